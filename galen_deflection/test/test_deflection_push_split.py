# SPDX-License-Identifier: Apache-2.0
"""Pushes dealt out: whole pushes with their pauses, everywhere, and no fit sees what is checked."""

from dataclasses import replace

import numpy as np
import pytest
from deflection_pushes import NOISE, TIP, make_samples, pushes_along
from deflection_synthetic import POSITIONS
from galen_deflection.measurement.samples import find_pushes, joined
from galen_deflection.models.interface import FitSettings
from galen_deflection.models.springs import tip_wrench
from galen_deflection.scoring.cross_check import (
    SPLITS,
    Split,
    SplitError,
    checked_samples,
    cross_check,
    fit_without,
    push_splits,
    usual_splits,
)
from galen_deflection.scoring.score import score
from galen_model.arm.galen import GALEN

SPRINGS = ["joint_stiffness", "joint_hysteresis"]


def visit(position, levels, *, set_number=0, seed=0):
    """Pushes along x, y, z in turn at a position, with the nominal deflection and noise."""
    load = np.concatenate([pushes_along(k % 3, [level]) for k, level in enumerate(levels)])
    joints = POSITIONS[position]
    rng = np.random.default_rng(seed + 10 * position + set_number)
    noise = NOISE * rng.standard_normal((len(load), 6))
    deflection = load @ GALEN.tip_compliance(joints, TIP).T + noise
    return make_samples(load, deflection, joints=joints, position=position, set_number=set_number)


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


def test_a_cut_between_two_checked_stretches_is_seen_even_where_both_are_unloaded():
    count = 40
    samples = make_samples(np.zeros((count, 6)), np.zeros((count, 6)))
    rows = np.zeros(count, dtype=bool)
    rows[:10] = rows[20:30] = True
    checked = checked_samples(samples, [Split("some", rows)])
    assert checked.segment.tolist() == [0] * 10 + [1] * 10
    with pytest.raises(ValueError, match="again: some of its samples are checked by another"):
        checked_samples(samples, [Split("some", rows), Split("again", rows)])


def test_too_few_pushes_to_deal_are_rejected():
    few = joined([visit(0, [8.0] * 6), visit(1, [8.0, 6.0, -5.0])])
    with pytest.raises(SplitError, match="position 1 has 3 pushes"):
        push_splits(few)


def test_nothing_is_not_joined(samples):
    with pytest.raises(ValueError, match="no samples to join"):
        joined([samples.rows(slice(0))] * 2)


def test_visits_of_two_pushes_each_reach_all_folds_together():
    twice = joined([visit(0, [8.0, -6.0], set_number=number, seed=7) for number in range(2)])
    assert [split.check.any() for split in push_splits(twice)] == [True] * 4


def test_a_segment_without_a_push_is_only_fitted_to(samples):
    quiet = visit(0, [8.0]).rows(slice(0, 25))
    with_quiet = joined([samples, quiet])
    for split in push_splits(with_quiet):
        assert not split.check[-25:].any()


# --- nothing leaks ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SPRINGS)
@pytest.mark.parametrize("name", ["push", "position"])
def test_what_is_checked_has_no_say_in_the_fit(samples, kind, name):
    split = SPLITS[name](samples)[1]
    measured = samples.deflection.copy()
    measured[split.check] = np.nan
    hidden = replace(samples, deflection=measured)
    settings = FitSettings()
    seen = fit_without(kind, samples, split, settings).to_json()
    blind = fit_without(kind, hidden, split, settings).to_json()
    assert blind == seen
    # ... and what is fitted to has: or this could not fail.
    measured = samples.deflection.copy()
    measured[~split.check] *= 1.5
    assert (
        fit_without(kind, replace(samples, deflection=measured), split, settings).to_json() != seen
    )


def test_one_position_alone_is_only_asked_by_pushes(samples):
    assert usual_splits(samples) == ["push", "position"]
    one = samples.rows(samples.position == 0)
    assert usual_splits(one) == ["push"]
    with pytest.raises(SplitError, match="only position 0"):
        SPLITS["position"](one)


# --- the score ----------------------------------------------------------------------------------


def test_each_sample_is_predicted_by_the_model_that_had_not_seen_it(samples):
    splits = SPLITS["push"](samples)
    done = []
    checked = cross_check("joint_stiffness", samples, splits, on_split=lambda: done.append(1))
    assert len(checked.samples) == len(samples)
    assert len(checked.models) == len(checked.seconds) == len(done) == 4
    # The model is the truth here.
    assert checked.score.ratio_of() == pytest.approx(1.0, abs=0.05)
    assert len(checked.score.rests.measured) == 18
    for split, model in zip(splits, checked.models, strict=True):
        mean = model.predict(samples).mean[split.check]
        assert np.array_equal(checked.predicted.mean[split.check], mean)
    positions = cross_check("joint_stiffness", samples, SPLITS["position"](samples))
    expected = score(positions.samples, positions.predicted)
    assert positions.score.rmse == pytest.approx(expected.rmse)
