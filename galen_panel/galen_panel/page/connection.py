"""What the page shows while it has no connection to the panel."""

from __future__ import annotations

from nicegui import ui

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


def build() -> None:
    """Draw what greys the page, in large letters, as long as the connection is lost."""
    ui.add_body_html(_LOST)
