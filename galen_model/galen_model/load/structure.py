# SPDX-License-Identifier: Apache-2.0
"""Find what readings hold beside loads and constant biases: a drift, steps, gains, a rotation.

    y_ik = J_ik (x, r) + b_k(t_i) + e_ik

x are the loads' moments, r the sensor's response (ratios of its gains, its rotation), in which the
readings are linear near where Gauss-Newton ends (`mounting`), b_k the bias (`estimation.curves`): a
constant, a straight line, a walk, a smooth curve, each with or without a step, or, where the
temperature is known, a part that goes with it.

**The choice.** Each candidate is scored on held-out blocks (`estimation.held_out`). Under each
response, forces and torques choose the bias of the highest sum if it is clearly better than a
constant one, and a step or temperature if that is clearly better yet; in a
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
from galen_model.errors import IdentificationError
from galen_model.estimation.curves import CONSTANT, BiasShape, Shape, Shapes
from galen_model.estimation.held_out import block_means, held_out, is_clear_gain, is_clear_loss
from galen_model.estimation.problem import Problem, Settled, gauss_newton
from galen_model.load.identifiability import MAX_STD
from galen_model.load.identification import check_mounting
from galen_model.load.reading_model import ReadingModel
from galen_model.load.readings import LoadReadings

SHAPES = (
    CONSTANT,
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
KINDS = slice(0, 3), slice(3, 6)
_STEPS_OF_NEWTON = 8
_LARGEST_RESPONSE = 0.3  # rad or a gain: beyond, nothing is small
_FEWEST_BESIDE_A_STEP = 3
_TOLERANCE = 1e-2  # of sigma


@dataclass(frozen=True)
class Linear:
    """Readings made linear near values (p,) of loads and of the response's `groups`."""

    groups: tuple[str, ...]
    model: ReadingModel
    values: Array
    problem: Problem


def linear(
    readings: LoadReadings,
    groups: tuple[str, ...],
    used: np.ndarray,
    response: Array | None = None,
) -> Linear:
    """Make readings linear by Gauss-Newton, under a bias that may drift.

    Args:
        readings: n of them.
        groups: of the mounting, the sensor's response.
        used: mask (n,) of the readings to fit.
        response: (q,) values of `groups`, known nearly, near which to stay; None: found.

    Returns:
        The linear problem and the values that it is made near.

    Raises:
        IdentificationError: the poses don't identify the response.

    """
    model = readings.model(groups)

    def solved(problem: Problem) -> Settled:
        return problem.under((FLEXIBLE,) * 6).solve(used).settle(_TOLERANCE)

    values = np.zeros(model.loads + len(model.entities))
    if response is not None:
        values[model.loads :] = response
    given = readings.linearised(model, values)  # of no load, which shows no response
    loads_alone = replace(given, design=given.design[..., : model.loads], known=readings.known)
    values[: model.loads] = solved(loads_alone).values
    if groups and response is None:
        largest = np.repeat([np.inf, _LARGEST_RESPONSE], [model.loads, len(model.entities)])
        found = gauss_newton(
            lambda near: solved(readings.linearised(model, near)), values, largest, _STEPS_OF_NEWTON
        )
        values = found.values
        check_mounting(readings, model, values, found.sigma, MAX_STD, used)
    return Linear(groups, model, values, readings.linearised(model, values))


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
        return self.linear.values[self.linear.model.loads :]

    @property
    def drifts(self) -> bool:
        """Whether a bias is not constant."""
        return any(shape != CONSTANT for shape in self.shapes)

    def __str__(self) -> str:
        """In words, as in "drifting bias: forces linear, torques constant"."""
        parts = [_RESPONSE_WORDS[group] for group in self.groups]
        if self.drifts:
            forces, torques = self._of_kind(0), self._of_kind(3)
            parts.append(f"drifting bias: forces {forces}, torques {torques}")
        return " and ".join(parts) or "constant bias"

    def _of_kind(self, first: int) -> str:
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


def step_shape(problem: Problem, used: np.ndarray) -> BiasShape:
    """Find the constant bias with one step, of all axes, that lowers the residual most.

    By the sum over the axes of the log of their sums of squares.

    Args:
        problem: n readings of six channels.
        used: mask (n,) of the readings that count.

    Returns:
        The shape with its step, or CONSTANT where no sweep has room for one.

    """
    design, readings = problem.design[used], problem.readings[used]
    sigma = problem.solve(used).settle(_TOLERANCE).sigma
    bias = problem.basis(CONSTANT)[1][used]
    count, parameters, width = len(design), design.shape[2], bias.shape[1]
    whole = np.zeros((count, 6, parameters + 6 * width))
    whole[:, :, :parameters] = design
    for channel in range(6):
        first = parameters + width * channel
        whole[:, channel, first : first + width] = bias
    basis = np.linalg.qr((whole / sigma[:, None]).reshape(6 * count, -1))[0]
    rest = (readings / sigma).reshape(-1)
    rest = rest - basis @ (basis.T @ rest)
    best, found = np.inf, CONSTANT
    for sweep in range(int(problem.segment.max()) + 1):
        here = problem.segment[used] == sweep
        times = np.unique(problem.time_s[used][here])
        inner = range(_FEWEST_BESIDE_A_STEP, len(times) - _FEWEST_BESIDE_A_STEP + 1)
        for place in inner:
            after = here & (problem.time_s[used] >= times[place])
            columns = np.einsum("n,kj->nkj", after.astype(float), np.eye(6)).reshape(-1, 6)
            columns -= basis @ (basis.T @ columns)
            misfit = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
            value = float(np.sum(np.log(np.sum(misfit.reshape(-1, 6) ** 2, axis=0) + 1e-300)))
            if value < best:
                step = (sweep, float(times[place - 1]), float(times[place]))
                best, found = value, BiasShape(steps=(step,))
    return _placed(problem, found, used) if found.steps else found


def _placed(problem: Problem, shape: BiasShape, used: np.ndarray) -> BiasShape:
    """Return a step's shape with the step among the readings not used (n,) within its gap.

    A pose beside a jump stands out of what follows slow drifts; it lies before or after.
    """
    sweep, before_s, after_s = shape.steps[0]
    times = problem.time_s
    inside = (problem.segment == sweep) & (times > before_s) & (times < after_s)
    if not inside.any():
        return shape
    equations = problem.under((shape,) * 6).solve(used)
    found = equations.settle(_TOLERANCE)
    residuals = equations.residuals(found.values) / found.sigma
    step = np.array([curve[-1] for _, curve in equations.curves(found.values)]) / found.sigma
    part = np.interp(times, [before_s, after_s], [0.0, 1.0])[:, None]
    low = np.linalg.norm(residuals + part * step, axis=1)
    high = np.linalg.norm(residuals + (part - 1.0) * step, axis=1)
    places = np.array([before_s, *np.unique(times[inside]), after_s])
    costs = [np.sum(np.where(times <= place, low, high)[inside]) for place in places[:-1]]
    place = int(np.argmin(costs))
    return BiasShape(steps=((sweep, float(places[place]), float(places[place + 1])),))


def _shapes(readings: LoadReadings, problem: Problem, used: np.ndarray) -> list[BiasShape]:
    """Return the biases that these readings allow to try."""
    if readings.time_s is None:
        return [CONSTANT]
    tried = list(SHAPES)
    steps = step_shape(problem, used).steps
    if steps:
        tried += [BiasShape(s.shape, s.roughness, steps) for s in _WITH_MORE]
    if readings.temperature_c is not None and np.ptp(readings.temperature_c) > 0.0:
        tried += [BiasShape(s.shape, s.roughness, thermal=True) for s in _WITH_MORE]
    return tried


def choose_structure(
    readings: LoadReadings,
    used: np.ndarray,
    groups: np.ndarray,
    responses: Sequence[tuple[str, ...]] = RESPONSES,
    progress: Callable[[str], None] | None = None,
    *,
    by_axis: bool = False,
) -> LoadStructure:
    """Choose among all candidates by held-out blocks.

    Args:
        readings: n of them.
        used: mask (n,) of those that may be fitted.
        groups: (n,) labels of the blocks; one below zero is not held out.
        responses: groups of the mounting to try, () among them.
        progress: called with a text on what is compared; what it raises comes through. None: not
            called.
        by_axis: only axes that need a drift have it. It finds walks of single axes that else stay
            unseen in two thirds of simulated calibrations; on measured tables it predicted unseen
            stops worse.

    Returns:
        The response, the shapes of the biases and the held-out residuals.

    Raises:
        IdentificationError: the loads can't be fitted even without a response.

    """
    found: dict[tuple[str, ...], tuple[LoadStructure, Array]] = {}

    def fit(response: tuple[str, ...]) -> None:
        try:
            near = linear(readings, response, used)
        except IdentificationError:
            if not response:
                raise
        else:
            found[response] = _biases(readings, near, used, groups, progress, by_axis=by_axis)

    def better(response: tuple[str, ...], than: tuple[str, ...]) -> bool:
        gain = found[response][1] - found[than][1]
        both = [gain[:, axes].sum(axis=1) for axes in KINDS]
        return is_clear_gain(both[0] + both[1]) and not any(is_clear_loss(kind) for kind in both)

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


def _biases(
    readings: LoadReadings,
    near: Linear,
    used: np.ndarray,
    groups: np.ndarray,
    progress: Callable[[str], None] | None,
    *,
    by_axis: bool,
) -> tuple[LoadStructure, Array]:
    """Choose forces' and torques' biases under one response; its density (blocks, 6)."""
    scores: dict[Shapes, tuple[Array, Array]] = {}
    for shape in _shapes(readings, near.problem, used):
        if progress is not None:
            progress(f"comparing: {LoadStructure(near, (shape,) * 6, np.zeros(0))}")
        scores[(shape,) * 6] = _held_out(near.problem, (shape,) * 6, used, groups)
    tried = {shape: density for (shape, *_), (_, density) in scores.items()}
    shapes: Shapes = ()
    for axes in KINDS:
        chosen, density = [CONSTANT] * 3, tried[CONSTANT][:, axes]
        # steps and temperature have to pay beside the curve that does without
        for plain in (True, False):
            some = [s for s in tried if (not s.steps and not s.thermal) is plain]
            gains = {s: tried[s][:, axes] - density for s in some}
            needed = {s: (np.nansum(g, axis=0) > 0.0) | (not by_axis) for s, g in gains.items()}
            total = {s: np.where(needed[s], gains[s], 0.0).sum(axis=1) for s in some}
            if not some:
                continue
            best = max(some, key=lambda shape: float(np.nansum(total[shape])))
            if is_clear_gain(total[best]):
                pairs = zip(chosen, needed[best], strict=True)
                chosen = [best if need else shape for shape, need in pairs]
                density = np.where(needed[best], tried[best][:, axes], density)
        shapes += tuple(chosen)
    residuals, density = scores.get(shapes) or _held_out(near.problem, shapes, used, groups)
    # beside the others' curves an axis may need none, which then costs its prediction
    for axis in range(6) if by_axis else ():
        without = tuple(CONSTANT if k == axis else shape for k, shape in enumerate(shapes))
        if without != shapes:
            other, sums = _held_out(near.problem, without, used, groups)
            if np.nansum(sums) >= np.nansum(density):
                shapes, residuals, density = without, other, sums
    return LoadStructure(near, shapes, residuals), density


def _held_out(
    problem: Problem, shapes: Sequence[BiasShape], used: np.ndarray, groups: np.ndarray
) -> tuple[Array, Array]:
    """Return residuals (n, 6) and their mean log density (blocks, 6)."""
    residuals, density = held_out(problem.under(tuple(shapes)), used, groups)
    return residuals, block_means(density, used, groups)
