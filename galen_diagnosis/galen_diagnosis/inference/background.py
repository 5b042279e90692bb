"""What is fitted beside every hypothesis: unknowns that are no gap, and a healthy arm's tolerances.

No arm is the nominal one to the last micrometre. Its joints' zeros, its sensor's gains, its tool's
file are right within what workshops and calibrations reach; a gap is what lies beyond. Sizes are
standard deviations, and reasons stand beside them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from galen_model.arrays import Array
from galen_model.evidence.background import Background

from galen_diagnosis.effects.candidates import Candidate
from galen_diagnosis.observation.observation import UNKNOWNS, Observation, Unknowns
from galen_diagnosis.observation.rows import CHANNELS, TIP_AXES

_GAIN = 0.3e-3
_ANGLE = 0.1e-3

TOLERANCES: Mapping[tuple[str, str], float | tuple[float, ...]] = {
    # A level and a dial gauge set a joint's zero and the base to 0.1 ... 0.2 mrad.
    ("joint_zero_offset:roll", ""): _ANGLE,
    ("joint_zero_offset:tilt", ""): _ANGLE,
    ("joint_axis_misalignment:tilt", ""): _ANGLE,
    ("base_inclination", ""): (_ANGLE, _ANGLE),
    ("sensor_mount_rotation", ""): (_ANGLE,) * 3,
    # An encoder's scale over its travel.
    ("joint_gain:tilt", ""): 0.1e-3,
    # What is left of a sensor's gains after its maker's matrix and an adjustment on the arm.
    ("axis_gain", ""): (_GAIN,) * 6,
    # Samples are stamped when they are read: within a fraction of a period of 2 to 10 ms.
    ("wrench_delay", ""): 0.3e-3,
    # A camera's exposure and way are known to a fraction of its period of 3 to 17 ms.
    ("tracker_delay", ""): 1.0e-3,
    ("tracker_scale", ""): 0.05e-3,
    # A tool seated in its mount.
    ("loose_tool", ""): 0.01e-3,
    # What a static test on the arm repeats.
    ("joint_compliance", "roll"): 0.5e-2,
    ("joint_compliance", "tilt"): 0.5e-2,
    ("joint_compliance", "carriage"): 0.5e-2,
    ("joint_compliance", "rod"): 0.5e-2,
}

_ZERO_N, _ZERO_NM = 0.1, 2e-3
"""How far the sensor's zero may lie off, beside what its drift makes of it."""

_PLACE_M, _PLACE_RAD = 0.05e-3, 0.08e-3
"""How well the joints tell where the tip is, from one place of the arm to another: its geometry."""

_MASS_KG, _COM_M = 0.1e-3, 0.1e-3
"""What a tool's file may be off at most and still be right, however unsure it says it is itself."""


def unknown_columns(observation: Observation) -> Array:
    """How the prediction changes (N, 18) by each of `Unknowns`."""
    steps = np.array([1e-2] * 3 + [1e-3] * 3 + [1e-4] * 6 + [1.0] * 6)
    columns = []
    for k, step in enumerate(steps):
        values = np.zeros(UNKNOWNS)
        values[k] = step
        columns.append(observation.change((), Unknowns(values)) / step)
    return np.stack(columns, axis=1)


def background(
    observation: Observation, unknowns: Array, columns: Mapping[tuple[str, str], Array]
) -> Background:
    """Unknowns (N, 18), places of the arm, and tolerances, of the columns of candidates.

    columns: by effect and form, (N, p) at nominal.
    """
    parts = [unknowns]
    std = [np.array([_ZERO_N] * 3 + [_ZERO_NM] * 3 + [np.inf] * 12)]
    places = _place_columns(observation)
    parts.append(places)
    std.append(np.tile([_PLACE_M] * 3 + [_PLACE_RAD] * 3, places.shape[1] // 6))
    for key, size in tolerances(observation).items():
        if key in columns:
            parts.append(columns[key])
            std.append(np.atleast_1d(np.asarray(size, dtype=float)))
    return Background(np.concatenate(parts, axis=1), np.concatenate(std))


def tolerances(observation: Observation) -> dict[tuple[str, str], float | tuple[float, ...]]:
    """Tolerances of effects, the tool's file's among them."""
    load = observation.recording.tool.load
    mass = min(float(load.mass_std_kg), _MASS_KG)
    com = tuple(float(min(std, _COM_M)) for std in load.com_std_m)
    return {
        **TOLERANCES,
        ("tool_mass_error", ""): max(mass, 1e-6),
        ("tool_com_error", ""): tuple(max(std, 1e-6) for std in com),
    }


def key_of(candidate: Candidate) -> tuple[str, str]:
    """By which a candidate's columns are found."""
    return candidate.effect, candidate.label


def _place_columns(observation: Observation) -> Array:
    """Rows of the tip at each place of the arm: (N, 6 places), in the rows' units."""
    rows = observation.rows
    first = CHANNELS.index(TIP_AXES[0])
    tip = (rows.channel >= first) & (rows.channel < first + 6)
    gain = np.zeros(len(rows))
    # A constant becomes sqrt(n) / sigma in a row of n samples: one over the row's scale.
    gain[tip] = 1.0 / rows.scale[tip]
    places = [number for number in np.unique(rows.pose[tip]) if number >= 0]
    columns = np.zeros((len(rows), 6 * len(places)))
    for k, place in enumerate(places):
        for axis in range(6):
            here = tip & (rows.pose == place) & (rows.channel == first + axis)
            columns[here, 6 * k + axis] = gain[here]
    return columns
