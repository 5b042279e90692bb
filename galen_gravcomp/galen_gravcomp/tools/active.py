"""Which tool is active, told on the latched topic `~/active_tool` and kept under watch.

The file on disk is looked at from time to time: one that has changed since it was loaded, such as
by a new calibration, is not what is compensated with.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from galen_model.arm.galen import SENSOR
from galen_model.files.calibration_store import FileState, StoredCalibration
from galen_ros.messages import LATCHED
from galen_ros.rclpy_workarounds import Background
from rclpy.node import Node

from galen_gravcomp.compensator import Compensator
from galen_gravcomp.tools.messages import active_message
from galen_msgs.msg import ActiveTool

_FILE_CHECK_S = 2.0
_NOTES = {
    FileState.AS_LOADED: "",
    FileState.CHANGED: "its file has changed since it was loaded: call ~/set_tool to load it again",
    FileState.GONE: "its file is gone since it was loaded",
}


class Active:
    """The active tool, as it was loaded."""

    def __init__(
        self,
        node: Node,
        compensator: Compensator,
        background: Background,
        on_note: Callable[[str], None],
    ) -> None:
        """`on_note(text)`: what became of the file since; empty while it is as loaded."""
        self._node = node
        self._compensator = compensator
        self._background = background
        self._on_note = on_note
        self._stored: StoredCalibration | None = None
        self._file_state = FileState.AS_LOADED
        self._checking = False
        self._checked_s = time.monotonic()
        self._said: tuple[object, ...] = ()
        self._said_bias_drift = np.zeros(6)
        self._publisher = node.create_publisher(ActiveTool, "~/active_tool", LATCHED)

    @property
    def stored(self) -> StoredCalibration | None:
        """The tool; None where there is none."""
        return self._stored

    @property
    def name(self) -> str:
        """The tool's name; empty where there is none."""
        return "" if self._stored is None else self._stored.tool.tool

    def put(self, stored: StoredCalibration | None) -> None:
        """Say that this one is active now, read just before."""
        self._stored = stored
        self._set_file_state(FileState.AS_LOADED)

    def rename(self, stored: StoredCalibration) -> None:
        """Say that the active one has another name and file; what became of it stays."""
        self._stored = stored
        self._compensator.rename_tool(stored.tool.tool)
        self.update()

    def update(self) -> None:
        """Publish what is active if it has changed; cheap, to be called often.

        A bias drift's estimate never stands still: it is told when it has moved by a sensor's
        quantum.
        """
        compensator = self._compensator
        bias_drift = compensator.bias_drift_offset
        tare = tuple(compensator.tare_offset)
        stored = self._stored
        loaded = None if stored is None else (stored.path, stored.sha256)
        says = (loaded, self._file_state, compensator.enabled, tare, bias_drift is None)
        step = np.zeros(6) if bias_drift is None else bias_drift - self._said_bias_drift
        if says == self._said and not np.any(np.abs(step) > SENSOR.quantum):
            return
        self._said = says
        self._said_bias_drift = self._said_bias_drift + step
        message = active_message(stored, self._file_state, compensator)
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def watch(self, now_s: float) -> None:
        """Look after the file now and then, and `update`; to be called a few times a second."""
        loaded = self._stored
        if loaded is not None and not self._checking and now_s - self._checked_s > _FILE_CHECK_S:
            self._checking, self._checked_s = True, now_s
            self._background.submit(
                loaded.file_state, lambda state: self._on_file_state(loaded, state)
            )
        self.update()

    def _on_file_state(self, loaded: StoredCalibration, state: FileState) -> None:
        self._checking = False
        if loaded is self._stored and state is not self._file_state:
            self._set_file_state(state)
            self.update()

    def _set_file_state(self, state: FileState) -> None:
        self._file_state = state
        self._on_note(_NOTES[state])
