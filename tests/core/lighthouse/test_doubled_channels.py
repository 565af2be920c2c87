"""Two stations on one channel are named, and their sweeps give no pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse import solve
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION
from locatk.core.lighthouse.doubled_channels import DoubledChannels, find_doubled_channels
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.formats.importers.dotbot.recording import read_dotbot

Array = NDArray[np.float64]

NONE = DoubledChannels((), ())


def on_channel_1(sweeps: Sweeps) -> Sweeps:
    channel = np.ones_like(sweeps.channel)
    return replace(
        sweeps,
        channel=channel,
        polynomial=np.where(sweeps.polynomial < 0, -1, sweeps.polynomial & 1),
    )


def with_report_times(sweeps: Sweeps) -> Sweeps:
    """Give all sweeps of a report, those within 50 ms, the time of the report."""
    time_ns = sweeps.time_ns.copy()
    for device in np.unique(sweeps.device):
        rows = np.flatnonzero(sweeps.device == device)
        rows = rows[np.argsort(time_ns[rows], kind="stable")]
        report = np.cumsum(np.diff(time_ns[rows], prepend=time_ns[rows[0]]) > 50_000_000)
        last = np.flatnonzero(np.diff(report, append=report[-1] + 1))
        time_ns[rows] = time_ns[rows][last][report]
    return replace(sweeps, time_ns=time_ns)


def with_one_station_per_report(sweeps: Sweeps, seed: int) -> Sweeps:
    """Keep the sweeps of a random station in each tenth of a second."""
    channels = np.unique(sweeps.channel)
    _, report = np.unique(sweeps.time_ns // 100_000_000, return_inverse=True)
    chosen = np.random.default_rng(seed).integers(0, len(channels), report.max() + 1)
    return sweeps.take(sweeps.channel == channels[chosen[report]])


def twins(world: Any, **options: Any) -> Sweeps:
    """Every sweep of two stations with the period of channel 5, of a robot at about 0.5 m/s."""
    first, second = world.lamps(5, 16)

    def position(time_s: Array) -> Array:
        return np.stack(
            [0.6 * np.sin(0.9 * time_s), 0.5 * np.cos(0.7 * time_s), 0.1 + 0 * time_s], axis=-1
        )

    return world.stream((first, replace(second, channel=5)), position, 6.0, **options)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rotors_with_two_phases_are_two_stations(world: Any, seed: int) -> None:
    both = twins(world, seed=seed)
    assert find_doubled_channels(both) == DoubledChannels((5,), ())
    with pytest.raises(DegenerateError, match="more than one station sends on channel 5") as error:
        solve(both)
    assert error.value.hint == "Set each station to a channel of its own"


def test_several_photodiodes(world: Any) -> None:
    both = twins(world, sensors=DECK.position_m, seed=4)
    assert find_doubled_channels(both) == DoubledChannels((5,), ())
    with pytest.raises(DegenerateError, match="channel 5"):
        solve(both, receivers={"robot": DECK})


def test_the_other_stations_are_used(world: Any) -> None:
    rest = world.lamps(1, 2)
    points = world.curve(150, flat=False)
    position = lambda t: np.stack([np.interp(t, np.arange(150) / 10, p) for p in points.T], axis=-1)  # noqa: E731
    others = world.stream(rest, position, 14.0, seed=5)
    both = twins(world)
    solution = solve(world.join(others, both))
    assert solution.rejected["sweep_of_doubled_channel"] == len(both)
    assert solution.warnings[0].code == "doubled_channel"
    assert [s.channel for s in solution.artifact.stations] == [1, 2]
    alone = solve(others)
    assert solution.poses == alone.poses > 300
    assert np.array_equal(solution.trajectories[0].position, alone.trajectories[0].position)


@pytest.mark.parametrize("seed", range(10, 14))
@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("known", [True, False])
def test_no_pose_from_a_simulated_recording(seed: int, planar: bool, known: bool) -> None:
    session = simulate(SimulationOptions(planar=planar, seed=seed, outliers=0.05))
    scene = session.scene
    if known:
        scene = replace(session.true_scene, stations=session.true_scene.stations[:1])
    both = on_channel_1(session.sweeps)
    sparse = with_one_station_per_report(session.sweeps, seed)
    for sweeps in (both, with_report_times(both), on_channel_1(with_report_times(sparse))):
        with pytest.raises(DegenerateError, match="more than one station sends on channel 1"):
            solve(sweeps, scene)


@pytest.mark.parametrize(
    "options",
    [
        SimulationOptions(robots=3, outliers=0.2),
        SimulationOptions(planar=False, stations=4, outliers=0.1, occlusion=0.3),
        SimulationOptions(outliers=0.1, labelled=False, report_hz=50),
        SimulationOptions(receiver=DECK, report_hz=40, outliers=0.1),
        SimulationOptions(report_hz=3, outliers=0.2),
    ],
)
@pytest.mark.parametrize("seed", [20, 21])
def test_outliers_and_reflections_are_no_second_station(
    options: SimulationOptions, seed: int
) -> None:
    sweeps = simulate(replace(options, seed=seed)).sweeps
    assert find_doubled_channels(sweeps) == NONE
    assert find_doubled_channels(with_report_times(sweeps)) == NONE


@pytest.mark.parametrize("speed_m_s", [1.0, 6.0])
def test_fast_motion_is_no_second_station(world: Any, speed_m_s: float) -> None:
    def position(time_s: Array) -> Array:
        angle = speed_m_s / 0.3 * time_s
        return np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.2 + 0 * time_s], axis=-1)

    sweeps = world.stream(world.lamps(1, 5), position, 5.0)
    assert find_doubled_channels(sweeps) == NONE
    points = position(np.arange(200) * 0.02)
    assert find_doubled_channels(world.drive(world.lamps(1, 5), points, step_s=0.02).sweeps) == NONE


def shuttle(time_s: Array, length_m: float, speed_m_s: float) -> Array:
    """Positions (n,) between -1/2 and 1/2 of ``length_m``, at constant speed to and fro."""
    return length_m * (np.abs((speed_m_s * time_s / length_m) % 2 - 1) - 0.5)


def stops(time_s: Array, length_m: float, speed_m_s: float) -> Array:
    """Positions (n,) of a shuttle that rests for a time at both ends."""
    return np.clip(1.5 * shuttle(time_s, length_m, speed_m_s), -length_m / 2, length_m / 2)


MOTIONS = {
    "line 0.3 m/s": lambda t: (shuttle(t, 2, 0.3), 0 * t),
    "line 0.5 m/s": lambda t: (shuttle(t, 2, 0.5), 0 * t),
    "line 0.8 m/s": lambda t: (shuttle(t, 2, 0.8), 0 * t),
    "short line": lambda t: (0 * t, shuttle(t, 0.4, 0.5)),
    "stops": lambda t: (stops(t, 1.0, 0.8), 0 * t),
    "hand 1.5 Hz": lambda t: (0.15 * np.sin(9.4 * t), 0 * t),
    "hand 1 Hz": lambda t: (0.3 * np.sin(6.28 * t), 0 * t),
    "hand 2 Hz": lambda t: (0.3 * np.sin(12.6 * t), 0.1 * np.cos(12.6 * t)),
    "circle": lambda t: (0.5 * np.sin(4 * t), 0.5 * np.cos(4 * t)),
    "spin": lambda t: (0.1 * np.sin(12.6 * t), 0.1 * np.cos(12.6 * t)),
}


@pytest.mark.parametrize("rate_hz", [5, 8, 10, 20, 100])
@pytest.mark.parametrize("name", MOTIONS)
def test_a_robot_that_turns_around_is_one_sensor(world: Any, name: str, rate_hz: int) -> None:
    rng = np.random.default_rng(rate_hz)
    time_s = np.arange(0, 30, 1 / rate_hz) + rng.uniform(0, 0.2 / rate_hz, 30 * rate_hz)
    points = np.stack([*MOTIONS[name](time_s), 0.2 + 0 * time_s], axis=-1)
    drive = world.drive(world.lamps(1, 5), points, step_s=1 / rate_hz)
    drive.time_ns[:] = drive.time_ns[0] + (time_s * 1e9).astype(np.int64)
    # Some reports are lost, so that a motion in step with the reports is not in step with these.
    drive.counts[rng.random(len(points)) < 0.1] = np.nan
    assert find_doubled_channels(drive.sweeps) == NONE


@pytest.mark.parametrize(("reports", "phase"), [(2, 0.25), (3, 0.25), (4, 0.125), (6, 1 / 12)])
def test_an_oscillation_in_step_with_the_reports_is_no_station(
    world: Any, reports: int, phase: float
) -> None:
    index = np.arange(300)
    x_m = 0.3 * np.sin(2 * np.pi * (index / reports + phase))
    points = np.stack([x_m, 0 * x_m, 0.2 + 0 * x_m], axis=-1)
    drive = world.drive(world.lamps(1), points, step_s=0.1)
    drive.counts[np.random.default_rng(1).random(len(points)) < 0.1] = np.nan
    assert find_doubled_channels(drive.sweeps) == NONE


def two_on_channel_1(world: Any, second_fraction: float, per_report: bool, seed: int) -> Sweeps:
    """Reports at 10 Hz of a robot at 0.2 m/s that each have sweeps of one of two stations.

    Without ``per_report`` each sweep of a report is of one of the stations.
    """
    rng = np.random.default_rng(seed)
    angle = np.arange(400) * 0.02 / 0.8
    points = np.stack([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0 * angle], axis=-1)
    drive = world.drive(world.lamps(1, 5), points, step_s=0.1)
    is_second = rng.random((400, 1, 1 if per_report else 2)) < second_fraction
    hidden = np.concatenate([is_second, ~is_second], axis=1)
    drive.counts[np.broadcast_to(hidden, drive.counts.shape)] = np.nan
    return on_channel_1(drive.sweeps)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("per_report", [True, False])
def test_two_stations_in_turn(world: Any, per_report: bool, seed: int) -> None:
    sweeps = two_on_channel_1(world, 0.5, per_report, seed)
    assert find_doubled_channels(sweeps) == DoubledChannels((1,), ())
    # Without the evidence of enough reports nothing is claimed.
    assert find_doubled_channels(sweeps.take(np.arange(40))) == NONE


def test_a_station_that_is_hidden_most_of_the_time_is_a_warning(world: Any) -> None:
    both = two_on_channel_1(world, 0.25, True, 3)
    assert find_doubled_channels(both) == DoubledChannels((), (1,))
    (lamp,) = world.lamps(1)
    station = Station(1, lamp.position, lamp.rotation, GENERIC_CALIBRATION)
    solution = solve(both, Scene(stations=(station,), planar=True))
    (warning,) = (w for w in solution.warnings if w.code == "possible_doubled_channel")
    assert "may send on channel 1" in warning.message
    assert "sweep_of_doubled_channel" not in solution.rejected


def test_a_restarted_station_is_one(world: Any) -> None:
    lamp = world.lamps(5)
    still = lambda t: np.array([0.2, 0.1, 0.0]) + np.zeros((*np.shape(t), 3))  # noqa: E731
    before, after = (world.stream(lamp, still, 4.0, seed=seed) for seed in (1, 2))
    after = replace(after, time_ns=after.time_ns + 12_000_000_000)
    assert find_doubled_channels(world.join(before, after)) == NONE


@pytest.mark.parametrize("slew_us_per_s", [200, 500, 1000, 5000])
def test_a_clock_that_is_corrected_is_no_station(world: Any, slew_us_per_s: float) -> None:
    """Capture finds a better mapping to the time of the host, and approaches it."""
    still = lambda t: np.array([0.2, 0.1, 0.0]) + np.zeros((*np.shape(t), 3))  # noqa: E731
    for start_s in (0.7, 1.5, 3.0):
        sweeps = world.stream(world.lamps(5), still, 4.0, seed=3)
        time_s = (sweeps.time_ns - sweeps.time_ns[0]) * 1e-9
        correction_s = 1e-6 * slew_us_per_s * np.clip(time_s - start_s, 0, 0.5)
        corrected = sweeps.time_ns + (1e9 * correction_s).astype(np.int64)
        assert find_doubled_channels(replace(sweeps, time_ns=corrected)) == NONE


def test_counts_that_are_no_numbers(world: Any) -> None:
    sweeps = twins(world)
    sweeps.count[::3] = np.nan
    sweeps.count[1::50] = np.inf
    find_doubled_channels(sweeps)


@pytest.mark.slow
def test_published_counts(recordings: Path) -> None:
    for name in (
        "twoLH-2D_scene/dataset/lighthouse/data.csv",
        "twoLH-3D_scene/dataset/data_all.csv",
    ):
        sweeps = read_dotbot([recordings / name]).sweeps
        assert find_doubled_channels(sweeps) == NONE
        assert find_doubled_channels(on_channel_1(sweeps)) == DoubledChannels((1,), ())
        assert find_doubled_channels(
            on_channel_1(with_one_station_per_report(sweeps, 2))
        ) == DoubledChannels((1,), ())
    for name in sorted((recordings / "oneLH-2D_scene/dataset/lighthouse").glob("*_lh2.csv")):
        assert find_doubled_channels(read_dotbot([name]).sweeps) == NONE


@pytest.mark.slow
def test_published_times(recorded_tracker: Any) -> None:
    sweeps = recorded_tracker.sweeps
    assert find_doubled_channels(sweeps) == NONE
    assert find_doubled_channels(on_channel_1(sweeps)) == DoubledChannels((1,), ())
