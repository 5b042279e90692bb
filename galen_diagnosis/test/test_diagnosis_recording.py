# SPDX-License-Identifier: Apache-2.0
"""What a recording is read into, against which nominal model, and how effects change its rows."""

import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import ArmRecording
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_diagnosis.diagnose import main
from galen_diagnosis.observation.observation import Observation, Unknowns
from galen_diagnosis.observation.recording import _REACH_S, _Arm, read_recording
from galen_diagnosis.simulated_recording import make_recording, sweep_poses
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.files.calibration_file import read_calibration, write_calibration
from galen_model.load.inertia import InertiaEstimate, point_mass_inertia
from galen_sim_driver.effects.load import InertialLoad, ToolMassError
from galen_sim_driver.effects.registry import identities
from galen_sim_driver.replay import Replay

from galen_diagnosis import simulated_recording

START_NS = 10**18


@pytest.fixture(scope="module", autouse=True)
def short():
    """A motion of 20 s in place of 45, six pushes at each of two positions in place of four."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated_recording, "MOTION_S", 20.0)
        positions = simulated_recording._PUSH_POSITIONS[:2]
        patch.setattr(simulated_recording, "_PUSH_POSITIONS", positions)
        patch.setattr(simulated_recording, "_PUSH_LEVELS_N", (11.0,))
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "made"
    make_recording(folder, seed=1, poses=sweep_poses(arm=GALEN)[:3], bags=("sweep",), arm=GALEN)
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


def test_wrenches_in_the_base_s_axes_are_turned_back(made, tmp_path, capsys):
    folder = shutil.copytree(made, tmp_path / "r", ignore=shutil.ignore_patterns("sweep"))
    right = read_recording(made).bags["sweep"]
    angles = GALEN.angles(right.joints)
    then = [np.interp(right.wrench_s, right.joint_s, column) for column in angles.T]
    turn = GALEN.rotation(np.column_stack(then))
    inside = np.stack(np.split(right.wrenches, 2, axis=1), axis=2)
    turned = np.swapaxes(turn @ inside, 1, 2).reshape(-1, 6)
    with open_bag(made / "sweep") as bag, BagWriter(folder / "sweep") as out:
        names, row = list(bag.topics), 0
        topics = [out.add_topic(name, bag.topics[name].type_name) for name in names]
        for block in bag.blocks(names):
            for k in range(len(block)):
                message = bytes(block.message(k))
                if names[block.topic[k]].endswith("wrench_raw"):
                    message = message.replace(b"ft_sensor", b"base_link")[:-48]
                    message += struct.pack("<6d", *turned[row])
                    row += 1
                out.write(topics[block.topic[k]], int(block.log_time_ns[k]), message)
    back = read_recording(folder, wrench_frame="base").bags["sweep"]
    np.testing.assert_allclose(back.wrenches, right.wrenches, atol=1e-9)
    options = [str(folder), "--output", str(tmp_path / "found"), "--no-report"]
    assert main(options) == 1
    assert "'base_link'" in (error := capsys.readouterr().err) and "--wrench-frame base" in error
    assert main([*options, "--wrench-frame", "base"]) == 0


@pytest.mark.parametrize("within", ["", "sweep.mcap"])
def test_a_bag_is_no_recording_and_told_which_command_takes_it(made, within):
    path = made / "sweep" / within
    with pytest.raises(GalenError, match="is a bag, and a recording is a directory") as error:
        read_recording(path)
    assert f"galen_gravcomp evaluate {path}" in str(error.value)


def test_a_directory_without_bags_is_told_what_a_recording_is(tmp_path):
    with pytest.raises(GalenError, match=r"holds none of the bags sweep, .* tool\.json"):
        read_recording(tmp_path)


@pytest.mark.parametrize(
    ("file", "content"),
    [*(("tool.json", text) for text in ("", "[]", '{"mass_kg": NaN}')), ("motion", "no bag")],
)
def test_a_broken_tools_file_and_a_bag_that_is_none_are_named(made, tmp_path, file, content):
    shutil.copytree(made, tmp_path / "copy")
    (tmp_path / "copy" / file).write_text(content)
    with pytest.raises(GalenError, match=file):
        read_recording(tmp_path / "copy")


def test_bags_that_overlap_in_time_are_a_problem(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "copy")
    shutil.copytree(folder / "sweep", folder / "motion")
    assert "weren't recorded one after the other" in read_recording(folder).problems[0]


def test_samples_that_say_nothing_are_left_out_and_counted(tmp_path):
    one = arm(tmp_path)
    one.wrenches[3, 2] = np.nan
    one.joints[[5, 6], 0] = np.inf
    stamps = one.wrench_stamp_ns.copy()
    stamps[0] = 0
    taken = _Arm(tmp_path, replace(one, wrench_stamp_ns=stamps), robot=GALEN)
    assert len(taken.wrench_s) == 98
    assert len(taken.joint_s) == 98
    assert taken.first_ns == START_NS
    assert np.isfinite(taken.wrenches).all()
    assert [problem.split()[0] for problem in taken.problems] == ["2", "1", "1"]


def test_wrenches_beyond_the_joints_are_left_out(tmp_path):
    one = arm(tmp_path, 200)
    short = replace(one, joint_stamp_ns=one.joint_stamp_ns[:100], joints=one.joints[:100])
    taken = _Arm(tmp_path, short, robot=GALEN)
    assert taken.wrench_s[-1] == pytest.approx(0.99 + _REACH_S)
    assert "90 wrenches" in taken.problems[0]


def test_a_dead_axis_is_a_problem(tmp_path):
    one = arm(tmp_path)
    one.wrenches[:, 1] = 0.3
    assert _Arm(tmp_path, one, robot=GALEN).problems[0].startswith("fy read the same")


@pytest.mark.parametrize(
    ("period_s", "changes", "sentence"),
    [
        (0.01, lambda one: {"wrench_stamp_ns": 0 * one.wrench_stamp_ns}, "0 usable wrenches"),
        (0.01, lambda one: {"wrench_stamp_ns": one.wrench_stamp_ns + 10**10}, "0 usable wre"),
        (0.01, lambda one: {"joints": one.joints + np.nan}, "name all joints of the arm galen"),
        (0.01, lambda one: {"joint_stamp_ns": np.full(100, START_NS)}, "1 u"),
        (
            0.01,
            lambda one: {"joint_stamp_ns": one.joint_stamp_ns + 10**10 * (np.arange(100) < 50)},
            "go back by",
        ),
        (0.1, lambda one: {}, "joint states at 10 Hz"),
    ],
)
def test_what_cant_be_used_is_an_error_that_names_the_bag(tmp_path, period_s, changes, sentence):
    one = arm(tmp_path, period_s=period_s)
    with pytest.raises(GalenError, match=sentence) as error:
        _Arm(tmp_path, replace(one, **changes(one)), robot=GALEN)
    assert str(tmp_path) in str(error.value)


@pytest.fixture(scope="module")
def accelerated(tmp_path_factory):
    """The pointer and its adapter, 0.16 kg, with an inertia of their own; all three bags."""
    folder = tmp_path_factory.mktemp("accelerated") / "made"
    inertial = InertialLoad(0.16, OWN_INERTIA_KG_M2)
    make_recording(folder, [inertial], seed=3, poses=sweep_poses(arm=GALEN)[:3], arm=GALEN)
    return folder


OWN_INERTIA_KG_M2 = (1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0)


def with_inertia(folder, target):
    tool = read_calibration(folder / "tool.json", arm=GALEN)
    about = point_mass_inertia(tool.load.load, tool.adapter.load) + OWN_INERTIA_KG_M2
    write_calibration(target, replace(tool, inertia=InertiaEstimate(about, np.eye(6) * 1e-10)))
    return target


def test_inertial_forces_of_the_calibration_file_leave_noise_of_a_motion(accelerated, tmp_path):
    file = with_inertia(accelerated, tmp_path / "pointer.json")
    # Nor are the pauses between positions of pushes missing samples.
    assert read_recording(accelerated).problems == ()
    left = {}
    for name, told in {
        "none": {},
        "points": {"inertial_forces": True},
        "whole": {"tool": file, "inertial_forces": True},
    }.items():
        recording = read_recording(accelerated, **told)
        observation = Observation(replace(recording, bags={"motion": recording.bags["motion"]}))
        # Of 4,000 rows the mean square is known to 2 %, and their noise to some percent.
        left[name] = np.mean(observation.residual(()) ** 2)
        assert ("inertial forces of 0.160 kg" in recording.nominal) == (name != "none")
    assert left["whole"] == pytest.approx(1.0, abs=0.1)
    assert left["points"] > left["whole"] + 0.02 and left["none"] > 1.5
    scene = observation.views["motion"].scene
    bare = replace(scene, inertia_kg_m2=None)
    lighter, same, heavier = (
        Replay(scene, effects).reading() - Replay(bare, effects).reading()
        for effects in ([ToolMassError(delta_kg)] for delta_kg in (-0.06, 0.0, 0.06))
    )
    # What weighs more accelerates with more as well.
    np.testing.assert_allclose(heavier - same, same - lighter, atol=1e-12)
    assert np.abs(heavier - same).max() > 1e-3


def shaken(effect):
    """The same effect with numbers that change something."""
    if effect.name == "sensor_saturation":
        return replace(effect, limit=1.0)
    if effect.name == "bias_step":
        return replace(effect, time_s=5.0, step=(0.1,) * 6, bag="motion")
    size = np.concatenate([0.4 * part.typicals for part in effect.fitted])
    return effect.with_vector(np.maximum(size, [part.lower for part in effect.fitted
                                                for _ in range(part.size)]))  # fmt: skip


@pytest.mark.parametrize("inertial_forces", [False, True])
def test_what_is_kept_of_a_replay_is_what_a_new_one_gives(accelerated, inertial_forces):
    observation = Observation(read_recording(accelerated, inertial_forces=inertial_forces))
    effects = [shaken(effect) for effect in identities(GALEN).values()]
    sets = [(one,) for one in effects]
    sets += [(one, effects[k - 7], effects[k - 11]) for k, one in enumerate(effects)]
    given = Unknowns(np.linspace(-1e-3, 1e-3, 18)) if inertial_forces else None
    kept = [observation.change(some, given) for some in sets]
    views = observation.views
    for some, found in zip(sets[::3], kept[::3], strict=True):
        again = observation.change(some, given)
        # A copy of a scene has nothing kept.
        observation.views = {
            name: replace(view, scene=replace(view.scene)) for name, view in views.items()
        }
        new = observation.change(some, given)
        observation.views = views
        assert np.abs(new).max() > 0.1, some
        np.testing.assert_allclose(found, new, rtol=0.0, atol=1e-9, err_msg=str(some))
        np.testing.assert_allclose(again, new, rtol=0.0, atol=1e-9, err_msg=str(some))
