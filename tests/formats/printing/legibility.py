"""Texts and strokes of the pages of a PDF, as pdfium finds them, and their collisions."""

from __future__ import annotations

import ctypes
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pypdfium2
import pypdfium2.raw as pdfium
from numpy.typing import NDArray

MM_PER_POINT = 25.4 / 72

TOUCH_MM = 0.02
"""Overlap that is due to rounding in the PDF."""

CURVE_CHORDS = 8
"""Chords that stand for one Bezier curve."""

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class PrintedText:
    """One text object: its size, and the box around the ink of its letters, in mm."""

    text: str
    points: float
    box: Box


@dataclass(frozen=True)
class PageInk:
    """Texts and strokes of a page; a stroke is x0, y0, x1, y1 and half its width, in mm."""

    texts: tuple[PrintedText, ...]
    strokes: NDArray[np.float64]


def page_inks(data: bytes) -> Iterator[PageInk]:
    """Yield the ink of each page of a PDF."""
    document = pypdfium2.PdfDocument(data)
    for page in document:
        text_page = page.get_textpage()
        strokes = [np.zeros((0, 5))]
        for item in page.get_objects(filter=(pdfium.FPDF_PAGEOBJ_PATH,)):
            edges = np.array(list(_strokes(item))).reshape(-1, 5) * MM_PER_POINT
            strokes.append(_clipped(edges, _clip(item.raw)))
        yield PageInk(tuple(_texts(text_page)), np.concatenate(strokes))


def _clip(item: object) -> Box:
    """Return the box to which an object is clipped, in mm."""
    box = (-math.inf, -math.inf, math.inf, math.inf)
    clip = pdfium.FPDFPageObj_GetClipPath(item)
    for path in range(max(0, pdfium.FPDFClipPath_CountPaths(clip))):
        corners = []
        for index in range(pdfium.FPDFClipPath_CountPathSegments(clip, path)):
            x, y = ctypes.c_float(), ctypes.c_float()
            segment = pdfium.FPDFClipPath_GetPathSegment(clip, path, index)
            pdfium.FPDFPathSegment_GetPoint(segment, x, y)
            corners.append((x.value * MM_PER_POINT, y.value * MM_PER_POINT))
        (left, bottom), (right, top) = np.min(corners, axis=0), np.max(corners, axis=0)
        box = _common((left, bottom, right, top), box)
    return box


def _common(first: Box, second: Box) -> Box:
    """Return the common area of two boxes."""
    low = [max(pair) for pair in zip(first[:2], second[:2], strict=True)]
    high = [min(pair) for pair in zip(first[2:], second[2:], strict=True)]
    return low[0], low[1], high[0], high[1]


def _texts(text_page: pypdfium2.PdfTextPage) -> Iterator[PrintedText]:
    """Yield the text objects with their letters."""

    def owner(index: int) -> int:
        found = pdfium.FPDFText_GetTextObject(text_page, index)
        return ctypes.addressof(found.contents) if found else 0

    for key, indices in itertools.groupby(range(text_page.count_chars()), owner):
        letters = list(indices)
        text = "".join(chr(pdfium.FPDFText_GetUnicode(text_page, i)) for i in letters)
        inked = [i for i, letter in zip(letters, text, strict=True) if not letter.isspace()]
        if not key or not inked:
            continue
        boxes = np.array([text_page.get_charbox(i) for i in inked]) * MM_PER_POINT
        left, bottom = boxes[:, :2].min(axis=0).tolist()
        right, top = boxes[:, 2:].max(axis=0).tolist()
        matrix = pdfium.FS_MATRIX()
        assert pdfium.FPDFText_GetMatrix(text_page, inked[0], matrix)
        scale = math.sqrt(abs(matrix.a * matrix.d - matrix.b * matrix.c))
        points = pdfium.FPDFText_GetFontSize(text_page, inked[0]) * scale
        item = pdfium.FPDFText_GetTextObject(text_page, inked[0])
        box = _common((left, bottom, right, top), _clip(item))
        if box[0] < box[2] and box[1] < box[3]:
            yield PrintedText(text.strip(), points, box)


def _strokes(item: pypdfium2.PdfObject) -> Iterator[tuple[float, ...]]:
    """Yield the edges of a path in points, with half the width of its line."""
    a, b, c, d, e, f = item.get_matrix().get()
    fill, stroked = ctypes.c_int(), ctypes.c_int()
    pdfium.FPDFPath_GetDrawMode(item, fill, stroked)
    width = ctypes.c_float()
    pdfium.FPDFPageObj_GetStrokeWidth(item, width)
    half = width.value / 2 * math.sqrt(abs(a * d - b * c)) if stroked.value else 0.0
    start = here = (0.0, 0.0)
    curve: list[tuple[float, float]] = []
    for index in range(pdfium.FPDFPath_CountSegments(item)):
        segment = pdfium.FPDFPath_GetPathSegment(item, index)
        x, y = ctypes.c_float(), ctypes.c_float()
        pdfium.FPDFPathSegment_GetPoint(segment, x, y)
        point = (a * x.value + c * y.value + e, b * x.value + d * y.value + f)
        kind = pdfium.FPDFPathSegment_GetType(segment)
        if kind == pdfium.FPDF_SEGMENT_MOVETO:
            start = here = point
            continue
        if kind == pdfium.FPDF_SEGMENT_BEZIERTO:
            curve.append(point)
            if len(curve) < 3:
                continue
            chords = _chords(here, *curve)
            curve = []
        else:
            chords = [point]
        for end in chords:
            yield (*here, *end, half)
            here = end
        if pdfium.FPDFPathSegment_GetClose(segment):
            yield (*here, *start, half)
            here = start


def _chords(*corners: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the ends of the chords of a cubic Bezier curve."""
    p = np.array(corners)
    t = np.linspace(0, 1, CURVE_CHORDS + 1)[1:, None]
    curve = (1 - t) ** 3 * p[0] + 3 * t * (1 - t) ** 2 * p[1] + 3 * t**2 * (1 - t) * p[2]
    return [(float(x), float(y)) for x, y in curve + t**3 * p[3]]


def crossed_texts(ink: PageInk, clearance_mm: float = -TOUCH_MM) -> list[str]:
    """Return the texts to which a stroke is nearer than this distance."""
    return [
        text.text
        for text in ink.texts
        if _entered(ink.strokes, text.box, ink.strokes[:, 4] + clearance_mm)[0].any()
    ]


def _clipped(strokes: NDArray[np.float64], box: Box) -> NDArray[np.float64]:
    """Return the parts of strokes in a box."""
    is_inside, low, high = _entered(strokes, box, np.zeros(len(strokes)))
    start, step = strokes[:, :2], strokes[:, 2:4] - strokes[:, :2]
    parts = [start + low[:, None] * step, start + high[:, None] * step, strokes[:, 4:]]
    return np.concatenate(parts, axis=1)[is_inside]


def _entered(
    strokes: NDArray[np.float64], box: Box, grow: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Return which strokes enter a box that is grown, and between which fractions of them."""
    low, high = np.zeros(len(strokes)), np.ones(len(strokes))
    is_inside = np.ones(len(strokes), bool)
    for axis in (0, 1):
        start, step = strokes[:, axis], strokes[:, axis + 2] - strokes[:, axis]
        lower, upper = box[axis] - grow, box[axis + 2] + grow
        is_parallel = np.abs(step) < 1e-9
        is_inside &= ~is_parallel | ((start > lower) & (start < upper))
        safe = np.where(is_parallel, 1.0, step)
        first, last = (lower - start) / safe, (upper - start) / safe
        low = np.maximum(low, np.where(is_parallel, 0.0, np.minimum(first, last)))
        high = np.minimum(high, np.where(is_parallel, 1.0, np.maximum(first, last)))
    return is_inside & (low < high), low, high


def overlapping_texts(ink: PageInk) -> list[tuple[str, str]]:
    """Return the pairs of texts whose boxes overlap."""
    if not ink.texts:
        return []
    boxes = np.array([text.box for text in ink.texts])
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    overlaps = (high - low > TOUCH_MM).all(axis=2)
    first, second = np.nonzero(np.triu(overlaps, 1))
    return [
        (ink.texts[a].text, ink.texts[b].text)
        for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]
