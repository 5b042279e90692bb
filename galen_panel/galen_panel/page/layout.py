"""The page as a whole: header, tabs, and what is in them."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from galen_panel.page import behaviours, nodes, tools, under_way
from galen_panel.page.header import build_compensation, build_lamp
from galen_panel.page.live import live
from galen_panel.page.page import Page
from galen_panel.page.recordings import recordings

STYLE = Path(__file__).with_name("panel.css")
_TABS = (
    ("Operate", "construction"),
    ("Live", "show_chart"),
    ("Recordings", "folder_open"),
    ("Nodes", "hub"),
)


def build(page: Page) -> None:
    """Draw the page."""
    ui.add_css(STYLE)
    _build_lost()
    with ui.header().classes("panel-header"):
        with ui.row().classes("panel-bar"):
            build_compensation(page)
        with ui.row().classes("panel-second"):
            with ui.tabs().classes("panel-tabs") as tabs:
                tabs.props('align=left inline-label no-caps aria-label="Parts of the panel"')
                names = {
                    name: ui.tab(name, icon=icon).props(f"data-testid=tab-{name.lower()}")
                    for name, icon in _TABS
                }
            build_lamp(page)
            _look()
        under_way.build(page)
    with ui.tab_panels(tabs, value=names["Operate"]).classes("panel-panels"):
        with ui.tab_panel(names["Operate"]), ui.element("main").classes("panel-columns"):
            tools.build(page)
            behaviours.build(page)
        with ui.tab_panel(names["Live"]), ui.element("main").classes("panel-wide"):
            live.build(page, lambda: tabs.value == "Live")
        with ui.tab_panel(names["Recordings"]), ui.element("main").classes("panel-wide"):
            recordings.build(page)
        with ui.tab_panel(names["Nodes"]), ui.element("main").classes("panel-wide"):
            nodes.build(page)


def _look() -> None:
    """The button for dark or light; at first it is as the browser's own setting."""
    dark = ui.dark_mode(None)

    async def switch() -> None:
        now = dark.value
        if now is None:
            now = await ui.run_javascript("Quasar.Dark.isActive", timeout=5.0)
        dark.set_value(not now)

    button = ui.button(icon="contrast", on_click=switch, color=None)
    button.props('flat round aria-label="Dark or light" data-testid=dark')


# A modal dialog of the browser's own: nothing behind it takes a click or a key, which would be
# kept and sent later, and no other dialog or message lies above it. NiceGUI shows and hides its
# own note of a lost connection, a small one, which says when.
_LOST = """\
<dialog id="panel-lost" closedby="none" role="alertdialog" aria-labelledby="panel-lost-title"
  data-testid="lost">
  <h1 id="panel-lost-title">The connection to the panel is lost</h1>
  <p>Nothing shown here is current, and no button acts. The arm may be moving.</p>
  <p>The page comes back by itself when the panel answers. If it does not, start the panel again
  and open the link that it prints.</p>
</dialog>
<script>
addEventListener("DOMContentLoaded", () => {
  const note = document.getElementById("popup");
  const lost = document.getElementById("panel-lost");
  const follow = () => {
    if (note.ariaHidden === "true") lost.close();
    else if (!lost.open) lost.showModal();
  };
  new MutationObserver(follow).observe(note, { attributeFilter: ["aria-hidden"] });
  // Escape closes it where the browser does not know closedby.
  lost.addEventListener("close", follow);
});
</script>
"""


def _build_lost() -> None:
    """Draw what greys the page, in large letters, as long as the connection is lost."""
    ui.add_body_html(_LOST)
