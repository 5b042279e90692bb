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

from galen_gravcomp.node_benchmark import Subject, add_benchmark_options, compare, relays
from geometry_msgs.msg import PoseStamped

from galen_deflection.bench_models import write_bench_models
from galen_msgs.msg import DeflectionStamped


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
