"""Questions to the person, in the middle of the page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from nicegui import ui

from galen_panel.page.elements import heading
from galen_panel.page.page import Page


@contextmanager
def dialog(page: Page, title: str) -> Iterator[ui.dialog]:
    """A dialog with a title, gone from the page when it is left; await what it yields.

    Escape closes it, which is None for who awaits it.
    """
    with page.client, ui.dialog() as shown, ui.card().classes("panel-dialog"):
        shown.props["aria-label"] = title
        heading(title)
        try:
            yield shown
        finally:
            if not shown.is_deleted:
                shown.delete()


def buttons(shown: ui.dialog, text: str, icon: str, color: str = "primary") -> ui.button:
    """The last line of a dialog: cancel, and what it is about, which has no handler yet."""
    with ui.row().classes("panel-actions"):
        ui.button("Cancel", on_click=shown.close).props("flat data-testid=dialog-cancel")
        return ui.button(text, icon=icon, color=color).props("unelevated data-testid=dialog-ok")


async def confirmed(
    page: Page, title: str, sentences: list[str], text: str, icon: str, color: str = "negative"
) -> bool:
    """Ask whether to do it; `text` is the button that says yes."""
    with dialog(page, title) as shown:
        for sentence in sentences:
            ui.label(sentence)
        buttons(shown, text, icon, color).on_click(lambda: shown.submit(True))
        return bool(await shown)
