# SPDX-License-Identifier: Apache-2.0
"""Evaluations of recordings in which what is wrong was put in, and so is known."""

import json
import re

import numpy as np
import pytest
from galen_bags.formats.bag import open_bag
from galen_bags.formats.writer import BagWriter
from galen_gravcomp.evaluate.bag import EvaluationSettings, evaluate_bag
from galen_gravcomp.evaluate.bag_report import to_json
from galen_gravcomp.parameters import GravcompParameters
from galen_model.arm.galen import SENSOR
from galen_model.load.verdict import Cause
from gravcomp_bags import Recording, tool_file


@pytest.fixture(scope="module")
def tool():
    return tool_file()


def evaluate(tmp_path, recording, tool, **options):
    return evaluate_bag(recording.write(tmp_path / "bag"), tool, EvaluationSettings(**options))


def test_a_recording_that_fits_is_at_the_noise(tmp_path, tool):
    recording = Recording(tool)
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is Cause.FITS
    assert (result.compensated, result.received) == (len(recording.angles),) * 2
    assert len(result.phases) == 16
    np.testing.assert_allclose(result.phases.noise, SENSOR.noise_std, rtol=0.1)
    np.testing.assert_allclose(result.rmse_still, SENSOR.noise_std, rtol=0.1)
    # 16 phases of some 100 readings each: their means scatter by a tenth of one reading's noise
    assert np.all(result.rmse_phases < 0.25 * SENSOR.noise_std)
    assert to_json(result)["findings"] == []
    np.testing.assert_allclose(
        result.phases.angles, recording.goals, atol=5e-5, err_msg="the poses it was still at"
    )


def test_the_standard_error_of_a_phase_is_that_of_the_noise(tmp_path, tool):
    normalised = []
    for seed in range(4):
        recording = Recording(tool, seed=seed, hold_s=2.0)
        result = evaluate_bag(recording.write(tmp_path / f"bag{seed}"), tool)
        normalised.append(result.phases.mean / result.phases.std_of_mean)
    # 4 x 16 x 6 means: their scatter in units of its standard error has itself an error of 4 %
    assert 0.8 < np.std(np.concatenate(normalised)) < 1.25


def test_a_heavier_tool_is_told_by_its_mass(tmp_path, tool):
    heavier = tool_file(mass_kg=0.212)
    recording = Recording(heavier)
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is Cause.LOAD
    parts = result.parts
    assert abs(parts.values["load"][0] - 0.012) < 4 * parts.stds["load"][0]
    assert parts.stds["load"][0] < 1e-3
    moment = heavier.load.load.moments[1:] - tool.load.load.moments[1:]
    assert np.all(np.abs(parts.values["load"][1:] - moment) < 4 * parts.stds["load"][1:])
    assert re.search(r"another load, by \+1[12]\.\d \+- 0\.\d g", result.verdict.text)


@pytest.mark.parametrize(
    ("part", "value", "cause"),
    [
        ("offset", [0.1, -0.2, 0.3, 0.005, 0.0, -0.004], Cause.OFFSET),
        ("drift", [0.0, 0.0, 60.0, 0.0, 0.0, 0.0], Cause.DRIFT),  # per hour, in half a minute
    ],
)
def test_an_offset_and_a_drift_are_told_with_their_values(tmp_path, tool, part, value, cause):
    recording = Recording(tool)
    hours = (recording.time_s - recording.time_s.mean())[:, None] / 3600.0
    recording.wrench += np.array(value) * (hours if part == "drift" else 1.0)
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is cause
    pull = (result.parts.values[part] - value) / result.parts.stds[part]
    assert np.all(np.abs(pull) < 4.0)


def test_touched_poses_stand_out_and_do_not_spoil_the_verdict(tmp_path, tool):
    recording = Recording(tool, poses=20)
    for pose in (3, 11):
        recording.wrench[recording.pose_slices[pose], :3] += [0.0, 2.0, -1.0]
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is Cause.FITS
    assert "2 of 20 rest segments: outliers" in result.verdict.text
    assert set(result.worst_phases[:2].tolist()) == {3, 11}
    assert np.flatnonzero(~result.parts.used).tolist() == [3, 11]


def test_gaps_jumps_and_duplicates_are_counted_and_the_node_rejects_as_it_does(tmp_path, tool):
    recording = Recording(tool)
    recording.kept[400:420] = False
    recording.stamp_ns[900] = recording.stamp_ns[899]
    recording.stamp_ns[1500:] += 7_000_000_000
    result = evaluate(tmp_path, recording, tool)
    for stamps in (result.joint_stamps, result.wrench_stamps):
        assert (stamps.gaps, stamps.missing, stamps.jumps, stamps.duplicates) == (1, 20, 1, 1)
    assert result.rejected["duplicate_stamp"] == 1
    assert result.notices["restarts"] == 1
    assert result.received == result.compensated + sum(result.rejected.values()) + result.waiting
    text = "\n".join(to_json(result)["findings"])
    for part in ("gap at 3.990 s", "jump at", "step of +7.0100 s", "duplicate"):
        assert part in text


def test_stuck_and_saturated_channels_are_named(tmp_path, tool):
    recording = Recording(tool)
    recording.wrench[800:1000, 4] = 0.0101
    recording.wrench[:, 1] = np.minimum(recording.wrench[:, 1], 1.0)
    text = "\n".join(to_json(evaluate(tmp_path, recording, tool))["findings"])
    assert "ty stuck at 0.0101 N.m" in text
    assert "fy saturated at 1 N" in text


def test_poses_that_tell_nothing_of_the_load_are_said_to(tmp_path, tool):
    recording = Recording(tool, poses=12)
    recording.angles[:] = 0.01 * recording.angles
    recording.wrench = tool.predict(recording.angles) + 0.2
    result = evaluate(tmp_path, recording, tool)
    assert "load" not in result.parts.values
    assert result.verdict.cause is Cause.OFFSET
    assert "or another load or drift, not distinguishable by these rest" in result.verdict.text
    assert "poses" in result.parts.why_no_load


def test_a_recording_in_motion_alone_fits_or_not(tmp_path, tool):
    recording = Recording(tool, poses=30, hold_s=0.0, move_s=1.0)
    result = evaluate(tmp_path, recording, tool)
    assert len(result.phases) == 0
    assert result.verdict.cause is Cause.FITS
    assert "in motion" in result.verdict.text
    recording.wrench += 1.0
    result = evaluate_bag(recording.write(tmp_path / "off"), tool)
    assert result.verdict.cause is Cause.UNKNOWN
    json.dumps(to_json(result), allow_nan=False)


def test_a_slow_sensor_gets_longer_cells(tmp_path, tool):
    recording = Recording(tool, rate_hz=10.0, hold_s=10.0, move_s=2.0, poses=8)
    settings = EvaluationSettings(parameters=GravcompParameters(max_joint_age_s=0.5))
    result = evaluate_bag(recording.write(tmp_path / "bag"), tool, settings)
    assert result.cells.cell_s == pytest.approx(0.5)
    assert len(result.phases) == 8
    assert result.verdict.cause is Cause.FITS


def test_a_tool_that_was_put_on_in_the_middle_is_told(tmp_path, tool):
    bare = tool_file(mass_kg=1e-6)
    first, second = Recording(bare, poses=10, seed=1), Recording(tool, poses=12, seed=2)
    shift = first.stamp_ns[-1] - second.stamp_ns[0] + 4_000_000_000
    second.stamp_ns += shift
    second.log_ns += shift
    for name in ("angles", "wrench", "stamp_ns", "log_ns", "kept"):
        setattr(first, name, np.concatenate([getattr(first, name), getattr(second, name)]))
    result = evaluate(tmp_path, first, tool)
    assert result.verdict.cause is Cause.CHANGED
    assert result.change.first_after == 10
    np.testing.assert_allclose(result.change.mass_kg, [-0.2, 0.0], atol=1e-3)
    settings = EvaluationSettings(start_s=21.0)
    later = evaluate_bag(tmp_path / "bag", tool, settings)
    assert later.verdict.cause is Cause.FITS
    assert len(later.phases) == 12
    assert later.duration_s == pytest.approx(12 * 1.5 + 11 * 0.5, abs=0.02)
    settings = EvaluationSettings(duration_s=5.0)
    assert evaluate_bag(tmp_path / "bag", tool, settings).duration_s == pytest.approx(5, abs=0.02)


def test_a_sensor_that_jumps_is_not_called_another_load(tmp_path, tool):
    recording = Recording(tool, poses=20)
    half = len(recording.wrench) // 2
    recording.wrench[half:, 0] -= 0.4
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is Cause.CHANGED
    assert result.change.mass_kg is None
    np.testing.assert_allclose(result.change.offset_step[:3], [-0.4, 0.0, 0.0], atol=0.01)
    told = re.search(r"jumps by -0\.\d+ N in fx at ([\d.]+) s", result.verdict.text)
    assert abs(float(told.group(1)) - 0.01 * half) < 1.0
    assert "Before: the file fits" in result.verdict.text
    assert "After: the residual is 0.399 N in fx: a constant offset" in result.verdict.text
    json.dumps(to_json(result), allow_nan=False)


def test_angles_that_are_off_are_not_called_what_a_tare_fixes(tmp_path, tool):
    """Most of what a wrong zero of tilt leaves is constant, but a tare would not make it fit."""
    recording = Recording(tool, poses=30)
    recording.angles[:, 1] -= 0.06
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is Cause.UNEXPLAINED
    assert "tare" not in result.verdict.text
    assert "wrong angles" in result.verdict.text


@pytest.mark.parametrize("what", ["degrees", "N mm"])
def test_units_that_look_wrong_leave_no_verdict(tmp_path, tool, what):
    recording = Recording(tool)
    if what == "degrees":
        recording.angles = np.degrees(recording.angles)
    else:
        recording.wrench[:, 3:] *= 1e3
    result = evaluate(tmp_path, recording, tool)
    assert result.verdict.cause is Cause.UNKNOWN
    assert f"look like {what} in " in result.verdict.text


def test_an_arm_at_rest_for_minutes_tells_the_drift(tmp_path, tool):
    recording = Recording(tool, poses=1, hold_s=200.0, rate_hz=50.0)
    recording.wrench[:, 2] += 5.0 * (recording.time_s / 3600.0)
    result = evaluate(tmp_path, recording, tool)
    assert len(result.phases) == 20
    assert result.verdict.cause is Cause.DRIFT
    assert "another load" in result.verdict.text
    assert abs(result.parts.values["drift"][2] - 5.0) < 4 * result.parts.stds["drift"][2] < 0.5


def test_after_a_jump_of_the_stamps_no_drift_is_told(tmp_path, tool):
    recording = Recording(tool, poses=20)
    recording.stamp_ns[len(recording.stamp_ns) // 2 :] += 7_200_000_000_000
    recording.wrench[:, 0] += 0.3
    result = evaluate(tmp_path, recording, tool)
    assert "drift" not in result.parts.values
    assert result.parts.why_no_drift == "the time stamps jump"
    assert result.verdict.cause is Cause.OFFSET
    assert "or drift, not distinguishable" in result.verdict.text


def test_a_slow_sensor_behind_a_fast_driver_is_said_to_be_one(tmp_path, tool):
    recording = Recording(tool, rate_hz=200.0, poses=8, hold_s=1.0)
    recording.wrench = recording.wrench[np.arange(len(recording.wrench)) // 5 * 5]
    result = evaluate(tmp_path, recording, tool)
    assert to_json(result)["findings"] == [
        "/wrench_raw: each reading comes about 5 times: new ones come at 40 Hz"
    ]


def test_a_message_that_cannot_be_read_is_no_stamp_and_no_reading(tmp_path, tool):
    path = Recording(tool, poses=4).write(tmp_path / "bag")
    with BagWriter(tmp_path / "spoilt") as spoilt, open_bag(path) as bag:
        names = sorted(bag.topics)
        topics = [spoilt.add_topic(name, bag.topics[name].type_name) for name in names]
        for block in bag.blocks(names):
            for row in range(len(block)):
                data, topic = block.message(row), block.topic[row]
                spoiled = names[topic] == "/wrench_raw" and row % 100 == 51
                data = data[:20] if spoiled else data
                spoilt.write(topics[topic], int(block.log_time_ns[row]), data)
    result = evaluate_bag(tmp_path / "spoilt", tool)
    assert result.rejected["unreadable"] == result.received - result.wrench_stamps.count > 0
    assert result.wrench_stamps.unstamped == 0
    assert not result.channels.not_finite.any()
