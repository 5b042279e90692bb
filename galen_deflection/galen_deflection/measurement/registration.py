# SPDX-License-Identifier: Apache-2.0
"""Where the tracker's markers are on the arm: the 2019 report's eqs. (13) and (14), checked.

The report takes g_fB = g_Tf^-1 g_Tt g_Bt^-1 (f the base's marker, T the tracker, t the tool's
marker, B base_link) from one pose, and then reads the tool in the base as g_fB^-1 g_Tf^-1 g_Tt (its
eq. (14) prints p_Tt for g_Tt). Here, with W = g_fB^-1 the base's marker in base_link, Y the tool's
marker in tool_tip, M_i the tool's marker in the base's marker and F(q_i) the tip by the joints,

    W M_i Y^-1 = F(q_i)   at every position i without contact,

is solved by weighted least squares over all of them. With Y known to be the identity, one position
gives W, and each further one checks it.

Effects of a wrong arm: a wrong tip and a wrong zero of the last joint are fixed in the tool, and so
exactly the same as a Y; with Y held they show as soon as the orientation differs between the
positions, and with Y estimated they vanish in it. A wrong zero of a joint before it turns all about
an axis that moves with the platform: W takes the turn up, and the residual is the turn times the
platform's way between positions. Wrong zeros of the platform's joints are W's translation, and do
not show at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.distributions import chi2_isf
from galen_model.registration import (
    IDENTITY,
    Transform,
    mean_pose,
    solve_base,
    solve_base_and_offset,
    turns,
)
from galen_model.rotation import skew

from galen_deflection.measurement.push_recording import PushRecording
from galen_deflection.measurement.samples import DeflectionError


class RegistrationError(DeflectionError):
    """The tracker can't be registered to the arm, or the registration doesn't hold."""


MAX_RESIDUAL_M, MAX_RESIDUAL_RAD = 1.0e-4, 3.5e-4
"""A position fails the check when its residual is more than chance makes it, and longer than this:
twice the length of a tracker's noise of 0.03 mm and 0.1 mrad an axis."""

_ITERATIONS = 30
_FALSE_ALARMS_A_REGISTRATION = 1e-3
# Directions of a position's residual of which the fit takes up nearly all don't check anything.
_LEAST_REDUNDANCY = 1e-3
_QUANTUM_M, _QUANTUM_RAD = 5e-6, 5e-5  # of the encoders
_BLOCK = 10
_LEAST_SAMPLES = 10
_NOT_IDENTIFIABLE = "the tool marker's own offset is not identifiable from these positions"


@dataclass(frozen=True)
class RestPose:
    """The arm at rest, without contact, for some samples.

    joints (j,): m, rad. marker: mean of the tool's marker in the base's. noise (6,): standard
    deviation of one sample along the base marker's axes, m and rad; covariance (6, 6) of the mean,
    along these axes: of the tracker's noise alone.
    """

    position: int
    joints: Array
    marker: Transform
    noise: Array
    covariance: Array


@dataclass(frozen=True)
class PositionCheck:
    """The residual (6,) at a position, m and rad in base_link, by the other positions' fit.

    distance: length of the residual in units of its expected standard deviation; limit: what chance
    makes of it at most. NaN where the other positions don't determine this one.
    """

    position: int
    residual: Array
    distance: float
    limit: float
    holds: bool

    def __str__(self) -> str:
        """Describe it in words."""
        return (
            f"position {self.position} is off by"
            f" {1e3 * np.linalg.norm(self.residual[:3]):.3f} mm and"
            f" {1e3 * np.linalg.norm(self.residual[3:]):.3f} mrad from where the others' fit has it"
            f" ({self.distance:.1f} sigma; by chance up to {self.limit:.1f})"
        )


@dataclass(frozen=True)
class Registration:
    """The markers' places, and how well they are known.

    base_marker: in base_link (W); tool_marker: in tool_tip (Y). covariance (12, 12): of both,
    translation (m) and rotation vector (rad; turned from the left), zero for a Y that was given.
    """

    base_marker: Transform
    tool_marker: Transform
    covariance: Array
    checks: tuple[PositionCheck, ...]
    problems: tuple[str, ...]

    def tip(self, marker: Transform) -> Transform:
        """Return tool_tip in base_link: eq. (14).

        Args:
            marker: poses (n) of the tool's marker in the base's, by the tracker.

        Returns:
            Poses (n).

        """
        return self.base_marker @ marker @ self.tool_marker.inverse()


def rest_poses(recording: PushRecording, stand: int) -> list[RestPose]:
    """Return one rest for each visit's phase before its first push.

    The covariance counts how long the noise is correlated in time.

    Args:
        recording: samples, with their phases without contact.
        stand: number of the base marker's stand, as in `recording.stands`.

    Returns:
        Rests in the order of positions and visits; none of phases of fewer than ten samples.

    """
    rows = recording.untouched & (recording.stand == stand)
    found = []
    which = np.stack([recording.position, recording.visit], axis=1)
    for key in np.unique(which[rows], axis=0):
        here = np.flatnonzero(rows & np.all(which == key, axis=1))
        if len(here) < _LEAST_SAMPLES:
            continue
        mean, std, used = mean_pose(recording.marker[here])
        off = recording.marker[here][used].displacement_from(mean)
        found.append((int(key[0]), here, mean, std, off))
    if not found:
        return []
    more = _correlation([off for *_, off in found])
    return [
        RestPose(
            position,
            recording.joints[here].mean(axis=0),
            mean,
            std,
            more * (off.T @ off) / (len(off) - 1) / len(off),
        )
        for position, here, mean, std, off in found
    ]


def _correlation(parts: Sequence[Array]) -> float:
    """How much larger the variance of a mean is than by white noise, at least 1."""
    ratios, weights = [], []
    for off in parts:
        count = len(off) // _BLOCK
        if count < 2:
            continue
        blocks = off[: count * _BLOCK].reshape(count, _BLOCK, 6).mean(axis=1)
        variance = np.maximum(off.var(axis=0, ddof=1), 1e-30)
        ratios.append(np.mean(_BLOCK * blocks.var(axis=0, ddof=1) / variance))
        weights.append(count - 1)
    return float(max(1.0, np.average(ratios, weights=weights))) if ratios else 1.0


def register(
    rests: Sequence[RestPose], tip_m: Array, estimate_offset: bool = False, *, arm: Arm
) -> Registration:
    """Register the tracker on rests of the arm.

    Args:
        rests: of one stand of the base's marker.
        tip_m: (3,) in ft_sensor.
        estimate_offset: estimate the tool marker's pose in tool_tip (Y); else it is the identity.
        arm: the arm that stood there.

    Returns:
        Both markers' places, with a check of each rest.

    Raises:
        RegistrationError: there is no rest, the tool marker's own offset is to be estimated and is
            not identifiable, or a position doesn't agree with the others.

    """
    if not rests:
        raise RegistrationError(
            "nowhere in the recording the arm stands untouched before its first push: leave it"
            " alone for a second or more at each position, and give the file of the tool that is on"
        )
    fit = _Fit(rests, np.asarray(tip_m, dtype=float), estimate_offset, arm)
    if estimate_offset:
        fit.require_turns()
    fit.solve()
    if estimate_offset:
        fit.require_offset_known()
    checks = fit.checks()
    failed = [check for check in checks if not check.holds]
    if failed:
        worst = max(failed, key=lambda check: check.distance)
        more = f"; so are {len(failed) - 1} more of {len(checks)}" if len(failed) > 1 else ""
        hint = "" if estimate_offset else _hint(rests, tip_m, arm)
        raise RegistrationError(f"the registration does not hold: {worst}{more}{hint}")
    problems = [
        f"{check}: accepted, but more than noise"
        for check in checks
        if check.distance > check.limit
    ]
    if not any(np.isfinite(check.distance) for check in checks):
        problems.append("registered at one position: nothing checks that it holds elsewhere")
    return Registration(fit.base, fit.tool_marker, fit.covariance(), checks, tuple(problems))


def _hint(rests: Sequence[RestPose], tip_m: Array, arm: Arm) -> str:
    """Whether an offset of the tool's marker would explain it."""
    try:
        other = register(rests, tip_m, True, arm=arm)
    except RegistrationError:
        return ""
    off = other.tool_marker.displacement_from(IDENTITY)
    shift = ", ".join(f"{1e3 * value:.2f}" for value in off[:3])
    turn = ", ".join(f"{1e3 * value:.2f}" for value in off[3:])
    return (
        f"; it holds with the tool's marker off by ({shift}) mm and ({turn}) mrad: estimate it, or"
        " look for another tip or an offset of the last joint's zero, which have the same effect"
    )


class _Fit:
    """Gauss-Newton over W and, if asked for, Y; errors in base_link, weighted by their noise.

    The unknowns are steps (translation, rotation vector) of W, and of Z = Y^-1: t_W + b,
    exp(a) R_W, t_Z + d, R_Z exp(c).
    """

    def __init__(
        self, rests: Sequence[RestPose], tip_m: Array, estimate_offset: bool, arm: Arm
    ) -> None:
        self._rests = rests
        joints = np.array([rest.joints for rest in rests])
        self._marker = Transform(
            np.array([rest.marker.rotation for rest in rests]),
            np.array([rest.marker.translation for rest in rests]),
        )
        self._tip = Transform(*arm.tip_pose(joints, tip_m))
        self._turns = turns(self._tip.rotation)
        if estimate_offset and len(rests) >= 3:
            self.base, offset = solve_base_and_offset(self._marker, self._tip)
        else:
            offset = IDENTITY
            self.base = solve_base(self._marker, self._tip, offset)
        self._back = offset.inverse()
        tracker = np.array([rest.covariance for rest in rests])
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = self.base.rotation
        # The tracker's noise is that of the marker; the tip's, over the lever between them.
        lever = np.broadcast_to(np.eye(6), tracker.shape).copy()
        lever[:, :3, 3:] = -skew(
            np.einsum(
                "ij,njk,k->ni", self.base.rotation, self._marker.rotation, self._back.translation
            )
        )
        # An encoder's rounding stays while the arm stands.
        quantum = np.array([_QUANTUM_M if unit == "m" else _QUANTUM_RAD for unit in arm.units])
        spread = quantum**2 / 12.0
        jacobians = arm.tip_jacobian(joints, tip_m)
        to_tip = lever @ turn
        covariance = to_tip @ tracker @ np.swapaxes(to_tip, 1, 2)
        covariance += (jacobians * spread) @ np.swapaxes(jacobians, 1, 2)
        try:
            self.root = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            raise RegistrationError(
                "the tool's marker does not scatter along some axis: its poses aren't measured"
            ) from None
        self._unknowns = 12 if estimate_offset else 6
        self._information = np.zeros((self._unknowns, self._unknowns))

    @property
    def tool_marker(self) -> Transform:
        """Y."""
        return self._back.inverse()

    def require_turns(self) -> None:
        """Raise RegistrationError unless there are three positions with turns about two axes."""
        positions = len({rest.position for rest in self._rests})
        if positions < 3:
            raise RegistrationError(
                f"the tool marker's own offset is not identifiable from {positions} position"
                f"{'s' if positions > 1 else ''}: it needs three or more, with the tool turned"
                " about two axes between them"
            )
        noise = float(np.median([rest.noise[3:] for rest in self._rests]))
        if self._turns[1] < 10.0 * noise:
            raise RegistrationError(
                f"{_NOT_IDENTIFIABLE}: between them the tool turns about one axis only"
                f" ({1e3 * self._turns[0]:.1f} mrad, and {1e3 * self._turns[1]:.2f} mrad about any"
                " other): two joints that turn the tool must both differ"
            )

    def solve(self) -> None:
        """Iterate from the closed form to the least squares' solution."""
        for _ in range(_ITERATIONS):
            error, rows = self._linearised()
            self._information = np.einsum("nki,nkj->ij", rows, rows)
            try:
                step = np.linalg.solve(self._information, -np.einsum("nki,nk->i", rows, error))
            except np.linalg.LinAlgError:
                raise RegistrationError(_NOT_IDENTIFIABLE) from None
            self.base = self.base.displaced(step[:6])
            if self._unknowns == 12:
                turned = Transform(self._back.rotation.T, np.zeros(3)).displaced(
                    np.concatenate([np.zeros(3), -step[9:]])
                )
                self._back = Transform(turned.rotation.T, self._back.translation + step[6:9])
            if float(step @ self._information @ step) < 1e-12:
                return
        raise RegistrationError("the registration does not settle: the positions don't agree")

    def require_offset_known(self) -> None:
        """Raise RegistrationError unless Y is better known than by one sample of the tracker."""
        if np.linalg.cond(self._information) > 1e18:
            raise RegistrationError(_NOT_IDENTIFIABLE)
        covariance = self.covariance()[6:, 6:]
        for name, block, rows in (
            ("mm", covariance[:3, :3], slice(0, 3)),
            ("mrad", covariance[3:, 3:], slice(3, 6)),
        ):
            values, axes = np.linalg.eigh(block)
            std = float(np.sqrt(values[-1]))
            limit = float(np.median([rest.noise[rows] for rest in self._rests]))
            if std > limit:
                axis = ", ".join(f"{value:.2f}" for value in axes[:, -1])
                raise RegistrationError(
                    f"{_NOT_IDENTIFIABLE}: along ({axis}) of tool_tip it is known to"
                    f" {1e3 * std:.3g} {name} only, worse than one sample of the tracker"
                    f" ({1e3 * limit:.3g} {name}); turn the tool further between positions (now"
                    f" {1e3 * self._turns[0]:.0f} and {1e3 * self._turns[1]:.0f} mrad about two"
                    " axes)"
                )

    def checks(self) -> tuple[PositionCheck, ...]:
        """Return the residual at each position by the fit to the others.

        By the residuals e and their covariance S = C - J P J^T (C the pose's own, P the fit's):
        in the whitened coordinates in which S is diagonal, r, the residual by the others' fit is
        e / r and its distance e^2 / r, summed over those r that aren't 0 (the deleted residual;
        Cook & Weisberg, *Residuals and Influence in Regression*, 1982, section 2.2).
        """
        error, rows = self._linearised()
        covariance = np.linalg.inv(self._information)
        false_alarms = _FALSE_ALARMS_A_REGISTRATION / len(self._rests)
        found = []
        for rest, e, j, root in zip(self._rests, error, rows, self.root, strict=True):
            redundancy, axes = np.linalg.eigh(np.eye(6) - j @ covariance @ j.T)
            checked = redundancy > _LEAST_REDUNDANCY
            freedom = int(checked.sum())
            if not freedom:
                unknown = PositionCheck(rest.position, np.full(6, np.nan), np.nan, np.nan, True)
                found.append(unknown)
                continue
            axes, redundancy = axes[:, checked], redundancy[checked]
            along = axes.T @ e
            residual = root @ axes @ (along / redundancy)
            distance = float(np.sqrt(np.sum(along**2 / redundancy)))
            limit = float(np.sqrt(chi2_isf(false_alarms, freedom)))
            large = (
                np.linalg.norm(residual[:3]) > MAX_RESIDUAL_M
                or np.linalg.norm(residual[3:]) > MAX_RESIDUAL_RAD
            )
            holds = not (distance > limit and large)
            found.append(PositionCheck(rest.position, residual, distance, limit, holds))
        return tuple(found)

    def covariance(self) -> Array:
        """Return that (12, 12) of W and Y, as `Registration` has it."""
        parameters = np.linalg.inv(self._information)
        covariance = np.zeros((12, 12))
        if self._unknowns == 6:
            covariance[:6, :6] = parameters
            return covariance
        # From steps of W and Z to those of W and Y = Z^-1: exp(c)^T R_Y turns R_Y by -c;
        # t_Y = -R_Y t_Z moves by t_Y x c - R_Y d.
        offset = self.tool_marker
        matrix = np.eye(12)
        matrix[6:9, 6:9] = -offset.rotation
        matrix[6:9, 9:] = skew(offset.translation)
        matrix[9:, 9:] = -np.eye(3)
        return np.asarray(matrix @ parameters @ matrix.T)

    def _linearised(self) -> tuple[Array, Array]:
        """Whitened errors (n, 6) of W M Z over F, and their derivatives (n, 6, unknowns)."""
        measured = self.base @ self._marker @ self._back
        error = measured.displacement_from(self._tip)
        rows = np.zeros((len(error), 6, self._unknowns))
        # log(exp(a) E) = e + (1 - e^/2 + O(e^2)) a
        left = np.eye(3) - 0.5 * skew(error[:, 3:])
        rows[:, :3, :3] = np.eye(3)
        rows[:, :3, 3:6] = -skew(measured.translation - self.base.translation)
        rows[:, 3:, 3:6] = left
        if self._unknowns == 12:
            rows[:, :3, 6:9] = self.base.rotation @ self._marker.rotation
            rows[:, 3:, 9:] = left @ measured.rotation
        whitened = np.linalg.solve(self.root, error[:, :, None])[:, :, 0]
        return np.asarray(whitened), np.asarray(np.linalg.solve(self.root, rows))
