"""Whether what a file leaves at some stops is a pull that belongs to the pose, or a hand's.

A cable's pull, and a wrong angle, change with the pose, and little from one pose to another near
it. A hand is whatever it is at each stop, or what it was at the stop before. With y_i (n,) an
axis' means at n stops and u gravity's unit vector there, each is a normal density of y_i with

    covariance s^2 R + v_i 1,    R_kl = exp(-|u_k - u_l|^2 / (2 l^2))     a pull
                                 R_kl = exp(-|k - l| / 2)                 a hand that changes slowly

and the size s integrated out over a coarse scale of sizes (Rasmussen and Williams, *Gaussian
Processes for Machine Learning*, 2006, section 5.4). A hand that is another at each stop has another
size at each as well: pushes of newtons and of tenths come from the same hand, and small ones at
poses near each other are not alike for that. The median over the stops is taken off first: what
they have in common tells a pull from hands by nothing. Forces and torques of a push at one point
say the same twice, so only those count that tell less of a pull. Nothing is said while poses are as
near to each other as they are in time, which is then the same.
"""

from __future__ import annotations

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array

from galen_gravcomp.calibration_monitor.evidence import Stops

_LENGTHS = (0.35, 0.7)
_STOPS_ALIKE = 2.0
_SIZES = np.repeat([0.15, 0.006], 3)[:, None] * 2.0 ** np.arange(-2, 5)
_LOG_2PI = float(np.log(2.0 * np.pi))


def log_odds_of_pull(stops: Stops, variance: Array) -> float:
    """Log odds of a pull by the pose against hands; `variance` (n, 6): of the noise."""
    means = stops.mean - np.median(stops.mean, axis=0)
    order = np.arange(len(stops))
    slow = np.exp(-np.abs(order[:, None] - order) / _STOPS_ALIKE)
    density = _log_density(means, variance, np.array([*_by_pose(stops), slow]))
    pulls = _log_mean(density[:-1], 0)
    hands = np.maximum(density[-1], _log_density_of_hands(means, variance))
    return float(np.min(pulls - hands))


def log_density_of_pull(stops: Stops, variance: Array) -> float:
    """Log density of all means (n, 6) if a pull by the pose is all there is."""
    return float(np.sum(_log_mean(_log_density(stops.mean, variance, _by_pose(stops)), 0)))


def _by_pose(stops: Stops) -> Array:
    """Kernels (lengths, n, n)."""
    unit = gravity_in_sensor(stops.angles[:, 0], stops.angles[:, 1]) / -GRAVITY_M_S2[2]
    square = np.sum((unit[:, None] - unit) ** 2, axis=2)
    return np.array([np.exp(-square / (2.0 * length**2)) for length in _LENGTHS])


def _log_density(means: Array, variance: Array, kernels: Array) -> Array:
    """Of means (n, 6) by each kernel (k, n, n), of forces and of torques: (k, 2).

    Sums over the kernel's own axes; noise is taken as the same at all stops.
    """
    values, modes = np.linalg.eigh(kernels)
    spread = np.maximum(values, 0.0)[:, None, None] * _SIZES[..., None] ** 2
    spread = spread + np.mean(variance, axis=0)[:, None, None]
    square = np.swapaxes(np.swapaxes(modes, 1, 2) @ means, 1, 2)[:, :, None] ** 2
    density = -0.5 * np.sum(square / spread + np.log(spread) + _LOG_2PI, axis=3)
    return np.asarray(_log_mean(density, 2).reshape(-1, 2, 3).sum(axis=2))


def _log_density_of_hands(means: Array, variance: Array) -> Array:
    """Of means (n, 6), of forces and of torques (2,), if each stop's are of a size of their own."""
    spread = _SIZES**2 + variance[..., None]
    density = -0.5 * (means[..., None] ** 2 / spread + np.log(spread) + _LOG_2PI)
    by_size = density.reshape(len(means), 2, 3, -1).sum(axis=2)
    return np.asarray(np.sum(_log_mean(by_size, 2), axis=0))


def _log_mean(values: Array, axis: int) -> Array:
    """Logarithm of the mean of exp(values): a tenth of what scipy's logsumexp takes."""
    most = np.max(values, axis=axis, keepdims=True)
    mean = np.mean(np.exp(values - most), axis=axis)
    return np.asarray(np.squeeze(most, axis=axis) + np.log(mean))
