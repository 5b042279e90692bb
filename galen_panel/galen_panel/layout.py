"""The page as a whole: header, tabs, and what is in them."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from galen_panel.page import Page
from galen_panel.sections import behaviours, compensation, live, nodes, recordings, tools

STYLE = Path(__file__).with_name("panel.css")


def build(page: Page) -> None:
    """Draw the page."""
    ui.add_css(STYLE)
    dark = ui.dark_mode(None)
    with ui.header().classes("panel-header"):
        compensation.build(page)
        ui.space()
        look = ui.button(icon="contrast", on_click=lambda: dark.set_value(not dark.value))
        look.props('flat round aria-label="Dark or light" data-testid=dark').classes("text-inherit")
    with ui.tabs().classes("panel-tabs").props('align=left inline-label aria-label="Parts"') as tabs:
        names = {
            name: ui.tab(name, icon=icon).props(f"data-testid=tab-{name.lower()}")
            for name, icon in (
                ("Operate", "construction"),
                ("Live", "show_chart"),
                ("Recordings", "folder_open"),
                ("Nodes", "hub"),
            )
        }
    with ui.tab_panels(tabs, value=names["Operate"]).classes("panel-panels"):
        with ui.tab_panel(names["Operate"]), ui.element("main").classes("panel-columns"):
            tools.build(page)
            behaviours.build(page)
        with ui.tab_panel(names["Live"]), ui.element("main"):
            live.build(page, lambda: tabs.value == "Live")
        with ui.tab_panel(names["Recordings"]), ui.element("main"):
            recordings.build(page)
        with ui.tab_panel(names["Nodes"]), ui.element("main"):
            nodes.build(page)
