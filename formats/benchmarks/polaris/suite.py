"""Figures of Polaris: the published recordings, simulations, and speed.

The recordings were published by the paper's authors: ten runs over their default tag and three
over one of varying orientations, read as by ``locatk import polaris-csv --rate 40 --spacing 20``.
The positions of the tags were not measured: the truth is their layout, and a car that was aligned
by hand. The pose is therefore unknown, and magnets are compared with each other:

- *rigid-aligned*: mean distance of the magnets from their cells after the best rotation and
  translation, without scale.
- *authors' metric*: as in ``sensing_offline.py`` of the released code, without rotation; see
  :func:`anchored_error`.

Except for this alignment, nothing is fitted to the truth. The default method does not know the
speed and measures lengths along the track with the known spacing of the tag, which is part of
solving; rows "without the ruler" undo this.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from locatk.core.errors import LocatkError
from locatk.core.geometry import umeyama
from locatk.core.polaris.array import Samples
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.published.pipeline import pattern_heading
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import cell_positions, symbol_angles
from locatk.formats.benchmarks.figures import Duration, Figure
from locatk.formats.benchmarks.polaris.designs import design_figures
from locatk.formats.benchmarks.polaris.disturbances import disturbance_figures
from locatk.formats.benchmarks.polaris.given_speeds import given_speed_figures
from locatk.formats.benchmarks.polaris.passes import pass_figures
from locatk.formats.benchmarks.polaris.speed import speed_figures
from locatk.formats.benchmarks.timing import run_single_threaded, time_each
from locatk.formats.importers.polaris_csv import PUBLISHED_TAGS, read_polaris

Array = NDArray[np.float64]

SAMPLE_RATE_HZ, SENSOR_SPACING_M = 40.0, 0.020
SPEED_MPS = 0.105
"""Constants of the published runs in the released code."""

SET_RUNS = {"default": 10, "varying": 3}
SET_IDS = {"default": 262143, "varying": 255183}
"""Number of runs of each set, and the id of its tag in the released table."""

RIGID_MM = {"default": 1.46, "varying": 2.36}
ANCHORED_MM = {"default": 1.68, "varying": 2.71}
"""Position errors of the authors' own results in both metrics, from their program (wjk5117/Polaris
on GitHub) run again on the ten recordings of each set."""

SCATTER_DEG = {"default": 4.7, "varying": 9.8}
HEADING_DEG = {"default": 1.14, "varying": 1.78}
"""Scatter of orientations and mean absolute headings of the authors' own results."""

SCALE_RANGE = (0.8, 1.25)
"""Range in which the scale of a track is fitted for cross-validation."""

SAME_RUNS = "authors, the same runs"
SAME_RUNS_WRONG_BITS = 1.0
SAME_RUNS_READ_PERCENT = {"default": 90.0, "varying": 100.0}
SAME_RUNS_ANCHORED_MM = {"default": 1.68, "varying": 2.01}
SAME_RUNS_HEADING_DEG = {"default": 1.14, "varying": 2.21}
"""The authors' results on the 13 runs alone, from ``Evaluation/Results`` of their repository."""

AUTHORS = {"default": "authors", "varying": "authors, ten runs of the set"}
"""Peer of each set; the data folder has three of the ten runs with varying orientations."""


def figures(data: Path) -> list[Figure]:
    """Return all figures of Polaris; ``data`` is the folder of published recordings."""
    return [
        *published_figures(data / "polaris"),
        *pass_figures(),
        *design_figures(),
        *disturbance_figures(),
        *given_speed_figures(),
        *speed_figures(),
    ]


# ---- the published runs


@dataclass(frozen=True)
class PublishedRun:
    """Result of one recording; the five magnets of the tag are in the order of its cells.

    Attributes
    ----------
    tag_id : int
        True id.
    is_read : bool
        True if any id was read.
    wrong_bits : int
        Wrong bits of the ids that were read.
    position_m : (5, 2) ndarray
        In the array's frame; ``nan`` unless magnets were detected on all cells of the tag.
    angle_rad : (5,) ndarray
    heading_rad : float
        Heading of the tag in the array's frame; the true one is nominally 0.
    scale : float
        Factor by which the spacing of the tag has scaled lengths along the track.
    residual_sigma : float
    """

    tag_id: int
    is_read: bool
    wrong_bits: int
    position_m: Array
    angle_rad: Array
    heading_rad: float
    scale: float
    residual_sigma: float

    @property
    def unscaled_position_m(self) -> Array:
        """Positions before the spacing of the tag was used to scale them."""
        return self.position_m / [self.scale, 1.0]


def read_runs(folder: Path) -> dict[str, list[Samples]]:
    """Read the published recordings by set.

    Raises
    ------
    LocatkError
        A recording is missing or damaged.
    """
    return {
        name: [
            read_polaris(
                folder / name / f"RawData_{k}.csv",
                rate_hz=SAMPLE_RATE_HZ,
                spacing_m=SENSOR_SPACING_M,
            ).samples
            for k in range(1, count + 1)
        ]
        for name, count in SET_RUNS.items()
    }


def solve_run(samples: Samples, method: str) -> tuple[TagDetection, ...]:
    """Return the detections of one recording; only the published method knows the speed."""
    speed = SPEED_MPS if method == "paper" else None
    return solve([samples], PUBLISHED_TAGS, SolveOptions(method, speed)).detections


def summarize_run(detections: Sequence[TagDetection], tag_id: int) -> PublishedRun:
    """Summarize the detections of one pass over ``tag_id``."""
    cells = layout_of(PUBLISHED_TAGS, tag_id).cells
    ids = [detection.tag_id for detection in detections if detection.tag_id is not None]
    wrong_bits = sum((read_id ^ tag_id).bit_count() for read_id in ids)
    for detection in detections:
        by_cell = {m.cell: m for m in detection.magnets if m.cell is not None}
        if set(by_cell) != set(cells):
            continue
        assert detection.heading_rad is not None  # its magnets are on a grid
        magnets = [by_cell[cell] for cell in cells]
        return PublishedRun(
            tag_id,
            bool(ids),
            wrong_bits,
            np.array([[magnet.x_m, magnet.y_m] for magnet in magnets]),
            np.array([magnet.angle_rad for magnet in magnets]),
            detection.heading_rad,
            detection.scale,
            detection.residual_sigma,
        )
    unknown = np.full((len(cells), 2), np.nan)
    return PublishedRun(
        tag_id, bool(ids), wrong_bits, unknown, unknown[:, 0], math.nan, math.nan, math.nan
    )


def rigid_error(position_m: Array, tag_id: int) -> float:
    """Return the mean distance [mm] of magnets (5, 2) from their cells after a rigid alignment.

    ``nan`` if the magnets were not detected.
    """
    if not np.isfinite(position_m).all():
        return math.nan
    nominal = cell_positions(PUBLISHED_TAGS, layout_of(PUBLISHED_TAGS, tag_id).cells)
    aligned = umeyama(position_m, nominal, with_scale=False).apply(position_m)
    return 1e3 * float(np.linalg.norm(aligned - nominal, axis=1).mean())


def cross_validated_error(position_m: Array, tag_id: int) -> float:
    """Return the mean distance [mm] of each magnet from its cell, predicted by the other four.

    Scale along the track, rotation and translation are fitted to four magnets of (5, 2) positions
    that were not scaled by the tag, so that no magnet takes part in its own alignment. ``nan`` if
    the magnets were not detected.
    """
    if not np.isfinite(position_m).all():
        return math.nan
    nominal = cell_positions(PUBLISHED_TAGS, layout_of(PUBLISHED_TAGS, tag_id).cells)
    errors = []
    for k in range(len(nominal)):
        others = np.arange(len(nominal)) != k

        def misfit(scale: float, others: NDArray[np.bool_] = others) -> float:
            scaled = position_m[others] * [scale, 1.0]
            aligned = umeyama(scaled, nominal[others], with_scale=False).apply(scaled)
            return float(((aligned - nominal[others]) ** 2).sum())

        scale = minimize_scalar(misfit, bounds=SCALE_RANGE, method="bounded").x
        scaled = position_m * [scale, 1.0]
        alignment = umeyama(scaled[others], nominal[others], with_scale=False)
        errors.append(np.linalg.norm(alignment.apply(scaled[k : k + 1]) - nominal[k]))
    return 1e3 * float(np.mean(errors))


def anchored_error(position_m: Array, tag_id: int) -> float:
    """Return the authors' metric [mm]: no rotation, and two anchors instead of the best shift.

    Their coordinates have x to the right and y along the track. Laterally the magnets are
    compared relative to the first of them (v1), along the track relative to the one that is
    passed first: an error of these two counts at all others, and not at themselves.
    """
    column, row = np.array(layout_of(PUBLISHED_TAGS, tag_id).cells, float).T
    nominal = PUBLISHED_TAGS.spacing_m * np.column_stack([column, row])
    estimate = np.column_stack([-position_m[:, 1], position_m[:, 0]])
    estimate = estimate - [estimate[0, 0], estimate[:, 1].min()]
    return 1e3 * float(np.linalg.norm(estimate - nominal, axis=1).mean())


def scatter(angle_rad: Array) -> float:
    """Return the rms [deg] of angles (runs, magnets) about the mean of each magnet."""
    mean = np.angle(np.exp(1j * angle_rad).mean(axis=0))
    deviation = np.angle(np.exp(1j * (angle_rad - mean)))
    return math.degrees(float(np.sqrt(np.mean(deviation**2))))


Statistic = Callable[[Sequence[PublishedRun]], float]


@dataclass(frozen=True)
class DeclaredFigure:
    """Figure without a value, with the statistic and the sets of runs that it is computed from."""

    sets: tuple[str, ...]
    statistic: Statistic
    figure: Figure


def published_figures(folder: Path) -> list[Figure]:
    """Compute the figures of both methods on the published runs."""
    try:
        recordings, error = read_runs(folder), None
    except (LocatkError, OSError) as missing:
        recordings, error = {}, missing
    rows = []
    for method, declared in (("joint", _joint()), ("paper", _paper())):
        solved = {
            name: [summarize_run(solve_run(samples, method), SET_IDS[name]) for samples in runs]
            for name, runs in recordings.items()
        }
        for item in declared:
            if error is not None:
                rows.append(item.figure.missing(error))
            else:
                runs = [run for name in item.sets for run in solved[name]]
                rows.append(replace(item.figure, value=item.statistic(runs)))
    return [*rows, *_duration_figures(folder, error)]


def _mean(statistic: Callable[[PublishedRun], float]) -> Statistic:
    return lambda runs: float(np.mean([statistic(run) for run in runs]))


READ_PERCENT = _mean(lambda run: 100.0 * (run.is_read and not run.wrong_bits))
RIGID_ERROR = _mean(lambda run: rigid_error(run.position_m, run.tag_id))
ANCHORED_ERROR = _mean(lambda run: anchored_error(run.position_m, run.tag_id))
UNSCALED_RIGID_ERROR = _mean(lambda run: rigid_error(run.unscaled_position_m, run.tag_id))
CROSS_VALIDATED_ERROR = _mean(
    lambda run: cross_validated_error(run.unscaled_position_m, run.tag_id)
)
UNSCALED_ANCHORED_ERROR = _mean(lambda run: anchored_error(run.unscaled_position_m, run.tag_id))
ABSOLUTE_HEADING = _mean(lambda run: abs(math.degrees(run.heading_rad)))
PATTERN_HEADING = _mean(lambda run: absolute_pattern_heading_deg(run.position_m))
MEAN_RESIDUAL = _mean(lambda run: run.residual_sigma)


def _wrong_bits(runs: Sequence[PublishedRun]) -> float:
    return float(sum(run.wrong_bits for run in runs))


def _not_read(runs: Sequence[PublishedRun]) -> float:
    return float(sum(not run.is_read for run in runs))


def _scatter(runs: Sequence[PublishedRun]) -> float:
    return scatter(np.array([run.angle_rad for run in runs]))


def _scatter_in_tag(runs: Sequence[PublishedRun]) -> float:
    return scatter(np.array([run.angle_rad - run.heading_rad for run in runs]))


def count_opposite(runs: Sequence[PublishedRun]) -> float:
    """Count the orientations with an error of more than a quarter of a circle."""
    count = 0
    for run in runs:
        nominal = symbol_angles(PUBLISHED_TAGS, layout_of(PUBLISHED_TAGS, run.tag_id).symbols)
        error = np.angle(np.exp(1j * (run.angle_rad - run.heading_rad - nominal)))
        count += int((np.abs(error) > math.pi / 2).sum())
    return float(count)


def absolute_pattern_heading_deg(position_m: Array) -> float:
    """Return the absolute heading by the position pattern alone; ``nan`` if there is none."""
    heading = pattern_heading(position_m) if np.isfinite(position_m).all() else None
    return math.nan if heading is None else abs(math.degrees(heading))


def _joint() -> Iterator[DeclaredFigure]:
    yield from _bits("", 0.0, "authors, 540 bits of 30 runs", 5.0)
    for name, count in SET_RUNS.items():
        title = f"{name}: read as {SET_IDS[name]}"
        yield DeclaredFigure(
            (name,), READ_PERCENT, Figure(title, None, "%", f"of {count} runs", 100.0, "higher")
        )
    ruler = "speed unknown; lengths along the track scaled by the tag's 40 mm"
    aligned = f"mean over magnets and runs, best rotation and translation; {ruler}"
    for name, target in (("default", 0.75), ("varying", 0.80)):
        yield _rigid(name, "", aligned, target)
    anchored = f"relative to v1 and to the first magnet, no alignment; {ruler}"
    for name, target in (("default", 1.5), ("varying", 1.6)):
        yield _anchored(name, "", anchored, target)
    without = "the same fit, but lengths along the track by the field's shape alone"
    for name in SET_RUNS:
        yield _rigid(name, ", without the ruler", without, None, UNSCALED_RIGID_ERROR)
        yield _anchored(name, ", without the ruler", without, None, UNSCALED_ANCHORED_ERROR)
    validated = "scale along the track and alignment by four magnets, error of the fifth; mean"
    for name in SET_RUNS:
        yield DeclaredFigure(
            (name,), CROSS_VALIDATED_ERROR,
            Figure(f"{name}: position, cross-validated ruler", None, "mm", validated),
        )  # fmt: skip
    own = "rms about the mean of each magnet over the runs"
    for name, peer in SCATTER_DEG.items():
        for label, how, statistic in (
            ("", f"{own}, directions in the array's frame", _scatter),
            (", tag's frame", f"{own}, directions less the run's heading", _scatter_in_tag),
        ):
            title = f"{name}: orientation scatter{label}"
            yield DeclaredFigure(
                (name,), statistic,
                Figure(title, None, "deg", how, 0.65, peer=AUTHORS[name], peer_value=peer),
            )  # fmt: skip
    yield from _headings("", dict.fromkeys(SET_RUNS, 0.5), 0.5)
    for name in SET_RUNS:
        how = "rms in standard deviations of the noise, mean of the runs"
        yield DeclaredFigure(
            (name,), MEAN_RESIDUAL, Figure(f"{name}: residual", None, "sigma", how)
        )


def _paper() -> Iterator[DeclaredFigure]:
    label, speed = ", --method paper", f"speed known: {SPEED_MPS} m/s, as the authors did"
    yield from _bits(label, SAME_RUNS_WRONG_BITS, SAME_RUNS, SAME_RUNS_WRONG_BITS)
    for name, count in SET_RUNS.items():
        read = SAME_RUNS_READ_PERCENT[name]
        title = f"{name}: read as {SET_IDS[name]}{label}"
        yield DeclaredFigure(
            (name,), READ_PERCENT,
            Figure(title, None, "%", f"of {count} runs", read, "higher", SAME_RUNS, read),
        )  # fmt: skip
    for name in SET_RUNS:
        yield _rigid(name, label, f"mean over magnets and runs; {speed}", RIGID_MM[name])
        same = f"the authors on the same runs: {SAME_RUNS_ANCHORED_MM[name]} mm"
        yield _anchored(name, label, f"no alignment; {speed}; {same}", ANCHORED_MM[name])
        how = "rms about the mean of each magnet over the runs, templates every 10 deg"
        yield DeclaredFigure(
            (name,), _scatter,
            Figure(f"{name}: orientation scatter{label}", None, "deg", how, SCATTER_DEG[name],
                   peer=AUTHORS[name], peer_value=SCATTER_DEG[name]),
        )  # fmt: skip
        yield DeclaredFigure(
            (name,), count_opposite,
            Figure(f"{name}: orientations off by more than 90 deg{label}", None, "magnets",
                   f"of {5 * SET_RUNS[name]}, against the tag's layout", 0.0),
        )  # fmt: skip
    yield from _headings(label, HEADING_DEG)
    for name in SET_RUNS:
        how = "mean absolute, from the centroid of v1, v2 and v3 to v2, as the authors' program"
        peer = SAME_RUNS_HEADING_DEG[name]
        yield DeclaredFigure(
            (name,), PATTERN_HEADING,
            Figure(f"{name}: heading of the position pattern{label}", None, "deg", how, peer,
                   peer=SAME_RUNS, peer_value=peer),
        )  # fmt: skip


def _bits(label: str, target: float, peer: str, peer_value: float) -> Iterator[DeclaredFigure]:
    """Declare the numbers of wrong bits, and of runs that were refused."""
    for title, value, figure in (
        ("wrong bits", _wrong_bits,
         Figure("", None, "bits", "of all ids that were read, 18 bits each", target,
                peer=peer, peer_value=peer_value)),
        ("not read", _not_read,
         Figure("", None, "runs", "of 13: refused instead of guessed", 0.0)),
    ):  # fmt: skip
        yield DeclaredFigure(
            tuple(SET_RUNS), value, replace(figure, name=f"published runs: {title}{label}")
        )


def _rigid(
    name: str, label: str, how: str, target: float | None, statistic: Statistic = RIGID_ERROR
) -> DeclaredFigure:
    title = f"{name}: position, rigid-aligned{label}"
    return DeclaredFigure(
        (name,), statistic,
        Figure(title, None, "mm", how, target, peer=AUTHORS[name], peer_value=RIGID_MM[name]),
    )  # fmt: skip


def _anchored(
    name: str, label: str, how: str, target: float | None, statistic: Statistic = ANCHORED_ERROR
) -> DeclaredFigure:
    title = f"{name}: position, authors' metric{label}"
    return DeclaredFigure(
        (name,), statistic,
        Figure(title, None, "mm", how, target, peer=AUTHORS[name], peer_value=ANCHORED_MM[name]),
    )  # fmt: skip


def _headings(
    label: str, targets: Mapping[str, float], target: float | None = None
) -> Iterator[DeclaredFigure]:
    """Declare the mean absolute headings of each set, and of all runs."""
    how = "mean absolute, no alignment; true headings are nominally 0, set by hand"
    for name, peer in HEADING_DEG.items():
        title = f"{name}: heading{label}"
        yield DeclaredFigure(
            (name,), ABSOLUTE_HEADING,
            Figure(title, None, "deg", how, targets[name], peer=AUTHORS[name], peer_value=peer),
        )  # fmt: skip
    title = f"published runs: heading{label}"
    yield DeclaredFigure(tuple(SET_RUNS), ABSOLUTE_HEADING, Figure(title, None, "deg", how, target))


# ---- duration of a run


def _duration_figures(folder: Path, error: Exception | None) -> Iterator[Figure]:
    how = "solve() from arrays in memory: processor time, one thread, best of 3 of each run"
    for method, label, target in (("joint", "", 0.1), ("paper", ", --method paper", None)):
        declared = [
            Figure(f"time a run, median{label}", None, "s", how, target, workload="numpy"),
            Figure(f"time a run, mean{label}", None, "s", how, target, workload="numpy"),
            Figure(f"time a run, longest{label}", None, "s", how, workload="numpy"),
        ]
        reason: Exception | None = error
        if reason is None:
            try:
                *seconds, factor = run_single_threaded(
                    f"polaris.suite.time_runs({str(folder)!r}, {method!r})"
                )
            except OSError as failure:
                reason = failure
        if reason is not None:
            yield from (figure.missing(reason) for figure in declared)
        else:
            for figure, duration_s in zip(declared, seconds, strict=True):
                yield figure.timed(Duration(duration_s, factor))


def time_runs(folder: str, method: str) -> tuple[float, float, float, float]:
    """Return median, mean and longest duration [s] of a published run, and the machine factor."""
    runs = [samples for runs in read_runs(Path(folder)).values() for samples in runs]
    calls = [partial(solve_run, samples, method) for samples in runs]
    seconds, factor = time_each(calls, 3)
    return float(np.median(seconds)), float(np.mean(seconds)), max(seconds), factor
