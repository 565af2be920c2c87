"""Quality of a solution: a summary, key figures, and panels of errors and covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locatk.core.evaluation import CHI2_95_QUANTILES, Evaluation, Statistics
from locatk.core.evaluation.consistency import NORMAL_95_QUANTILE
from locatk.core.solution import Solution
from locatk.formats.plots.ground import is_shown_unscaled, is_unscaled, with_finite_positions
from locatk.formats.plots.series import (
    Series,
    axis_limit,
    error_quantile_95,
    origin_ns,
    position_sigmas,
    scored_covariance,
    split_by_device,
)
from locatk.formats.plots.shapes import MAX_LEGEND_DEVICES, device_colors
from locatk.formats.plots.units import (
    DEGREES,
    Unit,
    abbreviate,
    format_count,
    format_length,
    format_number,
    last_bin_note,
    select_unit,
)
from locatk.formats.report.detections import format_probability
from locatk.formats.report.diagram_grid import DiagramGrid
from locatk.formats.report.panels import Panel, Table, escape, join_names, join_sentences
from locatk.formats.report.style import faded
from locatk.formats.report.subject import Subject
from locatk.formats.report.theme import ALL_DEVICES, CARD, INK, UNSOLVED_DEVICE
from locatk.formats.report.value_diagrams import ValueRow, value_panel

HISTOGRAM_BINS = 50
"""Number of bins of the histogram of errors, on an axis of about 900 pixels."""

MIN_HEIGHT_ERROR_M = 1e-9
"""Largest error in z up to which estimate and truth are in one plane, and z is not drawn."""

STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "p95")

ERRORS = (
    ("ape_translation", "APE translation"),
    ("ape_rotation", "APE rotation"),
    ("rpe_translation", "RPE translation"),
    ("rpe_rotation", "RPE rotation"),
)
"""Fields of an evaluation and their titles."""


# ---- the summary


def summarize(subject: Subject) -> str:
    """Return one or two sentences on the quality of the solution."""
    solution, evaluation = subject.solution, subject.evaluation
    if not solution.poses:
        return "Nothing was solved: there is no pose."
    unscaled = is_shown_unscaled(solution, evaluation)
    if evaluation is None:
        sigma = _all_sigmas(solution)
        covariance = "The solver reports no covariance."
        if len(sigma):
            median = format_length(float(np.median(sigma)), unscaled=unscaled)
            covariance = (
                f"The solver reports a standard deviation of {median} (median over all poses, all "
                "axes together)."
            )
        reason = why_not_evaluated(subject)
        return join_sentences(reason, covariance, *_trust_notes(solution))
    median, p95 = (
        format_length(value, unscaled=unscaled) for value in (evaluation.median, evaluation.p95)
    )
    alignment = (
        "No alignment was fitted."
        if evaluation.align == "none"
        else f"The alignment {evaluation.align} was fitted to the truth at these same poses."
    )
    offset = consistency = ""
    if evaluation.offset_s:
        origin = evaluation.time_offset.describe()
        offset = f"Time offset: {evaluation.offset_s:.4f} s ({origin})."
    if evaluation.consistency is not None:
        description = evaluation.consistency.describe()
        consistency = f"{description[0].upper()}{description[1:]}."
    return join_sentences(
        f"Half of the poses are within {median} of the truth, 95 % within {p95}.",
        alignment,
        offset,
        consistency,
        *_trust_notes(solution),
    )


def _trust_notes(solution: Solution) -> list[str]:
    """Return sentences on provisional poses and on poses that are not finite."""
    notes = [
        f"The poses of {t.device} are provisional: the least certain one is right with a "
        f"probability of {format_probability(t.min_probability)} %."
        for t in solution.trajectories
        if t.is_provisional
    ]
    return [*notes, _invalid_poses_note(solution)]


def _invalid_poses_note(solution: Solution) -> str:
    """Return a sentence on poses that are not finite, empty without any."""
    count = solution.poses - sum(len(with_finite_positions(t)) for t in solution.trajectories)
    if not count:
        return ""
    verb = "is" if count == 1 else "are"
    return f"{format_count(count, 'poses')} {verb} not finite and neither drawn nor evaluated."


def why_not_evaluated(subject: Subject) -> str:
    """Return a sentence on why there are no errors."""
    if subject.obstacle:
        return f"{subject.obstacle} There are no errors."
    if subject.truth:
        if is_unscaled(subject.solution):
            return (
                "The scene has no scale (its unit is the distance of the first two stations) and "
                "is not compared with the truth in metres; --align sim3 estimates the scale."
            )
        if not any(len(with_finite_positions(t)) for t in subject.solution.trajectories):
            return "No pose is finite: there are no errors."
        return "No pose has truth of its device at its time: there are no errors."
    if subject.session is not None:
        return "The session contains no truth: there are no errors. --truth FILE adds it."
    return "No truth is available: there are no errors. --truth FILE adds it."


def _all_sigmas(solution: Solution) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(s.value for s in position_sigmas(solution).values())])


def key_figures(subject: Subject) -> list[tuple[str, str]]:
    """Return the most important values, each with its name."""
    solution, evaluation = subject.solution, subject.evaluation
    unscaled = is_shown_unscaled(solution, evaluation)
    devices = format_count(len(solution.trajectories), "devices")
    figures = [(format_count(solution.poses), f"poses of {devices}")]
    sigma = _all_sigmas(solution)
    if evaluation is not None:
        figures += [
            (format_length(getattr(evaluation, name), unscaled=unscaled), f"APE {name}")
            for name in ("median", "rmse", "p95", "max")
        ]
        if evaluation.ape_rotation is not None:
            angle = format_number(evaluation.ape_rotation.median)
            figures.append((f"{angle}\u00b0", "APE rotation median"))
        if evaluation.coverage.fraction is not None:
            figures.append((f"{100 * evaluation.coverage.fraction:.1f} %", "of the time solved"))
    elif len(sigma):
        median, p95 = np.percentile(sigma, (50, 95)).tolist()
        figures.append((format_length(median, unscaled=unscaled), "median sigma"))
        figures.append((format_length(p95, unscaled=unscaled), "95 % of sigmas below"))
    rejected = sum(solution.rejected.values())
    return [*figures, (format_count(rejected), "observations rejected")]


# ---- errors


def error_panels(subject: Subject) -> list[Panel]:
    """Return panels of errors over time, by axis, of rotations and NEES; none without truth."""
    solution, evaluation = subject.solution, subject.evaluation
    if evaluation is None:
        return []
    colors = dict.fromkeys(evaluation.devices, UNSOLVED_DEVICE)
    colors |= device_colors([t.device for t in solution.trajectories])
    start_ns = origin_ns(subject.session, solution)
    unscaled = is_shown_unscaled(solution, evaluation)
    unit = select_unit(evaluation.p95, unscaled=unscaled)
    covariance = scored_covariance(solution, evaluation)
    panels = [
        _error_panel(evaluation, covariance, colors, unit, start_ns),
        _histogram_panel(evaluation, colors, unit),
        _axis_panel(evaluation, covariance, colors, unit, start_ns),
    ]
    has_rotation = np.isfinite(evaluation.rotation_errors_deg)
    if has_rotation.any():
        values = split_by_device(evaluation, evaluation.rotation_errors_deg, has_rotation)
        row = ValueRow(f"rotation error [{DEGREES.name}]", values, {})
        title = "Rotation error over time"
        panels.append(value_panel(title, "", [row], colors, start_ns, as_marks=True))
    panels += _nees_panels(evaluation, colors, start_ns)
    statistics = _statistics_table(evaluation, unit)
    panels.append(Panel("Statistics", _statistics_note(solution, evaluation), table=statistics))
    return panels


def _error_panel(
    evaluation: Evaluation,
    covariance: np.ndarray,
    colors: dict[str, str],
    unit: Unit,
    start_ns: int,
) -> Panel:
    """Return the errors over time with their 95 % bounds by the covariances (n, 3, 3)."""
    bound = error_quantile_95(covariance)
    row = ValueRow(
        f"error [{unit.name}]",
        split_by_device(evaluation, evaluation.errors * unit.per_si),
        split_by_device(evaluation, bound * unit.per_si),
    )
    panel = value_panel("Error over time", "", [row], colors, start_ns, as_marks=True)
    is_known = np.isfinite(bound)
    if is_known.any() and evaluation.consistency is None:
        inside = evaluation.errors <= bound
        percent = 100 * np.count_nonzero(inside) / np.count_nonzero(is_known)
        note = join_sentences(panel.note, f"{percent:.0f} % of the errors are.")
        return replace(panel, note=note)
    return panel


def _histogram_panel(evaluation: Evaluation, colors: dict[str, str], unit: Unit) -> Panel:
    """Return how often errors occur, with outliers in the last bin, and two marked quantiles."""
    series = split_by_device(evaluation, evaluation.errors * unit.per_si)
    every = np.concatenate([s.value for s in series.values()])
    limit = axis_limit(every)
    edges = np.linspace(0, limit, HISTOGRAM_BINS + 1)
    if len(series) <= MAX_LEGEND_DEVICES:
        groups = {
            escape(abbreviate(name)): (np.minimum(s.value, limit), colors[name])
            for name, s in series.items()
        }
    else:
        groups = {"all": (np.minimum(every, limit), ALL_DEVICES)}
    grid = DiagramGrid(1)
    grid.add_histogram(1, edges, groups, f"%{{y}} poses around %{{x:.3g}} {escape(unit.name)}")
    for name, value, side, shift_px in (
        ("median", evaluation.median, "right", -4),
        ("95 %", evaluation.p95, "left", 4),
    ):
        if value * unit.per_si <= limit:
            grid.add_vertical_line(
                value * unit.per_si,
                1,
                1,
                INK,
                "dash",
                annotation={
                    "text": name,
                    "yref": "paper",
                    "y": 1.0,
                    "yanchor": "top",
                    "xanchor": side,
                    "xshift": shift_px,
                    "bgcolor": faded(CARD, 0.8),
                    "showarrow": False,
                },
            )
    highest = np.histogram(np.minimum(every, limit), edges)[0].max()
    grid.figure.update_xaxes(range=[0, limit])
    grid.figure.update_yaxes(range=[0, 1.3 * float(highest)])  # Space for the line names.
    title = f"error [{unit.name}]"
    figure = grid.finish(
        280,
        ["poses"],
        column_titles=[title],
        barmode="stack",
        bargap=0,
        legend={
            **{"orientation": "h", "x": 0, "xanchor": "left", "y": 1.0, "yanchor": "bottom"},
            "traceorder": "normal",
        },
    )
    note = last_bin_note(every, limit)
    return Panel("Histogram of errors", f"{note}." if note else "", figure)


def _axis_panel(
    evaluation: Evaluation,
    covariance: np.ndarray,
    colors: dict[str, str],
    unit: Unit,
    start_ns: int,
) -> Panel:
    """Return the errors along each axis with their 95 % intervals by the covariances."""
    residual = evaluation.residuals * unit.per_si
    bound = NORMAL_95_QUANTILE * np.sqrt(np.einsum("nii->ni", covariance)) * unit.per_si
    rows = []
    for axis, name in enumerate("xyz"):
        if axis == 2 and not np.abs(evaluation.residuals[:, 2]).max() > MIN_HEIGHT_ERROR_M:
            continue
        values = split_by_device(evaluation, residual[:, axis])
        expected = split_by_device(evaluation, bound[:, axis])
        rows.append(ValueRow(f"{name} [{unit.name}]", values, expected))
    explanation = "Estimate minus truth."
    return value_panel("Error by axis", explanation, rows, colors, start_ns, signed=True)


def _nees_panels(evaluation: Evaluation, colors: dict[str, str], start_ns: int) -> list[Panel]:
    """Return the normalized errors squared, none if there are no covariances."""
    consistency = evaluation.consistency
    is_known = np.isfinite(evaluation.nees) & (evaluation.nees_dof > 0)
    if consistency is None or not is_known.any():
        return []
    ratio = evaluation.nees / np.array(CHI2_95_QUANTILES)[evaluation.nees_dof]
    row = ValueRow("NEES / 95 % quantile", split_by_device(evaluation, ratio, is_known), {})
    explanation = (
        "Normalized estimation error squared (NEES), divided by its 95 % quantile. "
        f"{100 * consistency.inside:.0f} % of {format_count(consistency.n, 'poses')} are below 1 "
        f"(95 % if the covariances are right)."
    )
    title = "Consistency of the covariance"
    return [value_panel(title, explanation, [row], colors, start_ns, as_marks=True, reference=1.0)]


def _statistics_table(evaluation: Evaluation, unit: Unit) -> Table:
    """Return APE and RPE of all devices together and, if there are several, of each device."""
    statistics = {
        name: evaluation.device_statistics(k) for k, name in enumerate(evaluation.devices)
    }
    if len(statistics) > 1:
        statistics = {"all": {name: getattr(evaluation, name) for name, _ in ERRORS}, **statistics}
    rows = []
    for name, title in ERRORS:
        row_unit = unit if "translation" in name else DEGREES
        for k, (device, errors) in enumerate(statistics.items()):
            error: Statistics | None = errors[name]
            if error is not None:
                values = (format_number(row_unit.per_si * getattr(error, s)) for s in STATISTICS)
                rows.append((title if k == 0 else "", device, row_unit.name, str(error.n), *values))
    return Table(("", "device", "unit", "n", *STATISTICS), rows)


def _statistics_note(solution: Solution, evaluation: Evaluation) -> str:
    """Return definitions of the statistics, and what was not scored."""
    unscored = ", ".join(
        f"{format_count(count)} {reason}" for reason, count in evaluation.unscored.items() if count
    )
    without_truth = [
        t.device for t in solution.trajectories if len(t) and t.device not in evaluation.devices
    ]
    scored = "" if without_truth else "All poses are scored."
    path = ""
    if evaluation.path_m:
        true, solved = (
            format_length(value) for value in (evaluation.path_m, evaluation.path_estimate_m)
        )
        path = f"Path length: {true} (truth), {solved} (estimate)"
        if evaluation.drift_percent is not None:
            path += f"; drift {format_number(evaluation.drift_percent)} %"
        path += "."
    return join_sentences(
        "APE: each pose compared with the truth at its time. RPE: the motion from each pose to the "
        f"{_describe_delta(evaluation.rpe_delta)}, compared with the true motion.",
        f"Alignment: {evaluation.align}; time offset: {evaluation.offset_s:g} s "
        f"({evaluation.time_offset.describe()}).",
        f"Not scored: {unscored}." if unscored else scored,
        f"There is no truth for {join_names(without_truth)}." if without_truth else "",
        path,
    )


def _describe_delta(delta: str) -> str:
    """Return the distance between the poses of a pair in words."""
    poses = delta.removesuffix("f")
    if poses == delta:
        return f"pose {delta} later"
    return "next one" if poses == "1" else f"pose {poses} poses later"


# ---- covariances


def covariance_panels(subject: Subject) -> list[Panel]:
    """Return the standard deviations of the solver over time; none if it reports none."""
    solution = subject.solution
    trajectories = [t for t in solution.trajectories if len(t)]
    sigmas = np.concatenate([np.zeros((0, 3)), *(t.sigma[:, :3] for t in trajectories)])
    every = sigmas[np.isfinite(sigmas)]
    size = float(np.percentile(every, 90)) if len(every) else 0.0
    unit = select_unit(size, unscaled=is_unscaled(solution))
    rows = []
    for column, name, scale, unit_name in (
        (0, "x", unit.per_si, unit.name),
        (1, "y", unit.per_si, unit.name),
        (2, "z", unit.per_si, unit.name),
        (5, "heading", 180 / np.pi, DEGREES.name),
    ):
        values = {}
        for t in trajectories:
            sigma = t.sigma[:, column] * scale
            if np.isfinite(sigma).any() and np.nanmax(sigma) > 0:
                values[t.device] = Series(t.time_ns, sigma)
        if values:
            rows.append(ValueRow(f"\u03c3 {name} [{unit_name}]", values, {}))
    if not rows:
        return []
    colors = device_colors([t.device for t in solution.trajectories])
    title, start_ns = "Standard deviation over time", origin_ns(subject.session, solution)
    explanation = "Standard deviations reported by the solver, in its own frame."
    return [value_panel(title, explanation, rows, colors, start_ns)]
