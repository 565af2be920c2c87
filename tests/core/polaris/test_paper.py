"""The paper's pipeline on drives over magpylib's cylinders, and on its own recordings."""

from __future__ import annotations

import ast
import csv
import functools
import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import magpylib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import umeyama
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.published import pipeline as paper
from locatk.core.polaris.published.peaks import (
    Peak,
    estimate_background,
    find_peaks,
    measure_signals,
)
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.simulation.session import SimulationOptions, simulate
from locatk.core.polaris.tag import TagLayout, Tags, cell_positions, symbol_angles
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

TAGS = Tags()
SPEED = 0.1
LAYOUT = TagLayout(((0, 0), (1, 1), (2, 1), (0, 2), (2, 2)), (0, 7, 2, 5, 4))


def installed_magnets(
    x: float, y: float, heading: float, layout: TagLayout = LAYOUT
) -> tuple[Array, Array]:
    """Places (M, 2) and angles (M,) of a tag's magnets on the floor."""
    cos, sin = math.cos(heading), math.sin(heading)
    rotated = cell_positions(TAGS, layout.cells) @ np.array([[cos, sin], [-sin, cos]])
    return rotated + [x, y], symbol_angles(TAGS, layout.symbols) + heading


def drive(
    magnets: list[tuple[Array, Array]],
    length: float,
    *,
    step: float = 1e-3,
    seed: int = 1,
    clearance_m: float = TAGS.clearance_m,
) -> Samples:
    """The paper's array driven over the floor from x = 0 on, with 0.5 uT of noise."""
    rng = np.random.default_rng(seed)
    path = np.arange(0, length, step)
    array = SensorArray(bar(9, 0.02))
    sensor = array.position_m + path[:, None, None] * [1.0, 0.0, 0.0]
    sensor[..., 2] = clearance_m
    field = rng.normal(0, 0.5e-6, sensor.shape) + rng.normal(0, 3e-5, (1, 9, 3))
    sources = [
        magpylib.magnet.Cylinder(
            polarization=(1.45 * math.cos(rotation), 1.45 * math.sin(rotation), 0),
            dimension=(2e-3, 0.5e-3),
            position=(*point, 0),
        )
        for places_m, rotations in magnets
        for point, rotation in zip(places_m, rotations, strict=True)
    ]
    if sources:
        field += magpylib.getB(sources, sensor, sumup=True)
    return Samples("bar", array, np.rint(path / SPEED * 1e9).astype(np.int64), field)


def floor_positions(sighting: DetectedMagnets, samples: Samples) -> Array:
    """Places with the way of the array added: from where it started."""
    path = (sighting.time_ns - samples.time_ns[0]) * 1e-9 * SPEED
    return sighting.position_m + [path, 0.0]


def compared(sighting: DetectedMagnets, samples: Samples, truth: tuple[Array, Array]) -> Array:
    """Distance in m and turn in rad (M, 2) of each true magnet's nearest."""
    point = floor_positions(sighting, samples)
    apart = np.linalg.norm(point[:, None] - truth[0], axis=2)
    nearest = apart.argmin(axis=0)
    assert sorted(nearest.tolist()) == list(range(len(sighting)))
    rotation = np.remainder(sighting.angle_rad[nearest] - truth[1] + math.pi, math.tau) - math.pi
    return np.column_stack([apart.min(axis=0), np.abs(rotation)])


# ---- Eq. 3


@pytest.mark.slow
@given(
    st.floats(0, math.tau),
    st.floats(0, 0.02),
    st.floats(0.008, 0.015),
    st.sampled_from([-1.0, 1.0]),
)
def test_a_magnet_between_two_sensors_is_found_by_their_ratio(
    angle: float, offset: float, clearance: float, side: float
) -> None:
    source = magpylib.magnet.Cylinder(
        polarization=(1.45 * math.cos(angle), 1.45 * math.sin(angle), 0),
        dimension=(2e-3, 0.5e-3),
    )
    strengths = np.linalg.norm(
        source.getB([(0, -side * offset, clearance), (0, side * (0.02 - offset), clearance)]),
        axis=1,
    )
    result = paper.lateral_offset(strengths[0] / strengths[1], angle, 0.02, clearance)
    assert result == pytest.approx(offset, abs=2e-4)


@pytest.mark.parametrize("angle", [0.0, 0.8, math.pi / 2])
def test_the_magnet_stays_between_the_two(angle: float) -> None:
    assert paper.lateral_offset(1e9, angle, 0.02, 0.01) == 0
    assert paper.lateral_offset(math.inf, angle, 0.02, 0.01) == 0
    assert paper.lateral_offset(1e-9, angle, 0.02, 0.01) == 0.02
    assert paper.lateral_offset(0.0, angle, 0.02, 0.01) == 0.02
    assert paper.lateral_offset(1.0, angle, 0.02, 0.01) == pytest.approx(0.01)


# ---- The position pattern


@given(st.floats(-math.pi, math.pi), st.permutations(range(5)), st.integers(0, 9))
def test_the_pattern_gives_the_heading(heading: float, order: list[int], placement: int) -> None:
    free = list(itertools.combinations([(1, 0), (0, 1), (1, 1), (2, 1), (1, 2)], 2))[placement]
    layout = TagLayout(((0, 0), (0, 2), (2, 2), *free), (0, 7, 2, 5, 4))
    position = installed_magnets(0.3, -0.02, heading, layout)[0][order]
    pattern = paper.position_pattern(position)
    assert pattern is not None
    assert [order[k] for k in pattern] == [0, 1, 2]
    result = paper.pattern_heading(position)
    assert result is not None
    assert math.remainder(result - heading, math.tau) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("degrees", "is_pattern"), [(76, True), (74, False), (104, True)])
def test_a_right_angle_may_be_off_by_fifteen_degrees(degrees: float, is_pattern: bool) -> None:
    angle = math.radians(degrees)
    side = 0.08 * np.array([[1.0, 0.0], [0.0, 0.0], [math.cos(angle), math.sin(angle)]])
    assert (paper.position_pattern(side) is not None) == is_pattern


@pytest.mark.parametrize(
    "points",
    [
        [(0.0, 0.0), (0.08, 0.0)],
        [(0.0, 0.0), (0.04, 0.0), (0.08, 0.0)],
        [(0.0, 0.0), (0.08, 0.08), (0.04, 0.04)],
    ],
)
def test_no_pattern_without_a_right_angle(points: list[tuple[float, float]]) -> None:
    assert paper.position_pattern(np.array(points)) is None
    assert paper.pattern_heading(np.array(points)) is None


# ---- Drives over cylinders


@pytest.mark.parametrize("degrees", range(0, 360, 40))
def test_magnets_of_a_tag_at_any_heading(degrees: int) -> None:
    # The paper has 1.93 to 2.49 mm over its headings (8.3.2).
    truth = installed_magnets(0.17, 0.004, math.radians(degrees))
    samples = drive([truth], 0.34, seed=degrees)
    (sighting,) = paper.detect_magnets(samples, TAGS, SPEED)
    wrong = compared(sighting, samples, truth)
    assert wrong[:, 0].mean() < 2.4e-3
    assert wrong[:, 0].max() < 5.5e-3
    assert np.median(wrong[:, 1]) < math.radians(10)
    assert sighting.moment_am2 == pytest.approx(TAGS.magnet.moment, rel=0.35)


@pytest.mark.parametrize(("lateral", "expected"), [(0.0, {4}), (0.004, {4}), (0.01, {4, 5})])
def test_a_magnet_counts_where_it_is_nearest(lateral: float, expected: set[int]) -> None:
    samples = drive([(np.array([[0.1, lateral]]), np.array([0.5]))], 0.2)
    result = find_peaks(measure_signals(samples, 1.0), 20.0)
    assert {peak.sensor for peak in result} == expected
    assert [peak.sample for peak in result] == pytest.approx([100] * len(result), abs=6)
    assert result[0].amplitude_t > 5e-5


@given(st.lists(st.floats(0, 1), max_size=8))
def test_pairs_in_a_row_that_gain_the_most(gains: list[float]) -> None:
    chosen = paper.disjoint_pairs(gains)
    assert all(b - a > 1 for a, b in itertools.pairwise(chosen))
    every = itertools.chain.from_iterable(
        itertools.combinations(range(len(gains)), count) for count in range(6)
    )
    apart = [ks for ks in every if all(b - a > 1 for a, b in itertools.pairwise(ks))]
    best = max(sum(gains[k] for k in ks) for ks in apart)
    assert sum(gains[k] for k in chosen) == pytest.approx(best)
    assert all(gains[k] > 0 for k in chosen)


def test_of_magnets_that_are_too_close_the_strongest_is_kept() -> None:
    def magnet(path_m: float, x_m: float, y_m: float) -> paper.LocatedMagnet:
        peak = Peak(0, 0.0, 1e-4)
        return paper.LocatedMagnet(peak, (0, 1), path_m, x_m, y_m, 0.0, 1e-3)

    # The position on the floor is the sensor's own and that of the array together.
    strongest, same, beside, ahead = (
        magnet(0.10, 0.0, 0.0), magnet(0.08, 0.02, 0.019), magnet(0.10, 0.0, 0.021),
        magnet(0.121, 0.0, 0.0),
    )  # fmt: skip
    kept = paper.without_duplicates([strongest, same, beside, ahead], 0.02)
    assert kept == [strongest, beside, ahead]


def test_no_two_magnets_of_a_pass_are_closer_than_half_a_spacing() -> None:
    # A tag of 20 mm under sensors 20 mm apart: too dense, so that one magnet has two peaks.
    tags = Tags(magnets=8, clearance_m=0.005, spacing_m=0.02)
    drive_over = SimulationOptions(route=(9770,), heading_rad=10.0, lateral_m=0.003, seed=10)
    (magnets,) = paper.detect_magnets(simulate(tags, drive_over).samples, tags, SPEED)
    distance = np.linalg.norm(magnets.position_m[:, None] - magnets.position_m, axis=2)
    assert distance[np.triu_indices(len(magnets), 1)].min() > 0.01


@pytest.mark.parametrize(
    "magnets",
    [
        [(0.1, -0.0225), (0.1, 0.0175)],
        [(0.1, 0.0105), (0.115, 0.0475)],
        [(0.1, -0.05), (0.104, -0.01), (0.101, 0.03)],
    ],
)
def test_magnets_passed_together_share_no_sensor(magnets: list[tuple[float, float]]) -> None:
    truth = np.array(magnets), np.zeros(len(magnets))
    samples = drive([truth], 0.2)
    (sighting,) = paper.detect_magnets(samples, TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].max() < 2.5e-3


def test_the_frame_is_the_array_s_at_the_middle_of_the_pass() -> None:
    truth = installed_magnets(0.25, 0.0, 0.0)
    samples = drive([truth], 0.5)
    (sighting,) = paper.detect_magnets(samples, TAGS, SPEED)
    assert sighting.position_m.mean(axis=0) == pytest.approx(
        truth[0].mean(axis=0) - [0.25, 0], abs=3e-3
    )
    assert paper.pattern_heading(sighting.position_m) == pytest.approx(0.0, abs=0.03)
    inside = samples.time_ns[sighting.first : sighting.stop]
    assert len(sighting.path_m) == len(inside)
    np.testing.assert_allclose(
        sighting.path_m, (inside - sighting.time_ns) * 1e-9 * SPEED, atol=1e-9
    )
    assert inside[0] < 2.1e9 < 2.9e9 < inside[-1]
    assert np.isnan(sighting.covariance).all()


def test_two_tags_are_two_passes() -> None:
    first, second = installed_magnets(0.15, 0.01, 0.2), installed_magnets(0.5, -0.015, -1.0)
    samples = drive([second, first], 0.65)
    before, after = paper.detect_magnets(samples, TAGS, SPEED)
    assert before.time_ns < after.time_ns
    assert compared(before, samples, first)[:, 0].mean() < 2.4e-3
    assert compared(after, samples, second)[:, 0].mean() < 2.4e-3


def test_background_that_drifts_is_no_magnet_and_moves_none() -> None:
    truth = installed_magnets(0.3, 0.003, 0.1)
    still, samples = drive([], 0.6), drive([truth], 0.6)
    # 20 uT over the drive, and 8 uT more from motors once it has begun.
    drift = np.linspace(0, 2e-5, 600)[:, None, None] * np.array([1.0, -0.5, 0.3])
    drift = drift + 8e-6 / (1 + np.exp(-(np.arange(600) - 120) / 20))[:, None, None]
    assert paper.detect_magnets(replace(still, field_t=still.field_t + drift), TAGS, SPEED) == []
    moved = replace(samples, field_t=samples.field_t + drift)
    (sighting,) = paper.detect_magnets(moved, TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].mean() < 2.4e-3


def test_lost_samples_and_a_dead_sensor_that_sees_nothing() -> None:
    truth = installed_magnets(0.17, 0.02, 0.0)
    samples = drive([truth], 0.34)
    field = samples.field_t.copy()
    field[np.random.default_rng(3).random(field.shape[:2]) < 0.02] = np.nan
    field[:, 0] = np.nan
    (sighting,) = paper.detect_magnets(replace(samples, field_t=field), TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].mean() < 2.4e-3
    (warning,) = sighting.warnings
    assert warning == SolverWarning(
        "sensor_silent", "without sensor 1: at most 50% of its samples are valid"
    )


@pytest.mark.slow
def test_sensors_may_come_in_any_order() -> None:
    samples = drive([installed_magnets(0.17, 0.004, 0.4)], 0.34)
    order = np.random.default_rng(4).permutation(9)
    array = replace(samples.array, position_m=samples.array.position_m[order])
    mixed = Samples("bar", array, samples.time_ns, samples.field_t[:, order])
    (mine,) = paper.detect_magnets(samples, TAGS, SPEED)
    (other,) = paper.detect_magnets(mixed, TAGS, SPEED)
    np.testing.assert_allclose(other.position_m, mine.position_m)


def test_interpolated_samples_do_not_lower_the_estimate_of_noise() -> None:
    samples = drive([], 0.6)
    lost = np.random.default_rng(5).random(samples.field_t.shape[:2]) < 0.45
    field = np.where(lost[..., None], np.nan, samples.field_t)
    whole, gaps = (
        measure_signals(replace(samples, field_t=f), 2.0) for f in (samples.field_t, field)
    )
    np.testing.assert_allclose(gaps.noise_t, whole.noise_t, rtol=0.3)


def test_background_of_scattered_clear_samples_is_zero() -> None:
    signal = measure_signals(drive([], 0.3), 2.0)
    peaks = [Peak(0, sample, 1e-4) for sample in range(300) if sample % 10]
    assert not estimate_background(signal, peaks, 0.5, 4).any()


def test_nothing_is_found_in_noise() -> None:
    assert paper.detect_magnets(drive([], 0.5), TAGS, SPEED) == []


def test_a_long_slow_recording_is_thinned_out() -> None:
    truth = installed_magnets(0.15, 0.004, 0.0)
    samples = drive([truth], 0.3, step=1e-4)
    (sighting,) = paper.detect_magnets(samples, TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].mean() < 2.4e-3


def test_unsolvable_sessions_are_refused() -> None:
    samples = drive([], 0.3)
    with pytest.raises(InputError, match="speed") as error:
        paper.detect_magnets(samples, TAGS, None)
    assert "--speed" in str(error.value.hint)
    for speed in (0.0, -SPEED, np.inf, np.nan):
        with pytest.raises(InputError, match="not above 0"):
            paper.detect_magnets(samples, TAGS, speed)
    with pytest.raises(InputError, match=r"10 mm apart.*40 mm"):
        paper.detect_magnets(samples, TAGS, 10 * SPEED)
    with pytest.raises(InputError, match="too few"):
        paper.detect_magnets(
            Samples("bar", samples.array, samples.time_ns[:9], samples.field_t[:9]), TAGS, SPEED
        )
    lost = samples.field_t.copy()
    lost[:, 1:] = np.nan
    with pytest.raises(InputError, match="1 of 9 sensors"):
        paper.detect_magnets(replace(samples, field_t=lost), TAGS, SPEED)


def test_windows_of_sparse_samples_have_the_points_of_the_templates() -> None:
    # As in the published recordings, 2.6 mm a sample: windows of 31 samples scatter twice as much.
    wrong = []
    for seed in range(6):
        truth = installed_magnets(0.17, 1e-3 * seed, math.radians(3 * seed))
        samples = drive([truth], 0.34, step=2.625e-3, seed=seed)
        (magnets,) = paper.detect_magnets(samples, TAGS, SPEED)
        wrong.append(compared(magnets, samples, truth)[:, 1])
    assert np.degrees(np.sqrt(np.mean(np.square(wrong)))) < 6


@pytest.mark.slow
@pytest.mark.parametrize("heading_deg", [0, 90, 180])
def test_a_wide_tag_flips_no_moment_across_the_track(heading_deg: int) -> None:
    # Templates beyond half the distance of the sensors look like the opposite moment's.
    tags = replace(TAGS, spacing_m=0.048, clearance_m=0.012)
    heading = math.radians(heading_deg)
    cos, sin = math.cos(heading), math.sin(heading)
    for lateral in (0.004, 0.007, 0.0085):
        rotated = cell_positions(tags, LAYOUT.cells) @ np.array([[cos, sin], [-sin, cos]])
        truth = rotated + [0.2, lateral], np.radians([90.0, -90.0, 90.0, -90.0, 90.0]) + heading
        samples = drive([truth], 0.4, clearance_m=0.012)
        (magnets,) = paper.detect_magnets(samples, tags, SPEED)
        assert compared(magnets, samples, truth)[:, 1].max() < math.radians(45)


@pytest.mark.parametrize("lateral", [0.022, 0.024, 0.036, 0.038])
def test_the_gap_of_a_dead_sensor_flips_no_moment(lateral: float) -> None:
    # The gap is twice the distance of two sensors; templates of such offsets would flip it.
    truth = np.array([[0.1, lateral]]), np.array([math.pi / 2])
    samples = drive([truth], 0.2)
    field = samples.field_t.copy()
    field[:, 2] = np.nan
    (magnets,) = paper.detect_magnets(replace(samples, field_t=field), TAGS, SPEED)
    assert compared(magnets, samples, truth)[0, 1] < math.radians(45)


def test_the_resolution_of_the_templates_is_that_of_the_orientations() -> None:
    samples = drive([installed_magnets(0.17, 0.004, 0.0)], 0.34)
    for orientations in (8, 90):
        (magnets,) = paper.detect_magnets(samples, TAGS, SPEED, TemplateGrid(orientations))
        steps = magnets.angle_rad / (math.tau / orientations)
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)


# ---- The published recordings

TRUE_MM = np.array([(0, 0), (40, 40), (80, 40), (0, 80), (80, 80)], float)
"""To the right and ahead of the first magnet."""

RUNS = {"default": range(1, 11), "varying": range(1, 4)}
NOMINAL = {"default": np.zeros(5), "varying": np.radians([0, -45, -90, -135, -180])}
RIGID_MM = {"default": 1.46, "varying": 2.36}
SCATTER_DEG = {"default": 4.7, "varying": 9.8}
"""The authors' own, from their program run again on all ten runs of each set."""

HEADING_DEG = {"default": 1.14, "varying": 2.21}
"""Mean absolute headings in the released result files, of these runs."""


@functools.cache
def published(file: Path) -> Samples:
    with file.open(newline="") as lines:
        rows = list(csv.reader(lines))[1:]
    raw = np.array([[ast.literal_eval(cell) for cell in row[2:]] for row in rows]) * 1e-6
    # Their axes are right, back and down, and 40 samples a second is their decoder's.
    field = np.stack([-raw[..., 1], -raw[..., 0], -raw[..., 2]], axis=-1)
    time = np.rint(np.arange(len(raw)) / 40 * 1e9).astype(np.int64)
    return Samples("bar", SensorArray(bar(9, 0.02)), time, field)


@dataclass(frozen=True)
class Score:
    """One run: its rigid-aligned error in mm, the magnets' angles and the pattern's heading."""

    rigid_mm: float
    angle_rad: Array
    heading_rad: float


Scores = dict[str, list[Score]]


@pytest.fixture(scope="module", params=[0.010, 0.015], ids=["10 mm", "15 mm"])
def scored(data: Path, request: pytest.FixtureRequest) -> Scores:
    """With the clearance of the paper, and with that of the authors' templates."""
    tags = replace(TAGS, clearance_m=request.param)
    scores: Scores = {}
    for kind, runs in RUNS.items():
        scores[kind] = []
        for run in runs:
            samples = published(data / "polaris" / kind / f"RawData_{run}.csv")
            (magnets,) = paper.detect_magnets(samples, tags, 0.105)
            assert len(magnets) == 5
            position = 1e3 * np.column_stack([-magnets.position_m[:, 1], magnets.position_m[:, 0]])
            distance = np.linalg.norm(position[:, None] - position[0] - TRUE_MM, axis=2)
            order = distance.argmin(axis=0)
            assert sorted(order.tolist()) == [0, 1, 2, 3, 4]
            position = position[order]
            aligned = umeyama(position, TRUE_MM, with_scale=False).apply(position)
            heading = paper.pattern_heading(magnets.position_m)
            assert heading is not None
            scores[kind].append(
                Score(
                    float(np.linalg.norm(aligned - TRUE_MM, axis=1).mean()),
                    magnets.angle_rad[order],
                    heading,
                )
            )
    return scores


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNS)
def test_orientations_scatter_no_more_than_the_authors(scored: Scores, kind: str) -> None:
    each = np.exp(1j * np.array([run.angle_rad for run in scored[kind]]))
    scatter = np.degrees(np.sqrt(np.mean(np.angle(each * each.mean(axis=0).conj()) ** 2)))
    assert scatter <= SCATTER_DEG[kind]


@pytest.mark.slow
def test_orientations_are_those_of_the_tag(scored: Scores, request: pytest.FixtureRequest) -> None:
    off = [run.angle_rad - NOMINAL[kind] for kind in RUNS for run in scored[kind]]
    off_deg = np.degrees(np.abs(np.angle(np.exp(1j * np.array(off)))))
    assert off_deg.max() < 45
    # The third magnet of the default tag was placed 13 degrees askew, and the recordings were
    # made at about 11.6 mm. The authors' program misreads one magnet of these runs, too.
    assert np.sum(off_deg > 22.5) <= (1 if "10 mm" in request.node.name else 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNS)
def test_headings_of_the_position_pattern_are_the_authors(scored: Scores, kind: str) -> None:
    assert np.degrees(np.mean([abs(run.heading_rad) for run in scored[kind]])) <= HEADING_DEG[kind]


@pytest.mark.slow
def test_positions_are_no_worse_than_the_authors(
    scored: Scores, request: pytest.FixtureRequest
) -> None:
    for kind in RUNS if "10 mm" in request.node.name else ["default"]:
        assert np.mean([run.rigid_mm for run in scored[kind]]) <= RIGID_MM[kind]
