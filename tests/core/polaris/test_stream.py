"""Causal localization over tags, compared with the solver of whole recordings."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading, wrap_angle
from locatk.core.polaris import stream as polaris_stream
from locatk.core.polaris import stream as stream_module
from locatk.core.polaris.array import Samples
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.given_path import known_path
from locatk.core.polaris.identification.tags import IdentifiedPass
from locatk.core.polaris.localization import PLANAR_COMPONENTS
from locatk.core.polaris.preprocessing import PassRange, preprocess
from locatk.core.polaris.results import HeadingCorrection, TagDetection
from locatk.core.polaris.simulation.session import SimulationOptions, simulate
from locatk.core.polaris.solver import identify_range, solve
from locatk.core.polaris.stream import PolarisStream
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.streaming.events import DetectionEvent, Fix, StreamEvent, WarningEvent
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.polaris import suite
from locatk.formats.benchmarks.polaris.designs import DESIGNS, random_tag, record_pass

Array = NDArray[np.float64]

TAGS = Tags(spacing_m=0.03)
TAG_ID, OTHER_ID = 123456, 1999
SPEED_MPS = 0.12


def tag_of(world: Any, tag_id: int, **where: Any) -> Any:
    layout = layout_of(TAGS, tag_id)
    return world.Tag(layout.cells, layout.symbols, spacing=TAGS.spacing_m, **where)


def odometry_of(course: Any, rate: float = 40.0, scale: float = 1.01) -> Trajectory:
    """What wheels measure on a course, in a frame of their own."""
    t = np.arange(course.t[0], course.t[-1], 1 / rate)
    x, y, heading = course.at(t)
    time_ns = 1_700_000_000_000_000_000 + np.rint(t * 1e9).astype(np.int64)
    position = np.column_stack([scale * x, scale * y, np.zeros(len(t))])
    covariance = np.full((len(t), 6, 6), np.nan)
    return Trajectory(
        "bar", "odom", time_ns, position, quaternion_from_heading(heading), covariance
    )


def piece(samples: Samples, first: int, stop: int) -> Samples:
    rows = slice(first, stop)
    return replace(samples, time_ns=samples.time_ns[rows], field_t=samples.field_t[rows])


def run(stream: PolarisStream, observations: Iterable[Any]) -> list[StreamEvent]:
    """Return the events of a stream from its beginning to its end."""
    events = [event for each in observations for event in stream.push(each)]
    return [*events, *stream.finish()]


def detections(events: Sequence[StreamEvent]) -> list[TagDetection]:
    found = [each.detection for each in events if isinstance(each, DetectionEvent)]
    return [each for each in found if isinstance(each, TagDetection)]


def fixes(events: Sequence[StreamEvent]) -> list[Fix]:
    return [each for each in events if isinstance(each, Fix)]


def codes(events: Sequence[StreamEvent]) -> list[str]:
    return [each.warning.code for each in events if isinstance(each, WarningEvent)]


def exact(events: Sequence[StreamEvent]) -> list[object]:
    """Return events in a form that compares bit for bit."""
    return [
        (e.time_ns, e.frame, e.position.tobytes(), e.quaternion.tobytes(), e.covariance.tobytes())
        if isinstance(e, Fix)
        else repr(e)
        for e in events
    ]


@pytest.fixture(scope="module")
def two_tags(world: Any) -> tuple[Samples, Trajectory, Tags]:
    """Recording, odometry and site of a bar that passes two tags."""
    placed = [tag_of(world, TAG_ID, heading=0.4), tag_of(world, OTHER_ID, x=0.3, heading=-1.1)]
    course = world.line(length=0.62, speed=SPEED_MPS, past=(0.15, 0.0))
    samples = world.record(placed, course, rate=50.0, seed=3)
    site = {TAG_ID: PlanarPose(0.0, 0.0, 0.4), OTHER_ID: PlanarPose(0.3, 0.0, -1.1)}
    return samples, odometry_of(course), replace(TAGS, site=site)


@pytest.mark.slow
def test_ids_poses_and_corrections_are_those_of_the_solver(
    two_tags: tuple[Samples, Trajectory, Tags],
) -> None:
    samples, odometry, tags = two_tags
    solution = solve([samples], tags, odometry=[odometry])
    events = run(PolarisStream(tags), [odometry, samples])
    live = detections(events)
    assert [each.tag_id for each in live] == [each.tag_id for each in solution.detections]
    assert [each.tag_id for each in live] == [TAG_ID, OTHER_ID]
    trajectory = solution.trajectories[0]
    assert [fix.frame for fix in fixes(events)] == ["site", "site"]
    for fix in fixes(events):
        k = int(np.abs(trajectory.time_ns - fix.time_ns).argmin())
        difference = fix.position[:2] - trajectory.position[k, :2]
        assert np.all(np.abs(difference) < 2 * np.sqrt(np.diag(fix.covariance)[:2]))
        assert np.isnan(fix.covariance[3:5, 3:5]).all()
    (offline,) = solution.facts.heading_corrections
    (correction,) = [
        e.detection
        for e in events
        if isinstance(e, DetectionEvent) and isinstance(e.detection, HeadingCorrection)
    ]
    assert (correction.from_tag, correction.to_tag) == (offline.from_tag, offline.to_tag)
    sigma = offline.sigma_rotation_rad
    assert correction.rotation_rad == pytest.approx(offline.rotation_rad, abs=3 * sigma)


@pytest.mark.slow
@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_cut_and_interleaving_gives_the_same_events(
    data: st.DataObject,
    two_tags: tuple[Samples, Trajectory, Tags],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples, odometry, tags = two_tags
    monkeypatch.setattr(polaris_stream, "MAX_ODOMETRY_DELAY_NS", 60_000_000_000)
    expected = run(PolarisStream(tags), [odometry, samples])
    assert len(fixes(expected)) == 2

    def cuts(count: int) -> list[int]:
        inside = data.draw(st.lists(st.integers(1, count - 1), max_size=20, unique=True))
        return [0, *sorted(inside), count]

    of_samples, of_odometry = cuts(len(samples)), cuts(len(odometry))
    queues: list[list[Any]] = [
        [piece(samples, a, b) for a, b in itertools.pairwise(of_samples)],
        [odometry.select(np.arange(a, b)) for a, b in itertools.pairwise(of_odometry)],
    ]
    order: list[Any] = []
    while any(queues):
        queue = data.draw(st.sampled_from([q for q in queues if q]))
        order.append(queue.pop(0))
    assert exact(run(PolarisStream(tags), order)) == exact(expected)


@pytest.mark.slow
def test_samples_alone_can_be_cut_anywhere(world: Any) -> None:
    samples = world.record([tag_of(world, TAG_ID)], world.line(speed=0.2), rate=50.0)
    tags = replace(TAGS, site={TAG_ID: PlanarPose(1.0, 2.0, 0.3)})
    expected = exact(run(PolarisStream(tags), [samples]))
    single = [piece(samples, k, k + 1) for k in range(len(samples))]
    assert exact(run(PolarisStream(tags), single)) == expected
    assert len(expected) == 2


@pytest.mark.slow
def test_results_come_before_the_end_of_the_pass(world: Any) -> None:
    """A tag of the site is known while its last magnet is still under the bar's field."""
    tag = tag_of(world, TAG_ID, heading=0.3)
    course = world.line(length=0.4, speed=SPEED_MPS)
    samples = world.record([tag], course, seed=5)
    stream = PolarisStream(replace(TAGS, site={TAG_ID: PlanarPose(0.0, 0.0, 0.3)}))
    last_m = tag.places[:, 0].max()
    x = course.at((samples.time_ns - samples.time_ns[0]) * 1e-9)[0]
    for k in range(len(samples)):
        if detections(list(stream.push(piece(samples, k, k + 1)))):
            break
    assert abs(x[k] - last_m) < 0.012
    rest = [*stream.push(piece(samples, k + 1, len(samples))), *stream.finish()]
    assert detections(rest) == []


@pytest.mark.slow
def test_published_recordings_are_read_as_by_the_solver(recordings: Path) -> None:
    for name, runs in suite.read_runs(recordings).items():
        for samples in runs:
            solution = solve([samples], suite.PUBLISHED_TAGS)
            events = run(PolarisStream(suite.PUBLISHED_TAGS), [samples])
            assert [d.tag_id for d in detections(events)] == [suite.SET_IDS[name]]
            assert [d.refused for d in detections(events)] == [None]
            (fix,) = fixes(events)
            assert fix.frame == f"tag-{suite.SET_IDS[name]}"
            trajectory = solution.trajectories[0]
            k = int(np.flatnonzero(trajectory.time_ns == fix.time_ns)[0])
            difference = fix.position[:2] - trajectory.position[k, :2]
            sigma = np.sqrt(np.diag(fix.covariance)[:2])
            assert np.all(np.abs(difference) < 2 * sigma), name
            assert np.all(sigma < 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("is_driven", [False, True])
def test_the_covariance_of_fixes_is_right(is_driven: bool) -> None:
    """NEES of 12 fixes, by the truth of simulated sessions."""
    nees = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        ids = [int(each) for each in rng.choice(280_000, 6, replace=False)]
        site = {
            tag_id: PlanarPose(0.7 * k, 0.15 * np.sin(k), float(rng.uniform(-3, 3)))
            for k, tag_id in enumerate(ids)
        }
        options = SimulationOptions(
            route=tuple(ids), speed_wobble=0.1, build_angle_rad=0.05, build_place_m=3e-4,
            lateral_m=0.006, odometry=is_driven, seed=seed,
        )  # fmt: skip
        session = simulate(Tags(site=site), options)
        inputs = [session.samples] if session.odometry is None else [
            session.odometry, session.samples
        ]  # fmt: skip
        events = run(PolarisStream(session.tags), inputs)
        assert [d.tag_id for d in detections(events)] == ids
        truth = session.truth
        for fix in fixes(events):
            k = int(np.abs(truth.time_ns - fix.time_ns).argmin())
            heading, true = heading_from_quaternion(np.array([fix.quaternion, truth.quaternion[k]]))
            offset = fix.position[:2] - truth.position[k, :2]
            error = np.array([*offset, wrap_angle(heading - true)])
            covariance = fix.covariance[np.ix_(PLANAR_COMPONENTS, PLANAR_COMPONENTS)]
            nees.append(float(error @ np.linalg.solve(covariance, error)))
    assert len(nees) == 12
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


@pytest.mark.slow
def test_a_partial_tag_is_refused_as_by_the_solver(world: Any) -> None:
    course = world.line(lateral=0.085, speed=0.2)
    samples = world.record([tag_of(world, TAG_ID)], course, rate=50.0, seed=2)
    expected = [d.refused for d in solve([samples], TAGS).detections]
    live = detections(run(PolarisStream(TAGS), [samples]))
    assert [d.refused for d in live] == expected == ["partial"]
    assert fixes(run(PolarisStream(TAGS), [samples])) == []


def test_a_floor_without_tags_gives_nothing(world: Any) -> None:
    samples = world.record([], world.line(length=2.0), seed=7)
    drift = np.linspace(0, 2e-6, len(samples))[:, None, None] * np.ones((1, 9, 3))
    assert run(PolarisStream(TAGS), [replace(samples, field_t=samples.field_t + drift)]) == []


@pytest.mark.slow
def test_without_a_design_magnets_are_detected(world: Any) -> None:
    samples = world.record([tag_of(world, TAG_ID)], world.line(speed=0.2), rate=50.0)
    (expected,) = solve([samples]).detections
    (live,) = detections(run(PolarisStream(), [samples]))
    assert live.refused == expected.refused == "no_tag_given"
    assert len(live.magnets) == len(expected.magnets)


@pytest.mark.slow
@pytest.mark.parametrize("rest_s", [0.8, 40.0])
def test_a_rest_over_a_tag(rest_s: float, world: Any) -> None:
    """The halves of the tag before and after the rest are refused by either solver."""
    times_s = [0.0, 1.6, 1.6 + rest_s, 3.2 + rest_s]
    course = world.driven(world.line(speed=0.1), times_s, [0, 0.5, 0.5, 1])
    samples = world.record([tag_of(world, TAG_ID, heading=0.7)], course, rate=50.0)
    live = detections(run(PolarisStream(TAGS), [samples]))
    expected = solve([samples], TAGS).detections
    assert [d.tag_id for d in live] == [d.tag_id for d in expected]
    assert [d.refused for d in live] == [d.refused for d in expected]


@pytest.mark.slow
@pytest.mark.parametrize(("rest_s", "is_merged"), [(0.8, True), (20.0, False)])
def test_two_passes_that_are_one_tag(
    rest_s: float, is_merged: bool, world: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each half of a tag is refused; both together are read."""
    tag = tag_of(world, TAG_ID, heading=0.7)
    clean = preprocess(world.record([tag], world.line(speed=0.2), rate=50.0))
    canned = identify_range(clean, [TAGS], PassRange(5, len(clean.samples) - 5), None)
    assert canned is not None
    assert canned.is_identified

    def identify(_: Any, designs: Sequence[Tags], part: PassRange, __: Any) -> IdentifiedPass:
        refused = "" if part.stop - part.first > 120 else "magnets_missing"
        magnets = replace(canned.magnets, first=part.first, stop=part.stop)
        observation = replace(
            canned.observations[0], magnets=magnets, tags=designs[0], refused=refused
        )
        return IdentifiedPass(magnets, (observation,))

    monkeypatch.setattr(stream_module, "identify_range", identify)
    times_s = [0.0, 1.6, 1.6 + rest_s, 3.2 + rest_s]
    course = world.driven(world.line(speed=0.1), times_s, [0, 0.5, 0.5, 1])
    tags = replace(TAGS, site={OTHER_ID: PlanarPose(0.0, 0.0, 0.0)})
    live = detections(run(PolarisStream(tags), [world.record([tag], course, rate=50.0)]))
    assert [d.tag_id for d in live] == [None, TAG_ID if is_merged else None]


@pytest.mark.slow
def test_an_early_tag_that_is_a_part_of_a_larger_one_is_contradicted() -> None:
    """A tag of 5 x 5 whose fourth row is empty, and a design of 3 x 3 without known ids."""
    rng = np.random.default_rng(29057)
    clearance_m = rng.uniform(0.008, 0.015)
    rng.integers(len(DESIGNS))
    placed = random_tag(DESIGNS[1 + 29057 % 3], rng, max_lateral_m=0.06)
    heading = np.pi / 2 * rng.integers(4) + 0.05 * rng.normal()
    placed = replace(placed, pose=replace(placed.pose, heading_rad=heading))
    samples = record_pass([placed], rng, clearance_m=clearance_m, screws=29057 % 3)
    events = run(PolarisStream(DESIGNS[0]), [samples])
    assert [d.refused for d in detections(events)] == [None, "other_design"]
    assert "early_tag_contradicted" in codes(events)
    known = replace(DESIGNS[0], ids=(1, 2, 3), min_distance=1)
    refused = [d.refused for d in solve([samples], known).detections]
    assert [d.refused for d in detections(run(PolarisStream(known), [samples]))] == refused
    assert None not in refused


@pytest.mark.slow
def test_a_pass_without_an_end_is_cut(world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Magnets that follow each other for ever, in bounded memory."""
    monkeypatch.setattr(stream_module, "MAX_PASS_SAMPLES", 200)
    monkeypatch.setattr(stream_module, "MAX_ATTEMPTS", 0)
    solved: list[int] = []

    def identify(preprocessed: Any, *_: Any) -> None:
        solved.append(len(preprocessed.samples))

    monkeypatch.setattr(stream_module, "identify_range", identify)
    samples = world.record([], world.line(length=20.0, speed=0.2), rate=50.0)
    wave = 20e-6 * np.sin(np.arange(len(samples)) / 3)[:, None, None] * [[1.0], [-1.0], [0.5]] * 3
    wave = np.repeat(wave, 3, axis=1)[:, :9]
    stream = PolarisStream(TAGS)
    run(stream, [replace(samples, field_t=samples.field_t + wave)])
    assert len(solved) >= len(samples) // 200 - 2
    assert max(solved) <= 200 + stream_module.HISTORY_SAMPLES + 16


@pytest.mark.slow
def test_memory_does_not_grow(world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_module, "CAPACITY_SAMPLES", 700)
    monkeypatch.setattr(stream_module, "CAPACITY_POSES", 600)
    course = world.line(length=100.0, speed=1.0)
    samples, odometry = world.record([], course, rate=100.0), odometry_of(course, rate=100.0)
    stream, sizes = PolarisStream(TAGS), []
    for k in range(0, len(samples), 500):
        stream.push(odometry.select(np.arange(k, min(k + 500, len(odometry)))))
        stream.push(piece(samples, k, k + 500))
        (device,) = stream._devices.values()
        sizes.append(
            max(
                device.samples.stop - device.samples.first,
                device.odometry.stop - device.odometry.first,
                len(device.held),
            )
        )
    assert max(sizes) <= 2 * 700 + 500
    # Odometry falls silent, and samples do not wait for it longer than they may.
    late = replace(samples, time_ns=samples.time_ns + 200 * 10**9)
    stream.push(late)
    assert len(device.held) == 0


def test_samples_wait_for_odometry_until_time_advances(
    world: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    course = world.line(length=0.5, speed=0.2)
    samples, odometry = world.record([], course), odometry_of(course)
    monkeypatch.setattr(polaris_stream, "MAX_ODOMETRY_DELAY_NS", 10_000_000_000)
    stream = PolarisStream(TAGS)
    stream.push(odometry.select(np.arange(20)))
    stream.push(samples)
    (device,) = stream._devices.values()
    assert device.last_ns <= odometry.time_ns[19] < device.held[0][0]
    stream.advance(int(samples.time_ns[150]))
    assert device.last_ns == samples.time_ns[150]
    stream.finish()
    assert device.last_ns == samples.time_ns[-1]


@pytest.mark.slow
def test_an_array_that_falls_silent_ends_its_pass(world: Any) -> None:
    samples = world.record([tag_of(world, TAG_ID)], world.line(lateral=0.085, speed=0.2), rate=50.0)
    stream = PolarisStream(TAGS)
    events = list(stream.push(piece(samples, 0, 45)))
    time_ns = int(samples.time_ns[44])
    assert detections(events) == detections(list(stream.advance(time_ns + 900_000_000))) == []
    assert [d.refused for d in detections(list(stream.advance(time_ns + 1_100_000_000)))] == [
        "partial"
    ]


@pytest.mark.slow
def test_a_gap_of_the_samples_ends_the_pass(world: Any) -> None:
    samples = world.record([tag_of(world, TAG_ID)], world.line(lateral=0.085, speed=0.2), rate=50.0)
    stream = PolarisStream(TAGS)
    assert detections(list(stream.push(piece(samples, 0, 45)))) == []
    late = piece(samples, 0, 1)
    events = list(stream.push(replace(late, time_ns=samples.time_ns[45:46] + 1_500_000_000)))
    assert [d.refused for d in detections(events)] == ["partial"]


def test_damaged_input(world: Any) -> None:
    samples = world.record([], world.line(speed=0.2))
    stream = PolarisStream(TAGS)
    stream.push(samples)
    assert codes(stream.push(piece(samples, 0, 5))) == ["samples_out_of_order"]
    assert codes(stream.push(piece(samples, 0, 5))) == []
    poses = odometry_of(world.line(speed=0.2))
    poses.position[3] = np.nan
    assert codes(stream.push(poses)) == ["odometry_invalid"]
    with pytest.raises(InputError, match="5 sensors"):
        stream.push(world.record([], world.line(), array=world.bar(count=5)))


@pytest.mark.slow
def test_a_tag_without_a_position_gives_no_fix(world: Any) -> None:
    samples = world.record([tag_of(world, TAG_ID)], world.line(speed=0.2), rate=50.0)
    tags = replace(TAGS, site={OTHER_ID: PlanarPose(0.0, 0.0, 0.0)}, meanings={TAG_ID: "stop"})
    events = run(PolarisStream(tags), [samples])
    assert [(d.tag_id, d.meaning) for d in detections(events)] == [(TAG_ID, "stop")]
    assert fixes(events) == []
    assert "tag_not_on_site" in codes(events)


def test_given_path_that_jumps_or_is_unknown_in_a_pass_is_not_used() -> None:
    path_m = np.linspace(0.0, 0.5, 100)
    part = PassRange(20, 80)
    assert known_path(path_m, part) is path_m
    for value in (np.nan, np.inf, 1e6):
        assert known_path(np.where(np.arange(100) < 50, path_m, value), part) is None
        # Outside of the pass it does not matter.
        assert known_path(np.where(np.arange(100) < 80, path_m, value), part) is not None
