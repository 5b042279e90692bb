"""How strong a cause is in one recording: its distance from no cause, nuisances apart.

With d the difference that the cause makes to what is told, each sample over its noise, and J what
the recording can't know anyway,

    D^2 = d^T (1 + J S J^T)^-1 d = d^T d - b^T (J^T J + S^-1)^-1 b,    b = J^T d

J holds the nuisances (sensor's zero 6, base_link in the tracker 6, mean of the base's marker 6),
whose S is infinite, and the healthy arm's tolerances, in standard deviations. Nobody can tell a
joint's zero that is off by less than zeros are off on healthy arms; so D counts tolerances, too.

What counts: readings where nobody touches; tip and marker at all times, the tip less what the
nominal springs make of the reading where somebody touches, since what a hand pushes is known from
the reading alone. Every k-th sample is taken, and counts k times; coloured noise counts with its
variance at low frequency, (1 + rho) / (1 - rho) times the sample's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.blind.plant.arm import BlindArm
from galen_diagnosis.blind.plant.cause import Cause
from galen_diagnosis.blind.plant.machine import Machine, changes
from galen_diagnosis.blind.plant.session import Session
from galen_diagnosis.blind.plant.tolerance import COUNT, NAMES, Tolerance

_SAMPLES_A_TOPIC = 600
_MOST_STEPS = 40
_AROUND_TOUCH_S = 0.06
"""Readings so near to a touch are left out."""
_AROUND = np.linspace(-_AROUND_TOUCH_S, _AROUND_TOUCH_S, 5)

TELLABLE = 3.3
"""Two causes nearer to each other than this can't be told apart: 5 % errors each way, 2 x 1.65."""


@dataclass(frozen=True)
class _Told:
    """Readings at the rows that count, and tip and marker, as one machine has them."""

    readings: list[Array]
    tip_rotation: Array
    tip_position: Array
    applied: Array
    marker_rotation: Array
    marker_position: Array


def _changed(causes: Sequence[Cause]) -> tuple[bool, bool, bool, bool]:
    """Whether causes change the true wrench, what becomes of it, the tip, the marker."""
    return (
        changes(causes, "late", "arm", "joints", "tool", "wrench"),
        changes(causes, "sense", "show"),
        changes(causes, "late", "arm", "joints", "displace", "track"),
        changes(causes, "late", "track", "stand"),
    )


_SEEN_ONLY = (
    "length_m", "rod_length_m", "stiffness", "place_m", "place_rad", "tracker_scale",
    "tracker_late_s",
)  # fmt: skip
_READ_ONLY = ("level_rad", "sensor_gain", "mass_kg", "moment_kg_m", "wrench_late_s")
"""Tolerances that change only what the tracker sees, and only the reading."""


@dataclass(frozen=True)
class Family:
    """Directions (k, n) of unit D that a linear family spans, after nuisances."""

    directions: Array

    def left(self, difference: Array, strength: float) -> float:
        """D that the family can't explain of a difference whose own is `strength`."""
        explained = self.directions @ difference
        return math.sqrt(max(0.0, strength**2 - float(explained @ explained)))


class Scale:
    """Measures causes in one session."""

    def __init__(self, session: Session, tolerance_scale: float = 1.0) -> None:
        """tolerance_scale: of the healthy arm's tolerances; 0 counts none."""
        self._session = session
        self._readings: list[tuple[str, Array, float]] = []
        colour = float((1.0 + session.rho) / (1.0 - session.rho))
        for bag, take in session.takes.items():
            taken_s = take.wrench.taken_s
            every = -(-len(taken_s) // _SAMPLES_A_TOPIC)
            chosen = taken_s[every // 2 :: every]
            if take.pushes is not None:
                near = [take.pushes.touched(chosen + shift) for shift in _AROUND]
                chosen = chosen[~np.any(near, axis=0)]
            self._readings.append((bag, chosen, float(np.sqrt(every / colour))))
        self._tracked_s = np.zeros(0)
        push = session.takes.get("push")
        if push is not None and push.tracker is not None and push.pushes is not None:
            taken_s = push.tracker.taken_s
            every = -(-len(taken_s) // _SAMPLES_A_TOPIC)
            self._tracked_s = taken_s[every // 2 :: every]
            colour = (1.0 + session.tracker_rho) / (1.0 - session.tracker_rho)
            self._tracker_weight = float(np.sqrt(every / colour))
            self._touched = push.pushes.touched(self._tracked_s)
            self._compliances = self._nominal_compliances()
        self._machine = Machine(session)
        self._moments = [self._machine.moment(b, s, "wrench") for b, s, _ in self._readings]
        self._totals = [self._machine.total(at, hand=False) for at in self._moments]
        if len(self._tracked_s):
            self._pushed_at = self._machine.moment("push", self._tracked_s, "wrench")
            self._pushed = self._machine.total(self._pushed_at)
        self._nominal = self._tell(self._machine)
        self._columns = self._nuisances()
        if tolerance_scale > 0.0:
            of_tolerances = [self._by_tolerance(k, tolerance_scale) for k in range(COUNT)]
        else:
            of_tolerances = []
        known = np.concatenate([np.zeros(len(self._columns)), np.ones(len(of_tolerances))])
        self._j = np.array([*self._columns, *of_tolerances])
        self._information = self._j @ self._j.T + np.diag(known)

    def difference(self, causes: Sequence[Cause], tolerance: Tolerance | None = None) -> Array:
        """d: what the causes change, each sample over its noise."""
        if tolerance is not None:
            return self._compared(self._tell(Machine(self._session, causes, tolerance)))
        machine = Machine(self._session, causes, like=self._machine)
        return self._compared(self._tell_anew(machine, *_changed(causes)))

    def _by_tolerance(self, number: int, size: float) -> Array:
        """The difference that one tolerance makes at `size` standard deviations."""
        name = NAMES[number]
        machine = Machine(self._session, (), Tolerance(size * np.eye(COUNT)[number]))
        reads = name not in _SEEN_ONLY
        seen = name not in _READ_ONLY
        return self._compared(self._tell_anew(machine, reads, False, seen, name == "tracker_scale"))

    def _free(self, rows: Array) -> Array:
        """J rows^T solved with the information: what the nuisances take of rows (k, n)."""
        return np.asarray(np.linalg.solve(self._information, self._j @ rows.T))

    def strength(self, difference: Array) -> float:
        """D of a difference."""
        taken = self._j @ difference
        square = difference @ difference - taken @ np.linalg.solve(self._information, taken)
        return math.sqrt(max(0.0, float(square)))

    def family(self, causes: Sequence[Cause]) -> Family:
        """What these causes, each as large as it likes, can explain together."""
        columns = np.array([self.difference([cause]) for cause in causes])
        length = np.linalg.norm(columns, axis=1)
        columns = columns / np.where(length > 0.0, length, 1.0)[:, None]
        free = columns - self._free(columns).T @ self._j
        gram = free @ columns.T
        values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
        good = values > 1e-9
        return Family((vectors[:, good] / np.sqrt(values[good])).T @ free)

    def sized(
        self, cause: Cause, strength: float, measure: Callable[[Array], float] | None = None
    ) -> tuple[Cause, float]:
        """The cause at the size that has this D, or at its largest; and the D that it then has.

        Secant steps on log D over log size, halved where they leave what is known to hold it.
        measure: of a difference, D if not given.
        """
        start, ceiling = abs(cause.size), math.log(cause.largest)
        low, high = -math.inf, math.inf
        at, before, found, reached = math.log(start), (0.0, 0.0), cause, 0.0
        for step in range(_MOST_STEPS):
            found = cause.times(math.exp(at) / start)
            reached = (measure or self.strength)(self.difference([found]))
            if abs(reached / strength - 1.0) < 0.01 or (reached < strength and at >= ceiling):
                break
            beside = math.log(max(reached, 1e-9) / strength)
            low, high = (at, high) if beside < 0.0 else (low, at)
            run = at - before[0]
            slope = (beside - before[1]) / run if step and run else 1.0
            before = (at, beside)
            at = min(at - beside / max(slope, 0.1), ceiling)
            if not low < at < high:
                at = 0.5 * (low + high)
        return found, reached

    # --- inside -------------------------------------------------------------------------------

    def _tell(self, machine: Machine) -> _Told:
        readings = [machine.reading(bag, at_s, hand=False) for bag, at_s, _ in self._readings]
        if not len(self._tracked_s):
            nothing = np.zeros((0, 3))
            none = np.zeros((0, 3, 3))
            return _Told(readings, none, nothing, np.zeros((0, 6)), none, nothing)
        tip = machine.tool_pose("push", self._tracked_s)
        marker = machine.base_pose("push", self._tracked_s)
        return _Told(readings, *tip, machine.reading("push", self._tracked_s), *marker)

    def _tell_anew(
        self, machine: Machine, loaded: bool, sensed: bool, bent: bool, marked: bool
    ) -> _Told:
        """As `_tell`, but what isn't said to be changed is taken from the nominal machine.

        loaded: the true wrench; sensed: what becomes of it; bent: the tip; marked: the marker.
        """
        nominal = self._nominal
        readings, applied = nominal.readings, nominal.applied
        if loaded:
            readings = [machine.reading(bag, at_s, hand=False) for bag, at_s, _ in self._readings]
            if len(self._tracked_s):
                applied = machine.reading("push", self._tracked_s)
        elif sensed:
            each = zip(self._moments, self._totals, strict=True)
            readings = [machine.told(at, total) for at, total in each]
            if len(self._tracked_s):
                applied = machine.told(self._pushed_at, self._pushed)
        tip = nominal.tip_rotation, nominal.tip_position
        marker = nominal.marker_rotation, nominal.marker_position
        if len(self._tracked_s):
            if bent:
                tip = machine.tool_pose("push", self._tracked_s)
            if marked:
                marker = machine.base_pose("push", self._tracked_s)
        return _Told(readings, *tip, applied, *marker)

    def _compared(self, told: _Told) -> Array:
        nominal = self._nominal
        changes = [a - b for a, b in zip(told.readings, nominal.readings, strict=True)]
        if not len(self._tracked_s):
            return self._whitened(changes, None, None)
        tip = marker = np.zeros((len(self._tracked_s), 6))
        # What is the same object was not computed anew.
        if told.tip_position is not nominal.tip_position:
            tip = self._moved(
                told.tip_rotation, told.tip_position, nominal.tip_rotation, nominal.tip_position
            )
        if told.marker_position is not nominal.marker_position:
            marker = self._moved(
                told.marker_rotation,
                told.marker_position,
                nominal.marker_rotation,
                nominal.marker_position,
            )
        if told.applied is not nominal.applied:
            tip = tip - self._bent(told.applied - nominal.applied)
        return self._whitened(changes, tip, marker)

    def _moved(
        self, rotation: Array, position: Array, rotation_0: Array, position_0: Array
    ) -> Array:
        """Displacement (n, 6) in base_link of poses in the tracker from others."""
        turn = rotation @ np.swapaxes(rotation_0, 1, 2)
        # Small turns: the skew part is the rotation vector.
        vector = 0.5 * np.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0],
             turn[:, 1, 0] - turn[:, 0, 1]], axis=1,
        )  # fmt: skip
        base = self._session.base_rotation
        return np.concatenate([(position - position_0) @ base, vector @ base], axis=1)

    def _bent(self, applied: Array) -> Array:
        """What the nominal springs make of a change (n, 6) of the reading; none where untouched."""
        bent = np.einsum("nij,nj->ni", self._compliances, applied)
        return np.where(self._touched[:, None], bent, 0.0)

    def _nominal_compliances(self) -> Array:
        """(n, 6, 6) from a wrench about the sensor's origin in ft_sensor to the tip's twist."""
        take = self._session.takes["push"]
        tip_m = self._session.tool.tip_m
        arm = BlindArm()
        x, y, z = tip_m
        to_tip = np.eye(6)
        to_tip[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        each = []
        for joints in take.places:
            springs = arm.springs(joints, tip_m)
            turn = np.kron(np.eye(2), arm.pose(joints[None]).rotation[0])
            each.append(springs.loads.T @ springs.give @ springs.loads @ turn @ to_tip)
        number = np.searchsorted(take.recorded[:, 0], self._tracked_s, side="right") - 1
        return np.array(each)[np.clip(number, 0, len(each) - 1)]

    def _whitened(self, changes: list[Array], tip: Array | None, marker: Array | None) -> Array:
        parts = [
            (change * (weight / self._session.wrench_std)).ravel()
            for change, (_, _, weight) in zip(changes, self._readings, strict=True)
        ]
        if tip is not None and marker is not None:
            weights = self._tracker_weight / np.repeat(self._session.tracker_std, 3)
            parts += [(tip * weights).ravel(), (marker * weights).ravel()]
        return np.concatenate(parts)

    def _nuisances(self) -> list[Array]:
        columns = []
        nothing = [np.zeros_like(reading) for reading in self._nominal.readings]
        tracked = len(self._tracked_s)
        for axis in range(6):
            one = np.eye(6)[axis]
            shifted = [reading + one for reading in nothing]
            if not tracked:
                columns.append(self._whitened(shifted, None, None))
                continue
            applied = np.tile(one, (tracked, 1))
            columns.append(self._whitened(shifted, -self._bent(applied), np.zeros((tracked, 6))))
        if not tracked:
            return columns
        base = self._session.base_rotation
        position = (self._nominal.tip_position - self._session.base_position) @ base
        for axis in range(6):
            one = np.zeros((tracked, 6))
            one[:, axis] = 1.0
            columns.append(self._whitened(nothing, np.zeros((tracked, 6)), one))
            tip = one.copy()
            if axis >= 3:
                tip[:, :3] = np.cross(np.eye(3)[axis - 3], position)
            columns.append(self._whitened(nothing, tip, np.zeros((tracked, 6))))
        return columns
