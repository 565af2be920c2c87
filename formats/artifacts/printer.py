"""What is known of a printer, ``printer.toml``, and the manifests of what it has printed.

The keys are described in docs/formats.md.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Any

from locatk.core.dots.calibration.printer import PrinterReport
from locatk.core.dots.sheet import Manifest
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import head
from locatk.formats.output import atomic_write

PRINTER_FORMAT = "locatk-printer"
PRINTER_VERSION = 1

DIGITS = 6
"""Of a scale; more are not measured."""


def write_printer(
    path: str | os.PathLike[str],
    report: PrinterReport,
    scale: tuple[float, float] | None,
    *,
    overwrite: bool = False,
) -> None:
    """Write what a test sheet has told of a printer as TOML.

    Parameters
    ----------
    path : path
    report : PrinterReport
    scale : (x, y) or None
        Printed over nominal length, where it was measured.
    overwrite : bool

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(dumps_printer(report, scale).encode())


def dumps_printer(report: PrinterReport, scale: tuple[float, float] | None) -> str:
    """TOML text of :func:`write_printer`."""
    best, sheet = report.recommended, report.sheet
    printer: dict[str, Any] = {"dpi": sheet.dpi}
    if scale is not None:
        printer |= {"scale_x": round(scale[0], DIGITS), "scale_y": round(scale[1], DIGITS)}
    if best is not None:
        printer |= {
            "field": best.name,
            "dot_px": best.dot_px,
            "dot_mm": best.dot_mm,
            "pitch_px": best.pitch_px,
            "pitch_mm": best.pitch_mm,
        }
    return toml.dumps(
        {
            **head(PRINTER_FORMAT, PRINTER_VERSION),
            "printer": printer,
            "sheet": {"paper": sheet.paper, "dpi": sheet.dpi, "codec": sheet.codec},
            "fields": [field_row(report, number) for number in range(len(report.fields))],
        }
    )


def field_row(report: PrinterReport, number: int) -> dict[str, Any]:
    """What is told of a field, in ``printer.toml`` and in JSON; no key where not known."""
    field = report.fields[number]
    row: dict[str, Any] = {
        "name": field.name,
        "dot_px": field.dot_px,
        "dot_mm": field.dot_mm,
        "pitch_px": field.pitch_px,
        "pitch_mm": field.pitch_mm,
        "dots": field.dots,
        "scan_px": round(field.scan_px, 2),
        "judged": field.judged,
        "read": field.read,
    }
    if field.judged:
        row |= {"found": round(field.found, 4), "right": round(field.right, 4)}
    if field.read:
        row |= {
            "wrong_bits": field.wrong_bits,
            "margin": round(field.margin, 4),
            "scatter": round(field.scatter, 4),
        }
        if math.isfinite(field.gain):
            row["gain"] = round(field.gain, 3)
    return row


def scaled(manifest: Manifest, scale: tuple[float, float]) -> Manifest:
    """A manifest of sheets from a printer whose test sheet has this scale.

    The test sheet is upright. A printer feeds a paper of the other orientation through in
    the same direction, so that the two scales change places; where a manifest holds both,
    that of its first sheet counts. Tiles lie at their registration marks, which the same
    printer has made, so that their places on the floor grow with the scale.
    """
    width, height = manifest.sheets[0].page_mm
    x, y = (round(value, DIGITS) for value in scale)
    new = (y, x) if width > height else (x, y)
    growth = [after / before for after, before in zip(new, manifest.scale, strict=True)]
    sheets = tuple(
        sheet
        if sheet.position_mm is None
        else replace(
            sheet,
            position_mm=(sheet.position_mm[0] * growth[0], sheet.position_mm[1] * growth[1]),
        )
        for sheet in manifest.sheets
    )
    return replace(manifest, scale=new, sheets=sheets)
