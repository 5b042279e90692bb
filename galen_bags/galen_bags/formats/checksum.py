"""A checksum of what a bag says, whatever its container, compression or tool's version."""

from __future__ import annotations

import hashlib
import os
import struct
from pathlib import Path

from galen_bags.errors import BagError
from galen_bags.formats.bag import open_bag


def content_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256, in hexadecimal, over every message of a bag in order of log time.

    Of each message: topic name and type, each ended by a zero byte, log time (int64, ns), length
    of the payload (uint64), both little-endian, the payload itself. Messages of one log time are
    taken in the bag's order. Raises BagError, also for a bag that can't be read to its end.
    """
    digest = hashlib.sha256()
    with open_bag(path) as bag:
        names = sorted(bag.topics)
        heads = [f"{name}\0{bag.topics[name].type_name}\0".encode() for name in names]
        for block in bag.blocks(names):
            for index, topic in enumerate(block.topic.tolist()):
                data = block.message(index)
                digest.update(heads[topic])
                digest.update(struct.pack("<qQ", int(block.log_time_ns[index]), len(data)))
                digest.update(data)
        if bag.problems:
            raise BagError(f"{Path(path)}: {bag.problems[0]}")
    return digest.hexdigest()
