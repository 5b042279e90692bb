# SPDX-License-Identifier: Apache-2.0
"""Models of one joint or transmission: least squares with bounds, each checked on held-out parts.

Every model may look at the torque and at the motor's angle and velocity, from a run's first reading
up to now, and never at the link's angle.

Fits come out of sums over cells of time. A cell is a part of a run within one part held out. Its
normal equations are all that a fit needs of it: fits that leave parts out, and the bootstrap's,
cost no further look at the readings.

Uncertainty: fits to cells, or to whole runs where there are five or more, drawn with replacement
(B. Efron, R. Tibshirani, *An Introduction to the Bootstrap*, 1993, section 8.5). Residuals are
correlated for as long as a stroke lasts, so that formulas for independent ones are far too small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.estimation.least_squares import Information
from galen_model.transmission import (
    FREE,
    MOTION_PLAYS,
    TERMS,
    TORQUE_PLAYS,
    JointRun,
    LagNoise,
    Parts,
    Scales,
    design,
    noise_of,
)
from scipy.optimize import nnls

from galen_deflection.measurement.samples import DeflectionError

OURS = "ours"

WINDOW_S = 0.1
"""Of the motor's velocity."""

CELLS = 8
"""In a run, or in a block's share of it a quarter of that."""

_FEWEST_RUNS = 5
_FIT_DRAWS, _SCORE_DRAWS = 200, 2000
_RIDGE = 1e-10
_WORTH_IT = 0.01
_INTERVAL = (0.025, 0.975)


@dataclass(frozen=True)
class CellSums:
    """Of cells (c,): sums of the terms, readings (c,), part and run (c,)."""

    cells: Information
    count: np.ndarray
    part: np.ndarray
    run: np.ndarray

    @classmethod
    def of(cls, runs: Sequence[JointRun], parts: Parts, designs: Sequence[Array]) -> CellSums:
        """Sum up all runs.

        Args:
            runs: the joint's runs, of n readings each.
            parts: the parts that their readings belong to.
            designs: of each run, terms (n, p).

        Returns:
            Sums of c cells.

        """
        blocks, places = [], []
        for number, (run, label, terms) in enumerate(zip(runs, parts.label, designs, strict=True)):
            for part, cell in _cells(label, CELLS if parts.whole_runs else CELLS // 4):
                blocks.append((terms[cell], run.lag[cell]))
                places.append((len(blocks[-1][1]), part, number))
        return cls(Information.of_blocks(blocks), *np.array(places).T)

    def of_parts(self, parts: Sequence[int]) -> np.ndarray:
        """Return the cells of some parts.

        Args:
            parts: numbers of parts.

        Returns:
            Indices (k,) of cells, increasing.

        """
        return np.flatnonzero(np.isin(self.part, parts))

    def cost(self, weights: Array, cells: np.ndarray) -> float:
        """Return the sum of squared residuals over cells.

        Args:
            weights: (p,) of the terms.
            cells: indices (k,) of cells.

        Returns:
            rad^2, none below zero.

        """
        return max(float(self.cells.part(cells).total().cost(weights)), 0.0)


def fit_terms(
    sums: CellSums, cells: np.ndarray, terms: Sequence[str], bounded: bool = True
) -> Array:
    """Fit weights of some terms; those of terms not FREE are none below zero.

    Args:
        sums: of all terms, p = len(TERMS).
        cells: indices (k,) of the cells to fit to.
        terms: names of the terms to fit, of TERMS.
        bounded: whether terms not FREE are kept from negative weights.

    Returns:
        (len(TERMS),), in each term's unit; zero for all but `terms`.

    Raises:
        DeflectionError: the cells hold nothing to fit to.

    """
    columns = [TERMS.index(name) for name in terms]
    whole = sums.cells.part(cells).total()
    information, right = whole.matrix[np.ix_(columns, columns)], whole.right[columns]
    scale = np.sqrt(np.diag(information))
    if not np.any(scale > 0.0):
        raise DeflectionError("there are no readings to fit a joint's lag to")
    # what never moves has no weight; a little is asked of every other weight, so that terms with
    # the same effect share it
    scale = np.where(scale > 0.0, scale, np.inf)
    information = information / np.outer(scale, scale) + _RIDGE * np.eye(len(columns))
    right = right / scale
    free = np.array([name in FREE or not bounded for name in terms], dtype=bool)
    weights = np.zeros(len(TERMS))
    weights[columns] = _solved(information, right, free) / scale
    return weights


def _solved(information: Array, right: Array, free: np.ndarray) -> Array:
    """Weights (k,) that minimise w^T N w - 2 b^T w, those not free none below zero.

    For given others the free ones follow, w_f = N_ff^-1 (b_f - N_fb w_b); the rest is a
    non-negative least squares problem in the others alone.
    """
    bound = ~free
    weights = np.zeros(len(right))
    if bound.any():
        n_ff, n_fb = information[np.ix_(free, free)], information[np.ix_(free, bound)]
        follow = np.linalg.solve(n_ff, np.column_stack([n_fb, right[free]]))
        left = information[np.ix_(bound, bound)] - n_fb.T @ follow[:, :-1]
        wanted = right[bound] - n_fb.T @ follow[:, -1]
        value, vectors = np.linalg.eigh(left)
        root = np.sqrt(np.maximum(value, _RIDGE))
        weights[bound] = nnls(root[:, None] * vectors.T, vectors.T @ wanted / root)[0]
    rest = right[free] - information[np.ix_(free, bound)] @ weights[bound]
    weights[free] = np.linalg.solve(information[np.ix_(free, free)], rest)
    return weights


def _bootstrap(sums: CellSums, terms: Sequence[str], bounded: bool = True) -> Array:
    """Weights (draws, len(TERMS)) of fits to cells or runs drawn with replacement."""
    random = np.random.default_rng(0)
    units = [np.array([cell]) for cell in range(len(sums.count))]
    if len(np.unique(sums.run)) >= _FEWEST_RUNS:
        units = [np.flatnonzero(sums.run == run) for run in np.unique(sums.run)]
    draws = [random.integers(len(units), size=len(units)) for _ in range(_FIT_DRAWS)]
    drawn = [np.concatenate([units[k] for k in draw]) for draw in draws]
    return np.stack([fit_terms(sums, cells, terms, bounded) for cells in drawn])


def _cells(label: np.ndarray, count: int) -> list[tuple[int, slice]]:
    bounds = [0, *(np.flatnonzero(np.diff(label)) + 1).tolist(), len(label)]
    return [
        (int(label[first]), slice(int(rows[0]), int(rows[-1]) + 1))
        for first, last in pairwise(bounds)
        for rows in np.array_split(np.arange(first, last), count)
        if len(rows)
    ]


# Physical models: which terms each has, and how fine its thresholds are


def _plays(names: Sequence[str], grids: Sequence[Sequence[int]]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(names[k] for k in grid) for grid in grids)


_TORQUE = _plays(TORQUE_PLAYS, ((3,), (1, 4), (0, 2, 4, 6), range(len(TORQUE_PLAYS))))
_MOTION = _plays(MOTION_PLAYS, ((4,), (2, 4), (0, 2, 4, 6), range(len(MOTION_PLAYS))))

CONSTANT, COMMON_TERMS = "constant", "common terms"
"""The mean lag; offset and the terms that all others have. Neither is a model of a torque."""

FORMS: dict[str, tuple[tuple[str, ...], ...]] = {
    CONSTANT: ((),),
    COMMON_TERMS: ((),),
    "linear": (("spring",),),
    "direction": (("spring", "direction"),),
    "torque plays": tuple(("spring", *plays) for plays in _TORQUE),
    "lost motion": tuple(("spring", *plays) for plays in _MOTION),
    "both plays": tuple(("spring", *a, *b) for a, b in zip(_TORQUE, _MOTION, strict=True)),
}
"""A model's terms beside the offset and the common ones, grids of plays to choose from; simpler
ones first."""


def choose(
    sums: CellSums, parts: Sequence[int], common: Sequence[str]
) -> tuple[dict[str, tuple[tuple[str, ...], tuple[str, ...]]], str]:
    """Return the terms that hold-outs among these parts choose for each form, and the best form.

    Args:
        sums: of all terms.
        parts: numbers of the parts to fit to and to hold out in turn.
        common: terms that all forms but the constant have.

    Returns:
        By form, its terms, and those of its next best grid (the same where it has only one); the
        name of the best form that has a spring.

    Raises:
        DeflectionError: there is nothing to fit to.

    """
    found, left = {}, {}
    for name, grids in FORMS.items():
        if name == COMMON_TERMS and not common:
            continue
        given = ("offset", *(common if name != CONSTANT else ()))
        candidates = [given + grid for grid in grids]
        costs = [_held_out_cost(sums, parts, terms) for terms in candidates]
        at = _first_good(costs)
        others = [k for k in range(len(costs)) if k != at] or [at]
        next_best = candidates[min(others, key=costs.__getitem__)]
        found[name] = candidates[at], next_best
        left[name] = costs[at]
    physical = [name for name in found if name not in (CONSTANT, COMMON_TERMS)]
    return found, physical[_first_good([left[name] for name in physical])]


def _held_out_cost(sums: CellSums, parts: Sequence[int], terms: Sequence[str]) -> float:
    """Mean square (rad^2) of the residuals of each part by a fit to the others of `parts`."""
    square, count = 0.0, 0
    for part in parts:
        weights = fit_terms(sums, sums.of_parts([k for k in parts if k != part]), terms)
        cells = sums.of_parts([part])
        square += sums.cost(weights, cells)
        count += int(sums.count[cells].sum())
    return square / count


def _first_good(costs: Sequence[float]) -> int:
    """Return the first whose cost is the least, or within a hundredth of it."""
    array: Array = np.asarray(costs)
    return int(np.argmax(array <= (1.0 + _WORTH_IT) * array.min()))


# All of them on held-out parts


class JointScore(NamedTuple):
    """A model's errors on what it has not seen: rad, of the parts (p,), and of all.

    interval: 95 %, of `rmse`, parts drawn with replacement. share: rmse over the lag's standard
    deviation.
    """

    rmse: float
    interval: tuple[float, float]
    share: float
    by_part: Array


@dataclass(frozen=True)
class Comparison:
    """Scores by model, in the order of the table, each on parts that it was not fitted to.

    common: terms that all models but the constant have. lag_std: of all readings, rad.
    predictions: by model, lags (n,) of each run. chosen: by part, the form that was `ours`.
    """

    runs: list[JointRun]
    parts: Parts
    common: tuple[str, ...]
    noise: LagNoise
    lag_std: float
    predictions: dict[str, list[Array]]
    scores: dict[str, JointScore]
    chosen: tuple[str, ...]


def compare(
    runs: list[JointRun],
    parts: Parts,
    common: tuple[str, ...] = (),
    on_part: Callable[[], object] = lambda: None,
) -> Comparison:
    """Fit and check all models, each on parts that it was not fitted to.

    Args:
        runs: the joint's runs.
        parts: the parts that their readings belong to.
        common: terms that all models but the constant have, of COMMON.
        on_part: called after each part.

    Returns:
        Predictions and scores by model.

    Raises:
        DeflectionError: there is nothing to fit to.

    """
    predictions: dict[str, list[Array]] = {}
    chosen = []
    count = len(parts.names)
    for part in range(count):
        trained_on = parts.trained_on(part)
        scales = Scales.of(runs, parts.rows(trained_on), WINDOW_S)
        designs = [design(run, scales) for run in runs]
        sums = CellSums.of(runs, parts, designs)
        forms, best = choose(sums, trained_on, common)
        chosen.append(best)
        for name, (terms, _) in {**forms, OURS: forms[best]}.items():
            weights = fit_terms(sums, sums.of_parts(trained_on), terms)
            kept = predictions.setdefault(name, [np.full(len(run), np.nan) for run in runs])
            for lag, some, columns in zip(kept, parts.rows([part]), designs, strict=True):
                lag[some] = (columns @ weights)[some]
        on_part()
    lag_std = float(np.std(np.concatenate([run.lag for run in runs])))
    readings = np.array([sum(some.sum() for some in parts.rows([k])) for k in range(count)])
    draws = np.random.default_rng(0).integers(count, size=(_SCORE_DRAWS, count))
    scores = {}
    for name, lags in predictions.items():
        square = np.array([_square(runs, lags, parts.rows([part])) for part in range(count)])
        rmse = float(np.sqrt(square.sum() / readings.sum()))
        drawn = np.sqrt(square[draws].sum(axis=1) / readings[draws].sum(axis=1))
        interval = _interval(drawn)
        scores[name] = JointScore(rmse, interval, rmse / lag_std, np.sqrt(square / readings))
    return Comparison(
        runs, parts, common, noise_of(runs), lag_std, predictions, scores,
        tuple(chosen),
    )  # fmt: skip


def _square(runs: Sequence[JointRun], lags: Sequence[Array], rows: Sequence[np.ndarray]) -> float:
    """Sum of squared errors over some rows, rad^2."""
    return sum(
        float(np.sum((lag[some] - run.lag[some]) ** 2))
        for run, lag, some in zip(runs, lags, rows, strict=True)
    )


def _interval(drawn: Array) -> tuple[float, float]:
    low, high = np.quantile(drawn, _INTERVAL)
    return float(low), float(high)


# How a joint deflects, by a form fitted to all of its readings

UNITS = {
    "compliance_first": "rad/(N.m)",
    "compliance": "rad/(N.m)",
    "direction": "rad",
    "torque_loop": "rad",
    "lost_motion": "rad",
    "gear_error": "1",
    "delay": "s",
    "offset": "rad",
}
_BOUNDED = ("compliance_first", "compliance", "torque_loop", "lost_motion")


class Estimate(NamedTuple):
    """A value with its standard deviation and 95 % interval.

    Of the bootstrap; enlarged by the difference of the form's next best grid of thresholds, since
    a form is never exactly the joint's.
    """

    value: float
    std: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class JointParameters:
    """What a form gives, by the names of UNITS.

    plain: compliance, direction's part and delay of a least squares fit without bounds, for which
    a negative compliance is no error.
    """

    form: str
    estimates: dict[str, Estimate]
    plain: dict[str, Estimate]

    @property
    def stiffness(self) -> Estimate | None:
        """Once everything slides, N.m/rad; None if it can't be distinguished from a rigid joint."""
        found = self.estimates["compliance"]
        low, high = found.interval
        if low <= 0.0:
            return None
        value = 1.0 / found.value
        return Estimate(value, found.std * value**2, (1.0 / high, 1.0 / low))


def estimate(comparison: Comparison, form: str | None = None) -> JointParameters:
    """Fit a form to all readings.

    Args:
        comparison: runs, parts and common terms.
        form: one of FORMS, COMMON_TERMS only where there are some; None: the one that hold-outs
            choose among all parts.

    Returns:
        Estimates by the names of UNITS, with standard deviations of the bootstrap.

    Raises:
        DeflectionError: there is nothing to fit to.

    """
    runs, parts, common = comparison.runs, comparison.parts, comparison.common
    every = list(range(len(parts.names)))
    scales = Scales.of(runs, parts.rows(every), WINDOW_S)
    sums = CellSums.of(runs, parts, [design(run, scales) for run in runs])
    forms, best = choose(sums, every, common)
    form = form or best
    terms, next_best = forms[form]
    plain_terms = ("offset", *common, "spring", "direction")
    plain = _estimates(sums, scales, plain_terms, bounded=False)
    wanted = ("compliance", "direction", *(("delay",) * ("delay" in common)))
    return JointParameters(
        form,
        _estimates(sums, scales, terms, bounded=True, otherwise=next_best),
        {name: plain[name] for name in wanted},
    )


def _estimates(
    sums: CellSums,
    scales: Scales,
    terms: tuple[str, ...],
    *,
    bounded: bool,
    otherwise: tuple[str, ...] | None = None,
) -> dict[str, Estimate]:
    every = np.arange(len(sums.count))
    values = _derived(fit_terms(sums, every, terms, bounded)[None], scales)
    others = _derived(fit_terms(sums, every, otherwise or terms, bounded)[None], scales)
    drawn = _derived(_bootstrap(sums, terms, bounded), scales)
    found = {}
    for name in UNITS:
        low, high = _interval(drawn[name])
        value = float(values[name][0])
        apart = abs(float(others[name][0]) - value)
        std = float(np.hypot(np.std(drawn[name], ddof=1), apart))
        # each side of the interval grows by two of these standard deviations, as squares add up
        below, above = (
            np.hypot(max(side, 0.0), 2.0 * apart) for side in (value - low, high - value)
        )
        least = 0.0 if bounded and name in _BOUNDED else -np.inf
        bounds = max(value - float(below), least), value + float(above)
        found[name] = Estimate(value, std, bounds)
    return found


def _derived(weights: Array, scales: Scales) -> dict[str, Array]:
    """From weights (k, len(TERMS))."""
    column = {name: weights[:, TERMS.index(name)] for name in TERMS}
    torque = np.stack([column[name] for name in TORQUE_PLAYS], axis=1)
    motion = np.stack([column[name] for name in MOTION_PLAYS], axis=1)
    return {
        "compliance_first": column["spring"],
        "compliance": column["spring"] + torque.sum(axis=1),
        "direction": column["direction"],
        "torque_loop": 2.0 * torque @ scales.torque_thresholds,
        "lost_motion": 2.0 * motion @ scales.motion_thresholds,
        "gear_error": column["gear"],
        "delay": column["delay"],
        "offset": column["offset"],
    }
