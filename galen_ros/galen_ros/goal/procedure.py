"""What the courses of all goals on the arm share, without ROS: samples and events in, commands out.

Any state ends at once on `cancel` or `fail`: the arm is told to stop, and the procedure is finished
when it stands still. Times of motion are the samples' stamps; only waiting for answers and for a
silent driver goes by the wall clock, handed in by `on_wall`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import ClassVar, Generic, TypeVar

import numpy as np
from galen_model.arm.galen import JOINT_NAMES
from galen_model.arrays import Array
from galen_model.poses.order import quintic_duration_s

from galen_ros.goal.arrival import ArrivalMonitor, MotionTimeoutError
from galen_ros.goal.commands import End, MoveTo, Stop
from galen_ros.goal.parameters import MotionParameters
from galen_ros.goal.stamps import NS, Silence, StampClock, StampsError, WallClock

JOINTS = "joint_states"

CommandT = TypeVar("CommandT")
EndT = TypeVar("EndT", bound=End)


class GoalProcedure(ABC, Generic[CommandT, EndT]):
    """One goal. Call `start`, feed samples and events, and do what `take_commands` gives.

    A subclass says by `_begin` what it does first. While `_waiting_for` names a service, an answer
    from it is waited for, for `service_timeout_s`.
    """

    codes: ClassVar[type[IntEnum]]
    """The action's error codes, by the names that all actions here have in common."""
    wrench_topic: ClassVar[str]

    def __init__(self, settings: MotionParameters, state: IntEnum) -> None:
        """`state` is the first one."""
        self._settings = settings
        self._state = state
        self._commands: list[CommandT | EndT | MoveTo | Stop] = []
        self._arrival: ArrivalMonitor | None = None
        self._then: Callable[[], None] | None = None
        self._joints: Array | None = None
        self._stamps: dict[str, int] = {}
        self._silences = (Silence(JOINTS), Silence(self.wrench_topic))
        self._wall = WallClock()
        self._waited_s = 0.0
        self._waiting_for = ""
        self._started = self._under_way = self._finished = False
        self._ending: EndT | None = None

    @property
    def state(self) -> IntEnum:
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
    @abstractmethod
    def progress(self) -> tuple[int, int]:
        """How much is done, of how much."""

    def take_commands(self) -> list[CommandT | EndT | MoveTo | Stop]:
        """Return the commands given since the last call, in order."""
        commands, self._commands = self._commands, []
        return commands

    # ---- what a subclass says

    @abstractmethod
    def _begin(self) -> None:
        """Both topics have brought a sample, by one clock."""

    @abstractmethod
    def _take_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state of the goal under way."""

    @abstractmethod
    def _take_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a wrench of the goal under way."""

    @abstractmethod
    def _make_end(self, code: IntEnum, message: str) -> EndT:
        """Return the end with what has come of the goal so far."""

    @abstractmethod
    def _drop_watches(self) -> None:
        """Look at nothing any more but whether the arm stops."""

    @abstractmethod
    def _report(self, message: str) -> None:
        """Give feedback."""

    def _note_arrival(self, clock: StampClock) -> None:
        """The arm has arrived, or has not in time, by this clock of the joint states."""

    # ---- events

    def start(self) -> None:
        """Begin as soon as joints and wrenches have come."""
        self._started = True
        self._report(f"waiting for {JOINTS} and {self.wrench_topic}")

    def on_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state, (5,) in m, rad and per s; velocity None where there is none."""
        self._silences[0].heard(stamp_ns)
        self._joints = position
        if not self._under_way:
            self._begin_if_ready(JOINTS, stamp_ns)
            return
        try:
            self._take_joints(stamp_ns, position, velocity)
        except MotionTimeoutError as error:
            if self._arrival is not None:
                self._note_arrival(self._arrival.clock)
                self._arrival = None
            self.fail(self.codes["MOTION_TIMEOUT"], str(error))
        except StampsError as error:
            self.fail(self.codes["BAD_INPUT"], str(error))

    def on_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a wrench of `wrench_topic`, (6,) in ft_sensor, N and N.m."""
        self._silences[1].heard(stamp_ns)
        if not self._under_way:
            self._begin_if_ready(self.wrench_topic, stamp_ns)
            return
        try:
            self._take_wrench(stamp_ns, wrench)
        except StampsError as error:
            self.fail(self.codes["BAD_INPUT"], str(error))

    def on_wall(self, now_s: float) -> None:
        """Take the time of a steady wall clock (s), some ten times a second."""
        dt = self._wall.step(now_s)
        if self._finished or not self._started:
            return
        self._waited_s += dt
        for silence in self._silences:
            silence.tick(dt)
        settings = self._settings
        if self._ending is not None:
            if self._waited_s > settings.stop_timeout_s:
                self._finish("the arm was not seen to stop")
            return
        silent = [s for s in self._silences if s.silent_s >= settings.silent_timeout_s]
        if silent:
            self.fail(self.codes["DRIVER_SILENT"], "; ".join(s.complaint() for s in silent))
        elif (
            not self._under_way
            and len(self._stamps) == 2
            and self._waited_s > settings.silent_timeout_s
        ):
            self.fail(
                self.codes["BAD_INPUT"],
                f"the stamps of {self.wrench_topic} and {JOINTS} differ by"
                f" {self._stamp_offset_s:+.3f} s: they must come from one clock",
            )
        else:
            self._check_patience()

    def cancel(self) -> None:
        """Stop the arm and end."""
        self.fail(self.codes["CANCELED"], f"canceled in state {self._state.name}")

    def fail(self, code: IntEnum, message: str) -> None:
        """Stop the arm and end with this error."""
        if self.ending:
            return
        self._ending = self._make_end(code, message)
        self._drop_watches()
        self._waiting_for = ""
        self._waited_s = 0.0
        self._commands.append(Stop())
        if code == self.codes["DRIVER_SILENT"] or not self._under_way:
            self._finish("")
            return
        # To stand still is enough: nothing is measured that would need it settled.
        stopping = replace(self._settings.arrival, settle_s=0.0)
        self._arrival = ArrivalMonitor(stopping, None, float("inf"), JOINTS)

    # ---- begin and end

    def _begin_if_ready(self, topic: str, stamp_ns: int) -> None:
        self._stamps[topic] = stamp_ns
        if not self._started or self.ending or len(self._stamps) < 2:
            return
        if abs(self._stamp_offset_s) > self._settings.max_stamp_offset_s:
            return
        self._under_way = True
        self._begin()

    @property
    def _stamp_offset_s(self) -> float:
        """How far the wrench's newest stamp is ahead of that of the joint states."""
        return (self._stamps[self.wrench_topic] - self._stamps[JOINTS]) / NS

    def _check_patience(self) -> None:
        """Fail where an answer was waited for long enough."""
        if self._waiting_for and self._waited_s > self._settings.service_timeout_s:
            self.fail(
                self.codes["SERVICE_FAILED"],
                f"{self._waiting_for} did not answer in {self._settings.service_timeout_s:g} s",
            )

    def _succeed(self) -> None:
        self._ending = self._make_end(self.codes["NONE"], "")
        self._finish("")

    def _finish(self, remark: str) -> None:
        assert self._ending is not None
        end = self._ending
        if remark:
            end = replace(end, error_msg=f"{end.error_msg}; {remark}")
        self._arrival = None
        self._finished = True
        self._commands.append(end)

    # ---- motion

    def _move(self, target: Array) -> float:
        """Order the move; return how long the arm may take, by stamps (s)."""
        assert self._joints is not None
        if not np.all(np.isfinite(self._joints)):
            bad = ", ".join(
                f"{JOINT_NAMES[k]} = {self._joints[k]}"
                for k in np.flatnonzero(~np.isfinite(self._joints))
            )
            self.fail(self.codes["BAD_INPUT"], f"{JOINTS}: {bad}")
            return 0.0
        duration = quintic_duration_s(
            target - self._joints, self._settings.max_velocity, self._settings.max_acceleration
        )
        self._commands.append(MoveTo(target, duration))
        return duration

    def _allowance(self, duration_s: float) -> float:
        settings = self._settings
        return duration_s + settings.arrival.settle_s + settings.motion_timeout_s

    def _go_to(self, target: Array, then: Callable[[], None]) -> None:
        """Go there, and call `then` as soon as the arm has arrived."""
        duration = self._move(target)
        if not self.ending:
            self._then = then
            self._arrival = ArrivalMonitor(
                self._settings.arrival, target, self._allowance(duration), JOINTS
            )

    def _look_at_arrival(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state on the way of `_go_to`, or of an arm that is to stop."""
        arrival = self._arrival
        if arrival is None or not arrival.add(stamp_ns, position, velocity):
            return
        self._arrival = None
        if self._ending is not None:
            self._finish("")
            return
        self._note_arrival(arrival.clock)
        then, self._then = self._then, None
        assert then is not None
        then()
