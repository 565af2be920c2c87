"""Write the tables of keys in docs/formats.md from the schemas of the artifacts, or check them.

Examples
--------
::

    python .ci/artifact_tables.py           # write
    python .ci/artifact_tables.py --check   # exit with 1 if the page is out of date
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from locatk.formats.artifacts import registry
from locatk.formats.artifacts.cameras import CAMERAS
from locatk.formats.artifacts.kinds import NO_UNIT, Boolean
from locatk.formats.artifacts.ledger import LEDGER
from locatk.formats.artifacts.prices import PRICES
from locatk.formats.artifacts.schema import HEADER, REQUIRED, Artifact, Key, Table, Tables, Variant

PAGE = Path(__file__).resolve().parent.parent / "docs" / "formats.md"

ARTIFACTS = (*(entry.artifact for entry in registry.ARTIFACTS.values()), LEDGER, PRICES, CAMERAS)

COLUMNS = "| key | value | default | meaning |\n|---|---|---|---|\n"


def rows(table: Table | Variant, path: str = "") -> Iterator[str]:
    """Yield the rows of the keys of a table, and of the tables below it."""
    for key in (table.documented if isinstance(table, Variant) else table).keys:
        below = key.kind.table if isinstance(key.kind, Tables) else key.kind
        if isinstance(below, Table | Variant) and not key.meaning:
            yield from rows(below, f"{path}{key.name}.")
        else:
            yield f"| `{path}{key.name}` | {value(key)} | {default(key)} | {key.meaning} |\n"


def value(key: Key) -> str:
    """Describe the valid values of a key."""
    text = re.sub(r"^an? ", "", key.kind.expected)
    return re.sub(r'"([^"]*)"', r"`\1`", text).replace("` or `", "`, `")


def default(key: Key) -> str:
    """Describe the default of a key, in the unit of the file."""
    if key.default is REQUIRED:
        return "required"
    if key.default_text:
        return key.default_text
    if key.default in ("", None):
        return ""
    if isinstance(key.default, tuple):
        return f"`{list(key.default)}`"
    if isinstance(key.default, str):
        return f"`{key.default}`"
    if isinstance(key.kind, Boolean):
        return str(key.default).lower()
    number = key.default if key.unit == NO_UNIT else key.unit.from_si(key.default)
    return f"{float(number):g}"


def updated_table(text: str, artifact: Artifact[Any]) -> str:
    """Return the page with the table of an artifact."""
    begin, end = f"<!-- keys of {artifact.file} -->\n", f"<!-- end of {artifact.file} -->\n"
    versions = "1" if artifact.version == 1 else f"1 to {artifact.version}"
    head = {"format": f"`{artifact.format}`", "format_version": versions}
    lines = [COLUMNS]
    for key in HEADER.keys:
        valid = head.get(key.name, value(key))
        lines.append(f"| `{key.name}` | {valid} | {default(key)} | {key.meaning} |\n")
    lines += rows(artifact.table)
    before, _, rest = text.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{PAGE} has no lines {begin.strip()} and {end.strip()}")
    return before + begin + "".join(lines) + end + after


def updated(text: str) -> str:
    """Return the page with the tables of all artifacts."""
    for artifact in ARTIFACTS:
        text = updated_table(text, artifact)
    return text


def main() -> int:
    old = PAGE.read_text(encoding="utf-8")
    text = updated(old)
    if "--check" in sys.argv[1:]:
        if text != old:
            print(f"{PAGE} is out of date; run: python .ci/artifact_tables.py", file=sys.stderr)
            return 1
        return 0
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
