"""Rejected observations: a sentence for each reason code of the solvers, and the panel of counts.

The codes are documented in docs/lighthouse.md, docs/dots.md, docs/polaris.md and docs/landmarks.md;
a test collects them from core. The numbers in the sentences are the constants of the solvers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from plotly.graph_objects import Figure

from locatk.core.lighthouse import epochs, noise
from locatk.core.lighthouse.localization import photodiodes
from locatk.core.polaris.identification import decoding as tag_decoding
from locatk.core.solution import Solution
from locatk.formats.plots.shapes import COLORS
from locatk.formats.plots.units import format_count
from locatk.formats.report.panels import Panel, Table, escape, reason_text

TITLE = "Rejected observations"

UNIT_COLORS = (COLORS[1], COLORS[5], COLORS[3])
"""Colors of the bars of reasons, one for each unit in which they are counted."""

BAR_HEIGHT_PX = 46
"""Height of the bar of a reason with its name."""


@dataclass(frozen=True)
class Reason:
    """Explanation of a reason code.

    Attributes
    ----------
    unit : {"sweeps", "moments", "frames", "passes", "visits", "observations"}
        Kind of the rejected observations.
    sentence : str
        Empty if the reason is unknown.
    """

    unit: str
    sentence: str


UNKNOWN_REASON = Reason("observations", "")


def explain(system: str, code: str) -> Reason:
    """Return the explanation of a reason code, :data:`UNKNOWN_REASON` for other systems."""
    reasons = REASONS.get(system)
    return UNKNOWN_REASON if reasons is None else reasons().get(code, UNKNOWN_REASON)


def rejection_panel(solution: Solution) -> Panel:
    """Return how many observations were rejected for which reason."""
    counts = {code: count for code, count in solution.rejected.items() if count}
    if not counts:
        return Panel(TITLE, "Nothing was rejected.")
    reasons = {code: explain(solution.system, code) for code in counts}
    order = sorted(counts, key=lambda code: (reasons[code].unit, -counts[code]))
    rejected = Counter[str]()
    for code in order:
        rejected[reasons[code].unit] += counts[code]
    totals = _count_observations(solution, rejected)
    rows = []
    for code in order:
        reason, count = reasons[code], counts[code]
        total = totals.get(reason.unit, 0)
        fraction = (
            f"{100 * count / total:.3g} % of {format_count(total, reason.unit)}" if total else "-"
        )
        rows.append((reason_text(code), str(count), fraction, reason.sentence))
    summary = [
        f"{format_count(count)} of {format_count(totals[unit], unit)}"
        if unit in totals
        else format_count(count, unit)
        for unit, count in rejected.items()
    ]
    table = Table(("reason", "count", "fraction", "meaning"), rows)
    figure = _draw_counts(order, counts, reasons) if len(order) > 1 else None
    return Panel(TITLE, f"Rejected: {', '.join(summary)}.", figure, table)


def _count_observations(solution: Solution, rejected: Counter[str]) -> dict[str, int]:
    """Return the number of all observations by unit, given that of rejected ones."""
    detections = solution.detections
    if solution.system == "lighthouse":
        # A moment from which one station was left out has a pose nevertheless.
        solved = solution.rejected.get("station_contradicts_others", 0)
        return {
            "sweeps": rejected["sweeps"] + sum(each.sweeps + each.rejected for each in detections),
            "moments": rejected["moments"] - solved + solution.poses,
        }
    return {
        "polaris": {
            "passes": len(detections)
            + sum(solution.rejected.get(code, 0) for code in ("no_magnets", "no_pass"))
        },
        "landmarks": {"visits": len(detections)},
        "dots": {"frames": rejected["frames"] + len(detections)},
    }.get(solution.system, {})


def _draw_counts(
    order: Sequence[str], counts: Mapping[str, int], reasons: Mapping[str, Reason]
) -> Figure:
    """Draw a bar for each reason, with its name above it so that it fits into narrow windows."""
    figure = Figure()
    row = {code: k for k, code in enumerate(order)}
    units = list(dict.fromkeys(reasons[code].unit for code in order))
    for k, unit in enumerate(units):
        codes = [code for code in order if reasons[code].unit == unit]
        figure.add_bar(
            x=[counts[code] for code in codes],
            y=[row[code] for code in codes],
            orientation="h",
            name=unit,
            marker_color=UNIT_COLORS[k % len(UNIT_COLORS)],
            width=0.4,
            text=[format_count(counts[code]) for code in codes],
            textposition="outside",
            cliponaxis=False,
            customdata=[escape(reason_text(code)) for code in codes],
            hovertemplate=f"%{{customdata}}: %{{x}} {unit}<extra></extra>",
        )
    for code in order:
        figure.add_annotation(
            x=0,
            y=row[code],
            text=escape(reason_text(code)),
            showarrow=False,
            xanchor="left",
            yanchor="bottom",
            yshift=0.2 * BAR_HEIGHT_PX,
            xshift=-3,
        )
    # The axis leaves space for the number at the end of the longest bar.
    figure.update_xaxes(visible=False, range=[0, 1.12 * max(counts.values())])
    figure.update_yaxes(visible=False, range=[len(order) - 0.5, -0.9])
    figure.update_layout(
        height=BAR_HEIGHT_PX * len(order) + (44 if len(units) > 1 else 20),
        margin={"l": 6, "r": 12, "t": 12, "b": 8},
        showlegend=len(units) > 1,
    )
    return figure


# ---- sentences


def _reasons(unit: str, sentences: Mapping[str, str]) -> dict[str, Reason]:
    return {code: Reason(unit, sentence) for code, sentence in sentences.items()}


def _lighthouse_reasons() -> dict[str, Reason]:
    sweeps = {
        "unknown_channel": "The channel is not one of 1 to 16.",
        "count_above_period": "The count exceeds a rotation of the station.",
        "plane_unknown": "A lone sweep that cannot be assigned to a plane.",
        "repeated_in_rotation": "The same plane was reported twice in one rotation.",
        "spike": "A single angle deviates from a smooth sequence by more than "
        f"{math.degrees(epochs.SPIKE_RAD):g} degrees.",
        "sweep_of_doubled_channel": "More than one station sends on the channel.",
        "station_not_in_scene": "The station is not in the given scene.",
        "station_not_solved": "The station has too few positions in common with the others to be "
        "located.",
        "other_station": "The method uses fewer stations, and this is not one of them.",
        "sensor_unknown": "The device has no photodiode with this number, or its position is "
        "unknown.",
        "sweep_contradicts_pose": "The sweep disagrees with the pose from the other photodiodes of "
        "its device (a reflection or an occluding edge).",
    }
    moments = {
        "station_contradicts_others": "One of three or more stations disagreed with the others "
        "(a reflection) and was left out; the moment has a pose nevertheless.",
        "moment_with_too_few_sweeps": "The sweeps of the moment do not determine a position.",
        "pose_not_determined": "The illuminated photodiodes do not determine a full pose.",
        "moment_inconsistent": "The light planes of the moment miss their common point by more "
        f"than {noise.INLIER_GATE_SIGMAS:g} times the noise of the recording (at most "
        f"{1e3 * noise.INLIER_GATE_RAD:g} mrad).",
        "moment_out_of_reach": f"The position is more than {photodiodes.MAX_RANGE_M:g} m from "
        "every station, which is beyond their range.",
        "moment_jumps": "No second measurement confirms the position, and it deviates from the "
        "trajectory of its device.",
    }
    return _reasons("sweeps", sweeps) | _reasons("moments", moments)


def _dots_reasons() -> dict[str, Reason]:
    # OpenCV and scipy, which these modules need, take 0.1 s and 0.5 s to import.
    from locatk.core.dots.detection import lattice
    from locatk.core.dots.identification import decoding
    from locatk.core.dots.localization import recordings
    from locatk.core.dots.published import localization as published

    frames = {
        "unreadable_frame": "The image is damaged or truncated.",
        "not_of_the_cameras_size": "The size of the frame differs from the camera calibration.",
        "off_sheet": "A position was decoded, but no sheet of the manifest is within "
        f"{recordings.SHEET_SLACK_PITCHES:g} pitches of it.",
        "mirrored": "The frame is mirrored: the pattern is decoded if it is mirrored back. Its "
        "heading would be wrong.",
        "inverted": "The frame is inverted, with light dots on dark paper.",
        "mirrored_and_inverted": "The frame is mirrored and inverted.",
        "too_few_dots": f"Fewer than {lattice.MIN_LATTICE_DOTS} dots were detected: no pattern in "
        "view, out of focus, or motion blur.",
        "no_grid": "Dots were detected, but no regular grid among them.",
        "no_code": "A grid was detected, but no position of this code: too many dots are missing "
        "or false, or the sheet was printed with another code.",
        "low_confidence": "The probability of the likeliest position is less than "
        f"{100 * decoding.MIN_CONFIDENCE:g} %.",
        "section_border": "The frame contains the border of two sections of the pattern.",
        "no_dots": f"Fewer than {published.MIN_DOTS} blobs were accepted as dots (published "
        "method).",
        "no_window": f"The frame contains no window of {published.WINDOW_DOTS} x "
        f"{published.WINDOW_DOTS} dots (published method).",
        "no_orientation": "Rows and columns vote equally for both directions (published method).",
    }
    return _reasons("frames", frames)


def _polaris_reasons() -> dict[str, Reason]:
    passes = {
        "no_magnets": "The field changed, but no magnets explain that, or not within the effort "
        "for a pass: several large tags in one pass, or much debris.",
        "no_pass": "The field changed while the array rested, or far less than by a tag.",
        "pass_too_long": "The field changed for longer than a pass over a tag (live only).",
        "no_tag_given": "The design of the tags (tag.toml) is not known: magnets were detected, "
        "but not identified.",
        "partial": "The tag extends beyond the bar, or the recording begins or ends over it.",
        "magnets_missing": "There are too few magnets for a tag, or at positions where no tag has "
        "magnets.",
        "too_many_magnets": "There are more magnets on the grid than a tag has.",
        "other_design": "The tag is one of another design: further magnets of the same strength "
        "continue its grid, or its spacing, height or magnets differ from the design. Without a "
        "family or positions on the site, a tag edge to edge with another one looks the same.",
        "not_in_family": "The distance to all tags of the family exceeds what may be corrected.",
        "beyond_code": "There are more errors than the redundant code can correct.",
        "tie": "Two ids are equally near, to within "
        f"{tag_decoding.MAX_TIE_STEPS:g} steps of orientation or "
        f"{tag_decoding.MAX_TIE_SIGMAS:g} standard deviations.",
        "ambiguous": "The magnets can be read as different ids, or as one id at two positions.",
        "misfit": "The magnets miss their cells, or the scale of the trajectory is wrong: tags of "
        "another spacing.",
        "residual": "The residuals of the fit are much larger than the noise, or the margin is "
        "small in relation to them: debris, an erroneous trajectory, a drifting sensor.",
        "outside_grid": "A magnet is outside of the grid of the tag.",
        "cell_twice": "Two magnets are in one cell.",
        "corner_occupied": "A magnet is in the corner that indicates the orientation of a tag and "
        "is empty on every tag.",
        "vertex_missing": "A magnet is missing in one of the three corners that every tag has.",
        "no_such_placement": "No tag of this code has magnets in these cells.",
    }
    return _reasons("passes", passes)


def _landmarks_reasons() -> dict[str, Reason]:
    # scipy, which these modules need, takes 0.5 s to import.
    from locatk.core.landmarks.detection import hypotheses
    from locatk.core.landmarks.localization import cell_filter

    visits = {
        "not_localised": "The landmark was identified, but the likeliest position on the map has a "
        f"probability below {cell_filter.MIN_CELL_PROBABILITY:g}.",
        "misread": "The position is known, and the map has another landmark there: it was built "
        "incorrectly or misread. It is used as it was read.",
        "uncertain": "The position is known, and the map has another landmark there than the one "
        "that was read, with too little evidence to call it misread: the robot grazed it.",
        "inconsistent": "Position and code contradict the odometry and the visits before and "
        "after: the visit is not used.",
        "no_pose": "The position is known, and fields and odometry contradict each other in this "
        "part of the drive, so that it has no poses.",
        "off_map": "By odometry the landmark is at a position where the map has none.",
        "not_explained": "The residuals of every landmark are "
        f"{hypotheses.MAX_RESIDUAL_SIGMAS:g} standard deviations or more: iron, a tool, broken "
        "bars, or other bars than those of the map.",
        "too_weak": "A field was detected, but it is too weak to determine a pose.",
        "too_short": f"There are samples at fewer than {hypotheses.MIN_BINS} positions of the "
        "visit.",
        "no_spin": "The robot only passed the landmark, and the published method requires it to "
        "spin on the spot.",
        "no_pattern": "The valleys of the field during the spin match no pattern (published "
        "method).",
        "unexplained": "The identified bars explain less than half of the field during the spin "
        "(published method).",
    }
    return _reasons("visits", visits)


REASONS: dict[str, Callable[[], dict[str, Reason]]] = {
    "lighthouse": _lighthouse_reasons,
    "dots": _dots_reasons,
    "polaris": _polaris_reasons,
    "landmarks": _landmarks_reasons,
}
"""Explanations by system and reason code."""
