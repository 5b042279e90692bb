"""The compensator without ROS: joint and wrench samples go in, compensated wrenches come out.

    compensated = C (raw - expected reading of the tool at the joint angles of the raw stamp) - tare

The other parts of the expected reading, C, and what else is subtracted:
`galen_gravcomp.corrections.stages`. Samples are pushed in the order of their arrival, one by
one or in blocks, which gives the same. Live node and offline evaluation feed the same class. Which
angles belong to a wrench, and which wrench is rejected, is `galen_ros.stream.pairing`'s.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from galen_bags.arrays.messages import Samples
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.prediction import Prediction
from galen_ros.stream.pairing import PairedWrench, WrenchPairing
from galen_ros.stream.regular_run import Arrivals
from galen_ros.stream.results import Compensated, Rejected, Rejection, Result

from galen_gravcomp.block import NOTHING, BlockResult, Outputs, push_block
from galen_gravcomp.calibration_monitor.monitor import CalibrationMonitor
from galen_gravcomp.corrections.bias_drift import BiasDrift
from galen_gravcomp.corrections.cable import CablePull
from galen_gravcomp.corrections.imu_motion import ImuMotion
from galen_gravcomp.corrections.joint_motion import JointMotion
from galen_gravcomp.corrections.motion_window import NoMotion
from galen_gravcomp.corrections.stages import Stages
from galen_gravcomp.corrections.tare import TareOutcome, TareRamp, TareWindow
from galen_gravcomp.parameters import GravcompParameters

_IMPOSSIBLE = (
    "inertial forces are not known: they come out beyond the sensor's range; does joint_states (or"
    " the IMU) jump, or come in another unit?"
)


class TareRejectedError(GalenError):
    """A tare can't start now; the message says why."""


class Compensator:
    """Streaming compensation of one sensor's wrench by one calibration file.

    Each wrench pushed ends as a `Compensated` or as a `Rejected`. `pairing` decides which samples
    are taken, and counts.

    Not thread-safe: push everything from one thread.
    """

    def __init__(
        self,
        parameters: GravcompParameters | None = None,
        on_restart: Callable[[str], None] | None = None,
        stages: Stages | None = None,
    ) -> None:
        """`on_restart(why)` is called after everything was cleared because the driver restarted."""
        self._stages = stages or Stages()
        self._parameters = parameters or GravcompParameters()
        self._sensor_range = np.array(self._parameters.sensor_range)
        self._on_restart = on_restart
        self.pairing = WrenchPairing(
            self._parameters, self._forget_driver, awaited=self._stages.motion
        )
        self._enabled = True
        self._tool: CalibrationFile | None = None
        self._prediction: Prediction | None = None
        self._cable: CablePull | None = None
        self._no_tool_detail = "no tool is loaded"
        self._ramp = TareRamp(self._parameters.tare_ramp_s)
        self._window: TareWindow | None = None
        self._update_bar()
        self.compensated = 0
        self.pushed_as_arrays = 0
        """Samples of both topics that `push_block` did not have to push one by one."""

    # State

    @property
    def enabled(self) -> bool:
        """Whether wrenches are compensated at all."""
        return self._enabled

    @property
    def tool(self) -> CalibrationFile | None:
        """The active tool."""
        return self._tool

    @property
    def motion(self) -> JointMotion | ImuMotion | None:
        """The stage of the inertial forces."""
        return self._stages.motion

    @property
    def bias_drift(self) -> BiasDrift | None:
        """The stage of the sensor's bias drift."""
        return self._stages.bias_drift

    @property
    def fit(self) -> CalibrationMonitor | None:
        """The watch on whether the file fits."""
        return self._stages.fit

    @property
    def cable(self) -> CablePull | None:
        """The pull of the cable that the tool's file tells of."""
        return self._cable

    @property
    def needs_positions(self) -> bool:
        """Whether `push_joints` must be given the platform's position."""
        motion = self._stages.motion
        return self.pairs_positions or (motion is not None and motion.needs_positions)

    @property
    def pairs_positions(self) -> bool:
        """Whether each wrench is paired with the platform's position as well."""
        return self._cable is not None

    @property
    def needs_imu(self) -> bool:
        """Whether `push_imu` must be called."""
        motion = self._stages.motion
        return motion is not None and motion.needs_imu

    @property
    def tare_offset(self) -> Array:
        """Offset (6,) that the tare subtracts when its ramp has ended, N and N.m."""
        return self._ramp.target.copy()

    @property
    def bias_drift_offset(self) -> Array | None:
        """Offset (6,) that the bias drift's estimate subtracts now, N and N.m; None without one."""
        bias_drift, now_ns = self._stages.bias_drift, self.pairing.newest_wrench_ns
        if bias_drift is None or not bias_drift.active or now_ns is None:
            return None
        return bias_drift.offset_at(now_ns)

    @property
    def taring(self) -> bool:
        """Whether a tare collects samples now."""
        return self._window is not None

    @property
    def tare_ramping(self) -> bool:
        """Whether a new tare is being applied now."""
        return self._ramp.ramping

    def set_enabled(self, enabled: bool) -> list[Result]:
        """Switch on or off; off rejects what waits, ends a running tare, keeps its offset."""
        if enabled == self._enabled:
            return []
        self._enabled = enabled
        if not enabled:
            self.cancel_tare("compensation was switched off")
        return [*self._update_bar()]

    def set_tool(
        self, tool: CalibrationFile | None, why_none: str = "no tool is loaded"
    ) -> list[Result]:
        """Activate a tool, or none. The tare was measured with the old one, so it is dropped.

        `why_none` says why there is no tool.
        """
        self.cancel_tare("the tool was changed")
        self._ramp.reset()
        self._tool = tool
        self._prediction = None if tool is None else Prediction(tool)
        self._no_tool_detail = why_none
        own_frame = "" if tool is None else tool.sensor_frame
        self.pairing.sensor_frame = self._parameters.sensor_frame or own_frame
        results = self._set_cable(tool)
        if self._stages.motion is not None:
            self._stages.motion.set_tool(tool)
        if self._stages.bias_drift is not None:
            self._stages.bias_drift.clear("the tool was changed")
        if self._stages.fit is not None:
            self._stages.fit.set_tool(tool)
        return [*results, *self._update_bar()]

    def rename_tool(self, name: str) -> None:
        """Call the active tool by another name; nothing else changes, the tare stays."""
        assert self._tool is not None
        self._tool = replace(self._tool, tool=name)

    # Tare

    def start_tare(self, on_done: Callable[[TareOutcome], None]) -> None:
        """Average the compensated wrench from now on; `on_done` gets the outcome, once.

        Raises TareRejectedError when there is nothing to tare.
        """
        if not self._enabled:
            raise TareRejectedError("not tared: compensation is switched off")
        if self._tool is None:
            raise TareRejectedError(f"not tared: {self._no_tool_detail}")
        if self._window is not None:
            raise TareRejectedError("not tared: a tare is already running")
        self._window = TareWindow(self._parameters, self.pairing.newest_wrench_ns, on_done)

    def cancel_tare(self, why: str) -> None:
        """End a running tare without an effect."""
        if self._window is not None:
            window, self._window = self._window, None
            window.finish(TareOutcome(False, f"not tared: {why}"))

    def set_bias_drift(self, enabled: bool) -> None:
        """Switch the bias drift's estimate on or off, where there is one."""
        if self._stages.bias_drift is not None:
            before = self._settled_offset
            self._stages.bias_drift.set_enabled(enabled)
            self._offset_changed(before)

    # Samples

    def push_joints(
        self,
        stamp_ns: int,
        roll_rad: float,
        tilt_rad: float,
        position_m: tuple[float, ...] | None = None,
    ) -> list[Result]:
        """Take a joint sample; returns what became of the wrenches that waited for it.

        position_m: the platform's (3,) in base_link, where `needs_positions`.
        """
        if self._stages.motion is not None:
            self._stages.motion.push_joints(stamp_ns, roll_rad, tilt_rad, position_m)
        if self._cable is None:
            results = self.pairing.push_joints(stamp_ns, (roll_rad, tilt_rad))
        else:
            platform = (math.nan,) * 3 if position_m is None else position_m
            results = self.pairing.push_joints(stamp_ns, (*platform, roll_rad, tilt_rad))
        return self._made(results) if results else []

    def push_wrench(
        self,
        stamp_ns: int,
        wrench: Sequence[float] | Array,
        frame_id: str | None = None,
        tag: object = None,
    ) -> list[Result]:
        """Take a wrench as `WrenchPairing.push_wrench`; returns what became of those answered."""
        return self._made(self.pairing.push_wrench(stamp_ns, wrench, frame_id, tag))

    def push_block(self, is_wrench: np.ndarray, joints: Samples, wrenches: Samples) -> BlockResult:
        """Take many samples of both topics: the same as pushing one by one, only faster.

        The arguments are those of `galen_gravcomp.block.push_block`. Blocks may be of any size, and
        end anywhere; a wrench that waits at the end comes out with a later block.
        """
        return push_block(self, is_wrench, joints, wrenches, self._push_run)

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> list[Result]:
        """Take an IMU's reading (3,), (3,) in its axes; returns what became of what waited."""
        motion = self._stages.motion
        if motion is not None:
            motion.push_imu(stamp_ns, angular_rad_s, linear_m_s2)
        return self._made(self.pairing.release())

    # Inside

    def _made(self, results: list[PairedWrench | Rejected]) -> list[Result]:
        made: list[Result] = []
        for one in results:
            made.append(self._compensate(one) if isinstance(one, PairedWrench) else one)
        return made

    def _update_bar(self) -> list[Rejected]:
        """Have all wrenches rejected while it is off or without a tool."""
        if not self._enabled:
            return self.pairing.bar(Rejection.DISABLED, "compensation is switched off")
        if self._tool is None:
            return self.pairing.bar(Rejection.NO_TOOL, self._no_tool_detail)
        self.pairing.unbar()
        return []

    def _forget_driver(self, why: str) -> None:
        """Forget everything that belongs to the driver's life so far: bias drift and tare, too.

        Tool, switch and counters stay.
        """
        self.cancel_tare(why)
        self._ramp.reset()
        if self._cable is not None:
            self._cable.forget()
        if self._stages.motion is not None:
            self._stages.motion.clear()
        if self._stages.bias_drift is not None:
            self._stages.bias_drift.clear(why)
        if self._stages.fit is not None:
            self._stages.fit.clear(why)
        if self._on_restart is not None:
            self._on_restart(why)

    def _set_cable(self, tool: CalibrationFile | None) -> list[Rejected]:
        """Take the cable of another tool, or none."""
        before = self.pairs_positions
        drag = None if tool is None else tool.cable
        self._cable = None if drag is None else CablePull(drag)
        if self.pairs_positions == before:
            return []
        # The joints so far were kept without the platform's position, or with one too many.
        return self.pairing.forget_joints("the tool was changed, and the joints are paired anew")

    @property
    def _settled_offset(self) -> Array:
        """What tare and drift subtract (6,) when no ramp runs."""
        bias_drift = self._stages.bias_drift
        return self._ramp.target if bias_drift is None else self._ramp.target + bias_drift.settled

    def _offset_changed(self, before: Array) -> None:
        if self._stages.fit is not None:
            self._stages.fit.offset_changed(self._settled_offset - before)

    def _end_tare(self, window: TareWindow, stamp_ns: int, roll: float, tilt: float) -> None:
        """Its offset holds what the bias drift subtracted: that goes as the tare comes."""
        self._window = None
        outcome = window.evaluate()
        if outcome.offset is not None:
            before = self._settled_offset
            self._ramp.start(stamp_ns, outcome.offset)
            if self._stages.bias_drift is not None:
                self._stages.bias_drift.tared(stamp_ns, roll, tilt, outcome.offset)
            self._offset_changed(before)
        window.finish(outcome)

    def _push_run(self, arrivals: Arrivals) -> Outputs:
        """Push the regular samples at the start of `arrivals`, none while there is a tare to do."""
        prediction = self._prediction
        taring = self._window is not None or self._ramp.ramping
        if not self._enabled or prediction is None or taring or self._one_by_one:
            return NOTHING
        paired = self.pairing.push_run(arrivals)
        self.compensated += len(paired.number)
        self.pushed_as_arrays += paired.taken
        angles = paired.joints[:, -2:]
        pull = 0.0 if self._cable is None else self._cable.readings(paired.joints)
        wrench = prediction.compensate(paired.raw - pull, angles[:, 0], angles[:, 1])
        wrench -= self._ramp.target
        return Outputs(paired.taken, paired.number, paired.stamp_ns, wrench, angles)

    @property
    def _one_by_one(self) -> bool:
        """Whether samples have to be pushed one by one: a stage sees each, or rejected."""
        stages = self._stages
        bias_drift = stages.bias_drift is not None and stages.bias_drift.active
        seen = stages.motion is not None or bias_drift or stages.fit is not None
        return seen or self.pairing.distrusted

    def _compensate(self, paired: PairedWrench) -> Result:
        stamp_ns, raw, joints, tag, number = paired
        roll, tilt = joints[-2:]
        stages, prediction = self._stages, self._prediction
        assert prediction is not None
        expected = prediction.reading(roll, tilt)
        if self._cable is not None:
            expected = expected + self._cable.reading(joints)
        untared = prediction.wrench(raw - expected)
        if stages.motion is not None:
            motion = stages.motion.reading(stamp_ns, roll, tilt)
            if isinstance(motion, NoMotion):
                return self.pairing.reject(stamp_ns, motion.reason, motion.detail, number)
            # No reading can hold more than the sensor does, and NaN is no less.
            if not (np.abs(motion) <= self._sensor_range).all():
                return self.pairing.reject(stamp_ns, Rejection.NO_MOTION, _IMPOSSIBLE, number)
            untared = untared - motion
        compensated: Array = untared - self._ramp.offset_at(stamp_ns)
        # Where a cable's pull is not known, what is left is neither the sensor's nor the load's.
        known = self._cable is None or self._cable.weight == 1.0
        if stages.bias_drift is not None:
            if known:
                stages.bias_drift.push(stamp_ns, roll, tilt, untared)
            compensated = compensated - stages.bias_drift.offset_at(stamp_ns)
        if self._window is not None and self._window.add(stamp_ns, roll, tilt, untared):
            self._end_tare(self._window, stamp_ns, roll, tilt)
        if stages.fit is not None and known:
            stages.fit.push(stamp_ns, roll, tilt, untared - self._settled_offset)
        self.compensated += 1
        return Compensated(stamp_ns, compensated, tag, number, (roll, tilt))
