"""The bags and the diagnosis recordings below a directory, from their metadata alone. No ROS.

An archive may hold thousands: the search asks the file system only, and what metadata says is read
for those that are shown. The browser names a recording by the id that it got from here, never by a
path.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path

from galen_bags.errors import BagError
from galen_bags.formats.find import find_bags
from galen_bags.formats.metadata import BagMetadata, read_metadata, storage_files
from galen_diagnosis.observation.rows import BAGS
from galen_model.errors import one_line

from galen_panel.messages import texts

TOOL_BESIDE = "tool.json"
_METADATA = "metadata.yaml"
_MAGIC = {".mcap": b"\x89MCAP", ".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V"}
_ID_LETTERS = 16
_HEAD_BYTES = 4096
_BEGAN = re.compile(rb"starting_time:\s*nanoseconds_since_epoch:\s*(\d{1,19})\b")


class RecordingKind(Enum):
    """What can be done with it: a bag is evaluated, a diagnosis recording is diagnosed."""

    BAG = "bag"
    DIAGNOSIS = "diagnosis recording"


@dataclass(frozen=True)
class FoundRecording:
    """One of them, as the search found it.

    name: its path below the directory. at_s: when it was recorded, s since 1970; where its metadata
    doesn't say it, when it was written. parts: of a diagnosis recording its bags.
    """

    id: str
    kind: RecordingKind
    name: str
    path: Path
    at_s: float
    parts: tuple[FoundRecording, ...] = ()


@dataclass(frozen=True)
class Details:
    """What its files' sizes and its metadata say.

    start_ns, duration_s: None where no metadata says it. topics: messages by name, empty where no
    metadata names them. problem: why it can't be used; note: what is wrong with it otherwise.
    """

    size_bytes: int = 0
    start_ns: int | None = None
    duration_s: float | None = None
    topics: dict[str, int] = field(default_factory=dict)
    problem: str = ""
    note: str = ""


@dataclass(frozen=True)
class Index:
    """What was found, the newest first, and why nothing was."""

    directory: Path
    recordings: tuple[FoundRecording, ...] = ()
    problem: str = ""

    def get(self, recording_id: str) -> FoundRecording | None:
        """The recording of an id; None where there is none."""
        return next((one for one in self.recordings if one.id == recording_id), None)

    def matching(self, text: str) -> list[FoundRecording]:
        """Those whose name or kind holds each word of a text; case makes no difference."""
        words = text.casefold().split()
        return [
            one
            for one in self.recordings
            if all(word in f"{one.name} {one.kind.value}".casefold() for word in words)
        ]


def find_recordings(directory: Path) -> Index:
    """Search a directory; takes as long as the disk does. Nothing is raised."""
    try:
        bags = find_bags([directory])
    except BagError as error:
        return Index(directory, problem=str(error))
    found = [_recording(bag, RecordingKind.BAG, directory, _at_s(bag)) for bag in bags]
    for folder, parts in _sets(found):
        began_s = min(part.at_s for part in parts)
        one = _recording(folder, RecordingKind.DIAGNOSIS, directory, began_s)
        found.append(replace(one, parts=tuple(parts)))
    return Index(directory, tuple(sorted(found, key=lambda one: (-one.at_s, one.name))))


def look_at(recording: FoundRecording, directory: Path) -> Details:
    """Read a recording's metadata. Nothing is raised: what can't be read is a problem, told."""
    root = directory.resolve()
    if recording.kind is RecordingKind.BAG:
        return _look_at_bag(recording.path, directory, root)
    return _look_at_set(recording, directory, root)


def leads_out(path: Path, root: Path) -> bool:
    """Whether a path, its links followed, is outside of root, which has none."""
    try:
        return not path.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # such as links in a circle, up to Python 3.12
        return True


def _recording(path: Path, kind: RecordingKind, directory: Path, at_s: float) -> FoundRecording:
    relative = os.path.relpath(path, directory)
    whole = f"{kind.value}:{relative}".encode(errors="surrogateescape")
    name = one_line(directory.resolve().name if relative == "." else relative)
    digest = hashlib.sha256(whole).hexdigest()[:_ID_LETTERS]
    return FoundRecording(digest, kind, name, path, at_s)


def _at_s(path: Path) -> float:
    """When a bag was recorded, in a look at its metadata's head: all of it takes 30 ms to parse."""
    try:
        with (path / _METADATA).open("rb") as stream:
            began = _BEGAN.search(stream.read(_HEAD_BYTES))
        if began is not None:
            return float(int(began[1]) * 1e-9)
    except OSError:
        pass
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _sets(bags: Iterable[FoundRecording]) -> Iterator[tuple[Path, list[FoundRecording]]]:
    """Folders with the bags of a diagnosis recording, and these."""
    folders: dict[Path, list[FoundRecording]] = {}
    for bag in bags:
        if bag.path.name in BAGS and bag.path.is_dir():
            folders.setdefault(bag.path.parent, []).append(bag)
    for folder, parts in folders.items():
        # One bag of such a name alone is any recording; with a calibration file beside it is meant.
        if len(parts) > 1 or (folder / TOOL_BESIDE).is_file():
            yield folder, parts


def _look_at_bag(path: Path, directory: Path, root: Path) -> Details:
    metadata_file = path / _METADATA
    try:
        files = storage_files(path) if path.is_dir() else [path]
        has_metadata = metadata_file.exists()
        parts = [*files, metadata_file] if has_metadata else files
        if any(leads_out(part, root) for part in (path, *parts)):
            return Details(problem=f"It is a link that leads out of {directory}.")
        size_bytes = sum(file.stat().st_size for file in files)
        problem = _broken(files)
    except OSError as error:
        return Details(problem=f"It can't be read: {error.strerror}.")
    metadata = read_metadata(path) if has_metadata else BagMetadata()
    duration_s = None
    if metadata.start_ns is not None and metadata.end_ns is not None:
        duration_s = (metadata.end_ns - metadata.start_ns) * 1e-9
    return Details(
        size_bytes=size_bytes,
        start_ns=metadata.start_ns,
        duration_s=duration_s,
        topics=dict(sorted(metadata.counts.items())),
        problem=problem,
        note=_note(path, has_metadata, metadata),
    )


def _broken(files: list[Path]) -> str:
    """Why its first file can't be one of a bag; empty where it can."""
    if not files:
        return "Its files are missing."
    first = files[0]
    magic = _MAGIC.get(first.suffix)
    with first.open("rb") as stream:
        head = stream.read(16)
    if not head:
        return f"{first.name} is empty."
    if magic is not None and not head.startswith(magic):
        return f"{first.name} is no {first.suffix} file."
    return ""


def _note(path: Path, has_metadata: bool, metadata: BagMetadata) -> str:
    if not has_metadata:
        if path.is_dir():
            return f"It has no {_METADATA}: its recording was cut off."
        return f"A file alone, without {_METADATA}: its length and topics are not known here."
    if not metadata.counts:
        return f"Its {_METADATA} is damaged or names no topic."
    return ""


def _look_at_set(recording: FoundRecording, directory: Path, root: Path) -> Details:
    folder = recording.path
    parts = {part.path.name: _look_at_bag(part.path, directory, root) for part in recording.parts}
    problems = [f"{name}: {part.problem}" for name, part in parts.items() if part.problem]
    # A diagnosis opens whatever has these names, also what is no bag and so was not found.
    for entry in (*(folder / name for name in BAGS), folder / TOOL_BESIDE):
        if entry.name not in parts and entry.exists() and leads_out(entry, root):
            problems.append(f"{entry.name} is a link that leads out of {directory}.")
    lacks = [name for name in BAGS if name not in parts]
    notes = [f"It lacks {', '.join(lacks)}."] if lacks else []
    if not (folder / TOOL_BESIDE).is_file():
        notes.append(f"It has no {TOOL_BESIDE}.")
    starts = [part.start_ns for part in parts.values() if part.start_ns is not None]
    lengths = [part.duration_s for part in parts.values() if part.duration_s is not None]
    topics: dict[str, int] = {}
    for part in parts.values():
        for topic, count in part.topics.items():
            topics[topic] = topics.get(topic, 0) + count
    return Details(
        size_bytes=sum(part.size_bytes for part in parts.values()),
        start_ns=min(starts, default=None),
        duration_s=sum(lengths) if len(lengths) == len(parts) else None,
        topics=topics,
        problem=" ".join(problems),
        note=" ".join(notes),
    )


VERBS = {"evaluate": "Evaluation", "diagnose": "Diagnosis"}
"""By the kind of a job or a report."""


def line_of(recording: FoundRecording, details: Details) -> str:
    """When, how long, how large, in a line."""
    parts = [texts.date(datetime.fromtimestamp(recording.at_s, UTC).isoformat(timespec="seconds"))]
    if details.duration_s is not None:
        parts.append(f"{details.duration_s:.0f} s")
    parts.append(_size(details.size_bytes))
    if recording.kind is RecordingKind.DIAGNOSIS:
        parts.append(recording.kind.value)
    return ", ".join(parts)


def facts_of(recording: FoundRecording, details: Details) -> str:
    """All that metadata says of it, and what is wrong with it; a line each."""
    lines = [line_of(recording, details)]
    if details.problem:
        lines.append(f"It can't be used. {details.problem}")
    if details.note:
        lines.append(details.note)
    lines += [f"{topic}: {texts.count(n, 'message')}" for topic, n in details.topics.items()]
    return "\n".join(lines)


def _size(size_bytes: int) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= size:
            return f"{size_bytes / size:.1f} {unit}"
    return f"{size_bytes} B"
