# SPDX-License-Identifier: Apache-2.0
"""Does the calibration file still fit? Asked live, while the arm is at rest without contact.

Windows at rest (`galen_model.rest.windows`) of what goes out are put together to rest segments: one
pose, one steady wrench. A window that is not steady, or that steps away from its segment's mean,
ends the segment; a segment at a place replaces the older one there. The last segments are judged
together (`galen_gravcomp.evidence`), the newest few and all that are remembered, since what is
wrong may be new. A cause that is likelier than a file that fits by `_SURE` is reported, if it also
leaves more than the limits of `galen_gravcomp.evaluate.residual`: an error too small to matter is
no warning. A hand that never lets go leaves another wrench at each segment, as a cable does; so
such errors are reported only where the residuals of poses near each other are alike, as no hand's
are.

One pose alone does not distinguish a hand from a wrong file, so that waits for `_LONE_S` at rest
without a tremble; then it is a load if the force is along gravity, drift if the reading crept
there, and else contact: a collision, something that leans on the tool, a hand that does not
tremble.

It recovers by itself: a newer segment that fits, against the verdict's prediction, is a
contradiction; everything older is dropped. So is everything at a change of tool or driver. A tare
changes what goes out by a known offset, by which the remembered segments are moved.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.verdict import (
    MESSAGES,
    Cause,
    Limits,
    Verdict,
    load_text,
    wrench_text,
)
from galen_model.rest.windows import StillWindow, StillWindows

from galen_gravcomp.evidence import FitEvidence, Judgement, Segments
from galen_gravcomp.setup_verification import SetupVerification

_NEWEST = 4
_LONE_S = 15.0
_SURE = 9.2  # a factor of ten thousand
_CONTRADICTION = 4.6  # of a hundred
_FITS = float(chi2_ppf(0.999, 6))
_FEWEST = {
    Cause.LOAD: 2,
    Cause.DRIFT: 3,
    Cause.LOOSE_TOOL: 4,
    Cause.UNEXPLAINED: 6,
}
REMEMBERED = 16
_OLDEST_NS = 1_800_000_000_000
_SAME_PLACE = 0.1
"""Chord between gravity's unit vectors, rad: segments nearer than that are at one place."""
_SAME_POSE = 0.005
_STEP_SIGMAS = 6.0
_STEP_FLOOR = np.repeat([0.02, 5e-4], 3)
_SOON_NS = 2_000_000_000


@dataclass(eq=False)
class RestSegment:
    """A pose with one steady wrench.

    stepped: it began by a step of the wrench where the arm was at rest, as a push does;
    fits: by chi-square; fitted: it did once; log_contact: log odds of contact against a fit.
    """

    gravity: Array
    angles: tuple[float, ...]
    mean: Array
    std: Array
    start_ns: int
    end_ns: int
    windows: int = 1
    stepped: bool = False
    fits: bool = False
    fitted: bool = False
    log_contact: float = 0.0
    recent: deque[Array] = field(default_factory=lambda: deque(maxlen=4))

    @property
    def lasts_s(self) -> float:
        """Duration so far."""
        return (self.end_ns - self.start_ns) * 1e-9


class SegmentMemory:
    """The last segments, oldest first."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.segments: deque[RestSegment] = deque()
        self._open = False

    def interrupt(self) -> None:
        """End the newest segment: a window was not steady."""
        self._open = False

    def keep(self, segments: Sequence[RestSegment]) -> None:
        """Forget all others.

        Args:
            segments: the ones that stay, oldest first.

        """
        self.segments = deque(segments)

    def shift(self, change: Array) -> None:
        """Move the means of all segments, as a tare moves what goes out.

        Args:
            change: (6,) to subtract, N and N.m.

        """
        for segment in self.segments:
            segment.mean = segment.mean - change
            segment.recent.clear()
            segment.fitted = False

    def add(self, window: StillWindow) -> RestSegment:
        """Add a window to the newest segment, or begin another.

        Args:
            window: a steady one, later than all before.

        Returns:
            The segment that it belongs to.

        """
        unit = np.asarray(self._arm.gravity_in_sensor(window.angles))
        unit = unit / np.linalg.norm(unit)
        segment = self.segments[-1] if self.segments and self._open else None
        if segment is not None and _goes_on(segment, window, unit):
            count = min(segment.windows, 20)  # old windows of a long segment count less and less
            segment.mean = segment.mean + (window.mean - segment.mean) / (count + 1)
            segment.std = window.std_of_mean / np.sqrt(count + 1)
            segment.end_ns, segment.windows = window.end_ns, segment.windows + 1
        else:
            segment = RestSegment(
                unit, window.angles, window.mean, window.std_of_mean, window.start_ns, window.end_ns
            )
            segment.stepped = bool(self.segments) and _near(self.segments[-1], window, unit)
            self._begin(segment)
        segment.recent.append(window.mean)
        self._open = True
        return segment

    def _begin(self, segment: RestSegment) -> None:
        oldest_ns = segment.end_ns - _OLDEST_NS
        kept = [
            other
            for other in self.segments
            if other.end_ns >= oldest_ns
            and other.windows >= 2
            and np.linalg.norm(other.gravity - segment.gravity) >= _SAME_PLACE
        ]
        self.segments = deque(kept[-(REMEMBERED - 1) :])
        self.segments.append(segment)


def _as_arrays(segments: Sequence[RestSegment]) -> Segments:
    return Segments(
        np.array([segment.mean for segment in segments]),
        np.array([segment.std for segment in segments]),
        np.array([segment.angles for segment in segments]),
        np.array([segment.end_ns for segment in segments]),
    )


def _goes_on(segment: RestSegment, window: StillWindow, unit: Array) -> bool:
    if not _near(segment, window, unit):
        return False
    if not segment.recent:  # a tare just moved it
        return True
    level = np.mean(segment.recent, axis=0)
    allowed = _STEP_SIGMAS * window.std_of_mean * np.sqrt(1.0 + 1.0 / len(segment.recent))
    return bool(np.all(np.abs(window.mean - level) <= allowed + _STEP_FLOOR))


def _near(segment: RestSegment, window: StillWindow, unit: Array) -> bool:
    """Whether a window is at a segment's pose and follows it soon."""
    soon = window.start_ns - segment.end_ns < _SOON_NS
    return soon and float(np.linalg.norm(unit - segment.gravity)) < _SAME_POSE


class CalibrationMonitor:
    """Judges a calibration by the rest segments of what goes out."""

    def __init__(self, limits: Limits | None = None, *, arm: Arm) -> None:
        self._arm = arm
        self._limits = limits or Limits()
        self._windows = StillWindows()
        self.setup = SetupVerification(arm)
        """Whether the set-up is the file's."""
        self._evidence: FitEvidence | None = None
        self._tool: CalibrationFile | None = None
        self._work: Iterator[None]
        self._forget()

    @property
    def trouble(self) -> str:
        """Why the file seems not to fit; empty where it does."""
        return self.verdict.text

    def values(self) -> dict[str, object]:
        """Return the verdict, for /diagnostics."""
        verdict = self.verdict
        return {
            "fit": verdict.fits,
            "fit_reason": verdict.cause.word if verdict.text else "",
            "fit_stops": verdict.blocks,
            "fit_log_odds": verdict.log_odds,
            "setup": self.setup.text,
        }

    # Samples

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Monitor another tool; the segments are forgotten.

        Args:
            tool: its calibration; None: nothing is monitored.

        """
        self._tool = tool
        self._evidence = None if tool is None else FitEvidence(tool, self._arm)
        self.setup.set_tool(tool)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._windows.clear()
        self.setup.clear()
        self._forget()

    def offset_changed(self, change: Array, tare: Array) -> None:
        """Follow a tare, or the bias drift's switch.

        Args:
            change: (6,) what is subtracted from now on more than before, N and N.m.
            tare: (6,) what the tare subtracts from now on, N and N.m.

        """
        self._windows.drop()
        self.setup.offset_changed(change, tare)
        self._memory.shift(change)
        segments = list(self._memory.segments)
        if segments:
            self._refit(segments)
            self._work = self._judge()

    def push(self, stamp_ns: int, angles: tuple[float, ...], output: Array) -> None:
        """Take a sample.

        Args:
            stamp_ns: the wrench's stamp.
            angles: (k,) at that stamp, rad.
            output: (6,) as it goes out when no ramp runs, in the sensor's frame, N and N.m.

        """
        if self._evidence is None:
            return
        self.setup.push(stamp_ns, angles, output)
        window = self._windows.push(stamp_ns, angles, output)
        if window is None:
            # One piece a sample, so that no sample waits for all of it.
            self._work_on(1)
            return
        self._work_on(None)
        if not window.steady:
            self._memory.interrupt()
            return
        segment = self._memory.add(window)
        self.setup.add(window)
        self._refit([segment])
        # With 2, 4, 8, ... windows: what a segment says changes little from one to the next.
        if segment.windows >= 2 and segment.windows & (segment.windows - 1) == 0:
            self._work = self._judge()

    # Inside

    def _forget(self) -> None:
        self._memory = SegmentMemory(self._arm)
        self.verdict = Verdict(Cause.UNKNOWN)
        self._judgement: Judgement | None = None
        self._work = iter(())

    def _work_on(self, pieces: int | None) -> None:
        """Go on with the pending judgement, by some pieces; None: to its end."""
        for _ in islice(self._work, pieces):
            pass

    def _refit(self, segments: list[RestSegment]) -> None:
        """Decide of each segment on its own whether it fits, and whether it is contact."""
        assert self._evidence is not None
        arrays = _as_arrays(segments)
        square, log_density = self._evidence.fit_of_each(arrays)
        log_contact = self._evidence.log_contact(arrays) - log_density
        for segment, distance, touched in zip(segments, square, log_contact, strict=True):
            segment.fits = bool(distance < _FITS)
            segment.fitted |= segment.fits
            segment.log_contact = float(touched)

    # Judgement

    def _judge(self) -> Iterator[None]:
        newest = self._memory.segments[-1]
        self._drop_contradicted(newest)
        yield
        found = yield from self._likeliest()
        if found is not None:
            self._judgement, self.verdict = found
        elif newest.fits or self.verdict.text:
            self._judgement = None
            self.verdict = Verdict(Cause.FITS, blocks=len(self._memory.segments))

    def _drop_contradicted(self, newest: RestSegment) -> None:
        """Drop what is older than segments that fit, against the verdict's prediction."""
        if not newest.fits or not self.verdict.text:
            return
        judgement = self._judgement
        if judgement is None:  # a contact, which is over
            self._memory.keep([newest])
            return
        assert self._evidence is not None
        # An error of its own at each segment allows one that fits, but not several.
        count = _NEWEST if judgement.explanation is Cause.UNEXPLAINED else 1
        against = list(self._memory.segments)[-count:]
        odds = self._evidence.log_contradiction(_as_arrays(against), judgement)
        if all(segment.fits for segment in against) and odds.sum() > _CONTRADICTION:
            self._memory.keep(against)

    def _likeliest(
        self,
    ) -> Generator[None, None, tuple[Judgement | None, Verdict] | None]:
        assert self._evidence is not None and self._tool is not None
        segments = self._judged
        if not segments:  # a tare in a segment's first moments
            return None
        newest = segments[-1]
        lone = newest.lasts_s >= _LONE_S
        for count in sorted({1 if lone else _NEWEST, _NEWEST, REMEMBERED}):
            some = segments[-count:]
            judgement = yield from self._evidence.judge(_as_arrays(some))
            yield
            if self._reportable(judgement, some):
                yield
                self._keep(some, judgement)
                yield
                # A few poses near each other fit any load: the reason is that of all of them.
                kept = self._judged
                whole = yield from self._evidence.judge(_as_arrays(kept))
                yield
                if self._reportable(whole, kept):
                    judgement, some = whole, kept
                yield
                pulled = self._may_be_pulled(judgement, some)
                return judgement, _verdict(judgement, self._tool, self._limits, pulled)
            if len(some) < count:
                break
            yield
        if lone and newest.log_contact > _SURE:
            return None, _contact(newest)
        return None

    @property
    def _judged(self) -> list[RestSegment]:
        return [segment for segment in self._memory.segments if segment.windows >= 2]

    def _keep(self, some: list[RestSegment], judgement: Judgement) -> None:
        """Drop segments before `some` that fit and so contradict the new verdict."""
        assert self._evidence is not None
        others = [segment for segment in self._memory.segments if segment not in some]
        if not others or judgement.explanation is Cause.UNEXPLAINED:
            return
        odds = self._evidence.log_contradiction(_as_arrays(others), judgement)
        kept = [
            segment
            for segment, value in zip(others, odds, strict=True)
            if value <= _CONTRADICTION or not segment.fits
        ]
        self._memory.keep(kept + some)

    def _reportable(self, judgement: Judgement, segments: list[RestSegment]) -> bool:
        what = judgement.explanation
        if what is Cause.FITS or judgement.log_odds < _SURE:
            return False
        if what is Cause.UNEXPLAINED and len(segments) <= _NEWEST:
            return False
        if np.all(judgement.beyond <= self._limits.axes):
            return False
        counted = _counted(judgement, segments)
        if not counted or 2 * len(counted) < len(segments):
            return False
        # Segments that fit were before it; those that nothing explains were pushes, as more may be.
        pushes = sum(not segment.fits for segment in segments if segment not in counted)
        if what is Cause.UNEXPLAINED:
            return self._is_of_the_pose(counted, len(segments))
        if len(counted) >= _FEWEST[what] + pushes:
            return True
        lone = counted[-1].lasts_s >= _LONE_S
        crept = what is Cause.DRIFT and counted[-1].fitted
        return crept or (lone and what is Cause.LOAD)

    def _is_of_the_pose(self, counted: list[RestSegment], of: int) -> bool:
        """Whether errors of each segment's own can't be pushes, which look alike."""
        assert self._evidence is not None
        counted = [segment for segment in counted if not segment.stepped]
        if len(counted) < _FEWEST[Cause.UNEXPLAINED] or 2 * len(counted) < of:
            return False
        arrays = _as_arrays(counted)
        return self._evidence.log_odds_of_pull(arrays) > _SURE

    def _may_be_pulled(self, judgement: Judgement, segments: list[RestSegment]) -> bool:
        """Whether a cable that pulls explains it nearly as well as a load or a drift."""
        assert self._evidence is not None
        arrays = _as_arrays(_counted(judgement, segments))
        pull = self._evidence.log_density_of_pull(arrays)
        own = self._evidence.log_density_of(judgement.explanation, arrays)
        return pull > own - _CONTRADICTION


def _counted(judgement: Judgement, segments: list[RestSegment]) -> list[RestSegment]:
    return [segment for segment, out in zip(segments, judgement.contact, strict=True) if not out]


def _verdict(judgement: Judgement, tool: CalibrationFile, limits: Limits, pulled: bool) -> Verdict:
    cause, details = judgement.explanation, ""
    if cause is Cause.LOAD:
        cause, details = _load(judgement, tool)
    elif cause is Cause.DRIFT:
        details = wrench_text(judgement.offset)
    elif cause is Cause.LOOSE_TOOL:
        details = f"its centre shifts with gravity by {1e3 * abs(judgement.shift_m):.1f} mm"
    why = MESSAGES[cause].text(details)
    if pulled and cause is not Cause.UNEXPLAINED:
        why += "; or a cable that pulls, which looks the same at these poses"
    count = int(np.count_nonzero(~judgement.contact))
    plural = "" if count == 1 else "s"
    size = limits.worst(judgement.beyond)
    text = f"its file does not fit, {size} too much in {count} rest segment{plural}: {why}"
    return Verdict(cause, text, count, judgement.log_odds)


def _load(judgement: Judgement, tool: CalibrationFile) -> tuple[Cause, str]:
    more, std = float(judgement.load[0]), judgement.mass_std_kg
    own = float(tool.load.mass_kg)
    if abs(own + more) < max(3.0 * std, 0.1 * own):
        return Cause.NO_TOOL, load_text(more, std)
    if own + more <= 0.0:
        return Cause.LOAD, load_text(more, std)
    centre = (own * tool.load.com_m + judgement.load[1:]) / (own + more)
    return Cause.LOAD, load_text(more, std, centre - tool.load.com_m)


def _contact(segment: RestSegment) -> Verdict:
    details = (
        f"{wrench_text(segment.mean)} for {segment.lasts_s:.0f} s without a tremble, and not along"
        " gravity: a collision, or something that leans on the tool"
    )
    return Verdict(Cause.CONTACT, MESSAGES[Cause.CONTACT].text(details), 1, segment.log_contact)
