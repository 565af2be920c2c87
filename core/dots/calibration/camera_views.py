"""Which frames of a session are taken to calibrate its camera, and the dots in them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.camera_fit import Views, homographies
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import locate, sightings
from locatk.core.dots.sheet import OFFSET, Manifest
from locatk.core.dots.solver import OFF_SHEET, RIM, UNREADABLE
from locatk.core.errors import DegenerateError, InputError

Array = NDArray[np.float64]

NO_PATTERN = "no_pattern"

FEWEST_FRAMES = 5
"""With fewer, nothing tells a bad frame from a good one."""

MOST_FRAMES = 200
"""Frames that are fitted; more would tell nothing new."""

MOST_LOCATED = 2 * MOST_FRAMES
"""Frames with a place from which those are chosen."""

MOST_SEEN = 1000
"""Frames that are looked at, where many of them show no pattern."""

BLOCK = 40
"""Frames that are in memory at once."""

MOST_DOTS = 250
"""Of a frame; the paper's camera sees 180."""


@dataclass(frozen=True)
class SeenFrame:
    """Dots of a located frame.

    Attributes
    ----------
    index : int
        Of the frame.
    size : (width, height)
        In px.
    pixels : (m, 2) ndarray
        As seen, in px.
    plane : (m, 2) ndarray
        In metres on the sheet from any origin, x right, y down, as printed.
    """

    index: int
    size: tuple[int, int]
    pixels: Array
    plane: Array


def spread_order(count: int) -> list[int]:
    """All of 0 .. count - 1, so that any beginning of it is spread evenly over them.

    By the fractional parts of the multiples of the golden ratio.
    """
    return np.argsort(np.arange(count) * ((math.sqrt(5) - 1) / 2) % 1).tolist()


def look(
    frames: Frames,
    manifest: Manifest,
    code: Codec,
    order: Iterable[int],
    cameras: Sequence[Camera | None],
) -> dict[int, SeenFrame | str]:
    """What frames show, or why they cannot be used, by index; until there are enough.

    Parameters
    ----------
    frames, manifest, code
    order : iterable of int
        Frames to look at.
    cameras : sequence of Camera or None
        With which of them to look, until one helps; None knows of no lens.
    """
    looked: dict[int, SeenFrame | str] = {}
    order = list(order)
    for start in range(0, len(order), BLOCK):
        images: dict[int, NDArray[np.uint8]] = {}
        for index in order[start : start + BLOCK]:
            looked[index] = NO_PATTERN
            try:
                images[index] = frames.images[index]
            except InputError:
                looked[index] = UNREADABLE
        for camera in dict.fromkeys(cameras):
            for index in _located(images, code, camera):
                looked[index] = _dots_of(index, images.pop(index), manifest, code, camera)
        if sum(isinstance(one, SeenFrame) for one in looked.values()) >= MOST_LOCATED:
            break
    return looked


def _located(images: dict[int, NDArray[np.uint8]], code: Codec, camera: Camera | None) -> list[int]:
    """Which frames have a place. In a batch, those that have none cost least."""
    found: list[int] = []
    for shape in {image.shape for image in images.values()}:
        if camera is None or camera.size == shape[::-1]:
            same = [index for index, image in images.items() if image.shape == shape]
            located = locate(np.stack([images[index] for index in same]), code, camera)
            found += [same[k] for k in np.flatnonzero(located.accepted)]
    return sorted(found)


def _dots_of(
    index: int,
    image: NDArray[np.uint8],
    manifest: Manifest,
    code: Codec,
    camera: Camera | None,
) -> SeenFrame | str:
    height, width = image.shape
    for sighting in sightings(image[None], code, camera):
        middle = sighting.origin + sighting.grid.mean(axis=0)
        number = int(manifest.find(middle[None], [[-1, -1]], slack=RIM)[0])
        if number < 0:
            return OFF_SHEET
        place = np.rint(sighting.grid)
        shift = (sighting.grid - place) * (manifest.offset_mm / manifest.pitch_mm / OFFSET)
        # Lengths alone: how a tile is turned on its floor means nothing to a camera.
        pitch = np.linalg.norm(manifest.jacobian(number), axis=0)
        plane = (place + shift) * pitch
        some = np.random.default_rng(index).permutation(len(plane))[:MOST_DOTS]
        return SeenFrame(index, (width, height), sighting.pixels[some], plane[some])
    return NO_PATTERN


def seen_of(
    looked: dict[int, SeenFrame | str], indices: Iterable[int], size: tuple[int, int]
) -> list[SeenFrame]:
    """Located frames of ``size`` among ``indices``."""
    outcomes = (looked[index] for index in indices)
    return [one for one in outcomes if isinstance(one, SeenFrame) and one.size == size]


def common_size(looked: dict[int, SeenFrame | str], total: int) -> tuple[int, int]:
    """Size in px of most located frames of ``total``.

    Raises
    ------
    DegenerateError
        There are less than :data:`FEWEST_FRAMES`.
    """
    sizes = Counter(one.size for one in looked.values() if isinstance(one, SeenFrame))
    size, count = sizes.most_common(1)[0] if sizes else ((0, 0), 0)
    if count >= FEWEST_FRAMES:
        return size
    reasons = Counter(one for one in looked.values() if isinstance(one, str))
    of = f"of {len(looked)} frames" + (f" (of {total})" if len(looked) < total else "")
    if reasons[OFF_SHEET] >= FEWEST_FRAMES:
        raise DegenerateError(
            f"{reasons[OFF_SHEET]} {of} show the pattern off all sheets of the manifest",
            hint="Is it the manifest of another sheet?",
        )
    raise DegenerateError(
        f"{count or 'none'} {of} show the pattern, where {FEWEST_FRAMES} are needed",
        hint="Take sharp frames at several places of the sheet that the manifest describes",
    )


def spread(size: tuple[int, int], found: list[SeenFrame], total: int) -> list[SeenFrame]:
    """At most :data:`MOST_FRAMES`, as different as can be in heading, tilt and time."""
    if len(found) <= MOST_FRAMES:
        return found
    own = homographies(views_of(size, found))
    heading = np.arctan2(own[:, 3], own[:, 0])
    tilt = own[:, 6:] / np.maximum(np.std(own[:, 6:]), 1e-12)
    when = np.array([seen.index for seen in found]) / total
    features = np.column_stack([np.cos(heading), np.sin(heading), tilt.clip(-3, 3), 2 * when])
    chosen = [0]
    nearest = np.full(len(found), np.inf)
    while len(chosen) < MOST_FRAMES:
        away = np.linalg.norm(features - features[chosen[-1]], axis=1)
        nearest = np.minimum(nearest, away)
        chosen.append(int(np.argmax(nearest)))
    return [found[k] for k in sorted(chosen)]


def views_of(size: tuple[int, int], found: Sequence[SeenFrame]) -> Views:
    """Frames as arrays, the shorter ones filled up."""
    most = max(len(seen.pixels) for seen in found)
    pixels, plane = np.zeros((2, len(found), most, 2))
    valid = np.zeros((len(found), most), bool)
    for k, seen in enumerate(found):
        count = len(seen.pixels)
        pixels[k, :count], plane[k, :count], valid[k, :count] = seen.pixels, seen.plane, True
    return Views(size, pixels, plane, valid)
