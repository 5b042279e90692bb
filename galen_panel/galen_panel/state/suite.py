"""What the page asks of the suite. `galen_panel.ros.suite` answers over ROS; tests have their own.

Every call is made in the server's event loop and answers, whatever happens: a node that is absent,
silent or rejects is an `Answer` that says so and what to do, never an exception.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from galen_panel.state.history import History
from galen_panel.state.snapshot import Answer, Comparison, Goal, Kind, State


class Suite(Protocol):
    """The suite as the page sees it."""

    @property
    def state(self) -> State:
        """The newest snapshot."""

    @property
    def history(self) -> History:
        """The streams' newest samples; it grows only while somebody watches."""

    def watch(self) -> AbstractContextManager[None]:
        """Within it the streams are listened to; the last one to leave stops that."""

    async def list_tools(self) -> Answer:
        """Ask anew for the tools; they are then in `state`."""

    async def activate(self, tool: str) -> Answer:
        """Have gravcomp load a tool's file; "" for none."""

    async def remove_tool(self, tool: str) -> Answer:
        """Take a tool's file off the list; it is kept beside."""

    async def revert_tool(self, tool: str) -> Answer:
        """Bring back the calibration before the present one."""

    async def compare(self, tool: str, with_tool: str = "") -> Comparison | Answer:
        """A tool's file (b) against another's (a); "": against its own calibration before."""

    async def set_enabled(self, enabled: bool) -> Answer:
        """Switch the compensation."""

    async def tare(self) -> Answer:
        """Take off what is left."""

    async def start(self, goal: Goal) -> Answer:
        """Send a goal; answers when it is accepted or rejected."""

    async def confirm(self) -> Answer:
        """Tell a calibration that the person has done what it asked."""

    async def cancel(self, kind: Kind) -> Answer:
        """Cancel a behaviour's goal, whoever sent it; answers when that is accepted."""
