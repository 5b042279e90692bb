"""The checksum sees all that a bag says, and nothing of how it is stored."""

import hashlib
import struct

import pytest
from galen_bags.formats.bag import content_sha256
from galen_bags.formats.writer import BagWriter
from galen_ros.cdr import wrench_bytes

from galen_bags import BagError

WRENCH = "geometry_msgs/msg/WrenchStamped"


def write(path, *, compressed=True, topic="wrench_raw", type_name=WRENCH, delay=7, last=2.0):
    layout = wrench_bytes("ft_sensor")
    with BagWriter(path, compressed=compressed) as bag:
        handle = bag.add_topic(topic, type_name)
        for k, value in enumerate((1.0, last)):
            stamp_ns = 1_000_000_000 + k
            bag.write(handle, stamp_ns + delay, layout.fill(stamp_ns, [value] * 6))
    return content_sha256(path)


def test_it_is_what_its_description_says(tmp_path):
    digest = hashlib.sha256()
    for k, value in enumerate((1.0, 2.0)):
        data = wrench_bytes("ft_sensor").fill(1_000_000_000 + k, [value] * 6)
        digest.update(f"/wrench_raw\0{WRENCH}\0".encode())
        digest.update(struct.pack("<qQ", 1_000_000_007 + k, len(data)))
        digest.update(data)
    assert write(tmp_path / "bag") == digest.hexdigest()


def test_compression_and_name_of_the_bag_do_not_matter(tmp_path):
    assert write(tmp_path / "a") == write(tmp_path / "b", compressed=False)


@pytest.mark.parametrize(
    "change",
    [
        {"topic": "wrench"},
        {"type_name": "geometry_msgs/msg/TwistStamped"},
        {"delay": 8},
        {"last": 2.0 + 1e-15},
    ],
    ids=["topic", "type", "log time", "payload"],
)
def test_everything_else_does(tmp_path, change):
    assert write(tmp_path / "a") != write(tmp_path / "b", **change)


def test_a_bag_that_was_cut_off_has_none(tmp_path):
    write(tmp_path / "bag", compressed=False)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    with pytest.raises(BagError, match="bag"):
        content_sha256(tmp_path / "bag")
