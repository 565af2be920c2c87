"""The paper's pipeline on drives over magpylib's cylinders, and on its own recordings."""

from __future__ import annotations

import ast
import csv
import functools
import itertools
import math
from dataclasses import replace
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
from locatk.core.polaris.published.peaks import find_peaks, signals
from locatk.core.polaris.tag import TagLayout, Tags, cell_positions, symbol_angles
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

TAGS = Tags()
SPEED = 0.1
LAYOUT = TagLayout(((0, 0), (1, 1), (2, 1), (0, 2), (2, 2)), (0, 7, 2, 5, 4))


def lying(x: float, y: float, heading: float, layout: TagLayout = LAYOUT) -> tuple[Array, Array]:
    """Places (M, 2) and angles (M,) of a tag's magnets on the floor."""
    cos, sin = math.cos(heading), math.sin(heading)
    turned = cell_positions(TAGS, layout.cells) @ np.array([[cos, sin], [-sin, cos]])
    return turned + [x, y], symbol_angles(TAGS, layout.symbols) + heading


def drive(
    magnets: list[tuple[Array, Array]], length: float, *, step: float = 1e-3, seed: int = 1
) -> Samples:
    """The paper's array driven over the floor from x = 0 on, with 0.5 uT of noise."""
    rng = np.random.default_rng(seed)
    way = np.arange(0, length, step)
    array = SensorArray(bar(9, 0.02))
    sensor = array.position_m + way[:, None, None] * [1.0, 0.0, 0.0]
    sensor[..., 2] = TAGS.clearance_m
    field = rng.normal(0, 0.5e-6, sensor.shape) + rng.normal(0, 3e-5, (1, 9, 3))
    sources = [
        magpylib.magnet.Cylinder(
            polarization=(1.45 * math.cos(turn), 1.45 * math.sin(turn), 0),
            dimension=(2e-3, 0.5e-3),
            position=(*place, 0),
        )
        for places_m, turns in magnets
        for place, turn in zip(places_m, turns, strict=True)
    ]
    if sources:
        field += magpylib.getB(sources, sensor, sumup=True)
    return Samples("bar", array, np.rint(way / SPEED * 1e9).astype(np.int64), field)


def on_the_floor(sighting: DetectedMagnets, samples: Samples) -> Array:
    """Places with the way of the array added: from where it started."""
    way = (sighting.time_ns - samples.time_ns[0]) * 1e-9 * SPEED
    return sighting.position_m + [way, 0.0]


def compared(sighting: DetectedMagnets, samples: Samples, truth: tuple[Array, Array]) -> Array:
    """Distance in m and turn in rad (M, 2) of each true magnet's nearest."""
    place = on_the_floor(sighting, samples)
    apart = np.linalg.norm(place[:, None] - truth[0], axis=2)
    nearest = apart.argmin(axis=0)
    assert sorted(nearest.tolist()) == list(range(len(sighting)))
    turn = np.remainder(sighting.angle_rad[nearest] - truth[1] + math.pi, math.tau) - math.pi
    return np.column_stack([apart.min(axis=0), np.abs(turn)])


# ---- Eq. 3


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
    found = paper.lateral_offset(strengths[0] / strengths[1], angle, 0.02, clearance)
    assert found == pytest.approx(offset, abs=2e-4)


@pytest.mark.parametrize("angle", [0.0, 0.8, math.pi / 2])
def test_the_magnet_stays_between_the_two(angle: float) -> None:
    assert paper.lateral_offset(1e9, angle, 0.02, 0.01) == 0
    assert paper.lateral_offset(math.inf, angle, 0.02, 0.01) == 0
    assert paper.lateral_offset(1e-9, angle, 0.02, 0.01) == 0.02
    assert paper.lateral_offset(0.0, angle, 0.02, 0.01) == 0.02
    assert paper.lateral_offset(1.0, angle, 0.02, 0.01) == pytest.approx(0.01)


# ---- The position pattern


@given(st.floats(-math.pi, math.pi), st.permutations(range(5)), st.integers(0, 9))
def test_the_pattern_gives_pose_cells_and_angles(
    heading: float, order: list[int], placement: int
) -> None:
    free = list(itertools.combinations([(1, 0), (0, 1), (1, 1), (2, 1), (1, 2)], 2))[placement]
    layout = TagLayout(((0, 0), (0, 2), (2, 2), *free), (0, 7, 2, 5, 4))
    place, angle = lying(0.3, -0.02, heading, layout)
    place, angle = place[order], angle[order]
    pattern = paper.position_pattern(place)
    assert pattern is not None
    assert [order[k] for k in pattern] == [0, 1, 2]
    sighting = DetectedMagnets(
        time_ns=0,
        first=0,
        stop=1,
        path_m=np.zeros(1),
        position_m=place,
        angle_rad=angle,
        moment_am2=np.ones(5),
        covariance=np.full((15, 15), np.nan),
        path_sigma_m=np.zeros(1),
    )
    found = paper.pose_and_angles(sighting, TAGS)
    assert found is not None
    pose, cells, turned = found
    assert pose[:2] == pytest.approx((0.3, -0.02))
    assert math.remainder(pose[2] - heading, math.tau) == pytest.approx(0, abs=1e-9)
    assert cells == tuple(layout.cells[k] for k in order)
    wrong = np.remainder(turned - symbol_angles(TAGS, layout.symbols)[order] + 1, math.tau) - 1
    np.testing.assert_allclose(wrong, 0, atol=1e-9)


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
    assert paper.heading(np.array(points)) is None


# ---- Drives over cylinders


@pytest.mark.parametrize("degrees", range(0, 360, 40))
def test_magnets_of_a_tag_at_any_heading(degrees: int) -> None:
    # The paper has 1.93 to 2.49 mm over its headings (8.3.2).
    truth = lying(0.17, 0.004, math.radians(degrees))
    samples = drive([truth], 0.34, seed=degrees)
    (sighting,) = paper.sightings(samples, TAGS, SPEED)
    wrong = compared(sighting, samples, truth)
    assert wrong[:, 0].mean() < 2.4e-3
    assert wrong[:, 0].max() < 5.5e-3
    assert np.median(wrong[:, 1]) < math.radians(10)
    assert sighting.moment_am2 == pytest.approx(TAGS.magnet.moment, rel=0.35)


@pytest.mark.parametrize(("lateral", "expected"), [(0.0, {4}), (0.004, {4}), (0.01, {4, 5})])
def test_a_magnet_counts_where_it_is_nearest(lateral: float, expected: set[int]) -> None:
    samples = drive([(np.array([[0.1, lateral]]), np.array([0.5]))], 0.2)
    found = find_peaks(signals(samples, 1.0), 20.0)
    assert {peak.sensor for peak in found} == expected
    assert [peak.at for peak in found] == pytest.approx([100] * len(found), abs=6)
    assert found[0].amplitude_t > 5e-5


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
    (sighting,) = paper.sightings(samples, TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].max() < 2.5e-3


def test_the_frame_is_the_array_s_at_the_middle_of_the_pass() -> None:
    truth = lying(0.25, 0.0, 0.0)
    samples = drive([truth], 0.5)
    (sighting,) = paper.sightings(samples, TAGS, SPEED)
    found = paper.pose_and_angles(sighting, TAGS)
    assert found is not None
    assert found[0] == pytest.approx((0.0, 0.0, 0.0), abs=0.03)
    inside = samples.time_ns[sighting.first : sighting.stop]
    assert len(sighting.path_m) == len(inside)
    np.testing.assert_allclose(
        sighting.path_m, (inside - sighting.time_ns) * 1e-9 * SPEED, atol=1e-9
    )
    assert inside[0] < 2.1e9 < 2.9e9 < inside[-1]
    assert np.isnan(sighting.covariance).all()


def test_two_tags_are_two_passes() -> None:
    first, second = lying(0.15, 0.01, 0.2), lying(0.5, -0.015, -1.0)
    samples = drive([second, first], 0.65)
    before, after = paper.sightings(samples, TAGS, SPEED)
    assert before.time_ns < after.time_ns
    assert compared(before, samples, first)[:, 0].mean() < 2.4e-3
    assert compared(after, samples, second)[:, 0].mean() < 2.4e-3


def test_background_that_drifts_is_no_magnet_and_moves_none() -> None:
    truth = lying(0.3, 0.003, 0.1)
    still, samples = drive([], 0.6), drive([truth], 0.6)
    # 20 uT over the drive, and 8 uT more from motors once it has begun.
    drift = np.linspace(0, 2e-5, 600)[:, None, None] * np.array([1.0, -0.5, 0.3])
    drift = drift + 8e-6 / (1 + np.exp(-(np.arange(600) - 120) / 20))[:, None, None]
    assert paper.sightings(replace(still, field_t=still.field_t + drift), TAGS, SPEED) == []
    moved = replace(samples, field_t=samples.field_t + drift)
    (sighting,) = paper.sightings(moved, TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].mean() < 2.4e-3


def test_lost_samples_and_a_dead_sensor_that_sees_nothing() -> None:
    truth = lying(0.17, 0.02, 0.0)
    samples = drive([truth], 0.34)
    field = samples.field_t.copy()
    field[np.random.default_rng(3).random(field.shape[:2]) < 0.02] = np.nan
    field[:, 0] = np.nan
    (sighting,) = paper.sightings(replace(samples, field_t=field), TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].mean() < 2.4e-3
    (warning,) = sighting.warnings
    assert warning == SolverWarning("sensor_silent", "without sensor 1, which gave no samples")


@pytest.mark.slow
def test_sensors_may_come_in_any_order() -> None:
    samples = drive([lying(0.17, 0.004, 0.4)], 0.34)
    order = np.random.default_rng(4).permutation(9)
    array = replace(samples.array, position_m=samples.array.position_m[order])
    mixed = Samples("bar", array, samples.time_ns, samples.field_t[:, order])
    (mine,) = paper.sightings(samples, TAGS, SPEED)
    (other,) = paper.sightings(mixed, TAGS, SPEED)
    np.testing.assert_allclose(other.position_m, mine.position_m)


def test_nothing_is_found_in_noise() -> None:
    assert paper.sightings(drive([], 0.5), TAGS, SPEED) == []


def test_a_long_slow_recording_is_thinned_out() -> None:
    truth = lying(0.15, 0.004, 0.0)
    samples = drive([truth], 0.3, step=1e-4)
    (sighting,) = paper.sightings(samples, TAGS, SPEED)
    assert compared(sighting, samples, truth)[:, 0].mean() < 2.4e-3


def test_what_cannot_be_solved_is_refused() -> None:
    samples = drive([], 0.3)
    with pytest.raises(InputError, match="speed") as error:
        paper.sightings(samples, TAGS, None)
    assert "--speed" in str(error.value.hint)
    with pytest.raises(InputError, match=r"10 mm apart.*40 mm"):
        paper.sightings(samples, TAGS, 10 * SPEED)
    with pytest.raises(InputError, match="too few"):
        paper.sightings(
            Samples("bar", samples.array, samples.time_ns[:9], samples.field_t[:9]), TAGS, SPEED
        )
    lost = samples.field_t.copy()
    lost[:, 1:] = np.nan
    with pytest.raises(InputError, match="1 of 9 sensors"):
        paper.sightings(replace(samples, field_t=lost), TAGS, SPEED)


# ---- The published recordings

TRUE_MM = np.array([(0, 0), (40, 40), (80, 40), (0, 80), (80, 80)], float)
"""To the right and ahead of the first magnet."""

RUNS = {"default": range(1, 11), "varying": range(1, 4)}
NOMINAL = {"default": np.zeros(5), "varying": np.radians([0, -45, -90, -135, -180])}
RIGID_MM = {"default": 1.46, "varying": 2.36}
ANCHORED_MM = {"default": 1.68, "varying": 2.71}
"""The authors' own: facts/polaris.md 1."""


@functools.cache
def published(file: Path) -> Samples:
    with file.open(newline="") as lines:
        rows = list(csv.reader(lines))[1:]
    raw = np.array([[ast.literal_eval(cell) for cell in row[2:]] for row in rows]) * 1e-6
    # Their axes are right, back and down, and 40 samples a second is their decoder's.
    field = np.stack([-raw[..., 1], -raw[..., 0], -raw[..., 2]], axis=-1)
    time = np.rint(np.arange(len(raw)) / 40 * 1e9).astype(np.int64)
    return Samples("bar", SensorArray(bar(9, 0.02)), time, field)


Scores = dict[str, list[tuple[float, float, Array, float]]]
"""By set and run: rigid and anchored error in mm, angles less their nominal, heading."""


@pytest.fixture(scope="module", params=[0.010, 0.015], ids=["10 mm", "15 mm"])
def scored(data: Path, request: pytest.FixtureRequest) -> Scores:
    """With the clearance of the paper, and with that of the authors' code."""
    tags = replace(TAGS, clearance_m=request.param)
    found: Scores = {}
    for kind, runs in RUNS.items():
        found[kind] = []
        for run in runs:
            samples = published(data / "polaris" / kind / f"RawData_{run}.csv")
            (sighting,) = paper.sightings(samples, tags, 0.105)
            assert len(sighting) == 5
            place = 1e3 * np.column_stack([-sighting.position_m[:, 1], sighting.position_m[:, 0]])
            apart = np.linalg.norm(place[:, None] - place[0] - TRUE_MM, axis=2)
            order = apart.argmin(axis=0)
            assert sorted(order.tolist()) == [0, 1, 2, 3, 4]
            place = place[order]
            laid = umeyama(place, TRUE_MM, with_scale=False).apply(place)
            pattern = paper.pose_and_angles(sighting, tags)
            assert pattern is not None
            assert [pattern[1][k] for k in order] == list(LAYOUT.cells)
            turn = sighting.angle_rad[order] - NOMINAL[kind]
            found[kind].append(
                (
                    float(np.linalg.norm(laid - TRUE_MM, axis=1).mean()),
                    float(np.linalg.norm(place - place[0] - TRUE_MM, axis=1).mean()),
                    np.remainder(turn + math.pi, math.tau) - math.pi,
                    pattern[0][2],
                )
            )
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNS)
def test_places_are_no_worse_than_the_authors(scored: Scores, kind: str) -> None:
    rigid, anchored = np.mean([run[:2] for run in scored[kind]], axis=0)
    assert rigid <= RIGID_MM[kind]
    assert anchored <= ANCHORED_MM[kind]


def test_orientations_and_headings_of_the_published_runs(
    scored: Scores, request: pytest.FixtureRequest
) -> None:
    runs = [run for kind in RUNS for run in scored[kind]]
    turns = np.abs(np.degrees([run[2] for run in runs]))
    assert np.median(turns) < 12
    # The recordings were made at about 11.6 mm: templates for 10 mm are too narrow.
    assert np.sum(turns > 22.5) <= (6 if "10 mm" in request.node.name else 0)
    assert np.mean([abs(math.degrees(run[3])) for run in runs]) < 1.3
