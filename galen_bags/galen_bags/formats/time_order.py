"""Stretches of messages that overlap in time, brought into one order."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from operator import itemgetter

import numpy as np

from galen_bags.formats.raw_block import BLOCK_MESSAGES, Messages

# Stretches that overlap are held until their turn comes: this much, and no more.
MOST_HELD_BYTES = 1 << 28


class TimeOrder:
    """Takes stretches in order of their first times and gives messages in order of log time.

    Messages of one time come in the order of their places in the file. More than MOST_HELD_BYTES
    are not held: then messages come out of order, and `overfull` says so.
    """

    def __init__(self) -> None:
        """Start with nothing held."""
        # (first time, place, messages); a place is there once, so messages are never compared.
        self._held: list[tuple[int, int, Messages]] = []
        self._held_bytes = 0
        self.overfull = False

    def add(self, place: int, messages: Messages) -> None:
        """Take the messages of the stretch at `place` of the file."""
        if len(messages):
            self._hold(place, messages.sorted())

    def ready(self, next_ns: int | None, next_place: int) -> Iterator[Messages]:
        """Return what comes before the next stretch, which begins at this time; None: all."""
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
    """Return the parts' messages, one part after the other."""
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
