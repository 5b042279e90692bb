# SPDX-License-Identifier: Apache-2.0
"""The collection's course, without ROS: samples and events in, commands out.

    record calibration_1 > CALIBRATION
    record push > for each set, for each position: MOVE > UNTOUCHED > pushes
    record calibration_2 > CALIBRATION > compare both

and for each push PUSH <> HOLD > RELEASE > REST, again if it was not as asked. Both calibration sets
are at the first position. They have bags of their own, because a third visit there without a push
would count as a set of pushes.

A cancel, an error and time are as in `galen_common.goal.procedure`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import partial

import numpy as np
from galen_common.goal.arrival import NS, StampClock
from galen_common.goal.procedure import JOINTS, GoalProcedure
from galen_model.arrays import Array

from galen_deflection.collection.plan import (
    NOTHING,
    CollectionParameters,
    CollectionPlan,
    ErrorCode,
    Feedback,
    Finished,
    OutOfReachError,
    PlanError,
    Push,
    Record,
    State,
    WantedPush,
)
from galen_deflection.collection.watches import (
    NoContact,
    NoContactWatch,
    PushWatch,
    collection_shift,
    shift_sentence,
)
from galen_deflection.models.springs import Springs

CALIBRATION_BAGS = ("calibration_1", "calibration_2")
PUSH_BAG = "push"

# A push is looked at so often, by its mean load over the window; each sample costs only an append.
_LOOK_NS = 20_000_000
_WINDOW_NS = 50_000_000
_FEEDBACK_S = 0.1
# A hand by service pushes so much longer than it must be held, and may come so much later.
_SERVICE_SPARE_S = 0.3
_SERVICE_PATIENCE_S = 3.0
# The tracker's poses may come so much later than the wrenches of the same time.
_MARKER_PATIENCE_S = 0.5
_WRENCH = "wrench_compensated"


class CollectionProcedure(GoalProcedure):
    """One collection. Call `start`, feed samples and events, and do what `take_commands` gives."""

    codes = ErrorCode
    wrench_topic = _WRENCH
    _settings: CollectionParameters
    _state: State

    def __init__(
        self,
        settings: CollectionParameters,
        plan: CollectionPlan,
        tip_m: Array,
        by_service: bool,
    ) -> None:
        """`tip_m` (3,) in ft_sensor; `by_service`: `push_tool` pushes, not a person."""
        super().__init__(settings, State.CALIBRATION)
        self._plan = plan
        self._tip_m, self._arm = tip_m, settings.arm
        self._by_service = by_service
        self._script = self._steps()
        self._set = self._position = 0  # from 1; 0 in a calibration set
        self._no_contact: NoContactWatch | None = None
        self._on_no_contact: Callable[[NoContact], None] | None = None
        self._no_contact_since_ns = 0
        self._calibrations: list[NoContact] = []
        self._here: NoContact | None = None
        self._springs = Springs(tip_m, settings.arm)
        self._window: deque[tuple[int, Array]] = deque()
        self._watch: PushWatch | None = None
        self._push_number = 0
        self._pushes_until_s = 0.0
        self._tries = 0
        self._in_a_row = 0
        self._good = 0
        self._left_out: list[str] = []
        self._warnings: list[str] = []
        self._shift = NOTHING
        self._holds = False
        self._not_before_ns = 0
        self._last_look = 0
        self._reported_s = 0.0
        self._over_limit = 0
        self._seen_jumps = 0
        self._tool_seen_s = 0.0
        self._tool_stamp_ns: int | None = None
        self._tool_key: tuple[float, ...] = ()
        self._clock = StampClock(_WRENCH, settings.arrival.max_stamp_step_s)

    @property
    def plan(self) -> CollectionPlan:
        """What is collected, from the start on with the positions that the arm goes to."""
        return self._plan

    @property
    def progress(self) -> tuple[int, int]:
        """Pushes done or left out, and pushes in all sets."""
        return self._good + len(self._left_out), self._plan.total

    def finish(self, code: IntEnum, message: str) -> Finished:
        """Return an end with what has come of it so far.

        Args:
            code: one of `ErrorCode`.
            message: the error in words; empty without one.

        Returns:
            The end, with pushes done and left out, shift and warnings.

        """
        warnings = [*self._plan.warnings, *self._warnings]
        if self._clock.jumps:
            warnings.append(
                f"time stamps jumped {self._clock.jumps} times; the last: {self._clock.last_jump}"
            )
        return Finished(
            ErrorCode(code), message, self._good, tuple(self._left_out), self._shift,
            self._holds, tuple(warnings),
        )  # fmt: skip

    # ---- events

    def _take_joints(self, stamp_ns: int, position: Array, velocity: Array | None) -> None:
        if not self.ending and not np.all(np.isfinite(position)):
            self.fail(ErrorCode.BAD_INPUT, f"{JOINTS} holds values that are not finite")
        elif self._arrival is not None:
            self._look_at_arrival(stamp_ns, position, velocity)
        elif self._no_contact is not None:
            self._no_contact.add_joints(position)
        elif self._watch is not None:
            self._check_position(position)

    def _take_wrench(self, stamp_ns: int, wrench: Array) -> None:
        if self.ending or not self._clock.advance(stamp_ns):
            return
        self._check_limits(wrench)
        self._check_stamps()
        if self.ending or stamp_ns < self._not_before_ns:
            return
        if self._no_contact is not None:
            self._no_contact.add_wrench(stamp_ns, wrench)
            self._look_at_no_contact()
        elif self._watch is not None:
            self._window.append((stamp_ns, wrench))
            self._look_at_push(stamp_ns)

    def on_tool_marker(self, stamp_ns: int, rotation: Array, translation: Array) -> None:
        """Take the tool's marker in `tracker`.

        Args:
            stamp_ns: its stamp.
            rotation: (3, 3).
            translation: (3,), m.

        """
        if self._no_contact is not None:
            self._no_contact.tool.add(stamp_ns, rotation, translation)
        key = (*translation.tolist(), *rotation.ravel().tolist())
        if np.all(np.isfinite(key)) and key != self._tool_key:
            self._tool_key = key
            if self._tool_stamp_ns is not None:
                self._check_marker((stamp_ns - self._tool_stamp_ns) / NS)
            self._tool_stamp_ns, self._tool_seen_s = stamp_ns, self._time_s

    def on_base_marker(self, stamp_ns: int, rotation: Array, translation: Array) -> None:
        """Take the base's marker in `tracker`.

        Args:
            stamp_ns: its stamp.
            rotation: (3, 3).
            translation: (3,), m.

        """
        if self._no_contact is not None:
            self._no_contact.base.add(stamp_ns, rotation, translation)

    def on_recording(self) -> None:
        """Every topic is recorded."""
        if self._waiting_for == "recording" and not self.ending:
            self._waiting_for = ""
            self._next()

    def on_service(self, success: bool, message: str, busy: bool = False) -> None:
        """Take the answer to the last Push.

        Args:
            success: whether the push has begun.
            message: the service's reason where it has not.
            busy: another push is under way; this one is not as asked.

        """
        if self._waiting_for != "push_tool" or self.ending:
            return
        self._waiting_for = ""
        if busy:
            self._spoil(f"push_tool: {message}")
        elif not success:
            self.fail(ErrorCode.SERVICE_FAILED, f"push_tool failed: {message}")

    def _check_patience(self) -> None:
        patience_s = self._settings.service_timeout_s
        if self._waiting_for == "recording" and self._waited_s > patience_s:
            self.fail(
                ErrorCode.WRITE_FAILED, f"not every topic was recorded within {patience_s:g} s"
            )
        else:
            super()._check_patience()

    def _make_end(self, code: IntEnum, message: str) -> Finished:
        return self.finish(code, message)

    def _drop_watches(self) -> None:
        self._no_contact = self._watch = None

    # ---- the course

    def _steps(self) -> Iterator[Callable[[], None]]:
        yield partial(self._record, CALIBRATION_BAGS[0])
        yield self._calibrate
        yield partial(self._record, PUSH_BAG)
        for number in range(self._plan.sets):
            for position in range(len(self._plan.positions)):
                yield partial(self._visit, number + 1, position + 1)
        yield partial(self._record, CALIBRATION_BAGS[1])
        yield self._calibrate
        yield self._compare

    def _begin(self) -> None:
        assert self._joints is not None
        try:
            settings = self._settings.beside(self.beside)
            self._plan = self._plan.begun_at(self._joints, settings, self._tip_m)
        except PlanError as error:
            far = isinstance(error, OutOfReachError)
            self.fail(ErrorCode.OUT_OF_REACH if far else ErrorCode.BAD_INPUT, str(error))
            return
        self._next()

    @property
    def _time_s(self) -> float:
        """Time gone by on the wrench's stamps."""
        return self._clock.elapsed_ns / NS

    def _next(self) -> None:
        self._waited_s = 0.0
        next(self._script)()

    def _record(self, bag: str) -> None:
        self._waiting_for = "recording"
        self._commands.append(Record(bag))

    def _calibrate(self) -> None:
        self._set = self._position = 0
        self._state = State.CALIBRATION
        number = len(self._calibrations) + 1
        self._report(f"calibration set {number} of 2: keep off the tool")
        self._go_to(self._plan.positions[0], partial(self._wait_for_no_contact, self._calibrated))

    def _calibrated(self, found: NoContact) -> None:
        self._calibrations.append(found)
        self._next()

    def _visit(self, number: int, position: int) -> None:
        self._set, self._position = number, position
        self._state = State.MOVE
        self._report("going to the position: keep off")
        self._go_to(self._plan.positions[position - 1], self._arrived_at_position)

    def _arrived_at_position(self) -> None:
        self._state = State.UNTOUCHED
        self._report("keep off the tool")
        self._wait_for_no_contact(self._begin_pushes)

    def _begin_pushes(self, found: NoContact) -> None:
        self._here = found
        self._push_number = self._tries = 0
        self._ask()

    def _compare(self) -> None:
        first, second = self._calibrations
        self._shift = collection_shift(first, second, self._tip_m, self._arm)
        warning = shift_sentence(first, second, self._shift, self._settings)
        self._holds = not warning
        if warning:
            self._warnings.append(warning)
        if not self._good:
            self.fail(ErrorCode.NO_PUSHES, f"no push was as asked; the last: {self._left_out[-1]}")
            return
        self._succeed()

    # ---- the tool left alone

    def _wait_for_no_contact(self, then: Callable[[NoContact], None]) -> None:
        self._no_contact = NoContactWatch(self._settings)
        self._on_no_contact = then
        self._no_contact_since_ns = self._clock.elapsed_ns

    def _look_at_no_contact(self) -> None:
        watch = self._no_contact
        assert watch is not None and self._on_no_contact is not None
        if watch.result is not None:
            self._no_contact = None
            self._on_no_contact(watch.result)
        elif watch.complaint:
            complaint, watch.complaint = watch.complaint, ""
            waited_s = (self._clock.elapsed_ns - self._no_contact_since_ns) / NS
            if waited_s > self._settings.untouched_timeout_s:
                where = f"at position {self._position}" if self._position else "when calibrating"
                self.fail(ErrorCode.NOT_UNTOUCHED, f"{where}, {complaint} ({waited_s:.0f} s)")
            else:
                self._report(f"{complaint}; keep off the tool, and let the tracker see it")

    # ---- pushes

    @property
    def _wanted(self) -> WantedPush:
        return self._plan.pushes[self._push_number]

    def _ask(self) -> None:
        settings = self._settings
        timeout_s = settings.push_timeout_s
        if self._by_service:
            timeout_s = (
                settings.push_edge_s + settings.hold_s + _SERVICE_SPARE_S + _SERVICE_PATIENCE_S
            )
        self._watch = PushWatch(self._wanted, settings, timeout_s, self._time_s)
        self._window.clear()
        self._state = self._watch.state

    def _look_at_push(self, stamp_ns: int) -> None:
        while stamp_ns - self._window[0][0] > _WINDOW_NS:
            self._window.popleft()
        if stamp_ns // _LOOK_NS == self._last_look:
            return
        self._last_look = stamp_ns // _LOOK_NS
        watch = self._watch
        assert watch is not None and self._here is not None
        wrench = np.mean([w for _, w in self._window], axis=0) - self._here.offset
        load = self._springs.at_tip(self._here.joints[None], wrench[None])[0]
        asked, before = watch.asked, watch.state
        self._check_marker(self._time_s - self._tool_seen_s - _MARKER_PATIENCE_S)
        # A push that was spoiled before it was felt comes nevertheless: that isn't let go of yet.
        if watch.state != State.RELEASE or self._time_s >= self._pushes_until_s:
            watch.look(self._time_s, load)
        self._state = watch.state
        if watch.outcome is not None:
            self._watch = None
            self._take_outcome(watch.outcome)
            return
        if watch.asked and not asked and self._by_service:
            self._push_by_service()
        if watch.state != before or self._time_s - self._reported_s >= _FEEDBACK_S:
            self._report_push(watch, load)

    def _push_by_service(self) -> None:
        settings = self._settings
        self._waiting_for = "push_tool"
        self._waited_s = 0.0
        push = Push(
            self._wanted.wrench,
            settings.push_edge_s,
            settings.hold_s + _SERVICE_SPARE_S,
            settings.push_edge_s,
        )
        self._pushes_until_s = self._time_s + push.rise_s + push.hold_s + push.fall_s
        self._commands.append(push)

    def _take_outcome(self, reason: str) -> None:
        if not reason:
            self._good += 1
            self._in_a_row = 0
        elif self._tries < self._settings.push_retries:
            self._tries += 1
            self._report(f"{self._wanted}: {reason}; once more")
            self._ask()
            return
        else:
            self._left_out.append(
                f"set {self._set}, position {self._position}, {self._wanted}: {reason}"
            )
            self._report(f"{self._wanted}: {reason}; left out")
            self._in_a_row += 1
            if self._in_a_row >= self._settings.max_left_out_in_a_row:
                self.fail(
                    ErrorCode.NO_PUSHES,
                    f"{self._in_a_row} pushes in a row were not as asked; the last:"
                    f" {self._left_out[-1]}",
                )
                return
        self._tries = 0
        self._push_number += 1
        if self._push_number < len(self._plan.pushes):
            self._ask()
        else:
            self._next()

    # ---- what spoils a push, or ends it all

    def _check_limits(self, wrench: Array) -> None:
        """Two samples in a row: a single one may be a spike on the line."""
        if not np.all(np.isfinite(wrench)):
            self.fail(ErrorCode.BAD_INPUT, f"{_WRENCH} holds values that are not finite")
            return
        force, torque = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        most_n, most_nm = self._settings.max_force_n, self._settings.max_torque_nm
        if force <= most_n and torque <= most_nm:
            self._over_limit = 0
            return
        self._over_limit += 1
        if self._over_limit == 2:
            self.fail(
                ErrorCode.OVERLOAD,
                f"{_WRENCH} reads {force:.1f} N and {torque:.2f} N·m; the limits are"
                f" {most_n:g} N and {most_nm:g} N·m",
            )

    def _check_stamps(self) -> None:
        """Begin anew where stamps jumped."""
        if self._clock.jumps == self._seen_jumps:
            return
        self._seen_jumps = self._clock.jumps
        if self._no_contact is not None:
            self._no_contact.begin_again()
            self._no_contact.complaint = self._clock.last_jump
        self._window.clear()
        self._spoil(self._clock.last_jump)

    def _check_position(self, position: Array) -> None:
        assert self._here is not None
        off = self._arm.nearest(position, self._here.joints) - self._here.joints
        away = np.abs(off) > self._settings.arrival.position_tolerance
        if np.any(away):
            k = int(np.argmax(away))
            self._spoil(
                f"{self._arm.joint_names[k]} moved by {off[k]:+.2g} {self._arm.units[k]}:"
                " the arm must hold its position (no admittance mode)"
            )

    def _check_marker(self, lost_s: float) -> None:
        if lost_s > self._settings.max_marker_gap_s:
            self._spoil(f"the tool's marker was lost for {lost_s:.2f} s")

    def _spoil(self, reason: str) -> None:
        if self._watch is not None:
            self._watch.spoil(reason, self._time_s)

    # ---- motion

    def _note_arrival(self, clock: StampClock) -> None:
        # The wrench comes by way of another node, and so from a time when the arm still moved.
        assert clock.stamp_ns is not None
        self._not_before_ns = clock.stamp_ns

    # ---- reports

    def _report(self, message: str) -> None:
        self._commands.append(
            Feedback(self._state, message, self._set, self._position, self.progress[0])
        )

    def _report_push(self, watch: PushWatch, load: Array) -> None:
        self._reported_s = self._time_s
        wanted = watch.wanted
        now = f"{_amount(watch.along, wanted)} now, {_amount(watch.aside, wanted)} aside"
        message = {
            State.PUSH: f"push {wanted}: {now}",
            State.HOLD: f"hold {wanted}: {now}",
            State.RELEASE: f"let go: {now}",
            State.REST: "keep off",
        }[watch.state]
        self._commands.append(
            Feedback(
                watch.state,
                message,
                self._set,
                self._position,
                self.progress[0],
                wanted.wrench,
                load,
                watch.along,
                watch.aside,
            )
        )


def _amount(value: float, wanted: WantedPush) -> str:
    decimals = 1 if wanted.is_force else 2
    return f"{round(value, decimals) + 0.0:.{decimals}f} {wanted.unit}"  # no minus before a zero
