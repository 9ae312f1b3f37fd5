"""The keys of the ground process, and telling people what was refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from companion.link.framing import refused_since
from companion.link.signing_times import KeptSigner, open_signer

TELL_EVERY_S: Final = 10.0


class Guards:
    """One signer for each key file: what was accepted on one link is not accepted on another one with the same key."""

    def __init__(self) -> None:
        self._opened: dict[str, KeptSigner] = {}

    def of(self, key_file: str | None) -> KeptSigner | None:
        """The signer for a key file; None without one.

        Raises:
            InputError: the key file cannot be used.
        """
        if key_file is None:
            return None
        known = self._opened.get(key_file)
        if known is None:
            opened = open_signer(key_file)
            assert opened is not None
            known = self._opened[key_file] = opened
        return known

    def close(self) -> None:
        """Ends all of them in order."""
        for signer in self._opened.values():
            signer.close()


class RefusalWatch:
    """Tells what was refused since it told last, every ten seconds at most.

    Args:
        say: gets a line.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._told: dict[str, dict[str, int]] = {}
        self._told_s = -TELL_EVERY_S

    def tick(self, now_s: float, refused: dict[str, dict[str, int]]) -> None:
        """Takes what was refused so far, by link and reason."""
        if now_s - self._told_s < TELL_EVERY_S:
            return
        for link, reasons in refused.items():
            before = self._told.get(link, {})
            # The control process counts from zero again when it was started again.
            again = any(count < before.get(reason, 0) for reason, count in reasons.items())
            more = refused_since(reasons, {} if again else before)
            told = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in more.items())
            if told:
                self._told_s = now_s
                self._say(f"refused at {link}: {told}")
            self._told[link] = dict(reasons)
