"""A recording in words. No ROS, no NiceGUI."""

from __future__ import annotations

from datetime import UTC, datetime

from galen_panel.messages import texts
from galen_panel.recordings.index import Details, Recording, RecordingKind

VERBS = {"evaluate": "Evaluation", "diagnose": "Diagnosis"}
"""By the kind of a job or a report."""


def line_of(recording: Recording, details: Details) -> str:
    """When, how long, how large, in a line."""
    parts = [texts.date(datetime.fromtimestamp(recording.at_s, UTC).isoformat(timespec="seconds"))]
    if details.duration_s is not None:
        parts.append(f"{details.duration_s:.0f} s")
    parts.append(_size(details.size_bytes))
    if recording.kind is RecordingKind.DIAGNOSIS:
        parts.append(recording.kind.value)
    return ", ".join(parts)


def facts_of(recording: Recording, details: Details) -> str:
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
