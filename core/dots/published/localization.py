"""The published algorithm, frame by frame and without memory, for comparison.

Hostettler, Özgür, Lemaignan, Dillenbourg and Mondada, "Real-Time High-Accuracy 2D Localization
with Structured Patterns", IEEE ICRA 2016, section II-B. The first half, from a frame to a grid and
soft bits, is in :mod:`~locatk.core.dots.published.grid`, which also names the one correction of
the text; here is the second half, from soft bits to a pose.

As in the paper no step tests whether a result is likely: the digits of the best correlations are
looked up, and only strings that no sequence contains are rejected.
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
from locatk.core.dots.codec.lookup import (
    DIGITS_PER_STRING,
    POSSIBLE_SHIFTS,
    digit_strings,
    digits_of,
)
from locatk.core.dots.published.grid import AffineGrid, detect_blobs, fit_grid, soft_bits
from locatk.core.errors import InputError

Array = NDArray[np.float64]

WINDOW_DOTS = 8
"""Columns and rows of the window that is decoded (II-B.5)."""

MIN_DOTS = 9
"""Fewer dots have no intact neighbourhood of 3 x 3."""

MAX_GRID_POSITIONS = 1_000_000
"""Largest area of a grid in positions; the blobs of a larger one are no pattern."""

_MAIN_SEQUENCE_STRINGS = (
    MAIN_SEQUENCE[
        np.add.outer(np.arange(MAIN_SEQUENCE_LENGTH), np.arange(WINDOW_DOTS)) % MAIN_SEQUENCE_LENGTH
    ]
    * 2.0
    - 1.0
)
"""(63, 8) strings of the main sequence from each phase on, as -1 and 1."""


@dataclass(frozen=True)
class PublishedPose:
    """Result of the published algorithm for one frame.

    Attributes
    ----------
    x, y : float
        Grid coordinates of the camera's centre, with fractions; nan if rejected.
    heading_rad : float
        From the sheet's x to the image's right, counter-clockwise; -pi..pi.
    section : (u, v)
        Each 0..62, by the majority of columns and rows; -1 if rejected.
    dots : int
        Number of blobs.
    corrected_bits : int
        Bits, of the 128 in the window, that differ from the best correlations.
    quality : float
        Mean of ``|P(x) P(y)|`` over the window, 0..1: closeness of the dots to the nominal
        offsets. It is no probability.
    rejected : str or None
        ``no_dots``: fewer than nine blobs. ``no_grid``: no two directions, or no intact 3 x 3
        neighbourhood. ``no_window``: fewer than 8 x 8 positions, or over a million.
        ``no_orientation``: equal votes of rows or columns for both directions. ``no_code``: their
        strings are in no sequence, or disagree, or name a position beyond the section.
    """

    x: float = float("nan")
    y: float = float("nan")
    heading_rad: float = float("nan")
    section: tuple[int, int] = (-1, -1)
    dots: int = 0
    corrected_bits: int = 0
    quality: float = 0.0
    rejected: str | None = None


def localize_published(
    image: NDArray[np.uint8], codec: Codec, camera: Camera | None = None
) -> PublishedPose:
    """Estimate the pose of one frame by the published algorithm.

    Parameters
    ----------
    image : (height, width) uint8 ndarray
        Dots dark.
    codec : Codec
    camera : Camera, optional
        Centre of the device in the frame, and radial distortion of the lens. Default: the middle
        of the frame, and no distortion.

    Returns
    -------
    PublishedPose

    Raises
    ------
    InputError
        The image is not grey with 8 bits, or has another size than the camera's.
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
    points = detect_blobs(image, camera)
    dots = len(points)
    if dots < MIN_DOTS:
        return PublishedPose(dots=dots, rejected="no_dots")
    fitted = fit_grid(points, centre)
    if fitted is None:
        return PublishedPose(dots=dots, rejected="no_grid")
    grid, nodes, offsets = fitted
    size = np.ptp(nodes, axis=0) + 1
    if size.min() < WINDOW_DOTS or size.prod(dtype=float) > MAX_GRID_POSITIONS:
        return PublishedPose(dots=dots, rejected="no_window")
    bits = soft_bits(nodes, offsets)
    corner = best_window(np.abs(bits.prod(axis=0)))
    window = bits[:, corner[1] : corner[1] + WINDOW_DOTS, corner[0] : corner[0] + WINDOW_DOTS]
    rotation = vote_orientation(window)
    if rotation is None:
        return PublishedPose(dots=dots, rejected="no_orientation")
    printed, grid = rotate_to_print(window, grid, rotation, corner + nodes.min(axis=0))
    weights = np.abs(printed.prod(axis=0))
    x_phases, x_corrected = correlate(printed[0].T, weights.T)
    y_phases, y_corrected = correlate(printed[1], weights)
    x, y = look_up_position(x_phases, codec), look_up_position(y_phases, codec)
    if x is None or y is None:
        return PublishedPose(dots=dots, rejected="no_code")
    position = np.array([x, y]) + grid.coordinates(centre)  # Eq. 10 to 12.
    steps = np.arange(WINDOW_DOTS)
    u = (x_phases - y - codec.phases(x + steps)) % MAIN_SEQUENCE_LENGTH
    v = (y_phases - x - codec.phases(y + steps)) % MAIN_SEQUENCE_LENGTH
    return PublishedPose(
        x=float(position[0]),
        y=float(position[1]),
        heading_rad=float(np.arctan2(grid.u[1], grid.u[0])),
        section=(int(np.bincount(u).argmax()), int(np.bincount(v).argmax())),
        dots=dots,
        corrected_bits=x_corrected + y_corrected,
        quality=float(weights.mean()),
    )


def best_window(likelihood: Array) -> NDArray[np.intp]:
    """Return column and row of the corner of the 8 x 8 positions with the largest sum (II-B.5)."""
    total = np.pad(likelihood, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    row_sums = total[WINDOW_DOTS:] - total[:-WINDOW_DOTS]
    sums = row_sums[:, WINDOW_DOTS:] - row_sums[:, :-WINDOW_DOTS]
    row, column = np.unravel_index(np.argmax(sums), sums.shape)
    return np.array([column, row])


def vote_orientation(window: Array) -> int | None:
    """Return the counter-clockwise quarter turns 0..3 of the print in the image (II-B.6).

    Each column of column bits and each row of row bits is searched in the main sequence, as it is
    and reversed with its bits inverted, which it is if its axis points backwards. Lines with a
    missing dot do not vote. Returns None if an axis has no majority.
    """
    is_forward = []
    for lines in (window[0].T, window[1]):
        complete = np.sign(lines[(lines != 0).all(axis=1)])
        forward, backward = (
            int((candidates[:, None] == _MAIN_SEQUENCE_STRINGS).all(axis=2).sum())
            for candidates in (complete, -complete[:, ::-1])
        )
        if forward == backward:
            return None
        is_forward.append(forward > backward)
    return {(True, True): 0, (False, True): 1, (False, False): 2, (True, False): 3}[
        (is_forward[0], is_forward[1])
    ]


def rotate_to_print(
    window: Array, grid: AffineGrid, rotation: int, corner: NDArray[np.intp]
) -> tuple[Array, AffineGrid]:
    """Rotate a window and its grid back by ``rotation`` quarter turns (II-B.6).

    ``corner`` is the node of the window's upper left dot in ``grid``. The returned grid has its
    origin at the dot that was printed at the upper left.
    """
    last = WINDOW_DOTS - 1
    printed_corner = corner + np.array([[0, 0], [0, last], [last, last], [last, 0]])[rotation]
    u, v = grid.u, grid.v
    for _ in range(rotation):
        # The printed right is the image's up, and the printed down is its right.
        u, v = -v, u
        columns, rows = window
        window = np.stack([np.rot90(rows, -1), -np.rot90(columns, -1)])
    return window, AffineGrid(grid.points(printed_corner), u, v)


def correlate(lines: Array, weights: Array) -> tuple[NDArray[np.int64], int]:
    """Return the phase (8,) of each line of soft bits, and the number of corrected bits (II-B.7).

    The bits are -1 or 1 times ``weights``, ``|P(x) P(y)|``. Of equal correlations the first
    counts.
    """
    phases = np.argmax((np.sign(lines) * weights) @ _MAIN_SEQUENCE_STRINGS.T, axis=1)
    return phases, int((lines * _MAIN_SEQUENCE_STRINGS[phases] < 0).sum())


def look_up_position(phases: NDArray[np.int64], codec: Codec) -> int | None:
    """Return x from the phases (8,) of adjacent columns, or y from those of rows (II-A).

    Six lines would be sufficient. Eight have three strings of five digits, each of which gives the
    residue of the first line; the majority counts. Returns None if there is no majority or the
    window leaves the section.
    """
    shift = np.diff(phases) % MAIN_SEQUENCE_LENGTH
    is_possible = np.isin(shift, POSSIBLE_SHIFTS)
    residues = []
    for digits, base, table, sequence in zip(
        digits_of(shift), sequences.DIGIT_BASES, digit_strings(codec), codec.digits, strict=True
    ):
        votes = np.zeros(len(sequence), np.int64)
        for k in range(len(shift) - DIGITS_PER_STRING + 1):
            if is_possible[k : k + DIGITS_PER_STRING].all():
                code = (
                    digits[k : k + DIGITS_PER_STRING] @ base ** np.arange(DIGITS_PER_STRING)[::-1]
                )
                candidates = table[code][table[code] >= 0]
                votes[(candidates - k) % len(sequence)] += 1
        if not votes.any() or (votes == votes.max()).sum() > 1:
            return None
        residues.append(int(votes.argmax()))
    position = int(codec.position(residues))
    return position if position + len(phases) <= SECTION_LENGTH else None
