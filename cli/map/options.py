"""Options of ``locatk map design``: cells, walls and the geometry of the landmarks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from locatk.cli.command import section
from locatk.cli.options import number
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.landmarks.landmark import Geometry
    from locatk.core.landmarks.map.floor import Cell, Wall

MAX_ROWS = 2_000
"""Rows or columns of a map (:data:`locatk.formats.artifacts.maps.MAX_ROWS`)."""

THRESHOLD_MT_PER_T = 2.75
"""Default threshold of the territory per remanence: the default bars of 1.2 T then have the radii
of the paper, 45 and 54 mm (section 3.1)."""

_SPAN = re.compile(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?")


class Size(click.ParamType):
    """Rows and columns, as in ``24x24``."""

    name = "ROWSxCOLS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)[xX](\d+)", str(value).strip())
        if match is None:
            self.fail(f"{value!r} is not rows x columns as in 24x24.", param, ctx)
        rows, columns = int(match[1]), int(match[2])
        if not (1 <= rows <= MAX_ROWS and 1 <= columns <= MAX_ROWS):
            self.fail(f"{value!r} does not have 1 to {MAX_ROWS} rows and columns.", param, ctx)
        return rows, columns


class Bar(click.ParamType):
    """Length, width and height in mm, as in ``30x10x5``."""

    name = "LxWxH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value
        try:
            length, width, height = (float(part) for part in str(value).lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not length x width x height in mm as in 30x10x5.", param, ctx)
        return length, width, height


class Cells(click.ParamType):
    """Cells as ``row,column``, from 0, with ranges, as in ``2,3;4,0-5``."""

    name = "CELLS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Cell, ...]:
        try:
            return tuple(cell for item in str(value).split(";") for cell in _block(item))
        except ValueError as error:
            self.fail(f"{error} is not row,column as in 2,3 or 4,0-5.", param, ctx)


class Walls(click.ParamType):
    """Walls between neighbouring cells, as in ``2,3:2,4`` or ``0-5,3:0-5,4``."""

    name = "CELLS:CELLS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Wall, ...]:
        walls: list[Wall] = []
        for item in str(value).split(";"):
            try:
                first_cells, second_cells = (list(_block(side)) for side in item.split(":"))
            except ValueError:
                self.fail(f"{item!r} is not cell:cell as in 2,3:2,4.", param, ctx)
            if len(first_cells) != len(second_cells):
                self.fail(
                    f"{item!r} has {len(first_cells)} and {len(second_cells)} cells.", param, ctx
                )
            for first, second in zip(first_cells, second_cells, strict=True):
                if abs(first[0] - second[0]) + abs(first[1] - second[1]) != 1:
                    self.fail(
                        f"{_cell_text(first)} and {_cell_text(second)} are not neighbours.",
                        param,
                        ctx,
                    )
                walls.append((min(first, second), max(first, second)))
        return tuple(walls)


def _block(item: str) -> Iterator[Cell]:
    """Yield the cells of ``rows,columns``, each a number or a range.

    Raises ValueError for other texts.
    """
    spans = [_SPAN.fullmatch(part) for part in item.split(",")]
    if len(spans) != 2 or spans[0] is None or spans[1] is None:
        raise ValueError(repr(item))
    (top, bottom), (left, right) = (
        (int(span[1]), int(span[2] or span[1])) for span in spans if span is not None
    )
    if not (top <= bottom < MAX_ROWS and left <= right < MAX_ROWS):
        raise ValueError(repr(item))
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            yield row, column


def _cell_text(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def check_cells(size: tuple[int, int], cells: list[Cell], option: str) -> None:
    """Raise click.BadParameter if a cell of an option is not on the floor."""
    for row, column in cells:
        if row >= size[0] or column >= size[1]:
            raise click.BadParameter(
                f"{row},{column} is not a cell of the floor, whose last one is "
                f"{size[0] - 1},{size[1] - 1}.",
                param_hint=f"'{option}'",
            )


geometry_options = section(
    "Landmarks and sensors",
    number(
        "--bar",
        default="30x10x5",
        type=Bar(),
        metavar="LxWxH",
        help="Length, width and height of a bar magnet in mm.",
    ),
    number(
        "--remanence",
        default=1.2,
        metavar="T",
        help="Remanence of the bars; N35 has 1.2, ferrite 0.4.",
    ),
    number(
        "--radius",
        default=25.0,
        metavar="MM",
        help="Distance from the centre of a landmark to the centres of its bars.",
    ),
    number(
        "--sensor-height",
        default=12.0,
        metavar="MM",
        help="Height of the hall sensors above the tops of the bars.",
    ),
    number("--circle", default=25.0, metavar="MM", help="Radius of the circle of hall sensors."),
    click.option(
        "--threshold",
        type=float,
        metavar="MT",
        help="Field from which on a sensor counts as above a landmark.  [default: 2.75 per "
        "tesla of remanence]",
    ),
)


def geometry_of(
    bar: tuple[float, float, float],
    remanence: float,
    radius: float,
    sensor_height: float,
    circle: float,
    threshold: float | None,
) -> Geometry:
    """Return the landmark that :data:`geometry_options` describe."""
    from locatk.core.landmarks.landmark import Geometry

    if threshold is None:
        threshold = round(THRESHOLD_MT_PER_T * remanence, 6)
    length, width, height = bar
    return Geometry(
        bar_length_m=metres(length),
        bar_width_m=metres(width),
        bar_height_m=metres(height),
        remanence_t=remanence,
        radius_m=metres(radius),
        sensor_height_m=metres(sensor_height),
        circle_m=metres(circle),
        threshold_t=metres(threshold),
    )
