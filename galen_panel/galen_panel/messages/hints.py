"""Programs, what is missing, and what to do about it. No ROS, no page."""

from __future__ import annotations

import math
from dataclasses import dataclass

from galen_panel.messages import texts
from galen_panel.snapshot import Behaviour, BehaviourKind, SuiteState


@dataclass(frozen=True)
class Program:
    """A part of the suite; `node` is its node's name on /diagnostics.

    offers: a service or action of it, as in `State.available`. needed: whether nothing works
    without it.
    """

    node: str
    package: str
    executable: str
    title: str
    purpose: str
    offers: str = ""
    needed: bool = False

    @property
    def start(self) -> str:
        """Command that starts it."""
        return f"ros2 run {self.package} {self.executable}"

    @property
    def absent(self) -> str:
        """Sentence on its absence, and what to do."""
        return f"{self.executable} isn't running. Start it: {self.start}"


DRIVER = Program(
    *("sim_driver", "galen_sim_driver", "sim_driver_node"),
    "Driver",
    "Moves the arm and reads its sensor.",
    offers="attach_tool",
    needed=True,
)
GRAVCOMP = Program(
    *("gravcomp", "galen_gravcomp", "gravcomp_node"),
    "Compensation",
    "Subtracts the tool's weight from the wrench.",
    offers="gravcomp/enable",
    needed=True,
)
CALIBRATION = Program(
    *("calibration", "galen_calibration_behavior", "calibration_node"),
    "Calibration",
    "Finds and checks a tool's mass and centre.",
    offers="calibrate_tool",
)
DEFLECTION = Program(
    *("deflection", "galen_deflection", "deflection_node"),
    "Deflection",
    "Predicts how far the arm bends.",
)
COLLECTION = Program(
    *("collection", "galen_deflection", "collection_node"),
    "Collection of pushes",
    "Records pushes, to learn the deflection from.",
    offers="collect_pushes",
)
PROGRAMS = (DRIVER, GRAVCOMP, CALIBRATION, DEFLECTION, COLLECTION)

OFFERED_BY = {
    "gravcomp/set_tool": GRAVCOMP,
    "gravcomp/list_tools": GRAVCOMP,
    "gravcomp/compare_tools": GRAVCOMP,
    "gravcomp/remove_tool": GRAVCOMP,
    "gravcomp/revert_tool": GRAVCOMP,
    "gravcomp/enable": GRAVCOMP,
    "gravcomp/tare": GRAVCOMP,
    "calibration/confirm": CALIBRATION,
    "calibrate_tool": CALIBRATION,
    "check_tool": CALIBRATION,
    "collect_pushes": COLLECTION,
    "attach_tool": DRIVER,
}
"""By the names in the contract, which are also those in `State.available`."""


NAMES = {
    BehaviourKind.CALIBRATE: "Calibration",
    BehaviourKind.CHECK: "Quick check",
    BehaviourKind.COLLECT: "Collection of pushes",
}


def missing(state: SuiteState, name: str) -> str:
    """Say what to do where that service or action isn't there; empty where it is."""
    return "" if name in state.available else OFFERED_BY[name].absent


def title(behaviour: Behaviour) -> str:
    """Name a behaviour, such as "Calibration of pointer"."""
    joined = "with" if behaviour.kind is BehaviourKind.COLLECT else "of"
    name = NAMES[behaviour.kind]
    return f"{name} {joined} {behaviour.tool}" if behaviour.tool else name


def running(state: SuiteState) -> Behaviour | None:
    """Return the running behaviour, the newest of several."""
    under_way = [behaviour for behaviour in state.behaviours.values() if behaviour.running]
    return max(under_way, key=lambda behaviour: behaviour.number, default=None)


def cannot_start(state: SuiteState, kind: BehaviourKind) -> str:
    """Say why a behaviour can't be started now and what to do; empty where it can.

    A node rejects a second goal of its own; another node's at the same arm would end both.
    """
    other = running(state)
    if other is not None:
        return f"{title(other)} is under way. Wait until it has ended, or cancel it."
    return missing(state, kind.value)


def before_calibration(state: SuiteState, *, one_sweep: bool, by_hand: bool) -> list[str]:
    """List what a person must know before the arm moves: how long, and a clear area."""
    duration_s = (1 if one_sweep else 2) * _sweep_s(state)
    long = (
        f"{CALIBRATION.executable} does not tell how long that takes"
        if math.isnan(duration_s)
        else f"about {texts.duration(duration_s)}"
    )
    sentences = [f"The arm moves: it goes through its poses, {long}."]
    if by_hand:
        sentences.append("It waits for the tool to be removed and put on; that comes on top.")
    return [
        *sentences,
        "Look whether the area around the arm is clear. Keep off the arm and the tool until the"
        " calibration has ended.",
    ]


def _sweep_s(state: SuiteState) -> float:
    """How long one sweep takes, as the calibration's node tells; NaN where it doesn't."""
    report = state.report_of(CALIBRATION.node)
    try:
        return float("nan" if report is None else report.values.get("sweep_s", "nan"))
    except ValueError:
        return math.nan
