# SPDX-License-Identifier: Apache-2.0
"""The still phases of a recording, each averaged and judged as the live sweep does it.

The phases come from the joints alone (`galen_model.rest.segments`). Each is then played to a
`PoseRecorder`, sample by sample in the order they were received, with the phase's own pose as its
target. A live sweep's recorder sees the same samples, and where its average lies hangs on their
stamps alone. So a recording of a live calibration gives the averages that the live one had.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from galen_bags.arrays.arm_recording import ArmRecording
from galen_common.goal.arrival import NS, PoseRecorder, PoseRejection, StampClock, StampsError
from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.rest.segments import JointRest, PoseRecord, rest_by_joints

from galen_calibration_behavior.common.parameters import CalibrationParameters

# The recorder hears the samples from this long before a phase, for a stop is found by a window that
# reaches back into the motion, and until this long after it, for wrenches received late.
_LEAD_NS = NS // 2
_LAG_NS = NS


@dataclass(frozen=True)
class MeanReading:
    """Mean reading (6,) over one average's length, N and N.m, and its std for white noise."""

    wrench: Array
    std: Array


@dataclass(frozen=True)
class Visit:
    """One still phase that is long enough for an average.

    Stamps in ns; `log_ns` is when the phase's last joint state was received. joints (n,): the
    phase's medians, m and rad. `first` and `last`: the reading once the arm had settled, and at the
    phase's end; None where there are too few wrenches.
    """

    start_ns: int
    end_ns: int
    window_ns: tuple[int, int]
    log_ns: int
    joints: Array
    outcome: PoseRecord | PoseRejection
    first: MeanReading | None
    last: MeanReading | None


@dataclass(frozen=True)
class Visits:
    """A recording's visits in order, and what is odd.

    `short_ns` (k, 2): begins and ends of the rest segments that are too short for an average.
    """

    recording: ArmRecording
    visits: list[Visit]
    warnings: list[str]
    short_ns: np.ndarray

    @property
    def path(self) -> Path:
        """The recording's."""
        return self.recording.path

    @property
    def origin_ns(self) -> int:
        """Stamp of the first joint state, from which times are counted."""
        return int(self.recording.joint_stamp_ns[0])

    def time_s(self, stamp_ns: int) -> float:
        """Return the time from the recording's begin.

        Args:
            stamp_ns: a sample's stamp, ns.

        Returns:
            Seconds after the first joint state's stamp.

        """
        return (stamp_ns - self.origin_ns) / NS


def find_visits(
    recording: ArmRecording,
    settings: CalibrationParameters,
    progress: Callable[[list[slice]], Iterable[slice]] = iter,
) -> Visits:
    """Average and judge every still phase.

    An average begins when the arm has settled and is as long as a live one.

    Args:
        recording: joint states and wrenches.
        settings: of stillness and averages, as the live node's.
        progress: wraps the phases while they are worked through.

    Returns:
        The phases that are long enough for an average, and warnings.

    Raises:
        GalenError: nothing is still in the recording, or it does not hold what it must.

    """
    _check_frames(recording, settings)
    warnings = [*recording.problems, *_stamp_warnings(recording, settings)]
    recording, unknown = _stand_in_for_missing_joints(recording, settings)
    warnings += unknown
    still = JointRest(
        max_speed=settings.arrival.velocity_tolerance,
        window_s=settings.arrival.velocity_window_s,
        min_duration_s=0.0,
        max_stamp_step_s=settings.arrival.max_stamp_step_s,
    )
    phases = rest_by_joints(recording.joint_stamp_ns, recording.joints, still, arm=settings.arm)
    player = _Player(recording, settings)
    visits, short, before = [], [], 0
    for number, rows in enumerate(progress(phases)):
        after = phases[number + 1].start if number + 1 < len(phases) else None
        visit = player.visit(rows, before, after)
        before = rows.stop
        if visit is not None:
            visits.append(visit)
        else:
            short.append(recording.joint_stamp_ns[[rows.start, rows.stop - 1]])
    short_ns = np.array(short, dtype=np.int64).reshape(-1, 2)
    if not visits:
        needed_s = settings.arrival.settle_s + settings.average_s
        longest_s = float(np.max(np.diff(short_ns), initial=0)) / NS
        raise GalenError(
            f"{recording.path}: the arm never stands still for the {needed_s:g} s that settling and"
            f" averaging take ({len(phases)} shorter stops, the longest {longest_s:.2f} s): hold"
            " each pose for longer, or give -p average_s:=SECONDS and -p settle_s:=SECONDS"
        )
    return Visits(recording, _with_temperature(visits, recording), warnings, short_ns)


def _with_temperature(visits: list[Visit], recording: ArmRecording) -> list[Visit]:
    """Give each average the temperature at its middle, by interpolation, where there is one."""
    stamps = recording.temperature_stamp_ns
    joints = recording.joint_stamp_ns
    if not len(stamps) or stamps[-1] < joints.min() or stamps[0] > joints.max():
        return visits
    warm = []
    for visit in visits:
        outcome = visit.outcome
        if isinstance(outcome, PoseRecord):
            # Differences: a date in ns is too long for a float.
            since = (stamps - outcome.stamp_ns).astype(float)
            celsius = float(np.interp(0.0, since, recording.temperature_c))
            outcome = replace(outcome, temperature_c=celsius)
        warm.append(replace(visit, outcome=outcome))
    return warm


class _Player:
    """Plays a recording's phases to recorders."""

    def __init__(self, recording: ArmRecording, settings: CalibrationParameters) -> None:
        self._recording = recording
        self._settings = settings
        joints = len(recording.joint_stamp_ns)
        log_ns = np.concatenate([recording.joint_log_ns, recording.wrench_log_ns])
        self._order = np.argsort(
            log_ns, kind="stable"
        )  # rows of both, the wrenches' after `joints`
        place = np.empty_like(self._order)
        place[self._order] = np.arange(len(self._order))
        self._joint_place = place[:joints]  # of a joint state among all samples
        self._has_velocity = np.all(np.isfinite(recording.joint_velocities), axis=1)

    def visit(self, rows: slice, before: int, after: int | None) -> Visit | None:
        """Return the phase's average; None when the phase is too short for one.

        `before` and `after` are the joint rows that the neighbouring phases leave to this one.
        """
        recording = self._recording
        stamps = recording.joint_stamp_ns
        start_ns, end_ns = int(stamps[rows.start]), int(stamps[rows.stop - 1])
        joints = np.median(recording.joints[rows], axis=0)
        recorder = PoseRecorder(
            self._settings.arrival,
            self._settings.stillness,
            self._settings.average_s,
            joints,
            math.inf,
        )
        first = self._first_within(before, rows.start, start_ns - _LEAD_NS)
        last = self._last_within(rows.stop, after, end_ns + _LAG_NS)
        try:
            self._play(recorder, first, last)
        except StampsError as error:
            raise GalenError(f"{recording.path}: {error}") from error
        window_ns, outcome = recorder.window_ns, recorder.result
        if window_ns is None or (window_ns[1] > end_ns and not isinstance(outcome, PoseRecord)):
            return None
        if outcome is None:
            outcome = PoseRejection("wrench_raw ends before the average does")
        return Visit(
            start_ns, end_ns, window_ns, int(recording.joint_log_ns[rows.stop - 1]), joints,
            outcome, *self._levels(rows, window_ns[0], end_ns),
        )  # fmt: skip

    def _first_within(self, low: int, high: int, from_ns: int) -> int:
        """First of the joint rows from `low` to `high` whose stamp is `from_ns` or later."""
        later = np.flatnonzero(self._recording.joint_stamp_ns[low:high] >= from_ns)
        return low + int(later[0]) if len(later) else high

    def _last_within(self, low: int, high: int | None, upto_ns: int) -> int:
        """Last of the joint rows from `low - 1` to `high` whose stamp is `upto_ns` or earlier."""
        earlier = np.flatnonzero(self._recording.joint_stamp_ns[low:high] <= upto_ns)
        return low + int(earlier[-1]) if len(earlier) else low - 1

    def _play(self, recorder: PoseRecorder, first: int, last: int) -> None:
        """Feed both topics from joint row `first` to `last` until there is a result."""
        recording = self._recording
        count = len(recording.joint_stamp_ns)
        # Nothing after the last joint state can be shown to belong elsewhere.
        end = None if last == count - 1 else self._joint_place[last] + 1
        for row in self._order[self._joint_place[first] : end].tolist():
            if row < count:
                recorder.add_joints(
                    int(recording.joint_stamp_ns[row]),
                    recording.joints[row],
                    recording.joint_velocities[row] if self._has_velocity[row] else None,
                )
            else:
                row -= count
                recorder.add_wrench(int(recording.wrench_stamp_ns[row]), recording.wrenches[row])
            if recorder.result is not None:
                return

    def _levels(
        self, rows: slice, settled_ns: int, end_ns: int
    ) -> tuple[MeanReading | None, MeanReading | None]:
        """Return the readings at the phase's begin and end."""
        count = len(self._recording.joint_stamp_ns)
        places = self._order[self._joint_place[rows.start] : self._joint_place[rows.stop - 1] + 1]
        wrench_rows = places[places >= count] - count
        stamps = self._recording.wrench_stamp_ns[wrench_rows]
        average_ns = round(self._settings.average_s * NS)
        last_ns = max(settled_ns, end_ns - average_ns)
        return (
            self._level(wrench_rows[(stamps >= settled_ns) & (stamps <= settled_ns + average_ns)]),
            self._level(wrench_rows[(stamps >= last_ns) & (stamps <= end_ns)]),
        )

    def _level(self, wrench_rows: np.ndarray) -> MeanReading | None:
        values = self._recording.wrenches[wrench_rows]
        values = values[np.all(np.isfinite(values), axis=1)]
        if len(values) < 2:
            return None
        std = np.maximum(values.std(axis=0, ddof=1), SENSOR.quantum / np.sqrt(12.0))
        return MeanReading(values.mean(axis=0), std / np.sqrt(len(values)))


def _check_frames(recording: ArmRecording, settings: CalibrationParameters) -> None:
    """Raise GalenError for readings in another frame, or topics of two clocks."""
    wrong = [frame for frame in recording.frame_ids if frame != settings.arm.sensor_frame]
    if wrong:
        raise GalenError(
            f"{recording.path}: wrench_raw has frame_id {wrong[0]!r};"
            f" it must be {settings.arm.sensor_frame!r}: --sensor-frame names the frame that the"
            " wrenches are written in"
        )
    both = (recording.joint_stamp_ns, recording.wrench_stamp_ns)
    for topic, stamps in zip(recording.topics, both, strict=False):
        if not stamps.any():
            raise GalenError(
                f"{recording.path}: {topic} is not stamped (its stamps are 0): the driver must"
                " stamp its samples; --log-times takes the times at which they were recorded"
            )
    apart_ns = max(int(s.min()) for s in both) - min(int(s.max()) for s in both)
    if apart_ns > 0:
        raise GalenError(
            f"{recording.path}: the stamps of joint_states and wrench_raw lie {apart_ns / NS:.3f} s"
            " apart: they must come from one clock"
        )


def _stamp_warnings(recording: ArmRecording, settings: CalibrationParameters) -> list[str]:
    warnings = []
    for topic, stamps in (
        ("joint_states", recording.joint_stamp_ns),
        ("wrench_raw", recording.wrench_stamp_ns),
    ):
        clock = StampClock(topic, settings.arrival.max_stamp_step_s)
        try:
            for stamp_ns in stamps.tolist():
                clock.advance(stamp_ns)
        except StampsError as error:
            raise GalenError(f"{recording.path}: {error}") from error
        if clock.jumps:
            warnings.append(f"time stamps jumped {clock.jumps} times; the last: {clock.last_jump}")
    return warnings


def _stand_in_for_missing_joints(
    recording: ArmRecording, settings: CalibrationParameters
) -> tuple[ArmRecording, list[str]]:
    """Let a joint that the recording lacks stand at home, with a warning."""
    missing = ~np.isfinite(recording.joints).any(axis=0)
    if not missing.any():
        return recording, []
    joints, velocities = recording.joints.copy(), recording.joint_velocities.copy()
    joints[:, missing], velocities[:, missing] = settings.home[missing], 0.0
    names = ", ".join(settings.arm.joint_names[k] for k in np.flatnonzero(missing))
    return replace(recording, joints=joints, joint_velocities=velocities), [
        f"joint_states does not hold {names}: taken to stand still"
    ]
