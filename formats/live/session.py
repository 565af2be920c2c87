"""Live session: inputs to a stream, its estimates to sinks and into the recording.

There is one thread per input that only reads; one per recording; this one, which decodes and
solves; and those of the sinks. A sink, a recorder or a background computation never delays the
solver (docs/live.md).

Replays are an exception. Their time is that of the recordings: events of all inputs are solved in
the order of their times, the stream learns from them how much time has passed, and
background computations are done at once. Hence the results do not depend on the speed of the
replay, on threads, or on the machine.
"""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

from locatk.core.errors import LocatkError
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    ArtifactUpdate,
    LiveEvent,
    PoseEstimate,
    StateChange,
    TrackingState,
    WarningEvent,
)
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.formats.capture.clocks import HostClock, ReplayClock
from locatk.formats.capture.reader_thread import SourceEnded
from locatk.formats.capture.setup import (
    CAMERA,
    CaptureRequest,
    check_request,
    is_session_address,
)
from locatk.formats.capture.status import RecordingResult
from locatk.formats.live.background import BackgroundWorker
from locatk.formats.live.inputs import (
    Arrival,
    ArrivalQueue,
    InputNotice,
    LiveInput,
    RecordedOrder,
    open_inputs,
)
from locatk.formats.live.observations import AttachedArtifacts, Observations, system_of
from locatk.formats.live.recorded_events import RecordedEvents
from locatk.formats.live.streams import StreamOptions, create_stream, system_of_artifacts
from locatk.formats.sinks.interface import LiveMessage, Sink, SinkContext, SinkStatus

TICK_S = 0.05
"""Longest wait for data, and interval at which the stream learns how much time has passed."""

TICK_NS = int(1e9 * TICK_S)

MIN_INTERVAL_S = 0.001
"""Shortest time between two calls of the solver: what arrives meanwhile is solved at once."""

ARRIVAL_DELAY_NS = 500_000_000
"""Age from which an observation that has not arrived is missing: buffers of USB and Bluetooth."""

MAX_LATENESS_S = 0.2
"""Time by which the solver may be behind the last received byte before that is reported."""

CLOSE_TIMEOUT_S = 2.0
"""Time for each sink to send what is waiting at the end."""

RECORDING_TIMEOUT_S = 30.0
"""Time for a recording to finish its files; a slow disk may have a backlog."""


@dataclass
class DeviceStatus:
    """State of one device.

    Attributes
    ----------
    state : TrackingState
    reason : str
    pose : PoseEstimate or None
        The newest one.
    poses : int
        Number of poses.
    rate_hz : float
        Poses per second in the last seconds.
    latency_s : float
        From the last byte to the newest pose at the sinks.
    """

    state: TrackingState = TrackingState.LOST
    reason: str = ""
    pose: PoseEstimate | None = None
    poses: int = 0
    rate_hz: float = 0.0
    latency_s: float = 0.0
    _counted: tuple[float, int] = (0.0, 0)

    def count(self, now_s: float) -> None:
        """Update the rate once a second."""
        start_s, poses = self._counted
        if now_s - start_s >= 1.0:
            self.rate_hz = (self.poses - poses) / (now_s - start_s) if start_s else 0.0
            self._counted = (now_s, self.poses)


@dataclass
class LiveResult:
    """Result of a live session.

    Attributes
    ----------
    ended : str
        Reason of the end: ``"stopped"``, ``"duration"`` or ``"end of the source"``.
    recording_errors : list of str
        Reasons why recordings are incomplete.
    system : str
    poses : dict of str to int
        Number of poses by device.
    recordings : list of RecordingResult
    status : dict
        As :meth:`LiveSession.status` at the end.
    """

    ended: str
    recording_errors: list[str]
    system: str
    poses: dict[str, int]
    recordings: list[RecordingResult]
    status: dict[str, Any]


@dataclass(frozen=True)
class LiveRequest:
    """Options of ``locatk live``.

    Attributes
    ----------
    inputs : tuple of CaptureRequest
        With ``output`` if they are recorded.
    stream : StreamOptions
    duration_s : float or None
    token : str or None
        Secret for clients of servers that do not listen on the loopback address.
    """

    inputs: tuple[CaptureRequest, ...]
    stream: StreamOptions = field(default_factory=StreamOptions)
    duration_s: float | None = None
    token: str | None = None


class LiveSession:
    """Runs a live session.

    Parameters
    ----------
    request : LiveRequest
    sinks : sequence of Sink
        Not yet open.
    tell : callable
        Takes messages for the user.
    """

    def __init__(
        self, request: LiveRequest, sinks: Sequence[Sink], *, tell: Callable[[str], None]
    ) -> None:
        self._request, self._sinks, self._tell = request, sinks, tell
        self._clock: HostClock = HostClock()
        if all(each.keeps_time or _is_session(each.port) for each in request.inputs):
            self._clock = ReplayClock()
        self._queue = ArrivalQueue()
        self._inputs: list[LiveInput] = []
        self._recorded: list[RecordedEvents] = []
        self._localizer: LiveLocalizer | None = None
        self._worker = BackgroundWorker()
        self._artifacts: dict[str, Any] = {}
        self._devices: dict[str, DeviceStatus] = {}
        self._warnings: Counter[str] = Counter()
        self._lateness_s = self._loaded_s = 0.0
        self._is_late = False
        self._is_sink_open = False
        self._started_s = 0.0
        self._replay: RecordedOrder | None = None
        self._replayed_ns = 0
        self._stop = threading.Event()
        self._sink_errors: dict[int, str] = {}
        self._scene_version = 0
        self._rejected: dict[str, int] = {}
        self.system = ""

    # ---- life

    def run(
        self,
        stop: threading.Event,
        *,
        ready: Callable[[], None] = lambda: None,
        waiting: Callable[[str], None] = lambda port: None,
    ) -> LiveResult:
        """Run until ``stop`` is set, the time is over, or all inputs have ended.

        Parameters
        ----------
        stop : threading.Event
        ready : callable
            Called once inputs and sinks are open.
        waiting : callable
            Takes the error of a port that is not yet available.

        Raises
        ------
        LocatkError
            An input, an artifact or a sink is invalid, or an artifact that the data require is
            missing.
        """
        self._load()
        self._stop = stop
        inputs = open_inputs(self._request.inputs, self._clock, stop, self._queue, waiting=waiting)
        self._inputs = inputs
        if all(each.keeps_time for each in inputs):
            self._replay = RecordedOrder(len(inputs))
            self._worker = BackgroundWorker(is_synchronous=True)
        ended = ""
        try:
            self._prepare()
            self._open_sinks()
            self._start()
            ready()
            ended = self._work(stop)
        finally:
            # After an error of the solver, its next result would be wrong or another error.
            self._close(solve_rest=bool(ended))
        recordings = [each.recording for each in inputs if each.recording is not None]
        return LiveResult(
            ended,
            [each.recording_error for each in inputs if each.recording_error],
            self.system,
            {name: device.poses for name, device in self._devices.items()},
            recordings,
            self.status(),
        )

    def _load(self) -> None:
        """Load the solver before a port is open: bytes that wait in it have the time of reading."""
        inputs = [AttachedArtifacts(check_request(each)) for each in self._request.inputs]
        system = system_of_artifacts({k: v for each in inputs for k, v in each.texts.items()})
        if system:
            create_stream(system, inputs, self._request.stream)

    def _prepare(self) -> None:
        texts: dict[str, str] = {}
        for each in self._inputs:
            texts |= each.artifacts.texts
        system = system_of_artifacts(texts)
        if system:
            self._create_localizer(system)

    def _create_localizer(self, system: str) -> None:
        stream, self._artifacts = create_stream(
            system, [each.artifacts for each in self._inputs], self._request.stream
        )
        self.system = system
        self._loaded_s = time.monotonic()
        self._localizer = LiveLocalizer(stream)

    def _open_sinks(self) -> None:
        context = SinkContext(
            self.system,
            self._artifacts,
            tuple(dict.fromkeys(name for each in self._inputs for name in each.devices)),
            self._request.token,
            self.status,
        )
        for index, sink in enumerate(self._sinks):
            try:
                sink.open(context)
            except Exception as error:
                self._close_sinks(self._sinks[:index])
                if isinstance(error, LocatkError):
                    raise
                raise LocatkError(
                    f"{sink.address} cannot be opened: {describe(error)}",
                    hint="Omit it, or update its package",
                ) from error
        self._is_sink_open = True

    def _start(self) -> None:
        # Objects of the imports are no garbage: a search through them takes 13 ms.
        gc.collect()
        gc.freeze()
        self._started_s = time.monotonic()
        for each in self._inputs:
            recorded = RecordedEvents()
            self._recorded.append(recorded)
            each.start(tell=self._tell, further=recorded.take)

    def _close(self, *, solve_rest: bool) -> None:
        try:
            for each in self._inputs:
                each.stop_reading()
            if solve_rest:
                self._take(self._queue.take(0.0))
                if self._localizer is not None:
                    self._publish(self._localizer.finish(), time.monotonic())
        finally:
            self._worker.close()
            for each in self._inputs:
                each.stop_recording(RECORDING_TIMEOUT_S)
            if self._is_sink_open:
                self._close_sinks(self._sinks)
            gc.unfreeze()

    @staticmethod
    def _close_sinks(sinks: Sequence[Sink]) -> None:
        def close(sink: Sink) -> None:
            # Sinks of other packages may raise; there is nobody left to be told.
            with contextlib.suppress(Exception):
                sink.close(CLOSE_TIMEOUT_S)

        closing = [threading.Thread(target=close, args=(sink,), daemon=True) for sink in sinks]
        for thread in closing:
            thread.start()
        until_s = time.monotonic() + CLOSE_TIMEOUT_S + 0.5
        for thread in closing:
            thread.join(max(0.0, until_s - time.monotonic()))

    # ---- solver

    def _work(self, stop: threading.Event) -> str:
        advanced_s = solved_s = time.monotonic()
        while True:
            arrivals = self._queue.take(TICK_S)
            early_s = solved_s + MIN_INTERVAL_S - time.monotonic()
            if arrivals and early_s > 0:
                # Each call costs more than each further observation in it.
                time.sleep(early_s)
                arrivals += self._queue.take(0.0)
            self._take(arrivals)
            solved_s = time.monotonic()
            now_s = time.monotonic()
            if now_s - advanced_s >= TICK_S:
                advanced_s = now_s
                self._advance(now_s)
            if self._replay is None:
                self._serve_background()
            if stop.is_set():
                return "stopped"
            duration_s = self._request.duration_s
            if duration_s is not None and now_s - self._started_s >= duration_s:
                return "duration"
            if not arrivals and all(each.is_ended for each in self._inputs):
                return "end of the source"

    def _take(self, arrivals: Sequence[Arrival]) -> None:
        """Decode and solve what has arrived."""
        if self._replay is not None:
            self._take_recorded(self._replay.merge(arrivals))
            return
        for _, group in groupby(arrivals, key=lambda arrival: arrival.source):
            self._take_batch(list(group))

    def _take_recorded(self, arrivals: Iterable[Arrival]) -> None:
        """Decode and solve events of a replay; time passes in steps between them."""
        for arrival in arrivals:
            if self._stop.is_set():  # Nobody waits for the rest of a recording.
                return
            time_ns = arrival.event.time_ns
            is_end = isinstance(arrival.event, SourceEnded)
            if not is_end and time_ns - self._replayed_ns >= TICK_NS:
                self._serve_background()
                self._replayed_ns = time_ns
                self._pass_time(time_ns, arrival.received_s)
            # One by one: how many are there depends on the threads of the readers, and the times
            # of records on those that are decoded together.
            self._take_batch([arrival])

    def _take_batch(self, batch: Sequence[Arrival]) -> None:
        """Decode and solve successive events of one input."""
        self._check_lateness(batch[0].received_s)
        source = self._inputs[batch[0].source]
        events = [each.event for each in batch]
        self._solve(source, source.decode(events), batch[-1].received_s)

    def _solve(
        self,
        source: LiveInput,
        observations: Iterable[Observations | InputNotice],
        received_s: float,
    ) -> None:
        for each in observations:
            if isinstance(each, InputNotice):
                self._report(source.name, "input", each.text, received_s)
                continue
            if self._localizer is None:
                system = system_of(each)
                if not system:
                    continue  # Odometry before the first sample of a sensor.
                self._create_localizer(system)
            assert self._localizer is not None
            system = system_of(each)
            if system and system != self.system:
                self._report_once("other_system", f"data of {system} are not used", received_s)
                continue
            self._publish(self._localizer.push(each), received_s)

    def _advance(self, now_s: float) -> None:
        """Update the counts, and tell the stream that time has passed."""
        for device in self._devices.values():
            device.count(now_s)
        if self._localizer is not None:
            self._rejected = self._localizer.rejected
        if self._replay is None:
            now_ns = self._clock.now()
            time_ns = min(each.complete_ns(now_ns) for each in self._inputs)
            self._pass_time(time_ns, now_s)

    def _pass_time(self, time_ns: int, received_s: float) -> None:
        """Tell decoders and stream that everything up to a time has been decoded."""
        for source in self._inputs:
            self._solve(source, source.identify(time_ns), received_s)
        if self._localizer is not None and time_ns > ARRIVAL_DELAY_NS:
            self._publish(self._localizer.advance(time_ns - ARRIVAL_DELAY_NS), received_s)

    def _serve_background(self) -> None:
        if self._localizer is None:
            return
        finished = self._worker.result()
        if finished is not None:
            self._publish(self._localizer.complete(*finished), time.monotonic())
        if self._worker.is_idle:
            task = self._localizer.background_task()
            if task is not None:
                self._worker.start(task)

    def _check_lateness(self, received_s: float) -> None:
        """Report that the solver is behind, once until it has caught up."""
        if not received_s:
            return
        self._lateness_s = time.monotonic() - received_s
        # Bytes that came while the solver was loaded say nothing about the speed of the computer.
        is_late = self._lateness_s > MAX_LATENESS_S and received_s > self._loaded_s
        is_late &= any(each.is_paced for each in self._inputs)
        if is_late and not self._is_late:
            text = f"the solver is {self._lateness_s:.1f} s behind: this computer is too slow"
            self._report("", "solver_late", text, time.monotonic())
        self._is_late = is_late

    # ---- results

    def _publish(self, events: Iterable[LiveEvent], received_s: float) -> None:
        for event in events:
            if isinstance(event, PoseEstimate):
                device = self._devices.setdefault(event.device, DeviceStatus())
                device.pose, device.state, device.reason = event, event.state, event.reason
                device.poses += 1
                device.latency_s = time.monotonic() - received_s
            elif isinstance(event, StateChange):
                device = self._devices.setdefault(event.device, DeviceStatus())
                device.state, device.reason = event.state, event.reason
            elif isinstance(event, ArtifactUpdate):
                self._scene_version = event.version
            elif isinstance(event, WarningEvent):
                self._warnings[event.warning.message] += 1
            message = LiveMessage(event, received_s)
            for sink in self._sinks:
                try:
                    sink.offer(message)
                except Exception as error:  # Of another package: the others go on.
                    self._note_sink_error(sink, error)
            for number in self._recorders_of(event):
                self._recorded[number].add(event)

    def _note_sink_error(self, sink: Sink, error: Exception) -> None:
        """Report the first error of a sink, and keep the last one for the status."""
        is_first = id(sink) not in self._sink_errors
        self._sink_errors[id(sink)] = describe(error)
        if is_first:
            self._tell(f"{sink.address} failed: {describe(error)}")

    def _sink_status(self, sink: Sink) -> SinkStatus:
        error = self._sink_errors.get(id(sink), "")
        try:
            status = sink.status()
        except Exception as failure:  # Of another package.
            return SinkStatus(error=describe(failure), address=sink.address)
        return status if status.error or not error else replace(status, error=error)

    def _recorders_of(self, event: LiveEvent) -> list[int]:
        """Return the inputs in whose recording an event belongs."""
        recording = [each.number for each in self._inputs if each.is_recording]
        name = getattr(event, "device", "")
        own = [
            number
            for number in recording
            if name == self._inputs[number].name or name.startswith(f"{self._inputs[number].name}-")
        ]
        return own[:1] or recording[:1]

    def _report(self, device: str, code: str, text: str, received_s: float) -> None:
        self._tell(f"{device}: {text}" if device else text)
        event = WarningEvent(device, self._clock.now(), SolverWarning(code, text))
        self._publish([event], received_s)

    def _report_once(self, code: str, text: str, received_s: float) -> None:
        if not self._warnings[text]:
            self._report("", code, text, received_s)

    def status(self) -> dict[str, Any]:
        """Return the health of the session for JSON.

        ``ok`` is false if an input is disconnected, a recording has failed, the solver is late, or
        a sink does not work; lost devices do not count. Sinks call it in threads of their own.
        """
        sinks = [self._sink_status(sink) for sink in self._sinks]
        inputs: list[dict[str, Any]] = [
            {
                "name": each.name,
                "port": each.port,
                "connected": each.is_connected,
                "bytes": each.totals().bytes,
                "bad_frames": each.totals().bad,
                "lost_frames": each.totals().lost,
                "dropped_bytes": each.dropped_bytes,
                "recording": None
                if each.request.output is None
                else {
                    "file": str(each.request.output),
                    "running": each.is_recording,
                    "error": each.recording_error,
                },
            }
            for each in self._inputs
        ]
        is_ok = (
            not self._is_late
            and all(each["connected"] for each in inputs)
            and all(each["recording"] is None or each["recording"]["running"] for each in inputs)
            and not any(each.error for each in sinks)
        )
        return {
            "version": 1,
            "ok": is_ok,
            "system": self.system,
            "uptime_s": round(time.monotonic() - self._started_s, 3) if self._started_s else 0.0,
            "lateness_s": round(self._lateness_s, 4),
            "artifact_version": self._scene_version,
            "devices": {
                name: {
                    "state": str(each.state),
                    "reason": each.reason,
                    "poses": each.poses,
                    "rate_hz": round(each.rate_hz, 2),
                    "latency_s": round(each.latency_s, 4),
                }
                for name, each in self.devices.items()
            },
            "inputs": inputs,
            "sinks": [
                {
                    "address": each.address,
                    "sent": each.sent,
                    "dropped": each.dropped,
                    "clients": each.clients,
                    "error": each.error,
                }
                for each in sinks
            ],
            "rejected": self._rejected,
            "warnings": list(dict(self._warnings)),
        }

    @property
    def devices(self) -> dict[str, DeviceStatus]:
        """State of each device."""
        return dict(self._devices)


def _is_session(port: str) -> bool:
    """Return whether a port plays a session."""
    return port.startswith(CAMERA) and is_session_address(port.removeprefix(CAMERA))


def describe(error: Exception) -> str:
    """Return an error of any kind on one line."""
    if isinstance(error, LocatkError):
        return str(error)
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
