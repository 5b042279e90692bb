"""What a rosbag2 directory holds: its files, and what its metadata.yaml states."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml
from galen_model.files.json_fields import read_limited
from rosbags.interfaces import Qos
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

STORAGES = (".mcap", ".db3")
ZSTD_ENDING = ".zstd"
# A topic's entry has some hundred bytes, and a file's as well.
_MOST_BYTES = 1 << 20
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
        raw = read_limited(path / "metadata.yaml", _MOST_BYTES, "a bag's metadata")
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


def storage_files(directory: Path) -> list[Path]:
    """Return a rosbag2 directory's files, in the order of the numbers in their names."""
    found = [
        file
        for file in directory.iterdir()
        if file.is_file() and storage_of(file) in STORAGES and not file.name.startswith(".")
    ]
    return sorted(found, key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)] or [0])


def storage_of(path: Path) -> str:
    """Return the ending that says the storage, without that of a compression."""
    return Path(path.stem).suffix if path.suffix == ZSTD_ENDING else path.suffix


def listed_files(directory: Path) -> tuple[list[Path] | None, list[str]]:
    """Return the files that metadata.yaml lists (None: unknown), and what is wrong with it."""
    metadata = directory / "metadata.yaml"
    if not metadata.exists():
        return None, [f"{directory.name} has no metadata.yaml: its recording was cut off"]
    try:
        if not metadata.is_file():
            raise ValueError("it is no file")
        # Only names: a path in it must not lead out of the directory.
        names = dict.fromkeys(PurePath(text).name for text in _listed_paths(metadata))
        if not names:
            raise ValueError("it lists no files")
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        return None, [f"{directory.name}/metadata.yaml can't be used: {reason}"]
    listed = [directory / name for name in names]
    return listed, [
        f"{file.name} is not read: metadata.yaml does not list it"
        for file in storage_files(directory)
        if file not in listed
    ]


def _listed_paths(metadata: Path) -> list[str]:
    """Return the texts in the list of files; the rest of the file is not taken apart."""
    with metadata.open(encoding="utf-8") as file:
        found = iter(yaml.parse(file.read(_MOST_BYTES), Loader=_Loader))
        for event in found:
            if isinstance(event, yaml.ScalarEvent) and event.value == "relative_file_paths":
                break
        paths: list[str] = []
        if isinstance(next(found, None), yaml.SequenceStartEvent):
            for event in found:
                if not isinstance(event, yaml.ScalarEvent):
                    break
                paths.append(event.value)
        return paths


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
