"""Live events in a recording."""

from __future__ import annotations

import json

import numpy as np
import pytest

from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    PoseEstimate,
    StateChange,
    TrackingState,
    WarningEvent,
)
from locatk.formats.live.recorded_events import RecordedEvents
from locatk.formats.sessions.messages import POSES, symmetric


def pose(device: str, time_ns: int, x_m: float) -> PoseEstimate:
    return PoseEstimate(
        device,
        "floor",
        time_ns,
        np.array([x_m, 0.0, 0.0]),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.diag([1e-4, 1e-4, np.nan, np.nan, np.nan, 1e-2]),
        probability=0.5,
    )


def test_poses_are_batches_per_device_in_the_order_of_time() -> None:
    queue = RecordedEvents()
    for event in (pose("red", 10, 1.0), pose("blue", 20, 5.0), pose("red", 30, 2.0)):
        queue.add(event)
    blue, red = queue.take()
    assert (blue.topic, red.topic) == ("/live_track/blue", "/live_track/red")
    assert (red.time_ns, red.publish_ns) == (30, 10)
    batches = POSES.unpack([red.message.SerializeToString()])
    assert batches.columns["time_ns"].tolist() == [10, 30]
    assert batches.columns["position_m"][:, 0].tolist() == [1.0, 2.0]
    assert batches.columns["probability"].tolist() == [0.5, 0.5]
    covariance = symmetric(batches.columns["covariance_m_rad"])[0]
    assert covariance[5, 5] == pytest.approx(1e-2)
    assert np.isnan(covariance[2, 2])
    assert batches.texts == {"device": ["red"], "frame_id": ["floor"]}
    assert queue.take() == []


def test_other_events_are_lines_of_the_log() -> None:
    queue = RecordedEvents()
    queue.add(StateChange("red", 10, TrackingState.LOST, "no fix yet"))
    queue.add(WarningEvent("", 20, SolverWarning("solver_late", "behind")))
    state, warning = queue.take()
    assert {state.topic, warning.topic} == {"/log"}
    assert json.loads(state.message.message) == {  # type: ignore[attr-defined]
        "type": "state",
        "time_s": 1e-8,
        "device": "red",
        "state": "lost",
        "reason": "no fix yet",
    }
    assert json.loads(warning.message.message)["code"] == "solver_late"  # type: ignore[attr-defined]
