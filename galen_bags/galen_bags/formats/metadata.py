"""What a rosbag2 directory's metadata.yaml says about times and quality of service."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from galen_model.files.json_fields import read_limited
from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

# A topic's entry has some hundred bytes, and a file's as well.
MOST_BYTES = 1 << 20
# rosbag2 writes half as many levels.
_DEEPEST = 20


@dataclass(frozen=True)
class BagMetadata:
    """Log times of the first and the last message, ns; offered QoS and messages by topic."""

    start_ns: int | None = None
    end_ns: int | None = None
    qos: dict[str, list[Qos]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)


def read_metadata(path: Path) -> BagMetadata:
    """Read metadata.yaml; nothing is known where there is none, or where it is damaged.

    That is no error here: `open_bag` reports it, and reads the messages all the same.
    """
    try:
        raw = read_limited(path / "metadata.yaml", MOST_BYTES, "a bag's metadata")
        content = yaml.load(raw.decode(), Loader=_Loader)
        known = content["rosbag2_bagfile_information"]
        qos, counts = {}, {}
        for entry in known["topics_with_message_count"]:
            topic = entry["topic_metadata"]
            qos[topic["name"]] = parse_qos(topic.get("offered_qos_profiles") or [])
            counts[topic["name"]] = int(entry["message_count"])
        if not known["message_count"]:
            return BagMetadata(qos=qos, counts=counts)
        start_ns = int(known["starting_time"]["nanoseconds_since_epoch"])
        end_ns = start_ns + int(known["duration"]["nanoseconds"])
        return BagMetadata(start_ns, end_ns, qos, counts)
    except (
        OSError, ValueError, OverflowError, yaml.YAMLError, LookupError, TypeError, AttributeError,
        RecursionError, ReaderError,
    ):  # fmt: skip
        return BagMetadata()


def events(text: str) -> Iterator[yaml.Event]:
    """YAML's events of a metadata.yaml, one by one; raises yaml.YAMLError."""
    found: Iterator[yaml.Event] = yaml.parse(text, Loader=_Loader)
    return found


class _Loader(yaml.SafeLoader):
    """Without what rosbag2 never writes and what makes a small file long to read.

    A few lines of aliases stand for gigabytes; a few thousand levels take a minute.
    """

    def fetch_flow_collection_start(self, token_class: Any) -> None:
        """As the base's, for each `[` and `{`."""
        if self.flow_level >= _DEEPEST:
            raise yaml.YAMLError("too deep")
        super().fetch_flow_collection_start(token_class)

    def add_indent(self, column: int) -> bool:
        """As the base's, for each list or mapping without brackets."""
        if len(self.indents) >= _DEEPEST:
            raise yaml.YAMLError("too deep")
        return bool(super().add_indent(column))

    def compose_node(self, parent: Any, index: Any) -> Any:
        """As the base's, which would follow an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)
