"""Pictures of a report.

Pictures of a diagnosis: where the gap is, before and after on the same scale.

The residual in time, before and after on the same scale, with the noise's band.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # a lab's machine over ssh has no display
import matplotlib.pyplot as plt
import numpy as np
from galen_model.arrays import Array
from galen_model.files.atomic_file import save_figure
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle

from galen_diagnosis.answer.answer import Diagnosis
from galen_diagnosis.answer.bands import GROUPS, group_of, spectrum
from galen_diagnosis.answer.localization import View, picture_cells
from galen_diagnosis.observation.rows import BAGS, CHANNELS, REGIMES, Rows, Stream

BEFORE, AFTER = "#d55e00", "#0072b2"
"""Okabe and Ito's: told apart by colour-blind people too."""
_AXES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#000000")
_POINTS = 180
_UNITS = {
    "force": (1e3, "mN"),
    "torque": (1e3, "mN.m"),
    "tip translation": (1e6, "µm"),
    "tip rotation": (1e6, "µrad"),
}
_BEYOND = 1.15
_MAP = "YlOrBr"
_STATES = ("before", "after")
_LEAST_TOP = 3.0
_TICKS = (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000)
_DARK = 0.55
"""Beyond this part of the colours' range, text is white."""
_MOST_TEXTS = 14
"""With more columns than this, numbers don't fit."""


def write_pictures(diagnosis: Diagnosis, folder: Path) -> dict[str, Path]:
    """Write all pictures that the recording has data for; their names to their files."""
    written = {"gap": save_figure(gap_figure(diagnosis), folder / "gap.png")}
    sweep = sweep_figure(diagnosis)
    if sweep is not None:
        written["sweep"] = save_figure(sweep, folder / "sweep.png")
    if diagnosis.streams_before:
        written["time"] = save_figure(draw_times(diagnosis), folder / "time.png")
        written["spectra"] = save_figure(spectra_figure(diagnosis), folder / "spectra.png")
    return written


# --- the one picture ------------------------------------------------------------------------------


def gap_figure(diagnosis: Diagnosis) -> plt.Figure:
    """RMS residual over the noise: channels by regimes of bags, before and after.

    A black frame marks a cell beyond noise and a healthy arm's tolerances (p < 0.05, corrected for
    all cells of the map).
    """
    views = [
        picture_cells(diagnosis.rows, residual, diagnosis.floor, healthy=diagnosis.healthy)
        for residual in (diagnosis.held_out_before, diagnosis.held_out_after)
    ]
    channels = [name for name in CHANNELS if any(d["channel"] == name for d in views[0].details)]
    columns = _columns(views[0])
    top = max(_LEAST_TOP, *(float(np.sqrt(view.ratio).max(initial=1.0)) for view in views))
    height = 2.3 + 0.33 * len(channels)
    figure, axes = plt.subplots(1, 2, figsize=(4.0 + 1.05 * len(columns), height), sharey=True)
    norm = LogNorm(1.0, top)
    for axis, view, state, residual in zip(
        axes,
        views,
        _STATES,
        (diagnosis.held_out_before, diagnosis.held_out_after),
        strict=True,
    ):
        rms = np.sqrt(np.mean(residual**2) / diagnosis.floor) if len(residual) else np.nan
        _draw_cells(axis, view, channels, columns, norm)
        axis.set_title(f"{state}: {rms:.2f} × noise over all", fontsize=12)
    axes[0].set_yticks(range(len(channels)), channels)
    margins(figure, 0.95, 1.1, 0.95, 0.95, between_x=0.04)
    _name_groups(axes[0], channels)
    _colour_bar(figure, plt.cm.ScalarMappable(norm=norm, cmap=_MAP), top)
    figure.suptitle(_headline(diagnosis), fontsize=11)
    return figure


def _headline(diagnosis: Diagnosis) -> str:
    answer = diagnosis.answer
    causes = " + ".join(cause.label for cause in answer.causes)
    text = answer.verdict if not causes else f"{answer.verdict}: {causes}"
    closed = answer.gap.get("closed_fraction") or {}
    if closed.get("value") is not None:
        text += f"; {closed['value']:.0%} of the gap closed"
    return f"{text}\nframed: beyond noise and tolerances (p < 0.05, corrected for all cells)"


def _name_groups(axis: plt.Axes, channels: Sequence[str]) -> None:
    """The channels' groups, left of their names."""
    for group in dict.fromkeys(map(group_of, channels)):
        rows = [row for row, name in enumerate(channels) if group_of(name) == group]
        axis.annotate(
            group.replace(" ", "\n"),
            (0.0, float(np.mean(rows))),
            xycoords=("axes fraction", "data"),
            xytext=(-46, 0),
            textcoords="offset points",
            rotation=90,
            ha="center",
            va="center",
            fontsize=9,
            color="0.35",
        )


def _colour_bar(figure: plt.Figure, mappable: plt.cm.ScalarMappable, top: float) -> None:
    """At the right rim, which `margins` left free."""
    width, _ = figure.get_size_inches()
    inside = figure.subplotpars
    place = (1.0 - 0.95 / width, inside.bottom, 0.22 / width, inside.top - inside.bottom)
    bar = figure.colorbar(mappable, cax=figure.add_axes(place))
    ticks = [tick for tick in _TICKS if tick <= top]
    bar.set_ticks(ticks, labels=[str(tick) for tick in ticks])
    bar.ax.minorticks_off()
    bar.set_label("RMS residual over noise (1: noise alone)")


def _columns(view: View) -> list[tuple[str, str]]:
    there = {(detail["bag"], detail["regime"]) for detail in view.details}
    return sorted(there, key=lambda one: (BAGS.index(one[0]), REGIMES.index(one[1])))


def _draw_cells(
    axis: plt.Axes,
    view: View,
    channels: Sequence[str],
    columns: Sequence[tuple[str, str]],
    norm: LogNorm,
) -> None:
    values = np.full((len(channels), len(columns)), np.nan)
    marked = np.zeros(values.shape, dtype=bool)
    for detail, ratio, p in zip(view.details, view.ratio, view.p, strict=True):
        at = channels.index(detail["channel"]), columns.index((detail["bag"], detail["regime"]))
        values[at] = np.sqrt(ratio)
        marked[at] = p < view.level
    axis.set_facecolor("0.9")
    axis.imshow(np.clip(values, norm.vmin, None), norm=norm, cmap=_MAP, aspect="auto")
    for row, column in np.argwhere(np.isfinite(values)):
        value = values[row, column]
        dark = norm(max(value, 1.0)) > _DARK
        if len(columns) <= _MOST_TEXTS:
            axis.text(
                column,
                row,
                f"{value:.1f}" if value < 99.5 else f"{value:.0f}",
                ha="center",
                va="center",
                fontsize=8,
                color="white" if dark else "black" if marked[row, column] else "0.55",
                fontweight="bold" if marked[row, column] else "normal",
            )
        if marked[row, column]:
            axis.add_patch(
                Rectangle((column - 0.46, row - 0.44), 0.92, 0.88, fill=False, ec="black", lw=1.4)
            )
    axis.set_xticks(
        range(len(columns)),
        [f"{bag}\n{regime}" for bag, regime in columns],
        fontsize=8,
        rotation=0 if len(columns) <= 4 else 45,
        ha="center" if len(columns) <= 4 else "right",
        rotation_mode="anchor" if len(columns) > 4 else "default",
    )
    _separate(axis, channels, columns)


def _separate(axis: plt.Axes, channels: Sequence[str], columns: Sequence[tuple[str, str]]) -> None:
    """Lines between groups of channels and between bags."""
    for row in range(1, len(channels)):
        if group_of(channels[row]) != group_of(channels[row - 1]):
            axis.axhline(row - 0.5, color="white", lw=3)
    for column in range(1, len(columns)):
        if columns[column][0] != columns[column - 1][0]:
            axis.axvline(column - 0.5, color="white", lw=3)


# --- the sweep ------------------------------------------------------------------------------------


def sweep_figure(diagnosis: Diagnosis) -> plt.Figure | None:
    """RMS residual at each pose over roll and tilt; None without poses of a sweep."""
    maps = [
        _pose_map(diagnosis.rows, residual, diagnosis.floor)
        for residual in (diagnosis.held_out_before, diagnosis.held_out_after)
    ]
    if not len(maps[0]):
        return None
    top = max(_LEAST_TOP, *(float(one[:, 2:].max()) for one in maps))
    norm = LogNorm(1.0, top)
    figure, axes = plt.subplots(2, 2, figsize=(9.5, 6.6), sharex=True, sharey=True)
    for column, (state, values) in enumerate(zip(_STATES, maps, strict=True)):
        for row, group in enumerate(("force", "torque")):
            axis = axes[row, column]
            shown = axis.scatter(
                np.degrees(values[:, 0]),
                np.degrees(values[:, 1]),
                c=np.clip(values[:, 2 + row], 1.0, None),
                cmap=_MAP,
                norm=norm,
                s=330,
                marker="s",
                edgecolors="0.5",
                linewidths=0.5,
            )
            axis.set_title(f"{group}, {state}", fontsize=11)
            axis.margins(0.09)
    for axis in axes[-1]:
        axis.set_xlabel("roll, °")
    for axis in axes[:, 0]:
        axis.set_ylabel("tilt, °")
    margins(figure, 0.75, 1.1, 0.6, 0.4, between_x=0.06, between_y=0.18)
    _colour_bar(figure, shown, top)
    return figure


def _pose_map(rows: Rows, residual: Array, floor: float) -> Array:
    """Roll, tilt, RMS of force and of torque over the noise at each pose of the sweep."""
    found = []
    in_sweep = (rows.bag == BAGS.index("sweep")) & (rows.pose >= 0)
    for pose in np.unique(rows.pose[in_sweep]):
        own = in_sweep & (rows.pose == pose)
        parts = [own & (rows.channel // 3 == kind) for kind in (0, 1)]
        if not all(part.any() for part in parts):
            continue
        roll, tilt = np.median(rows.joints[own, 3:], axis=0)
        rms = [float(np.sqrt(np.mean(residual[part] ** 2) / floor)) for part in parts]
        found.append([roll, tilt, *rms])
    return np.array(found).reshape(-1, 4)


# --- frequency ------------------------------------------------------------------------------------


def spectra_figure(diagnosis: Diagnosis) -> plt.Figure:
    """Power over the noise's by frequency: a panel for each bag and group of channels."""
    panels = stream_panels(diagnosis)
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(4.3 * columns, 2.9 * lines + 0.3),
        squeeze=False,
        sharey=True,
    )
    for axis, (bag, group) in zip(axes.flat, panels, strict=False):
        for streams, colour, state, style in (
            (diagnosis.streams_before, BEFORE, "before", "-"),
            (diagnosis.streams_after, AFTER, "after", "--"),
        ):
            at_hz, power = spectrum(streams, bag, group)
            axis.loglog(at_hz, power, style, color=colour, lw=1.8, marker="o", ms=3, label=state)
        axis.axhline(1.0, color="0.4", lw=1.0, ls=":", label="noise")
        axis.minorticks_off()  # they take longer than all the rest
        axis.set_title(f"{bag}: {group}", fontsize=10)
        axis.set_xlabel("frequency, Hz (first point: constant)")
    for axis in axes[:, 0]:
        axis.set_ylabel("power over the noise's")
    for axis in list(axes.flat)[len(panels) :]:
        axis.set_visible(False)
    axes[0, 0].legend(frameon=False, fontsize=9)
    margins(figure, 0.75, 0.15, 0.55, 0.35, between_x=0.08, between_y=0.42)
    return figure


def stream_panels(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Bags and groups of channels that have streams, in order."""
    there = {
        (stream.bag, group_of(channel))
        for stream in diagnosis.streams_before
        for channel in stream.channels
    }
    order = list(GROUPS)
    return sorted(there, key=lambda one: (BAGS.index(one[0]), order.index(one[1])))


def draw_times(diagnosis: Diagnosis) -> plt.Figure:
    """A line of panels for each bag and group of channels: before on the left, after right."""
    lines = list(_lines(diagnosis))
    figure, axes = plt.subplots(
        len(lines),
        2,
        figsize=(13, 1.75 * len(lines) + 0.4),
        squeeze=False,
        sharey="row",
    )
    for row, (bag, group, before, after) in enumerate(lines):
        factor, unit = _UNITS[group]
        top = 0.0
        for axis, streams, state in zip(
            axes[row], (before, after), ("before", "after"), strict=True
        ):
            top = max(top, _draw(axis, streams, group, factor))
            axis.set_title(f"{bag}: {group}, {state}", fontsize=9, loc="left")
            axis.margins(x=0.01)
        axes[row, 0].set_ylim(-_BEYOND * top, _BEYOND * top)
        axes[row, 0].set_ylabel(unit)
        axes[row, 0].legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.97), ncol=3, fontsize=8, frameon=False
        )
    for axis in axes[-1]:
        axis.set_xlabel("time in the bag, s (grey: ± 2 σ of the noise of a point)")
    margins(figure, 0.9, 0.15, 0.5, 0.3, between_x=0.05, between_y=0.5)
    return figure


def margins(
    figure: plt.Figure,
    left: float,
    right: float,
    bottom: float,
    top: float,
    between_x: float = 0.2,
    between_y: float = 0.2,
) -> None:
    """Set margins in inches: matplotlib's own layouts draw everything twice to find them.

    between_x, between_y: of panels, over their own size.
    """
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        wspace=between_x,
        hspace=between_y,
    )


def _lines(
    diagnosis: Diagnosis,
) -> Iterator[tuple[str, str, list[Stream], list[Stream]]]:
    bags = list(dict.fromkeys(stream.bag for stream in diagnosis.streams_before))
    for bag in bags:
        for group in GROUPS:
            if group not in _UNITS:
                continue
            before, after = (
                [
                    stream
                    for stream in streams
                    if stream.bag == bag and any(group_of(c) == group for c in stream.channels)
                ]
                for streams in (diagnosis.streams_before, diagnosis.streams_after)
            )
            if before:
                yield bag, group, before, after


def _draw(axis: plt.Axes, streams: Sequence[Stream], group: str, factor: float) -> float:
    """Draw means over even spans of time; returns the largest value, the band's at least."""
    top = 0.0
    for stream in streams:
        columns = [k for k, name in enumerate(stream.channels) if name in GROUPS[group]]
        at_s, mean, samples = _averaged(stream.at_s, stream.residual[:, columns])
        # One band for all axes: the widest.
        band = 2.0 * stream.noise[columns].max() * factor / np.sqrt(np.maximum(samples, 1))
        band[samples == 0] = np.nan
        axis.fill_between(at_s, -band, band, color="0.82", lw=0, step="mid")
        for colour, k, values in zip(_AXES, columns, mean.T, strict=False):
            axis.plot(
                at_s,
                values * factor,
                color=colour,
                lw=1.0,
                marker=".",
                ms=2.5,
                label=stream.channels[k],
            )
        shown = np.concatenate([np.abs(mean).ravel() * factor, band])
        top = max(top, float(np.nanmax(shown, initial=0.0)))
    axis.axhline(0.0, color="black", lw=0.5)
    return top


def _averaged(at_s: Array, values: Array) -> tuple[Array, Array, Array]:
    """Times, means (m, k) and samples of _POINTS even spans; NaN where there is nothing."""
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
