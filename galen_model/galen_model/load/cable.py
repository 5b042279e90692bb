# SPDX-License-Identifier: Apache-2.0
"""The pull of a cable at the tool, as a sweep with the cable on shows it.

What a reading holds beyond the calibration file, y (6,), is a Gaussian process over the joints q
(Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, eqs. 2.25, 2.26):

    y = B(q) g(q) + noise,   cov(g_l(q), g_l(q')) = a^2 exp(-|q - q'|^2 / 2) + c^2

with distances in units of the lengths over which the pull changes, a the size of its changes and c
a broad prior for what is the same at all poses; B is of `form_matrices`. The pull at q is the mean
given the sweep's poses; the covariance says how well that is known. It needs no parameters but the
sweep and the few numbers that `fit` found, so a calibration file holds the sweep itself.

Off outside the poses seen: s(q), the share of the sweep's information that is missing at q, is the
same process' variance over its prior's, but for lengths that come from the sweep's spacing and not
from the pull (`support_rad`, SUPPORT_M), so that a slow pull is not trusted farther than a quick
one. The pull is taken whole up to s = SEEN, not at all from UNSEEN on, and by a smooth step
between, with a continuous slope; nothing jumps.

A part of the pull that is constant or linear in gravity's direction looks like a load. So the load
comes from a calibration without the cable; what is left with it on is the cable's.

A pull is learned in one of three forms:

    free              g: three forces and three torques along ft_sensor, nothing presumed
    point             g: a force F along base_link that acts at one point r of the tool
    point_and_couple  and a couple M along base_link, as of a cord that is bent at the tool

With R = R_base_sensor: f = R^T F, tau = r x R^T F + R^T M. Along base_link the pull of a cable
hardly turns with the wrist (it points at where the cable is held), so that g is nearly constant
there; and a torque, which the sensor knows to a few thousandths of a newton over r, tells of the
force. Where a cable is caught at two places of the tool neither holds, and `free` remains.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.json_fields import (
    FieldError,
    array,
    get,
    items,
    mapping,
    number,
    numbers,
    text,
)
from galen_model.rotation import skew

FORMS = ("point", "point_and_couple", "free")


def groups(form: str) -> int:
    """Count the vectors that g has in a form.

    Args:
        form: one of FORMS.

    Returns:
        1 (forces) or 2 (forces, and torques or couples).

    """
    return 1 if form == "point" else 2


def form_matrices(form: str, joints: ArrayLike, attachment_m: ArrayLike, arm: Arm) -> Array:
    """Compute B, which takes g to the readings, of each pose.

    Args:
        form: one of FORMS.
        joints: (n, d) of the arm, m and rad.
        attachment_m: r (3,) in the sensor's frame; without effect for `free`.
        arm: whose joints they are.

    Returns:
        B (groups, n, 6, 3): wrench in ft_sensor by each vector of g.

    """
    q = np.asarray(joints, dtype=float)
    matrices = np.zeros((groups(form), len(q), 6, 3))
    if form == "free":
        matrices[0, :, :3] = matrices[1, :, 3:] = np.eye(3)
        return matrices
    turned = np.swapaxes(arm.rotation(arm.angles(q)), -1, -2)
    matrices[0, :, :3] = turned
    matrices[0, :, 3:] = skew(np.asarray(attachment_m, dtype=float)) @ turned
    if form == "point_and_couple":
        matrices[1, :, 3:] = turned
    return matrices


def attachment_derivatives(form: str, joints: Array, arm: Arm) -> Array:
    """Compute the derivatives of B[0] by the attachment.

    Args:
        form: one of FORMS.
        joints: (n, d) of the arm, m and rad.
        arm: whose joints they are.

    Returns:
        (3, n, 6, 3), 1/m, the first axis x, y, z of the attachment; zeros for `free`.

    """
    derivatives = np.zeros((3, len(joints), 6, 3))
    if form != "free":
        turned = np.swapaxes(arm.rotation(arm.angles(joints)), -1, -2)
        derivatives[:, :, 3:] = skew(np.eye(3))[:, None] @ turned
    return derivatives


MIN_POSES = 16
MAX_POSES = 120
SUPPORT_M = 0.10
"""Length of s over prismatic joints: whole up to 6 cm away, nothing from 13 cm on."""
SEEN, UNSEEN = 0.3, 0.8
_CONSTANT = np.array([1.0, 0.1])
"""c of forces (N) and torques (N.m): larger than any cable on a tool that a hand can guide."""
_SUPPORT_NOISE = 0.05
_LARGEST_N = 20.0
"""No pull of a cable that an arm guided by hand could work with; N.m as well."""


@dataclass(frozen=True)
class LearnedPull:
    """What was learned: the sweep and how smooth the pull is. SI, wrenches along ft_sensor.

    joints (n, d) of the arm, wrench (n, 6) beyond the calibration file, std (n, 6) of it.
    length_rad (k,), over the revolute joints, length_m over the prismatic ones. amplitude (2,): a
    of forces (N) and of torques (N.m). attachment_m (3,): r. inflation: the covariance's standard
    deviations are this much larger than the process says, as held-out poses asked for.
    held_out_rmse (6,): theirs.
    """

    form: str
    joints: Array
    wrench: Array
    std: Array
    length_rad: Array
    length_m: float
    amplitude: Array
    support_rad: float
    learned_at: str
    attachment_m: Array = field(default_factory=lambda: np.zeros(3))
    inflation: float = 1.0
    held_out_rmse: Array = field(default_factory=lambda: np.zeros(6))
    arm: Arm = field(default=GALEN, repr=False)

    @cached_property
    def posterior(self) -> CablePosterior:
        """Its prediction at any pose; numpy's LinAlgError where the numbers don't make one."""
        return CablePosterior(self)

    def to_json(self) -> dict[str, Any]:
        """Return the content of the key `cable`."""
        return {
            "form": self.form,
            "length_rad": numbers(self.length_rad),
            "length_m": float(self.length_m),
            "amplitude": numbers(self.amplitude),
            "attachment_m": numbers(self.attachment_m),
            "support_rad": float(self.support_rad),
            "inflation": float(self.inflation),
            "held_out_rmse": numbers(self.held_out_rmse),
            "learned_at": self.learned_at,
            "poses": [
                {"joints": numbers(q), "wrench": numbers(y), "std": numbers(s)}
                for q, y, s in zip(self.joints, self.wrench, self.std, strict=True)
            ],
        }

    @classmethod
    def from_json(cls, value: Any, name: str, arm: Arm) -> LearnedPull:
        """Read the content of the key `cable`.

        Args:
            value: the content as parsed.
            name: the key's name in errors.
            arm: whose joints the poses are of.

        Returns:
            The pull, whose numbers make a posterior.

        Raises:
            FieldError: a field is missing or wrong; the message names it.

        """
        whole = mapping(value, name)
        form = text(get(whole, "form"), f"{name}.form")
        if form not in FORMS:
            raise FieldError(f"{name}.form is {form!r:.40}; expected one of {', '.join(FORMS)}")
        poses = [
            mapping(pose, f"{name}.poses") for pose in items(get(whole, "poses"), f"{name}.poses")
        ]
        if not MIN_POSES <= len(poses) <= MAX_POSES:
            raise FieldError(
                f"{name}.poses are {len(poses)}; expected {MIN_POSES} to {MAX_POSES} of them"
            )

        def rows(key: str, width: int) -> Array:
            return np.array(
                [array(get(pose, key), f"{name}.poses.{key}", (width,)) for pose in poses]
            )

        def within(key: str, values: Array, least: float, most: float) -> Array:
            if np.any(values < least) or np.any(values > most):
                raise FieldError(f"{name}.{key} is not between {least:g} and {most:g}")
            return values

        def one(key: str, least: float, most: float) -> float:
            found = number(get(whole, key), f"{name}.{key}")
            return float(within(key, np.array(found), least, most))

        def vector(key: str, length: int) -> Array:
            return array(get(whole, key), f"{name}.{key}", (length,))

        drag = cls(
            form=form,
            joints=rows("joints", len(arm.joints)),
            wrench=within("poses.wrench", rows("wrench", 6), -_LARGEST_N, _LARGEST_N),
            std=within("poses.std", rows("std", 6), 1e-6, 100.0),
            length_rad=within("length_rad", vector("length_rad", len(arm.turning)), 1e-2, 100.0),
            length_m=one("length_m", 1e-3, 100.0),
            amplitude=within("amplitude", vector("amplitude", 2), 1e-6, 100.0),
            support_rad=one("support_rad", 1e-2, 2.0),
            learned_at=text(get(whole, "learned_at"), f"{name}.learned_at"),
            attachment_m=within("attachment_m", vector("attachment_m", 3), -2.0, 2.0),
            inflation=one("inflation", 1.0, 1e3),
            held_out_rmse=within("held_out_rmse", vector("held_out_rmse", 6), 0.0, 100.0),
            arm=arm,
        )
        try:
            drag.posterior  # noqa: B018 - only to see whether there is one
        except np.linalg.LinAlgError:
            raise FieldError(f"{name} holds poses that no pull can be computed from") from None
        return drag


def smooth_kernel(a: Array, b: Array, lengths: Array) -> Array:
    """Compute exp(-|a - b|^2 / 2) of all pairs, in units of lengths.

    Args:
        a: (n, d).
        b: (m, d), in a's units.
        lengths: (d,), in a's units.

    Returns:
        Kernel (n, m).

    """
    left, right = a / lengths, b / lengths
    # By products, without an array of all differences: |a - b|^2 = |a|^2 + |b|^2 - 2 a.b.
    apart2 = np.sum(left**2, axis=1)[:, None] + np.sum(right**2, axis=1) - 2.0 * left @ right.T
    return np.asarray(np.exp(-0.5 * np.maximum(apart2, 0.0)))


def prior_covariance(drag: LearnedPull, a: Array, b: Array) -> Array:
    """Compute the prior covariance of the readings at two sets of poses.

    Args:
        drag: form, lengths and amplitudes.
        a: joints (n, d), m and rad.
        b: joints (m, d), m and rad.

    Returns:
        (6 n, 6 m) of wrenches in ft_sensor, pose by pose.

    """
    kernel = smooth_kernel(a, b, _lengths(drag))
    left = form_matrices(drag.form, a, drag.attachment_m, drag.arm)
    right = form_matrices(drag.form, b, drag.attachment_m, drag.arm)
    total: Array = np.zeros((len(a), 6, len(b), 6))
    for group in range(groups(drag.form)):
        size = drag.amplitude[group] ** 2 * kernel + _CONSTANT[group] ** 2
        total += together(left[group], right[group]) * size[:, None, :, None]
    return total.reshape(6 * len(a), 6 * len(b))


def together(left: Array, right: Array) -> Array:
    """Compute B B'^T of all pairs of poses.

    Args:
        left: B (n, 6, 3).
        right: B' (m, 6, 3).

    Returns:
        (n, 6, m, 6).

    """
    return np.asarray(np.tensordot(left, right, axes=(2, 2)))


def constant_size(group: int) -> float:
    """Get the prior's c for a group of the form.

    Args:
        group: 0 for forces, 1 for torques.

    Returns:
        c, N or N.m.

    """
    return float(_CONSTANT[group])


def _lengths(drag: LearnedPull) -> Array:
    return drag.arm.by_unit(drag.length_m, drag.length_rad)


def support_step(missing: ArrayLike) -> Array:
    """Compute how much of the pull is taken where a part of the information is missing.

    Args:
        missing: s (...), 0 to 1.

    Returns:
        Weight (...), from 1 at SEEN to 0 at UNSEEN.

    """
    x = np.clip((np.asarray(missing, dtype=float) - SEEN) / (UNSEEN - SEEN), 0.0, 1.0)
    return np.asarray(1.0 - x * x * (3.0 - 2.0 * x))


class CablePosterior:
    """The pull at other poses than those of the sweep."""

    def __init__(self, drag: LearnedPull) -> None:
        """Factor the covariance of the poses.

        Args:
            drag: the sweep and how smooth the pull is.

        Raises:
            numpy.linalg.LinAlgError: the numbers make no covariance.

        """
        self._drag = drag
        covariance = prior_covariance(drag, drag.joints, drag.joints)
        covariance[np.diag_indices(len(covariance))] += drag.std.ravel() ** 2
        self._factor = cho_factor(covariance, lower=True)
        weights = cho_solve(self._factor, drag.wrench.ravel()).reshape(-1, 6)
        if not np.all(np.isfinite(weights)):
            raise np.linalg.LinAlgError("the weights are not finite")
        matrices = form_matrices(drag.form, drag.joints, drag.attachment_m, drag.arm)
        # g_l(q) = a^2 sum_i k(q, q_i) b_il + c^2 sum_i b_il,   b_il = sum_k B_ikl w_ik
        parts: Array = np.einsum("gnkl,nk->gln", matrices, weights)
        size: Array = drag.amplitude[: len(parts), None, None] ** 2
        constant: Array = _CONSTANT[: len(parts), None] ** 2
        self.by_pose: Array = (size * parts).reshape(-1, len(weights))
        """(3 groups, n): g over the kernel's values, but for `constant`."""
        self.constant: Array = (constant * parts.sum(axis=2)).ravel()
        """(3 groups,)."""
        self.middle: Array = (drag.joints.min(axis=0) + drag.joints.max(axis=0)) / 2.0
        """(d,) of the poses' range, from which endless joints are at most half a turn away."""
        self.lengths: Array = _lengths(drag)
        """(d,) of the pull, m and rad."""
        self.support_lengths = drag.arm.by_unit(SUPPORT_M, drag.support_rad)
        """(d,) of s."""
        seen = smooth_kernel(drag.joints, drag.joints, self.support_lengths)
        seen[np.diag_indices(len(seen))] += _SUPPORT_NOISE**2
        self.support: Array = np.asarray(np.linalg.inv(seen), dtype=float)
        """(n, n): s = 1 - k^T support k."""

    def readings(self, joints: ArrayLike) -> Array:
        """Compute the pull to subtract: mean times `weights`.

        Args:
            joints: (n, d) of the arm, m and rad.

        Returns:
            Wrenches (n, 6) in ft_sensor, N and N.m.

        """
        q = np.asarray(joints, dtype=float)
        return self.means(q) * self.weights(q)[:, None]

    def means(self, joints: ArrayLike) -> Array:
        """Compute the process' mean, whether the pose was seen or not.

        Args:
            joints: (n, d) of the arm, m and rad.

        Returns:
            Wrenches (n, 6) in ft_sensor, N and N.m.

        """
        q = self._drag.arm.nearest(joints, self.middle)
        kernel = smooth_kernel(q, self._drag.joints, self.lengths)
        smooth = (kernel @ self.by_pose.T + self.constant).reshape(len(q), -1, 3)
        matrices = form_matrices(self._drag.form, q, self._drag.attachment_m, self._drag.arm)
        return np.asarray(np.einsum("gnkl,ngl->nk", matrices, smooth))

    def weights(self, joints: ArrayLike) -> Array:
        """Compute how much of the mean is taken.

        Args:
            joints: (n, d) of the arm, m and rad.

        Returns:
            Weights (n,), from 0 to 1.

        """
        q = self._drag.arm.nearest(joints, self.middle)
        kernel = smooth_kernel(q, self._drag.joints, self.support_lengths)
        return support_step(1.0 - np.einsum("ni,ij,nj->n", kernel, self.support, kernel))

    def covariance(self, joints: ArrayLike) -> Array:
        """Compute the covariance of what `readings` leaves of the pull.

        The process' own, inflated; and, where the pull isn't taken whole, what is not taken.

        Args:
            joints: (d,) of one pose, m and rad.

        Returns:
            (6, 6), N and N.m squared, in ft_sensor.

        """
        q = np.asarray(joints, dtype=float)[None]
        left = (1.0 - self.weights(q)[0]) * self.means(q)[0]
        own = self.process_covariance(joints) * self._drag.inflation**2
        return np.asarray(own + np.outer(left, left))

    def process_covariance(self, joints: ArrayLike) -> Array:
        """Compute the covariance of the pull given the sweep, as the process has it.

        Args:
            joints: (d,) of one pose, m and rad.

        Returns:
            (6, 6), N and N.m squared, in ft_sensor, not inflated.

        """
        q = self._drag.arm.nearest(joints, self.middle)[None]
        across = prior_covariance(self._drag, q, self._drag.joints)
        known = across @ cho_solve(self._factor, across.T)
        return np.asarray(prior_covariance(self._drag, q, q) - known)
