"""Streams of all systems with faults that inputs can have: no exception, and valid poses."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.frames import Frames
from locatk.core.dots.simulation import session as dots_session
from locatk.core.dots.solver import SolveOptions as DotsOptions
from locatk.core.dots.stream import DotsStream
from locatk.core.geometry import quaternion_from_heading
from locatk.core.inertial import InertialSamples
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.simulation import session as landmarks_session
from locatk.core.landmarks.stream import LandmarksStream
from locatk.core.lighthouse import simulation as lighthouse_session
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.stream import LighthouseStream
from locatk.core.polaris.simulation import session as polaris_session
from locatk.core.polaris.stream import PolarisStream
from locatk.core.streaming.events import Fix, LiveEvent, PoseEstimate, Stream, TrackingState
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.core.streaming.tracker import DeviceTracker
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

SECOND_NS = 1_000_000_000

MAX_BYTES = 64_000_000
"""Limit of the memory of a localizer of a few devices."""


# ---- sessions


@dataclass(frozen=True)
class Case:
    """Simulated session of a system: its stream, and observations of one time each, in order."""

    stream: Callable[[], Stream]
    pieces: tuple[Any, ...]


def times(observations: Any) -> NDArray[np.int64]:
    stamps: NDArray[np.int64] = observations.time_ns
    return stamps


def select(observations: Any, rows: NDArray[np.int64]) -> Any:
    """Return some rows of observations of any kind."""
    if isinstance(observations, Sweeps):
        return observations.take(rows)
    if isinstance(observations, Trajectory):
        return observations.select(rows)
    if isinstance(observations, Frames):
        images = [observations.images[k] for k in rows]
        names = tuple(observations.names[k] for k in rows)
        return Frames(observations.device, observations.time_ns[rows], names, images)
    count = len(observations)
    columns = {
        each.name: value[rows]
        for each in fields(observations)
        if isinstance(value := getattr(observations, each.name), np.ndarray) and len(value) == count
    }
    return replace(observations, **columns)


def in_order(*recordings: Any) -> tuple[Any, ...]:
    """Return observations of one time each, in the order of time."""
    pieces = [
        select(each, np.flatnonzero(each.time_ns == time_ns))
        for each in recordings
        for time_ns in np.unique(each.time_ns)
    ]
    return tuple(sorted(pieces, key=lambda piece: int(piece.time_ns[0])))


@functools.cache
def case(name: str) -> Case:
    """Simulate a short session of a system."""
    if name == "landmarks":
        floor = FloorMap(np.random.default_rng(11).integers(0, 16, (12, 12)))
        options = landmarks_session.SimulationOptions(
            strategy="path", cells=((2, 2), (2, 5), (4, 5)), rate_hz=50.0, stop_s=0.1, seed=1,
            aims=landmarks_session.Aims(),
        )  # fmt: skip
        drive = landmarks_session.simulate(floor, options)
        pieces = in_order(drive.samples[0], drive.odometry[0])
        return Case(lambda: LandmarksStream(floor), pieces)
    if name == "polaris":
        car = polaris_session.CARS["mini"]
        options_of_pass = polaris_session.SimulationOptions(
            array=polaris_session.usual_bar(car.sensors, car.spacing_m, 100.0),
            rate_hz=100.0, speed_mps=0.1, odometry=True,
        )  # fmt: skip
        session = polaris_session.simulate(car.tags, options_of_pass)
        recordings = [each for each in (session.samples, session.odometry) if each is not None]
        return Case(lambda: PolarisStream(session.tags), in_order(*recordings))
    if name == "dots":
        frames = dots_session.simulate(None, dots_session.SimulationOptions(frames=12))
        options_of_dots = DotsOptions(camera=Camera((188, 120), 348.7, (93.5, 59.5)))
        return Case(lambda: DotsStream(frames.manifest, options_of_dots), in_order(frames.frames))
    is_rigid = name == "rigid"
    sweeps = lighthouse_session.simulate(
        lighthouse_session.SimulationOptions(
            robots=2, stations=2 if is_rigid else 3, planar=False, duration_s=1.0, report_hz=60.0,
            receiver=DECK if is_rigid else None, imu_hz=100.0, seed=3,
        )
    )  # fmt: skip
    receivers = dict.fromkeys(sweeps.sweeps.devices, DECK) if is_rigid else {}
    return Case(
        lambda: LighthouseStream(sweeps.true_scene, receivers.get),
        in_order(sweeps.sweeps, *sweeps.imu),
    )


# ---- faults


def faulty(pieces: Sequence[Any], rng: np.random.Generator, count: int) -> list[Any]:
    """Return observations with some faults, and times up to which no other one is missing."""
    result = list(pieces)
    for _ in range(count):
        if result:
            FAULTS[rng.integers(len(FAULTS))](result, rng)
    return result


def stretch(pieces: Sequence[Any], rng: np.random.Generator) -> tuple[int, int]:
    """Return a random range of indices."""
    first = int(rng.integers(len(pieces)))
    return first, min(len(pieces), first + int(2 ** rng.uniform(0, 7)))


def is_time(piece: Any) -> bool:
    return isinstance(piece, int)


def shifted(piece: Any, shift_ns: int) -> Any:
    if is_time(piece):
        return piece + shift_ns
    return replace(piece, time_ns=piece.time_ns + shift_ns)


def _delay(pieces: list[Any], rng: np.random.Generator) -> None:
    first, last = stretch(pieces, rng)
    late = pieces[first:last]
    del pieces[first:last]
    at = min(first + int(rng.integers(1, 100)), len(pieces))
    pieces[at:at] = late


def _repeat(pieces: list[Any], rng: np.random.Generator) -> None:
    first, last = stretch(pieces, rng)
    pieces[last:last] = pieces[first:last]


def _reverse(pieces: list[Any], rng: np.random.Generator) -> None:
    first, last = stretch(pieces, rng)
    pieces[first:last] = pieces[first:last][::-1]


def _silence(pieces: list[Any], rng: np.random.Generator) -> None:
    """Remove one kind of observations for a while."""
    first, last = stretch(pieces, rng)
    kind = type(pieces[first])
    last = min(len(pieces), first + 4 * (last - first))
    pieces[first:last] = [each for each in pieces[first:last] if type(each) is not kind]


def _pause(pieces: list[Any], rng: np.random.Generator) -> None:
    """Continue after seconds to hours."""
    first, _ = stretch(pieces, rng)
    shift_ns = int(10 ** rng.uniform(9, 13.5))
    pieces[first:] = [shifted(each, shift_ns) for each in pieces[first:]]


def _silence_of_one_kind(pieces: list[Any], rng: np.random.Generator) -> None:
    """Go on with the first observations of one kind for a while, later, and without the other."""
    first, last = stretch(pieces, rng)
    kind = type(pieces[first])
    own = [each for each in pieces[first:last] if type(each) is kind]
    step_ns = int(10 ** rng.uniform(7, 11))
    more = [shifted(each, k * step_ns) for k, each in enumerate(own)]
    total_ns = len(own) * step_ns
    pieces[first:] = more + [shifted(each, total_ns) for each in pieces[first:]]


def _restart_of_clock(pieces: list[Any], rng: np.random.Generator) -> None:
    first, last = stretch(pieces, rng)
    pieces[first:last] = [
        each if is_time(each) else shifted(each, -int(times(each)[0]) + k * 10_000_000)
        for k, each in enumerate(pieces[first:last])
    ]


def _one_far_time(pieces: list[Any], rng: np.random.Generator) -> None:
    first, _ = stretch(pieces, rng)
    pieces[first] = shifted(pieces[first], int(10 ** rng.uniform(9, 17)))


def _jitter(pieces: list[Any], rng: np.random.Generator) -> None:
    first, last = stretch(pieces, rng)
    step_ns = 10 ** rng.uniform(0, 8)
    pieces[first:last] = [shifted(each, int(step_ns * rng.normal())) for each in pieces[first:last]]


def _advance(pieces: list[Any], rng: np.random.Generator) -> None:
    first, _ = stretch(pieces, rng)
    piece = pieces[first]
    time_ns = piece if is_time(piece) else int(times(piece)[-1])
    ahead_ns = int(rng.choice([0, 10**8, 10**9, 10**10, 10**13]) * rng.uniform(-1, 1))
    pieces.insert(first + 1, time_ns + ahead_ns)


VALUES = (np.nan, 0.0, 1.0, -1.0, np.inf, -np.inf, 1e-3, 1e6, 1e200)


def _values(pieces: list[Any], rng: np.random.Generator) -> None:
    """Replace or offset some or all values."""
    first, last = stretch(pieces, rng)
    value = VALUES[rng.integers(len(VALUES))]
    fraction = rng.choice([0.05, 0.5, 1.0])
    is_offset = rng.random() < 0.5
    for k in range(first, last):
        piece = pieces[k]
        if is_time(piece):
            continue
        if isinstance(piece, Frames):
            shape = [(120, 188), (60, 94), (1, 1), (480, 640), (3, 200)][rng.integers(5)]
            grey = rng.integers(0, 256, shape) if is_offset else np.full(shape, rng.integers(256))
            pieces[k] = replace(piece, images=[grey.astype(np.uint8)] * len(piece))
            continue
        changed = {}
        for each in fields(piece):
            old = getattr(piece, each.name)
            is_column = isinstance(old, np.ndarray) and old.ndim and len(old) == len(piece)
            if not is_column or old.dtype != np.float64 or rng.random() < 0.3:
                continue
            chosen = rng.random(old.shape) < fraction
            with np.errstate(all="ignore"):
                changed[each.name] = np.where(chosen, old + value if is_offset else value, old)
        pieces[k] = replace(piece, **changed)


def _numbers(pieces: list[Any], rng: np.random.Generator) -> None:
    """Replace channels, planes and photodiodes of sweeps."""
    first, last = stretch(pieces, rng)
    name = ("channel", "sweep", "sensor", "polynomial")[rng.integers(4)]
    for k in range(first, last):
        if isinstance(pieces[k], Sweeps):
            column = rng.integers(-1, 18, len(pieces[k])).astype(np.int32)
            pieces[k] = replace(pieces[k], **{name: column})


def _odometry(pieces: list[Any], rng: np.random.Generator) -> None:
    """Restart the odometry at zero, or drive fast from here on."""
    first, _ = stretch(pieces, rng)
    start = next((each for each in pieces[first:] if isinstance(each, Trajectory)), None)
    if start is None:
        return
    factor = float(rng.choice([1.0, 20.0, 1e3]))
    pieces[first:] = [
        replace(each, position=factor * (each.position - start.position[:1]))
        if isinstance(each, Trajectory)
        else each
        for each in pieces[first:]
    ]


def _only_one(pieces: list[Any], rng: np.random.Generator) -> None:
    """Remove one kind from here on, except its next one."""
    first, _ = stretch(pieces, rng)
    kind = type(pieces[first])
    pieces[first + 1 :] = [each for each in pieces[first + 1 :] if type(each) is not kind]


FAULTS = (
    _delay,
    _repeat,
    _reverse,
    _silence,
    _pause,
    _silence_of_one_kind,
    _restart_of_clock,
    _one_far_time,
    _jitter,
    _advance,
    _advance,
    _values,
    _values,
    _numbers,
    _odometry,
    _only_one,
)


# ---- promises


def play(localizer: LiveLocalizer, pieces: Sequence[Any]) -> list[LiveEvent]:
    """Return the events of observations, and check all poses."""
    events: list[LiveEvent] = []
    for piece in pieces:
        events += localizer.advance(piece) if is_time(piece) else localizer.push(piece)
    events += localizer.finish()
    check_poses(events)
    return events


def check_poses(events: Sequence[LiveEvent]) -> None:
    """Check that poses are numbers, with valid covariances and ascending times."""
    last_ns: dict[str, int] = {}
    for pose in events:
        if not isinstance(pose, PoseEstimate):
            continue
        assert pose.time_ns > last_ns.get(pose.device, -(2**63)), "times do not ascend"
        last_ns[pose.device] = pose.time_ns
        assert pose.state is not TrackingState.LOST
        assert np.isfinite(pose.position).all(), pose
        assert abs(np.linalg.norm(pose.quaternion) - 1) < 1e-6, pose
        check_covariance(pose.covariance)


def check_covariance(covariance: Array) -> None:
    """Check that a covariance is symmetric and positive definite in the observed components."""
    is_known = np.isfinite(np.diagonal(covariance))
    assert is_known[:2].all()
    known = covariance[np.ix_(is_known, is_known)]
    assert np.isfinite(known).all()
    sigma = np.sqrt(np.diagonal(known))
    assert (sigma > 1e-7).all(), sigma
    correlation = known / np.outer(sigma, sigma)
    np.testing.assert_allclose(correlation, correlation.T, rtol=0, atol=1e-6)
    assert np.linalg.eigvalsh(correlation)[0] > -1e-6


def size_of(root: Any) -> int:
    """Return the size of everything that an object refers to, about [bytes]."""
    seen: dict[int, Any] = {}
    total, todo = 0, [root]
    while todo:
        each = todo.pop()
        if id(each) in seen or callable(each) or isinstance(each, type):
            continue
        seen[id(each)] = each
        total += 64
        if isinstance(each, np.ndarray):
            total += each.nbytes if each.base is None else 0
            todo += [] if each.base is None else [each.base]
        elif isinstance(each, dict):
            todo += [*each.keys(), *each.values()]
        elif isinstance(each, (str, bytes)):
            total += len(each)
        elif hasattr(each, "__len__") and hasattr(each, "__iter__"):
            todo += list(each)
        else:
            todo += list(getattr(each, "__dict__", {}).values())
            names = [slot for kind in type(each).__mro__ for slot in getattr(kind, "__slots__", ())]
            todo += [getattr(each, name, None) for name in names]
            if is_dataclass(each):
                todo += [getattr(each, one.name) for one in fields(each)]
    return total


# ---- streams

MAX_FAULTS = 6

SEEDS = {
    "landmarks": (66,),
    "polaris": (4,),
    "dots": (1, 2, 3),
    "photodiodes": (1, 2),
    "rigid": (8, 18),
}
"""Seeds of faults; those of landmarks, Polaris and rigid devices found errors."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "seed"), [(system, seed) for system, seeds in SEEDS.items() for seed in seeds]
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_faults_of_the_input(system: str, seed: int) -> None:
    session = case(system)
    rng = np.random.default_rng(seed)
    pieces = faulty(session.pieces, rng, int(rng.integers(1, MAX_FAULTS + 1)))
    localizer = LiveLocalizer(session.stream())
    play(localizer, pieces)
    assert size_of(localizer) < MAX_BYTES


@pytest.mark.slow
@pytest.mark.parametrize("system", SEEDS)
def test_observations_after_their_time_was_complete(system: str) -> None:
    """They may be left out, but later ones are used as before."""
    session = case(system)
    middle = len(session.pieces) // 4
    localizer = LiveLocalizer(session.stream())
    pieces = list(session.pieces)
    ahead_ns = int(times(pieces[middle])[-1]) + 300_000_000
    events = play(localizer, [*pieces[:middle], ahead_ns, *pieces[middle:]])
    assert any(isinstance(event, PoseEstimate) for event in events)


# ---- trackers


def drive_of(times_ns: list[int], positions_m: list[float]) -> Trajectory:
    n = len(times_ns)
    position = np.zeros((n, 3))
    position[:, 0] = positions_m
    return Trajectory(
        "robot",
        "odom",
        np.array(times_ns),
        position,
        quaternion_from_heading(np.zeros(n)),
        np.full((n, 6, 6), np.nan),
    )


def fix_at(time_ns: int, x_m: float = 0.0) -> Fix:
    covariance = np.full((6, 6), np.nan)
    plane = np.array([0, 1, 5])
    covariance[plane[:, None], plane] = np.diag([1e-6, 1e-6, 1e-4])
    quaternion = np.array([0.0, 0.0, 0.0, 1.0])
    return Fix("robot", "floor", time_ns, np.array([x_m, 0.0, 0.0]), quaternion, covariance)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e12, 1e200])
@pytest.mark.parametrize("column", ["position", "quaternion"])
def test_a_damaged_pose_of_the_odometry_is_left_out(value: float, column: str) -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    damaged = drive_of([20_000_000], [0.01])
    getattr(damaged, column)[0, 1] = value
    tracker.odometry(drive_of([0, 10_000_000], [0.0, 0.005]))
    assert tracker.odometry(damaged) == []
    events = tracker.odometry(drive_of([30_000_000], [0.015]))
    check_poses(events)
    (pose,) = events
    assert isinstance(pose, PoseEstimate)
    assert pose.position[0] == pytest.approx(0.015, abs=2e-3)
    assert tracker.rejected["bad_motions"] == 1


@pytest.mark.parametrize("variance", [np.inf, 1e200, 1e12])
def test_an_unlimited_variance_of_the_heading_keeps_the_covariance_valid(variance: float) -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    odometry = drive_of([0, 10_000_000, 20_000_000], [0.0, 0.005, 0.01])
    odometry.covariance[:, 5, 5] = [0.0, 0.0, variance]
    events = tracker.odometry(odometry)
    assert len([event for event in events if isinstance(event, PoseEstimate)]) > 1
    check_poses(events)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6, -1e200])
def test_a_damaged_reading_of_an_imu_keeps_the_last_one(value: float) -> None:
    tracker = DeviceTracker("robot")
    n = 30
    samples = InertialSamples(
        "robot",
        10_000_000 * np.arange(n),
        np.tile([0.0, 0.0, 9.80665], (n, 1)),
        np.zeros((n, 3)),
    )
    samples.acceleration[15, 0] = value
    samples.angular_rate[16, 2] = value
    pose = dataclasses.replace(fix_at(50_000_000), covariance=np.diag([1e-6] * 3 + [1e-4] * 3))
    events: list[Any] = []
    for k in range(n):
        events += tracker.inertial(
            InertialSamples(
                "robot",
                samples.time_ns[k : k + 1],
                samples.acceleration[k : k + 1],
                samples.angular_rate[k : k + 1],
            )
        )
        if k == 6:
            events += tracker.fix(pose)
    check_poses(events)
    last = [event for event in events if isinstance(event, PoseEstimate)][-1]
    assert last.time_ns == samples.time_ns[-1]
    assert np.abs(last.position).max() < 0.1


def test_extrapolation_of_samples_that_arrived_together_is_limited() -> None:
    """Two samples a microsecond apart tell no speed."""
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    tracker.odometry(drive_of([0, 100_000_000, 200_000_000, 200_001_000], [0, 0.01, 0.02, 0.03]))
    events = tracker.fix(fix_at(300_000_000, 0.04))
    check_poses(events)
    (pose,) = (event for event in events if isinstance(event, PoseEstimate))
    assert pose.position[0] == pytest.approx(0.04, abs=0.001)
    assert tracker.rejected["refused_fixes"] == 0


def test_covariance_grows_without_fixes() -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    times_ns = [20_000_000 * k for k in range(50)]
    events = tracker.odometry(drive_of(times_ns, [0.005 * k for k in range(50)]))
    poses = [event for event in events if isinstance(event, PoseEstimate)]
    variance = np.array([np.diagonal(pose.covariance)[[0, 1, 5]] for pose in poses])
    assert len(poses) > 40
    assert (np.diff(variance, axis=0) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("system", SEEDS)
def test_common_errors_of_fixes_are_part_of_their_covariance(system: str) -> None:
    session = case(system)
    stream = session.stream()
    events = [event for piece in session.pieces for event in stream.push(piece)]
    fixes = [event for event in [*events, *stream.finish()] if isinstance(event, Fix)]
    assert fixes
    for fix in fixes:
        check_covariance(fix.covariance)
        if fix.common_covariance is None:
            continue
        known = np.flatnonzero(np.isfinite(np.diagonal(fix.covariance)))
        index = known[:, None], known
        sigma = np.sqrt(np.diagonal(fix.covariance)[known])
        scale = np.outer(sigma, sigma)
        common = fix.common_covariance[index] / scale
        own = fix.covariance[index] / scale - common
        assert np.linalg.eigvalsh(common)[0] > -1e-9
        assert np.linalg.eigvalsh(own)[0] > -1e-9
