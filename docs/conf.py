"""The documentation as a site: ``sphinx-build -W -n -b html docs build/html``.

Pages are Markdown that reads on GitHub as it is: no directives stand in them. What only the site
needs is added while it is built: the README is its first page, with the menu of all pages below,
and CHANGELOG.md its list of changes.
"""

from __future__ import annotations

import re
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parent.parent

project = "locatk"
extensions = ["myst_parser"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "locatk"
# What commands print is 90 columns wide, and is no language.
html_theme_options = {"light_css_variables": {"code-font-size": "75%"}}
highlight_language = "text"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
# Excerpts of what is found would be fetched, which a browser forbids to pages opened as files.
html_show_search_summary = False

MENU = {
    "First hour": ["first-hour-*"],
    "Systems": ["lighthouse", "light", "lighthouse-signal", "dots", "polaris", "landmarks"],
    "From port to viewer": ["capture", "batch", "viewers"],
    "Reference": [
        "Commands <commands>",
        "File formats <formats>",
        "The four papers <papers>",
        "Benchmarks <bench>",
        "Firmware <firmware/README>",
        "Architecture <architecture>",
        "Glossary <glossary>",
        "Changes <changelog>",
    ],
}
"""Captions of the menu, and the pages below each, as globs or with a title of their own."""


def menu() -> str:
    """Table of contents for the left side."""
    parts = []
    for caption, entries in MENU.items():
        body = "\n".join(entries)
        parts.append(f"```{{toctree}}\n:hidden:\n:glob:\n:caption: {caption}\n\n{body}\n```\n")
    return "\n".join(parts)


ELSEWHERE = {"README.md": "index.md", "CHANGELOG.md": "changelog.md"}
"""Files above docs that are pages of the site."""


def linked(text: str, up: str) -> str:
    """Links to :data:`ELSEWHERE` as they are on the site; ``up`` leads from the page to docs."""
    for name, page in ELSEWHERE.items():
        text = re.sub(rf"\]\({re.escape(up)}\.\./{re.escape(name)}(?=[)#])", f"]({up}{page}", text)
    return text


def readme() -> str:
    """README.md, with links as they are from docs."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.sub(r"\]\((?!https?:|#|docs/)", "](../", text).replace("](docs/", "](")


def add_what_is_elsewhere(app: Sphinx, page: str, source: list[str]) -> None:
    """Give the first page and the list of changes their text."""
    if page == "index":
        pages = source[0].split("\n", 1)[1]
        source[0] = f"{readme()}\n## All pages\n{pages}\n{menu()}"
    elif page == "changelog":
        source[0] = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    source[0] = linked(source[0], "../" * page.count("/"))


def setup(app: Sphinx) -> dict[str, bool]:
    """Hook into the reading of pages."""
    app.connect("source-read", add_what_is_elsewhere)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
