"""Messages of live events in the recording: poses, state changes, detections."""

from __future__ import annotations

import json
from collections import defaultdict, deque
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from locatk.core.streaming.events import LiveEvent, PoseEstimate
from locatk.formats.capture.ingestion import StampedMessage
from locatk.formats.sessions import messages
from locatk.formats.sessions.messages import POSES, triangle
from locatk.formats.sessions.trajectories import LIVE_TRACK
from locatk.formats.sinks.json_messages import event_to_json

SENDER = "locatk live"
"""Sender of the messages on ``/log``."""

MAX_WAITING = 100_000
"""Events that wait for the recorder; older ones are left out."""


class RecordedEvents:
    """Queue of live events from the solver to the recorder of an input.

    :meth:`add` runs in the thread of the solver, :meth:`take` in that of the recorder.
    """

    def __init__(self) -> None:
        self._events: deque[LiveEvent] = deque(maxlen=MAX_WAITING)

    def add(self, event: LiveEvent) -> None:
        """Add an event."""
        self._events.append(event)

    def take(self) -> list[StampedMessage]:
        """Return the messages of all events since the last call, in the order of their times.

        Poses are on ``/live_track/<device>``, all other events as JSON on ``/log``.
        """
        events = [self._events.popleft() for _ in range(len(self._events))]
        poses: dict[tuple[str, str], list[PoseEstimate]] = defaultdict(list)
        stamped: list[StampedMessage] = []
        for event in events:
            if isinstance(event, PoseEstimate):
                poses[event.device, event.frame].append(event)
            else:
                stamped.append(_log(event))
        stamped += [_track(*key, each) for key, each in poses.items()]
        return sorted(stamped, key=lambda message: message.time_ns)


def _track(device: str, frame: str, poses: list[PoseEstimate]) -> StampedMessage:
    columns: dict[str, NDArray[Any]] = {
        "time_ns": np.array([pose.time_ns for pose in poses], np.int64),
        "position_m": np.array([pose.position for pose in poses]),
        "quaternion_xyzw": np.array([pose.quaternion for pose in poses]),
        "covariance_m_rad": triangle(np.array([pose.covariance for pose in poses])),
        "probability": np.array([pose.probability for pose in poses]),
    }
    message = POSES.pack({"device": device, "frame_id": frame}, columns)
    first_ns, last_ns = int(columns["time_ns"][0]), int(columns["time_ns"][-1])
    return StampedMessage(LIVE_TRACK + device, message, last_ns, first_ns)


def _log(event: LiveEvent) -> StampedMessage:
    text = json.dumps(event_to_json(event))
    line = Log(
        timestamp=messages.timestamp(event.time_ns), level=Log.INFO, message=text, name=SENDER
    )
    return StampedMessage("/log", line, event.time_ns, event.time_ns)
