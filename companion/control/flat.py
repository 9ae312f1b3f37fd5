"""One whole control step, prediction included, on flat arrays: what the compiled engine calls.

Nested tuples are expensive to hand to compiled code (some 30 us for a step), a few arrays of floats are not. The
function is a kernel like the others and calls the very same `model.through` and `law.step_plain`; with lists instead of
arrays it runs as plain Python.
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence

from companion.control.heading import HeadingState
from companion.control.law import (
    ControllerState,
    Parameters,
    PlainCommand,
    PlainController,
    PlainEvaluation,
    lyapunov_plain,
    step_plain,
)
from companion.control.model import Factors, through
from companion.control.types import PlainState

# where things stand in the input, behind the state's 13 numbers
DT = 13
"""Since the last step [s]."""
FROZEN = 14
"""1: hold the estimator still."""
INTEGRATE = 15
"""1: the controller's state goes on."""
THRUST_NOW = 16
"""That acts at the state's stamp [N]."""
COUNT = 17
"""Of the pieces."""
REFERENCE = 18
"""18 numbers: position with four derivatives, heading with two."""
CONTROLLER = REFERENCE + 18
"""The controller's state; the step replaces it."""
PIECES = CONTROLLER + 15
"""Where the pieces begin."""
CONSTANTS = 36

# where things stand in the results: in the order of a flight's record (`record.columns`), then what is not in it
HEADING_ERROR = 0
ERRORS = slice(1, 13)
LYAPUNOV = 13
B_HAT = slice(14, 17)
TOTAL = 17
TOTAL_RATE = 18
TAU = slice(19, 22)
RATES = slice(22, 25)
LIMITS = 25
PREDICTED_Q = slice(26, 30)
PREDICTED_W = slice(30, 33)
THRUST = 33
RATES_MODEL = slice(34, 37)
RESULTS = 37
RECORDED = slice(HEADING_ERROR, LIMITS), slice(LIMITS, THRUST)
"""The two parts that stand together in the record."""


def constants(parameters: Parameters, lags: Factors) -> list[float]:
    """The CONSTANTS numbers of a control step in the order that `control_step` reads them."""
    g, m, lim = parameters
    return [
        *(g.k1, g.k2, g.k3, g.k4, g.gamma, g.p_max, float(g.heading_kind), g.l1, g.l2, g.damping),
        *(m.mass, m.gravity, m.drag, *m.rate_lag, *m.rate_integral, m.thrust_lag),
        *(lim.thrust_min, lim.thrust_max, *lim.rate_max),
        *(lim.disturbance_max, lim.heading_rate_max, lim.heading_speed_min),
        *lags,
    ]


def controller_numbers(c: ControllerState) -> tuple[float, ...]:
    """The controller's state as 15 numbers."""
    h = c.heading
    return (c.thrust, c.thrust_rate, *c.b_hat, *h.r2d, *h.forward, float(h.held), *c.lead_integral)


def controller_of_numbers(n: Sequence[float]) -> ControllerState:
    """The controller's state from what `controller_numbers` gives."""
    memory = HeadingState((n[5], n[6], n[7]), (n[8], n[9], n[10]), n[11] > 0.5)
    return ControllerState(n[0], n[1], (n[2], n[3], n[4]), memory, (n[12], n[13], n[14]))


def control_step(x: MutableSequence[float], c: Sequence[float], y: MutableSequence[float]) -> None:
    """Predicts the state through the pieces, computes one law step, and replaces the controller's state.

    Args:
        x: state 13, then what DT to CONTROLLER name, the controller's state being 15 numbers (T, T', b_hat, r2d,
            forward, held, lead integral), then PIECE numbers per piece.
        c: `constants`.
        y: gets RESULTS numbers, see the names above.
    """
    state = (x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[6], x[7], x[8], x[9]), (x[10], x[11], x[12])
    p, v, a = (x[18], x[19], x[20]), (x[21], x[22], x[23]), (x[24], x[25], x[26])
    j, s = (x[27], x[28], x[29]), (x[30], x[31], x[32])
    ref = p, v, a, j, s, x[33], x[34], x[35]
    b_hat = (x[38], x[39], x[40])
    memory = (x[41], x[42], x[43]), (x[44], x[45], x[46]), x[47] > 0.5
    controller = x[36], x[37], b_hat, memory, (x[48], x[49], x[50])
    gains = c[0], c[1], c[2], c[3], c[4], c[5], int(c[6]), c[7], c[8], c[9]
    model = c[10], c[11], c[12], (c[13], c[14], c[15]), (c[16], c[17], c[18]), c[19]
    limits = c[20], c[21], (c[22], c[23], c[24]), c[25], c[26], c[27]
    lags = (c[28], c[29], c[30], c[31], c[32], c[33], c[34], c[35])
    state, _ = through(state, x[THRUST_NOW], x, PIECES, int(x[COUNT]), b_hat, (c[10], c[11], c[12]), lags)
    command, after, out = step_plain(state, ref, controller, (gains, model, limits), x[FROZEN] > 0.5, x[DT])
    if x[INTEGRATE] < 0.5:
        after = controller
    thrust, rates, rates_model, tau, flags = command
    x[36], x[37], b_hat, (r2d, forward, held), lead_integral = after
    x[47] = 1.0 if held else 0.0
    e, _, _, _, _, y[HEADING_ERROR] = out
    y[LYAPUNOV] = lyapunov_plain(e, c[5])
    y[TOTAL], y[TOTAL_RATE], y[LIMITS], y[THRUST] = x[36], x[37], float(flags), thrust
    _, _, (y[26], y[27], y[28], y[29]), w = state
    for i in range(12):
        y[1 + i] = e[i]
    for i in range(3):
        y[14 + i] = b_hat[i]
        y[19 + i] = tau[i]
        y[22 + i] = rates[i]
        y[30 + i] = w[i]
        y[34 + i] = rates_model[i]
        x[38 + i] = b_hat[i]
        x[41 + i] = r2d[i]
        x[44 + i] = forward[i]
        x[48 + i] = lead_integral[i]


def results(
    command: PlainCommand, after: PlainController, out: PlainEvaluation, p_max: float, predicted: PlainState
) -> tuple[float, ...]:
    """The RESULTS numbers of a step that was computed with tuples."""
    thrust, rates, rates_model, tau, flags = command
    total, total_rate, b_hat, _, _ = after
    e, _, _, _, _, heading_error = out
    _, _, q, w = predicted
    return (
        *(heading_error, *e[:12], lyapunov_plain(e, p_max), *b_hat, total, total_rate, *tau, *rates),
        *(float(flags), *q, *w, thrust, *rates_model),
    )
