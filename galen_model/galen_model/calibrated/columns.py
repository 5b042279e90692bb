# SPDX-License-Identifier: Apache-2.0
"""How each cause changes the reading of an untouched arm, to first order.

With u gravity in the sensor and W = (f, tau) the reading of tool and adapter, a cause adds X w:

    another load           G(u) d      d: mass and first moment, true less file's       (4)
    an offset              b           of the sensor's zero                             (6)
    a drift                t c         t: hours                                         (6)
    a loose tool           tau = s m (a x u), a the x and y parts of u / |u|, s: shift  (1)
    joints' zeros          dW/dq_k                                                      (k)
    a turned sensor        -phi x f, -phi x tau, phi its rotation vector                (3)
    a constant pull        R^T F at the tool's tip, F in the base, as of a cable        (3)
"""

from __future__ import annotations

import numpy as np

from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import LoadEstimate, gravity_wrench
from galen_model.rotation import skew

_STEP_RAD = 1e-4
_KNOWN_AT_BEST = np.array([1e-4, 1e-5, 1e-5, 1e-5])
"""kg and kg.m: no calibration tells a load better than that."""


def drift(hours: Array) -> Array:
    """Compute the columns of a drift, t I.

    Args:
        hours: t (n,), h.

    Returns:
        (n, 6, 6), by N/h and N.m/h.

    """
    return np.asarray(hours[:, None, None] * np.eye(6))


def loose_tool(gravity: Array, mass_kg: float) -> Array:
    """Compute the columns of a shift of a tool's centre.

    Args:
        gravity: (n, 3) in the sensor's frame, m/s^2.
        mass_kg: the tool's.

    Returns:
        (n, 6, 1), by a metre.

    """
    aside = gravity / np.linalg.norm(gravity, axis=1, keepdims=True) * np.array([1.0, 1.0, 0.0])
    columns = np.zeros((len(gravity), 6, 1))
    columns[:, 3:, 0] = np.cross(aside, gravity) * mass_kg
    return columns


def turned_sensor(gravity: Array, tool: CalibrationFile) -> Array:
    """Compute the columns of a rotation of the sensing element.

    Args:
        gravity: (n, 3) in the sensor's frame, m/s^2.
        tool: whose tool and adapter hang on the sensor.

    Returns:
        (n, 6, 3), by a radian about each of the sensor's axes.

    """
    loads = gravity_wrench(gravity, tool.load.load) + gravity_wrench(gravity, tool.adapter.load)
    return np.concatenate([skew(loads[:, :3]), skew(loads[:, 3:])], axis=1)


def joint_zeros(angles: Array, tool: CalibrationFile) -> Array:
    """Compute the columns of the joints' zeros, by central differences.

    Args:
        angles: reported (n, k), rad.
        tool: the file that predicts the readings.

    Returns:
        (n, 6, k), by a radian.

    """
    columns = []
    for step in _STEP_RAD * np.eye(angles.shape[1]):
        ahead, behind = tool.predict(angles + step), tool.predict(angles - step)
        columns.append((ahead - behind) / (2.0 * _STEP_RAD))
    return np.stack(columns, axis=2)


def constant_pull(angles: Array, tool: CalibrationFile) -> Array:
    """Compute the columns of a pull at the tip that is constant in the base.

    Args:
        angles: (n, k), rad.
        tool: with arm and tip.

    Returns:
        (n, 6, 3), by a newton along each of the base's axes.

    """
    to_sensor = np.swapaxes(tool.arm.rotation(angles), 1, 2)
    return np.concatenate([to_sensor, skew(tool.tip_m) @ to_sensor], axis=1)


def moment_covariance(estimate: LoadEstimate, known_at_best: Array = _KNOWN_AT_BEST) -> Array:
    """Convert the covariance of (m, p) to that of (m, h), h = m p.

    Args:
        estimate: mass and centre, with their covariance.
        known_at_best: least standard deviations (4,), kg and kg.m.

    Returns:
        (4, 4), kg and kg.m.

    """
    change = np.eye(4) * estimate.mass_kg
    change[0, 0] = 1.0
    change[1:, 0] = estimate.com_m
    return np.asarray(change @ estimate.covariance @ change.T + np.diag(known_at_best**2))
