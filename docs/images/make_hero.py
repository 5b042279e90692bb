#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Make hero.svg: the simulated arm turns a tool, with compensation off and on.

The simulated driver's plant is stepped without ROS, three times through the same turns: without
admittance, following the raw wrench (the sensor zeroed at home with the tool on), and following the
wrench that gravity compensation makes of it by `bags/tools/retractor.json`.

    source scripts/env.sh && python docs/images/make_hero.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from galen_bringup.measurements import TURNS
from galen_common.stream.samples import Rejected
from galen_gravcomp.compensator import Compensator
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import TOOLS
from galen_sim_driver.plant.cell import Plant
from galen_sim_driver.plant.config import PlantConfig
from galen_sim_driver.plant.motion import Trajectory, TrajectoryPoint

HERE = Path(__file__).resolve().parent
TOOL = "retractor"
MOVE_S, HOLD_S = 2.0, 2.0
DURATION_S = len(TURNS) * (MOVE_S + HOLD_S)
RATE_HZ = 500
DRAWN_EVERY = 50
"""Samples per drawn one: 0.1 s."""

WIDTH, HEIGHT = 900, 430
PLOT_X, PLOT_WIDTH, PLOT_HEIGHT = 440, 430, 96
INK, GRID, OFF, ON = "#24292f", "#d0d7de", "#c4432b", "#1f6fb4"
AXES = ("#1f6fb4", "#2a8c55", "#8250a8")


def run(mode: str) -> tuple[Array, Array]:
    """Follow the turns once.

    Args:
        mode: "still" (no admittance), "raw" or "compensated" (what admittance follows).

    Returns:
        Joints (n, 5), m and rad, and the wrench (n, 6) that admittance follows, N and N.m.

    """
    plant = Plant(PlantConfig(rate_hz=RATE_HZ, arm=GALEN), np.random.default_rng(0))
    plant.attach_tool(TOOL)
    compensator = Compensator(arm=GALEN)
    compensator.set_tool(
        read_calibration(HERE.parents[1] / "bags" / "tools" / f"{TOOL}.json", arm=GALEN)
    )
    if mode == "raw":
        zeroing = plant.start_zeroing(0.5)
        while not zeroing.done:
            plant.step()
    rest = [0.0] * len(GALEN.joints)
    points = []
    for turn, angles in enumerate(TURNS):
        target = GALEN.with_angles(angles).tolist()
        start_s = turn * (MOVE_S + HOLD_S)
        points += [
            TrajectoryPoint(start_s + MOVE_S, target, rest, rest),
            TrajectoryPoint(start_s + MOVE_S + HOLD_S, target, rest, rest),
        ]
    plant.command(Trajectory(list(GALEN.joint_names), points))
    plant.set_admittance(mode != "still")
    joints, wrenches = [], []
    for _ in range(round(DURATION_S * RATE_HZ)):
        sample = plant.step()
        wrench = np.array(sample.wrench)
        if mode == "compensated":
            compensator.push_joints(sample.stamp_ns, tuple(sample.positions))
            (result,) = compensator.push_wrench(sample.stamp_ns, wrench)
            if isinstance(result, Rejected):
                raise RuntimeError(f"the wrench was rejected: {result}")
            wrench = result.wrench
        plant.admittance.feed(sample.stamp_ns, wrench.tolist())
        joints.append(sample.positions)
        wrenches.append(wrench)
    return np.array(joints), np.array(wrenches)


def drawn(values: Array) -> Array:
    """Average (n, k) over what is drawn as one sample."""
    return values.reshape(-1, DRAWN_EVERY, values.shape[1]).mean(axis=1)


def path(xy: Array) -> str:
    """Write points (n, 2) as SVG has them."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)


def text(x: float, y: float, words: str, color: str = INK, size: int = 13) -> str:
    """Write some words."""
    return f'<text x="{x}" y="{y}" fill="{color}" font-size="{size}">{words}</text>'


def plot(top: float, title: str, limits: tuple[float, float], curves: Array, colors: tuple) -> str:
    """Plot curves (n, k), uncovered as time goes on."""
    low, high = limits
    x = PLOT_X + np.linspace(0, PLOT_WIDTH, len(curves))
    y = top + PLOT_HEIGHT * (high - curves) / (high - low)
    zero = top + PLOT_HEIGHT * high / (high - low)
    parts = [
        text(PLOT_X, top - 7, title),
        f'<rect x="{PLOT_X}" y="{top}" width="{PLOT_WIDTH}" height="{PLOT_HEIGHT}" fill="none"'
        f' stroke="{GRID}"/>',
        f'<path d="M{PLOT_X} {zero:.1f}h{PLOT_WIDTH}" stroke="{GRID}"/>',
    ]
    parts += [text(PLOT_X - 34, top + 11, f"{high:g}", size=11)]
    parts += [text(PLOT_X - 34, top + PLOT_HEIGHT, f"{low:g}", size=11)]
    for column, color in zip(y.T, colors, strict=True):
        points = path(np.column_stack([x, column]))
        parts.append(
            f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6"'
            ' clip-path="url(#past)"/>'
        )
    return "\n".join(parts)


def tool(joints: Array, color: str, width: float) -> str:
    """Draw the tool from wrist to tip as it moves, joints (n, 5)."""
    corners = []
    tip = np.asarray(TOOLS[TOOL].tip_m)
    for point in (np.zeros(3), tip * [0, 0, 1], tip):
        corners.append(GALEN.tip_pose(joints, point)[1] - GALEN.tip_pose(GALEN.home, tip)[1])
    position = np.stack(corners, axis=1)  # (n, 3 corners, 3)
    right = np.array([0.80, 0.60, 0.0])
    up = np.array([-0.20, 0.26, 0.94])
    xy = np.stack([205 + 650 * position @ right, 215 - 650 * position @ up], axis=2)
    frames = ";".join(path(frame) for frame in xy)
    return (
        f'<polyline points="{path(xy[0])}" fill="none" stroke="{color}" stroke-width="{width}"'
        ' stroke-linecap="round" stroke-linejoin="round">'
        f'<animate attributeName="points" dur="{DURATION_S:g}s" repeatCount="indefinite"'
        f' values="{frames}"/></polyline>'
    )


def main() -> None:
    """Run the simulations, write the picture, print what it shows."""
    reference, _ = run("still")
    off, raw = run("raw")
    on, compensated = run("compensated")
    tip = np.asarray(TOOLS[TOOL].tip_m)
    place = GALEN.tip_pose(reference, tip)[1]
    drift = 1e3 * np.column_stack(
        [np.linalg.norm(GALEN.tip_pose(joints, tip)[1] - place, axis=1) for joints in (off, on)]
    )
    print(f"largest drift: off {drift[:, 0].max():.1f} mm, on {drift[:, 1].max():.2f} mm")
    largest = float(np.ceil(np.abs(raw[:, :3]).max()))
    force = (-largest, largest)
    duration = f'dur="{DURATION_S:g}s" repeatCount="indefinite"'
    picture = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}"'
        ' font-family="sans-serif">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="8" fill="#ffffff"/>',
        f'<clipPath id="past"><rect x="{PLOT_X}" y="0" height="{HEIGHT}" width="{PLOT_WIDTH}">'
        f'<animate attributeName="width" {duration} values="0;{PLOT_WIDTH}"/></rect></clipPath>',
        text(30, 33, "Hand-guided tool, no contact", size=15),
        text(30, 380, "compensation off: follows the tool's own weight", OFF),
        text(30, 400, "compensation on", ON),
        tool(drawn(off), OFF, 7),
        tool(drawn(on), ON, 7),
        plot(40, "raw force, N", force, drawn(raw[:, :3]), AXES),
        *(text(PLOT_X + 90 + 22 * k, 33, f"f{'xyz'[k]}", AXES[k]) for k in range(3)),
        plot(175, "compensated force, N", force, drawn(compensated[:, :3]), AXES),
        plot(
            310, "drift of the tip, mm", (0.0, 50 * np.ceil(drift.max() / 50)), drawn(drift),
            (OFF, ON),
        ),
        text(PLOT_X + PLOT_WIDTH - 64, PLOT_HEIGHT + 328, f"{DURATION_S:g} s, simulated", size=11),
        "</svg>",
    ]  # fmt: skip
    (HERE / "hero.svg").write_text("\n".join(picture) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
