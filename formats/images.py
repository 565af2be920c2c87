"""Decoding of image files, and their conversion to grey values for the solver.

Grey values have 8 bits, 0 is black. Other images are converted:

- Colour becomes luminance (ITU-R BT.601); transparent pixels are shown on white paper.
- 16-bit values are shifted right by as many bits as the brightest pixel of the frame needs
  to fit into 8: 10, 12 and 16 bits a pixel all keep their contrast, and 8-bit values in a
  16-bit file stay as they are.

Pixels stay at their positions on the sensor: the EXIF orientation of a file is ignored.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

EXTENSIONS = frozenset(
    {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".dib", ".pgm", ".pbm", ".ppm", ".pnm"}
    | {".tif", ".tiff"}
)
"""Extensions of image files, in lower case."""

VIEWER_FORMATS = {"PNG": "png", "JPEG": "jpeg", "WEBP": "webp"}
"""Formats that every viewer of sessions can show, and their names in Foxglove."""

PILLOW_FORMATS = (*VIEWER_FORMATS, "BMP", "DIB", "PPM", "TIFF")
FORMAT_NAMES = "PNG, JPEG, WebP, BMP, PGM or TIFF"

RAW_PIXEL_BYTES = {
    "mono8": 1,
    "8UC1": 1,
    "mono16": 2,
    "16UC1": 2,
    "rgb8": 3,
    "bgr8": 3,
    "8UC3": 3,
    "rgba8": 4,
    "bgra8": 4,
}
"""Supported encodings of ``foxglove.RawImage``, and their bytes a pixel."""


@dataclass(frozen=True)
class Picture:
    """Decoded image file.

    Attributes
    ----------
    pixels : ndarray
        Unconverted values: (h, w) uint8 or uint16, (h, w, 3) or (h, w, 4) uint8 in the
        order red, green, blue, alpha. Only 16-bit colour is converted to luminance.
    format : str
        ``"png"``, ``"jpeg"`` or ``"webp"``; ``""`` for formats that viewers do not show.
    """

    pixels: NDArray[Any]
    format: str


def is_compressed(head: bytes) -> bool:
    """Return whether a file that begins with these 12 bytes is PNG, JPEG or WebP."""
    return head.startswith((b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")) or (
        head[:4] == b"RIFF" and head[8:12] == b"WEBP"
    )


def decode(data: bytes) -> Picture:
    """Decode an image file.

    Raises
    ------
    InputError
        The file is not an image of a known format, is damaged or cut short, contains several
        pictures, or has values that are not grey of 8 or 16 bits.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(io.BytesIO(data), formats=PILLOW_FORMATS)
            count = getattr(image, "n_frames", 1)
    except (UnidentifiedImageError, SyntaxError):
        raise InputError(f"not an image in the format {FORMAT_NAMES}") from None
    except Image.DecompressionBombError:
        raise InputError("the image claims to be too large") from None
    except Exception:  # Pillow raises any builtin exception on damaged headers
        raise InputError("the image is damaged") from None
    if count > 1 and image.format != "MPO":  # a JPEG followed by previews
        raise InputError(f"{count} pictures in one file")
    deep = image.mode in ("RGB", "RGBA") and "16" in str(image.tile)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image.load()
    except Exception:
        raise InputError("the image is damaged or cut short") from None
    pixels = _deep_colour(data) if deep else _pixels(image)
    kind = "JPEG" if image.format == "MPO" else image.format
    return Picture(pixels, VIEWER_FORMATS.get(kind or "", ""))


def _pixels(image: Any) -> NDArray[Any]:
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 0xFFFF:
            raise InputError("32-bit pixels")
        return values.astype(np.uint16)
    if image.mode == "F":
        raise InputError("floating-point pixels")
    if image.mode == "L" and "transparency" not in image.info:
        return np.asarray(image)
    if image.mode == "1":
        return np.asarray(image.convert("L"))
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _deep_colour(data: bytes) -> NDArray[np.uint16]:
    """Return the luminance of 16-bit colour, of which Pillow would keep only the upper 8 bits."""
    import cv2

    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.ndim != 3 or values.dtype != np.uint16:
        raise InputError("16-bit colour that is not readable")
    luminance = cv2.cvtColor(np.ascontiguousarray(values[..., :3]), cv2.COLOR_BGR2GRAY)
    if values.shape[2] == 4:
        alpha = values[..., 3] / 0xFFFF
        luminance = np.rint(luminance * alpha + 0xFFFF * (1 - alpha)).astype(np.uint16)
    result: NDArray[np.uint16] = luminance
    return result


def grey(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return (h, w) uint8 grey values of the pixels of a :class:`Picture`; see the module."""
    from PIL import Image

    if pixels.dtype == np.uint16:
        shift = max(0, int(pixels.max(initial=0)).bit_length() - 8)
        return (pixels >> shift).astype(np.uint8)
    if pixels.ndim == 2:
        return pixels
    image = Image.fromarray(pixels)
    if pixels.shape[2] == 4:
        paper = Image.new("RGBA", image.size, "white")
        image = Image.alpha_composite(paper, image)
    return np.asarray(image.convert("L"))


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Return a lossless PNG file of the pixels of a :class:`Picture`."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def raw_encoding(pixels: NDArray[Any]) -> str:
    """Return the encoding of the pixels of a :class:`Picture` in ``foxglove.RawImage``."""
    if pixels.ndim == 2:
        return "mono16" if pixels.dtype == np.uint16 else "mono8"
    return "rgba8" if pixels.shape[2] == 4 else "rgb8"


def raw_grey(data: bytes, width: int, height: int, step: int, encoding: str) -> NDArray[np.uint8]:
    """Return (h, w) uint8 grey values of a ``foxglove.RawImage``.

    Raises
    ------
    InputError
        The encoding is unknown, or the data do not fill the frame.
    """
    if encoding not in RAW_PIXEL_BYTES:
        raise InputError(f"encoding {encoding!r} is not one of {', '.join(RAW_PIXEL_BYTES)}")
    size = RAW_PIXEL_BYTES[encoding]
    if min(width, height) < 1 or step < width * size or len(data) != step * height:
        raise InputError(
            f"{len(data)} bytes for {width} x {height} px of {encoding} in rows of {step} bytes"
        )
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * size]
    if size == 1:
        return rows
    if size == 2:
        return grey(np.ascontiguousarray(rows).view("<u2"))
    pixels = rows.reshape(height, width, size)
    if not encoding.startswith("rgb"):
        pixels = pixels[..., [2, 1, 0, 3][:size]]
    return grey(np.ascontiguousarray(pixels))
