"""Options of ``locatk map design``: cells, walls and the geometry of the landmarks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from locatk.cli.command import combine
from locatk.cli.options import number
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.landmarks.landmark import Geometry
    from locatk.core.landmarks.map.floor import Cell, Wall

LARGEST_SIDE = 2_000

THRESHOLD_MT_PER_T = 2.75
"""Of the remanence, at which the default bars have the paper's radii (facts 2.2)."""

_SPAN = re.compile(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?")


class Size(click.ParamType):
    """Rows and columns, as in ``24x24``."""

    name = "ROWSxCOLS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        found = re.fullmatch(r"(\d+)[xX](\d+)", str(value).strip())
        if found is None:
            self.fail(f"{value!r} is not rows x columns as in 24x24.", param, ctx)
        rows, columns = int(found[1]), int(found[2])
        if not (1 <= rows <= LARGEST_SIDE and 1 <= columns <= LARGEST_SIDE):
            self.fail(f"{value!r} has a side outside of 1 to {LARGEST_SIDE}.", param, ctx)
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
                here, there = (list(_block(side)) for side in item.split(":"))
            except ValueError:
                self.fail(f"{item!r} is not cell:cell as in 2,3:2,4.", param, ctx)
            if len(here) != len(there):
                self.fail(f"{item!r} has {len(here)} and {len(there)} cells.", param, ctx)
            for one, other in zip(here, there, strict=True):
                if abs(one[0] - other[0]) + abs(one[1] - other[1]) != 1:
                    self.fail(f"{_told(one)} and {_told(other)} are no neighbours.", param, ctx)
                walls.append((min(one, other), max(one, other)))
        return tuple(walls)


def _block(item: str) -> Iterator[Cell]:
    """Cells of ``rows,columns``, each a number or a range; ValueError for anything else."""
    spans = [_SPAN.fullmatch(part) for part in item.split(",")]
    if len(spans) != 2 or spans[0] is None or spans[1] is None:
        raise ValueError(repr(item))
    (top, bottom), (left, right) = (
        (int(span[1]), int(span[2] or span[1])) for span in spans if span is not None
    )
    if not (top <= bottom < LARGEST_SIDE and left <= right < LARGEST_SIDE):
        raise ValueError(repr(item))
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            yield row, column


def _told(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def on_floor(size: tuple[int, int], cells: list[Cell], option: str) -> None:
    """Refuse cells that are not on the floor."""
    for row, column in cells:
        if row >= size[0] or column >= size[1]:
            raise click.BadParameter(
                f"{row},{column} is no cell of the floor, whose last one is "
                f"{size[0] - 1},{size[1] - 1}.",
                param_hint=f"'{option}'",
            )


geometry_options = combine(
    number("--bar", default="30x10x5", type=Bar(), metavar="LxWxH", help="Of each bar, in mm."),
    number("--remanence", default=1.2, metavar="T", help="Of the bars: N35 has 1.2, ferrite 0.4."),
    number("--radius", default=25.0, metavar="MM", help="From the middle to each bar's middle."),
    number("--sensor-height", default=12.0, metavar="MM", help="From the bars' tops to the chips."),
    number("--circle", default=25.0, metavar="MM", help="Radius of the hall sensors' circle."),
    click.option(
        "--threshold",
        type=float,
        metavar="MT",
        help="Field at which a sensor is in a landmark's territory.  [default: 2.75 for each "
        "tesla of the remanence]",
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
    """The landmark that the options describe."""
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
