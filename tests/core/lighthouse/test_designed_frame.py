"""Scenes of designed rooms: stations that were mounted beside their designed poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit, Scene, Station
from locatk.core.lighthouse.scene.designed_frame import (
    DesignedFrame,
    design_prior,
    fit_designed_frame,
)
from locatk.core.lighthouse.solver import SolveOptions, solve
from locatk.core.solution import Solution
from tests.core.lighthouse import rooms

TOLERANCE = np.repeat([0.02, np.radians(1.5)], 3)
"""Standard deviations of a mounted station, in m and rad."""


def design_of(truth: Scene, rng: np.random.Generator, tolerance: np.ndarray = TOLERANCE) -> Scene:
    """Design of which the stations of ``truth`` differ by the tolerance."""
    stations = []
    for station in truth.stations:
        error = rng.normal(0, tolerance)
        stations.append(
            Station(
                station.channel,
                station.position + error[:3],
                rotation_exp(error[3:]) @ station.rotation,
                station.calibration,
                covariance=np.diag(tolerance**2),
            )
        )
    return Scene(
        tuple(stations),
        scale="design",
        frame_source="design",
        frame="room",
        planar=truth.planar,
        floor_z=truth.floor_z,
    )


def estimated(truth: Scene, rng: np.random.Generator) -> tuple[Scene, Similarity]:
    """Return the true stations in a frame and unit of an estimate, and the transform back."""
    turn = rng.normal(0, 1, 3)
    if truth.planar:
        turn[:2] = 0.0
    to = Similarity(rng.uniform(0.2, 0.5), rotation_exp(turn), rng.normal(0, 2, 3))
    if truth.planar:
        to = replace(to, translation=np.array([*to.translation[:2], -to.scale * truth.floor_z]))
    back = Similarity(
        1 / to.scale, to.rotation.T, -to.rotation.T @ to.translation / to.scale
    )  # fmt: skip
    moved = truth.transformed(to)
    return replace(moved, scale="unit", frame_source="station", frame="station-1"), back


def frame_error(frame: DesignedFrame, back: Similarity) -> np.ndarray:
    """Error (7,) of the frame: translation and rotation about its centre, and relative scale."""
    turn = frame.to_design.rotation @ back.rotation.T
    scale = frame.to_design.scale / back.scale
    moved = frame.to_design.apply(back.rotation.T @ (frame.centre - back.translation) / back.scale)
    angle = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.r_[moved - frame.centre, angle / 2, np.log(scale)]


def codes(solution: Solution) -> set[str]:
    return {warning.code for warning in solution.warnings}


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("count", [2, 4])
def test_the_frame_is_as_uncertain_as_it_says(count: int, planar: bool) -> None:
    rng = np.random.default_rng(count)
    free = [0, 1, 5, 6] if planar else list(range(7))
    nees = []
    for _ in range(60):
        truth = replace(rooms.room(rng, count), planar=planar, floor_z=0.1)
        scene, back = estimated(truth, rng)
        frame = fit_designed_frame(scene, design_of(truth, rng))
        error = frame_error(frame, back)
        own = frame.covariance[np.ix_(free, free)]
        nees.append(error[free] @ np.linalg.solve(own, error[free]) / len(free))
        if planar:
            np.testing.assert_allclose(error[[2, 3, 4]], 0, atol=1e-9)
    # Sixty chi-square figures of mean 1.
    assert 0.75 < np.mean(nees) < 1.3


def test_more_stations_and_a_smaller_tolerance_give_a_more_certain_frame() -> None:
    rng = np.random.default_rng(1)
    truth = rooms.room(rng, 4)
    scene, _ = estimated(truth, rng)
    wide = fit_designed_frame(scene, design_of(truth, rng))
    narrow = fit_designed_frame(scene, design_of(truth, rng, TOLERANCE / 4))
    few = replace(scene, stations=scene.stations[:2])
    fewer = fit_designed_frame(few, design_of(truth, rng))
    assert narrow.origin_sigma_m == pytest.approx(wide.origin_sigma_m / 4, rel=0.1)
    assert fewer.origin_sigma_m > 1.2 * wide.origin_sigma_m


def test_a_known_scale_counts_with_that_of_the_design() -> None:
    rng = np.random.default_rng(2)
    truth = rooms.room(rng, 3)
    scene, back = estimated(truth, rng)
    metric = scene.transformed(Similarity(back.scale, np.eye(3), np.zeros(3)))
    visit = MarkerVisit("robot", 0, 1)
    by_tape = replace(metric, scale="distance", distances=(Distance(visit, visit, 2.0),))
    design = design_of(truth, rng)
    own = fit_designed_frame(scene, design).scale_sigma
    # A distance of 2 m between two points, each known to 3 mm.
    combined = (own**-2 + (np.sqrt(2) * 3e-3 / 2.0) ** -2) ** -0.5
    assert fit_designed_frame(by_tape, design).scale_sigma == pytest.approx(combined, rel=0.1)


@pytest.mark.parametrize("count", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_station_that_was_mounted_elsewhere_does_not_move_the_frame(count: int) -> None:
    rng = np.random.default_rng(3)
    for _ in range(count):
        truth = rooms.room(rng, 4)
        scene, back = estimated(truth, rng)
        design = design_of(truth, rng)
        first, *others = design.stations
        moved = replace(first, position=first.position + rng.choice([-0.6, 0.6], 3))
        frame = fit_designed_frame(scene, replace(design, stations=(moved, *others)))
        assert frame.used == (2, 3, 4)
        assert [d.channel for d in frame.deviations if d.sigmas > 5] == [1]
        (deviation,) = [d for d in frame.deviations if d.channel == 1]
        assert deviation.offset_m == pytest.approx(np.sqrt(3) * 0.6, abs=0.15)
        assert np.linalg.norm(frame_error(frame, back)[:3]) < 0.08


def test_careless_mounting_widens_the_frame() -> None:
    rng = np.random.default_rng(9)
    truth = rooms.room(rng, 4)
    scene, _ = estimated(truth, rng)
    careful = fit_designed_frame(scene, design_of(truth, rng))
    design = design_of(truth, rng, 2 * TOLERANCE)
    stated = tuple(replace(s, covariance=np.diag(TOLERANCE**2)) for s in design.stations)
    careless = fit_designed_frame(scene, replace(design, stations=stated))
    assert careful.misfit_ratio == 1.0
    assert careless.used == (1, 2, 3, 4)
    assert careless.misfit_ratio > 1.3
    assert careless.origin_sigma_m > 1.3 * careful.origin_sigma_m


@pytest.mark.slow
def test_careless_mounting_leaves_few_stations_out_and_is_in_the_covariance() -> None:
    rng = np.random.default_rng(9)
    nees, used = [], []
    for _ in range(15):
        truth = rooms.room(rng, 4)
        scene, back = estimated(truth, rng)
        design = design_of(truth, rng, 2 * TOLERANCE)
        stated = tuple(replace(s, covariance=np.diag(TOLERANCE**2)) for s in design.stations)
        frame = fit_designed_frame(scene, replace(design, stations=stated))
        used.append(len(frame.used))
        error = frame_error(frame, back)
        nees.append(error @ np.linalg.solve(frame.covariance, error) / 7)
    assert np.mean(used) > 3.3
    assert np.mean(nees) < 2.5  # It would be 4 without.


def test_swapped_channels_are_named() -> None:
    rng = np.random.default_rng(4)
    truth = rooms.room(rng, 4)
    scene, back = estimated(truth, rng)
    design = design_of(truth, rng)
    channels = {1: 3, 3: 1, 2: 2, 4: 4}
    stations = tuple(replace(s, channel=channels[s.channel]) for s in design.stations)
    frame = fit_designed_frame(scene, replace(design, stations=stations))
    assert frame.swaps[0] == (1, 3)
    assert np.linalg.norm(frame_error(frame, back)[:3]) < 0.06


def test_an_exchange_in_a_symmetric_room_names_all_arrangements_that_fit() -> None:
    rng = np.random.default_rng(7)
    corners = np.array([[-2, -1.5, 2.2], [2, 1.5, 2.2], [-2, 1.5, 2.2], [2, -1.5, 2.2]])
    stations = tuple(
        Station(k + 1, corner, rooms.looking_at(corner, np.zeros(3)), rooms.IDEAL)
        for k, corner in enumerate(corners)
    )
    truth = Scene(stations, planar=True)
    scene, _ = estimated(truth, rng)
    design = design_of(truth, rng)
    channels = {1: 2, 2: 1, 3: 3, 4: 4}
    swapped = tuple(replace(s, channel=channels[s.channel]) for s in design.stations)
    frame = fit_designed_frame(scene, replace(design, stations=swapped))
    assert set(frame.swaps) == {(1, 2), (3, 4)}  # The second is the first, turned by 180 degrees.


def test_scenes_without_stations_of_the_design_are_refused() -> None:
    rng = np.random.default_rng(5)
    truth = rooms.room(rng, 2)
    scene, _ = estimated(truth, rng)
    design = design_of(truth, rng)
    (first, second) = design.stations
    other = replace(design, stations=(replace(first, channel=7), replace(second, channel=8)))
    with pytest.raises(DegenerateError, match="too few of the designed stations"):
        fit_designed_frame(scene, other)
    with pytest.raises(DegenerateError):  # One station gives no scale.
        fit_designed_frame(scene, replace(design, stations=(first,)))


def test_the_prior_has_the_directions_of_gravity_and_no_stations() -> None:
    rng = np.random.default_rng(6)
    truth = rooms.room(rng, 2)
    design = replace(design_of(truth, rng), ups={2: np.array([0.0, 0.0, 1.0])})
    prior = design_prior(design)
    assert prior.stations == ()
    np.testing.assert_allclose(
        prior.ups[1], design.stations[0].rotation.T @ [0, 0, 1.0], atol=1e-12
    )
    np.testing.assert_array_equal(prior.ups[2], [0, 0, 1])  # measured
    assert set(prior.calibrations) == {1, 2}


# ---- recordings


def recording(
    rng: np.random.Generator, truth: Scene, rests: int = 9, flat: bool = False
) -> tuple[Sweeps, list[rooms.Stay]]:
    low, high = np.array([-1, -1, 0.1]), np.array([1, 1, 0.1 if flat else 0.9])
    stays = [rooms.Stay(tuple(rng.uniform(low, high)), 0.5, 1.2) for _ in range(rests)]
    return rooms.sweeps_of(truth, stays, rng), stays


def mean_error(solution: Solution, stays: list[rooms.Stay]) -> tuple[np.ndarray, np.ndarray]:
    """Mean error (3,) of all positions, which is that of the frame, and the mean covariance."""
    (track,) = solution.trajectories
    true = rooms.path(stays, (track.time_ns - rooms.START_NS) * 1e-9)
    covariance = track.covariance[:, :3, :3].mean(axis=0)
    return (track.position - true).mean(axis=0), covariance


@pytest.mark.slow
@pytest.mark.parametrize("planar", [True, False])
def test_a_recording_is_solved_in_the_frame_of_the_room(planar: bool) -> None:
    nees = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = replace(rooms.room(rng, 3), planar=planar or None, floor_z=0.1 if planar else 0.0)
        sweeps, stays = recording(rng, truth, flat=planar)
        solution = solve(sweeps, design_of(truth, rng))
        error, covariance = mean_error(solution, stays)
        dims = slice(0, 2 if planar else 3)
        nees.append(error[dims] @ np.linalg.solve(covariance[dims, dims], error[dims]))
        scene = solution.artifact
        assert (scene.frame, scene.frame_source, scene.scale) == ("room", "floor", "design")
        assert "frame_of_design" in codes(solution)
        assert not {"unit_scale", "station_not_as_designed"} & codes(solution)
        assert any("mounting of the stations" in note for note in scene.notes)
        # The stations are those of the recording, and not those of the design.
        separation = np.linalg.norm(scene.stations[0].position - scene.stations[1].position)
        true = np.linalg.norm(truth.stations[0].position - truth.stations[1].position)
        assert separation == pytest.approx(true, rel=4 * solution.facts.frame.scale_sigma)
    assert 0.2 < np.mean(nees) / (2 if planar else 3) < 2.5


@pytest.mark.slow
def test_markers_count_more_than_the_design() -> None:
    rng = np.random.default_rng(8)
    truth = rooms.room(rng, 3)
    sweeps, stays = recording(rng, truth)
    markers, now = [], 0.0
    for k, stay in enumerate(stays):
        start, end = (round(rooms.START_NS + 1e9 * (now + edge)) for edge in (0.05, 0.45))
        visit = MarkerVisit("robot", start, end)
        markers.append(Marker(f"m{k}", np.array(stay.point), (visit,)))
        now += stay.rest_s + stay.move_s
    design = design_of(truth, rng)
    displaced = replace(design.stations[2], position=design.stations[2].position + 0.5)
    design = replace(design, stations=(*design.stations[:2], displaced), markers=tuple(markers))
    solution = solve(sweeps, design)
    error, _ = mean_error(solution, stays)
    assert np.linalg.norm(error) < 0.003
    assert solution.artifact.frame_source == "markers"
    (warning,) = [w for w in solution.warnings if w.code == "station_not_as_designed"]
    assert "channel 3" in warning.message


def test_the_published_method_is_placed_in_the_design_as_well() -> None:
    rng = np.random.default_rng(3)
    truth = rooms.room(rng, 2)
    sweeps, stays = recording(rng, truth)
    solution = solve(sweeps, design_of(truth, rng), SolveOptions(method="paper", scene="two-3d"))
    (track,) = solution.trajectories
    true = rooms.path(stays, (track.time_ns - rooms.START_NS) * 1e-9)
    assert np.linalg.norm((track.position - true).mean(axis=0)) < 0.1
    assert solution.artifact.frame == "room"


def test_one_station_is_used_where_it_was_designed() -> None:
    offsets, sigmas = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = replace(rooms.room(rng, 1), planar=True, floor_z=0.1)
        stays = [rooms.Stay((0.3, -0.2, 0.1), 0.4)]
        design = design_of(truth, rng)
        solution = solve(rooms.sweeps_of(truth, stays, rng), design, SolveOptions())
        error, covariance = mean_error(solution, stays)
        offsets.append(error[:2] @ np.linalg.solve(covariance[:2, :2], error[:2]) / 2)
        sigmas.append(np.sqrt(covariance[0, 0]))
        assert "designed_poses_used" in codes(solution)
        assert solution.artifact is design
    assert 0.02 < np.mean(sigmas) < 0.3
    assert 0.4 < np.mean(offsets) < 2.0
