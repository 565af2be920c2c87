"""Tables of what a system saw, as text: the same words on a terminal and in a report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.polaris.results import TagDetection

DEGREES = math.degrees(1)

POSE = ("x [mm]", "y [mm]", "heading [deg]")
SIGMAS = ("sigma x [mm]", "sigma y [mm]", "sigma heading [deg]")


@dataclass(frozen=True)
class Seen:
    """A table; ``more`` is how many rows were left out."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    more: int = 0


def tags(
    detections: Sequence[TagDetection], most: int | None = None, *, compact: bool = False
) -> Seen:
    """Tags as arrays saw them, in the array's frame.

    Parameters
    ----------
    detections : sequence of TagDetection
    most : int, optional
        Rows; all by default.
    compact : bool
        Standard deviations stand behind the values, not in columns of their own.
    """
    shown = detections[:most]
    arrays = len({found.device for found in detections}) > 1
    refused = any(found.refused for found in shown)
    header = (
        *(["array"] if arrays else []),
        "tag",
        "margin [steps]",
        "magnets",
        *POSE,
        *(() if compact else SIGMAS),
        *(["refused"] if refused else []),
    )
    rows = [
        (
            *([found.device] if arrays else []),
            "-" if found.tag_id is None else str(found.tag_id),
            number(found.margin, 1, ".2f"),
            str(len(found.magnets)),
            *_pose(found, compact),
            *([words(found.refused)] if refused else []),
        )
        for found in shown
    ]
    return Seen(header, rows, len(detections) - len(shown))


def landmarks(
    detections: Sequence[LandmarkDetection], most: int | None = None, *, compact: bool = False
) -> Seen:
    """Landmarks, and the robot in the frame of each; parameters as of :func:`tags`."""
    shown = detections[:most]
    robots = len({found.device for found in detections}) > 1
    refused = any(found.refused for found in shown)
    header = (
        "time (UTC)",
        *(["robot"] if robots else []),
        "cell",
        "pattern",
        "sure [%]",
        *POSE,
        *(() if compact else SIGMAS),
        *(["refused"] if refused else []),
    )
    rows = [
        (
            clock(found.time_s),
            *([found.device] if robots else []),
            cell(found.cell) or "-",
            found.pattern or "-",
            sure(found.probability),
            *_pose(found, compact),
            *([words(found.refused)] if refused else []),
        )
        for found in shown
    ]
    return Seen(header, rows, len(detections) - len(shown))


def _pose(found: TagDetection | LandmarkDetection, compact: bool) -> tuple[str, ...]:
    scales = {"x_m": 1e3, "y_m": 1e3, "heading_rad": DEGREES}
    values = [number(getattr(found, key), scale, ".2f") for key, scale in scales.items()]
    sigmas = [number(getattr(found, f"sigma_{key}"), scale, ".2g") for key, scale in scales.items()]
    if not compact:
        return (*values, *sigmas)
    return tuple(
        value if "-" in (value, sigma) else f"{value} \u00b1 {sigma}"
        for value, sigma in zip(values, sigmas, strict=True)
    )


def words(reason: str | None) -> str:
    """A reason of refusal as people read it."""
    return (reason or "").replace("_", " ")


def cell(found: Sequence[int] | None) -> str:
    """Row and column of a landmark, "" where they are not known."""
    return "" if found is None else ",".join(map(str, found))


def sure(probability: float | None) -> str:
    """In percent; what is not wholly sure is not rounded to 100."""
    if probability is None or not math.isfinite(probability):
        return "-"
    percent = 100 * probability
    return f"{percent:.1f}" if percent < 99.95 else "100" if percent >= 99.9995 else ">99.9"


def clock(time_s: float) -> str:
    """Time of day, to the millisecond."""
    try:
        return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S.%f")[:-3]
    except (OverflowError, ValueError, OSError):
        return f"{time_s:g} s"


def number(value: float | None, scale: float, form: str) -> str:
    """``value`` times ``scale`` in a format, "-" where it is not known."""
    if value is None or not math.isfinite(value):
        return "-"
    return format(value * scale, form)
