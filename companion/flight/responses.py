"""The ladder of responses to a guard that is broken: slower, to rest, Hold, Land, silence.

The last rungs are the sequence's: it hands over to Hold, to Return or Land where Hold is refused, and then sends
nothing more.
"""

from __future__ import annotations

from companion.flight.guards import Finding, Guard, Response
from companion.flight.phases import Phase
from companion.flight.sequence import Sequence
from companion.link import modes

SLOW_PACE = 0.5
"""Of the reference, while something is not well."""


def respond(sequence: Sequence, finding: Finding, now_s: float) -> None:
    """Does what a finding asks for, if it is more than what is done already.

    Args:
        sequence: of the flight.
        finding: what was found.
        now_s: vehicle time [s].
    """
    if sequence.ending is not None:
        return
    guard, response, detail = finding
    if guard is None:
        sequence.orders.set_pace(1.0, detail)
    elif response is Response.SLOW:
        sequence.orders.set_pace(SLOW_PACE, _said(guard, detail))
    elif response is Response.REST and sequence.phase is not Phase.LAND:
        sequence.come_to_rest(guard.value.cause, detail, now_s)
    elif response is Response.HOLD:
        sequence.end(guard.value.cause, detail, now_s)
    elif response is Response.LAND:
        sequence.end(guard.value.cause, detail, now_s, (modes.LAND,))


def _said(guard: Guard, detail: str) -> str:
    return f"{guard.value.cause.value.sentence}: {detail}"
