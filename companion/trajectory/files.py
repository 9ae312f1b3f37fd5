"""Trajectories from the files of other programs: from what a file holds to a shape, with the fit's own figures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import hypot
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError, RefusedError
from companion.frames import Frame, GeoPoint, ned_from_geo
from companion.trajectory.anchored import Origin
from companion.trajectory.earth import APART_MAX_M
from companion.trajectory.fence import Fence, moved
from companion.trajectory.formats import parse
from companion.trajectory.formats.contents import Content, Polynomials, Route, Sampled
from companion.trajectory.formats.reading import Source
from companion.trajectory.piecewise import PathPiece, Piecewise
from companion.trajectory.route import planned
from companion.trajectory.shapes import Heading, Shape
from companion.trajectory.waypoints import HeadingMode, PlanLimits

if TYPE_CHECKING:
    from companion.trajectory.fit import Curve

VELOCITY_SHARE_MAX = 0.5
VELOCITY_FLOOR_M_S = 0.5
"""A file whose velocities differ more from those of its path (rms, share and floor added) contradicts itself."""

RESIDUAL_NOTABLE_M = 0.05
GAP_NOTABLE = 10.0
"""A step in time longer than this many times the usual one is named."""


@dataclass(frozen=True)
class Options:
    """What is asked of a file, beside what it holds."""

    frame: Frame | None = None
    format: str | None = None
    smooth_m: float | None = None
    """Of a sampled file: stay within this of every sample."""
    limits: PlanLimits | None = None
    """Of waypoint files: what the path is planned within."""
    heading: HeadingMode | None = None
    """Of waypoint files."""
    yaw_rad: float = 0.0
    """Heading where the file says none."""
    origin: GeoPoint | None = None
    """Of missions: count coordinates from here."""


class Made(NamedTuple):
    """A shape from a file."""

    shape: Shape
    duration_s: float
    notes: tuple[str, ...]
    origin: Origin | None = None
    fence: Fence | None = None


@lru_cache(maxsize=8)
def shape_of(source: Source, suffix: str, options: Options) -> Made:
    """Return the shape that a file's text defines.

    Args:
        source: the text and the file's name.
        suffix: of the file's name.
        options: how to take it.

    Raises:
        InputError: something is wrong with the file; with line and reason.
        RefusedError: waypoints between which the limits leave no way.

    """
    content: Content = parse(source, frame=options.frame, name=options.format, suffix=suffix)
    if isinstance(content, Polynomials):
        return Made(content.shape, content.shape.own_duration_s, content.notes)
    if isinstance(content, Sampled):
        return _fitted(source, content, options)
    return _routed(source, content, options)


def _routed(source: Source, route: Route, options: Options) -> Made:
    if options.limits is None:
        raise InputError(
            f"{source.name}: holds points to plan a path through, which takes a vehicle's limits: name a vehicle"
        )
    if options.origin is not None:
        route = _counted_from(source, route, options.origin)
    try:
        shape, notes = planned(route, options.limits, options.heading, options.yaw_rad)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from None
    except RefusedError as error:
        raise RefusedError(f"{source.name}: {error}") from None
    origin = None if route.origin is None else Origin(route.origin, route.altitude_above_home)
    return Made(shape, shape.own_duration_s, route.notes + notes, origin, route.fence)


def _counted_from(source: Source, route: Route, origin: GeoPoint) -> Route:
    """Return the route with its coordinates counted from another place nearby."""
    if route.origin is None:
        raise InputError(f"{source.name}: origin is for missions, whose points are places on the Earth")
    north, east, down = ned_from_geo(route.origin, origin)
    if hypot(north, east) > APART_MAX_M:
        raise InputError(
            f"{source.name}: origin is {hypot(north, east) / 1e3:.1f} km from the mission, at most"
            f" {APART_MAX_M / 1e3:g} km can be"
        )
    shift = (north, east, 0.0 if route.altitude_above_home else down)
    legs = tuple(
        leg._replace(
            waypoint=replace(
                leg.waypoint,
                p_m=(leg.waypoint.p_m[0] + shift[0], leg.waypoint.p_m[1] + shift[1], leg.waypoint.p_m[2] + shift[2]),
            )
        )
        for leg in route.legs
    )
    fence = None if route.fence is None else moved(route.fence, shift[:2])
    return replace(route, legs=legs, origin=origin, fence=fence)


def _fitted(source: Source, samples: Sampled, options: Options) -> Made:
    """Return the spline along samples."""
    # Imported late: it needs scipy, which takes longer to import than most commands run.
    from companion.trajectory.fit import UnfitError, fit

    try:
        path = fit(samples.t_s, samples.p_m, distance_max=options.smooth_m, rest=_rests(samples))
        yaw = None if samples.yaw_rad is None else fit(samples.t_s, samples.yaw_rad[:, None])
    except UnfitError as error:
        raise InputError(f"{source.name}: {error}") from None
    if not all(np.isfinite(piece).all() for curve in (path, yaw) if curve is not None for piece in curve.pieces):
        raise InputError(f"{source.name}: no spline goes along its samples; are their times or positions mixed up?")
    shape = Piecewise(
        heading=Heading(options.yaw_rad),
        knots_s=path.knots_s,
        pieces=tuple(PathPiece(*axes) for axes in path.pieces),
        yaw_knots_s=() if yaw is None else yaw.knots_s,
        yaw_pieces=() if yaw is None else tuple(piece[0] for piece in yaw.pieces),
    )
    notes = [_fit_note(samples, path), *_gap_notes(samples), *_derivative_notes(source, samples, path)]
    return Made(shape, shape.own_duration_s, (*notes, *samples.notes))


def _rests(samples: Sampled) -> tuple[bool | None, bool | None]:
    """Whether it is at rest at its ends, where the file's velocities and accelerations say it."""
    from companion.trajectory.fit import REST_ACCELERATION, REST_SPEED

    if samples.v_m_s is None or samples.a_m_s2 is None:
        return None, None
    slow = [
        float(np.linalg.norm(samples.v_m_s[i])) < REST_SPEED
        and float(np.linalg.norm(samples.a_m_s2[i])) < REST_ACCELERATION
        for i in (0, -1)
    ]
    return slow[0], slow[1]


def _fit_note(samples: Sampled, path: Curve) -> str:
    count = len(samples.t_s)
    rate_hz = (count - 1) / float(samples.t_s[-1] - samples.t_s[0])
    begin = f"{count} samples at {rate_hz:.4g} Hz became a spline of degree 9 with {len(path.pieces)} pieces"
    if path.through:
        return (
            f"{begin}, through every sample; samples that it does not see it misses by up to {path.left_out:.2g} m:"
            " they are far apart for how it moves"
        )
    note = (
        f"{begin}; it stays within {path.largest:.2g} m of the samples ({path.rms:.2g} m rms, largest at"
        f" {path.largest_at_s:.2f} s)"
    )
    return f"{note}: they are noisy, or too far apart" if path.largest > RESIDUAL_NOTABLE_M else note


def _gap_notes(samples: Sampled) -> list[str]:
    steps = np.diff(samples.t_s)
    widest = int(np.argmax(steps))
    if steps[widest] <= GAP_NOTABLE * float(np.median(steps)):
        return []
    between = f"lines {samples.lines[widest]} and {samples.lines[widest + 1]}"
    return [
        f"between {between} {steps[widest]:.3g} s pass, usually {float(np.median(steps)):.3g} s: what happens there is"
        " a guess"
    ]


def _derivative_notes(source: Source, samples: Sampled, path: Curve) -> list[str]:
    """Compare the velocities and accelerations of the file with those of the path; refuse what contradicts itself."""
    local = samples.t_s - samples.t_s[0]
    notes = []
    if samples.v_m_s is not None:
        own: NDArray[np.float64] = path.spline(local, 1)
        rms, largest, at = _apart(samples.v_m_s, own)
        scale = float(np.sqrt((own**2).sum(axis=1).mean()))
        if rms > VELOCITY_SHARE_MAX * scale + VELOCITY_FLOOR_M_S:
            raise _contradiction(source, samples, own, at)
        notes.append(f"the file's velocities differ from the path's by {rms:.2g} m/s rms, at most {largest:.2g} m/s")
    if samples.a_m_s2 is not None:
        rms, largest, _ = _apart(samples.a_m_s2, path.spline(local, 2))
        notes.append(
            f"the file's accelerations differ from the path's by {rms:.2g} m/s^2 rms, at most {largest:.2g} m/s^2"
        )
    return notes


def _apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, float, int]:
    """Return the root mean square and the largest distance of two rows of vectors, and where it is largest."""
    apart = np.sqrt(((a - b) ** 2).sum(axis=1))
    at = int(np.argmax(apart))
    return float(np.sqrt((apart**2).mean())), float(apart[at]), at


def _contradiction(source: Source, samples: Sampled, own: NDArray[np.float64], at: int) -> InputError:
    """Say how velocities contradict positions, with the likely cause."""
    given = samples.v_m_s
    assert given is not None
    power = float((own**2).sum())
    factor = float((given * own).sum()) / power if power > 0.0 else 0.0
    turned = [
        axis for i, axis in enumerate(("north", "east", "down")) if float((given[:, i] * own[:, i]).sum()) < -1e-9
    ]
    if factor > 5.0 or 0.0 < factor < 0.2:
        cause = f"they are about {factor:.3g} times as large: time, position or velocity is in another unit"
    elif turned:
        cause = f"they point the other way along {' and '.join(turned)}: the frame is another one"
    else:
        cause = "they are in another frame or unit, or of another path"
    in_file, by_path = float(np.linalg.norm(given[at])), float(np.linalg.norm(own[at]))
    return source.fault(
        samples.lines[at],
        f"velocities contradict positions ({in_file:.3g} m/s in the file, {by_path:.3g} m/s by its positions); {cause}",
    )
