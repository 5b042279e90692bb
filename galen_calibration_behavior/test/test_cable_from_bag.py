# SPDX-License-Identifier: Apache-2.0
"""`calibrate_from_bag --estimate cable`: from a sweep to the tool's file, and where it can't."""

import functools
import json

import numpy as np
import pytest
from calibration_tape import RETRACTOR, Tape, grid
from check_pointer_file import calibrated
from galen_calibration_behavior.calibrate_from_bag import main, parse
from galen_calibration_behavior.from_bag import parts
from galen_model.arm.galen import GALEN
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.model import ADAPTER, TOOLS, gravity_wrench

AT = np.array([0.08, 0.0, 0.06])
ANCHOR = np.array([0.35, 0.35, 0.9])
POSES = grid(np.linspace(-1.2, 1.2, 6), np.linspace(-0.9, 0.8, 5))


def pull(pose):
    rotation, origin = GALEN.sensor_pose([*GALEN.home[:3], *pose])
    line = ANCHOR - origin - rotation @ AT
    length = np.linalg.norm(line)
    force = rotation.T @ line / length * (0.3 + length - 0.5)
    return np.concatenate([force, np.cross(AT, force)])


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A tools' directory with a calibrated retractor, and recordings by name."""
    known = {"rmse": np.zeros(6), "calibrated_at": "2023-11-01T03:04:05+00:00"}
    tool = calibrated(RETRACTOR, "retractor", 1e-5, **known)
    write_calibration(tmp_path / "retractor.json", tool)
    tapes = {}
    monkeypatch.setattr(parts, "read_recording", lambda _options, bag: tapes[str(bag)])

    def record(name, pull_at, poses=POSES, tool=RETRACTOR):
        tape = Tape(seed=5, tool=tool)
        tape.bias = gravity_wrench(GALEN.gravity_in_sensor((0.0, 0.0)), ADAPTER)
        for pose in poses:
            tape.move(pose)
            tape.touch = lambda _, at=pose: pull_at(at)
            tape.stay(1.0)
        tapes[name] = tape.recording(name)

    return tmp_path, record


@pytest.fixture
def one_form(monkeypatch):
    """Only one form is tried, which is a third of the work."""
    learn = functools.partial(parts.learn_cable, forms=("point",))
    monkeypatch.setattr(parts, "learn_cable", learn)


def run(*arguments):
    """Return the exit code; without a recording the cable is removed."""
    estimate = () if "--remove-cable" in arguments else ("--estimate", "cable")
    return main([str(argument) for argument in (*arguments, *estimate)])


def test_it_learns_the_pull_and_keeps_the_rest_of_the_file(place, capsys, one_form):
    folder, record = place
    record("corded", pull)
    before = json.loads((folder / "retractor.json").read_text())
    run("retractor", "corded", "--tools-dir", folder, "--json")
    fields = json.loads(capsys.readouterr().out)
    tool = read_calibration(folder / "retractor.json", arm=GALEN)
    after = json.loads((folder / "retractor.json").read_text())
    assert {key: after[key] for key in before} == before
    rng = np.random.default_rng(2)
    angles = rng.uniform([-1.2, -0.9], [1.2, 0.8], (20, 2))
    joints = np.column_stack([np.tile(GALEN.home[:3], (20, 1)), angles])
    error = tool.cable.posterior.readings(joints) - [pull(pose) for pose in angles]
    assert np.abs(error[:, :3]).max() < 0.012
    assert np.abs(error[:, 3:]).max() < 5e-4
    scores = fields["held_out"]
    ours, plain = scores[fields["form"]], scores["ten-parameter least squares"]
    assert (
        ours["times_noise"] < 0.2 * plain["times_noise"] < scores["the tool's file"]["times_noise"]
    )
    assert fields["poses"] == 30
    assert any("one place of the platform" in warning for warning in fields["warnings"])

    assert run("retractor", "--remove-cable", "--tools-dir", folder) == 0
    assert json.loads((folder / "retractor.json").read_text()) == before
    assert run("retractor", "--remove-cable", "--tools-dir", folder) == 1
    assert "holds no cable" in capsys.readouterr().err


def test_a_person_gets_a_table_and_a_dry_run_writes_nothing(place, capsys, one_form):
    folder, record = place
    record("corded", pull)
    before = (folder / "retractor.json").read_bytes()
    run("retractor", "corded", "--tools-dir", folder, "--dry-run")
    text = capsys.readouterr().out
    assert "ten-parameter least squares" in text
    assert "not written (--dry-run)" in text
    assert (folder / "retractor.json").read_bytes() == before


@pytest.mark.parametrize(
    ("pull_at", "tool", "words"),
    [
        (lambda _: np.zeros(6), RETRACTOR, "no pull beyond the noise"),
        (pull, TOOLS["pointer"].load, "the file of 300.0 g on the sensor, more than 20 %"),
    ],
)
@pytest.mark.usefixtures("one_form")
def test_where_there_is_no_cable_to_learn_it_says_so(place, capsys, pull_at, tool, words):
    folder, record = place
    record("sweep", pull_at, tool=tool)
    before = (folder / "retractor.json").read_bytes()
    assert run("retractor", "sweep", "--tools-dir", folder) == 1
    error = capsys.readouterr().err
    assert error.startswith("calibrate_from_bag: sweep: ") and words in error
    assert error.count("\n") == 1
    assert (folder / "retractor.json").read_bytes() == before


def test_a_recording_from_before_the_calibration_is_rejected(place, capsys):
    folder, record = place
    record("sweep", pull, POSES[:2])
    file = folder / "retractor.json"
    file.write_text(file.read_text().replace("2023-11-01", "2026-01-02"))
    before = file.read_bytes()
    assert run("retractor", "sweep", "--tools-dir", folder) == 1
    assert file.read_bytes() == before
    error = capsys.readouterr().err
    assert "calibrated 2026-01-02T03:04:05+00:00" in error and "2023-11-14T" in error
    assert "--replace-newer" in error


@pytest.mark.parametrize(
    "arguments",
    [
        ["retractor", "--estimate", "cable"],
        ["retractor", "bag", "--remove-cable"],
        ["retractor", "bag", "--estimate", "cable,inertia"],
        ["retractor", "bag", "--estimate", "cable", "--one-sweep"],
        ["retractor", "--propose-poses"],
        ["../x", "b"],
    ],
)
def test_wrong_arguments_are_a_usage_error(arguments):
    with pytest.raises(SystemExit) as end:
        parse(arguments)
    assert end.value.code == 2
