"""Scans and photos of printed sheets: grey values and resolution."""

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
    """Picture of a sheet.

    Attributes
    ----------
    image : (height, width) uint8 ndarray
        Grey values.
    dpi : (x, y) or None
        Resolution in the file; that of a camera is meaningless.
    """

    image: NDArray[np.uint8]
    dpi: tuple[float, float] | None


def read_scan(path: str | os.PathLike[str]) -> Scan:
    """Read a PNG, JPEG, TIFF or other picture.

    Raises
    ------
    MissingDataError
        The file does not exist.
    InputError
        The file is not a picture, or is damaged; see :func:`locatk.formats.images.decode`.
    """
    data = read_bytes(path)
    try:
        image = images.grey(images.decode(data).pixels)
    except InputError as error:
        hint = error.hint or "Save the scan as PNG"
        raise InputError(error.message, file=path, hint=hint) from None
    return Scan(np.ascontiguousarray(image), _dpi(data))


def _dpi(data: bytes) -> tuple[float, float] | None:
    from PIL import Image  # slow to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        resolution = Image.open(io.BytesIO(data)).info.get("dpi", ())
    try:
        x, y = (float(value) for value in resolution)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return (x, y) if min(x, y) > 1 and max(x, y) < 1e5 else None
