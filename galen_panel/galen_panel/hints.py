"""Which node offers what, and how to start one that is absent. No ROS, no NiceGUI."""

from __future__ import annotations

from galen_panel.programs import OFFERED_BY
from galen_panel.state import Behaviour, Kind, State

NAMES = {
    Kind.CALIBRATE: "Calibration",
    Kind.CHECK: "Quick check",
    Kind.COLLECT: "Collection of pushes",
}


def missing(state: State, name: str) -> str:
    """What to do where a service or action of that name isn't there; empty where it is."""
    return "" if name in state.available else OFFERED_BY[name].absent


def title(behaviour: Behaviour) -> str:
    """What it is called, such as "Calibration of pointer"."""
    joined = "with" if behaviour.kind is Kind.COLLECT else "of"
    name = NAMES[behaviour.kind]
    return f"{name} {joined} {behaviour.tool}" if behaviour.tool else name


def running(state: State) -> Behaviour | None:
    """The behaviour that is under way, the newest where there are several."""
    under_way = [behaviour for behaviour in state.behaviours.values() if behaviour.running]
    return max(under_way, key=lambda behaviour: behaviour.number, default=None)


def cannot_start(state: State, kind: Kind) -> str:
    """Why a behaviour can't be started now and what to do; empty where it can.

    A node refuses a second goal of its own; another node's at the same arm would end both.
    """
    other = running(state)
    if other is not None:
        return f"{title(other)} is under way. Wait until it has ended, or cancel it."
    return missing(state, kind.value)
