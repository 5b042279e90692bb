# SPDX-License-Identifier: Apache-2.0
"""Where in a recording the tool came on, as the readings of its still poses tell it.

Bare, the poses read the adapter, with the tool on they read both, each with an offset of its own:
since offsets are free, the two-sweep model of `galen_model.load.identification` with the border
after pose k is one load with six offsets for the poses up to k and another for those after it. So
each border's cost is that of two separate fits: the sum over the poses of how far they are off, in
standard deviations over all six channels, at the values that make this sum smallest (iteratively
reweighted least squares). A pose that was touched adds what it is off, and does not bias the fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.load.identification import MIN_POSES
from galen_model.load.model import gravity_regressor

_ITERATIONS = 15
_MAD_TO_STD = 1.4826
_RIDGE = 1e-10
# Another border must be worse by so many standard deviations: as much as one pose on its wrong side
# that is off by as much.
_CLEAR_SIGMAS = 10.0
# One load for both parts, with offsets of their own, must be so many times worse than two.
_CLEAR_RATIO = 3.0


@dataclass(frozen=True)
class Border:
    """The tool came on before pose `index`.

    `next_worse` tells by how many standard deviations the next best border (`next_index`) is worse;
    `ratio` how many times worse one load for all poses is than two.
    """

    index: int
    next_worse: float
    next_index: int
    ratio: float

    @property
    def changes(self) -> bool:
        """Whether two loads explain the poses clearly better than one."""
        return self.ratio >= _CLEAR_RATIO

    @property
    def clear(self) -> bool:
        """Whether no other border is nearly as good."""
        return self.next_worse >= _CLEAR_SIGMAS


def find_border(
    gravity: Array, wrench: Array, std_of_mean: Array, left_out: np.ndarray | None = None
) -> Border:
    """Find where the tool came on, among poses in visiting order.

    The caller judges how clear the border is.

    Args:
        gravity: (n, 3) in the sensor's frame, m/s^2.
        wrench: (n, 6) mean readings, N and N.m.
        std_of_mean: (n, 6) their standard deviations.
        left_out: (n,) bool, poses that are left out next to the border (at home): borders with
            nothing but such poses between them are one and the same. None: none is.

    Returns:
        The best border and the next best one.

    Raises:
        IdentificationError: there are too few poses.

    """
    count = len(gravity)
    if count < 2 * MIN_POSES:
        raise IdentificationError(
            f"{count} still poses are too few to find where the tool came on:"
            f" at least {MIN_POSES} without and {MIN_POSES} with it are needed"
        )
    design = np.zeros((count, 6, 10))
    design[:, :, :4] = gravity_regressor(gravity)
    design[:, :, 4:] = np.eye(6)
    sigma = np.median(std_of_mean, axis=0)
    borders = np.arange(MIN_POSES, count - MIN_POSES + 1)
    before = np.arange(count) < borders[:, None]  # of each border: which poses lie before it
    off, residuals = _two_loads(design, wrench, sigma, before)
    # And again in the noise that the best border leaves: what the model does not hold makes the
    # poses differ by more than their own scatter.
    sigma = np.maximum(sigma, _MAD_TO_STD * np.median(np.abs(residuals), axis=0))
    off, _ = _two_loads(design, wrench, sigma, before)
    best = int(np.argmin(off.sum(axis=1)))
    index, off_two = int(borders[best]), off[best]
    costs = np.full(count, np.inf)
    costs[borders] = off.sum(axis=1)
    rivals = costs.copy()
    low = high = index
    if left_out is not None:
        while low > 0 and left_out[low - 1]:
            low -= 1
        while high < count and left_out[high]:
            high += 1
    rivals[low : high + 1] = np.inf
    other = int(np.argmin(rivals))
    one_load = np.zeros((count, 6, 16))
    one_load[:, :, :10] = design
    one_load[index:, :, 10:] = np.eye(6)
    off_one = _off(one_load, wrench, sigma, np.ones((1, count), dtype=bool))[0][0]
    # What fits neither says nothing about which of them it is.
    kept = off_two <= _CLEAR_SIGMAS * np.median(off_two)
    return Border(
        index=index,
        next_worse=float(rivals[other] - costs[index]),
        next_index=other,
        ratio=max(1.0, float(off_one[kept].sum() / off_two[kept].sum())),
    )


def _two_loads(
    design: Array, wrench: Array, sigma: Array, before: np.ndarray
) -> tuple[Array, Array]:
    """For each border how far the poses are off (k, n), and the best one's residuals (n, 6)."""
    early, early_residuals = _off(design, wrench, sigma, before)
    late, late_residuals = _off(design, wrench, sigma, ~before)
    off = np.where(before, early, late)
    best = int(np.argmin(off.sum(axis=1)))
    return off, np.where(before[best, :, None], early_residuals[best], late_residuals[best])


def _off(design: Array, wrench: Array, sigma: Array, members: np.ndarray) -> tuple[Array, Array]:
    """How far poses are off where the sum of that over a part's members is smallest.

    design (n, 6, p), wrench (n, 6), members (k, n) of k parts. Returns for each part the distances
    (k, n) of all poses and their residuals (k, n, 6), N and N.m.
    """
    rows = design / sigma[:, None]
    rows = rows / np.linalg.norm(rows, axis=(0, 1))  # columns differ by orders of magnitude
    right = wrench / sigma
    count, _, parameters = rows.shape
    squares = np.einsum("ikp,ikq->ipq", rows, rows).reshape(count, -1)
    products = np.einsum("ikp,ik->ip", rows, right)
    flat = rows.reshape(-1, parameters).T
    floor = 0.1 * np.sqrt(6.0)
    weights = members.astype(float)
    distance = residuals = np.zeros(0)
    for _ in range(_ITERATIONS):
        matrices = (weights @ squares).reshape(-1, parameters, parameters)
        # A part of few poses may not tell every parameter; any value then does.
        ridge = _RIDGE * np.trace(matrices, axis1=1, axis2=2)[:, None, None]
        matrices = matrices + ridge * np.eye(parameters)
        values = np.linalg.solve(matrices, (weights @ products)[:, :, None])[:, :, 0]
        residuals = right - (values @ flat).reshape(-1, count, 6)
        distance = np.sqrt(np.sum(residuals**2, axis=2))
        weights = members / np.maximum(distance, floor)
    return distance, residuals * sigma
