# SPDX-License-Identifier: Apache-2.0
"""Ways for the arm around boxes and itself: straight in joint space, or over poses between.

The poses between are a lattice of angles with all other joints at home; without one, home alone.
Two neighbours are joined where the straight way between them is free, and so are home and its
nearest nodes. What is joined to home is where the arm can go; any pose from which a node is
straight ahead is as well.
"""

import itertools
from functools import cached_property

import numpy as np
import scipy  # its parts are loaded when they are used

from galen_model.arm.clearance import ArmClearance, ObstacleError
from galen_model.arrays import Array

# A pose is joined to no more than this many of the lattice's nodes, the nearest first.
_NEAREST = 12


class Router:
    """Free ways between poses; `lattice` (m, k) are angles, rad, `home` (n,) joints."""

    def __init__(
        self, clearance: ArmClearance, home: Array, lattice: Array, name: str = "home"
    ) -> None:
        """Look at home and at the lattice.

        Args:
            clearance: distances of the arm with its tool.
            home: joints (n,), m and rad.
            lattice: angles (m, k) of the poses between, rad; the other joints are at home.
            name: what home is called in errors.

        Raises:
            ObstacleError: the arm can't stand at home.

        """
        self.clearance = clearance
        self._home = np.asarray(home, dtype=float)
        if fault := clearance.pose_fault(self._home):
            raise ObstacleError(f"{name} can't be taken: {fault}")
        self._arm = clearance.arm
        angles = np.vstack([self._arm.angles(self._home), lattice])
        self._nodes = self._arm.with_angles(angles, self._home)
        self._faults = [clearance.pose_fault(node) for node in self._nodes]
        self._known: dict[bytes, str] = {}

    @property
    def lattice_faults(self) -> list[str]:
        """Why each node of the lattice can't be reached, "" where it can."""
        lengths, _ = self._ways
        faults = []
        for index in range(1, len(self._nodes)):
            fault = self._faults[index]
            if not fault and not np.isfinite(lengths[0, index]):
                fault = self.fault(self._nodes[index])
            faults.append(fault)
        return faults

    def fault(self, joints: Array) -> str:
        """Name why the arm can't stand at a pose or not get there from home.

        Args:
            joints: (n,), m and rad.

        Returns:
            A clause; empty when it can.

        """
        if fault := self.clearance.pose_fault(joints):
            return fault
        try:
            self.route(self._home, joints)
        except ObstacleError as error:
            return str(error)
        return ""

    def route(self, start: Array, goal: Array) -> list[Array]:
        """Find a free way.

        Args:
            start: joints (n,), m and rad.
            goal: joints (n,), m and rad.

        Returns:
            Joints (n,) to go to one after another, straight, `goal` the last.

        Raises:
            ObstacleError: no free way is found.

        """
        straight = self._path_fault(start, goal)
        if not straight:
            return [np.asarray(goal, dtype=float)]
        lengths, before = self._ways
        best: list[int] | None = None
        shortest = np.inf
        for first, last in itertools.product(self._joined(start), self._joined(goal)):
            length = (
                lengths[first, last]
                + _length(start, self._nodes[first])
                + _length(self._nodes[last], goal)
            )
            if length < shortest:
                shortest, best = length, _nodes_between(before, first, last)
        if best is None:
            raise ObstacleError(f"there is no free way: straight ahead {straight}")
        return self._shortened([start, *(self._nodes[k] for k in best), np.asarray(goal)])

    @cached_property  # most ways are straight ahead, and then it is not needed
    def _ways(self) -> tuple[Array, Array]:
        """Lengths between all nodes, inf for no way, and each way's last node but one."""
        free = np.array([not fault for fault in self._faults])
        angles = self._arm.angles(self._nodes)
        steps = [
            np.min(np.diff(np.unique(column.round(9))), initial=np.inf) for column in angles[1:].T
        ]
        rows, columns, lengths = [], [], []
        for one in range(len(self._nodes)):
            gap = np.abs(angles[one + 1 :] - angles[one])
            near = one + 1 + np.flatnonzero(np.all(gap < 1.5 * np.array(steps), axis=1))
            for other in near:
                if free[one] and free[other]:
                    if self._path_fault(self._nodes[one], self._nodes[other]):
                        continue
                    rows.append(one)
                    columns.append(other)
                    # Poses that coincide, as home and a node may, are joined all the same.
                    lengths.append(max(_length(self._nodes[one], self._nodes[other]), 1e-9))
        count = len(self._nodes)
        graph = scipy.sparse.coo_array((lengths, (rows, columns)), shape=(count, count)).tocsr()
        found = scipy.sparse.csgraph.dijkstra(graph, directed=False, return_predecessors=True)
        return found[0], found[1]

    def _joined(self, joints: Array) -> list[int]:
        """Nodes to which there is a straight way."""
        order = np.argsort([_length(joints, node) for node in self._nodes])
        candidates = [k for k in order if not self._faults[k]][:_NEAREST]
        if 0 not in candidates:
            candidates.append(0)
        return [k for k in candidates if not self._path_fault(joints, self._nodes[k])]

    def _shortened(self, way: list[Array]) -> list[Array]:
        """Without the nodes that a straight way skips; the start left out."""
        kept, at = [], 0
        while at < len(way) - 1:
            after = next(
                k
                for k in range(len(way) - 1, at, -1)
                if k == at + 1 or not self._path_fault(way[at], way[k])
            )
            kept.append(way[after])
            at = after
        return kept

    def _path_fault(self, start: Array, goal: Array) -> str:
        ends = (np.asarray(end, dtype=float).tobytes() for end in (start, goal))
        key = b"".join(sorted(ends))  # a straight way is free both ways or not at all
        if key not in self._known:
            self._known[key] = self.clearance.path_fault(start, goal)
        return self._known[key]


def _nodes_between(before: Array, first: int, last: int) -> list[int]:
    way = [last]
    while way[-1] != first:
        way.append(int(before[first, way[-1]]))
    return way[::-1]


def _length(start: Array, goal: Array) -> float:
    """Of a way: the joint that turns furthest decides how long it takes (1 m counts as 1 rad)."""
    return float(np.max(np.abs(np.asarray(goal) - start)))
