# SPDX-License-Identifier: Apache-2.0
"""Models with hysteresis and without, made by hand: no fit, no file of recordings."""

from dataclasses import replace

import numpy as np
from deflection_synthetic import NOISE, POSITIONS, TIP_M, recording
from galen_deflection.models.interface import FittedRange
from galen_deflection.models.spring_model import Operator, SpringBasis, SpringModel
from galen_model.arm.galen import GALEN

OPERATORS = (
    Operator("roll", "play", (0.4,)),
    Operator("tilt", "play", (0.3,)),
    Operator("carriage", "play", (3.0, 3.0, 3.0)),
)
WEIGHTS = (3e-4, 4e-4, 2e-6)
JOINT_SPREAD = np.array([0.15, 0.15, 0.15, 1.6, 1.1])


def offline(model, wrenches, joints, segment=0):
    """`predict` of samples with these wrenches and joints, the second method for a stream."""
    size = len(wrenches)
    some = recording(rate_hz=1.0, positions=POSITIONS[:1]).rows(np.zeros(size, dtype=int))
    return model.predict(
        replace(
            some,
            segment=np.full(size, segment),
            joints=np.asarray(joints, dtype=float),
            wrench=np.asarray(wrenches, dtype=float),
        )
    )


def made_model(hysteresis=True, tip_m=TIP_M, softer=1.0):
    """The nominal arm, `softer` times as compliant, with plays at its joints if asked for."""
    basis = SpringBasis(np.asarray(tip_m), arm=GALEN)
    values = softer * np.array([parameter.prior for parameter in basis.compliances])
    if hysteresis:
        basis = SpringBasis(np.asarray(tip_m), OPERATORS, arm=GALEN)
        values = np.concatenate([values, WEIGHTS])
    push = np.array([20.0, 20.0, 20.0, 4.0, 4.0, 4.0])
    home = np.array([0.0, 0.0, 0.408, 0.0, 0.0])
    size = len(values)
    return SpringModel(
        "joint_hysteresis" if hysteresis else "joint_stiffness",
        basis,
        values,
        np.diag((0.01 * values) ** 2),
        np.diag(NOISE**2) * 0.01,
        NOISE,
        FittedRange(-push, push, home - JOINT_SPREAD, home + JOINT_SPREAD, arm=GALEN),
        {"samples": size, "segments": 1, "positions": 1, "sets": 1},
    )
