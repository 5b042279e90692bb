# SPDX-License-Identifier: Apache-2.0
"""Pairs of a measured table: readings as they were, and the others with a known effect in them.

No simulation has a real sensor's own errors. Every other reading of a table is the reference; to
the others is added what an effect changes of the load's wrench W = (m g, c x m g). Load and offset
are those of least squares over the whole table, and sigma_k is what they leave of an axis.

How clear an effect is, D, is its distance from none beside a new offset. The reference is as noisy,
so that the variance counts twice: with d what the effect changes,

    D^2 = sum_k |d_k - mean d_k|^2 / (2 sigma_k^2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.arrays.tables import OrientationTable, read_table
from galen_model.arm.arm import STANDARD_GRAVITY_M_S2
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from galen_model.load.identification import plain_least_squares
from galen_model.load.model import gravity_regressor
from scipy.spatial.transform import Rotation

from galen_validation.blind.baselines import simple_answers
from galen_validation.blind.session import any_direction

TABLE, EARLIER = "table.csv", "reference.csv"
"""Of a pair's folder."""
CLEAR = 10.0
"""D from which on an effect is to be found."""
_LARGEST_D = 40.0
_FEWEST = 16
_DRAWS = 20

Sized = Callable[[float], tuple[Array, Mapping[str, Any]]]
"""Of a share -1 ... 1 of the largest size the change (n, 6) and its true parameters."""
Draw = Callable[[np.random.Generator, "_Later"], Sized]


@dataclass(frozen=True)
class _Later:
    """Readings that get an effect: their load's wrench W (n, 6), its mass, sigma (6,)."""

    wrench: Array
    mass_kg: float
    sigma: Array

    @property
    def weight(self) -> float:
        """The load's, N."""
        return self.mass_kg * STANDARD_GRAVITY_M_S2

    def whitened(self, change: Array) -> Array:
        """Return a change (n, 6, ...), less its mean, in units of the noise: (6 n, ...)."""
        centred = change - change.mean(axis=0)
        scale = (math.sqrt(2.0) * self.sigma).reshape(6, *[1] * (change.ndim - 2))
        return np.asarray((centred / scale).reshape(-1, *change.shape[2:]))

    def families(self) -> dict[str, list[Array]]:
        """Return each effect's columns (n, 6, p), a group for each place where it may be."""
        w, eye = self.wrench, np.eye(6)
        force, n = w[:, :3], len(w)
        zero = np.zeros((n, 3))
        turned = [np.concatenate([np.cross(f, a) for f in (force, w[:, 3:])], 1) for a in np.eye(3)]
        moved = [np.concatenate([zero, np.cross(a, force)], axis=1) for a in np.eye(3)]
        squares = [w[:, [k]] * other[:, [k]] * eye[k] for k in range(6) for other in (w, np.abs(w))]
        steps = ((np.arange(n) >= first)[:, None, None] * eye for first in range(1, n))
        return {
            "axis_gain": [w[:, :, None] * eye],
            "crosstalk": [(w[:, [a]] * eye[b])[:, :, None] for a, b in permutations(range(6), 2)],
            "sensor_mount_rotation": [np.stack(turned, axis=2)],
            "sensor_nonlinearity": [one[:, :, None] for one in squares],
            "bias_step": list(steps),
            "tool_com_error": [np.stack(moved, axis=2)],
            "tool_mass_error": [w[:, :, None]],
        }

    def fits(self, rows: Array) -> dict[str, tuple[float, int]]:
        """Return the sum of squares that each effect leaves of whitened rows, and its parameters.

        The effect is as large as it likes, and where it leaves least.
        """
        found: dict[str, tuple[float, int]] = {}
        for name, groups in self.families().items():
            for columns in map(self.whitened, groups):
                basis, size, _ = np.linalg.svd(columns, full_matrices=False)
                basis = basis[:, size > 1e-9 * size[0]]
                rest = float(np.sum((rows - basis @ (basis.T @ rows)) ** 2))
                one = rest, columns.shape[1]
                found[name] = min(one, found.get(name, one))
        return found


def _gain(rng: np.random.Generator, later: _Later) -> Sized:
    gain = 0.1 * np.eye(6)[rng.integers(3)]
    return lambda s: (s * gain * later.wrench, {"gain": (s * gain).tolist()})


def _crosstalk(rng: np.random.Generator, later: _Later) -> Sized:
    a, b = (int(axis) for axis in rng.permutation(3)[:2])
    names = {"from": WRENCH_AXES[a], "to": WRENCH_AXES[b]}
    change = 0.1 * later.wrench[:, [a]] * np.eye(6)[b]
    return lambda s: (s * change, {**names, "coefficient": 0.1 * s})


def _turned(rng: np.random.Generator, later: _Later) -> Sized:
    axis = 0.1 * any_direction(rng)

    def sized(share: float) -> tuple[Array, Mapping[str, Any]]:
        turn = Rotation.from_rotvec(share * axis).as_matrix()
        parts = later.wrench.reshape(-1, 2, 3)
        change = (parts @ turn).reshape(-1, 6) - later.wrench
        return change, {"rotvec_rad": (share * axis).tolist()}

    return sized


def _square(rng: np.random.Generator, later: _Later) -> Sized:
    k = int(rng.integers(3))
    coefficient = 0.1 / later.weight
    change = coefficient * later.wrench[:, [k]] ** 2 * np.eye(6)[k]
    return lambda s: (s * change, {"axis": WRENCH_AXES[k], "coefficient": s * coefficient})


def _step(rng: np.random.Generator, later: _Later) -> Sized:
    first = int(rng.uniform(0.3, 0.7) * len(later.wrench))
    torque = later.weight * 0.003 * any_direction(rng)
    step = np.concatenate([0.1 * later.weight * any_direction(rng), torque])
    change = (np.arange(len(later.wrench)) >= first)[:, None] * step
    return lambda s: (s * change, {"step": (s * step).tolist()})


def _centre(rng: np.random.Generator, later: _Later) -> Sized:
    delta_m = 0.01 * any_direction(rng)
    force = later.wrench[:, :3]
    change = np.concatenate([np.zeros_like(force), np.cross(delta_m, force)], axis=1)
    return lambda s: (s * change, {"delta_m": (s * delta_m).tolist()})


def _mass(_: np.random.Generator, later: _Later) -> Sized:
    change = 0.1 * later.wrench
    return lambda s: (s * change, {"delta_kg": 0.1 * s * later.mass_kg})


DRAWN: Mapping[str, Draw] = {
    "axis_gain": _gain,
    "crosstalk": _crosstalk,
    "sensor_mount_rotation": _turned,
    "sensor_nonlinearity": _square,
    "bias_step": _step,
    "tool_com_error": _centre,
    "tool_mass_error": _mass,
}
"""Effects that a table shows, each with how a seed draws it."""


@dataclass(frozen=True)
class Pair:
    """A reference (n, 6) and later readings (m, 6) with their table's rows.

    parameters: true ones of the effect, None without one. d: how clear it is. acceptable: names
    that the later readings can't separate from it.
    """

    table: OrientationTable
    earlier_rows: np.ndarray
    later_rows: np.ndarray
    later: Array
    parameters: Mapping[str, Any] | None = None
    d: float = 0.0
    acceptable: tuple[str, ...] = ()

    def write(self, directory: Path) -> None:
        """Write both tables.

        Args:
            directory: Gets TABLE and EARLIER; made where it is missing.

        """
        directory.mkdir(parents=True, exist_ok=True)
        earlier = self.table.wrench[self.earlier_rows]
        for name, rows, wrench in (
            (TABLE, self.later_rows, self.later),
            (EARLIER, self.earlier_rows, earlier),
        ):
            # No time: the reference's readings are between the others, and not before.
            numbers = np.concatenate([wrench, self.table.gravity[rows]], axis=1)
            lines = [",".join((*WRENCH_AXES, "gx", "gy", "gz"))]
            lines += [",".join(f"{x:.9g}" for x in row) for row in numbers]
            write_whole(directory / name, "\n".join(lines) + "\n")


def pair_of(path: Path, seed: int, effect: str | None, tellable: float) -> Pair:
    """Draw a pair of a measured table.

    Args:
        path: Table with orientations whose first line names its columns.
        seed: Draws which half is the reference, and the effect's place and size.
        effect: One of DRAWN; None for no effect.
        tellable: D that another effect must leave to be separated from this one.

    Returns:
        The pair; its D is CLEAR or more, unless a tenth of the load doesn't reach it.

    Raises:
        GalenError: The table can't be read, or has too few readings.

    """
    table = read_table(path, arm=GALEN)
    if len(table) < _FEWEST:
        raise GalenError(f"{path}: {len(table)} readings; a pair needs at least {_FEWEST}")
    rng = np.random.default_rng(seed)
    first = int(rng.integers(2))
    numbers = np.arange(len(table))
    later_rows, earlier_rows = numbers[first::2], numbers[1 - first :: 2]
    measured = table.wrench[later_rows]
    if effect is None:
        return Pair(table, earlier_rows, later_rows, measured)
    later = _later(table, table.gravity[later_rows])
    wanted = CLEAR * (_LARGEST_D / CLEAR) ** rng.random()
    for _ in range(_DRAWS):
        sized = DRAWN[effect](rng, later)
        share = wanted / float(np.linalg.norm(later.whitened(sized(1.0)[0])))
        if share <= 1.0:
            break
    share = min(share, 1.0) * float(rng.choice([-1.0, 1.0]))
    change, parameters = sized(share)
    rows = later.whitened(change)
    d = float(np.linalg.norm(rows))
    rests = later.fits(rows)
    others = [n for n, (rest, _) in rests.items() if rest < tellable**2 and n != effect]
    same = (effect, *others, *(["none"] if d < tellable else []))
    return Pair(table, earlier_rows, later_rows, measured + change, parameters, d, same)


def simple_table_answers(folder: Path) -> dict[str, Any]:
    """Return the baselines' answers to a pair: what leaves least beside the reference's load.

    Args:
        folder: Folder of the pair.

    Returns:
        Answers in the form of `diagnosis.json`, by the method's name.

    Raises:
        GalenError: A table can't be read.

    """
    earlier, table = (read_table(folder / name, arm=GALEN) for name in (EARLIER, TABLE))
    later = _later(earlier, table.gravity)
    rows = later.whitened(table.wrench - later.wrench)
    return simple_answers(len(rows), float(rows @ rows), later.fits(rows))


def _later(fitted: OrientationTable, gravity: Array) -> _Later:
    """Return the load of a table under other directions of gravity (m, 3)."""
    moments, offset = plain_least_squares(fitted.gravity, fitted.wrench)
    rest = fitted.wrench - gravity_regressor(fitted.gravity) @ moments - offset
    wrench = gravity_regressor(gravity) @ moments
    return _Later(wrench, float(moments[0]), np.std(rest, axis=0))
