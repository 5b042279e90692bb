# SPDX-License-Identifier: Apache-2.0
"""The suite's programs: what is missing, what each node is doing, what to do about it. No ROS.

A node tells its state by a short name, the value `state` on /diagnostics; the words are looked up
by it, never guessed from sentences. What it tells beside that (names, numbers) is its own message.
"""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass, replace

from galen_panel.messages import texts
from galen_panel.messages.advice import (
    ADVICE,
    FIT_NOT_JUDGED,
    LIFECYCLE,
    NO_CLOCK,
    OUTPUT,
    REJECTED,
    Advice,
)
from galen_panel.state.snapshot import (
    Asked,
    Behaviour,
    BehaviourKind,
    LoadedTool,
    NodeLevel,
    NodeReport,
    SuiteState,
)

SILENT_S = 3.0
"""A node that lives tells its state once a second."""
_GRAVCOMP_SILENT_PERIODS = 1.5


@dataclass(frozen=True)
class Program:
    """A part of the suite; `node` is its node's name on /diagnostics.

    offers: a service or action of it, as in `State.available`. needed: whether nothing works
    without it. lacks: parameters of `State.ros_arguments` that it does not have.
    """

    node: str
    package: str
    executable: str
    title: str
    purpose: str
    offers: str = ""
    needed: bool = False
    lacks: tuple[str, ...] = ()

    def start(self, state: SuiteState) -> str:
        """Return the command that starts it, with the panel's arm, names and directory of tools.

        Args:
            state: with the panel's own ROS arguments.

        Returns:
            A line for a shell.

        """
        given = [
            word
            for flag, text in state.ros_arguments
            if text.split(":=")[0] not in self.lacks
            for word in (flag, text)
        ]
        ros = ["--ros-args", *given] if given else []
        return shlex.join(["ros2", "run", self.package, self.executable, *ros])

    def absent(self, state: SuiteState) -> str:
        """Return that it is missing, and what to do.

        Args:
            state: with the panel's own ROS arguments.

        Returns:
            Sentences for an operator.

        """
        return f"{self.executable} isn't running. Start it: {self.start(state)}"


DRIVER = Program(
    *("sim_driver", "galen_sim_driver", "sim_driver_node"),
    "Driver",
    "Moves the arm and reads its sensor.",
    offers="attach_tool",
    needed=True,
    lacks=("use_robot_description", "tools_dir"),
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
    lacks=("tools_dir",),
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
    """Return what to do where a service or action isn't there.

    Args:
        state: with what is available.
        name: of the service or action, a key of `OFFERED_BY`.

    Returns:
        Sentences for an operator; empty where it is there.

    """
    return "" if name in state.available else OFFERED_BY[name].absent(state)


def title(behaviour: Behaviour) -> str:
    """Name a behaviour, such as "Calibration of pointer".

    Args:
        behaviour: under way, or ended.

    Returns:
        Its kind, and its tool where that is known.

    """
    joined = "with" if behaviour.kind is BehaviourKind.COLLECT else "of"
    name = NAMES[behaviour.kind]
    return f"{name} {joined} {behaviour.tool}" if behaviour.tool else name


def question(asked: Asked, tool: str) -> tuple[str, str]:
    """Return what a person is asked to do.

    Args:
        asked: the step that the behaviour waits for.
        tool: its name; empty: unknown.

    Returns:
        The sentence, and the text of the button that answers it.

    """
    if asked == "REMOVE_TOOL":
        return "Take the tool off, then press.", "The tool is off"
    return f"Put {tool or 'the tool'} on, then press.", "The tool is on"


def running(state: SuiteState) -> Behaviour | None:
    """Return the running behaviour, the newest of several.

    Args:
        state: with the behaviours.

    Returns:
        The behaviour; None where none runs.

    """
    under_way = [behaviour for behaviour in state.behaviours.values() if behaviour.running]
    return max(under_way, key=lambda behaviour: behaviour.number, default=None)


def cannot_start(state: SuiteState, kind: BehaviourKind) -> str:
    """Return why a behaviour can't be started now and what to do.

    A node rejects a second goal of its own; another node's at the same arm would end both.

    Args:
        state: with the behaviours, and what is available.
        kind: of the behaviour to start.

    Returns:
        Sentences for an operator; empty where it can.

    """
    other = running(state)
    if other is not None:
        return f"{title(other)} is under way. Wait until it has ended, or cancel it."
    return missing(state, kind.value)


def before_calibration(
    state: SuiteState, *, one_sweep: bool, by_hand: bool, hand_guided: bool = False
) -> list[str]:
    """List what a person must know before the arm moves: how long, and a clear area.

    Args:
        state: with the arm, and the calibration node's report, which has the sweep's duration.
        one_sweep: whether there is one sweep alone, with the tool on.
        by_hand: whether an operator takes the tool off and puts it on.
        hand_guided: whether an operator moves the arm.

    Returns:
        Sentences.

    """
    if hand_guided:
        return [
            "The arm is not moved: turn the wrist to many orientations, let go of the tool, and"
            " keep still at each. The page says which orientation is missing, and when to change"
            " the tool."
        ]
    duration_s = (1 if one_sweep else 2) * _sweep_s(state)
    long = (
        f"{CALIBRATION.executable} does not tell how long that takes"
        if math.isnan(duration_s)
        else f"about {texts.duration(duration_s)}"
    )
    # The Galen has a home; another arm begins where it stands.
    around = state.drawing is not None and state.drawing.arm.delta is None
    poses = "poses around the one that it has now" if around else "its poses"
    sentences = [f"The arm moves: it goes through {poses}, {long}."]
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


@dataclass(frozen=True)
class Words:
    """Of one node. doing: a sentence; todo: what to do, empty where nothing is; said: its message.

    running: whether it was heard of lately. stopped: whether it puts out nothing, though it should.
    """

    level: NodeLevel
    doing: str
    todo: str = ""
    said: str = ""
    running: bool = True
    stopped: bool = False


def others(state: SuiteState) -> list[NodeReport]:
    """List reports of other nodes, such as a recorder, or those of another arm.

    Args:
        state: with all nodes' reports.

    Returns:
        The reports, sorted by the node's name.

    """
    known = {state.full_name(program.node) for program in PROGRAMS}
    rest = (report for report in state.nodes.values() if report.name not in known)
    return sorted(rest, key=lambda report: report.name)


def words_of(state: SuiteState, program: Program, now_s: float) -> Words:
    """Describe what a program's node is doing.

    Args:
        state: with the node's report.
        program: one of `PROGRAMS`.
        now_s: time.monotonic(), s.

    Returns:
        The words.

    """
    report = state.report_of(program.node)
    if report is None or _silent(report, program, now_s):
        return _absent(state, program, report, now_s)
    calibration = state.behaviours.get(BehaviourKind.CALIBRATE)
    calibrating = calibration is not None and calibration.running
    words = _present(program, report, state.active_tool, calibrating)
    if "clock" in report.values:
        return replace(words, doing=NO_CLOCK.doing, todo=NO_CLOCK.todo)
    return words


def words_of_other(report: NodeReport, now_s: float) -> Words:
    """Describe what a node that is none of `PROGRAMS` is doing: its own message.

    Args:
        report: the node's newest.
        now_s: time.monotonic(), s.

    Returns:
        The words.

    """
    silent_s = now_s - report.heard_s
    if silent_s > SILENT_S:
        return Words(
            NodeLevel.STALE, _silence(silent_s), "Start it again if it is needed.", "", False
        )
    return _own_words(report)


def _silent(report: NodeReport, program: Program, now_s: float) -> bool:
    # A compensation must not be believed in for long; a busy machine makes reports late.
    limit_s = _GRAVCOMP_SILENT_PERIODS * report.period_s if program is GRAVCOMP else SILENT_S
    return now_s - report.heard_s > limit_s


def compensates(state: SuiteState, now_s: float) -> bool:
    """Return whether compensated wrenches go out; switched on is not enough.

    Args:
        state: with the active tool, and gravcomp's report.
        now_s: time.monotonic(), s.

    Returns:
        True where a tool is active and switched on, and gravcomp is neither silent nor in a state
        that stops it.

    """
    active_tool = state.active_tool
    wanted = active_tool is not None and active_tool.enabled and bool(active_tool.tool)
    return wanted and not words_of(state, GRAVCOMP, now_s).stopped


# By the first words of gravcomp's value `setup`; what follows a colon is put in.
_SETUP = {
    "verified": "Set-up verified: at rest the readings fit the tool's weight in several"
    " orientations.",
    "not yet verified": "Set-up not verified yet: {}. Let the arm rest in other orientations,"
    " without contact.",
    "wrong": "The set-up is wrong: {}. " + REJECTED["wrong_setup"].todo,
    "not checked": "Set-up not checked: {}.",
}


def setup_sentence(state: SuiteState, now_s: float) -> str:
    """Describe whether readings at rest fit axes, signs and units.

    Args:
        state: with gravcomp's report.
        now_s: time.monotonic(), s.

    Returns:
        Sentences; empty where gravcomp is silent.

    """
    report = state.report_of(GRAVCOMP.node)
    if report is None or _silent(report, GRAVCOMP, now_s):
        return ""
    found, _, detail = report.values.get("setup", "").partition(": ")
    return _SETUP.get(found, "").format(detail.rstrip("."))


def overall(state: SuiteState, now_s: float) -> tuple[NodeLevel, str]:
    """Choose the worst report; compensation that puts out nothing goes first.

    Args:
        state: with all nodes' reports.
        now_s: time.monotonic(), s.

    Returns:
        Level and sentence.

    """
    words = {program: words_of(state, program, now_s) for program in PROGRAMS}
    own = words[GRAVCOMP]
    if own.stopped:
        return own.level, own.doing
    # What isn't running and isn't needed is no trouble; without a driver compensation stops.
    running = [
        (_RANK[one.level], program is GRAVCOMP, program, one)
        for program, one in words.items()
        if one.running
    ]
    rank, _, program, worst = max(running, key=lambda entry: entry[:2])
    if rank == 0 or program is GRAVCOMP:
        return own.level, own.doing
    return worst.level, f"{program.title}: {worst.doing}"


_RANK = {NodeLevel.OK: 0, NodeLevel.WARN: 1, NodeLevel.STALE: 2, NodeLevel.ERROR: 3}


def _absent(state: SuiteState, program: Program, report: NodeReport | None, now_s: float) -> Words:
    command = program.start(state)
    start = f"Start it: {command}"
    if program is DRIVER:
        start = f"Start the arm's driver. For a simulated arm: {command}"
    if program is DRIVER and report is None:
        drivers = _other_drivers(state, now_s)
        if drivers:
            return Words(
                NodeLevel.OK, f"Another driver sends: {drivers}.", "", "nothing of its state"
            )
    if report is not None:
        text = _silence(now_s - report.heard_s)
    elif program.offers and program.offers in state.available:
        return Words(
            NodeLevel.STALE, f"{program.title} is there, but has not reported its state yet.",
            "Wait a moment. If that stays so, start it again.", "", False, True,
        )  # fmt: skip
    else:
        text = "Not running."
    if program is GRAVCOMP:
        text = f"No compensation: {text[0].lower()}{text[1:]}"
    level = NodeLevel.STALE if program.needed or report is not None else NodeLevel.OK
    return Words(level, text, start, "", False, program.needed)


def _silence(silent_s: float) -> str:
    if silent_s < 120.0:
        return f"Not running, or silent for {silent_s:.0f} s."
    return f"Not running, or silent for {silent_s / 60.0:.0f} min."


def _other_drivers(state: SuiteState, now_s: float) -> str:
    report = state.report_of(GRAVCOMP.node)
    if report is None or _silent(report, GRAVCOMP, now_s):
        return ""
    return report.values.get("wrench_raw_publisher_nodes", "")


def _present(
    program: Program, report: NodeReport, active_tool: LoadedTool | None, calibrating: bool
) -> Words:
    lifecycle = report.values.get("lifecycle", "")
    name = report.values.get("state", "")
    if name not in ("", "inactive") or lifecycle in ("", "active"):
        return _by_state(program, report, name, active_tool, calibrating)
    failed = report.level is NodeLevel.ERROR
    advice = LIFECYCLE.get(f"{lifecycle} failed" if failed else lifecycle)
    if advice is None:
        return _own_words(report)
    return Words(
        report.level, advice.doing, advice.todo.format(node=report.name), report.message, True, True
    )


def _by_state(
    program: Program,
    report: NodeReport,
    name: str,
    active_tool: LoadedTool | None,
    calibrating: bool,
) -> Words:
    level, advice = report.level, find_advice(program.node, name, report.level)
    if calibrating and (program, name) == (GRAVCOMP, "does_not_fit"):
        level, advice = NodeLevel.OK, FIT_NOT_JUDGED
    if advice is None:
        return _own_words(report)
    tool = report.values.get("tool", "") or ("" if active_tool is None else active_tool.tool)
    given = {"tool": tool or "the tool", "node": report.name}
    return Words(
        level, advice.doing.format(**given), advice.todo.format(**given), report.message,
        True, advice.stopped,
    )  # fmt: skip


def find_advice(node: str, state: str, level: NodeLevel) -> Advice | None:
    """Return the words for a state's name.

    Args:
        node: the node's name without a namespace.
        state: the value `state` of its report.
        level: of its report.

    Returns:
        The words; None where there are none.

    """
    known = ADVICE.get(node, {})
    advice = known.get(f"{state} {level.name.lower()}", known.get(state))
    if advice is not None or node not in OUTPUT:
        return advice
    rejected = REJECTED.get(state)
    if rejected is None:
        return None
    works, lost = OUTPUT[node]
    if level is NodeLevel.WARN:
        return Advice(f"{works}, but some wrenches are left out: {rejected.doing}.",
                      rejected.todo)  # fmt: skip
    return Advice(f"{lost}: {rejected.doing}.", rejected.todo, True)


def _own_words(report: NodeReport) -> Words:
    # A state that is not known here: a node of another version.
    todo = "" if report.level is NodeLevel.OK else "Its own message says what is wrong."
    stopped = report.level in (NodeLevel.ERROR, NodeLevel.STALE)
    return Words(report.level, _sentence(report.message), todo, "", True, stopped)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" if text else "It tells its level only."
