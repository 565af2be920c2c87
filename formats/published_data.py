"""Folder of published recordings, for tests and benchmarks."""

from __future__ import annotations

import os
from pathlib import Path

from locatk.core.errors import MissingDataError

VARIABLE = "LOCATK_DATA"
"""Environment variable that names the folder."""


def data_folder(explicit: Path | None = None) -> Path | None:
    """Return the folder with published recordings, or None if there is none.

    It is ``explicit`` if given. Otherwise it is the folder that the environment variable
    ``LOCATK_DATA`` names; if that is set and not a folder, the result is None. Without the
    variable it is ``../shared/data`` next to the working folder, then next to the source tree.

    Raises
    ------
    MissingDataError
        ``explicit`` is not a folder.
    """
    if explicit is not None:
        if not Path(explicit).is_dir():
            raise MissingDataError(
                "no such data folder", file=explicit, hint="Name the folder with --data"
            )
        return Path(explicit)
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named) if Path(named).is_dir() else None
    tree = Path(__file__).resolve().parents[1]
    for start in (Path.cwd(), tree):
        folder = start.parent / "shared" / "data"
        if folder.is_dir():
            return folder
    return None
