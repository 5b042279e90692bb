"""Cost and latency of the compensator's process, against bare relays in the same run.

    python -m galen_gravcomp.benchmark --rates 500 1000 --seconds 10 --json

What is measured and how, `galen_gravcomp.node_benchmark` says.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from galen_model.tool_file import LoadEstimate, ToolFile, tool_path, write_tool
from geometry_msgs.msg import WrenchStamped

from galen_gravcomp.node_benchmark import Subject, add_benchmark_options, compare, relays

VARIANTS = (
    ("gravcomp, weight alone", ("fit_watch:=false",), False),
    ("gravcomp", (), False),
    ("gravcomp, wander", ("wander:=true",), False),
    ("gravcomp, motion", ("motion:=joints",), True),
)
"""Names, the node's parameters that are not at their defaults, and whether the arm moves."""


def write_bench_tool(tools_dir: Path) -> None:
    """A tool file for the compensator to use."""
    load = LoadEstimate(0.06, np.array([0.055, 0.002, 0.045]), np.eye(4) * 1e-8)
    tool = ToolFile(
        tool="bench",
        load=load,
        bias=load,
        tip_m=np.zeros(3),
        rmse=np.zeros(6),
        poses_used=0,
        calibrated_at="2026-01-01T00:00:00+00:00",
    )
    write_tool(tool_path(tools_dir, "bench"), tool)


def main() -> None:
    """Measure every subject at every rate and print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_benchmark_options(parser)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        write_bench_tool(Path(directory))
        node = (
            *("galen_gravcomp.node", "--ros-args", "--log-level", "error"),
            *("-p", f"tools_dir:={directory}", "-p", "tool:=bench"),
        )
        subjects = [(relay, False) for relay in relays("wrench_raw")]
        for name, values, moving in VARIANTS:
            given = tuple(word for value in values for word in ("-p", value))
            output = ("wrench_compensated", WrenchStamped)
            subjects.append((Subject(name, (*node, *given), output), moving))
        compare(subjects, "wrench_raw", options)


if __name__ == "__main__":
    main()
