"""Where published data is found: tests and benchmarks look in the same places."""

from __future__ import annotations

import os
from pathlib import Path

from locatk.core.errors import MissingDataError

VARIABLE = "LOCATK_DATA"


def data_folder(explicit: Path | None = None) -> Path | None:
    """Folder with published recordings, or None where there is none.

    The first that applies: ``explicit``; the environment variable ``LOCATK_DATA`` (None
    where it names no folder: it is not passed over); ``../shared/data`` beside the
    working folder, then beside the source tree.

    Raises
    ------
    MissingDataError
        ``explicit`` is no folder.
    """
    if explicit is not None:
        if not Path(explicit).is_dir():
            raise MissingDataError(f"no data folder {str(explicit)!r}")
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
