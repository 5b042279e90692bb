import numpy as np
import pytest
from galen_panel.history import NS_PER_S, RESTART_S, History, StreamSeries


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


@pytest.mark.parametrize("seed", range(40))
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


def test_a_restart_in_the_midst_of_a_block_leaves_only_what_is_after_it():
    series = StreamSeries(1)
    series.append(np.array([5, 6]) * NS_PER_S, np.array([[5.0], [6.0]]))
    run = series.last().run
    series.append(np.array([7, 8, 1, 2]) * NS_PER_S, np.array([[7.0], [8.0], [1.0], [2.0]]))
    samples = series.last()
    assert samples.values.ravel().tolist() == [1.0, 2.0]
    assert samples.run == run + 1


def test_a_block_longer_than_the_ring_leaves_its_end():
    series = StreamSeries(1, rows=4)
    series.append(np.arange(3), np.arange(3.0)[:, None])
    series.append(np.arange(3, 20), np.arange(3.0, 20.0)[:, None])
    assert series.last().stamps_ns.tolist() == [16, 17, 18, 19]
    assert series.last().values.ravel().tolist() == [16, 17, 18, 19]
    series.append(np.array([20]), np.array([[20.0]]))
    assert series.last().stamps_ns.tolist() == [17, 18, 19, 20]


def test_what_was_read_does_not_change_when_more_is_written():
    series = StreamSeries(1, rows=3)
    series.append(np.arange(3), np.arange(3.0)[:, None])
    read = series.last()
    series.append(np.arange(3, 6), np.arange(3.0, 6.0)[:, None])
    assert read.values.ravel().tolist() == [0, 1, 2]


def test_stamps_and_values_must_be_as_many():
    with pytest.raises(ValueError, match="2 stamps for 3 rows"):
        StreamSeries(1).append(np.arange(2), np.zeros((3, 1)))


def test_clear_forgets_all_series():
    history = History()
    history.joints.append(np.array([1]), np.zeros((1, 5)))
    run = history.joints.last().run
    history.clear()
    assert history.joints.last().newest_ns is None
    assert history.joints.last().run == run + 1
