"""Make an example recording, diagnose it and draw its story.

`python -m galen_diagnosis.examples.command`: the 2019 report's two stories as worked examples.

    drift   figure 12: the reading along z drifts, and compensation is the worse the later it is
    tilt    figure 13: the tilt joint's kinematics are wrong, and compensation errs with the tilt

Each is a recording by the simulated arm with the effect on, its diagnosis, and the story's picture.

The picture of a worked example: what gravity compensation leaves in the sweep's still poses.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arm.galen import JOINT_NAMES, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    run_command,
)
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.joints import JointGain
from galen_sim_driver.effects.sensor import SensorDrift
from rich.console import Console
from tqdm import tqdm

from galen_diagnosis.answer.answer import Diagnosis
from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.examples.simulated_recording import make_recording
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import read_recording
from galen_diagnosis.observation.rows import BAGS, CHANNELS
from galen_diagnosis.report.output import told, write_output
from galen_diagnosis.report.terminal import print_answer

_EPILOG = f"""written to the output directory, whole or not at all:
  recording/   the three bags, tool.json and, as this one's cause is known, truth.json
  diagnosis/   what `ros2 run galen_diagnosis diagnose` writes: diagnosis.json, report.html, ...
  <story>.png  compensation's error in the sweep, before and after

exit codes:
  {EXIT_OK}    done
  {EXIT_FAILED}    the directory is there already, or can't be written
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""


@dataclass(frozen=True)
class Story:
    """What a story's arm has, and what its picture is drawn over."""

    effect: Effect
    seed: int
    over: str
    title: str


def _bias_drift() -> SensorDrift:
    """Along z by 0.24 N in the recording's five minutes, not evenly; a little along x."""
    knots_s = np.linspace(0.0, 312.0, 7)
    levels = np.zeros((len(knots_s), 6))
    levels[:, 2] = [0.0, 0.06, 0.14, 0.12, 0.17, 0.20, 0.24]
    levels[:, 0] = [0.0, 0.004, 0.01, 0.012, 0.012, 0.016, 0.02]
    return SensorDrift.through(knots_s, levels)


STORIES = {
    "drift": Story(_bias_drift(), 12, "time", "the sensor's z axis drifts (report, figure 12)"),
    "tilt": Story(
        JointGain("tilt", 0.02),
        13,
        "tilt",
        "the tilt joint's kinematics are wrong (report, figure 13)",
    ),
}


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="python -m galen_diagnosis.examples.command",
        description="Make a recording that shows one of the report's two stories, and diagnose it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("story", choices=STORIES, help="drift: figure 12; tilt: figure 13")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="make this")
    parser.add_argument("--seed", type=int, help="of noise and motion (default: the story's own)")
    return parser


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Make recording, diagnosis and picture; returns the exit code; raises GalenError."""
    story, target = STORIES[arguments.story], arguments.output
    if target.exists() or target.is_symlink():
        raise DiagnosisError(f"{target}: is there already, and is not written over")
    seed = story.seed if arguments.seed is None else arguments.seed
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    except OSError as error:
        raise DiagnosisError(f"{target}: can't be made: {error.strerror}") from error
    try:
        # Nothing where standard error is no terminal, and never left behind an error message.
        bar_format = "{percentage:3.0f}% |{bar}| {elapsed} {desc}"
        with tqdm(total=1.0, bar_format=bar_format, ncols=80, disable=None, leave=False) as bar:
            make_recording(
                work / "recording",
                [story.effect],
                seed,
                truth=True,
                progress=lambda name: _show(bar, f"recording {name}", bar.n + 0.05),
            )
            diagnosis = diagnose_recording(
                read_recording(work / "recording"),
                progress=lambda stage, share: _show(bar, stage, 0.2 + 0.7 * share),
            )
            diagnosis = told(diagnosis)
            _show(bar, "writing", 0.9)
            write_output(diagnosis, work / "diagnosis", with_report=True, overwrite=False)
            draw_story(diagnosis, story.over, story.title, work / f"{arguments.story}.png")
        work.chmod(0o755)  # mkdtemp's are the owner's alone
        os.replace(work, target)
    except OSError as error:
        raise DiagnosisError(f"{target}: can't be written: {error.strerror}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    print_answer(diagnosis.answer, console)
    console.print(f"written: {target}", soft_wrap=True, markup=False)
    return EXIT_OK


def _show(bar: tqdm, stage: str, share: float) -> None:
    bar.n = max(bar.n, min(share, 1.0))
    bar.set_description_str(stage)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = build_parser().parse_args(args)
    console = Console(width=None if sys.stdout.isatty() else 120)
    return run_command("examples", partial(run, arguments, console))


_COLOURS = ("#0072b2", "#e69f00", "#009e73")
_TILT = JOINT_NAMES.index("tilt")


def draw_story(diagnosis: Diagnosis, over: str, title: str, path: Path) -> Path:
    """Write the picture: forces above, torques below; before on the left, after on the right.

    over: "time" (since the recording's start) or "tilt". A point is what is left of the reading of
    one still pose, less its mean over all poses, for the sensor's zero is none of a compensation's
    errors. After: with the effect that was found in the simulator. Raises DiagnosisError without a
    sweep.
    """
    poses = _poses(diagnosis)
    if not len(poses):
        raise DiagnosisError("a story's picture needs the still poses of a sweep")
    figure, grid = plt.subplots(2, 2, figsize=(10, 5.2), sharex=True, sharey="row")
    for row, (group, axes, factor, unit) in enumerate(
        (("force", slice(0, 3), 1e3, "mN"), ("torque", slice(3, 6), 1e3, "mN.m"))
    ):
        for column, (state, residual) in enumerate(
            (("before", diagnosis.before), ("after", diagnosis.after))
        ):
            axis = grid[row, column]
            for colour, channel in zip(_COLOURS, range(6)[axes], strict=True):
                where, error = _pose_means(diagnosis, residual, poses, channel, over)
                axis.plot(
                    where,
                    (error - error.mean()) * factor,
                    ".",
                    color=colour,
                    ms=5,
                    label=WRENCH_AXES[channel],
                )
            axis.axhline(0.0, color="black", lw=0.6)
            if row == 0:
                axis.set_title(f"{state}", loc="left", fontsize=10)
        grid[row, 0].set_ylabel(f"error of {group}, {unit}")
        grid[row, 0].legend(loc="best", ncol=3, frameon=False, fontsize=8)
    for axis in grid[-1]:
        axis.set_xlabel("time of the recording, s" if over == "time" else "tilt as reported, rad")
    figure.suptitle(f"Gravity compensation where {title}", fontsize=11)
    figure.tight_layout()
    return save_figure(figure, path)


def _poses(diagnosis: Diagnosis) -> np.ndarray:
    rows = diagnosis.rows
    return np.unique(rows.pose[(rows.bag == BAGS.index("sweep")) & (rows.pose >= 0)])


def _pose_means(
    diagnosis: Diagnosis, residual: Array, poses: np.ndarray, channel: int, over: str
) -> tuple[Array, Array]:
    """Time (s) or tilt (rad), and the mean residual in N or N.m, of each pose that has the axis."""
    rows = diagnosis.rows
    mine = (rows.bag == BAGS.index("sweep")) & (
        rows.channel == CHANNELS.index(WRENCH_AXES[channel])
    )
    where, error = [], []
    for pose in poses:
        here = mine & (rows.pose == pose)
        if here.any():
            value = rows.session_s if over == "time" else rows.joints[:, _TILT]
            where.append(value[here].mean())
            # A row's weight is its number of samples: scale is that of its mean.
            weight = rows.samples[here]
            error.append(np.average((residual * rows.scale)[here], weights=weight))
    return np.array(where), np.array(error)


if __name__ == "__main__":
    sys.exit(main())
