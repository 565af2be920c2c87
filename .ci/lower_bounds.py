"""Print the lower bounds of all dependencies as a pip constraint.

To try them (with the oldest Python that is supported)::

    python .ci/lower_bounds.py > bounds.txt
    python3.11 -m venv low && low/bin/pip install ".[test]" --constraint bounds.txt
    low/bin/python -m pytest
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


def main() -> None:
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    for line in [*project["dependencies"], *project["optional-dependencies"]["test"]]:
        name, bound = re.fullmatch(r"([\w.-]+)>=([\w.]+)", line).groups()  # type: ignore[union-attr]
        print(f"{name}=={bound}")


if __name__ == "__main__":
    main()
