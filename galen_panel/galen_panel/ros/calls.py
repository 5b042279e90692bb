"""Service calls with a time limit, to nodes that may be absent, silent or gone in between."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.client import Client
from rclpy.task import Future

from galen_panel.messages.programs import Program
from galen_panel.ros.thread import CallError, Reply, RosThread


@dataclass(eq=False)
class _Pending:
    client: Client
    future: Future
    deadline_s: float | None
    late: str
    done: Callable[[Any], None]


class Calls:
    """Keeps what waits for an answer. Only `ask` may be called outside the ROS thread."""

    def __init__(self, thread: RosThread) -> None:
        self._thread = thread
        self._pending: list[_Pending] = []

    async def ask(self, client: Client, request: Any, program: Program, timeout_s: float) -> Any:
        """Call a service from an event loop and return its response; raises CallError."""

        def job(reply: Reply[Any]) -> None:
            def done(answer: Any) -> None:
                if isinstance(answer, CallError):
                    reply.fail(answer)
                else:
                    reply.give(answer)

            self.send(client, request, program, timeout_s, done)

        return await self._thread.ask(job)

    def send(
        self,
        client: Client,
        request: Any,
        program: Program,
        timeout_s: float | None,
        done: Callable[[Any], None],
    ) -> Callable[[], None]:
        """Send, then `done(the response, or a CallError)`; returns what gives it up, unanswered.

        timeout_s None: no limit.
        """
        if not client.service_is_ready():
            done(CallError(program.absent))
            return lambda: None
        future = client.call_async(request)
        late = f"{program.executable} has not answered for {timeout_s:g} s" if timeout_s else ""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        pending = _Pending(client, future, deadline_s, late, done)
        self._pending.append(pending)
        future.add_done_callback(lambda _: self._answered(pending))
        return lambda: self._give_up(pending)

    def tick(self, now_s: float) -> None:
        """Tell those whose time is over; now_s: time.monotonic()."""
        for pending in list(self._pending):
            if pending.deadline_s is not None and now_s > pending.deadline_s:
                self._give_up(pending)
                pending.done(CallError(f"{pending.late}: it hangs or is busy, see Nodes"))

    def _answered(self, pending: _Pending) -> None:
        if pending not in self._pending:
            return
        self._pending.remove(pending)
        error = pending.future.exception()
        pending.done(
            pending.future.result() if error is None else CallError(f"no readable answer: {error}")
        )

    def _give_up(self, pending: _Pending) -> None:
        if pending in self._pending:
            self._pending.remove(pending)
            pending.client.remove_pending_request(pending.future)
