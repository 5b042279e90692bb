import numpy as np
import pytest
from galen_panel.history import NS_PER_S, StreamSeries
from galen_panel.page.live.decimation import (
    BUCKETS,
    Follower,
    bucket_ns,
    decimate,
    with_gaps,
    zoomed,
)

MS = NS_PER_S // 1000


def swing(count, period_ms=2, start_ms=1_000_000):
    rng = np.random.default_rng(3)
    stamps = (start_ms + period_ms * np.arange(count)) * MS
    values = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    return stamps, values


def test_no_peak_is_lost():
    stamps, values = swing(30_000)
    values[12_345, 1], values[777, 0] = 1e6, -1e6
    rows = decimate(stamps, values, 200 * MS)
    assert len(rows) == 600
    for number in np.unique(stamps // (200 * MS)):
        inside, drawn = stamps // (200 * MS) == number, rows.stamps_ns // (200 * MS) == number
        assert rows.values[drawn].min(axis=0).tolist() == values[inside].min(axis=0).tolist()
        assert rows.values[drawn].max(axis=0).tolist() == values[inside].max(axis=0).tolist()


def test_a_slow_curve_has_no_teeth():
    stamps = np.arange(1000) * MS
    up = decimate(stamps, np.arange(1000.0)[:, None], 100 * MS).values.ravel()
    down = decimate(stamps, -np.arange(1000.0)[:, None], 100 * MS).values.ravel()
    assert (np.diff(up) > 0).all()
    assert (np.diff(down) < 0).all()


def test_full_buckets_stay_as_they_are_when_the_window_moves():
    stamps, values = swing(5000)
    early = decimate(stamps[:4000], values[:4000], 40 * MS)
    late = decimate(stamps[500:], values[500:], 40 * MS)
    begin, end = stamps[520], stamps[3960] // (40 * MS) * (40 * MS)
    for rows, other in ((early, late), (late, early)):
        kept = (rows.stamps_ns >= begin) & (rows.stamps_ns < end)
        same = (other.stamps_ns >= begin) & (other.stamps_ns < end)
        assert rows.stamps_ns[kept].tolist() == other.stamps_ns[same].tolist()
        assert rows.values[kept].tolist() == other.values[same].tolist()


def test_few_samples_are_drawn_as_they_are():
    stamps, values = swing(20, period_ms=10)
    rows = decimate(stamps, values, 4 * MS)
    assert rows.stamps_ns.tolist() == stamps.tolist()
    assert rows.values.tolist() == values.tolist()


def test_a_gap_ends_the_line_and_a_wide_bucket_is_no_gap():
    stamps = np.r_[np.arange(0, 1000, 2), np.arange(1400, 2000, 2)] * MS
    rows = with_gaps(decimate(stamps, np.ones((len(stamps), 1)), 100 * MS), 100 * MS)
    broken = np.flatnonzero(np.isnan(rows.values[:, 0]))
    assert rows.stamps_ns[broken].tolist() == [1400 * MS]
    assert rows.stamps_ns[broken - 1].tolist() == [998 * MS]
    wide = with_gaps(decimate(stamps, np.ones((len(stamps), 1)), 400 * MS), 400 * MS)
    assert not np.isnan(wide.values).any()


def drawn(stamps, values, width):
    return with_gaps(decimate(stamps, values, width), width)


class Browser:
    """Keeps rows as the page's script does."""

    def __init__(self):
        self.stamps, self.values = [], []

    def take(self, patch):
        keep = 0 if patch.whole else int(np.searchsorted(self.stamps, patch.from_ns))
        self.stamps[keep:] = patch.rows.stamps_ns.tolist()
        self.values[keep:] = patch.rows.values.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_patches_add_up_to_what_all_samples_give(seed):
    rng = np.random.default_rng(seed)
    series = StreamSeries(3)
    follower, browser = Follower(series), Browser()
    follower.look_at(60.0, 200 * MS)
    stamps, values = swing(8000)
    kept = np.ones(8000, dtype=bool)
    kept[3000:3400] = False
    stamps, values = stamps[kept], values[kept]
    done = 0
    while done < len(stamps):
        step = int(rng.integers(0, 250))
        series.append(stamps[done : done + step], values[done : done + step])
        done += step
        browser.take(follower.patch())
    browser.take(follower.patch())
    expected = drawn(stamps, values, 200 * MS)
    assert browser.stamps == expected.stamps_ns.tolist()
    assert np.array_equal(browser.values, expected.values, equal_nan=True)
    assert int(np.isnan(expected.values[:, 0]).sum()) == 1


def test_a_patch_holds_what_is_new():
    series = StreamSeries(3)
    follower = Follower(series)
    follower.look_at(60.0, 200 * MS)
    stamps, values = swing(30_000)
    series.append(stamps[:29_900], values[:29_900])
    assert follower.patch().whole
    series.append(stamps[29_900:], values[29_900:])
    patch = follower.patch()
    assert not patch.whole
    assert 1 <= len(patch.rows) <= 6
    assert not len(follower.patch().rows), "nothing came since"
    follower.forget()
    assert follower.patch().whole


def test_after_a_restart_the_browser_begins_anew():
    series = StreamSeries(3)
    follower, browser = Follower(series), Browser()
    follower.look_at(60.0, 200 * MS)
    stamps, values = swing(1000)
    series.append(stamps, values)
    browser.take(follower.patch())
    series.append(stamps[:100] - 500_000 * MS, values[:100])
    patch = follower.patch()
    assert patch.whole
    browser.take(patch)
    expected = drawn(stamps[:100] - 500_000 * MS, values[:100], 200 * MS)
    assert browser.stamps == expected.stamps_ns.tolist()


def test_a_series_that_begins_later_comes_whole():
    series = StreamSeries(3)
    follower, browser = Follower(series), Browser()
    follower.look_at(10.0, 40 * MS)
    assert follower.patch().newest_ns is None
    stamps, values = swing(300)
    series.append(stamps, values)
    browser.take(follower.patch())
    assert browser.stamps == drawn(stamps, values, 40 * MS).stamps_ns.tolist()


def test_zoomed_shows_single_samples_within_and_the_rest_coarsely():
    stamps, values = swing(60_000)
    start, end = int(stamps[30_000]), int(stamps[30_200])
    rows = zoomed(stamps, values, start, end, 120.0)
    inside = (rows.stamps_ns >= start) & (rows.stamps_ns < end)
    assert rows.stamps_ns[inside].tolist() == stamps[30_000:30_200].tolist()
    assert rows.values[inside].tolist() == values[30_000:30_200].tolist()
    assert (np.diff(rows.stamps_ns) > 0).all()
    assert len(rows) < 200 + 2 * (BUCKETS + 3)
    assert rows.stamps_ns[0] == stamps[0]
    assert rows.stamps_ns[-1] == stamps[-1]


def test_a_window_is_at_most_some_600_rows():
    stamps, values = swing(60_000)
    for span in (10, 30, 60, 120):
        taken = stamps >= stamps[-1] - span * NS_PER_S
        assert len(decimate(stamps[taken], values[taken], bucket_ns(span))) <= 2 * BUCKETS + 2
