# SPDX-License-Identifier: Apache-2.0
"""The compensation as a managed node, over its own services: silent unless it is active."""

import time
from pathlib import Path
from typing import Any

import pytest
from calibration_files import pointer
from galen_gravcomp.ros.node import GravcompNode
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import calibration_path, write_calibration
from galen_ros.node.diagnostics import Level
from galen_ros.node.testing import Harness, Lifecycle, parameters
from std_srvs.srv import SetBool, Trigger
from test_gravcomp_node import LEFT, POINTER, PUSH, RETRACTOR, STILL, Bench

from galen_msgs.srv import ListTools

OTHER = pointer(mass_kg=0.09)  # of another arm, by the same name


@pytest.fixture
def tools(tmp_path: Path) -> Path:
    for tool in (POINTER, RETRACTOR):
        write_calibration(calibration_path(tmp_path, tool.tool), tool)
    return tmp_path


def managed(harness: Harness, tools: Path, **values: Any) -> tuple[Bench, Lifecycle]:
    bench = Bench(harness, tools, {"tare_window_s": 0.05, "tare_ramp_s": 0.01} | values)
    return bench, Lifecycle(harness, bench.listener, "gravcomp")


def published(bench: Bench) -> list[bool]:
    """For each wrench that goes out from now on, whether the node was active."""
    said: list[bool] = []
    publish = bench.node._publish

    def recorded(*args: Any) -> None:
        said.append(bench.node.active)
        publish(*args)

    bench.node._publish = recorded
    return said


def test_nothing_is_held_over_from_before_it_was_deactivated(harness: Harness, tools: Path) -> None:
    bench, life = managed(harness, tools)
    bench.running()
    tare = bench.listener.create_client(Trigger, "gravcomp/tare")
    future = tare.call_async(Trigger.Request())
    harness.wait_for(lambda: bench.step(LEFT) and future.done(), 20.0, "a tare")
    assert future.result().success
    for _ in range(20):
        tared = bench.step(LEFT)
    bench.expect(tared, LEFT - LEFT)

    assert life.go("deactivate") and life.state == "inactive"
    bench.state("inactive", Level.WARN)
    harness.wait_for(lambda: not bench.driver.ready(), 20.0, "the subscriptions to go")
    rejected = bench.call("tare", Trigger, Trigger.Request())
    assert not rejected.success and rejected.message == "not tared: the node is inactive"
    assert "inactive" in bench.call("enable", SetBool, SetBool.Request(data=True)).message
    listed = bench.call("list_tools", ListTools, ListTools.Request()).tools
    assert [tool.tool for tool in listed] == ["pointer", "retractor"]
    before = len(bench.listener.outputs)
    for _ in range(50):
        late = bench.step(PUSH)
    assert life.go("activate")
    harness.wait_for(bench.ready, 20.0, "inputs and output")
    fresh = bench.step(LEFT)
    bench.expect(fresh, LEFT)  # the tool stays, the tare does not
    assert bench.output_at(late) is None and len(bench.listener.outputs) == before + 1


def test_not_one_wrench_goes_out_while_it_is_not_active(harness: Harness, tools: Path) -> None:
    """Switched at 1000 Hz of input, while samples wait in its queues."""
    bench, life = managed(harness, tools)
    said = published(bench)
    timer = bench.driver.create_timer(0.001, lambda: bench.step(PUSH))
    for _ in range(5):
        said_before = len(said)
        harness.wait_for(lambda n=said_before: len(said) > n + 20, 10.0, "wrenches")
        assert life.go("deactivate", "activate")
    assert life.go("deactivate", "cleanup", "configure", "activate")
    timer.cancel()
    assert said and all(said)


def test_it_is_configured_anew_with_other_files_and_joints(harness: Harness, tools: Path) -> None:
    bench, life = managed(harness, tools)
    bench.running()
    other = tools / "other"
    other.mkdir()
    write_calibration(calibration_path(other, "pointer"), OTHER)
    assert life.go("deactivate", "cleanup")
    assert not bench.node.get_publishers_info_by_topic("/wrench_compensated")
    assert not life.set(tools_dir=str(other), joint_names=list("abcde"))
    assert life.go("configure", "activate")
    harness.wait_for(bench.driver.ready, 20.0, "the subscriptions")
    bench.driver.joints(bench.stamp, *STILL, names=("roll", "tilt"))
    bench.state("bad_joints", Level.ERROR, lambda: bench.step(PUSH))
    assert life.go("deactivate", "cleanup") and not life.set(joint_names=list(GALEN.joint_names))
    assert life.go("configure", "activate")
    harness.wait_for(bench.ready, 20.0, "inputs and output")
    stamp = bench.step(PUSH)
    bench.expect(stamp, PUSH + POINTER.predict(STILL) - OTHER.predict(STILL))


def test_a_bad_file_fails_configure_and_can_be_fixed(harness: Harness, tools: Path) -> None:
    bench, life = managed(harness, tools)
    assert life.go("deactivate", "cleanup")
    good = (tools / "pointer.json").read_bytes()
    (tools / "pointer.json").write_text('{"schema_version": 1')
    assert not life.go("configure") and life.state == "unconfigured"
    said = bench.report(lambda s, v: s.level == bytes([Level.ERROR]), "the error")
    assert said["message"].startswith("configure failed: ") and "pointer.json" in said["message"]
    (tools / "pointer.json").write_bytes(good)
    assert life.go("configure", "activate")
    harness.wait_for(bench.driver.ready, 20.0, "the subscriptions")
    bench.running()


def test_who_waits_for_an_answer_gets_one(harness: Harness, tools: Path) -> None:
    """A tare under way when it is deactivated, and files under work when it is cleaned up."""
    bench, life = managed(harness, tools)
    bench.running()
    tare = bench.listener.create_client(Trigger, "gravcomp/tare")
    waits = tare.call_async(Trigger.Request())
    bench.state("taring", Level.OK)
    assert life.go("deactivate")
    harness.wait_for(waits.done, 20.0, "the tare's answer")
    assert waits.result().message == "not tared: the node was deactivated"

    client = bench.listener.create_client(ListTools, "gravcomp/list_tools")
    harness.wait_for(client.service_is_ready, 20.0, "the service")
    bench.node._tools._background.submit(lambda: time.sleep(0.3), lambda _: None)  # a slow disk
    waits = client.call_async(ListTools.Request())
    harness.wait_for(lambda: len(bench.node._tools._background._waiting) > 1, 20.0, "the request")
    assert life.go("cleanup")
    harness.wait_for(waits.done, 20.0, "the list's answer")
    assert not waits.result().success and "cleaned up" in waits.result().error_msg


def test_a_second_compensator_that_waits_is_no_conflict(harness: Harness, tools: Path) -> None:
    """A spare, configured and inactive, takes over when the first one is deactivated."""
    bench, life = managed(harness, tools)
    spare = harness.add(
        lambda context: GravcompNode(
            context=context,
            parameter_overrides=parameters(
                tools_dir=str(tools), tool="retractor", late_s=0.0, autostart=False
            ),
            cli_args=["--ros-args", "-r", "__node:=spare"],
        )
    )
    spare_life = Lifecycle(harness, bench.listener, "spare")
    assert spare_life.go("configure")
    bench.running()
    assert bench.running()["wrench_compensated_publishers"] == "1"
    assert spare_life.go("activate")
    bench.state("several_publishers", Level.ERROR, lambda: bench.step(LEFT))
    assert life.go("deactivate")
    harness.wait_for(
        lambda: bench.step(PUSH) and spare._compensator.compensated, 20.0, "the spare to take over"
    )
