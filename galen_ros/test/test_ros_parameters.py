# SPDX-License-Identifier: Apache-2.0
"""Parameters: what is declared, what is rejected and how the README's table reads."""

from dataclasses import dataclass

import pytest
from galen_common.arm import ArmParameters
from galen_common.parameters import ParameterError, param
from galen_ros.node.parameters import declare_parameters, warn_of_unknown_parameters
from galen_ros.node.testing import Harness, parameters
from rclpy.node import Node
from rclpy.parameter import Parameter


@dataclass(frozen=True)
class Example:
    rate_hz: float = param(500.0, "sample rate in Hz", minimum=1.0, maximum=2000.0)
    count: int = param(7, "poses", minimum=1)
    tools_dir: str = param("", "where the tools' files are")
    weights: tuple[float, ...] = param([1.0, 2.0], "weights", minimum=0.0)
    names: tuple[str, ...] = param([], "names")
    strict: bool = param(True, "reject what is odd")
    gain: float = param(0.5, "gain", minimum=0.0, maximum=1.0, read_only=False)
    gain_limit: float = param(0.9, "largest gain", read_only=False)

    def validate(self):
        if self.gain > self.gain_limit:
            raise ParameterError(f"gain is {self.gain}, above gain_limit {self.gain_limit}")


@pytest.fixture(scope="module")
def harness():
    with Harness() as world:
        yield world


def declared(harness, on_change=None, **overrides):
    node = harness.add(
        lambda context: Node(
            "example", context=context, parameter_overrides=parameters(**overrides)
        )
    )
    try:
        return node, harness.call_in_executor(lambda: declare_parameters(node, Example, on_change))
    except BaseException:
        harness.remove(node)
        raise


def test_defaults_and_overrides(harness):
    """ROS hands over `-p weights:="[]"` without a value."""
    node, values = declared(harness, rate_hz=250.0, weights=None, names=["a", "b"], count=3)
    assert values == Example(rate_hz=250.0, weights=(), names=("a", "b"), count=3)
    assert node.describe_parameter("rate_hz").description == "sample rate in Hz"
    assert node.describe_parameter("rate_hz").read_only
    harness.remove(node)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"rate_hz": 5000.0}, ["rate_hz", "5000", "1.0 to 2000.0"]),
        ({"rate_hz": 0}, ["rate_hz", "0", "1.0 to 2000.0"]),
        ({"rate_hz": "fast"}, ["rate_hz", "fast", "float"]),
        ({"rate_hz": True}, ["rate_hz", "True", "float"]),
        ({"rate_hz": float("nan")}, ["rate_hz", "nan"]),
        ({"count": 2.5}, ["count", "2.5", "int"]),
        ({"count": 0}, ["count", "0", "at least 1"]),
        ({"weights": [1.0, -1.0]}, ["weights", "-1.0", "at least 0.0"]),
        ({"weights": 1.0}, ["weights", "1.0", "float list"]),
        ({"names": "a"}, ["names", "'a'", "string list"]),
        ({"gain": 0.8, "gain_limit": 0.7}, ["gain", "0.8", "gain_limit", "0.7"]),
    ],
)
def test_a_bad_value_is_named_with_what_is_allowed(harness, overrides, words):
    with pytest.raises(ParameterError) as error:
        declared(harness, **overrides)
    for word in words:
        assert word in str(error.value)


def test_changes_at_run_time_are_checked_and_told(harness):
    changes = []
    node, _ = declared(harness, changes.append)

    def set_to(name, value):
        return harness.call_in_executor(
            lambda: node.set_parameters([Parameter(name, value=value)])[0]
        )

    assert set_to("gain", 0.7).successful
    assert [change.gain for change in changes] == [0.7]
    for name, value in [("gain", 1.5), ("gain", 0.95), ("gain", "much"), ("rate_hz", 100.0)]:
        result = set_to(name, value)
        assert not result.successful
        assert result.reason
    assert len(changes) == 1
    # gain_limit 0.6 fits the default gain of 0.5, but not the 0.7 that is active.
    assert not set_to("gain_limit", 0.6).successful
    harness.remove(node)


def test_only_a_misspelt_parameter_gives_a_warning(harness):
    node, _ = declared(harness, rate_hs=5.0, gian_limit=0.5, other_node_has_this=1)
    warnings = []

    class Log:
        warning = staticmethod(warnings.append)

    node.get_logger = Log
    harness.call_in_executor(lambda: warn_of_unknown_parameters(node))
    assert warnings == [
        "parameter 'gian_limit' is unknown to /example and ignored: did you mean 'gain_limit'?",
        "parameter 'rate_hs' is unknown to /example and ignored: did you mean 'rate_hz'?",
    ]
    harness.remove(node)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -98.1), (0.0, 0.0, 0.0), (9.8, 0.0)])
def test_gravity_that_no_calibration_file_may_have_is_rejected_at_start(gravity):
    ArmParameters(gravity_m_s2=(0.0, 6.9, 6.9)).validate()
    with pytest.raises(ParameterError, match=r"gravity_m_s2.* 9.7 to 9.9 m/s\^2 long"):
        ArmParameters(gravity_m_s2=gravity).validate()
