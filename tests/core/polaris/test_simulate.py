"""The simulator of polaris against magpylib used naively, closed forms, and a recording.

Nothing here solves a pass: what is held is that samples and truth belong together.
"""

from __future__ import annotations

import ast
import csv
import math
from dataclasses import replace
from pathlib import Path

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.magnetics import dipole_field
from locatk.core.polaris import codec
from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.simulation.field import Discs, disc_field, scatter_debris
from locatk.core.polaris.simulation.sensors import SensorFaults, measure, received_frames
from locatk.core.polaris.simulation.session import (
    CARS,
    SimulatedSession,
    SimulationOptions,
    simulate,
    usual_bar,
)
from locatk.core.polaris.tag import AsBuiltTag, Magnet, PlanarPose, TagLayout, Tags
from locatk.core.simulation import SESSION_START_NS

Array = NDArray[np.float64]
UT = 1e-6

EXACT = SensorArray(bar(9, 0.02), noise_t=np.zeros(3))
"""Nine sensors that make no errors, all axes at once."""

PLAIN = SimulationOptions(array=EXACT, earth_t=0.0, offset_t=0.0)

WIDE_SPACING = Tags(order=2, magnets=3, spacing_m=0.5)
"""Magnets half a metre apart: under one of them the others make 4 nT."""

NO_FIELD = Tags(magnet=Magnet(remanence_t=1e-12))
"""A tag without any field."""


def stamped(simulated: SimulatedSession) -> Array:
    """Seconds since the start of the drive."""
    return (simulated.samples.time_ns - SESSION_START_NS) * 1e-9


def over_v1(symbol: int) -> SimulatedSession:
    """Straight over v1 of a lonely tag, whose magnet has this orientation; then over v2."""
    layout = TagLayout(((0, 0), (0, 1), (1, 1)), (symbol, 0, 0))
    options = replace(
        PLAIN, route=(codec.id_of(WIDE_SPACING, layout),), lateral_m=0.25, run_up_m=0.05
    )
    return simulate(WIDE_SPACING, options)


def sample_at(simulated: SimulatedSession, x_m: float, axis: int = 0) -> Array:
    """Readings (N, 3) where the array's middle is at that x (or y), between the samples."""
    path = simulated.truth.position[:, axis]
    return np.asarray(CubicSpline(path, simulated.samples.field_t)(x_m))


# ---- the field


def test_each_sample_agrees_with_magpylib() -> None:
    """Its own sensors and magnets, placed by truth and by the paper's words alone."""
    tags = Tags(site={300: PlanarPose(0.1, -0.2, 0.4), 77: PlanarPose(0.45, -0.05, -2.0)})
    options = replace(
        PLAIN,
        earth_t=50 * UT,
        north_rad=0.9,
        crab_rad=0.1,
        yaw_wobble_rad=0.05,
        height_wobble_m=1e-3,
        speed_wobble=0.3,
        seed=4,
    )
    simulated = simulate(tags, options)
    truth, read = simulated.truth, simulated.samples.field_t
    magnets = magpylib.Collection()
    for tag_id, at in tags.site.items():
        layout = codec.layout_of(tags, tag_id)
        for (column, row), symbol in zip(layout.cells, layout.symbols, strict=True):
            # Rows forward (x), columns to the right (-y), orientations clockwise from x.
            ahead, left = 0.04 * (row - 1), -0.04 * (column - 1)
            c, s = math.cos(at.heading_rad), math.sin(at.heading_rad)
            magnets.add(
                magpylib.magnet.Cylinder(
                    polarization=(1.45, 0, 0),
                    dimension=(2e-3, 0.5e-3),
                    position=(at.x_m + c * ahead - s * left, at.y_m + s * ahead + c * left, 0),
                    orientation=Rotation.from_euler(
                        "z", at.heading_rad - math.radians(45 * symbol)
                    ),
                )
            )
    dip = math.radians(65)
    earth = [math.cos(dip) * math.cos(0.9), math.cos(dip) * math.sin(0.9), -math.sin(dip)]
    for n in range(0, len(read), 37):
        rotation = Rotation.from_quat(truth.quaternion[n])
        sensor = magpylib.Sensor(
            position=truth.position[n], orientation=rotation, pixel=EXACT.position_m.tolist()
        )
        expected = magnets.getB(sensor) + rotation.inv().apply(50 * UT * np.array(earth))
        # What is left out is below a nanotesla a magnet.
        assert read[n] == pytest.approx(expected, abs=5e-9)
    assert np.ptp(read, axis=0).max() > 150 * UT
    assert np.ptp(truth.position[:, 2]) > 1e-3


def test_far_away_magnets_are_dipoles_and_near_they_are_not() -> None:
    for height, least, most in ((0.1, 0.0, 2e-3), (0.01, 5e-3, 2e-2)):
        simulated = simulate(None, replace(PLAIN, clearance_m=height, heading_rad=0.3))
        truth = simulated.truth
        rotation = Rotation.from_quat(truth.quaternion)
        total = np.zeros_like(simulated.samples.field_t)
        for sensor, position in enumerate(EXACT.position_m):
            points = truth.position + rotation.apply(position)
            for point, angle in zip(
                simulated.magnets.position_m, simulated.magnets.angle_rad, strict=True
            ):
                # 1.8125 mA m2: remanence 1.45 T (N52) times the volume of 2 x 0.5 mm, over mu0.
                moment = 1.8125e-3 * np.array([math.cos(angle), math.sin(angle), 0])
                field = dipole_field(points - [*point, 0], moment)
                total[:, sensor] += rotation.inv().apply(field)
        away = np.abs(simulated.samples.field_t - total).max() / np.abs(total).max()
        assert least <= away < most


def test_a_magnet_with_its_north_ahead_pulls_the_field_back_right_above_it() -> None:
    simulated = over_v1(symbol=0)
    above = sample_at(simulated, -0.25)[4]
    # 178.8 uT at 10 mm: magpylib 6.1.0, cylinder of 2 x 0.5 mm with 1.45 T.
    assert above == pytest.approx([-178.8 * UT, 0, 0], abs=0.2 * UT)
    # Before the magnet the field goes down into its south, beyond it up out of its north.
    before, beyond = sample_at(simulated, -0.258)[4], sample_at(simulated, -0.242)[4]
    assert before[2] < -50 * UT
    assert beyond[2] > 50 * UT
    # Beside it the field runs back along it too: no more than that, by symmetry.
    right, left = sample_at(simulated, -0.25)[[3, 5]]
    assert right == pytest.approx(left, abs=0.1 * UT)
    assert right[0] < -5 * UT
    assert right[1:] == pytest.approx([0, 0], abs=0.1 * UT)


def test_orientation_two_of_eight_points_to_the_right() -> None:
    simulated = over_v1(symbol=2)
    right, above, left = sample_at(simulated, -0.25)[3:6]
    assert above == pytest.approx([0, 178.8 * UT, 0], abs=0.2 * UT)
    # Out of its north on the right, into its south on the left.
    assert right[2] > 10 * UT
    assert left[2] == pytest.approx(-right[2], abs=0.1 * UT)


def test_a_rotated_array_measures_in_its_own_axes() -> None:
    """Across the tag, towards its left: a north ahead of the tag is on the array's right."""
    layout = TagLayout(((0, 0), (0, 1), (1, 1)), (0, 0, 0))
    route = (codec.id_of(WIDE_SPACING, layout),)
    # The array passes v1 and v4, 0.25 m behind the tag's middle: to the left, going to +y.
    options = replace(PLAIN, route=route, heading_rad=math.pi / 2, lateral_m=0.25)
    simulated = simulate(WIDE_SPACING, options)
    assert heading_from_quaternion(simulated.truth.quaternion) == pytest.approx(math.pi / 2)
    assert simulated.truth.position[:, 0] == pytest.approx(-0.25)
    right, above, left = sample_at(simulated, 0.25, axis=1)[3:6]
    assert above == pytest.approx([0, 178.8 * UT, 0], abs=0.2 * UT)
    assert right[2] > 10 * UT
    assert left[2] < -10 * UT


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_the_earth_field_rotates_relative_to_the_array(heading: float) -> None:
    options = replace(
        PLAIN, earth_t=48 * UT, dip_rad=1.1, north_rad=0.4, heading_rad=heading, crab_rad=0.2
    )
    read = simulate(NO_FIELD, options).samples.field_t
    level, rotated = 48 * math.cos(1.1), 0.4 - heading - 0.2
    expected = [level * math.cos(rotated), level * math.sin(rotated), -48 * math.sin(1.1)]
    assert read / UT == pytest.approx(np.broadcast_to(expected, read.shape), abs=1e-9)


@pytest.mark.slow
def test_each_axis_is_measured_at_its_own_time() -> None:
    """Delays of whole frames, so that shifting the samples undoes them."""
    late = replace(EXACT, delay_s=np.array([0.003, 0.0, -0.002]))
    driven = replace(PLAIN, speed_wobble=0.3, acceleration_mps2=0.2, seed=2)
    # 1 kHz is too quick for such delays; every fifth sample of it is not.
    fine = simulate(None, replace(driven, rate_hz=1000.0))
    skewed = simulate(None, replace(driven, rate_hz=150.0, array=late))
    # The first sample is taken when its earliest axis is.
    assert stamped(skewed)[0] == pytest.approx(0.002)
    moved = 0.0
    for axis, delay_s in enumerate(late.delay_s):
        times = stamped(skewed) + delay_s
        inside = times < stamped(fine)[-1]
        for sensor in range(9):
            there = fine.samples.field_t[:, sensor, axis]
            expected = np.interp(times[inside], stamped(fine), there)
            here = skewed.samples.field_t[inside, sensor, axis]
            assert here == pytest.approx(expected, abs=0.05 * UT)
            plain = np.interp(stamped(skewed)[inside], stamped(fine), there)
            if delay_s:
                moved = max(moved, float(np.abs(here - plain).max()))
    assert moved > 3 * UT


@pytest.mark.slow
def test_the_published_run_resembles_its_simulation(data: Path) -> None:
    """Axes, signs and orientations against the real array over the real tag."""
    with open(data / "polaris" / "default" / "RawData_1.csv", newline="") as file:
        rows = [
            [ast.literal_eval(cell) for cell in row[2:11]] for row in list(csv.reader(file))[1:]
        ]
    raw = np.array(rows)
    real = -raw[..., [1, 0, 2]]
    real = (real - real[:150].mean(axis=0))[195:275]
    tags = Tags(codec="polaris-released", clearance_m=0.0116)

    def likeness(route: int = 262143, lateral: float = -0.017, heading: float = 0.0) -> float:
        options = replace(
            PLAIN,
            rate_hz=40.0,
            speed_mps=0.105,
            run_up_m=0.3,
            route=(route,),
            lateral_m=lateral,
            heading_rad=heading,
        )
        field = simulate(tags, options).samples.field_t
        windows = np.lib.stride_tricks.sliding_window_view(field, len(real), axis=0)
        scores = [np.corrcoef(w.transpose(2, 0, 1).ravel(), real.ravel())[0, 1] for w in windows]
        return float(max(scores))

    assert likeness() > 0.85
    assert likeness(heading=math.pi) < 0.5
    assert likeness(lateral=0.017) < 0.5
    rotated = codec.id_of(tags, TagLayout(codec.layout_of(tags, 262143).cells, (4,) * 5))
    assert likeness(rotated) < 0.5


# ---- the sensors


def test_counts_are_whole_and_nearest() -> None:
    quantum = np.array([0.15, 0.3, 0.242]) * UT
    exact = simulate(None, replace(PLAIN, offset_t=20 * UT)).samples.field_t
    array = replace(EXACT, quantum_t=quantum)
    counted = simulate(None, replace(PLAIN, array=array, offset_t=20 * UT)).samples.field_t
    assert counted / quantum == pytest.approx(np.rint(counted / quantum), abs=1e-6)
    error = np.abs(counted - exact) / quantum
    assert error.max() <= 0.5 + 1e-9
    assert error.mean() == pytest.approx(0.25, abs=0.01)


def test_noise_is_white_and_of_its_size_and_offsets_stay() -> None:
    array = replace(EXACT, noise_t=np.array([0.5, 1.0, 2.0]) * UT)
    options = replace(PLAIN, rate_hz=500.0, offset_t=15 * UT)
    quiet = simulate(NO_FIELD, options).samples.field_t
    noise = simulate(NO_FIELD, replace(options, array=array)).samples.field_t - quiet
    assert noise.std(axis=(0, 1)) / UT == pytest.approx([0.5, 1.0, 2.0], rel=0.03)
    unit = noise / noise.std(axis=0)
    assert np.abs((unit[1:] * unit[:-1]).mean(axis=0)).max() < 0.15
    assert np.abs((unit[:, 1:] * unit[:, :-1]).mean(axis=0)).max() < 0.15
    assert (quiet == quiet[0]).all()
    assert quiet[0].std() == pytest.approx(15 * UT, rel=0.5)


def test_offsets_have_their_size_and_drift_wanders() -> None:
    many = replace(EXACT, position_m=bar(400, 0.001))
    still = np.zeros((201, 400, 3))
    read, _ = measure(still, many, 100.0, SensorFaults(offset_t=15 * UT, drift_t=0.2 * UT), 1)
    assert read[0].std() == pytest.approx(15 * UT, rel=0.06)
    # A random walk: by sqrt(2) more after two seconds than after one.
    assert (read[100] - read[0]).std() == pytest.approx(0.2 * UT, rel=0.06)
    assert (read[200] - read[0]).std() == pytest.approx(0.2 * math.sqrt(2) * UT, rel=0.06)


def test_saturated_readings_are_missing_or_clipped_and_counted() -> None:
    array = replace(EXACT, range_t=np.full(3, 100 * UT))
    exact = simulate(None, PLAIN)
    beyond = np.abs(exact.samples.field_t) > 100 * UT
    assert 0 < beyond.sum() < beyond.size / 10
    missing = simulate(None, replace(PLAIN, array=array))
    assert missing.saturated == beyond.sum()
    assert np.array_equal(np.isnan(missing.samples.field_t), beyond)
    clipped = simulate(None, replace(PLAIN, array=array, clipped=True))
    assert clipped.saturated == beyond.sum()
    assert np.array_equal(
        clipped.samples.field_t, np.clip(exact.samples.field_t, -100 * UT, 100 * UT)
    )
    assert exact.saturated == 0


def test_dead_sensors_give_nothing_and_stuck_ones_nothing_new() -> None:
    whole = simulate(None, PLAIN).samples.field_t
    read = simulate(None, replace(PLAIN, dead=(4,), stuck=(0, 7))).samples.field_t
    assert np.isnan(read[:, 4]).all()
    assert (read[:, [0, 7]] == whole[0, [0, 7]]).all()
    others = [1, 2, 3, 5, 6, 8]
    assert np.array_equal(read[:, others], whole[:, others])


def test_lost_frames_leave_gaps_in_time_and_the_rest_as_it_was() -> None:
    whole, torn = (simulate(None, replace(PLAIN, lost=fraction)) for fraction in (0.0, 0.1))
    assert whole.lost == 0
    assert torn.lost == round(0.1 * len(whole.samples))
    assert len(torn.samples) == len(whole.samples) - torn.lost
    kept = np.isin(whole.samples.time_ns, torn.samples.time_ns)
    assert kept.sum() == len(torn.samples)
    assert kept[[0, -1]].all()
    assert np.array_equal(torn.samples.field_t, whole.samples.field_t[kept])
    assert np.array_equal(torn.truth.time_ns, whole.truth.time_ns)


def test_the_usual_bar_converts_for_as_long_as_the_rate_allows() -> None:
    paper, mini = usual_bar(), usual_bar(3, 0.008, 17.0, None)
    assert paper.position_m[[0, 8], 1] == pytest.approx([-0.08, 0.08])
    assert paper.noise_t == pytest.approx([0.5 * UT] * 3)
    # Its X, Y, Z lie along -y, -x and -z of the bar, and are converted in that order.
    assert paper.delay_s[1] < paper.delay_s[0] < paper.delay_s[2]
    assert np.ptp(paper.delay_s) < 0.01
    assert np.ptp(mini.delay_s) > 3 * np.ptp(paper.delay_s)
    assert mini.noise_t == pytest.approx(np.array([0.89, 0.86, 1.24]) * UT)
    assert usual_bar(gain=5, resolution=1).quantum_t / UT == pytest.approx([0.5, 0.5, 0.806])
    with pytest.raises(InputError, match="5000 Hz"):
        usual_bar(rate_hz=5000.0)


# ---- the drive


def test_a_pass_goes_straight_over_the_tag_at_its_heading() -> None:
    options = replace(PLAIN, heading_rad=2.0, lateral_m=0.015, speed_mps=0.2, run_up_m=0.1)
    simulated = simulate(None, options)
    truth = simulated.truth
    assert truth.frame == "tag-0"
    assert truth.device == simulated.samples.device == "bar"
    ahead, left = [math.cos(2.0), math.sin(2.0)], [-math.sin(2.0), math.cos(2.0)]
    path = truth.position[:, :2] @ ahead
    assert truth.position[:, :2] @ left == pytest.approx(0.015)
    assert path[0] == pytest.approx(-0.1 - 0.04 * math.sqrt(2))
    assert path[-1] == pytest.approx(-path[0], abs=0.002)
    assert np.diff(path) == pytest.approx(0.2 / 100, rel=1e-6)
    assert truth.position[:, 2] == pytest.approx(0.01)
    assert heading_from_quaternion(truth.quaternion) == pytest.approx(2.0)
    assert np.diff(truth.time_ns) == pytest.approx(1e7, abs=1)
    (crossing,) = simulated.crossings
    assert crossing.tag_id == 0
    assert (crossing.time_ns - SESSION_START_NS) * 1e-9 == pytest.approx(-path[0] / 0.2, abs=1e-6)
    assert crossing.y_m == pytest.approx(-0.015)
    assert crossing.heading_rad == pytest.approx(-2.0)


def test_the_car_starts_from_rest_as_configured() -> None:
    options = replace(PLAIN, rest_s=0.5, acceleration_mps2=0.4, speed_mps=0.2)
    simulated = simulate(None, options)
    time_s, path = stamped(simulated), simulated.truth.position[:, 0]
    path = path - path[0]
    driven = np.maximum(time_s - 0.5, 0)
    # 0.2 m/s are reached after 0.5 s and 50 mm.
    expected = np.where(driven < 0.5, 0.2 * driven**2, 0.05 + 0.2 * (driven - 0.5))
    assert path == pytest.approx(expected, abs=1e-6)
    jump = simulate(None, replace(options, acceleration_mps2=None))
    path = jump.truth.position[:, 0] - jump.truth.position[0, 0]
    assert path == pytest.approx(0.2 * np.maximum(stamped(jump) - 0.5, 0), abs=2e-5)


def test_the_wobble_stays_within_its_fraction_and_approaches_it() -> None:
    speeds, heights, headings = [], [], []
    for seed in range(20):
        options = replace(
            PLAIN,
            speed_wobble=0.3,
            height_wobble_m=2e-3,
            yaw_wobble_rad=0.1,
            crab_rad=0.5,
            rate_hz=50.0,
            seed=seed,
        )
        truth = simulate(NO_FIELD, options).truth
        assert truth.position[:, 1] == pytest.approx(0, abs=1e-12)
        speeds.append(np.diff(truth.position[:, 0]) * 50)
        heights.append(truth.position[:, 2])
        headings.append(heading_from_quaternion(truth.quaternion))
    for values, middle, swing in (
        (speeds, 0.1, 0.03),
        (heights, 0.01, 2e-3),
        (headings, 0.5, 0.1),
    ):
        off = (np.concatenate(values) - middle) / swing
        assert np.abs(off).max() <= 1 + 1e-9
        assert off.max() > 0.8
        assert off.min() < -0.8
        # Smooth: nothing jumps from one frame to the next.
        assert max(np.abs(np.diff((v - middle) / swing)).max() for v in values) < 0.5


@pytest.mark.slow
def test_a_tour_crosses_the_tags_of_a_site_in_their_order() -> None:
    tags = Tags(
        site={
            5: PlanarPose(0.0, 0.0, 0.0),
            9: PlanarPose(0.6, 0.0, 1.0),
            77: PlanarPose(0.6, 0.6, -2.0),
            8: PlanarPose(5.0, 5.0, 0.0),
        }
    )
    simulated = simulate(tags, replace(PLAIN, route=(5, 9, 77, 5)))
    assert simulated.truth.frame == "site"
    assert [crossing.tag_id for crossing in simulated.crossings] == [5, 9, 77, 5]
    position, heading = (
        simulated.truth.position,
        heading_from_quaternion(simulated.truth.quaternion),
    )
    times = simulated.truth.time_ns
    for crossing in simulated.crossings:
        at = tags.site[crossing.tag_id]
        n = int(np.argmin(np.abs(times - crossing.time_ns)))
        assert position[n, :2] == pytest.approx([at.x_m, at.y_m], abs=1e-3)
        rotated = math.remainder(at.heading_rad - heading[n] - crossing.heading_rad, math.tau)
        assert rotated == pytest.approx(0, abs=1e-9)
        assert crossing.y_m == pytest.approx(0, abs=1e-9)
        # Straight on while any of it is near.
        near = np.linalg.norm(position[:, :2] - [at.x_m, at.y_m], axis=1) < 0.06
        near &= np.abs(times - crossing.time_ns) < 2_000_000_000
        assert np.ptp(np.unwrap(heading[near])) < 1e-9
    # The way points where it goes, at one speed.
    step = np.diff(position[:, :2], axis=0)
    assert np.linalg.norm(step, axis=1) == pytest.approx(1e-3, rel=2e-3)
    ahead = np.exp(1j * heading)
    along = np.angle((step @ [1, 1j]) / (ahead[1:] + ahead[:-1]))
    assert np.abs(along).max() < 5e-3


@pytest.mark.slow
def test_tags_in_a_row_are_crossed_on_one_straight_line() -> None:
    tags = Tags(site={k: PlanarPose(0.3 * k, 0.1 * k, 0.2 * k) for k in range(1, 4)})
    simulated = simulate(tags, PLAIN)
    assert [crossing.tag_id for crossing in simulated.crossings] == [1, 2, 3]
    x, y, _ = simulated.truth.position.T
    assert y == pytest.approx(x / 3, abs=1e-9)
    assert len(simulated.magnets) == sum(len(codec.layout_of(tags, k).cells) for k in (1, 2, 3))
    assert simulated.magnets.tag_id[0] == 1
    # One of them alone, in the middle of the others.
    (crossing,) = simulate(tags, replace(PLAIN, route=(2,), heading_rad=1.4)).crossings
    assert crossing.tag_id == 2
    assert crossing.heading_rad == pytest.approx(-1.4)


@pytest.mark.parametrize(("lateral", "whole"), [(0.0, True), (0.07, False), (0.13, None)])
def test_a_tag_is_crossed_whole_in_part_or_not(lateral: float, whole: bool | None) -> None:
    crossings = simulate(NO_FIELD, replace(PLAIN, lateral_m=lateral)).crossings
    assert [crossing.whole for crossing in crossings] == ([] if whole is None else [whole])


# ---- tags, debris, motors, odometry


@pytest.mark.slow
def test_hand_built_tags_are_reproducible_and_in_the_truth() -> None:
    wrong = {"build_angle_rad": 0.1, "build_place_m": 5e-4, "build_strength": 0.05}
    tags = Tags(site={k: PlanarPose(0.3 * k, 0.0, 0.3) for k in range(40)})
    plain = replace(PLAIN, rate_hz=20.0)
    one = simulate(tags, replace(plain, route=(0,), **wrong))  # type: ignore[arg-type]
    two = simulate(tags, replace(plain, route=(3,), seed=9, **wrong))  # type: ignore[arg-type]
    other = simulate(tags, replace(plain, route=(0,), build_seed=1, **wrong))  # type: ignore[arg-type]
    assert np.array_equal(one.magnets.angle_rad, two.magnets.angle_rad)
    assert np.array_equal(one.magnets.moment_am2, two.magnets.moment_am2)
    assert not np.array_equal(one.magnets.angle_rad, other.magnets.angle_rad)
    angle = np.concatenate([built.angle_rad for built in one.built.values()])
    position = np.concatenate([built.offset_m for built in one.built.values()])
    assert angle.std() == pytest.approx(0.1, rel=0.2)
    assert position.std() == pytest.approx(5e-4, rel=0.15)
    assert one.magnets.moment_am2.std() == pytest.approx(0.05 * Magnet().moment, rel=0.2)
    # A tag that is built as told, and well, is the same tag.
    known = replace(tags, built=one.built)
    again = simulate(known, replace(plain, route=(0,)))
    assert again.magnets.position_m == pytest.approx(one.magnets.position_m)
    apart = np.exp(1j * (again.magnets.angle_rad - one.magnets.angle_rad))
    assert apart == pytest.approx(1.0)
    assert one.tags is tags


def test_the_build_shows_in_the_field() -> None:
    """Magnet v1 turned by 30 degrees and moved by 2 mm, by what the tag's artifact says."""
    layout = TagLayout(((0, 0), (0, 1), (1, 1)), (0, 0, 0))
    tag_id = codec.id_of(WIDE_SPACING, layout)
    built = AsBuiltTag(np.array([[2e-3, 0.0], [0, 0], [0, 0]]), np.radians([30.0, 0, 0]))
    tags = replace(WIDE_SPACING, built={tag_id: built})
    simulated = simulate(tags, replace(PLAIN, route=(tag_id,), lateral_m=0.25))
    above = sample_at(simulated, -0.248)[4] / UT
    rotated = [-178.8 * math.cos(math.pi / 6), -178.8 * math.sin(math.pi / 6), 0]
    assert above == pytest.approx(rotated, abs=0.3)


def test_soft_iron_takes_three_times_the_field_it_is_in() -> None:
    nothing = Discs(Magnet(), (), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    low, high = np.array([-0.1, 0.2]), np.array([0.3, 0.4])
    earth = np.array([20e-6, -10e-6, -40e-6])
    rng = np.random.default_rng(3)
    soft = scatter_debris(nothing, low, high, 2000, 2e-3, 0.0, earth, rng)
    assert (soft.position_m[:, :2] >= low).all()
    assert (soft.position_m[:, :2] <= high).all()
    # A bit lies on the magnets' upper faces: its height tells its radius.
    radius = soft.position_m[:, 2] - 0.25e-3
    assert radius.max() == pytest.approx(1e-3, rel=0.01)
    assert radius.min() == pytest.approx(0.3e-3, rel=0.01)
    mu0 = 4e-7 * math.pi
    volume = 4 / 3 * math.pi * radius**3
    assert soft.moment_am2 == pytest.approx(3 * volume[:, None] * earth / mu0, rel=1e-6)
    hard = scatter_debris(nothing, low, high, 2000, 2e-3, 0.5, earth, np.random.default_rng(3))
    assert np.array_equal(hard.position_m, soft.position_m)
    kept = np.linalg.norm(hard.moment_am2 - soft.moment_am2, axis=1)
    assert (kept > 0).mean() == pytest.approx(0.5, abs=0.05)
    assert (kept / volume).max() == pytest.approx(20e3, rel=0.01)
    # In a field of a tesla and more, iron has all the magnetisation there is.
    full = scatter_debris(nothing, low, high, 50, 2e-3, 0.0, np.array([0, 0, 3.0]), rng)
    volume = 4 / 3 * math.pi * (full.position_m[:, 2] - 0.25e-3) ** 3
    assert full.moment_am2[:, 2] / volume == pytest.approx(1.7e6)


def test_iron_near_a_magnet_is_magnetised_by_it() -> None:
    disc = Discs(Magnet(), (1,), np.zeros((1, 2)), np.zeros(1), np.ones(1))
    low, high = np.array([-0.01, -0.01]), np.array([0.01, 0.01])
    bits = scatter_debris(disc, low, high, 200, 1e-3, 0.0, np.zeros(3), np.random.default_rng(0))
    volume = 4 / 3 * math.pi * (bits.position_m[:, 2] - 0.25e-3) ** 3
    induced = 3 * volume[:, None] * disc_field(disc, bits.position_m) / (4e-7 * math.pi)
    unsaturated = np.linalg.norm(induced, axis=1) < 1.7e6 * volume
    assert unsaturated.mean() > 0.9
    assert bits.moment_am2[unsaturated] == pytest.approx(induced[unsaturated], rel=1e-6)


def test_debris_on_the_tag_acts_as_dipoles() -> None:
    options = replace(PLAIN, heading_rad=0.5, earth_t=50 * UT)
    clean = simulate(None, options)
    dirty = simulate(None, replace(options, debris=25, seed=3))
    bits = dirty.debris
    assert len(bits) == 25
    assert np.abs(bits.position_m[:, :2]).max() < 0.08
    n = int(np.argmax(np.abs(dirty.samples.field_t - clean.samples.field_t).max(axis=(1, 2))))
    rotation = Rotation.from_quat(dirty.truth.quaternion[n])
    total = sum(
        magpylib.misc.Dipole(moment=moment, position=position).getB(
            magpylib.Sensor(
                position=dirty.truth.position[n],
                orientation=rotation,
                pixel=EXACT.position_m.tolist(),
            )
        )
        for moment, position in zip(bits.moment_am2, bits.position_m, strict=True)
    )
    felt = dirty.samples.field_t[n] - clean.samples.field_t[n]
    assert np.abs(felt).max() > 0.5 * UT
    assert felt == pytest.approx(total, abs=20e-9)


def test_motors_are_felt_while_they_drive_and_more_at_one_end() -> None:
    options = replace(
        PLAIN, motor_t=8.5 * UT, motor_gradient=2.0, rest_s=1.0, acceleration_mps2=0.1, seed=5
    )
    simulated = simulate(NO_FIELD, options)
    felt, time_s = np.linalg.norm(simulated.samples.field_t, axis=2) / UT, stamped(simulated)
    assert (felt[time_s < 1.0] == 0).all()
    cruising = felt[time_s > 2.2]
    assert cruising[:, 4] == pytest.approx(8.5)
    ends = sorted(cruising[0, [0, 8]])
    assert ends == pytest.approx([8.5 * (1 - 2.0 * 0.08), 8.5 * (1 + 2.0 * 0.08)])
    # While it gains speed, the throttle is above what that speed takes.
    early = (time_s > 1.3) & (time_s < 1.9)
    assert (felt[early, 4] > 8.5 * (time_s[early] - 1.0)).all()
    wobbling = simulate(NO_FIELD, replace(options, speed_wobble=0.3, rest_s=0.0))
    speed = np.diff(wobbling.truth.position[:, 0])
    felt = np.linalg.norm(wobbling.samples.field_t[1:, 4], axis=-1)
    assert np.corrcoef(speed, felt)[0, 1] > 0.7
    # One direction all the time.
    path = simulated.samples.field_t[time_s > 1.2]
    path = path / np.linalg.norm(path, axis=2, keepdims=True)
    assert path == pytest.approx(np.broadcast_to(path[0, 0], path.shape))


@pytest.mark.slow
def test_odometry_has_scale_and_heading_errors() -> None:
    tags = Tags(site={1: PlanarPose(0.0, 0.0, 0.0), 2: PlanarPose(1.0, 0.5, 0.0)})
    options = replace(PLAIN, odometry=True, rate_hz=20.0)
    assert simulate(tags, replace(options, odometry=False)).odometry is None
    right = simulate(tags, replace(options, odometry_scale=0.0, odometry_turn_rad=0.0))
    assert right.odometry is not None
    assert right.odometry.frame == "odom"
    truth = right.truth
    start = Rotation.from_quat(truth.quaternion[0]).inv()
    moved = start.apply(truth.position - truth.position[0])
    assert right.odometry.position == pytest.approx(moved, abs=1e-12)
    assert heading_from_quaternion(right.odometry.quaternion)[0] == pytest.approx(0)
    rotated = heading_from_quaternion(right.odometry.quaternion) - heading_from_quaternion(
        truth.quaternion
    )
    assert np.exp(1j * rotated) == pytest.approx(np.exp(1j * rotated[0]))
    long = simulate(tags, replace(options, odometry_scale=0.03, odometry_turn_rad=0.0))
    assert long.odometry is not None
    assert long.odometry.position == pytest.approx(1.03 * moved, abs=1e-12)
    path = np.linalg.norm(np.diff(moved, axis=0), axis=1).sum()
    assert long.odometry.sigma[-1, 0] == pytest.approx(0.03 * path)
    ends = []
    for seed in range(60):
        away = simulate(NO_FIELD, replace(options, odometry_turn_rad=0.05, seed=seed)).odometry
        assert away is not None
        ends.append(heading_from_quaternion(away.quaternion)[-1] / away.sigma[-1, 5])
    assert np.std(ends) == pytest.approx(1.0, abs=0.3)


# ---- sessions


@pytest.mark.slow
def test_the_same_options_give_the_same_session() -> None:
    options = SimulationOptions(
        drift_t=1e-7,
        speed_wobble=0.3,
        debris=10,
        motor_t=8e-6,
        lost=0.02,
        build_angle_rad=0.1,
        odometry=True,
        seed=3,
    )
    one, two = simulate(None, options), simulate(None, options)
    assert np.array_equal(one.samples.field_t, two.samples.field_t)
    assert np.array_equal(one.samples.time_ns, two.samples.time_ns)
    assert np.array_equal(one.truth.position, two.truth.position)
    assert one.crossings == two.crossings
    assert one.odometry is not None
    assert two.odometry is not None
    assert np.array_equal(one.odometry.position, two.odometry.position)
    other = simulate(None, replace(options, seed=4))
    assert not np.array_equal(one.samples.field_t[:200], other.samples.field_t[:200])
    # More noise, and nothing else: the drive, the offsets and the debris stay.
    loud = simulate(None, replace(options, array=usual_bar(noise_t=5e-6)))
    assert np.array_equal(loud.truth.position, one.truth.position)
    assert np.array_equal(loud.samples.time_ns, one.samples.time_ns)
    apart = (loud.samples.field_t - one.samples.field_t).mean(axis=0)
    assert np.abs(apart).max() < 4 * 4.5e-6 / math.sqrt(len(one.samples))


def test_the_paper_and_its_miniature_car() -> None:
    assert len(simulate().samples.array) == 9
    mini = CARS["mini"]
    options = SimulationOptions(
        array=usual_bar(mini.sensors, mini.spacing_m, mini.rate_hz),
        rate_hz=mini.rate_hz,
        speed_mps=mini.speed_mps,
        route=(77,),
    )
    simulated = simulate(mini.tags, options)
    assert simulated.samples.field_t.shape[1:] == (3, 3)
    assert codec.capacity(mini.tags) == 2**9
    step = np.diff(simulated.truth.position[:, 0])
    assert step == pytest.approx(5e-3 / 17, rel=1e-4)
    # 359 uT over a magnet of 1 x 0.5 mm with 1.45 T at 5 mm: magpylib 6.1.0.
    first = np.median(simulated.samples.field_t, axis=0)
    assert np.abs(simulated.samples.field_t - first).max() == pytest.approx(359 * UT, rel=0.15)
    assert simulated.crossings[0].whole


@pytest.mark.parametrize(
    "wrong",
    [
        {"array": replace(EXACT, noise_t=np.full(3, np.nan))},
        {"array": replace(EXACT, position_m=np.zeros((0, 3)))},
        {"rate_hz": 0.0},
        {"rate_hz": 300.0},
        {"route": (3, 3)},
        {"heading_rad": math.nan},
        {"lateral_m": math.inf},
        {"run_up_m": 0.0},
        {"speed_mps": 0.0},
        {"rest_s": -1.0},
        {"acceleration_mps2": 0.0},
        {"speed_wobble": 1.0},
        {"crab_rad": math.nan},
        {"clearance_m": 0.0},
        {"height_wobble_m": -1e-3},
        {"build_angle_rad": -0.1},
        {"build_place_m": math.nan},
        {"build_strength": 0.5},
        {"build_seed": -1},
        {"earth_t": -1e-6},
        {"offset_t": -1e-6},
        {"drift_t": math.nan},
        {"dead": (9,)},
        {"stuck": (-1,)},
        {"lost": 1.0},
        {"debris": -1},
        {"debris_size_m": 0.0},
        {"debris_magnetised": 1.1},
        {"motor_t": -1e-6},
        {"odometry_scale": -1.0},
        {"odometry_turn_rad": -1.0},
        {"seed": -1},
    ],
    ids=lambda wrong: "-".join(map(str, wrong)),
)
def test_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        SimulationOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("tags", "options", "said"),
    [
        (Tags(), {"route": (1, 2)}, "no site"),
        (Tags(site={4: PlanarPose(0, 0, 0)}), {"route": (5,)}, "not on the site"),
        (Tags(ids=(3, 8)), {"route": (4,)}, "not of the family"),
        (Tags(), {"route": (327_680,)}, "327680"),
        (Tags(), {"clearance_m": 2e-4}, "magnet"),
        (Tags(), {"clearance_m": 2e-3, "debris": 3}, "debris"),
        (Tags(), {"clearance_m": 0.01, "height_wobble_m": 0.01}, "magnet"),
        (Tags(), {"speed_mps": 1e-6}, "samples"),
        (Tags(), {"acceleration_mps2": 1e-12}, "samples"),
        (Tags(), {"speed_mps": 1e3}, "frames"),
        (Tags(), {"run_up_m": 1e12}, "simulation of .* s$"),
    ],
)
def test_settings_that_contradict_the_tags_are_refused(
    tags: Tags, options: dict[str, object], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        simulate(tags, SimulationOptions(**options))  # type: ignore[arg-type]


def test_without_a_route_the_first_of_the_family_is_crossed() -> None:
    assert simulate(Tags(ids=(300, 8)), PLAIN).crossings[0].tag_id == 300


def test_the_first_and_the_last_frame_always_arrive() -> None:
    for seed in range(5):
        is_received = received_frames(10, 0.9, seed)
        assert is_received.tolist() == [True, *[False] * 8, True]
    assert np.count_nonzero(~received_frames(100, 0.25, 0)) == 25
