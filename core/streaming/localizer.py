"""Live localization of all devices of one system: its stream, with a tracker for each device.

Results depend on the observations and on the order in which they are pushed, but not on how they
are cut into pieces. Observations of one kind and device are pushed in the order of time. If those
of different kinds arrive in another order (fixes late, odometry early), the filters still process
them in the order of time: later poses are the same to rounding, as long as the lateness is within
the history of the filter and no fix is refused at its limit. What was published before an
observation arrived cannot depend on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from locatk.core.inertial import InertialSamples
from locatk.core.solution import add_counts
from locatk.core.streaming.events import (
    ArtifactUpdate,
    BackgroundTask,
    DetectionEvent,
    Fix,
    LiveEvent,
    StateChange,
    Stream,
    StreamEvent,
)
from locatk.core.streaming.tracker import (
    DEFAULT_SETTINGS,
    DeviceTracker,
    TrackerSettings,
)
from locatk.core.trajectory import Trajectory


class LiveLocalizer:
    """Causal localization of the devices of one system.

    Parameters
    ----------
    stream : Stream
    settings : TrackerSettings, optional
        Default: those of the system.
    """

    def __init__(self, stream: Stream, settings: TrackerSettings | None = None) -> None:
        self.stream = stream
        self._settings = settings or DEFAULT_SETTINGS.get(stream.system) or TrackerSettings()
        self._trackers: dict[str, DeviceTracker] = {}
        self._sources: dict[str, str] = {}

    def push(self, observations: Any) -> list[LiveEvent]:
        """Return the events of the next observations, see :meth:`.Stream.push`."""
        if isinstance(observations, Trajectory):
            tracker = self._tracker(observations.device)
            events: list[LiveEvent] = []
            for index in range(len(observations)):
                sample = observations.select(np.array([index]))
                events += self._route(self.stream.push(sample))
                events += tracker.odometry(sample)
            return events
        if isinstance(observations, InertialSamples):
            tracker, events = self._tracker(observations.device), []
            for index in range(len(observations)):
                part = slice(index, index + 1)
                inertial = InertialSamples(
                    observations.device,
                    observations.time_ns[part],
                    observations.acceleration[part],
                    observations.angular_rate[part],
                )
                events += self._route(self.stream.push(inertial))
                events += tracker.inertial(inertial)
            return events
        return self._route(self.stream.push(observations))

    def advance(self, time_ns: int) -> list[LiveEvent]:
        """Return the events that follow from the time alone: no observation up to it is missing."""
        events = self._route(self.stream.advance(time_ns))
        for tracker in self._trackers.values():
            events += tracker.advance(time_ns)
        return events

    def finish(self) -> list[LiveEvent]:
        """Return the events of observations that were held back, at the end of the input."""
        return self._route(self.stream.finish())

    def background_task(self) -> BackgroundTask | None:
        """Return the next long computation to be done elsewhere; None if there is none."""
        return self.stream.background_task()

    def complete(self, task: BackgroundTask, result: Any) -> list[LiveEvent]:
        """Take the result of a task, or the exception that it raised."""
        return self._route(self.stream.complete(task, result))

    @property
    def rejected(self) -> dict[str, int]:
        """Numbers of observations that the stream did not use, and of fixes and motions that the
        trackers did not use, by reason."""
        return add_counts(
            self.stream.rejected, *(tracker.rejected for tracker in self._trackers.values())
        )

    def _tracker(self, device: str) -> DeviceTracker:
        tracker = self._trackers.get(device)
        if tracker is None:
            tracker = self._trackers[device] = DeviceTracker(device, self._settings)
        return tracker

    def _route(self, results: Iterable[StreamEvent]) -> list[LiveEvent]:
        """Give fixes and states to the trackers; pass other events through."""
        events: list[LiveEvent] = []
        for result in results:
            if isinstance(result, Fix):
                source = self._sources.pop(result.device, "")
                events += self._tracker(result.device).fix(result, source)
            elif isinstance(result, StateChange):
                events += self._tracker(result.device).take_reason(result)
            else:
                if isinstance(result, ArtifactUpdate):
                    for tracker in self._trackers.values():
                        tracker.use_artifact(result)
                elif isinstance(result, DetectionEvent):
                    self._name_source(result)
                events.append(result)
        return events

    def _name_source(self, event: DetectionEvent) -> None:
        """Remember what was identified: the next fix of the device is from it."""
        for name, attribute in (("tag", "tag_id"), ("landmark at cell", "cell")):
            identity = getattr(event.detection, attribute, None)
            if identity is not None:
                self._sources[event.device] = f"{name} {identity}"
