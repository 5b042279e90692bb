"""Pushes dealt out: whole pushes with their pauses, everywhere, and no fit sees what is checked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deflection_pushes import NOISE, TIP, make_samples, pushes_along
from galen_deflection.measurement.pushes import PushLimits, find_pushes, tip_wrench
from galen_deflection.measurement.recordings import Recording
from galen_deflection.measurement.samples import DeflectionSamples, joined
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.registry import KINDS
from galen_deflection.scoring.cross_check import Task, cross_check, fit_without, make_tasks
from galen_deflection.scoring.score import score
from galen_deflection.scoring.splits import Split, SplitError, checked_samples, push_splits
from galen_model.arm.kinematics import sensor_pose, tip_pose
from galen_model.arm.stiffness import tip_compliance
from galen_model.wrench import move_wrench
from push_bag import TOOL

PHYSICS = ["independent", "coupled", "joint_stiffness", "joint_hysteresis"]
PLACES = np.array([[0.0, 0.0, 0.408, 0.0, 0.0], [0.06, -0.05, 0.43, 0.7, -0.4],
                   [-0.07, 0.04, 0.37, -0.9, 0.5]])  # fmt: skip


def visit(position, levels, *, set_number=0, seed=0):
    """Pushes along x, y, z in turn at a position, with the nominal deflection and noise."""
    load = np.concatenate([pushes_along(k % 3, [level]) for k, level in enumerate(levels)])
    joints = PLACES[position]
    rotation, origin = sensor_pose(joints)
    _, tip = tip_pose(joints, TIP)
    count = len(load)
    rng = np.random.default_rng(seed + 10 * position + set_number)
    deflection = load @ tip_compliance(joints, TIP).T + NOISE * rng.standard_normal((count, 6))
    return DeflectionSamples(
        stamp_ns=np.arange(count) * 10_000_000,
        segment=np.zeros(count, dtype=int),
        position=np.full(count, position),
        set_number=np.full(count, set_number),
        joints=np.tile(joints, (count, 1)),
        wrench=move_wrench(load, rotation.T, rotation.T @ (tip - origin)),
        deflection=deflection,
        tip_m=TIP,
        noise=NOISE,
    )


@pytest.fixture(scope="module")
def samples():
    """Three positions, one visit each, six pushes of different strength."""
    levels = [8.0, -10.0, 6.0, -4.0, 9.0, -7.0]
    return joined([visit(position, levels) for position in range(3)])


def found_pushes(samples):
    return find_pushes(samples, tip_wrench(samples))


def test_every_sample_is_checked_once_and_pushes_stay_whole_with_the_pause_after(samples):
    splits = push_splits(samples)
    assert np.array_equal(sum(split.check.astype(int) for split in splits), np.ones(len(samples)))
    pushes = found_pushes(samples)
    assert len(pushes) == 18
    for push in pushes:
        inside = slice(push.rows.start, push.rest.stop)
        assert push.rest.stop > push.rest.start
        assert [split.check[inside].all() for split in splits].count(True) == 1
        assert [split.check[inside].any() for split in splits].count(True) == 1


def test_every_fold_checks_at_every_position_and_the_same_push_at_one_only(samples):
    pushes = found_pushes(samples)
    number = {push.peak: k % 6 for k, push in enumerate(pushes)}
    for split in push_splits(samples):
        checked = [push for push in pushes if split.check[push.peak]]
        assert {int(samples.position[push.peak]) for push in checked} == {0, 1, 2}
        # Push k of the script, checked at one position, is fitted to at the others; six pushes in
        # four folds come round once.
        by_number = [number[push.peak] for push in checked]
        assert max(map(by_number.count, by_number)) < 3


def test_what_is_checked_is_scored_push_by_push(samples):
    splits = push_splits(samples)
    checked = checked_samples(samples, splits)
    assert np.array_equal(checked.stamp_ns, samples.stamp_ns)
    assert len(np.unique(checked.segment)) == 18
    # With the whole's own limits, as a part has a smaller largest load; see cross_check.
    limits = PushLimits().absolute(tip_wrench(samples))
    found = find_pushes(checked, tip_wrench(checked), limits)
    assert [push.peak for push in found] == [push.peak for push in found_pushes(samples)]
    one = checked_samples(samples, splits[:1])
    assert np.array_equal(one.deflection, samples.deflection[splits[0].check])
    assert len(find_pushes(one, tip_wrench(one), limits)) == len(np.unique(one.segment))


def test_a_cut_between_two_checked_stretches_is_seen_even_where_both_are_unloaded():
    count = 40
    samples = make_samples(np.zeros((count, 6)), np.zeros((count, 6)))
    rows = np.zeros(count, dtype=bool)
    rows[:10] = rows[20:30] = True
    checked = checked_samples(samples, [Split("some", ~rows, rows)])
    assert checked.segment.tolist() == [0] * 10 + [1] * 10
    with pytest.raises(ValueError, match="again: some of its samples are checked by another"):
        checked_samples(samples, [Split("some", ~rows, rows), Split("again", ~rows, rows)])


def test_too_few_pushes_to_deal_are_rejected():
    few = joined([visit(0, [8.0] * 6), visit(1, [8.0, 6.0, -5.0])])
    with pytest.raises(SplitError, match="position 1 has 3 pushes"):
        push_splits(few)


def test_a_segment_without_a_push_is_only_fitted_to(samples):
    quiet = visit(0, [8.0]).rows(slice(0, 25))
    with_quiet = joined([samples, quiet])
    for split in push_splits(with_quiet):
        assert not split.check[-25:].any()
        assert split.train[-25:].all()


# --- nothing leaks ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", PHYSICS)
@pytest.mark.parametrize("name", ["push", "position"])
def test_what_is_checked_has_no_say_in_the_fit(samples, kind, name):
    task = Task.of(name, samples)
    split, use = task.splits[1], task.use[1]
    measured = samples.deflection.copy()
    measured[split.check] = np.nan
    hidden = replace(samples, deflection=measured)
    settings = FitSettings()
    seen = fit_without(kind, samples, use, settings).to_json()
    blind = fit_without(kind, hidden, use, settings).to_json()
    assert blind == seen
    # ... and what is fitted to has: or this could not fail.
    measured = samples.deflection.copy()
    measured[split.train] *= 1.5
    assert fit_without(kind, replace(samples, deflection=measured), use, settings).to_json() != seen


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lstm", "lstm_direct"])
def test_what_is_checked_has_no_say_in_a_networks_fit(samples, kind):
    pytest.importorskip("torch", reason="networks need PyTorch: `make networks` installs it")
    assert KINDS[kind].is_network
    task = Task.of("push", samples)
    measured = samples.deflection.copy()
    measured[task.splits[1].check] = np.nan
    hidden = replace(samples, deflection=measured)
    settings = FitSettings(iterations=2)
    fits = [fit_without(kind, some, task.use[1], settings) for some in (samples, hidden)]
    assert fits[0].to_json() == fits[1].to_json()
    assert np.array_equal(fits[0].predict(samples).mean, fits[1].predict(samples).mean)


def test_where_whole_segments_are_checked_not_even_their_loads_are_shown(samples):
    task = Task.of("position", samples)
    wrench = samples.wrench.copy()
    wrench[task.splits[2].check] *= 100.0
    stronger = replace(samples, wrench=wrench)
    fits = [
        fit_without("joint_hysteresis", some, task.use[2], FitSettings()).to_json()
        for some in (samples, stronger)
    ]
    assert fits[0] == fits[1]


def test_extra_samples_are_fitted_to_but_for_the_position_left_out(samples):
    extra = visit(1, [8.0, -10.0, 6.0], set_number=4, seed=5)
    whole = joined([samples, extra])
    for name, left_out in (("push", None), ("position", 1)):
        task = Task.of(name, samples, whole)
        for split, use in zip(task.splits, task.use, strict=True):
            assert np.array_equal(use[: len(samples)], split.train)
            assert use[len(samples) :].all() == (split.name != f"position {left_out}")
            assert use[len(samples) :].any() == (split.name != f"position {left_out}")


def test_one_position_alone_is_only_asked_by_pushes(samples):
    def recordings_of(count):
        some = samples.rows(samples.position < count)
        return [Recording(Path("bag"), TOOL, some, PLACES[:count], ())]

    assert [task.split for task in make_tasks(None, recordings_of(2))] == ["push", "position"]
    assert [task.split for task in make_tasks(None, recordings_of(1))] == ["push"]
    with pytest.raises(SplitError, match="only position 0"):
        make_tasks(["position"], recordings_of(1))


# --- the score ----------------------------------------------------------------------------------


def test_each_sample_is_predicted_by_the_model_that_had_not_seen_it(samples):
    checked = cross_check("joint_stiffness", Task.of("push", samples))
    assert len(checked.samples) == len(samples)
    assert len(checked.models) == len(checked.seconds) == 4
    # The model is the truth here.
    assert checked.score.ratio_all == pytest.approx(1.0, abs=0.05)
    assert len(checked.score.loops.measured) == 18
    for split, model in zip(Task.of("push", samples).splits, checked.models, strict=True):
        mean = model.predict(samples).mean[split.check]
        assert np.array_equal(checked.predicted.mean[split.check], mean)


def test_the_score_of_a_task_is_that_of_its_check_samples_alone(samples):
    task = Task.of("position", samples)
    by_axes = cross_check("coupled", task)
    expected = score(by_axes.samples, by_axes.predicted)
    assert by_axes.score.rmse == pytest.approx(expected.rmse)
    seen = fit_to_all("coupled", samples)
    assert by_axes.score.ratio_all > 1.2 * score(samples, seen.predict(samples)).ratio_all


def fit_to_all(kind, samples):
    return fit_without(kind, samples, np.ones(len(samples), dtype=bool), FitSettings())
