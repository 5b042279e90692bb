# SPDX-License-Identifier: Apache-2.0
"""MCAP files that were cut off, damaged, or made to do harm."""

import struct
import tracemalloc

import pytest
from bags_samples import (
    CHANNEL,
    CHUNK,
    MESSAGE,
    SCHEMA,
    STATISTICS,
    WRENCH,
    Sample,
    arm_samples,
    channel,
    chunk,
    index,
    mcap,
    mcap_of,
    message,
    read,
    read_or_reject,
    record,
    schema,
    statistics,
    text,
)
from galen_bags.formats import mcap_file
from galen_bags.formats.mcap_records import zstd

CDR = b"\0\1\0\0"
DESCRIBED = schema(1, WRENCH) + channel(1, 1, "/w")
ONE = message(1, 5, CDR)


@pytest.fixture
def file(tmp_path):
    """Writes a file, and reads it."""

    def write_and_read(data):
        path = tmp_path / "bag.mcap"
        path.write_bytes(data)
        return read_or_reject(path)

    return write_and_read


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
@pytest.mark.parametrize("chunk_of", [10, None])
def test_file_that_was_cut_off_anywhere(file, compression, chunk_of):
    """What is read is a prefix of the whole, and it is said that it is one."""
    samples = arm_samples(12)
    whole = mcap_of(samples, compression, chunk_of=chunk_of)
    counts = set()
    for length in range(0, len(whole) - 8, 97):  # without its last 8 bytes a file still has an end
        found, problems = file(whole[:length])
        assert found == samples[: len(found)]
        expected = "was cut off: it has no end" if length >= 8 else "is empty"
        assert len(problems) == 1 and expected in problems[0]
        counts.add(len(found))
    assert file(whole) == (samples, [])
    # Of a cut chunk that is not compressed, its whole messages are read.
    least = len(samples) if chunk_of is None or not compression else 3
    assert len(counts) >= least and max(counts) == len(samples)


def test_file_that_is_damaged_between_chunks(file):
    parts = [chunk(DESCRIBED + message(1, k, CDR), k, k) for k in (1, 2, 3)]
    at = len(mcap(parts[0], end=False))
    assert file(mcap(parts[0], bytes(9) + parts[1][9:], parts[2])) == (
        [("/w", 1, CDR)],
        [f"bag.mcap is damaged at byte {at}; what comes after is not read"],
    )


def test_a_checksum_that_does_not_fit(file):
    samples = arm_samples(30)
    whole = mcap_of(samples, chunk_of=20)
    at = whole.index(samples[25].data) + 30  # a double
    damaged = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
    found, problems = file(damaged)
    assert found == samples[:20] + samples[40:]
    assert "is damaged and left out: its checksum is another" in problems[0]
    assert "/joint_states has 20 readable messages, but 30 by the file's own summary" in problems[1]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        # --- chunks
        (chunk(ONE, 5, 5, size=2**60), "it claims to hold 1152921504606846976 bytes"),
        (chunk(ONE, 5, 5, size=34), "it holds 35 bytes instead of 34"),
        (chunk(ONE, 5, 5, size=36), "it holds 35 bytes instead of 36"),
        (chunk(ONE, 5, 5, "zstd", size=2**27), "it holds 35 bytes instead of 134217728"),
        (chunk(ONE, 5, 5, "zstd", packed=b"nonsense"), "zstd: Unable to decompress"),
        (chunk(ONE, 5, 5, "lz4", packed=b"nonsense"), "lz4: LZ4F_decompress failed"),
        (chunk(ONE, 5, 5, "zstd", packed=b""), "it holds 0 bytes instead of 35"),
        (chunk(ONE, 5, 5, "xz", packed=ONE), "its compression 'xz' is not known"),
        (record(CHUNK, bytes(10)), "is too short"),
        (record(CHUNK, bytes(28)), "is damaged and left out"),
        (record(CHUNK, bytes(28) + b"\xff\xff\xff\xff"), "4294967295 bytes are announced"),
        (record(CHUNK, bytes(28) + text("") + b"\xff" * 8), "are announced and 0 are there"),
        (chunk(chunk(DESCRIBED + ONE, 5, 5), 5, 5), "it is read up to byte 0"),
        (chunk(bytes(50), 5, 5), "it is read up to byte 0 of its 50"),
        (chunk(ONE[:-1], 5, 5), "it is read up to byte 0 of its 34"),
        (chunk(record(MESSAGE, bytes(21)), 5, 5), "it is read up to byte 0"),
        (chunk(message(9, 5, CDR), 5, 5), "no topic is given for channel 9"),
        (chunk(message(1, 4, CDR), 5, 5), "begins earlier than it says"),
        # --- outside of them
        (struct.pack("<BQ", MESSAGE, 2**63) + bytes(100), "is damaged at byte"),
        (struct.pack("<BQ", CHUNK, 2**64 - 1) + bytes(100), "is damaged at byte"),
        (struct.pack("<BQ", SCHEMA, 2**40) + bytes(100), "is damaged at byte"),
        (record(MESSAGE, bytes(21)), "is too short"),
        (record(MESSAGE, b""), "is too short"),
        (message(9, 5, CDR), "no topic is given for channel 9"),
        (record(SCHEMA, b"\1"), "a description at byte"),
        (record(CHANNEL, b"\1\0\1\0\xff\xff\xff\xff"), "4294967295 bytes are announced"),
        (record(CHANNEL, b"\2\0\1\0" + text("x" * 5000) + text("")), "a name is too long"),
        (record(CHANNEL, b"\2\0\1\0\2\0\0\0\xff\xff"), "a description at byte"),
        (record(SCHEMA, b"\2\0" + text("x" * 5000) + text("") + text("")), "a name is too long"),
        (record(STATISTICS, bytes(42) + b"\xff\xff\xff\xff"), "a description at byte"),
        (DESCRIBED + statistics({1: 2**63}), "but 9223372036854775808 by the file's own summary"),
        (bytes(100), "is damaged at byte"),
    ],
)
def test_hostile_records(file, body, words):
    """What is wrong is said, and what is right before it is read."""
    before = chunk(DESCRIBED + message(1, 3, CDR), 3, 3)
    found, problems = file(mcap(before, body))
    assert Sample("/w", 3, CDR) in found and len(found) <= 2
    assert any(words in problem for problem in problems), problems


def test_damage_all_over_is_named_a_few_times(file):
    bad = [chunk(ONE, 5, 5, size=36) for _ in range(3000)]
    _, problems = file(mcap(DESCRIBED, *bad))
    assert len(problems) == 21 and problems[-1] == "there are more than these 20 problems"


def peak_bytes(path):
    tracemalloc.start()
    try:
        read_or_reject(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_that_a_small_file_may_take(tmp_path, monkeypatch):
    path = tmp_path / "bag.mcap"
    megabyte = 1 << 20
    zeros = zstd.compress(bytes(300 * megabyte))
    for body in (
        chunk(b"", 5, 5, "zstd", packed=zeros, size=10),  # more than it says
        chunk(b"", 5, 5, "zstd", packed=zeros, size=2**50),  # says more than any has
        b"".join(chunk(b"", 5, 5, "lz4", packed=zeros, size=2**22) for _ in range(50)),
    ):
        path.write_bytes(mcap(body))
        assert peak_bytes(path) < 20 * megabyte
    # Types' texts that a chunk holds, again and again.
    monkeypatch.setattr(mcap_file, "_MOST_DEFINITION_BYTES", megabyte)
    long = text(WRENCH) + text("ros2msg") + text("x" * megabyte)
    schemas = [record(SCHEMA, struct.pack("<H", k) + long) for k in range(1, 60)]
    path.write_bytes(mcap(*[chunk(one, 5, 5, "zstd") for one in schemas]))
    assert path.stat().st_size < megabyte and peak_bytes(path) < 20 * megabyte
    assert "some are left out" in " ".join(read(path)[1])


def test_sparse_file_of_a_terabyte(tmp_path):
    """Records may be as long as a file says it is, which costs its maker nothing."""
    for opcode, words in {
        MESSAGE: "claims 1099511627785 bytes; it is left out",
        CHUNK: "claims 1099511627776 bytes; it is left out",
        SCHEMA: "claims 1099511627776 bytes; it is left out",
        0x99: "",
    }.items():
        path = tmp_path / f"{opcode}.mcap"
        with path.open("wb") as out:
            out.write(mcap(DESCRIBED, ONE, end=False) + struct.pack("<BQ", opcode, 1 << 40))
            try:
                out.truncate((1 << 40) + 10_000)
            except OSError:
                pytest.skip("this file system has no sparse files of a terabyte")
        found, problems = read(path)
        assert found == [("/w", 5, CDR)]
        assert words in " ".join(problems) and "was cut off" in " ".join(problems)


def test_hostile_indexes_cost_nothing(file):
    content = DESCRIBED + ONE + message(1, 5, CDR + ONE)  # the last holds the bytes of a message
    good, whole = chunk(content, 5, 5), ([("/w", 5, CDR), ("/w", 5, CDR + ONE)], [])
    size, log_time = len(content), len(DESCRIBED) + 15  # whose 5 looks like a message's opcode
    for places in ([2**64 - 1], [size - 30], [0], [log_time], [size - len(ONE)], range(2000)):
        assert file(mcap(good, index(1, [(5, at) for at in places]))) == whole
    lies = record(7, struct.pack("<HI", 1, 2**32 - 1) + bytes(32))
    assert file(mcap(good, lies, record(7, b""), record(7, b"\0" * 5))) == whole
