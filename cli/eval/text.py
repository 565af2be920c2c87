"""Text of ``locatk eval``: a verdict, tables of errors, and the assumptions behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.evaluation import Evaluation, Statistics
    from locatk.formats.evaluation import RunSummary

SUMMARY = ("rmse", "mean", "median", "p95", "max")
"""Statistics that are shown by default."""

MAIN = ("median", "rmse", "p95", "max")
"""Statistics of each of several files."""

STATISTICS = (*SUMMARY, "std", "min", "sse")

ERRORS = (
    ("ape_translation", "APE", True),
    ("ape_rotation", "APE", False),
    ("rpe_translation", "RPE", True),
    ("rpe_rotation", "RPE", False),
)
"""Attribute of an evaluation, name, and whether it is a length (otherwise an angle)."""

ASSOCIATIONS = {
    "interpolate": "truth interpolated to the poses",
    "nearest": "nearest in time",
}


def text(evaluation: Evaluation, *, full: bool = False) -> str:
    """Format an evaluation; lengths are in mm if all of them are below 1 m.

    By default: verdict, APE, RPE, coverage, alignment, and a time offset if there is one.
    """
    unit, factor = ("m", 1.0) if evaluation.max >= 1.0 else ("mm", 1e3)
    scopes = _scopes(evaluation)
    table = _full_table if full else _summary_table
    lines = _all_lines(evaluation) if full else _short_lines(evaluation)
    return "\n".join(
        [
            _verdict(evaluation, unit, factor),
            table(scopes, unit, factor),
            *map(console.wrapped, lines),
        ]
    )


def several(rows: Sequence[Mapping[str, Any]], summaries: Sequence[RunSummary]) -> str:
    """Format the errors of several files, of all of each run, and the differences of runs."""
    has_runs = len(summaries) > 1
    factor, unit = (1.0, "m") if max(row["max_m"] or 0.0 for row in rows) >= 1.0 else (1e3, "mm")
    header = ("session", "device", "n", *(f"{name} [{unit}]" for name in MAIN), "coverage")
    cells = []
    for row in rows:
        session = f"{row['run']}/{row['session']}" if has_runs else row["session"]
        errors = (_cell(row[f"{name}_m"], factor) for name in MAIN)
        coverage = "-" if row["coverage"] is None else f"{row['coverage']:.1%}"
        cells.append((session, row["device"], row["poses"], *errors, coverage))
    for summary in summaries:
        errors = (_cell(getattr(summary, f"{name}_m"), factor) for name in MAIN)
        title = summary.run if has_runs else "all"
        cells.append((title, f"{summary.sessions} sessions", summary.poses, *errors, ""))
    lines = [console.table(header, cells)]
    for summary in summaries[1:]:
        if summary.difference_m is not None:
            change = factor * summary.difference_m
            lines.append(
                console.wrapped(
                    f"{summary.run} against {summaries[0].run}, {summary.shared} shared sessions: "
                    f"the median error is {number(abs(change))} {unit} "
                    f"{'smaller' if change < 0 else 'larger'} (median of the differences), and "
                    f"smaller in {summary.better}"
                )
            )
    return "\n".join(lines)


def _cell(value: float | None, factor: float) -> str:
    return "-" if value is None else number(factor * value)


def _scopes(evaluation: Evaluation) -> list[tuple[str, dict[str, Statistics | None]]]:
    """Return the statistics of all devices together, if there are several, and of each."""
    from locatk.core.natural_order import natural_key

    names = evaluation.devices
    order = sorted(range(len(names)), key=lambda index: natural_key(names[index]))
    scopes = [(names[index], evaluation.device_statistics(index)) for index in order]
    if len(names) > 1:
        scopes.insert(0, ("all", {name: getattr(evaluation, name) for name, _, _ in ERRORS}))
    return scopes


def _verdict(evaluation: Evaluation, unit: str, factor: float) -> str:
    """Return the error of most poses in a sentence."""
    median, p95 = (f"{number(factor * e)} {unit}" for e in (evaluation.median, evaluation.p95))
    if evaluation.n == 1:
        return f"The only pose with truth has an error of {median}."
    return f"Half of {evaluation.n} poses are within {median} of the truth, 95 % within {p95}."


def _summary_table(
    scopes: Sequence[tuple[str, dict[str, Statistics | None]]], unit: str, factor: float
) -> str:
    """Format a row for each error of each device."""
    rows = []
    for device, statistics in scopes:
        for name, label, is_length in ERRORS:
            values = statistics[name]
            if values is not None:
                scale, error_unit = (factor, unit) if is_length else (1.0, "deg")
                cells = (number(scale * getattr(values, figure)) for figure in SUMMARY)
                rows.append((device, f"{label} [{error_unit}]", values.n, *cells))
    return console.table(("device", "error", "n", *SUMMARY), rows)


def _full_table(
    scopes: Sequence[tuple[str, dict[str, Statistics | None]]], unit: str, factor: float
) -> str:
    """Format a row for each statistic of each device, and a column for each error."""
    known = [
        (name, label, is_length)
        for name, label, is_length in ERRORS
        if any(statistics[name] is not None for _, statistics in scopes)
    ]
    titles = [f"{label} [{unit if is_length else 'deg'}]" for _, label, is_length in known]
    rows: list[tuple[str, ...]] = []
    for device, statistics in scopes:
        for figure in ("n", *STATISTICS):
            cells = []
            for name, _, is_length in known:
                values = statistics[name]
                scale = factor if is_length else 1.0
                if values is None:
                    cells.append("-")
                elif figure == "n":
                    cells.append(str(values.n))
                else:
                    power = 2 if figure == "sse" else 1
                    cells.append(number(scale**power * getattr(values, figure)))
            rows.append((device, "sse [unit²]" if figure == "sse" else figure, *cells))
    return console.table(("device", "statistic", *titles), rows)


def number(value: float) -> str:
    """Format with three decimals, or three digits below 0.1; rounding errors are 0."""
    if value < 1e-9:
        return "0"
    return f"{value:.3f}" if value >= 0.1 else f"{value:.3g}"


def _short_lines(evaluation: Evaluation) -> list[str]:
    """Return coverage, alignment, and assumptions that are not the default ones."""
    lines = [_coverage(evaluation), _alignment(evaluation)]
    if evaluation.offset_s:
        lines.append(_time_offset(evaluation))
    if any(evaluation.unscored.values()):
        lines.append(_unscored(evaluation))
    return lines


def _all_lines(evaluation: Evaluation) -> list[str]:
    """Return a line for each assumption and each further statistic."""
    return [
        "RPE: from each pose to the next"
        if evaluation.rpe_delta == "1f"
        else f"RPE: between poses at a distance of {evaluation.rpe_delta}",
        _alignment(evaluation),
        f"association: {evaluation.match} ({ASSOCIATIONS[evaluation.match]})",
        _time_offset(evaluation),
        _unscored(evaluation),
        _coverage(evaluation),
        f"path: {evaluation.path_m:.3f} m (truth), {evaluation.path_estimate_m:.3f} m (estimate)",
        _drift(evaluation),
        _consistency(evaluation),
    ]


def _alignment(evaluation: Evaluation) -> str:
    if evaluation.align == "none":
        return "alignment: none"
    scale = f" (scale {evaluation.alignment.scale:.6f})" if evaluation.align[:3] == "sim" else ""
    fitted_on = evaluation.as_dict()["align_fitted_on"]
    return f"alignment: {evaluation.align}, fitted on {fitted_on}{scale}"


def _time_offset(evaluation: Evaluation) -> str:
    return f"time offset: {evaluation.offset_s:.4f} s ({evaluation.time_offset.describe()})"


def _unscored(evaluation: Evaluation) -> str:
    counts = ", ".join(f"{n} {reason}" for reason, n in evaluation.unscored.items() if n)
    return f"not scored: {counts or 'nothing'}"


def _coverage(evaluation: Evaluation) -> str:
    coverage = evaluation.coverage
    if coverage.fraction is None:
        return "coverage: - (the truth has single poses only)"
    percent = 100 * coverage.fraction
    return f"coverage: {percent:.1f} % ({coverage.solved_s:.1f} of {coverage.truth_s:.1f} s)"


def _drift(evaluation: Evaluation) -> str:
    drift = evaluation.as_dict()["drift"]
    percent, rotation = drift["translation_percent"], drift["rotation_deg_per_m"]
    if percent is None:
        return "drift: - (the truth does not move)"
    rate = "" if rotation is None else f", {number(rotation)} deg/m"
    return f"drift: {number(percent)} %{rate} (over 10 to 50 % of the path)"


def _consistency(evaluation: Evaluation) -> str:
    consistency = evaluation.consistency
    if consistency is None:
        return "consistency: - (the estimate has no covariances)"
    return (
        f"consistency: {consistency.describe()}; {100 * consistency.inside:.0f} % of the poses are "
        "in their 95 % region"
    )
