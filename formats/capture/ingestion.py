"""What was read becomes messages: raw bytes as they are, and what a decoder makes of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message
from numpy.typing import NDArray

from locatk.core.clock_sync import TickClock
from locatk.formats.artifacts import hall_sensors
from locatk.formats.capture.clocks import ArrivalTimes, DeviceClock
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.capture.statistics import CaptureStatistics
from locatk.formats.devices import Device, find_device
from locatk.formats.devices.decoder import Batch, Counts, Decoder, Options, Stream
from locatk.formats.devices.identification import MAX_IDENTIFICATION_S, Identifier, Verdict
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import frames, messages
from locatk.formats.sessions.messages import Layout
from locatk.formats.sessions.trajectories import LARGEST_BATCH

PAUSE_NS = 3_000_000
"""A line that is silent for longer is between two frames: within a frame bytes follow each
other, or wait for the next millisecond of USB."""

AUTO = "auto"

UNPACED = ("replay:", "socket:", "rfc2217:", "loop:")
"""Ports whose bytes do not come one after the other at a baud."""


class Intake(Protocol):
    """What becomes of what was read.

    Attributes
    ----------
    declared : sequence of (str, type)
        Topics that are sure to come, with their messages.
    system : str
        Whose session it is, ``""`` while that is not known.
    """

    declared: Sequence[tuple[str, type[Message]]]
    system: str

    def take(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Messages of what was read."""

    def turn(self, now_ns: int) -> Iterator[StampedMessage]:
        """Time has gone on, whether or not something was read."""

    def restart(self) -> Iterator[StampedMessage]:
        """The line was lost and is there again."""

    def finish(self) -> Iterator[StampedMessage]:
        """Nothing more comes."""

    def count(self, totals: CaptureStatistics) -> None:
        """Put what was counted into ``totals``."""

    def remarks(self) -> list[str]:
        """What must be known to use the records, and was not said yet."""

    def clocks(self) -> dict[str, str]:
        """What is known of the devices' clocks, as entries of the metadata record."""

    def rates(self) -> dict[str, float]:
        """Records a second by topic, from the first to the last."""

    def artifacts(self) -> dict[str, str]:
        """Artifacts that are known without being told, name to text."""


class SerialIntake:
    """Bytes of a serial line.

    Parameters
    ----------
    name : str
        Of the device, in topics.
    port : str
        As the user named it.
    device_name : str
        Of :data:`locatk.formats.devices.DEVICES` or an entry point, or ``"auto"``.
    options : Options
        For the decoder.
    baud : int, optional
        Of the port; the device's own where it is left out.
    artifacts : mapping of str to str
        What is attached to the session: name to text.

    Raises
    ------
    InputError
        There is no such device.
    """

    def __init__(
        self,
        name: str,
        port: str,
        device_name: str,
        options: Options | None = None,
        *,
        baud: int | None = None,
        artifacts: Mapping[str, str] | None = None,
    ) -> None:
        self.topic = f"/serial/{name}"
        self.declared: Sequence[tuple[str, type[Message]]] = [(self.topic, SerialChunk)]
        self.system = ""
        self.device: Device | None = None
        self._port, self._options = port, options or Options()
        self._baud = baud
        self._offset = self._fed = 0
        self._opened = True
        self._last_ns: int | None = None
        self._first_ns: int | None = None
        text = (artifacts or {}).get(hall_sensors.HALLS_FILE)
        halls = () if text is None else hall_sensors.loads_halls(text).names
        self._streams = MessageEncoder(name, halls)
        self._arrivals = ArrivalTimes()
        self._known: dict[tuple[str, str], Stream] = {}
        self._asked: set[Stream] = set()
        self._counts = Counts()
        self._said: list[str] = []
        self._decoder: Decoder | None = None
        self._identifier: Identifier | None = None
        self._held: list[tuple[bytes, bool] | None] = []  # None: opened again
        if device_name == AUTO:
            self._identifier = Identifier(self._options)
        else:
            self._set_device(find_device(device_name))

    def _set_device(self, found: Device) -> None:
        self.device = found
        self._decoder = found.create_decoder(self._options)
        if not self._port.startswith(UNPACED):
            self._arrivals.byte_ns = 10e9 / (self._baud or found.baud)

    def take(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Messages of what was read: all raw ones, then the records."""
        pieces: list[tuple[bool, list[bytes]]] = []
        for each in arrived:
            chunk = SerialChunk(
                timestamp=messages.timestamp(each.time_ns),
                port=self._port,
                byte_offset=self._offset,
                data=each.data,
                opened=self._opened,
            )
            self._opened = False
            self._offset += each.size
            self._fed += each.size
            self._arrivals.add(self._fed, each.time_ns)
            pause = self._last_ns is None or each.time_ns - self._last_ns >= PAUSE_NS
            self._last_ns = each.time_ns
            self._first_ns = self._first_ns or each.time_ns
            if pause or not pieces:
                pieces.append((pause, []))
            pieces[-1][1].append(each.data)
            yield StampedMessage(self.topic, chunk, each.time_ns, each.time_ns)
        for pause, data in pieces:
            yield from self._records(partial(self._feed, b"".join(data), pause))

    def _feed(self, data: bytes, pause: bool) -> list[Batch]:
        if self._decoder is not None:
            return self._decoder.feed(data, pause=pause)
        if self._identifier is None:
            return []
        self._held.append((data, pause))
        self._identifier.feed(data, pause=pause)
        return self._identified(self._identifier.verdict())

    def turn(self, now_ns: int) -> Iterator[StampedMessage]:
        """Settle what the device is, when it was listened to for long enough."""
        if self._identifier is None or self._first_ns is None:
            return
        if now_ns - self._first_ns > MAX_IDENTIFICATION_S * 1e9:
            yield from self._records(self._settle)

    def _settle(self) -> list[Batch]:
        return [] if self._identifier is None else self._identified(self._identifier.settle())

    def _identified(self, verdict: Verdict | None) -> list[Batch]:
        if verdict is None:
            return []
        if self._fed:
            self._said.append(f"the device is taken for {verdict.device}: {verdict.why}")
        self._identifier = None
        self._set_device(find_device(verdict.device))
        held, self._held = self._held, []
        batches = []
        for piece in held:
            batches += self._again() if piece is None else self._feed(*piece)
        return batches

    def restart(self, *, opened: bool = True) -> Iterator[StampedMessage]:
        """What is half received is dropped; byte offsets go on. Not ``opened`` where only
        bytes are missing from a recording."""
        self._opened = opened
        yield from self._records(self._again)
        self._streams.restart()  # after what was held back, which is of the time before

    def _again(self) -> list[Batch]:
        if self._decoder is not None:
            return self._decoder.restart()
        self._held += [None] * (self._identifier is not None)
        return []

    def skip_to(self, offset: int) -> None:
        """Of a recording that is not whole: the next byte is number ``offset``."""
        if offset > self._offset > 0:
            self._said.append(f"{offset - self._offset} bytes are missing at byte {self._offset}")
        self._offset = offset

    def finish(self) -> Iterator[StampedMessage]:
        """What the decoder held back."""
        yield from self._records(self._settle)
        if self._decoder is not None:
            yield from self._records(self._decoder.finish)

    def _records(self, decode: Callable[[], list[Batch]]) -> list[StampedMessage]:
        """Messages of what ``decode`` gives. Whatever it raises ends the decoding, and not
        the recording: the bytes go on."""
        try:
            batches = decode()
            made = list(self._streams.messages(batches, self._arrivals, self._last_ns or 0))
        except Exception as error:  # of a decoder that may be somebody else's
            self._stop_decoding(error)
            return []
        for batch in batches:
            if len(batch):
                self._known[batch.stream.kind, self._streams.device(batch.stream)] = batch.stream
                self.system = self.system or SYSTEMS.get(batch.stream.kind, "")
        return made

    def _stop_decoding(self, error: Exception) -> None:
        self._said.append(
            f"the decoder failed ({type(error).__name__}: {error}): from here on there are only "
            "raw bytes. Please report it"
        )
        if self._decoder is not None:
            self._counts = self._decoder.counts
            self._said += self._decoder.remarks
        self._decoder = self._identifier = None
        self._held = []

    def count(self, totals: CaptureStatistics) -> None:
        """What the decoder counted, and how many records there are of each topic."""
        totals.bytes = self._fed
        if self._decoder is not None:
            self._counts = self._decoder.counts
        counts = self._counts
        totals.frames, totals.bad, totals.lost = counts.frames, counts.bad, counts.lost
        totals.skipped, totals.unknown = counts.skipped, counts.unknown
        totals.samples = dict(self._streams.samples)

    def remarks(self) -> list[str]:
        """Of the decoder and of the identification."""
        said, self._said = self._said + self._streams.remarks, []
        self._streams.remarks = []
        if self._decoder is not None:
            said += self._decoder.remarks
            self._decoder.remarks.clear()
        return said

    def clocks(self) -> dict[str, str]:
        """Of each device's clock against the host's: offset, drift, and how late the latest
        twentieth of what it sends arrives."""
        found: dict[str, str] = {}
        for name, clock in self._streams.clocks().items():
            if clock.jitter_ns is not None and clock.jitter_ns[1] < 0:
                continue  # ticks ahead of their arrival are of no clock that runs with ours
            if clock.offset_ns is not None:
                found[f"tick_offset_s:{name}"] = f"{clock.offset_ns / 1e9:.6f}"
            if clock.drift_ppm is not None:
                found[f"tick_drift_ppm:{name}"] = f"{clock.drift_ppm:.3f}"
            if clock.jitter_ns is not None:
                found[f"tick_jitter_s:{name}"] = f"{clock.jitter_ns[1] / 1e9:.6f}"
            found[f"tick_restarts:{name}"] = str(clock.restarts)
        return found

    def rates(self) -> dict[str, float]:
        """Of what was decoded."""
        return self._streams.rates()

    def artifacts(self) -> dict[str, str]:
        """Sensors of devices that are what they are."""
        if self.device is None:
            return {}
        found: dict[str, str] = {}
        for stream in self._known.values():
            if stream not in self._asked:
                self._asked.add(stream)
                try:
                    found |= self.device.default_artifacts(stream)
                except Exception as error:  # of a device that may be somebody else's
                    self._said.append(f"no artifacts of {self.device.name}: {error}")
        return found


class CameraIntake:
    """Frames of a camera, already packed as image files.

    Parameters
    ----------
    name : str
        Of the camera, in topics.
    format : str
        ``"png"`` or ``"jpeg"``.
    """

    def __init__(self, name: str, format: str) -> None:
        self.topic = f"{frames.TOPIC}{name}"
        self.declared: Sequence[tuple[str, type[Message]]] = [(self.topic, CompressedImage)]
        self.system = "dots"
        self._name, self._format = name, format
        self._frames = self._bytes = self._first_ns = self._last_ns = 0

    def take(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """One message a frame."""
        for each in arrived:
            for time_ns, image, *_ in each.data:
                self._first_ns = self._first_ns or time_ns
                self._last_ns = time_ns
                self._frames += 1
                self._bytes += len(image)
                message = CompressedImage(
                    timestamp=messages.timestamp(time_ns),
                    frame_id=self._name,
                    data=image,
                    format=self._format,
                )
                yield StampedMessage(self.topic, message, time_ns, time_ns)

    def turn(self, now_ns: int) -> Iterator[StampedMessage]:
        """Nothing."""
        return iter(())

    def restart(self) -> Iterator[StampedMessage]:
        """Nothing: each frame stands alone."""
        return iter(())

    def finish(self) -> Iterator[StampedMessage]:
        """Nothing."""
        return iter(())

    def count(self, totals: CaptureStatistics) -> None:
        """Frames and their bytes."""
        totals.bytes, totals.frames = self._bytes, self._frames
        totals.samples = {self.topic: self._frames}

    def remarks(self) -> list[str]:
        """None."""
        return []

    def clocks(self) -> dict[str, str]:
        """None: a frame has the time at which it was taken from the driver."""
        return {}

    def rates(self) -> dict[str, float]:
        """Of the frames."""
        span_s = (self._last_ns - self._first_ns) * 1e-9
        return {self.topic: (self._frames - 1) / span_s} if span_s > 0 else {}

    def artifacts(self) -> dict[str, str]:
        """None."""
        return {}


SYSTEMS = {
    "magnetometers": "polaris",
    "halls": "landmarks",
    "lighthouse": "lighthouse",
    "captures": "lighthouse",
}
"""Kind of records to the system that solves them."""

MIN_RATE_SPAN_S = 0.01
"""Of less there is no rate."""

LEVELS = (Log.UNKNOWN, Log.DEBUG, Log.INFO, Log.WARNING, Log.ERROR, Log.FATAL)


@dataclass(frozen=True)
class StampedMessage:
    """A message on its way into a session: when it was complete, and measured."""

    topic: str
    message: Message
    time_ns: int
    publish_ns: int


class MessageEncoder:
    """Messages of the batches that a decoder gives.

    Parameters
    ----------
    name : str
        Of the device; those behind it, if several, are ``<name>-<node>``.
    halls : sequence of str
        Names of the hall sensors in the order that ``halls.toml`` has them; empty where that
        is not known.

    Attributes
    ----------
    samples : Counter
        Records by topic, so far.
    remarks : list of str
        What must be known to use the records.
    """

    def __init__(self, name: str, halls: Sequence[str] = ()) -> None:
        self._name = name
        self._halls = tuple(halls)
        self._doubted: set[tuple[str, ...]] = set()
        self.remarks: list[str] = []
        self._first: dict[str, int] = {}
        self._last: dict[str, int] = {}
        self._times_of: dict[str, DeviceClock] = {}
        self.samples: Counter[str] = Counter()

    def device(self, stream: Stream) -> str:
        """Name of the device whose records these are."""
        return f"{self._name}-{stream.node}" if stream.node else self._name

    def rates(self) -> dict[str, float]:
        """Records a second by topic, from the first to the last."""
        spans = {topic: (self._last[topic] - first) * 1e-9 for topic, first in self._first.items()}
        return {
            topic: (self.samples[topic] - 1) / span
            for topic, span in spans.items()
            if span > MIN_RATE_SPAN_S
        }

    def clocks(self) -> dict[str, TickClock]:
        """By device, of those that tell their ticks and can be believed."""
        return {name: known.clock for name, known in self._times_of.items() if known.rate is None}

    def restart(self) -> None:
        """The devices were away: their clocks may have begun anew."""
        for known in self._times_of.values():
            known.restart()

    def messages(
        self, batches: Sequence[Batch], arrivals: ArrivalTimes, now_ns: int
    ) -> Iterator[StampedMessage]:
        """Messages of ``batches``, all complete at ``now_ns``; what was measured when, is told
        by the device's ticks where it has any, else by the arrival of the last byte."""
        for batch in batches:
            if len(batch) == 0:
                continue
            if batch.stream.kind == "log":
                yield from self._log(batch, arrivals.read_ns(batch.end), now_ns)
            else:
                yield from self._records(batch, self._times(batch, arrivals), now_ns)

    def _records(
        self, batch: Batch, time_ns: NDArray[np.int64], now_ns: int
    ) -> Iterator[StampedMessage]:
        stream, device = batch.stream, self.device(batch.stream)
        topic, layout, once = _form(stream, device)
        time_ns = self._ascending(topic, time_ns)
        self._first.setdefault(topic, int(time_ns[0]))
        self.samples[topic] += len(batch)
        columns: dict[str, NDArray[Any]] = {"time_ns": time_ns, **batch.columns}
        if stream.kind == "halls":
            columns["b_tesla"] = self._in_order(stream.names, columns["b_tesla"])
        if batch.tick is not None:
            columns["device_ticks"] = batch.tick
        if batch.sequence is not None:
            columns["sequence"] = batch.sequence
        for start in range(0, len(batch), LARGEST_BATCH):
            part = slice(start, start + LARGEST_BATCH)
            message = layout.pack(once, {key: column[part] for key, column in columns.items()})
            yield StampedMessage(topic, message, now_ns, int(time_ns[start]))

    def _in_order(self, names: tuple[str, ...], field: NDArray[Any]) -> NDArray[Any]:
        """Fields (n, N) of sensors that a device names, in the order of ``halls.toml``."""
        if not names or not self._halls or names == self._halls:
            return field
        if sorted(names) == sorted(self._halls):
            return field[:, [names.index(name) for name in self._halls]]
        if names not in self._doubted:
            self._doubted.add(names)
            self.remarks.append(
                f"hall sensors are named {', '.join(names)}, and in halls.toml "
                f"{', '.join(self._halls)}: they are taken in their order"
            )
        return field

    def _times(self, batch: Batch, arrivals: ArrivalTimes) -> NDArray[np.int64]:
        ticks = batch.stream.ticks
        if batch.tick is None or ticks is None:
            return arrivals.wire_ns(batch.end)
        device = self.device(batch.stream)
        known = self._times_of.get(device)
        if known is None or known.ticks != ticks:
            known = self._times_of[device] = DeviceClock(ticks)
        believed = known.rate is None
        times = known.times(batch.stream.kind, batch.tick, arrivals.read_ns(batch.end))
        if believed and known.rate is not None:
            self.remarks.append(
                f"the clock of {device} runs {known.rate:.2g} times as fast as it says: samples "
                "have the times of their arrival"
            )
        return arrivals.wire_ns(batch.end) if times is None else times

    def _ascending(self, topic: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The same times, each later than the one before it by a nanosecond at least."""
        steps = np.arange(len(time_ns))
        last = self._last.get(topic, -1)
        rising = np.maximum.accumulate(np.maximum(time_ns - steps, last + 1)) + steps
        self._last[topic] = int(rising[-1])
        return rising

    def _log(
        self, batch: Batch, read_ns: NDArray[np.int64], now_ns: int
    ) -> Iterator[StampedMessage]:
        name = self.device(batch.stream)
        rows = zip(batch.columns["level"], batch.columns["text"], read_ns.tolist(), strict=True)
        for level, text, time_ns in rows:
            stamp = messages.timestamp(time_ns)
            line = Log(timestamp=stamp, level=LEVELS[int(level)], message=str(text), name=name)
            yield StampedMessage("/log", line, now_ns, time_ns)


def _form(stream: Stream, device: str) -> tuple[str, Layout, dict[str, Any]]:
    """Topic, layout and what is said once of a stream of a device."""
    field: dict[str, Any] = {"device": device, "frame_id": device, "sensors": stream.sensors}
    if stream.kind == "magnetometers":
        return f"/magnetometers/{device}", messages.magnetometers(stream.sensors), field
    if stream.kind == "halls":
        return f"/halls/{device}", messages.halls(stream.sensors), field
    if stream.kind == "lighthouse":
        return f"/lighthouse/{device}", messages.SWEEPS, {"device": device}
    if stream.kind == "captures":
        return f"/captures/{device}", messages.CAPTURES, {"device": device}
    if stream.kind == "odometry":
        once: dict[str, Any] = {"device": device, "frame_id": "odometry"}
        return f"/odometry/{device}", messages.ODOMETRY, once
    if stream.kind == "readings":
        once = {"device": device, "names": stream.names}
        return f"/readings/{device}", messages.readings(len(stream.names)), once
    raise ValueError(f"no such kind of records: {stream.kind}")
