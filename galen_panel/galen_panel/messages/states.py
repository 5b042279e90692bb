"""What each node of the suite is doing, in plain words, and what to do about it. No ROS.

A node tells its state by a short name, the value `state` on /diagnostics; the words are looked up
by it, never guessed from sentences. What it tells beside that (names, numbers) is its own message.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from galen_panel.messages.advice import (
    ADVICE,
    LIFECYCLE,
    NO_CLOCK,
    OUTPUT,
    REJECTED,
    WHILE_CALIBRATING,
    Advice,
)
from galen_panel.messages.hints import (
    CALIBRATION,
    COLLECTION,
    DEFLECTION,
    DRIVER,
    GRAVCOMP,
    Program,
)
from galen_panel.snapshot import Active, Kind, Level, NodeReport, State

SILENT_S = 3.0
"""A node that lives tells its state once a second."""


class Role(NamedTuple):
    """A part of the suite.

    offers: a service or action of it, as in `State.available`. needed: whether nothing works
    without it.
    """

    program: Program
    title: str
    purpose: str
    offers: str = ""
    needed: bool = False

    @property
    def name(self) -> str:
        """Its node's, without a namespace."""
        return self.program.node

    @property
    def start(self) -> str:
        """The command that starts it."""
        return self.program.start


_COMPENSATION = Role(
    GRAVCOMP, "Compensation", "Takes the tool's weight out of the wrench.", "gravcomp/enable", True
)
_DRIVER = Role(DRIVER, "Driver", "Moves the arm and reads its sensor.", "attach_tool", True)
ROLES = (
    _DRIVER,
    _COMPENSATION,
    Role(
        CALIBRATION,
        "Calibration",
        "Finds and checks a tool's mass and centre.",
        "calibrate_tool",
    ),
    Role(
        DEFLECTION,
        "Deflection",
        "Predicts how far the arm bends.",
    ),
    Role(
        COLLECTION,
        "Collection of pushes",
        "Records pushes, to learn the deflection from.",
        "collect_pushes",
    ),
)


@dataclass(frozen=True)
class Words:
    """Of one node. doing: a sentence; todo: what to do, empty where nothing is; said: its message.

    running: whether it was heard of lately. stopped: whether it puts out nothing, though it should.
    """

    level: Level
    doing: str
    todo: str = ""
    said: str = ""
    running: bool = True
    stopped: bool = False


def others(state: State) -> list[NodeReport]:
    """Reports of other nodes, such as a recorder, or those of another arm; by name."""
    known = {report.name for role in ROLES if (report := state.report_of(role.name)) is not None}
    rest = (report for report in state.nodes.values() if report.name not in known)
    return sorted(rest, key=lambda report: report.name)


def words_of(state: State, role: Role, now_s: float) -> Words:
    """What a role's node is doing. now_s: time.monotonic()."""
    report = state.report_of(role.name)
    if report is None or now_s - report.heard_s > SILENT_S:
        return _absent(state, role, report, now_s)
    calibration = state.behaviours.get(Kind.CALIBRATE)
    calibrating = calibration is not None and calibration.running
    words = _present(role, report, state.active_tool, calibrating)
    if "clock" in report.values:
        return replace(words, doing=NO_CLOCK.doing, todo=NO_CLOCK.todo)
    return words


def words_of_other(report: NodeReport, now_s: float) -> Words:
    """The same of a node that plays no role: its own message."""
    silent_s = now_s - report.heard_s
    if silent_s > SILENT_S:
        return Words(Level.STALE, _silence(silent_s), "Start it again if it is needed.", "", False)
    todo = "" if report.level is Level.OK else "Its own message says what is wrong."
    return Words(report.level, _sentence(report.message), todo)


def compensates(state: State, now_s: float) -> bool:
    """Whether compensated wrenches go out; switched on is not enough. now_s: as in `words_of`."""
    active_tool = state.active_tool
    wanted = active_tool is not None and active_tool.enabled and bool(active_tool.tool)
    return wanted and not words_of(state, _COMPENSATION, now_s).stopped


def overall(state: State, now_s: float) -> tuple[Level, str]:
    """The worst that an operator must know: compensation that puts out nothing goes first."""
    words = {role: words_of(state, role, now_s) for role in ROLES}
    own = words[_COMPENSATION]
    if own.stopped:
        return own.level, own.doing
    # What isn't running and isn't needed is no trouble; without a driver compensation stops.
    running = [
        (_RANK[one.level], role is _COMPENSATION, role, one)
        for role, one in words.items()
        if one.running
    ]
    rank, _, role, worst = max(running, key=lambda entry: entry[:2])
    if rank == 0 or role is _COMPENSATION:
        return own.level, own.doing
    return worst.level, f"{role.title}: {worst.doing}"


_RANK = {Level.OK: 0, Level.WARN: 1, Level.STALE: 2, Level.ERROR: 3}


def _absent(state: State, role: Role, report: NodeReport | None, now_s: float) -> Words:
    start = f"Start it: {role.start}"
    if role is _DRIVER:
        start = f"Start the arm's driver. For a simulated arm: {role.start}"
    if role is _DRIVER and report is None:
        drivers = _other_drivers(state, now_s)
        if drivers:
            return Words(Level.OK, f"Another driver sends: {drivers}.", "", "nothing of its state")
    if report is not None:
        text = _silence(now_s - report.heard_s)
    elif role.offers and role.offers in state.available:
        return Words(
            Level.STALE, f"{role.title} is there, but has told nothing of itself yet.",
            "Wait a moment. If that stays so, start it again.", "", False, True,
        )  # fmt: skip
    else:
        text = "Not running."
    if role is _COMPENSATION:
        text = f"No compensation: {text[0].lower()}{text[1:]}"
    level = Level.STALE if role.needed or report is not None else Level.OK
    return Words(level, text, start, "", False, role.needed)


def _silence(silent_s: float) -> str:
    if silent_s < 120.0:
        return f"Not running, or silent for {silent_s:.0f} s."
    return f"Not running, or silent for {silent_s / 60.0:.0f} min."


def _other_drivers(state: State, now_s: float) -> str:
    """Who publishes wrench_raw, as gravcomp tells."""
    report = state.report_of(_COMPENSATION.name)
    if report is None or now_s - report.heard_s > SILENT_S:
        return ""
    return report.values.get("wrench_raw_publisher_nodes", "")


def _present(
    role: Role, report: NodeReport, active_tool: Active | None, calibrating: bool
) -> Words:
    lifecycle = report.values.get("lifecycle", "")
    name = report.values.get("state", "")
    if name not in ("", "inactive") or lifecycle in ("", "active"):
        return _by_state(role, report, name, active_tool, calibrating)
    failed = report.level is Level.ERROR
    advice = LIFECYCLE.get(f"{lifecycle} failed" if failed else lifecycle)
    if advice is None:
        return _own_words(report)
    return Words(
        report.level, advice.doing, advice.todo.format(node=report.name), report.message, True, True
    )


def _by_state(
    role: Role, report: NodeReport, name: str, active_tool: Active | None, calibrating: bool
) -> Words:
    level, advice = report.level, find_advice(role.name, name, report.level)
    if calibrating and name in (expected := WHILE_CALIBRATING.get(role.name, {})):
        level, advice = Level.OK, expected[name]
    if advice is None:
        return _own_words(report)
    tool = report.values.get("tool", "") or ("" if active_tool is None else active_tool.tool)
    given = {"tool": tool or "the tool", "node": report.name}
    return Words(
        level, advice.doing.format(**given), advice.todo.format(**given), report.message,
        True, advice.stopped,
    )  # fmt: skip


def find_advice(role: str, state: str, level: Level) -> Advice | None:
    """The words for a state's name; None where there are none."""
    known = ADVICE.get(role, {})
    advice = known.get(f"{state} {level.name.lower()}", known.get(state))
    if advice is not None or role not in OUTPUT:
        return advice
    rejected = REJECTED.get(state)
    if rejected is None:
        return None
    if level is Level.WARN:
        return Advice(f"{OUTPUT[role].works}, but some wrenches are left out: {rejected.doing}.",
                      rejected.todo)  # fmt: skip
    return Advice(f"{OUTPUT[role].lost}: {rejected.doing}.", rejected.todo, True)


def _own_words(report: NodeReport) -> Words:
    """A state that is not known here: a node of another version."""
    todo = "" if report.level is Level.OK else "Its own message says what is wrong."
    stopped = report.level in (Level.ERROR, Level.STALE)
    return Words(report.level, _sentence(report.message), todo, "", True, stopped)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" if text else "It tells its level only."
