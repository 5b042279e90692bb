# SPDX-License-Identifier: Apache-2.0
"""Identify loads at the wrist, offsets and, where asked, the mounting, from still poses.

After two sweeps tool, adapter and both offsets are known. With one sweep the offset has to be taken
as the zeroing's own noise, and even then only the sum of tool and adapter is known for the part of
h along gravity at the zeroing pose, because the sensor reads G(theta) (x_t + x_b) - G_0 x_b, and
g_0 x h_b holds nothing of h_b along g_0. Of a sensor that was not zeroed so, one sweep gives one
load, tool and adapter together, and the offset. The model: `galen_model.load.readings`.

The mounting is found by Gauss-Newton, each step of which is a robust fit
(`galen_model.estimation.problem`). Before and after, `identifiability` rejects parameters that the
poses don't identify. No parameter of the mounting has a prior; of the loads only what the caller
has measured otherwise (a scale, a drawing) enters.

Source: the 2019 report's eqs. (1)-(8) with the errata's bias term, as one least-squares problem
that uses force and torque of both sweeps together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.estimation.curves import Shapes
from galen_model.estimation.least_squares import least_squares
from galen_model.estimation.problem import Fit, Known, gauss_newton
from galen_model.load.identifiability import (
    LOAD_PARAMETERS,
    MAX_STD,
    check_excitation,
    check_identifiable,
)
from galen_model.load.model import LoadEstimate, gravity_regressor
from galen_model.load.mounting import Mounting
from galen_model.load.reading_model import ReadingModel
from galen_model.load.readings import LoadReadings, StillPoses, single_load_design, with_offsets

MIN_POSES = 4
"""Fewer still poses than this leave no residual worth the name."""

_MAX_REJECTED_FRACTION = 1 / 3
_MIN_POSES_FOR_BIAS_DRIFT = 12
_BIAS_DRIFT_SIGMAS = 4.0  # by chance in one calibration of a thousand, over its twelve channels
_ZEROED_SQUARE = float(chi2_ppf(0.999, 3))
_SURE = 3.0  # standard deviations
_FARTHEST_ADAPTER_M = 0.3
_STEPS = 20
_STEPS_OF_REJECTION = 6  # readings that come and go with every step would never end
_LARGEST_RESPONSE = 1.0  # rad or a gain
ONE_LOAD = ("tool and adapter: found as one load, with the sensor's constant offset",)
"""What a sweep of a sensor that was not zeroed does not show."""


@dataclass(frozen=True)
class SweepBiasDrift:
    """How the bias went over a calibration.

    shapes: of the six axes. bare (m, 6) or None, tool (n, 6): the bias at each pose, N and N.m.
    """

    shapes: Shapes
    bare: Array | None
    tool: Array


@dataclass(frozen=True)
class Identification:
    """What a calibration found.

    load, adapter: tool and adapter with covariance (4, 4) of (kg, m, m, m). offset: (6,) constant
    part of the sweep with the tool on, and its standard deviation; offset_change: (6,) that offset
    less the one of the sweep without the tool, with its standard deviation (None after one sweep).
    rmse: (6,) residual of the used readings of the sweep with the tool; sigma: (6,) noise of one
    averaged reading as the residuals tell it. used_*: masks of the poses used. outliers: poses that
    the fit left out: the sweep ("bare" or "tool"), the place in it, and by how many sigmas.
    bias_drift: None unless a bias that drifts was chosen; where it was, each offset is that at
    its sweep's last pose. mounting: None unless its parameters were asked for, or chosen. model,
    reason: what was chosen, and why, in a line each; empty where nothing was.
    """

    load: LoadEstimate
    adapter: LoadEstimate
    offset: Array
    offset_std: Array
    offset_change: Array | None
    offset_change_std: Array | None
    rmse: Array
    sigma: Array
    used_tool: np.ndarray
    used_bare: np.ndarray
    outliers: tuple[tuple[str, int, float], ...]
    warnings: tuple[str, ...]
    unresolved: tuple[str, ...] = ()
    bias_drift: SweepBiasDrift | None = None
    mounting: Mounting | None = None
    model: str = ""
    reason: str = ""
    zeroed: bool = True
    """Whether tool and adapter are apart; else the load is both, and the offset the sensor's."""


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

    def of_moments(self, parameters: int) -> Known:
        """Convert to knowledge of the moments (m, h).

        A known centre p is h - p m = 0 within m times its deviation.

        Args:
            parameters: number of unknowns, of which the load's moments are the first four.

        Returns:
            1 row, or 4 where the centre is known, in kg and kg.m.

        """
        count = 1 if self.com_m is None else 4
        rows, values = np.zeros((count, parameters)), np.zeros(count)
        std = np.full(count, self.mass_std_kg)
        rows[0, 0], values[0] = 1.0, self.mass_kg
        if self.com_m is not None and self.com_std_m is not None:
            rows[1:, 1:4] = np.eye(3)
            rows[1:, 0] = -np.asarray(self.com_m, dtype=float)
            std[1:] = self.mass_kg * self.com_std_m
        return Known(rows, values, std)


def identify_two_sweeps(
    bare: StillPoses,
    tool: StillPoses,
    zero_angles: ArrayLike | None = None,
    groups: Sequence[str] = (),
    known: KnownLoad | None = None,
) -> Identification:
    """Identify tool and adapter from a sweep without the tool and one with it.

    Args:
        bare: the sweep without the tool.
        tool: the sweep with it.
        zero_angles: (k,) where the sensor was zeroed, rad; None: the arm's home.
        groups: of the mounting, to be found as well; rmse and offsets are of the raw axes.
        known: what is known of the tool otherwise.

    Returns:
        Loads, offsets and the mounting, if asked for.

    Raises:
        NotExcitedError: naming what the poses don't identify.
        IdentificationError: for a mass that is not positive, too few poses or too many that fit no
            load.

    """
    readings = check_two_sweeps(bare, tool, zero_angles)
    if known is not None:
        readings = replace(readings, known=known.of_moments(8))
    poses = {"without the tool": bare, "with the tool": tool}
    fit, mounting = fit_robust(readings, groups, poses=poses)
    return identification(fit, mounting if groups else None, tool, bare)


def check_two_sweeps(
    bare: StillPoses, tool: StillPoses, zero_angles: ArrayLike | None = None
) -> LoadReadings:
    """Check two sweeps before a fit.

    Args:
        bare: the sweep without the tool.
        tool: the sweep with it.
        zero_angles: (k,) where the sensor was zeroed, rad; None: the arm's home.

    Returns:
        The readings of both.

    Raises:
        NotExcitedError: too few poses, or poses that don't identify the loads.
        IdentificationError: a channel reads the same whatever the others do.

    """
    check_count(bare, "sweep without the tool")
    check_count(tool, "sweep with the tool")
    readings = LoadReadings.of_two_sweeps(bare, tool, zero_angles)
    check_loads(readings, poses={"without the tool": bare, "with the tool": tool})
    design = readings.of_loads.design
    check_channels(design[: len(bare), :, 4:8], bare, "sweep without the tool")
    check_channels(design[len(bare) :, :, :4], tool, "sweep with the tool")
    return readings


def identify_one_sweep(
    tool: StillPoses, zero_angles: ArrayLike | None = None, groups: Sequence[str] = ()
) -> Identification:
    """Identify tool and adapter from one sweep with the tool on, after zeroing without it.

    The compensation is fully determined; the split between tool and adapter is not: `unresolved`
    names what is not known, the adapter's first moment along gravity at the zeroing pose is put to
    zero, and the covariances hold how wide that leaves both.

    The offset is taken as the zeroing's noise, as large as that of one averaged reading. A sensor
    that has drifted since it was zeroed is mistaken for adapter mass; two sweeps don't do that.

    Args:
        tool: the sweep.
        zero_angles: (k,) where the sensor was zeroed, rad; None: the arm's home.
        groups: of the mounting, to be found as well; rmse and offsets are of the raw axes.

    Returns:
        Loads, offset and the mounting, if asked for.

    Raises:
        NotExcitedError: naming what the poses don't identify.
        IdentificationError: for a mass that is not positive, too few poses or too many that fit no
            load.

    """
    together = check_one_sweep(tool)
    readings = LoadReadings.of_one_sweep(tool, zero_angles)
    fit, mounting = fit_robust(readings, groups, together, {"with the tool": tool})
    gravity_zero = readings.zero.gravity(mounting)[0][0]
    return identification(fit, mounting if groups else None, tool, gravity_zero=gravity_zero)


def check_one_sweep(tool: StillPoses) -> LoadReadings:
    """Check a sweep before a fit.

    The sum of both loads must show in the poses themselves, whatever the zeroing adds.

    Args:
        tool: the sweep.

    Returns:
        Its readings as of one load.

    Raises:
        NotExcitedError: too few poses, or poses that don't identify one load.
        IdentificationError: a channel reads the same whatever the others do.

    """
    check_count(tool, "sweep with the tool")
    readings = LoadReadings.of_one_load(tool)
    check_loads(readings, poses={"with the tool": tool})
    check_channels(gravity_regressor(tool.gravity), tool, "sweep with the tool")
    return readings


def fit_robust(
    readings: LoadReadings,
    groups: Sequence[str] = (),
    shown: LoadReadings | None = None,
    poses: Mapping[str, StillPoses] | None = None,
) -> tuple[Fit, Mounting]:
    """Fit loads, offsets and mounting to the readings that agree.

    Args:
        readings: n of them.
        groups: of the mounting.
        shown: n readings in which loads and mounting must show; None: `readings`. What tool and
            adapter are together must show in a sweep itself, whatever the zeroing tells.
        poses: the sweeps, for the error's text.

    Returns:
        The fit, whose values are the loads' moments, the mounting along `groups`, the offsets of
        each sweep; and the mounting.

    Raises:
        NotExcitedError: naming what the poses don't tell.
        IdentificationError: where too few agree.

    """
    shown = readings if shown is None else shown
    model = readings.model(groups)
    if not groups:
        fit = readings.of_loads.robust()
    else:
        fit = _fit_mounting(readings, model, shown)
    check_rejections(fit)
    check_loads(shown, fit.used, poses)
    if groups:
        values = _of_shown(fit.values, readings, shown, model)
        check_mounting(shown, model, values, fit.sigma, MAX_STD, fit.used)
    return fit, model.mounting(fit.values, tuple(groups), fit.covariance)


def _fit_mounting(readings: LoadReadings, model: ReadingModel, shown: LoadReadings) -> Fit:
    """Fit by Gauss-Newton from loads without a mounting."""
    first = readings.of_loads.fit(np.ones(len(readings), dtype=bool), equal=True)
    start = np.concatenate([first.values[: model.loads], np.zeros(len(model.entities))])
    check_mounting(shown, model, _of_shown(start, readings, shown, model), first.sigma, None)
    used: list[np.ndarray] = []

    def solve(values: Array) -> Fit:
        problem = readings.linearised(model, values)
        if len(used) < _STEPS_OF_REJECTION:
            used.append(problem.agreeing())
        return problem.fit(used[-1])

    largest = np.repeat([np.inf, _LARGEST_RESPONSE], [model.loads, len(model.entities)])
    return gauss_newton(solve, start, largest, _STEPS)


def _of_shown(
    values: Array, readings: LoadReadings, shown: LoadReadings, model: ReadingModel
) -> Array:
    """Return loads and mounting (p,) as those have them in which they must show."""
    found = values[: model.loads + len(model.entities)]
    if shown.loads == readings.loads:
        return found
    return np.concatenate([found[:4] + found[4:8], found[8:]])


def check_loads(
    readings: LoadReadings,
    used: np.ndarray | None = None,
    poses: Mapping[str, StillPoses] | None = None,
) -> None:
    """Check that the readings identify the loads.

    Args:
        readings: n of them.
        used: mask (n,) of those that count; None: all.
        poses: sweeps by their labels, for the error's text.

    Raises:
        NotExcitedError: naming what they don't identify.

    """
    design = with_offsets(readings.of_loads.design, readings.segment)
    rows = slice(None) if used is None else used
    check_excitation(design[rows], LOAD_PARAMETERS[: readings.loads], poses)


def check_mounting(
    readings: LoadReadings,
    model: ReadingModel,
    values: Array,
    sigma: Array,
    max_std: float | None,
    used: np.ndarray | None = None,
) -> None:
    """Check that the readings identify the mounting.

    Args:
        readings: n of them.
        model: with the mounting's entities; its sweeps don't count.
        values: (p,) loads and mounting, near which the readings are linear.
        sigma: (6,) noise of a reading.
        max_std: largest standard deviation, rad or a gain; None: the noise is not known yet.
        used: mask (n,) of the readings that count; None: all.

    Raises:
        NotExcitedError: naming what they don't identify.

    """
    own = replace(model, sweeps=readings.sweeps, zero=readings.zero, loads=readings.loads)
    jacobian = with_offsets(own.evaluate(values)[1], readings.segment)
    rows = np.zeros((0, jacobian.shape[2]))
    if readings.known is not None:
        beside = jacobian.shape[2] - readings.loads
        rows = readings.known.beside(beside).whitened
    names = [entity.name for entity in model.entities]
    check_identifiable(
        jacobian if used is None else jacobian[used], sigma, readings.loads, names, rows, max_std
    )


def identification(
    fit: Fit,
    mounting: Mounting | None,
    tool: StillPoses,
    bare: StillPoses | None = None,
    *,
    gravity_zero: Array | None = None,
    drifts: bool = False,
) -> Identification:
    """Collect what a fit found of two sweeps, or of one.

    Args:
        fit: its values as `fit_robust` has them.
        mounting: None unless it was asked for, or chosen.
        tool: the sweep with the tool.
        bare: the sweep without it, or None.
        gravity_zero: (3,) in the sensor's frame where it was zeroed with the adapter alone before
            the only sweep, m/s^2; None: two sweeps, or tool and adapter are one load.
        drifts: a change of the offset between the sweeps is no news.

    Returns:
        Loads and offsets, with warnings.

    Raises:
        IdentificationError: for a mass that is not positive.

    """
    first = 0 if bare is None else len(bare)
    apart = bare is not None or gravity_zero is not None
    change, change_std = None, None
    unresolved: tuple[str, ...] = ()
    warnings = _noise_warnings(fit, _joined_std(tool, bare))
    if bare is not None:
        places = np.arange(len(fit.values))[-12:]
        change = fit.values[places[6:]] - fit.values[places[:6]]
        rows = np.eye(len(fit.values))
        across = rows[places[6:]] - rows[places[:6]]
        change_std = np.sqrt(np.diag(across @ fit.covariance @ across.T))
        warnings += [] if drifts else _drift_warnings(change, change_std, fit.sigma)
        warnings += _bias_drift_warnings(fit, slice(0, first), "sweep without the tool")
    warnings += _bias_drift_warnings(fit, slice(first, None), "sweep with the tool")
    if not apart:
        unresolved = ONE_LOAD
    elif gravity_zero is not None:
        unresolved = (_unresolved(fit, gravity_zero),)
        warnings += unresolved
    return Identification(
        load=load_estimate(fit.values, fit.covariance, "the tool" if apart else "the load"),
        adapter=load_estimate(fit.values, fit.covariance, "the adapter", 4)
        if apart
        else LoadEstimate(0.0, np.zeros(3), np.zeros((4, 4))),
        offset=fit.values[-6:],
        offset_std=fit.std[-6:],
        offset_change=change,
        offset_change_std=change_std,
        rmse=np.sqrt(np.mean(fit.residuals[first:][fit.used[first:]] ** 2, axis=0)),
        sigma=fit.sigma,
        used_tool=fit.used[first:],
        used_bare=fit.used[:first],
        outliers=(
            *_outliers(fit, np.arange(first), "bare"),
            *_outliers(fit, np.arange(first, len(fit.used)), "tool"),
        ),
        warnings=tuple(warnings),
        unresolved=unresolved,
        mounting=mounting,
        zeroed=apart,
    )


def _unresolved(fit: Fit, gravity_zero: Array) -> str:
    along = gravity_zero / np.linalg.norm(gravity_zero)
    total = along @ (fit.values[1:4] + fit.values[5:8])
    return (
        "the first moments of tool and adapter along gravity at the zeroing pose "
        f"(direction in the sensor's frame {np.round(along, 4).tolist()}): only their sum "
        f"{total:.6f} kg.m is known, here all of it is given to the tool; as long as the sensor is "
        "zeroed there with the adapter alone the compensation is not affected"
    )


def zeroing_fault(tool: StillPoses, gravity_zero: Array) -> str:
    """Find why the sensor can't have been zeroed with the adapter alone.

    One load x and free offsets o are fitted to the sweep. A zeroing with the adapter (m_b, h_b)
    under gravity g_0 leaves o = -G_0 x_b:

        o_f = -m_b g_0,    o_tau = g_0 x h_b

    so that o_f has no part across g_0 (two numbers) and o_tau none along it (one). With C their
    covariance, of the fit and of the zeroing's own reading, d^T C^-1 d is chi-square of 3. Beside
    that m_b lies between zero and the whole mass, and h_b across g_0 within 0.3 m of the sensor.

    Args:
        tool: the sweep.
        gravity_zero: (3,) in the sensor's frame where it would have been zeroed, m/s^2.

    Returns:
        The reason, a clause; empty where it may have been.

    Raises:
        IdentificationError: too few poses, or too many that fit no load.

    """
    fit = LoadReadings.of_one_load(tool).of_loads.robust()
    check_rejections(fit)
    size = float(np.linalg.norm(gravity_zero))
    along = gravity_zero / size
    across = np.linalg.svd(along[None])[2][1:]
    rows = np.zeros((3, 10))
    rows[:2, 4:7], rows[2, 7:10] = across, along
    noise = np.zeros((10, 10))
    noise[range(4, 10), range(4, 10)] = fit.sigma**2
    covariance = fit.covariance + noise
    off = rows @ fit.values
    square = float(off @ np.linalg.solve(rows @ covariance @ rows.T, off))
    if square > _ZEROED_SQUARE:
        return (
            f"the offset has {np.linalg.norm(off[:2]):.3g} N across gravity at the zeroing pose and"
            f" {abs(off[2]):.3g} N.m along it, where a zeroing with the adapter alone leaves none"
        )
    mass = -float(along @ fit.values[4:7]) / size
    mass_std = float(np.sqrt(along @ covariance[4:7, 4:7] @ along)) / size
    slack = _SURE * mass_std
    if not -slack <= mass <= fit.values[0] + slack:
        whole = f"{fit.values[0] * 1e3:.0f} g"
        return f"the adapter would weigh {mass * 1e3:.0f} g, of {whole} for tool and adapter"
    moment = float(np.linalg.norm(fit.values[7:10])) / size
    moment_std = float(np.sqrt(np.max(np.diag(covariance)[7:10]))) / size
    if moment > _FARTHEST_ADAPTER_M * (mass + slack) + _SURE * moment_std:
        return f"the adapter's centre would be {moment / max(mass, 1e-9):.2g} m from the sensor"
    return ""


def check_planned_poses(
    angles: Array,
    groups: Sequence[str] = (),
    *,
    one_sweep: bool = False,
    zero_angles: ArrayLike | None = None,
    arm: Arm,
) -> None:
    """Check, before the arm moves, that the poses identify loads and mounting.

    Args:
        angles: (n, k), rad.
        groups: of the mounting. The load isn't known yet; one of 100 g, well off every axis,
            stands for it.
        one_sweep: there is none without the tool.
        zero_angles: (k,) where the sensor will be zeroed, rad; None: the arm's home.
        arm: that moves.

    Raises:
        NotExcitedError: naming what they don't identify.
        IdentificationError: a group can't be estimated for this arm.

    """
    planned = StillPoses(np.asarray(angles, dtype=float), np.zeros((len(angles), 6)), arm=arm)
    check_count(planned, "each sweep")
    if one_sweep:
        readings = LoadReadings.of_one_load(planned)
        check_loads(readings)
    else:
        readings = LoadReadings.of_two_sweeps(planned, planned, zero_angles)
        check_loads(readings, poses={"in each sweep": planned})
    if groups:
        model = readings.model(groups)
        load = np.tile(0.1 * np.array([1.0, 0.05, 0.03, 0.05]), readings.loads // 4)
        values = np.concatenate([load, np.zeros(len(model.entities))])
        check_mounting(readings, model, values, np.repeat([1.0, 0.02], 3), None)


@dataclass(frozen=True)
class SingleLoad:
    """One load and six constant biases (6,) from orientations alone: the ten-parameter model.

    mounting: None unless its parameters were asked for.
    """

    load: LoadEstimate
    offset: Array
    sigma: Array
    used: np.ndarray
    mounting: Mounting | None = None

    def predict(self, gravity_sensor: ArrayLike, base_from_sensor: Array | None = None) -> Array:
        """Compute readings.

        Args:
            gravity_sensor: (..., 3) in the sensor's frame of a level base, m/s^2.
            base_from_sensor: R_base_sensor (..., 3, 3), which an inclination of the base needs.

        Returns:
            (..., 6), N and N.m, with the offset.

        """
        gravity = np.asarray(gravity_sensor, dtype=float)
        if self.mounting is None:
            return gravity_regressor(gravity) @ self.load.load.moments + self.offset
        if base_from_sensor is not None:
            gravity = self.mounting.turned_gravity(gravity, base_from_sensor)
        weight = gravity_regressor(gravity) @ self.load.load.moments
        return weight @ self.mounting.reading_from_wrench.T + self.offset


def identify_single_load(
    gravity_sensor: ArrayLike,
    wrench: ArrayLike,
    groups: Sequence[str] = (),
    base_from_sensor: Array | None = None,
    known: KnownLoad | None = None,
    *,
    arm: Arm,
) -> SingleLoad:
    """Identify mass, centre and six biases, robust to outliers, from orientations.

    Args:
        gravity_sensor: (n, 3) in the sensor's frame of a level base, m/s^2.
        wrench: (n, 6), N and N.m.
        groups: of the mounting, to be found as well.
        base_from_sensor: R_base_sensor (n, 3, 3), which an inclination of the base needs.
        known: of all that hangs on the sensor.
        arm: whose sensor it is.

    Returns:
        Load, biases, noise and the mask (n,) of the readings used.

    Raises:
        NotExcitedError: naming what the poses don't identify.
        IdentificationError: for a mass that is not positive, too few poses or too many that fit no
            load.

    """
    readings = LoadReadings.of_orientations(gravity_sensor, wrench, base_from_sensor, arm=arm)
    if len(readings) < MIN_POSES:
        raise IdentificationError(f"{len(readings)} still poses; at least {MIN_POSES} are needed")
    if known is not None:
        readings = replace(readings, known=known.of_moments(4))
    check_loads(readings)
    fit, mounting = fit_robust(readings, groups)
    load = load_estimate(fit.values, fit.covariance, "the load")
    return SingleLoad(load, fit.values[-6:], fit.sigma, fit.used, mounting if groups else None)


def plain_least_squares(gravity_sensor: ArrayLike, wrench: ArrayLike) -> tuple[Array, Array]:
    """Fit moments and biases of one load, unweighted and unchecked, as other packages do.

    The three axes of a force (of a torque) count alike, whatever their noise; force and torque
    share no parameter in (m, h).

    Args:
        gravity_sensor: (n, 3) in the sensor's frame, m/s^2.
        wrench: readings (n, 6), N and N.m.

    Returns:
        Moments (4,), kg and kg.m, and biases (6,), N and N.m.

    """
    design = single_load_design(np.asarray(gravity_sensor, dtype=float))
    solution = least_squares(design, np.asarray(wrench, dtype=float)).values
    return solution[:4], solution[4:]


def check_count(poses: StillPoses, name: str) -> None:
    """Check that a sweep has at least `MIN_POSES` poses.

    Args:
        poses: the sweep.
        name: of the sweep, for the error's text.

    Raises:
        NotExcitedError: it has fewer.

    """
    if len(poses) < MIN_POSES:
        raise NotExcitedError(f"{name}: {len(poses)} still poses; at least {MIN_POSES} are needed")


def check_channels(rows: Array, poses: StillPoses, name: str) -> None:
    """Check for a channel that reads the same whatever the other five do.

    A dead channel would else pass as a noisy one, since its own residual makes its weight.

    Args:
        rows: (n, 6, 4) of one load and, with free offsets, of any that hang on the sensor together.
        poses: the sweep, n poses.
        name: of the sweep, for the error's text.

    Raises:
        IdentificationError: a channel is constant where it should change.

    """
    centred_rows = rows - rows.mean(axis=0)
    centred = poses.wrench - poses.wrench.mean(axis=0)
    for channel in np.flatnonzero(np.ptp(poses.wrench, axis=0) == 0.0):
        others = np.delete(np.arange(6), channel)
        moments = least_squares(centred_rows[:, others], centred[:, others]).values
        kind = [other for other in others if other // 3 == channel // 3]
        noise = np.std(centred[:, kind] - centred_rows[:, kind] @ moments)
        expected = np.ptp(centred_rows[:, channel] @ moments)
        # Zero is right for a channel on which this load has no lever.
        if expected > 10.0 * noise + 1e-9:
            unit = "N" if channel < 3 else "N.m"
            raise IdentificationError(
                f"{name}: {WRENCH_AXES[channel]} is {poses.wrench[0, channel]:g} {unit}, the same "
                f"at all {len(poses)} poses, where it should change by {expected:.3g} {unit}: "
                "does the sensor measure it?"
            )


def check_rejections(fit: Fit) -> None:
    """Check how many poses a fit rejected.

    Args:
        fit: with its mask of the readings used.

    Raises:
        IdentificationError: more than a third fit no common load.

    """
    rejected = int(np.sum(~fit.used))
    if rejected > _MAX_REJECTED_FRACTION * len(fit.used):
        raise IdentificationError(
            f"{rejected} of {len(fit.used)} poses fit no common load: was the tool touched, did it "
            "shift, or do the joint angles not belong to the readings?"
        )


def load_estimate(values: Array, covariance: Array, name: str, first: int = 0) -> LoadEstimate:
    """Compute mass and centre from the moments; covariance by p = h / m, dp = (dh - p dm) / m.

    Args:
        values: (p,), four of which, from `first` on, are the moments.
        covariance: (p, p).
        name: of the load, for the error's text.
        first: see values.

    Returns:
        Mass, centre in ft_sensor and their covariance.

    Raises:
        IdentificationError: for a mass that is not positive beyond its standard deviation.

    """
    columns = slice(first, first + 4)
    moments, covariance = values[columns], covariance[columns, columns]
    mass, std = float(moments[0]), float(np.sqrt(covariance[0, 0]))
    if mass <= 0.0:
        raise IdentificationError(
            f"{name} would weigh {mass * 1e3:.3f} g (standard deviation {std * 1e3:.3f} g): a mass "
            "is positive. Is it mounted? Does a push read positive in the direction of the push?"
        )
    if mass < 3.0 * std:
        raise IdentificationError(
            f"{name} weighs {mass * 1e3:.3f} g with a standard deviation of {std * 1e3:.3f} g, "
            "which is not distinguishable from none. Is it mounted?"
        )
    com = moments[1:] / mass
    jacobian = np.zeros((4, 4))
    jacobian[0, 0] = 1.0
    jacobian[1:, 0] = -com / mass
    jacobian[1:, 1:] = np.eye(3) / mass
    return LoadEstimate(mass, com, jacobian @ covariance @ jacobian.T)


def _joined_std(tool: StillPoses, bare: StillPoses | None) -> Array | None:
    if bare is None or tool.std_of_mean is None:
        return tool.std_of_mean
    if bare.std_of_mean is None:
        return None
    return np.concatenate([bare.std_of_mean, tool.std_of_mean])


def _outliers(fit: Fit, indices: np.ndarray, sweep: str) -> tuple[tuple[str, int, float], ...]:
    return tuple(
        (sweep, pose, float(fit.distance[index]))
        for pose, index in enumerate(indices)
        if not fit.used[index]
    )


def _noise_warnings(fit: Fit, std_of_mean: Array | None) -> list[str]:
    """Tell when the residual is larger than what the scatter within the poses explains."""
    if std_of_mean is None:
        return []
    expected = np.sqrt(np.mean(std_of_mean[fit.used] ** 2, axis=0))
    if not np.all(expected > 0.0):  # an ideal sensor, without any noise to compare with
        return []
    ratio = fit.sigma / expected
    worst = int(np.argmax(ratio))
    if ratio[worst] < 2.0:
        return []
    axis = WRENCH_AXES[worst]
    return [
        f"the residual of {axis} is {ratio[worst]:.1f} times what the noise within a pose explains"
        ": something that the model doesn't hold (drift, joint zero, sensor rotation, a cable)"
    ]


def _drift_warnings(change: Array, std: Array, sigma: Array) -> list[str]:
    return [
        f"the sensor's {name} moved by {value:+.4f} {'N' if index < 3 else 'N.m'} between the "
        "sweeps: it drifts, or was zeroed in between"
        for index, (name, value) in enumerate(zip(WRENCH_AXES, change, strict=True))
        if abs(value) > 5.0 * std[index] and abs(value) > 3.0 * sigma[index]
    ]


def _bias_drift_warnings(fit: Fit, sweep: slice, name: str) -> list[str]:
    """Tell when a sweep's residual goes up or down over its poses, taken as in visiting order.

    Where the order goes with a joint, a drift looks in part like a load, and the parameters
    are off by more than their covariance says. The fit takes that part, so that the drift told is
    a lower bound, and its test against noise a cautious one.
    """
    used, residuals = fit.used[sweep], fit.residuals[sweep]
    order = np.linspace(0.0, 1.0, len(used))[used]
    order = order - order.mean()
    if len(order) < _MIN_POSES_FOR_BIAS_DRIFT:
        return []
    bias_drift = order @ residuals[used] / (order @ order)
    limit = _BIAS_DRIFT_SIGMAS * fit.sigma / np.sqrt(order @ order)
    return [
        f"the residual of {axis} drifted by {value:+.4g} {'N' if index < 3 else 'N.m'} over the "
        f"{name}: the sensor drifts, or the model misses something that goes with the pose; the "
        "stated standard deviations don't hold that"
        for index, (axis, value) in enumerate(zip(WRENCH_AXES, bias_drift, strict=True))
        if abs(value) > limit[index]
    ]
