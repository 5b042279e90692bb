"""The topics of a bag that a player can publish, and why others are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from galen_bags.errors import BagError
from galen_bags.formats.bag import Bag
from galen_bags.topics import message_class

CLOCK = "/clock"


@dataclass
class PlayedTopic:
    """One topic that is played; `stamped`: its messages start with a header."""

    name: str
    publisher: Publisher
    stamped: bool
    carries: bool
    published: int = 0


def selected_topics(bag: Bag, wanted: Sequence[str] | None) -> list[str]:
    """Full names of the wanted topics (None: all); raises BagError for one that the bag lacks."""
    if wanted is None:
        return sorted(bag.topics)
    names = [name if name.startswith("/") else f"/{name}" for name in wanted]
    for name in names:
        if name not in bag.topics:
            there = ", ".join(sorted(bag.topics)) or "none"
            raise BagError(f"{bag.path}: has no topic {name}; it has {there}")
    return list(dict.fromkeys(names))


def make_topics(
    node: Node, bag: Bag, offers: Mapping[str, QoSProfile], own_clock: bool
) -> tuple[list[PlayedTopic], dict[str, str]]:
    """Return publishers for the topics in `offers`, and {name: reason} of those that are left out.

    `own_clock`: the player publishes /clock itself. Raises BagError when nothing is left to play.
    """
    topics: list[PlayedTopic] = []
    left_out: dict[str, str] = {}
    for name, offer in offers.items():
        info = bag.topics[name]
        try:
            if name == CLOCK and own_clock:
                raise BagError("the player's own /clock takes its place")
            if info.encoding != "cdr":
                raise BagError(f"it is serialised as {info.encoding!r}, not cdr")
            kind = message_class(info.type_name)
        except BagError as reason:
            left_out[name] = str(reason)
            continue
        fields = list(kind.get_fields_and_field_types().values())
        topics.append(
            PlayedTopic(
                name,
                node.create_publisher(kind, name, offer),
                stamped=fields[:1] == ["std_msgs/Header"],
                carries=info.count != 0,
            )
        )
    if not any(topic.carries for topic in topics):
        raise BagError(f"{bag.path}: holds no message that can be played")
    return topics, left_out
