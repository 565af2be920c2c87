"""First places of magnets, on fields of magpylib's cylinders."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.polaris.detection import magnets as magnets_module
from locatk.core.polaris.detection.magnets import (
    MagnetCandidate,
    MagnetHypothesis,
    MatchedFilter,
    detect_magnets,
    detect_magnets_at,
)
from locatk.core.polaris.preprocessing import find_passes, preprocess
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

NOISE = 5e-7
HEIGHT = 0.01


def atoms_of(
    world: Any,
    tags: list[Any],
    *,
    most: int = 8,
    height: float = HEIGHT,
    scale: float = 1.0,
    count: int = 9,
    course: Any = None,
) -> tuple[list[MagnetCandidate], float]:
    """What the scan finds where the way is known up to ``scale``; the bar starts at -0.12."""
    course = course or world.line(length=0.24)
    samples = world.record(
        tags, course, offsets=0.0, earth=(0, 0, 0), array=world.bar(count), seed=1
    )
    t = (samples.time_ns - world.start_ns) * 1e-9
    path = scale * course.at(t)[0]
    matched_filter = MatchedFilter(samples.array.position_m, np.full((count, 3), NOISE), height)
    return matched_filter.find_magnets(
        path, samples.field_t.reshape(len(samples), -1) / NOISE, most, 80.0
    )


def single(world: Any, x: float, y: float, angle: float = 0.0, share: float = 1.0) -> Any:
    return world.Tag(((0, 0),), (0,), x=x, y=y, heading=angle, order=1, strength=(share,))


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5, -2.0])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.03, 0.051), (-0.02, -0.083)])
def test_one_magnet(place: tuple[float, float], angle: float, world: Any) -> None:
    atoms, left = atoms_of(world, [single(world, *place, angle)], most=1)
    (atom,) = atoms
    # Rows are a quarter of the height apart, places half of it.
    assert abs(atom.position_m[0] - place[0]) < 0.2 * HEIGHT
    assert abs(atom.position_m[1] - place[1]) < 0.3 * HEIGHT
    towards = np.arctan2(atom.moment_am2[1], atom.moment_am2[0])
    assert abs(world.turn(towards, angle)) < 0.15
    assert np.hypot(*atom.moment_am2) == pytest.approx(1.81e-3, rel=0.25)
    assert left < 0.15


@pytest.mark.parametrize("wrong", [0.75, 1.3])
def test_height_need_not_be_right(wrong: float, world: Any) -> None:
    atoms, _ = atoms_of(world, [single(world, 0.01, 0.02, 0.5)], most=1, height=wrong * HEIGHT)
    assert np.linalg.norm(atoms[0].position_m - [0.01, 0.02]) < 0.4 * HEIGHT


def test_the_right_speed_explains_most(world: Any) -> None:
    """By this the solver chooses the speed to begin with."""
    tag = world.Tag(((0, 0), (0, 2), (2, 2)), (1, 4, 6))
    left = [atoms_of(world, [tag], most=3, scale=s)[1] for s in (0.3, 0.55, 1.0, 1.8, 3.0)]
    assert np.argmin(left) == 2


def test_magnets_of_a_tag_the_strongest_first(world: Any) -> None:
    cells = ((0, 0), (1, 1), (0, 2), (2, 2))
    tag = world.Tag(cells, (0, 3, 5, 6), strength=(1.0, 1.1, 0.7, 0.85), heading=0.3)
    atoms, left = atoms_of(world, [tag], most=4)
    positions = np.array([atom.position_m for atom in atoms])
    nearest = np.linalg.norm(positions[:, None] - tag.places[None], axis=2)
    assert sorted(nearest.argmin(axis=1)) == [0, 1, 2, 3]
    assert nearest.min(axis=1).max() < 0.4 * HEIGHT
    energies = [atom.energy for atom in atoms]
    assert energies == sorted(energies, reverse=True)
    assert left < 0.2


def test_the_path_may_go_backward(world: Any) -> None:
    course = world.driven(world.line(length=0.24), [0, 2.4], [1, 0])
    atoms, _ = atoms_of(world, [single(world, 0.03, -0.01, 1.0)], most=1, course=course)
    assert np.linalg.norm(atoms[0].position_m - [0.03, -0.01]) < 0.3 * HEIGHT


@pytest.mark.parametrize("count", [2, 3, 9])
def test_noise_holds_no_magnet(count: int, world: Any) -> None:
    atoms, left = atoms_of(world, [], count=count)
    assert atoms == []
    assert left == 1.0


def grown(world: Any, sources: list[Any], **more: Any) -> MagnetHypothesis:
    """The first explanation of a recording that is one pass."""
    samples = world.record(sources, world.line(length=0.26), seed=5)
    preprocessed = preprocess(samples)
    (part,) = find_passes(preprocessed.samples, preprocessed.noise_t)
    return next(detect_magnets(preprocessed, part, TAGS, **more))


CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = (0, 3, 5, 2, 6)
TAGS = Tags()


def test_a_weak_source_is_no_magnet(world: Any) -> None:
    """A magnet of a quarter of the strength, between cells."""
    tag = world.Tag(CELLS, SYMBOLS)
    weak = single(world, 0.02, 0.03, share=0.25)
    magnets = grown(world, [tag, weak]).magnets
    assert len(magnets) == 5
    assert magnets.other_sources == 1


def test_noise_of_the_residual_scales_the_covariance(world: Any) -> None:
    """A field that no dipole explains makes all standard deviations larger."""
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.26), seed=5)
    preprocessed = preprocess(samples)
    (part,) = find_passes(preprocessed.samples, preprocessed.noise_t)
    sure = next(detect_magnets(preprocessed, part, TAGS)).magnets
    understated = replace(preprocessed, noise_t=preprocessed.noise_t / 2)
    unsure = next(detect_magnets(understated, part, TAGS)).magnets
    assert unsure.robust_residual_sigma == pytest.approx(2 * sure.robust_residual_sigma, rel=0.1)
    ratio = np.sqrt(np.diag(unsure.covariance) / np.diag(sure.covariance))
    # The sandwich estimator of single magnets has an uncertainty of its own.
    np.testing.assert_allclose(ratio[2::3], 1.0, rtol=0.5)
    assert ratio[2::3].mean() == pytest.approx(1.0, rel=0.15)


def test_a_contradicted_path_is_replaced(world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.26), seed=5)
    path = 0.5 * np.linspace(0, 0.26, len(samples))
    magnets = grown(world, [world.Tag(CELLS, SYMBOLS)], path_m=path).magnets
    assert magnets.is_path_estimated


def test_sources_at_given_positions(world: Any) -> None:
    """Weak ones are dropped; the frame is that of the first explanation."""
    tag = world.Tag(CELLS, SYMBOLS)
    samples = world.record([tag], world.line(length=0.26), seed=5)
    hypothesis = grown(world, [tag])
    grid = world.Tag(tuple((c, r) for r in range(3) for c in range(3)), (0,) * 9).places
    shift = hypothesis.magnets.position_m.mean(axis=0) - tag.places.mean(axis=0)
    again = detect_magnets_at(samples, hypothesis, grid + shift).magnets
    assert (len(again), again.other_sources) == (5, 0)
    distance = np.linalg.norm(
        again.position_m[:, None] - hypothesis.magnets.position_m[None], axis=2
    )
    assert distance.min(axis=1).max() < 1e-3


def test_a_fit_whose_height_collapses_is_given_up() -> None:
    """The rows of the matched filter follow the height: ten micrometres would take hours."""
    prepared: Any = SimpleNamespace(window=SimpleNamespace())
    fit: Any = SimpleNamespace(state=SimpleNamespace(height_m=1e-5))
    with pytest.raises(DegenerateError, match="height"):
        magnets_module._find_missed_sources(prepared, fit)
