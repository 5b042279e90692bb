"""Where the gap lies: parts of the squared residual beyond noise, and which parts aren't noise.

The gap is the excess of the squared whitened residual over the floor. A view cuts it into cells (by
channel, bag, regime, pose, time, frequency, joint); a cell has a share of the excess and a p-value,
corrected for all cells of its view (`energies.py`): that noise and a healthy arm's tolerances give
as much. Where no cell of a view is beyond those its shares are 0: noise has no place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from galen_model.arrays import Array

from galen_diagnosis.answer import views as cut
from galen_diagnosis.answer.bands import band_energies
from galen_diagnosis.answer.energies import (
    DEFAULTS,
    CellSettings,
    Tested,
    block_spread,
    compare_cells,
)
from galen_diagnosis.answer.joint_dependence import Followed, joints_followed
from galen_diagnosis.observation.rows import Rows, Stream

Detail = dict[str, Any]


@dataclass(frozen=True)
class View:
    """K cells. share: of the view's excess; ratio: mean square over the floor; p: corrected."""

    labels: tuple[str, ...]
    details: tuple[Detail, ...]
    share: Array
    ratio: Array
    p: Array
    level: float

    def marked(self) -> np.ndarray:
        """Which cells (K,) are beyond noise."""
        return np.asarray(self.p < self.level)

    def shares(self) -> dict[str, float]:
        """By label."""
        return _numbers(self.labels, self.share)

    def to_list(self) -> list[Detail]:
        """Each cell with what it is."""
        return [
            {**detail, "share": _rounded(share), "ratio": _rounded(ratio), "p": _rounded(p)}
            for detail, share, ratio, p in zip(
                self.details, self.share, self.ratio, self.p, strict=True
            )
        ]


@dataclass(frozen=True)
class Where:
    """All views; `cells`: channels in the regimes of bags, for the picture.

    p: that noise alone gives as much energy in all of the recording, or in one of the cells of
    channels, bags, regimes, poses or times.
    """

    channels: View
    bags: View
    regimes: View
    poses: View
    times: View
    bands: View
    joints: View
    cells: View
    follows: tuple[Followed, ...]
    ratio: float
    p: float
    level: float

    def is_gap(self) -> bool:
        """Whether anything is beyond noise."""
        return self.p < self.level

    def to_json(self) -> Detail:
        """The contract's `where`, with p-values and further views beside."""
        named = {"channels": self.channels, "bags": self.bags, "regimes": self.regimes}
        return {
            **{name: view.shares() for name, view in named.items()},
            "poses": self.poses.to_list(),
            "times": self.times.to_list(),
            "bands": self.bands.to_list(),
            "joints": {
                "follows": [
                    {"joint": one.joint, "part": _rounded(one.part), "p": _rounded(one.p)}
                    for one in self.follows
                ],
                "cells": self.joints.to_list(),
            },
            "cells": self.cells.to_list(),
            "p": {name: _numbers(view.labels, view.p) for name, view in named.items()},
            "ratio": {name: _numbers(view.labels, view.ratio) for name, view in named.items()},
            "whole": {"ratio": _rounded(self.ratio), "p": _rounded(self.p)},
        }


def where(
    rows: Rows,
    residual: Array,
    streams: Sequence[Stream] = (),
    floor: float = 1.0,
    settings: CellSettings = DEFAULTS,
    healthy: Array | None = None,
) -> Where:
    """Where the residual (N,) of rows is beyond noise and a healthy arm's tolerances.

    residual: whitened, what is no gap fitted; streams: the same in time; floor: mean square of
    noise alone. healthy (N, q): how rows change by each of q tolerances of a healthy arm, what is
    no gap projected out; None for an arm that is the nominal one. Frequencies know of noise alone.
    """
    energy = residual**2 / floor
    spread = block_spread(energy, rows.block) if len(rows) else 0.0
    off = None if healthy is None else healthy / np.sqrt(floor)
    look = partial(_view, rows, energy, spread=spread, settings=settings, healthy=off)
    views = {
        "channels": look(cut.by_channel(rows)),
        "bags": look(cut.by_bag(rows)),
        "regimes": look(cut.by_regime(rows)),
        "poses": look(cut.by_pose(rows)),
        "times": look(cut.by_time(rows)),
    }
    everything = np.zeros(len(rows), dtype=int)
    whole = compare_cells(energy, rows.block, everything, 1, settings, spread=spread, healthy=off)
    smallest = [whole.p.min(), *(view.p.min(initial=1.0) for view in views.values())]
    p = min(1.0, float(min(smallest)) * len(smallest))
    bands = _bands(streams, settings)
    if p >= settings.level:
        # Bands know of noise alone: what they mark on a healthy arm are its tolerances.
        bands = replace(bands, share=np.zeros_like(bands.share))
    return Where(
        **views,
        bands=bands,
        joints=look(cut.by_joint(rows)),
        cells=look(cut.by_map(rows)),
        follows=joints_followed(rows, residual, floor),
        ratio=float(whole.ratio[0]),
        p=p,
        level=settings.level,
    )


def picture_cells(
    rows: Rows,
    residual: Array,
    floor: float = 1.0,
    settings: CellSettings = DEFAULTS,
    healthy: Array | None = None,
) -> View:
    """The view `cells` alone."""
    off = None if healthy is None else healthy / np.sqrt(floor)
    energy = residual**2 / floor
    spread = block_spread(energy, rows.block) if len(rows) else 0.0
    return _view(rows, energy, cut.by_map(rows), spread=spread, settings=settings, healthy=off)


def _view(
    rows: Rows,
    energy: Array,
    cells: cut.Cells,
    *,
    spread: float,
    settings: CellSettings,
    healthy: Array | None,
) -> View:
    tested = compare_cells(
        energy[cells.row],
        rows.block[cells.row],
        cells.cell,
        len(cells.labels),
        settings,
        spread=spread,
        healthy=None if healthy is None else healthy[cells.row],
    )
    return _of(cells.labels, cells.details, tested, settings)


def _bands(streams: Sequence[Stream], settings: CellSettings) -> View:
    bands, energy, count, block, cell = band_energies(streams)
    tested = compare_cells(energy, block, cell, len(bands), settings, count=count, spread=0.0)
    labels = tuple(f"{band.bag} {band.group} {hertz(band.from_hz, band.to_hz)}" for band in bands)
    details = tuple(
        {
            "bag": band.bag,
            "group": band.group,
            "from_hz": band.from_hz,
            "to_hz": band.to_hz if np.isfinite(band.to_hz) else None,
        }
        for band in bands
    )
    return _of(labels, details, tested, settings)


def hertz(from_hz: float, to_hz: float | None) -> str:
    """A band in words."""
    if to_hz is None or not np.isfinite(to_hz):
        return f"above {from_hz:g} Hz"
    return f"below {to_hz:g} Hz" if from_hz == 0.0 else f"{from_hz:g} to {to_hz:g} Hz"


def p_words(p: float | None) -> str:
    """A p-value as tables show it; below 0.001 the null wasn't drawn often enough to say more."""
    if p is None:
        return "-"
    return "≤ 0.001" if p <= 0.001 else f"{p:.3f}"


def _of(
    labels: tuple[str, ...], details: tuple[Detail, ...], tested: Tested, settings: CellSettings
) -> View:
    shares = tested.shares(settings.level)
    return View(labels, details, shares, tested.ratio, tested.p, settings.level)


def _numbers(labels: tuple[str, ...], values: Array) -> dict[str, float]:
    return {label: _rounded(value) for label, value in zip(labels, values, strict=True)}


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
