"""Whether the tool is left alone and its marker seen, at the start of a set.

By the rule that reading the recording goes by later (`arm_positions.load_phases`), and by a limit
of its own: a hand that trembles makes its own noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from galen_model.arrays import Array
from galen_model.registration.rigid import Transform, mean_pose
from galen_ros.goal.stamps import NS

from galen_deflection.measurement.arm_positions import UnloadedSettings, load_phases, noise_of_mean

_LEAST_POSES = 10


@dataclass(frozen=True)
class UntouchedSettings:
    """When the tool counts as left alone.

    For `duration_s` of stamps the wrench's mean over a tenth of a second stays within `tolerance`
    (6,) (N, N.m) of what it is, and both markers are seen without a gap of more than `max_gap_s`.
    """

    duration_s: float
    tolerance: Array
    max_gap_s: float
    unloaded: UnloadedSettings = field(default_factory=UnloadedSettings)


@dataclass(frozen=True)
class Untouched:
    """What there is without a touch.

    joints (5,), m and rad: mean. offset (6,): mean compensated wrench, ft_sensor, N and N.m. tool,
    base: mean poses of the markers in `tracker`.
    """

    joints: Array
    offset: Array
    tool: Transform
    base: Transform


class MarkerPoses:
    """A marker's poses while something is watched."""

    def __init__(self, may_stand: bool) -> None:
        """`may_stand`: a pose that repeats to the last bit is a measurement, too."""
        self._may_stand = may_stand
        self._last: tuple[float, ...] = ()
        self.stamps: list[int] = []
        self.poses: list[tuple[Array, Array]] = []

    def add(self, stamp_ns: int, rotation: Array, translation: Array) -> None:
        """Take a pose in `tracker`: (3, 3) and (3,), m. Not finite ones tell nothing."""
        key = (*translation.tolist(), *rotation.ravel().tolist())
        if not np.all(np.isfinite(key)) or (not self._may_stand and key == self._last):
            return
        self._last = key
        self.stamps.append(stamp_ns)
        self.poses.append((rotation, translation))

    def clear(self) -> None:
        """Begin anew."""
        self.stamps.clear()
        self.poses.clear()

    def complaint(self, duration_s: float, max_gap_s: float) -> str:
        """Why these are not the poses of a marker that was seen all the time; empty if they are."""
        if len(self.stamps) < _LEAST_POSES:
            return f"was seen {len(self.stamps)} times in {duration_s:g} s"
        gap_s = float(np.max(np.diff(self.stamps))) / NS
        missing_s = duration_s - (self.stamps[-1] - self.stamps[0]) / NS
        worst_s = max(gap_s, missing_s / 2)
        return f"was lost for {worst_s:.2f} s" if worst_s > max_gap_s else ""

    def mean(self) -> Transform:
        """The mean pose."""
        rotations, translations = zip(*self.poses, strict=True)
        return mean_pose(Transform(np.array(rotations), np.array(translations))).pose


class UntouchedWatch:
    """Feed it until there is a `result`; `complaint` is why the last stretch was none."""

    def __init__(self, settings: UntouchedSettings) -> None:
        self._settings = settings
        self.tool = MarkerPoses(may_stand=False)
        self.base = MarkerPoses(may_stand=True)
        self._joints: list[Array] = []
        self._stamps: list[int] = []
        self._wrenches: list[Array] = []
        self.result: Untouched | None = None
        self.complaint = ""

    def add_joints(self, position: Array) -> None:
        """Take the joints (5,), m and rad."""
        self._joints.append(position)

    def add_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a compensated wrench (6,) in ft_sensor, N and N.m."""
        self._stamps.append(stamp_ns)
        self._wrenches.append(wrench)
        if stamp_ns - self._stamps[0] < self._settings.duration_s * NS:
            return
        self.complaint = self._judge()
        self.begin_again()

    def begin_again(self) -> None:
        """Forget what there is: the stretch was broken."""
        for part in (self._joints, self._stamps, self._wrenches):
            part.clear()
        self.tool.clear()
        self.base.clear()

    def _judge(self) -> str:
        settings = self._settings
        for marker, name in ((self.tool, "tool's"), (self.base, "base's")):
            if complaint := marker.complaint(settings.duration_s, settings.max_gap_s):
                return f"the {name} marker {complaint}"
        if not self._joints:
            return "no joint states came"
        time_ns, wrenches = np.array(self._stamps), np.array(self._wrenches)
        unloaded = settings.unloaded
        noise = noise_of_mean(time_ns, wrenches, unloaded.window_s)
        noise = np.minimum(noise, settings.tolerance / unloaded.sigmas)
        found = load_phases(time_ns, wrenches, noise, unloaded)
        if found.first is None:
            return f"the tool is touched: {found.why_none}"
        if found.first[1] < time_ns[-1]:
            at_s = (found.first[1] - time_ns[0]) / NS
            return f"the tool is touched: the wrench changes after {at_s:.1f} s"
        self.result = Untouched(
            np.mean(self._joints, axis=0), found.offset, self.tool.mean(), self.base.mean()
        )
        return ""
