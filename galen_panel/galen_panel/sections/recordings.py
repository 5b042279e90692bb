"""To be written."""

from nicegui import ui

from galen_panel.page import Page


def build(page: Page) -> None:
    """Draw it."""
    ui.label("recordings")
