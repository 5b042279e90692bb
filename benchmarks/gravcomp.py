"""What `benchmarks.bench` measures of the compensator's process."""

from pathlib import Path

from geometry_msgs.msg import WrenchStamped

from benchmarks.bench_tool import NAME, write_bench_tool
from benchmarks.node import Subject

VARIANTS = (
    ("gravcomp", (), True),
    ("gravcomp, weight alone", ("fit_watch:=false",), True),
    ("gravcomp, motion", ("motion:=joints",), True),
)
"""Names, the node's parameters that are not at their defaults, and whether the arm moves."""


def subjects(tools_dir: Path) -> list[Subject]:
    """The node with its stages; writes a tool's file into tools_dir."""
    write_bench_tool(tools_dir)
    node = (
        *("galen_gravcomp.node", "--ros-args", "--log-level", "error"),
        *("-p", f"tools_dir:={tools_dir}", "-p", f"tool:={NAME}"),
    )
    output = ("wrench_compensated", WrenchStamped)
    return [
        Subject(name, (*node, *(w for v in values for w in ("-p", v))), output, moving=moving)
        for name, values, moving in VARIANTS
    ]
