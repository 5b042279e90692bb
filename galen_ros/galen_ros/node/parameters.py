# SPDX-License-Identifier: Apache-2.0
"""Declare on a node the parameters of a frozen dataclass (`galen_common.parameters`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from typing import Any, Generic, TypeVar, cast

from galen_common.parameters import Meaning, ParameterError, checked, param_fields, wanted
from galen_model.errors import GalenError
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from galen_ros.rclpy_workarounds import guard_parameter_services

T = TypeVar("T")

# rclpy declares these with the publisher or subscription that they are for, if that allows it.
_DECLARED_LATER = "qos_overrides."


def declare_parameters(
    node: Node, cls: type[T], on_change: Callable[[T], None] | None = None, **others: Any
) -> T:
    """Declare every `param` field of a dataclass on a node.

    An integer is accepted where a float is asked. The instance's `validate()` is called if it has
    one; it raises a GalenError when values don't fit together. A value that can't be used is
    rejected when set at run time.

    Args:
        node: that has the parameters.
        cls: dataclass with `param` fields.
        on_change: called with the new instance after every accepted change of a `read_only=False`
            field.
        **others: values of the fields that are no parameters.

    Returns:
        An instance with the active values; a later change makes another one.

    Raises:
        ParameterError: a value given at start-up can't be used, or the values don't fit together.

    """
    return Held(node, cls, on_change, **others).now


class Held(Generic[T]):
    """The parameters of a node, checked when they are set; `now` has those active."""

    def __init__(
        self,
        node: Node,
        cls: type[T],
        on_change: Callable[[T], None] | None = None,
        why_fixed: Callable[[], str] | None = None,
        **others: Any,
    ) -> None:
        """Declare the parameters.

        Args:
            node: that has them.
            cls: dataclass with `param` fields.
            on_change: called with the new instance after an accepted change; not while
                `why_fixed()` is empty.
            why_fixed: returns why the `read_only` fields can't be set now, such as "while the node
                is active"; while it returns an empty text, every field can be set. None: these can
                never be set.
            **others: values of the fields that are no parameters.

        Raises:
            ParameterError: a value given at start-up can't be used, or the values don't fit
                together.

        """
        guard_parameter_services(node)
        self._fields = param_fields(cls)
        self._on_change = on_change
        self._why_fixed = why_fixed
        values = {
            name: _declare(node, name, *field, fixed=why_fixed is None)
            for name, field in self._fields.items()
        }
        self.now = cls(**values, **others)
        _validate(self.now)
        if why_fixed or any(not meaning.read_only for _, _, meaning in self._fields.values()):
            node.add_on_set_parameters_callback(self._on_set)
            node.add_post_set_parameters_callback(self._on_post_set)

    def _changed(self, parameters: Sequence[Parameter]) -> T:
        new = {}
        for parameter in parameters:
            if parameter.name in self._fields:
                hint, _, meaning = self._fields[parameter.name]
                new[parameter.name] = checked(parameter.name, parameter.value, hint, meaning)
        if not new:
            return self.now
        instance = cast(T, dataclasses.replace(cast(Any, self.now), **new))
        _validate(instance)
        return instance

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        why = "" if self._why_fixed is None else self._why_fixed()
        for parameter in parameters if why else ():
            if parameter.name in self._fields and self._fields[parameter.name][2].read_only:
                reason = f"parameter '{parameter.name}' can't be set {why}"
                return SetParametersResult(successful=False, reason=reason)
        try:
            self._changed(parameters)
        except GalenError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_post_set(self, parameters: Sequence[Parameter]) -> None:
        new = self._changed(parameters)
        if new is self.now:
            return
        self.now = new
        if self._on_change is not None and (self._why_fixed is None or self._why_fixed()):
            self._on_change(new)


def _declare(
    node: Node, name: str, hint: Any, default: Any, meaning: Meaning, *, fixed: bool
) -> Any:
    """Declare one parameter and return its checked value; `fixed`: rclpy keeps a read-only one."""
    descriptor = ParameterDescriptor(
        name=name,
        description=meaning.description,
        read_only=fixed and meaning.read_only,
        # With a static type rclpy would reject 5 for 5.0; `checked` holds the type instead.
        dynamic_typing=True,
    )
    start = list(default) if isinstance(default, tuple) else default
    try:
        value = node.declare_parameter(name, start, descriptor).value
    except (ParameterException, ValueError) as error:  # ValueError: a list with nothing in it
        # rclpy's message has the override's value, ours adds the range.
        raise ParameterError(
            f"parameter '{name}' must be {wanted(hint, meaning)}: {error}"
        ) from error
    if value is None and isinstance(default, tuple):
        value = ()  # ROS knows no type of an empty list, and hands over none
    return checked(name, value, hint, meaning)


def _validate(instance: Any) -> None:
    validate = getattr(instance, "validate", None)
    if validate is not None:
        validate()


def warn_of_unknown_parameters(node: Node) -> None:
    """Log a warning for each parameter given to a node whose name is nearly one of its own.

    Others are not named: a section for any node, such as `/**`, may hold other nodes' parameters.

    Args:
        node: that has declared its parameters.

    """
    known = list(node._parameters)
    for name in sorted(node._parameter_overrides):
        if node.has_parameter(name) or name.startswith(_DECLARED_LATER):
            continue
        for near in get_close_matches(name, known, n=1):
            node.get_logger().warning(
                f"parameter '{name}' is unknown to {node.get_fully_qualified_name()} and ignored:"
                f" did you mean '{near}'?"
            )
