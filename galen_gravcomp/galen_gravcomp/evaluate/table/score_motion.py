"""`score_motion`: inertial forces by an IMU, on tables of a sensor's own."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from galen_bags.arrays.motion_table import read_motion, read_specific
from galen_bags.arrays.orientation_table import read_table
from galen_model.arm.galen import GRAVITY_M_S2, WRENCH_AXES
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    positive,
    run_command,
)
from rich.console import Console
from rich.table import Table

from galen_gravcomp.evaluate.table.motion_table import (
    MotionScore,
    StillTable,
    score_motion,
)

_EPILOG = f"""exit codes:
  {EXIT_OK}    done
  {EXIT_FAILED}    a table can't be used; a line says why
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="score_motion",
        description="Calibrate load and IMU on still poses, take weight and inertial forces off a"
        " run by the IMU, and say what is left beside the weight alone. Columns are named in the"
        " first lines.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, text in (
        ("still", "still poses: fx .. tz, gx gy gz or another orientation, ax ay az"),
        ("wrench", "the run's wrench: t, fx .. tz"),
        ("imu", "the run's IMU: t, ax ay az"),
        ("orientations", "the run's orientation: t, r11 .. r33 or another"),
    ):
        parser.add_argument(f"--{name}", required=True, type=Path, metavar="FILE", help=text)
    parser.add_argument(
        "--time-unit-s",
        type=positive,
        default=1.0,
        metavar="SECONDS",
        help="a unit of the column t (default: %(default)s)",
    )
    parser.add_argument(
        "--imu-unit-m-s2",
        type=positive,
        default=1.0,
        metavar="UNIT",
        help=f"a unit of ax ay az; {-GRAVITY_M_S2[2]} for g (default: %(default)s)",
    )
    parser.add_argument(
        "--bands-hz",
        nargs="+",
        type=positive,
        default=[45.0, 10.0],
        metavar="HZ",
        help="score below these frequencies as well (default: 45 10)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object (SI units)")
    return parser


def run(arguments: argparse.Namespace) -> MotionScore:
    """Read the tables and score; raises GalenError."""
    table = read_table(arguments.still)
    still = StillTable(
        table.gravity, table.wrench, read_specific(arguments.still, arguments.imu_unit_m_s2)
    )
    motion = read_motion(
        arguments.wrench,
        arguments.imu,
        arguments.orientations,
        arguments.time_unit_s,
        arguments.imu_unit_m_s2,
    )
    return score_motion(still, motion, tuple(arguments.bands_hz))


def to_json(score: MotionScore) -> dict[str, object]:
    """Plain numbers, SI units."""
    mount = score.imu.mount
    return {
        "imu": {
            "rotvec_rad": mount.rotvec_rad.tolist(),
            "bias_m_s2": mount.bias_m_s2.tolist(),
            "scale": mount.scale,
            "std_m_s2": score.imu.std_m_s2.tolist(),
        },
        "lag_of_halves_s": list(score.lag_s),
        "rest_s": score.rest_s,
        "rms": {
            "all" if np.isinf(band) else f"below_{band:g}_hz": {
                name: dict(zip(WRENCH_AXES, values.tolist(), strict=True))
                for name, values in models.items()
            }
            for band, models in score.bands.items()
        },
    }


def print_score(score: MotionScore, console: Console) -> None:
    """Tables for a person."""
    mount = score.imu.mount
    for name, values in (
        ("imu_rotvec_rad", mount.rotvec_rad),
        ("imu_bias_m_s2", mount.bias_m_s2),
        ("left over of the still poses, m/s^2", score.imu.std_m_s2),
    ):
        console.print(f"{name}: {' '.join(f'{value:.4f}' for value in values)}")
    first, second = (1e3 * lag for lag in score.lag_s)
    console.print(
        f"imu_scale: {mount.scale:.5f}; the IMU's stamps are {first:.2f} ms (first half), "
        f"{second:.2f} ms (second half) late; each is used on the other"
    )
    table = Table(title="Left over in motion, root mean square, mN and mN.m, tared at rest")
    for name in ("band", "model"):
        table.add_column(name)
    for axis in WRENCH_AXES:
        table.add_column(axis, justify="right")
    for band, models in score.bands.items():
        for name, values in models.items():
            label = "all" if np.isinf(band) else f"< {band:g} Hz"
            table.add_row(label, name, *(f"{1e3 * value:.1f}" for value in values))
    console.print(table)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = build_parser().parse_args(args)

    def work() -> int:
        score = run(arguments)
        if arguments.json:
            print(json.dumps(to_json(score), indent=2))
        else:
            print_score(score, Console(width=None if sys.stdout.isatty() else 120))
        return EXIT_OK

    return run_command("score_motion", work)


if __name__ == "__main__":
    sys.exit(main())
