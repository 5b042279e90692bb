"""The node's services on the tools' files.

Files are read and written beside the executor (`galen_ros.rclpy_workarounds`), so that a slow disk
holds up no wrench; answers go out later. Only `~/set_tool` reads its one small file at once.

The active tool can't be removed. It can be renamed: it stays active under its new name, with
its tare, and the output doesn't change. It can be reverted: the file is then another one than what
was loaded, and the output doesn't change either.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from galen_model.arm.galen import JOINT_NAMES, SENSOR_FRAME
from galen_model.arrays import Array
from galen_model.errors import CalibrationFileError, GalenError, ToolNameError
from galen_model.files.calibration_store import (
    CalibrationStore,
    CalibrationStoreError,
    FileState,
    StoredCalibration,
)
from galen_model.files.comparison import CalibrationComparison, before_name, compare_calibrations
from galen_model.load.frames import (
    joint_vector,
    needed_joints,
    sensor_in_frame,
)
from galen_ros.cdr import JointStateError, JointWire, UnreadableError
from galen_ros.rclpy_workarounds import Background, DeferredService, Respond
from rclpy.node import Node

from galen_gravcomp.compensator import Compensator
from galen_gravcomp.tools.active import Active
from galen_gravcomp.tools.messages import (
    ActiveError,
    NothingActiveError,
    error_code,
    fill_comparison,
    summary,
)
from galen_msgs.msg import ToolSummary
from galen_msgs.srv import CompareTools, GetTool, ListTools, RemoveTool, RenameTool, RevertTool

MAX_LISTED = 500


@dataclass(frozen=True)
class LiveJoints:
    """Reads the five joints from the newest joint_states; `newest()`: wall time and message."""

    newest: Callable[[], tuple[float, bytes] | None]
    position_names: Sequence[str]
    angle_names: Sequence[str]
    max_age_s: float

    def read(self) -> Array:
        """Joints (5,), m and rad; NaN where they are not known, or were long ago."""
        joints = np.full(len(JOINT_NAMES), np.nan)
        newest = self.newest()
        if newest is None or time.monotonic() - newest[0] > self.max_age_s:
            return joints
        for names, place in ((self.angle_names, slice(3, 5)), (self.position_names, slice(0, 3))):
            try:
                joints[place] = JointWire(names).read(newest[1])[1]
            except (JointStateError, UnreadableError):
                continue
        return joints


class ToolServices:
    """What a node offers on the tools' files in `tools_dir`."""

    def __init__(
        self,
        node: Node,
        compensator: Compensator,
        tools_dir: str,
        joints: LiveJoints,
        on_note: Callable[[str], None],
    ) -> None:
        """`on_note(text)`: what became of the active file since; empty while as loaded."""
        self._node = node
        self._store = CalibrationStore(tools_dir)
        self._joints = joints
        self._changing: list[set[str]] = []
        self._background = Background(node)
        self.active_tool = Active(node, compensator, self._background, on_note)
        self._services = [
            DeferredService(node, ListTools, "~/list_tools", self._on_list),
            DeferredService(node, GetTool, "~/get_tool", self._on_get),
            DeferredService(node, CompareTools, "~/compare_tools", self._on_compare),
            DeferredService(node, RenameTool, "~/rename_tool", self._on_rename),
            DeferredService(node, RemoveTool, "~/remove_tool", self._on_remove),
            DeferredService(node, RevertTool, "~/revert_tool", self._on_revert),
        ]

    def read(self, name: str) -> StoredCalibration:
        """Read a tool that is to be activated; raises ToolNameError or CalibrationFileError."""
        if self._changes({name}):
            raise CalibrationFileError(f"tool '{name}' is being changed: ask again")
        return self._store.read(name)

    def close(self) -> None:
        """Call it before the services are destroyed: who waits for an answer gets one."""
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
                rows.append(summary(entry, entry.name == active_tool, self._reverts(entry.name)))
                time.sleep(0)  # the executor's thread may go on between two files
            return rows, len(names) - len(rows)

        def fill(result: tuple[list[ToolSummary], int]) -> None:
            response.tools_dir = str(self._store.directory)
            response.tools, response.left_out = result

        self._answer(response, respond, job, fill, "UNREADABLE")

    def _on_get(self, request: Any, response: Any, respond: Respond) -> None:
        live, active_tool = self._joints.read(), self.active_tool.stored

        def job() -> StoredCalibration:
            stored = self._named(request.tool, active_tool)
            own = ("", stored.tool.sensor_frame)
            frame = SENSOR_FRAME if request.frame in own else request.frame
            given = joint_vector(list(request.joints))
            joints = given if len(request.joints) else live
            used = [name in needed_joints(frame) for name in JOINT_NAMES]
            place = sensor_in_frame(frame, stored.tool.tip_m, joints)
            load = place.load(stored.tool.load)
            response.frame = request.frame or stored.tool.sensor_frame
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
            response, respond, job, lambda comparison: fill_comparison(response, comparison)
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
                raise ActiveError(
                    f"'{request.tool}' is active: put another active tool first, or none"
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
        """A tool, or the calibration before it, and what to call it; may read a file."""
        if previous:
            tool = name or self._named(name, active_tool).tool.tool
            return self._store.previous(tool), before_name(tool)
        stored = self._named(name, active_tool)
        return stored, name or f"active {stored.tool.tool}"

    def _named(self, name: str, active_tool: StoredCalibration | None) -> StoredCalibration:
        """A tool by its name; empty: the active one, as it was loaded."""
        if name:
            return self._store.read(name)
        if active_tool is None:
            raise NothingActiveError("no tool is active: give a tool's name")
        return active_tool
