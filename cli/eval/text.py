"""What ``locatk eval`` tells people: tables of errors, and a line for each assumption."""

from __future__ import annotations

from typing import TYPE_CHECKING

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.evaluation import Evaluation, Statistics

STATISTICS = ("rmse", "mean", "median", "p95", "max", "std", "min", "sse")

KINDS = (
    ("ape_translation", "APE", True),
    ("ape_rotation", "APE", False),
    ("rpe_translation", "RPE", True),
    ("rpe_rotation", "RPE", False),
)


def text(found: Evaluation) -> str:
    """The evaluation for people; lengths in mm where they are small."""
    metres = found.max >= 1.0
    unit, factor = ("m", 1.0) if metres else ("mm", 1e3)
    several = len(found.devices) > 1
    scopes: list[tuple[str, dict[str, Statistics | None]]] = []
    if several:
        every = {name: getattr(found, name) for name, _, _ in KINDS}
        scopes.append(("all", every))
    scopes += [(name, found.device_statistics(i)) for i, name in enumerate(found.devices)]
    rows = [
        _row(name, f"{short} [{unit}]", figures, factor)
        if length
        else _row(name, f"{short} [deg]", figures, 1.0)
        for name, told in scopes
        for kind, short, length in KINDS
        if (figures := told[kind]) is not None
    ]
    header = ("device", "error", "n", *STATISTICS[:-1], "sse [unit²]")
    return "\n".join([_verdict(found, unit, factor), console.table(header, rows), *_lines(found)])


def _verdict(found: Evaluation, unit: str, factor: float) -> str:
    """Whether it is good, in one line."""
    middle, most = (f"{number(factor * value)} {unit}" for value in (found.median, found.p95))
    if found.n == 1:
        return f"The one pose with truth lies {middle} from it."
    return f"Half of {found.n} poses lie within {middle} of the truth, 95 % within {most}."


def _row(device: str, label: str, figures: Statistics, factor: float) -> tuple[object, ...]:
    numbers = (
        number(getattr(figures, name) * (factor**2 if name == "sse" else factor))
        for name in STATISTICS
    )
    return (device, label, figures.n, *numbers)


def number(value: float) -> str:
    """Three decimals; three digits below a tenth, and nothing below rounding."""
    if value < 1e-9:
        return "0"
    return f"{value:.3f}" if value >= 0.1 else f"{value:.3g}"


def _lines(found: Evaluation) -> list[str]:
    facts = found.as_dict()
    left_out = ", ".join(f"{count} {why}" for why, count in found.unscored.items() if count)
    how = {
        "interpolate": "truth interpolated to the poses",
        "nearest": "nearest in time",
    }[found.match]
    return [
        "RPE: from each pose to the next"
        if found.rpe_delta == "1f"
        else f"RPE: of poses {found.rpe_delta} apart",
        f"alignment: {found.align}, fitted on {facts['align_fitted_on']}"
        + (f" (scale {found.alignment.scale:.6f})" if found.align.startswith("sim") else ""),
        f"association: {found.match} ({how})",
        f"time offset: {found.offset_s:.4f} s ({found.time_offset.describe()})",
        f"not scored: {left_out or 'nothing'}",
        _coverage(found),
        f"path: {found.path_m:.3f} m (truth), {found.path_estimate_m:.3f} m (estimate)",
        _drift(facts["drift"]),
        _consistency(found),
    ]


def _coverage(found: Evaluation) -> str:
    fraction, time = found.coverage.fraction, found.coverage
    if fraction is None:
        return "coverage: - (the truth tells of single poses)"
    return f"coverage: {100 * fraction:.1f} % ({time.solved_s:.1f} of {time.truth_s:.1f} s)"


def _drift(drift: dict[str, float | None]) -> str:
    percent, turned = drift["translation_percent"], drift["rotation_deg_per_m"]
    if percent is None:
        return "drift: - (the truth stands still)"
    rotation = "" if turned is None else f", {number(turned)} deg/m"
    return f"drift: {number(percent)} %{rotation} (over 10 to 50 % of the path)"


def _consistency(found: Evaluation) -> str:
    said = found.consistency
    if said is None:
        return "consistency: - (the estimate has no covariances)"
    return (
        f"consistency: {said.describe()}; NEES {said.mean:.3g} a degree of freedom "
        f"({said.low:.2f} to {said.high:.2f} expected of independent poses), "
        f"{100 * said.inside:.0f} % of the poses in their 95 % region"
    )
