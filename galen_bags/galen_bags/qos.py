"""Quality of service: what fits all of a topic's publishers, and the form it has in a bag."""

from __future__ import annotations

from collections.abc import Sequence

from galen_ros.qos import STREAM
from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

_NS_PER_S = 1_000_000_000


def request_for(offers: Sequence[QoSProfile]) -> QoSProfile:
    """A subscription's QoS that all these publishers can serve, as strict as they allow.

    Reliable unless one is best effort, transient local where all are; the last 2000 kept.
    """
    reliable = all(offer.reliability is not ReliabilityPolicy.BEST_EFFORT for offer in offers)
    latched = all(offer.durability is DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return _stream(reliable, latched and bool(offers))


def serves(offer: QoSProfile, request: QoSProfile) -> bool:
    """Whether messages of a publisher with this offer reach a subscription with this request."""
    if (
        request.reliability is ReliabilityPolicy.RELIABLE
        and offer.reliability is ReliabilityPolicy.BEST_EFFORT
    ):
        return False
    return (
        request.durability is not DurabilityPolicy.TRANSIENT_LOCAL
        or offer.durability is DurabilityPolicy.TRANSIENT_LOCAL
    )


def to_bag(offer: QoSProfile) -> Qos:
    """A publisher's QoS in the form that bags hold."""
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
    """A publisher's QoS that stands for the recorded publishers of a topic.

    Best effort and transient local where all of them were; else reliable and volatile. History is
    the player's own affair: DDS does not tell a publisher's, so a bag does not have it.
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
