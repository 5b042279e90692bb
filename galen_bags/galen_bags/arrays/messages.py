"""Serialised messages straight into arrays, thousands at a time.

A publisher's messages are alike but for stamp and numbers. So the first message's layout is worked
out, all that fit it are read by array operations, and so on with what is left
(`galen_ros.cdr`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from galen_model.arrays import Array
from galen_ros.cdr import (
    NS_PER_S,
    STAMP_AT,
    JointStateError,
    Layout,
    UnreadableError,
    check_joint_counts,
    joint_indices,
    joint_state_layout,
    stamped_layout,
)

from galen_bags.errors import BagError
from galen_bags.formats.raw_block import Messages, windows

WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
POSE_TYPE = "geometry_msgs/msg/PoseStamped"
JOINT_STATE_TYPE = "sensor_msgs/msg/JointState"

_KEPT_LAYOUTS = 16
# A block in which every message is another one is not worth an array operation for each.
_MOST_LAYOUTS_A_BLOCK = 64


@dataclass(frozen=True)
class Samples:
    """Messages of one topic.

    stamp_ns (n,) int64; values (n, k): what the decoder says, NaN where it is not known;
    frame (n,) counts in `frame_ids`; `bad`: why the message at this row can't be used. A bad
    row's values are NaN; its stamp is 0 where it has none.
    """

    stamp_ns: np.ndarray
    values: Array
    frame: np.ndarray
    frame_ids: tuple[str, ...]
    bad: dict[int, str]

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamp_ns)


class Decoder:
    """Decodes one topic's messages; remembers their layouts from block to block."""

    def __init__(self, type_name: str, joint_names: Sequence[str] = (), required: int = 0) -> None:
        """Take one of the three types.

        The values are a wrench's (fx, fy, fz, tx, ty, tz) N and N.m; a pose's (x, y, z, qx, qy,
        qz, qw) m; a joint state's positions, then velocities of `joint_names`. A joint state that
        lacks one of the first `required` names is bad; others that it lacks are NaN.
        """
        self._type_name = type_name
        self._joint_names = tuple(joint_names)
        self._required = tuple(joint_names[:required])
        widths = {WRENCH_TYPE: 6, POSE_TYPE: 7, JOINT_STATE_TYPE: 2 * len(self._joint_names)}
        if type_name not in widths:
            raise BagError(f"messages of type {type_name} can't be read here")
        self._width = widths[type_name]
        self._layouts: list[Layout] = []
        self._frame_ids: dict[str, int] = {}

    def decode(self, block: Messages, rows: np.ndarray) -> Samples:
        """Return the messages at `rows` (n,) of a block."""
        count = len(rows)
        samples = Samples(
            np.zeros(count, dtype=np.int64),
            np.full((count, self._width), np.nan),
            np.zeros(count, dtype=np.intp),
            (),
            {},
        )
        left = np.arange(count)
        for layout in list(self._layouts):
            left = self._fill(samples, layout, block, rows, left)
        learnt = 0
        while len(left):
            first = int(left[0])
            data = block.message(int(rows[first]))
            try:
                layout = self._learn(data)
            except UnreadableError as error:
                samples.bad[first] = (
                    f"{len(data)} bytes came that are not a readable {self._type_name}: {error}"
                )
                left = left[1:]
                continue
            learnt += 1
            if learnt <= _MOST_LAYOUTS_A_BLOCK:
                left = self._fill(samples, layout, block, rows, left)
            else:
                self._fill(samples, layout, block, rows, left[:1])
                left = left[1:]
        return replace(samples, frame_ids=tuple(self._frame_ids) or ("",))

    def _fill(
        self, samples: Samples, layout: Layout, block: Messages, rows: np.ndarray, left: np.ndarray
    ) -> np.ndarray:
        """Fill in those of the samples `left` that are laid out so; returns the others."""
        fits = block.size[rows[left]] == layout.length
        if not fits.any():
            return left
        same = left[fits]
        cells = windows(block.data, layout.length)[block.start[rows[same]]]
        alike = np.ones(len(same), dtype=bool)
        for run, expected in layout.fixed:
            equal = cells[:, run] == np.frombuffer(expected, np.uint8)
            if not equal.all():  # over all at once: much faster than over each row
                alike &= equal.all(axis=1)
        if not alike.all():
            same, cells = same[alike], cells[alike]
            fits[fits] = alike
        samples.stamp_ns[same] = _stamps(layout, cells)
        samples.frame[same] = self._frame_ids.setdefault(layout.frame_id, len(self._frame_ids))
        try:
            samples.values[same] = self._values(layout, cells)
        except JointStateError as error:
            samples.bad.update(dict.fromkeys(same.tolist(), str(error)))
        return left[~fits]

    def _learn(self, data: bytes) -> Layout:
        if self._type_name == JOINT_STATE_TYPE:
            layout = joint_state_layout(data)
        else:
            layout = stamped_layout(data, self._width)
        self._layouts = [layout, *self._layouts[: _KEPT_LAYOUTS - 1]]
        return layout

    def _values(self, layout: Layout, rows: np.ndarray) -> Array:
        """Values (n, k) of messages of one layout; raises JointStateError."""
        if self._type_name != JOINT_STATE_TYPE:
            return _doubles(layout, rows, 0)
        joint_indices(self._required, layout.names)
        positions, velocities = layout.counts[0], layout.counts[1]
        check_joint_counts(len(layout.names), positions, velocities)
        values = np.full((len(rows), self._width), np.nan)
        joints = len(self._joint_names)
        there = [k for k, name in enumerate(self._joint_names) if name in layout.names]
        source = [layout.names.index(self._joint_names[k]) for k in there]
        values[:, there] = _doubles(layout, rows, 0)[:, source]
        if velocities:
            values[:, [joints + k for k in there]] = _doubles(layout, rows, 1)[:, source]
        return values


def _stamps(layout: Layout, rows: np.ndarray) -> np.ndarray:
    """Stamps (n,) in ns."""
    seconds = np.ascontiguousarray(rows[:, STAMP_AT : STAMP_AT + 4]).view(layout.order + "i4")
    rest = np.ascontiguousarray(rows[:, STAMP_AT + 4 : STAMP_AT + 8]).view(layout.order + "u4")
    return seconds[:, 0].astype(np.int64) * NS_PER_S + rest[:, 0]


def _doubles(layout: Layout, rows: np.ndarray, run: int) -> Array:
    """One of the runs of doubles (n, count)."""
    count = layout.counts[run]
    start = layout.doubles_at[run]
    cells = np.ascontiguousarray(rows[:, start : start + 8 * count])
    return cells.view(layout.order + "f8").astype(np.float64, copy=False).reshape(-1, count)
