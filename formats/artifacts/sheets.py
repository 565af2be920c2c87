"""Artifacts of the dots: the manifest of printed sheets, ``sheet.toml``, and ``camera.toml``.

Lengths stay in millimetres and angles in degrees, as in the dataclasses.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import MAIN_SEQUENCE_LENGTH, SECTION_LENGTH, check_window, sequences
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, Distortion, Manifest, Sheet
from locatk.core.errors import InputError
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    NOT_NEGATIVE,
    POSITIVE,
    Integer,
    InvalidValueError,
    ListOf,
    Number,
    Row,
    Text,
)
from locatk.formats.artifacts.schema import Artifact, Key, Table, Tables, Values, refuse_repeated

SHEET_FILE = "sheet.toml"
"""Name of the attachment that holds the manifest of a session or a solution."""

CAMERA_FILE = "camera.toml"
"""Name of the attachment that holds the camera of a session."""

MANIFEST_FORMAT = "locatk-dot-sheets"
CAMERA_FORMAT = "locatk-camera"

MAX_DPI = 10_000
MAX_FRAME_SIDE_PX = 65_535

PRINTER_SCALE = Number(
    0.5, 2.0, hint="A ruler of 100 mm that measures 100.2 mm has a scale of 1.002"
)
"""Measured over nominal length; outside of the range it is an error of the user."""

CODECS = Text(tuple(sequences.FOURTH_DIGITS))
GRID_POSITION = Row(Integer(0, SECTION_LENGTH - 1), 2)
GRID_SIZE = Row(Integer(1, SECTION_LENGTH), 2)
SECTION = Row(Integer(0, MAIN_SEQUENCE_LENGTH - 1), 2)


# ---- manifests


def _sheet_of(values: Values) -> Sheet:
    check_area(values)
    if values["position_mm"] is None and values["heading_deg"] is not None:
        raise InvalidValueError(
            "a heading without position_mm",
            "heading_deg",
            "Give both for a tile of a floor, otherwise neither",
        )
    covariance = values["covariance_mm_deg"]
    if covariance is not None:
        if values["position_mm"] is None:
            raise InvalidValueError(
                "a covariance without position_mm",
                "covariance_mm_deg",
                "Give both for a tile of a floor, otherwise neither",
            )
        if not is_covariance(np.array(covariance)):
            raise InvalidValueError("expected a covariance", "covariance_mm_deg")
    heading_deg = 0.0 if values["heading_deg"] is None else values["heading_deg"]
    return Sheet(**{**values, "heading_deg": heading_deg})


def is_covariance(matrix: NDArray[np.float64]) -> bool:
    """Return whether a matrix is symmetric and has no negative eigenvalue, but for rounding."""
    tolerance = 1e-6 * np.abs(matrix).max()
    is_symmetric = bool((np.abs(matrix - matrix.T) <= tolerance).all())
    return is_symmetric and bool((np.linalg.eigvalsh(matrix) >= -tolerance).all())


def _distortion_of(values: Values) -> Distortion:
    x, y = values["x_mm"], values["y_mm"]
    shapes = {tuple(len(row) for row in rows) for rows in (x, y)}
    if len(shapes) > 1 or len({len(row) for row in x}) > 1:
        raise InvalidValueError("expected as many rows and columns as x_mm", "y_mm")
    if len(x) < 2 or len(x[0]) < 2:
        raise InvalidValueError("expected at least two rows and columns", "x_mm")
    return Distortion(x, y)


def check_area(values: Values) -> None:
    """Refuse an area (``origin``, ``size``, ``section``) that leaves its section."""
    try:
        check_window(values["origin"], values["size"], values["section"])
    except InputError as error:
        raise InvalidValueError(error.message, "origin", error.hint) from None


def _manifest_of(values: Values) -> Manifest:
    pitch_mm = values["pitch_mm"]
    for key, limit_mm, limit in (
        ("dot_mm", pitch_mm, "the pitch"),
        ("offset_mm", pitch_mm / 2, "half the pitch"),
    ):
        if values[key] is None:
            values[key] = pitch_mm / round(1 / DOT_OFFSET_PITCHES)
        if values[key] >= limit_mm:
            raise InvalidValueError(f"expected less than {limit}, {limit_mm:g} mm", key)
    scale = (values.pop("scale_x"), values.pop("scale_y"))
    manifest = Manifest(**values, scale=scale)
    _check_sheets(manifest.sheets)
    return manifest


def _check_sheets(sheets: tuple[Sheet, ...]) -> None:
    """Refuse sheets that cannot be distinguished."""
    names = [sheet.id for sheet in sheets]
    is_tile = np.array([sheet.position_mm is not None for sheet in sheets])
    refuse_repeated(names, "sheets", "id")
    if "floor" in names and is_tile.any():
        raise InvalidValueError(
            "'floor' is the name of the frame of all tiles", f"sheets[{names.index('floor')}].id"
        )
    # Tiles may share a rim, which is one position on the floor; other sheets may share nothing.
    low = np.array([sheet.origin for sheet in sheets])
    high = low + [sheet.size for sheet in sheets]
    section = np.array([sheet.section for sheet in sheets])
    for number in range(1, len(sheets)):
        before = slice(number)
        is_shared = (low[before] < high[number]).all(axis=1)
        is_shared &= (low[number] < high[before]).all(axis=1)
        is_shared &= (section[before] == section[number]).all(axis=1)
        is_shared &= ~(is_tile[before] & is_tile[number])
        if is_shared.any():
            raise InvalidValueError(
                f"shares positions with sheet {names[int(is_shared.argmax())]!r}",
                f"sheets[{number}].origin",
                "Give each sheet an area of its own, or position_mm to the tiles of a floor",
            )


def _manifest_values(manifest: Manifest) -> Values:
    return {
        **vars(manifest),
        "scale_x": manifest.scale[0],
        "scale_y": manifest.scale[1],
        "sheets": [_sheet_values(sheet, manifest.pitch_mm) for sheet in manifest.sheets],
    }


def _sheet_values(sheet: Sheet, pitch_mm: float) -> Values:
    width_mm, height_mm = (count * pitch_mm for count in sheet.size)
    return {
        "#": f"{width_mm:.1f} x {height_mm:.1f} mm of pattern",
        **vars(sheet),
        "heading_deg": None if sheet.position_mm is None else sheet.heading_deg,
        "distortion_sigma_mm": sheet.distortion_sigma_mm
        if any(sheet.distortion_sigma_mm)
        else None,
        "distortion_sigma_deg": sheet.distortion_sigma_deg or None,
    }


_NUMBER_PAIR = Row(ANY_NUMBER, 2)

_DISPLACEMENTS = ListOf(ListOf(ANY_NUMBER))

_DISTORTION = Table(
    (
        Key(
            "x_mm",
            _DISPLACEMENTS,
            "measured errors of the print along the paper's width, added after the scale: rows of "
            "values at the nodes of a regular grid, from the lower left to the upper right end of "
            "the printed area; between the nodes by cubic convolution",
            is_si=False,
        ),
        Key("y_mm", _DISPLACEMENTS, "the same up the paper", is_si=False),
    ),
    _distortion_of,
    vars,
)

_SHEET = Table(
    (
        Key("id", Text(is_blank_allowed=False), "name that is printed in the margin, once each"),
        Key("origin", GRID_POSITION, "grid coordinates of the upper left dot"),
        Key("size", GRID_SIZE, "columns and rows of dots; the area may not leave its section"),
        Key("section", SECTION, "section of the pattern", (0, 0)),
        Key("page_mm", Row(POSITIVE, 2), "width and height of the paper", is_si=False),
        Key(
            "first_mm",
            _NUMBER_PAIR,
            "from the paper's upper left corner right and down to the grid position of the upper "
            "left dot, as sent to the printer",
            is_si=False,
        ),
        Key(
            "position_mm",
            _NUMBER_PAIR,
            "of a tile: position of the paper's lower left corner on the floor",
            None,
            "none",
            is_si=False,
        ),
        Key(
            "heading_deg",
            ANY_NUMBER,
            "of a tile: rotation of the paper on the floor, counter-clockwise",
            None,
            "0",
            is_si=False,
        ),
        Key(
            "covariance_mm_deg",
            Row(Row(ANY_NUMBER, 3), 3),
            "of a tile: covariance of position_mm and heading_deg as measured by `locatk calibrate "
            "sheet`",
            None,
            "as designed, exact",
            is_si=False,
        ),
        Key("distortion", _DISTORTION, default=None),
        Key(
            "distortion_sigma_mm",
            Row(NOT_NEGATIVE, 2),
            "standard deviation of the print's other errors, along the paper's axes",
            (0.0, 0.0),
            is_si=False,
        ),
        Key(
            "distortion_sigma_deg",
            NOT_NEGATIVE,
            "standard deviation of the local rotation of the print by these errors",
            0.0,
            is_si=False,
        ),
    ),
    _sheet_of,
)

MANIFEST: Artifact[Manifest] = Artifact(
    SHEET_FILE,
    MANIFEST_FORMAT,
    Table(
        (
            Key("codec", CODECS, "sequences of the pattern"),
            Key(
                "pitch_mm",
                POSITIVE,
                "distance of two grid positions, as sent to the printer",
                is_si=False,
            ),
            Key("dot_mm", POSITIVE, "width of a dot", None, "1/6 of the pitch", is_si=False),
            Key(
                "offset_mm",
                POSITIVE,
                "from a grid position to its dot, below half the pitch",
                None,
                "1/6 of the pitch",
                is_si=False,
            ),
            Key("dpi", Integer(1, MAX_DPI), "resolution of the printer", 300),
            Key(
                "scale_x",
                PRINTER_SCALE,
                "measured over nominal length along the paper's width: 1.002 if a ruler of 100 mm "
                "measures 100.2 mm",
                1.0,
            ),
            Key("scale_y", PRINTER_SCALE, "the same along the paper's height", 1.0),
            Key("notes", ListOf(Text()), "for people", ()),
            Key("sheets", Tables(_SHEET, min_count=1)),
        ),
        _manifest_of,
        _manifest_values,
    ),
)
"""A manifest as a file."""

dumps_manifest, loads_manifest = MANIFEST.dumps, MANIFEST.loads
write_manifest, read_manifest = MANIFEST.write, MANIFEST.read
attached_manifest = MANIFEST.attached


# ---- cameras


def _camera_of(values: Values) -> Camera:
    camera = Camera(**values)
    (width, height), (x, y) = camera.size, camera.centre_px
    for axis, centre, count in (("x", x, width), ("y", y, height)):
        if not -0.5 <= centre <= count - 0.5:
            raise InvalidValueError(
                f"{axis} {centre:g} is outside the frame of {count} px", "centre_px"
            )
    # Beyond 1 / sqrt(|k|) the division model is not invertible.
    corner = math.hypot(max(x, width - 1 - x), max(y, height - 1 - y)) / camera.focal_px
    if abs(camera.radial) * corner**2 >= 1:
        raise InvalidValueError(
            f"expected less than {1 / corner**2:.3g} in size, so that the corners are in the image",
            "radial",
            "k is for offsets in focal lengths: multiply a k in px^-2 by focal_px squared",
        )
    return camera


CAMERA: Artifact[Camera] = Artifact(
    CAMERA_FILE,
    CAMERA_FORMAT,
    Table(
        (
            Key(
                "size_px",
                Row(Integer(1, MAX_FRAME_SIDE_PX), 2),
                "width and height of a frame",
                value_name="size",
            ),
            Key("focal_px", POSITIVE, "focal length"),
            Key(
                "centre_px",
                _NUMBER_PAIR,
                "intersection of the optical axis with the frame; the centre of the upper left "
                "pixel is (0, 0)",
            ),
            Key(
                "radial",
                ANY_NUMBER,
                "k: a point at distance r from the centre, in focal lengths, is undistorted to "
                "r / (1 + k r^2). Below 0 for barrel distortion. The paper gives k in px^-2: "
                "multiply that by `focal_px` squared",
                0.0,
            ),
        ),
        _camera_of,
        vars,
    ),
)
"""A camera as a file."""

dumps_camera, loads_camera = CAMERA.dumps, CAMERA.loads
write_camera, read_camera = CAMERA.write, CAMERA.read
attached_camera = CAMERA.attached
