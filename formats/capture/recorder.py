"""Recorder: writes the events of the reader to files until the recording ends.

There are three threads: the reader only reads the port; this one decodes and writes; the third
one forces the file to the disk (fsync), which may take longer than a port can wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from foxglove_schemas_protobuf.Log_pb2 import Log

from locatk.core.errors import LocatkError
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.ingestion import Intake, StampedMessage
from locatk.formats.capture.links import Overruns
from locatk.formats.capture.reader_thread import (
    ConnectionLost,
    Event,
    ReceivedData,
    Reconnected,
    SourceEnded,
)
from locatk.formats.capture.recording_files import CHUNK_BYTES, RecordingFiles
from locatk.formats.capture.status import CaptureStatus, RecordingResult
from locatk.formats.sessions.capture_statistics import CaptureStatistics

WRITE_INTERVAL_S = 0.02
"""Interval between batches of received data; a message of a stream covers about so much time."""

STATUS_INTERVAL_S = 1.0
"""Interval between checks of rates, disk, silence and clock."""

FRAME_CHECK_S = 5.0
"""Time after which bytes without a frame are reported."""

DISK_WARNING_S = 300.0
"""Remaining time until the disk is full at which that is reported."""


@dataclass(frozen=True)
class Limits:
    """Limits of a recording; None for no limit.

    Attributes
    ----------
    duration_s, max_bytes
        The recording ends.
    rotate_s, rotate_bytes
        A new file begins.
    silence_s : float
        Time without data after which a warning is issued.
    reserve_bytes : int
        Free space of the disk at which the recording ends; 0 to use all of it.
    flush_s : float
        Interval of flushes to the system: with :data:`WRITE_INTERVAL_S`, the most that is lost when
        the program is killed.
    sync_s : float
        Interval of flushes to the disk: the most that is lost in a power failure.
    """

    duration_s: float | None = None
    max_bytes: int | None = None
    rotate_s: float | None = None
    rotate_bytes: int | None = None
    silence_s: float = 5.0
    reserve_bytes: int = 64 << 20
    flush_s: float = 0.2
    sync_s: float = 1.0


def _split_events(events: Sequence[Event]) -> Iterator[list[Event]]:
    """Yield events in pieces of at most a chunk, because sizes are checked after each piece.

    There is at least one piece, which may be empty.
    """
    piece: list[Event] = []
    size = 0
    for event in events:
        piece.append(event)
        size += event.size if isinstance(event, ReceivedData) else 0
        if size >= CHUNK_BYTES:
            yield piece
            piece, size = [], 0
    yield piece


class EventSource(Protocol):
    """Source of the events of a recording: a :class:`.reader_thread.PortReader`, or a part of one.

    Attributes are those of the reader.
    """

    @property
    def received(self) -> int:
        """Bytes so far."""

    @property
    def last_data_ns(self) -> int:
        """When the last of them were read."""

    @property
    def high_water(self) -> int:
        """Most bytes that waited to be taken."""

    @property
    def pauses(self) -> int:
        """How often reading stopped because too much was waiting."""

    @property
    def overruns(self) -> Overruns:
        """Error counters of the kernel."""

    @property
    def dropped(self) -> int:
        """Frames of a camera that were dropped."""

    def start(self) -> None:
        """Start reading."""

    def stop(self) -> bool:
        """End reading; return False if a driver hangs."""

    def take(self) -> Sequence[Event]:
        """Return all events since the last call."""


class Recorder:
    """Records one port.

    Parameters
    ----------
    reader : EventSource
        Not yet started.
    intake : Intake
    files : RecordingFiles
    clock : HostClock
    limits : Limits
    tell : callable
        Takes messages for the user: gaps, silence, a disk that fills up.
    show : callable
        Takes a :class:`CaptureStatus` once per second.
    observe : callable
        Takes each message of the recording before it is written.
    further : callable
        Returns further messages to write, such as poses that were solved meanwhile.
    """

    def __init__(
        self,
        reader: EventSource,
        intake: Intake,
        files: RecordingFiles,
        clock: HostClock,
        limits: Limits,
        *,
        tell: Callable[[str], None],
        show: Callable[[CaptureStatus], None],
        observe: Callable[[StampedMessage], None] | None = None,
        further: Callable[[], Iterable[StampedMessage]] = tuple,
    ) -> None:
        self._further = further
        self._reader, self._intake, self._files = reader, intake, files
        self._clock, self._limits = clock, limits
        self._tell, self._show, self._observe = tell, show, observe
        self._totals = CaptureStatistics()
        self._part_began = CaptureStatistics()
        self._disconnected_ns: int | None = None
        self._step_s = 0.0
        self._pauses = 0
        self._disk_reported = False
        self._flushed_bytes = 0
        self._frames_checked = False

    def run(self, stop: threading.Event) -> RecordingResult:
        """Record until ``stop`` is set, a limit is reached, or the source ends.

        The files are finished when this returns, in all cases.
        """
        self._start_ns = self._part_ns = self._last_data_ns = self._clock.now()
        self._silent = False
        syncing = threading.Event()
        syncer = threading.Thread(
            target=self._sync, args=(syncing,), name="locatk-sync", daemon=True
        )
        syncer.start()
        try:
            self._files.flush()  # A program killed after the first byte leaves a readable file.
            self._reader.start()
            ended, failed = self._write_until_end(stop)
            if not self._reader.stop():
                self._report("the driver of the port hangs: bytes in its buffer are not recorded")
            self._write_remaining()
        # Errors of the disk; those of the port are events of the reader.
        except (LocatkError, OSError) as error:
            self._reader.stop()
            ended, failed = self._disk_error(error), True
        except BaseException as error:
            self._files.finish(self._facts(f"{type(error).__name__}: {error}"))
            raise
        finally:
            self._reader.stop()
            syncing.set()
        recorded = RecordingResult(
            totals=self._count(),
            paths=self._files.paths,
            device=self._device(),
            started_ns=self._start_ns,
            ended_ns=self._clock.now(),
            ended=ended,
            failed=failed,
            system=self._intake.system,
            artifacts=sorted(self._files.artifacts),
            clocks=self._intake.clocks(),
            rates=self._intake.rates(),
        )
        if self._files.is_gone():
            recorded.failed = True
            recorded.ended += f"; {self._files.file.path} was removed or replaced"
        try:
            self._files.finish(self._facts(ended))
        except OSError as error:
            recorded.failed = True
            missing = self._reader.received - self._flushed_bytes
            recorded.ended = (
                f"{error}; the end of the file is missing, with up to {missing} received bytes: "
                "use `locatk recover`"
            )
        recorded.file_bytes = self._files.bytes_written
        syncer.join(self._limits.sync_s)
        return recorded

    def _flush(self) -> None:
        self._files.flush()
        self._flushed_bytes = self._count().bytes

    def _disk_error(self, error: LocatkError | OSError) -> str:
        """Return the error of the disk, and the number of received bytes that are not saved."""
        unsaved = self._reader.received - self._count().bytes
        return f"{error}" + (f"; {unsaved} received bytes are not in the file" if unsaved else "")

    def _write_until_end(self, stop: threading.Event) -> tuple[str, bool]:
        """Write batches of received data; return why it ended, and whether by an error."""
        flushed = shown = time.monotonic()
        before = CaptureStatistics()
        while True:
            over = self._reason_to_stop(stop)
            ended = None
            for events in _split_events(self._reader.take()):
                ended = self._write(events) or ended
                if self._is_full():
                    return "max-size", False
            now = time.monotonic()
            if now - flushed >= self._limits.flush_s:
                flushed = now
                self._flush()
            if now - shown >= STATUS_INTERVAL_S:
                totals = self._count()
                full = self._check_status(totals, before, now - shown)
                before, shown = totals, now
                if full:
                    return full, True
            if ended is not None:
                return ended.error or "end of the source", ended.error is not None
            if over:
                return over, False
            stop.wait(WRITE_INTERVAL_S)

    def _reason_to_stop(self, stop: threading.Event) -> str:
        """Return why the recording must end; ``""`` if it continues."""
        limits = self._limits
        if stop.is_set():
            return "stopped"
        if limits.duration_s is not None and self._elapsed_s() >= limits.duration_s:
            return "duration"
        return ""

    def _is_full(self) -> bool:
        limit = self._limits.max_bytes
        return limit is not None and self._files.bytes_written >= limit

    def _elapsed_s(self) -> float:
        return (self._clock.now() - self._start_ns) * 1e-9

    def _write(self, events: Sequence[Event]) -> SourceEnded | None:
        """Write the events of the reader in their order; return its end, if it is among them."""
        received: list[ReceivedData] = []
        ended = None
        for event in events:
            if isinstance(event, ReceivedData):
                received.append(event)
                self._last_data_ns, self._silent = event.time_ns, False
                continue
            self._take(received)
            received = []
            if isinstance(event, ConnectionLost):
                self._disconnected_ns = event.time_ns
                self._totals.gaps += 1
                self._report(f"connection lost: {event.why}", event.time_ns)
            elif isinstance(event, Reconnected):
                self._close_gap(event)
            else:
                ended = event
        self._take(received)
        self._files.write(self._observed(self._intake.turn(self._clock.now())))
        self._files.write(self._further())
        self._files.system(self._intake.system)
        self._files.attach(self._intake.artifacts())
        for remark in self._intake.remarks():
            self._report(remark)
        return ended

    def _take(self, received: Sequence[ReceivedData]) -> None:
        if received:
            self._rotate()  # Before the first byte of a part, so that none is empty.
            self._files.write(self._observed(self._intake.take(received)))

    def _observed(self, messages: Iterator[StampedMessage]) -> Iterator[StampedMessage]:
        """Yield messages, which the observer takes first."""
        for message in messages:
            if self._observe is not None:
                self._observe(message)
            yield message

    def _close_gap(self, event: Reconnected) -> None:
        assert self._disconnected_ns is not None
        away_s = (event.time_ns - self._disconnected_ns) * 1e-9
        self._totals.gap_s += away_s
        self._disconnected_ns = None
        self._last_data_ns = event.time_ns
        self._files.write(self._intake.restart())
        self._report(f"reconnected to {event.path} after {away_s:.1f} s", event.time_ns)

    def _write_remaining(self) -> None:
        """Write the data received between the last batch and the end."""
        if not self._is_full():
            self._write(self._reader.take())
        if self._disconnected_ns is not None:
            self._totals.gap_s += (self._clock.now() - self._disconnected_ns) * 1e-9
        self._files.write(self._intake.finish())
        self._files.write(self._further())
        for remark in self._intake.remarks():
            self._report(remark)

    def _check_status(
        self, totals: CaptureStatistics, before: CaptureStatistics, elapsed_s: float
    ) -> str:
        """Run the checks of each second; return why to stop, ``""`` for no reason."""
        new = totals.since(before)
        free = self._files.file.free()
        rate = new.bytes / elapsed_s
        self._show(
            CaptureStatus(
                self._elapsed_s(),
                None
                if self._disconnected_ns is None
                else (self._clock.now() - self._disconnected_ns) * 1e-9,
                rate,
                new.frames / elapsed_s,
                totals,
                self._files.bytes_written,
                free,
            )
        )
        self._check_silence()
        self._check_clock()
        self._check_frames(totals)
        if self._reader.pauses > self._pauses:
            self._pauses = self._reader.pauses
            self._report("the disk is slower than the port: reading is paused")
        return "" if free is None else self._check_disk(free)

    def _check_silence(self) -> None:
        # Newer data may wait to be written.
        last_data_ns = max(self._last_data_ns, self._reader.last_data_ns)
        silent_s = (self._clock.now() - last_data_ns) * 1e-9
        if (
            self._disconnected_ns is None
            and not self._silent
            and silent_s >= self._limits.silence_s
        ):
            self._silent = True
            self._totals.silences += 1
            self._report(
                f"no data received for {silent_s:.0f} s: check the power, the wiring and --baud"
            )

    def _check_frames(self, totals: CaptureStatistics) -> None:
        """Report bytes without frames, the most frequent fault of all."""
        device = self._device()
        if (
            not self._frames_checked
            and device
            and self._elapsed_s() >= FRAME_CHECK_S
            and totals.bytes
        ):
            self._frames_checked = True
            for doubt in totals.doubts(device):
                self._report(f"{doubt}: check --device (or use auto) and --baud")

    def _device(self) -> str:
        """Return the name of the device; ``""`` if it is unknown, and of a camera."""
        return getattr(getattr(self._intake, "device", None), "name", "")

    def _check_clock(self) -> None:
        step_s = self._clock.stepped_ns() * 1e-9
        if abs(step_s - self._step_s) > 0.1:
            self._report(
                f"the wall clock was set by {step_s - self._step_s:+.1f} s; times of this "
                "recording are not affected"
            )
            self._step_s = step_s

    def _check_disk(self, free: int) -> str:
        available = free - self._limits.reserve_bytes
        if available <= 0 and self._limits.reserve_bytes:
            return "the disk is full up to --reserve"
        per_s = self._files.bytes_written / max(self._elapsed_s(), 1.0)
        if per_s > 0 and available / per_s < DISK_WARNING_S:
            if not self._disk_reported:
                self._report(f"at this rate the disk will be full in {available / per_s:.0f} s")
            self._disk_reported = True
        else:
            self._disk_reported = False
        return ""

    def _rotate(self) -> None:
        limits = self._limits
        old = (
            limits.rotate_s is not None
            and (self._clock.now() - self._part_ns) * 1e-9 >= limits.rotate_s
        )
        big = limits.rotate_bytes is not None and self._files.part_bytes >= limits.rotate_bytes
        if old or big:
            self._files.next_part(self._facts("continued in the next part"))
            self._part_ns = self._clock.now()
            self._part_began = self._count()
            self._files.flush()

    def _report(self, text: str, time_ns: int | None = None) -> None:
        """Report a message to the user and in the session.

        Without a time it gets that of the last message, because earlier bytes may still wait.
        """
        self._files.log(text, time_ns or self._start_ns, level=Log.WARNING)
        self._tell(text)

    def _count(self) -> CaptureStatistics:
        """Return the present statistics."""
        totals = self._totals
        self._intake.count(totals)
        overruns = self._reader.overruns
        totals.overruns, totals.line_errors = overruns.lost, overruns.frame + overruns.parity
        totals.dropped = self._reader.dropped
        totals.high_water_bytes = self._reader.high_water
        totals.clock_step_s = self._step_s
        return CaptureStatistics(**vars(totals))

    def _facts(self, ended: str) -> dict[str, str]:
        """Return the statistics of the file that ends now, for its metadata."""
        device = self._device()
        return {
            **({"device": device} if device else {}),
            "ended_ns": str(self._clock.now()),
            "ended": ended,
            **self._count().since(self._part_began).texts(),
            **self._intake.clocks(),
        }

    def _sync(self, done: threading.Event) -> None:
        """Force the file to the disk repeatedly, in a thread of its own."""
        while not done.wait(self._limits.sync_s):
            self._files.file.sync()
