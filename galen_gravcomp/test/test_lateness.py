# SPDX-License-Identifier: Apache-2.0
"""Late wrenches, told by arrivals and stamps that are made up."""

import numpy as np
import pytest
from galen_common.stream.watches import LateWatch

MS = 1_000_000
START_NS = 1_700_000_000_000 * MS


class Line:
    """Wrenches every 2 ms, by a driver's clock that is `offset_s` from ours, on a line of 1 ms."""

    def __init__(self, late_s=0.05, offset_s=0.0):
        self.watch = LateWatch(late_s)
        self.arrival_s = 5000.0
        self.offset_s = offset_s
        self.stamp_ns = START_NS

    def send(self, count, extra_s=0.0, rate=1.0):
        """`rate`: how many seconds of the driver's clock one of ours is."""
        for _ in range(count):
            self.stamp_ns += 2 * MS
            self.arrival_s += 0.002 / rate
            at_s = self.arrival_s + 0.001 + extra_s + self.offset_s
            self.watch.push(at_s, self.stamp_ns)
            self.watch.tick(at_s)

    def stall(self, time_s):
        """Nothing comes for so long; then all of it at once."""
        end_s = self.arrival_s + time_s
        for _ in range(round(time_s / 0.002)):
            self.stamp_ns += 2 * MS
            self.arrival_s += 0.002
            self.watch.push(end_s + 0.001 + self.offset_s, self.stamp_ns)
        self.watch.tick(end_s)


@pytest.mark.parametrize("offset_s", [0.0, -3600.0, 1e5])
def test_what_queued_up_is_late_whatever_the_clocks_offset(offset_s):
    line = Line(offset_s=offset_s)
    line.send(3000)
    line.stall(0.04)
    assert line.watch.count == 0
    line.stall(2.0)
    # Waited 1.998, 1.996 ... s: those that waited for more than 50 ms.
    assert line.watch.count in (974, 975)
    assert line.watch.worst_s == pytest.approx(1.998, abs=1e-5)
    line.send(10_000)
    assert line.watch.count in (974, 975)


def test_a_line_that_got_longer_is_late_for_ten_seconds_at_most_and_then_the_normal_one():
    line = Line()
    line.send(5000)
    line.send(20_000, extra_s=0.2)
    late_s = line.watch.count * 0.002
    assert 5.0 <= late_s <= 10.01
    line.send(5000)
    assert line.watch.count * 0.002 == late_s
    line.send(5000, extra_s=0.2)
    assert line.watch.count * 0.002 > late_s


def test_the_worst_is_the_difference_itself():
    """Against the definition, for delays of any kind within the first five seconds."""
    rng = np.random.default_rng(3)
    stamps = START_NS + np.arange(2000) * 2 * MS
    took_s = 0.001 + rng.exponential(0.02, 2000)
    watch, limit_s = LateWatch(0.05), 0.05
    for stamp, took in zip(stamps.tolist(), took_s, strict=True):
        watch.push(stamp * 1e-9 + took, stamp)
    over_s = took_s - np.minimum.accumulate(took_s)
    assert watch.count == np.count_nonzero(over_s > limit_s) > 50
    assert watch.worst_s == pytest.approx(over_s.max(), abs=1e-6)
