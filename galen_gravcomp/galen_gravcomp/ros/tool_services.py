# SPDX-License-Identifier: Apache-2.0
"""The node's services on the calibration files, and what is active on a latched topic.

Files are read and written beside the executor (`galen_ros.rclpy_workarounds`), so that a slow disk
holds up no wrench; answers go out later. Only `~/set_tool` reads its one small file at once.

The active tool can't be removed. It can be renamed: it stays active under its new name, with
its tare, and the output doesn't change. It can be reverted: the file is then another one than what
was loaded, and the output doesn't change either. The file on disk is looked at from time to time:
one that has changed since it was loaded, such as by a new calibration, is not what is active.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_store import (
    CalibrationStore,
    CalibrationStoreError,
    Entry,
    FileState,
    StoredCalibration,
    ToolExistsError,
)
from galen_model.files.comparison import (
    CalibrationComparison,
    IncomparableError,
    before_name,
    compare_calibrations,
)
from galen_model.load.frames import (
    FrameError,
    FrameNeedsJointsError,
    joint_vector,
    needed_joints,
    sensor_in_frame,
)
from galen_ros.messages import LATCHED
from galen_ros.rclpy_workarounds import BackgroundJobs, DeferredService, Respond
from geometry_msgs.msg import Wrench
from rclpy.node import Node

from galen_gravcomp.compensator import Compensator
from galen_msgs.msg import ActiveTool, ToolDifference, ToolSummary
from galen_msgs.srv import CompareTools, GetTool, ListTools, RemoveTool, RenameTool, RevertTool

MAX_LISTED = 500
_MOST_POSES = 65535
"""A uint16 of the message; the file may hold any number."""
_FILE_CHECK_S = 2.0
# The message's constant, its name in `tools active`, and the note on /diagnostics.
FILE_STATES = {
    FileState.AS_LOADED: (ActiveTool.FILE_AS_LOADED, "as loaded", ""),
    FileState.CHANGED: (
        ActiveTool.FILE_CHANGED,
        "changed",
        "its file has changed since it was loaded: call ~/set_tool to load it again",
    ),
    FileState.GONE: (ActiveTool.FILE_GONE, "gone", "its file is gone since it was loaded"),
}
_CODES: dict[type[GalenError], str] = {
    ToolNameError: "INVALID_NAME",
    ToolExistsError: "EXISTS",
    FrameError: "INVALID_FRAME",
    FrameNeedsJointsError: "NEEDS_JOINTS",
    IncomparableError: "INCOMPARABLE",
}


class ActiveToolError(GalenError):
    """A request that what is active forbids; `code`: by its name in the answer."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


def error_code(response: Any, error: GalenError, otherwise: str) -> int:
    """Return an error's code in an answer.

    Args:
        response: the service's response, which has the codes as constants.
        error: the error.
        otherwise: name of the code of any error without one of its own.

    Returns:
        The code.

    """
    name = _CODES.get(type(error), otherwise)
    if isinstance(error, ActiveToolError):
        name = error.code
    if isinstance(error, CalibrationFileError):
        missing = isinstance(error.__cause__, FileNotFoundError)
        name = "NOT_FOUND" if missing else "INVALID_FILE"
    return int(getattr(response, name))


class ActiveToolTopic:
    """The active tool, as it was loaded, on the latched topic `~/active_tool`."""

    def __init__(
        self,
        node: Node,
        compensator: Compensator,
        background: BackgroundJobs,
        on_note: Callable[[str], None],
    ) -> None:
        """`on_note(text)`: what became of the file since; empty while it is as loaded."""
        self._node = node
        self._compensator = compensator
        self._background = background
        self._on_note = on_note
        self.stored: StoredCalibration | None = None
        self._file_state = FileState.AS_LOADED
        self._checking = False
        self._checked_s = time.monotonic()
        self._sent: tuple[object, ...] = ()
        self._sent_bias_drift = np.zeros(6)
        self._publisher = node.create_publisher(ActiveTool, "~/active_tool", LATCHED)

    @property
    def name(self) -> str:
        """The tool's name; empty where there is none."""
        return "" if self.stored is None else self.stored.tool.tool

    def put(self, stored: StoredCalibration | None) -> None:
        """Take another active tool, read just before.

        Args:
            stored: the tool and its file; None: no tool.

        """
        self.stored = stored
        self._set_file_state(FileState.AS_LOADED)

    def rename(self, stored: StoredCalibration) -> None:
        """Follow a new name and file of the active tool; the file's state stays.

        Args:
            stored: the tool under its new name.

        """
        self.stored = stored
        self._compensator.rename_tool(stored.tool.tool)
        self.update()

    def update(self) -> None:
        """Publish what is active if it has changed; cheap, to be called often.

        A bias drift's estimate never stays: it is sent when it has moved by a sensor's quantum.
        """
        compensator = self._compensator
        bias_drift = compensator.bias_drift_offset
        tare = tuple(compensator.tare_offset)
        loaded = None if self.stored is None else (self.stored.path, self.stored.sha256)
        state = (loaded, self._file_state, compensator.enabled, tare, bias_drift is None)
        step = np.zeros(6) if bias_drift is None else bias_drift - self._sent_bias_drift
        if state == self._sent and not np.any(np.abs(step) > SENSOR.quantum):
            return
        self._sent = state
        self._sent_bias_drift = self._sent_bias_drift + step
        self._publisher.publish(self._message(bias_drift))

    def watch(self, now_s: float) -> None:
        """Check the file now and then, and `update`; to be called a few times a second.

        Args:
            now_s: wall time, s, monotonic.

        """
        loaded = self.stored
        if loaded is not None and not self._checking and now_s - self._checked_s > _FILE_CHECK_S:
            self._checking, self._checked_s = True, now_s
            self._background.submit(
                loaded.file_state, lambda state: self._on_file_state(loaded, state)
            )
        self.update()

    def _on_file_state(self, loaded: StoredCalibration, state: FileState) -> None:
        self._checking = False
        if loaded is self.stored and state is not self._file_state:
            self._set_file_state(state)
            self.update()

    def _set_file_state(self, state: FileState) -> None:
        self._file_state = state
        self._on_note(FILE_STATES[state][2])

    def _message(self, bias_drift: Array | None) -> ActiveTool:
        offset = self._compensator.tare_offset
        message = ActiveTool(enabled=self._compensator.enabled)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = self._compensator.pairing.sensor_frame
        message.tared = bool(offset.any())
        message.tare = _wrench(offset)
        message.bias_drift_estimated = bias_drift is not None
        message.bias_drift = _wrench(np.zeros(6) if bias_drift is None else bias_drift)
        if self.stored is None:
            return message
        tool = self.stored.tool
        message.tool = tool.tool
        message.mass_kg = float(tool.load.mass_kg)
        message.com_m = np.asarray(tool.load.com_m, dtype=float)
        message.covariance = np.asarray(tool.load.covariance, dtype=float).ravel()
        message.tip_m = np.asarray(tool.tip_m, dtype=float)
        message.adapter_mass_kg = float(tool.adapter.mass_kg)
        message.adapter_com_m = np.asarray(tool.adapter.com_m, dtype=float)
        message.parts = list(tool.parts)
        message.calibrated_at = tool.calibrated_at
        message.path = str(self.stored.path)
        message.sha256 = self.stored.sha256
        message.file_state = FILE_STATES[self._file_state][0]
        return message


def _wrench(values: Array) -> Wrench:
    message = Wrench()
    force, torque = message.force, message.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = (float(value) for value in values)
    return message


class ToolServices:
    """What a node offers on the calibration files in `tools_dir`."""

    def __init__(
        self,
        node: Node,
        compensator: Compensator,
        tools_dir: str,
        live_joints: Callable[[], Array],
        on_note: Callable[[str], None],
    ) -> None:
        """Offer the services.

        live_joints: joints (n,), m and rad, NaN where they are not known. `on_note(text)`: what
        became of the active file since; empty while as loaded.
        """
        self._node = node
        self._store = CalibrationStore(tools_dir, compensator.arm)
        self._live_joints = live_joints
        self._changing: list[set[str]] = []
        self._background = BackgroundJobs(node)
        self.active_tool = ActiveToolTopic(node, compensator, self._background, on_note)
        self._services = [
            DeferredService(node, ListTools, "~/list_tools", self._on_list),
            DeferredService(node, GetTool, "~/get_tool", self._on_get),
            DeferredService(node, CompareTools, "~/compare_tools", self._on_compare),
            DeferredService(node, RenameTool, "~/rename_tool", self._on_rename),
            DeferredService(node, RemoveTool, "~/remove_tool", self._on_remove),
            DeferredService(node, RevertTool, "~/revert_tool", self._on_revert),
        ]

    def read(self, name: str) -> StoredCalibration:
        """Read a tool that is to be activated.

        Args:
            name: the tool's.

        Returns:
            The tool and its file.

        Raises:
            ToolNameError: the name is not allowed.
            CalibrationFileError: the file is missing or invalid, or is being changed.

        """
        if self._changes({name}):
            raise CalibrationFileError(f"tool '{name}' is being changed: ask again")
        return self._store.read(name)

    def close(self) -> None:
        """Answer waiting requests; to be called before the services are destroyed."""
        self._background.close()

    # Services

    def _answer(
        self,
        response: Any,
        respond: Respond,
        job: Callable[[], Any],
        fill: Callable[[Any], None],
        otherwise: str = "INVALID_FILE",
    ) -> None:
        """Run `job` beside the executor, then `fill(its result)` the response, and send it.

        A GalenError of the job is the answer; `otherwise`: the code of a CalibrationStoreError.
        """

        def guarded() -> Any:
            try:
                return job()
            except GalenError as error:
                return error

        def done(result: Any) -> None:
            if isinstance(result, GalenError):
                response.success, response.error_msg = False, str(result)
                response.error_code = error_code(response, result, otherwise)
            else:
                response.success = True
                fill(result)
            respond(response)

        def dropped() -> None:
            done(CalibrationStoreError("not done: the node was shut down or cleaned up meanwhile"))

        self._background.submit(guarded, done, dropped)

    def _on_list(self, _request: Any, response: Any, respond: Respond) -> None:
        active_tool = self.active_tool.name

        def job() -> tuple[list[ToolSummary], int]:
            names = self._store.names()
            rows = []
            for entry in self._store.entries(names[:MAX_LISTED]):
                rows.append(_summary(entry, entry.name == active_tool, self._reverts(entry.name)))
                time.sleep(0)  # the executor's thread may go on between two files
            return rows, len(names) - len(rows)

        def fill(result: tuple[list[ToolSummary], int]) -> None:
            response.tools_dir = str(self._store.directory)
            response.tools, response.left_out = result

        self._answer(response, respond, job, fill, "UNREADABLE")

    def _on_get(self, request: Any, response: Any, respond: Respond) -> None:
        live, active_tool = self._live_joints(), self.active_tool.stored

        def job() -> StoredCalibration:
            stored, arm = self._named(request.tool, active_tool), self._store.arm
            frame = request.frame or arm.sensor_frame
            given = joint_vector(list(request.joints), arm)
            joints = given if len(request.joints) else live
            used = [name in needed_joints(frame, arm) for name in arm.joint_names]
            place = sensor_in_frame(frame, stored.tool.tip_m, joints, arm=arm)
            load = place.load(stored.tool.load)
            response.frame = frame
            response.joints = np.where(used, joints, math.nan)
            response.mass_kg = float(load.mass_kg)
            response.com_m = load.com_m
            response.covariance = load.covariance.ravel()
            response.tip_m = place.point(stored.tool.tip_m)
            return stored

        def fill(stored: StoredCalibration) -> None:
            response.tool = stored.tool.tool
            response.active_tool = active_tool is not None and stored.sha256 == active_tool.sha256
            response.parts = list(stored.tool.parts)
            response.calibrated_at = stored.tool.calibrated_at
            response.path = str(stored.path)
            response.sha256 = stored.sha256
            response.content = stored.content

        self._answer(response, respond, job, fill)

    def _on_compare(self, request: Any, response: Any, respond: Respond) -> None:
        active_tool = self.active_tool.stored

        def job() -> CalibrationComparison:
            a, name_a = self._compared(request.a, request.a_previous, active_tool)
            b, name_b = self._compared(request.b, request.b_previous, active_tool)
            return compare_calibrations(a.tool, b.tool, (name_a, name_b))

        self._answer(
            response, respond, job, lambda comparison: _fill_comparison(response, comparison)
        )

    def _on_rename(self, request: Any, response: Any, respond: Respond) -> None:
        loaded = self.active_tool.stored if request.tool == self.active_tool.name else None
        changing = {request.tool, request.new_name}

        def job() -> tuple[StoredCalibration, bool]:
            as_loaded = loaded is not None and loaded.file_state() is FileState.AS_LOADED
            return self._store.rename(request.tool, request.new_name), as_loaded

        def fill(result: tuple[StoredCalibration, bool]) -> None:
            stored, as_loaded = result
            response.path = str(stored.path)
            if loaded is not None and loaded is self.active_tool.stored:
                # What is active is what was loaded, also where the file has changed since.
                tool = replace(loaded.tool, tool=stored.tool.tool)
                changed = replace(loaded, path=stored.path, tool=tool)
                self.active_tool.rename(stored if as_loaded else changed)
            self._node.get_logger().info(
                f"tool '{request.tool}' is now '{request.new_name}'; a launch file's parameter"
                " 'tool' that names it must be changed, too"
            )

        self._change(changing, response, respond, job, fill)

    def _on_remove(self, request: Any, response: Any, respond: Respond) -> None:
        active_tool = request.tool == self.active_tool.name

        def job() -> str:
            if active_tool:
                raise ActiveToolError(
                    "IN_FORCE",
                    f"'{request.tool}' is active: put another active tool first, or none",
                )
            return str(self._store.remove(request.tool))

        def fill(kept_as: str) -> None:
            response.kept_as = kept_as
            self._node.get_logger().info(f"tool '{request.tool}' is removed: {kept_as}")

        self._change({request.tool}, response, respond, job, fill)

    def _on_revert(self, request: Any, response: Any, respond: Respond) -> None:
        def fill(stored: StoredCalibration) -> None:
            response.path = str(stored.path)
            self._node.get_logger().info(
                f"tool '{request.tool}' is as calibrated {stored.tool.calibrated_at} again;"
                " what is active stays until ~/set_tool is called"
            )

        self._change(
            {request.tool}, response, respond, lambda: self._store.revert(request.tool), fill
        )

    def _change(
        self,
        names: set[str],
        response: Any,
        respond: Respond,
        job: Callable[[], Any],
        fill: Callable[[Any], None],
    ) -> None:
        """As `_answer`; until the answer none of the names can be activated or changed."""
        if self._changes(names):
            response.success, response.error_code = False, response.UNWRITABLE
            response.error_msg = f"{' or '.join(sorted(names))}: is being changed: ask again"
            respond(response)
            return
        self._changing.append(names)

        def respond_and_release(answer: Any) -> None:
            self._changing.remove(names)
            respond(answer)

        self._answer(response, respond_and_release, job, fill, "UNWRITABLE")

    def _changes(self, names: set[str]) -> bool:
        return any(names & changing for changing in self._changing)

    def _reverts(self, name: str) -> bool:
        try:
            return self._store.has_previous(name)
        except ToolNameError:  # the list has files of any name
            return False

    def _compared(
        self, name: str, previous: bool, active_tool: StoredCalibration | None
    ) -> tuple[StoredCalibration, str]:
        if previous:
            tool = name or self._named(name, active_tool).tool.tool
            return self._store.previous(tool), before_name(tool)
        stored = self._named(name, active_tool)
        return stored, name or f"active {stored.tool.tool}"

    def _named(self, name: str, active_tool: StoredCalibration | None) -> StoredCalibration:
        if name:
            return self._store.read(name)
        if active_tool is None:
            raise ActiveToolError("NOT_FOUND", "no tool is active: give a tool's name")
        return active_tool


def _fill_comparison(response: Any, comparison: CalibrationComparison) -> None:
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
    response.worst_force_n, response.worst_force_at = comparison.worst_force
    response.worst_torque_nm, response.worst_torque_at = comparison.worst_torque


def _summary(entry: Entry, active_tool: bool, has_previous: bool) -> ToolSummary:
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
