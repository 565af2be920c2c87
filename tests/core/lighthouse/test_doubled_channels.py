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
from locatk.core.lighthouse.doubled_channels import find_doubled_channels
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.formats.importers.dotbot.recording import read_dotbot
from locatk.formats.importers.libsurvive.recording import read_libsurvive

Array = NDArray[np.float64]


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
    assert find_doubled_channels(both) == (5,)
    with pytest.raises(DegenerateError, match="more than one station sends on channel 5") as error:
        solve(both)
    assert error.value.hint == "Set each station to a channel of its own"


def test_several_photodiodes(world: Any) -> None:
    both = twins(world, sensors=DECK.position_m, seed=4)
    assert find_doubled_channels(both) == (5,)
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
    assert find_doubled_channels(sweeps) == ()
    assert find_doubled_channels(with_report_times(sweeps)) == ()


@pytest.mark.parametrize("speed_m_s", [1.0, 6.0])
def test_fast_motion_is_no_second_station(world: Any, speed_m_s: float) -> None:
    def position(time_s: Array) -> Array:
        angle = speed_m_s / 0.3 * time_s
        return np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.2 + 0 * time_s], axis=-1)

    sweeps = world.stream(world.lamps(1, 5), position, 5.0)
    assert find_doubled_channels(sweeps) == ()
    points = position(np.arange(200) * 0.02)
    assert find_doubled_channels(world.drive(world.lamps(1, 5), points, step_s=0.02).sweeps) == ()


def test_a_restarted_station_is_one(world: Any) -> None:
    lamp = world.lamps(5)
    still = lambda t: np.array([0.2, 0.1, 0.0]) + np.zeros((*np.shape(t), 3))  # noqa: E731
    before, after = (world.stream(lamp, still, 4.0, seed=seed) for seed in (1, 2))
    after = replace(after, time_ns=after.time_ns + 12_000_000_000)
    assert find_doubled_channels(world.join(before, after)) == ()


def test_counts_that_are_no_numbers(world: Any) -> None:
    sweeps = twins(world)
    sweeps.count[::3] = np.nan
    sweeps.count[1::50] = np.inf
    find_doubled_channels(sweeps)


def test_published_counts(recordings: Path) -> None:
    for name in (
        "twoLH-2D_scene/dataset/lighthouse/data.csv",
        "twoLH-3D_scene/dataset/data_all.csv",
    ):
        sweeps = read_dotbot([recordings / name]).sweeps
        assert find_doubled_channels(sweeps) == ()
        assert find_doubled_channels(on_channel_1(sweeps)) == (1,)
        assert find_doubled_channels(on_channel_1(with_one_station_per_report(sweeps, 2))) == (1,)
    for name in sorted((recordings / "oneLH-2D_scene/dataset/lighthouse").glob("*_lh2.csv")):
        assert find_doubled_channels(read_dotbot([name]).sweeps) == ()


@pytest.mark.slow
def test_published_times(recordings: Path) -> None:
    sweeps = read_libsurvive([recordings / "libsurvive/tracker-cal-attempt.rec.gz"]).sweeps
    assert find_doubled_channels(sweeps) == ()
    assert find_doubled_channels(on_channel_1(sweeps)) == (1,)
