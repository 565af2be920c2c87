"""Conversion of received data to messages of a session: raw bytes, and records of a decoder."""

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
from locatk.formats.artifacts import maps
from locatk.formats.capture.clocks import ArrivalTimes, DeviceClock
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.devices import Device, find_device
from locatk.formats.devices.identification import MAX_IDENTIFICATION_S, Identifier, Verdict
from locatk.formats.devices.interface import Batch, Counts, Decoder, Options, Stream
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import frames, messages
from locatk.formats.sessions.capture_statistics import CaptureStatistics
from locatk.formats.sessions.inertial import IMU_TOPIC_PREFIX
from locatk.formats.sessions.messages import MAX_BATCH_SAMPLES, Layout

PAUSE_NS = 3_000_000
"""Silence of the line that separates two frames: within a frame, bytes follow each other, or wait
for the next millisecond of USB."""

AUTO = "auto"

UNPACED = ("replay:", "socket:", "rfc2217:", "loop:", "ble:")
"""Ports whose bytes are not spaced by a baud rate."""


class Intake(Protocol):
    """Converts received data to messages.

    Attributes
    ----------
    declared : sequence of (str, type)
        Topics that are certain to occur, with their messages.
    """

    declared: Sequence[tuple[str, type[Message]]]

    @property
    def system(self) -> str:
        """System of the session, ``""`` while it is unknown."""

    def take(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Return the messages of received data."""

    def turn(self, now_ns: int) -> Iterator[StampedMessage]:
        """Return the messages that are due at ``now_ns``, whether or not data were received."""

    def restart(self) -> Iterator[StampedMessage]:
        """Return the messages that were held back, after a reconnect."""

    def finish(self) -> Iterator[StampedMessage]:
        """Return the messages that were held back, at the end."""

    def count(self, totals: CaptureStatistics) -> None:
        """Write the counts into ``totals``."""

    def remarks(self) -> list[str]:
        """Return new facts that a user of the records must know."""

    def clocks(self) -> dict[str, str]:
        """Return the parameters of the devices' clocks, as entries of the metadata record."""

    def rates(self) -> dict[str, float]:
        """Return records per second by topic, between the first and the last."""

    def artifacts(self) -> dict[str, str]:
        """Return artifacts that follow from the device, name to text."""


class SerialIntake:
    """Bytes of a serial line.

    Parameters
    ----------
    name : str
        Name of the device in topics.
    port : str
        Port as given by the user.
    device_name : str
        Name in :data:`locatk.formats.devices.DEVICES`, of an entry point, or ``"auto"``.
    options : Options
        Options of the decoder.
    baud : int, optional
        Baud rate of the port; that of the device by default.
    artifacts : mapping of str to str
        Attachments of the session: name to text.

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
        self._offset = self._fed = self._stored = 0
        self._opened = True
        self._last_ns: int | None = None
        self._first_ns: int | None = None
        text = (artifacts or {}).get(maps.HALLS_FILE)
        halls = () if text is None else maps.loads_halls(text).names
        self._encoder = MessageEncoder(name, halls)
        self._arrivals = ArrivalTimes()
        self._streams_by_device: dict[tuple[str, str], Stream] = {}
        self._with_artifacts: set[Stream] = set()
        self._counts = Counts()
        self._remarks: list[str] = []
        self._decoder: Decoder | None = None
        self._identifier: Identifier | None = None
        self._pending: list[tuple[bytes, bool] | None] = []  # None: opened again
        if device_name == AUTO:
            self._identifier = Identifier(self._options)
        else:
            self._set_device(find_device(device_name))

    def _set_device(self, device: Device) -> None:
        self.device = device
        self._decoder = device.create_decoder(self._options)
        if not self._port.lower().startswith(UNPACED):
            self._arrivals.byte_ns = 10e9 / (self._baud or device.baud)

    def take(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Return the messages of received data: first all raw ones, then the records."""
        yield from self.chunks(arrived)
        yield from self._packed(self.decode(arrived))

    def chunks(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Return the raw bytes of received data as messages."""
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
            self._stored += each.size
            yield StampedMessage(self.topic, chunk, each.time_ns, each.time_ns)

    def decode(self, arrived: Sequence[ReceivedData]) -> list[TimedBatch]:
        """Return the records of received data, without messages: for a solver that runs along."""
        pieces: list[tuple[bool, list[bytes]]] = []
        for each in arrived:
            self._fed += each.size
            self._arrivals.add(self._fed, each.time_ns)
            pause = self._last_ns is None or each.time_ns - self._last_ns >= PAUSE_NS
            self._last_ns = each.time_ns
            self._first_ns = self._first_ns or each.time_ns
            if pause or not pieces:
                pieces.append((pause, []))
            pieces[-1][1].append(each.data)
        return [
            batch
            for pause, data in pieces
            for batch in self._records(partial(self._feed, b"".join(data), pause))
        ]

    def _feed(self, data: bytes, pause: bool) -> list[Batch]:
        if self._decoder is not None:
            return self._decoder.feed(data, pause=pause)
        if self._identifier is None:
            return []
        self._pending.append((data, pause))
        self._identifier.feed(data, pause=pause)
        return self._identified(self._identifier.verdict())

    def turn(self, now_ns: int) -> Iterator[StampedMessage]:
        """Return the messages of :meth:`decode_identified`."""
        yield from self._packed(self.decode_identified(now_ns))

    def decode_identified(self, now_ns: int) -> list[TimedBatch]:
        """End the identification of the device after MAX_IDENTIFICATION_S; return its records."""
        if self._identifier is None or self._first_ns is None:
            return []
        if now_ns - self._first_ns <= MAX_IDENTIFICATION_S * 1e9:
            return []
        return self._records(self._settle)

    def _settle(self) -> list[Batch]:
        return [] if self._identifier is None else self._identified(self._identifier.settle())

    def _identified(self, verdict: Verdict | None) -> list[Batch]:
        if verdict is None:
            return []
        if self._fed:
            self._remarks.append(f"identified device: {verdict.device} ({verdict.why})")
        self._identifier = None
        self._set_device(find_device(verdict.device))
        pending, self._pending = self._pending, []
        batches = []
        for piece in pending:
            batches += self._restart_decoder() if piece is None else self._feed(*piece)
        return batches

    def restart(self, *, opened: bool = True) -> Iterator[StampedMessage]:
        """Return the records that were held back, and discard a partial frame.

        Byte offsets continue. ``opened`` is False if the connection was not lost, and bytes are
        missing from an incomplete recording instead.
        """
        self._opened = opened
        yield from self._packed(self.decode_restart())

    def mark_opened(self) -> None:
        """Mark the next bytes as the first ones since the port was opened."""
        self._opened = True

    def decode_restart(self) -> list[TimedBatch]:
        """Return the records that were held back, and discard a partial frame."""
        records = self._records(self._restart_decoder)
        # After what was held back, which was received before the reconnect.
        self._encoder.restart()
        return records

    def _restart_decoder(self) -> list[Batch]:
        if self._decoder is not None:
            return self._decoder.restart()
        self._pending += [None] * (self._identifier is not None)
        return []

    def skip_to(self, offset: int) -> None:
        """Continue at byte ``offset`` after a hole in an incomplete recording."""
        if offset > self._offset > 0:
            self._remarks.append(
                f"{offset - self._offset} bytes are missing at byte {self._offset}"
            )
        self._offset = offset

    def finish(self) -> Iterator[StampedMessage]:
        """Return the messages of the records that the decoder held back."""
        yield from self._packed(self.decode_finish())

    def decode_finish(self) -> list[TimedBatch]:
        """Return the records that the decoder held back, at the end."""
        records = self._records(self._settle)
        if self._decoder is not None:
            records += self._records(self._decoder.finish)
        return records

    def _packed(self, records: Sequence[TimedBatch]) -> Iterator[StampedMessage]:
        for batch in records:
            try:
                packed = list(pack_records(batch))
            except Exception as error:  # The decoder may be of another package.
                self._stop_decoding(error)
                return
            yield from packed

    def _records(self, decode: Callable[[], list[Batch]]) -> list[TimedBatch]:
        """Return the batches of ``decode`` with their times.

        An exception ends the decoding, but not the recording of the bytes.
        """
        try:
            batches = decode()
            stamped = list(self._encoder.timed(batches, self._arrivals, self._last_ns or 0))
        except Exception as error:  # The decoder may be of another package.
            self._stop_decoding(error)
            return []
        for batch in batches:
            if len(batch):
                self._streams_by_device[batch.stream.kind, self._encoder.device(batch.stream)] = (
                    batch.stream
                )
                self.system = self.system or SYSTEMS.get(batch.stream.kind, "")
        return stamped

    def _stop_decoding(self, error: Exception) -> None:
        self._remarks.append(
            f"the decoder failed ({type(error).__name__}: {error}); only raw bytes are recorded "
            "from now on. Please report this error"
        )
        if self._decoder is not None:
            self._counts = self._decoder.counts
            self._remarks += self._decoder.remarks
        self._decoder = self._identifier = None
        self._pending = []

    def count(self, totals: CaptureStatistics) -> None:
        """Write the counts of the decoder, and the records per topic, into ``totals``."""
        # A full disk can end the storage between the raw bytes and their records.
        totals.bytes = max(self._fed, self._stored)
        if self._decoder is not None:
            self._counts = self._decoder.counts
        counts = self._counts
        totals.frames, totals.bad, totals.lost = counts.frames, counts.bad, counts.lost
        totals.skipped, totals.unknown = counts.skipped, counts.unknown
        totals.samples = dict(self._encoder.samples)

    def remarks(self) -> list[str]:
        """Return new remarks of the decoder and the identification."""
        remarks, self._remarks = self._remarks + self._encoder.remarks, []
        self._encoder.remarks = []
        if self._decoder is not None:
            remarks += self._decoder.remarks
            self._decoder.remarks.clear()
        return remarks

    def clocks(self) -> dict[str, str]:
        """Return offset, drift and jitter (95th percentile of the delay) of each device's clock."""
        entries: dict[str, str] = {}
        for name, clock in self._encoder.clocks().items():
            if clock.jitter_ns is not None and clock.jitter_ns[1] < 0:
                continue  # Ticks ahead of their arrival belong to no clock in step with the host.
            if clock.offset_ns is not None:
                entries[f"tick_offset_s:{name}"] = f"{clock.offset_ns / 1e9:.6f}"
            if clock.drift_ppm is not None:
                entries[f"tick_drift_ppm:{name}"] = f"{clock.drift_ppm:.3f}"
            if clock.jitter_ns is not None:
                entries[f"tick_jitter_s:{name}"] = f"{clock.jitter_ns[1] / 1e9:.6f}"
            entries[f"tick_restarts:{name}"] = str(clock.restarts)
        return entries

    def rates(self) -> dict[str, float]:
        """Return decoded records per second by topic."""
        return self._encoder.rates()

    def artifacts(self) -> dict[str, str]:
        """Return the default artifacts of the device, by its streams."""
        if self.device is None:
            return {}
        entries: dict[str, str] = {}
        for stream in self._streams_by_device.values():
            if stream not in self._with_artifacts:
                self._with_artifacts.add(stream)
                try:
                    entries |= self.device.default_artifacts(stream)
                except Exception as error:  # The device may be of another package.
                    self._remarks.append(f"no artifacts of {self.device.name}: {error}")
        return entries


class CameraIntake:
    """Frames of a camera, encoded as image files.

    Parameters
    ----------
    name : str
        Name of the camera in topics.
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
        """Return one message per frame."""
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
        """Return nothing."""
        return iter(())

    def restart(self) -> Iterator[StampedMessage]:
        """Return nothing, because frames are independent."""
        return iter(())

    def finish(self) -> Iterator[StampedMessage]:
        """Return nothing."""
        return iter(())

    def count(self, totals: CaptureStatistics) -> None:
        """Write the number of frames and their bytes into ``totals``."""
        totals.bytes, totals.frames = self._bytes, self._frames
        totals.samples = {self.topic: self._frames}

    def remarks(self) -> list[str]:
        """Return nothing."""
        return []

    def clocks(self) -> dict[str, str]:
        """Return nothing: a frame has the time at which it was taken from the driver."""
        return {}

    def rates(self) -> dict[str, float]:
        """Return frames per second."""
        span_s = (self._last_ns - self._first_ns) * 1e-9
        return {self.topic: (self._frames - 1) / span_s} if span_s > 0 else {}

    def artifacts(self) -> dict[str, str]:
        """Return nothing."""
        return {}


SYSTEMS = {
    "magnetometers": "polaris",
    "halls": "landmarks",
    "lighthouse": "lighthouse",
    "captures": "lighthouse",
}
"""System that solves a kind of records."""

MIN_RATE_SPAN_S = 0.01
"""Shortest time from which a rate is computed."""

LEVELS = (Log.UNKNOWN, Log.DEBUG, Log.INFO, Log.WARNING, Log.ERROR, Log.FATAL)


@dataclass(frozen=True)
class StampedMessage:
    """Message of a session, with the times of its completion and of its measurement."""

    topic: str
    message: Message
    time_ns: int
    publish_ns: int


@dataclass(frozen=True)
class TimedBatch:
    """Records of one stream with times of the host's clock.

    Attributes
    ----------
    stream : Stream
    device : str
        Name of the device in the session.
    topic : str
    time_ns : (n,) int64 ndarray
        Time of each measurement, strictly ascending in a topic.
    completed_ns : int
        Time at which the last of them was received.
    columns : dict of str to ndarray
        As :attr:`.interface.Batch.columns`, and ``device_ticks``, ``sequence`` as received.
    """

    stream: Stream
    device: str
    topic: str
    time_ns: NDArray[np.int64]
    completed_ns: int
    columns: dict[str, NDArray[Any]]


class MessageEncoder:
    """Converts batches of a decoder to messages with times of the host's clock.

    Parameters
    ----------
    name : str
        Name of the device; if there are several behind the port, they are ``<name>-<node>``.
    halls : sequence of str
        Names of the hall sensors in the order of ``halls.toml``; empty if unknown.

    Attributes
    ----------
    samples : Counter
        Records by topic.
    remarks : list of str
        Facts that a user of the records must know.
    """

    def __init__(self, name: str, halls: Sequence[str] = ()) -> None:
        self._name = name
        self._halls = tuple(halls)
        self._reported_names: set[tuple[str, ...]] = set()
        self.remarks: list[str] = []
        self._first: dict[str, int] = {}
        self._last: dict[str, int] = {}
        self._clocks: dict[str, DeviceClock] = {}
        self.samples: Counter[str] = Counter()

    def device(self, stream: Stream) -> str:
        """Return the name of the device of a stream."""
        return f"{self._name}-{stream.node}" if stream.node else self._name

    def rates(self) -> dict[str, float]:
        """Return records per second by topic, between the first and the last."""
        spans = {topic: (self._last[topic] - first) * 1e-9 for topic, first in self._first.items()}
        return {
            topic: (self.samples[topic] - 1) / span
            for topic, span in spans.items()
            if span > MIN_RATE_SPAN_S
        }

    def clocks(self) -> dict[str, TickClock]:
        """Return the clock models of plausible ticks, by device and name of its counter."""
        return {name: clock.model for name, clock in self._clocks.items() if clock.rate is None}

    def restart(self) -> None:
        """Restart the clock models after a reconnect."""
        for clock in self._clocks.values():
            clock.restart()

    def messages(
        self, batches: Sequence[Batch], arrivals: ArrivalTimes, now_ns: int
    ) -> Iterator[StampedMessage]:
        """Yield the messages of ``batches``; see :meth:`timed`."""
        for records in self.timed(batches, arrivals, now_ns):
            yield from pack_records(records)

    def timed(
        self, batches: Sequence[Batch], arrivals: ArrivalTimes, now_ns: int
    ) -> Iterator[TimedBatch]:
        """Yield ``batches``, which were all complete at ``now_ns``, with their times.

        Times of measurements are those of the device's ticks, if it sends any, or else the arrival
        times of their last bytes.
        """
        for batch in batches:
            if len(batch) == 0:
                continue
            device = self.device(batch.stream)
            if batch.stream.kind == "log":
                read_ns = arrivals.read_ns(batch.end)
                yield TimedBatch(batch.stream, device, "/log", read_ns, now_ns, batch.columns)
                continue
            if batch.stream.kind not in TOPIC_PREFIXES:
                raise ValueError(f"unknown kind of records: {batch.stream.kind}")
            topic = TOPIC_PREFIXES[batch.stream.kind] + device
            time_ns = self._ascending(topic, self._times(batch, arrivals))
            self._first.setdefault(topic, int(time_ns[0]))
            self.samples[topic] += len(batch)
            columns: dict[str, NDArray[Any]] = dict(batch.columns)
            if batch.stream.kind == "halls":
                columns["b_tesla"] = self._in_order(batch.stream.names, columns["b_tesla"])
            if batch.tick is not None:
                columns["device_ticks"] = batch.tick
            if batch.sequence is not None:
                columns["sequence"] = batch.sequence
            yield TimedBatch(batch.stream, device, topic, time_ns, now_ns, columns)

    def _in_order(self, names: tuple[str, ...], field: NDArray[Any]) -> NDArray[Any]:
        """Return fields (n, N) in the order of ``halls.toml``, by the names that a device sends."""
        if not names or not self._halls or names == self._halls:
            return field
        if sorted(names) == sorted(self._halls):
            return field[:, [names.index(name) for name in self._halls]]
        if names not in self._reported_names:
            self._reported_names.add(names)
            self.remarks.append(
                f"the device names its hall sensors {', '.join(names)}, halls.toml names them "
                f"{', '.join(self._halls)}: they are assigned in order"
            )
        return field

    def _times(self, batch: Batch, arrivals: ArrivalTimes) -> NDArray[np.int64]:
        ticks = batch.stream.ticks
        if batch.tick is None or ticks is None:
            return arrivals.wire_ns(batch.end)
        name = "-".join(filter(None, (self.device(batch.stream), ticks.name)))
        clock = self._clocks.get(name)
        if clock is None or clock.ticks != ticks:
            clock = self._clocks[name] = DeviceClock(ticks)
        believed = clock.rate is None
        times = clock.times(batch.stream.kind, batch.tick, arrivals.read_ns(batch.end))
        if believed and clock.rate is not None:
            self.remarks.append(
                f"the clock of {name} runs {clock.rate:.2g} times as fast as stated: samples "
                "have the times of their arrival"
            )
        return arrivals.wire_ns(batch.end) if times is None else times

    def _ascending(self, topic: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return times that increase by at least a nanosecond, also across batches."""
        if len(time_ns) == 1:
            only = max(int(time_ns[0]), self._last.get(topic, -1) + 1)
            self._last[topic] = only
            return np.array([only], np.int64)
        steps = np.arange(len(time_ns))
        last = self._last.get(topic, -1)
        rising = np.maximum.accumulate(np.maximum(time_ns - steps, last + 1)) + steps
        self._last[topic] = int(rising[-1])
        return rising


TOPIC_PREFIXES = {
    "magnetometers": "/magnetometers/",
    "halls": "/halls/",
    "lighthouse": "/lighthouse/",
    "captures": "/captures/",
    "odometry": "/odometry/",
    "imu": IMU_TOPIC_PREFIX,
    "poses": "/onboard_track/",
    "readings": "/readings/",
}
"""Topic of each kind of records, without the name of the device."""


def pack_records(records: TimedBatch) -> Iterator[StampedMessage]:
    """Yield the messages of records with their times."""
    stream = records.stream
    if stream.kind == "log":
        columns = records.columns
        rows = zip(columns["level"], columns["text"], records.time_ns.tolist(), strict=True)
        for level, text, time_ns in rows:
            line = Log(
                timestamp=messages.timestamp(time_ns),
                level=LEVELS[int(level)],
                message=str(text),
                name=records.device,
            )
            yield StampedMessage("/log", line, records.completed_ns, time_ns)
        return
    layout, fields = _stream_layout(stream, records.device)
    columns = {"time_ns": records.time_ns, **records.columns}
    for start in range(0, len(records.time_ns), MAX_BATCH_SAMPLES):
        part = slice(start, start + MAX_BATCH_SAMPLES)
        message = layout.pack(fields, {key: column[part] for key, column in columns.items()})
        yield StampedMessage(
            records.topic, message, records.completed_ns, int(records.time_ns[start])
        )


def _stream_layout(stream: Stream, device: str) -> tuple[Layout, dict[str, Any]]:
    """Return layout and constant fields of a stream of a device."""
    field: dict[str, Any] = {"device": device, "frame_id": device, "sensors": stream.sensors}
    if stream.kind == "magnetometers":
        return messages.magnetometers(stream.sensors), field
    if stream.kind == "halls":
        return messages.halls(stream.sensors), field
    if stream.kind == "lighthouse":
        return messages.SWEEPS, {"device": device}
    if stream.kind == "captures":
        return messages.CAPTURES, {"device": device}
    if stream.kind == "odometry":
        return messages.ODOMETRY, {"device": device, "frame_id": "odometry"}
    if stream.kind == "imu":
        return messages.IMU, {"device": device}
    if stream.kind == "poses":
        return messages.POSES, {"device": device, "frame_id": "onboard"}
    assert stream.kind == "readings"
    return messages.readings(len(stream.names)), {"device": device, "names": stream.names}
