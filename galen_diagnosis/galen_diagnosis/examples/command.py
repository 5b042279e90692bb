"""`python -m galen_diagnosis.examples.command`: the 2019 report's two stories as worked examples.

    drift   figure 12: the reading along z drifts, and compensation is the worse the later it is
    tilt    figure 13: the tilt joint's kinematics are wrong, and compensation errs with the tilt

Each is a recording by the simulated arm with the effect on, its diagnosis, and the story's picture.
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

import numpy as np
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    run_command,
)
from galen_sim_driver.effects.effect import Effect
from galen_sim_driver.effects.joint_effects import JointGain
from galen_sim_driver.effects.sensor_drift import SensorDrift
from rich.console import Console
from tqdm import tqdm

from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.examples.example_picture import draw_story
from galen_diagnosis.examples.simulated_recording import make_recording
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.observation.recording import read_recording
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


if __name__ == "__main__":
    sys.exit(main())
