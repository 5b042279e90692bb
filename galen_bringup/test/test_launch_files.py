"""What the launch files start; recorders stand in for `launch`, which PyPI does not have."""

import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest
from galen_ros.arm import ArmParameters
from galen_ros.parameters import param_fields

LAUNCH = Path(__file__).resolve().parent.parent / "launch"


class Recorded:
    """What a launch file made: the class' name and the arguments."""

    def __init__(self, kind, arguments, options):
        self.kind, self.arguments, self.options = kind, arguments, options

    def __eq__(self, other):
        return vars(self) == vars(other)


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

    def nodes(name):
        made = runpy.run_path(str(LAUNCH / name))["generate_launch_description"]().arguments[0]
        return {one.options["executable"]: one.options for one in made if one.kind == "Node"}

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


@pytest.mark.parametrize("name", ["simulation.launch.py", "robot.launch.py"])
def test_the_log_calls_each_process_by_its_executable(launched, name):
    for executable, node in launched(name).items():
        assert "prefix" not in node or node["exec_name"] == executable
