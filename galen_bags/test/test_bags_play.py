# SPDX-License-Identifier: Apache-2.0
"""The player over real rclpy: what goes out, in which order, and how it ends."""

import json
import signal
import sys
from functools import cache

import pytest
from bags_samples import messages_by_topic
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import BagWriter, GrowingBagWriter
from galen_bags.ros.play import main
from galen_bags.ros.player import PlayerNode, PlayOptions
from galen_bags.ros.recorder import RecorderNode
from galen_bags.ros.topics import definition_of, to_bag
from galen_common.cdr import wrench_bytes
from galen_ros.messages import LATCHED, STREAM
from galen_ros.node.testing import Harness
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import SetBool

from galen_msgs.msg import DeflectionStamped

S = 1_000_000_000
MS = 1_000_000
START = 500 * S
WRENCH = "geometry_msgs/msg/WrenchStamped"
DEFLECTION = "galen_msgs/msg/DeflectionStamped"


def wrench(index):
    return wrench_bytes("ft_sensor").fill(7 * S + index, [float(index)] * 6)


@cache
def deflection(index):
    """The same bytes each time: what rclpy leaves between a text and a number is by chance."""
    message = DeflectionStamped()
    message.translation.x = float(index)
    return bytes(serialize_message(message))


def log_ns(index):
    return START + 2 * MS * index


@pytest.fixture
def path(tmp_path):
    """A bag of 100 wrenches and deflections in turn, 2 ms apart, and a topic without messages."""
    with BagWriter(tmp_path / "bag") as bag:
        wrenches = bag.add_topic("wrench_raw", WRENCH)
        deflections = bag.add_topic("deflection", DEFLECTION, definition_of(DEFLECTION))
        bag.add_topic("empty", WRENCH)
        for index in range(0, 100, 2):
            bag.write(wrenches, log_ns(index), wrench(index))
            bag.write(deflections, log_ns(index + 1), deflection(index + 1))
    return tmp_path / "bag"


@pytest.fixture
def harness():
    with Harness() as world:
        yield world


@pytest.fixture
def opened(path):
    with open_bag(path) as bag:
        yield bag


class Listener(Node):
    """Hears all, as bytes, in the order in which one queue gets it."""

    def __init__(self, *topics, qos=STREAM, **options):
        super().__init__("listener", **options)
        self.heard: dict[str, list[bytes]] = {}
        self.clock_ns: list[int] = []
        self.listening = [
            self.create_subscription(
                DeflectionStamped if topic.endswith("deflection") else WrenchStamped,
                topic,
                self.heard.setdefault(topic, []).append,
                qos,
                raw=True,
            )
            for topic in topics
        ]
        self.create_subscription(
            Clock,
            "/clock",
            lambda m: self.clock_ns.append(m.clock.sec * S + m.clock.nanosec),
            STREAM,
        )


def listen(harness, *topics):
    return harness.add(lambda context: Listener(*topics, context=context))


def play(harness, bag, options, **more):
    return harness.add(lambda context: PlayerNode(bag, options, context=context, **more))


def to_the_end(harness, player):
    harness.wait_for(lambda: player.done, 20.0, "the end")


def test_the_clock_is_the_bags_log_time(harness, opened):
    listener = listen(harness, "wrench_raw")
    player = play(harness, opened, PlayOptions(rate=0.5))
    to_the_end(harness, player)
    harness.wait_for(lambda: listener.clock_ns[-1:] == [log_ns(99)], 5.0, "the last time")
    assert listener.clock_ns[0] >= START
    assert listener.clock_ns == sorted(listener.clock_ns)
    assert len(set(listener.clock_ns)) > 5


def test_a_part_and_some_topics(harness, opened):
    listener = listen(harness, "wrench_raw", "deflection")
    options = PlayOptions(
        topics=("wrench_raw",), start_offset_s=0.02, playback_duration_s=0.04, rate=2.0
    )
    player = play(harness, opened, options)
    to_the_end(harness, player)
    wanted = [wrench(index) for index in range(10, 31, 2)]
    harness.wait_for(lambda: listener.heard["wrench_raw"] == wanted, 5.0, "the part")
    assert player.length_s == pytest.approx(0.04)
    assert listener.heard["deflection"] == []


def test_a_pause_holds_it(harness, opened):
    listener = listen(harness, "wrench_raw")
    player = play(harness, opened, PlayOptions(rate=0.1))
    client = listener.create_client(SetBool, "/player/pause")
    harness.wait_for(lambda: player.state == "playing", 5.0, "the start")
    assert harness.call(client, SetBool.Request(data=True)).success
    assert player.state == "paused"
    heard, ticks = len(listener.heard["wrench_raw"]), len(listener.clock_ns)
    harness.wait_for(lambda: len(listener.clock_ns) > ticks + 5, 5.0, "a clock that stands")
    assert len(set(listener.clock_ns[ticks + 1 :])) == 1
    assert len(listener.heard["wrench_raw"]) <= heard + 1 < 50
    assert harness.call(client, SetBool.Request(data=False)).success
    to_the_end(harness, player)
    harness.wait_for(lambda: len(listener.heard["wrench_raw"]) == 50, 5.0, "the rest")


def test_it_waits_for_subscribers(harness, opened):
    player = play(harness, opened, PlayOptions(wait_for_subscribers_s=30.0))
    first = listen(harness, "wrench_raw")
    harness.wait_for(lambda: player.count_subscribers("wrench_raw"), 5.0, "the first")
    assert player.state == "waiting"
    second = listen(harness, "deflection")
    to_the_end(harness, player)
    for listener, topic in ((first, "wrench_raw"), (second, "deflection")):
        harness.wait_for(
            lambda heard=listener.heard[topic]: len(heard) == 50, 5.0, f"all of {topic}"
        )


def test_a_loop_begins_again(harness, opened):
    listener = listen(harness, "wrench_raw")
    player = play(harness, opened, PlayOptions(loop=True, rate=10.0))
    harness.wait_for(lambda: player.published["/wrench_raw"] > 120, 20.0, "three rounds")
    harness.remove(player)
    once = [wrench(index) for index in range(0, 100, 2)]
    assert listener.heard["wrench_raw"][:120] == (once * 3)[:120]


def test_quality_of_service_is_the_recorded_one(harness, tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        text = bag.add_topic("text", "std_msgs/msg/String", qos=(to_bag(LATCHED),))
        bag.write(text, START, bytes(serialize_message(String(data="late"))))
    with open_bag(tmp_path / "bag") as bag:
        player = play(harness, bag, PlayOptions())
        to_the_end(harness, player)
        heard: list[str] = []
        late = harness.add(lambda context: Node("late", context=context))
        late.create_subscription(String, "text", lambda m: heard.append(m.data), LATCHED)
        harness.wait_for(lambda: heard == ["late"], 5.0, "a latched message")


def test_types_that_are_not_installed_are_left_out(harness, opened, monkeypatch):
    def uninstalled(type_name):
        if type_name == DEFLECTION:
            raise BagError(f"the type {type_name} is not installed here")
        return WrenchStamped

    monkeypatch.setattr("galen_bags.ros.player.message_class", uninstalled)
    player = play(harness, opened, PlayOptions(rate=10.0))
    to_the_end(harness, player)
    assert player.left_out == {"/deflection": f"the type {DEFLECTION} is not installed here"}
    assert player.published == {"/empty": 0, "/wrench_raw": 50}


def test_a_part_without_messages_is_an_error(harness, opened):
    play(harness, opened, PlayOptions(start_offset_s=10.0))
    with pytest.raises(BagError, match="holds no message in the part"):
        harness.wait_for(lambda: False, 5.0, "an error")


def test_record_of_a_replay_is_the_bag_again(opened, tmp_path):
    """Play into a recorder: the new bag holds the same messages, byte for byte."""
    with (
        Harness(lambda context: SingleThreadedExecutor(context=context)) as harness,
        GrowingBagWriter(tmp_path / "again") as again,
    ):
        topics = ("wrench_raw", "deflection")
        recorder = harness.add(lambda context: RecorderNode(again, topics, context=context))
        player = play(harness, opened, PlayOptions(wait_for_subscribers_s=10.0, rate=0.5))
        to_the_end(harness, player)
        assert player.acknowledged
        assert player.published == {"/deflection": 50, "/empty": 0, "/wrench_raw": 50}
        harness.wait_for(lambda: recorder.messages == 100, 10.0, "100 messages")
        harness.remove(recorder)
    assert messages_by_topic(tmp_path / "again") == {
        "/wrench_raw": [wrench(index) for index in range(0, 100, 2)],
        "/deflection": [deflection(index) for index in range(1, 100, 2)],
    }


# --- the command ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_plays_to_the_end(started, path):
    options = ("--json", "-r", "2", "--no-clock", "--ros-args", "-r", "wrench_raw:=x")
    player = started("-m", "galen_bags.ros.play", str(path), *options)
    out, err = player.communicate(timeout=60.0)
    assert player.returncode == 0, err
    result = json.loads(out)
    assert (result["ended_by"], result["messages"], result["acknowledged"]) == ("end", 100, True)
    assert result["position_s"] == pytest.approx(0.198)


@pytest.mark.slow
def test_a_signal_ends_it(started, path):
    player = started("-m", "galen_bags.ros.play", str(path), "--loop")
    # rclpy's own handlers are not used; ours are active before the node says a word.
    player.stderr.readline()
    player.send_signal(signal.SIGTERM)
    out, _ = player.communicate(timeout=20.0)
    assert player.returncode == 143
    assert "messages published" in out


def test_mistakes_are_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["play", "nowhere"])
    assert main() == 1
    assert capsys.readouterr() == ("", "play: nowhere: is not there\n")
    monkeypatch.setattr(sys, "argv", ["play", "nowhere", "--rate", "0"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "0 is not above 0" in capsys.readouterr().err.splitlines()[-1]
