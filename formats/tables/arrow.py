"""Access to pyarrow, which reads and writes Parquet (extra ``parquet``)."""

from __future__ import annotations

from typing import Any

from locatk.formats.extras import requires_extra


def import_pyarrow() -> tuple[Any, Any]:
    """Return the modules ``pyarrow`` and ``pyarrow.parquet``.

    Raises
    ------
    LocatkError
        They are not installed.
    """
    with requires_extra("parquet", "Parquet"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow, pyarrow.parquet
