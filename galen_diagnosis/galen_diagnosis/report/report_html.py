"""Pieces of a page that stands alone: everything escaped, nothing loaded, no script.

The page's Content-Security-Policy lets in nothing but pictures in the page itself and the one style
sheet whose hash it names; a name that smuggled in a tag could still not run or load anything.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

STYLE = """
:root { color-scheme: light dark; --ink: #1b1e23; --soft: #5b626d; --paper: #ffffff;
  --line: #d7dbe0; --panel: #f4f6f8; --accent: #0072b2; --none: #00795c; --some: #b54a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8eb; --soft: #a3abb6; --paper: #15181c;
  --line: #363c45; --panel: #1f242a; --accent: #56b4e9; --none: #35c9a0; --some: #f0a35e; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1080px; padding: 24px 20px 60px; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
h1 { font-size: 1.1rem; font-weight: 500; color: var(--soft); margin: 0 0 8px;
  overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 36px 0 8px; border-bottom: 1px solid var(--line);
  padding-bottom: 4px; }
p.sentence { font-size: 1.3rem; line-height: 1.4; margin: 8px 0 16px; }
.verdict { display: inline-block; padding: 2px 12px; border-radius: 12px; font-weight: 600;
  border: 2px solid var(--some); color: var(--some); }
.verdict.none { border-color: var(--none); color: var(--none); }
table { border-collapse: collapse; margin: 8px 0; font-size: 0.92rem; }
.wide { overflow-x: auto; }
th, td { text-align: left; padding: 4px 14px 4px 0; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: anywhere; }
th { color: var(--soft); font-weight: 600; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
tr.marked td { font-weight: 600; }
img { max-width: 100%; height: auto; background: #ffffff; border-radius: 6px; padding: 6px;
  border: 1px solid var(--line); }
figure { margin: 12px 0; }
figcaption, .note { color: var(--soft); font-size: 0.9rem; }
svg rect { fill: var(--accent); }
code { background: var(--panel); padding: 1px 5px; border-radius: 4px; overflow-wrap: anywhere; }
details { margin: 8px 0; } summary { cursor: pointer; color: var(--accent); }
li { margin: 2px 0; overflow-wrap: anywhere; }
"""

_BAR_WIDTH, _BAR_HEIGHT = 160, 12


def page(title: str, body: Iterable[str]) -> str:
    """A whole page; `body` is HTML, `title` text."""
    digest = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; base-uri 'none'; "
        "form-action 'none'"
    )
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="referrer" content="no-referrer">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>{STYLE}</style></head><body>",
            *body,
            "</body></html>\n",
        ]
    )


def heading(text: str) -> str:
    """A section's heading."""
    return f"<h2>{escape(text)}</h2>"


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph; kind: a class of the style sheet."""
    return f'<p class="{escape(kind)}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def items(texts: Iterable[str]) -> str:
    """A list."""
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>"


def picture(file: Path, caption: str) -> str:
    """A PNG in the page itself; the caption tells those who can't see it, too."""
    data = base64.b64encode(file.read_bytes()).decode()
    text = escape(caption)
    return (
        f'<figure><img alt="{text}" src="data:image/png;base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def bar(part: float) -> str:
    """A bar as long as a part of 1."""
    width = round(_BAR_WIDTH * min(max(part, 0.0), 1.0), 1)
    return (
        f'<svg width="{_BAR_WIDTH}" height="{_BAR_HEIGHT}" role="img" aria-label="{part:.0%}">'
        f'<rect width="{width}" height="{_BAR_HEIGHT}"></rect></svg>'
    )


class Table:
    """Rows of cells; text is escaped, what `bar` gave is not."""

    def __init__(self, *columns: str, numbers: Sequence[int] = ()) -> None:
        self._numbers = set(numbers)
        self._lines = ["".join(self._cell("th", k, escape(c)) for k, c in enumerate(columns))]
        self._classes = [""]

    def add(self, *cells: str, bars: Sequence[int] = (), marked: bool = False) -> None:
        """A row; `bars`: which cells are HTML made here."""
        self._lines.append(
            "".join(
                self._cell("td", k, cell if k in bars else escape(cell))
                for k, cell in enumerate(cells)
            )
        )
        self._classes.append(' class="marked"' if marked else "")

    def html(self) -> str:
        """The table."""
        lines = "".join(
            f"<tr{kind}>{line}</tr>" for kind, line in zip(self._classes, self._lines, strict=True)
        )
        return f'<div class="wide"><table>{lines}</table></div>'

    def __len__(self) -> int:
        return len(self._lines) - 1

    def _cell(self, tag: str, column: int, html: str) -> str:
        kind = ' class="number"' if column in self._numbers else ""
        return f"<{tag}{kind}>{html}</{tag}>"


def details(summary: str, html: str) -> str:
    """What opens on a click."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"
