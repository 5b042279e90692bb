"""What a calibration check answers, and what may be behind readings that do not fit.

A cause (`galen_model.evidence.columns`) explains the rest if, fitted beside load and offset, it
leaves only noise; what all three then make of a compensation, anywhere in the arm's range, decides
whether it matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.evidence import columns
from galen_model.evidence.verdict import Cause, CheckAnswer, Limits
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import gravity_regressor, gravity_wrench


@dataclass(frozen=True)
class CheckLimits(Limits):
    """What a compensation may be off by, anywhere, and how often chance may call a change."""

    false_alarm: float = 0.05


@dataclass(frozen=True)
class Differences:
    """Load and offset that the readings at still poses differ by, all in ft_sensor, SI.

    moments (4,): mass and first moment, true less file's, with covariance (4, 4); offset (6,), its
    std (6,): with no other load where that isn't told, else beside it; rest (n, 6): what neither
    explains; sigma (6,): noise of one pose's mean. rest_p, load_p, offset_p: how often chance alone
    does as much. load_effect, effect (6,): by how much a compensation is off at worst, by the load
    and by all; effect_std (6,): its largest standard deviation.
    """

    moments: Array
    moments_covariance: Array
    offset: Array
    offset_std: Array
    rest: Array
    sigma: Array
    rest_p: float
    load_p: float
    offset_p: float
    load_effect: Array
    effect: Array
    effect_std: Array


@dataclass(frozen=True)
class QuickCheck:
    """What the readings differ by, and in words.

    found_mass_kg, found_offset (6,): the smallest changes that are found beyond noise with 95 %.
    """

    cause: Cause
    text: str
    found: Differences
    poses: int
    found_mass_kg: float
    found_offset: Array

    @property
    def answer(self) -> CheckAnswer:
        """What to do."""
        return self.cause.answer


@dataclass(frozen=True)
class Explanation:
    """A cause beside load and offset: by how much a compensation is off at worst, (6,) each.

    effect: by all three; load_effect: by the load that is then left.
    """

    name: str
    effect: Array
    load_effect: Array


def explain_rest(
    angles: Array,
    residual: Array,
    sigma: Array,
    tool: CalibrationFile,
    anywhere: Array,
    p_noise: float,
) -> tuple[Explanation, ...]:
    """Return the causes that leave only noise of the residual (n, 6), the best first.

    angles (n, k) are in rad, `anywhere` (w, k) those of the arm's range; sigma (6,) is the
    noise, and what is likelier than `p_noise` by chance counts as noise.
    """
    count = len(residual)
    found = []
    here, there = _causes(angles, tool), _causes(anywhere, tool)
    for name in here:
        rows = np.concatenate([load_and_offset(angles, tool), here[name]], axis=2)
        width = rows.shape[2]
        scaled = (rows / sigma[:, None]).reshape(-1, width)
        values = np.linalg.lstsq(scaled, (residual / sigma).ravel(), rcond=1e-9)[0]
        left = (residual - rows @ values) / sigma
        p_value = float(chi2_sf(np.sum(left**2), 6 * count - width))
        if p_value > p_noise:
            known = load_and_offset(anywhere, tool)
            by_all = known @ values[:10] + there[name] @ values[10:]
            explanation = Explanation(
                name,
                np.max(np.abs(by_all), axis=0),
                np.max(np.abs(known[:, :, :4] @ values[:4]), axis=0),
            )
            found.append((p_value, explanation))
    return tuple(explanation for _, explanation in sorted(found, key=lambda one: -one[0]))


def load_and_offset(angles: Array, tool: CalibrationFile) -> Array:
    """Return [G, I] (n, 6, 10) at angles (n, k), rad."""
    return columns.load_and_offset(tool.gravity_in_sensor(angles))


def zero_lost(offset: Array, tool: CalibrationFile, limit: Array) -> str:
    """How the sensor's zero went, if an offset (6,) is just as that would leave it; else empty.

    What the zeroing took for nothing is Z = W(zeroing; adapter) - offset: none if there was no
    zeroing, the adapter's wrench under another direction of gravity if it was elsewhere, that of
    tool and adapter if the tool was on. `limit` (6,): how near.
    """
    if np.all(np.abs(offset) <= 2.0 * limit):
        return ""
    at_zero = tool.gravity_at_zeroing
    zero = gravity_wrench(at_zero, tool.adapter.load) - tool.residual_offset - offset
    if np.all(np.abs(zero) <= limit):
        return "it was not zeroed since it was switched on"
    adapter, own = tool.adapter.load.moments, tool.load.load.moments
    gravity = zero[:3] / np.linalg.norm(zero[:3]) * np.linalg.norm(tool.gravity_m_s2)
    for moments, how in (
        (adapter + own, "it was zeroed with the tool on"),
        (adapter, "it was zeroed in another pose than the file's"),
    ):
        if np.all(np.abs(gravity_regressor(gravity) @ moments - zero) <= limit):
            return how
    return ""


def _causes(angles: Array, tool: CalibrationFile) -> dict[str, Array]:
    """Columns (n, 6, k) of each cause, by its name."""
    gravity = tool.gravity_in_sensor(angles)
    return {
        "a loose tool": columns.loose_tool(gravity, tool.load.mass_kg),
        "a joint's zero that has moved": columns.joint_zeros(angles, tool),
        "a sensor that has turned in its mount": columns.turned_sensor(gravity, tool),
        "a cable that pulls": columns.constant_pull(angles, tool),
    }
