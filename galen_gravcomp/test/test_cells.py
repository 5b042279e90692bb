# SPDX-License-Identifier: Apache-2.0
"""Cells of 0.1 s, and the rest segments in them."""

import numpy as np
import pytest
from galen_model.rest.binned import CellReducer, Cells, find_still_phases

START = 1_700_000_000_000_000_000


def samples(count=2311, seed=0):
    rng = np.random.default_rng(seed)
    stamps = START + 2_000_000 * np.arange(count, dtype=np.int64)
    return stamps, 5.0 + 0.01 * rng.normal(size=(count, 6)), rng.normal(size=(count, 2))


def reduce(stamps, wrench, angles, borders):
    reducer = CellReducer()
    for rows in np.split(np.arange(len(stamps)), borders):
        reducer.add(stamps[rows], wrench[rows], angles[rows])
    return reducer.finish()


@pytest.mark.parametrize(
    "borders", [[], [0], [1, 1, 50], list(range(1, 2311, 37)), [2310], [49, 50, 51]]
)
def test_cells_are_what_numpy_says_whatever_the_blocks(borders):
    stamps, wrench, angles = samples()
    cells = reduce(stamps, wrench, angles, borders)
    number = stamps // 100_000_000
    assert len(cells) == len(np.unique(number))
    assert cells.count.sum() == len(stamps)
    for k, value in enumerate(np.unique(number)):
        rows = number == value
        assert cells.start_ns[k] == stamps[rows][0]
        assert cells.end_ns[k] == stamps[rows][-1]
        np.testing.assert_allclose(cells.mean[k], wrench[rows].mean(axis=0), rtol=1e-12)
        scatter = np.var(wrench[rows], axis=0) * rows.sum()
        np.testing.assert_allclose(cells.squares[k], scatter, rtol=1e-9)
        np.testing.assert_allclose(cells.angles[k], angles[rows].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(cells.spans[k], np.ptp(angles[rows], axis=0), atol=1e-12)
    np.testing.assert_allclose(cells.sum_of_squares.sum(axis=0), (wrench**2).sum(axis=0))


def test_stamps_that_jump_back_do_not_mix_with_what_was_there_before():
    stamps, wrench, angles = samples(1000)
    stamps[500:] -= 500 * 2_000_000
    wrench[500:] += 1.0
    cells = reduce(stamps, wrench, angles, [])
    assert np.all((np.abs(cells.mean - 5.0) < 0.1) | (np.abs(cells.mean - 6.0) < 0.1))


CELL_NS = 100_000_000


def still_cells(roll, *, scatter=1.0, mean=0.0):
    """A cell each 0.1 s with roll (n,), ten readings of this scatter, spans of zero."""
    count = len(roll)
    start = START + CELL_NS * np.arange(count, dtype=np.int64)
    return Cells(
        start,
        start + 90_000_000,
        np.full(count, 10),
        np.broadcast_to(np.reshape(mean, (-1, 1)), (count, 6)).astype(float),
        np.full((count, 6), 9.0 * scatter**2),
        np.column_stack([roll, np.zeros(count)]),
        np.zeros((count, 2)),
    )


def test_a_phase_is_the_stand_less_its_rims():
    phases = find_still_phases(still_cells(np.zeros(20)))
    assert phases.start_ns.tolist() == [START + 2 * CELL_NS]
    assert phases.end_ns.tolist() == [START + 17 * CELL_NS + 90_000_000]


def test_another_pose_is_another_phase_though_no_cell_moves():
    phases = find_still_phases(still_cells(np.repeat([0.0, 0.01], 15)))
    np.testing.assert_allclose(phases.angles[:, 0], [0.0, 0.01], atol=1e-12)


def test_a_bias_drift_from_cell_to_cell_is_in_the_mean_s_error():
    mean = 0.003 * np.random.default_rng(2).choice([-1.0, 1.0], 10)
    phases = find_still_phases(still_cells(np.zeros(10), scatter=1e-3, mean=mean))
    assert np.all(phases.std_of_mean > 0.0008)
