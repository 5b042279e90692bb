"""What `galen_bringup.bench` measures of the compensator's process."""

from pathlib import Path

import numpy as np
from galen_model.tool_file import LoadEstimate, ToolFile, tool_path, write_tool
from geometry_msgs.msg import WrenchStamped

from galen_gravcomp.node_benchmark import Subject

VARIANTS = (
    ("gravcomp", (), True),
    ("gravcomp, weight alone", ("fit_watch:=false",), True),
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


def subjects(tools_dir: Path) -> list[Subject]:
    """The node with its stages; writes a tool's file into tools_dir."""
    write_bench_tool(tools_dir)
    node = (
        *("galen_gravcomp.node", "--ros-args", "--log-level", "error"),
        *("-p", f"tools_dir:={tools_dir}", "-p", "tool:=bench"),
    )
    output = ("wrench_compensated", WrenchStamped)
    return [
        Subject(name, (*node, *(w for v in values for w in ("-p", v))), output, moving=moving)
        for name, values, moving in VARIANTS
    ]
