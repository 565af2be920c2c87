"""Options that the commands of rooms share, and their conversion to a room and a request."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import options
from locatk.cli.command import combine, section
from locatk.cli.options import number
from locatk.core.errors import InputError
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.lighthouse.design.placement import RoomRequest
    from locatk.core.lighthouse.room import Room

MAX_LENGTH_MM = 1e6

MIN_EXTENT_MM = 10.0
"""Least sides of a working area, and least difference of the heights of --volume: shorter ones are
lengths in metres."""

_NUMBER = r"[0-9]+(?:\.[0-9]*)?|\.[0-9]+"
_SIGNED = rf"-?(?:{_NUMBER})"

ROOM_FILES = (".toml", ".dxf", ".svg")

MOUNT_NAMES = ("wall", "ceiling", "tripod")


class Pattern(click.ParamType):
    """Numbers in a fixed form, such as ``X,Y:LxW``."""

    def __init__(self, form: str, regex: str, example: str) -> None:
        self.name = form
        self._regex, self._example = re.compile(regex), example

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Return the numbers; fail with the expected form."""
        if isinstance(value, tuple):
            return value
        match = self._regex.fullmatch(str(value).replace(" ", ""))
        if match is None:
            self.fail(f"{value!r} is not {self.name} as in {self._example}.", param, ctx)
        numbers = tuple(float(text) for text in match.groups() if text is not None)
        if any(abs(each) > MAX_LENGTH_MM for each in numbers):
            self.fail(f"{value!r} is beyond 1 km.", param, ctx)
        return numbers


AREA = Pattern("X,Y:LxW", rf"({_SIGNED}),({_SIGNED}):({_NUMBER})x({_NUMBER})", "500,500:4000x3000")
OBSTACLE = Pattern(
    "X,Y:LxWxH",
    rf"({_SIGNED}),({_SIGNED}):({_NUMBER})x({_NUMBER})x({_NUMBER})",
    "2000,500:800x400x1800",
)
TRIPOD = Pattern("X,Y,Z", rf"({_SIGNED}),({_SIGNED}),({_NUMBER})", "300,300,2200")
VOLUME = Pattern("Z1-Z2", rf"({_NUMBER})-({_NUMBER})", "0-1500")
PAIR = Pattern("AxB", rf"({_NUMBER})x({_NUMBER})", "100x150")


def parse_mounts(ctx: click.Context, param: click.Parameter, value: str | None) -> Any:
    """Return the kinds of mounts of a text with commas."""
    if value is None:
        return None
    names = tuple(dict.fromkeys(part.strip() for part in value.split(",")))
    unknown = [name for name in names if name not in MOUNT_NAMES]
    if unknown:
        raise click.BadParameter(
            f"{unknown[0]!r} is not one of {', '.join(MOUNT_NAMES)}.", ctx=ctx, param=param
        )
    return names


room_options = combine(
    section(
        "Room",
        click.option(
            "--height",
            type=options.PositiveNumber(1, MAX_LENGTH_MM),
            metavar="MM",
            help="Height of the ceiling, if ROOM is a drawing (.dxf, .svg).",
        ),
        click.option(
            "--floor",
            type=click.FloatRange(0),
            metavar="MM",
            help="All photodiodes move at this height; the default is 0, or that of ROOM.",
        ),
        click.option(
            "--volume",
            type=VOLUME,
            metavar="Z1-Z2",
            help="Photodiodes move in space, between these heights in mm, as in 0-1500.",
        ),
        click.option(
            "--area",
            type=AREA,
            metavar="X,Y:LxW",
            help="Working area in mm, if it is not the whole room: lower left corner and size.",
        ),
        click.option(
            "--obstacle",
            "obstacles",
            type=OBSTACLE,
            multiple=True,
            metavar="X,Y:LxWxH",
            help="Box on the floor in mm: lower left corner and size. Repeatable.",
        ),
        click.option(
            "--robots",
            type=click.IntRange(1, 10_000),
            metavar="N",
            help="Number of robots, which hide each other's photodiodes.",
        ),
        click.option(
            "--robot-size",
            type=PAIR,
            metavar="RxH",
            help="Radius and height of a robot in mm.  [default: 100x100]",
        ),
    ),
    section(
        "Drawing",
        click.option(
            "--layer",
            default=None,
            metavar="NAME",
            help="DXF layer with the outline of the room, a closed polyline; by default the "
            "largest one of the drawing.",
        ),
        click.option(
            "--obstacle-layer",
            metavar="NAME",
            help="DXF layer whose closed polylines are obstacles up to --obstacle-height.",
        ),
        click.option(
            "--obstacle-height",
            type=options.PositiveNumber(1, MAX_LENGTH_MM),
            metavar="MM",
            help="Height of the obstacles of a drawing; the default is that of the ceiling.",
        ),
        click.option(
            "--units",
            type=click.Choice(("mm", "cm", "dm", "m", "in", "ft")),
            default=None,
            help="Unit of a drawing, if it states none.",
        ),
        click.option(
            "--scale",
            type=options.PositiveNumber(1e-6, 1e6),
            metavar="N",
            help="The n of a drawing at the scale 1 : n.  [default: 1]",
        ),
    ),
)
"""Options of the room and its working volume."""

reception_options = section(
    "Reception",
    click.option(
        "--seen",
        type=click.IntRange(1, 16),
        metavar="K",
        help="Number of stations that each place must see; the default is 1 with --floor and 2 "
        "with --volume.",
    ),
    click.option(
        "--facing",
        type=click.Choice(("up", "all")),
        default="up",
        show_default=True,
        help="Light that photodiodes receive: from above only, or from everywhere.",
    ),
    number(
        "--range",
        "range_mm",
        default=7000.0,
        type=options.PositiveNumber(100, MAX_LENGTH_MM),
        metavar="MM",
        help="Largest distance of a station that is received, as HTC states it.",
    ),
    number(
        "--field-of-view",
        default="150x110",
        type=PAIR,
        metavar="HxV",
        help="Horizontal and vertical field of view of a station in degrees: HTC states 150x110, "
        "Valve 160x115 for the same station.",
    ),
    click.option(
        "--calibration",
        type=click.Choice(("generic", "factory")),
        default="generic",
        show_default=True,
        help="Calibration of the light planes that the solver will have: that of an average "
        "station, or the one that each station sends (OOTX).",
    ),
    click.option(
        "--device",
        type=click.Choice(("photodiode", "deck")),
        default="photodiode",
        show_default=True,
        help="Receiver on a robot: one photodiode, or four on a Crazyflie lighthouse deck, which "
        "also give the heading.",
    ),
)
"""Options of what photodiodes receive."""

maps_option = options.output_option(
    "--maps",
    help="Picture to write with maps of standard deviation, stations seen and dilution.",
    endings=(".png", ".svg", ".pdf"),
)


def request_of(
    *,
    stations: int | None,
    accuracy: float | None,
    criterion: str = "worst",
    seen: int | None,
    facing: str,
    range_mm: float,
    field_of_view: tuple[float, float],
    calibration: str,
    device: str,
) -> RoomRequest:
    """Return the request of options in mm and degrees."""
    import math

    from locatk.core.lighthouse.design.placement import RoomRequest

    return RoomRequest(
        stations=stations,
        accuracy_m=None if accuracy is None else metres(accuracy),
        criterion="mean" if criterion == "mean" else "worst",
        min_seen=seen,
        facing="all" if facing == "all" else "up",
        max_range_m=metres(range_mm),
        field_of_view_rad=(math.radians(field_of_view[0]), math.radians(field_of_view[1])),
        calibration="factory" if calibration == "factory" else "generic",
    )


def room_of(
    room: str,
    *,
    height: float | None,
    layer: str | None,
    obstacle_layer: str | None,
    obstacle_height: float | None,
    units: str | None,
    scale: float | None,
    **more: Any,
) -> Room:
    """Return the room of an argument ROOM and of the options of :data:`room_options`.

    ``more`` are those of :func:`changed_room`.

    Raises
    ------
    click.UsageError
        ROOM is neither a size nor a file, or options contradict each other.
    LocatkError
        The file is missing or wrong.
    """
    drawing = {
        "--layer": layer,
        "--obstacle-layer": obstacle_layer,
        "--obstacle-height": obstacle_height,
        "--units": units,
        "--scale": scale,
    }
    return changed_room(_base_room(room, height, drawing), **more)


def _base_room(text: str, height: float | None, drawing: dict[str, Any]) -> Room:
    from locatk.core.lighthouse.room import Room
    from locatk.core.polygons import rectangle

    ending = Path(text).suffix.lower()
    given = [name for name, value in drawing.items() if value is not None]
    if given and ending not in (".dxf", ".svg"):
        raise click.UsageError(f"{given[0]} is for a ROOM that is a drawing (.dxf, .svg).")
    if ending in ROOM_FILES:
        path = Path(text)
        if ending == ".toml":
            return _scene_room(path, height)
        if height is None:
            raise click.UsageError("A drawing has no ceiling: add --height MM.")
        return _drawn_room(path, ending, metres(height), drawing)
    match = re.fullmatch(rf"({_NUMBER})x({_NUMBER})(?:x({_NUMBER}))?", text.replace(" ", ""))
    if match is None:
        raise click.UsageError(
            f"ROOM is {text!r}: give length x width x height in metres as in 10x8x3, or a file "
            f"({', '.join(ROOM_FILES)})."
        )
    length, width, top = (None if each is None else float(each) for each in match.groups())
    if top is None and height is None:
        raise click.UsageError("ROOM has no height: write it as in 10x8x3, or add --height MM.")
    if top is not None and height is not None:
        raise click.UsageError("--height repeats the height of ROOM: give one of them.")
    assert length is not None
    assert width is not None
    hint = "Lengths of ROOM are in metres"
    for side in (length, width, top):
        if side is not None and not 0.1 <= side <= 200:
            raise InputError(f"a room of {text} m: {side:g} m is not from 0.1 to 200 m", hint=hint)
    top_m = metres(height) if top is None and height is not None else top
    assert top_m is not None
    return Room(rectangle(length, width), top_m)


def _scene_room(path: Path, height: float | None) -> Room:
    from locatk.formats.artifacts.scene import read_scene

    room = read_scene(path).room
    if room is None:
        raise InputError(
            "the scene has no room",
            file=path,
            hint="Add a table [room] with outline_mm and height_mm, or give LxWxH in metres",
        )
    return room if height is None else replace(room, height_m=metres(height))


def _drawn_room(path: Path, ending: str, height_m: float, drawing: dict[str, Any]) -> Room:
    from locatk.core.lighthouse.room import Obstacle, Room
    from locatk.formats.importers.floors.room_drawing import read_dxf_room, read_svg_room

    scale = drawing["--scale"] or 1.0
    if ending == ".dxf":
        drawn = read_dxf_room(
            path, drawing["--layer"], drawing["--obstacle-layer"], drawing["--units"], scale
        )
    else:
        for name in ("--layer", "--obstacle-layer"):
            if drawing[name] is not None:
                raise click.UsageError(f"{name} is for DXF: in SVG, the outline is the largest.")
        drawn = read_svg_room(path, drawing["--units"], scale)
    top = height_m if drawing["--obstacle-height"] is None else metres(drawing["--obstacle-height"])
    obstacles = tuple(
        Obstacle(outline, 0.0, top, f"obstacle {number}")
        for number, outline in enumerate(drawn.obstacles_m, 1)
    )
    return Room(drawn.outline_m, height_m, obstacles=obstacles)


def changed_room(
    room: Room,
    *,
    floor: float | None,
    volume: tuple[float, float] | None,
    area: tuple[float, ...] | None,
    obstacles: tuple[tuple[float, ...], ...],
    robots: int | None,
    robot_size: tuple[float, float] | None,
    mounts: tuple[str, ...] | None = None,
    tripods: tuple[tuple[float, ...], ...] = (),
    **unused: Any,
) -> Room:
    """Return a room with the working volume, obstacles, robots and mounts of options in mm.

    Raises
    ------
    click.UsageError
        Options of ``unused``, which are for drawings, are given, or options contradict each other.
    InputError
        The options describe no room.
    """
    given = [name for name, value in unused.items() if value is not None]
    if given:
        raise click.UsageError(
            f"--{given[0].replace('_', '-')} is for a ROOM of which it is a part: add --room."
        )
    if floor is not None and volume is not None:
        raise click.UsageError("--floor is for a plane and --volume for space: give one of them.")
    if robot_size is not None and robots is None:
        raise click.UsageError("--robot-size is the size of --robots: add it.")
    import numpy as np

    from locatk.core.lighthouse.room import Obstacle, RobotSize
    from locatk.core.polygons import rectangle

    changes: dict[str, Any] = {}
    if floor is not None:
        changes["photodiode_z_m"] = (metres(floor), metres(floor))
    if volume is not None:
        if 0 <= volume[1] - volume[0] < MIN_EXTENT_MM:
            raise InputError(
                f"--volume from {volume[0]:g} to {volume[1]:g} mm is flat",
                hint="Heights are in mm; a plane is --floor",
            )
        changes["photodiode_z_m"] = (metres(volume[0]), metres(volume[1]))
    if area is not None:
        if min(area[2:]) < MIN_EXTENT_MM:
            raise InputError(
                f"--area of {area[2]:g} x {area[3]:g} mm", hint="Positions and sizes are in mm"
            )
        _check_inside("--area", room, area[0], area[1], area[0] + area[2], area[1] + area[3])
        x, y, length, width = map(metres, area)
        changes["area_m"] = rectangle(length, width, (x, y))
    if obstacles:
        more = []
        for count, each in enumerate(obstacles, len(room.obstacles) + 1):
            _check_overlap("--obstacle", room, *each[:4])
            x, y, length, width, top = map(metres, each)
            more.append(Obstacle(rectangle(length, width, (x, y)), 0.0, top, f"obstacle {count}"))
        changes["obstacles"] = (*room.obstacles, *more)
    if robots is not None:
        radius, height = (100.0, 100.0) if robot_size is None else robot_size
        changes["robots"] = RobotSize(robots, metres(radius), metres(height))
    for each in tripods:
        _check_inside("--tripod", room, each[0], each[1], each[0], each[1])
        if metres(each[2]) > room.height_m:
            raise InputError(
                f"--tripod at a height of {each[2]:g} mm in a room of {1e3 * room.height_m:g} mm",
                hint="Positions are in mm, and below the ceiling",
            )
    if tripods:
        changes["tripods_m"] = np.array([[metres(v) for v in each] for each in tripods])
        changes["mounts"] = (*room.mounts, *(("tripod",) if "tripod" not in room.mounts else ()))
    if mounts is not None:
        changes["mounts"] = mounts
    return replace(room, **changes)


def _bounds_mm(room: Room) -> tuple[float, float, float, float]:
    """Return x and y of the lower left and of the upper right corner around a room."""
    low, high = 1e3 * room.outline_m.min(axis=0), 1e3 * room.outline_m.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _check_inside(name: str, room: Room, x0: float, y0: float, x1: float, y1: float) -> None:
    """Raise an error unless a rectangle in mm is within the bounds of a room."""
    low_x, low_y, high_x, high_y = _bounds_mm(room)
    slack = 1.0
    if x0 < low_x - slack or y0 < low_y - slack or x1 > high_x + slack or y1 > high_y + slack:
        raise _outside(name, room)


def _check_overlap(name: str, room: Room, x: float, y: float, length: float, width: float) -> None:
    """Raise an error if a rectangle in mm is wholly outside the bounds of a room."""
    low_x, low_y, high_x, high_y = _bounds_mm(room)
    if x > high_x or y > high_y or x + length < low_x or y + width < low_y:
        raise _outside(name, room)


def _outside(name: str, room: Room) -> InputError:
    low_x, low_y, high_x, high_y = _bounds_mm(room)
    return InputError(
        f"{name} is outside the room: x {low_x:g} to {high_x:g}, y {low_y:g} to {high_y:g} mm",
        hint="Positions and sizes are in mm",
    )
