"""Print the one command line that a section of the README holds.

Example
-------
::

    python .ci/readme.py "Run it"
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"


def command(heading: str) -> str:
    """The only line of the only code block under ``## heading``."""
    text = README.read_text(encoding="utf-8")
    section = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    if section is None:
        raise SystemExit(f"{README} has no section {heading!r}")
    blocks = re.findall(r"^```\w*\n(.*?)^```$", section[1], re.M | re.S)
    lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    if len(blocks) != 1 or len(lines) != 1:
        raise SystemExit(f"{README}, {heading!r}: not one code block with one line")
    return str(lines[0])


if __name__ == "__main__":
    print(command(sys.argv[1]))
