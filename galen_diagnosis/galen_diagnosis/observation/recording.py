# SPDX-License-Identifier: Apache-2.0
"""Reads a diagnostic recording (contract, section 5): up to three bags and the tool's file.

Nothing else in its directory is opened.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from galen_bags.arrays.arm_recording import ARM_FILE, ArmRecording, ArmTopics, read_arm
from galen_bags.arrays.marker_tracks import marker_track, read_poses
from galen_bags.formats.bag import open_bag, robot_description
from galen_bags.formats.errors import BagError
from galen_bags.formats.files import is_bag
from galen_model.arm.arm import MAX_URDF_BYTES, Arm
from galen_model.arm.description import read_arm as read_description
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import (
    MAX_FILE_BYTES,
    CalibrationFile,
    read_calibration,
)
from galen_model.json_fields import (
    FieldError,
    array,
    get,
    mapping,
    read_json,
    read_limited,
    text,
)
from galen_model.load.inertia import point_mass_inertia
from galen_model.rest.binned import CellReducer, find_still_phases
from galen_model.setup_check.check import SetupError, check_setup
from galen_model.setup_check.readings import at_angles
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.joints import JointZeroOffset, base_inclination
from galen_sim_driver.effects.registry import limit_parts
from galen_sim_driver.effects.sensor import AxisGain, SensorMountRotation

from galen_diagnosis.observation.rows import BAGS
from galen_diagnosis.observation.specification import (
    CALIBRATED,
    DEFAULT,
    SPECIFICATION_FILE,
    Specification,
    specification_of,
)

RECORDING_FILES = ("tool.json", ARM_FILE, SPECIFICATION_FILE)
"""What is read of a recording beside its bags."""
_JUMP_S = 1.0
_TRACKER_TOPICS = ("tracker/tool_pose", "tracker/base_pose")
_LEAST_SAMPLES = 50
_LEAST_HZ = 20.0
_REACH_S = 0.1


@dataclass(frozen=True)
class Track:
    """Poses of a marker in `tracker`: at_s (n,), rotation (n, 3, 3), position (n, 3) m."""

    at_s: Array
    rotation: Array
    position: Array

    def __len__(self) -> int:
        return len(self.at_s)


@dataclass(frozen=True)
class Readings:
    """What is known of a table's n readings, each of which stands for itself.

    block (n,): readings that are held out together, numbered; labels: of the blocks. noise_std
    (6,), N and N.m, of a reading; noise_known: by measurement. unknowns (n, 6, k): what is no gap,
    in readings by weights of about one. hidden: by effect, why it can't be seen. notes: how they
    were made. earlier: names of the tables that what is nominal is from.
    """

    block: np.ndarray
    labels: tuple[str, ...]
    noise_std: Array
    noise_known: bool
    unknowns: Array
    hidden: Mapping[str, str]
    notes: tuple[str, ...] = ()
    earlier: tuple[str, ...] = ()


@dataclass(frozen=True)
class BagData:
    """One bag; times in s since its first stamp, in increasing order.

    start_s: its first stamp since the recording's. joint_s (nj,), joints (nj, n) m and rad;
    wrench_s (nw,), wrenches (nw, 6) N and N.m in ft_sensor; the two markers, None without.
    readings: of a table, whose joints are those of a wrist.
    """

    name: str
    start_s: float
    joint_s: Array
    joints: Array
    wrench_s: Array
    wrenches: Array
    tool_marker: Track | None
    base_marker: Track | None
    readings: Readings | None = None


DAY_TO_DAY = 0.05
"""Of what a specification allows an arm may change from day to day."""


@dataclass(frozen=True)
class Earlier:
    """What earlier recordings of the arm say of it.

    names: of them. effects: the arm's own deviations and causes that were there. keys (n,), with
    covariance (n, n): the forms of the deviations' numbers, which may still be off.
    """

    names: tuple[str, ...]
    effects: tuple[Effect, ...]
    keys: tuple[tuple[str, str], ...]
    covariance: Array


@dataclass(frozen=True)
class DiagnosticRecording:
    """Bags by name, in the contract's order, of an arm; `missing` names those that aren't there.

    inertial_forces: whether the nominal model has those of tool and adapter. specification: of the
    arm and its instruments. earlier: what is known of the arm from others, None where it is not
    compared.
    """

    name: str
    tool: CalibrationFile
    bags: dict[str, BagData]
    missing: tuple[str, ...]
    problems: tuple[str, ...]
    arm: Arm
    specification: Specification
    inertial_forces: bool = False
    earlier: Earlier | None = None

    @property
    def readings(self) -> Readings | None:
        """What is known of its readings, of a table; None of bags."""
        return next((bag.readings for bag in self.bags.values()), None)

    @property
    def reference(self) -> tuple[str, ...]:
        """Names of the earlier recordings or tables that it is compared with."""
        if self.readings is not None:
            return self.readings.earlier
        return self.earlier.names if self.earlier is not None else ()

    @property
    def inertia_kg_m2(self) -> Array | None:
        """Inertia (6,) of tool and adapter about the sensor's origin; None without such forces.

        The calibration file's or, where it has none, that of two points at the centres, as for the
        compensation of inertial forces.
        """
        if not self.inertial_forces:
            return None
        if self.tool.inertia is not None:
            return self.tool.inertia.about_sensor_kg_m2
        return point_mass_inertia(self.tool.load.load, self.tool.adapter.load)

    @property
    def nominal_effects(self) -> tuple[Effect, ...]:
        """Effects that the nominal model has too; one that is found comes on top of them."""
        return (*self.mounted_effects, *(self.earlier.effects if self.earlier else ()))

    @property
    def mounted_effects(self) -> tuple[Effect, ...]:
        """The mounting that the calibration file has, as effects."""
        mounting = self.tool.mounting
        if mounting is None:
            return ()
        zeros = zip(mounting.joints, mounting.joint_zero_rad.tolist(), strict=True)
        every: tuple[Effect, ...] = (
            *(JointZeroOffset(joint, zero, nominal=self.arm) for joint, zero in zeros),
            base_inclination(self.arm.gravity_m_s2)(*mounting.base_inclination_rad.tolist()),
            SensorMountRotation(tuple(mounting.sensor_rotvec_rad.tolist())),
            AxisGain(tuple(mounting.axis_gain.tolist())),
        )
        return tuple(effect for effect in every if not effect.changes_nothing)

    @property
    def nominal(self) -> str:
        """The nominal model in words."""
        mounted = " with the mounting of the calibration file" if self.mounted_effects else ""
        if self.earlier is not None:
            mounted += f", and the arm as in {', '.join(self.earlier.names)}"
        if not self.inertial_forces:
            return f"gravity{mounted}"
        of = "two points at their centres" if self.tool.inertia is None else "the calibration file"
        mass_kg = self.tool.load.mass_kg + self.tool.adapter.mass_kg
        return (
            f"gravity{mounted} and inertial forces of {mass_kg:.3f} kg (tool and adapter; inertia"
            f" of {of})"
        )


def read_recording(
    path: str | os.PathLike[str],
    tool: str | os.PathLike[str] | None = None,
    *,
    inertial_forces: bool = False,
    wrench_frame: str = "sensor",
    specification: Sequence[str | os.PathLike[str]] = (),
) -> DiagnosticRecording:
    """Read a recording's directory.

    The arm is that of `arm.urdf` in it, or of `robot_description` in its bags, else the Galen.
    Missing bags are named in `missing`; without any there is nothing to diagnose.

    Args:
        path: The directory.
        tool: The tool's file; None for the directory's own tool.json.
        inertial_forces: Whether the nominal model has those of tool and adapter, with the file's
            masses.
        wrench_frame: "sensor", or "base" where wrenches are written in the base's axes.
        specification: Files and presets, the first before the others; empty for the directory's own
            specification.json. Without one the Galen is a carefully calibrated arm, and any other a
            usual one.

    Returns:
        The recording.

    Raises:
        GalenError: A file is missing or malformed, frames don't fit, stamps jump back, or too
            little of a bag is usable.

    """
    path = Path(path)
    if not any((path / name).exists() for name in BAGS):
        raise GalenError(_no_recording(path))
    tool_path = path / RECORDING_FILES[0] if tool is None else Path(tool)
    robot = _robot(path, tool_path)
    tool_file = read_calibration(tool_path, robot)
    arms: dict[str, ArmRecording] = {}
    problems: list[str] = []
    for name in BAGS:
        if (path / name).exists():
            arms[name] = read_arm(path / name, ArmTopics(wrench_frame=wrench_frame), arm=robot)
            problems += [f"{name}: {problem}" for problem in arms[name].problems]
    for name, arm in arms.items():
        _check_frames(path / name, arm, tool_file)
    taken = {name: _Arm(path / name, arm, robot) for name, arm in arms.items()}
    session_ns = min(usable.first_ns for usable in taken.values())
    bags = {}
    for name, usable in taken.items():
        problems += [f"{name}: {problem}" for problem in usable.problems]
        bags[name] = _bag(path / name, name, usable, session_ns, problems)
    spans = [(bag.start_s, bag.start_s + bag.wrench_s[-1]) for bag in bags.values()]
    if any(later[0] < before[1] for before, later in pairwise(spans)):
        problems.append(
            f"by their stamps the bags weren't recorded one after the other in the order "
            f"{', '.join(bags)}: drifts and jumps that last from bag to bag can't be trusted"
        )
    if tool_file.cable is not None:
        problems.append(
            "the tool's file has an estimate of a cable; the nominal model of a diagnosis leaves it"
            " out, and so finds it again"
        )
    missing = tuple(name for name in BAGS if name not in arms)
    return DiagnosticRecording(
        path.absolute().name or str(path),
        tool_file,
        bags,
        missing,
        tuple(problems),
        robot,
        _specification(path, specification, robot),
        inertial_forces,
    )


def _specification(path: Path, given: Sequence[str | os.PathLike[str]], arm: Arm) -> Specification:
    own = path / SPECIFICATION_FILE
    usual = CALIBRATED if arm.joint_names == GALEN.joint_names else DEFAULT
    return specification_of(given or ([own] if own.exists() else [usual]), limit_parts(arm))


def require_sound_setup(recording: DiagnosticRecording) -> None:
    """Reject a recording whose still poses of the sweep a wrong set-up explains.

    It is looked for in the readings alone, without the calibration file: the effects of a healthy
    set-up are far smaller. One without a sweep, or with a mounting in its tool's file, isn't looked
    at.

    Args:
        recording: What was read.

    Raises:
        SetupError: A gross mistake explains the readings.

    """
    bag, arm = recording.bags.get("sweep"), recording.arm
    if bag is None or recording.tool.mounting is not None:
        return
    joint_angles = arm.angles(bag.joints)
    angles = np.column_stack([np.interp(bag.wrench_s, bag.joint_s, q) for q in joint_angles.T])
    cells = CellReducer()
    cells.add(np.round(bag.wrench_s * 1e9).astype(np.int64), bag.wrenches, angles)
    phases = find_still_phases(cells.finish())
    if not len(phases):
        return
    noise = np.sqrt(np.mean(phases.std_of_mean**2, axis=0))
    found = check_setup(at_angles(phases.mean, phases.angles, arm), noise)
    if found is not None and found.gross:
        raise SetupError(
            f"{recording.name}: {found.sentence}. Of the recording gravity and sensor frame are"
            " those of its tool's file; --no-setup-check diagnoses it all the same"
        )


def _robot(path: Path, tool: Path) -> Arm:
    """Return the recording's arm, with the sensor's frame and gravity of the tool's file."""
    source, described = _description(path)
    if not described:
        return GALEN
    try:
        file = read_json(tool, MAX_FILE_BYTES, "a calibration file")
        known = mapping(file, "the file")
        frame = text(get(known, "sensor_frame"), "sensor_frame")
        gravity = array(get(known, "gravity_m_s2"), "gravity_m_s2", (3,))
        return read_description(described, sensor_frame=frame, gravity_m_s2=gravity)
    except (OSError, FieldError) as error:
        raise GalenError(f"{tool}: can't be read: {error}") from error
    except GalenError as error:
        raise GalenError(f"{source}: {error}") from error


def _description(path: Path) -> tuple[Path, str]:
    """Return where a robot's description is in a recording, and its text; "" for none."""
    file = path / RECORDING_FILES[1]
    if file.exists():
        try:
            raw = read_limited(file, MAX_URDF_BYTES, "a robot description")
        except (OSError, FieldError) as error:
            raise GalenError(f"{file}: can't be read: {error}") from error
        return file, raw.decode("utf-8", errors="replace")
    for bag_path in (path / name for name in BAGS if (path / name).exists()):
        with open_bag(bag_path) as bag:
            if described := robot_description(bag):
                return bag_path, described
    return path, ""


def _no_recording(path: Path) -> str:
    wanted = f"a directory with the bags {', '.join(BAGS)} (or some of them) and tool.json"
    if is_bag(path):
        return (
            f"{path}: is a bag, and a recording is {wanted}; `ros2 run galen_gravcomp evaluate"
            f" {path} --tool FILE` takes a single bag"
        )
    if not path.is_dir():
        return f"{path}: no directory with a recording; a recording is {wanted}"
    return f"{path}: holds none of the bags {', '.join(BAGS)}; a recording is {wanted}"


def _check_frames(path: Path, arm: ArmRecording, tool: CalibrationFile) -> None:
    other = [frame for frame in arm.frame_ids if frame and frame != tool.sensor_frame]
    if other:
        raise GalenError(
            f"{path}: wrenches in frame {other[0]!r}, but the tool's file is for"
            f" {tool.sensor_frame!r}; --wrench-frame base turns them out of the base's axes"
        )


class _Arm:
    """A bag's usable joint states and wrenches in the order of their stamps.

    first_ns: the first stamp. joint_s (nj,), joints (nj, n), wrench_s (nw,), wrenches (nw, 6):
    times since then; joint_ns (nj,): stamps. problems: sentences about what was left out.
    """

    def __init__(self, path: Path, arm: ArmRecording, robot: Arm) -> None:
        """Raise GalenError where too little is left."""
        self.problems: list[str] = []
        for what, stamps in (
            ("joint states", arm.joint_stamp_ns),
            ("wrenches", arm.wrench_stamp_ns),
        ):
            back_s = -1e-9 * float(np.diff(stamps[stamps > 0]).min(initial=0))
            if back_s > _JUMP_S:
                raise GalenError(
                    f"{path}: stamps of {what} go back by {back_s:.3g} s, as when a clock is set"
                )
        if not np.isfinite(arm.joints).all(axis=1).any():
            raise GalenError(
                f"{path}: joint states don't name all joints of the arm {robot.name}:"
                f" {', '.join(robot.joint_names)}"
            )
        joint_ns, joints = self._usable("joint states", arm.joint_stamp_ns, arm.joints)
        joints = robot.unwrapped(joints)
        wrench_ns, wrenches = self._usable("wrenches", arm.wrench_stamp_ns, arm.wrenches)
        known = _within_reach(wrench_ns, joint_ns)
        if not known.all():
            self.problems.append(f"{np.sum(~known)} wrenches without joint states near; left out")
        wrench_ns, wrenches = wrench_ns[known], wrenches[known]
        for what, stamps in (("joint states", joint_ns), ("wrenches", wrench_ns)):
            if len(stamps) < _LEAST_SAMPLES:
                raise GalenError(
                    f"{path}: {len(stamps)} usable {what}; at least {_LEAST_SAMPLES} are needed"
                )
            rate_hz = 1e9 / float(np.median(np.diff(stamps)))
            if rate_hz < _LEAST_HZ:
                raise GalenError(
                    f"{path}: {what} at {rate_hz:.3g} Hz; at least {_LEAST_HZ:g} Hz are needed"
                )
        frozen = [
            axis
            for axis, size in zip(WRENCH_AXES, np.ptp(wrenches, axis=0), strict=True)
            if size == 0.0
        ]
        if frozen:
            self.problems.append(
                f"{', '.join(frozen)} read the same all along, as a dead axis does"
            )
        self.first_ns = int(min(joint_ns[0], wrench_ns[0]))
        self.joint_ns = joint_ns
        self.joint_s, self.joints = (joint_ns - self.first_ns) * 1e-9, joints
        self.wrench_s, self.wrenches = (wrench_ns - self.first_ns) * 1e-9, wrenches

    def _usable(self, what: str, stamp_ns: np.ndarray, values: Array) -> tuple[np.ndarray, Array]:
        """Return samples with a stamp and finite numbers, in order, one a stamp."""
        finite = np.isfinite(values).all(axis=1)
        for bad, why in ((stamp_ns <= 0, "without a stamp"), (~finite, "with numbers missing")):
            if bad.any():
                self.problems.append(f"{np.sum(bad)} {what} {why}; left out")
        use = (stamp_ns > 0) & finite
        stamps, rows = np.unique(stamp_ns[use], return_index=True)
        return stamps, values[use][rows]


def _within_reach(stamp_ns: np.ndarray, known_ns: np.ndarray) -> np.ndarray:
    """Which stamps (n,) have one of the known, in increasing order, near before or after them."""
    if not len(known_ns):
        return np.zeros(len(stamp_ns), dtype=bool)
    after = np.searchsorted(known_ns, stamp_ns)
    before = known_ns[np.maximum(after - 1, 0)]
    after_ns = known_ns[np.minimum(after, len(known_ns) - 1)]
    away = np.minimum(np.abs(stamp_ns - before), np.abs(after_ns - stamp_ns))
    return np.asarray(away <= _REACH_S * 1e9)


def _bag(path: Path, name: str, arm: _Arm, session_ns: int, problems: list[str]) -> BagData:
    tool_marker = base_marker = None
    try:
        with open_bag(path) as bag:
            raw = read_poses(bag, _TRACKER_TOPICS)
        tracks = []
        for track, may_stand in zip(raw, (False, True), strict=True):
            good = marker_track(
                track, _JUMP_S, arm.first_ns, may_stand=may_stand, beside_ns=arm.joint_ns
            )
            problems += [f"{name}: {problem}" for problem in good.problems]
            order = np.argsort(good.line.time_ns, kind="stable")
            order = order[_within_reach(good.line.time_ns[order], arm.joint_ns)]
            at_s = (good.line.time_ns[order] - arm.first_ns) * 1e-9
            tracks.append(Track(at_s, good.poses.rotation[order], good.poses.translation[order]))
        problem = _too_little(tracks)
        if problem:
            problems.append(f"{name}: no tracker: {problem}")
        else:
            tool_marker, base_marker = tracks
    except BagError as error:
        if name == "push":
            problems.append(f"push: no tracker: {error}")
    return BagData(
        name,
        (arm.first_ns - session_ns) * 1e-9,
        arm.joint_s,
        arm.joints,
        arm.wrench_s,
        arm.wrenches,
        tool_marker,
        base_marker,
    )


def _too_little(tracks: list[Track]) -> str:
    """Why the two markers' poses aren't enough; empty where they are."""
    for topic, track in zip(_TRACKER_TOPICS, tracks, strict=True):
        if len(track) < _LEAST_SAMPLES:
            return f"{topic} has {len(track)} usable poses; at least {_LEAST_SAMPLES} are needed"
    # The base's marker may be looked at less often: it stands.
    rate_hz = 1.0 / float(np.median(np.diff(tracks[0].at_s)))
    if rate_hz < _LEAST_HZ:
        return f"{_TRACKER_TOPICS[0]} comes at {rate_hz:.3g} Hz; {_LEAST_HZ:g} Hz are needed"
    return ""
