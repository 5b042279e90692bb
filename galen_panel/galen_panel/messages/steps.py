# SPDX-License-Identifier: Apache-2.0
"""The guide: five steps from nothing to a compensated wrench, and which one is next. No ROS."""

from __future__ import annotations

from typing import NamedTuple

from galen_model.load.verdict import CheckAnswer

from galen_panel.messages import programs, texts
from galen_panel.messages.advice import REJECTED
from galen_panel.messages.programs import CALIBRATION, DRIVER, GRAVCOMP
from galen_panel.state.snapshot import BehaviourKind, SuiteState

_NO_STREAM = frozenset({*REJECTED, "silent", "waiting", "incompatible_qos"}) - {"disabled"}
"""States of gravcomp in which the arm's data doesn't come as it should."""


class Step(NamedTuple):
    """name: a word; done; doing: a sentence on what is; todo: what to do next, empty where done."""

    name: str
    done: bool
    doing: str
    todo: str = ""


def steps(state: SuiteState, now_s: float) -> tuple[Step, ...]:
    """Return the guide's steps in their order.

    Args:
        state: that they are judged by.
        now_s: time.monotonic(), s.

    Returns:
        Connect, check, calibrate, verify, use.

    """
    return (
        _connect(state, now_s),
        _check(state, now_s),
        _calibrate(state),
        _verify(state),
        _use(state, now_s),
    )


def current(found: tuple[Step, ...]) -> int:
    """Return the number of the first step that isn't done.

    Args:
        found: the steps, as `steps` returns them.

    Returns:
        The number, from 0; that of the steps where all are done.

    """
    return next((number for number, step in enumerate(found) if not step.done), len(found))


def _connect(state: SuiteState, now_s: float) -> Step:
    words = {one: programs.words_of(state, one, now_s) for one in (DRIVER, GRAVCOMP, CALIBRATION)}
    # A driver that isn't the suite's tells no state: gravcomp hears it, or says that it is silent.
    lacking = [one for one in (GRAVCOMP, CALIBRATION) if not words[one].running]
    if not words[DRIVER].running and words[DRIVER].stopped and DRIVER.offers not in state.available:
        lacking.insert(0, DRIVER)
    if lacking:
        names = ", ".join(one.title.lower() for one in lacking)
        todo = "\n".join(words[one].todo for one in lacking)
        return Step("Connect", False, f"Missing: {names}.", todo)
    late = [
        one
        for one in words
        if state.report_of(one.node) is not None and one.offers not in state.available
    ]
    if late:
        names = ", ".join(one.title.lower() for one in late)
        todo = "\n".join(words[one].todo for one in late if words[one].todo)
        return Step("Connect", False, f"Not to be called yet: {names}.", todo or "Wait a moment.")
    return Step("Connect", True, "Driver, compensation and calibration are there.")


def _check(state: SuiteState, now_s: float) -> Step:
    words = programs.words_of(state, GRAVCOMP, now_s)
    report = state.report_of(GRAVCOMP.node)
    if not words.running or report is None:
        return Step("Check", False, "Joint angles and wrenches are not seen yet.")
    if report.values.get("state", "") in _NO_STREAM:
        return Step("Check", False, words.doing, words.todo)
    if state.drawing is None:
        return Step("Check", False, "The arm's description has not come.", state.arm_problem)
    return Step("Check", True, "Joint angles and wrenches come in, and the arm is known.")


def _calibrate(state: SuiteState) -> Step:
    behaviour = state.behaviours.get(BehaviourKind.CALIBRATE)
    if behaviour is not None and behaviour.running:
        todo = "Keep off."
        if behaviour.asked is not None:
            todo, _ = programs.question(behaviour.asked, behaviour.tool)
        return Step("Calibrate", False, f"{programs.title(behaviour)} is under way.", todo)
    usable = [tool.name for tool in state.tools or () if not tool.problem]
    if usable:
        return Step("Calibrate", True, f"Calibrated: {', '.join(usable)}.")
    doing = "No tool is calibrated yet."
    if behaviour is not None and behaviour.outcome is not None and behaviour.outcome.error:
        doing = f"The last calibration failed: {texts.sentence(behaviour.outcome.text)}"
    return Step(
        "Calibrate", False, doing,
        "Clear the area around the arm, give the tool a name, and start. Keep off until it ends.",
    )  # fmt: skip


def _verify(state: SuiteState) -> Step:
    check = state.behaviours.get(BehaviourKind.CHECK)
    if check is not None and check.running:
        return Step("Verify", False, f"{programs.title(check)} is under way.", "Keep off the tool.")
    outcome = None if check is None else check.outcome
    if outcome is not None and outcome.values.get("answer") == CheckAnswer.GOOD:
        return Step("Verify", True, f"The quick check of {outcome.tool} was good.")
    doing = "The calibration has not been checked since the panel started."
    if outcome is not None:
        doing = f"The last check was not good: {texts.sentence(outcome.text)}"
    return Step(
        "Verify", False, doing,
        "Put the calibrated tool on, activate it, and let the quick check go to a few poses.",
    )  # fmt: skip


def _use(state: SuiteState, now_s: float) -> Step:
    if programs.compensates(state, now_s) and state.active_tool is not None:
        doing = f"Compensated wrenches of {state.active_tool.tool} go out."
        return Step("Use", True, f"{doing} Without contact they stay near zero: see Live.")
    words = programs.words_of(state, GRAVCOMP, now_s)
    return Step("Use", False, words.doing, words.todo)
