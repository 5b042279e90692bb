# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from galen_bags.arrays.timeline import StampCheck

START = 1_700_000_000_000_000_000
PERIOD = 2_000_000


def clean(count=5000):
    stamps = START + PERIOD * np.arange(count, dtype=np.int64)
    return stamps, stamps + 300_000


def report(stamps, logs, block=700):
    check = StampCheck()
    for at in range(0, len(stamps), block):
        check.add(stamps[at : at + block], logs[at : at + block])
    return check.report()


def faults(found):
    return found.gaps + found.jumps + found.duplicates + found.out_of_order + found.unstamped


def test_a_clean_topic_is_sound():
    found = report(*clean())
    assert not faults(found)
    assert (found.count, found.events) == (5000, ())
    assert found.rate_hz == pytest.approx(500.0, abs=1e-9)
    assert found.period_s == 0.002
    assert found.delay_s == pytest.approx((0.0003,) * 3, abs=1e-9)


@pytest.mark.parametrize("block", [7, 699, 700, 5000])
def test_a_gap_is_counted_with_what_is_missing_whatever_the_blocks(block):
    stamps, logs = clean()
    kept = np.ones(5000, dtype=bool)
    kept[700:723] = False  # 23 samples, at a border of blocks
    found = report(stamps[kept], logs[kept], block)
    assert (found.gaps, found.missing, found.jumps) == (1, 23, 0)
    assert found.longest_step_s == pytest.approx(0.048)
    assert found.events[0] == ("gap", pytest.approx(699 * 0.002), pytest.approx(0.048))
    assert found.rate_hz == pytest.approx(500.0)


@pytest.mark.parametrize("jump_s", [-3.0, -0.5, 0.5, 7200.0])
def test_where_the_stamp_leaves_the_log_time_it_is_a_jump(jump_s):
    stamps, logs = clean()
    stamps[2000:] += round(jump_s * 1e9)
    found = report(stamps, logs)
    assert (found.jumps, found.gaps, found.out_of_order, found.missing) == (1, 0, 0, 0)
    assert found.events[0][2] == pytest.approx(jump_s + 0.002)
    # the jump is no time gone by
    assert found.rate_hz == pytest.approx(500.0)


def test_duplicates_and_samples_out_of_order():
    stamps, logs = clean()
    stamps[100] = stamps[99]
    stamps[[300, 301]] = stamps[[301, 300]]
    found = report(stamps, logs)
    assert (found.duplicates, found.out_of_order, found.jumps) == (1, 1, 0)
    assert {kind for kind, _, _ in found.events} >= {"duplicate", "out_of_order"}


@pytest.mark.parametrize("block", [7, 700, 5000])
def test_what_only_comes_late_is_no_gap_and_not_missing(block):
    stamps, logs = clean()
    order = np.arange(5000)
    for at in (300, 701, 2500):  # one sample comes five places later
        order[at : at + 6] = np.roll(order[at : at + 6], -1)
    found = report(stamps[order], logs, block)
    assert (found.out_of_order, found.gaps, found.missing, found.jumps) == (3, 0, 0, 0)
    assert {kind for kind, _, _ in found.events} == {"out_of_order"}
    assert found.rate_hz == pytest.approx(500.0, rel=1e-3)


def test_unstamped_messages_are_counted_and_spoil_nothing_else():
    stamps, logs = clean()
    stamps[50:60] = 0
    found = report(stamps, logs)
    assert (found.unstamped, found.jumps) == (10, 0)
    assert found.gaps == 1


def test_jitter_is_no_gap():
    rng = np.random.default_rng(1)
    stamps, _ = clean()
    stamps = stamps + rng.integers(-900_000, 900_000, len(stamps))
    found = report(stamps, stamps + rng.integers(0, 50_000_000, len(stamps)))
    assert not faults(found)


def test_a_log_that_stood_still_makes_no_jump_of_regular_stamps():
    """A recorder that waited for its disk: late once, then many at once."""
    stamps, logs = clean()
    logs[2000:2200] = logs[2200]
    found = report(stamps, logs)
    assert not faults(found)
    assert found.delay_s[2] == pytest.approx(0.4003, abs=1e-9)
