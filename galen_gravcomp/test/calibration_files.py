# SPDX-License-Identifier: Apache-2.0
"""Calibration files of tests: one tool on the contract's adapter."""

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile, zeroed_at
from galen_model.load.model import LoadEstimate

POINTER_COM, RETRACTOR_COM = (0.055, 0.002, 0.045), (0.07, -0.01, 0.055)


def tool_file(mass_kg=0.2, com_m=RETRACTOR_COM, name="retractor", std=1e-5, **fields):
    """A file whose load and adapter are known to `std` (kg and m)."""
    covariance = np.eye(4) * std**2
    known = {
        "tip_m": np.array([0.15, 0.0, 0.05]),
        "rmse": np.zeros(6),
        "poses_used": 56,
        "calibrated_at": "2026-01-01T00:00:00+00:00",
        "arm": GALEN,
        "zeroing": zeroed_at(arm=GALEN),
    }
    return CalibrationFile(
        tool=name,
        load=LoadEstimate(mass_kg, np.array(com_m), covariance),
        adapter=LoadEstimate(0.1, np.array([0.0, 0.0, 0.02]), covariance),
        **known | fields,
    )


def pointer(name="pointer", mass_kg=0.06, **fields):
    """The pointer, or a heavier one."""
    return tool_file(mass_kg, POINTER_COM, name, std=1e-4, **fields)
