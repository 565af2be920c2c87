"""Images and shadings of a PDF without black ink.

If possible, samples remain unchanged and only their colour space is replaced: red, green and blue
are the complements of cyan, magenta and yellow, and a palette of 256 colours needs no black.
Photos then lose no quality and files do not grow. Only if black is a channel (CMYK), or if a grey
photo is a JPEG, new samples are computed.
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pikepdf
from numpy.typing import NDArray
from pikepdf import Array, Dictionary, Name, Pdf, PdfInlineImage, Stream, StreamDecodeLevel

from locatk.formats.printing.separation import colours
from locatk.formats.printing.separation.colours import ColourSpace, Floats

JPEG_QUALITY_PERCENT = 95
SHADING_STEPS = 1024
"""Colours of a shading; a printer reproduces 256."""

BLOCK_PIXELS = 1 << 20
"""Pixels whose colours are computed at once."""

Bytes = NDArray[np.uint8]


class NotConvertible(Exception):
    """Kind of objects, in the plural, that cannot be converted to inks without black."""


def inks_space(pdf: Pdf) -> pikepdf.Object:
    """Create the colour space of cyan, magenta and yellow, without black."""
    to_cmyk = Stream(pdf, b"{0}")
    to_cmyk.FunctionType = 4
    to_cmyk.Domain = Array([0, 1] * 3)
    to_cmyk.Range = Array([0, 1] * 4)
    inks = Array([Name.Cyan, Name.Magenta, Name.Yellow])
    converted = Array([Name.DeviceN, inks, Name.DeviceCMYK, pdf.make_indirect(to_cmyk)])
    return pdf.make_indirect(converted)


def convert_image(
    pdf: Pdf, image: Stream, named: pikepdf.Object | None, inks: pikepdf.Object
) -> Stream:
    """Return an image without black as a new stream, or ``image`` itself if it has no colours.

    Parameters
    ----------
    pdf : Pdf
        The document.
    image : Stream
    named : Dictionary or None
        Colour spaces of the resources.
    inks : Object
        From :func:`inks_space`.

    Raises
    ------
    NotConvertible
        The object has to remain as it is.
    """
    if bool(image.get("/ImageMask", False)):
        return image  # a stencil, painted in the current colour
    filters = _filters(image)
    if "/JPXDecode" in filters:
        return _jpeg_2000(pdf, image, named, inks)
    space = colours.read_convertible_space(image.get("/ColorSpace"), named)
    if space is None:
        raise NotConvertible("images in a spot or Lab colour space")
    bits = int(image.get("/BitsPerComponent", 8))
    decode = _decode(image, space, bits)
    is_jpeg = filters[-1:] == ["/DCTDecode"]
    if space.kind == "rgb":
        converted = copy.copy(image)
        converted.ColorSpace = inks
        converted.Decode = Array([_number(1 - end) for end in decode.ravel()])
        _convert_matte(pdf, converted, space)
    elif space.components == 1 and bits <= 8 and not (is_jpeg and space.kind != "indexed"):
        _no_matte(image)
        converted = copy.copy(image)
        converted.ColorSpace = _palette(space, decode[0], bits)
        if "/Decode" in converted:
            del converted.Decode
    else:
        if isinstance(image.get("/Mask"), Array):
            raise NotConvertible("images with a transparent colour")
        _no_matte(image)
        converted = _with_samples(pdf, image, _remaining_light(image, space), is_jpeg, inks)
    if "/Alternates" in converted:
        del converted.Alternates
    return converted


def inline_stream(pdf: Pdf, image: PdfInlineImage) -> Stream:
    """Return an inline image as a stream, as images of resources are."""
    stream = pdf.make_stream(b"")
    for key, value in image.obj.items():
        stream[key] = value
    _, _, data = image.unparse().partition(b"\nID\n")
    filters: Any = image.obj.get("/Filter")
    parameters: Any = image.obj.get("/DecodeParms")
    data = data.removesuffix(b"EI")
    stream.write(data, filter=filters, decode_parms=parameters, type_check=False)
    stream.Subtype = Name.Image
    return stream


def _filters(image: Stream) -> list[str]:
    names = image.get("/Filter")
    if names is None:
        return []
    return [str(name) for name in names] if isinstance(names, Array) else [str(names)]


def _decode(image: Stream, space: ColourSpace, bits: int) -> Floats:
    """Return the values (components, 2) of the smallest and of the largest sample."""
    if "/Decode" in image:
        given = colours.numbers(image.Decode)
        if given.size >= 2 * space.components:
            return given[: 2 * space.components].reshape(-1, 2)
    top = float((1 << bits) - 1) if space.kind == "indexed" else 1.0
    return np.array(space.ranges or [(0.0, top)] * space.components)


def _palette(space: ColourSpace, decode: Floats, bits: int) -> Array:
    top = (1 << bits) - 1
    values = decode[0] + np.arange(top + 1) * (decode[1] - decode[0]) / top
    table = np.zeros((top + 1, 4), np.uint8)
    table[:, :3] = np.round(255 * space.cmy(values[:, None]))
    return Array([Name.Indexed, Name.DeviceCMYK, top, pikepdf.String(table.tobytes())])


def read_values(image: Stream, space: ColourSpace) -> Iterator[Floats]:
    """Return the colours of an image, row by row, in blocks of (pixels, components).

    Raises
    ------
    NotConvertible
        There are too few samples, or samples of another size.
    """
    width, height = int(image.Width), int(image.Height)
    bits = int(image.get("/BitsPerComponent", 8))
    if bits not in (1, 2, 4, 8, 16):
        raise NotConvertible("images that are damaged")
    decode = _decode(image, space, bits)
    low, step = decode[:, 0], (decode[:, 1] - decode[:, 0]) / ((1 << min(bits, 8)) - 1)
    data = np.frombuffer(image.read_bytes(decode_level=StreamDecodeLevel.all), np.uint8)
    row_samples = width * space.components
    row_bytes = (row_samples * bits + 7) // 8
    if width < 1 or height < 1 or data.size < height * row_bytes:
        raise NotConvertible("images that are cut short")
    rows = data[: height * row_bytes].reshape(height, row_bytes)
    block_rows = max(1, BLOCK_PIXELS // width)
    for start in range(0, height, block_rows):
        samples = rows[start : start + block_rows, :: max(1, bits // 8)]
        if bits < 8:
            flags = np.unpackbits(samples, axis=1)[:, : row_samples * bits].reshape(-1, bits)
            samples = np.packbits(flags, axis=1) >> np.uint8(8 - bits)
        yield low + samples.reshape(-1, space.components) * step


def _remaining_light(image: Stream, space: ColourSpace) -> Bytes:
    """Return the light (height, width, 3) that the inks do not absorb, 255 without ink."""
    lights = [
        np.round(255 * (1 - space.cmy(values))).astype(np.uint8)
        for values in read_values(image, space)
    ]
    return np.concatenate(lights).reshape(int(image.Height), int(image.Width), 3)


def _with_samples(
    pdf: Pdf, image: Stream, lights: Bytes, is_jpeg: bool, inks: pikepdf.Object
) -> Stream:
    """Return a copy of ``image`` with other samples."""
    converted = pdf.make_stream(b"")
    for key in image.keys():  # noqa: SIM118 - a Stream is no mapping
        if key not in ("/Length", "/Filter", "/DecodeParms", "/SMaskInData"):
            converted[key] = image[key]
    converted.ColorSpace = inks
    converted.BitsPerComponent = 8
    converted.Decode = Array([1, 0] * 3)
    converted.Height, converted.Width = lights.shape[:2]
    if is_jpeg:
        import cv2  # slow to import

        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY_PERCENT]
        _, data = cv2.imencode(".jpg", lights[..., ::-1], options)
        converted.write(data.tobytes(), filter=Name.DCTDecode, type_check=False)
        return converted
    # Differences from the row above are far more compressible (PNG's predictor "up").
    rows = lights.reshape(len(lights), -1)
    coded = np.full((len(rows), rows.shape[1] + 1), 2, np.uint8)
    coded[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1]))
    how = Dictionary(Predictor=15, Colors=3, BitsPerComponent=8, Columns=lights.shape[1])
    packed = zlib.compress(coded.tobytes(), 6)
    converted.write(packed, filter=Name.FlateDecode, decode_parms=how, type_check=False)
    return converted


def _jpeg_2000(
    pdf: Pdf, image: Stream, named: pikepdf.Object | None, inks: pikepdf.Object
) -> Stream:
    """Convert a JPEG 2000, which contains its colour space, to a JPEG if it is grey or RGB."""
    import cv2  # slow to import

    given = image.get("/ColorSpace")
    space = None if given is None else colours.read_convertible_space(given, named)
    plain = given is None or (space is not None and space.kind in ("grey", "rgb"))
    if not plain or int(image.get("/SMaskInData", 0)) or "/Decode" in image:
        raise NotConvertible("JPEG 2000 images")
    if isinstance(image.get("/Mask"), Array) or _filters(image) != ["/JPXDecode"]:
        raise NotConvertible("JPEG 2000 images")
    _no_matte(image)
    data = np.frombuffer(image.read_raw_bytes(), np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype != np.uint8 or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise NotConvertible("JPEG 2000 images")
    lights = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels[..., ::-1]
    return _with_samples(pdf, image, np.ascontiguousarray(lights), True, inks)


def _no_matte(image: Stream) -> None:
    mask = image.get("/SMask")
    if mask is not None and "/Matte" in mask:
        raise NotConvertible("images blended with a matte")


def _convert_matte(pdf: Pdf, converted: Stream, space: ColourSpace) -> None:
    mask = converted.get("/SMask")
    if mask is not None and "/Matte" in mask:
        changed = copy.copy(mask)
        matte = space.cmy(colours.numbers(mask.Matte)[None, :])[0]
        changed.Matte = Array([_number(value) for value in matte])
        converted.SMask = pdf.make_indirect(changed)


def convert_shading(
    pdf: Pdf, shaded: pikepdf.Object, named: pikepdf.Object | None, inks: pikepdf.Object
) -> pikepdf.Object:
    """Return a shading without black as a new object.

    Raises
    ------
    NotConvertible
        The object has to remain as it is.
    """
    kind = int(shaded.ShadingType)
    space = colours.read_convertible_space(shaded.get("/ColorSpace"), named)
    if space is None or kind == 1:
        raise NotConvertible("shadings by a formula, or in a spot or Lab colour space")
    converted = copy.copy(shaded)
    if "/Background" in shaded:
        cmy = space.cmy(colours.numbers(shaded.Background)[None, :])[0]
    if "/Function" in shaded or (kind >= 4 and space.components == 1):
        low, high = _parameter(shaded, kind)
        converted.Function = _colours_along(pdf, shaded, space, low, high)
        converted.ColorSpace = Name.DeviceCMYK
        background = [*cmy, 0.0] if "/Background" in shaded else None
    elif kind >= 4 and space.kind == "rgb":
        decode = colours.numbers(shaded.Decode)
        decode[4:] = 1 - decode[4:]
        converted.Decode = Array([_number(value) for value in decode])
        converted.ColorSpace = inks
        background = [*cmy] if "/Background" in shaded else None
    else:
        raise NotConvertible("shadings of a mesh in CMYK")
    if background is not None:
        converted.Background = Array([_number(value) for value in background])
    return converted


def _parameter(shaded: pikepdf.Object, kind: int) -> tuple[float, float]:
    """Return the range of the parameter of a shading."""
    if kind >= 4:
        low, high = colours.numbers(shaded.Decode)[4:6]
    else:
        low, high = colours.numbers(shaded.Domain)[:2] if "/Domain" in shaded else (0.0, 1.0)
    return float(low), float(high)


def _colours_along(
    pdf: Pdf, shaded: pikepdf.Object, space: ColourSpace, low: float, high: float
) -> pikepdf.Object:
    """Return a sampled function from the parameter to CMYK with zero black."""
    along = np.linspace(low, high, SHADING_STEPS)
    if "/Function" in shaded:
        inner = colours.read_function(shaded.Function)
        if inner is None:
            raise NotConvertible("shadings by a formula, or in a spot or Lab colour space")
        values = inner(along)
    else:
        values = along[:, None]
    table = np.zeros((SHADING_STEPS, 4), np.uint8)
    table[:, :3] = np.round(255 * space.cmy(values))
    converted = Stream(pdf, table.tobytes())
    converted.FunctionType = 0
    converted.Domain = Array([_number(low), _number(high)])
    converted.Range = Array([0, 1] * 4)
    converted.Size = Array([SHADING_STEPS])
    converted.BitsPerSample = 8
    return pdf.make_indirect(converted)


def _number(value: float) -> float | int:
    """Round a number to six decimals; integers are written as such."""
    rounded = round(float(value), 6)
    return int(rounded) if rounded == int(rounded) else rounded
