"""HTML of a report: one page that needs neither a network nor another file.

All text is escaped here. The content security policy of the page lists its two scripts by their
hashes, so that no other script runs, and forbids loading anything but the pictures in the page.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from typing import Any

from plotly.graph_objects import Figure
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from locatk.core.printable import escape_controls
from locatk.formats.report.panels import Panel, Picture, Table
from locatk.formats.report.style import CONFIG, MAX_EAGER_FIGURES, SCRIPT, STYLE, TEMPLATE
from locatk.formats.report.theme import DARK_COLORS

NUMBER = re.compile(r"[<>=~+\-\u2212]? ?\d[\d.,\u202f]*(e[+-]?\d+)?( ?\S{1,5})?")
"""A number with an optional sign and unit; columns of numbers are aligned to the right."""

MAX_UNBROKEN_CHARACTERS = 28
"""Length of a cell of a table up to which it stays on one line."""

DEFAULT_FIGURE_HEIGHT_PX = 380
"""Height of a figure whose layout has none."""


def document(title: str, body: Sequence[str]) -> str:
    """Return the complete page around its parts, which are HTML."""
    scripts = (get_plotlyjs(), SCRIPT)
    allowed = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    shared = _json(
        {
            "template": TEMPLATE,
            "config": CONFIG,
            "dark": DARK_COLORS,
            "eager": MAX_EAGER_FIGURES,
        }
    )
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{text(title)}</title>",
            f"<style>{STYLE}</style>",
            "</head>",
            "<body>",
            *body,
            f'<script type="application/json" id="shared">{shared}</script>',
            # The hash covers every byte between the tags.
            *(f"<script>{script}</script>" for script in scripts),
            "</body>",
            "</html>",
            "",
        ]
    )


def text(plain: object) -> str:
    """Escape text for HTML."""
    return html.escape(escape_controls(str(plain), keep="\n"))


def paragraph(plain: str, style: str = "") -> str:
    """Return a paragraph, empty for an empty text."""
    if not plain:
        return ""
    return f'<p class="{style}">{text(plain)}</p>' if style else f"<p>{text(plain)}</p>"


def notes(title: str, lines: Sequence[str]) -> str:
    """Return a box with a list of notes, empty without notes."""
    if not lines:
        return ""
    items = "".join(f"<li>{text(line)}</li>" for line in lines)
    return f'<div class="notes"><b>{text(title)}</b><ul>{items}</ul></div>'


def tiles(figures: Sequence[tuple[str, str]]) -> str:
    """Return key figures, each a value and its name."""
    boxes = "".join(
        f'<div class="tile"><b>{text(value)}</b><span>{text(name)}</span></div>'
        for value, name in figures
    )
    return f'<div class="tiles">{boxes}</div>' if boxes else ""


def command(line: str, ident: str) -> str:
    """Return a command line with a button that copies it."""
    return (
        f'<div class="command"><pre id="{ident}">{text(line)}</pre>'
        f'<button class="copy" data-of="{ident}" hidden>Copy</button></div>'
    )


def panel(part: Panel, ident: str) -> str:
    """Return a panel as a section with this id."""
    inner = [f"<h3>{text(part.title)}</h3>", paragraph(part.note)]
    if part.figure is not None:
        inner.append(figure(part.figure, f"{ident}-figure"))
    if part.table is not None:
        inner.append(table(part.table))
    if part.pictures:
        inner.append(f'<div class="pictures">{"".join(map(picture, part.pictures))}</div>')
    return section(inner, ident)


def section(inner: Sequence[str], ident: str) -> str:
    """Return HTML in a box."""
    return "\n".join([f'<section class="panel" id="{ident}">', *filter(None, inner), "</section>"])


def figure(drawn: Figure, ident: str) -> str:
    """Return an empty element of the figure's height, and the data that a script draws in it."""
    spec = drawn.to_dict()
    layout = spec.setdefault("layout", {})
    layout.pop("template", None)  # All figures share the template of the page.
    # A figure is as wide as the window. A window narrower than its width scrolls it, and in a
    # narrow window a map becomes lower. Both are therefore properties of the element.
    width = layout.pop("width", None)
    height = int(layout.pop("height", None) or DEFAULT_FIGURE_HEIGHT_PX)
    min_width = f";min-width:{int(width)}px" if width else ""
    data = to_json_plotly({"data": spec.get("data", []), "layout": layout}, engine="json")
    return (
        f'<div class="wide"><div class="figure" id="{ident}" '
        f'style="height:{height}px{min_width}"></div></div>\n'
        f'<script type="application/json" id="{ident}-data">{_inert(data)}</script>'
    )


def table(content: Table, links: Sequence[str] = ()) -> str:
    """Return a table; columns of numbers are right-aligned, and short cells are never wrapped.

    ``links`` are the targets of the first cells of the rows.
    """
    columns = list(zip(*content.rows, strict=True)) if content.rows else []
    is_number = [all(cell in ("", "-") or NUMBER.fullmatch(cell) for cell in c) for c in columns]
    is_number += [False] * (len(content.header) - len(is_number))

    def row(cells: Sequence[str], tag: str, link: str = "") -> str:
        parts: list[str] = []
        for cell, number in zip(cells, is_number, strict=True):
            is_short = len(cell) <= MAX_UNBROKEN_CHARACTERS
            kind = "number" if number else "short" if is_short else ""
            inner = text(cell)
            if link and not parts:
                inner = f'<a href="{text(link)}">{inner}</a>'
            parts.append(f'<{tag} class="{kind}">' if kind else f"<{tag}>")
            parts.append(f"{inner}</{tag}>")
        return f"<tr>{''.join(parts)}</tr>"

    head = f"<thead>{row(content.header, 'th')}</thead>" if any(content.header) else ""
    targets = links or [""] * len(content.rows)
    rows = "".join(
        row(cells, "td", link) for cells, link in zip(content.rows, targets, strict=True)
    )
    return f'<div class="table"><table>{head}<tbody>{rows}</tbody></table></div>'


def picture(shown: Picture) -> str:
    """Return an image that is contained in the page."""
    data = base64.b64encode(shown.png).decode()
    caption = text(shown.caption)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _json(value: Any) -> str:
    return _inert(json.dumps(value, sort_keys=True))


def _inert(data: str) -> str:
    """Escape the characters with which JSON could end its script element."""
    return data.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
