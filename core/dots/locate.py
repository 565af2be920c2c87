"""Frames to places: dots, grid and decoding joined, each frame by itself.

No frame knows of another, so that the first one counts as much as the thousandth
(the paper's peer needs a few frames until its vote on the orientation has settled:
facts/dots.md 3.2). Batches are only for speed: a frame's answer does not depend on them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots import grid
from locatk.core.dots.blobs import find_dots
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import DISPLACEMENT, MAIN, PERIOD, RANGE, Codec
from locatk.core.dots.decode import THRESHOLD, decode
from locatk.core.dots.grid import Lattices
from locatk.core.dots.located import Located, nothing
from locatk.core.dots.sheet import OFFSET

BATCH = 16
"""Frames that are worked on at once; their data fits the cache."""

WIDEST = 40
"""Columns and rows about the middle of a frame that are decoded."""

SMALLEST = 48
"""Pixels of a side below which a frame cannot show a window of the pattern."""

NATURAL = 120
"""Pixels of the short side at which the pattern is looked for first: at full size in the
paper's frames, at half size in those of twice their size, and so on."""

LEVELS = 4

OFTEN = 0.018
"""Likelihood of a bit that the dot's position all but excludes."""

SHARPEST = 0.03
"""Least standard deviation of a dot that is believed, in pitches."""

FEW_DOTS = "too_few_dots"
NO_GRID = "no_grid"
NO_CODE = "no_code"
DOUBTFUL = "low_confidence"
BORDER = "section_border"


@dataclass(frozen=True)
class Sighting:
    """Dots of one located frame with where on the grid each stands, for calibration.

    Attributes
    ----------
    pixels : (m, 2) float64 ndarray
        As seen, distortion and all.
    grid : (m, 2) float64 ndarray
        Of the dot itself, its displacement included, relative to :attr:`origin`.
    origin : (2,) int64 ndarray
    """

    pixels: NDArray[np.float64]
    grid: NDArray[np.float64]
    origin: NDArray[np.int64]


def locate(
    images: NDArray[np.uint8],
    codec: Codec,
    camera: Camera | None = None,
    *,
    threshold: float = THRESHOLD,
) -> Located:
    """Place and heading of (n, h, w) grey frames of one camera.

    Without a ``camera`` the centre of the frame is the camera's, and the bend of its lens
    is estimated in each frame.
    """
    n, height, width = images.shape
    result = nothing(n, FEW_DOTS)
    if min(height, width) < SMALLEST:
        return result
    for start in range(0, n, BATCH):
        left = np.arange(start, min(start + BATCH, n))
        for level in _levels(height, width):
            part, _ = _locate(images[left], codec, camera, level, threshold)
            result.keep(left, part)
            left = left[~result.accepted[left]]
            if not len(left):
                break
    return result


def sightings(
    images: NDArray[np.uint8], codec: Codec, camera: Camera | None = None
) -> Iterator[Sighting]:
    """What each located frame of ``images`` shows; frames that have no place are left out."""
    _, height, width = images.shape
    for image in images:
        for level in _levels(height, width):
            part, match = _locate(image[None], codec, camera, level, THRESHOLD)
            if part.accepted[0]:
                dots = match.use[0]
                centre, scale = _normal_frame(height, width, camera)
                seen = match.lattices.points[0, dots] * scale
                if camera is not None:
                    yield Sighting(
                        camera.distort(seen + centre), match.target[0, dots], match.origin[0]
                    )
                else:
                    yield Sighting(seen + centre, match.target[0, dots], match.origin[0])
                break


def _levels(height: int, width: int) -> list[int]:
    """Halvings of the frame to try, likeliest first."""
    short = min(height, width)
    first = max(0, round(math.log2(short / NATURAL)))
    possible = [k for k in range(max(LEVELS, first + 1)) if short >> k >= SMALLEST]
    return sorted(possible, key=lambda k: (abs(k - first), k))


def _normal_frame(
    height: int, width: int, camera: Camera | None
) -> tuple[NDArray[np.float64], float]:
    """Centre of the camera in px, and half the diagonal of a frame."""
    centre = ((width - 1) / 2, (height - 1) / 2) if camera is None else camera.centre_px
    return np.array(centre), math.hypot(width, height) / 2


@dataclass(frozen=True)
class _Match:
    """Dots of frames against the pattern: (n, m) in use, (n, m, 2) by how much each misses
    its lattice coordinates, and (n, m, 2) where it stands from ``origin`` on."""

    lattices: Lattices
    use: NDArray[np.bool_]
    miss: NDArray[np.float32]
    target: NDArray[np.float64]
    origin: NDArray[np.int64]


def _locate(
    images: NDArray[np.uint8],
    codec: Codec,
    camera: Camera | None,
    level: int,
    threshold: float,
) -> tuple[Located, _Match]:
    n, height, width = images.shape
    shrink = 1 << level
    if level:
        size = (width >> level, height >> level)
        whole = images[:, : size[1] << level, : size[0] << level]
        images = np.stack([cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in whole])
    dots = find_dots(images)
    pixels = (dots.xy + np.float32(0.5)) * np.float32(shrink) - np.float32(0.5)
    centre, scale = _normal_frame(height, width, camera)
    if camera is not None and camera.radial:
        pixels = camera.undistort(pixels.astype(np.float64))
    points = ((pixels - centre) / scale).astype(np.float32)
    lattices = grid.fit_lattices(points, dots.valid, lens=camera is None)

    half = _half(lattices)
    column_bits, row_bits = _bits(lattices, half)
    decoded = decode(column_bits, row_bits, codec)
    match = _match(lattices, half, decoded.x, decoded.y, decoded.section, decoded.rotation, codec)
    covariance = _refine(lattices, match)

    rejected = np.full(n, "", object)
    rejected[decoded.confidence < threshold] = DOUBTFUL
    rejected[decoded.confidence < 0.5] = NO_CODE
    rejected[(rejected != "") & decoded.border] = BORDER
    rejected[~lattices.found] = NO_GRID
    rejected[dots.counts < grid.FEWEST] = FEW_DOTS
    centre_uv = lattices.parameters[:, [grid.C_U, grid.C_V]]
    turn = _turns()[decoded.rotation]
    at = np.einsum("nij,nj->ni", turn, centre_uv + half) + _corner(half)[decoded.rotation]
    slope = grid.slope_at_centre(lattices.parameters)
    right = np.einsum("nij,nj->ni", turn, slope[:, :, 0])
    located = Located(
        grid=at + np.stack([decoded.x, decoded.y], axis=1),
        section=decoded.section,
        heading=np.arctan2(-right[:, 1], right[:, 0]),
        covariance=_pose_covariance(covariance, slope, turn),
        dots=decoded.dots,
        corrected=decoded.corrected,
        confidence=np.where(lattices.found, decoded.confidence, 0.0),
        rejected=rejected,
    )
    return located, match


def _half(lattices: Lattices) -> int:
    """Half the width of the window in which all frames' dots lie."""
    places = np.abs(lattices.place[lattices.valid & lattices.found[:, None]])
    reach = int(places.max(initial=4)) + 1 if places.size else 5
    return min(reach, WIDEST // 2)


def _bits(lattices: Lattices, half: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row bits (n, 2 half, 2 half) as the decoder takes them.

    A bit is one where the dot lies beyond the diagonal through its place (papers/dots.txt
    Fig. 6); how sure that is follows from the scatter of the frame's dots. Where two dots
    claim a place, the one closer to where symbols stand is taken.
    """
    length = 2 * half
    n = len(lattices.found)
    rest = lattices.uv - lattices.place
    index = lattices.place.astype(np.int64) + half
    inside = (
        lattices.valid & lattices.found[:, None] & ((index >= 0) & (index < length)).all(axis=2)
    )
    frame, dot = np.nonzero(inside)
    index, rest = index[frame, dot], rest[frame, dot]
    cell = (frame * length + index[:, 1]) * length + index[:, 0]
    miss = np.abs(rest - grid.displacement(rest)).max(axis=1)
    holder = np.full(n * length * length, -1, np.int64)
    order = np.arange(len(cell))
    holder[cell] = order
    worse = np.flatnonzero(holder[cell] != order)
    for k in worse[np.argsort(-miss[worse], kind="stable")]:
        if miss[k] < miss[holder[cell[k]]]:
            holder[cell[k]] = k
    kept = holder[cell] == order
    cell, rest, frame = cell[kept], rest[kept], frame[kept]

    sigma = np.clip(1.5 * lattices.sigma, SHARPEST, 2 * SHARPEST)[frame]
    spread = (-0.25 / (sigma * sigma)).astype(np.float32)
    bits = []
    for along in (rest[:, 1] - rest[:, 0], rest[:, 1] + rest[:, 0]):
        one = np.exp(spread * (along - OFFSET) ** 2) + OFTEN
        zero = np.exp(spread * (along + OFFSET) ** 2) + OFTEN
        table = np.zeros(n * length * length, np.float32)
        table[cell] = np.log(one / zero)
        bits.append(table.reshape(n, length, length))
    return bits[0], bits[1]


def _turns() -> NDArray[np.int64]:
    """(4, 2, 2): directions as seen to directions as printed, by rotation."""
    back = np.array([[0, -1], [1, 0]])
    return np.stack([np.linalg.matrix_power(back, k) for k in range(4)])


def _corner(half: int) -> NDArray[np.int64]:
    """(4, 2) printed index of the seen window's upper left place, by rotation."""
    last = 2 * half - 1
    return np.array([[0, 0], [last, 0], [last, last], [0, last]])


def _match(
    lattices: Lattices,
    half: int,
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    section: NDArray[np.int64],
    rotation: NDArray[np.int64],
    codec: Codec,
) -> _Match:
    """Where in the lattice each dot should stand, if it is what the code has there."""
    turn, corner = _turns()[rotation], _corner(half)[rotation]
    index = (lattices.place.astype(np.int64) + half) @ turn.transpose(0, 2, 1) + corner[:, None]
    steps = np.arange(2 * half)
    columns = codec.phases((x[:, None] + steps) % RANGE) + section[:, :1]
    rows = codec.phases((y[:, None] + steps) % RANGE) + section[:, 1:]
    inside = ((index >= 0) & (index < 2 * half)).all(axis=2)
    column = np.where(inside, index[..., 0], 0)
    row = np.where(inside, index[..., 1], 0)
    column_bit = MAIN[(np.take_along_axis(columns, column, 1) + y[:, None] + row) % PERIOD]
    row_bit = MAIN[(np.take_along_axis(rows, row, 1) + x[:, None] + column) % PERIOD]
    printed = DISPLACEMENT[column_bit + 2 * row_bit] * OFFSET
    seen = (printed @ turn).astype(np.float32)  # the inverse turn
    miss = lattices.uv - lattices.place - seen
    use = lattices.valid & inside & (np.abs(miss) < grid.TIGHT).all(axis=2)
    target = index + printed
    return _Match(lattices, use, miss, target, np.stack([x, y], axis=1))


def _refine(lattices: Lattices, match: _Match) -> NDArray[np.float64]:
    """Fit the lattices once more, to the dots that say what they should; (n, 9, 9) covariance."""
    lattices.parameters, covariance = grid.refit(lattices, match.miss, match.use)
    return covariance


def _pose_covariance(
    covariance: NDArray[np.float64], slope: NDArray[np.float64], turn: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(n, 3, 3) of x, y and heading from that of a lattice's parameters."""
    n = len(covariance)
    jacobian = np.zeros((n, 3, 9))
    jacobian[:, :2, grid.C_U] = turn[:, :, 0]
    jacobian[:, :2, grid.C_V] = turn[:, :, 1]
    # Heading is minus the angle of the image's right in the lattice, but for quarter turns.
    u, v = slope[:, 0, 0], slope[:, 1, 0]
    square = u * u + v * v
    jacobian[:, 2, grid.A_U.start] = v / square
    jacobian[:, 2, grid.A_V.start] = -u / square
    result: NDArray[np.float64] = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return result
