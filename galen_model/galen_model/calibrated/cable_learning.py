# SPDX-License-Identifier: Apache-2.0
"""Learn a cable's pull out of a sweep: how smooth, in which form, and whether it is one.

**How smooth.** With K the covariance of all readings y of a sweep (6 n), W = K^-1 (y y^T - K) K^-1:

    log p(y) = -(y^T K^-1 y + log det K) / 2 + const.,    d log p = tr(W dK) / 2

(Rasmussen & Williams 2006, eqs. 5.8 and 5.9), plus broad normal priors on the logarithms of
lengths, amplitudes and scatter and on the attachment, for numbers that the sweep does not identify.
The scatter is what poses have beside smoothness and the averages' own noise (a cord that slips, a
sensor that drifts), in units of the sensor's noise.

**Which form.** The poses are cut into blocks of neighbours in the angles, and every block is
predicted from the others, lengths and all learned without it. Beside it: the calibration file as it
is, and plain least squares with ten parameters (mass, first moment, six offsets) on the same poses,
which is what a calibration with the cable on would make of it. A cable is believed where it beats
both, block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy  # its parts are loaded when they are used

from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.calibrated.inertia_identification import OTHER_MASS
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.estimation.held_out import block_gain
from galen_model.estimation.least_squares import least_squares
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.cable import (
    FORMS,
    MAX_POSES,
    MIN_POSES,
    LearnedPull,
    attachment_derivatives,
    constant_size,
    form_matrices,
    groups,
    together,
)
from galen_model.load.readings import single_load_design
from galen_model.rotation import skew

# Priors: mean and standard deviation of the logarithms, of length_rad (each), length_m, amplitude
# (2) and scatter: 1 rad of a joint, 0.15 m of a platform (half the way to an anchor nearby), some
# 0.1 N and 0.01 N.m.
_RAD_PRIOR, _RAD_WIDTH = 0.0, 0.7
_LOG_PRIOR = np.log([0.15, 0.1, 0.01, 0.1])
_LOG_WIDTH = np.array([0.7, 1.5, 1.5, 1.5])
_ATTACHMENT_WIDTH_M = 0.2
_DUPLICATE_RAD = 0.02
_SPACINGS = 1.5


@dataclass(frozen=True)
class CableSweep:
    """Still poses with the cable on: joints (n, d), wrench (n, 6) beyond the file, N, N.m.

    std_of_mean (n, 6) of the wrench; noise (6,), the sensor's, of one reading.
    """

    joints: Array
    wrench: Array
    std_of_mean: Array
    noise: Array
    arm: Arm = field(default=GALEN, repr=False)

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def angles(self) -> Array:
        """Angles (n, k) of the arm's revolute joints, rad."""
        return self.arm.angles(self.joints)

    def part(self, which: Array) -> CableSweep:
        """Select some of the poses.

        Args:
            which: mask (n,) or indices.

        Returns:
            Those poses.

        """
        return CableSweep(
            self.joints[which],
            self.wrench[which],
            self.std_of_mean[which],
            self.noise,
            self.arm,
        )


def spacing_rad(angles: Array) -> float:
    """Compute how far apart the poses stand in their angles.

    Args:
        angles: (n, k), rad.

    Returns:
        Distance, rad, within which 80 % of the poses have another one; poses that coincide don't
        count.

    """
    apart = np.linalg.norm(angles[:, None] - angles[None], axis=2)
    apart[apart < _DUPLICATE_RAD] = np.inf
    return float(np.quantile(apart.min(axis=1), 0.8))


def spread_out(joints: Array, count: int, arm: Arm) -> Array:
    """Choose poses that are spread, each next one farthest from the others.

    A tenth of a metre of a prismatic joint counts as much as half a radian.

    Args:
        joints: (n, d), m and rad.
        count: how many at most.
        arm: whose joints they are.

    Returns:
        Indices (count,), sorted; all where there are fewer poses.

    """
    scaled = joints / arm.by_unit(0.1, 0.5)
    chosen = [int(np.argmin(np.linalg.norm(scaled - scaled.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(scaled - scaled[chosen[0]], axis=1)
    while len(chosen) < min(count, len(joints)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(scaled - scaled[chosen[-1]], axis=1))
    return np.sort(chosen)


def fit_cable(
    sweep: CableSweep, form: str, learned_at: str, start: Array | None = None
) -> tuple[LearnedPull, float, Array]:
    """Learn a cable's pull from all poses given.

    Args:
        sweep: poses with the cable on.
        form: one of FORMS.
        learned_at: time of the sweep, RFC 3339.
        start: the optimiser's vector (k + 7,) of an earlier fit of the form; None: the priors'.

    Returns:
        The pull, its scatter in units of the sensor's noise, and the optimiser's vector (k + 7,),
        to start another from.

    Raises:
        IdentificationError: the sweep's numbers give no pull.

    """
    problem = _Likelihood(sweep, form)
    prior, turning = problem.prior, len(sweep.arm.turning)
    begin = np.concatenate([prior, problem.first_attachment()]) if start is None else start
    # The logarithms stay within e^-6 to e^6 of where they are plausible: beyond, exp() overflows.
    bounds = [(centre - 6.0, centre + 6.0) for centre in prior] + [(-1.0, 1.0)] * 3
    found = scipy.optimize.minimize(
        problem,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 60, "ftol": 1e-6},
    )
    if not np.isfinite(found.fun):
        raise IdentificationError("the sweep's readings give no cable's pull: they don't add up")
    values = np.exp(found.x[: len(prior)])
    scatter = float(values[-1])
    drag = LearnedPull(
        form=form,
        joints=sweep.joints,
        wrench=sweep.wrench,
        std=np.hypot(sweep.std_of_mean, scatter * sweep.noise),
        length_rad=values[:turning],
        length_m=float(values[turning]),
        amplitude=values[turning + 1 : turning + 3],
        support_rad=float(np.clip(_SPACINGS * spacing_rad(sweep.angles), 0.1, 0.8)),
        learned_at=learned_at,
        attachment_m=np.zeros(3) if form == "free" else found.x[len(prior) :],
        arm=sweep.arm,
    )
    return drag, scatter, found.x


class _Likelihood:
    """Minus the logarithm of posterior density, and its gradient, over the fit's vector (k + 7,).

    It holds the logarithms of length_rad (k), length_m, amplitude (2), scatter; the attachment (3).
    """

    def __init__(self, sweep: CableSweep, form: str) -> None:
        self._sweep = sweep
        self._form = form
        joints = sweep.joints
        self._apart2 = (joints[:, None] - joints[None]) ** 2
        self._derivatives = attachment_derivatives(form, joints, sweep.arm)
        turning = len(sweep.arm.turning)
        self.prior = np.concatenate([np.full(turning, _RAD_PRIOR), _LOG_PRIOR])
        """Means of the logarithms (k + 4,)."""
        self._width = np.concatenate(
            [np.full(turning, _RAD_WIDTH), _LOG_WIDTH, np.full(3, _ATTACHMENT_WIDTH_M)]
        )
        self._mean = np.concatenate([self.prior, np.zeros(3)])

    def first_attachment(self) -> Array:
        """Return the point r (3,) for which r x f comes nearest to the torques."""
        if self._form == "free":
            return np.zeros(3)
        force, torque = self._sweep.wrench[:, :3], self._sweep.wrench[:, 3:]
        # tau = -[f]x r, by ridge: a constant direction leaves r along it open.
        lever = -skew(force).reshape(-1, 3)
        normal = lever.T @ lever
        ridge = 1e-3 * np.trace(normal) * np.eye(3) + 1e-12 * np.eye(3)
        return np.clip(np.linalg.solve(normal + ridge, lever.T @ torque.ravel()), -0.9, 0.9)

    def __call__(self, vector: Array) -> tuple[float, Array]:
        sweep, form, arm = self._sweep, self._form, self._sweep.arm
        values, attachment, turning = np.exp(vector[:-3]), vector[-3:], len(arm.turning)
        amplitude, scatter = values[turning + 1 : -1], values[-1]
        lengths = arm.by_unit(values[turning], values[:turning])
        scaled = self._apart2 / lengths**2
        kernel = np.exp(-0.5 * scaled.sum(axis=2))
        matrices = form_matrices(form, sweep.joints, attachment, arm)
        products = [together(part, part) for part in matrices]
        sizes = [amplitude[g] ** 2 * kernel + constant_size(g) ** 2 for g in range(groups(form))]
        n = len(sweep)
        total: Array = np.zeros((n, 6, n, 6))
        for product, size in zip(products, sizes, strict=True):
            total += product * size[:, None, :, None]
        covariance = total.reshape(6 * n, 6 * n)
        scatter2 = np.tile((scatter * sweep.noise) ** 2, n)
        covariance[np.diag_indices(6 * n)] += sweep.std_of_mean.ravel() ** 2 + scatter2
        try:
            factor = scipy.linalg.cho_factor(covariance, lower=True)
        except np.linalg.LinAlgError:
            return np.inf, np.zeros_like(vector)
        inverse = scipy.linalg.cho_solve(factor, np.eye(6 * n))
        weights = inverse @ sweep.wrench.ravel()
        away = (vector - self._mean) / self._width
        value = (
            0.5 * float(sweep.wrench.ravel() @ weights)
            + float(np.log(np.diag(factor[0])).sum())
            + 0.5 * float(away @ away)
        )
        pull = (np.outer(weights, weights) - inverse).reshape(n, 6, n, 6)
        gradient = np.zeros(len(vector))
        sliding = [k for k in range(len(arm.joints)) if k not in arm.turning]
        for group, product in enumerate(products):
            # tr(W dK) for a dK that is this group's product times a change of its kernel (n, n).
            along = amplitude[group] ** 2 * kernel * np.einsum("aibj,aibj->ab", pull, product)
            gradient[turning + 1 + group] = -along.sum()
            for place, joint in enumerate(arm.turning):
                gradient[place] -= 0.5 * np.sum(along * scaled[:, :, joint])
            gradient[turning] -= 0.5 * np.sum(along * scaled[:, :, sliding].sum(axis=2))
        gradient[-4] = -np.einsum("aiai,i->", pull, (scatter * sweep.noise) ** 2)
        if form != "free":
            seen = np.einsum("aibj,ab,bjl->ail", pull, sizes[0], matrices[0], optimize=True)
            gradient[-3:] = -np.einsum("dail,ail->d", self._derivatives, seen)
        gradient += away / self._width
        return value, gradient


LARGEST_SPACING_RAD = 0.5
# Of the mean square that another tool leaves a load leaves less; of a cable's pull mostly more.
_LOAD_LEAVES = 0.06
_MIN_SPAN_RAD = 0.3
_SECOND_PARTS = 3
_NOISE = 1.5
"""What a sweep without a cable leaves, in units of its averages' noise, is not more than this; and
less than the noise of one reading is not worth a cable: a joint's zero that is a little wrong, or a
drift, leaves as much."""


@dataclass(frozen=True)
class CableScore:
    """Errors (n, 6) of predicted less measured wrenches of held-out poses, N and N.m.

    chi: their root mean square in units of the averages' noise; coverage: the share within the
    stated 95 % (NaN where nothing is stated).
    """

    error: Array
    chi: float
    coverage: float = float("nan")

    @property
    def rmse(self) -> Array:
        """(6,), N and N.m."""
        return np.asarray(np.sqrt(np.mean(self.error**2, axis=0)))


@dataclass(frozen=True)
class LearnedCable:
    """The pull, and how well poses held out were predicted: by each form and by the others."""

    drag: LearnedPull
    scatter: float
    file: CableScore
    least_squares: CableScore
    forms: dict[str, CableScore]
    block: np.ndarray

    @property
    def held_out(self) -> CableScore:
        """Score of the form chosen."""
        return self.forms[self.drag.form]

    @property
    def scores(self) -> dict[str, CableScore]:
        """All scores by name."""
        plain = {
            "the tool's file": self.file,
            "ten-parameter least squares": self.least_squares,
        }
        return plain | self.forms


def check_same_tool(tool: CalibrationFile, sweep: CableSweep) -> list[str]:
    """Compare the load that the sweep's wrenches show with the file's.

    Args:
        tool: the file.
        sweep: wrenches beyond it.

    Returns:
        Warnings; empty where the masses agree.

    Raises:
        IdentificationError: another load explains nearly all of the wrenches.

    """
    columns = _ten_columns(sweep)
    found = least_squares(columns, sweep.wrench, sweep.std_of_mean).values
    mass = tool.load.mass_kg + tool.adapter.mass_kg
    if abs(found[0]) <= OTHER_MASS * mass:
        return []
    file = _scored(sweep, np.zeros_like(sweep.wrench))
    left = (_scored(sweep, columns @ found).chi / file.chi) ** 2
    text = (
        f"the recording is of {1e3 * (mass + found[0]):.1f} g, the file of {1e3 * mass:.1f} g on"
        f" the sensor, more than {100.0 * OTHER_MASS:.0f} % apart"
    )
    if left < _LOAD_LEAVES:
        raise IdentificationError(
            f"{text}, and another load leaves only {100.0 * left:.1g} % of what the file leaves:"
            " another tool is on (or the cable pulls straight up or down, as a load does); name the"
            " tool that is on, or calibrate it without the cable first"
        )
    return [f"{text}: if that is not the cable, another tool is on"]


def pose_blocks(angles: Array) -> np.ndarray:
    """Label blocks of neighbours among poses, a few poses in each.

    Of more than two angles the blocks are along the two directions in which they differ most.

    Args:
        angles: (n, k), rad, k at least 2.

    Returns:
        Labels (n,), from 0 on.

    """
    if angles.shape[1] > 2:
        _, _, directions = np.linalg.svd(angles - angles.mean(axis=0), full_matrices=False)
        angles = angles @ directions[:2].T
    first, second = angles.T
    parts = int(np.clip(len(angles) // (4 * _SECOND_PARTS), 3, 6))
    labels = _parts(first, parts) * _SECOND_PARTS + _parts(second, _SECOND_PARTS)
    return np.unique(labels, return_inverse=True)[1]


def _parts(values: Array, count: int) -> np.ndarray:
    """Which of `count` parts of equal width each of values (n,) lies in."""
    low, high = values.min(), values.max()
    return np.minimum((count * (values - low) / (high - low)).astype(int), count - 1)


def learn_cable(
    sweep: CableSweep,
    learned_at: str,
    forms: Iterable[str] = FORMS,
    progress: Callable[[list[tuple[str, int]]], Iterable[tuple[str, int]]] = iter,
) -> LearnedCable:
    """Learn the pull, choosing among forms by held-out blocks.

    Args:
        sweep: poses with the cable on.
        learned_at: time of the sweep, RFC 3339.
        forms: some of FORMS.
        progress: wraps the fits, (form, block; -1: all poses), and yields them in their order.

    Returns:
        The pull of the form chosen, and the scores of all.

    Raises:
        NotExcitedError: the poses are too few, too many, too near or too far from each other, or
            the arm has too few revolute joints.
        IdentificationError: held-out poses don't show a cable.

    """
    _check_poses(sweep)
    block = pose_blocks(sweep.angles)
    parts = range(int(block.max()) + 1)
    file = _scored(sweep, np.zeros_like(sweep.wrench))
    least_squares = _scored(sweep, _linear_held_out(sweep, block))
    over_noise = float(np.max(file.rmse / sweep.noise))
    if file.chi < _NOISE or over_noise < 1.0:
        raise IdentificationError(
            f"no pull beyond the noise: the calibration file leaves {_newtons(file)},"
            f" {file.chi:.1f} times the noise of the averages and, in the worst axis,"
            f" {over_noise:.2g} times that of one reading"
        )
    whole: dict[str, tuple[LearnedPull, float, Array]] = {}
    predicted = {form: np.zeros_like(sweep.wrench) for form in forms}
    stated = {form: np.zeros_like(sweep.wrench) for form in forms}
    for form, part in progress([(form, part) for form in predicted for part in (-1, *parts)]):
        if part < 0:
            whole[form] = fit_cable(sweep, form, learned_at)
            continue
        out = block == part
        fold, scatter, _ = fit_cable(sweep.part(~out), form, learned_at, whole[form][2])
        posterior = fold.posterior
        predicted[form][out] = posterior.means(sweep.joints[out])
        own = [np.diag(posterior.process_covariance(q)) for q in sweep.joints[out]]
        noise = np.hypot(sweep.std_of_mean[out], scatter * sweep.noise)
        stated[form][out] = np.sqrt(np.maximum(own, 0.0) + noise**2)
    held_out = {form: _scored(sweep, predicted[form], stated[form]) for form in predicted}
    best = min(held_out, key=lambda form: held_out[form].chi)
    _check_worth(sweep, block, held_out[best], file, least_squares)
    ratio = held_out[best].error / stated[best]
    drag, scatter, _ = whole[best]
    drag = replace(
        drag,
        inflation=max(1.0, float(np.sqrt(np.mean(ratio**2)))),
        held_out_rmse=held_out[best].rmse,
    )
    return LearnedCable(drag, scatter, file, least_squares, held_out, block)


def _check_poses(sweep: CableSweep) -> None:
    n = len(sweep)
    if n < MIN_POSES:
        raise NotExcitedError(f"the sweep has {n} still poses; at least {MIN_POSES} are needed")
    if n > MAX_POSES:
        raise NotExcitedError(f"the sweep has {n} still poses; at most {MAX_POSES} can be kept")
    if len(sweep.arm.turning) < 2:
        raise NotExcitedError(
            f"the arm '{sweep.arm.name}' has {len(sweep.arm.turning)} revolute joints: a cable's"
            " pull is learned over two at least"
        )
    spans = np.ptp(sweep.angles, axis=0)
    second = int(np.argsort(-spans, kind="stable")[1])
    if spans[second] < _MIN_SPAN_RAD:
        raise NotExcitedError(
            f"the sweep covers {spans[second]:.2g} rad of {sweep.arm.turning_names[second]}; of two"
            f" joints at least {_MIN_SPAN_RAD:g} are needed"
        )
    spacing = spacing_rad(sweep.angles)
    if not spacing <= LARGEST_SPACING_RAD:
        raise NotExcitedError(
            f"the poses are too sparse: they stand {spacing:.2g} rad apart; a cable's pull needs"
            f" {LARGEST_SPACING_RAD:g} rad or less"
        )


def _check_worth(
    sweep: CableSweep,
    block: np.ndarray,
    best: CableScore,
    file: CableScore,
    least_squares: CableScore,
) -> None:
    if not _clearly_better(sweep, block, best, file):
        raise IdentificationError(
            f"the calibration file leaves {_newtons(file)}, but what it leaves at some poses does"
            f" not tell of the others ({_newtons(best)} on poses held out): no cable's pull that"
            " repeats, or a sweep too sparse for it"
        )
    if not _clearly_better(sweep, block, best, least_squares):
        raise IdentificationError(
            f"another load explains it as well as a cable ({_newtons(least_squares)} and"
            f" {_newtons(best)} on poses held out): calibrate the tool without the cable first"
        )


def _clearly_better(
    sweep: CableSweep, block: np.ndarray, one: CableScore, other: CableScore
) -> bool:
    """Whether `one` has clearly smaller errors, by the paired differences of the blocks' means."""
    gain = np.sum((other.error / sweep.std_of_mean) ** 2, axis=1)
    gain -= np.sum((one.error / sweep.std_of_mean) ** 2, axis=1)
    return block_gain([gain[block == part].mean() for part in np.unique(block)]).clear


def _scored(sweep: CableSweep, predicted: Array, stated: Array | None = None) -> CableScore:
    """Score wrenches (n, 6) predicted for the sweep's poses, N and N.m.

    stated (n, 6): standard deviations of the difference to what was measured.
    """
    error = predicted - sweep.wrench
    chi = float(np.sqrt(np.mean((error / sweep.std_of_mean) ** 2)))
    if stated is None:
        return CableScore(error, chi)
    return CableScore(error, chi, float(np.mean(np.abs(error) < 1.96 * stated)))


def _linear_held_out(sweep: CableSweep, block: np.ndarray) -> Array:
    """Predict each block (n, 6) by load and offsets, ten parameters, of the other blocks."""
    design = _ten_columns(sweep)
    predicted = np.zeros_like(sweep.wrench)
    for part in np.unique(block):
        out = block == part
        found = least_squares(design[~out], sweep.wrench[~out], sweep.std_of_mean[~out])
        predicted[out] = design[out] @ found.values
    return predicted


def _ten_columns(sweep: CableSweep) -> Array:
    return single_load_design(sweep.arm.gravity_in_sensor(sweep.angles))


def _newtons(held_out: CableScore) -> str:
    return f"{np.sqrt(np.mean(held_out.rmse[:3] ** 2)):.2g} N"
