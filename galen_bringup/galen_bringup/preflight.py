# SPDX-License-Identifier: Apache-2.0
"""`preflight`: whether a robot has what the suite needs, and what to fix where it has not.

Receives `joint_states`, `wrench_raw` and `robot_description` for some seconds, whatever their
quality of service is, and pairs the samples by the code and the limits of the nodes.

The load, and with it signs, axes, units and the mount, is checked over the orientations that came
(`galen_model.setup_check`).
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Sequence
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from galen_common.arm import ArmParameters, add_arm, chosen_arm
from galen_common.cdr import JointStateError, JointWire, UnreadableError, WrenchWire
from galen_common.command import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    add_json,
    make_parser,
    positive,
    print_json,
    run_command,
    terminal,
)
from galen_common.stream.pairing import StreamParameters, WrenchPairing
from galen_common.stream.samples import Notice, PairedWrench, Rejected, Rejection
from galen_model.arm.arm import Arm
from galen_model.arm.clearance import ArmClearance
from galen_model.arm.galen import GALEN, WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.setup_check.check import check_setup
from galen_model.setup_check.readings import at_angles, fit_load
from galen_ros.messages import LATCHED, publisher_nodes
from galen_ros.node.parameters import declare_parameters
from galen_ros.node.spin import run_until
from galen_ros.node.stream_node import input_qos
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rich.markup import escape
from rich.table import Table
from sensor_msgs.msg import JointState
from std_msgs.msg import String

OK, NOTE, FIX = "ok", "note", "fix"
_COLOURS = {OK: "green", NOTE: "yellow", FIX: "red"}
_JOINTS, _WRENCH, _DESCRIPTION = "joint_states", "wrench_raw", "robot_description"
_KINDS: dict[str, Any] = {_JOINTS: JointState, _WRENCH: WrenchStamped, _DESCRIPTION: String}
_SENSOR_LIKE = re.compile(r"ft_|_ft|force|sensor|flange|tool0|link_?8|ee_", re.IGNORECASE)
_FEWEST = 20
# Of samples and time: so much may be lost, as at the start before the other topic's first sample.
_TOLERATED = 0.02
_CLOCK_OFFSET_S = 1.0
# Gravity's direction must turn so far, and the weight be so large, to show a load.
_TURNED, _MASS_KG = 0.3, 0.02
_MOST_SAMPLES = 300  # they are fitted a thousand times where nothing fits
_CLOCKS = "stamp both by one clock (chrony, PTP), raise the joints' rate, or set max_joint_age_s"
_ONE_DRIVER = "one publisher, and a stamp of its own for each sample"
_UNSTAMPED = (
    "the driver must stamp each message with the sample's time; with use_sim_time it needs /clock"
)
_JUMP = "stamps must not jump: one clock, which nothing sets meanwhile, and one driver"
_REMEDIES: dict[Enum, str] = {
    Rejection.WRONG_FRAME: "give --sensor-frame (nodes: sensor_frame), or correct the driver",
    Rejection.UNSTAMPED: _UNSTAMPED,
    Rejection.DUPLICATE: _ONE_DRIVER,
    Rejection.NONFINITE_WRENCH: "is the sensor initialised, and not overloaded?",
    Rejection.NO_JOINTS: _CLOCKS,
    Rejection.STALE_JOINTS: _CLOCKS,
    Rejection.NONFINITE_JOINTS: "are all joints' encoders initialised?",
    Notice.OUT_OF_ORDER_WRENCH: _ONE_DRIVER,
    Notice.OUT_OF_ORDER_JOINTS: _ONE_DRIVER,
    Notice.DUPLICATE_JOINTS: _ONE_DRIVER,
    Notice.RESTART: _JUMP,
    Notice.JOINT_JUMP: "does another node publish other joint values?",
    Notice.BEYOND_RANGE: "unload the sensor, or set sensor_range",
    Notice.TORQUE_UNIT: "torques must be in N.m",
    Notice.ANGLE_UNIT: "angles must be in rad",
}
# Even a few of them are no loss at the start.
_NEVER_SOUND = (Rejection.NONFINITE_WRENCH, Rejection.NONFINITE_JOINTS)
_NOTES = """topics of this robot: --ros-args -r wrench_raw:=/ft_sensor/wrench -r __ns:=/arm
limits are parameters of gravcomp_node: --ros-args -p best_effort_input:=true"""


class Check(NamedTuple):
    """One thing that was looked at; `state`: OK, NOTE (nothing to fix, or not checked) or FIX."""

    what: str
    state: str
    found: str
    remedy: str = ""


class Observer(Node):
    """Receives for `seconds` what the suite's nodes would, and knows who sends it."""

    def __init__(self, seconds: float, **node_options: Any) -> None:
        super().__init__("preflight", **node_options)
        self.limits = declare_parameters(self, StreamParameters)
        self._end_s = time.monotonic() + seconds
        self.samples: list[tuple[str, int, bytes]] = []
        """Topic, arrival (ns) and message of each, in the order of arrival."""
        self.descriptions: list[str] = []
        for topic in (_JOINTS, _WRENCH):
            on_sample, qos = partial(self._on_sample, topic), input_qos(best_effort=True)
            self.create_subscription(_KINDS[topic], topic, on_sample, qos, raw=True)
        self.create_subscription(String, _DESCRIPTION, self._on_description, LATCHED)

    def _on_sample(self, topic: str, data: bytes) -> None:
        self.samples.append((topic, time.time_ns(), data))

    def _on_description(self, message: String) -> None:
        self.descriptions.append(message.data)

    @property
    def finished(self) -> bool:
        """Whether the time is over."""
        return time.monotonic() > self._end_s

    def checks(self, arguments: argparse.Namespace) -> list[Check]:
        """Judge what came so far.

        Args:
            arguments: those of `build_parser`.

        Returns:
            The checks of arm, topics, samples and interfaces.

        """
        checks: list[Check] = []
        arm = None
        text = self.descriptions[-1] if self.descriptions else ""
        if not arguments.urdf:
            checks += self._sender(_DESCRIPTION, bool(text))
        try:
            arm = chosen_arm(arguments, text)
            chain = f"{len(arm.joints)} joints from {arm.base_frame} to {arm.sensor_frame}"
            other = text and not arguments.urdf and GALEN.difference(arm)
            use = "nodes: use_robot_description:=true" if other else ""
            checks.append(Check("arm", OK, f"{arm.name}: {chain}", use))
        except GalenError as error:
            checks.append(Check("arm", FIX, str(error), _arm_remedy(arguments, text)))
        for topic in (_JOINTS, _WRENCH):
            checks += self._sender(topic, any(sample[0] == topic for sample in self.samples))
        found = sample_checks(self.samples, arm, self.limits) if arm else []
        if arm is not None and not text and not arguments.urdf and lack_joints(found):
            # The Galen was only taken for want of a description.
            remedy = "start robot_state_publisher, or give --urdf FILE --sensor-frame FRAME"
            of_galen = f"{arm.name} is taken, and joint_states are another arm's"
            checks = [
                Check("arm", FIX, of_galen, remedy) if one.what == "arm" else one for one in checks
            ]
        return [*checks, *found, *self._interfaces(arm)]

    def _sender(self, topic: str, came: bool) -> list[Check]:
        """Check a topic's publishers and their quality of service."""
        name, kind = self.resolve_topic_name(topic), _KINDS[topic]
        infos = [info.qos_profile for info in self.get_publishers_info_by_topic(name)]
        if not infos:
            wanted = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
            others = [one for one, kinds in self.get_topic_names_and_types() if wanted in kinds]
            others = [one for one in others if self.count_publishers(one)]
            remedy = f"start the driver{' or remap one of ' * bool(others)}{', '.join(others)}"
            if topic != _DESCRIPTION:
                return [Check(topic, FIX, f"no publisher on {name}", remedy)]
            remedy = "another arm: start robot_state_publisher, or give --urdf (nodes: urdf_file)"
            return [Check(topic, NOTE, f"no publisher on {name}: the Galen is taken", remedy)]
        nodes = ", ".join(publisher_nodes(self, topic))
        checks = [Check(topic, OK, f"{name}, by {nodes}")]
        if len(infos) > 1:
            # Joints may come from several, as long as only one of them has this arm's.
            state = NOTE if topic == _JOINTS else FIX
            found = f"{len(infos)} publishers on {name}: {nodes}"
            checks = [Check(topic, state, found, "only one may have this arm's: stop the others")]
        if topic == _DESCRIPTION:
            if any(qos.durability == DurabilityPolicy.VOLATILE for qos in infos):
                found = "volatile: a node that starts later gets none"
                checks.append(Check(topic, FIX, found, "publish it transient local"))
        elif any(qos.reliability == ReliabilityPolicy.BEST_EFFORT for qos in infos):
            state, set_it = (OK, "") if self.limits.best_effort_input else (FIX, "set ")
            checks.append(Check(topic, state, "best effort", f"{set_it}best_effort_input:=true"))
        if not came:
            remedy = "is the driver connected to the robot, and its controller active?"
            checks.append(Check(topic, FIX, "no message came", remedy))
        return checks

    def _interfaces(self, arm: Arm | None) -> list[Check]:
        """Look for simulated time, zeroing and motion: compensation alone needs none."""
        checks = []
        if self.count_publishers("/clock"):
            remedy = "start the nodes with use_sim_time:=true"
            checks.append(Check("time", NOTE, "/clock is published", remedy))
        elif self.get_parameter("use_sim_time").value:
            remedy = "start what publishes /clock (a simulation, play), or leave out use_sim_time"
            checks.append(Check("time", FIX, "use_sim_time, and nothing publishes /clock", remedy))
        services = sorted(name for name, _ in self.get_service_names_and_types())
        zero = self.resolve_service_name("zero_ft_sensor")
        follow, goal = "follow_joint_trajectory", "/_action/send_goal"
        ways = [one.removesuffix(goal) for one in services if one.endswith(follow + goal)]
        topic = self.resolve_topic_name("joint_trajectory")
        ways += [topic] * bool(self.count_subscribers(topic))
        for what, found, lacking, remedy in (
            ("zeroing", [zero] * (zero in services), zero, "remap the driver's to it"),
            ("motion", ways, f"{topic} or {follow}", "start a controller, or calibrate by hand"),
        ):
            missing = Check(what, NOTE, f"nothing offers {lacking}", remedy)
            checks.append(Check(what, OK, ", ".join(found)) if found else missing)
        if arm is not None and ways:
            checks += _shape_checks(arm)
        return checks


def _shape_checks(arm: Arm) -> list[Check]:
    """Check that the nodes can look for collisions before they move the arm."""
    try:
        ArmClearance((), 0.0, np.zeros(3), arm).require_shapes()
    except GalenError as error:
        trouble, _, remedy = str(error).partition(": ")
        return [Check("collisions", FIX, trouble, remedy)]
    return []


def _arm_remedy(arguments: argparse.Namespace, text: str) -> str:
    """Name what is wrong with the description's file, or the frames that may be the sensor's."""
    if arguments.urdf:
        file = Path(arguments.urdf).expanduser()
        if not file.is_file():
            return "name an existing file: --urdf FILE (nodes: urdf_file)"
        text = file.read_text(encoding="utf-8", errors="replace")
    try:
        links = [str(link.get("name")) for link in ElementTree.fromstring(text).iter("link")]
    except ElementTree.ParseError:
        return "give a URDF (a xacro must be expanded first)"
    like = [name for name in links if _SENSOR_LIKE.search(name)]
    if not like or (arguments.sensor_frame or ArmParameters.sensor_frame) in links:
        return ""
    return f"give --sensor-frame {' or '.join(like)} (nodes: sensor_frame)"


# Samples

_OTHER_ARM = "is it this arm's description, and topic?"


def lack_joints(checks: Sequence[Check]) -> bool:
    """Return whether joint states came that lack the arm's joints.

    Args:
        checks: as `sample_checks` returns them.

    Returns:
        True where one of them has that remedy.

    """
    return any(check.remedy == _OTHER_ARM for check in checks)


def sample_checks(
    samples: Sequence[tuple[str, int, bytes]], arm: Arm, limits: StreamParameters
) -> list[Check]:
    """Check what the nodes would make of the samples.

    Args:
        samples: topic (`joint_states` or `wrench_raw`), arrival in ns of system time, and
            serialised message of each, in the order of arrival.
        arm: whose joints and sensor's frame they must have.
        limits: of the samples' stamps and range.

    Returns:
        The checks of joint states, wrenches, their pairing and the load.

    """
    pairing = WrenchPairing(limits, sensor_frame=arm.sensor_frame, arm=arm)
    joint_wire, wrench_wire = JointWire(arm.joint_names), WrenchWire()
    times: dict[str, list[tuple[int, int]]] = {_JOINTS: [], _WRENCH: []}
    joints, wrenches, results, trouble = [], [], [], ""
    for topic, arrival_ns, data in samples:
        try:
            if topic == _JOINTS:
                stamp_ns, positions = joint_wire.read(data)
                joints.append(positions)
                results += pairing.push_joints(stamp_ns, positions)
            else:
                raw = wrench_wire.read(data)
                stamp_ns = raw.stamp_ns
                wrenches.append(raw.wrench)
                results += pairing.push_wrench(stamp_ns, raw.wrench, raw.frame_id)
            times[topic].append((stamp_ns, arrival_ns))
        except (JointStateError, UnreadableError) as error:
            trouble = str(error)
    checks = []
    if not joints and trouble:
        checks.append(Check(_JOINTS, FIX, trouble, _OTHER_ARM))
    for topic, limit_s in ((_JOINTS, limits.max_joint_age_s), (_WRENCH, limits.restart_gap_s)):
        if times[topic]:
            checks.append(_rate_check(topic, np.array(times[topic]), limit_s))
    for values, check in ((joints, partial(_limit_check, arm)), (wrenches, _noise_check)):
        finite = np.array([row for row in values if np.all(np.isfinite(row))])
        if len(finite) >= _FEWEST:
            checks.append(check(finite))
    if joints and wrenches:
        checks += _pairing_checks(pairing, results)
        paired = [one for one in results if isinstance(one, PairedWrench)]
        if len(paired) >= _FEWEST:
            at = np.array([one.joints for one in paired])
            checks.append(setup_check(arm, at, np.array([one.wrench for one in paired])))
    return checks


def _rate_check(topic: str, times_ns: Array, limit_s: float) -> Check:
    """Check stamps and arrivals (n, 2), ns; steps longer than the limit lose wrenches."""
    stamps, arrivals = times_ns.T
    steps_s = np.diff(np.sort(stamps)) * 1e-9
    if not np.all(stamps) or len(steps_s) < _FEWEST:
        found = f"{len(stamps)} messages, {np.sum(stamps == 0)} of them without a stamp"
        return Check(topic, FIX, found, f"{_UNSTAMPED}; it must send all the time")
    # Without the arrivals' own step: a stalled network is no jump.
    jumps_s = (np.diff(stamps) - np.diff(arrivals)) * 1e-9
    jumps_s = jumps_s[np.abs(np.diff(stamps)) > _CLOCK_OFFSET_S * 1e9]
    if len(jumps_s) and np.max(np.abs(jumps_s)) > _CLOCK_OFFSET_S:
        found = f"a stamp jumps by {jumps_s[np.argmax(np.abs(jumps_s))]:+.3f} s"
        return Check(topic, FIX, found, _JUMP)
    late_s, longest_s = float(np.median(arrivals - stamps)) * 1e-9, float(steps_s.max())
    found = (
        f"{1.0 / steps_s.mean():.1f} Hz, jitter {steps_s.std() * 1e3:.2f} ms, longest step"
        f" {longest_s * 1e3:.1f} ms, stamps {late_s:.3f} s old at arrival"
    )
    if np.sum(steps_s[steps_s > limit_s]) > _TOLERATED * np.sum(steps_s):
        found += f": {np.sum(steps_s > limit_s)} steps above {limit_s * 1e3:g} ms"
        return Check(topic, FIX, found, "raise the rate, or unload the network and the machine")
    if abs(late_s) > _CLOCK_OFFSET_S:
        remedy = (
            "synchronise the clocks (chrony); with a bag's or a simulation's /clock: use_sim_time"
        )
        return Check(topic, NOTE, found, remedy)
    return Check(topic, OK, found)


def _limit_check(arm: Arm, joints: Array) -> Check:
    """Check joints (n, k), m and rad, against the limits."""
    for row in (joints.min(axis=0), joints.max(axis=0)):
        if fault := arm.limit_fault(row):
            return Check(_JOINTS, NOTE, fault, "is the description this robot's?")
    return Check(_JOINTS, OK, f"within limits; {arm.described(arm.angles(joints[-1]))}")


def _noise_check(wrenches: Array) -> Check:
    """Check that every axis of wrenches (n, 6) is alive."""
    span = np.ptp(wrenches, axis=0)
    dead = [axis for axis, width in zip(WRENCH_AXES, span, strict=True) if width == 0.0]
    if dead:
        found = f"{', '.join(dead)} the same in all {len(wrenches)} messages"
        remedy = "a live sensor has noise: is it connected and streaming?"
        return Check(_WRENCH, FIX, found, remedy)
    noise = _noise(wrenches)
    force, torque = (" ".join(f"{value:.2g}" for value in part) for part in (noise[:3], noise[3:]))
    return Check(_WRENCH, OK, f"noise {force} N, {torque} N.m")


def _noise(wrenches: Array) -> Array:
    """Return the noise (6,) of wrenches (n, 6): of differences, so that slow motion is none."""
    return np.asarray(np.std(np.diff(wrenches, axis=0), axis=0) / np.sqrt(2.0))


def _pairing_checks(
    pairing: WrenchPairing, results: Sequence[PairedWrench | Rejected]
) -> list[Check]:
    """Say how many wrenches the nodes would use, and why not the others."""
    last = {one.reason: one.detail for one in results if isinstance(one, Rejected)}
    checks = []
    for reason, count in [*pairing.rejections.items(), *pairing.notices.items()]:
        if count > _TOLERATED * pairing.received and reason is not Notice.BAD_JOINTS:
            found = last.get(reason, str(reason.value).replace("_", " "))
            remedy = _REMEDIES.get(reason, "correct the driver")
            checks.append(Check("samples", FIX, f"{count} times: {found}", remedy))
        elif reason in _NEVER_SOUND:
            remedy = _REMEDIES[reason]
            checks.append(Check("samples", NOTE, f"{count} times: {last[reason]}", remedy))
    used = sum(isinstance(one, PairedWrench) for one in results)
    found = f"{used} of {pairing.received} wrenches have joints at their stamp"
    if any(check.state == FIX for check in checks):
        return checks
    return [*checks, Check("samples", OK, found)]


def setup_check(arm: Arm, joints: Array, wrenches: Array) -> Check:
    """Check that wrenches are those of a load.

    Args:
        arm: whose sensor it is.
        joints: (n, k) at the wrenches' stamps, m and rad, all of the arm's.
        wrenches: (n, 6) as read, in the sensor's frame, N and N.m.

    Returns:
        The check; a NOTE where too little turned or weighed.

    """
    what = "load"
    some = np.linspace(0, len(joints) - 1, min(len(joints), _MOST_SAMPLES)).astype(int)
    readings = at_angles(wrenches[some], arm.angles(joints[some]), arm)
    spread = readings.gravity - readings.gravity.mean(axis=0)
    if np.max(np.linalg.norm(spread, axis=1)) < _TURNED * np.linalg.norm(arm.gravity_m_s2):
        remedy = "turn the tool by 60 degrees or more against gravity meanwhile (--seconds 30)"
        return Check(what, NOTE, "not checked: the tool did not turn", remedy)
    fit = fit_load(readings)
    found = f"{fit.mass_kg:.3f} kg by gravity, residual {fit.residual[0]:.2g} N"
    if wrong := check_setup(readings, _noise(wrenches)):
        remedies = [f"{one.what}: {one.remedy}" for one in wrong.explanations]
        remedy = "; or ".join(remedies)
        if len(remedies) > 1:
            tests = dict.fromkeys(one.test for one in wrong.explanations)
            remedy += f". What separates them: {'; '.join(tests)}"
        unknown = f"{arm.sensor_frame} must have the sensing element's axes; was there contact?"
        return Check(what, FIX, wrong.trouble, remedy or unknown)
    if fit.change[0] < _MASS_KG * np.sqrt(np.mean(spread**2)):
        remedy = "mount a tool; is the reading compensated already? The suite needs the raw one"
        return Check(what, NOTE, f"not checked: {found}", remedy)
    return Check(what, OK, found)


# Command


def build_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    parser = make_parser(
        "preflight",
        "Check what the suite needs of a robot, and say what to fix.",
        notes=_NOTES,
        ok="nothing to fix",
        failed="something is to be fixed",
    )
    listen = "listen so long (default: %(default)s)"
    parser.add_argument("--seconds", type=positive, default=5.0, metavar="SECONDS", help=listen)
    add_arm(parser)
    add_json(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        args: the command line without the command's name; None: that of the process.

    Returns:
        The exit code.

    """
    words = list(sys.argv[1:] if args is None else args)
    at = words.index("--ros-args") if "--ros-args" in words else len(words)
    arguments = build_parser().parse_args(words[:at])
    checks: list[Check] = []

    def done(node: Observer) -> bool:
        if node.finished:
            checks.extend(node.checks(arguments))
        return node.finished

    def work() -> int:
        if run_until(lambda: Observer(arguments.seconds), done, words[at:]) is not None:
            return EXIT_INTERRUPTED
        fix = sum(check.state == FIX for check in checks)
        if arguments.json:
            print_json({"ok": not fix, "checks": [check._asdict() for check in checks]})
        else:
            table = Table("", "", "found", "what to do")
            for what, state, found, remedy in checks:
                shown = f"[{_COLOURS[state]}]{state}[/]"
                table.add_row(what, shown, escape(found), escape(remedy))
            terminal().print(table, f"{fix} to fix" if fix else "nothing to fix")
        return EXIT_FAILED if fix else EXIT_OK

    return run_command("preflight", work)


if __name__ == "__main__":
    sys.exit(main())
