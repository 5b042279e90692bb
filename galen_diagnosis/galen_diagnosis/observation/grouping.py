"""Samples in runs and in groups of a few, whitened and averaged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.observation.noise import ChannelNoise


@dataclass(frozen=True)
class Groups:
    """Samples of one stream in groups: which (n,) (-1 for none), mean time, number of samples."""

    which: np.ndarray
    at_s: Array
    count: np.ndarray


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
