"""What the node's services on tools answer, as messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_store import Entry, FileState, StoredCalibration, ToolExistsError
from galen_model.files.comparison import CalibrationComparison, IncomparableError
from galen_model.load.frames import FrameError, FrameNeedsJointsError
from geometry_msgs.msg import Wrench

from galen_gravcomp.compensator import Compensator
from galen_msgs.msg import ActiveTool, ToolDifference, ToolSummary


class ActiveError(GalenError):
    """The tool is active, and can't be removed."""


class NothingActiveError(GalenError):
    """There is no active tool."""


_MOST_POSES = 65535
"""A uint16 of the message; the file may say any number."""
_FILE_STATES = {
    FileState.AS_LOADED: ActiveTool.FILE_AS_LOADED,
    FileState.CHANGED: ActiveTool.FILE_CHANGED,
    FileState.GONE: ActiveTool.FILE_GONE,
}
_CODES: dict[type[GalenError], str] = {
    ToolNameError: "INVALID_NAME",
    ToolExistsError: "EXISTS",
    FrameError: "INVALID_FRAME",
    FrameNeedsJointsError: "NEEDS_JOINTS",
    IncomparableError: "INCOMPARABLE",
    ActiveError: "IN_FORCE",
    NothingActiveError: "NOT_FOUND",
}


def error_code(response: Any, error: GalenError, otherwise: str) -> int:
    """The code of an error in an answer; `otherwise`: the name of that of any other error."""
    name = _CODES.get(type(error), otherwise)
    if isinstance(error, CalibrationFileError):
        missing = isinstance(error.__cause__, FileNotFoundError)
        name = "NOT_FOUND" if missing else "INVALID_FILE"
    return int(getattr(response, name))


def active_message(
    stored: StoredCalibration | None, state: FileState, compensator: Compensator
) -> ActiveTool:
    """What is active; `stored`: the tool as it was loaded, `state`: its file since."""
    offset, bias_drift = compensator.tare_offset, compensator.bias_drift_offset
    message = ActiveTool(enabled=compensator.enabled)
    message.header.frame_id = compensator.pairing.sensor_frame
    message.tared = bool(offset.any())
    message.tare = _wrench(offset)
    message.bias_drift_estimated = bias_drift is not None
    message.bias_drift = _wrench(np.zeros(6) if bias_drift is None else bias_drift)
    if stored is None:
        return message
    tool = stored.tool
    message.tool = tool.tool
    message.mass_kg = float(tool.load.mass_kg)
    message.com_m = np.asarray(tool.load.com_m, dtype=float)
    message.covariance = np.asarray(tool.load.covariance, dtype=float).ravel()
    message.tip_m = np.asarray(tool.tip_m, dtype=float)
    message.adapter_mass_kg = float(tool.adapter.mass_kg)
    message.adapter_com_m = np.asarray(tool.adapter.com_m, dtype=float)
    message.parts = list(tool.parts)
    message.calibrated_at = tool.calibrated_at
    message.path = str(stored.path)
    message.sha256 = stored.sha256
    message.file_state = _FILE_STATES[state]
    return message


def fill_comparison(response: Any, comparison: CalibrationComparison) -> None:
    """Write a comparison into the answer of `~/compare_tools`."""
    response.same_load, response.text = comparison.same_load, comparison.text
    response.differences = [
        ToolDifference(
            quantity=row.quantity,
            unit=row.unit,
            a=float(row.a),
            b=float(row.b),
            difference=float(row.value),
            std_dev=float(row.std_dev),
            text=row.text,
        )
        for row in comparison.differences
    ]
    response.worst_force_n = comparison.worst_force.size
    response.worst_force_at = comparison.worst_force.at_rad
    response.worst_torque_nm = comparison.worst_torque.size
    response.worst_torque_at = comparison.worst_torque.at_rad


def summary(entry: Entry, active_tool: bool, has_previous: bool) -> ToolSummary:
    """A row of the list."""
    row = ToolSummary(tool=entry.name, problem=entry.problem, active_tool=active_tool)
    row.has_previous = has_previous
    row.rmse_force_n = row.rmse_torque_nm = np.full(3, np.nan)
    if entry.stored is not None:
        tool = entry.stored.tool
        row.mass_kg = float(tool.load.mass_kg)
        row.mass_std_kg = tool.load.mass_std_kg
        row.com_m = np.asarray(tool.load.com_m, dtype=float)
        row.rmse_force_n, row.rmse_torque_nm = tool.rmse[:3], tool.rmse[3:]
        row.poses_used = min(tool.poses_used, _MOST_POSES)
        row.calibrated_at = tool.calibrated_at
        row.parts = list(tool.parts)
    return row


def _wrench(values: Array) -> Wrench:
    message = Wrench()
    force, torque = message.force, message.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = (float(value) for value in values)
    return message
