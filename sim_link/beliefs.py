"""What goes wrong with what the vehicle believes: resets, drift, bias walk, outage, freeze, delay, rate, bad numbers.

A layer over the estimator's late and noisy sample (`engines.Engine.believed`). Nothing here touches the truth. While
nothing is wrong the layer is not entered at all (`active`). What it gives is a function of the vehicle's time, of the
seed and of what was set when; it does not matter who asks, or how often, and both engines give the same.

The autopilot flies on the same beliefs (`inner`): a reset, a drift, a walk, a freeze, an outage reach its position,
velocity and heading. It has no delay, no noise and no lower rate (PX4's output predictor takes them out), and its
inner loops go on with the true tilt and the gyros' rates, as the kernels compute them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from .bias_walk import Bias, BiasWalk, sigmas_of
from .estimator import Estimate
from .inner_loops import ATTITUDE, Setpoint
from .physics import RigidState
from .rotation import Quat, Vec3, from_yaw, multiply
from .vehicle_file import VehicleFile

BAD_NUMBERS = ("nan", "zero_quaternion", "stamp_back")
"""In which ways what is sent can be broken."""
STAMP_BACK_US = 1_000_000
"""So far back go the stamps of "stamp_back"."""
DELAY_MAX_S = 10.0
RATE_MIN_HZ = 0.1
_ZERO: Vec3 = (0.0, 0.0, 0.0)
_NO_NUMBERS: Vec3 = (math.nan, math.nan, math.nan)
_NO_ATTITUDE: Quat = (math.nan, math.nan, math.nan, math.nan)


class Source(Protocol):
    """Where the samples come from (an engine)."""

    def believed(self, steps_ahead: int) -> Estimate:
        """Return the estimate that is the newest in so many steps."""

    def set_noise_factor(self, factor: float) -> None:
        """Scale the white noise of the estimates that are asked for from now on."""


class Reset(NamedTuple):
    """A jump of the estimate."""

    dp_m: Vec3
    dv_m_s: Vec3
    dyaw_rad: float


class _Pose(NamedTuple):
    """What the autopilot believes, without its rates."""

    p: Vec3
    v: Vec3
    q: Quat


class Beliefs:
    """The errors of one vehicle's estimate. Each is in force from the call on, until it is taken back."""

    def __init__(
        self,
        source: Source,
        rigid: Callable[[], RigidState],
        clock: Callable[[], int],
        *,
        vehicle: VehicleFile,
        seed: int,
        dt_us: int,
        age_steps: int,
    ) -> None:
        """Begin with the vehicle file's bias walk alone.

        Args:
            source: gives the late and noisy samples.
            rigid: gives the true state now.
            clock: gives the vehicle's time [us].
            vehicle: gives the bias walk.
            seed: of the bias walk.
            dt_us: one step.
            age_steps: how late the samples are.
        """
        self._source = source
        self._rigid = rigid
        self._clock = clock
        self._dt_us = dt_us
        self._age_steps = age_steps
        sigmas = sigmas_of(vehicle)
        self._walk = BiasWalk(sigmas, seed=seed, start_us=clock()) if sigmas.any else None
        self.active = self._walk is not None
        """Whether the estimate may differ from the source's."""
        self.recording = False
        """Whether `record` must be called after every single step."""
        self.version = 0
        """Rises with everything that is set."""
        self.reset_counter = 0
        """ODOMETRY.reset_counter: number of resets, mod 256."""
        self._resets: list[Reset] = []
        self._jumped = Reset(_ZERO, _ZERO, 0.0)
        self._drift_m_s: Vec3 = _ZERO
        self._drift_rad_s = 0.0
        self._drift_us = clock()
        self._drifted_m: Vec3 = _ZERO
        self._drifted_rad = 0.0
        self._frozen: tuple[Estimate, _Pose, float] | None = None
        """Estimate, the autopilot's pose, and heading error, all three before resets."""
        self._lost: tuple[Estimate, _Pose] | None = None
        self._bad: str | None = None
        self._delay_us = 0
        self._period_ns = 0
        self._anchor_us = 0
        """A stamp of the grid of a lower rate."""
        self._floor_us = 0
        """Newest stamp so far when the delay changed: stamps do not go back."""
        self._history: deque[Estimate] = deque()
        self._last: Estimate | None = None
        self._last_us = -1
        self._inner: RigidState | None = None
        self._inner_of: RigidState | None = None

    # What goes wrong

    def reset(self, dp_m: Vec3, dv_m_s: Vec3, dyaw_rad: float) -> None:
        """Let the estimate jump from now on, as after a reset of the filter; `reset_counter` rises by one.

        Args:
            dp_m: added to the position, NED [m].
            dv_m_s: added to the velocity, NED [m/s].
            dyaw_rad: turns the attitude about the inertial down axis [rad]; position and velocity stay.

        Raises:
            ValueError: a number is not finite.
        """
        _check("reset", *dp_m, *dv_m_s, dyaw_rad)
        old = self._jumped
        self._jumped = Reset(_sum(old.dp_m, dp_m), _sum(old.dv_m_s, dv_m_s), old.dyaw_rad + dyaw_rad)
        self.reset_counter = (self.reset_counter + 1) % 256
        self._resets.append(Reset(dp_m, dv_m_s, dyaw_rad))
        self._changed()

    def set_outage(self, active: bool) -> None:
        """Begin or end an outage: there is no state at all. What was believed last is kept, but is not to be sent."""
        if active != (self._lost is not None):
            self._lost = (self._complete(0), self._pose(self._rigid())) if active else None
            self._changed()

    def set_frozen(self, active: bool) -> None:
        """Let the numbers stand still, or go on; their stamps go on all the time. A reset moves frozen ones too."""
        if active != (self._frozen is not None):
            self._frozen = self._unmoved() if active else None
            self._changed()

    def set_noise_factor(self, factor: float) -> None:
        """Scale the vehicle file's white noise from now on; 1: as it is there. Raises ValueError."""
        _check("noise factor", factor)
        if factor < 0.0:
            raise ValueError(f"noise factor {factor!r}: must be 0 or more")
        self._source.set_noise_factor(factor)
        self._changed()

    def set_delay_s(self, delay_s: float | None) -> None:
        """Let estimates come later by this much than the vehicle file says; None: as it says.

        Stamps never go back: after a rise of the delay no new estimate comes for as long as it rose. After a fall the
        ones that were under way are left out.

        Raises:
            ValueError: not 0 to DELAY_MAX_S.
        """
        delay_s = 0.0 if delay_s is None else delay_s
        if not 0.0 <= delay_s <= DELAY_MAX_S:
            raise ValueError(f"delay {delay_s!r} s: must be 0 to {DELAY_MAX_S:g}")
        self._floor_us = self._wanted_us(self._clock())
        self._delay_us = round(delay_s * 1.0e6 / self._dt_us) * self._dt_us
        self._changed()

    def set_rate_hz(self, rate_hz: float | None) -> None:
        """Let estimates come at a lower rate: between two of them the last one is repeated; None: at the usual rate.

        Raises:
            ValueError: below RATE_MIN_HZ.
        """
        if rate_hz is not None and not RATE_MIN_HZ <= rate_hz < math.inf:
            raise ValueError(f"rate {rate_hz!r} Hz: must be {RATE_MIN_HZ:g} or more")
        self._anchor_us = self._wanted_us(self._clock())
        self._period_ns = 0 if rate_hz is None else max(1, round(1.0e9 / rate_hz))
        self._changed()

    def set_drift(self, dp_m_s: Vec3, dyaw_rad_s: float) -> None:
        """Let a bias of position NED [m/s] and heading [rad/s] grow; zero: it stays as it is. Raises ValueError."""
        _check("drift", *dp_m_s, dyaw_rad_s)
        now_us = self._clock()
        self._drifted_m, self._drifted_rad = self._drifted(now_us)
        self._drift_us = now_us
        self._drift_m_s, self._drift_rad_s = dp_m_s, dyaw_rad_s
        self._changed()

    def set_bad_numbers(self, kind: str | None) -> None:
        """Break what is sent, in one way of BAD_NUMBERS; None: it is whole. The autopilot's own belief stays whole.

        Raises:
            ValueError: there is no such way.
        """
        if kind is not None and kind not in BAD_NUMBERS:
            raise ValueError(f"bad numbers {kind!r}: must be one of {', '.join(BAD_NUMBERS)}")
        self._bad = kind
        self._changed()

    def _changed(self) -> None:
        """Take note that something was set."""
        self.version += 1
        self._last = self._inner = None
        wanted = self._delay_us > 0 or self._period_ns > 0
        if wanted and not self.recording:
            self._history = deque(self._source.believed(k) for k in range(self._age_steps + 1))
        elif not wanted:
            self._history.clear()
        self.recording = wanted
        drifts = self._drifted_m != _ZERO or self._drifted_rad != 0.0
        drifts = drifts or self._drift_m_s != _ZERO or self._drift_rad_s != 0.0
        jumped = self._jumped != (_ZERO, _ZERO, 0.0)
        wrong = self._frozen is not None or self._lost is not None or self._bad is not None
        self.active = self._walk is not None or wanted or drifts or jumped or wrong

    # What there is to know

    @property
    def available(self) -> bool:
        """Whether there is a state; not so during an outage."""
        return self._lost is None

    @property
    def stamp_shift_us(self) -> int:
        """What is added to the stamps of messages that are not stamped with the estimate's own."""
        return -STAMP_BACK_US if self._bad == "stamp_back" else 0

    def take_resets(self) -> list[Reset]:
        """Return the resets since the last call, oldest first: for the autopilot, which moves its setpoints along."""
        resets, self._resets = self._resets, []
        return resets

    def estimate(self, steps_ahead: int = 0) -> Estimate:
        """Return what is believed now, or in so many steps (at most the sample's age) if nothing is set until then.

        During an outage it is the last one before it.
        """
        now_us = self._clock() + steps_ahead * self._dt_us
        if self._last is None or self._last_us != now_us:
            self._last = self._broken(self._complete(steps_ahead))
            self._last_us = now_us
        return self._last

    def inner(self, rigid: RigidState) -> RigidState:
        """Return what the autopilot's own modes believe while this is the truth; rates and rotors are the true ones."""
        if self._inner is None or self._inner_of is not rigid:
            pose = self._pose(rigid)
            self._inner = RigidState(pose.p, pose.v, pose.q, rigid.w, rigid.rotor_n)
            self._inner_of = rigid
        return self._inner

    def in_truth(self, setpoint: Setpoint) -> Setpoint:
        """Return a setpoint for loops that know the true heading: an attitude is meant as the vehicle believes it."""
        if setpoint.mode != ATTITUDE:
            return setpoint
        now_us = self._clock()
        yaw = self._bias(now_us, now_us).yaw if self._frozen is None else self._frozen[2]
        yaw += self._jumped.dyaw_rad
        return setpoint if yaw == 0.0 else setpoint._replace(q=multiply(from_yaw(-yaw), setpoint.q))

    def record(self) -> None:
        """Keep the sample of the step that has just been done, and no more than can still be wanted."""
        history = self._history
        history.append(self._source.believed(self._age_steps))
        wanted_us = self._wanted_us(self._clock())
        while len(history) > 1 and history[0].t_us < wanted_us:
            history.popleft()

    # How it comes about

    def _wanted_us(self, now_us: int) -> int:
        """Return the stamp of the sample that is the newest at a time."""
        stamp_us = max(now_us - self._age_steps * self._dt_us - self._delay_us, self._floor_us)
        if self._period_ns > 0:
            periods = max(0, 1000 * (stamp_us - self._anchor_us) // self._period_ns)
            stamp_us = self._anchor_us - (-periods * self._period_ns // (1000 * self._dt_us)) * self._dt_us
        return stamp_us

    def _sample(self, steps_ahead: int) -> Estimate:
        """Return the sample that is the newest in so many steps, delay and rate considered."""
        if not self.recording:
            return self._source.believed(steps_ahead)
        history = self._history
        wanted_us = self._wanted_us(self._clock() + steps_ahead * self._dt_us)
        index = (wanted_us - history[0].t_us) // self._dt_us
        return history[min(max(index, 0), len(history) - 1)]

    def _drifted(self, now_us: int) -> tuple[Vec3, float]:
        """Return how far position and heading have drifted by now."""
        passed_s = (now_us - self._drift_us) * 1.0e-6
        a, b = self._drifted_m, self._drift_m_s
        drifted = (a[0] + passed_s * b[0], a[1] + passed_s * b[1], a[2] + passed_s * b[2])
        return drifted, self._drifted_rad + passed_s * self._drift_rad_s

    def _bias(self, sample_us: int, now_us: int) -> Bias:
        """Return walk (of a sample's time) and drift (of the time at which it is believed)."""
        drifted_m, drifted_rad = self._drifted(now_us)
        if self._walk is None:
            return Bias(drifted_m, _ZERO, drifted_rad, _ZERO)
        walk = self._walk.at(sample_us)
        return Bias(_sum(walk.p, drifted_m), walk.v, walk.yaw + drifted_rad, walk.w)

    def _with_bias(self, sample: Estimate, now_us: int) -> Estimate:
        """Return a sample with walk and drift."""
        bias = self._bias(sample.t_us, now_us)
        return Estimate(
            sample.t_us, _sum(sample.p, bias.p), _sum(sample.v, bias.v), _turned(sample.q, bias.yaw),
            _sum(sample.w, bias.w),
        )  # fmt: skip

    def _unmoved(self) -> tuple[Estimate, _Pose, float]:
        """Return the estimate, the autopilot's pose and the heading error of now, before resets."""
        now_us = self._clock()
        pose = self._pose_with_bias(self._rigid(), now_us)
        return self._with_bias(self._sample(0), now_us), pose, self._bias(now_us, now_us).yaw

    def _complete(self, steps_ahead: int) -> Estimate:
        """Return the estimate before it is broken."""
        if self._lost is not None:
            return self._lost[0]
        sample = self._sample(steps_ahead)
        if self._frozen is None:
            believed = self._with_bias(sample, self._clock() + steps_ahead * self._dt_us)
        else:
            believed = self._frozen[0]
        jump = self._jumped
        p, v, q = _sum(believed.p, jump.dp_m), _sum(believed.v, jump.dv_m_s), _turned(believed.q, jump.dyaw_rad)
        return Estimate(sample.t_us, p, v, q, believed.w)

    def _pose_with_bias(self, rigid: RigidState, now_us: int) -> _Pose:
        """Return the autopilot's pose with walk and drift."""
        bias = self._bias(now_us, now_us)
        return _Pose(_sum(rigid.p, bias.p), _sum(rigid.v, bias.v), _turned(rigid.q, bias.yaw))

    def _pose(self, rigid: RigidState) -> _Pose:
        """Return the autopilot's pose."""
        if self._lost is not None:
            return self._lost[1]
        pose = self._pose_with_bias(rigid, self._clock()) if self._frozen is None else self._frozen[1]
        jump = self._jumped
        return _Pose(_sum(pose.p, jump.dp_m), _sum(pose.v, jump.dv_m_s), _turned(pose.q, jump.dyaw_rad))

    def _broken(self, whole: Estimate) -> Estimate:
        """Return the estimate as it is sent."""
        if self._bad == "nan":
            return Estimate(whole.t_us, _NO_NUMBERS, _NO_NUMBERS, _NO_ATTITUDE, _NO_NUMBERS)
        if self._bad == "zero_quaternion":
            return whole._replace(q=(0.0, 0.0, 0.0, 0.0))
        if self._bad == "stamp_back":
            return whole._replace(t_us=max(0, whole.t_us - STAMP_BACK_US))
        return whole


def _sum(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _turned(q: Quat, yaw: float) -> Quat:
    """Return an attitude turned about the inertial down axis."""
    return multiply(from_yaw(yaw), q) if yaw != 0.0 else q


def _check(what: str, *numbers: float) -> None:
    """Raise ValueError unless all numbers are finite."""
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{what}: {', '.join(map(repr, numbers))}: must be finite numbers")
