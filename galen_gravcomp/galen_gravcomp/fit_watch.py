"""Does the tool's file still fit? Asked live, while the arm stands and nobody touches the tool.

Still windows (`galen_gravcomp.still_windows`) of what goes out are put together to stops: one pose,
one steady wrench. A window that is not steady, or that steps away from its stop's mean, ends the
stop; a stop at a place replaces the older one there. The last stops are judged together
(`galen_gravcomp.fit_evidence`), the newest few and all that are remembered, since what is wrong may
be new. What is likelier than a file that fits by `_SURE` is said, if it also leaves more than the
limits of `galen_gravcomp.misfit`: an error too small to matter is no warning.

One pose alone can't tell a hand from what is wrong, so that waits for `_LONE_S` of standing without
a tremble; then it is a load if the force is along gravity, drift if the reading crept there, and
else contact: a collision, something that leans on the tool, a hand that does not tremble.

It recovers by itself: a newer stop that fits, and that what was said had foretold otherwise, is
contradiction; everything older is dropped. So is everything at a change of tool or driver. A tare
changes what goes out by a known offset, by which what is remembered is moved.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from galen_model.arrays import Array
from galen_model.kinematics import gravity_in_sensor
from galen_model.tool_file import ToolFile
from scipy.stats import chi2

from galen_gravcomp import fit_words as words
from galen_gravcomp.fit_evidence import Explanation, FitEvidence, Judgement, Stops
from galen_gravcomp.fit_words import FitNotice, FitState
from galen_gravcomp.misfit import Limits
from galen_gravcomp.still_windows import StillWindow, StillWindows

_REMEMBERED = 16
_NEWEST = 4
_OLDEST_NS = 1_800_000_000_000
_SAME_PLACE = 0.1
"""Chord between gravity's unit vectors, rad: stops nearer than that are at one place."""
_SAME_POSE = 0.005
_STEP_SIGMAS = 6.0
_STEP_FLOOR = np.repeat([0.02, 5e-4], 3)
_STOP_NS = 2_000_000_000
_LONE_S = 15.0
_SURE = 9.2  # a factor of ten thousand
_CONTRADICTION = 4.6  # of a hundred
_FITS = float(chi2.ppf(0.999, 6))
_FEWEST = {
    Explanation.LOAD: 2,
    Explanation.DRIFT: 3,
    Explanation.LOOSE: 4,
    Explanation.UNKNOWN: 6,
}


_NOT_JUDGED = FitState(FitNotice.NOT_JUDGED)


@dataclass(eq=False)
class _Stop:
    """A pose with one steady wrench.

    stepped: it began by a step of the wrench where the arm stood, as a push does;
    fits: by chi-square; fitted: it did once; log_touched: log odds of a touch against a fit.
    """

    gravity: Array
    angles: tuple[float, float]
    mean: Array
    std: Array
    start_ns: int
    end_ns: int
    windows: int = 1
    stepped: bool = False
    fits: bool = False
    fitted: bool = False
    log_touched: float = 0.0
    recent: deque[Array] = field(default_factory=lambda: deque(maxlen=4))

    @property
    def lasts_s(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9


class GravityFitWatch:
    """A `galen_gravcomp.stages.FitWatch`."""

    def __init__(self, limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        self._windows = StillWindows()
        self._evidence: FitEvidence | None = None
        self._tool: ToolFile | None = None
        self._forget()

    @property
    def state(self) -> FitState:
        """What it says now."""
        return self._state

    @property
    def trouble(self) -> str:
        """Why the file seems not to fit, empty while nothing says so."""
        return self._state.sentence

    def values(self) -> dict[str, object]:
        """What it says, for /diagnostics."""
        state = self._state
        return {
            "fit": state.notice.value,
            "fit_reason": "" if state.reason is None else state.reason.value,
            "fit_stops": state.stops,
            "fit_log_odds": state.log_odds,
        }

    # Samples

    def set_tool(self, tool: ToolFile | None) -> None:
        """Watch another tool; what was seen is forgotten."""
        self._tool = tool
        self._evidence = None if tool is None else FitEvidence(tool)
        self.clear("")

    def clear(self, why: str) -> None:
        """Forget everything."""
        del why
        self._windows.clear()
        self._forget()

    def offset_changed(self, change: Array) -> None:
        """From now on `change` (6,) more is taken off than before, by a tare."""
        self._windows.drop()
        for stop in self._stops:
            stop.mean = stop.mean - change
            stop.recent.clear()
            stop.fitted = False
        if self._stops:
            self._refit(list(self._stops))
            self._judge()

    def push(self, stamp_ns: int, roll_rad: float, tilt_rad: float, output: Array) -> None:
        """Take a wrench (6,) as it goes out, and the angles at its stamp."""
        if self._evidence is None:
            return
        window = self._windows.push(stamp_ns, roll_rad, tilt_rad, output)
        if window is None:
            return
        if not window.steady:
            self._open = False
            return
        if self._add(window):
            self._judge()

    # Stops

    def _forget(self) -> None:
        self._stops: deque[_Stop] = deque()
        self._open = False
        self._state = _NOT_JUDGED
        self._judgement: Judgement | None = None

    def _add(self, window: StillWindow) -> bool:
        """Put a window to the newest stop, or begin another; whether there is enough of it."""
        unit = np.asarray(gravity_in_sensor(*window.angles))
        unit = unit / np.linalg.norm(unit)
        stop = self._stops[-1] if self._stops and self._open else None
        if stop is not None and self._goes_on(stop, window, unit):
            count = min(stop.windows, 20)  # old windows of a long stop count less and less
            stop.mean = stop.mean + (window.mean - stop.mean) / (count + 1)
            stop.std = window.std_of_mean / np.sqrt(count + 1)
            stop.end_ns, stop.windows = window.end_ns, stop.windows + 1
        else:
            stop = _Stop(
                unit, window.angles, window.mean, window.std_of_mean, window.start_ns, window.end_ns
            )
            if self._stops:
                last = self._stops[-1]
                stop.stepped = self._near(last, window, unit)
            self._begin(stop)
        stop.recent.append(window.mean)
        self._open = True
        self._refit([stop])
        # With 2, 4, 8, ... windows: what a stop says changes little from one to the next.
        return stop.windows >= 2 and stop.windows & (stop.windows - 1) == 0

    def _goes_on(self, stop: _Stop, window: StillWindow, unit: Array) -> bool:
        if not self._near(stop, window, unit):
            return False
        if not stop.recent:  # a tare just moved it
            return True
        level = np.mean(stop.recent, axis=0)
        allowed = _STEP_SIGMAS * window.std_of_mean * np.sqrt(1.0 + 1.0 / len(stop.recent))
        return bool(np.all(np.abs(window.mean - level) <= allowed + _STEP_FLOOR))

    def _near(self, stop: _Stop, window: StillWindow, unit: Array) -> bool:
        """Whether a window is at a stop's pose and follows it soon."""
        soon = window.start_ns - stop.end_ns < _STOP_NS
        return soon and float(np.linalg.norm(unit - stop.gravity)) < _SAME_POSE

    def _begin(self, stop: _Stop) -> None:
        oldest_ns = stop.end_ns - _OLDEST_NS
        kept = [
            other
            for other in self._stops
            if other.end_ns >= oldest_ns
            and other.windows >= 2
            and np.linalg.norm(other.gravity - stop.gravity) >= _SAME_PLACE
        ]
        self._stops = deque(kept[-(_REMEMBERED - 1) :])
        self._stops.append(stop)

    def _as_stops(self, stops: list[_Stop]) -> Stops:
        return Stops(
            np.array([stop.mean for stop in stops]),
            np.array([stop.std for stop in stops]),
            np.array([stop.angles for stop in stops]),
            np.array([stop.end_ns for stop in stops]),
        )

    def _refit(self, stops: list[_Stop]) -> None:
        """Say of each stop on its own whether it fits, and whether it is touched."""
        assert self._evidence is not None
        arrays = self._as_stops(stops)
        square, log_density = self._evidence.fit_of_each(arrays)
        log_touched = self._evidence.log_touched(arrays) - log_density
        for stop, distance, touched in zip(stops, square, log_touched, strict=True):
            stop.fits = bool(distance < _FITS)
            stop.fitted |= stop.fits
            stop.log_touched = float(touched)

    # Judgement

    def _judge(self) -> None:
        newest = self._stops[-1]
        self._drop_contradicted(newest)
        found = self._likeliest()
        if found is not None:
            self._judgement, self._state = found
        elif newest.fits or self._state.notice is FitNotice.DOES_NOT_FIT:
            self._judgement = None
            self._state = FitState(FitNotice.FITS, stops=len(self._stops))

    def _drop_contradicted(self, newest: _Stop) -> None:
        """Drop what is older than stops that fit, where what was said foretold otherwise."""
        if not newest.fits or self._state.notice is not FitNotice.DOES_NOT_FIT:
            return
        judgement = self._judgement
        if judgement is None:  # a contact, which is over
            self._stops = deque([newest])
            return
        assert self._evidence is not None
        # An error of its own at each stop forbids no stop that fits, but makes several unlikely.
        count = _NEWEST if judgement.explanation is Explanation.UNKNOWN else 1
        against = list(self._stops)[-count:]
        odds = self._evidence.log_contradiction(self._as_stops(against), judgement)
        if all(stop.fits for stop in against) and odds.sum() > _CONTRADICTION:
            self._stops = deque(against)

    def _likeliest(self) -> tuple[Judgement | None, FitState] | None:
        """What is wrong, if something is: by the fewest of the newest stops that tell of it."""
        assert self._evidence is not None and self._tool is not None
        stops = [stop for stop in self._stops if stop.windows >= 2]
        newest = stops[-1]
        lone = newest.lasts_s >= _LONE_S
        for count in sorted({1 if lone else _NEWEST, _NEWEST, _REMEMBERED}):
            some = stops[-count:]
            judgement = self._evidence.judge(self._as_stops(some))
            if self._worth_saying(judgement, some):
                self._keep(some, judgement)
                # A few poses near each other fit any load: the reason is what all of them say.
                kept = [stop for stop in self._stops if stop.windows >= 2]
                whole = self._evidence.judge(self._as_stops(kept))
                if self._worth_saying(whole, kept):
                    judgement = whole
                return judgement, words.misfit(judgement, self._tool, self._limits)
            if len(some) < count:
                break
        if lone and newest.log_touched > _SURE:
            return None, words.contact(newest.mean, newest.lasts_s, newest.log_touched)
        return None

    def _keep(self, some: list[_Stop], judgement: Judgement) -> None:
        """Drop stops before `some` that fit and so contradict what is said now: it is new."""
        assert self._evidence is not None
        others = [stop for stop in self._stops if stop not in some]
        if not others or judgement.explanation is Explanation.UNKNOWN:
            return
        odds = self._evidence.log_contradiction(self._as_stops(others), judgement)
        kept = [
            stop
            for stop, value in zip(others, odds, strict=True)
            if value <= _CONTRADICTION or not stop.fits
        ]
        self._stops = deque(kept + some)

    def _worth_saying(self, judgement: Judgement, stops: list[_Stop]) -> bool:
        what = judgement.explanation
        if what is Explanation.FITS or judgement.log_odds < _SURE:
            return False
        if what is Explanation.UNKNOWN and len(stops) <= _NEWEST:
            return False
        if np.all(judgement.beyond <= self._limits.axes):
            return False
        counted = [stop for stop, out in zip(stops, judgement.touched, strict=True) if not out]
        if not counted or 2 * len(counted) < len(stops):
            return False
        if what is Explanation.UNKNOWN:
            # Pushes on most stops look like that as well.
            counted = [stop for stop in counted if not stop.stepped]
            return len(counted) >= _FEWEST[what] and 2 * len(counted) >= len(stops)
        if len(counted) >= _FEWEST[what]:
            return True
        lone = counted[-1].lasts_s >= _LONE_S
        crept = what is Explanation.DRIFT and counted[-1].fitted
        return crept or (lone and what is Explanation.LOAD)
