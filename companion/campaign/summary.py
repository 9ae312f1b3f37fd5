"""What a campaign amounted to: how many flights converged, percentiles of every measure, and what mattered."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.campaign.outcome import MEASURES
from companion.campaign.sensitivity import ranking
from companion.campaign.store import read_flights
from companion.campaign.study import Study

FloatArray = NDArray[np.float64]
PERCENTS: Final = (5.0, 25.0, 50.0, 75.0, 95.0)


def summarise(study: Study, folder: Path) -> dict[str, Any]:
    """The contents of campaign.json: a function of the flights alone."""
    columns = ["flight", "ended", "converged", "certified", *study.spreads, *MEASURES]
    table = read_flights(folder, columns)
    count = len(table)
    ended = table["ended"].value_counts().to_pylist()
    numbers = {name: table[name].to_numpy() for name in MEASURES}
    converged = table["converged"].to_numpy()
    low, high = _interval(int(converged.sum()), count)
    return {
        "study": study.name,
        "flights": count,
        "seed": study.file.seed,
        "converged": int(converged.sum()),
        "converged_share": float(converged.mean()),
        "converged_share_95": [low, high],
        "certified": int(table["certified"].to_numpy().sum()),
        "ended": {entry["values"]: entry["counts"] for entry in sorted(ended, key=lambda e: str(e["values"]))},
        "worst": worst(table),
        "measures": {name: percentiles(values) for name, values in numbers.items()},
        "sensitivity": {
            name: [found._asdict() for found in ranking(study, table, name)]
            for name in ("converged", "rms_m", "track_rms_m", "settled_at_s", "saturated_s")
        },
    }


def percentiles(values: FloatArray) -> dict[str, float] | None:
    """Percentiles of the finite values; None where there is none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    found = np.percentile(finite, PERCENTS)
    named = {f"p{int(percent)}": float(value) for percent, value in zip(PERCENTS, found, strict=True)}
    return {"count": len(finite), "min": float(finite.min()), **named, "max": float(finite.max())}


def worst(table: Any, count: int = 5) -> list[int]:
    """Flights to look at first: those that did not converge with the largest error, then the largest rms."""
    converged = table["converged"].to_numpy()
    rms = np.nan_to_num(table["rms_m"].to_numpy(), nan=math.inf)
    error = np.nan_to_num(table["error_max_m"].to_numpy(), nan=math.inf)
    order = np.lexsort((-np.where(converged, rms, error), converged))
    return [int(x) for x in table["flight"].to_numpy()[order[:count]]]


def _interval(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    z = 1.959964
    share = successes / count
    middle = (share + z * z / (2.0 * count)) / (1.0 + z * z / count)
    half = z / (1.0 + z * z / count) * math.sqrt(share * (1.0 - share) / count + z * z / (4.0 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)
