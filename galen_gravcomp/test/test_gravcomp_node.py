# SPDX-License-Identifier: Apache-2.0
"""The node over real rclpy: what goes out, what does not, and what /diagnostics says."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_files import pointer
from diagnostic_msgs.msg import DiagnosticArray
from galen_common.stream.monitor import NOTICE_HOLD_S
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.files.calibration_file import calibration_path, write_calibration
from galen_ros.messages import STREAM, fill_stamp, fill_wrench, stamp_to_ns, wrench_to_array
from galen_ros.node.diagnostics import Level
from galen_ros.node.testing import Harness, parameters
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from galen_msgs.srv import SetTool

MS = 1_000_000
S = 1_000_000_000
START = 100 * S
PUSH = np.array([1.0, -2.0, 3.0, 0.1, -0.2, 0.3])
LEFT = np.array([0.5, -0.4, 0.3, 0.01, -0.02, 0.03])
STILL = (0.2, -0.1)
TORN = b"\x00\x01\x00\x00\x01\x00"  # ends inside its stamp


POINTER, RETRACTOR = pointer(), pointer("retractor", 0.2)


@pytest.fixture
def tools_dir(tmp_path: Path) -> Path:
    for tool in (POINTER, RETRACTOR):
        write_calibration(calibration_path(tmp_path, tool.tool), tool)
    return tmp_path


class Driver(Node):
    """Stands in for a driver: publishes what a test says, when it says so."""

    def __init__(
        self, name: str, wrench_raw: str = "wrench_raw", prefix: str = "", **options: Any
    ) -> None:
        super().__init__(name, **options)
        self.prefix = prefix
        self.joints_publisher = self.create_publisher(JointState, "joint_states", STREAM)
        self.wrench_publisher = self.create_publisher(WrenchStamped, wrench_raw, STREAM)

    def joints(self, stamp_ns: int, roll: float, tilt: float, names: Any = None) -> None:
        message = JointState()
        fill_stamp(message.header.stamp, stamp_ns)
        # Not in the contract's order, and with one more: names count, not places.
        message.name = list(names or ("tilt", "gripper", "delta_x", "roll", "delta_y", "delta_z"))
        values = {"roll": roll, "tilt": tilt}
        message.position = [values.get(name, 9.0) for name in message.name]
        message.name = [self.prefix + name for name in message.name]
        self.joints_publisher.publish(message)

    def wrench(self, stamp_ns: int, wrench: Array) -> None:
        message = WrenchStamped()
        fill_stamp(message.header.stamp, stamp_ns)
        message.header.frame_id = self.prefix + "ft_sensor"
        fill_wrench(message, wrench)
        self.wrench_publisher.publish(message)

    def ready(self) -> bool:
        return bool(
            self.joints_publisher.get_subscription_count()
            and self.wrench_publisher.get_subscription_count()
        )


class Listener(Node):
    """Collects what the compensator says."""

    def __init__(self, topic: str, **options: Any) -> None:
        super().__init__("listener", **options)
        self.outputs: list[tuple[int, str, Array]] = []
        self.reports: list[Any] = []
        self.subscription = self.create_subscription(WrenchStamped, topic, self._on_wrench, STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def _on_wrench(self, message: WrenchStamped) -> None:
        stamp_ns = stamp_to_ns(message.header.stamp)
        self.outputs.append((stamp_ns, message.header.frame_id, wrench_to_array(message)))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.reports += [status for status in message.status if "gravcomp" in status.name]


class Bench:
    """One compensator, one driver, one listener."""

    def __init__(
        self,
        harness: Harness,
        tools_dir: Path,
        values: dict[str, Any] | None = None,
        namespace: str = "",
        prefix: str = "",
        wrench_raw: str = "wrench_raw",
        wrench_compensated: str = "wrench_compensated",
    ) -> None:
        self.harness = harness
        # The stamps here are slower than time.
        values = {"tools_dir": str(tools_dir), "tool": "pointer", "late_s": 0.0} | (values or {})
        names = {"wrench_raw": wrench_raw, "wrench_compensated": wrench_compensated}
        remaps = [word for pair in names.items() for word in ("-r", ":=".join(pair))]
        self.node = harness.add(
            lambda context: GravcompNode(
                context=context,
                namespace=namespace,
                parameter_overrides=parameters(**values),
                cli_args=["--ros-args", *remaps],
            )
        )
        self.listener = harness.add(
            lambda context: Listener(wrench_compensated, context=context, namespace=namespace)
        )
        self.services = f"{namespace}/gravcomp"
        self.stamp = START
        self._driver_options = {"namespace": namespace, "prefix": prefix, "wrench_raw": wrench_raw}
        self.driver = self.start_driver("driver")

    def start_driver(self, name: str) -> Driver:
        driver = self.harness.add(
            lambda context: Driver(name, context=context, **self._driver_options)
        )
        self.harness.wait_for(driver.ready, 10.0, "the compensator to see the driver")
        self.harness.wait_for(self.heard, 10.0, "the output's publisher")
        return driver

    def heard(self) -> bool:
        return bool(self.listener.subscription.get_publisher_count())

    def ready(self) -> bool:
        return self.driver.ready() and self.heard()

    def step(self, touch: Array, roll: float = STILL[0], tilt: float = STILL[1]) -> int:
        """One sample of an arm with the pointer on; returns its stamp."""
        stamp = self.stamp
        self.driver.joints(stamp, roll, tilt)
        self.driver.wrench(stamp, POINTER.predict(np.stack([roll, tilt], axis=-1)) + touch)
        self.stamp += 2 * MS
        return stamp

    def output_at(self, stamp_ns: int) -> Array | None:
        outputs = reversed(self.listener.outputs)
        return next((wrench for stamp, _, wrench in outputs if stamp == stamp_ns), None)

    def expect(self, stamp_ns: int, wrench: Array, atol: float = 1e-9) -> None:
        """Wait for the output of a stamp and compare it."""
        self.harness.wait_for(
            lambda: self.output_at(stamp_ns) is not None, 5.0, f"an output at {stamp_ns}"
        )
        output = self.output_at(stamp_ns)
        assert output is not None
        np.testing.assert_allclose(output, wrench, rtol=0, atol=atol)

    def report(
        self,
        accepts: Callable[[Any, dict[str, str]], bool],
        what: str,
        feed: Callable[[], object] = lambda: None,
    ) -> dict[str, str]:
        """Wait for a report that is accepted, the newest or a later one; `feed` while waiting."""

        def found() -> dict[str, str] | None:
            feed()
            for status in reversed(self.listener.reports):
                values = {item.key: item.value for item in status.values}
                if accepts(status, values):
                    return {"name": status.name, "message": status.message, **values}
            return None

        del self.listener.reports[:-1]
        # A notice of what came before is held for NOTICE_HOLD_S.
        report: dict[str, str] = self.harness.wait_for(found, NOTICE_HOLD_S + 5.0, what)
        return report

    def state(
        self, name: str, level: Level, feed: Callable[[], object] = lambda: None
    ) -> dict[str, str]:
        return self.report(
            lambda s, v: v["state"] == name and s.level == bytes([level]), f"the state {name}", feed
        )

    def running(self) -> dict[str, str]:
        """Wait for the report of a compensator that works, feeding it."""
        return self.state("compensating", Level.OK, lambda: self.step(LEFT))

    def call(self, service: str, kind: Any, request: Any) -> Any:
        client = self.listener.create_client(kind, f"{self.services}/{service}")
        return self.harness.call(client, request)

    def set_tool(self, tool: str) -> Any:
        return self.call("set_tool", SetTool, SetTool.Request(tool=tool))


@pytest.fixture
def bench(harness: Harness, tools_dir: Path) -> Bench:
    return Bench(harness, tools_dir)


def test_compensates_and_keeps_stamp_and_frame(bench: Bench) -> None:
    rng = np.random.default_rng(5)
    expected = {}
    for i in range(200):
        roll, tilt = rng.uniform(-1, 1, 2) * 0.1 + i * 0.003
        touch = rng.uniform(-1, 1, 6)
        expected[bench.step(touch, roll, tilt)] = touch
    bench.harness.wait_for(lambda: len(bench.listener.outputs) == 200, 5.0, "200 outputs")
    assert [stamp for stamp, _, _ in bench.listener.outputs] == sorted(expected)
    for stamp, frame_id, wrench in bench.listener.outputs:
        assert frame_id == "ft_sensor"
        np.testing.assert_allclose(wrench, expected[stamp], rtol=0, atol=1e-9)
    values = bench.running()
    assert values["tool"] == "pointer" and values["calibrated_at"] == POINTER.calibrated_at
    assert int(values["compensated"]) > 0 and float(values["latency_p99_ms"]) > 0


# Rejections


@pytest.mark.parametrize(
    ("tool", "state", "level", "words"),
    [
        ("", "no_tool", Level.WARN, "call ~/set_tool"),
        ("../pointer", "bad_tool_file", Level.ERROR, "../pointer"),
    ],
)
def test_without_a_tool_at_start_nothing_goes_out_until_one_is_set(
    harness: Harness, tools_dir: Path, tool: str, state: str, level: Level, words: str
) -> None:
    bench = Bench(harness, tools_dir, values={"tool": tool})
    bench.step(PUSH)
    bench.report(lambda _, v: int(v["rejected_no_tool"]) > 0, "a rejection without a tool")
    assert words in bench.state(state, level)["message"]
    assert bench.listener.outputs == []
    assert bench.set_tool("pointer").success
    bench.expect(bench.step(PUSH), PUSH)
    bench.running()


# Services


def start_tare(bench: Bench) -> Any:
    """Ask for a tare and return the answer's future, when the request has been taken."""
    client = bench.listener.create_client(Trigger, f"{bench.services}/tare")
    bench.harness.wait_for(client.service_is_ready, 5.0, "the tare service")
    future = client.call_async(Trigger.Request())
    bench.report(lambda _, v: v["tare"] == "averaging", "the tare to begin")
    return future


# The driver restarts


def test_new_driver_starts_from_nothing(bench: Bench) -> None:
    """The same stamps go on, so only the publishers tell that this is another driver."""
    bench.expect(bench.step(LEFT), LEFT)
    future = start_tare(bench)
    for _ in range(252):
        bench.step(LEFT)
    bench.harness.wait_for(future.done, 5.0, "the tare's answer")
    assert future.result().success and "(0.500, -0.400, 0.300) N" in future.result().message
    for _ in range(520):
        last = bench.step(LEFT)
    bench.expect(last, np.zeros(6))

    bench.harness.remove(bench.driver)
    bench.report(lambda _, v: "is gone" in v["last_restart"], "the restart to be told")
    bench.driver = bench.start_driver("driver_again")
    # Between the old joints and these new ones nothing may be interpolated.
    before = bench.stamp - MS
    bench.driver.wrench(before, PUSH)
    stamp = bench.step(PUSH, -1.0, 0.6)
    bench.expect(stamp, PUSH)
    assert bench.output_at(before) is None
    values = bench.report(lambda s, v: int(v["restarts"]) > 0, "restarts to be counted")
    assert values["tare_force_n"] == "0 0 0"


def test_best_effort_driver(harness: Harness, tools_dir: Path) -> None:
    bench = Bench(harness, tools_dir)
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    harness.call_in_executor(
        lambda: bench.driver.create_publisher(WrenchStamped, "wrench_raw", best_effort)
    )
    values = bench.state("incompatible_qos", Level.ERROR)
    assert "best_effort_input" in values["message"] and "wrench_raw" in values["message"]


# Names


def test_namespace_and_remap(harness: Harness, tools_dir: Path) -> None:
    """A left arm, with the sensor's topic and the output under the names of another suite."""
    left = replace(GALEN, sensor_frame="left_ft_sensor")
    write_calibration(calibration_path(tools_dir, "pointer"), replace(POINTER, arm=left))
    bench = Bench(
        harness,
        tools_dir,
        namespace="/left",
        prefix="left_",
        wrench_raw="ft/raw",
        wrench_compensated="measured_cf",
        values={
            "sensor_frame": "left_ft_sensor",
            "joint_names": [f"left_{name}" for name in GALEN.joint_names],
        },
    )
    topics = dict(bench.listener.get_publisher_names_and_types_by_node("gravcomp", "/left"))
    assert "/left/measured_cf" in topics
    bench.expect(bench.step(PUSH), PUSH)
    assert bench.listener.outputs[-1][1] == "left_ft_sensor"
    values = bench.running()
    assert values["name"] == "left/gravcomp"
    assert bench.call("enable", SetBool, SetBool.Request(data=False)).success


# Rejections


def _torn_wrench(bench: Bench) -> None:
    bench.driver.joints(bench.stamp, *STILL)
    bench.driver.wrench_publisher.publish(TORN)


def _torn_joints(bench: Bench) -> None:
    bench.driver.joints_publisher.publish(TORN)
    bench.driver.wrench(bench.stamp, PUSH)


def test_rejections_are_errors_that_end_by_themselves(bench: Bench) -> None:
    """What the compensator rejects is tested there; here, what only a node sees, one by one."""
    for feed, state, words in (
        (_torn_wrench, "unreadable", "wrench_raw"),
        (_torn_joints, "bad_joints", "not a readable sensor_msgs/msg/JointState"),
    ):
        bench.expect(bench.step(PUSH), PUSH)
        last_good = len(bench.listener.outputs)

        def rejected(feed: Callable[[Bench], None] = feed, words: str = words) -> bool:
            feed(bench)
            bench.stamp += 2 * MS
            newest = bench.listener.reports[-1:] or [None]
            return bool(newest[0]) and words in newest[0].message and newest[0].level == b"\x02"

        bench.harness.wait_for(rejected, 8.0, f"an error that says {words!r}")
        values = bench.report(lambda _, v, state=state: v["state"] == state, f"the state {state}")
        assert "nothing is published" in values["message"]
        assert int(values[f"rejected_{state}"]) > 0
        assert len(bench.listener.outputs) == last_good, "something went out as compensated"


# Services


def test_set_tool_reads_back_what_is_active_and_failures_keep_it(bench: Bench) -> None:
    answer = bench.set_tool("retractor")
    assert answer.success and answer.error_code == SetTool.Response.NONE and answer.error_msg == ""
    assert (answer.tool, answer.mass_kg) == ("retractor", 0.2)
    np.testing.assert_array_equal(answer.com_m, RETRACTOR.load.com_m)
    np.testing.assert_array_equal(answer.tip_m, RETRACTOR.tip_m)
    assert answer.calibrated_at == RETRACTOR.calibrated_at
    # what is wrong with files is in test_faults_tool_file
    for tool, code in (("absent", answer.NOT_FOUND), ("../pointer", answer.INVALID_NAME)):
        answer = bench.set_tool(tool)
        assert not answer.success and answer.error_code == code and tool in answer.error_msg
        assert (answer.tool, answer.mass_kg) == ("retractor", 0.2)
    difference = POINTER.predict(STILL) - RETRACTOR.predict(STILL)
    bench.expect(bench.step(PUSH), PUSH + difference)


def test_enable_off_and_on_and_tares_that_cannot_be(bench: Bench) -> None:
    bench.expect(bench.step(PUSH), PUSH)
    future = start_tare(bench)
    second = bench.call("tare", Trigger, Trigger.Request())
    assert not second.success and "already running" in second.message
    assert bench.harness.wait_for(future.done, 8.0, "an answer though no wrench comes")
    assert not future.result().success and "no compensated wrench" in future.result().message
    assert bench.call("enable", SetBool, SetBool.Request(data=False)).success
    for _ in range(5):
        bench.step(PUSH)
    bench.report(lambda _, v: int(v["rejected_disabled"]) == 5, "five rejections while off")
    assert len(bench.listener.outputs) == 1
    answer = bench.call("enable", SetBool, SetBool.Request(data=True))
    assert answer.success and answer.message == "compensation is on"
    bench.expect(bench.step(LEFT), LEFT)


# A wrong set-up

POSES = ((0.2, -0.1), (-1.0, 0.6), (1.1, -0.8))
NOISE = np.array([0.02, 0.02, 0.02, 4e-4, 4e-4, 4e-4])


class Rest:
    """Samples at rest of a driver that makes a mistake, with the retractor on."""

    def __init__(self, bench: Bench, spoil: Callable[[Array], Array]) -> None:
        self.bench, self.spoil, self.pose = bench, spoil, 0
        self.rng = np.random.default_rng(7)

    def __call__(self) -> None:
        roll, tilt = POSES[self.pose]
        for _ in range(25):
            reading = self.spoil(RETRACTOR.predict(np.array([roll, tilt])))
            self.bench.driver.joints(self.bench.stamp, roll, tilt)
            noisy = reading + NOISE * self.rng.normal(size=6)
            self.bench.driver.wrench(self.bench.stamp, noisy)
            self.bench.stamp += 2 * MS


def test_a_wrong_set_up_stops_the_output_with_its_explanation(
    harness: Harness, tools_dir: Path
) -> None:
    """Forces are in kgf, which a known tool shows; mounts are in test_model_setup_check."""
    bench = Bench(harness, tools_dir, {"tool": "retractor", "check_units": False})
    rest = Rest(bench, lambda wrench: wrench * np.repeat([1 / 9.80665, 1.0], 3))
    values = bench.state("wrong_setup", Level.ERROR, rest)
    assert "forces are in kgf" in values["message"]
    assert "nothing is published" in values["message"]
    assert values["setup"].startswith("wrong: ")
    rest.spoil = lambda wrench: wrench  # the driver is mended
    bench.report(lambda _, v: v["state"] == "compensating", "the end of it", rest)
    for pose in range(3):
        rest.pose = pose
        text = f"not yet verified: fits at rest in {pose + 1} of 3 orientations"
        setup = text if pose < 2 else "verified"
        bench.report(lambda _, v, setup=setup: v["setup"] == setup, setup, rest)


def test_an_offset_is_no_wrong_set_up_and_waiting_publishes_nothing_before_a_reading_fits(
    harness: Harness, tools_dir: Path
) -> None:
    bench = Bench(harness, tools_dir, {"tool": "retractor", "setup_check": "wait"})
    rest = Rest(bench, lambda wrench: wrench + [2.0, 1.0, -3.0, 0.02, 0.05, -0.01])
    values = bench.report(lambda _, v: "off in the last" in v["setup"], "the offset", rest)
    assert values["state"] == "setup_not_verified" and "zero or tare" in values["setup"]
    assert bench.listener.outputs == []
    rest.spoil = lambda wrench: wrench
    bench.report(lambda _, v: v["state"] == "compensating", "the first that fits", rest)


def test_angles_in_degrees_are_not_compensated_until_they_are_plausible(bench: Bench) -> None:
    bench.expect(bench.step(PUSH), PUSH)
    bench.running()

    def in_degrees() -> None:
        bench.step(PUSH, roll=30.0)

    values = bench.state("implausible_units", Level.ERROR, in_degrees)
    assert "are they in degrees?" in values["message"]
    assert "nothing is published" in values["message"] and "check_units:=false" in values["message"]
    last = bench.listener.outputs[-1][0]
    for _ in range(20):
        in_degrees()
    bench.report(lambda _, v: int(v["rejected_implausible_units"]) > 20, "more of them", in_degrees)
    assert bench.listener.outputs[-1][0] == last
    bench.running()
