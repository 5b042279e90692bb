"""Samples for the gap's watch, and what its node can say of its health. No ROS."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

from galen_model.arrays import Array
from galen_model.files.calibration_file import ToolFile
from galen_model.load.prediction import Prediction
from galen_ros.stream.monitor import Severity, State, StreamMonitor, joined
from galen_ros.stream.pairing import PairingSettings, WrenchPairing
from galen_ros.stream.results import Rejected, Rejection

from galen_diagnosis.monitor.gap_watch import GapNotice, GapSettings, GapState, GapWatch

_WRENCH_UNITS = ("N", "N", "N", "mN.m", "mN.m", "mN.m")
_SHOWN = (1.0, 1.0, 1.0, 1e3, 1e3, 1e3)
_TO_DO = "record the arm and run `diagnose` on it"


class Judged(NamedTuple):
    """A wrench that was looked at."""

    stamp_ns: int
    tag: object


class GapPairing(WrenchPairing[Judged]):
    """Gives each wrench, less what the file's load reads there, to the watch."""

    def __init__(
        self,
        settings: PairingSettings,
        gap: GapSettings,
        on_restart: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(settings, on_restart)
        self._frame = settings.sensor_frame
        self.watch = GapWatch(gap)
        self.tool: ToolFile | None = None
        self.looks = 0
        self.judged = 0
        self._prediction: Prediction | None = None

    @property
    def sensor_frame(self) -> str:
        """The settings', else the tool's file's."""
        return self._frame or ("" if self.tool is None else self.tool.sensor_frame)

    def set_tool(self, tool: ToolFile | None) -> list[Judged | Rejected]:
        """Watch another tool, or none; what was seen is forgotten."""
        self.tool = tool
        self._prediction = None if tool is None else Prediction(tool)
        self.watch.set_tool(tool)
        if tool is None:
            return self._reject_waiting(Rejection.NO_TOOL, "no tool is known")
        return []

    def push_joints(self, stamp_ns: int, joints: tuple[float, ...]) -> list[Judged | Rejected]:
        """Take joints (5,), m and rad; returns what became of the wrenches that waited."""
        return self._push_joint_sample(stamp_ns, joints)

    def restart(self, why: str) -> list[Judged | Rejected]:
        """Forget every sample and what was learned of them."""
        self.watch.clear()
        return super().restart(why)

    def _barred(self) -> tuple[Enum, str] | None:
        return None if self.tool is not None else (Rejection.NO_TOOL, "no tool is known")

    def _make(
        self, stamp_ns: int, raw: Array, joints: tuple[float, ...], tag: object, number: int
    ) -> Judged | Rejected:
        assert self._prediction is not None
        residual = self._prediction.wrench(raw - self._prediction.reading(*joints[3:]))
        self.looks += self.watch.push(stamp_ns, joints, residual)
        self.judged += 1
        return Judged(stamp_ns, tag)


class GapMonitor(StreamMonitor):
    """What goes on /diagnostics. `silence_s`: how long an input may be silent by the wall clock."""

    said_better = (Rejection.RESTART, Rejection.NO_TOOL)
    working = "watching"
    lost = "nothing is judged"

    def __init__(self, pairing: GapPairing, silence_s: float) -> None:
        super().__init__(pairing, silence_s)
        self._gap = pairing
        self._tool_trouble = "no tool is known: give the parameter tool, or start gravcomp_node"
        self._effects: list[tuple[str, float]] = []

    def set_tool_trouble(self, text: str) -> None:
        """Say why no tool is known; empty when one is."""
        self._tool_trouble = text

    def set_effects(self, effects: list[tuple[str, float]]) -> None:
        """Say which effects fit the gap best, with their probabilities."""
        self._effects = effects

    def _standing_state(self) -> State | None:
        if self._tool_trouble:
            return State(Severity.WARN, "no_tool", self._tool_trouble)
        return None

    def _running_state(self) -> State:
        state = self._gap.watch.state
        match state.notice:
            case GapNotice.LEARNING:
                text = "learning the noise from an arm at rest that nobody touches"
            case GapNotice.WAITING:
                text = f"{len(state.stops)} untouched stops, too few to say whether there is a gap"
            case GapNotice.NO_GAP if state.poses > 1:
                text = f"no gap: {state.poses} poses read as the model does, to the noise"
            case GapNotice.NO_GAP:
                text = "no gap, but at one pose only a drift or a jump would show"
            case GapNotice.GAP:
                return State(Severity.WARN, "gap", gap_sentence(state, self._effects))
        return State(Severity.OK, state.notice.value, text)

    def values(self, now_s: float) -> dict[str, object]:
        """Everything measured, for /diagnostics; units are in the names."""
        tool, state = self._gap.tool, self._gap.watch.state
        test, noise = state.test, state.noise
        values: dict[str, object] = {
            "tool": "" if tool is None else tool.tool,
            "gap": state.notice.value,
            "gap_since_stamp_s": "" if state.since_ns is None else f"{state.since_ns * 1e-9:.3f}",
            "gap_channels": " ".join(state.channels),
            "stops": len(state.stops),
            "poses": state.poses,
            "untouched_s": 0.5 * sum(len(stop.means) for stop in state.stops),
            "false_alarms_per_hour": self._gap.watch.settings.false_alarms_per_hour,
            "looks": self._gap.looks,
        }
        if test is not None:
            values |= {
                "probability_without_gap": test.probability,
                "stops_left_out": len(state.stops) - len(test.kept),
                "size_force_n": joined(test.size[:3]),
                "size_torque_nm": joined(test.size[3:]),
            }
        if noise is not None:
            values["noise_std_of_half_second"] = joined(noise.variance**0.5)
            values["noise_correlation"] = joined(noise.correlation)
        if state.notice is GapNotice.GAP:
            values["effects"] = _shares(self._effects)
        values |= self.inputs(now_s, "judged")
        return (
            values | {"received": self._gap.received, "judged": self._gap.judged} | self.rejected()
        )


def gap_sentence(state: GapState, effects: list[tuple[str, float]]) -> str:
    """What is said of a gap, in plain words."""
    assert state.test is not None and state.since_ns is not None
    lasts_s = (state.at_ns - state.since_ns) * 1e-9
    sizes = {
        axis: f"{axis} {factor * size:.2g} {unit}"
        for axis, size, factor, unit in zip(
            ("fx", "fy", "fz", "tx", "ty", "tz"),
            state.test.size,
            _SHOWN,
            _WRENCH_UNITS,
            strict=True,
        )
    }
    where = ", ".join(sizes[axis] for axis in state.channels) or "all channels a little"
    text = f"gap for {lasts_s:.0f} s, from stop to stop: {where}"
    if state.poses < 2:
        text += "; at one pose, so a drift or jumps"
    elif effects:
        text += f"; fits best: {_shares(effects)}"
    return f"{text}; {_TO_DO}"


def _shares(effects: list[tuple[str, float]]) -> str:
    return ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in effects[:3] if share > 0.05)
