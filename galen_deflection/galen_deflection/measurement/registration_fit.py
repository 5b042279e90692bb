"""The registration's least squares: two rigid transforms, their covariance, the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from galen_model.arm.galen import ENCODER_QUANTUM, GALEN, ArmParameters
from galen_model.arm.kinematics import tip_jacobian, tip_pose
from galen_model.arrays import Array
from galen_model.distributions import chi2_isf
from galen_model.registration.hand_eye import solve_base, solve_base_and_offset, turns
from galen_model.registration.rigid import IDENTITY, Transform
from galen_model.rotation import skew

from galen_deflection.errors import RegistrationError
from galen_deflection.measurement.rest_poses import RestPose

_ITERATIONS = 30
_FALSE_ALARMS_A_REGISTRATION = 1e-3
# Directions of a position's residual of which the fit takes up nearly all don't check anything.
_LEAST_REDUNDANCY = 1e-3


@dataclass(frozen=True)
class RegistrationSettings:
    """What is estimated, and when it holds.

    tool_marker: in tool_tip, where it is not estimated. A position fails the check when its
    residual is more than chance makes it, and longer than `max_residual_m` or turned by more
    than `max_residual_rad`: twice the length of a tracker's noise of 0.03 mm and 0.1 mrad an axis.
    With infinite limits all is told, and nothing rejected.
    joint_quantum (5,): step of the encoders, m and rad, whose rounding stays while the arm stands.
    """

    tool_marker: Transform = IDENTITY
    estimate_tool_marker: bool = False
    max_residual_m: float = 1.0e-4
    max_residual_rad: float = 3.5e-4
    joint_quantum: Array = field(default_factory=lambda: ENCODER_QUANTUM)
    arm: ArmParameters = GALEN


@dataclass(frozen=True)
class PositionCheck:
    """The residual (6,) at a position, m and rad in base_link, by the other positions' fit.

    std (6,): expected; distance: length of the residual in units of it; limit: what chance makes
    of it at most. All NaN where the other positions don't determine this one.
    """

    position: int
    visit: int
    residual: Array
    std: Array
    distance: float
    limit: float
    holds: bool

    def __str__(self) -> str:
        """In words."""
        return (
            f"position {self.position} stands off by"
            f" {1e3 * np.linalg.norm(self.residual[:3]):.3f} mm and"
            f" {1e3 * np.linalg.norm(self.residual[3:]):.3f} mrad from where the others' fit has it"
            f" ({self.distance:.1f} sigma; by chance up to {self.limit:.1f})"
        )


class RegistrationFit:
    """Gauss-Newton over W and, if asked for, Y; errors in base_link, weighted by their noise.

    The unknowns are steps (translation, rotation vector) of W, and of Z = Y^-1: t_W + b,
    exp(a) R_W, t_Z + d, R_Z exp(c).
    """

    def __init__(
        self, rests: Sequence[RestPose], tip_m: Array, settings: RegistrationSettings
    ) -> None:
        self._rests = rests
        self._settings = settings
        self._joints = np.array([rest.joints for rest in rests])
        self._marker = Transform(
            np.array([rest.marker.rotation for rest in rests]),
            np.array([rest.marker.translation for rest in rests]),
        )
        self._tip = Transform(*tip_pose(self._joints, tip_m, settings.arm))
        self.turns = turns(self._tip.rotation)
        if settings.estimate_tool_marker and len(rests) >= 3:
            self.base, offset = solve_base_and_offset(self._marker, self._tip)
        else:
            offset = settings.tool_marker
            self.base = solve_base(self._marker, self._tip, offset)
        self._back = offset.inverse()
        tracker = np.array([rest.covariance for rest in rests])
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = self.base.rotation
        # The tracker's noise is that of the marker; the tip's, over the lever between them.
        lever = np.broadcast_to(np.eye(6), tracker.shape).copy()
        lever[:, :3, 3:] = -skew(
            np.einsum(
                "ij,njk,k->ni",
                self.base.rotation,
                self._marker.rotation,
                self._back.translation,
            )
        )
        spread = np.asarray(settings.joint_quantum) ** 2 / 12.0
        jacobians = np.array([tip_jacobian(q, tip_m, settings.arm) for q in self._joints])
        self._to_tip = lever @ turn
        of_tracker = self._to_tip @ tracker @ np.swapaxes(self._to_tip, 1, 2)
        self._covariance = of_tracker + (jacobians * spread) @ np.swapaxes(jacobians, 1, 2)
        try:
            self.root = np.linalg.cholesky(self._covariance)
        except np.linalg.LinAlgError:
            raise RegistrationError(
                "the tool's marker does not scatter along some axis: its poses aren't measured"
            ) from None
        self._unknowns = 12 if settings.estimate_tool_marker else 6
        self._information = np.zeros((self._unknowns, self._unknowns))

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
        if self.turns[1] < 10.0 * noise:
            raise RegistrationError(
                "the tool marker's own offset is not identifiable from these positions: between"
                f" them the tool turns about one axis only ({1e3 * self.turns[0]:.1f} mrad, and"
                f" {1e3 * self.turns[1]:.2f} mrad about any other): tilt and roll must both differ"
            )

    def solve(self) -> None:
        """Iterate from the closed form to the least squares' solution."""
        for _ in range(_ITERATIONS):
            error, rows = self._linearised()
            self._information = np.einsum("nki,nkj->ij", rows, rows)
            try:
                step = np.linalg.solve(self._information, -np.einsum("nki,nk->i", rows, error))
            except np.linalg.LinAlgError:
                raise RegistrationError(
                    "the tool marker's own offset is not identifiable from these positions"
                ) from None
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
        """Raise RegistrationError unless Y is known better than one sample of the tracker tells."""
        covariance = self._offset_covariance()
        for name, block, unit, noise in (
            ("mm", covariance[:3, :3], 1e3, [rest.noise[:3] for rest in self._rests]),
            ("mrad", covariance[3:, 3:], 1e3, [rest.noise[3:] for rest in self._rests]),
        ):
            values, axes = np.linalg.eigh(block)
            std, limit = float(np.sqrt(values[-1])), float(np.median(noise))
            if std > limit:
                axis = ", ".join(f"{value:.2f}" for value in axes[:, -1])
                raise RegistrationError(
                    "the tool marker's own offset is not identifiable from these positions: along"
                    f" ({axis}) of tool_tip it is known to {std * unit:.3g} {name} only, worse"
                    f" than one sample of the tracker ({limit * unit:.3g} {name}); turn the tool"
                    f" further between positions (now {1e3 * self.turns[0]:.0f} and"
                    f" {1e3 * self.turns[1]:.0f} mrad about two axes)"
                )

    def checks(self) -> tuple[PositionCheck, ...]:
        """The residual at each position by the fit to the others.

        By the residuals e and their covariance S = C - J P J^T (C the pose's own, P the fit's):
        in the whitened coordinates in which S is diagonal, r, the residual by the others' fit is
        e / r and its distance e^2 / r, summed over those r that aren't 0 (the deleted residual;
        Cook & Weisberg, *Residuals and Influence in Regression*, 1982, section 2.2).
        """
        error, rows = self._linearised()
        covariance = np.linalg.inv(self._information)
        found = []
        for rest, e, j, root in zip(self._rests, error, rows, self.root, strict=True):
            redundancy, axes = np.linalg.eigh(np.eye(6) - j @ covariance @ j.T)
            told = redundancy > _LEAST_REDUNDANCY
            freedom = int(told.sum())
            if not freedom:
                nothing = np.full(6, np.nan)
                found.append(
                    PositionCheck(rest.position, rest.visit, nothing, nothing, np.nan, np.nan, True)
                )
                continue
            axes, redundancy = axes[:, told], redundancy[told]
            along = axes.T @ e
            residual = root @ axes @ (along / redundancy)
            spread = root @ axes / np.sqrt(redundancy)
            distance = float(np.sqrt(np.sum(along**2 / redundancy)))
            false_alarms = _FALSE_ALARMS_A_REGISTRATION / len(self._rests)
            limit = float(np.sqrt(chi2_isf(false_alarms, freedom)))
            large = (
                np.linalg.norm(residual[:3]) > self._settings.max_residual_m
                or np.linalg.norm(residual[3:]) > self._settings.max_residual_rad
            )
            found.append(
                PositionCheck(
                    rest.position,
                    rest.visit,
                    residual,
                    np.sqrt(np.sum(spread**2, axis=1)),
                    distance,
                    limit,
                    not (distance > limit and large),
                )
            )
        return tuple(found)

    def covariance(self) -> Array:
        """(12, 12) of W and Y, as `registration.Registration` has it."""
        covariance = np.zeros((12, 12))
        parameters = np.linalg.inv(self._information)
        if self._unknowns == 12:
            to_offset = self._to_offset()
            return np.asarray(to_offset @ parameters @ to_offset.T)
        covariance[:6, :6] = parameters
        return covariance

    def sample_noise(self) -> Array:
        """Standard deviation (6,) of one measured pose of the tip, in base_link."""
        weight = np.array([rest.samples for rest in self._rests], dtype=float)
        noise = np.array([rest.noise for rest in self._rests])
        variance = np.einsum("nij,nj->ni", self._to_tip**2, noise**2)
        return np.asarray(np.sqrt(np.average(variance, axis=0, weights=weight)))

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

    @property
    def tool_marker(self) -> Transform:
        """Y."""
        return self._back.inverse()

    def _to_offset(self) -> Array:
        """(12, 12): from steps of W and Z to those of W and Y = Z^-1.

        exp(c)^T R_Y turns R_Y by -c; t_Y = -R_Y t_Z moves by t_Y x c - R_Y d.
        """
        offset = self.tool_marker
        matrix = np.eye(12)
        matrix[6:9, 6:9] = -offset.rotation
        matrix[6:9, 9:] = skew(offset.translation)
        matrix[9:, 9:] = -np.eye(3)
        return matrix

    def _offset_covariance(self) -> Array:
        if np.linalg.cond(self._information) > 1e18:
            raise RegistrationError(
                "the tool marker's own offset is not identifiable from these positions"
            )
        to_offset = self._to_offset()
        return np.asarray((to_offset @ np.linalg.inv(self._information) @ to_offset.T)[6:, 6:])
