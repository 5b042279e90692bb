"""Recordings to compare models of deflection on: too large to keep, so made where they are wanted.

As in the 2019 report, two sets of pushes at each of four positions, here one set a recording and
position; and further positions, for models that want more data. The joints have hysteresis. The
hand pushes like a person: as hard, as long and as straight as it comes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from galen_sim_driver.plant.config import HandPush
from offline_cell import OfflineCell

RESIDUAL_FRACTION = 0.0742
"""Of a joint's deflection, what is left at no load: what a recording of another's arm shows."""

EXTRA_POSITIONS = (
    (-0.04, -0.06, 0.390, 0.5, -0.7),
    (0.07, 0.03, 0.435, -0.4, 0.2),
    (-0.02, 0.07, 0.420, 1.0, -0.1),
    (0.05, -0.02, 0.375, -0.6, -0.5),
    (-0.06, -0.01, 0.440, 0.1, 0.6),
    (0.01, -0.07, 0.400, -0.2, 0.4),
)

_START_S, _MOVE_S, _SETTLE_S, _UNTOUCHED_S = 1.0, 2.0, 0.5, 3.0
_FORCES_N, _TORQUES_NM = (3.0, 6.0, 10.0), (0.3, 0.8)
_STRENGTH, _ASIDE = (0.85, 1.15), 0.06
_PUSH_S, _PAUSE_S, _RAMP_S = (0.85, 1.2), (0.3, 0.5), (0.2, 0.3)


def script(visits: int, seed: int) -> tuple[tuple[HandPush, ...], tuple[float, ...]]:
    """The hand's pushes in all visits, and when (s) each visit's last one is over.

    The script runs from the start of the recording: a visit begins with the move to its position.
    Each of the forces and torques, to both sides along each axis of base_link, is made somewhat
    stronger or weaker, longer or shorter, and aside.
    """
    rng = np.random.default_rng(seed)
    pushes: list[HandPush] = []
    ends = []
    at_s = _START_S
    for _ in range(visits):
        at_s += _MOVE_S + _SETTLE_S + _UNTOUCHED_S
        for levels, torque in ((_FORCES_N, False), (_TORQUES_NM, True)):
            for axis in range(3):
                for sign in (1.0, -1.0):
                    for level in levels:
                        duration_s = rng.uniform(*_PUSH_S)
                        pushes.append(_push(rng, at_s, duration_s, sign * level, axis, torque))
                        at_s += duration_s + rng.uniform(*_PAUSE_S)
        ends.append(at_s)
    return tuple(pushes), tuple(ends)


def _push(
    rng: np.random.Generator,
    start_s: float,
    duration_s: float,
    level: float,
    axis: int,
    torque: bool,
) -> HandPush:
    strength = level * rng.uniform(*_STRENGTH)
    vector = strength * _ASIDE * rng.standard_normal(3)
    vector[axis] = strength
    x, y, z = vector.tolist()
    return HandPush(
        start_s,
        duration_s,
        force_n=(0.0, 0.0, 0.0) if torque else (x, y, z),
        torque_nm=(x, y, z) if torque else (0.0, 0.0, 0.0),
        ramp_s=rng.uniform(*_RAMP_S),
    )


def play(
    cell: OfflineCell,
    _recipe: object,
    _folder: Path,
    positions: Sequence[Sequence[float]],
    ends_s: Sequence[float],
) -> None:
    """Visit the positions while the plant's hand plays its `script`, whose `ends_s` these are."""
    start_ns = cell.plant.now_ns
    cell.plant.start_hand()
    cell.run(_START_S)
    for joints, end_s in zip(positions, ends_s, strict=True):
        cell.move_to(joints, _MOVE_S)
        cell.run(end_s - 1e-9 * (cell.plant.now_ns - start_ns))
    cell.run(_START_S)
