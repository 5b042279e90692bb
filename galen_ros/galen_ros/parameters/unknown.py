"""Warns of parameters that were given to a node and that it doesn't have: a misspelt name."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from rclpy.node import Node

# rclpy declares these with the publisher or subscription that they are for, if that allows it.
_DECLARED_LATER = "qos_overrides."
_NEAR, _VERY_NEAR = 0.5, 0.8


def warn_of_unknown_parameters(node: Node, arguments: Sequence[str] | None = None) -> None:
    """Log a warning for each parameter given to `node` that it has not declared by now.

    A section of a file for any node, such as `/**`, may hold other nodes' parameters: only what is
    spelt almost as one of this node's is told of those. `arguments`: default `sys.argv`.
    """
    shared = set(_given_to_any_node(sys.argv if arguments is None else arguments))
    known = list(node._parameters)
    for name in sorted(node._parameter_overrides):
        if node.has_parameter(name) or name.startswith(_DECLARED_LATER):
            continue
        near = get_close_matches(name, known, n=1, cutoff=_VERY_NEAR if name in shared else _NEAR)
        if name in shared and not near:
            continue
        meant = f": did you mean '{near[0]}'?" if near else ""
        node.get_logger().warning(
            f"parameter '{name}' is unknown to {node.get_fully_qualified_name()} and ignored{meant}"
        )


def _given_to_any_node(arguments: Sequence[str]) -> Iterator[str]:
    """Names in the sections of `--params-file`s whose node is a wildcard."""
    for option, value in pairwise(arguments):
        if option == "--params-file":
            content = yaml.safe_load(Path(value).read_text(encoding="utf-8"))
            yield from _wildcard_names(content, "")


def _wildcard_names(content: Any, node: str) -> Iterator[str]:
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key != "ros__parameters":
            yield from _wildcard_names(value, str(key))
        elif node.endswith("*"):
            yield from _names(value, "")


def _names(content: Any, prefix: str) -> Iterator[str]:
    """Full names of parameters; a group's are nested."""
    for key, value in content.items() if isinstance(content, Mapping) else ():
        if isinstance(value, Mapping):
            yield from _names(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"
