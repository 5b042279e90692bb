"""Which single effect fits a gap between still stops best, by its linear columns.

With r what is left of the stops' means and S an effect's columns
(`galen_diagnosis.experiment.separation`), all in units of the noise and with the sensor's zero N
projected out,

    r = S theta + noise,   theta ~ N(0, typical^2),   noise ~ N(0, s^2),

    log p(r) = -(r^T r - r^T S A^-1 S^T r) / (2 s^2) - log|A| / 2 - n log s,
    A = 1 + S^T S / s^2, S scaled by the typical sizes,

with s^2 what the effect that fits best leaves a row, at least 1: a law that isn't quite the arm's
must not make the rest sure. `unknown` has an error of its own at each stop. A quick look at poses
alone: effects of motion, of loads and of the tracker don't show here at all, twins share what they
have, and `diagnose` on a recording is what decides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from galen_model.arrays import Array
from galen_model.files.calibration_file import ToolFile
from galen_sim_driver.effects.registry import EFFECTS
from scipy.special import logsumexp

from galen_diagnosis.answer.answer import UNKNOWN
from galen_diagnosis.experiment.separation import slopes, typical_sizes
from galen_diagnosis.experiment.trial import Instruments, Trial, free_columns, still_trial
from galen_diagnosis.monitor.gap_watch import GapState, GapStop, count_poses

AT_REST = (
    "roll_zero_offset",
    "tilt_zero_offset",
    "tilt_gain",
    "tilt_axis_misalignment",
    "base_inclination",
    "sensor_mount_rotation",
    "axis_gain",
    "sensor_drift",
    "tool_mass_error",
    "tool_com_error",
    "loose_tool",
)
"""Effects that still poses show and that need no scan over axes or places."""

FEWEST_POSES = 6
_PRIOR_UNKNOWN = 0.1


def likely_effects(state: GapState, variances: Array, tool: ToolFile) -> list[tuple[str, float]]:
    """Effects and `unknown` with their probabilities, the likeliest first; empty for too few poses.

    variances (k, 6): of the stops' means without a gap.
    """
    test = state.test
    if test is None:
        return []
    stops = [state.stops[k] for k in test.kept]
    if count_poses([stop.joints for stop in stops]) < FEWEST_POSES:
        return []
    means = np.array([stop.mean for stop in stops])
    trial = _trial(stops, tool)
    # The trial's rows are in units of one deviation for all; here each stop has its own.
    scale = (trial.wrench_std / np.sqrt(variances[test.kept])).ravel()
    rest = ((means - test.zero) / trial.wrench_std).ravel() * scale
    free, _ = np.linalg.qr(free_columns([trial]) * scale[:, None])
    rest -= free @ (free.T @ rest)
    columns = {}
    for name in AT_REST:
        effects = (EFFECTS[name](),)
        _, raw = slopes([trial], effects)
        scaled = raw * typical_sizes(effects) * scale[:, None]
        columns[name] = scaled - free @ (free.T @ scaled)
    return _posterior(rest, columns, len(rest) - free.shape[1])


def _trial(stops: Sequence[GapStop], tool: ToolFile) -> Trial:
    joints = np.array([stop.joints for stop in stops])
    ends = np.array([stop.end_ns - stops[0].start_ns for stop in stops]) * 1e-9
    home = np.concatenate([joints[:, :3].mean(axis=0), np.zeros(2)])
    return still_trial(joints[:, 3:], ends, 0.1, tool, Instruments(), home)


def _posterior(rest: Array, columns: dict[str, Array], freedom: int) -> list[tuple[str, float]]:
    total = float(rest @ rest)
    fits = {}
    for name, matrix in columns.items():
        left = rest - matrix @ np.linalg.lstsq(matrix, rest, rcond=1e-9)[0]
        fits[name] = float(left @ left) / max(freedom - matrix.shape[1], 1)
    variance = max(min(fits.values()), 1.0)
    log = {name: _of_forms(rest, matrix, variance) for name, matrix in columns.items()}
    own = max(total / freedom, 1.0)
    log[UNKNOWN] = -0.5 * total / own - 0.5 * freedom * float(np.log(own))
    log = {
        name: value - (0.5 * freedom * float(np.log(variance)) if name != UNKNOWN else 0.0)
        for name, value in log.items()
    }
    prior = {name: (1.0 - _PRIOR_UNKNOWN) / len(columns) for name in columns}
    prior[UNKNOWN] = _PRIOR_UNKNOWN
    top = max(log.values())
    weight = {name: prior[name] * float(np.exp(log[name] - top)) for name in log}
    whole = sum(weight.values())
    found = [(name, value / whole) for name, value in weight.items()]
    return sorted(found, key=lambda pair: -pair[1])


def _of_forms(rest: Array, columns: Array, variance: float) -> float:
    """Of an effect: the mean over all its numbers together, and over each of them alone.

    So a twin with a second number that isn't needed isn't taken for the less likely one.
    """
    forms = [columns]
    if columns.shape[1] > 1:
        forms += [columns[:, [k]] for k in range(columns.shape[1])]
    return float(
        logsumexp([_log_evidence(rest, form, variance) for form in forms]) - np.log(len(forms))
    )


def _log_evidence(rest: Array, columns: Array, variance: float) -> float:
    """Up to n log s, which all of them share."""
    matrix = np.eye(columns.shape[1]) + columns.T @ columns / variance
    right = columns.T @ rest / variance
    gain = float(right @ np.linalg.solve(matrix, right))
    return -0.5 * float(rest @ rest) / variance + 0.5 * (gain - float(np.linalg.slogdet(matrix)[1]))
