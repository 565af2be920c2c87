"""What goes wrong on floors and in wires: read in spite of it, or refused; never wrong.

What each pass measures is the independent world's (conftest), which the solver cannot see.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris import codec, solver
from locatk.core.polaris.array import Samples
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import PlanarPose, TagLayout, Tags
from locatk.core.solution import Solution

Array = NDArray[np.float64]

TAGS = Tags()
CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = (0, 3, 5, 2, 6)
OTHER = (1, 7, 4, 4, 3)


def id_of(symbols: tuple[int, ...], tags: Tags = TAGS) -> int:
    return codec.id_of(tags, TagLayout(CELLS, symbols))


def the_tag(solution: Solution) -> TagDetection:
    """The one detection that was read."""
    (result,) = [d for d in solution.detections if d.tag_id is not None]
    return result


def errors(world: Any, result: TagDetection, course: Any, tag: Any) -> Array:
    """Of the pose (x, y in m, heading in rad) against the truth at that time."""
    truth = world.true_tag_pose(course, round(result.time_s * 1e9), tag)
    observed = np.array([result.x_m, result.y_m, result.heading_rad]) - truth
    observed[2] = world.turn(observed[2])
    return observed


def sigmas(result: TagDetection) -> Array:
    return np.array([result.sigma_x_m, result.sigma_y_m, result.sigma_heading_rad])


# ---- what goes wrong on floors and in wires


def passed(world: Any, **more: Any) -> tuple[Any, Any, Samples]:
    tag = world.Tag(CELLS, SYMBOLS, heading=more.pop("heading", 2.2))
    course = more.pop("course", world.line(length=0.28))
    return tag, course, world.record([tag], course, **more)


def with_faults(kind: str, samples: Samples) -> Samples:
    """The same recording with one thing wrong."""
    rng = np.random.default_rng(3)
    b = samples.field_t.copy()
    n = len(b)
    u = np.linspace(0, 1, n)[:, None, None]
    keep = np.ones(n, bool)
    if kind == "dead sensor":
        b[:, 5] = np.nan
    elif kind == "dead axis":
        b[:, 4, 2] = np.nan
    elif kind == "stuck sensor":
        b[:, 4] = b[0, 4]
    elif kind == "lost frames":
        keep = rng.random(n) > 0.02
    elif kind == "burst of nan":
        b[120:140] = np.nan
    elif kind == "saturated":
        b[np.abs(b) > 90e-6] = np.nan
    elif kind == "spikes":
        b[rng.random(b.shape) < 0.003] += 3e-4
    elif kind == "one garbage frame":
        b[130] = 1e-3 * rng.standard_normal(b[130].shape)
    elif kind == "drift":
        b += 15e-6 * u * rng.uniform(-1, 1, b.shape[1:])
    elif kind == "the Earth turns":
        b += 10e-6 * np.concatenate([np.cos(3 * u), np.sin(3 * u), 0 * u], axis=2)
    elif kind == "motor":
        b += 8e-6 * np.sin(1.3 * np.arange(n))[:, None, None] * np.array([1.0, 0.5, -0.3])
    elif kind == "motor noise":
        b += 3e-6 * rng.standard_normal((n, 1, 3))
    else:
        raise AssertionError(kind)
    return Samples(samples.device, samples.array, samples.time_ns[keep], b[keep])


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "dead sensor", "dead axis", "stuck sensor", "lost frames", "burst of nan", "saturated",
        "spikes", "one garbage frame", "drift", "the Earth turns", "motor", "motor noise",
    ],
)  # fmt: skip
def test_read_in_spite_of(kind: str, world: Any) -> None:
    tag, course, recording = passed(world, seed=8)
    result = the_tag(solve([with_faults(kind, recording)], TAGS))
    assert result.tag_id == id_of(SYMBOLS)
    error = errors(world, result, course, tag)
    assert np.all(np.abs(error) < [6e-4, 2e-4, np.radians(0.3)])
    assert np.all(np.abs(error) < 4 * sigmas(result))


def test_missing_samples_are_reported(world: Any) -> None:
    _, _, recording = passed(world)
    solution = solve([with_faults("dead sensor", recording)], TAGS)
    (warning,) = [each for each in solution.warnings if each.code == "samples_missing"]
    assert "11 %" in warning.message


def test_iron_debris_is_no_magnet(world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, heading=0.5)
    debris = [world.Debris(0.02, 0.025, 3e-3), world.Debris(-0.05, 0.0, 2e-3)]
    debris += [world.Debris(0.01, -0.055, 4e-3)]
    course = world.line(length=0.28)
    result = the_tag(solve([world.record([tag, *debris], course, seed=4)], TAGS))
    assert result.tag_id == id_of(SYMBOLS)
    assert len(result.magnets) == 5
    assert np.all(np.abs(errors(world, result, course, tag)) < [6e-4, 2e-4, np.radians(0.3)])


@pytest.mark.slow
@pytest.mark.parametrize("step_mm", [0.1, 0.4, 3.0, 7.0])
def test_slow_and_fast(step_mm: float, world: Any) -> None:
    tag, course, recording = passed(world, course=world.line(length=0.26, speed=step_mm / 10))
    result = the_tag(solve([recording], TAGS))
    assert result.tag_id == id_of(SYMBOLS)
    assert np.all(np.abs(errors(world, result, course, tag)) < [6e-4, 1e-4, np.radians(0.2)])
    assert result.speed_mps == pytest.approx(step_mm / 10, rel=0.06)


@pytest.mark.slow
def test_backward(world: Any) -> None:
    course = world.driven(world.line(length=0.28), [0, 2.8], [1, 0])
    tag, _, recording = passed(world, course=course, array=world.bar(7), rate=25.0)
    result = the_tag(solve([recording], TAGS))
    assert result.tag_id == id_of(SYMBOLS)
    assert np.all(np.abs(errors(world, result, course, tag)) < [6e-4, 1e-4, np.radians(0.2)])


@pytest.mark.slow
def test_standing_still_over_the_tag(world: Any) -> None:
    course = world.driven(world.line(length=0.28), [0, 1.2, 2.7, 4.3], [0, 0.43, 0.43, 1])
    tag, _, recording = passed(world, course=course, heading=np.radians(33), seed=2)
    solution = solve([recording], TAGS)
    for result in solution.detections:
        assert result.tag_id in (None, id_of(SYMBOLS))  # read, or refused; never wrong
        if result.tag_id is not None:
            error = errors(world, result, course, tag)
            assert np.all(np.abs(error) < np.maximum(4 * sigmas(result), [6e-4, 1e-4, 3e-3]))


# ---- what must be refused


@pytest.mark.slow
@pytest.mark.parametrize("lateral", [-0.12, -0.08, 0.09, 0.12])
def test_a_tag_partly_outside_the_bar_is_partial(lateral: float, world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, heading=0.1)
    recording = world.record([tag], world.line(lateral=lateral, length=0.28), seed=5)
    solution = solve([recording], TAGS)
    assert [d.tag_id for d in solution.detections] == [None]
    assert solution.rejected == {"partial": 1}
    assert solution.trajectories == ()


@pytest.mark.slow
@pytest.mark.parametrize("part", [slice(0, 110), slice(170, 280)])
def test_recording_cut_within_the_tag_is_partial(part: slice, world: Any) -> None:
    _, _, recording = passed(world, heading=0.0)
    cut = Samples("bar", recording.array, recording.time_ns[part], recording.field_t[part])
    solution = solve([cut], TAGS)
    assert solution.rejected == {"partial": 1}


@pytest.mark.slow
@pytest.mark.parametrize("gone", range(5))
def test_plain_tag_without_a_magnet_is_refused(gone: int, world: Any) -> None:
    strength = tuple(float(k != gone) for k in range(5))
    tag = world.Tag(CELLS, SYMBOLS, heading=1.0, strength=strength)
    solution = solve([world.record([tag], world.line(length=0.28), seed=gone)], TAGS)
    (result,) = solution.detections
    assert result.tag_id is None
    assert result.refused in ("magnets_missing", "partial")  # four fit on more than one grid
    assert len(result.magnets) == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        {"spacing_m": 0.03},
        {"spacing_m": 0.05},
        {"order": 4},
        {"magnets": 6},
        {"orientations": 20},
        {"ids": (1, 2, 3), "min_distance": 2},
    ],
)
def test_tag_of_another_design_is_refused(wrong: dict[str, Any], world: Any) -> None:
    _, _, recording = passed(world, seed=6)
    solution = solve([recording], replace(TAGS, **wrong))
    assert [d.tag_id for d in solution.detections] == [None]
    assert sum(solution.rejected.values()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [0.036, 0.045])
def test_slightly_wrong_spacing_is_never_a_surely_wrong_pose(spacing: float, world: Any) -> None:
    tag, course, recording = passed(world, heading=0.0)
    for result in solve([recording], replace(TAGS, spacing_m=spacing)).detections:
        if result.tag_id is not None:
            assert np.all(np.abs(errors(world, result, course, tag)) < 4 * sigmas(result))


def test_wrong_clearance_does_not_matter(world: Any) -> None:
    tag, course, recording = passed(world)
    for clearance in (0.006, 0.015):
        result = the_tag(solve([recording], replace(TAGS, clearance_m=clearance)))
        assert result.tag_id == id_of(SYMBOLS)
        assert result.height_m == pytest.approx(0.010, abs=1e-4)
        assert np.all(np.abs(errors(world, result, course, tag)) < [6e-4, 1e-4, np.radians(0.2)])


def test_without_a_tag_there_are_magnets_but_no_ids(world: Any) -> None:
    tag, _, recording = passed(world)
    solution = solve([recording], None)
    assert solution.rejected == {"no_tag_given": 1}
    (result,) = solution.detections
    assert result.tag_id is None
    positions = np.array([[m.x_m, m.y_m] for m in result.magnets])
    apart = np.sort(
        np.linalg.norm(positions[:, None] - positions[None], axis=2)[np.triu_indices(5, 1)]
    )
    grid = tag.places
    expected = np.sort(np.linalg.norm(grid[:, None] - grid[None], axis=2)[np.triu_indices(5, 1)])
    np.testing.assert_allclose(apart, expected, atol=1e-3)


# ---- several tags


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ahead", "aside"), [(0.5, 0.0), (0.2, 0.0), (0.13, 0.0), (0.0, 0.13)]
)  # far, near, as near as tags can lie, side by side
def test_two_tags(ahead: float, aside: float, world: Any) -> None:
    first = world.Tag(CELLS, SYMBOLS, x=-ahead / 2, y=-aside / 2, heading=0.2)
    second = world.Tag(CELLS, OTHER, x=ahead / 2, y=aside / 2, heading=-1.0)
    course = world.line(length=0.28 + ahead)
    array = world.bar(9 if not aside else 15)
    recording = world.record([first, second], course, array=array, seed=2)
    solution = solve([recording], TAGS)
    truth = {id_of(SYMBOLS): first, id_of(OTHER): second}
    assert {d.tag_id for d in solution.detections} == set(truth)
    for result in solution.detections:
        error = errors(world, result, course, truth[result.tag_id])
        assert np.all(np.abs(error) < np.maximum([8e-4, 1e-4, 3e-3], 3 * sigmas(result)))


@pytest.mark.slow
def test_order_is_that_of_time_and_the_site_places_the_array(world: Any) -> None:
    tags = [
        world.Tag(CELLS, SYMBOLS, x=0.0, y=0.01, heading=0.4),
        world.Tag(CELLS, OTHER, x=0.6, y=-0.01, heading=2.0),
    ]
    ids = [id_of(SYMBOLS), id_of(OTHER)]
    site = {i: PlanarPose(t.x, t.y, t.heading) for i, t in zip(ids, tags, strict=True)}
    course = world.line(length=0.9, past=(0.3, 0.0))
    solution = solve([world.record(tags, course, seed=9)], replace(TAGS, site=site))
    assert [d.tag_id for d in solution.detections] == ids
    (poses,) = solution.trajectories
    assert poses.frame == "site"
    x, y, _ = course.at((poses.time_ns - world.start_ns) * 1e-9)
    error = poses.position[:, :2] - np.column_stack([x, y])
    assert np.sqrt(np.mean(error**2)) < 3e-4
    assert np.all(np.abs(error) < 4 * poses.sigma[:, :2] + 1e-4)
    (rotation,) = solution.facts.heading_corrections
    assert (rotation.from_tag, rotation.to_tag) == tuple(ids)


# ---- input that is none


def test_bad_input_is_named(world: Any) -> None:
    _, _, recording = passed(world)

    def solved(rows: slice = slice(None), field_t: Array | None = None) -> Solution:
        field_t = recording.field_t if field_t is None else field_t
        return solve(
            [Samples("bar", recording.array, recording.time_ns[rows], field_t[rows])], TAGS
        )

    with pytest.raises(InputError, match="5 samples of bar"):
        solved(slice(0, 5))
    with pytest.raises(InputError, match="0 samples"):
        solved(slice(0, 0))
    with pytest.raises(InputError, match="no sensor of bar"):
        solved(field_t=np.full_like(recording.field_t, np.nan))
    with pytest.raises(InputError, match="unknown method"):
        SolveOptions(method="best")
    with pytest.raises(InputError, match="impossible speed"):
        SolveOptions(speed_mps=-1.0)
    with pytest.raises(InputError, match="joint uses no templates") as error:
        SolveOptions(templates=TemplateGrid())
    assert "--method paper" in str(error.value.hint)
    backwards = replace(recording, time_ns=recording.time_ns[::-1].copy())
    with pytest.raises(InputError, match="time stamps"):
        solve([backwards], TAGS)


@pytest.mark.parametrize("kind", ["zeros", "constant", "noise", "one spike", "earth only"])
def test_nothing_there_is_nothing_found(kind: str, world: Any) -> None:
    rng = np.random.default_rng(0)
    recording = world.record([], world.line(), seed=1)
    b = recording.field_t
    spike = np.full_like(b, 5e-5)
    spike[100, 4] = 1e-3
    field = {
        "zeros": np.zeros_like(b),
        "constant": np.full_like(b, 5e-5),
        "noise": 5e-7 * rng.standard_normal(b.shape),
        "one spike": spike,
        "earth only": b,
    }[kind]
    solution = solve([world.spoiled(recording, field)], TAGS)
    assert solution.detections == ()
    assert solution.trajectories == ()


def test_devices_are_solved_separately(world: Any) -> None:
    tag, course, left = passed(world, device="left", seed=1)
    right = world.record([world.Tag(CELLS, OTHER)], course, device="right", seed=2)
    solution = solve([left, right], TAGS)
    assert {(d.device, d.tag_id) for d in solution.detections} == {
        ("left", id_of(SYMBOLS)),
        ("right", id_of(OTHER)),
    }
    assert [t.device for t in solution.trajectories] == ["left", "right"]
    assert tag.cells == CELLS


def test_the_sigma_of_a_height_follows_the_scale_of_the_path(world: Any) -> None:
    """A speed that is told one percent too high lifts the array by as much."""
    _, _, samples = passed(world, course=world.line(length=0.28, speed=0.1))
    solution = solve([samples], TAGS, SolveOptions(speed_mps=0.101))
    (trajectory,) = solution.trajectories
    off, sigma = trajectory.position[:, 2] - 0.01, trajectory.sigma[:, 2]
    assert np.all(np.abs(off) > 5e-5)
    assert np.all(np.abs(off) < 2 * sigma)
    assert np.all(sigma < 5e-4)


@pytest.mark.slow
def test_passes_are_merged_only_if_that_identifies_a_tag(
    world: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two passes that may be the ends of one tag stay two if the whole cannot be identified."""
    _, _, recording = passed(world, rate=50.0)
    (part,) = solver.find_passes(recording, np.full((9, 3), 5e-7))
    half = (part.first + part.stop) // 2
    ends = [replace(part, stop=half), replace(part, first=half)]
    monkeypatch.setattr(solver, "find_passes", lambda *_: ends)
    monkeypatch.setattr(solver, "may_be_one_tag", lambda *_: True)
    assert len(solve([recording], replace(TAGS, spacing_m=0.03)).detections) == 2
    (merged,) = solve([recording], TAGS).detections
    assert merged.tag_id == id_of(SYMBOLS)


# ---- before the robot starts, and how hosts stamp samples


@pytest.mark.slow
def test_drift_before_the_start_is_no_refused_pass(world: Any) -> None:
    """Three seconds at rest, while sensors warm up and a tool is laid down nearby."""
    tag = world.Tag(CELLS, SYMBOLS)
    course = world.driven(world.line(length=0.4), [0, 3, 7], [0, 0, 1])
    samples = world.record([tag], course, noise=0.9e-6, rate=60.0, seed=7)
    rng = np.random.default_rng(7)
    time = np.arange(len(samples))[:, None, None] / 60
    change = 12e-6 * rng.standard_normal((9, 3)) / (1 + np.exp(-(time - 1.0) / 0.05))
    change = change + 5e-6 * rng.standard_normal((9, 3)) * np.exp(-time / rng.uniform(0.2, 0.6))
    solution = solve([world.spoiled(samples, samples.field_t + change)], TAGS)
    assert [d.tag_id for d in solution.detections] == [id_of(SYMBOLS)]
    assert solution.rejected["no_pass"] >= 1
    assert sum(solution.rejected.values()) == solution.rejected["no_pass"]


def test_equal_time_stamps_do_not_lose_a_pass(world: Any) -> None:
    tag, course, samples = passed(world)
    for count in (2, 8):
        time_ns = samples.time_ns.copy()
        middle = len(time_ns) // 2
        time_ns[middle : middle + count] = time_ns[middle + count - 1]
        result = the_tag(solve([replace(samples, time_ns=time_ns)], TAGS))
        assert result.tag_id == id_of(SYMBOLS)
        assert np.all(np.abs(errors(world, result, course, tag)[1:]) < [1e-3, 0.01])
