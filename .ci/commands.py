"""Write docs/commands.md from the help of every command, or check it.

Examples
--------
::

    python .ci/commands.py           # write
    python .ci/commands.py --check   # exit with 1 if the page is out of date
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterator
from pathlib import Path

import click

from locatk.cli.app import app

PAGE = Path(__file__).resolve().parent.parent / "docs" / "commands.md"

HEAD = """\
# Commands

<!-- Made by `python .ci/commands.py` from the commands' own help; do not edit. -->

Results are on stdout; messages and progress on stderr. `--json` prints one object with a
`version` on stdout instead of text. No command replaces a file without `--overwrite`. An error
is one line with a hint. A misspelled command or option gets a suggestion.

| exit status | meaning |
|---|---|
| 0 | done |
| 1 | failed, or a result could not be printed (files are complete then) |
| 2 | usage error |
| 3 | finished with losses or unsolved parts, which are listed |

Terminals show colours unless `NO_COLOR` is set. Completion for bash:
`eval "$(_LOCATK_COMPLETE=bash_source locatk)"`
(also `zsh_source`, `fish_source`).
"""


def commands(
    command: click.Command, name: str, parent: click.Context | None = None
) -> Iterator[tuple[str, str]]:
    """Name and help of ``command`` and of all below it."""
    # The width is fixed: the page must not depend on the terminal.
    context = click.Context(command, info_name=name, parent=parent, terminal_width=90)
    context.help_option_names = ["-h", "--help"]
    yield context.command_path, command.get_help(context)
    if isinstance(command, click.Group):
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            assert found is not None
            yield from commands(found, child, context)


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for name, text in commands(app, "locatk"):
        parts.append(f"\n## {name}\n\n```\n{text.rstrip()}\n```\n")
    return "".join(parts)


def main() -> int:
    text = page()
    if "--check" in sys.argv[1:]:
        present = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
        if present == text:
            return 0
        print(f"{PAGE} is out of date; run: python .ci/commands.py", file=sys.stderr)
        lines = present.splitlines(), text.splitlines()
        for line in difflib.unified_diff(*lines, "page", "help", n=0, lineterm=""):
            print(line, file=sys.stderr)
        return 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
