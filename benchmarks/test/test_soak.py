"""A soak of some seconds: what it counts is there, and what breaks is seen."""

import io

import numpy as np
import pytest
from rich.console import Console

from benchmarks.soak.__main__ import soak
from benchmarks.soak.report import print_report, save_plot, slope_per_hour


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_short_soak_in_real_time_loses_nothing(tmp_path, monkeypatch):
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, "0")  # set back afterwards
    found = soak("real", 6.0, 1.0, 200.0, tmp_path)
    assert found.whole
    for account in found.accounts.values():
        assert 1100 < account.went_in == account.came_out
    assert set(found.memory_mb) == {"gravcomp", "deflection", "sender"}
    assert all(20.0 < value < 1000.0 for values in found.memory_mb.values() for value in values)
    shown = io.StringIO()
    print_report(found, Console(width=120, file=shown))
    assert "wrench_compensated" in shown.getvalue()
    save_plot(found, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 5000


def test_the_slope_of_memory_leaves_out_the_warm_up():
    time_s = np.arange(5.0, 3600.0, 5.0)
    rng = np.random.default_rng(3)
    memory = 100.0 + 2.0 * time_s / 3600.0 + 0.1 * rng.normal(size=len(time_s))
    memory[:50] -= 40.0  # while it starts
    slope, error = slope_per_hour(time_s.tolist(), memory.tolist())
    assert abs(slope - 2.0) < 4.0 * error < 0.1
