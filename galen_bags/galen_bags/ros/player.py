# SPDX-License-Identifier: Apache-2.0
"""The player: publishes a bag's messages by their log times, and the time itself on /clock."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from galen_ros.messages import fill_stamp
from galen_ros.node.diagnostics import OK, WARN, DiagnosticsPublisher, Status
from galen_ros.rclpy_workarounds import guard_parameter_services
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from galen_bags.formats.bag import Bag
from galen_bags.formats.errors import BagError
from galen_bags.formats.files import read_metadata
from galen_bags.formats.raw_block import Messages
from galen_bags.ros.topics import message_class, offer_again
from galen_bags.timing import BagClock, Playlist, window

_CLOCK = "/clock"
_CLOCK_HZ = 100.0
_TICK_S = 0.001
# More at once could overflow the queues of receivers (2000).
_MOST_AT_ONCE = 200
# Discovery takes a moment; who was there before the player is to get the first message too.
_QUIET_S = 1.0
_ACK_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class PlayOptions:
    """How to play. `topics` None: all; `clock`: publish /clock; times in s."""

    topics: tuple[str, ...] | None = None
    rate: float = 1.0
    clock: bool = True
    start_offset_s: float = 0.0
    playback_duration_s: float | None = None
    loop: bool = False
    wait_for_subscribers_s: float = 0.0


@dataclass
class _PlayedTopic:
    """One topic that is played."""

    name: str
    publisher: Publisher
    carries: bool
    published: int = 0


def _selected_topics(bag: Bag, wanted: Sequence[str] | None) -> list[str]:
    """Full names of the wanted topics (None: all); raises BagError for one that the bag lacks."""
    if wanted is None:
        return sorted(bag.topics)
    names = [name if name.startswith("/") else f"/{name}" for name in wanted]
    for name in names:
        if name not in bag.topics:
            there = ", ".join(sorted(bag.topics)) or "none"
            raise BagError(f"{bag.path}: has no topic {name}; it has {there}")
    return list(dict.fromkeys(names))


def _make_topics(
    node: Node, bag: Bag, offers: Mapping[str, QoSProfile], own_clock: bool
) -> tuple[list[_PlayedTopic], dict[str, str]]:
    """Return publishers for the topics in `offers`, and {name: reason} of those that are left out.

    `own_clock`: the player publishes /clock itself. Raises BagError when nothing is left to play.
    """
    topics: list[_PlayedTopic] = []
    left_out: dict[str, str] = {}
    for name, offer in offers.items():
        info = bag.topics[name]
        try:
            if name == _CLOCK and own_clock:
                raise BagError("the player's own /clock takes its place")
            if info.encoding != "cdr":
                raise BagError(f"it is serialised as {info.encoding!r}, not cdr")
            kind = message_class(info.type_name)
        except BagError as reason:
            left_out[name] = str(reason)
            continue
        topics.append(
            _PlayedTopic(
                name,
                node.create_publisher(kind, name, offer),
                carries=info.count != 0,
            )
        )
    if not any(topic.carries for topic in topics):
        raise BagError(f"{bag.path}: holds no message that can be played")
    return topics, left_out


class PlayerNode(Node):
    """Publishes a bag.

    Bag time is log time: it starts at the first message (or `start_offset_s` later) when those who
    listen have been found, and runs at `rate`. /clock carries it, so nodes with `use_sim_time` live
    in the time of the recording; it is on because nodes without `use_sim_time` don't notice.
    """

    def __init__(self, bag: Bag, options: PlayOptions = PlayOptions(), **node_options: Any) -> None:
        """`bag` stays the caller's. Raises BagError for topics that the bag lacks."""
        super().__init__("player", **node_options)
        guard_parameter_services(self)
        self._bag = bag
        self._options = options
        self.acknowledged = True
        self.done = False
        self._metadata = read_metadata(bag.path)
        names = _selected_topics(bag, options.topics)
        offers = {name: offer_again(self._metadata.qos.get(name, [])) for name in names}
        self._topics, self.left_out = _make_topics(self, bag, offers, options.clock)
        for name, reason in self.left_out.items():
            self.get_logger().warning(f"{name} is not played: {reason}")
        self._timeline = BagClock(options.rate)
        self._subscribers = (0, time.monotonic())
        """How many there are, and since when."""
        self._began_s = time.monotonic()
        self._playing_since_s: float | None = None
        self._played_s = 0.0
        self._round = 0
        self._ending_since_s: float | None = None
        self._position_ns: int | None = None
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._playlist = Playlist(self._read)
        self._clock_message = ClockMessage()
        self._next_clock_s = 0.0
        self._clock_publisher = (
            self.create_publisher(ClockMessage, _CLOCK, 10) if options.clock else None
        )
        self.create_service(SetBool, "~/pause", self._on_pause)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = DiagnosticsPublisher(self, "galen_player", self._report)
        self.create_timer(_TICK_S, self._on_tick, clock=self._steady)

    # --- state -------------------------------------------------------------------------------

    @property
    def published(self) -> dict[str, int]:
        """Number of messages by topic."""
        return {topic.name: topic.published for topic in self._topics}

    @property
    def state(self) -> str:
        """`waiting` (subscribers), `playing`, `paused`, `ending` (acknowledgements), `done`."""
        if self.done:
            return "done"
        if self._ending_since_s is not None:
            return "ending"
        if self._playing_since_s is None:
            return "waiting"
        return "paused" if self._timeline.paused else "playing"

    @property
    def lag_s(self) -> float:
        """By how much the replay is late, because this machine or the bag's was too slow."""
        return self._timeline.lag_s

    @property
    def position_s(self) -> float:
        """Bag time since the start of what is played."""
        if self._position_ns is None or self._first_ns is None:
            return 0.0
        return (self._position_ns - self._first_ns) * 1e-9

    @property
    def length_s(self) -> float | None:
        """Bag time from start to end of what is played; None where the bag does not tell."""
        if self._first_ns is None or self._last_ns is None:
            return None
        return max(0.0, (self._last_ns - self._first_ns) * 1e-9)

    @property
    def played_s(self) -> float:
        """Wall time from the first message to the last."""
        return self._played_s

    # --- reading, in a thread ----------------------------------------------------------------

    def _read(self) -> Iterator[Messages]:
        options = self._options
        start_ns = self._metadata.start_ns
        if start_ns is None:
            everything = [n for n, info in self._bag.topics.items() if info.encoding == "cdr"]
            first = next(self._bag.blocks(everything), None)
            start_ns = 0 if first is None else int(first.log_time_ns[0])
        first_ns = start_ns + round(options.start_offset_s * 1e9)
        last_ns = None
        if options.playback_duration_s is not None:
            last_ns = first_ns + round(options.playback_duration_s * 1e9)
        ends = [ns for ns in (last_ns, self._metadata.end_ns) if ns is not None]
        self._first_ns, self._last_ns = first_ns, min(ends, default=None)
        return window(self._bag.blocks([topic.name for topic in self._topics]), first_ns, last_ns)

    def _rewind(self) -> None:
        self._playlist.close()
        self._playlist = Playlist(self._read)

    # --- time --------------------------------------------------------------------------------

    def _on_tick(self) -> None:
        if self.done:
            return
        now_s = time.monotonic()
        if self._ending_since_s is not None:
            self._wait_for_acknowledgements(now_s)
        elif self._playing_since_s is None:
            self._start_if_ready(now_s)
        else:
            self._play(now_s)
        self._publish_clock(now_s)

    def _start_if_ready(self, now_s: float) -> None:
        options = self._options
        counts = [topic.publisher.get_subscription_count() for topic in self._topics]
        if self._subscribers[0] != sum(counts):
            self._subscribers = (sum(counts), now_s)
        settled = now_s - self._subscribers[1] >= _QUIET_S
        lonely = any(
            topic.carries and not count for topic, count in zip(self._topics, counts, strict=True)
        )
        waited_s = now_s - self._began_s
        if not settled:
            return
        if lonely and waited_s < options.wait_for_subscribers_s:
            return
        if self._playlist.peek_ns() is None and not self._playlist.ended:
            return
        if self._playlist.ended:
            raise BagError(f"{self._bag.path}: holds no message in the part that is to be played")
        assert self._first_ns is not None
        if not self._round:
            length = "" if self.length_s is None else f"{self.length_s:.1f} s of "
            self.get_logger().info(f"playing {length}{self._bag.path} at rate {options.rate:g}")
        self._round += 1
        self._playing_since_s = now_s
        self._timeline.start(self._first_ns, now_s)
        self._position_ns = self._first_ns

    def _play(self, now_s: float) -> None:
        if self._timeline.paused:
            return
        bag_ns = self._timeline.advance(now_s)
        for _ in range(_MOST_AT_ONCE):
            due_ns = self._playlist.peek_ns()
            if due_ns is None or due_ns > bag_ns:
                break
            self._publish_next()
        if self._playlist.ended:
            assert self._playing_since_s is not None
            self._played_s = now_s - self._playing_since_s
            self._end_or_rewind(now_s)
            return
        due_ns, position_ns = self._playlist.peek_ns(), self._position_ns
        assert position_ns is not None
        if due_ns is None or due_ns < bag_ns:  # not read yet, or too much at once
            bag_ns = position_ns if due_ns is None else due_ns
            self._timeline.hold(bag_ns, now_s)
        self._position_ns = bag_ns

    def _publish_next(self) -> None:
        number, log_time_ns, data = self._playlist.pop()
        topic = self._topics[number]
        topic.publisher.publish(data)
        topic.published += 1
        self._position_ns = log_time_ns

    def _end_or_rewind(self, now_s: float) -> None:
        if self._options.loop:
            self._rewind()
            self._playing_since_s = None
        else:
            self._ending_since_s = now_s
            self._next_clock_s = now_s  # the last time goes out, too
        self._diagnostics.publish_now()

    def _wait_for_acknowledgements(self, now_s: float) -> None:
        """Wait, for the process must not end before the last messages have arrived."""
        assert self._ending_since_s is not None
        publishers = [topic.publisher for topic in self._topics]
        if self._clock_publisher is not None:
            publishers.append(self._clock_publisher)
        self.acknowledged = all(
            publisher.wait_for_all_acked(Duration(nanoseconds=0)) for publisher in publishers
        )
        if self.acknowledged or now_s - self._ending_since_s > _ACK_TIMEOUT_S:
            self.done = True
            self._diagnostics.publish_now()

    def _publish_clock(self, now_s: float) -> None:
        publisher, bag_ns = self._clock_publisher, self._position_ns
        if publisher is None or bag_ns is None or now_s < self._next_clock_s:
            return
        period_s = 1.0 / _CLOCK_HZ
        self._next_clock_s = max(self._next_clock_s + period_s, now_s)
        fill_stamp(self._clock_message.clock, bag_ns)
        publisher.publish(self._clock_message)

    # --- service, diagnostics, end -----------------------------------------------------------

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        self._timeline.pause(request.data, time.monotonic())
        response.success = True
        response.message = f"{'paused' if request.data else 'running'} at {self.position_s:.3f} s"
        self._diagnostics.publish_now()
        return response

    def _report(self) -> Status:
        values: dict[str, object] = {
            "state": self.state,
            "bag": self._bag.path,
            "position_s": self.position_s,
            "rate": self._options.rate,
            "round": self._round,
            "lag_s": self.lag_s,
            "messages": sum(topic.published for topic in self._topics),
        }
        if self.length_s is not None:
            values["length_s"] = self.length_s
        troubles = [f"{name} is left out: {reason}" for name, reason in self.left_out.items()]
        troubles += [
            f"{topic.name} has {count} publishers: is the arm's driver running too?"
            for topic in self._topics
            if (count := self.count_publishers(topic.publisher.topic_name)) > 1
            and topic.name not in ("/diagnostics", "/rosout", "/parameter_events", "/tf")
        ]
        if self._clock_publisher is not None and self.count_publishers(_CLOCK) > 1:
            troubles.append("another node publishes /clock, too")
        if troubles:
            return Status(WARN, "; ".join(itertools.islice(troubles, 5)), values)
        return Status(OK, self.state, values)

    def destroy_node(self) -> None:
        """End the reading thread, and go."""
        self._playlist.close()
        super().destroy_node()
