"""``locatk print testsheet``: test sheet of a printer."""

from __future__ import annotations

from pathlib import Path

import click

from locatk.cli import console, options
from locatk.cli.command import Command


@click.command(cls=Command, short_help="Draw a test sheet for choosing dots.")
@options.output("PDF to write.", endings=(".pdf",))
@click.option(
    "--size", type=click.Choice(("A4", "Letter"), case_sensitive=False), default="A4",
    show_default=True, help="Paper.",
)  # fmt: skip
@click.option(
    "--dpi",
    type=click.Choice(("300", "600", "1200")),
    default="600",
    show_default=True,
    help="Resolution of the printer; dots are whole pixels.",
)
@click.option(
    "--codec",
    type=click.Choice(("anoto", "libdots", "microdots")),
    default="anoto",
    show_default=True,
    help="Code of the pattern.",
)
@options.overwrite
@options.as_json
@options.verbosity
def testsheet(
    output: Path, size: str, dpi: str, codec: str, overwrite: bool, as_json: bool
) -> None:
    """Draw a test sheet, with a field of dots for each combination of size and pitch.

    Print and scan the sheet; `locatk calibrate printer` then determines which dots are printed
    best, and the scale of the printer. The sheet contains markers that identify it and needs no
    manifest.

    \b
    Examples:
      locatk print testsheet -o test.pdf
      locatk print testsheet -o test.pdf --size Letter --dpi 1200
    """
    from locatk.core.dots.drawing.test_sheet import printer_sheet
    from locatk.formats.output import atomic_write
    from locatk.formats.printing.pattern import render_test_sheet

    options.guard_output(output, overwrite=overwrite)
    sheet = printer_sheet(size, int(dpi), codec)
    with atomic_write(output, overwrite=overwrite) as stream:
        stream.write(render_test_sheet(sheet))
    pitches = sorted({field.pitch_mm for field in sheet.fields})
    dots = sorted({field.dot_mm for field in sheet.fields})
    console.result(
        f"Wrote {output}: {len(sheet.fields)} fields, dots {1000 * dots[0]:.0f} to "
        f"{1000 * dots[-1]:.0f} um, pitches {pitches[0]:.3f} to {pitches[-1]:.3f} mm"
    )
    console.say(
        "Print at 100 %, black only, scan with 1200 dpi, and run `locatk calibrate printer`."
    )
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "paper": sheet.paper,
                "dpi": sheet.dpi,
                "codec": sheet.codec,
                "fields": [
                    {
                        "name": field.name,
                        "dot_px": field.layout.raster.dot,
                        "dot_mm": field.dot_mm,
                        "pitch_px": field.layout.raster.pitch,
                        "pitch_mm": field.pitch_mm,
                        "origin": field.origin,
                        "size": field.layout.size,
                    }
                    for field in sheet.fields
                ],
            }
        )
