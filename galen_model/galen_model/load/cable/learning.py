"""A cable's pull out of a sweep: which form, how well on poses held out, or why there is none.

The poses are cut into blocks of neighbours in roll and tilt, and every block is predicted from the
others, lengths and all learned without it. Beside it: the calibration file as it is, and plain
least squares with ten parameters (mass, first moment, six offsets) on the same poses, which is what
a calibration with the cable on would make of it. A cable is believed where it beats both, block by
block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.evidence.block_gain import block_gain
from galen_model.load.cable.drag import FORMS, MAX_POSES, MIN_POSES, LearnedPull
from galen_model.load.cable.fit import CableFit, CableSweep, fit_cable, spacing_rad
from galen_model.load.model import gravity_regressor

LARGEST_SPACING_RAD = 0.5
_MIN_SPAN_RAD = 0.3
_TILT_PARTS = 3
_NOISE = 1.5
"""What a sweep without a cable leaves, in units of its averages' noise, is not more than this; and
less than the noise of one reading is not worth a cable: a joint's zero that is a little wrong, or a
drift, leaves as much."""


class NoCableError(IdentificationError):
    """The sweep shows no pull of a cable."""


class SparseSweepError(IdentificationError):
    """The sweep is too sparse for a pull to be learned."""


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
        """That of the form chosen."""
        return self.forms[self.drag.form]


def pose_blocks(joints: Array) -> np.ndarray:
    """Labels (n,) of blocks of neighbours among joints (n, 5): a few poses in each."""
    roll_parts = int(np.clip(len(joints) // (4 * _TILT_PARTS), 3, 6))
    labels = _parts(joints[:, 3], roll_parts) * _TILT_PARTS + _parts(joints[:, 4], _TILT_PARTS)
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
    """Learn the pull, choosing among `forms` by held-out blocks; `progress` wraps the work.

    Raises SparseSweepError, or NoCableError where held-out poses don't show a cable.
    """
    _check_poses(sweep)
    block = pose_blocks(sweep.joints)
    parts = range(int(block.max()) + 1)
    file = scored(sweep, np.zeros_like(sweep.wrench))
    least_squares = scored(sweep, linear_held_out(sweep, block))
    over_noise = float(np.max(file.rmse / sweep.noise))
    if file.chi < _NOISE or over_noise < 1.0:
        raise NoCableError(
            f"no pull beyond the noise: the calibration file leaves {_newtons(file)},"
            f" {file.chi:.1f} times the noise of the averages and, in the worst axis,"
            f" {over_noise:.2g} times that of one reading"
        )
    whole: dict[str, CableFit] = {}
    predicted = {form: np.zeros_like(sweep.wrench) for form in forms}
    stated = {form: np.zeros_like(sweep.wrench) for form in forms}
    for form, part in progress([(form, part) for form in predicted for part in (-1, *parts)]):
        if part < 0:
            whole[form] = fit_cable(sweep, form, learned_at)
            continue
        out = block == part
        fold = fit_cable(sweep.part(~out), form, learned_at, whole[form].start)
        posterior = fold.drag.posterior
        predicted[form][out] = posterior.means(sweep.joints[out])
        own = [np.diag(posterior.process_covariance(q)) for q in sweep.joints[out]]
        noise = np.hypot(sweep.std_of_mean[out], fold.scatter * sweep.noise)
        stated[form][out] = np.sqrt(np.maximum(own, 0.0) + noise**2)
    held_out = {form: scored(sweep, predicted[form], stated[form]) for form in predicted}
    best = min(held_out, key=lambda form: held_out[form].chi)
    _check_worth(sweep, block, held_out[best], file, least_squares)
    ratio = held_out[best].error / stated[best]
    drag = replace(
        whole[best].drag,
        inflation=max(1.0, float(np.sqrt(np.mean(ratio**2)))),
        held_out_rmse=held_out[best].rmse,
    )
    return LearnedCable(drag, whole[best].scatter, file, least_squares, held_out, block)


def _check_poses(sweep: CableSweep) -> None:
    n = len(sweep)
    if n < MIN_POSES:
        raise SparseSweepError(f"the sweep has {n} still poses; at least {MIN_POSES} are needed")
    if n > MAX_POSES:
        raise SparseSweepError(f"the sweep has {n} still poses; at most {MAX_POSES} can be kept")
    for name, column in (("roll", 3), ("tilt", 4)):
        span = float(np.ptp(sweep.joints[:, column]))
        if span < _MIN_SPAN_RAD:
            raise SparseSweepError(
                f"the sweep covers {span:.2g} rad of {name}; at least {_MIN_SPAN_RAD:g} are needed"
            )
    spacing = spacing_rad(sweep.joints)
    if not spacing <= LARGEST_SPACING_RAD:
        raise SparseSweepError(
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
    if not clearly_better(sweep, block, best, file):
        raise NoCableError(
            f"the calibration file leaves {_newtons(file)}, but what it leaves at some poses does"
            f" not tell of the others ({_newtons(best)} on poses held out): no cable's pull that"
            " repeats, or a sweep too sparse for it"
        )
    if not clearly_better(sweep, block, best, least_squares):
        raise NoCableError(
            f"another load explains it as well as a cable ({_newtons(least_squares)} and"
            f" {_newtons(best)} on poses held out): calibrate the tool without the cable first"
        )


def clearly_better(
    sweep: CableSweep, block: np.ndarray, one: CableScore, other: CableScore
) -> bool:
    """Whether `one` has clearly smaller errors, by the paired differences of the blocks' means."""
    gain = np.sum((other.error / sweep.std_of_mean) ** 2, axis=1)
    gain -= np.sum((one.error / sweep.std_of_mean) ** 2, axis=1)
    return block_gain([gain[block == part].mean() for part in np.unique(block)]).clear


def scored(sweep: CableSweep, predicted: Array, stated: Array | None = None) -> CableScore:
    """Score wrenches (n, 6) predicted for the sweep's poses, N and N.m.

    stated (n, 6): standard deviations of the difference to what was measured.
    """
    error = predicted - sweep.wrench
    chi = float(np.sqrt(np.mean((error / sweep.std_of_mean) ** 2)))
    if stated is None:
        return CableScore(error, chi)
    return CableScore(error, chi, float(np.mean(np.abs(error) < 1.96 * stated)))


def linear_held_out(sweep: CableSweep, block: np.ndarray, more: Array | None = None) -> Array:
    """Each block's wrenches (n, 6) by load and offsets that the other blocks give, ten parameters.

    more: further columns (n, 6, k) beside the ten.
    """
    gravity = gravity_in_sensor(sweep.joints[:, 3], sweep.joints[:, 4])
    constant = np.broadcast_to(np.eye(6), (len(sweep), 6, 6))
    columns = [gravity_regressor(gravity), constant]
    design = np.concatenate(columns if more is None else [*columns, more], axis=2)
    predicted = np.zeros_like(sweep.wrench)
    for part in np.unique(block):
        out = block == part
        found = least_squares(design[~out], sweep.wrench[~out], sweep.std_of_mean[~out])
        predicted[out] = design[out] @ found
    return predicted


def least_squares(design: Array, readings: Array, std: Array) -> Array:
    """Parameters (p,) of readings (n, 6) by design (n, 6, p), weighted by std (n, 6).

    Where the readings don't tell some apart, the smallest.
    """
    scale = 1.0 / std
    rows = (design * scale[:, :, None]).reshape(-1, design.shape[2])
    return np.asarray(np.linalg.lstsq(rows, (readings * scale).ravel(), rcond=1e-9)[0])


def _newtons(held_out: CableScore) -> str:
    return f"{np.sqrt(np.mean(held_out.rmse[:3] ** 2)):.2g} N"
