"""Propose the poses that are worth most for a load, beside the grid's. Moves nothing."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from galen_model.arm.clearance import ObstacleError
from galen_model.arrays import Array
from galen_model.poses.design import compensation_std, reading_noise
from galen_model.poses.order import drift_share
from galen_model.poses.plan import plan_as_is

from galen_calibration_behavior.parameters import CalibrationParameters

_RATE_HZ = 500.0  # the contract's, of wrench_raw


def propose_poses(options: argparse.Namespace) -> dict[str, Any]:
    """Choose as the options say, print it unless as JSON; raises GalenError."""
    parameters = replace(options.parameters, poses="chosen")
    parameters.validate()
    tip = np.array(options.tip or [0.0, 0.0, 0.0])
    poses = parameters.plan(tip, one_sweep=options.one_sweep).poses
    grid = parameters.grid_poses(parameters.itersT, parameters.itersR)
    try:
        plan_as_is(grid, parameters.range, parameters.surroundings, tip)
        grid_fault = ""
    except ObstacleError as error:
        grid_fault = str(error)
    promises = {
        "grid": _promise(grid, replace(parameters, poses="grid")),
        "chosen": _promise(poses, parameters),
    }
    if not options.json:
        print(f"{_format_poses(poses, parameters)}\n\n{_format_promises(promises)}")
        if grid_fault:
            print(f"The grid can't be swept: {grid_fault}.")
    return {
        "poses": poses.tolist(),
        "grid": grid.tolist(),
        "grid_fault": grid_fault,
        "promises": promises,
    }


def _promise(poses: Array, parameters: CalibrationParameters) -> dict[str, float]:
    """Return what poses (n, 2), rad, in visiting order make of the compensation, by theory; SI.

    The standard deviations are the root mean square over workspace and three axes, the sensor's
    noise taken as white; drift_share: how far a linear drift looks like load, 0 to 1.
    """
    times, average_s = parameters.times(), parameters.of_sweep().average_s
    std = compensation_std(poses, reading_noise() / np.sqrt(average_s * _RATE_HZ))
    return {
        "poses": len(poses),
        "average_s": average_s,
        "sweep_s": times.sweep_s(poses),
        "force_std_n": float(np.sqrt(np.mean(std[:3] ** 2))),
        "torque_std_nm": float(np.sqrt(np.mean(std[3:] ** 2))),
        "drift_share": drift_share(poses, times.at_s(poses)),
    }


def _format_poses(poses: Array, parameters: CalibrationParameters) -> str:
    times = parameters.times()
    heads = "".join(f"{name + ' [rad]':>12}" for name in parameters.arm.turning_names)
    lines = [f"{'pose':>4}{heads}{'from [s]':>10}"]
    starts = times.at_s(poses) - times.stay_s
    for index, (angles, start) in enumerate(zip(poses, starts, strict=True)):
        lines.append(f"{index:4}{''.join(f'{angle:12.4f}' for angle in angles)}{start:10.1f}")
    return "\n".join(lines)


def _format_promises(rows: dict[str, dict[str, float]]) -> str:
    lines = [
        f"{'':10}{'poses':>6}{'average':>9}{'sweep':>8}{'error of compensation':>26}{'drift':>7}",
        f"{'':10}{'':>6}{'[s]':>9}{'[s]':>8}{'force [mN]':>12}{'torque [mN.m]':>14}{'R^2':>7}",
    ]
    lines += [
        f"{name:10}{row['poses']:6}{row['average_s']:9.2f}{row['sweep_s']:8.1f}"
        f"{row['force_std_n'] * 1e3:12.3f}{row['torque_std_nm'] * 1e3:14.4f}"
        f"{row['drift_share']:7.3f}"
        for name, row in rows.items()
    ]
    return "\n".join(lines)
