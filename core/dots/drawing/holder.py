"""Drawing of a camera over printed dots, to build its holder.

A page has the side view at true size: paper, lens, sensor, the cone of the rays, and the depth of
field; beside it is the field from above, enlarged, with dots and the smallest window.
"""

from __future__ import annotations

import math

import numpy as np

from locatk.core.dots.codec import DOT_DIRECTIONS
from locatk.core.dots.design.camera import MIN_WINDOW_DOTS, CameraReport
from locatk.core.dots.design.camera_optics import illuminance_text
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES
from locatk.core.drawing.marks import (
    TRUE_SIZE_INSTRUCTION,
    Circle,
    Group,
    Line,
    Mark,
    Page,
    Point,
    Polygon,
    Text,
    arrow,
    capital_height,
    rectangle,
    shifted,
)
from locatk.core.drawing.pages import (
    TEXT_POINTS,
    PageFrame,
    TableColumn,
    UnnumberedPage,
    check_margin,
    larger_paper_text,
    number_pages,
    printable,
    size_text,
    table_pages,
)
from locatk.core.errors import InputError
from locatk.core.units import length_text

HOLDER_TITLE = "Camera over printed dots"

LEFT_MM = 14.0
"""Space at the left of the side view for the depth of field."""

LABEL_MM = 58.0
"""Space at the right of the side view for dimensions and their texts."""

BELOW_MM = 8.0
"""Space below the paper for the width of the field."""

MIN_TOP_VIEW_MM = 45.0
"""Least width of the enlarged field."""

MAX_TOP_VIEW_MM = 90.0
"""Largest side of the enlarged field."""

HEAD_MM = 1.8
"""Length of the heads of dimension arrows."""

MAX_DRAWN_DOTS = 3000

TABLE_MM = 50.0
"""Space for the table of dimensions below the drawing."""


def draw_holder(report: CameraReport, paper_mm: Point, margin_mm: float = 10.0) -> tuple[Page, ...]:
    """Draw side view, field and dimensions of a camera.

    Parameters
    ----------
    report : CameraReport
    paper_mm : (width, height)
        Rotated if the drawing fits only then.
    margin_mm : float

    Raises
    ------
    InputError
        The side view does not fit on the paper at true size.
    """
    check_margin(paper_mm, margin_mm)
    setup = report.setup
    width = max(1e3 * report.field_m[0], 1e3 * setup.size_px[0] * setup.pixel_m, 14.0)
    height = 1e3 * (setup.distance_m + report.image_distance_m) + 12.0
    needed = (LEFT_MM + width + LABEL_MM + MIN_TOP_VIEW_MM, height + BELOW_MM + TABLE_MM)
    frame = _frame(report, paper_mm, margin_mm, needed)
    left, _, right, top = frame.content_box
    top_left = left + LEFT_MM + width + LABEL_MM
    scale, field_height = _field_scale(report, right - top_left)
    # Both views stand on one line; the taller one is below the notes.
    base = top - max(height, field_height + 10.0) - BELOW_MM
    middle = left + LEFT_MM + width / 2
    side = Group("side view", tuple(_side_view(report, (middle, base + BELOW_MM), width)))
    field = Group("field", tuple(_field_view(report, (top_left, base + BELOW_MM), scale)))
    dimensions = Group("dimensions", tuple(_table(report, frame, base)))
    return number_pages([UnnumberedPage(frame, (side, field, dimensions))])


def _frame(report: CameraReport, paper_mm: Point, margin_mm: float, needed: Point) -> PageFrame:
    """Return the frame of a page with enough space for the drawing."""
    setup = report.setup
    title = printable(f"{HOLDER_TITLE}: {setup.sensor.name}, {length_text(setup.lens.focal_m)}")
    notes = (
        "Side view at true size. Distances are those of a thin lens: build the holder so that the "
        "lens can be turned, and focus it on the paper. Paint the inside black; the LEDs are "
        f"beside the lens. {TRUE_SIZE_INSTRUCTION}",
    )
    available = (0.0, 0.0)
    for size_mm in (paper_mm, paper_mm[::-1]):
        frame = PageFrame(size_mm, margin_mm, title, notes)
        left, bottom, right, top = frame.content_box
        available = (right - left, top - bottom)
        if needed[0] <= available[0] and needed[1] <= available[1]:
            return frame
    larger = larger_paper_text(paper_mm[::-1], needed, available)
    raise InputError(
        f"the drawing of the camera, {size_text(needed, 0)}, does not fit on paper of "
        f"{size_text(paper_mm)}",
        hint=f"Use a larger paper, as in --size {larger}, or a shorter distance",
    )


def _side_view(report: CameraReport, origin: Point, width_mm: float) -> list[Mark]:
    """Draw the side view; ``origin`` is the point of the paper on the optical axis."""
    setup = report.setup
    x, y = origin
    distance, image = 1e3 * setup.distance_m, 1e3 * report.image_distance_m
    lens, sensor = y + distance, y + distance + image
    half_field = 1e3 * report.field_m[0] / 2
    half_sensor = 1e3 * setup.size_px[0] * setup.pixel_m / 2
    aperture = 1e3 * setup.lens.focal_m / setup.lens.f_number / 2
    half = width_mm / 2
    marks: list[Mark] = [
        Line((x - half, y), (x + half, y), 0.5),
        Line((x - half_sensor, sensor), (x + half_sensor, sensor), 0.8),
        Line((x, y - 2), (x, sensor + 3), 0.08, dash_mm=1.0),
        # The lens as two arcs, and its aperture.
        _lens_outline((x, lens), max(1.6 * aperture, 2.0)),
    ]
    for sign in (-1, 1):
        marks += [
            Line((x + sign * half_field, y), (x - sign * half_sensor, sensor), 0.1),
            Line((x + sign * aperture, lens), (x + sign * (aperture + 2.5), lens), 0.4),
        ]
    marks += _depth_of_field(report, (x, y), half)
    column = x + half + 4.0
    marks += _dimension(column, y, lens, f"lens to paper {length_text(setup.distance_m, 4)}")
    marks += _dimension(
        column, lens, sensor, f"sensor to lens {length_text(report.image_distance_m, 4)}"
    )
    for level in (y, lens, sensor):
        marks.append(Line((x + half * 0.7, level), (column + 1.5, level), 0.06))
    baseline = y - 2.0 - capital_height(TEXT_POINTS)
    field = f"field {1e3 * report.field_m[0]:.3g} x {length_text(report.field_m[1])}"
    marks.append(Text(field, (x - half + 1.5, baseline - 1.0), TEXT_POINTS))
    marks.append(
        Text(
            f"sensor {2 * half_sensor:.3g} mm wide",
            (x, sensor + 4.0),
            TEXT_POINTS,
            "middle",
        )
    )
    return marks


def _lens_outline(centre: Point, half_width: float) -> Polygon:
    """Return a biconvex lens."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    thickness = 0.22 * half_width
    corners = zip(
        (centre[0] + half_width * np.cos(angle)).tolist(),
        (centre[1] + thickness * np.sin(angle)).tolist(),
        strict=True,
    )
    return Polygon(tuple(corners), width_mm=0.2)


def _depth_of_field(report: CameraReport, origin: Point, half: float) -> list[Mark]:
    """Draw the heights of the paper between which it is sharp enough."""
    x, y = origin
    distance = 1e3 * report.setup.distance_m
    high = distance - 1e3 * report.near_m
    # Below the paper the space is for texts.
    low = min(1e3 * report.far_m - distance, 6.0)
    column = x - half - 1.0
    return [
        Line((x - half, y + high), (x + half, y + high), 0.08, dash_mm=0.8),
        *arrow((column, y), (column, y + high), min(HEAD_MM, high / 2), 0.12),
        *arrow((column, y), (column, y - low), min(HEAD_MM, low / 2), 0.12),
        Text(
            "sharp enough",
            (column - 1.0, y + (high - low) / 2),
            TEXT_POINTS,
            "middle",
            angle_deg=90,
        ),
    ]


def _dimension(x: float, low: float, high: float, text: str) -> list[Mark]:
    """Draw a vertical dimension with its text at the right."""
    middle = (low + high) / 2
    head = min(HEAD_MM, (high - low) / 3)
    return [
        *arrow((x, middle), (x, low), head, 0.12),
        *arrow((x, middle), (x, high), head, 0.12),
        Text(text, (x + 2.0, middle - capital_height(TEXT_POINTS) / 2), TEXT_POINTS),
    ]


def _field_scale(report: CameraReport, width_mm: float) -> tuple[float, float]:
    """Return the scale of the enlarged field, and its height."""
    field = (1e3 * report.field_m[0], 1e3 * report.field_m[1])
    scale = min(min(width_mm, MAX_TOP_VIEW_MM) / field[0], MAX_TOP_VIEW_MM / field[1])
    scale = float(math.floor(scale)) if scale >= 1 else round(scale, 2)
    return scale, scale * field[1]


def _field_view(report: CameraReport, corner: Point, scale: float) -> list[Mark]:
    """Draw the field from above, enlarged, with dots and the smallest window at 45 degrees."""
    setup = report.setup
    size = (1e3 * scale * report.field_m[0], 1e3 * scale * report.field_m[1])
    x, y = corner
    middle = (x + size[0] / 2, y + size[1] / 2)
    pitch = 1e3 * setup.pitch_m * scale
    columns, rows = (math.ceil(side / pitch) + 1 for side in size)
    marks: list[Mark] = [rectangle((x, y, x + size[0], y + size[1]), 0.3)]
    if columns * rows <= MAX_DRAWN_DOTS:
        rng = np.random.default_rng(1)
        nodes = np.stack(
            np.meshgrid(np.arange(columns) - columns / 2, np.arange(rows) - rows / 2), axis=-1
        ).reshape(-1, 2)
        symbol = rng.integers(0, 4, len(nodes))
        centres = pitch * (nodes + 0.25 + DOT_OFFSET_PITCHES * DOT_DIRECTIONS[symbol])
        radius = setup.dot_pitches * pitch / 2
        for dx, dy in centres.tolist():
            if abs(dx) + radius < size[0] / 2 and abs(dy) + radius < size[1] / 2:
                marks.append(_disc((middle[0] + dx, middle[1] + dy), radius))
    label = "smaller than the smallest window"
    if report.window_dots >= MIN_WINDOW_DOTS:
        label = "with the smallest window at 45 degrees"
        reach = pitch * (MIN_WINDOW_DOTS - 1 + 3 * DOT_OFFSET_PITCHES) / math.sqrt(2)
        corners = tuple(
            (middle[0] + reach * math.cos(angle), middle[1] + reach * math.sin(angle))
            for angle in np.pi / 2 * np.arange(4)
        )
        marks.append(Polygon(corners, width_mm=0.3))
    marks.append(Circle(middle, 0.8, 0.2))
    text = f"field from above, {scale:g} : 1, {label}"
    marks.append(Text(text, (x, y + size[1] + 2.0), TEXT_POINTS))
    return marks


def _disc(centre: Point, radius: float) -> Polygon:
    angles = 2 * np.pi * np.arange(10) / 10
    corners = tuple(
        (centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle))
        for angle in angles
    )
    return Polygon(corners, filled=True)


def _table(report: CameraReport, frame: PageFrame, top_mm: float) -> list[Mark]:
    """Set the dimensions in a table below the drawing."""
    setup = report.setup
    far = "any" if math.isinf(report.far_m) else length_text(report.far_m, 4)
    rows = (
        ("lens (principal plane) to paper", length_text(setup.distance_m, 4)),
        ("sensor to lens", length_text(report.image_distance_m, 4)),
        ("sensor to paper", length_text(setup.distance_m + report.image_distance_m, 4)),
        ("lens to paper, sharp enough", f"{length_text(report.near_m, 4)} to {far}"),
        (
            "field on the paper",
            f"{1e3 * report.field_m[0]:.4g} x {length_text(report.field_m[1], 4)}",
        ),
        ("diagonal of the field", length_text(2 * setup.corner_m, 4)),
        ("dots in view, at least", f"{report.window_dots} x {report.window_dots}"),
        ("exposure, LEDs pulsed", f"{setup.exposure_s * 1e6:.0f} us"),
        ("light on the paper", illuminance_text(report.needed_illuminance_lx)),
    )
    columns = (TableColumn("dimension", 60.0), TableColumn("", 60.0))
    below = PageFrame(
        (frame.size_mm[0], frame.size_mm[1]), frame.margin_mm, "", (), has_rulers=frame.has_rulers
    )
    page = table_pages(rows, columns, below)[0]
    shift = top_mm - 8.0 - below.content_box[3]
    return [shifted(mark, 0.0, shift) for group in page.groups for mark in group.marks]
