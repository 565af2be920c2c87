"""Why solvers leave something out, in plain words: a sentence for each reason that core gives.

The reasons are those of docs/lighthouse.md, docs/dots.md, docs/polaris.md and
docs/landmarks.md; a test collects them from core. Numbers are those of the solvers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Reason:
    """What a reason means, and in what it is counted: ``"sweeps"``, ``"frames"``, ..."""

    unit: str
    sentence: str


def meaning(system: str, reason: str) -> Reason | None:
    """What ``reason`` means; None where nobody here knows (a system of others)."""
    known = SYSTEMS.get(system)
    return None if known is None else known().get(reason)


def _lighthouse() -> dict[str, Reason]:
    from locatk.core.lighthouse import epochs, noise
    from locatk.core.lighthouse.localization import photodiodes as poses

    sweeps = {
        "unknown_channel": "The channel is none of 1 to 16.",
        "count_above_period": "The count is longer than a rotation of that station.",
        "plane_unknown": "A single sweep of which nobody says whether it is of the first or the "
        "second plane.",
        "repeated_in_rotation": "The same plane was reported twice in one rotation.",
        "spike": f"For one moment the angle left a smooth run by more than "
        f"{math.degrees(epochs.SPIKE_RAD):g} degrees.",
        "station_not_in_scene": "The station is not in the scene that was given.",
        "station_not_solved": "The station shares too few places with the others to be located.",
        "other_station": "The method uses fewer stations, and this is none of them.",
        "sensor_unknown": "The device has no photodiode of that number, or nobody told where it "
        "sits.",
        "sweep_contradicts_pose": "The sweep disagrees with the pose that the other photodiodes of "
        "its device agree on (a reflection, an edge in the way).",
    }
    moments = {
        "station_contradicts_others": "One of three or more stations disagreed with the others "
        "(a reflection) and was left out; the moment has a pose all the same.",
        "moment_with_too_few_sweeps": "The sweeps of the moment do not determine a position.",
        "pose_not_determined": "The photodiodes that were lit do not determine a full pose.",
        "moment_inconsistent": f"The planes of the moment miss their meeting point by more than "
        f"{noise.INLIER_GATE_SIGMAS:g} times the noise of the recording (at most "
        f"{1e3 * noise.INLIER_GATE_RAD:g} mrad).",
        "moment_out_of_reach": f"The position would be farther than {poses.MAX_RANGE_M:g} m from "
        "every station, where none is received.",
        "moment_jumps": "No second measurement checks the position, and it leaves the path of its "
        "device.",
    }
    return _of("sweeps", sweeps) | _of("moments", moments)


def _dots() -> dict[str, Reason]:
    from locatk.core.dots import solver
    from locatk.core.dots.detection import lattice as grid
    from locatk.core.dots.identification import decoding as decode
    from locatk.core.dots.published import localization as paper

    return _of(
        "frames",
        {
            "unreadable_frame": "The image is damaged or cut short.",
            "not_of_the_cameras_size": "The frame has another size than the camera's calibration.",
            "off_sheet": f"A place was decoded, but no sheet of the manifest reaches within "
            f"{solver.SHEET_SLACK_PITCHES:g} pitches of it.",
            "too_few_dots": f"Fewer than {grid.MIN_LATTICE_DOTS} dots were found: no pattern in "
            "sight, out of focus, or blurred.",
            "no_grid": "Dots were found, but no regular grid among them.",
            "no_code": "A grid was found, but no place of this code: too many dots are missing or "
            "false, or the sheet was printed with another code.",
            "low_confidence": f"The likeliest place is less than {100 * decode.MIN_CONFIDENCE:g} % "
            "sure.",
            "section_border": "The frame lies across the border of two sections of the pattern.",
            "no_dots": f"Fewer than {paper.MIN_DOTS} blobs were taken for dots (published method).",
            "no_window": f"No window of {paper.WINDOW_DOTS} x {paper.WINDOW_DOTS} dots is in the "
            "frame (published method).",
            "no_orientation": "Rows and columns vote alike for both directions (published method).",
        },
    )


def _polaris() -> dict[str, Reason]:
    from locatk.core.polaris.identification import decoding

    return _of(
        "passes",
        {
            "no_magnets": "The field changed, but no magnet explains it.",
            "no_tag_given": "Nobody said how the tags are designed (tag.toml): magnets were found, "
            "nothing was read.",
            "partial": "The tag reaches beyond the bar, or the recording begins or ends on it.",
            "magnets_missing": "The magnets found are too few for a tag, or lie where no tag has "
            "them.",
            "too_many_magnets": "More magnets were found on the grid than a tag has.",
            "not_in_family": "It is farther from all tags of the family than may be corrected.",
            "beyond_code": "It has more errors than the redundant code is made for.",
            "tie": f"Two ids are as near, to within {decoding.MAX_TIE_STEPS:g} steps of "
            f"orientation or {decoding.MAX_TIE_SIGMAS:g} standard deviations.",
            "ambiguous": "The magnets can be read as different ids, or one id seems to lie in two "
            "places.",
            "misfit": "The magnets miss their cells, or the scale of the way is far off: tags of "
            "another spacing.",
            "residual": "The magnets leave much more of the samples than noise, or the margin is "
            "small for what they leave: debris, another way than was given, a drifting sensor.",
            "outside_grid": "A magnet lies outside of the tag's grid.",
            "cell_twice": "Two magnets lie in one cell.",
            "corner_occupied": "A magnet lies on the corner that tells the tag's orientation, "
            "which is empty on every tag.",
            "vertex_missing": "A magnet is missing on one of the three corners that every tag has.",
            "no_such_placement": "No tag of this code has magnets in these cells.",
        },
    )


def _landmarks() -> dict[str, Reason]:
    from locatk.core.landmarks.detection import hypotheses
    from locatk.core.landmarks.localization import cell_filter

    return _of(
        "visits",
        {
            "not_localised": "The landmark was read, but the likeliest place on the map has a "
            f"probability below {cell_filter.MIN_CELL_PROBABILITY:g}.",
            "misread": "The place is known, and the map has another landmark there: it is laid "
            "wrongly or was misread. It is used all the same, as it was read.",
            "off_map": "By odometry the landmark lies where the map has none.",
            "not_explained": f"Every landmark leaves {hypotheses.MAX_RESIDUAL_SIGMAS:g} standard "
            "deviations and more: iron, a tool, broken bars, or other bars than the map's.",
            "too_weak": "A field was felt, but it is too weak for a place.",
            "too_short": f"There are samples in fewer than {hypotheses.MIN_BINS} places of the "
            "visit.",
            "no_spin": "The robot only passed the landmark, and the published method needs it to "
            "turn on the spot.",
            "no_pattern": "The valleys seen during the spin are those of no pattern (published "
            "method).",
            "unexplained": "The bars that were read explain less than half of the field during the "
            "spin (published method).",
        },
    )


def _of(unit: str, sentences: dict[str, str]) -> dict[str, Reason]:
    return {reason: Reason(unit, sentence) for reason, sentence in sentences.items()}


SYSTEMS: dict[str, Callable[[], dict[str, Reason]]] = {
    "lighthouse": _lighthouse,
    "dots": _dots,
    "polaris": _polaris,
    "landmarks": _landmarks,
}
