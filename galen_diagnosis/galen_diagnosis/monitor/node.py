"""The node gap_monitor: says on /diagnostics whether the arm at rest reads as the model does."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from galen_model.errors import GalenError, ToolFileError, ToolNameError
from galen_model.files.calibration_file import LoadEstimate, ToolFile
from galen_model.files.calibration_store import ToolStore
from galen_ros.cdr.wire import RawWrench
from galen_ros.node.background import Background
from galen_ros.node.spin import run
from galen_ros.qos import LATCHED
from galen_ros.stream.node import StreamNode
from galen_ros.stream.results import Rejected

from galen_diagnosis.monitor.gap_effects import likely_effects
from galen_diagnosis.monitor.gap_parameters import GapMonitorParameters
from galen_diagnosis.monitor.gap_stream import GapMonitor, GapPairing, Judged
from galen_diagnosis.monitor.gap_watch import GapNotice
from galen_msgs.msg import ActiveTool

_EFFECTS_EVERY_S = 20.0


class GapMonitorNode(StreamNode):
    """Declares, converts and calls; what is a gap, `galen_diagnosis.monitor.gap_watch` says."""

    hardware_id = "galen_gap_monitor"
    cleared_on_restart = "stops and noise"

    def __init__(self, **node_options: Any) -> None:
        super().__init__("gap_monitor", **node_options)
        self._held = self.hold(GapMonitorParameters)
        self.start()

    def _configure(self) -> None:
        p = self._held.now
        self._gap = GapPairing(p.pairing(), p.gap(), self._on_restart)
        self._says = GapMonitor(self._gap, p.silence_s)
        self._store = ToolStore(p.tools_dir)
        self._background = Background(self)
        self._at_undo(self._background.close)
        self._asked_s = float("-inf")
        self._asking = False
        self._active: tuple[object, ...] = ()
        if p.tool:
            self._load(p.tool)
        self._begin(self._gap, self._says, p.joint_names, p.best_effort_input)
        if not p.tool:
            topic = f"{p.gravcomp_node}/active_tool"
            self.create_subscription(ActiveTool, topic, self._on_active_tool, LATCHED)

    # Samples

    @property
    def samples(self) -> int:
        """Wrenches received so far."""
        return self._gap.received

    def _push_joints(self, stamp_ns: int, positions: tuple[float, ...]) -> list[Judged | Rejected]:
        return self._gap.push_joints(stamp_ns, positions)

    def _publish(self, result: Judged, raw: RawWrench) -> None:
        """Nothing: all is on /diagnostics."""

    # The tool

    def _load(self, name: str) -> None:
        try:
            self._put_on(self._store.read(name).tool)
        except (ToolNameError, ToolFileError) as error:
            if not self.starts_itself:
                raise  # whoever configures it hears of it
            # The node lives on, so that the state is on /diagnostics.
            self._says.set_tool_trouble(f"no tool: {error}")

    def _put_on(self, tool: ToolFile | None) -> None:
        self._says.set_tool_trouble("" if tool is not None else "gravcomp has no active tool")
        self._says.set_effects([])
        results = self._gap.set_tool(tool)
        if results:
            self._emit(results)

    def _on_active_tool(self, message: ActiveTool) -> None:
        """Follow gravcomp's tool; a tare or the bias drift's estimate changes nothing here."""
        now = (message.tool, message.sha256)
        if now == self._active:
            return
        self._active = now
        try:
            self._put_on(self._tool_of(message) if message.tool else None)
        except GalenError as error:
            self._gap.set_tool(None)
            self._says.set_tool_trouble(f"no tool: {error}")
        self._announce(always=True)

    def _tool_of(self, message: ActiveTool) -> ToolFile:
        """The active calibration, where it is here as well; else what gravcomp tells of it."""
        try:
            stored = self._store.read(message.tool)
            if stored.sha256 == message.sha256:
                return stored.tool
        except ToolFileError:
            pass
        if message.parts:
            raise GalenError(
                f"the file of '{message.tool}' that gravcomp has active holds"
                f" {', '.join(message.parts)}, and is not in {self._store.directory}:"
                " give tools_dir"
            )
        return ToolFile(
            message.tool,
            LoadEstimate(
                message.mass_kg,
                np.array(message.com_m, dtype=float),
                np.reshape(np.array(message.covariance, dtype=float), (4, 4)),
            ),
            LoadEstimate(
                message.adapter_mass_kg,
                np.array(message.adapter_com_m, dtype=float),
                np.zeros((4, 4)),
            ),
            np.array(message.tip_m, dtype=float),
            np.zeros(6),
            0,
            message.calibrated_at,
        )

    # State

    def _watch(self, now_s: float) -> None:
        watch, tool = self._gap.watch, self._gap.tool
        if watch.state.notice is not GapNotice.GAP:
            self._says.set_effects([])
            self._asked_s = float("-inf")
        elif tool is not None and not self._asking and now_s - self._asked_s > _EFFECTS_EVERY_S:
            self._asking, self._asked_s = True, time.monotonic()
            state = watch.state
            assert state.noise is not None
            variances = watch.variances(state.stops, state.noise)
            self._background.submit(
                lambda: likely_effects(state, variances, tool), self._on_effects
            )

    def _on_effects(self, effects: list[tuple[str, float]]) -> None:
        self._asking = False
        if self._gap.watch.state.notice is GapNotice.GAP:
            self._says.set_effects(effects)
            self._announce(always=True)

    def _values(self, now_s: float) -> dict[str, object]:
        return self._says.values(now_s)


def main() -> None:
    """Run the node until it is told to stop."""
    run(GapMonitorNode)


if __name__ == "__main__":
    main()
