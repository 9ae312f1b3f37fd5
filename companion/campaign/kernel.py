"""One whole flight as one kernel: the law, the delay line, the inner loops, the rigid body and the noise, step by step.

It strings together the very functions that fly: `control.model.advance` and `control.law.step` on the companion's side,
`sim_link.inner_loops.advance_step` and `sim_link.estimator.with_noise` on the vehicle's. What `flight.tracker` and
`control.history` work out from time stamps is constant here, because states come at equal intervals: which commands
act in which piece of the prediction is a table of weights. Plain Python with lists, or compiled with arrays
(`companion.accelerate`): the same source.

Nothing is random in here: noise and gusts are handed in.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

from companion.control.law import Command, ControllerState, Evaluation, Parameters, step
from companion.control.model import Factors, advance
from companion.control.output import Conversion, attitude_output, rates_output
from companion.control.types import Reference, State, Vec3
from sim_link.estimator import Noise, with_noise
from sim_link.inner_loops import ATTITUDE, RATES, LoopGains, LoopState, Setpoint, advance_step
from sim_link.physics import Body, RigidState

REFERENCE = 21
"""Numbers of a reference row: p, v, a, j, s, three of the heading, all at the time of effect, then the position at the
stamp (18, 19, 20)."""
NOISE = 12
AIR = 3
STATE = 13
"""Numbers of a true state in the ring."""
COMMAND = 12
"""Numbers of a command in its ring: the thrust and rates of the model, then thrust fraction, rates or the attitude's
first three numbers, its last one, and the yaw rate."""
ROW = 17

# where things stand in a row of what is recorded
ERROR = slice(0, 3)
HEADING_ERROR = 3
THRUST = 4
TILT_COSINE = 5
TAU = slice(6, 9)
LIMITS = 9
B_HAT = slice(10, 13)
E1_SQUARED = 13
POSITION = slice(14, 17)

FLOWN = 0
DIVERGED = 1
GROUND = 2
"""How a flight ended."""


class Clock(NamedTuple):
    """The clockwork of a flight; whole numbers are counts of physics steps unless they say otherwise."""

    start_us: int
    """Vehicle time at the start."""
    dt_us: int
    """One physics step."""
    per_state: int
    """Steps between two states."""
    age: int
    """How old a state is when it arrives."""
    delay: int
    """From a command to its effect, as it really is."""
    per_gust: int
    """Steps between two rows of the air."""
    states: int
    """States that are answered."""


class Memory(NamedTuple):
    """What `control.history` amounts to at equal intervals."""

    pieces: int
    """Number of pieces; the weights are pieces rows over `history` commands, the newest first."""
    length_s: float
    """Of a piece."""
    history: int
    """Commands that are remembered."""
    older: int
    """How many states ago the command was computed that acts first in the interval before a state."""
    decay_older: float
    """What is left of the thrust's gap when that command ends."""
    decay_newer: float
    """What is left after the one that follows it."""


class Setup(NamedTuple):
    """All constants of a flight."""

    parameters: Parameters
    lags: Factors
    conversion: Conversion
    by_attitude: bool
    """Attitude setpoints instead of rates."""
    clock: Clock
    memory: Memory
    hover: tuple[float, float]
    """Thrust setpoint [N] before the first command as the prediction takes it, and the fraction that is sent."""
    body: Body
    gains: LoopGains
    noise: Noise
    force_n: Vec3
    ground_d_m: float
    diverged_m: float
    """Position error beyond which the flight is given up."""


def fly(
    setup: Setup,
    rigid: RigidState,
    loops: LoopState,
    controller: ControllerState,
    reference: Sequence[float],
    noise: Sequence[float],
    air: Sequence[float],
    weights: Sequence[float],
    ring: MutableSequence[float],
    sent: MutableSequence[float],
    rows: MutableSequence[float],
) -> tuple[int, int, RigidState]:
    """Fly from a start to the end of the reference, or until it diverges or touches the ground.

    Args:
        setup: the constants.
        rigid: the vehicle at the start.
        loops: its inner loops.
        controller: the controller's state.
        reference: REFERENCE numbers per state.
        noise: NOISE standard normal numbers per state.
        air: AIR numbers, the velocity of the air NED [m/s], per gust period.
        weights: of the prediction, see `Memory`.
        ring: STATE (clock.age + 1) numbers, filled with the state before the start.
        sent: COMMAND numbers per remembered command, filled with the hover's; see `ring_length`.
        rows: gets ROW numbers per state.

    Returns:
        how it ended, the number of rows, and the vehicle at the end.
    """
    parameters, lags, conversion, by_attitude, clock, memory, hover, body, gains, sigmas, force_n, ground, far = setup
    start_us, dt_us, per_state, age, delay, per_gust, states = clock
    vehicle = (parameters.model.mass, parameters.model.gravity, parameters.model.drag)
    dt_s = dt_us * 1.0e-6
    remembered = len(sent) // COMMAND
    interval_s = per_state * dt_us * 1.0e-6
    thrust = hover[0]
    acting = Setpoint(RATES, hover[1], (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0))
    fresh = True
    far_sq = far * far
    wait = -(-age // per_state)
    """States that are still from before the start when they arrive."""
    slot = 0
    at_step = 0
    wind = (air[0], air[1], air[2])
    last_s = 0.0
    for tick in range(wait + states):
        k = tick - wait
        if k >= 0:
            # -- the state as the vehicle believes it, `age` steps old
            state = _believed(ring, STATE * ((at_step - age) % (age + 1)), noise, NOISE * k, sigmas)
            p = state.p
            stamp_s = (start_us + (at_step - age) * dt_us) * 1.0e-6
            dt = interval_s if k == 0 else stamp_s - last_s
            last_s = stamp_s
            # -- what was sent acts until the new command will: the thrust at the stamp, then the pieces
            if k > 0:
                thrust = _thrust_at_stamp(thrust, sent, slot, remembered, memory)
            ahead = state
            thrust_ahead = thrust
            for i in range(memory.pieces):
                mean_t, means = _piece(weights, memory.history * i, memory.history, sent, slot, remembered)
                ahead, thrust_ahead = advance(
                    ahead, thrust_ahead, means, mean_t, controller.b_hat, vehicle, lags, memory.length_s
                )
            # -- the law at the time of effect
            r = REFERENCE * k
            wanted = _wanted(reference, r)
            order, controller, out = step(ahead, wanted, controller, parameters, False, dt)
            # -- into the delay line
            _send(sent, COMMAND * slot, order, ahead, by_attitude, conversion)
            slot = (slot + 1) % remembered
            # -- what is recorded
            x, y, z = p[0] - reference[r + 18], p[1] - reference[r + 19], p[2] - reference[r + 20]
            _note(rows, ROW * k, state, (x, y, z), order, controller, out)
            if not x * x + y * y + z * z < far_sq:  # NaN is not
                return DIVERGED, k + 1, rigid
        # -- the vehicle, until the next state
        for _ in range(per_state):
            late = at_step - delay
            if late >= wait * per_state and late % per_state == 0:
                acting = _setpoint(sent, COMMAND * ((late // per_state - wait) % remembered), by_attitude)
                fresh = True
            if at_step % per_gust == 0:
                g = AIR * (at_step // per_gust)
                wind = (air[g], air[g + 1], air[g + 2])
            rigid, loops, sinking, _ = advance_step(
                rigid, loops, acting, fresh, wind, force_n, body, gains, ground, dt_s
            )
            fresh = False
            at_step += 1
            _keep(ring, STATE * (at_step % (age + 1)), rigid)
            if sinking >= 0.0:
                return GROUND, max(k + 1, 0), rigid
    return FLOWN, states, rigid


def _believed(ring: Sequence[float], at: int, noise: Sequence[float], n: int, sigmas: Noise) -> State:
    """The state at a place of the ring, with the noise of its draws."""
    draws = (noise[n], noise[n + 1], noise[n + 2], noise[n + 3], noise[n + 4], noise[n + 5], noise[n + 6],
             noise[n + 7], noise[n + 8], noise[n + 9], noise[n + 10], noise[n + 11])  # fmt: skip
    p, v, q, w = with_noise(
        (ring[at], ring[at + 1], ring[at + 2]),
        (ring[at + 3], ring[at + 4], ring[at + 5]),
        (ring[at + 6], ring[at + 7], ring[at + 8], ring[at + 9]),
        (ring[at + 10], ring[at + 11], ring[at + 12]),
        sigmas,
        draws,
    )
    return State(p, v, q, w)


def _thrust_at_stamp(thrust: float, sent: Sequence[float], slot: int, remembered: int, memory: Memory) -> float:
    """The modelled thrust, one state on."""
    if memory.decay_older < 1.0:
        command = sent[COMMAND * ((slot - memory.older) % remembered)]
        thrust = command + (thrust - command) * memory.decay_older
    command = sent[COMMAND * ((slot - memory.older + 1) % remembered)]
    return command + (thrust - command) * memory.decay_newer


def _piece(
    weights: Sequence[float], begin: int, history: int, sent: Sequence[float], slot: int, remembered: int
) -> tuple[float, Vec3]:
    """Mean thrust and rates of the commands that act in a piece, by the row of weights that begins at `begin`."""
    mean_t = mean_x = mean_y = mean_z = 0.0
    for j in range(history):
        share = weights[begin + j]
        if share > 0.0:
            c = COMMAND * ((slot - 1 - j) % remembered)
            mean_t += share * sent[c]
            mean_x += share * sent[c + 1]
            mean_y += share * sent[c + 2]
            mean_z += share * sent[c + 3]
    return mean_t, (mean_x, mean_y, mean_z)


def _wanted(reference: Sequence[float], r: int) -> Reference:
    """The reference of the row that begins at `r`."""
    return Reference(
        (reference[r], reference[r + 1], reference[r + 2]),
        (reference[r + 3], reference[r + 4], reference[r + 5]),
        (reference[r + 6], reference[r + 7], reference[r + 8]),
        (reference[r + 9], reference[r + 10], reference[r + 11]),
        (reference[r + 12], reference[r + 13], reference[r + 14]),
        reference[r + 15],
        reference[r + 16],
        reference[r + 17],
    )


def _send(
    sent: MutableSequence[float], c: int, order: Command, ahead: State, by_attitude: bool, conversion: Conversion
) -> None:
    """Put a command into the delay line, as the model and as the vehicle take it."""
    sent[c] = order.thrust
    for i in range(3):
        sent[c + 1 + i] = order.rates_model[i]
    if by_attitude:
        turn = attitude_output(order.thrust, order.rates, order.tau, ahead.q, ahead.w, conversion)
        sent[c + 4] = turn.thrust
        sent[c + 5], sent[c + 6], sent[c + 7], sent[c + 8] = turn.q
        sent[c + 9] = turn.yaw_rate
    else:
        spin = rates_output(order.thrust, order.rates, conversion)
        sent[c + 4] = spin.thrust
        for i in range(3):
            sent[c + 5 + i] = spin.w[i]


def _setpoint(sent: Sequence[float], c: int, by_attitude: bool) -> Setpoint:
    """The command at a place of the delay line as the vehicle's loops take it."""
    zero = (0.0, 0.0, 0.0)
    if by_attitude:
        attitude = (sent[c + 5], sent[c + 6], sent[c + 7], sent[c + 8])
        return Setpoint(ATTITUDE, sent[c + 4], zero, attitude, sent[c + 9], zero)
    rates = (sent[c + 5], sent[c + 6], sent[c + 7])
    return Setpoint(RATES, sent[c + 4], rates, (1.0, 0.0, 0.0, 0.0), 0.0, zero)


def _note(
    rows: MutableSequence[float],
    b: int,
    state: State,
    error: Vec3,
    order: Command,
    controller: ControllerState,
    out: Evaluation,
) -> None:
    """Fill the row that begins at `b`."""
    e1, q = out.errors.e1, state.q
    rows[b + 3] = out.heading_error
    rows[b + 4] = controller.thrust
    rows[b + 5] = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    for i in range(3):
        rows[b + i] = error[i]
        rows[b + 6 + i] = order.tau[i]
        rows[b + 10 + i] = controller.b_hat[i]
        rows[b + 14 + i] = state.p[i]
    rows[b + 9] = float(order.limits)
    rows[b + 13] = e1[0] * e1[0] + e1[1] * e1[1] + e1[2] * e1[2]


def _keep(ring: MutableSequence[float], at: int, rigid: RigidState) -> None:
    """Put the true state into the ring."""
    for i in range(3):
        ring[at + i] = rigid.p[i]
        ring[at + 3 + i] = rigid.v[i]
        ring[at + 10 + i] = rigid.w[i]
    ring[at + 6], ring[at + 7], ring[at + 8], ring[at + 9] = rigid.q


def ring_length(clock: Clock, memory: Memory) -> int:
    """How many commands the ring holds: those that the prediction remembers, and those under way."""
    return max(memory.history, memory.older, -(-clock.delay // clock.per_state)) + 2


def finite(rigid: RigidState) -> bool:
    """Whether a vehicle is still somewhere."""
    return all(math.isfinite(x) for x in (*rigid.p, *rigid.v, *rigid.q, *rigid.w))
