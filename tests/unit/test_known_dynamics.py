"""Each known dynamic of the law can be switched off by itself, and docs/tracking.md shows them all."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from companion.config import Vehicle, load_vehicle
from companion.errors import InputError

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "tracking.md").read_text(encoding="utf-8")


def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("tracking", ROOT / "tools" / "tracking.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def vehicle(**controller: Any) -> Vehicle:
    return load_vehicle("bundled", {"controller": controller})


def test_each_switch_takes_its_own_part_out_of_the_model() -> None:
    whole = vehicle().parameters().model
    assert vehicle(drag_feedforward=False).parameters().model == whole._replace(drag=0.0)
    nothing = (0.0, 0.0, 0.0)
    assert vehicle(rate_lag_inversion=False).parameters().model == whole._replace(
        rate_lag=nothing, rate_integral=nothing
    )
    assert vehicle(thrust_lag_compensation=False).parameters().model == whole._replace(thrust_lag=0.0)
    yaw_off = vehicle(rate_lag_inversion=[True, True, False]).parameters().model
    assert yaw_off.rate_lag == (0.040, 0.040, 0.0)
    assert yaw_off.rate_integral == (0.5, 0.5, 0.0)
    with pytest.raises(InputError, match="rate_lag_inversion"):
        vehicle(rate_lag_inversion=[True, False])


def test_the_drag_pays_on_the_bundled_vehicle() -> None:
    flown = tool().flown
    with_it, without = flown(2.5, {}), flown(2.5, {"drag_feedforward": False})
    assert with_it["position_rms_m"] < 0.006 and without["position_rms_m"] > 20.0 * with_it["position_rms_m"]


def test_every_switch_is_documented_with_the_tools_own_rows() -> None:
    module = tool()
    for name in module.SWITCHES:
        assert f"| {name} |" in TEXT
    for key in (
        "drag_feedforward",
        "rate_lag_inversion",
        "thrust_lag_compensation",
        "prediction",
        "thrust_scale_estimate",
    ):
        assert f"| `{key}` |" in TEXT
