# SPDX-License-Identifier: Apache-2.0
"""Test nodes with real rclpy: private context, own domain, a spinning thread, no sleeping."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import try_shutdown

from galen_ros.node.spin import DomainLock, make_executor

N = TypeVar("N", bound=Node)

_POLL_S = 0.005


def parameters(**values: Any) -> list[Parameter]:
    """Return a Node's `parameter_overrides`: `parameters(rate_hz=500.0)`.

    Args:
        **values: by the parameter's name.

    Returns:
        The parameters, as `set_parameters` takes them as well.

    """
    return [Parameter(name, value=value) for name, value in values.items()]


class Harness:
    """A private ROS world for one test.

        with Harness() as harness:
            node = harness.add(lambda context: MyNode(context=context))
            probe = harness.add(lambda context: Node("probe", context=context))
            ...
            harness.wait_for(lambda: len(received) > 10, 5.0, "ten samples")

    All nodes run on one executor in one thread, as in a node's own process. An exception in a
    callback ends the thread and is raised again by the next `wait_for` and at the end.
    """

    def __init__(self, make: Callable[[Context], Executor] = make_executor) -> None:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
        self._make = make
        self._nodes: list[Node] = []
        self._jobs: list[Callable[[], None]] = []
        self._jobs_lock = threading.Lock()
        self._stop = threading.Event()
        self._removed = False
        self._error: BaseException | None = None

    def __enter__(self) -> Harness:
        self._lock = DomainLock()
        self.domain_id = self._lock.domain_id
        self.context = Context()
        rclpy.init(context=self.context, domain_id=self.domain_id)
        self._executor = self._make(self.context)
        self._thread = threading.Thread(target=self._spin, name="harness", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=10.0)
        for node in self._nodes:
            node.destroy_node()
        self._executor.shutdown()
        try_shutdown(context=self.context)
        self._lock.release()
        if kind is None:
            self._raise_error()

    def add(self, make_node: Callable[[Context], N]) -> N:
        """Make a node in this world and spin it.

        Args:
            make_node: makes the node in a context; its error is raised here.

        Returns:
            The node.

        """
        node: N = self.call_in_executor(lambda: self._add(make_node))
        return node

    def remove(self, node: Node) -> None:
        """Stop and destroy one node, as if its process had ended.

        Args:
            node: one that `add` returned.

        """
        self.call_in_executor(lambda: self._remove(node))

    def call_in_executor(self, job: Callable[[], Any], timeout_s: float = 10.0) -> Any:
        """Run a job between callbacks, in the executor's thread.

        Args:
            job: its exception is raised here.
            timeout_s: how long it may take until it is done, s.

        Returns:
            What the job returns.

        Raises:
            AssertionError: it took longer.

        """
        future: Future[Any] = Future()

        def work() -> None:
            try:
                future.set_result(job())
            except BaseException as error:
                future.set_exception(error)

        with self._jobs_lock:
            self._jobs.append(work)
        self.wait_for(future.done, timeout_s, "the executor to take a job")
        return future.result()

    def answer_of(self, ask: Callable[[], Any], timeout_s: float, what: str) -> Any:
        """Run a question in the executor's thread, and wait for its answer.

        From any other thread an action client may hear the answer before it has noted the
        question, and drops it (rclpy's ActionClient has no lock; its Client has).

        Args:
            ask: returns a future.
            timeout_s: how long to wait for the answer, s.
            what: names the answer in the error's text.

        Returns:
            The future's result.

        Raises:
            AssertionError: no answer came in time.

        """
        future = self.call_in_executor(ask)
        self.wait_for(future.done, timeout_s, what)
        return future.result()

    def wait_for(self, predicate: Callable[[], Any], timeout_s: float, what: str) -> Any:
        """Wait until a predicate is true.

        Args:
            predicate: called every few milliseconds, in the caller's thread.
            timeout_s: how long to wait, s.
            what: names what is waited for in the error's text.

        Returns:
            The predicate's value.

        Raises:
            AssertionError: it did not become true in time.

        """
        deadline = time.monotonic() + timeout_s
        while True:
            self._raise_error()
            value = predicate()
            if value:
                return value
            if time.monotonic() > deadline:
                raise AssertionError(f"waited {timeout_s} s in vain for {what}")
            time.sleep(_POLL_S)

    def call(self, client: Client, request: Any, timeout_s: float = 10.0) -> Any:
        """Call a service.

        Args:
            client: of a node in this world.
            request: the service's Request.
            timeout_s: how long to wait for the service, and for its answer, s.

        Returns:
            The service's Response.

        Raises:
            AssertionError: there was no service, or no answer, in time.

        """
        name = client.srv_name
        self.wait_for(client.service_is_ready, timeout_s, f"service {name}")
        future = client.call_async(request)
        self.wait_for(future.done, timeout_s, f"an answer of {name}")
        return future.result()

    def _add(self, make_node: Callable[[Context], N]) -> N:
        node = make_node(self.context)
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def _remove(self, node: Node) -> None:
        self._removed = True
        self._nodes.remove(node)
        self._executor.remove_node(node)
        node.destroy_node()

    def _spin(self) -> None:
        try:
            while not self._stop.is_set():
                with self._jobs_lock:
                    jobs, self._jobs = self._jobs, []
                for job in jobs:
                    job()
                try:
                    self._executor.spin_once(timeout_sec=0.01)
                except InvalidHandle:
                    # The executor calls a timer that was due before its node was removed.
                    if not self._removed:
                        raise
        except BaseException as error:
            self._error = error

    def _raise_error(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error


class Lifecycle:
    """Drives a managed node by its own services, as `ros2 lifecycle` does.

    life = Lifecycle(harness, probe, "gravcomp")
    assert life.go("deactivate", "cleanup") and life.state == "unconfigured"
    """

    def __init__(self, harness: Harness, probe: Node, node_name: str) -> None:
        """Make the clients of the node's services.

        Args:
            harness: the world.
            probe: a node in it that may call them.
            node_name: of the managed node.

        """
        self._harness = harness
        self._change = probe.create_client(ChangeState, f"{node_name}/change_state")
        self._get = probe.create_client(GetState, f"{node_name}/get_state")
        self._set = probe.create_client(SetParameters, f"{node_name}/set_parameters")

    def go(self, *labels: str) -> bool:
        """Ask for transitions, one after another, until one fails.

        Args:
            *labels: such as "configure" and "activate".

        Returns:
            Whether all succeeded.

        """
        return all(self.ask(Transition(label=label)) for label in labels)

    def ask(self, transition: Transition) -> bool:
        """Ask for one transition.

        Args:
            transition: by its label or number.

        Returns:
            Whether it succeeded.

        """
        request = ChangeState.Request(transition=transition)
        return bool(self._harness.call(self._change, request).success)

    @property
    def state(self) -> str:
        """The node's state, as it answers it."""
        return str(self._harness.call(self._get, GetState.Request()).current_state.label)

    def set(self, **values: Any) -> str:
        """Set parameters one by one, as `ros2 param set` does.

        Args:
            **values: by the parameter's name.

        Returns:
            The first error's reason; empty: none.

        """
        for parameter in parameters(**values):
            request = SetParameters.Request(parameters=[parameter.to_parameter_msg()])
            (result,) = self._harness.call(self._set, request).results
            if not result.successful:
                return str(result.reason)
        return ""
