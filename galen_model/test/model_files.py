# SPDX-License-Identifier: Apache-2.0
"""Calibration files for tests."""

import numpy as np
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile, zeroed_at
from galen_model.load.model import ADAPTER, TOOLS, LoadEstimate

COVARIANCE = np.diag([1e-8, 1e-9, 1e-9, 1e-9])


def calibration(tool: str = "pointer", mass_kg: float = 0.06, **changes) -> CalibrationFile:
    """A pointer's file, of another name, mass or whatever else is given."""
    pointer = TOOLS["pointer"]
    fields = {
        "load": LoadEstimate(mass_kg, pointer.load.com_m, COVARIANCE),
        "adapter": LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, COVARIANCE),
        "tip_m": pointer.tip_m,
        "rmse": np.full(6, 1e-3),
        "poses_used": 56,
        "calibrated_at": "2026-11-21T12:00:00+00:00",
        "arm": GALEN,
        "zeroing": zeroed_at(arm=GALEN),
    }
    return CalibrationFile(tool, **{**fields, **changes})
