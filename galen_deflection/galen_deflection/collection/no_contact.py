"""The tool without contact, its markers seen: at the start of a set; two such compared.

By the rule that reading the recording goes by later (`arm_positions.load_phases`), and by a limit
of its own: a hand that trembles makes its own noise.

Two calibration sets tell whether the robot's position stayed constant, as in the 2019 report. The
first set registers the tracker as the report does (eq. 13), W = F(q_1) M_1^-1 with F the tip by the
joints and M the tool's marker in the base's; in the second one the tip is at W M_2 (eq. 14), and by
the joints at F(q_2). A tool marker that is not at the tip hardly counts, because the joints are
nearly the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.registration import Transform, mean_pose
from galen_ros.goal.arrival import NS

from galen_deflection.collection.parameters import CollectionParameters
from galen_deflection.measurement.arm_positions import UnloadedSettings, load_phases, noise_of_mean

_LEAST_POSES = 10


@dataclass(frozen=True)
class NoContact:
    """What was measured without contact.

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
        """Take a pose in `tracker`: (3, 3) and (3,), m. Values that are not finite are ignored."""
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


class NoContactWatch:
    """Feed it until there is a `result`; `complaint` is why the last attempt was none.

    For `untouched_s` of stamps the wrench's mean over a tenth of a second stays within the
    tolerance of what it is, and both markers are seen without a gap of more than
    `max_marker_gap_s`.
    """

    def __init__(self, settings: CollectionParameters) -> None:
        self._settings = settings
        self.tool = MarkerPoses(may_stand=False)
        self.base = MarkerPoses(may_stand=True)
        self._joints: list[Array] = []
        self._stamps: list[int] = []
        self._wrenches: list[Array] = []
        self.result: NoContact | None = None
        self.complaint = ""

    def add_joints(self, position: Array) -> None:
        """Take the joints (5,), m and rad."""
        self._joints.append(position)

    def add_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a compensated wrench (6,) in ft_sensor, N and N.m."""
        self._stamps.append(stamp_ns)
        self._wrenches.append(wrench)
        if stamp_ns - self._stamps[0] < self._settings.untouched_s * NS:
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
            if complaint := marker.complaint(settings.untouched_s, settings.max_marker_gap_s):
                return f"the {name} marker {complaint}"
        if not self._joints:
            return "no joint states came"
        time_ns, wrenches = np.array(self._stamps), np.array(self._wrenches)
        unloaded = UnloadedSettings()
        noise = noise_of_mean(time_ns, wrenches, unloaded.window_s)
        noise = np.minimum(noise, settings.untouched_tolerance / unloaded.sigmas)
        found = load_phases(time_ns, wrenches, noise, unloaded)
        if found.first is None:
            return f"the tool is in contact: {found.why_none}"
        if found.first[1] < time_ns[-1]:
            at_s = (found.first[1] - time_ns[0]) / NS
            return f"the tool is in contact: the wrench changes after {at_s:.1f} s"
        self.result = NoContact(
            np.mean(self._joints, axis=0), found.offset, self.tool.mean(), self.base.mean()
        )
        return ""


def collection_shift(first: NoContact, second: NoContact, tip_m: Array) -> Array:
    """How far the tip (6,) is from where it should be, in base_link, m and rad."""
    registered = _tip(first, tip_m) @ _tool_in_base_marker(first).inverse()
    return (registered @ _tool_in_base_marker(second)).displacement_from(_tip(second, tip_m))


def shift_sentence(
    first: NoContact, second: NoContact, shift: Array, most_m: float, most_rad: float
) -> str:
    """A warning with the numbers where it is more than allowed, else empty."""
    moved_m, turned_rad = _sizes(shift)
    if moved_m <= most_m and turned_rad <= most_rad:
        return ""
    marker_m, marker_rad = _sizes(second.base.displacement_from(first.base))
    return (
        "the robot's position did not stay constant: between the calibration sets the tip moved by"
        f" {1e3 * moved_m:.3f} mm and {1e3 * turned_rad:.3f} mrad from where the joints say (at"
        f" most {1e3 * most_m:g} mm and {1e3 * most_rad:g} mrad): the base, a marker or the tool"
        f" moved; the tracker saw the base's marker move by {1e3 * marker_m:.3f} mm and"
        f" {1e3 * marker_rad:.3f} mrad"
    )


def _tip(at: NoContact, tip_m: Array) -> Transform:
    return Transform(*GALEN.tip_pose(at.joints, tip_m))


def _tool_in_base_marker(at: NoContact) -> Transform:
    return at.base.inverse() @ at.tool


def _sizes(displacement: Array) -> tuple[float, float]:
    return float(np.linalg.norm(displacement[:3])), float(np.linalg.norm(displacement[3:]))
