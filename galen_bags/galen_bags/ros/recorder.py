# SPDX-License-Identifier: Apache-2.0
"""The recorder: subscribes to topics as they appear and writes their messages, byte for byte."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from galen_ros.node.diagnostics import OK, WARN, DiagnosticsPublisher, Status
from galen_ros.rclpy_workarounds import guard_parameter_services
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_bags.ros.topics import (
    check_topic_name,
    definition_of,
    message_class,
    request_for,
    to_bag,
)

DEFAULT_TOPICS = (
    "joint_states",
    "wrench_raw",
    "wrench_compensated",
    "tracker/tool_pose",
    "tracker/base_pose",
    "robot_description",
)
# Topics that many nodes publish, as they should.
_SHARED = ("/diagnostics", "/rosout", "/parameter_events", "/tf", "/tf_static")
_DISCOVER_PERIOD_S = 0.1
# Publishers that are there are found within this.
_DISCOVERY_S = 1.0
_DRAIN_PERIOD_S = 0.02
_FLUSH_PERIOD_S = 1.0
# More than a subscription's queue holds; so that one topic can't keep the others waiting for ever.
_MOST_AT_ONCE = 5000


class _Never(CallbackGroup):
    """A callback group that lets an executor take nothing."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


@dataclass
class TopicCounts:
    """What a recording has of one topic; times are log times, ns.

    Lost messages are gaps in a publisher's sequence numbers, which start at 1. They mean a loss
    only while there is one publisher: two count each for itself. So messages come in batches, and
    `end_batch` gets whether one publisher was matched all the while.
    """

    name: str
    type_name: str
    messages: int = 0
    size_bytes: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    lost: int = 0
    _last_number: int | None = None
    _gaps: int = 0
    _kept: tuple[int, int, int | None] = (0, 0, None)

    def add(self, log_time_ns: int, size_bytes: int) -> None:
        """Count a message that was written.

        Args:
            log_time_ns: its log time, ns.
            size_bytes: its length as CDR.

        """
        self.messages += 1
        self.size_bytes += size_bytes
        self.first_ns = log_time_ns if self.first_ns is None else self.first_ns
        self.last_ns = log_time_ns

    def add_number(self, sequence_number: int | None) -> None:
        """Take the number of the next message.

        Args:
            sequence_number: the publisher's, from 1; None where the middleware gives none.

        """
        last, self._last_number = self._last_number, sequence_number
        # A lower number is another publisher's: the old one was restarted.
        if sequence_number is not None and last is not None and sequence_number > last:
            self._gaps += sequence_number - last - 1

    def end_batch(self, one_publisher: bool) -> int:
        """Count the batch's gaps, or forget them.

        Args:
            one_publisher: exactly one publisher was matched all the while.

        Returns:
            How many lost messages were counted.

        """
        counted = self._gaps if one_publisher else 0
        if not one_publisher:
            self._last_number = None
        self._gaps = 0
        self.lost += counted
        return counted

    def keep(self) -> None:
        """Note that what was counted until now is in the file."""
        self._kept = (self.messages, self.size_bytes, self.last_ns)

    def take_back(self) -> None:
        """Take back what was counted since `keep`: it did not get into the file."""
        self.messages, self.size_bytes, self.last_ns = self._kept
        self.first_ns = self.first_ns if self.messages else None

    @property
    def rate_hz(self) -> float | None:
        """Mean rate by log times; None where two messages don't span any time."""
        if self.first_ns is None or self.last_ns is None or self.last_ns <= self.first_ns:
            return None
        return (self.messages - 1) / ((self.last_ns - self.first_ns) * 1e-9)

    def to_dict(self) -> dict[str, Any]:
        """Return the counts for JSON."""
        return {
            "name": self.name,
            "type": self.type_name,
            "messages": self.messages,
            "bytes": self.size_bytes,
            "lost": self.lost,
            "first_ns": self.first_ns,
            "last_ns": self.last_ns,
            "rate_hz": self.rate_hz,
        }


@dataclass
class _Topic:
    """One topic that is being recorded."""

    handle: Any
    offered: tuple[Any, ...]  # the publishers' qualities of service, as a bag has them
    message_class: Any
    subscription: Subscription
    counts: TopicCounts


def received_ns(info: Mapping[str, int | None]) -> int:
    """Return when the middleware received a message.

    Args:
        info: what rclpy gives with a taken message; `received_timestamp` in ns, system time.

    Returns:
        The time, ns; now where the middleware does not give it (Cyclone DDS).

    """
    return info["received_timestamp"] or time.time_ns()


class SimulatedTimes:
    """What the simulated clock was when messages were received, by wall time; all in ns.

    Messages are taken in batches, and a batch of 20 ms is many times that in a simulation that runs
    faster than real time. So between two looks at the clock it is taken to run evenly.
    """

    def __init__(self) -> None:
        self._before = self._now = (0, 0)

    def look(self, wall_ns: int, clock_ns: int) -> None:
        """Take what the clock is now.

        Args:
            wall_ns: system time, ns.
            clock_ns: simulated time, ns; 0 where it is not known.

        """
        self._before, self._now = self._now, (wall_ns, clock_ns)

    def at(self, received_ns: int) -> int:
        """Return what the clock was when a message was received.

        Args:
            received_ns: system time, ns, between the last two looks.

        Returns:
            Simulated time, ns; 0 where it is not known.

        """
        (from_wall, from_clock), (wall, clock) = self._before, self._now
        if from_clock == 0 or not (from_wall < wall and from_clock < clock):
            return clock
        part = min(max((received_ns - from_wall) / (wall - from_wall), 0.0), 1.0)
        return from_clock + round(part * (clock - from_clock))


class RecorderNode(Node):
    """Writes what topics carry to a bag.

    Log times are when the middleware received a message, system time in ns, as with `ros2 bag
    record`; with `use_sim_time` they are the node's clock at that time, and nothing is written
    before the first /clock.

    Messages are not taken by the executor but by a timer, in batches: only so does rclpy's events
    executor not get them without their receive times, and a batch costs a fraction of callbacks.
    The queues of the subscriptions (2000 messages each) hold what comes in between. So the node
    needs an executor that respects callback groups, such as SingleThreadedExecutor.
    """

    def __init__(
        self,
        bag: GrowingBagWriter,
        topics: Sequence[str] = DEFAULT_TOPICS,
        all_topics: bool = False,
        node_name: str = "recorder",
        **node_options: Any,
    ) -> None:
        """`topics`: names, relative ones within the node's namespace. `bag` stays the caller's.

        Raises BagError for a name that no topic can have.
        """
        super().__init__(node_name, **node_options)
        guard_parameter_services(self)
        self._bag = bag
        self._all = all_topics
        self._wanted = (
            []
            if all_topics
            else [str(self.resolve_topic_name(check_topic_name(name))) for name in topics]
        )
        self._topics: dict[str, _Topic] = {}
        self._rejected: dict[str, str] = {}
        self._warned: dict[str, str] = {}
        self._waiting: list[tuple[int, _Topic, bytes]] = []
        self._before_clock = 0
        self._ended = False
        self._use_sim_time = bool(self.get_parameter("use_sim_time").value)
        self._times = SimulatedTimes()
        self._group = _Never()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = DiagnosticsPublisher(self, "galen_recorder", self._report)
        self.discover()
        for period_s, callback in (
            (_DISCOVER_PERIOD_S, self.discover),
            (_DRAIN_PERIOD_S, self._drain),
            (_FLUSH_PERIOD_S, self._flush),
        ):
            self.create_timer(period_s, callback, clock=self._steady)
        self._first_look = self.create_timer(_DISCOVERY_S, self._say_absent, clock=self._steady)

    # --- state -------------------------------------------------------------------------------

    @property
    def counts_by_topic(self) -> list[TopicCounts]:
        """The recorded topics, by name."""
        return [self._topics[name].counts for name in sorted(self._topics)]

    @property
    def messages(self) -> int:
        """Number of messages written."""
        return sum(topic.counts.messages for topic in self._topics.values())

    def problems(self) -> dict[str, str]:
        """Return problems by topic: not seen, nothing carried, not recordable, lost messages ..."""
        found = dict(self._warned)
        for name in self._wanted:
            if name not in self._topics:
                found[name] = "no publisher was found"
        for name, topic in self._topics.items():
            if topic.counts.messages == 0:
                found[name] = "it carried nothing"
            elif topic.counts.lost:
                found[name] = f"{topic.counts.lost} of its messages were lost on the way"
        if self._before_clock:
            found["/clock"] = f"{self._before_clock} messages came before it, and were left out"
        return found | self._rejected

    # --- topics come -------------------------------------------------------------------------

    def discover(self) -> None:
        """Take up topics that have a publisher by now."""
        for name in self._published() if self._all else self._wanted:
            if name in self._topics or name in self._rejected:
                continue
            offers = self.get_publishers_info_by_topic(name)
            if not offers:
                continue
            try:
                self._take_up(name, offers)
            except BagError as error:
                self._rejected[name] = f"not recorded: {error}"
                self.get_logger().error(f"{name} is not recorded: {error}")

    def _say_absent(self) -> None:
        """Say once which topics have no publisher; `_take_up` says when one appears."""
        self._first_look.cancel()
        absent = [name for name in self._wanted if name not in (*self._topics, *self._rejected)]
        if self._use_sim_time and not self.count_publishers("/clock"):
            absent.append("/clock, without which nothing is written")
        if absent:
            self.get_logger().warning(
                f"no publisher on {', '.join(absent)}: waiting for it; is its node running, is the"
                " name right?"
            )

    def _published(self) -> list[str]:
        return [
            name
            for name, _ in self.get_topic_names_and_types()
            if not topic_or_service_is_hidden(name)
        ]

    def _take_up(self, name: str, offers: Sequence[Any]) -> None:
        types = sorted({offer.topic_type for offer in offers})
        if len(types) > 1:
            raise BagError(f"it is published with several types, {' and '.join(types)}")
        (type_name,) = types
        kind = message_class(type_name)
        profiles = [offer.qos_profile for offer in offers]
        offered = tuple(map(to_bag, profiles))
        handle = self._add_to_bag(name, type_name, offered)
        subscription = self.create_subscription(
            kind,
            name,
            self._on_executor,
            request_for(profiles),
            callback_group=self._group,
            raw=True,
        )
        counts = TopicCounts(name, type_name)
        self._topics[name] = _Topic(handle, offered, kind, subscription, counts)
        self.get_logger().info(f"recording {name} ({type_name})")

    def _add_to_bag(self, name: str, type_name: str, offered: tuple[Any, ...]) -> Any:
        known = self._bag.knows(type_name)
        return self._bag.add_topic(
            name, type_name, None if known else definition_of(type_name), offered
        )

    def change_bag(self, bag: GrowingBagWriter) -> int:
        """Go on in another bag, with the same subscriptions: nothing is lost in between.

        What has come until now goes into the old bag, which stays the caller's. Counts begin anew.

        Args:
            bag: an open bag; it gets the topics that are being recorded.

        Returns:
            How many messages the old bag then has.

        Raises:
            BagError: one of the bags can't be written.

        """
        self._write_all()
        written = self.messages
        self._bag = bag
        for name, topic in self._topics.items():
            topic.handle = self._add_to_bag(name, topic.counts.type_name, topic.offered)
            topic.counts = TopicCounts(name, topic.counts.type_name)
        return written

    # --- messages come -----------------------------------------------------------------------

    def _on_executor(self, _data: bytes) -> None:
        raise RuntimeError("the recorder needs an executor that respects callback groups")

    def _drain(self) -> None:
        now_ns = time.time_ns()
        self._take_all()
        self._waiting.sort(key=lambda item: item[0])
        if self._use_sim_time:
            self._write(self._waiting)
            self._waiting = []
            return
        # A message that came while the topics were taken may be older than one still in a queue.
        early = [item for item in self._waiting if item[0] < now_ns]
        self._waiting = self._waiting[len(early) :]
        self._write(early)

    def _take_all(self) -> None:
        if self._use_sim_time:
            self._times.look(time.time_ns(), self.get_clock().now().nanoseconds)
        for topic in self._topics.values():
            self._take(topic)

    def _take(self, topic: _Topic) -> None:
        subscription = topic.subscription
        counts = topic.counts
        one_publisher = subscription.get_publisher_count() == 1
        handle = subscription.handle
        with handle:
            for _ in range(_MOST_AT_ONCE):
                taken = handle.take_message(topic.message_class, True)
                if taken is None:
                    break
                data, info = taken
                log_ns = received_ns(info)
                if self._use_sim_time:
                    log_ns = self._times.at(log_ns)
                self._waiting.append((log_ns, topic, data))
                counts.add_number(info.get("publication_sequence_number"))
        one_publisher = one_publisher and subscription.get_publisher_count() == 1
        lost = counts.end_batch(one_publisher)
        if lost:
            self.get_logger().warning(f"{counts.name}: {lost} messages were lost on the way")

    def _write(self, items: Sequence[tuple[int, _Topic, bytes]]) -> None:
        for log_ns, topic, data in items:
            if log_ns == 0 and self._use_sim_time:
                self._before_clock += 1
                continue
            self._bag.write(topic.handle, log_ns, data)
            topic.counts.add(log_ns, len(data))

    def _flush(self) -> None:
        self._bag.flush()
        for topic in self._topics.values():
            topic.counts.keep()

    def _write_all(self) -> None:
        self._take_all()
        waiting, self._waiting = self._waiting, []
        self._write(sorted(waiting, key=lambda item: item[0]))
        self._flush()

    # --- end ---------------------------------------------------------------------------------

    def destroy_node(self) -> None:
        """Write what still waits, and go."""
        if self._ended:
            return
        self._ended = True
        try:
            if self._bag.is_open:
                self._write_all()
        finally:
            if not self._bag.is_open:  # cut back to the last flush
                for topic in self._topics.values():
                    topic.counts.take_back()
            super().destroy_node()

    # --- diagnostics -------------------------------------------------------------------------

    def _report(self) -> Status:
        self._look_at_publishers()
        problems = self.problems()
        values: dict[str, object] = {
            "state": "recording",
            "bag": self._bag.path,
            "messages": self.messages,
            "size_bytes": self._bag.size_bytes,
            "lost": sum(topic.counts.lost for topic in self._topics.values()),
            "topics": len(self._topics),
        }
        for counts in self.counts_by_topic:
            values[f"messages {counts.name}"] = counts.messages
        if problems:
            text = "; ".join(f"{name}: {problem}" for name, problem in problems.items())
            return Status(WARN, text, values)
        return Status(OK, f"recording {len(self._topics)} topics", values)

    def _look_at_publishers(self) -> None:
        for name in self._topics:
            count = self.count_publishers(name)
            if count > 1 and not self._all and name not in _SHARED and name not in self._warned:
                self._warned[name] = f"it had {count} publishers at a time"
                self.get_logger().warning(f"{name}: {self._warned[name]}")
