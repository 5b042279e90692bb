# SPDX-License-Identifier: Apache-2.0
"""What a fit leaves: energy in means over cells, smooth structure, oscillations.

White rows averaged over a cell and scaled by the root of their number are again white; what is slow
adds up. With c cells the sum of squares of such means is chi-square of c degrees of freedom. That
sees any structure, but with thousands of cells a few hundred of energy are chance.

What machines do wrong is mostly a smooth function of something: of gravity's direction, the joints,
their rates, the reading itself, what the reading was before, time, the applied load. A family of
such functions for each, with its evidence in whatever shape (`any_shape`), sees a tenth of that,
and names what the gap depends on where no listed effect is it.

Oscillations are faster than any mean over half a second shows. A stream is cut into pieces without
holes, each transformed by the orthonormal DCT-II: coefficient k of n oscillates at
k * rate / (2 n), and of white noise all are independent with the noise's variance. Bands of n
coefficients whose squares sum to E are weighed as families are: in bands of several widths, in each
channel and in all of them, less the log of the number of looks.
Noise is known to _UNSURE in a band.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.estimation.evidence import Background, any_shape, explained
from scipy.fft import dct
from scipy.sparse import csc_array

from galen_diagnosis.observation.noise import smooth_basis
from galen_diagnosis.observation.observation import Observation
from galen_diagnosis.observation.rows import (
    BAGS,
    CHANNELS,
    REGIMES,
    TIP_AXES,
    ResidualRows,
    Stream,
)

_CELL_S = 0.5
_SURE = 2.0
_UNSURE = 0.15
"""How well the noise is known at one frequency: its model is of four numbers, fitted to rest."""
_LEAST_FREEDOM = 100
"""Degrees of freedom from which on rows show their noise better than it is known."""


def remaining_energy(rows: ResidualRows, residual: Array) -> tuple[float, float]:
    """Return the energy of cells' means that noise and its estimate can't be, and the floor.

    The floor is the mean square of a row about its cell's mean, what noise alone gives a row.

    Args:
        rows: N rows.
        residual: Whitened rows after a fit, (N,).

    Returns:
        The energy, at least 0, and the floor, both in units of the noise's variance.

    """
    cell = _cells(rows)
    number = np.bincount(cell)
    total = np.bincount(cell, residual)
    energy = float(np.sum(total**2 / number))
    count = len(number)
    within = float(residual @ residual) - energy
    freedom = len(residual) - count
    floor = within / freedom if freedom >= _LEAST_FREEDOM else 1.0
    chance = _SURE * floor * np.sqrt(2.0 * count) + _UNSURE * count
    return max(0.0, energy - count * floor - chance), floor


def _cells(rows: ResidualRows) -> np.ndarray:
    """Cell (N,) of each row: a channel of a pose of the sweep, else of half a second."""
    piece = np.zeros(len(rows), dtype=np.int64)
    for number, name in enumerate(BAGS):
        here = rows.bag == number
        halves = np.floor(rows.bag_s[here] / _CELL_S).astype(np.int64)
        if name == "sweep":
            # A pose is a cell; a move, over which everything changes, is several.
            still = rows.pose[here] >= 0
            halves[still] = -1 - rows.block[here][still]
        piece[here] = halves
    key = (piece * len(BAGS) + rows.bag) * len(CHANNELS) + rows.channel
    return np.unique(key, return_inverse=True)[1]


BY_TIME = "wrench by time"
_KNOT_S = 8.0
_SLOW_S = 0.25
_MEMORY_S = (1.0, 10.0)
_PAST_S = (1.0, 3.0, 10.0, 30.0)
_HARMONICS = (1, 2, 3)


class Structure(NamedTuple):
    """What a fit leaves; log_bayes: against noise, looks paid; energy: over the noise's."""

    name: str
    log_bayes: float
    energy: float


def structures(observation: Observation, behind: Background, residual: Array) -> list[Structure]:
    """Return each family's evidence on what a fit leaves.

    Args:
        observation: What was measured.
        behind: Background and the columns of the effects that were fitted.
        residual: Rows that were fitted, background included, (N,).

    Returns:
        One for each family, the likeliest first; the number of looks is paid.

    """
    rows = observation.rows
    means = _means(rows)
    behind, left = behind.averaged(means), np.asarray(means @ residual)
    out = [_judged(family, rows, means, behind, left) for family in _families(observation)]
    looks = float(np.log(max(len(out), 1)))
    paid = [one._replace(log_bayes=one.log_bayes - looks) for one in out]
    return sorted(paid, key=lambda one: -one.log_bayes)


def own_past(observation: Observation, behind: Background, residual: Array) -> Structure:
    """Return the evidence that each axis of the sensor lags what it read, exponentially.

    As of creep in its strain gauges (OIML R 60), which is on no list, and which a drift of any
    shape, gains and steps together imitate: c_k (y_k - x), tau_k dy_k/dt = x - y_k, of each axis
    for itself.

    Args:
        observation: What was measured.
        behind: Background.
        residual: Rows before its fit, (N,).

    Returns:
        The evidence against noise alone.

    """
    rows = observation.rows
    means = _means(rows)
    parts = []
    for name, view in observation.views.items():
        # The reading itself has the noise that is to be explained; what it should be has none.
        at_s, load = observation.applied_load(name)
        reading = observation.nominal_reading(name) + load
        steps = np.maximum(np.diff(at_s, prepend=at_s[:1]), 0.0)
        lags = [_low_passed(reading, np.exp(-steps / past_s)) - reading for past_s in _PAST_S]
        parts.append(np.stack(lags, axis=2)[view.shows])
    family = "wrench by its own past", _wrench(rows), np.concatenate(parts)
    return _judged(family, rows, means, behind.averaged(means), np.asarray(means @ residual))


def _wrench(rows: ResidualRows) -> np.ndarray:
    return np.flatnonzero(rows.channel < CHANNELS.index(TIP_AXES[0]))


def _judged(
    family: _Family, rows: ResidualRows, means: csc_array, behind: Background, left: Array
) -> Structure:
    """Return the evidence of a family of functions in means of what is left."""
    name, which, functions = family
    blocks = []
    for axis in range(6):
        own = which[axis::6]
        of = functions if functions.ndim == 2 else functions[:, axis]
        blocks.append(means[:, own] @ (of / rows.scale[own, None]))
    columns = np.concatenate(blocks, axis=1)
    seen = np.maximum(np.linalg.norm(columns, axis=0), 1e-150)
    energy, directions = explained(*behind.reduced(columns / seen, left))
    return Structure(name, any_shape(energy, directions), energy - directions)


def _means(rows: ResidualRows) -> csc_array:
    """Return a matrix (C, N) that makes white rows of white ones: means over short cells, scaled.

    What is slower than _SLOW_S loses nothing, and there are a fifth of the rows.
    """
    instant = np.floor(rows.bag_s / _SLOW_S).astype(np.int64)
    key = (instant * len(REGIMES) + rows.regime) * len(BAGS) + rows.bag
    _, cell = np.unique(key * len(CHANNELS) + rows.channel, return_inverse=True)
    size = 1.0 / np.sqrt(np.bincount(cell))
    return csc_array((size[cell], (cell, np.arange(len(rows)))))


_Family = tuple[str, np.ndarray, Array]
"""Of what they are functions; which rows (6 n,) they are in; functions (n, f) of six rows each, or
(n, 6, f) of each row its own."""


def _families(observation: Observation) -> Iterator[_Family]:
    rows = observation.rows
    first = CHANNELS.index(TIP_AXES[0])
    wrench = _wrench(rows)
    tip = np.flatnonzero((rows.channel >= first) & (rows.channel < first + len(TIP_AXES)))
    functions: list[Array] = []
    readings: list[Array] = []
    loads: list[Array] = []
    for name, view in observation.views.items():
        expected = observation.nominal_reading(name)[view.shows]
        functions.append(_of_reading(view.scene.wrench_s[view.shows], expected))
        readings.append(expected)
        if view.tracks:
            loads.append(_of_load(view.scene.tracker_s, *observation.applied_load(name)))
    yield from _of_arm(observation, wrench, "wrench")
    yield ("wrench by what it should be, and was", wrench, np.concatenate(functions))
    at_s = rows.session_s[wrench[::6]]
    turns = np.outer((at_s - at_s.min()) / max(np.ptp(at_s), 1e-9), np.pi * np.array(_HARMONICS))
    gains = np.concatenate(readings)[:, :, None] * np.cos(turns)[:, None]
    yield ("the wrench's gains by time", wrench, gains)
    if len(tip):
        yield from _of_arm(observation, tip, "tip")
        yield ("tip by the load on it", tip, np.concatenate(loads))


def _of_arm(observation: Observation, which: np.ndarray, what: str) -> Iterator[_Family]:
    rows = observation.rows
    groups = which[::6]
    joints, rate = rows.joints[groups], rows.rate[groups]
    arm = rows.arm
    rotation, _ = arm.sensor_pose(joints)
    down = (arm.gravity_m_s2 / np.linalg.norm(arm.gravity_m_s2)) @ rotation
    yield (f"{what} by gravity's direction", which, _polynomials(down))
    waves = [f(k * joints[:, j]) for j in arm.turning for k in _HARMONICS for f in (np.sin, np.cos)]
    names = " and ".join(filter(None, (", ".join(arm.turning_names[:-1]), arm.turning_names[-1])))
    yield (f"{what} by {names}", which, np.stack(waves, axis=1))
    if arm.delta is not None:
        places = 10.0 * (joints[:, :3] - joints[:, :3].mean(axis=0))
        yield (f"{what} by the platform's place", which, _polynomials(places, 2))
    if what == "wrench":
        speeds = np.concatenate([rate, np.abs(rate), rate * np.abs(rate)], axis=1)
        yield (f"{what} by the joints' rates", which, speeds)
    bag = rows.bag[groups]
    curves = []
    for number in range(len(BAGS)):
        here = bag == number
        if here.any():
            own = smooth_basis(rows.bag_s[groups][here], _KNOT_S)
            basis = np.zeros((len(groups), own.shape[1]))
            basis[here] = own
            curves.append(basis)
    yield (f"{what} by time", which, np.concatenate(curves, axis=1))


def _polynomials(of: Array, degree: int = 3) -> Array:
    """Monomials of three variables (n, 3) from degree 1 on."""
    out = [of]
    for _ in range(degree - 1):
        out.append(np.concatenate([out[-1] * of[:, k : k + 1] for k in range(3)], axis=1))
    every = np.concatenate(out, axis=1)
    keep = np.unique(np.round(every[:: max(len(every) // 50, 1)], 9), axis=1, return_index=True)[1]
    return every[:, np.sort(keep)]


def _of_reading(at_s: Array, reading: Array) -> Array:
    """Even, bent and past functions of each axis (n, 48)."""
    size = np.sqrt(np.mean(reading**2, axis=0)) + 1e-9
    x = reading / size
    out = [x, x**2, np.abs(x), np.tanh(3.0 * x)]
    steps = np.maximum(np.diff(at_s, prepend=at_s[:1]), 0.0)
    for constant in _MEMORY_S:
        path = _low_passed(x, np.exp(-steps / constant))
        out += [path, np.tanh(3.0 * (x - path))]
    return np.concatenate(out, axis=1)


def _of_load(tracker_s: Array, at_s: Array, load: Array) -> Array:
    """Return the push (n, 6), its squares and its past at the tracker's times (m, 30)."""
    size = np.sqrt(np.mean(load**2, axis=0)) + 1e-9
    x = load / size
    steps = np.maximum(np.diff(at_s, prepend=at_s[:1]), 0.0)
    path = _low_passed(x, np.exp(-steps / _MEMORY_S[0]))
    every = np.concatenate([_polynomials(x[:, :3], 2), x[:, 3:], x * np.abs(x), path, x - path], 1)
    return np.stack([np.interp(tracker_s, at_s, column) for column in every.T], axis=1)


def _low_passed(values: Array, keep: Array) -> Array:
    """y_k = keep_k y_{k-1} + (1 - keep_k) x_k, from y_0 = x_0."""
    path = np.empty_like(values)
    last = values[0]
    for k, share in enumerate(keep):
        last = share * last + (1.0 - share) * values[k]
        path[k] = last
    return path


_PIECE_S = 4.0
_SHORTEST_S = 0.4
_HOLE = 3.0
"""A step of more than this many median steps is a hole."""
_WIDTHS_HZ = (0.5, 2.0, 8.0)
_FROM_HZ = 1.0


def oscillation(streams: Sequence[Stream]) -> Structure | None:
    """Return the clearest oscillation in the wrench's streams of a residual.

    Args:
        streams: Residuals after a fit; those of tip and marker are left out.

    Returns:
        The band and channel, or all channels, with the number of looks paid; None where no band has
        more than its noise.

    """
    found: list[Structure] = []
    looks = 0
    for stream in streams:
        if stream.channels[0] != WRENCH_AXES[0]:
            continue
        frequency, square = coefficients(stream)
        frequency, square = frequency[frequency >= _FROM_HZ], square[frequency >= _FROM_HZ]
        if not len(frequency):
            continue
        each = square.shape[1]
        for width in _WIDTHS_HZ:
            number = np.floor(frequency / width).astype(int)
            count = np.bincount(number).astype(float)
            energies = [np.bincount(number, column) for column in square.T]
            for energy, channels in (
                (np.sum(energies, axis=0), each),
                *((one, 1) for one in energies),
            ):
                n = count * channels
                known_to = energy / (1.0 + _UNSURE)
                for k in np.flatnonzero(known_to > n):
                    e = known_to[k]
                    log = any_shape(e, n[k])
                    name = f"wrench in {stream.bag} at {k * width:g} to {(k + 1) * width:g} Hz"
                    found.append(Structure(name, log, float(energy[k] - n[k])))
            looks += int(np.sum(count > 0)) * (each + 1)
    if not found:
        return None
    best = max(found, key=lambda one: one.log_bayes)
    return best._replace(log_bayes=best.log_bayes - float(np.log(looks)))


def coefficients(stream: Stream) -> tuple[Array, Array]:
    """Return frequencies and squared coefficients of a stream's pieces.

    Args:
        stream: n samples of k channels; those with a NaN in any channel are holes.

    Returns:
        Frequencies (m,), Hz, and squares over the noise's variance (m, k), of all pieces.

    """
    frequencies, squares = [np.zeros(0)], [np.zeros((0, len(stream.channels)))]
    if len(stream.at_s) > 1:
        step = float(np.median(np.diff(stream.at_s)))
        for rows in _pieces(stream, step):
            white = _white(stream, rows)
            squares.append(dct(white, type=2, norm="ortho", axis=0) ** 2)
            frequencies.append(np.arange(len(white)) / (2.0 * len(white) * step))
    return np.concatenate(frequencies), np.concatenate(squares)


def _pieces(stream: Stream, step: float) -> Iterator[np.ndarray]:
    good = np.flatnonzero(np.all(np.isfinite(stream.residual), axis=1))
    if not len(good) or step <= 0.0:
        return
    hole = (np.diff(good) > 1) | (np.diff(stream.at_s[good]) > _HOLE * step)
    longest = max(1, round(_PIECE_S / step))
    for run in np.split(good, np.flatnonzero(hole) + 1):
        for rows in np.array_split(run, max(1, -(-len(run) // longest))):
            if len(rows) * step >= _SHORTEST_S:
                yield rows


def _white(stream: Stream, rows: np.ndarray) -> Array:
    """Return a piece with unit, white noise; with coloured noise without its first samples."""
    piece = stream.residual[rows]
    if not stream.models:
        return np.asarray(piece / stream.noise)
    columns = [model.whitened(column) for model, column in zip(stream.models, piece.T, strict=True)]
    return np.stack(columns, axis=1)[max(model.order for model in stream.models) :]
