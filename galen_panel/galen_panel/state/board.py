"""Holds the newest snapshot of the suite; any thread may read it and put up another. No ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from galen_panel.state.snapshot import Behaviour, Kind, State


class Board:
    """The state, and the only way to change it."""

    def __init__(self) -> None:
        self._state = State()
        self._lock = threading.Lock()

    @property
    def state(self) -> State:
        """The newest snapshot."""
        return self._state

    def put(self, **changes: Any) -> None:
        """Change fields of the state; nothing new where they are as they were."""
        self.change(lambda _: changes)

    def put_behaviour(self, behaviour: Behaviour) -> None:
        """Show a behaviour in place of the one of its kind."""

        def changes(state: State) -> dict[str, dict[Kind, Behaviour]]:
            return {"behaviours": {**state.behaviours, behaviour.kind: behaviour}}

        self.change(changes)

    def change(self, changes: Callable[[State], dict[str, Any]]) -> None:
        """Change what `changes(state)` says; in it the state stays as it is."""
        with self._lock:
            old = self._state
            new = changes(old)
            if any(getattr(old, name) != value for name, value in new.items()):
                self._state = replace(old, **new, revision=old.revision + 1)
