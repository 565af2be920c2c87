"""Colours of a PDF with and without black ink.

:func:`read_colour_space` reads a colour space, and provides the amount of black ink of its colours
and their conversion to cyan, magenta and yellow alone, according to ISO 32000-1, 7.10 (functions)
and 8.6 (colour spaces).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pikepdf
from numpy.typing import NDArray
from pikepdf import Name

Floats = NDArray[np.float64]

COMPONENTS_BY_NAME = {
    "/DeviceGray": 1,
    "/G": 1,
    "/CalGray": 1,
    "/DeviceRGB": 3,
    "/RGB": 3,
    "/CalRGB": 3,
    "/DeviceCMYK": 4,
    "/CMYK": 4,
}
"""Number of components by the name of the colour space; short names are of inline images."""

MAX_NEUTRAL_DIFFERENCE = 0.05
"""Largest difference of red, green and blue of a colour that printers print by black alone."""

BLACK_ONSET = 0.5
"""Common part of cyan, magenta and yellow from which on printers replace it by black in colours;
half is usual for grey component replacement of medium strength."""

INKS = ("/Cyan", "/Magenta", "/Yellow", "/Black")


@dataclass(frozen=True)
class ColourSpace:
    """Colour space with a conversion to inks without black.

    Attributes
    ----------
    kind : {"grey", "rgb", "cmyk", "lab", "indexed", "tint", "inks"}
    components : int
    initial : tuple of float
        Colour that is set together with the space.
    cmy : callable
        Maps (n, components) numbers of the document to (n, 3) cyan, magenta and yellow, from 0
        (no ink) to 1.
    black : callable
        Maps (n, components) numbers to the (n,) amount of black ink of a printer, from 0 to 1.
    high : int
        Largest index of an indexed space.
    ranges : tuple of (float, float)
        Smallest and largest value of each component if they are not 0 and 1.
    is_convertible : bool
        False if ``cmy`` does not give the appearance, so that the colours have to remain.
    """

    kind: str
    components: int
    initial: tuple[float, ...]
    cmy: Callable[[Floats], Floats]
    black: Callable[[Floats], Floats]
    high: int = 0
    ranges: tuple[tuple[float, float], ...] = ()
    is_convertible: bool = True


def from_grey(values: Floats) -> Floats:
    """Convert grey (n, 1) to inks (n, 3): black is all three inks."""
    return np.repeat(1 - np.clip(values, 0, 1), 3, axis=1)


def from_rgb(values: Floats) -> Floats:
    """Convert RGB (n, 3) to inks (n, 3): each ink absorbs one colour."""
    return 1 - np.clip(values, 0, 1)


def from_cmyk(values: Floats) -> Floats:
    """Convert CMYK (n, 4) to inks (n, 3): black absorbs the remaining light, ``c + k - c k``.

    With the sum ``c + k`` of ISO 32000-1 10.3.5 all dark colours would become the same black.
    """
    ink, black = np.clip(values[:, :3], 0, 1), np.clip(values[:, 3:], 0, 1)
    return ink + black - ink * black


def black_of_grey(values: Floats) -> Floats:
    """Return the black ink (n,) of grey (n, 1): printers print grey by black alone."""
    return 1 - np.clip(values[:, 0], 0, 1)


def black_of_rgb(values: Floats) -> Floats:
    """Return the black ink (n,) of RGB (n, 3).

    Printers replace equal parts of the three inks by black: all of them in neutral colours, and in
    others the part above :data:`BLACK_ONSET`.
    """
    light = np.clip(values, 0, 1)
    ink = 1 - light.max(axis=1)
    is_neutral = np.ptp(light, axis=1) <= MAX_NEUTRAL_DIFFERENCE
    return np.where(is_neutral, ink, np.clip((ink - BLACK_ONSET) / (1 - BLACK_ONSET), 0, 1))


def black_of_cmyk(values: Floats) -> Floats:
    """Return the black ink (n,) of CMYK (n, 4)."""
    return np.clip(values[:, 3], 0, 1)


def rgb_of_lab(values: Floats) -> Floats:
    """Convert CIE L*a*b* (n, 3) to sRGB (n, 3), the white point of both being the paper.

    See ISO 32000-1, 8.6.5.4, and IEC 61966-2-1.
    """
    middle = (values[:, 0] + 16) / 116
    roots = np.stack([middle + values[:, 1] / 500, middle, middle - values[:, 2] / 200], axis=1)
    xyz = np.where(roots >= 6 / 29, roots**3, 108 / 841 * (roots - 4 / 29))
    linear = np.clip(xyz @ SRGB_OF_XYZ.T, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


SRGB_OF_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
) * (0.9505, 1.0, 1.0890)
"""Linear sRGB of X, Y and Z relative to the white point (IEC 61966-2-1, D65)."""

GREY = ColourSpace("grey", 1, (0.0,), from_grey, black_of_grey)
RGB = ColourSpace("rgb", 3, (0.0, 0.0, 0.0), from_rgb, black_of_rgb)
CMYK = ColourSpace("cmyk", 4, (0.0, 0.0, 0.0, 1.0), from_cmyk, black_of_cmyk)
BY_COMPONENTS = {1: GREY, 3: RGB, 4: CMYK}


def read_convertible_space(
    definition: pikepdf.Object | None, named: pikepdf.Object | None = None
) -> ColourSpace | None:
    """Read a colour space; return None if it cannot be converted to inks without black."""
    space = read_colour_space(definition, named)
    return space if space is not None and space.is_convertible else None


def read_colour_space(
    definition: pikepdf.Object | None, named: pikepdf.Object | None = None
) -> ColourSpace | None:
    """Read a colour space; return None if its black ink is unknown.

    Parameters
    ----------
    definition : Name or Array
    named : Dictionary, optional
        ``ColorSpace`` of the resources, in which names are looked up.
    """
    if isinstance(definition, Name):
        if str(definition) in COMPONENTS_BY_NAME:
            return BY_COMPONENTS[COMPONENTS_BY_NAME[str(definition)]]
        inner = None if named is None else named.get(str(definition))
        # Names that refer to names are resolved once only, which excludes endless loops.
        return read_colour_space(inner) if inner is not None and inner != definition else None
    if not isinstance(definition, pikepdf.Array) or len(definition) == 0:
        return None
    family = str(definition[0])
    if family in COMPONENTS_BY_NAME:
        return BY_COMPONENTS[COMPONENTS_BY_NAME[family]]
    if family == "/Lab":
        return _lab(definition)
    if family == "/ICCBased":
        return _profile(definition)
    if family in ("/Indexed", "/I"):
        return _indexed(definition, named)
    if family == "/Separation":
        return _tint(definition, named)
    if family == "/DeviceN":
        return _inks(definition)
    return None


def _profile(definition: pikepdf.Array) -> ColourSpace | None:
    stream = definition[1]
    alternate = stream.get("/Alternate")
    if isinstance(alternate, pikepdf.Array) and str(alternate[0]) == "/Lab":
        return _lab(alternate)
    return BY_COMPONENTS.get(int(stream.get("/N", 0)))


def _lab(definition: pikepdf.Array) -> ColourSpace:
    given = definition[1].get("/Range")
    ends = np.array([-100.0, 100.0] * 2) if given is None else numbers(given)
    (low_a, high_a), (low_b, high_b) = ends[:4].reshape(2, 2).tolist()
    return ColourSpace(
        "lab",
        3,
        (0.0, min(max(0.0, low_a), high_a), min(max(0.0, low_b), high_b)),
        lambda v: from_rgb(rgb_of_lab(v)),
        lambda v: black_of_rgb(rgb_of_lab(v)),
        ranges=((0.0, 100.0), (low_a, high_a), (low_b, high_b)),
        is_convertible=False,
    )


def _indexed(definition: pikepdf.Array, named: pikepdf.Object | None) -> ColourSpace | None:
    base = read_colour_space(definition[1], named)
    if base is None or base.kind == "indexed":
        return None
    high = int(definition[2])
    table = definition[3]
    data = table.read_bytes() if isinstance(table, pikepdf.Stream) else bytes(table)
    wanted = (high + 1) * base.components
    entries = np.frombuffer(data[:wanted].ljust(wanted, b"\0"), np.uint8) / 255.0
    low, top = np.array(base.ranges or ((0.0, 1.0),) * base.components).T
    colours = low + entries.reshape(high + 1, base.components) * (top - low)

    def look_up(values: Floats, palette: Floats) -> Floats:
        return palette[np.clip(values[:, 0].astype(int), 0, high)]

    cmy, black = (partial(look_up, palette=of(colours)) for of in (base.cmy, base.black))
    return ColourSpace("indexed", 1, (0.0,), cmy, black, high, is_convertible=base.is_convertible)


def _tint(definition: pikepdf.Array, named: pikepdf.Object | None) -> ColourSpace | None:
    """Read a single ink: black itself, or a spot colour by its alternate space."""
    name = str(definition[1])
    if name == "/None":  # paints nothing, whereas no ink would paint white
        return ColourSpace(
            "tint",
            1,
            (1.0,),
            lambda v: np.zeros((len(v), 3)),
            lambda v: np.zeros(len(v)),
            is_convertible=False,
        )
    if name in ("/Black", "/All"):  # /All is printed with all inks, including black
        return ColourSpace(
            "tint",
            1,
            (1.0,),
            lambda v: np.repeat(np.clip(v, 0, 1), 3, axis=1),
            lambda v: np.clip(v[:, 0], 0, 1),
        )
    if name in INKS:
        plate = np.eye(4)[INKS.index(name), :3]
        return ColourSpace(
            "tint", 1, (1.0,), lambda v: np.clip(v, 0, 1) * plate, lambda v: np.zeros(len(v))
        )
    alternate = read_colour_space(definition[2], named)
    transform = read_function(definition[3])
    if alternate is None or transform is None:
        return None
    return ColourSpace(
        "tint",
        1,
        (1.0,),
        lambda v: alternate.cmy(transform(np.clip(v[:, 0], 0, 1))),
        lambda v: alternate.black(transform(np.clip(v[:, 0], 0, 1))),
        is_convertible=alternate.is_convertible,
    )


def _inks(definition: pikepdf.Array) -> ColourSpace | None:
    """Read several inks; only process inks are convertible."""
    names = [str(name) for name in definition[1]]
    to_cmyk = np.array([[float(ink == name) for ink in INKS] for name in names])
    return ColourSpace(
        "inks",
        len(names),
        (1.0,) * len(names),
        lambda v: from_cmyk(v @ to_cmyk),
        lambda v: black_of_cmyk(v @ to_cmyk),
        is_convertible=set(names) <= {*INKS, "/None"},
    )


def read_function(definition: pikepdf.Object) -> Callable[[Floats], Floats] | None:
    """Read a function of one number, (n,) to (n, outputs); return None for unsupported types.

    Supported are sampled (type 0), exponential (2) and stitched (3) functions, and lists of them
    with one output each.
    """
    if isinstance(definition, pikepdf.Array):
        parts = [read_function(item) for item in definition]
        if any(part is None for part in parts):
            return None
        return lambda x: np.hstack([part(x) for part in parts if part is not None])
    kind = int(definition.get("/FunctionType", -1))
    read = {0: _sampled, 2: _exponential, 3: _stitched}.get(kind)
    inner = read(definition) if read is not None else None
    if inner is None:
        return None
    low, high = numbers(definition.Domain)[:2]
    ends = numbers(definition.Range).reshape(-1, 2) if "/Range" in definition else None

    def evaluate(x: Floats) -> Floats:
        result = inner(np.clip(x, low, high))
        return result if ends is None else np.clip(result, ends[:, 0], ends[:, 1])

    return evaluate


def numbers(definition: Any) -> Floats:
    """Convert a PDF array of numbers."""
    return np.array([float(item) for item in definition])


def _exponential(definition: pikepdf.Object) -> Callable[[Floats], Floats]:
    first = numbers(definition.C0) if "/C0" in definition else np.zeros(1)
    last = numbers(definition.C1) if "/C1" in definition else np.ones(1)
    power = float(definition.N)
    return lambda x: first + (x**power)[:, None] * (last - first)


def _stitched(definition: pikepdf.Object) -> Callable[[Floats], Floats] | None:
    parts = [read_function(item) for item in definition.Functions]
    if any(part is None for part in parts):
        return None
    domain, bounds = numbers(definition.Domain)[:2], numbers(definition.Bounds)
    encode = numbers(definition.Encode).reshape(-1, 2)
    edges = np.concatenate([domain[:1], bounds, domain[1:]])

    def evaluate(x: Floats) -> Floats:
        part_index = np.searchsorted(bounds, x, side="right")
        results = []
        for k, part in enumerate(parts):
            assert part is not None
            width = edges[k + 1] - edges[k]
            fraction = (x - edges[k]) / width if width else np.zeros_like(x)
            results.append(part(encode[k, 0] + fraction * (encode[k, 1] - encode[k, 0])))
        return np.stack(results)[part_index, np.arange(len(x))]

    return evaluate


def _sampled(definition: pikepdf.Object) -> Callable[[Floats], Floats] | None:
    size, bits = numbers(definition.Size), int(definition.BitsPerSample)
    if len(size) != 1 or bits not in (8, 16, 32) or not isinstance(definition, pikepdf.Stream):
        return None
    ends = numbers(definition.Range).reshape(-1, 2)
    samples = np.frombuffer(definition.read_bytes(), f">u{bits // 8}")[: int(size[0]) * len(ends)]
    samples = samples.reshape(int(size[0]), len(ends)) / (2.0**bits - 1)
    decode = numbers(definition.Decode).reshape(-1, 2) if "/Decode" in definition else ends
    table = decode[:, 0] + samples * (decode[:, 1] - decode[:, 0])
    low, high = numbers(definition.Domain)[:2]
    start, end = numbers(definition.Encode)[:2] if "/Encode" in definition else (0.0, size[0] - 1)

    def evaluate(x: Floats) -> Floats:
        position = np.clip(start + (x - low) / (high - low) * (end - start), 0, size[0] - 1)
        columns = [np.interp(position, np.arange(len(table)), column) for column in table.T]
        return np.stack(columns, axis=1)

    return evaluate
