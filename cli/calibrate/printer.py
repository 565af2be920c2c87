"""``locatk calibrate printer``: dots and scale of a printer, from a scan of the test sheet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.core.errors import DegenerateError, InputError

if TYPE_CHECKING:
    from locatk.core.dots.calibration.printed_fields import FieldScore
    from locatk.core.dots.calibration.printer import PrinterReport
    from locatk.core.dots.sheet import Manifest

RULER_MM = 100.0
"""Length of both rulers on the test sheet [mm]."""

MEASURED_LENGTH = click.FloatRange(50.0, 150.0)


@click.command("printer", cls=Command, short_help="Find the best dots and the scale of a printer.")
@options.input_argument("scan")
@options.output("Calibration to write (.toml).", required=False, endings=(".toml",))
@options.overwrite
@section(
    "Scale",
    click.option(
        "--scan-dpi",
        type=click.FloatRange(50.0, 20_000.0),
        metavar="DPI",
        help="Resolution of the scan.  [default: as in the file]",
    ),
    click.option(
        "--measured-x",
        type=MEASURED_LENGTH,
        metavar="MM",
        help="Length of the lower ruler, measured on the paper; replaces the scale of the scan.",
    ),
    click.option(
        "--measured-y",
        type=MEASURED_LENGTH,
        metavar="MM",
        help="Length of the left ruler, measured on the paper.",
    ),
)
@section(
    "Advanced",
    click.option(
        "--pitch",
        "pitch_mm",
        type=options.POSITIVE,
        metavar="MM",
        help="Recommend a dot for this pitch.  [default: recommend a pitch, too]",
    ),
    options.input_option(
        "--manifest",
        "manifests",
        many=True,
        help="Manifest of sheets from this printer (sheet.toml) in which to set the scale; "
        "needs --overwrite. Repeatable.",
    ),
)
@options.as_json
@options.verbosity
def command(
    scan: Path,
    output: Path | None,
    scan_dpi: float | None,
    measured_x: float | None,
    measured_y: float | None,
    pitch_mm: float | None,
    manifests: tuple[Path, ...],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Rate the dots on a scanned test sheet, and measure the scale of the printer.

    Each field of the sheet has dots of one size and pitch. Candidates are the fields with the
    fewest wrong or missing dots that have at least 70 % of the best margin. Of these, the field
    with the pitch nearest to 0.508 mm is recommended and, at equal pitch, the one with the best
    margin. The margin of a dot is the difference in darkness between its position and the darkest
    of the other three possible positions, as a fraction of full black; the margin of a field is the
    one that 99 % of its dots reach.

    The scale (printed over nominal length) is measured in a flat scan of known resolution, with the
    accuracy of the scanner, or computed from the two rulers, measured by hand. From a photo, only
    the best dot can be determined.

    \b
    Examples:
      locatk calibrate printer scan.png -o printer.toml
      locatk calibrate printer scan.jpg --scan-dpi 1200 --pitch 0.508
      locatk calibrate printer photo.jpg --measured-x 100.2 --measured-y 99.7
      locatk calibrate printer scan.png --manifest sheet.toml --overwrite
    """
    from locatk.core.dots.calibration.printer import calibrate
    from locatk.formats.artifacts import printer as files
    from locatk.formats.artifacts.sheets import read_manifest, write_manifest
    from locatk.formats.scans import read_scan

    if (measured_x is None) != (measured_y is None):
        raise click.UsageError("Give both --measured-x and --measured-y.")
    if measured_x is not None and scan_dpi is not None:
        raise click.UsageError("The scale comes from --scan-dpi or from the rulers, not both.")
    if output is not None:
        options.guard_output(output, overwrite=overwrite, inputs=[scan, *manifests])
    updated = [(path, read_manifest(path)) for path in manifests]
    for path, _ in updated:
        options.guard_output(path, overwrite=overwrite, inputs=[scan])

    with console.working("Reading the test sheet"):
        picture = read_scan(scan)
        dpi = (scan_dpi, scan_dpi) if scan_dpi is not None else picture.dpi
        try:
            report = calibrate(picture.image, dpi, pitch_mm=pitch_mm)
        except (DegenerateError, InputError) as error:
            raise type(error)(error.message, file=scan, hint=error.hint) from None
    scale: tuple[float, float] | None = report.scale
    if measured_x is not None and measured_y is not None:
        scale = (measured_x / RULER_MM, measured_y / RULER_MM)
    elif report.doubt is not None and scan_dpi is not None:
        raise InputError(report.doubt, file=scan, hint=_HOW_TO_SCALE)
    elif report.doubt is not None:
        console.warn(f"{report.doubt[0].upper()}{report.doubt[1:]}: the scale is not known.")
        scale = None
    if scale is None and updated:
        raise InputError("the scale is not known", file=scan, hint=_HOW_TO_SCALE)

    if output is not None:
        files.write_printer(output, report, scale, overwrite=overwrite)
    for path, manifest in updated:
        if scale is not None:
            write_manifest(path, files.with_printer_scale(manifest, scale), overwrite=True)
    console.result(_text(report, scale))
    _print_remarks(report, output, updated, scale)
    if as_json:
        console.emit_json(_entry(scan, output, report, scale, manifests))
    if report.recommended is None:
        raise failures.Incomplete(
            "no field is good enough to be recommended: print with more dpi or larger dots"
        )


_HOW_TO_SCALE = (
    "Give the scanner's resolution with --scan-dpi, or the measured lengths of the two rulers "
    "with --measured-x and --measured-y"
)


def _text(report: PrinterReport, scale: tuple[float, float] | None) -> str:
    """Format the table of scores, the recommended field and the scale."""
    sheet, best = report.sheet, report.recommended
    lines = [f"Test sheet {sheet.paper}, {sheet.dpi} dpi, {sheet.codec}", ""]
    header = (
        *("field", "dot [um]", "pitch [mm]", "found", "correct", "wrong bits"),
        *("margin", "scatter", "gain", ""),
    )
    lines += [console.table(header, [_row(field, report) for field in report.fields]), ""]
    if best is not None:
        lines += [
            f"Best: {best.name}, dots of {1000 * best.dot_mm:.0f} um at {best.pitch_mm:.3f} mm; "
            "print with",
            f"  --dpi {sheet.dpi} --pitch {best.pitch_mm:.4f} --dot {best.dot_mm:.4f}",
        ]
    if scale is not None:
        x, y = scale
        lines.append(f"Scale: x {x:.5f}, y {y:.5f} ({_deviation(x)} and {_deviation(y)} in 100 mm)")
    return "\n".join(lines)


def _deviation(scale: float) -> str:
    return f"{RULER_MM * (scale - 1):+.2f} mm"


def _row(field: FieldScore, report: PrinterReport) -> tuple[str, ...]:
    design = (field.name, f"{1000 * field.dot_mm:.0f}", f"{field.pitch_mm:.3f}")
    blank = ("-",) * 4
    if not field.judged:
        return (*design, "-", "-", *blank, "picture too coarse")
    detected = (f"{100 * field.found:.1f} %", f"{100 * field.right:.1f} %")
    if not field.read:
        return (*design, *detected, *blank, "cannot be read")
    scores = (
        str(field.wrong_bits),
        f"{field.margin:.3f}",
        f"{field.scatter:.4f}",
        f"{field.gain:.2f}",
    )
    return (*design, *detected, *scores, "<- best" if field is report.recommended else "")


def _print_remarks(
    report: PrinterReport,
    output: Path | None,
    updated: list[tuple[Path, Manifest]],
    scale: tuple[float, float] | None,
) -> None:
    """Print warnings and the written files."""
    coarse = sum(not field.judged for field in report.fields)
    if coarse:
        console.warn(f"The picture is too coarse for {coarse} fields: scan with more dpi.")
    if scale is None:
        console.say(f"The scale is not known. {_HOW_TO_SCALE}.")
    if output is not None:
        console.say(f"Wrote {output}.")
    for path, manifest in updated:
        width, height = manifest.sheets[0].page_mm
        swapped = "; x and y are exchanged, because it is landscape" if width > height else ""
        console.say(f"Wrote the scale into {path}{swapped}.")


def _entry(
    scan: Path,
    output: Path | None,
    report: PrinterReport,
    scale: tuple[float, float] | None,
    manifests: tuple[Path, ...],
) -> dict[str, Any]:
    from locatk.formats.artifacts.printer import field_row

    best = report.recommended
    return {
        "version": 1,
        "scan": scan,
        "output": output,
        "paper": report.sheet.paper,
        "dpi": report.sheet.dpi,
        "codec": report.sheet.codec,
        "scale_x": None if scale is None else scale[0],
        "scale_y": None if scale is None else scale[1],
        "bend_mm": report.bend_mm,
        "recommended": None if best is None else best.name,
        "fields": [field_row(report, number) for number in range(len(report.fields))],
        "manifests": list(manifests),
    }
