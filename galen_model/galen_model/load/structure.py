"""Find what readings hold beside loads and constant biases: a drift, steps, gains, a rotation.

    y_ik = J_ik (x, r) + b_k(t_i) + e_ik

x are the loads' moments, r the sensor's response (ratios of its gains, its rotation), in which the
readings are linear near where Gauss-Newton ends (`mounting`), b_k the bias (`drifting_bias`): a
constant, a straight line, a walk, a smooth curve, each with or without a step, or, where the
temperature is known, a part that goes with it.

**The choice.** Blocks of poses that follow each other in time are held out in turn. Each candidate
is fitted to the rest, and says with which density it expects each held-out reading: a block inside
a sweep is bridged by the curve between its neighbours, a block at an end is reached by
extrapolation (a walk stays where it was, a straight line and a smooth curve go on). The log density
is that of Student's t, because sigma is estimated; it is a proper score (Gneiting and Raftery, *J.
Am. Stat. Assoc.* 102, 2007), so that it tells whether the stated errors are true as well as whether
the predictions are near, which a mean square alone doesn't. A block counts by the mean over its
readings, each on its own: their joint density would ask how readings of one moment follow each
other, such as creep within a stop, and not how well the gap is bridged, on which the load hangs.

Under each response, forces and torques choose the bias of the highest sum if it is clearly better
than a constant one (`clear`), and a step or temperature if that is clearly better yet; in a
calibration only axes whose readings it predicts better count, and get it. Of the responses the one
of the highest sum is taken if it is clearly better than none, and neither forces nor torques are
worse. In a sweep whose orientation goes with time a gain looks like a drift; the candidate that is
a gain predicts better.

A joint's zero or an inclination of the base turns weights as a rotation of the sensor does, but not
pushes. Where the angles are known, the rotation is taken only if it is clearly better than those.

The mean of the three force gains is a mass and that of the torque gains a centre; the response
holds their ratios alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.distributions import student_t_logpdf
from galen_model.errors import IdentificationError
from galen_model.evidence.block_gain import block_gain
from galen_model.load.drifting_bias import (
    BiasShape,
    Problem,
    Shape,
    Shapes,
    Sweeps,
    settle,
)
from galen_model.load.identifiability import LOAD_PARAMETERS, MAX_STD, check_excitation
from galen_model.load.mounting_identification import MountingProblem
from galen_model.load.robust_fit import PRIOR_READINGS

SHAPES = (
    BiasShape(),
    BiasShape(Shape.LINEAR),
    *(BiasShape(Shape.WALK, roughness) for roughness in (3.0, 10.0, 30.0, 100.0)),
    *(BiasShape(Shape.SMOOTH, roughness) for roughness in (10.0, 30.0, 100.0, 300.0)),
)
"""Biases that are tried; the first is what the others have to beat."""

RESPONSES = (
    (),
    ("gain_ratio",),
    ("sensor_rotation",),
    ("gain_ratio", "sensor_rotation"),
)
"""Groups of the mounting that are tried, the simplest first."""

_WITH_MORE = SHAPES[0], SHAPES[1], SHAPES[3], SHAPES[4]
"""Biases that are also tried with a step, and with a part that goes with the temperature."""

FLEXIBLE = BiasShape(Shape.WALK, 30.0)
"""Follows most drifts, but no single pose."""

BLOCKS = 8
FEWEST_BLOCKS = 5  # four say too little of chance
KINDS = slice(0, 3), slice(3, 6)
_STEPS_OF_NEWTON = 8
_SETTLED = 0.05  # of a standard deviation
_LARGEST_RESPONSE = 0.3  # rad or a gain: beyond, nothing is small
_FEWEST_BESIDE_A_STEP = 3
_LEAST_GAIN, _CLEAR_SIGMAS = 0.1, 3.0
"""Log density per block, and standard errors of it, that more than chance needs.

Several candidates are compared, so that two standard errors are often chance.
"""


@dataclass(frozen=True)
class Readings:
    """Still readings of one load, or of several, and how they hang on loads and response.

    problem: from groups of the mounting to the model; wrench (n, 6), N and N.m; gravity (n, 3) in
    the sensor, m/s^2; time_s (n,) s or None; segment (n,): which sweep, from 0 on; temperature_c
    (n,) deg C or None. zeroed: as `Sweeps` has it. rivals: groups that explain weights as a
    rotation of the sensor does, and leave pushes as they are.
    """

    problem: Callable[[Sequence[str]], MountingProblem]
    wrench: Array
    gravity: Array
    time_s: Array | None
    segment: np.ndarray
    temperature_c: Array | None = None
    zeroed: bool = False
    rivals: tuple[tuple[str, ...], ...] = ()

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.wrench)

    @property
    def order_s(self) -> Array:
        """Times (n,), s; where they are not known, the order."""
        return np.arange(float(len(self))) if self.time_s is None else self.time_s

    def sweeps_of(self, design: Array, wrench: Array, known: tuple[Array, Array] | None) -> Sweeps:
        """Return the linear problem of a design (n, 6, p)."""
        matrix, right = (None, None) if known is None else known
        return Sweeps(
            design, wrench, self.order_s, self.segment, matrix, right, self.zeroed,
            self.temperature_c,
        )  # fmt: skip

    def affine(self) -> Sweeps:
        """Return it for a fit in which each axis is affine in gravity, sweep by sweep.

        Gains, crosstalk and rotations of the sensor are in it.
        """
        rows = np.zeros((len(self), 6, int(self.segment.max()) + 1, 6, 3))
        for channel in range(6):
            rows[np.arange(len(self)), channel, self.segment, channel] = self.gravity
        return Sweeps(rows.reshape(len(self), 6, -1), self.wrench, self.order_s, self.segment)


@dataclass(frozen=True)
class Linear:
    """Readings made linear in loads and response; columns: those of `problem` without offsets."""

    groups: tuple[str, ...]
    problem: MountingProblem
    values: Array
    columns: Array
    sweeps: Sweeps

    @property
    def loads(self) -> Array:
        """Return the columns of the loads' moments."""
        return self.columns[self.columns < self.problem.model.linear]

    @property
    def whole_design(self) -> Array:
        """Columns (n, 6, p) of loads, offsets and response."""
        return self.problem.model.evaluate(self.values)[1]

    def check(self, rows: np.ndarray) -> None:
        """Raise NotExcitedError where the readings `rows` (n,) don't tell the loads."""
        count = len(self.loads)
        check_excitation(self.whole_design[rows], LOAD_PARAMETERS[:count])


def linear(
    readings: Readings,
    groups: tuple[str, ...],
    used: np.ndarray,
    response: Array | None = None,
) -> Linear:
    """Make readings linear by Gauss-Newton on those `used` (n,), under a bias that may drift.

    response: (q,) of `groups`, known nearly, near which to stay. Raises IdentificationError where
    the poses don't tell the response.
    """
    problem = readings.problem(groups)
    values = np.zeros(problem.known.rows.shape[1])
    if response is not None:
        values[problem.model.linear :] = response
    offsets = [c for s in problem.model.sweeps for c in range(s.offset.start, s.offset.stop)]
    columns = np.setdiff1d(np.arange(len(values)), offsets)
    loads = columns[columns < problem.model.linear]
    weights = used.astype(float)

    def made(at: Array) -> Sweeps:
        expected, jacobian = problem.model.evaluate(values)
        right = readings.wrench - expected + jacobian[:, :, at] @ values[at]
        known = problem.known.rows[:, at] / problem.known.std[:, None]
        prior = None
        if len(known):
            prior = known.T @ known, known.T @ (problem.known.values / problem.known.std)
        return readings.sweeps_of(jacobian[:, :, at], right, prior)

    for step in range(1 + _STEPS_OF_NEWTON):
        at = columns if step else loads
        sweeps = made(at)
        found, covariance, sigma, _ = settle(Problem(sweeps, (FLEXIBLE,) * 6, weights), 1e-2)
        change = np.abs(found - values[at])
        values = values.copy()
        values[at] = found
        if not groups or response is not None:
            break
        if np.any(np.abs(values[problem.model.linear :]) > _LARGEST_RESPONSE):
            raise IdentificationError("the readings fit no small gain or rotation")
        if step and np.all(change <= _SETTLED * np.sqrt(np.diag(covariance)) + 1e-11):
            problem.check(values, sigma, MAX_STD, used)
            break
    else:
        raise IdentificationError("the fit of a gain or rotation does not settle")
    if response is not None:
        sweeps = made(columns)
    return Linear(groups, problem, values, columns, sweeps)


@dataclass(frozen=True)
class LoadStructure:
    """What was found beside loads and constant biases.

    shapes: of the six axes' biases; held_out: (n, 6) residuals, N and N.m; NaN where not scored.
    alike: whether the sensor's rotation explains the poses as well.
    """

    linear: Linear
    shapes: Shapes
    held_out: Array
    alike: bool = False

    @property
    def groups(self) -> tuple[str, ...]:
        """The response's groups of the mounting."""
        return self.linear.groups

    @property
    def response(self) -> Array:
        """Return the response's values (q,), in the order of `groups`."""
        return self.linear.values[self.linear.problem.model.linear :]

    @property
    def drifts(self) -> bool:
        """Whether a bias is not constant."""
        return any(shape != SHAPES[0] for shape in self.shapes)

    def __str__(self) -> str:
        """In words, as in "drifting bias: forces linear, torques constant"."""
        told = [_RESPONSE_WORDS[group] for group in self.groups]
        if self.drifts:
            told.append(f"drifting bias: forces {self._told(0)}, torques {self._told(3)}")
        return " and ".join(told) or "constant bias"

    def _told(self, first: int) -> str:
        axes: dict[BiasShape, list[str]] = {}
        for k in range(first, first + 3):
            axes.setdefault(self.shapes[k], []).append(WRENCH_AXES[k])
        if len(axes) == 1:
            return str(self.shapes[first])
        return ", ".join(f"{shape} ({' '.join(names)})" for shape, names in axes.items())


_RESPONSE_WORDS = {
    "gain_ratio": "ratios of the axes' gains (their mean is taken as 1)",
    "sensor_rotation": "rotation of the sensor",
    "joint_zero": "zeros of the joints",
    "base_inclination": "inclination of the base",
}


def time_blocks(time_s: Array, segment: np.ndarray, blocks: int) -> np.ndarray:
    """Labels (n,) of `blocks` runs of poses that follow each other, none across two sweeps."""
    order = np.lexsort((time_s, segment))
    labels = np.empty(len(time_s), dtype=int)
    first = 0
    counts = np.bincount(segment)
    for count in counts:
        share = max(1, round(blocks * count / len(time_s)))
        share = min(share, count)
        labels[order[first : first + count]] = first + np.arange(count) * share // count
        first += count
    return np.unique(labels, return_inverse=True)[1]


def held_out(
    sweeps: Sweeps, shapes: Shapes, used: np.ndarray, groups: np.ndarray, equal: bool = False
) -> tuple[Array, Array]:
    """Hold out each block of `groups` (n,) in turn: residuals (n, 6) and their log densities.

    Only readings `used` (n,) are fitted; a label below zero is not held out. equal: all axes weigh
    alike, as in plain least squares, and there is no density. NaN where the rest tells no load.
    """
    residuals = np.full((len(sweeps), 6), np.nan)
    density = residuals.copy()
    try:
        sigma = settle(Problem(sweeps, shapes, used.astype(float)), 1e-2)[2]
    except IdentificationError:
        return residuals, density
    for label in np.unique(groups[groups >= 0]):
        held = groups == label
        try:
            problem = Problem(sweeps, shapes, (used & ~held).astype(float))
            if equal:
                values, _ = problem.solve(np.ones(6))
                expected = sweeps.design[held] @ values + problem.bias(values)[held]
                residuals[held] = sweeps.readings[held] - expected
                continue
            values, covariance, own_sigma, freedom = settle(problem, 1e-2, sigma)
        except IdentificationError:
            continue
        for channel, curve in enumerate(problem.curves(values)):
            rows, inverse = problem.rows[channel][held], problem.inverse[channel]
            design = sweeps.design[held, channel]
            miss = sweeps.readings[held, channel] - design @ values - rows @ curve
            free = design - rows @ problem.curve_x[channel]
            variance = own_sigma[channel] ** 2 * (1.0 + np.sum((rows @ inverse) * rows, axis=1))
            variance += np.maximum(np.sum((free @ covariance) * free, axis=1), 0.0)
            known_by = freedom[channel] + PRIOR_READINGS
            residuals[held, channel] = miss
            density[held, channel] = student_t_logpdf(miss, known_by, np.sqrt(variance))
    return residuals, density


def clear(gains: Array) -> bool:
    """Whether gains (blocks,) in log density are more than chance."""
    gains = gains[np.isfinite(gains)]
    if len(gains) < FEWEST_BLOCKS:
        return False
    # a block in which a curve gains far more would, by the scatter, speak against the curve
    mean, std = block_gain(np.minimum(gains, 2.0 * np.median(gains)))
    return mean > _LEAST_GAIN + _CLEAR_SIGMAS * std


def step_shape(sweeps: Sweeps, used: np.ndarray) -> BiasShape:
    """Return a constant bias with the one step, of all axes, that lowers the residual most.

    By the sum over the axes of the log of their sums of squares. Poses `used` (n,) count.
    """
    constant = (SHAPES[0],) * 6
    design, readings = sweeps.design[used], sweeps.readings[used]
    sigma = settle(Problem(sweeps, constant, used.astype(float)), 1e-2)[2]
    bias = sweeps.basis(SHAPES[0])[1][used]
    count, parameters, width = len(design), design.shape[2], bias.shape[1]
    whole = np.zeros((count, 6, parameters + 6 * width))
    whole[:, :, :parameters] = design
    for channel in range(6):
        first = parameters + width * channel
        whole[:, channel, first : first + width] = bias
    basis = np.linalg.qr((whole / sigma[:, None]).reshape(6 * count, -1))[0]
    rest = (readings / sigma).reshape(-1)
    rest = rest - basis @ (basis.T @ rest)
    best, found = np.inf, SHAPES[0]
    for sweep in range(int(sweeps.segment.max()) + 1):
        here = sweeps.segment[used] == sweep
        times = np.unique(sweeps.time_s[used][here])
        inner = range(_FEWEST_BESIDE_A_STEP, len(times) - _FEWEST_BESIDE_A_STEP + 1)
        for place in inner:
            after = here & (sweeps.time_s[used] >= times[place])
            columns = np.einsum("n,kj->nkj", after.astype(float), np.eye(6)).reshape(-1, 6)
            columns -= basis @ (basis.T @ columns)
            misfit = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
            value = float(np.sum(np.log(np.sum(misfit.reshape(-1, 6) ** 2, axis=0) + 1e-300)))
            if value < best:
                step = (sweep, float(times[place - 1]), float(times[place]))
                best, found = value, BiasShape(steps=(step,))
    return _placed(sweeps, found, used) if found.steps else found


def _placed(sweeps: Sweeps, shape: BiasShape, used: np.ndarray) -> BiasShape:
    """Return a step's shape with the step among the poses not used (n,) within its gap.

    A pose beside a jump stands out of what follows slow drifts; it lies before or after.
    """
    sweep, before_s, after_s = shape.steps[0]
    times = sweeps.time_s
    inside = (sweeps.segment == sweep) & (times > before_s) & (times < after_s)
    if not inside.any():
        return shape
    problem = Problem(sweeps, (shape,) * 6, used.astype(float))
    values, _, sigma, _ = settle(problem, 1e-2)
    residuals = (sweeps.readings - sweeps.design @ values - problem.bias(values)) / sigma
    step = np.array([curve[-1] for curve in problem.curves(values)]) / sigma
    part = np.interp(times, [before_s, after_s], [0.0, 1.0])[:, None]
    low = np.linalg.norm(residuals + part * step, axis=1)
    high = np.linalg.norm(residuals + (part - 1.0) * step, axis=1)
    places = np.array([before_s, *np.unique(times[inside]), after_s])
    costs = [np.sum(np.where(times <= place, low, high)[inside]) for place in places[:-1]]
    place = int(np.argmin(costs))
    return BiasShape(steps=((sweep, float(places[place]), float(places[place + 1])),))


def _shapes(readings: Readings, sweeps: Sweeps, used: np.ndarray) -> list[BiasShape]:
    """Return the biases that these readings allow to try."""
    if readings.time_s is None:
        return [SHAPES[0]]
    tried = list(SHAPES)
    steps = step_shape(sweeps, used).steps
    if steps:
        tried += [BiasShape(s.shape, s.roughness, steps) for s in _WITH_MORE]
    if readings.temperature_c is not None and np.ptp(readings.temperature_c) > 0.0:
        tried += [BiasShape(s.shape, s.roughness, thermal=True) for s in _WITH_MORE]
    return tried


def choose_structure(
    readings: Readings,
    used: np.ndarray,
    groups: np.ndarray,
    responses: Sequence[tuple[str, ...]] = RESPONSES,
    progress: Callable[[str], None] | None = None,
    *,
    by_axis: bool = False,
) -> LoadStructure:
    """Choose among all candidates by blocks `groups` (n,) of the readings `used` (n,).

    progress: told in words what is compared; what it raises comes through. by_axis: only axes that
    need a drift have it. It finds walks of single axes that else stay unseen in two thirds of
    simulated calibrations; on measured tables it predicted unseen stops worse.
    """
    found: dict[tuple[str, ...], tuple[LoadStructure, Array]] = {}

    def fit(response: tuple[str, ...]) -> None:
        try:
            problem = linear(readings, response, used)
        except IdentificationError:
            if not response:
                raise
        else:
            found[response] = _biases(readings, problem, used, groups, progress, by_axis=by_axis)

    def better(response: tuple[str, ...], than: tuple[str, ...]) -> bool:
        gain = found[response][1] - found[than][1]
        both = [gain[:, axes].sum(axis=1) for axes in KINDS]
        return clear(both[0] + both[1]) and not any(_lost(kind) for kind in both)

    def highest(some: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
        return max(some, key=lambda response: np.nansum(found[response][1]))

    for response in responses:
        fit(response)
    best: tuple[str, ...] = ()
    for count in (1, 2):
        some = [one for one in found if len(one) == count and better(one, best)]
        if some:
            best = highest(some)
    if "sensor_rotation" in best:
        others = [
            tuple(
                part
                for group in best
                for part in (rival if group == "sensor_rotation" else (group,))
            )
            for rival in readings.rivals
        ]
        for other in others:
            fit(other)
        fitting = [one for one in others if one in found and not better(best, one)]
        if fitting:
            return replace(found[highest(fitting)][0], alike=True)
    return found[best][0]


def _lost(gains: Array) -> bool:
    """Whether gains (blocks,) are losses beyond chance."""
    gains = gains[np.isfinite(gains)]
    return len(gains) >= FEWEST_BLOCKS and block_gain(gains).clear_loss


def _density(density: Array, used: np.ndarray, groups: np.ndarray) -> Array:
    """Mean log density (blocks, 6) of each block's readings that are used."""
    return np.array(
        [
            np.mean(density[used & (groups == label)], axis=0)
            for label in np.unique(groups[used & (groups >= 0)])
        ]
    )


def _biases(
    readings: Readings,
    problem: Linear,
    used: np.ndarray,
    groups: np.ndarray,
    progress: Callable[[str], None] | None,
    *,
    by_axis: bool,
) -> tuple[LoadStructure, Array]:
    """Choose forces' and torques' biases under one response; its density (blocks, 6)."""
    tried = {}
    for shape in _shapes(readings, problem.sweeps, used):
        if progress is not None:
            progress(f"comparing: {LoadStructure(problem, (shape,) * 6, np.zeros(0))}")
        tried[shape] = _held_out(problem, (shape,) * 6, used, groups)[1]
    shapes: list[BiasShape] = []
    for axes in KINDS:
        chosen, density = [SHAPES[0]] * 3, tried[SHAPES[0]][:, axes]
        # steps and temperature have to pay beside the curve that does without
        for plain in (True, False):
            some = [s for s in tried if (not s.steps and not s.thermal) is plain]
            gains = {s: tried[s][:, axes] - density for s in some}
            needed = {s: (np.nansum(g, axis=0) > 0.0) | (not by_axis) for s, g in gains.items()}
            total = {s: np.where(needed[s], gains[s], 0.0).sum(axis=1) for s in some}
            if not some:
                continue
            best = max(some, key=lambda shape: float(np.nansum(total[shape])))
            if clear(total[best]):
                pairs = zip(chosen, needed[best], strict=True)
                chosen = [best if need else shape for shape, need in pairs]
                density = np.where(needed[best], tried[best][:, axes], density)
        shapes += chosen
    residuals, density = _held_out(problem, shapes, used, groups)
    # beside the others' curves an axis may need none, which then costs its prediction
    for axis in range(6) if by_axis else ():
        without = [SHAPES[0] if k == axis else shape for k, shape in enumerate(shapes)]
        if without != shapes:
            other, sums = _held_out(problem, without, used, groups)
            if np.nansum(sums) >= np.nansum(density):
                shapes, residuals, density = without, other, sums
    return LoadStructure(problem, tuple(shapes), residuals), density


def _held_out(
    problem: Linear, shapes: Sequence[BiasShape], used: np.ndarray, groups: np.ndarray
) -> tuple[Array, Array]:
    """Return residuals (n, 6) and their mean log density (blocks, 6)."""
    residuals, density = held_out(problem.sweeps, tuple(shapes), used, groups)
    return residuals, _density(density, used, groups)
