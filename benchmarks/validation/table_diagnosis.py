"""Score `diagnose` on tables with a known cause, by other models than it fits.

A table's times and orientations stay, its wrenches are replaced: a load, autoregressive noise, and
a cause. Laws that differ from those that are fitted: drift is a random walk, a cable is a spring to
a place in the base, a step is a ramp, turns and gains are taken exactly. Unknown causes are ones
without a name on the list: a reading that bends with the load, a constant of each stop's own.

    python -m benchmarks.validation.table_diagnosis TABLE [--columns NAMES] [--cases N]

prints the share of right answers by cause; `SearchSettings` holds what was chosen by it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from galen_bags.arrays.orientation_table import OrientationTable, read_table
from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.tables.conclusion import BlockDiagnosis
from galen_diagnosis.tables.output import diagnose_rows
from galen_diagnosis.tables.table_plant import TablePlant
from galen_diagnosis.tables.table_rows import prepare_table
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.evidence.search import SearchSettings
from galen_model.load.model import Load
from galen_ros.command import EXIT_OK, run_command
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.registry import effect_from
from scipy.signal import lfilter
from tqdm import tqdm

NOISE = np.repeat([0.02, 0.001], 3)
"""N, N.m of one reading."""
_CORRELATION = 0.6
_LOAD = Load(0.9, np.array([0.004, -0.003, 0.045]))
_OFFSET = np.array([9.0, -1.0, 5.0, 0.4, -0.7, -0.15])
CAUSES = (
    NONE,
    "sensor_mount_rotation",
    "axis_gain",
    "crosstalk",
    "loose_tool",
    "base_inclination",
    "sensor_drift",
    "bias_step",
    "cable_drag",
    UNKNOWN,
)


def simulated(
    table: OrientationTable, cause: str, random: np.random.Generator, strength: float = 1.0
) -> tuple[OrientationTable, Array]:
    """The table with other wrenches, and still readings (n, 6) of the same sensor."""
    timed = table.timed()
    assert timed.time is not None
    at_s = timed.time - timed.time[0]
    plant = TablePlant(table.gravity, table.rotation, at_s, _LOAD, _OFFSET)
    effects = _effects(cause, random, strength)
    wrench = plant.reading(effects) + _more(cause, plant, table, random, strength)
    quiet = _noise(len(wrench), table.time is not None, random)
    still = _noise(700, False, random)
    return replace(table, wrench=wrench + quiet, block=None), still


def _effects(cause: str, random: np.random.Generator, strength: float) -> list[Effect]:
    numbers = _numbers(cause, random, strength)
    return [] if numbers is None else [effect_from(cause, numbers)]


def _numbers(cause: str, random: np.random.Generator, strength: float) -> dict[str, object] | None:
    if cause == "sensor_mount_rotation":
        return {"rotvec_rad": (strength * 0.03 * _unit(random, 3)).tolist()}
    if cause == "axis_gain":
        return {"gain": (strength * 0.04 * random.standard_normal(6)).tolist()}
    if cause == "crosstalk":
        origin, target = random.permutation(3)[:2]
        size = float(strength * 0.05 * random.choice([-1.0, 1.0]))
        return {"from": WRENCH_AXES[origin], "to": WRENCH_AXES[target], "coefficient": size}
    if cause == "loose_tool":
        return {"shift_m": strength * random.uniform(0.003, 0.006)}
    if cause == "base_inclination":
        about = (strength * 0.03 * _unit(random, 2)).tolist()
        return {"about_x_rad": about[0], "about_y_rad": about[1]}
    return None


def _more(
    cause: str,
    plant: TablePlant,
    table: OrientationTable,
    random: np.random.Generator,
    strength: float,
) -> Array:
    """What no effect's hook gives (n, 6)."""
    count, at_s = len(plant.at_s), plant.at_s
    span = at_s[-1]
    sizes = strength * np.repeat([0.15, 0.006], 3)
    if cause == "sensor_drift":
        walk = np.cumsum(random.standard_normal((count, 6)), axis=0) / np.sqrt(count)
        return np.asarray(2.0 * sizes * walk)
    if cause == "bias_step":
        when = span * random.uniform(0.25, 0.75)
        risen = np.clip((at_s - when) / (0.01 * span), 0.0, 1.0)
        return np.asarray(np.outer(risen, 3.0 * sizes * random.standard_normal(6)))
    if cause == "cable_drag":
        assert table.rotation is not None
        attached = np.array([0.03, 0.02, 0.08])
        held = np.array([0.4, -0.2, 0.3]) * random.choice([-1.0, 1.0], 3)
        way = held - table.rotation @ attached
        length = np.linalg.norm(way, axis=1, keepdims=True)
        pull = strength * 0.6 * (1.0 + 2.0 * (length - length.mean())) * way / length
        force = np.einsum("nji,nj->ni", table.rotation, pull)
        return np.concatenate([force, np.cross(attached, force)], axis=1)
    if cause == UNKNOWN:
        if random.random() < 0.5:
            weight = plant.reading() - plant.offset
            axis = random.integers(3)
            more = np.zeros((count, 6))
            more[:, axis] = strength * 0.03 * weight[:, axis] ** 2 / _LOAD.mass_kg / 9.8 * 2.0
            return more
        stops = np.concatenate(
            [[0], np.cumsum(np.linalg.norm(np.diff(plant.gravity, axis=0), axis=1) > 0.05)]
        )
        return np.asarray((2.0 * sizes * random.standard_normal((stops[-1] + 1, 6)))[stops])
    return np.zeros((count, 6))


def _unit(random: np.random.Generator, size: int) -> Array:
    vector = random.standard_normal(size)
    return np.asarray(vector / np.linalg.norm(vector))


def _noise(count: int, in_time: bool, random: np.random.Generator) -> Array:
    white = NOISE * random.standard_normal((count + 200, 6))
    if not in_time:
        return np.asarray(white[200:])
    scale = np.sqrt(1.0 - _CORRELATION**2)
    return np.asarray(lfilter([scale], [1.0, -_CORRELATION], white, axis=0)[200:])


def diagnose_case(
    table: OrientationTable,
    cause: str,
    seed: int,
    strength: float = 1.0,
    settings: SearchSettings | None = None,
) -> BlockDiagnosis:
    """A simulated table's diagnosis."""
    random = np.random.default_rng([seed, CAUSES.index(cause)])
    made, still = simulated(table, cause, random, strength)
    noise = still if table.time is None else None
    return diagnose_rows(cause, prepare_table(made, noise=noise), settings)


def is_right(found: BlockDiagnosis, cause: str) -> bool:
    """The verdict for none and unknown, else the cause alone, or among what can't be told apart."""
    answer = found.answer
    if cause in (NONE, UNKNOWN):
        return answer.verdict == cause
    named = [one for one in answer.causes if one.effect != UNKNOWN]
    return len(named) == 1 and cause in (named[0].effect, *named[0].equivalent)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="table_diagnosis", description="diagnose simulated tables"
    )
    parser.add_argument("table", metavar="TABLE", help="times and orientations are this table's")
    parser.add_argument("--columns", metavar="NAMES", help="as in diagnose")
    parser.add_argument("--cases", type=int, default=5, metavar="N", help="of each cause")
    parser.add_argument("--strength", type=float, default=1.0, metavar="S", help="1: clear")
    arguments = parser.parse_args(args)
    return run_command("table_diagnosis", lambda: _check(arguments))


def _check(arguments: argparse.Namespace) -> int:
    columns = arguments.columns.split(",") if arguments.columns else None
    table = read_table(arguments.table, columns)
    causes = [cause for cause in CAUSES if table.rotation is not None or cause != "cable_drag"]
    for cause in causes:
        right = wrong_and_sure = 0
        for seed in tqdm(range(arguments.cases), desc=cause, disable=None):
            found = diagnose_case(table, cause, seed, arguments.strength)
            right += is_right(found, cause)
            wrong_and_sure += found.answer.verdict == "identified" and not is_right(found, cause)
        print(f"{cause:24} right {right} of {arguments.cases}, wrong and sure {wrong_and_sure}")
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
