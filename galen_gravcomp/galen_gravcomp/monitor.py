"""What the compensator's node can say of its health: state, rates, latency. No ROS.

Refusals come and go with single samples; a state must not flap at 500 Hz. So a refusal stays the
state for `HOLD_S` after the last one. Times here are wall times (s, monotonic): they only say
whether something arrives at all, never what is done with a sample.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from galen_gravcomp.compensator import Compensator
from galen_gravcomp.results import Notice, Refusal, Refused

HOLD_S = 0.5
NOTICE_HOLD_S = 5.0
RATE_WINDOW_S = 2.0
LATENCY_SAMPLES = 2000

# Notices that a person should hear of, and how.
_NOTICE_TEXTS = {
    Notice.TORQUE_UNIT: "torques far beyond the sensor's range: are they in N.mm?",
    Notice.ANGLE_UNIT: "joint angles beyond a full turn: are they in degrees?",
    Notice.BEYOND_RANGE: "wrenches beyond the sensor's range: the reading may be clipped",
    Notice.OUT_OF_ORDER_WRENCH: "wrench_raw stamps are out of order",
    Notice.OUT_OF_ORDER_JOINTS: "joint_states stamps are out of order",
}


class Severity(Enum):
    """Named as the levels of diagnostic_msgs/DiagnosticStatus."""

    OK = "OK"
    WARN = "WARN"
    ERROR = "ERROR"
    STALE = "STALE"


class State(NamedTuple):
    """The state's severity, its short name, and a sentence for a person."""

    severity: Severity
    name: str
    message: str


class _Counts(NamedTuple):
    now_s: float
    joints: int
    wrenches: int
    compensated: int


@dataclass
class _LastRefusal:
    refused: Refused
    now_s: float


class Monitor:
    """Watches one compensator. `silence_s`: how long an input may be silent on the wall clock."""

    def __init__(self, compensator: Compensator, silence_s: float) -> None:
        self._compensator = compensator
        self._silence_s = silence_s
        self._tool_error = ""
        self._joints_seen = 0
        self._joints_s: float | None = None
        self._wrench_s: float | None = None
        self._output_s: float | None = None
        self._last: _LastRefusal | None = None
        self._restart: tuple[str, float] | None = None
        self._notices_seen: Mapping[Notice, int] = {}
        self._notice: tuple[str, float] | None = None
        self._counts: deque[_Counts] = deque()
        self._latencies_s: deque[float] = deque(maxlen=LATENCY_SAMPLES)

    def set_tool_error(self, text: str) -> None:
        """Say why the tool asked for at start is not loaded; empty when one is in force."""
        self._tool_error = text

    def on_joints(self, now_s: float) -> None:
        """Note that a joint message came."""
        self._joints_seen += 1
        self._joints_s = now_s

    def on_wrench(self, now_s: float) -> None:
        """Note that a wrench came."""
        self._wrench_s = now_s

    def on_output(self, arrival_s: float, now_s: float) -> bool:
        """Note an output. True when it may have changed the state."""
        first = self._output_s is None or now_s - self._output_s > HOLD_S
        self._output_s = now_s
        self._latencies_s.append(now_s - arrival_s)
        return first

    def on_refused(self, refused: Refused, now_s: float) -> bool:
        """Note a refusal. True when it may have changed the state."""
        last = self._last
        self._last = _LastRefusal(refused, now_s)
        return (
            last is None or last.refused.reason is not refused.reason or now_s - last.now_s > HOLD_S
        )

    def on_restart(self, why: str, now_s: float) -> None:
        """Note that everything was cleared."""
        self._restart = (why, now_s)
        self._output_s = None

    def tick(self, now_s: float) -> None:
        """Take the counts for the rates, and new notices; call it a few times a second."""
        compensator = self._compensator
        self._counts.append(
            _Counts(now_s, self._joints_seen, compensator.received, compensator.compensated)
        )
        while len(self._counts) > 2 and now_s - self._counts[1].now_s > RATE_WINDOW_S:
            self._counts.popleft()
        for notice, text in _NOTICE_TEXTS.items():
            if compensator.notices[notice] > self._notices_seen.get(notice, 0):
                self._notice = (text, now_s)
                break
        self._notices_seen = dict(compensator.notices)

    def state(self, now_s: float) -> State:
        """The state now; the most serious and most basic trouble comes first."""
        return (
            self._standing_state()
            or self._silence_state(now_s)
            or self._refusal_state(now_s)
            or self._running_state(now_s)
        )

    def _standing_state(self) -> State | None:
        if self._tool_error:
            return State(Severity.ERROR, "bad_tool_file", f"no tool: {self._tool_error}")
        if not self._compensator.enabled:
            return State(Severity.WARN, "disabled", "switched off: nothing is published")
        if self._compensator.tool is None:
            return State(
                Severity.WARN, "no_tool", "no tool is loaded: call ~/set_tool; nothing is published"
            )
        return None

    def _silence_state(self, now_s: float) -> State | None:
        # Wrenches without joints are refused one by one: that says more than the joints' silence.
        if self._wrench_s is not None and now_s - self._wrench_s <= self._silence_s:
            return None
        silent = []
        for topic, last_s in (("wrench_raw", self._wrench_s), ("joint_states", self._joints_s)):
            if last_s is None:
                silent.append(f"no {topic} came yet")
            elif now_s - last_s > self._silence_s:
                silent.append(f"no {topic} for {now_s - last_s:.1f} s")
        return State(Severity.STALE, "silent", " and ".join(silent))

    def _refusal_state(self, now_s: float) -> State | None:
        last = self._last
        if last is None or now_s - last.now_s > HOLD_S:
            return None
        reason, detail = last.refused.reason, last.refused.detail
        # These two are said better by the state itself, or by the restart's own text.
        if reason in (Refusal.DISABLED, Refusal.NO_TOOL, Refusal.RESTART):
            return None
        if self._output_s is None or now_s - self._output_s > HOLD_S:
            return State(Severity.ERROR, reason.value, f"nothing is published: {detail}")
        return State(Severity.WARN, reason.value, f"some wrenches are refused: {detail}")

    def _running_state(self, now_s: float) -> State:
        compensator = self._compensator
        assert compensator.tool is not None
        if self._output_s is None:
            return State(Severity.STALE, "waiting", "waiting for wrenches with joints around them")
        for held in (self._restart, self._notice):
            if held is not None and now_s - held[1] < NOTICE_HOLD_S:
                return State(Severity.WARN, "compensating", f"compensating, but: {held[0]}")
        tool = compensator.tool.tool
        if compensator.taring:
            return State(Severity.OK, "taring", f"compensating '{tool}', averaging for a tare")
        if compensator.tare_ramping:
            return State(Severity.OK, "tare_ramp", f"compensating '{tool}', applying a tare")
        return State(Severity.OK, "compensating", f"compensating '{tool}'")

    def values(self, now_s: float) -> dict[str, object]:
        """Everything measured, for /diagnostics; units are in the names."""
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
                "com_m": _join(tool.load.com_m),
                "calibrated_at": tool.calibrated_at,
            }
        values |= {
            "sensor_frame": compensator.sensor_frame,
            "tare": self._tare_text(),
            "tare_force_n": _join(offset[:3]),
            "tare_torque_nm": _join(offset[3:]),
            "wrench_raw_hz": self._rate("wrenches"),
            "joint_states_hz": self._rate("joints"),
            "wrench_compensated_hz": self._rate("compensated"),
            "wrench_raw_age_s": _since(self._wrench_s, now_s),
            "joint_states_age_s": _since(self._joints_s, now_s),
        }
        if self._latencies_s:
            median, p99 = np.percentile(np.array(self._latencies_s) * 1e3, (50, 99))
            values |= {"latency_median_ms": float(median), "latency_p99_ms": float(p99)}
        values |= {
            "received": compensator.received,
            "compensated": compensator.compensated,
            "waiting": compensator.waiting,
        }
        values |= {f"refused_{reason.value}": compensator.refusals[reason] for reason in Refusal}
        values |= {notice.value: compensator.notices[notice] for notice in Notice}
        values["last_refusal"] = "" if self._last is None else self._last.refused.detail
        values["last_restart"] = "" if self._restart is None else self._restart[0]
        return values

    def _tare_text(self) -> str:
        if self._compensator.taring:
            return "averaging"
        if self._compensator.tare_ramping:
            return "ramping"
        return "on" if self._compensator.tare_offset.any() else "none"

    def _rate(self, name: str) -> float:
        if len(self._counts) < 2:
            return 0.0
        first, last = self._counts[0], self._counts[-1]
        elapsed_s = last.now_s - first.now_s
        count: int = getattr(last, name) - getattr(first, name)
        return count / elapsed_s if elapsed_s > 0.0 else 0.0


def _join(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.6g}" for number in numbers)


def _since(last_s: float | None, now_s: float) -> object:
    return "never came" if last_s is None else now_s - last_s
