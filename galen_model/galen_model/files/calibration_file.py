# SPDX-License-Identifier: Apache-2.0
"""Calibration file `<tools_dir>/<tool>.json`: read with checks, written whole or not at all.

The old file is kept as `<tool>.json.bak`, see `galen_model.files.atomic_file`. Files of schema 1
(`bias` for the adapter, `bias_pose_rad` for the zeroing, always the Galen's) are read as well.
"""

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import GRAVITY_RANGE_M_S2, Arm, Joint, constant
from galen_model.arm.galen import GALEN, GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, ToolNameError
from galen_model.files.atomic_file import write_whole
from galen_model.json_fields import (
    CALIBRATION_FILE,
    FieldError,
    array,
    check_kind,
    check_version,
    count,
    covariance,
    get,
    items,
    mapping,
    number,
    numbers,
    parse_json,
    read_limited,
    sentence,
    text,
    texts,
)
from galen_model.load.cable import LearnedPull
from galen_model.load.inertia import InertiaEstimate
from galen_model.load.model import LoadEstimate, gravity_wrench
from galen_model.load.mounting import Mounting

SCHEMA_VERSION = 2
GRAVITY_TOLERANCE_M_S2 = 1e-3
GRAVITY_TOLERANCE_RAD = 1e-4
ZEROING_TOLERANCE_RAD = 0.02
"""Between gravity at the zeroing as the file has it and as the arm's geometry gives it."""
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
MAX_FILE_BYTES = 1_000_000
_MODEL_KEYS = ("model", "model_reason")
_AGES = ((86400.0, "day"), (3600.0, "hour"), (60.0, "minute"))


@dataclass(frozen=True)
class ArmIdentity:
    """The arm of a calibration: its name, joints from base to sensor, SHA-256 of the URDF."""

    name: str
    joints: tuple[str, ...]
    urdf_sha256: str


def identity(arm: Arm) -> ArmIdentity:
    """Collect what a calibration file keeps of an arm.

    Args:
        arm: of the calibration.

    Returns:
        Name, joints and checksum.

    """
    return ArmIdentity(arm.name, arm.joint_names, arm.urdf_sha256)


@dataclass(frozen=True)
class ZeroingPose:
    """Pose of the last zeroing: joints by name (m, rad), gravity (3,) in ft_sensor, m/s^2."""

    joints: Mapping[str, float]
    gravity_in_sensor_m_s2: Array


def zeroed_at(angles: ArrayLike | None = None, *, arm: Arm) -> ZeroingPose:
    """Make the zeroing at a pose.

    Args:
        angles: (k,) of the arm's turning joints, rad; None: home.
        arm: whose joints they are.

    Returns:
        The zeroing, with the turning joints alone.

    """
    at = arm.home_angles if angles is None else np.asarray(angles, dtype=float)
    joints = dict(zip(arm.turning_names, numbers(at), strict=True))
    return ZeroingPose(joints, arm.gravity_in_sensor(at))


@dataclass(frozen=True)
class CalibrationFile:
    """What a calibration found. Offsets, rmse: (6,), N and N.m in the sensor's frame; tip_m: (3,).

    arm: the one that it is used on; gravity_m_s2: (3,) in the arm's base frame.
    """

    tool: str
    load: LoadEstimate
    adapter: LoadEstimate
    tip_m: Array
    rmse: Array
    poses_used: int
    calibrated_at: str
    residual_offset: Array = field(default_factory=lambda: np.zeros(6))
    arm: Arm = field(kw_only=True, repr=False, compare=False)
    zeroing: ZeroingPose | None = field(kw_only=True)
    """Where the sensor was zeroed with the adapter alone; None: not so, or not known."""
    poses_rejected: tuple[str, ...] = ()
    gravity_m_s2: Array = field(default_factory=lambda: GRAVITY_M_S2.copy())
    made_on: ArmIdentity | None = None
    """The arm of the calibration; None: `arm`."""
    unresolved: tuple[str, ...] = ()
    """What the calibration could not tell (one sweep); empty after two sweeps."""
    model: str = ""
    model_reason: str = ""
    """By which model the load was identified, and why; empty in files from before."""
    inertia: InertiaEstimate | None = None
    """Of tool and adapter together, identified in a recording of motion."""
    mounting: Mounting | None = None
    cable: LearnedPull | None = None
    """What a cable at the tool pulls beside the load, identified in a sweep with the cable on."""

    @property
    def sensor_frame(self) -> str:
        """Frame of the wrenches, the load and the tip."""
        return self.arm.sensor_frame

    def predict(self, angles: ArrayLike) -> Array:
        """Predict readings without contact.

        reading = M (W(q; tool) + W(q; adapter) - W(zeroing; adapter)) + residual offset

        in the sensor's own axes: with a `mounting`, q and M are its; without, M is one and the axes
        are the sensor frame's.

        Args:
            angles: reported (..., k), rad.

        Returns:
            (..., 6), N and N.m.

        """
        return self.predict_under(self.gravity_in_sensor(angles))

    def gravity_in_sensor(self, angles: ArrayLike) -> Array:
        """Compute gravity in the sensor, of the file's size and with its mounting.

        Args:
            angles: reported (..., k), rad.

        Returns:
            (..., 3) in the sensor's frame, m/s^2.

        """
        if self.mounting is None:
            return self.arm.gravity_in_sensor(angles) * self._gravity_scale
        return self.mounting.gravity_in_sensor(angles, self.arm) * self._gravity_scale

    def predict_under(self, gravity_sensor: ArrayLike) -> Array:
        """Predict readings as `predict` does, from gravity.

        Args:
            gravity_sensor: true gravity (..., 3) in ft_sensor, m/s^2.

        Returns:
            (..., 6), N and N.m, in the sensor's own axes.

        """
        wrench = (
            gravity_wrench(gravity_sensor, self.load.load)
            + gravity_wrench(gravity_sensor, self.adapter.load)
            - gravity_wrench(self.gravity_at_zeroing, self.adapter.load)
        )
        if self.mounting is not None:
            wrench = wrench @ self.mounting.reading_from_wrench.T
        return wrench + self.residual_offset

    @property
    def bias_note(self) -> str:
        """Say how old the sensor's bias is that the file holds; empty where a zeroing sets it."""
        if self.zeroing is not None or not np.any(self.residual_offset):
            return ""
        return (
            f"the sensor's bias is the file's, {age_text(self.calibrated_at)}: tare without contact"
            " where it may have changed (restart, zeroing, warming up)"
        )

    @property
    def zero_angles(self) -> Array:
        """Angles (k,) of the zeroing, rad; home where the file does not hold them."""
        joints = {} if self.zeroing is None else self.zeroing.joints
        names, home = self.arm.turning_names, self.arm.home_angles
        return np.array([joints.get(name, at) for name, at in zip(names, home, strict=True)])

    @property
    def gravity_at_zeroing(self) -> Array:
        """Gravity (3,) in ft_sensor at the zeroing, m/s^2, mounted; zero without a zeroing."""
        if self.zeroing is None:
            return np.zeros(3)
        if self.mounting is None:
            return self.zeroing.gravity_in_sensor_m_s2
        return self.gravity_in_sensor(self.zero_angles)

    @property
    def arm_warning(self) -> str:
        """A sentence where the file was made on another URDF of this arm, else empty."""
        made, here = self.made_on, self.arm.urdf_sha256
        if made is None or not self.arm.urdf or made.urdf_sha256 in ("", here):
            return ""
        return (
            f"the calibration of '{self.tool}' was made with another URDF of the arm"
            f" '{self.arm.name}' ({made.urdf_sha256[:12]}, here {here[:12]}):"
            " calibrate again if the geometry differs"
        )

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the optional parts that were estimated, as the file's keys."""
        names = ("inertia", "mounting", "cable")
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def _gravity_scale(self) -> float:
        """The file's gravity over the arm's; another place on earth has another."""
        return float(np.linalg.norm(self.gravity_m_s2) / np.linalg.norm(self.arm.gravity_m_s2))

    def to_json(self) -> dict[str, Any]:
        """Return the file's content."""
        made = self.made_on or identity(self.arm)
        content: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "tool": self.tool,
            "sensor_frame": self.sensor_frame,
            "arm": {
                "name": made.name,
                "joints": list(made.joints),
                "urdf_sha256": made.urdf_sha256,
            },
            "gravity_m_s2": numbers(self.gravity_m_s2),
            "zeroing": None
            if self.zeroing is None
            else {
                "joints": {name: float(value) for name, value in self.zeroing.joints.items()},
                "gravity_in_sensor_m_s2": numbers(self.zeroing.gravity_in_sensor_m_s2),
            },
            "load": _load_to_json(self.load),
            "adapter": _load_to_json(self.adapter),
            "residual_offset": _wrench_to_json(self.residual_offset),
            "tip_m": numbers(self.tip_m),
            "rmse": _wrench_to_json(self.rmse),
            "poses_used": self.poses_used,
            "poses_rejected": list(self.poses_rejected),
            "calibrated_at": self.calibrated_at,
        }
        if self.unresolved:
            content["unresolved"] = list(self.unresolved)
        content |= {key: words for key in _MODEL_KEYS if (words := getattr(self, key))}
        if self.inertia is not None:
            content["inertia"] = self.inertia.to_json()
        if self.mounting is not None:
            content["mounting"] = self.mounting.to_json()
        if self.cable is not None:
            content["cable"] = self.cable.to_json()
        return content


def check_tool_name(name: str, what: str = "tool") -> str:
    """Check that a name may name a file, of a tool or of `what`.

    Args:
        name: to be checked.
        what: whose name it is, for the error's text.

    Returns:
        The name.

    Raises:
        ToolNameError: it is not 1 to 64 letters, digits, '_' and '-'.

    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ToolNameError(
            f"{what} name {name!r:.80}: a name holds 1 to 64 letters, digits, '_' and '-',"
            " nothing else"
        )
    return name


def calibration_path(tools_dir: str | os.PathLike[str], tool: str) -> Path:
    """Compose the path of a calibration file.

    Args:
        tools_dir: directory of the files; ~ is expanded.
        tool: the tool's name.

    Returns:
        The path, whether there is a file or not.

    Raises:
        ToolNameError: the name is not allowed.

    """
    return Path(tools_dir).expanduser() / f"{check_tool_name(tool)}.json"


def read_calibration(path: str | os.PathLike[str], arm: Arm) -> CalibrationFile:
    """Read and check a calibration file.

    Args:
        path: file to read.
        arm: the one that the file is used on.

    Returns:
        The file's content.

    Raises:
        CalibrationFileError: naming the file and the field; where the file itself can't be read,
            its cause is the OSError.

    """
    path = Path(path)
    try:
        raw = read_limited(path, MAX_FILE_BYTES, "a calibration file")
        return parse_calibration(path, raw, arm)
    except OSError as error:
        raise CalibrationFileError(f"{path}: can't be read: {error.strerror}") from error
    except FieldError as error:
        raise CalibrationFileError(f"{path}: {error}") from error


def parse_calibration(
    path: str | os.PathLike[str], raw: bytes, arm: Arm, *, other_arms: bool = False
) -> CalibrationFile:
    """Check the bytes of a calibration file.

    Args:
        path: of the file, for the error's text.
        raw: its content.
        arm: the one that the file is used on.
        other_arms: a file of another arm than `arm` is read as well. Its arm then has the file's
            name, joints, sensor frame and gravity, but no geometry: its `urdf` is empty.

    Returns:
        The file's content.

    Raises:
        CalibrationFileError: naming `path` and the field.

    """
    try:
        return _from_json(parse_json(raw), arm, other_arms)
    except (FieldError, ToolNameError, RecursionError) as error:
        raise CalibrationFileError(f"{path}: {error}") from error


def write_calibration(path: str | os.PathLike[str], tool: CalibrationFile) -> None:
    """Write a calibration file whole or not at all; the old one is kept as `.bak`.

    Args:
        path: file to write.
        tool: its content.

    Raises:
        CalibrationFileError: naming the file, which could not be read back or written; the old file
            is then untouched.

    """
    path = Path(path)
    try:
        content = tool.to_json()
        # What can't be read must not be written.
        _from_json(json.loads(json.dumps(content)), tool.arm)
        content_text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    except (ValueError, FieldError, ToolNameError) as error:
        raise CalibrationFileError(f"{path}: not written: {error}") from error
    try:
        write_whole(path, content_text)
    except OSError as error:
        raise CalibrationFileError(f"{path}: can't be written: {error.strerror}") from error


def age_text(calibrated_at: str, now: datetime | None = None) -> str:
    """Write how long ago a time was.

    Args:
        calibrated_at: RFC 3339, with a time zone.
        now: with a time zone; None: the clock's.

    Returns:
        As "3 days ago".

    Raises:
        ValueError: it is no such time.

    """
    then = datetime.fromisoformat(calibrated_at)
    age_s = ((now or datetime.now(UTC)) - then).total_seconds()
    if age_s < -60.0:
        return "in the future"
    for length_s, unit in _AGES:
        count = int(age_s // length_s)
        if count >= 1:
            return f"{count} {unit}{'' if count == 1 else 's'} ago"
    return "just now"


def _load_to_json(estimate: LoadEstimate) -> dict[str, Any]:
    return {
        "mass_kg": float(estimate.mass_kg),
        "com_m": numbers(estimate.com_m),
        "covariance": [numbers(row) for row in estimate.covariance],
    }


def _wrench_to_json(wrench: Array) -> dict[str, Any]:
    return {"force_N": numbers(wrench[:3]), "torque_Nm": numbers(wrench[3:])}


def _from_json(content: Any, arm: Arm, other_arms: bool = False) -> CalibrationFile:
    whole = mapping(content, "the file")
    check_kind(whole, CALIBRATION_FILE)
    version = whole.get("schema_version")
    if version == 1 and version is not True:
        whole = _from_schema_1(whole)
    check_version(whole, SCHEMA_VERSION)
    made = _made_on(get(whole, "arm"))
    frame = text(get(whole, "sensor_frame"), "sensor_frame")
    if other_arms and (made.joints, frame) != (arm.joint_names, arm.sensor_frame):
        arm = _named_arm(made, frame, whole)
    _check_arm(made, arm, frame)
    gravity = _gravity(get(whole, "gravity_m_s2"), arm)
    if frame != arm.sensor_frame:
        raise FieldError(
            f"sensor_frame is '{frame}', but this arm's is '{arm.sensor_frame}': calibrate the tool"
            " with it, or correct the parameter sensor_frame"
        )
    file = CalibrationFile(
        tool=check_tool_name(text(get(whole, "tool"), "tool")),
        load=_load(get(whole, "load"), "load"),
        adapter=_load(get(whole, "adapter"), "adapter", none_allowed=True),
        tip_m=array(get(whole, "tip_m"), "tip_m", (3,)),
        rmse=_wrench(get(whole, "rmse"), "rmse"),
        poses_used=count(get(whole, "poses_used"), "poses_used"),
        calibrated_at=_time(get(whole, "calibrated_at")),
        residual_offset=_wrench(get(whole, "residual_offset"), "residual_offset"),
        arm=arm,
        zeroing=_zeroing(get(whole, "zeroing"), arm, float(np.linalg.norm(gravity))),
        poses_rejected=texts(get(whole, "poses_rejected"), "poses_rejected"),
        gravity_m_s2=gravity,
        made_on=made,
        unresolved=texts(whole.get("unresolved", []), "unresolved"),
        **{key: sentence(whole[key], key) for key in _MODEL_KEYS if key in whole},
        inertia=InertiaEstimate.from_json(whole["inertia"], "inertia")
        if "inertia" in whole
        else None,
        mounting=Mounting.from_json(whole["mounting"], "mounting", arm)
        if "mounting" in whole
        else None,
        cable=LearnedPull.from_json(whole["cable"], "cable", arm) if "cable" in whole else None,
    )
    if file.mounting is not None and file.zeroing is not None:
        lacking = set(arm.turning_names) - file.zeroing.joints.keys()
        if lacking:
            raise FieldError(
                f"zeroing.joints lacks {', '.join(sorted(lacking))}: mounting needs it"
            )
    return file


def _from_schema_1(whole: Mapping[str, Any]) -> Mapping[str, Any]:
    """Rewrite the content of schema 1; raises FieldError with the names of its own keys."""
    pose = mapping(get(whole, "bias_pose_rad"), "bias_pose_rad")
    zero = [number(get(pose, name), f"bias_pose_rad.{name}") for name in GALEN.turning_names]
    gravity = array(get(whole, "gravity_m_s2"), "gravity_m_s2", (3,))
    _load(get(whole, "bias"), "bias", none_allowed=True)
    galen = identity(GALEN)
    at_zero = GALEN.gravity_in_sensor(zero) * float(gravity[2] / GRAVITY_M_S2[2])
    kept = {key: value for key, value in whole.items() if key not in ("bias", "bias_pose_rad")}
    return {
        **kept,
        "schema_version": SCHEMA_VERSION,
        "arm": {
            "name": galen.name, "joints": list(galen.joints), "urdf_sha256": galen.urdf_sha256,
        },
        "zeroing": {
            "joints": dict(zip(GALEN.turning_names, zero, strict=True)),
            "gravity_in_sensor_m_s2": at_zero.tolist(),
        },
        "adapter": whole["bias"],
    }  # fmt: skip


def _made_on(value: Any) -> ArmIdentity:
    whole = mapping(value, "arm")
    joints = tuple(text(name, "arm.joints") for name in items(get(whole, "joints"), "arm.joints"))
    name = text(get(whole, "name"), "arm.name")
    # Empty: the description is not known.
    digest = get(whole, "urdf_sha256")
    return ArmIdentity(name, joints, "" if digest == "" else text(digest, "arm.urdf_sha256"))


def _check_arm(made: ArmIdentity, here: Arm, frame: str) -> None:
    """Reject another arm than this one, with both names and the file's frame."""
    if made.joints != here.joint_names:
        raise FieldError(
            f"made on the arm '{made.name}' with the joints {', '.join(made.joints) or 'none'};"
            f" this arm is '{here.name}' with {', '.join(here.joint_names)}: calibrate the tool on"
            f" it, or name the file's arm and frame (--urdf FILE --sensor-frame {frame}; nodes:"
            " urdf_file, sensor_frame; a recording: arm.urdf beside its bags)"
        )


def _named_arm(made: ArmIdentity, frame: str, whole: Mapping[str, Any]) -> Arm:
    """Return the arm as far as its file names it; the joints' places and axes are not known."""
    turning: set[str] = set()
    for part, key in (("zeroing", "joints"), ("mounting", "joint_zero_rad")):
        if whole.get(part) is not None:
            turning |= set(mapping(get(mapping(whole[part], part), key), f"{part}.{key}"))
    return Arm(
        name=made.name,
        joints=tuple(
            Joint(
                name,
                "revolute" if name in turning or not turning else "prismatic",
                axis=constant(0.0, 0.0, 1.0),
                origin_m=np.zeros(3),
                lower=-np.inf,
                upper=np.inf,
            )
            for name in made.joints
        ),
        sensor_origin_m=np.zeros(3),
        sensor_rotation=np.eye(3),
        gravity_m_s2=array(get(whole, "gravity_m_s2"), "gravity_m_s2", (3,)),
        sensor_frame=frame,
    )


def _gravity(value: Any, here: Arm) -> Array:
    """Read `gravity_m_s2`, which points as the arm's: a base elsewhere turns every reading."""
    gravity = array(value, "gravity_m_s2", (3,))
    size = float(np.linalg.norm(gravity))
    lowest, highest = GRAVITY_RANGE_M_S2
    if not lowest <= size <= highest:
        raise FieldError(
            f"gravity_m_s2 is {gravity.tolist()}, {size:g} m/s^2 long; expected {lowest} to"
            f" {highest}"
        )
    down = here.gravity_m_s2 / np.linalg.norm(here.gravity_m_s2)
    if not np.linalg.norm(gravity / size - down) <= GRAVITY_TOLERANCE_RAD:
        raise FieldError(
            f"gravity_m_s2 is {gravity.tolist()}, but this arm's is {here.gravity_m_s2.tolist()}:"
            " correct the parameter gravity_m_s2, or calibrate the tool anew"
        )
    return gravity


def _zeroing(value: Any, arm: Arm, gravity_m_s2: float) -> ZeroingPose | None:
    if value is None:
        return None
    whole = mapping(value, "zeroing")
    joints = mapping(get(whole, "joints"), "zeroing.joints")
    unknown = sorted(set(joints) - set(arm.joint_names))
    if unknown:
        raise FieldError(
            f"zeroing.joints holds {unknown[0]!r:.40}; joints are {', '.join(arm.joint_names)}"
        )
    name = "zeroing.gravity_in_sensor_m_s2"
    gravity = array(get(whole, "gravity_in_sensor_m_s2"), name, (3,))
    size = float(np.linalg.norm(gravity))
    if not abs(size - gravity_m_s2) <= GRAVITY_TOLERANCE_M_S2:
        raise FieldError(
            f"{name} is {size:g} m/s^2 long; expected {gravity_m_s2:g} as gravity_m_s2"
        )
    at = {joint: number(angle, f"zeroing.joints.{joint}") for joint, angle in joints.items()}
    if arm.urdf and at.keys() >= set(arm.turning_names):
        expected = arm.gravity_in_sensor([at[joint] for joint in arm.turning_names])
        cosine = gravity @ expected / size / np.linalg.norm(expected)
        angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        if angle > ZEROING_TOLERANCE_RAD:
            raise FieldError(
                f"{name} is {gravity.round(3).tolist()}, {angle:.3f} rad off what the arm"
                f" '{arm.name}' has at zeroing.joints, {expected.round(3).tolist()}; at most"
                f" {ZEROING_TOLERANCE_RAD:g} rad: correct base_frame, gravity_m_s2 or the robot"
                " description, or calibrate the tool again"
            )
    return ZeroingPose(at, gravity)


def _wrench(value: Any, name: str) -> Array:
    whole = mapping(value, name)
    return np.concatenate(
        [
            array(get(whole, "force_N"), f"{name}.force_N", (3,)),
            array(get(whole, "torque_Nm"), f"{name}.torque_Nm", (3,)),
        ]
    )


def _load(value: Any, name: str, none_allowed: bool = False) -> LoadEstimate:
    """`none_allowed`: nothing may have hung on the sensor, so that the mass is zero."""
    whole = mapping(value, name)
    mass = number(get(whole, "mass_kg"), f"{name}.mass_kg")
    if mass < 0.0 or (mass == 0.0 and not none_allowed):
        raise FieldError(f"{name}.mass_kg is {mass}; a mass is positive")
    com = array(get(whole, "com_m"), f"{name}.com_m", (3,))
    return LoadEstimate(mass, com, covariance(get(whole, "covariance"), f"{name}.covariance", 4))


def _time(value: Any) -> str:
    written = text(value, "calibrated_at")
    try:
        moment = datetime.fromisoformat(written)
    except ValueError:
        raise FieldError(f"calibrated_at is {written!r:.40}; expected an RFC 3339 time") from None
    if moment.tzinfo is None:
        raise FieldError(f"calibrated_at is {written!r:.40}; it has no time zone")
    return written
