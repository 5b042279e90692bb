"""What chosen poses promise beside the grid's: precision, time, drift, and how many are as good."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arm.kinematics import gravity_in_sensor
from galen_model.arrays import Array
from galen_model.load.identification import single_load_design
from galen_model.poses.design import PoseDesign, compensation_std, reading_noise
from galen_model.poses.order import SweepTimes, drift_share

# A centre of mass can only be told for a tool of some mass.
EXAMPLE_TOOL_KG = 0.1


@dataclass(frozen=True)
class Promise:
    """What a sweep's poses make of the load, by theory; standard deviations, SI units.

    force_std_n, torque_std_nm: of the compensation's error, root mean square over the workspace
    and three axes. mass_std_kg, moment_std_kgm: of the tool after two sweeps, the moment along its
    worst axis. loss: the worst growth of the error's standard deviation when one pose is lost.
    drift_share: how far a linear drift looks like load, 0 to 1. sweep_s: one sweep, home to home.
    """

    poses: int
    average_s: float
    sweep_s: float
    force_std_n: float
    torque_std_nm: float
    mass_std_kg: float
    moment_std_kgm: float
    loss: float
    drift_share: float


def promise(poses: Array, times: SweepTimes, average_s: float, rate_hz: float) -> Promise:
    """Of poses (n, 2), rad, in visiting order, averaged for `average_s` at `rate_hz`.

    The sensor's noise is that of `galen_model.arm.galen.SENSOR`, taken as white.
    """
    sigma = reading_noise() / np.sqrt(average_s * rate_hz)
    std = compensation_std(poses, sigma)
    rows = single_load_design(gravity_in_sensor(poses[:, 0], poses[:, 1])) / sigma[:, None]
    covariance = np.linalg.inv(np.einsum("nkp,nkq->pq", rows, rows))
    moments = 2.0 * covariance[1:4, 1:4]  # the tool's: both sweeps' sum, as they are independent
    without = [
        np.linalg.norm(compensation_std(np.delete(poses, k, axis=0), sigma) / std) / np.sqrt(6.0)
        for k in range(len(poses))
    ]
    return Promise(
        poses=len(poses),
        average_s=average_s,
        sweep_s=times.sweep_s(poses),
        force_std_n=_rms(std[:3]),
        torque_std_nm=_rms(std[3:]),
        mass_std_kg=float(np.sqrt(2.0 * covariance[0, 0])),
        moment_std_kgm=float(np.sqrt(np.linalg.eigvalsh(moments)[-1])),
        loss=float(max(without)),
        drift_share=drift_share(poses, times.at_s(poses)),
    )


@dataclass(frozen=True)
class Efficiency:
    """n chosen poses against the best that any n could be: best (phi of the bound) over theirs.

    grid_ratio: standard deviation over that of the grid's poses, all averaged equally long.
    """

    poses: int
    efficiency: float
    grid_ratio: float


def efficiency_curve(
    design: PoseDesign,
    grid: Array,
    counts: Sequence[int],
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> list[Efficiency]:
    """For each count; `progress` wraps the counts while they are worked through."""
    of_grid = design.value(grid)
    curve = []
    for count in progress(counts):
        value = design.value(design.candidates[design.choose(count)])
        bound = design.lower_bound(count)
        curve.append(Efficiency(count, bound / value, float(np.sqrt(value / of_grid))))
    return curve


def equal_count(design: PoseDesign, grid: Array) -> int | None:
    """The fewest chosen poses as good as the grid's, averaged equally long; None if more than it.

    The bound says below which count none can be.
    """
    of_grid = design.value(grid)
    first = max(int(np.floor(design.lower_bound(len(grid)) * len(grid) / of_grid)), 4)
    chosen: list[int] = []
    for count in range(first, min(len(grid), len(design.candidates)) + 1):
        chosen = design.choose(count, chosen)
        if design.value(design.candidates[chosen]) <= of_grid:
            return count
    return None


def format_poses(poses: Array, times: SweepTimes) -> str:
    """The poses as a table in visiting order; angles in rad and degrees."""
    lines = [f"{'pose':>4}{'roll [rad]':>12}{'tilt [rad]':>12}{'roll [deg]':>12}{'tilt [deg]':>12}"
             f"{'from [s]':>10}"]  # fmt: skip
    starts = times.at_s(poses) - times.stay_s
    for index, ((roll, tilt), start) in enumerate(zip(poses, starts, strict=True)):
        lines.append(
            f"{index:4}{roll:12.4f}{tilt:12.4f}{np.degrees(roll):12.1f}{np.degrees(tilt):12.1f}"
            f"{start:10.1f}"
        )
    return "\n".join(lines)


def format_promises(rows: dict[str, Promise]) -> str:
    """One line a kind of sweep."""
    lines = [
        f"{'':10}{'poses':>6}{'average':>9}{'sweep':>8}{'error of compensation':>26}"
        f"{'tool mass':>11}{'centre of':>12}{'one pose':>10}{'drift':>7}",
        f"{'':10}{'':>6}{'[s]':>9}{'[s]':>8}{'force [mN]':>12}{'torque [mN.m]':>14}{'[g]':>11}"
        f"{'100 g [mm]':>12}{'lost':>10}{'R^2':>7}",
    ]
    for name, row in rows.items():
        centre_mm = row.moment_std_kgm / EXAMPLE_TOOL_KG * 1e3
        lines.append(
            f"{name:10}{row.poses:6}{row.average_s:9.2f}{row.sweep_s:8.1f}"
            f"{row.force_std_n * 1e3:12.3f}{row.torque_std_nm * 1e3:14.4f}"
            f"{row.mass_std_kg * 1e3:11.4f}{centre_mm:12.4f}{'x ' + format(row.loss, '.2f'):>10}"
            f"{row.drift_share:7.3f}"
        )
    return "\n".join(lines)


def format_curve(curve: Sequence[Efficiency]) -> str:
    """One line a number of poses."""
    lines = [f"{'poses':>5}{'of the best possible':>22}{'std over the grid' + chr(39) + 's':>22}"]
    lines += [f"{row.poses:5}{100 * row.efficiency:20.1f} %{row.grid_ratio:22.3f}" for row in curve]
    return "\n".join(lines)


def to_dict(value: Any) -> dict[str, Any]:
    """A Promise or an Efficiency for JSON."""
    return dict(vars(value))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
