# SPDX-License-Identifier: Apache-2.0
"""From a recording's still phases to sweeps and loads: what is found, and what is rejected."""

import numpy as np
import pytest
from calibration_tape import NO_TOOL, POINTER, RETRACTOR, Tape, grid
from galen_calibration_behavior.calibration.estimate import estimate
from galen_calibration_behavior.common.parameters import CalibrationParameters
from galen_calibration_behavior.from_bag.sweeps import SweepSorter
from galen_calibration_behavior.from_bag.visits import find_visits
from galen_model.arm.galen import GALEN
from galen_model.errors import GalenError
from galen_model.load.identification import identify_two_sweeps
from galen_model.load.model import ADAPTER, Load, gravity_wrench

PARAMETERS = CalibrationParameters()
SETTINGS = PARAMETERS
SORTER = SweepSorter(SETTINGS, (0.0, 0.0))
POSES = grid()
# chi-square with 4 degrees of freedom is above it once in 10000 draws
CHI2_4 = 23.5


def visits(tape):
    return find_visits(tape.recording(), SETTINGS)


def two_sweeps(tape, **options):
    return SORTER.two_sweeps(visits(tape), **options)


def found(sweeps):
    return estimate("x.json", "x", np.zeros(3), sweeps.measurements, [])


def loads(sweeps):
    """Tool and adapter by the constant bias alone, which takes a tenth of the time."""
    told = sweeps.measurements
    return identify_two_sweeps(told.bare, told.tool, told.zero_angles)


def error_squared(estimated, true):
    """Squared distance of (mass, centre) from the truth in the stated covariance."""
    error = np.array([estimated.mass_kg - true.mass_kg, *(estimated.com_m - true.com_m)])
    return error @ np.linalg.solve(estimated.covariance, error)


def counts(sweeps):
    return len(sweeps.measurements.bare), len(sweeps.measurements.tool)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("tool", [POINTER, RETRACTOR])
def test_both_loads_come_out_as_well_as_they_say_and_the_border_where_the_tool_came_on(tool, seed):
    tape = Tape(seed)
    tape.calibration(tool)
    sweeps = two_sweeps(tape)
    assert counts(sweeps) == (len(POSES), len(POSES))
    both = loads(sweeps)
    assert error_squared(both.load, tool) < CHI2_4
    assert error_squared(both.adapter, ADAPTER) < CHI2_4
    tool_on_s = 3.0 + len(POSES) * 1.5 + 0.5 + 1.5
    assert sweeps.tool_on_s[0] < tool_on_s < sweeps.tool_on_s[1]
    assert sweeps.border.next_worse > 200.0
    assert sweeps.border.ratio > 50.0


@pytest.mark.parametrize(
    ("poses", "count"),
    [
        (grid((-1.0, 0.0, 1.0), (-0.8, 0.0, 0.8)), 9),  # home in the middle: kept
        (grid((0.0, -1.0, 1.0), (0.0, -0.8, 0.8)), 8),  # home first: not told from the stay there
    ],
)
def test_a_grid_may_contain_home(poses, count):
    sweeps = two_sweeps(Tape().calibration(POINTER, poses))
    assert counts(sweeps) == (count, count)
    home = [pose for pose in sweeps.poses if np.all(np.abs(pose.visit.joints[3:]) < 1e-3)]
    assert len(home) == (2 if count == 9 else 0)
    assert error_squared(loads(sweeps).load, POINTER) < CHI2_4


@pytest.mark.parametrize("before", ["another zero", "a tool"])
def test_nothing_from_before_the_zeroing_enters(before):
    tape = Tape()
    if before == "a tool":
        tape.tool = RETRACTOR
    else:
        tape.bias = np.array([0.3, -0.2, 0.1, 0.01, 0.02, 0.0])
    tape.pose = np.array([0.5, 0.5])
    tape.stay(2.0).move((0.0, 0.0)).stay(1.0)
    tape.tool = NO_TOOL
    sweeps = two_sweeps(tape.calibration(POINTER))
    assert counts(sweeps) == (len(POSES), len(POSES))
    assert "1 still phases before 6.5 s are left out" in sweeps.measurements.warnings[0]
    assert loads(sweeps).outliers == ()


def test_a_whole_sweep_before_the_zeroing_is_another_recording():
    tape = Tape(tool=RETRACTOR).sweep(POSES).move((0.0, 0.0)).stay(1.0)
    tape.tool = NO_TOOL
    sweeps = two_sweeps(tape.calibration(POINTER))
    assert counts(sweeps) == (len(POSES), len(POSES))
    assert error_squared(loads(sweeps).load, POINTER) < CHI2_4


def touched_at(pose, touch):
    """A calibration whose pose of this number in the tool's sweep is touched."""
    tape = Tape().stay(1.0).zero().stay(1.0).sweep(POSES).move((0.0, 0.0)).stay(1.0)
    tape.tool = POINTER
    tape.stay(1.0).sweep(POSES[:pose])
    tape.touch = touch
    tape.sweep([POSES[pose]])
    tape.touch = lambda _: np.zeros(6)
    return tape.sweep(POSES[pose + 1 :])


def shaken(time_s):
    return np.array([0.3 * np.sin(60.0 * time_s), 0.0, 0.0, 0.0, 0.0, 0.0])


def let_go(time_s):
    return np.array([0.0, 0.5 * (time_s < 0.6), 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("touch", [shaken, let_go])
def test_a_touched_pose_is_rejected_with_its_reason_and_the_rest_is_as_good(touch):
    sweeps = two_sweeps(touched_at(5, touch))
    assert counts(sweeps) == (len(POSES), len(POSES) - 1)
    (text,) = sweeps.measurements.rejected
    assert text.startswith("tool/5: f")
    assert "scattered" in text or "changed by" in text
    content = found(sweeps).content
    assert content.poses_rejected == (text,)
    assert error_squared(content.load, POINTER) < CHI2_4


def test_a_steady_push_is_the_fit_s_to_find():
    sweeps = two_sweeps(touched_at(5, lambda _: np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])))
    assert counts(sweeps) == (len(POSES), len(POSES))
    calibration = found(sweeps)
    (text,) = calibration.content.poses_rejected
    assert text.startswith("tool/5: ")
    assert "sigma off" in text


@pytest.mark.parametrize(
    "tape",
    [
        Tape().stay(1.0).zero().stay(1.0).sweep(POSES),
        Tape(tool=POINTER).sweep(POSES),
        Tape().sweep(POSES).move((0.0, 0.0)).stay(1.0).sweep(POSES),
        Tape().calibration(Load(0.0003, np.array([0.05, 0.0, 0.04]))),
    ],
    ids=["bare", "tool", "bare twice", "too light"],
)
def test_a_recording_in_which_no_tool_came_on_is_rejected_and_told_what_it_may_be(tape):
    with pytest.raises(GalenError, match=r"no tool came on.*--one-sweep.*--tool-on-at-s"):
        two_sweeps(tape)


@pytest.mark.slow
def test_a_light_tool_is_found_or_rejected_but_never_put_on_at_a_wrong_place():
    outcomes = []
    for mass in (0.0008, 0.0015, 0.002, 0.003, 0.006):
        tape = Tape(seed=4).calibration(Load(mass, np.array([0.05, 0.0, 0.04])))
        try:
            sweeps = two_sweeps(tape)
        except GalenError:
            outcomes.append(False)
            continue
        outcomes.append(True)
        assert counts(sweeps) == (len(POSES), len(POSES))
        assert error_squared(loads(sweeps).load, tape.tool) < CHI2_4
    assert outcomes[0] is False
    assert outcomes[-1] is True


def test_where_a_pose_belongs_to_either_sweep_the_border_is_asked_for():
    """In the last pose without the tool somebody holds it on, and carries half of it."""
    tape = Tape().stay(1.0).zero().stay(1.0).sweep(POSES[:-1])
    tape.touch = lambda _: 0.5 * gravity_wrench(GALEN.gravity_in_sensor(POSES[-1]), POINTER)
    tape.sweep(POSES[-1:])
    tape.touch = lambda _: np.zeros(6)
    tape.tool = POINTER
    tape.sweep(POSES)
    with pytest.raises(GalenError, match=r"before the pose at 19\.0 s or .*--tool-on-at-s"):
        two_sweeps(tape)
    sweeps = two_sweeps(tape, tool_on_at_s=20.0)
    assert counts(sweeps) == (len(POSES), len(POSES))
    assert error_squared(loads(sweeps).load, POINTER) < CHI2_4


def test_the_border_given_by_hand_is_taken_and_a_wrong_one_is_found_out():
    tape = Tape().calibration(POINTER)
    assert counts(two_sweeps(tape, tool_on_at_s=23.5)) == (len(POSES), len(POSES))
    with pytest.raises(GalenError, match=r"the load is another from 25\.0 s on"):
        two_sweeps(tape, tool_on_at_s=38.0)
    with pytest.raises(GalenError, match=r"no still pose after --tool-on-at-s 1000; they lie"):
        two_sweeps(tape, tool_on_at_s=1000.0)
    with pytest.raises(GalenError, match=r"no still pose before --tool-on-at-s 0;"):
        two_sweeps(tape, tool_on_at_s=0.0)


def test_two_recordings_of_a_sweep_each():
    bare = visits(Tape(1).stay(1.0).zero().stay(1.0).sweep(POSES))
    tool = visits(Tape(2, tool=POINTER).sweep(POSES).move((0.0, 0.0)).stay(1.0))
    sweeps = SORTER.two_recordings(bare, tool)
    assert counts(sweeps) == (len(POSES), len(POSES))
    assert sweeps.border is None
    assert error_squared(loads(sweeps).load, POINTER) < CHI2_4
    with pytest.raises(GalenError, match="the load is another from"):
        SORTER.two_recordings(bare, visits(Tape().calibration(POINTER)))


def test_a_recording_cut_off_in_the_second_sweep_gives_what_it_holds():
    tape = Tape().calibration(POINTER)
    whole = two_sweeps(tape)
    stop = int(np.searchsorted(tape.recording().joint_stamp_ns, whole.last.start_ns)) - 300
    sweeps = SORTER.two_sweeps(find_visits(tape.recording(stop=stop), SETTINGS))
    assert counts(sweeps)[0] == len(POSES)
    assert 8 <= counts(sweeps)[1] < len(POSES)
    assert error_squared(loads(sweeps).load, POINTER) < CHI2_4
    with pytest.raises(GalenError, match="no tool came on"):
        SORTER.two_sweeps(find_visits(tape.recording(stop=stop // 2), SETTINGS))
    with pytest.raises(GalenError, match="5 still poses are too few"):
        SORTER.two_sweeps(find_visits(tape.recording(stop=1080), SETTINGS))


def test_too_few_good_poses_are_rejected_as_live():
    tape = Tape(tool=POINTER).sweep(POSES)
    recording = tape.recording()
    start = recording.wrench_stamp_ns[0]
    time_s = (recording.wrench_stamp_ns - start) / 1e9
    recording.wrenches[time_s < 11.0, 0] = np.nan
    with pytest.raises(GalenError, match=r"only 5 of 12 poses of the tool .*fx not finite"):
        SORTER.one_sweep(find_visits(recording, SETTINGS))
