"""Optional packages, and the extras of locatk that install them (``pip install "locatk[dxf]"``).

A module that needs one imports it where it is used, inside :func:`requires_extra`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from locatk.core.errors import LocatkError

PACKAGES = {
    "ble": "bleak",
    "dask": "distributed",
    "dxf": "ezdxf",
    "live": "websockets",
    "mqtt": "paho-mqtt",
    "pandas": "pandas",
    "parquet": "pyarrow",
    "pdf": "pikepdf",
    "ros": "rosbags",
    "s3": "s3fs",
    "yaml": "PyYAML",
    "zenoh": "eclipse-zenoh",
}
"""Package that each extra for users installs; the extra ``all`` installs all of them."""


@contextmanager
def requires_extra(
    extra: str, purpose: str, *, file: str | os.PathLike[str] | None = None
) -> Iterator[None]:
    """Convert the ImportError of an optional package to an error of one line.

    Parameters
    ----------
    extra : str
        Key of :data:`PACKAGES`.
    purpose : str
        What needs the package, at the beginning of the message: "DXF".
    file : path, optional
        File or address that was to be processed.

    Raises
    ------
    LocatkError
        The package, or one that it needs, cannot be imported.
    """
    try:
        yield
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "locatk":
            raise
        problem = "is not installed"
        if not isinstance(error, ModuleNotFoundError):
            problem = f"cannot be imported ({error})"
        raise LocatkError(
            f"{purpose} needs {PACKAGES[extra]}, which {problem}",
            file=file,
            hint=f'Install it: pip install "locatk[{extra}]"',
        ) from None
