# SPDX-License-Identifier: Apache-2.0
import csv
import io

import numpy as np
import pytest
from galen_panel.state import history
from galen_panel.state.history import NS_PER_S, StreamSamples, StreamSeries, plot_rows


class Reference:
    """The rules of `Series`, row by row."""

    def __init__(self, rows, seconds):
        self.rows, self.span, self.kept = rows, int(seconds * NS_PER_S), []

    def append(self, stamps, values):
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True):
            if self.kept and stamp < self.kept[-1][0] - int(history.RESTART_S * NS_PER_S):
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
    rows = list(csv.DictReader(io.StringIO(history.csv(raw, compensated, deflection).decode())))
    assert len(rows) == 6
    stamps = [row["stamp_s"] for row in rows]
    assert stamps[0] == "1790000000.123456789"
    assert stamps == sorted(stamps)
    columns = history.HEADER.split(",")
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
    return stamps, np.cumsum(rng.normal(size=(count, 3)), axis=0)


def test_no_peak_is_lost_in_some_600_rows():
    stamps, values = swing(30_000)
    values[12_345, 1], values[777, 0] = 1e6, -1e6
    drawn, rows = plot_rows(stamps, values, 200 * MS)
    assert len(drawn) == 600
    for number in np.unique(stamps // (200 * MS)):
        inside, shown = stamps // (200 * MS) == number, drawn // (200 * MS) == number
        assert rows[shown].min(axis=0).tolist() == values[inside].min(axis=0).tolist()
        assert rows[shown].max(axis=0).tolist() == values[inside].max(axis=0).tolist()
    for span in (10, 30, 60):
        taken = stamps >= stamps[-1] - span * NS_PER_S
        drawn, _ = plot_rows(stamps[taken], values[taken], history.bucket_ns(span))
        assert len(drawn) <= 2 * history.BUCKETS + 2


def test_a_slow_curve_has_no_teeth_and_few_samples_are_drawn_as_they_are():
    stamps = np.arange(1000) * MS
    _, up = plot_rows(stamps, np.arange(1000.0)[:, None], 100 * MS)
    _, down = plot_rows(stamps, -np.arange(1000.0)[:, None], 100 * MS)
    assert (np.diff(up.ravel()) > 0).all() and (np.diff(down.ravel()) < 0).all()
    stamps, values = swing(20, period_ms=10)
    drawn, rows = plot_rows(stamps, values, 4 * MS)
    assert drawn.tolist() == stamps.tolist() and rows.tolist() == values.tolist()


def test_full_buckets_stay_as_they_are_when_the_window_moves():
    stamps, values = swing(5000)
    early = plot_rows(stamps[:4000], values[:4000], 40 * MS)
    late = plot_rows(stamps[500:], values[500:], 40 * MS)
    begin, end = stamps[520], stamps[3960] // (40 * MS) * (40 * MS)
    (one, one_rows), (two, two_rows) = (
        (drawn[kept], rows[kept])
        for drawn, rows in (early, late)
        for kept in [(drawn >= begin) & (drawn < end)]
    )
    assert one.tolist() == two.tolist() and one_rows.tolist() == two_rows.tolist()


def test_a_gap_ends_the_line_and_a_wide_bucket_is_no_gap():
    stamps = np.r_[np.arange(0, 1000, 2), np.arange(1400, 2000, 2)] * MS
    drawn, rows = plot_rows(stamps, np.ones((len(stamps), 1)), 100 * MS)
    broken = np.flatnonzero(np.isnan(rows[:, 0]))
    assert drawn[broken].tolist() == [1400 * MS] and drawn[broken - 1].tolist() == [998 * MS]
    _, wide = plot_rows(stamps, np.ones((len(stamps), 1)), 400 * MS)
    assert not np.isnan(wide).any()
