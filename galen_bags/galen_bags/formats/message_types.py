"""Python message classes and installed definitions, found by a type's name."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_path

from galen_bags.errors import BagError
from galen_bags.formats.definitions import find_definition


def message_class(type_name: str) -> Any:
    """The class of a type such as "galen_msgs/msg/DeflectionStamped"; raises BagError."""
    try:
        package, folder, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.{folder}"), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise BagError(f"the type {type_name} is not installed here") from error


def definition_of(type_name: str) -> str:
    """The type's installed .msg text with all types in it; raises BagError."""

    def share_of(package: str) -> Path:
        return Path(get_package_share_path(package))

    return find_definition(type_name, share_of)
