"""Identify tool and adapter with a sensor whose bias drifts over the sweeps.

Each sweep has six curves of its own (the sensor may have been zeroed in between), of a shape that
held-out blocks choose (below); the fit is `drifting_bias`. What comes out is an
`Identification` whose offsets are the biases at the end of each sweep, because they are what holds
for the first readings that the calibration is used on, and whose covariances hold the bias drift.
Where a constant bias is chosen, it is that of `identification`, to the last digit.

**The choice.** Blocks of poses that follow each other in time are held out in turn. Each candidate
is fitted to the rest, and says with which density it expects each held-out reading: a block inside
a sweep is bridged by the curve between its neighbours, a block at an end is reached by
extrapolation (a walk stays where it was, a straight line and a smooth curve go on). The log density
is that of Student's t, because sigma is estimated; it is a proper score (Gneiting and Raftery, *J.
Am. Stat. Assoc.* 102, 2007), so that it tells whether the stated errors are true as well as whether
the predictions are near, which a mean square alone doesn't. A block counts by the mean over its
readings, each on its own: their joint density would ask how readings of one moment follow each
other, such as creep within a stop, and not how well the gap is bridged, on which the load hangs.

The candidate with the highest sum is taken if it beats a constant bias by more than two standard
errors over the blocks (after Breiman et al., *Classification and Regression Trees*, 1984, section
3.4.3, who take one); else, and with fewer than twelve poses, the bias is constant. Forces and
torques choose on their own: they share no parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.distributions import student_t_logpdf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.evidence.block_gain import BlockGain, block_gain
from galen_model.files.calibration_file import LoadEstimate
from galen_model.load.drifting_bias import (
    BiasDriftFit,
    BiasShape,
    Problem,
    Shape,
    Shapes,
    Sweeps,
    agreeing,
    fit_drifting,
    settle,
)
from galen_model.load.identifiability import LOAD_PARAMETERS, check_excitation
from galen_model.load.identification import (
    MIN_POSES,
    Identification,
    StillPoses,
    check_channels,
    check_count,
    check_rejections,
    identify_one_sweep,
    identify_two_sweeps,
    load_estimate,
    one_sweep_prior,
    one_sweep_result,
    two_sweeps_design,
    two_sweeps_result,
)
from galen_model.load.model import gravity_regressor
from galen_model.load.robust_fit import MIN_POSES_TO_REJECT, PRIOR_READINGS

CANDIDATES = (
    BiasShape(),
    BiasShape(Shape.LINEAR),
    *(BiasShape(Shape.WALK, roughness) for roughness in (1.0, 3.0, 10.0, 30.0, 100.0)),
    *(BiasShape(Shape.SMOOTH, roughness) for roughness in (3.0, 10.0, 30.0, 100.0, 300.0)),
)
"""What is tried; the first is what the others have to beat."""


class BiasMode(StrEnum):
    """What a calibration takes the sensor's bias for."""

    CONSTANT = "constant"
    BIAS_DRIFTING = "drifting"
    AUTO = "auto"


BLOCKS = 8
_FEWEST_BLOCKS = 3
_FEWEST_POSES = 12  # as for outliers: too few to say what is noise and what is not
# What outliers are found with, before anything is chosen: follows most drifts, but no single pose.
_FIRST_GUESS = BiasShape(Shape.WALK, 10.0)


@dataclass(frozen=True)
class Choice:
    """What was chosen.

    shapes: of forces and torques; gain, gain_std: by how much log density per block each beats the
    first candidate, and the standard error over the `blocks` that could be scored.
    """

    shapes: Shapes
    candidates: int
    gain: tuple[float, float]
    gain_std: tuple[float, float]
    blocks: int

    @property
    def constant(self) -> bool:
        """Whether nothing drifts."""
        return all(shape.shape is Shape.CONSTANT for shape in self.shapes)

    def __str__(self) -> str:
        """In words, as in "forces walk (10 sigma over a sweep), torques constant"."""
        return f"forces {self.shapes[0]}, torques {self.shapes[1]}"


@dataclass(frozen=True)
class SweepBiasDrift:
    """How the bias went over a calibration.

    choice: the shapes, and by how much held-out blocks prefer them to a constant bias. bare (m, 6)
    or None, tool (n, 6): the bias at each pose, N and N.m; None where it was found constant.
    mass_growth: how many times larger the bias drift makes the mass's standard deviation than a
    constant bias with the same noise would.
    """

    choice: Choice
    bare: Array | None
    tool: Array | None
    mass_growth: float


def time_blocks(time_s: Array, segment: np.ndarray, blocks: int) -> np.ndarray:
    """Labels (n,) of `blocks` runs of poses that follow each other, none across two sweeps."""
    order = np.lexsort((time_s, segment))
    labels = np.empty(len(time_s), dtype=int)
    first = 0
    counts = np.bincount(segment)
    for count in counts:
        share = max(1, round(blocks * count / len(time_s)))
        share = min(share, count)
        labels[order[first : first + count]] = (
            1000 * len(labels) + first + np.arange(count) * share // count
        )
        first += count
    return np.unique(labels, return_inverse=True)[1]


def choose_by_mode(
    sweeps: Sweeps, mode: BiasMode, groups: np.ndarray | None = None
) -> Choice | None:
    """Choose among all candidates (auto), or among those that drift; None for a constant bias."""
    if mode is BiasMode.CONSTANT:
        return None
    tried = CANDIDATES if mode is BiasMode.AUTO else CANDIDATES[2:]
    return choose_shapes(sweeps, tried, groups)


def choose_shapes(
    sweeps: Sweeps,
    candidates: tuple[BiasShape, ...] = CANDIDATES,
    groups: np.ndarray | None = None,
) -> Choice:
    """Choose among `candidates`; groups (n,): blocks to hold out (None: `BLOCKS` of neighbours).

    Where too few blocks can be spared, the first candidate is taken, with a gain of 0.
    """
    used = np.ones(len(sweeps), dtype=bool)
    if len(sweeps) >= MIN_POSES_TO_REJECT:
        used = agreeing(sweeps, (_FIRST_GUESS, _FIRST_GUESS))
    if groups is None:
        groups = time_blocks(sweeps.time_s, sweeps.segment, BLOCKS)
    scores = []
    for label in np.unique(groups[used]):
        held = used & (groups == label)
        try:
            scores.append([_density(sweeps, shape, used & ~held, held) for shape in candidates])
        except IdentificationError:  # the others don't tell the load
            continue
    if len(scores) < _FEWEST_BLOCKS or len(sweeps) < _FEWEST_POSES:
        first = candidates[0]
        return Choice((first, first), len(candidates), (0.0, 0.0), (np.nan, np.nan), len(scores))
    gain = np.array(scores)  # (blocks, candidates, kinds)
    gain -= gain[:, :1]
    chosen, gains = [], []
    for kind in range(2):
        best = int(np.argmax(gain[:, :, kind].sum(axis=0)))
        over_first = block_gain(gain[:, best, kind])
        if not over_first.clear:
            best, over_first = 0, BlockGain(0.0, 0.0)
        chosen.append(candidates[best])
        gains.append(over_first)
    return Choice(
        (chosen[0], chosen[1]),
        len(candidates),
        (gains[0].mean, gains[1].mean),
        (gains[0].std, gains[1].std),
        len(scores),
    )


def _density(
    sweeps: Sweeps, shape: BiasShape, known: np.ndarray, held: np.ndarray
) -> tuple[float, float]:
    """Log density of the readings `held` (n,) by a fit to those `known` (n,): forces, torques."""
    problem = Problem(sweeps, (shape, shape), known.astype(float))
    values, covariance, sigma, freedom = settle(problem, tolerance=1e-3)
    rows, inverse = problem.rows[0][held], problem.inverse[0]
    own = 1.0 + np.sum((rows @ inverse) * rows, axis=1)
    result = np.zeros(6)
    for channel, curve in enumerate(problem.curves(values)):
        design = sweeps.design[held, channel]
        miss = sweeps.readings[held, channel] - design @ values - rows @ curve
        free = design - rows @ problem.curve_x[channel]
        variance = sigma[channel] ** 2 * own
        variance += np.maximum(np.sum((free @ covariance) * free, axis=1), 0.0)
        known_by = freedom[channel] + PRIOR_READINGS
        result[channel] = np.mean(student_t_logpdf(miss, known_by, np.sqrt(variance)))
    return float(result[:3].sum()), float(result[3:].sum())


MOST_COM_STD_M = 0.02
"""Standard deviation of a centre beyond which it counts as not told."""


@dataclass(frozen=True)
class DriftingLoad:
    """A load, and the six curves of its sensor's bias.

    choice: of the shapes (None: constant was asked for); found: fit and curves; bias_end (6,): the
    bias at the last reading, N and N.m.
    """

    load: LoadEstimate
    choice: Choice | None
    found: BiasDriftFit

    @property
    def bias_end(self) -> Array:
        """The bias (6,) at the last reading, N and N.m."""
        return self.found.fit.values[4:]

    def predict(self, gravity_sensor: ArrayLike, time_s: Array) -> Array:
        """Return reading (n, 6), N and N.m, under gravity (n, 3), m/s^2, at times (n,), s."""
        bias = self.found.bias_at(time_s, np.zeros(len(time_s), dtype=int))
        return gravity_regressor(gravity_sensor) @ self.load.load.moments + bias


def identify_drifting_load(
    gravity_sensor: ArrayLike,
    wrench: ArrayLike,
    time_s: Array,
    groups: np.ndarray | None = None,
    bias: BiasMode = BiasMode.AUTO,
) -> DriftingLoad:
    """Mass, centre and six curves from gravity (n, 3), readings (n, 6) and their times (n,), s.

    groups (n,): blocks that the choice holds out, from 0 on; None: runs of neighbours.
    Raises as `identification.identify_single_load` does.
    """
    gravity, reading = np.asarray(gravity_sensor, dtype=float), np.asarray(wrench, dtype=float)
    if len(gravity) < MIN_POSES:
        raise IdentificationError(f"{len(gravity)} still poses; at least {MIN_POSES} are needed")
    rows = gravity_regressor(gravity)
    offsets = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
    check_excitation(np.concatenate([rows, offsets], axis=2), LOAD_PARAMETERS[:4])
    sweeps = Sweeps(rows, reading, np.asarray(time_s, dtype=float), np.zeros(len(rows), dtype=int))
    choice = choose_by_mode(sweeps, bias, groups)
    shapes = (BiasShape(), BiasShape()) if choice is None else choice.shapes
    found = fit_drifting(sweeps, shapes)
    load = load_estimate(found.fit, slice(0, 4), "the load")
    check_told(load, found, "the load")
    return DriftingLoad(load, choice, found)


def check_told(load: LoadEstimate, found: BiasDriftFit, name: str) -> None:
    """Raise NotExcitedError where drift and load look so alike that the centre is not known."""
    worst = float(load.com_std_m.max())
    if worst > MOST_COM_STD_M:
        raise NotExcitedError(
            f"a drifting bias and {name} look alike in the order in which the poses were visited: "
            f"the standard deviation of its centre would be {worst * 1e3:.0f} mm, and the mass's "
            f"{found.growth[0]:.0f} times that under a constant bias; visit them in another order"
        )


_TELLING_GROWTH = 3.0


def identify_two_sweeps_drifting(
    bare: StillPoses,
    tool: StillPoses,
    zero_angles: ArrayLike | None = None,
    mode: BiasMode = BiasMode.AUTO,
) -> Identification:
    """As `identify_two_sweeps`; the poses need times. Raises as it does.

    NotExcitedError also where the order of the poses makes a bias drift look like a load.
    """
    named = {"without the tool": bare, "with the tool": tool}
    for name, poses in named.items():
        check_count(poses, f"sweep {name}")
    zero = gravity_regressor(tool.arm.gravity_in_sensor(zero_angles))
    bare_rows, tool_rows = gravity_regressor(bare.gravity) - zero, gravity_regressor(tool.gravity)
    design = two_sweeps_design(bare_rows, tool_rows, zero)
    check_excitation(design, LOAD_PARAMETERS, named)
    check_channels(bare_rows, bare, "sweep without the tool")
    check_channels(tool_rows, tool, "sweep with the tool")
    sweeps = Sweeps(
        design[:, :, :8],
        np.concatenate([bare.wrench, tool.wrench]),
        _times(bare, tool),
        np.repeat([0, 1], [len(bare), len(tool)]),
    )
    choice = choose_by_mode(sweeps, mode)
    if choice is None or choice.constant:
        found = identify_two_sweeps(bare, tool, zero_angles)
        return replace(
            found, bias_drift=None if choice is None else SweepBiasDrift(choice, None, None, 1.0)
        )
    fitted = fit_drifting(sweeps, choice.shapes)
    check_rejections(fitted.fit)
    result = two_sweeps_result(fitted.fit, bare, tool)
    check_told(result.load, fitted, "the tool")
    check_told(result.adapter, fitted, "the adapter")
    curves = fitted.bias[: len(bare)], fitted.bias[len(bare) :]
    return _with_bias_drift(result, SweepBiasDrift(choice, *curves, float(fitted.growth[0])))


def identify_one_sweep_drifting(
    tool: StillPoses,
    zero_angles: ArrayLike | None = None,
    mode: BiasMode = BiasMode.AUTO,
) -> Identification:
    """As `identify_one_sweep`; the poses need times, and the zeroing holds for the first of them.

    Raises as it does.
    """
    check_count(tool, "sweep with the tool")
    gravity_zero = tool.arm.gravity_in_sensor(zero_angles)
    rows = gravity_regressor(tool.gravity)
    offsets = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
    sum_design = np.concatenate([rows, offsets], axis=2)
    check_excitation(sum_design, LOAD_PARAMETERS[:4], {"with the tool": tool})
    check_channels(rows, tool, "sweep with the tool")
    prior_rows, prior_values, prior_std = one_sweep_prior(gravity_zero)
    weighted = prior_rows[:, :8] / prior_std[:, None] ** 2
    sweeps = Sweeps(
        np.concatenate([rows, rows - gravity_regressor(gravity_zero)], axis=2),
        tool.wrench,
        _times(tool),
        np.zeros(len(tool), dtype=int),
        weighted.T @ prior_rows[:, :8],
        weighted.T @ prior_values,
        zeroed=True,
    )
    choice = choose_by_mode(sweeps, mode)
    if choice is None or choice.constant:
        found = identify_one_sweep(tool, zero_angles)
        return replace(
            found, bias_drift=None if choice is None else SweepBiasDrift(choice, None, None, 1.0)
        )
    fitted = fit_drifting(sweeps, choice.shapes)
    check_rejections(fitted.fit)
    bias_drift = SweepBiasDrift(choice, None, fitted.bias, float(fitted.growth[0]))
    return _with_bias_drift(one_sweep_result(fitted.fit, tool, gravity_zero), bias_drift)


def _times(*sweeps: StillPoses) -> np.ndarray:
    times = [sweep.time_s for sweep in sweeps if sweep.time_s is not None]
    if len(times) != len(sweeps):
        raise IdentificationError("the still poses have no times, which a drifting bias needs")
    return np.concatenate(times)


def _with_bias_drift(found: Identification, bias_drift: SweepBiasDrift) -> Identification:
    """Add what the bias did, and tell what that costs."""
    parts = [part for part in (bias_drift.bare, bias_drift.tool) if part is not None]
    span = np.max([np.ptp(part, axis=0) for part in parts], axis=0)
    force, torque = int(np.argmax(span[:3])), 3 + int(np.argmax(span[3:]))
    text = (
        f"the sensor's bias drifted ({bias_drift.choice}), by up to {span[force]:.3f} N "
        f"({WRENCH_AXES[force]}) and {span[torque] * 1e3:.2f} mN.m ({WRENCH_AXES[torque]}) over a "
        "sweep; the offset written is that at the end"
    )
    if bias_drift.mass_growth > _TELLING_GROWTH:
        text += (
            ". In the order of these poses that looks like a load: the mass's standard deviation "
            f"is {bias_drift.mass_growth:.1f} times what it would be without; visit them in another"
        )
    return replace(found, bias_drift=bias_drift, warnings=(text, *found.warnings))
