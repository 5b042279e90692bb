# SPDX-License-Identifier: Apache-2.0
"""Bags of every kind are read as the library rosbags reads them, message by message."""

import os
import random
import shutil
import sqlite3

import pytest
from bags_samples import (
    JOINT_STATE,
    T0,
    WRENCH,
    Sample,
    arm_samples,
    channel,
    chunk,
    mcap,
    mcap_of,
    message,
    read,
    read_by_rosbags,
    read_or_reject,
    schema,
    write_rosbag2,
)
from galen_bags.formats import raw_block
from galen_bags.formats.bag import open_bag, storage_files
from galen_bags.formats.errors import BagError
from galen_bags.formats.files import find_bags
from galen_bags.formats.mcap_records import zstd
from rosbags.rosbag2 import CompressionMode, StoragePlugin

SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP


def in_order(samples):
    return sorted(samples, key=lambda sample: sample.log_time_ns)


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        (MCAP, CompressionMode.NONE),
        (MCAP, CompressionMode.STORAGE),
        (MCAP, CompressionMode.FILE),
        (MCAP, CompressionMode.MESSAGE),
        (SQLITE, CompressionMode.NONE),
        (SQLITE, CompressionMode.FILE),
        (SQLITE, CompressionMode.MESSAGE),
    ],
)
def test_directory(tmp_path, storage, mode):
    samples = arm_samples()
    path = write_rosbag2(tmp_path / "bag", samples, storage, mode, silent=["/other/wrench"])
    assert read(path) == (read_by_rosbags(path), [])
    assert read(path)[0] == samples
    with open_bag(path) as bag:
        assert {name: info.count for name, info in bag.topics.items()} == {
            "/joint_states": 40, "/wrench_raw": 40, "/tracker/tool_pose": 6, "/other/wrench": 0,
        }  # fmt: skip
        assert bag.topics["/wrench_raw"].type_name == WRENCH
        assert "Wrench wrench" in bag.topics["/wrench_raw"].definition


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
@pytest.mark.parametrize("chunk_of", [1, 7, 1000, None])
@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("summary", [True, False])
def test_mcap_file(tmp_path, compression, chunk_of, indexed, summary):
    samples = arm_samples()
    path = tmp_path / "one.mcap"
    path.write_bytes(
        mcap_of(samples, compression, chunk_of=chunk_of, indexed=indexed, summary=summary)
    )
    assert read(path) == (samples, [])
    assert read_by_rosbags(path) == samples
    with open_bag(path) as bag:
        assert [info.count for info in bag.topics.values()] == [40, 40, 6]


@pytest.mark.parametrize("chunk_of", [9, None])
def test_mcap_whose_messages_are_out_of_order(tmp_path, chunk_of):
    """Chunks overlap in time, and within a chunk times go back; many log times are equal."""
    rng = random.Random(2)
    samples = [
        sample._replace(log_time_ns=T0 + max(0, k // 3 + rng.randint(-20, 20)))
        for k, sample in enumerate(arm_samples(100))
    ]
    path = tmp_path / "jumbled.mcap"
    path.write_bytes(mcap_of(samples, "zstd", chunk_of=chunk_of))
    # Messages of one time come as they are in the file.
    assert read(path) == (in_order(samples), [])
    if chunk_of is not None:
        assert read_by_rosbags(path) == in_order(samples)


def test_overlap_beyond_the_limit_is_named(tmp_path, monkeypatch):
    first, second = arm_samples(40), arm_samples(40, seed=2)
    third = [Sample("/wrench_raw", T0 + 10**9, first[1].data)]
    path = tmp_path / "overlapping.mcap"
    parts = []
    numbers = {"/joint_states": 1, "/wrench_raw": 2, "/tracker/tool_pose": 3}
    described = b"".join(schema(k, WRENCH) + channel(k, k, name) for name, k in numbers.items())
    for group in (first, second, third):
        content = described + b"".join(message(numbers[s.topic], *s[1:]) for s in group)
        times = [s.log_time_ns for s in group]
        parts.append(chunk(content, min(times), max(times)))
    path.write_bytes(mcap(*parts))
    assert read(path) == (in_order(first + second + third), [])
    monkeypatch.setattr(raw_block, "MOST_HELD_BYTES", 1000)
    found, problems = read(path)
    assert sorted(found) == sorted(first + second + third)
    assert len(problems) == 1 and "come out of order" in problems[0]


def test_a_topic_of_two_types_or_encodings_is_rejected_by_name(tmp_path):
    path = tmp_path / "mixed.mcap"
    described = [
        schema(1, WRENCH), schema(2, JOINT_STATE),
        channel(1, 1, "/w"), channel(2, 2, "/w"), channel(3, 1, "/j"), channel(4, 1, "/j", "json"),
        channel(5, 1, "/fine"),
    ]  # fmt: skip
    path.write_bytes(mcap(*described, message(5, 5, b"\0\1\0\0")))
    assert read(path, ["/fine"])[0] == [("/fine", 5, b"\0\1\0\0")]
    with open_bag(path) as bag:
        assert bag.topics["/w"].type_name == f"{WRENCH} and {JOINT_STATE}"
        with pytest.raises(BagError, match="/j is serialised as 'cdr and json', not cdr"):
            next(bag.blocks(["/j"]))


# --- directories ------------------------------------------------------------------------------


def split_bag(tmp_path, storage, parts):
    """A directory of several files, numbered as rosbag2 does; returns it and its samples."""
    samples = arm_samples(60)
    whole = tmp_path / f"split_{storage.name}"
    whole.mkdir()
    names = []
    step = len(samples) // parts + 1
    for k in range(parts):
        one = write_rosbag2(tmp_path / f"part{k}", samples[k * step : (k + 1) * step], storage)
        (file,) = storage_files(one)
        names.append(f"split_{k}{file.suffix}")
        shutil.move(file, whole / names[-1])
    listing = "".join(f"  - {name}\n" for name in names)
    (whole / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{listing}"
    )
    return whole, samples


@pytest.mark.parametrize(("storage", "parts"), [(MCAP, 12), (SQLITE, 2)])
def test_directory_split_over_files(tmp_path, storage, parts):
    path, samples = split_bag(tmp_path, storage, parts)
    assert read(path) == (samples, [])
    with open_bag(path) as bag:
        assert bag.topics["/joint_states"].count == 60
    (path / "metadata.yaml").unlink()
    found, problems = read(path)  # in the order of their numbers: 10 after 9
    assert found == samples
    assert problems == [f"{path.name} has no metadata.yaml: its recording was cut off"]


def test_split_bag_whose_last_file_was_just_begun(tmp_path):
    path, samples = split_bag(tmp_path, MCAP, 3)
    last = path / "split_2.mcap"
    lost = read(last)[0]
    (path / "other.db3").write_bytes(b"")
    last.write_bytes(b"")
    found, problems = read(path)
    assert found == samples[: -len(lost)]
    assert problems[0] == "other.db3 is not read: metadata.yaml does not list it"
    assert len(problems) == 2 and "split_2.mcap: is empty" in problems[1]
    last.unlink()
    assert read(path) == (found, [problems[0], "split_2.mcap is missing"])


def test_files_whose_times_overlap_are_named(tmp_path):
    path, samples = split_bag(tmp_path, MCAP, 2)
    one, two = path / "split_0.mcap", path / "split_1.mcap"
    one.rename(path / "x"), two.rename(one), (path / "x").rename(two)
    found, problems = read(path)
    assert sorted(found) == sorted(samples)
    assert problems == [
        "split_1.mcap: begins before the file before it ends; their messages are not sorted"
        " into each other"
    ]


@pytest.mark.parametrize(
    "listed",
    [
        "[../../etc/passwd]", "[/etc/passwd]", "[.., .]", "['']", "[[a]]", "[1]", "{a: b}", "3", "",
        "[!!python/object/apply:os.system [true]]", "&a [*a]", "[\0]", "[" * 100_000,
    ],
)  # fmt: skip
def test_hostile_metadata(tmp_path, listed):
    """What it lists is looked for in the directory only; what can't be used is said."""
    path = write_rosbag2(tmp_path / "bag", arm_samples(3))
    (path / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  relative_file_paths: {listed}\n"
    )
    found, problems = read_or_reject(path)
    if found:
        assert found == arm_samples(3) and "metadata.yaml can't be used" in problems[0]
    else:
        assert "its file" in problems[0] and "is missing" in problems[0]


def test_paths_that_are_no_bags(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "x.mcap").mkdir()
    os.mkfifo(tmp_path / "pipe.mcap")  # opening it would wait for a writer
    (tmp_path / "loop.mcap").symlink_to(tmp_path / "loop.mcap")
    (tmp_path / "text.txt").write_text("no bag")
    (tmp_path / "zeros.mcap").write_bytes(bytes(100))
    (tmp_path / "zeros.db3").write_bytes(bytes(100))
    (tmp_path / "nothing.mcap").write_bytes(b"")
    (tmp_path / "nothing.mcap.zstd").write_bytes(b"")
    for name, words in {
        "absent.mcap": "is not there", "empty": "holds no bag", "x.mcap": "holds no bag",
        "pipe.mcap": "neither a file nor a directory", "loop.mcap": "is not there",
        "text.txt": "is no bag", "zeros.mcap": "is no MCAP file", "zeros.db3": "can't be read",
        "nothing.mcap": "is empty", "nothing.mcap.zstd": "is empty",
        "n" * 300: "can't be read",
    }.items():  # fmt: skip
        with pytest.raises(BagError, match=words) as raised:
            open_bag(tmp_path / name)
        assert name[:200] in str(raised.value) and "\n" not in str(raised.value)


def test_compressed_file_that_would_fill_the_disk(tmp_path):
    path = tmp_path / "bomb.mcap.zstd"
    path.write_bytes(zstd.compress(bytes(1 << 26)))
    with pytest.raises(BagError, match="grows to more than 1000 times its size"):
        open_bag(path)


# --- SQLite -------------------------------------------------------------------------------------


def test_sqlite_rows_that_are_no_messages(tmp_path):
    samples = arm_samples(20)
    path = write_rosbag2(tmp_path / "bag", samples, SQLITE)
    (file,) = storage_files(path)
    with sqlite3.connect(file) as base:
        base.execute("CREATE TABLE loose AS SELECT * FROM messages")  # without its NOT NULL
        base.execute("DROP TABLE messages")
        base.execute("ALTER TABLE loose RENAME TO messages")
        base.execute("UPDATE messages SET data = NULL WHERE id = 3")
        base.execute("UPDATE messages SET data = 'text' WHERE id = 5")
        base.execute("UPDATE messages SET data = 7 WHERE id = 7")
    base.close()
    found, problems = read(path)
    assert found == [sample for k, sample in enumerate(samples, 1) if k not in (3, 5, 7)]
    assert problems and "some messages of" in problems[0]


def test_sqlite_row_that_is_computed(tmp_path):
    """A table may say that its rows are a gigabyte each, in a file of a few kilobytes."""
    path = write_rosbag2(tmp_path / "bag", arm_samples(20), SQLITE)
    (file,) = storage_files(path)
    with sqlite3.connect(file) as base:
        base.execute("DROP TABLE messages")
        base.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB GENERATED ALWAYS AS (zeroblob(999999999)) VIRTUAL)"
        )
        base.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, 5)")
    base.close()
    found, problems = read(path)
    assert found == [] and "is damaged" in problems[0]


def test_sqlite_messages_left_in_the_journal_are_named(tmp_path):
    path = write_rosbag2(tmp_path / "bag", arm_samples(3), SQLITE)
    (path / "bag.db3-wal").write_bytes(b"something")
    assert read(path) == (
        arm_samples(3), ["bag.db3: its recording was cut off; what is in bag.db3-wal is not read"]
    )  # fmt: skip


@pytest.mark.parametrize("opened", [open_bag, lambda path: find_bags([path])])
def test_a_bag_of_ros1_names_the_command_that_converts_it(tmp_path, opened):
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(BagError, match=r"rosbags-convert --src .*old\.bag --dst NEW"):
        opened(tmp_path / "old.bag")
