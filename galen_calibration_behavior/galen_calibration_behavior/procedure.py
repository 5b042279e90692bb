"""The calibration's state machine, without ROS: samples and events in, commands out.

    HOME -> REMOVE_TOOL -> ZERO -> SWEEP_BARE -> HOME -> ATTACH_TOOL -> SWEEP_TOOL -> HOME
    -> ESTIMATE

and for one sweep

    HOME -> REMOVE_TOOL -> ZERO -> ATTACH_TOOL -> SWEEP_TOOL -> HOME -> ESTIMATE

The sensor is zeroed at home with the adapter on and no tool in both. Any state ends at once on
`cancel` or `fail`: the arm is told to stop, and the procedure is finished when it stands still.
Times of motion are the samples' stamps; only waiting for answers, for a person and for a silent
driver goes by the wall clock, handed in by `on_wall`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm import JOINT_NAMES, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.identification import StillPoses

from galen_calibration_behavior.arrival import (
    ArrivalMonitor,
    ArrivalSettings,
    MotionTimeoutError,
)
from galen_calibration_behavior.commands import (
    AttachTool,
    Command,
    ErrorCode,
    Estimate,
    Feedback,
    Finished,
    Measurements,
    MoveTo,
    State,
    Stop,
    ZeroSensor,
)
from galen_calibration_behavior.motion_time import quintic_duration_s
from galen_calibration_behavior.pose_recorder import PoseRecorder, Rejection
from galen_calibration_behavior.silence import Silence, WallClock
from galen_calibration_behavior.stamps import NS, StampsError
from galen_calibration_behavior.stillness import PoseRecord, StillnessSettings
from galen_calibration_behavior.sweep import Sweep, Verdict, stack

# A topic's queue holds no more than this of stamps: 2000 samples at 500 Hz.
_DEEPEST_QUEUE_S = 4.0

_TWO_SWEEPS = (
    State.HOME,
    State.REMOVE_TOOL,
    State.ZERO,
    State.SWEEP_BARE,
    State.HOME,
    State.ATTACH_TOOL,
    State.SWEEP_TOOL,
    State.HOME,
    State.ESTIMATE,
)
_ONE_SWEEP = (
    State.HOME,
    State.REMOVE_TOOL,
    State.ZERO,
    State.ATTACH_TOOL,
    State.SWEEP_TOOL,
    State.HOME,
    State.ESTIMATE,
)


@dataclass(frozen=True)
class ProcedureSettings:
    """Everything that the node's parameters decide."""

    home: Array  # (5,) m and rad
    arrival: ArrivalSettings
    stillness: StillnessSettings
    average_s: float
    max_velocity: Array  # (5,)
    max_acceleration: Array  # (5,)
    motion_timeout_s: float  # beyond the move's own duration
    pose_retries: int
    max_rejected_in_a_row: int
    min_pose_fraction: float
    zero_tolerance: Array  # (6,) largest reading just after zeroing, N and N.m
    max_stamp_offset_s: float
    silent_timeout_s: float
    service_timeout_s: float
    confirm_timeout_s: float
    stop_timeout_s: float


@dataclass(frozen=True)
class Request:
    """What one goal asks for; `poses` (n, 2) are roll and tilt in rad."""

    tool: str
    one_sweep: bool
    attach_by_service: bool
    poses: Array


class CalibrationProcedure:
    """One calibration. Call `start`, feed samples and events, and do what `take_commands` gives."""

    def __init__(self, settings: ProcedureSettings, request: Request) -> None:
        self._settings = settings
        self._request = request
        self._commands: list[Command] = []
        self._plan = iter(_ONE_SWEEP if request.one_sweep else _TWO_SWEEPS)
        self._state = State.HOME
        self._arrival: ArrivalMonitor | None = None
        self._recorder: PoseRecorder | None = None
        self._on_record: Callable[[PoseRecord | Rejection], None] | None = None
        self._sweep: Sweep | None = None
        self._bare: Sweep | None = None
        self._tool: Sweep | None = None
        self._done_before = 0
        self._total = len(request.poses) * (1 if request.one_sweep else 2)
        self._waiting_for_service = ""
        self._waiting_for_person = False
        self._waited_s = 0.0
        self._zero_attempts = 0
        self._zero_checks_left = 0
        self._bias_pose = (float("nan"), float("nan"))
        self._jumps = 0
        self._last_jump = ""
        self._joints: Array | None = None
        self._stamps: dict[str, int] = {}
        self._silences = (Silence("joint_states"), Silence("wrench_raw"))
        self._wall = WallClock()
        self._started = False
        self._under_way = False
        self._ending: Finished | None = None
        self._finished = False

    @property
    def state(self) -> State:
        """The state it is in, or was in when it began to end."""
        return self._state

    @property
    def finished(self) -> bool:
        """Whether it is over."""
        return self._finished

    @property
    def ending(self) -> bool:
        """Whether it is over, or only waits for the arm to stop."""
        return self._finished or self._ending is not None

    @property
    def waiting_for_person(self) -> bool:
        """Whether `confirm` would be heard."""
        return self._waiting_for_person and not self.ending

    @property
    def progress(self) -> tuple[int, int]:
        """Poses finished in all sweeps, and poses in all sweeps."""
        return self._done_before + (self._sweep.finished_poses if self._sweep else 0), self._total

    def take_commands(self) -> list[Command]:
        """Return the commands given since the last call, in order."""
        commands, self._commands = self._commands, []
        return commands

    # ---- events

    def start(self) -> None:
        """Begin as soon as both topics have brought a sample."""
        self._started = True
        self._report("waiting for joint_states and wrench_raw")

    def on_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state, (5,) in m, rad and per s; velocity None where there is none."""
        self._silences[0].heard(stamp_ns)
        self._joints = position
        if not self._under_way:
            self._stamps["joint_states"] = stamp_ns
            self._begin_if_ready()
            return
        try:
            if self._recorder is not None:
                self._recorder.add_joints(stamp_ns, position, velocity)
                self._take_record()
            elif self._arrival is not None and self._arrival.add(stamp_ns, position, velocity):
                self._note_jumps(self._arrival.clock.jumps, self._arrival.clock.last_jump)
                self._arrival = None
                self._on_arrived()
        except MotionTimeoutError as error:
            self._on_motion_timeout(str(error))
        except StampsError as error:
            self.fail(ErrorCode.BAD_INPUT, str(error))

    def on_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a wrench, (6,) in ft_sensor, N and N.m."""
        self._silences[1].heard(stamp_ns)
        if not self._under_way:
            self._stamps["wrench_raw"] = stamp_ns
            self._begin_if_ready()
        elif self._recorder is not None:
            try:
                self._recorder.add_wrench(stamp_ns, wrench)
                self._take_record()
            except StampsError as error:
                self.fail(ErrorCode.BAD_INPUT, str(error))

    def on_service(self, success: bool, message: str) -> None:
        """Take the answer to the last ZeroSensor or AttachTool."""
        name, self._waiting_for_service = self._waiting_for_service, ""
        if not name or self.ending:
            return
        if not success:
            self.fail(ErrorCode.SERVICE_FAILED, f"{name} failed: {message}")
        elif self._state == State.ZERO:
            one_check_s = self._settings.arrival.settle_s + self._settings.average_s
            self._zero_checks_left = math.ceil(_DEEPEST_QUEUE_S / one_check_s)
            self._record(self._settings.home, 0.0, self._on_zero_checked)
        else:
            self._next()

    def confirm(self) -> bool:
        """Take a person's word that the tool is off or on; False when nobody was asked."""
        if not self.waiting_for_person:
            return False
        self._waiting_for_person = False
        self._next()
        return True

    def on_wall(self, now_s: float) -> None:
        """Take the time of a steady wall clock (s), some ten times a second."""
        dt = self._wall.step(now_s)
        if self._finished or not self._started:
            return
        self._waited_s += dt
        for silence in self._silences:
            silence.tick(dt)
        if self._ending is not None:
            if self._waited_s > self._settings.stop_timeout_s:
                self._finish("the arm was not seen to stop")
            return
        silent = [s for s in self._silences if s.silent_s >= self._settings.silent_timeout_s]
        if silent:
            self.fail(ErrorCode.DRIVER_SILENT, "; ".join(s.complaint() for s in silent))
        elif (
            not self._under_way
            and len(self._stamps) == 2
            and self._waited_s > self._settings.silent_timeout_s
        ):
            self.fail(
                ErrorCode.BAD_INPUT,
                "the stamps of wrench_raw and joint_states differ by"
                f" {self._stamp_offset_s:+.3f} s: they must come from one clock",
            )
        elif self._waiting_for_service and self._waited_s > self._settings.service_timeout_s:
            self.fail(
                ErrorCode.SERVICE_FAILED,
                f"{self._waiting_for_service} did not answer in"
                f" {self._settings.service_timeout_s:g} s",
            )
        elif self._waiting_for_person and self._waited_s > self._settings.confirm_timeout_s:
            what = "taken off" if self._state == State.REMOVE_TOOL else "put on"
            self.fail(
                ErrorCode.CONFIRM_TIMEOUT,
                f"nobody confirmed in {self._settings.confirm_timeout_s:g} s that the tool was"
                f" {what}",
            )

    def cancel(self) -> None:
        """Stop the arm and end; nothing is written."""
        self.fail(ErrorCode.CANCELED, f"canceled in state {self._state.name}")

    def fail(self, code: ErrorCode, message: str) -> None:
        """Stop the arm and end with this error."""
        if self.ending:
            return
        self._ending = Finished(code, message, self._rejections(), self._warnings())
        self._recorder = None
        self._waiting_for_service = ""
        self._waiting_for_person = False
        self._waited_s = 0.0
        self._commands.append(Stop())
        if code == ErrorCode.DRIVER_SILENT or not self._under_way:
            self._finish("")
            return
        # To stand still is enough: nothing is measured that would need it settled.
        stopping = replace(self._settings.arrival, settle_s=0.0)
        self._arrival = ArrivalMonitor(stopping, None, float("inf"), "joint_states")

    def on_estimated(self) -> None:
        """The file is written."""
        if not self.ending:
            self._ending = Finished(ErrorCode.NONE, "", self._rejections(), self._warnings())
            self._finish("")

    # ---- states

    def _begin_if_ready(self) -> None:
        if not self._started or self.ending or len(self._stamps) < 2:
            return
        if abs(self._stamp_offset_s) > self._settings.max_stamp_offset_s:
            return
        self._under_way = True
        self._next()

    @property
    def _stamp_offset_s(self) -> float:
        """How far the wrench's newest stamp is ahead of that of the joint states."""
        return (self._stamps["wrench_raw"] - self._stamps["joint_states"]) / NS

    def _next(self) -> None:
        self._state = next(self._plan)
        self._waited_s = 0.0
        enter = {
            State.HOME: self._enter_home,
            State.REMOVE_TOOL: lambda: self._change_tool("", "take the tool off"),
            State.ZERO: self._enter_zero,
            State.SWEEP_BARE: lambda: self._enter_sweep("bare"),
            State.ATTACH_TOOL: lambda: self._change_tool(
                self._request.tool, f"put {self._request.tool} on"
            ),
            State.SWEEP_TOOL: lambda: self._enter_sweep("tool"),
            State.ESTIMATE: self._enter_estimate,
        }
        enter[self._state]()

    def _enter_home(self) -> None:
        self._report("going home")
        self._go_to(self._settings.home)

    def _on_arrived(self) -> None:
        if self._ending is not None:
            self._finish("")
        else:
            self._next()

    def _change_tool(self, tool: str, what: str) -> None:
        if self._request.attach_by_service:
            self._report(f"asking the driver to {what}")
            self._waiting_for_service = "attach_tool"
            self._commands.append(AttachTool(tool))
        else:
            self._waiting_for_person = True
            self._report(f"please {what}, let go, then confirm")

    def _enter_zero(self) -> None:
        """The arm may have been pushed while a person took the tool off: home again, and still."""
        self._zero_attempts += 1
        self._report("zeroing the sensor")
        self._record(self._settings.home, self._move(self._settings.home), self._on_ready_to_zero)

    def _on_ready_to_zero(self, outcome: PoseRecord | Rejection) -> None:
        if isinstance(outcome, Rejection):
            self._zero_again(outcome)
            return
        self._bias_pose = (float(outcome.joints[3]), float(outcome.joints[4]))
        self._waited_s = 0.0
        self._waiting_for_service = "bias_sensor"
        self._commands.append(ZeroSensor())

    def _on_zero_checked(self, outcome: PoseRecord | Rejection) -> None:
        if isinstance(outcome, Rejection):
            self._zero_again(outcome)
            return
        off = np.abs(outcome.wrench) > self._settings.zero_tolerance
        if np.any(off) and self._zero_checks_left > 0:
            # Samples from before the zeroing may still have been in the queue.
            self._zero_checks_left -= 1
            self._record(self._settings.home, 0.0, self._on_zero_checked)
            return
        if np.any(off):
            values = ", ".join(
                f"{WRENCH_AXES[k]} = {outcome.wrench[k]:.4g} {'N' if k < 3 else 'N.m'}"
                for k in np.flatnonzero(off)
            )
            self.fail(
                ErrorCode.SERVICE_FAILED,
                f"bias_sensor answered, but wrench_raw does not read zero: {values}",
            )
            return
        self._next()

    def _zero_again(self, rejection: Rejection) -> None:
        if self._zero_attempts > self._settings.pose_retries:
            self.fail(
                ErrorCode.BAD_INPUT if rejection.not_finite else ErrorCode.POSES_NOT_STILL,
                f"the sensor can't be zeroed at home: {rejection.reason}",
            )
        else:
            self._enter_zero()

    def _enter_sweep(self, name: str) -> None:
        self._sweep = Sweep(
            name, self._request.poses, self._settings.stillness, self._settings.pose_retries
        )
        if name == "bare":
            self._bare = self._sweep
        else:
            self._tool = self._sweep
        with_tool = "without the tool" if name == "bare" else f"with {self._request.tool}"
        self._report(f"sweep {with_tool}")
        self._visit_next_pose()

    def _visit_next_pose(self) -> None:
        assert self._sweep is not None
        index = self._sweep.current
        if index is None:
            self._finish_sweep(self._sweep)
            return
        roll, tilt = self._sweep.poses[index]
        target = np.array([*self._settings.home[:3], roll, tilt])
        self._record(target, self._move(target), self._on_pose)

    def _on_pose(self, outcome: PoseRecord | Rejection) -> None:
        assert self._sweep is not None
        for verdict in self._sweep.take(outcome):
            self._report_pose(verdict)
        if self._sweep.rejected_in_a_row >= self._settings.max_rejected_in_a_row:
            reason = outcome.reason if isinstance(outcome, Rejection) else "the wrench is not still"
            not_finite = isinstance(outcome, Rejection) and outcome.not_finite
            self.fail(
                ErrorCode.BAD_INPUT if not_finite else ErrorCode.POSES_NOT_STILL,
                f"{self._sweep.rejected_in_a_row} poses in a row can't be used; the last: {reason}",
            )
            return
        self._visit_next_pose()

    def _finish_sweep(self, sweep: Sweep) -> None:
        good, count = len(sweep.records), len(sweep.poses)
        if good < self._settings.min_pose_fraction * count:
            reason = sweep.rejections[-1]
            self.fail(
                ErrorCode.BAD_INPUT if sweep.not_finite else ErrorCode.POSES_NOT_STILL,
                f"only {good} of {count} poses of the {sweep.name} sweep can be used; {reason}",
            )
            return
        self._done_before += count
        self._sweep = None
        self._next()

    def _enter_estimate(self) -> None:
        assert self._tool is not None
        self._report("estimating")
        self._commands.append(
            Estimate(
                Measurements(
                    bare=None if self._bare is None else _still_poses(self._bare),
                    tool=_still_poses(self._tool),
                    bias_roll=self._bias_pose[0],
                    bias_tilt=self._bias_pose[1],
                    bare_indices=[] if self._bare is None else self._bare.indices,
                    tool_indices=self._tool.indices,
                    rejected=self._rejections(),
                    warnings=self._warnings(),
                )
            )
        )

    # ---- motion

    def _move(self, target: Array) -> float:
        """Order the move; return how long the arm may take, by stamps (s)."""
        assert self._joints is not None
        if not np.all(np.isfinite(self._joints)):
            bad = ", ".join(
                f"{JOINT_NAMES[k]} = {self._joints[k]}"
                for k in np.flatnonzero(~np.isfinite(self._joints))
            )
            self.fail(ErrorCode.BAD_INPUT, f"joint_states: {bad}")
            return 0.0
        duration = quintic_duration_s(
            target - self._joints, self._settings.max_velocity, self._settings.max_acceleration
        )
        self._commands.append(MoveTo(target, duration))
        return duration

    def _allowance(self, duration_s: float) -> float:
        settings = self._settings
        return duration_s + settings.arrival.settle_s + settings.motion_timeout_s

    def _go_to(self, target: Array) -> None:
        duration = self._move(target)
        if not self.ending:
            self._arrival = ArrivalMonitor(
                self._settings.arrival, target, self._allowance(duration), "joint_states"
            )

    def _record(
        self, target: Array, duration_s: float, then: Callable[[PoseRecord | Rejection], None]
    ) -> None:
        if self.ending:
            return
        self._recorder = PoseRecorder(
            self._settings.arrival,
            self._settings.stillness,
            self._settings.average_s,
            target,
            self._allowance(duration_s),
        )
        self._on_record = then

    def _take_record(self) -> None:
        recorder = self._recorder
        if recorder is None or recorder.result is None or self._on_record is None:
            return
        self._recorder = None
        self._note_jumps(recorder.jumps, recorder.last_jump)
        self._on_record(recorder.result)

    def _on_motion_timeout(self, message: str) -> None:
        self._arrival = None
        if self._ending is not None:
            self._finish(message)
        else:
            self.fail(ErrorCode.MOTION_TIMEOUT, message)

    # ---- reports

    def _finish(self, remark: str) -> None:
        assert self._ending is not None
        end = self._ending
        if remark:
            end = Finished(end.error_code, f"{end.error_msg}; {remark}", end.rejected, end.warnings)
        self._arrival = None
        self._finished = True
        self._commands.append(end)

    def _report(self, message: str) -> None:
        done, total = self.progress
        sweep = self._sweep
        self._commands.append(
            Feedback(
                self._state,
                message,
                pose=sweep.finished_poses if sweep else 0,
                poses=len(sweep.poses) if sweep else 0,
                done=done,
                total=total,
            )
        )

    def _report_pose(self, verdict: Verdict) -> None:
        assert self._sweep is not None
        done, total = self.progress
        wrench: tuple[float, ...] = (float("nan"),) * 6
        if verdict.record is not None:
            wrench = tuple(float(value) for value in verdict.record.wrench)
        where = f"{self._sweep.name}/{verdict.index}"
        self._commands.append(
            Feedback(
                self._state,
                f"{where}: {verdict.message}" if verdict.message else f"{where} recorded",
                pose=self._sweep.finished_poses,
                poses=len(self._sweep.poses),
                done=done,
                total=total,
                roll=verdict.roll,
                tilt=verdict.tilt,
                accepted=verdict.accepted,
                wrench=wrench,
            )
        )

    def _note_jumps(self, count: int, last: str) -> None:
        self._jumps += count
        self._last_jump = last or self._last_jump

    def _rejections(self) -> list[str]:
        return [text for sweep in (self._bare, self._tool) if sweep for text in sweep.rejections]

    def _warnings(self) -> list[str]:
        if not self._jumps:
            return []
        return [f"time stamps jumped {self._jumps} times; the last: {self._last_jump}"]


def _still_poses(sweep: Sweep) -> StillPoses:
    roll, tilt, wrench, std_of_mean = stack(sweep.records)
    return StillPoses(roll=roll, tilt=tilt, wrench=wrench, std_of_mean=std_of_mean)
