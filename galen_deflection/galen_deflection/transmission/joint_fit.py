"""Least squares with bounds for a joint's terms, out of sums over cells of time.

A cell is a stretch of a run within one part. Its normal equations say all that a fit needs of it:
fits that leave parts out, and the bootstrap's, cost no further look at the readings.

Uncertainty: fits to cells, or to whole runs where there are five or more, drawn with replacement
(B. Efron, R. Tibshirani, *An Introduction to the Bootstrap*, 1993, section 8.5). Residuals hang
together for as long as a stroke lasts, so that formulas for independent ones say far too little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.transmission.joint_run import JointRun
from galen_model.transmission.parts import Parts
from galen_model.transmission.terms import FREE, MOTION_PLAYS, TERMS, TORQUE_PLAYS
from scipy.optimize import nnls

from galen_deflection.errors import FitError

CELLS = 8
"""In a run, or in a block's share of it a quarter of that."""

_FEWEST_RUNS = 5
_DRAWS = 200
_RIDGE = 1e-10
_WORTH_IT = 0.01


@dataclass(frozen=True)
class CellSums:
    """Of cells (c,): N (c, p, p), b (c, p), y^T y (c,), readings (c,), part and run (c,)."""

    information: Array
    right: Array
    square: Array
    count: np.ndarray
    part: np.ndarray
    run: np.ndarray

    @classmethod
    def of(cls, runs: Sequence[JointRun], parts: Parts, designs: Sequence[Array]) -> CellSums:
        """Of all runs, from their terms (n, p)."""
        rows = []
        for number, (run, label, terms) in enumerate(zip(runs, parts.label, designs, strict=True)):
            lag = run.lag
            for part, cell in _cells(label, CELLS if parts.whole_runs else CELLS // 4):
                x, y = terms[cell], lag[cell]
                # not by BLAS: its threads wait for a busy machine's cores
                information = np.einsum("rp,rq->pq", x, x)
                right = np.einsum("rp,r->p", x, y)
                rows.append((information, right, y @ y, len(y), part, number))
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))

    def of_parts(self, parts: Sequence[int]) -> np.ndarray:
        """The cells (k,) of some parts."""
        return np.flatnonzero(np.isin(self.part, parts))

    def cost(self, weights: Array, cells: np.ndarray) -> float:
        """Sum of squared residuals (rad^2) of weights (p,) over cells."""
        fitted = weights @ self.information[cells].sum(axis=0) @ weights
        square = self.square[cells].sum() - 2.0 * self.right[cells].sum(axis=0) @ weights + fitted
        return max(float(square), 0.0)

    def units(self, runs: bool) -> list[np.ndarray]:
        """The cells that the bootstrap draws together."""
        if runs and len(np.unique(self.run)) >= _FEWEST_RUNS:
            return [np.flatnonzero(self.run == run) for run in np.unique(self.run)]
        return [np.array([cell]) for cell in range(len(self.count))]


def fit_terms(
    sums: CellSums, cells: np.ndarray, terms: Sequence[str], bounded: bool = True
) -> Array:
    """Weights (len(TERMS),), zero for all but `terms`; those not FREE are none below zero.

    `bounded` off lets all of them be. Raises FitError if the cells hold nothing to fit to.
    """
    columns = [TERMS.index(name) for name in terms]
    information = sums.information[cells].sum(axis=0)[np.ix_(columns, columns)]
    right = sums.right[cells].sum(axis=0)[columns]
    scale = np.sqrt(np.diag(information))
    if not np.any(scale > 0.0):
        raise FitError("there are no readings to fit a joint's lag to")
    # what never moves has no weight; a little is asked of every other weight, so that terms that
    # say the same share what they say
    scale = np.where(scale > 0.0, scale, np.inf)
    information = information / np.outer(scale, scale) + _RIDGE * np.eye(len(columns))
    right = right / scale
    free = np.array([name in FREE or not bounded for name in terms], dtype=bool)
    weights = np.zeros(len(TERMS))
    weights[columns] = _solved(information, right, free) / scale
    return weights


def _solved(information: Array, right: Array, free: np.ndarray) -> Array:
    """Weights (k,) that minimise w^T N w - 2 b^T w, those not free none below zero.

    For given others the free ones follow, w_f = N_ff^-1 (b_f - N_fb w_b); what is left is a
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


def bootstrap(sums: CellSums, terms: Sequence[str], seed: int, bounded: bool = True) -> Array:
    """Weights (draws, len(TERMS)) of fits to cells or runs drawn with replacement."""
    random = np.random.default_rng(seed)
    units = sums.units(runs=True)
    return np.stack(
        [
            fit_terms(
                sums,
                np.concatenate([units[k] for k in random.integers(len(units), size=len(units))]),
                terms,
                bounded,
            )
            for _ in range(_DRAWS)
        ]
    )


def _cells(label: np.ndarray, count: int) -> list[tuple[int, slice]]:
    bounds = [0, *(np.flatnonzero(np.diff(label)) + 1).tolist(), len(label)]
    return [
        (int(label[first]), slice(int(rows[0]), int(rows[-1]) + 1))
        for first, last in pairwise(bounds)
        for rows in np.array_split(np.arange(first, last), count)
        if len(rows)
    ]


# Physical models: which terms each has, and how fine its thresholds are

_TORQUE_GRIDS = ((3,), (1, 4), (0, 2, 4, 6), tuple(range(len(TORQUE_PLAYS))))
_MOTION_GRIDS = ((4,), (2, 4), (0, 2, 4, 6), tuple(range(len(MOTION_PLAYS))))


@dataclass(frozen=True)
class Form:
    """A model's terms beside the offset and the common ones; grids of plays to choose from."""

    name: str
    summary: str
    terms: tuple[str, ...]
    grids: tuple[tuple[str, ...], ...] = ((),)
    common: bool = True

    def candidates(self, common: Sequence[str]) -> list[tuple[str, ...]]:
        """Sets of terms, the coarsest grid first."""
        given = ("offset", *(common if self.common else ()), *self.terms)
        return [given + grid for grid in self.grids]


def _plays(names: Sequence[str], grids: Sequence[Sequence[int]]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(names[k] for k in grid) for grid in grids)


_TORQUE, _MOTION = _plays(TORQUE_PLAYS, _TORQUE_GRIDS), _plays(MOTION_PLAYS, _MOTION_GRIDS)

FORMS = (
    Form("constant", "the mean lag", (), common=False),
    Form("common terms", "no give: offset and the terms that all others have", ()),
    Form("linear", "a spring: linear in the torque", ("spring",)),
    Form("direction", "a spring and the motor's direction of motion", ("spring", "direction")),
    Form("torque plays", "a spring with friction: plays of the torque", ("spring",), _TORQUE),
    Form("lost motion", "a spring and lost motion: plays of the motor's", ("spring",), _MOTION),
    Form(
        "both plays",
        "a spring, plays of the torque and of the motor's motion",
        ("spring",),
        tuple(a + b for a, b in zip(_TORQUE, _MOTION, strict=True)),
    ),
)
"""In the order in which they are listed, simpler ones first."""

BASELINES = ("constant", "common terms")
"""What is no model of a torque."""


class Chosen(NamedTuple):
    """A form with its terms, and the mean square (rad^2) that they left on parts held out.

    next_best: the terms of its next best grid; the same where it has only one.
    """

    form: Form
    terms: tuple[str, ...]
    held_out: float
    next_best: tuple[str, ...]


def choose(form: Form, sums: CellSums, parts: Sequence[int], common: Sequence[str]) -> Chosen:
    """The terms of a form that hold-outs among these parts choose."""
    candidates = form.candidates(common)
    costs = [held_out_cost(sums, parts, terms) for terms in candidates]
    at = first_good(costs)
    others = [k for k in range(len(costs)) if k != at] or [at]
    return Chosen(form, candidates[at], costs[at], candidates[min(others, key=costs.__getitem__)])


def ours(chosen: Sequence[Chosen]) -> Chosen:
    """Of the forms that know of the torque or of motion, the one that hold-outs choose."""
    physical = [one for one in chosen if one.form.name not in BASELINES]
    return physical[first_good([one.held_out for one in physical])]


def held_out_cost(sums: CellSums, parts: Sequence[int], terms: Sequence[str]) -> float:
    """Mean square (rad^2) of the residuals of each part by a fit to the others of `parts`."""
    square, count = 0.0, 0
    for part in parts:
        weights = fit_terms(sums, sums.of_parts([k for k in parts if k != part]), terms)
        cells = sums.of_parts([part])
        square += sums.cost(weights, cells)
        count += int(sums.count[cells].sum())
    return square / count


def first_good(costs: Sequence[float]) -> int:
    """The first whose cost is the least, or within a hundredth of it."""
    array: Array = np.asarray(costs)
    return int(np.argmax(array <= (1.0 + _WORTH_IT) * array.min()))
