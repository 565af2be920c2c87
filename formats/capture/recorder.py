"""The recording itself: from the receiver's events to files, until somebody ends it.

Three threads: the receiver reads the port and nothing else; this one decodes and writes;
a third forces the file to the disk, which may take longer than a port can wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from foxglove_schemas_protobuf.Log_pb2 import Log

from locatk.core.errors import LocatkError
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.ingestion import Intake
from locatk.formats.capture.reader_thread import (
    ConnectionLost,
    Event,
    PortReader,
    ReceivedData,
    Reconnected,
    SourceEnded,
)
from locatk.formats.capture.recording_files import CHUNK_BYTES, RecordingFiles
from locatk.formats.capture.statistics import CaptureStatistics, CaptureStatus, RecordingResult

WRITE_INTERVAL_S = 0.02
"""Between looks at what was received: one message of each stream covers about so much."""

STATUS_INTERVAL_S = 1.0
"""Between looks at rates, disk, silence and clock."""

FRAME_CHECK_S = 5.0
"""After so long bytes without a frame are told of."""

DISK_WARNING_S = 300.0
"""A disk that will be full sooner than this is told of."""


@dataclass(frozen=True)
class Limits:
    """When what is done; None for never.

    Attributes
    ----------
    duration_s, max_bytes
        The recording ends.
    rotate_s, rotate_bytes
        A new part begins.
    silence_s : float
        Without a byte for so long there is a warning.
    reserve_bytes : int
        So much of the disk stays free.
    flush_s : float
        So often what was recorded is given to the system: the most that is lost when the
        program is killed, with :data:`WRITE_INTERVAL_S`.
    sync_s : float
        So often it is forced to the disk: the most that is lost with the power.
    """

    duration_s: float | None = None
    max_bytes: int | None = None
    rotate_s: float | None = None
    rotate_bytes: int | None = None
    silence_s: float = 5.0
    reserve_bytes: int = 64 << 20
    flush_s: float = 0.2
    sync_s: float = 1.0


def _pieces(events: Sequence[Event]) -> Iterator[list[Event]]:
    """The events of a turn, and no more than a chunk of bytes at once: a file is looked at
    after each. At least one piece, if an empty one."""
    piece: list[Event] = []
    size = 0
    for event in events:
        piece.append(event)
        size += event.size if isinstance(event, ReceivedData) else 0
        if size >= CHUNK_BYTES:
            yield piece
            piece, size = [], 0
    yield piece


class Recorder:
    """Records one port.

    Parameters
    ----------
    receiver : PortReader
        Not yet started.
    intake : Intake
    parts : RecordingFiles
    clock : HostClock
    limits : Limits
    tell : callable
        Takes lines for people as they come: gaps, silence, a disk that fills.
    show : callable
        Takes a :class:`CaptureStatus` once a second.
    """

    def __init__(
        self,
        receiver: PortReader,
        intake: Intake,
        parts: RecordingFiles,
        clock: HostClock,
        limits: Limits,
        *,
        tell: Callable[[str], None],
        show: Callable[[CaptureStatus], None],
    ) -> None:
        self._receiver, self._intake, self._parts = receiver, intake, parts
        self._clock, self._limits = clock, limits
        self._tell, self._show = tell, show
        self._totals = CaptureStatistics()
        self._part_began = CaptureStatistics()
        self._lost_ns: int | None = None
        self._step_s = 0.0
        self._held_up = 0
        self._disk_told = False
        self._flushed_bytes = 0
        self._doubted = False

    def run(self, stop: threading.Event) -> RecordingResult:
        """Record until ``stop`` is set, a limit is reached, or nothing more can come.

        The files are finished when this returns, whatever ended it.
        """
        self._start_ns = self._part_ns = self._heard_ns = self._clock.now()
        self._silent = False
        self._parts.flush()
        self._receiver.start()
        syncing = threading.Event()
        syncer = threading.Thread(
            target=self._sync, args=(syncing,), name="locatk-sync", daemon=True
        )
        syncer.start()
        try:
            ended, failed = self._turns(stop)
            if not self._receiver.stop():
                self._say("the port's driver hangs: what it still holds is not recorded")
            self._rest()
        except (LocatkError, OSError) as error:  # of the disk: all else is of the receiver
            self._receiver.stop()
            ended, failed = self._unsaved(error), True
        except BaseException as error:
            self._parts.finish(self._facts(f"{type(error).__name__}: {error}"))
            raise
        finally:
            self._receiver.stop()
            syncing.set()
        recorded = RecordingResult(
            totals=self._count(),
            paths=self._parts.paths,
            device=self._device(),
            started_ns=self._start_ns,
            ended_ns=self._clock.now(),
            ended=ended,
            failed=failed,
            system=self._intake.system,
            artifacts=sorted(self._parts.artifacts),
            clocks=self._intake.clocks(),
            rates=self._intake.rates(),
        )
        if self._parts.is_gone():
            recorded.failed = True
            recorded.ended += f"; somebody has removed or replaced {self._parts.file.path}"
        try:
            self._parts.finish(self._facts(ended))
        except OSError as error:
            recorded.failed = True
            missing = self._receiver.received - self._flushed_bytes
            recorded.ended = (
                f"{error}; the end of the file is missing, with up to {missing} bytes that were "
                "received: `locatk recover` it"
            )
        recorded.file_bytes = self._parts.bytes_written
        syncer.join(self._limits.sync_s)
        return recorded

    def _flush(self) -> None:
        self._parts.flush()
        self._flushed_bytes = self._count().bytes

    def _unsaved(self, error: LocatkError | OSError) -> str:
        """What went wrong with the disk, and what is not on it."""
        left = self._receiver.received - self._count().bytes
        return f"{error}" + (f"; {left} bytes that were received are not in it" if left else "")

    def _turns(self, stop: threading.Event) -> tuple[str, bool]:
        """Write what comes, turn after turn; returns why it ended and whether that is bad."""
        flushed = shown = time.monotonic()
        before = CaptureStatistics()
        while True:
            over = self._over(stop)
            ended = None
            for events in _pieces(self._receiver.take()):
                ended = self._write(events) or ended
                if self._is_full():
                    return "max-size", False
            now = time.monotonic()
            if now - flushed >= self._limits.flush_s:
                flushed = now
                self._flush()
            if now - shown >= STATUS_INTERVAL_S:
                totals = self._count()
                full = self._second(totals, before, now - shown)
                before, shown = totals, now
                if full:
                    return full, True
            if ended is not None:
                return ended.error or "end of the source", ended.error is not None
            if over:
                return over, False
            stop.wait(WRITE_INTERVAL_S)

    def _over(self, stop: threading.Event) -> str:
        """Why it is time to end, ``""`` while it is not."""
        limits = self._limits
        if stop.is_set():
            return "stopped"
        if limits.duration_s is not None and self._elapsed_s() >= limits.duration_s:
            return "duration"
        return ""

    def _is_full(self) -> bool:
        most = self._limits.max_bytes
        return most is not None and self._parts.bytes_written >= most

    def _elapsed_s(self) -> float:
        return (self._clock.now() - self._start_ns) * 1e-9

    def _write(self, events: Sequence[Event]) -> SourceEnded | None:
        """Write what the receiver tells, in its order; returns its end where there is one."""
        arrived: list[ReceivedData] = []
        ended = None
        for event in events:
            if isinstance(event, ReceivedData):
                arrived.append(event)
                self._heard_ns, self._silent = event.time_ns, False
                continue
            self._take(arrived)
            arrived = []
            if isinstance(event, ConnectionLost):
                self._lost_ns = event.time_ns
                self._totals.gaps += 1
                self._say(f"connection lost: {event.why}", event.time_ns)
            elif isinstance(event, Reconnected):
                self._close_gap(event)
            else:
                ended = event
        self._take(arrived)
        self._parts.write(self._intake.turn(self._clock.now()))
        self._parts.system(self._intake.system)
        self._parts.attach(self._intake.artifacts())
        for remark in self._intake.remarks():
            self._say(remark)
        return ended

    def _take(self, arrived: Sequence[ReceivedData]) -> None:
        if arrived:
            self._rotate()  # with the first byte of a part, so that none is empty
            self._parts.write(self._intake.take(arrived))

    def _close_gap(self, event: Reconnected) -> None:
        assert self._lost_ns is not None
        away_s = (event.time_ns - self._lost_ns) * 1e-9
        self._totals.gap_s += away_s
        self._lost_ns = None
        self._heard_ns = event.time_ns
        self._parts.write(self._intake.restart())
        self._say(f"connected again to {event.where} after {away_s:.1f} s", event.time_ns)

    def _rest(self) -> None:
        """What was received between the last turn and the end."""
        if not self._is_full():
            self._write(self._receiver.take())
        if self._lost_ns is not None:
            self._totals.gap_s += (self._clock.now() - self._lost_ns) * 1e-9
        self._parts.write(self._intake.finish())
        for remark in self._intake.remarks():
            self._say(remark)

    def _second(self, totals: CaptureStatistics, before: CaptureStatistics, took_s: float) -> str:
        """What is looked at once a second; returns why to stop, ``""`` for no reason."""
        fresh = totals.since(before)
        free = self._parts.file.free()
        rate = fresh.bytes / took_s
        self._show(
            CaptureStatus(
                self._elapsed_s(),
                None if self._lost_ns is None else (self._clock.now() - self._lost_ns) * 1e-9,
                rate,
                fresh.frames / took_s,
                totals,
                self._parts.bytes_written,
                free,
            )
        )
        self._look_for_silence()
        self._look_at_clock()
        self._look_for_frames(totals)
        if self._receiver.held_up > self._held_up:
            self._held_up = self._receiver.held_up
            self._say("the disk is slower than the port: reading waits")
        return "" if free is None else self._look_at_disk(free)

    def _look_for_silence(self) -> None:
        heard_ns = max(self._heard_ns, self._receiver.heard_ns)  # more may wait to be written
        silent_s = (self._clock.now() - heard_ns) * 1e-9
        if self._lost_ns is None and not self._silent and silent_s >= self._limits.silence_s:
            self._silent = True
            self._totals.silences += 1
            self._say(
                f"nothing received for {silent_s:.0f} s: is it on, does it send, is the baud right?"
            )

    def _look_for_frames(self, totals: CaptureStatistics) -> None:
        """Bytes and nothing in them: the most usual fault of all."""
        device = self._device()
        if not self._doubted and device and self._elapsed_s() >= FRAME_CHECK_S and totals.bytes:
            self._doubted = True
            for doubt in totals.doubts(device):
                self._say(f"{doubt}: is it this device (--device auto), is its baud right?")

    def _device(self) -> str:
        """What is at the port, ``""`` while that is not known, and of a camera."""
        return getattr(getattr(self._intake, "device", None), "name", "")

    def _look_at_clock(self) -> None:
        step_s = self._clock.stepped_ns() * 1e-9
        if abs(step_s - self._step_s) > 0.1:
            self._say(
                f"the wall clock was set by {step_s - self._step_s:+.1f} s; times of this "
                "recording go on as they were"
            )
            self._step_s = step_s

    def _look_at_disk(self, free: int) -> str:
        left = free - self._limits.reserve_bytes
        if left <= 0:
            return "the disk is full but for the reserve"
        per_s = self._parts.bytes_written / max(self._elapsed_s(), 1.0)
        if per_s > 0 and left / per_s < DISK_WARNING_S:
            if not self._disk_told:
                self._say(f"the disk is full in {left / per_s:.0f} s at this rate")
            self._disk_told = True
        else:
            self._disk_told = False
        return ""

    def _rotate(self) -> None:
        limits = self._limits
        old = (
            limits.rotate_s is not None
            and (self._clock.now() - self._part_ns) * 1e-9 >= limits.rotate_s
        )
        big = limits.rotate_bytes is not None and self._parts.part_bytes >= limits.rotate_bytes
        if old or big:
            self._parts.next_part(self._facts("goes on in the next part"))
            self._part_ns = self._clock.now()
            self._part_began = self._count()
            self._parts.flush()

    def _say(self, text: str, time_ns: int | None = None) -> None:
        """To people and into the session; without a time at that of what was written last, as
        bytes that came before now may still wait."""
        self._parts.log(text, time_ns or self._start_ns, level=Log.WARNING)
        self._tell(text)

    def _count(self) -> CaptureStatistics:
        """All that is counted, as of now."""
        totals = self._totals
        self._intake.count(totals)
        overruns = self._receiver.overruns
        totals.overruns, totals.line_errors = overruns.lost, overruns.frame + overruns.parity
        totals.dropped = self._receiver.dropped
        totals.high_water_bytes = self._receiver.high_water
        totals.clock_step_s = self._step_s
        return CaptureStatistics(**vars(totals))

    def _facts(self, ended: str) -> dict[str, str]:
        """What the part that ends now holds, for its metadata."""
        device = self._device()
        return {
            **({"device": device} if device else {}),
            "ended_ns": str(self._clock.now()),
            "ended": ended,
            **self._count().since(self._part_began).texts(),
            **self._intake.clocks(),
        }

    def _sync(self, done: threading.Event) -> None:
        """Force the file to the disk again and again, away from the thread that writes."""
        while not done.wait(self._limits.sync_s):
            self._parts.file.sync()
