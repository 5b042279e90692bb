# SPDX-License-Identifier: Apache-2.0
"""An experiment that isn't done yet, and what a nominal diagnosis would see of it.

A `Trial` is one recording of an experiment: still poses, a motion, or pushes. `signature` runs the
simulator with a hypothesis' effects along it and returns the residual of the nominal simulator, of
the reading and of the tip that the tracker sees, in units of the noise, without noise. Unknowns
that are no gap (the sensor's zero, where base_link stands in `tracker`, how well the file knows its
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
from galen_model.arrays import Array
from galen_model.calibrated.columns import moment_covariance
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import Load, ToolGeometry, gravity_regressor
from galen_model.rotation import matrix_to_rotvec, skew
from galen_sim_driver.effects.effect import Effect, Fitted, Instants, Posture
from galen_sim_driver.replay import Replay, Scene
from scipy.linalg import block_diag

_BASE_IN_TRACKER_M = np.array([1.2, 0.3, 0.2])
"""A tracker stands about so far away; only its scale asks."""
_TRACKER_STD = np.repeat([TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD], 3)
_WRENCH_HZ, _TRACKER_HZ = 500.0, 60.0
_MOTION_STEP_S = 0.02
_MOTION_HZ = (0.17, 0.23, 0.19, 0.21, 0.29)
_PUSH_STEP_S = 0.15
_BETWEEN_PLACES_S = 5.0
_PUSH_COURSE = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 0.75, 0.5, 0.25, 0.0])


@dataclass(frozen=True)
class Trial:
    """One recording of an experiment.

    scene: its `reading` is zero. pushed (nw, 6): in ft_sensor about its origin. unit (nw,),
    tracker_unit (nt,): the pose or position that a sample belongs to. average_s: what a sample
    averages. absent: names of the effects that can't act here, such as a tool's without one.
    """

    scene: Scene
    pushed: Array
    unit: np.ndarray
    tracker_unit: np.ndarray
    average_s: float
    absent: frozenset[str] = frozenset()
    tool_on: bool = True

    @property
    def wrench_std(self) -> Array:
        """Noise (6,) of a sample; half a quantum stays in any average, an estimate."""
        samples = max(self.average_s * _WRENCH_HZ, 1.0)
        return np.hypot(SENSOR.noise_std / np.sqrt(samples), np.asarray(SENSOR.quantum) / 2.0)

    @property
    def tracker_std(self) -> Array:
        """Noise (6,) of a sample, m and rad; half of it stays in any average, an estimate."""
        samples = max(self.average_s * _TRACKER_HZ, 1.0)
        return np.hypot(_TRACKER_STD / np.sqrt(samples), 0.5 * _TRACKER_STD)

    @property
    def untouched(self) -> np.ndarray:
        """Where the tool isn't pushed (nw,)."""
        return ~np.asarray(self.scene.touched, dtype=bool)

    @property
    def row_units(self) -> np.ndarray:
        """The unit of each row of `signature`."""
        wrench_units = np.repeat(self.unit[self.untouched], 6)
        return np.concatenate([wrench_units, np.repeat(self.tracker_unit, 6)])


@dataclass(frozen=True, eq=False)
class _Push(Effect):
    """A push at the tool."""

    name: ClassVar[str] = "push"
    fitted: ClassVar[tuple[Fitted, ...]] = ()

    at_s: Array = field(default_factory=lambda: np.zeros(1))
    pushed: Array = field(default_factory=lambda: np.zeros((1, 6)))

    def wrench(self, when: Instants, posture: Posture) -> Array:
        """Return what it pushes at these times."""
        return _at(when.bag_s, self.at_s, self.pushed)


def _at(at_s: Array, known_s: Array, values: Array) -> Array:
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)


def signature(trial: Trial, effects: Sequence[Effect]) -> Array:
    """Return the residual of the nominal simulator that effects make, without noise.

    Args:
        trial: The recording.
        effects: A hypothesis' effects; those absent in the trial are left out.

    Returns:
        Rows (n,) in units of the noise: six axes of the wrench at each untouched sample, then six
        of the tip's pose in `tracker` (m, rad) at each of the tracker's.

    """
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
    """Return columns over the rows of all trials: unknowns without a prior.

    Of each trial the sensor's zero (6) and, with a tracker, base_link in `tracker` (6).

    Args:
        trials: The experiment's recordings.

    Returns:
        Columns, (n, m), in units of the noise.

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
    return np.asarray(block_diag(zero, base))


def load_columns(trials: Sequence[Trial], tool: CalibrationFile) -> Array:
    """Return columns of the file's load errors, one standard deviation each.

    With G(u) of `galen_model.load.model` and C = L L^T the covariance of mass and first moment:
    G(u) L of the tool, where it is on, and of the adapter. One sweep doesn't resolve the two, and
    the file's covariances are then huge; but their sum, which is what the sensor feels, is known
    well: such a file counts as exact.

    Args:
        trials: The experiment's recordings.
        tool: The tool's file.

    Returns:
        Columns over the rows of all trials, (n, 8), in units of the noise.

    """
    parts = [tool.load, tool.adapter]
    if tool.unresolved:
        parts = [replace(part, covariance=np.zeros((4, 4))) for part in parts]
    factors = [np.linalg.cholesky(moment_covariance(part)) for part in parts]
    blocks = []
    for trial in trials:
        scene = trial.scene
        joints = _at(scene.wrench_s, scene.joint_s, scene.joints)[trial.untouched]
        regressor = gravity_regressor(tool.arm.gravity_in_sensor(tool.arm.angles(joints)))
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
    *,
    at: Array | None = None,
    tracker: bool = False,
    absent: frozenset[str] = frozenset(),
    tool_on: bool = True,
) -> Trial:
    """Return a sweep of still poses.

    Each joint is held during its average, so that a delay shows nothing here.

    Args:
        poses: Angles, (n, k), rad, in the order in which they are visited.
        at_s: When each pose's average ends, (n,), s.
        average_s: How long readings are averaged.
        tool: The tool's file, with the arm.
        at: Joints, m and rad, at which those that slide stay; None for home.
        tracker: Whether the tracker is on.
        absent: Names of effects that can't act.
        tool_on: Whether the tool is on the arm.

    Returns:
        The trial; a pose is a unit.

    """
    joint_s = np.stack([at_s - average_s, at_s], axis=1).ravel()
    middle_s = at_s - 0.5 * average_s
    joints = np.repeat(tool.arm.with_angles(poses, at), 2, axis=0)
    pushed, tracker_s = np.zeros((len(poses), 6)), middle_s if tracker else np.zeros(0)
    scene = _scene("sweep", joint_s, joints, middle_s, pushed, tracker_s, tool, tool_on)
    units = np.arange(len(poses))
    return Trial(scene, pushed, units, units[: len(tracker_s)], average_s, absent, tool_on)


def motion_trial(
    speed: float, length_s: float, tool: CalibrationFile, at: Array | None = None
) -> Trial:
    """Return a swing of all joints; one unit, without the tracker.

    Args:
        speed: Over the usual one, at which joints swing at about 0.2 Hz.
        length_s: How long it lasts.
        tool: The tool's file, with the arm.
        at: Joints about which they swing, m and rad; None for home.

    Returns:
        The trial.

    """
    arm = tool.arm
    at_s = np.arange(0.0, length_s, _MOTION_STEP_S)
    size = arm.by_unit(0.03, 0.5 if arm.delta is None else (0.7, 0.5))
    hertz = np.array(_MOTION_HZ)
    if arm.delta is None:
        hertz = np.linspace(hertz.min(), hertz.max(), len(size))
    phase = 2.0 * np.pi * speed * np.outer(at_s, hertz)
    joints = (arm.home if at is None else at) + size * np.sin(phase)
    pushed, units = np.zeros((len(at_s), 6)), np.zeros(len(at_s), dtype=int)
    scene = _scene("motion", at_s, joints, at_s, pushed, np.zeros(0), tool)
    return Trial(scene, pushed, units, units[:0], _MOTION_STEP_S)


def push_trial(places: Array, levels_n: Sequence[float], tool: CalibrationFile) -> Trial:
    """Return pushes to both sides along each axis, after a rest at each place.

    The force acts at the tip along the axes of base_link, up and down by steps of a quarter of its
    level, as collection_node asks for it; the tracker is on.

    Args:
        places: Joints, (n, joints), m and rad.
        levels_n: Largest forces of the pushes, N.
        tool: The tool's file, with the arm.

    Returns:
        The trial; a place is a unit.

    """
    forces = [
        level * sign * axis for level in levels_n for axis in np.eye(3) for sign in (1.0, -1.0)
    ]
    course = np.concatenate([np.zeros((4, 3)), *(np.outer(_PUSH_COURSE, f) for f in forces)])
    in_sensor = np.concatenate([course @ tool.arm.sensor_pose(place)[0] for place in places])
    pushed = np.concatenate([in_sensor, np.cross(np.asarray(tool.tip_m), in_sensor)], axis=1)
    steps, count = len(course), len(places)
    number = np.arange(steps * count)
    at_s: Array = number * _PUSH_STEP_S + number // steps * _BETWEEN_PLACES_S
    units = np.repeat(np.arange(count), steps)
    scene = _scene("push", at_s, np.repeat(places, steps, axis=0), at_s, pushed, at_s, tool)
    return Trial(scene, pushed, units, units, _PUSH_STEP_S)


def _scene(
    bag: str,
    joint_s: Array,
    joints: Array,
    wrench_s: Array,
    pushed: Array,
    tracker_s: Array,
    tool: CalibrationFile,
    tool_on: bool = True,
) -> Scene:
    load = tool.load.load if tool_on else Load(0.0, np.zeros(3))
    return Scene(
        bag=bag,
        start_s=0.0,
        joint_s=joint_s,
        joints=joints,
        wrench_s=wrench_s,
        reading=np.zeros_like(pushed),
        touched=np.any(pushed != 0.0, axis=1),
        tracker_s=tracker_s,
        tool=ToolGeometry(load, np.asarray(tool.tip_m, dtype=float)),
        adapter=tool.adapter.load,
        zero_pose_rad=tuple(tool.zero_angles),
        arm=tool.arm,
    )
