# SPDX-License-Identifier: Apache-2.0
"""The command `tools`: what it prints, what it rejects, exit codes; without a node."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_files import pointer
from galen_gravcomp.ros import active_tool
from galen_gravcomp.tools import main
from galen_model.arm.description import read_arm
from galen_model.files.calibration_file import (
    CalibrationFile,
    calibration_path,
    write_calibration,
    zeroed_at,
)
from galen_model.load.cable import LearnedPull
from galen_model.load.mounting import Mounting

from galen_gravcomp import tools as tools_module


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    unresolved = ("how much of the load is the adapter",)
    for tool in (pointer(), pointer("retractor", 0.2, unresolved=unresolved)):
        write_calibration(calibration_path(tmp_path, tool.tool), tool)
    (tmp_path / "cut.json").write_text("{")
    return tmp_path


@dataclass
class Command:
    folder: Path
    capsys: Any
    err: str = field(default="")

    def __call__(self, *words: str, code: int = 0) -> str:
        assert main([*words, "--tools-dir", str(self.folder)]) == code
        captured = self.capsys.readouterr()
        self.err = captured.err
        return captured.out

    def json(self, *words: str) -> Any:
        return json.loads(self(*words, "--json"))


@pytest.fixture
def tools(folder: Path, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(folder, capsys)


def test_list_names_what_is_broken_and_what_was_removed(tools: Command) -> None:
    out = tools("list")
    assert "pointer" in out and "200.00 ± 0.100" in out and "one sweep" in out
    assert "cut.json: not JSON" in out
    assert f"kept as {tools.folder / 'pointer.json.removed'}" in tools("remove", "pointer", "--yes")
    assert "can be restored: pointer" in tools("list")
    found = tools.json("list")
    assert found["removed"] == ["pointer"]
    assert [(row["tool"], row["problem"] is None) for row in found["tools"]] == [
        ("cut", False), ("retractor", True),
    ]  # fmt: skip
    assert "'pointer' is back" in tools("restore", "pointer")
    assert tools.json("show", "pointer")["load"]["mass_kg"] == 0.06


def test_show_prints_the_file_and_its_optional_parts_whatever_they_hold(
    tools: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = tools.json("show", "pointer")
    assert found["load"]["com_m"] == [0.055, 0.002, 0.045] and found["tip_m"] == [0.15, 0.0, 0.05]
    assert found["path"] == str(tools.folder / "pointer.json") and len(found["sha256"]) == 64
    assert "not identified by the calibration: how much" in tools("show", "retractor")

    class Part:
        def to_json(self) -> dict[str, Any]:
            return {"gain": [1.0, 2.5], "covariance": [[1.0]], "nested": {"x": 0.1}}

    monkeypatch.setattr(CalibrationFile, "parts", ("of_later",))
    monkeypatch.setattr(CalibrationFile, "of_later", Part(), raising=False)
    out = tools("show", "pointer")
    assert "of_later" in out and "1 2.5" in out and "x: 0.1" in out and "given" in out


def test_compare(tools: Command) -> None:
    out = tools("compare", "pointer", "retractor")
    assert "another load: mass differs by 140 g (990 sigma)" in out
    found = tools.json("compare", "pointer", "retractor")
    assert found["differences"][0]["difference"] == pytest.approx(0.14)
    assert found["worst"]["force_n"] == pytest.approx(0.14 * 9.80665)
    assert next(r for r in found["differences"] if r["quantity"] == "tip_x")["std_dev"] is None


def test_the_calibration_before(tools: Command, capsys: pytest.CaptureFixture[str]) -> None:
    write_calibration(calibration_path(tools.folder, "pointer"), pointer(mass_kg=0.061))
    found = tools.json("compare", "pointer", "--previous")
    assert (found["a"], found["b"]) == ("pointer before", "pointer")
    assert found["differences"][0]["difference"] == pytest.approx(1e-3)
    assert "'pointer' is as calibrated 2026-01-01" in tools("revert", "pointer")
    assert tools.json("show", "pointer")["load"]["mass_kg"] == 0.06
    for words in (("compare", "pointer"), ("compare", "pointer", "retractor", "--previous")):
        with pytest.raises(SystemExit) as usage:
            main([*words, "--tools-dir", str(tools.folder)])
        assert usage.value.code == 2 and "--previous" in capsys.readouterr().err


def test_what_is_rejected_is_one_line_and_changes_nothing(tools: Command) -> None:
    before = {path.name: path.read_bytes() for path in tools.folder.iterdir()}
    for words, said in (
        (("rename", "pointer", "retractor"), "never overwritten"),
        (("remove", "none", "--yes"), "can't be read: No such file"),
        (("restore", "pointer"), "is there"),
        (("revert", "pointer"), "no calibration of 'pointer' before its present one"),
        (("compare", "pointer", "--previous"), "no calibration of 'pointer' before"),
        (("show", "cut"), "not JSON"),
    ):
        tools(*words, code=1)
        assert said in tools.err and tools.err.startswith("tools: ") and tools.err.count("\n") == 1
    assert before == {path.name: path.read_bytes() for path in tools.folder.iterdir()}
    assert "is now" in tools("rename", "pointer", "probe")
    assert (tools.folder / "probe.json").is_file() and not (tools.folder / "pointer.json").exists()


def test_remove_asks(
    tools: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Terminal:
        answer = ""

        def isatty(self) -> bool:
            return True

        def readline(self) -> str:
            if self.answer == "interrupt":
                raise KeyboardInterrupt
            return self.answer

    terminal = Terminal()
    monkeypatch.setattr(tools_module.sys, "stdin", terminal)
    for answer, code in (("n\n", 1), ("", 1), ("interrupt", 130), ("y\n", 0)):
        terminal.answer = answer
        tools("remove", "pointer", code=code)
        assert "remove 'pointer' (60.0 g, calibrated 2026" in tools.err
        assert (tools.folder / "pointer.json").exists() == (code != 0)
    terminal.isatty = lambda: False  # type: ignore[method-assign]
    with pytest.raises(SystemExit) as usage:
        main(["remove", "retractor", "--tools-dir", str(tools.folder)])
    assert usage.value.code == 2 and "give --yes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ("pointer", "0.06", "0.5 0 0", "as loaded")),
        ({"enabled": False}, ("switched off",)),
        ({"file_state": "changed"}, ("file is changed since it was loaded",)),
        ({"tool": ""}, ("no tool is active",)),
    ],
)
def test_active_shows_the_topic_and_what_is_wrong(
    changes: dict[str, Any],
    words: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    state = {"tool": "pointer", "enabled": True, "mass_kg": 0.06, "tare": [0.5, 0.0, 0.0]}
    state |= {"file_state": "as loaded"} | changes
    monkeypatch.setattr(active_tool, "read_active", lambda *_: state)
    assert main(["active"]) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in words)
    assert main(["active", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == state


SIX_AXIS = Path(__file__).parents[2] / "galen_bringup/urdf/six_axis.urdf"


def test_export_prints_what_a_driver_takes(tools: Command) -> None:
    out = tools("export", "pointer", "--format", "ur")
    assert "set_payload(0.16, [0.020625, 0.00075, 0.029375])\n" in out
    found = tools.json("export", "pointer", "--format", "urdf")
    assert found["frame"] == "ft_sensor" and found["mass_kg"] == pytest.approx(0.16)
    assert tools("export", "pointer", "--format", "urdf") == found["text"]
    for words, said in (
        (("--frame", "tool0"), "no frame 'tool0'; there are ft_sensor"),
        (("--frame", "roll_link"), "'roll_link' depends on tilt"),
    ):
        tools("export", "pointer", "--format", "kuka", *words, code=1)
        assert said in tools.err


@pytest.mark.parametrize("zeroed", [True, False])
def test_a_tool_of_another_arm_needs_its_description_for_what_the_file_lacks_alone(
    tools: Command, zeroed: bool
) -> None:
    arm = read_arm(SIX_AXIS.read_text(), sensor_frame="tool0")
    zeroing = zeroed_at(arm=arm) if zeroed else None
    for name, mass_kg in (("grip", 0.06), ("drill", 0.07)):
        made = pointer(name, mass_kg=mass_kg, arm=arm, zeroing=zeroing)
        write_calibration(calibration_path(tools.folder, name), made)
    with_arm = ("--urdf", str(SIX_AXIS), "--sensor-frame", "tool0")
    rows = {row["tool"]: row["problem"] for row in tools.json("list")["tools"]}
    assert rows["grip"] is None and rows["pointer"] is None
    assert "tool0" in tools("list") and "centre in tool0" in tools("show", "grip")
    assert "can't be used" in tools("list", *with_arm)
    found = tools.json("export", "grip", "--format", "ur")
    assert (found["frame"], found["mass_kg"]) == ("tool0", pytest.approx(0.16))
    worst = [tools.json("compare", "grip", "drill", *words)["worst"] for words in ((), with_arm)]
    for axes in ("force_n", "torque_nm"):
        assert worst[0][axes] == pytest.approx(worst[1][axes], rel=0.01)
    for words, said in (
        (("compare", "grip", "pointer"), "of two arms"),
        (("export", "grip", "--format", "control_toolbox"), "--urdf FILE and --sensor-frame tool0"),
        (("export", "grip", "--format", "ur", "--frame", "flange"), "frame 'flange' is in the"),
        (("export", "pointer", "--format", "franka", *with_arm), "this arm is 'six_axis'"),
    ):
        tools(*words, code=1)
        assert said in tools.err
    assert "is now" in tools("rename", "grip", "probe")


def test_a_mounting_and_a_cable_of_another_arm_are_shown(tools: Command) -> None:
    arm = read_arm(SIX_AXIS.read_text())
    flat = np.zeros(3), np.ones(6)
    pull = LearnedPull(
        "point_and_couple", np.zeros((30, 6)), np.zeros((30, 6)), np.full((30, 6), 0.01),
        flat[1], 0.15, np.array([0.2, 0.02]), 0.4, "today", flat[0], arm=arm,
    )  # fmt: skip
    parts: dict[str, Any] = {"mounting": Mounting.of(arm), "cable": pull}
    write_calibration(
        calibration_path(tools.folder, "grip"), pointer("grip", arm=arm, zeroing=None, **parts)
    )
    assert tools.json("show", "grip")["mounting"]["joint_zero_rad"]["elbow"] == 0.0
    tools("compare", "grip", "grip", code=1)
    assert "has a mounting" in tools.err and "--urdf FILE" in tools.err
