"""The layouts for Foxglove and PlotJuggler name topics and fields that are there."""

import json
import re
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree

import pytest
from galen_model.arm.galen import JOINT_NAMES
from rosidl_parser.definition import AbstractNestedType, BasicType, NamespacedType

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "galen_bringup" / "config"
# | `name` | package/Type | or | `name` | package/msg/Type |
ROW = re.compile(r"^\| `([\w/~]+)` \| (\w+)/(?:\w+/)?(\w+) \| ([^|]*)", re.MULTILINE)
NUMBERS = {"double", "float", "boolean"}


def offered():
    """{full name: (package, type, meaning)} of the tables in the packages' READMEs."""
    found = {}
    for readme in ROOT.glob("galen_*/README.md"):
        node = readme.parent.name.removeprefix("galen_")
        for name, package, kind, direction in ROW.findall(readme.read_text(encoding="utf-8")):
            name = name.replace("~", node) if name.startswith("~") else name
            found[f"/{name.lstrip('/')}"] = (package, kind, direction)
    return found


def interface(package, what, name):
    """The class of a message or service."""
    return getattr(import_module(f"{package}.{what}"), name)


def type_of(topic, separators, field):
    """Type of a field, as in `wrench.force.x` or `position[3]`."""
    package, kind, _ = offered()[topic]
    found = interface(package, "msg", kind)
    parts = re.split(separators, field)
    for index, part in enumerate(parts):
        name, _, place = part.partition("[")
        slots = dict(zip(found.get_fields_and_field_types(), found.SLOT_TYPES, strict=True))
        kind = slots[name]
        if place:
            assert isinstance(kind, AbstractNestedType), field
            kind = kind.value_type
        if index + 1 == len(parts):
            return kind
        assert isinstance(kind, NamespacedType), field
        found = interface(kind.namespaces[0], "msg", kind.name)
    raise AssertionError(field)


def assert_number(kind):
    assert isinstance(kind, BasicType) and kind.typename in NUMBERS, kind


def panels(layout):
    """The panels that a layout shows, in its tabs, too."""
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column") and 0 < layout["splitPercentage"] < 100
    return panels(layout["first"]) + panels(layout["second"])


@pytest.fixture(scope="module")
def foxglove():
    return json.loads((CONFIG / "galen.foxglove.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def plotjuggler():
    return ElementTree.parse(CONFIG / "galen.plotjuggler.xml").getroot()


def test_foxglove_shows_each_panel_once(foxglove):
    shown = panels(foxglove["layout"])
    for panel in list(shown):
        for tab in foxglove["configById"][panel].get("tabs", []):
            shown += panels(tab["layout"])
    assert sorted(shown) == sorted(foxglove["configById"])


def test_foxglove_plots_fields_that_are_there(foxglove):
    plotted = set()
    for name, config in foxglove["configById"].items():
        for path in config.get("paths", []):
            topic, _, field = path["value"].partition(".")
            assert_number(type_of(topic, r"\.", field))
            plotted.add(topic)
            if topic == "/joint_states":
                place = int(re.fullmatch(r"position\[(\d)\]", field)[1])
                assert JOINT_NAMES[place] == path["label"]
        for topic in config.get("topics", {}):
            assert topic in offered(), name
        for key in ("topicPath", "topicToRender"):
            assert config.get(key, "/diagnostics") in offered(), name
    assert plotted == {"/wrench_raw", "/wrench_compensated", "/deflection", "/joint_states"}


def test_foxglove_calls_services_that_are_there(foxglove):
    called = set()
    for name, config in foxglove["configById"].items():
        if name.startswith("CallService!"):
            package, kind, direction = offered()[config["serviceName"]]
            assert direction.strip() == "service"
            interface(package, "srv", kind).Request(**json.loads(config["requestPayload"]))
            called.add(config["serviceName"])
    assert called == {"/gravcomp/enable", "/gravcomp/set_tool", "/gravcomp/tare"}


def test_plotjuggler_plots_fields_that_are_there(plotjuggler):
    (selected,) = (entry.get("value") for entry in plotjuggler.iter("selected_topics"))
    plotted = set()
    for curve in plotjuggler.iter("curve"):
        (topic,) = (
            topic for topic in selected.split(";") if curve.get("name").startswith(topic + "/")
        )
        field = curve.get("name").removeprefix(topic + "/")
        if topic == "/joint_states":  # by the joint's name, not by its place
            joint, _, field = field.partition("/")
            assert joint in JOINT_NAMES
            field += "[0]"
        assert_number(type_of(topic, "/", field))
        plotted.add(topic)
    assert plotted == set(selected.split(";"))


def test_plotjuggler_finds_as_many_plots_as_it_counts(plotjuggler):
    """It splits a plot as often as `count` says, and fills what it finds below into these."""
    splitters = list(plotjuggler.iter("DockSplitter"))
    assert splitters
    for splitter in splitters:
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))
    for area in plotjuggler.iter("DockArea"):
        assert [child.tag for child in area] == ["plot"]
    (plugin,) = plotjuggler.iter("plugin")
    (streamer,) = plotjuggler.iter("previouslyLoaded_Streamer")
    assert plugin.get("ID") == streamer.get("name") == "ROS2 Topic Subscriber"
