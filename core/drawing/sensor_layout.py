"""Drawing of a layout of sensors at true size, to compare with the hardware."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.drawing.marks import (
    TRUE_SIZE_INSTRUCTION,
    Circle,
    Group,
    Mark,
    Page,
    Point,
    Text,
    arrow,
    capital_height,
    cross,
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
from locatk.core.drawing.placement import Obstacles
from locatk.core.errors import InputError

AXIS_MM = 10.0
"""Length of the arrows of the axes."""

ARROW_HEAD_MM = 2.0

CROSS_ARM_MM = 2.0

LABEL_OFFSETS_MM = (1.0, 1.6, 2.4, 3.4)
"""Distances of a label from the lines of its cross, in the order in which they are tried."""

EDGE_MM = 8.0
"""Free space around the outermost sensors, for their labels."""


def draw_sensor_layout(
    labels: Sequence[str],
    position_m: ArrayLike,
    paper_mm: Point,
    *,
    title: str,
    margin_mm: float = 10.0,
) -> tuple[Page, ...]:
    """Draw sensors as seen from above at true size, and a table of their positions.

    The forward direction, x, points up on the page, and y to the left. The axes start at the origin
    of the frame of the sensors.

    Parameters
    ----------
    labels : sequence of str
        Number or name of each sensor.
    position_m : (n, 2) or (n, 3) array_like
        Sensors that differ only in z share a cross.
    paper_mm : (width, height)
        Rotated if the sensors fit only then.
    title : str
    margin_mm : float

    Raises
    ------
    InputError
        The sensors do not fit on the paper.
    """
    position_mm = np.asarray(position_m, float) * 1e3
    check_margin(paper_mm, margin_mm)
    on_page = np.column_stack([-position_mm[:, 1], position_mm[:, 0]])
    lower = np.minimum(on_page.min(axis=0), [-AXIS_MM, 0.0]) - EDGE_MM
    upper = np.maximum(on_page.max(axis=0), [0.0, AXIS_MM]) + EDGE_MM
    frame, corner = _place(upper - lower, paper_mm, margin_mm, title)
    plan = _draw_plan(labels, on_page, corner - lower)
    pages = [UnnumberedPage(frame, (Group("sensors", tuple(plan)),))]
    return number_pages([*pages, *_table(labels, position_mm, frame)])


def _place(
    extent_mm: NDArray[np.float64], paper_mm: Point, margin_mm: float, title: str
) -> tuple[PageFrame, NDArray[np.float64]]:
    """Return a frame that has space for the extent, and the lower left corner of that space."""
    notes = (
        f"Seen from above, true size; x, the forward direction, is up, y is left. "
        f"{TRUE_SIZE_INSTRUCTION}",
    )
    available = np.zeros(2)
    for size_mm in (paper_mm, paper_mm[::-1]):
        frame = PageFrame(size_mm, margin_mm, title, notes)
        left, bottom, right, top = frame.content_box
        available = np.array([right - left, top - bottom])
        if (extent_mm <= available).all():
            return frame, np.array([left, bottom]) + (available - extent_mm) / 2
    needed = (float(extent_mm[0]), float(extent_mm[1]))
    larger = larger_paper_text(paper_mm[::-1], needed, (float(available[0]), float(available[1])))
    raise InputError(
        f"the sensors, {size_text(needed, 0)}, do not fit on paper of {size_text(paper_mm)}",
        hint=f"Use a larger paper, as in --size {larger}",
    )


def _draw_plan(
    labels: Sequence[str], on_page: NDArray[np.float64], origin: NDArray[np.float64]
) -> list[Mark]:
    """Draw the axes at ``origin``, and a cross with a label for each sensor.

    Labels without space between the crosses are left out; the table has them.
    """
    x0, y0 = float(origin[0]), float(origin[1])
    shared: dict[tuple[float, float], list[str]] = {}
    for label, (x, y) in zip(labels, np.round(on_page + origin, 6).tolist(), strict=True):
        shared.setdefault((x, y), []).append(label)
    marks: list[Mark] = [
        Circle((x0, y0), 0.6),
        *arrow((x0, y0), (x0, y0 + AXIS_MM), ARROW_HEAD_MM),
        *arrow((x0, y0), (x0 - AXIS_MM, y0), ARROW_HEAD_MM),
        *(mark for point in shared for mark in cross(point, CROSS_ARM_MM)),
    ]
    obstacles = Obstacles(marks)
    texts: list[Text] = []
    for point, names in shared.items():
        texts += obstacles.place(_labels_near(printable(", ".join(names)), point))
    for name, tip in (("x", (x0, y0 + AXIS_MM)), ("y", (x0 - AXIS_MM, y0))):
        texts += obstacles.place(_labels_near(name, tip, bold=True))
    return [*marks, *texts]


def _labels_near(text: str, point: Point, *, bold: bool = False) -> Iterator[Text]:
    """Yield a text at the right and left of a point, above and below it, nearest first."""
    height = capital_height(TEXT_POINTS)
    for dx, dy in itertools.product(LABEL_OFFSETS_MM, repeat=2):
        for rise in (dy, -dy - height):
            yield Text(text, (point[0] + dx, point[1] + rise), TEXT_POINTS, bold=bold)
            yield Text(text, (point[0] - dx, point[1] + rise), TEXT_POINTS, "end", bold=bold)


def _table(
    labels: Sequence[str], position_mm: NDArray[np.float64], frame: PageFrame
) -> list[UnnumberedPage]:
    """Set the positions in a table."""
    axes = ("x", "y", "z")[: position_mm.shape[1]]
    columns = [TableColumn("sensor", 20.0)]
    columns += [TableColumn(f"{axis} (mm)", 15.0, is_right_aligned=True) for axis in axes]
    rows = [
        [printable(label), *(f"{value:.2f}" for value in row)]
        for label, row in zip(labels, position_mm.tolist(), strict=True)
    ]
    return table_pages(rows, columns, frame)
