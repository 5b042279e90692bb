# SPDX-License-Identifier: Apache-2.0
"""The timing of a replay, without ROS: when is what due, by the log times of a bag.

All `now_s` are of one steady clock, in s; bag times are log times in ns.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from galen_common.cdr import NS_PER_S

from galen_bags.formats.raw_block import Messages

_BLOCKS_AHEAD = 4


class BagClock:
    """Bag time as a function of the steady clock: runs at `rate`, can be paused and held.

    A stall of more than `max_step_s` is not caught up: the messages that would be due at once would
    overflow the receivers' queues. Bag time then stands still during the stall; `lag_s` says by how
    much, in all, the replay is late.
    """

    def __init__(self, rate: float, max_step_s: float = 0.1) -> None:
        self.lag_s = 0.0
        self._rate = rate
        self._max_step_s = max_step_s
        self._anchor_ns = 0
        self._anchor_s = 0.0
        self._last_s = 0.0
        self._paused = False

    @property
    def paused(self) -> bool:
        """Whether bag time stands still."""
        return self._paused

    def start(self, bag_ns: int, now_s: float) -> None:
        """Let bag time run from here, unless it is paused.

        Args:
            bag_ns: bag time now, ns.
            now_s: steady clock, s.

        """
        self._anchor_ns, self._anchor_s, self._last_s = bag_ns, now_s, now_s

    def advance(self, now_s: float) -> int:
        """Return bag time now.

        Args:
            now_s: steady clock, s; not before that of the call before.

        Returns:
            Bag time, ns.

        """
        if self._paused:
            return self._anchor_ns
        excess_s = now_s - self._last_s - self._max_step_s
        if excess_s > 0.0:
            self.lag_s += excess_s
            self._anchor_s += excess_s
        self._last_s = now_s
        return self._anchor_ns + round((now_s - self._anchor_s) * self._rate * NS_PER_S)

    def hold(self, bag_ns: int, now_s: float) -> None:
        """Go on from an earlier bag time: what was due could not be published at once.

        Args:
            bag_ns: bag time, ns, from which it goes on; what it falls behind is added to `lag_s`.
            now_s: steady clock, s.

        """
        late_ns = self.advance(now_s) - bag_ns
        self.lag_s += max(0, late_ns) / (NS_PER_S * self._rate)
        self.start(bag_ns, now_s)

    def pause(self, paused: bool, now_s: float) -> None:
        """Stop bag time, or let it go on from where it stopped.

        Args:
            paused: whether it is to stand still.
            now_s: steady clock, s.

        """
        if paused != self._paused:
            self.start(self.advance(now_s), now_s)
            self._paused = paused


def window(blocks: Iterable[Messages], first_ns: int, last_ns: int | None) -> Iterator[Messages]:
    """Yield the messages with log times in a window.

    Args:
        blocks: messages in order of log time.
        first_ns: earliest log time, ns, included.
        last_ns: latest log time, ns, included; None: to the end.

    Yields:
        Blocks of those messages.

    """
    for block in blocks:
        times = block.log_time_ns
        if last_ns is not None and len(times) and times[0] > last_ns:
            return
        keep = times >= first_ns
        if last_ns is not None:
            keep &= times <= last_ns
        if np.all(keep):
            yield block
        elif np.any(keep):
            yield Messages(
                block.topic[keep], times[keep], block.data, block.start[keep], block.size[keep]
            )


class Playlist:
    """Messages one after the other, in order; a thread reads them ahead, so that none is late.

    An error of reading is raised by `peek_ns`. `close` ends the thread.
    """

    def __init__(self, make_blocks: Callable[[], Iterator[Messages]]) -> None:
        self._make_blocks = make_blocks
        self._ready: queue.Queue[Messages | BaseException | None] = queue.Queue(_BLOCKS_AHEAD)
        self._stop = threading.Event()
        self._block: Messages | None = None
        self._next = 0
        self.ended = False
        self._thread = threading.Thread(target=self._read, name="bag reader", daemon=True)
        self._thread.start()

    def peek_ns(self) -> int | None:
        """Return the next message's log time; None if it is not read yet, or at the end."""
        while not self.ended and (self._block is None or self._next >= len(self._block)):
            try:
                item = self._ready.get_nowait()
            except queue.Empty:
                return None
            if isinstance(item, BaseException):
                raise item
            self._block, self._next = item, 0
            self.ended = item is None
        return None if self._block is None else int(self._block.log_time_ns[self._next])

    def pop(self) -> tuple[int, int, bytes]:
        """Return the next message: number of its topic, log time, bytes; only after `peek_ns`."""
        block, index = self._block, self._next
        assert block is not None
        self._next += 1
        return int(block.topic[index]), int(block.log_time_ns[index]), block.message(index)

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def _read(self) -> None:
        try:
            for block in self._make_blocks():
                if not self._put(block):
                    return
            self._put(None)
        except BaseException as error:
            self._put(error)

    def _put(self, item: Messages | BaseException | None) -> bool:
        while not self._stop.is_set():
            try:
                self._ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False
