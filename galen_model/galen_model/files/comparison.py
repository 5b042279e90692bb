# SPDX-License-Identifier: Apache-2.0
"""Two calibration files side by side: what differs, and whether that is more than they can tell.

A difference d of two estimates has the covariance C_a + C_b, as two calibrations don't share their
noise; it is given in its own standard deviations. Mass and centre together are the same load if

    d^T (C_a + C_b)^-1 d  <  chi^2_4(0.95)

(Hotelling's test with known covariances). The covariances know the sensor's noise, and not what
the calibration's model leaves out; calibrations on other days differ by more, where that is large.
Offset and tip have no covariance in the file: their differences are given without a measure.
"""

from dataclasses import dataclass

import numpy as np

from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.distributions import chi2_ppf
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import LoadEstimate
from galen_model.poses.design import angle_limits

_CONFIDENCE = 0.95
_SAME_SIGMAS = 2.0
# Steps of 0.05 rad: between two of them a component of gravity changes by 0.03 % of g more.
_GRID = (64, 41)
_SAMPLES = 4096
_SHOWN = {"kg": (1e3, "g"), "m": (1e3, "mm"), "N": (1e3, "mN"), "N.m": (1e3, "mN.m")}
# In units of the standard deviations: directions that both covariances call exactly known.
_RIDGE = 1e-9


class IncomparableError(GalenError):
    """Two files that say nothing of each other."""


@dataclass(frozen=True)
class Difference:
    """One quantity of two files, SI; std_dev of the difference, NaN where the files tell none."""

    quantity: str
    unit: str
    a: float
    b: float
    std_dev: float = float("nan")

    @property
    def value(self) -> float:
        """The second file's value less the first's."""
        return self.b - self.a

    @property
    def sigmas(self) -> float:
        """Size of the difference in its standard deviations; NaN where there are none."""
        if self.std_dev > 0.0:
            return abs(self.value) / self.std_dev
        if np.isnan(self.std_dev):
            return float("nan")
        return 0.0 if self.value == 0.0 else float("inf")

    @property
    def shown(self) -> tuple[float, str]:
        """For a person: what to multiply the values by, and the unit then."""
        return _SHOWN[self.unit]

    @property
    def text(self) -> str:
        """In words, in g, mm, mN and mN.m."""
        scale, unit = self.shown
        amount = f"{three_digits(scale * abs(self.value))} {unit}"
        if np.isnan(self.std_dev):
            return "the same" if self.value == 0.0 else f"differs by {amount}"
        if self.sigmas <= _SAME_SIGMAS:
            return f"the same within {_SAME_SIGMAS:.0f} sigma"
        return f"differs by {amount} ({three_digits(self.sigmas)} sigma)"


@dataclass(frozen=True)
class CalibrationComparison:
    """Two files compared; `parts`: (part, who has it) of optional parts that not both have.

    worst_force, worst_torque: largest difference over all angles, N or N.m, and the angles (k,) of
    it, rad.
    """

    a: str
    b: str
    differences: tuple[Difference, ...]
    same_load: bool
    worst_force: tuple[float, Array]
    worst_torque: tuple[float, Array]
    parts: tuple[tuple[str, str], ...]

    @property
    def text(self) -> str:
        """The answer in a sentence."""
        if self.same_load:
            load = "the same mass and centre as far as both covariances tell"
        else:
            found = [d for d in self.differences[:4] if d.sigmas > _SAME_SIGMAS]
            load = "another load"
            if found:
                load += ": " + ", ".join(f"{d.quantity} {d.text}" for d in found)
        text = (
            f"'{self.a}' and '{self.b}': {load}; what is compensated differs by at most"
            f" {three_digits(1e3 * self.worst_force[0])} mN and"
            f" {three_digits(1e3 * self.worst_torque[0])} mN.m"
        )
        for part, owner in self.parts:
            text += f"; only '{owner}' has the part {part}"
        return text


def before_name(tool: str) -> str:
    """Name the calibration before a tool's present one, beside others.

    Args:
        tool: the tool's name.

    Returns:
        The name with "before", which no tool has.

    """
    return f"{tool} before"


def compare_calibrations(
    a: CalibrationFile, b: CalibrationFile, names: tuple[str, str] | None = None
) -> CalibrationComparison:
    """Compare two files.

    Args:
        a: the first.
        b: the second; differences are its values less the first's.
        names: what they are called in texts; None: by their tools.

    Returns:
        The differences, and the largest one of what is compensated.

    Raises:
        IncomparableError: the files are of two arms, or a mounting's effect is not known for lack
            of the arm's description.

    """
    name_a, name_b = names or (a.tool, b.tool)
    if why := a.arm.difference(b.arm):
        raise IncomparableError(f"'{name_a}' and '{name_b}' are of two arms: {why}")
    if not a.arm.urdf and (a.mounting or b.mounting):
        raise IncomparableError(
            f"'{name_a}' or '{name_b}' has a mounting, whose effect depends on the arm"
            f" '{a.arm.name}': give --urdf FILE and --sensor-frame {a.sensor_frame}"
        )
    differences = [
        *_load_differences("", a.load, b.load),
        *_load_differences("adapter_", a.adapter, b.adapter),
    ]
    for axis, of_a, of_b in zip(WRENCH_AXES, a.residual_offset, b.residual_offset, strict=True):
        unit = "N" if axis.startswith("f") else "N.m"
        differences.append(Difference(f"offset_{axis}", unit, float(of_a), float(of_b)))
    for axis, of_a, of_b in zip("xyz", a.tip_m, b.tip_m, strict=True):
        differences.append(Difference(f"tip_{axis}", "m", float(of_a), float(of_b)))
    force, torque = _worst(a, b)
    return CalibrationComparison(
        name_a,
        name_b,
        tuple(differences),
        same_load(a.load, b.load),
        force,
        torque,
        tuple((part, name_a) for part in a.parts if part not in b.parts)
        + tuple((part, name_b) for part in b.parts if part not in a.parts),
    )


def same_load(a: LoadEstimate, b: LoadEstimate) -> bool:
    """Check whether mass and centre are the same, at 95 %, as far as both covariances show.

    Args:
        a: the first estimate.
        b: the second, of independent noise and in the same frame.

    Returns:
        Whether noise alone may make the difference.

    """
    covariance = np.asarray(a.covariance, dtype=float) + b.covariance
    difference = np.concatenate([[b.mass_kg - a.mass_kg], b.com_m - np.asarray(a.com_m)])
    scale = np.sqrt(np.diag(covariance))
    if np.any((scale == 0.0) & (difference != 0.0)):
        return False
    scale[scale == 0.0] = 1.0
    correlation = covariance / scale / scale[:, None] + _RIDGE * np.eye(4)
    with np.errstate(over="ignore"):  # variances next to nothing: surely not the same
        z = difference / scale
        return bool(z @ np.linalg.solve(correlation, z) < chi2_ppf(_CONFIDENCE, 4))


def _load_differences(prefix: str, a: LoadEstimate, b: LoadEstimate) -> list[Difference]:
    std_dev = np.sqrt(np.diag(np.asarray(a.covariance, dtype=float) + b.covariance))
    rows = [Difference(f"{prefix}mass", "kg", a.mass_kg, b.mass_kg, float(std_dev[0]))]
    for index, axis in enumerate("xyz"):
        of_a, of_b = float(a.com_m[index]), float(b.com_m[index])
        rows.append(Difference(f"{prefix}com_{axis}", "m", of_a, of_b, float(std_dev[1 + index])))
    return rows


def _worst(a: CalibrationFile, b: CalibrationFile) -> list[tuple[float, Array]]:
    """Over angles within the arm's limits, of weight and offsets: a grid of two, else samples.

    Of an arm without geometry over all directions of gravity, and the angles are NaN.
    """
    lower, upper = angle_limits(a.arm)
    if not a.arm.urdf:
        even = np.random.default_rng(0).normal(size=(_SAMPLES, 3))
        even /= np.linalg.norm(even, axis=1, keepdims=True)
        angles = np.full((_SAMPLES, len(lower)), np.nan)
        of_a, of_b = (one.predict_under(even * np.linalg.norm(one.gravity_m_s2)) for one in (a, b))
        return _largest(of_b - of_a, angles)
    if len(lower) == len(_GRID):
        axes = (np.linspace(*limit) for limit in zip(lower, upper, _GRID, strict=True))
        angles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    else:
        angles = np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, len(lower)))
    return _largest(b.predict(angles) - a.predict(angles), angles)


def _largest(difference: Array, angles: Array) -> list[tuple[float, Array]]:
    """Return the largest force and torque of differences (..., 6), and the angles (k,) there."""
    worst = []
    for part in (slice(0, 3), slice(3, 6)):
        size = np.linalg.norm(difference[..., part], axis=-1)
        at = np.unravel_index(np.argmax(size), size.shape)
        worst.append((float(size[at]), angles[at]))
    return worst


def three_digits(value: float) -> str:
    """Write a number with three significant digits, or all before its point, and no exponent.

    Args:
        value: in the unit in which it is shown.

    Returns:
        The text.

    """
    if value == 0.0 or not np.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(0, 2 - int(np.floor(np.log10(abs(value)))))}f}"
