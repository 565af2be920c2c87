"""The page: panels as HTML that needs nothing else, neither a network nor another file.

Text is escaped here and nowhere else. The security policy of the page names its two scripts by
their hashes, so that no other script runs, wherever it may come from, and forbids all loading
but that of pictures inside the page.
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

from locatk.formats.report.panel import Panel, Picture, Table
from locatk.formats.report.style import CONFIG, SCRIPT, STYLE, TEMPLATE

_NUMBER = re.compile(r"[<>=~+\-\u2212]? ?\d[\d.,\u202f]*(e[+-]?\d+)?( ?\S{1,5})?")


SHORT = 28
"""Characters up to which a cell of a table stays on one line."""


def document(title: str, body: Sequence[str]) -> str:
    """The whole page around its parts, which are HTML."""
    scripts = (get_plotlyjs(), SCRIPT)
    allowed = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    shared = _json({"template": TEMPLATE, "config": CONFIG})
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
            # Nothing between the tags but the script: the hash is of every byte.
            *(f"<script>{script}</script>" for script in scripts),
            "</body>",
            "</html>",
            "",
        ]
    )


def text(plain: object) -> str:
    """Text as it shall appear, for HTML."""
    return html.escape(str(plain))


def paragraph(plain: str, style: str = "") -> str:
    """A paragraph of text, or nothing where there is none."""
    if not plain:
        return ""
    return f'<p class="{style}">{text(plain)}</p>' if style else f"<p>{text(plain)}</p>"


def notes(title: str, lines: Sequence[str]) -> str:
    """A box of things to know, or nothing where there are none."""
    if not lines:
        return ""
    items = "".join(f"<li>{text(line)}</li>" for line in lines)
    return f'<div class="notes"><b>{text(title)}</b><ul>{items}</ul></div>'


def tiles(figures: Sequence[tuple[str, str]]) -> str:
    """Key figures: a value and what it is, each."""
    made = "".join(
        f'<div class="tile"><b>{text(value)}</b><span>{text(what)}</span></div>'
        for value, what in figures
    )
    return f'<div class="tiles">{made}</div>' if made else ""


def command(line: str, ident: str) -> str:
    """A command line with a button that copies it."""
    return (
        f'<div class="command"><pre id="{ident}">{text(line)}</pre>'
        f'<button class="copy" data-of="{ident}" hidden>Copy</button></div>'
    )


def panel(part: Panel, ident: str) -> str:
    """A panel as a section with this id."""
    inner = [f"<h3>{text(part.title)}</h3>", paragraph(part.note)]
    if part.figure is not None:
        inner.append(figure(part.figure, f"{ident}-figure"))
    if part.table is not None:
        inner.append(table(part.table))
    if part.pictures:
        inner.append(f'<div class="pictures">{"".join(map(picture, part.pictures))}</div>')
    return section(inner, ident)


def section(inner: Sequence[str], ident: str) -> str:
    """A box around HTML."""
    return "\n".join([f'<section class="panel" id="{ident}">', *filter(None, inner), "</section>"])


def figure(drawn: Figure, ident: str) -> str:
    """The place of a figure, as high as it will be, and its data beside it."""
    spec = drawn.to_dict()
    layout = spec.setdefault("layout", {})
    layout.pop("template", None)  # the page has one for all
    # Of its place, not of the figure: it is as wide as its window, which scrolls it where that
    # is narrower, and a map is lower in a narrow one.
    least = layout.pop("width", None)
    height = int(layout.pop("height", None) or 380)
    wide = f";min-width:{int(least)}px" if least else ""
    data = to_json_plotly({"data": spec.get("data", []), "layout": layout}, engine="json")
    return (
        f'<div class="wide"><div class="figure" id="{ident}" style="height:{height}px{wide}">'
        "</div></div>\n"
        f'<script type="application/json" id="{ident}-data">{_inert(data)}</script>'
    )


def table(of: Table) -> str:
    """A table; columns that hold nothing but numbers are set to the right, and short cells are
    never broken into lines."""
    columns = list(zip(*of.rows, strict=True)) if of.rows else []
    right = [all(cell in ("", "-") or _NUMBER.fullmatch(cell) for cell in c) for c in columns]
    right += [False] * (len(of.header) - len(right))

    def cell(words: str, number: bool, tag: str) -> str:
        kind = "number" if number else "short" if len(words) <= SHORT else ""
        start = f'<{tag} class="{kind}">' if kind else f"<{tag}>"
        return f"{start}{text(words)}</{tag}>"

    def row(cells: Sequence[str], tag: str) -> str:
        made = (cell(words, number, tag) for words, number in zip(cells, right, strict=True))
        return f"<tr>{''.join(made)}</tr>"

    head = f"<thead>{row(of.header, 'th')}</thead>" if any(of.header) else ""
    rows = "".join(row(cells, "td") for cells in of.rows)
    return f'<div class="table"><table>{head}<tbody>{rows}</tbody></table></div>'


def picture(shown: Picture) -> str:
    """An image inside the page."""
    data = base64.b64encode(shown.png).decode()
    caption = text(shown.caption)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _json(value: Any) -> str:
    return _inert(json.dumps(value, sort_keys=True))


def _inert(data: str) -> str:
    """JSON in which no character can end the script element that holds it."""
    return data.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
