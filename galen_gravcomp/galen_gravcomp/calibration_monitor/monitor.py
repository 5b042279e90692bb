"""Does the tool's file still fit? Asked live, while the arm stands and nobody touches the tool.

Still windows (`galen_model.rest.windows`) of what goes out are put together to stops
(`galen_gravcomp.calibration_monitor.rest_segments`). The last stops are judged together
(`galen_gravcomp.calibration_monitor.evidence`), the newest few and all that are remembered, since
what is wrong may be new. What is likelier than a file that fits by `_SURE` is said, if it also
leaves more than the limits of `galen_gravcomp.evaluate.residual_decomposition`: an error too small
to matter is no warning. A hand that never lets go leaves something else at each stop, as a cable
does; so such errors are said only where what poses near each other leave is alike, as no hand's is
(`galen_gravcomp.calibration_monitor.pull`).

One pose alone can't tell a hand from what is wrong, so that waits for `_LONE_S` of standing without
a tremble; then it is a load if the force is along gravity, drift if the reading crept there, and
else contact: a collision, something that leans on the tool, a hand that does not tremble.

It recovers by itself: a newer stop that fits, and that what was said had foretold otherwise, is
contradiction; everything older is dropped. So is everything at a change of tool or driver. A tare
changes what goes out by a known offset, by which what is remembered is moved.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from itertools import islice

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.evidence.verdict import (
    MESSAGES,
    Cause,
    Limits,
    Verdict,
    load_text,
    wrench_text,
)
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.windows import StillWindows

from galen_gravcomp.calibration_monitor.evidence import FitEvidence, Judgement
from galen_gravcomp.calibration_monitor.pull import log_density_of_pull, log_odds_of_pull
from galen_gravcomp.calibration_monitor.rest_segments import REMEMBERED, Stop, StopMemory, as_arrays

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
_NOT_JUDGED = Verdict(Cause.UNKNOWN)


class CalibrationMonitor:
    """Judges a calibration by the rest segments of what goes out."""

    def __init__(self, limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        self._windows = StillWindows()
        self._evidence: FitEvidence | None = None
        self._tool: CalibrationFile | None = None
        self._work: Iterator[None]
        self._forget()

    @property
    def verdict(self) -> Verdict:
        """What it says now."""
        return self._verdict

    @property
    def trouble(self) -> str:
        """Why the file seems not to fit, empty while nothing says so."""
        return self._verdict.text

    def values(self) -> dict[str, object]:
        """What it says, for /diagnostics."""
        verdict = self._verdict
        return {
            "fit": verdict.fits,
            "fit_reason": verdict.cause.word if verdict.text else "",
            "fit_stops": verdict.blocks,
            "fit_log_odds": verdict.log_odds,
        }

    # Samples

    def set_tool(self, tool: CalibrationFile | None) -> None:
        """Watch another tool; what was seen is forgotten."""
        self._tool = tool
        self._evidence = None if tool is None else FitEvidence(tool)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._windows.clear()
        self._forget()

    def offset_changed(self, change: Array) -> None:
        """From now on `change` (6,) more is taken off than before, by a tare."""
        self._windows.drop()
        self._memory.shift(change)
        stops = list(self._memory.stops)
        if stops:
            self._refit(stops)
            self._work = self._judge()

    def push(self, stamp_ns: int, roll_rad: float, tilt_rad: float, output: Array) -> None:
        """Take a wrench (6,) as it goes out, and the angles at its stamp."""
        if self._evidence is None:
            return
        window = self._windows.push(stamp_ns, roll_rad, tilt_rad, output)
        if window is None:
            # One piece a sample, so that no sample waits for all of it.
            self._work_on(1)
            return
        self._work_on(None)
        if not window.steady:
            self._memory.interrupt()
            return
        stop = self._memory.add(window)
        self._refit([stop])
        # With 2, 4, 8, ... windows: what a stop says changes little from one to the next.
        if stop.windows >= 2 and stop.windows & (stop.windows - 1) == 0:
            self._work = self._judge()

    # Inside

    def _forget(self) -> None:
        self._memory = StopMemory()
        self._verdict = _NOT_JUDGED
        self._judgement: Judgement | None = None
        self._work = iter(())

    def _work_on(self, pieces: int | None) -> None:
        """Go on with the judgement at work, by some pieces; None: to its end."""
        for _ in islice(self._work, pieces):
            pass

    def _refit(self, stops: list[Stop]) -> None:
        """Say of each stop on its own whether it fits, and whether it is touched."""
        assert self._evidence is not None
        arrays = as_arrays(stops)
        square, log_density = self._evidence.fit_of_each(arrays)
        log_touched = self._evidence.log_touched(arrays) - log_density
        for stop, distance, touched in zip(stops, square, log_touched, strict=True):
            stop.fits = bool(distance < _FITS)
            stop.fitted |= stop.fits
            stop.log_touched = float(touched)

    # Judgement

    def _judge(self) -> Iterator[None]:
        newest = self._memory.stops[-1]
        self._drop_contradicted(newest)
        yield
        found = yield from self._likeliest()
        if found is not None:
            self._judgement, self._verdict = found
        elif newest.fits or self._verdict.text:
            self._judgement = None
            self._verdict = Verdict(Cause.FITS, blocks=len(self._memory.stops))

    def _drop_contradicted(self, newest: Stop) -> None:
        """Drop what is older than stops that fit, where what was said foretold otherwise."""
        if not newest.fits or not self._verdict.text:
            return
        judgement = self._judgement
        if judgement is None:  # a contact, which is over
            self._memory.keep([newest])
            return
        assert self._evidence is not None
        # An error of its own at each stop forbids no stop that fits, but makes several unlikely.
        count = _NEWEST if judgement.explanation is Cause.UNEXPLAINED else 1
        against = list(self._memory.stops)[-count:]
        odds = self._evidence.log_contradiction(as_arrays(against), judgement)
        if all(stop.fits for stop in against) and odds.sum() > _CONTRADICTION:
            self._memory.keep(against)

    def _likeliest(
        self,
    ) -> Generator[None, None, tuple[Judgement | None, Verdict] | None]:
        """What is wrong, if something is: by the fewest of the newest stops that tell of it."""
        assert self._evidence is not None and self._tool is not None
        stops = self._judged
        if not stops:  # a tare in the first moments of the first stop, or of one that it leaves
            return None
        newest = stops[-1]
        lone = newest.lasts_s >= _LONE_S
        for count in sorted({1 if lone else _NEWEST, _NEWEST, REMEMBERED}):
            some = stops[-count:]
            judgement = yield from self._evidence.judge(as_arrays(some))
            yield
            if self._worth_saying(judgement, some):
                yield
                self._keep(some, judgement)
                yield
                # A few poses near each other fit any load: the reason is what all of them say.
                kept = self._judged
                whole = yield from self._evidence.judge(as_arrays(kept))
                yield
                if self._worth_saying(whole, kept):
                    judgement, some = whole, kept
                yield
                pulled = self._may_be_pulled(judgement, some)
                return judgement, _said(judgement, self._tool, self._limits, pulled)
            if len(some) < count:
                break
            yield
        if lone and newest.log_touched > _SURE:
            return None, _contact(newest)
        return None

    @property
    def _judged(self) -> list[Stop]:
        return [stop for stop in self._memory.stops if stop.windows >= 2]

    def _keep(self, some: list[Stop], judgement: Judgement) -> None:
        """Drop stops before `some` that fit and so contradict what is said now: it is new."""
        assert self._evidence is not None
        others = [stop for stop in self._memory.stops if stop not in some]
        if not others or judgement.explanation is Cause.UNEXPLAINED:
            return
        odds = self._evidence.log_contradiction(as_arrays(others), judgement)
        kept = [
            stop
            for stop, value in zip(others, odds, strict=True)
            if value <= _CONTRADICTION or not stop.fits
        ]
        self._memory.keep(kept + some)

    def _worth_saying(self, judgement: Judgement, stops: list[Stop]) -> bool:
        what = judgement.explanation
        if what is Cause.FITS or judgement.log_odds < _SURE:
            return False
        if what is Cause.UNEXPLAINED and len(stops) <= _NEWEST:
            return False
        if np.all(judgement.beyond <= self._limits.axes):
            return False
        counted = _counted(judgement, stops)
        if not counted or 2 * len(counted) < len(stops):
            return False
        # Stops that fit were before it; those that nothing explains were pushes, as more may be.
        pushes = sum(not stop.fits for stop in stops if stop not in counted)
        if what is Cause.UNEXPLAINED:
            return self._is_of_the_pose(counted, len(stops))
        if len(counted) >= _FEWEST[what] + pushes:
            return True
        lone = counted[-1].lasts_s >= _LONE_S
        crept = what is Cause.DRIFT and counted[-1].fitted
        return crept or (lone and what is Cause.LOAD)

    def _is_of_the_pose(self, counted: list[Stop], of: int) -> bool:
        """Whether errors of each stop's own can't be pushes, which look like that as well."""
        assert self._evidence is not None
        counted = [stop for stop in counted if not stop.stepped]
        if len(counted) < _FEWEST[Cause.UNEXPLAINED] or 2 * len(counted) < of:
            return False
        arrays = as_arrays(counted)
        return log_odds_of_pull(arrays, self._evidence.variance(arrays)) > _SURE

    def _may_be_pulled(self, judgement: Judgement, stops: list[Stop]) -> bool:
        """Whether a cable that pulls explains nearly as well what is called a load or a drift."""
        assert self._evidence is not None
        arrays = as_arrays(_counted(judgement, stops))
        pull = log_density_of_pull(arrays, self._evidence.variance(arrays))
        own = self._evidence.log_density_of(judgement.explanation, arrays)
        return pull > own - _CONTRADICTION


def _counted(judgement: Judgement, stops: list[Stop]) -> list[Stop]:
    return [stop for stop, out in zip(stops, judgement.touched, strict=True) if not out]


def _said(judgement: Judgement, tool: CalibrationFile, limits: Limits, pulled: bool) -> Verdict:
    """What a judgement says; pulled: a cable's pull may look like that, too."""
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
    count = int(np.count_nonzero(~judgement.touched))
    plural = "" if count == 1 else "s"
    size = limits.worst(judgement.beyond)
    text = f"its file does not fit, {size} too much in {count} rest segment{plural}: {why}"
    return Verdict(cause, text, count, judgement.log_odds)


def _load(judgement: Judgement, tool: CalibrationFile) -> tuple[Cause, str]:
    more, std = float(judgement.load[0]), float(judgement.load_std[0])
    own = float(tool.load.mass_kg)
    if abs(own + more) < max(3.0 * std, 0.1 * own):
        return Cause.NO_TOOL, load_text(more, std)
    if own + more <= 0.0:
        return Cause.LOAD, load_text(more, std)
    centre = (own * tool.load.com_m + judgement.load[1:]) / (own + more)
    return Cause.LOAD, load_text(more, std, centre - tool.load.com_m)


def _contact(stop: Stop) -> Verdict:
    """A lone stop's wrench that is neither a load's nor a hand's."""
    details = (
        f"{wrench_text(stop.mean)} for {stop.lasts_s:.0f} s without a tremble, and not along"
        " gravity: a collision, or something that leans on the tool"
    )
    return Verdict(Cause.CONTACT, MESSAGES[Cause.CONTACT].text(details), 1, stop.log_touched)
