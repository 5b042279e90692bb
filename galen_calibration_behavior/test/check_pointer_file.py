# SPDX-License-Identifier: Apache-2.0
"""The pointer's file as a calibration on FakeArm leaves it, for the tests of the check."""

import numpy as np
from calibration_fake_arm import ADAPTER, POINTER
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile, zeroed_at
from galen_model.load.model import LoadEstimate

_STD = np.diag(np.full(4, 3e-5) ** 2)
POINTER_FILE = CalibrationFile(
    tool="pointer",
    load=LoadEstimate(POINTER.mass_kg, POINTER.com_m, _STD),
    adapter=LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, _STD),
    tip_m=np.array([0.15, 0.0, 0.05]),
    rmse=np.array([3e-3, 3e-3, 4e-3, 6e-5, 6e-5, 6e-5]),
    poses_used=56,
    calibrated_at="2026-01-01T00:00:00+00:00",
    arm=GALEN,
    zeroing=zeroed_at(arm=GALEN),
)
