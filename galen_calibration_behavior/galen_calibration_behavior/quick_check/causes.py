"""What may be behind readings that no other load and no offset explains, or behind an offset.

Each cause moves the reading W = (f, tau) of tool and adapter at pose k, to first order, by J_k x
with a few unknowns x:

    a loose tool        tau = s m (a x u), a the x and y parts of u / |u|, s the shift    (1)
    joints' zeros       dW/droll, dW/dtilt                                                (2)
    a turned sensor     -phi x f, -phi x tau, phi its rotation vector                     (3)
    a constant pull     R^T F at the tool's tip, F in base_link, as of a cable            (3)

A cause explains the rest if, fitted beside load and offset, it leaves only noise; what all three
then make of a compensation, anywhere in the arm's range, tells whether it matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arm.kinematics import sensor_rotation
from galen_model.arrays import Array
from galen_model.distributions import chi2_sf
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import gravity_regressor, gravity_wrench
from galen_model.rotation import skew

_STEP_RAD = 1e-4


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
    """The causes that leave only noise of the residual (n, 6) at angles (n, 2), the best first.

    Angles are roll and tilt in rad, `anywhere` (w, 2) those of the arm's range; sigma (6,) is the
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
    """X = [G, I] (n, 6, 10) at roll and tilt (n, 2), rad."""
    regressor = gravity_regressor(tool.gravity_in_sensor(angles[:, 0], angles[:, 1]))
    return np.concatenate([regressor, np.broadcast_to(np.eye(6), (len(angles), 6, 6))], axis=2)


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
    """J (n, 6, x) of each cause, by its name."""
    roll, tilt = angles[:, 0], angles[:, 1]
    gravity = tool.gravity_in_sensor(roll, tilt)
    count = len(gravity)
    aside = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    aside[:, 2] = 0.0
    loose = np.zeros((count, 6, 1))
    loose[:, 3:, 0] = tool.load.mass_kg * np.cross(aside, gravity)

    loads = gravity_wrench(gravity, tool.load.load) + gravity_wrench(gravity, tool.adapter.load)
    turned = np.concatenate([skew(loads[:, :3]), skew(loads[:, 3:])], axis=1)

    zeros = []
    for roll_step, tilt_step in ((_STEP_RAD, 0.0), (0.0, _STEP_RAD)):
        ahead = tool.predict(roll + roll_step, tilt + tilt_step)
        behind = tool.predict(roll - roll_step, tilt - tilt_step)
        zeros.append((ahead - behind) / (2.0 * _STEP_RAD))

    to_sensor = np.swapaxes(sensor_rotation(roll, tilt), 1, 2)
    pull = np.concatenate([to_sensor, skew(tool.tip_m) @ to_sensor], axis=1)
    return {
        "a loose tool": loose,
        "a joint's zero that has moved": np.stack(zeros, axis=2),
        "a sensor that has turned in its mount": turned,
        "a cable that pulls": pull,
    }
