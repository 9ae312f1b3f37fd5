"""Flight modes as PX4 packs them."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import modes
from companion.link.modes import Mode


# The packed values as PX4's headers give them.
@pytest.mark.parametrize(
    ("mode", "packed"),
    [
        (modes.OFFBOARD, 393216),
        (modes.POSITION, 196608),
        (modes.ALTITUDE, 131072),
        (modes.STABILIZED, 458752),
        (modes.ACRO, 327680),
        (modes.TAKEOFF, 33816576),
        (modes.HOLD, 50593792),
        (modes.MISSION, 67371008),
        (modes.RETURN, 84148224),
        (modes.LAND, 100925440),
    ],
)
def test_packed_values(mode, packed):
    assert mode.custom_mode == packed
    assert Mode.from_custom_mode(packed) == mode


@settings(deadline=None)
@given(st.integers(0, 255), st.integers(0, 255))
def test_packing_comes_back(main, sub):
    assert Mode.from_custom_mode(Mode(main, sub).custom_mode) == (main, sub)


def test_names():
    assert modes.HOLD.label == "Hold"
    assert Mode.from_custom_mode(393216).label == "Offboard"
    assert Mode(4, 19).label == "mode 4/19"
