"""Figures of the landmarks: the paper's study, simulated visits, sessions, maps and speed.

No recording of a landmark floor is published. The simulations and their errors are described in
:mod:`.visits`, :mod:`.global_localization`, :mod:`.sessions`, :mod:`.faults` and :mod:`.doubts`.
Only the verified maps are read from the data folder.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.published.study import study
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.landmarks.doubts import doubt_figures
from locatk.formats.benchmarks.landmarks.endurance import endurance_figures
from locatk.formats.benchmarks.landmarks.faults import fault_figures
from locatk.formats.benchmarks.landmarks.global_localization import global_figures
from locatk.formats.benchmarks.landmarks.odometry import odometry_figures
from locatk.formats.benchmarks.landmarks.sessions import closed_loop_figures, session_figures
from locatk.formats.benchmarks.landmarks.speed import map_figures, speed_figures
from locatk.formats.benchmarks.landmarks.visits import (
    CONFIDENT_PROBABILITY,
    VisitResult,
    calibration_error,
    errors_mm,
    log_loss,
    rms_deg,
    simulate_visits,
    solve_by_field,
    solve_by_valleys,
    solve_first_steps,
    solve_stops,
)
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]

SINGLE_PASSES = 600
"""Single straight passes."""

LONG_VISITS = 1000
"""Passes followed by a spin, and as many followed by a second pass."""

STOPPED_ROBOTS = 400

STUDY_STEP_DEG = 1
"""Angle between the starts of the paper's study; six times as large in the real field, as in the
prototype's study."""

REAL_FIELD_STEPS = 6

PAPER_MM = {"mean": 7.28, "SD": 3.53, "largest": 17.9}
"""Errors of the paper's first step (section 3.5.2)."""

MAX_FIRST_ERROR_MM = 15.0

MAX_LISTED_NUMBERS = 12

NOMINAL = "nominal errors, any of the 16 codes, at the end of the visit"


def figures(data: Path) -> list[Figure]:
    """Return all figures of landmarks; ``data`` is the folder of published data."""
    folder = data / "landmarks"
    return [
        *paper_figures(),
        *pass_figures(),
        *spin_figures(),
        *second_pass_figures(),
        *stop_figures(),
        *global_figures(folder),
        *session_figures(folder),
        *closed_loop_figures(folder),
        *fault_figures(folder),
        *odometry_figures(folder),
        *doubt_figures(folder),
        *map_figures(folder),
        *speed_figures(),
        *endurance_figures(),
    ]


# ---- the paper's study


def paper_figures() -> Iterator[Figure]:
    """Run the first step of the published algorithm on ideal half-discs and in the real field."""
    name = "paper's first step, half-discs"
    results = study(STUDY_STEP_DEG)
    all_runs, ungrazed = results.figures(), results.figures(grazed=False)
    runs = f"{all_runs['runs']:.0f} runs, {all_runs['missed']:.0f} miss the landmark"
    yield Figure(f"{name}: mean, off the paper's", abs(all_runs["mean_mm"] - PAPER_MM["mean"]),
                 "mm", f"landmark 3 (NNNS), corrected rule for two lines; {runs}", 0.5)  # fmt: skip
    for label, key in (("mean", "mean_mm"), ("SD", "sd_mm"), ("largest", "max_mm")):
        yield Figure(f"{name}: {label}", all_runs[key], "mm",
                     f"of the same runs; {ungrazed[key]:.2f} without passes that graze a corner",
                     peer="paper", peer_value=PAPER_MM[label])  # fmt: skip
    yield Figure(f"{name}: over 20 mm", 100 * all_runs["over_20_share"], "%",
                 f"of the same runs; {100 * ungrazed['over_20_share']:.2g} without passes that "
                 "graze a corner", 0.5, peer="paper", peer_value=0.0)  # fmt: skip
    literal = study(STUDY_STEP_DEG, method="literal").figures()
    yield Figure(f"{name}, literal rules: mean", literal["mean_mm"], "mm",
                 f"the text's convex hull: {100 * literal['over_20_share']:.0f} % over 20 mm",
                 peer="paper", peer_value=PAPER_MM["mean"])  # fmt: skip
    for label, method, prototype in (("", "corrected", 10.0), (", voting", "voting", 9.4)):
        real = study(REAL_FIELD_STEPS * STUDY_STEP_DEG, "field", method).figures()  # type: ignore[arg-type]
        yield Figure(f"paper's first step, real field{label}: mean", real["mean_mm"], "mm",
                     f"no noise; {100 * real['over_20_share']:.1f} % over 20 mm",
                     peer="prototype", peer_value=prototype)  # fmt: skip


# ---- visits


def pass_figures() -> Iterator[Figure]:
    """Score the first estimate from one straight pass."""
    name, seed = "one pass", FIRST_SEED
    visits = simulate_visits(SINGLE_PASSES, "", seed)
    results = [solve_by_field(*visit) for visit in visits]
    first_steps = [solve_first_steps(*visit) for visit in visits]
    by_rules = errors_mm([rules for rules, _ in first_steps])
    by_votes = errors_mm([votes for _, votes in first_steps])
    how = f"{len(results)} passes, 230 mm, {NOMINAL}; prototype 1.51 of NNNS"
    yield from _position_rows(
        name,
        results,
        seed,
        (1.5, 3.0, MAX_FIRST_ERROR_MM),
        how,
        "voting, the same passes",
        by_votes,
    )
    large, large_by_votes = (
        float((mm > MAX_FIRST_ERROR_MM).sum()) for mm in (errors_mm(results), by_votes)
    )
    yield Figure(f"{name}: over {MAX_FIRST_ERROR_MM:.0f} mm", large, "passes",
                 "of the same passes", 0.0, peer="voting",
                 peer_value=large_by_votes)  # fmt: skip
    yield _correct_row(name, results, seed, 92.0, "prototype", 91.0)
    yield from _probability_rows(name, results, seed)
    for method, errors, prototype in (
        (", paper's first step", by_rules, 10.0),
        (", voting", by_votes, 9.4),
    ):
        yield Figure(f"{name}{method}: mean", float(errors.mean()), "mm",
                     f"the same passes; {len(visits) - len(errors)} without a centre; SD "
                     f"{errors.std():.2f}, largest {errors.max():.1f}",
                     peer="prototype, real field, no noise",
                     peer_value=prototype)  # fmt: skip


def spin_figures() -> Iterator[Figure]:
    """Score the estimate after a spin of 360 degrees, on average 7 mm from the centre."""
    name, seed = "after a spin", FIRST_SEED + 10_000
    visits = simulate_visits(LONG_VISITS, "spin", seed)
    results = [solve_by_field(*visit) for visit in visits]
    by_valleys = [solve_by_valleys(*visit) for visit in visits]
    valleys_mm = errors_mm(by_valleys)
    how = (
        f"{len(results)} visits: a pass, return to 7 mm from the centre on average, 360 degrees; "
        f"{NOMINAL}"
    )
    yield from _position_rows(
        name, results, seed, (0.5, None, None), how, "paper's valleys (NMV), the same spins",
        valleys_mm,
    )  # fmt: skip
    read = [result for result in by_valleys if math.isfinite(result.error_m)]
    read_percent = 100 * len(read) / len(by_valleys)
    correct_percent = 100 * float(np.mean([result.is_correct for result in by_valleys]))
    yield _correct_row(name, results, seed, 99.9, "paper's valleys", correct_percent)
    yield from _probability_rows(name, results, seed)
    read_correct = 100 * float(np.mean([result.is_correct for result in read] or [False]))
    yield Figure(f"{name}, paper's valleys: mean", float(valleys_mm.mean()), "mm",
                 f"of the {read_percent:.0f} % that it reads, of which {read_correct:.1f} % are "
                 f"correct; {100 * np.mean(valleys_mm < 3):.0f} % below 3 mm, "
                 f"{100 * np.mean(valleys_mm > 6):.0f} % above 6 mm; the paper: most below 3, "
                 "some above 6")  # fmt: skip


def second_pass_figures() -> Iterator[Figure]:
    """Score the estimate after a second pass across the first."""
    name, seed = "after a second pass", FIRST_SEED + 20_000
    results = [solve_by_field(*visit) for visit in simulate_visits(LONG_VISITS, "pass", seed)]
    how = f"{len(results)} visits: a pass, and one across it; {NOMINAL}"
    yield from _position_rows(name, results, seed, (0.5, None, None), how)
    yield _correct_row(name, results, seed, 99.9, None, None)
    yield from _probability_rows(name, results, seed)


def _position_rows(
    name: str,
    results: Sequence[VisitResult],
    seed: int,
    targets_mm: tuple[float | None, float | None, float | None],
    how: str,
    peer: str | None = None,
    peer_errors_mm: Array | None = None,
) -> Iterator[Figure]:
    """Yield errors of position and heading; the targets are those of mean, p95 and largest."""
    errors = errors_mm(results)
    missing = [result.number for result in results if not math.isfinite(result.error_m)]
    remarks = f"; not detected or refused: {_list(missing)} of seed {seed}" if missing else ""
    if divided := [result.number for result in results if result.visits > 1]:
        remarks += f"; divided into several visits, of which the last counts: {_list(divided)}"
    by_error = sorted((r for r in results if r.error_m > 0), key=lambda r: -r.error_m)
    worst = [result.number for result in by_error[:3]]
    by_lines = ", ".join(
        f"{errors_mm(group).mean():.2f} by {lines}"
        for lines in (1, 2, 3)
        if (group := [result for result in results if result.lines == lines])
    )
    target_mean, target_p95, target_largest = targets_mm
    for label, statistic, target, detail in (
        ("mean", _mean, target_mean, f"{how}{remarks}; mean {by_lines} lines of sensors"),
        ("p95", _p95, target_p95, "of the same visits"),
        ("largest", _largest, target_largest, f"visits {_list(worst)} of seed {seed}"),
    ):
        peer_value = None if peer_errors_mm is None else statistic(peer_errors_mm)
        yield Figure(f"{name}: {label}", statistic(errors), "mm", detail, target,
                     peer=peer, peer_value=peer_value)  # fmt: skip
    yield Figure(f"{name}: heading", rms_deg([result.heading_rad for result in results]), "deg",
                 "rms, of the same visits")  # fmt: skip
    nees = np.array([result.nees for result in results])
    known = nees[np.isfinite(nees)] if np.isfinite(nees).any() else np.array([math.nan])
    yield Figure(f"{name}: NEES", float(known.mean()), "",
                 f"x, y and heading, at the last sample of the visit; median "
                 f"{np.median(known):.2f} (2.37 expected), "
                 f"{100 * np.mean(known > 11.34):.1f} % above 11.34 (1 % expected)",
                 peer="consistent", peer_value=3.0)  # fmt: skip


def _mean(errors: Array) -> float:
    return float(errors.mean())


def _p95(errors: Array) -> float:
    return float(np.quantile(errors, 0.95))


def _largest(errors: Array) -> float:
    return float(errors.max())


def _correct_row(
    name: str,
    results: Sequence[VisitResult],
    seed: int,
    target: float,
    peer: str | None,
    peer_value: float | None,
) -> Figure:
    wrong = [result.number for result in results if not result.is_correct]
    return Figure(f"{name}: pattern right", 100 * (1 - len(wrong) / len(results)), "%",
                  f"all four bars, of {len(results)}; wrong, or not detected: {_list(wrong)} of "
                  f"seed {seed}", target, "higher", peer, peer_value)  # fmt: skip


def _probability_rows(name: str, results: Sequence[VisitResult], seed: int) -> Iterator[Figure]:
    """Yield the calibration of the reported probabilities."""
    error, bins = calibration_error(results)
    yield Figure(f"{name}: calibration error", error, "",
                 f"expected calibration error of the codes' probabilities: {bins}",
                 0.03)  # fmt: skip
    entropies = [r.entropy for r in results if math.isfinite(r.entropy)] or [math.nan]
    yield Figure(f"{name}: log loss", log_loss(results), "nats", "of the true codes",
                 peer="their own entropy: calibrated",
                 peer_value=float(np.mean(entropies)))  # fmt: skip
    confident = [result for result in results if result.probability > CONFIDENT_PROBABILITY]
    wrong = [result.number for result in confident if not result.is_correct]
    percent = 100 * len(wrong) / len(confident) if confident else math.nan
    yield Figure(f"{name}: wrong above {100 * CONFIDENT_PROBABILITY:.0f} %", percent, "%",
                 f"of {len(confident)} codes with a higher probability: {_list(wrong)} of seed "
                 f"{seed}", 100 - 100 * CONFIDENT_PROBABILITY)  # fmt: skip


def _list(numbers: Sequence[int]) -> str:
    more = len(numbers) - MAX_LISTED_NUMBERS
    text = ", ".join(map(str, numbers[:MAX_LISTED_NUMBERS]))
    return (text + (f" and {more} more" if more > 0 else "")) or "none"


# ---- robots at rest


def stop_figures() -> Iterator[Figure]:
    """Score the static fit of four values."""
    errors = "bars 4 % and 0.3 mm, gains 2 %, offsets 0.1 mT"
    for name, anywhere, poses in (
        ("static at the landmark", False, "3 mm along each axis and 3 degrees off (1 sigma), all "
         "within 10 mm"),
        ("static within 10 mm", True, "anywhere on a disc of 10 mm and within 5 degrees; beyond "
         "7.5 mm the field of some bars changes its sign"),
    ):  # fmt: skip
        static = solve_stops(STOPPED_ROBOTS, FIRST_SEED + 30, anywhere)
        targets = (None, None) if anywhere else (0.4, 0.5)
        how = f"{STOPPED_ROBOTS} robots, known code, four values each; {poses}; {errors}"
        yield from _static_rows(name, static.field, how, targets)
        yield Figure(f"{name}: NEES", float(static.nees.mean()), "", "x, y and heading",
                     peer="consistent", peer_value=3.0)  # fmt: skip
        for label, by_paper in (("linear", static.linear), ("by Newton's method", static.newton)):
            yield from _static_rows(f"{name}, --method paper, {label}", by_paper, "the same values")


def _static_rows(
    name: str,
    errors: Array,
    how: str,
    targets: tuple[float | None, float | None] = (None, None),
) -> Iterator[Figure]:
    known = errors[np.isfinite(errors[:, 0])]
    distances = 1e3 * np.hypot(known[:, 0], known[:, 1]) if len(known) else np.array([math.nan])
    unsolved = f"; {len(errors) - len(known)} unsolved" if len(known) < len(errors) else ""
    yield Figure(f"{name}: mean", float(distances.mean()), "mm",
                 f"{how}{unsolved}; p95 {np.quantile(distances, 0.95):.2f}, largest "
                 f"{distances.max():.2f}", targets[0], peer="paper",
                 peer_value=1.0)  # fmt: skip
    yield Figure(f"{name}: heading", rms_deg(list(known[:, 2])), "deg", "rms, of the same",
                 targets[1], peer="paper", peer_value=1.5)  # fmt: skip
