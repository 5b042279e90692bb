# SPDX-License-Identifier: Apache-2.0
"""Calibration files of tests: of any load, and of the pointer that FakeArm has."""

import numpy as np
from calibration_fake_arm import ADAPTER, POINTER
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile, zeroed_at
from galen_model.load.model import LoadEstimate


def calibrated(load, name="pointer", std=3e-5, **fields):
    """A file of a load that is known to `std` (kg and m): one number or four."""
    covariance = np.diag(np.broadcast_to(std, 4) ** 2)
    known = {
        "tip_m": np.array([0.15, 0.0, 0.05]),
        "rmse": np.array([3e-3, 3e-3, 4e-3, 6e-5, 6e-5, 6e-5]),
        "poses_used": 56,
        "calibrated_at": "2026-01-01T00:00:00+00:00",
        "arm": GALEN,
        "zeroing": zeroed_at(arm=GALEN),
    }
    return CalibrationFile(
        tool=name,
        load=LoadEstimate(load.mass_kg, load.com_m, covariance),
        adapter=LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, covariance),
        **known | fields,
    )


POINTER_FILE = calibrated(POINTER)
