"""Simulated sweeps against an independent implementation of the physics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from locatk.core import lighthouse
from locatk.core.errors import InputError
from locatk.core.evaluation import evaluate
from locatk.core.geometry import heading_from_quaternion
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    IDEAL_CALIBRATION,
    Calibration,
    predict_angles,
)
from locatk.core.lighthouse.channels import channel_of, period_counts, period_ticks
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.scene import Station
from locatk.core.lighthouse.simulation.optics import SimulatedStation
from locatk.core.lighthouse.simulation.session import (
    FLOOR_MARKERS_M,
    RAISED_MARKERS_M,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.simulation import SESSION_START_NS

Array = NDArray[np.float64]
NOISELESS = SimulationOptions(noise_rad=0.0, seed=4)
COUNT_RAD = 2 * np.pi / period_counts(1)
"""One LFSR step of channel 1 as an angle."""


@dataclass
class Rotations:
    """Complete rotations of one station that one robot observed, and the station's rotor."""

    time_s: Array  # (n, 2) since the start of the session
    count: Array  # (n, 2)
    row: NDArray[np.int64]  # (n, 2) of the sweeps
    zero_s: float
    period_s: float


def find_rotations(session: SimulatedSession, device: int, channel: int) -> Rotations:
    """Recover rotations from times and counts alone."""
    s = session.sweeps
    rows = np.flatnonzero((s.device == device) & (s.channel == channel))
    time_s, count = (s.time_ns[rows] - SESSION_START_NS) * 1e-9, s.count[rows]
    nominal = float(period_ticks(channel)) / 48e6
    period_s = nominal
    for _ in range(3):  # counts are in steps of the station's own clock, estimated here
        start = time_s - count / float(period_counts(channel)) * period_s
        number = np.cumsum(np.rint(np.r_[0.0, np.diff(start)] / nominal))
        period_s, zero_s = np.polyfit(number, start, 1)
    new = np.r_[True, np.diff(number) > 0.5]
    first = np.flatnonzero(new & np.r_[~new[1:], False])
    pairs = np.stack([first, first + 1], axis=1)
    return Rotations(time_s[pairs], count[pairs], rows[pairs], float(zero_s), float(period_s))


def fit_path(session: SimulatedSession, device: int) -> tuple[Array, CubicSpline]:
    """Return the times of the ground truth of a robot, and a spline through its positions."""
    truth = session.truth[device]
    time_s = (truth.time_ns - SESSION_START_NS) * 1e-9
    return time_s, CubicSpline(time_s, truth.position)


# ---- physics


def plane_side(time_s: Array, points: Array, plane: int, rotations: Rotations) -> Array:
    """Return the signed distance of points (n, 3), in a station's axes, from a rotating plane.

    The plane contains the forward axis, is tilted by 30 degrees about it, and rotates about the
    vertical axis. It points forward after a third (two thirds) of a rotation.
    """
    tilt = np.radians([30.0, -30.0])[plane]
    angle = 2 * np.pi * ((time_s - rotations.zero_s) / rotations.period_s - (1 + plane) / 3)
    normal = np.stack(
        [
            -np.sin(angle) * np.cos(tilt),
            np.cos(angle) * np.cos(tilt),
            np.full_like(angle, -np.sin(tilt)),
        ],
        axis=-1,
    )
    return np.sum(normal * points, axis=-1)


def test_ideal_planes_cross_moving_robots_at_the_times_of_their_sweeps() -> None:
    """By brute force: the plane is stepped through time until the robot changes sides."""
    session = simulate(replace(NOISELESS, robots=2, calibration="ideal"))
    station = session.true_scene.stations[1]
    rotations = find_rotations(session, 1, 2)
    _, path = fit_path(session, 1)
    assert len(rotations.time_s) > 250
    for row in range(0, len(rotations.time_s), 10):
        for plane in (0, 1):
            about = rotations.time_s[row, plane]
            fine = about + np.arange(-2e-4, 2e-4, 1e-7)
            local = (path(fine) - station.position) @ station.rotation
            side = plane_side(fine, local, plane, rotations)
            crossed = np.flatnonzero(np.sign(side[1:]) != np.sign(side[:-1]))
            assert len(crossed) == 1
            # The rotor's zero was found from whole counts: 0.17 us each.
            assert fine[crossed[0]] == pytest.approx(about, abs=2e-7)


def reproject(point: Array, unit: Array, sweep: int) -> float:
    """``survive_reproject_gen2.c`` of libsurvive, line by line, in its own axes.

    There x points left-right, y up and -z ahead.
    """
    _, tilts, curves, gibmags, gibphases, ogeemags, ogeephases = (
        (0.0, unit[0]) if k == 0 else unit[2 * k - 1 : 2 * k + 1] for k in range(7)
    )
    x, y, z = -point[1], point[2], -point[0]
    b = np.arctan2(-z, x)
    y_deg = tilts[sweep] + (-1 if sweep else 1) * np.pi / 6
    sin_arg = np.tan(y_deg) * y / np.hypot(x, z)
    sin_part = ogeemags[sweep] * np.sin(b - np.arcsin(sin_arg) + ogeephases[sweep])
    norm = np.sqrt(x * x + y * y + z * z)
    asin_out = np.arcsin(y / norm / np.cos(y_deg))
    modulus, acc = 0.0, 0.0
    for f in (-8.0108022e-06, 0.0028679863, 5.3685255000000001e-06, 0.0076069798000000001, 0, 0):
        # Horner with its derivative
        acc = acc * asin_out + modulus
        modulus = modulus * asin_out + f
    bend = sin_part + curves[sweep]
    asin_arg2 = sin_arg + modulus * bend / (np.cos(y_deg) - acc * bend * np.sin(y_deg))
    angle = b - np.arcsin(asin_arg2)
    phase = (0.0, unit[0])[sweep]
    return float(angle + gibmags[sweep] * np.sin(angle + gibphases[sweep]) - phase - np.pi / 2)


def test_factory_planes_cross_moving_robots_at_the_times_of_their_sweeps() -> None:
    session = simulate(replace(NOISELESS, planar=False, robots=2, stations=3))
    station = session.true_scene.stations[2]
    [unit] = [u for u in FACTORY_UNITS if u[1] == station.calibration.sweeps[0, 1]]
    rotations = find_rotations(session, 1, 3)
    _, path = fit_path(session, 1)
    rotor = (
        2
        * np.pi
        * ((rotations.time_s - rotations.zero_s) / rotations.period_s - np.array([1 / 3, 2 / 3]))
    )
    worst = 0.0
    for row in range(0, len(rotations.time_s), 5):
        for plane in (0, 1):
            local = (path(rotations.time_s[row, plane]) - station.position) @ station.rotation
            miss = reproject(local, unit, plane) - rotor[row, plane]
            worst = max(worst, abs(np.angle(np.exp(1j * miss))))
    assert worst < 5e-6  # a tenth of an LFSR step


@pytest.mark.parametrize("calibration", ["units", "generic", "ideal"])
def test_standing_robots_obey_the_forward_model(calibration: str) -> None:
    session = simulate(replace(NOISELESS, calibration=calibration, stations=4))
    for marker in session.scene.markers:
        [visit] = marker.visits
        for station in session.true_scene.stations:
            rotations = find_rotations(session, 0, station.channel)
            still = (rotations.time_s[:, 0] * 1e9 + SESSION_START_NS > visit.start_ns) & (
                rotations.time_s[:, 1] * 1e9 + SESSION_START_NS < visit.end_ns
            )
            assert np.count_nonzero(still) >= 18
            local = (marker.position - station.position) @ station.rotation
            angles = predict_angles(local, station.calibration)
            expected = (angles + np.radians([120.0, 240.0])) / (2 * np.pi)
            expected = expected * float(period_counts(station.channel))
            np.testing.assert_allclose(
                rotations.count[still], expected[None].repeat(still.sum(), 0), atol=0.5 + 1e-6
            )


def test_rotors_rotate_on_their_own_clocks() -> None:
    session = simulate(replace(NOISELESS, stations=16, duration_s=20.0))
    phases, errors = [], []
    for channel in range(1, 17):
        rotations = find_rotations(session, 0, channel)
        start = (
            rotations.time_s - rotations.count / float(period_counts(channel)) * rotations.period_s
        )
        number = np.rint((start - rotations.zero_s) / rotations.period_s)
        rest = start - rotations.zero_s - number * rotations.period_s
        assert np.abs(rest).max() < 1.2e-7  # a count is 1.67e-7 s
        errors.append(rotations.period_s / (float(period_ticks(channel)) / 48e6) - 1)
        phases.append((rotations.zero_s / rotations.period_s) % 1)
    assert np.max(np.abs(errors)) < 25e-6
    assert np.std(errors) > 5e-6
    assert np.std(phases) > 0.15


def test_sweeps_of_a_report_are_spread_in_time() -> None:
    s = simulate(replace(NOISELESS, stations=4)).sweeps
    time_s = (s.time_ns - SESSION_START_NS) * 1e-9
    report = np.r_[True, np.diff(time_s) > 0.05].cumsum()
    spread = [np.ptp(time_s[report == k]) for k in np.unique(report)]
    assert 0.01 < np.median(spread) < 0.03
    assert np.max(spread) < 0.031


def test_noise_is_that_of_the_angle_and_of_whole_counts() -> None:
    sigma = 3e-4
    options = SimulationOptions(noise_rad=sigma, report_hz=40.0, calibration="units", seed=2)
    session = simulate(options)
    deviations = []
    for channel in (1, 2):
        rotations = find_rotations(session, 0, channel)
        for marker in session.scene.markers:
            [visit] = marker.visits
            span = (np.array([visit.start_ns, visit.end_ns]) - SESSION_START_NS) * 1e-9
            still = (rotations.time_s[:, 0] > span[0]) & (rotations.time_s[:, 1] < span[1])
            counts = rotations.count[still]
            deviations.append(counts - counts.mean(axis=0))
    expected = np.hypot(sigma / COUNT_RAD, 1 / np.sqrt(12))
    assert np.std(np.concatenate(deviations)) == pytest.approx(expected, rel=0.06)


# ---- shape


def are_equal(a: Sweeps, b: Sweeps) -> bool:
    names = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
    return a.devices == b.devices and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in names
    )


def test_same_options_same_arrays() -> None:
    options = SimulationOptions(robots=2, occlusion=0.1, outliers=0.05, duration_s=5.0, seed=9)
    first, second = simulate(options), simulate(options)
    assert are_equal(first.sweeps, second.sweeps)
    assert first.sweeps.time_ns.min() >= SESSION_START_NS == 1_767_225_600_000_000_000
    assert all(
        np.array_equal(a.position, b.position)
        for a, b in zip(first.truth, second.truth, strict=True)
    )
    assert not are_equal(first.sweeps, simulate(replace(options, seed=10)).sweeps)


def test_noise_and_faults_do_not_move_robots_or_stations() -> None:
    calm, wild = (
        simulate(NOISELESS),
        simulate(replace(NOISELESS, noise_rad=1e-4, outliers=0.1, occlusion=0.3, labelled=False)),
    )
    np.testing.assert_array_equal(calm.truth[0].position, wild.truth[0].position)
    for a, b in zip(calm.true_scene.stations, wild.true_scene.stations, strict=True):
        np.testing.assert_array_equal(a.position, b.position)


@pytest.mark.slow
@pytest.mark.parametrize("planar", [True, False])
def test_counts_are_whole_and_of_one_rotation(planar: bool) -> None:
    session = simulate(SimulationOptions(robots=3, stations=16, outliers=0.3, planar=planar))
    s = session.sweeps
    assert len(s) > 15_000
    assert np.all(s.count == np.rint(s.count))
    assert np.all((s.count >= 0) & (s.count < period_counts(s.channel)))
    assert np.all(np.diff(s.time_ns) >= 0)
    assert np.all(s.sweep == UNKNOWN)
    assert set(s.channel) == set(range(1, 17))


def test_the_first_plane_has_the_smaller_count_and_the_same_slow_bit() -> None:
    session = simulate(replace(NOISELESS, stations=2))
    s = session.sweeps
    rotations = find_rotations(session, 0, 1)
    assert np.all(rotations.count[:, 0] < rotations.count[:, 1])
    assert np.array_equal(channel_of(s.polynomial), s.channel)
    bits = s.polynomial[rotations.row] & 1
    assert len(bits) > 200
    assert np.array_equal(bits[:, 0], bits[:, 1])
    assert 0.3 < np.mean(bits) < 0.7


def test_without_labels_polynomials_are_unknown_and_nothing_else_changes() -> None:
    known, unknown = simulate(NOISELESS).sweeps, simulate(replace(NOISELESS, labelled=False)).sweeps
    assert np.all(unknown.polynomial == UNKNOWN)
    assert are_equal(unknown, replace(known, polynomial=unknown.polynomial))


@pytest.mark.slow
def test_the_whole_floor_is_in_the_beams() -> None:
    for seed in range(3):
        for planar in (True, False):
            options = SimulationOptions(
                robots=5, stations=6, planar=planar, duration_s=30.0, seed=seed
            )
            session = simulate(options)
            others = session.sweeps.device > 0  # the first is carried for a while
            reports = 4 * 300 * 6
            assert np.count_nonzero(others) / 2 > 0.99 * reports


@pytest.mark.parametrize(
    ("azimuth", "elevation", "received"),
    [(74, 0, True), (76, 0, False), (-74, 0, True), (-76, 0, False), (0, 49, True),
     (0, 51, False), (0, -49, True), (0, -51, False)],
)  # fmt: skip
def test_light_is_received_inside_the_beam(
    azimuth: float, elevation: float, received: bool
) -> None:
    a, e = np.radians([azimuth, elevation])
    point = 2 * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    station = SimulatedStation(
        Station(1, np.zeros(3), np.eye(3), IDEAL_CALIBRATION), 0.0, 0.02, np.zeros(1, np.int64)
    )
    _, count = station.observe(
        np.zeros(1), lambda time: np.broadcast_to(point, (*time.shape, 3)), np.zeros((1, 2))
    )
    assert np.isfinite(count).all() == received
    assert np.isfinite(count).any() == received


def test_photodiodes_receive_only_stations_that_they_face() -> None:
    normal = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    receiver = Receiver(np.array([[0.05, 0.02, 0.0], [-0.05, 0.0, 0.01]]), normal)
    session = simulate(replace(NOISELESS, receiver=receiver, robots=2, stations=3))
    s, truth = session.sweeps, session.truth[1]
    rows = np.flatnonzero(s.device == 1)
    assert set(s.sensor[rows]) == {0, 1}
    nearest = np.searchsorted(truth.time_ns, s.time_ns[rows]).clip(max=len(truth) - 1)
    heading = heading_from_quaternion(truth.quaternion[nearest])
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * normal[s.sensor[rows], :1]
    station = np.stack([x.position for x in session.true_scene.stations])[s.channel[rows] - 1]
    towards = (station - truth.position[nearest])[:, :2]
    facing = np.sum(direction * towards, axis=-1)
    # The photodiodes are up to 5 cm from the robot's position.
    assert facing.min() > -0.06
    # Every station is faced by one of the two.
    assert len(rows) > 0.95 * 2 * 3 * 10 * 30


@pytest.mark.slow
def test_stations_are_mounted_realistically_and_have_real_calibrations() -> None:
    for seed in range(10):
        session = simulate(SimulationOptions(stations=11, duration_s=1.0, seed=seed))
        stations = session.true_scene.stations
        position = np.stack([s.position for s in stations])
        assert np.all(np.abs(np.hypot(position[:, 0], position[:, 1]) - 2.0) <= 0.1)
        assert np.all((position[:, 2] >= 1.5) & (position[:, 2] <= 2.0))
        for s in stations:
            np.testing.assert_allclose(s.rotation @ s.rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(s.rotation) > 0
            toward = -s.position / np.linalg.norm(s.position)
            assert s.rotation[:, 0] @ toward > np.cos(np.radians(6.0))
            assert abs(np.degrees(np.arcsin(s.rotation[2, 1]))) < 4.0
            assert s.calibration.source == "factory"
            assert not np.allclose(s.calibration.sweeps, GENERIC_CALIBRATION.sweeps)
        tilts = {float(s.calibration.sweeps[0, 1]) for s in stations}
        assert len(tilts) == len(set(FACTORY_UNITS[:, 1]))  # no unit twice


def test_the_prior_is_the_mean_of_the_units() -> None:
    """The simulator and the prior interpret the columns of a unit alike."""
    many = simulate(SimulationOptions(stations=11, duration_s=1.0)).true_scene.stations
    mean = np.mean([s.calibration.sweeps[:, :3] for s in many], axis=0)
    np.testing.assert_allclose(mean, GENERIC_CALIBRATION.sweeps[:, :3], atol=1e-12)
    generic = simulate(SimulationOptions(duration_s=1.0, calibration="generic"))
    assert all(isinstance(s.calibration, Calibration) for s in generic.true_scene.stations)
    assert all(s.calibration is GENERIC_CALIBRATION for s in generic.true_scene.stations)


@pytest.mark.parametrize("planar", [True, False])
def test_robots_drive_smoothly_along_their_heading(planar: bool) -> None:
    session = simulate(replace(NOISELESS, robots=4, planar=planar, duration_s=60.0))
    for truth in session.truth[1:]:
        time_s = (truth.time_ns - SESSION_START_NS) * 1e-9
        np.testing.assert_allclose(np.diff(time_s), 0.01, atol=1e-6)
        velocity = np.diff(truth.position, axis=0) / 0.01
        speed = np.linalg.norm(velocity, axis=1)
        assert 0.15 < speed.max() < 0.301
        assert np.mean(speed < 1e-6) > 0.03  # it rests now and then
        assert np.abs(np.diff(velocity, axis=0)).max() / 0.01 < 1.0  # m/s^2
        assert np.abs(truth.position[:, :2]).max() <= 0.9 + 1e-6
        z = truth.position[:, 2]
        assert np.all(z == 0) if planar else (z.min() >= 0 and z.max() <= 0.5 and np.ptp(z) > 0.1)
        moving = np.hypot(*velocity[:, :2].T) > 0.02
        along = np.arctan2(velocity[:, 1], velocity[:, 0])
        off = np.angle(np.exp(1j * (along - heading_from_quaternion(truth.quaternion[:-1]))))
        assert np.abs(off[moving]).max() < 0.05


@pytest.mark.parametrize("planar", [True, False])
def test_the_first_robot_rests_on_the_markers(planar: bool) -> None:
    session = simulate(replace(NOISELESS, planar=planar, robots=2))
    known = FLOOR_MARKERS_M if planar else RAISED_MARKERS_M
    assert session.scene.stations == ()
    assert session.scene.planar is planar
    assert session.true_scene.markers == session.scene.markers
    truth = session.truth[0]
    for marker, position in zip(session.scene.markers, known, strict=True):
        [visit] = marker.visits
        assert visit.device == truth.device == session.sweeps.devices[0]
        assert (visit.end_ns - visit.start_ns) * 1e-9 == pytest.approx(2.0)
        at_rest = (truth.time_ns >= visit.start_ns) & (truth.time_ns <= visit.end_ns)
        assert np.count_nonzero(at_rest) >= 199
        np.testing.assert_allclose(
            truth.position[at_rest], position[None].repeat(at_rest.sum(), 0), atol=1e-9
        )
        np.testing.assert_array_equal(marker.position, position)
    spread = np.linalg.svd(known - known.mean(axis=0), compute_uv=False)
    assert spread[2] < 1e-12 if planar else spread[2] > 0.3
    # While it is carried between markers it has neither sweeps nor ground truth.
    gaps = [
        (a.visits[0].end_ns, b.visits[0].start_ns)
        for a, b in zip(session.scene.markers, session.scene.markers[1:], strict=False)
    ]
    received_ns = session.sweeps.time_ns[session.sweeps.device == 0]
    for start, end in gaps:
        assert not np.any((received_ns > start) & (received_ns < end))
        assert not np.any((truth.time_ns > start) & (truth.time_ns < end))


@pytest.mark.parametrize(("duration_s", "visited"), [(2.0, 2), (3.0, 3), (5.0, 4), (10.0, 4)])
def test_short_sessions_visit_markers_without_haste(duration_s: float, visited: int) -> None:
    session = simulate(SimulationOptions(duration_s=duration_s, robots=1, seed=3))
    visits = [visit for marker in session.scene.markers for visit in marker.visits]
    assert len(visits) == visited
    times = np.array([(visit.start_ns, visit.end_ns) for visit in visits], np.float64) * 1e-9
    assert np.min(times[:, 1] - times[:, 0]) > 0.24
    assert np.min(times[1:, 0] - times[:-1, 1]) > 0.49
    assert times[-1, 1] - times[0, 0] < 0.75 * duration_s - 0.49


# ---- faults


@pytest.mark.slow
def test_occlusion_hides_the_fraction_in_blocks() -> None:
    options = SimulationOptions(robots=8, stations=3, duration_s=60.0)
    free = simulate(options).sweeps
    hidden = simulate(replace(options, occlusion=0.3)).sweeps
    assert 1 - len(hidden) / len(free) == pytest.approx(0.3, abs=0.02)
    kept = np.isin(free.time_ns, hidden.time_ns)
    assert np.count_nonzero(kept) == len(hidden)
    visible = kept[(free.device == 3) & (free.channel == 2)]
    changes = np.count_nonzero(visible[1:] != visible[:-1])
    assert 4 < changes < 60  # independent samples: 500
    other = kept[(free.device == 3) & (free.channel == 1)]
    n = min(len(visible), len(other))
    assert abs(np.corrcoef(visible[:n], other[:n])[0, 1]) < 0.5  # each on its own


@pytest.mark.slow
@pytest.mark.parametrize(("fraction", "stations"), [(0.02, 2), (0.2, 2), (0.2, 1), (0.95, 3)])
def test_outliers_are_the_requested_fraction(fraction: float, stations: int) -> None:
    options = SimulationOptions(robots=3, stations=stations)
    clean, faulty = simulate(options), simulate(replace(options, outliers=fraction))
    assert len(faulty.sweeps) == len(clean.sweeps)
    assert np.count_nonzero(faulty.is_outlier) == round(fraction * len(clean.sweeps))
    assert not np.any(clean.is_outlier)

    def rows(s: Sweeps, which: NDArray[np.bool_]) -> set[tuple[float, ...]]:
        return set(
            zip(s.device[which], s.time_ns[which], s.channel[which], s.count[which], strict=True)
        )

    every = rows(clean.sweeps, ~clean.is_outlier)
    assert rows(faulty.sweeps, ~faulty.is_outlier) <= every
    assert not rows(faulty.sweeps, faulty.is_outlier) & every


@pytest.mark.slow
def test_outliers_jump_are_reflected_and_are_swapped() -> None:
    options = SimulationOptions(robots=3, noise_rad=0.0, duration_s=60.0)
    clean, faulty = simulate(options), simulate(replace(options, outliers=0.12))
    s, c = faulty.sweeps, clean.sweeps
    before = {(d, t): k for k, (d, t) in enumerate(zip(c.device, c.time_ns, strict=True))}
    jumps = swaps = reflections = 0
    for k in np.flatnonzero(faulty.is_outlier):
        old = before.get((s.device[k], s.time_ns[k]))
        if old is None:
            reflections += 1
            assert _is_reflection(faulty, k)
        elif s.channel[k] == c.channel[old]:
            jumps += 1
            assert abs(s.count[k] - c.count[old]) * COUNT_RAD > np.radians(2.0)
        else:
            swaps += 1
            assert s.count[k] == c.count[old]
            assert channel_of(s.polynomial[k]) == s.channel[k]
    total = np.count_nonzero(faulty.is_outlier)
    for kind in (jumps, swaps, reflections):
        assert kind == pytest.approx(total / 3, abs=6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_exchanged_stations_exchange_their_labels_once(seed: int) -> None:
    # A sweep that were exchanged with two others would change the number of each station.
    options = SimulationOptions(robots=3, stations=6, seed=seed)
    clean, faulty = simulate(options).sweeps, simulate(replace(options, outliers=0.9)).sweeps
    assert np.count_nonzero(clean.channel != faulty.channel) > 100
    np.testing.assert_array_equal(np.bincount(clean.channel), np.bincount(faulty.channel))
    np.testing.assert_array_equal(np.bincount(clean.polynomial), np.bincount(faulty.polynomial))


def _is_reflection(session: SimulatedSession, k: int) -> bool:
    """Return True if a sweep is that of the robot's mirror image in one of four walls."""
    s = session.sweeps
    station = session.true_scene.stations[s.channel[k] - 1]
    truth = session.truth[s.device[k]]
    at = [
        np.interp(s.time_ns[k] - SESSION_START_NS, truth.time_ns - SESSION_START_NS, x)
        for x in truth.position.T
    ]
    for axis, wall in ((0, 2.5), (0, -2.5), (1, 2.5), (1, -2.5)):
        image = np.array(at)
        image[axis] = 2 * wall - image[axis]
        angles = predict_angles((image - station.position) @ station.rotation, station.calibration)
        turn = (angles + np.radians([120.0, 240.0])) / (2 * np.pi)
        miss = turn * float(period_counts(station.channel)) - s.count[k]
        if np.min(np.abs(miss)) * COUNT_RAD < 5e-4:  # the truth is interpolated
            return True
    return False


# ---- options, and solving a simulated session


@pytest.mark.parametrize(
    "wrong",
    [
        {"robots": 0}, {"stations": 0}, {"stations": 17}, {"duration_s": 0.0},
        {"duration_s": float("nan")}, {"duration_s": float("inf")}, {"report_hz": 0.0},
        {"noise_rad": -1e-9}, {"occlusion": 1.0}, {"occlusion": -0.1}, {"outliers": 1.0},
        {"calibration": "bent"}, {"seed": -1},
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))) as caught:
        SimulationOptions(**wrong)  # type: ignore[arg-type]
    assert caught.value.hint
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        {"duration_s": 0.001},
        {"duration_s": 0.05, "stations": 3, "outliers": 0.5, "occlusion": 0.5},
        {"duration_s": 3.0, "report_hz": 0.2},
        {"duration_s": 2.0, "report_hz": 500.0},
        {"duration_s": 4.0, "occlusion": 0.99, "outliers": 0.99},
        {"duration_s": 4.0, "noise_rad": 1.5},
    ],
)
def test_odd_sessions_are_whole(options: dict[str, float]) -> None:
    session = simulate(SimulationOptions(**options))  # type: ignore[arg-type]
    s = session.sweeps
    assert len(s.count) == len(s.time_ns) == len(session.is_outlier)
    assert np.all((s.count >= 0) & (s.count < period_counts(s.channel)))
    if options.get("report_hz", 0) > 50:  # no rotation is reported twice
        assert len(set(zip(s.channel, s.time_ns, strict=True))) == len(s)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "largest_mm"),
    [
        (SimulationOptions(seed=1), 5.0),
        (SimulationOptions(stations=1, seed=1), 5.0),
        (SimulationOptions(planar=False, stations=3, robots=2, seed=1), 5.0),
        (SimulationOptions(calibration="generic", seed=1), 0.5),
    ],
)
def test_the_solver_finds_the_robots(options: SimulationOptions, largest_mm: float) -> None:
    session = simulate(options)
    solution = lighthouse.solve(session.sweeps, session.scene)
    truth = {t.device: t for t in session.truth}
    score = evaluate([(t, truth[t.device]) for t in solution.trajectories])
    assert score.n > 0.8 * 10 * options.robots * (options.duration_s - 6)
    assert score.mae < 1e-3 * largest_mm
