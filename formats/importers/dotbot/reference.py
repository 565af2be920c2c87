"""What fixes the frame of a DotBot recording: the floor square and the camera's tracks.

``calibration.json`` has one entry a video: ``corners_cm`` (the square on the floor),
``corners_px`` (the same corners in the video), and either ``corners_lh2`` (the corners in
PyDotBot's plane, columns x and y of a one-station recording) or ``timestamps_lh2`` (when a
robot stood on each corner).

Axes. The corners ``tl, tr, br, bl`` go clockwise as seen from above, which the images of
three published stations and the camera agree on. Where ``corners_cm`` makes them go the
other way round (y to the front, as in a picture), its frame would have z pointing into the
floor. There y is negated, for markers and truth alike, so that z is up (REP 103).

One-station recordings. Their columns x and y are an exact homography (residual 1e-15 in
the published files) of the image point that the counts give; PyDotBot fitted it to the
counts it read on the four corners. The homography is found again from the recording,
turned back at the corners, and gives those counts: what the robot measured on the markers
when it was calibrated. (In the published files they come out whole to 0.001.)
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from locatk.formats.tables.csv_table import parse_time_ns, read_table, read_text

Array = NDArray[np.float64]

FRAME = "floor"
CLOCKWISE = ("tl", "tr", "br", "bl")
"""Names of the square's corners, clockwise from above."""

EXACT = 1e-6
"""Columns x and y that miss the homography by more do not derive from the counts."""


@dataclass(frozen=True)
class Rows:
    """Rows of a recording; n rows with k counts each.

    Attributes
    ----------
    devices : tuple of str
    time_ns : (n,) int64 ndarray
    device : (n,) int32 ndarray
    count : (n, k) float64 ndarray
    channel, polynomial : (n, k) int32 ndarray
    truth : (n, 3) ndarray or None
        Positions in metres.
    plane : (n, 2) ndarray or None
        Columns x and y: PyDotBot's plane, without unit.
    """

    devices: tuple[str, ...]
    time_ns: NDArray[np.int64]
    device: NDArray[np.int32]
    count: Array
    channel: NDArray[np.int32]
    polynomial: NDArray[np.int32]
    truth: Array | None
    plane: Array | None

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, index: NDArray[np.int64]) -> Rows:
        """The rows ``index``, in that order."""
        return replace(
            self,
            time_ns=self.time_ns[index],
            device=self.device[index],
            count=self.count[index],
            channel=self.channel[index],
            polynomial=self.polynomial[index],
            truth=None if self.truth is None else self.truth[index],
            plane=None if self.plane is None else self.plane[index],
        )


@dataclass(frozen=True)
class FloorSquare:
    """Known points on the floor.

    Attributes
    ----------
    file : Path
    floor : dict of str to (2,) ndarray
        Metres, z up.
    pixels, plane : dict of str to (2,) ndarray
        The same points in the video and in PyDotBot's plane; empty where not given.
    stays : dict of str to (int, int)
        Start and end in nanoseconds since the epoch of a robot's stay on each point.
    axes : str
        Whether y was negated, in words.
    """

    file: Path
    floor: dict[str, Array]
    pixels: dict[str, Array]
    plane: dict[str, Array]
    stays: dict[str, tuple[int, int]]
    axes: str


def find_calibration(
    explicit: Path | None, truth: Sequence[Path], recordings: Sequence[Path]
) -> Path | None:
    """``calibration.json``: as given, beside the truth, beside the recordings, or in their
    sister folder ``ground_truth``, as published."""
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
        No JSON, no or several videos, a key that is missing or is not what it should be.
    """
    try:
        content = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise FormatError(
            f"no JSON ({error.msg})", file=path, where=error.lineno, hint="check the file"
        ) from error
    except RecursionError:
        raise FormatError("no calibration: nested too deeply", file=path) from None
    if not isinstance(content, dict):
        raise FormatError("no calibration: should be an object", file=path)
    videos = {"": content} if "corners_cm" in content else content
    if len(videos) != 1:
        raise FormatError(
            f"{len(videos)} videos, where one is expected",
            file=path,
            hint="keep the entry of this recording only",
        )
    name, video = next(iter(videos.items()))
    if not isinstance(video, dict) or "corners_cm" not in video:
        raise FormatError(
            "missing key 'corners_cm'", file=path, where=name, hint="corner name to [x, y] in cm"
        )

    def points(key: str) -> dict[str, Array]:
        return {
            corner: _pair(value, path, f"{key}.{corner}")
            for corner, value in _object(video.get(key, {}), path, key).items()
        }

    floor = {corner: value / 100 for corner, value in points("corners_cm").items()}
    axes = "axes as given"
    if all(corner in floor for corner in CLOCKWISE):
        x, y = np.array([floor[corner] for corner in CLOCKWISE]).T
        if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0:
            floor = {corner: value * [1.0, -1.0] for corner, value in floor.items()}
            axes = "y negated, so that z is up"
    stays = {
        corner: _stay(value, path, f"timestamps_lh2.{corner}")
        for corner, value in _object(
            video.get("timestamps_lh2", {}), path, "timestamps_lh2"
        ).items()
    }
    square = FloorSquare(path, floor, points("corners_px"), points("corners_lh2"), stays, axes)
    for part in (square.pixels, square.plane, square.stays):
        unknown = sorted(set(part) - set(floor))
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
    """The first two numbers of a list; a third may be there (the published ones have 0)."""
    good = isinstance(value, list) and len(value) in (2, 3)
    if good:
        good = all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not good or not np.all(np.isfinite(np.array(value, float))):
        raise FormatError(f"{str(value)[:40]} should be two finite numbers", file=path, where=where)
    return np.array(value[:2], float)


def _stay(value: Any, path: Path, where: str) -> tuple[int, int]:
    try:
        start, end = (parse_time_ns(time) for time in value)
    except (TypeError, ValueError, AttributeError):
        start, end = 1, 0
    if start >= end:
        raise FormatError(
            f"{str(value)[:70]} should be two ascending UTC times", file=path, where=where
        )
    return start, end


def scene_of(
    square: FloorSquare, rows: Rows, facts: dict[str, str], warnings: list[str]
) -> Scene | None:
    """Markers at the corners with what the recording says of them; None without any."""
    sightings: dict[str, MarkerVisit] = {}
    if square.plane and rows.plane is not None:
        sightings = _sightings_of_plane(square, rows, facts, warnings)
    elif square.stays:
        sightings = _sightings_of_stays(square, rows, facts, warnings)
    if not sightings:
        return None
    return Scene(
        markers=tuple(
            Marker(name, np.append(position, 0.0), (sightings[name],) if name in sightings else ())
            for name, position in square.floor.items()
        ),
        frame=FRAME,
    )


def _sightings_of_plane(
    square: FloorSquare, rows: Rows, facts: dict[str, str], warnings: list[str]
) -> dict[str, MarkerVisit]:
    """Counts on the corners, from the homography hidden in columns x and y."""
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
    if not residual <= EXACT:
        warnings.append(
            f"columns x and y are no homography of the counts (residual {residual:.1g}): "
            "no markers were derived"
        )
        return {}
    corners = np.array(list(square.plane.values()))
    right, up = apply_homography(np.linalg.inv(to_plane), corners).T
    # The plane was made with ideal stations, whatever the real one is like.
    angles = predict_angles(np.stack([np.ones(len(right)), -right, up], axis=1), IDEAL_CALIBRATION)
    counts = angles_to_counts(angles, channel)
    facts["markers"] = (
        f"{len(corners)}: counts on the corners, recovered from the homography of columns x "
        f"and y (residual {residual:.1g}) that PyDotBot was calibrated with"
    )
    return {
        name: MarkerVisit(counts={channel: (float(first), float(second))})
        for name, (first, second) in zip(square.plane, counts, strict=True)
    }


def _sightings_of_stays(
    square: FloorSquare, rows: Rows, facts: dict[str, str], warnings: list[str]
) -> dict[str, MarkerVisit]:
    """Which device reported during each stay on a corner."""
    sightings = {}
    for name, (start, end) in square.stays.items():
        during = (rows.time_ns >= start) & (rows.time_ns <= end)
        present = np.unique(rows.device[during])
        if len(present) == 1:
            sightings[name] = MarkerVisit(rows.devices[present[0]], start, end)
        else:
            who = "no device" if len(present) == 0 else "more than one device"
            warnings.append(f"marker {name!r}: {who} reported during the stay on it")
    seen_by = sorted({str(sighting.device) for sighting in sightings.values()})
    if sightings:
        facts["markers"] = f"{len(sightings)}: stays of {', '.join(seen_by)} on the corners"
    return sightings


def read_tracks(
    paths: Sequence[Path],
    square: FloorSquare,
    devices: tuple[str, ...],
    facts: dict[str, str],
    warnings: list[str],
) -> list[Trajectory]:
    """Truth from pixel tracks: one trajectory a device, on the floor (z = 0).

    Pixels become floor metres by the homography of the square's four corners, as in the
    authors' code: the lens is not corrected, the camera's clock not shifted.

    Parameters
    ----------
    paths : sequence of path
        CSV with ``timestamp, x, y`` and, where there are several devices, ``source``.
    square : FloorSquare
    devices : tuple of str
        Devices of the recording. Tracks without ``source`` belong to the only one.
    facts, warnings : dict and list
        Added to.

    Raises
    ------
    FormatError, InputError
        As for recordings; tracks without ``source`` of several devices.
    MissingDataError
        The calibration has no four corners in pixels.
    """
    if len(square.pixels) < 4:
        raise MissingDataError(
            "fewer than four corners in 'corners_px'",
            file=square.file,
            hint="pixel tracks need the floor square in pixels",
        )
    names = list(square.pixels)
    try:
        to_floor = fit_homography(
            np.array([square.pixels[name] for name in names]),
            np.array([square.floor[name] for name in names]),
        )
    except DegenerateError as error:
        raise FormatError(
            f"unusable corners_px: {error.message}", file=square.file, hint="measure them anew"
        ) from error

    times, positions, sources = [], [], []
    for path in paths:
        table = read_table(path)
        table.require("timestamp", "x", "y")
        if "source" in table.columns:
            sources += [name.strip() for name in table.columns["source"]]
        elif len(devices) == 1:
            sources += [devices[0]] * len(table)
        else:
            raise InputError(
                f"tracks without column 'source', where the recording has {', '.join(devices)}",
                file=path,
                where=1,
                hint="add the column, with the names of the devices",
            )
        times.append(table.times_ns())
        pixels = np.stack([table.floats("x"), table.floats("y")], axis=1)
        positions.append(apply_homography(to_floor, pixels))
    return _tracks(
        np.concatenate(times), np.concatenate(positions), sources, devices, facts, warnings
    )


def _tracks(
    time: NDArray[np.int64],
    position: Array,
    sources: list[str],
    devices: tuple[str, ...],
    facts: dict[str, str],
    warnings: list[str],
) -> list[Trajectory]:
    """One trajectory a source, ascending in time, each stamp once."""
    source = np.array(sources)
    trajectories, repeats = [], 0
    for name in dict.fromkeys(sources):
        mine = np.flatnonzero(source == name)
        stamps, first = np.unique(time[mine], return_index=True)
        repeats += len(mine) - len(stamps)
        points = np.zeros((len(stamps), 3))
        points[:, :2] = position[mine[first]]
        trajectories.append(Trajectory.from_positions(name, FRAME, stamps, points))
        if name not in devices:
            warnings.append(f"truth of device {name!r}, which the recording does not have")
    if repeats:
        warnings.append(f"{repeats} rows of the truth repeat a time stamp: the first was kept")
    facts["truth"] = (
        f"{sum(map(len, trajectories))} poses of {', '.join(t.device for t in trajectories)} from "
        "pixel tracks by the homography of the floor square; lens not corrected, the camera's "
        "clock not shifted"
    )
    return trajectories
