# SPDX-License-Identifier: Apache-2.0
"""Recordings of pushes: what is measured, and everything wrong with a recording found and cut."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from galen_bags.arrays.arm_recording import read_arm
from galen_bags.arrays.marker_tracks import RawTrack, marker_track
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_deflection.measurement.arm_track import (
    no_contact_phase,
    noise_of_mean,
    read_arm_track,
    wrench_noise,
)
from galen_deflection.measurement.measured_deflection import measure_deflection
from galen_deflection.measurement.push_recording import base_stands, read_pushes
from galen_deflection.measurement.registration import RegistrationError
from galen_deflection.measurement.samples import DeflectionError
from galen_gravcomp.compensator import Compensator
from galen_model.arm.galen import GALEN, SENSOR
from galen_model.files.calibration_file import read_calibration
from galen_model.registration import Transform
from galen_model.rotation import matrix_to_quaternion, quaternion_to_matrix
from push_bag import (
    BASE_IN_TRACKER,
    BASE_POSE,
    JOINTS,
    NOISE,
    NS,
    POSITIONS,
    ROOT,
    START_NS,
    TOOL,
    TOOL_POSE,
    WRENCH,
    Scene,
    nominal,
    repeated,
    write,
)
from scipy.signal import lfilter

SHARED = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "disclosed"
SHORT = Scene(positions=POSITIONS[:2])


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The recording that others are compared with, and its deflections."""
    scene = Scene()
    path = write(tmp_path_factory.mktemp("bag") / "sound", scene.topics())
    recording = read_pushes(path, TOOL, arm=GALEN)
    return scene, recording, measure_deflection(recording)


def tampered(tmp_path, tamper, scene=SHORT, arm=GALEN):
    topics = scene.topics()
    tamper(topics)
    return read_pushes(write(tmp_path / "bag", topics), TOOL, arm=arm)


def said(recording, *words):
    """The sentences that hold all of the words."""
    return [text for text in recording.problems if all(word in text for word in words)]


def seconds(recording):
    return (recording.stamp_ns - START_NS) * 1e-9


def assert_true_but_for_noise(measured, times, scene=SHORT):
    off = measured.samples.deflection - scene.deflection_at(times)
    assert np.sqrt(np.mean(off**2, axis=0)) == pytest.approx(NOISE, rel=0.15)


# --- what is measured ---------------------------------------------------------------------------


def test_a_sound_recording_gives_the_true_deflections(sound):
    scene, recording, measured = sound
    assert recording.problems == ()
    times = seconds(recording)
    off = measured.samples.deflection - scene.deflection_at(times)
    assert np.sqrt(np.mean(off**2, axis=0)) == pytest.approx(NOISE, rel=0.1)
    # The mean's own error is that of the registration and the joints' fit, far under the noise.
    assert np.all(np.abs(off.mean(axis=0)) < 0.2 * NOISE)
    assert measured.samples.noise == pytest.approx(NOISE, rel=0.15)
    assert np.max(np.abs(measured.samples.deflection[:, :3])) > 0.3e-3  # it does measure pushes


def test_the_wrench_is_the_applied_one_at_the_markers_stamps(sound):
    scene, recording, _ = sound
    off = recording.wrench - scene.wrench_at(seconds(recording))
    # Between two samples the noise of both counts, by their weights: at most all of one.
    assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 1.1 * SENSOR.noise_std)
    assert np.all(np.abs(off.mean(axis=0)) < 0.2 * SENSOR.noise_std)
    assert recording.joints == pytest.approx(scene.joints_at(seconds(recording)), abs=1e-6)


@pytest.mark.parametrize(
    ("bag", "tool"),
    [
        ("pushes", ROOT / "bags" / "tools" / "retractor.json"),
        ("cable_sweep", ROOT / "test" / "baselines" / "pointer_with_cable.json"),
    ],
)
def test_wrenches_are_those_of_the_compensator(bag, tool):
    path, tool, count = ROOT / "bags" / bag, read_calibration(tool, arm=GALEN), 3000
    with open_bag(path) as opened:
        track = read_arm_track(opened, tool, jump_s=0.03, arm=GALEN)
    arm = read_arm(path, arm=GALEN)
    compensator = Compensator(arm=GALEN)
    compensator.set_tool(tool)
    made = []
    last_ns = arm.wrench_stamp_ns[count]
    for stamp_ns, joints in zip(arm.joint_stamp_ns, arm.joints, strict=True):
        if stamp_ns <= last_ns:
            made += compensator.push_joints(int(stamp_ns), tuple(joints))
    for k in range(count):
        made += compensator.push_wrench(int(arm.wrench_stamp_ns[k]), arm.wrenches[k])
    made = [one for one in made if hasattr(one, "wrench")]
    assert len(made) > 0.9 * count
    same = np.isin(track.wrench_line.stamp_ns, [one.stamp_ns for one in made])
    expected = np.array([one.wrench for one in made])
    np.testing.assert_allclose(track.wrenches[same], expected, rtol=0.0, atol=1e-12)


def test_positions_and_phases_are_found(sound):
    scene, recording, _ = sound
    assert recording.positions == pytest.approx(POSITIONS)
    times = seconds(recording)
    assert np.array_equal(recording.position, scene.position_at(times))
    assert np.array_equal(recording.segment, recording.position)  # a stay each, nothing cut
    load = np.linalg.norm(scene.wrench_at(times)[:, :3], axis=1)
    assert np.all(load[recording.untouched] < 0.05)
    in_rest = times % (scene.stay_s + scene.gap_s) < scene.rest_s - 0.2
    assert np.mean(recording.untouched[in_rest]) > 0.95


def test_a_position_visited_again_has_its_number_and_another_visit(tmp_path):
    scene = Scene(positions=POSITIONS[[0, 1, 0]])
    recording = tampered(tmp_path, lambda topics: None, scene)
    keys = np.unique(np.stack([recording.position, recording.visit, recording.segment]), axis=1)
    assert keys.T.tolist() == [[0, 0, 0], [0, 1, 2], [1, 0, 1]]
    samples = measure_deflection(recording).samples
    assert np.array_equal(samples.set_number, recording.visit)


def test_an_endless_joint_reported_within_one_turn_is_where_it_is(tmp_path):
    def wrap(topics):
        topics[JOINTS].values[::2, 3] -= 2.0 * np.pi

    roll = replace(GALEN.joints[3], lower=-np.inf, upper=np.inf)
    endless = replace(GALEN, joints=(*GALEN.joints[:3], roll, GALEN.joints[4]))
    recording = tampered(tmp_path, wrap, arm=endless)
    assert recording.problems == ()
    assert recording.positions == pytest.approx(SHORT.positions)
    assert recording.joints == pytest.approx(SHORT.joints_at(seconds(recording)), abs=1e-6)


def test_the_simulated_cells_pushes_agree_with_nominal():
    recording = read_pushes(ROOT / "bags" / "pushes", TOOL, arm=GALEN)
    assert recording.problems == ()
    _check_nominal(measure_deflection(recording))


@pytest.mark.parametrize("number", [359, 956])
def test_an_arm_that_others_wrote(number):
    folder = SHARED / f"recording_{number}"
    if not folder.is_dir():
        pytest.skip("the shared recordings are not here")
    recording = read_pushes(
        folder / "push", read_calibration(folder / "tool.json", arm=GALEN), arm=GALEN
    )
    measured = measure_deflection(recording)
    assert len(recording.positions) == 4
    untouched = recording.untouched[measured.rows]
    assert np.all(_over_nominal(measured, untouched) < 1.1)
    if number == 359:  # nothing but nominal
        _check_nominal(measured)
    else:  # hysteresis
        assert _over_nominal(measured, ~untouched).max() > 1.5


def _check_nominal(measured):
    """The residual of the nominal model is the tracker's noise, about zero."""
    everything = np.ones(len(measured.samples), dtype=bool)
    assert _over_nominal(measured, everything) == pytest.approx(np.ones(6), abs=0.08)
    mean = _residual(measured).mean(axis=0)
    assert np.all(np.abs(mean) < 0.15 * measured.samples.noise)


def _residual(measured):
    samples = measured.samples
    left = samples.deflection.copy()
    for number in np.unique(samples.position):
        here = samples.position == number
        joints = np.median(samples.joints[here], axis=0)
        left[here] -= nominal(joints, samples.wrench[here], samples.tip_m)
    return left


def _over_nominal(measured, rows):
    return np.sqrt(np.mean(_residual(measured)[rows] ** 2, axis=0)) / measured.samples.noise


# --- what is wrong with a recording -------------------------------------------------------------


@pytest.mark.parametrize("name", [TOOL_POSE, WRENCH])
def test_a_gap_is_cut(tmp_path, name):
    def lose(topics):
        topic = topics[name]
        topic.keep((topic.seconds() < 1.9) | (topic.seconds() > 2.2))

    recording = tampered(tmp_path, lose)
    assert said(recording, name, "1 gap")
    times = seconds(recording)
    assert not np.any((times > 1.91) & (times < 2.19))
    assert set(recording.segment[times < 1.9]) == {0}
    assert set(recording.segment[(times > 2.2) & (times < 4)]) == {1}


@pytest.mark.parametrize(
    ("value", "word"),
    [
        ([np.nan] * 7, "not finite"),
        ([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 0.0], "quaternion"),
        ([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.02], "quaternion"),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "identity"),
        (None, "frozen"),
    ],
)
def test_a_lost_marker_is_found_however_it_is_told(tmp_path, value, word):
    def lose(topics):
        topic = topics[TOOL_POSE]
        rows = np.flatnonzero((topic.seconds() > 1.9) & (topic.seconds() < 2.2))
        topic.values[rows] = topic.values[rows[0] - 1] if value is None else value

    recording = tampered(tmp_path, lose)
    (sentence,) = said(recording, "marker lost")
    assert word in sentence
    assert "18 samples" in sentence
    assert "at 1.90 s" in sentence
    times = seconds(recording)
    assert not np.any((times > 1.9) & (times < 2.2))
    assert np.max(recording.segment) == 2


def test_a_marker_that_is_elsewhere_for_some_samples_is_left_out_there(tmp_path):
    off = [0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    turned = 0.1 * np.array([0.0, 0.0, 0.0, 1.0, -1.0, 1.0, 0.0])

    def take_another_for_it(topics):
        values = topics[TOOL_POSE].values
        values[100:104] += off
        values[150] += turned
        values[150, 3:] /= np.linalg.norm(values[150, 3:])
        values[170:, 3:] *= -1.0  # the same rotations

    there = seconds(tampered(tmp_path, lambda topics: None))
    (tmp_path / "sound").mkdir()
    recording = tampered(tmp_path / "sound", take_another_for_it)
    (sentence,) = recording.problems
    assert "marker lost in 5 samples (elsewhere for a few samples), 2 times" in sentence
    assert len(recording) == len(there) - 5
    assert np.max(np.abs(measure_deflection(recording).samples.deflection)) < 3e-3


def test_a_marker_published_faster_than_it_is_measured_is_not_lost(tmp_path):
    def repeat(topics):
        for name in (TOOL_POSE, BASE_POSE):
            topic = topics[name]
            topic.values = topic.values[np.arange(len(topic.values)) // 3 * 3]

    scene = Scene(positions=POSITIONS[:2], tracker_rate_hz=180.0)
    recording = tampered(tmp_path, repeat, scene)
    assert recording.problems == ()
    assert np.array_equal(recording.segment, recording.position)


def test_stamps_that_jump_and_stay_are_cut_and_left_out(tmp_path):
    def jump(topics):
        topic = topics[TOOL_POSE]
        topic.stamp_ns[topic.seconds() > 8.0] += NS // 2

    recording = tampered(tmp_path, jump)
    assert said(recording, TOOL_POSE, "jump by +0.500 s", "after 7.98")
    assert said(recording, TOOL_POSE, "left out", "after a jump")
    assert seconds(recording).max() < 8.01
    # What is left is as good as before.
    assert_true_but_for_noise(measure_deflection(recording), seconds(recording))


def test_stamps_that_jump_for_one_sample_cost_that_sample_only(tmp_path):
    def jump(topics):
        topics[TOOL_POSE].stamp_ns[200] += NS // 2
        topics[JOINTS].stamp_ns[702] -= NS // 2
        topics[WRENCH].stamp_ns[900] += NS // 2

    recording = tampered(tmp_path, jump)
    clean = read_pushes(write(tmp_path / "clean", SHORT.topics()), TOOL, arm=GALEN)
    assert len(said(recording, "stamps jump by")) == 6  # there and back
    # The marker's own, and the one before the joints' bad one. The compensator rejects the bad
    # wrench, and its neighbours are near enough.
    lost = (np.setdiff1d(clean.stamp_ns, recording.stamp_ns) - START_NS) * 1e-9
    assert lost == pytest.approx([200 / 60 + 0.0021, 421 / 60 + 0.0021])
    assert np.isin(recording.stamp_ns, clean.stamp_ns).all()
    assert np.array_equal(recording.segment, recording.position)


def test_a_recorder_that_holds_up_is_no_jump(tmp_path):
    """It writes late what came while it was busy; the stamps are sound."""

    def hold_up(topics):
        for topic in topics.values():
            since = topic.seconds() - 2.0
            held = (since > 0.0) & (since < 0.6)
            topic.log_ns[held] += np.rint((0.6 - since[held]) * NS).astype(np.int64)

    recording = tampered(tmp_path, hold_up)
    assert recording.problems == ()
    assert np.array_equal(recording.segment, recording.position)


def test_stamps_that_jump_in_all_topics_at_once_are_only_cut(tmp_path):
    """The clock was set back by two seconds in the second rest: stamps come twice."""

    def jump(topics):
        for topic in topics.values():
            topic.stamp_ns[topic.seconds() > 6.3] -= 2 * NS

    recording = tampered(tmp_path, jump)
    assert said(recording, TOOL_POSE, "jump by -2.000 s")
    assert not said(recording, "after a jump")
    times = seconds(recording)
    cut = np.flatnonzero(np.diff(times) < 0)
    assert len(cut) == 1
    assert recording.segment[cut[0] + 1] == recording.segment[cut[0]] + 1
    late = np.arange(len(times)) > cut[0]
    assert_true_but_for_noise(measure_deflection(recording), times + 2.0 * late)


def test_wrenches_beyond_the_sensors_range_are_left_out(tmp_path):
    def spike(topics):
        topics[WRENCH].values[240] = [1.0, -130.0, 0.0, 0.0, 0.0, 0.0]

    recording = tampered(tmp_path, spike)
    (sentence,) = recording.problems
    assert "1 wrench left out, beyond the sensor's range: 1, -130, 0, 0, 0, 0" in sentence
    assert np.max(np.abs(recording.wrench[:, :3])) < 9.0


def test_wrenches_that_cannot_be_compensated_are_named(tmp_path):
    def spoil(topics):
        topics[WRENCH].values[240] = np.nan
        rows = np.flatnonzero((topics[JOINTS].seconds() > 1.0) & (topics[JOINTS].seconds() < 1.02))
        topics[JOINTS].values[rows[0], 3] += 4.0

    recording = tampered(tmp_path, spoil)
    assert said(recording, "1 wrench not compensated: a value is not finite")
    assert said(recording, "not compensated: no joint angles within 0.05 s")
    other = replace(TOOL, arm=replace(TOOL.arm, sensor_frame="other"))
    with pytest.raises(DeflectionError, match=r"no wrench could be.*frame_id is not 'other'"):
        read_pushes(tmp_path / "bag", other, arm=GALEN)


def test_repeated_and_late_stamps_are_left_out(tmp_path):
    def spoil(topics):
        stamp_ns = topics[TOOL_POSE].stamp_ns
        stamp_ns[100] = stamp_ns[99]
        stamp_ns[150] = stamp_ns[149] - 1_000_000

    recording = tampered(tmp_path, spoil)
    assert said(recording, "1 sample repeats a stamp")
    assert said(recording, "1 sample is older")
    assert np.all(np.diff(recording.stamp_ns) > 0)


@pytest.mark.parametrize("what", ["the base's marker", "the tracker"])
def test_a_move_is_found_cut_and_registered_anew(tmp_path, what):
    step = np.array([0.4e-3, -0.2e-3, 0.1e-3, 0.3e-3, 0.0, -0.5e-3])
    moved_s = SHORT.stay_s + 0.5  # between the two positions

    def move(topics):
        first = _poses(topics[BASE_POSE].values)[0]
        moved = first.displaced(step) @ first.inverse()
        for name in (BASE_POSE,) if what == "the base's marker" else (BASE_POSE, TOOL_POSE):
            rows = topics[name].seconds() > moved_s
            poses = repeated(moved, rows.sum()) @ _poses(topics[name].values[rows])
            topics[name].values[rows] = np.hstack(
                [poses.translation, matrix_to_quaternion(poses.rotation)]
            )

    recording = tampered(tmp_path, move)
    (sentence,) = said(recording, "moved at")
    assert f"moved at {moved_s:.1f}" in sentence
    assert "by 0.4" in sentence
    assert "mm and 0.5" in sentence
    assert len(recording.stands) == 2
    found = recording.stands[1].pose.displacement_from(recording.stands[0].pose)
    assert found == pytest.approx(step, abs=5 * NOISE.max() / np.sqrt(200))
    measured = measure_deflection(recording)
    assert len(measured.registrations) == 2
    assert_true_but_for_noise(measured, seconds(recording))


def test_samples_after_a_move_that_nothing_registers_are_left_out(tmp_path):
    def move(topics):
        topic = topics[BASE_POSE]
        topic.values[topic.seconds() > 8.0, 0] += 1e-3

    recording = tampered(tmp_path, move)
    measured = measure_deflection(recording)
    assert measured.registrations[1] is None
    assert seconds(recording)[measured.rows].max() < 8.1
    assert any("nothing registers it" in text for text in measured.problems)


def _poses(values):
    return Transform(quaternion_to_matrix(values[:, 3:]), values[:, :3])


@pytest.mark.parametrize(("outliers", "goes_on"), [(0, 0.0), (3, 0.0), (0, 0.8)])
def test_no_move_is_found_where_there_is_none(outliers, goes_on):
    """In 20 recordings; a few poses that are far off are no move, nor is noise that goes on."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        white = rng.standard_normal((1500, 6)) * NOISE
        off = lfilter([np.sqrt(1.0 - goes_on**2)], [1.0, -goes_on], white, axis=0)
        off[rng.integers(0, len(off), outliers)] += 0.05
        assert len(base_stands(_track(off), START_NS)[0]) == 1


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_move_as_small_as_one_samples_noise_is_found(share):
    rng = np.random.default_rng(7)
    off = rng.standard_normal((800, 6)) * NOISE
    at = int(share * 800)
    off[at:, 1] += NOISE[1]
    stands, (sentence,) = base_stands(_track(off), START_NS)
    assert len(stands) == 2
    assert abs(stands[0].end_ns - (START_NS + at * NS // 60)) < NS
    assert "moved at" in sentence


def test_a_base_marker_that_was_looked_at_once_will_do(tmp_path):
    def freeze(topics):
        topics[BASE_POSE].values[:] = topics[BASE_POSE].values[0]

    recording = tampered(tmp_path, freeze)
    assert recording.problems == ()
    assert len(recording.stands) == 1


def _track(off):
    many = repeated(BASE_IN_TRACKER, len(off)).displaced(off)
    stamp_ns = START_NS + np.arange(len(off)) * NS // 60
    values = np.hstack([many.translation, matrix_to_quaternion(many.rotation)])
    raw = RawTrack("base", stamp_ns, stamp_ns, values, ("tracker",), {})
    return marker_track(raw, 0.1, START_NS, may_stand=True)


# --- phases without load ------------------------------------------------------------------------


def _wrenches(load, offset=0.0, seed=1):
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((len(load), 6)) * SENSOR.noise_std
    return load[:, None] * np.array([1.0, 0, 0, 0, 0.1, 0]) + offset + noise


def _phases(load, offset=0.0):
    wrenches = _wrenches(load, offset)
    time_ns = START_NS + np.arange(len(load)) * NS // 100
    return no_contact_phase(time_ns, wrenches, noise_of_mean(time_ns, wrenches))


def test_the_untouched_phase_ends_before_the_push():
    load = np.zeros(800)
    load[300:400] = np.linspace(0.0, 5.0, 100)
    found, _, _ = _phases(load)
    assert found is not None
    assert 2.5 < (found[1] - START_NS) * 1e-9 < 3.0
    # An offset of the tool's file is no load.
    found, offset, _ = _phases(np.zeros(300), np.array([0.2, 0.0, 0.0, 0.0, 0.01, 0.0]))
    assert found is not None
    assert offset[0] == pytest.approx(0.2, abs=0.01)


def test_a_visit_that_begins_under_load_has_no_untouched_phase():
    found, _, why_none = _phases(np.full(300, 4.0))
    assert found is None
    assert "under load (4.00 N" in why_none
    assert _phases(np.linspace(0.0, 4.0, 300))[0] is None


def test_a_recording_pushed_from_the_start_says_so(tmp_path):
    scene = Scene(positions=POSITIONS[:2], rest_s=0.0)
    recording = read_pushes(write(tmp_path / "bag", scene.topics()), TOOL, arm=GALEN)
    assert len(said(recording, "not untouched at first")) == 2
    with pytest.raises(
        RegistrationError, match=r"stands untouched.*; position 0.*changes from the start"
    ):
        measure_deflection(recording)


def test_stamps_of_the_tracker_that_lie_off_are_told_by_what_moves_untouched(tmp_path):
    def late(topics):
        for name in (TOOL_POSE, BASE_POSE):
            topics[name].stamp_ns += 25_000_000

    scene = Scene(positions=POSITIONS[:3], gap_s=0.6)
    recording = tampered(tmp_path, late, scene)
    (sentence,) = measure_deflection(recording).problems
    assert "do its stamps lie off" in sentence


def test_the_noise_is_that_of_the_sensor_whatever_is_pushed():
    load = 5.0 * np.sin(np.arange(3000) / 100.0)
    assert wrench_noise(_wrenches(load)) == pytest.approx(SENSOR.noise_std, rel=0.1)


def test_a_filtered_sensors_noise_goes_on_and_is_no_load():
    """Low-passed at a thirtieth of the rate: its means scatter more than white noise's would."""
    rng = np.random.default_rng(9)
    time_ns = START_NS + np.arange(3000) * NS // 500
    white = rng.standard_normal((3100, 6)) * SENSOR.noise_std
    wrenches = lfilter([0.436], [1.0, -0.9], white, axis=0)[100:]
    noise = noise_of_mean(time_ns, wrenches)
    blocks = wrenches.reshape(60, 50, 6).mean(axis=1)
    assert noise == pytest.approx(blocks.std(axis=0), rel=0.6)
    found, _, _ = no_contact_phase(time_ns, wrenches, noise)
    assert found == (time_ns[0], time_ns[-1])


# --- recordings that can't be used --------------------------------------------------------------


def _without_base(topics):
    del topics[BASE_POSE]


def _lost(topics):
    topics[TOOL_POSE].values[:, 3:] = 0.0


def _restless(topics):
    topics[JOINTS].values += 0.1 * np.sin(10.0 * topics[JOINTS].seconds())[:, None]


def _ahead(*names):
    def tamper(topics):
        for name in names:
            topics[name].stamp_ns += 3600 * NS

    return tamper


@pytest.mark.parametrize(
    ("tamper", "error", "words"),
    [
        (_without_base, BagError, "tracker/base_pose"),
        (_lost, DeflectionError, r"no sample is left.*marker lost in \d+ samples"),
        (_restless, DeflectionError, "never stands still"),
        (_ahead(WRENCH), DeflectionError, "no wrench could be compensated"),
        (_ahead(TOOL_POSE, BASE_POSE), DeflectionError, r"tool_pose: stamps are 3600\.000 s ahead"),
    ],
)
def test_why_a_recording_cant_be_used_is_named(tmp_path, tamper, error, words):
    with pytest.raises(error, match=words):
        tampered(tmp_path, tamper)
