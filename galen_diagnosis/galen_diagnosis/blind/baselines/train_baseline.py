"""Train the network that stands beside the diagnosis in the blind check.

    python -m galen_diagnosis.blind.baselines.train_baseline [--per-class N] [--seed N] [--output
    FILE]

It learns from recordings of the blind plant, made for it: other seeds than any check's, and unknown
causes of the kinds for calibration alone. Needs PyTorch (`make networks`); the check doesn't.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from galen_bags.many.run import run_many
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_ros.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    add_workers,
    run_command,
)
from galen_sim_driver.effects.registry import CONTRACT_ORDER
from tqdm import tqdm

from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.blind.baselines.answers import Rest
from galen_diagnosis.blind.baselines.features import features
from galen_diagnosis.blind.baselines.network import FILE, NEEDS, NetworkError, read_network, train
from galen_diagnosis.blind.baselines.templates import unknown_columns
from galen_diagnosis.blind.plan import CALIBRATION, full_plan
from galen_diagnosis.blind.plant.case import Case, generate
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.recording import read_recording

_SEED = 20_000_003
_EPILOG = f"""An interrupted training goes on where it stopped if --work is given.

exit codes:
  {EXIT_OK}    done
  {EXIT_FAILED}    PyTorch isn't there, or a recording can't be made; a line says why
  {EXIT_USAGE}    wrong arguments
  {EXIT_INTERRUPTED}  interrupted (Ctrl-C)"""


@dataclass(frozen=True)
class Describer:
    """Makes a recording, describes its residual, and removes it again; in any process."""

    cases: dict[str, Case]

    def __call__(self, place: Path) -> None:
        """Leave the features as `<place>.npy`."""
        kept = place.with_suffix(".npy")
        if kept.exists():
            return
        with tempfile.TemporaryDirectory(dir=place.parent) as folder:
            recording = Path(folder) / place.name
            generate(self.cases[place.name], recording, None)
            described = describe(recording)
        unfinished = place.with_suffix(".part.npy")
        np.save(unfinished, described, allow_pickle=False)
        shutil.move(unfinished, kept)


def describe(recording: Path) -> Array:
    """Features of a recording's residual, as the baseline gets them."""
    observation = Observation(read_recording(recording))
    rest = Rest(observation.nominal, unknown_columns(observation))
    return features(observation.rows, rest.residual)


def build_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = argparse.ArgumentParser(
        prog="train_baseline",
        description="Train the blind check's baseline network on recordings made for it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--per-class", type=int, default=6, metavar="N",
        help="recordings of each effect at each strength; others in proportion (default:"
        " %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=int, default=_SEED, metavar="N", help="of recordings and training"
    )
    parser.add_argument(
        "--output", type=Path, default=FILE, metavar="FILE", help="default: the package's own"
    )
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="keep the recordings' features here"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_workers(parser)
    return parser


def run(arguments: argparse.Namespace, work: Path) -> int:
    """Make, describe, train, write; returns the exit code; raises GalenError."""
    plan = [
        one
        for one in full_plan(arguments.seed, arguments.per_class, unknown=CALIBRATION)
        if one.case.kind in (NONE, "single", CALIBRATION)
    ]
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GalenError(f"{work}: can't be made: {error.strerror}") from error
    places = [work.resolve() / one.recording for one in plan]
    describer = Describer({one.recording: one.case for one in plan})
    outcomes = run_many(describer, places, scheduler=arguments.scheduler, workers=arguments.workers)
    for outcome in outcomes:
        if outcome.error is not None:
            raise GalenError(f"a recording couldn't be described: {outcome.error}")
    described = np.stack([np.load(p.with_suffix(".npy"), allow_pickle=False) for p in places])
    answers = [
        one.case.effects[0] if one.case.kind == "single" else
        NONE if one.case.kind == NONE else UNKNOWN
        for one in plan
    ]  # fmt: skip
    with tqdm(unit="iteration", disable=arguments.json or not sys.stderr.isatty()) as bar:
        network, right = train(
            described,
            answers,
            (NONE, *CONTRACT_ORDER, UNKNOWN),
            seed=arguments.seed % 2**31,
            on_progress=lambda done, total: bar.update(done - bar.n),
        )
    network.write(arguments.output)
    read_network(arguments.output)
    if arguments.json:
        print(json.dumps({"recordings": len(plan), "right": right, "file": str(arguments.output)}))
    else:
        print(
            f"{arguments.output}: {len(plan)} recordings; right {100 * right['training']:.0f} % of"
            f" those trained on, {100 * right['held_out']:.0f} % of those held out"
        )
    return EXIT_OK


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = build_parser()
    arguments = parser.parse_args(args)
    if arguments.per_class < 1:
        parser.error("--per-class is at least 1")
    if arguments.seed < 0:
        parser.error("--seed is not negative")

    def work() -> int:
        try:
            import torch  # noqa: F401 - said before an hour of making recordings
        except ImportError as error:
            raise NetworkError(f"the baseline's network {NEEDS}") from error
        if arguments.work is not None:
            return run(arguments, arguments.work)
        with tempfile.TemporaryDirectory(prefix="galen_train_baseline_") as folder:
            return run(arguments, Path(folder))

    return run_command("train_baseline", work)


if __name__ == "__main__":
    sys.exit(main())
