"""What a recording is read into where it isn't as it should be."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import ArmRecording
from galen_diagnosis.observation.recording import _REACH_S, _Arm, read_recording
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.errors import GalenError

START_NS = 10**18


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "made"
    make_recording(folder, seed=1, poses=sweep_poses()[:3], bags=("sweep",))
    return folder


def arm(tmp_path, count=100, period_s=0.01):
    """An arm at rest, with noise in its wrenches."""
    stamp_ns = START_NS + (np.arange(count) * period_s * 1e9).astype(np.int64)
    joints = np.zeros((count, 5))
    wrenches = np.random.default_rng(0).standard_normal((count, 6))
    return ArmRecording(
        tmp_path, stamp_ns, stamp_ns, joints, joints, stamp_ns, stamp_ns, wrenches, ("",), ()
    )


def test_a_recording_has_its_directorys_name_also_from_within(made, monkeypatch):
    monkeypatch.chdir(made)
    read = read_recording(".")
    assert read.name == made.name
    assert read.missing == ("motion", "push")
    assert not read.problems


@pytest.mark.parametrize("within", ["", "sweep.mcap"])
def test_a_bag_is_no_recording_and_told_which_command_takes_it(made, within):
    with pytest.raises(GalenError, match="sweep") as error:
        read_recording(made / "sweep" / within)
    assert "is a bag, and a recording is a directory with the bags sweep, motion" in str(
        error.value
    )
    assert f"galen_gravcomp evaluate {made / 'sweep' / within}" in str(error.value)


def test_a_directory_without_bags_is_told_what_a_recording_is(tmp_path):
    with pytest.raises(GalenError, match=r"holds none of the bags sweep, .* tool\.json"):
        read_recording(tmp_path)


def test_pauses_between_positions_are_no_missing_samples(tmp_path):
    make_recording(tmp_path / "r", seed=1, poses=sweep_poses()[:1], bags=("push",))
    assert read_recording(tmp_path / "r").problems == ()


@pytest.mark.parametrize("tool", ["", "{", "[]", '{"mass_kg": NaN}'])
def test_a_broken_tools_file_is_named(made, tmp_path, tool):
    shutil.copytree(made, tmp_path / "copy")
    (tmp_path / "copy" / "tool.json").write_text(tool)
    with pytest.raises(GalenError, match=r"tool\.json"):
        read_recording(tmp_path / "copy")


def test_a_bag_that_is_none_is_named(made, tmp_path):
    shutil.copytree(made, tmp_path / "copy")
    (tmp_path / "copy" / "motion").write_text("no bag")
    with pytest.raises(GalenError, match="motion"):
        read_recording(tmp_path / "copy")


def test_samples_that_say_nothing_are_left_out_and_counted(tmp_path):
    one = arm(tmp_path)
    one.wrenches[3, 2] = np.nan
    one.joints[[5, 6], 0] = np.inf
    stamps = one.wrench_stamp_ns.copy()
    stamps[0] = 0
    taken = _Arm(tmp_path, replace(one, wrench_stamp_ns=stamps))
    assert len(taken.wrench_s) == 98
    assert len(taken.joint_s) == 98
    assert taken.first_ns == START_NS
    assert np.isfinite(taken.wrenches).all()
    assert [problem.split()[0] for problem in taken.problems] == ["2", "1", "1"]


def test_wrenches_beyond_the_joints_are_left_out(tmp_path):
    one = arm(tmp_path, 200)
    short = replace(one, joint_stamp_ns=one.joint_stamp_ns[:100], joints=one.joints[:100])
    taken = _Arm(tmp_path, short)
    assert taken.wrench_s[-1] == pytest.approx(0.99 + _REACH_S)
    assert "90 wrenches" in taken.problems[0]


def test_a_dead_axis_is_a_problem(tmp_path):
    one = arm(tmp_path)
    one.wrenches[:, 1] = 0.3
    assert _Arm(tmp_path, one).problems[0].startswith("fy read the same")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda one: replace(one, wrench_stamp_ns=0 * one.wrench_stamp_ns), "0 usable wrenches"),
        (lambda one: replace(one, joints=np.full((100, 5), np.nan)), "name all five joints"),
        (
            lambda one: replace(one, joint_stamp_ns=one.joint_stamp_ns[0] + 0 * np.arange(100)),
            "1 u",
        ),
        (lambda one: replace(one, wrench_stamp_ns=one.wrench_stamp_ns + 10**10), "0 usable wre"),
        (
            lambda one: replace(
                one, joint_stamp_ns=np.where(np.arange(100) < 50, 10**10, 0) + one.joint_stamp_ns
            ),
            "go back by",
        ),
    ],
)
def test_what_cant_be_used_is_an_error_that_names_the_bag(tmp_path, change, sentence):
    one = change(arm(tmp_path))
    with pytest.raises(GalenError, match=sentence) as error:
        _Arm(tmp_path, one)
    assert str(tmp_path) in str(error.value)


def test_slow_topics_are_an_error(tmp_path):
    with pytest.raises(GalenError, match="joint states at 10 Hz"):
        _Arm(tmp_path, arm(tmp_path, period_s=0.1))
