# SPDX-License-Identifier: Apache-2.0
"""The health of the compensator's node: state, rates, latency. No ROS."""

from galen_common.stream.monitor import Severity, StreamMonitor, StreamState, joined
from galen_common.stream.samples import Rejection

from galen_gravcomp.compensator import Compensator


class Monitor(StreamMonitor):
    """Watches one compensator; times as `StreamMonitor` says."""

    not_shown = (Rejection.DISABLED, Rejection.NO_TOOL, Rejection.RESTART)
    working = "compensating"
    output = "wrench_compensated"

    def __init__(self, compensator: Compensator) -> None:
        super().__init__(compensator.pairing)
        self._compensator = compensator
        self._tool_error = ""
        self._file_note = ""

    def set_tool_error(self, text: str) -> None:
        """Set why the tool asked for at start is not loaded.

        Args:
            text: the reason; empty when a tool is active.

        """
        self._tool_error = text

    def set_file_note(self, text: str) -> None:
        """Set what became of the file of the active tool since.

        Args:
            text: in words; empty while it is as loaded.

        """
        self._file_note = text

    def _standing_state(self) -> StreamState | None:
        if self._tool_error:
            return StreamState(Severity.ERROR, "bad_tool_file", f"no tool: {self._tool_error}")
        if not self._compensator.enabled:
            return StreamState(Severity.WARN, "disabled", "switched off: nothing is published")
        if self._compensator.tool is None:
            return StreamState(
                Severity.WARN, "no_tool", "no tool is loaded: call ~/set_tool; nothing is published"
            )
        return None

    def _running_state(self) -> StreamState:
        compensator = self._compensator
        assert compensator.tool is not None
        tool = compensator.tool.tool
        if compensator.taring:
            return StreamState(
                Severity.OK, "taring", f"compensating '{tool}', averaging for a tare"
            )
        if compensator.tare_ramping:
            return StreamState(Severity.OK, "tare_ramp", f"compensating '{tool}', applying a tare")
        monitor, bias_drift = compensator.monitor, compensator.bias_drift
        if monitor is not None and monitor.trouble:
            return self._warning("does_not_fit", f"'{tool}', but {monitor.trouble}")
        if bias_drift.trouble:
            return self._warning("bias_drift_limit", f"'{tool}', but {bias_drift.trouble}")
        if compensator.cable is not None and compensator.cable.where == "outside":
            return self._warning(
                "cable_outside", f"'{tool}' without its cable's pull: no such pose was seen with it"
            )
        if self._file_note:
            return StreamState(
                Severity.WARN, "file_changed", f"compensating '{tool}': {self._file_note}"
            )
        return StreamState(Severity.OK, "compensating", f"compensating '{tool}'")

    def _warning(self, name: str, text: str) -> StreamState:
        note = f"; {self._file_note}" if self._file_note else ""
        return StreamState(Severity.WARN, name, f"compensating {text}{note}")

    def values(self, now_s: float) -> dict[str, object]:
        """Everything measured, for /diagnostics; units are in the names.

        Args:
            now_s: wall time, s, monotonic.

        Returns:
            Values by key.

        """
        compensator = self._compensator
        tool = compensator.tool
        offset = compensator.tare_offset
        values: dict[str, object] = {
            "enabled": compensator.enabled,
            "tool": "" if tool is None else tool.tool,
        }
        if tool is not None:
            values |= {
                "mass_kg": float(tool.load.mass_kg),
                "com_m": joined(tool.load.com_m),
                "tip_m": joined(tool.tip_m),
                "calibrated_at": tool.calibrated_at,
                "bias": "" if offset.any() else tool.bias_note,
            }
        values |= {
            "sensor_frame": compensator.pairing.sensor_frame,
            "tare": self._tare_text(),
            "tare_force_n": joined(offset[:3]),
            "tare_torque_nm": joined(offset[3:]),
        }
        motion = compensator.motion
        values |= {"motion": "off"} if motion is None else motion.values()
        values |= {"cable": "none"} if compensator.cable is None else compensator.cable.values()
        values |= compensator.bias_drift.values()
        values |= {"fit": "off"} if compensator.monitor is None else compensator.monitor.values()
        values |= self.inputs(now_s, self.output)
        values |= {
            "received": compensator.pairing.received,
            "compensated": compensator.compensated,
        }
        return values | self.rejected()

    def _tare_text(self) -> str:
        if self._compensator.taring:
            return "averaging"
        if self._compensator.tare_ramping:
            return "ramping"
        return "on" if self._compensator.tare_offset.any() else "none"
