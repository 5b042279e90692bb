"""Find the still phases of a recording from its joint states.

An encoder moves in steps, so that the difference of two samples, 2 ms apart, says nothing of a
speed: one step of 5e-5 rad in 2 ms would be 0.025 rad/s. So a joint's range is taken over blocks of
half a window, and the arm stands still where, over each two blocks that follow one another, no
joint goes further than its speed limit allows in a window, beside one step of its encoder.

Blocks lie on multiples of half a window of the stamps. So the phases don't hang on where a
recording begins, and one read in parts has the same blocks as one read as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from galen_model.arm.galen import ENCODER_QUANTUM
from galen_model.arrays import Array

_NS = 1_000_000_000


def _default_speeds() -> Array:
    return np.array([5e-4] * 3 + [2e-3] * 2)


@dataclass(frozen=True)
class StillSettings:
    """When the arm counts as still. Joints in the joint vector's order, m and rad.

    max_speed (5,): m/s and rad/s, over `window_s`; a phase shorter than `min_duration_s` is none;
    a step of the stamps backward or longer than `max_stamp_step_s` ends a phase.
    """

    max_speed: Array = field(default_factory=_default_speeds)
    quantum: Array = field(default_factory=lambda: ENCODER_QUANTUM)
    window_s: float = 0.1
    min_duration_s: float = 0.5
    max_stamp_step_s: float = 0.25


def find_still(
    stamp_ns: np.ndarray, joints: Array, settings: StillSettings | None = None
) -> list[tuple[int, int]]:
    """First and last stamp (ns) of each still phase; arguments as for `still_rows`."""
    return [
        (int(stamp_ns[rows.start]), int(stamp_ns[rows.stop - 1]))
        for rows in still_rows(stamp_ns, joints, settings)
    ]


def still_rows(
    stamp_ns: np.ndarray, joints: Array, settings: StillSettings | None = None
) -> list[slice]:
    """Rows of each still phase, in order.

    stamp_ns (n,) in the order received; joints (n, 5), m and rad. A row that is not finite counts
    as motion; a joint of which no row is finite is not looked at. Inside a phase the stamps never
    go back, and where they stand still, the rows belong to it all the same.
    """
    settings = settings or StillSettings()
    known = np.isfinite(joints).any(axis=0) if len(joints) else np.zeros(5, dtype=bool)
    if len(stamp_ns) < 2 or not known.any():
        return []
    block_ns = max(1, round(settings.window_s * _NS / 2))
    step_ns = np.diff(stamp_ns)
    jumps = (step_ns < 0) | (step_ns > round(settings.max_stamp_step_s * _NS))
    starts = np.flatnonzero(np.concatenate([[True], jumps | (np.diff(stamp_ns // block_ns) != 0)]))
    joined = ~jumps[starts[1:] - 1]  # whether a block goes on from the one before it
    low = np.minimum.reduceat(joints[:, known], starts, axis=0)
    high = np.maximum.reduceat(joints[:, known], starts, axis=0)
    span = np.maximum(high[1:], high[:-1]) - np.minimum(low[1:], low[:-1])
    allowed = settings.max_speed * settings.window_s + settings.quantum
    still = joined & np.all(span <= allowed[known], axis=1)  # of a block and its next one

    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    ends = np.concatenate([starts[1:], [len(stamp_ns)]])
    least_ns = round(settings.min_duration_s * _NS)
    phases = [
        slice(int(starts[first]), int(ends[last]))
        for first, last in zip(edges[::2], edges[1::2], strict=True)
    ]
    return [p for p in phases if stamp_ns[p.stop - 1] - stamp_ns[p.start] >= least_ns]
