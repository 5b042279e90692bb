"""What all formats give: topics, blocks of serialised messages, problems found in a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from galen_model.errors import one_line

# A block of a joint state's or a wrench's messages is about 2 MB; larger ones make it shorter.
BLOCK_MESSAGES = 1 << 14
_PACK_BYTES = 1 << 23
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
        """One message's bytes."""
        start = self.start[index]
        return self.data[start : start + self.size[index]].tobytes()

    def in_order(self) -> bool:
        """Whether the log times never go back."""
        return bool(np.all(self.log_time_ns[1:] >= self.log_time_ns[:-1]))

    def sorted(self) -> Messages:
        """Return the same in order of log time; messages of one time keep their order."""
        if self.in_order():
            return self
        return self.rows(np.argsort(self.log_time_ns, kind="stable"))

    def rows(self, rows: slice | np.ndarray) -> Messages:
        """Return some of the messages, in the same buffer."""
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
    """All stretches (m, length) of a buffer (n,), m = n - length + 1, without a copy."""
    return np.ndarray((len(data) - length + 1, length), np.uint8, data, strides=(1, 1))


def pack(topic: Sequence[int], log_time_ns: Sequence[int], messages: Sequence[bytes]) -> Messages:
    """Put single messages into one buffer."""
    size = np.array([len(message) for message in messages], dtype=np.int64)
    return Messages(
        np.array(topic, dtype=np.int32),
        np.array(log_time_ns, dtype=np.int64),
        np.frombuffer(b"".join(messages), np.uint8),
        np.cumsum(size) - size,
        size,
    )


def packed(messages: Iterable[tuple[int, int, bytes]]) -> Iterator[Messages]:
    """Blocks of (topic, log time in ns, bytes), of some megabytes at most beside the last one."""
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


class Problems:
    """Sentences, each once; a bag that is damaged all over doesn't fill the memory with them."""

    def __init__(self) -> None:
        """Start without any."""
        self._texts: list[str] = []
        self._more = False

    def add(self, text: str) -> None:
        """Note a problem. Reading a bag again finds the same ones again."""
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
