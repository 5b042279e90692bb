# SPDX-License-Identifier: Apache-2.0
"""One sweep: which pose comes next, which were still, which are tried again or left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from galen_common.goal.arrival import PoseRejection
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.load.readings import StillPoses
from galen_model.rest.segments import PoseRecord, StillnessSettings, wrench_fault

_COLDEST_C, _HOTTEST_C = -273.15, 1000.0


@dataclass(frozen=True)
class PoseOutcome:
    """What became of one visit of a pose."""

    index: int
    angles: tuple[float, ...]
    accepted: bool
    record: PoseRecord | None
    message: str


class Sweep:
    """Visits every pose once, then the rejected ones again, `retries` times.

    A rejected pose is tried again at the end of the sweep, not at once: an operator who touched the
    arm is more likely gone by then. After the last pose all are judged once more against the whole
    sweep, because the first ones had little to be compared with.
    """

    def __init__(self, name: str, poses: Array, stillness: StillnessSettings, retries: int) -> None:
        """`poses` (n, k): angles of the turning joints, rad, in visiting order."""
        self.name = name
        self.poses = poses
        self._stillness = stillness
        self._retries = retries
        self._queue = list(range(len(poses)))
        self._visits = [0] * len(poses)
        self._records: dict[int, PoseRecord] = {}
        self._left_out: dict[int, PoseRejection] = {}
        self.rejected_in_a_row = 0

    def append(self, angles: Array) -> None:
        """Add a pose to those to visit.

        Args:
            angles: (k,) of the turning joints, rad.

        """
        self._queue.append(len(self.poses))
        self._visits.append(0)
        self.poses = np.vstack([self.poses, angles])

    @property
    def current(self) -> int | None:
        """Index of the pose to visit now; None when the sweep is over."""
        return self._queue[0] if self._queue else None

    @property
    def finished_poses(self) -> int:
        """Poses whose fate is known: recorded, or left out for good."""
        return len(self._records) + len(self._left_out)

    @property
    def indices(self) -> list[int]:
        """Indices of the recorded poses, in the order of `records`."""
        return sorted(self._records)

    @property
    def records(self) -> list[PoseRecord]:
        """The recorded poses in the grid's order."""
        return [self._records[k] for k in self.indices]

    @property
    def rejections(self) -> list[str]:
        """Name sweep, pose and reason of every pose left out, as in "tool/3: reason"."""
        return [f"{self.name}/{k}: {r.reason}" for k, r in sorted(self._left_out.items())]

    @property
    def not_finite(self) -> bool:
        """Whether the poses left out had, for the most part, values that are not finite."""
        bad = sum(r.not_finite for r in self._left_out.values())
        return bad > len(self._left_out) / 2

    def take(self, outcome: PoseRecord | PoseRejection) -> list[PoseOutcome]:
        """Judge the current pose's visit and step on.

        Args:
            outcome: the visit's average, or why there is none.

        Returns:
            The visit's verdict, then, at the end of a round, those of recorded poses that turned
            out less still than the rest.

        """
        index = self._queue.pop(0)
        self._visits[index] += 1
        if isinstance(outcome, PoseRecord):
            fault = wrench_fault(outcome, [*self._records.values(), outcome], self._stillness)
            verdicts = [
                self._reject(index, PoseRejection(fault)) if fault else self._keep(index, outcome)
            ]
        else:
            verdicts = [self._reject(index, outcome)]
        self.rejected_in_a_row = 0 if verdicts[0].accepted else self.rejected_in_a_row + 1
        if not self._queue:
            verdicts += self._judge_all()
            self._queue = [
                k
                for k in range(len(self.poses))
                if k not in self._records and k not in self._left_out
            ]
        return verdicts

    def _keep(self, index: int, record: PoseRecord) -> PoseOutcome:
        self._records[index] = record
        return self._verdict(index, True, record, "")

    def _reject(self, index: int, rejection: PoseRejection) -> PoseOutcome:
        if self._visits[index] > self._retries:
            self._left_out[index] = rejection
            return self._verdict(index, False, None, f"{rejection.reason}; left out")
        return self._verdict(index, False, None, f"{rejection.reason}; will be tried again")

    def _judge_all(self) -> list[PoseOutcome]:
        records = list(self._records.values())
        faults = {
            k: fault
            for k, record in self._records.items()
            if (fault := wrench_fault(record, records, self._stillness))
        }
        for k in faults:
            del self._records[k]
        return [self._reject(k, PoseRejection(fault)) for k, fault in sorted(faults.items())]

    def _verdict(
        self, index: int, accepted: bool, record: PoseRecord | None, message: str
    ) -> PoseOutcome:
        return PoseOutcome(index, tuple(self.poses[index].tolist()), accepted, record, message)


def still_poses(records: Sequence[PoseRecord], arm: Arm, origin_ns: int = 0) -> StillPoses:
    """Return the records for an identification.

    Args:
        records: mean readings at n still poses.
        arm: whose joints they have.
        origin_ns: stamp, ns, from which times are counted.

    Returns:
        Angles, readings and times, in s; the temperature, deg C, only where every pose has one that
        a sensor can have.

    """
    temperature = np.array([r.temperature_c for r in records])
    plausible = (temperature >= _COLDEST_C) & (temperature <= _HOTTEST_C)
    return StillPoses(
        *stack(records, arm),
        # as whole ns until the difference: floats of today's date are 0.2 us apart
        time_s=np.array([(r.stamp_ns - origin_ns) * 1e-9 for r in records]),
        arm=arm,
        temperature_c=temperature if np.all(plausible) else None,
    )


def stack(records: Sequence[PoseRecord], arm: Arm) -> tuple[Array, Array, Array]:
    """Stack records into arrays.

    Args:
        records: mean readings at n still poses.
        arm: whose joints they have.

    Returns:
        Angles (n, k) of the turning joints, rad; wrench (n, 6), N and N.m, in the sensor's frame;
        its standard deviation (n, 6) as a mean's.

    """
    joints = np.array([r.joints for r in records]).reshape(-1, len(arm.joints))
    return (
        arm.angles(joints),
        np.array([r.wrench for r in records]).reshape(-1, 6),
        np.array([r.std_of_mean for r in records]).reshape(-1, 6),
    )
