"""Topics' quality of service; messages to arrays and back.

Stamps are integer nanoseconds; a wrench is force, then torque.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from galen_ros.cdr import check_joint_counts, joint_indices

_NS_PER_S = 1_000_000_000

# For 500 Hz streams. The depth is the stall budget: 2000 samples are 4 s of a node that is busy.
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=2000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

# For what a late subscriber must still get, such as the robot's description.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def stamp_to_ns(stamp: Time) -> int:
    """Return the stamp in nanoseconds."""
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def fill_stamp(stamp: Time, ns: int) -> None:
    """Write `ns` nanoseconds (not negative) into `stamp`."""
    stamp.sec, stamp.nanosec = divmod(ns, _NS_PER_S)


def wrench_to_array(message: WrenchStamped) -> NDArray[np.float64]:
    """Return (fx, fy, fz, tx, ty, tz) in N and N·m, shape (6,)."""
    force, torque = message.wrench.force, message.wrench.torque
    return np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])


def fill_wrench(message: WrenchStamped, wrench: NDArray[np.float64]) -> None:
    """Write a wrench (6,) in N and N·m into `message`; its header stays as it is."""
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = (float(value) for value in wrench)


class JointStateReader:
    """Reads wanted joints out of JointState messages by name, in any order, among any others."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._wanted = tuple(joint_names)
        # A publisher hardly ever changes its names, so the last answer is kept.
        self._seen: list[str] | None = None
        self._indices: NDArray[np.intp] = np.zeros(0, dtype=np.intp)

    def read(self, message: JointState) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return positions (n,) and velocities (n,) in the order of the wanted joints.

        Velocities are None when the message has none. Raises JointStateError when joints are
        missing, JointStateError when a list's length doesn't fit the names.
        """
        if message.name != self._seen:
            found = joint_indices(self._wanted, message.name)
            self._indices = np.array(found, dtype=np.intp)
            self._seen = list(message.name)
        check_joint_counts(len(message.name), len(message.position), len(message.velocity))
        positions = np.array(message.position)[self._indices]
        if len(message.velocity) == 0:
            return positions, None
        return positions, np.array(message.velocity)[self._indices]
