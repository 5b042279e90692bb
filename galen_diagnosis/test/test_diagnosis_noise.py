# SPDX-License-Identifier: Apache-2.0
"""The noise floor of a channel: variance and colour come back, whatever smooth curve lies under."""

import numpy as np
import pytest
from galen_diagnosis.observation.noise import ChannelNoise, channel_noise


def _process(generator, coefficients, count):
    white = generator.standard_normal(count + 200)
    series = np.zeros_like(white)
    for k in range(len(white)):
        past = sum(c * series[k - 1 - i] for i, c in enumerate(coefficients) if k > i)
        series[k] = white[k] + past
    return series[200:]


@pytest.mark.parametrize("coefficients", [(), (0.5,), (0.3, 0.2), (-0.3,)])
def test_gain_and_variance_come_back_through_short_stretches(coefficients):
    generator = np.random.default_rng(4)
    at_s = np.arange(80) * 0.02
    stretches = [
        (at_s, 0.02 * _process(generator, coefficients, 80)[:, None] + k) for k in range(60)
    ]
    (noise,) = channel_noise(stretches, 1.0)
    # What decides about slow effects is the gain on a constant, (1 - sum a) / s.
    assert noise.gain == pytest.approx((1.0 - sum(coefficients)) / 0.02, rel=0.06)
    truth = ChannelNoise(np.array(coefficients), 0.02)
    assert noise.std == pytest.approx(truth.std, rel=0.04)


def test_whitened_rows_are_white_with_unit_variance():
    generator = np.random.default_rng(5)
    series = 3.0 * _process(generator, (0.6,), 20000)
    white = ChannelNoise(np.array([0.6]), 3.0).whitened(series)[1:]
    assert white.var() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / len(white)))
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 5.0 / np.sqrt(len(white))


def test_of_short_stretches_no_noise_is_told():
    assert channel_noise([(np.arange(14) * 0.01, np.zeros((14, 6)))] * 5, 1.0) == []
    assert channel_noise([], 1.0) == []


def test_a_channel_that_only_alternates_is_no_error():
    turns = np.where(np.arange(100) % 2, 1.0, -1.0)[:, None]
    (noise,) = channel_noise([(np.arange(100) * 0.01, turns)], 1.0)
    assert np.isfinite(noise.gain)


def test_a_frozen_channel_gets_the_floor():
    (noise,) = channel_noise([(np.arange(100) * 0.01, np.full((100, 1), 0.3))], 1.0, 1e-6)
    assert noise.innovation == 1e-6
    assert noise.order == 0
