# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policies against what the nodes have in the graph: nothing lacks, nothing is more."""

import gc
import re
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
import rclpy
from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.ros.recorder import RecorderNode
from galen_calibration_behavior.ros.calibrate import CalibrateClient
from galen_calibration_behavior.ros.check import CheckClient
from galen_calibration_behavior.ros.node import CalibrationNode
from galen_common.goal.procedure import PoseProcedure
from galen_deflection.collection.procedure import CollectionProcedure
from galen_deflection.ros import collection_node
from galen_deflection.ros.collect import CollectClient
from galen_deflection.ros.collection_node import CollectionNode
from galen_deflection.ros.node import DeflectionNode
from galen_gravcomp.ros.node import GravcompNode
from galen_panel.ros.suite import RosSuite
from galen_ros.node.testing import Harness, parameters
from galen_sim_driver.ros.node import SimDriverNode
from rclpy.node import Node

POLICIES = Path(__file__).resolve().parent.parent / "config" / "sros2"
INCLUDE = "{http://www.w3.org/2001/XInclude}include"
# What each attribute of a policy's lists allows.
RULES = {
    ("topics", "publish"), ("topics", "subscribe"), ("services", "reply"),
    ("services", "request"), ("actions", "execute"), ("actions", "call"),
}  # fmt: skip
ALONE = {"player"}  # says what a driver says
OUTSIDE = {"imu", "joint_trajectory", "temperature"}  # whoever has that sensor, or moves the arm
NODES = {
    SimDriverNode: {"speed_factor": 2.0},  # at another speed there is /clock
    GravcompNode: {"motion": "imu"},
    DeflectionNode: {},
    CalibrationNode: {},
    CollectionNode: {},
}
PROCEDURES = {
    CalibrationNode: PoseProcedure,
    CollectionNode: CollectionProcedure,
}


@pytest.fixture(autouse=True)
def _no_node_of_the_test_before():
    """A managed node's own services live on in the graph until it is collected."""
    gc.collect()


def children(path, element):
    """An element's children, those of its included files in place of the includes."""
    for child in element:
        if child.tag == INCLUDE:
            (inner,) = re.findall(r"^xpointer\(.*/(\w+)/\*\)$", child.get("xpointer"))
            file = path.parent / child.get("href")
            root = ElementTree.parse(file).getroot()
            yield from children(file, root if root.tag == inner else root.find(inner))
        else:
            yield child


def full_name(name, profile):
    if name.startswith("/"):
        return name
    space = profile.get("ns").rstrip("/")
    if name.startswith("~/"):
        return f"{space}/{profile.get('node')}{name[1:]}"
    return f"{space}/{name}"


def read_policy(path):
    """{enclave: {node: {rule: names}}} of one file."""
    root = ElementTree.parse(path).getroot()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    read = {}
    for enclave in children(path, root.find("enclaves")):
        nodes = read.setdefault(enclave.get("path"), {})
        for profile in enclave.find("profiles"):
            rules = nodes.setdefault(profile.get("node"), {rule: set() for _, rule in RULES})
            for block in children(path, profile):
                ((rule, allowed),) = block.attrib.items()
                assert (block.tag, rule) in RULES and allowed == "ALLOW", f"{path}: {rule}"
                names = [full_name(entry.text, profile) for entry in block]
                assert not rules[rule] & set(names) and len(set(names)) == len(names), path
                rules[rule].update(names)
    return read


def policies():
    return {path.name.split(".")[0]: path for path in POLICIES.glob("*.policy.xml")}


def allowed_to(node):
    """The rules of the one node of this name that is a node of the suite."""
    (rules,) = [
        nodes[node]
        for path in policies().values()
        if path.name != "galen.policy.xml"
        for nodes in read_policy(path).values()
        if node in nodes
    ]
    return rules


def in_graph(node, name=None):
    """The same of a node that runs, or of another one of this name that it sees: {rule: names}."""
    if name is not None and name not in node.get_node_names():
        return {}
    this = (name or node.get_name(), node.get_namespace())
    found = {
        "publish": node.get_publisher_names_and_types_by_node(*this),
        "subscribe": node.get_subscriber_names_and_types_by_node(*this),
        "reply": node.get_service_names_and_types_by_node(*this),
        "request": node.get_client_names_and_types_by_node(*this),
    }
    rules = {rule: {name for name, _ in names} for rule, names in found.items()}
    for rule, served in (("execute", "reply"), ("call", "request")):
        goals = [name for name in rules[served] if name.endswith("/_action/send_goal")]
        rules[rule] = {name.removesuffix("/_action/send_goal") for name in goals}
    for rule in found:
        rules[rule] = {name for name in rules[rule] if "/_action/" not in name}
    return rules


def assert_allowed(harness, node, allowed, name=None):
    """Wait until the graph is what the policy allows; else say where they differ."""
    try:
        harness.wait_for(lambda: in_graph(node, name) == allowed, 5.0, "the policy's interfaces")
    except AssertionError:
        assert in_graph(node, name) == allowed
        raise


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind.__name__)
def test_a_node_may_do_what_it_does_and_no_more(kind, tmp_path):
    values = parameters(use_sim_time=True, **NODES[kind])
    with Harness() as harness:
        node = harness.add(lambda context: kind(context=context, parameter_overrides=values))
        if kind in PROCEDURES:  # as while it works on a goal
            topic = PROCEDURES[kind].wrench_topic
            goal = SimpleNamespace(procedure=SimpleNamespace(wrench_topic=topic))
            action = next(iter(node._servers))
            harness.call_in_executor(lambda: action.subscribe(goal))
            harness.call_in_executor(lambda: node._arm.hear_others(lambda text: None))
        assert_allowed(harness, node, allowed_to(node.get_name()))


@pytest.mark.parametrize(
    "kind", [CalibrateClient, CheckClient, CollectClient], ids=lambda kind: kind.__name__
)
def test_a_command_may_do_what_it_does_and_no_more(kind):
    with Harness() as harness:
        rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true"], domain_id=harness.domain_id)
        try:
            client = kind(Namespace(node="calibration"))
            assert_allowed(harness, client.node, allowed_to(client.node_name))
            client.node.destroy_node()
        finally:
            rclpy.try_shutdown()


def test_the_panel_may_do_what_it_does_and_no_more(monkeypatch):
    with Harness() as harness:
        probe = harness.add(lambda context: Node("probe", context=context))
        monkeypatch.setenv("ROS_DOMAIN_ID", str(harness.domain_id))
        arguments = ["panel", "--ros-args", "-p", "use_sim_time:=true"]
        with RosSuite(arguments) as suite, suite.watch():
            for name in ("panel", "panel_streams"):
                assert_allowed(harness, probe, allowed_to(name), name)


def test_recorders_may_hear_what_they_record(tmp_path):
    recorded = {f"/{name}" for name in collection_node._RECORDED}
    assert allowed_to("collection_recorder")["subscribe"] == recorded | {"/clock"}
    contract = set().union(*(allowed_to(name)["publish"] for name in ("sim_driver", "gravcomp")))
    contract |= allowed_to("deflection")["publish"] | {"/imu", "/temperature"}
    heard = allowed_to("recorder")["subscribe"]
    assert {name for name in heard if name not in contract | {"/clock"}} == set()
    values = parameters(use_sim_time=True)
    with GrowingBagWriter(tmp_path / "bag") as bag, Harness() as harness:
        for name in ("recorder", "collection_recorder"):
            node = harness.add(
                lambda context, name=name: RecorderNode(
                    bag, node_name=name, context=context, parameter_overrides=values
                )
            )
            allowed = allowed_to(name) | {"subscribe": {"/clock"}}  # nothing to record yet
            assert_allowed(harness, node, allowed)


def test_all_enclaves_of_a_robot_are_in_one_file():
    one_by_one = {}
    for name, path in policies().items():
        if name not in ALONE | {"galen"}:
            policy = read_policy(path)
            assert list(policy) == [f"/galen/{name}"]
            one_by_one |= policy
    assert read_policy(POLICIES / "galen.policy.xml") == one_by_one


def test_what_is_asked_for_is_what_is_offered():
    """A misspelled service in a caller's policy would only be found on the robot."""
    rules = [
        rules
        for nodes in read_policy(POLICIES / "galen.policy.xml").values()
        for rules in nodes.values()
    ]
    for asked, offered in (("request", "reply"), ("call", "execute"), ("subscribe", "publish")):
        has = set().union(*(one[offered] for one in rules)) | {f"/{name}" for name in OUTSIDE}
        assert set().union(*(one[asked] for one in rules)) <= has, asked


def test_only_who_moves_the_arm_may():
    movers = {
        node
        for nodes in read_policy(POLICIES / "galen.policy.xml").values()
        for node, rules in nodes.items()
        if "/joint_trajectory" in rules["publish"]
    }
    assert movers == {"calibration", "collection"}
