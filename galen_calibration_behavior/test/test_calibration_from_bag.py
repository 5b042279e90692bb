# SPDX-License-Identifier: Apache-2.0
"""`calibrate_from_bag` on the sample recordings, and on those of a lab where they are there."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from calibration_tape import POINTER, Tape
from galen_calibration_behavior.calibrate_from_bag import main, parse
from galen_calibration_behavior.from_bag.loads import sample_time
from galen_common.command import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration
from galen_model.load.model import ADAPTER, TOOLS

BAGS = Path(__file__).resolve().parents[2] / "bags"
POINTER_BAG = str(BAGS / "pointer_calibration")
# chi-square with 4 degrees of freedom is above it once in 10000 draws
CHI2_4 = 23.5


def run(capsys, *arguments):
    """Return exit code, standard output, standard error."""
    try:
        code = main(list(arguments))
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def error_squared(estimated, true):
    error = np.array([estimated.mass_kg - true.mass_kg, *(estimated.com_m - true.com_m)])
    return error @ np.linalg.solve(estimated.covariance, error)


def test_a_sample_recording_gives_the_loads_that_made_it_and_one_json_object(capsys, tmp_path):
    bag, path = str(BAGS / "retractor_calibration"), tmp_path / "retractor.json"
    options = ("--json", "--tip", "0.15", "0", "0.05", "--tools-dir", str(tmp_path))
    code, out, error = run(capsys, "retractor", bag, *options)
    result, file = json.loads(out), read_calibration(path, arm=GALEN)
    assert (code, result["error_code"], result["file"]) == (0, 0, str(path)), error
    assert error_squared(file.load, TOOLS["retractor"].load) < CHI2_4
    assert error_squared(file.adapter, ADAPTER) < CHI2_4
    assert result["mass_kg"] == file.load.mass_kg
    assert result["poses_used"] == file.poses_used == 56
    assert file.poses_rejected == ()
    assert file.zero_angles.tolist() == [0.0, 0.0]
    assert 95.0 < result["tool_on_s"][0] < result["tool_on_s"][1] < 110.0
    assert result["next_border_worse_sigmas"] > 300.0
    (warning,) = result["warnings"]  # the recording's order is a serpentine
    assert "sweep without the tool and sweep with the tool: in the order of these poses" in warning


@pytest.fixture
def tape(monkeypatch, plain_fit):
    """A short recording in place of any bag, with no models compared."""
    recording = Tape().calibration(POINTER).recording()
    read = "galen_calibration_behavior.from_bag.loads.read_arm"
    monkeypatch.setattr(read, lambda *_, **_options: recording)


@pytest.mark.usefixtures("tape")
def test_a_person_gets_the_live_one_s_table_and_a_dry_run_writes_nothing(capsys, tmp_path):
    arguments = ("pointer", "bag", "--tools-dir", str(tmp_path / "tools"))
    code, out, error = run(capsys, *arguments, "--dry-run", "--json")
    assert (code, error, json.loads(out)["file"]) == (0, "", "")
    assert not (tmp_path / "tools").exists()
    code, out, error = run(capsys, *arguments)
    assert "12 poses without the tool, 12 poses with it" in out
    assert "RMSE torque [mN.m]" in out
    assert "warning: the tool's tip is not known" in out
    assert out.rstrip().endswith(f"written: {tmp_path / 'tools' / 'pointer.html'}")


@pytest.mark.usefixtures("tape")
def test_a_wrong_set_up_is_named_and_nothing_is_written_unless_it_is_said(capsys, tmp_path):
    """The arm stands upright; told that it hangs, the load that fits is negative."""
    hangs = ("pointer", "bag", "--gravity", "0", "0", "9.80665", "--tools-dir", str(tmp_path))
    code, out, error = run(capsys, *hangs)
    assert (code, out, list(tmp_path.iterdir())) == (EXIT_FAILED, "", [])
    assert "the load that fits has the mass -160 g" in error.lower()
    assert "base_link is inclined by 180.0 deg" in error and "--gravity 0 0 -9.80665" in error
    assert "the reading is reversed" in error and "what separates them" in error
    assert run(capsys, *hangs, "-p", "check_setup:=false")[0] == EXIT_FAILED  # no such load
    on_a_wall = (*hangs[:3], "9.80665", "0", "0", *hangs[6:])
    code, _, error = run(capsys, *on_a_wall)
    assert code == EXIT_FAILED and "--gravity 0 0 -9.80665" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([str(BAGS / "free_motion")], "still pose"),
        ([POINTER_BAG, "--joint-names", "a,b,c,d,e"], "joint"),
        ([POINTER_BAG, "--one-sweep"], "the load is another from"),
        ([POINTER_BAG, "-p", "min_samples:=400"], "400 wrenches are needed"),
        ([str(BAGS / "nowhere")], "nowhere"),
    ],
)
def test_what_gives_no_file_is_said_in_one_line_and_leaves_nothing(
    capsys, tmp_path, arguments, words
):
    code, out, error = run(capsys, "pointer", *arguments, "--tools-dir", str(tmp_path))
    assert (code, out) == (EXIT_FAILED, "")
    assert error.startswith("calibrate_from_bag: ")
    assert error.count("\n") == 1
    assert words in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("tape")
def test_a_newer_calibration_is_replaced_only_if_asked(capsys, tmp_path):
    old = json.loads((BAGS / "tools/pointer.json").read_text())
    now = datetime.now(UTC).isoformat(timespec="seconds")
    file = tmp_path / "pointer.json"
    file.write_text(json.dumps(old | {"calibrated_at": now}))
    before = file.read_bytes()
    arguments = ["pointer", "bag", "--tools-dir", str(tmp_path), "--tool-on-at-s", "23.5"]
    code, out, error = run(capsys, *arguments)
    assert (code, out, file.read_bytes()) == (EXIT_FAILED, "", before)
    assert f"{file}: not replaced: calibrated {now} (just now)" in error
    assert "2023-11-14T22:1" in error and "days ago" in error and "--replace-newer" in error
    code, _, error = run(capsys, *arguments, "--replace-newer")
    assert (code, error) == (0, "")
    # The recording that gave the file is not older than it.
    assert run(capsys, *arguments)[0] == 0


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["pointer"],
        ["../x", "bag"],
        ["pointer", "bag", "--bare", "other"],
        ["pointer", "--bare", "other"],
        ["pointer", "--bare", "a", "--with-tool", "b", "--one-sweep"],
        ["pointer", "--bare", "a", "--with-tool", "b", "--tool-on-at-s", "3"],
        ["pointer", "bag", "--one-sweep", "--tool-on-at-s", "3"],
        ["pointer", "bag", "--tip", "nan", "0", "0"],
        ["pointer", "bag", "--tool-on-at-s", "inf"],
        ["pointer", "bag", "-p", "average_s:=0"],
        ["pointer", "bag", "-p", "avarage_s:=1"],
        ["pointer", "bag", "-p", "average_s"],
        ["pointer", "bag", "-p", "Rhome:=9.0"],
        ["pointer", "bag", "--joint-names", "a,b"],
    ],
)
def test_wrong_arguments_end_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        parse(arguments)
    assert end.value.code == EXIT_USAGE
    assert "calibrate_from_bag: error:" in capsys.readouterr().err


def test_the_time_is_the_stamp_s_or_else_when_it_was_received():
    at = 1_700_000_000 * 10**9
    assert sample_time(at, at + 10**12).isoformat() == "2023-11-14T22:13:20+00:00"
    assert sample_time(5 * 10**9, at).isoformat() == "2023-11-14T22:13:20+00:00"
    assert sample_time(5 * 10**9, 6 * 10**9).year == 1970


def test_ctrl_c_ends_with_130_and_writes_nothing(capsys, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("galen_calibration_behavior.from_bag.loads.read_arm", interrupted)
    code, _, error = run(capsys, "pointer", POINTER_BAG, "--tools-dir", str(tmp_path))
    assert code == EXIT_INTERRUPTED
    assert "nothing is written" in error
    assert list(tmp_path.iterdir()) == []
