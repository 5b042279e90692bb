"""Small things that the page's parts do to elements of NiceGUI."""

from __future__ import annotations

from nicegui import ui

from galen_panel.snapshot import NodeLevel

LOOKS = {
    NodeLevel.OK: ("check_circle", "text-positive"),
    NodeLevel.WARN: ("warning", "text-warning"),
    NodeLevel.ERROR: ("error", "text-negative"),
    NodeLevel.STALE: ("help", "text-warning"),
}
"""A level's icon, and its colour's class; to be shown with a word."""


def set_prop(element: ui.element, name: str, value: str | None) -> None:
    """Set an attribute, or take it away; nothing is sent to the browser where it is so already."""
    if element.props.get(name) == value:
        return
    if value is None:
        del element.props[name]
    else:
        element.props[name] = value


def set_test_id(element: ui.element, test_id: str) -> None:
    """Name an element for tests, whatever characters a tool's name holds."""
    element.props["data-testid"] = test_id


def pick_class(element: ui.element, prefix: str, word: str) -> None:
    """Give it the class prefix + word, and take other classes of that prefix away."""
    wanted = prefix + word
    if wanted not in element.classes:
        others = [name for name in element.classes if name.startswith(prefix)]
        element.classes(add=wanted, remove=" ".join(others))


def heading(text: str, level: int = 2) -> ui.label:
    """A title that a screen reader finds."""
    return ui.label(text).classes("panel-title").props(f'role=heading aria-level="{level}"')


def table(headers: list[str], rows: list[list[str]]) -> ui.element:
    """A plain table of texts; the first column names its row."""
    with ui.element("table").classes("panel-table") as drawn:
        if headers:
            with ui.element("thead"), ui.element("tr"):
                for text in headers:
                    with ui.element("th").props("scope=col"):
                        ui.label(text)
        with ui.element("tbody"):
            for row in rows:
                with ui.element("tr"):
                    for index, text in enumerate(row):
                        with ui.element("td" if index else "th").props(
                            "" if index else "scope=row"
                        ):
                            ui.label(text)
    return drawn
