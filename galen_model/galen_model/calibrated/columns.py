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
    """Return t I (n, 6, 6) for times (n,)."""
    return np.asarray(hours[:, None, None] * np.eye(6))


def loose_tool(gravity: Array, mass_kg: float) -> Array:
    """Return (n, 6, 1), by a metre of shift of a tool's centre, for gravity (n, 3)."""
    aside = gravity / np.linalg.norm(gravity, axis=1, keepdims=True) * np.array([1.0, 1.0, 0.0])
    columns = np.zeros((len(gravity), 6, 1))
    columns[:, 3:, 0] = np.cross(aside, gravity) * mass_kg
    return columns


def turned_sensor(gravity: Array, tool: CalibrationFile) -> Array:
    """Return (n, 6, 3) by a radian, for gravity (n, 3)."""
    loads = gravity_wrench(gravity, tool.load.load) + gravity_wrench(gravity, tool.adapter.load)
    return np.concatenate([skew(loads[:, :3]), skew(loads[:, 3:])], axis=1)


def joint_zeros(angles: Array, tool: CalibrationFile) -> Array:
    """Return (n, 6, k) by a radian, at angles (n, k) in rad."""
    columns = []
    for step in _STEP_RAD * np.eye(angles.shape[1]):
        ahead, behind = tool.predict(angles + step), tool.predict(angles - step)
        columns.append((ahead - behind) / (2.0 * _STEP_RAD))
    return np.stack(columns, axis=2)


def constant_pull(angles: Array, tool: CalibrationFile) -> Array:
    """Return (n, 6, 3) by a newton at the tip, at angles (n, k) in rad."""
    to_sensor = np.swapaxes(tool.arm.rotation(angles), 1, 2)
    return np.concatenate([to_sensor, skew(tool.tip_m) @ to_sensor], axis=1)


def moment_covariance(estimate: LoadEstimate, known_at_best: Array = _KNOWN_AT_BEST) -> Array:
    """Return the covariance (4, 4) of (m, h), h = m p, from that of (m, p).

    `known_at_best` (4,): least standard deviations, kg and kg.m.
    """
    change = np.eye(4) * estimate.mass_kg
    change[0, 0] = 1.0
    change[1:, 0] = estimate.com_m
    return np.asarray(change @ estimate.covariance @ change.T + np.diag(known_at_best**2))
