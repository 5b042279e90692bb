# SPDX-License-Identifier: Apache-2.0
"""Recordings by the simulated arm: what is in them, and that replay explains them to the noise."""

import json
from dataclasses import replace

import numpy as np
import pytest
from galen_bags.formats.bag import open_bag
from galen_diagnosis.observation.recording import DiagnosticRecording, read_recording
from galen_diagnosis.simulated_recording import main, make_recording, sweep_poses
from galen_model.arm.galen import GALEN, SENSOR, TRACKER_POSITION_NOISE_M
from galen_model.errors import GalenError
from galen_model.load.model import TOOLS
from galen_model.rotation import rotvec_to_matrix
from galen_sim_driver.effects.joints import JointGain
from galen_sim_driver.effects.load import InertialLoad
from galen_sim_driver.effects.sensor import BaseShift, BiasStep, TrackerDelay, WrenchDelay
from galen_sim_driver.plant.config import BASE_IN_TRACKER
from galen_sim_driver.replay import Replay, Scene

FEW = sweep_poses(arm=GALEN)[::11]


def scene(recording: DiagnosticRecording, name: str) -> Scene:
    bag, tool = recording.bags[name], recording.tool
    return Scene(
        bag=name,
        start_s=bag.start_s,
        joint_s=bag.joint_s,
        joints=bag.joints,
        wrench_s=bag.wrench_s,
        reading=bag.wrenches,
        touched=np.full(len(bag.wrench_s), name == "push"),
        tracker_s=np.zeros(0) if bag.tool_marker is None else bag.tool_marker.at_s,
        tool=replace(TOOLS[tool.tool], load=tool.load.load, tip_m=tool.tip_m),
        adapter=tool.adapter.load,
        arm=GALEN,
    )


def spread(recording, name, effects):
    """Mean square of the wrench residual in units of the noise and quantum (6,)."""
    told = scene(recording, name)
    residual = told.reading - Replay(told, effects).reading()
    noise = np.sqrt(SENSOR.noise_std**2 + SENSOR.quantum**2 / 12.0)
    return np.mean((residual / noise) ** 2, axis=0)


def test_a_sweep_holds_what_the_contract_says_and_nothing_else(tmp_path):
    make_recording(
        tmp_path / "made", seed=4, tool="retractor", poses=FEW, bags=("sweep",), arm=GALEN
    )
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == ["sweep", "tool.json"]
    with open_bag(tmp_path / "made" / "sweep") as bag:
        assert sorted(bag.topics) == ["/joint_states", "/wrench_raw"]
    recording = read_recording(tmp_path / "made")
    assert recording.problems == () and recording.missing == ("motion", "push")
    assert recording.tool.tool == "retractor"
    bag = recording.bags["sweep"]
    assert np.diff(bag.joint_s) == pytest.approx(0.02, abs=1e-6)
    for pose in FEW:
        still = np.abs(bag.joints - pose).max(axis=1) < 1e-4
        assert still.sum() * 0.02 > 1.5
    # Nothing but noise is left of it: 500 samples tell a mean square to 6 %.
    assert np.abs(spread(recording, "sweep", []) - 1.0).max() < 0.25


def test_the_same_seed_makes_the_same_recording_and_another_one_another(tmp_path):
    readings = []
    for number, seed in enumerate((1, 1, 2)):
        path = tmp_path / str(number)
        make_recording(path, seed=seed, poses=FEW[:1], bags=("sweep",), arm=GALEN)
        readings.append(read_recording(path).bags["sweep"].wrenches)
    assert (readings[0] == readings[1]).all()
    assert (readings[0] != readings[2]).any()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"bags": ("dance",)}, "dance"),
        ({"tool": "spoon"}, "spoon"),
        ({"tool": ""}, "needs a tool"),
        ({"poses": np.full((1, 5), 3.0)}, "outside its limits"),
    ],
)
def test_a_recording_that_cant_be_is_not_left_half(tmp_path, arguments, words):
    with pytest.raises(GalenError, match=words):
        make_recording(tmp_path / "made", arm=GALEN, **arguments)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_not_written_over(tmp_path, capsys):
    (tmp_path / "made").mkdir()
    with pytest.raises(GalenError, match="made: is there already"):
        make_recording(tmp_path / "made", arm=GALEN)
    assert main(["tilt", "--output", str(tmp_path / "made")]) == 1
    assert "is there already" in capsys.readouterr().err
    assert list((tmp_path / "made").iterdir()) == []


@pytest.mark.slow
def test_replay_with_the_effects_explains_all_three_bags_to_the_noise(tmp_path):
    effects = [
        JointGain("tilt", 0.02),
        InertialLoad(0.16),
        WrenchDelay(0.01),
        TrackerDelay(0.02),
        BiasStep(20.0, (0.2, 0.0, 0.0, 0.0, 0.0, 0.01), "motion"),
        BaseShift((0.002, 0.0, 0.0), (0.0, 0.0, 0.001), 60.0),
    ]
    make_recording(tmp_path / "made", effects, seed=7, poses=FEW, truth=True, arm=GALEN)
    recording = read_recording(tmp_path / "made")
    told = json.loads((tmp_path / "made" / "truth.json").read_text())
    assert [one["effect"] for one in told["effects"]] == [effect.name for effect in effects]
    assert told["effects"][0]["parameters"] == {"joint": "tilt", "gain": 0.02}
    for name in ("sweep", "motion"):
        # 600 and 9000 samples tell a mean square to 6 and 1.5 %.
        most = {"sweep": 0.25, "motion": 0.07}[name]
        assert np.abs(spread(recording, name, effects) - 1.0).max() < most
        assert spread(recording, name, []).max() > 1.5
    push = scene(recording, "push")
    replay = Replay(push, effects)
    rotation, position = replay.tip()
    base = BASE_IN_TRACKER
    _, there = replay.seen_by_tracker(
        rotation, position, rotvec_to_matrix(base.rotvec_rad), np.array(base.translation_m)
    )
    seen = recording.bags["push"].tool_marker.position
    left = np.mean(((seen - there) / TRACKER_POSITION_NOISE_M) ** 2, axis=0)
    # The applied wrench is that of a noisy sensor: some percent more than the tracker's own noise.
    assert np.abs(left - 1.0).max() < 0.12
    assert np.abs(replay.applied_wrench()[:, :3]).max() > 9.0
    base_marker = recording.bags["push"].base_marker
    after = base_marker.at_s > 60.0
    shift = base_marker.position[after].mean(axis=0) - base_marker.position[~after].mean(axis=0)
    assert np.linalg.norm(shift) == pytest.approx(0.002, abs=2e-5)
