"""What a recording has of one topic: counts, times, and how many messages were lost."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


class LossCounter:
    """Counts the gaps in a publisher's sequence numbers, which start at 1.

    They tell only while there is one publisher: two count each for itself. So messages come in
    batches, and `end_batch` says whether one publisher was matched all the while.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last: int | None = None
        self._gaps = 0

    def add(self, sequence_number: int | None) -> None:
        """Take the number of the next message; None where the middleware gives none."""
        if sequence_number is None:
            self._last = None
            return
        # A lower number is another publisher's: the old one was restarted.
        if self._last is not None and sequence_number > self._last:
            self._gaps += sequence_number - self._last - 1
        self._last = sequence_number

    def end_batch(self, one_publisher: bool) -> int:
        """Count the batch's gaps, or forget them; returns how many were counted."""
        counted = self._gaps if one_publisher else 0
        if not one_publisher:
            self._last = None
        self._gaps = 0
        self.lost += counted
        return counted


@dataclass
class TopicCounts:
    """Counts of one recorded topic; times are log times, ns."""

    name: str
    type_name: str
    messages: int = 0
    size_bytes: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    losses: LossCounter = field(default_factory=LossCounter)
    _kept: tuple[int, int, int | None] = (0, 0, None)

    def add(self, log_time_ns: int, size_bytes: int) -> None:
        """Take note of a message that was written."""
        self.messages += 1
        self.size_bytes += size_bytes
        self.first_ns = log_time_ns if self.first_ns is None else self.first_ns
        self.last_ns = log_time_ns

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
            "lost": self.losses.lost,
            "first_ns": self.first_ns,
            "last_ns": self.last_ns,
            "rate_hz": self.rate_hz,
        }


def topic_table(counts_by_topic: list[TopicCounts]) -> str:
    """Return the tallies as lines of text, aligned."""
    width = max((len(counts.name) for counts in counts_by_topic), default=0)
    lines = []
    for counts in counts_by_topic:
        rate = "" if counts.rate_hz is None else f"{counts.rate_hz:9.1f} Hz"
        lost = f"  {counts.losses.lost} lost" if counts.losses.lost else ""
        lines.append(
            f"  {counts.name:<{width}} {counts.messages:>9} messages {rate:12}"
            f"  {counts.type_name}{lost}"
        )
    return "\n".join(lines)
