"""The tool that benchmarks work with: the simulator's nominal retractor on its adapter. No ROS."""

from pathlib import Path

import numpy as np
from galen_model.arm.galen import SENSOR
from galen_model.files.calibration_file import (
    CalibrationFile,
    LoadEstimate,
    calibration_path,
    write_calibration,
)
from galen_model.load.model import Load
from galen_model.load.nominal_tools import ADAPTER, TOOLS

NAME = "retractor"


def bench_tool() -> CalibrationFile:
    """Its file's content, without any error of a calibration."""

    def estimate(load: Load) -> LoadEstimate:
        return LoadEstimate(load.mass_kg, load.com_m, np.eye(4) * 1e-8)

    return CalibrationFile(
        tool=NAME,
        load=estimate(TOOLS[NAME].load),
        adapter=estimate(ADAPTER),
        tip_m=TOOLS[NAME].tip_m,
        rmse=SENSOR.noise_std.copy(),
        poses_used=56,
        calibrated_at="2026-01-01T00:00:00+00:00",
    )


def write_bench_tool(tools_dir: Path) -> None:
    """Write it into a folder of tools."""
    write_calibration(calibration_path(tools_dir, NAME), bench_tool())
