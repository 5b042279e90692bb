"""Work beside the executor, such as reading files: in a thread of its own, one job after another.

A node's callbacks must end at once, or its streams wait. A disk, and more so a network's, takes as
long as it likes.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

T = TypeVar("T")

_LOOK_PERIOD_S = 0.005


class Background:
    """Runs jobs in the order in which they are handed over."""

    def __init__(self, node: Node) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="background")
        self._waiting: list[
            tuple[Future[Any], Callable[[Any], None], Callable[[], None] | None]
        ] = []
        # rclpy's EventsExecutor takes no guard conditions (7.1.6), so it is looked while jobs wait.
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
        """Run `job` in the thread, then `done(its result)` in the executor's thread.

        An exception of the job is raised there as well. `dropped` is called instead where `close`
        came before the job's turn. Call it in the executor's thread.
        """
        self._waiting.append((self._thread.submit(job), done, dropped))
        self._look.reset()

    def close(self) -> None:
        """Wait for the job at work, drop the others; call it before the node is destroyed."""
        self._thread.shutdown(wait=True, cancel_futures=True)
        waiting, self._waiting = self._waiting, []
        for future, done, dropped in waiting:
            if not future.cancelled():
                done(future.result())
            elif dropped is not None:
                dropped()

    def _on_look(self) -> None:
        while self._waiting and self._waiting[0][0].done():
            future, done, _ = self._waiting.pop(0)
            done(future.result())
        if not self._waiting:
            self._look.cancel()
