"""What the arm did when: still, moving, touched; poses and blocks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from galen_model.arrays import Array
from galen_sim_driver.replay import rates

from galen_diagnosis.observation.rows import FOLDS, REGIMES

_STILL_RAD_S, _STILL_M_S = 0.02, 2e-3
_FAST_RAD_S2, _FAST_M_S2 = 3.0, 0.3
_LEAST_STILL_S = 0.3
_GAP_S = 0.3
_TOUCH_N, _TOUCH_NM = 0.25, 0.02
_TOUCH_SIGMA = 8.0
_TOUCH_WINDOW_S = 0.1
_REST_START_S = 0.4
_BEFORE_TOUCH_S = 0.15
_MOTION_BLOCK_S = 3.0
_PUSH_BLOCK_S = 3.0
_HELD_N_S = 4.0

STILL, PLUS, MINUS, ACCELERATING, REST, LOADING, HELD, UNLOADING = range(len(REGIMES))


class Phases(NamedTuple):
    """Of n instants: stretch (n,) number of the still or moving stretch without a gap, still (n,).

    pose (n,): number of the still stretch, -1 in motion. rate, acceleration (n, 5) of the joints.
    """

    stretch: np.ndarray
    still: np.ndarray
    pose: np.ndarray
    rate: Array
    acceleration: Array


def phases(at_s: Array, joint_s: Array, joints: Array) -> Phases:
    """Phases at times at_s (n,), by the reported joints (nj, 5) at joint_s (nj,)."""
    velocity, acceleration = (_at(at_s, joint_s, part) for part in rates(joint_s, joints))
    still = (np.abs(velocity[:, 3:]).max(axis=1) < _STILL_RAD_S) & (
        np.abs(velocity[:, :3]).max(axis=1) < _STILL_M_S
    )
    cuts = (np.diff(at_s) > _GAP_S) | (np.diff(still.astype(np.int8)) != 0)
    stretch = np.concatenate([[0], np.cumsum(cuts)])
    starts = np.flatnonzero(np.concatenate([[True], cuts]))
    ends = np.concatenate([starts[1:], [len(at_s)]])
    pose = np.full(len(at_s), -1)
    number = 0
    for first, last in zip(starts, ends, strict=True):
        if not still[first]:
            continue
        if at_s[last - 1] - at_s[first] < _LEAST_STILL_S:
            still[first:last] = False
            continue
        pose[first:last] = number
        number += 1
    return Phases(stretch, still, pose, velocity, acceleration)


def moving_regime(of: Phases) -> np.ndarray:
    """Regime (n,) where nobody touches the tool."""
    fast = (np.abs(of.acceleration[:, 3:]).max(axis=1) > _FAST_RAD_S2) | (
        np.abs(of.acceleration[:, :3]).max(axis=1) > _FAST_M_S2
    )
    leading = np.argmax(np.abs(of.rate[:, 3:]), axis=1)
    forward = of.rate[np.arange(len(leading)), 3 + leading] >= 0.0
    regime = np.where(forward, PLUS, MINUS)
    regime[fast] = ACCELERATING
    regime[of.still] = STILL
    return regime


def touched(at_s: Array, of: Phases, residual: Array, noise: Array) -> np.ndarray:
    """Where a hand may be at the tool, (n,) bool, of a bag with pushes.

    residual (n, 6): reading less nominal; noise (6,) of a sample. In each still stretch the hand
    comes when the residual, averaged over 0.1 s, leaves what it was at the stretch's start; from
    then on to the stretch's end the tool counts as touched.
    """
    out = np.zeros(len(at_s), dtype=bool)
    for number in range(of.pose.max() + 1):
        rows = np.flatnonzero(of.pose == number)
        since = at_s[rows] - at_s[rows[0]]
        start = since < _REST_START_S
        if start.sum() < 4 or since[-1] < _REST_START_S:
            continue
        step = max(float(np.median(np.diff(since))), 1e-4)
        width = max(int(_TOUCH_WINDOW_S / step), 1)
        off = residual[rows] - np.median(residual[rows][start], axis=0)
        kernel = np.ones(width) / width
        smooth = np.stack([np.convolve(column, kernel, mode="same") for column in off.T], axis=1)
        limit = np.maximum(
            np.array([_TOUCH_N] * 3 + [_TOUCH_NM] * 3),
            _TOUCH_SIGMA * noise / np.sqrt(min(width, int(start.sum()))),
        )
        hits = np.flatnonzero((np.abs(smooth) > limit).any(axis=1))
        if len(hits):
            first = since[hits[0]] - _BEFORE_TOUCH_S
            out[rows[since >= first]] = True
    return out


def push_regime(at_s: Array, force_n: Array, is_touched: np.ndarray) -> np.ndarray:
    """Regime (n,) of pushes: rest, loading, held, unloading by the applied force's size (n,)."""
    regime = np.full(len(at_s), REST)
    if len(at_s) < 3:
        return regime
    slope = np.gradient(force_n, at_s + 1e-9 * np.arange(len(at_s)))
    on = is_touched & (force_n > 2.0 * _TOUCH_N)
    regime[on] = HELD
    regime[on & (slope > _HELD_N_S)] = LOADING
    regime[on & (slope < -_HELD_N_S)] = UNLOADING
    return regime


def blocks(bag: str, at_s: Array, pose: np.ndarray) -> np.ndarray:
    """Block (n,) within the bag: a pose with the move after it, 3 s of motion, 3 s of pushes."""
    if bag == "sweep":
        # Rows of a move belong to the pose before it.
        return np.maximum(np.maximum.accumulate(pose), 0)
    if bag == "motion":
        return np.floor(at_s / _MOTION_BLOCK_S).astype(int)
    return np.floor(at_s / _PUSH_BLOCK_S).astype(int)


def deal(count: int, seed: int) -> np.ndarray:
    """Fold (count,) of each block: neighbours in time in different ones, in a shuffled order."""
    generator = np.random.default_rng(seed)
    turns = [generator.permutation(FOLDS) for _ in range(-(-count // FOLDS))]
    return np.concatenate(turns)[:count] if turns else np.zeros(0, dtype=int)


def _at(at_s: Array, known_s: Array, values: Array) -> Array:
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)
