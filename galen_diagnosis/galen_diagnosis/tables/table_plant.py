"""What a sensor that an orientation table is of would read, by the simulator's own effects.

A table tells gravity in the sensor and, perhaps, the sensor's rotation in its base; no joints. The
effects' hooks that need no more are called as the replay calls them (`galen_sim_driver.replay`):

    reading = read(W(tool_load(load); R^T gravity(g))) + wrench(posture's motion)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import GRAVITY_M_S2
from galen_model.arm.sensor_motion import SensorMotion
from galen_model.arrays import Array
from galen_model.load.model import Load
from galen_sim_driver.effects.effect import Effect, Instants, Posture


@dataclass(frozen=True)
class TablePlant:
    """A load on a sensor at n moments.

    gravity (n, 3) in the sensor, m/s^2; rotation R_base_sensor (n, 3, 3), None if not told; at_s
    (n,); motion: of the sensor, None if not told. offset (6,): the reading's constant part.
    """

    gravity: Array
    rotation: Array | None
    at_s: Array
    load: Load
    offset: Array
    motion: SensorMotion | None = None

    def reading(self, effects: Sequence[Effect] = ()) -> Array:
        """(n, 6), N and N.m in the sensor's frame."""
        when = Instants("", self.at_s, self.at_s)
        gravity = self._gravity(effects)
        direction = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
        mass = self.load.mass_kg
        com = np.broadcast_to(np.asarray(self.load.com_m, dtype=float), gravity.shape)
        for effect in effects:
            mass, com = effect.tool_load(mass, com, direction)
        total = np.concatenate([mass * gravity, np.cross(com, mass * gravity)], axis=1)
        if self.motion is not None:
            posture = self._posture(gravity)
            for effect in effects:
                more = effect.wrench(when, posture)
                total = total if more is None else total + more
        for effect in sorted(effects, key=lambda one: one.order):
            if not effect.after_noise:
                total = effect.read(when, total)
        total = total + self.offset
        for effect in effects:
            if effect.after_noise:  # a range is of the whole reading
                total = effect.read(when, total)
        return np.asarray(total)

    def change(self, effect: Effect) -> Array:
        """What an effect adds to the reading (n, 6)."""
        return self.reading([effect]) - self.reading()

    def _gravity(self, effects: Sequence[Effect]) -> Array:
        turned = GRAVITY_M_S2.copy()
        for effect in effects:
            turned = effect.gravity(turned)
        if self.rotation is None or np.array_equal(turned, GRAVITY_M_S2):
            return self.gravity
        return self.gravity + np.einsum("nji,j->ni", self.rotation, turned - GRAVITY_M_S2)

    def _posture(self, gravity: Array) -> Posture:
        count = len(gravity)
        rotation = np.zeros((count, 3, 3)) if self.rotation is None else self.rotation
        nowhere = np.zeros((count, 3))
        return Posture(
            joints=np.zeros((count, 5)),
            rotation=rotation,
            origin=nowhere,
            gravity=gravity,
            motion=self.motion,
            tool=self.load,
            adapter=Load(0.0),
            tip_m=np.zeros(3),
        )
