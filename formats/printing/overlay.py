"""Dots printed over the pages of a PDF document.

:func:`overlay` draws each page of one PDF over the same page of another at true size, and
optionally removes the black ink of the lower one. It needs pikepdf (extra ``pdf``).
"""

from __future__ import annotations

import copy
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pikepdf
from pikepdf import Array, Dictionary, Name, Pdf, Rectangle, Stream

from locatk.core.drawing import MM_PER_POINT
from locatk.core.errors import FormatError, InputError
from locatk.formats.files import read_head
from locatk.formats.printing.separation.content import DAMAGE_ERRORS, BlackRemover
from locatk.formats.printing.separation.detection import BlackFinder

SIZE_TOLERANCE_MM = 0.1
"""Largest difference in size between a stamp and its page."""

PRINT_FLAG, HIDDEN_FLAG = 4, 2
"""Flags of annotations (ISO 32000-1 table 165)."""

MAX_STREAM_BYTES = 1 << 30
"""Largest decompressed stream of a document [bytes]; an A0 page in CMYK at 400 dpi has 0.99e9.

A page of some kilobytes can claim any size.
"""


@dataclass(frozen=True)
class OverlaidDocument:
    """Result of :func:`overlay`.

    Attributes
    ----------
    data : bytes
        The PDF.
    pages : int
    left_black : dict of str to int
        Kinds of objects that remain black although black was to be removed, in the plural
        ("shadings of a mesh in CMYK"), and their numbers. If empty, only the stamp is black.
    dropped : int
        Printable comments without an appearance, which each viewer draws in its own way; they are
        left out.
    black_pages : int
        Pages with black below the stamp; not counted if black was to be removed.
    """

    data: bytes
    pages: int
    left_black: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    black_pages: int = 0


@dataclass(frozen=True)
class _PageFrame:
    """Visible part of a page: its crop box in the page's units, from the lower left."""

    left: float
    bottom: float
    right: float
    top: float
    rotation: int
    unit: float

    @classmethod
    def of(cls, page: pikepdf.Object) -> _PageFrame:
        media = _box(page.MediaBox)
        crop = _box(page.get("/CropBox", page.MediaBox))
        left, bottom = max(media[0], crop[0]), max(media[1], crop[1])
        right, top = min(media[2], crop[2]), min(media[3], crop[3])
        rotation = int(page.get("/Rotate", 0)) % 360
        unit = float(page.get("/UserUnit", 1))
        if right <= left or top <= bottom or unit <= 0 or rotation % 90:
            raise ValueError("a page of no size")
        return cls(left, bottom, right, top, rotation, unit)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height as displayed."""
        width, height = (self.right - self.left), (self.top - self.bottom)
        if self.rotation % 180:
            width, height = height, width
        return width * self.unit * MM_PER_POINT, height * self.unit * MM_PER_POINT

    @property
    def area(self) -> Rectangle:
        """Visible part in the units of the page's content."""
        return Rectangle(self.left, self.bottom, self.right, self.top)

    def onto(self, stamp: _PageFrame) -> str:
        """Return the matrix (for ``cm``) that moves the upright visible part over ``stamp``."""
        x, y = {
            0: (self.left, self.bottom),
            90: (self.right, self.bottom),
            180: (self.right, self.top),
            270: (self.left, self.top),
        }[self.rotation]
        cos = {0: 1, 90: 0, 180: -1, 270: 0}[self.rotation]
        sin = {0: 0, 90: 1, 180: 0, 270: -1}[self.rotation]
        scale = self.unit / stamp.unit
        a, b, c, d = scale * cos, -scale * sin, scale * sin, scale * cos
        e, f = stamp.left - a * x - c * y, stamp.bottom - b * x - d * y
        return " ".join(str(_plain(value)) for value in (a, b, c, d, e, f))


def page_sizes(path: str | os.PathLike[str]) -> list[tuple[float, float]]:
    """Return width and height of each page in mm, as it is displayed and printed.

    This is the rotated crop box in the unit of the page.

    Raises
    ------
    MissingDataError
        The file does not exist.
    FormatError
        The file is not a PDF, is damaged or encrypted, or has no page.
    """
    with _opened(path) as pdf:
        return [_PageFrame.of(page.obj).size_mm for page in pdf.pages]


def overlay(
    document: str | os.PathLike[str],
    stamp: bytes,
    *,
    strip_black: bool,
    progress: Callable[[int, int], None] | None = None,
) -> OverlaidDocument:
    """Draw page i of ``stamp`` over page i of a document.

    Pages are not scaled; the lower left corners of the stamp and of the displayed page coincide.
    The fonts of the stamp are stored once, its inks and its overprint are kept, and no part of the
    document covers it: comments and filled-in forms become part of the page below, as they would
    print.

    Parameters
    ----------
    document : path
        The lower PDF.
    stamp : bytes
        PDF with as many pages, of the sizes of :func:`page_sizes`, without rotation.
    strip_black : bool
        Replace black and grey of the document by cyan, magenta and yellow.
    progress : callable, optional
        Called with the number of finished pages and the number of all.

    Returns
    -------
    OverlaidDocument
        The same input gives the same bytes.

    Raises
    ------
    MissingDataError, FormatError
        See :func:`page_sizes`.
    InputError
        The stamp has another number of pages, or a page of another size.
    """
    with _opened(document) as pdf, Pdf.open(io.BytesIO(stamp)) as stamps:
        if len(stamps.pages) != len(pdf.pages):
            raise InputError(
                f"{len(stamps.pages)} pages cannot be drawn over {len(pdf.pages)}", file=document
            )
        finder = BlackFinder(pdf)
        dropped = _flatten(pdf, finder)
        remover = BlackRemover(pdf) if strip_black else None
        black_pages = 0
        for number, page in enumerate(pdf.pages, 1):
            try:
                black_pages += _draw_over(
                    pdf, page, stamps, stamps.pages[number - 1], remover or finder
                )
            except InputError as error:
                raise InputError(error.message, file=document, where=f"page {number}") from None
            if progress is not None:
                progress(number, len(pdf.pages))
        if "/ViewerPreferences" not in pdf.Root:
            pdf.Root.ViewerPreferences = Dictionary()
        pdf.Root.ViewerPreferences.PrintScaling = Name("/None")
        target = io.BytesIO()
        pdf.save(
            target,
            min_version=max(stamps.pdf_version, "1.4"),
            object_stream_mode=pikepdf.ObjectStreamMode.generate,
            deterministic_id=True,
        )
        left_black = {} if remover is None else dict(sorted(remover.left.items()))
        return OverlaidDocument(target.getvalue(), len(pdf.pages), left_black, dropped, black_pages)


def _draw_over(
    pdf: Pdf,
    page: pikepdf.Page,
    stamps: Pdf,
    stamp: pikepdf.Page,
    black: BlackRemover | BlackFinder,
) -> bool:
    """Draw a stamp over a page; return True if it has black and that is only to be found."""
    frame, stamp_frame = _PageFrame.of(page.obj), _PageFrame.of(stamp.obj)
    if stamp_frame.rotation:
        raise InputError("the stamp is rotated")
    if any(
        abs(a - b) > SIZE_TOLERANCE_MM
        for a, b in zip(frame.size_mm, stamp_frame.size_mm, strict=True)
    ):
        sizes = (*stamp_frame.size_mm, *frame.size_mm)
        raise InputError(
            "the stamp has {:.2f} x {:.2f} mm, the page {:.2f} x {:.2f} mm".format(*sizes)
        )
    below = _as_form(pdf, page.obj)
    is_black = False
    if isinstance(black, BlackFinder):
        is_black = black.is_black(below, frame.area)
    else:
        below = black.form(below, starts=True)
    above = pdf.copy_foreign(_as_form(stamps, stamp.obj))
    # The page gets the size of the stamp, which is an integer number of the printer's pixels. The
    # document becomes a form, so that neither affects the state, blending or profiles of the other.
    for key in list(page.obj.keys()):
        if key not in ("/Type", "/Parent"):
            del page.obj[key]
    page.obj.MediaBox = Array([_plain(value) for value in _box(stamp.obj.MediaBox)])
    if "/TrimBox" in stamp.obj:
        page.obj.TrimBox = Array([_plain(value) for value in _box(stamp.obj.TrimBox)])
    if stamp_frame.unit != 1:
        page.obj.UserUnit = _plain(stamp_frame.unit)
    page.obj.Resources = Dictionary(XObject=Dictionary(Below=below, Dots=above))
    page.obj.Contents = pdf.make_stream(
        f"q {frame.onto(stamp_frame)} cm /Below Do Q /Dots Do".encode()
    )
    return is_black


def _as_form(pdf: Pdf, page: pikepdf.Object) -> Stream:
    """Convert the content of a page to a form in the page's coordinates."""
    contents = page.get("/Contents")
    if isinstance(contents, Stream):
        form = copy.copy(contents)  # its bytes remain compressed
    else:
        parts = [] if contents is None else [item.read_bytes() for item in contents]
        form = pdf.make_stream(b"\n".join(parts))
    form.Type, form.Subtype = Name.XObject, Name.Form
    form.BBox = Array([_plain(value) for value in _box(page.MediaBox)])
    form.Resources = page.get("/Resources", Dictionary())
    if "/Group" in page:
        form.Group = page.Group
    return pdf.make_indirect(form)


def _flatten(pdf: Pdf, layers: BlackFinder) -> int:
    """Draw annotations into the pages; return the number of those that cannot be drawn.

    Those of hidden layers are left out.
    """
    if "/AcroForm" in pdf.Root and pdf.Root.AcroForm.get("/NeedAppearances", False):
        pdf.generate_appearance_streams()
    dropped = 0
    for page in pdf.pages:
        annotations = [
            item for item in page.obj.get("/Annots", ()) if not layers.is_hidden(item.get("/OC"))
        ]
        for annotation in annotations:
            flags = int(annotation.get("/F", 0))
            is_drawn = "/AP" in annotation or str(annotation.get("/Subtype")) in (
                "/Link",
                "/Popup",
                "/Widget",
            )
            dropped += bool(flags & PRINT_FLAG) and not flags & HIDDEN_FLAG and not is_drawn
        if "/Annots" in page.obj:
            page.obj.Annots = Array(annotations)
            # The page becomes a form, so that its graphics state does not displace annotations.
            below = _as_form(pdf, page.obj)
            if "/Group" in below:
                del below.Group
            page.obj.Resources = Dictionary(XObject=Dictionary(Below=below))
            page.obj.Contents = pdf.make_stream(b"/Below Do")
    pdf.flatten_annotations("print")
    if "/AcroForm" in pdf.Root:
        del pdf.Root.AcroForm
    return dropped


def _box(rectangle: Any) -> tuple[float, float, float, float]:
    """Return left, bottom, right, top of a rectangle that is given by any two corners."""
    a, b, c, d = (float(value) for value in rectangle)
    return min(a, c), min(b, d), max(a, c), max(b, d)


def _plain(value: float) -> float | int:
    return int(value) if value == int(value) else round(value, 6)


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[Pdf]:
    """Open a document; errors while it is processed are reported as damage, too."""
    if b"%PDF-" not in read_head(path, 1024):
        raise FormatError("not a PDF", file=path, hint="Save the document as PDF")
    _limit_streams()
    try:
        _check_boxes(path)
        # A repair may lose pages without a message.
        with Pdf.open(os.fspath(path), attempt_recovery=False) as pdf:
            if pdf.is_encrypted:
                raise _encrypted(path)
            if len(pdf.pages) == 0:
                raise FormatError("a PDF without pages", file=path)
            yield pdf
    except pikepdf.PasswordError:
        raise _encrypted(path) from None
    except InputError:
        raise
    except DAMAGE_ERRORS as error:
        raise FormatError(
            f"a damaged PDF ({_first_line(error)})",
            file=path,
            hint="Print it into a new PDF from a viewer, check that it is complete, and use that",
        ) from error


def _check_boxes(path: str | os.PathLike[str]) -> None:
    """Check that each page has a size.

    If attributes are inherited or pages are counted, an invalid media box has already been replaced
    by that of US Letter.
    """
    with Pdf.open(os.fspath(path), attempt_recovery=False, inherit_page_attributes=False) as pdf:
        for number, box in enumerate(_media_boxes(pdf), 1):
            try:
                left, bottom, right, top = _box(box)
                is_valid = right > left and top > bottom
            except DAMAGE_ERRORS:
                is_valid = False
            if not is_valid:
                raise FormatError(
                    "the page has no valid size (MediaBox)",
                    file=path,
                    where=f"page {number}",
                    hint="Print the document into a new PDF from a viewer, and use that",
                )


def _media_boxes(pdf: Pdf) -> Iterator[Any]:
    """Yield the media boxes of the pages, as written."""
    nodes: list[tuple[Any, Any]] = [(pdf.Root.Pages, None)]
    folders = set()
    while nodes:
        node, inherited = nodes.pop()
        if not isinstance(node, Dictionary):
            continue  # ignored by viewers
        box = node.get("/MediaBox", inherited)
        if "/Kids" not in node:
            yield box
        elif node.objgen in folders:
            raise ValueError("a loop in the tree of pages")
        else:
            folders.add(node.objgen)
            nodes += [(kid, box) for kid in reversed(list(node.Kids))]


def _limit_streams() -> None:
    """Limit the memory that a stream may take; old versions of pikepdf have no limits."""
    if hasattr(pikepdf.settings, "set_qpdf_limits"):
        pikepdf.settings.set_qpdf_limits(
            flate_max_memory=MAX_STREAM_BYTES,
            png_max_memory=MAX_STREAM_BYTES,
            tiff_max_memory=MAX_STREAM_BYTES,
            run_length_max_memory=MAX_STREAM_BYTES,
            dct_max_memory=MAX_STREAM_BYTES,
        )


def _encrypted(path: str | os.PathLike[str]) -> FormatError:
    return FormatError(
        "an encrypted PDF",
        file=path,
        hint="Save it without password and restrictions, as with `qpdf --decrypt IN.pdf OUT.pdf`",
    )


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
