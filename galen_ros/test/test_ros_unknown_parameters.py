"""A misspelt parameter is told, with the name that was meant; other nodes' parameters are not."""

from dataclasses import dataclass

import pytest
from galen_ros.node.testing import Harness
from galen_ros.parameters.declare import declare_parameters, param
from galen_ros.parameters.unknown import warn_of_unknown_parameters
from rclpy.node import Node


@dataclass(frozen=True)
class Example:
    tool: str = param("", "tool")
    speed_factor: float = param(1.0, "speed")


@pytest.fixture(scope="module")
def harness():
    with Harness() as world:
        yield world


@pytest.fixture
def warnings(harness):
    def warned(*arguments):
        words = ["--ros-args", *map(str, arguments)]
        node = harness.add(lambda context: Node("example", context=context, cli_args=words))
        said = []

        class Log:
            warning = staticmethod(said.append)

        harness.call_in_executor(lambda: declare_parameters(node, Example))
        node.get_logger = Log
        harness.call_in_executor(lambda: warn_of_unknown_parameters(node, words))
        harness.remove(node)
        return said

    return warned


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("too:=x", "'too' is unknown to /example and ignored: did you mean 'tool'?"),
        ("speed:=5.0", "'speed' is unknown to /example and ignored: did you mean 'speed_factor'?"),
        ("qqq:=1", "'qqq' is unknown to /example and ignored"),
    ],
)
def test_a_misspelt_parameter_is_told(warnings, given, text):
    assert warnings("-p", given, "-p", "tool:=drill") == [f"parameter {text}"]


def test_what_ros_itself_declares_is_known(warnings):
    assert not warnings(
        "-p", "use_sim_time:=true", "-p", "start_type_description_service:=false",
        "-p", "qos_overrides./clock.subscription.depth:=5", "-p", "other_node:tilt:=1.0",
    )  # fmt: skip


def test_a_file_for_all_nodes_may_hold_other_nodes_parameters(warnings, tmp_path):
    path = tmp_path / "all.yaml"
    path.write_text(
        "/**:\n  ros__parameters:\n    rate_hz: 5.0\n    tooll: x\n    effects: {cable: true}\n"
        "/**/other:\n  ros__parameters:\n    tol: x\n"
        "/**/example:\n  ros__parameters:\n    poses: 5\n"
    )
    assert warnings("--params-file", path) == [
        "parameter 'poses' is unknown to /example and ignored",
        "parameter 'tooll' is unknown to /example and ignored: did you mean 'tool'?",
    ]
