"""An experiment that nobody has done yet, and what a nominal diagnosis would see of it.

A `Trial` is one recording of an experiment: still poses, a motion, or pushes. `signature` runs the
simulator with a hypothesis' effects along it and gives what the nominal simulator leaves of the
reading and of the tip that the tracker sees, in units of the noise, without noise. What isn't known
and is no gap (the sensor's zero, where base_link stands in `tracker`, how well the file knows its
load) are `free_columns` and `load_columns`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from galen_model.arm.galen import (
    SENSOR,
    TRACKER_POSITION_NOISE_M,
    TRACKER_ROTATION_NOISE_RAD,
)
from galen_model.arm.kinematics import gravity_in_sensor, sensor_pose
from galen_model.arrays import Array
from galen_model.evidence.columns import moment_covariance
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import Load, gravity_regressor
from galen_model.load.nominal_tools import ToolGeometry
from galen_model.rotation import matrix_to_rotvec, skew
from galen_sim_driver.effects.effect import Effect, Fitted, Instants, Posture
from galen_sim_driver.replay import Replay, Scene
from scipy.linalg import block_diag

_BASE_IN_TRACKER_M = np.array([1.2, 0.3, 0.2])
"""A tracker stands about so far away; only `tracker_scale` asks."""


def _tracker_std() -> Array:
    return np.repeat([TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD], 3)


@dataclass(frozen=True)
class Instruments:
    """Noise of sensor and tracker: of one sample, at these rates, and what no average takes away.

    All (6,): N and N.m; m and rad. The floors are estimates: half a quantum of the sensor, half of
    the tracker's noise.
    """

    wrench_std: Array = field(default_factory=lambda: np.asarray(SENSOR.noise_std))
    wrench_hz: float = 500.0
    wrench_floor: Array = field(default_factory=lambda: np.asarray(SENSOR.quantum) / 2.0)
    tracker_std: Array = field(default_factory=_tracker_std)
    tracker_hz: float = 60.0
    tracker_floor: Array = field(default_factory=lambda: 0.5 * _tracker_std())

    def wrench_mean_std(self, average_s: float) -> Array:
        """Of a wrench (6,) averaged for so long."""
        samples = max(average_s * self.wrench_hz, 1.0)
        return np.hypot(self.wrench_std / np.sqrt(samples), self.wrench_floor)

    def tracker_mean_std(self, average_s: float) -> Array:
        """Of a pose (6,) averaged for so long."""
        samples = max(average_s * self.tracker_hz, 1.0)
        return np.hypot(self.tracker_std / np.sqrt(samples), self.tracker_floor)


@dataclass(frozen=True)
class Trial:
    """One recording of an experiment.

    scene: its `reading` is not asked for. pushed (nw, 6): by a hand, in ft_sensor about its origin.
    unit (nw,), tracker_unit (nt,): the pose or position that a sample belongs to. wrench_std,
    tracker_std (6,): of one sample here, which may be an average. absent: names of the effects that
    can't act here, such as a tool's where it is off.
    """

    scene: Scene
    pushed: Array
    unit: np.ndarray
    tracker_unit: np.ndarray
    wrench_std: Array
    tracker_std: Array
    absent: frozenset[str] = frozenset()
    tool_on: bool = True

    @property
    def untouched(self) -> np.ndarray:
        """Where nobody pushes (nw,)."""
        return ~np.asarray(self.scene.touched, dtype=bool)

    @property
    def row_units(self) -> np.ndarray:
        """The unit of each row of `signature`."""
        wrench_units = np.repeat(self.unit[self.untouched], 6)
        return np.concatenate([wrench_units, np.repeat(self.tracker_unit, 6)])


@dataclass(frozen=True, eq=False)
class _Push(Effect):
    """A hand at the tool."""

    name: ClassVar[str] = "push"
    fitted: ClassVar[tuple[Fitted, ...]] = ()

    at_s: Array = field(default_factory=lambda: np.zeros(1))
    pushed: Array = field(default_factory=lambda: np.zeros((1, 6)))

    def wrench(self, when: Instants, posture: Posture) -> Array:
        """What it pushes at these times."""
        return _at(when.bag_s, self.at_s, self.pushed)


def _at(at_s: Array, known_s: Array, values: Array) -> Array:
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)


def signature(trial: Trial, effects: Sequence[Effect]) -> Array:
    """Rows (n,) in units of the noise: wrench, where nobody touches, then the tip (m, rad)."""
    effects = tuple(effect for effect in effects if effect.name not in trial.absent)
    scene = trial.scene
    push = _Push(scene.wrench_s, trial.pushed)
    reading = Replay(scene, (*effects, push)).reading()
    scene = replace(scene, reading=reading)
    nominal, true = Replay(scene), Replay(scene, effects)
    left = (reading - nominal.reading()) / trial.wrench_std
    rows = [left[trial.untouched].ravel()]
    if len(scene.tracker_s):
        late_s = sum(effect.wrench_delay_s for effect in effects)
        pushed = _at(scene.wrench_s - late_s, scene.wrench_s, trial.pushed)
        seen = true.seen_by_tracker(*true.tip(pushed), np.eye(3), _BASE_IN_TRACKER_M)
        expected = nominal.seen_by_tracker(*nominal.tip(), np.eye(3), _BASE_IN_TRACKER_M)
        turned = matrix_to_rotvec(seen[0] @ np.swapaxes(expected[0], 1, 2))
        moved = np.concatenate([seen[1] - expected[1], turned], axis=1)
        rows.append((moved / trial.tracker_std).ravel())
    return np.concatenate(rows)


def free_columns(trials: Sequence[Trial]) -> Array:
    """Columns (n, m) over the rows of all trials: what isn't known at all and is no gap.

    Of each trial the sensor's zero (6) and, with a tracker, base_link in `tracker` (6).
    """
    return np.asarray(block_diag(*(_free(trial) for trial in trials)))


def _free(trial: Trial) -> Array:
    scene = trial.scene
    zero = np.tile(np.diag(1.0 / trial.wrench_std), (int(trial.untouched.sum()), 1))
    count = len(scene.tracker_s)
    if not count:
        return zero
    _, position = Replay(scene).tip(np.zeros_like(scene.reading))
    shift = np.zeros((count, 6, 6))
    shift[:, :3, :3] = np.eye(3)
    shift[:, :3, 3:] = -skew(position)
    shift[:, 3:, 3:] = np.eye(3)
    base = (shift / trial.tracker_std[:, None]).reshape(-1, 6)
    free = np.zeros((len(zero) + len(base), 12))
    free[: len(zero), :6], free[len(zero) :, 6:] = zero, base
    return free


def moment_covariances(tool: CalibrationFile) -> tuple[Array, Array]:
    """Covariances (4, 4) of mass and first moment, of the tool and of the adapter.

    One sweep doesn't tell the two apart, and each alone is then known to nearly nothing; but their
    sum, which is what the sensor feels, is known well: such a file counts as exact.
    """
    parts = (tool.load, tool.adapter)
    if tool.unresolved:
        parts = (
            replace(tool.load, covariance=np.zeros((4, 4))),
            replace(tool.adapter, covariance=np.zeros((4, 4))),
        )
    return moment_covariance(parts[0]), moment_covariance(parts[1])


def load_columns(trials: Sequence[Trial], tool: CalibrationFile) -> Array:
    """Columns (n, 8): one standard deviation each of what the file doesn't know of its loads.

    With G(u) of `galen_model.load.model` and C = L L^T the covariance of mass and first moment:
    G(u) L of the tool, where it is on, and of the adapter.
    """
    factors = [np.linalg.cholesky(known) for known in moment_covariances(tool)]
    blocks = []
    for trial in trials:
        scene = trial.scene
        joints = _at(scene.wrench_s, scene.joint_s, scene.joints)[trial.untouched]
        regressor = gravity_regressor(gravity_in_sensor(joints[:, 3], joints[:, 4]))
        scaled = regressor / trial.wrench_std[:, None]
        columns = [scaled @ factors[0] * trial.tool_on, scaled @ factors[1]]
        wrench = np.concatenate(columns, axis=2).reshape(-1, 8)
        blocks.append(np.concatenate([wrench, np.zeros((6 * len(scene.tracker_s), 8))]))
    return np.concatenate(blocks)


def still_trial(
    poses: Array,
    at_s: Array,
    average_s: float,
    tool: CalibrationFile,
    instruments: Instruments,
    home: Array,
    *,
    tracker: bool = False,
    absent: frozenset[str] = frozenset(),
    tool_on: bool = True,
    start_s: float = 0.0,
) -> Trial:
    """Poses (n, 2), roll and tilt, rad, each averaged until at_s (n,), s; platform as at home (5,).

    Each joint is held during its average, so that a delay shows nothing here.
    """
    count = len(poses)
    joints = np.column_stack([np.tile(home[:3], (count, 1)), poses])
    joint_s = np.stack([at_s - average_s, at_s], axis=1).ravel()
    middle = at_s - 0.5 * average_s
    units = np.arange(count)
    scene = Scene(
        bag="sweep",
        start_s=start_s,
        joint_s=joint_s,
        joints=np.repeat(joints, 2, axis=0),
        wrench_s=middle,
        reading=np.zeros((count, 6)),
        touched=np.zeros(count, dtype=bool),
        tracker_s=middle if tracker else np.zeros(0),
        tool=_geometry(tool, tool_on),
        adapter=tool.adapter.load,
        zero_pose_rad=tool.zero_pose_rad,
    )
    return Trial(
        scene=scene,
        pushed=np.zeros((count, 6)),
        unit=units,
        tracker_unit=units if tracker else units[:0],
        wrench_std=instruments.wrench_mean_std(average_s),
        tracker_std=instruments.tracker_mean_std(average_s),
        absent=absent,
        tool_on=tool_on,
    )


_MOTION_STEP_S = 0.02
_MOTION_HZ = np.array([0.17, 0.23, 0.19, 0.21, 0.29])
_MOTION_SIZE = np.array([0.03, 0.03, 0.03, 0.7, 0.5])


def motion_trial(
    speed: float, length_s: float, tool: CalibrationFile, instruments: Instruments, home: Array
) -> Trial:
    """All joints swing about home (5,), `speed` times as fast as 0.2 Hz; one unit."""
    at_s = np.arange(0.0, length_s, _MOTION_STEP_S)
    phase = 2.0 * np.pi * speed * np.outer(at_s, _MOTION_HZ)
    joints = home + _MOTION_SIZE * np.sin(phase)
    count = len(at_s)
    scene = Scene(
        bag="motion",
        start_s=0.0,
        joint_s=at_s,
        joints=joints,
        wrench_s=at_s,
        reading=np.zeros((count, 6)),
        touched=np.zeros(count, dtype=bool),
        tracker_s=np.zeros(0),
        tool=_geometry(tool, True),
        adapter=tool.adapter.load,
        zero_pose_rad=tool.zero_pose_rad,
    )
    return Trial(
        scene=scene,
        pushed=np.zeros((count, 6)),
        unit=np.zeros(count, dtype=int),
        tracker_unit=np.zeros(0, dtype=int),
        wrench_std=instruments.wrench_mean_std(_MOTION_STEP_S),
        tracker_std=instruments.tracker_mean_std(_MOTION_STEP_S),
    )


_PUSH_STEP_S = 0.15
_BETWEEN_PLACES_S = 5.0
_PUSH_COURSE = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 0.75, 0.5, 0.25, 0.0])


def push_trial(
    places: Array, levels_n: Sequence[float], tool: CalibrationFile, instruments: Instruments
) -> Trial:
    """At each of places (n, 5), m and rad: a rest, then pushes to both sides along each axis.

    The force acts at the tip along the axes of base_link, up and down by steps of a quarter of its
    level, as collection_node asks for it; the tracker is on.
    """
    forces = [
        level * sign * axis for level in levels_n for axis in np.eye(3) for sign in (1.0, -1.0)
    ]
    course = np.concatenate([np.zeros((4, 3)), *(np.outer(_PUSH_COURSE, f) for f in forces)])
    in_sensor = np.concatenate([course @ sensor_pose(place)[0] for place in places])
    pushed = np.concatenate([in_sensor, np.cross(np.asarray(tool.tip_m), in_sensor)], axis=1)
    steps, count = len(course), len(places)
    number = np.arange(steps * count)
    at_s: Array = number * _PUSH_STEP_S + number // steps * _BETWEEN_PLACES_S
    units = np.repeat(np.arange(count), steps)
    scene = Scene(
        bag="push",
        start_s=0.0,
        joint_s=at_s,
        joints=np.repeat(places, steps, axis=0),
        wrench_s=at_s,
        reading=np.zeros((len(at_s), 6)),
        touched=np.any(pushed != 0.0, axis=1),
        tracker_s=at_s,
        tool=_geometry(tool, True),
        adapter=tool.adapter.load,
        zero_pose_rad=tool.zero_pose_rad,
    )
    return Trial(
        scene=scene,
        pushed=pushed,
        unit=units,
        tracker_unit=units,
        wrench_std=instruments.wrench_mean_std(_PUSH_STEP_S),
        tracker_std=instruments.tracker_mean_std(_PUSH_STEP_S),
    )


def _geometry(tool: CalibrationFile, tool_on: bool) -> ToolGeometry:
    load = tool.load.load if tool_on else Load(0.0, np.zeros(3))
    return ToolGeometry(load, np.asarray(tool.tip_m, dtype=float))
