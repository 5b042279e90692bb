# SPDX-License-Identifier: Apache-2.0
"""Which poses tell most about a load: optimal design for the load's identification.

A sweep with one load on it reads y = G(theta) x + c + noise, x = (m, h) the load's moments and c
six constants (`galen_model.load.identification`). All that the compensation uses is of this kind:
with x = x_tool + x_adapter and c = o_tool - G_0 x_adapter it expects G(theta) x + c. So its error
is B(theta) (dx, dc) with B = [G, I], and n poses leave the covariance N^-1 with

    N = sum_i I(theta_i) + P,    I(theta) = B^T Sigma^-1 B,

Sigma one averaged reading's noise and P what is known beforehand: nothing after two sweeps, after
one what the zeroing tells of c. The sweep without the tool does not enter the compensation; it
takes tool and adapter apart, and is the same problem (with the same poses in both sweeps the
tool's own covariance is twice that of the sum). The criterion is linear in N^-1:

    phi = tr(M N^-1) / 6, M the mean of I(theta) over the workspace: the variance of the
    compensation's error, mean over workspace and axes, in units of one averaged reading's ("V-" or
    "I-optimality"; Pukelsheim, *Optimal Design of Experiments*, 1993).

I(theta) is a function of gravity's direction in the sensor alone. The workspace is a grid of the
angles for up to two revolute joints. Of more joints it is the directions that they can give, evenly
over the sphere; then no n poses do better than phi = 10 / (6 n), as directions evenly over all of
it.

Fedorov's exchange finds n poses (Fedorov 1972, chapter 2): each is taken out in turn and the best
candidate put in, until no exchange is better.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array, evenly_spread
from galen_model.errors import GalenError
from galen_model.load.model import gravity_regressor
from galen_model.load.readings import single_load_design

_WORKSPACE_STEPS = 25
MOST_GRID_JOINTS = 2  # a grid of more angles has too many poses
_REACH_POSES = 4096
_PARAMETERS = 10
_EXCHANGES = 100  # rounds; ten are many
_BETTER = 1e-9
# Below this share of an even spread's information a design counts as singular.
_RIDGE = 1e-9


class PoseDesignError(GalenError):
    """Poses can't be chosen; the message says why."""


def reading_noise() -> Array:
    """Compute the noise of one sample, quantum included: only its ratios matter here.

    Returns:
        Standard deviations (6,), N and N.m.

    """
    return np.asarray(np.hypot(SENSOR.noise_std, SENSOR.quantum / np.sqrt(12.0)))


def angle_grid(
    lower: Sequence[float] | Array, upper: Sequence[float] | Array, *counts: int
) -> Array:
    """Make a grid of angles, ends included.

    Args:
        lower: (k,), rad.
        upper: (k,), rad.
        *counts: k of them, points along each angle.

    Returns:
        Angles (prod(counts), k), rad, the last angle changing fastest.

    """
    axes = [np.linspace(*axis) for axis in zip(lower, upper, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def workspace(steps: int, arm: Arm) -> Array:
    """Spread angles evenly over all that the joints' limits allow.

    Args:
        steps: points along each angle of a grid.
        arm: with k revolute joints.

    Returns:
        Angles (w, k), rad: a grid of steps^k for up to two joints, steps^2 spread poses of more.

    """
    lower, upper = angle_limits(arm)
    if len(lower) <= MOST_GRID_JOINTS:
        return angle_grid(lower, upper, *[steps] * len(lower))
    return lower + (upper - lower) * evenly_spread(steps**2, len(lower))


def angle_limits(arm: Arm) -> tuple[Array, Array]:
    """Get the revolute joints' limits, at most one turn apart.

    Args:
        arm: with k revolute joints.

    Returns:
        Lowest and highest angles (k,), rad.

    """
    lower, upper = arm.angles(arm.lower), arm.angles(arm.upper)
    turn = upper - lower > 2.0 * np.pi
    return np.where(turn, -np.pi, lower), np.where(turn, np.pi, upper)


def workspace_gravity(arm: Arm) -> Array:
    """Compute gravity in the sensor over the workspace.

    Args:
        arm: whose workspace it is.

    Returns:
        (w, 3) in the sensor's frame, m/s^2.

    """
    if len(arm.turning) <= MOST_GRID_JOINTS:
        return arm.gravity_in_sensor(workspace(_WORKSPACE_STEPS, arm))
    count = _WORKSPACE_STEPS**2
    # Fibonacci's spiral, equal shares of the sphere (Gonzalez, Math. Geosci. 42, 2010)
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    flat = np.sqrt(1.0 - height**2)
    even = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    lower, upper = angle_limits(arm)
    angles = lower + (upper - lower) * evenly_spread(_REACH_POSES, len(lower))
    reached = arm.gravity_in_sensor(angles)
    size = np.linalg.norm(arm.gravity_m_s2)
    near = np.max(even @ reached.T, axis=1) > size * np.cos(2.0 * np.sqrt(np.pi / count))
    return np.asarray(even[near] * size)


def compensation_std(poses: Array, sigma: Array, arm: Arm) -> Array:
    """Compute the standard deviation of the compensation's error after a sweep.

    Args:
        poses: angles (n, k), rad.
        sigma: (6,) one averaged reading's noise, N and N.m.
        arm: that takes the poses.

    Returns:
        (6,), N and N.m: root of the mean variance over the workspace; inf where the poses don't
        identify the load.

    """
    return compensation_std_under(arm.gravity_in_sensor(poses), sigma, arm)


def compensation_std_under(gravity: Array, sigma: Array, arm: Arm) -> Array:
    """Compute the standard deviation of the compensation's error as `compensation_std`.

    Args:
        gravity: (n, 3) of the sweep, in the sensor's frame, m/s^2.
        sigma: (6,) one averaged reading's noise, N and N.m.
        arm: whose workspace counts.

    Returns:
        (6,), N and N.m; inf where the poses don't identify the load.

    """
    information = _information(single_load_design(gravity), sigma).sum(axis=0)
    scaled, balance = _balanced(information)
    if np.linalg.eigvalsh(scaled)[0] < _RIDGE:
        return np.full(6, np.inf)
    covariance = np.linalg.inv(scaled) * balance
    everywhere = single_load_design(workspace_gravity(arm))
    variance = np.einsum("wkp,pq,wkq->k", everywhere, covariance, everywhere) / len(everywhere)
    return np.asarray(np.sqrt(variance))


class PoseDesign:
    """Chooses from candidates (m, k), angles in rad, each at most once.

    sigma (6,), N and N.m: the noise, up to a factor. `one_sweep_zero`
    (k,), angles of the zeroing, says that there is the tool's sweep alone.
    """

    def __init__(
        self,
        candidates: Array,
        *,
        sigma: Array | None = None,
        one_sweep_zero: ArrayLike | None = None,
        arm: Arm,
    ) -> None:
        self._arm = arm
        self.candidates = np.asarray(candidates, dtype=float).reshape(-1, len(arm.turning))
        self._sigma = reading_noise() if sigma is None else np.asarray(sigma, dtype=float)
        # Parameters scaled so that one ideal reading would tell each of them to about 1.
        gravity = float(np.linalg.norm(arm.gravity_m_s2))
        force, torque = self._sigma[:3].mean(), self._sigma[3:].mean()
        self._scale = np.concatenate(
            [[force / gravity], np.full(3, np.sqrt(1.5) * torque / gravity), self._sigma]
        )
        self._each = self.information(self.candidates)
        self._known = np.zeros((_PARAMETERS, _PARAMETERS))
        if one_sweep_zero is not None:
            self._known[4:, 4:] = _zeroing_information(
                arm.gravity_in_sensor(one_sweep_zero), self._sigma
            )
            self._known *= np.outer(self._scale, self._scale)
        rows = single_load_design(workspace_gravity(arm)) * self._scale
        self._target = _information(rows, self._sigma).mean(axis=0) / 6.0

    def information(self, poses: Array) -> Array:
        """Compute I of poses, in the scaled parameters.

        Args:
            poses: angles (n, k), rad.

        Returns:
            (n, 10, 10).

        """
        rows = single_load_design(self._arm.gravity_in_sensor(poses))
        return _information(rows * self._scale, self._sigma)

    def value(self, poses: Array) -> float:
        """Compute phi of poses, whether candidates or not.

        Args:
            poses: angles (n, k), rad.

        Returns:
            Phi; inf where they don't identify all parameters.

        """
        return float(self._value(self.information(poses).sum(axis=0) + self._known))

    def best_value(self, count: int) -> float:
        """Compute phi of poses that are spread as the workspace is.

        Args:
            count: number of poses.

        Returns:
            Phi.

        """
        return float(
            np.trace(self._target @ np.linalg.pinv(6.0 * count * self._target + self._known))
        )

    def choose(self, count: int, start: Sequence[int] = ()) -> list[int]:
        """Choose the most informative candidates, by exchange.

        Args:
            count: how many.
            start: indices of some to begin with, which may be exchanged.

        Returns:
            Indices of the candidates, sorted.

        Raises:
            PoseDesignError: there are fewer candidates, or too little excitation.

        """
        if count > len(self.candidates):
            raise PoseDesignError(
                f"{count} poses are wanted, but there are only {len(self.candidates)} to choose"
                " from"
            )
        chosen = self.first(count, start)
        self._exchange(chosen)
        if not np.isfinite(self.value(self.candidates[chosen])):
            raise PoseDesignError(
                f"{count} poses out of {len(self.candidates)} don't tell all of the load"
            )
        return sorted(chosen)

    def first(self, count: int, start: Sequence[int] = ()) -> list[int]:
        """Choose candidates, the best one by one; no exchange follows.

        Args:
            count: how many, at most as many as candidates.
            start: indices of some to begin with.

        Returns:
            Indices of the candidates, in the order chosen.

        """
        chosen = list(start)[:count]
        # Until the poses tell all, a little of every candidate stands in for those to come.
        ridge = 1e-3 * self._each.mean(axis=0)
        while len(chosen) < count:
            so_far = self._each[chosen].sum(axis=0) + self._known + ridge
            chosen.append(self._best(so_far, chosen)[0])
        return chosen

    def _exchange(self, chosen: list[int]) -> None:
        """Fedorov's exchange in place, until a whole round finds nothing better."""
        for _ in range(_EXCHANGES):
            before = self._value(self._each[chosen].sum(axis=0) + self._known)
            for place in range(len(chosen)):
                others = chosen[:place] + chosen[place + 1 :]
                rest = self._each[others].sum(axis=0) + self._known
                best, value = self._best(rest, others)
                if value < self._value(rest + self._each[chosen[place]]) * (1.0 - _BETTER):
                    chosen[place] = best
            after = self._value(self._each[chosen].sum(axis=0) + self._known)
            if not after < before * (1.0 - _BETTER):
                return

    def _best(self, rest: Array, taken: list[int]) -> tuple[int, float]:
        values = self._value(rest + self._each)
        values[taken] = np.inf
        best = int(np.argmin(values))
        return best, float(values[best])

    def _value(self, information: Array) -> Array:
        """Phi of information (..., 10, 10); inf where it is singular."""
        lowest = np.linalg.eigvalsh(information)[..., 0]
        regular = lowest > _RIDGE * np.trace(information, axis1=-2, axis2=-1)
        safe = np.where(regular[..., None, None], information, np.eye(_PARAMETERS))
        values = np.einsum("...pq,qp->...", np.linalg.inv(safe), self._target)
        return np.where(regular, values, np.inf)


def _information(rows: Array, sigma: Array) -> Array:
    """(n, p, p) of each pose's rows (n, 6, p)."""
    weighted = rows / np.asarray(sigma)[:, None] ** 2
    return np.asarray(np.swapaxes(rows, 1, 2) @ weighted)


def _balanced(information: Array) -> tuple[Array, Array]:
    """With a unit diagonal, and what its inverse is to be multiplied by."""
    balance = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    both = np.outer(balance, balance)
    return information * both, both


def _zeroing_information(gravity_zero: Array, sigma: Array) -> Array:
    """Of c = o - G_0 x_adapter (6, 6): o is zero to one reading's noise, x_adapter not known.

    W - W G_0 (G_0^T W G_0)^+ G_0^T W with W = Sigma^-1, what is left when x_adapter is taken out.
    """
    at_zero = gravity_regressor(gravity_zero)
    weights = np.diag(1.0 / np.asarray(sigma) ** 2)
    root = np.diag(1.0 / np.asarray(sigma)) @ at_zero
    basis, singular, _ = np.linalg.svd(root, full_matrices=False)
    basis = np.diag(1.0 / np.asarray(sigma)) @ basis[:, singular > 1e-9 * singular.max()]
    return np.asarray(weights - basis @ basis.T)
