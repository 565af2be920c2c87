"""SimulatedSession sweeps against physics that is written down here a second time."""

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
    Calibration,
    predict_angles,
)
from locatk.core.lighthouse.channels import channel_of, period_counts, period_ticks
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.simulation.session import (
    EPOCH_NS,
    FLAT_MARKERS,
    RAISED_MARKERS,
    SimulatedSession,
    SimulationOptions,
    simulate,
)

Array = NDArray[np.float64]
QUIET = SimulationOptions(noise_rad=0.0, seed=4)
COUNT_RAD = 2 * np.pi / period_counts(1)
"""One LFSR step of channel 1 as an angle."""


@dataclass
class Turns:
    """Whole rotations of one station as one robot saw them, with the station's rotor."""

    time_s: Array  # (n, 2) since the start of the session
    count: Array  # (n, 2)
    row: NDArray[np.int64]  # (n, 2) of the sweeps
    zero_s: float
    period_s: float


def turns_of(made: SimulatedSession, device: int, channel: int) -> Turns:
    """Find rotations again from times and counts alone."""
    s = made.sweeps
    mine = np.flatnonzero((s.device == device) & (s.channel == channel))
    time_s, count = (s.time_ns[mine] - EPOCH_NS) * 1e-9, s.count[mine]
    nominal = float(period_ticks(channel)) / 48e6
    period_s = nominal
    for _ in range(3):  # a count lasts as long as the station's own clock says
        start = time_s - count / float(period_counts(channel)) * period_s
        number = np.cumsum(np.rint(np.r_[0.0, np.diff(start)] / nominal))
        period_s, zero_s = np.polyfit(number, start, 1)
    new = np.r_[True, np.diff(number) > 0.5]
    first = np.flatnonzero(new & np.r_[~new[1:], False])
    rows = np.stack([first, first + 1], axis=1)
    return Turns(time_s[rows], count[rows], mine[rows], float(zero_s), float(period_s))


def path_of(made: SimulatedSession, device: int) -> tuple[Array, CubicSpline]:
    """Times and positions of a robot from the truth, between its samples by splines."""
    truth = made.truth[device]
    time_s = (truth.time_ns - EPOCH_NS) * 1e-9
    return time_s, CubicSpline(time_s, truth.position)


# ---- physics


def plane_side(time_s: Array, points: Array, plane: int, turns: Turns) -> Array:
    """Which side of a rotating plane points (n, 3) of a station's axes are on.

    Plain geometry: a plane that holds the forward axis and is tilted by 30 degrees about it
    is turned about the vertical; after a third (two thirds) of a turn it is as it was.
    """
    tilt = np.radians([30.0, -30.0])[plane]
    turn = 2 * np.pi * ((time_s - turns.zero_s) / turns.period_s - (1 + plane) / 3)
    normal = np.stack(
        [
            -np.sin(turn) * np.cos(tilt),
            np.cos(turn) * np.cos(tilt),
            np.full_like(turn, -np.sin(tilt)),
        ],
        axis=-1,
    )
    return np.sum(normal * points, axis=-1)


def test_ideal_planes_pass_moving_robots_when_their_sweeps_say() -> None:
    """Brute force: the plane is stepped through time until the robot changes sides."""
    made = simulate(replace(QUIET, robots=2, calibration="ideal"))
    station = made.stations.stations[1]
    turns = turns_of(made, 1, 2)
    _, path = path_of(made, 1)
    assert len(turns.time_s) > 250
    for row in range(0, len(turns.time_s), 10):
        for plane in (0, 1):
            about = turns.time_s[row, plane]
            fine = about + np.arange(-2e-4, 2e-4, 1e-7)
            local = (path(fine) - station.position) @ station.rotation
            side = plane_side(fine, local, plane, turns)
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


def test_factory_planes_pass_moving_robots_when_their_sweeps_say() -> None:
    made = simulate(replace(QUIET, planar=False, robots=2, stations=3))
    station = made.stations.stations[2]
    [unit] = [u for u in FACTORY_UNITS if u[1] == station.calibration.sweeps[0, 1]]
    turns = turns_of(made, 1, 3)
    _, path = path_of(made, 1)
    rotor = 2 * np.pi * ((turns.time_s - turns.zero_s) / turns.period_s - np.array([1 / 3, 2 / 3]))
    worst = 0.0
    for row in range(0, len(turns.time_s), 5):
        for plane in (0, 1):
            local = (path(turns.time_s[row, plane]) - station.position) @ station.rotation
            miss = reproject(local, unit, plane) - rotor[row, plane]
            worst = max(worst, abs(np.angle(np.exp(1j * miss))))
    assert worst < 5e-6  # a tenth of an LFSR step


@pytest.mark.parametrize("calibration", ["units", "generic", "ideal"])
def test_standing_robots_obey_the_forward_model(calibration: str) -> None:
    made = simulate(replace(QUIET, calibration=calibration, stations=4))
    for marker in made.scene.markers:
        [sighting] = marker.sightings
        for station in made.stations.stations:
            turns = turns_of(made, 0, station.channel)
            still = (turns.time_s[:, 0] * 1e9 + EPOCH_NS > sighting.start_ns) & (
                turns.time_s[:, 1] * 1e9 + EPOCH_NS < sighting.end_ns
            )
            assert np.count_nonzero(still) >= 18
            local = (marker.position - station.position) @ station.rotation
            angles = predict_angles(local, station.calibration)
            expected = (angles + np.radians([120.0, 240.0])) / (2 * np.pi)
            expected = expected * float(period_counts(station.channel))
            np.testing.assert_allclose(
                turns.count[still], expected[None].repeat(still.sum(), 0), atol=0.5 + 1e-6
            )


def test_rotors_turn_on_their_own_clocks() -> None:
    made = simulate(replace(QUIET, stations=16, duration_s=20.0))
    phases, errors = [], []
    for channel in range(1, 17):
        turns = turns_of(made, 0, channel)
        start = turns.time_s - turns.count / float(period_counts(channel)) * turns.period_s
        number = np.rint((start - turns.zero_s) / turns.period_s)
        rest = start - turns.zero_s - number * turns.period_s
        assert np.abs(rest).max() < 1.2e-7  # a count is 1.67e-7 s
        errors.append(turns.period_s / (float(period_ticks(channel)) / 48e6) - 1)
        phases.append((turns.zero_s / turns.period_s) % 1)
    assert np.max(np.abs(errors)) < 25e-6
    assert np.std(errors) > 5e-6
    assert np.std(phases) > 0.15


def test_sweeps_of_a_report_are_spread_in_time() -> None:
    s = simulate(replace(QUIET, stations=4)).sweeps
    time_s = (s.time_ns - EPOCH_NS) * 1e-9
    report = np.r_[True, np.diff(time_s) > 0.05].cumsum()
    spread = [np.ptp(time_s[report == k]) for k in np.unique(report)]
    assert 0.01 < np.median(spread) < 0.03
    assert np.max(spread) < 0.031


def test_noise_is_that_of_the_angle_and_of_whole_counts() -> None:
    sigma = 3e-4
    options = SimulationOptions(noise_rad=sigma, report_hz=40.0, calibration="units", seed=2)
    made = simulate(options)
    deviations = []
    for channel in (1, 2):
        turns = turns_of(made, 0, channel)
        for marker in made.scene.markers:
            [sighting] = marker.sightings
            span = (np.array([sighting.start_ns, sighting.end_ns]) - EPOCH_NS) * 1e-9
            still = (turns.time_s[:, 0] > span[0]) & (turns.time_s[:, 1] < span[1])
            counts = turns.count[still]
            deviations.append(counts - counts.mean(axis=0))
    expected = np.hypot(sigma / COUNT_RAD, 1 / np.sqrt(12))
    assert np.std(np.concatenate(deviations)) == pytest.approx(expected, rel=0.06)


# ---- shape


def same(a: Sweeps, b: Sweeps) -> bool:
    names = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
    return a.devices == b.devices and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in names
    )


def test_same_options_same_arrays() -> None:
    options = SimulationOptions(robots=2, occlusion=0.1, outliers=0.05, duration_s=5.0, seed=9)
    first, second = simulate(options), simulate(options)
    assert same(first.sweeps, second.sweeps)
    assert first.sweeps.time_ns.min() >= EPOCH_NS == 1_767_225_600_000_000_000
    assert all(
        np.array_equal(a.position, b.position)
        for a, b in zip(first.truth, second.truth, strict=True)
    )
    assert not same(first.sweeps, simulate(replace(options, seed=10)).sweeps)


def test_noise_and_faults_do_not_move_robots_or_stations() -> None:
    calm, wild = (
        simulate(QUIET),
        simulate(replace(QUIET, noise_rad=1e-4, outliers=0.1, occlusion=0.3, labelled=False)),
    )
    np.testing.assert_array_equal(calm.truth[0].position, wild.truth[0].position)
    for a, b in zip(calm.stations.stations, wild.stations.stations, strict=True):
        np.testing.assert_array_equal(a.position, b.position)


@pytest.mark.parametrize("planar", [True, False])
def test_counts_are_whole_and_of_one_rotation(planar: bool) -> None:
    made = simulate(SimulationOptions(robots=3, stations=16, outliers=0.3, planar=planar))
    s = made.sweeps
    assert len(s) > 15_000
    assert np.all(s.count == np.rint(s.count))
    assert np.all((s.count >= 0) & (s.count < period_counts(s.channel)))
    assert np.all(np.diff(s.time_ns) >= 0)
    assert np.all(s.sweep == UNKNOWN)
    assert set(s.channel) == set(range(1, 17))


def test_the_first_plane_has_the_smaller_count_and_the_same_slow_bit() -> None:
    made = simulate(replace(QUIET, stations=2))
    s = made.sweeps
    turns = turns_of(made, 0, 1)
    assert np.all(turns.count[:, 0] < turns.count[:, 1])
    assert np.array_equal(channel_of(s.polynomial), s.channel)
    bits = s.polynomial[turns.row] & 1
    assert len(bits) > 200
    assert np.array_equal(bits[:, 0], bits[:, 1])
    assert 0.3 < np.mean(bits) < 0.7


def test_without_labels_polynomials_are_unknown_and_nothing_else_changes() -> None:
    known, unknown = simulate(QUIET).sweeps, simulate(replace(QUIET, labelled=False)).sweeps
    assert np.all(unknown.polynomial == UNKNOWN)
    assert same(unknown, replace(known, polynomial=unknown.polynomial))


def test_all_of_the_floor_is_in_sight() -> None:
    for seed in range(5):
        for planar in (True, False):
            options = SimulationOptions(
                robots=5, stations=6, planar=planar, duration_s=60.0, seed=seed
            )
            made = simulate(options)
            others = made.sweeps.device > 0  # the first is carried for a while
            reports = 4 * 600 * 6
            assert np.count_nonzero(others) / 2 > 0.99 * reports


def test_stations_stand_as_they_would_and_have_real_calibrations() -> None:
    for seed in range(10):
        made = simulate(SimulationOptions(stations=11, duration_s=1.0, seed=seed))
        stations = made.stations.stations
        place = np.stack([s.position for s in stations])
        assert np.all(np.abs(np.hypot(place[:, 0], place[:, 1]) - 2.0) <= 0.1)
        assert np.all((place[:, 2] >= 1.5) & (place[:, 2] <= 2.0))
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
    """The columns of a unit are read as the prior reads them."""
    many = simulate(SimulationOptions(stations=11, duration_s=1.0)).stations.stations
    mean = np.mean([s.calibration.sweeps[:, :3] for s in many], axis=0)
    np.testing.assert_allclose(mean, GENERIC_CALIBRATION.sweeps[:, :3], atol=1e-12)
    generic = simulate(SimulationOptions(duration_s=1.0, calibration="generic"))
    assert all(isinstance(s.calibration, Calibration) for s in generic.stations.stations)
    assert all(s.calibration is GENERIC_CALIBRATION for s in generic.stations.stations)


@pytest.mark.parametrize("planar", [True, False])
def test_robots_drive_smoothly_along_their_heading(planar: bool) -> None:
    made = simulate(replace(QUIET, robots=4, planar=planar, duration_s=60.0))
    for truth in made.truth[1:]:
        time_s = (truth.time_ns - EPOCH_NS) * 1e-9
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
def test_the_first_robot_stands_on_the_markers(planar: bool) -> None:
    made = simulate(replace(QUIET, planar=planar, robots=2))
    known = FLAT_MARKERS if planar else RAISED_MARKERS
    assert made.scene.stations == ()
    assert made.scene.planar is planar
    assert made.stations.markers == made.scene.markers
    truth = made.truth[0]
    for marker, place in zip(made.scene.markers, known, strict=True):
        [sighting] = marker.sightings
        assert sighting.device == truth.device == made.sweeps.devices[0]
        assert (sighting.end_ns - sighting.start_ns) * 1e-9 == pytest.approx(2.0)
        there = (truth.time_ns >= sighting.start_ns) & (truth.time_ns <= sighting.end_ns)
        assert np.count_nonzero(there) >= 199
        np.testing.assert_allclose(
            truth.position[there], place[None].repeat(there.sum(), 0), atol=1e-9
        )
        np.testing.assert_array_equal(marker.position, place)
    spread = np.linalg.svd(known - known.mean(axis=0), compute_uv=False)
    assert spread[2] < 1e-12 if planar else spread[2] > 0.3
    # In the hand, between markers, it is neither received nor has it truth.
    gaps = [
        (a.sightings[0].end_ns, b.sightings[0].start_ns)
        for a, b in zip(made.scene.markers, made.scene.markers[1:], strict=False)
    ]
    mine = made.sweeps.time_ns[made.sweeps.device == 0]
    for start, end in gaps:
        assert not np.any((mine > start) & (mine < end))
        assert not np.any((truth.time_ns > start) & (truth.time_ns < end))


# ---- what goes wrong


def test_occlusion_hides_the_share_in_blocks() -> None:
    options = SimulationOptions(robots=8, stations=3, duration_s=60.0)
    free = simulate(options).sweeps
    hidden = simulate(replace(options, occlusion=0.3)).sweeps
    assert 1 - len(hidden) / len(free) == pytest.approx(0.3, abs=0.02)
    kept = np.isin(free.time_ns, hidden.time_ns)
    assert np.count_nonzero(kept) == len(hidden)
    mine = kept[(free.device == 3) & (free.channel == 2)]
    changes = np.count_nonzero(mine[1:] != mine[:-1])
    assert 4 < changes < 60  # independent samples: 500
    other = kept[(free.device == 3) & (free.channel == 1)]
    n = min(len(mine), len(other))
    assert abs(np.corrcoef(mine[:n], other[:n])[0, 1]) < 0.5  # each on its own


@pytest.mark.parametrize(("share", "stations"), [(0.02, 2), (0.2, 2), (0.2, 1), (0.95, 3)])
def test_outliers_are_the_share_that_was_asked_for(share: float, stations: int) -> None:
    options = SimulationOptions(robots=3, stations=stations)
    clean, made = simulate(options), simulate(replace(options, outliers=share))
    assert len(made.sweeps) == len(clean.sweeps)
    assert np.count_nonzero(made.wrong) == round(share * len(clean.sweeps))
    assert not np.any(clean.wrong)

    def rows(s: Sweeps, which: NDArray[np.bool_]) -> set[tuple[float, ...]]:
        return set(
            zip(s.device[which], s.time_ns[which], s.channel[which], s.count[which], strict=True)
        )

    every = rows(clean.sweeps, ~clean.wrong)
    assert rows(made.sweeps, ~made.wrong) <= every
    assert not rows(made.sweeps, made.wrong) & every


def test_outliers_jump_are_reflected_and_are_swapped() -> None:
    options = SimulationOptions(robots=3, noise_rad=0.0, duration_s=60.0)
    clean, made = simulate(options), simulate(replace(options, outliers=0.12))
    s, c = made.sweeps, clean.sweeps
    before = {(d, t): k for k, (d, t) in enumerate(zip(c.device, c.time_ns, strict=True))}
    jumps = swaps = reflections = 0
    for k in np.flatnonzero(made.wrong):
        old = before.get((s.device[k], s.time_ns[k]))
        if old is None:
            reflections += 1
            assert _is_mirrored(made, k)
        elif s.channel[k] == c.channel[old]:
            jumps += 1
            assert abs(s.count[k] - c.count[old]) * COUNT_RAD > np.radians(2.0)
        else:
            swaps += 1
            assert s.count[k] == c.count[old]
            assert channel_of(s.polynomial[k]) == s.channel[k]
    total = np.count_nonzero(made.wrong)
    for kind in (jumps, swaps, reflections):
        assert kind == pytest.approx(total / 3, abs=6)


def _is_mirrored(made: SimulatedSession, k: int) -> bool:
    """Whether a sweep is where the robot's image in one of four walls would be seen."""
    s = made.sweeps
    station = made.stations.stations[s.channel[k] - 1]
    truth = made.truth[s.device[k]]
    at = [np.interp(s.time_ns[k] - EPOCH_NS, truth.time_ns - EPOCH_NS, x) for x in truth.position.T]
    for axis, wall in ((0, 2.5), (0, -2.5), (1, 2.5), (1, -2.5)):
        image = np.array(at)
        image[axis] = 2 * wall - image[axis]
        angles = predict_angles((image - station.position) @ station.rotation, station.calibration)
        turn = (angles + np.radians([120.0, 240.0])) / (2 * np.pi)
        miss = turn * float(period_counts(station.channel)) - s.count[k]
        if np.min(np.abs(miss)) * COUNT_RAD < 5e-4:  # the truth is interpolated
            return True
    return False


# ---- options and the way through the solver


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
    made = simulate(SimulationOptions(**options))  # type: ignore[arg-type]
    s = made.sweeps
    assert len(s.count) == len(s.time_ns) == len(made.wrong)
    assert np.all((s.count >= 0) & (s.count < period_counts(s.channel)))
    if options.get("report_hz", 0) > 50:  # no rotation is reported twice
        assert len(set(zip(s.channel, s.time_ns, strict=True))) == len(s)


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
    made = simulate(options)
    solution = lighthouse.solve(made.sweeps, made.scene)
    truth = {t.device: t for t in made.truth}
    score = evaluate([(t, truth[t.device]) for t in solution.trajectories])
    assert score.n > 0.8 * 10 * options.robots * (options.duration_s - 6)
    assert score.mae < 1e-3 * largest_mm
