"""The gap, watched live: stops of an untouched arm in a sliding window, tested again and again.

Half-second windows of what the file's load leaves come from `galen_model.rest.windows`, which
says whether the wrench trembled as a hand does. Those that didn't are put together to stops. Where
the wrench jumps while the arm stands, a hand (or anything else) has come: until the arm moves or
the wrench is back, nothing counts. `galen_diagnosis.monitor.gap_statistic` tests the last stops.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.files.calibration_file import ToolFile
from galen_model.load.model import gravity_regressor
from galen_model.rest.windows import WINDOW_S, StillWindow, StillWindows

from galen_diagnosis.experiment.trial import moment_covariances
from galen_diagnosis.monitor.gap_statistic import (
    LONGEST,
    GapTest,
    Scatter,
    WindowNoise,
    gap_test,
    window_noise,
)

_NEXT_WINDOW_S = 0.2
_SAME_POSE_RAD = 0.003
_JUMP_SIGMAS = 6.0
_NOISE_STOPS = 400
_FEWEST_FREEDOM = 30
_FEWEST_STOPS = 5
_MOST_STOPS = 60
_CLEARED = 0.01
_CHANNEL_SURE = 0.001
_CLEARED_LOOKS = 3


def _by_axis(force_n: float, torque_nm: float) -> Array:
    return np.repeat([force_n, torque_nm], 3)


@dataclass(frozen=True)
class GapSettings:
    """window_s: untouched time at rest that is tested; max_age_s: nothing older counts.

    false_alarms_per_hour: of a healthy arm, at most; look_s: time between tests. floor_n, floor_nm:
    standard deviation from stop to stop that a healthy arm has beside the noise.
    """

    window_s: float = 60.0
    max_age_s: float = 600.0
    look_s: float = 10.0
    false_alarms_per_hour: float = 0.05
    floor_n: float = 5e-4
    floor_nm: float = 2e-5

    @property
    def alarm_probability(self) -> float:
        """What a look without a gap may be as odd as (Bonferroni over an hour's looks)."""
        return self.false_alarms_per_hour * self.look_s / 3600.0


class GapNotice(Enum):
    """What is said."""

    LEARNING = "learning"  # the noise isn't known yet
    WAITING = "waiting"  # too few untouched stops
    NO_GAP = "no_gap"
    GAP = "gap"


@dataclass
class GapStop:
    """A stay, or a part of one, that nobody touched: joints (5,), windows' means."""

    start_ns: int
    end_ns: int
    joints: Array
    means: list[Array] = field(default_factory=list)

    @property
    def mean(self) -> Array:
        """(6,), N and N.m."""
        return np.asarray(np.mean(self.means, axis=0))


@dataclass(frozen=True)
class GapState:
    """What the last look said; since_ns: the stamp at which a gap was first seen, else None.

    at_ns: its stamp; stops, test: what it was said of; noise: of a window.
    """

    notice: GapNotice
    stops: tuple[GapStop, ...] = ()
    test: GapTest | None = None
    noise: WindowNoise | None = None
    since_ns: int | None = None
    at_ns: int = 0

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels in which the gap shows by itself."""
        if self.notice is not GapNotice.GAP or self.test is None:
            return ()
        sure = self.test.channel_probability < _CHANNEL_SURE
        return tuple(axis for axis, yes in zip(WRENCH_AXES, sure, strict=True) if yes)

    @property
    def poses(self) -> int:
        """Different poses among the stops."""
        return count_poses([stop.joints for stop in self.stops])


class GapWatch:
    """Takes residuals sample by sample; `state` is what the last look said."""

    def __init__(self, settings: GapSettings | None = None) -> None:
        self.settings = settings or GapSettings()
        self._floor = _by_axis(self.settings.floor_n, self.settings.floor_nm) ** 2
        self._known: Array | None = None
        self.clear()

    def set_tool(self, tool: ToolFile | None) -> None:
        """Another tool is on: forget all."""
        self._known = None
        if tool is not None:
            of_tool, of_adapter = moment_covariances(tool)
            self._known = of_tool + of_adapter
        self.clear()

    def clear(self) -> None:
        """Forget stops and noise."""
        self._windows = StillWindows()
        self._stops: deque[GapStop] = deque()
        self._scatters: deque[Scatter] = deque(maxlen=_NOISE_STOPS)
        self._open: GapStop | None = None
        self._level: Array | None = None
        self._skip = False
        self._pose = np.zeros(5)
        self._last_ns = 0
        self._look_ns = 0
        self._first_odd_ns: int | None = None
        self._calm_looks = 0
        self.state = GapState(GapNotice.LEARNING)

    def push(self, stamp_ns: int, joints: Sequence[float], residual: Array) -> bool:
        """Take a residual (6,) with joints (5,) at its stamp; whether a look was taken."""
        window = self._windows.push(stamp_ns, joints[3], joints[4], residual)
        if window is None:
            return False
        return self.take(window, np.array(joints))

    def take(self, window: StillWindow, joints: Array) -> bool:
        """Take a window at rest; whether a look was taken."""
        self._place(window, joints)
        settings = self.settings
        if window.end_ns - self._look_ns < settings.look_s * 1e9:
            return False
        self._look_ns = window.end_ns
        self._look(window.end_ns)
        return True

    # --- stops ----------------------------------------------------------------------------------

    def _place(self, window: StillWindow, joints: Array) -> None:
        """Put a window to the stop that it belongs to, unless it may be touched."""
        if window.start_ns - self._last_ns > _NEXT_WINDOW_S * 1e9 or self._moved(joints):
            self._close()
            self._level, self._skip, self._pose = None, False, joints
        self._last_ns = window.end_ns
        if not window.steady:
            # Its neighbours hold a part of the hand that comes or goes.
            self._close(without_last=True)
            self._skip = True
        elif self._skip:
            self._skip = False
        elif self._level is None or not self._jumped(window, self._level):
            if self._open is None:
                self._open = GapStop(window.start_ns, window.end_ns, joints)
            self._open.means.append(window.mean)
            self._open.end_ns = window.end_ns
            self._level = self._open.mean
            if len(self._open.means) == LONGEST:
                self._close()
        else:
            self._close()

    def _moved(self, joints: Array) -> bool:
        return bool(np.abs(joints[3:] - self._pose[3:]).max() > _SAME_POSE_RAD)

    def _jumped(self, window: StillWindow, level: Array) -> bool:
        allowed = _JUMP_SIGMAS * window.std_of_mean * np.sqrt(2.0) + 3.0 * np.sqrt(self._floor)
        return bool(np.any(np.abs(window.mean - level) > allowed))

    def _close(self, without_last: bool = False) -> None:
        stop, self._open = self._open, None
        if stop is not None and without_last:
            stop.means.pop()
        if stop is None or not stop.means:
            return
        self._stops.append(stop)
        if len(stop.means) > 1:
            self._scatters.append(Scatter.of(np.array(stop.means)))

    # --- looks ----------------------------------------------------------------------------------

    def _look(self, now_ns: int) -> None:
        self._drop_old(now_ns)
        noise = window_noise(self._scatters, 1e-2 * self._floor)
        stops = tuple(self._stops)
        if noise.freedom < _FEWEST_FREEDOM:
            self.state = GapState(GapNotice.LEARNING, stops, None, noise, None, now_ns)
            return
        if len(stops) < _FEWEST_STOPS:
            if self.state.notice is not GapNotice.GAP:
                self.state = GapState(GapNotice.WAITING, stops, None, noise, None, now_ns)
            return
        test = gap_test(
            np.array([s.mean for s in stops]), self.variances(stops, noise), noise.freedom
        )
        self._decide(test, stops, noise, now_ns)

    def variances(self, stops: Sequence[GapStop], noise: WindowNoise) -> Array:
        """Of the stops' means (k, 6) without a gap: noise, floor, what the file doesn't know."""
        variance = np.array([noise.of_mean(len(stop.means)) for stop in stops]) + self._floor
        if self._known is not None:
            angles = np.array([stop.joints[3:] for stop in stops])
            rows = gravity_regressor(gravity_in_sensor(angles[:, 0], angles[:, 1]))
            rows = rows - rows.mean(axis=0)  # the mean is the sensor's zero
            variance += np.einsum("kip,pq,kiq->ki", rows, self._known, rows)
        return variance

    def _decide(
        self, test: GapTest, stops: tuple[GapStop, ...], noise: WindowNoise, now_ns: int
    ) -> None:
        odd = test.probability < _CLEARED
        was_gap = self.state.notice is GapNotice.GAP
        if odd and self._first_odd_ns is None:
            self._first_odd_ns = now_ns
        self._calm_looks = 0 if odd else self._calm_looks + 1
        if test.probability < self.settings.alarm_probability or (
            was_gap and self._calm_looks < _CLEARED_LOOKS
        ):
            notice = GapNotice.GAP
        else:
            notice = GapNotice.NO_GAP
            if not odd:
                self._first_odd_ns = None
        since = self._first_odd_ns if notice is GapNotice.GAP else None
        self.state = GapState(notice, stops, test, noise, since, now_ns)

    def _drop_old(self, now_ns: int) -> None:
        oldest_ns = now_ns - round(self.settings.max_age_s * 1e9)
        while self._stops and self._stops[0].end_ns < oldest_ns:
            self._stops.popleft()
        most = self.settings.window_s / WINDOW_S
        while len(self._stops) > _MOST_STOPS or (
            len(self._stops) > _FEWEST_STOPS and sum(len(s.means) for s in self._stops) > most
        ):
            self._stops.popleft()


def count_poses(joints: Sequence[Array]) -> int:
    """How many of the poses differ by more than the joints' noise."""
    different: list[Array] = []
    for pose in joints:
        if all(np.abs(pose[3:] - other[3:]).max() > 10 * _SAME_POSE_RAD for other in different):
            different.append(pose)
    return len(different)
