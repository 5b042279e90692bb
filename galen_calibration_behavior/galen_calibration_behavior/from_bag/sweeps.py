# SPDX-License-Identifier: Apache-2.0
"""Which of a recording's still phases belong to which sweep, and what the estimate takes of them.

What is recorded at home before, between and after the sweeps is left out; where the
tool came on is found (`tool_border`) or given; then each sweep's poses are compared with each other
as a live sweep's are.

A live calibration goes home before, between and after its sweeps, and measures nothing there unless
its grid has home among its poses. So phases at home are left out where a sweep begins or ends with
them, and stay in inside of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from galen_common.goal.arrival import NS, PoseRejection
from galen_model.arrays import Array
from galen_model.errors import GalenError, IdentificationError
from galen_model.load.identification import MIN_POSES
from galen_model.load.readings import StillPoses
from galen_model.rest.segments import PoseRecord, wrench_fault
from galen_model.setup_check.check import SetupError, require_setup
from galen_model.setup_check.readings import StillReadings
from numpy.typing import ArrayLike

from galen_calibration_behavior.common.commands import Measurements
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.common.sweep import stack, still_poses
from galen_calibration_behavior.from_bag.tool_border import Border, find_border
from galen_calibration_behavior.from_bag.visits import Visit, Visits


class HomeStays:
    """Tells the visits at home from the others."""

    def __init__(self, settings: CalibrationParameters, zero_angles: ArrayLike) -> None:
        """`zero_angles` (k,), rad, at home, where the sensor was zeroed."""
        self._settings = settings
        self._zero_angles = np.asarray(zero_angles, dtype=float)

    def at_home(self, visit: Visit) -> bool:
        """Return whether the arm stands at home, by its angles.

        Args:
            visit: a still phase.

        Returns:
            True within the tolerance of an arrival.

        """
        away = np.abs(self._settings.arm.angles(visit.joints) - self._zero_angles)
        return bool(
            np.all(away <= self._settings.arm.angles(self._settings.arrival.position_tolerance))
        )

    def without_ends(self, visits: Sequence[Visit]) -> list[Visit]:
        """Leave out the phases at home with which a sweep begins and ends.

        Args:
            visits: still phases in the order of time.

        Returns:
            From the first to the last one away from home; those at home between them stay.

        """
        away = [k for k, visit in enumerate(visits) if not self.at_home(visit)]
        return list(visits[away[0] : away[-1] + 1]) if away else []

    def after_zeroing(self, recording: Visits) -> tuple[list[Visit], list[str]]:
        """Return the visits after the zeroing, and a warning where poses are lost by that.

        It was zeroed in a stay at home in which the reading goes to zero (or a tool was removed;
        in both cases what was read before has another zero or load), and, where the zero did not
        change by enough to be seen, in the first stay at home, if the recording begins with it or
        with too few poses for a sweep.

        Args:
            recording: the visits of one recording.

        Returns:
            The visits, all of them where no zeroing is seen; and at most one warning.

        """
        visits = recording.visits
        stays = [
            list(group)
            for at_home, group in groupby(range(len(visits)), lambda k: self.at_home(visits[k]))
            if at_home
        ]
        first = 0
        for stay in stays:
            begins = stay == stays[0] and stay[0] < MIN_POSES
            enough_left = len(visits) - 1 - stay[-1] >= 2 * MIN_POSES
            if enough_left and (begins or self._zeroed([visits[k] for k in stay])):
                first = stay[-1] + 1
        lost = sum(not self.at_home(visit) for visit in visits[:first])
        if not lost:
            return visits[first:], []
        at_s = recording.time_s(visits[first - 1].end_ns)
        return visits[first:], [
            f"{lost} still phases before {at_s:.1f} s are left out: the arm was at home then, and"
            " the sensor was zeroed there, or a tool removed"
        ]

    def _zeroed(self, stay: list[Visit]) -> bool:
        before = next((v.first for v in stay if v.first is not None), None)
        after = next((v.last for v in reversed(stay) if v.last is not None), None)
        if before is None or after is None:
            return False
        noise = np.hypot(after.std, before.std)
        change = (after.wrench - before.wrench) / noise
        # A light tool that comes on changes a reading within the tolerance too, but away from zero.
        nearer = np.linalg.norm(after.wrench / noise) < np.linalg.norm(before.wrench / noise)
        changed = np.any(np.abs(change) > self._settings.stillness.trend_sigmas)
        at_zero = np.all(np.abs(after.wrench) <= self._settings.zero_tolerance)
        return bool(changed and nearer and at_zero)


_AT_HAND = "say --tool-on-at-s SECONDS, from the recording's first joint state"


@dataclass(frozen=True)
class RecordedPose:
    """A visit in its sweep: `number` counts the sweep's poses, `fault` says why it isn't used."""

    sweep: str
    number: int
    time_s: float
    visit: Visit
    fault: str


@dataclass(frozen=True)
class RecordedSweeps:
    """What the estimate needs, and where it comes from.

    `poses` holds every visit of both sweeps in order; those without a fault are the rows of
    `measurements`, in this order. `border` is set where it was looked for, `tool_on_s` where one
    recording holds both sweeps: end of the last average without the tool, begin of the first with.
    `recordings`: the one of both sweeps or of the tool's, or one of each.
    """

    measurements: Measurements
    poses: list[RecordedPose]
    recordings: tuple[Visits, ...]
    border: Border | None = None
    tool_on_s: tuple[float, float] | None = None

    @property
    def last(self) -> Visit:
        """The last visit used."""
        return [pose for pose in self.poses if not pose.fault][-1].visit


class SweepSorter:
    """Sorts the visits of recordings into sweeps."""

    def __init__(self, settings: CalibrationParameters, zero_angles: ArrayLike) -> None:
        """`zero_angles` (k,), rad, where the sensor was zeroed, at home."""
        self._settings = settings
        self._zero_angles = np.asarray(zero_angles, dtype=float)
        self._home = HomeStays(settings, zero_angles)

    def two_sweeps(self, recording: Visits, tool_on_at_s: float | None = None) -> RecordedSweeps:
        """Sort both sweeps out of one recording.

        Args:
            recording: its visits, first without the tool, then with it.
            tool_on_at_s: when the tool came on, s from the first joint state; None: it is found.

        Returns:
            The poses of both sweeps.

        Raises:
            GalenError: a sweep has too few poses or more than one load, or it is not clear where
                the tool came on.

        """
        visits, warnings = self._home.after_zeroing(recording)
        visits = self._home.without_ends(visits)
        border = None
        if tool_on_at_s is None:
            border, first = self._find_border(recording, visits)
            bare, tool = visits[:first], visits[first:]
        else:
            at_ns = recording.origin_ns + round(tool_on_at_s * NS)
            bare = [v for v in visits if v.window_ns[1] <= at_ns]
            tool = [v for v in visits if v.window_ns[0] >= at_ns]
            if not bare or not tool:
                side = "before" if not bare else "after"
                raise GalenError(
                    f"{recording.path}: there is no still pose {side} --tool-on-at-s"
                    f" {tool_on_at_s:g}; they lie between {_span(recording, visits)}"
                )
        done = self._put_together(
            self._one_load_sweep("bare", recording, bare),
            self._one_load_sweep("tool", recording, tool),
            [*recording.warnings, *warnings],
            recording,
        )
        without = max(p.visit.window_ns[1] for p in done.poses if p.sweep == "bare" and not p.fault)
        with_it = min(p.visit.window_ns[0] for p in done.poses if p.sweep == "tool" and not p.fault)
        tool_on_s = (recording.time_s(without), recording.time_s(with_it))
        return replace(done, border=border, tool_on_s=tool_on_s)

    def two_recordings(self, bare: Visits, tool: Visits) -> RecordedSweeps:
        """Take each sweep out of a recording of its own.

        Args:
            bare: visits without the tool.
            tool: visits with the tool on.

        Returns:
            The poses of both sweeps.

        Raises:
            GalenError: a sweep has too few poses, or more than one load.

        """
        parts, warnings = [], []
        for name, recording in (("bare", bare), ("tool", tool)):
            visits, lost = self._home.after_zeroing(recording)
            parts.append(self._one_load_sweep(name, recording, visits))
            warnings += [*recording.warnings, *lost]
        return self._put_together(parts[0], parts[1], warnings, bare, tool)

    def one_sweep(self, recording: Visits) -> RecordedSweeps:
        """Take the tool's sweep alone out of a recording.

        Args:
            recording: visits with the tool on.

        Returns:
            The poses, none of them bare.

        Raises:
            GalenError: the sweep has too few poses, or more than one load.

        """
        visits, lost = self._home.after_zeroing(recording)
        poses = self._one_load_sweep("tool", recording, visits)
        return self._put_together([], poses, [*recording.warnings, *lost], recording)

    def still_poses(self, recording: Visits) -> tuple[list[RecordedPose], list[str]]:
        """Return the poses of a sweep of one tool, and warnings.

        Whether one load explains them is not asked: a cable's pull comes and goes with the pose.

        Args:
            recording: visits with the tool on.

        Returns:
            The poses, those with a fault too; and warnings.

        Raises:
            GalenError: the sweep has too few poses.

        """
        visits, lost = self._home.after_zeroing(recording)
        poses = self._judge("tool", recording, self._home.without_ends(visits))
        return poses, [*recording.warnings, *lost]

    def _one_load_sweep(
        self, name: str, recording: Visits, visits: list[Visit]
    ) -> list[RecordedPose]:
        kept = self._home.without_ends(visits)
        self._check_one_load(recording, kept)
        return self._judge(name, recording, kept)

    # ---- where the tool came on

    def _find_border(self, recording: Visits, visits: list[Visit]) -> tuple[Border, int]:
        """Return the border and the first visit after it."""
        good = self._still(visits)
        later = good[len(good) // 2 :]  # with the tool on, if the set-up is wrong
        try:
            border = self._border(visits, good)
        except IdentificationError as error:
            self._check_setup(recording, visits, later)
            faults = [*self._faults(visits).values()]
            home = len(recording.visits) - len(visits)
            counts = f"rest segments: {len(recording.visits)} in all, {home} where it was zeroed"
            if faults:
                counts += f", {len(faults)} rejected, the last: {faults[-1]}"
            raise GalenError(f"{recording.path}: {error} ({counts})") from error
        if not border.changes or not border.clear:
            self._check_setup(recording, visits, later)
        if not border.changes:
            raise GalenError(
                f"{recording.path}: one load explains all {len(good)} still poses, and two don't do"
                f" it clearly better (the residual of one is {border.ratio:.2f} times as large):"
                " no tool came on. If it is a recording of the tool's sweep alone, say"
                f" --one-sweep; if a tool came on and is as light as that, {_AT_HAND}"
            )
        if not border.clear:
            times = sorted(
                recording.time_s(visits[good[k]].start_ns)
                for k in (border.index, border.next_index)
            )
            raise GalenError(
                f"{recording.path}: the tool came on before the pose at {times[0]:.1f} s or before"
                f" that at {times[1]:.1f} s; the poses fit either"
                f" ({border.next_worse:.1f} standard deviations apart): {_AT_HAND}"
            )
        return border, good[border.index - 1] + 1

    def _border(self, visits: list[Visit], good: list[int]) -> Border:
        at_home = np.array([self._home.at_home(visits[k]) for k in good], dtype=bool)
        arm = self._settings.arm
        angles, wrench, std_of_mean = stack([_record(visits[k]) for k in good], arm)
        return find_border(arm.gravity_in_sensor(angles), wrench, std_of_mean, at_home)

    def _check_one_load(self, recording: Visits, visits: list[Visit]) -> None:
        """Raise GalenError where a load came or went between the poses."""
        good = self._still(visits)
        if len(good) < 2 * MIN_POSES:
            return
        border = self._border(visits, good)
        if border.changes and border.clear:
            self._check_setup(recording, visits, good)
            at_s = recording.time_s(visits[good[border.index]].start_ns)
            raise GalenError(
                f"{recording.path}: the load is another from {at_s:.1f} s on (one load leaves a"
                f" residual {border.ratio:.0f} times as large as two): what should be one sweep is"
                " not one"
            )

    def _check_setup(self, recording: Visits, visits: list[Visit], good: list[int]) -> None:
        """Raise GalenError where a wrong set-up explains what looks like two loads, or none."""
        if not self._settings.check_setup or not good:
            return
        poses = still_poses([_record(visits[k]) for k in good], self._settings.arm)
        try:
            require_setup(StillReadings.of_poses(poses), poses.noise)
        except SetupError as error:
            raise GalenError(f"{recording.path}: {error}") from error

    # ---- judgement

    def _faults(self, visits: Sequence[Visit]) -> dict[int, str]:
        """Why visits can't be used: arm or wrench were not still, compared with the others."""
        faults = {
            k: visit.outcome.reason
            for k, visit in enumerate(visits)
            if isinstance(visit.outcome, PoseRejection)
        }
        while True:
            records = {k: _record(v) for k, v in enumerate(visits) if k not in faults}
            others = list(records.values())
            new = {
                k: fault
                for k, record in records.items()
                if (fault := wrench_fault(record, others, self._settings.stillness))
            }
            if not new:
                return faults
            faults |= new

    def _still(self, visits: Sequence[Visit]) -> list[int]:
        faults = self._faults(visits)
        return [k for k in range(len(visits)) if k not in faults]

    def _judge(self, name: str, recording: Visits, visits: list[Visit]) -> list[RecordedPose]:
        """Return the sweep's poses, one visited again under its old number.

        Raises GalenError.
        """
        faults = self._faults(visits)
        tolerance = 2.0 * self._settings.arm.angles(self._settings.arrival.position_tolerance)
        seen: list[Array] = []
        poses = []
        for k, visit in enumerate(visits):
            angles = self._settings.arm.angles(visit.joints)
            near = [n for n, old in enumerate(seen) if np.all(np.abs(angles - old) <= tolerance)]
            if not near:
                seen.append(angles)
            number = near[0] if near else len(seen) - 1
            time_s = recording.time_s(visit.start_ns)
            poses.append(RecordedPose(name, number, time_s, visit, faults.get(k, "")))
        if len(_recorded(poses)) < self._settings.min_pose_fraction * len(seen) or not seen:
            last = [pose.fault for pose in poses if pose.fault][-1:] or ["nothing was still"]
            raise GalenError(
                f"{recording.path}: only {len(_recorded(poses))} of {len(seen)} poses of the {name}"
                f" sweep can be used; {last[0]}"
            )
        return poses

    def _put_together(
        self,
        bare: list[RecordedPose],
        tool: list[RecordedPose],
        warnings: list[str],
        *recordings: Visits,
    ) -> RecordedSweeps:
        good_bare, good_tool = ([p for p in poses if not p.fault] for poses in (bare, tool))
        measurements = Measurements(
            bare=self._still_poses(good_bare, recordings[0]) if bare else None,
            tool=self._still_poses(good_tool, recordings[-1]),
            zero_angles=self._zero_angles,
            bare_indices=[pose.number for pose in good_bare],
            tool_indices=[pose.number for pose in good_tool],
            rejected=[*_left_out(bare), *_left_out(tool)],
            warnings=warnings,
            zeroed=self._settings.zeroed,
        )
        return RecordedSweeps(measurements, [*bare, *tool], recordings)

    def _still_poses(self, poses: list[RecordedPose], recording: Visits) -> StillPoses:
        records = [_record(pose.visit) for pose in poses]
        return still_poses(records, self._settings.arm, recording.origin_ns)


def _record(visit: Visit) -> PoseRecord:
    assert isinstance(visit.outcome, PoseRecord)
    return visit.outcome


def _recorded(poses: list[RecordedPose]) -> set[int]:
    """Numbers of the poses with a visit that can be used."""
    return {pose.number for pose in poses if not pose.fault}


def _left_out(poses: list[RecordedPose]) -> list[str]:
    """Name the poses without a visit that can be used, with their last fault, as a live sweep."""
    recorded = _recorded(poses)
    faults = {p.number: f"{p.sweep}/{p.number}: {p.fault}" for p in poses}
    return [text for number, text in sorted(faults.items()) if number not in recorded]


def _span(recording: Visits, visits: list[Visit]) -> str:
    times = [recording.time_s(visit.start_ns) for visit in visits]
    return f"{min(times):.1f} s and {max(times):.1f} s" if times else "nowhere"
