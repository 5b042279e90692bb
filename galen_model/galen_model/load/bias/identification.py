"""Tool and adapter as `identification`, with a sensor whose bias drifts over the sweeps.

Each sweep has six curves of its own (the sensor may have been zeroed in between), of a shape that
held-out blocks choose (`choice`); the fit is `drifting`. What comes out is an
`Identification` whose offsets are the biases at the end of each sweep, because they are what holds
for the first readings that the calibration is used on, and whose covariances hold the bias drift.
Where a constant bias is chosen, it is that of `identification`, to the last digit.

One load from orientations and times alone, with a bias that may drift meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.errors import IdentificationError, NotExcitedError
from galen_model.files.calibration_file import LoadEstimate
from galen_model.load.bias.choice import BiasMode, Choice, SweepBiasDrift, choose_by_mode
from galen_model.load.bias.curve import BiasShape
from galen_model.load.bias.drifting import BiasDriftFit, Sweeps, fit_drifting
from galen_model.load.excitation import LOAD_PARAMETERS, check_excitation
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
        """Reading (n, 6), N and N.m, under gravity (n, 3), m/s^2, at times (n,), s."""
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
    zero_roll_rad: float = 0.0,
    zero_tilt_rad: float = 0.0,
    mode: BiasMode = BiasMode.AUTO,
) -> Identification:
    """As `identify_two_sweeps`; the poses need times. Raises as it does.

    NotExcitedError also where the order of the poses makes a bias drift look like a load.
    """
    named = {"without the tool": bare, "with the tool": tool}
    for name, poses in named.items():
        check_count(poses, f"sweep {name}")
    zero = gravity_regressor(gravity_in_sensor(zero_roll_rad, zero_tilt_rad))
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
        found = identify_two_sweeps(bare, tool, zero_roll_rad, zero_tilt_rad)
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
    zero_roll_rad: float = 0.0,
    zero_tilt_rad: float = 0.0,
    known_adapter: LoadEstimate | None = None,
    mode: BiasMode = BiasMode.AUTO,
) -> Identification:
    """As `identify_one_sweep`; the poses need times, and the zeroing holds for the first of them.

    Raises as it does.
    """
    check_count(tool, "sweep with the tool")
    gravity_zero = gravity_in_sensor(zero_roll_rad, zero_tilt_rad)
    rows = gravity_regressor(tool.gravity)
    offsets = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
    sum_design = np.concatenate([rows, offsets], axis=2)
    check_excitation(sum_design, LOAD_PARAMETERS[:4], {"with the tool": tool})
    check_channels(rows, tool, "sweep with the tool")
    prior_rows, prior_values, prior_std = one_sweep_prior(gravity_zero, known_adapter)
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
        found = identify_one_sweep(tool, zero_roll_rad, zero_tilt_rad, known_adapter)
        return replace(
            found, bias_drift=None if choice is None else SweepBiasDrift(choice, None, None, 1.0)
        )
    fitted = fit_drifting(sweeps, choice.shapes)
    check_rejections(fitted.fit)
    bias_drift = SweepBiasDrift(choice, None, fitted.bias, float(fitted.growth[0]))
    return _with_bias_drift(
        one_sweep_result(fitted.fit, tool, gravity_zero, known_adapter), bias_drift
    )


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
