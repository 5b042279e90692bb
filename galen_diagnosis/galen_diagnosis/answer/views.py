"""Which cell of a view each row belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_model.arm.galen import JOINT_NAMES

from galen_diagnosis.observation.rows import BAGS, CHANNELS, REGIMES, Rows

TIME_BINS = 12
JOINT_BINS = 6
_NARROW = (1e-3, 1e-3, 1e-3, 5e-3, 5e-3)
"""Joints that move less than this (m, rad) stand still."""
_STILL = (1e-3, 1e-3, 1e-3, 5e-3, 5e-3)
"""m/s, rad/s."""
_ENOUGH_ROWS = 6


@dataclass(frozen=True)
class Cells:
    """A view: row (M,) of Rows in cell (M,); `labels` and what JSON tells of each cell."""

    labels: tuple[str, ...]
    details: tuple[dict[str, Any], ...]
    row: np.ndarray
    cell: np.ndarray


def by_names(index: np.ndarray, names: tuple[str, ...]) -> Cells:
    """Cells of those names that occur, in their order."""
    present, cell = np.unique(index, return_inverse=True)
    labels = tuple(names[number] for number in present)
    return Cells(labels, tuple({} for _ in labels), np.arange(len(index)), cell.ravel())


def by_channel(rows: Rows) -> Cells:
    """Cells are channels."""
    return by_names(rows.channel, CHANNELS)


def by_bag(rows: Rows) -> Cells:
    """Cells are bags."""
    return by_names(rows.bag, BAGS)


def by_regime(rows: Rows) -> Cells:
    """Cells are regimes."""
    return by_names(rows.regime, REGIMES)


def by_map(rows: Rows) -> Cells:
    """Cells are channels in each regime of each bag: the picture's."""
    shape = (len(BAGS), len(REGIMES), len(CHANNELS))
    keys = np.ravel_multi_index((rows.bag, rows.regime, rows.channel), shape)
    present, cell = np.unique(keys, return_inverse=True)
    labels: list[str] = []
    details: list[dict[str, Any]] = []
    for bag, regime, channel in zip(*np.unravel_index(present, shape), strict=True):
        labels.append(f"{CHANNELS[channel]}, {BAGS[bag]} {REGIMES[regime]}")
        details.append({"channel": CHANNELS[channel], "bag": BAGS[bag], "regime": REGIMES[regime]})
    return Cells(tuple(labels), tuple(details), np.arange(len(rows)), cell.ravel())


def by_pose(rows: Rows) -> Cells:
    """Cells are the sweep's still poses and the arm's positions among the pushes."""
    row = np.flatnonzero(rows.pose >= 0)
    poses = int(rows.pose.max(initial=0)) + 1
    present, cell = np.unique(rows.bag[row] * poses + rows.pose[row], return_inverse=True)
    labels: list[str] = []
    details: list[dict[str, Any]] = []
    for number, (bag, pose) in enumerate(zip(present // poses, present % poses, strict=True)):
        joints = np.median(rows.joints[row[cell.ravel() == number]], axis=0)
        labels.append(f"{BAGS[bag]} {'pose' if BAGS[bag] == 'sweep' else 'position'} {pose}")
        details.append(
            {
                "bag": BAGS[bag],
                "pose": int(pose),
                "joints": {
                    name: round(float(q), 5) for name, q in zip(JOINT_NAMES, joints, strict=True)
                },
            }
        )
    return Cells(tuple(labels), tuple(details), row, cell.ravel())


def by_time(rows: Rows) -> Cells:
    """Cells are TIME_BINS equal spans of each bag."""
    row: list[np.ndarray] = []
    cell: list[np.ndarray] = []
    labels: list[str] = []
    details: list[dict[str, Any]] = []
    for bag in np.unique(rows.bag):
        own = np.flatnonzero(rows.bag == bag)
        at_s = rows.bag_s[own]
        edges = np.linspace(at_s.min(), at_s.max() + 1e-9, TIME_BINS + 1)
        which = np.clip(np.searchsorted(edges, at_s, side="right") - 1, 0, TIME_BINS - 1)
        for number in np.unique(which):
            start, end = float(edges[number]), float(edges[number + 1])
            own_rows = own[which == number]
            row.append(own_rows)
            cell.append(np.full(len(own_rows), len(labels)))
            labels.append(f"{BAGS[bag]} {start:.0f} to {end:.0f} s")
            details.append({"bag": BAGS[bag], "from_s": round(start, 3), "to_s": round(end, 3)})
    return Cells(tuple(labels), tuple(details), _joined(row), _joined(cell))


def by_joint(rows: Rows) -> Cells:
    """Cells are ranges of each joint, and its directions of motion; a row is in several."""
    row: list[np.ndarray] = []
    cell: list[np.ndarray] = []
    labels: list[str] = []
    details: list[dict[str, Any]] = []

    def add(rows_in: np.ndarray, label: str, detail: dict[str, Any]) -> None:
        if len(rows_in) >= _ENOUGH_ROWS:
            row.append(rows_in)
            cell.append(np.full(len(rows_in), len(labels)))
            labels.append(label)
            details.append(detail)

    for joint, name in enumerate(JOINT_NAMES):
        bins, edges = joint_bins(rows, joint)
        for number in range(len(edges) - 1):
            start, end = float(edges[number]), float(edges[number + 1])
            add(
                np.flatnonzero(bins == number),
                f"{name} {start:.2f} to {end:.2f}",
                {"joint": name, "from": round(start, 5), "to": round(end, 5)},
            )
        rate = rows.rate[:, joint]
        for sign, word in ((1.0, "+"), (-1.0, "-")):
            moving = np.flatnonzero(sign * rate > _STILL[joint])
            add(moving, f"{name} moving {word}", {"joint": name, "direction": word})
    return Cells(tuple(labels), tuple(details), _joined(row), _joined(cell))


def joint_bins(rows: Rows, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of JOINT_BINS equal ranges each row's joint is in, and their edges.

    Without edges, and -1 for all, where the joint stands still.
    """
    values = rows.joints[:, joint]
    if not len(values) or np.ptp(values) < _NARROW[joint]:
        return np.full(len(values), -1), np.zeros(0)
    edges = np.linspace(values.min(), values.max(), JOINT_BINS + 1)
    inside = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, JOINT_BINS - 1)
    return inside, edges


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype=int), *parts])
