"""Loads, offsets and chosen parameters of the mounting together, from still poses.

Gauss-Newton: the model (`galen_model.load.reading_model`) is made linear at the last
values and each step is a whole robust fit (`galen_model.load.robust_fit`), so that outliers, the
channels' noise and the covariance are those of the fits without a mounting. Before and after,
`identifiability` rejects parameters that the poses don't identify. No parameter of the mounting has
a prior; of the loads only what the caller has measured otherwise (a scale, a drawing) enters.

Whether the mounting's parameters pay is a matter of poses held out by blocks, not of the fit's own
residual (`worth`): blocks of neighbouring poses, in visiting order, are left out of both sweeps in
turn; three models fitted to the rest predict the readings with the tool: the ten-parameter least
squares of other packages (from the sweep with the tool alone), loads without a mounting, loads with
it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.errors import IdentificationError
from galen_model.evidence.block_gain import MOUNTED, PLAIN, ROBUST, Worth, compare
from galen_model.load.identifiability import (
    LOAD_PARAMETERS,
    MAX_STD,
    JacobianColumns,
    check_excitation,
    check_identifiable,
)
from galen_model.load.identification import (
    MIN_POSES,
    Identification,
    SingleLoad,
    StillPoses,
    check_channels,
    check_count,
    check_rejections,
    identify_one_sweep,
    identify_two_sweeps,
    load_estimate,
    one_sweep_prior,
    one_sweep_result,
    plain_least_squares,
    two_sweeps_result,
)
from galen_model.load.model import gravity_regressor, gravity_wrench
from galen_model.load.mounting import Entity, Mounting, entities
from galen_model.load.reading_model import (
    JointPoses,
    MountedSweep,
    OrientedPoses,
    Poses,
    ReadingModel,
)
from galen_model.load.robust_fit import Prior, RobustFit, fit_robust

_STEPS = 20
_STEPS_WITH_ALL = 6
_SETTLED = 0.05  # of a standard deviation: the step after that is smaller by two orders
_ROUNDING = 1e-11  # kg, kg.m, N, N.m, rad


@dataclass(frozen=True)
class KnownLoad:
    """What is known of the load otherwise: its mass, as of a scale, and its centre (3,) or None.

    It must not come from the sensor that is being calibrated.
    """

    mass_kg: float
    mass_std_kg: float
    com_m: Array | None = None
    com_std_m: float | None = None

    def __post_init__(self) -> None:
        """Check the values; raises IdentificationError."""
        if not (0.0 < self.mass_kg < np.inf and 0.0 < self.mass_std_kg < np.inf):
            raise IdentificationError(
                f"the known mass is {self.mass_kg:g} +- {self.mass_std_kg:g} kg: both are positive"
            )
        if (self.com_m is None) != (self.com_std_m is None):
            raise IdentificationError(
                "a known centre needs its standard deviation, and it a centre"
            )
        if self.com_std_m is not None and not 0.0 < self.com_std_m < np.inf:
            raise IdentificationError(f"the known centre's deviation is {self.com_std_m:g} m")

    def prior(self, parameters: int) -> Prior:
        """Return it as knowledge of the moments (m, h), the first four of p parameters.

        h - p m = 0 within m times the centre's deviation.
        """
        count = 1 if self.com_m is None else 4
        rows, values = np.zeros((count, parameters)), np.zeros(count)
        std = np.full(count, self.mass_std_kg)
        rows[0, 0], values[0] = 1.0, self.mass_kg
        if self.com_m is not None and self.com_std_m is not None:
            rows[1:, 1:4] = np.eye(3)
            rows[1:, 0] = -np.asarray(self.com_m, dtype=float)
            std[1:] = self.mass_kg * self.com_std_m
        return Prior(rows, values, std)


@dataclass(frozen=True)
class MountedLoad:
    """One load, its offsets (6,) and the mounting, from orientations."""

    single: SingleLoad
    mounting: Mounting

    def predict(self, gravity_sensor: ArrayLike, base_from_sensor: Array | None) -> Array:
        """Raw reading (n, 6) under a level base's gravity (n, 3) with R_base_sensor (n, 3, 3)."""
        gravity = np.asarray(gravity_sensor, dtype=float)
        if base_from_sensor is not None:
            gravity = self.mounting.turned_gravity(gravity, base_from_sensor)
        weight = self.single.predict(gravity) - self.single.offset
        return weight @ self.mounting.reading_from_wrench.T + self.single.offset


def identify_two_sweeps_mounted(
    bare: StillPoses,
    tool: StillPoses,
    groups: Sequence[str],
    zero_angles: ArrayLike | None = None,
    known: KnownLoad | None = None,
) -> Identification:
    """As `identify_two_sweeps`, with the mounting's `groups`. known: of the tool.

    rmse and offsets are of the raw axes.

    Raises NotExcitedError naming the pairs, and as `identify_two_sweeps` does.
    """
    check_count(bare, "sweep without the tool")
    check_count(tool, "sweep with the tool")
    asked = entities(groups, tool.arm)
    problem = two_sweeps_problem(
        JointPoses(bare.angles, bare.arm),
        JointPoses(tool.angles, tool.arm),
        zeroing_pose(zero_angles, tool.arm),
        asked,
        known,
    )
    readings = np.concatenate([bare.wrench, tool.wrench])
    start, design, sigma = problem.start(readings)
    check_excitation(design, LOAD_PARAMETERS, {"without the tool": bare, "with the tool": tool})
    check_channels(design[: len(bare), :, 4:8], bare, "sweep without the tool")
    check_channels(design[len(bare) :, :, :4], tool, "sweep with the tool")
    fit = problem.fit(readings, start, sigma)
    found = two_sweeps_result(fit, bare, tool)
    return replace(found, mounting=problem.mounting(fit, tuple(groups)))


def identify_one_sweep_mounted(
    tool: StillPoses,
    groups: Sequence[str],
    zero_angles: ArrayLike | None = None,
) -> Identification:
    """As `identify_one_sweep`, with the mounting's `groups`; raises as the two sweeps' does.

    The mounting must show in the poses themselves, whatever the zeroing tells: the gate looks at
    the sum of both loads with free offsets.
    """
    check_count(tool, "sweep with the tool")
    asked = entities(groups, tool.arm)
    poses = JointPoses(tool.angles, tool.arm)
    zero = zeroing_pose(zero_angles, tool.arm)
    together = single_problem(poses, asked, None, tool.arm)
    start, design, sigma = together.start(tool.wrench)
    check_excitation(design, LOAD_PARAMETERS[:4], {"with the tool": tool})
    check_channels(design[:, :, :4], tool, "sweep with the tool")
    together.check(start, sigma, None)

    gravity_zero = zero.gravity(Mounting.of(tool.arm))[0][0]
    problem = one_sweep_problem(poses, zero, asked)
    # what the sum's offset holds, the zeroing took: - G_0 x_adapter
    at_zero = gravity_regressor(gravity_zero)
    adapter = np.linalg.lstsq(at_zero, -start[4:10], rcond=None)[0]
    apart = np.concatenate([start[:4] - adapter, adapter, np.zeros(6), start[10:]])
    fit = problem.fit(tool.wrench, apart, sigma)
    sum_values = np.concatenate([fit.values[:4] + fit.values[4:8], fit.values[8:]])
    together.check(sum_values, fit.sigma, MAX_STD, fit.used)
    mounting = problem.mounting(fit, tuple(groups))
    gravity_zero = zero.gravity(mounting)[0][0]
    return replace(one_sweep_result(fit, tool, gravity_zero), mounting=mounting)


def identify_single_load_mounted(
    gravity_sensor: ArrayLike,
    wrench: ArrayLike,
    groups: Sequence[str],
    base_from_sensor: Array | None = None,
    known: KnownLoad | None = None,
    *,
    arm: Arm,
) -> MountedLoad:
    """As `identify_single_load`, with the mounting's `groups`, from orientations.

    gravity_sensor: (n, 3) for a level base; base_from_sensor: R_base_sensor (n, 3, 3), which an
    inclination of the base needs. known: of all that hangs on the sensor; arm: whose mounting it
    is. Raises NotExcitedError naming the pairs, and as `identify_single_load` does.
    """
    gravity, readings = np.asarray(gravity_sensor, dtype=float), np.asarray(wrench, dtype=float)
    if len(gravity) < MIN_POSES:
        raise IdentificationError(f"{len(gravity)} still poses; at least {MIN_POSES} are needed")
    poses = OrientedPoses(gravity, base_from_sensor)
    problem = single_problem(poses, entities(groups, arm), known, arm)
    start, design, sigma = problem.start(readings)
    check_excitation(design, LOAD_PARAMETERS[:4])
    fit = problem.fit(readings, start, sigma)
    single = SingleLoad(
        load_estimate(fit, slice(0, 4), "the load"), fit.values[4:10], fit.sigma, fit.used
    )
    return MountedLoad(single, problem.mounting(fit, tuple(groups)))


def zeroing_pose(zero_angles: ArrayLike | None, arm: Arm) -> JointPoses:
    """Return the pose, rad, at which the sensor was zeroed; None: the arm's home."""
    at = arm.home_angles if zero_angles is None else np.asarray(zero_angles, dtype=float)
    return JointPoses(at[None], arm)


def check_planned_mounting(
    angles: Array,
    groups: Sequence[str],
    *,
    one_sweep: bool = False,
    zero_angles: ArrayLike | None = None,
    arm: Arm,
) -> None:
    """Raise, before the arm moves, for angles (n, k), rad, that can't distinguish `groups`.

    The load isn't known then; one of 100 g, well off every axis, stands for it.
    """
    asked = entities(groups, arm)
    planned = JointPoses(np.asarray(angles, dtype=float), arm)
    zero = zeroing_pose(zero_angles, arm)
    load, noise = 0.1 * np.array([1.0, 0.05, 0.03, 0.05]), np.array([1.0] * 3 + [0.02] * 3)
    if one_sweep:
        problem = single_problem(planned, asked, None, arm)
        problem.check(np.concatenate([load, np.zeros(6 + len(asked))]), noise, None)
        return
    problem = two_sweeps_problem(planned, planned, zero, asked, None)
    problem.check(np.concatenate([load, load, np.zeros(12 + len(asked))]), noise, None)


def one_sweep_problem(
    tool: Poses, zero: JointPoses, asked: tuple[Entity, ...]
) -> "MountingProblem":
    """Values: tool's moments (4), adapter's (4), offsets (6), asked; the zeroing holds."""
    gravity_zero = zero.gravity(Mounting.of(zero.arm))[0][0]
    rows, values, std = one_sweep_prior(gravity_zero)
    known = Prior(np.hstack([rows, np.zeros((len(rows), len(asked)))]), values, std, slice(8, 14))
    sweep = MountedSweep(tool, slice(0, 4), slice(4, 8), slice(8, 14))
    return MountingProblem(ReadingModel([sweep], zero, asked, 14), known, None)


def two_sweeps_problem(
    bare: Poses, tool: Poses, zero: JointPoses, asked: tuple[Entity, ...], known: KnownLoad | None
) -> "MountingProblem":
    """Values: tool's moments (4), adapter's (4), offsets bare (6) and with the tool (6), asked."""
    adapter = slice(4, 8)
    sweeps = [
        MountedSweep(bare, None, adapter, slice(8, 14)),
        MountedSweep(tool, slice(0, 4), adapter, slice(14, 20)),
    ]
    columns = JacobianColumns((0, 4), (1, 2, 3, 5, 6, 7), range(8, 20), [e.name for e in asked])
    return MountingProblem(
        ReadingModel(sweeps, zero, asked, 20), _prior(known, 20 + len(asked)), columns
    )


def single_problem(
    poses: Poses, asked: tuple[Entity, ...], known: KnownLoad | None, arm: Arm
) -> "MountingProblem":
    """Values: the load's moments (4), offsets (6), asked."""
    model = ReadingModel(
        [MountedSweep(poses, slice(0, 4), None, slice(4, 10))],
        zeroing_pose(None, arm),
        asked,
        10,
    )
    columns = JacobianColumns((0,), (1, 2, 3), range(4, 10), [e.name for e in asked])
    return MountingProblem(model, _prior(known, 10 + len(asked)), columns)


def _prior(known: KnownLoad | None, parameters: int) -> Prior:
    if known is None:
        return Prior(np.zeros((0, parameters)), np.zeros(0), np.zeros(0))
    return known.prior(parameters)


@dataclass(frozen=True)
class MountingProblem:
    """A model, what is known beforehand, and the columns of `check_identifiable`."""

    model: ReadingModel
    known: Prior
    columns: JacobianColumns | None

    def start(self, readings: Array) -> tuple[Array, Array, Array]:
        """Values (p,) without a mounting, their linear part's design, and the noise (6,) so far."""
        values = np.zeros(self.known.rows.shape[1])
        design = self.model.evaluate(values)[1][:, :, : self.model.linear]
        rows = design.reshape(-1, self.model.linear)
        values[: self.model.linear] = np.linalg.lstsq(rows, readings.reshape(-1), rcond=None)[0]
        sigma = np.std(readings - design @ values[: self.model.linear], axis=0)
        return values, design, np.maximum(sigma, 1e-12)

    def fit(self, readings: Array, values: Array, sigma: Array) -> RobustFit:
        """Fit from `values` (p,); sigma: (6,) a first guess of the noise."""
        self.check(values, sigma, None)
        asked = np.ones(len(readings), dtype=bool)
        last = asked
        for step in range(_STEPS):
            expected, jacobian = self.model.evaluate(values)
            right = readings - expected + jacobian @ values
            fit = fit_robust(jacobian[asked], right[asked], self.known)
            used = asked.copy()
            used[asked] = fit.used
            change = np.abs(fit.values - values)
            values = fit.values
            if np.any(np.abs(values[self.model.linear :]) > 1.0):
                break
            if np.all(change <= _SETTLED * np.sqrt(np.diag(fit.covariance)) + _ROUNDING):
                residuals = readings - self.model.evaluate(values)[0]
                distance = np.sqrt(np.sum((residuals / fit.sigma) ** 2, axis=1))
                fit = replace(fit, residuals=residuals, used=used, distance=distance)
                check_rejections(fit)
                self.check(values, fit.sigma, MAX_STD, used)
                return fit
            if step >= _STEPS_WITH_ALL:  # poses that come and go with every step would never end
                asked = asked & (used | ~last) & (last | ~used)
            last = used
        raise IdentificationError(
            "sensor and mounting: the fit does not settle; the readings fit no small rotation, gain"
            " or inclination"
        )

    def check(
        self, values: Array, sigma: Array, max_std: float | None, used: np.ndarray | None = None
    ) -> None:
        """Raise NotExcitedError unless the (used) poses tell all that is asked."""
        if self.columns is None:
            return
        jacobian = self.model.evaluate(values)[1]
        check_identifiable(
            jacobian if used is None else jacobian[used],
            sigma,
            self.columns,
            self.known.rows / self.known.std[:, None],
            max_std=max_std,
        )

    def mounting(self, fit: RobustFit, groups: tuple[str, ...]) -> Mounting:
        """Return the mounting of a fit's values, with its covariance."""
        return self.model.mounting(fit.values, groups, fit.covariance)


BLOCKS = 5
_Predict = Callable[[StillPoses], Array]


@dataclass(frozen=True)
class Calibrated:
    """What was measured: sweeps, the zeroing pose (rad), what is known, the groups asked for."""

    bare: StillPoses | None
    tool: StillPoses
    groups: Sequence[str]
    zero_angles: ArrayLike | None = None
    known: KnownLoad | None = None

    def identify(self) -> Identification:
        """From all poses, or those `without` leaves; raises IdentificationError."""
        if self.bare is not None:
            return identify_two_sweeps_mounted(
                self.bare, self.tool, self.groups, self.zero_angles, known=self.known
            )
        if self.known is not None:
            raise IdentificationError("a known mass of the tool needs two sweeps")
        return identify_one_sweep_mounted(self.tool, self.groups, self.zero_angles)

    def identify_unmounted(self) -> Identification:
        """Return the same without a mounting; raises IdentificationError."""
        if self.bare is not None:
            return identify_two_sweeps(self.bare, self.tool, self.zero_angles)
        return identify_one_sweep(self.tool, self.zero_angles)

    def without(self, block: int, blocks: int) -> "Calibrated":
        """Return the same without a block of each sweep."""
        bare = None if self.bare is None else self.bare.take(~_held(self.bare, block, blocks))
        tool = self.tool.take(~_held(self.tool, block, blocks))
        return replace(self, bare=bare, tool=tool)


def worth(measured: Calibrated, all_poses: Identification, blocks: int = BLOCKS) -> Worth:
    """Score the models; all_poses: the mounted fit to everything, whose outliers don't count.

    Raises IdentificationError where the mounting can't be fitted without a block.
    """
    parts: dict[str, list[Array]] = {name: [] for name in (PLAIN, ROBUST, MOUNTED)}
    for block in range(blocks):
        held = _held(measured.tool, block, blocks)
        rest = measured.without(block, blocks)
        scored = measured.tool.take(held & all_poses.used_tool)
        try:
            mounted = rest.identify()
        except IdentificationError as error:
            raise IdentificationError(
                f"without block {block + 1} of {blocks} of the poses: {error}"
            ) from error
        for name, predict in zip(parts, _models(rest, mounted), strict=True):
            left = np.full((len(scored), 6), np.nan) if predict is None else predict(scored)
            parts[name].append(scored.wrench - left)
    return compare(parts, all_poses.sigma)


def _models(rest: Calibrated, mounted: Identification) -> list[_Predict | None]:
    moments, offset = plain_least_squares(rest.tool.gravity, rest.tool.wrench)
    try:
        unmounted = rest.identify_unmounted()
    except IdentificationError:  # far off, readings fit no load at all without a mounting
        galen = None
    else:
        galen = _predictor(unmounted, rest.zero_angles)
    return [
        lambda poses: gravity_regressor(poses.gravity) @ moments + offset,
        galen,
        _predictor(mounted, rest.zero_angles),
    ]


def _predictor(found: Identification, zero_angles: ArrayLike | None) -> _Predict:

    def predict(poses: StillPoses) -> Array:
        mounting = found.mounting or Mounting.of(poses.arm)
        gravity = mounting.gravity_in_sensor(poses.angles, poses.arm)
        wrench = (
            gravity_wrench(gravity, found.load.load)
            + gravity_wrench(gravity, found.adapter.load)
            - gravity_wrench(mounting.gravity_in_sensor(zero_angles, poses.arm), found.adapter.load)
        )
        return np.asarray(wrench @ mounting.reading_from_wrench.T + found.offset)

    return predict


def _held(poses: StillPoses, block: int, blocks: int) -> np.ndarray:
    return np.asarray(np.arange(len(poses)) * blocks // len(poses) == block)
