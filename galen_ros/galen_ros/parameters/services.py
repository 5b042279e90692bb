"""A node's parameter services, kept from what would end the process.

rclpy (7.1.6) raises it out of the executor when somebody sets a parameter of a type that there is
not: one wrong request, from anywhere on the network, and the node is gone.
"""

from __future__ import annotations

from typing import Any

from galen_model.errors import one_line
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter

_GUARDED = "galen_guarded"


def guard_parameter_services(node: Node) -> None:
    """Have requests that rclpy can't read rejected; may be called more than once."""
    for service in node.services:
        if hasattr(service.callback, _GUARDED):
            continue
        if service.srv_type is SetParameters:
            service.callback = _guarded(service.callback, _one_by_one)
        elif service.srv_type is SetParametersAtomically:
            service.callback = _guarded(service.callback, _all_or_none)


def _guarded(inner: Any, answer: Any) -> Any:
    def callback(request: Any, response: Any) -> Any:
        return answer(inner, request, response)

    setattr(callback, _GUARDED, True)
    return callback


def _one_by_one(inner: Any, request: Any, response: Any) -> Any:
    for message in request.parameters:
        rejected = _rejection(message)
        if rejected is None:
            one = SetParameters.Request(parameters=[message])
            (result,) = inner(one, SetParameters.Response()).results
        else:
            result = rejected
        response.results.append(result)
    return response


def _all_or_none(inner: Any, request: Any, response: Any) -> Any:
    for message in request.parameters:
        rejected = _rejection(message)
        if rejected is not None:
            response.result = rejected
            return response
    return inner(request, response)


def _rejection(message: Any) -> SetParametersResult | None:
    """None where rclpy can read it."""
    try:
        Parameter.from_parameter_msg(message)
    except (ValueError, TypeError) as error:
        name = one_line(message.name, 80)
        return SetParametersResult(
            successful=False, reason=one_line(f"parameter '{name}' can't be read: {error}")
        )
    return None
