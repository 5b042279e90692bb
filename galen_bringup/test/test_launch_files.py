# SPDX-License-Identifier: Apache-2.0
"""What the launch files start; recorders stand in for `launch`, which PyPI does not have."""

import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest
from galen_common.arm import ArmParameters
from galen_common.parameters import param_fields

LAUNCH = Path(__file__).resolve().parent.parent / "launch"


class Recorded:
    """What a launch file made: the class' name and the arguments."""

    def __init__(self, kind, arguments, options):
        self.kind, self.arguments, self.options = kind, arguments, options

    def __eq__(self, other):
        return vars(self) == vars(other)

    def perform(self, context):
        return context[self.arguments[0]]


class Recorder(ModuleType):
    """A module whose classes only record how they were called."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *arguments, **options: Recorded(name, arguments, options)


@pytest.fixture
def launched(monkeypatch):
    """Tells the arguments of each node that a launch file starts, by its executable."""
    modules = ("actions", "conditions", "substitutions", "parameter_descriptions")
    for package in ("launch", "launch_ros"):
        for name in (package, *(f"{package}.{module}" for module in modules)):
            monkeypatch.setitem(sys.modules, name, Recorder(name))

    def nodes(name, **given):
        """With arguments given, those nodes that need some to be made."""
        made = runpy.run_path(str(LAUNCH / name))["generate_launch_description"]().arguments[0]
        if given:
            made = [
                new
                for one in made
                if one.kind == "OpaqueFunction"
                for new in one.options["function"](given)
            ]
        said = {one.kind: one.options for one in made if one.kind == "LogInfo"}
        return said | {one.options["executable"]: one.options for one in made if one.kind == "Node"}

    return nodes


def argument(name):
    return Recorded("LaunchConfiguration", (name,), {})


def parameter(node, name):
    """The value that counts: of the last of the node's parameters."""
    given = [values for values in node["parameters"] if isinstance(values, dict)]
    return [values[name] for values in given if name in values][-1]


def test_one_argument_names_the_tool_on_the_arm_and_in_the_compensation(launched):
    driver = launched("simulation.launch.py")["sim_driver_node"]
    gravcomp = launched("robot.launch.py")["gravcomp_node"]
    for value in (parameter(driver, "initial_tool"), parameter(gravcomp, "tool")):
        assert value.arguments == (argument("tool"),)


@pytest.mark.parametrize("name", ["simulation.launch.py", "robot.launch.py"])
def test_every_node_is_told_which_arm_it_is(launched, name):
    told = {"urdf_file": "urdf", "gravity_m_s2": "gravity"}
    told |= {frame: frame for frame in ("base_frame", "sensor_frame")}
    if name == "robot.launch.py":
        told["use_robot_description"] = "use_robot_description"
    for node in launched(name).values():
        for asked, given in told.items():
            assert parameter(node, asked).arguments == (argument(given),)
    assert told.keys() <= set(param_fields(ArmParameters))


def test_the_simulated_arm_starts_where_it_is_asked_to(launched):
    driver = launched("simulation.launch.py")["sim_driver_node"]
    assert parameter(driver, "start_joints").arguments == (argument("start_joints"),)


ARM = {"urdf": "", "base_frame": "", "sensor_frame": "ft_sensor"}


def test_the_viewer_that_is_not_installed_is_named_with_the_remedy(launched, monkeypatch, tmp_path):
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    (said,) = launched("simulation.launch.py", **ARM).values()
    assert "apt install ros-jazzy-robot-state-publisher ros-jazzy-rviz2" in said["msg"]


@pytest.mark.parametrize("urdf", ["", str(LAUNCH.parent / "urdf/six_axis.urdf")])
def test_the_viewer_has_the_arm_s_description_and_frame(launched, monkeypatch, tmp_path, urdf):
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    for name in ("robot_state_publisher", "rviz2"):
        (index / name).touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    nodes = launched("simulation.launch.py", **ARM | {"urdf": urdf})
    (text,) = parameter(nodes["robot_state_publisher"], "robot_description").arguments
    arm = ArmParameters(urdf_file=urdf).arm()
    assert text == arm.urdf and arm.name in text
    assert nodes["rviz2"]["arguments"][-2:] == ["-f", arm.base_frame]


@pytest.mark.parametrize("name", ["simulation.launch.py", "robot.launch.py"])
def test_the_log_calls_each_process_by_its_executable(launched, name):
    for executable, node in launched(name).items():
        assert "prefix" not in node or node["exec_name"] == executable
