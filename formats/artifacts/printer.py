"""Result of a printer's test sheet, ``printer.toml``, and manifests in its scale."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Any

from locatk.core.dots.calibration.printer import PrinterReport
from locatk.core.dots.sheet import Manifest
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.schema import header
from locatk.formats.output import atomic_write

PRINTER_FORMAT = "locatk-printer"
PRINTER_VERSION = 1

SCALE_DECIMALS = 6
"""Decimals of a scale; a scan does not resolve more."""


def write_printer(
    path: str | os.PathLike[str],
    report: PrinterReport,
    scale: tuple[float, float] | None,
    *,
    overwrite: bool = False,
) -> None:
    """Write the result of a test sheet as TOML.

    Parameters
    ----------
    path : path
    report : PrinterReport
    scale : (x, y) or None
        Printed over nominal length, if it was measured.
    overwrite : bool

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(dumps_printer(report, scale).encode())


def dumps_printer(report: PrinterReport, scale: tuple[float, float] | None) -> str:
    """Return the TOML text of :func:`write_printer`."""
    best, sheet = report.recommended, report.sheet
    printer: dict[str, Any] = {"dpi": sheet.dpi}
    if scale is not None:
        printer |= dict(zip(("scale_x", "scale_y"), _rounded(scale), strict=True))
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
            **header(PRINTER_FORMAT, PRINTER_VERSION),
            "printer": printer,
            "sheet": {"paper": sheet.paper, "dpi": sheet.dpi, "codec": sheet.codec},
            "fields": [field_row(report, number) for number in range(len(report.fields))],
        }
    )


def field_row(report: PrinterReport, number: int) -> dict[str, Any]:
    """Return the result of one field for ``printer.toml`` and JSON; unknown keys are missing."""
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


def with_printer_scale(manifest: Manifest, scale: tuple[float, float]) -> Manifest:
    """Return a manifest of sheets from a printer whose test sheet has this scale.

    The test sheet is upright. A printer feeds a paper of the other orientation in the same
    direction, so that the two scales are exchanged; if a manifest contains both orientations, that
    of its first sheet counts. Tiles are aligned at their registration marks, which were printed by
    the same printer: their positions on the floor are multiplied by the scale.
    """
    width_mm, height_mm = manifest.sheets[0].page_mm
    x, y = _rounded(scale)
    new = (y, x) if width_mm > height_mm else (x, y)
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


def _rounded(scale: tuple[float, float]) -> tuple[float, float]:
    x, y = (round(value, SCALE_DECIMALS) for value in scale)
    return x, y
