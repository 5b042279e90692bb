# SPDX-License-Identifier: Apache-2.0
"""A soak of some seconds: what it counts is there, and what breaks is seen."""

import io
from itertools import count
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from galen_validation import soak as soak_module
from galen_validation.soak import Account, StampLedger, print_report, slope_per_hour, soak


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_short_soak_in_real_time_loses_nothing(tmp_path, monkeypatch):
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, "0")  # set back afterwards
    found = soak("real", 6.0, 1.0, 200.0, tmp_path)
    assert found.whole
    for account in found.accounts.values():
        assert 200 < account.went_in == account.came_out
    assert set(found.memory_mb) == {"gravcomp", "deflection", "sender"}
    assert all(20.0 < value < 1000.0 for values in found.memory_mb.values() for value in values)
    shown = io.StringIO()
    print_report(found, Console(width=120, file=shown))
    assert "wrench_compensated" in shown.getvalue()


def test_the_slope_of_memory_leaves_out_the_warm_up():
    time_s = np.arange(5.0, 3600.0, 5.0)
    rng = np.random.default_rng(3)
    memory = 100.0 + 2.0 * time_s / 3600.0 + 0.1 * rng.normal(size=len(time_s))
    memory[:50] -= 40.0  # while it starts
    slope, error = slope_per_hour(time_s.tolist(), memory.tolist())
    assert abs(slope - 2.0) < 4.0 * error < 0.1


def test_a_node_that_stalls_still_gets_its_report(monkeypatch):
    clock = SimpleNamespace(monotonic=count(0.0, 0.01).__next__)
    monkeypatch.setattr(soak_module, "time", clock)
    ledger = StampLedger()
    ledger.come_out(MS)
    for second in range(40):
        ledger.go_in(MS + second * 1000 * MS)
    listener = SimpleNamespace(
        compensated=1, deflections=1, states={}, delays_ns=[1], stamp_ns=MS, ledgers={"out": ledger}
    )
    nothing = Mock()
    found = soak_module._watch("real", 12.0, listener, nothing, nothing, {})
    assert found.accounts["out"].lost == 9
    assert found.delay_p50_ms == [5000.0, 5000.0]


# --- the ledger of stamps ---------------------------------------------------------------------

MS = 1_000_000


def told(inputs, outputs, every=50):
    ledger = StampLedger(allowed_ns=20 * MS)
    outputs = list(outputs)
    for number, stamp in enumerate(inputs, start=1):
        ledger.go_in(stamp)
        while outputs and outputs[0] <= stamp - 5 * MS:  # heard five samples later
            ledger.come_out(outputs.pop(0))
        if number % every == 0:
            ledger.settle()
    for stamp in outputs:
        ledger.come_out(stamp)
    ledger.settle(last=True)
    return ledger.account


STAMPS = [k * MS for k in range(1, 1001)]


def test_a_whole_stream_is_whole_whatever_is_heard_first():
    assert told(STAMPS, STAMPS) == Account(went_in=1000, came_out=1000)
    assert told(STAMPS, STAMPS[100:]).lost == 0, "before the first that came out nothing counts"


def test_what_lacks_is_lost():
    rng = np.random.default_rng(1)
    gone = set(rng.choice(np.arange(1, 999), 37, replace=False).tolist())
    account = told(STAMPS, [s for k, s in enumerate(STAMPS) if k not in gone])
    assert account == Account(went_in=1000, came_out=963, lost=37)
    # Of an output that ended what is not old enough may still come.
    longer = [k * MS for k in range(1, 3001)]
    assert told(longer, STAMPS[:600]) == Account(went_in=1800, came_out=600, lost=1200)


def test_doubled_and_made_up_stamps_are_counted():
    outputs = sorted([*STAMPS, STAMPS[500], STAMPS[700]])
    assert told(STAMPS, outputs) == Account(went_in=1000, came_out=1002, doubled=2)
    outputs = sorted([*STAMPS, STAMPS[500] + 7])
    assert told(STAMPS, outputs).unknown == 1


@pytest.mark.parametrize("swapped", [1, 3])
def test_disorder_is_counted(swapped):
    outputs = list(STAMPS)
    for k in range(100, 100 + 10 * swapped, 10):
        outputs[k], outputs[k + 1] = outputs[k + 1], outputs[k]
    account = told(STAMPS, outputs)
    assert account.disordered == swapped and account.lost == account.unknown == 0


def test_it_forgets_what_it_has_looked_at():
    ledger = StampLedger(allowed_ns=20 * MS)
    for stamp in STAMPS:
        ledger.go_in(stamp)
        ledger.come_out(stamp)
        ledger.settle()
    assert len(ledger._inputs) <= 21 and len(ledger._outputs) <= 21
