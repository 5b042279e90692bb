"""Pacing: how many steps are due on a given clock."""

import pytest
from galen_sim_driver.node import Pacer, SpeedMeter


def test_steps_follow_the_clock():
    pacer = Pacer(0.002, 1.0, 40)
    pacer.start(100.0)
    assert pacer.due(100.0) == 0
    assert pacer.due(100.0051) == 2
    assert pacer.due(100.0061) == 1
    assert pacer.due(100.0) == 0
    taken = 3 + sum(pacer.due(100.0 + 0.0017 * tick) for tick in range(1, 1001))
    assert taken == pytest.approx(1.7 / 0.002, abs=1)


def test_a_speed_factor_multiplies():
    pacer = Pacer(0.002, 5.0, 40)
    pacer.start(0.0)
    assert sum(pacer.due(0.002 * tick) for tick in range(1, 1001)) == pytest.approx(5000, abs=1)


def test_real_time_makes_every_missing_step_up_in_bounded_batches():
    pacer = Pacer(0.002, 1.0, 40)
    pacer.start(0.0)
    batches = [pacer.due(1.0 + 0.002 * tick) for tick in range(100)]
    assert max(batches) == 40
    assert sum(batches) == pytest.approx(1.198 / 0.002, abs=1)
    assert batches[-1] == 1


def test_another_speed_runs_slower_after_a_stall_instead_of_bursts():
    pacer = Pacer(0.002, 10.0, 40)
    pacer.start(0.0)
    assert pacer.due(0.004) == 20
    # 0.4 s late: 2000 steps are missing, one batch of them is taken.
    assert pacer.due(0.4) == 40
    assert pacer.due(0.4021) == 10
    assert pacer.due(0.4041) == 10


def test_the_speed_is_averaged_over_a_window():
    meter = SpeedMeter(0.5)
    meter.update(0.0, 0)
    meter.update(0.3, 9_000_000_000)
    assert meter.speed is None
    meter.update(0.6, 3_000_000_000)
    assert meter.speed == pytest.approx(5.0)
    meter.update(0.7, 3_000_000_000)
    assert meter.speed == pytest.approx(5.0)
