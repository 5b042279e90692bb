"""A residual's energy by frequency, in units of what noise gives.

A stream is cut into pieces without holes, and each piece transformed by the orthonormal DCT-II. Of
white noise all coefficients are independent with the noise's variance, so that a band's energy is
chi-square with as many degrees of freedom as it has coefficients: exact, without windows whose
overlap correlates. Coefficient k of n oscillates at k * rate / (2 n); a trend, which a Fourier
transform smears over all frequencies since the ends don't meet, stays with the first few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from scipy.fft import dct

from galen_diagnosis.observation.rows import MARKER_AXES, TIP_AXES, Stream

BANDS_HZ = (0.0, 0.25, 1.0, 4.0, 16.0, 64.0, np.inf)
"""Edges. The first band is what stays the same over a piece."""
PIECE_S = 4.0
_SHORTEST_S = 0.4
_HOLE = 3.0
"""A step of more than this many median steps is a hole."""

GROUPS = {
    "force": WRENCH_AXES[:3],
    "torque": WRENCH_AXES[3:],
    "tip translation": TIP_AXES[:3],
    "tip rotation": TIP_AXES[3:],
    "base marker": MARKER_AXES,
}


@dataclass(frozen=True)
class Coefficients:
    """Squares of a stream's coefficients over the noise's variance: (n, k), k channels.

    frequency_hz, piece (n,).
    """

    bag: str
    channels: tuple[str, ...]
    frequency_hz: Array
    piece: np.ndarray
    square: Array


@dataclass(frozen=True)
class Band:
    """A cell: frequencies of a group of channels in a bag."""

    bag: str
    group: str
    from_hz: float
    to_hz: float


def group_of(channel: str) -> str:
    """Which of GROUPS a channel belongs to."""
    return next(name for name, channels in GROUPS.items() if channel in channels)


def coefficients(stream: Stream) -> Coefficients:
    """The stream's pieces, transformed. Samples with a NaN in any channel are holes."""
    if len(stream.at_s) < 2:
        return Coefficients(
            stream.bag,
            stream.channels,
            np.zeros(0),
            np.zeros(0, dtype=int),
            np.zeros((0, len(stream.channels))),
        )
    step = float(np.median(np.diff(stream.at_s)))
    frequencies, pieces, squares = [np.zeros(0)], [np.zeros(0, int)], []
    squares.append(np.zeros((0, len(stream.channels))))
    for number, rows in enumerate(_pieces(stream, step)):
        white = _white(stream, rows)
        n = len(white)
        squares.append(dct(white, type=2, norm="ortho", axis=0) ** 2)
        frequencies.append(np.arange(n) / (2.0 * n * step))
        pieces.append(np.full(n, number))
    return Coefficients(
        stream.bag,
        stream.channels,
        np.concatenate(frequencies),
        np.concatenate(pieces),
        np.concatenate(squares),
    )


def _pieces(stream: Stream, step: float) -> Iterator[np.ndarray]:
    good = np.flatnonzero(np.all(np.isfinite(stream.residual), axis=1))
    if not len(good) or step <= 0.0:
        return
    hole = (np.diff(good) > 1) | (np.diff(stream.at_s[good]) > _HOLE * step)
    longest = max(1, round(PIECE_S / step))
    for run in np.split(good, np.flatnonzero(hole) + 1):
        for rows in np.array_split(run, max(1, -(-len(run) // longest))):
            if len(rows) * step >= _SHORTEST_S:
                yield rows


def _white(stream: Stream, rows: np.ndarray) -> Array:
    """A piece with unit, white noise; with coloured noise its first samples are left out."""
    piece = stream.residual[rows]
    if not stream.models:
        return np.asarray(piece / stream.noise)
    columns = [model.whitened(column) for model, column in zip(stream.models, piece.T, strict=True)]
    return np.stack(columns, axis=1)[max(model.order for model in stream.models) :]


def band_energies(
    streams: Sequence[Stream],
) -> tuple[tuple[Band, ...], Array, Array, np.ndarray, np.ndarray]:
    """Energies by piece and band.

    Returns the bands, then energy, count, block and cell (M,) as `compare_cells` takes them; blocks
    are pieces, numbered over all streams.
    """
    bands: list[Band] = []
    energy, count, block, cell = [], [], [], []
    blocks = 0
    for stream in streams:
        known = coefficients(stream)
        which = np.searchsorted(BANDS_HZ, known.frequency_hz, side="right") - 1
        pieces = int(known.piece.max()) + 1 if len(known.piece) else 0
        for group, members in GROUPS.items():
            columns = [k for k, name in enumerate(stream.channels) if name in members]
            if not columns:
                continue
            square = known.square[:, columns].sum(axis=1)
            for index in np.unique(which):
                rows = which == index
                by_piece = np.bincount(known.piece[rows], minlength=pieces)
                there = np.flatnonzero(by_piece)
                energy.append(np.bincount(known.piece[rows], square[rows], pieces)[there])
                count.append(by_piece[there] * float(len(columns)))
                block.append(there + blocks)
                cell.append(np.full(len(there), len(bands)))
                bands.append(Band(stream.bag, group, BANDS_HZ[index], BANDS_HZ[index + 1]))
        blocks += pieces
    if not bands:
        nothing = np.zeros(0)
        return (), nothing, nothing, np.zeros(0, int), np.zeros(0, int)
    return (
        tuple(bands),
        np.concatenate(energy),
        np.concatenate(count),
        np.concatenate(block),
        np.concatenate(cell),
    )


def spectrum(
    streams: Sequence[Stream], bag: str, group: str, bins: int = 20
) -> tuple[Array, Array]:
    """Frequencies (Hz) and mean power over the noise's, in `bins` bins even in the logarithm.

    What stays the same over a piece stands at half the lowest frequency. Empty arrays where nothing
    is known.
    """
    frequency, square = [], []
    for stream in streams:
        columns = [k for k, name in enumerate(stream.channels) if name in GROUPS[group]]
        if stream.bag != bag or not columns:
            continue
        known = coefficients(stream)
        frequency.append(known.frequency_hz)
        square.append(known.square[:, columns].mean(axis=1))
    if not frequency:
        return np.zeros(0), np.zeros(0)
    at_hz, power = np.concatenate(frequency), np.concatenate(square)
    if not np.any(at_hz > 0.0):
        return np.zeros(0), np.zeros(0)
    at_hz[at_hz == 0.0] = 0.5 * at_hz[at_hz > 0.0].min()
    edges = np.geomspace(at_hz.min(), at_hz.max() * 1.0001, bins + 1)
    which = np.digitize(at_hz, edges) - 1
    count = np.bincount(which, minlength=bins)
    there = count > 0
    mean = np.bincount(which, power, bins)[there] / count[there]
    return np.sqrt(edges[1:] * edges[:-1])[there], mean
