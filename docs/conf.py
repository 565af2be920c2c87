"""The documentation as a site: ``sphinx-build -W -n -b html docs build/html``.

Pages are Markdown without directives, so that GitHub shows them unchanged. The build adds what only
the site needs: the README is its first page, with the menu of all pages below it;
CONTRIBUTING.md and CHANGELOG.md are the last ones.
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
# The output of commands is about 90 columns wide and has no language to highlight.
html_theme_options = {"light_css_variables": {"code-font-size": "75%"}}
highlight_language = "text"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
# Search excerpts would need a request, which browsers forbid to pages opened as files.
html_show_search_summary = False

MENU = {
    "First hour": ["first-hour-*", "crazyflie"],
    "Systems": ["lighthouse", "light", "lighthouse-signal", "dots", "polaris", "landmarks"],
    "From port to viewer": ["capture", "live", "live_page", "live_messages", "batch", "viewers"],
    "Reference": [
        "Python <python>",
        "Commands <commands>",
        "File formats <formats>",
        "The four papers <papers>",
        "Benchmarks <bench>",
        "Firmware <firmware/README>",
        "Architecture <architecture>",
        "Glossary <glossary>",
        "Contributing <contributing>",
        "Changes <changelog>",
    ],
}
"""Captions of the menu with their pages, as globs or as `Title <page>`."""


def menu() -> str:
    """Return the table of contents of the left side."""
    parts = []
    for caption, entries in MENU.items():
        body = "\n".join(entries)
        parts.append(f"```{{toctree}}\n:hidden:\n:glob:\n:caption: {caption}\n\n{body}\n```\n")
    return "\n".join(parts)


REPOSITORY = re.compile(
    r"https://(?:github\.com/locatk/locatk/blob|raw\.githubusercontent\.com/locatk/locatk)/main/"
)
"""Addresses of files of the repository. README has them, as PyPI shows it, too."""

ELSEWHERE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Files above docs, and their pages of the site."""


def linked(text: str, up: str) -> str:
    """Replace links to :data:`ELSEWHERE` by their pages; ``up`` leads from the page to docs."""
    for name, page in ELSEWHERE.items():
        text = re.sub(rf"\]\({re.escape(up)}\.\./{re.escape(name)}(?=[)#])", f"]({up}{page}", text)
    return text


def included(name: str) -> str:
    """Return the text of a file above docs, with its links rewritten for docs."""
    text = REPOSITORY.sub("", (ROOT / name).read_text(encoding="utf-8"))
    return re.sub(r"\]\((?!https?:|#|docs/)", "](../", text).replace("](docs/", "](")


def add_what_is_elsewhere(app: Sphinx, page: str, source: list[str]) -> None:
    """Insert README, CONTRIBUTING and CHANGELOG into their pages."""
    if page == "index":
        pages = source[0].split("\n", 1)[1]
        source[0] = f"{included('README.md')}\n## All pages\n{pages}\n{menu()}"
    elif page in ("contributing", "changelog"):
        source[0] = included(f"{page.upper()}.md")
    source[0] = linked(source[0], "../" * page.count("/"))


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the insertion of pages to the build."""
    app.connect("source-read", add_what_is_elsewhere)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
