"""The figures of the published recordings, computed here and not by the bench.

Peers and protocols: the scripts that the authors of the Lighthouse paper published with their
recordings (github.com/DotBots/alvarado23lighthouse), run again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.evaluation import (
    Evaluation,
    EvaluationOptions,
    estimate_offset,
    evaluate,
)
from locatk.core.geometry import umeyama
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Distance, MarkerVisit, Scene
from locatk.core.lighthouse.solver import SolveOptions, solve
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.dotbot.recording import read_dotbot

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]
Pairs = list[tuple[Trajectory, Trajectory]]


# ---- two stations in space: a grid of 140 places


@dataclass(frozen=True)
class Grid:
    sweeps: Sweeps
    truth: Array  # (m, 3) in mm, one row a moment
    time_ns: NDArray[np.int64]

    def edge(self) -> Scene:
        """One 40 mm edge of the grid, as the paper's protocol has it."""

        def stay(place: tuple[int, int, int]) -> MarkerVisit:
            there = self.time_ns[np.all(self.truth == place, axis=1)]
            return MarkerVisit(self.sweeps.devices[0], int(there.min()), int(there.max()))

        return Scene(distances=(Distance(stay((0, 0, 0)), stay((40, 0, 0)), 0.040),))


@pytest.fixture(scope="module")
def grid(recordings: Path) -> Grid:
    session = read_dotbot([recordings / "twoLH-3D_scene" / "dataset" / "data_all.csv"], [])
    (truth,) = session.truth
    return Grid(session.sweeps, truth.position * 1e3, truth.time_ns)


def at(solution: Solution, grid: Grid) -> tuple[Array, Array]:
    """Poses in mm (or units) and the places they belong to."""
    (track,) = solution.trajectories
    row = np.searchsorted(grid.time_ns, track.time_ns)
    np.testing.assert_array_equal(grid.time_ns[row], track.time_ns)
    return track.position * 1e3, grid.truth[row]


def misses(position: Array, truth: Array, *, with_scale: bool) -> Array:
    to = umeyama(position, truth, with_scale=with_scale)
    return np.asarray(np.linalg.norm(to.apply(position) - truth, axis=1))


def to_one_edge(position: Array, truth: Array) -> Array:
    """The paper's scale: the mean places of one 40 mm edge are 40 mm apart."""
    ends = [position[np.all(truth == p, axis=1)].mean(axis=0) for p in ((0, 0, 0), (40, 0, 0))]
    return np.asarray(position * 40 / np.linalg.norm(ends[1] - ends[0]))


def test_grid_by_the_papers_scale(grid: Grid) -> None:
    # Authors' script 5.20; the scale is that of the solver, from the counts of one edge.
    solution = solve(grid.sweeps, grid.edge())
    position, truth = at(solution, grid)
    assert solution.artifact.planar is False  # decided from the data
    assert solution.artifact.scale == "distance"
    assert len(position) > 0.995 * len(grid.truth)
    assert misses(position, truth, with_scale=False).mean() <= 2.3
    assert misses(to_one_edge(position, truth), truth, with_scale=False).mean() <= 2.3


def test_grid_by_similarity(grid: Grid) -> None:
    solution = solve(grid.sweeps)
    position, truth = at(solution, grid)
    assert solution.artifact.scale == "unit"
    assert misses(position, truth, with_scale=True).mean() <= 0.95


def test_grid_by_the_papers_method_is_that_of_the_authors_scripts(grid: Grid) -> None:
    solution = solve(grid.sweeps, None, SolveOptions(method="paper", scene="two-3d"))
    position, truth = at(solution, grid)
    edge = misses(to_one_edge(position, truth), truth, with_scale=False)
    assert edge.mean() == pytest.approx(5.196, rel=0.05)
    assert np.sqrt(np.mean(edge**2)) == pytest.approx(5.722, rel=0.05)
    assert misses(position, truth, with_scale=True).mean() == pytest.approx(4.95, rel=0.05)


def test_grid_scatter_at_rest(grid: Grid) -> None:
    position, truth = at(solve(grid.sweeps), grid)
    still = umeyama(position, truth).apply(position)
    _, place = np.unique(truth, axis=0, return_inverse=True)
    scatter = np.mean([still[place == k].std(axis=0) for k in range(140)], axis=0)
    assert scatter[0] <= 0.087
    assert scatter[1] <= 0.262
    # 0.135 was measured in heights that planes of 30 degrees make 8 % too short.
    assert scatter[2] <= 0.135 * 1.085


def test_grid_covariance_matches_the_scatter(grid: Grid) -> None:
    # What repeats at a standstill is noise; the rest of the covariance is calibration.
    solution = solve(grid.sweeps, grid.edge())
    (track,) = solution.trajectories
    _, truth = at(solution, grid)
    _, place = np.unique(truth, axis=0, return_inverse=True)
    found = np.mean([track.position[place == k].std(axis=0) for k in range(140)], axis=0)
    assert np.all(np.median(track.sigma[:, :3], axis=0) > found)
    assert np.all(np.median(track.sigma[:, :3], axis=0) < 12 * found)


@pytest.mark.parametrize(("places", "paper_mm"), [(8, 25.2), (20, 11.2), (100, 6.7)])
def test_grid_from_few_places(grid: Grid, places: int, paper_mm: float) -> None:
    # The paper's Fig. 12; the bench does this sixty times for each number.
    rng = np.random.default_rng(0)
    _, place = np.unique(grid.truth, axis=0, return_inverse=True)
    errors = []
    for _ in range(4):
        chosen = rng.choice(140, places, replace=False)
        rows = np.array([rng.choice(np.flatnonzero(place == k)) for k in chosen])
        index = (rows[:, None] * 4 + np.arange(4)).ravel()
        columns = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
        few = replace(grid.sweeps, **{c: getattr(grid.sweeps, c)[index] for c in columns})
        scene = solve(few, None, SolveOptions(scene="two-3d")).artifact
        position, truth = at(solve(grid.sweeps, scene), grid)
        scaled = to_one_edge(position, truth)
        errors.append(misses(scaled, truth, with_scale=False).mean())
    assert np.mean(errors) < paper_mm


@pytest.mark.parametrize("seed", [1, 2])
def test_grid_does_not_hang_on_order_or_seed(grid: Grid, seed: int, world: Any) -> None:
    reference, truth = at(solve(grid.sweeps), grid)
    order = np.random.default_rng(seed).permutation(len(grid.sweeps))
    solution = solve(world.take(grid.sweeps, order), None, SolveOptions(seed=seed))
    position, _ = at(solution, grid)
    assert len(position) == len(reference)
    np.testing.assert_allclose(
        umeyama(position, reference).apply(position), reference, atol=2e-4 * np.ptp(reference)
    )
    assert misses(position, truth, with_scale=True).mean() <= 0.95


# ---- two stations over a floor


@pytest.fixture(scope="module")
def floor(recordings: Path) -> tuple[Sweeps, list[list[Trajectory]], Scene]:
    folder = recordings / "twoLH-2D_scene" / "dataset"
    path = folder / "lighthouse" / "data.csv"
    truths = [
        read_dotbot([path], [folder / "ground_truth" / f"{k}_blender.csv"]).truth
        for k in range(1, 6)
    ]
    session = read_dotbot([path], [])
    assert session.scene is not None
    return session.sweeps, truths, session.scene


def pairs_of(solution: Solution, truths: list[Trajectory]) -> Pairs:
    named = {t.device: t for t in solution.trajectories}
    return [(named[t.device], t) for t in truths]


def test_floor_by_the_authors_alignment(floor: Any) -> None:
    # One scene from all robots without markers; authors' offset; authors' script 4.35.
    sweeps, truths, _ = floor
    solution = solve(sweeps)
    assert solution.artifact.planar is True  # decided from the data
    every = [pair for truth in truths for pair in pairs_of(solution, truth)]
    score = evaluate(every, EvaluationOptions(align="sim3", offset_s=-0.265))
    assert score.n > 1100
    assert 1e3 * score.mae <= 2.9


def test_floor_swapped_sweeps_are_given_back(floor: Any) -> None:
    sweeps, truths, _ = floor
    solution = solve(sweeps)
    restored = solution.facts.restored_swapped_epochs
    assert 650 < restored < 800
    # Between experiments robots are carried, off the floor; within them few moments are lost.
    seen = lost = 0
    for truth in truths:
        for true in truth:
            mine = sweeps.device == sweeps.devices.index(true.device)
            moments = np.unique(sweeps.time_ns[mine])
            moments = moments[(moments >= true.time_ns[0]) & (moments <= true.time_ns[-1])]
            (track,) = (t for t in solution.trajectories if t.device == true.device)
            seen += len(moments)
            lost += int(np.count_nonzero(~np.isin(moments, track.time_ns)))
    assert seen > 1150
    assert lost < 0.03 * seen


def test_floor_with_its_markers_is_in_metres(floor: Any) -> None:
    sweeps, truths, scene = floor
    solution = solve(sweeps, scene)
    assert solution.artifact.scale == "markers"
    every = [pair for truth in truths for pair in pairs_of(solution, truth)]
    score = evaluate(every, EvaluationOptions(offset_s=-0.265))
    assert 1e3 * score.mae < 6  # the frame of four markers, no alignment


def test_floor_does_not_hang_on_order_seed_or_names(floor: Any, world: Any) -> None:
    sweeps, truths, _ = floor
    order = np.random.default_rng(0).permutation(len(sweeps))
    solution = solve(world.take(sweeps, order), None, SolveOptions(seed=3))
    every = [pair for truth in truths for pair in pairs_of(solution, truth)]
    score = evaluate(every, EvaluationOptions(align="sim3", offset_s=-0.265))
    assert 1e3 * score.mae <= 2.9


def test_floor_by_the_papers_method_is_near_that_of_the_authors(floor: Any) -> None:
    # 4.35 from hand-picked signs and markers; the automatic choice must find the same world.
    sweeps, truths, _ = floor
    solution = solve(sweeps, None, SolveOptions(method="paper", scene="two-planar"))
    every = [pair for truth in truths for pair in pairs_of(solution, truth)]
    score = evaluate(every, EvaluationOptions(align="sim3", offset_s=-0.265))
    assert 1e3 * score.mae < 4.6


# ---- one station over a floor


@pytest.fixture(scope="module")
def alone(recordings: Path) -> list[Any]:
    folder = recordings / "oneLH-2D_scene" / "dataset"
    return [
        read_dotbot(
            [folder / "lighthouse" / f"{k}_lh2.csv"],
            [folder / "ground_truth" / f"{k}_blender.csv"],
        )
        for k in range(1, 6)
    ]


def leave_one_out(experiments: list[Pairs]) -> Evaluation:
    """Each experiment scored with the time offset that the other four ask for."""
    shifted: Pairs = []
    for k, pairs in enumerate(experiments):
        others = [pair for j, e in enumerate(experiments) if j != k for pair in e]
        later = round(estimate_offset(others) * 1e9)
        shifted += [(replace(e, time_ns=e.time_ns + later), t) for e, t in pairs]
    return evaluate(shifted)


def test_one_station_without_any_alignment(alone: list[Any]) -> None:
    # Authors' script 7.01 with an offset of 0.318 s.
    experiments = [
        pairs_of(solve(session.sweeps, session.scene), session.truth) for session in alone
    ]
    score = leave_one_out(experiments)
    assert score.n > 750
    assert 1e3 * score.mae <= 3.4


def test_one_station_by_the_papers_method_and_offset(alone: list[Any]) -> None:
    every: Pairs = []
    for session in alone:
        options = SolveOptions(method="paper")
        every += pairs_of(solve(session.sweeps, session.scene, options), session.truth)
    score = evaluate(every, EvaluationOptions(offset_s=-0.318109))
    assert score.n == pytest.approx(824, abs=15)
    assert 1e3 * score.mae == pytest.approx(7.01, rel=0.05)
