"""Still phases of cells that were made up."""

import numpy as np
from galen_model.rest.binned import Cells, find_still_phases
from gravcomp_bags import START_NS

CELL_NS = 100_000_000


def cells(roll, *, scatter=1.0, mean=0.0):
    """A cell each 0.1 s with roll (n,), ten readings of this scatter, spans of zero."""
    count = len(roll)
    start = START_NS + CELL_NS * np.arange(count, dtype=np.int64)
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
    (start,), (end,) = (
        getattr(find_still_phases(cells(np.zeros(20))), name) for name in ("start_ns", "end_ns")
    )
    assert start == START_NS + 2 * CELL_NS
    assert end == START_NS + 17 * CELL_NS + 90_000_000


def test_another_pose_is_another_phase_though_no_cell_moves():
    phases = find_still_phases(cells(np.repeat([0.0, 0.01], 15)))
    np.testing.assert_allclose(phases.angles[:, 0], [0.0, 0.01], atol=1e-12)


def test_a_bias_drift_from_cell_to_cell_is_in_the_mean_s_error():
    mean = 0.003 * np.random.default_rng(2).choice([-1.0, 1.0], 10)
    phases = find_still_phases(cells(np.zeros(10), scatter=1e-3, mean=mean))
    assert np.all(phases.std_of_mean > 0.0008)
