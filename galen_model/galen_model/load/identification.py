"""Identify loads at the wrist from averaged readings of still poses.

The model is linear in the loads' moments x = (m, h = m p) (see `galen_model.load.model`), with
G(theta) the gravity regressor and G_0 the one at the pose where the sensor was zeroed:

    sweep without the tool:   y_i = (G(theta_i) - G_0) x_b               + o_bare
    sweep with the tool:      y_i = G(theta_i) x_t + (G(theta_i) - G_0) x_b + o_tool

x_t belongs to the tool, x_b to the adapter ("bias load"). The offsets o hold what the zeroing left
and how far the sensor had drifted when each sweep was made; they are free and apart, so that a
slow drift between the two sweeps reaches neither mass nor centre. After two sweeps everything is
told. With one sweep the offset has to be taken as the zeroing's own noise, and even then only the
sum of tool and adapter is known for the part of h along gravity at the zeroing pose, because the
sensor reads G(theta) (x_t + x_b) - G_0 x_b, and g_0 x h_b says nothing of h_b along g_0. Of a
sensor that was not zeroed so, one sweep tells one load, tool and adapter together, and the offset.

Source: the 2019 report's eqs. (1)-(8) with the errata's bias term, as one least-squares problem
that uses force and torque of both sweeps together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.load.identifiability import LOAD_PARAMETERS, check_excitation
from galen_model.load.model import LoadEstimate, gravity_regressor
from galen_model.load.robust_fit import Prior, RobustFit, fit_robust

if TYPE_CHECKING:
    from galen_model.load.drifting_bias import Shapes
    from galen_model.load.mounting import Mounting

MIN_POSES = 4
"""Fewer still poses than this leave no residual worth the name."""

_MAX_REJECTED_FRACTION = 1 / 3
_MIN_POSES_FOR_BIAS_DRIFT = 12
_BIAS_DRIFT_SIGMAS = 4.0  # by chance in one calibration of a thousand, over its twelve channels
_ZEROED_SQUARE = float(chi2_ppf(0.999, 3))
_SURE = 3.0  # standard deviations
_FARTHEST_ADAPTER_M = 0.3
ONE_LOAD = ("tool and adapter: found as one load, with the sensor's constant offset",)
"""What a sweep of a sensor that was not zeroed does not tell."""

_UNOBSERVED_MOMENT_STD_KGM = 0.01  # 100 g at 100 mm: wider than any adapter's first moment


@dataclass(frozen=True)
class StillPoses:
    """Averaged readings of n still poses of one sweep.

    angles: (n, k) of the turning joints, rad; wrench: (n, 6) N and N.m; std_of_mean: (n, 6), the
    averaged reading's standard deviation from the scatter within each pose, or None; time_s: (n,)
    when each was taken, s from anywhere, or None. A bias that drifts needs it. temperature_c: (n,)
    of the sensor, deg C, or None.
    """

    angles: Array
    wrench: Array
    std_of_mean: Array | None = None
    time_s: Array | None = None
    arm: Arm = field(kw_only=True)
    temperature_c: Array | None = None

    def __post_init__(self) -> None:
        """Check shapes and values; raises IdentificationError."""
        count, names = len(self.angles), self.arm.turning_names
        if self.angles.shape != (count, len(names)):
            raise IdentificationError(
                f"angles of the still poses have shape {self.angles.shape}; expected ({count},"
                f" {len(names)}) for {', '.join(names)}"
            )
        if self.wrench.shape != (count, 6):
            raise IdentificationError(
                f"wrenches of the still poses have shape {self.wrench.shape}; expected ({count}, 6)"
            )
        named = {"angles": self.angles, "wrench": self.wrench}
        for name, column in (("time", self.time_s), ("temperature", self.temperature_c)):
            if column is not None:
                if column.shape != (count,):
                    raise IdentificationError(
                        f"angles and {name} of the still poses differ in length"
                    )
                named[name] = column
        for name, values in named.items():
            if not np.all(np.isfinite(values)):
                raise IdentificationError(f"{name} of the still poses holds a non-finite value")

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.angles)

    @property
    def gravity(self) -> Array:
        """Gravity (n, 3) in ft_sensor, m/s^2."""
        return self.arm.gravity_in_sensor(self.angles)

    @property
    def noise(self) -> Array | None:
        """Standard deviation (6,) of an averaged reading, N and N.m; None where it is not known."""
        if self.std_of_mean is None:
            return None
        return np.asarray(np.sqrt(np.mean(self.std_of_mean**2, axis=0)))

    def take(self, rows: np.ndarray) -> StillPoses:
        """Return the poses `rows` (n,), a mask."""

        def part(column: Array | None) -> Array | None:
            return None if column is None else column[rows]

        return StillPoses(
            self.angles[rows],
            self.wrench[rows],
            part(self.std_of_mean),
            part(self.time_s),
            part(self.temperature_c),
            arm=self.arm,
        )


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


def identify_two_sweeps(
    bare: StillPoses, tool: StillPoses, zero_angles: ArrayLike | None = None
) -> Identification:
    """Tool and adapter from a sweep without the tool and one with it.

    Raises NotExcitedError naming what the poses don't tell, IdentificationError for a mass that is
    not positive, too few poses or too many that fit no load.
    """
    design = check_two_sweeps(bare, tool, zero_angles)
    poses = {"without the tool": bare, "with the tool": tool}
    fit = fit_robust(design, np.concatenate([bare.wrench, tool.wrench]))
    check_rejections(fit)
    check_excitation(design[fit.used], LOAD_PARAMETERS, poses)
    return two_sweeps_result(fit, bare, tool)


def check_two_sweeps(
    bare: StillPoses, tool: StillPoses, zero_angles: ArrayLike | None = None
) -> Array:
    """Return the design of `two_sweeps_design`; raises as `identify_two_sweeps` before a fit."""
    check_count(bare, "sweep without the tool")
    check_count(tool, "sweep with the tool")
    zero = gravity_regressor(tool.arm.gravity_in_sensor(zero_angles))
    bare_rows = gravity_regressor(bare.gravity) - zero
    tool_rows = gravity_regressor(tool.gravity)
    design = two_sweeps_design(bare_rows, tool_rows, zero)
    poses = {"without the tool": bare, "with the tool": tool}
    check_excitation(design, LOAD_PARAMETERS, poses)
    check_channels(bare_rows, bare, "sweep without the tool")
    check_channels(tool_rows, tool, "sweep with the tool")
    return design


def check_one_sweep(tool: StillPoses) -> None:
    """Raise as `identify_one_sweep` does before a fit.

    The sum of both loads must show in the poses themselves, whatever the zeroing tells.
    """
    check_count(tool, "sweep with the tool")
    check_excitation(single_load_design(tool.gravity), LOAD_PARAMETERS[:4], {"with the tool": tool})
    check_channels(gravity_regressor(tool.gravity), tool, "sweep with the tool")


def two_sweeps_result(
    fit: RobustFit, bare: StillPoses, tool: StillPoses, *, drifts: bool = False
) -> Identification:
    """Return what a fit to both sweeps found; drifts: a change between the sweeps is no news.

    Its values: see `two_sweeps_design`, any others last.

    Raises IdentificationError.
    """
    used_bare, used_tool = fit.used[: len(bare)], fit.used[len(bare) :]
    change = fit.values[14:20] - fit.values[8:14]
    change_matrix = np.zeros((6, len(fit.values)))
    change_matrix[:, 14:20], change_matrix[:, 8:14] = np.eye(6), -np.eye(6)
    change_std = np.sqrt(np.diag(change_matrix @ fit.covariance @ change_matrix.T))
    warnings = [
        *_noise_warnings(fit, _joined_std(bare, tool)),
        *([] if drifts else _drift_warnings(change, change_std, fit.sigma)),
        *_bias_drift_warnings(fit, slice(0, len(bare)), "sweep without the tool"),
        *_bias_drift_warnings(fit, slice(len(bare), None), "sweep with the tool"),
    ]
    return Identification(
        load=load_estimate(fit, slice(0, 4), "the tool"),
        adapter=load_estimate(fit, slice(4, 8), "the adapter"),
        offset=fit.values[14:20],
        offset_std=np.sqrt(np.diag(fit.covariance)[14:20]),
        offset_change=change,
        offset_change_std=change_std,
        rmse=_rmse(fit.residuals[len(bare) :], used_tool),
        sigma=fit.sigma,
        used_tool=used_tool,
        used_bare=used_bare,
        outliers=(
            *_outliers(fit, np.arange(len(bare)), "bare"),
            *_outliers(fit, len(bare) + np.arange(len(tool)), "tool"),
        ),
        warnings=tuple(warnings),
    )


def identify_one_sweep(tool: StillPoses, zero_angles: ArrayLike | None = None) -> Identification:
    """Identify tool and adapter from one sweep with the tool on, after zeroing without it.

    The compensation is fully determined; the split between tool and adapter is not: `unresolved`
    names what is not known, the adapter's first moment along gravity at the zeroing pose is put to
    zero, and the covariances hold how wide that leaves both.

    The offset is taken as the zeroing's noise, as large as that of one averaged reading. A sensor
    that has drifted since it was zeroed is mistaken for adapter mass; two sweeps don't do that.

    Raises as `identify_two_sweeps` does.
    """
    check_one_sweep(tool)
    gravity_zero = tool.arm.gravity_in_sensor(zero_angles)
    rows = gravity_regressor(tool.gravity)
    design = np.zeros((len(tool), 6, 14))
    design[:, :, :4] = rows
    design[:, :, 4:8] = rows - gravity_regressor(gravity_zero)
    design[:, :, 8:14] = np.eye(6)
    fit = fit_robust(design, tool.wrench, Prior(*one_sweep_prior(gravity_zero), slice(8, 14)))
    check_rejections(fit)
    sum_design = single_load_design(tool.gravity[fit.used])
    check_excitation(sum_design, LOAD_PARAMETERS[:4], {"with the tool": tool})
    return one_sweep_result(fit, tool, gravity_zero)


def one_sweep_result(fit: RobustFit, tool: StillPoses, gravity_zero: Array) -> Identification:
    """Return what a fit to one sweep found; its values: see `identify_one_sweep`, any others last.

    gravity_zero: (3,) in ft_sensor where the sensor was zeroed, m/s^2. Raises IdentificationError.
    """
    along = gravity_zero / np.linalg.norm(gravity_zero)
    total = along @ (fit.values[1:4] + fit.values[5:8])
    unresolved = (
        "the first moments of tool and adapter along gravity at the zeroing pose "
        f"(direction in the sensor's frame {np.round(along, 4).tolist()}): only their sum "
        f"{total:.6f} kg.m is known, here all of it is given to the tool; as long as the sensor is "
        "zeroed there with the adapter alone the compensation is not affected",
    )
    return Identification(
        load=load_estimate(fit, slice(0, 4), "the tool"),
        adapter=load_estimate(fit, slice(4, 8), "the adapter"),
        offset=fit.values[8:14],
        offset_std=np.sqrt(np.diag(fit.covariance)[8:14]),
        offset_change=None,
        offset_change_std=None,
        rmse=_rmse(fit.residuals, fit.used),
        sigma=fit.sigma,
        used_tool=fit.used,
        used_bare=np.zeros(0, dtype=bool),
        outliers=_outliers(fit, np.arange(len(tool)), "tool"),
        warnings=(
            *_noise_warnings(fit, tool.std_of_mean),
            *_bias_drift_warnings(fit, slice(None), "sweep with the tool"),
            *unresolved,
        ),
        unresolved=unresolved,
    )


def zeroing_fault(tool: StillPoses, gravity_zero: Array) -> str:
    """Say why the sensor can't have been zeroed with the adapter alone; empty where it may.

    One load x and free offsets o are fitted to the sweep. A zeroing with the adapter (m_b, h_b)
    under gravity g_0 leaves o = -G_0 x_b:

        o_f = -m_b g_0,    o_tau = g_0 x h_b

    so that o_f has no part across g_0 (two numbers) and o_tau none along it (one). With C their
    covariance, of the fit and of the zeroing's own reading, d^T C^-1 d is chi-square of 3. Beside
    that m_b lies between zero and the whole mass, and h_b across g_0 within 0.3 m of the sensor.

    Args:
        tool: the sweep.
        gravity_zero: (3,) in the sensor's frame where it would have been zeroed, m/s^2.

    Raises:
        IdentificationError: as `identify_single_load` does.

    """
    fit = fit_robust(single_load_design(tool.gravity), tool.wrench)
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


def identify_one_load(tool: StillPoses) -> Identification:
    """Identify tool and adapter as one load, with the sensor's own constant offset, from one sweep.

    Raises as `identify_two_sweeps` does.
    """
    check_one_sweep(tool)
    fit = fit_robust(single_load_design(tool.gravity), tool.wrench)
    check_rejections(fit)
    used = single_load_design(tool.gravity[fit.used])
    check_excitation(used, LOAD_PARAMETERS[:4], {"with the tool": tool})
    return one_load_result(fit, tool)


def one_load_result(fit: RobustFit, tool: StillPoses) -> Identification:
    """Return what a fit found; its values: moments (4), offsets (6), any others last.

    Raises IdentificationError.
    """
    return Identification(
        load=load_estimate(fit, slice(0, 4), "the load"),
        adapter=LoadEstimate(0.0, np.zeros(3), np.zeros((4, 4))),
        offset=fit.values[4:10],
        offset_std=np.sqrt(np.diag(fit.covariance)[4:10]),
        offset_change=None,
        offset_change_std=None,
        rmse=_rmse(fit.residuals, fit.used),
        sigma=fit.sigma,
        used_tool=fit.used,
        used_bare=np.zeros(0, dtype=bool),
        outliers=_outliers(fit, np.arange(len(tool)), "tool"),
        warnings=(
            *_noise_warnings(fit, tool.std_of_mean),
            *_bias_drift_warnings(fit, slice(None), "sweep with the tool"),
        ),
        unresolved=ONE_LOAD,
        zeroed=False,
    )


def check_planned_poses(
    angles: Array,
    *,
    one_sweep: bool = False,
    zero_angles: ArrayLike | None = None,
    arm: Arm,
) -> None:
    """Raise NotExcitedError, before the arm moves, where angles (n, k), rad, excite too little."""
    planned = StillPoses(angles, np.zeros((len(angles), 6)), arm=arm)
    check_count(planned, "each sweep")
    rows = gravity_regressor(planned.gravity)
    if one_sweep:
        check_excitation(single_load_design(planned.gravity), LOAD_PARAMETERS[:4])
        return
    zero = gravity_regressor(arm.gravity_in_sensor(zero_angles))
    poses = {"in each sweep": planned}
    check_excitation(two_sweeps_design(rows - zero, rows, zero), LOAD_PARAMETERS, poses)


def two_sweeps_design(bare_rows: Array, tool_rows: Array, zero: Array) -> Array:
    """Columns: tool's moments (4), adapter's (4), offsets of the bare sweep (6), the other (6)."""
    count = len(bare_rows)
    design = np.zeros((count + len(tool_rows), 6, 20))
    design[:count, :, 4:8] = bare_rows
    design[:count, :, 8:14] = np.eye(6)
    design[count:, :, :4] = tool_rows
    design[count:, :, 4:8] = tool_rows - zero
    design[count:, :, 14:20] = np.eye(6)
    return design


def one_sweep_prior(gravity_zero: Array) -> tuple[Array, Array, Array]:
    """Return what is known beforehand: rows (1, 14), value (1,) and standard deviation (1,).

    gravity_zero: (3,) in ft_sensor where the sensor was zeroed, m/s^2.
    """
    row = np.zeros((1, 14))
    row[0, 5:8] = gravity_zero / np.linalg.norm(gravity_zero)
    return row, np.zeros(1), np.array([_UNOBSERVED_MOMENT_STD_KGM])


@dataclass(frozen=True)
class SingleLoad:
    """One load and six constant biases from orientations alone (the ten-parameter model)."""

    load: LoadEstimate
    offset: Array
    sigma: Array
    used: np.ndarray

    def predict(self, gravity_sensor: ArrayLike) -> Array:
        """Return readings (..., 6), N and N.m, under gravity (..., 3) in the sensor, m/s^2."""
        return gravity_regressor(gravity_sensor) @ self.load.load.moments + self.offset


def identify_single_load(gravity_sensor: ArrayLike, wrench: ArrayLike) -> SingleLoad:
    """Mass, centre and six biases, robust to outliers, from gravity (n, 3) and readings (n, 6).

    Raises as `identify_two_sweeps` does.
    """
    gravity, reading = np.asarray(gravity_sensor, dtype=float), np.asarray(wrench, dtype=float)
    if len(gravity) < MIN_POSES:
        raise IdentificationError(f"{len(gravity)} still poses; at least {MIN_POSES} are needed")
    design = single_load_design(gravity)
    check_excitation(design, LOAD_PARAMETERS[:4])
    fit = fit_robust(design, reading)
    check_rejections(fit)
    check_excitation(design[fit.used], LOAD_PARAMETERS[:4])
    load = load_estimate(fit, slice(0, 4), "the load")
    return SingleLoad(load, fit.values[4:], fit.sigma, fit.used)


def plain_least_squares(gravity_sensor: ArrayLike, wrench: ArrayLike) -> tuple[Array, Array]:
    """Fit moments (4,) and biases (6,), unweighted and unchecked, as other packages do.

    gravity (n, 3) in the sensor's frame, m/s^2; readings (n, 6). The three axes of a force (of a
    torque) count alike, whatever their noise; force and torque share no parameter in (m, h).
    """
    design = single_load_design(np.asarray(gravity_sensor, dtype=float))
    solution = np.linalg.lstsq(
        design.reshape(-1, 10), np.asarray(wrench, dtype=float).reshape(-1), rcond=None
    )[0]
    return solution[:4], solution[4:]


def single_load_design(gravity: Array) -> Array:
    """Columns (n, 6, 10): one load's moments (4) and six offsets, from gravity (n, 3), m/s^2."""
    design = np.zeros((len(gravity), 6, 10))
    design[:, :, :4] = gravity_regressor(gravity)
    design[:, :, 4:] = np.eye(6)
    return design


def check_count(poses: StillPoses, name: str) -> None:
    """Raise NotExcitedError for fewer than `MIN_POSES`."""
    if len(poses) < MIN_POSES:
        raise NotExcitedError(f"{name}: {len(poses)} still poses; at least {MIN_POSES} are needed")


def check_channels(rows: Array, poses: StillPoses, name: str) -> None:
    """Raise IdentificationError for a channel that reads the same whatever the other five do.

    rows: (n, 6, 4) of one load and, with free offsets, of any that hang on the sensor together.
    A dead channel would else pass as a noisy one, since its own residual makes its weight.
    """
    centred_rows = rows - rows.mean(axis=0)
    centred = poses.wrench - poses.wrench.mean(axis=0)
    for channel in np.flatnonzero(np.ptp(poses.wrench, axis=0) == 0.0):
        others = np.delete(np.arange(6), channel)
        moments = np.linalg.lstsq(
            centred_rows[:, others].reshape(-1, 4), centred[:, others].reshape(-1), rcond=None
        )[0]
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


def check_rejections(fit: RobustFit) -> None:
    """Raise IdentificationError where too many poses fit no common load."""
    rejected = int(np.sum(~fit.used))
    if rejected > _MAX_REJECTED_FRACTION * len(fit.used):
        raise IdentificationError(
            f"{rejected} of {len(fit.used)} poses fit no common load: was the tool touched, did it "
            "shift, or do the joint angles not belong to the readings?"
        )


def load_estimate(fit: RobustFit, columns: slice, name: str) -> LoadEstimate:
    """Mass and centre from the moments; covariance by p = h / m, dp = (dh - p dm) / m.

    Raises IdentificationError calling the load `name`.
    """
    moments, covariance = fit.values[columns], fit.covariance[columns, columns]
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


def _rmse(residuals: Array, used: np.ndarray) -> Array:
    return np.asarray(np.sqrt(np.mean(residuals[used] ** 2, axis=0)))


def _joined_std(*sweeps: StillPoses) -> Array | None:
    parts = [sweep.std_of_mean for sweep in sweeps]
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


def _outliers(
    fit: RobustFit, indices: np.ndarray, sweep: str
) -> tuple[tuple[str, int, float], ...]:
    return tuple(
        (sweep, pose, float(fit.distance[index]))
        for pose, index in enumerate(indices)
        if not fit.used[index]
    )


def _noise_warnings(fit: RobustFit, std_of_mean: Array | None) -> list[str]:
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


def _bias_drift_warnings(fit: RobustFit, sweep: slice, name: str) -> list[str]:
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
