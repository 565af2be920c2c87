"""Access to pyarrow, which reads and writes Parquet (extra ``parquet``)."""

from __future__ import annotations

from typing import Any

from locatk.core.errors import LocatkError


def import_pyarrow() -> tuple[Any, Any]:
    """Return the modules ``pyarrow`` and ``pyarrow.parquet``.

    Raises
    ------
    LocatkError
        They are not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise LocatkError(
            "Parquet needs pyarrow, which is not installed",
            hint='Install it: pip install "locatk[parquet]"',
        ) from None
    return pyarrow, pyarrow.parquet
