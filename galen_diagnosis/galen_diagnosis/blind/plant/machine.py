"""What arm, sensor and tracker tell with tolerances and causes, noise apart.

    reading = show( sense(weights + causes + hand) - sense(adapter at the zeroing) ) + zero

The sensor's errors act on the whole wrench on it, the adapter's weight at the zeroing included, as
in a real sensor. The tip is moved by the true springs under the hand's true wrench.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from galen_model.arm.galen import HOME
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm, Springs
from galen_diagnosis.blind.plant.cause import Cause, Moment, State
from galen_diagnosis.blind.plant.course import Going
from galen_diagnosis.blind.plant.session import Session, Take, adapter, tool_body
from galen_diagnosis.blind.plant.tolerance import NOMINAL, Tolerance
from galen_diagnosis.blind.plant.turning import back, cross, forth, turned_by

HISTORY_S = 0.02
"""Springs with memory are followed at this step."""


def changes(causes: Sequence[Cause], *hooks: str) -> bool:
    """Whether one of the causes has one of these hooks of its own."""
    return any(getattr(type(c), hook) is not getattr(Cause, hook) for c in causes for hook in hooks)


class Machine:
    """One arm in one session."""

    def __init__(
        self,
        session: Session,
        causes: Sequence[Cause] = (),
        tolerance: Tolerance = NOMINAL,
        like: Machine | None = None,
    ) -> None:
        """Take springs from `like`: a machine of that session and tolerance without causes."""
        self.session = session
        self.tolerance = tolerance
        self.causes = tuple(sorted(causes, key=lambda cause: cause.order))
        self._loads: dict[tuple[bytes, bytes], tuple[Springs, Array]] = {}
        self.arm: BlindArm
        if like is not None and not changes(self.causes, "arm"):
            self.arm, self._loads = like.arm, like._loads
        else:
            self.arm = tolerance.arm(BlindArm())
            for cause in self.causes:
                self.arm = cause.arm(self.arm)
        self.tool = tolerance.tool(tool_body(session.tool))
        self.adapter = adapter()
        self.zeroing = self._sensed_at_zeroing()
        """What the sensor was zeroed at (6,)."""

    # --- the sensor ---------------------------------------------------------------------------

    def reading(self, bag: str, taken_s: Array, *, hand: bool = True) -> Array:
        """(n, 6) at the times when samples are thought to be taken; hand: with what it pushes."""
        at = self.moment(bag, taken_s, "wrench")
        return self.told(at, self.total(at, hand=hand))

    def total(self, at: Moment, *, hand: bool = True) -> Array:
        """The true wrench (n, 6) on the sensor."""
        state = self.state(at)
        total = self.weight(at, state)
        for cause in self.causes:
            more = cause.wrench(at, state)
            if more is not None:
                total = total + more
        if hand and at.take.pushes is not None:
            total = total + at.take.pushes.wrench(at.bag_s)
        return total

    def told(self, at: Moment, total: Array) -> Array:
        """The reading (n, 6) of a true wrench."""
        reading = self._sense(at, total) - self.zeroing + self.session.zero
        for cause in self.causes:
            reading = cause.show(at, reading)
        return reading

    def moment(self, bag: str, taken_s: Array, of: str) -> Moment:
        """True times and course of samples of `of` ("wrench" or "tracker")."""
        take = self.session.takes[bag]
        taken_s = taken_s - self.tolerance.late_s(of)
        for cause in self.causes:
            taken_s = cause.late(taken_s, of)
        return Moment(take, taken_s, taken_s + take.start_s, take.course.at(taken_s))

    def state(self, at: Moment) -> State:
        """The true arm then."""
        joints = self.arm.turned_joints(at.going.joints)
        for cause in self.causes:
            joints = cause.joints(at, joints)
        pose = self.arm.pose(joints)
        gravity = back(pose.rotation, self.arm.gravity)
        tip_m = self.session.tool.tip_m
        return State(self.arm, joints, pose, gravity, self.tool, self.adapter, tip_m)

    def weight(self, at: Moment, state: State) -> Array:
        """Of tool and adapter (n, 6)."""
        tool = self.tool
        com = np.broadcast_to(tool.com_m, state.gravity.shape)
        for cause in self.causes:
            tool, com = cause.tool(at, tool, com, state.gravity)
        force = tool.mass_kg * state.gravity
        total = np.concatenate([force, cross(com, force)], axis=1)
        return total + self._adapter_weight(state.gravity)

    def _adapter_weight(self, gravity: Array) -> Array:
        force = self.adapter.mass_kg * gravity
        return np.concatenate([force, cross(self.adapter.com_m, force)], axis=1)

    def _sense(self, at: Moment, total: Array) -> Array:
        total = total * self.arm.sensor_gain
        for cause in self.causes:
            total = cause.sense(at, total)
        return total

    def _sensed_at_zeroing(self) -> Array:
        take = next(iter(self.session.takes.values()))
        still = np.zeros((1, 5))
        at = Moment(take, np.zeros(1), np.zeros(1), Going(HOME[None].copy(), still, still))
        return self._sense(at, self._adapter_weight(self.state(at).gravity))[0]

    # --- the tracker --------------------------------------------------------------------------

    def tip(self, bag: str, taken_s: Array) -> tuple[Array, Array]:
        """R_base_tip (n, 3, 3) and its position (n, 3) in base_link, bent."""
        at = self.moment(bag, taken_s, "tracker")
        return self._tip(at)

    def tool_pose(self, bag: str, taken_s: Array) -> tuple[Array, Array]:
        """Of the tool's marker in `tracker`: (n, 3, 3), (n, 3)."""
        at = self.moment(bag, taken_s, "tracker")
        rotation, position = self._tip(at)
        return self._seen(at, rotation, position)

    def base_pose(self, bag: str, taken_s: Array) -> tuple[Array, Array]:
        """Of the base's marker in `tracker`: (n, 3, 3), (n, 3)."""
        at = self.moment(bag, taken_s, "tracker")
        moved = np.zeros((len(at), 6))
        for cause in self.causes:
            more = cause.stand(at)
            if more is not None:
                moved = moved + more
        rotation = turned_by(moved[:, 3:]) @ self.session.marker_rotation
        return self._seen(at, rotation, self.session.marker_position + moved[:, :3])

    def _seen(self, at: Moment, rotation: Array, position: Array) -> tuple[Array, Array]:
        there = position @ self.session.base_rotation.T + self.session.base_position
        there = there * self.arm.tracker_scale
        for cause in self.causes:
            there = cause.track(at, there)
        return self.session.base_rotation @ rotation, there

    def _tip(self, at: Moment) -> tuple[Array, Array]:
        joints = self.arm.turned_joints(at.going.joints)
        for cause in self.causes:
            joints = cause.joints(at, joints)
        pose = self.arm.pose(joints)
        position = pose.origin + forth(pose.rotation, self.session.tool.tip_m)
        bent = self._bent(at)
        return turned_by(bent[:, 3:]) @ pose.rotation, position + bent[:, :3]

    def _bent(self, at: Moment) -> Array:
        """Displacement (n, 6) of the tip in base_link under the hand's wrench."""
        bent = np.zeros((len(at), 6))
        take = at.take
        if take.pushes is None:
            return bent
        for place, joints in enumerate(take.places):
            begin_s, end_s = take.recorded[place]
            here = (at.bag_s >= begin_s - 1.0) & (at.bag_s <= end_s + 1.0)
            if not here.any():
                continue
            springs, loads = self.loads(take, joints, at.bag_s[here])
            moved = springs.moved(loads @ springs.give.T)
            # The platform's twist is that of the first six springs.
            moved = moved + self.arm.places[place] @ springs.loads[:6]
            grid_s = np.arange(begin_s, end_s + HISTORY_S, HISTORY_S)
            more = self._more(take, grid_s, place)
            if more is not None:
                on = [np.interp(at.bag_s[here], grid_s, column) for column in more.T]
                moved = moved + np.stack(on, axis=1)
            bent[here] = moved
        return bent

    def _more(self, take: Take, grid_s: Array, place: int) -> Array | None:
        """What causes add (n, 6) to the tip's displacement on a grid at one place."""
        asked = [cause for cause in self.causes if changes([cause], "displace")]
        if not asked:
            return None
        springs, loads = self.loads(take, take.places[place], grid_s)
        then = Moment(take, grid_s, grid_s + take.start_s, take.course.at(grid_s))
        added = np.zeros((len(grid_s), 6))
        for cause in asked:
            extra = cause.displace(then, springs, loads, place)
            if extra is not None:
                added = added + extra
        return added

    def loads(self, take: Take, joints: Array, at_s: Array) -> tuple[Springs, Array]:
        """The springs at a place's joints (5,), and what a hand loads them with (n, 8)."""
        assert take.pushes is not None
        true = self._true_joints(take, joints, at_s)
        key = (true.tobytes(), at_s.tobytes())
        if key not in self._loads:
            springs = self.arm.springs(true, self.session.tool.tip_m)
            rotation = self.arm.pose(true[None]).rotation[0]
            loads = springs.loaded(self._at_tip(rotation, take.pushes.wrench(at_s)))
            self._loads[key] = springs, loads
        return self._loads[key]

    def _true_joints(self, take: Take, joints: Array, at_s: Array) -> Array:
        """Where the arm stands (5,) while its joints tell `joints`.

        Causes are taken as at the middle of at_s: what a joint moves in its gap turns no spring.
        """
        true = self.arm.turned_joints(joints[None])
        middle = at_s[len(at_s) // 2 : len(at_s) // 2 + 1]
        then = Moment(take, middle, middle + take.start_s, take.course.at(middle))
        for cause in self.causes:
            true = cause.joints(then, true)
        return np.asarray(true[0])

    def _at_tip(self, rotation: Array, wrench: Array) -> Array:
        """A wrench (n, 6) about the sensor's origin in ft_sensor, at the tip in base_link."""
        force, torque = wrench[:, :3], wrench[:, 3:]
        torque = torque - cross(self.session.tool.tip_m, force)
        return np.concatenate([force @ rotation.T, torque @ rotation.T], axis=1)
