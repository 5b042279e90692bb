# SPDX-License-Identifier: Apache-2.0
"""The three behaviours' actions: goals to messages, feedback and results to words."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, get_args

from galen_calibration_behavior.common.commands import (
    CALIBRATION_PHASES,
    CHECK_PHASES,
    CalibrationCode,
    CalibrationState,
    CheckCode,
    CheckState,
)
from galen_deflection.collection import plan as collection_plan
from galen_deflection.collection.plan import COLLECTION_PHASES
from galen_model.files.calibration_file import check_tool_name
from galen_ros.goal.client import result_to_dict

from galen_msgs.action import CalibrateTool, CheckTool, CollectPushes
from galen_panel.messages.programs import CALIBRATION, COLLECTION, NAMES, Program
from galen_panel.ros.thread import CallError
from galen_panel.state.snapshot import Asked, BehaviourKind, BehaviourOutcome, Goal


@dataclass(frozen=True)
class GoalKind:
    """One action of the suite.

    lost: what becomes of a goal without its server. failed: how a sentence on a failure begins.
    request: makes the action's goal, raises CallError or ToolNameError. succeeded: a sentence on a
    result.
    """

    kind: BehaviourKind
    program: Program
    action_type: Any
    codes: type[IntEnum]
    states: type[IntEnum]
    phases: Mapping[Any, str]
    lost: str
    failed: str
    request: Callable[[Goal], Any]
    succeeded: Callable[[Any], str]

    def begun(self, goal: Goal) -> str:
        """Write for a person that a goal has begun.

        Args:
            goal: as it was sent.

        Returns:
            The sentence.

        """
        what = goal.name or goal.tool or "the active tool"
        return f"{NAMES[self.kind]} of {what}: begun"

    def state_name(self, state: int) -> str:
        """Return the name of a feedback's state.

        Args:
            state: its number.

        Returns:
            The name; empty for an unknown one.

        """
        return self.states(state).name if state in (one.value for one in self.states) else ""

    def phase_text(self, state_name: str) -> str:
        """Put a state's name into words.

        Args:
            state_name: as in feedback or on /diagnostics.

        Returns:
            The words; an unknown name in lower case.

        """
        known = state_name in self.states.__members__
        return self.phases[self.states[state_name]] if known else state_name.lower()

    def asked(self, state_name: str) -> Asked | None:
        """Return what a person does in a state.

        Args:
            state_name: as in feedback or on /diagnostics.

        Returns:
            The step; None where a person does nothing.

        """
        return next((step for step in get_args(Asked) if step == state_name), None)

    def outcome(self, result: Any, tool: str, new: bool) -> BehaviourOutcome:
        """Read a result.

        Args:
            result: the action's Result.
            tool: the goal's.
            new: whether the tool had no file when the goal began.

        Returns:
            The outcome.

        """
        known = result.error_code in (code.value for code in self.codes)
        code = self.codes(result.error_code).name if known else f"CODE_{result.error_code}"
        ok = code == "NONE"
        text = self.succeeded(result) if ok else f"{self.failed}: {result.error_msg or code}"
        return BehaviourOutcome(
            error="" if ok else code,
            text=text,
            tool=tool,
            file=getattr(result, "file", "") or getattr(result, "directory", ""),
            values=result_to_dict(result),
            warnings=tuple(result.warnings),
            notes=tuple(getattr(result, "notes", ())),
            new=new,
        )

    @property
    def gone(self) -> str:
        """Sentence on a goal whose server went away."""
        return f"{self.program.executable} went away; {self.lost}"


def rejected_pose(feedback: Any) -> str:
    """Return why a pose was not still.

    Args:
        feedback: the action's Feedback.

    Returns:
        The reason; empty where the feedback is on something else.

    """
    ended = len(getattr(feedback, "angles", ())) > 0
    return str(feedback.message) if ended and not feedback.accepted else ""


def _calibration(goal: Goal) -> CalibrateTool.Goal:
    tip = [math.nan] * 3 if goal.tip_m is None else [float(value) for value in goal.tip_m]
    if goal.tip_m is not None and not (len(tip) == 3 and all(map(math.isfinite, tip))):
        raise CallError("the tool's tip needs three finite numbers")
    return CalibrateTool.Goal(
        tool=check_tool_name(goal.tool),
        one_sweep=goal.one_sweep,
        attach_by_service=not (goal.by_hand or goal.hand_guided),
        by_hand=goal.hand_guided,
        tip_m=tip,
    )


def _check(goal: Goal) -> CheckTool.Goal:
    return CheckTool.Goal(tool=check_tool_name(goal.tool) if goal.tool else "")


def _collection(goal: Goal) -> CollectPushes.Goal:
    return CollectPushes.Goal(
        name=check_tool_name(goal.name, "recording's"),
        tool=check_tool_name(goal.tool),
        push_by_service=not goal.by_hand,
    )


def _calibrated(result: Any) -> str:
    left_out = len(result.poses_rejected)
    poses = f"{result.poses_used} poses" + (f", {left_out} left out" if left_out else "")
    return (
        f"{result.tool} is calibrated: {1e3 * result.mass_kg:.2f} ±"
        f" {1e3 * result.mass_std_kg:.2f} g; {poses}"
    )


KINDS = (
    GoalKind(
        BehaviourKind.CALIBRATE,
        CALIBRATION,
        CalibrateTool,
        CalibrationCode,
        CalibrationState,
        CALIBRATION_PHASES,
        "nothing was written",
        "not calibrated, and nothing is written",
        _calibration,
        _calibrated,
    ),
    GoalKind(
        BehaviourKind.CHECK,
        CALIBRATION,
        CheckTool,
        CheckCode,
        CheckState,
        CHECK_PHASES,
        "nothing is known of the tool",
        "not checked",
        _check,
        lambda result: str(result.text),
    ),
    GoalKind(
        BehaviourKind.COLLECT,
        COLLECTION,
        CollectPushes,
        collection_plan.ErrorCode,
        collection_plan.State,
        COLLECTION_PHASES,
        "what it recorded is under a name that ends in .unfinished",
        "not collected",
        _collection,
        lambda result: f"{result.pushes} of {result.pushes_asked} pushes are recorded",
    ),
)
