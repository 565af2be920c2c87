"""``locatk calibrate printer``: a scan of the test sheet says how the printer prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.core.errors import DegenerateError, InputError

if TYPE_CHECKING:
    from locatk.core.dots.calibration.printed_fields import FieldScore
    from locatk.core.dots.calibration.printer import PrinterReport
    from locatk.core.dots.sheet import Manifest

RULER_MM = 100.0
LENGTH = click.FloatRange(50.0, 150.0)


@click.command("printer", cls=Command, short_help="Find the best dots and the scale of a printer.")
@options.input_argument("scan")
@options.output("What was found, as TOML.", required=False)
@click.option(
    "--scan-dpi",
    type=click.FloatRange(50.0, 20_000.0),
    metavar="DPI",
    help="Resolution of the scan.  [default: what the file says]",
)
@click.option(
    "--measured-x",
    type=LENGTH,
    metavar="MM",
    help="Length of the sheet's lower ruler, measured on the paper: instead of a scan's scale.",
)
@click.option("--measured-y", type=LENGTH, metavar="MM", help="Length of the left ruler, likewise.")
@click.option(
    "--pitch",
    "pitch_mm",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="MM",
    help="Recommend a dot for this pitch.  [default: the pitch is chosen, too]",
)
@options.input_option(
    "--manifest",
    "manifests",
    many=True,
    metavar="SHEET.toml",
    help="Manifest of sheets from this printer, into which the scale is written; repeatable. "
    "Needs --overwrite.",
)
@options.overwrite
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
    """Score each field of a printed test sheet in SCAN, and measure the printer's scale.

    Recommended is, of the fields with the fewest wrong or missing dots and at least 70 % of
    the best margin, the one whose pitch is nearest to 0.508 mm and of these the one with
    the best margin. The margin is how much darker the right one of a dot's four spots is
    than any other, in parts of full black, for all but the worst hundredth of the dots.

    The scale (printed over nominal length) comes from a flat scan whose resolution is
    known, as exact as the scanner; or from the two rulers, which you measure by hand. A
    photo tells the best dot, but no scale.

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
    from locatk.formats.printing.scans import read_scan

    if (measured_x is None) != (measured_y is None):
        raise click.UsageError("--measured-x and --measured-y go together.")
    if measured_x is not None and scan_dpi is not None:
        raise click.UsageError("The scale comes from --scan-dpi or from the rulers, not both.")
    if output is not None:
        options.guard_output(output, overwrite=overwrite, inputs=[scan, *manifests])
    held = [(path, read_manifest(path)) for path in manifests]
    for path, _ in held:
        options.guard_output(path, overwrite=overwrite, inputs=[scan])

    with console.working("Reading the test sheet"):
        picture = read_scan(scan)
        said = (scan_dpi, scan_dpi) if scan_dpi is not None else picture.dpi
        try:
            report = calibrate(picture.image, said, pitch_mm=pitch_mm)
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
    if scale is None and held:
        raise InputError("the scale is not known", file=scan, hint=_HOW_TO_SCALE)

    if output is not None:
        files.write_printer(output, report, scale, overwrite=overwrite)
    for path, manifest in held:
        if scale is not None:
            write_manifest(path, files.scaled(manifest, scale), overwrite=True)
    console.result(_text(report, scale))
    _tell(report, output, held, scale)
    if as_json:
        console.emit_json(_entry(scan, output, report, scale, manifests))
    if report.recommended is None:
        raise failures.Incomplete(
            "No field is good enough to be recommended: print with more dpi or larger dots"
        )


_HOW_TO_SCALE = (
    "Give the scanner's resolution with --scan-dpi, or the measured lengths of the two rulers "
    "with --measured-x and --measured-y"
)


def _text(report: PrinterReport, scale: tuple[float, float] | None) -> str:
    """The table of scores, the recommended field and the scale, for people."""
    sheet, best = report.sheet, report.recommended
    lines = [f"Test sheet {sheet.paper}, {sheet.dpi} dpi, {sheet.codec}", ""]
    header = ("field", "dot", "pitch", "found", "right", "bits", "margin", "scatter", "gain", "")
    lines += [console.table(header, [_row(field, report) for field in report.fields]), ""]
    if best is not None:
        lines.append(
            f"Best: {best.name}, dots of {1000 * best.dot_mm:.0f} um at {best.pitch_mm:.3f} mm; "
            f"print with --dpi {sheet.dpi} --pitch {best.pitch_mm:.4f} --dot {best.dot_mm:.4f}"
        )
    if scale is not None:
        x, y = scale
        lines.append(f"Scale: x {x:.5f}, y {y:.5f} ({_off(x)} and {_off(y)} in 100 mm)")
    return "\n".join(lines)


def _off(scale: float) -> str:
    return f"{RULER_MM * (scale - 1):+.2f} mm"


def _row(field: FieldScore, report: PrinterReport) -> tuple[str, ...]:
    what = (field.name, f"{1000 * field.dot_mm:.0f} um", f"{field.pitch_mm:.3f} mm")
    blank = ("-",) * 4
    if not field.judged:
        return (*what, "-", "-", *blank, "picture too coarse")
    seen = (f"{100 * field.found:.1f} %", f"{100 * field.right:.1f} %")
    if not field.read:
        return (*what, *seen, *blank, "cannot be read")
    scores = (
        str(field.wrong_bits),
        f"{field.margin:.3f}",
        f"{field.scatter:.4f}",
        f"{field.gain:.2f}",
    )
    return (*what, *seen, *scores, "<- best" if field is report.recommended else "")


def _tell(
    report: PrinterReport,
    output: Path | None,
    held: list[tuple[Path, Manifest]],
    scale: tuple[float, float] | None,
) -> None:
    """What people ought to know besides."""
    coarse = sum(not field.judged for field in report.fields)
    if coarse:
        console.warn(f"The picture is too coarse for {coarse} fields: scan with more dpi.")
    if scale is None:
        console.say(f"The scale is not known. {_HOW_TO_SCALE}.")
    if output is not None:
        console.say(f"Wrote {output}.")
    for path, manifest in held:
        width, height = manifest.sheets[0].page_mm
        turned = "; it is landscape, so x and y change places" if width > height else ""
        console.say(f"Wrote the scale into {path}{turned}.")


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
