"""What AUTOPILOT_VERSION says about the autopilot's software, as far as a flight depends on it."""

from __future__ import annotations

from typing import Final, NamedTuple

from companion.link.codec import AutopilotVersionMessage

ACTUATOR_CONTROL_REMOVED_IN: Final = (1, 14, 0)
"""PX4 release that dropped SET_ACTUATOR_CONTROL_TARGET; it has ignored the message without a word since."""

_RELEASE_TYPES: Final = {0: "dev", 64: "alpha", 128: "beta", 192: "release candidate"}  # FIRMWARE_VERSION_TYPE


class AutopilotVersion(NamedTuple):
    """The autopilot's version and abilities."""

    version: tuple[int, int, int]
    """Major, minor, patch; (0, 0, 0) when it does not say."""
    release_type: int
    """FIRMWARE_VERSION_TYPE: 0 development ... 255 official release."""
    capabilities: int
    """MAV_PROTOCOL_CAPABILITY bits."""
    uid: int
    """Hardware id, 0 when it does not say."""

    @classmethod
    def from_message(cls, message: AutopilotVersionMessage) -> AutopilotVersion:
        """Unpack the message's packed version."""
        packed = message.flight_sw_version
        version = (packed >> 24 & 0xFF, packed >> 16 & 0xFF, packed >> 8 & 0xFF)
        return cls(version, packed & 0xFF, message.capabilities, message.uid)

    @property
    def accepts_actuator_control(self) -> bool:
        """Whether SET_ACTUATOR_CONTROL_TARGET does anything (PX4 before 1.14). An unknown version counts as new."""
        return (0, 0, 0) < self.version < ACTUATOR_CONTROL_REMOVED_IN

    @property
    def label(self) -> str:
        """For people: "1.18.0", "1.18.0 (beta)", "unknown version"."""
        if self.version == (0, 0, 0):
            return "unknown version"
        kind = _RELEASE_TYPES.get(self.release_type)
        return ".".join(str(part) for part in self.version) + (f" ({kind})" if kind else "")
