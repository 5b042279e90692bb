# SPDX-License-Identifier: Apache-2.0
"""The recorder over real rclpy: bytes and times as they came, topics as they come, its ends."""

import json
import os
import signal
import time
from types import SimpleNamespace
from typing import Any

import pytest
from bags_samples import messages_by_topic, read_by_rosbags
from bags_wait import wait_for
from diagnostic_msgs.msg import DiagnosticArray
from galen_bags.formats.bag import open_bag, robot_description
from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.ros import record as record_command
from galen_bags.ros.record import RecordRun, parse
from galen_bags.ros.recorder import RecorderNode, SimulatedTimes
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_ros.messages import LATCHED, STREAM
from galen_ros.node.diagnostics import Level
from galen_ros.node.testing import Harness
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from galen_msgs.msg import DeflectionStamped

S = 1_000_000_000
SIM_TIME = {"parameter_overrides": [Parameter("use_sim_time", value=True)]}
NAMES = ("delta_x", "delta_y", "delta_z", "roll", "tilt")


def wrench(index):
    return wrench_bytes("ft_sensor").fill(S + index, [float(index)] * 6)


def joints(index):
    return joint_state_bytes(NAMES).fill(S + index, [0.5 * index] * 5, [0.0] * 5)


@pytest.fixture
def harness():
    with Harness(lambda context: SingleThreadedExecutor(context=context)) as world:
        yield world


@pytest.fixture
def bag(tmp_path):
    with GrowingBagWriter(tmp_path / "bag") as opened:
        yield opened


def start(harness, bag, topics, **options):
    return harness.add(lambda context: RecorderNode(bag, topics, context=context, **options))


def publisher(harness, kind, name, qos=STREAM):
    node = harness.add(lambda context: Node("source", context=context))
    return node.create_publisher(kind, name, qos)


def connected(harness, *publishers):
    harness.wait_for(
        lambda: all(p.get_subscription_count() for p in publishers), 10.0, "the recorder to listen"
    )


def wait_recorded(harness, recorder, count):
    harness.wait_for(lambda: recorder.messages == count, 10.0, f"{count} messages in the bag")


def end(harness, recorder, bag):
    harness.remove(recorder)
    bag.__exit__(None, None, None)
    return bag.path


def test_by_default_the_arm_s_description_is_recorded(harness, bag):
    publisher(harness, String, "robot_description", LATCHED).publish(String(data="<robot/>"))
    recorder = harness.add(lambda context: RecorderNode(bag, context=context))
    wait_recorded(harness, recorder, 1)
    with open_bag(end(harness, recorder, bag)) as whole:
        assert robot_description(whole) == "<robot/>"


@pytest.mark.parametrize(("duration_s", "end_s"), [("2", 10.0), ("20", 20.0)])
def test_the_duration_ends_it_where_nothing_comes(tmp_path, monkeypatch, duration_s, end_s):
    now_s = [100.0]
    monkeypatch.setattr(record_command.time, "monotonic", lambda: now_s[0])
    options = parse(["-o", str(tmp_path / "bag"), "--duration-s", duration_s])
    run, node = RecordRun(options), SimpleNamespace(messages=0)
    with run.bag:
        for after_s, over in ((end_s - 0.1, False), (end_s, True)):
            now_s[0] = 100.0 + after_s
            assert run._done(node) is over
    assert run._ended_by == "duration"


def test_bytes_are_as_they_came(harness, bag):
    recorder = start(harness, bag, ("wrench_raw", "joint_states", "never"))
    wrenches = publisher(harness, WrenchStamped, "wrench_raw")
    states = publisher(harness, JointState, "joint_states")
    connected(harness, wrenches, states)
    before_ns = time.time_ns()
    for index in range(200):
        wrenches.publish(wrench(index))
        states.publish(joints(index))
    wait_recorded(harness, recorder, 400)
    after_ns = time.time_ns()
    assert recorder.problems() == {"/never": "no publisher was found"}
    path = end(harness, recorder, bag)
    assert messages_by_topic(path) == {
        "/wrench_raw": [wrench(index) for index in range(200)],
        "/joint_states": [joints(index) for index in range(200)],
    }
    times = [sample.log_time_ns for sample in read_by_rosbags(path)]
    assert before_ns <= min(times) and max(times) <= after_ns


def test_a_type_of_our_own_is_recorded_with_its_definition(harness, bag):
    recorder = start(harness, bag, ("deflection",))
    deflections = publisher(harness, DeflectionStamped, "deflection")
    connected(harness, deflections)
    message = DeflectionStamped(extrapolated=True)
    message.translation.x = 0.25
    deflections.publish(message)
    wait_recorded(harness, recorder, 1)
    (offer,) = recorder.get_publishers_info_by_topic("/deflection")
    path = end(harness, recorder, bag)
    with Reader(path) as reader:
        ((connection, _, data),) = reader.messages()
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        read = types.deserialize_cdr(data, connection.msgtype)
        assert connection.digest == str(offer.topic_type_hash)
    assert (read.translation.x, read.extrapolated) == (0.25, True)


def test_late_topics_of_any_quality_of_service_are_taken_up(harness, bag):
    recorder = start(harness, bag, ("/latched", "sensor"))
    harness.wait_for(lambda: len(recorder.problems()) == 2, 5.0, "two topics missing")
    latched = publisher(harness, String, "latched", LATCHED)
    latched.publish(String(data="before"))
    sensor = publisher(harness, WrenchStamped, "sensor", qos_profile_sensor_data)
    connected(harness, latched, sensor)
    sensor.publish(wrench(1))
    wait_recorded(harness, recorder, 2)
    assert recorder.problems() == {}
    path = end(harness, recorder, bag)
    assert messages_by_topic(path)["/sensor"] == [wrench(1)]
    with Reader(path) as reader:
        offers = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert offers["/latched"].durability is QosDurability.TRANSIENT_LOCAL
    assert offers["/latched"].reliability is QosReliability.RELIABLE
    assert offers["/sensor"].reliability is QosReliability.BEST_EFFORT


def test_topics_without_a_publisher_are_said_at_once_and_when_they_appear(harness, bag, capfd):
    heard: list[str] = []

    def wait_for(words):
        def said():
            heard.append(capfd.readouterr().err)
            return words in "".join(heard)

        harness.wait_for(said, 10.0, words)

    publisher(harness, JointState, "joint_states")
    start(harness, bag, ("joint_states", "wrench_raw", "imu"), **SIM_TIME)
    wait_for("no publisher on /wrench_raw, /imu, /clock, without which nothing is written: waiting")
    publisher(harness, WrenchStamped, "wrench_raw")
    wait_for("recording /wrench_raw (geometry_msgs/msg/WrenchStamped)")
    assert "".join(heard).count("no publisher on") == 1


def test_all_takes_what_there_is_but_hidden_topics(harness, bag):
    recorder = harness.add(lambda context: RecorderNode(bag, all_topics=True, context=context))
    wrenches = publisher(harness, WrenchStamped, "left/wrench_raw")
    hidden = publisher(harness, WrenchStamped, "left/_secret")
    connected(harness, wrenches)
    wrenches.publish(wrench(3))
    harness.wait_for(
        lambda: any(t.name == "/left/wrench_raw" and t.messages for t in recorder.counts_by_topic),
        10.0,
        "the message",
    )
    assert hidden.get_subscription_count() == 0
    assert messages_by_topic(end(harness, recorder, bag))["/left/wrench_raw"] == [wrench(3)]


def test_what_can_not_be_recorded_does_not_disturb_the_rest(harness, bag, monkeypatch):
    def uninstalled(type_name):
        if type_name == "std_msgs/msg/String":
            raise BagError(f"the type {type_name} is not installed here")
        return WrenchStamped

    monkeypatch.setattr("galen_bags.ros.recorder.message_class", uninstalled)
    recorder = start(harness, bag, ("wrench_raw", "strange"))
    wrenches = publisher(harness, WrenchStamped, "wrench_raw")
    strange = publisher(harness, String, "strange")
    connected(harness, wrenches)
    strange.publish(String(data="x"))
    wrenches.publish(wrench(0))
    wait_recorded(harness, recorder, 1)
    harness.wait_for(recorder.problems, 5.0, "the topic to be reported")
    reason = "not recorded: the type std_msgs/msg/String is not installed here"
    assert recorder.problems() == {"/strange": reason}
    assert list(messages_by_topic(end(harness, recorder, bag))) == ["/wrench_raw"]


def test_lost_messages_are_counted(harness, bag):
    """A burst that the queue of 2000 can't hold, while the recorder has no time for it."""
    recorder = start(harness, bag, ("wrench_raw",))
    wrenches = publisher(harness, WrenchStamped, "wrench_raw")
    connected(harness, wrenches)
    wrenches.publish(wrench(0))
    wait_recorded(harness, recorder, 1)
    harness.call_in_executor(lambda: [wrenches.publish(wrench(k)) for k in range(1, 2501)])
    (counts,) = recorder.counts_by_topic
    harness.wait_for(lambda: counts.messages + counts.lost == 2501, 10.0, "all accounted for")
    assert counts.lost > 0
    assert recorder.problems() == {
        "/wrench_raw": f"{counts.lost} of its messages were lost on the way"
    }
    found = messages_by_topic(end(harness, recorder, bag))["/wrench_raw"]
    assert found[-1] == wrench(2500)
    assert len(found) == counts.messages


def test_log_times_are_simulated_time_where_asked(harness, bag):
    recorder = start(harness, bag, ("wrench_raw",), **SIM_TIME)
    wrenches = publisher(harness, WrenchStamped, "wrench_raw")
    clock = publisher(harness, Clock, "/clock")
    connected(harness, wrenches, clock)
    wrenches.publish(wrench(0))
    harness.wait_for(lambda: "/clock" in recorder.problems(), 5.0, "the early message to be left")
    message = Clock()
    message.clock.sec = 77
    clock.publish(message)
    harness.wait_for(lambda: recorder.get_clock().now().nanoseconds == 77 * S, 5.0, "the time")
    wrenches.publish(wrench(1))
    wait_recorded(harness, recorder, 1)
    path = end(harness, recorder, bag)
    assert read_by_rosbags(path) == [("/wrench_raw", 77 * S, wrench(1))]


def test_the_bag_changes_and_no_message_is_lost(harness, bag, tmp_path):
    recorder = start(harness, bag, ("wrench_raw",))
    wrenches = publisher(harness, WrenchStamped, "wrench_raw")
    connected(harness, wrenches)
    wrenches.publish(wrench(0))
    wait_recorded(harness, recorder, 1)
    with GrowingBagWriter(tmp_path / "second") as second:
        harness.call_in_executor(lambda: [wrenches.publish(wrench(k)) for k in range(1, 20)])
        written = harness.call_in_executor(lambda: recorder.change_bag(second))
        bag.__exit__(None, None, None)
        first = messages_by_topic(bag.path)["/wrench_raw"]
        assert len(first) == written
        wrenches.publish(wrench(20))
        wait_recorded(harness, recorder, 21 - written)
        harness.remove(recorder)
    then = messages_by_topic(second.path)["/wrench_raw"]
    assert [*first, *then] == [wrench(k) for k in range(21)]


def test_between_two_looks_the_simulated_clock_runs_evenly():
    times = SimulatedTimes()
    assert times.at(5) == 0  # it is not known yet
    times.look(1000, 0)
    times.look(2000, 77 * S)
    assert times.at(1500) == 77 * S  # nor was it before
    times.look(3000, 77 * S + 4000)
    assert [times.at(wall) for wall in (1500, 2000, 2250, 3000, 3001)] == [
        77 * S, 77 * S, 77 * S + 1000, 77 * S + 4000, 77 * S + 4000
    ]  # fmt: skip
    times.look(4000, 77 * S + 4000)  # it stands still
    assert times.at(3500) == 77 * S + 4000
    times.look(5000, S)  # it began anew
    assert times.at(4500) == S


def test_diagnostics_tell_what_is_missing(harness, bag):
    recorder = start(harness, bag, ("wrench_raw", "joint_states"))
    first = publisher(harness, WrenchStamped, "wrench_raw")
    second = publisher(harness, WrenchStamped, "wrench_raw")
    heard: list[Any] = []
    probe = harness.add(lambda context: Node("probe", context=context))
    probe.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.extend(m.status), 10)
    connected(harness, first, second)
    first.publish(wrench(0))

    wanted = ("/joint_states: no publisher was found", "/wrench_raw: it had 2 publishers")

    def told():
        return [status for status in heard if all(words in status.message for words in wanted)]

    (status, *_) = harness.wait_for(told, 10.0, "a warning")
    assert status.level == bytes([Level.WARN])
    end(harness, recorder, bag)


# --- the command ------------------------------------------------------------------------------


SOURCE = """
import sys
import rclpy
from galen_common.cdr import wrench_bytes
from galen_ros.messages import STREAM
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node

rclpy.init()
node = Node("source")
publisher = node.create_publisher(WrenchStamped, "wrench_raw", STREAM)
index = 0
def publish():
    global index
    publisher.publish(wrench_bytes("ft_sensor").fill(10**9 + index, [float(index)] * 6))
    index += 1
node.create_timer(0.002, publish)
rclpy.spin(node)
"""


def record(started, path, *options):
    return started("-m", "galen_bags.ros.record", "wrench_raw", "-o", str(path), *options)


def wait_growing(path, size_bytes=4000):
    file = path / f"{path.name}.mcap"
    wait_for(lambda: file.exists() and file.stat().st_size >= size_bytes, "a message in the bag")


def check_run_of_wrenches(found):
    """A run without gaps of what the source publishes, counted from some number."""
    first = int.from_bytes(found[0][8:12], "little")  # nanoseconds of the stamp
    assert found == [wrench(first + k) for k in range(len(found))]


@pytest.mark.slow
@pytest.mark.parametrize("limit", [(), ("--duration-s", "1")], ids=["signal", "duration"])
def test_a_signal_or_the_duration_closes_the_bag(started, tmp_path, limit):
    started("-c", SOURCE)
    recorder = record(started, tmp_path / "bag", "--json", *limit)
    if not limit:
        wait_growing(tmp_path / "bag")
        recorder.send_signal(signal.SIGTERM)
    out, err = recorder.communicate(timeout=20.0)
    assert recorder.returncode == 0, err
    result = json.loads(out)
    found = messages_by_topic(tmp_path / "bag")["/wrench_raw"]
    check_run_of_wrenches(found)
    assert result["ended_by"] == ("duration" if limit else "signal")
    assert result["messages"] == result["topics"][0]["messages"] == len(found)
    assert result["problems"] == {}
    with open_bag(tmp_path / "bag") as whole:
        assert whole.problems == []


@pytest.mark.slow
def test_a_kill_leaves_all_but_the_last_second(started, tmp_path):
    started("-c", SOURCE)
    recorder = record(started, tmp_path / "bag")
    wait_growing(tmp_path / "bag", 20_000)
    killed_ns = time.time_ns()
    os.kill(recorder.pid, signal.SIGKILL)
    recorder.wait(timeout=20.0)
    with open_bag(tmp_path / "bag") as cut:
        assert any("cut off" in problem for problem in cut.problems)
        blocks = list(cut.blocks(["/wrench_raw"]))
    check_run_of_wrenches([block.message(k) for block in blocks for k in range(len(block))])
    assert killed_ns - max(block.log_time_ns.max() for block in blocks) < 5 * S  # 1 s and a stall


@pytest.mark.slow
def test_a_full_disk_ends_it_with_one_line(started, tmp_path):
    """A limit on the size of files stands in for the disk: the system rejects the write."""
    program = (
        "import resource, sys; from galen_bags.ros.record import main;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000));"
        f"sys.argv = ['record', 'wrench_raw', '-o', {str(tmp_path / 'bag')!r}]; sys.exit(main())"
    )
    started("-c", SOURCE)
    recorder = started("-c", program)
    out, err = recorder.communicate(timeout=60.0)
    assert recorder.returncode == 1
    (line,) = [text for text in err.splitlines() if text.startswith("record:")]
    assert "bag: can't be written any more: File too large" in line
    assert "Traceback" not in err
    assert "/wrench_raw" in out
    with open_bag(tmp_path / "bag") as cut:
        blocks = list(cut.blocks(["/wrench_raw"]))
        assert all("breaks off" not in problem for problem in cut.problems)
    found = [block.message(k) for block in blocks for k in range(len(block))]
    check_run_of_wrenches(found)
    assert f"{tmp_path / 'bag'}: {len(found)} messages" in out


def test_wrong_arguments_are_said(capsys):
    for arguments, said in (
        (["/a b"], "'/a b' is no name of a topic: topic name must not contain"),
        (["-a", "wrench_raw"], "--all records all topics"),
        (["--duration-s", "0"], "0 is not above 0"),
    ):
        with pytest.raises(SystemExit, match="2"):
            parse(arguments)
        assert said in capsys.readouterr().err.splitlines()[-1]
