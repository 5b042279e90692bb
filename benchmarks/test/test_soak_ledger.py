"""The ledger of stamps finds what was lost, doubled, made up or put out of order."""

import numpy as np
import pytest

from benchmarks.soak.ledger import Account, StampLedger

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
