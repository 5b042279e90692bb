import numpy as np
import pytest
from galen_gravcomp.channel_check import ChannelCheck, describe_run
from galen_model.arm import SENSOR

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


@pytest.mark.parametrize("seed", range(5))
def test_a_sound_sensor_is_sound(seed):
    assert check(readings(seed=seed)).sound


def test_a_sensor_without_noise_that_stands_still_is_sound():
    """A simulation without noise, or a sensor of coarse quanta: all channels stand in a pose."""
    assert check(readings(noise=0.0)).stuck == ()
    assert check(np.ones((5000, 6))).stuck == ()


@pytest.mark.parametrize("block", [1, 50, 997, 20_000])
def test_a_channel_that_sticks_for_a_while_is_found(block):
    values = readings(4000 if block == 1 else 10_000)
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
    values[10:13, 0] = 130.0
    values[20, 5] = np.nan
    values[21, 5] = np.inf
    found = check(values)
    assert found.beyond_range.tolist() == [3, 0, 0, 0, 0, 0]
    assert found.not_finite.tolist() == [0, 0, 0, 0, 0, 2]
    assert not found.sound
    assert found.largest[0] == 130.0


def test_a_frozen_reading_is_found_on_all_channels():
    """A driver that repeats its last reading under new stamps."""
    values = readings()
    values[5000:5100] = values[5000]
    found = check(values)
    assert {run.axis for run in (*found.stuck, *found.saturated)} == set(range(6))


def test_many_short_sticks_stay_bounded_in_memory():
    values = readings(60_000)
    for start in range(0, 60_000, 12):
        values[start : start + 11, 3] = values[start, 3]
    found = ChannelCheck(RANGE)
    stamps = START + 2_000_000 * np.arange(len(values), dtype=np.int64)
    found.add(stamps, values)
    assert len(found._runs[3]) <= 4000
