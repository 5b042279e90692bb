# SPDX-License-Identifier: Apache-2.0
"""Weighted least squares for compliances, out of sums over blocks of time.

With W = 1 / noise^2, a block's N = sum D^T W D, b = sum D^T W y and y^T W y are all that a fit
needs of it (`galen_model.estimation.least_squares.Information`): fits that leave some blocks out,
and their residuals there, cost no further look at the samples. Blocks are a few seconds long, about
a push each.

Covariance of the parameters: N^-1, which is Cramer and Rao's bound if the model is right. If it is
not, residuals hang together for as long as a push lasts, and count for much less than their number.
The sums g of D^T W r over the blocks tell: if residuals were noise, sum g^T N^-1 g were the number
of parameters. The covariance is made larger by what it is more (a scalar form of the sandwich
covariance of clusters; Liang and Zeger, Biometrika 73, 1986).

Discrepancy: the covariance of residuals beyond the noise, on folds (repetitions of a position) that
the fit for them has not seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_model.arrays import Array
from galen_model.estimation.least_squares import Information

from galen_deflection.measurement.samples import DeflectionError, DeflectionSamples, check_to_fit
from galen_deflection.models.interface import FitSettings, FittedRange, fitted_on
from galen_deflection.models.spring_model import (
    Parameter,
    SpringBasis,
    SpringModel,
    SpringRun,
)

BLOCK_S = 4.0

FEWEST_FOLDS = 4

MAX_RELATIVE_STD = 0.5
"""Standard deviation over what was known before, beyond which a parameter is not identifiable."""

_REJECTED_BEYOND = 3.0
"""Standard deviations below zero."""


@dataclass(frozen=True)
class Sums:
    """Blocks (b,) of the samples, and the fold (b,) they belong to.

    wrench_at_tip (n, 6): of the samples, base_link. used (n,): which of them count.
    """

    blocks: Information
    fold: np.ndarray
    wrench_at_tip: Array
    used: np.ndarray

    def combined(self, combination: Array) -> Sums:
        """Return the sums of other designs, whose columns are combinations of these.

        Args:
            combination: (p, q); a column for each new parameter.

        Returns:
            Sums of q parameters.

        """
        return replace(self, blocks=self.blocks.combined(combination))


@dataclass(frozen=True)
class Solution:
    """Values (p,), which are free (p,) bool, names that are not identifiable, N (p, p)."""

    values: Array
    free: np.ndarray
    unresolved: tuple[str, ...]
    information: Array

    @cached_property
    def covariance(self) -> Array:
        """(p, p); zero of what is not free. Fits of folds don't need it."""
        covariance = np.zeros_like(self.information)
        some = np.ix_(self.free, self.free)
        covariance[some] = _inverse(self.information[some])
        return covariance


def sums(basis: SpringBasis, samples: DeflectionSamples, settings: FitSettings) -> Sums:
    """Go through the samples once, segment by segment.

    Args:
        basis: what the p parameters multiply.
        samples: n samples; all of their loads count for what operators remember.
        settings: which samples' deflections count.

    Returns:
        Sums by block, whitened by the samples' noise.

    Raises:
        DeflectionError: as `check_to_fit`.
        ValueError: `settings.use` is for another number of samples.

    """
    used = settings.used(len(samples))
    check_to_fit(samples, used)
    weight = 1.0 / samples.noise
    parts = blocks(samples)
    size = len(basis.parameters)
    wrench_at_tip = np.empty((len(samples), 6))

    def whitened() -> Iterator[tuple[Array, Array]]:
        for part, at_tip, rows in _rows(basis, samples, parts):
            wrench_at_tip[part] = at_tip
            design = (rows[used[part]] * weight[:, None]).reshape(-1, size)
            yield design, (samples.deflection[part][used[part]] * weight).ravel()

    return Sums(Information.of_blocks(whitened()), folds(samples, parts), wrench_at_tip, used)


def blocks(samples: DeflectionSamples) -> list[slice]:
    """Return blocks of at most BLOCK_S, each within a segment and a repetition of a position.

    Args:
        samples: n samples.

    Returns:
        Rows of the b blocks, in their order.

    """
    found = []
    places = np.stack([samples.position, samples.set_number], axis=1)
    for segment in samples.segments():
        changed = np.any(np.diff(places[segment], axis=0) != 0, axis=1)
        since_s = (samples.stamp_ns[segment] - samples.stamp_ns[segment.start]) * 1e-9
        cut = changed | (np.diff(np.floor(since_s / BLOCK_S)) > 0)
        bounds = [0, *(np.flatnonzero(cut) + 1).tolist(), segment.stop - segment.start]
        found += [
            slice(segment.start + first, segment.start + last) for first, last in pairwise(bounds)
        ]
    return found


def folds(samples: DeflectionSamples, parts: Sequence[slice]) -> np.ndarray:
    """Return the fold of each block: the repetition of a position.

    Where there are fewer than FEWEST_FOLDS, each is cut into equal runs of blocks.

    Args:
        samples: n samples.
        parts: rows of the b blocks, by `blocks`.

    Returns:
        (b,), numbers from 0.

    """
    firsts = [part.start for part in parts]
    places = np.stack([samples.position[firsts], samples.set_number[firsts]], axis=1)
    labels = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    count = int(labels.max()) + 1
    pieces = -(-FEWEST_FOLDS // count)
    if pieces > 1:
        for label in range(count):
            rows = np.flatnonzero(labels == label)
            for piece, some in enumerate(np.array_split(rows, pieces)):
                labels[some] = label + piece * count
    return labels


def solve(blocks: Information, parameters: Sequence[Parameter]) -> Solution:
    """Solve from the sums over blocks; what is not identifiable stays near its prior.

    None is below zero, but for signed parameters.

    Args:
        blocks: sums (b,) of whitened designs and deflections, of p parameters.
        parameters: the p parameters; all signed, or none.

    Returns:
        Values in the parameters' units; names of those that are not identifiable.

    """
    information, right, _ = blocks.total()
    missing = _not_identifiable(information, parameters)
    for k in missing:
        prior_std = parameters[k].prior_std
        assert prior_std is not None
        information[k, k] += prior_std**-2
        right[k] += parameters[k].prior * prior_std**-2
    scale = np.sqrt(np.diag(information))
    used = scale > 0.0
    scale = np.where(used, scale, 1.0)
    values = np.zeros(len(right))
    # N = R^T R, by eigenvalues since hardly different thresholds leave it nearly singular
    eigenvalue, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = eigenvalue > 1e-12 * eigenvalue[-1]
    root = np.sqrt(eigenvalue[kept])
    rows, wanted = root[:, None] * vectors[:, kept].T, vectors[:, kept].T @ (right / scale) / root
    solver = np.linalg.lstsq if parameters[0].signed else scipy.optimize.nnls
    values[used] = solver(rows[:, used], wanted)[0]
    values /= scale
    free = used & ((values > 0.0) | [p.prior_std is not None for p in parameters])
    names = tuple(parameters[k].name for k in missing)
    return Solution(values, free, names, information)


def _not_identifiable(information: Array, parameters: Sequence[Parameter]) -> list[int]:
    """Return the parameters that are hardly better known by the samples than before.

    In units of what was known, a combination whose standard deviation is above MAX_RELATIVE_STD is
    not identifiable, and all that have a share in it are named. What has no prior is left out: of
    hysteresis, the fit itself takes what the samples want.
    """
    asked = np.array([k for k, p in enumerate(parameters) if p.prior_std is not None], dtype=int)
    scale = np.array([parameters[k].prior_std for k in asked], dtype=float)
    gained, directions = np.linalg.eigh(information[np.ix_(asked, asked)] * np.outer(scale, scale))
    weak = gained < MAX_RELATIVE_STD**-2
    share = np.sum(directions[:, weak] ** 2, axis=1)
    return [int(k) for k in asked[share > 0.1]]


def finished(
    name: str,
    basis: SpringBasis,
    samples: DeflectionSamples,
    totals: Sums,
    *,
    only_nearby: bool = False,
) -> SpringModel:
    """Return the model of a basis, by its sums over the samples.

    Args:
        name: kind of the model.
        basis: what the parameters multiply.
        samples: n samples, those that don't count as well.
        totals: the basis' sums over `samples`.
        only_nearby: it holds near the positions of the samples, and not between them.

    Returns:
        The fitted model.

    Raises:
        DeflectionError: the samples are without load, or a spring would push back.

    """
    parameters = basis.parameters
    solution = solve(totals.blocks, parameters)
    if len(solution.unresolved) == sum(p.prior_std is not None for p in parameters):
        raise DeflectionError(
            f"no parameter of the model {name} is identifiable from the samples: nothing loads the"
            " arm"
        )
    covariance = _inflation(totals, solution) * solution.covariance
    _reject_negative(totals, solution, parameters)
    used = samples.rows(totals.used)
    return SpringModel(
        name=name,
        basis=basis,
        values=solution.values,
        covariance=covariance,
        discrepancy=_discrepancy(basis, samples, totals),
        noise=samples.noise,
        fitted_range=FittedRange.of(
            used.joints, totals.wrench_at_tip[totals.used], only_nearby, basis.arm
        ),
        fitted_on=fitted_on(used),
        unresolved=solution.unresolved,
    )


def _values_without(totals: Sums, basis: SpringBasis) -> dict[int, Array]:
    """For each fold, the values (p,) fitted to all others."""
    return {
        int(fold): solve(totals.blocks.part(totals.fold != fold), basis.parameters).values
        for fold in np.unique(totals.fold)
    }


def held_out_cost(totals: Sums, basis: SpringBasis) -> Array:
    """Return each fold's squared residual by a fit to the others, over the noise's.

    Args:
        totals: sums over blocks.
        basis: the basis of these sums.

    Returns:
        (folds,), without unit: sums over a fold's readings, each residual in units of its noise.

    """
    return np.array(
        [
            float(totals.blocks.cost(value)[totals.fold == fold].sum())
            for fold, value in _values_without(totals, basis).items()
        ]
    )


def _rows(
    basis: SpringBasis, samples: DeflectionSamples, parts: Sequence[slice]
) -> Iterator[tuple[slice, Array, Array]]:
    """Yield blocks in their order with wrenches at the tip and designs, a run a segment."""
    beginnings = {segment.start for segment in samples.segments()}
    for part in parts:
        if part.start in beginnings:
            run = SpringRun(basis)
        at_tip, design, _ = run.rows(samples.joints[part], samples.wrench[part])
        yield part, at_tip, design


def _inflation(totals: Sums, solution: Solution) -> float:
    """By how much residuals that hang together enlarge the covariance; 1 if they don't."""
    scores = totals.blocks.right - totals.blocks.matrix @ solution.values
    size = int(solution.free.sum())
    squares = np.einsum("bp,pq,bq->", scores, solution.covariance, scores)
    return max(1.0, float(squares) / max(size, 1))


def _reject_negative(totals: Sums, solution: Solution, parameters: Sequence[Parameter]) -> None:
    """Raise DeflectionError if a compliance would be below zero, were it let."""
    information, right, _ = totals.blocks.total()
    for k, parameter in enumerate(parameters):
        seen = information[k, k] > 0.0
        spring = parameter.prior_std is not None and not parameter.signed
        if not spring or solution.values[k] > 0.0 or not seen:
            continue
        free = solution.values > 0.0
        free[k] = True
        unbounded = Solution(np.empty(0), free, (), information)
        values = unbounded.covariance @ right
        std = np.sqrt(
            _inflation(totals, replace(unbounded, values=values)) * unbounded.covariance[k, k]
        )
        if values[k] < -_REJECTED_BEYOND * std:
            raise DeflectionError(
                f"{parameter.name} comes out as {values[k]:.3g} +- {std:.2g} {parameter.unit}: no "
                "spring pushes back; wrench, joints and tracker do not fit together"
            )


def _discrepancy(basis: SpringBasis, samples: DeflectionSamples, totals: Sums) -> Array:
    """Covariance (6, 6) of the residuals that is more than the noise's."""
    values = _values_without(totals, basis)
    found = np.zeros((6, 6))
    rows = _rows(basis, samples, blocks(samples))
    for (part, _, design), fold in zip(rows, totals.fold, strict=True):
        residual = (samples.deflection[part] - design @ values[int(fold)]) / samples.noise
        residual = residual[totals.used[part]]
        found += residual.T @ residual
    return beyond_noise(found / np.count_nonzero(totals.used), samples.noise)


def beyond_noise(square: Array, noise: Array) -> Array:
    """Return the part of residuals' covariance that the noise does not explain.

    Args:
        square: (6, 6) mean of the residuals' products, in units of the noise.
        noise: (6,) standard deviation of one measured deflection, m and rad.

    Returns:
        (6, 6), in m and rad.

    """
    eigenvalue, vectors = np.linalg.eigh(square - np.eye(6))
    beyond = vectors * np.maximum(eigenvalue, 0.0) @ vectors.T
    return np.asarray(beyond * np.outer(noise, noise))


def _inverse(matrix: Array) -> Array:
    """Of a symmetric positive matrix whose rows have different units."""
    scale = np.sqrt(np.diag(matrix))
    return np.linalg.pinv(matrix / np.outer(scale, scale), 1e-12, True) / np.outer(scale, scale)
