"""Scale and frame: markers, distances, odometry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION
from locatk.core.lighthouse.epochs import group_epochs, rotor_angles
from locatk.core.lighthouse.localization.positions import estimate_positions
from locatk.core.lighthouse.scene import Distance, MarkerVisit, Scene, frame
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

SECOND = 1_000_000_000


class Recorded:
    """A receiver that stays 3 s on each marker, and a rig in a unit of its own."""

    def __init__(self, world: Any) -> None:
        plain = (world.Plane(), world.Plane())
        self.lamps = tuple(replace(s, planes=plain) for s in world.lamps(1, 2))
        self.places = world.square
        self.drive = world.drive(self.lamps, np.repeat(self.places, 30, axis=0))
        self.epochs = group_epochs(self.drive.sweeps)
        self.angles = rotor_angles(self.epochs)
        self.to = Similarity(0.2, rotation_exp(np.array([0.0, 0.0, 0.7])), np.array([3.0, 1, 0]))
        ideal = replace(GENERIC_CALIBRATION, sweeps=np.zeros((2, 7)))
        self.state = frame.transform_state(
            BundleState(
                np.stack([s.position for s in self.lamps]),
                np.stack([s.rotation for s in self.lamps]),
                (ideal, ideal),
                self.places,
            ),
            self.to,
        )

    def stay(self, k: int) -> MarkerVisit:
        start = int(self.drive.time_ns[30 * k])
        return MarkerVisit("robot", start, start + int(2.9 * SECOND))


@pytest.fixture(scope="module")
def recorded(world: Any) -> Recorded:
    return Recorded(world)


def test_sighting_by_time_is_the_median_of_its_time(recorded: Recorded) -> None:
    for k in range(4):
        seen = frame.visit_angles(recorded.stay(k), recorded.epochs, recorded.angles)
        np.testing.assert_allclose(
            seen, np.median(recorded.angles[30 * k : 30 * k + 30], axis=0), atol=1e-12
        )


def test_sighting_by_counts_takes_either_order(recorded: Recorded) -> None:
    counts = {1: (80_000.0, 41_000.0), 9: (1.0, 2.0)}
    seen = frame.visit_angles(MarkerVisit(counts=counts), recorded.epochs, recorded.angles)
    same = frame.visit_angles(
        MarkerVisit(counts={1: (41_000.0, 80_000.0)}), recorded.epochs, recorded.angles
    )
    np.testing.assert_array_equal(seen, same)
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1]).all()
    assert abs(seen[0]).max() < 0.2


def test_a_sighting_outside_the_recording_shows_nothing(recorded: Recorded) -> None:
    early = MarkerVisit("robot", 0, 10)
    assert np.isnan(frame.visit_angles(early, recorded.epochs, recorded.angles)).all()


def test_an_unknown_device_is_named(recorded: Recorded) -> None:
    with pytest.raises(InputError, match="'green'") as refused:
        frame.visit_angles(MarkerVisit("green", 0, 1), recorded.epochs, recorded.angles)
    assert "robot" in str(refused.value.hint)


def test_markers_bring_the_rig_home(recorded: Recorded, world: Any) -> None:
    markers = world.markers_of(recorded.lamps, recorded.places)
    known, seen = frame.marker_angles(markers, recorded.epochs, recorded.angles)
    np.testing.assert_array_equal(known, recorded.places)
    to = frame.align_to_markers(recorded.state, True, known, seen)
    assert to is not None
    home = frame.transform_state(recorded.state, to)
    for k, lamp in enumerate(recorded.lamps):
        np.testing.assert_allclose(home.positions[k], lamp.position, atol=1e-5)
        np.testing.assert_allclose(home.rotations[k], lamp.rotation, atol=1e-5)
    np.testing.assert_allclose(home.points, recorded.places, atol=1e-5)


def test_several_markers_average_the_error_of_one(recorded: Recorded, world: Any) -> None:
    # A frame from a single origin sample would shift by the whole error of that sample.
    places = np.array([[x, y, 0.0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)])
    markers = world.markers_of(recorded.lamps, places)
    known, seen = frame.marker_angles(markers, recorded.epochs, recorded.angles)
    moved = known.copy()
    moved[0, 0] += 0.03  # measured badly
    to = frame.align_to_markers(recorded.state, True, moved, seen)
    assert to is not None
    home = frame.transform_state(recorded.state, to)
    assert np.max(np.abs(home.points - recorded.places)) < 0.012


def test_two_markers_fix_no_frame(recorded: Recorded, world: Any) -> None:
    markers = world.markers_of(recorded.lamps, world.square[:2])
    known, seen = frame.marker_angles(markers, recorded.epochs, recorded.angles)
    assert frame.align_to_markers(recorded.state, True, known, seen) is None


@pytest.mark.parametrize("kind", ["line", "one place"])
def test_markers_on_a_line_are_refused(recorded: Recorded, world: Any, kind: str) -> None:
    places = {
        "line": np.linspace([-0.5, -0.2, 0], [0.5, 0.3, 0], 5),
        "one place": np.zeros((4, 3)),
    }[kind]
    markers = world.markers_of(recorded.lamps, places)
    known, seen = frame.marker_angles(markers, recorded.epochs, recorded.angles)
    with pytest.raises(DegenerateError, match="marker") as refused:
        frame.align_to_markers(recorded.state, True, known, seen)
    assert refused.value.hint


def test_no_sighting_is_no_marker(recorded: Recorded) -> None:
    known, seen = frame.marker_angles([], recorded.epochs, recorded.angles)
    assert known.shape == (0, 3)
    assert seen.shape == (0, 2, 2)


def positions_on_floor(recorded: Recorded) -> Any:
    """Positions on the floor, in the rig's unit, of photodiodes that saw given angles."""
    rig = recorded.state
    return lambda angles: (
        estimate_positions(
            angles, rig.positions, rig.rotations, rig.calibrations, floor_z=0.0
        ).position
    )


def test_distances_give_the_scale(recorded: Recorded) -> None:
    def scale(*distances: Distance, unseen: int = 0) -> float:
        scale, used = frame.scale_from_distances(
            positions_on_floor(recorded), distances, recorded.epochs, recorded.angles
        )
        assert used == len(distances) - unseen
        return scale

    edge = Distance(recorded.stay(0), recorded.stay(1), 1.0)
    diagonal = Distance(recorded.stay(0), recorded.stay(2), np.sqrt(2))
    assert scale(edge) == pytest.approx(5, rel=2e-3)
    assert scale(edge, diagonal) == pytest.approx(5, rel=2e-3)
    late = replace(edge, second=MarkerVisit("robot", 0, 1))
    assert scale(edge, late, unseen=1) == scale(edge)
    # Of two that disagree the longer says more.
    wrong = replace(edge, distance=1.1)
    assert 5 < scale(wrong, diagonal) < 5.25


def test_unobserved_distances_are_refused(recorded: Recorded) -> None:
    unseen = Distance(recorded.stay(0), MarkerVisit("robot", 0, 1), 1.0)
    with pytest.raises(DegenerateError) as refused:
        frame.scale_from_distances(
            positions_on_floor(recorded), [unseen], recorded.epochs, recorded.angles
        )
    assert refused.value.hint


def test_visits_that_are_not_used_are_reported(recorded: Recorded, world: Any) -> None:
    def warnings(prior: Scene) -> list[str]:
        framed = frame.fix_gauge(
            recorded.state,
            np.zeros((2, 6, 6)),
            True,
            prior,
            recorded.epochs,
            recorded.angles,
            (),
        )
        return [each.message for each in framed.warnings if each.code == "visits_not_used"]

    markers = world.markers_of(recorded.lamps, recorded.places)
    late = replace(markers[0], visits=(MarkerVisit("robot", 0, 1),))
    assert warnings(Scene(markers=markers)) == []
    (message,) = warnings(Scene(markers=(*markers, late)))
    assert message.startswith(f"1 of {len(markers) + 1} visits of markers")
    edge = Distance(recorded.stay(0), recorded.stay(1), 1.0)
    assert warnings(Scene(distances=(edge,))) == []
    unseen = replace(edge, second=MarkerVisit("robot", 0, 1))
    (message,) = warnings(Scene(distances=(edge, unseen)))
    assert message.startswith("1 of 2 known distances")


def drift(points: Array, seed: int, share: float = 0.05) -> Array:
    """Odometry of a drive: every step off by some per cent, the heading wanders."""
    rng = np.random.default_rng(seed)
    steps = np.diff(points, axis=0) * (1 + share * rng.normal(size=(len(points) - 1, 1)))
    turn = np.cumsum(rng.normal(0, 0.01, len(steps)))
    cos, sin = np.cos(turn), np.sin(turn)
    x = cos * steps[:, 0] - sin * steps[:, 1]
    y = sin * steps[:, 0] + cos * steps[:, 1]
    walked = np.cumsum(np.stack([x, y, steps[:, 2]], axis=1), axis=0)
    return np.concatenate([np.zeros((1, 3)), walked])


@pytest.mark.parametrize("seed", range(4))
def test_odometry_gives_the_scale_in_spite_of_drift(world: Any, seed: int) -> None:
    points = world.curve(300, flat=True)
    when = world.start_ns + np.arange(300) * SECOND // 10
    track = Trajectory.from_positions("robot", "odom", when + 7_000_000, drift(points, seed))
    # The heading has wandered far by the end; the metres have not.
    assert np.linalg.norm(track.position[-1] - (points[-1] - points[0])) > 0.02
    found = frame.scale_from_odometry(points / 5, when, np.zeros(300, np.int64), ["robot"], [track])
    assert found == pytest.approx(5, rel=0.02)


def test_odometry_of_another_device_or_at_rest_is_ignored(world: Any) -> None:
    points = world.curve(100, flat=True)
    when = world.start_ns + np.arange(100) * SECOND // 10
    device = np.zeros(100, np.int64)
    track = Trajectory.from_positions("blue", "odom", when, points)
    assert frame.scale_from_odometry(points, when, device, ["robot"], [track]) is None
    still = Trajectory.from_positions("robot", "odom", when, np.zeros((100, 3)))
    assert frame.scale_from_odometry(points, when, device, ["robot"], [still]) is None
    short = Trajectory.from_positions("robot", "odom", when[:1], points[:1])
    assert frame.scale_from_odometry(points, when, device, ["robot"], [short]) is None
    assert frame.scale_from_odometry(points, when, device, ["robot"], []) is None


def test_frame_of_the_first_station(recorded: Recorded) -> None:
    for planar in (True, False):
        to = frame.first_station_frame(recorded.state, planar, 5.0)
        home = frame.transform_state(recorded.state, to)
        true = np.stack([s.position for s in recorded.lamps])
        np.testing.assert_allclose(
            np.linalg.norm(home.positions[1] - home.positions[0]),
            np.linalg.norm(true[1] - true[0]),
            rtol=1e-9,
        )
        forward = home.rotations[0][:, 0]
        if planar:
            np.testing.assert_allclose(home.positions[0], [0, 0, true[0, 2]], atol=1e-9)
            np.testing.assert_allclose(home.points[:, 2], 0, atol=1e-9)
            assert abs(forward[1]) < 1e-9
            assert forward[0] > 0
        else:
            np.testing.assert_allclose(home.positions[0], 0, atol=1e-9)
            np.testing.assert_allclose(home.rotations[0], np.eye(3), atol=1e-9)


# ---- guards


def test_three_markers_give_a_frame_but_no_misfit(recorded: Recorded, world: Any) -> None:
    for count, is_known in ((3, False), (4, True)):
        markers = world.markers_of(recorded.lamps, world.square[:count])
        prior = Scene(markers=tuple(markers))
        framed = frame.fix_gauge(
            recorded.state, np.zeros((2, 10, 10)), True, prior, recorded.epochs, recorded.angles, ()
        )
        assert framed.scale == "markers"
        assert (framed.marker_misfit_m is not None) is is_known
        assert framed.warnings == ()


@pytest.mark.parametrize(("error_m", "warned"), [(0.03, False), (0.06, True)])
def test_markers_that_misfit_are_named(
    recorded: Recorded, world: Any, error_m: float, warned: bool
) -> None:
    # One corner of a square moved off: a third of it is the rms misfit of the best similarity.
    first, *others = world.markers_of(recorded.lamps, world.square)
    wrong = replace(first, position=first.position + [error_m, error_m, 0.0])
    framed = frame.fix_gauge(
        recorded.state,
        np.zeros((2, 10, 10)),
        True,
        Scene(markers=(wrong, *others)),
        recorded.epochs,
        recorded.angles,
        (),
    )
    assert ("marker_misfit" in {w.code for w in framed.warnings}) is warned


@pytest.mark.parametrize(("intervals", "is_known"), [(4, False), (5, True)])
def test_odometry_needs_five_intervals_with_motion(intervals: int, is_known: bool) -> None:
    when = np.arange(intervals + 1) * SECOND
    points = np.stack([0.3 * np.arange(intervals + 1.0), *np.zeros((2, intervals + 1))], axis=1)
    track = Trajectory.from_positions("robot", "odom", when, points)
    device = np.zeros(len(when), np.int64)
    scale = frame.scale_from_odometry(points / 5, when, device, ["robot"], [track])
    assert scale == (pytest.approx(5) if is_known else None)


def test_odometry_over_a_gap_is_not_compared() -> None:
    when = np.arange(10) * 2 * SECOND
    points = np.stack([0.3 * np.arange(10.0), *np.zeros((2, 10))], axis=1)
    track = Trajectory.from_positions("robot", "odom", when, points)
    device = np.zeros(10, np.int64)
    assert frame.scale_from_odometry(points, when, device, ["robot"], [track]) is None


def test_slow_intervals_do_not_give_the_scale() -> None:
    """In them the noise of the positions is as long as the path."""
    when = np.arange(40) * SECOND
    step = np.where(np.arange(40) < 30, 0.02, 0.3)
    x = np.cumsum(step)
    noisy = x / 5 + np.where(np.arange(40) % 2 == 0, 0.01, -0.01) * (np.arange(40) < 30)
    track = Trajectory.from_positions("robot", "odom", when, np.c_[x, 0 * x, 0 * x])
    device = np.zeros(40, np.int64)
    scale = frame.scale_from_odometry(np.c_[noisy, 0 * x, 0 * x], when, device, ["robot"], [track])
    assert scale == pytest.approx(5, rel=0.02)
