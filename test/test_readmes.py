# SPDX-License-Identifier: Apache-2.0
"""The reference's `docs/interfaces.yaml` against the nodes; a README for each package."""

import importlib
import re
from pathlib import Path

import pytest
import yaml
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter, GrowingBagWriter
from galen_bags.ros.player import PlayerNode, PlayOptions
from galen_bags.ros.recorder import RecorderNode
from galen_calibration_behavior.ros.node import CalibrationNode
from galen_common.cdr import wrench_bytes
from galen_common.parameters import param_fields
from galen_deflection.ros.collection_node import CollectionNode
from galen_deflection.ros.node import DeflectionNode
from galen_gravcomp.ros.node import GravcompNode
from galen_panel.ros.suite import RosSuite
from galen_ros.node.testing import Harness, parameters
from galen_sim_driver.ros.node import SimDriverNode
from rclpy.node import Node

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("*/package.xml"))
INTERFACES = yaml.safe_load((ROOT / "docs" / "interfaces.yaml").read_text())


def recorder_node(folder, **options):
    return RecorderNode(GrowingBagWriter(folder / "new").__enter__(), **options)


def player_node(folder, **options):
    with BagWriter(folder / "bag") as bag:
        topic = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        bag.write(topic, 1, wrench_bytes("ft_sensor").fill(1, [0.0] * 6))
    return PlayerNode(open_bag(folder / "bag"), PlayOptions(wait_for_subscribers_s=1e6), **options)


NODES = {
    "calibration_node": lambda _, **options: CalibrationNode(**options),
    "collection_node": lambda _, **options: CollectionNode(**options),
    "deflection_node": lambda _, **options: DeflectionNode(**options),
    "gravcomp_node": lambda _, **options: GravcompNode(**options),
    "sim_driver_node": lambda _, **options: SimDriverNode(**options),
    "record": recorder_node,
    "play": player_node,
}
OVERRIDES = {"sim_driver_node": {"speed_factor": 2.0}}  # at another speed there is /clock
TRACKER = {"tracker/tool_pose", "tracker/base_pose"}
# Opened only while the node works on a goal, for a parameter, or for a topic of the bag.
WHILE_BUSY = {
    "calibration_node": {"joint_states", "wrench_raw"},
    "collection_node": {"joint_states", "wrench_compensated", "wrench_raw", *TRACKER},
    "gravcomp_node": {"imu"},  # with the parameter motion
    "record": {"joint_states", "wrench_raw", "wrench_compensated", "/clock", *TRACKER},
    "play": {"joint_states", "wrench_compensated", *TRACKER},
}
# What rclpy itself gives every node, and every managed one.
RCLPY = re.compile(
    r"^/(parameter_events|rosout)$|_parameters?(_types|_atomically)?$|type_description$"
    r"|/(change_state|get_state|get_available_(states|transitions)|get_transition_graph"
    r"|transition_event)$"
)
RCLPY_PARAMETERS = {"use_sim_time", "start_type_description_service"}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_has_a_readme(package):
    assert (ROOT / package / "README.md").read_text().startswith(f"# {package}\n")


def documented(node):
    """A node's interfaces as the reference has them: {name: type}."""
    return {name: kind for name, kind, *_ in INTERFACES[node]["interfaces"]}


def documented_parameters(node):
    classes = (path.rpartition(".") for path in INTERFACES[node]["parameters"])
    return {
        name
        for module, _, cls in classes
        for name in param_fields(getattr(importlib.import_module(module), cls))
    }


def plain(kind):
    """A type without the folder of its package that its definition lies in."""
    return re.sub(r"/(msg|srv|action)/", "/", kind)


def in_use(node, name=None):
    """What the graph knows of a node: {name: type}, names as the reference writes them.

    name: of another one that it sees.
    """
    name, space = name or node.get_name(), node.get_namespace()
    graph = (
        node.get_publisher_names_and_types_by_node(name, space)
        + node.get_subscriber_names_and_types_by_node(name, space)
        + node.get_service_names_and_types_by_node(name, space)
        + node.get_client_names_and_types_by_node(name, space)
    )
    found = {}
    for full, kinds in graph:
        if RCLPY.search(full):
            continue
        if "/_action/" in full:
            short, kind = full.split("/_action/")[0], plain(kinds[0])
            if kind.endswith("_SendGoal"):
                found[short.removeprefix("/")] = kind.removesuffix("_SendGoal")
            continue
        short = full.replace(f"/{name}/", "~/", 1) if full.startswith(f"/{name}/") else full
        if full not in ("/diagnostics", "/clock"):
            short = short.removeprefix("/")
        found[short] = plain(kinds[0])
    return found


@pytest.mark.parametrize("name", sorted(NODES))
def test_the_reference_has_a_nodes_interfaces_and_parameters(name, tmp_path):
    values = parameters(**OVERRIDES.get(name, {}))
    with Harness() as harness:
        node = harness.add(
            lambda context: NODES[name](tmp_path, context=context, parameter_overrides=values)
        )
        code = harness.wait_for(lambda: in_use(node), 10.0, "the node's graph")
        # what `ros2 param dump` does; a node's own attribute can hide rclpy's of the same name
        held = node.get_parameters_by_prefix("")
    assert {p.value is not None for p in held.values()} == {True}
    assert set(held) - RCLPY_PARAMETERS == documented_parameters(name)
    reference = documented(name)
    assert code.items() <= reference.items(), "in the code, not in the reference"
    assert set(reference) - set(code) <= WHILE_BUSY.get(name, set()), "in the reference alone"


def test_the_reference_has_the_panels_interfaces(monkeypatch):
    with Harness() as harness:
        probe = harness.add(lambda context: Node("probe", context=context))
        monkeypatch.setenv("ROS_DOMAIN_ID", str(harness.domain_id))
        wanted = documented("panel")
        with RosSuite(["panel"]) as suite, suite.watch():

            def seen():
                names = [name for name in probe.get_node_names() if name.startswith("panel")]
                return {key: kind for name in names for key, kind in in_use(probe, name).items()}

            harness.wait_for(lambda: set(seen()) >= set(wanted), 10.0, "all that is documented")
            assert seen() == wanted
