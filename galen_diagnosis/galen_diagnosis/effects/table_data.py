# SPDX-License-Identifier: Apache-2.0
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
DELAY_S = 0.005
"""Usual delay of a stamp."""


@dataclass(frozen=True)
class TablePlant:
    """A load on a sensor in the orientations of a table, n moments.

    at_s (n,); offset (6,): the reading's constant part. known_load: the load is a file's and not
    fitted, so that it may be wrong. by_order: the order of readings is all that is known of time.
    """

    table: OrientationTable
    at_s: Array
    load: Load
    offset: Array
    known_load: bool = False
    by_order: bool = False

    def reading(self, effects: Sequence[Effect] = ()) -> Array:
        """Return the reading of the load with effects.

        Args:
            effects: Those whose hooks need no joints.

        Returns:
            Readings in the sensor's frame, (n, 6), N and N.m.

        """
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
        """Return what an effect adds to the reading.

        Args:
            effect: One whose hooks need no joints.

        Returns:
            Changes in the sensor's frame, (n, 6), N and N.m.

        """
        return self.reading([effect]) - self.reading()

    def columns(self, effect: Effect, words: Mapping[str, str] | None = None) -> Columns:
        """Return the columns of an effect's fitted parameters, by differences at zero.

        Args:
            effect: Changes nothing yet; one whose hooks need no joints.
            words: Its parameters that are no numbers.

        Returns:
            Values (n, 6, p), N and N.m, for one usual size of each parameter.

        """
        typical = np.concatenate([part.typicals for part in effect.fitted])
        columns = [
            self.change(effect.with_vector(STEP * size * unit)) / STEP
            for size, unit in zip(typical, np.eye(len(typical)), strict=True)
        ]
        return Columns(np.stack(columns, axis=2), numbers_of(effect, typical), words or {})

    def _gravity(self, effects: Sequence[Effect]) -> Array:
        gravity, rotation = self.table.gravity, self.table.rotation
        if rotation is None:
            return gravity
        in_base = rotation[0] @ gravity[0]
        if np.allclose(in_base, GRAVITY_M_S2, rtol=0.0, atol=1e-6):
            in_base = GRAVITY_M_S2
        turned = in_base.copy()
        for effect in effects:
            turned = effect.gravity(turned)
        if np.array_equal(turned, in_base):
            return gravity
        return gravity + np.einsum("nji,j->ni", rotation, turned - in_base)


def numbers_of(effect: Effect, typical: Array) -> Mapping[str, Callable[[Array], Array]]:
    """Return how weights of columns become the effect's fitted parameters.

    Args:
        effect: Its `fitted` name the parameters.
        typical: Size of each column, (p,), in the parameters' units.

    Returns:
        By parameter, a function of the weights (p,).

    """
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
) -> Callable[[TablePlant], list[Columns] | str]:
    """Return how an effect shows in a table by the simulator.

    Args:
        effect: Changes nothing yet.
        of_the_load: Whether it shows only where the load is a file's and not fitted.

    Returns:
        The way in which it shows in a plant, or why it can't.

    """

    def in_table(plant: TablePlant) -> list[Columns] | str:
        if of_the_load and not plant.known_load:
            return "mass and centre are fitted (--tool)"
        return [plant.columns(effect)]

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
    """Return the way of columns of a joint's lag.

    Args:
        values: Columns, (n,) or (n, k), rad.
        name: Name of the parameter.
        size: The parameter as a function of the weights.
        positive: Whether only weights with a parameter above 0 are allowed.

    Returns:
        Columns of one channel.

    """
    allowed = (lambda w: bool(size(w) > 0.0)) if positive else (lambda w: True)
    return Columns(values.reshape(len(values), 1, -1), {name: size}, allowed=allowed)
