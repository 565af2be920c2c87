"""Frames from standstills: roles, the plane of a floor, and the transformed solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core import lighthouse
from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene
from locatk.core.lighthouse.scene.floor_frame import (
    FLOOR_SIGMA_M,
    MAX_FLOOR_MISFIT_M,
    PLACEMENT_SIGMA_M,
    fit_floor_frame,
)
from locatk.core.lighthouse.scene.gravity import UpEstimate
from locatk.core.lighthouse.scene.levelling import level_solution
from locatk.core.lighthouse.scene.setup import (
    SceneSetup,
    add_to_prior,
    assign_standstills,
    place_on_floor,
    with_standstills,
)
from locatk.core.lighthouse.scene.standstills import Standstill, find_standstills

from .rooms import Stay, measured_up, room, sweeps_of

S = 10**9
RESTS = [Standstill("r", k * 10 * S, k * 10 * S + 3 * S) for k in range(4)]
MARKERS = (("a", (0.0, 0.0, 0.0)), ("b", (1.0, 0.0, 0.0)), ("c", (1.0, 1.0, 0.0)))


def roles(setup: SceneSetup, rests: list[Standstill] = RESTS) -> list[str]:
    return [each.role for each in assign_standstills(setup, rests)]


def test_roles_follow_the_order_of_time() -> None:
    assert roles(SceneSetup()) == ["", "", "", ""]
    assert roles(SceneSetup(markers=MARKERS)) == ["a", "b", "c", ""]
    assert roles(SceneSetup(markers=MARKERS, ignored=(2,))) == ["a", "", "b", "c"]
    assert roles(SceneSetup(has_floor=True)) == ["origin", "x axis", "floor", "floor"]
    assert roles(SceneSetup(has_floor=True, ignored=(1,))) == ["", "origin", "x axis", "floor"]
    assert roles(SceneSetup(has_floor=True, origin=3)) == ["x axis", "floor", "origin", "floor"]
    assert roles(SceneSetup(has_floor=True, origin=4, x_axis=2)) == [
        "floor",
        "x axis",
        "floor",
        "origin",
    ]


@pytest.mark.parametrize(
    ("setup", "rests", "words"),
    [
        (SceneSetup(markers=MARKERS), RESTS[:2], "3 markers and 2 standstills"),
        (SceneSetup(has_floor=True), RESTS[:1], "needs two standstills"),
        (SceneSetup(has_floor=True), [], "needs two standstills"),
        (SceneSetup(has_floor=True, origin=5), RESTS, "no standstill 5"),
        (SceneSetup(has_floor=True, ignored=(0,)), RESTS, "no standstill 0"),
        (SceneSetup(has_floor=True, origin=2, x_axis=2), RESTS, "the same standstill"),
        (SceneSetup(has_floor=True, device="x"), RESTS, "'x' did not rest"),
        (SceneSetup(has_floor=True), [*RESTS, replace(RESTS[0], device="s")], "2 devices rested"),
    ],
)
def test_setups_that_do_not_match(setup: SceneSetup, rests: list[Standstill], words: str) -> None:
    with pytest.raises(InputError, match=words):
        assign_standstills(setup, rests)


def test_one_device_of_several() -> None:
    rests = [RESTS[0], replace(RESTS[1], device="s"), RESTS[2]]
    named = assign_standstills(SceneSetup(has_floor=True, device="r"), rests)
    assert [(each.number, each.standstill.device, each.role) for each in named] == [
        (1, "r", "origin"),
        (2, "r", "x axis"),
    ]


def test_markers_and_the_x_axis_reach_the_solver() -> None:
    setup = SceneSetup(markers=MARKERS, height_m=0.02)
    prior = add_to_prior(
        Scene(markers=(Marker("old", np.zeros(3)),)),
        setup,
        assign_standstills(setup, RESTS),
        is_rigid=False,
    )
    assert [marker.name for marker in prior.markers] == ["a", "b", "c"]
    assert prior.markers[1].position.tolist() == [1.0, 0.0, 0.02]
    assert prior.markers[1].visits == (MarkerVisit("r", 10 * S, 13 * S),)

    setup = SceneSetup(has_floor=True, x_distance_m=1.5)
    assigned = assign_standstills(setup, RESTS)
    old = Scene(markers=(Marker("old", np.zeros(3)),))
    prior = add_to_prior(old, setup, assigned, is_rigid=False)
    assert prior.markers == ()
    (distance,) = prior.distances
    assert (distance.first.start_ns, distance.second.start_ns) == (0, 10 * S)
    assert distance.distance == 1.5
    assert add_to_prior(old, setup, assigned, is_rigid=True).distances == ()


# ---- the plane of a floor

FLOOR = np.array([[0.0, 0, 0], [1.2, 0, 0], [1.0, 1.5, 0], [-0.8, 1.0, 0], [0.2, -1.0, 0]])
STATIONS = np.array([[2.0, 0, 2.0], [-2.0, 1.0, 2.2]])


def frame_of(rng: np.random.Generator) -> Similarity:
    """Return the transform to a frame as that of a station: tilted, turned and moved."""
    return Similarity(1.0, rotation_exp(rng.normal(0, 1.2, 3)), rng.normal(size=3))


@pytest.mark.parametrize("count", [3, 5])
@pytest.mark.parametrize("with_gravity", [False, True])
def test_a_floor_is_as_level_as_it_says(count: int, with_gravity: bool) -> None:
    rng = np.random.default_rng(count)
    squares, headings = [], []
    for _ in range(300):
        to = frame_of(rng)
        up = to.rotation @ rotation_exp(rng.normal(0, 0.03, 3))[:, 2]
        heights = np.c_[np.zeros((count, 2)), rng.normal(0, FLOOR_SIGMA_M, count)]
        placed = np.c_[rng.normal(0, PLACEMENT_SIGMA_M, (count, 2)), np.zeros(count)]
        frame = fit_floor_frame(
            to.apply(FLOOR[:count] + heights + placed),
            to.apply(STATIONS),
            UpEstimate(up, 0.03, ("a",)) if with_gravity else None,
        )
        turned = frame.to_floor.rotation @ to.rotation
        # The least certain axis has the stated standard deviation.
        squares.append(turned[:2, 2] / frame.level_sigma_rad)
        headings.append(turned[1, 0] / frame.heading_sigma_rad)
    spread = np.linalg.eigvalsh(np.cov(np.array(squares).T))[-1]
    # The scatter of three points cannot be verified; that of five is taken if it is larger.
    assert 0.7 < spread < 1.25
    assert 0.8 < np.mean(np.square(headings)) < 1.25


def test_the_floor_is_below_the_stations_and_scaled() -> None:
    rng = np.random.default_rng(50)
    for _ in range(20):
        to = frame_of(rng)
        to = replace(to, scale=0.37)
        frame = fit_floor_frame(
            to.apply(FLOOR), to.apply(STATIONS), x_distance_m=1.2, height_m=0.03
        )
        assert frame.to_floor.scale == pytest.approx(1 / 0.37)
        raised = FLOOR + [0, 0, 0.03]
        assert frame.to_floor.apply(to.apply(FLOOR)) == pytest.approx(raised, abs=1e-9)
        assert frame.to_floor.apply(to.apply(STATIONS)) == pytest.approx(
            STATIONS + [0, 0, 0.03], abs=1e-9
        )
        assert frame.scale_sigma == pytest.approx(np.sqrt(2) * PLACEMENT_SIGMA_M / 1.2)


def test_points_on_one_line_need_gravity() -> None:
    rng = np.random.default_rng(51)
    to = frame_of(rng)
    for points in (FLOOR[:2], np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [1.5, 0.001, 0]])):
        with pytest.raises(DegenerateError, match="on one line"):
            fit_floor_frame(to.apply(points), to.apply(STATIONS))
        up = UpEstimate(to.rotation[:, 2], 0.02, ("a",))
        frame = fit_floor_frame(to.apply(points), to.apply(STATIONS), up)
        assert frame.to_floor.apply(to.apply(points)) == pytest.approx(points, abs=1e-6)
        assert frame.level_sigma_rad == pytest.approx(0.02, rel=0.05)


def test_points_that_are_no_floor_are_refused() -> None:
    points = FLOOR + [[0, 0, h] for h in (0.0, 0.5, -0.4, 0.3, 0.6)]
    with pytest.raises(DegenerateError, match="no floor"):
        fit_floor_frame(points, STATIONS)
    with pytest.raises(DegenerateError, match="is that of the origin"):
        fit_floor_frame(np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 1, 0]]), STATIONS)
    uneven = FLOOR + [[0, 0, h] for h in (0.0, 0.012, -0.01, 0.01, 0.0)]
    frame = fit_floor_frame(uneven, STATIONS)
    flat = fit_floor_frame(FLOOR, STATIONS)
    assert frame.misfit_m is not None
    assert frame.level_sigma_rad / flat.level_sigma_rad == pytest.approx(
        frame.misfit_m / FLOOR_SIGMA_M, rel=1e-3
    )


@pytest.mark.parametrize("count", [2, 3, 5])
def test_points_that_contradict_a_given_normal_are_refused(count: int) -> None:
    up = np.array([0.0, 0.0, 1.0])
    flat = fit_floor_frame(FLOOR[:count], STATIONS, normal=up)
    assert flat.misfit_m == pytest.approx(0.0, abs=1e-12)
    # Half of the tolerance is accepted and reported, twice the tolerance is refused.
    tilt = (FLOOR[:count, 0] - FLOOR[:count, 0].mean()) / np.std(FLOOR[:count, 0], ddof=1)
    for factor in (0.5, 2.0):
        points = FLOOR[:count] + factor * MAX_FLOOR_MISFIT_M * tilt[:, None] * up
        if factor > 1:
            with pytest.raises(DegenerateError, match=r"100 mm \(rms\) from one plane"):
                fit_floor_frame(points, STATIONS, normal=up)
        else:
            misfit = fit_floor_frame(points, STATIONS, normal=up).misfit_m
            assert misfit == pytest.approx(factor * MAX_FLOOR_MISFIT_M)


# ---- end to end, from sweeps of ideal stations

TOUR = (
    Stay((0.0, 0.0, 0.0)),
    Stay((1.0, 0.0, 0.0)),
    Stay((0.9, 1.1, 0.0)),
    Stay((-0.7, 0.6, 0.0)),
    *(
        Stay(point, 0.05, 1.2)
        for point in np.random.default_rng(4).uniform([-1, -1, 0.1], [1, 1, 1.3], (15, 3)).tolist()
    ),
    Stay((0.0, 0.0, 0.5), 0.05),
)
SQUARE = Receiver(
    np.array([[0.08, 0.05, 0], [-0.08, 0.05, 0.02], [-0.08, -0.05, 0], [0.08, -0.05, 0.03]])
)


@pytest.mark.slow
@pytest.mark.parametrize("is_rigid", [False, True])
def test_a_room_is_set_up_on_its_floor(is_rigid: bool) -> None:
    """The first station hangs rolled and looks down; neither frame nor scale are known."""
    rng = np.random.default_rng(60)
    truth = room(rng, 2, roll_rad=0.5)
    offsets = SQUARE.position_m.tolist() if is_rigid else [[0.0, 0.0, 0.0]]
    sweeps = sweeps_of(truth, TOUR, rng, noise_rad=5e-5, offsets=offsets)
    prior = Scene(
        calibrations={s.channel: s.calibration for s in truth.stations},
        ups={s.channel: measured_up(rng, s, 0.03) for s in truth.stations},
    )
    setup = SceneSetup(has_floor=True, x_distance_m=1.0)
    rests = assign_standstills(setup, find_standstills(sweeps))
    assert [each.role for each in rests] == ["origin", "x axis", "floor", "floor"]
    known = add_to_prior(prior, setup, rests, is_rigid=is_rigid)
    more = {"receivers": {"robot": SQUARE}} if is_rigid else {}
    solution = lighthouse.solve(sweeps, known, **more)
    solution = level_solution(place_on_floor(solution, setup, rests, known), known)
    solution = with_standstills(solution, rests)
    scene = solution.artifact
    assert (scene.frame_source, scene.scale, scene.is_on_floor) == ("floor", "distance", True)
    for station in scene.stations:
        own = truth.station(station.channel)
        assert own is not None
        assert station.position == pytest.approx(own.position, abs=0.02)
        assert station.rotation == pytest.approx(own.rotation, abs=0.01)
    for rest, stay in zip(solution.facts.frame.standstills, TOUR, strict=False):
        assert rest.position_m == pytest.approx(stay.point, abs=0.01)
    assert np.degrees(scene.level_sigma_rad) < 0.5
    assert solution.facts.frame.up_deviation_rad < 3 * solution.facts.frame.up_sigma_rad
