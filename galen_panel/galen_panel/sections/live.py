"""To be written."""

from collections.abc import Callable

from nicegui import ui

from galen_panel.page import Page


def build(page: Page, shown: Callable[[], bool]) -> None:
    """Draw it."""
    ui.label("live")
