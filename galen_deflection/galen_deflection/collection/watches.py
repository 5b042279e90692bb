# SPDX-License-Identifier: Apache-2.0
"""What a collection watches: one push, and the tool without contact, its markers seen.

Without contact by the rule that reading the recording goes by later
(`arm_track.no_contact_phase`), and by a limit of its own: a trembling hand makes its own noise.

Two calibration sets show whether the robot's position stayed constant, as in the 2019 report. The
first set registers the tracker as the report does (eq. 13), W = F(q_1) M_1^-1 with F the tip by the
joints and M the tool's marker in the base's; in the second one the tip is at W M_2 (eq. 14), and by
the joints at F(q_2). A tool marker that is not at the tip hardly counts, because the joints are
nearly the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_common.goal.arrival import NS
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.registration import Transform, mean_pose

from galen_deflection.collection.plan import CollectionParameters, State, WantedPush
from galen_deflection.measurement.arm_track import SIGMAS, no_contact_phase, noise_of_mean

_LEAST_POSES = 10


@dataclass(frozen=True)
class NoContact:
    """The means of a phase without contact.

    joints (j,), m and rad. offset (6,): compensated wrench, ft_sensor, N and N.m. tool,
    base: poses of the markers in `tracker`.
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
        """Take a pose in `tracker`; values that are not finite are ignored.

        Args:
            stamp_ns: its stamp.
            rotation: (3, 3).
            translation: (3,), m.

        """
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
        """Return why the marker was not seen all the time.

        Args:
            duration_s: how long it was watched, s.
            max_gap_s: longest time without a pose, s.

        Returns:
            In words; empty if it was seen.

        """
        if len(self.stamps) < _LEAST_POSES:
            return f"was seen {len(self.stamps)} times in {duration_s:g} s"
        gap_s = float(np.max(np.diff(self.stamps))) / NS
        missing_s = duration_s - (self.stamps[-1] - self.stamps[0]) / NS
        worst_s = max(gap_s, missing_s / 2)
        return f"was lost for {worst_s:.2f} s" if worst_s > max_gap_s else ""

    def mean(self) -> Transform:
        """Return the mean pose."""
        rotations, translations = zip(*self.poses, strict=True)
        return mean_pose(Transform(np.array(rotations), np.array(translations)))[0]


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
        """Take a joint state.

        Args:
            position: (j,), m and rad.

        """
        self._joints.append(position)

    def add_wrench(self, stamp_ns: int, wrench: Array) -> None:
        """Take a wrench; after `untouched_s` of them, judge the phase.

        Args:
            stamp_ns: its stamp.
            wrench: (6,) compensated, in ft_sensor, N and N.m.

        """
        self._stamps.append(stamp_ns)
        self._wrenches.append(wrench)
        if stamp_ns - self._stamps[0] < self._settings.untouched_s * NS:
            return
        self.complaint = self._judge()
        self.begin_again()

    def begin_again(self) -> None:
        """Forget all samples: the phase was broken."""
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
        noise = noise_of_mean(time_ns, wrenches)
        noise = np.minimum(noise, settings.untouched_tolerance / SIGMAS)
        phase, offset, why_none = no_contact_phase(time_ns, wrenches, noise)
        if phase is None:
            return f"the tool is in contact: {why_none}"
        if phase[1] < time_ns[-1]:
            at_s = (phase[1] - time_ns[0]) / NS
            return f"the tool is in contact: the wrench changes after {at_s:.1f} s"
        joints = settings.arm.nearest(self._joints, self._joints[0])
        self.result = NoContact(joints.mean(axis=0), offset, self.tool.mean(), self.base.mean())
        return ""


def collection_shift(first: NoContact, second: NoContact, tip_m: Array, arm: Arm) -> Array:
    """Return how far the tip is from where it should be at the second calibration set.

    Args:
        first: the first calibration set, which registers the tracker.
        second: the second one.
        tip_m: (3,) in ft_sensor.
        arm: the arm that stood there.

    Returns:
        (6,), translation (m) and rotation vector (rad) in base_link.

    """
    registered = (
        Transform(*arm.tip_pose(first.joints, tip_m)) @ _tool_in_base_marker(first).inverse()
    )
    tip = Transform(*arm.tip_pose(second.joints, tip_m))
    return (registered @ _tool_in_base_marker(second)).displacement_from(tip)


def shift_sentence(
    first: NoContact, second: NoContact, shift: Array, settings: CollectionParameters
) -> str:
    """Return a warning with the numbers where the shift is more than allowed.

    Args:
        first: the first calibration set.
        second: the second one.
        shift: (6,), by `collection_shift`.
        settings: the node's parameters, with both tolerances.

    Returns:
        A sentence; empty where the shift is allowed.

    """
    most_m, most_rad = settings.shift_tolerance_m, settings.shift_tolerance_rad
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


def _tool_in_base_marker(at: NoContact) -> Transform:
    return at.base.inverse() @ at.tool


def _sizes(displacement: Array) -> tuple[float, float]:
    return float(np.linalg.norm(displacement[:3])), float(np.linalg.norm(displacement[3:]))


class PushWatch:
    """One try at a push. Give it the load some fifty times a second until there is an `outcome`.

        RELEASE (if in contact) -> PUSH <-> HOLD -> RELEASE -> REST

    `outcome` is None, "" for a push as asked, else the reason why it isn't. Along its axis the load
    must be within `level_tolerance` of the level, beside it (force of a force, torque of a torque:
    where exactly a hand takes hold of the tip does not matter) at most `aside_share`, both for
    `hold_s` without a break. More than `overload_share` in all is rejected. Released is a load
    below `released` for `rest_s`.
    """

    def __init__(
        self, wanted: WantedPush, limits: CollectionParameters, timeout_s: float, start_s: float
    ) -> None:
        """`timeout_s`: for the push from when it is asked for until it has been held."""
        self.wanted = wanted
        self._limits = limits
        self._timeout_s = timeout_s
        self._kind = slice(0, 3) if wanted.is_force else slice(3, 6)
        self._direction = wanted.wrench[self._kind] / wanted.level
        self.state = State.RELEASE
        self.outcome: str | None = None
        self.asked = False
        self.along = self.aside = 0.0
        self._since_s = start_s
        self._held_since_s: float | None = None
        self._verdict: str | None = None
        self._most = 0.0
        self._aside_then = 0.0

    def look(self, time_s: float, load: Array) -> None:
        """Take the load.

        Args:
            time_s: the time of the wrench's stamps, s.
            load: (6,) at the tip in base_link, N and N.m.

        """
        part = load[self._kind]
        self.along = float(part @ self._direction)
        self.aside = float(np.linalg.norm(part - self.along * self._direction))
        force, torque = np.linalg.norm(load[:3]), np.linalg.norm(load[3:])
        free = force <= self._limits.released[0] and torque <= self._limits.released[1]
        if self.state in (State.PUSH, State.HOLD):
            self._look_at_push(time_s, float(np.linalg.norm(part)))
        elif self.state == State.RELEASE:
            if free:
                self._released(time_s)
            elif time_s - self._since_s > self._limits.release_timeout_s:
                self.outcome = (
                    f"the tool was not let go of for {self._limits.release_timeout_s:g} s"
                    f" ({force:.2f} N, {torque:.3f} N·m)"
                )
        elif not free:
            self._enter(State.RELEASE, time_s)
        elif time_s - self._since_s >= self._limits.rest_s:
            self.outcome = self._verdict

    def spoil(self, reason: str, time_s: float) -> None:
        """Reject the push for a reason other than its load.

        Args:
            reason: in words, the later `outcome`.
            time_s: the time of the wrench's stamps, s.

        """
        if self._verdict:
            return
        self._verdict = reason
        if self.state in (State.PUSH, State.HOLD):
            self._enter(State.RELEASE, time_s)

    def _released(self, time_s: float) -> None:
        if self._verdict is None:
            self.asked = True
            self._enter(State.PUSH, time_s)
        else:
            self._enter(State.REST, time_s)

    def _look_at_push(self, time_s: float, size: float) -> None:
        limits, level = self._limits, self.wanted.level
        if size > limits.overload_share * level:
            self._judge(f"it came to {size:.2f} {self.wanted.unit}", time_s)
            return
        if self.along > self._most:
            self._most, self._aside_then = self.along, self.aside
        fits = (
            abs(self.along - level) <= limits.level_tolerance * level
            and self.aside <= limits.aside_share * level
        )
        if not fits:
            self._held_since_s = None
            self.state = State.PUSH
        elif self._held_since_s is None:
            self._held_since_s = time_s
            self.state = State.HOLD
        elif time_s - self._held_since_s >= limits.hold_s:
            self._judge("", time_s)
            return
        if time_s - self._since_s > self._timeout_s:
            self._judge(self._what_lacked(), time_s)

    def _what_lacked(self) -> str:
        level, unit, tolerance = self.wanted.level, self.wanted.unit, self._limits.level_tolerance
        if self._most < (1.0 - tolerance) * level:
            return f"it came to no more than {self._most:.2f} {unit} in {self._timeout_s:g} s"
        if self._aside_then > self._limits.aside_share * level:
            return f"{self._aside_then:.2f} {unit} went aside"
        return f"it was not held for {self._limits.hold_s:g} s within {self._timeout_s:g} s"

    def _judge(self, verdict: str, time_s: float) -> None:
        self._verdict = verdict
        self._enter(State.RELEASE, time_s)

    def _enter(self, state: State, time_s: float) -> None:
        self.state = state
        self._since_s = time_s
