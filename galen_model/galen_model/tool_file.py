"""A tool's file `<tools_dir>/<tool>.json`: read with checks, written whole or not at all.

Writing puts the new text into a temporary file beside the old one, syncs it to the disk and
renames it over the old name, which POSIX does in one step; before that the old file gets a second
name, `<tool>.json.bak`. A process killed at any moment leaves the old file or the new one.
"""

import json
import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm import GRAVITY_M_S2, SENSOR_FRAME
from galen_model.arrays import Array
from galen_model.errors import ToolFileError, ToolNameError
from galen_model.kinematics import gravity_in_sensor
from galen_model.load import Load, gravity_wrench

SCHEMA_VERSION = 1
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MAX_FILE_BYTES = 1_000_000
_LARGEST = 1e6
"""No SI number of a tool at a wrist comes near it; what is larger would overflow in a product."""


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

    def predict(self, roll_rad: ArrayLike, tilt_rad: ArrayLike) -> Array:
        """Reading (..., 6) expected at roll and tilt (...) without touch, N and N.m in ft_sensor.

        reading = W(theta; tool) + W(theta; adapter) - W(theta_bias; adapter) + residual offset
        """
        return self.predict_under(gravity_in_sensor(roll_rad, tilt_rad) * self._gravity_scale)

    def predict_under(self, gravity_sensor: ArrayLike) -> Array:
        """As `predict`, from gravity (..., 3) in the sensor's frame, m/s^2."""
        at_bias = gravity_in_sensor(self.bias_roll_rad, self.bias_tilt_rad) * self._gravity_scale
        return (
            gravity_wrench(gravity_sensor, self.load.load)
            + gravity_wrench(gravity_sensor, self.bias.load)
            - gravity_wrench(at_bias, self.bias.load)
            + self.residual_offset
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
            "gravity_m_s2": _numbers(self.gravity_m_s2),
            "bias_pose_rad": {"roll": self.bias_roll_rad, "tilt": self.bias_tilt_rad},
            "load": _load_to_json(self.load),
            "bias": _load_to_json(self.bias),
            "residual_offset": _wrench_to_json(self.residual_offset),
            "tip_m": _numbers(self.tip_m),
            "rmse": _wrench_to_json(self.rmse),
            "poses_used": self.poses_used,
            "poses_rejected": list(self.poses_rejected),
            "calibrated_at": self.calibrated_at,
        }
        if self.unresolved:
            content["unresolved"] = list(self.unresolved)
        return content


def check_tool_name(name: str) -> str:
    """Return `name` if it may name a file.

    Raises ToolNameError unless it is 1 to 64 letters, digits, '_' and '-'.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ToolNameError(
            f"tool name {name!r}: a name holds 1 to 64 letters, digits, '_' and '-', nothing else"
        )
    return name


def tool_path(tools_dir: str | os.PathLike[str], tool: str) -> Path:
    """Path of a tool's file; raises ToolNameError for a name that is not allowed."""
    return Path(tools_dir).expanduser() / f"{check_tool_name(tool)}.json"


def read_tool(path: str | os.PathLike[str]) -> ToolFile:
    """Read and check a tool's file. Raises ToolFileError that names the file and the field."""
    path = Path(path)
    try:
        with path.open("rb") as stream:
            raw = stream.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ToolFileError(f"{path}: can't be read: {error.strerror}") from error
    if len(raw) > _MAX_FILE_BYTES:
        raise ToolFileError(f"{path}: larger than {_MAX_FILE_BYTES} bytes, not a tool's file")
    try:
        content = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise ToolFileError(f"{path}: not JSON: {error}") from error
    try:
        return _from_json(content)
    except (_FieldError, ToolNameError, RecursionError) as error:
        raise ToolFileError(f"{path}: {error}") from error


def write_tool(path: str | os.PathLike[str], tool: ToolFile) -> None:
    """Write a tool's file whole or not at all; the old one is kept as `.bak`.

    Raises ToolFileError, naming the file; the old file is then untouched.
    """
    path = Path(path)
    try:
        content = tool.to_json()
        _from_json(json.loads(json.dumps(content)))  # what can't be read must not be written
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    except (ValueError, _FieldError, ToolNameError) as error:
        raise ToolFileError(f"{path}: not written: {error}") from error
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            Path(temporary).chmod(0o644)  # mkstemp's 0600 would hide it from the lab's others
            _keep_backup(path)
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
        _sync_directory(path.parent)
    except OSError as error:
        raise ToolFileError(f"{path}: can't be written: {error.strerror}") from error


def _keep_backup(path: Path) -> None:
    """Give the old file its second name; the backup, too, changes in one step."""
    if not path.exists():
        return
    backup = path.with_name(path.name + ".bak")
    spare = path.with_name(f".{path.name}.bak.{os.getpid()}")
    spare.unlink(missing_ok=True)
    try:
        os.link(path, spare)
    except OSError:  # a file system without hard links
        spare.write_bytes(path.read_bytes())
    os.replace(spare, backup)


def _sync_directory(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems can't sync a directory; the rename itself is done
    finally:
        os.close(handle)


class _FieldError(ValueError):
    """A field is missing or wrong; the message names it."""


def _numbers(values: ArrayLike) -> list[float]:
    return [float(value) for value in np.asarray(values, dtype=float)]


def _load_to_json(estimate: LoadEstimate) -> dict[str, Any]:
    return {
        "mass_kg": float(estimate.mass_kg),
        "com_m": _numbers(estimate.com_m),
        "covariance": [_numbers(row) for row in estimate.covariance],
    }


def _wrench_to_json(wrench: Array) -> dict[str, Any]:
    return {"force_N": _numbers(wrench[:3]), "torque_Nm": _numbers(wrench[3:])}


def _from_json(content: Any) -> ToolFile:
    whole = _mapping(content, "the file")
    version = _get(whole, "schema_version")
    if version != SCHEMA_VERSION or isinstance(version, bool):
        raise _FieldError(f"schema_version is {version!r}; this version reads {SCHEMA_VERSION}")
    pose = _mapping(_get(whole, "bias_pose_rad"), "bias_pose_rad")
    gravity = _array(_get(whole, "gravity_m_s2"), "gravity_m_s2", (3,))
    if gravity[0] != 0.0 or gravity[1] != 0.0 or not 9.7 < -gravity[2] < 9.9:
        raise _FieldError(f"gravity_m_s2 is {gravity.tolist()}; expected (0, 0, about -9.8)")
    used = _get(whole, "poses_used")
    if not isinstance(used, int) or isinstance(used, bool) or used < 0:
        raise _FieldError(f"poses_used is {used!r}; expected a count")
    return ToolFile(
        tool=check_tool_name(_text(_get(whole, "tool"), "tool")),
        load=_load(_get(whole, "load"), "load"),
        bias=_load(_get(whole, "bias"), "bias", none_allowed=True),
        tip_m=_array(_get(whole, "tip_m"), "tip_m", (3,)),
        rmse=_wrench(_get(whole, "rmse"), "rmse"),
        poses_used=used,
        calibrated_at=_time(_get(whole, "calibrated_at")),
        residual_offset=_wrench(_get(whole, "residual_offset"), "residual_offset"),
        bias_roll_rad=_number(_get(pose, "roll"), "bias_pose_rad.roll"),
        bias_tilt_rad=_number(_get(pose, "tilt"), "bias_pose_rad.tilt"),
        poses_rejected=_texts(_get(whole, "poses_rejected"), "poses_rejected"),
        sensor_frame=_text(_get(whole, "sensor_frame"), "sensor_frame"),
        gravity_m_s2=gravity,
        unresolved=_texts(whole.get("unresolved", []), "unresolved"),
    )


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _FieldError(f"{name} is not an object")
    return value


def _get(mapping: Mapping[str, Any], name: str) -> Any:
    if name not in mapping:
        raise _FieldError(f"{name} is missing")
    return mapping[name]


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value:
        raise _FieldError(f"{name} is {value!r}; expected a text")
    return value


def _texts(value: Any, name: str) -> tuple[str, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise _FieldError(f"{name} is not a list")
    return tuple(str(item) for item in value)


def _number(value: Any, name: str) -> float:
    # The comparison, unlike float(), takes integers of any size; NaN fails it.
    if not _is_number(value) or not abs(value) <= _LARGEST:
        raise _FieldError(f"{name} is {value!r:.40}; expected a finite number up to {_LARGEST:g}")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _holds_numbers(value: Any) -> bool:
    if isinstance(value, list):
        return all(_holds_numbers(item) for item in value)
    return _is_number(value)


def _array(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    if not _holds_numbers(value):
        raise _FieldError(f"{name} does not hold numbers")
    try:
        array = np.array(value, dtype=float)
    except (ValueError, OverflowError):
        raise _FieldError(f"{name} does not hold numbers of the shape {shape}") from None
    if array.shape != shape:
        raise _FieldError(f"{name} has shape {array.shape}; expected {shape}")
    if not np.all(np.abs(array) <= _LARGEST):
        raise _FieldError(f"{name} holds a value that is not finite, or above {_LARGEST:g}")
    return array


def _wrench(value: Any, name: str) -> Array:
    mapping = _mapping(value, name)
    return np.concatenate(
        [
            _array(_get(mapping, "force_N"), f"{name}.force_N", (3,)),
            _array(_get(mapping, "torque_Nm"), f"{name}.torque_Nm", (3,)),
        ]
    )


def _load(value: Any, name: str, none_allowed: bool = False) -> LoadEstimate:
    """`none_allowed`: nothing may have hung on the sensor, so that the mass is zero."""
    mapping = _mapping(value, name)
    mass = _number(_get(mapping, "mass_kg"), f"{name}.mass_kg")
    if mass < 0.0 or (mass == 0.0 and not none_allowed):
        raise _FieldError(f"{name}.mass_kg is {mass}; a mass is positive")
    covariance = _array(_get(mapping, "covariance"), f"{name}.covariance", (4, 4))
    if np.any(np.diag(covariance) < 0.0):
        raise _FieldError(f"{name}.covariance has a negative variance")
    com = _array(_get(mapping, "com_m"), f"{name}.com_m", (3,))
    return LoadEstimate(mass, com, covariance)


def _time(value: Any) -> str:
    text = _text(value, "calibrated_at")
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise _FieldError(f"calibrated_at is {text!r}; expected an RFC 3339 time") from None
    if moment.tzinfo is None:
        raise _FieldError(f"calibrated_at is {text!r}; it has no time zone")
    return text
