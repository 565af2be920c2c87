"""Reference of a DotBot recording: the floor square and the pixel tracks of a camera.

``calibration.json`` has one entry a video: ``corners_cm`` (the square on the floor),
``corners_px`` (the same corners in the video), and either ``corners_lh2`` (the corners in
PyDotBot's plane, columns x and y of a one-station recording) or ``timestamps_lh2`` (the times
at which a robot rested on each corner).

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

FRAME = "floor"
CLOCKWISE = ("tl", "tr", "br", "bl")
"""Names of the square's corners, clockwise from above."""

MAX_HOMOGRAPHY_RESIDUAL = 1e-6
"""Largest residual of columns x and y that derive from the counts, in units of the plane."""

MIN_CORNERS = 4
"""Corners in pixels that determine the homography to the floor."""

CENTIMETRES_PER_METRE = 100

MAX_PIXELS = 1e5
"""Largest coordinate in a video: no frame is that wide."""


@dataclass(frozen=True)
class FloorSquare:
    """Known points on the floor.

    Attributes
    ----------
    file : Path
    floor_m : dict of str to (2,) ndarray
        In axes with z up.
    pixels, plane : dict of str to (2,) ndarray
        The same points in the video and in PyDotBot's plane; empty if not given.
    stays : dict of str to (int, int)
        Start and end of the stay of a robot on each point, in nanoseconds since the epoch.
    axes : str
        Description of the axes, for the facts of the session.
    """

    file: Path
    floor_m: dict[str, Array]
    pixels: dict[str, Array]
    plane: dict[str, Array]
    stays: dict[str, tuple[int, int]]
    axes: str


def find_calibration(
    explicit: Path | None, truth: Sequence[Path], recordings: Sequence[Path]
) -> Path | None:
    """Return the path of ``calibration.json``; None if there is none.

    It is the given file, or one in the folder of the truth, of the recordings, or in their sister
    folder ``ground_truth`` as in the published data sets.

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
    candidates = (folder / "calibration.json" for folder in folders)
    return next((file for file in candidates if file.is_file()), None)


def read_calibration(path: Path) -> FloorSquare:
    """Read ``calibration.json``.

    Raises
    ------
    FormatError
        The file is not JSON, has no or several videos, or a key is missing or wrong.
    """
    try:
        content = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise FormatError(
            f"not JSON ({error.msg})", file=path, where=error.lineno, hint="Check the file"
        ) from error
    except RecursionError:
        raise FormatError("not a calibration: nested too deeply", file=path) from None
    if not isinstance(content, dict):
        raise FormatError("not a calibration: should be an object", file=path)
    videos = {"": content} if "corners_cm" in content else content
    if len(videos) != 1:
        raise FormatError(
            f"{len(videos)} videos instead of one",
            file=path,
            hint="Keep the entry of this recording only",
        )
    name, video = next(iter(videos.items()))
    if not isinstance(video, dict) or "corners_cm" not in video:
        raise FormatError(
            "key 'corners_cm' is missing",
            file=path,
            where=name,
            hint="Map the name of each corner to [x, y] in cm",
        )

    def points(key: str) -> dict[str, Array]:
        return {
            corner: _pair(value, path, f"{key}.{corner}")
            for corner, value in _object(video.get(key, {}), path, key).items()
        }

    floor_m = {
        corner: value / CENTIMETRES_PER_METRE for corner, value in points("corners_cm").items()
    }
    axes = "axes as given"
    if all(corner in floor_m for corner in CLOCKWISE):
        x, y = np.array([floor_m[corner] for corner in CLOCKWISE]).T
        if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0:
            floor_m = {corner: value * [1.0, -1.0] for corner, value in floor_m.items()}
            axes = "y negated, so that z is up"
    stays = {
        corner: _stay(value, path, f"timestamps_lh2.{corner}")
        for corner, value in _object(
            video.get("timestamps_lh2", {}), path, "timestamps_lh2"
        ).items()
    }
    square = FloorSquare(path, floor_m, points("corners_px"), points("corners_lh2"), stays, axes)
    for part in (square.pixels, square.plane, square.stays):
        unknown = sorted(set(part) - set(floor_m))
        if unknown:
            raise FormatError(
                f"corner {unknown[0]!r} is not in 'corners_cm'", file=path, where=name
            )
    return square


def _object(value: Any, path: Path, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise FormatError("should be an object of corners", file=path, where=where)
    return value


def _pair(value: Any, path: Path, where: str) -> Array:
    """Return the first two numbers of a list; a third is allowed (the published lists have 0)."""
    is_valid = isinstance(value, list) and len(value) in (2, 3)
    if is_valid:
        is_valid = all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not is_valid or not np.all(np.isfinite(np.array(value, float))):
        raise FormatError(f"{str(value)[:40]} should be two finite numbers", file=path, where=where)
    return np.array(value[:2], float)


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
            Marker(name, np.append(position, 0.0), (visits[name],) if name in visits else ())
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
            np.array([square.floor_m[name] for name in names]),
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
