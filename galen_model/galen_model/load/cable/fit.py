"""How smooth a cable's pull is: the numbers of `drag` by marginal likelihood.

With K the covariance of all readings y of a sweep (6 n), W = K^-1 y y^T K^-1 - K^-1:

    log p(y) = -(y^T K^-1 y + log det K) / 2 + const.,    d log p = tr(W dK) / 2

(Rasmussen & Williams 2006, eqs. 5.8 and 5.9), plus broad normal priors on the logarithms of
lengths, amplitudes and scatter and on the attachment, which keep a number where the sweep doesn't
tell it.
The scatter is what poses have beside smoothness and the averages' own noise (a cord that slips, a
sensor that drifts), in units of the sensor's noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.load.cable.drag import (
    LearnedPull,
    attachment_derivatives,
    constant_size,
    form_matrices,
    groups,
    together,
)

# Priors: mean and standard deviation of the logarithms, of length_rad (2), length_m, amplitude (2)
# and scatter: 1 rad of the wrist, 0.15 m of the platform (half the way to an anchor nearby), some
# 0.1 N and 0.01 N.m.
_LOG_PRIOR = np.log([1.0, 1.0, 0.15, 0.1, 0.01, 0.1])
_LOG_WIDTH = np.array([0.7, 0.7, 0.7, 1.5, 1.5, 1.5])
_ATTACHMENT_WIDTH_M = 0.2
_DUPLICATE_RAD = 0.02
_SPACINGS = 1.5


@dataclass(frozen=True)
class CableSweep:
    """Still poses with the cable on: joints (n, 5), wrench (n, 6) beyond the file, N, N.m.

    std_of_mean (n, 6) of the wrench; noise (6,), the sensor's, of one reading; time_s (n,).
    """

    joints: Array
    wrench: Array
    std_of_mean: Array
    noise: Array
    time_s: Array

    def __len__(self) -> int:
        return len(self.joints)

    def part(self, which: Array) -> CableSweep:
        """Some of the poses, by mask (n,) or indices."""
        return CableSweep(
            self.joints[which],
            self.wrench[which],
            self.std_of_mean[which],
            self.noise,
            self.time_s[which],
        )


@dataclass(frozen=True)
class CableFit:
    """What was found for one form: the pull, and the optimiser's vector, to start another from."""

    drag: LearnedPull
    scatter: float
    start: Array


def spacing_rad(joints: Array) -> float:
    """How far apart the poses (n, 5) stand in roll and tilt: most have another within it."""
    angles = joints[:, 3:]
    apart = np.linalg.norm(angles[:, None] - angles[None], axis=2)
    apart[apart < _DUPLICATE_RAD] = np.inf
    return float(np.quantile(apart.min(axis=1), 0.8))


def spread_out(joints: Array, count: int) -> Array:
    """Indices (count,) of poses (n, 5) that lie far apart: each next one farthest from the others.

    A tenth of a metre of the platform counts as much as half a radian.
    """
    scaled = joints / np.array([0.1, 0.1, 0.1, 0.5, 0.5])
    chosen = [int(np.argmin(np.linalg.norm(scaled - scaled.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(scaled - scaled[chosen[0]], axis=1)
    while len(chosen) < min(count, len(joints)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(scaled - scaled[chosen[-1]], axis=1))
    return np.sort(chosen)


def fit_cable(
    sweep: CableSweep, form: str, learned_at: str, start: Array | None = None
) -> CableFit:
    """Learn a cable's pull from all poses given. `start`: an earlier fit's.

    Raises IdentificationError where the sweep's numbers give none.
    """
    problem = _Likelihood(sweep, form)
    begin = np.concatenate([_LOG_PRIOR, problem.first_attachment()]) if start is None else start
    # The logarithms stay within e^-6 to e^6 of where they are plausible: beyond, exp() overflows.
    bounds = [(centre - 6.0, centre + 6.0) for centre in _LOG_PRIOR] + [(-1.0, 1.0)] * 3
    found = minimize(
        problem,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 60, "ftol": 1e-6},
    )
    if not np.isfinite(found.fun):
        raise IdentificationError("the sweep's readings give no cable's pull: they don't add up")
    values = np.exp(found.x[:6])
    scatter = float(values[5])
    drag = LearnedPull(
        form=form,
        joints=sweep.joints,
        wrench=sweep.wrench,
        std=np.hypot(sweep.std_of_mean, scatter * sweep.noise),
        length_rad=values[:2],
        length_m=float(values[2]),
        amplitude=values[3:5],
        support_rad=float(np.clip(_SPACINGS * spacing_rad(sweep.joints), 0.1, 0.8)),
        learned_at=learned_at,
        attachment_m=np.zeros(3) if form == "free" else found.x[6:],
    )
    return CableFit(drag, scatter, found.x)


class _Likelihood:
    """Minus the logarithm of posterior density, and its gradient, over the fit's vector (9,)."""

    def __init__(self, sweep: CableSweep, form: str) -> None:
        self._sweep = sweep
        self._form = form
        joints = sweep.joints
        self._apart2 = (joints[:, None] - joints[None]) ** 2
        self._derivatives = attachment_derivatives(form, joints)

    def first_attachment(self) -> Array:
        """The point r (3,) for which r x f comes nearest to the torques."""
        if self._form == "free":
            return np.zeros(3)
        force, torque = self._sweep.wrench[:, :3], self._sweep.wrench[:, 3:]
        # tau = -[f]x r, by ridge: a constant direction leaves r along it open.
        lever = -_skews(force).reshape(-1, 3)
        normal = lever.T @ lever
        ridge = 1e-3 * np.trace(normal) * np.eye(3) + 1e-12 * np.eye(3)
        return np.clip(np.linalg.solve(normal + ridge, lever.T @ torque.ravel()), -0.9, 0.9)

    def __call__(self, vector: Array) -> tuple[float, Array]:
        sweep, form = self._sweep, self._form
        values, attachment = np.exp(vector[:6]), vector[6:]
        lengths = np.array([values[2]] * 3 + [values[0], values[1]])
        scaled = self._apart2 / lengths**2
        kernel = np.exp(-0.5 * scaled.sum(axis=2))
        matrices = form_matrices(form, sweep.joints, attachment)
        products = [together(part, part) for part in matrices]
        sizes = [values[3 + g] ** 2 * kernel + constant_size(g) ** 2 for g in range(groups(form))]
        n = len(sweep)
        total: Array = np.zeros((n, 6, n, 6))
        for product, size in zip(products, sizes, strict=True):
            total += product * size[:, None, :, None]
        covariance = total.reshape(6 * n, 6 * n)
        scatter2 = np.tile((values[5] * sweep.noise) ** 2, n)
        covariance[np.diag_indices(6 * n)] += sweep.std_of_mean.ravel() ** 2 + scatter2
        try:
            factor = cho_factor(covariance, lower=True)
        except np.linalg.LinAlgError:
            return np.inf, np.zeros_like(vector)
        inverse = cho_solve(factor, np.eye(6 * n))
        weights = inverse @ sweep.wrench.ravel()
        away = np.concatenate(
            [(vector[:6] - _LOG_PRIOR) / _LOG_WIDTH, attachment / _ATTACHMENT_WIDTH_M]
        )
        value = (
            0.5 * float(sweep.wrench.ravel() @ weights)
            + float(np.log(np.diag(factor[0])).sum())
            + 0.5 * float(away @ away)
        )
        pull = (np.outer(weights, weights) - inverse).reshape(n, 6, n, 6)
        gradient = np.zeros(9)
        for group, product in enumerate(products):
            # tr(W dK) for a dK that is this group's product times a change of its kernel (n, n).
            along = values[3 + group] ** 2 * kernel * np.einsum("aibj,aibj->ab", pull, product)
            gradient[3 + group] = -along.sum()
            gradient[0] -= 0.5 * np.sum(along * scaled[:, :, 3])
            gradient[1] -= 0.5 * np.sum(along * scaled[:, :, 4])
            gradient[2] -= 0.5 * np.sum(along * scaled[:, :, :3].sum(axis=2))
        gradient[5] = -np.einsum("aiai,i->", pull, (values[5] * sweep.noise) ** 2)
        if form != "free":
            seen = np.einsum("aibj,ab,bjl->ail", pull, sizes[0], matrices[0], optimize=True)
            gradient[6:] = -np.einsum("dail,ail->d", self._derivatives, seen)
        gradient += away / np.concatenate([_LOG_WIDTH, np.full(3, _ATTACHMENT_WIDTH_M)])
        return value, gradient


def _skews(vectors: Array) -> Array:
    zero = np.zeros(len(vectors))
    x, y, z = vectors.T
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.array(rows).transpose(2, 0, 1)
