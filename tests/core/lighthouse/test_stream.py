"""Live localization: fixes as offline, independent of how the input is cut, in bounded memory."""

from __future__ import annotations

import pickle
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, matrix_from_quaternion, rotation_exp
from locatk.core.lighthouse.calibration import ideal_angles, predict_angles
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.devices.solver import solve_devices
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.simulation import SimulatedSession, SimulationOptions, simulate
from locatk.core.lighthouse.solver import solve
from locatk.core.lighthouse.stream import LighthouseStream
from locatk.core.lighthouse.stream.known_scene import AngleCorrection
from locatk.core.lighthouse.stream.scene_search import SceneResult, align_scene, is_better
from locatk.core.streaming.events import (
    ArtifactUpdate,
    BackgroundTask,
    DetectionEvent,
    Fix,
    StreamEvent,
    WarningEvent,
)
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse.suite import read_dotbot
from locatk.formats.published_data import data_folder

Array = NDArray[np.float64]

NOISE_RAD = 1.15e-4
PHOTODIODES = SimulationOptions(
    robots=2, stations=3, planar=False, duration_s=1.5, report_hz=120.0, noise_rad=NOISE_RAD,
    outliers=0.05, seed=3,
)  # fmt: skip
DECKS = SimulationOptions(
    robots=2, planar=False, duration_s=1.0, report_hz=120.0, noise_rad=NOISE_RAD, receiver=DECK,
    seed=1,
)  # fmt: skip
CERTAIN = np.diag([1e-12] * 6)


_SESSIONS: dict[str, SimulatedSession] = {}


def simulated(options: SimulationOptions) -> SimulatedSession:
    """Simulate a session, whose true scene is certain."""
    if repr(options) not in _SESSIONS:
        _SESSIONS[repr(options)] = _simulate(options)
    return _SESSIONS[repr(options)]


def _simulate(options: SimulationOptions) -> SimulatedSession:
    session = simulate(options)
    stations = tuple(replace(s, covariance=CERTAIN) for s in session.true_scene.stations)
    return replace(session, true_scene=replace(session.true_scene, stations=stations))


def receivers(session: SimulatedSession) -> dict[str, Receiver]:
    return dict.fromkeys(session.sweeps.devices, DECK)


def cut(sweeps: Sweeps, edges: Sequence[int] | None = None) -> list[Sweeps]:
    """Cut sweeps at some rows; by default, every eight."""
    rows = np.arange(0, len(sweeps), 8)[1:] if edges is None else np.array(edges, int)
    bounds = [0, *rows.tolist(), len(sweeps)]
    return [sweeps.take(np.arange(a, b)) for a, b in pairwise(bounds)]


def run(stream: LighthouseStream, pieces: Sequence[Sweeps]) -> list[StreamEvent]:
    events = [event for piece in pieces for event in stream.push(piece)]
    return [*events, *stream.finish()]


def fixes_of(events: Sequence[Any], device: str | None = None) -> list[Fix]:
    return [e for e in events if isinstance(e, Fix) and device in (None, e.device)]


def codes(events: Sequence[Any]) -> list[str]:
    return [e.warning.code for e in events if isinstance(e, WarningEvent)]


def true_position(session: SimulatedSession, fix: Fix) -> Array:
    truth = next(t for t in session.truth if t.device == fix.device)
    axes = (np.interp(fix.time_ns, truth.time_ns, axis) for axis in truth.position.T)
    return np.array(list(axes))


def errors_of(session: SimulatedSession, fixes: Sequence[Fix]) -> Array:
    return np.array([fix.position - true_position(session, fix) for fix in fixes])


def everything(event: Any) -> tuple[Any, ...]:
    """Return the content of an event, bit for bit."""
    return tuple(
        value.tobytes() if isinstance(value := getattr(event, f.name), np.ndarray) else value
        for f in fields(event)
    )


# ---- independence of the cut


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_results_do_not_depend_on_how_sweeps_of_photodiodes_are_cut(data: st.DataObject) -> None:
    session = simulated(PHOTODIODES)
    n = len(session.sweeps)
    edges = sorted(data.draw(st.lists(st.integers(0, n), max_size=60)))
    whole = run(LighthouseStream(session.true_scene), [session.sweeps])
    parts = run(LighthouseStream(session.true_scene), cut(session.sweeps, edges))
    assert len(fixes_of(whole)) > 100
    assert [everything(e) for e in parts] == [everything(e) for e in whole]


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_results_do_not_depend_on_how_sweeps_of_devices_are_cut(data: st.DataObject) -> None:
    session = simulated(DECKS)
    n = len(session.sweeps)
    edges = sorted(data.draw(st.lists(st.integers(0, n), max_size=60)))
    known = receivers(session)
    whole = run(LighthouseStream(session.true_scene, known.get), [session.sweeps])
    parts = run(LighthouseStream(session.true_scene, known.get), cut(session.sweeps, edges))
    assert len(fixes_of(whole)) > 40
    assert [everything(e) for e in parts] == [everything(e) for e in whole]


@pytest.mark.slow
def test_each_sweep_alone_gives_the_same_as_all_at_once() -> None:
    session = simulated(PHOTODIODES)
    whole = run(LighthouseStream(session.true_scene), [session.sweeps])
    single = run(
        LighthouseStream(session.true_scene), cut(session.sweeps, range(1, len(session.sweeps)))
    )
    assert [everything(e) for e in single] == [everything(e) for e in whole]


# ---- photodiodes


@pytest.mark.slow
def test_fixes_of_photodiodes_are_right_within_their_covariance() -> None:
    options = replace(PHOTODIODES, outliers=0.0, stations=2, duration_s=6.0, robots=3)
    session = simulated(options)
    fixes = fixes_of(run(LighthouseStream(session.true_scene), cut(session.sweeps)))
    # Each pair of a station gives a fix: 50 and 50.2 rotations a second, two robots all the time.
    assert len(fixes) > 2 * 6.0 * 90
    errors = errors_of(session, fixes)
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.8e-3
    covariance = np.stack([fix.covariance[:3, :3] for fix in fixes])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors)
    # Two fixes share each pair, and the noise of a fix is doubled for it.
    assert 0.6 < np.mean(nees) < 2.0
    for fix in fixes[:5]:
        assert np.isnan(fix.covariance[3:]).all()
        np.testing.assert_array_equal(fix.quaternion, [0, 0, 0, 1])


@pytest.mark.slow
def test_the_mean_of_successive_fixes_has_the_covariance_of_independent_ones() -> None:
    options = replace(PHOTODIODES, outliers=0.0, stations=2, duration_s=8.0, robots=4)
    session = simulated(options)
    events = run(LighthouseStream(session.true_scene), cut(session.sweeps))
    nees = []
    for device in session.sweeps.devices[1:]:
        fixes = fixes_of(events, device)
        errors = errors_of(session, fixes)
        for k in range(0, len(fixes) - 10, 10):
            mean = errors[k : k + 10].mean(axis=0)
            own = np.sum([f.covariance[:3, :3] for f in fixes[k : k + 10]], axis=0) / 100
            nees.append(mean @ np.linalg.solve(own, mean))
    assert 1.5 < np.mean(nees) < 4.5  # three degrees of freedom


def test_a_fix_comes_with_the_last_sweep_that_it_needs() -> None:
    session = simulated(replace(PHOTODIODES, outliers=0.0, robots=1))
    stream = LighthouseStream(session.true_scene)
    delays_ns = []
    for piece in cut(session.sweeps, range(1, len(session.sweeps))):
        now_ns = int(piece.time_ns[0])
        delays_ns += [now_ns - fix.time_ns for fix in fixes_of(stream.push(piece))]
    # The mean time of three pairs, the last of which has just come.
    assert len(delays_ns) > 100
    assert 3e6 < np.median(delays_ns) < 16e6
    assert np.percentile(delays_ns, 95) < 22e6


def test_motion_between_the_sweeps_of_a_fix_is_corrected() -> None:
    """Without it, a robot at 0.5 m/s would be off by millimetres."""
    session = simulated(replace(PHOTODIODES, outliers=0.0, noise_rad=0.0, stations=2, robots=2))
    fixes = fixes_of(run(LighthouseStream(session.true_scene), cut(session.sweeps)), "robot-2")
    errors = np.linalg.norm(errors_of(session, fixes), axis=1)
    speed = np.linalg.norm(np.diff([f.position for f in fixes[::10]], axis=0), axis=1).max() / 0.1
    assert speed > 0.1
    assert np.percentile(errors[5:], 95) < 0.1e-3


@pytest.mark.slow
def test_fixes_are_those_of_the_offline_solver_for_reports() -> None:
    session = simulated(replace(PHOTODIODES, report_hz=10.0, duration_s=12.0, outliers=0.0))
    assert_agrees_with_offline(session.sweeps, session.true_scene, min_share=0.97)


def assert_agrees_with_offline(sweeps: Sweeps, scene: Scene, min_share: float) -> None:
    """Compare fixes with the positions of the offline solver at the same times."""
    offline = solve(sweeps, scene)
    order = np.argsort(sweeps.time_ns, kind="stable")
    live = defaultdict(list)
    for fix in fixes_of(run(LighthouseStream(scene), cut(sweeps.take(order)))):
        live[fix.device].append(fix)
    ratio, number = [], 0
    for track in offline.trajectories:
        number += len(track)
        time_ns = np.array([fix.time_ns for fix in live[track.device]])
        for own_ns, position in zip(track.time_ns.tolist(), track.position, strict=True):
            k = int(np.argmin(np.abs(time_ns - own_ns)))
            if abs(time_ns[k] - own_ns) <= 1000:
                fix = live[track.device][k]
                sigma_m = np.sqrt(np.trace(fix.covariance[:3, :3]))
                ratio.append(np.linalg.norm(fix.position - position) / sigma_m)
    assert len(ratio) >= min_share * number
    assert np.percentile(ratio, 95) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recording", "truth"),
    [
        ("twoLH-2D_scene/dataset/lighthouse/data.csv", ()),
        (
            "oneLH-2D_scene/dataset/lighthouse/1_lh2.csv",
            ("oneLH-2D_scene/dataset/ground_truth/1_blender.csv",),
        ),
    ],
)
def test_fixes_are_those_of_the_offline_solver_on_published_recordings(
    recording: str, truth: tuple[str, ...]
) -> None:
    folder = data_folder()
    if folder is None or not (folder / "lighthouse" / recording).exists():
        pytest.skip("the published recordings are not there: set LOCATK_DATA")
    base = folder / "lighthouse"
    session = read_dotbot([base / recording], [base / name for name in truth])
    scene = solve(session.sweeps, session.scene if truth else None).artifact
    assert_agrees_with_offline(session.sweeps, scene, min_share=0.99)


@pytest.mark.slow
def test_outliers_are_rejected_and_counted() -> None:
    session = simulated(replace(PHOTODIODES, outliers=0.1, duration_s=3.0, robots=3))
    stream = LighthouseStream(session.true_scene)
    fixes = fixes_of(run(stream, cut(session.sweeps)))
    errors = np.linalg.norm(errors_of(session, fixes), axis=1)
    assert np.percentile(errors, 98) < 5e-3
    assert stream.rejected["moment_inconsistent"] > 10
    assert stream.rejected["station_contradicts_others"] > 10


def test_wrong_numbers_are_rejected_by_reason() -> None:
    session = simulated(PHOTODIODES)
    sweeps = session.sweeps.take(np.arange(4))
    wrong = replace(
        sweeps,
        channel=np.array([0, 17, 1, 16], np.int32),
        count=np.array([1.0, 1.0, 1e7, 5.0]),
    )
    stream = LighthouseStream(session.true_scene)
    assert stream.push(wrong) == []
    assert stream.rejected == {
        "unknown_channel": 2, "count_above_period": 1, "station_not_in_scene": 1,
    }  # fmt: skip


def test_a_position_that_jumps_is_held_back_until_others_confirm_it() -> None:
    session = simulated(replace(PHOTODIODES, robots=1, stations=2, outliers=0.0))
    scene = replace(session.true_scene, planar=True, floor_z=0.0)
    stations = scene.stations

    def report(time_s: float, position: Array) -> Sweeps:
        counts, channels = [], []
        for station in stations:
            local = (position - station.position) @ station.rotation
            turns = (predict_angles(local, station.calibration) / (2 * np.pi)) + [1 / 3, 2 / 3]
            counts += (turns * period_counts(station.channel)).tolist()
            channels += [station.channel] * 2
        n = len(counts)
        time_ns = int(1e18 + 1e9 * time_s)
        return Sweeps(
            ("robot",), np.full(n, time_ns), np.zeros(n, np.int32), np.zeros(n, np.int32),
            np.array(channels, np.int32), np.full(n, UNKNOWN), np.full(n, UNKNOWN),
            np.array(counts),
        )  # fmt: skip

    stream = LighthouseStream(scene)
    here, there = np.array([0.1, 0.0, 0.0]), np.array([0.6, 0.3, 0.0])
    number = [
        len(fixes_of(stream.push(report(0.1 * k, there if k in (5, 10, 11, 12, 13) else here))))
        for k in range(14)
    ]
    assert number == [1, 1, 1, 1, 1, 0, 1, 1, 1, 1, 0, 0, 1, 1]
    assert stream.rejected["moment_jumps"] == 3


@pytest.mark.slow
def test_a_hidden_station_does_not_stop_fixes() -> None:
    session = simulated(replace(PHOTODIODES, outliers=0.0, duration_s=6.0))
    sweeps = session.sweeps.take(session.sweeps.device == 1)
    start_ns = int(sweeps.time_ns[0])
    kept = sweeps.take((sweeps.channel != 2) | (sweeps.time_ns < start_ns + int(1e9)))
    events = run(LighthouseStream(session.true_scene), cut(kept))
    fixes = fixes_of(events)
    late = [f for f in fixes if f.time_ns > start_ns + 1.1e9]
    assert len(late) / 4.9 > 45
    # Fixes go on while the station is still waited for, one for each rotation.
    waiting = [f for f in fixes if 1.05e9 < f.time_ns - start_ns < 1.45e9]
    assert 17 <= len(waiting) <= 30
    hidden = [e for e in events if isinstance(e, WarningEvent)]
    assert [e.warning.code for e in hidden] == ["station_hidden"]
    assert "channel 2" in hidden[0].warning.message
    assert 2.9e9 < hidden[0].time_ns - start_ns < 4.5e9


def test_time_alone_completes_the_fix_of_the_stations_that_are_left() -> None:
    session = simulated(replace(PHOTODIODES, outliers=0.0, robots=1))
    stream = LighthouseStream(session.true_scene)
    half = len(session.sweeps) // 2
    first = session.sweeps.take(np.arange(half))
    stream.push(first)
    end_ns = int(first.time_ns[-1])
    rest = session.sweeps.take(np.arange(half, half + 40))
    rest = rest.take(rest.channel != 3)
    assert len(fixes_of(stream.push(rest.take(np.arange(8))))) <= 2
    assert stream.advance(end_ns) == []
    assert len(fixes_of(stream.advance(end_ns + 100_000_000))) == 1
    assert fixes_of(stream.advance(end_ns + 200_000_000)) == []


@pytest.mark.slow
def test_a_moved_station_is_found_and_left_out() -> None:
    turn = np.radians(2.0)
    options = replace(
        PHOTODIODES, stations=4, outliers=0.0, robots=2, duration_s=16.0, station_turn_rad=turn
    )
    session = simulated(options)
    stream = LighthouseStream(session.true_scene)
    events: list[StreamEvent] = []
    rejected = []
    for piece in cut(session.sweeps):
        events += stream.push(piece)
        if "wrong_station" in codes(events):
            rejected.append(stream._photodiodes.rejected[3])
    events += stream.finish()
    assert len(rejected) > 100
    assert rejected[0] == rejected[-1]
    start_ns = int(session.sweeps.time_ns[0])
    moved = [e for e in events if isinstance(e, WarningEvent) and e.warning.code == "wrong_station"]
    assert len(moved) == 1
    assert "channel 4" in moved[0].warning.message
    assert 11.5e9 < moved[0].time_ns - start_ns < 14.5e9  # the second verification
    after = [f for f in fixes_of(events) if f.time_ns > moved[0].time_ns]
    assert len(after) > 100
    assert np.percentile(np.linalg.norm(errors_of(session, after), axis=1), 99) < 3e-3
    before = [f for f in fixes_of(events) if f.time_ns < start_ns + 8e9]
    assert np.percentile(np.linalg.norm(errors_of(session, before), axis=1), 99) < 3e-3
    detections = [e.detection for e in events if isinstance(e, DetectionEvent)][-4:]
    assert [d.channel for d in detections] == [1, 2, 3, 4]
    assert detections[3].sweeps < 0.8 * detections[0].sweeps


# ---- rigid devices


@pytest.mark.slow
def test_poses_of_devices_are_right_within_their_covariance() -> None:
    session = simulated(replace(DECKS, duration_s=4.0))
    events = run(LighthouseStream(session.true_scene, receivers(session).get), cut(session.sweeps))
    fixes = fixes_of(events, "robot-2")
    assert len(fixes) > 45 * 4.0
    errors = errors_of(session, fixes)
    assert np.percentile(np.linalg.norm(errors, axis=1), 95) < 1.5e-3
    nees = [
        e @ np.linalg.solve(f.covariance[:3, :3], e) for e, f in zip(errors, fixes, strict=True)
    ]
    assert 0.5 < np.mean(nees) < 3.0
    truth = next(t for t in session.truth if t.device == "robot-2")
    heading = 2 * np.arctan2(truth.quaternion[:, 2], truth.quaternion[:, 3])
    true = np.interp([f.time_ns for f in fixes], truth.time_ns, np.unwrap(heading))
    rotations = matrix_from_quaternion(np.stack([f.quaternion for f in fixes]))
    estimated = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    difference = np.angle(np.exp(1j * (estimated - true)))
    assert np.percentile(np.abs(difference), 95) < np.radians(4.0)
    sigma = np.array([np.sqrt(f.covariance[5, 5]) for f in fixes])
    assert 0.5 < np.sqrt(np.mean((difference / sigma) ** 2)) < 1.3


@pytest.mark.slow
def test_poses_of_devices_agree_with_the_offline_solver() -> None:
    session = simulated(DECKS)
    events = run(LighthouseStream(session.true_scene, receivers(session).get), cut(session.sweeps))
    offline = solve_devices(session.sweeps, receivers(session), session.true_scene)
    # Robot 1 is hidden while it is carried from marker to marker.
    track = next(t for t in offline.trajectories if t.device == "robot-2")
    fixes = fixes_of(events, "robot-2")
    assert len(fixes) > 0.9 * len(track)
    for fix in fixes[2:-2]:
        position = [np.interp(fix.time_ns, track.time_ns, axis) for axis in track.position.T]
        sigma_m = np.sqrt(np.trace(fix.covariance[:3, :3]))
        assert np.linalg.norm(fix.position - position) < 3 * sigma_m


@pytest.mark.slow
def test_a_reflected_station_is_left_out_of_poses() -> None:
    """One plane of its reflection always agrees with some pose, which is wrong by decimetres."""
    session = simulated(
        replace(DECKS, duration_s=12.0, reflections=0.08, occlusion=0.1, outliers=0.03, seed=2)
    )
    stream = LighthouseStream(session.true_scene, receivers(session).get)
    fixes = fixes_of(run(stream, cut(session.sweeps)))
    assert stream.rejected["sweep_contradicts_pose"] > 20
    assert len(fixes) > 800
    errors = np.linalg.norm(errors_of(session, fixes), axis=1)
    sigma = np.array([np.sqrt(np.trace(f.covariance[:3, :3])) for f in fixes])
    assert np.mean(errors > 6 * sigma) < 0.018


# ---- scene in the background


@pytest.mark.slow
def test_a_scene_is_estimated_after_the_first_seconds() -> None:
    session = simulated(
        replace(PHOTODIODES, outliers=0.0, planar=True, report_hz=10.0, duration_s=14.0, stations=2)
    )
    stream = LighthouseStream(None)
    events: list[StreamEvent] = []
    tasks: list[BackgroundTask] = []
    for piece in cut(session.sweeps):
        events += stream.push(piece)
        task = stream.background_task()
        if task is not None:
            assert stream.background_task() is None
            function, arguments = pickle.loads(pickle.dumps((task.function, task.arguments)))
            events += stream.complete(task, function(*arguments))
            tasks.append(task)
    start_ns = int(session.sweeps.time_ns[0])
    updates = [e for e in events if isinstance(e, ArtifactUpdate)]
    assert updates[0].version == 1
    assert [u.version for u in updates] == list(range(1, len(updates) + 1))
    assert 5e9 <= updates[0].time_ns - start_ns < 6e9
    assert len(updates[0].artifact.stations) == 2
    assert len(tasks) == 2
    assert len(tasks[1].arguments[0]) > len(tasks[0].arguments[0])
    fixes = fixes_of(events)
    assert min(f.time_ns for f in fixes) > start_ns + 4.9e9
    assert len(fixes) > 100
    assert "unit_scale" in codes(events)
    assert stream.scene is updates[-1].artifact


def test_what_a_scene_lacks_is_said_once() -> None:
    session = simulated(
        replace(PHOTODIODES, outliers=0.0, report_hz=10.0, stations=1, duration_s=12.0)
    )
    stream = LighthouseStream(None)
    events: list[StreamEvent] = []
    attempts_ns = []
    for piece in cut(session.sweeps):
        events += stream.push(piece)
        task = stream.background_task()
        if task is not None:
            attempts_ns.append(int(piece.time_ns[-1] - session.sweeps.time_ns[0]))
            with pytest.raises(DegenerateError) as error:
                task.function(*task.arguments)
            events += stream.complete(task, error.value)
    assert len(attempts_ns) == 2
    assert codes(events) == ["scene_not_estimated"]
    warning = next(e for e in events if isinstance(e, WarningEvent)).warning
    assert "marker" in warning.message
    assert not fixes_of(events)


def as_design(session: SimulatedSession, seed: int) -> Scene:
    """Return the true stations, beside which these were mounted within 20 mm and 1.5 degrees."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([0.02, np.radians(1.5)], 3)
    stations = []
    for station in session.true_scene.stations:
        error = rng.normal(0, sigma)
        position = station.position + error[:3]
        rotation = rotation_exp(error[3:]) @ station.rotation
        stations.append(replace(station, position=position, rotation=rotation, covariance=None))
    return Scene(tuple(stations), planar=True, scale="design", frame="room", frame_source="design")


def test_designed_stations_are_used_until_they_are_estimated() -> None:
    session = simulated(
        replace(PHOTODIODES, outliers=0.0, planar=True, report_hz=10.0, duration_s=10.0)
    )
    stream = LighthouseStream(as_design(session, 1))
    events: list[StreamEvent] = []
    for piece in cut(session.sweeps):
        events += stream.push(piece)
        task = stream.background_task()
        if task is not None:
            events += stream.complete(task, task.function(*task.arguments))
    (update,) = [e for e in events if isinstance(e, ArtifactUpdate)]
    fixes = fixes_of(events)
    before = [f for f in fixes if f.time_ns < update.time_ns]
    after = [f for f in fixes if f.time_ns > update.time_ns]
    assert {f.frame for f in fixes} == {"room"}
    assert len(before) > 0.5 * len(after)
    assert before[0].time_ns - session.sweeps.time_ns[0] < 0.5e9
    for chosen in (before, after):
        error = errors_of(session, chosen)[:, :2]
        own = np.array([f.covariance[:2, :2] for f in chosen])
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(own), error) / 2
        assert np.mean(nees) < 3  # One draw of the mounting, common to all.
        assert np.median(np.sqrt(own[:, 0, 0])) > 0.008  # That of the frame is included.
    spread = [np.std(errors_of(session, chosen)[:, :2], axis=0).max() for chosen in (before, after)]
    assert spread[1] < 0.006 < spread[0]
    assert not {"station_contradicts_others", "scene_contradicted"} & set(codes(events))
    assert "frame_of_design" in codes(events)


def test_designed_stations_stay_in_use_if_they_cannot_be_estimated() -> None:
    session = simulated(
        replace(PHOTODIODES, outliers=0.0, planar=True, stations=1, report_hz=10.0, duration_s=7.0)
    )
    stream = LighthouseStream(as_design(session, 2))
    events: list[StreamEvent] = []
    for piece in cut(session.sweeps):
        events += stream.push(piece)
        task = stream.background_task()
        if task is not None:
            with pytest.raises(DegenerateError) as error:
                task.function(*task.arguments)
            events += stream.complete(task, error.value)
    assert len(fixes_of(events)) > 60
    (warning,) = [
        e.warning
        for e in events
        if isinstance(e, WarningEvent) and e.warning.code == "scene_not_estimated"
    ]
    assert "designed poses" in warning.message


@pytest.mark.slow
def test_notes_of_a_scene_are_said_with_the_first_sweep() -> None:
    session = simulated(PHOTODIODES)
    scene = replace(session.true_scene, notes=("stations were measured by hand",))
    stream = LighthouseStream(scene)
    assert not stream.advance(int(session.sweeps.time_ns[0]))
    events = [event for piece in cut(session.sweeps) for event in stream.push(piece)]
    (note,) = [event for event in events if codes([event]) == ["scene_assumption"]]
    assert note.time_ns == int(session.sweeps.time_ns[0])


def test_an_error_of_the_program_is_not_hidden() -> None:
    task = BackgroundTask("scene", len)
    with pytest.raises(ZeroDivisionError):
        LighthouseStream(None).complete(task, ZeroDivisionError("division"))


def test_a_later_scene_replaces_an_earlier_one_only_if_it_is_better() -> None:
    scene = simulated(PHOTODIODES).true_scene
    worse = replace(
        scene, stations=tuple(replace(s, covariance=4 * CERTAIN) for s in scene.stations)
    )
    assert is_better(scene, worse)
    assert not is_better(worse, scene)
    assert not is_better(scene, scene)
    fewer = replace(scene, stations=scene.stations[:2])
    assert is_better(worse, replace(worse, stations=worse.stations[:2]))
    assert not is_better(fewer, worse)
    assert is_better(worse, replace(scene, scale="unit"))
    assert not is_better(replace(scene, scale="unit"), worse)
    stream = LighthouseStream(None)
    task = BackgroundTask("scene", len)
    assert [e.version for e in stream.complete(task, SceneResult(worse, ()))] == [1]  # type: ignore[union-attr]
    assert stream.complete(task, SceneResult(worse, ())) == []
    turn = Similarity(1.0, rotation_exp(np.array([0.0, 0.0, 2.0])), np.array([1.0, -2.0, 0.0]))
    events = stream.complete(task, SceneResult(scene.transformed(turn), ()))
    assert [e.version for e in events] == [2]  # type: ignore[union-attr]
    assert stream.scene is not None
    for station, before in zip(stream.scene.stations, scene.stations, strict=True):
        np.testing.assert_allclose(station.position, before.position, atol=1e-9)


def test_a_later_scene_is_in_the_frame_of_the_earlier_one() -> None:
    scene = replace(simulated(PHOTODIODES).true_scene, frame_source="station", planar=False)
    turn = Similarity(1.0, rotation_exp(np.array([0.2, -0.1, 2.0])), np.array([1.0, -2.0, 0.5]))
    back = align_scene(scene.transformed(turn), scene)
    for a, b in zip(back.stations, scene.stations, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1e-9)
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-9)
    # The axes of a level scene stay vertical.
    level = align_scene(replace(scene, frame_source="floor").transformed(turn), scene)
    tilt = level.stations[0].rotation[2] - (turn.rotation @ scene.stations[0].rotation)[2]
    np.testing.assert_allclose(tilt, 0.0, atol=1e-12)
    measured = replace(scene.transformed(turn), frame_source="markers")
    assert align_scene(measured, scene) is measured


# ---- memory


def sizes(thing: Any, seen: set[int] | None = None) -> int:
    """Return the number of objects in containers that a stream holds."""
    seen = set() if seen is None else seen
    if id(thing) in seen or isinstance(thing, str | bytes | int | float | np.ndarray | Receiver):
        return 0
    seen.add(id(thing))
    if isinstance(thing, dict):
        return len(thing) + sum(sizes(v, seen) for v in thing.values())
    if isinstance(thing, list | tuple | set) or type(thing).__name__ == "deque":
        return len(thing) + sum(sizes(v, seen) for v in thing)
    slots = [getattr(thing, name) for name in getattr(thing, "__slots__", ())]
    return sum(sizes(v, seen) for v in [*getattr(thing, "__dict__", {}).values(), *slots])


def repeated(sweeps: Sweeps, times: int, period_ns: int) -> list[Sweeps]:
    return [replace(sweeps, time_ns=sweeps.time_ns + k * period_ns) for k in range(times)]


@pytest.mark.slow
@pytest.mark.parametrize("has_scene", [True, False])
def test_memory_does_not_grow_with_the_length_of_the_input(
    has_scene: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from locatk.core.lighthouse.stream import scene_search

    monkeypatch.setattr(scene_search, "MAX_SWEEPS", 4000)
    session = simulated(replace(PHOTODIODES, outliers=0.02, duration_s=2.0))
    stream = LighthouseStream(session.true_scene if has_scene else None)
    grown = []
    for k, piece in enumerate(repeated(session.sweeps, 40, 2_500_000_000)):
        stream.push(piece)
        if k >= 14:
            grown.append(sizes(stream))
    # The last pieces do not hold more than the first ones that fill the buffers.
    assert max(grown[-8:]) <= 1.2 * max(grown[:8])


@pytest.mark.slow
def test_devices_that_are_gone_are_forgotten() -> None:
    session = simulated(replace(PHOTODIODES, robots=1, outliers=0.0))
    stream = LighthouseStream(session.true_scene)
    for k in range(5):
        own = replace(session.sweeps.take(np.arange(60)), devices=(f"robot {k}",))
        stream.push(replace(own, time_ns=own.time_ns + k * 50_000_000_000))
    assert len(stream._photodiodes._states) <= 3


# ---- parts


def test_the_table_of_corrections_agrees_with_the_iteration() -> None:
    session = simulated(PHOTODIODES)
    calibration = session.true_scene.stations[0].calibration
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-1, 1, (2, 500)) * [[1.05], [0.7]]
    points = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    angles = predict_angles(points, calibration)
    table = AngleCorrection(calibration)
    ideal = np.array([table.ideal(a, b) for a, b in angles])
    assert np.abs(ideal - angles).max() > 1e-3
    np.testing.assert_allclose(ideal, ideal_angles(angles, calibration), atol=3e-6)
    assert np.isnan(table.ideal(2.0, 2.0)).all()


@pytest.mark.slow
def test_odometry_gives_the_scale_of_an_estimated_scene() -> None:
    session = simulated(
        replace(PHOTODIODES, outliers=0.0, planar=True, report_hz=10.0, duration_s=8.0, stations=2)
    )
    truth = session.truth[1]
    stream = LighthouseStream(None)
    half = len(truth) // 2
    for rows in (slice(0, half), slice(half, None)):
        stream.push(
            Trajectory(
                truth.device, "odometry", truth.time_ns[rows], truth.position[rows],
                truth.quaternion[rows], truth.covariance[rows],
            )
        )  # fmt: skip
    stream.push(session.sweeps)
    task = stream.background_task()
    assert task is not None
    result = task.function(*task.arguments)
    assert result.scene.scale == "odometry"
    apart = np.linalg.norm(result.scene.stations[0].position - result.scene.stations[1].position)
    true = session.true_scene.stations
    assert apart == pytest.approx(np.linalg.norm(true[0].position - true[1].position), rel=0.05)


# ---- damaged sweeps


def sweeps_of(rows: Sequence[tuple[int, int, int, float]]) -> Sweeps:
    """Return sweeps of one photodiode from rows of time, channel, plane and count."""
    time_ns, channel, plane, count = (np.array(column) for column in zip(*rows, strict=True))
    none = np.zeros(len(rows), np.int32)
    return Sweeps(("robot",), time_ns, none, none, channel, none - 1, plane, count.astype(float))


def test_three_sweeps_with_one_time_stamp_leave_no_pair() -> None:
    session = simulated(PHOTODIODES)
    stream = LighthouseStream(session.true_scene)
    channel = session.true_scene.stations[0].channel
    third = int(period_counts(channel) / 3)
    at = 1_000_000_000
    counts = [1000, 1000 + third, 1010 + third]
    stream.push(sweeps_of([(at, channel, UNKNOWN, count) for count in counts]))
    stream.advance(at + 10_000_000_000)
    assert stream.rejected["plane_unknown"] == 3
    later = session.sweeps
    assert fixes_of(run(stream, [later]))


def test_unknown_planes_are_counted() -> None:
    session = simulated(DECKS)
    stream = LighthouseStream(session.true_scene, receivers(session).get)
    planes = np.full(len(session.sweeps), 2, np.int32)
    assert not fixes_of(run(stream, [replace(session.sweeps, sweep=planes)]))
    assert stream.rejected["plane_unknown"] == len(session.sweeps)


@pytest.mark.slow
@pytest.mark.parametrize("options", [PHOTODIODES, DECKS], ids=["photodiodes", "decks"])
def test_fixes_go_on_after_a_clock_was_set_back(options: SimulationOptions) -> None:
    session = simulated(options)
    known = receivers(session) if options is DECKS else {}
    stream = LighthouseStream(session.true_scene, known.get)
    expected = len(fixes_of(stream.push(session.sweeps)))
    earlier = replace(session.sweeps, time_ns=session.sweeps.time_ns - 3600 * 10**9)
    assert len(fixes_of(stream.push(earlier))) > 0.9 * expected
