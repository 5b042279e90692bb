"""Many samples at once: as arrays where they are regular, one by one around what is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from galen_model.arrays import Array
from galen_ros.stream.regular_run import Arrivals
from galen_ros.stream.results import Compensated, Rejected, Result

if TYPE_CHECKING:
    from galen_gravcomp.compensator import Compensator

# Samples looked at as arrays at once. What lies behind the first irregular sample was looked at in
# vain, so after a short stretch the next look is a short one.
_LARGEST_LOOK = 1 << 16
_SMALLEST_LOOK = 256
# Samples pushed one by one around an irregular one. Where trouble lasts, each look in vain makes
# them twice as many, so that looking never costs more than pushing.
_FEWEST_STEPS = 16
_MOST_STEPS = 1024


@dataclass(frozen=True)
class SampleBlock:
    """Samples of both topics in the order of their arrival; is_wrench (n,) bool says whose.

    joint_stamp_ns (j,), angles (j, 2): roll and tilt, rad; wrench_stamp_ns (w,), wrenches (w, 6):
    N and N.m. positions (j, 3): the platform's, m, where a stage asks for them. frame (w,) counts
    in `frame_ids`; None: frames aren't checked. `bad_joints` and `bad_wrenches`: rows (of joints,
    of wrenches) whose message can't be used, and why; the numbers in such a row are not looked at.
    Raises ValueError for shapes that don't fit.
    """

    is_wrench: np.ndarray
    joint_stamp_ns: np.ndarray
    angles: Array
    wrench_stamp_ns: np.ndarray
    wrenches: Array
    frame: np.ndarray | None = None
    frame_ids: Sequence[str] = ()
    bad_joints: Mapping[int, str] = field(default_factory=dict)
    bad_wrenches: Mapping[int, str] = field(default_factory=dict)
    positions: Array | None = None

    def __post_init__(self) -> None:
        w = int(np.count_nonzero(self.is_wrench))
        j = len(self.is_wrench) - w
        shapes = {
            "joint_stamp_ns": (self.joint_stamp_ns, (j,)),
            "angles": (self.angles, (j, 2)),
            "wrench_stamp_ns": (self.wrench_stamp_ns, (w,)),
            "wrenches": (self.wrenches, (w, 6)),
        }
        if self.frame is not None:
            shapes["frame"] = (self.frame, (w,))
        if self.positions is not None:
            shapes["positions"] = (self.positions, (j, 3))
        for name, (array, shape) in shapes.items():
            if array.shape != shape:
                raise ValueError(
                    f"{name} has shape {array.shape}; with {j} joint samples and {w} wrenches in"
                    f" is_wrench it must be {shape}"
                )
        bad = (("joints", self.bad_joints, j), ("wrenches", self.bad_wrenches, w))
        for name, rows, count in bad:
            if any(not 0 <= row < count for row in rows):
                raise ValueError(f"bad_{name} has rows {sorted(rows)}; there are {count} {name}")

    def __len__(self) -> int:
        """Number of samples of both topics."""
        return len(self.is_wrench)


@dataclass(frozen=True)
class BlockResult:
    """What became of the wrenches of a block, and of those that had waited before it.

    In the order in which they came out: index (k,), the wrench's running number by arrival over
    all blocks, from 0; stamp_ns (k,); wrench (k, 6), compensated, N and N.m; angles (k, 2), roll
    and tilt at the stamp, rad. `rejected` in the order of the rejections; its `number` is the
    index.
    """

    index: np.ndarray
    stamp_ns: np.ndarray
    wrench: Array
    angles: Array
    rejected: list[Rejected]


@dataclass(frozen=True)
class Outputs:
    """The arrays of `BlockResult` for one stretch, and how many samples it took."""

    taken: int
    index: np.ndarray
    stamp_ns: np.ndarray
    wrench: Array
    angles: Array


NOTHING = Outputs(
    0, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 6)), np.zeros((0, 2))
)


def push_block(
    block: SampleBlock, sink: Compensator, push_stretch: Callable[[Arrivals], Outputs]
) -> BlockResult:
    """Push a block. `push_stretch` pushes the regular samples at the start of what it is given."""
    pushing = _Pushing(block, sink)
    look, steps = _LARGEST_LOOK, _FEWEST_STEPS
    while pushing.at < len(block):
        outputs = push_stretch(pushing.arrivals(look))
        pushing.take(outputs)
        if outputs.taken < look:
            pushing.step(steps)
            if outputs.taken < steps:
                steps = min(2 * steps, _MOST_STEPS)
            else:
                steps = _FEWEST_STEPS
        look = min(max(2 * outputs.taken, _SMALLEST_LOOK), _LARGEST_LOOK)
    return pushing.result()


class _Pushing:
    """A block on its way: how far it is, and what came out."""

    def __init__(self, block: SampleBlock, sink: Compensator) -> None:
        self._block = block
        self._sink = sink
        self.at = 0
        self._joint_row = 0
        self._wrench_row = 0
        self._joints = _paired_joints(block, sink)
        self._joint_usable = _all_but(block.bad_joints, len(block.joint_stamp_ns))
        self._wrench_readable = _all_but(block.bad_wrenches, len(block.wrench_stamp_ns))
        self._parts = [NOTHING]
        self._single: list[Compensated] = []
        self._rejected: list[Rejected] = []

    def arrivals(self, most: int) -> Arrivals:
        """The next samples, `most` or as many as there are."""
        block = self._block
        is_wrench = block.is_wrench[self.at : self.at + most]
        w = int(np.count_nonzero(is_wrench))
        joints = slice(self._joint_row, self._joint_row + len(is_wrench) - w)
        wrenches = slice(self._wrench_row, self._wrench_row + w)
        usable = self._wrench_readable[wrenches]
        if block.frame is not None:
            expected = self._sink.pairing.sensor_frame
            right = np.array([frame_id == expected for frame_id in block.frame_ids], dtype=bool)
            usable = usable & right[block.frame[wrenches]]
        return Arrivals(
            is_wrench,
            block.joint_stamp_ns[joints],
            self._joints[joints],
            self._joint_usable[joints],
            block.wrench_stamp_ns[wrenches],
            block.wrenches[wrenches],
            usable,
        )

    def take(self, outputs: Outputs) -> None:
        """Go on behind a stretch."""
        if outputs.taken:
            self._flush()
            self._parts.append(outputs)
            self._go_on(outputs.taken)

    def step(self, count: int) -> None:
        """Push the next `count` samples one by one, or as many as there are."""
        block, sink = self._block, self._sink
        kinds = block.is_wrench[self.at : self.at + count].tolist()
        joint_row, wrench_row = self._joint_row, self._wrench_row
        for is_wrench in kinds:
            if not is_wrench:
                if self._joint_usable[joint_row]:
                    stamp_ns = int(block.joint_stamp_ns[joint_row])
                    roll, tilt = block.angles[joint_row].tolist()
                    platform = (
                        None
                        if block.positions is None
                        else tuple(block.positions[joint_row].tolist())
                    )
                    self._sort(sink.push_joints(stamp_ns, roll, tilt, platform))
                else:
                    sink.pairing.push_bad_joints(block.bad_joints[joint_row])
                joint_row += 1
                continue
            if self._wrench_readable[wrench_row]:
                frame_id = None
                if block.frame is not None:
                    frame_id = block.frame_ids[int(block.frame[wrench_row])]
                stamp_ns = int(block.wrench_stamp_ns[wrench_row])
                wrench = block.wrenches[wrench_row].tolist()
                self._sort(sink.push_wrench(stamp_ns, wrench, frame_id))
            else:
                self._sort(sink.pairing.push_bad_wrench(block.bad_wrenches[wrench_row]))
            wrench_row += 1
        self._go_on(len(kinds))

    def result(self) -> BlockResult:
        """What came out of the whole block."""
        self._flush()
        parts = self._parts
        return BlockResult(
            np.concatenate([part.index for part in parts]),
            np.concatenate([part.stamp_ns for part in parts]),
            np.concatenate([part.wrench for part in parts]),
            np.concatenate([part.angles for part in parts]),
            self._rejected,
        )

    def _go_on(self, count: int) -> None:
        w = int(np.count_nonzero(self._block.is_wrench[self.at : self.at + count]))
        self._wrench_row += w
        self._joint_row += count - w
        self.at += count

    def _sort(self, results: list[Result]) -> None:
        for result in results:
            if isinstance(result, Compensated):
                self._single.append(result)
            else:
                self._rejected.append(result)

    def _flush(self) -> None:
        """Put the outputs of single samples where those of stretches are."""
        if not self._single:
            return
        self._parts.append(
            Outputs(
                0,
                np.array([single.number for single in self._single], dtype=np.int64),
                np.array([single.stamp_ns for single in self._single], dtype=np.int64),
                np.array([single.wrench for single in self._single]),
                np.array([single.angles for single in self._single]),
            )
        )
        self._single = []


def _paired_joints(block: SampleBlock, sink: Compensator) -> Array:
    """What wrenches are paired with (j, 2), or (j, 5) with the platform's position first."""
    if not sink.pairs_positions:
        return block.angles
    positions = block.positions
    if positions is None:
        positions = np.full((len(block.angles), 3), np.nan)
    return np.concatenate((positions, block.angles), axis=1)


def _all_but(rows: Mapping[int, str], count: int) -> np.ndarray:
    fine = np.ones(count, dtype=bool)
    fine[list(rows)] = False
    return fine
