"""The compensator without ROS: joint and wrench samples go in, compensated wrenches come out.

    compensated = raw - expected reading of the tool at the joint angles of the raw stamp - tare

Samples are pushed in the order of their arrival, one by one or in blocks, which gives the same;
every decision is made on stamps. Live node and offline evaluation feed the same class. Each wrench
pushed ends in exactly one way: as a `Compensated` result, or as a `Refused` one that names the
reason.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.tool_file import ToolFile

from galen_gravcomp.block import NOTHING, BlockResult, Outputs, SampleBlock, push_block
from galen_gravcomp.joint_buffer import JointBuffer, JointPush, NoAngles
from galen_gravcomp.prediction import Prediction
from galen_gravcomp.results import Compensated, Notice, Refusal, Refused, Result
from galen_gravcomp.sample_limits import SampleLimits, angle_unit_notice, count_angle_unit_notices
from galen_gravcomp.stretch import Arrivals, regular_stretch
from galen_gravcomp.tare import TareOutcome, TareRamp, TareSettings, TareWindow


class TareRefusedError(GalenError):
    """A tare can't start now; the message says why."""


def _sensor_range() -> Array:
    return np.array([125.0, 125.0, 500.0, 3.0, 3.0, 3.0])


@dataclass(frozen=True)
class CompensatorSettings:
    """Limits of the compensator; times in s by the samples' stamps, range (6,) in N and N.m."""

    max_joint_age_s: float = 0.05
    restart_gap_s: float = 1.0
    max_waiting: int = 1000
    sensor_frame: str = ""  # empty: as the tool's file says
    sensor_range: Array = field(default_factory=_sensor_range)
    tare: TareSettings = field(default_factory=TareSettings)


# Samples of one driver never lie this far apart; two clocks do.
_OTHER_CLOCK_NS = 5_000_000_000


class _Waiting(NamedTuple):
    """A wrench that waits for joint samples, as `_compensate` takes it."""

    stamp_ns: int
    raw: Array
    tag: object
    number: int


def _clock_hint(difference_ns: int) -> str:
    if difference_ns < _OTHER_CLOCK_NS:
        return ""
    return "; do joint_states and wrench_raw get their stamps from different clocks?"


class Compensator:
    """Streaming compensation of one sensor's wrench by one tool's file.

    Not thread-safe: push everything from one thread.
    """

    def __init__(
        self,
        settings: CompensatorSettings | None = None,
        on_restart: Callable[[str], None] | None = None,
    ) -> None:
        """`on_restart(why)` is called after everything was cleared because the driver restarted."""
        self._settings = settings or CompensatorSettings()
        self._on_restart = on_restart
        self._limits = SampleLimits(
            max_age_ns=round(self._settings.max_joint_age_s * 1e9),
            restart_gap_ns=round(self._settings.restart_gap_s * 1e9),
            max_waiting=self._settings.max_waiting,
            sensor_range=tuple(float(limit) for limit in self._settings.sensor_range),
        )
        self._joints = JointBuffer(self._limits.max_age_ns)
        self._waiting: deque[_Waiting] = deque()
        self._newest_wrench_ns: int | None = None
        self._joint_trouble: str | None = None
        self._enabled = True
        self._tool: ToolFile | None = None
        self._prediction: Prediction | None = None
        self._no_tool_detail = "no tool is loaded"
        self._ramp = TareRamp(self._settings.tare.ramp_s)
        self._window: TareWindow | None = None
        self.received = 0
        self.compensated = 0
        self.refusals: Counter[Refusal] = Counter()
        self.notices: Counter[Notice] = Counter()
        self.pushed_as_arrays = 0
        """Samples of both topics that `push_block` did not have to push one by one."""

    # State

    @property
    def settings(self) -> CompensatorSettings:
        """The limits in force."""
        return self._settings

    @property
    def enabled(self) -> bool:
        """Whether wrenches are compensated at all."""
        return self._enabled

    @property
    def tool(self) -> ToolFile | None:
        """The tool in force."""
        return self._tool

    @property
    def sensor_frame(self) -> str:
        """The frame_id that a wrench must have; empty while neither tool nor settings name one."""
        if self._settings.sensor_frame or self._tool is None:
            return self._settings.sensor_frame
        return self._tool.sensor_frame

    @property
    def waiting(self) -> int:
        """Wrenches that wait for joint samples."""
        return len(self._waiting)

    @property
    def tare_offset(self) -> Array:
        """Offset (6,) that the tare takes off when its ramp has ended, N and N.m."""
        return self._ramp.target.copy()

    @property
    def taring(self) -> bool:
        """Whether a tare collects samples now."""
        return self._window is not None

    @property
    def tare_ramping(self) -> bool:
        """Whether a new tare is being applied now."""
        return self._ramp.ramping

    def set_enabled(self, enabled: bool) -> list[Result]:
        """Switch on or off; off refuses what waits, ends a running tare, keeps its offset."""
        if enabled == self._enabled:
            return []
        self._enabled = enabled
        if enabled:
            return []
        self.cancel_tare("compensation was switched off")
        return self._refuse_waiting(Refusal.DISABLED, "compensation is switched off")

    def set_tool(self, tool: ToolFile | None, why_none: str = "no tool is loaded") -> list[Result]:
        """Put a tool in force, or none. The tare was measured with the old one, so it is dropped.

        `why_none` says why there is no tool.
        """
        self.cancel_tare("the tool was changed")
        self._ramp.reset()
        self._tool = tool
        self._prediction = None if tool is None else Prediction(tool)
        self._no_tool_detail = why_none
        if tool is None:
            return self._refuse_waiting(Refusal.NO_TOOL, why_none)
        return []

    def restart(self, why: str) -> list[Result]:
        """Forget everything that belongs to the driver's life so far: samples and tare.

        Tool, switch and counters stay.
        """
        results = self._refuse_waiting(Refusal.RESTART, why)
        self.cancel_tare(why)
        self._ramp.reset()
        self._joints.clear()
        self._newest_wrench_ns = None
        self._joint_trouble = None
        self.notices[Notice.RESTART] += 1
        if self._on_restart is not None:
            self._on_restart(why)
        return results

    # Tare

    def start_tare(self, on_done: Callable[[TareOutcome], None]) -> None:
        """Average the compensated wrench from now on; `on_done` gets the outcome, once.

        Raises TareRefusedError when there is nothing to tare.
        """
        if not self._enabled:
            raise TareRefusedError("not tared: compensation is switched off")
        if self._tool is None:
            raise TareRefusedError(f"not tared: {self._no_tool_detail}")
        if self._window is not None:
            raise TareRefusedError("not tared: a tare is already running")
        self._window = TareWindow(self._settings.tare, self._newest_wrench_ns, on_done)

    def cancel_tare(self, why: str) -> None:
        """End a running tare without an effect."""
        if self._window is not None:
            window, self._window = self._window, None
            window.finish(TareOutcome(False, f"not tared: {why}"))

    # Samples

    def push_joints(self, stamp_ns: int, roll_rad: float, tilt_rad: float) -> list[Result]:
        """Take a joint sample; returns what became of the wrenches that waited for it."""
        results: list[Result] = []
        newest = self._joints.newest_ns
        if newest is not None:
            restarted = self._limits.restarted("joint_states", stamp_ns, newest)
            if restarted:
                results = self.restart(restarted)
        self._joint_trouble = None
        if not (math.isfinite(roll_rad) and math.isfinite(tilt_rad)):
            self.notices[Notice.NONFINITE_JOINTS] += 1
            roll_rad = tilt_rad = math.nan
        elif angle_unit_notice(roll_rad, tilt_rad):
            self.notices[Notice.ANGLE_UNIT] += 1
        pushed = self._joints.push(stamp_ns, roll_rad, tilt_rad)
        if pushed is not JointPush.STORED:
            duplicate = pushed is JointPush.DUPLICATE
            self.notices[Notice.DUPLICATE_JOINTS if duplicate else Notice.OUT_OF_ORDER_JOINTS] += 1
            return results
        while self._waiting and self._waiting[0].stamp_ns <= stamp_ns:
            results.append(self._compensate(*self._waiting.popleft()))
        return results

    def push_bad_joints(self, detail: str) -> None:
        """Take note of a joint message that can't be used; `detail` says why."""
        self.notices[Notice.BAD_JOINTS] += 1
        self._joint_trouble = detail

    def push_wrench(
        self,
        stamp_ns: int,
        wrench: Sequence[float] | Array,
        frame_id: str | None = None,
        tag: object = None,
    ) -> list[Result]:
        """Take a wrench (6,), N and N.m; returns what became of it and of those that waited.

        The list is empty while the wrench waits for joint samples. `frame_id` None is not checked;
        `tag` comes back with the compensated wrench.
        """
        number = self.received
        self.received += 1
        if frame_id is not None and self._prediction is not None and self._enabled:
            expected = self.sensor_frame
            if frame_id != expected:
                detail = f"wrench_raw has frame_id '{frame_id}', expected '{expected}'"
                return [self._refuse(stamp_ns, Refusal.WRONG_FRAME, detail, number)]
        if stamp_ns <= 0:
            detail = "wrench_raw has no stamp (zero): the driver does not stamp its samples"
            return [self._refuse(stamp_ns, Refusal.UNSTAMPED, detail, number)]
        if stamp_ns == self._newest_wrench_ns:
            detail = "wrench_raw repeats a stamp; only the first wrench of a stamp is used"
            return [self._refuse(stamp_ns, Refusal.DUPLICATE, detail, number)]
        results = self._follow_wrench_stamps(stamp_ns)
        if not self._enabled:
            detail = "compensation is switched off"
            results.append(self._refuse(stamp_ns, Refusal.DISABLED, detail, number))
            return results
        if self._prediction is None:
            results.append(self._refuse(stamp_ns, Refusal.NO_TOOL, self._no_tool_detail, number))
            return results
        values = tuple(map(float, wrench))
        # One sum finds a NaN or an infinity among the six; it overflows only beyond any wrench.
        if not math.isfinite(sum(values)):
            shown = ", ".join(f"{value:g}" for value in values)
            detail = f"wrench_raw holds a value that is not finite: ({shown})"
            results.append(self._refuse(stamp_ns, Refusal.NONFINITE_WRENCH, detail, number))
            return results
        beyond_range, other_unit = self._limits.range_notices(values)
        if beyond_range:
            self.notices[Notice.BEYOND_RANGE] += 1
        if other_unit:
            self.notices[Notice.TORQUE_UNIT] += 1
        raw = np.array(values)
        newest = self._joints.newest_ns
        if newest is not None and stamp_ns <= newest:
            results.append(self._compensate(stamp_ns, raw, tag, number))
            return results
        self._waiting.append(_Waiting(stamp_ns, raw, tag, number))
        results.extend(self._drop_hopeless())
        return results

    def push_bad_wrench(self, detail: str) -> list[Result]:
        """Refuse a wrench message that can't be read, and so has no stamp; `detail` says why."""
        self.received += 1
        return [self._refuse(0, Refusal.UNREADABLE, detail, self.received - 1)]

    def push_block(
        self,
        is_wrench: np.ndarray,
        joint_stamp_ns: np.ndarray,
        angles: Array,
        wrench_stamp_ns: np.ndarray,
        wrenches: Array,
        *,
        frame: np.ndarray | None = None,
        frame_ids: Sequence[str] = (),
        bad_joints: Mapping[int, str] | None = None,
        bad_wrenches: Mapping[int, str] | None = None,
    ) -> BlockResult:
        """Take many samples of both topics: the same as pushing one by one, only faster.

        The arguments are `SampleBlock`'s. Blocks may be of any size, and end anywhere; a wrench
        that waits at the end comes out with a later block. Raises ValueError for shapes that don't
        fit, before anything was pushed.
        """
        block = SampleBlock(
            is_wrench,
            joint_stamp_ns,
            angles,
            wrench_stamp_ns,
            wrenches,
            frame,
            frame_ids,
            bad_joints or {},
            bad_wrenches or {},
        )
        return push_block(block, self, self._push_stretch)

    # Inside

    def _push_stretch(self, arrivals: Arrivals) -> Outputs:
        """Push the regular samples at the start of `arrivals`, none while there is a tare to do."""
        prediction, waiting = self._prediction, self._waiting
        taring = self._window is not None or self._ramp.ramping
        if not self._enabled or prediction is None or taring:
            return NOTHING
        waiting_ns = np.array([one.stamp_ns for one in waiting], dtype=np.int64)
        stretch = regular_stretch(
            arrivals, waiting_ns, self._newest_wrench_ns, self._joints, self._limits
        )
        arrivals, angles = stretch.arrivals, stretch.angles
        out, waited = len(angles), len(waiting)
        stamp_ns = np.concatenate((waiting_ns, arrivals.wrench_stamp_ns))
        raw = np.concatenate((np.reshape([one.raw for one in waiting], (-1, 6)), arrivals.wrenches))
        arrived = self.received + np.arange(len(arrivals.wrenches))
        number = np.concatenate(([one.number for one in waiting], arrived)).astype(np.int64)

        for _ in range(min(out, waited)):
            waiting.popleft()
        for row in range(max(out, waited), len(stamp_ns)):
            waiting.append(_Waiting(int(stamp_ns[row]), raw[row].copy(), None, int(number[row])))
        self._joints.push_regular(arrivals.joint_stamp_ns, arrivals.angles)
        if len(arrivals.joint_stamp_ns):
            self._joint_trouble = None
        if len(arrivals.wrench_stamp_ns):
            self._newest_wrench_ns = int(arrivals.wrench_stamp_ns[-1])
        self.received += len(arrivals.wrenches)
        self.compensated += out
        self.pushed_as_arrays += len(arrivals.is_wrench)
        beyond_range, other_unit = self._limits.count_range_notices(arrivals.wrenches)
        self._note(Notice.BEYOND_RANGE, beyond_range)
        self._note(Notice.TORQUE_UNIT, other_unit)
        self._note(Notice.ANGLE_UNIT, count_angle_unit_notices(arrivals.angles))
        wrench = raw[:out] - prediction.readings(angles[:, 0], angles[:, 1]) - self._ramp.target
        return Outputs(len(arrivals.is_wrench), number[:out], stamp_ns[:out], wrench, angles)

    def _note(self, notice: Notice, count: int) -> None:
        if count:
            self.notices[notice] += count

    def _follow_wrench_stamps(self, stamp_ns: int) -> list[Result]:
        """Compare with the newest stamp: restart, out of order."""
        newest = self._newest_wrench_ns
        results: list[Result] = []
        if newest is not None:
            restarted = self._limits.restarted("wrench_raw", stamp_ns, newest)
            if restarted:
                results = self.restart(restarted)
            elif stamp_ns < newest:
                self.notices[Notice.OUT_OF_ORDER_WRENCH] += 1
                return results
        self._newest_wrench_ns = stamp_ns
        return results

    def _drop_hopeless(self) -> list[Result]:
        """Refuse what waits once the joints have fallen too far behind, or too many wait."""
        newest_wrench = self._newest_wrench_ns
        newest_joints = self._joints.newest_ns
        assert newest_wrench is not None and self._waiting
        if newest_joints is None:
            # The first joint sample may still be on its way, but no longer than this.
            if newest_wrench - self._waiting[0].stamp_ns > self._limits.max_age_ns:
                return self._refuse_waiting(
                    *self._joint_reason(Refusal.NO_JOINTS, "no joint_states were received")
                )
        elif newest_wrench - newest_joints > self._limits.max_age_ns:
            behind_ms = (newest_wrench - newest_joints) * 1e-6
            detail = (
                f"joint_states are stale: {behind_ms:.0f} ms behind wrench_raw,"
                f" max_joint_age_s is {self._settings.max_joint_age_s:g}"
                f"{_clock_hint(newest_wrench - newest_joints)}"
            )
            return self._refuse_waiting(*self._joint_reason(Refusal.STALE_JOINTS, detail))
        if len(self._waiting) > self._limits.max_waiting:
            oldest = self._waiting.popleft()
            detail = f"more than {self._limits.max_waiting} wrenches wait for joint_states"
            return [self._refuse(oldest.stamp_ns, Refusal.QUEUE_FULL, detail, oldest.number)]
        return []

    def _joint_reason(self, reason: Refusal, detail: str) -> tuple[Refusal, str]:
        """The deeper reason, when joint messages do come but can't be used."""
        if self._joint_trouble is not None:
            return Refusal.BAD_JOINTS, self._joint_trouble
        return reason, detail

    def _compensate(self, stamp_ns: int, raw: Array, tag: object, number: int) -> Result:
        """Compensate a wrench whose joints are in the buffer."""
        angles = self._joints.angles_at(stamp_ns)
        if isinstance(angles, NoAngles):
            if angles is NoAngles.GAP:
                detail = (
                    "joint_states are stale: two samples more than"
                    f" {self._settings.max_joint_age_s:g} s apart around a wrench"
                )
                reason = self._joint_reason(Refusal.STALE_JOINTS, detail)
                return self._refuse(stamp_ns, *reason, number)
            newest = self._joints.newest_ns
            hint = "" if newest is None else _clock_hint(newest - stamp_ns)
            detail = f"no joint angles: {angles.value}{hint}"
            return self._refuse(stamp_ns, *self._joint_reason(Refusal.NO_JOINTS, detail), number)
        roll, tilt = angles
        if math.isnan(roll) or math.isnan(tilt):
            detail = "joint_states hold an angle that is not finite"
            return self._refuse(stamp_ns, Refusal.NONFINITE_JOINTS, detail, number)
        assert self._prediction is not None
        untared: Array = raw - self._prediction.reading(roll, tilt)
        compensated: Array = untared - self._ramp.offset_at(stamp_ns)
        if self._window is not None and self._window.add(stamp_ns, roll, tilt, untared):
            window, self._window = self._window, None
            outcome = window.evaluate()
            if outcome.offset is not None:
                self._ramp.start(stamp_ns, outcome.offset)
            window.finish(outcome)
        self.compensated += 1
        return Compensated(stamp_ns, compensated, tag, number, angles)

    def _refuse(self, stamp_ns: int, reason: Refusal, detail: str, number: int) -> Refused:
        self.refusals[reason] += 1
        return Refused(stamp_ns, reason, detail, number)

    def _refuse_waiting(self, reason: Refusal, detail: str) -> list[Result]:
        results: list[Result] = [
            self._refuse(waiting.stamp_ns, reason, detail, waiting.number)
            for waiting in self._waiting
        ]
        self._waiting.clear()
        return results
