"""Where in a recording one load, or one zero of the sensor, gave way to another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from galen_model.arrays import Array
from galen_model.files.calibration_file import CalibrationFile
from galen_model.load.model import gravity_regressor
from galen_model.rest.binned import StillPhases

from galen_gravcomp.evaluate.residual_decomposition import Limits, phase_gravity

_FEWEST_A_SIDE = 6
_CHANGE = 5.0


@dataclass(frozen=True)
class LoadChange:
    """Something changed between two still phases: `time_ns` is between them.

    first_after: the first phase after it. mass_kg: what the mass differs from the file's, before
    and after; None where one load explains both sides and only the reading's offset changed, by
    offset_step (6,), N and N.m.
    """

    time_ns: int
    first_after: int
    mass_kg: tuple[float, float] | None
    offset_step: Array


def find_change(phases: StillPhases, tool: CalibrationFile, limits: Limits) -> LoadChange | None:
    """Where the recording falls in two, as one in which a tool was put on or the sensor zeroed.

    Each border between two phases is tried, with a load and an offset of its own on either side
    (least squares, the channels weighted by their limits). The best one counts if the root mean
    square left is then less than a fifth of what one load and offset leave, and that is beyond
    the limits. If offsets of its own with one load for both sides do as well, it is the offset
    that changed.
    """
    if len(phases) < 2 * _FEWEST_A_SIDE:
        return None
    loads = gravity_regressor(phase_gravity(phases, tool)) / limits.axes[None, :, None]
    offsets = np.broadcast_to(np.diag(1.0 / limits.axes), (len(phases), 6, 6))
    values = phases.mean / limits.axes
    # kg and kg.m beside N and N.m: balance
    scale = np.array([10.0] + [100.0] * 3 + [1.0] * 6)
    rows = np.concatenate([loads, offsets], axis=2) / scale
    matrices = np.cumsum(np.einsum("nkp,nkq->npq", rows, rows), axis=0)
    rights = np.cumsum(np.einsum("nkp,nk->np", rows, values), axis=0)
    squares = np.cumsum(np.sum(values**2, axis=1))

    def cost(matrix: Array, right: Array, square: float) -> tuple[float, Array]:
        # The pseudo-inverse: a side's poses need not tell all of its load.
        solution = np.linalg.pinv(matrix, rcond=1e-9, hermitian=True) @ right
        return max(float(square - right @ solution), 0.0), solution / scale

    whole, _ = cost(matrices[-1], rights[-1], float(squares[-1]))
    if whole <= len(phases):
        return None
    best: tuple[float, int, Array, Array] | None = None
    for k in range(_FEWEST_A_SIDE, len(phases) - _FEWEST_A_SIDE + 1):
        before, first = cost(matrices[k - 1], rights[k - 1], float(squares[k - 1]))
        after, second = cost(
            matrices[-1] - matrices[k - 1],
            rights[-1] - rights[k - 1],
            float(squares[-1] - squares[k - 1]),
        )
        if best is None or before + after < best[0]:
            best = (before + after, k, first, second)
    assert best is not None
    least, k, first, second = best
    if least * _CHANGE**2 > whole:
        return None
    time_ns = (int(phases.end_ns[k - 1]) + int(phases.start_ns[k])) // 2
    later = np.arange(len(phases)) >= k
    stepped = np.concatenate([rows, later[:, None, None] * offsets], axis=2).reshape(-1, 16)
    solution = np.linalg.lstsq(stepped, values.ravel(), rcond=1e-9)[0]
    left = float(np.sum((values.ravel() - stepped @ solution) ** 2))
    if left * _CHANGE**2 <= whole:
        return LoadChange(time_ns, k, None, solution[-6:])
    return LoadChange(time_ns, k, (float(first[0]), float(second[0])), second[4:] - first[4:])
