"""Routing of observations to a stream and to the trackers of its devices."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.inertial import InertialSamples
from locatk.core.simulation import SESSION_START_NS
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    ArtifactUpdate,
    BackgroundTask,
    Correction,
    DetectionEvent,
    Fix,
    LiveEvent,
    PoseEstimate,
    StateChange,
    Stream,
    StreamEvent,
    TrackingState,
    WarningEvent,
)
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class Given:
    """Observation of the stream below: the results that it returns."""

    results: tuple[StreamEvent, ...]


class EchoStream(Stream):
    """Stream that returns the results it is given, and remembers what it was pushed."""

    system = "lighthouse"

    def __init__(self) -> None:
        self.pushed: list[Any] = []

    def push(self, observations: Any) -> Sequence[StreamEvent]:
        self.pushed.append(observations)
        return observations.results if isinstance(observations, Given) else ()

    def advance(self, time_ns: int) -> Sequence[StreamEvent]:
        return [StateChange("robot", time_ns, TrackingState.LOST, "silent")]

    def finish(self) -> Sequence[StreamEvent]:
        return [WarningEvent("", 0, SolverWarning("end", "the end"))]

    def background_task(self) -> BackgroundTask | None:
        return BackgroundTask("scene", sum, ((1, 2),))

    def complete(self, task: BackgroundTask, result: Any) -> Sequence[StreamEvent]:
        return [ArtifactUpdate(0, 2, result)]


@dataclass(frozen=True)
class Identified:
    tag_id: int | None


def poses(events: Sequence[LiveEvent]) -> list[PoseEstimate]:
    return [event for event in events if isinstance(event, PoseEstimate)]


def fingerprint(events: Sequence[LiveEvent]) -> list[Any]:
    return [
        tuple(
            value.tobytes() if isinstance(value, np.ndarray) else repr(value)
            for value in (getattr(event, name) for name in event.__dataclass_fields__)
        )
        for event in events
    ]


def push_in_order(localizer: LiveLocalizer, case: Any, part_of: Any, edges: list[int]) -> Any:
    """Push the motion in pieces, and each fix before the piece that ends after it."""
    events: list[LiveEvent] = []
    fixes = list(case.fixes)
    for first, last in itertools.pairwise(edges):
        events += localizer.push(part_of(case.motion, slice(first, last)))
        while fixes and last < len(case.motion) and fixes[0].time_ns <= case.motion.time_ns[last]:
            events += localizer.push(Given((fixes.pop(0),)))
    return events


def test_fixes_and_motion_of_two_devices(drive: Any, part_of: Any) -> None:
    case = drive(0, duration_s=2.0)
    stream = EchoStream()
    localizer = LiveLocalizer(stream)
    other = Fix(
        "other",
        *(getattr(case.fixes[0], name) for name in Fix.__dataclass_fields__ if name != "device"),
    )
    events = localizer.push(case.motion)
    events += localizer.push(Given((case.fixes[-1], other)))
    assert [pose.device for pose in poses(events)] == ["robot", "other"]
    assert sum(isinstance(each, Trajectory) for each in stream.pushed) == len(case.motion)


def test_other_events_pass_through() -> None:
    stream = EchoStream()
    localizer = LiveLocalizer(stream)
    detection = DetectionEvent("robot", 5, Identified(None))
    assert localizer.push(Given((detection,))) == [detection]
    assert localizer.finish() == stream.finish()
    task = localizer.background_task()
    assert task == stream.background_task()
    assert task is not None
    assert localizer.complete(task, 3) == [ArtifactUpdate(0, 2, 3)]
    (change,) = localizer.advance(7)
    assert change == StateChange("robot", 7, TrackingState.LOST, "silent")


def test_a_correction_names_what_was_identified(drive: Any) -> None:
    case = drive(0, duration_s=3.0)
    localizer = LiveLocalizer(EchoStream())
    localizer.push(case.motion.select(np.arange(100)))
    first, second = case.fixes[:2]
    localizer.push(Given((first,)))
    moved = Fix(
        "robot", "floor", second.time_ns, second.position + 1, second.quaternion, second.covariance
    )
    detection = DetectionEvent("robot", second.time_ns, Identified(77))
    events = localizer.push(Given((detection, moved, moved, moved)))
    assert not [event for event in events if isinstance(event, Correction) and not event.reason]
    events += localizer.push(Given((detection, moved)))
    corrections = [event for event in events if isinstance(event, Correction)]
    assert len(corrections) == 1


def test_a_new_scene_starts_all_devices_anew(drive: Any) -> None:
    case = drive(0, duration_s=3.0)
    localizer = LiveLocalizer(EchoStream())
    events = localizer.push(Given((case.fixes[0],)))
    events += localizer.push(Given((ArtifactUpdate(0, 3, None), case.fixes[1])))
    assert [pose.reset_counter for pose in poses(events)] == [0, 1]
    (correction,) = [event for event in events if isinstance(event, Correction)]
    assert correction.reason == "scene version 3"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["drive", "flight"])
@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_pieces_give_the_same_events(
    drive: Any, flight: Any, part_of: Any, kind: str, data: Any
) -> None:
    """Bit for bit, as long as fixes and motion keep their order."""
    case = (drive if kind == "drive" else flight)(data.draw(st.integers(0, 2)), duration_s=1.5)
    n = len(case.motion)
    fix_edges = np.searchsorted(case.motion.time_ns, [fix.time_ns for fix in case.fixes])
    needed = {0, n, *fix_edges.tolist()}
    cuts = data.draw(st.sets(st.integers(1, n - 1)))
    expected = push_in_order(LiveLocalizer(EchoStream()), case, part_of, sorted(needed))
    events = push_in_order(LiveLocalizer(EchoStream()), case, part_of, sorted(needed | cuts))
    assert fingerprint(events) == fingerprint(expected)
    assert len(poses(events)) > n // 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["drive", "flight"])
def test_interleaving_changes_later_poses_by_rounding(
    drive: Any, flight: Any, part_of: Any, kind: str
) -> None:
    """Fixes that come before, with or after the motion around them."""
    case = (drive if kind == "drive" else flight)(4, duration_s=3.0, fix_interval_s=0.2)
    n = len(case.motion)
    last = []
    for pieces in (n - 1, (n - 1) // 4, 3):
        localizer = LiveLocalizer(EchoStream())
        edges = np.unique(np.linspace(0, n - 1, pieces + 1).astype(int)).tolist()
        push_in_order(localizer, case, part_of, edges)
        last.append(poses(localizer.push(part_of(case.motion, slice(n - 1, n))))[-1])
    for pose in last[1:]:
        np.testing.assert_allclose(pose.position, last[0].position, rtol=0, atol=1e-9)
        np.testing.assert_allclose(pose.covariance, last[0].covariance, rtol=1e-6, atol=1e-12)


def test_inertial_samples_reach_stream_and_tracker(flight: Any, part_of: Any) -> None:
    case = flight(0, duration_s=1.0)
    stream = EchoStream()
    localizer = LiveLocalizer(stream)
    localizer.push(part_of(case.motion, slice(0, 20)))
    localizer.push(Given((case.fixes[0],)))
    events = localizer.push(part_of(case.motion, slice(20, 30)))
    assert len(poses(events)) == 10
    assert sum(isinstance(each, InertialSamples) for each in stream.pushed) == 30
    assert poses(events)[-1].time_ns == case.motion.time_ns[29] > SESSION_START_NS
