# SPDX-License-Identifier: Apache-2.0
"""Splits: which sets are fitted to, which are checked; segments stay whole."""

import deflection_pushes
import numpy as np
import pytest
from galen_deflection.scoring.cross_check import SplitError, position_splits, report_splits


def make_samples(sets, segments_a_set=2, samples_a_segment=3):
    """Samples of (position, set number) pairs in their order."""
    rows = []
    for position, number in sets:
        for _ in range(segments_a_set):
            segment = rows[-1][0] + 1 if rows else 0
            rows += [(segment, position, number)] * samples_a_segment
    segment, position, number = np.array(rows, dtype=int).reshape(-1, 3).T
    nothing = np.zeros((len(rows), 6))
    return deflection_pushes.make_samples(
        nothing, nothing, segment=segment, position=position, set_number=number
    )


# Two recordings of four positions: eight sets, as the report has them.
EIGHT = [(position, number) for number in (0, 1) for position in (0, 1, 2, 3)]


def pairs(samples, rows):
    return sorted(set(zip(samples.position[rows].tolist(), samples.set_number[rows].tolist(),
                          strict=True)))  # fmt: skip


def check_whole(samples, split):
    assert not split.check.all()
    assert split.check.any()
    shared = set(samples.segment[~split.check]) & set(samples.segment[split.check])
    assert not shared


def test_the_reports_split_is_six_sets_to_two():
    samples = make_samples(EIGHT)
    splits = report_splits(samples)
    checked = [pairs(samples, split.check) for split in splits]
    assert checked == [[(0, 1), (1, 1)], [(2, 1), (3, 1)], [(0, 0), (1, 0)], [(2, 0), (3, 0)]]
    for split in splits:
        check_whole(samples, split)
        train = pairs(samples, ~split.check)
        assert len(train) == 6
        # Every position is among those fitted to.
        assert {position for position, _ in train} == {0, 1, 2, 3}
    # Together they check every sample once.
    assert np.array_equal(sum(split.check.astype(int) for split in splits), np.ones(len(samples)))
    assert splits[0].name == "set 1 of position 0, set 1 of position 1"


def test_a_position_left_out_is_left_out_with_all_its_sets():
    samples = make_samples([*EIGHT, (3, 2)])
    splits = position_splits(samples)
    assert [split.name for split in splits] == [f"position {k}" for k in range(4)]
    for position, split in enumerate(splits):
        check_whole(samples, split)
        assert set(samples.position[split.check]) == {position}
        assert position not in samples.position[~split.check]
    assert pairs(samples, splits[3].check) == [(3, 0), (3, 1), (3, 2)]


@pytest.mark.parametrize(
    ("splitter", "sets", "words"),
    [
        (report_splits, [(0, 0), (0, 1)], "only position 0"),
        (report_splits, [(0, 0), (0, 1), (1, 0)], "position 1 has one"),
        (report_splits, [], "no samples"),
        (position_splits, [(3, 0), (3, 1)], "only position 3"),
        (position_splits, [], "no samples"),
    ],
)
def test_too_little_is_rejected(splitter, sets, words):
    with pytest.raises(SplitError, match=words):
        splitter(make_samples(sets))


@pytest.mark.parametrize("splitter", [report_splits, position_splits])
@pytest.mark.parametrize("column", ["position", "set_number"])
def test_a_segment_in_two_sets_is_rejected(splitter, column):
    samples = make_samples(EIGHT)
    getattr(samples, column)[1] += 1  # in segment 0
    with pytest.raises(SplitError, match="segment 0 belongs to set"):
        splitter(samples)
