# SPDX-License-Identifier: Apache-2.0
"""Procedures of goals on the arm, without ROS: samples and events in, commands out.

Any state ends at once on `cancel` or `fail`: the arm is told to stop, and the procedure is finished
when it stands still. Times of motion are the samples' stamps; only waiting for answers and for a
silent driver goes by the wall clock, handed in by `on_wall`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
from galen_model.arm.clearance import ObstacleError
from galen_model.arm.routes import Router
from galen_model.arrays import Array
from galen_model.poses.plan import quintic_duration_s
from galen_model.rest.segments import PoseRecord

from galen_common.goal.arrival import (
    NS,
    ArrivalMonitor,
    MotionTimeoutError,
    PoseRecorder,
    PoseRejection,
    StampClock,
    StampsError,
)
from galen_common.goal.parameters import MotionParameters, PoseParameters

OnRecord = Callable[[PoseRecord | PoseRejection], None]

JOINTS = "joint_states"
DISCOVERY_S = 10.0
"""A driver that runs may take so long to be found and heard: DDS repeats what was lost after 3 s.

Measured on two cores with four times the load they can carry: the first sample came after 7 s.
"""
# A tick of the wall clock counts at most this much towards a silence: a process that was itself
# held up for seconds has the samples still waiting in its queues.
_LONGEST_TICK_S = 0.25
# Errors that lost samples may be the cause of.
_OF_LOST_SAMPLES = ("MOTION_TIMEOUT", "POSES_NOT_STILL")


@dataclass(frozen=True)
class MoveTo:
    """Go to `joints` (n,), m and rad, from rest to rest in `duration_s`."""

    joints: Array
    duration_s: float


@dataclass(frozen=True)
class Stop:
    """Decelerate and stay where the arm then is."""


@dataclass(frozen=True)
class End:
    """A goal is over, and the arm stands still as far as can be seen."""

    error_code: IntEnum
    error_msg: str


class _Silence:
    """How long a topic has brought nothing new, by the wall clock."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.silent_s = 0.0
        self._received = False
        self._moved_on = False
        self._ever = False
        self._standing_still = False
        self._stamp_ns: int | None = None

    def heard(self, stamp_ns: int) -> None:
        """Take the stamp of a sample."""
        self._received = self._ever = True
        if stamp_ns != self._stamp_ns:
            self._stamp_ns = stamp_ns
            self._moved_on = True

    def tick(self, dt_s: float) -> None:
        """Let wall time go by."""
        self.silent_s = 0.0 if self._moved_on else self.silent_s + dt_s
        self._standing_still = self._received and not self._moved_on
        self._received = self._moved_on = False

    def lasts(self, silent_timeout_s: float) -> bool:
        """Return whether it has been silent for too long."""
        least_s = 0.0 if self._ever else DISCOVERY_S
        return self.silent_s >= max(silent_timeout_s, least_s)

    def complaint(self) -> str:
        """Return what is wrong with the topic."""
        if self._standing_still:
            return f"the stamps of {self.topic} have stood still for {self.silent_s:.1f} s"
        if self._ever:
            return f"nothing on {self.topic} for {self.silent_s:.1f} s"
        return f"nothing has come on {self.topic}: is the driver running?"


class GoalProcedure(ABC):
    """One goal. Call `start`, feed samples and events, and do what `take_commands` gives.

    A subclass begins in `_begin`. While `_waiting_for` names a service, an answer
    from it is waited for, for `service_timeout_s`.
    """

    codes: ClassVar[type[IntEnum]]
    """The action's error codes, by the names that all actions here have in common."""
    wrench_topic: ClassVar[str]
    moves: ClassVar[bool] = True
    """Whether it commands the arm; else an operator moves it."""

    def __init__(self, settings: MotionParameters, state: IntEnum) -> None:
        """Prepare a goal; nothing happens before `start`.

        Args:
            settings: of motion and time-outs, with the arm.
            state: the first state, of the action's own enumeration.

        """
        self._settings = settings
        self._state = state
        self._commands: list[Any] = []
        self._arrival: ArrivalMonitor | None = None
        self._then: Callable[[], None] | None = None
        self._joints: Array | None = None
        self.beside: dict[str, float] = {}
        """Joints by name, m and rad, as the driver reports them, others than the arm's as well."""
        self._checked_from: Array | None = None
        self._stamps: dict[str, int] = {}
        self._silences = (_Silence(JOINTS), _Silence(self.wrench_topic))
        self._wall_s: float | None = None
        self._waited_s = 0.0
        self._waiting_for = ""
        self._started = self._under_way = self._finished = False
        self._ending: Any = None
        self.needs_arm = True
        """False at its end, while it only computes: nothing on the arm matters to it any more."""

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
    def holds_arm(self) -> bool:
        """Whether the arm has to be stopped where it ends now."""
        return self.moves and self.needs_arm

    @property
    @abstractmethod
    def progress(self) -> tuple[int, int]:
        """How much is done, of how much."""

    def take_commands(self) -> list[Any]:
        """Return the commands given since the last call.

        Returns:
            MoveTo, Stop, End and what a subclass adds, in order.

        """
        commands, self._commands = self._commands, []
        return commands

    # ---- for subclasses

    @abstractmethod
    def _begin(self) -> None:
        """Begin: both topics have brought a sample, by one clock."""

    @abstractmethod
    def _take_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state of the goal under way."""

    @abstractmethod
    def _take_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a wrench of the goal under way."""

    @abstractmethod
    def _make_end(self, code: IntEnum, message: str) -> Any:
        """Return the end with what has come of the goal so far."""

    @abstractmethod
    def _drop_watches(self) -> None:
        """Look at nothing any more but whether the arm stops."""

    @abstractmethod
    def _report(self, message: str) -> None:
        """Give feedback."""

    def _note_arrival(self, clock: StampClock) -> None:  # noqa: B027 - most have nothing to do
        """Note that the arm has arrived, or has not in time, by this clock."""

    # ---- events

    def start(self) -> None:
        """Begin as soon as joints and wrenches have come."""
        self._started = True
        self._report(f"waiting for {JOINTS} and {self.wrench_topic}")

    def on_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        """Take a joint state.

        Args:
            stamp_ns: its stamp, ns.
            position: (n,) of the arm's joints, m and rad.
            velocity: (n,), m/s and rad/s; None where the message has none.

        """
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
        """Take a wrench of `wrench_topic`.

        Args:
            stamp_ns: its stamp, ns.
            wrench: (6,) in the sensor's frame, N and N.m.

        """
        self._silences[1].heard(stamp_ns)
        if not self._under_way:
            self._begin_if_ready(self.wrench_topic, stamp_ns)
            return
        try:
            self._take_wrench(stamp_ns, wrench)
        except StampsError as error:
            self.fail(self.codes["BAD_INPUT"], str(error))

    def on_wall(self, now_s: float) -> None:
        """Take the time of a wall clock, some ten times a second.

        Args:
            now_s: of a steady clock, s; only differences count.

        """
        last_s, self._wall_s = self._wall_s, now_s
        dt = 0.0 if last_s is None else min(max(now_s - last_s, 0.0), _LONGEST_TICK_S)
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
        silent = [s for s in self._silences if s.lasts(settings.silent_timeout_s)]
        if silent and self.needs_arm:
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
        """Stop the arm and end with this error; nothing happens where the goal is ending already.

        Args:
            code: one of `codes`.
            message: the error's sentence, for the action's result.

        """
        if self.ending:
            return
        self._ending = self._make_end(code, message)
        self._drop_watches()
        self._waiting_for = ""
        self._waited_s = 0.0
        if self.holds_arm:
            self._commands.append(Stop())
        if code == self.codes["DRIVER_SILENT"] or not (self._under_way and self.holds_arm):
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
        return (self._stamps[self.wrench_topic] - self._stamps[JOINTS]) / NS

    def _check_patience(self) -> None:
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
                f"{self._settings.arm.joint_names[k]} = {self._joints[k]}"
                for k in np.flatnonzero(~np.isfinite(self._joints))
            )
            self.fail(self.codes["BAD_INPUT"], f"{JOINTS}: {bad}")
            return 0.0
        # An endless joint goes the way that was checked, else the shorter way round.
        start = target if self._checked_from is None else self._checked_from
        here = self._settings.arm.nearest(self._joints, start)
        duration = quintic_duration_s(
            target - here, self._settings.max_velocity, self._settings.max_acceleration
        )
        self._commands.append(MoveTo(target + (self._joints - here), duration))
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


class PoseProcedure(GoalProcedure):
    """Goes to poses and averages the raw reading there; a wrench is of no use on the way.

    A subclass that knows of boxes sets `_router`; None: all ways are free.
    """

    wrench_topic: ClassVar[str] = "wrench_raw"
    _settings: PoseParameters

    def __init__(self, settings: PoseParameters, state: IntEnum) -> None:
        """Prepare a goal; nothing happens before `start`.

        Args:
            settings: of motion, averages and time-outs, with the arm.
            state: the first state, of the action's own enumeration.

        """
        super().__init__(settings, state)
        self._router: Router | None = None
        self._ordered: Array | None = None
        self._recorder: PoseRecorder | None = None
        self._on_record: OnRecord | None = None
        self._jumps = 0
        self._last_jump = ""

    def _take_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        if self._recorder is not None:
            self._recorder.add_joints(stamp_ns, position, velocity)
            self._take_record()
        else:
            self._look_at_arrival(stamp_ns, position, velocity)

    def _take_wrench(self, stamp_ns: int, wrench: Array) -> None:
        if self._recorder is not None:
            self._recorder.add_wrench(stamp_ns, wrench)
            self._take_record()

    def _drop_watches(self) -> None:
        self._recorder = None

    def fail(self, code: IntEnum, message: str) -> None:
        """Stop the arm and end with this error.

        Args:
            code: one of `codes`.
            message: the error's sentence; where lost samples may be the cause, they are added.

        """
        if self._recorder is not None and not self.ending:
            self._note_jumps(self._recorder.jumps, self._recorder.last_jump)
        if self._jumps and code.name in _OF_LOST_SAMPLES:
            message += (
                f"; time stamps jumped {self._jumps} times: samples are lost where the machine is"
                " overloaded; close other programs, or lower the simulated driver's speed_factor"
            )
        super().fail(code, message)

    def _record(self, target: Array, duration_s: float, then: OnRecord) -> None:
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

    def _go_to(self, target: Array, then: Callable[[], None]) -> None:
        go_straight = super()._go_to
        self._on_the_way(target, lambda: go_straight(target, then))

    def _move(self, target: Array) -> float:
        self._ordered = target
        duration = super()._move(target)
        if self._checked_from is not None:
            self._checked_from = target
        return duration

    def _visit(self, target: Array, then: OnRecord) -> None:
        self._on_the_way(target, lambda: self._record(target, self._move(target), then))

    def _on_the_way(self, target: Array, then: Callable[[], None]) -> None:
        """Go where `target` is straight ahead, and call `then`."""
        router, joints = self._router, self._joints
        if router is None or joints is None or not np.all(np.isfinite(joints)):
            then()
            return
        # An arm that is where it was sent is so within its tolerance; the way was looked at from
        # the place itself.
        near = self._settings.arrival.position_tolerance
        sent = self._ordered
        arm = self._settings.arm
        is_there = sent is not None and np.all(np.abs(arm.nearest(joints, sent) - sent) <= near)
        start = arm.nearest(sent if sent is not None and is_there else joints, target)
        try:
            way = router.route(start, target)
        except ObstacleError as error:
            self.fail(
                self.codes["BAD_INPUT"],
                f"no way to {arm.described(arm.angles(target))}: {error}",
            )
            return
        self._checked_from = start
        self._follow(way[:-1], then)

    def _follow(self, way: list[Array], then: Callable[[], None]) -> None:
        if not way:
            then()
            return
        super()._go_to(way[0], lambda: self._follow(way[1:], then))

    def _note_arrival(self, clock: StampClock) -> None:
        self._note_jumps(clock.jumps, clock.last_jump)

    def _note_jumps(self, count: int, last: str) -> None:
        self._jumps += count
        self._last_jump = last or self._last_jump

    def _warnings(self) -> list[str]:
        if not self._jumps:
            return []
        return [f"time stamps jumped {self._jumps} times; the last: {self._last_jump}"]
