"""The published algorithm, a frame at a time, cold: for comparison.

Hostettler et al., Real-Time High-Accuracy 2D Localization with Structured Patterns
(papers/dots.txt), II-B. The first half, from a frame to a grid and soft bits, is in
:mod:`~locatk.core.dots.published.grid`; here is the second, from soft bits to a pose. As in
the paper nothing asks whether an answer is likely: whatever digits the best correlations
give are looked up, and only strings that no sequence holds are refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import (
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
    sequences,
)
from locatk.core.dots.codec.lookup import SHIFTS, STRING, digits_of, strings
from locatk.core.dots.published import grid as paper_grid
from locatk.core.dots.published.grid import Grid
from locatk.core.errors import InputError

Array = NDArray[np.float64]

WINDOW = 8
"""Dots a side of what is decoded (II-B.5)."""

FEWEST_DOTS = 9
"""Less has no intact neighbourhood of 3 x 3 dots."""

MOST_PLACES = 1_000_000
"""A grid of more places than that lies over no pattern."""

_SHIFTED = (
    MAIN_SEQUENCE[
        np.add.outer(np.arange(MAIN_SEQUENCE_LENGTH), np.arange(WINDOW)) % MAIN_SEQUENCE_LENGTH
    ]
    * 2.0
    - 1.0
)
"""(63, 8) the main sequence from each place on, as -1 and 1."""


@dataclass(frozen=True)
class PaperPose:
    """What the published algorithm says of one frame.

    Attributes
    ----------
    x, y : float
        Grid coordinates, with fractions, of the camera's centre; nan where rejected.
    heading_rad : float
        From the sheet's x to the image's right, counter-clockwise; -pi..pi.
    section : (u, v)
        Each 0..62; that of most columns and rows. -1 where rejected.
    dots : int
        Blobs taken for dots.
    corrected_bits : int
        Of the 128 in the window, those that differ from the best correlations.
    quality : float
        Mean of ``|P(x) P(y)|`` over the window, 0..1: how near the dots lie to where
        dots may lie. Not a probability.
    rejected : str or None
        ``no_dots``: fewer than nine blobs. ``no_grid``: no two directions, or no intact
        3 x 3 neighbourhood. ``no_window``: fewer than 8 x 8 places, or over a million.
        ``no_orientation``: rows or columns vote alike for both directions. ``no_code``:
        their strings are in no sequence, or point to different places, or to a place
        beyond the range.
    """

    x: float = float("nan")
    y: float = float("nan")
    heading_rad: float = float("nan")
    section: tuple[int, int] = (-1, -1)
    dots: int = 0
    corrected_bits: int = 0
    quality: float = 0.0
    rejected: str | None = None


def locate_paper(image: NDArray[np.uint8], codec: Codec, camera: Camera | None = None) -> PaperPose:
    """Pose of one frame by the published algorithm.

    Parameters
    ----------
    image : (height, width) uint8 ndarray
        Dots dark.
    codec : Codec
    camera : Camera, optional
        Where the device's centre lies in the frame, and the lens's radial distortion.
        Without one: the frame's middle, and none.

    Returns
    -------
    PaperPose

    Raises
    ------
    InputError
        The image is not grey with 8 bits, or of another size than the camera's.
    """
    if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
        raise InputError(f"a frame of {image.dtype} and shape {image.shape} is not 8-bit grey")
    height, width = image.shape
    if camera is not None and camera.size != (width, height):
        raise InputError(
            f"a frame of {width} x {height} px is not of the camera's "
            f"{camera.size[0]} x {camera.size[1]} px"
        )
    centre = np.array([(width - 1) / 2, (height - 1) / 2] if camera is None else camera.centre_px)
    points = paper_grid.find_dots(image, camera)
    dots = len(points)
    if dots < FEWEST_DOTS:
        return PaperPose(dots=dots, rejected="no_dots")
    laid = paper_grid.lay_grid(points, centre)
    if laid is None:
        return PaperPose(dots=dots, rejected="no_grid")
    grid, places, offsets = laid
    size = np.ptp(places, axis=0) + 1
    if size.min() < WINDOW or size.prod() > MOST_PLACES:
        return PaperPose(dots=dots, rejected="no_window")
    bits = paper_grid.soft_bits(places, offsets)
    corner = best_window(np.abs(bits.prod(axis=0)))
    window = bits[:, corner[1] : corner[1] + WINDOW, corner[0] : corner[0] + WINDOW]
    quarters = vote_orientation(window)
    if quarters is None:
        return PaperPose(dots=dots, rejected="no_orientation")
    upright, grid = turn_back(window, grid, quarters, corner + places.min(axis=0))
    weights = np.abs(upright.prod(axis=0))
    x_phases, x_wrong = correlate(upright[0].T, weights.T)
    y_phases, y_wrong = correlate(upright[1], weights)
    x, y = find_place(x_phases, codec), find_place(y_phases, codec)
    if x is None or y is None:
        return PaperPose(dots=dots, rejected="no_code")
    at = np.array([x, y]) + grid.coordinates(centre)  # eq. 10 to 12
    along = np.arange(WINDOW)
    u = (x_phases - y - codec.phases(x + along)) % MAIN_SEQUENCE_LENGTH
    v = (y_phases - x - codec.phases(y + along)) % MAIN_SEQUENCE_LENGTH
    return PaperPose(
        x=float(at[0]),
        y=float(at[1]),
        heading_rad=float(np.arctan2(grid.u[1], grid.u[0])),
        section=(int(np.bincount(u).argmax()), int(np.bincount(v).argmax())),
        dots=dots,
        corrected_bits=x_wrong + y_wrong,
        quality=float(weights.mean()),
    )


def best_window(likely: NDArray[np.float64]) -> NDArray[np.intp]:
    """II-B.5: column and row of the corner of the 8 x 8 places with the largest sum."""
    total = np.pad(likely, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    down = total[WINDOW:] - total[:-WINDOW]
    sums = down[:, WINDOW:] - down[:, :-WINDOW]
    row, column = np.unravel_index(np.argmax(sums), sums.shape)
    return np.array([column, row])


def vote_orientation(window: Array) -> int | None:
    """II-B.6: quarter turns counter-clockwise by which the print appears turned; 0..3.

    Every column of column bits and every row of row bits is sought in the main sequence as
    it stands, and reversed and flipped, which it is when its axis points backwards. Lines
    with a missing dot do not vote. None where an axis has no majority.
    """
    forward = []
    for lines in (window[0].T, window[1]):
        whole = np.sign(lines[(lines != 0).all(axis=1)])
        votes = [
            int((tried[:, None] == _SHIFTED).all(axis=2).sum())
            for tried in (whole, -whole[:, ::-1])
        ]
        if votes[0] == votes[1]:
            return None
        forward.append(votes[0] > votes[1])
    return {(True, True): 0, (False, True): 1, (False, False): 2, (True, False): 3}[
        (forward[0], forward[1])
    ]


def turn_back(
    window: Array, grid: Grid, quarters: int, corner: NDArray[np.intp]
) -> tuple[Array, Grid]:
    """II-B.6: quasi-probabilities as they were printed, and the grid along the print's axes.

    ``corner`` is the place of the window's upper left dot in ``grid``; the new grid has its
    origin at the dot that was printed at the upper left.
    """
    last = WINDOW - 1
    first = corner + np.array([[0, 0], [0, last], [last, last], [last, 0]])[quarters]
    u, v = grid.u, grid.v
    for _ in range(quarters):
        # What was printed to the right is seen upwards, what was printed down to the right.
        u, v = -v, u
        columns, rows = window
        window = np.stack([np.rot90(rows, -1), -np.rot90(columns, -1)])
    return window, Grid(grid.points(first), u, v)


def correlate(lines: Array, weights: Array) -> tuple[NDArray[np.int64], int]:
    """II-B.7: place (8,) in the main sequence of each line of soft bits, and bits corrected.

    The bits are -1 or 1 times ``weights``, ``|P(x) P(y)|``. The first of equal correlations
    counts.
    """
    phases = np.argmax((np.sign(lines) * weights) @ _SHIFTED.T, axis=1)
    return phases, int((lines * _SHIFTED[phases] < 0).sum())


def find_place(phases: NDArray[np.int64], codec: Codec) -> int | None:
    """II-A: x from the phases (8,) of adjoining columns, or y from those of rows.

    Six lines would do. Of eight, each of the three strings of five digits says where its
    sequence stands at the first line, and most of them decide.
    """
    shift = np.diff(phases) % MAIN_SEQUENCE_LENGTH
    possible = np.isin(shift, SHIFTS)
    residues = []
    for digits, base, table, sequence in zip(
        digits_of(shift), sequences.BASES, strings(codec), codec.digits, strict=True
    ):
        votes = np.zeros(len(sequence), np.int64)
        for k in range(len(shift) - STRING + 1):
            if possible[k : k + STRING].all():
                code = digits[k : k + STRING] @ base ** np.arange(STRING)[::-1]
                places = table[code][table[code] >= 0]
                votes[(places - k) % len(sequence)] += 1
        if not votes.any() or (votes == votes.max()).sum() > 1:
            return None
        residues.append(int(votes.argmax()))
    place = int(codec.place(residues))
    return place if place + len(phases) <= SECTION_LENGTH else None
