"""The figures of Polaris: the published recordings, simulations, and speed.

The recordings are those of the paper's authors: ten runs over their default tag and three
over one of varying orientations, read as ``locatk import polaris-csv --rate 40 --spacing 20``
does. Nobody measured where the tags lay: the truth is their layout, and a car that was set
straight by hand. So nothing is known of the pose, and places are scored against each other:

- *rigid-aligned*: mean distance of the magnets from their cells after the rotation and
  translation that fit best, with no scale.
- *authors' metric*: as ``sensing_offline.py`` of the released code has it, with no rotation;
  see :func:`anchored_error`.

No figure of a run is fitted on its truth but for that alignment. Along the track the default
method measures with the tag's known spacing as a ruler, which is part of solving (the speed
is not told to it); rows "without the ruler" take that back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.geometry import umeyama
from locatk.core.polaris.array import Samples
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.published.pipeline import pattern_heading
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import cell_positions, symbol_angles
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.polaris.speed import speed_figures
from locatk.formats.benchmarks.polaris.study import study_figures
from locatk.formats.benchmarks.timing import alone, cpu_seconds
from locatk.formats.importers.polaris_csv import PUBLISHED_TAGS, read_polaris

Array = NDArray[np.float64]

RATE_HZ, SPACING_M = 40.0, 0.020
SPEED_MPS = 0.105
"""Of the published runs, as the released code has them."""

RUNS = {"default": 10, "varying": 3}
IDS = {"default": 262143, "varying": 255183}
"""Sets, their runs, and the id of their tag in the released table."""

RIGID_MM = {"default": 1.46, "varying": 2.36}
ANCHORED_MM = {"default": 1.68, "varying": 2.71}
"""Position errors of the authors' own results in both metrics, from their program (wjk5117/Polaris
on GitHub) run again on the ten recordings of each set."""

SCATTER_DEG = {"default": 4.7, "varying": 9.8}
HEADING_DEG = {"default": 1.14, "varying": 1.78}
"""Scatter of orientations and mean absolute headings of the authors' own results."""

SAME_RUNS = "authors, the same runs"
SAME_RUNS_WRONG_BITS = 1.0
SAME_RUNS_READ_PERCENT = {"default": 90.0, "varying": 100.0}
SAME_RUNS_ANCHORED_MM = {"default": 1.68, "varying": 2.01}
SAME_RUNS_HEADING_DEG = {"default": 1.14, "varying": 2.21}
"""The authors' results on the 13 runs alone, from ``Evaluation/Results`` of their repository."""

PEERS = {"default": "authors", "varying": "authors, ten runs of the set"}
"""Of the set of varying orientations only three of its ten runs are in the data folder."""


def figures(data: Path) -> list[Figure]:
    """All figures of Polaris; ``data`` is the folder of published recordings."""
    folder = data / "polaris"
    return [*published_figures(folder), *study_figures(), *speed_figures()]


# ---- the published runs


@dataclass(frozen=True)
class Run:
    """What was found in one recording. The tag's five magnets are in the order of its cells.

    Attributes
    ----------
    tag_id : int
        The true one.
    read : bool
        Whether any id was.
    wrong_bits : int
        Of the ids that were read.
    place_m : (5, 2) ndarray
        In the array's frame; ``nan`` where the magnets were not found on the tag's cells.
    angle_rad : (5,) ndarray
    heading_rad : float
        Of the tag in the array's frame; the true one is nominally 0.
    scale : float
        By which the tag as a ruler has stretched lengths along the track.
    residual_sigma : float
    """

    tag_id: int
    read: bool
    wrong_bits: int
    place_m: Array
    angle_rad: Array
    heading_rad: float
    scale: float
    residual_sigma: float

    @property
    def unruled_m(self) -> Array:
        """Places as they were found before the tag served as ruler."""
        return self.place_m / [self.scale, 1.0]


def read_runs(folder: Path) -> dict[str, list[Samples]]:
    """The published recordings by set.

    Raises
    ------
    LocatkError
        One is not there, or cannot be read.
    """
    return {
        name: [
            read_polaris(
                folder / name / f"RawData_{k}.csv", rate_hz=RATE_HZ, spacing_m=SPACING_M
            ).samples
            for k in range(1, count + 1)
        ]
        for name, count in RUNS.items()
    }


def solve_run(samples: Samples, method: str) -> tuple[TagDetection, ...]:
    """Detections of one recording. The published algorithm is told the speed."""
    speed = SPEED_MPS if method == "paper" else None
    return solve([samples], PUBLISHED_TAGS, SolveOptions(method, speed)).detections


def as_run(detections: Sequence[TagDetection], tag_id: int) -> Run:
    """What detections of one pass over ``tag_id`` say of it."""
    cells = layout_of(PUBLISHED_TAGS, tag_id).cells
    ids = [found.tag_id for found in detections if found.tag_id is not None]
    wrong = sum((one ^ tag_id).bit_count() for one in ids)
    for found in detections:
        by_cell = {m.cell: m for m in found.magnets if m.cell is not None}
        if set(by_cell) != set(cells):
            continue
        assert found.heading_rad is not None  # its magnets are on a grid
        magnets = [by_cell[cell] for cell in cells]
        return Run(
            tag_id,
            bool(ids),
            wrong,
            np.array([[magnet.x_m, magnet.y_m] for magnet in magnets]),
            np.array([magnet.angle_rad for magnet in magnets]),
            found.heading_rad,
            found.scale,
            found.residual_sigma,
        )
    nowhere = np.full((len(cells), 2), np.nan)
    return Run(tag_id, bool(ids), wrong, nowhere, nowhere[:, 0], math.nan, math.nan, math.nan)


def rigid_error(place_m: Array, tag_id: int) -> float:
    """Mean distance in mm of magnets (5, 2) from their cells, after the best rotation and
    translation; ``nan`` where they were not found."""
    if not np.isfinite(place_m).all():
        return math.nan
    nominal = cell_positions(PUBLISHED_TAGS, layout_of(PUBLISHED_TAGS, tag_id).cells)
    aligned = umeyama(place_m, nominal, with_scale=False).apply(place_m)
    return 1e3 * float(np.linalg.norm(aligned - nominal, axis=1).mean())


def anchored_error(place_m: Array, tag_id: int) -> float:
    """The authors' metric in mm: no rotation, and two anchors in place of the best shift.

    Their coordinates have x to the right and y along the track. Laterally the magnets are
    compared relative to the first of them (v1), along the track relative to the one that
    is passed first: whatever is wrong with these two is counted at all others, and nothing
    at themselves.
    """
    column, row = np.array(layout_of(PUBLISHED_TAGS, tag_id).cells, float).T
    nominal = PUBLISHED_TAGS.spacing_m * np.column_stack([column, row])
    found = np.column_stack([-place_m[:, 1], place_m[:, 0]])
    found = found - [found[0, 0], found[:, 1].min()]
    return 1e3 * float(np.linalg.norm(found - nominal, axis=1).mean())


def scatter(angle_rad: Array) -> float:
    """Rms in degrees of angles (runs, magnets) about each magnet's own mean over the runs."""
    mean = np.angle(np.exp(1j * angle_rad).mean(axis=0))
    away = np.angle(np.exp(1j * (angle_rad - mean)))
    return math.degrees(float(np.sqrt(np.mean(away**2))))


Value = Callable[[Sequence[Run]], float]


@dataclass(frozen=True)
class Measure:
    """A row of the published runs: a figure that waits for its value, and whose it is."""

    sets: tuple[str, ...]
    value: Value
    figure: Figure


def published_figures(folder: Path) -> list[Figure]:
    """Figures of both methods on the published runs, without values where those are absent."""
    try:
        recordings, absent = read_runs(folder), ""
    except (LocatkError, OSError) as error:
        recordings, absent = {}, f"not measured: {error}"
    rows = []
    for method, measures in (("joint", _joint()), ("paper", _paper())):
        solved = {
            name: [as_run(solve_run(samples, method), IDS[name]) for samples in runs]
            for name, runs in recordings.items()
        }
        for measure in measures:
            if absent:
                rows.append(replace(measure.figure, how=absent))
            else:
                runs = [run for name in measure.sets for run in solved[name]]
                rows.append(replace(measure.figure, value=measure.value(runs)))
    return [*rows, *_times(folder, absent)]


def _mean(of: Callable[[Run], float]) -> Value:
    return lambda runs: float(np.mean([of(run) for run in runs]))


READ = _mean(lambda run: 100.0 * (run.read and not run.wrong_bits))
RIGID = _mean(lambda run: rigid_error(run.place_m, run.tag_id))
ANCHORED = _mean(lambda run: anchored_error(run.place_m, run.tag_id))
RIGID_UNRULED = _mean(lambda run: rigid_error(run.unruled_m, run.tag_id))
ANCHORED_UNRULED = _mean(lambda run: anchored_error(run.unruled_m, run.tag_id))
HEADING = _mean(lambda run: abs(math.degrees(run.heading_rad)))
PATTERN_HEADING = _mean(lambda run: _pattern_heading_deg(run.place_m))
RESIDUAL = _mean(lambda run: run.residual_sigma)


def _wrong(runs: Sequence[Run]) -> float:
    return float(sum(run.wrong_bits for run in runs))


def _not_read(runs: Sequence[Run]) -> float:
    return float(sum(not run.read for run in runs))


def _scatter(runs: Sequence[Run]) -> float:
    return scatter(np.array([run.angle_rad for run in runs]))


def _scatter_in_tag(runs: Sequence[Run]) -> float:
    return scatter(np.array([run.angle_rad - run.heading_rad for run in runs]))


def _half_turns(runs: Sequence[Run]) -> float:
    """Number of orientations that are off by more than a quarter of a circle."""
    count = 0
    for run in runs:
        nominal = symbol_angles(PUBLISHED_TAGS, layout_of(PUBLISHED_TAGS, run.tag_id).symbols)
        off = np.angle(np.exp(1j * (run.angle_rad - run.heading_rad - nominal)))
        count += int((np.abs(off) > math.pi / 2).sum())
    return float(count)


def _pattern_heading_deg(place_m: Array) -> float:
    """Absolute heading by the position pattern alone; ``nan`` where there is none."""
    heading = pattern_heading(place_m) if np.isfinite(place_m).all() else None
    return math.nan if heading is None else abs(math.degrees(heading))


def _joint() -> Iterator[Measure]:
    yield from _bits("", 0.0, "authors, 540 bits of 30 runs", 5.0)
    for name, count in RUNS.items():
        title = f"{name}: read as {IDS[name]}"
        yield Measure((name,), READ, Figure(title, None, "%", f"of {count} runs", 100.0, "higher"))
    ruler = "speed unknown; lengths along the track by the tag's 40 mm as ruler"
    aligned = f"mean over magnets and runs, best rotation and translation; {ruler}"
    for name, target in (("default", 0.75), ("varying", 0.80)):
        yield _rigid(name, "", aligned, target)
    anchored = f"relative to v1 and to the first magnet, no alignment; {ruler}"
    for name, target in (("default", 1.5), ("varying", 1.6)):
        yield _anchored(name, "", anchored, target)
    without = "the same fit, but lengths along the track by the field's shape alone"
    for name in RUNS:
        yield _rigid(name, ", without the ruler", without, None, RIGID_UNRULED)
        yield _anchored(name, ", without the ruler", without, None, ANCHORED_UNRULED)
    own = "rms about each magnet's own mean over the runs"
    for name, peer in SCATTER_DEG.items():
        for label, how, value in (
            ("", f"{own}, directions in the array's frame", _scatter),
            (", tag's frame", f"{own}, directions less the run's heading", _scatter_in_tag),
        ):
            title = f"{name}: orientation scatter{label}"
            yield Measure(
                (name,), value,
                Figure(title, None, "deg", how, 0.65, peer=PEERS[name], peer_value=peer),
            )  # fmt: skip
    yield from _headings("", dict.fromkeys(RUNS, 0.5), 0.5)
    for name in RUNS:
        how = "rms in standard deviations of the noise, mean of the runs"
        yield Measure((name,), RESIDUAL, Figure(f"{name}: residual", None, "sigma", how))


def _paper() -> Iterator[Measure]:
    label, speed = ", --method paper", f"speed known: {SPEED_MPS} m/s, as the authors did"
    yield from _bits(label, SAME_RUNS_WRONG_BITS, SAME_RUNS, SAME_RUNS_WRONG_BITS)
    for name, count in RUNS.items():
        read = SAME_RUNS_READ_PERCENT[name]
        title = f"{name}: read as {IDS[name]}{label}"
        yield Measure(
            (name,), READ,
            Figure(title, None, "%", f"of {count} runs", read, "higher", SAME_RUNS, read),
        )  # fmt: skip
    for name in RUNS:
        yield _rigid(name, label, f"mean over magnets and runs; {speed}", RIGID_MM[name])
        same = f"the authors on the same runs: {SAME_RUNS_ANCHORED_MM[name]} mm"
        yield _anchored(name, label, f"no alignment; {speed}; {same}", ANCHORED_MM[name])
        how = "rms about each magnet's own mean over the runs, templates every 10 deg"
        yield Measure(
            (name,), _scatter,
            Figure(f"{name}: orientation scatter{label}", None, "deg", how, SCATTER_DEG[name],
                   peer=PEERS[name], peer_value=SCATTER_DEG[name]),
        )  # fmt: skip
        yield Measure(
            (name,), _half_turns,
            Figure(f"{name}: orientations off by more than 90 deg{label}", None, "magnets",
                   f"of {5 * RUNS[name]}, against the tag's layout", 0.0),
        )  # fmt: skip
    yield from _headings(label, HEADING_DEG)
    for name in RUNS:
        how = "mean absolute, from the centroid of v1, v2 and v3 to v2, as the authors' program"
        peer = SAME_RUNS_HEADING_DEG[name]
        yield Measure(
            (name,), PATTERN_HEADING,
            Figure(f"{name}: heading of the position pattern{label}", None, "deg", how, peer,
                   peer=SAME_RUNS, peer_value=peer),
        )  # fmt: skip


def _bits(label: str, target: float, peer: str, peer_value: float) -> Iterator[Measure]:
    """Wrong bits, and runs that were refused."""
    for title, value, figure in (
        ("wrong bits", _wrong,
         Figure("", None, "bits", "of all ids that were read, 18 bits each", target,
                peer=peer, peer_value=peer_value)),
        ("not read", _not_read,
         Figure("", None, "runs", "of 13: refused instead of guessed", 0.0)),
    ):  # fmt: skip
        yield Measure(tuple(RUNS), value, replace(figure, name=f"published runs: {title}{label}"))


def _rigid(name: str, label: str, how: str, target: float | None, value: Value = RIGID) -> Measure:
    title = f"{name}: position, rigid-aligned{label}"
    return Measure(
        (name,), value,
        Figure(title, None, "mm", how, target, peer=PEERS[name], peer_value=RIGID_MM[name]),
    )  # fmt: skip


def _anchored(
    name: str, label: str, how: str, target: float | None, value: Value = ANCHORED
) -> Measure:
    title = f"{name}: position, authors' metric{label}"
    return Measure(
        (name,), value,
        Figure(title, None, "mm", how, target, peer=PEERS[name], peer_value=ANCHORED_MM[name]),
    )  # fmt: skip


def _headings(
    label: str, targets: Mapping[str, float], target: float | None = None
) -> Iterator[Measure]:
    """Mean absolute headings of each set, and of all runs."""
    how = "mean absolute, no alignment; true headings are nominally 0, set by hand"
    for name, peer in HEADING_DEG.items():
        title = f"{name}: heading{label}"
        yield Measure(
            (name,), HEADING,
            Figure(title, None, "deg", how, targets[name], peer=PEERS[name], peer_value=peer),
        )  # fmt: skip
    title = f"published runs: heading{label}"
    yield Measure(tuple(RUNS), HEADING, Figure(title, None, "deg", how, target))


# ---- time a run

KINDS = ("median", "mean", "longest")


def _times(folder: Path, absent: str) -> list[Figure]:
    how = "solve() from arrays in memory: processor time, one thread, best of 3 of each run"
    rows = []
    for method, target in (("joint", 0.1), ("paper", None)):
        label = "" if method == "joint" else ", --method paper"
        seconds: list[float | None] = [None] * len(KINDS)
        said = absent
        if not absent:
            try:
                seconds = list(alone(f"polaris.suite.run_times({str(folder)!r}, {method!r})"))
            except OSError as error:
                said = f"not measured: {error}"
        for kind, value in zip(KINDS, seconds, strict=True):
            promised = None if kind == "longest" else target
            rows.append(Figure(f"time a run, {kind}{label}", value, "s", said or how, promised))
    return rows


def run_times(folder: str, method: str) -> tuple[float, float, float]:
    """Seconds of processor time that a published run takes: median, mean and longest."""
    runs = [samples for runs in read_runs(Path(folder)).values() for samples in runs]
    seconds = [cpu_seconds(lambda one=samples: solve_run(one, method), 3) for samples in runs]  # type: ignore[misc]
    return float(np.median(seconds)), float(np.mean(seconds)), max(seconds)
