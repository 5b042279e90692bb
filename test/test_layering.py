"""The mathematics stays free of ROS: which modules may import it is a list, kept here."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("galen_*/setup.py"))

# These import rclpy or messages, themselves or by another module here. All others are pure: they
# work, and are tested, without ROS. A new node, client or conversion module is added on purpose.
ROS_MODULES = {
    "galen_bags.formats.message_types",
    "galen_bags.play.command",
    "galen_bags.play.played_topics",
    "galen_bags.play.player",
    "galen_bags.qos",
    "galen_bags.record.command",
    "galen_bags.record.recorder",
    "galen_bags.topic_names",
    "galen_bringup.arm_client",
    "benchmarks.bench",
    "galen_bringup.demo",
    "benchmarks.diagnosis",
    "galen_bringup.drift",
    "galen_bringup.figures",
    "benchmarks.panel",
    "galen_bringup.processes",
    "benchmarks.soak",
    "benchmarks.startup",
    "galen_bringup.suite",
    "galen_bringup.verification",
    "galen_ros.goal.arm_link",
    "galen_calibration_behavior.calibrate",
    "galen_calibration_behavior.quick_check.command",
    "galen_calibration_behavior.quick_check.node",
    "galen_ros.goal.deferred_action",
    "galen_ros.goal.client",
    "galen_ros.goal.node",
    "galen_calibration_behavior.node",
    "benchmarks.deflection",
    "galen_deflection.node",
    "galen_deflection.collection.command",
    "galen_deflection.collection.node",
    "galen_deflection.collection.recorder",
    "benchmarks.gravcomp",
    "galen_gravcomp.tools.client",
    "galen_gravcomp.node",
    "benchmarks.node",
    "benchmarks.node_table",
    "galen_ros.stream.node",
    "galen_gravcomp.tools.active",
    "galen_gravcomp.tools.messages",
    "galen_gravcomp.tools.services",
    "galen_panel.ros.calls",
    "galen_panel.ros.goal_kinds",
    "galen_panel.ros.goals",
    "galen_panel.ros.reports",
    "galen_panel.ros.streams",
    "galen_panel.ros.suite",
    "galen_panel.ros.thread",
    "galen_panel.ros.tools",
    "galen_ros.node.background",
    "galen_ros.conversions",
    "galen_ros.node.deferred_service",
    "galen_ros.node.diagnostics",
    "galen_ros.node.managed_node",
    "galen_ros.parameters.services",
    "galen_ros.parameters.declare",
    "galen_ros.qos",
    "galen_ros.node.spin",
    "galen_ros.node.testing",
    "galen_ros.parameters.unknown",
    "galen_sim_driver.node.conversions",
    "galen_sim_driver.node.sim_driver_node",
    "galen_sim_driver.node.parameters",
}

ROS_ROOTS = {"rclpy", "rcl_interfaces", "ament_index_python", "launch", "launch_ros", "std_srvs"}

IMPORT_WITHOUT_ROS = """
import importlib, json, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        root = name.partition(".")[0]
        if root in roots or root.endswith(("_msgs", "_interfaces")):
            raise ModuleNotFoundError("ROS is not for this module: " + name, name=name)

roots = set(json.loads(sys.argv[1]))
sys.meta_path.insert(0, NoRos())
failed = {}
for module in json.loads(sys.argv[2]):
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        failed[module] = str(error)
print(json.dumps(failed))
"""


def modules(package):
    """The package's modules by name: {name: file}."""
    folder = ROOT / package / package
    found = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(ROOT / package).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def is_ros(name):
    root = name.partition(".")[0]
    return root in ROS_ROOTS or root.endswith(("_msgs", "_interfaces"))


def imported(path):
    """All that a file imports, inside functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module)
    return names


@pytest.fixture(scope="module")
def failed_without_ros():
    """Every module that doesn't import without ROS, and why; all tried in one process."""
    names = [name for package in PACKAGES for name in modules(package)]
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            IMPORT_WITHOUT_ROS,
            json.dumps(sorted(ROS_ROOTS)),
            json.dumps(sorted(names)),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def test_there_are_packages_to_check():
    assert {"galen_model", "galen_ros", "galen_sim_driver", "galen_gravcomp"} <= set(PACKAGES)


def test_the_model_has_no_ros_module():
    assert not [name for name in ROS_MODULES if name.startswith("galen_model.")]


@pytest.mark.parametrize("package", PACKAGES)
def test_pure_modules_import_without_ros(package, failed_without_ros):
    pure = [name for name in modules(package) if name not in ROS_MODULES]
    assert pure
    assert {name: failed_without_ros[name] for name in pure if name in failed_without_ros} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_pure_modules_name_no_ros_import_anywhere(package):
    found = {
        name: sorted(filter(is_ros, imported(path)))
        for name, path in modules(package).items()
        if name not in ROS_MODULES
    }
    assert {name: names for name, names in found.items() if names} == {}


def test_the_list_holds_no_module_that_is_pure_or_gone(failed_without_ros):
    present = {name for package in PACKAGES for name in modules(package)}
    assert present >= ROS_MODULES
    assert failed_without_ros.keys() >= ROS_MODULES
