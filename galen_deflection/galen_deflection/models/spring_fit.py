# SPDX-License-Identifier: Apache-2.0
"""Fits of the springs: alone (`joint_stiffness`), and with hysteresis (`joint_hysteresis`).

The tip's compliance depends on where the arm stands, and is linear in the springs' compliances 1/k
(`galen_deflection.models.springs` has the proof), so that they come from linear least squares, none
below zero. What the samples do not determine stays near the nominal value and is named.

With hysteresis each of these springs deflects by

    d = c l + sum_i w_i play_i(l),   c, w_i >= 0,

with play operators of its load l (`galen_model.play`). This is linear in c and w for given
thresholds, which lie on a grid of shares of the largest load of each kind of spring. How fine a
grid pays is decided by folds that a fit has not seen.

That is what dry friction does. Other forms are tried as well:

- smooth plays, for friction that deflects before it slides and whose loops shift;
- plays of the platform's six motions, as the springs alone would make them, in place of plays of
  carriages and rods: hysteresis that is not known to sit in one of its parts;
- stops, l - play(l), in place of either. Plays lag behind the load: after a push a residual
  deflection is on its side. With stops it is on the other side, the deflection leads. No joint does
  that, since it would give out more work than it takes; a wrench that is measured with hysteresis
  looks like this.

Of no hysteresis at all and these forms, the first is taken that is within two standard errors of
the best, or within 1 % of its mean square: folds are few, and a memory that the arm does not have
is worse than one of a tenth of the noise that is missed. Then, of its grids, the coarsest within
two standard errors. The model's notes name another form than the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.least_squares import Sums, finished, held_out_cost, solve, sums
from galen_deflection.models.spring_model import (
    HYSTERESIS,
    PLATFORM,
    STIFFNESS,
    STOPS,
    Operator,
    Shape,
    SpringBasis,
    SpringModel,
    SpringRun,
)

GRID = (0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8)
"""Thresholds over the largest load. The finest: what a joint keeps of a small push."""

SMOOTH_GRID = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""The same of smooth operators, which deflect at once, however large their threshold."""

_EVERY: tuple[tuple[Shape, float], ...] = (
    *(("play", share) for share in GRID),
    *(("smooth_play", share) for share in SMOOTH_GRID),
)

GRIDS: dict[Shape, tuple[tuple[float, ...], ...]] = {
    "play": ((0.2,), (0.1, 0.4), (0.05, 0.2, 0.5), (0.05, 0.1, 0.2, 0.4, 0.65), GRID),
    "smooth_play": ((0.8,), (0.2, 0.8), (0.1, 0.4, 1.6), SMOOTH_GRID),
}
"""What is tried after no hysteresis at all; each a part of GRID or SMOOTH_GRID."""

SHAPES: tuple[Shape, ...] = ("play", "smooth_play", "stop", "smooth_stop")
"""What the operators are, most physical first; each in the springs, then in the platform."""

OF_PLATFORM = "hysteresis of the platform as a whole fits better than that of its parts"
LEADS = "the deflection leads the load, as if joints gave out work: is the wrench hysteretic?"

_SMALLEST_LOAD = 1e-12  # of a spring that nothing loads: a threshold must not be zero
_STANDARD_ERRORS = 2.0
_WORTH_IT = 0.01


def fit_stiffness(samples: DeflectionSamples, settings: FitSettings | None = None) -> SpringModel:
    """Fit the springs alone by weighted non-negative least squares.

    Args:
        samples: n samples to fit to.
        settings: which of them count; None: all.

    Returns:
        The model of the kind `joint_stiffness`.

    Raises:
        DeflectionError: the samples can't be fitted to, are without load, or want a spring that
            pushes back.
        ValueError: `settings.use` is for another number of samples.

    """
    basis = SpringBasis(samples.tip_m, arm=samples.arm)
    return finished(STIFFNESS, basis, samples, sums(basis, samples, settings or FitSettings()))


def fit_hysteresis(samples: DeflectionSamples, settings: FitSettings | None = None) -> SpringModel:
    """Fit the springs with hysteresis, of the form that held-out folds choose.

    Args:
        samples: n samples to fit to.
        settings: which of them count; None: all.

    Returns:
        The model of the kind `joint_hysteresis`; its notes name a form other than plays of springs.

    Raises:
        DeflectionError: as of `fit_stiffness`.
        ValueError: `settings.use` is for another number of samples.

    """
    settings = settings or FitSettings()
    grid = _whole_grid(samples, settings)
    totals = sums(grid, samples, settings)
    chosen = _chosen(grid, totals)
    found = solve(chosen.totals.blocks, chosen.basis.parameters)
    wanted = np.flatnonzero(found.free[len(grid.compliances) :]).tolist()
    used = _Candidate.of(grid, totals, [chosen.operators[k] for k in wanted], chosen.shape)
    model = finished(HYSTERESIS, used.basis, samples, used.totals)
    operators = used.basis.operators
    notes = [OF_PLATFORM] * any(operator.place == PLATFORM for operator in operators)
    notes += [LEADS] * any(operator.shape in STOPS.values() for operator in operators)
    return replace(model, notes=tuple(notes))


def _whole_grid(samples: DeflectionSamples, settings: FitSettings) -> SpringBasis:
    """Plays at all thresholds, in all places; the springs alone are the platform's reference."""
    springs = SpringBasis(samples.tip_m, arm=samples.arm)
    reference = solve(sums(springs, samples, settings).blocks, springs.compliances).values
    anywhere = tuple(
        Operator(place, "play", (0.0,) * len(columns)) for place, columns in springs.columns.items()
    )
    run = SpringRun(SpringBasis(samples.tip_m, anywhere, reference, arm=samples.arm))
    largest = np.abs(run.loads(samples.joints, samples.wrench)[3]).max(axis=0)
    operators = []
    for place, columns in springs.columns.items():
        loads = largest[list(columns)]
        if place != PLATFORM:  # springs of a kind are alike
            loads = np.full_like(loads, loads.max())
        loads = np.maximum(loads, _SMALLEST_LOAD)
        operators += [
            Operator(place, shape, tuple((share * loads).tolist())) for shape, share in _EVERY
        ]
    return SpringBasis(samples.tip_m, tuple(operators), reference, arm=samples.arm)


class _Candidate(NamedTuple):
    """A part of the whole grid (`operators`: indices) and what its basis sums up to."""

    operators: Sequence[int]
    shape: Shape
    basis: SpringBasis
    totals: Sums

    @classmethod
    def of(
        cls, grid: SpringBasis, totals: Sums, operators: Sequence[int], shape: Shape
    ) -> _Candidate:
        """From the sums of the whole grid of plays; a stop's design is the load's less the play's.

        That is a combination of columns, so that nothing has to be summed up again.
        """
        given = len(grid.compliances)
        names = [kind.name for kind in grid.kinds]
        combination = np.zeros((given + len(grid.operators), given + len(operators)))
        combination[:given, :given] = np.eye(given)
        for column, k in enumerate(operators, start=given):
            place = grid.operators[k].place
            if shape in STOPS:
                combination[given + k, column] = 1.0
                continue
            combination[given + k, column] = -1.0
            if place == PLATFORM:
                under = grid.under_platform
                combination[under, column] = grid.platform_compliances[under]
            else:
                combination[names.index(place), column] = 1.0
        return cls(operators, shape, grid.part(operators, shape), totals.combined(combination))


def _chosen(grid: SpringBasis, totals: Sums) -> _Candidate:
    """Return the part of the grid that held-out folds choose: first the form, then how fine."""
    springs = tuple(kind.name for kind in grid.kinds)
    places = [springs]
    if PLATFORM in grid.columns:  # the displacements that add up at the tip: contract, section 2
        under = [springs[k] for k in grid.under_platform]
        places.append((*(name for name in springs if name not in under), PLATFORM))
    forms = [[_Candidate.of(grid, totals, [], "play")]]
    for shape, where in product(SHAPES, places):
        forms.append([])
        plays = next(play for play, stop in STOPS.items() if shape in (play, stop))
        for shares in GRIDS[plays]:
            wanted = [(plays, share) for share in shares]
            operators = [
                k
                for k, operator in enumerate(grid.operators)
                if operator.place in where and _EVERY[k % len(_EVERY)] in wanted
            ]
            forms[-1].append(_Candidate.of(grid, totals, operators, shape))
    costs = [np.array([held_out_cost(one.totals, one.basis) for one in form]) for form in forms]
    best = np.array([cost[np.argmin(cost.sum(axis=1))] for cost in costs])
    form = _first_good(best, _WORTH_IT)
    return forms[form][_first_good(costs[form], 0.0)]


def _first_good(costs: Array, share: float) -> int:
    """Return the first of (k, folds) as cheap as the least but for errors, or a share of it.

    A single fold, which nothing was fitted to, decides nothing: the first.
    """
    if costs.shape[1] < 2:
        return 0
    best = costs[np.argmin(costs.sum(axis=1))]
    worse = costs - best
    error = _STANDARD_ERRORS * np.std(worse, axis=1, ddof=1) * np.sqrt(len(best))
    return int(np.argmax(worse.sum(axis=1) <= np.maximum(error, share * best.sum())))
