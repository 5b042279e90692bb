"""Which effects of the contract an orientation table can show, as columns.

A table holds gravity in the sensor and, perhaps, the sensor's rotation in its base; no joints.
Effects of geometry, load and sensor are the simulator's own: those hooks that need no joints are
called as the replay calls them (`galen_sim_driver.replay`), and differences give the columns,

    reading = read(W(tool_load(load); R^T gravity(g))).

Drift, step and cable, whose shape is open, are written out here:

    drift   any smooth course: the leading eigenvectors of exp(-(t - t')^2 / 2 l^2), six axes each
    step    0 before, 1 after a moment
    cable   a constant force F along the base's axes at a point r of the tool: R^T F, r x R^T F

A cable's pull along gravity weighs as mass does, so that its tension here is the level part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from galen_bags.arrays.tables import OrientationTable
from galen_model.arm.galen import GRAVITY_M_S2, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.evidence.held_out import Columns, Effects
from galen_model.load.identification import identify_single_load
from galen_model.load.model import Load
from galen_model.load.mounting import inclination_axes
from galen_model.rotation import skew
from galen_sim_driver.effects.effect import Effect, Fitted, Instants
from galen_sim_driver.effects.joints import base_inclination
from galen_sim_driver.effects.registry import EFFECTS

_HOUR_S = 3600.0
_STEP = 1e-3
_INCLINATIONS_RAD = (0.01, 0.1)
"""Usual sizes: of a base that is meant to be level, and of a mount that isn't known."""
_DRIFT_LENGTHS = (1.0, 0.25, 0.08)
"""Over the table's span; what bends faster than this, in s, is no bias drift."""
_FASTEST_DRIFT_S = 10.0
_DRIFT_SIZES_N = (0.03, 0.2)
_LEVER_M = 0.05
_CABLE_N = 0.3
_MOST_STEPS = 24
_SATURATION_SHARES = (0.97, 0.9, 0.75)
_KEPT = 0.999
_FEWEST_YAWS = 3

_BY_HOOKS = ("sensor_mount_rotation", "axis_gain", "loose_tool")
_OF_THE_LOAD = ("tool_mass_error", "tool_com_error")


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


def table_effects(
    plant: TablePlant,
    table: OrientationTable,
    nominal: Columns,
    *,
    known_load: bool,
    by_order: bool,
) -> Effects:
    """Return all effects that a table, of n readings, can show.

    known_load: the load is a file's and not fitted, so that it may be wrong. by_order: the order of
    readings is all that is known of time.
    """
    of: dict[str, Sequence[Columns]] = {}
    cannot: list[str] = []
    for name in (*_BY_HOOKS, *(_OF_THE_LOAD if known_load else ())):
        of[name] = [_by_hooks(plant, EFFECTS[name]())]
    if plant.rotation is None:
        cannot.append("base_inclination: the table has gravity alone, not the rotation")
    else:
        of["base_inclination"] = _inclinations(plant, table, known_load)
    of["crosstalk"] = [
        _by_hooks(plant, EFFECTS["crosstalk"](from_axis=a, to_axis=b), {"from": a, "to": b})  # type: ignore[call-arg]
        for a in WRENCH_AXES
        for b in WRENCH_AXES
        if a != b
    ]
    of["sensor_saturation"] = _saturation(plant)
    if plant.rotation is None:
        cannot.append("cable_drag: the table has gravity alone, not the rotation")
    elif _yaws(plant.rotation) < _FEWEST_YAWS:
        cannot.append("cable_drag: the sensor hardly turns about gravity, a level pull is a bias")
    else:
        of["cable_drag"] = [_cable(plant.rotation)]
    if not known_load:
        cannot.append("tool_mass_error, tool_com_error: mass and centre are fitted (--tool)")
    of["sensor_drift"] = drift_columns(plant.at_s, by_order)
    of["bias_step"] = _steps(plant.at_s)
    cannot.append("inertial_load, wrench_delay: rest segments have no motion")
    return Effects(nominal, of, tuple(cannot))


def _inclinations(plant: TablePlant, table: OrientationTable, known_load: bool) -> list[Columns]:
    """Return the columns of each usual size, exact at the load and angles that fit together.

    A load that was fitted under a wrong direction of gravity is a wrong one.
    """
    gravity = table.arm.gravity_m_s2
    level, angles = base_inclination(gravity)(), np.zeros(2)
    if not known_load:
        with suppress(IdentificationError):
            found = identify_single_load(
                plant.gravity, table.wrench, ["base_inclination"], plant.rotation, arm=table.arm
            )
            axes = ["xyz".index(axis) for axis in inclination_axes(gravity)]
            assert found.mounting is not None
            angles = found.mounting.base_inclination_rad[axes]
            plant = replace(plant, load=found.load.load)
    whole = plant.change(level.with_vector(angles))
    moved = [plant.change(level.with_vector(angles + step)) for step in _STEP * np.eye(2)]
    slope = (np.stack(moved, axis=2) - whole[:, :, None]) / _STEP
    if np.any(angles):
        slope += np.multiply.outer(whole - slope @ angles, angles / (angles @ angles))
    return [
        Columns(
            usual * slope,
            {
                part.name: _numbers(part, at, np.full(2, usual))
                for at, part in enumerate(level.fitted)
            },
        )
        for usual in _INCLINATIONS_RAD
    ]


def drift_columns(at_s: Array, by_order: bool = False) -> list[Columns]:
    """Return smooth courses of all six axes, of several lengths and sizes."""
    span = float(at_s[-1] - at_s[0])
    ways = []
    for share in _DRIFT_LENGTHS:
        if share < 1.0 and share * span < _FASTEST_DRIFT_S and not by_order:
            continue
        apart = (at_s[:, None] - at_s[None, :]) / (share * span)
        value, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
        kept = np.cumsum(value[::-1]) < _KEPT * value.sum()
        count = int(kept.sum()) + 1
        shapes = vectors[:, ::-1][:, :count] * np.sqrt(np.maximum(value[::-1][:count], 0.0))
        shapes = shapes - shapes.mean(axis=0)
        for size_n in _DRIFT_SIZES_N:
            sizes = size_n * np.repeat([1.0, _LEVER_M], 3)
            values = np.einsum("nk,cd->ncdk", shapes, np.diag(sizes)).reshape(len(at_s), 6, -1)
            ends = (shapes[-1] - shapes[0]) / span * _HOUR_S

            def rate(w: Array, ends: Array = ends, sizes: Array = sizes) -> Array:
                return np.asarray(sizes * (w.reshape(6, -1) @ ends))

            ways.append(Columns(values, {"rate_per_hour": rate}, {"bends_every_s": share * span}))
    return ways


def _steps(at_s: Array) -> list[Columns]:
    typical = EFFECTS["bias_step"].fitted[0].typicals
    gaps = np.arange(1, len(at_s))
    if len(gaps) > _MOST_STEPS:
        gaps = np.unique(np.linspace(1, len(at_s) - 1, _MOST_STEPS).round().astype(int))
    ways = []
    for first in gaps:
        after = (np.arange(len(at_s)) >= first).astype(float)
        values = np.einsum("n,cd->ncd", after, np.diag(typical))
        time_s = float((at_s[first - 1] + at_s[first]) / 2.0)
        ways.append(Columns(values, {"step": lambda w: typical * w}, {"time_s": time_s}))
    return ways


def _by_hooks(plant: TablePlant, effect: Effect, words: dict[str, str] | None = None) -> Columns:
    """Columns of an effect's fitted parameters, by differences at zero."""
    typical = np.concatenate([part.typicals for part in effect.fitted])
    columns = [
        plant.change(effect.with_vector(_STEP * size * unit)) / _STEP
        for size, unit in zip(typical, np.eye(len(typical)), strict=True)
    ]
    parameters, at = {}, 0
    for part in effect.fitted:
        parameters[part.name] = _numbers(part, at, typical)
        at += part.size
    return Columns(np.stack(columns, axis=2), parameters, words or {})


def _numbers(part: Fitted, at: int, typical: Array) -> Callable[[Array], Array]:
    rows = slice(at, at + part.size)
    if part.size == 1:
        return lambda w: typical[at] * w[at]
    return lambda w: typical[rows] * w[rows]


def _saturation(plant: TablePlant) -> list[Columns]:
    """Return an axis that clips at some share of the largest reading: on or off, no free size."""
    largest = np.abs(plant.reading()).max(axis=0)
    ways = []
    for axis, name in enumerate(WRENCH_AXES):
        for share in _SATURATION_SHARES:
            limit = float(share * largest[axis])
            effect = EFFECTS["sensor_saturation"](limit=limit, axis=name)  # type: ignore[call-arg]
            values = plant.change(effect)[:, :, None]
            words = {"axis": name, "limit": limit}
            ways.append(Columns(values, {}, words, allowed=lambda w: 0.5 < w[0] < 1.5))
    return ways


def _cable(rotation: Array) -> Columns:
    back = np.swapaxes(rotation, 1, 2)
    values = np.zeros((len(back), 6, 12))
    values[:, :3, :3] = _CABLE_N * back
    # r x R^T F is linear in the nine products r_i F_j
    for i, cross in enumerate(skew(np.eye(3))):
        values[:, 3:, 3 + 3 * i : 6 + 3 * i] = _CABLE_N * _LEVER_M * (cross @ back)
    tension = {"tension_N": lambda w: np.asarray(_CABLE_N * np.linalg.norm(w[:2]))}
    return Columns(values, tension)


def _yaws(rotation: Array) -> float:
    """How much of a level force in the base is no constant in the sensor: rank beside gravity."""
    level = np.swapaxes(rotation, 1, 2)[:, :, :2].reshape(len(rotation), 6)
    about = level - level.mean(axis=0)
    sizes = np.linalg.svd(about, compute_uv=False) / np.sqrt(len(rotation))
    return float(np.sum(sizes > 0.1))
