"""The figures of the published recordings, computed here and not by the bench.

Peers and metrics: the program of github.com/wjk5117/Polaris, run again on its 30 recordings.
The recordings are read here too, by a few lines that share nothing with the importer.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples
from locatk.core.polaris.mlx90393 import published_bar
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import Tags

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

TAGS = Tags(codec="polaris-released")
IDS = {"default": 262143, "varying": 255183}
RUNS = {"default": 10, "varying": 3}

TRUTH_MM = np.array([0, 40 + 40j, 80 + 40j, 80j, 80 + 80j])
"""The authors' layout: real to the right, imaginary along the track; counted as they do."""

CLOCKWISE_DEG = {"default": [0, 0, 0, 0, 0], "varying": [0, 45, 90, 135, 180]}

AUTHORS = {
    "default": {"rigid": 1.46, "anchored": 1.68, "scatter": 4.7, "heading": 1.14},
    "varying": {"rigid": 2.36, "anchored": 2.71, "scatter": 9.8, "heading": 1.78},
}


def recorded(path: Path) -> Samples:
    """A run as it was published: x right, y back, z down, sensor 1 rightmost, 40 Hz."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    cells = [[[float(v) for v in cell.strip("()").split(",")] for cell in row[2:]] for row in rows]
    ut = np.array(cells)
    field_t = np.stack([-ut[..., 1], -ut[..., 0], -ut[..., 2]], axis=-1) * 1e-6
    time_ns = (1e9 + np.arange(len(rows)) * 25e6).astype(np.int64)
    return Samples("bar", published_bar(), time_ns, field_t)


@dataclass(frozen=True)
class Run:
    """One run as it was solved: magnets in the authors' order."""

    tag_id: int | None
    place_mm: NDArray[np.complex128]
    angle_rad: Array
    heading_rad: float
    margin: float | None
    detection: TagDetection


def aligned(place_mm: NDArray[np.complex128]) -> float:
    """Mean distance in mm from the layout after the best rotation and translation."""
    a, b = place_mm - place_mm.mean(), TRUTH_MM - TRUTH_MM.mean()
    rotation = np.vdot(a, b)
    return float(np.abs(a * rotation / abs(rotation) - b).mean())


def solved(samples: Samples, options: SolveOptions) -> Run:
    (result,) = solve([samples], TAGS, options).detections
    position = np.array([-m.y_m + 1j * m.x_m for m in result.magnets]) * 1e3
    angle = np.array([m.angle_rad for m in result.magnets])
    assert len(position) == 5
    order = min(permutations(range(5)), key=lambda order: aligned(position[list(order)]))
    position, angle = position[list(order)], angle[list(order)]
    return Run(result.tag_id, position, angle, result.heading_rad, result.margin, result)


@pytest.fixture(scope="module")
def samples(recordings: Path) -> dict[str, list[Samples]]:
    return {
        name: [recorded(recordings / name / f"RawData_{k}.csv") for k in range(1, count + 1)]
        for name, count in RUNS.items()
    }


@pytest.fixture(scope="module")
def runs(samples: dict[str, list[Samples]]) -> dict[str, list[Run]]:
    """By the default method, which is told nothing but the tag's design."""
    return {name: [solved(one, SolveOptions()) for one in some] for name, some in samples.items()}


def rigid(run: Run) -> float:
    return aligned(run.place_mm)


def anchored(run: Run) -> float:
    """The authors' metric: the first magnet laid on its place, nothing turned."""
    return float(np.abs(run.place_mm - run.place_mm[0] - TRUTH_MM).mean())


def scatter_deg(some: list[Run]) -> float:
    """Rms of the orientations about each magnet's own mean over the runs."""
    rotated = np.exp(1j * np.array([run.angle_rad for run in some]))
    return float(np.degrees(np.sqrt(np.mean(np.angle(rotated * rotated.mean(axis=0).conj()) ** 2))))


@pytest.mark.parametrize("name", RUNS)
def test_no_wrong_bit(name: str, runs: dict[str, list[Run]]) -> None:
    """The authors: 5 wrong bits of 540 over their 30 runs."""
    assert [run.tag_id for run in runs[name]] == [IDS[name]] * RUNS[name]
    assert all(run.margin is not None and run.margin > 0.25 for run in runs[name])


@pytest.mark.parametrize(("name", "most_mm"), [("default", 0.75), ("varying", 0.80)])
def test_position_rigid_aligned(name: str, most_mm: float, runs: dict[str, list[Run]]) -> None:
    mean = np.mean([rigid(run) for run in runs[name]])
    assert mean <= most_mm < AUTHORS[name]["rigid"]


@pytest.mark.parametrize(("name", "most_mm"), [("default", 1.5), ("varying", 1.6)])
def test_position_in_the_authors_metric(
    name: str, most_mm: float, runs: dict[str, list[Run]]
) -> None:
    mean = np.mean([anchored(run) for run in runs[name]])
    assert mean <= most_mm < AUTHORS[name]["anchored"]


@pytest.mark.parametrize("name", RUNS)
def test_orientation_scatter(name: str, runs: dict[str, list[Run]]) -> None:
    assert scatter_deg(runs[name]) <= 0.65 < AUTHORS[name]["scatter"]


@pytest.mark.parametrize("name", RUNS)
def test_orientations_equal_those_of_the_tag(name: str, runs: dict[str, list[Run]]) -> None:
    """Hand-laid: the worst magnet is 13 degrees off, in each run the same."""
    expected = np.exp(-1j * np.radians(CLOCKWISE_DEG[name]))
    for run in runs[name]:
        off = np.degrees(np.angle(np.exp(1j * run.angle_rad) / expected))
        assert np.abs(off).max() < 16


def test_heading(runs: dict[str, list[Run]]) -> None:
    """The car was set straight by hand: nobody knows better than 0, and each run for itself
    may well be a degree off. Over all thirteen the issue's figure holds."""
    mean = np.degrees(np.mean([abs(run.heading_rad) for name in RUNS for run in runs[name]]))
    assert mean <= 0.5 < AUTHORS["default"]["heading"]


@pytest.mark.parametrize("name", RUNS)
def test_uncertainty_is_of_the_size_of_the_errors(name: str, runs: dict[str, list[Run]]) -> None:
    """How the car stood is not known (one of the ten runs is 1.6 degrees askew, the others
    scatter by 0.3), nor where the tag lay: so much only."""
    for run in runs[name]:
        result = run.detection
        assert 0.1 < np.degrees(result.sigma_heading_rad) < 1.0
        assert 1e-4 < result.sigma_y_m < 1e-3
        assert 0.8 < result.residual_sigma < 1.6
    askew = [abs(run.heading_rad / run.detection.sigma_heading_rad) for run in runs[name]]
    assert np.median(askew) < 2.5


def test_height_and_moments_are_those_of_an_independent_fit(runs: dict[str, list[Run]]) -> None:
    """11.4 to 11.9 mm and 1.1 to 1.4 mA m^2 by an independent least-squares fit of all dipoles."""
    every = [run.detection for some in runs.values() for run in some]
    assert 0.0105 < np.median([result.height_m for result in every]) < 0.0125
    moments = [magnet.moment_am2 for result in every for magnet in result.magnets]
    assert 1.0e-3 < np.median(moments) < 1.5e-3


def test_a_dead_sensor_does_not_change_the_reading(samples: dict[str, list[Samples]]) -> None:
    """Facts 1: the noise of the array is not known beforehand."""
    for dead in (2, 6):
        one = samples["default"][dead]
        field = one.field_t.copy()
        field[:, dead] = np.nan
        assert solved(replace(one, field_t=field), SolveOptions()).tag_id == IDS["default"]


@pytest.fixture(scope="module")
def published_runs(samples: dict[str, list[Samples]]) -> dict[str, list[Run]]:
    """By the published method, which needs the speed."""
    options = SolveOptions(method="paper", speed_mps=0.105)
    return {name: [solved(one, options) for one in some] for name, some in samples.items()}


@pytest.mark.parametrize(("name", "max_wrong_bits"), [("default", 1), ("varying", 0)])
def test_published_method_reads_as_many_bits_as_its_authors(
    name: str, max_wrong_bits: int, published_runs: dict[str, list[Run]]
) -> None:
    """On these thirteen runs the authors' program has one wrong bit, in a default tag."""
    ids = [run.tag_id for run in published_runs[name]]
    assert None not in ids
    assert sum((tag_id ^ IDS[name]).bit_count() for tag_id in ids if tag_id) <= max_wrong_bits


@pytest.mark.parametrize("name", RUNS)
def test_published_method_is_no_worse_than_its_authors(
    name: str, published_runs: dict[str, list[Run]]
) -> None:
    runs = published_runs[name]
    assert np.mean([rigid(run) for run in runs]) <= AUTHORS[name]["rigid"]
    assert np.mean([anchored(run) for run in runs]) <= AUTHORS[name]["anchored"]
    assert scatter_deg(runs) <= AUTHORS[name]["scatter"]
    heading = np.degrees(np.mean([abs(run.heading_rad) for run in runs]))
    assert heading <= AUTHORS[name]["heading"]


@pytest.mark.parametrize("name", RUNS)
def test_published_method_flips_no_magnet(name: str, published_runs: dict[str, list[Run]]) -> None:
    nominal = np.exp(-1j * np.radians(CLOCKWISE_DEG[name]))
    for run in published_runs[name]:
        assert np.abs(np.degrees(np.angle(np.exp(1j * run.angle_rad) / nominal))).max() < 45


@pytest.mark.parametrize("name", RUNS)
def test_finer_templates_scatter_less(
    name: str, samples: dict[str, list[Samples]], published_runs: dict[str, list[Run]]
) -> None:
    options = SolveOptions(method="paper", speed_mps=0.105, templates=TemplateGrid(72, 9, 80))
    runs = [solved(one, options) for one in samples[name]]
    assert scatter_deg(runs) < 0.9 * scatter_deg(published_runs[name])


@pytest.mark.slow
def test_angles_scatter_over_the_runs_as_their_sigmas_state(runs: dict[str, list[Run]]) -> None:
    """Rotations of the robot are part of the scatter."""
    by_cell = [{m.cell: m for m in run.detection.magnets} for run in runs["default"]]
    cells = sorted(by_cell[0], key=str)
    rotated = np.exp(1j * np.array([[each[cell].angle_rad for cell in cells] for each in by_cell]))
    sigma = np.array([[each[cell].sigma_angle_rad for cell in cells] for each in by_cell])
    deviation = np.angle(rotated * rotated.mean(axis=0).conj())
    count = len(by_cell)
    assert 0.5 < float(((deviation / sigma) ** 2).mean()) * count / (count - 1) < 1.25
