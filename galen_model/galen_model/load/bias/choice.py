"""How a sweep's bias goes, constant, straight or drifting, chosen by held-out blocks of poses.

Blocks of poses that follow each other in time are held out in turn. Each candidate is fitted to
the rest, and says with which density it expects each held-out reading: a block inside a sweep is
bridged by the curve between its neighbours, a block at an end is reached by extrapolation (a walk
stays where it was, a straight line and a smooth curve go on). The log density is that of Student's
t, because sigma is estimated; it is a proper score (Gneiting and Raftery, *J. Am. Stat. Assoc.*
102, 2007), so that it tells whether the stated errors are true as well as whether the predictions
are near, which a mean square alone doesn't. A block counts by the mean over its readings, each on
its own: their joint density would ask how readings of one moment follow each other, such as creep
within a stop, and not how well the gap is bridged, on which the load hangs.

The candidate with the highest sum is taken if it beats a constant bias by more than two standard
errors over the blocks (after Breiman et al., *Classification and Regression Trees*, 1984, section
3.4.3, who take one); else, and with fewer than twelve poses, the bias is constant. Forces and
torques choose on their own: they share no parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from galen_model.arrays import Array
from galen_model.distributions import student_t_logpdf
from galen_model.errors import IdentificationError
from galen_model.evidence.block_gain import BlockGain, block_gain
from galen_model.load.bias.curve import BiasShape, Shape
from galen_model.load.bias.drifting import Problem, Shapes, Sweeps, agreeing, settle
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
