# SPDX-License-Identifier: Apache-2.0
"""`preflight`: each fault of a robot is found and named, and a healthy robot passes."""

import argparse
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from galen_bringup.preflight import (
    FIX,
    NOTE,
    OK,
    Check,
    Observer,
    build_parser,
    main,
    sample_checks,
)
from galen_common.stream.pairing import StreamParameters
from galen_model.arm.description import read_arm
from galen_model.load.model import Load, gravity_wrench
from galen_ros.messages import LATCHED, STREAM, fill_stamp, fill_wrench
from galen_ros.node.stream_node import input_qos
from galen_ros.node.testing import Harness
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

URDF = Path(__file__).parents[1] / "urdf/six_axis.urdf"
ARM = read_arm(URDF.read_text())
START_NS, STEP_NS = 1_700_000_000_000_000_000, 5_000_000
Edit = Callable[[JointState, WrenchStamped], object]


@functools.cache
def reading(k: int, swing: float, mass_kg: float) -> tuple[np.ndarray, np.ndarray]:
    """The k-th joints (6,) and wrench (6,) of a healthy robot that swings its tool."""
    position = 0.3 + swing * np.sin(k / 60.0 + np.arange(6))
    load = gravity_wrench(
        ARM.gravity_in_sensor(position), Load(mass_kg, np.array([0.0, 0.01, 0.05]))
    )
    noise = np.random.default_rng(k).normal(0.0, 1.0, 6)
    return position, load + noise * [0.02, 0.02, 0.02, 5e-4, 5e-4, 5e-4]


def sample(k: int, now_ns: int, swing: float = 1.0, mass_kg: float = 0.5) -> tuple[Any, Any]:
    """Its k-th pair of messages."""
    position, numbers = reading(k, swing, mass_kg)
    joints = JointState(name=list(ARM.joint_names), position=position.tolist())
    wrench = WrenchStamped()
    wrench.header.frame_id = "ft_sensor"
    fill_wrench(wrench, numbers)
    for message in (joints, wrench):
        fill_stamp(message.header.stamp, now_ns)
    return joints, wrench


Tape = list[tuple[str, int, bytes]]


def tape_of(edit: Edit = lambda *_: None, every: int = 1, **robot: float) -> Tape:
    """Return 400 pairs, each edited; `every`: of so many pairs one has joints."""
    tape = []
    for k in range(400):
        now_ns = START_NS + k * STEP_NS
        joints, wrench = sample(k, now_ns, **robot)
        edit(joints, wrench)
        if k % every == 0:
            tape.append(("joint_states", now_ns, serialize_message(joints)))
        tape.append(("wrench_raw", now_ns, serialize_message(wrench)))
    return tape


def checked(edit: Edit = lambda *_: None, every: int = 1, **robot: float) -> list[Check]:
    return sample_checks(tape_of(edit, every, **robot), ARM, StreamParameters())


def by(checks: list[Check], state: str) -> str:
    return "\n".join(" | ".join(check) for check in checks if check.state == state)


def scaled(force: float, torque: float) -> Edit:
    def edit(_: JointState, wrench: WrenchStamped) -> None:
        for part, factor in ((wrench.wrench.force, force), (wrench.wrench.torque, torque)):
            part.x, part.y, part.z = factor * part.x, factor * part.y, factor * part.z

    return edit


def degrees(joints: JointState, _: WrenchStamped) -> None:
    joints.position = np.degrees(joints.position).tolist()


def swapped(_: JointState, wrench: WrenchStamped) -> None:
    force = wrench.wrench.force
    force.x, force.y, force.z = force.z, force.x, force.y


def turned(_: JointState, wrench: WrenchStamped) -> None:
    for part in (wrench.wrench.force, wrench.wrench.torque):
        part.x, part.y = part.y, -part.x


def upside_down(_: JointState, wrench: WrenchStamped) -> None:
    for part in (wrench.wrench.force, wrench.wrench.torque):
        part.y, part.z = -part.y, -part.z


def shifted(topic: int, seconds: int) -> Edit:
    def edit(*messages: Any) -> None:
        messages[topic].header.stamp.sec += seconds

    return edit


def test_a_healthy_robot_has_nothing_to_fix_and_all_is_checked() -> None:
    checks = checked()
    assert {check.state for check in checks} == {OK}
    text = by(checks, OK)
    assert text.count("200.0 Hz, jitter 0.00 ms") == 2 and "within limits; shoulder_pan" in text
    assert "399 of 400 wrenches" in text or "400 of 400 wrenches" in text
    assert "noise 0.0" in text and "load | ok | 0.5" in text


@pytest.mark.parametrize(
    ("edit", "found"),
    [
        (lambda j, w: setattr(w.header, "stamp", Time()), "the driver does not stamp its samples"),
        (lambda j, w: setattr(j.header, "stamp", Time()), "400 of them without a stamp"),
        (lambda j, w: setattr(w.header, "frame_id", "tool0"), "has frame_id 'tool0', expected"),
        (lambda j, w: setattr(j, "name", list("abcdef")), "lacks shoulder_pan, shoulder_lift"),
        (lambda j, w: setattr(w.wrench.force, "y", np.nan), "a value that is not finite"),
        (lambda j, w: setattr(w.wrench.torque, "z", 0.25), "tz the same in all 400 messages"),
        (lambda j, w: fill_wrench(w, np.ones(6)), "fx, fy, fz, tx, ty, tz the same"),
        (lambda j, w: setattr(j, "position", [np.nan] * 6), "are all joints' encoders"),
        (degrees, "angles look like degrees | angles must be in rad"),
        (scaled(1.0, 1e3), "torque looks like N mm | torques must be in N.m"),
        (scaled(1e3, 1.0), "beyond sensor range | unload the sensor"),
        (scaled(-1.0, -1.0), "the reading is reversed: negate the wrench"),
        (swapped, "ft_sensor must have the sensing element's axes"),
        (turned, "the sensing element is turned by 90.0 deg about -z"),
        (upside_down, "180.0 deg about +x, in ft_sensor: in the driver (fx, fy, fz) := (fx, -fy"),
        (shifted(0, -1), "stamp both by one clock"),
        (shifted(1, -1), "stamp both by one clock"),
    ],
)  # fmt: skip
def test_each_fault_of_the_samples_is_named(edit: Edit, found: str) -> None:
    assert found in by(checked(edit), FIX)


@pytest.mark.parametrize("seconds", [5, -3600])
def test_a_jump_of_the_stamps_is_no_matter_of_rate(seconds: int) -> None:
    left = iter([0] * 200 + [seconds] * 200)

    def edit(*messages: Any) -> None:
        by_s = next(left)
        for message in messages:
            message.header.stamp.sec += by_s

    fix = by(checked(edit), FIX)
    assert fix.count(f"a stamp jumps by {seconds:+d}.000 s | stamps must not jump") == 2
    assert "raise the rate" not in fix


def test_a_stalled_network_is_no_jump_of_the_stamps() -> None:
    tape, stalled_until_ns = tape_of(), START_NS + 200 * STEP_NS + 3 * 10**9
    late = [
        (topic, at_ns if k < 400 else max(at_ns, stalled_until_ns), data)
        for k, (topic, at_ns, data) in enumerate(tape)
    ]
    assert "jumps by" not in by(sample_checks(late, ARM, StreamParameters()), FIX)


def test_a_few_lost_samples_are_no_fault() -> None:
    few = iter([np.nan] * 4 + [1.0] * 396)
    checks = checked(lambda _, w: setattr(w.wrench.force, "y", w.wrench.force.y * next(few)))
    assert by(checks, FIX) == "" and "396 of 400 wrenches" in by(checks, OK)
    assert "nan" not in by(checks, OK)
    assert "4 times" in by(checks, NOTE) and "not finite" in by(checks, NOTE)


def test_slow_joints_lose_wrenches_and_two_drivers_mix_their_stamps() -> None:
    text = by(checked(every=50), FIX)
    assert "joint_states | fix | 8 messages" in text and "set max_joint_age_s" in text
    turn = iter(range(800))
    two_drivers = by(checked(lambda j, _: shifted(0, -(next(turn) % 2))(j)), FIX)
    assert "and one driver" in two_drivers


def test_what_can_not_be_checked_is_a_note_with_what_to_do() -> None:
    still = checked(swing=0.0)
    assert by(still, FIX) == "" and "turn the tool by 60 degrees" in by(still, NOTE)
    compensated = checked(mass_kg=0.0)
    assert by(compensated, FIX) == "" and "is the reading compensated already?" in by(
        compensated, NOTE
    )
    late = checked(lambda j, w: (shifted(0, -3600)(j, w), shifted(1, -3600)(j, w)))
    assert by(late, FIX) == "" and "stamps 3600.000 s old at arrival" in by(late, NOTE)
    assert "is the description this robot's?" in by(checked(swing=3.0), NOTE)


# Publishers, quality of service, services: with ROS


class Robot(Node):
    """Publishes as `sample` does, 200 Hz by its stamps, whatever the machine is busy with."""

    def __init__(self, wrench_qos: Any = STREAM, description: str = "", **options: Any) -> None:
        super().__init__("robot", **options)
        self._joints = self.create_publisher(JointState, "joint_states", STREAM)
        self._wrench = self.create_publisher(WrenchStamped, "wrench_raw", wrench_qos)
        self._count, self._start_ns = 0, self.get_clock().now().nanoseconds
        self.create_timer(STEP_NS * 1e-9, self._publish)
        self.create_service(Trigger, "zero_ft_sensor", lambda _, response: response)
        self.create_subscription(JointTrajectory, "joint_trajectory", lambda _: None, 10)
        if description:
            self._description = self.create_publisher(String, "robot_description", LATCHED)
            self._description.publish(String(data=description))

    def _publish(self) -> None:
        self._count += 1
        joints, wrench = sample(self._count, self._start_ns + self._count * STEP_NS)
        self._joints.publish(joints)
        self._wrench.publish(wrench)


def observed(harness: Harness, *words: str) -> list[Check]:
    node = harness.add(lambda context: Observer(60.0, context=context))
    harness.wait_for(lambda: len(node.samples) >= 200, 20.0, "samples")
    arguments: argparse.Namespace = build_parser().parse_args(words)
    checks: list[Check] = harness.call_in_executor(lambda: node.checks(arguments))
    return checks


def test_the_command_passes_a_robot_by_its_own_description(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with Harness() as harness:
        harness.add(lambda context: Robot(description=URDF.read_text(), context=context))
        monkeypatch.setenv("ROS_DOMAIN_ID", str(harness.domain_id))
        assert main(["--seconds", "2.5", "--json"]) == 0
        found = json.loads(capfd.readouterr().out)
        text = json.dumps(found)
        assert found["ok"] is True and '"what": "load"' in text and f'"{FIX}"' not in text
        assert "six_axis: 6 joints from base_link to ft_sensor" in text
        assert "use_robot_description:=true" in text and "/joint_trajectory" in text
        assert main(["--seconds", "2.5", "--urdf", str(URDF), "--sensor-frame", "wrist"]) == 1
        out = capfd.readouterr().out
        assert "'wrist'" in out and "1 to fix" in out  # a long path may break the line anywhere
        without_clock = ("--ros-args", "-p", "use_sim_time:=true")
        for words, what, remedy in (
            (("--urdf", "nowhere.urdf"), "arm", "name an existing file: --urdf FILE"),
            (without_clock, "time", "start what publishes /clock"),
        ):
            assert main(["--seconds", "2.5", "--json", *words]) == 1
            checks = json.loads(capfd.readouterr().out)["checks"]
            (fix,) = (check for check in checks if check["state"] == FIX)
            assert fix["what"] == what and remedy in fix["remedy"]


def test_best_effort_a_second_sensor_and_a_frame_that_lacks_are_named() -> None:
    best_effort = input_qos(best_effort=True)
    bare = URDF.read_text().replace("ft_sensor", "sensing_plate_of_force")
    with Harness() as harness:
        harness.add(lambda context: Robot(best_effort, bare, context=context))
        harness.add(lambda context: Node("other", context=context)).create_publisher(
            WrenchStamped, "wrench_raw", STREAM
        )
        fix = by(observed(harness), FIX)
        assert "set best_effort_input:=true" in fix
        assert "2 publishers on /wrench_raw: /other, /robot" in fix
        assert "no frame 'ft_sensor'" in fix
        assert "--sensor-frame tool0 or sensing_plate_of_force" in fix
        frame = ("--sensor-frame", "sensing_plate_of_force")
        assert "frame_id 'ft_sensor', expected 'sensing_plate_of_force'" in by(
            observed(harness, *frame), FIX
        )


def test_without_a_driver_the_topics_of_its_type_are_offered() -> None:
    with Harness() as harness:
        idle = harness.add(lambda context: Node("idle", context=context))
        idle.create_publisher(WrenchStamped, "ft/wrench", STREAM)
        idle.create_publisher(JointState, "joint_states", STREAM)
        idle.create_publisher(String, "robot_description", 1)
        idle.create_service(
            Trigger, "arm_controller/follow_joint_trajectory/_action/send_goal", print
        )
        probe = harness.add(lambda context: Observer(60.0, context=context))
        harness.wait_for(lambda: probe.count_publishers("ft/wrench"), 10.0, "discovery")
        arguments = build_parser().parse_args([])
        checks = harness.call_in_executor(lambda: probe.checks(arguments))
    fix, note = by(checks, FIX), by(checks, NOTE)
    assert "no publisher on /wrench_raw | start the driver or remap one of /ft/wrench" in fix
    assert "joint_states | fix | no message came" in fix and "publish it transient local" in fix
    assert "nothing offers /zero_ft_sensor" in note
    assert "motion | ok | /arm_controller/follow_joint_trajectory" in by(checks, OK)


@pytest.mark.parametrize(
    ("shape", "trouble"),
    [
        ('<mesh filename="package://lacking/arm.stl"/>', "the meshes of"),
        ("", "no collision shapes"),
    ],
)
def test_shapes_that_a_moving_arm_needs_are_missed(shape: str, trouble: str) -> None:
    robot = ElementTree.fromstring(URDF.read_text())
    for link in robot.iter("link"):
        for collision in link.findall("collision"):
            link.remove(collision)
        if shape:
            collision = ElementTree.SubElement(link, "collision")
            geometry = ElementTree.SubElement(collision, "geometry")
            geometry.append(ElementTree.fromstring(shape))
    text = ElementTree.tostring(robot, encoding="unicode")
    with Harness() as harness:
        harness.add(lambda context: Robot(description=text, context=context))
        (found,) = (check for check in observed(harness) if check.what == "collisions")
    assert found.state == FIX and trouble in found.found
    assert "ROS_PACKAGE_PATH" in found.remedy and "require_collision_shapes" in found.remedy


def test_another_arm_without_a_description_is_not_passed_as_the_galen() -> None:
    with Harness() as harness:
        harness.add(lambda context: Robot(context=context))
        (arm,) = (check for check in observed(harness) if check.what == "arm")
    assert arm.state == FIX and "joint_states are another arm's" in arm.found
    assert "--urdf FILE --sensor-frame FRAME" in arm.remedy
