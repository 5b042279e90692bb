import csv
import io

import numpy as np
import pytest
from galen_panel.history import (
    BUCKETS,
    HEADER,
    NS_PER_S,
    RESTART_S,
    Follower,
    StreamSamples,
    StreamSeries,
    bucket_ns,
    decimate,
    with_gaps,
)
from galen_panel.history import csv as written


class Reference:
    """The rules of `Series`, row by row."""

    def __init__(self, rows, seconds):
        self.rows, self.span, self.kept = rows, int(seconds * NS_PER_S), []

    def append(self, stamps, values):
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True):
            if self.kept and stamp < self.kept[-1][0] - int(RESTART_S * NS_PER_S):
                self.kept = []
            elif self.kept and stamp <= self.kept[-1][0]:
                continue
            self.kept.append((stamp, value))
        self.kept = self.kept[-self.rows :]

    def since(self, stamp):
        return [row for row in self.kept if row[0] >= stamp]

    def last(self, seconds=None):
        span = self.span if seconds is None else int(seconds * NS_PER_S)
        return self.since(self.kept[-1][0] - span) if self.kept else []


def rows_of(samples):
    return list(zip(samples.stamps_ns.tolist(), samples.values.tolist(), strict=True))


@pytest.mark.parametrize("seed", range(10))
def test_it_keeps_what_a_row_by_row_reference_keeps(seed):
    rng = np.random.default_rng(seed)
    series, reference = StreamSeries(2, rows=50, seconds=1.5), Reference(50, 1.5)
    at = 10 * NS_PER_S
    for block in range(30):
        steps = rng.choice(
            [1, 0, -1, 40, -30, -80, 100],
            p=[0.6, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05],
            size=rng.integers(0, 120 if block % 7 == 0 else 20),
        )
        stamps = at + np.cumsum(steps * (NS_PER_S // 50))
        values = rng.normal(size=(len(stamps), 2))
        series.append(stamps, values)
        reference.append(stamps, values)
        at = int(stamps[-1]) if len(stamps) else at
        assert rows_of(series.last()) == reference.last()
        assert rows_of(series.last(0.3)) == reference.last(0.3)
        newest = reference.kept[-1][0] if reference.kept else 0
        for stamp in (newest - NS_PER_S // 4, newest, newest + 1):
            assert rows_of(series.since(stamp)) == reference.since(stamp)


def test_a_frozen_copy_gets_no_more_rows():
    series = StreamSeries(1, rows=3)
    series.append(np.arange(3), np.arange(3.0)[:, None])
    copy = series.frozen()
    series.append(np.arange(3, 6), np.arange(3.0, 6.0)[:, None])
    assert copy.last().values.ravel().tolist() == [0, 1, 2]
    assert StreamSeries(1).frozen().newest_ns is None


# Files

AT = 1_790_000_000 * NS_PER_S + 123_456_789


def samples(stamps, seed):
    values = np.random.default_rng(seed).normal(size=(len(stamps), 6))
    return StreamSamples(np.asarray(stamps, dtype=np.int64), values)


def test_rows_are_joined_by_stamp_and_cells_are_empty_where_nothing_came():
    raw = samples(AT + np.arange(5) * 2_000_000, 1)
    compensated = samples(raw.stamps_ns[1:4], 2)
    deflection = samples([raw.stamps_ns[2], raw.stamps_ns[4] + 7], 3)
    rows = list(csv.DictReader(io.StringIO(written(raw, compensated, deflection).decode())))
    assert len(rows) == 6
    stamps = [row["stamp_s"] for row in rows]
    assert stamps[0] == "1790000000.123456789"
    assert stamps == sorted(stamps)
    columns = HEADER.split(",")
    assert len(columns) == 19
    for index, stream in enumerate((raw, compensated, deflection)):
        names = columns[1 + 6 * index : 7 + 6 * index]
        filled = [row for row in rows if row[names[0]]]
        assert len(filled) == len(stream.stamps_ns)
        for row, values in zip(filled, stream.values, strict=True):
            np.testing.assert_allclose([float(row[name]) for name in names], values, rtol=1e-6)


# What plots draw

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


@pytest.mark.parametrize("seed", range(3))
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


def test_a_window_is_at_most_some_600_rows():
    stamps, values = swing(60_000)
    for span in (10, 30, 60, 120):
        taken = stamps >= stamps[-1] - span * NS_PER_S
        assert len(decimate(stamps[taken], values[taken], bucket_ns(span))) <= 2 * BUCKETS + 2
