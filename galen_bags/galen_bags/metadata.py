"""What a rosbag2 directory's metadata.yaml says about times and quality of service."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos


@dataclass(frozen=True)
class BagMetadata:
    """Log times of the first and the last message, ns; offered QoS by topic."""

    start_ns: int | None = None
    end_ns: int | None = None
    qos: dict[str, list[Qos]] = field(default_factory=dict)


def read_metadata(path: Path) -> BagMetadata:
    """Read metadata.yaml; nothing is known where there is none, or where it is damaged.

    That is no error here: `open_bag` reports it, and reads the messages all the same.
    """
    try:
        content = yaml.safe_load((path / "metadata.yaml").read_text(encoding="utf-8"))
        known = content["rosbag2_bagfile_information"]
        qos = {}
        for entry in known["topics_with_message_count"]:
            topic = entry["topic_metadata"]
            qos[topic["name"]] = parse_qos(topic.get("offered_qos_profiles") or [])
        if not known["message_count"]:
            return BagMetadata(qos=qos)
        start_ns = int(known["starting_time"]["nanoseconds_since_epoch"])
        return BagMetadata(start_ns, start_ns + int(known["duration"]["nanoseconds"]), qos)
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, ReaderError):
        return BagMetadata()
