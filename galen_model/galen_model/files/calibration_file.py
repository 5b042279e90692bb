"""A tool's file `<tools_dir>/<tool>.json`: read with checks, written whole or not at all.

The old file is kept as `<tool>.json.bak`; how it is written, `galen_model.files.atomic_file` says.
"""

import json
import os
import re
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import GRAVITY_M_S2, SENSOR_FRAME
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.errors import ToolFileError, ToolNameError
from galen_model.files.atomic_file import write_whole
from galen_model.files.json_fields import (
    CALIBRATION_FILE,
    FieldError,
    array,
    check_kind,
    check_version,
    count,
    covariance,
    get,
    mapping,
    number,
    numbers,
    parse_json,
    read_limited,
    text,
    texts,
)
from galen_model.load.cable.drag import CableDrag
from galen_model.load.inertia.estimate import InertiaEstimate
from galen_model.load.model import Load, gravity_wrench
from galen_model.load.mounting.mounting import Mounting

SCHEMA_VERSION = 1
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
MAX_FILE_BYTES = 1_000_000
_AGES = ((86400.0, "day"), (3600.0, "hour"), (60.0, "minute"))


@dataclass(frozen=True)
class LoadEstimate:
    """A load and the covariance (4, 4) of (mass, centre): kg and m."""

    mass_kg: float
    com_m: Array
    covariance: Array

    @property
    def load(self) -> Load:
        """The load without its uncertainty."""
        return Load(self.mass_kg, self.com_m)

    @property
    def mass_std_kg(self) -> float:
        """Standard deviation of the mass."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def com_std_m(self) -> Array:
        """Standard deviations (3,) of the centre."""
        return np.sqrt(np.diag(self.covariance)[1:])


@dataclass(frozen=True)
class ToolFile:
    """What a calibration found. Offsets, rmse: (6,), N and N.m in ft_sensor; tip_m: (3,)."""

    tool: str
    load: LoadEstimate
    bias: LoadEstimate
    tip_m: Array
    rmse: Array
    poses_used: int
    calibrated_at: str
    residual_offset: Array = field(default_factory=lambda: np.zeros(6))
    bias_roll_rad: float = 0.0
    bias_tilt_rad: float = 0.0
    poses_rejected: tuple[str, ...] = ()
    sensor_frame: str = SENSOR_FRAME
    gravity_m_s2: Array = field(default_factory=lambda: GRAVITY_M_S2.copy())
    unresolved: tuple[str, ...] = ()
    """What the calibration could not tell (one sweep); empty after two sweeps."""
    inertia: InertiaEstimate | None = None
    """Of tool and adapter together, where a recording of motion told it."""
    mounting: Mounting | None = None
    cable: CableDrag | None = None
    """What a cable at the tool pulls beside the load, where a sweep with the cable on told it."""

    def predict(self, roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
        """Reading (..., 6) expected at roll and tilt (...) without touch, N and N.m.

        reading = M (W(theta; tool) + W(theta; adapter) - W(theta_bias; adapter)) + residual offset

        in the sensor's own axes: with a `mounting`, theta and M are its; without, M is one and the
        axes are ft_sensor's.
        """
        return self.predict_under(self.gravity_in_sensor(roll_rad, tilt_rad))

    def gravity_in_sensor(self, roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
        """Gravity (..., 3) in ft_sensor at reported angles (...), m/s^2: the file's, mounted."""
        if self.mounting is None:
            return gravity_in_sensor(roll_rad, tilt_rad) * self._gravity_scale
        return self.mounting.gravity_in_sensor(roll_rad, tilt_rad) * self._gravity_scale

    def predict_under(self, gravity_sensor: ArrayLike) -> Array:
        """As `predict`, from the true gravity (..., 3) in ft_sensor, m/s^2."""
        at_bias = self.gravity_in_sensor(self.bias_roll_rad, self.bias_tilt_rad)
        wrench = (
            gravity_wrench(gravity_sensor, self.load.load)
            + gravity_wrench(gravity_sensor, self.bias.load)
            - gravity_wrench(at_bias, self.bias.load)
        )
        if self.mounting is not None:
            wrench = wrench @ self.mounting.reading_from_wrench.T
        return wrench + self.residual_offset

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the optional parts that were estimated, as the file's keys."""
        return tuple(
            part.name
            for part in fields(self)
            if part.default is None and getattr(self, part.name) is not None
        )

    @property
    def _gravity_scale(self) -> float:
        """The file's gravity over the suite's; another place on earth has another."""
        return float(self.gravity_m_s2[2] / GRAVITY_M_S2[2])

    def to_json(self) -> dict[str, Any]:
        """The file's content."""
        content: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "tool": self.tool,
            "sensor_frame": self.sensor_frame,
            "gravity_m_s2": numbers(self.gravity_m_s2),
            "bias_pose_rad": {"roll": self.bias_roll_rad, "tilt": self.bias_tilt_rad},
            "load": _load_to_json(self.load),
            "bias": _load_to_json(self.bias),
            "residual_offset": _wrench_to_json(self.residual_offset),
            "tip_m": numbers(self.tip_m),
            "rmse": _wrench_to_json(self.rmse),
            "poses_used": self.poses_used,
            "poses_rejected": list(self.poses_rejected),
            "calibrated_at": self.calibrated_at,
        }
        if self.unresolved:
            content["unresolved"] = list(self.unresolved)
        if self.inertia is not None:
            content["inertia"] = self.inertia.to_json()
        if self.mounting is not None:
            content["mounting"] = self.mounting.to_json()
        if self.cable is not None:
            content["cable"] = self.cable.to_json()
        return content


def check_tool_name(name: str, what: str = "tool") -> str:
    """Return `name` if it may name a file, of a tool or of `what`.

    Raises ToolNameError unless it is 1 to 64 letters, digits, '_' and '-'.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ToolNameError(
            f"{what} name {name!r:.80}: a name holds 1 to 64 letters, digits, '_' and '-',"
            " nothing else"
        )
    return name


def tool_path(tools_dir: str | os.PathLike[str], tool: str) -> Path:
    """Path of a tool's file; raises ToolNameError for a name that is not allowed."""
    return Path(tools_dir).expanduser() / f"{check_tool_name(tool)}.json"


def read_tool(path: str | os.PathLike[str]) -> ToolFile:
    """Read and check a tool's file. Raises ToolFileError that names the file and the field.

    Where the file itself can't be read, the error's cause is the OSError.
    """
    path = Path(path)
    try:
        return parse_tool(path, read_limited(path, MAX_FILE_BYTES, "a tool's file"))
    except OSError as error:
        raise ToolFileError(f"{path}: can't be read: {error.strerror}") from error
    except FieldError as error:
        raise ToolFileError(f"{path}: {error}") from error


def parse_tool(path: str | os.PathLike[str], raw: bytes) -> ToolFile:
    """Check the bytes of a tool's file; `path` is for the ToolFileError that it raises."""
    try:
        return _from_json(parse_json(raw))
    except (FieldError, ToolNameError, RecursionError) as error:
        raise ToolFileError(f"{path}: {error}") from error


def write_tool(path: str | os.PathLike[str], tool: ToolFile) -> None:
    """Write a tool's file whole or not at all; the old one is kept as `.bak`.

    Raises ToolFileError, naming the file; the old file is then untouched.
    """
    path = Path(path)
    try:
        content = tool.to_json()
        _from_json(json.loads(json.dumps(content)))  # what can't be read must not be written
        content_text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    except (ValueError, FieldError, ToolNameError) as error:
        raise ToolFileError(f"{path}: not written: {error}") from error
    try:
        write_whole(path, content_text)
    except OSError as error:
        raise ToolFileError(f"{path}: can't be written: {error.strerror}") from error


def age_text(calibrated_at: str, now: datetime | None = None) -> str:
    """How long ago an RFC 3339 time was."""
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


def _from_json(content: Any) -> ToolFile:
    whole = mapping(content, "the file")
    check_kind(whole, CALIBRATION_FILE)
    check_version(whole, SCHEMA_VERSION)
    pose = mapping(get(whole, "bias_pose_rad"), "bias_pose_rad")
    gravity = array(get(whole, "gravity_m_s2"), "gravity_m_s2", (3,))
    if gravity[0] != 0.0 or gravity[1] != 0.0 or not 9.7 < -gravity[2] < 9.9:
        raise FieldError(f"gravity_m_s2 is {gravity.tolist()}; expected (0, 0, about -9.8)")
    return ToolFile(
        tool=check_tool_name(text(get(whole, "tool"), "tool")),
        load=_load(get(whole, "load"), "load"),
        bias=_load(get(whole, "bias"), "bias", none_allowed=True),
        tip_m=array(get(whole, "tip_m"), "tip_m", (3,)),
        rmse=_wrench(get(whole, "rmse"), "rmse"),
        poses_used=count(get(whole, "poses_used"), "poses_used"),
        calibrated_at=_time(get(whole, "calibrated_at")),
        residual_offset=_wrench(get(whole, "residual_offset"), "residual_offset"),
        bias_roll_rad=number(get(pose, "roll"), "bias_pose_rad.roll"),
        bias_tilt_rad=number(get(pose, "tilt"), "bias_pose_rad.tilt"),
        poses_rejected=texts(get(whole, "poses_rejected"), "poses_rejected"),
        sensor_frame=text(get(whole, "sensor_frame"), "sensor_frame"),
        gravity_m_s2=gravity,
        unresolved=texts(whole.get("unresolved", []), "unresolved"),
        inertia=InertiaEstimate.from_json(whole["inertia"], "inertia")
        if "inertia" in whole
        else None,
        mounting=Mounting.from_json(whole["mounting"], "mounting") if "mounting" in whole else None,
        cable=CableDrag.from_json(whole["cable"], "cable") if "cable" in whole else None,
    )


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
