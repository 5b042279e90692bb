# SPDX-License-Identifier: Apache-2.0
"""Pictures of a diagnosis: the residual with what was found, and where the residual lies."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle
from matplotlib.ticker import PercentFormatter

from galen_diagnosis.answer.answer import RESIDUAL, Answer, BudgetItem, Diagnosis, Interval
from galen_diagnosis.answer.localization import (
    LEVEL,
    by_regime_of_bag,
    cell_scores,
)
from galen_diagnosis.observation.rows import BAGS, CHANNELS, REGIMES, group_of
from galen_diagnosis.report.words import title

_STANDINGS = {"within": "#009e73", "undecided": "#e69f00", "beyond": "#d55e00"}
_OTHER = "0.6"
_LEAST_RATIO = 0.01
_MEASURED, _FOUND, _LEFT = "0.35", "#0072b2", "#e69f00"
_POINTS = 180
_PANELS = 2
_UNITS = {
    "force": (1e3, "mN"),
    "torque": (1e3, "mN.m"),
    "tip translation": (1e6, "µm"),
    "tip rotation": (1e3, "mrad"),
    "base marker": (1e3, "mm, mrad"),
}
_MAP = "YlOrBr"
_STATES = ("before", "after")
_LEAST_TOP = 3.0
_DARK = 0.55
"""Beyond this part of the colours' range, text is white."""


def write_pictures(diagnosis: Diagnosis, folder: Path) -> dict[str, Path]:
    """Write all pictures that the recording has data for.

    Args:
        diagnosis: The answer and the residuals behind it.
        folder: Where the PNG files go.

    Returns:
        Files by name: `budget`, `answer`, `gap`.

    """
    written = {}
    if diagnosis.answer.budget:
        written["budget"] = save_figure(budget_figure(diagnosis.answer), folder / "budget.png")
    if diagnosis.streams_before:
        written["answer"] = save_figure(answer_figure(diagnosis), folder / "answer.png")
    written["gap"] = save_figure(gap_figure(diagnosis), folder / "gap.png")
    return written


# What the gap is made of


def budget_figure(answer: Answer) -> plt.Figure:
    """Draw the gap from the whole down to the noise, a bar an effect, and numbers over limits.

    Args:
        answer: One with a budget.

    Returns:
        The figure.

    """
    items = sorted(answer.budget, key=lambda one: (one.label == RESIDUAL, -one.share.value))
    figure, (bars, sizes) = plt.subplots(
        1, 2, figsize=(11, 1.5 + 0.42 * len(items)), sharey=True, width_ratios=(3, 2)
    )
    above = 1.0
    for row, one in enumerate(items):
        colour = _STANDINGS.get(one.standing or "", _OTHER)
        share = one.share
        bars.barh(row, share.value, left=above - share.value, color=colour, height=0.62)
        above -= share.value
        if row + 1 < len(items):
            bars.plot([above, above], [row - 0.31, row + 1.31], color="0.5", lw=0.8)
        bars.text(1.02, row, f"{share.value:.1%}", va="center", fontsize=9)
        for number, limit in _limited(one):
            low, high = (0.0 if end is None else end for end in number[1:])
            ends = np.abs([low, high]) / limit
            reach = (0.0 if low * high < 0.0 else ends.min(), ends.max())
            sizes.plot(np.maximum(reach, _LEAST_RATIO), [row, row], color=colour, lw=1.6)
            sizes.plot(max(abs(number.value) / limit, _LEAST_RATIO), row, "o", color=colour, ms=5)
    bars.set_yticks(range(len(items)), [_budget_title(one) for one in items])
    bars.invert_yaxis()
    bars.axvline(0.0, color="black", lw=0.8)
    bars.set_xlabel("share of the whole gap: 0 is the noise floor")
    bars.xaxis.set_major_formatter(PercentFormatter(1.0))
    bars.set_xlim(min(0.0, above) - 0.02, 1.13)
    sizes.set_xscale("log")
    sizes.axvline(1.0, color="black", lw=1.2)
    sizes.set_xlabel("size in units of its limit, with 95 % interval")
    sizes.set_xlim(_LEAST_RATIO, max(10.0, 1.5 * sizes.get_xlim()[1]))
    sizes.grid(axis="x", color="0.92")
    sizes.set_axisbelow(True)
    names = [plt.Line2D([], [], color=c, lw=5, label=n) for n, c in _STANDINGS.items()]
    names.append(plt.Line2D([], [], color=_OTHER, lw=5, label="no limit, or no effect"))
    figure.legend(handles=names, loc="upper right", ncol=4, fontsize=9, frameon=False)
    _margins(figure, 2.6, 0.2, 0.55, 0.55, 0.06)
    return figure


def _budget_title(one: BudgetItem) -> str:
    name = "residual" if one.label == RESIDUAL else title(one.label)
    ends = [str(one.parameters[end]) for end in ("from", "to") if end in one.parameters]
    return f"{name}, {' to '.join(ends)}" if ends else name


def _limited(one: BudgetItem) -> Iterator[tuple[Interval, float]]:
    """Yield an effect's limited numbers, each with its limit."""
    for name, limit in one.limits.items():
        value = one.parameters[name]
        numbers = [value] if isinstance(value, Interval) else value
        limits = limit if isinstance(limit, list) else [limit] * len(numbers)
        yield from zip(numbers, limits, strict=True)


# Where


def gap_figure(diagnosis: Diagnosis) -> plt.Figure:
    """Draw the RMS residual over the noise: channels by regimes of bags, before and after.

    A black frame marks a cell beyond noise and a healthy arm's tolerances (p < 0.05, corrected for
    all cells of the map).

    Args:
        diagnosis: Its held-out residuals are drawn.

    Returns:
        The figure.

    """
    view = by_regime_of_bag(diagnosis.rows)
    residuals = (diagnosis.held_out_before, diagnosis.held_out_after)
    cells = [
        cell_scores(diagnosis.rows, residual, view, diagnosis.floor, diagnosis.healthy)
        for residual in residuals
    ]
    channels = sorted({one["channel"] for one in view.details}, key=CHANNELS.index)
    columns = sorted(
        {(one["bag"], one["regime"]) for one in view.details},
        key=lambda one: (BAGS.index(one[0]), REGIMES.index(one[1])),
    )
    top = max(_LEAST_TOP, *(float(np.sqrt(ratio).max(initial=1.0)) for _, ratio, _ in cells))
    size = (4.0 + 0.85 * len(columns), 1.9 + 0.33 * len(channels))
    figure, axes = plt.subplots(1, 2, figsize=size, sharey=True)
    for axis, (_, ratio, p), state, residual in zip(axes, cells, _STATES, residuals, strict=True):
        rms = np.sqrt(np.mean(residual**2) / diagnosis.floor) if len(residual) else np.nan
        values = np.full((len(channels), len(columns)), np.nan)
        marked = np.zeros(values.shape, dtype=bool)
        for one, square, chance in zip(view.details, ratio, p, strict=True):
            at = channels.index(one["channel"]), columns.index((one["bag"], one["regime"]))
            values[at], marked[at] = np.sqrt(square), chance < LEVEL
        _draw_cells(axis, values, marked, LogNorm(1.0, top))
        axis.set_title(f"{state}: {rms:.2f} × noise", fontsize=12)
        of_table = bool(diagnosis.rows.labels)
        names = ["readings"] if of_table else [f"{bag}\n{regime}" for bag, regime in columns]
        axis.set_xticks(range(len(columns)), names, fontsize=8, rotation=45)
        for row in range(1, len(channels)):
            if group_of(channels[row]) != group_of(channels[row - 1]):
                axis.axhline(row - 0.5, color="white", lw=3)
    axes[0].set_yticks(range(len(channels)), channels)
    _margins(figure, 0.5, 0.1, 0.95, 0.35, 0.04)
    return figure


def _draw_cells(axis: plt.Axes, values: Array, marked: np.ndarray, norm: LogNorm) -> None:
    """Draw values (rows, columns) as colours and numbers; NaN is grey, what is marked framed."""
    axis.set_facecolor("0.9")
    axis.imshow(np.clip(values, norm.vmin, None), norm=norm, cmap=_MAP, aspect="auto")
    for row, column in np.argwhere(np.isfinite(values)):
        value, bold = values[row, column], marked[row, column]
        dark = norm(max(value, 1.0)) > _DARK
        colour = "white" if dark else "black" if bold else "0.55"
        text = f"{value:.1f}" if value < 99.5 else f"{value:.0f}"
        weight = "bold" if bold else "normal"
        axis.text(column, row, text, ha="center", va="center", size=8, color=colour, weight=weight)
        if bold:
            place = (column - 0.46, row - 0.44)
            axis.add_patch(Rectangle(place, 0.92, 0.88, fill=False, ec="black", lw=1.4))


# The residual with what was found


def answer_figure(diagnosis: Diagnosis) -> plt.Figure:
    """Draw the channels in which what was found is clearest, else those that are furthest off.

    Measured less nominal, what was found adds to nominal, and what it leaves, in time.

    Args:
        diagnosis: One with streams.

    Returns:
        The figure.

    """
    panels = _clearest(diagnosis)
    figure, axes = plt.subplots(
        len(panels), 1, figsize=(10, 2.6 * len(panels) + 0.5), squeeze=False
    )
    for axis, (channel, bag, at_s, before, after, noise) in zip(axes[:, 0], panels, strict=True):
        factor, unit = _UNITS[group_of(channel)]
        band = 2.0 * noise * factor
        axis.fill_between(at_s, -band, band, color="0.88", lw=0, step="mid", label="± 2 σ of noise")
        axis.plot(at_s, before * factor, ".", color=_MEASURED, ms=5, label="measured less nominal")
        if diagnosis.effects:
            added = (before - after) * factor
            axis.plot(at_s, added, color=_FOUND, lw=1.8, label="what was found adds to nominal")
            axis.plot(at_s, after * factor, ".", color=_LEFT, ms=3, label="residual with it")
        axis.set_title(f"{bag}: {group_of(channel)}, {channel}", fontsize=11, loc="left")
        axis.set_ylabel(unit)
        axis.margins(x=0.01)
    axes[0, 0].legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=4, fontsize=9, frameon=False
    )
    axes[-1, 0].set_xlabel("time in the bag, s")
    _margins(figure, 0.8, 0.15, 0.5, 0.4, 0.35)
    return figure


_Panel = tuple[str, str, Array, Array, Array, Array]
"""Channel, bag, times, means before and after, noise of a mean: each of _POINTS spans."""


def _clearest(diagnosis: Diagnosis) -> list[_Panel]:
    """Return the clearest channel of each of the clearest streams."""
    best: list[tuple[float, _Panel]] = []
    for before, after in zip(diagnosis.streams_before, diagnosis.streams_after, strict=True):
        at_s, means, samples = _averaged(before.at_s, before.residual)
        left = _averaged(after.at_s, after.residual)[1]
        # A span that is mostly a move shows next to nothing.
        means[samples < 0.5 * np.median(samples[samples > 0])] = np.nan
        noise = before.noise / np.sqrt(np.where(np.isnan(means), np.nan, samples[:, None]))
        shown = means - left if diagnosis.effects else means
        energy = np.nansum((shown / noise) ** 2, axis=0)
        k = int(np.argmax(energy))
        panel = (before.channels[k], before.bag, at_s, means[:, k], left[:, k], noise[:, k])
        best.append((float(energy[k]), panel))
    best.sort(key=lambda one: -one[0])
    return [panel for _, panel in best[:_PANELS]]


def _averaged(at_s: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return times, means (m, k) and samples of _POINTS even spans; NaN where there is nothing."""
    span_s = (at_s[-1] - at_s[0]) / _POINTS if len(at_s) else 1.0
    which = np.minimum(((at_s - at_s[0]) / max(span_s, 1e-9)).astype(int), _POINTS - 1)
    good = np.isfinite(values).all(axis=1)
    samples = np.bincount(which[good], minlength=_POINTS).astype(float)
    mean = np.full((_POINTS, values.shape[1]), np.nan)
    there = samples > 0
    for k, column in enumerate(values.T):
        sums = np.bincount(which[good], column[good], _POINTS)
        mean[there, k] = sums[there] / samples[there]
    return at_s[0] + (np.arange(_POINTS) + 0.5) * span_s, mean, samples


def _margins(
    figure: plt.Figure, left: float, right: float, bottom: float, top: float, between: float
) -> None:
    """Set margins in inches: matplotlib's own layouts draw everything twice to find them.

    between: panels, over their own size.
    """
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left / width, bottom / height, 1.0 - right / width, 1.0 - top / height, between, between
    )
