"""``locatk print pattern``: sheets of dots."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section

CODECS = ("anoto", "libdots", "microdots")
ENDINGS = {
    "pdf": (".pdf",),
    "png": (".png",),
    "tiff": (".tiff", ".tif"),
    "pbm": (".pbm",),
    "txt": (".txt",),
}
"""Endings of the names of files, by format.

SVG is none of them: programs for vectors do not keep the pixels of a printer.
"""

MAX_FILES = 200
"""Largest number of files of a run, all of which are open until the last one is complete."""

MAX_SECTION = 62
"""Largest number of a section: the main sequence of the pattern has 63 of them."""

MAX_TABLE_ROWS = 10


class PairType(click.ParamType):
    """Two whole numbers with a separator, as in ``3x2`` or ``1330,7200``."""

    def __init__(self, separator: str, minimum: int, maximum: float = math.inf) -> None:
        self.separator, self.minimum, self.maximum = separator, minimum, maximum
        self.name = f"a pair of numbers as in 3{separator}2"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Return the two numbers."""
        if isinstance(value, tuple):
            return value
        parts = str(value).lower().split(self.separator)
        if len(parts) != 2 or not all(p.strip().isascii() and p.strip().isdigit() for p in parts):
            self.fail(f"{value!r} is not {self.name}.", param, ctx)
        first, second = (int(part) for part in parts)
        if min(first, second) < self.minimum:
            self.fail(f"{value!r} has a number below {self.minimum}.", param, ctx)
        if max(first, second) > self.maximum:
            self.fail(f"{value!r} has a number above {self.maximum}.", param, ctx)
        return first, second


@click.command(cls=Command, short_help="Draw sheets of dots for localization by camera.")
@options.output("File to write; the manifest is written next to it as .toml.")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(list(ENDINGS)),
    help="`png`, `tiff`, `pbm`: image of 1 bit per pixel at the printer's resolution, without "
    "margin texts. `txt`: a letter u, d, l or r for each dot. These write one file per sheet, "
    "named by its id.  [default: by the ending of the output]",
)
@options.overwrite
@options.as_json
@options.verbosity
@section(
    "Paper",
    click.option(
        "--size",
        default=None,
        metavar="PAPER",
        help="A0 to A5, Letter, Tabloid, or a size as in 600x3000mm or 24x36in.  [default: A4]",
    ),
    click.option("--landscape/--portrait", default=None, help="Orientation of the paper."),
    click.option(
        "--margin",
        "margin_mm",
        type=float,
        default=10.0,
        show_default=True,
        metavar="MM",
        help="Margin without dots; from 7 mm on it contains rulers and captions.",
    ),
    click.option(
        "--marks/--no-marks",
        default=True,
        show_default=True,
        help="Print rulers and captions in the margin.",
    ),
    click.option("--crop-marks", is_flag=True, help="Print marks for cutting the margin off."),
)
@section(
    "Dots",
    click.option(
        "--dpi",
        type=click.Choice(("300", "600", "1200")),
        default="300",
        show_default=True,
        help="Resolution of the printer.",
    ),
    click.option(
        "--pitch",
        "pitch_mm",
        type=float,
        default=0.508,
        show_default=True,
        metavar="MM",
        help="Distance between dots, rounded to whole pixels of the printer.",
    ),
    click.option(
        "--dot",
        "dot_mm",
        type=float,
        metavar="MM",
        help="Width of a dot, rounded to whole pixels.  [default: 1/6 of the pitch]",
    ),
    click.option(
        "--codec",
        type=click.Choice(CODECS),
        default=CODECS[0],
        show_default=True,
        help="Code of the pattern.",
    ),
)
@section(
    "Several sheets",
    click.option(
        "--count",
        type=click.IntRange(1, 1000),
        metavar="N",
        default=1,
        show_default=True,
        help="Number of sheets, each with its own area of the pattern.",
    ),
    click.option(
        "--tiles",
        type=PairType("x", 1),
        metavar="CxR",
        help="Divide one large sheet into C pages across and R down, which overlap. Poses "
        "refer to the lower left page.",
    ),
    click.option(
        "--overlap",
        "overlap_mm",
        type=float,
        default=10.0,
        show_default=True,
        metavar="MM",
        help="Overlap of neighbouring pages of --tiles; registration marks show where to cut.",
    ),
)
@section(
    "Document below the dots",
    options.input_option(
        "--overlay",
        help="Print over each page of this PDF document, whose pages determine the size. Black "
        "and grey of the document hide dots and are reported. Needs locatk[pdf].",
    ),
    click.option(
        "--strip-black",
        is_flag=True,
        help="Print the document's black in cyan, magenta and yellow, so that only dots are black.",
    ),
)
@section(
    "Area of the pattern",
    click.option(
        "--origin",
        type=PairType(",", 0),
        metavar="X,Y",
        help="Grid coordinates of the upper left dot; further sheets follow to the right.  "
        "[default: the next area that is free in the ledger]",
    ),
    click.option(
        "--section",
        type=PairType(",", 0, MAX_SECTION),
        default="0,0",
        show_default=True,
        metavar="U,V",
        help="Section of the pattern; two numbers from 0 to 62.",
    ),
    click.option(
        "--id", "name", metavar="NAME", help="Name of the sheet.  [default: its paper and a number]"
    ),
    click.option(
        "--ledger",
        type=options.PATH,
        envvar="LOCATK_LEDGER",
        show_envvar=True,
        metavar="FILE",
        help="File with the areas in use.  [default: locatk-ledger.toml in the folder of the "
        "output]",
    ),
    click.option(
        "--force", is_flag=True, help="Use an area even if the ledger lists it for another sheet."
    ),
)
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
    """Draw sheets of dots, on which a camera determines its pose.

    Dots are exactly on the printer's pixels. Each sheet gets its own area of the pattern, which is
    recorded in a ledger; use one ledger for all sheets. `locatk solve` reads the manifest of the
    sheets. Print at 100 %, measure the rulers, and enter measured over nominal length as `scale_x`
    and `scale_y` in the manifest.

    \b
    Examples:
      locatk print pattern -o sheet.pdf
      locatk print pattern -o a3.pdf --size A3 --landscape --dpi 600 --count 20
      locatk print pattern -o roll.pdf --size 914x3000mm --dpi 1200
      locatk print pattern -o floor.pdf --size A3 --tiles 3x2 --overlap 15
      locatk print pattern -o map.pdf --overlay drawing.pdf --strip-black
      locatk print pattern -o sheet.png --origin 1330,7200 --section 24,32
      locatk print pattern -o sheet.tiff --size A3 --dpi 1200
    """
    from locatk.core.dots.design.ledger import plan
    from locatk.core.dots.drawing import layout
    from locatk.core.errors import OutputExistsError
    from locatk.formats.artifacts.ledger import LEDGER_FILE, open_ledger
    from locatk.formats.printing import job

    format_name = options.choose_format(output, format_name, ENDINGS)
    _check_combinations(
        format_name, size, landscape, count, tiles, overlay, strip_black, crop_marks
    )
    ledger_file = ledger or output.parent / LEDGER_FILE
    inputs = [overlay] if overlay else []
    manifest_file = output.with_suffix(".toml")
    if len({os.path.realpath(path) for path in (output, manifest_file, ledger_file)}) < 3:
        raise OutputExistsError(
            "sheets, manifest and ledger would be one file", file=manifest_file, hint="Rename one"
        )
    options.guard_output(manifest_file, overwrite=overwrite, inputs=inputs)

    raster = layout.snap(pitch_mm, dot_mm, int(dpi))
    for note in layout.snapped(raster, pitch_mm, dot_mm):
        console.say(f"{note[0].upper()}{note[1:]}.")
    if overlay is not None:
        items = job.page_layouts(overlay, margin_mm, raster)
    else:
        items = job.paper_layouts(
            size or "A4", margin_mm, raster, landscape=landscape, count=count, tiles=tiles,
            overlap_mm=overlap_mm,
        )  # fmt: skip
    is_new_ledger = not ledger_file.exists()
    with open_ledger(ledger_file) as opened_ledger:
        areas, manifest = plan(
            items,
            opened_ledger.areas,
            codec=codec,
            section=section,
            name=name,
            origin=origin,
            force=force,
        )
        files = _files(output, format_name, manifest)
        for path in files:
            options.guard_output(path, overwrite=overwrite, inputs=inputs)
        with console.steps(job.count_steps(manifest, overlay), "Drawing") as done:
            drawn = job.draw(
                manifest,
                format_name,
                marks=marks,
                crop=crop_marks,
                document=overlay,
                strip_black=strip_black,
                done=done,
            )
            job.publish(
                list(zip(files, drawn.writers, strict=True)),
                manifest_file,
                manifest,
                opened_ledger,
                areas,
                overwrite=overwrite,
            )
    if format_name == "pdf":
        _warn_of_narrow_margins(manifest, marks or crop_marks or tiles is not None)
    console.result(_text(files, manifest_file, manifest))
    console.say("Print at 100 %, without scaling to fit.")
    if is_new_ledger:
        console.say(
            f"{ledger_file} is new: keep it, and select it by --ledger for sheets in other folders."
        )
    if as_json:
        console.emit_json(_entry(files, manifest_file, ledger_file, manifest))
    if drawn.warning:
        console.warn(drawn.warning)
    for loss in drawn.losses[1:]:
        console.warn(loss)
    if drawn.losses:
        raise failures.Incomplete(drawn.losses[0])


def _check_combinations(
    format_name: str,
    size: str | None,
    landscape: bool | None,
    count: int,
    tiles: tuple[int, int] | None,
    overlay: Path | None,
    strip_black: bool,
    crop_marks: bool,
) -> None:
    """Refuse options that contradict each other or have no effect."""
    if overlay is not None and (size is not None or landscape is not None):
        raise click.UsageError("The pages of --overlay determine the size; leave --size out.")
    if overlay is not None and (count > 1 or tiles):
        raise click.UsageError("--overlay prints one sheet a page; leave --count and --tiles out.")
    if count > 1 and tiles:
        raise click.UsageError("--tiles prints one floor; leave --count out.")
    if strip_black and overlay is None:
        raise click.UsageError("--strip-black needs --overlay.")
    if format_name != "pdf" and (overlay is not None or crop_marks):
        raise click.UsageError("--overlay and --crop-marks need --format pdf.")


def _files(output: Path, format_name: str, manifest: Any) -> list[Path]:
    """Return one file for a PDF and for a single sheet, else one for each sheet."""
    if format_name == "pdf" or len(manifest.sheets) == 1:
        return [output]
    if len(manifest.sheets) > MAX_FILES:
        raise click.UsageError(f"More than {MAX_FILES} files; print fewer sheets or use a PDF.")
    return [output.with_stem(f"{output.stem}-{sheet.id}") for sheet in manifest.sheets]


def _warn_of_narrow_margins(manifest: Any, has_marks: bool) -> None:
    from locatk.formats.printing.page import MIN_MARGIN_MM
    from locatk.formats.printing.pattern import sheets_without_margin

    narrow = sheets_without_margin(manifest) if has_marks else []
    if narrow:
        others = f" and {len(narrow) - 1} more" if len(narrow) > 1 else ""
        console.warn(
            f"No rulers, marks and captions on {narrow[0]}{others}: they need a margin of "
            f"{MIN_MARGIN_MM:g} mm."
        )


def _text(files: list[Path], manifest_file: Path, manifest: Any) -> str:
    """Format the summary of the printed sheets."""
    pitch = manifest.pitch_mm
    rows = [
        (
            sheet.id,
            f"{sheet.origin[0]},{sheet.origin[1]}",
            f"{sheet.size[0]} x {sheet.size[1]}",
            f"{sheet.size[0] * pitch:.1f} x {sheet.size[1] * pitch:.1f} mm",
        )
        for sheet in manifest.sheets[:MAX_TABLE_ROWS]
    ]
    more = len(manifest.sheets) - len(rows)
    names = str(files[0]) if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
    return "\n".join(
        [
            f"Wrote {names}, manifest {manifest_file}",
            console.table(("sheet", "origin", "dots", "pattern"), rows),
            *([f"and {more} more"] if more else []),
        ]
    )


def _entry(
    files: list[Path], manifest_file: Path, ledger_file: Path, manifest: Any
) -> dict[str, Any]:
    """Return the summary for ``--json`` (docs/commands.md)."""
    return {
        "version": 1,
        "outputs": files,
        "manifest": manifest_file,
        "ledger": ledger_file,
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
