"""Whole sessions of an independent world: scenes, scale, outliers, refusals."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError, LocatkError
from locatk.core.geometry import Similarity, rotation_exp, umeyama
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.devices.solver import merge_solutions
from locatk.core.lighthouse.localization.photodiodes import MAX_RANGE_M
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import Distance, MarkerVisit, Scene
from locatk.core.lighthouse.solver import SolveOptions, solve
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


def strict(
    sweeps: Sweeps,
    known: Scene | None = None,
    odometry: Sequence[Trajectory] = (),
    **options: Any,
) -> Solution:
    """Solve with the options of :class:`SolveOptions`; no warning may escape."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return solve(sweeps, known, SolveOptions(**options), odometry)


def errors(solution: Solution, drive: Any, *, align: bool = False) -> Array:
    """Distance of each pose from the truth, in metres."""
    (track,) = solution.trajectories
    true = drive.points[np.searchsorted(drive.time_ns, track.time_ns)]
    found = track.position
    if align:
        found = umeyama(found, true).apply(found)
    return np.asarray(np.linalg.norm(found - true, axis=1))


def codes(solution: Solution) -> set[str]:
    """Return the codes of the warnings of a solution."""
    return {warning.code for warning in solution.warnings}


def marked(world: Any, lamps: Any, places: Array | None = None) -> Scene:
    return Scene(markers=world.markers_of(lamps, world.square if places is None else places))


# ---- scenes


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("channels", [(1, 2), (1, 2, 5), (1, 2, 5, 16)])
def test_markers_give_metres_and_frame(world: Any, channels: tuple[int, ...], flat: bool) -> None:
    lamps = world.lamps(*channels)
    drive = world.drive(lamps, world.curve(150, flat=flat))
    solution = strict(drive.sweeps, marked(world, lamps))
    scene = solution.artifact
    assert solution.poses == 150
    assert solution.rejected == {}
    assert scene.scale == "markers"
    assert scene.planar is flat
    assert errors(solution, drive).mean() < (1e-3 if flat else 4e-3)
    for lamp in lamps:
        station = scene.station(lamp.channel)
        np.testing.assert_allclose(station.position, lamp.position, atol=0.06)
        np.testing.assert_allclose(station.rotation, lamp.rotation, atol=0.03)
        assert station.calibration.source == "estimated"
    assert "generic_calibration" in codes(solution)


def test_one_station_needs_only_its_markers(world: Any) -> None:
    lamps = world.lamps(1)
    drive = world.drive(lamps, world.curve(150, flat=True, size=0.5))
    solution = strict(drive.sweeps, marked(world, lamps))
    assert errors(solution, drive).mean() < 1.5e-3
    assert solution.artifact.planar
    np.testing.assert_allclose(solution.artifact.stations[0].position, lamps[0].position, atol=0.1)


def test_one_station_gives_its_uncertainty(world: Any) -> None:
    lamps = world.lamps(1)
    drive = world.drive(lamps, world.curve(50, flat=True, size=0.5))
    (track,) = strict(drive.sweeps, marked(world, lamps)).trajectories
    sigma = track.sigma[:, :2]
    # 115 microradians at three metres, stretched by the slant.
    assert np.all(sigma > 2e-4)
    assert np.all(sigma < 3e-3)


def test_markers_at_a_height_raise_the_floor(world: Any) -> None:
    lamps = world.lamps(1, 2)
    up = np.array([0.0, 0.0, 0.15])
    drive = world.drive(lamps, world.curve(100, flat=True) + up)
    solution = strict(drive.sweeps, marked(world, lamps, world.square + up))
    assert solution.artifact.floor_z == pytest.approx(0.15)
    (track,) = solution.trajectories
    np.testing.assert_allclose(track.position[:, 2], 0.15, atol=1e-9)
    assert errors(solution, drive).mean() < 1.5e-3
    single = world.drive(lamps[:1], world.curve(100, flat=True, size=0.5) + up)
    alone = strict(single.sweeps, marked(world, lamps[:1], world.square + up))
    assert errors(alone, single).mean() < 1.5e-3
    assert alone.trajectories[0].position[0, 2] == pytest.approx(0.15)
    (station,) = alone.artifact.stations
    np.testing.assert_allclose(station.position, lamps[0].position, atol=0.1)


@pytest.mark.parametrize("flat", [True, False])
def test_a_clockwise_frame_is_solved_and_named(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(120, flat=flat))
    turned = [
        replace(marker, position=marker.position[[1, 0, 2]])
        for marker in world.markers_of(lamps, world.square)
    ]
    solution = strict(drive.sweeps, Scene(markers=tuple(turned)))
    (track,) = solution.trajectories
    found = track.position[:, [1, 0, 2]] * [1, 1, -1]
    assert np.linalg.norm(found - drive.points, axis=1).mean() < 5e-3
    if flat:
        assert "stations_below_floor" in codes(solution)


@pytest.mark.parametrize("flat", [True, False])
def test_a_missing_scale_is_reported(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(120, flat=flat))
    solution = strict(drive.sweeps)
    scene = solution.artifact
    assert scene.scale == "unit"
    assert "unit_scale" in codes(solution)
    first, second = (s.position for s in scene.stations)
    assert np.linalg.norm(second - first) == pytest.approx(1)
    assert errors(solution, drive, align=True).mean() < 4e-3


@pytest.mark.parametrize("flat", [True, False])
def test_a_distance_gives_metres(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    places = world.curve(120, flat=flat)
    points = places[np.r_[[0] * 10, :120, [119] * 10]]
    drive = world.drive(lamps, points)
    stays = [
        MarkerVisit("robot", int(drive.time_ns[a]), int(drive.time_ns[b]))
        for a, b in ((0, 9), (-10, -1))
    ]
    length = float(np.linalg.norm(places[-1] - places[0]))
    solution = strict(drive.sweeps, Scene(distances=(Distance(*stays, length),)))
    assert solution.artifact.scale == "distance"
    (track,) = solution.trajectories
    assert umeyama(track.position, drive.points).scale == pytest.approx(1, abs=0.01)
    assert "unit_scale" not in codes(solution)


@pytest.mark.parametrize("flat", [True, False])
def test_drifting_odometry_gives_metres(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    rng = np.random.default_rng(1)
    steps = np.diff(drive.points, axis=0) * (1 + 0.05 * rng.normal(size=(299, 1)))
    turn = np.cumsum(rng.normal(0, 0.01, 299))
    steps = np.stack(
        [
            np.cos(turn) * steps[:, 0] - np.sin(turn) * steps[:, 1],
            np.sin(turn) * steps[:, 0] + np.cos(turn) * steps[:, 1],
            steps[:, 2],
        ],
        axis=1,
    )
    walked = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    track = Trajectory.from_positions("robot", "odom", drive.time_ns, walked)
    solution = strict(drive.sweeps, odometry=[track])
    assert solution.artifact.scale == "odometry"
    found = solution.trajectories[0].position
    assert umeyama(found, drive.points).scale == pytest.approx(1, abs=0.015)
    # Odometry that stands still gives none, and it is said.
    still = replace(track, position=np.zeros((300, 3)))
    other = strict(drive.sweeps, odometry=[still])
    assert other.artifact.scale == "unit"
    assert {"odometry_without_motion", "unit_scale"} <= codes(other)


def test_markers_win_over_odometry(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(100, flat=True))
    wrong = Trajectory.from_positions("robot", "odom", drive.time_ns, 3 * drive.points)
    solution = strict(drive.sweeps, marked(world, lamps), [wrong])
    assert solution.artifact.scale == "markers"
    assert errors(solution, drive).mean() < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_a_solved_scene_serves_later_sessions(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5)
    scene = strict(world.drive(lamps, world.curve(200, flat=flat)).sweeps, marked(world, lamps))
    artifact = scene.artifact
    # A later session need not determine a scene: here a robot that stands still.
    where = np.array([[0.31, -0.22, 0.0 if flat else 0.5]])
    later = world.drive(lamps, np.repeat(where, 20, axis=0), seed=9, start_s=3600)
    solution = strict(later.sweeps, artifact)
    assert solution.artifact is artifact
    assert solution.poses == 20
    assert errors(solution, later).mean() < 3e-3
    for note in artifact.notes:
        assert note in [warning.message for warning in solution.warnings]
    # With fewer stations than it was solved with, and with one that it does not know.
    two = world.drive(lamps[1:], np.repeat(where, 20, axis=0), seed=9)
    assert errors(strict(two.sweeps, artifact), two).mean() < 4e-3
    more = world.drive(world.lamps(1, 2, 5, 16), np.repeat(where, 20, axis=0), seed=9)
    solution = strict(more.sweeps, artifact)
    assert solution.rejected == {"station_not_in_scene": 40}
    assert errors(solution, more).mean() < 3e-3


def test_one_station_of_a_scene_in_space_gives_a_note_only(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(100, flat=False))
    artifact = strict(drive.sweeps, marked(world, lamps)).artifact
    alone = world.drive(lamps[:1], world.curve(30, flat=False))
    solution = strict(alone.sweeps, artifact)
    assert solution.poses == 0
    assert solution.rejected == {"moment_with_too_few_sweeps": 30}


def test_a_scene_of_other_stations_is_refused(world: Any) -> None:
    lamps = world.lamps(1, 2)
    artifact = strict(world.drive(lamps, world.curve(60, flat=True)).sweeps).artifact
    other = world.drive(world.lamps(5, 16), world.curve(60, flat=True))
    with pytest.raises(DegenerateError, match="stations") as refused:
        strict(other.sweeps, artifact)
    assert "5" in str(refused.value.hint)


def test_the_papers_method_does_not_pass_over_a_solved_scene_in_silence(world: Any) -> None:
    lamps = world.lamps(2, 16)
    drive = world.drive(lamps, world.curve(60, flat=True))
    artifact = strict(drive.sweeps, marked(world, lamps)).artifact
    solution = told(drive.sweeps, artifact, method="paper")
    assert solution is None


def test_factory_calibration_of_stations_is_used_as_it_is(world: Any) -> None:
    lamps = world.lamps(1, 2)
    names = ("phase", "tilt", "curve", "gibmag", "gibpha", "ogeemag", "ogeephase")
    calibrations = {
        lamp.channel: Calibration(
            np.array([[getattr(plane, name) for name in names] for plane in lamp.planes]),
            "factory",
        )
        for lamp in lamps
    }
    for flat in (True, False):
        drive = world.drive(lamps, world.curve(200, flat=flat))
        guessed = strict(drive.sweeps, marked(world, lamps))
        known = strict(drive.sweeps, replace(marked(world, lamps), calibrations=calibrations))
        for station in known.artifact.stations:
            assert station.calibration is calibrations[station.channel]
        assert "generic_calibration" not in codes(known)
        assert errors(known, drive).mean() < errors(guessed, drive).mean()
        assert errors(known, drive).mean() < (5e-4 if flat else 1.5e-3)


# ---- order, labels, seeds


@pytest.mark.parametrize("flat", [True, False])
def test_order_of_sweeps_and_names_of_channels_do_not_matter(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(120, flat=flat))
    scene = marked(world, lamps)
    reference = strict(drive.sweeps, scene).trajectories[0]
    shuffled = world.take(drive.sweeps, np.random.default_rng(0).permutation(len(drive.sweeps)))
    again = strict(shuffled, scene).trajectories[0]
    np.testing.assert_array_equal(again.position, reference.position)
    np.testing.assert_array_equal(again.time_ns, reference.time_ns)

    # The same two stations, set to each other's channel.
    swapped = tuple(replace(s, channel=3 - s.channel) for s in lamps)
    other = world.drive(swapped, drive.points)
    there = strict(other.sweeps, marked(world, swapped)).trajectories[0]
    np.testing.assert_allclose(there.position, reference.position, atol=2e-3)


def test_seeds_change_nothing_that_matters(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(120, flat=False))
    scene = marked(world, lamps)
    a, b, c = (strict(drive.sweeps, scene, seed=s).trajectories[0].position for s in (0, 0, 5))
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(c, a, atol=1e-4)


def test_several_devices_share_a_scene(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = np.concatenate([world.curve(60, flat=True), world.curve(60, flat=True)[::-1] * 0.7])
    drive = world.drive(lamps, points)
    drive.devices, drive.device = ("red", "blue"), np.repeat([0, 1], 60).astype(np.int32)
    drive.time_ns[60:] = drive.time_ns[:60]
    solution = strict(drive.sweeps, marked(world, lamps))
    red, blue = solution.trajectories
    assert (red.device, blue.device) == ("red", "blue")
    np.testing.assert_allclose(red.position, points[:60], atol=3e-3)
    np.testing.assert_allclose(blue.position, points[60:], atol=3e-3)


# ---- free rotors


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_free_rotors_and_a_moving_receiver(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5)

    def where(t: Array) -> Array:
        z = np.zeros_like(t) if flat else 0.4 + 0.3 * np.sin(1.1 * t)
        return np.stack([0.8 * np.cos(0.9 * t), 0.7 * np.sin(1.3 * t), z], axis=-1)

    sweeps = world.stream(lamps, where, 5.0)
    solution = strict(sweeps, marked(world, lamps))
    (track,) = solution.trajectories
    true = where((track.time_ns - world.start_ns) * 1e-9)
    error = np.linalg.norm(track.position - true, axis=1)
    # The receiver moves up to 20 mm in the 20 ms of a moment.
    assert len(track) > 230
    assert error.mean() < 2.5e-3
    assert error.max() < 8e-3
    assert solution.artifact.planar is flat


def test_photodiodes_of_a_device_are_solved_separately(world: Any) -> None:
    lamps = world.lamps(1, 2)
    sensors = np.array([[0.015, 0.0075, 0.0], [-0.015, -0.0075, 0.0]])

    def where(t: Array) -> Array:
        return np.stack([0.5 * np.cos(t), 0.5 * np.sin(1.7 * t), np.zeros_like(t)], axis=-1)

    sweeps = world.stream(lamps, where, 5.0, sensors=sensors)
    front, rear = strict(sweeps, marked(world, lamps)).trajectories
    assert (front.device, rear.device) == ("robot/0", "robot/1")
    for track, offset in ((front, sensors[0]), (rear, sensors[1])):
        true = where((track.time_ns - world.start_ns) * 1e-9) + offset
        assert np.linalg.norm(track.position - true, axis=1).mean() < 1.5e-3


# ---- outliers


SPOILED_MEAN = {True: 1.5e-3, False: 6e-3}
"""Mean error in metres that a spoiled recording may have, by whether it is flat."""


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("channels", [(1, 2), (1, 2, 5)])
def test_single_jumps_are_rejected_and_counted(
    world: Any, channels: tuple[int, ...], flat: bool
) -> None:
    lamps = world.lamps(*channels)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    rng = np.random.default_rng(3)
    hit = rng.random(drive.counts.shape) < 0.05
    for column, plane in np.ndindex(drive.counts.shape[1:]):
        rows = np.flatnonzero(hit[:, column, plane])
        jump = np.radians(rng.uniform(3, 10, len(rows))) * rng.choice([-1, 1], len(rows))
        drive.turned(rows, column, plane, jump)
    solution = strict(drive.sweeps, marked(world, lamps))
    error = errors(solution, drive)
    assert solution.artifact.planar is flat
    assert error.mean() < SPOILED_MEAN[flat]
    assert error.max() < 0.025
    assert solution.rejected["spike"] > 0.7 * np.count_nonzero(hit)
    lost = 300 - solution.poses
    told = sum(n for reason, n in solution.rejected.items() if reason.startswith("moment"))
    assert lost == told
    assert solution.poses > (0.95 if flat or len(channels) > 2 else 0.75) * 300


@pytest.mark.parametrize("flat", [True, False])
def test_single_reflections_are_rejected(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    rng = np.random.default_rng(4)
    hit = rng.random((300, 2)) < 0.05
    for column, lamp in enumerate(lamps):
        rows = np.flatnonzero(hit[:, column])
        mirrored = drive.points[rows] * [-1, 1, 1] + [0, 3.0, 0.6]
        drive.counts[rows, column] = np.rint(lamp.counts(lamp.angles(mirrored)))
    solution = strict(drive.sweeps, marked(world, lamps))
    error = errors(solution, drive)
    assert error.mean() < SPOILED_MEAN[flat]
    assert error.max() < 0.025
    assert sum(solution.rejected.values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("liar", [0, 1, 2])
def test_a_temporarily_wrong_station_is_outvoted(world: Any, liar: int, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    mirrored = drive.points[100:130] * [-1, 1, 1] + [0.3, 0.4, 0.2]
    drive.counts[100:130, liar] = np.rint(lamps[liar].counts(lamps[liar].angles(mirrored)))
    solution = strict(drive.sweeps, marked(world, lamps))
    error = errors(solution, drive)
    assert error.mean() < SPOILED_MEAN[flat]
    assert error.max() < 0.02
    # Where the mirrored ray happens to pass by the robot nothing contradicts.
    assert solution.rejected["station_contradicts_others"] >= 25
    assert solution.poses > 290


def test_a_wrong_station_in_a_known_scene_is_outvoted(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    scene = strict(
        world.drive(lamps, world.curve(200, flat=False)).sweeps, marked(world, lamps)
    ).artifact
    drive = world.drive(lamps, world.curve(100, flat=False), seed=5)
    mirrored = drive.points[40:60] * [-1, 1, 1] + [0.3, 0.4, 0.2]
    drive.counts[40:60, 2] = np.rint(lamps[2].counts(lamps[2].angles(mirrored)))
    solution = strict(drive.sweeps, scene)
    assert solution.rejected == {"station_contradicts_others": 20}
    assert errors(solution, drive).max() < 6e-3


def test_a_scene_of_another_site_is_reported(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(200, flat=False))
    scene = strict(drive.sweeps, marked(world, lamps)).artifact
    right = strict(drive.sweeps, scene)
    assert "scene_contradicted" not in codes(right)
    moved = replace(scene.stations[0], position=scene.stations[0].position + [0.5, 0.3, 0.0])
    wrong = strict(drive.sweeps, replace(scene, stations=(moved, *scene.stations[1:])))
    assert wrong.rejected["moment_inconsistent"] > 100
    assert "scene_contradicted" in codes(wrong)


@pytest.mark.parametrize("flat", [True, False])
def test_two_stations_that_contradict_are_both_left_out(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    mirrored = drive.points[100:130] * [-1, 1, 1] + [0.3, 0.4, 0.6]
    drive.counts[100:130, 1] = np.rint(lamps[1].counts(lamps[1].angles(mirrored)))
    solution = strict(drive.sweeps, marked(world, lamps))
    error = errors(solution, drive)
    assert error.mean() < SPOILED_MEAN[flat]
    assert error.max() < 0.025
    assert sum(n for r, n in solution.rejected.items() if r.startswith("moment")) >= 28


def test_reflections_that_nothing_checks_leave_the_path(world: Any) -> None:
    # One station: only the path itself tells. Two moments in a row are no single spike.
    lamps = world.lamps(1)
    drive = world.drive(lamps, world.curve(300, flat=True, size=0.5))
    for start in (50, 140, 230):
        rows = np.array([start, start + 1])
        mirrored = drive.points[rows] * [-1, 1, 1] + [0, 2.0, 0.0]
        drive.counts[rows, 0] = np.rint(lamps[0].counts(lamps[0].angles(mirrored)))
    solution = strict(drive.sweeps, marked(world, lamps))
    assert solution.rejected == {"moment_jumps": 6}
    assert errors(solution, drive).max() < 5e-3


def test_markers_decide_between_two_readings_or_protest(world: Any) -> None:
    """Two stations side by side, both leaning: roll alone picks the wrong reading."""
    places = np.array([2.5, 0.6, 2.0]), np.array([2.5, 0.9, 2.4])
    lamps = tuple(
        replace(lamp, position=place, rotation=world.look(place, np.zeros(3), 0.5))
        for lamp, place in zip(world.lamps(1, 2), places, strict=True)
    )
    drive = world.drive(lamps, world.curve(150, flat=True))
    solution = strict(drive.sweeps, marked(world, lamps), scene="two-planar")
    right = errors(solution, drive).mean() < 0.06
    assert right or "marker_misfit" in codes(solution)


def test_markers_that_contradict_the_scene_are_reported(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(100, flat=True))
    right = strict(drive.sweeps, marked(world, lamps))
    assert right.facts.marker_misfit_m < 5e-3
    assert "marker_misfit" not in codes(right)
    scene = marked(world, lamps)
    first = replace(scene.markers[0], position=scene.markers[0].position + [0.15, 0, 0])
    wrong = strict(drive.sweeps, replace(scene, markers=(first, *scene.markers[1:])))
    assert wrong.facts.marker_misfit_m > 0.02
    assert "marker_misfit" in codes(wrong)


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("channels", [(1, 2), (1, 2, 5)])
def test_occlusion_costs_poses_not_accuracy(
    world: Any, channels: tuple[int, ...], flat: bool
) -> None:
    lamps = world.lamps(*channels)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    hidden = np.random.default_rng(6).random((300, len(channels))) < 0.3
    drive.counts[hidden] = np.nan
    solution = strict(drive.sweeps, marked(world, lamps))
    assert errors(solution, drive).mean() < SPOILED_MEAN[flat]
    enough = np.count_nonzero(np.sum(~hidden, axis=1) >= (1 if flat else 2))
    assert solution.poses == enough


def test_swapped_sweeps_are_given_back(world: Any) -> None:
    # A report without polynomials that sorts all four counts exchanges a plane of each
    # station wherever their counts cross, or both planes.
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(300, flat=True))
    drive.labelled = False
    crossed = drive.counts[:, 0] > drive.counts[:, 1]
    assert np.count_nonzero(crossed.any(axis=1) & ~crossed.all(axis=1)) > 20
    assert np.count_nonzero(crossed.all(axis=1)) > 50
    drive.counts = np.sort(drive.counts, axis=1)
    solution = strict(drive.sweeps, marked(world, lamps))
    assert np.max(errors(solution, drive)) < 6e-3
    assert "swapped_sweeps_restored" in codes(solution)
    assert solution.poses > 0.95 * 300


@pytest.mark.parametrize("flat", [True, False])
def test_a_station_with_nothing_in_common_is_left_out_and_named(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    drive = world.drive(lamps, world.curve(300, flat=flat))
    drive.counts[:250, 3] = np.nan
    drive.counts[250:, :3] = np.nan
    solution = strict(drive.sweeps, marked(world, lamps[:3]))
    assert [s.channel for s in solution.artifact.stations] == [1, 2, 5]
    assert solution.rejected["station_not_solved"] == 100
    (left_out,) = [w for w in solution.warnings if w.code == "stations_left_out"]
    assert "channel 16 " in left_out.message
    assert errors(solution, drive).mean() < SPOILED_MEAN[flat]


def test_positions_out_of_range_are_rejected(world: Any) -> None:
    lamps = world.lamps(1, 2)
    near = world.curve(100, flat=True)
    far = near[:5] + [0.0, 2 * MAX_RANGE_M, 0.0]
    scene = strict(world.drive(lamps, near).sweeps, marked(world, lamps)).artifact
    drive = world.drive(
        tuple(replace(s, rotation=world.look(s.position, far[0])) for s in lamps), far
    )
    turned = replace(
        scene,
        stations=tuple(
            replace(s, position=lamp.position, rotation=lamp.rotation)
            for s, lamp in zip(scene.stations, drive.lamps, strict=True)
        ),
    )
    solution = strict(drive.sweeps, turned)
    assert solution.poses == 0
    assert sum(solution.rejected.values()) == 5


# ---- uncertainty


@pytest.mark.parametrize("flat", [True, False])
def test_covariance_of_poses_is_worth_its_name(world: Any, flat: bool) -> None:
    """In a scene that is right, the normalised error is that of its dimension."""
    lamps = world.lamps(1, 2)
    learned = strict(
        world.drive(lamps, world.curve(100, flat=flat)).sweeps, marked(world, lamps)
    ).artifact
    names = ("phase", "tilt", "curve", "gibmag", "gibpha", "ogeemag", "ogeephase")
    exact = replace(
        learned,
        stations=tuple(
            replace(
                station,
                position=lamp.position,
                rotation=lamp.rotation,
                calibration=replace(
                    station.calibration,
                    source="factory",
                    sweeps=np.array([[getattr(p, n) for n in names] for p in lamp.planes]),
                ),
            )
            for station, lamp in zip(learned.stations, lamps, strict=True)
        ),
    )
    for noise in (3e-4, 1e-3):
        drive = world.drive(lamps, world.curve(600, flat=flat), noise_rad=noise)
        solution = strict(drive.sweeps, exact)
        (track,) = solution.trajectories
        dims = 2 if flat else 3
        error = track.position - drive.points[np.searchsorted(drive.time_ns, track.time_ns)]
        error, weight = error[:, :dims], np.linalg.inv(track.covariance[:, :dims, :dims])
        nees = np.einsum("ni,nij,nj->n", error, weight, error)
        assert nees.mean() == pytest.approx(dims, rel=0.2)
        assert np.isnan(track.covariance[:, 3:, 3:]).all()  # a photodiode has no heading
        assert solution.facts.angle_sigma_rad == pytest.approx(noise, rel=0.1)


def test_station_covariance_rotates_and_scales_with_its_frame(world: Any) -> None:
    """The same recording in two frames: C -> J C J' with J = (s R, R)."""
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(100, flat=False))
    to = Similarity(2.5, rotation_exp(np.array([0.0, 0.0, 0.9])), np.array([1.0, -2.0, 0.3]))
    markers = world.markers_of(lamps, world.square)
    moved = tuple(replace(m, position=to.apply(m.position)) for m in markers)
    here = strict(drive.sweeps, Scene(markers=markers), scene="two-3d").artifact
    there = strict(drive.sweeps, Scene(markers=moved), scene="two-3d").artifact
    change = np.zeros((6, 6))
    change[:3, :3], change[3:, 3:] = to.scale * to.rotation, to.rotation
    for a, b in zip(here.stations, there.stations, strict=True):
        np.testing.assert_allclose(b.position, to.apply(a.position), atol=1e-6)
        expected = change @ a.covariance @ change.T
        np.testing.assert_allclose(b.covariance, expected, rtol=1e-3, atol=1e-12)


# ---- what is said of it


def test_detections_describe_the_observations_of_each_station(world: Any) -> None:
    lamps = world.lamps(2, 5)
    drive = world.drive(lamps, world.curve(100, flat=True))
    drive.counts[:30, 1] = np.nan
    solution = strict(drive.sweeps, marked(world, lamps))
    rows = solution.detections
    assert [row.channel for row in rows] == [2, 5]
    assert [row.period_ticks for row in rows] == [957000, 947000]
    assert [row.sweeps for row in rows] == [200, 140]
    assert [row.rejected for row in rows] == [0, 0]
    for row in rows:
        assert (row.id, row.calibration) == (None, "estimated")
    assert [row.station for row in rows] == [0, 1]


# ---- refusals


def spoiled(sweeps: Sweeps, **values: float) -> Sweeps:
    columns = {
        name: np.full(len(sweeps), value, getattr(sweeps, name).dtype)
        for name, value in values.items()
    }
    return replace(sweeps, **columns)


@pytest.mark.parametrize("method", ["bundle", "paper"])
@pytest.mark.parametrize(
    "kind", ["empty", "above the period", "channel 0", "channel 17", "nan", "negative"]
)
def test_nothing_usable_is_refused(world: Any, kind: str, method: str) -> None:
    sweeps = world.drive(world.lamps(1, 2), world.curve(30, flat=True)).sweeps
    sweeps = {
        "empty": world.take(sweeps, np.zeros(0, np.int64)),
        "above the period": spoiled(sweeps, count=120_000),
        "channel 0": spoiled(sweeps, channel=0),
        "channel 17": spoiled(sweeps, channel=17),
        "nan": spoiled(sweeps, count=np.nan),
        "negative": spoiled(sweeps, count=-5),
    }[kind]
    with pytest.raises(DegenerateError, match="no usable sweep") as refused:
        strict(sweeps, method=method)
    assert refused.value.hint


@pytest.mark.parametrize("method", ["bundle", "paper"])
@pytest.mark.parametrize("scene", ["auto", "one-planar", "two-planar", "two-3d"])
def test_one_station_without_markers_is_refused(world: Any, scene: str, method: str) -> None:
    drive = world.drive(world.lamps(1), world.curve(60, flat=True))
    with pytest.raises(DegenerateError, match=r"markers|two stations") as refused:
        strict(drive.sweeps, scene=scene, method=method)
    assert "markers" in str(refused.value.hint)


PLACES = {
    "three": np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0]]),
    "on a line": np.linspace([-0.5, -0.3, 0], [0.5, 0.2, 0], 5),
    "three of four on a line": np.array([[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0], [0.3, 0.7, 0]]),
    "one place": np.zeros((5, 3)),
}


@pytest.mark.parametrize("kind", PLACES)
def test_one_station_with_markers_that_fix_nothing_is_refused(world: Any, kind: str) -> None:
    lamps = world.lamps(1)
    drive = world.drive(lamps, world.curve(60, flat=True))
    with pytest.raises(DegenerateError) as refused:
        strict(drive.sweeps, marked(world, lamps, PLACES[kind]))
    assert refused.value.hint


@pytest.mark.parametrize("kind", ["on a line", "one place"])
def test_two_stations_with_markers_that_fix_nothing_are_refused(world: Any, kind: str) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(60, flat=True))
    with pytest.raises(DegenerateError, match="marker") as refused:
        strict(drive.sweeps, marked(world, lamps, PLACES[kind]))
    assert refused.value.hint


@pytest.mark.parametrize(
    ("kind", "scene", "word"),
    [
        ("still", "auto", "stood still"),
        ("line", "auto", "line"),
        ("three places", "auto", "3 positions"),
        ("three places again and again", "auto", "3 positions"),
        ("flat", "two-3d", "plane"),
        ("never together", "auto", "two stations at once"),
        ("one plane each", "auto", "."),
    ],
)
def test_drives_that_determine_nothing_are_named(
    world: Any, kind: str, scene: str, word: str
) -> None:
    points = {
        "still": np.tile([[0.3, 0.2, 0.0]], (60, 1)),
        "line": np.linspace([-0.8, -0.3, 0], [0.7, 0.5, 0], 100),
        "three places": np.repeat(world.curve(3, flat=True), 30, axis=0),
        "three places again and again": np.tile(
            np.repeat(world.curve(3, flat=True), 3, axis=0), (20, 1)
        ),
    }.get(kind, world.curve(60, flat=True))
    drive = world.drive(world.lamps(1, 2), points)
    if kind == "never together":
        drive.counts[:30, 0], drive.counts[30:, 1] = np.nan, np.nan
    if kind == "one plane each":
        drive.counts[:, 0, 0] = drive.counts[:, 1, 1] = np.nan
    with pytest.raises(DegenerateError, match=word) as refused:
        strict(drive.sweeps, scene=scene)
    assert refused.value.hint


def told(sweeps: Sweeps, known: Scene | None, **options: Any) -> Solution | None:
    """A solution, or None where the session was refused with a hint."""
    try:
        return strict(sweeps, known, **options)
    except LocatkError as refused:
        hint = refused.hint
        message = str(refused)
    assert hint, message
    return None


def test_a_few_moments_in_space_that_are_called_flat(world: Any) -> None:
    drive = world.drive(world.lamps(2, 5, 16), world.curve(12, flat=False))
    solution = told(drive.sweeps, None, scene="two-planar")
    assert solution is None or sum(solution.rejected.values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["any counts", "one jumbled", "equal planes", "drawn twice"])
@pytest.mark.parametrize("channels", [(1,), (1, 2), (2, 5, 16), (1, 2, 5, 16)])
def test_garbage_is_refused_or_reported_without_a_crash(
    world: Any, channels: tuple[int, ...], kind: str
) -> None:
    lamps = world.lamps(*channels)
    # Many stations have many arrangements to try: seconds a session of garbage.
    scenes = ("auto", "two-planar", "two-3d")
    for seed in range({1: 6, 2: 6, 3: 3, 4: 1}[len(channels)]):
        # Each kind of scene once with markers and once without, of all seeds.
        scene = scenes[(seed + seed // 3) % 3]
        rng = np.random.default_rng(seed)
        moments = int(rng.choice([6, 12, 20, 40]))
        drive = world.drive(lamps, world.curve(moments, flat=seed % 2 == 0), noise_rad=1e-3)
        if kind == "any counts":
            drive.counts = rng.uniform(0, 110_000, drive.counts.shape)
        if kind == "one jumbled":
            drive.counts[rng.random(drive.counts.shape) < 0.3] += rng.uniform(-5000, 5000)
        if kind == "equal planes":
            drive.counts[..., 1] = drive.counts[..., 0]
        sweeps = drive.sweeps
        if kind == "drawn twice":
            sweeps = world.take(sweeps, rng.integers(0, len(sweeps), len(sweeps)))
        known = marked(world, lamps) if seed % 3 == 0 else None
        for method in ("bundle", "paper"):
            solution = told(sweeps, known, scene=scene, method=method)
            if solution is None:
                continue
            for station in solution.artifact.stations:
                assert np.isfinite(station.position).all()
                assert np.linalg.det(station.rotation) == pytest.approx(1)
            for track in solution.trajectories:
                assert np.isfinite(track.position).all()
                if method == "bundle":
                    assert np.isfinite(track.covariance[:, :3, :3]).all()


def test_unknown_choices_are_refused() -> None:
    for choice in ({"method": "magic"}, {"scene": "three-planar"}):
        with pytest.raises(InputError, match="unknown") as refused:
            SolveOptions(**choice)
        assert refused.value.hint


def test_a_marker_on_an_unknown_device_is_named(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(60, flat=True))
    (marker, *_) = world.markers_of(lamps, world.square)
    wrong = replace(marker, visits=(MarkerVisit("green", 0, 1),))
    with pytest.raises(InputError, match="green") as refused:
        strict(drive.sweeps, Scene(markers=(wrong,)))
    assert "robot" in str(refused.value.hint)


def test_solutions_of_devices_and_photodiodes_are_merged() -> None:
    def detection(station: int, channel: int, sweeps: int, rejected: int) -> StationDetection:
        return StationDetection(station, channel, None, 959000, "generic", sweeps, rejected, 1e-4)

    devices = Solution(
        "lighthouse",
        "bundle",
        (),
        {"plane_unknown": 3, "sweep_contradicts_pose": 2},
        (detection(0, 1, 10, 1), detection(1, 2, 20, 2)),
        facts=LighthouseFacts(iterations=7),
        warnings=(SolverWarning("device", "of a device"),),
    )
    photodiodes = Solution(
        "lighthouse",
        "bundle",
        (),
        {"plane_unknown": 4, "moment_jumps": 5},
        (detection(0, 2, 100, 30),),
        facts=LighthouseFacts(angle_sigma_rad=1e-4),
    )
    merged = merge_solutions(devices, photodiodes)
    assert merged.rejected == {"plane_unknown": 7, "sweep_contradicts_pose": 2, "moment_jumps": 5}
    assert [(d.station, d.channel, d.sweeps, d.rejected) for d in merged.detections] == [
        (0, 1, 10, 1),
        (1, 2, 120, 32),
    ]
    assert merged.facts == LighthouseFacts(angle_sigma_rad=1e-4, rigid=devices.facts)
    assert merged.warnings == devices.warnings
