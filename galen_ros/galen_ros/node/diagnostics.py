# SPDX-License-Identifier: Apache-2.0
"""A node's state on /diagnostics, once a period of wall time and whenever it changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


class Level(IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


OK, WARN, ERROR, STALE = Level.OK, Level.WARN, Level.ERROR, Level.STALE


@dataclass(frozen=True)
class Status:
    """What a node says about itself.

    Numbers among `values` are written with six significant digits, booleans in lower case.
    """

    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class DiagnosticsPublisher:
    """Publish `report()` as one DiagnosticStatus, named after the node.

    The topic is absolute, `/diagnostics`: that is where every ROS tool looks. The timer runs on
    the steady clock, so that a node says it is waiting for /clock while /clock is silent.
    """

    def __init__(
        self,
        node: Node,
        hardware_id: str,
        report: Callable[[], Status],
        period_s: float = 1.0,
    ) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._report = report
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(period_s, self.publish_now, clock=self._clock)

    def publish_now(self) -> None:
        """Publish the state as it is now; call it when the state changes."""
        status = self._report()
        now = self._node.get_clock().now()
        if now.nanoseconds == 0:  # only a simulation's clock is ever zero
            text = f"{status.message}; use_sim_time is set, but no /clock came: time stands still"
            status = replace(
                status,
                level=max(status.level, Level.WARN),
                message=text,
                values={"clock": "stands still", **status.values},
            )
        message = DiagnosticArray()
        message.header.stamp = now.to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([status.level]),
                name=self._node.get_fully_qualified_name().lstrip("/"),
                message=status.message,
                hardware_id=self._hardware_id,
                values=[
                    KeyValue(key=key, value=_format(value)) for key, value in status.values.items()
                ],
            )
        ]
        self._publisher.publish(message)


def _format(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
