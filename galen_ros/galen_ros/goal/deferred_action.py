"""An action server whose goals end later, without a coroutine that waits for it.

rclpy's way is an `async` execute callback that awaits a future. Its executors poll such a
coroutine: the EventsExecutor puts an unfinished one straight back on its queue and so keeps one
core fully busy for as long as the goal runs; the SingleThreadedExecutor resumes it with every
message. Here nothing runs between a goal's acceptance and its end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node


class DeferredActionServer(ActionServer):
    """Calls `on_start(goal_handle)` when a goal begins; `finish` gives its result, any time later.

    All callbacks are plain functions. The goal counts as executing from `on_start` on.
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
        """Begin a goal; ServerGoalHandle.execute calls it, where rclpy would start a coroutine."""
        self._on_start(goal_handle)

    def finish(self, goal_handle: ServerGoalHandle, result: Any, success: bool) -> None:
        """End the goal: succeeded, canceled where the client asked for it, else aborted."""

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
