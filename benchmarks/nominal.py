"""The nominal retractor and deflection models that benchmarks work with. No ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from galen_deflection.models.file import write_model
from galen_deflection.models.fitted_range import FittedRange
from galen_deflection.models.hysteresis_basis import COLUMNS, HysteresisBasis, Operator
from galen_deflection.models.joint_stiffness import StiffnessBasis
from galen_deflection.models.linear import Basis, FittedOn, LinearModel
from galen_deflection.springs.springs import kinds
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
    )


def write_bench_tool(tools_dir: Path) -> None:
    """Write its calibration file into a folder of tools."""
    write_calibration(calibration_path(tools_dir, NAME), bench_tool())


def bench_models() -> tuple[LinearModel, LinearModel]:
    """Return springs, and springs with two smooth plays at each.

    Plays as fits to arms with friction come out.
    """
    tip_m = TOOLS[NAME].tip_m
    operators = tuple(
        Operator(place, "smooth_play", (share * load,) * len(COLUMNS[place]))
        for place, load in _LARGEST.items()
        for share in _SHARES
    )
    return (
        _nominal("joint_stiffness", StiffnessBasis(tip_m)),
        _nominal("joint_hysteresis", HysteresisBasis(tip_m, operators)),
    )


def write_bench_models(folder: Path) -> list[Path]:
    """Write a model file of both."""
    paths = []
    for model in bench_models():
        paths.append(folder / f"{model.name}.json")
        write_model(paths[-1], model)
    return paths


def _nominal(kind: str, basis: Basis) -> LinearModel:
    nominal = {kind.name: kind.compliance for kind in kinds()}
    given = [nominal[operator.place] for operator in getattr(basis, "operators", ())]
    values = np.array([*nominal.values(), *(_WEIGHT * compliance for compliance in given)])
    home = np.array([0.0, 0.0, 0.408, 0.0, 0.0])
    push, way = np.full(6, 20.0), np.array([0.1, 0.1, 0.1, 1.5, 1.0])
    return LinearModel(
        name=kind,
        tip_m=TOOLS[NAME].tip_m,
        basis=basis,
        values=values,
        covariance=np.diag((0.01 * values) ** 2),
        discrepancy=np.eye(6) * 1e-12,
        noise=np.full(6, 1e-4),
        fitted_range=FittedRange(-push, push, home - way, home + way),
        fitted_on=FittedOn(1, 1, 1, 1),
    )
