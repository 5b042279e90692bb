# SPDX-License-Identifier: Apache-2.0
"""`evaluate BAG...` as a user types it."""

import json
import pickle
import re

import pytest
from galen_gravcomp.evaluate.bag import BagJob
from galen_gravcomp.evaluate.bag_report import COLUMNS
from galen_gravcomp.evaluate.command import main
from galen_model.files.calibration_file import write_calibration
from gravcomp_bags import Recording, tool_file


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Three recordings, each with its tool's file beside it, and a broken one."""
    folder = tmp_path_factory.mktemp("archive")
    for name, mass_kg in (("monday", 0.2), ("tuesday", 0.2), ("friday", 0.23)):
        recording = Recording(tool_file(mass_kg), poses=8, hold_s=1.0)
        recording.write(folder / name / "sweep")
        write_calibration(folder / name / "retractor.json", tool_file())
    broken = folder / "wednesday"
    broken.mkdir()
    (broken / "broken.mcap").write_bytes(b"\x89MCAP0\r\nno")
    write_calibration(broken / "retractor.json", tool_file())
    return folder


def test_one_bag_gives_a_report_a_picture_and_a_bag(archive, tmp_path, capsys):
    bag, tool = archive / "friday" / "sweep", archive / "friday" / "retractor.json"
    arguments = [str(bag), "--tool", str(tool)]
    code = main(
        [*arguments, "--plots", str(tmp_path / "plots"), "--write-bags", str(tmp_path / "out")]
    )
    out = capsys.readouterr().out
    assert code == 0
    told = re.search(r"as of another load, by \+([\d.]+) \+-", out.replace("\n", " "))
    assert float(told.group(1)) == pytest.approx(30.0, abs=1.0)
    assert re.search(r"load less the file's: \+(29\.\d|30\.\d)\d \+- 0\.\d+ g", out)
    for part in ("rest segments' means", "another load", "Worst rest segments", "Time stamps"):
        assert part in out
    picture = tmp_path / "plots" / "sweep_evaluation.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 30_000
    assert str(picture) in out.replace("\n", "")
    assert main([str(tmp_path / "out" / "sweep_compensated"), "--tool", str(tool)]) == 0


def test_a_folder_gives_one_table_and_a_broken_bag_does_not_stop_the_rest(archive, capsys):
    code = main([str(archive), "--tool-beside", "retractor.json", "--json", "--workers", "1"])
    rows = json.loads(capsys.readouterr().out)["bags"]
    assert code == 1
    verdicts = {row["bag"].split("/")[-2]: row.get("verdict") for row in rows if "verdict" in row}
    assert verdicts == {"monday": "fits", "tuesday": "fits", "friday": "load"}
    (broken,) = [row for row in rows if "error" in row]
    assert "wednesday" in broken["error"]
    assert main([str(archive), "--tool-beside", "retractor.json", "--workers", "1"]) == 1
    out = capsys.readouterr().out
    assert "Does the file still fit?" in out
    assert "│ monday/sweep " in out  # below the folder that all share
    assert f"{archive}/monday/sweep" not in out
    friday = "friday/sweep: "
    (line,) = [line for line in out.splitlines() if line.startswith(friday)]
    assert re.search(r"as of another load, by \+(29\.9|30\.[01]) ", line)
    assert "broken" in out


def test_brackets_in_names_are_shown_as_they_are(archive, tmp_path, capsys):
    for name in ("br[", "[red]"):
        (tmp_path / "a[b]" / name).mkdir(parents=True)
        (tmp_path / "a[b]" / name / "x].mcap").write_bytes(b"no bag")
    odd = tmp_path / "a[b]" / "br[" / "[bold]"
    odd.symlink_to(archive / "friday" / "sweep")
    tool = str(archive / "friday" / "retractor.json")
    assert main([str(tmp_path), "--tool", tool, "--workers", "1"]) == 1
    out = capsys.readouterr().out
    assert "br[/x].mcap" in out and "[red]/x].mcap" in out and "br[/[bold]: " in out
    assert main([str(odd), "--tool", tool]) == 0
    assert "br[/[bold]: " in capsys.readouterr().out


def test_an_archive_s_results_are_kept_and_tabled(archive, tmp_path, capsys):
    arguments = [str(archive), "--tool-beside", "retractor.json", "--workers", "1"]
    arguments += ["--results", str(tmp_path / "kept")]
    assert main([*arguments, "--json"]) == 1
    summary = json.loads(capsys.readouterr().out)
    assert [summary[name] for name in ("done", "skipped", "failed")] == [3, 0, 1]
    assert summary["verdicts"] == {"fits": 2, "load": 1}
    table = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "kept" / "table.parquet")
    assert table.column_names == ["recording", "error", *COLUMNS]
    rows = {row["recording"].split("/")[-2]: row for row in table.to_pylist()}
    assert "wednesday" in rows["wednesday"]["error"]
    assert rows["friday"]["load_error_kg"] == pytest.approx(0.03, abs=1e-3)
    assert 0.0 < rows["monday"]["rmse_still_phases_tz_Nm"] < 1e-3 and not rows["monday"]["error"]
    assert all(rows["monday"][name] is not None for name in COLUMNS if "drift" not in name)
    assert main(arguments) == 1
    out, err = capsys.readouterr()
    assert "0 done, 3 skipped, 1 failed" in out and "fits: 2" in out
    assert "wednesday" in err
    # Other limits are another question.
    assert main([*arguments, "--limit-force-n", "9", "--limit-torque-nm", "9", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["verdicts"] == {"fits": 3}


def test_a_job_can_be_sent_to_another_process(archive):
    folder = archive / "monday"
    job = BagJob(tool=folder / "retractor.json")
    assert pickle.loads(pickle.dumps(job))(folder / "sweep") == job(folder / "sweep")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "--tool", "{tool}"], "nowhere"),
        (["{bag}", "--tool", "nothing.json"], "nothing.json"),
        (["{bag}", "--tool-beside", "nothing.json"], "nothing.json"),
        (["{bag}", "--tool", "{tool}", "--wrench-raw", "ft/raw"], "it has /wrench_raw"),
        (["{bag}", "--tool", "{tool}", "--joint-names", "a,b,c"], "joint names"),
        (["{bag}", "--tool", "{tool}", "--write-bags", "{taken}"], "is there already"),
        (["{bag}", "--tool", "{tool}", "--write-bags", "{tool}"], "is no directory"),
        (["{bag}", "--tool", "{tool}", "--plots", "{tool}"], "is no directory"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_exit_code_1(
    archive, tmp_path, capsys, arguments, message
):
    taken = tmp_path / "taken"
    (taken / "sweep_compensated").mkdir(parents=True)
    places = {
        "tool": archive / "monday" / "retractor.json",
        "bag": archive / "monday" / "sweep",
        "taken": taken,
    }
    assert main([argument.format(**places) for argument in arguments]) == 1
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert error.startswith("evaluate: ")


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["bag"],
        ["bag", "t.csv", "--tool", "x"],
        ["bag", "--tool", "x", "--tool-beside", "y"],
        ["bag", "--tool", "x", "--max-joint-age-s", "100"],
        ["bag", "--tool", "x", "--limit-force-n", "0"],
    ],
)
def test_wrong_usage_is_exit_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "usage: evaluate BAG" in capsys.readouterr().err


def test_joints_that_are_not_there_are_said_as_the_node_says_it(archive, tmp_path, capsys):
    names = ["a", "b", "c", "d", "e"]
    Recording(tool_file(), poses=3).write(tmp_path / "bag", joint_names=names)
    tool = str(archive / "monday" / "retractor.json")
    assert main([str(tmp_path / "bag"), "--tool", tool]) == 0
    out = capsys.readouterr().out
    assert "joint state lacks roll, tilt; it has a, b, c, d, e" in out.replace("\n", " ")
    assert main([str(tmp_path / "bag"), "--tool", tool, "--joint-names", "a,b,c,d,e"]) == 0
    assert "the file fits" in capsys.readouterr().out
