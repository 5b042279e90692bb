# SPDX-License-Identifier: Apache-2.0
"""The bag that a recording grows: what is in it when it is cut off, or the disk is full."""

import errno

import pytest
from bags_samples import read, read_by_rosbags
from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import GrowingBagWriter
from galen_common.cdr import wrench_bytes

WRENCH = "geometry_msgs/msg/WrenchStamped"


def message(index):
    return wrench_bytes("ft_sensor").fill(index, [float(index)] * 6)


def write_some(bag, topic, indices):
    for index in indices:
        bag.write(topic, 1000 + index, message(index))


def read_all(path):
    return read(path, ["/w"])[0]


def expected(indices):
    return [("/w", 1000 + index, message(index)) for index in indices]


@pytest.mark.parametrize("compressed", [True, False])
def test_a_closed_bag_is_what_rosbags_reads(tmp_path, compressed):
    with GrowingBagWriter(tmp_path / "bag", compressed=compressed) as bag:
        topic = bag.add_topic("w", WRENCH)
        write_some(bag, topic, range(10))
        bag.flush()
        bag.flush()  # a second without messages writes nothing
        write_some(bag, topic, range(10, 20))
    assert read_by_rosbags(tmp_path / "bag") == expected(range(20))
    assert bag.size_bytes == (tmp_path / "bag" / "bag.mcap").stat().st_size


def test_what_was_flushed_can_be_read_while_it_grows(tmp_path):
    with GrowingBagWriter(tmp_path / "bag") as bag:
        topic = bag.add_topic("w", WRENCH)
        write_some(bag, topic, range(10))
        bag.flush()
        write_some(bag, topic, range(10, 20))
        found, problems = read(tmp_path / "bag", ["/w"])
        assert found == expected(range(10))
        assert any("cut off" in problem for problem in problems)


def test_a_log_time_that_no_bag_can_hold_closes_it_and_what_was_flushed_is_whole(
    tmp_path,
):
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

    def __init__(self, file, room):
        self._file, self._room = file, room

    def __getattr__(self, name):
        return getattr(self._file, name)

    def write(self, data):
        size = len(memoryview(data).cast("B"))
        if size > self._room:
            self._file.write(memoryview(data).cast("B")[: size // 2])
            self._file.flush()
            raise OSError(errno.ENOSPC, "No space left on device")
        self._room -= size
        return int(self._file.write(data))


def fill_disk(bag, room):
    storage = bag._writer.storage
    storage.bio = FullDisk(storage.bio, room)


def test_a_full_disk_is_said_and_what_was_flushed_is_whole(tmp_path):
    bag = GrowingBagWriter(tmp_path / "bag")
    sizes = []

    def record():
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
