"""A service whose answer comes later, while the node goes on working.

rclpy has `async` service callbacks for that, but its EventsExecutor doesn't await them (7.1.6).
Both executors do call the public `Service.send_response` with whatever the callback returns, and
that is where the answer is held back here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from rclpy.node import Node

# Sends the filled response to the caller; to be called once.
Respond = Callable[[Any], None]


class DeferredService:
    """Calls `callback(request, response, respond)`; the caller waits until `respond(response)`.

    `respond` may be called at once, inside the callback, or any time later from the executor's
    thread. A caller who has gone by then is no error.
    """

    def __init__(
        self,
        node: Node,
        service_type: Any,
        name: str,
        callback: Callable[[Any, Any, Respond], None],
    ) -> None:
        self._callback = callback
        self._pending: list[_Answer] = []
        self._service = cast(Any, node.create_service(service_type, name, self._on_request))
        self._send = self._service.send_response
        self._service.send_response = self._on_send

    def _on_request(self, request: Any, response: Any) -> Any:
        answer = _Answer(self)
        self._pending.append(answer)
        self._callback(request, response, answer.respond)
        return response

    def _on_send(self, response: Any, header: Any) -> None:
        # The executor runs one callback to its end, with its send, before the next.
        answer = self._pending.pop()
        answer.header = header
        answer.send_when_complete()

    def send(self, response: Any, header: Any) -> None:
        """Send `response` to the caller that `header` names."""
        self._send(response, header)


class _Answer:
    """One request's answer: goes out as soon as both the response and the header are known."""

    def __init__(self, service: DeferredService) -> None:
        self._service = service
        self._response: Any = None
        self.header: Any = None

    def respond(self, response: Any) -> None:
        if self._response is not None:
            raise RuntimeError("a service request was answered twice")
        self._response = response
        self.send_when_complete()

    def send_when_complete(self) -> None:
        if self._response is not None and self.header is not None:
            self._service.send(self._response, self.header)
