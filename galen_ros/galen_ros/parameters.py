"""Node parameters declared from a frozen dataclass: type, default, range and meaning in one place.

A node writes

    @dataclass(frozen=True)
    class Parameters:
        rate_hz: float = param(500.0, "sample rate in Hz", minimum=1.0, maximum=2000.0)

and calls `declare_parameters(node, Parameters)`. The same dataclass gives the README its table
(`markdown_table`), so that the two can't differ.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, get_type_hints

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

T = TypeVar("T")

# What a field may be annotated with, and what the README calls it.
_TYPE_NAMES: dict[Any, str] = {
    bool: "bool",
    int: "int",
    float: "float",
    str: "string",
    tuple[float, ...]: "float list",
    tuple[int, ...]: "int list",
    tuple[str, ...]: "string list",
    tuple[bool, ...]: "bool list",
}
_INT64_MAX = 2**63 - 1


class ParameterError(GalenError):
    """A parameter's value can't be used. The message names parameter, value and what is allowed."""


@dataclasses.dataclass(frozen=True)
class _Meaning:
    """What `param` keeps about a field, beside its default."""

    description: str
    minimum: float | None
    maximum: float | None
    read_only: bool


def param(
    default: Any,
    description: str,
    minimum: float | None = None,
    maximum: float | None = None,
    read_only: bool = True,
) -> Any:
    """Return a dataclass field that is also a node parameter.

    `minimum` and `maximum` are inclusive, and hold for every element of a list. Name the unit in
    the field's name or in `description`. With `read_only=False` it can be set while the node runs.
    A list default becomes a tuple; annotate it `tuple[float, ...]`.
    """
    value = tuple(default) if isinstance(default, list | tuple) else default
    meaning = _Meaning(description, minimum, maximum, read_only)
    return dataclasses.field(default=value, metadata={"param": meaning})


def declare_parameters(node: Node, cls: type[T], on_change: Callable[[T], None] | None = None) -> T:
    """Declare every `param` field of `cls` on `node`; return an instance with the values in force.

    An integer is accepted where a float is asked. The instance's `validate()` is called if it has
    one; it raises a GalenError (or ValueError) when values don't fit together. A value that can't
    be used raises `ParameterError` at start-up, and is refused when set at run time.
    `on_change(new_instance)` is called after every accepted change of a `read_only=False` field.
    """
    fields = _param_fields(cls)
    values = {}
    for name, (hint, default, meaning) in fields.items():
        values[name] = _declare(node, name, hint, default, meaning)
    current = cls(**values)
    _validate(current)
    if any(not meaning.read_only for _, _, meaning in fields.values()):
        _follow_changes(node, current, fields, on_change)
    return current


def markdown_table(cls: type) -> str:
    """Return the parameters of `cls` as a Markdown table (no newline at the end)."""
    lines = ["| name | type | default | range | meaning |", "|---|---|---|---|---|"]
    for name, (hint, default, meaning) in _param_fields(cls).items():
        text = meaning.description if meaning.read_only else meaning.description + " (at run time)"
        lines.append(
            f"| `{name}` | {_TYPE_NAMES[hint]} | {_format(default)} "
            f"| {_format_range(meaning)} | {text} |"
        )
    return "\n".join(lines)


def _param_fields(cls: type) -> dict[str, tuple[Any, Any, _Meaning]]:
    """Return name -> (type hint, default, meaning) of the `param` fields, in their order."""
    hints = get_type_hints(cls)
    found = {}
    for field in dataclasses.fields(cls):
        if "param" not in field.metadata:
            continue
        hint = hints[field.name]
        if hint not in _TYPE_NAMES:
            raise TypeError(f"{cls.__name__}.{field.name}: a parameter can't be a {hint}")
        found[field.name] = (hint, field.default, field.metadata["param"])
    return found


def _declare(node: Node, name: str, hint: Any, default: Any, meaning: _Meaning) -> Any:
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
            f"parameter '{name}' must be {_wanted(hint, meaning)}: {error}"
        ) from error
    return _checked(name, value, hint, meaning)


def _checked(name: str, value: Any, hint: Any, meaning: _Meaning) -> Any:
    """Return `value` as the field's type, or raise ParameterError."""
    element = {tuple[float, ...]: float, tuple[int, ...]: int, tuple[str, ...]: str}.get(
        hint, bool if hint == tuple[bool, ...] else None
    )
    try:
        if element is None:
            return _checked_scalar(value, hint, meaning)
        if isinstance(value, str | bytes) or not hasattr(value, "__iter__"):
            raise ValueError
        return tuple(_checked_scalar(item, element, meaning) for item in value)
    except ValueError:
        shown = list(value) if hasattr(value, "tolist") else value
        raise ParameterError(
            f"parameter '{name}' is {shown!r}, but must be {_wanted(hint, meaning)}"
        ) from None


def _checked_scalar(value: Any, kind: Any, meaning: _Meaning) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    # bool is a subclass of int in Python, not in ROS.
    if type(value) is not kind:
        raise ValueError
    if kind in (int, float):
        if not math.isfinite(value):
            raise ValueError
        if meaning.minimum is not None and value < meaning.minimum:
            raise ValueError
        if meaning.maximum is not None and value > meaning.maximum:
            raise ValueError
    return value


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
                new[parameter.name] = _checked(parameter.name, parameter.value, hint, meaning)
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


def _wanted(hint: Any, meaning: _Meaning) -> str:
    text = f"a {_TYPE_NAMES[hint]}" if hint is not int else "an int"
    limits = _format_range(meaning)
    return text if not limits else f"{text}, {limits}"


def _format_range(meaning: _Meaning) -> str:
    if meaning.minimum is not None and meaning.maximum is not None:
        return f"{_format(meaning.minimum)} to {_format(meaning.maximum)}"
    if meaning.minimum is not None:
        return f"at least {_format(meaning.minimum)}"
    if meaning.maximum is not None:
        return f"at most {_format(meaning.maximum)}"
    return ""


def _format(value: Any) -> str:
    """Format a value as YAML, as a person would write it in a parameter file."""
    if isinstance(value, tuple):
        return "[" + ", ".join(_format(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return repr(value)
