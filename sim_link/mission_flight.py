"""Flying the uploaded mission: which item is current, when it is reached, and what comes next."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from . import missions
from .missions import Item, Plans
from .parameters import Parameters
from .rotation import Vec3

NO_MISSION, NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 1, 2, 3, 4, 5
"""MISSION_STATE"""
_STEPS_PER_ITEM = 4
"""So many steps without flying anywhere end the mission: a plan of nothing but jumps must not hang the vehicle."""


class Kind(Enum):
    """What to do for an item."""

    CLIMB = 0
    """Straight up to the height of `target`."""
    FLY = 1
    LAND = 2
    """Above `target` first, then down."""
    RETURN = 3
    NOTHING = 4
    """The mission is over."""


class Leg(NamedTuple):
    """One piece of the flight."""

    kind: Kind
    target: Vec3
    """Local position NED [m]."""
    yaw: float
    """[rad]; NaN: towards the target."""


class MissionFlight:
    """Goes through the items of the mission that is in force."""

    def __init__(self, parameters: Parameters, plans: Plans) -> None:
        self._parameters = parameters
        self._plans = plans
        self.current = 0
        self.reached: int | None = None
        """The item that was reached last; whoever reports it sets this back to None."""
        self.finished = False
        self.speed_m_s: float | None = None
        """Asked for by DO_CHANGE_SPEED."""
        self.home_here = False
        """Whether a DO_SET_HOME wants home to be here; whoever does it sets this back."""
        self._version = 0
        self._leg: Leg | None = None
        self._hold_until_s: float | None = None
        self._clock_s = 0.0
        self._jumps: dict[int, int] = {}
        self._active = False

    @property
    def items(self) -> list[Item]:
        """The mission in force."""
        self._refresh()
        return self._plans.items[missions.MISSION]

    @property
    def can_run(self) -> bool:
        """Whether there is something to fly."""
        return any(item.is_place or item.command == missions.RETURN for item in self.items)

    @property
    def state(self) -> int:
        """MISSION_STATE."""
        if not self.items:
            return NO_MISSION
        if self.finished:
            return COMPLETE
        if self._active:
            return ACTIVE
        return PAUSED if self.current > 0 else NOT_STARTED

    def select(self, index: int) -> bool:
        """Make an item the current one; False: there is no such item."""
        if not 0 <= index < len(self.items):
            return False
        self.current = index
        self.finished = False
        self._leg = None
        self._hold_until_s = None
        return True

    def enter(self) -> None:
        """Begin, or go on with, the mission; one that is over begins anew."""
        self._active = True
        if self.finished:
            self.select(0)
            self._jumps.clear()
        self._leg = None
        self._hold_until_s = None

    def leave(self) -> None:
        """Another mode is in charge."""
        self._active = False

    def leg(self, p: Vec3, home: Vec3, landed: bool) -> Leg:
        """Give what to fly now from the position p NED [m]."""
        self._refresh()
        if self._leg is None:
            self._leg = self._next_leg(p, home, landed)
        return self._leg

    def update(self, p: Vec3, landed: bool, dt_s: float) -> None:
        """Look whether the present item is done, and go on to the next one."""
        self._clock_s += dt_s
        leg = self._leg
        if leg is None or leg.kind is Kind.NOTHING:
            return
        item = self.items[self.current] if self.current < len(self.items) else None
        if item is None or not self._done(item, leg, p, landed):
            return
        if leg.kind is Kind.CLIMB and item.command != missions.TAKEOFF:
            self._leg = None  # the climb before the first waypoint is no item of its own
            return
        if self._hold_until_s is None:
            self.reached = self.current
            self._hold_until_s = self._clock_s + self._hold_s(item)
        if self._clock_s >= self._hold_until_s:
            self._hold_until_s = None
            self._leg = None
            self._advance()

    def _done(self, item: Item, leg: Leg, p: Vec3, landed: bool) -> bool:
        """Tell whether the vehicle is where the item wants it."""
        if leg.kind is Kind.LAND:
            return landed
        if leg.kind is Kind.RETURN:
            return False
        radius = item.params[1] if item.command == missions.WAYPOINT and item.params[1] > 0.0 else 0.0
        radius = radius or max(self._parameters.number("NAV_ACC_RAD"), 0.05)
        high = abs(p[2] - leg.target[2]) < max(self._parameters.number("NAV_MC_ALT_RAD"), 0.05)
        near = math.hypot(p[0] - leg.target[0], p[1] - leg.target[1]) < radius
        if self._hold_until_s is not None:
            return True  # was there; a gust does not begin the waiting anew
        return high and (near or leg.kind is Kind.CLIMB)

    @staticmethod
    def _hold_s(item: Item) -> float:
        """Give how long to stay."""
        if item.command == missions.LOITER_UNLIMITED:
            return math.inf
        if item.command in (missions.WAYPOINT, missions.LOITER_TIME, missions.DELAY) and item.params[0] > 0.0:
            return item.params[0]
        return 0.0

    def _next_leg(self, p: Vec3, home: Vec3, landed: bool) -> Leg:
        """Find the next item that flies somewhere, and do what stands before it."""
        for _ in range(_STEPS_PER_ITEM * len(self.items) + 1):
            if self.current >= len(self.items) or self.finished:
                break
            item = self.items[self.current]
            leg = self._leg_of(item, p, home, landed)
            if leg is not None:
                return leg
            self.reached = self.current
            self._do(item)
        self.finished = True
        return Leg(Kind.NOTHING, p, math.nan)

    def _leg_of(self, item: Item, p: Vec3, home: Vec3, landed: bool) -> Leg | None:
        """Give the leg of an item; None for one that only does something."""
        if item.command == missions.RETURN:
            return Leg(Kind.RETURN, home, math.nan)
        if item.command == missions.DELAY:
            return Leg(Kind.FLY, p, math.nan)
        if not item.is_place:
            return None
        target = item.position(home)
        if not item.has_place:
            target = (p[0], p[1], target[2])
        yaw = math.radians(item.params[3])
        if item.command == missions.TAKEOFF:
            height = min(target[2], home[2] - self._parameters.number("MIS_TAKEOFF_ALT"))
            return Leg(Kind.CLIMB, (p[0], p[1], min(p[2], height)), yaw)
        if item.command == missions.LAND:
            return Leg(Kind.LAND, target, yaw)
        if landed:
            height = min(target[2], home[2] - self._parameters.number("MIS_TAKEOFF_ALT"))
            return Leg(Kind.CLIMB, (p[0], p[1], height), math.nan)
        return Leg(Kind.FLY, target, yaw)

    def _do(self, item: Item) -> None:
        """Do what an item says that flies nowhere, and go on."""
        if item.command == missions.CHANGE_SPEED:
            self.speed_m_s = item.params[1] if item.params[1] > 0.0 else None
        elif item.command == missions.SET_HOME:
            self.home_here = True
        elif item.command == missions.JUMP:
            left = self._jumps.setdefault(self.current, round(max(item.params[1], 0.0)))
            if left > 0:
                self._jumps[self.current] = left - 1
                self.current = round(item.params[0])
                return
            del self._jumps[self.current]
        self._advance()

    def _advance(self) -> None:
        """Go on to the next item; after the last one the mission is over and the last one stays the current one."""
        if self.current + 1 < len(self.items):
            self.current += 1
        else:
            self.finished = True

    def _refresh(self) -> None:
        """Begin a new mission from its beginning."""
        version = self._plans.versions[missions.MISSION]
        if version == self._version:
            return
        self._version = version
        marked = [k for k, item in enumerate(self._plans.items[missions.MISSION]) if item.current]
        self.current = marked[-1] if marked else 0
        self.reached = None
        self.finished = False
        self.speed_m_s = None
        self._leg = None
        self._hold_until_s = None
        self._jumps.clear()
