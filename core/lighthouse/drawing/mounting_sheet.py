"""Mounting sheet of a room: plan to scale, drilling list, and a tilt gauge at true size.

The gauge is a protractor: held with its edge along the front of a station and with a weight on a
thread in its centre, it shows the tilt. Hole patterns of brackets differ, so that none is drawn.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import (
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
    cross,
    rectangle,
    text_width,
)
from locatk.core.drawing.pages import (
    TEXT_POINTS,
    PageFrame,
    TableColumn,
    UnnumberedPage,
    check_margin,
    number_pages,
    printable,
    table_pages,
)
from locatk.core.drawing.scale import axes, round_scale, scale_bar
from locatk.core.errors import InputError
from locatk.core.lighthouse.room import Room
from locatk.core.lighthouse.scene import Scene, Station

Array = NDArray[np.float64]

MARGIN_MM = 10.0
"""Empty margin of the pages."""

PLAN_SPACE_MM = 16.0
"""Space around the plan, for lengths of walls and stations next to walls."""

FOOT_MM = 14.0
"""Height of the strip with axes and scale bar."""

STATION_MM = 1.6
"""Radius of the symbol of a station."""

MARKER_MM = 2.0
"""Length of the arms of the cross of a marker."""

VIEW_MM = 11.0
"""Length of the arrow along the direction of view, if it is horizontal."""

LABEL_DISTANCE_MM = 6.0
"""Distance of the middle of a channel from its station."""

MAX_GAUGE_RADIUS_MM = 80.0
"""Radius of the protractor."""

MIN_GAUGE_RADIUS_MM = 40.0

GAUGE_EDGE_MM = 8.0
"""Distance of the hole of the gauge from its edges."""

GAUGE_RIM_MM = 18.0
"""Width of the gauge beyond the scale, for the marks of stations."""

SAME_LABEL_DEG = 7.0
"""Difference of two tilts whose channels would overlap on the rim."""

VERTICAL_RAD = math.radians(89.5)
"""Tilt from which on a view is vertical: its azimuth is that of the upper side of the housing."""


def draw_mounting_sheet(
    scene: Scene, mounts: Sequence[str], title: str, paper_mm: Point
) -> tuple[Page, ...]:
    """Draw the pages of a mounting sheet.

    Parameters
    ----------
    scene : Scene
        Stations with a room.
    mounts : sequence of str
        Kind of mount of each station: ``"wall"``, ``"ceiling"`` or ``"tripod"``.
    title : str
    paper_mm : (width, height)

    Raises
    ------
    InputError
        There is no room, or the paper is too small.
    """
    room = scene.room
    if room is None or not scene.stations:
        raise InputError("a mounting sheet needs stations and their room")
    check_margin(paper_mm, MARGIN_MM, min_content_mm=100.0)
    title = printable(title)
    pages = [
        _plan_page(scene, room, title, paper_mm),
        *_list_pages(scene, room, mounts, title, paper_mm),
        *_marker_pages(scene, room, title, paper_mm),
        _gauge_page(scene, title, paper_mm),
    ]
    return number_pages(pages)


def wall_distances(room: Room, position_m: Array) -> tuple[tuple[int, float], tuple[int, float]]:
    """Return the two walls from which a position is measured, and its distances from them.

    The first is the nearest wall; the second the nearest one that is not almost parallel to it.
    Walls are counted from 0 in the order of the outline. Distances are perpendicular, from the part
    of a wall that is opposite of the position if there is one.
    """
    start = room.outline_m
    edges = np.roll(start, -1, axis=0) - start
    lengths = np.hypot(*edges.T)
    along = edges / lengths[:, None]
    offset = position_m[:2] - start
    foot = np.sum(offset * along, axis=1)
    distance = np.abs(along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0])
    is_opposite = (foot >= -1e-9) & (foot <= lengths + 1e-9)
    # Walls that are not opposite of the position come last.
    order = np.lexsort((distance, ~is_opposite))
    first = int(order[0])
    second = first
    for index in order[1:].tolist():
        if abs(float(along[index] @ along[first])) < math.cos(math.radians(30.0)):
            second = index
            break
    return (first, float(distance[first])), (second, float(distance[second]))


def view_angles(station: Station) -> tuple[float, float, bool]:
    """Return yaw and tilt of a station in degrees, and whether it looks straight up or down.

    Its yaw is then that of the upper side of the housing.
    """
    x, y, z = station.rotation[:, 0].tolist()
    tilt = math.atan2(z, math.hypot(x, y))
    is_vertical = abs(tilt) >= VERTICAL_RAD
    if is_vertical:
        x, y = station.rotation[:2, 2].tolist()
    # 0.0 instead of -0.0
    return math.degrees(math.atan2(y, x)) + 0.0, math.degrees(tilt) + 0.0, is_vertical


def _plan_page(scene: Scene, room: Room, title: str, paper_mm: Point) -> UnnumberedPage:
    low, high = room.outline_m.min(axis=0), room.outline_m.max(axis=0)
    size = high - low
    # A wide room is drawn on the wide side of the paper.
    portrait, landscape = sorted(paper_mm), sorted(paper_mm, reverse=True)
    page_mm = (landscape[0], landscape[1]) if size[0] > size[1] else (portrait[0], portrait[1])

    def frame_at(scale: float) -> PageFrame:
        text = (
            f"Plan at 1 : {scale:g}, seen from above; lengths in mm. W1, W2 ... are the walls. "
            "Arrows show where stations look, shorter if they look down; a ring is a station that "
            "looks almost straight down. Bold numbers are channels. Crosses M1, M2 ... are markers "
            "on the floor."
        )
        if room.area_m is not None:
            text += " Dashed: working area."
        name = f"{title}: plan of the stations"
        return PageFrame(page_mm, MARGIN_MM, name, (text,), has_rulers=False)

    left, bottom, right, top = frame_at(1000.0).content_box
    space = np.array([right - left, top - bottom - FOOT_MM]) - 2 * PLAN_SPACE_MM
    if not np.all(space > 30):
        raise InputError("the paper is too small for the plan of a room", hint="Use a larger paper")
    scale = round_scale(float(max(1.0, (1e3 * size / space).max())))
    frame = frame_at(scale)
    factor = 1e3 / scale
    centre = np.array([(left + right) / 2, (bottom + FOOT_MM + top) / 2])
    origin = centre - factor * 0.5 * (low + high)

    def at(point: Array) -> Point:
        x, y = (origin + factor * np.asarray(point)[:2]).tolist()
        return x, y

    marks: list[Mark] = [Polygon(tuple(at(corner) for corner in room.outline_m), width_mm=0.5)]
    marks += _wall_marks(room, at)
    if room.area_m is not None:
        corners = [at(corner) for corner in room.area_m]
        marks += [
            Line(first, second, dash_mm=1.5)
            for first, second in zip(corners, [*corners[1:], corners[0]], strict=True)
        ]
    for obstacle in room.obstacles:
        corners = [at(corner) for corner in obstacle.outline_m]
        marks.append(Polygon(tuple(corners), width_mm=0.25))
        marks += _hatching(corners)
    for number, marker in enumerate(scene.markers, 1):
        x, y = at(marker.position)
        marks += cross((x, y), MARKER_MM)
        marks.append(Text(f"M{number}", (x, y + MARKER_MM + 0.5), TEXT_POINTS, "middle"))
    for station in scene.stations:
        marks += _station_marks(station, at, 0.5 * (low + high))
    foot = (
        *axes((left + 1.0, bottom + 1.0), 9.0, "+x", "+y"),
        *scale_bar((left + 28.0, bottom + 2.0), scale, 60.0),
        Text(f"1 : {scale:g}", (left + 28.0, bottom + 5.0), TEXT_POINTS, bold=True),
        *cross(at(np.zeros(2)), 2.5),
        Circle(at(np.zeros(2)), 1.5),
    )
    return UnnumberedPage(frame, (Group("plan", tuple(marks)), Group("foot", foot)))


def _wall_marks(room: Room, at: Callable[[Array], Point]) -> list[Mark]:
    """Return number and length of each wall outside of it."""
    marks: list[Mark] = []
    start = room.outline_m
    end = np.roll(start, -1, axis=0)
    for number, (first, second) in enumerate(zip(start, end, strict=True), 1):
        along = second - first
        length = float(np.hypot(*along))
        angle = math.degrees(math.atan2(along[1], along[0]))
        is_turned = not -90.0 < round(angle, 6) <= 90.0
        outwards = np.array([along[1], -along[0]]) / length
        x, y = at(0.5 * (first + second))
        # The text is outside of the wall: below its baseline if it is upside down.
        gap = 1.5 if is_turned else 1.5 + capital_height(TEXT_POINTS)
        position = (x + gap * outwards[0], y + gap * outwards[1])
        text = f"W{number}: {1e3 * length:.0f}"
        if text_width(text, TEXT_POINTS) > math.dist(at(first), at(second)):
            text = f"W{number}"
        shown = angle + 180.0 if is_turned else angle
        marks.append(Text(text, position, TEXT_POINTS, "middle", angle_deg=shown))
    return marks


def _hatching(corners: Sequence[Point]) -> list[Mark]:
    """Return the diagonals of an obstacle, as a sign that it is solid."""
    if len(corners) != 4:
        return []
    return [Line(corners[0], corners[2], 0.1), Line(corners[1], corners[3], 0.1)]


def _station_marks(station: Station, at: Callable[[Array], Point], centre_m: Array) -> list[Mark]:
    x, y = at(station.position)
    marks: list[Mark] = [
        Polygon(
            tuple(
                (
                    x + STATION_MM * math.cos(math.radians(angle)),
                    y + STATION_MM * math.sin(math.radians(angle)),
                )
                for angle in range(0, 360, 20)
            ),
            filled=True,
        )
    ]
    view = VIEW_MM * station.rotation[:2, 0]
    length = float(np.hypot(*view))
    if length > STATION_MM + 2.0:
        marks += arrow((x, y), (x + float(view[0]), y + float(view[1])), 2.0, 0.3)
    else:
        marks.append(Circle((x, y), 2.0 * STATION_MM))
    # The number is beside the arrow, inside the room: behind the station there may be a wall.
    side = np.array([-view[1], view[0]]) / length if length > 1e-6 else np.array([1.0, 0.0])
    if side @ (centre_m - station.position[:2]) < 0:
        side = -side
    height = capital_height(9.0)
    position = (
        x + LABEL_DISTANCE_MM * float(side[0]),
        y + LABEL_DISTANCE_MM * float(side[1]) - height / 2,
    )
    marks.append(Text(str(station.channel), position, 9.0, "middle", bold=True))
    return marks


def _list_pages(
    scene: Scene, room: Room, mounts: Sequence[str], title: str, paper_mm: Point
) -> list[UnnumberedPage]:
    rows = []
    for station, mount in zip(scene.stations, mounts, strict=True):
        (first, first_m), (second, second_m) = wall_distances(room, station.position)
        yaw, tilt, is_vertical = view_angles(station)
        rows.append(
            (
                str(station.channel),
                mount,
                f"{1e3 * station.position[2]:.0f}",
                f"W{first + 1}: {1e3 * first_m:.0f}",
                f"W{second + 1}: {1e3 * second_m:.0f}",
                f"{1e3 * station.position[0]:.0f}, {1e3 * station.position[1]:.0f}",
                f"{yaw:.0f}" + (" (top)" if is_vertical else ""),
                f"{abs(tilt):.0f} {'down' if tilt < 0 else 'up'}",
                "[  ]",
            )
        )
    columns = (
        TableColumn("channel", 14.0),
        TableColumn("mount", 16.0),
        TableColumn("height", 14.0),
        TableColumn("from wall", 24.0),
        TableColumn("and from wall", 24.0),
        TableColumn("x, y", 26.0),
        TableColumn("yaw deg", 22.0),
        TableColumn("tilt deg", 20.0),
        TableColumn("done", 10.0),
    )
    notes = (
        "All lengths are in mm, from the floor and from the walls to the centre of the rotor, "
        "behind the middle of the front window. Hold the station with its bracket in this place "
        "and mark the holes of the bracket: brackets differ.",
        "Yaw is the direction of view, counter-clockwise from the x axis of the plan (0: along +x, "
        "90: along +y). For a station that looks straight down, it is the direction of the top of "
        "the housing. Tilt is the angle of the view below or above the horizon: see the gauge.",
        "Set the channel of each station (button at its back, or Bluetooth). 20 mm and 1.5 degrees "
        "are accurate enough: `locatk calibrate scene` measures the rest.",
    )
    page_mm = tuple(sorted(paper_mm))
    frame = PageFrame(
        (page_mm[0], page_mm[1]), MARGIN_MM, f"{title}: drilling list", notes, has_rulers=False
    )
    return table_pages(rows, columns, frame)


def _marker_pages(scene: Scene, room: Room, title: str, paper_mm: Point) -> list[UnnumberedPage]:
    """List the markers with their distances from two walls."""
    if not scene.markers:
        return []
    rows = []
    for number, marker in enumerate(scene.markers, 1):
        (first, first_m), (second, second_m) = wall_distances(room, marker.position)
        x_mm, y_mm, z_mm = (1e3 * marker.position).tolist()
        rows.append(
            (
                f"M{number}",
                marker.name,
                f"W{first + 1}: {1e3 * first_m:.0f}",
                f"W{second + 1}: {1e3 * second_m:.0f}",
                f"{x_mm:.0f}, {y_mm:.0f}",
                f"{z_mm:.0f}",
                "[  ]",
            )
        )
    columns = (
        TableColumn("marker", 14.0),
        TableColumn("name", 28.0),
        TableColumn("from wall", 24.0),
        TableColumn("and from wall", 24.0),
        TableColumn("x, y", 28.0),
        TableColumn("photodiode height", 32.0),
        TableColumn("done", 10.0),
    )
    notes = (
        "Mark these places on the floor, in mm from the walls. A device that rests with its "
        "photodiode above each of them fixes frame and scale of the scene. If you measure a mark "
        "elsewhere, correct its position in the scene.",
    )
    page_mm = tuple(sorted(paper_mm))
    frame = PageFrame(
        (page_mm[0], page_mm[1]), MARGIN_MM, f"{title}: markers", notes, has_rulers=False
    )
    return table_pages(rows, columns, frame)


def _gauge_page(scene: Scene, title: str, paper_mm: Point) -> UnnumberedPage:
    """Draw a quarter of a protractor, with a mark at the tilt of each station."""
    page_mm = tuple(sorted(paper_mm))
    notes = (
        "Print at 100 %, without scaling, and measure the rulers. Glue it on cardboard, cut it "
        "along the thick lines, and hang a nut on a thread from the hole.",
        "Hold the edge FRONT on the front window of the station, upright, with the arrow to the "
        "top of the housing. The thread shows how far the station looks down, from 0 (horizontal) "
        "to 90 degrees. Marks beyond the scale are the channels with their tilts.",
    )
    frame = PageFrame((page_mm[0], page_mm[1]), MARGIN_MM, f"{title}: tilt gauge", notes)
    left, bottom, right, top = frame.content_box
    extent = GAUGE_EDGE_MM + GAUGE_RIM_MM
    radius = min(MAX_GAUGE_RADIUS_MM, right - left - extent - 14.0, top - bottom - extent - 10.0)
    if radius < MIN_GAUGE_RADIUS_MM:
        raise InputError("the paper is too small for the tilt gauge", hint="Use a larger paper")
    # If the view turns down by t, the gauge turns with it, and the thread moves by t away from
    # the edge FRONT.
    hole = (left + 12.0 + GAUGE_EDGE_MM, top - 6.0 - GAUGE_EDGE_MM)

    def point(tilt_deg: float, distance_mm: float) -> Point:
        angle = math.radians(tilt_deg)
        return hole[0] + distance_mm * math.sin(angle), hole[1] - distance_mm * math.cos(angle)

    marks: list[Mark] = [
        rectangle(
            (
                hole[0] - GAUGE_EDGE_MM,
                hole[1] - radius - GAUGE_RIM_MM,
                hole[0] + radius + GAUGE_RIM_MM,
                hole[1] + GAUGE_EDGE_MM,
            ),
            0.6,
        ),
        Circle(hole, 1.0),
        *cross(hole, 3.0),
    ]
    for degree in range(91):
        length = 7.0 if degree % 10 == 0 else 5.0 if degree % 5 == 0 else 3.0
        marks.append(Line(point(degree, radius - length), point(degree, radius), 0.2))
        if degree % 10 == 0:
            marks.append(_upright_text(str(degree), point(degree, radius - 10.5)))
    arc = [point(degree, radius) for degree in range(91)]
    marks += [Line(first, second, 0.2) for first, second in itertools.pairwise(arc)]
    marks += _tilt_marks(scene, point, radius)
    edge = hole[0] - GAUGE_EDGE_MM
    marks.append(Text("FRONT", (edge - 3.0, hole[1] - 0.55 * radius), 10.0, "middle", True, 90.0))
    marks += arrow((edge - 4.5, hole[1] - 0.25 * radius), (edge - 4.5, hole[1]), 3.0, 0.3)
    return UnnumberedPage(frame, (Group("gauge", tuple(marks)),))


def _tilt_marks(
    scene: Scene, point: Callable[[float, float], Point], radius_mm: float
) -> list[Mark]:
    """Return the marks of the stations that look down, on the rim of the gauge."""
    by_tilt: dict[int, list[int]] = {}
    for station in scene.stations:
        _, tilt, _ = view_angles(station)
        if tilt <= 0.5:
            by_tilt.setdefault(round(-tilt), []).append(station.channel)
    marks: list[Mark] = []
    previous, is_outside = -90.0, False
    for tilt_deg, channels in sorted(by_tilt.items()):
        is_outside = not is_outside and tilt_deg - previous < SAME_LABEL_DEG
        previous = tilt_deg
        end = radius_mm + (10.0 if is_outside else 4.0)
        marks.append(Line(point(tilt_deg, radius_mm), point(tilt_deg, end), 0.4))
        text = ",".join(map(str, channels))
        marks.append(_upright_text(text, point(tilt_deg, end + 3.5), bold=True))
    return marks


def _upright_text(text: str, centre: Point, *, bold: bool = False) -> Text:
    height = capital_height(TEXT_POINTS)
    return Text(text, (centre[0], centre[1] - height / 2), TEXT_POINTS, "middle", bold)
