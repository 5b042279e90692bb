# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from galen_gravcomp.evaluate.channel_check import ChannelCheck, describe_run
from galen_model.arm.galen import SENSOR

START = 1_700_000_000_000_000_000
RANGE = np.array([125.0, 125.0, 500.0, 3.0, 3.0, 3.0])


def readings(count=10_000, seed=1, noise=1.0):
    """Noise of the contract's sensor on a slow swing, in its quanta."""
    rng = np.random.default_rng(seed)
    swing = np.sin(np.arange(count)[:, None] / 900.0 + np.arange(6)) * [1, 1, 1, 0.05, 0.05, 0.05]
    value = swing + noise * rng.normal(size=(count, 6)) * SENSOR.noise_std
    return np.round(value / SENSOR.quantum) * SENSOR.quantum


def check(values, block=997):
    stamps = START + 2_000_000 * np.arange(len(values), dtype=np.int64)
    found = ChannelCheck(RANGE)
    for at in range(0, len(values), block):
        found.add(stamps[at : at + block], values[at : at + block])
    return found.report()


def sound(found):
    runs = found.stuck + found.saturated + found.frozen
    return not (runs or found.beyond_range.any() or found.not_finite.any())


@pytest.mark.parametrize("seed", range(5))
def test_a_sound_sensor_is_sound(seed):
    assert sound(check(readings(seed=seed)))


def test_a_sensor_without_noise_that_stands_still_is_sound():
    """A simulation without noise, or a sensor of coarse quanta: all channels stand in a pose."""
    assert check(readings(noise=0.0)).stuck == ()
    assert check(np.ones((5000, 6))).stuck == ()


@pytest.mark.parametrize("block", [7, 50, 997, 20_000])
def test_a_channel_that_sticks_for_a_while_is_found(block):
    values = readings()
    values[2000:2300, 4] = values[2000, 4]
    found = check(values, block)
    (run,) = found.stuck
    assert run.axis == 4
    assert run.count >= 300
    assert run.start_ns - START == pytest.approx(2000 * 2_000_000, abs=4_000_000)
    assert found.saturated == ()
    text = describe_run(run, START, "stuck")
    assert text.startswith("ty stuck at ")
    assert "from 4.00 s on" in text


def test_a_channel_that_is_dead_from_the_start_is_found():
    values = readings()
    values[:, 2] = 0.015
    (run,) = check(values).stuck
    assert (run.axis, run.count, run.value) == (2, len(values), 0.015)


def test_a_channel_that_clips_is_saturated():
    values = readings()
    values[:, 1] = np.clip(values[:, 1], -10.0, 0.8)
    found = check(values)
    assert found.stuck == ()
    assert found.saturated
    assert {run.axis for run in found.saturated} == {1}
    assert {run.value for run in found.saturated} == {0.8}


def test_readings_beyond_the_range_and_not_finite_are_counted_by_axis():
    values = readings()
    values[10:13, 0] = [125.0, -125.0, 130.0]
    values[20, 5] = np.nan
    values[21, 5] = np.inf
    found = check(values)
    assert found.beyond_range.tolist() == [3, 0, 0, 0, 0, 0]
    assert found.not_finite.tolist() == [0, 0, 0, 0, 0, 2]
    assert not sound(found)


def test_a_frozen_reading_is_found_once_and_not_as_six_stuck_channels():
    """A driver that repeats its last reading under new stamps."""
    values = readings()
    values[5000:5100] = values[5000]
    found = check(values)
    (run,) = found.frozen
    assert (run.axis, run.count, run.start_ns) == (None, 100, START + 5000 * 2_000_000)
    assert (found.stuck, found.saturated, found.held) == ((), (), 1)
    assert not sound(found)
    assert describe_run(run, START, "frozen").startswith("all six channels frozen for 0.20 s (100")


@pytest.mark.parametrize(
    ("shortest", "longest", "block"), [(5, 5, 7), (4, 6, 997), (20, 20, 997), (49, 51, 7)]
)
def test_a_slow_sensor_whose_readings_come_several_times_is_called_that(shortest, longest, block):
    times = np.random.default_rng(3).integers(shortest, longest + 1, size=10_000 // longest)
    values = np.repeat(readings(len(times)), times, axis=0)
    found = check(values, block)
    assert found.held == (shortest + longest) // 2
    assert sound(found)
    at = int(np.sum(times[:100]))
    frozen = np.insert(values, [at] * 40 * longest, values[at], axis=0)
    (run,) = check(frozen, block).frozen
    assert 40 * longest <= run.count <= 42 * longest


@pytest.mark.parametrize("quanta", [10, 20, 50, 100])
@pytest.mark.parametrize("swing", [0.0, 1.0])
def test_a_sensor_whose_quantum_is_above_its_noise_is_sound(quanta, swing):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        value = swing * (readings(20_000, noise=0.0) - readings(1, noise=0.0))
        value = value + rng.uniform(-1, 1, 6) * SENSOR.quantum * quanta
        value = value + rng.normal(size=value.shape) * SENSOR.noise_std
        coarse = np.round(value / SENSOR.quantum / quanta) * SENSOR.quantum * quanta
        assert sound(check(coarse))
