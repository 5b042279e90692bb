# SPDX-License-Identifier: Apache-2.0
"""Calibrates the few numbers of the evidence on simulated recordings with known causes.

    OMP_NUM_THREADS=1 python -m galen_validation.calibrate_diagnosis CASES [--per-class N] [--write]

makes recordings by the blind check's arms, with a seed and unknown kinds that it never uses,
explores each (CASES keeps what came out, so that a run can be taken up again), and fits the
settings of `posterior.py` to the largest mean log probability of what was there, every kind of case
counting the same, with a prior about the settings' defaults. Half of the sessions are fitted, the
other half tells whether that holds.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from galen_bags.many import run_many
from galen_common.command import EXIT_OK, run_command
from galen_diagnosis.answer.answer import NONE, UNKNOWN
from galen_diagnosis.inference.diagnosing import explore, within_limits
from galen_diagnosis.inference.posterior import (
    Probabilities,
    Scored,
    Settings,
    load_settings,
    posterior,
)
from galen_diagnosis.observation.recording import read_recording
from galen_model.errors import GalenError
from galen_model.files.atomic_file import write_whole
from scipy.optimize import minimize

from galen_diagnosis import inference
from galen_validation.blind.blind_protocol import full_plan
from galen_validation.blind.case import SINCE, Case, generate
from galen_validation.blind.diagnosing import specified
from galen_validation.blind.score import matched
from galen_validation.blind.unlisted import CALIBRATION_UNKNOWN

_SEED = 7_000_000
"""Of calibration's cases."""
_HEALTHY = 20

_FAINT = 0.5
_LEAST = 1e-3
"""A single case costs no more than this probability: the plant itself may be odd, too."""

_SPREAD = (0.3, 0.5, 0.5, 0.5, 0.4)
"""Prior of the settings' logarithms about where they start."""


@dataclass(frozen=True)
class Known:
    """A calibration case: what was there and what the search made of it.

    acceptable: for each cause the names that the recording can't separate from it. causes: of each
    of `scored` the effects that lie beyond their limits.
    """

    kind: str
    strength: str
    acceptable: tuple[frozenset[str], ...]
    scored: tuple[Scored, ...]
    causes: tuple[frozenset[str], ...]

    def chance(self, of: Probabilities) -> float:
        """Return the probability of what was there: sets with one acceptable name for each effect.

        Args:
            of: Probabilities that settings give this case's hypotheses.

        Returns:
            0 ... 1; of faint causes half of `none` counts as right, too.

        """
        none = of.none + sum(
            chance
            for one, causes, chance in zip(self.scored, self.causes, of.hypotheses, strict=True)
            if one.names and not causes
        )
        if self.kind == NONE:
            return none
        # What looks like a healthy arm may be called so. A faint cause can, just: "none" is half
        # right there, as it is better than any other cause.
        right = _FAINT * none if self.strength == "faint" else 0.0
        if all(NONE in names for names in self.acceptable):
            right = none
        if self.kind == UNKNOWN:
            return of.unknown + right
        for causes, chance in zip(self.causes, of.hypotheses, strict=True):
            if causes and self._is_right(causes):
                right += chance
        return right

    def _is_right(self, causes: frozenset[str]) -> bool:
        wanted = len(self.acceptable)
        return len(causes) == wanted == matched(self.acceptable, causes)


def plan(per_class: int) -> dict[str, Case]:
    """Plan cases on all arms, as a blind set's, with unknown kinds and seeds of their own.

    Args:
        per_class: As `blind_check`'s; healthy arms in proportion.

    Returns:
        Cases by name, in random order; none with a reference, whose `explore` follows another's.

    """
    cases = full_plan(_SEED, per_class, _HEALTHY * per_class, CALIBRATION_UNKNOWN)
    return {name: case for name, case in cases.items() if case.kind not in SINCE}


def collect(case: Case) -> dict[str, Any]:
    """Make a case's recording, explore it, and return what a posterior needs.

    Args:
        case: Case to make, in a folder that is deleted.

    Returns:
        JSON content: the truth, and the hypotheses that the search scored.

    Raises:
        GalenError: The recording can't be made or explored.

    """
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording"
        truth = generate(case, recording)
        explored = explore(read_recording(recording, specification=specified(recording)))
    within = within_limits(explored, posterior(explored.scored, load_settings()))
    explored = replace(explored, within=within)
    return {
        "kind": case.kind,
        "strength": case.strength,
        "arm": case.arm,
        "effects": [one["effect"] for one in truth.effects],
        "parameters": [_plain(one["parameters"]) for one in truth.effects],
        "d": truth.d,
        "acceptable": truth.acceptable,
        "scored": [asdict(one) for one in explored.scored],
        "causes": [sorted(explored.beyond(one.names)) for one in explored.scored],
    }


def known(content: dict[str, Any]) -> Known:
    """Read what `collect` returned.

    Args:
        content: Content of a case's JSON file.

    Returns:
        The case; arm, parameters and D are left out.

    """
    scored = tuple(
        Scored(tuple(one["names"]), one["energy"], one["occam"], one["structure"])
        for one in content["scored"]
    )
    acceptable = tuple(frozenset(names) for names in content["acceptable"])
    causes = tuple(frozenset(names) for names in content["causes"])
    return Known(content["kind"], content["strength"], acceptable, scored, causes)


def loss(cases: Sequence[Known], settings: Settings) -> float:
    """Return the mean of -log probability of what was there.

    Args:
        cases: Calibration cases.
        settings: Settings of the posterior.

    Returns:
        Mean over the pairs of kind and strength, each the mean of its cases.

    """
    of_kind: dict[str, list[float]] = {}
    for case in cases:
        chance = case.chance(posterior(case.scored, settings))
        of_kind.setdefault(f"{case.kind} {case.strength}", []).append(-np.log(chance + _LEAST))
    return float(np.mean([np.mean(losses) for losses in of_kind.values()]))


def fitted(cases: Sequence[Known], start: Settings) -> Settings:
    """Return the settings with the smallest loss beside their prior (Nelder-Mead).

    Args:
        cases: Calibration cases.
        start: Settings from which the search starts; the prior is about the defaults.

    Returns:
        The settings that were found.

    """
    origin = _vector(Settings())

    def cost(vector: np.ndarray) -> float:
        prior = 0.5 * float(np.sum(((vector - origin) / np.array(_SPREAD)) ** 2))
        return loss(cases, _settings(vector)) + prior / len(cases)

    result = minimize(
        cost,
        _vector(start),
        method="Nelder-Mead",
        options={"maxiter": 500, "xatol": 1e-2, "fatol": 1e-4, "adaptive": True},
    )
    return _settings(result.x)


def _vector(of: Settings) -> np.ndarray:
    return np.log(np.array(list(asdict(of).values())))


def _settings(vector: np.ndarray) -> Settings:
    numbers = [float(value) for value in np.exp(np.clip(vector, -8.0, 6.0))]
    of = dict(zip(asdict(Settings()), numbers, strict=True))
    return Settings(**{**of, "temper": min(of["temper"], 1.0)})


def _plain(parameters: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(parameters, default=lambda value: np.asarray(value).tolist()))


def report(cases: Sequence[Known], settings: Settings) -> dict[str, Any]:
    """Count how often what was there has a probability over 0.5, by kind and strength.

    Args:
        cases: Calibration cases.
        settings: Settings of the posterior.

    Returns:
        By kind and strength: `cases`, share `right`, `mean_probability` of what was there.

    """
    rows: dict[str, list[tuple[float, bool]]] = {}
    for case in cases:
        chances = posterior(case.scored, settings)
        right = case.chance(chances)
        rows.setdefault(f"{case.kind} {case.strength}".strip(), []).append((right, right > 0.5))
    return {
        name: {
            "cases": len(each),
            "right": float(np.mean([hit for _, hit in each])),
            "mean_probability": float(np.mean([chance for chance, _ in each])),
        }
        for name, each in rows.items()
    }


def main(args: Sequence[str] | None = None) -> int:
    """Entry point.

    Args:
        args: Command line; None for the process's own.

    Returns:
        The exit code.

    """
    parser = argparse.ArgumentParser(
        prog="python -m galen_validation.calibrate_diagnosis",
        description=__doc__.split("\n")[0],
    )
    parser.add_argument("cases", type=Path, help="folder that keeps what came out of each case")
    parser.add_argument(
        "--per-class", type=int, default=4, help="turns over all kinds (4); 0: make no more cases"
    )
    parser.add_argument("--write", action="store_true", help="write the package's calibration.json")
    given = parser.parse_args(args)
    return run_command(parser.prog, lambda: _run(given))


def _collect_into(path: Path, cases: Mapping[str, Case]) -> None:
    write_whole(path, json.dumps(collect(cases[path.stem])))


def _run(given: argparse.Namespace) -> int:
    given.cases.mkdir(parents=True, exist_ok=True)
    cases_of = plan(given.per_class)
    missing = [path for name in cases_of if not (path := given.cases / f"{name}.json").exists()]
    one = partial(_collect_into, cases=cases_of)
    for finished in run_many(one, missing):
        if finished.error is not None:
            print(f"{finished.bag}: {finished.error}", file=sys.stderr)
    files = sorted(given.cases.glob("*.json"))
    if not files:
        raise GalenError(f"{given.cases}: no cases to calibrate on")
    cases = [known(json.loads(path.read_text(encoding="utf-8"))) for path in files]
    halves = cases[0::2], cases[1::2]
    start = Settings()
    half = fitted(halves[0], start)
    everything = fitted(cases, half)
    outcome = {
        "settings": asdict(everything),
        "made_by": "python -m galen_validation.calibrate_diagnosis",
        "cases": len(cases),
        "loss": {
            "start": loss(cases, start),
            "fitted_half": loss(halves[0], half),
            "other_half": loss(halves[1], half),
            "all": loss(cases, everything),
        },
        "other_half": report(halves[1], half),
    }
    print(json.dumps(outcome, indent=2))
    if given.write:
        target = Path(inference.__file__).with_name("calibration.json")
        write_whole(target, json.dumps(outcome, indent=2) + "\n")
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
