# SPDX-License-Identifier: Apache-2.0
"""Is the set-up the one that the calibration file was made with? Asked live, of readings at rest.

The tool's file says what the sensor reads at a pose, so that one rest segment without contact shows
a mistake that is gross: a reversed reading is off by twice what is expected. What is off by more
than half of that is compared with what each mistake of `galen_model.setup_check` would read there;
one that explains the readings of all segments so far contradicts the set-up. A hand on the tool, or
an offset of the sensor, is explained by none: the set-up is then not verified, and not contradicted
either. It is verified once readings in three orientations fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.windows import StillWindow
from galen_model.setup_check.mistakes import Corrected, known_load_mistakes
from galen_model.setup_check.readings import at_angles

ORIENTATIONS = 3
"""So many, in which readings fit, verify a set-up."""

_WINDOW_NS = 300_000_000
_FEWEST_SAMPLES = 5
_STILL_RAD = 0.003  # an arm that turns by less over a window is at rest
_APART = 0.3  # chord between gravity's unit vectors: nearer segments are of one orientation
_REMEMBERED = 8
_OFF = 0.5  # of the expected reading, of forces or torques: what contradicts
_FITS = 0.15  # and what fits
_FITS_N, _FITS_NM = 0.2, 0.01  # or so much of an offset
_MOST_NAMED = 3


@dataclass(frozen=True)
class _Segment:
    direction: Array
    angles: Array
    expected: Array
    output: Array

    def within(self, left: Array, share: float, smallest: float = 1.0) -> bool:
        """Whether what is left (6,) is at most a share of the reading, or an offset that may be."""
        sizes = [float(np.linalg.norm(part)) for part in np.split(self.expected, 2)]
        force, torque = (float(np.linalg.norm(part)) for part in np.split(left, 2))
        return force <= max(share * sizes[0], smallest * _FITS_N) and torque <= max(
            share * sizes[1], smallest * _FITS_NM
        )

    @property
    def shares_off(self) -> tuple[float, float]:
        """How much of the expected force and torque the output is."""
        force, torque = (
            float(np.linalg.norm(self.output[kind]))
            / max(float(np.linalg.norm(self.expected[kind])), 1e-9)
            for kind in (slice(3), slice(3, 6))
        )
        return force, torque

    @property
    def share_off(self) -> float:
        """The larger of them."""
        return max(self.shares_off)

    @property
    def fits(self) -> bool:
        """Whether the reading is the file's."""
        return self.within(self.output, _FITS)


class SetupVerification:
    """Whether readings at rest have verified or contradicted the set-up, since the last change."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._tool: CalibrationFile | None = None
        self._angles: tuple[float, ...] = ()
        self.clear()

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Begin anew with another tool.

        Args:
            tool: its calibration; None: nothing is checked.

        """
        self._tool = tool
        self.clear()

    def clear(self) -> None:
        """Begin anew, without a tare."""
        self._tare: Array = np.zeros(6)
        self._segments: list[_Segment] = []
        self.contradiction = ""
        """What is wrong, and the remedy; empty where nothing is known to be."""
        self.verified = False
        """Whether readings fit in enough orientations."""
        self._drop()

    def push(self, stamp_ns: int, angles: tuple[float, ...], output: Array) -> None:
        """Take a sample, until the set-up is verified.

        Averages of 0.3 s are enough for mistakes that are gross, long before the sensor's noise is
        learned that the calibration monitor's windows need.

        Args:
            stamp_ns: the wrench's stamp.
            angles: (k,) at that stamp, rad.
            output: (6,) as it goes out when no ramp runs, in the sensor's frame, N and N.m.

        """
        if self.verified:
            return
        if not self._outputs:
            self._from_ns, self._angles = stamp_ns, angles
        elif any(abs(a - b) > _STILL_RAD for a, b in zip(angles, self._angles, strict=True)):
            self._drop()
            return
        self._outputs.append(output)
        if stamp_ns - self._from_ns < _WINDOW_NS:
            return
        outputs = np.array(self._outputs)
        self._drop()
        if self._tool is None or len(outputs) < _FEWEST_SAMPLES:
            return
        segment_angles = np.array(angles)
        force = float(np.linalg.norm(self._tool.predict(segment_angles)[:3]))
        std = outputs.std(axis=0)
        if float(np.linalg.norm(std[:3])) <= max(_FITS * force, _FITS_N):
            mean, of_mean = outputs.mean(axis=0), std / np.sqrt(len(outputs))
            window = (self._from_ns, stamp_ns, len(outputs), mean, of_mean, angles, True)
            self.add(StillWindow(*window))

    def _drop(self) -> None:
        self._outputs: list[Array] = []
        self._from_ns = 0

    def offset_changed(self, change: Array, tare: Array) -> None:
        """Follow a tare, or the bias drift's switch.

        Args:
            change: (6,) what is subtracted from now on more than before, N and N.m.
            tare: (6,) what the tare subtracts from now on, N and N.m.

        """
        self._drop()
        self._segments = [replace(one, output=one.output - change) for one in self._segments]
        self._tare = tare

    @property
    def checks(self) -> bool:
        """Whether readings are judged: a mounting's gains and rotation explain too much."""
        return self._tool is not None and self._tool.mounting is None

    @property
    def fitting(self) -> int:
        """In how many orientations readings fit."""
        return sum(one.fits for one in self._segments)

    @property
    def text(self) -> str:
        """The state, for /diagnostics."""
        if not self.checks:
            return "not checked: no tool, or its file has a mounting"
        if self.contradiction:
            return f"wrong: {self.contradiction}"
        if self.verified:
            return "verified"
        state = f"not yet verified: fits at rest in {self.fitting} of {ORIENTATIONS} orientations"
        if self._segments and not self._segments[-1].fits:
            off = np.linalg.norm(self._segments[-1].output[:3])
            state += f", {off:.2g} N off in the last; without contact zero or tare the sensor"
        return state

    def add(self, window: StillWindow) -> None:
        """Take a window at rest, of what goes out.

        Args:
            window: a steady one.

        """
        tool = self._tool
        if tool is None or not self.checks:
            return
        angles = np.array(window.angles)
        down = self._arm.gravity_in_sensor(angles)
        segment = _Segment(down / np.linalg.norm(down), angles, tool.predict(angles), window.mean)
        elsewhere = [
            one
            for one in self._segments
            if np.linalg.norm(one.direction - segment.direction) > _APART
        ]
        self._segments = [*elsewhere, segment][-_REMEMBERED:]
        if not self.verified:
            self.contradiction = self._explained()
            self.verified = not self.contradiction and self.fitting >= ORIENTATIONS

    def _explained(self) -> str:
        """Return which mistakes explain the readings of all segments, in words; empty for none."""
        assert self._tool is not None
        if all(one.within(one.output, _OFF) for one in self._segments):
            return ""
        raw = [one.output + self._tare + one.expected for one in self._segments]
        angles = np.array([one.angles for one in self._segments])
        good: list[Corrected] = []
        for mistake in known_load_mistakes(at_angles(np.array(raw), angles, self._arm)):
            corrected = mistake.readings
            left = corrected.wrench - self._tool.predict_under(corrected.gravity)
            pairs = zip(self._segments, left, strict=True)
            if all(one.within(row, _FITS, 0.5) for one, row in pairs):
                good.append(mistake)
        if not good:
            return ""
        worst = max(self._segments, key=lambda one: one.share_off)
        kind, unit = (
            (slice(3), "N") if worst.share_off == worst.shares_off[0] else (slice(3, 6), "N.m")
        )
        off, of = (np.linalg.norm(part[kind]) for part in (worst.output, worst.expected))
        causes = "; or ".join(f"{one.what} ({one.remedy})" for one in good[:_MOST_NAMED])
        return f"{causes}: at rest {off:.2g} {unit} too much, where {of:.2g} {unit} are expected"
