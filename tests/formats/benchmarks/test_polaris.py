"""The benchmark of Polaris: every target has its row, and scores are correct."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.polaris import codec
from locatk.core.polaris.published.ddtw import distances, prepare
from locatk.core.polaris.results import MagnetDetection, TagDetection
from locatk.core.polaris.simulation.session import SimulatedSession, SimulationOptions, simulate
from locatk.core.polaris.tag import Tags, cell_positions, symbol_angles
from locatk.formats.benchmarks import timing
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.polaris import designs, disturbances, given_speeds
from locatk.formats.benchmarks.polaris import passes as polaris_passes
from locatk.formats.benchmarks.polaris import speed as polaris_speed
from locatk.formats.benchmarks.polaris import suite as polaris

PROMISED = {
    "published runs: wrong bits": 0.0,
    "default: read as 262143": 100.0,
    "varying: read as 255183": 100.0,
    "default: position, rigid-aligned": 0.75,
    "varying: position, rigid-aligned": 0.80,
    "default: position, authors' metric": 1.5,
    "varying: position, authors' metric": 1.6,
    "default: orientation scatter": 0.65,
    "varying: orientation scatter": 0.65,
    "default: heading": 0.5,
    "varying: heading": 0.5,
    "time a run, median": 0.1,
    "time a run, mean": 0.1,
    "default: position, rigid-aligned, --method paper": 1.46,
    "varying: position, rigid-aligned, --method paper": 2.36,
    "default: position, authors' metric, --method paper": 1.68,
    "varying: position, authors' metric, --method paper": 2.71,
    "published runs: wrong bits, --method paper": 1.0,
    "published runs: not read, --method paper": 0.0,
    "default: read as 262143, --method paper": 90.0,
    "varying: read as 255183, --method paper": 100.0,
    "default: orientation scatter, --method paper": 4.7,
    "varying: orientation scatter, --method paper": 9.8,
    "default: orientations off by more than 90 deg, --method paper": 0.0,
    "varying: orientations off by more than 90 deg, --method paper": 0.0,
    "default: heading, --method paper": 1.14,
    "varying: heading, --method paper": 1.78,
    "default: heading of the position pattern, --method paper": 1.14,
    "varying: heading of the position pattern, --method paper": 2.21,
    "default, known speed: every bit right": 100.0,
    "default, known speed: x over the bound": 1.15,
    "default, known speed: y over the bound": 1.15,
    "default, known speed: angle over the bound": 1.15,
    "default, known speed: angle": 1.15 * 0.056,
    "right speed: doubted": 0.0,
    "array at rest: refused passes": 0.0,
    "random designs: every bit right": 100.0,
    "random designs: magnets missed": 0.0,
    "random designs: wrong ids": 0.0,
    "random designs: misplaced": 0.0,
    "mini tag, known speed: position": 0.58,
    "mini tag, known speed: heading": 1.0,
    "one dead sensor: wrong, or nothing said": 0.0,
    "DDTW, 180 templates of 80 samples": 2.0,
    "180 templates of 80 samples made": 5.0,
}
"""Targets, without the faults and the set of templates that these tests leave out."""

RELEASED = polaris.PUBLISHED_TAGS
TAG = 255183


@pytest.fixture(scope="module")
def rows(
    by_name: Any, run_in_process: Any, time_once: Any, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Figure]:
    """Return all figures of few passes, without the published runs."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (timing, polaris_speed):
            patch.setattr(module, "run_single_threaded", run_in_process)
        patch.setattr(polaris_speed, "time_call", time_once)
        patch.setattr(designs, "PASSES", dict.fromkeys(designs.PASSES, 1))
        patch.setattr(given_speeds, "RECORDINGS_PER_KIND", 1)
        patch.setattr(disturbances, "PASSES_PER_KIND", 1)
        # The solver solves these passes at once; on others it searches for seconds.
        patch.setattr(designs, "FIRST_SEED", designs.FIRST_SEED + 2)
        patch.setattr(polaris_passes, "HEADINGS_DEG", (30,))
        for name in ("HEADING_REPEATS", "RANDOM_DESIGNS", "REPEATED_PASSES"):
            patch.setattr(polaris_passes, name, 1)
        faults = {"one dead sensor": polaris_passes.FAULTS["one dead sensor"]}
        patch.setattr(polaris_passes, "FAULTS", faults)
        patch.setattr(polaris_speed, "TARGETS_MS", {180: polaris_speed.TARGETS_MS[180]})
        patch.setattr(polaris_speed, "LIBRARIES", ("no-such-library",))
        return by_name(polaris.figures(tmp_path_factory.mktemp("empty")))


@pytest.mark.slow
def test_every_promise_has_its_row(rows: dict[str, Figure]) -> None:
    for name, target in PROMISED.items():
        assert rows[name].target == pytest.approx(target), name
        assert rows[name].how
    assert set(polaris_speed.TARGETS_MS) == {180, 1800}
    assert len(polaris_passes.FAULTS) >= 7


@pytest.mark.slow
def test_missing_runs_are_reported_and_affect_no_other_figure(rows: dict[str, Figure]) -> None:
    for name, figure in rows.items():
        if name.startswith(("published", "default:", "varying:", "time a run")):
            assert figure.value is None
            assert figure.met is None
            assert "RawData_1.csv" in figure.how
        elif "no-such-library" in name:
            assert figure.value is None
            assert figure.how == "not installed"
        else:
            assert figure.value is not None, figure.how
    assert rows["default, known speed: every bit right"].met
    assert rows["mini tag, known speed: position"].met
    assert rows["one dead sensor: wrong, or nothing said"].met


@pytest.mark.slow
def test_published_runs_are_as_promised(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polaris, "_duration_figures", lambda folder, error: [])
    monkeypatch.setattr(polaris, "SET_RUNS", {"default": 3, "varying": 3})
    found = {figure.name: figure for figure in polaris.published_figures(data / "polaris")}
    for figure in found.values():
        assert figure.value is not None
        if figure.name in PROMISED and "heading" not in figure.name:
            assert figure.met, f"{figure.name}: {figure.value}"
    ruled, free = (
        found[f"default: position, rigid-aligned{label}"].value
        for label in ("", ", without the ruler")
    )
    assert ruled < free  # type: ignore[operator]


# ---- scores of a published run


def layout_m() -> np.ndarray:
    return cell_positions(RELEASED, codec.layout_of(RELEASED, TAG).cells)


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def test_rigid_alignment_takes_the_pose_and_nothing_else() -> None:
    there = turned(layout_m(), 0.7) + [0.3, -0.2]
    assert polaris.rigid_error(there, TAG) == pytest.approx(0, abs=1e-9)
    middle = there.mean(axis=0)
    # Stretched by 1 %: magnets move by as much of their distances from the middle.
    away = 1e3 * np.linalg.norm(there - middle, axis=1).mean()
    assert polaris.rigid_error(middle + 1.01 * (there - middle), TAG) == pytest.approx(0.01 * away)
    there[2] = np.nan
    assert math.isnan(polaris.rigid_error(there, TAG))


def test_the_authors_metric_has_two_anchors_and_no_rotation() -> None:
    there = layout_m() + [5.0, 7.0]
    assert polaris.anchored_error(there, TAG) == pytest.approx(0, abs=1e-9)
    # v1 is the first to be passed: a millimetre of it is a millimetre of the other four.
    for axis in (0, 1):
        off = there.copy()
        off[0, axis] -= 1e-3
        assert polaris.anchored_error(off, TAG) == pytest.approx(0.8)
    other = there.copy()
    other[3, 1] += 1e-3
    assert polaris.anchored_error(other, TAG) == pytest.approx(0.2)
    assert polaris.anchored_error(turned(there, 0.01), TAG) > 0.3
    # To the right, not to the left: a mirrored layout is no match.
    assert polaris.anchored_error(there * [1, -1], TAG) > 40


def test_opposite_orientations_are_counted_against_the_layout() -> None:
    layout = codec.layout_of(RELEASED, TAG)
    true = symbol_angles(RELEASED, layout.symbols)
    run = polaris.PublishedRun(TAG, True, 0, layout_m(), true + 0.3, 0.3, 1.0, 1.0)
    other = replace(run, angle_rad=true + 0.3 + [0, math.pi, 1.4, -math.pi, math.tau])
    lost = replace(run, angle_rad=np.full(5, np.nan), heading_rad=math.nan)
    assert polaris.count_opposite([run, lost]) == 0
    assert polaris.count_opposite([run, other]) == 2


def test_heading_of_the_position_pattern_is_absolute_and_in_degrees() -> None:
    assert polaris.absolute_pattern_heading_deg(turned(layout_m(), -0.1)) == pytest.approx(
        math.degrees(0.1)
    )
    assert math.isnan(polaris.absolute_pattern_heading_deg(np.full((5, 2), np.nan)))


def test_scatter_is_about_each_magnets_own_mean() -> None:
    mean = np.array([math.pi, 0.3, -2.0])
    angle = mean + np.radians([[1.0, 2.0, 0.0], [-1.0, -2.0, 0.0]])
    angle[0, 0] -= math.tau
    assert polaris.scatter(angle) == pytest.approx(math.sqrt(5 / 3))


DETECTION = TagDetection(
    time_s=1.0,
    device="bar",
    tag_id=None,
    margin=1.0,
    refused=None,
    x_m=0.0,
    y_m=0.0,
    heading_rad=0.02,
    sigma_x_m=1e-4,
    sigma_y_m=1e-4,
    sigma_heading_rad=1e-3,
    array_pose=None,
    magnets=(),
    residual_sigma=1.5,
    height_m=0.01,
    speed_mps=0.1,
    scale=2.0,
    corrected=0,
    erased=0,
    other_sources=0,
)


def magnet(
    x_m: float, y_m: float, angle_rad: float, cell: tuple[int, int] | None = None
) -> MagnetDetection:
    return MagnetDetection(x_m, y_m, angle_rad, None, cell, 1e-4, 1e-4, 1e-2, 1e-3)


def detection(tag_id: int | None, cells: Any) -> TagDetection:
    """As a solver would tell it; magnets the other way round than in the layout."""
    magnets = [
        magnet(2 * x, y, 0.1 * k, cell)
        for k, (cell, (x, y)) in enumerate(zip(cells, cell_positions(RELEASED, cells), strict=True))
    ]
    return replace(DETECTION, tag_id=tag_id, magnets=tuple(magnets[::-1]))


def test_a_run_is_what_its_detections_say() -> None:
    cells = codec.layout_of(RELEASED, TAG).cells
    run = polaris.summarize_run([detection(TAG ^ 0b101 << 10, cells)], TAG)
    assert (run.is_read, run.wrong_bits) == (True, 2)
    assert run.unscaled_position_m == pytest.approx(layout_m())
    assert run.angle_rad == pytest.approx(0.1 * np.arange(5))
    twice = polaris.summarize_run([detection(TAG, cells), detection(TAG ^ 1, cells)], TAG)
    assert twice.wrong_bits == 1
    refused = polaris.summarize_run([detection(None, cells)], TAG)
    assert (refused.is_read, refused.wrong_bits) == (False, 0)
    assert np.isfinite(refused.position_m).all()
    for nothing in ([], [detection(None, cells[:4])]):
        run = polaris.summarize_run(nothing, TAG)
        assert not run.is_read
        assert math.isnan(polaris.rigid_error(run.position_m, TAG))
        assert Figure("f", polaris.RIGID_ERROR([run]), "mm", "how", 0.75).met is False


# ---- scores of a simulated pass


@pytest.fixture(scope="module")
def made() -> SimulatedSession:
    options = SimulationOptions(route=(1234,), heading_rad=2.0, lateral_m=0.005, earth_t=0.0)
    return simulate(Tags(), options)


def told(made: SimulatedSession, tag_id: int | None, refused: str | None = None) -> TagDetection:
    """The truth at some sample, as a detection."""
    at = 150
    heading = heading_from_quaternion(made.truth.quaternion[at : at + 1])[0]
    magnets = turned(made.magnets.position_m - made.truth.position[at, :2], -heading)
    x, y = turned(-made.truth.position[at, :2][None], -heading)[0]
    return replace(
        DETECTION,
        time_s=made.truth.time_ns[at] * 1e-9,
        tag_id=tag_id,
        refused=refused,
        x_m=x,
        y_m=y,
        heading_rad=-heading + math.tau,
        magnets=tuple(
            magnet(a, b, angle - heading - math.tau)
            for (a, b), angle in zip(magnets, made.magnets.angle_rad, strict=True)
        ),
    )


def test_the_truth_has_no_errors_in_any_order(made: SimulatedSession) -> None:
    found = told(made, 1234)
    found = replace(found, magnets=found.magnets[::-1])
    outcome = polaris_passes.score_pass(made, [found])
    assert (outcome.verdict, outcome.missed, outcome.reasons) == ("right", 0, ())
    assert outcome.magnets == pytest.approx(np.zeros((5, 3)), abs=1e-9)
    assert outcome.pose == pytest.approx(np.zeros(3), abs=1e-9)
    first, *others = found.magnets
    moved = replace(first, x_m=first.x_m + 2e-3)
    found = replace(found, magnets=(moved, *others), y_m=found.y_m - 0.9e-3)
    outcome = polaris_passes.score_pass(made, [found])
    assert polaris_passes.rms(outcome.magnets)[0] == pytest.approx(2e-3 / math.sqrt(5))
    assert outcome.pose == pytest.approx([0, -0.9e-3, 0], abs=1e-9)


def test_a_right_id_at_another_place_is_misplaced(made: SimulatedSession) -> None:
    found = told(made, 1234)
    found = replace(found, x_m=found.x_m + 2e-3)
    assert polaris_passes.score_pass(made, [found]).verdict == "misplaced"
    found = replace(found, sigma_x_m=1e-3)
    assert polaris_passes.score_pass(made, [found]).verdict == "right"
    found = replace(found, heading_rad=found.heading_rad + math.radians(2))
    assert polaris_passes.score_pass(made, [found]).verdict == "misplaced"


def test_a_pass_is_right_wrong_refused_or_silent(made: SimulatedSession) -> None:
    right, wrong = told(made, 1234), told(made, 1235)
    refused = told(made, None, "tie")
    refused = replace(refused, magnets=refused.magnets[:3])
    cases = (
        ([right], "right", 0),
        ([wrong], "wrong", 0),
        ([right, wrong], "wrong", 0),
        ([refused], "refused", 2),
        ([refused, right], "right", 0),
        ([], "silent", 5),
    )
    outcomes = []
    for detections, verdict, missed in cases:
        outcome = polaris_passes.score_pass(made, detections)
        assert (outcome.verdict, outcome.missed) == (verdict, missed)
        outcomes.append(outcome)
    assert np.isnan(outcomes[3].pose).all()
    assert polaris_passes.correct_percent(outcomes) == pytest.approx(100 / 3)
    assert polaris_passes.describe_outcomes(outcomes[3:4]) == "1 refused; 1 tie"


@pytest.mark.slow
def test_nothing_read_is_not_met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polaris_passes, "REPEATED_PASSES", 1)
    monkeypatch.setattr(polaris_passes, "RANDOM_DESIGNS", 1)
    solve = polaris_passes.solve

    def blind(*args: Any) -> Any:
        return replace(solve(*args), detections=())

    monkeypatch.setattr(polaris_passes, "solve", blind)
    faults = {"offsets": {"offset_t": 1e-4}}
    monkeypatch.setattr(polaris_passes, "FAULTS", faults)
    rows = [*polaris_passes.random_figures(), *polaris_passes.fault_figures()]
    met = {figure.name: figure.met for figure in rows}
    assert met["random designs: every bit right"] is False
    assert met["random designs: magnets missed"] is False
    assert met["offsets: wrong, or nothing said"] is False


def test_random_designs_fit_under_the_bar() -> None:
    for seed in range(200):
        tags, heading = polaris_passes.random_design(np.random.default_rng(seed))
        grid = tuple((c, r) for c in range(tags.order) for r in range(tags.order))
        across = turned(cell_positions(tags, grid), -heading)[:, 1]
        assert np.abs(across).max() < 0.0826
        assert 0.016 <= tags.spacing_m <= 0.040
        assert 4 <= tags.magnets <= min(13, tags.order**2 - 1)


# ---- speed


def test_the_window_that_is_timed_is_one_of_the_templates() -> None:
    window, field = polaris_speed.window_and_templates(180)
    assert (window.shape, field.shape) == ((80, 3), (180, 80, 3))
    assert distances(window, prepare(field)).argmin() == 60
    assert polaris_speed.window_and_templates(1800)[1].shape == (1800, 80, 3)


# ---- passes over tags of other designs


@pytest.mark.slow
@pytest.mark.parametrize("kind", designs.PASSES)
def test_a_pass_over_tags_of_several_designs(kind: str) -> None:
    for seed in (700_000, 700_001):
        read, present, refused = designs.pass_result(kind, seed)
        assert read <= present
        assert read == present or refused
    if kind in ("part of a larger tag", "another spacing"):
        assert present == set()
    else:
        assert present
