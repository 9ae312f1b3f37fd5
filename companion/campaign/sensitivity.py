"""Which of the varied quantities matter for an outcome: Spearman's rank correlations, plain and partial.

Rank correlation asks for nothing but monotony, and has no parameters. The partial one is what is left when the linear
effect of all other variables on the ranks is taken out: it separates variables that the draws happened to correlate.
A variable that matters by its size whatever its sign (a wind to either side) shows nothing monotone, so its distance
from the median is looked at as well and the stronger of the two is reported.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.campaign.study import Study
from companion.campaign.variables import NAMES

FloatArray = NDArray[np.float64]
FLIGHTS_MIN = 20
"""With fewer a correlation says little."""


class Sensitivity(NamedTuple):
    """How an outcome goes with one variable."""

    variable: str
    by_distance: bool
    """Whether it is the distance from the variable's median that the outcome goes with."""
    spearman: float
    """-1 to 1."""
    partial: float
    """The same with the effect of the other variables taken out."""
    noise: float
    """Correlations below this are likely to be chance (two standard deviations)."""


def ranking(study: Study, table: Any, outcome: str) -> list[Sensitivity]:
    """The varied numbers, the most important first; empty where nothing can be said."""
    y = np.asarray(table[outcome].to_numpy(), dtype=np.float64)
    usable = np.isfinite(y)
    y = y[usable]
    if len(y) < FLIGHTS_MIN or float(np.ptp(y)) == 0.0:
        return []
    target = _ranks(y)
    columns, names = [], []
    for name in study.varied:
        if name in NAMES:
            continue
        x = np.asarray(table[name].to_numpy(), dtype=np.float64)[usable]
        if float(np.ptp(x)) == 0.0:
            continue
        straight, distance = _ranks(x), _ranks(np.abs(x - np.median(x)))
        by_distance = bool(abs(_correlation(distance, target)) > abs(_correlation(straight, target)) + 0.05)
        columns.append(distance if by_distance else straight)
        names.append((name, by_distance))
    noise = 2.0 / math.sqrt(len(y) - 1)
    found = []
    for index, (name, by_distance) in enumerate(names):
        others = [column for i, column in enumerate(columns) if i != index]
        partial = _correlation(_without(columns[index], others), _without(target, others))
        found.append(Sensitivity(name, by_distance, _correlation(columns[index], target), partial, noise))
    return sorted(found, key=lambda s: -abs(s.partial))


def _ranks(x: FloatArray) -> FloatArray:
    """Ranks from 1, ties at their mean."""
    from scipy.stats import rankdata

    return np.asarray(rankdata(x), dtype=np.float64)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / scale if scale > 1e-12 * len(a) else 0.0


def _without(x: FloatArray, others: list[FloatArray]) -> FloatArray:
    """What the others do not explain of x, linearly."""
    basis = np.column_stack([np.ones(len(x)), *others])
    solution = np.linalg.lstsq(basis, x, rcond=None)[0]
    return np.asarray(x - basis @ solution)
