"""The still poses of a sweep: a grid over tilt and roll, in an order that saves travel.

The 2019 report sweeps 7 tilts x 8 rolls = 56 poses (class roBehaviorGravComp: tstart, tend, itersT,
rstart, rend, itersR).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from galen_model.arrays import Array
from galen_model.errors import GalenError


class GridError(GalenError):
    """A grid that the arm can't visit; the message names the joint and the value."""


@dataclass(frozen=True)
class SweepGrid:
    """Start, end (both included, rad) and count of tilts and rolls; names as in the report."""

    tstart: float
    tend: float
    itersT: int
    rstart: float
    rend: float
    itersR: int

    def poses(self, lower: tuple[float, float], upper: tuple[float, float]) -> Array:
        """All poses as rows (roll, tilt) in rad, shape (itersT * itersR, 2), in visiting order.

        `lower` and `upper` are the limits of (roll, tilt) in rad.
        The order is a serpentine: the inner joint goes there and back while the outer one steps
        on, so that no move is longer than one step of the grid. Travel is
        outer range + outer count * inner range; the cheaper of both orders is taken.
        Raises GridError for a count below 1, a value that is not finite or outside the limits.
        """
        rolls = _axis("roll", "r", self.rstart, self.rend, self.itersR, lower[0], upper[0])
        tilts = _axis("tilt", "t", self.tstart, self.tend, self.itersT, lower[1], upper[1])
        roll_inside = np.ptp(tilts) + len(tilts) * np.ptp(rolls)
        tilt_inside = np.ptp(rolls) + len(rolls) * np.ptp(tilts)
        if tilt_inside <= roll_inside:
            return _serpentine(rolls, tilts)
        return _serpentine(tilts, rolls)[:, ::-1].copy()


def _axis(
    joint: str, letter: str, start: float, end: float, count: int, lower: float, upper: float
) -> Array:
    if count < 1:
        raise GridError(f"iters{letter.upper()} is {count}: a sweep needs at least 1 {joint}")
    for name, value in ((f"{letter}start", start), (f"{letter}end", end)):
        if not np.isfinite(value):
            raise GridError(f"{name} of joint {joint} is {value}: not a finite angle")
        if not lower <= value <= upper:
            raise GridError(
                f"{name} = {value:g} rad is outside the limits of joint {joint},"
                f" {lower:g} ... {upper:g} rad"
            )
    if count > 1 and start == end:
        raise GridError(
            f"{letter}start and {letter}end of joint {joint} are both {start:g} rad:"
            f" iters{letter.upper()} = {count} poses would be one and the same"
        )
    if count == 1:
        return np.array([0.5 * (start + end)])
    return np.linspace(start, end, count)


def _serpentine(outer: Array, inner: Array) -> Array:
    rows = []
    for k, value in enumerate(outer):
        turned = inner if k % 2 == 0 else inner[::-1]
        rows.append(np.column_stack([np.full(len(inner), value), turned]))
    return np.vstack(rows)
