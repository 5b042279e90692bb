"""Tools' files as a perfect calibration of the simulated arm would write them."""

import numpy as np
from galen_model.files.calibration_file import (
    CalibrationFile,
    LoadEstimate,
    calibration_path,
    write_calibration,
)
from galen_model.load.nominal_tools import ADAPTER, TOOLS

_COVARIANCE = np.diag([3e-5, 3e-5, 2e-5, 3e-5]) ** 2


def write_perfect_tool(tools_dir, name):
    """Write it and return its path."""
    tool = TOOLS[name]
    file = CalibrationFile(
        tool=name,
        load=LoadEstimate(tool.load.mass_kg, tool.load.com_m, _COVARIANCE),
        adapter=LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, _COVARIANCE),
        tip_m=tool.tip_m,
        rmse=np.array([2e-3, 2e-3, 3e-3, 4e-5, 4e-5, 4e-5]),
        poses_used=56,
        calibrated_at="2026-11-20T09:12:44+00:00",
    )
    path = calibration_path(tools_dir, name)
    write_calibration(path, file)
    return path
