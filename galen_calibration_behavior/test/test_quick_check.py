# SPDX-License-Identifier: Apache-2.0
"""The quick check's decision: what it finds of known changes, and how often it is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from check_pointer_file import calibrated
from galen_calibration_behavior.common.check_decision import CheckLimits, differences, quick_check
from galen_calibration_behavior.quick_check.procedure import plan_check
from galen_model.arm.galen import GALEN
from galen_model.load.cable import LearnedPull
from galen_model.load.model import ADAPTER, TOOLS, Load, gravity_wrench, nominal_reading
from galen_model.load.verdict import Cause, CheckAnswer
from galen_model.poses.design import PoseDesign, PoseDesignError
from galen_model.poses.plan import Surroundings, SweepTimes
from galen_model.rest.segments import PoseRecord

from galen_msgs.action import CheckTool

POINTER, RETRACTOR = TOOLS["pointer"].load, TOOLS["retractor"].load
SIGMA = np.array([1.3e-3, 1.3e-3, 1.9e-3, 2.6e-5, 2.6e-5, 2.6e-5])  # of a mean of 250 samples
LOAD_STD = np.array([3e-5, 3e-5, 3e-5, 3e-5])  # kg and m, as a sweep of 56 poses leaves it
TIMES = SweepTimes(np.zeros(2), [0.8, 0.8], [3.0, 3.0], 0.9)
LIMITS = CheckLimits()


def heavier(load, mass_kg):
    """The load with more mass at its centre."""
    return Load(load.mass_kg + mass_kg, load.com_m)


def loose(load, shift_m):
    """A tool that hangs `shift_m` aside, the way gravity pulls it across the flange."""

    def extra(roll, tilt, _pose):
        gravity = GALEN.gravity_in_sensor((roll, tilt))
        aside = gravity / np.linalg.norm(gravity) * (1.0, 1.0, 0.0)
        return np.concatenate([np.zeros(3), np.cross(aside * shift_m, load.mass_kg * gravity)])

    return extra


def tilt_zero(load, offset_rad):
    """The tilt encoder reads `offset_rad` too little."""

    def extra(roll, tilt, _pose):
        true = nominal_reading((roll, tilt + offset_rad), load, ADAPTER, arm=GALEN)
        return true - nominal_reading((roll, tilt), load, ADAPTER, arm=GALEN)

    return extra


def touched(force_n):
    """A steady push at the third pose."""
    return lambda _roll, _tilt, pose: np.array([force_n, 0, 0, 0, 0, 0]) * (pose == 2)


def choose(here, reach_rad=0.5):
    joints = np.array([0.0, 0.0, 0.408, *here])
    return plan_check(joints, reach_rad, 6, TIMES, Surroundings(), np.zeros(3), arm=GALEN).poses


POSES = choose((0.0, 0.0))


def file_of(load, name="pointer", std=LOAD_STD, **fields):
    return calibrated(load, name, std, rmse=SIGMA, **fields)


def records(load, random, *, offset=0.0, extra=None, sigma=SIGMA, poses=POSES, nothing=False):
    """Averages at the poses: true physics, white noise; `extra(roll, tilt, k)` is added."""
    made = []
    for k, (roll, tilt) in enumerate(poses):
        wrench = nominal_reading((roll, tilt), load, ADAPTER, arm=GALEN) + offset
        wrench = wrench + (extra(roll, tilt, k) if extra else 0.0)
        noise = 0.0 if nothing else random.standard_normal(6) * sigma
        halves = random.standard_normal(6) * 2.0 * sigma
        joints = np.array([0.0, 0.0, 0.408, roll, tilt])
        made.append(
            PoseRecord(joints, np.zeros(5), wrench + noise, sigma * np.sqrt(250), halves, 250)
        )
    return made


NEVER_ZEROED = gravity_wrench(GALEN.gravity_in_sensor((0.0, 0.0)), ADAPTER)
ZEROED_ELSEWHERE = NEVER_ZEROED - gravity_wrench(GALEN.gravity_in_sensor((0.9, -0.6)), ADAPTER)
ZEROED_WITH_TOOL = -gravity_wrench(GALEN.gravity_in_sensor((0.0, 0.0)), POINTER)
PULL = np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0])
CASES = {
    "healthy": (POINTER, POINTER, {}, Cause.FITS, "fits"),
    "no noise": (
        Load(POINTER.mass_kg - 0.0005, POINTER.com_m), POINTER, {}, Cause.FITS,
        "within the limits (0.05 N, 2 mN.m), although noise alone does not explain",
    ),
    "small": (POINTER, POINTER, {"offset": 0.1 * PULL}, Cause.FITS, "0.020 N"),
    "offset": (POINTER, POINTER, {"offset": PULL}, Cause.OFFSET, "/gravcomp/tare"),
    "unzeroed": (
        POINTER, POINTER, {"offset": NEVER_ZEROED}, Cause.ZERO_LOST, "switched on",
    ),
    "zeroed": (
        POINTER, POINTER, {"offset": ZEROED_WITH_TOOL}, Cause.ZERO_LOST,
        "with the tool on",
    ),
    "elsewhere": (
        POINTER, POINTER, {"offset": ZEROED_ELSEWHERE}, Cause.ZERO_LOST,
        "in another pose",
    ),
    "wrong": (POINTER, RETRACTOR, {}, Cause.OTHER_TOOL, "'retractor'"),
    "none": (RETRACTOR, Load(0.0), {}, Cause.NO_TOOL, "no tool is on"),
    "heavier": (
        POINTER, heavier(POINTER, 0.005), {}, Cause.LOAD, "9 +- 0.1 g, its",
    ),
    "both": (
        RETRACTOR, heavier(RETRACTOR, 0.01), {"offset": PULL}, Cause.LOAD,
        "beside it an offset",
    ),
    "loose": (
        RETRACTOR, RETRACTOR, {"extra": loose(RETRACTOR, 0.005)}, Cause.UNEXPLAINED,
        "as of a loose tool:",
    ),
    "zero": (
        RETRACTOR, RETRACTOR, {"extra": tilt_zero(RETRACTOR, 0.03)}, Cause.UNEXPLAINED,
        "a joint's zero that has moved",
    ),
    "touched": (POINTER, POINTER, {"extra": touched(0.3)}, Cause.CONTACT, "repeat"),
    "noisy": (POINTER, POINTER, {"sigma": 60 * SIGMA}, Cause.NOISE, "too noisy"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_change_has_its_answer(case):
    believed, true, how, cause, words = CASES[case]
    others = {"retractor": file_of(RETRACTOR, "retractor")} if believed is POINTER else {}
    check = quick_check(
        records(true, np.random.default_rng(1), **how), file_of(believed), LIMITS, others=others
    )
    assert check.cause is cause, check.text
    assert words in check.text


@pytest.mark.parametrize(
    ("answer", "causes"),
    [
        (CheckAnswer.GOOD, {Cause.FITS}),
        (CheckAnswer.RETARE, {Cause.OFFSET, Cause.ZERO_LOST}),
        (CheckAnswer.RECALIBRATE, {Cause.LOAD, Cause.OTHER_TOOL, Cause.NO_TOOL, Cause.UNEXPLAINED}),
        (CheckAnswer.UNSURE, {Cause.CONTACT, Cause.NOISE}),
    ],
)
def test_a_cause_has_its_answer_and_the_message_s_number(answer, causes):
    assert {cause for cause in Cause if cause <= Cause.NOISE and cause.answer is answer} == causes
    assert getattr(CheckTool.Result, answer.name) == answer
    names = {Cause.FITS: "NOTHING", Cause.CONTACT: "TOUCHED"}
    for cause in causes:
        assert getattr(CheckTool.Result, names.get(cause, cause.name)) == cause


def test_a_change_without_noise_is_found_exactly():
    change, offset = Load(0.07, POINTER.com_m + (0.003, -0.002, 0.001)), 0.1 * np.arange(6)
    found = differences(
        records(change, np.random.default_rng(1), offset=offset, nothing=True),
        file_of(POINTER), LIMITS, np.zeros(6),
    )  # fmt: skip
    assert found.moments == pytest.approx(change.moments - POINTER.moments, abs=1e-12)
    assert found.offset == pytest.approx(offset, abs=1e-11)
    assert np.max(np.abs(found.rest)) < 1e-11


def test_standard_deviations_are_those_of_the_scatter_and_of_the_file():
    """Many files drawn as the calibration leaves them, and many checks of each."""
    random = np.random.default_rng(3)
    tool = file_of(POINTER)
    chi_squared = []
    for _ in range(150):
        mass, *com = random.normal([POINTER.mass_kg, *POINTER.com_m], LOAD_STD)
        drawn = file_of(Load(mass, np.array(com)))
        # The rmse is the noise, and the noise's own estimates are left out of the maximum.
        averages = [
            replace(record, wrench_std=record.wrench_std * 1e-3, half_difference=np.zeros(6))
            for record in records(POINTER, random)
        ]
        found = differences(averages, drawn, LIMITS, np.zeros(6))
        error = POINTER.moments - drawn.load.load.moments - found.moments
        assert np.all(np.abs(error[1:]) < 1e-4)
        information = np.linalg.inv(found.moments_covariance)
        chi_squared.append(found.moments @ information @ found.moments)
    assert np.mean(chi_squared) == pytest.approx(4.0, abs=5 * np.sqrt(8.0 / 150))
    assert differences(averages, tool, LIMITS, np.zeros(6)).sigma == pytest.approx(SIGMA)


def test_the_smallest_change_that_is_found_is_found_as_often_as_said():
    random = np.random.default_rng(4)
    tool = file_of(POINTER, std=1e-9 * LOAD_STD)
    smallest = quick_check(records(POINTER, random), tool, LIMITS).found_mass_kg
    assert 5e-5 < smallest < 3e-4
    for share, low, high in ((0.0, 0.0, 0.12), (1.0, 0.85, 1.0)):
        true = heavier(POINTER, share * smallest)
        told = [
            differences(records(true, random), tool, LIMITS, np.zeros(6)).load_p < 0.05
            for _ in range(100)
        ]
        assert low <= np.mean(told) <= high


def test_what_a_tare_takes_off_is_no_offset_any_more():
    averages = records(POINTER, np.random.default_rng(1), offset=PULL)
    check = quick_check(averages, file_of(POINTER), LIMITS, known_offset=PULL)
    assert check.answer is CheckAnswer.GOOD
    assert np.all(np.abs(check.found.offset) < 5 * SIGMA)
    unzeroed = records(POINTER, np.random.default_rng(1), offset=NEVER_ZEROED)
    check = quick_check(unzeroed, file_of(POINTER), LIMITS, known_offset=PULL)
    assert check.cause is Cause.ZERO_LOST
    assert check.found.offset == pytest.approx(NEVER_ZEROED - PULL, abs=5e-3)


def test_a_learned_cable_is_expected_as_the_compensation_expects_it():
    learned = np.array([[0.0, 0.0, 0.408, r, t] for r in (-0.6, 0.0, 0.6) for t in (-0.6, 0, 0.6)])
    pulls = np.column_stack([0.3 * np.sin(learned[:, 3:]), 0.2 * np.cos(learned[:, 3])])
    wrench = np.concatenate([pulls, 0.05 * pulls], axis=1)
    cable = LearnedPull(
        form="free", joints=learned, wrench=wrench, std=np.tile(SIGMA, (9, 1)),
        length_rad=np.array([1.0, 1.0]), length_m=0.1, amplitude=np.array([0.3, 0.02]),
        support_rad=0.6, learned_at="2026-01-01T00:00:00+00:00",
    )  # fmt: skip

    def pull(roll, tilt, _k):
        return cable.posterior.readings(np.array([[0.0, 0.0, 0.408, roll, tilt]]))[0]

    averages = records(POINTER, np.random.default_rng(1), extra=pull)
    with_cable, without = (
        quick_check(averages, file_of(POINTER, cable=part), LIMITS) for part in (cable, None)
    )
    left, without_part = (np.max(np.abs(c.found.rest)) for c in (with_cable, without))
    assert left < 5 * np.max(SIGMA) < 0.5 * without_part
    assert with_cable.cause in (Cause.FITS, Cause.NOISE)
    assert without.answer in (CheckAnswer.RECALIBRATE, CheckAnswer.RETARE)


def test_a_file_of_one_sweep_is_judged_by_what_it_knows_of_tool_and_adapter_together():
    split = np.array([5e-3, 1e-2, 1e-2, 1e-2])
    tool = file_of(POINTER, std=split, unresolved=("the tool's centre along z",))
    random = np.random.default_rng(1)
    assert quick_check(records(POINTER, random), tool, LIMITS).answer is CheckAnswer.GOOD
    check = quick_check(records(heavier(POINTER, 0.005), random), tool, LIMITS)
    assert check.cause is Cause.LOAD
    # The same covariance of two sweeps is what is known of their sum, too.
    untold = quick_check(records(POINTER, random), replace(tool, unresolved=()), LIMITS)
    assert untold.cause is Cause.NOISE


@pytest.mark.parametrize("here", [(0.0, 0.0), (1.5, 0.9), (-0.8, 0.4)])
def test_poses_are_near_and_tell_the_most_of_those_near(here):
    poses = choose(here)
    low, high = GALEN.angles(GALEN.lower), GALEN.angles(GALEN.upper)
    assert np.all((poses >= low) & (poses <= high))
    assert np.all(np.abs(poses - here) <= 1.0 + 1e-9)
    assert np.all(np.ptp(poses, axis=0) <= 1.0 + 1e-9)
    value = PoseDesign(poses, arm=GALEN).value
    random = np.random.default_rng(2)
    middle = (poses.min(axis=0) + poses.max(axis=0)) / 2
    scattered = [value(middle + random.uniform(-0.5, 0.5, (6, 2))) for _ in range(50)]
    assert value(poses) < min(scattered)


def test_a_reach_that_tells_nothing_is_rejected():
    with pytest.raises(PoseDesignError):
        choose((0.0, 0.0), 1e-7)
