# SPDX-License-Identifier: Apache-2.0
"""Wrenches and joints that come as two streams, paired by their stamps. No ROS.

What comes out is a `PairedWrench` or a `Rejected`. Samples are pushed in the order of their
arrival; every decision is made on stamps.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array

from galen_common.parameters import ParameterError, param
from galen_common.stream.regular_run import Arrivals, find_regular_run
from galen_common.stream.samples import (
    NO_JOINTS_GAP,
    JointBuffer,
    Notice,
    PairedWrench,
    Rejected,
    Rejection,
    Result,
    SampleLimits,
    angle_unit_notice,
    count_angle_unit_notices,
    joint_jump,
)
from galen_common.stream.watches import FROZEN_S, LATE_S

# Wrenches that may wait: 2 s of a driver at 500 Hz.
MAX_WAITING = 1000
# Samples of one driver never lie this far apart; two clocks do.
_OTHER_CLOCK_NS = 5_000_000_000


@dataclass(frozen=True)
class StreamParameters:
    """Limits of the samples, by their stamps, and when a topic is silent."""

    max_joint_age_s: float = param(
        0.05,
        "s; how far `joint_states` may lie behind a wrench, and how far apart two joint samples"
        " may be to interpolate between them",
        minimum=0.001,
        maximum=1.0,
    )
    restart_gap_s: float = param(
        1.0,
        "s; a longer gap in the stamps of a topic means that the driver was restarted",
        minimum=0.1,
        maximum=60.0,
    )
    silence_s: float = param(
        1.0,
        "s of wall time without a message after which a topic is called silent",
        minimum=0.1,
        maximum=60.0,
    )
    best_effort_input: bool = param(
        False, "subscribe as best effort, for who publishes the wrench or the joints so"
    )
    frozen_s: float = param(
        FROZEN_S,
        "s of wall time that a wrench may stay the same to the last bit while the arm turns;"
        " then it is rejected: the sensor hangs; 0: for ever",
        minimum=0.0,
        maximum=60.0,
    )
    late_s: float = param(
        LATE_S,
        "s; a wrench that takes so much longer from its stamp to its arrival than the fastest of"
        " the last 5 to 10 s gives a warning, and goes out; 0: none does. Not watched with"
        " `use_sim_time`",
        minimum=0.0,
        maximum=60.0,
    )
    check_units: bool = param(
        True,
        "whether nothing is published while torques look like N·mm or joint angles like degrees;"
        " false: the values are right",
    )
    sensor_range: tuple[float, ...] = param(
        (125.0, 125.0, 500.0, 3.0, 3.0, 3.0),
        "N, N.m; range of the sensor's axes fx fy fz tx ty tz; a wrench beyond it gives a warning",
        minimum=1e-6,
    )

    def validate(self) -> None:
        """Check what no single range can say.

        Raises:
            ParameterError: the sensor's range has not six numbers.

        """
        if len(self.sensor_range) != 6:
            raise ParameterError(
                f"parameter 'sensor_range' has {len(self.sensor_range)} numbers, but must have 6"
            )


class PairedRun(NamedTuple):
    """Regular wrenches with the joints at their stamps: (k,), (k,), (k, 6), (k, joints).

    taken: how many arrivals they and those that began to wait were.
    """

    taken: int
    number: np.ndarray
    stamp_ns: np.ndarray
    raw: Array
    joints: Array


class Awaited(Protocol):
    """Give what a wrench waits for besides the joints."""

    @property
    def known_until_ns(self) -> int | None:
        """The newest stamp that need not wait; None: none yet."""

    def late(self, newest_wrench_ns: int) -> tuple[Enum, str] | None:
        """Return why what waits must not wait any longer.

        Args:
            newest_wrench_ns: stamp of the newest wrench, ns.

        Returns:
            Reason and sentence of the rejection; None: it may wait.

        """


class WrenchPairing:
    """One sensor's wrenches and the joints at their stamps.

    Each wrench pushed ends in exactly one way: as a `PairedWrench`, or as a `Rejected` that names
    the reason. Not thread-safe: push everything from one thread.
    """

    def __init__(
        self,
        parameters: StreamParameters,
        on_restart: Callable[[str], None] | None = None,
        *,
        wrench_topic: str = "wrench_raw",
        sensor_frame: str = "",
        awaited: Awaited | None = None,
        arm: Arm,
    ) -> None:
        """Pair a topic's wrenches.

        Args:
            parameters: limits of ages, gaps and range.
            on_restart: called with a sentence after everything was cleared, because the driver
                restarted.
            wrench_topic: as it is called in sentences.
            sensor_frame: what a wrench's frame_id must be.
            awaited: what a wrench waits for besides the joints; None: nothing.
            arm: whose joints they are.

        """
        self._on_restart = on_restart
        self._awaited = awaited
        self._arm, self._turning = arm, arm.turning
        self.wrench_topic = wrench_topic
        self.sensor_frame = sensor_frame
        self.parameters = parameters
        self._barred: tuple[Enum, str] | None = None
        self._limits = SampleLimits(
            max_age_ns=round(parameters.max_joint_age_s * 1e9),
            restart_gap_ns=round(parameters.restart_gap_s * 1e9),
            max_waiting=MAX_WAITING,
            sensor_range=parameters.sensor_range,
        )
        self._joints = JointBuffer(self._limits.max_age_ns, arm=arm)
        self._waiting: deque[PairedWrench] = deque()
        self._newest_wrench_ns: int | None = None
        self._joint_trouble: str | None = None
        # Joints without limits may be reported over many turns.
        self._limited = [not arm.endless[k] for k in arm.turning]
        self._distrust: tuple[Enum, str] | None = None
        self._reported: tuple[int, tuple[float, ...]] | None = None
        self._jump: tuple[int, str] | None = None
        self.newest_wrench: Sequence[float] | Array | None = None
        """The last wrench (6,) that came by itself, N and N.m, whatever became of it."""
        self.received = 0
        self.rejections: Counter[Enum] = Counter()
        self.notices: Counter[Notice] = Counter()

    # State

    @property
    def waiting(self) -> int:
        """Wrenches that wait for joint samples."""
        return len(self._waiting)

    @property
    def newest_angles(self) -> tuple[float, ...] | None:
        """Angles of the turning joints as last reported, rad; None before any."""
        return None if self._reported is None else self._reported[1]

    def bar(self, reason: Enum, detail: str) -> list[Rejected]:
        """Reject every wrench until `unbar`, those that wait, too.

        Args:
            reason: under which they are counted.
            detail: sentence for an operator.

        Returns:
            The wrenches that waited.

        """
        self._barred = (reason, detail)
        return self.reject_waiting(reason, detail)

    def unbar(self) -> None:
        """Take wrenches again."""
        self._barred = None

    @property
    def distrusted(self) -> bool:
        """Whether every wrench is rejected by `distrust`."""
        return self._distrust is not None

    def distrust(self, reason: Enum, detail: str) -> list[Rejected]:
        """Reject every wrench until `trust`, for a reason that no single sample shows.

        Args:
            reason: under which they are counted.
            detail: sentence for an operator.

        Returns:
            The wrenches that waited.

        """
        self._distrust = (reason, detail)
        return self.reject_waiting(reason, detail)

    def trust(self) -> None:
        """Take wrenches again."""
        self._distrust = None

    def restart(self, why: str) -> list[Rejected]:
        """Forget every sample: it belongs to the driver's life so far. Counters stay.

        Args:
            why: sentence for an operator, which `on_restart` gets as well.

        Returns:
            The wrenches that waited.

        """
        results = self.reject_waiting(Rejection.RESTART, why)
        self._joints.clear()
        self._reported = None
        self._jump = None
        self._newest_wrench_ns = None
        self._joint_trouble = None
        self.notices[Notice.RESTART] += 1
        if self._on_restart is not None:
            self._on_restart(why)
        return results

    # Samples

    def push_bad_joints(self, detail: str) -> None:
        """Take note of a joint message that can't be used.

        Args:
            detail: why; the next rejections for lack of joints give it.

        """
        self.notices[Notice.BAD_JOINTS] += 1
        self._joint_trouble = detail

    def push_wrench(
        self,
        stamp_ns: int,
        wrench: Sequence[float] | Array,
        frame_id: str | None = None,
        tag: object = None,
    ) -> list[Result]:
        """Take a wrench.

        Args:
            stamp_ns: its stamp, ns.
            wrench: (6,) as read, in the sensor's frame, N and N.m.
            frame_id: of the message; None: not checked.
            tag: comes back with the paired wrench.

        Returns:
            What became of it and of those that waited; empty while it waits for joint samples.

        """
        number = self.received
        self.received += 1
        self.newest_wrench = wrench
        barred = self._barred or self._distrust
        if frame_id is not None and barred is None and frame_id != self.sensor_frame:
            detail = (
                f"{self.wrench_topic} has frame_id '{frame_id}', expected '{self.sensor_frame}'"
            )
            return [self.reject(stamp_ns, Rejection.WRONG_FRAME, detail, number)]
        if stamp_ns <= 0:
            detail = f"{self.wrench_topic} has no stamp (zero): the driver does not stamp its"
            return [self.reject(stamp_ns, Rejection.UNSTAMPED, f"{detail} samples", number)]
        if stamp_ns == self._newest_wrench_ns:
            detail = f"{self.wrench_topic} repeats a stamp; only the first wrench of a stamp is"
            return [self.reject(stamp_ns, Rejection.DUPLICATE, f"{detail} used", number)]
        results: list[Result] = [*self._follow_wrench_stamps(stamp_ns)]
        if barred is not None:
            results.append(self.reject(stamp_ns, *barred, number))
            return results
        values = tuple(map(float, wrench))
        # One sum finds a NaN or an infinity among the six; it overflows only beyond any wrench.
        if not math.isfinite(sum(values)):
            shown = ", ".join(f"{value:g}" for value in values)
            detail = f"{self.wrench_topic} holds a value that is not finite: ({shown})"
            results.append(self.reject(stamp_ns, Rejection.NONFINITE_WRENCH, detail, number))
            return results
        beyond_range, other_unit = self._limits.range_notices(values)
        if beyond_range:
            self.notices[Notice.BEYOND_RANGE] += 1
        if other_unit:
            self.notices[Notice.TORQUE_UNIT] += 1
        raw = np.array(values)
        until = self._known_until_ns()
        if until is not None and stamp_ns <= until:
            results.append(self._pair(stamp_ns, raw, tag, number))
            return results
        self._waiting.append(PairedWrench(stamp_ns, raw, (), tag, number))
        results.extend(self._drop_hopeless())
        return results

    def push_bad_wrench(self, detail: str) -> list[Rejected]:
        """Reject a wrench message that can't be read, and so has no stamp.

        Args:
            detail: why it can't be read.

        Returns:
            The one rejection, with stamp 0.

        """
        self.received += 1
        return [self.reject(0, Rejection.UNREADABLE, detail, self.received - 1)]

    def push_joints(self, stamp_ns: int, joints: tuple[float, ...]) -> list[Result]:
        """Take a joint sample.

        Args:
            stamp_ns: its stamp, ns.
            joints: all n joints of the arm, m and rad, or the k turning ones, rad; always the same.

        Returns:
            What became of wrenches that waited.

        """
        results: list[Result] = []
        newest = self._joints.newest_ns
        if newest is not None:
            restarted = self._limits.restarted("joint_states", stamp_ns, newest)
            if restarted:
                results.extend(self.restart(restarted))
        self._joint_trouble = None
        # As with wrenches: the sum is finite if all of them are.
        if not math.isfinite(sum(joints)):
            self.notices[Notice.NONFINITE_JOINTS] += 1
            joints = (math.nan,) * len(joints)
        else:
            angles = self._arm.angles_of(joints)
            if angle_unit_notice(angles, self._limited):
                self.notices[Notice.ANGLE_UNIT] += 1
            if self._jumped(stamp_ns, angles):
                self.notices[Notice.JOINT_JUMP] += 1
                joints = (math.nan,) * len(joints)
        wrong = self._joints.push(stamp_ns, joints)
        if wrong is not None:
            self.notices[wrong] += 1
            return results
        results.extend(self.release())
        return results

    def _jumped(self, stamp_ns: int, angles: tuple[float, ...]) -> bool:
        before = self._reported
        if before is not None and stamp_ns <= before[0]:
            return False
        self._reported = (stamp_ns, angles)
        if before is None:
            return False
        step_ns = stamp_ns - before[0]
        step_rad = max([abs(now - then) for now, then in zip(angles, before[1], strict=True)])
        if not joint_jump(step_ns, step_rad):
            return False
        # Rare, so that wrapped angles are looked at here alone.
        steps = self._arm.nearest(angles, before[1]) - np.array(before[1])
        step_rad = float(np.abs(steps).max())
        if not joint_jump(step_ns, step_rad):
            return False
        detail = f"joint_states jumped by {step_rad:.2f} rad within {step_ns * 1e-6:.1f} ms"
        self._jump = (stamp_ns, detail)
        return True

    def release(self) -> list[Result]:
        """Return what becomes of the wrenches that have waited long enough."""
        until = self._known_until_ns()
        results: list[Result] = []
        while until is not None and self._waiting and self._waiting[0].stamp_ns <= until:
            one = self._waiting.popleft()
            results.append(self._pair(one.stamp_ns, one.wrench, one.tag, one.number))
        return results

    def push_run(self, arrivals: Arrivals) -> PairedRun:
        """Take the regular samples at the start as arrays; nothing is rejected.

        Args:
            arrivals: samples of both topics, in the order of their arrival.

        Returns:
            The wrenches that come out; the sample at which `taken` ends is to be pushed by itself.

        """
        waiting = self._waiting
        waiting_ns = np.array([one.stamp_ns for one in waiting], dtype=np.int64)
        arrivals, joints = find_regular_run(
            arrivals,
            waiting_ns,
            self._newest_wrench_ns,
            self._joints,
            self._limits,
            self._reported,
            self._angles(arrivals.joints),
        )
        out, waited = len(joints), len(waiting)
        stamp_ns = np.concatenate((waiting_ns, arrivals.wrench_stamp_ns))
        held = np.reshape([one.wrench for one in waiting], (-1, 6))
        raw = np.concatenate((held, arrivals.wrenches))
        arrived = self.received + np.arange(len(arrivals.wrenches))
        number = np.concatenate(([one.number for one in waiting], arrived)).astype(np.int64)

        for _ in range(min(out, waited)):
            waiting.popleft()
        for row in range(max(out, waited), len(stamp_ns)):
            wrench = raw[row].copy()
            waiting.append(PairedWrench(int(stamp_ns[row]), wrench, (), None, int(number[row])))
        self._joints.push_regular(arrivals.joint_stamp_ns, arrivals.joints)
        angles = self._angles(arrivals.joints)
        if len(angles):
            self._joint_trouble = None
            self._reported = (int(arrivals.joint_stamp_ns[-1]), tuple(angles[-1].tolist()))
        if len(arrivals.wrench_stamp_ns):
            self._newest_wrench_ns = int(arrivals.wrench_stamp_ns[-1])
        self.received += len(arrivals.wrenches)
        beyond_range, other_unit = self._limits.count_range_notices(arrivals.wrenches)
        self._note(Notice.BEYOND_RANGE, beyond_range)
        self._note(Notice.TORQUE_UNIT, other_unit)
        self._note(Notice.ANGLE_UNIT, count_angle_unit_notices(angles, self._limited))
        return PairedRun(len(arrivals.is_wrench), number[:out], stamp_ns[:out], raw[:out], joints)

    def forget_joints(self, detail: str) -> list[Rejected]:
        """Forget the joint samples, as of another joint vector; reject what waits for them.

        Args:
            detail: sentence for an operator.

        Returns:
            The wrenches that waited.

        """
        self._joints.clear()
        return self.reject_waiting(Rejection.NO_JOINTS, detail)

    @property
    def newest_wrench_ns(self) -> int | None:
        """The newest wrench's stamp."""
        return self._newest_wrench_ns

    # Inside

    def _angles(self, joints: Array) -> Array:
        """Angles (n, k) of joints (n, all or the k turning ones)."""
        return joints if joints.shape[1] == len(self._turning) else joints[:, self._turning]

    def _known_until_ns(self) -> int | None:
        """Return the newest stamp that need not wait; None: none yet."""
        joints_ns, awaited = self._joints.newest_ns, self._awaited
        if awaited is None or joints_ns is None:
            return joints_ns
        awaited_ns = awaited.known_until_ns
        return None if awaited_ns is None else min(joints_ns, awaited_ns)

    def _note(self, notice: Notice, count: int) -> None:
        if count:
            self.notices[notice] += count

    def _follow_wrench_stamps(self, stamp_ns: int) -> list[Rejected]:
        newest = self._newest_wrench_ns
        results: list[Rejected] = []
        if newest is not None:
            restarted = self._limits.restarted(self.wrench_topic, stamp_ns, newest)
            if restarted:
                results = self.restart(restarted)
            elif stamp_ns < newest:
                self.notices[Notice.OUT_OF_ORDER_WRENCH] += 1
                return results
        self._newest_wrench_ns = stamp_ns
        return results

    def _drop_hopeless(self) -> list[Rejected]:
        """Reject what waits once the joints have fallen too far behind, or too many wait."""
        newest_wrench = self._newest_wrench_ns
        newest_joints = self._joints.newest_ns
        assert newest_wrench is not None and self._waiting
        if newest_joints is None:
            # The first joint sample may still be on its way, but no longer than this.
            if newest_wrench - self._waiting[0].stamp_ns > self._limits.max_age_ns:
                return self.reject_waiting(
                    *self._joint_reason(Rejection.NO_JOINTS, "no joint_states were received")
                )
        elif newest_wrench - newest_joints > self._limits.max_age_ns:
            behind_ms = (newest_wrench - newest_joints) * 1e-6
            detail = (
                f"joint_states are stale: {behind_ms:.0f} ms behind {self.wrench_topic},"
                f" max_joint_age_s is {self.parameters.max_joint_age_s:g}"
                f"{self._clock_hint(newest_wrench - newest_joints)}"
            )
            return self.reject_waiting(*self._joint_reason(Rejection.STALE_JOINTS, detail))
        elif self._awaited is not None and (late := self._awaited.late(newest_wrench)):
            return self.reject_waiting(*late)
        if len(self._waiting) > self._limits.max_waiting:
            oldest = self._waiting.popleft()
            detail = f"more than {self._limits.max_waiting} wrenches wait for joint_states"
            return [self.reject(oldest.stamp_ns, Rejection.QUEUE_FULL, detail, oldest.number)]
        return []

    def _joint_reason(self, reason: Rejection, detail: str) -> tuple[Rejection, str]:
        """Return the deeper reason, when joint messages come but can't be used."""
        if self._joint_trouble is not None:
            return Rejection.BAD_JOINTS, self._joint_trouble
        return reason, detail

    def _clock_hint(self, difference_ns: int) -> str:
        if difference_ns < _OTHER_CLOCK_NS:
            return ""
        return f"; do joint_states and {self.wrench_topic} get their stamps from different clocks?"

    def _pair(self, stamp_ns: int, raw: Array, tag: object, number: int) -> Result:
        joints = self._joints.joints_at(stamp_ns)
        if isinstance(joints, str):
            if joints == NO_JOINTS_GAP:
                detail = (
                    "joint_states are stale: two samples more than"
                    f" {self.parameters.max_joint_age_s:g} s apart around a wrench"
                )
                reason = self._joint_reason(Rejection.STALE_JOINTS, detail)
                return self.reject(stamp_ns, *reason, number)
            newest = self._joints.newest_ns
            hint = "" if newest is None else self._clock_hint(newest - stamp_ns)
            detail = f"no joint angles: {joints}{hint}"
            return self.reject(stamp_ns, *self._joint_reason(Rejection.NO_JOINTS, detail), number)
        if math.isnan(joints[0]):
            jump = self._jump
            if jump is not None and abs(stamp_ns - jump[0]) <= self._limits.max_age_ns:
                return self.reject(stamp_ns, Rejection.JUMPING_JOINTS, jump[1], number)
            detail = "joint_states hold an angle that is not finite"
            return self.reject(stamp_ns, Rejection.NONFINITE_JOINTS, detail, number)
        return PairedWrench(stamp_ns, raw, joints, tag, number)

    def reject(self, stamp_ns: int, reason: Enum, detail: str, number: int) -> Rejected:
        """Count the rejection of one wrench.

        Args:
            stamp_ns: the wrench's stamp, ns; 0 without one.
            reason: under which it is counted.
            detail: sentence for an operator.
            number: of the wrench in the order of arrival, from 0.

        Returns:
            The rejection.

        """
        self.rejections[reason] += 1
        return Rejected(stamp_ns, reason, detail, number)

    def reject_waiting(self, reason: Enum, detail: str) -> list[Rejected]:
        """Reject the wrenches that wait.

        Args:
            reason: under which they are counted.
            detail: sentence for an operator.

        Returns:
            Their rejections, the oldest first.

        """
        results: list[Rejected] = [
            self.reject(waiting.stamp_ns, reason, detail, waiting.number)
            for waiting in self._waiting
        ]
        self._waiting.clear()
        return results
