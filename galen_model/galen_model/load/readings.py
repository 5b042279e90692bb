# SPDX-License-Identifier: Apache-2.0
"""Averaged readings of still poses, and the problem that they pose to whoever asks for the loads.

The model is linear in the loads' moments x = (m, h = m p) (see `galen_model.load.model`), with
G(theta) the gravity regressor and G_0 the one at the pose where the sensor was zeroed:

    sweep without the tool:   y_i = (G(theta_i) - G_0) x_b               + o_bare
    sweep with the tool:      y_i = G(theta_i) x_t + (G(theta_i) - G_0) x_b + o_tool

x_t belongs to the tool, x_b to the adapter ("bias load"). The offsets o hold what the zeroing left
and how far the sensor had drifted when each sweep was made; they are free and apart, so that a slow
drift between the two sweeps reaches neither mass nor centre. They are the constant case of the
biases of `galen_model.estimation.problem`. The mounting (`galen_model.load.mounting`) enters as a
few parameters in which the readings are linear near their values
(`galen_model.load.reading_model`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.estimation.problem import Known, Problem
from galen_model.load.model import gravity_regressor
from galen_model.load.mounting import entities
from galen_model.load.reading_model import (
    JointPoses,
    MountedSweep,
    OrientedPoses,
    ReadingModel,
)

_UNOBSERVED_MOMENT_STD_KGM = 0.01  # 100 g at 100 mm: wider than any adapter's first moment
_TOOL, _ADAPTER = slice(0, 4), slice(4, 8)
_RIVALS = ("joint_zero",), ("joint_zero", "base_inclination")


@dataclass(frozen=True)
class StillPoses:
    """Averaged readings of n still poses of one sweep.

    angles: (n, k) of the turning joints, rad; wrench: (n, 6) N and N.m; std_of_mean: (n, 6), the
    averaged reading's standard deviation from the scatter within each pose, or None; time_s: (n,)
    when each was taken, s from anywhere, or None. A bias that drifts needs it. temperature_c: (n,)
    of the sensor, deg C, or None.
    """

    angles: Array
    wrench: Array
    std_of_mean: Array | None = None
    time_s: Array | None = None
    arm: Arm = field(kw_only=True)
    temperature_c: Array | None = None

    def __post_init__(self) -> None:
        """Check shapes and values; raises IdentificationError."""
        count, names = len(self.angles), self.arm.turning_names
        if self.angles.shape != (count, len(names)):
            raise IdentificationError(
                f"angles of the still poses have shape {self.angles.shape}; expected ({count},"
                f" {len(names)}) for {', '.join(names)}"
            )
        if self.wrench.shape != (count, 6):
            raise IdentificationError(
                f"wrenches of the still poses have shape {self.wrench.shape}; expected ({count}, 6)"
            )
        named = {"angles": self.angles, "wrench": self.wrench}
        for name, column in (("time", self.time_s), ("temperature", self.temperature_c)):
            if column is not None:
                if column.shape != (count,):
                    raise IdentificationError(
                        f"angles and {name} of the still poses differ in length"
                    )
                named[name] = column
        for name, values in named.items():
            if not np.all(np.isfinite(values)):
                raise IdentificationError(f"{name} of the still poses holds a non-finite value")

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.angles)

    @property
    def gravity(self) -> Array:
        """Gravity (n, 3) in ft_sensor, m/s^2."""
        return self.arm.gravity_in_sensor(self.angles)

    @property
    def noise(self) -> Array | None:
        """Standard deviation (6,) of an averaged reading, N and N.m; None where it is not known."""
        if self.std_of_mean is None:
            return None
        return np.asarray(np.sqrt(np.mean(self.std_of_mean**2, axis=0)))

    def take(self, rows: np.ndarray) -> StillPoses:
        """Select some of the poses.

        Args:
            rows: mask (n,).

        Returns:
            Those poses.

        """

        def part(column: Array | None) -> Array | None:
            return None if column is None else column[rows]

        return StillPoses(
            self.angles[rows],
            self.wrench[rows],
            part(self.std_of_mean),
            part(self.time_s),
            part(self.temperature_c),
            arm=self.arm,
        )


@dataclass(frozen=True)
class LoadReadings:
    """n readings, and what hangs on the sensor at each.

    sweeps, zero: see `ReadingModel`; wrench (n, 6), N and N.m; gravity (n, 3) in the sensor, m/s^2;
    time_s (n,) s or None; temperature_c (n,) deg C or None. known: of the loads' moments; zeroed:
    as `Problem` has it. rivals: groups of the mounting that explain weights as a rotation of the
    sensor does, and leave pushes as they are.
    """

    sweeps: tuple[MountedSweep, ...]
    zero: JointPoses
    wrench: Array
    gravity: Array
    time_s: Array | None = None
    temperature_c: Array | None = None
    known: Known | None = None
    zeroed: bool = False
    rivals: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def of_orientations(
        cls,
        gravity: ArrayLike,
        wrench: ArrayLike,
        base_from_sensor: Array | None = None,
        *,
        arm: Arm,
    ) -> LoadReadings:
        """Make the readings of one load from orientations alone.

        Args:
            gravity: (n, 3) in the sensor's frame for a level base, m/s^2.
            wrench: (n, 6), N and N.m.
            base_from_sensor: R_base_sensor (n, 3, 3); None: an inclination of the base has no
                effect.
            arm: whose sensor it is.

        Returns:
            Readings of one sweep, without times.

        """
        level = np.asarray(gravity, dtype=float)
        sweep = MountedSweep(OrientedPoses(level, base_from_sensor), _TOOL, None)
        return cls((sweep,), zeroing_pose(None, arm), np.asarray(wrench, dtype=float), level)

    @classmethod
    def of_one_load(cls, tool: StillPoses) -> LoadReadings:
        """Make the readings of a sweep, tool and adapter being one load.

        Args:
            tool: the sweep.

        Returns:
            Its readings, with 4 moments.

        """
        sweep = MountedSweep(JointPoses(tool.angles, tool.arm), _TOOL, None)
        return cls(
            (sweep,), zeroing_pose(None, tool.arm), tool.wrench, tool.gravity, tool.time_s,
            tool.temperature_c, rivals=_RIVALS,
        )  # fmt: skip

    @classmethod
    def of_one_sweep(cls, tool: StillPoses, zero_angles: ArrayLike | None) -> LoadReadings:
        """Make the readings of a sweep of a sensor that was zeroed without the tool.

        The readings say nothing of the adapter's first moment along gravity there.

        Args:
            tool: the sweep.
            zero_angles: (k,) where the sensor was zeroed, rad; None: the arm's home.

        Returns:
            Its readings, with 8 moments and that moment known to be small.

        """
        zero = zeroing_pose(zero_angles, tool.arm)
        along = np.zeros((1, 8))
        gravity_zero = tool.arm.gravity_in_sensor(zero.angles[0])
        along[0, 5:8] = gravity_zero / np.linalg.norm(gravity_zero)
        known = Known(along, np.zeros(1), np.array([_UNOBSERVED_MOMENT_STD_KGM]))
        sweep = MountedSweep(JointPoses(tool.angles, tool.arm), _TOOL, _ADAPTER)
        return replace(cls.of_one_load(tool), sweeps=(sweep,), zero=zero, known=known, zeroed=True)

    @classmethod
    def of_two_sweeps(
        cls, bare: StillPoses, tool: StillPoses, zero_angles: ArrayLike | None
    ) -> LoadReadings:
        """Make the readings of a sweep without the tool and one with it.

        Args:
            bare: the sweep without the tool.
            tool: the sweep with it, of the same arm.
            zero_angles: (k,) where the sensor was zeroed, rad; None: the arm's home.

        Returns:
            Readings of both, with 8 moments; times and temperatures only where both sweeps have
            them.

        """

        def joined(first: Array | None, second: Array | None) -> Array | None:
            return None if first is None or second is None else np.concatenate([first, second])

        return cls(
            (
                MountedSweep(JointPoses(bare.angles, bare.arm), None, _ADAPTER),
                MountedSweep(JointPoses(tool.angles, tool.arm), _TOOL, _ADAPTER),
            ),
            zeroing_pose(zero_angles, tool.arm),
            np.concatenate([bare.wrench, tool.wrench]),
            np.concatenate([bare.gravity, tool.gravity]),
            joined(bare.time_s, tool.time_s),
            joined(bare.temperature_c, tool.temperature_c),
            rivals=_RIVALS,
        )

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.wrench)

    @property
    def loads(self) -> int:
        """Return the number of the loads' moments, 4 or 8."""
        return 4 if all(sweep.adapter is None for sweep in self.sweeps) else 8

    @property
    def segment(self) -> np.ndarray:
        """Which sweep (n,) each reading belongs to."""
        return np.repeat(np.arange(len(self.sweeps)), [len(s.poses) for s in self.sweeps])

    @property
    def order_s(self) -> Array:
        """Times (n,), s; where they are not known, the order."""
        return np.arange(float(len(self))) if self.time_s is None else self.time_s

    def model(self, groups: Sequence[str] = ()) -> ReadingModel:
        """Make the readings a function of the loads and of the mounting.

        Args:
            groups: names of the mounting's parameters, as of `entities`.

        Returns:
            The model.

        Raises:
            IdentificationError: a group can't be estimated for this arm.

        """
        return ReadingModel(self.sweeps, self.zero, entities(groups, self.zero.arm), self.loads)

    def linearised(self, model: ReadingModel, values: Array) -> Problem:
        """Make the problem linear near some values.

        Args:
            model: of these readings.
            values: (p,) loads' moments, then the mounting's values.

        Returns:
            The problem, whose unknowns are the values themselves, not their changes.

        """
        expected, jacobian = model.evaluate(values)
        known = None if self.known is None else self.known.beside(len(model.entities))
        return Problem(
            jacobian,
            self.wrench - expected + jacobian @ values,
            self.order_s,
            self.segment,
            known,
            self.zeroed,
            self.temperature_c,
        )

    @cached_property
    def of_loads(self) -> Problem:
        """The linear problem of the loads alone, without a mounting."""
        return self.linearised(self.model(), np.zeros(self.loads))

    def affine(self) -> Problem:
        """Return the problem in which each axis is affine in gravity, sweep by sweep.

        Gains, crosstalk and rotations of the sensor are in it.
        """
        rows = np.zeros((len(self), 6, len(self.sweeps), 6, 3))
        for channel in range(6):
            rows[np.arange(len(self)), channel, self.segment, channel] = self.gravity
        return Problem(rows.reshape(len(self), 6, -1), self.wrench, self.order_s, self.segment)


def zeroing_pose(zero_angles: ArrayLike | None, arm: Arm) -> JointPoses:
    """Return the pose at which the sensor was zeroed.

    Args:
        zero_angles: (k,), rad; None: the arm's home.
        arm: whose joints they are.

    Returns:
        One pose.

    """
    at = arm.home_angles if zero_angles is None else np.asarray(zero_angles, dtype=float)
    return JointPoses(at[None], arm)


def with_offsets(design: Array, segment: np.ndarray | None = None) -> Array:
    """Append columns of six offsets for each sweep to a design.

    Args:
        design: (n, 6, p).
        segment: (n,) which sweep each is of, from 0 on; None: one sweep.

    Returns:
        (n, 6, p + 6 sweeps), the offsets sweep by sweep.

    """
    which = np.zeros(len(design), dtype=int) if segment is None else segment
    offsets = np.zeros((len(design), 6, int(which.max(initial=0)) + 1, 6))
    for channel in range(6):
        offsets[np.arange(len(design)), channel, which, channel] = 1.0
    return np.concatenate([design, offsets.reshape(len(design), 6, -1)], axis=2)


def single_load_design(gravity: Array) -> Array:
    """Compute the columns of one load's moments (4) and six offsets.

    Args:
        gravity: (n, 3) along the sensor's axes, m/s^2.

    Returns:
        (n, 6, 10).

    """
    return with_offsets(gravity_regressor(gravity))
