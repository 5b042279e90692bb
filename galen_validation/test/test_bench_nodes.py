# SPDX-License-Identifier: Apache-2.0
"""What the benchmark of nodes counts and divides; the nodes themselves are left out."""

import io

import numpy as np
import pytest
from rich.console import Console

from galen_validation.speed.nodes import Measurement, lost_between, ratios, spread, table

TEN_US = 10_000


def stamps(numbers, first_ns=1_700_000_000_000_000_000):
    """As the sender makes them: the time in steps of 10 us, and in the last digits the number."""
    return np.array([first_ns + 200 * TEN_US * k + k % TEN_US for k in numbers])


@pytest.mark.parametrize("start", [0, 7, 9_990])
def test_every_wrench_that_lacks_is_counted(start):
    numbers = np.arange(start, start + 25_000)
    assert lost_between(stamps(numbers)) == 0
    rng = np.random.default_rng(start)
    gone = rng.choice(np.arange(1, len(numbers) - 1), 321, replace=False)
    assert lost_between(stamps(np.delete(numbers, gone))) == 321


def measured(subject, number, cpu, p99):
    return Measurement(subject, 500.0, number, 4000, number, cpu, 20.0, 0.5, p99, 5.0, 9.0)


def test_ratios_are_of_one_round():
    found = [
        measured("relay", 0, 100.0, 1.0), measured("node", 0, 150.0, 1.0),
        measured("node", 1, 600.0, 6.0), measured("relay", 1, 300.0, 2.0),
    ]  # fmt: skip
    assert ratios(found, "node", 500.0, "cpu_us_per_wrench") == [1.5, 2.0]
    assert ratios(found, "node", 500.0, "latency_p99_ms") == [1.0, 3.0]
    assert ratios(found, "node", 1000.0, "latency_p99_ms") == []
    shown = io.StringIO()
    Console(width=150, file=shown).print(table(found))
    assert "1.50/1.75/2.00" in shown.getvalue() and "1 of 8001" in shown.getvalue()


def test_a_spread_is_least_median_and_largest():
    assert spread([3.0, 1.0, 2.0], 1) == "1.0/2.0/3.0"
    assert spread([3.0], 1) == "3.0" and spread([], 1) == ""
