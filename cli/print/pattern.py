"""``locatk print pattern``: sheets of dots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.core.errors import OutputExistsError

if TYPE_CHECKING:
    from locatk.core.dots.drawing.layout import SheetLayout
    from locatk.core.dots.drawing.tiles import SheetTiling
    from locatk.core.dots.sheet import Manifest

CODECS = ("anoto", "libdots", "microdots")
FORMATS = ("pdf", "png", "txt")
MOST_FILES = 200
"""Files of a run: each is open until all are whole."""
MOST_ROWS = 10


class Pair(click.ParamType):
    """Two whole numbers with something between them, as in ``3x2`` or ``1330,7200``."""

    def __init__(self, between: str, low: int) -> None:
        self.between, self.low = between, low
        self.name = f"a pair of numbers as in 3{between}2"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        parts = str(value).lower().split(self.between)
        if len(parts) != 2 or not all(p.strip().isascii() and p.strip().isdigit() for p in parts):
            self.fail(f"{value!r} is not {self.name}.", param, ctx)
        first, second = (int(part) for part in parts)
        if min(first, second) < self.low:
            self.fail(f"{value!r} has a number below {self.low}.", param, ctx)
        return first, second


@click.command(short_help="Sheets of dots that know where they are.")
@options.output("File to write; its manifest goes beside it as .toml.")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(FORMATS),
    help="`png`: 1 bit a pixel at the dpi. `txt`: a letter u, d, l or r a dot. With several "
    "sheets, a file each, named by its id.  [default: by the output's ending, else pdf]",
)
@click.option(
    "--size",
    default=None,
    metavar="PAPER",
    help="A0 to A5, Letter, Tabloid, or WxHmm as in 600x3000mm.  [default: A4]",
)
@click.option("--landscape/--portrait", default=None, help="Turn the paper.")
@click.option(
    "--pitch",
    "pitch_mm",
    type=float,
    default=0.508,
    show_default=True,
    metavar="MM",
    help="Between two dots; the nearest whole number of the printer's pixels is taken.",
)
@click.option(
    "--dpi",
    type=click.Choice(("300", "600", "1200")),
    default="300",
    show_default=True,
    help="Of the printer.",
)
@click.option(
    "--dot",
    "dot_mm",
    type=float,
    metavar="MM",
    help="Width of a dot, in whole pixels too.  [default: 1/6 of the pitch]",
)
@click.option(
    "--margin",
    "margin_mm",
    type=float,
    default=10.0,
    show_default=True,
    metavar="MM",
    help="Without dots; from 7 mm on it holds rulers and words.",
)
@click.option(
    "--count",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Sheets, each with an area of its own.",
)
@click.option(
    "--tiles",
    type=Pair("x", 1),
    metavar="CxR",
    help="One floor, cut over C papers across and R down, which share --overlap. Poses are "
    "in the floor's frame, the one of the lower left paper.",
)
@click.option(
    "--overlap",
    "overlap_mm",
    type=float,
    default=10.0,
    show_default=True,
    metavar="MM",
    help="What neighbouring tiles both hold; registration marks show where to cut.",
)
@options.input_option(
    "--overlay",
    metavar="FILE.pdf",
    help="Print over each page of this document; the pages set the papers' sizes.",
)
@click.option(
    "--strip-black",
    is_flag=True,
    help="Make the document's black of cyan, magenta and yellow, so that only dots are black.",
)
@click.option("--crop-marks", is_flag=True, help="Show where to cut the margin off.")
@click.option(
    "--marks/--no-marks", default=True, show_default=True, help="Rulers and words in the margin."
)
@click.option("--codec", type=click.Choice(CODECS), default=CODECS[0], show_default=True)
@click.option(
    "--origin",
    type=Pair(",", 0),
    metavar="X,Y",
    help="Grid coordinates of the upper left dot; further sheets follow to the right.  "
    "[default: the next area that is free in the ledger]",
)
@click.option(
    "--section", type=Pair(",", 0), default="0,0", show_default=True, metavar="U,V", help="0 to 62."
)
@click.option("--id", "name", help="Name of the sheet.  [default: its paper and a number]")
@click.option(
    "--ledger",
    type=options.PATH,
    envvar="LOCATK_LEDGER",
    show_envvar=True,
    metavar="FILE",
    help="Where the areas in use are written down.  [default: locatk-ledger.toml beside the "
    "output]",
)
@click.option("--force", is_flag=True, help="Use positions that another sheet has.")
@options.overwrite
@options.as_json
@options.verbosity
def pattern(
    output: Path,
    format_name: str | None,
    size: str | None,
    landscape: bool | None,
    pitch_mm: float,
    dpi: str,
    dot_mm: float | None,
    margin_mm: float,
    count: int,
    tiles: tuple[int, int] | None,
    overlap_mm: float,
    overlay: Path | None,
    strip_black: bool,
    crop_marks: bool,
    marks: bool,
    codec: str,
    origin: tuple[int, int] | None,
    section: tuple[int, int],
    name: str | None,
    ledger: Path | None,
    force: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw sheets of dots, on which a camera knows where it is.

    Dots lie exactly on the printer's pixels. Each sheet gets an area of the pattern that
    no other has; the ledger remembers it, so keep one ledger for all sheets. The manifest
    tells `locatk solve` what was printed: print at 100 %, measure the rulers, and write
    measured over nominal length as `scale_x` and `scale_y` into it.

    \b
    Examples:
      locatk print pattern -o sheet.pdf
      locatk print pattern -o a3.pdf --size A3 --landscape --dpi 600 --count 20
      locatk print pattern -o roll.pdf --size 914x3000mm --dpi 1200
      locatk print pattern -o floor.pdf --size A3 --tiles 3x2 --overlap 15
      locatk print pattern -o map.pdf --overlay drawing.pdf --strip-black
      locatk print pattern -o sheet.png --origin 1330,7200 --section 24,32
    """
    from locatk.core.dots.design.ledger import plan
    from locatk.core.dots.drawing import layout
    from locatk.core.dots.drawing.tiles import tiling
    from locatk.core.paper_sizes import paper_size
    from locatk.formats.artifacts.ledger import LEDGER_FILE, open_ledger
    from locatk.formats.printing import job as printing

    format_name = format_name or _ending(output)
    _refuse_odd_pairs(format_name, size, landscape, count, tiles, overlay, strip_black, crop_marks)
    book = ledger or output.parent / LEDGER_FILE
    inputs = [overlay] if overlay else []
    sheet_file = output.with_suffix(".toml")
    if len({path.resolve() for path in (output, sheet_file, book)}) < 3:
        raise OutputExistsError(
            "sheets, manifest and ledger would be one file", file=sheet_file, hint="Rename one"
        )
    options.guard_output(sheet_file, overwrite=overwrite, inputs=inputs)

    raster = layout.snap(pitch_mm, dot_mm, int(dpi))
    for note in layout.snapped(raster, pitch_mm, dot_mm):
        console.say(f"{note[0].upper()}{note[1:]}.")
    items: Sequence[SheetLayout | SheetTiling]
    if overlay is not None:
        items = printing.page_layouts(overlay, margin_mm, raster)
    else:
        _, paper = paper_size(size or "A4", landscape=landscape)
        one = layout.lay_out(paper, margin_mm, raster)
        items = [one] * count if tiles is None else [tiling(one, tiles, overlap_mm)]
    new_book = not book.exists()
    with open_ledger(book) as held:
        areas, manifest = plan(
            items,
            held.areas,
            codec=codec,
            section=section,
            name=name,
            origin=origin,
            force=force,
        )
        files = _files(output, format_name, manifest)
        for path in files:
            options.guard_output(path, overwrite=overwrite, inputs=inputs)
        with console.steps(printing.steps(manifest, overlay), "Drawing") as done:
            drawn = printing.draw(
                manifest,
                format_name,
                marks=marks,
                crop=crop_marks,
                document=overlay,
                strip_black=strip_black,
                done=done,
            )
            printing.publish(
                list(zip(files, drawn.writers, strict=True)),
                sheet_file,
                manifest,
                held,
                areas,
                overwrite=overwrite,
            )
    if format_name == "pdf":
        _tell_cramped(manifest, marks or crop_marks or tiles is not None)
    console.result(_text(files, sheet_file, manifest))
    console.say("Print at 100 %, without scaling to fit.")
    if new_book:
        console.say(f"{book} is new: keep it, and use it by --ledger for sheets in other folders.")
    if as_json:
        console.emit_json(_entry(files, sheet_file, book, manifest))
    for loss in drawn.losses[1:]:
        console.warn(loss)
    if drawn.losses:
        raise failures.Incomplete(drawn.losses[0])


def _ending(output: Path) -> str:
    ending = output.suffix.lower().removeprefix(".")
    return ending if ending in FORMATS else "pdf"


def _refuse_odd_pairs(
    format_name: str,
    size: str | None,
    landscape: bool | None,
    count: int,
    tiles: tuple[int, int] | None,
    overlay: Path | None,
    strip_black: bool,
    crop_marks: bool,
) -> None:
    """Refuse options that contradict each other or that nothing would come of."""
    if overlay is not None and (size is not None or landscape is not None):
        raise click.UsageError("The pages of --overlay set the size; leave --size out.")
    if overlay is not None and (count > 1 or tiles):
        raise click.UsageError("--overlay gives a sheet a page; leave --count and --tiles out.")
    if count > 1 and tiles:
        raise click.UsageError("--tiles makes one floor; leave --count out.")
    if strip_black and overlay is None:
        raise click.UsageError("--strip-black needs --overlay.")
    if format_name != "pdf" and (overlay is not None or crop_marks):
        raise click.UsageError("--overlay and --crop-marks need --format pdf.")


def _files(output: Path, format_name: str, manifest: Manifest) -> list[Path]:
    """One file for a PDF and for a single sheet, else one a sheet."""
    if format_name == "pdf" or len(manifest.sheets) == 1:
        return [output]
    if len(manifest.sheets) > MOST_FILES:
        raise click.UsageError(f"More than {MOST_FILES} files; print fewer sheets or use a PDF.")
    return [output.with_stem(f"{output.stem}-{sheet.id}") for sheet in manifest.sheets]


def _tell_cramped(manifest: Manifest, wanted: bool) -> None:
    from locatk.formats.printing.page import MIN_MARGIN_MM
    from locatk.formats.printing.pattern import sheets_without_margin

    bare = sheets_without_margin(manifest) if wanted else []
    if bare:
        others = f" and {len(bare) - 1} more" if len(bare) > 1 else ""
        console.warn(
            f"No rulers, marks and words on {bare[0]}{others}: they need a margin of "
            f"{MIN_MARGIN_MM:g} mm."
        )


def _text(files: list[Path], sheet_file: Path, manifest: Manifest) -> str:
    """What was printed, for people."""
    pitch = manifest.pitch_mm
    rows = [
        (
            sheet.id,
            f"{sheet.origin[0]},{sheet.origin[1]}",
            f"{sheet.size[0]} x {sheet.size[1]}",
            f"{sheet.size[0] * pitch:.1f} x {sheet.size[1] * pitch:.1f} mm",
        )
        for sheet in manifest.sheets[:MOST_ROWS]
    ]
    more = len(manifest.sheets) - len(rows)
    names = str(files[0]) if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
    return "\n".join(
        [
            f"Wrote {names}, manifest {sheet_file}",
            console.table(("sheet", "origin", "dots", "pattern"), rows),
            *([f"and {more} more"] if more else []),
        ]
    )


def _entry(files: list[Path], sheet_file: Path, book: Path, manifest: Manifest) -> dict[str, Any]:
    """The same as ``--json`` (docs/commands.md)."""
    return {
        "version": 1,
        "outputs": files,
        "manifest": sheet_file,
        "ledger": book,
        "codec": manifest.codec,
        "pitch_mm": manifest.pitch_mm,
        "dot_mm": manifest.dot_mm,
        "offset_mm": manifest.offset_mm,
        "dpi": manifest.dpi,
        "sheets": [
            {
                "id": sheet.id,
                "origin": sheet.origin,
                "size": sheet.size,
                "section": sheet.section,
                "page_mm": sheet.page_mm,
                "first_mm": sheet.first_mm,
                "position_mm": sheet.position_mm,
            }
            for sheet in manifest.sheets
        ],
    }
