"""Dots over a document: exactly placed, the only black there is, and nothing lost in silence."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pikepdf
import pypdfium2
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pikepdf import Array, Dictionary, Name, Pdf, Stream
from reportlab.pdfgen.canvas import Canvas

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.formats.printing.overlay import OverlaidDocument, overlay, page_sizes

WIDTH, HEIGHT = 384.0, 288.0
"""Points: 800 x 600 px of 150 dpi."""

SCALE = 150 / 72
STEP = 24

FAR = 80
"""By how much a colour may change at most: black becomes 57, grey of 50 % becomes pink."""

PURE_BLACK = 46
"""Brightest channel of a pixel: K alone is 35 in pdfium, cyan, magenta and yellow 57."""


def stamp(*sizes: tuple[float, float]) -> bytes:
    """A page each with squares of 4 x 4 px, black and overprinting, and a word."""
    stream = io.BytesIO()
    canvas = Canvas(stream, invariant=1)
    for width, height in sizes or ((WIDTH, HEIGHT),):
        canvas.setPageSize((width, height))
        canvas.setFillColorCMYK(0, 0, 0, 1)
        canvas.setFillOverprint(True)
        for x in range(0, int(width), STEP):
            for y in range(0, int(height), STEP):
                canvas.rect(x, y, 1.92, 1.92, stroke=0, fill=1)
        canvas.drawString(STEP + 4, 4, "up")
        canvas.showPage()
    canvas.save()
    return stream.getvalue()


def blank() -> bytes:
    """An empty page."""
    return Maker().written(b"")


def shown(source: Any, page: int = 0, scale: float = SCALE) -> NDArray[np.uint8]:
    """The page as a viewer shows it, RGB."""
    bitmap = pypdfium2.PdfDocument(source)[page].render(scale=scale, rev_byteorder=True)
    return bitmap.to_numpy()[..., :3]


def only_dots_are_black(picture: NDArray[np.uint8], stamps: NDArray[np.uint8]) -> bool:
    """Whether pure black is where the stamp has it, and nowhere else."""
    black = picture.max(axis=2) < PURE_BLACK
    return bool(((stamps.max(axis=2) < PURE_BLACK) == black).all())


class Maker:
    """A document of one page that is written by hand."""

    def __init__(self) -> None:
        self.pdf = Pdf.new()
        self.pdf.add_blank_page(page_size=(WIDTH, HEIGHT))
        self.page = self.pdf.pages[0].obj
        self.page.Resources = Dictionary()

    def stream(self, data: bytes, **entries: Any) -> pikepdf.Object:
        made = Stream(self.pdf, data)
        for key, value in entries.items():
            made["/" + key] = value
        return self.pdf.make_indirect(made)

    def image(self, data: bytes, space: Any, bits: int = 8, **more: Any) -> pikepdf.Object:
        if space is not None:
            more["ColorSpace"] = space
        return self.stream(
            data, Subtype=Name.Image, Width=64, Height=64, BitsPerComponent=bits, **more
        )

    def form(self, data: bytes, **more: Any) -> pikepdf.Object:
        return self.stream(data, Subtype=Name.Form, BBox=Array([0, 0, 400, 300]), **more)

    def add(self, kind: str, **items: Any) -> None:
        held = self.page.Resources.get("/" + kind, Dictionary())
        for name, item in items.items():
            held["/" + name] = item
        self.page.Resources["/" + kind] = held

    def written(self, content: bytes) -> bytes:
        self.page.Contents = self.pdf.make_stream(content)
        target = io.BytesIO()
        self.pdf.save(target)
        return target.getvalue()

    def save(self, path: Path, content: bytes) -> Path:
        path.write_bytes(self.written(content))
        return path


def drawing(path: Path, pages: int = 1) -> Path:
    """Text, shapes, a picture and a form, as programs write them."""
    canvas = Canvas(str(path), pagesize=(WIDTH, HEIGHT), invariant=1)
    canvas.beginForm("badge")
    canvas.setFillColorRGB(0.1, 0.1, 0.1)
    canvas.rect(0, 0, 60, 20, stroke=1, fill=1)
    canvas.endForm()
    for number in range(pages):
        canvas.drawString(30, 250, f"Black text of page {number}, in no colour at all")
        canvas.setFillGray(0.4)
        canvas.rect(30, 180, 60, 40, fill=1)
        canvas.setFillColorRGB(0.6, 0.2, 0.1)
        canvas.circle(150, 200, 25, fill=1)
        canvas.setFillColorCMYK(0.2, 0.1, 0, 0.7)
        canvas.rect(200, 180, 60, 40, fill=1)
        canvas.saveState()
        canvas.translate(280, 190)
        canvas.doForm("badge")
        canvas.restoreState()
        canvas.showPage()
    canvas.save()
    return path


def streams_below(holder: Any, seen: set[Any]) -> Iterator[Any]:
    """All that the resources of ``holder`` lead to."""
    resources = holder.get("/Resources")
    if resources is None:
        return
    for kind in ("/XObject", "/Pattern", "/Shading", "/Font"):
        for _, item in resources.get(kind, Dictionary()).items():
            if item.objgen not in seen or item.objgen == (0, 0):
                seen.add(item.objgen)
                yield item
                yield from streams_below(item, seen)
                yield from (glyph for _, glyph in item.get("/CharProcs", Dictionary()).items())


def names_of_inks(space: Any) -> str:
    if isinstance(space, Array) and str(space[0]) == "/Indexed":
        table = bytes(space[3])
        assert str(space[1]) == "/DeviceCMYK"
        assert set(table[3::4]) <= {0}
        return "CMY"
    if isinstance(space, Array) and str(space[0]) == "/DeviceN":
        return "".join(str(name)[1] for name in space[1])
    return str(space)


def test_the_documents_black_is_gone_and_its_look_is_not(tmp_path: Path) -> None:
    document = drawing(tmp_path / "in.pdf")
    kept = overlay(document, stamp(), strip_black=False)
    made = overlay(document, stamp(), strip_black=True)
    assert (made.pages, made.left_black, made.dropped) == (1, {}, 0)
    before, plain, after = shown(document), shown(kept.data), shown(made.data)
    dots = shown(stamp())
    assert not only_dots_are_black(plain, dots)
    assert only_dots_are_black(after, dots)
    # The same shapes in nearly the same colours; where there was nothing there is nothing.
    elsewhere = dots.min(axis=2) == 255
    assert (after[elsewhere & (before.min(axis=2) == 255)] == 255).all()
    off = np.abs(after.astype(int) - before)[elsewhere]
    assert off.max() < FAR
    assert off.mean() < 6
    assert (plain[elsewhere] == before[elsewhere]).all()


def test_everything_that_has_a_colour_is_converted(tmp_path: Path) -> None:
    make = Maker()
    y, x = np.mgrid[0:64, 0:64]
    photo = np.stack([4 * x, 4 * y, 2 * (x + y)], axis=2).astype(np.uint8)
    grey = (4 * x).astype(np.uint8)
    inks = np.stack([4 * x, 4 * y, 0 * x, 25 * (x // 8)], axis=2).astype(np.uint8)
    chess = np.packbits((x // 8 + y // 8) % 2).tobytes()
    files = [cv2.imencode(kind, array)[1].tobytes() for kind, array in
             ((".jpg", photo), (".jpg", grey), (".jp2", photo))]  # fmt: skip
    jpeg, jpeg_2000 = Name.DCTDecode, Name.JPXDecode
    palette = pikepdf.String(bytes(range(0, 240, 5)))
    black_ink = Array(
        [
            Name.Separation,
            Name.Black,
            Name.DeviceGray,
            Dictionary(
                FunctionType=2, Domain=Array([0, 1]), C0=Array([1]), C1=Array([0]), N=1
            ),
        ]
    )  # fmt: skip
    images = [
        make.image(photo.tobytes(), Name.DeviceRGB),
        make.image(zlib.compress(grey.tobytes()), Name.DeviceGray, Filter=Name.FlateDecode),
        make.image(inks.tobytes(), Name.DeviceCMYK),
        make.image(files[0], Name.DeviceRGB, Filter=jpeg),
        make.image(files[1], Name.DeviceGray, Filter=jpeg, Decode=Array([1, 0])),
        make.image(files[2], None, Filter=jpeg_2000),
        make.image(chess, Name.DeviceGray, 1, Decode=Array([1, 0])),
        make.image((x // 4).astype(np.uint8).tobytes(),
                   Array([Name.Indexed, Name.DeviceRGB, 15, palette])),
        make.image((257 * grey.astype(">u2")).astype(">u2").tobytes(), Name.DeviceGray, 16),
        make.image(photo.tobytes(), Name.DeviceRGB, Mask=Array([0, 99, 0, 255, 0, 255])),
        make.image(photo.tobytes(), Name.DeviceRGB,
                   SMask=make.image(grey.tobytes(), Name.DeviceGray)),
        make.image(grey.tobytes(), black_ink),
    ]  # fmt: skip
    make.add("XObject", **{f"I{k}": image for k, image in enumerate(images)})
    lines = [f"q 40 0 0 40 {4 + k % 8 * 46} {240 - k // 8 * 46} cm /I{k} Do Q"
             for k in range(len(images))]  # fmt: skip
    in_rgb = Dictionary(S=Name.Transparency, CS=Name.DeviceRGB)
    boxes = b"0 0 40 20 re f 0 g 50 0 20 20 re f 0.3 G 80 2 20 15 re S "
    boxes += b"q 9 0 0 9 0 25 cm BI /W 1 /H 1 /CS /RGB /BPC 8 ID \x05\x05\x05 EI Q"
    make.add("XObject", F=make.form(boxes, Group=in_rgb))
    box = Array([0, 0, 8, 8])
    tile = {"PatternType": 1, "TilingType": 1, "BBox": box, "XStep": 8, "YStep": 8}
    rise = Dictionary(
        FunctionType=2, Domain=Array([0, 1]), C0=Array([0, 0, 0]), C1=Array([1, 1, 0]), N=1
    )
    shading = Dictionary(
        ShadingType=2, ColorSpace=Name.DeviceRGB, Coords=Array([0, 0, 60, 0]), Function=rise
    )
    make.add(
        "Pattern",
        Own=make.stream(
            b"0 0 4 4 re f 0.5 g 4 4 4 4 re f q 4 0 0 4 4 0 cm "
            b"BI /W 1 /H 1 /CS /G /BPC 8 /F /AHx ID 40> EI Q",
            PaintType=1,
            **tile,
        ),
        Stencil=make.stream(b"0 0 4 4 re f", PaintType=2, **tile),
        Ramp=Dictionary(PatternType=2, Shading=shading, Matrix=Array([1, 0, 0, 1, 200, 0])),
    )
    make.add("Shading", Ramp=shading)
    make.add("ColorSpace", Grey=Array([Name.Pattern, Name.DeviceGray]), Ink=black_ink,
             Cal=Array([Name.CalGray, Dictionary(WhitePoint=Array([0.95, 1, 1.09]))]))  # fmt: skip
    make.add("Font", T=Dictionary(
        Type=Name.Font, Subtype=Name.Type3, FontBBox=Array([0, 0, 1, 1]), FirstChar=97, LastChar=98,
        FontMatrix=Array([1, 0, 0, 1, 0, 0]), Widths=Array([1, 1]), Resources=Dictionary(),
        Encoding=Dictionary(Differences=Array([97, Name.a, Name.b])),
        CharProcs=Dictionary(a=make.stream(b"1 0 d0 0.2 g 0 0 .8 .8 re f"),
                             b=make.stream(b"1 0 0 0 1 1 d1 0 0 .8 .8 re f"))))  # fmt: skip
    lines += [
        "q 1 0 0 1 4 150 cm /F Do Q 0.2 g 0.1 G q 1 0 0 1 120 150 cm /F Do Q",
        "/Pattern cs /Own scn 4 110 40 30 re f /Grey cs 0.2 /Stencil scn 50 110 40 30 re f",
        "/Pattern cs /Ramp scn 200 110 60 30 re f q 1 0 0 1 280 110 cm 0 0 60 30 re W n /Ramp sh Q",
        "/Ink cs 1 scn 4 70 30 30 re f 0.6 scn 40 70 30 30 re f /Cal cs 80 70 30 30 re f 0.4 sc",
        "120 70 30 30 re f /DeviceRGB CS 3 w 160 70 30 30 re S",
        "0.9 g BT /T 20 Tf 200 70 Td (ab) Tj ET",
        "q 30 0 0 30 260 70 cm BI /W 2 /H 2 /CS /G /BPC 8 ID \x01\x80\xff\x40 EI Q",
    ]  # fmt: skip
    make.page.Group = in_rgb
    document = make.save(tmp_path / "in.pdf", "\n".join(lines).encode("latin-1"))
    made = overlay(document, stamp(), strip_black=True)
    assert made.left_black == {}
    dots, before, after = shown(stamp()), shown(document), shown(made.data)
    assert only_dots_are_black(after, dots)
    elsewhere = dots.min(axis=2) == 255
    assert np.abs(after.mean(axis=2) - before.mean(axis=2))[elsewhere].max() < 90
    assert np.abs(after.mean(axis=2) - before.mean(axis=2))[elsewhere].mean() < 14
    with pikepdf.open(io.BytesIO(made.data)) as pdf:
        page = pdf.pages[0].obj
        assert "/Group" not in page
        below = page.Resources.XObject.Below
        assert below.Group.CS == "/DeviceCMYK"
        found = [below, *streams_below(below, set())]
        assert len(found) > 20
        for item in found:
            if isinstance(item, Stream) and item.get("/Subtype") == "/Image":
                assert names_of_inks(item.ColorSpace) == "CMY"
            elif isinstance(item, Stream) and "/ShadingType" not in item:
                for operands, operator in pikepdf.parse_content_stream(item):
                    assert str(operator) not in {"g", "G", "rg", "RG", "sc", "SC"}
                    if str(operator) in {"k", "K"}:
                        assert float(operands[3]) == 0


def test_what_stays_black_is_told(tmp_path: Path) -> None:
    make = Maker()
    lab = Array([Name.Lab, Dictionary(WhitePoint=Array([0.95, 1, 1.09]))])
    formula = make.stream(
        b"{2 copy mul}", FunctionType=4, Domain=Array([0, 1] * 2), Range=Array([0, 1] * 3)
    )
    spot = make.stream(b"{0 0 3 -1 roll 0 exch}", FunctionType=4,
                       Domain=Array([0, 1]), Range=Array([0, 1] * 4))  # fmt: skip
    night = Dictionary(FunctionType=2, Domain=[0, 1], C0=[100, 0, 0], C1=[0, 0, 0], N=1)
    make.add(
        "ColorSpace",
        L=lab,
        S=Array([Name.Separation, Name.Gold, Name.DeviceCMYK, spot]),
        N=Array([Name.Separation, Name.Night, lab, night]),
    )
    make.add("Shading", F=Dictionary(ShadingType=1, ColorSpace=Name.DeviceRGB, Function=formula))
    make.add(
        "XObject", I=make.image(b"\x20" * 3 * 64 * 64, lab), J=make.image(b"short", Name.DeviceCMYK)
    )
    document = make.save(
        tmp_path / "in.pdf",
        b"/L cs 20 0 0 scn 9 9 9 9 re f /S cs 1 scn 30 9 9 9 re f /N cs 1 scn 9 30 9 9 re f "
        b"/F sh /I Do /J Do",
    )
    left = overlay(document, stamp(), strip_black=True).left_black
    assert left == {
        "colours in a spot or Lab colour space": 3,
        "images in a spot or Lab colour space": 1,
        "images that are cut short": 1,
        "shadings by a formula, or in a spot or Lab colour space": 1,
    }
    assert overlay(document, stamp(), strip_black=False).left_black == {}


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_images_of_any_depth_keep_their_colours(tmp_path: Path, bits: int) -> None:
    make = Maker()
    plates = np.random.default_rng(bits).integers(0, 1 << min(bits, 8), (64, 63, 4))
    plates[..., 3] = 0
    if bits == 16:
        plates *= 257  # others are rounded to 8 bits
    flags = plates[..., None] >> np.arange(bits)[::-1] & 1
    data = np.packbits(flags.astype(np.uint8).reshape(64, -1), axis=1).tobytes()
    image = make.image(data, Name.DeviceCMYK, bits)
    image.Width = 63
    make.add("XObject", I=image)
    document = make.save(tmp_path / "in.pdf", b"q 126 0 0 128 20 20 cm /I Do Q")
    result = overlay(document, blank(), strip_black=True)
    assert result.left_black == {}
    before, after = shown(document.read_bytes()), shown(result.data)
    assert before.min() < 60
    assert np.abs(before.astype(int) - after).max() <= 2


@pytest.mark.parametrize("box", [None, [0, 0, 99], [0, 0, "a", 99], [0, 0, 0, 99]])
def test_pages_without_a_size_are_refused(tmp_path: Path, box: list[Any] | None) -> None:
    """Programs assume different sizes for them; a sheet has only one."""
    make = Maker()
    make.pdf.add_blank_page(page_size=(WIDTH, HEIGHT))
    del make.pdf.pages[1].obj.MediaBox
    if box is not None:
        make.pdf.pages[1].obj.MediaBox = Array(box)
    document = make.save(tmp_path / "in.pdf", b"")
    for read in (page_sizes, lambda path: overlay(path, stamp(), strip_black=False)):
        with pytest.raises(FormatError, match="no valid size") as info:
            read(document)
        assert info.value.where == "page 2"
        assert info.value.hint


def test_sizes_are_inherited(tmp_path: Path) -> None:
    make = Maker()
    del make.page.MediaBox
    make.pdf.Root.Pages.MediaBox = Array([0, 0, 72, 144])
    assert page_sizes(make.save(tmp_path / "in.pdf", b"")) == [pytest.approx((25.4, 50.8))]


GREYS = st.sampled_from(["0", "0.25", "0.5", "1"])
COLOURS = st.one_of(
    st.tuples(GREYS, st.sampled_from("gG")).map(" ".join),
    st.tuples(GREYS, st.sampled_from(["rg", "RG"])).map(lambda v: f"{v[0]} {v[0]} {v[0]} {v[1]}"),
    st.tuples(GREYS, st.sampled_from("kK")).map(lambda v: f"0 0 0 {v[0]} {v[1]}"),
    st.tuples(st.sampled_from(["DeviceGray", "Cal"]), GREYS, st.sampled_from(["sc", "SCN"])).map(
        lambda v: f"/{v[0]} {'cs' if v[2].islower() else 'CS'} {v[1]} {v[2]}"
    ),
    st.sampled_from(["q", "Q", "/Form Do"]),
)


NOTHING = Maker().written(b"")
"""A stamp without a dot."""


@pytest.mark.slow
@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(COLOURS, max_size=12))
def test_any_order_of_colours_looks_the_same(tmp_path: Path, operators: list[str]) -> None:
    make = Maker()
    make.add("ColorSpace", Cal=Array([Name.CalGray, Dictionary(WhitePoint=Array([1, 1, 1]))]))
    make.add("XObject", Form=make.form(b"2 w 350 100 30 99 re B 0.5 g 350 9 30 60 re f"))
    lines = ["4 w"]
    for number, operator in enumerate(operators):
        lines += [operator, f"{5 + 25 * number} 150 15 50 re B"]
    document = make.save(tmp_path / "in.pdf", "\n".join(lines).encode())
    made = overlay(document, NOTHING, strip_black=True)
    assert made.left_black == {}
    before, after = shown(document, scale=0.5), shown(made.data, scale=0.5)
    assert after.max(axis=2).min() >= PURE_BLACK
    assert np.abs(after.astype(int) - before).max() < FAR


def test_a_colour_space_brings_its_black(tmp_path: Path) -> None:
    # As ISO 32000-1 8.6.5.6 has it; pdfium, which keeps the colour, cannot be asked.
    content = b"/DeviceRGB cs /DeviceGray CS 9 9 9 9 re B /Ink cs 9 9 9 9 re f"
    make = Maker()
    function = Dictionary(FunctionType=2, Domain=Array([0, 1]), C1=Array([0, 0, 0, 0.5]), N=1)
    function.C0 = Array([0, 0, 0, 0])
    make.add("ColorSpace", Ink=Array([Name.Separation, Name.Soot, Name.DeviceCMYK, function]))
    made = overlay(make.save(tmp_path / "in.pdf", content), NOTHING, strip_black=True)
    with pikepdf.open(io.BytesIO(made.data)) as pdf:
        below = pdf.pages[0].obj.Resources.XObject.Below
        told = [
            (str(operator), [float(value) for value in operands])
            for operands, operator in pikepdf.parse_content_stream(below)
            if str(operator) in "kK"
        ]
    black, half = [1, 1, 1, 0], [0.5, 0.5, 0.5, 0]
    assert told == [("k", black), ("K", black), ("k", black), ("K", black), ("k", half)]


@pytest.mark.slow
@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_a_stamp_lies_upright_on_what_is_seen(tmp_path: Path, rotation: int) -> None:
    path = drawing(tmp_path / "plain.pdf")
    turned = tmp_path / "turned.pdf"
    with pikepdf.open(path) as pdf:
        page = pdf.pages[0].obj
        page.MediaBox = Array([-50, -30, 400, 300])
        page.CropBox = Array([24, 12, 360, 288])
        page.Rotate = rotation
        page.UserUnit = 2
        pdf.save(turned)
    width, height = (672.0, 552.0) if rotation % 180 == 0 else (552.0, 672.0)
    (size,) = page_sizes(turned)
    assert size == pytest.approx((width * 25.4 / 72, height * 25.4 / 72))
    mark = stamp((width, height))
    made = overlay(turned, mark, strip_black=False)
    # pdfium does not know of a page's own unit.
    dots, before, after = shown(mark), shown(turned, scale=2 * SCALE), shown(made.data)
    assert before.shape == after.shape == dots.shape
    inked = dots.max(axis=2) < PURE_BLACK
    assert (after[inked].max(axis=1) < PURE_BLACK).all()
    elsewhere = dots.min(axis=2) == 255
    off = np.abs(after.astype(int) - before).max(axis=2)[elsewhere]
    assert (off > 40).mean() < 1e-3
    assert (off[before.min(axis=2)[elsewhere] < 255] < 40).mean() > 0.99


def test_the_stamp_is_untouched(tmp_path: Path) -> None:
    blank = Maker().save(tmp_path / "blank.pdf", b"")
    mark = stamp()
    for strip in (False, True):
        made = overlay(blank, mark, strip_black=strip)
        assert (shown(made.data) == shown(mark)).all()
        with pikepdf.open(io.BytesIO(made.data)) as pdf:
            assert pdf.Root.ViewerPreferences.PrintScaling == "/None"
            dots = pdf.pages[0].obj.Resources.XObject.Dots
            states = dots.Resources.ExtGState.items()
            assert any(bool(state.get("/op")) for _, state in states)
            with pikepdf.open(io.BytesIO(mark)) as alone:
                assert dots.read_bytes() == alone.pages[0].Contents.read_bytes()


def test_the_same_input_gives_the_same_small_file(tmp_path: Path) -> None:
    pages = 20
    document = drawing(tmp_path / "in.pdf", pages)
    mark = stamp(*[(WIDTH, HEIGHT)] * pages)
    steps: list[tuple[int, int]] = []
    made = overlay(document, mark, strip_black=True, progress=lambda *at: steps.append(at))
    assert made == overlay(document, mark, strip_black=True)
    assert made.pages == pages
    assert steps == [(n + 1, pages) for n in range(pages)]
    assert len(made.data) < 1.3 * (document.stat().st_size + len(mark))
    with pikepdf.open(io.BytesIO(made.data)) as pdf:
        fonts = {page.obj.Resources.XObject.Dots.Resources.Font.F1.objgen for page in pdf.pages}
        badges = {
            next(iter(page.obj.Resources.XObject.Below.Resources.XObject.items()))[1].objgen
            for page in pdf.pages
        }
    assert len(fonts) == len(badges) == 1
    for number in (0, 19):
        assert only_dots_are_black(shown(made.data, number), shown(mark, number))


def annotated(path: Path) -> Path:
    """A page that leaves a mess behind, with a comment that has a look and one without."""
    make = Maker()
    look = make.form(b"10 10 40 20 re f 0.5 G 3 w 2 2 56 36 re S", Resources=Dictionary())
    look.BBox = Array([0, 0, 60, 40])
    place = Array([96, 96, 156, 136])
    make.page.Annots = Array(
        [
            make.pdf.make_indirect(Dictionary(Type=Name.Annot, F=4, Rect=place, **more))
            for more in (
                {"Subtype": Name.Stamp, "AP": Dictionary(N=look)},
                {"Subtype": Name.Square},
                {"Subtype": Name.Link},
            )
        ]
    )
    return make.save(path, b"Q Q q 5 0 0 5 7 7 cm 0.9 g")


def test_comments_lie_below_the_dots(tmp_path: Path) -> None:
    document = annotated(tmp_path / "in.pdf")
    made = overlay(document, stamp(), strip_black=True)
    assert made.dropped == 1
    picture, dots = shown(made.data), shown(stamp())
    assert only_dots_are_black(picture, dots)
    inside = picture[600 - 260 : 600 - 225, 225:300]
    assert (inside.max(axis=2) < 80).mean() > 0.5
    with pikepdf.open(io.BytesIO(made.data)) as pdf:
        assert "/Annots" not in pdf.pages[0].obj


def test_masks_keep_their_meaning(tmp_path: Path) -> None:
    # One grey picture is both seen and the mask of another: only the first changes.
    make = Maker()
    ramp = make.image(np.repeat(np.arange(0, 256, 4, np.uint8), 64).tobytes(), Name.DeviceGray)
    veiled = make.image(b"\xff\x00\x00" * 64 * 64, Name.DeviceRGB, SMask=ramp)
    make.add("XObject", A=ramp, B=veiled)
    glow = make.form(b"0 g 0 0 400 300 re f 1 g 240 20 60 60 re f", Resources=Dictionary(),
                     Group=Dictionary(S=Name.Transparency, CS=Name.DeviceGray))  # fmt: skip
    make.add("ExtGState", M=Dictionary(SMask=Dictionary(S=Name.Luminosity, G=glow)))
    document = make.save(
        tmp_path / "in.pdf",
        b"q 60 0 0 60 20 20 cm /A Do Q q 60 0 0 60 120 20 cm /B Do Q /M gs 220 0 100 100 re f",
    )
    made = overlay(document, stamp(), strip_black=True)
    assert made.left_black == {}
    dots, before, after = shown(stamp()), shown(document), shown(made.data)
    assert only_dots_are_black(after, dots)
    elsewhere = dots.min(axis=2) == 255
    assert np.abs(after.astype(int) - before)[elsewhere].max() < FAR


def encrypted(path: Path, user: str) -> Path:
    with pikepdf.open(drawing(path.with_name("clear.pdf"))) as pdf:
        pdf.save(path, encryption=pikepdf.Encryption(owner="secret", user=user))
    return path


def test_bad_documents_are_refused_in_one_line(tmp_path: Path) -> None:
    good = drawing(tmp_path / "good.pdf").read_bytes()
    cut = tmp_path / "cut.pdf"
    cut.write_bytes(good[: len(good) // 2])
    text = tmp_path / "text.pdf"
    text.write_text("no PDF at all")
    broken = tmp_path / "broken.pdf"
    with pikepdf.open(io.BytesIO(good)) as pdf:
        stream = Stream(pdf, b"")
        stream.write(b"this was never deflated", filter=Name.FlateDecode, type_check=False)
        pdf.pages[0].obj.Contents = pdf.make_indirect(stream)
        pdf.save(broken, stream_decode_level=pikepdf.StreamDecodeLevel.none, compress_streams=False)
    bad = [cut, text, encrypted(tmp_path / "a.pdf", "user"), encrypted(tmp_path / "b.pdf", "")]
    for path in bad:
        for call in (page_sizes, lambda p: overlay(p, stamp(), strip_black=True)):
            with pytest.raises(FormatError) as caught:
                call(path)
            assert str(path) in str(caught.value)
            assert "\n" not in str(caught.value)
    for path, word in ((cut, "damaged"), (text, "not a PDF"), (bad[2], "encrypted")):
        with pytest.raises(FormatError, match=word):
            page_sizes(path)
    with pytest.raises(FormatError, match="damaged"):
        overlay(broken, stamp(), strip_black=True)
    with pytest.raises(MissingDataError):
        page_sizes(tmp_path / "none.pdf")


def test_stamps_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    document = drawing(tmp_path / "in.pdf", 2)
    with pytest.raises(InputError, match="1 pages cannot be drawn over 2"):
        overlay(document, stamp(), strip_black=False)
    with pytest.raises(InputError, match="page 2"):
        overlay(document, stamp((WIDTH, HEIGHT), (WIDTH, HEIGHT + 3)), strip_black=False)
    close = stamp((WIDTH + 0.1, HEIGHT), (WIDTH, HEIGHT - 0.1))
    assert isinstance(overlay(document, close, strip_black=False), OverlaidDocument)


def test_a_stream_larger_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not hasattr(pikepdf.settings, "set_qpdf_limits"):
        pytest.skip("this version of pikepdf has no limits")
    previous = pikepdf.settings.get_qpdf_limits()
    monkeypatch.setattr("locatk.formats.printing.overlay.MAX_STREAM_BYTES", 1 << 20)
    document = tmp_path / "bomb.pdf"
    with Pdf.new() as pdf:
        pdf.add_blank_page(page_size=(100, 100))
        packed = zlib.compress(zlib.compress(b" " * (8 << 20), 9), 9)
        content = Stream(pdf, packed)
        content.Filter = Array([Name.FlateDecode, Name.FlateDecode])
        pdf.pages[0].Contents = content
        pdf.save(document)
    try:
        with pytest.raises(FormatError, match=r"damaged PDF \(.*memory limit exceeded"):
            overlay(document, stamp((100, 100)), strip_black=True)
    finally:
        pikepdf.settings.set_qpdf_limits(**previous)
