"""Declares on a node the parameters of a frozen dataclass, whose fields are `galen_ros.param`s.

A node writes

    @dataclass(frozen=True)
    class Parameters:
        rate_hz: float = param(500.0, "sample rate in Hz", minimum=1.0, maximum=2000.0)

and calls `declare_parameters(node, Parameters)`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from galen_model.errors import GalenError
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from galen_ros.param import (
    Meaning,
    ParameterError,
    checked,
    markdown_table,
    param,
    param_fields,
    wanted,
)

__all__ = ["ParameterError", "declare_parameters", "markdown_table", "param"]

T = TypeVar("T")

_INT64_MAX = 2**63 - 1


def declare_parameters(node: Node, cls: type[T], on_change: Callable[[T], None] | None = None) -> T:
    """Declare every `param` field of `cls` on `node`; return an instance with the values in force.

    An integer is accepted where a float is asked. The instance's `validate()` is called if it has
    one; it raises a GalenError (or ValueError) when values don't fit together. A value that can't
    be used raises `ParameterError` at start-up, and is refused when set at run time.
    `on_change(new_instance)` is called after every accepted change of a `read_only=False` field.
    """
    fields = param_fields(cls)
    values = {}
    for name, (hint, default, meaning) in fields.items():
        values[name] = _declare(node, name, hint, default, meaning)
    current = cls(**values)
    _validate(current)
    if any(not meaning.read_only for _, _, meaning in fields.values()):
        _follow_changes(node, current, fields, on_change)
    return current


def _declare(node: Node, name: str, hint: Any, default: Any, meaning: Meaning) -> Any:
    """Declare one parameter and return its checked value."""
    descriptor = ParameterDescriptor(
        name=name,
        description=meaning.description,
        read_only=meaning.read_only,
        # With a static type rclpy would refuse 5 for 5.0; `_checked` holds the type instead.
        dynamic_typing=True,
    )
    if meaning.minimum is not None or meaning.maximum is not None:
        low = -math.inf if meaning.minimum is None else meaning.minimum
        high = math.inf if meaning.maximum is None else meaning.maximum
        if hint is float:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
        elif hint is int:
            descriptor.integer_range = [
                IntegerRange(
                    from_value=int(max(low, -_INT64_MAX)), to_value=int(min(high, _INT64_MAX))
                )
            ]
    start = list(default) if isinstance(default, tuple) else default
    try:
        value = node.declare_parameter(name, start, descriptor).value
    except ParameterException as error:
        # rclpy keeps an override's value to itself: its own message says it, ours adds the range.
        raise ParameterError(
            f"parameter '{name}' must be {wanted(hint, meaning)}: {error}"
        ) from error
    return checked(name, value, hint, meaning)


def _follow_changes(
    node: Node, first: T, fields: dict[str, Any], on_change: Callable[[T], None] | None
) -> None:
    """Check what is set at run time, and tell `on_change`."""
    current = first

    def changed(parameters: Sequence[Parameter]) -> T:
        new = {}
        for parameter in parameters:
            if parameter.name in fields:
                hint, _, meaning = fields[parameter.name]
                new[parameter.name] = checked(parameter.name, parameter.value, hint, meaning)
        instance = dataclasses.replace(current, **new) if new else current  # type: ignore[type-var]
        if new:
            _validate(instance)
        return instance

    def on_set(parameters: Sequence[Parameter]) -> SetParametersResult:
        try:
            changed(parameters)
        except GalenError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def on_post_set(parameters: Sequence[Parameter]) -> None:
        nonlocal current
        new = changed(parameters)
        if new is not current:
            current = new
            if on_change is not None:
                on_change(new)

    node.add_on_set_parameters_callback(on_set)
    node.add_post_set_parameters_callback(on_post_set)


def _validate(instance: Any) -> None:
    validate = getattr(instance, "validate", None)
    if validate is None:
        return
    try:
        validate()
    except ValueError as error:
        raise ParameterError(str(error)) from error
