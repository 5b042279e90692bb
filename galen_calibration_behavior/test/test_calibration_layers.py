import ast
import sys
from pathlib import Path

import pytest

import galen_calibration_behavior

PACKAGE = Path(galen_calibration_behavior.__file__).parent
PURE = [
    "grid", "motion_time", "stamps", "arrival", "stillness", "pose_recorder", "sweep", "commands",
    "procedure", "estimate", "result_text", "visits", "tool_border", "recorded_sweeps",
    "pose_table", "home_stays", "silence", "goal_procedure", "pose_procedure",
    "pose_order", "precision", "sweep_plan",
]  # fmt: skip
ALLOWED = {"numpy", "scipy", "galen_model", "galen_bags", "galen_calibration_behavior"}


@pytest.mark.parametrize("module", PURE)
def test_the_procedure_and_its_parts_know_nothing_of_ros(module):
    tree = ast.parse((PACKAGE / f"{module}.py").read_text())
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module.split(".")[0])
            if node.module.startswith("galen_calibration_behavior."):
                assert node.module.split(".")[1] in PURE
    assert imported <= ALLOWED | sys.stdlib_module_names, imported - ALLOWED
