# SPDX-License-Identifier: Apache-2.0
"""Readers of files and messages under made-up bytes and structures; what holds: fuzz/readers.py."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_bytes import cut_up, json_with_a_wrong_part, table_text, yaml_with_a_wrong_part
from fuzz.readers import READERS, check
from galen_bags.formats.errors import BagError
from galen_bags.formats.raw_block import pack
from galen_bags.formats.writer import BagWriter
from galen_common.cdr import WrenchWire
from galen_model.errors import GalenError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

JSON_READERS = ("tool_file", "model_json", "answer")
LEFT = {reader.file_name for reader in READERS.values()} | {"bag_0.mcap"}


def hold(name: str, inputs: st.SearchStrategy[bytes], folder: Path, examples: int) -> None:
    """Give a reader `examples` inputs; nothing may be left of any of them."""

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(inputs)
    def holds(data: bytes) -> None:
        check(READERS[name], data, folder)
        assert {path.name for path in folder.iterdir()} <= LEFT

    holds()


@pytest.mark.parametrize("name", READERS)
def test_any_bytes_and_damaged_files(name: str, tmp_path: Path) -> None:
    hold(name, cut_up(READERS[name].seeds()), tmp_path, 25)


@pytest.mark.parametrize("name", JSON_READERS)
def test_json_with_a_part_that_is_wrong(name: str, tmp_path: Path) -> None:
    hold(name, json_with_a_wrong_part(READERS[name].seeds()), tmp_path, 20)


def test_tables_of_anything(tmp_path: Path) -> None:
    hold("table", table_text(), tmp_path, 40)


def test_metadata_with_a_part_that_is_wrong(tmp_path: Path) -> None:
    hold("metadata", yaml_with_a_wrong_part(READERS["metadata"].seeds()), tmp_path, 25)


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", READERS)
def test_much_more_of_it(name: str, tmp_path: Path) -> None:
    seeds = READERS[name].seeds()
    inputs = cut_up(seeds)
    if name in JSON_READERS:
        inputs |= json_with_a_wrong_part(seeds)
    if name == "table":
        inputs |= table_text()
    if name == "metadata":
        inputs |= yaml_with_a_wrong_part(seeds)
    hold(name, inputs, tmp_path, 3000)


@pytest.mark.parametrize("name", ["tool_file", "model_json"])
def test_a_file_cut_at_any_byte_is_rejected(name: str, tmp_path: Path) -> None:
    """The last byte alone may lack: it is the end of the line."""
    whole = READERS[name].seeds()[0] + b"\n"
    assert check(READERS[name], whole, tmp_path)
    cuts = {*range(0, len(whole), 7), *range(len(whole) - 100, len(whole))}
    assert {n for n in cuts if check(READERS[name], whole[:n], tmp_path)} == {len(whole) - 1}


@pytest.mark.soak
@pytest.mark.parametrize("name", ["tool_file", "model_json"])
def test_a_file_cut_at_every_byte_is_rejected(name: str, tmp_path: Path) -> None:
    whole = READERS[name].seeds()[0]
    assert not [n for n in range(len(whole)) if check(READERS[name], whole[:n], tmp_path)]


@pytest.mark.parametrize("number", [b"NaN", b"Infinity", b"1e999", b"-1e999"])
def test_a_model_with_a_number_that_is_none(number: bytes, tmp_path: Path) -> None:
    """Python's JSON reads them, and its writer, for the checksum, raised a bare ValueError."""
    seed = READERS["model_json"].seeds()[0]
    for data in (seed.replace(b"0.05", number), seed[:-1] + b', "more": ' + number + b"}"):
        assert data != seed and not check(READERS["model_json"], data, tmp_path)


def test_a_matrix_that_overflows_is_no_rotation(tmp_path: Path) -> None:
    """Its products were infinite, their difference NaN, and that is not above the tolerance."""
    head = "t,fx,fy,fz,tx,ty,tz,r11,r12,r13,r21,r22,r23,r31,r32,r33\n"
    row = "0,1,2,3,.1,.2,.3,1e200,1e200,0,1e200,-1e200,0,0,0,1\n"
    assert not check(READERS["table"], (head + row).encode(), tmp_path)


@pytest.mark.timeout(20)
def test_a_table_with_a_hundred_thousand_columns(tmp_path: Path) -> None:
    """Looking for a name that is there twice took the square of their number."""
    names = ",".join(f"c{k}" for k in range(100_000))
    values = ",".join(["1"] * 100_000)
    assert not check(READERS["table"], f"{names}\n{values}\n".encode(), tmp_path)


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "text",
    [
        "[" * 50_000,  # took minutes
        "- " * 50_000,
        "{? " * 50_000,
        "rosbag2_bagfile_information:\n  topics_with_message_count:\n  - topic_metadata: [a]\n",
        "rosbag2_bagfile_information: {topics_with_message_count: [], message_count: 1,"
        " starting_time: {nanoseconds_since_epoch: .inf}, duration: {nanoseconds: 1}}",
        "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\nrosbag2_bagfile_information: *c\n",
        "!!python/object/apply:os.getpid []",
    ],
)
def test_metadata_that_is_no_metadata_is_as_none(text: str, tmp_path: Path) -> None:
    assert check(READERS["metadata"], text.encode(), tmp_path)


@pytest.mark.parametrize(
    "definition", ["A x\n", f"float64[{'9' * 5000}] x\n", "x\n", "other/T x\n"]
)
def test_a_definition_that_no_bag_can_hold_is_named(definition: str, tmp_path: Path) -> None:
    """Such as that of another topic in a bag that is copied."""
    with BagWriter(tmp_path / "bag") as bag, pytest.raises(BagError, match="topic: can't be added"):
        bag.add_topic("topic", "p/msg/A", definition)


FLOATS = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf, 5e-324, 1e308])


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    st.lists(FLOATS, min_size=6, max_size=6),
    st.lists(FLOATS, min_size=6, max_size=6),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40),
    st.integers(-(2**31), 2**31 - 1),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_any_wrench_is_read_and_written_to_the_bit(
    values: list[float], others: list[float], frame: str, sec: int, nanosec: int, little: bool
) -> None:
    """By rosbags' own writer; every double, also NaN, infinite or denormal, comes as it is."""
    from bags_samples import TYPES, WRENCH, cdr, header, wrench

    head = header(0, frame)
    head.stamp.sec, head.stamp.nanosec = sec, nanosec
    data = cdr(wrench(head, values), little_endian=little)
    raw = WrenchWire().read(data)
    assert (raw.stamp_ns, raw.frame_id) == (sec * 10**9 + nanosec, frame)
    assert struct.pack("<6d", *raw.wrench) == struct.pack("<6d", *values)
    back = TYPES.deserialize_cdr(raw.with_wrench(np.array(others)), WRENCH)
    force, torque = back.wrench.force, back.wrench.torque
    found = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
    np.testing.assert_array_equal(found, others)
    assert back.header.frame_id == frame


@pytest.mark.parametrize("count", [2**31 - 1, 2**31, 2**32 - 1, 10**6])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_length_that_is_a_lie_costs_nothing(count: int, order: str, tmp_path: Path) -> None:
    """As the frame's length, the number of joints, or that of positions."""
    import tracemalloc

    start = (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + bytes(8)
    lie = struct.pack(order + "I", count)
    one = struct.pack(order + "I", 1) + b"\0\0\0\0"
    tracemalloc.start()
    for middle in (b"", one, one + struct.pack(order + "I", 0)):
        assert not check(READERS["messages"], start + middle + lie + bytes(64), tmp_path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_errors_are_one_line_whatever_is_in_them() -> None:
    nasty = "a\nb\r\x1b[2J\0\ud800\u2028" + "x" * 100_000
    told = str(GalenError(f"/topic {nasty}: is not there"))
    assert told.isprintable() and len(told) <= 1000 and told.startswith("/topic a\\nb")
    assert str(GalenError("Gelenk Ä 5 µm: fehlt")) == "Gelenk Ä 5 µm: fehlt"


def test_the_checks_themselves_can_fail(tmp_path: Path) -> None:
    """A reader that lets something else out, tells two lines or no name is found."""
    from dataclasses import replace

    def raising(error: Exception) -> Any:
        def use(_path: Path) -> None:
            raise error

        return replace(READERS["table"], use=use)

    with pytest.raises(ZeroDivisionError):
        check(raising(ZeroDivisionError()), b"", tmp_path)
    with pytest.raises(AssertionError, match="does not name the file"):
        check(raising(GalenError("something is wrong")), b"", tmp_path)

    class TwoLinesError(GalenError):
        __str__ = Exception.__str__

    with pytest.raises(AssertionError, match="not one plain line"):
        check(raising(TwoLinesError("table.csv: a\nb")), b"", tmp_path)
    assert json.loads(READERS["tool_file"].seeds()[0]) and pack([0], [0], [b"x"])
