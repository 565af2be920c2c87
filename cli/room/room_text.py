"""Text and JSON of designed and checked rooms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.lighthouse.design import Addition, RoomDesign, RoomReport, RoomRequest
    from locatk.core.lighthouse.room import Room
    from locatk.core.lighthouse.scene import Marker, Station


def room_lines(room: Room) -> list[tuple[str, str]]:
    """Return the lines about a room."""
    low, high = room.outline_m.min(axis=0), room.outline_m.max(axis=0)
    size = " x ".join(f"{value:g}" for value in (*(high - low).round(3), round(room.height_m, 3)))
    shape = "" if len(room.outline_m) == 4 else f", outline of {len(room.outline_m)} corners"
    lines = [("room", f"{size} m{shape}")]
    first, last = (1e3 * z for z in room.photodiode_z_m)
    lines.append(
        (
            "photodiodes",
            f"on the plane at {first:g} mm"
            if room.is_planar
            else f"in space, {first:g} to {last:g} mm above the floor",
        )
    )
    if room.obstacles:
        lines.append(("obstacles", str(len(room.obstacles))))
    if room.robots is not None:
        robots = room.robots
        lines.append(
            (
                "robots",
                f"{robots.count}, radius {1e3 * robots.radius_m:g} mm, height "
                f"{1e3 * robots.height_m:g} mm",
            )
        )
    return lines


def reception_line(request: RoomRequest) -> tuple[str, str]:
    """Return the line about the range and the field of view that a prediction assumes."""
    across, up = (math.degrees(angle) for angle in request.field_of_view_rad)
    return "reception", f"within {request.max_range_m:g} m, {across:g} x {up:g} deg"


def report_lines(report: RoomReport, heading_rad: float | None = None) -> list[tuple[str, str]]:
    """Return the lines about accuracy and coverage."""
    needed = f"{report.min_seen} or more stations"
    seen = report.stations_seen
    lines = [
        ("covered", f"{_percent(report.covered_fraction)}, by {needed}"),
        ("stations seen", f"{seen.min()} to {seen.max()}, mean {seen.mean():.1f}"),
        (
            "sigma",
            f"{mm(report.p95_sigma_m)} at 95 % of the places, mean {mm(report.mean_sigma_m)}",
        ),
        ("repeatability", f"{mm(report.p95_noise_sigma_m)} at 95 % of the places"),
    ]
    covered = report.dilution[report.is_covered]
    if len(covered):
        ordered = sorted(covered.tolist())
        middle = ordered[len(ordered) // 2]
        lines.append(("dilution", f"median {middle:.2g}, worst {ordered[-1]:.2g}"))
    if heading_rad is not None:
        lines.append(("heading", f"{degrees(heading_rad)} at 95 % of the places"))
    if report.availability[report.is_covered].size and report.availability.max() < 1.0:
        worst = report.availability[report.is_covered].min()
        lines.append(("not hidden", f"{100 * worst:.1f} % of the time at the worst place"))
    return lines


def station_rows(stations: Sequence[Station], mounts: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the rows of the table of stations: channel, mount, position, yaw and tilt."""
    from locatk.core.lighthouse.drawing.mounting_sheet import view_angles

    rows: list[tuple[str, ...]] = []
    for station, mount in zip(stations, mounts, strict=True):
        x, y, z = (f"{1e3 * value:.0f}" for value in station.position)
        yaw, tilt, _ = view_angles(station)
        rows.append((str(station.channel), mount, x, y, z, f"{yaw:.0f}", f"{tilt:.0f}"))
    return rows


STATION_HEADER = ("channel", "mount", "x mm", "y mm", "z mm", "yaw deg", "tilt deg")


def marker_text(markers: Sequence[Marker]) -> str:
    """Return the places of the markers and their purpose in words."""
    places = ", ".join(
        "{:.0f} {:.0f}".format(*(1e3 * marker.position[:2]).tolist()) for marker in markers
    )
    return (
        f"Markers, x y in mm: {places}. A device that rests on each of them fixes frame and scale "
        "to the accuracy of these places."
    )


def point_text(report: RoomReport, index: int) -> str:
    """Return position, stations in view and sigma of a place in words."""
    x, y, z = (f"{value:.1f}" for value in report.points_m[index])
    count = int(report.stations_seen[index])
    seen = f"{count} station" + "s" * (count != 1)
    state = mm(report.sigma_m[index]) if report.is_covered[index] else "not covered"
    return f"{x}, {y}, {z} m: {state}, sees {seen}"


def addition_text(addition: Addition) -> str:
    """Return the best additional station in words."""
    from locatk.core.lighthouse.drawing.mounting_sheet import view_angles

    station, report = addition.station, addition.report
    x, y, z = (f"{value:.1f}" for value in station.position)
    yaw, tilt, _ = view_angles(station)
    return (
        f"channel {station.channel} at {x}, {y}, {z} m, yaw {yaw:.0f} deg, tilt {tilt:.0f} deg: "
        f"{mm(report.p95_sigma_m)} at 95 % of the places, {_percent(report.covered_fraction)} "
        "covered"
    )


def report_entry(report: RoomReport) -> dict[str, Any]:
    """Return a report for ``--json``."""
    return {
        "places": len(report.points_m),
        "min_seen": report.min_seen,
        "covered_fraction": report.covered_fraction,
        "p95_sigma_m": report.p95_sigma_m,
        "mean_sigma_m": report.mean_sigma_m,
        "p95_noise_sigma_m": report.p95_noise_sigma_m,
        "stations_seen": {
            "min": int(report.stations_seen.min()),
            "mean": float(report.stations_seen.mean()),
            "max": int(report.stations_seen.max()),
        },
        "min_availability": float(report.availability[report.is_covered].min())
        if report.is_covered.any()
        else 0.0,
        "worst_places": [
            {
                "position_m": report.points_m[index].tolist(),
                "sigma_m": float(report.sigma_m[index]),
                "stations_seen": int(report.stations_seen[index]),
                "covered": bool(report.is_covered[index]),
            }
            for index in report.worst_points
        ],
        "notes": report.notes,
        "warnings": report.warnings,
    }


def station_entries(
    stations: Sequence[Station], mounts: Sequence[str | None]
) -> list[dict[str, Any]]:
    """Return stations for ``--json``."""
    from locatk.core.lighthouse.drawing.mounting_sheet import view_angles

    entries = []
    for station, mount in zip(stations, mounts, strict=True):
        yaw, tilt, _ = view_angles(station)
        entries.append(
            {
                "channel": station.channel,
                "mount": mount,
                "position_m": station.position.tolist(),
                "yaw_rad": math.radians(yaw),
                "tilt_rad": math.radians(tilt),
            }
        )
    return entries


def design_entry(design: RoomDesign) -> dict[str, Any]:
    """Return a design for ``--json``."""
    return {
        "stations": station_entries(design.scene.stations, design.poses.kinds),
        "markers": [
            {"name": marker.name, "position_m": marker.position.tolist()}
            for marker in design.scene.markers
        ],
        "reached": design.is_reached,
        "report": report_entry(design.report),
        "mounted_p95_sigma_m": design.mounted_report.p95_sigma_m,
    }


def addition_entry(addition: Addition | None) -> dict[str, Any] | None:
    """Return the best additional station for ``--json``."""
    if addition is None:
        return None
    return {
        **station_entries([addition.station], [None])[0],
        "covered_fraction": addition.report.covered_fraction,
        "p95_sigma_m": addition.report.p95_sigma_m,
    }


def mm(value_m: float) -> str:
    """Format an error in mm."""
    if not math.isfinite(value_m):
        return "unknown"
    value = 1e3 * value_m
    return (
        f"{value:.2f} mm" if value < 1 else f"{value:.1f} mm" if value < 100 else f"{value:.0f} mm"
    )


def degrees(value_rad: float) -> str:
    """Format an angle in degrees."""
    return f"{math.degrees(value_rad):.2f} deg" if math.isfinite(value_rad) else "unknown"


def _percent(fraction: float) -> str:
    percent = 100 * fraction
    return f"{percent:.0f} %" if percent in (0.0, 100.0) else f"{min(percent, 99.9):.1f} %"
