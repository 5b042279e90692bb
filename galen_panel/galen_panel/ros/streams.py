# SPDX-License-Identifier: Apache-2.0
"""Listen to the 500 Hz streams while a page shows them, for as little as can be.

Subscriptions on a node that no executor spins cost nothing when a message comes: it lies in the
middleware's queue until all that is there is taken at once, some 25 times a second.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from galen_common.cdr import (
    JointStateError,
    JointWire,
    Layout,
    UnreadableError,
    WrenchWire,
    stamped_layout,
)
from galen_model.arm.arm import Arm
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from galen_msgs.msg import DeflectionStamped
from galen_panel.state.history import History, StreamSeries

_DEPTH = 200
"""0.4 s at 500 Hz; what a busy panel loses is only missing in its plots."""
_LINGER_S = 2.0
"""A page that is loaded again leaves and comes back."""
_DEFLECTION_DOUBLES = 42
"""Translation, rotation and covariance."""

Read = Callable[[bytes], tuple[int, tuple[float, ...]]]


def deflection_reader() -> Read:
    """Make a reader of serialised DeflectionStamped.

    Returns:
        The reader: stamp, ns, and translation and rotation vector (6,), m and rad, in the message's
        frame; it raises UnreadableError.

    """
    layout: Layout | None = None

    def read(data: bytes) -> tuple[int, tuple[float, ...]]:
        nonlocal layout
        if layout is None or not layout.fits(data):
            layout = stamped_layout(data, _DEFLECTION_DOUBLES)
        values = layout.doubles[0].unpack_from(data, layout.doubles_at[0])
        return layout.stamp_ns(data), values[:6]

    return read


def wrench_reader() -> Read:
    """Make a reader of serialised WrenchStamped.

    Returns:
        The reader: stamp, ns, and wrench (6,), N and N.m, in the message's frame; it raises
        UnreadableError.

    """
    wire = WrenchWire()

    def read(data: bytes) -> tuple[int, tuple[float, ...]]:
        raw = wire.read(data)
        return raw.stamp_ns, raw.wrench

    return read


@dataclass
class _Tap:
    topic: str
    message_type: Any
    read: Read
    series: StreamSeries
    subscription: Subscription | None = None


class Streams:
    """Fills a history. `watch` may be called in any thread, all else in the ROS thread."""

    def __init__(self, history: History, context: Context) -> None:
        self._context = context
        self._history = history
        self._taps = [
            _Tap("wrench_raw", WrenchStamped, wrench_reader(), history.raw),
            _Tap("wrench_compensated", WrenchStamped, wrench_reader(), history.compensated),
            _Tap("deflection", DeflectionStamped, deflection_reader(), history.deflection),
        ]
        self._watchers = 0
        self._lock = threading.Lock()
        self._node: Node | None = None
        self.listening = False
        self._watched_s = 0.0

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Within it the streams are listened to."""
        with self._lock:
            self._watchers += 1
        try:
            yield
        finally:
            with self._lock:
                self._watchers -= 1

    def follow(self, arm: Arm) -> None:
        """Take an arm's joints from now on, once the arm is known.

        Args:
            arm: whose n joints go into the history, in its order.

        """
        self._unsubscribe()
        self._history.follow(arm)
        read = JointWire(arm.joint_names).read
        self._taps.append(_Tap("joint_states", JointState, read, self._history.joints))

    def tick(self, now_s: float) -> None:
        """Begin or end to listen, and take what has come.

        Args:
            now_s: time.monotonic(), s.

        """
        if self._watchers:
            self._watched_s = now_s
            if not self.listening:
                self._subscribe()
        elif self.listening and now_s - self._watched_s > _LINGER_S:
            self._unsubscribe()
        if self.listening:
            for tap in self._taps:
                self._take(tap)

    def close(self) -> None:
        """Leave ROS."""
        self._unsubscribe()
        if self._node is not None:
            self._node.destroy_node()
            self._node = None

    def _subscribe(self) -> None:
        if self._node is None:
            self._node = Node(
                "panel_streams", context=self._context, start_parameter_services=False
            )
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        for tap in self._taps:
            tap.subscription = self._node.create_subscription(
                tap.message_type, tap.topic, _never, qos, raw=True
            )
        self.listening = True

    def _unsubscribe(self) -> None:
        for tap in self._taps:
            if tap.subscription is not None and self._node is not None:
                self._node.destroy_subscription(tap.subscription)
            tap.subscription = None
        self.listening = False

    def _take(self, tap: _Tap) -> None:
        assert tap.subscription is not None
        handle, message_type = tap.subscription.handle, tap.subscription.msg_type
        stamps: list[int] = []
        rows: list[tuple[float, ...]] = []
        with handle:
            # No more than the queue holds: a flood must not keep the thread here.
            for _ in range(_DEPTH):
                taken = handle.take_message(message_type, True)
                if taken is None:
                    break
                try:
                    stamp_ns, row = tap.read(taken[0])
                except (UnreadableError, JointStateError):
                    continue
                stamps.append(stamp_ns)
                rows.append(row)
        if not stamps:
            return
        values = np.array(rows)
        finite = np.isfinite(values).all(axis=1)
        tap.series.append(np.array(stamps, dtype=np.int64)[finite], values[finite])


def _never(_data: bytes) -> None:
    raise AssertionError("no executor has this node")
