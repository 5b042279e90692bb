"""Where in a recording the tool came on, as the readings of its still poses tell it.

Bare, the poses read the adapter, with the tool on they read both, each with an offset of its own:
since offsets are free, the two-sweep model of `galen_model.identification` with the border after
pose k is one load with six offsets for the poses up to k and another for those after it. So each
border's cost is that of two separate fits: the sum over the poses of how far they are off, in
standard deviations over all six channels, at the values that make this sum smallest (iteratively
reweighted least squares). A pose that was touched adds what it is off, and leads nobody astray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.identification import MIN_POSES
from galen_model.kinematics import gravity_in_sensor
from galen_model.load import gravity_regressor

_ITERATIONS = 15
_MAD_TO_STD = 1.4826
# Another border must be worse by so many standard deviations: as much as one pose on its wrong side
# that is off by as much.
_CLEAR_SIGMAS = 10.0
# One load for both parts, with offsets of their own, must be so many times worse than two.
_CLEAR_RATIO = 3.0


class BorderError(GalenError):
    """The poses are too few to tell where a tool came on."""


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


def find_border(roll: Array, tilt: Array, wrench: Array, std_of_mean: Array) -> Border:
    """Find it among poses in visiting order: roll, tilt (n,) rad; wrench, std_of_mean (n, 6).

    Raises BorderError for too few poses. How clear the border is, is for the caller to judge.
    """
    count = len(roll)
    if count < 2 * MIN_POSES:
        raise BorderError(
            f"{count} still poses are too few to find where the tool came on:"
            f" at least {MIN_POSES} without and {MIN_POSES} with it are needed"
        )
    design = np.zeros((count, 6, 10))
    design[:, :, :4] = gravity_regressor(gravity_in_sensor(roll, tilt))
    design[:, :, 4:] = np.eye(6)
    sigma = np.median(std_of_mean, axis=0)
    for _ in range(2):
        # The second time in the noise that the first border leaves: what the model does not hold
        # makes the poses differ by more than their own scatter.
        costs = np.full(count, np.inf)
        for k in range(MIN_POSES, count - MIN_POSES + 1):
            costs[k] = sum(_cost(design[p], wrench[p], sigma)[0] for p in _parts(k))
        index = int(np.argmin(costs))
        residuals = np.concatenate([_cost(design[p], wrench[p], sigma)[1] for p in _parts(index)])
        sigma = np.maximum(sigma, _MAD_TO_STD * np.median(np.abs(residuals), axis=0))
    rivals = costs.copy()
    rivals[index] = np.inf
    other = int(np.argmin(rivals))
    one_load = np.zeros((count, 6, 16))
    one_load[:, :, :10] = design
    one_load[index:, :, 10:] = np.eye(6)
    return Border(
        index=index,
        next_worse=float(rivals[other] - costs[index]),
        next_index=other,
        ratio=max(1.0, _cost(one_load, wrench, sigma)[0] / float(costs[index])),
    )


def _parts(index: int) -> tuple[slice, slice]:
    return slice(None, index), slice(index, None)


def _cost(design: Array, wrench: Array, sigma: Array) -> tuple[float, Array]:
    """Smallest sum of the poses' distances, and the residuals (n, 6) there."""
    rows = design / sigma[:, None]
    right = wrench / sigma
    floor = 0.1 * np.sqrt(6.0)
    weights = np.ones(len(design))
    distance = residuals = np.zeros(0)
    for _ in range(_ITERATIONS):
        weighted = (rows * weights[:, None, None]).reshape(-1, design.shape[2])
        values = np.linalg.lstsq(weighted, (right * weights[:, None]).reshape(-1), rcond=None)[0]
        residuals = right - rows @ values
        distance = np.sqrt(np.sum(residuals**2, axis=1))
        weights = 1.0 / np.sqrt(np.maximum(distance, floor))
    return float(np.sum(distance)), residuals * sigma
