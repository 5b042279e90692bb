"""What records need of a table: of orientations, or of a joint with encoders at both ends.

A table of orientations holds gravity in the sensor and, perhaps, the sensor's rotation in its base;
no joints. Effects of geometry, load and sensor are the simulator's own: those hooks that need no
joints are called as the replay calls them (`galen_sim_driver.replay`), and differences give the
columns,

    reading = read(W(tool_load(load); R^T gravity(g))).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from galen_bags.arrays.tables import OrientationTable
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arrays import Array
from galen_model.evidence.held_out import Columns
from galen_model.load.model import Load
from galen_model.transmission import Scales
from galen_sim_driver.effects.effect import Effect, Instants

STEP = 1e-3
"""Of differences, in typical sizes."""
LEVER_M = 0.05
"""Usual torque over usual force."""
USUAL_DELAY_S = 0.005


@dataclass(frozen=True)
class TablePlant:
    """A load on a sensor at n moments.

    gravity (n, 3) in the sensor, m/s^2; rotation R_base_sensor (n, 3, 3), None if not known; at_s
    (n,); offset (6,): the reading's constant part.
    """

    gravity: Array
    rotation: Array | None
    at_s: Array
    load: Load
    offset: Array

    def reading(self, effects: Sequence[Effect] = ()) -> Array:
        """Return the reading (n, 6), N and N.m in the sensor's frame."""
        when = Instants("", self.at_s, self.at_s)
        gravity = self._gravity(effects)
        direction = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
        mass = self.load.mass_kg
        com = np.broadcast_to(np.asarray(self.load.com_m, dtype=float), gravity.shape)
        for effect in effects:
            mass, com = effect.tool_load(mass, com, direction)
        total = np.concatenate([mass * gravity, np.cross(com, mass * gravity)], axis=1)
        for effect in sorted(effects, key=lambda one: one.order):
            if not effect.after_noise:
                total = effect.read(when, total)
        total = total + self.offset
        for effect in effects:
            if effect.after_noise:  # a range is of the whole reading
                total = effect.read(when, total)
        return np.asarray(total)

    def change(self, effect: Effect) -> Array:
        """Return what an effect adds to the reading (n, 6)."""
        return self.reading([effect]) - self.reading()

    def _gravity(self, effects: Sequence[Effect]) -> Array:
        if self.rotation is None:
            return self.gravity
        in_base = self.rotation[0] @ self.gravity[0]
        if np.allclose(in_base, GRAVITY_M_S2, rtol=0.0, atol=1e-6):
            in_base = GRAVITY_M_S2
        turned = in_base.copy()
        for effect in effects:
            turned = effect.gravity(turned)
        if np.array_equal(turned, in_base):
            return self.gravity
        return self.gravity + np.einsum("nji,j->ni", self.rotation, turned - in_base)


@dataclass(frozen=True)
class TableData:
    """A table, and what its readings should be.

    known_load: the load is a file's and not fitted, so that it may be wrong. by_order: the order of
    readings is all that is known of time.
    """

    plant: TablePlant
    table: OrientationTable
    known_load: bool
    by_order: bool


def by_hooks(plant: TablePlant, effect: Effect, words: dict[str, str] | None = None) -> Columns:
    """Return the columns of an effect's fitted parameters, by differences at zero."""
    typical = np.concatenate([part.typicals for part in effect.fitted])
    columns = [
        plant.change(effect.with_vector(STEP * size * unit)) / STEP
        for size, unit in zip(typical, np.eye(len(typical)), strict=True)
    ]
    return Columns(np.stack(columns, axis=2), numbers_of(effect, typical), words or {})


def numbers_of(effect: Effect, typical: Array) -> Mapping[str, Callable[[Array], Array]]:
    """Return how weights of columns of these sizes become the effect's fitted parameters."""
    found, at = {}, 0
    for part in effect.fitted:
        rows = at if part.size == 1 else slice(at, at + part.size)
        found[part.name] = partial(_scaled, rows, typical[rows])
        at += part.size
    return found


def _scaled(rows: int | slice, typical: Array, weights: Array) -> Array:
    return np.asarray(typical * weights[rows])


def by_simulator(
    effect: Effect, *, of_the_load: bool = False
) -> Callable[[TableData], list[Columns] | str]:
    """Return how an effect shows in a table by the simulator; of_the_load: if a file has that."""

    def in_table(data: TableData) -> list[Columns] | str:
        if of_the_load and not data.known_load:
            return "mass and centre are fitted (--tool)"
        return [by_hooks(data.plant, effect)]

    return in_table


@dataclass(frozen=True)
class JointTerms:
    """Means over n short windows of a joint's runs.

    lag (n,), rad; column (n,): each of `galen_model.transmission.TERMS`; torque_rate (n,), N.m/s;
    lost (n, p), rad: what plays of the motion of thresholds gaps (p,), rad, leave behind.
    """

    lag: Array
    column: Mapping[str, Array]
    torque_rate: Array
    lost: Array
    gaps: Array
    scales: Scales

    @property
    def usual_softness(self) -> float:
        """Half the lag's range over half the torque's, rad/(N.m)."""
        return self.scales.lag_half_range / self.scales.torque_half_range


def in_lag(
    values: Array, name: str, size: Callable[[Array], Array], *, positive: bool = False
) -> Columns:
    """Return the way of columns (n,) or (n, k) of the lag; size: of weights, a parameter."""
    allowed = (lambda w: bool(size(w) > 0.0)) if positive else (lambda w: True)
    return Columns(values.reshape(len(values), 1, -1), {name: size}, allowed=allowed)
