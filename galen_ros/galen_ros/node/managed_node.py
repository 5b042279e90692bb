# SPDX-License-Identifier: Apache-2.0
"""A managed (lifecycle) node that also starts by itself.

The states are ROS 2's: unconfigured, inactive, active, finalized. A subclass implements
the way up, `_configure` and `_activate`; on the way down all that these have made (publishers,
subscriptions, services, clients, timers) is destroyed here, after what they asked for by
`_at_undo`. So a node that is configured again starts from nothing, with the parameters of then.

An exception in a transition is logged and becomes the error state; what was made is destroyed, the
node is unconfigured again and says on /diagnostics what happened, so that it can be fixed and
configured. Only at a start by itself (`autostart`) it is raised, and the
process ends with the reason, as one that is not managed does.
"""

from __future__ import annotations

import traceback
from abc import abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, TypeVar

from galen_common.parameters import param
from galen_model.errors import GalenError
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from galen_ros.node.diagnostics import ERROR, WARN, DiagnosticsPublisher, Status
from galen_ros.node.parameters import Held, declare_parameters
from galen_ros.rclpy_workarounds import destroy_all, guard_transitions, leave_graph

T = TypeVar("T")

_SUCCESS = TransitionCallbackReturn.SUCCESS


class Stage(Enum):
    """Where a node is in its life; values as in lifecycle_msgs/State."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    FINALIZED = "finalized"


@dataclass(frozen=True)
class LifecycleParameters:
    """What every managed node has beside its own."""

    autostart: bool = param(
        True,
        "whether the node configures and activates itself at its start; else it waits for"
        " `configure` and `activate`",
    )


_SAYS = {
    Stage.UNCONFIGURED: "unconfigured: nothing is read or published; call configure, then activate",
    Stage.INACTIVE: "inactive: nothing is published; call activate",
    Stage.FINALIZED: "shut down: nothing is read or published; only a new process starts again",
}
_FIXED = {
    Stage.INACTIVE: "while the node is configured: call cleanup first, and configure then",
    Stage.ACTIVE: "while the node is active: call deactivate and cleanup first, and configure then",
    Stage.FINALIZED: "after the node was shut down",
}


class ManagedNode(LifecycleNode):
    """Configures, activates and goes back; `start` is the last line of a subclass's constructor."""

    hardware_id: ClassVar[str]
    """On /diagnostics."""

    def __init__(self, name: str, **node_options: Any) -> None:
        """Make the node, unconfigured.

        Args:
            name: the node's default name.
            **node_options: rclpy.node.Node's keyword arguments, such as context and
                parameter_overrides.

        """
        super().__init__(name, **node_options)
        self._stage = Stage.UNCONFIGURED
        self._error: Exception | None = None
        self._trouble = ""
        self._undo_configure = ExitStack()
        self._undo_activate = ExitStack()
        self._undo = self._undo_configure
        self._autostarts = declare_parameters(self, LifecycleParameters).autostart
        self._starting = False
        guard_transitions(self, lambda: self._stage.value)
        self._diagnostics = DiagnosticsPublisher(self, self.hardware_id, self._full_report)

    # What a subclass does

    @abstractmethod
    def _configure(self) -> None:
        """Read parameters and files, make publishers and services."""

    @abstractmethod
    def _activate(self) -> None:
        """Subscribe, and begin to publish."""

    @abstractmethod
    def _report(self) -> Status:
        """Return the state for /diagnostics while the node is inactive or active."""

    def _remark(self) -> str:
        """Return a warning that /diagnostics shows in any state; empty for none."""
        return ""

    # What it can use

    def start(self) -> None:
        """Configure and activate, unless the parameter `autostart` is false.

        Raises:
            Exception: what `_configure` or `_activate` raised; the node is then destroyed.

        """
        if not self._autostarts:
            self.get_logger().info(_SAYS[Stage.UNCONFIGURED])
            return
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not _SUCCESS:
                assert self._error is not None
                self.destroy_node()
                raise self._error
        self._starting = False

    @property
    def configured(self) -> bool:
        """Whether what `_configure` made is there."""
        return self._stage in (Stage.INACTIVE, Stage.ACTIVE)

    @property
    def active(self) -> bool:
        """Whether the node does its work."""
        return self._stage is Stage.ACTIVE

    @property
    def starts_itself(self) -> bool:
        """Whether this is the start by itself, without a request to `configure`."""
        return self._starting

    def hold(self, cls: type[T], on_change: Callable[[T], None] | None = None) -> Held[T]:
        """Declare parameters that can be set while the node is unconfigured; take them when it is.

        Args:
            cls: dataclass with `param` fields.
            on_change: called with the new instance for fields of `read_only=False` that are set
                while the node is configured.

        Returns:
            The parameters, as they are now.

        """
        return Held(self, cls, on_change, lambda: _FIXED.get(self._stage, ""))

    def _at_undo(self, callback: Callable[[], object]) -> None:
        """In `_configure` or `_activate`: have this called on the way down, the last one first."""
        self._undo.callback(callback)

    # Transitions, called by rclpy

    def on_configure(self, _state: Any) -> TransitionCallbackReturn:
        """Make what the node needs.

        Args:
            _state: the state before, not used.

        Returns:
            SUCCESS or ERROR.

        """
        return self._transition(
            "configure", Stage.INACTIVE, lambda: self._make(self._configure, self._undo_configure)
        )

    def on_activate(self, _state: Any) -> TransitionCallbackReturn:
        """Begin to work.

        Args:
            _state: the state before, not used.

        Returns:
            SUCCESS or ERROR.

        """
        return self._transition(
            "activate", Stage.ACTIVE, lambda: self._make(self._activate, self._undo_activate)
        )

    def on_deactivate(self, _state: Any) -> TransitionCallbackReturn:
        """End the work: nothing goes out from here on.

        Args:
            _state: the state before, not used.

        Returns:
            SUCCESS or ERROR.

        """
        return self._transition("deactivate", Stage.INACTIVE, lambda: self._go_down(Stage.INACTIVE))

    def on_cleanup(self, _state: Any) -> TransitionCallbackReturn:
        """Destroy what was configured.

        Args:
            _state: the state before, not used.

        Returns:
            SUCCESS or ERROR.

        """
        return self._transition(
            "cleanup", Stage.UNCONFIGURED, lambda: self._go_down(Stage.UNCONFIGURED)
        )

    def on_shutdown(self, _state: Any) -> TransitionCallbackReturn:
        """Clean up for good.

        Args:
            _state: the state before, not used.

        Returns:
            SUCCESS or ERROR.

        """
        return self._transition("shutdown", Stage.FINALIZED, lambda: self._go_down(Stage.FINALIZED))

    def on_error(self, _state: Any) -> TransitionCallbackReturn:
        """Be unconfigured again, so that the reason can be fixed; finalized if that fails.

        Args:
            _state: the state before, not used.

        Returns:
            SUCCESS: unconfigured; ERROR: finalized.

        """
        result = _SUCCESS
        try:
            self._go_down(Stage.UNCONFIGURED)
        except Exception as error:
            self._stage = Stage.FINALIZED
            self._log_failure("cleaning up after it", error)
            result = TransitionCallbackReturn.ERROR
        self._diagnostics.publish_now()
        return result

    def _transition(
        self, name: str, goal: Stage, work: Callable[[], None]
    ) -> TransitionCallbackReturn:
        before = self._stage
        try:
            work()
        except Exception as error:
            self._error = error
            self._trouble = f"{name} failed: {_sentence(error)}"
            self._log_failure(name, error)
            return TransitionCallbackReturn.ERROR
        self._stage = goal
        self._trouble = ""
        if not self._starting:
            self._diagnostics.publish_now()
            self.get_logger().info(f"{name}: {before.value} -> {goal.value}")
        return _SUCCESS

    def _make(self, work: Callable[[], None], undo: ExitStack) -> None:
        """Do `work`; `undo` takes back what it makes, also where it fails half-way."""
        self._undo = undo
        before = {id(entity) for entity, _ in self._entities()}
        made: list[tuple[Any, Callable[[Any], object]]] = []
        # The first in, so the last out: what is called before may still answer by these services.
        undo.callback(destroy_all, made)
        try:
            work()
        finally:
            made += [pair for pair in self._entities() if id(pair[0]) not in before]

    def _go_down(self, goal: Stage) -> None:
        self._stage = goal  # at once: nothing goes out while it is undone
        try:
            self._undo_activate.close()
        finally:
            if goal is not Stage.INACTIVE:
                self._undo_configure.close()

    def _entities(self) -> list[tuple[Any, Callable[[Any], object]]]:
        """All that is attached to the node, each with what destroys it."""
        kinds = (
            (self.subscriptions, self.destroy_subscription),
            (self.timers, self.destroy_timer),
            (self.clients, self.destroy_client),
            (self.services, self.destroy_service),
            (self.publishers, self.destroy_publisher),
        )
        return [(entity, destroy) for entities, destroy in kinds for entity in entities]

    # State

    def _full_report(self) -> Status:
        life, remark = {"lifecycle": self._stage.value}, self._remark()
        if self.configured:
            status = self._report()
            text = "; ".join(filter(None, (remark, status.message)))
            level = max(status.level, WARN) if remark else status.level
            return Status(level, text, life | dict(status.values))
        text = "; ".join(filter(None, (self._trouble, remark, _SAYS[self._stage])))
        return Status(ERROR if self._trouble else WARN, text, life)

    @property
    def inactive_text(self) -> str:
        """State of the node in words while it is inactive."""
        return _SAYS[Stage.INACTIVE]

    def _log_failure(self, what: str, error: Exception) -> None:
        if self._starting:
            return  # it is raised
        name = self.get_fully_qualified_name()
        if isinstance(error, GalenError):
            self.get_logger().error(f"{name}: {what} failed: {error}")
        else:
            trace = "".join(traceback.format_exception(error))
            self.get_logger().error(f"{name}: {what} failed: {_sentence(error)}\n{trace}")

    def destroy_node(self) -> None:
        """As rclpy's, after all is undone."""
        try:
            self._go_down(Stage.FINALIZED)
        finally:
            super().destroy_node()
            leave_graph(self)


def _sentence(error: Exception) -> str:
    return str(error) if isinstance(error, GalenError) else f"{type(error).__name__}: {error}"
