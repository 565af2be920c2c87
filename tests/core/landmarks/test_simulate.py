"""The simulator of landmarks against the closed form, kinematics, and its own promises.

Nothing here localizes: what is held is that samples, odometry and truth belong together.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.field import basis, landmark_field
from locatk.core.landmarks.halls import NAMES, HallSensors, circle
from locatk.core.landmarks.landmark import Geometry, code_of, pattern, signs
from locatk.core.landmarks.map.floor import (
    HOLE_CODE,
    STEPS,
    WINDOWS,
    AsBuiltLandmark,
    Cell,
    FloorMap,
)
from locatk.core.landmarks.simulation.floor import (
    BAR_DRAWS,
    DIPOLE_LENGTHS,
    bar_fields,
    dipole_fields,
    scatter_bars,
)
from locatk.core.landmarks.simulation.passes import simulate_passes
from locatk.core.landmarks.simulation.robot import Robot
from locatk.core.landmarks.simulation.sensors import odometry
from locatk.core.landmarks.simulation.session import (
    NONE,
    Aims,
    Errors,
    Faults,
    RobotLimits,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.landmarks.simulation.strategy import is_free
from locatk.core.simulation import SESSION_START_NS
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

FLOOR = FloorMap(np.random.default_rng(7).integers(0, 16, (5, 6)), origin_m=(0.3, -0.1))

PLAIN = SimulationOptions(errors=NONE, rate_hz=100.0)
"""A robot and a floor without any error."""

EXACT = Aims(0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def tour() -> SimulatedSession:
    """The paper's strategy on a faultless floor."""
    return simulate(FLOOR, replace(PLAIN, seed=3))


@pytest.fixture(scope="module")
def nominal() -> SimulatedSession:
    """The same with the nominal errors."""
    return simulate(FLOOR, SimulationOptions(rate_hz=100.0, seed=3))


def flat(trajectory: Trajectory) -> Array:
    """x, y and heading (n, 3), the heading without jumps."""
    heading = np.unwrap(heading_from_quaternion(trajectory.quaternion))
    return np.column_stack([trajectory.position[:, :2], heading])


def sensed(poses: Array, sensors: Array) -> Array:
    """Places (n, N, 2) of sensors."""
    spots = [
        position + sensors @ np.array([[math.cos(h), math.sin(h)], [-math.sin(h), math.cos(h)]])
        for *position, h in poses
    ]
    return np.array(spots)


def cells_of(simulated: SimulatedSession) -> list[Cell]:
    """In the order of their visits, each once in a row."""
    cells = [visit.cell for visit in simulated.events]
    return [cell for k, cell in enumerate(cells) if k == 0 or cell != cells[k - 1]]


def relative(poses: Array) -> Array:
    """Poses (n, 3) from the first one."""
    x, y, h = (poses - poses[0]).T
    c, s = math.cos(poses[0, 2]), math.sin(poses[0, 2])
    return np.column_stack([c * x + s * y, -s * x + c * y, h])


# ---- the field


def test_samples_are_the_closed_form_at_the_truth(tour: SimulatedSession) -> None:
    (samples,), (truth,) = tour.samples, tour.truth
    spots = sensed(flat(truth), circle(0.025))
    expected = sum(
        landmark_field(FLOOR.geometry, int(FLOOR.codes[cell]), spots - FLOOR.position(cell))
        for cell in FLOOR.cells()
    )
    # Landmarks out of reach are left out: a dozen of them, a microtesla each at most.
    assert samples.field_t == pytest.approx(np.asarray(expected), abs=4e-6)
    assert np.abs(samples.field_t).max() > 0.02


def test_a_displaced_landmark_has_its_field_there() -> None:
    floor = replace(FLOOR, codes=np.array([[14]]))
    errors = replace(
        NONE, landmark_place_m=5e-3, landmark_turn_rad=0.1, bar_strength=0.1, height_m=2e-3
    )
    options = replace(PLAIN, strategy="pass", errors=errors, seed=2)
    simulated = simulate(floor, options)
    (mark,) = simulated.installed_landmarks
    assert math.hypot(mark.x_m - 0.3, mark.y_m + 0.1) > 1e-3
    assert abs(mark.heading_rad) > 0.01
    spots = sensed(flat(simulated.truth[0]), circle(0.025)) - [mark.x_m, mark.y_m]
    c, s = math.cos(mark.heading_rad), math.sin(mark.heading_rad)
    own = spots @ np.array([[c, -s], [s, c]])
    expected = basis(floor.geometry, own, 0.014) @ mark.strength
    near = np.hypot(*np.moveaxis(own, -1, 0)) < 0.03 * DIPOLE_LENGTHS
    assert 1 > near.mean() > 0.5
    read = simulated.samples[0].field_t
    assert read[near] == pytest.approx(expected[near], abs=1e-12)
    assert read[~near] == pytest.approx(expected[~near], abs=5e-7)
    assert np.sign(mark.strength) == pytest.approx(signs(14))


def test_rotated_and_tilted_bars_agree_with_magpylib() -> None:
    geometry, rng = Geometry(), np.random.default_rng(4)
    errors = replace(NONE, bar_place_m=1e-3, bar_turn_rad=0.1, bar_lean_rad=0.1)
    _, middle, axes = scatter_bars(geometry, rng.standard_normal((1, BAR_DRAWS)), errors)
    points = np.column_stack([rng.uniform(-0.06, 0.06, (50, 2)), np.full(50, 0.012)])
    own = bar_fields(geometry, middle[0], axes[0], points[:, None])
    for bar in range(4):
        magnet = magpylib.magnet.Cuboid(
            polarization=(1.2, 0, 0),
            dimension=(0.03, 0.01, 0.005),
            position=middle[0, bar],
            orientation=Rotation.from_matrix(axes[0, bar]),
        )
        assert own[:, bar] == pytest.approx(magnet.getB(points)[:, 2], abs=1e-15)


def test_far_bars_are_dipoles_to_a_third_of_a_microtesla() -> None:
    draws = np.random.default_rng(4).standard_normal((1, BAR_DRAWS))
    _, middle, axes = scatter_bars(Geometry(), draws, replace(NONE, bar_turn_rad=0.1))
    angle = np.linspace(0, 2 * math.pi, 40)[:, None]
    for away, most in ((0.03 * DIPOLE_LENGTHS, 3e-7), (0.3, 3e-8)):
        points = away * np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        points[:, 2] = 0.012
        given = (Geometry(), middle[0], axes[0], points[:, None])
        exact, rough = bar_fields(*given), dipole_fields(*given)
        assert np.abs(rough - exact).max() < most
        assert np.abs(exact).max() > 5 * most


def test_a_bar_that_is_n_points_counter_clockwise() -> None:
    _, middle, axes = scatter_bars(Geometry(), np.ones((1, BAR_DRAWS)), NONE)
    north_ends = [[0.025, 0.014, 0.012], [-0.014, 0.025, 0.012]]
    above = bar_fields(Geometry(), middle[0, :2], axes[0, :2], north_ends)
    # Out of a north pole the field comes up.
    assert (above > 5e-3).all()


def test_errors_of_bars_are_as_large_as_asked() -> None:
    errors = replace(
        NONE, bar_strength=0.04, bar_place_m=5e-4, bar_turn_rad=0.02, bar_lean_rad=0.01
    )
    draws = np.random.default_rng(1).standard_normal((2000, BAR_DRAWS))
    strength, middle, axes = scatter_bars(Geometry(), draws, errors)
    assert strength.mean() == pytest.approx(1, abs=2e-3)
    assert strength.std() == pytest.approx(0.04, rel=0.03)
    assert middle.std(axis=0)[:, :2] == pytest.approx(np.full((4, 2), 5e-4), rel=0.06)
    assert middle[..., 2] == pytest.approx(-0.0025)
    along = axes[:, 0, :, 0]
    assert along[:, 0].std() == pytest.approx(0.02, rel=0.06)
    assert along[:, 2].std() == pytest.approx(0.01, rel=0.06)


# ---- the robot


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        PLAIN,
        replace(PLAIN, seed=5, landmarks=7, limits=RobotLimits(0.2, 0.5, 1.0, 3.0)),
        replace(PLAIN, strategy="path", cells=((0, 0), (0, 3), (2, 3), (4, 0))),
        replace(PLAIN, strategy="path", waypoints=((0.3, 0.0), (0.6, 0.1), (0.6, 0.5))),
        replace(PLAIN, strategy="pass"),
    ],
)
def test_it_moves_as_a_differential_drive_can(options: SimulationOptions) -> None:
    (truth,) = simulate(FLOOR, options).truth
    poses, dt, limits = flat(truth), 1 / options.rate_hz, options.limits
    assert np.diff(truth.time_ns) == pytest.approx(1e9 * dt, abs=1)
    step = np.diff(poses, axis=0)
    middle = poses[:-1, 2] + step[:, 2] / 2
    ahead = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    aside = step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)
    # A landing curve changes sides within a step, no more.
    assert np.abs(aside).max() < 2e-6
    assert np.abs(ahead).max() <= limits.speed_mps * dt * (1 + 1e-9)
    assert np.abs(ahead).max() > 0.9 * limits.speed_mps * dt
    assert np.abs(step[:, 2]).max() <= limits.turn_rps * dt * (1 + 1e-9)
    gain = np.abs(np.diff(ahead)) / dt**2
    assert gain.max() <= limits.acceleration_mps2 * 1.01
    # It starts and ends at rest.
    rest = round(0.4 / dt)
    assert not step[:rest].any()
    assert not step[-rest:].any()


@given(
    st.tuples(*[st.floats(-1, 1)] * 2, st.floats(-7, 7)),
    st.floats(0.02, 0.4),
    st.floats(-0.45, 0.45),
)
@settings(max_examples=60, deadline=None)
def test_a_landing_curve_arrives_with_the_heading_it_had(
    pose: tuple[float, float, float], away: float, off: float
) -> None:
    robot = Robot(np.array(pose))
    path = pose[2] + off
    position = np.array([pose[0] + away * math.cos(path), pose[1] + away * math.sin(path)])
    robot.land_at(position)
    assert robot.pose == pytest.approx([*position, pose[2]], abs=1e-9)
    # Two equal arcs: the curve passes the middle of the chord half-way through.
    halfway = robot.poses_at(np.array([robot.time_s / 2]))[0]
    assert halfway[:2] == pytest.approx((np.array(pose[:2]) + position) / 2, abs=1e-9)
    assert halfway[2] - pose[2] == pytest.approx(2 * off, abs=1e-9)


def test_the_robot_reverses_over_short_distances() -> None:
    robot = Robot(np.array([0.0, 0.0, 0.0]))
    robot.drive_to((-0.02, 0.0), back_m=0.05)
    assert robot.pose == pytest.approx([-0.02, 0, 0])
    robot.drive_to((0.0, 0.0), back_m=0.05)
    assert robot.pose == pytest.approx([0, 0, 0]), "ahead, however near"
    robot.drive_to((-0.02, 0.0), back_m=0.05)
    robot.drive_to((-0.12, 0.0), back_m=0.05)
    assert abs(robot.pose[2]) == pytest.approx(math.pi)
    assert robot.pose[:2] == pytest.approx([-0.12, 0])


# ---- the paper's strategy


def test_it_searches_spins_and_goes_an_l(tour: SimulatedSession) -> None:
    (truth,) = tour.truth
    # The first pass may have brushed the landmark behind the first one.
    *brushed, first_cell, second_cell, third_cell = cells_of(tour)
    assert set(brushed) <= {first_cell, *(c for c in FLOOR.cells() if math.dist(c, first_cell) < 2)}
    cells = [first_cell, second_cell, third_cell]
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(cells)]
    first, second = map(STEPS.index, steps)
    assert (second - first) % 4 == 1
    poses = flat(truth)
    start = poses[0, :2]
    # It starts outside of every territory: the nearest sensor is 54 mm away or more.
    assert min(math.dist(start, FLOOR.position(cell)) for cell in FLOOR.cells()) > 0.079
    for cell in cells:
        near = np.hypot(*(poses[:, :2] - FLOOR.position(cell)).T) < 0.02
        assert np.ptp(poses[near, 2]) > 2 * math.pi, "a spin on each"
        still = near[1:] & ~np.diff(poses, axis=0).any(axis=1)
        assert still.sum() >= 45, "half a second of compensation"
        stands = poses[1:][still]
        off = np.hypot(*(stands[:, :2] - FLOOR.position(cell)).T)
        assert off.max() < 0.008
        rotated = np.remainder(stands[:, 2] + math.pi / 4, math.pi / 2) - math.pi / 4
        assert np.abs(rotated).max() < math.radians(4)


def test_each_visit_is_felt(nominal: SimulatedSession) -> None:
    (samples,) = nominal.samples
    threshold = FLOOR.geometry.threshold_t
    assert nominal.events
    for visit in nominal.events:
        assert visit.first_ns <= visit.nearest_ns <= visit.last_ns
        assert visit.nearest_m < 0.06
        during = (samples.time_ns >= visit.first_ns) & (samples.time_ns <= visit.last_ns)
        assert np.abs(samples.field_t[during]).max() > 2 * threshold
    over = np.zeros(len(samples), bool)
    for visit in nominal.events:
        over |= (samples.time_ns >= visit.first_ns) & (samples.time_ns <= visit.last_ns)
    # And what is none is not: the rest of the territory reaches 54 mm.
    assert np.abs(samples.field_t[~over]).max() < 1.5e-2
    assert np.median(np.abs(samples.field_t[~over]).max(axis=1)) < threshold


SHAPES = {
    "L": [(0, 0), (1, 0), (1, 1)],
    "I2": [(0, 0), (1, 0)],
    "I3": [(0, 0), (1, 0), (2, 0)],
    "2x2": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "3x3": [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (0, 2), (1, 2), (2, 2)],
}
"""Places of a window's landmarks (ahead, left)."""


@pytest.mark.parametrize("window", WINDOWS)
def test_it_reads_the_window_of_the_map(window: str) -> None:
    floor = replace(FLOOR, window=window)
    simulated = simulate(floor, replace(PLAIN, rate_hz=20.0, spins=1, stop_s=0.1, seed=1))
    cells = cells_of(simulated)
    assert not simulated.notes
    shapes = []
    for q in range(4):
        (up, right), (left_up, left_right) = STEPS[q], STEPS[(q + 1) % 4]
        for side in (1, -1):
            shapes.append(
                [
                    (
                        cells[0][0] + ahead * up + side * left * left_up,
                        cells[0][1] + ahead * right + side * left * left_right,
                    )
                    for ahead, left in SHAPES[window]
                ]
            )
    assert cells in shapes


@pytest.mark.parametrize("seed", range(6))
def test_it_respects_holes_and_walls(seed: int) -> None:
    rng = np.random.default_rng(seed)
    codes = np.where(rng.random((6, 6)) < 0.25, HOLE_CODE, rng.integers(0, 16, (6, 6)))
    walls = frozenset(
        ((row, column), (row + up, column + right))
        for row in range(5)
        for column in range(5)
        for up, right in ((0, 1), (1, 0))
        if rng.random() < 0.15
    )
    floor = FloorMap(codes, walls=walls)
    options = replace(PLAIN, rate_hz=20.0, landmarks=12, spins=0, stop_s=0.0, seed=seed)
    simulated = simulate(floor, options)
    assert is_free(floor, simulated.truth[0].position[:, :2])
    cells = cells_of(simulated)
    for one, other in pairwise(cells):
        heading = STEPS.index((other[0] - one[0], other[1] - one[1]))
        assert floor.is_passable(one, heading)
    assert len(cells) >= 12 or simulated.notes


def test_what_is_free() -> None:
    floor = FloorMap(np.array([[1, 2], [HOLE_CODE, 3]]), walls=frozenset({((0, 0), (0, 1))}))

    def line(*ends: tuple[float, float]) -> Array:
        return np.linspace(*ends, 41)

    assert is_free(floor, line((0.0, -0.05), (0.0, 0.05)))
    assert not is_free(floor, line((0.0, 0.19), (0.0, 0.21))), "within a hole"
    assert not is_free(floor, line((0.0, 0.0), (0.2, 0.0))), "a wall"
    assert not is_free(floor, line((0.0, 0.0), (0.0, 0.2))), "a hole"
    assert is_free(floor, line((0.2, 0.0), (0.2, 0.2)))
    assert not is_free(floor, line((0.2, 0.0), (0.4, 0.0))), "the end of the map"
    # From corner to corner it would need one of the two cells beside.
    assert not is_free(floor, line((0.0, 0.0), (0.2, 0.2)))
    assert is_free(replace(floor, walls=frozenset()), line((0.0, 0.0), (0.2, 0.2)))


def test_the_robot_starts_at_the_given_cell() -> None:
    start = (0.4, 0.0, 0.8)
    simulated = simulate(FLOOR, replace(PLAIN, start=start, rate_hz=20.0))
    assert flat(simulated.truth[0])[0] == pytest.approx(start)
    with pytest.raises(InputError, match="meets no landmark"):
        simulate(FLOOR, replace(PLAIN, start=(0.2, 0.0, math.pi)))


def test_more_landmarks_than_reachable_are_noted() -> None:
    alone = FloorMap(np.array([[14]]), pitch_m=0.3)
    simulated = simulate(alone, replace(PLAIN, rate_hz=20.0))
    assert {visit.cell for visit in simulated.events} == {(0, 0)}
    assert any("not reached" in note for note in simulated.notes)


# ---- other ways


def test_a_path_is_followed() -> None:
    path = ((0.3, 0.0), (0.6, 0.1), (0.6, 0.5))
    simulated = simulate(FLOOR, replace(PLAIN, strategy="path", waypoints=path, aims=EXACT))
    poses = flat(simulated.truth[0])
    for position in path:
        assert np.hypot(*(poses[:, :2] - position).T).min() < 1e-3
    assert poses[0, :2] == pytest.approx(path[0])
    assert poses[-1, :2] == pytest.approx(path[-1])
    assert not simulated.notes
    beyond = replace(PLAIN, strategy="path", waypoints=((0.3, 0.0), (-0.3, 0.0)))
    assert "leaves the map" in simulate(FLOOR, beyond).notes[0]


def test_a_path_of_cells_visits_them() -> None:
    cells = ((0, 0), (0, 2), (3, 2))
    simulated = simulate(FLOOR, replace(PLAIN, strategy="path", cells=cells))
    expected = [(0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (3, 2)]
    assert cells_of(simulated) == expected


@pytest.mark.parametrize("lateral", [-0.03, 0.0, 0.02])
def test_a_pass_goes_by_the_centre_on_the_side_asked_for(lateral: float) -> None:
    options = replace(PLAIN, strategy="pass", cell=(2, 3), lateral_m=lateral, approach_rad=1.0)
    simulated = simulate(FLOOR, options)
    poses = flat(simulated.truth[0])
    centre = np.array(FLOOR.position((2, 3)))
    assert math.dist(poses[0, :2], centre) == pytest.approx(0.115)
    assert poses[0, :2] - centre == pytest.approx([0.115 * math.cos(1), 0.115 * math.sin(1)])
    heading = poses[0, 2]
    left = (poses[:, :2] - centre) @ [-math.sin(heading), math.cos(heading)]
    assert left == pytest.approx(lateral, abs=1e-9)
    assert math.dist(poses[0, :2], poses[-1, :2]) == pytest.approx(0.23)


def test_a_pass_finds_its_pattern() -> None:
    simulated = simulate(FLOOR, replace(PLAIN, strategy="pass", pattern="NNNS", lateral_m=0.0))
    (cell,) = {visit.cell for visit in simulated.events if visit.nearest_m < 0.01}
    assert pattern(int(FLOOR.codes[cell])) == "NNNS"
    with pytest.raises(InputError, match="no landmark"):
        simulate(FloorMap(np.array([[0]])), replace(PLAIN, strategy="pass", pattern="NNNS"))


# ---- odometry


def test_odometry_without_errors_is_the_truth(tour: SimulatedSession) -> None:
    (truth,), (reported,) = tour.truth, tour.odometry
    assert reported.frame == "odometry"
    assert flat(reported)[0] == pytest.approx([0, 0, 0])
    both = np.isin(truth.time_ns, reported.time_ns)
    expected = relative(flat(truth))[both]
    assert flat(reported)[np.isin(reported.time_ns, truth.time_ns)] == pytest.approx(
        expected, abs=5e-6
    )


def test_errors_of_odometry_are_as_large_as_asked() -> None:
    errors = Errors()
    straight = np.linspace([0.2, 0.1, 0.0], [0.7, 0.1, 0.0], 101)
    spin = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 4 * math.pi], 101)
    ways, rotations = [], []
    for seed in range(400):
        reported, slips = odometry(straight, errors, np.random.default_rng(seed))
        assert not slips
        ways.append((np.hypot(*np.diff(reported[:, :2], axis=0).T).sum(), reported[-1, 2]))
        rotations.append(odometry(spin, errors, np.random.default_rng(seed))[0][-1, 2])
    length, heading = np.array(ways).T
    # Noise of two wheels of half a metre each; the track is 0.1 m.
    noise = 0.2e-3 * math.sqrt(0.5)
    assert length.mean() == pytest.approx(0.5, abs=2e-3)
    assert length.std() == pytest.approx(math.hypot(0.005, noise / math.sqrt(2)), rel=0.1)
    drift = math.radians(1) / 0.23 * 0.5
    expected = math.hypot(drift, math.sqrt(2) * noise / 0.1)
    assert heading.std() == pytest.approx(expected, rel=0.1)
    assert np.std(rotations) == pytest.approx(0.01 * 4 * math.pi, rel=0.1)


def test_a_slipping_wheel_rotates_too_far() -> None:
    straight = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 1001)
    errors = replace(NONE, slips_per_m=3.0, slip_m=0.005)
    counts = []
    for seed in range(50):
        reported, slips = odometry(straight, errors, np.random.default_rng(seed))
        counts.append(len(slips))
        if len(slips) == 1 and slips[0] < 900:
            assert abs(reported[-1, 2]) == pytest.approx(0.005 / 0.1, rel=0.05)
            assert not reported[: slips[0] + 1, 2].any()
    assert np.mean(counts) == pytest.approx(3, abs=0.8)


# ---- sensors and faults


@pytest.mark.slow
def test_sensors_err_as_much_as_asked() -> None:
    still = replace(
        PLAIN, strategy="pass", cell=(2, 3), lateral_m=0.0, approach_rad=0.5, rest_s=10.0
    )
    quiet = simulate(FLOOR, still).samples[0].field_t[:900]
    assert np.ptp(quiet, axis=0) == pytest.approx(0, abs=1e-12)
    errors = replace(NONE, noise_t=1.5e-4, offset_t=1e-4, earth_t=-45e-6)
    off = []
    for seed in range(12):
        (read,) = simulate(FLOOR, replace(still, errors=errors, seed=seed)).samples
        assert read.sensors.noise_t == 1.5e-4
        first = read.field_t[:900]
        assert first.std(axis=0) == pytest.approx(1.5e-4, rel=0.1)
        off.append((first - quiet).mean(axis=0))
    assert np.std(off) == pytest.approx(1e-4, rel=0.3)
    assert np.mean(off) == pytest.approx(-45e-6, abs=4e-5)


def test_gains_are_of_the_sensor() -> None:
    errors = replace(NONE, gain=0.03)
    options = replace(PLAIN, strategy="pass", cell=(2, 3), lateral_m=0.0)
    exact = simulate(FLOOR, options).samples[0].field_t
    read = simulate(FLOOR, replace(options, errors=errors)).samples[0].field_t
    strong = np.abs(exact) > 1e-3
    for sensor in range(4):
        ratio = (read / exact)[strong[:, sensor], sensor]
        assert np.ptp(ratio) < 1e-9
        assert 0 < abs(ratio[0] - 1) < 0.12


def test_readings_saturate_and_have_steps() -> None:
    options = replace(PLAIN, strategy="pass", cell=(2, 3), lateral_m=0.0, range_t=0.01)
    simulated = simulate(FLOOR, replace(options, errors=replace(NONE, quantum_t=1e-4)))
    (samples,) = simulated.samples
    assert samples.sensors.range_t == 0.01
    assert np.abs(samples.field_t).max() == 0.01
    ends = np.count_nonzero(np.abs(samples.field_t) >= 0.01)
    assert simulated.saturated == ends > 10
    assert samples.field_t / 1e-4 == pytest.approx(np.rint(samples.field_t / 1e-4), abs=1e-6)


def test_dead_stuck_and_swapped_sensors() -> None:
    options = replace(PLAIN, strategy="pass", cell=(2, 3), lateral_m=0.02)
    exact = simulate(FLOOR, options).samples[0].field_t
    faults = Faults(dead=("rear",), stuck=("right",), swapped=(("front", "left"),))
    read = simulate(FLOOR, replace(options, faults=faults)).samples[0].field_t
    assert np.isnan(read[:, 2]).all()
    assert np.ptp(read[:, 3]) == 0
    assert np.array_equal(read[:, :2], exact[:, 1::-1])
    assert not np.array_equal(exact[:, 0], exact[:, 1])


def test_faults_of_the_floor_are_at_the_given_cells() -> None:
    faults = Faults(
        flipped=(((1, 2), 0), ((1, 2), 3)),
        missing=(((0, 1), 2),),
        displaced=(((4, 5), (0.004, -0.002)),),
    )
    options = replace(PLAIN, rate_hz=20.0, faults=faults, errors=replace(NONE, bar_strength=0.04))
    plain = simulate(FLOOR, replace(options, faults=Faults()))
    wrong = simulate(FLOOR, options)
    for before, after in zip(plain.installed_landmarks, wrong.installed_landmarks, strict=True):
        strength = before.strength.copy()
        if after.cell == (1, 2):
            strength[[0, 3]] *= -1
            assert after.faults == ("flipped:0", "flipped:3")
        elif after.cell == (0, 1):
            strength[2] = 0.0
            assert after.faults == ("missing:2",)
        elif after.cell == (4, 5):
            assert (after.x_m - before.x_m, after.y_m - before.y_m) == pytest.approx(
                (0.004, -0.002)
            )
            assert after.middle_m[:, :2] - before.middle_m[:, :2] == pytest.approx(
                np.tile([0.004, -0.002], (4, 1))
            )
            assert after.faults == ("displaced",)
        else:
            assert not after.faults
        assert after.strength == pytest.approx(strength)


@pytest.mark.parametrize("alphabet", ["6", "16", "compass"])
def test_a_misread_landmark_is_another_one_of_the_alphabet(alphabet: str) -> None:
    known = {"6": ("NSNS", "NNNS", "SSSN", "NNSS", "NNNN", "SSSS")}.get(
        alphabet, ("NNNS", "SSSN", "NNSS")
    )
    letters = np.array([code_of(each) for each in known])
    codes = np.resize(letters, (12, 12))
    floor = FloorMap(codes, alphabet=alphabet)
    options = replace(PLAIN, rate_hz=10.0, faults=Faults(misread_rate=0.3))
    simulated = simulate(floor, options)
    wrong = [mark for mark in simulated.installed_landmarks if mark.code != mark.designed]
    assert all(mark.faults == ("misread",) for mark in wrong)
    assert len(wrong) / 144 == pytest.approx(0.3, abs=0.12)
    if alphabet == "6":
        assert all(pattern(mark.code) != pattern(mark.designed) for mark in wrong)
    if alphabet == "compass":
        assert {mark.code for mark in wrong} <= set(letters.tolist())


def test_a_floor_has_the_built_positions() -> None:
    built = AsBuiltLandmark(
        0.004, -0.003, 0.05, np.array([1.1, -0.9, 0.0, math.nan]), np.full(7, math.nan)
    )
    floor = replace(FLOOR, built={(2, 3): built})
    simulated = simulate(floor, replace(PLAIN, rate_hz=10.0, errors=Errors()))
    (mark,) = (mark for mark in simulated.installed_landmarks if mark.cell == (2, 3))
    x, y = floor.position((2, 3))
    assert (mark.x_m, mark.y_m, mark.heading_rad) == pytest.approx((x + 0.004, y - 0.003, 0.05))
    assert mark.strength[:3] == pytest.approx([1.1, -0.9, 0.0])
    assert abs(mark.strength[3]) == pytest.approx(1, abs=0.2)


# ---- seeds and bad input


@pytest.mark.slow
def test_the_same_seed_gives_the_same_session(nominal: SimulatedSession) -> None:
    again = simulate(FLOOR, SimulationOptions(rate_hz=100.0, seed=3))
    assert np.array_equal(again.samples[0].field_t, nominal.samples[0].field_t)
    assert np.array_equal(again.odometry[0].position, nominal.odometry[0].position)
    assert again.events == nominal.events
    other = simulate(FLOOR, SimulationOptions(rate_hz=100.0, seed=4))
    assert not np.allclose(other.truth[0].position[0], nominal.truth[0].position[0])


def test_more_noise_leaves_all_else_as_it_is(nominal: SimulatedSession) -> None:
    loud = SimulationOptions(rate_hz=100.0, seed=3, errors=replace(Errors(), noise_t=3e-4))
    read = simulate(FLOOR, loud)
    assert np.array_equal(read.truth[0].position, nominal.truth[0].position)
    assert np.array_equal(read.odometry[0].position, nominal.odometry[0].position)
    added = read.samples[0].field_t - nominal.samples[0].field_t
    assert added.std() == pytest.approx(1.5e-4, rel=0.05)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"strategy": "dance"}, "dance"),
        ({"landmarks": 0}, "landmarks"),
        ({"strategy": "path"}, "waypoints"),
        ({"strategy": "path", "cells": ((0, 0), (9, 9))}, "9,9"),
        ({"strategy": "pass", "cell": (0, 7)}, "0,7"),
        ({"strategy": "pass", "lateral_m": 0.2}, "115 mm"),
        ({"pattern": "NNN"}, "NNN"),
        ({"faults": Faults(dead=("top",))}, "faults"),
        ({"faults": Faults(flipped=(((7, 7), 0),))}, "7,7"),
        ({"faults": Faults(missing=(((0, 0), 4),))}, "bar 4"),
        ({"errors": replace(NONE, height_m=-0.012)}, "top faces"),
        ({"rate_hz": 1e6}, "samples"),
        ({"range_t": 0.0}, "range_t"),
        ({"limits": RobotLimits(speed_mps=0.0)}, "limits"),
    ],
)
def test_impossible_settings_are_refused(given: dict[str, object], said: str) -> None:
    with pytest.raises(InputError) as raised:
        simulate(FLOOR, replace(PLAIN, **given))  # type: ignore[arg-type]
    assert said in f"{raised.value} {raised.value.hint}"


def test_errors_that_cannot_be_are_refused() -> None:
    for name in ("noise_t", "bar_strength", "slip_m"):
        with pytest.raises(InputError, match=name):
            replace(Errors(), **{name: -1e-3})
    assert Errors().scaled(2).gain == 0.06
    assert Errors().scaled(0) == replace(NONE, earth_t=-45e-6)


# ---- passes for studies


@pytest.mark.slow
def test_passes_start_on_the_circle_and_head_for_the_landmark() -> None:
    generated = simulate_passes(150, errors=NONE, seed=5)
    starts = np.array([flat(one.truth)[0] for one in generated])
    assert np.hypot(starts[:, 0], starts[:, 1]) == pytest.approx(0.115)
    to_centre = np.arctan2(-starts[:, 1], -starts[:, 0])
    aside = np.remainder(starts[:, 2] - to_centre + math.pi, 2 * math.pi) - math.pi
    assert np.abs(aside).max() <= math.pi / 4
    assert np.abs(aside).max() > 0.7
    assert aside.std() == pytest.approx(math.pi / 2 / math.sqrt(12), rel=0.15)
    for one in generated[:20]:
        poses = flat(one.truth)
        assert np.hypot(*np.diff(poses[:, :2], axis=0).T) == pytest.approx(0.002)
        assert math.dist(poses[0, :2], poses[-1, :2]) == pytest.approx(0.23)
        assert one.end[:2] == pytest.approx(poses[-1, :2])
        assert flat(one.odometry) == pytest.approx(relative(poses), abs=1e-9)
    # With 25 mm to either side and 45 to 54 mm of territory, some miss and most do not.
    lines = np.bincount([one.lines for one in generated], minlength=4)
    assert len(lines) == 4
    assert lines[0] < 0.2 * 150 < lines[1:].sum()


def test_passes_feel_the_closed_form() -> None:
    geometry = Geometry(sensor_height_m=0.01)
    for then in ("", "spin", "pass", "stand"):
        for one in simulate_passes(
            3, [14, 5, 3], geometry=geometry, errors=NONE, then=then, seed=2
        ):
            spots = sensed(flat(one.truth), circle(0.025))
            expected = landmark_field(geometry, one.code, spots)
            assert one.samples.field_t == pytest.approx(expected, abs=1e-12)
            assert one.strength == pytest.approx(signs(one.code))
            assert np.array_equal(one.samples.time_ns, one.truth.time_ns)
            assert one.samples.time_ns[0] == SESSION_START_NS


@pytest.mark.slow
def test_what_follows_a_pass_is_near_the_centre() -> None:
    aims = [np.hypot(*one.end[:2]) for one in simulate_passes(150, 14, errors=NONE, then="stand")]
    assert np.mean(aims) == pytest.approx(0.007, rel=0.13)
    for one in simulate_passes(4, 14, errors=NONE, then="spin", aim_m=0.0):
        poses = flat(one.truth)
        over = np.hypot(poses[:, 0], poses[:, 1]) < 1e-9
        assert np.ptp(poses[over, 2]) >= 2 * math.pi - 1e-9
        assert not over[: one.first].all()
    for one in simulate_passes(4, 14, errors=NONE, then="pass", aim_m=0.0):
        poses = flat(one.truth)
        along = poses[-1, 2] - poses[0, 2]
        assert math.cos(along) == pytest.approx(0, abs=1e-9)
        second = poses[one.first :]
        assert np.hypot(second[:, 0], second[:, 1]).min() < 0.002


@pytest.mark.slow
def test_passes_err_as_facts_say() -> None:
    exact, generated = (simulate_passes(200, 14, errors=errors, seed=1) for errors in (NONE, None))
    scale, drift, strength = [], [], []
    for one, other in zip(exact, generated, strict=True):
        assert np.array_equal(one.truth.position, other.truth.position)
        reported = flat(other.odometry)
        scale.append(np.hypot(*np.diff(reported[:, :2], axis=0).T).sum() / 0.23)
        drift.append(reported[-1, 2])
        strength.append(np.abs(other.strength))
    assert np.std(scale) == pytest.approx(0.01, rel=0.15)
    # A degree, and the noise of the wheels.
    assert np.std(drift) == pytest.approx(math.hypot(math.radians(1), 1.36e-3), rel=0.12)
    assert np.std(strength) == pytest.approx(0.04, rel=0.1)
    far = np.concatenate([other.samples.field_t[:3] for other in generated])
    near = np.concatenate([one.samples.field_t[:3] for one in exact])
    assert (far - near).std() == pytest.approx(math.hypot(1.5e-4, 1e-4), rel=0.1)
    assert (far - near).mean() == pytest.approx(-45e-6, abs=2e-5)


def test_passes_are_asked_for_with_sense() -> None:
    with pytest.raises(InputError, match="dance"):
        simulate_passes(1, then="dance")
    with pytest.raises(InputError, match="16"):
        simulate_passes(1, 16)
    sensors = HallSensors(NAMES, circle(0.03), range_t=0.005)
    (one,) = simulate_passes(1, 5, sensors=sensors, start=(0.0, 0.0))
    assert one.samples.sensors is sensors
    assert np.abs(one.samples.field_t).max() == 0.005
    assert flat(one.truth)[0] == pytest.approx([0.115, 0, math.pi])
