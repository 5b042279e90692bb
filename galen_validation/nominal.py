# SPDX-License-Identifier: Apache-2.0
"""The nominal retractor and deflection models that benchmarks work with. No ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from galen_deflection.models.file import write_model
from galen_deflection.models.interface import FittedRange
from galen_deflection.models.spring_model import Operator, SpringBasis, SpringModel
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.files.calibration_file import (
    CalibrationFile,
    calibration_path,
    write_calibration,
    zeroed_at,
)
from galen_model.load.model import ADAPTER, TOOLS, Load, LoadEstimate

NAME = "retractor"
_SHARES = (0.2, 0.8)
_WEIGHT = 0.1  # of each play, over its spring's own compliance
_LARGEST = {"roll": 1.5, "tilt": 1.5, "carriage": 15.0, "rod": 60.0}  # N.m, N


def bench_tool() -> CalibrationFile:
    """Return the retractor's calibration, without any error of it."""

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
        arm=GALEN,
        zeroing=zeroed_at(arm=GALEN),
    )


def write_bench_tool(tools_dir: Path) -> None:
    """Write the retractor's calibration file.

    Args:
        tools_dir: Existing folder of tools.

    """
    write_calibration(calibration_path(tools_dir, NAME), bench_tool())


def bench_models() -> tuple[SpringModel, SpringModel]:
    """Return springs, and springs with two smooth plays at each.

    Plays as fits to arms with friction come out.
    """
    tip_m = TOOLS[NAME].tip_m
    springs = SpringBasis(tip_m, arm=GALEN)
    operators = tuple(
        Operator(place, "smooth_play", (share * load,) * len(springs.columns[place]))
        for place, load in _LARGEST.items()
        for share in _SHARES
    )
    return (
        _nominal("joint_stiffness", springs),
        _nominal("joint_hysteresis", SpringBasis(tip_m, operators, arm=GALEN)),
    )


def write_bench_models(folder: Path) -> list[Path]:
    """Write a model file of both.

    Args:
        folder: Existing folder.

    Returns:
        Files of the springs, and of the springs with plays.

    """
    paths = []
    for model in bench_models():
        paths.append(folder / f"{model.name}.json")
        write_model(paths[-1], model)
    return paths


def _nominal(kind: str, basis: SpringBasis) -> SpringModel:
    nominal = {kind.name: kind.compliance for kind in basis.kinds}
    given = [nominal[operator.place] for operator in basis.operators]
    values = np.array([*nominal.values(), *(_WEIGHT * compliance for compliance in given)])
    home = np.array([0.0, 0.0, 0.408, 0.0, 0.0])
    push, way = np.full(6, 20.0), np.array([0.1, 0.1, 0.1, 1.5, 1.0])
    return SpringModel(
        name=kind,
        basis=basis,
        values=values,
        covariance=np.diag((0.01 * values) ** 2),
        discrepancy=np.eye(6) * 1e-12,
        noise=np.full(6, 1e-4),
        fitted_range=FittedRange(-push, push, home - way, home + way, arm=GALEN),
        fitted_on={"samples": 1, "segments": 1, "positions": 1, "sets": 1},
    )
