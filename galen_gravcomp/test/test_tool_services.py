# SPDX-License-Identifier: Apache-2.0
"""The node's services on tools' files and the topic of what is active, in one node's life."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_files import pointer
from galen_gravcomp.ros import tool_services
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import calibration_path, write_calibration
from galen_ros.messages import LATCHED
from galen_ros.node.testing import Harness
from std_srvs.srv import SetBool, Trigger
from test_gravcomp_node import LEFT, STILL, Bench

from galen_msgs.msg import ActiveTool
from galen_msgs.srv import (
    CompareTools,
    GetTool,
    ListTools,
    RemoveTool,
    RenameTool,
    RevertTool,
    SetTool,
)

JOINTS = np.array([9.0, 9.0, 9.0, *STILL])


RMSE = np.arange(6) * 1e-3
POINTER, RETRACTOR = pointer(rmse=RMSE), pointer("retractor", 0.2, rmse=RMSE)


class Person(Bench):
    """Drives the arm, calls the services, hears which tool is active."""

    def __init__(self, harness: Harness, folder: Path) -> None:
        super().__init__(harness, folder, {"tare_window_s": 0.05, "tare_ramp_s": 0.05})
        self.told: list[ActiveTool] = []
        self.listener.create_subscription(
            ActiveTool, "gravcomp/active_tool", self.told.append, LATCHED
        )

    def ask(self, service: str, kind: Any, **request: Any) -> Any:
        return self.call(service, kind, kind.Request(**request))

    def wait_told(self, accepts: Callable[[ActiveTool], bool], what: str) -> ActiveTool:
        self.harness.wait_for(lambda: self.told and accepts(self.told[-1]), 5.0, what)
        return self.told[-1]

    def output(self) -> np.ndarray:
        """The newest one, after a step."""
        stamp = self.step(LEFT)
        self.harness.wait_for(lambda: self.output_at(stamp) is not None, 5.0, "an output")
        return self.output_at(stamp)


def test_tools_by_service_in_one_nodes_life(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tool_services, "_FILE_CHECK_S", 0.05)
    for tool in (POINTER, RETRACTOR, pointer("drill", 0.06 + 1e-5)):
        write_calibration(calibration_path(tmp_path, tool.tool), tool)
    write_calibration(tmp_path / "cut.json.bak", pointer("cut", 0.1))
    (tmp_path / "cut.json").write_text("{")
    with Harness() as harness:
        person = Person(harness, tmp_path)
        # Latched: told once at the start, before this node was there.
        first = person.wait_told(lambda m: True, "the topic")
        assert (first.tool, first.mass_kg, first.enabled) == ("pointer", 0.06, True)
        assert first.header.frame_id == "ft_sensor" and first.file_state == first.FILE_AS_LOADED
        assert first.path == str(tmp_path / "pointer.json") and not first.tared
        np.testing.assert_array_equal(np.reshape(first.covariance, (4, 4)), np.eye(4) * 1e-8)
        check_list_get_compare(person, tmp_path)
        check_rejections(person)
        check_tare_and_switch(person)
        check_rename_active(person, tmp_path)
        check_changed_file(person, tmp_path)
        check_revert_active(person, tmp_path)
        gone = person.ask("set_tool", SetTool, tool="")
        assert gone.success
        assert person.wait_told(lambda m: m.tool == "", "no tool").file_state == first.FILE_NONE
        assert person.ask("get_tool", GetTool).error_code == GetTool.Response.NOT_FOUND
        removed = person.ask("remove_tool", RemoveTool, tool="probe")
        assert removed.success and Path(removed.kept_as).is_file()
        assert [row.tool for row in person.ask("list_tools", ListTools).tools] == [
            "cut", "drill", "retractor",
        ]  # fmt: skip


def check_list_get_compare(person: Person, folder: Path) -> None:
    answer = person.ask("list_tools", ListTools)
    assert answer.success and answer.tools_dir == str(folder) and answer.left_out == 0
    rows = {row.tool: row for row in answer.tools}
    assert list(rows) == ["cut", "drill", "pointer", "retractor"]
    assert "not JSON" in rows["cut"].problem and rows["pointer"].problem == ""
    assert [row.active_tool for row in answer.tools] == [False, False, True, False]
    assert rows["retractor"].mass_kg == 0.2
    assert rows["retractor"].mass_std_kg == pytest.approx(1e-4)
    np.testing.assert_array_equal(rows["retractor"].rmse_force_n, [0.0, 1e-3, 2e-3])
    np.testing.assert_array_equal(rows["retractor"].rmse_torque_nm, [3e-3, 4e-3, 5e-3])
    assert np.isnan([*rows["cut"].rmse_force_n, *rows["cut"].rmse_torque_nm]).all()
    # An unreadable file can have a calibration before it, too.
    assert [row.has_previous for row in answer.tools] == [True, False, False, False]

    # Live joints reach the base; before there are any, they must be given.
    asked = {"tool": "retractor", "frame": "base_link"}
    answer = person.ask("get_tool", GetTool, **asked)
    assert answer.error_code == answer.NEEDS_JOINTS and "delta_x" in answer.error_msg
    given = person.ask("get_tool", GetTool, **asked, joints=JOINTS.tolist())
    person.output()
    live = person.ask("get_tool", GetTool, **asked)
    rotation, origin = GALEN.sensor_pose(JOINTS)
    for answer in (given, live):
        assert answer.success and answer.frame == "base_link" and not answer.active_tool
        np.testing.assert_allclose(answer.com_m, rotation @ RETRACTOR.load.com_m + origin)
        np.testing.assert_allclose(answer.tip_m, rotation @ RETRACTOR.tip_m + origin)
        np.testing.assert_array_equal(answer.joints, JOINTS)
    assert json.loads(live.content)["tool"] == "retractor"
    active = person.ask("get_tool", GetTool)
    assert (active.tool, active.active_tool, active.frame) == ("pointer", True, "ft_sensor")
    assert np.isnan(active.joints).all()
    np.testing.assert_array_equal(active.com_m, POINTER.load.com_m)

    other = person.ask("compare_tools", CompareTools, b="retractor")
    assert other.success and not other.same_load and "'active pointer'" in other.text
    assert other.worst_force_n == pytest.approx(0.14 * 9.80665)
    assert person.ask("compare_tools", CompareTools, a="pointer", b="drill").same_load


def check_rejections(person: Person) -> None:
    """Each code once; what is rejected is the store's table, test_tool_store's."""
    for service, kind, request, code, words in (
        ("get_tool", GetTool, {"tool": "../x"}, "INVALID_NAME", "letters"),
        ("get_tool", GetTool, {"frame": "tool0"}, "INVALID_FRAME", "tool0"),
        ("compare_tools", CompareTools, {"a_previous": True}, "NOT_FOUND", "pointer.json.bak"),
        ("rename_tool", RenameTool, {"tool": "drill", "new_name": "cut"}, "EXISTS", "cut.json"),
        ("rename_tool", RenameTool, {"tool": "cut", "new_name": "x"}, "INVALID_FILE", "cut.json"),
        ("remove_tool", RemoveTool, {"tool": "pointer"}, "IN_FORCE", "another active tool"),
    ):
        answer = person.ask(service, kind, **request)
        assert not answer.success
        assert answer.error_code == getattr(answer, code), (service, request, answer)
        assert words in answer.error_msg


def check_tare_and_switch(person: Person) -> None:
    tare = person.listener.create_client(Trigger, "gravcomp/tare").call_async(Trigger.Request())
    person.harness.wait_for(lambda: person.step(LEFT) and tare.done(), 5.0, "the tare")
    told = person.wait_told(lambda m: m.tared, "the tare")
    np.testing.assert_allclose(
        [told.tare.force.x, told.tare.force.y, told.tare.torque.z], LEFT[[0, 1, 5]]
    )
    person.ask("enable", SetBool, data=False)
    person.wait_told(lambda m: not m.enabled, "the switch")
    person.ask("enable", SetBool, data=True)
    assert person.wait_told(lambda m: m.enabled, "the switch").tared
    person.harness.wait_for(
        lambda: np.allclose(person.output(), 0.0, atol=1e-9), 5.0, "the ramp's end"
    )


def check_rename_active(person: Person, folder: Path) -> None:
    """It goes on under the new name: neither the load nor the tare changes, nothing steps."""
    before = person.output()
    answer = person.ask("rename_tool", RenameTool, tool="pointer", new_name="probe")
    assert answer.success and answer.path == str(folder / "probe.json")
    told = person.wait_told(lambda m: m.tool == "probe", "the new name")
    assert told.tared and told.path == answer.path and told.file_state == told.FILE_AS_LOADED
    np.testing.assert_array_equal(person.output(), before)
    active_tool = person.ask("get_tool", GetTool)
    assert active_tool.sha256 == told.sha256 and active_tool.content != ""
    assert not (folder / "pointer.json").exists()
    assert person.ask("remove_tool", RemoveTool, tool="probe").error_code == 4


def check_changed_file(person: Person, folder: Path) -> None:
    """A calibration that nobody activated is told, until somebody does."""
    path = folder / "probe.json"
    write_calibration(
        path, replace(POINTER, tool="probe", load=replace(POINTER.load, mass_kg=0.061))
    )
    told = person.wait_told(lambda m: m.file_state == m.FILE_CHANGED, "the change")
    assert told.mass_kg == 0.06
    person.report(lambda s, _: "has changed since" in s.message, "it", lambda: person.step(LEFT))
    # Renamed, what is active stays what was loaded, and so does the warning.
    assert person.ask("rename_tool", RenameTool, tool="probe", new_name="p2").success
    told = person.wait_told(lambda m: m.tool == "p2", "the new name")
    assert (told.mass_kg, told.file_state) == (0.06, told.FILE_CHANGED)
    assert person.ask("rename_tool", RenameTool, tool="p2", new_name="probe").success
    assert person.ask("set_tool", SetTool, tool="probe").success
    told = person.wait_told(lambda m: m.file_state == m.FILE_AS_LOADED, "the file loaded")
    assert (told.mass_kg, told.tared) == (0.061, False)
    path.rename(folder / "elsewhere")
    person.wait_told(lambda m: m.file_state == m.FILE_GONE, "the file gone")
    (folder / "elsewhere").rename(path)
    person.wait_told(lambda m: m.file_state == m.FILE_AS_LOADED, "the file back")


def check_revert_active(person: Person, folder: Path) -> None:
    """The file is the one before; what is active doesn't change until it is loaded."""
    before = person.output()
    compared = person.ask("compare_tools", CompareTools, a_previous=True, b="probe")
    assert compared.success and "'probe before' and 'probe'" in compared.text
    assert compared.differences[0].difference == pytest.approx(1e-3)
    answer = person.ask("revert_tool", RevertTool, tool="probe")
    assert answer.success and answer.path == str(folder / "probe.json")
    told = person.wait_told(lambda m: m.file_state == m.FILE_CHANGED, "the change")
    assert (told.tool, told.mass_kg) == ("probe", 0.061)
    np.testing.assert_array_equal(person.output(), before)
    compared = person.ask("compare_tools", CompareTools, a="probe", b="probe", b_previous=True)
    assert compared.differences[0].difference == pytest.approx(1e-3)
    # Back again, it is what was loaded.
    assert person.ask("revert_tool", RevertTool, tool="probe").success
    person.wait_told(lambda m: m.file_state == m.FILE_AS_LOADED, "the file as it was")
