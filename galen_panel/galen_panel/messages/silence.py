"""What to tell about streams that don't come. No ROS, no page."""

from __future__ import annotations

from collections.abc import Mapping

from galen_panel.messages.hints import DEFLECTION as DEFLECTION_NODE
from galen_panel.messages.hints import DRIVER, GRAVCOMP
from galen_panel.snapshot import SuiteState

SILENT_S = 1.0
RAW, COMPENSATED, DEFLECTION, JOINTS = "raw", "compensated", "deflection", "joints"


class Heard:
    """When each stream was heard last; stamps may be of any clock, so that they are only compared.

    A stream is silent where its newest stamp hasn't changed for `SILENT_S` of `now_s`.
    """

    def __init__(self) -> None:
        self._newest: dict[str, int | None] = {}
        self._changed_s: dict[str, float] = {}

    def look(self, newest_ns: Mapping[str, int | None], now_s: float) -> None:
        """Take each stream's newest stamp, None for nothing yet; now_s: time.monotonic()."""
        for name, newest in newest_ns.items():
            if name not in self._newest or newest != self._newest[name]:
                self._newest[name] = newest
                self._changed_s[name] = now_s

    def forget(self, now_s: float) -> None:
        """Count silence from here: the streams were not listened to."""
        self._changed_s = dict.fromkeys(self._changed_s, now_s)

    def silent(self, now_s: float) -> frozenset[str]:
        """The streams that don't come."""
        return frozenset(
            name for name, changed_s in self._changed_s.items() if now_s - changed_s > SILENT_S
        )


def tell(silent: frozenset[str], state: SuiteState) -> str:
    """Which topics don't come, why, and what to do; empty where nothing is missing."""
    if RAW in silent:
        return (
            "No wrench_raw: the arm's driver is not running or not heard. "
            f"The simulated arm: {DRIVER.start}"
        )
    if COMPENSATED in silent:
        return f"No wrench_compensated: {_why_not_compensated(silent, state)}"
    if DEFLECTION in silent:
        return (
            "No deflection: its node is not running or has rejected its model (see Nodes). "
            f"Start it: {DEFLECTION_NODE.start}"
        )
    if JOINTS in silent:
        return "No joint_states: the arm's driver doesn't say where its joints are."
    return ""


def _why_not_compensated(silent: frozenset[str], state: SuiteState) -> str:
    if state.active_tool is None:
        return f"gravcomp_node is not running. Start it: {GRAVCOMP.start}"
    if not state.active_tool.tool:
        return "no tool is active. Choose one under Operate."
    if not state.active_tool.enabled:
        return "compensation is off. The switch above turns it on."
    if JOINTS in silent:
        return "no joint_states come, and without them nothing can be compensated."
    return "gravcomp_node holds it back; Nodes says why."
