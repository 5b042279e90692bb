"""The plant knows nothing of ROS."""

import ast
from pathlib import Path

import pytest

import galen_sim_driver

_WITH_ROS = {"node", "conversions", "parameters"}
_MODULES = sorted(Path(galen_sim_driver.__file__).parent.rglob("*.py"))


@pytest.mark.parametrize("path", _MODULES, ids=lambda path: path.stem)
def test_only_the_ros_side_imports_ros(path):
    imported = set()
    for item in ast.walk(ast.parse(path.read_text())):
        if isinstance(item, ast.Import):
            imported |= {alias.name.split(".")[0] for alias in item.names}
        elif (
            isinstance(item, ast.ImportFrom) and item.module != "galen_ros.parameters.param"
        ):  # has no ROS
            imported.add((item.module or "").split(".")[0])
    ros = {name for name in imported if name in ("rclpy", "galen_ros") or name.endswith("_msgs")}
    assert path.stem in _WITH_ROS or not ros, f"{path.name} imports {', '.join(sorted(ros))}"
