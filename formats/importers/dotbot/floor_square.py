"""Reference of a DotBot recording: the floor square and the pixel tracks of a camera.

``calibration.json`` has one entry a video: ``corners_cm`` (the square on the floor),
``corners_px`` (the same corners in the video), and either ``corners_lh2`` (the corners in
PyDotBot's plane, columns x and y of a one-station recording) or ``timestamps_lh2`` (the times
at which a robot rested on each corner).

The file of alvarado24automatic has one entry a scene, ``scene_1`` and ``scene_2``, with
``corners_mm`` (in space, by motion capture) and ``timestamps_lh2``; recordings are in folders with
the names of the scenes. Its axes are tilted by a degree to the floor: the authors level them, here
heights are averaged. ``circles`` (times at which a robot drove circles) are not used.

Axes. The corners ``tl, tr, br, bl`` are clockwise from above, according to the images of
three published stations and the camera. If ``corners_cm`` makes them counter-clockwise (y to the
front, as in a picture), z of its frame would point into the floor. Then y is negated, for
markers and truth alike, so that z is up (REP 103).

One-station recordings. Their columns x and y are an exact homography (residual 1e-15 in
the published files) of the image point that the counts give; PyDotBot fitted it to the
counts it read on the four corners. The homography is estimated from the recording and inverted
at the corners, which recovers those counts: the measurements of the robot on the markers during
its calibration. (In the published files they are whole numbers to 0.001.)
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, FormatError, InputError, MissingDataError
from locatk.core.geometry import apply_homography, fit_homography
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION, predict_angles
from locatk.core.lighthouse.light_planes import angles_to_counts
from locatk.core.lighthouse.published.scene import paper_image_points
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene
from locatk.core.trajectory import Trajectory
from locatk.formats.files import read_text
from locatk.formats.importers.dotbot.count_rows import PLANE_COLUMNS, TIME_COLUMN, CountRows
from locatk.formats.tables.delimited import read_table
from locatk.formats.tables.timestamps import parse_iso_time

Array = NDArray[np.float64]

FILE_NAME = "calibration.json"
FRAME = "floor"
CLOCKWISE = ("tl", "tr", "br", "bl")
"""Names of the square's corners, clockwise from above."""

MAX_HOMOGRAPHY_RESIDUAL = 1e-6
"""Largest residual of columns x and y that derive from the counts, in units of the plane."""

MIN_CORNERS = 4
"""Corners in pixels that determine the homography to the floor."""

METRES = {"corners_cm": 1e-2, "corners_mm": 1e-3}
"""Keys of the corners, and their units in metres."""

MAX_FLOOR_SLOPE = 0.05
"""Largest difference of the heights of corners on one floor, relative to their distance. Averaging
the heights changes lengths by half of its square, 0.1 %."""

MAX_COORDINATE = 1e7
"""Largest coordinate of a corner: 10 km in millimetres."""

MAX_PIXELS = 1e5
"""Largest coordinate in a video: no frame is that wide."""


@dataclass(frozen=True)
class FloorSquare:
    """Known points on the floor.

    Attributes
    ----------
    file : Path
    floor_m : dict of str to (3,) ndarray
        In axes with z up; z is zero if it is not given.
    pixels, plane : dict of str to (2,) ndarray
        The same points in the video and in PyDotBot's plane; empty if not given.
    stays : dict of str to (int, int)
        Start and end of the stay of a robot on each point, in nanoseconds since the epoch.
    axes : str
        Description of the axes, for the facts of the session.
    unused : str
        Description of the parts that are not used, empty if there are none.
    """

    file: Path
    floor_m: dict[str, Array]
    pixels: dict[str, Array]
    plane: dict[str, Array]
    stays: dict[str, tuple[int, int]]
    axes: str
    unused: str


def find_calibration(
    explicit: Path | None, truth: Sequence[Path], recordings: Sequence[Path]
) -> Path | None:
    """Return the path of ``calibration.json``; None if there is none.

    It is the given file, or one in the folder of the truth, of the recordings, or in their sister
    folder ``ground_truth`` as in the published data sets; or one in the folder above that has an
    entry with the name of the recordings' folder.

    Raises
    ------
    MissingDataError
        The given file is missing.
    """
    if explicit is not None:
        if not Path(explicit).is_file():
            raise MissingDataError(f"no calibration file {str(explicit)!r}")
        return Path(explicit)
    folders = [Path(t).parent for t in truth]
    for recording in recordings:
        folders += [Path(recording).parent, Path(recording).parent.parent / "ground_truth"]
    candidates = [folder / FILE_NAME for folder in folders]
    for recording in recordings:
        folder = Path(recording).resolve().parent
        if _has_entry(folder.parent / FILE_NAME, folder.name):
            candidates.append(folder.parent / FILE_NAME)
    return next((file for file in candidates if file.is_file()), None)


def _has_entry(path: Path, name: str) -> bool:
    """Return whether a file is a calibration with an entry ``name``."""
    try:
        return path.is_file() and name in _read_entries(path)
    except FormatError:
        return False  # The folder above may hold a file of another program.


def read_calibration(
    path: Path, recordings: Sequence[Path] = (), span_ns: tuple[int, int] | None = None
) -> FloorSquare:
    """Read ``calibration.json``.

    Parameters
    ----------
    path : path
    recordings : sequence of path
        Of several entries, the one whose name is a part of their paths is read.
    span_ns : (int, int), optional
        First and last time of the recordings. Without such a name, the only entry with stays in
        that time is read.

    Raises
    ------
    FormatError
        The file is not JSON, has no entry of the recording or several, or a key is missing or
        wrong.
    """
    entries = _read_entries(path)
    if len(entries) == 1:
        name = next(iter(entries))
    else:
        name = _choose_entry(path, entries, recordings, span_ns)
    return _parse_square(path, name, entries[name])


def _choose_entry(
    path: Path,
    entries: dict[str, Any],
    recordings: Sequence[Path],
    span_ns: tuple[int, int] | None,
) -> str:
    """Return the name of the entry of a recording."""
    parts = [{*Path(file).resolve().parts, Path(file).stem} for file in recordings]
    named = [name for name in entries if parts and all(name in each for each in parts)]
    if not named and span_ns is not None:
        squares = {name: _parse_square(path, name, entry) for name, entry in entries.items()}
        named = [
            name
            for name, square in squares.items()
            if square.stays
            and min(start for start, _ in square.stays.values()) <= span_ns[1]
            and max(end for _, end in square.stays.values()) >= span_ns[0]
        ]
    if len(named) != 1:
        raise FormatError(
            f"{len(entries)} entries ({', '.join(entries)}), of which "
            f"{len(named) or 'none'} belong to the recording",
            file=path,
            hint="Import each scene into a session of its own, from a folder with its name, or "
            "keep the entry of this recording only",
        )
    return named[0]


def _read_entries(path: Path) -> dict[str, Any]:
    """Return the entries of ``calibration.json`` by video or scene; one without name is "".

    Raises
    ------
    FormatError
        The file is not a JSON object, or empty.
    """
    try:
        content = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise FormatError(
            f"not JSON ({error.msg})", file=path, where=error.lineno, hint="Check the file"
        ) from error
    except RecursionError:
        raise FormatError("not a calibration: nested too deeply", file=path) from None
    except ValueError:  # An integer of more than 4300 digits.
        raise FormatError("not a calibration: a number is too long", file=path) from None
    if not isinstance(content, dict):
        raise FormatError("not a calibration: should be an object", file=path)
    entries = {"": content} if any(key in content for key in METRES) else content
    if not entries:
        raise FormatError("not a calibration: no entries", file=path)
    return entries


def _parse_square(path: Path, name: str, video: Any) -> FloorSquare:
    """Return the square of one entry."""
    unit = next((key for key in METRES if isinstance(video, dict) and key in video), None)
    if unit is None:
        raise FormatError(
            "key 'corners_cm' is missing",
            file=path,
            where=name,
            hint="Map the name of each corner to [x, y] in cm, or as 'corners_mm' in mm",
        )

    def points(key: str) -> dict[str, Array]:
        return {
            corner: _point(value, path, f"{key}.{corner}")
            for corner, value in _object(video.get(key, {}), path, key).items()
        }

    def planar_points(key: str) -> dict[str, Array]:
        return {corner: point[:2] for corner, point in points(key).items()}

    floor_m = {corner: METRES[unit] * point for corner, point in points(unit).items()}
    changes = []
    corners_m = np.array(list(floor_m.values()))
    relief_m = np.ptp(corners_m[:, 2]) if len(corners_m) else 0.0
    if 0 < relief_m <= MAX_FLOOR_SLOPE * np.ptp(corners_m[:, :2], axis=0).max():
        changes.append(f"heights averaged over {1e3 * relief_m:.0f} mm")
        floor_m = {c: np.append(p[:2], corners_m[:, 2].mean()) for c, p in floor_m.items()}
    if all(corner in floor_m for corner in CLOCKWISE):
        x, y, _ = np.array([floor_m[corner] for corner in CLOCKWISE]).T
        if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0:
            floor_m = {corner: value * [1.0, -1.0, 1.0] for corner, value in floor_m.items()}
            changes.append("y negated, so that z is up")
    stays = {
        corner: _stay(value, path, f"timestamps_lh2.{corner}")
        for corner, value in _object(
            video.get("timestamps_lh2", {}), path, "timestamps_lh2"
        ).items()
    }
    circles = video.get("circles", {})
    number = sum(key != "quantity" for key in circles) if isinstance(circles, dict) else 0
    square = FloorSquare(
        path,
        floor_m,
        planar_points("corners_px"),
        planar_points("corners_lh2"),
        stays,
        ", ".join(changes) or "axes as given",
        f"{number} circles" if number else "",
    )
    for part in (square.pixels, square.plane, square.stays):
        unknown = sorted(set(part) - set(floor_m))
        if unknown:
            raise FormatError(f"corner {unknown[0]!r} is not in {unit!r}", file=path, where=name)
    return square


def _object(value: Any, path: Path, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise FormatError("should be an object of corners", file=path, where=where)
    return value


def _point(value: Any, path: Path, where: str) -> Array:
    """Return the two or three numbers of a list as a point (3,); z is zero if it is missing."""
    is_valid = (
        isinstance(value, list)
        and len(value) in (2, 3)
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        and all(abs(v) <= MAX_COORDINATE for v in value)
    )
    if not is_valid:
        raise FormatError(
            f"{repr(value)[:40]} should be two numbers up to {MAX_COORDINATE:.0e}",
            file=path,
            where=where,
        )
    return np.array([*value, 0.0][:3], float)


def _stay(value: Any, path: Path, where: str) -> tuple[int, int]:
    try:
        start, end = (parse_iso_time(time) for time in value)
    except (TypeError, ValueError, AttributeError):
        start, end = 1, 0
    if start >= end:
        raise FormatError(
            f"{str(value)[:70]} should be two ascending UTC times", file=path, where=where
        )
    return start, end


def estimate_markers(
    square: FloorSquare, rows: CountRows, facts: dict[str, str], warnings: list[str]
) -> Scene | None:
    """Return a scene with markers at the corners and their visits; None without any visit."""
    visits: dict[str, MarkerVisit] = {}
    if square.plane and rows.plane is not None:
        visits = _visits_from_plane(square, rows, facts, warnings)
    elif square.stays:
        visits = _visits_from_stays(square, rows, facts, warnings)
    if not visits:
        return None
    return Scene(
        markers=tuple(
            Marker(name, position, (visits[name],) if name in visits else ())
            for name, position in square.floor_m.items()
        ),
        frame=FRAME,
    )


def _visits_from_plane(
    square: FloorSquare, rows: CountRows, facts: dict[str, str], warnings: list[str]
) -> dict[str, MarkerVisit]:
    """Return the counts on the corners, recovered from the homography in columns x and y."""
    assert rows.plane is not None
    channels = np.unique(rows.channel)
    if len(channels) != 1:
        warnings.append("columns x and y with more than one station: no markers were derived")
        return {}
    channel = int(channels[0])
    image = paper_image_points(np.sort(rows.count, axis=1), channel)
    try:
        to_plane = fit_homography(image, rows.plane)
    except DegenerateError as error:
        warnings.append(f"no markers from columns x and y: {error.message}")
        return {}
    residual = float(np.abs(apply_homography(to_plane, image) - rows.plane).max())
    if not residual <= MAX_HOMOGRAPHY_RESIDUAL:
        warnings.append(
            f"columns x and y are not a homography of the counts (residual {residual:.1g}): "
            "no markers were derived"
        )
        return {}
    corners = np.array(list(square.plane.values()))
    right, up = apply_homography(np.linalg.inv(to_plane), corners).T
    # PyDotBot computed the plane with an ideal station.
    angles = predict_angles(np.stack([np.ones(len(right)), -right, up], axis=1), IDEAL_CALIBRATION)
    counts = angles_to_counts(angles, channel)
    facts["markers"] = (
        f"{len(corners)}: counts on the corners, recovered from the homography of columns x "
        f"and y (residual {residual:.1g}) of PyDotBot's calibration"
    )
    return {
        name: MarkerVisit(counts={channel: (float(first), float(second))})
        for name, (first, second) in zip(square.plane, counts, strict=True)
    }


def _visits_from_stays(
    square: FloorSquare, rows: CountRows, facts: dict[str, str], warnings: list[str]
) -> dict[str, MarkerVisit]:
    """Return the device that reported during each stay on a corner."""
    visits = {}
    for name, (start, end) in square.stays.items():
        during = (rows.time_ns >= start) & (rows.time_ns <= end)
        present = np.unique(rows.device[during])
        if len(present) == 1:
            visits[name] = MarkerVisit(rows.devices[present[0]], start, end)
        else:
            devices = "no device" if len(present) == 0 else "more than one device"
            warnings.append(f"marker {name!r}: {devices} reported during the stay on it")
    visitors = sorted({str(visit.device) for visit in visits.values()})
    if visits:
        facts["markers"] = f"{len(visits)}: stays of {', '.join(visitors)} on the corners"
    return visits


def read_tracks(
    paths: Sequence[Path],
    square: FloorSquare,
    devices: tuple[str, ...],
    facts: dict[str, str],
    warnings: list[str],
) -> list[Trajectory]:
    """Read truth from pixel tracks: one trajectory a device, on the floor (z = 0).

    Pixels become floor metres by the homography of the square's four corners, as in the
    authors' code: the lens is not corrected, the camera's clock not shifted.

    Parameters
    ----------
    paths : sequence of path
        CSV with ``timestamp, x, y`` and, for several devices, ``source``.
    square : FloorSquare
    devices : tuple of str
        Devices of the recording. Tracks without ``source`` are of the only one.
    facts, warnings : dict and list
        Added to.

    Raises
    ------
    FormatError, InputError
        As for recordings; or tracks of several devices have no ``source``.
    MissingDataError
        The calibration has fewer than four corners in pixels.
    """
    if len(square.pixels) < MIN_CORNERS:
        raise MissingDataError(
            "fewer than four corners in 'corners_px'",
            file=square.file,
            hint="Pixel tracks need the floor square in pixels",
        )
    names = list(square.pixels)
    try:
        to_floor = fit_homography(
            np.array([square.pixels[name] for name in names]),
            np.array([square.floor_m[name][:2] for name in names]),
        )
    except DegenerateError as error:
        raise FormatError(
            f"unusable corners_px: {error.message}", file=square.file, hint="Measure them again"
        ) from error

    times, positions, sources = [], [], []
    for path in paths:
        table = read_table(path)
        table.require(TIME_COLUMN, *PLANE_COLUMNS)
        if "source" in table.columns:
            sources += [name.strip() for name in table.columns["source"]]
        elif len(devices) == 1:
            sources += [devices[0]] * len(table)
        else:
            raise InputError(
                f"column 'source' is missing, but the recording has {', '.join(devices)}",
                file=path,
                where=1,
                hint="Add the column, with the names of the devices",
            )
        times.append(table.iso_times_ns(TIME_COLUMN))
        pixels = np.stack(
            [table.floats(name, -MAX_PIXELS, MAX_PIXELS) for name in PLANE_COLUMNS], axis=1
        )
        positions.append(apply_homography(to_floor, pixels))
    return _tracks(
        np.concatenate(times), np.concatenate(positions), sources, devices, facts, warnings
    )


def _tracks(
    time_ns: NDArray[np.int64],
    position_m: Array,
    sources: list[str],
    devices: tuple[str, ...],
    facts: dict[str, str],
    warnings: list[str],
) -> list[Trajectory]:
    """Return one trajectory a source, ascending in time, with each time stamp once."""
    source = np.array(sources)
    trajectories, repeats = [], 0
    for name in dict.fromkeys(sources):
        of_source = np.flatnonzero(source == name)
        stamps_ns, first = np.unique(time_ns[of_source], return_index=True)
        repeats += len(of_source) - len(stamps_ns)
        points_m = np.zeros((len(stamps_ns), 3))
        points_m[:, :2] = position_m[of_source[first]]
        trajectories.append(Trajectory.from_positions(name, FRAME, stamps_ns, points_m))
        if name not in devices:
            warnings.append(f"truth of device {name!r}, which is not in the recording")
    if repeats:
        warnings.append(f"{repeats} rows of the truth repeat a time stamp: the first was kept")
    facts["truth"] = (
        f"{sum(map(len, trajectories))} poses of {', '.join(t.device for t in trajectories)} from "
        "pixel tracks by the homography of the floor square; lens not corrected, the camera's "
        "clock not shifted"
    )
    return trajectories
