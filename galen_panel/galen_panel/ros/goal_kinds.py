"""The three behaviours' actions: goals to messages, feedback and results to words."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

from galen_calibration_behavior.commands import (
    CALIBRATION_PHASES,
    CHECK_PHASES,
    CalibrationCode,
    CalibrationState,
    CheckCode,
    CheckState,
)
from galen_deflection.collection import commands as collection_commands
from galen_deflection.collection.commands import COLLECTION_PHASES
from galen_model.files.calibration_file import check_tool_name
from galen_ros.goal.client import result_to_dict

from galen_msgs.action import CalibrateTool, CheckTool, CollectPushes
from galen_panel.messages.hints import CALIBRATION, COLLECTION, Program
from galen_panel.ros.thread import CallError
from galen_panel.snapshot import (
    Asked,
    BehaviourKind,
    BehaviourOutcome,
    CalibrateGoal,
    CheckGoal,
    CollectGoal,
    FinishedPose,
    Goal,
)


@dataclass(frozen=True)
class Step:
    """What one feedback says; `phase` is the name of a state. pose None: none has just ended."""

    phase: str
    message: str
    done: int
    total: int
    pose: FinishedPose | None = None


class GoalKind(ABC):
    """One action of the suite."""

    kind: ClassVar[BehaviourKind]
    program: ClassVar[Program]
    action_type: ClassVar[Any]
    lost: ClassVar[str]
    """What becomes of a goal without its server."""
    codes: ClassVar[type[IntEnum]]
    states: ClassVar[type[IntEnum]]
    phases: ClassVar[dict[Any, str]]

    @abstractmethod
    def request(self, goal: Any) -> Any:
        """The action's goal; raises CallError or ToolNameError for one that can't be."""

    @abstractmethod
    def begun(self, goal: Any) -> str:
        """That it has begun, for a person."""

    @abstractmethod
    def tool(self, goal: Any, active_tool: str) -> str:
        """The tool's name; `active_tool`: that of the active tool."""

    @abstractmethod
    def _file(self, result: Any) -> str:
        """What was written; empty for nothing."""

    @abstractmethod
    def _succeeded(self, result: Any) -> str:
        """How it ended, in a sentence."""

    def _failed(self, message: str, result: Any) -> str:
        return message

    def _notes(self, result: Any) -> Iterable[str]:
        return ()

    def step(self, feedback: Any) -> Step:
        """What a feedback says."""
        phase = self._phase(feedback.state)
        return Step(phase, feedback.message, feedback.done, feedback.total, self._pose(feedback))

    def _pose(self, feedback: Any) -> FinishedPose | None:
        return None

    def _phase(self, state: int) -> str:
        known = state in (one.value for one in self.states)
        return self.states(state).name if known else ""

    def phase_text(self, phase: str) -> str:
        """A state's name in words."""
        known = phase in self.states.__members__
        return self.phases[self.states[phase]] if known else phase.lower().replace("_", " ")

    def asked(self, phase: str) -> Asked | None:
        """What a person does in this state, where one is to do it."""
        return None

    def outcome(self, result: Any, tool: str, new: bool) -> BehaviourOutcome:
        """What a result says; `new`: whether the tool had no file when the goal began."""
        known = result.error_code in (code.value for code in self.codes)
        code = self.codes(result.error_code).name if known else f"CODE_{result.error_code}"
        ok = code == "NONE"
        return BehaviourOutcome(
            error="" if ok else code,
            text=self._succeeded(result) if ok else self._failed(result.error_msg or code, result),
            tool=tool,
            file=self._file(result),
            values=result_to_dict(result),
            warnings=tuple(result.warnings),
            notes=tuple(self._notes(result)),
            new=new,
        )

    @property
    def gone(self) -> str:
        """That the server went away, and what became of its goal."""
        return f"{self.program.executable} went away; {self.lost}"


class CalibrationGoals(GoalKind):
    """`calibrate_tool`."""

    kind = BehaviourKind.CALIBRATE
    program = CALIBRATION
    action_type = CalibrateTool
    lost = "nothing was written"
    codes = CalibrationCode
    states = CalibrationState
    phases = CALIBRATION_PHASES

    def request(self, goal: CalibrateGoal) -> CalibrateTool.Goal:
        """See GoalKind."""
        tip = [math.nan] * 3 if goal.tip_m is None else [float(value) for value in goal.tip_m]
        if goal.tip_m is not None and not (len(tip) == 3 and all(map(math.isfinite, tip))):
            raise CallError("the tool's tip needs three finite numbers")
        return CalibrateTool.Goal(
            tool=check_tool_name(goal.tool),
            one_sweep=goal.one_sweep,
            attach_by_service=not goal.by_hand,
            tip_m=tip,
        )

    def begun(self, goal: CalibrateGoal) -> str:
        """See GoalKind."""
        return f"the calibration of {goal.tool} has begun"

    def tool(self, goal: CalibrateGoal, active_tool: str) -> str:
        """See GoalKind."""
        return goal.tool

    def asked(self, phase: str) -> Asked | None:
        """See GoalKind."""
        return Asked[phase] if phase in Asked.__members__ else None

    def _pose(self, feedback: Any) -> FinishedPose | None:
        if not math.isfinite(feedback.roll):
            return None
        bare = feedback.state == CalibrationState.SWEEP_BARE
        wrench = tuple(map(float, feedback.wrench))
        return FinishedPose(
            sweep="bare" if bare else "tool",
            number=feedback.pose,
            roll_rad=feedback.roll,
            tilt_rad=feedback.tilt,
            accepted=feedback.accepted,
            text=feedback.message,
            wrench=wrench if all(map(math.isfinite, wrench)) else None,
        )

    def _file(self, result: Any) -> str:
        return str(result.file)

    def _notes(self, result: Any) -> Iterable[str]:
        return tuple(result.notes)

    def _succeeded(self, result: Any) -> str:
        left_out = len(result.poses_rejected)
        poses = f"{result.poses_used} poses" + (f", {left_out} left out" if left_out else "")
        return (
            f"{result.tool} is calibrated: {1e3 * result.mass_kg:.2f} ±"
            f" {1e3 * result.mass_std_kg:.2f} g; {poses}"
        )

    def _failed(self, message: str, result: Any) -> str:
        return f"not calibrated, and nothing is written: {message}"


class CheckGoals(GoalKind):
    """`check_tool`."""

    kind = BehaviourKind.CHECK
    program = CALIBRATION
    action_type = CheckTool
    lost = "nothing is known of the tool"
    codes = CheckCode
    states = CheckState
    phases = CHECK_PHASES

    def request(self, goal: CheckGoal) -> CheckTool.Goal:
        """See GoalKind."""
        return CheckTool.Goal(tool=check_tool_name(goal.tool) if goal.tool else "")

    def begun(self, goal: CheckGoal) -> str:
        """See GoalKind."""
        return f"the check of {goal.tool or 'the active tool'} has begun"

    def tool(self, goal: CheckGoal, active_tool: str) -> str:
        """See GoalKind."""
        return goal.tool or active_tool

    def _pose(self, feedback: Any) -> FinishedPose | None:
        if not math.isfinite(feedback.roll):
            return None
        roll, tilt, done = feedback.roll, feedback.tilt, feedback.done
        return FinishedPose("check", done, roll, tilt, feedback.accepted, feedback.message)

    def _file(self, result: Any) -> str:
        return ""

    def _succeeded(self, result: Any) -> str:
        return str(result.text)

    def _failed(self, message: str, result: Any) -> str:
        return f"not checked: {message}"


class CollectionGoals(GoalKind):
    """`collect_pushes`."""

    kind = BehaviourKind.COLLECT
    program = COLLECTION
    action_type = CollectPushes
    lost = "what it recorded is under a name that ends in .unfinished"
    codes = collection_commands.ErrorCode
    states = collection_commands.State
    phases = COLLECTION_PHASES

    def request(self, goal: CollectGoal) -> CollectPushes.Goal:
        """See GoalKind."""
        return CollectPushes.Goal(
            name=check_tool_name(goal.name, "recording's"),
            tool=check_tool_name(goal.tool),
            push_by_service=not goal.by_hand,
        )

    def begun(self, goal: CollectGoal) -> str:
        """See GoalKind."""
        return f"the collection of {goal.name} has begun"

    def tool(self, goal: CollectGoal, active_tool: str) -> str:
        """See GoalKind."""
        return goal.tool

    def _file(self, result: Any) -> str:
        return str(result.directory)

    def _notes(self, result: Any) -> Iterable[str]:
        return (f"left out: {text}" for text in result.left_out)

    def _succeeded(self, result: Any) -> str:
        return f"{result.pushes} of {result.pushes_asked} pushes are recorded"

    def _failed(self, message: str, result: Any) -> str:
        where = f"; what was recorded is in {result.directory}" if result.directory else ""
        return f"not collected: {message}{where}"


KINDS: tuple[GoalKind, ...] = (CalibrationGoals(), CheckGoals(), CollectionGoals())


def kind_of(goal: Goal) -> BehaviourKind:
    """Which behaviour a goal is for."""
    if isinstance(goal, CalibrateGoal):
        return BehaviourKind.CALIBRATE
    return BehaviourKind.CHECK if isinstance(goal, CheckGoal) else BehaviourKind.COLLECT
