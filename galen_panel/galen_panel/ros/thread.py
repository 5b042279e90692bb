# SPDX-License-Identifier: Apache-2.0
"""The panel's ROS side in a thread of its own, beside the server's event loop.

All that touches rclpy happens in that thread. Jobs are handed over, and answers awaited in the
event loop, whatever becomes of their origin: a page that is closed, a panel that ends. Services are
called with a time limit: their nodes may be absent, silent or gone in between.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
import traceback
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass
from typing import Any, TypeVar

from galen_model.errors import GalenError
from galen_ros.node.spin import init_ros, make_executor
from galen_ros.rclpy_workarounds import guard_parameter_services
from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.task import Future as RosFuture
from rclpy.utilities import ok, try_shutdown

from galen_panel.messages.programs import Program

T = TypeVar("T")

BEAT_S = 0.04
"""At least this often jobs are taken and `on_beat` is called."""
_START_PATIENCE_S = 30.0
_STOP_PATIENCE_S = 5.0


class CallError(GalenError):
    """What was asked for has not been done; the text says why, and what to do."""


_STOPPED = "not done: the panel is being stopped"


class Reply(Future[T]):
    """Takes an answer once, in any thread, to be awaited in an event loop; drops later ones."""

    def __init__(self) -> None:
        super().__init__()
        # So that a closed page doesn't cancel what is under way.
        self.set_running_or_notify_cancel()

    def give(self, value: T) -> None:
        """Answer.

        Args:
            value: the answer; dropped where there is one already.

        """
        with contextlib.suppress(InvalidStateError):
            self.set_result(value)

    def fail(self, error: Exception) -> None:
        """Answer with an exception.

        Args:
            error: raised where the reply is awaited; dropped where there is an answer already.

        """
        with contextlib.suppress(InvalidStateError):
            self.set_exception(error)

    def __await__(self) -> Any:
        return asyncio.wrap_future(self).__await__()


class RosThread:
    """Runs a node, from `start` to `close`."""

    def __init__(self) -> None:
        self.context = Context()
        """For further nodes."""
        self._jobs: deque[tuple[Callable[[Reply[Any]], None], Reply[Any]]] = deque()
        self._open: set[Reply[Any]] = set()
        self._lock = threading.Lock()
        self._stop = False
        self._thread: threading.Thread | None = None

    def start(
        self,
        name: str,
        argv: list[str],
        set_up: Callable[[Node], Callable[[float], None]],
        clean_up: Callable[[], None],
    ) -> None:
        """Make the node; all that is given runs in the thread.

        Args:
            name: the node's default name.
            argv: the command line with its ROS arguments.
            set_up: makes what is on the node, and returns what is called at each beat with
                time.monotonic(), s.
            clean_up: called before the node is destroyed.

        Raises:
            GalenError: ROS can't be initialised, rclpy rejects a parameter, or the node was not
                made in 30 s; what `set_up` raises comes out as well.

        """
        started: Reply[None] = Reply()
        work = (name, argv, set_up, clean_up, started)
        self._thread = threading.Thread(target=self._run, args=work, name="ros", daemon=True)
        self._thread.start()
        try:
            started.result(_START_PATIENCE_S)
        except TimeoutError:
            raise GalenError(
                f"ROS has not started within {_START_PATIENCE_S:g} s: start the panel again when"
                " the machine is less busy"
            ) from None

    def ask(self, job: Callable[[Reply[T]], None]) -> Awaitable[T]:
        """Run a job in the thread.

        Args:
            job: gives an answer to the reply, at once or later.

        Returns:
            To be awaited: the answer. It raises what the job raises, or CallError where the thread
            ends before.

        """
        reply: Reply[T] = Reply()
        with self._lock:
            if self._stop:
                reply.fail(CallError(_STOPPED))
            else:
                self._open = {one for one in self._open if not one.done()} | {reply}
                self._jobs.append((job, reply))
        return reply

    def close(self) -> None:
        """End the thread; open calls get a CallError. May be called again."""
        with self._lock:
            self._stop = True
        if self._thread is not None:
            self._thread.join(_STOP_PATIENCE_S)

    def _run(
        self,
        name: str,
        argv: list[str],
        set_up: Callable[[Node], Callable[[float], None]],
        clean_up: Callable[[], None],
        started: Reply[None],
    ) -> None:
        try:
            init_ros(argv, self.context)
        except Exception as error:
            started.fail(error)
            return
        try:
            node = Node(name, context=self.context)
            guard_parameter_services(node)
            on_beat = set_up(node)
            executor = make_executor(self.context)
            executor.add_node(node)
            started.give(None)
            self._spin(executor, on_beat)
            self._fail_open()
            clean_up()
            executor.remove_node(node)
            node.destroy_node()
            executor.shutdown()
        except ParameterException as error:  # of rclpy's own, such as use_sim_time
            started.fail(GalenError(str(error)))
        except Exception as error:
            started.fail(error)
        finally:
            self._fail_open()
            try_shutdown(context=self.context)

    def _fail_open(self) -> None:
        with self._lock:
            self._stop = True
            waiting, self._open = self._open, set()
        for reply in waiting:
            reply.fail(CallError(_STOPPED))

    def _spin(self, executor: Executor, on_beat: Callable[[float], None]) -> None:
        beat_s = 0.0
        while ok(context=self.context) and not self._stop:
            # A bug in what one message meets must not blind all browsers for good.
            try:
                while self._jobs:
                    self._do(*self._jobs.popleft())
                now_s = time.monotonic()
                if now_s >= beat_s:
                    beat_s = now_s + BEAT_S
                    on_beat(now_s)
                # The EventsExecutor takes no guard condition: a job can't wake it. It hands over
                # one event a call.
                executor.spin_once(timeout_sec=max(0.0, beat_s - time.monotonic()))
            except Exception:
                traceback.print_exc()

    def _do(self, job: Callable[[Reply[Any]], None], reply: Reply[Any]) -> None:
        try:
            job(reply)
        except Exception as error:
            reply.fail(error)


@dataclass(eq=False)
class _Pending:
    client: Client
    future: RosFuture
    deadline_s: float | None
    late: str
    done: Callable[[Any], None]


class Calls:
    """Keeps what waits for an answer. Only `ask` may be called outside the ROS thread."""

    def __init__(self, thread: RosThread, absent: Callable[[Program], str]) -> None:
        """Start with no call.

        Args:
            thread: that the clients belong to.
            absent: returns what to do where a program isn't running.

        """
        self._thread = thread
        self._absent = absent
        self._pending: list[_Pending] = []

    async def ask(self, client: Client, request: Any, program: Program, timeout_s: float) -> Any:
        """Call a service from an event loop.

        Args:
            client: of the service.
            request: the service's Request.
            program: that offers it, for the error's text.
            timeout_s: how long to wait for the answer, s.

        Returns:
            The service's Response.

        Raises:
            CallError: the service is absent, or does not answer.

        """

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
        """Call a service from the ROS thread.

        Args:
            client: of the service.
            request: the service's Request.
            program: that offers it, for the error's text.
            timeout_s: how long to wait for the answer, s; None: no limit.
            done: called with the Response or a CallError; at once where the service is absent.

        Returns:
            What gives the call up: `done` is then not called.

        """
        if not client.service_is_ready():
            done(CallError(self._absent(program)))
            return lambda: None
        future = client.call_async(request)
        late = f"{program.executable} has not answered for {timeout_s:g} s" if timeout_s else ""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        pending = _Pending(client, future, deadline_s, late, done)
        self._pending.append(pending)
        future.add_done_callback(lambda _: self._answered(pending))
        return lambda: self._give_up(pending)

    def tick(self, now_s: float) -> None:
        """End the calls whose time is over.

        Args:
            now_s: time.monotonic(), s.

        """
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
