# SPDX-License-Identifier: Apache-2.0
"""Joints of known parameters, and with friction that no model has: what a fit finds."""

from dataclasses import replace

import numpy as np
import pytest
from galen_deflection.measurement.samples import DeflectionError
from galen_deflection.scoring.joint_fit import OURS, CellSums, compare, estimate, fit_terms
from galen_deflection.scoring.joint_report import notes
from galen_model.errors import GalenError
from galen_model.transmission import (
    TERMS,
    JointRun,
    Scales,
    design,
    encoder_step,
    swapped,
    time_blocks,
    whole_runs,
)
from joint_synthetic import LOST_RAD, NOISE_RAD, STIFFNESS, dahl_run, lost_run, motion, spring_run


def within(found, true, sigmas=3.0):
    return abs(found.value - true) < sigmas * found.std


def test_stiffness_of_a_spring_with_dahls_friction():
    runs = [dahl_run(f"run{k}", k, seconds=14.0) for k in range(4)]
    comparison = compare(runs, whole_runs(runs))
    assert set(comparison.chosen) <= {"torque plays", "both plays"}
    scores = comparison.scores
    assert scores[OURS].rmse < 0.5 * scores["linear"].rmse
    assert scores[OURS].rmse < 2.0 * NOISE_RAD
    found = estimate(comparison)
    # 1 / k is its slope once all of the friction slides; at first Dahl's own stiffness, ten times
    # the spring's, is beside it
    assert within(found.estimates["compliance"], 1.0 / STIFFNESS)
    assert found.estimates["compliance"].std < 0.05 / STIFFNESS
    assert found.stiffness.interval[0] < STIFFNESS < found.stiffness.interval[1]
    assert found.estimates["compliance_first"].value < 0.4 / STIFFNESS
    assert "delay" not in found.plain


def test_lost_motion_that_friction_takes_up():
    runs = [lost_run(f"run{k}", k, seconds=14.0) for k in range(4)]
    comparison = compare(runs, whole_runs(runs))
    assert set(comparison.chosen) == {"lost motion"}
    assert comparison.scores[OURS].rmse < 0.5 * comparison.scores["direction"].rmse
    assert comparison.scores[OURS].rmse < 1.5 * NOISE_RAD
    found = estimate(comparison).estimates
    assert within(found["compliance"], 1.0 / STIFFNESS)
    assert found["lost_motion"].value == pytest.approx(LOST_RAD, rel=0.03)
    assert found["torque_loop"].value == 0.0


def test_a_spring_in_noise_is_found_as_well_as_it_can_be():
    noise, errors, stds = 2e-3, [], []
    for seed in range(3):
        runs = [spring_run("run", seed, noise, seconds=10.0)]
        comparison = compare(runs, time_blocks(runs, 4))
        found = estimate(comparison, "linear").estimates["compliance"]
        errors.append(found.value - 1.0 / STIFFNESS)
        stds.append(found.std)
        assert comparison.scores["linear"].rmse == pytest.approx(noise, rel=0.06)
        assert comparison.noise.floor == pytest.approx(noise, rel=0.06)
        assert comparison.scores[OURS].rmse < 1.05 * comparison.scores["linear"].rmse
    # Cramer and Rao's bound, for a mean torque of about zero
    bound = noise / np.sqrt(np.sum((runs[0].torque - runs[0].torque.mean()) ** 2))
    assert 0.5 * bound < np.median(stds) < 1.5 * bound
    assert np.sqrt(np.mean(np.square(errors))) < 2.0 * bound


def test_a_late_clock_is_distinguished_from_compliance():
    runs = [spring_run("run", 3, 2e-5, seconds=12.0)]
    late = np.interp(runs[0].time_s - 0.003, runs[0].time_s, runs[0].link)
    runs = [replace(runs[0], link=late)]
    parts = time_blocks(runs, 4)
    without = compare(runs, parts)
    told = compare(runs, parts, ("delay",))
    assert told.scores[OURS].rmse < 0.2 * without.scores[OURS].rmse
    found = estimate(told)
    assert found.estimates["delay"].value == pytest.approx(0.003, rel=0.02)
    assert found.estimates["compliance"].value == pytest.approx(1.0 / STIFFNESS, rel=0.02)
    assert any("after the motor's" in note for note in notes(told, found))
    # without the term, the motor's direction of motion has to stand for it
    assert estimate(without, "direction").estimates["direction"].value > 5e-4


def test_what_is_held_out_is_not_seen():
    runs = [lost_run(f"run{k}", k, seconds=6.0) for k in range(3)]
    parts = whole_runs(runs)
    before = compare(runs, parts)
    changed = [replace(runs[0], link=runs[0].link + 0.01 * np.sin(runs[0].time_s)), *runs[1:]]
    after = compare(changed, parts)
    for name, lags in before.predictions.items():
        assert np.array_equal(lags[0], after.predictions[name][0])
    assert not np.allclose(before.predictions["linear"][1], after.predictions["linear"][1])


def test_terms_look_neither_ahead_nor_at_the_link():
    run = dahl_run("run", 1, seconds=8.0)
    scales = Scales.of([run], [np.full(len(run), True)], 0.1)
    before, half = design(run, scales), len(run) // 2
    later = np.arange(len(run)) >= half
    other = replace(
        run,
        motor=run.motor + 0.2 * later,
        torque=run.torque + 30.0 * later,
        link=run.link + 1.0,
    )
    after = design(other, scales)
    assert np.array_equal(before[:half], after[:half])
    assert not np.allclose(before[half:], after[half:])


def test_bounds_hold_for_what_gives_and_not_for_the_rest():
    run = spring_run("run", 1, 1e-5)
    turned = replace(run, torque=-run.torque)
    scales = Scales.of([turned], [np.full(len(run), True)], 0.1)
    sums = CellSums.of([turned], time_blocks([turned], 4), [design(turned, scales)])
    cells = np.arange(len(sums.count))
    assert fit_terms(sums, cells, ("offset", "spring"))[TERMS.index("spring")] == 0.0
    free = fit_terms(sums, cells, ("offset", "spring"), bounded=False)
    assert free[TERMS.index("spring")] == pytest.approx(-1.0 / STIFFNESS, rel=0.01)
    comparison = compare([turned], time_blocks([turned], 4))
    found = estimate(comparison, "linear")
    assert found.stiffness is None
    assert any("--torque-gear" in note for note in notes(comparison, found))
    with pytest.raises(DeflectionError, match="no readings"):
        fit_terms(sums, cells[:0], ("offset", "spring"))


def test_swapped_ends_are_told():
    # a gap of 20 mrad: the link stands while the motor turns back
    time_s, motor = motion(20.0, 1)
    link = np.empty_like(motor)
    at = 0.0
    for k, angle in enumerate(motor):
        at = min(max(at, angle - 0.02), angle + 0.02)
        link[k] = at
    run = JointRun("run", time_s, motor, link, np.sin(time_s))
    assert not swapped([run])
    assert swapped([replace(run, motor=link, link=motor)])
    assert not swapped([spring_run("run", 1, 1e-4)])


def test_runs_that_may_train_for_each_other():
    names = ("tool4_00", "tool4_01", "tool4_12", "tool4_21", "tool4_33")
    runs = [spring_run(name, k, 1e-5, seconds=2.0) for k, name in enumerate(names)]
    parts = whole_runs(runs, "_(.)(.)")
    assert parts.trained_on(0) == [2, 3, 4]
    assert parts.trained_on(1) == [2, 4]
    assert whole_runs(runs).trained_on(3) == [0, 1, 2, 4]
    with pytest.raises(GalenError, match="tool4_00: 1 runs differ"):
        whole_runs(runs[:3], "_(.)(.)")
    for pattern in ("x(.)", "tool4"):
        with pytest.raises(GalenError, match=r"tool4_00: .* finds no groups"):
            whole_runs(runs, pattern)
    with pytest.raises(GalenError, match="no regular expression"):
        whole_runs(runs, "(")
    with pytest.raises(GalenError, match="2 runs"):
        whole_runs(runs[:2])


@pytest.mark.filterwarnings("error")
def test_an_angle_that_stays_shows_no_step_of_an_encoder():
    assert encoder_step(np.full(100, 0.3)) == 0.0
    assert encoder_step(np.repeat([0.3, 0.31], 50)) == pytest.approx(0.01)
