# SPDX-License-Identifier: Apache-2.0
"""A long recording without contact as one series of time bins; spans with contact are left out.

Samples are reduced to cells of a second on the way in, so that three days at 500 Hz (130 million)
need memory for 260 thousand cells. The weight is subtracted with a calibration file, if given, at
poses at which the arm was at rest; without one, only cells at the pose where the arm stood
longest are kept, because the weight turns with the sensor.

Cells that lie far from the median of their neighbourhood (`_WINDOW_CELLS`), in units of how far
cells of this recording lie from it (median absolute deviation), or that scatter within far more
than the recording's do, are contact: left out with those beside them. A level that jumps and
stays is kept, and reported as a step; contact that is steady for longer than half the window looks
like two steps.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_bags.arrays.arm_recording import (
    JOINT_STATE_TYPE,
    WRENCH_TYPE,
    ArmTopics,
    Decoder,
    find_topic,
)
from galen_bags.arrays.tables import read_text_table
from galen_bags.formats.bag import Bag, open_bag
from galen_bags.formats.errors import BagError
from galen_model.arm.arm import Arm
from galen_model.arm.galen import WRENCH_AXES
from galen_model.arrays import Array
from galen_model.errors import GalenError
from galen_model.files.calibration_file import CalibrationFile
from galen_model.rest.binned import CellReducer, Cells

CELL_S = 1.0
_WINDOW_CELLS = 600
_TOUCH_SIGMAS = 8.0
_STEP_CELLS = 60
_STEP_SIGMAS = 10.0
_BESIDE = 3
_MAD_TO_STD = 1.4826
_POSE_RAD = 2e-3
_FEWEST_CELLS = 60
_FEWEST_IN_CELL = 10
_MOST_CELLS = 5_000_000  # 58 days of seconds, 2 GB
_MOST_TABLE_S = 9e9  # of nanoseconds that int64 holds
OnProgress = Callable[[int, int | None], None]
TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat")


@dataclass(frozen=True)
class DriftSeries:
    """A reading (n, 6), N and N.m, one row each `cell_s`, NaN where it is not known or left out.

    noise (6,): standard deviation of one sample about its kept cell's mean; samples: how many there
    were. contact_s: spans (begin, end), s from the start, left out for contact; steps: (time in s,
    change (6,)) of levels that jump and stay. notes: in words.
    """

    reading: Array
    cell_s: float
    noise: Array
    samples: int
    contact_s: tuple[tuple[float, float], ...]
    steps: tuple[tuple[float, Array], ...]
    notes: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """From the first to the last cell, s."""
        return len(self.reading) * self.cell_s

    def every(self, cell_s: float) -> Array:
        """Return means over longer times.

        Args:
            cell_s: a multiple of the series' own `cell_s`, s.

        Returns:
            (m, 6), N and N.m; NaN where less than half is there.

        """
        group = max(1, round(cell_s / self.cell_s))
        count = len(self.reading) // group
        rows = self.reading[: count * group].reshape(count, group, 6)
        there = np.isfinite(rows)
        total = np.where(there, rows, 0.0).sum(axis=1)
        number = there.sum(axis=1)
        mean = total / np.maximum(number, 1)
        return np.where(2 * number >= group, mean, np.nan)


def read_series(
    paths: Sequence[Path],
    topics: ArmTopics,
    tool: CalibrationFile | None = None,
    columns: Sequence[str] | None = None,
    cell_s: float = CELL_S,
    on_progress: OnProgress | None = None,
    *,
    arm: Arm,
) -> DriftSeries:
    """Read bags, or tables of t, fx ... tz, on one clock.

    Args:
        paths: the files, in the order of their times.
        topics: where the wrench and the joints are in a bag; one without joints will do without
            `tool`.
        tool: calibration, whose weight is subtracted; None: only the pose is kept at which the arm
            stood longest.
        columns: names of a table's columns where it has no first line of names; None: it has.
        cell_s: length of a cell, s.
        on_progress: called with a bag's messages done so far and their number, None where that is
            not known.
        arm: the arm that was recorded.

    Returns:
        The series, in the sensor's frame.

    Raises:
        GalenError: a file can't be used, the stamps jump back, or too little is left.

    """
    wrenches, joints = CellReducer(cell_s), CellReducer(cell_s)
    for path in paths:
        if path.suffix in TEXT_SUFFIXES:
            stamp_ns, wrench = _table(path, columns)
            wrenches.add(stamp_ns, wrench, np.zeros((len(wrench), len(arm.turning))))
        else:
            with open_bag(path) as bag:
                _read_bag(bag, topics, wrenches, joints, on_progress, arm)
    cells = wrenches.finish()
    name = ", ".join(str(path) for path in paths)
    if not len(cells):
        raise GalenError(f"{name}: no wrench in it")
    if np.any(np.diff(cells.start_ns) < 0):
        raise GalenError(f"{name}: the stamps jump back; are the recordings in order?")
    return series_of(name, cells, joints.finish(), tool)


def _table(path: Path, columns: Sequence[str] | None) -> tuple[np.ndarray, Array]:
    text = read_text_table(path, {"t", *WRENCH_AXES}, columns)
    wrench = np.column_stack([text.require(axis) for axis in WRENCH_AXES])
    time_s = text.require("t")
    if np.any(np.diff(time_s) < 0.0):
        raise GalenError(f"{path}: time steps back")
    last_s = float(np.abs(time_s).max())
    if not last_s < _MOST_TABLE_S:
        raise GalenError(f"{path}: t goes to {last_s:.2g} s; is its time in seconds?")
    return np.round(time_s * 1e9).astype(np.int64), wrench


def _read_bag(
    bag: Bag,
    topics: ArmTopics,
    wrenches: CellReducer,
    joints: CellReducer,
    on_progress: OnProgress | None,
    arm: Arm,
) -> None:
    names = [find_topic(bag, topics.wrench_raw, WRENCH_TYPE)]
    with contextlib.suppress(BagError):  # a sensor on a table has no joints
        names.append(find_topic(bag, topics.joint_states, JOINT_STATE_TYPE))
    counts = [bag.topics[name].count for name in names]
    total = None if None in counts else sum(count or 0 for count in counts)
    decoder = Decoder(WRENCH_TYPE)
    named, count = topics.joint_names or arm.joint_names, len(arm.turning)
    if len(named) != len(arm.joints):
        raise GalenError(f"{len(named)} joint names; the arm has {len(arm.joints)} joints")
    turning = [named[k] for k in arm.turning]
    angles = Decoder(JOINT_STATE_TYPE, turning, required=turning)
    done = 0
    for block in bag.blocks(names):
        found = decoder.decode(block, np.flatnonzero(block.topic == 0))
        good = np.asarray(np.isfinite(found.values).all(axis=1))
        good[list(found.bad)] = False
        none = np.zeros((int(good.sum()), count))
        wrenches.add(found.stamp_ns[good], found.values[good], none)
        if len(names) > 1:
            turned = angles.decode(block, np.flatnonzero(block.topic == 1))
            good = np.asarray(np.isfinite(turned.values[:, :count]).all(axis=1))
            good[list(turned.bad)] = False
            place = turned.values[good][:, :count]
            joints.add(turned.stamp_ns[good], np.zeros((len(place), 6)), place)
        done += len(block.topic)
        if on_progress is not None:
            on_progress(done, total)


def series_of(name: str, cells: Cells, joints: Cells, tool: CalibrationFile | None) -> DriftSeries:
    """Make the series of cells and, where there are any, of the joints' cells.

    Args:
        name: of the recording, for messages.
        cells: of the wrench (6,), N and N.m, in the order of their times.
        joints: cells of the angles (k,), rad, of the same length; none without joints.
        tool: calibration, whose weight is subtracted; None: only the pose is kept at which the arm
            stood longest.

    Returns:
        The series, without contact.

    Raises:
        GalenError: the joints lack that the tool needs, or too many or too few cells are there.

    """
    notes = []
    cell_ns = round(cells.cell_s * 1e9)
    first = int(cells.start_ns[0]) // cell_ns
    row = cells.start_ns // cell_ns - first
    count = int(row[-1]) + 1
    if count > _MOST_CELLS:
        gap = int(np.argmax(np.diff(row)))
        raise GalenError(
            f"{name}: {count} cells of {cells.cell_s:g} s from first to last stamp are more than"
            f" {_MOST_CELLS}; the longest gap is {np.diff(row)[gap] * cells.cell_s / 3600.0:.3g} h:"
            " are all stamps of one clock? (else a larger --cell-s)"
        )
    reading, scatter = np.full((count, 6), np.nan), np.full((count, 6), np.nan)
    reading[row] = cells.mean
    scatter[row] = np.sqrt(cells.squares / np.maximum(cells.count - 1, 1)[:, None])
    scatter[row[cells.count < _FEWEST_IN_CELL]] = np.nan  # would say little
    angles = np.full((count, joints.angles.shape[1]), np.nan)
    if len(joints):
        place = joints.start_ns // cell_ns - first
        inside = (place >= 0) & (place < count) & (joints.spans <= _POSE_RAD).all(axis=1)
        angles[place[inside]] = joints.angles[inside]
        moving = np.isnan(angles[:, 0])
        if tool is not None:
            reading = reading - tool.predict(angles)
            left = moving
        else:
            stood = _longest_pose(angles)
            left = moving | (np.abs(angles - stood) > _POSE_RAD).any(axis=1)
        share = float(np.mean(left[row]))
        if left.any() and share > 0.01:
            notes.append(
                f"{share:.0%} of it is left out, where the arm "
                + ("moved" if tool is not None else "was elsewhere (--tool subtracts the weight)")
            )
        if tool is not None and bool(np.nanmax(np.abs(angles - _longest_pose(angles))) > 0.1):
            notes.append(
                "the arm stood in several poses: what the tool's file is wrong by there is in all"
                " changes"
            )
        reading[left] = np.nan
    elif tool is not None:
        raise GalenError(f"{name}: --tool needs the joints, and it has none")
    contact = _contact(reading, scatter)
    if int(np.isfinite(reading[:, 0]).sum()) < 3 * _WINDOW_CELLS:
        notes.append("too short to find contact")
    reading[contact] = np.nan
    there = int(np.isfinite(reading[:, 0]).sum())
    if there < _FEWEST_CELLS:
        raise GalenError(
            f"{name}: {there} cells of {cells.cell_s:g} s that can be used are too few; there must"
            f" be {_FEWEST_CELLS} (--cell-s)"
        )
    spans = _spans(contact)
    steps = _steps(reading, cells.cell_s)
    still = np.isfinite(reading[row, 0])
    freedom = max(int((cells.count[still] - 1).sum()), 1)
    noise = np.sqrt(cells.squares[still].sum(axis=0) / freedom)
    return DriftSeries(
        reading,
        cells.cell_s,
        noise,
        int(cells.count.sum()),
        tuple((begin * cells.cell_s, end * cells.cell_s) for begin, end in spans),
        steps,
        tuple(notes),
    )


def _longest_pose(angles: Array) -> Array:
    known = angles[np.isfinite(angles[:, 0])]
    if not len(known):
        raise GalenError("the arm never stands still in it")
    _, which = np.unique(np.round(known / _POSE_RAD), axis=0, return_inverse=True)
    return np.median(known[which.ravel() == np.argmax(np.bincount(which.ravel()))], axis=0)


def _contact(reading: Array, scatter: Array) -> np.ndarray:
    """Mask (n,) of the time bins with contact."""
    there = np.isfinite(reading[:, 0])
    contact = np.zeros(len(reading), dtype=bool)
    rows = np.flatnonzero(there)
    if len(rows) < 3 * _WINDOW_CELLS:
        return contact
    window = _WINDOW_CELLS | 1
    for channel in range(6):
        value = reading[rows, channel]
        off = value - scipy.ndimage.median_filter(value, window, mode="nearest")
        scale = _MAD_TO_STD * np.median(np.abs(off))
        far = np.abs(off) > _TOUCH_SIGMAS * max(scale, 1e-9)
        # A filter that is late at a jump that stays is no contact: only what comes back counts.
        within = scatter[rows, channel]
        usual = np.nanmedian(within) if np.isfinite(within).any() else np.nan
        shaken = within > 4.0 * usual if np.isfinite(usual) and usual > 0.0 else np.zeros_like(far)
        contact[rows[far | shaken]] = True
    return np.convolve(contact, np.ones(2 * _BESIDE + 1), mode="same") > 0.5


def _steps(reading: Array, cell_s: float) -> tuple[tuple[float, Array], ...]:
    """Levels that jump and stay: the medians of a minute before and after, robustly judged."""
    rows = np.flatnonzero(np.isfinite(reading[:, 0]))
    length = _STEP_CELLS
    if len(rows) < 6 * length:
        return ()
    known = reading[rows]
    medians = scipy.ndimage.median_filter(known, size=(length | 1, 1), mode="nearest")
    change = medians[length:] - medians[:-length]
    scale = np.maximum(_MAD_TO_STD * np.median(np.abs(change), axis=0), 1e-9)
    over = np.max(np.abs(change) / scale, axis=1)
    found = []
    while over.max() > _STEP_SIGMAS:
        # A jump's change is flat while the two windows straddle it: its middle is the jump.
        top = int(np.median(np.flatnonzero(over > 0.95 * over.max())[: length + 1]))
        found.append((float(rows[top + length // 2] * cell_s), change[top]))
        over[max(0, top - 2 * length) : top + 2 * length] = 0.0
        if len(found) == 20:
            break
    return tuple(sorted(found, key=lambda step: step[0]))


def _spans(mask: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
