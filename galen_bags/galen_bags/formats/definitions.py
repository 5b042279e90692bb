"""Message definitions out of the .msg files that are installed with a ROS package."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from galen_bags.errors import BagError

_TYPE = re.compile(r"^\s*(?P<type>[A-Za-z][\w/]*)(\[[<=\d]*\])?\s+[A-Za-z]", re.MULTILINE)
_BUILT_IN = re.compile(r"bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string(<=\d+)?")
_SEPARATOR = "=" * 80


def find_definition(type_name: str, share_of: Callable[[str], Path]) -> str:
    """The text of a type and of all types in it, as MCAP's `ros2msg` wants it.

    `type_name` as in "galen_msgs/msg/DeflectionStamped"; `share_of(package)` is the package's
    share directory, or raises LookupError. Raises BagError, naming the type that is missing.
    """
    texts = {type_name: _read(type_name, share_of)}
    waiting = _types_in(type_name, texts[type_name])
    while waiting:
        name = waiting.pop(0)
        if name not in texts:
            texts[name] = _read(name, share_of)
            waiting += _types_in(name, texts[name])
    first, *others = texts.items()
    parts = [first[1]]
    parts += [f"{_SEPARATOR}\nMSG: {_short(name)}\n{text}" for name, text in others]
    return "\n".join(parts)


def _read(type_name: str, share_of: Callable[[str], Path]) -> str:
    package, folder, name = type_name.split("/")
    try:
        return (share_of(package) / folder / f"{name}.msg").read_text(encoding="utf-8")
    except (LookupError, OSError) as error:
        raise BagError(f"no definition of {type_name} is installed here: {error}") from error


def _types_in(type_name: str, text: str) -> list[str]:
    """Full names of the types that a definition's fields have."""
    package = type_name.split("/")[0]
    found = []
    for match in _TYPE.finditer(text):
        name = match["type"]
        if not _BUILT_IN.fullmatch(name):
            parts = name.split("/")
            found.append(f"{package if len(parts) == 1 else parts[0]}/msg/{parts[-1]}")
    return found


def _short(type_name: str) -> str:
    package, _, name = type_name.split("/")
    return f"{package}/{name}"
