"""Artifacts of the dots: the manifest of printed sheets, ``sheet.toml``, and the camera.

Their keys are described in docs/formats.md. Numbers are kept exactly: what is written and
read again is the same to the last bit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import MAIN_SEQUENCE_LENGTH, SECTION_LENGTH, check_window, sequences
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import InputError
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import Artifact, head
from locatk.formats.artifacts.checks import above
from locatk.formats.artifacts.toml import Table

SHEET_FILE = "sheet.toml"
"""Name of the attachment that holds the manifest of a session or a solution."""

CAMERA_FILE = "camera.toml"
"""Name of the attachment that holds the camera of a session."""

MANIFEST_FORMAT = "locatk-dot-sheets"
CAMERA_FORMAT = "locatk-camera"
VERSION = 1

SCALES = (0.5, 2.0)
"""Measured over nominal length: what is outside is no printer, but a slip."""

LARGEST_FRAME_PX = 65_535


def dumps_manifest(manifest: Manifest) -> str:
    """TOML text of a manifest; the same manifest gives the same text."""
    return toml.dumps(
        {
            **head(MANIFEST_FORMAT, VERSION),
            "codec": manifest.codec,
            "pitch_mm": float(manifest.pitch_mm),
            "dot_mm": float(manifest.dot_mm),
            "offset_mm": float(manifest.offset_mm),
            "dpi": int(manifest.dpi),
            "scale_x": float(manifest.scale[0]),
            "scale_y": float(manifest.scale[1]),
            "notes": list(manifest.notes) or None,
            "sheets": [_sheet_table(sheet, manifest.pitch_mm) for sheet in manifest.sheets],
        }
    )


def dumps_camera(camera: Camera) -> str:
    """TOML text of a camera; the same camera gives the same text."""
    return toml.dumps(
        {
            **head(CAMERA_FORMAT, VERSION),
            "size_px": [int(n) for n in camera.size],
            "focal_px": float(camera.focal_px),
            "centre_px": [float(x) for x in camera.centre_px],
            "radial": float(camera.radial),
        }
    )


def _sheet_table(sheet: Sheet, pitch_mm: float) -> dict[str, Any]:
    width, height = (n * pitch_mm for n in sheet.size)
    tile = sheet.position_mm is not None
    return {
        "#": f"{width:.1f} x {height:.1f} mm of pattern",
        "id": sheet.id,
        "origin": [int(n) for n in sheet.origin],
        "size": [int(n) for n in sheet.size],
        "section": [int(n) for n in sheet.section],
        "page_mm": [float(x) for x in sheet.page_mm],
        "first_mm": [float(x) for x in sheet.first_mm],
        "position_mm": None if sheet.position_mm is None else [float(x) for x in sheet.position_mm],
        "heading_deg": float(sheet.heading_deg) if tile else None,
    }


def _manifest(table: Table) -> Manifest:
    toml.check_format(table, MANIFEST_FORMAT, VERSION)
    name = table.text("codec", choices=tuple(sequences.FOURTH_DIGITS))
    pitch = above(table, "pitch_mm")
    dot = above(table, "dot_mm", pitch / 6)
    offset = above(table, "offset_mm", pitch / 6)
    for key, value, most, words in (
        ("dot_mm", dot, pitch, "the pitch"),
        ("offset_mm", offset, pitch / 2, "half the pitch"),
    ):
        if value >= most:
            raise table.error(key, f"expected less than {words}, {most:g} mm")
    tables = table.tables("sheets")
    if not tables:
        raise table.error("sheets", "expected at least one sheet: write it under [[sheets]]")
    manifest = Manifest(
        sheets=tuple(_sheet(sheet) for sheet in tables),
        codec=name,
        pitch_mm=pitch,
        dot_mm=dot,
        offset_mm=offset,
        dpi=table.integer("dpi", 1, 10_000, 300),
        scale=(_scale(table, "scale_x"), _scale(table, "scale_y")),
        notes=table.texts("notes", ()),
    )
    table.end()
    _check_sheets(table, manifest.sheets)
    return manifest


def _sheet(table: Table) -> Sheet:
    name = table.text("id")
    if not name.strip():
        raise table.error("id", "expected a name")
    origin = _whole(table, "origin", 0, SECTION_LENGTH - 1)
    size = _whole(table, "size", 1, SECTION_LENGTH)
    section = _whole(table, "section", 0, MAIN_SEQUENCE_LENGTH - 1, (0, 0))
    try:
        check_window(origin, size, section)
    except InputError as error:
        raise table.error("origin", error.message, error.hint) from None
    page = _pair(table, "page_mm")
    if min(page) <= 0:
        raise table.error("page_mm", "expected a width and a height above 0")
    first = _pair(table, "first_mm")
    position = _pair(table, "position_mm") if "position_mm" in table else None
    heading = table.number("heading_deg", None)
    table.raw("position_mm", None)  # known also where it is missing
    table.end()
    if position is None and heading is not None:
        raise table.error(
            "heading_deg",
            "a heading without position_mm",
            "Give both for a sheet that lies on a floor, or neither",
        )
    turn = 0.0 if heading is None else heading
    return Sheet(name, origin, size, section, page, first, position, turn)


def _check_sheets(table: Table, sheets: tuple[Sheet, ...]) -> None:
    """Refuse sheets that cannot be told apart."""
    names = [sheet.id for sheet in sheets]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise table.error(f"sheets[{number}].id", f"{name!r} is there twice")
        if name == "floor" and any(sheet.position_mm is not None for sheet in sheets):
            raise table.error(
                f"sheets[{number}].id", "'floor' is the name of the frame in which tiles lie"
            )
    # Tiles may share a rim, which is one place of the floor; other sheets may share nothing.
    loose = np.array([sheet.position_mm is None for sheet in sheets])
    low = np.array([sheet.origin for sheet in sheets])
    high = low + [sheet.size for sheet in sheets]
    section = np.array([sheet.section for sheet in sheets])
    for number in range(1, len(sheets)):
        before = slice(number)
        shared = (low[before] < high[number]).all(axis=1)
        shared &= (low[number] < high[before]).all(axis=1)
        shared &= (section[before] == section[number]).all(axis=1)
        shared &= loose[before] | loose[number]
        if shared.any():
            raise table.error(
                f"sheets[{number}].origin",
                f"shares positions with sheet {names[int(shared.argmax())]!r}",
                "Give each sheet an area of its own, or position_mm to the tiles of a floor",
            )


def _camera(table: Table) -> Camera:
    toml.check_format(table, CAMERA_FORMAT, VERSION)
    camera = Camera(
        size=_whole(table, "size_px", 1, LARGEST_FRAME_PX),
        focal_px=above(table, "focal_px"),
        centre_px=_pair(table, "centre_px"),
        radial=table.number("radial", 0.0),
    )
    table.end()
    (width, height), (x, y) = camera.size, camera.centre_px
    for key, at, count in (("x", x, width), ("y", y, height)):
        if not -0.5 <= at <= count - 0.5:
            raise table.error("centre_px", f"{key} {at:g} is outside the frame of {count} px")
    # Beyond 1 / sqrt(|k|) the division model folds the picture back on itself.
    corner = math.hypot(max(x, width - 1 - x), max(y, height - 1 - y)) / camera.focal_px
    if abs(camera.radial) * corner**2 >= 1:
        raise table.error(
            "radial",
            f"expected less than {1 / corner**2:.3g} in size, for the corners to be seen",
            "k is for offsets in focal lengths: multiply one in px^-2 by focal_px squared",
        )
    return camera


def _scale(table: Table, key: str) -> float:
    value: float = table.number(key, 1.0)
    low, high = SCALES
    if not low <= value <= high:
        raise table.error(
            key,
            f"expected measured over nominal length, from {low:g} to {high:g}",
            "A ruler of 100 mm that measures 100.2 mm has a scale of 1.002",
        )
    return value


def _pair(table: Table, key: str) -> tuple[float, float]:
    first, second = table.array(key, (2,)).tolist()
    return first, second


def _whole(
    table: Table, key: str, low: int, high: int, default: tuple[int, int] | None = None
) -> tuple[int, int]:
    value = table.raw(key) if default is None else table.raw(key, list(default))
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(isinstance(n, int) and not isinstance(n, bool) for n in value)
        or not all(low <= n <= high for n in value)
    ):
        raise table.error(key, f"expected a list of 2 whole numbers from {low} to {high}")
    return value[0], value[1]


MANIFEST = Artifact(SHEET_FILE, dumps_manifest, _manifest)
CAMERA = Artifact(CAMERA_FILE, dumps_camera, _camera)
"""Manifests and cameras as files; these are their methods."""

write_manifest, read_manifest = MANIFEST.write, MANIFEST.read
loads_manifest, attached_manifest = MANIFEST.loads, MANIFEST.attached
write_camera, read_camera = CAMERA.write, CAMERA.read
loads_camera, attached_camera = CAMERA.loads, CAMERA.attached
