"""How good a solution is: in one sentence, in key figures, in tables and in figures."""

from __future__ import annotations

import numpy as np

from locatk.core.evaluation import CHI2_95_QUANTILES, Evaluation, Statistics
from locatk.core.solution import Solution
from locatk.formats.plots import series as plot_series
from locatk.formats.plots.ground import has_no_scale, known
from locatk.formats.plots.series import NORMAL_95, Series
from locatk.formats.plots.time_axis import origin_ns
from locatk.formats.plots.units import Unit, digits, length, thousands, unit_for
from locatk.formats.report.figures import colours, sentences
from locatk.formats.report.figures_time import Row, errors_figure, histogram_figure, rows_figure
from locatk.formats.report.panel import Panel, Table
from locatk.formats.report.signals_drawing import listed
from locatk.formats.report.subject import Subject


def unscaled(subject: Subject) -> bool:
    """Whether lengths of the subject are in units of its scene, not in metres."""
    evaluation = subject.evaluation
    fitted = evaluation is not None and evaluation.align.startswith("sim")
    return has_no_scale(subject.solution) and not fitted


def verdict(subject: Subject) -> str:
    """How good it is, in a sentence or two."""
    solution, evaluation = subject.solution, subject.evaluation
    if not solution.poses:
        return "Nothing was solved: there is no pose."
    if evaluation is None:
        spread = _sigma(subject)
        if not len(spread):
            return sentences(
                why_unjudged(subject), "The solver tells no covariance either.", _left_out(solution)
            )
        middle = length(float(np.median(spread)), unscaled=unscaled(subject))
        return sentences(
            why_unjudged(subject),
            f"The solver itself expects a standard deviation of {middle} (median over all poses, "
            "all axes together).",
            _left_out(solution),
        )
    unit = unscaled(subject)
    text = (
        f"Half of the poses lie within {length(evaluation.median, unscaled=unit)} of the truth, "
        f"95 % within {length(evaluation.p95, unscaled=unit)}."
    )
    fitted = (
        "Nothing was fitted on the truth."
        if evaluation.align == "none"
        else f"The alignment {evaluation.align} was fitted on the truth, on these same poses."
    )
    if evaluation.offset_s:
        fitted += (
            f" Time offset: {evaluation.offset_s:.4f} s ({evaluation.time_offset.describe()})."
        )
    consistency = evaluation.consistency
    judged = "" if consistency is None else f"{consistency.describe().capitalize()}."
    return sentences(text, fitted, judged, _left_out(solution))


def _left_out(solution: Solution) -> str:
    """A sentence on poses that are no numbers."""
    count = solution.poses - sum(len(known(t)) for t in solution.trajectories)
    if not count:
        return ""
    said = "1 pose is not a number: it is" if count == 1 else f"{thousands(count)} poses are not "
    return f"{said}{'' if count == 1 else 'numbers: they are'} neither drawn nor scored."


def why_unjudged(subject: Subject) -> str:
    """Why there are no errors."""
    if subject.truth:
        if has_no_scale(subject.solution):
            return (
                "The scene has no scale (its unit is the distance of the first two stations), so "
                "that it is not compared with the truth in metres; --align sim3 compares them."
            )
        if not any(len(known(t)) for t in subject.solution.trajectories):
            return "No pose is a number, so that there are no errors."
        return "No pose has truth at its time for its device, so that there are no errors."
    if subject.session is not None:
        return "The session holds no truth, so that there are no errors; --truth FILE gives it."
    return "No truth is at hand, so that there are no errors; --truth FILE gives it."


def _sigma(subject: Subject) -> np.ndarray:
    found = [s.value for s in plot_series.sigmas(subject.solution).values()]
    return np.concatenate(found) if found else np.zeros(0)


def key_figures(subject: Subject) -> list[tuple[str, str]]:
    """Values and what they are, for the head."""
    solution, evaluation = subject.solution, subject.evaluation
    unit = unscaled(subject)
    devices = len(solution.trajectories)
    found = [(thousands(solution.poses), _of(devices))]
    if evaluation is not None:
        found += [
            (length(getattr(evaluation, name), unscaled=unit), f"APE {name}")
            for name in ("median", "rmse", "p95", "max")
        ]
        if evaluation.ape_rotation is not None:
            found.append((f"{digits(evaluation.ape_rotation.median)}\u00b0", "APE rotation median"))
        if evaluation.coverage.fraction is not None:
            found.append((f"{100 * evaluation.coverage.fraction:.1f} %", "of the time solved"))
    else:
        spread = _sigma(subject)
        if len(spread):
            middle, high = np.percentile(spread, (50, 95)).tolist()
            found.append((length(middle, unscaled=unit), "median sigma"))
            found.append((length(high, unscaled=unit), "95 % of sigmas below"))
    rejected = sum(solution.rejected.values())
    found.append((thousands(rejected), "observations rejected"))
    return found


def _of(devices: int) -> str:
    return f"poses of {devices} {'device' if devices == 1 else 'devices'}"


def error_panels(subject: Subject) -> list[Panel]:
    """Errors against time, how often they occur, by axis, in a table; none without truth."""
    evaluation = subject.evaluation
    if evaluation is None:
        return []
    colors = colours([t.device for t in subject.solution.trajectories])
    for name in evaluation.devices:
        colors.setdefault(name, "#5b6875")
    series = plot_series.errors(evaluation)
    expected = plot_series.expected(subject.solution, evaluation)
    unit = unit_for(evaluation.p95, unscaled=unscaled(subject))
    figure, note = errors_figure(
        series,
        expected,
        colors,
        unit,
        "error",
        origin_ns(subject.session, subject.solution),
        "where 95 % of the errors should be below, by the solver's covariance",
    )
    edges = np.concatenate([s.value for s in expected.values()])
    below = evaluation.errors <= edges
    told = np.isfinite(edges)
    if told.any() and evaluation.consistency is None:
        share = 100 * np.count_nonzero(below[told]) / np.count_nonzero(told)
        note = sentences(note, f"{share:.0f} % of the errors are below what it expects of 95 %.")
    panels = [Panel("Error against time", note, figure)]
    lines = {"median": evaluation.median, "95 %": evaluation.p95}
    shown = histogram_figure(series, colors, unit, "error", lines)
    panels.append(Panel("How often errors occur", "", shown))
    panels.append(_by_axis(subject, evaluation, colors, unit))
    panels += _rotation(subject, evaluation, colors)
    panels += _nees(subject, evaluation, colors)
    panels.append(
        Panel("Statistics", _how(subject.solution, evaluation), table=_statistics(evaluation, unit))
    )
    return panels


def _by_axis(subject: Subject, evaluation: Evaluation, colors: dict[str, str], unit: Unit) -> Panel:
    covariance = plot_series.scored_covariance(subject.solution, evaluation)
    band = NORMAL_95 * np.sqrt(np.einsum("nii->ni", covariance)) * unit.per_metre
    rows = []
    for k, name in enumerate("xyz"):
        value = evaluation.residuals[:, k] * unit.per_metre
        if k == 2 and not np.abs(value).max() > 1e-9 * unit.per_metre:
            continue  # all on the plane of the truth
        values, bands = {}, {}
        for i, device in enumerate(evaluation.devices):
            mine = evaluation.device == i
            if mine.any():
                values[device] = Series(evaluation.time_ns[mine], value[mine])
                if np.isfinite(band[mine, k]).any():
                    bands[device] = Series(evaluation.time_ns[mine], band[mine, k])
        rows.append(Row(f"{name} [{unit.name}]", values, bands))
    start = origin_ns(subject.session, subject.solution)
    figure, note = rows_figure(rows, colors, start, signed=True)
    drawn = [len(row.bands) for row in rows if 0 < len(row.bands) <= plot_series.MOST_BANDS]
    within = "shade" if max(drawn, default=0) == 1 else "thin lines"
    expected = f"95 % should lie within the {within}, by the solver's covariance."
    return Panel(
        "Error by axis", sentences("Solved minus true.", expected if drawn else "", note), figure
    )


def _rotation(subject: Subject, evaluation: Evaluation, colors: dict[str, str]) -> list[Panel]:
    told = np.isfinite(evaluation.rotation_errors_deg)
    if not told.any():
        return []
    series = {}
    for k, name in enumerate(evaluation.devices):
        mine = told & (evaluation.device == k)
        series[name] = Series(evaluation.time_ns[mine], evaluation.rotation_errors_deg[mine])
    start = origin_ns(subject.session, subject.solution)
    figure, note = errors_figure(series, {}, colors, Unit("\u00b0", 1.0), "rotation error", start)
    return [Panel("Rotation error against time", note, figure)]


def _nees(subject: Subject, evaluation: Evaluation, colors: dict[str, str]) -> list[Panel]:
    told = np.isfinite(evaluation.nees) & (evaluation.nees_dof > 0)
    if evaluation.consistency is None or not told.any():
        return []
    ratio = evaluation.nees / np.array(CHI2_95_QUANTILES)[evaluation.nees_dof]
    series = {}
    for k, name in enumerate(evaluation.devices):
        mine = told & (evaluation.device == k)
        series[name] = Series(evaluation.time_ns[mine], ratio[mine])
    start = origin_ns(subject.session, subject.solution)
    figure, note = errors_figure(
        series, {}, colors, Unit("of its 95 % edge", 1.0), "NEES", start, reference=1.0
    )
    consistency = evaluation.consistency
    said = (
        "Normalised estimation error squared: the error measured by the covariance that comes "
        "with it, here over the value below which 95 % should be. "
        f"{100 * consistency.inside:.0f} % of {thousands(consistency.n)} poses are below 1; the "
        f"mean over its expectation is {digits(consistency.mean)} (1 where the covariances are "
        "right)."
    )
    return [Panel("Does the covariance fit the error?", sentences(said, note), figure)]


STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "p95")
ERRORS = (
    ("ape_translation", "APE translation"),
    ("ape_rotation", "APE rotation"),
    ("rpe_translation", "RPE translation"),
    ("rpe_rotation", "RPE rotation"),
)


def _statistics(evaluation: Evaluation, unit: Unit) -> Table:
    """APE and RPE; of several devices also each of them."""
    rows: list[tuple[str, ...]] = []

    def add(what: str, device: str, of: Statistics | None, unit: str, factor: float) -> None:
        if of is not None:
            values = (digits(factor * getattr(of, name)) for name in STATISTICS)
            rows.append((what, device, unit, str(of.n), *values))

    every = {name: getattr(evaluation, name) for name, _ in ERRORS}
    of_each = {name: evaluation.device_statistics(k) for k, name in enumerate(evaluation.devices)}
    if len(of_each) > 1:
        of_each = {"all": every, **of_each}
    for name, title in ERRORS:
        of, factor = (unit.name, unit.per_metre) if "translation" in name else ("\u00b0", 1.0)
        for k, (device, found) in enumerate(of_each.items()):
            add(title if k == 0 else "", device, found[name], of, factor)
    return Table(("", "device", "unit", "n", *STATISTICS), rows)


def _how(solution: Solution, evaluation: Evaluation) -> str:
    """What the statistics mean, and what was left out."""
    out = ", ".join(
        f"{thousands(count)} {why}" for why, count in evaluation.unscored.items() if count
    )
    alone = [t.device for t in solution.trajectories if len(t)]
    alone = [name for name in alone if name not in evaluation.devices]
    parts = [
        "APE: each pose against the truth at its time. "
        f"RPE: the motion from each pose to {_apart(evaluation.rpe_delta)}, against the true one.",
        f"Alignment: {evaluation.align}; time offset: {evaluation.offset_s:g} s "
        f"({evaluation.time_offset.describe()}).",
        f"Not scored: {out}." if out else "" if alone else "All poses are scored.",
        f"There is no truth for {listed(alone)}." if alone else "",
    ]
    if evaluation.path_m:
        path = f"The true path is {length(evaluation.path_m)} long"
        path += f", the solved one {length(evaluation.path_estimate_m)}"
        if evaluation.drift_percent is not None:
            path += f"; drift {digits(evaluation.drift_percent)} % of it"
        parts.append(path + ".")
    return sentences(*parts)


def _apart(delta: str) -> str:
    """How far apart the poses of a pair are, in words."""
    frames = delta.removesuffix("f")
    if frames != delta:
        return "the next" if frames == "1" else f"the one {frames} poses on"
    return f"the one {delta} on"


def sigma_panels(subject: Subject) -> list[Panel]:
    """Standard deviations as the solver tells them, against time; none where it tells none."""
    solution = subject.solution
    colors = colours([t.device for t in solution.trajectories])
    moved = [t for t in solution.trajectories if len(t)]
    spreads = [t.sigma[:, :3][np.isfinite(t.sigma[:, :3])] for t in moved]
    every = np.concatenate(spreads) if spreads else np.zeros(0)
    size = float(np.percentile(every, 90)) if len(every) else 0.0
    unit = unit_for(size, unscaled=has_no_scale(solution))
    rows = []
    for column, name, factor, of in (
        (0, "x", unit.per_metre, unit.name),
        (1, "y", unit.per_metre, unit.name),
        (2, "z", unit.per_metre, unit.name),
        (5, "heading", 180 / np.pi, "\u00b0"),
    ):
        values = {}
        for t in moved:
            sigma = t.sigma[:, column] * factor
            if np.isfinite(sigma).any() and np.nanmax(sigma) > 0:
                values[t.device] = Series(t.time_ns, sigma)
        if values:
            rows.append(Row(f"\u03c3 {name} [{of}]", values, {}))
    if not rows:
        return []
    start = origin_ns(subject.session, solution)
    figure, note = rows_figure(rows, colors, start, signed=False)
    said = "Standard deviations as the solver tells them, in its own frame."
    return [Panel("Covariance against time", sentences(said, note), figure)]
