"""What is flown over the loop as it was measured before the flight: which setpoints go out, and with which share of the
vehicle file's gains.

Body rates follow best and forgive least: the autopilot keeps turning through a gap. An attitude setpoint is held
through it. So rates are flown while the loop is as the vehicle file says; where it is not, with gains as low as that
loop needs, and attitude setpoints where it has gaps and they are certified. One number lowers all gains: k1, k3, k4 and
the heading's by a share, Gamma by its cube, p_max by its square the other way, which is the same law on a slower clock.
Every choice passes the same certificate and the same margins as the file's own gains do, over the interval, delay and
gap that were measured. Nothing is chosen in flight: PX4 takes up to half a second to change what it listens to.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

from companion.config import STATE_AGE_ROOM_S, Flight, Vehicle
from companion.control.certificate import certify, disturbance_overcome
from companion.control.sampled import DELAY_STRIDE_S, INTERVAL_STRIDE_S
from companion.errors import InputError
from companion.flight.adaptation import Adaptation, adapted
from companion.flight.findings import Finding, Gate, passed, refused, warning
from companion.flight.gates_state import JITTER_WANTED_S, RATE_FLOOR, SCHEDULED_RATE_FLOOR
from companion.flight.loop_margins import DELAY_MARGIN_MIN_S, loop_margins
from companion.flight.measure import LinkFigures

SHARES: Final = (1.0, 0.85, 0.7, 0.6, 0.5)
"""Of the vehicle file's gains; the first that is certified is flown."""
AGE_ROOM_S: Final = 0.010
GAP_BORNE_S: Final = 0.15
"""A longer interval is not asked of the loop: gaps are rare, margins speak of every interval."""


class Choice(NamedTuple):
    """What was chosen, and what people are told."""

    adaptation: Adaptation | None
    """None: what the files say, rates where they leave it open."""
    finding: Finding


def choose(flight: Flight, link: LinkFigures) -> Choice:
    """What to fly over a loop that was measured so."""
    gate, limit = Gate.LOOP_HEALTH, "as the vehicle file says, or certified as it is"
    kind = flight.output.kind
    fixed = flight.output.by_law
    if flight.output.controller != "law" or link.rate_hz is None:
        return Choice(None, passed(gate, "not judged", limit, "the law does not fly, or nothing came to judge it by"))
    wrong = _wrong(flight.vehicle, link)
    if _hopeless(flight.vehicle, link):
        return Choice(None, passed(gate, "not judged", limit, "another gate refuses this loop"))
    if not wrong:
        by = "as asked for" if kind != "auto" else "the most precise"
        return Choice(None, passed(gate, fixed, limit, f"the loop is as the vehicle file says: output {fixed}, {by}"))
    said = ", ".join(wrong)
    for share, output in _candidates(kind, gaps=link.gaps > 0):
        adaptation = _measured(flight.vehicle, link, output, share)
        if _bears(adapted(flight, adaptation).vehicle, output, link):
            shown = f"{output}, {share:.0%} of the gains"
            sentence = (
                f"the loop is worse than the vehicle file says ({said}): output {output}, {share:.0%} of its gains"
            )
            fix = "certified for what was measured; put the loop right to fly more precisely"
            return Choice(adaptation, warning(gate, shown, limit, sentence, fix))
    sentence = f"no certified gains for the loop as it is: {said}"
    fix = "look for what holds the link or this machine up, or lower the gains"
    return Choice(None, refused(gate, said, limit, sentence, fix))


def _wrong(vehicle: Vehicle, link: LinkFigures) -> list[str]:
    """In what the loop is worse than the vehicle file's, for people."""
    out, wanted = [], vehicle.link.state_rate_hz
    assert link.rate_hz is not None
    if link.rate_hz < RATE_FLOOR * wanted:
        out.append(f"states at {link.rate_hz:.0f} Hz, not {wanted:.0f}")
    if link.age_s is not None and link.age_s > vehicle.link.state_age_s + AGE_ROOM_S and not link.paced:
        out.append(f"states {link.age_s * 1e3:.0f} ms old, not {vehicle.link.state_age_s * 1e3:.0f}")
    if link.jitter_s is not None and link.jitter_s > 2.0 * JITTER_WANTED_S:
        out.append(f"jitter of {link.jitter_s * 1e3:.0f} ms")
    if link.gaps and link.longest_gap_s is not None:
        out.append(f"gaps of up to {link.longest_gap_s * 1e3:.0f} ms")
    return out


def _hopeless(vehicle: Vehicle, link: LinkFigures) -> bool:
    """Whether states are so rare or so old that the gates for that refuse, whatever would be flown."""
    assert link.rate_hz is not None
    old = link.age_s is not None and link.age_s > vehicle.link.state_age_s + STATE_AGE_ROOM_S
    return link.rate_hz < SCHEDULED_RATE_FLOOR * vehicle.link.state_rate_hz or (old and not link.paced)


def _candidates(kind: str, *, gaps: bool) -> Iterable[tuple[float, str]]:
    """Shares and outputs in the order in which they are tried."""
    outputs: tuple[str, ...] = (kind,)
    if kind == "auto":
        outputs = ("attitude", "rates") if gaps else ("rates",)
    return [(share, output) for share in SHARES for output in outputs]


def _measured(vehicle: Vehicle, link: LinkFigures, output: str, share: float) -> Adaptation:
    """The loop as it was measured; where that is better than the vehicle file, the file's."""
    assert link.rate_hz is not None
    rate_hz = min(max(link.rate_hz, 10.0), vehicle.link.state_rate_hz)
    age_s = vehicle.link.state_age_s
    if link.age_s is not None and not link.paced:
        age_s = min(max(age_s, link.age_s), 0.5)
    return Adaptation(output, share, rate_hz, age_s)


def _bears(vehicle: Vehicle, output: str, link: LinkFigures) -> bool:
    """Whether these gains are certified over this loop, its jitter and its longest gap."""
    try:
        parameters = vehicle.parameters()
    except InputError:
        return False
    sound = certify(parameters.gains, parameters.model.drag).failure() is None
    if not sound or vehicle.limits.disturbance_max_m_s2 > disturbance_overcome(parameters.gains):
        return False
    delay_s = max(DELAY_MARGIN_MIN_S, min(link.jitter_s or 0.0, 0.05))
    gap_s = max(vehicle.limits.state_gap_max_s, min(link.longest_gap_s or 0.0, GAP_BORNE_S))
    found = loop_margins(vehicle, output, delay_s + DELAY_STRIDE_S, gap_s + 1.5 * INTERVAL_STRIDE_S)
    return found.delay_margin_s >= delay_s and found.interval_max_s >= gap_s
