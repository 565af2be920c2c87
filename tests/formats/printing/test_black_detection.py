"""Black below the dots is found where a printer would print it, by Ghostscript's black plate."""

from __future__ import annotations

import io
import shutil
import zlib
from pathlib import Path

import pikepdf
import pytest
from pikepdf import Array, Dictionary, Name, Pdf

from locatk.formats.benchmarks.dots.rasterisers import rasterise_inks
from locatk.formats.printing.overlay import overlay

SIZE = 72.0


def stamp(pages: int) -> bytes:
    pdf = Pdf.new()
    for _ in range(pages):
        pdf.add_blank_page(page_size=(SIZE, SIZE))
    return bytes_of(pdf)


def bytes_of(pdf: Pdf) -> bytes:
    target = io.BytesIO()
    pdf.save(target)
    return target.getvalue()


def image(pdf: Pdf, pixels: bytes, space: Name, side: int = 2, **more: object) -> pikepdf.Object:
    made = pdf.make_stream(zlib.compress(pixels), Filter=Name.FlateDecode)
    made.Type, made.Subtype, made.ColorSpace = Name.XObject, Name.Image, space
    made.Width, made.Height, made.BitsPerComponent = side, side, 8
    for key, value in more.items():
        made[f"/{key}"] = value
    return made


def resources(pdf: Pdf) -> Dictionary:
    """What the contents below use."""
    half = Dictionary(FunctionType=2, Domain=[0, 1], C0=[0, 0, 0, 0], C1=[1, 0, 0, 0], N=1)
    grow = Dictionary(FunctionType=2, Domain=[0, 1], C0=[0, 0, 0, 0], C1=[0, 0, 0, 1], N=1)
    cyan = Array([Name.Separation, Name.Cyan, Name.DeviceCMYK, half])
    ink = Array([Name.Separation, Name.Black, Name.DeviceCMYK, grow])
    gold = Array([Name.Separation, Name.Gold, Name.DeviceCMYK, half])

    def shading(function: Dictionary) -> Dictionary:
        return Dictionary(
            ShadingType=2, ColorSpace=Name.DeviceCMYK, Coords=[0, 0, 72, 0], Function=function
        )

    def form(content: bytes, **more: object) -> pikepdf.Object:
        made = pdf.make_stream(content)
        made.Subtype, made.BBox = Name.Form, Array([0, 0, 72, 72])
        for key, value in more.items():
            made[f"/{key}"] = value
        return made

    tile = {"PatternType": 1, "TilingType": 1, "XStep": 8, "YStep": 8}
    mask = image(pdf, bytes([255, 0, 255, 0]), Name.DeviceGray)
    return Dictionary(
        ColorSpace=Dictionary(C=cyan, K=ink, Gold=gold, P=Array([Name.Pattern, Name.DeviceGray])),
        Shading=Dictionary(Light=shading(half), Dark=shading(grow)),
        Pattern=Dictionary(
            Dark=form(b"0.2 g 0 0 4 4 re f", PaintType=1, Resources=Dictionary(), **tile),
            Light=form(b"1 0 0 rg 0 0 4 4 re f", PaintType=1, Resources=Dictionary(), **tile),
            Stencil=form(b"0 0 4 4 re f", PaintType=2, Resources=Dictionary(), **tile),
        ),
        Font=Dictionary(F=Dictionary(Type=Name.Font, Subtype=Name.Type1, BaseFont=Name.Helvetica)),
        XObject=Dictionary(
            Inherits=form(b"0 0 50 50 re f"),
            Dark=form(b"0.3 g 0 0 50 50 re f"),
            Light=form(b"0 1 1 0 k 0 0 50 50 re f"),
            Photo=image(pdf, bytes([250, 200, 200] * 3 + [20, 10, 10]), Name.DeviceRGB),
            Pink=image(pdf, bytes([250, 200, 200] * 4), Name.DeviceRGB),
            Plates=image(pdf, bytes([9, 9, 9, 0] * 3 + [0, 0, 0, 99]), Name.DeviceCMYK),
            Colours=image(pdf, bytes([200, 99, 9, 0] * 4), Name.DeviceCMYK),
            Hidden=image(
                pdf, bytes([250, 200, 200, 0, 0, 0] * 2), Name.DeviceRGB, SMask=mask
            ),
        ),
    )  # fmt: skip


CASES = {
    "": False,
    "0 0 50 50 re f": True,
    "0 0 50 50 re n": False,
    "0 0 50 50 re S": True,
    "1 g 0 0 50 50 re f": False,
    "1 g 0 0 50 50 re B": True,
    "1 g 1 G 0 0 50 50 re B": False,
    "0.5 g 0 0 50 50 re f": True,
    "0.99 g 0 0 50 50 re f": False,
    "0 0 0 rg 0 0 50 50 re f": True,
    "0.2 0.2 0.2 rg 0 0 50 50 re f": True,
    "1 0 0 rg 0 0 50 50 re f": False,
    "0.9 0.8 0.95 rg 0 0 50 50 re f": False,
    "0.1 0.05 0.02 rg 0 0 50 50 re f": True,
    "1 1 1 0 k 0 0 50 50 re f": False,
    "0 0 0 0.3 k 0 0 50 50 re f": True,
    "0 0 0 0.01 k 0 0 50 50 re f": False,
    "q 1 0 0 rg Q 0 0 50 50 re f": True,
    "1 0 0 rg q 0 g Q 0 0 50 50 re f": False,
    "/C cs 1 scn 0 0 50 50 re f": False,
    "/K cs 0.5 scn 0 0 50 50 re f": True,
    "/K cs 0 scn 0 0 50 50 re f": False,
    "/Pattern cs /Dark scn 0 0 50 50 re f": True,
    "/Pattern cs /Light scn 0 0 50 50 re f": False,
    "/P cs 0 /Stencil scn 0 0 50 50 re f": True,
    "/P cs 1 /Stencil scn 0 0 50 50 re f": False,
    "/Light sh": False,
    "/Dark sh": True,
    "/Inherits Do": True,
    "1 0 0 rg /Inherits Do": False,
    "1 0 0 rg /Dark Do": True,
    "/Light Do": False,
    "q 50 0 0 50 0 0 cm /Photo Do Q": True,
    "q 50 0 0 50 0 0 cm /Pink Do Q": False,
    "q 50 0 0 50 0 0 cm /Plates Do Q": True,
    "q 50 0 0 50 0 0 cm /Colours Do Q": False,
    "q 50 0 0 50 0 0 cm /Hidden Do Q": False,
    "BT /F 30 Tf 5 5 Td (H) Tj ET": True,
    "1 0 0 rg BT /F 30 Tf 5 5 Td (H) Tj ET": False,
    "1 0 0 rg BT 1 Tr /F 30 Tf 5 5 Td (H) Tj ET": True,
    "BT 3 Tr /F 30 Tf 5 5 Td (H) Tj ET": False,
    "q 9 0 0 9 0 0 cm BI /W 1 /H 1 /CS /G /BPC 8 ID \x10 EI Q": True,
    "q 9 0 0 9 0 0 cm BI /W 1 /H 1 /CS /RGB /BPC 8 ID \xf0\x80\x80 EI Q": False,
    "q 9 0 0 9 0 0 cm BI /W 1 /H 1 /IM true /BPC 1 /D [1 0] ID \xf0 EI Q": True,
}
"""Content of a page, and whether it is printed with black ink."""


def document(path: Path, contents: list[str]) -> Path:
    pdf = Pdf.new()
    shared = pdf.make_indirect(resources(pdf))
    for content in contents:
        page = pdf.add_blank_page(page_size=(SIZE, SIZE)).obj
        page.Resources = shared
        page.Contents = pdf.make_stream(content.encode("latin-1"))
    path.write_bytes(bytes_of(pdf))
    return path


@pytest.mark.parametrize("content", CASES)
def test_black_is_found(tmp_path: Path, content: str) -> None:
    source = document(tmp_path / "in.pdf", [content])
    assert overlay(source, stamp(1), strip_black=False).black_pages == CASES[content]


@pytest.mark.slow
def test_the_cases_are_those_of_a_printer(tmp_path: Path) -> None:
    """Whose plate of black ink is empty, or not, as Ghostscript separates the pages."""
    if shutil.which("gs") is None:
        pytest.skip("gs is not installed")
    source = document(tmp_path / "in.pdf", list(CASES))
    folder = tmp_path / "plates"
    folder.mkdir()
    for content, plates in zip(CASES, rasterise_inks(source, 36, folder), strict=True):
        black = 1 - plates["Black"].min() / 255
        assert (black > 0.04) == CASES[content], content


def test_pages_are_counted(tmp_path: Path) -> None:
    source = document(
        tmp_path / "in.pdf", ["0 0 9 9 re f", "", "/Dark Do", "/Dark Do", "/Light Do"]
    )
    assert overlay(source, stamp(5), strip_black=False).black_pages == 3
    # What is removed is not reported.
    assert overlay(source, stamp(5), strip_black=True).black_pages == 0


@pytest.mark.filterwarnings("error")
def test_damaged_content_is_no_error(tmp_path: Path) -> None:
    """Viewers draw what comes before the damage, and so does the search."""
    contents = ["0 0 9 9 re f (((", "1 0 0 rg 0 0 9 9 re f (((", "cs scn /None Do /F Tf BT"]
    source = document(tmp_path / "in.pdf", contents)
    assert overlay(source, stamp(3), strip_black=False).black_pages == 1


def test_nested_and_recursive_forms_end(tmp_path: Path) -> None:
    pdf = Pdf.new()
    page = pdf.add_blank_page(page_size=(SIZE, SIZE)).obj
    inner = pdf.make_stream(b"/Self Do /Self Do 1 0 0 rg 0 0 9 9 re f")
    inner.Subtype, inner.BBox = Name.Form, Array([0, 0, 72, 72])
    inner.Resources = Dictionary(XObject=Dictionary(Self=inner))
    for _ in range(3000):
        outer = pdf.make_stream(b"/Inner Do /Inner Do")
        outer.Subtype, outer.BBox = Name.Form, Array([0, 0, 72, 72])
        outer.Resources = Dictionary(XObject=Dictionary(Inner=inner))
        inner = outer
    page.Resources = Dictionary(XObject=Dictionary(Inner=inner))
    page.Contents = pdf.make_stream(b"/Inner Do")
    (tmp_path / "in.pdf").write_bytes(bytes_of(pdf))
    assert overlay(tmp_path / "in.pdf", stamp(1), strip_black=False).black_pages == 0
    assert overlay(tmp_path / "in.pdf", stamp(1), strip_black=True).left_black != {}


def test_huge_images_are_not_decoded(tmp_path: Path) -> None:
    pdf = Pdf.new()
    page = pdf.add_blank_page(page_size=(SIZE, SIZE)).obj
    page.Resources = Dictionary(
        XObject=Dictionary(I=image(pdf, b"\xff", Name.DeviceGray, side=60_000))
    )
    page.Contents = pdf.make_stream(b"q 9 0 0 9 0 0 cm /I Do Q")
    (tmp_path / "in.pdf").write_bytes(bytes_of(pdf))
    assert overlay(tmp_path / "in.pdf", stamp(1), strip_black=False).black_pages == 1
