# SPDX-License-Identifier: Apache-2.0
"""The compensator without ROS: joint and wrench samples go in, compensated wrenches come out.

    expected    = weight(angles) + pull of a cable   as the sensor reads them, in its own axes
    untared     = C (raw - expected) - inertial forces   C: undoes its gains and rotation
    compensated = untared - bias drift - tare

All but the weight is optional. A correction sees each sample once, in the order of its arrival, by
its stamp. Samples are pushed one by one or in blocks, which gives the same. Live node and offline
evaluation feed the same class. Which angles belong to a wrench, and which wrench is rejected, is
`galen_common.stream.pairing`'s.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from galen_bags.arrays.arm_recording import Samples
from galen_common.stream.pairing import WrenchPairing
from galen_common.stream.regular_run import Arrivals
from galen_common.stream.samples import PairedWrench, Rejected, Rejection, Result
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.calibrated.prediction import Prediction
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.verdict import Limits

from galen_gravcomp.block import BlockResult, push_block
from galen_gravcomp.calibration_monitor import CalibrationMonitor
from galen_gravcomp.corrections.bias_drift import BiasDrift
from galen_gravcomp.corrections.cable import CablePull
from galen_gravcomp.corrections.inertial import ImuMotion, InertialForces, JointMotion
from galen_gravcomp.corrections.tare import OnTared, TareRamp, TareWindow
from galen_gravcomp.parameters import GravcompParameters

_MOTIONS: dict[str, type[InertialForces]] = {"joints": JointMotion, "imu": ImuMotion}
_IMPOSSIBLE = (
    "inertial forces are not known: they come out beyond the sensor's range; does joint_states (or"
    " the IMU) jump, or come in another unit?"
)


class TareRejectedError(GalenError):
    """A tare can't start now; the message says why."""


class Compensator:
    """Streaming compensation of one sensor's wrench by one calibration file.

    Each wrench pushed ends compensated or as a `Rejected`. `pairing` decides which samples
    are taken, and counts.

    Not thread-safe: push everything from one thread.
    """

    def __init__(
        self,
        parameters: GravcompParameters | None = None,
        on_restart: Callable[[str], None] | None = None,
        *,
        arm: Arm,
    ) -> None:
        """`on_restart(why)` is called after everything was cleared because the driver restarted."""
        self.arm = arm
        self._parameters = p = parameters or GravcompParameters()
        self._sensor_range = np.array(p.sensor_range)
        self._on_restart = on_restart
        self.motion = _MOTIONS[p.motion](p, arm) if p.motion in _MOTIONS else None
        """Inertial forces, where the parameters ask for them."""
        self.bias_drift = BiasDrift(enabled=p.bias_drift, ramp_s=p.tare_ramp_s, arm=arm)
        limits = Limits(p.fit_limit_force_n, p.fit_limit_torque_nm)
        self.monitor = CalibrationMonitor(limits, arm=arm) if p.calibration_monitor else None
        """Checks whether the calibration file fits."""
        self.pairing = WrenchPairing(
            p, self._forget_driver, sensor_frame=arm.sensor_frame, awaited=self.motion, arm=arm
        )
        self.enabled = True
        self.tool: CalibrationFile | None = None
        """The active tool; `set_tool` changes it."""
        self._prediction: Prediction | None = None
        self.cable: CablePull | None = None
        """The cable that the tool's file describes."""
        self._no_tool_detail = "no tool is loaded"
        self._ramp = TareRamp(p.tare_ramp_s)
        self._window: TareWindow | None = None
        self._update_bar()
        self.compensated = 0
        self.pushed_as_arrays = 0
        """Samples of both topics that `push_block` did not have to push one by one."""

    # State

    @property
    def needs_positions(self) -> bool:
        """Whether `push_joints` must be given all joints, and not the angles alone."""
        return self.pairs_positions or (self.motion is not None and self.motion.needs_positions)

    @property
    def pairs_positions(self) -> bool:
        """Whether each wrench is paired with all joints, and not with the angles alone."""
        return self.cable is not None

    @property
    def needs_imu(self) -> bool:
        """Whether `push_imu` must be called."""
        return self.motion is not None and self.motion.needs_imu

    @property
    def tare_offset(self) -> Array:
        """Offset (6,) that the tare subtracts when its ramp has ended, N and N.m."""
        return self._ramp.target.copy()

    @property
    def bias_drift_offset(self) -> Array | None:
        """Offset (6,) that the bias drift's estimate subtracts now, N and N.m; None without one."""
        now_ns = self.pairing.newest_wrench_ns
        if not self.bias_drift.active or now_ns is None:
            return None
        return self.bias_drift.offset_at(now_ns)

    @property
    def taring(self) -> bool:
        """Whether a tare collects samples now."""
        return self._window is not None

    @property
    def tare_ramping(self) -> bool:
        """Whether a new tare is being applied now."""
        return self._ramp.ramping

    def set_enabled(self, enabled: bool) -> list[Result]:
        """Switch on or off; off rejects what waits, ends a running tare, keeps its offset.

        Args:
            enabled: whether wrenches are compensated.

        Returns:
            The wrenches rejected.

        """
        if enabled == self.enabled:
            return []
        self.enabled = enabled
        if not enabled:
            self.cancel_tare("compensation was switched off")
        return [*self._update_bar()]

    def set_tool(
        self, tool: CalibrationFile | None, why_none: str = "no tool is loaded"
    ) -> list[Result]:
        """Activate a tool, or none. The tare was measured with the old one, so it is dropped.

        Args:
            tool: its calibration; None: none, and every wrench is rejected.
            why_none: the reason without a tool, as rejections name it.

        Returns:
            The wrenches rejected: all that wait, where no tool follows or only one of both tools
            has a cable.

        """
        self.cancel_tare("the tool was changed")
        self._ramp.reset()
        self.tool = tool
        self._prediction = None if tool is None else Prediction(tool, self.arm)
        self._no_tool_detail = why_none
        results = self._set_cable(tool)
        if self.motion is not None:
            self.motion.set_tool(tool)
        self.bias_drift.clear()
        if self.monitor is not None:
            self.monitor.set_tool(tool)
        return [*results, *self._update_bar()]

    def rename_tool(self, name: str) -> None:
        """Call the active tool by another name; nothing else changes, the tare stays.

        Args:
            name: its new name.

        """
        assert self.tool is not None
        self.tool = replace(self.tool, tool=name)

    # Tare

    def start_tare(self, on_done: OnTared) -> None:
        """Average the compensated wrench from now on.

        Args:
            on_done: called once, with the answer and the offset.

        Raises:
            TareRejectedError: there is nothing to tare, or a tare is already running.

        """
        if not self.enabled:
            raise TareRejectedError("not tared: compensation is switched off")
        if self.tool is None:
            raise TareRejectedError(f"not tared: {self._no_tool_detail}")
        if self._window is not None:
            raise TareRejectedError("not tared: a tare is already running")
        self._window = TareWindow(
            self._parameters, self.pairing.newest_wrench_ns, on_done, self.arm.turning_names
        )

    def cancel_tare(self, why: str) -> None:
        """End a running tare without an effect.

        Args:
            why: the reason, for the tare's answer.

        """
        if self._window is not None:
            window, self._window = self._window, None
            window.finish(f"not tared: {why}", None)

    def set_bias_drift(self, enabled: bool) -> None:
        """Switch the bias drift's estimate on or off.

        Args:
            enabled: whether it is learned and subtracted.

        """
        before = self._settled_offset
        self.bias_drift.set_enabled(enabled)
        self._offset_changed(before)

    # Samples

    def push_joints(self, stamp_ns: int, joints: tuple[float, ...]) -> list[Result]:
        """Take a joint sample.

        Args:
            stamp_ns: its stamp.
            joints: the arm's (n,), m and rad, or its angles (k,) alone, which do where
                `needs_positions` is false.

        Returns:
            What became of the wrenches that waited for it.

        """
        if len(joints) < len(self.arm.joints) and self.needs_positions:
            unknown = np.full(len(self.arm.joints), np.nan)
            joints = tuple(self.arm.with_angles(joints, unknown).tolist())
        if self.motion is not None:
            self.motion.push_joints(stamp_ns, joints)
        paired = joints if self.pairs_positions else self.arm.angles_of(joints)
        results = self.pairing.push_joints(stamp_ns, paired)
        return self._made(results) if results else []

    def push_wrench(
        self,
        stamp_ns: int,
        wrench: Sequence[float] | Array,
        frame_id: str | None = None,
        tag: object = None,
    ) -> list[Result]:
        """Take a wrench as `WrenchPairing.push_wrench`.

        Args:
            stamp_ns: its stamp.
            wrench: (6,) raw, in the sensor's own axes, N and N.m.
            frame_id: the message's; None: not checked.
            tag: comes back with the compensated wrench.

        Returns:
            What became of it and of those that waited; empty while it waits for joints.

        """
        return self._made(self.pairing.push_wrench(stamp_ns, wrench, frame_id, tag))

    def push_block(self, is_wrench: np.ndarray, joints: Samples, wrenches: Samples) -> BlockResult:
        """Take many samples of both topics: the same as pushing one by one, only faster.

        Blocks may be of any size, and end anywhere; a wrench that waits at the end comes out with a
        later block.

        Args:
            is_wrench: (n,) bool of both topics' samples in the order of their arrival: whether the
                next one is a wrench.
            joints: values (j, n or more) in the arm's order, m and rad.
            wrenches: values (w, 6), N and N.m.

        Returns:
            What became of these wrenches, and of those that had waited before.

        Raises:
            ValueError: the counts don't fit, before anything was pushed.

        """
        return push_block(self, is_wrench, joints, wrenches, self._push_run)

    def push_imu(
        self, stamp_ns: int, angular_rad_s: Sequence[float], linear_m_s2: Sequence[float]
    ) -> list[Result]:
        """Take an IMU's reading.

        Args:
            stamp_ns: its stamp.
            angular_rad_s: (3,) angular velocity in the IMU's axes.
            linear_m_s2: (3,) specific force in the IMU's axes.

        Returns:
            What became of the wrenches that waited for it.

        """
        if self.motion is not None:
            self.motion.push_imu(stamp_ns, angular_rad_s, linear_m_s2)
        return self._made(self.pairing.release())

    # Inside

    def _made(self, results: list[PairedWrench | Rejected]) -> list[Result]:
        return [self._compensate(one) if isinstance(one, PairedWrench) else one for one in results]

    def _update_bar(self) -> list[Rejected]:
        """Have all wrenches rejected while it is off or without a tool."""
        if not self.enabled:
            return self.pairing.bar(Rejection.DISABLED, "compensation is switched off")
        if self.tool is None:
            return self.pairing.bar(Rejection.NO_TOOL, self._no_tool_detail)
        self.pairing.unbar()
        return []

    def _forget_driver(self, why: str) -> None:
        """Forget samples, bias drift and tare; tool, switch and counters stay."""
        self.cancel_tare(why)
        self._ramp.reset()
        if self.cable is not None:
            self.cable.forget()
        if self.motion is not None:
            self.motion.clear()
        self.bias_drift.clear()
        if self.monitor is not None:
            self.monitor.clear()
        if self._on_restart is not None:
            self._on_restart(why)

    def _set_cable(self, tool: CalibrationFile | None) -> list[Rejected]:
        """Take the cable of another tool, or none."""
        before = self.pairs_positions
        drag = None if tool is None else tool.cable
        self.cable = None if drag is None else CablePull(drag, self.arm)
        if self.pairs_positions == before:
            return []
        # The joints so far were kept as angles alone, or with others that no one needs now.
        return self.pairing.forget_joints("the tool was changed, and the joints are paired anew")

    @property
    def _settled_offset(self) -> Array:
        """What tare and drift subtract (6,) when no ramp runs."""
        return self._ramp.target + self.bias_drift.settled

    def _offset_changed(self, before: Array) -> None:
        if self.monitor is not None:
            self.monitor.offset_changed(self._settled_offset - before, self._ramp.target)

    def _end_tare(self, window: TareWindow, stamp_ns: int, angles: tuple[float, ...]) -> None:
        """Its offset holds what the bias drift subtracted: that goes as the tare comes."""
        self._window = None
        message, offset = window.evaluate()
        if offset is not None:
            before = self._settled_offset
            self._ramp.start(stamp_ns, offset)
            self.bias_drift.tared(stamp_ns, angles, offset)
            self._offset_changed(before)
        window.finish(message, offset)

    def _push_run(self, arrivals: Arrivals) -> tuple[int, BlockResult]:
        """Push the regular samples at the start of `arrivals`, none during a tare; how many."""
        prediction = self._prediction
        taring = self._window is not None or self._ramp.ramping
        if not self.enabled or prediction is None or taring or self._one_by_one:
            return 0, BlockResult.empty(len(self.arm.turning))
        paired = self.pairing.push_run(arrivals)
        self.compensated += len(paired.number)
        self.pushed_as_arrays += paired.taken
        angles = self.arm.angles(paired.joints) if self.pairs_positions else paired.joints
        pull = 0.0 if self.cable is None else self.cable.readings(paired.joints)
        wrench = prediction.compensate(paired.raw - pull, angles)
        wrench -= self._ramp.target
        return paired.taken, BlockResult(paired.number, paired.stamp_ns, wrench, angles)

    @property
    def _one_by_one(self) -> bool:
        """Whether samples have to be pushed one by one: a correction sees each, or rejected."""
        seen = self.motion is not None or self.bias_drift.active or self.monitor is not None
        return seen or self.pairing.distrusted

    def _compensate(self, paired: PairedWrench) -> Result:
        stamp_ns, raw, joints, tag, number = paired
        prediction, cable = self._prediction, self.cable
        # Only with a cable are all joints paired.
        angles = joints if cable is None else self.arm.angles_of(joints)
        assert prediction is not None
        expected = prediction.reading(angles)
        if cable is not None:
            expected = expected + cable.reading(joints)
        untared = prediction.wrench(raw - expected)
        if self.motion is not None:
            motion = self.motion.reading(stamp_ns, angles)
            if isinstance(motion, str):
                return self.pairing.reject(stamp_ns, Rejection.NO_MOTION, motion, number)
            # No reading can hold more than the sensor does, and NaN is no less.
            if not (np.abs(motion) <= self._sensor_range).all():
                return self.pairing.reject(stamp_ns, Rejection.NO_MOTION, _IMPOSSIBLE, number)
            untared = untared - motion
        compensated: Array = untared - self._ramp.offset_at(stamp_ns)
        # Where a cable's pull is not known, the residual is neither the sensor's nor the load's.
        known = cable is None or cable.weight == 1.0
        if known:
            self.bias_drift.push(stamp_ns, angles, untared)
        compensated = compensated - self.bias_drift.offset_at(stamp_ns)
        if self._window is not None and self._window.add(stamp_ns, angles, untared):
            self._end_tare(self._window, stamp_ns, angles)
        if self.monitor is not None and known:
            self.monitor.push(stamp_ns, angles, untared - self._settled_offset)
        self.compensated += 1
        return PairedWrench(stamp_ns, compensated, joints, tag, number)
