"""The experiment that best separates the causes that are left, and how sure it would make.

Every experiment of `galen_diagnosis.experiment.experiments` is simulated with every hypothesis and
judged by `galen_diagnosis.experiment.separation`; the one with the least trouble is taken of those
that make the answer as sure as the best does, but for a hundredth.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from galen_model.arrays import Array
from galen_model.files.atomic_file import write_whole
from galen_model.files.calibration_file import CalibrationFile

from galen_diagnosis.errors import DiagnosisError
from galen_diagnosis.experiment.experiments import LEVELS_N, Budget, Experiments, Program, Proposal
from galen_diagnosis.experiment.separation import Alternative, Separation, separate

__all__ = ["Alternative", "Budget", "Experiment", "propose", "write_sweep"]

APART = 3.3
"""Pairs at a distance below this can't be told apart: 5 % of errors at Phi(-D/2)."""
_AS_GOOD = 0.01
_WORTH = 0.05
_MOST_ALTERNATIVES = 4


@dataclass(frozen=True)
class Experiment:
    """What to do next.

    separates: the causes that it tells apart; not_separated: those that stay as they are. do: a
    sentence. poses (n, 5): joints to stand at, m and rad, in this order; program: whose parameters
    `write_sweep` makes of them. distance: the smallest D of the pairs that are
    separated. expected_probability: of the truth afterwards, before: now.
    """

    separates: tuple[str, ...]
    not_separated: tuple[tuple[str, str], ...]
    do: str
    kind: str
    poses: Array
    program: Program
    average_s: float
    home: tuple[float, ...]
    distance: float
    expected_probability: float
    before: float

    def to_json(self) -> dict[str, Any]:
        """As `next_experiment` in diagnosis.json: the contract's two keys and more."""
        return {
            "separates": list(self.separates),
            "do": self.do,
            "kind": self.kind,
            "poses": len(self.poses),
            "distance": self.distance,
            "expected_probability": self.expected_probability,
            "probability_now": self.before,
            "not_separated": [list(pair) for pair in self.not_separated],
        }


def propose(
    alternatives: Sequence[Alternative], tool: CalibrationFile, budget: Budget | None = None
) -> Experiment | None:
    """The next experiment for two or more hypotheses that are left; None where none would help.

    Of more than four the likeliest four count.

    Raises DiagnosisError for probabilities or covariances that are none, ObstacleError where the
    budget's boxes leave the arm no home.
    """
    budget = budget or Budget()
    for one in alternatives:
        one.check()
    known = sorted(alternatives, key=lambda one: -one.probability)[:_MOST_ALTERNATIVES]
    known = [one for one in known if one.probability > 0.0]
    if len(known) < 2:
        return None
    left = [one.in_another_session() for one in known]
    probability = np.array([one.probability for one in left])
    before = float(np.sum((probability / probability.sum()) ** 2))
    judged = [
        (proposal, separate(proposal.trials, left, tool))
        for proposal in Experiments(left, tool, budget).all()
    ]
    best = max(separation.expected_probability for _, separation in judged)
    if best < before + _WORTH * (1.0 - before):
        return None
    proposal, separation = next(
        (one, how) for one, how in judged if how.expected_probability >= best - _AS_GOOD
    )
    return _experiment(proposal, separation, [one.name for one in known], budget, before)


def _experiment(
    proposal: Proposal,
    separation: Separation,
    names: Sequence[str],
    budget: Budget,
    before: float,
) -> Experiment:
    distance = np.minimum(separation.distance, separation.distance.T)
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    apart = [pair for pair in pairs if distance[pair] >= APART]
    # Where no pair comes that far, the farthest is what it is about.
    about = apart or [max(pairs, key=lambda pair: distance[pair])]
    told = {k for pair in about for k in pair}
    return Experiment(
        separates=tuple(name for k, name in enumerate(names) if k in told),
        not_separated=tuple((names[j], names[i]) for i, j in pairs if (i, j) not in about),
        do=proposal.do,
        kind=proposal.kind,
        poses=proposal.poses,
        program=proposal.program,
        average_s=budget.average_s,
        home=tuple(float(value) for value in budget.where.home),
        distance=float(min(distance[pair] for pair in about)),
        expected_probability=min(float(separation.expected_probability), 1.0),
        before=before,
    )


_HEAD = """\
{do}
# It tells apart: {separates}.
#
#   ros2 run {node} --ros-args --params-file THIS_FILE{more}
#   ros2 run {command}
#
{remark}
"""
_SWEEP_REMARK = (
    "Record joint_states and wrench_raw{tracker} meanwhile. A calibration writes the tool's file:"
    " give it a directory of its own, so that the file in use stays."
)
_PUSH_REMARK = "It records what a diagnosis needs."


def write_sweep(experiment: Experiment, path: Path) -> None:
    """Write it as parameters of calibration_node or of collection_node, whole or not at all.

    Raises DiagnosisError for an experiment that neither runs, and where it can't be written.
    """
    if experiment.program == "none":
        raise DiagnosisError(
            f"{path}: not written: the next experiment ({experiment.kind}) is nothing that a node"
            f" runs; do it by hand: {experiment.do}"
        )
    sweep = experiment.program == "calibration"
    parameters = _sweep_parameters(experiment) if sweep else _collection_parameters(experiment)
    tracker = ", tracker/tool_pose, tracker/base_pose" if "tracker" in experiment.kind else ""
    one_sweep = "" if experiment.kind == "second mass" else " --one-sweep"
    head = _HEAD.format(
        do=_comment(f"{experiment.do}."),
        separates=", ".join(experiment.separates),
        node="galen_calibration_behavior calibration_node"
        if sweep
        else "galen_deflection collection_node",
        more=" -p tools_dir:=DIR" if sweep else "",
        command=f"galen_calibration_behavior calibrate TOOL --tip X Y Z{one_sweep}"
        if sweep
        else "galen_deflection collect NAME --tool TOOL",
        remark=_comment(_SWEEP_REMARK.format(tracker=tracker) if sweep else _PUSH_REMARK),
    )
    body = yaml.safe_dump(
        {f"/**/{experiment.program}": {"ros__parameters": parameters}},
        sort_keys=False,
        default_flow_style=None,
        width=100,
    )
    try:
        write_whole(path, head + body)
    except OSError as error:
        raise DiagnosisError(f"{path}: can't be written: {error.strerror or error}") from error


def _comment(text: str) -> str:
    return textwrap.fill(text, 100, initial_indent="# ", subsequent_indent="# ")


def _sweep_parameters(experiment: Experiment) -> dict[str, Any]:
    names = ("Xhome", "Yhome", "Zhome", "Rhome", "Thome")
    return {
        "poses": "listed",
        "average_s": float(experiment.average_s),
        **dict(zip(names, experiment.home, strict=True)),
        "listed_poses_rad": _rounded(experiment.poses[:, 3:]),
    }


def _collection_parameters(experiment: Experiment) -> dict[str, Any]:
    return {"positions": _rounded(experiment.poses), "forces_n": list(LEVELS_N)}


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 5) for value in values.ravel()]
