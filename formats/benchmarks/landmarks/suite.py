"""The figures of the landmarks: the paper's study, simulated visits, floors, maps and speed.

There is no published recording: what is simulated, and with which errors, is told in
:mod:`.landmarks_study`, :mod:`.landmarks_global`, :mod:`.landmarks_sessions` and
:mod:`.landmarks_closed_loop`. Of the data folder only the verified maps are used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.published.study import study
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.landmarks.closed_loop import closed_loop_figures
from locatk.formats.benchmarks.landmarks.global_localization import global_figures
from locatk.formats.benchmarks.landmarks.sessions import session_figures
from locatk.formats.benchmarks.landmarks.speed import map_figures, speed_figures
from locatk.formats.benchmarks.landmarks.study import (
    SURE,
    Found,
    by_field,
    by_valleys,
    by_voting,
    calibration,
    errors_mm,
    log_loss,
    rms_deg,
    stands,
    visited,
)
from locatk.formats.benchmarks.timing import SEED

Array = NDArray[np.float64]

PASSES = 600
"""Single straight passes."""

VISITS = 1000
"""Passes with a spin after them, and as many with a second pass."""

STANDS = 400

START_STEP = 1
"""Degrees between the starts of the paper's study; those in the real field are six times
as far apart, as in the prototype's study."""

PAPER = {"mean": 7.28, "SD": 3.53, "largest": 17.9}
"""Errors of the paper's first step in mm (section 3.5.2)."""

FAR_MM = 15.0

NOMINAL = "nominal errors, any of the 16 codes, at the end of the visit"


def figures(data: Path) -> list[Figure]:
    """All figures of landmarks; ``data`` is the folder of published data."""
    folder = data / "landmarks"
    return [
        *paper_figures(),
        *pass_figures(),
        *spin_figures(),
        *second_pass_figures(),
        *stand_figures(),
        *global_figures(folder),
        *session_figures(folder),
        *closed_loop_figures(folder),
        *map_figures(folder),
        *speed_figures(),
    ]


# ---- the paper's study


def paper_figures() -> Iterator[Figure]:
    """The first step of the published algorithm, on ideal half-discs and in the real field."""
    name = "paper's first step, half-discs"
    found = study(START_STEP)
    all_, ungrazed = found.figures(), found.figures(grazed=False)
    runs = f"{all_['runs']:.0f} runs, {all_['missed']:.0f} miss the landmark"
    yield Figure(f"{name}: mean, off the paper's", abs(all_["mean_mm"] - PAPER["mean"]), "mm",
                 f"landmark 3 (NNNS), corrected rule for two lines; {runs}", 0.5)  # fmt: skip
    for label, key in (("mean", "mean_mm"), ("SD", "sd_mm"), ("largest", "max_mm")):
        yield Figure(f"{name}: {label}", all_[key], "mm",
                     f"the same; {ungrazed[key]:.2f} without passes that graze a corner",
                     peer="paper", peer_value=PAPER[label])  # fmt: skip
    yield Figure(f"{name}: over 20 mm", 100 * all_["over_20_share"], "%",
                 f"the same; {100 * ungrazed['over_20_share']:.2g} without passes that graze",
                 0.5, peer="paper", peer_value=0.0)  # fmt: skip
    literal = study(START_STEP, method="literal").figures()
    yield Figure(f"{name}, literal rules: mean", literal["mean_mm"], "mm",
                 f"the text's convex hull: {100 * literal['over_20_share']:.0f} % over 20 mm",
                 peer="paper", peer_value=PAPER["mean"])  # fmt: skip
    for label, method, prototype in (("", "corrected", 10.0), (", voting", "voting", 9.4)):
        real = study(6 * START_STEP, "field", method).figures()  # type: ignore[arg-type]
        yield Figure(f"paper's first step, real field{label}: mean", real["mean_mm"], "mm",
                     f"no noise; {100 * real['over_20_share']:.1f} % over 20 mm",
                     peer="prototype", peer_value=prototype)  # fmt: skip


# ---- visits


def pass_figures() -> Iterator[Figure]:
    """The first estimate from one straight pass."""
    name, seed = "one pass", SEED
    made = visited(PASSES, "", seed)
    found = [by_field(*one) for one in made]
    baselines = [by_voting(*one) for one in made]
    voted = errors_mm([one for _, one in baselines])
    mean_voted = float(voted.mean())
    how = f"{len(found)} passes, 230 mm, {NOMINAL}; prototype 1.51 of NNNS"
    yield from _place(
        name, found, seed, 1.5, 3.0, FAR_MM, "voting, the same passes", voted, how
    )  # fmt: skip
    far, theirs = (float((mm > FAR_MM).sum()) for mm in (errors_mm(found), voted))
    yield Figure(f"{name}: over {FAR_MM:.0f} mm", far, "passes", "the same", 0.0, peer="voting",
                 peer_value=theirs)  # fmt: skip
    yield _right(name, found, seed, 92.0, "prototype", 91.0)
    yield from _probabilities(name, found, seed)
    ruled = errors_mm([one for one, _ in baselines])
    yield Figure(f"{name}, paper's first step: mean", float(ruled.mean()), "mm",
                 f"the same passes; {len(made) - len(ruled)} without a centre; SD "
                 f"{ruled.std():.2f}, largest {ruled.max():.1f}",
                 peer="prototype, real field, no noise", peer_value=10.0)  # fmt: skip
    yield Figure(f"{name}, voting: mean", mean_voted, "mm",
                 f"the same passes; {len(made) - len(voted)} without a centre; SD "
                 f"{voted.std():.2f}, largest {voted.max():.1f}",
                 peer="prototype, real field, no noise", peer_value=9.4)  # fmt: skip


def spin_figures() -> Iterator[Figure]:
    """The same after a spin of 360 degrees, 7 mm off the centre in the mean."""
    name, seed = "after a spin", SEED + 10_000
    made = visited(VISITS, "spin", seed)
    found = [by_field(*one) for one in made]
    spun = [by_valleys(*one) for one in made]
    valleys = errors_mm(spun)
    yield from _place(name, found, seed, 0.5, None, None, "paper's valleys (NMV), the same spins",
                      valleys, f"{len(found)} visits: a pass, back to 7 mm off the centre in the "
                      f"mean, 360 degrees; {NOMINAL}")  # fmt: skip
    read = [one for one in spun if math.isfinite(one.error_m)]
    share = 100 * len(read) / len(spun)
    right = 100 * float(np.mean([one.right for one in spun]))
    yield _right(name, found, seed, 99.9, "paper's valleys", right)
    yield from _probabilities(name, found, seed)
    yield Figure(f"{name}, paper's valleys: mean", float(valleys.mean()), "mm",
                 f"of the {share:.0f} % that it reads, of which "
                 f"{100 * float(np.mean([one.right for one in read] or [False])):.1f} % right; "
                 f"{100 * np.mean(valleys < 3):.0f} % below 3 mm, {100 * np.mean(valleys > 6):.0f} "
                 "% above 6 mm; the paper: most below 3, some above 6")  # fmt: skip


def second_pass_figures() -> Iterator[Figure]:
    """The same after a second pass, across the first."""
    name, seed = "after a second pass", SEED + 20_000
    made = visited(VISITS, "pass", seed)
    found = [by_field(*one) for one in made]
    yield from _place(name, found, seed, 0.5, None, None, None, None,
                      f"{len(found)} visits: a pass, and one across it; {NOMINAL}")  # fmt: skip
    yield _right(name, found, seed, 99.9, None, None)
    yield from _probabilities(name, found, seed)


def _place(
    name: str,
    found: Sequence[Found],
    seed: int,
    mean: float | None,
    p95: float | None,
    largest: float | None,
    peer: str | None,
    theirs: Array | None,
    how: str,
) -> Iterator[Figure]:
    """Errors of the place; the three numbers are what is promised."""
    every = errors_mm(found)
    lost = [one.number for one in found if not math.isfinite(one.error_m)]
    said = f"; not found or refused: {_numbers(lost)} of seed {seed}" if lost else ""
    if split := [one.number for one in found if one.visits > 1]:
        said += f"; taken for several visits, of which the last counts: {_numbers(split)}"
    worst = sorted((one for one in found if one.error_m > 0), key=lambda one: -one.error_m)[:3]
    numbers = _numbers([one.number for one in worst])
    by_lines = ", ".join(
        f"{errors_mm(some).mean():.2f} by {lines}"
        for lines in (1, 2, 3)
        if (some := [one for one in found if one.lines == lines])
    )
    for label, value, target, other, told in (
        ("mean", every.mean(), mean, np.mean, f"{how}{said}; mean {by_lines} lines of sensors"),
        ("p95", np.quantile(every, 0.95), p95, lambda a: np.quantile(a, 0.95), "the same"),
        ("largest", every.max(), largest, np.max, f"visits {numbers} of seed {seed}"),
    ):
        value_theirs = None if theirs is None else float(other(theirs))
        yield Figure(f"{name}: {label}", float(value), "mm", told, target,
                     peer=peer, peer_value=value_theirs)  # fmt: skip
    yield Figure(f"{name}: heading", rms_deg([one.heading_rad for one in found]), "deg",
                 "rms, of the same")  # fmt: skip
    nees = np.array([one.nees for one in found])
    known = nees[np.isfinite(nees)] if np.isfinite(nees).any() else np.array([math.nan])
    yield Figure(f"{name}: NEES", float(known.mean()), "",
                 f"x, y and heading, at the last sample of the visit; median "
                 f"{np.median(known):.2f} (2.37 expected), "
                 f"{100 * np.mean(known > 11.34):.1f} % above 11.34 (1 % expected)",
                 peer="consistent", peer_value=3.0)  # fmt: skip


def _right(
    name: str,
    found: Sequence[Found],
    seed: int,
    target: float,
    peer: str | None,
    theirs: float | None,
) -> Figure:
    wrong = [one.number for one in found if not one.right]
    return Figure(f"{name}: pattern right", 100 * (1 - len(wrong) / len(found)), "%",
                  f"all four bars, of {len(found)}; wrong, or not found: {_numbers(wrong)} of seed "
                  f"{seed}", target, "higher", peer, theirs)  # fmt: skip


def _probabilities(name: str, found: Sequence[Found], seed: int) -> Iterator[Figure]:
    """Whether probabilities are what they say."""
    off, bins = calibration(found)
    yield Figure(f"{name}: calibration error", off, "",
                 f"expected calibration error of the codes' probabilities: {bins}",
                 0.03)  # fmt: skip
    entropy = [one.entropy for one in found if math.isfinite(one.entropy)] or [math.nan]
    yield Figure(f"{name}: log loss", log_loss(found), "nats", "of the true codes",
                 peer="their own entropy: calibrated",
                 peer_value=float(np.mean(entropy)))  # fmt: skip
    sure = [one for one in found if one.probability > SURE]
    wrong = [one.number for one in sure if not one.right]
    share = 100 * len(wrong) / len(sure) if sure else math.nan
    yield Figure(f"{name}: wrong above {100 * SURE:.0f} %", share, "%",
                 f"of {len(sure)} codes told with more: {_numbers(wrong)} of seed {seed}",
                 100 - 100 * SURE)  # fmt: skip


def _numbers(which: Sequence[int]) -> str:
    more = "" if len(which) <= 12 else f" and {len(which) - 12} more"
    return ", ".join(map(str, which[:12])) + more if which else "none"


# ---- standing


def stand_figures() -> Iterator[Figure]:
    """A static fit of four values."""
    errors = "bars 4 % and 0.3 mm, gains 2 %, offsets 0.1 mT"
    for name, anywhere, where in (
        ("static at the landmark", False, "3 mm along each axis and 3 degrees off (1 sigma), all "
         "within 10 mm"),
        ("static within 10 mm", True, "anywhere on a disc of 10 mm and within 5 degrees; beyond "
         "7.5 mm some bars' fields turn over"),
    ):  # fmt: skip
        found = stands(STANDS, SEED + 30, anywhere)
        targets = (None, None) if anywhere else (0.4, 0.5)
        how = f"{STANDS} robots, the code known, four values each; {where}; {errors}"
        yield from _stood(name, found.field, how, targets)
        yield Figure(f"{name}: NEES", float(found.nees.mean()), "", "x, y and heading",
                     peer="consistent", peer_value=3.0)  # fmt: skip
        for label, way in (("linear", found.linear), ("by Newton's method", found.inverted)):
            yield from _stood(f"{name}, --method paper, {label}", way, "the same values")


def _stood(
    name: str,
    errors: Array,
    how: str,
    targets: tuple[float | None, float | None] = (None, None),
) -> Iterator[Figure]:
    known = errors[np.isfinite(errors[:, 0])]
    away = 1e3 * np.hypot(known[:, 0], known[:, 1]) if len(known) else np.array([math.nan])
    lost = f"; {len(errors) - len(known)} unsolved" if len(known) < len(errors) else ""
    yield Figure(f"{name}: mean", float(away.mean()), "mm",
                 f"{how}{lost}; p95 {np.quantile(away, 0.95):.2f}, largest {away.max():.2f}",
                 targets[0], peer="paper", peer_value=1.0)  # fmt: skip
    yield Figure(f"{name}: heading", rms_deg(list(known[:, 2])), "deg", "rms, the same",
                 targets[1], peer="paper", peer_value=1.5)  # fmt: skip
