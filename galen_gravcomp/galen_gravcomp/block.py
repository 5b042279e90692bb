# SPDX-License-Identifier: Apache-2.0
"""Many samples at once: as arrays where they are regular, one by one around what is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from galen_bags.arrays.arm_recording import Samples
from galen_common.stream.regular_run import Arrivals
from galen_common.stream.samples import PairedWrench, Rejected, Result
from galen_model.arrays import Array

if TYPE_CHECKING:
    from galen_gravcomp.compensator import Compensator

# Samples looked at as arrays at once. What lies behind the first irregular sample was looked at in
# vain, so after a short run the next look is a short one.
_LARGEST_LOOK = 1 << 16
_SMALLEST_LOOK = 256
# Samples pushed one by one around an irregular one. Where trouble lasts, each look in vain makes
# them twice as many, so that looking never costs more than pushing.
_FEWEST_STEPS = 16
_MOST_STEPS = 1024


@dataclass(frozen=True)
class BlockResult:
    """What became of the wrenches of a block, and of those that had waited before it.

    In the order in which they came out: index (k,), the wrench's running number by arrival over
    all blocks, from 0; stamp_ns (k,); wrench (k, 6), compensated, N and N.m; angles (k, a)
    at the stamp, rad. `rejected` in the order of the rejections; its `number` is the
    index.
    """

    index: np.ndarray
    stamp_ns: np.ndarray
    wrench: Array
    angles: Array
    rejected: Sequence[Rejected] = ()

    @classmethod
    def empty(cls, angles: int) -> BlockResult:
        """Make one of no wrench.

        Args:
            angles: number of the arm's angles.

        Returns:
            Arrays of length 0.

        """
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, np.zeros((0, 6)), np.zeros((0, angles)))


def push_block(
    sink: Compensator,
    is_wrench: np.ndarray,
    joints: Samples,
    wrenches: Samples,
    push_run: Callable[[Arrivals], tuple[int, BlockResult]],
) -> BlockResult:
    """Push samples in the order of their arrival.

    Args:
        sink: where samples go one by one.
        is_wrench: (n,) bool of both topics' samples in the order of their arrival: whether the next
            one is a wrench.
        joints: values (j, n or more) in the arm's order, m and rad.
        wrenches: values (w, 6), N and N.m.
        push_run: pushes the regular samples at the start of its argument; how many, and outputs.

    Returns:
        What became of these wrenches, and of those that had waited before.

    Raises:
        ValueError: the counts don't fit, before anything was pushed.

    """
    count = int(np.count_nonzero(is_wrench))
    if (len(is_wrench) - count, count) != (len(joints), len(wrenches)):
        raise ValueError(
            f"{len(joints)} joint samples and {len(wrenches)} wrenches; is_wrench has"
            f" {len(is_wrench) - count} and {count}"
        )
    pushing = _Pushing(sink, is_wrench, joints, wrenches)
    look, steps = _LARGEST_LOOK, _FEWEST_STEPS
    while pushing.at < len(is_wrench):
        taken, outputs = push_run(pushing.arrivals(look))
        pushing.take(taken, outputs)
        if taken < look:
            pushing.step(steps)
            steps = min(2 * steps, _MOST_STEPS) if taken < steps else _FEWEST_STEPS
        look = min(max(2 * taken, _SMALLEST_LOOK), _LARGEST_LOOK)
    return pushing.result()


class _Pushing:
    """A block on its way: how far it is, and what came out."""

    def __init__(
        self, sink: Compensator, is_wrench: np.ndarray, joints: Samples, wrenches: Samples
    ) -> None:
        self._sink = sink
        self._is_wrench = is_wrench
        self._joints = joints
        self._wrenches = wrenches
        self.at = 0
        self._joint_row = 0
        self._wrench_row = 0
        all_joints = joints.values[:, : len(sink.arm.joints)]
        angles = sink.arm.angles(all_joints)
        self._joint_values = all_joints if sink.needs_positions else angles
        self._paired = all_joints if sink.pairs_positions else angles
        self._joint_usable = _all_but(joints.bad, len(joints))
        self._wrench_readable = _all_but(wrenches.bad, len(wrenches))
        self._parts = [BlockResult.empty(len(sink.arm.turning))]
        self._single: list[PairedWrench] = []
        self._rejected: list[Rejected] = []

    def arrivals(self, most: int) -> Arrivals:
        """Return the next samples, `most` or as many as there are."""
        is_wrench = self._is_wrench[self.at : self.at + most]
        w = int(np.count_nonzero(is_wrench))
        joints = slice(self._joint_row, self._joint_row + len(is_wrench) - w)
        wrenches = slice(self._wrench_row, self._wrench_row + w)
        expected = self._sink.pairing.sensor_frame
        right = np.array([name == expected for name in self._wrenches.frame_ids], dtype=bool)
        return Arrivals(
            is_wrench,
            self._joints.stamp_ns[joints],
            self._paired[joints],
            self._joint_usable[joints],
            self._wrenches.stamp_ns[wrenches],
            self._wrenches.values[wrenches],
            self._wrench_readable[wrenches] & right[self._wrenches.frame[wrenches]],
        )

    def take(self, taken: int, outputs: BlockResult) -> None:
        """Go on behind a regular run of `taken` samples."""
        if taken:
            self._flush()
            self._parts.append(outputs)
            self._go_on(taken)

    def step(self, count: int) -> None:
        """Push the next `count` samples one by one, or as many as there are."""
        kinds = self._is_wrench[self.at : self.at + count].tolist()
        joint_row, wrench_row = self._joint_row, self._wrench_row
        for is_wrench in kinds:
            if is_wrench:
                self._step_wrench(wrench_row)
                wrench_row += 1
            else:
                self._step_joints(joint_row)
                joint_row += 1
        self._go_on(len(kinds))

    def _step_joints(self, row: int) -> None:
        sink, joints = self._sink, self._joints
        if not self._joint_usable[row]:
            sink.pairing.push_bad_joints(joints.bad[row])
            return
        values = tuple(self._joint_values[row].tolist())
        self._sort(sink.push_joints(int(joints.stamp_ns[row]), values))

    def _step_wrench(self, row: int) -> None:
        sink, wrenches = self._sink, self._wrenches
        if not self._wrench_readable[row]:
            self._sort(sink.pairing.push_bad_wrench(wrenches.bad[row]))
            return
        frame_id = wrenches.frame_ids[int(wrenches.frame[row])]
        values = wrenches.values[row].tolist()
        self._sort(sink.push_wrench(int(wrenches.stamp_ns[row]), values, frame_id))

    def result(self) -> BlockResult:
        """Return what came out of the whole block."""
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
        w = int(np.count_nonzero(self._is_wrench[self.at : self.at + count]))
        self._wrench_row += w
        self._joint_row += count - w
        self.at += count

    def _sort(self, results: Sequence[Result]) -> None:
        for result in results:
            if isinstance(result, PairedWrench):
                self._single.append(result)
            else:
                self._rejected.append(result)

    def _flush(self) -> None:
        """Put the outputs of single samples where those of regular runs are."""
        if not self._single:
            return
        joints = np.array([single.joints for single in self._single])
        self._parts.append(
            BlockResult(
                np.array([single.number for single in self._single], dtype=np.int64),
                np.array([single.stamp_ns for single in self._single], dtype=np.int64),
                np.array([single.wrench for single in self._single]),
                self._sink.arm.angles(joints) if self._sink.pairs_positions else joints,
            )
        )
        self._single = []


def _all_but(rows: Mapping[int, str], count: int) -> np.ndarray:
    fine = np.ones(count, dtype=bool)
    fine[list(rows)] = False
    return fine
