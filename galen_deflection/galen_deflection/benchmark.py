"""Cost and latency of the deflection's process, against bare relays in the same run.

    python -m galen_deflection.benchmark --rates 500 1000 --rounds 3 --json

What is measured and how, `galen_gravcomp.node_benchmark` says. Each model works once on an arm
that stands, whose joints are the same sample by sample, and once on one whose joints never are
(`..._moving`). Without `--model` they are the nominal arm's: springs, and springs with two smooth
plays at each, as fits to arms with friction come out.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from galen_gravcomp.node_benchmark import Subject, add_benchmark_options, compare, relays
from galen_model.tools import TOOLS
from geometry_msgs.msg import PoseStamped

from galen_deflection.fitted_range import FittedRange
from galen_deflection.model_file import write_model
from galen_deflection.models.hysteresis_basis import COLUMNS, HysteresisBasis, Operator
from galen_deflection.models.joint_stiffness import StiffnessBasis
from galen_deflection.models.linear import Basis, FittedOn, LinearModel
from galen_deflection.springs import kinds
from galen_msgs.msg import DeflectionStamped

_SHARES = (0.2, 0.8)
_WEIGHT = 0.1  # of each play, over its spring's own compliance
_LARGEST = {"roll": 1.5, "tilt": 1.5, "carriage": 15.0, "rod": 60.0}  # N.m, N


def _nominal(kind: str, basis: Basis) -> LinearModel:
    nominal = {kind.name: kind.compliance for kind in kinds()}
    given = [nominal[operator.place] for operator in getattr(basis, "operators", ())]
    values = np.array([*nominal.values(), *(_WEIGHT * compliance for compliance in given)])
    home = np.array([0.0, 0.0, 0.408, 0.0, 0.0])
    push, way = np.full(6, 20.0), np.array([0.1, 0.1, 0.1, 1.5, 1.0])
    return LinearModel(
        name=kind,
        tip_m=TOOLS["retractor"].tip_m,
        basis=basis,
        values=values,
        covariance=np.diag((0.01 * values) ** 2),
        discrepancy=np.eye(6) * 1e-12,
        noise=np.full(6, 1e-4),
        fitted_range=FittedRange(-push, push, home - way, home + way),
        fitted_on=FittedOn(1, 1, 1, 1),
    )


def write_bench_models(folder: Path) -> list[Path]:
    """Model files of the nominal arm, without and with hysteresis."""
    tip_m = TOOLS["retractor"].tip_m
    operators = tuple(
        Operator(place, "smooth_play", (share * load,) * len(COLUMNS[place]))
        for place, load in _LARGEST.items()
        for share in _SHARES
    )
    paths = []
    for kind, basis in (
        ("joint_stiffness", StiffnessBasis(tip_m)),
        ("joint_hysteresis", HysteresisBasis(tip_m, operators)),
    ):
        paths.append(folder / f"{kind}.json")
        write_model(paths[-1], _nominal(kind, basis))
    return paths


def _subject(model: Path, name: str) -> Subject:
    return Subject(
        name,
        ("galen_deflection.node", "--ros-args", "--log-level", "error")
        + ("-p", f"model_file:={model}"),
        ("deflection", DeflectionStamped),
        (("tip_pose_corrected", PoseStamped),),
    )


def main() -> None:
    """Measure every subject at every rate and print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--model", type=Path, nargs="+", help="models' files to measure instead")
    add_benchmark_options(parser)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        models = options.model or write_bench_models(Path(directory))
        subjects = [(subject, False) for subject in relays("wrench_compensated")]
        for model in models:
            subjects.append((_subject(model, model.stem), False))
            subjects.append((_subject(model, f"{model.stem}_moving"), True))
        compare(subjects, "wrench_compensated", options)


if __name__ == "__main__":
    main()
