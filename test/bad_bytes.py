# SPDX-License-Identifier: Apache-2.0
"""Strategies for input that is nearly right, or not at all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from hypothesis import strategies as st

NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-0.0", "1e999", "0x10", "1_0", "٣", "",
    "9" * 400, "-9" * 30, "1,5", "true", "null",
)  # fmt: skip
TEXTS = (
    "", ".", "..", "../x", "/etc/passwd", "a/b", "a\0b", "a\nb", "\x1b[2J", "\ud800", "ä", "x" * 65,
    "x" * 100_000, "%s%n", "${HOME}", "~", "-", "pointer.json", "CON", "\u202e", " ",
)  # fmt: skip
COLUMNS = (
    "t", "fx", "fy", "fz", "tx", "ty", "tz", "gx", "gy", "gz", "qx", "qy", "qz", "qw", "roll",
    "tilt", "block", "r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33", "-", "x",
)  # fmt: skip
LIES = (
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\0" * 8,
    b"\xff" * 8,
    b"\x7f" * 8,
)


@st.composite
def cut_up(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """Any bytes, or a file that is right but for up to four damages."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=300))
    data = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        kind = draw(st.integers(0, 5))
        if kind == 0:
            data[at : at + 1] = bytes([draw(st.integers(0, 255))])
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + draw(st.integers(1, 40))]
        elif kind == 3:
            lie = draw(st.sampled_from(LIES))
            data[at : at + len(lie)] = lie
        elif kind == 4:
            other = draw(st.integers(0, len(data)))
            data[at:at] = data[other : other + draw(st.integers(1, 200))]
        else:
            data[at:at] = draw(st.sampled_from(NUMBERS)).encode()
    return bytes(data)


def _scalars() -> st.SearchStrategy[Any]:
    return (
        st.none()
        | st.booleans()
        | st.integers()
        | st.sampled_from([10**30, 10**400, -1, 2**63])
        | st.floats()
        | st.sampled_from(TEXTS)
        | st.text(max_size=10)
    )


def values() -> st.SearchStrategy[Any]:
    """Anything that JSON holds, and what Python's JSON holds beyond it."""
    return st.recursive(
        _scalars(),
        lambda inner: (
            st.lists(inner, max_size=7) | st.dictionaries(st.sampled_from(TEXTS), inner, max_size=3)
        ),
        max_leaves=12,
    )


def _places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path]
    if isinstance(content, dict):
        for name, value in content.items():
            found += _places(value, (*path, name))
    elif isinstance(content, list):
        for index, value in enumerate(content):
            found += _places(value, (*path, index))
    return found


@st.composite
def json_with_a_wrong_part(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """One to three fields changed, left out or added, anywhere in it."""
    content = json.loads(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(_places(content)))
        value = draw(values())
        if not path:
            if draw(st.integers(0, 20)) == 0:
                content = value
            continue
        inside = content
        for step in path[:-1]:
            inside = inside[step]
        if draw(st.integers(0, 5)) == 0:
            del inside[path[-1]]
        elif draw(st.integers(0, 2)) == 0 and isinstance(inside[path[-1]], float):
            # a number that could be one
            inside[path[-1]] = draw(st.floats(-1e7, 1e7) | st.sampled_from([5e-324, 1e-200, 1e6]))
        else:
            inside[path[-1]] = value
    return json.dumps(content).encode("utf-8", "surrogatepass")


@st.composite
def table_text(draw: st.DrawFn) -> bytes:
    """A table whose columns, separators, ends of lines and cells may be anything."""
    columns = st.sampled_from(COLUMNS)
    whole = ("t fx fy fz tx ty tz " + draw(st.sampled_from(("gx gy gz", "qx qy qz qw", "roll tilt",
             "r11 r12 r13 r21 r22 r23 r31 r32 r33")))).split()  # fmt: skip
    names = whole if draw(st.booleans()) else draw(st.lists(columns, min_size=1, max_size=12))
    separator = draw(st.sampled_from((",", ";", "\t", " ", ", ")))
    end = draw(st.sampled_from(("\n", "\r\n", "\r", "\n\n", "\u2028")))
    cell = (
        st.floats().map(repr)
        | st.sampled_from(("0", "1", "-9.81", "9.81"))
        | st.sampled_from(NUMBERS)
        | st.sampled_from(TEXTS)
    )
    right = st.floats(-2.0, 2.0).map(repr) | st.sampled_from(("0", "1", "-9.81"))
    cells = draw(st.sampled_from((cell, right)))
    rows = [separator.join(draw(cells) for _ in names) for _ in range(draw(st.integers(0, 4)))]
    return end.join([separator.join(names), *rows]).encode("utf-8", "surrogatepass")


@st.composite
def yaml_with_a_wrong_part(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """Values of some lines replaced by anything."""
    lines = draw(st.sampled_from(seeds)).decode().splitlines()
    odd = st.sampled_from(
        ("[]", "{}", "&a [*a]", "*a", ".inf", ".nan", "!!python/name:os.system", "!!binary x", "~",
         "2024-99-99", "[" * 2000, "'../../etc/passwd'", "-1", "9" * 400, "|", "? x", "0o9",
         "1:60:60")
    ) | st.text(max_size=8)  # fmt: skip
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        head, colon, _ = lines[at].partition(":")
        lines[at] = head + colon + " " + draw(odd)
    return "\n".join(lines).encode("utf-8", "surrogatepass")
