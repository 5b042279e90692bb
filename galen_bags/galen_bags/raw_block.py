"""Serialised messages by the thousand: one buffer, and arrays that say where each message is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


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
        """Number of messages."""
        return len(self.topic)

    def message(self, index: int) -> bytes:
        """One message's bytes."""
        start = self.start[index]
        return self.data[start : start + self.size[index]].tobytes()

    def sorted(self) -> Messages:
        """The same in order of log time; messages of one time keep their order."""
        if np.all(self.log_time_ns[1:] >= self.log_time_ns[:-1]):
            return self
        return self._rows(np.argsort(self.log_time_ns, kind="stable"))

    def split(self, upto_ns: int | None) -> tuple[Messages, Messages | None]:
        """Messages up to a log time, and the later ones in a buffer of their own (None: none)."""
        if upto_ns is None or not len(self) or self.log_time_ns[-1] <= upto_ns:
            return self, None
        border = int(np.searchsorted(self.log_time_ns, upto_ns, side="right"))
        early, late = self._rows(slice(None, border)), self._rows(slice(border, None))
        data = np.concatenate(
            [self.data[a : a + n] for a, n in zip(late.start, late.size, strict=True)]
        )
        start = np.concatenate([[0], np.cumsum(late.size)[:-1]])
        return early, Messages(late.topic, late.log_time_ns, data, start, late.size)

    def joined(self, other: Messages) -> Messages:
        """These messages, then `other`'s."""
        return Messages(
            np.concatenate([self.topic, other.topic]),
            np.concatenate([self.log_time_ns, other.log_time_ns]),
            np.concatenate([self.data, other.data]),
            np.concatenate([self.start, other.start + len(self.data)]),
            np.concatenate([self.size, other.size]),
        )

    def _rows(self, rows: slice | np.ndarray) -> Messages:
        return Messages(
            self.topic[rows], self.log_time_ns[rows], self.data, self.start[rows], self.size[rows]
        )


def pack(topic: Sequence[int], log_time_ns: Sequence[int], messages: Sequence[bytes]) -> Messages:
    """Put single messages into one buffer."""
    size = np.array([len(message) for message in messages], dtype=np.int64)
    start = np.concatenate([np.zeros(1, np.int64), np.cumsum(size)[:-1]]) if len(size) else size
    return Messages(
        np.array(topic, dtype=np.int32),
        np.array(log_time_ns, dtype=np.int64),
        np.frombuffer(b"".join(messages), np.uint8),
        start,
        size,
    )
