"""Black below the dots is found where a printer would print it, by Ghostscript's black plate."""

from __future__ import annotations

import io
import shutil
import tracemalloc
import zlib
from collections import Counter
from pathlib import Path

import pikepdf
import pypdfium2
import pytest
from pikepdf import Array, Dictionary, Name, Pdf, Rectangle

from locatk.formats.benchmarks.dots.rasterisers import rasterise_inks
from locatk.formats.printing.overlay import overlay
from locatk.formats.printing.separation import detection
from locatk.formats.printing.separation.content import rewrite_colours
from locatk.formats.printing.separation.detection import BlackFinder

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

    fade = Dictionary(FunctionType=2, Domain=[0, 1], C0=[100, 0, 0], C1=[0, 0, 0], N=1)
    blush = Dictionary(FunctionType=2, Domain=[0, 1], C0=[100, 0, 0], C1=[60, 60, 30], N=1)
    lab = Array([Name.Lab, Dictionary(WhitePoint=[0.95, 1, 1.09], Range=[-100, 100, -100, 100])])
    nothing = Array([Name.Separation, Name("/None"), Name.DeviceCMYK, grow])
    ink_by_lab = Array([Name.Separation, Name.Night, lab, fade])
    table = pikepdf.String(bytes([255, 128, 128, 0, 128, 128]))
    few_lab = Array([Name.Indexed, lab, 1, table])
    on, off, member = layers(pdf)

    def shading(function: Dictionary, space: pikepdf.Object = Name.DeviceCMYK) -> Dictionary:
        return Dictionary(ShadingType=2, ColorSpace=space, Coords=[0, 0, 72, 0], Function=function)

    def form(content: bytes, **more: object) -> pikepdf.Object:
        made = pdf.make_stream(content)
        made.Subtype, made.BBox = Name.Form, Array([0, 0, 72, 72])
        for key, value in more.items():
            made[f"/{key}"] = value
        return made

    glyph = pdf.make_stream(b"500 0 0 0 500 500 d1 0 0 500 500 re f")
    drawn = Dictionary(
        Type=Name.Font, Subtype=Name.Type3, FontBBox=[0, 0, 500, 500], Resources=Dictionary(),
        FontMatrix=[0.001, 0, 0, 0.001, 0, 0], CharProcs=Dictionary(H=glyph),
        Encoding=Dictionary(Differences=[72, Name.H]), FirstChar=72, LastChar=72, Widths=[500],
    )  # fmt: skip
    tile = {"PatternType": 1, "TilingType": 1, "XStep": 8, "YStep": 8}
    mask = image(pdf, bytes([255, 0, 255, 0]), Name.DeviceGray)
    return Dictionary(
        ColorSpace=Dictionary(C=cyan, K=ink, Gold=gold, P=Array([Name.Pattern, Name.DeviceGray]),
                              Lab=lab, Nothing=nothing, Night=ink_by_lab, FewLab=few_lab),
        Shading=Dictionary(Light=shading(half), Dark=shading(grow), LabDark=shading(fade, lab),
                           LabLight=shading(blush, lab)),
        ExtGState=Dictionary(Faint=Dictionary(ca=0.01), Gone=Dictionary(ca=0, CA=0),
                             NoLine=Dictionary(CA=0), Half=Dictionary(ca=0.5),
                             Full=Dictionary(ca=1)),
        Properties=Dictionary(On=on, Off=off, Member=member),
        Pattern=Dictionary(
            Dark=form(b"0.2 g 0 0 4 4 re f", PaintType=1, Resources=Dictionary(), **tile),
            Light=form(b"1 0 0 rg 0 0 4 4 re f", PaintType=1, Resources=Dictionary(), **tile),
            Stencil=form(b"0 0 4 4 re f", PaintType=2, Resources=Dictionary(), **tile),
        ),
        Font=Dictionary(F=Dictionary(Type=Name.Font, Subtype=Name.Type1, BaseFont=Name.Helvetica),
                        Drawn=drawn),
        XObject=Dictionary(
            Inherits=form(b"0 0 50 50 re f"),
            Dark=form(b"0.3 g 0 0 50 50 re f"),
            Light=form(b"0 1 1 0 k 0 0 50 50 re f"),
            Opaque=form(b"/Full gs 0 g 0 0 50 50 re f",
                        Resources=Dictionary(ExtGState=Dictionary(Full=Dictionary(ca=1)))),
            Group=form(b"/Full gs 0 g 0 0 50 50 re f", Group=Dictionary(S=Name.Transparency),
                       Resources=Dictionary(ExtGState=Dictionary(Full=Dictionary(ca=1)))),
            GroupLine=form(b"0 0 50 50 re S", Group=Dictionary(S=Name.Transparency)),
            Moved=form(b"0 g 0 0 50 50 re f", Matrix=[1, 0, 0, 1, 99, 0]),
            Layer=form(b"0 g 0 0 50 50 re f", OC=off),
            LabDark=image(pdf, bytes([255, 128, 128] * 3 + [0, 128, 128]), lab),
            LabLight=image(pdf, bytes([255, 128, 128] * 3 + [160, 200, 160]), lab),
            NoInk=image(pdf, bytes([255] * 4), nothing),
            Cyan=image(pdf, bytes([255] * 4), cyan),
            Inked=image(pdf, bytes([0, 0, 0, 255]), ink),
            Photo=image(pdf, bytes([250, 200, 200] * 3 + [20, 10, 10]), Name.DeviceRGB),
            Pink=image(pdf, bytes([250, 200, 200] * 4), Name.DeviceRGB),
            Plates=image(pdf, bytes([9, 9, 9, 0] * 3 + [0, 0, 0, 99]), Name.DeviceCMYK),
            Colours=image(pdf, bytes([200, 99, 9, 0] * 4), Name.DeviceCMYK),
            Hidden=image(
                pdf, bytes([250, 200, 200, 0, 0, 0] * 2), Name.DeviceRGB, SMask=mask
            ),
        ),
    )  # fmt: skip


def layers(pdf: Pdf) -> tuple[pikepdf.Object, pikepdf.Object, pikepdf.Object]:
    """A layer that is printed, one that is not, and a membership of the latter."""
    on, off = (pdf.make_indirect(Dictionary(Type=Name.OCG, Name=name)) for name in ("on", "off"))
    pdf.Root.OCProperties = Dictionary(
        OCGs=Array([on, off]), D=Dictionary(BaseState=Name.ON, OFF=Array([off]))
    )
    return on, off, pdf.make_indirect(Dictionary(Type=Name.OCMD, OCGs=Array([off])))


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
    "BT 0 Tr /Drawn 60 Tf 5 5 Td (H) Tj ET": True,
    "BT 1 Tr /Drawn 60 Tf 5 5 Td (H) Tj ET": True,
    "BT 3 Tr /Drawn 60 Tf 5 5 Td (H) Tj ET": False,
    "1 0 0 rg BT /Drawn 60 Tf 5 5 Td (H) Tj ET": False,
    "q 9 0 0 9 0 0 cm BI /W 1 /H 1 /CS /G /BPC 8 ID \x10 EI Q": True,
    "q 9 0 0 9 0 0 cm BI /W 1 /H 1 /CS /RGB /BPC 8 ID \xf0\x80\x80 EI Q": False,
    "q 9 0 0 9 0 0 cm BI /W 1 /H 1 /IM true /BPC 1 /D [1 0] ID \xf0 EI Q": True,
    "/Lab cs 0 0 0 scn 0 0 50 50 re f": True,
    "/Lab cs 0 0 50 50 re f": True,
    "/Lab CS 30 2 1 SCN 0 0 50 50 re S": True,
    "/Lab cs 100 0 0 scn 0 0 50 50 re f": False,
    "/Lab cs 60 70 40 scn 0 0 50 50 re f": False,
    "/FewLab cs 1 scn 0 0 50 50 re f": True,
    "/FewLab cs 0 scn 0 0 50 50 re f": False,
    "/LabDark sh": True,
    "/LabLight sh": False,
    "q 50 0 0 50 0 0 cm /LabDark Do Q": True,
    "q 50 0 0 50 0 0 cm /LabLight Do Q": False,
    "q 50 0 0 50 0 0 cm /Cyan Do Q": False,
    "q 50 0 0 50 0 0 cm /Inked Do Q": True,
    # What is not printed.
    "/Nothing cs 1 scn 0 0 50 50 re f": False,
    "q 50 0 0 50 0 0 cm /NoInk Do Q": False,
    "/Faint gs 0 0 50 50 re f": False,
    "/Faint gs 0 0 50 50 re S": True,
    "q /Faint gs Q 0 0 50 50 re f": True,
    "/Gone gs 0 0 50 50 re B": False,
    "/Gone gs /Dark sh": False,
    "/Gone gs BT 2 Tr /F 30 Tf 5 5 Td (H) Tj ET": False,
    "/Gone gs q 50 0 0 50 0 0 cm /Photo Do Q": False,
    "/Gone gs /Dark Do": False,
    "/Gone gs /Opaque Do": True,
    "/Gone gs /Group Do": False,
    "/NoLine gs /GroupLine Do": True,
    "/Half gs 0 0 50 50 re f": True,
    "/OC /Off BDC 0 0 50 50 re f EMC": False,
    "/OC /Off BDC EMC 0 0 50 50 re f": True,
    "/OC /Off BDC 1 0 0 rg EMC 0 0 50 50 re f": False,
    "/OC /On BDC 0 0 50 50 re f EMC": True,
    "/OC /Member BDC 0 0 50 50 re f EMC": False,
    "80 80 20 20 re f": False,
    "80 80 -20 -20 re f": True,
    "0 0 9 9 re n 80 80 20 20 re f": False,
    "-9 30 m 80 90 l 99 30 l f": True,
    "1 0 0 1 -60 0 cm 0 0 50 50 re f": False,
    "-10 0 m -10 72 l S": False,
    "40 w -10 0 m -10 72 l S": True,
    "q 50 0 0 50 0 80 cm /Photo Do Q": False,
    "q 50 0 0 50 0 -20 cm /Photo Do Q": True,
    "q 9 0 0 9 80 0 cm BI /W 1 /H 1 /CS /G /BPC 8 ID \x10 EI Q": False,
    "/Moved Do": False,
    "1 0 0 1 -99 0 cm /Moved Do": True,
    "BT /F 30 Tf 5 200 Td (H) Tj ET": False,
    "BT /F 30 Tf 5 -5 Td (H) Tj ET": True,
    "BT /F 30 Tf 1 0 0 1 5 200 Tm 0 -195 Td (H) Tj ET": True,
    "BT /F 1 Tf 30 0 0 30 5 -70 Tm (H) Tj ET": False,
    "BT /F 30 Tf 195 TL 5 200 Td T* (H) Tj ET": True,
}
"""Content of a page, and whether it is printed with black ink."""


OTHER_CASES = {
    "/Night cs 1 scn 0 0 50 50 re f": True,
    "/Night cs 0 scn 0 0 50 50 re f": False,
    "/OC /Off BDC /A BMC EMC 0 0 50 50 re f EMC": False,
    "/Layer Do": False,
}
"""The same where Ghostscript 10.00 differs: it prints spot colours with inks of their own, takes
the first ``EMC`` for the end of a layer, and prints forms of hidden layers. poppler, MuPDF and
pdfium do not."""


def document(path: Path, contents: list[str]) -> Path:
    pdf = Pdf.new()
    shared = pdf.make_indirect(resources(pdf))
    for content in contents:
        page = pdf.add_blank_page(page_size=(SIZE, SIZE)).obj
        page.Resources = shared
        page.Contents = pdf.make_stream(content.encode("latin-1"))
    path.write_bytes(bytes_of(pdf))
    return path


@pytest.mark.parametrize(("content", "is_black"), [*CASES.items(), *OTHER_CASES.items()])
def test_black_is_found(tmp_path: Path, content: str, is_black: bool) -> None:
    source = document(tmp_path / "in.pdf", [content])
    assert overlay(source, stamp(1), strip_black=False).black_pages == is_black


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


@pytest.mark.parametrize(
    ("policy", "hidden_of"),
    [
        (None, ["off"]),
        ("/AnyOn", ["off"]),
        ("/AllOn", ["off", "both"]),
        ("/AnyOff", ["on"]),
        ("/AllOff", ["on", "both"]),
    ],
)
def test_memberships_of_layers(policy: str | None, hidden_of: list[str]) -> None:
    """See ISO 32000-1, table 99."""
    pdf = Pdf.new()
    on, off, _ = layers(pdf)
    finder = BlackFinder(pdf)
    for name, groups in {"on": [on], "off": [off], "both": [on, off], "none": []}.items():
        member = Dictionary(Type=Name.OCMD, OCGs=Array(groups))
        if policy is not None:
            member.P = Name(policy)
        assert finder.is_hidden(member) == (name in hidden_of), name
    pdf.Root.OCProperties.D = Dictionary(BaseState=Name.OFF, ON=Array([off]))
    assert [BlackFinder(pdf).is_hidden(layer) for layer in (on, off)] == [True, False]


def test_layers_for_the_screen_are_printed(tmp_path: Path) -> None:
    """Their state on paper is another one, of which the search knows nothing."""
    pdf = Pdf.open(document(tmp_path / "in.pdf", ["/Layer Do", "/OC /Off BDC 0 0 9 9 re f EMC"]))
    default = pdf.Root.OCProperties.D
    default.AS = Array(
        [Dictionary(Event=Name.Print, Category=Array([Name.Print]), OCGs=default.OFF)]
    )
    (tmp_path / "changed.pdf").write_bytes(bytes_of(pdf))
    assert overlay(tmp_path / "changed.pdf", stamp(2), strip_black=False).black_pages == 2


def test_comments_on_hidden_layers_are_left_out(tmp_path: Path) -> None:
    """Their layer is lost when they become part of the page."""
    pdf = Pdf.open(document(tmp_path / "in.pdf", ["", ""]))
    for page, layer in zip(pdf.pages, pdf.Root.OCProperties.OCGs, strict=True):
        drawn = pdf.make_stream(b"0 g 0 0 50 50 re f")
        drawn.Type, drawn.Subtype, drawn.BBox = Name.XObject, Name.Form, Array([0, 0, 50, 50])
        comment = Dictionary(Type=Name.Annot, Subtype=Name.Stamp, Rect=[0, 0, 50, 50], F=4,
                             AP=Dictionary(N=pdf.make_indirect(drawn)), OC=layer)  # fmt: skip
        page.obj.Annots = Array([comment])
    (tmp_path / "comments.pdf").write_bytes(bytes_of(pdf))
    result = overlay(tmp_path / "comments.pdf", stamp(2), strip_black=False)
    assert (result.black_pages, result.dropped) == (1, 0)
    on, off = pypdfium2.PdfDocument(result.data)
    assert on.render(grayscale=True).to_numpy().min() < 100
    assert off.render(grayscale=True).to_numpy().min() == 255


def test_only_the_visible_part_of_a_page_counts(tmp_path: Path) -> None:
    """Also below comments, with which the content becomes a part of the page."""
    contents = ["0 40 72 32 re f", "0 40 72 32 re f", "0 0 72 72 re f"]
    pdf = Pdf.open(document(tmp_path / "in.pdf", contents))
    for page in pdf.pages:
        page.obj.CropBox = Array([0, 0, 72, 36])
    pdf.pages[1].obj.Annots = Array([Dictionary(Subtype=Name.Link, Rect=[0, 0, 9, 9])])
    (tmp_path / "cropped.pdf").write_bytes(bytes_of(pdf))
    below = Pdf.new()
    for _ in range(3):
        below.add_blank_page(page_size=(72, 36))
    found = overlay(tmp_path / "cropped.pdf", bytes_of(below), strip_black=False)
    assert found.black_pages == 1


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
    contents = [
        "0 0 9 9 re f (((",
        "1 0 0 rg 0 0 9 9 re f (((",
        "cs scn /None Do /F Tf BT",
        "() w 1 cm re /Half gs 0 0 9 9 re f",
        "(a) rg /Gold cs (b) sc /None gs BDC 1 0 0 rg 0 0 9 9 re f",
    ]
    source = document(tmp_path / "in.pdf", contents)
    assert overlay(source, stamp(5), strip_black=False).black_pages == 2


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
    assert overlay(tmp_path / "in.pdf", stamp(1), strip_black=False).black_pages == 1
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


def form(pdf: Pdf, content: bytes, **objects: pikepdf.Object) -> pikepdf.Object:
    made = pdf.make_stream(content)
    made.Type, made.Subtype, made.BBox = Name.XObject, Name.Form, Array([0, 0, 9, 9])
    made.Resources = Dictionary(XObject=Dictionary(**objects))
    return pdf.make_indirect(made)


PAGE = Rectangle(0, 0, 100, 100)


def test_forms_that_are_nested_too_deeply_count_as_black() -> None:
    pdf = Pdf.new()
    nested = form(pdf, b"")
    for _ in range(10):
        nested = form(pdf, b"/Inner Do", Inner=nested)
    assert not BlackFinder(pdf).is_black(nested, PAGE)
    for _ in range(1000):
        nested = form(pdf, b"/Inner Do", Inner=nested)
    assert BlackFinder(pdf).is_black(nested, PAGE)


def test_the_search_ends_at_black_and_after_many_instructions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pdf = Pdf.new()
    monkeypatch.setattr(detection, "MAX_INSTRUCTIONS", 100)
    assert not BlackFinder(pdf).is_black(form(pdf, b"q Q " * 50), PAGE)
    assert BlackFinder(pdf).is_black(form(pdf, b"q Q " * 51), PAGE)
    finder = BlackFinder(pdf)
    assert finder.is_black(form(pdf, b"0 g 0 0 9 9 re f " + b"q Q " * 1000), PAGE)
    assert finder._instructions == 3


@pytest.mark.slow
def test_compressed_content_takes_little_memory() -> None:
    pdf = Pdf.new()
    content = form(pdf, b"q Q " * 30_000)
    tracemalloc.start()
    assert not BlackFinder(pdf).is_black(content, PAGE)
    converted = rewrite_colours(content, lambda _: None, lambda _: None, lambda _: Name.I,
                                Counter(), starts=True)  # fmt: skip
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert converted.count(b"q") == 30_000
    assert peak < 4e6


def test_a_form_is_judged_by_the_page_on_which_it_is_drawn() -> None:
    """Pages of equal size may be at different places in the units of a common form."""
    pdf = Pdf.new()
    shared = form(pdf, b"0 g 110 110 9 9 re f")
    finder = BlackFinder(pdf)
    assert not finder.is_black(shared, PAGE)
    assert finder.is_black(shared, Rectangle(100, 100, 200, 200))


def test_a_damaged_start_of_marked_content_has_its_end(tmp_path: Path) -> None:
    content = "/OC /Off BDC BDC EMC 0 g 0 0 9 9 re f EMC"
    pdf = Pdf.open(document(tmp_path / "in.pdf", [content, content]))
    (tmp_path / "saved.pdf").write_bytes(bytes_of(pdf))
    assert overlay(tmp_path / "saved.pdf", stamp(2), strip_black=False).black_pages == 0


@pytest.mark.parametrize(("pixel", "is_black"), [(b"\xff\xff\xff\0", False), (b"\0\0\0\xff", True)])
def test_masked_images_of_inks(pixel: bytes, is_black: bool) -> None:
    pdf = Pdf.new()
    mask = pdf.make_indirect(image(pdf, b"\xff" * 4, Name.DeviceGray))
    photo = pdf.make_indirect(image(pdf, pixel * 4, Name.DeviceCMYK, SMask=mask))
    drawn = form(pdf, b"9 0 0 9 0 0 cm /Photo Do", Photo=photo)
    assert BlackFinder(pdf).is_black(drawn, PAGE) == is_black
