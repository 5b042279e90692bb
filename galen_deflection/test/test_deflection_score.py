# SPDX-License-Identifier: Apache-2.0
"""Scores, against numbers found by hand."""

import json
from io import StringIO

import numpy as np
import pytest
from deflection_pushes import NOISE, along, hysteretic, make_samples, predict, pushes_along
from galen_deflection.measurement.samples import DeflectionError, find_pushes
from galen_deflection.models.springs import tip_wrench
from galen_deflection.scoring.report import score_table
from galen_deflection.scoring.score import RestScore, score
from rich.console import Console

# --- errors, noise, coverage --------------------------------------------------------------------


def test_errors_and_their_ratio_to_the_noise():
    count = 2
    measured = np.zeros((count, 6))
    error = along(1, [3e-3, -4e-3]) + along(5, [6e-3, 8e-3])
    result = score(
        make_samples(np.zeros((count, 6)), measured, noise=[1e-3] * 3 + [2e-3] * 3),
        predict(measured + error, extrapolated=[True, False]),
    )
    assert result.rmse == pytest.approx([0.0, np.sqrt(12.5) * 1e-3, 0.0, 0.0, 0.0, 5e-3 * 2**0.5])
    # Between two values, 95 % of the way from the smaller to the larger.
    assert result.percentile95 == pytest.approx([0.0, 3.95e-3, 0.0, 0.0, 0.0, 7.9e-3])
    assert result.ratio == pytest.approx([0.0, 12.5**0.5, 0.0, 0.0, 0.0, 12.5**0.5])
    assert result.ratio_of() == pytest.approx(np.sqrt(25.0 / 6.0))
    assert result.extrapolated == 0.5
    assert result.rests is None


def test_coverage_is_that_of_the_models_variance_and_the_noise():
    # 3 and 4 make 5; 95 % of a normal distribution are within 1.960 of it: 9.80.
    error = along(0, [9.7e-3, 9.9e-3, -9.7e-3, -9.9e-3])
    samples = make_samples(np.zeros((4, 6)), np.zeros((4, 6)), noise=[4e-3] * 6)
    result = score(samples, predict(error, variance=9e-6))
    assert result.coverage == pytest.approx([0.5, 1.0, 1.0, 1.0, 1.0, 1.0])
    assert result.coverage_joint == 1.0
    # Six axes: chi square of 12.59, 3.548 times 5.
    far = along(0, [17.7e-3, 17.8e-3, 30e-3, 0.0])
    assert score(samples, predict(far, variance=9e-6)).coverage_joint == 0.5


def test_the_ellipsoid_knows_of_correlation():
    # x and y that go together, correlation 0.99: an error along (1, -1) is far outside.
    predicted = predict(along(0, [2e-3, 2e-3]) + along(1, [2e-3, -2e-3]), variance=1e-6)
    predicted.covariance[:, 0, 1] = predicted.covariance[:, 1, 0] = 0.99e-6
    result = score(make_samples(np.zeros((2, 6)), np.zeros((2, 6)), noise=[1e-6] * 6), predicted)
    assert result.coverage_joint == 0.5
    assert result.coverage[:2] == pytest.approx([0.0, 0.0])


def test_a_perfect_prediction_is_at_the_floor():
    rng = np.random.default_rng(5)
    load = pushes_along(1, [3.0, -3.0, 10.0, -10.0] * 5)
    truth = 1e-4 * load
    samples = make_samples(load, truth + NOISE * rng.standard_normal(load.shape))
    result = score(samples, predict(truth))
    assert result.ratio == pytest.approx(np.ones(6), abs=0.06)
    assert result.percentile95 == pytest.approx(1.96 * NOISE, rel=0.06)
    assert result.coverage == pytest.approx(0.95 * np.ones(6), abs=0.02)
    assert result.coverage_joint == pytest.approx(0.95, abs=0.02)
    # There is no residual, and the noise isn't taken for one.
    assert len(result.rests.measured) == 20
    assert result.rests.truth_rms() is None
    assert result.rests.error_share() is None
    assert result.rests.gain() is None
    assert 0.7 < np.sqrt(np.mean((result.rests.measured / result.rests.noise) ** 2)) < 1.3


# --- pushes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "level"), [(0, 8.0), (2, -3.0), (4, 0.5)])
def test_pushes_and_pauses_are_found(axis, level):
    samples = make_samples(pushes_along(axis, [level, 0.5 * level]), np.zeros((288, 6)))
    at_tip = tip_wrench(samples)
    assert np.abs(at_tip - pushes_along(axis, [level, 0.5 * level])).max() < 1e-12
    first, second = find_pushes(samples, at_tip)
    # 30 samples of rest, 99 of which the first few and the last few are below the limits.
    assert 28 < first.rows.start < 36
    assert 121 < first.rows.stop < 131
    assert not np.any(np.abs(at_tip[[first.rows.start, first.rows.stop - 1], axis]) > 0.3)
    assert 54 <= first.peak <= 104
    assert 183 <= second.peak <= 233
    # 0.05 s of each pause's ends are cut off.
    assert first.rest.start == first.rows.stop - 1 + 5
    assert first.rest.stop == second.rows.start + 1 - 5
    assert np.abs(at_tip[first.rest, axis]).max() < 1e-12
    assert second.rest.stop == len(samples) - 5


def test_a_push_that_begins_or_ends_a_segment_is_none():
    load = pushes_along(0, [5.0, 5.0, 5.0])
    # Segments end amid the first push and in the pause before the last.
    segment = np.repeat([0, 1, 2], [80, 190, len(load) - 270])
    samples = make_samples(load, 1e-4 * load, segment=segment)
    pushes = find_pushes(samples, tip_wrench(samples))
    assert [push.peak // 129 for push in pushes] == [1, 2]
    # Nothing of the next segment is in the pause after the push.
    assert pushes[0].rest.stop == 270 - 5


def test_short_dips_belong_to_the_push_and_short_touches_are_none():
    force = np.zeros(100)
    force[20:60] = 5.0
    force[40:43] = 0.0  # 0.03 s
    force[80:83] = 5.0
    samples = make_samples(along(1, force), np.zeros((100, 6)))
    (push,) = find_pushes(samples, tip_wrench(samples))
    assert (push.rows, push.rest) == (slice(19, 61), slice(65, 95))


# --- what is left at no load --------------------------------------------------------------------


def test_what_is_left_with_the_noise_taken_out():
    # Truth 0.1 mm along x, two means off by +-0.02 mm, which is their noise. Predicted: 90 %.
    truth, off = 1e-4, 2e-5
    noise = np.zeros((2, 6))
    noise[:, 0] = off
    rests = RestScore(
        along(0, [truth + off, truth - off]), along(0, [0.9 * truth, 0.9 * truth]), noise
    )
    assert rests.truth_rms() == pytest.approx(truth)
    assert rests.error_share(slice(0, 3)) == pytest.approx(0.1)
    gain, uncertain = rests.gain()
    assert gain == pytest.approx(0.9)
    # (0.9 t - 1.8 m) e / 2 t^2 with m = 1.2 t and 0.8 t, e = 0.2 t.
    assert uncertain == pytest.approx(0.1 * np.hypot(0.9 - 1.8 * 1.2, 0.9 - 1.8 * 0.8))
    assert rests.truth_rms(slice(3, 6)) is None


def test_the_pauses_are_those_after_the_pushes():
    load = pushes_along(0, [8.0, -8.0])
    measured, predicted = 1e-5 * load, 1e-5 * load
    # Left after the first push from its end on: 50 um, of which the model knows 30; then back.
    measured[125:159, 0] += 50e-6
    predicted[125:159, 0] += 30e-6
    measured[:25, 0] += 1.0  # before the first push, nothing is looked at
    result = score(make_samples(load, measured), predict(predicted)).rests
    assert result.measured[:, 0] == pytest.approx([50e-6, 0.0], abs=1e-12)
    assert result.predicted[:, 0] == pytest.approx([30e-6, 0.0], abs=1e-12)
    # Means of the pause's samples: what the noise of one sample is, over their root.
    assert 3e-5 / np.sqrt(35.0) < result.noise[0, 0] < 3e-5 / np.sqrt(15.0)


# --- for programs and people --------------------------------------------------------------------


def test_the_dictionary_is_strict_json_in_millimetres():
    samples, predicted = hysteretic()
    full = score(samples, predicted)
    told = json.loads(json.dumps(full.to_json(), allow_nan=False))
    assert told["samples"] == len(samples)
    assert told["rmse_mm"] == pytest.approx((1e3 * full.rmse[:3]).tolist())
    assert told["noise_mrad"] == pytest.approx([0.1, 0.1, 0.1])
    assert told["rmse_over_noise"]["y"] == pytest.approx(full.ratio[1])
    assert told["rests"]["pauses"] == 8
    assert told["rests"]["translation"]["predicted_over_measured"] == pytest.approx(0.5, abs=0.05)
    # Nothing to say is null, not NaN.
    assert told["rests"]["rotation"]["predicted_over_measured"] is None
    bare = score(samples.rows(slice(0, 20)), predicted.rows(slice(0, 20)))
    told = json.loads(json.dumps(bare.to_json(), allow_nan=False))
    assert told["rests"] is None


def test_the_table_holds_the_numbers_also_in_a_narrow_terminal():
    result = score(*hysteretic())
    names = ["joint_stiffness", "joint_hysteresis"]
    table = score_table(dict.fromkeys(names, result), "some", {"a fit, CPU": {names[0]: "12.3"}})
    for width in (200, 120):
        text = StringIO()
        Console(file=text, width=width).print(table)
        for words in (*names, f"{result.ratio_of():.2f}:", "12.3"):
            assert words in text.getvalue()
    assert f"{100 * result.rests.gain(slice(0, 3))[0]:.0f} +-" in text.getvalue()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p._replace(mean=p.mean[:-1]), r"predicted deflections have the shape \(1061, 6"),
        (lambda p: p._replace(mean=p.mean * np.where(np.arange(1062) == 7, np.nan, 1)[:, None]),
         "sample 7 is not finite"),
        (lambda p: p._replace(covariance=p.covariance[:, :3]), "covariances.*3"),
        (lambda p: p._replace(covariance=-p.covariance * 100.0), "isn't positive"),
        (lambda p: p._replace(extrapolated=p.extrapolated[:5]), r"extrapolated.*\(5,\)"),
    ],
)  # fmt: skip
def test_bad_predictions_are_rejected(change, words):
    samples, predicted = hysteretic()
    with pytest.raises(DeflectionError, match=words):
        score(samples, change(predicted))


def test_no_samples_and_no_noise_are_rejected():
    samples, predicted = hysteretic()
    with pytest.raises(DeflectionError, match="no samples"):
        score(samples.rows(slice(0, 0)), predicted)
    silent = make_samples(samples.wrench, samples.deflection, noise=[0.0] * 6)
    with pytest.raises(DeflectionError, match="noise"):
        score(silent, predicted)
