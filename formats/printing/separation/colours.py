"""Colours of a PDF without black ink: what black was made of is given to the other three.

A colour space says how many numbers make a colour; :func:`space` reads one from the
document and knows how to turn such numbers into cyan, magenta and yellow. Everything
here is of ISO 32000-1, chapters 7.10 (functions) and 8.6 (colour spaces).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pikepdf
from numpy.typing import NDArray
from pikepdf import Name

Floats = NDArray[np.float64]

FAMILIES = {
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

INKS = ("/Cyan", "/Magenta", "/Yellow", "/Black")


@dataclass(frozen=True)
class Space:
    """A colour space whose colours can be made without black.

    Attributes
    ----------
    kind : {"grey", "rgb", "cmyk", "indexed", "tint", "inks"}
    components : int
    initial : tuple of float
        The colour that is set together with the space.
    cmy : callable
        (n, components) numbers as in the document to (n, 3) cyan, magenta and yellow,
        each 0 for none to 1 for all.
    high : int
        Largest index of an indexed space.
    """

    kind: str
    components: int
    initial: tuple[float, ...]
    cmy: Callable[[Floats], Floats]
    high: int = 0


def from_grey(values: Floats) -> Floats:
    """(n, 1) grey to (n, 3): black is all three inks."""
    return np.repeat(1 - np.clip(values, 0, 1), 3, axis=1)


def from_rgb(values: Floats) -> Floats:
    """(n, 3) to (n, 3): each ink takes one light away."""
    return 1 - np.clip(values, 0, 1)


def from_cmyk(values: Floats) -> Floats:
    """(n, 4) to (n, 3): black darkens what the other three leave, ``c + k - c k``.

    The sum ``c + k`` of ISO 32000-1 10.3.5 would make all dark colours the same black.
    """
    ink, black = np.clip(values[:, :3], 0, 1), np.clip(values[:, 3:], 0, 1)
    return ink + black - ink * black


GREY = Space("grey", 1, (0.0,), from_grey)
RGB = Space("rgb", 3, (0.0, 0.0, 0.0), from_rgb)
CMYK = Space("cmyk", 4, (0.0, 0.0, 0.0, 1.0), from_cmyk)
BY_COMPONENTS = {1: GREY, 3: RGB, 4: CMYK}


def space(found: pikepdf.Object | None, named: pikepdf.Object | None = None) -> Space | None:
    """The colour space that ``found`` describes, None where it cannot be done without black.

    Parameters
    ----------
    found : Name or Array
    named : Dictionary, optional
        ``ColorSpace`` of the resources, in which a name is looked up.
    """
    if isinstance(found, Name):
        if str(found) in FAMILIES:
            return BY_COMPONENTS[FAMILIES[str(found)]]
        inner = None if named is None else named.get(str(found))
        # A name that stands for a name that stands for ... ends here.
        return space(inner) if inner is not None and inner != found else None
    if not isinstance(found, pikepdf.Array) or len(found) == 0:
        return None
    family = str(found[0])
    if family in FAMILIES:
        return BY_COMPONENTS[FAMILIES[family]]
    if family == "/ICCBased":
        return _profile(found)
    if family in ("/Indexed", "/I"):
        return _indexed(found, named)
    if family == "/Separation":
        return _tint(found, named)
    if family == "/DeviceN":
        return _inks(found)
    return None


def _profile(found: pikepdf.Array) -> Space | None:
    stream = found[1]
    alternate = stream.get("/Alternate")
    if isinstance(alternate, pikepdf.Array) and str(alternate[0]) == "/Lab":
        return None
    return BY_COMPONENTS.get(int(stream.get("/N", 0)))


def _indexed(found: pikepdf.Array, named: pikepdf.Object | None) -> Space | None:
    base = space(found[1], named)
    if base is None or base.kind == "indexed":
        return None
    high = int(found[2])
    table = found[3]
    data = table.read_bytes() if isinstance(table, pikepdf.Stream) else bytes(table)
    wanted = (high + 1) * base.components
    entries = np.frombuffer(data[:wanted].ljust(wanted, b"\0"), np.uint8) / 255.0
    palette = base.cmy(entries.reshape(high + 1, base.components))

    def look_up(values: Floats) -> Floats:
        return palette[np.clip(values[:, 0].astype(int), 0, high)]

    return Space("indexed", 1, (0.0,), look_up, high)


def _tint(found: pikepdf.Array, named: pikepdf.Object | None) -> Space | None:
    """One ink: black itself, or a spot colour by its alternate."""
    name = str(found[1])
    if name in ("/Black", "/All"):  # /All is on every plate, so on that of black
        return Space("tint", 1, (1.0,), lambda v: np.repeat(np.clip(v, 0, 1), 3, axis=1))
    if name in INKS:
        plate = np.eye(4)[INKS.index(name), :3]
        return Space("tint", 1, (1.0,), lambda v: np.clip(v, 0, 1) * plate)
    alternate = space(found[2], named)
    transform = function(found[3])
    if alternate is None or transform is None:
        return None
    return Space("tint", 1, (1.0,), lambda v: alternate.cmy(transform(np.clip(v[:, 0], 0, 1))))


def _inks(found: pikepdf.Array) -> Space | None:
    """Several inks, where all of them are process inks."""
    names = [str(name) for name in found[1]]
    if not set(names) <= {*INKS, "/None"}:
        return None
    into = np.array([[float(ink == name) for ink in INKS] for name in names])
    return Space("inks", len(names), (1.0,) * len(names), lambda v: from_cmyk(v @ into))


def function(found: pikepdf.Object) -> Callable[[Floats], Floats] | None:
    """A function of one number, (n,) to (n, outputs); None for kinds that are not read.

    Read are sampled (type 0), exponential (2) and stitched (3) functions, and lists of them
    with one output each.
    """
    if isinstance(found, pikepdf.Array):
        parts = [function(item) for item in found]
        if any(part is None for part in parts):
            return None
        return lambda x: np.hstack([part(x) for part in parts if part is not None])
    kind = int(found.get("/FunctionType", -1))
    made = {0: _sampled, 2: _exponential, 3: _stitched}.get(kind)
    inner = made(found) if made is not None else None
    if inner is None:
        return None
    low, high = numbers(found.Domain)[:2]
    ends = numbers(found.Range).reshape(-1, 2) if "/Range" in found else None

    def evaluate(x: Floats) -> Floats:
        result = inner(np.clip(x, low, high))
        return result if ends is None else np.clip(result, ends[:, 0], ends[:, 1])

    return evaluate


def numbers(found: Any) -> Floats:
    """A PDF array of numbers."""
    return np.array([float(item) for item in found])


def _exponential(found: pikepdf.Object) -> Callable[[Floats], Floats]:
    first = numbers(found.C0) if "/C0" in found else np.zeros(1)
    last = numbers(found.C1) if "/C1" in found else np.ones(1)
    power = float(found.N)
    return lambda x: first + (x**power)[:, None] * (last - first)


def _stitched(found: pikepdf.Object) -> Callable[[Floats], Floats] | None:
    parts = [function(item) for item in found.Functions]
    if any(part is None for part in parts):
        return None
    domain, bounds = numbers(found.Domain)[:2], numbers(found.Bounds)
    encode = numbers(found.Encode).reshape(-1, 2)
    edges = np.concatenate([domain[:1], bounds, domain[1:]])

    def evaluate(x: Floats) -> Floats:
        which = np.searchsorted(bounds, x, side="right")
        results = []
        for k, part in enumerate(parts):
            assert part is not None
            width = edges[k + 1] - edges[k]
            share = (x - edges[k]) / width if width else np.zeros_like(x)
            results.append(part(encode[k, 0] + share * (encode[k, 1] - encode[k, 0])))
        return np.stack(results)[which, np.arange(len(x))]

    return evaluate


def _sampled(found: pikepdf.Object) -> Callable[[Floats], Floats] | None:
    size, bits = numbers(found.Size), int(found.BitsPerSample)
    if len(size) != 1 or bits not in (8, 16, 32) or not isinstance(found, pikepdf.Stream):
        return None
    ends = numbers(found.Range).reshape(-1, 2)
    samples = np.frombuffer(found.read_bytes(), f">u{bits // 8}")[: int(size[0]) * len(ends)]
    samples = samples.reshape(int(size[0]), len(ends)) / (2.0**bits - 1)
    decode = numbers(found.Decode).reshape(-1, 2) if "/Decode" in found else ends
    table = decode[:, 0] + samples * (decode[:, 1] - decode[:, 0])
    low, high = numbers(found.Domain)[:2]
    start, end = numbers(found.Encode)[:2] if "/Encode" in found else (0.0, size[0] - 1)

    def evaluate(x: Floats) -> Floats:
        at = np.clip(start + (x - low) / (high - low) * (end - start), 0, size[0] - 1)
        columns = [np.interp(at, np.arange(len(table)), column) for column in table.T]
        return np.stack(columns, axis=1)

    return evaluate
