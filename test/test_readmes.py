"""The packages' READMEs against the code: parameters, topics, services and actions."""

import importlib
import re
from pathlib import Path

import pytest
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter, GrowingBagWriter
from galen_bags.player import PlayerNode, PlayOptions
from galen_bags.recorder import RecorderNode
from galen_calibration_behavior.node import CalibrationNode
from galen_deflection.collection.node import CollectionNode
from galen_deflection.node import DeflectionNode
from galen_gravcomp.node import GravcompNode
from galen_panel.ros.suite import RosSuite
from galen_ros.cdr import wrench_bytes
from galen_ros.node.testing import Harness, parameters
from galen_ros.parameters import markdown_table
from galen_sim_driver.node import SimDriverNode
from rclpy.node import Node

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("*/package.xml"))
MARKED = re.compile(r"<!-- parameters: ([\w.]+) -->\n(.*?)\n<!-- end -->", re.DOTALL)
NODES = {
    "galen_calibration_behavior": (CalibrationNode,),
    "galen_deflection": (CollectionNode, DeflectionNode),
    "galen_gravcomp": (GravcompNode,),
    "galen_sim_driver": (SimDriverNode,),
}


def recorder_node(folder, **options):
    return RecorderNode(GrowingBagWriter(folder / "new").__enter__(), **options)


def player_node(folder, **options):
    with BagWriter(folder / "bag") as bag:
        topic = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        bag.write(topic, 1, wrench_bytes("ft_sensor").fill(1, [0.0] * 6))
    return PlayerNode(open_bag(folder / "bag"), PlayOptions(wait_for_subscribers_s=1e6), **options)


# Nodes that need a folder to work in; they have no parameters.
BAG_NODES = {"galen_bags": (recorder_node, player_node)}
OVERRIDES = {"galen_sim_driver": {"speed_factor": 2.0}}  # at another speed there is /clock
# Opened only while the node works on a goal, or for a parameter.
WHILE_BUSY = {
    "galen_calibration_behavior": {"joint_states", "wrench_raw"},
    "galen_deflection": {
        "joint_states", "wrench_compensated", "wrench_raw", "tracker/tool_pose",
        "tracker/base_pose",
    },
    "galen_gravcomp": {"imu"},  # with the parameter motion
    "galen_bags": {
        "joint_states", "wrench_compensated", "tracker/tool_pose", "tracker/base_pose",
    },
}  # fmt: skip
# What rclpy itself gives every node, and every managed one.
RCLPY = re.compile(
    r"^/(parameter_events|rosout)$|_parameters?(_types|_atomically)?$|type_description$"
    r"|/(change_state|get_state|get_available_(states|transitions)|get_transition_graph"
    r"|transition_event)$"
)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_has_a_readme(package):
    assert (ROOT / package / "README.md").read_text().startswith(f"# {package}\n")


@pytest.mark.parametrize("package", sorted(NODES))
def test_parameter_tables_are_what_the_code_declares(package):
    tables = MARKED.findall((ROOT / package / "README.md").read_text())
    assert tables, "the README marks no parameter table"
    for name, table in tables:
        module, cls = name.rsplit(".", 1)
        assert table == markdown_table(getattr(importlib.import_module(module), cls)), name


def documented(package):
    """The interface tables' rows, of all nodes: {name: type}."""
    text = (ROOT / package / "README.md").read_text()
    tables = re.findall(
        r"^\| name \| type \| direction \| meaning \|\n\|[-|]+\|\n((?:\|.*\|\n)+)",
        text,
        re.MULTILINE,
    )
    assert tables, f"{package}: no interface table"
    rows = [row for table in tables for row in table.splitlines()]
    cells = [[cell.strip().strip("`") for cell in row.strip("|").split("|")] for row in rows]
    return {row[0]: plain(row[1]) for row in cells}


def plain(kind):
    """A type without the folder of its package that its definition lies in."""
    return re.sub(r"/(msg|srv|action)/", "/", kind)


def in_use(node, name=None):
    """What the graph knows of a node: {name: type}, names as the README writes them.

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


@pytest.mark.parametrize("package", sorted(NODES | BAG_NODES))
def test_interface_tables_are_what_the_node_has(package, tmp_path):
    values = parameters(**OVERRIDES.get(package, {}))
    makers = BAG_NODES.get(package) or [
        lambda _folder, kind=kind, **options: kind(**options) for kind in NODES[package]
    ]
    code = {}
    with Harness() as harness:
        for make in makers:
            node = harness.add(
                lambda context, make=make: make(
                    tmp_path, context=context, parameter_overrides=values
                )
            )
            code |= harness.wait_for(lambda node=node: in_use(node), 10.0, "the node's graph")
            # what `ros2 param dump` does; a node's own attribute can hide rclpy's of the same name
            held = node.get_parameters_by_prefix("").values()
            assert {p.value is not None for p in held} == {True}
    readme = documented(package)
    assert code.items() <= readme.items(), "in the code, not in the README"
    assert set(readme) - set(code) <= WHILE_BUSY.get(package, set()), "in the README alone"


def test_the_panels_interface_table_is_what_it_has(monkeypatch):
    with Harness() as harness:
        probe = harness.add(lambda context: Node("probe", context=context))
        monkeypatch.setenv("ROS_DOMAIN_ID", str(harness.domain_id))
        wanted = documented("galen_panel")
        with RosSuite(["panel"]) as suite, suite.watch():

            def seen():
                names = [name for name in probe.get_node_names() if name.startswith("panel")]
                return {key: kind for name in names for key, kind in in_use(probe, name).items()}

            harness.wait_for(lambda: set(seen()) >= set(wanted), 10.0, "all that the README names")
            assert seen() == wanted
