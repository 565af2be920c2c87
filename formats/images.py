"""Image files and grey values: what a camera has saved becomes what a solver takes.

Grey values are 8 bits, 0 black. What is not so already is converted, always alike:

- Colour becomes luminance (ITU-R BT.601); what is transparent lies over white paper.
- 16-bit values are shifted right by as many bits as the brightest pixel of the frame needs
  to fit into 8: 10, 12 and 16 bits a pixel all keep their contrast, and 8-bit values in a
  16-bit file stay as they are.

Pixels stay where the sensor had them: a note in the file that says how to hold the picture
(EXIF orientation) is not obeyed.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

EXTENSIONS = frozenset(
    {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".dib", ".pgm", ".pbm", ".ppm", ".pnm"}
    | {".tif", ".tiff"}
)
"""File names that promise an image, in lower case."""

COMPRESSED = {"PNG": "png", "JPEG": "jpeg", "WEBP": "webp"}
"""Kinds whose bytes every viewer of sessions can show, and what Foxglove calls them."""

_KINDS = (*COMPRESSED, "BMP", "DIB", "PPM", "TIFF")
_KNOWN = "PNG, JPEG, WebP, BMP, PGM or TIFF"

_RAW = {"mono8": 1, "8UC1": 1, "mono16": 2, "16UC1": 2, "rgb8": 3, "bgr8": 3, "8UC3": 3} | {
    "rgba8": 4,
    "bgra8": 4,
}
"""Encodings of ``foxglove.RawImage`` that are read, and their bytes a pixel."""


@dataclass(frozen=True)
class Picture:
    """An image file, read.

    Attributes
    ----------
    pixels : ndarray
        Its values as they are: (h, w) uint8 or uint16, (h, w, 3) or (h, w, 4) uint8 in the
        order red, green, blue, alpha. Only 16-bit colour has become luminance already.
    format : str
        ``"png"``, ``"jpeg"`` or ``"webp"``; ``""`` for kinds that viewers do not show.
    """

    pixels: NDArray[Any]
    format: str


def is_compressed(head: bytes) -> bool:
    """Whether a file that begins with these 12 bytes is PNG, JPEG or WebP."""
    return head.startswith((b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")) or (
        head[:4] == b"RIFF" and head[8:12] == b"WEBP"
    )


def decode(data: bytes) -> Picture:
    """Pixels of an image file.

    Raises
    ------
    InputError
        It is no image of a known kind, damaged, cut short, holds several pictures, or
        values that are no grey of 8 or 16 bits.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(io.BytesIO(data), formats=_KINDS)
    except (UnidentifiedImageError, SyntaxError):
        raise InputError(f"not an image, or none that is {_KNOWN}") from None
    except Image.DecompressionBombError:
        raise InputError("the image claims to be too large") from None
    except Exception:  # what damaged headers raise in Pillow is any builtin
        raise InputError("the image is damaged") from None
    count = getattr(image, "n_frames", 1)
    if count > 1 and image.format != "MPO":  # which is a JPEG with previews behind it
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
    return Picture(pixels, COMPRESSED.get(kind or "", ""))


def _pixels(image: Image) -> NDArray[Any]:
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 0xFFFF:
            raise InputError("pixels of 32 bits")
        return values.astype(np.uint16)
    if image.mode == "F":
        raise InputError("pixels with fractions")
    if image.mode == "L" and "transparency" not in image.info:
        return np.asarray(image)
    if image.mode == "1":
        return np.asarray(image.convert("L"))
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _deep_colour(data: bytes) -> NDArray[np.uint16]:
    """Luminance of 16-bit colour, of which Pillow would keep the upper 8 bits only."""
    import cv2

    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.ndim != 3 or values.dtype != np.uint16:
        raise InputError("colour of 16 bits that cannot be read")
    luminance = cv2.cvtColor(np.ascontiguousarray(values[..., :3]), cv2.COLOR_BGR2GRAY)
    if values.shape[2] == 4:
        alpha = values[..., 3] / 0xFFFF
        luminance = np.rint(luminance * alpha + 0xFFFF * (1 - alpha)).astype(np.uint16)
    result: NDArray[np.uint16] = luminance
    return result


def grey(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """(h, w) uint8 grey values of a :class:`Picture`'s pixels; see the module."""
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
    """PNG file of a :class:`Picture`'s pixels, without loss."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def raw_encoding(pixels: NDArray[Any]) -> str:
    """What ``foxglove.RawImage`` calls a :class:`Picture`'s pixels."""
    if pixels.ndim == 2:
        return "mono16" if pixels.dtype == np.uint16 else "mono8"
    return "rgba8" if pixels.shape[2] == 4 else "rgb8"


def raw_grey(data: bytes, width: int, height: int, step: int, encoding: str) -> NDArray[np.uint8]:
    """(h, w) uint8 grey values of a ``foxglove.RawImage``.

    Raises
    ------
    InputError
        The encoding is not known, or the data does not fill the frame.
    """
    if encoding not in _RAW:
        raise InputError(f"encoding {encoding!r} is none of {', '.join(_RAW)}")
    size = _RAW[encoding]
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
