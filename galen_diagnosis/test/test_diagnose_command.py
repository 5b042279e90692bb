# SPDX-License-Identifier: Apache-2.0
"""The command `diagnose`: what it writes, its exit codes, and that it never looks at the truth."""

import json
import os
import shutil
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from diagnosis_example import example_diagnosis
from galen_diagnosis.observation.recording import DiagnosticRecording
from galen_diagnosis.observation.specification import Specification
from galen_diagnosis.report import report
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import read_calibration
from matplotlib import pyplot as plt

from galen_diagnosis import diagnose

ROOT = Path(__file__).resolve().parents[2]
ALL = [
    "corrected.urdf",
    "corrected_retractor.json",
    "diagnosis.json",
    "found_effect.mjcf.xml",
    "found_effect.yaml",
    "pictures",
    "report.html",
]


@cache
def diagnosed_as(verdict):
    return example_diagnosis(verdict)


NO_LIMITS = Specification("none", "", {})


@pytest.fixture
def recordings(monkeypatch, tmp_path):
    """Work in a directory of its own; names of recordings are their verdicts."""

    def read(path, tool=None, **options):
        if path.name.startswith("broken"):
            raise GalenError(f"{path}: no directory with a recording")
        retractor = read_calibration(ROOT / "bags" / "tools" / "retractor.json", arm=GALEN)
        return DiagnosticRecording(path.name, retractor, {}, (), (), GALEN, NO_LIMITS)

    def diagnosed(recording, progress=None, references=()):
        diagnosis = diagnosed_as(recording.name.split("_")[0])
        return replace(diagnosis, answer=replace(diagnosis.answer, recording=recording.name))

    monkeypatch.setattr(diagnose, "read_recording", read)
    monkeypatch.setattr(diagnose, "diagnose_recording", diagnosed)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return diagnose.main([str(argument) for argument in arguments])


@pytest.mark.slow
def test_writes_answer_report_and_the_drivers_file(recordings, capsys):
    assert run("identified") == 0
    folder = recordings / "diagnosis_identified"
    assert sorted(path.name for path in folder.iterdir()) == ALL
    content = json.loads((folder / "diagnosis.json").read_text())
    assert content["verdict"] == "identified" and content["causes"][0]["probability"] == 0.93
    assert content["where"]["channels"]["fx"] > 0.4
    pictures = sorted((folder / "pictures").iterdir())
    assert [path.name for path in pictures] == ["answer.png", "gap.png"]
    for file in pictures:
        pixels = plt.imread(file)
        assert min(pixels.shape[:2]) > 500 and np.ptp(pixels[..., :3]) > 0.9
    assert (folder / "report.html").read_text().count("data:image/png") == 2
    out, err = capsys.readouterr()
    assert content["sentence"][:40] in out and "written: diagnosis_identified" in out
    assert err == "" and "several can be there together" in " ".join(out.split())
    assert [path.name for path in recordings.iterdir()] == ["diagnosis_identified"]


def test_json_is_what_is_in_the_file(recordings, capsys):
    assert run("none", "--json", "--no-report", "--output", "somewhere/else") == 0
    folder = recordings / "somewhere" / "else"
    assert json.loads(capsys.readouterr().out) == json.loads(
        (folder / "diagnosis.json").read_text()
    )
    assert [path.name for path in folder.iterdir()] == ["diagnosis.json"]


def test_a_gap_can_be_an_exit_code(recordings):
    assert run("none", "--no-report", "--fail-on-gap") == 0
    assert run("unknown", "--no-report", "--fail-on-gap") == diagnose.EXIT_GAP
    assert run("unknown_2", "--no-report") == 0


def test_an_old_diagnosis_is_replaced_only_when_asked(recordings, capsys):
    assert run("none", "--no-report", "--output", "o") == 0
    assert run("unknown", "--no-report", "--output", "o") == 1
    assert "o: is there already" in capsys.readouterr().err
    assert json.loads(Path("o/diagnosis.json").read_text())["verdict"] == "none"
    assert run("unknown", "--no-report", "--output", "o", "--overwrite") == 0
    assert json.loads(Path("o/diagnosis.json").read_text())["verdict"] == "unknown"
    Path("home").mkdir()
    Path("home/letter.txt").write_text("dear")
    assert run("unknown", "--no-report", "--output", "home", "--overwrite") == 1
    assert Path("home/letter.txt").read_text() == "dear"
    assert sorted(path.name for path in recordings.iterdir()) == ["home", "o"]


def test_what_fails_half_way_leaves_nothing(recordings, monkeypatch, capsys):
    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    assert run("none", "--no-report", "--output", "o") == 0
    monkeypatch.setattr(report, "_put", full)
    assert run("unknown", "--no-report", "--output", "o", "--overwrite") == 1
    assert run("unknown", "--no-report", "--output", "new") == 1
    assert capsys.readouterr().err.count("can't be written: No space left on device") == 2
    assert [path.name for path in recordings.iterdir()] == ["o"]
    assert json.loads(Path("o/diagnosis.json").read_text())["verdict"] == "none"


def test_of_many_recordings_the_good_ones_are_diagnosed_and_printed(recordings, capsys):
    names = ("none_1", "broken", "unknown", "--no-report", "--output", "all", "--workers", "1")
    assert run(*names) == 1
    assert "failed: broken: no directory" in capsys.readouterr().out
    assert run("none_2", "unknown_2", "--no-report", "--workers", "1", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["recordings"]
    assert [row["verdict"] for row in rows] == ["none", "unknown"]


def test_an_archive_s_answers_are_kept_and_tabled(recordings, capsys):
    for name in ("a/none/sweep", "b/none/push", "b/identified/motion", "b/broken/sweep"):
        Path("lab", name).mkdir(parents=True)
    arguments = ("lab", "--no-report", "--workers", "1", "--results", "kept", "--output", "all")
    assert run(*arguments) == 1
    out, err = capsys.readouterr()
    assert "4 recordings: 3 done, 0 skipped, 1 failed" in out and "b/broken" in err
    names = ["diagnosis_a_none", "diagnosis_b_identified", "diagnosis_b_none"]
    assert sorted(path.name for path in Path("all").iterdir()) == names
    table = pytest.importorskip("pyarrow.parquet").read_table("kept/table.parquet")
    assert table.column_names == ["recording", "error", *report.COLUMNS]
    rows = {row["recording"]: row for row in table.to_pylist()}
    assert [row["verdict"] for row in rows.values()] == ["none", None, "identified", "none"]
    found = rows["lab/b/identified"]
    assert found["probability"] == 0.93 and found["causes"] and found["gap_before"] > 1.0
    shutil.rmtree("lab/b/broken")
    assert run(*arguments, "--fail-on-gap") == diagnose.EXIT_GAP
    assert "3 recordings: 0 done, 3 skipped, 0 failed" in capsys.readouterr().out
    again = (*arguments[:-3], "again", *arguments[-2:])
    assert run(*again) == 1
    assert capsys.readouterr().err.count("--overwrite replaces") == 3
    assert run(*again, "--overwrite") == 0


def test_two_recordings_of_one_name_are_rejected_before_any_work(recordings, capsys):
    assert run("a/none", "b/none", "--no-report") == 1
    assert "would be written twice" in capsys.readouterr().err
    assert list(recordings.iterdir()) == []


def test_next_says_where_there_is_nothing_to_separate(recordings, capsys):
    assert run("none", "--no-report", "--next", "next.yaml") == 0
    assert "next.yaml not written: the verdict is none" in capsys.readouterr().err
    assert not Path("next.yaml").exists()


def test_two_effects_of_a_kind_are_a_problem_and_no_file(recordings, monkeypatch):
    twice = replace(diagnosed_as("identified"), effects=diagnosed_as("identified").effects * 2)
    monkeypatch.setattr(
        diagnose, "diagnose_recording", lambda recording, progress=None, references=(): twice
    )
    assert run("identified", "--no-report", "--output", "o") == 0
    assert not list(Path("o").glob("found_effect.*"))
    content = json.loads(Path("o/diagnosis.json").read_text())
    assert "found_effect.yaml is not written" in content["problems"][-1]


def test_wrong_arguments_are_2(recordings, capsys):
    for arguments in ([], ["a", "b", "--next", "n.yaml"], ["a", "--workers", "0"]):
        with pytest.raises(SystemExit) as ended:
            run(*arguments)
        assert ended.value.code == 2


def test_the_truth_is_never_opened(monkeypatch, tmp_path, capsys):
    folder, seen = tmp_path / "recording", []
    poses = sweep_poses(arm=GALEN)[:2]
    make_recording(folder, arm=GALEN, poses=poses, bags=("sweep",), truth=True)
    for truth in (folder / "truth.json", folder / "sweep" / "truth.json"):
        truth.write_text("not even JSON")

    def diagnosed(recording, progress=None, references=()):
        seen.append(recording)
        return diagnosed_as("none")

    monkeypatch.setattr(diagnose, "diagnose_recording", diagnosed)
    opened, watching = [], [True]

    def see(event, arguments):  # there is no way to take a hook away
        if watching and event == "open" and isinstance(arguments[0], str | bytes):
            opened.append(Path(os.fsdecode(arguments[0])).name)

    sys.addaudithook(see)
    assert run(folder, "--no-report", "--output", tmp_path / "out") == 0
    watching.clear()
    assert set(seen[0].bags) == {"sweep"}
    assert "tool.json" in opened and any(name.endswith(".mcap") for name in opened)
    assert "truth.json" not in opened
