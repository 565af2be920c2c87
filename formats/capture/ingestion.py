"""What was read becomes messages: raw bytes as they are, and what a decoder makes of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Protocol

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.message import Message

from locatk.formats.artifacts import maps
from locatk.formats.capture.arrival_times import Arrivals
from locatk.formats.capture.device_messages import SYSTEMS, Stamped, Streams
from locatk.formats.capture.reader_thread import Arrived
from locatk.formats.capture.statistics import Totals
from locatk.formats.devices import Device, device
from locatk.formats.devices.decoder import Batch, Counts, Decoder, Options, Stream
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import frames, messages

if TYPE_CHECKING:
    from locatk.formats.devices.identification import Identifier, Verdict

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

    def take(self, arrived: Sequence[Arrived]) -> Iterator[Stamped]:
        """Messages of what was read."""

    def turn(self, now_ns: int) -> Iterator[Stamped]:
        """Time has gone on, whether or not something was read."""

    def restart(self) -> Iterator[Stamped]:
        """The line was lost and is there again."""

    def finish(self) -> Iterator[Stamped]:
        """Nothing more comes."""

    def count(self, totals: Totals) -> None:
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
        text = (artifacts or {}).get(maps.HALLS_FILE)
        halls = () if text is None else maps.loads_halls(text).names
        self._streams = Streams(name, halls)
        self._arrivals = Arrivals()
        self._known: dict[tuple[str, str], Stream] = {}
        self._asked: set[Stream] = set()
        self._counts = Counts()
        self._said: list[str] = []
        self._decoder: Decoder | None = None
        self._identifier: Identifier | None = None
        self._held: list[tuple[bytes, bool] | None] = []  # None: opened again
        if device_name == AUTO:
            from locatk.formats.devices.identification import Identifier

            self._identifier = Identifier(self._options)
        else:
            self._decide(device(device_name))

    def _decide(self, found: Device) -> None:
        self.device = found
        self._decoder = found.decode(self._options)
        if not self._port.startswith(UNPACED):
            self._arrivals.byte_ns = 10e9 / (self._baud or found.baud)

    def take(self, arrived: Sequence[Arrived]) -> Iterator[Stamped]:
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
            yield Stamped(self.topic, chunk, each.time_ns, each.time_ns)
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

    def turn(self, now_ns: int) -> Iterator[Stamped]:
        """Settle what the device is, when it was listened to for long enough."""
        if self._identifier is not None and self._first_ns is not None:
            from locatk.formats.devices.identification import LISTEN_S

            if now_ns - self._first_ns > LISTEN_S * 1e9:
                yield from self._records(self._settle)

    def _settle(self) -> list[Batch]:
        return [] if self._identifier is None else self._identified(self._identifier.settle())

    def _identified(self, verdict: Verdict | None) -> list[Batch]:
        if verdict is None:
            return []
        if self._fed:
            self._said.append(f"the device is taken for {verdict.device}: {verdict.why}")
        self._identifier = None
        self._decide(device(verdict.device))
        held, self._held = self._held, []
        batches = []
        for piece in held:
            batches += self._again() if piece is None else self._feed(*piece)
        return batches

    def restart(self, *, opened: bool = True) -> Iterator[Stamped]:
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

    def finish(self) -> Iterator[Stamped]:
        """What the decoder held back."""
        yield from self._records(self._settle)
        if self._decoder is not None:
            yield from self._records(self._decoder.finish)

    def _records(self, decode: Callable[[], list[Batch]]) -> list[Stamped]:
        """Messages of what ``decode`` gives. Whatever it raises ends the decoding, and not
        the recording: the bytes go on."""
        try:
            batches = decode()
            made = list(self._streams.messages(batches, self._arrivals, self._last_ns or 0))
        except Exception as error:  # of a decoder that may be somebody else's
            self._give_up(error)
            return []
        for batch in batches:
            if len(batch):
                self._known[batch.stream.kind, self._streams.device(batch.stream)] = batch.stream
                self.system = self.system or SYSTEMS.get(batch.stream.kind, "")
        return made

    def _give_up(self, error: Exception) -> None:
        self._said.append(
            f"the decoder failed ({type(error).__name__}: {error}): from here on there are only "
            "raw bytes. Please report it"
        )
        if self._decoder is not None:
            self._counts = self._decoder.counts
            self._said += self._decoder.remarks
        self._decoder = self._identifier = None
        self._held = []

    def count(self, totals: Totals) -> None:
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
                    found |= self.device.attached(stream)
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

    def take(self, arrived: Sequence[Arrived]) -> Iterator[Stamped]:
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
                yield Stamped(self.topic, message, time_ns, time_ns)

    def turn(self, now_ns: int) -> Iterator[Stamped]:
        """Nothing."""
        return iter(())

    def restart(self) -> Iterator[Stamped]:
        """Nothing: each frame stands alone."""
        return iter(())

    def finish(self) -> Iterator[Stamped]:
        """Nothing."""
        return iter(())

    def count(self, totals: Totals) -> None:
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
