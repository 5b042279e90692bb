"""What a recording holds of the arm at home, where the sensor is zeroed and the tool comes on.

A live calibration goes home before, between and after its sweeps, and measures nothing there unless
its grid has home among its poses. So phases at home are left out where a sweep begins or ends with
them, and stay in inside of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from galen_model.load.identification import MIN_POSES

from galen_calibration_behavior.from_bag.visits import Visit, Visits
from galen_calibration_behavior.parameters import CalibrationParameters


class HomeStays:
    """Tells the visits at home from the others."""

    def __init__(self, settings: CalibrationParameters, zero_pose: tuple[float, float]) -> None:
        """`zero_pose`: roll and tilt (rad) at home, where the sensor was zeroed."""
        self._settings = settings
        self._zero_pose = zero_pose

    def at_home(self, visit: Visit) -> bool:
        """Whether it stands there, by roll and tilt."""
        away = np.abs(visit.joints[3:] - self._zero_pose)
        return bool(np.all(away <= self._settings.arrival.position_tolerance[3:]))

    def without_ends(self, visits: Sequence[Visit]) -> list[Visit]:
        """Without the phases at home with which it begins and ends."""
        away = [k for k, visit in enumerate(visits) if not self.at_home(visit)]
        return list(visits[away[0] : away[-1] + 1]) if away else []

    def after_zeroing(self, recording: Visits) -> tuple[list[Visit], list[str]]:
        """What comes after the sensor was zeroed, and a warning where poses are lost by that.

        It was zeroed in a stay at home in which the reading goes to zero (or a tool was removed;
        in both cases what was read before has another zero or load), and, where the zero did not
        change by enough to be seen, in the first stay at home, if the recording begins with it or
        with too few poses for a sweep.
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
