# SPDX-License-Identifier: Apache-2.0
"""Topics as ROS and bags name them: valid names, message types, quality of service."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_path
from galen_ros.messages import STREAM
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.validate_topic_name import validate_topic_name
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from galen_bags.formats.errors import BagError

_TYPE = re.compile(r"^\s*(?P<type>[A-Za-z][\w/]*)(\[[<=\d]*\])?\s+[A-Za-z]", re.MULTILINE)
_BUILT_IN = re.compile(r"bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string(<=\d+)?")
_SEPARATOR = "=" * 80
_NS_PER_S = 1_000_000_000


def check_topic_name(name: str) -> str:
    """Check that a topic can have this name.

    Args:
        name: absolute, relative or private (~).

    Returns:
        The same name.

    Raises:
        BagError: no topic can have it.

    """
    try:
        validate_topic_name(name)
    except InvalidTopicNameException as error:
        reason = str(error).splitlines()[0].removeprefix("Invalid topic name: ").rstrip(":")
        raise BagError(f"{name!r} is no name of a topic: {reason}") from error
    return name


# Message types


def message_class(type_name: str) -> Any:
    """Return the class of a message type.

    Args:
        type_name: such as "galen_msgs/msg/DeflectionStamped".

    Returns:
        The class that rosidl has generated.

    Raises:
        BagError: the type is not installed here.

    """
    try:
        package, folder, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.{folder}"), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise BagError(f"the type {type_name} is not installed here") from error


def definition_of(type_name: str) -> str:
    """Return the type's installed definition.

    Args:
        type_name: such as "galen_msgs/msg/DeflectionStamped".

    Returns:
        Its .msg text with all types in it, as MCAP's `ros2msg` wants it.

    Raises:
        BagError: the type, or one in it, is not installed here.

    """
    return find_definition(type_name, lambda package: Path(get_package_share_path(package)))


def find_definition(type_name: str, share_of: Callable[[str], Path]) -> str:
    """Return the text of a type and of all types in it, as MCAP's `ros2msg` wants it.

    Args:
        type_name: as in "galen_msgs/msg/DeflectionStamped".
        share_of: returns the share directory of a package, or raises LookupError.

    Returns:
        The type's .msg text, then those of the types in it, each once, after a line of =.

    Raises:
        BagError: a type is missing; the message names it.

    """
    texts = {type_name: _read(type_name, share_of)}
    waiting = _types_in(type_name, texts[type_name])
    while waiting:
        name = waiting.pop(0)
        if name not in texts:
            texts[name] = _read(name, share_of)
            waiting += _types_in(name, texts[name])
    first, *others = texts.items()
    parts = [first[1]]
    parts += [f"{_SEPARATOR}\nMSG: {_short(name)}\n{text}" for name, text in others]
    return "\n".join(parts)


def _read(type_name: str, share_of: Callable[[str], Path]) -> str:
    package, folder, name = type_name.split("/")
    try:
        return (share_of(package) / folder / f"{name}.msg").read_text(encoding="utf-8")
    except (LookupError, OSError) as error:
        raise BagError(f"no definition of {type_name} is installed here: {error}") from error


def _types_in(type_name: str, text: str) -> list[str]:
    package = type_name.split("/")[0]
    found = []
    for match in _TYPE.finditer(text):
        name = match["type"]
        if not _BUILT_IN.fullmatch(name):
            parts = name.split("/")
            found.append(f"{package if len(parts) == 1 else parts[0]}/msg/{parts[-1]}")
    return found


def _short(type_name: str) -> str:
    package, _, name = type_name.split("/")
    return f"{package}/{name}"


# Quality of service


def request_for(offers: Sequence[QoSProfile]) -> QoSProfile:
    """Return a subscription's QoS that all these publishers can serve, as strict as they allow.

    Args:
        offers: QoS of a topic's publishers.

    Returns:
        Reliable unless one is best effort, transient local where all are; the last 2000 kept.

    """
    reliable = all(offer.reliability is not ReliabilityPolicy.BEST_EFFORT for offer in offers)
    latched = all(offer.durability is DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return _stream(reliable, latched and bool(offers))


def to_bag(offer: QoSProfile) -> Qos:
    """Return a publisher's QoS in the form that bags hold.

    Args:
        offer: what the publisher offers.

    Returns:
        The same, as `BagWriter.add_topic` takes it.

    """
    return Qos(
        QosHistory[offer.history.name],
        offer.depth,
        QosReliability[offer.reliability.name],
        QosDurability[offer.durability.name],
        _to_bag_time(offer.deadline),
        _to_bag_time(offer.lifespan),
        QosLiveliness[offer.liveliness.name],
        _to_bag_time(offer.liveliness_lease_duration),
        offer.avoid_ros_namespace_conventions,
    )


def offer_again(recorded: Sequence[Qos]) -> QoSProfile:
    """Return a publisher's QoS that stands for the recorded publishers of a topic.

    Args:
        recorded: their QoS as the bag holds them; none where the bag doesn't.

    Returns:
        Best effort and transient local where all of them were; else reliable and volatile. History
        is the player's own affair: DDS does not announce a publisher's, so a bag does not have it.

    """
    best_effort = bool(recorded) and all(
        qos.reliability is QosReliability.BEST_EFFORT for qos in recorded
    )
    latched = bool(recorded) and all(
        qos.durability is QosDurability.TRANSIENT_LOCAL for qos in recorded
    )
    return _stream(not best_effort, latched)


def _stream(reliable: bool, latched: bool) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=STREAM.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.AUTOMATIC,
    )


def _to_bag_time(duration: Duration) -> QosTime:
    return QosTime(*divmod(duration.nanoseconds, _NS_PER_S))
