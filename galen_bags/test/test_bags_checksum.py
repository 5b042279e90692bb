# SPDX-License-Identifier: Apache-2.0
"""The checksum covers all that a bag holds, and nothing of how it is stored."""

import hashlib
import struct

import pytest
from galen_bags.formats.bag import content_sha256
from galen_bags.formats.errors import BagError
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import wrench_bytes

WRENCH = "geometry_msgs/msg/WrenchStamped"


@pytest.mark.parametrize("compressed", [True, False])
def test_it_is_what_its_description_states(tmp_path, compressed):
    digest, layout = hashlib.sha256(), wrench_bytes("ft_sensor")
    with BagWriter(tmp_path / "bag", compressed=compressed) as bag:
        handle = bag.add_topic("wrench_raw", WRENCH)
        for k, value in enumerate((1.0, 2.0)):
            data = layout.fill(1_000_000_000 + k, [value] * 6)
            bag.write(handle, 1_000_000_007 + k, data)
            digest.update(f"/wrench_raw\0{WRENCH}\0".encode())
            digest.update(struct.pack("<qQ", 1_000_000_007 + k, len(data)))
            digest.update(data)
    assert content_sha256(tmp_path / "bag") == digest.hexdigest()
    (file,) = (tmp_path / "bag").glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(BagError, match="bag"):
        content_sha256(tmp_path / "bag")
