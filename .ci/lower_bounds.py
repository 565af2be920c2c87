"""Print the lower bounds of all dependencies as a pip constraint.

To try them (with the oldest Python that is supported)::

    python .ci/lower_bounds.py > bounds.txt
    python3.11 -m venv low && low/bin/pip install ".[test]" --constraint bounds.txt
    low/bin/python -m pytest
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


def lines(project: dict[str, Any]) -> Iterator[str]:
    """All requirements, those of extras that other extras name included."""
    extras = project["optional-dependencies"]
    wanted, seen = [*project["dependencies"], *extras["test"]], set()
    for line in wanted:
        own = re.fullmatch(r"locatk\[([\w,]+)\]", line)
        if own is None:
            yield line
            continue
        for name in set(own[1].split(",")) - seen:
            seen.add(name)
            wanted += extras[name]


def main() -> None:
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    for line in lines(project):
        found = re.fullmatch(r"([\w.-]+)(?:\[\w+\])?>=([\w.]+)", line)
        assert found is not None, line
        print(f"{found[1]}=={found[2]}")


if __name__ == "__main__":
    main()
