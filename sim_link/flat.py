"""The vehicle's steps on one flat array of floats: what the compiled engine calls, once for many steps.

Nested tuples are expensive to hand to compiled code (some 14 us), one array that is allocated once is not. The array
holds everything: state, setpoint, constants, the true states of as long as the estimator is late, and a block of the
estimator's noise. The functions are kernels like the others and call the very same `inner_loops.advance_step` and
`estimator.with_noise`; with a list instead of an array they run as plain Python.
"""

from __future__ import annotations

from collections.abc import MutableSequence

from .estimator import NOISE_ROWS, Noise, with_noise
from .inner_loops import LoopState, Setpoint, advance_step
from .loop_gains import LoopGains
from .physics import Body, RigidState

# Where things stand, in the order of the fields of the tuples whose names they bear.
RIGID = 0
RIGID_NUMBERS = 17
LOOPS = 17
LOOPS_NUMBERS = 17
ORDER = 34
"""Setpoint, then whether it is fresh (0 or 1), the number of steps, and what is asked for."""
FRESH = 47
ASK = 49
"""Row of the ring, and row of the noise, that make the estimate that is asked for."""
ORDER_NUMBERS = 17
TOUCH = 51
"""On the ground after the last step (0 or 1), then the hardest touchdown so far [m/s]."""
ESTIMATE = 53
"""p, v, q, w of the estimate that was asked for."""
ESTIMATE_NUMBERS = 13
AIR = 66
FORCE = 69
WORLD = 72
"""Ground's down coordinate [m], step [s]."""
BODY = 74
BODY_NUMBERS = 25
GAINS = 99
GAINS_NUMBERS = 36
SIGMAS = 135
RING_ROWS = 139
RING_NEXT = 140
"""Row of the ring that the next step overwrites: the oldest."""
NOISE = 141
NOISE_NUMBERS = 12
RING = NOISE + NOISE_NUMBERS * NOISE_ROWS
RING_NUMBERS = 13


def length(ring_rows: int) -> int:
    """Return how many numbers the array holds when the estimator is late by ring_rows - 1 steps."""
    return RING + RING_NUMBERS * ring_rows


def run_steps(x: MutableSequence[float]) -> None:
    """Run the steps that the array asks for, keep the true states of all of them, and write the estimate of then."""
    rigid = RigidState((x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[6], x[7], x[8], x[9]), (x[10], x[11], x[12]),
                       (x[13], x[14], x[15], x[16]))  # fmt: skip
    loops = LoopState((x[17], x[18], x[19]), (x[20], x[21], x[22]), (x[23], x[24], x[25]),
                      (x[26], x[27], x[28], x[29]), (x[30], x[31], x[32]), x[33])  # fmt: skip
    setpoint = Setpoint(int(x[34]), x[35], (x[36], x[37], x[38]), (x[39], x[40], x[41], x[42]), x[43],
                        (x[44], x[45], x[46]))  # fmt: skip
    body = Body(x[74], (x[75], x[76], x[77]), x[78], x[79], x[80], x[81], x[82], (x[83], x[84], x[85], x[86]),
                (x[87], x[88], x[89], x[90]), (x[91], x[92], x[93], x[94]),
                (x[95], x[96], x[97], x[98]))  # fmt: skip
    gains = LoopGains((x[99], x[100], x[101]), (x[102], x[103], x[104]), (x[105], x[106], x[107]), x[108], x[109],
                      (x[110], x[111], x[112]), x[113], (x[114], x[115], x[116]), x[117],
                      (x[118], x[119], x[120], x[121]), (x[122], x[123], x[124], x[125]),
                      (x[126], x[127], x[128], x[129]), (x[130], x[131], x[132], x[133]), x[134])  # fmt: skip
    air = (x[66], x[67], x[68])
    force = (x[69], x[70], x[71])
    fresh = x[FRESH] > 0.5
    rows = int(x[RING_ROWS])
    row = int(x[RING_NEXT])
    sinking = -1.0
    for _ in range(int(x[FRESH + 1])):
        rigid, loops, sinking, hit = advance_step(
            rigid, loops, setpoint, fresh, air, force, body, gains, x[WORLD], x[WORLD + 1]
        )
        fresh = False
        x[TOUCH + 1] = max(x[TOUCH + 1], hit)
        keep(x, RING + RING_NUMBERS * row, rigid)
        row = row + 1 if row + 1 < rows else 0
    x[RING_NEXT] = float(row)
    x[TOUCH] = 1.0 if sinking >= 0.0 else 0.0
    keep(x, RIGID, rigid)
    x[13], x[14], x[15], x[16] = rigid.rotor_n
    for i in range(3):
        x[17 + i] = loops.integral[i]
        x[20 + i] = loops.w_previous[i]
        x[23 + i] = loops.rates[i]
        x[30 + i] = loops.w_ref[i]
    x[26], x[27], x[28], x[29] = loops.q_ref
    x[33] = loops.reference_age_s
    estimate(x)


def keep(x: MutableSequence[float], at: int, rigid: RigidState) -> None:
    """Write p, v, q and w from x[at] on."""
    for i in range(3):
        x[at + i] = rigid.p[i]
        x[at + 3 + i] = rigid.v[i]
        x[at + 10 + i] = rigid.w[i]
    x[at + 6], x[at + 7], x[at + 8], x[at + 9] = rigid.q


def estimate(x: MutableSequence[float]) -> None:
    """Write the estimate that is asked for: a true state of the ring, with noise."""
    at = RING + RING_NUMBERS * int(x[ASK])
    noise = NOISE + NOISE_NUMBERS * int(x[ASK + 1])
    sigmas = Noise(x[SIGMAS], x[SIGMAS + 1], x[SIGMAS + 2], x[SIGMAS + 3])
    n = (x[noise], x[noise + 1], x[noise + 2], x[noise + 3], x[noise + 4], x[noise + 5], x[noise + 6], x[noise + 7],
         x[noise + 8], x[noise + 9], x[noise + 10], x[noise + 11])  # fmt: skip
    p, v, q, w = with_noise(
        (x[at], x[at + 1], x[at + 2]),
        (x[at + 3], x[at + 4], x[at + 5]),
        (x[at + 6], x[at + 7], x[at + 8], x[at + 9]),
        (x[at + 10], x[at + 11], x[at + 12]),
        sigmas,
        n,
    )
    for i in range(3):
        x[ESTIMATE + i] = p[i]
        x[ESTIMATE + 3 + i] = v[i]
        x[ESTIMATE + 10 + i] = w[i]
    x[ESTIMATE + 6], x[ESTIMATE + 7], x[ESTIMATE + 8], x[ESTIMATE + 9] = q
