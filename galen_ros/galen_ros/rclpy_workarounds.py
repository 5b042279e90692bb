# SPDX-License-Identifier: Apache-2.0
"""Workarounds for defects of rclpy, each with its upstream issue; written for `RCLPY_VERSION`.

| here | defect | upstream |
|---|---|---|
| `DeferredService` | EventsExecutor does not await an `async` service callback | ros2/rclpy#1473 |
| `DeferredActionServer` | executors poll an `async` execute callback | ros2/rclpy#1405 |
| `BackgroundJobs` | EventsExecutor ignores guard conditions | ros2/rclpy#1391 |
| `guard_parameter_services` | a parameter of an unknown type ends the node | ros2/rclcpp#3257 |
| `guard_transitions` | a transition that the state lacks ends the node | ros2/rclpy#1209 |
| `destroy_all` | the executor calls what was destroyed | ros2/rclpy#1206 |
| `leave_graph` | a destroyed node stays on the graph | ros2/rclpy#1710 |

A test fails when rclpy's version changes: look the issues up, remove what is fixed, then raise
`RCLPY_VERSION`. rclpy 7.1.11 fixes the first one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar, cast

from galen_model.errors import one_line
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter

RCLPY_VERSION = "7.1.6"

T = TypeVar("T")
# Sends the filled response to the caller; to be called once.
Respond = Callable[[Any], None]

_LOOK_PERIOD_S = 0.005
_GUARDED = "galen_guarded"


# Answers that come later


class DeferredService:
    """Calls `callback(request, response, respond)`; the caller waits until `respond(response)`.

    `respond` may be called at once, inside the callback, or any time later from the executor's
    thread. A caller that has gone by then is no error. All executors call the public
    `Service.send_response` with whatever the callback returns: there the answer is held back.
    https://github.com/ros2/rclpy/issues/1473
    """

    def __init__(
        self,
        node: Node,
        service_type: Any,
        name: str,
        callback: Callable[[Any, Any, Respond], None],
    ) -> None:
        self._callback = callback
        # Of each request, newest last: its header and the filled response, as far as known.
        self._pending: list[dict[str, Any]] = []
        service = cast(Any, node.create_service(service_type, name, self._on_request))
        self._send = service.send_response
        service.send_response = self._on_send

    def _on_request(self, request: Any, response: Any) -> Any:
        answer: dict[str, Any] = {}
        self._pending.append(answer)

        def respond(filled: Any) -> None:
            if "response" in answer:
                raise RuntimeError("a service request was answered twice")
            self._complete(answer, response=filled)

        self._callback(request, response, respond)
        return response

    def _on_send(self, _response: Any, header: Any) -> None:
        # The executor runs one callback to its end, with its send, before the next.
        self._complete(self._pending.pop(), header=header)

    def _complete(self, answer: dict[str, Any], **known: Any) -> None:
        """Send the answer as soon as both the response and the header are known."""
        answer |= known
        if len(answer) == 2:
            self._send(answer["response"], answer["header"])


class DeferredActionServer(ActionServer):
    """Calls `on_start(goal_handle)` when a goal begins; `finish` gives its result, any time later.

    rclpy's executors poll an `async` execute callback that awaits a future: the EventsExecutor
    keeps one core busy for as long as the goal runs. Here nothing runs between a goal's acceptance
    and its end. All callbacks are plain functions; the goal executes from `on_start` on.
    https://github.com/ros2/rclpy/issues/1405
    """

    def __init__(
        self,
        node: Node,
        action_type: Any,
        name: str,
        on_goal: Callable[[Any], GoalResponse],
        on_start: Callable[[ServerGoalHandle], None],
        on_cancel: Callable[[ServerGoalHandle], CancelResponse],
    ) -> None:
        self._on_start = on_start
        super().__init__(
            node,
            action_type,
            name,
            execute_callback=self._never,
            goal_callback=on_goal,
            cancel_callback=on_cancel,
        )

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        """Begin a goal; ServerGoalHandle.execute calls it, where rclpy would start a coroutine.

        Args:
            goal_handle: of the accepted goal; `on_start` gets it.
            execute_callback: rclpy's argument, not used.

        """
        self._on_start(goal_handle)

    def finish(self, goal_handle: ServerGoalHandle, result: Any, success: bool) -> None:
        """End a goal: succeeded, canceled where the client asked for it, else aborted.

        Args:
            goal_handle: as `on_start` got it.
            result: the action's Result.
            success: whether the goal has succeeded.

        """

        def end(handle: ServerGoalHandle) -> Any:
            if success:
                handle.succeed()
            elif handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
            return result

        super().notify_execute(goal_handle, end)

    def _never(self, _goal_handle: ServerGoalHandle) -> Any:
        raise AssertionError("goals of a DeferredActionServer end through finish()")


class BackgroundJobs:
    """Runs jobs, such as reading files, in a thread beside the executor, one after another.

    A guard condition would wake the executor when a job is done; EventsExecutor ignores them, so a
    timer looks while jobs wait. https://github.com/ros2/rclpy/pull/1391
    """

    def __init__(self, node: Node) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="background")
        self._waiting: list[
            tuple[Future[Any], Callable[[Any], None], Callable[[], None] | None]
        ] = []
        # Wall time: also while a simulation's clock stands still.
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._look = node.create_timer(_LOOK_PERIOD_S, self._on_look, clock=self._clock)
        self._look.cancel()

    def submit(
        self,
        job: Callable[[], T],
        done: Callable[[T], None],
        dropped: Callable[[], None] | None = None,
    ) -> None:
        """Run a job in the thread; call this in the executor's thread.

        Args:
            job: runs in the thread, after those submitted before.
            done: called with the job's result in the executor's thread; an exception of the job is
                raised there instead.
            dropped: called instead where `close` came before the job's turn; None: nothing is.

        """
        self._waiting.append((self._thread.submit(job), done, dropped))
        self._look.reset()

    def close(self) -> None:
        """Wait for the running job, drop the others; call it before the node is destroyed."""
        self._thread.shutdown(wait=True, cancel_futures=True)
        waiting, self._waiting = self._waiting, []
        for future, done, dropped in waiting:
            if not future.cancelled():
                done(future.result())
            elif dropped is not None:
                dropped()

    def _on_look(self) -> None:
        if not self._waiting:  # closed, and the timer with the node destroyed (ros2/rclpy#1206)
            return
        while self._waiting and self._waiting[0][0].done():
            future, done, _ = self._waiting.pop(0)
            done(future.result())
        if not self._waiting:
            self._look.cancel()


# Requests that would end the node


def guard_parameter_services(node: Node) -> None:
    """Reject requests with parameters that rclpy can't read; may be called more than once.

    rclpy raises out of the executor for a parameter of an unknown type, as rclcpp did:
    https://github.com/ros2/rclcpp/issues/3257

    Args:
        node: whose parameter services are guarded.

    """
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
        result = _rejection(message)
        if result is None:
            one = SetParameters.Request(parameters=[message])
            (result,) = inner(one, SetParameters.Response()).results
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


def guard_transitions(node: Node, state: Callable[[], str]) -> None:
    """Answer "no" to a transition that the state lacks, where rclpy raises out of the executor.

    https://github.com/ros2/rclpy/issues/1209

    Args:
        node: a lifecycle node, with its one service `change_state`.
        state: returns the state's name, for the log.

    """
    (service,) = (s for s in node.services if s.srv_name.endswith("/change_state"))
    change_state = service.callback

    def callback(request: Any, response: Any) -> Any:
        try:
            return change_state(request, response)
        except RuntimeError as error:
            wanted = request.transition.label or request.transition.id
            node.get_logger().warning(
                f"transition '{wanted}' is rejected: the node is {state()} ({error})"
            )
            response.success = False
            return response

    service.callback = callback


# Destruction


def destroy_all(made: Iterable[tuple[Any, Callable[[Any], object]]]) -> None:
    """Destroy entities; what the executor still holds of them is ignored.

    https://github.com/ros2/rclpy/issues/1206

    Args:
        made: each entity (publisher, subscription, service, client, timer) with what destroys it.

    """
    for entity, destroy in made:
        for one in (entity, *getattr(entity, "event_handlers", ())):
            if hasattr(one, "callback"):
                one.callback = _ignore
        if hasattr(entity, "send_response"):
            entity.send_response = _ignore
        destroy(entity)


def leave_graph(node: Any) -> None:
    """Remove the services of a destroyed lifecycle node from the graph.

    https://github.com/ros2/rclpy/issues/1710

    Args:
        node: a lifecycle node, destroyed.

    """
    node._state_machine.destroy_when_not_in_use()


def _ignore(*_: Any) -> None:
    pass
