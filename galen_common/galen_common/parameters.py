# SPDX-License-Identifier: Apache-2.0
"""Parameters as fields of a frozen dataclass: type, default, range and meaning in one place.

    @dataclass(frozen=True)
    class Parameters:
        rate_hz: float = param(500.0, "sample rate in Hz", minimum=1.0, maximum=2000.0)

A node declares them by `galen_ros.node.parameters.declare_parameters`, a command takes some of
them as options by `add_options` and `from_options`, and a README has its table from
`markdown_table`, so that none of these can differ from the others. No ROS here.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, get_type_hints

from galen_model.errors import GalenError

T = TypeVar("T")

# What a field may be annotated with, and what the README calls it.
_TYPE_NAMES: dict[Any, str] = {
    bool: "bool",
    int: "int",
    float: "float",
    str: "string",
    tuple[float, ...]: "float list",
    tuple[str, ...]: "string list",
}


LARGEST = 1e12
"""Of any float: no SI number of an arm comes near it, and products of several don't overflow."""


class ParameterError(GalenError):
    """A parameter's value can't be used. The message names parameter, value and what is allowed."""


@dataclasses.dataclass(frozen=True)
class Meaning:
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

    Args:
        default: of the field's type; a list becomes a tuple, whose field is annotated `tuple[float,
            ...]` or `tuple[str, ...]`.
        description: meaning, for README and help; names the unit unless the field's name does.
        minimum: smallest value, inclusive, of every element of a list; None: no limit.
        maximum: largest value, inclusive, of every element of a list; None: no limit but LARGEST.
        read_only: whether it can't be set while the node runs.

    Returns:
        What `dataclasses.field` gives.

    """
    value = tuple(default) if isinstance(default, list | tuple) else default
    meaning = Meaning(description, minimum, maximum, read_only)
    return dataclasses.field(default=value, metadata={"param": meaning})


def markdown_table(cls: type) -> str:
    """Return the parameters of a class as a Markdown table.

    Args:
        cls: dataclass with `param` fields.

    Returns:
        The table, without a newline at the end.

    """
    lines = ["| name | type | default | range | meaning |", "|---|---|---|---|---|"]
    for name, (hint, default, meaning) in param_fields(cls).items():
        text = meaning.description if meaning.read_only else meaning.description + " (at run time)"
        lines.append(
            f"| `{name}` | {_TYPE_NAMES[hint]} | {_format(default)} "
            f"| {_format_range(meaning)} | {text} |"
        )
    return "\n".join(lines)


def add_options(parser: argparse._ActionsContainer, cls: type, names: Sequence[str]) -> None:
    """Let a command take some of the parameters: `settle_s` as `--settle-s`, its default shown.

    A value outside of the parameter's range is a usage error.

    Args:
        parser: parser, or a group of its options.
        cls: dataclass with `param` fields.
        names: of the fields that become options; each an int, a float or a str.

    Raises:
        TypeError: a field has a type that no option can have.

    """
    fields = param_fields(cls)
    for name in names:
        hint, default, meaning = fields[name]
        if hint not in (int, float, str):
            raise TypeError(f"{cls.__name__}.{name}: no option can be a {hint}")
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=_option_type(hint, meaning),
            default=default,
            metavar=_TYPE_NAMES[hint].upper(),
            help=f"{meaning.description.replace('%', '%%')} (default {_format(default)})",
        )


def from_options(options: argparse.Namespace, cls: type[T], names: Sequence[str]) -> T:
    """Read the options that `add_options` made into parameters.

    Args:
        options: parsed.
        cls: dataclass with `param` fields.
        names: of the fields that are options; others have their defaults.

    Returns:
        The instance, not validated.

    """
    return cls(**{name: getattr(options, name) for name in names})


def _option_type(hint: Any, meaning: Meaning) -> Callable[[str], Any]:
    def convert(text: str) -> Any:
        try:
            return _checked_scalar(hint(text), hint, meaning)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{text!r}, but must be {wanted(hint, meaning)}"
            ) from None

    return convert


def param_fields(cls: type) -> dict[str, tuple[Any, Any, Meaning]]:
    """Return the `param` fields of a class.

    Args:
        cls: dataclass; fields without `param` are left out.

    Returns:
        Type hint, default and meaning by the field's name, in the fields' order.

    Raises:
        TypeError: a field's type is not one that a parameter can have.

    """
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


def checked(name: str, value: Any, hint: Any, meaning: Meaning) -> Any:
    """Return a parameter's value as the field's type.

    Args:
        name: of the parameter, for the error's text.
        value: as ROS or a caller gives it; an int is taken for a float, an array for a list.
        hint: the field's type.
        meaning: with the range, which holds for every element of a list.

    Returns:
        The value; a list as a tuple.

    Raises:
        ParameterError: it has another type, is out of range, or is not finite.

    """
    element = {tuple[float, ...]: float, tuple[str, ...]: str}.get(hint)
    try:
        if element is None:
            return _checked_scalar(value, hint, meaning)
        if isinstance(value, str | bytes) or not hasattr(value, "__iter__"):
            raise ValueError
        return tuple(_checked_scalar(item, element, meaning) for item in value)
    except ValueError:
        shown = list(value) if hasattr(value, "tolist") else value
        raise ParameterError(
            f"parameter '{name}' is {shown!r}, but must be {wanted(hint, meaning)}"
        ) from None


def _checked_scalar(value: Any, kind: Any, meaning: Meaning) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    # bool is a subclass of int in Python, not in ROS.
    if type(value) is not kind:
        raise ValueError
    if kind in (int, float):
        if not math.isfinite(value) or (kind is float and abs(value) > LARGEST):
            raise ValueError
        if meaning.minimum is not None and value < meaning.minimum:
            raise ValueError
        if meaning.maximum is not None and value > meaning.maximum:
            raise ValueError
    return value


def wanted(hint: Any, meaning: Meaning) -> str:
    """Return of what type and in what range a value must be, in words.

    Args:
        hint: the field's type.
        meaning: with the range.

    Returns:
        The words, to follow "must be".

    """
    text = f"a {_TYPE_NAMES[hint]}" if hint is not int else "an int"
    limits = [_format_range(meaning)]
    if hint in (float, tuple[float, ...]) and meaning.maximum is None:
        limits.append(f"no larger than {LARGEST:g}")
    return ", ".join([text, *filter(None, limits)])


def _format_range(meaning: Meaning) -> str:
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
