# SPDX-License-Identifier: Apache-2.0
"""The timing of a replay, by a clock that the tests turn themselves."""

import pytest
from bags_wait import wait_for
from galen_bags.formats.errors import BagError
from galen_bags.formats.raw_block import pack
from galen_bags.timing import BagClock, Playlist, window

S = 1_000_000_000
MS = 1_000_000


def block(times_ns):
    return pack([0] * len(times_ns), times_ns, [b"%d" % time_ns for time_ns in times_ns])


def times(blocks):
    return [int(time_ns) for each in blocks for time_ns in each.log_time_ns]


@pytest.mark.parametrize("rate", [0.25, 1.0, 8.0])
def test_bag_time_runs_at_the_rate(rate):
    timeline = BagClock(rate)
    timeline.start(5 * S, 100.0)
    assert timeline.advance(100.0) == 5 * S
    for step in range(1, 101):
        bag_ns = timeline.advance(100.0 + 0.05 * step)
        assert bag_ns == pytest.approx(5 * S + rate * 0.05 * step * S, abs=2)
    assert timeline.lag_s == 0.0


def test_a_stall_is_not_caught_up_but_said():
    timeline = BagClock(2.0, max_step_s=0.1)
    timeline.start(0, 10.0)
    assert timeline.advance(10.1) == pytest.approx(200 * MS, abs=2)
    assert timeline.advance(13.1) == pytest.approx(400 * MS, abs=2)  # 0.1 s of the 3 s
    assert timeline.advance(13.2) == pytest.approx(600 * MS, abs=2)
    assert timeline.lag_s == pytest.approx(2.9)


def test_hold_goes_on_from_what_was_not_published():
    timeline = BagClock(2.0)
    timeline.start(0, 0.0)
    assert timeline.advance(0.05) == pytest.approx(100 * MS, abs=2)
    timeline.hold(40 * MS, 0.05)
    assert timeline.lag_s == pytest.approx(0.03)
    assert timeline.advance(0.06) == pytest.approx(60 * MS, abs=2)


@pytest.mark.parametrize(
    ("first_ns", "last_ns", "wanted"),
    [
        (0, None, [1, 2, 3, 4, 5, 6]),
        (2, 5, [2, 3, 4, 5]),
        (3, None, [3, 4, 5, 6]),
        (4, 4, [4]),
        (7, None, []),
        (0, 0, []),
    ],
)
def test_a_window_of_a_bag(first_ns, last_ns, wanted):
    blocks = [block([1, 2]), block([3]), block([]), block([4, 5, 6])]
    kept = list(window(blocks, first_ns, last_ns))
    assert times(iter(kept)) == wanted
    assert [each.message(k) for each in kept for k in range(len(each))] == [
        b"%d" % time_ns for time_ns in wanted
    ]


def played(playlist):
    found = []
    while True:
        wait_for(lambda: playlist.peek_ns() is not None or playlist.ended)
        if playlist.ended:
            return found
        found.append(playlist.pop()[2])


def test_a_playlist_is_all_messages_in_order():
    blocks = [block([k, k + 1]) for k in range(0, 40, 2)] + [block([])]
    playlist = Playlist(lambda: iter(blocks))
    assert played(playlist) == [b"%d" % k for k in range(40)]
    playlist.close()


def test_an_error_of_reading_comes_out():
    def broken():
        yield block([1])
        raise BagError("x.mcap: can't be read")

    playlist = Playlist(broken)
    wait_for(lambda: playlist.peek_ns() == 1)
    playlist.pop()
    with pytest.raises(BagError, match="can't be read"):
        played(playlist)
    playlist.close()
