"""Whitened rows of a recording.

The residual as a diagnosis works on it: whitened rows, each with where it comes from.

A row is a residual (measured less predicted) of one channel, averaged over a few samples and scaled
so that noise alone has unit variance and no correlation from row to row. What isn't known of the
recording and is no gap (the sensor's zero, where the tracker stands) is not projected out of rows;
whoever fits has it among the columns.

Samples in runs and in groups of a few, whitened and averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array

from galen_diagnosis.observation.noise import ChannelNoise

if TYPE_CHECKING:
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
class Rows:
    """Where N rows come from; all arrays (N,) unless said.

    channel, bag, regime: indices into CHANNELS, BAGS, REGIMES. bag_s, session_s: time of the row
    since the bag's and the recording's first stamp, s. pose: index of the still pose of the sweep,
    or of the arm's position among the pushes; -1 in motion. block: rows of one block are held out
    together, and are what is drawn in a bootstrap; numbered over the whole recording. fold (0 ...
    FOLDS - 1): of the block. joints (N, 5): reported, m and rad. rate (N, 5): their rates. samples:
    how many a row averages. scale: what one unit is in N, N.m, m or rad.
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
    """Return which of GROUPS a channel belongs to."""
    return next(name for name, channels in GROUPS.items() if channel in channels)


def stretches(
    at_s: Array, residual: Array, stretch: np.ndarray, use: np.ndarray
) -> list[tuple[Array, Array]]:
    """Runs of usable samples within one stretch."""
    key = np.where(use & np.isfinite(residual).all(axis=1), stretch, -1)
    cuts = np.flatnonzero(np.diff(key) != 0) + 1
    runs = np.split(np.arange(len(at_s)), cuts)
    return [(at_s[run], residual[run]) for run in runs if len(run) and key[run[0]] >= 0]


def groups_of(at_s: Array, stretch: np.ndarray, length_s: float, order: int) -> Groups:
    """Samples of each stretch in groups of about length_s; the first `order` of it in none."""
    step = max(float(np.median(np.diff(at_s))), 1e-6)
    most = max(round(length_s / step), 1)
    which = np.full(len(at_s), -1)
    number = 0
    for run in np.split(np.arange(len(at_s)), np.flatnonzero(np.diff(stretch) != 0) + 1):
        for part in np.array_split(run[order:], max(1, -(-(len(run) - order) // most))):
            if len(part):
                which[part] = number
                number += 1
    groups = Groups(which, np.zeros(number), np.bincount(which[which >= 0], minlength=number))
    return replace(groups, at_s=group_mean(groups, at_s))


def group_mean(groups: Groups, values: Array) -> Array:
    """Mean (m, ...) of values (n, ...) over each group."""
    inside = groups.which >= 0
    flat = values[inside].reshape(int(inside.sum()), -1)
    sums = np.stack(
        [np.bincount(groups.which[inside], column, len(groups.count)) for column in flat.T], axis=1
    )
    return (sums / groups.count[:, None]).reshape(len(groups.count), *values.shape[1:])


def middle(groups: Groups) -> np.ndarray:
    """The sample in the middle of each group."""
    inside = np.flatnonzero(groups.which >= 0)
    first = np.searchsorted(groups.which[inside], np.arange(len(groups.count)))
    return inside[first + groups.count // 2]


def whitened(
    residual: Array, noise: list[ChannelNoise], stretch: np.ndarray, groups: Groups
) -> tuple[Array, Array]:
    """Whitened rows (m, k) of samples (n, k), and what a constant 1 becomes in them (m, k)."""
    white = np.empty_like(residual)
    runs = np.split(np.arange(len(residual)), np.flatnonzero(np.diff(stretch) != 0) + 1)
    for column, one in enumerate(noise):
        for run in runs:
            white[run, column] = one.whitened(residual[run, column])
    root = np.sqrt(groups.count)[:, None]
    gain = root * np.array([one.gain for one in noise])
    return group_mean(groups, white) * root, gain
