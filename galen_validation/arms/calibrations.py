# SPDX-License-Identifier: Apache-2.0
"""Calibrations in simulation: each arm through the action, and many of one for the covariance.

The first part runs driver, calibration node and clients as processes, as a user does, faster than
real time. The second draws readings with the sensor's noise and quanta at the poses that the node
would choose, and hands them to the node's own estimate.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from galen_bringup.processes import (
    Processes,
    calibrate,
    executable_path,
    ros_arguments,
    ros_world,
)
from galen_calibration_behavior.calibration.estimate import estimate
from galen_calibration_behavior.common.commands import Measurements
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_model.arm.galen import SENSOR
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.load.model import ADAPTER, TOOLS, gravity_regressor
from galen_model.load.readings import StillPoses
from scipy.stats import binomtest, norm

from galen_validation.arms import ROBOTS, UR5, Robot
from galen_validation.arms.recordings import command, errors, over_noise

TOOL = "retractor"
_SPEED = 4.0
_UNSEEN, _REACH_RAD = 12, 1.0
_RATE_HZ = 500.0
_RUNS = 1000
_PATIENCE_S = 60.0


def through_the_action() -> str:
    """Calibrate each arm by the action in simulation: the section's Markdown."""
    lines = [
        f"The {TOOL} (0.2 kg) on each arm: `sim_driver_node` and `calibration_node` as processes,"
        " `calibrate` as a user calls it, poses chosen by the node around the present one; then"
        f" `check` with {_UNSEEN} other poses, up to {_REACH_RAD:g} rad away, recorded and"
        " evaluated. Seconds are the arm's; the residual is of single readings at rest, of the"
        " worst axis.",
        "",
        "| arm | joints | poses | seconds | error over σ: mass, x, y, z | σ: g, mm, mm, mm"
        " | residual over noise |",
        f"| --- |{' ---: |' * 6}",
    ]
    failed = []
    for number, robot in enumerate(ROBOTS):
        try:
            lines.append(_row(robot, number))
        except GalenError as error:
            failed.append(f"{robot.name}: {error}")
            lines.append(f"| {robot.name} | {len(robot.standing)} |{' failed |' * 5}")
    return "\n".join([*lines, "", *failed]).rstrip()


def _row(robot: Robot, seed: int) -> str:
    own = {"urdf_file": robot.path, "base_frame": robot.base_frame}
    own["sensor_frame"] = robot.sensor_frame
    driver = {"speed_factor": _SPEED, "seed": seed, "start_joints": list(robot.standing)}
    with tempfile.TemporaryDirectory() as name, ros_world():
        folder = Path(name)
        node = {"tools_dir": folder, "use_sim_time": True, "check_reach_rad": _REACH_RAD}
        with Processes(folder / "nodes") as running:
            running.start("galen_sim_driver", "sim_driver_node", ros_arguments(own | driver))
            running.start(
                "galen_calibration_behavior", "calibration_node", ros_arguments(own | node)
            )
            with _recorded(folder / "sweeps"):
                found = calibrate(running, TOOL)
            check = str(executable_path("galen_calibration_behavior", "check"))
            with _recorded(folder / "unseen"):
                done = subprocess.run(
                    [check, TOOL, "--poses", str(_UNSEEN)], stdout=subprocess.DEVNULL, check=False
                )
            if done.returncode:
                raise GalenError(f"the check of {robot.name} ended with code {done.returncode}")
            running.check()
        sweeps, unseen = (
            command(
                "galen_gravcomp.evaluate.command", str(folder / bag), "--tool",
                str(folder / f"{TOOL}.json"), *robot.options,
            )
            for bag in ("sweeps", "unseen")
        )  # fmt: skip
    std = ", ".join(f"{1e3 * v:.3f}" for v in (found["mass_std_kg"], *found["com_std_m"]))
    return (
        f"| {robot.name} | {len(robot.standing)} | {found['poses_used']}"
        f" | {sweeps['duration_s']:.0f} | {errors(found, TOOLS[TOOL].load)} | {std}"
        f" | {over_noise(unseen, 'still').max():.3f} |"
    )


@contextmanager
def _recorded(bag: Path) -> Iterator[None]:
    """Record joints and wrenches to a bag meanwhile."""
    with Processes(bag.parent / f"{bag.name}_log") as recorder:
        topics = ["joint_states", "wrench_raw", "-o", str(bag)]
        simulated = ros_arguments({"use_sim_time": True})
        recorder.start("galen_bags", "record", topics + simulated)
        deadline = time.monotonic() + _PATIENCE_S
        while not list(bag.glob("*.mcap")):
            recorder.check()
            if time.monotonic() > deadline:
                raise GalenError(f"no recording began within {_PATIENCE_S:g} s")
            time.sleep(0.1)
        yield


def coverage() -> str:
    """Count how often intervals of simulated calibrations hold the truth: Markdown."""
    arm = UR5.arm
    settings = replace(CalibrationParameters(), arm=arm).standing_at(np.array(UR5.standing))
    poses = settings.plan(TOOLS[TOOL].tip_m).poses
    errors = np.array([_calibrated(settings, poses, seed) for seed in range(_RUNS)])
    held = np.abs(errors) <= norm.ppf(0.975)
    lines = [
        f"Calibrations of a {UR5.name} with {len(poses)} chosen poses, each averaged for"
        f" {settings.of_sweep().average_s:g} s at {_RATE_HZ:g} Hz, noise and quanta drawn anew; how"
        " many of the 95 % intervals hold the truth, with the 95 % interval of that share.",
        "",
        "| calibrations | mass | x | y | z | all four | error over σ, root mean square |",
        "| ---: | --- | --- | --- | --- | --- | ---: |",
    ]
    for count in (100, _RUNS):
        shares = [_share(held[:count, k]) for k in range(4)] + [_share(held[:count].ravel())]
        rms = np.sqrt(np.mean(errors[:count] ** 2))
        lines.append(f"| {count} | {' | '.join(shares)} | {rms:.3f} |")
    return "\n".join(lines)


def _share(held: Array) -> str:
    found = binomtest(int(held.sum()), len(held)).proportion_ci(method="wilson")
    return f"{100 * held.mean():.1f} % ({100 * found.low:.1f}–{100 * found.high:.1f})"


def _calibrated(settings: CalibrationParameters, poses: Array, seed: int) -> Array:
    """Errors (4,) over their standard deviations of mass and centre."""
    random, arm = np.random.default_rng(seed), settings.arm
    rows = gravity_regressor(arm.gravity_in_sensor(poses))
    zero = gravity_regressor(arm.gravity_in_sensor(settings.home_angles)) @ ADAPTER.moments
    sweeps = []
    for moments in (ADAPTER.moments, ADAPTER.moments + TOOLS[TOOL].load.moments):
        readings = _averaged(random, rows @ moments - zero, settings.of_sweep().average_s)
        sweeps.append(StillPoses(poses, *readings, arm=arm))
    order = list(range(len(poses)))
    measured = Measurements(sweeps[0], sweeps[1], settings.home_angles, order, order, [], [])
    found = estimate(Path("none.json"), TOOL, np.zeros(3), measured, []).content.load
    truth = TOOLS[TOOL].load
    error = np.array([found.mass_kg, *found.com_m]) - [truth.mass_kg, *truth.com_m]
    return np.asarray(error / np.sqrt(np.diag(found.covariance)))


def _averaged(random: np.random.Generator, true: Array, average_s: float) -> tuple[Array, Array]:
    """Means (n, 6) of noisy, quantised readings of true wrenches (n, 6), and their own noise."""
    count = round(average_s * _RATE_HZ)
    noisy = true[:, None] + random.normal(0.0, SENSOR.noise_std, (len(true), count, 6))
    read = SENSOR.quantum * np.round(noisy / SENSOR.quantum)
    return read.mean(axis=1), read.std(axis=1, ddof=1) / np.sqrt(count)
