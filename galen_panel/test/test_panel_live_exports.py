import csv
import io
from datetime import datetime

import numpy as np
from galen_panel.history import HEADER, NS_PER_S, StreamSamples, between, file_name
from galen_panel.history import csv as written

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
        for row in rows:
            assert len({bool(row[name]) for name in names}) == 1


def test_many_rows_are_all_written():
    raw = samples(AT + np.arange(4100) * 2_000_000, 1)
    empty = samples([], 2)
    assert written(raw, empty, empty).count(b"\n") == 4101


def test_nothing_gives_the_header_alone():
    empty = samples([], 1)
    assert written(empty, empty, empty).decode() == HEADER + "\n"


def test_between_includes_both_ends():
    stream = samples(np.arange(10), 1)
    assert between(stream, 3, 6).stamps_ns.tolist() == [3, 4, 5, 6]
    assert between(stream, 3, 6).values.tolist() == stream.values[3:7].tolist()


def test_the_name_has_the_date_and_no_colon():
    at = datetime(2026, 11, 22, 9, 3, 12)
    assert file_name("wrench", "csv", at) == "galen_wrench_2026-11-22_09-03-12.csv"
