# SPDX-License-Identifier: Apache-2.0
"""Tare: the residual wrench, averaged at rest and subtracted along a ramp."""

from collections.abc import Callable, Sequence

import numpy as np
from galen_model.arrays import Array

from galen_gravcomp.parameters import GravcompParameters

MIN_SAMPLES = 10
# An arm at rest moves less, and a sensor's noise is 15 to 50 times smaller.
MAX_MOTION_RAD = 0.001
MAX_STD_FORCE_N = 0.3
MAX_STD_TORQUE_NM = 0.02


OnTared = Callable[[str, Array | None], None]
"""Gets the answer to a tare request, and the offset (6,), N and N.m, None if it is rejected."""


class TareWindow:
    """Collects samples from a request on, until they span `window_s` by their stamps."""

    def __init__(
        self,
        parameters: GravcompParameters,
        after_ns: int | None,
        on_done: OnTared,
        angle_names: Sequence[str],
    ) -> None:
        """Take only samples stamped later than `after_ns` (None: any)."""
        self._parameters = parameters
        self._after_ns = after_ns
        self.finish = on_done
        """Answers the request."""
        self._angle_names = angle_names
        self._stamps: list[int] = []
        self._angles: list[tuple[float, ...]] = []
        self._wrenches: list[Array] = []

    def add(self, stamp_ns: int, angles: tuple[float, ...], untared: Array) -> bool:
        """Take a sample; one that is not later than the one before is left out.

        Args:
            stamp_ns: the wrench's stamp.
            angles: (k,) at that stamp, rad.
            untared: (6,) wrench without weight, before tare and bias drift, N and N.m.

        Returns:
            Whether the window is full.

        """
        if self._after_ns is not None and stamp_ns <= self._after_ns:
            return False
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return False
        self._stamps.append(stamp_ns)
        self._angles.append(angles)
        self._wrenches.append(untared)
        return stamp_ns - self._stamps[0] >= self._parameters.tare_window_s * 1e9

    def evaluate(self) -> tuple[str, Array | None]:
        """Return the answer, and the mean of the window's wrenches where they make a tare."""
        wrenches = np.array(self._wrenches)
        problem = self._unsteady(wrenches)
        if problem:
            return f"not tared: {problem}", None
        p, offset = self._parameters, wrenches.mean(axis=0)
        for what, part, limit, parameter, unit in (
            ("force", offset[:3], p.tare_max_force_n, "tare_max_force_n", "N"),
            ("torque", offset[3:], p.tare_max_torque_nm, "tare_max_torque_nm", "N.m"),
        ):
            value = np.linalg.norm(part)
            if value > limit:
                return (
                    f"not tared: a {what} of {value:.3g} {unit} would be subtracted, {parameter} is"
                    f" {limit:g}; is the right tool active, and is it free of contact?",
                    None,
                )
        force = ", ".join(f"{v:.3f}" for v in offset[:3])
        torque = ", ".join(f"{1e3 * v:.1f}" for v in offset[3:])
        return (
            f"tared: subtracts force ({force}) N, torque ({torque}) mN.m"
            f" over the next {p.tare_ramp_s:g} s",
            offset,
        )

    def _unsteady(self, wrenches: Array) -> str:
        """Why arm and wrench were not at rest in the window; empty if they were."""
        if len(wrenches) < MIN_SAMPLES:
            return (
                f"{len(wrenches)} compensated wrenches in {self._parameters.tare_window_s:g} s,"
                f" at least {MIN_SAMPLES} are needed"
            )
        motion = np.ptp(np.array(self._angles), axis=0)
        for name, moved in zip(self._angle_names, motion, strict=True):
            if moved > MAX_MOTION_RAD:
                return (
                    f"{name} moved by {moved:.4f} rad in the window, the limit is"
                    f" {MAX_MOTION_RAD:g}"
                )
        std = wrenches.std(axis=0, ddof=1)
        for what, value, limit, unit in (
            ("force", std[:3].max(), MAX_STD_FORCE_N, "N"),
            ("torque", std[3:].max(), MAX_STD_TORQUE_NM, "N.m"),
        ):
            if value > limit:
                return (
                    f"the {what} was not still, standard deviation {value:.3g} {unit}"
                    f" in the window, the limit is {limit:g}"
                )
        return ""


class TareRamp:
    """The active offset at a stamp. A new target is approached by a smoothstep in the stamps.

    With s = (t - start) / ramp_s in [0, 1] the offset is start + (3 s^2 - 2 s^3) (target - start),
    so that its rate never exceeds 1.5 |target - start| / ramp_s, and is zero at both ends.
    """

    def __init__(self, ramp_s: float) -> None:
        self._ramp_ns = ramp_s * 1e9
        self._start_ns: int | None = None  # None: the target is fully active
        self._start: Array = np.zeros(6)
        self._target: Array = np.zeros(6)

    @property
    def target(self) -> Array:
        """Offset (6,) when the ramp has ended."""
        return self._target

    @property
    def ramping(self) -> bool:
        """Whether the last stamp asked for lay inside a ramp."""
        return self._start_ns is not None

    def reset(self) -> None:
        """Zero offset, at once."""
        self._start_ns = None
        self._start = np.zeros(6)
        self._target = np.zeros(6)

    def start(self, stamp_ns: int, target: Array) -> None:
        """Go from the active offset to another.

        Args:
            stamp_ns: where the ramp begins.
            target: (6,) where it ends, N and N.m.

        """
        self._start = self.offset_at(stamp_ns)
        self._target = np.array(target, dtype=float)
        self._start_ns = stamp_ns

    def offset_at(self, stamp_ns: int) -> Array:
        """Return the offset active at a stamp.

        Args:
            stamp_ns: the wrench's stamp.

        Returns:
            (6,), N and N.m; the caller must not write into it.

        """
        if self._start_ns is None:
            return self._target
        elapsed_ns = stamp_ns - self._start_ns
        if elapsed_ns >= self._ramp_ns:
            self._start_ns = None
            return self._target
        s = max(0.0, elapsed_ns / self._ramp_ns)
        return self._start + (s * s * (3.0 - 2.0 * s)) * (self._target - self._start)
