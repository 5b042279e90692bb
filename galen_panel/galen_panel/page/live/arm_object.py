"""The arm as one object of a `ui.scene`: made once, then only moved."""

from __future__ import annotations

from nicegui.awaitable_response import AwaitableResponse
from nicegui.elements.scene import Object3D

from galen_panel.state.arm_view_drawing import Part, Placement


class ArmObject(Object3D, component="arm_object.js"):
    """Parts and placements as in `galen_panel.state.arm_view_drawing`."""

    def __init__(self, parts: list[Part]) -> None:
        super().__init__(parts)

    def place(self, placement: Placement, timeout_s: float) -> AwaitableResponse:
        """Move the parts; awaited, it is True once that is done, None without a picture."""
        return self.run_method("place", placement, timeout=timeout_s)
