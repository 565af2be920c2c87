"""Scans and photos of printed sheets: grey values, and how many pixels an inch."""

from __future__ import annotations

import io
import os
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.formats import images
from locatk.formats.files import read_bytes


@dataclass(frozen=True)
class Scan:
    """A picture of a sheet.

    Attributes
    ----------
    image : (height, width) uint8 ndarray
        Grey values.
    dpi : (x, y) or None
        What the file says; scanners write it, cameras write anything.
    """

    image: NDArray[np.uint8]
    dpi: tuple[float, float] | None


def read_scan(path: str | os.PathLike[str]) -> Scan:
    """Read a PNG, JPEG, TIFF or other picture.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It is no picture, or a damaged one; see :func:`locatk.formats.images.decode`.
    """
    data = read_bytes(path)
    try:
        image = images.grey(images.decode(data).pixels)
    except InputError as error:
        hint = error.hint or "Save the scan as PNG"
        raise InputError(error.message, file=path, hint=hint) from None
    return Scan(np.ascontiguousarray(image), _dpi(data))


def _dpi(data: bytes) -> tuple[float, float] | None:
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = Image.open(io.BytesIO(data)).info.get("dpi", ())
    try:
        x, y = (float(value) for value in found)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return (x, y) if min(x, y) > 1 and max(x, y) < 1e5 else None
