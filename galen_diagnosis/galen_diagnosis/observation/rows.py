# SPDX-License-Identifier: Apache-2.0
"""The residual as a diagnosis works on it: whitened rows, each with where it comes from.

A row is a residual (measured less predicted) of one channel, averaged over a few samples and scaled
so that noise alone has unit variance and no correlation from row to row. Unknowns that are no gap
(the sensor's zero, where the tracker stands) are not projected out of rows: a fit has them among
its columns. Here are also the samples' phases (still, moving, touched; poses, blocks) and groups.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_sim_driver.replay import GAP_S, rates

from galen_diagnosis.observation.noise import ChannelNoise

TIP_AXES = ("dx", "dy", "dz", "rx", "ry", "rz")
"""Displacement of tool_tip in base_link: m, rad."""

MARKER_AXES = ("mx", "my", "mz", "mrx", "mry", "mrz")
"""Displacement of the base's marker from its mean, in base_link: m, rad."""

CHANNELS = (*WRENCH_AXES, *TIP_AXES, *MARKER_AXES)
"""Order of a row's channel."""

GROUPS = {
    "force": WRENCH_AXES[:3],
    "torque": WRENCH_AXES[3:],
    "tip translation": TIP_AXES[:3],
    "tip rotation": TIP_AXES[3:],
    "base marker": MARKER_AXES,
}

BAGS = ("sweep", "motion", "push")

REGIMES = ("still", "moving+", "moving-", "accelerating", "rest", "loading", "held", "unloading")
"""still: sweep's poses and any other stop; moving+-: by the sign of the fastest angle's rate;
rest, loading, held, unloading: of the pushes, by the applied force and its rate."""

FOLDS = 4
"""Blocks are dealt to this many parts; each part is held out once."""


@dataclass(frozen=True)
class ResidualRows:
    """Where N rows come from; all arrays (N,) unless said.

    channel, bag, regime: indices into CHANNELS, BAGS, REGIMES. bag_s, session_s: time of the row
    since the bag's and the recording's first stamp, s. pose: index of the still pose of the sweep,
    or of the arm's position among the pushes; -1 in motion. block: rows of one block are held out
    together, and are what is drawn in a bootstrap; numbered over the whole recording. fold (0 ...
    FOLDS - 1): of the block. joints (N, n): reported, m and rad. rate (N, n): their rates. samples:
    how many a row averages. scale: what one unit is in N, N.m, m or rad. labels: of a table's
    blocks, which are its poses.
    """

    channel: np.ndarray
    bag: np.ndarray
    regime: np.ndarray
    bag_s: Array
    session_s: Array
    pose: np.ndarray
    block: np.ndarray
    fold: np.ndarray
    joints: Array
    rate: Array
    samples: np.ndarray
    scale: Array
    arm: Arm
    labels: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.channel)


@dataclass(frozen=True)
class Stream:
    """A residual in time, for spectra and pictures: not averaged, in the channels' own units.

    channels: names of the k columns; bag; at_s (n,) since the bag's first stamp; residual (n, k);
    noise (k,): standard deviation of one sample. Rows that say nothing are NaN. models: of each
    column's noise, whose pieces they whiten; empty for white noise of `noise`.
    """

    bag: str
    channels: tuple[str, ...]
    at_s: Array
    residual: Array
    noise: Array
    models: tuple[ChannelNoise, ...] = ()


@dataclass(frozen=True)
class Groups:
    """Samples of one stream in groups: which (n,) (-1 for none), mean time, number of samples."""

    which: np.ndarray
    at_s: Array
    count: np.ndarray


def group_of(channel: str) -> str:
    """Return which of GROUPS a channel belongs to.

    Args:
        channel: One of CHANNELS.

    Returns:
        Name of the group.

    """
    return next(name for name, channels in GROUPS.items() if channel in channels)


def stretches(
    at_s: Array, residual: Array, stretch: np.ndarray, use: np.ndarray
) -> list[tuple[Array, Array]]:
    """Return runs of usable samples within one stretch.

    Args:
        at_s: Times, (n,), s.
        residual: Residuals, (n, k); samples with a NaN aren't usable.
        stretch: Number of each sample's stretch, (n,).
        use: Which samples may be used, (n,) bool.

    Returns:
        Times and residuals of each run.

    """
    key = np.where(use & np.isfinite(residual).all(axis=1), stretch, -1)
    cuts = np.flatnonzero(np.diff(key) != 0) + 1
    runs = np.split(np.arange(len(at_s)), cuts)
    return [(at_s[run], residual[run]) for run in runs if len(run) and key[run[0]] >= 0]


def groups_of(at_s: Array, stretch: np.ndarray, length_s: Array, order: int) -> Groups:
    """Group samples of each stretch, but for its first ones.

    Args:
        at_s: Times, (n,), s.
        stretch: Number of each sample's stretch, (n,).
        length_s: About how long a group is, (n,); each stretch takes that of its first sample.
        order: How many samples at the start of a stretch are in no group, which whitening takes.

    Returns:
        m groups, numbered in time.

    """
    step = max(float(np.median(np.diff(at_s))), 1e-6)
    which = np.full(len(at_s), -1)
    number = 0
    for run in np.split(np.arange(len(at_s)), np.flatnonzero(np.diff(stretch) != 0) + 1):
        most = max(round(float(length_s[run[0]]) / step), 1)
        for part in np.array_split(run[order:], max(1, -(-(len(run) - order) // most))):
            if len(part):
                which[part] = number
                number += 1
    groups = Groups(which, np.zeros(number), np.bincount(which[which >= 0], minlength=number))
    return replace(groups, at_s=group_mean(groups, at_s))


def group_mean(groups: Groups, values: Array) -> Array:
    """Return means over each group.

    Args:
        groups: Groups of n samples.
        values: Values of the samples, (n, ...).

    Returns:
        Means, (m, ...).

    """
    inside = groups.which >= 0
    flat = values[inside].reshape(int(inside.sum()), -1)
    sums = np.stack(
        [np.bincount(groups.which[inside], column, len(groups.count)) for column in flat.T], axis=1
    )
    return (sums / groups.count[:, None]).reshape(len(groups.count), *values.shape[1:])


def middle(groups: Groups) -> np.ndarray:
    """Return the sample in the middle of each group.

    Args:
        groups: Groups of n samples.

    Returns:
        Indices of samples, (m,).

    """
    inside = np.flatnonzero(groups.which >= 0)
    first = np.searchsorted(groups.which[inside], np.arange(len(groups.count)))
    return inside[first + groups.count // 2]


def whitened(
    residual: Array, noise: list[ChannelNoise], stretch: np.ndarray, groups: Groups
) -> tuple[Array, Array]:
    """Whiten samples and average them over groups.

    Args:
        residual: Samples, (n, k), in the channels' units.
        noise: Noise of each of k channels.
        stretch: Number of each sample's stretch, (n,).
        groups: m groups, none with the first samples of a stretch.

    Returns:
        Rows of unit variance, (m, k), and what a constant 1 becomes in them, (m, k), in one over
        the channels' units.

    """
    white = np.empty_like(residual)
    runs = np.split(np.arange(len(residual)), np.flatnonzero(np.diff(stretch) != 0) + 1)
    for column, one in enumerate(noise):
        for run in runs:
            white[run, column] = one.whitened(residual[run, column])
    root = np.sqrt(groups.count)[:, None]
    gain = root * np.array([one.gain for one in noise])
    return group_mean(groups, white) * root, gain


# Phases

_STILL = (2e-3, 0.02)  # m/s, rad/s
_FAST = (0.3, 3.0)  # m/s^2, rad/s^2
_LEAST_STILL_S = 0.3
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

    pose (n,): number of the still stretch, -1 in motion. rate, acceleration (n, k) of the joints.
    """

    stretch: np.ndarray
    still: np.ndarray
    pose: np.ndarray
    rate: Array
    acceleration: Array


def phases(arm: Arm, at_s: Array, joint_s: Array, joints: Array) -> Phases:
    """Return phases at times, by the reported joints.

    Args:
        arm: Which joints turn and which slide.
        at_s: Times, (n,), s, in increasing order.
        joint_s: Times of the joints, (nj,), s.
        joints: Reported joints, (nj, k), m and rad.

    Returns:
        Phases of n instants.

    """
    velocity, acceleration = (_at(at_s, joint_s, part) for part in rates(joint_s, joints))
    still = np.asarray(np.all(np.abs(velocity) < arm.by_unit(*_STILL), axis=1))
    cuts = (np.diff(at_s) > GAP_S) | (np.diff(still.astype(np.int8)) != 0)
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


def moving_regime(arm: Arm, of: Phases) -> np.ndarray:
    """Return the regime where the tool isn't touched.

    Args:
        arm: Which joints turn and which slide.
        of: Phases of n instants.

    Returns:
        STILL, ACCELERATING, or PLUS and MINUS by the sign of the fastest angle's rate, (n,).

    """
    fast = (np.abs(of.acceleration) > arm.by_unit(*_FAST)).any(axis=1)
    turning = arm.angles(of.rate)
    leading = np.argmax(np.abs(turning), axis=1)
    forward = turning[np.arange(len(leading)), leading] >= 0.0
    regime = np.where(forward, PLUS, MINUS)
    regime[fast] = ACCELERATING
    regime[of.still] = STILL
    return regime


def touched(at_s: Array, of: Phases, residual: Array, noise: Array) -> np.ndarray:
    """Return where the tool may be touched, of a bag with pushes.

    In each still stretch the push comes when the residual, averaged over 0.1 s, leaves what it was
    at the stretch's start; from then on to the stretch's end the tool counts as touched.

    Args:
        at_s: Times, (n,), s.
        of: Phases at these times.
        residual: Reading less nominal, (n, 6), N and N.m.
        noise: Standard deviations of a sample, (6,), N and N.m.

    Returns:
        (n,) bool.

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
    """Return the regime of pushes, by the applied force's size and its rate.

    Args:
        at_s: Times, (n,), s.
        force_n: Size of the applied force, (n,), N.
        is_touched: Where the tool may be touched, (n,) bool.

    Returns:
        REST, LOADING, HELD or UNLOADING, (n,).

    """
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
    """Return the block of samples: a pose with the move after it, 3 s of motion, 3 s of pushes.

    Args:
        bag: Name of the bag.
        at_s: Times since the bag's first stamp, (n,), s.
        pose: Number of the still stretch, -1 in motion, (n,).

    Returns:
        Numbers within the bag, (n,), from 0 on; some may be unused.

    """
    if bag == "sweep":
        # Rows of a move belong to the pose before it.
        return np.maximum(np.maximum.accumulate(pose), 0)
    if bag == "motion":
        return np.floor(at_s / _MOTION_BLOCK_S).astype(int)
    return np.floor(at_s / _PUSH_BLOCK_S).astype(int)


def deal(count: int, seed: int) -> np.ndarray:
    """Deal blocks to folds: neighbours in time to different ones, in a shuffled order.

    Args:
        count: Number of blocks.
        seed: Of the order.

    Returns:
        Fold of each block, (count,), 0 ... FOLDS - 1.

    """
    generator = np.random.default_rng(seed)
    turns = [generator.permutation(FOLDS) for _ in range(-(-count // FOLDS))]
    return np.concatenate(turns)[:count] if turns else np.zeros(0, dtype=int)


def _at(at_s: Array, known_s: Array, values: Array) -> Array:
    return np.stack([np.interp(at_s, known_s, column) for column in values.T], axis=1)
