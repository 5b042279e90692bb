# SPDX-License-Identifier: Apache-2.0
"""The bag that a recording grows: what is in it when it is cut off, or the disk is full."""

import errno
from pathlib import Path
from typing import Any

import pytest
from galen_bags.formats.bag import open_bag
from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_common.cdr import wrench_bytes
from rosbags.rosbag2 import Reader

WRENCH = "geometry_msgs/msg/WrenchStamped"


def message(index: int) -> bytes:
    return wrench_bytes("ft_sensor").fill(index, [float(index)] * 6)


def write_some(bag: GrowingBagWriter, topic: Any, indices: range) -> None:
    for index in indices:
        bag.write(topic, 1000 + index, message(index))


def read_all(path: Path) -> list[tuple[int, bytes]]:
    with open_bag(path) as bag:
        return [
            (int(block.log_time_ns[k]), block.message(k))
            for block in bag.blocks(["/w"])
            for k in range(len(block))
        ]


def expected(indices: range) -> list[tuple[int, bytes]]:
    return [(1000 + index, message(index)) for index in indices]


@pytest.mark.parametrize("compressed", [True, False])
def test_a_closed_bag_is_what_rosbags_reads(tmp_path: Path, compressed: bool) -> None:
    with GrowingBagWriter(tmp_path / "bag", compressed=compressed) as bag:
        topic = bag.add_topic("w", WRENCH)
        write_some(bag, topic, range(10))
        bag.flush()
        bag.flush()  # a second without messages writes nothing
        write_some(bag, topic, range(10, 20))
    with Reader(tmp_path / "bag") as reader:
        found = [(time_ns, data) for _, time_ns, data in reader.messages()]
    assert found == expected(range(20))
    assert bag.size_bytes == (tmp_path / "bag" / "bag.mcap").stat().st_size


def test_what_was_flushed_can_be_read_while_it_grows(tmp_path: Path) -> None:
    with GrowingBagWriter(tmp_path / "bag") as bag:
        topic = bag.add_topic("w", WRENCH)
        write_some(bag, topic, range(10))
        bag.flush()
        write_some(bag, topic, range(10, 20))
        assert read_all(tmp_path / "bag") == expected(range(10))
        with open_bag(tmp_path / "bag") as cut:
            assert any("cut off" in problem for problem in cut.problems)


def test_a_log_time_that_no_bag_can_hold_closes_it_and_what_was_flushed_is_whole(
    tmp_path: Path,
) -> None:
    with GrowingBagWriter(tmp_path / "bag") as bag:
        topic = bag.add_topic("w", WRENCH)
        write_some(bag, topic, range(10))
        bag.flush()
        with pytest.raises(BagError, match=r"bag: can't be written any more: .*; what it holds"):
            bag.write(topic, -1, message(10))
        assert not bag.is_open
    assert read_all(tmp_path / "bag") == expected(range(10))


class FullDisk:
    """A file that takes `room` bytes more, half of what is too much, and then no more."""

    def __init__(self, file: Any, room: int) -> None:
        self._file, self._room = file, room

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: Any) -> int:
        size = len(memoryview(data).cast("B"))
        if size > self._room:
            self._file.write(memoryview(data).cast("B")[: size // 2])
            self._file.flush()
            raise OSError(errno.ENOSPC, "No space left on device")
        self._room -= size
        return int(self._file.write(data))


def fill_disk(bag: GrowingBagWriter, room: int) -> None:
    storage = bag._writer.storage
    storage.bio = FullDisk(storage.bio, room)


def test_a_full_disk_is_said_and_what_was_flushed_is_whole(tmp_path: Path) -> None:
    bag = GrowingBagWriter(tmp_path / "bag")
    sizes = []

    def record() -> None:
        with bag:
            topic = bag.add_topic("w", WRENCH)
            write_some(bag, topic, range(10))
            bag.flush()
            sizes.append(bag.size_bytes)
            fill_disk(bag, room=20)
            write_some(bag, topic, range(10, 20))
            bag.flush()

    with pytest.raises(BagError, match=r"bag: .*No space left"):
        record()
    assert [(tmp_path / "bag" / "bag.mcap").stat().st_size, bag.size_bytes] == sizes * 2
    assert read_all(tmp_path / "bag") == expected(range(10))
