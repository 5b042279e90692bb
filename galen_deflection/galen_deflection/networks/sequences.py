"""Samples as sequences for a network; which of them are held out of its training."""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array

from galen_deflection.measurement.samples import DeflectionSamples
from galen_deflection.models.least_squares import blocks
from galen_deflection.models.linear import segments
from galen_deflection.networks.recurrent_net import PacedNet, RecurrentNet
from galen_deflection.networks.training import Series

_HELD_OUT_SHARE = 0.25


def sequences(
    samples: DeflectionSamples, inputs: Array, targets: Array, use: np.ndarray, period_s: float
) -> list[Series]:
    """A sequence for each segment and phase, at one rate: inputs (n, k), targets (n, m), use (n,).

    Where samples come faster than the period, several sequences begin one after the other within
    the first period, so that every sample is learnt from, and as it will be run (`paced`). Between
    samples inputs and targets are interpolated; a target counts if both its sides do. Sequences of
    which nothing counts are left out.
    """
    found = []
    for segment in segments(samples):
        time = (samples.stamp_ns[segment] - samples.stamp_ns[segment.start]) * 1e-9
        if len(time) < 2 or not use[segment].any():
            continue
        known = np.where(use[segment, None], targets[segment], np.nan)
        phases = max(1, round(period_s / float(np.median(np.diff(time)))))
        for phase in range(phases):
            at = np.arange(phase * period_s / phases, time[-1] + 1e-6, period_s)
            target = interpolated(at, time, known)
            use_target = np.asarray(np.isfinite(target).all(axis=1))
            if use_target.any():
                found.append(Series(interpolated(at, time, inputs[segment]), target, use_target))
    return found


def interpolated(at: Array, time: Array, values: Array) -> Array:
    """Values (n, k) at other times (m,), linearly; NaN where a side that counts is NaN."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    share = np.clip((at - time[after - 1]) / (time[after] - time[after - 1]), 0.0, 1.0)[:, None]
    # a sample that is as good as hit needs no other side
    left = np.where(share > 1.0 - 1e-6, 0.0, (1.0 - share) * values[after - 1])
    right = np.where(share < 1e-6, 0.0, share * values[after])
    return left + right


def run(net: RecurrentNet, samples: DeflectionSamples, inputs: Array, period_s: float) -> Array:
    """A network's outputs (n, n_out), each segment from a fresh start."""
    result = np.empty((len(samples), len(net.outputs.mean)))
    for segment in segments(samples):
        paced = PacedNet(net, period_s)
        result[segment] = paced.run(samples.stamp_ns[segment], inputs[segment])
    return result


def products(samples: DeflectionSamples, mean: Array, rows: np.ndarray) -> Array:
    """Mean (6, 6) of the products of residuals in units of the noise, of predictions (n, 6)."""
    error = ((samples.deflection - mean) / samples.noise)[rows]
    return np.asarray(error.T @ error / len(error))


def hold_out(samples: DeflectionSamples, used: np.ndarray) -> np.ndarray:
    """Choose at most a quarter (n,) bool of the used samples, of positions that also remain.

    A training only checks itself on them. The last repetitions of positions that have several, as
    the report held out sets; of as many positions as make up a quarter. Where no position has
    several, the last blocks of each (blocks: as `least_squares`, about a push); nothing of a
    position that has only one.
    """
    held = np.zeros(len(samples), dtype=bool)
    for position in np.unique(samples.position[used]):
        there = used & (samples.position == position)
        sets = np.unique(samples.set_number[there])
        last = there & (samples.set_number == sets[-1])
        if len(sets) > 1 and np.count_nonzero(held | last) <= _HELD_OUT_SHARE * np.count_nonzero(
            used
        ):
            held |= last
    if held.any():
        return held
    parts = [part for part in blocks(samples) if used[part].any()]
    places = np.array([samples.position[part.start] for part in parts])
    for position in np.unique(places):
        of_position = np.flatnonzero(places == position)
        if len(of_position) > 1:
            for k in of_position[-max(1, round(_HELD_OUT_SHARE * len(of_position))) :]:
                held[parts[k]] = used[parts[k]]
    return held
