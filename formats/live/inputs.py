"""Inputs of a live session: an open port, its reader thread, and a decoder for the solver."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from locatk.core.errors import LocatkError
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.ingestion import (
    AUTO,
    CameraIntake,
    SerialIntake,
    StampedMessage,
    TimedBatch,
)
from locatk.formats.capture.links import Overruns
from locatk.formats.capture.reader_thread import (
    ConnectionLost,
    Event,
    PortReader,
    ReceivedData,
    Reconnected,
    SourceEnded,
)
from locatk.formats.capture.recorder import Recorder
from locatk.formats.capture.replay import PREFIX as REPLAY
from locatk.formats.capture.setup import (
    CAMERA,
    CaptureRequest,
    OpenSource,
    check_request,
    create_files,
    create_intake,
    open_source,
)
from locatk.formats.capture.status import RecordingResult
from locatk.formats.live.observations import (
    AttachedArtifacts,
    Observations,
    RecordConverter,
    frame_observations,
)
from locatk.formats.live.recorded_input import RecordedInput
from locatk.formats.live.session_replay import (
    ObservationsIntake,
    ObservationsPort,
    observation_topics,
)
from locatk.formats.sessions.capture_statistics import CaptureStatistics
from locatk.formats.sessions.frames import SCHEMAS, TOPIC
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD
from locatk.formats.sessions.reader import Session

MAX_WAITING_BYTES = 8 << 20
"""Received bytes that wait for the solver, beyond which those of a device are left out: more than
two seconds of the fastest serial ports. A replayed file waits instead."""

REPLAY_POLL_S = 0.002
"""Interval at which a replayed file checks whether the solver has caught up."""


Decoder = SerialIntake | CameraIntake | ObservationsIntake
"""Decoder of the solver."""


@dataclass(frozen=True, slots=True)
class BytesLeftOut:
    """Bytes before this time were not queued, because too many were waiting."""

    time_ns: int


@dataclass(frozen=True, slots=True)
class Arrival:
    """Event of an input for the solver.

    Attributes
    ----------
    source : int
        Number of the input.
    event : Event
    received_s : float
        ``time.monotonic()`` when it came.
    """

    source: int
    event: Event | BytesLeftOut
    received_s: float


class ArrivalQueue:
    """Queue from the readers to the solver; :meth:`LiveInput._deliver` limits what waits in it."""

    def __init__(self) -> None:
        self._arrivals: deque[Arrival] = deque()
        self._is_filled = threading.Event()

    def put(self, arrival: Arrival) -> None:
        """Add an event and wake up the solver."""
        self._arrivals.append(arrival)
        self._is_filled.set()

    def take(self, wait_s: float) -> list[Arrival]:
        """Return all events; wait for the first one, at most ``wait_s``."""
        if not self._arrivals and not self._is_filled.wait(wait_s):
            return []
        self._is_filled.clear()
        return [self._arrivals.popleft() for _ in range(len(self._arrivals))]


class RecordedOrder:
    """Merges the events of replayed inputs in the order of their times.

    Which thread of a reader runs first does not matter: an event is held back until every other
    input that has not ended has a later one.

    Parameters
    ----------
    inputs : int
        Number of inputs.
    """

    def __init__(self, inputs: int) -> None:
        self._waiting: list[deque[Arrival]] = [deque() for _ in range(inputs)]
        self._last_ns = [0] * inputs
        self._ended: set[int] = set()

    def merge(self, arrivals: Sequence[Arrival]) -> Iterator[Arrival]:
        """Add arrivals, and yield the events whose turn has come."""
        for arrival in arrivals:
            self._waiting[arrival.source].append(arrival)
        while all(queue or n in self._ended for n, queue in enumerate(self._waiting)):
            times = [(self._time_ns(queue[0]), n) for n, queue in enumerate(self._waiting) if queue]
            if not times:
                return
            time_ns, number = min(times)
            arrival = self._waiting[number].popleft()
            self._last_ns[number] = time_ns
            if isinstance(arrival.event, SourceEnded):
                self._ended.add(number)
            yield arrival

    def _time_ns(self, arrival: Arrival) -> int:
        """Return the time of an event; the end of an input is at its last byte."""
        if isinstance(arrival.event, SourceEnded):
            return self._last_ns[arrival.source]
        return arrival.event.time_ns


@dataclass(frozen=True)
class InputNotice:
    """Change of an input that its users must know.

    Attributes
    ----------
    text : str
    """

    text: str


class LiveInput:
    """One input of a live session.

    Parameters
    ----------
    number : int
        Its index among the inputs.
    request : CaptureRequest
        With ``output`` if it is recorded.
    source : OpenSource
    decoder : SerialIntake, CameraIntake or ObservationsIntake
        Of the solver.
    clock : HostClock
    queue : ArrivalQueue
        Takes its events.

    Attributes
    ----------
    name : str
        Name of the device in topics.
    devices : tuple of str
        Devices that are known before data come: this one, or those of a replayed session.
    is_paced : bool
        Its bytes come in real time; otherwise it waits for the solver.
    keeps_time : bool
        Its bytes have the times of a recording.
    is_connected, is_ended : bool
    dropped_bytes : int
        Bytes that the solver did not take because it was late.
    recording : RecordingResult or None
        Result of the recorder, once it has ended.
    recording_error : str
        Reason why the recording is incomplete; ``""`` if it is not.
    """

    def __init__(
        self,
        number: int,
        request: CaptureRequest,
        source: OpenSource,
        decoder: Decoder,
        clock: HostClock,
        queue: ArrivalQueue,
    ) -> None:
        self.number, self.request = number, request
        self.name = request.device_name
        self.devices: tuple[str, ...] = getattr(source.port, "devices", (self.name,))
        self.port = source.port.name
        self.is_paced = source.port.can_reconnect
        self.keeps_time = getattr(source.port, "keeps_time", False)
        self.is_connected, self.is_ended = True, False
        self.dropped_bytes = 0
        self.recording: RecordingResult | None = None
        self.recording_error = ""
        self.artifacts = AttachedArtifacts(source.artifacts)
        self._clock, self._queue = clock, queue
        # Each is written by one thread only.
        self._delivered_bytes = self._taken_bytes = 0
        self._decoded_ns = 0
        self._is_dropping = self._is_stopping = False
        self._end_error: str | None = None
        self._frames = 0
        self._decoder = decoder
        self._converter = RecordConverter(self.artifacts)
        self._reader = PortReader(source.port, source.link, clock, deliver=self._deliver)
        self._stop_recorder = threading.Event()
        self._source = source
        self._thread: threading.Thread | None = None
        self._shared: RecorderView | None = None
        self._recorded: RecordedInput | None = None

    # ---- reader and recorder

    def start(
        self,
        *,
        tell: Callable[[str], None],
        further: Callable[[], Sequence[StampedMessage]],
    ) -> None:
        """Start reading, and recording if the request has an output.

        Parameters
        ----------
        tell : callable
            Takes messages of the recorder.
        further : callable
            Returns messages to record besides those of the input.
        """
        if self.request.output is None:
            self._reader.discard()
        else:
            files = create_files(self.request, self._source, self._clock)
            shared = self._shared = RecorderView(self._reader)
            raw = self._source.intake
            if not isinstance(self._decoder, CameraIntake):
                self._recorded = RecordedInput(raw, self._decoder)  # type: ignore[arg-type]
            recorder = Recorder(
                shared,
                self._recorded or raw,
                files,
                self._clock,
                self.request.limits,
                tell=tell,
                show=lambda status: None,
                further=further,
            )
            self._thread = threading.Thread(
                target=self._record,
                args=(recorder, shared, tell),
                name="locatk-recorder",
                daemon=True,
            )
            self._thread.start()
        self._reader.start()

    def _record(
        self, recorder: Recorder, shared: RecorderView, tell: Callable[[str], None]
    ) -> None:
        try:
            self.recording = recorder.run(self._stop_recorder)
        except Exception as error:  # A fault of the recorder must not end the solver.
            self.recording_error = f"{type(error).__name__}: {error}"
            tell(f"the recording failed: {self.recording_error}")
            return
        finally:
            shared.detach()
        if self.recording.failed:
            self.recording_error = self.recording.ended
        if self.recording.failed and self.recording.ended != self._end_error:
            tell(f"the recording ended: {self.recording.ended}")

    def stop_reading(self) -> None:
        """End reading; what has arrived is delivered."""
        self._is_stopping = True
        self._reader.stop()

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the solver."""
        return self._delivered_bytes - self._taken_bytes

    def stop_recording(self, timeout_s: float) -> None:
        """End the recording, and finish its files."""
        if self._shared is not None:
            self._shared.release_end()
        self._stop_recorder.set()
        if self._thread is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                self.recording_error = f"the disk is too slow: not finished after {timeout_s:g} s"

    def complete_ns(self, now_ns: int) -> int:
        """Return the time up to which everything that was received has been decoded."""
        return now_ns if self.waiting_bytes <= 0 else min(self._decoded_ns, now_ns)

    @property
    def is_recording(self) -> bool:
        """Return whether its bytes are being recorded."""
        return self._thread is not None and self._thread.is_alive()

    def _deliver(self, event: Event) -> None:
        """Queue an event for the solver; runs in the thread of the reader."""
        received_s = time.monotonic()
        if isinstance(event, SourceEnded):
            self._end_error = event.error
        if isinstance(event, ReceivedData):
            while not self.is_paced and self.waiting_bytes > MAX_WAITING_BYTES:
                if self._is_stopping:
                    break
                time.sleep(REPLAY_POLL_S)
            if self.is_paced and self.waiting_bytes + event.size > MAX_WAITING_BYTES:
                self.dropped_bytes += event.size
                self._is_dropping = True
                return
            if self._is_dropping:
                self._is_dropping = False
                self._queue.put(Arrival(self.number, BytesLeftOut(event.time_ns), received_s))
            self._delivered_bytes += event.size
        self._queue.put(Arrival(self.number, event, received_s))

    # ---- decoder, in the thread of the solver

    def decode(
        self, events: Sequence[Event | BytesLeftOut]
    ) -> Iterator[Observations | InputNotice]:
        """Yield the observations and notices of successive events.

        Raises
        ------
        LocatkError
            An artifact that the records need is missing.
        """
        received: list[ReceivedData] = []
        for event in events:
            if isinstance(event, ReceivedData):
                received.append(event)
                continue
            yield from self._observations(received)
            received = []
            if isinstance(event, BytesLeftOut):
                yield from self._restarted()
                yield InputNotice("the solver was late: bytes were left out")
            elif isinstance(event, ConnectionLost):
                self.is_connected = False
                yield InputNotice(f"connection lost: {event.why}")
            elif isinstance(event, Reconnected):
                self.is_connected = True
                yield from self._restarted()
                yield InputNotice(f"reconnected to {event.path}")
            elif isinstance(event, SourceEnded):
                self.is_connected, self.is_ended = False, True
                if not isinstance(self._decoder, CameraIntake):
                    yield from self._converted(self._decoder.decode_finish())
                if event.error is not None:
                    yield InputNotice(event.error)
        yield from self._observations(received)

    def _restarted(self) -> Iterator[Observations | InputNotice]:
        """Discard a partial frame, because bytes are missing; yield what was held back."""
        if not isinstance(self._decoder, CameraIntake):
            yield from self._converted(self._decoder.decode_restart())

    def identify(self, now_ns: int) -> Iterator[Observations | InputNotice]:
        """Decide which device it is if the time for that is over; yield what was held back."""
        if not isinstance(self._decoder, CameraIntake):
            yield from self._converted(self._decoder.decode_identified(now_ns))

    def _observations(
        self, received: Sequence[ReceivedData]
    ) -> Iterator[Observations | InputNotice]:
        if not received:
            return
        if isinstance(self._decoder, CameraIntake):
            for each in received:
                yield from frame_observations(self.name, each.data, self._frames)
                self._frames += len(each.data)
        else:
            yield from self._converted(self._decoder.decode(received))
        # Only now, because the caller solves each observation before it asks for the next one.
        self._taken_bytes += sum(each.size for each in received)
        self._decoded_ns = received[-1].time_ns

    def _converted(self, records: Sequence[TimedBatch]) -> Iterator[Observations | InputNotice]:
        own = self._decoder.artifacts()
        self.artifacts.add(own)
        if self._recorded is not None:
            self._recorded.device_artifacts |= own
            if self.is_recording:
                self._recorded.add(records)
        yield from self._converter.observations(records)
        for remark in self._decoder.remarks():
            yield InputNotice(remark)

    def totals(self) -> CaptureStatistics:
        """Return the counts of the decoder."""
        totals = CaptureStatistics()
        self._decoder.count(totals)
        totals.bytes = self._reader.received
        totals.dropped = self._reader.dropped
        return totals


class RecorderView:
    """View of a reader for a recorder, which cannot start or stop it: the solver uses it as well.

    The end of the source is held back until :meth:`release_end`: the recording also contains the
    poses of the last bytes. Attributes are those of :class:`.reader_thread.PortReader`.
    """

    def __init__(self, reader: PortReader) -> None:
        self._reader = reader
        self._is_released = False
        self._end: list[Event] = []

    def release_end(self) -> None:
        """Let the recorder know the end of the source."""
        self._is_released = True

    @property
    def received(self) -> int:
        """Bytes so far."""
        return self._reader.received

    @property
    def last_data_ns(self) -> int:
        """When the last of them were read."""
        return self._reader.last_data_ns

    @property
    def high_water(self) -> int:
        """Most bytes that waited for the recorder."""
        return self._reader.high_water

    @property
    def pauses(self) -> int:
        """How often reading stopped because too much was waiting."""
        return self._reader.pauses

    @property
    def overruns(self) -> Overruns:
        """Error counters of the kernel."""
        return self._reader.overruns

    @property
    def dropped(self) -> int:
        """Frames of a camera that arrived faster than they were taken."""
        return self._reader.dropped

    def start(self) -> None:
        """Do nothing: the session starts the reader."""

    def stop(self) -> bool:
        """Do nothing: the session stops the reader."""
        return True

    def detach(self) -> None:
        """Keep no more events for a recorder that has ended."""
        self._reader.discard()

    def take(self) -> Sequence[Event]:
        """Return all events since the last call."""
        is_released = self._is_released
        events = self._reader.take()
        self._end += [event for event in events if isinstance(event, SourceEnded)]
        events = [event for event in events if not isinstance(event, SourceEnded)]
        if is_released:
            events, self._end = [*events, *self._end], []
        return events


def open_inputs(
    requests: Sequence[CaptureRequest],
    clock: HostClock,
    stop: threading.Event,
    queue: ArrivalQueue,
    *,
    waiting: Callable[[str], None],
) -> list[LiveInput]:
    """Open all inputs, or none.

    Raises
    ------
    LocatkError
        See :func:`.setup.open_source`.
    """
    inputs: list[LiveInput] = []
    try:
        for number, request in enumerate(requests):
            opened, source, decoder = _open(request, clock, stop, waiting)
            inputs.append(LiveInput(number, opened, source, decoder, clock, queue))
    except LocatkError:
        for each in inputs:
            each.stop_reading()
        raise
    return inputs


def _open(
    request: CaptureRequest,
    clock: HostClock,
    stop: threading.Event,
    waiting: Callable[[str], None],
) -> tuple[CaptureRequest, OpenSource, Decoder]:
    """Open an input; a replay by its content: raw bytes, camera frames or decoded observations."""
    session = _replayed_session(request)
    if session is not None:
        if session.topics("/serial/"):
            recorded_by = session.metadata().get(CAPTURE_RECORD, {}).get("device")
            if recorded_by and request.device == AUTO:
                request = replace(request, device=recorded_by)
        elif any(session.topics(TOPIC, schema) for schema in SCHEMAS):
            request = replace(request, port=f"{CAMERA}{session.path}")
        elif observation_topics(session):
            content = check_request(request)
            port = ObservationsPort(request.port, session, request.speed)
            intake = ObservationsIntake()
            # RecordedInput needs only a part of an intake.
            source = OpenSource(port, port.open(), intake, content)  # type: ignore[arg-type]
            return request, source, intake
    source = open_source(request, clock, stop, waiting=waiting)
    # The recording has an intake of its own, which only keeps the bytes.
    return request, source, create_intake(request, source.artifacts)


def _replayed_session(request: CaptureRequest) -> Session | None:
    """Return the session that a request replays; None if there is none."""
    file = request.port[len(REPLAY) :].removeprefix("//")
    is_replay = request.port.lower().startswith(REPLAY) and request.keeps_time
    if not (is_replay and os.path.exists(file)):
        return None
    try:
        return Session.open(file, damaged_ok=True)
    except LocatkError:
        return None  # Opening it as a port reports the error with a hint.
