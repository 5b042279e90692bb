# SPDX-License-Identifier: Apache-2.0
"""What a fit leaves: functions and oscillations that are no effect are seen, and noise is not."""

from dataclasses import replace

import numpy as np
import pytest
from galen_diagnosis.effects.forms import healthy_background
from galen_diagnosis.inference.diagnosing import diagnose_recording
from galen_diagnosis.inference.refine import nothing
from galen_diagnosis.inference.structure import (
    coefficients,
    oscillation,
    own_past,
    remaining_energy,
    structures,
)
from galen_diagnosis.observation.noise import ChannelNoise
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import CHANNELS, Stream
from scipy.signal import lfilter


def changed(recording, by):
    """The recording with by(bag) (n, 6) added to the sweep's wrenches."""
    sweep = recording.bags["sweep"]
    more = replace(sweep, wrenches=sweep.wrenches + by(sweep))
    return replace(recording, bags={**recording.bags, "sweep": more})


def left_of(recording):
    observation = Observation(recording)
    behind = healthy_background(observation)
    none = nothing(observation, behind)
    seen = structures(observation, behind, none.raw_rows)
    return observation, none, seen, oscillation(observation.streams_with((), none.unknowns))


def roll_at_wrenches(bag):
    return np.interp(bag.wrench_s, bag.joint_s, bag.joints[:, 3])


def test_a_healthy_arm_leaves_nothing(healthy_sweep):
    _, none, seen, fast = left_of(healthy_sweep)
    assert seen[0].log_bayes < 3.0
    assert fast.log_bayes < 3.0
    assert len(seen) == 7
    assert not any(np.isnan(one.log_bayes) for one in seen)
    assert len(none.rows) > 3000


def test_a_function_of_a_joint_is_seen_where_means_over_cells_see_none(healthy_sweep):
    def ripple(bag):
        out = np.zeros((len(bag.wrench_s), 6))
        out[:, 0] = 0.004 * np.sin(3.0 * roll_at_wrenches(bag) + 0.5)  # a fifth of the noise
        return out

    observation, none, seen, fast = left_of(changed(healthy_sweep, ripple))
    assert seen[0].name == "wrench by roll and tilt"
    assert seen[0].log_bayes > 10.0
    assert seen[0].energy > 20.0
    assert remaining_energy(observation.rows, none.rows)[0] == 0.0
    assert fast.log_bayes < 3.0


def test_a_sensor_that_creeps_lags_its_own_past_and_a_gain_does_not(healthy_sweep):
    def past(recording):
        observation = Observation(recording)
        behind = healthy_background(observation)
        return own_past(observation, behind, nothing(observation, behind).raw_rows).log_bayes

    def creep(bag):
        share = 1.0 - np.exp(-np.median(np.diff(bag.wrench_s)) / 5.0)
        path = lfilter([share], [1.0, share - 1.0], bag.wrenches - bag.wrenches[0], axis=0)
        return 0.02 * (path + bag.wrenches[0] - bag.wrenches)

    assert past(healthy_sweep) < 3.0
    assert past(changed(healthy_sweep, creep)) > 30.0
    assert past(changed(healthy_sweep, lambda bag: 0.02 * bag.wrenches)) < 0.3 * past(
        changed(healthy_sweep, creep)
    )


def test_a_gain_that_changes_with_time_is_seen_and_a_constant_one_is_the_readings(healthy_sweep):
    def warm(bag):
        return 0.01 * np.sin(3.0 * bag.wrench_s / np.ptp(bag.wrench_s))[:, None] * bag.wrenches

    _, _, seen, _ = left_of(changed(healthy_sweep, warm))
    assert seen[0].name == "the wrench's gains by time"
    assert seen[0].log_bayes > 20.0
    _, _, seen, _ = left_of(changed(healthy_sweep, lambda bag: 0.01 * bag.wrenches))
    assert seen[0].name != "the wrench's gains by time"


def moves(bag):
    return np.abs(np.gradient(roll_at_wrenches(bag), bag.wrench_s)) > 0.1


def hum(bag):
    out = np.zeros((len(bag.wrench_s), 6))
    out[:, 2] = 0.03 * np.sin(2.0 * np.pi * 17.3 * bag.wrench_s)  # as large as the noise
    return out * moves(bag)[:, None]


def test_an_oscillation_that_no_listed_effect_shares_is_unknown(healthy_sweep):
    answer = diagnose_recording(changed(healthy_sweep, hum)).answer
    assert answer.verdict == "unknown"
    assert "Hz" in answer.remaining[0]["what"]


def test_an_oscillation_is_seen_at_its_frequency_though_its_mean_is_nothing(healthy_sweep):
    observation, none, seen, fast = left_of(changed(healthy_sweep, hum))
    assert fast.name.startswith("wrench in sweep at ")
    from_hz, to_hz = (float(word) for word in fast.name.split()[4:7:2])
    assert from_hz <= 17.3 <= to_hz
    assert fast.log_bayes > 20.0
    # A sine of the noise's size has half its variance; not all of it lies in the band.
    expected = 0.5 * np.sum(moves(healthy_sweep.bags["sweep"]))
    assert 0.5 * expected < fast.energy < 1.2 * expected
    assert seen[0].log_bayes < 3.0
    assert remaining_energy(observation.rows, none.rows)[0] == 0.0


NOISE = np.array([0.02, 0.02, 0.03, 4e-4, 4e-4, 4e-4])


def test_holes_cut_a_stream():
    at_s = np.concatenate([np.arange(100), np.arange(150, 250), [900]]) * 0.01
    residual = np.ones((len(at_s), 6)) * NOISE
    residual[50] = np.nan
    frequency, square = coefficients(Stream("motion", CHANNELS[:6], at_s, residual, NOISE))
    # Pieces of 50, 49 and 100 samples; the last sample is alone. Parseval: none is lost else.
    assert len(frequency) == 199 and np.sum(frequency == 0.0) == 3
    assert square.sum() == pytest.approx(199 * 6)


def test_coloured_noise_that_is_known_is_no_oscillation():
    rng = np.random.default_rng(4)
    model = ChannelNoise(np.array([0.6]), 0.016)
    residual = np.zeros((6000, 6))
    for row in range(1, len(residual)):
        residual[row] = 0.6 * residual[row - 1] + 0.016 * rng.standard_normal(6)
    at_s = np.arange(6000) / 100.0
    white = Stream("motion", CHANNELS[:6], at_s, residual, np.full(6, model.std))
    assert oscillation([white]).log_bayes > 5.0
    coloured = oscillation([replace(white, models=(model,) * 6)])
    assert coloured is None or coloured.log_bayes < 3.0
