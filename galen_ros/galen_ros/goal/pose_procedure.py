"""What the procedures share that measure at still poses: ways there, averages, their stamps."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import ClassVar

import numpy as np
from galen_model.arm.clearance import ObstacleError
from galen_model.arm.routes import Router
from galen_model.arrays import Array
from galen_model.rest.pose import PoseRecord

from galen_ros.goal.parameters import PoseParameters
from galen_ros.goal.pose_recorder import PoseRecorder, Rejection
from galen_ros.goal.procedure import CommandT, EndT, GoalProcedure
from galen_ros.goal.stamps import StampClock

# Errors that lost samples may be the cause of.
_OF_LOST_SAMPLES = ("MOTION_TIMEOUT", "POSES_NOT_STILL")


class PoseProcedure(GoalProcedure[CommandT, EndT]):
    """Goes to poses and averages the raw reading there; a wrench is of no use on the way.

    A subclass that knows of boxes sets `_router`; None: all ways are free.
    """

    wrench_topic: ClassVar[str] = "wrench_raw"
    _settings: PoseParameters

    def __init__(self, settings: PoseParameters, state: IntEnum) -> None:
        """`state` is the first one."""
        super().__init__(settings, state)
        self._router: Router | None = None
        self._ordered: Array | None = None
        self._recorder: PoseRecorder | None = None
        self._on_record: Callable[[PoseRecord | Rejection], None] | None = None
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
        """Stop the arm and end with this error; where samples were lost, it names the cause."""
        if self._recorder is not None and not self.ending:
            self._note_jumps(self._recorder.jumps, self._recorder.last_jump)
        if self._jumps and code.name in _OF_LOST_SAMPLES:
            message += (
                f"; time stamps jumped {self._jumps} times: samples are lost where the machine is"
                " overloaded; close other programs, or lower the simulated driver's speed_factor"
            )
        super().fail(code, message)

    def _record(
        self, target: Array, duration_s: float, then: Callable[[PoseRecord | Rejection], None]
    ) -> None:
        """Average at `target`, to which the arm goes in `duration_s`, and call `then` with it."""
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
        return super()._move(target)

    def _visit(self, target: Array, then: Callable[[PoseRecord | Rejection], None]) -> None:
        """Go to `target` around all boxes, and average there."""
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
        start = sent if sent is not None and np.all(np.abs(joints - sent) <= near) else joints
        try:
            way = router.route(start, target)
        except ObstacleError as error:
            roll, tilt = target[3:]
            self.fail(
                self.codes["BAD_INPUT"],
                f"no way to roll {roll:.3f}, tilt {tilt:.3f} rad: {error}",
            )
            return
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
