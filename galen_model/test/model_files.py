# SPDX-License-Identifier: Apache-2.0
"""Calibration files, an arm of six joints, and a sweep's poses and noise: for tests."""

import json
from pathlib import Path

import numpy as np
from galen_model.arm.description import read_arm
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import CalibrationFile, read_calibration, zeroed_at
from galen_model.load.model import ADAPTER, TOOLS, LoadEstimate

COVARIANCE = np.diag([1e-8, 1e-9, 1e-9, 1e-9])
SIX_AXIS_URDF = (Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf").read_text()
SIX_AXIS = read_arm(SIX_AXIS_URDF)
SIGMA = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4]) / np.sqrt(125)
"""Noise (6,) of a still pose's averaged reading, N and N.m."""


def calibration(tool: str = "pointer", mass_kg: float = 0.06, **changes) -> CalibrationFile:
    """A pointer's file, of another name, mass, arm (zeroed at its home) or whatever else."""
    pointer = TOOLS["pointer"]
    arm = changes.get("arm", GALEN)
    fields = {
        "load": LoadEstimate(mass_kg, pointer.load.com_m, COVARIANCE),
        "adapter": LoadEstimate(ADAPTER.mass_kg, ADAPTER.com_m, COVARIANCE),
        "tip_m": pointer.tip_m,
        "rmse": np.full(6, 1e-3),
        "poses_used": 56,
        "calibrated_at": "2026-11-21T12:00:00+00:00",
        "arm": arm,
        "zeroing": zeroed_at(arm=arm),
    }
    return CalibrationFile(tool, **{**fields, **changes})


def read_content(folder: Path, content: dict, arm=GALEN) -> CalibrationFile:
    """What is read of folder/pointer.json with this content."""
    path = folder / "pointer.json"
    path.write_text(json.dumps(content))
    return read_calibration(path, arm)


def sweep_grid(tilts=7, rolls=8, roll=1.5, tilt=(-1.0, 0.9)):
    """Angles (tilts * rolls, 2) of a sweep, rad; the roll changes fastest."""
    mesh = np.meshgrid(np.linspace(*tilt, tilts), np.linspace(-roll, roll, rolls), indexing="ij")
    return np.column_stack([mesh[1].ravel(), mesh[0].ravel()])
