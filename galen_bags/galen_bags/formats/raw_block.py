# SPDX-License-Identifier: Apache-2.0
"""What all formats give: topics, blocks of serialised messages in order, problems of a file."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from galen_model.errors import one_line

# A block of a joint state's or a wrench's messages is about 2 MB; larger ones make it shorter.
BLOCK_MESSAGES = 1 << 14
_PACK_BYTES = 1 << 23
# Stretches that overlap are held until their turn comes: this much, and no more.
MOST_HELD_BYTES = 1 << 28
_MOST_PROBLEMS = 20


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag. `type_name` as in "sensor_msgs/msg/JointState"; `count` None: not known.

    `definition` is the type's text in the form `definition_form` ("ros2msg", "ros2idl", ""), where
    the bag holds one.
    """

    name: str
    type_name: str
    count: int | None
    encoding: str = "cdr"
    definition_form: str = ""
    definition: str = ""


@dataclass(frozen=True)
class Messages:
    """Messages in order of log time.

    topic (n,) number of each one's topic; log_time_ns (n,) int64; message k is
    `data[start[k] : start[k] + size[k]]`, as CDR.
    """

    topic: np.ndarray
    log_time_ns: np.ndarray
    data: np.ndarray
    start: np.ndarray
    size: np.ndarray

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.topic)

    def message(self, index: int) -> bytes:
        """Return one message.

        Args:
            index: its place in the block.

        Returns:
            A copy of its bytes, CDR.

        """
        start = self.start[index]
        return self.data[start : start + self.size[index]].tobytes()

    def in_order(self) -> bool:
        """Return whether the log times never go back."""
        return bool(np.all(self.log_time_ns[1:] >= self.log_time_ns[:-1]))

    def sorted(self) -> Messages:
        """Return the same in order of log time; messages of one time keep their order."""
        if self.in_order():
            return self
        return self.rows(np.argsort(self.log_time_ns, kind="stable"))

    def rows(self, rows: slice | np.ndarray) -> Messages:
        """Return some of the messages, in the same buffer.

        Args:
            rows: slice, indices or mask (n,) of the messages, which come in this order.

        Returns:
            The messages; `data` is shared, not copied.

        """
        return Messages(
            self.topic[rows], self.log_time_ns[rows], self.data, self.start[rows], self.size[rows]
        )

    def pieces(self) -> Iterator[Messages]:
        """Return the same in blocks of at most BLOCK_MESSAGES."""
        if len(self) <= BLOCK_MESSAGES:
            if len(self):
                yield self
            return
        for first in range(0, len(self), BLOCK_MESSAGES):
            yield self.rows(slice(first, first + BLOCK_MESSAGES))


def windows(data: np.ndarray, length: int) -> np.ndarray:
    """Return all runs of a buffer, without a copy.

    Args:
        data: bytes (n,), contiguous.
        length: bytes a run; at most n.

    Returns:
        Runs (n - length + 1, length), each one byte after the one before; a view of `data`.

    """
    return np.ndarray((len(data) - length + 1, length), np.uint8, data, strides=(1, 1))


def pack(topic: Sequence[int], log_time_ns: Sequence[int], messages: Sequence[bytes]) -> Messages:
    """Put single messages into one buffer.

    Args:
        topic: number of each message's topic.
        log_time_ns: log time of each, ns.
        messages: bytes of each, CDR.

    Returns:
        The messages, in the order given.

    """
    size = np.array([len(message) for message in messages], dtype=np.int64)
    return Messages(
        np.array(topic, dtype=np.int32),
        np.array(log_time_ns, dtype=np.int64),
        np.frombuffer(b"".join(messages), np.uint8),
        np.cumsum(size) - size,
        size,
    )


def packed(messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Messages]:
    """Put single messages into blocks.

    Args:
        messages: (number of the topic, log time in ns, bytes) of each, in order of log time.

    Yields:
        Blocks of at most BLOCK_MESSAGES, and of about 8 MB where messages are large.

    """
    batch: list[tuple[int, int, bytes]] = []
    held = 0
    for message in messages:
        batch.append(message)
        held += len(message[2])
        if len(batch) == BLOCK_MESSAGES or held >= _PACK_BYTES:
            yield pack(*zip(*batch, strict=True))
            batch, held = [], 0
    if batch:
        yield pack(*zip(*batch, strict=True))


class TimeOrder:
    """Take stretches in order of their first times; give messages in order of log time.

    Messages of one time come in the order of their places in the file. More than MOST_HELD_BYTES
    are not held: then messages come out of order, and `overfull` is set.
    """

    def __init__(self) -> None:
        """Start with nothing held."""
        # (first time, place, messages); a place is there once, so messages are never compared.
        self._held: list[tuple[int, int, Messages]] = []
        self._held_bytes = 0
        self.overfull = False

    def add(self, place: int, messages: Messages) -> None:
        """Take the messages of a stretch.

        Args:
            place: where the stretch begins in the file, bytes; another one for each.
            messages: in any order of log time; none is all right.

        """
        if len(messages):
            self._hold(place, messages.sorted())

    def ready(self, next_ns: int | None, next_place: int) -> Iterator[Messages]:
        """Yield what comes before the next stretch.

        Args:
            next_ns: first log time of the next stretch, ns; None: there is none, and all comes.
            next_place: where the next stretch begins in the file, bytes: of messages at `next_ns`
                those before it come.

        Yields:
            Blocks in order of log time; they are no longer held.

        """
        if next_ns is not None and self._held_bytes > MOST_HELD_BYTES:
            self.overfull = True
            next_ns = None
        while self._held and (next_ns is None or self._held[0][:2] < (next_ns, next_place)):
            upto_ns = self._upto_ns()
            if upto_ns is None or (next_ns is not None and upto_ns >= next_ns):
                yield from self._take(next_ns, next_place)
            else:
                yield from self._take(upto_ns, -1)

    def _upto_ns(self) -> int | None:
        """Find a time before which there is about a block's worth of messages; None: all there are.

        All that is held at once would be twice in memory while it is put together.
        """
        if len(self._held) == 1:
            return None
        times = self._held[0][2].log_time_ns
        return int(times[min(len(times) - 1, BLOCK_MESSAGES // len(self._held))]) + 1

    def _take(self, next_ns: int | None, next_place: int) -> Iterator[Messages]:
        early: list[tuple[int, Messages]] = []
        late: list[tuple[int, Messages]] = []
        while self._held and (next_ns is None or self._held[0][:2] < (next_ns, next_place)):
            _, place, messages = heapq.heappop(self._held)
            self._held_bytes -= messages.data.nbytes
            border = _border(messages.log_time_ns, next_ns, inclusive=place < next_place)
            early.append((place, messages.rows(slice(None, border))))
            if border < len(messages):
                late.append((place, _compact(messages.rows(slice(border, None)))))
        for place, messages in late:
            self._hold(place, messages)
        if len(early) == 1:
            yield from early[0][1].pieces()
        else:
            early.sort(key=itemgetter(0))
            yield from _joined([_compact(messages) for _, messages in early]).sorted().pieces()

    def _hold(self, place: int, messages: Messages) -> None:
        heapq.heappush(self._held, (int(messages.log_time_ns[0]), place, messages))
        self._held_bytes += messages.data.nbytes


def _border(times: np.ndarray, next_ns: int | None, *, inclusive: bool) -> int:
    """How many of the messages come before the next stretch."""
    if next_ns is None or times[-1] < next_ns:
        return len(times)
    return int(np.searchsorted(times, next_ns, "right" if inclusive else "left"))


def _compact(messages: Messages) -> Messages:
    """Return the same in a buffer that holds little else, and in their order in it."""
    size = messages.size
    if np.all(messages.start[1:] >= messages.start[:-1]):
        first, stop = int(messages.start[0]), int(messages.start[-1] + size[-1])
        if stop - first == len(messages.data):
            return messages
        data = messages.data[first:stop]
        # A view would keep all of the buffer: worth it only for most of it.
        data = data if 2 * len(data) > len(messages.data) else data.copy()
        start = messages.start - first
    else:
        places = zip(messages.start, messages.start + size, strict=True)
        data = np.concatenate([messages.data[start:stop] for start, stop in places])
        start = np.cumsum(size) - size
    return Messages(messages.topic, messages.log_time_ns, data, start, size)


def _joined(parts: list[Messages]) -> Messages:
    lengths = np.array([len(part.data) for part in parts])
    return Messages(
        np.concatenate([part.topic for part in parts]),
        np.concatenate([part.log_time_ns for part in parts]),
        np.concatenate([part.data for part in parts]),
        np.concatenate(
            [
                part.start + before
                for part, before in zip(parts, np.cumsum(lengths) - lengths, strict=True)
            ]
        ),
        np.concatenate([part.size for part in parts]),
    )


class Problems:
    """Sentences, each once, and a few of them at most."""

    def __init__(self) -> None:
        """Start without any."""
        self._texts: list[str] = []
        self._more = False

    def add(self, text: str) -> None:
        """Note a problem; the same one again, as when a bag is read twice, is noted once.

        Args:
            text: a sentence; it is kept on one line.

        """
        text = one_line(" ".join(text.split()))
        if text in self._texts:
            return
        if len(self._texts) < _MOST_PROBLEMS:
            self._texts.append(text)
        else:
            self._more = True

    def __iter__(self) -> Iterator[str]:
        """Return the sentences, in the order in which they were found."""
        yield from self._texts
        if self._more:
            yield f"there are more than these {_MOST_PROBLEMS} problems"
