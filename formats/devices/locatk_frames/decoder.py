"""Device ``locatk``: the protocol of the firmware in docs/firmware, to records and back."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.lighthouse.channels import CHANNELS
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.formats.devices.interface import Batch, Counts, Options, Recording, Stream, Ticks
from locatk.formats.devices.locatk_frames import payloads
from locatk.formats.devices.locatk_frames.framing import (
    MAX_CONTENT_BYTES,
    Contents,
    Deframer,
    Index,
)
from locatk.formats.devices.locatk_frames.payloads import (
    HEADER,
    PROTOCOL_VERSION,
    READERS,
    SERIES,
    SHAPE_BYTES,
    Block,
    FrameWriter,
    Hello,
    Type,
    read_hello,
    read_text,
)

TICK_HZ = 1_000_000
"""Tick rate of a device before its first HELLO."""

PIECE_BYTES = 1 << 18
"""Bytes decoded at a time; larger pieces need more memory and are not faster."""

INFO, WARNING = 2, 3


@dataclass
class _Node:
    """State of one of the devices behind the port.

    Attributes
    ----------
    hello : Hello or None
        Its last one.
    assumed : bool
        It has sent records before its first HELLO.
    last : int or None
        Its last sequence number.
    """

    hello: Hello | None = None
    assumed: bool = False
    last: int | None = None

    @property
    def ticks(self) -> Ticks:
        return Ticks(TICK_HZ if self.hello is None else self.hello.tick_hz, 32)


@dataclass(frozen=True)
class _LogLine:
    """Log message, and the index of its frame."""

    frame: int
    level: int
    text: str


@dataclass
class _FrameSources:
    """Node and clock of each frame of a piece.

    Attributes
    ----------
    known : list of (int, Ticks)
        Nodes; several entries if the tick rate of a node changes.
    of : (n,) int ndarray
        Index into ``known`` of each frame.
    """

    known: list[tuple[int, Ticks]]
    of: Index

    def add(self, number: int, ticks: Ticks, frames: NDArray[np.bool_]) -> None:
        """Assign a node and clock to some frames."""
        self.of[frames] = len(self.known)
        self.known.append((number, ticks))


class FrameDecoder:
    """Decoder of the locatk protocol; a :class:`.decoder.Decoder`.

    A frame with a valid CRC counts as received, whatever its content. A sequence number less than
    half a cycle ahead gives the number of missing frames; one further ahead is a step back, as
    after a restart of the device. Then, and at a HELLO with sequence number 0, nothing is
    :attr:`.Counts.lost`.

    :attr:`.Batch.sequence` of each sample is that of its frame.

    Parameters
    ----------
    options : Options, optional
        Not used.

    Attributes
    ----------
    counts : Counts
        Frames of unknown types are among the ``frames``. A partial frame at the end or before a
        reconnect is not ``skipped``.
    remarks : list of str
    """

    def __init__(self, options: Options | None = None) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._deframer = Deframer(self.counts)
        self._nodes: dict[int, _Node] = {}
        self._pulses = self._unused = 0

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Return the records of the frames that these bytes complete; pauses are not used."""
        batches: list[Batch] = []
        for start in range(0, len(data), PIECE_BYTES):
            contents = self._deframer.feed(data[start : start + PIECE_BYTES])
            if len(contents):
                batches += self._records(contents)
        return batches

    def restart(self) -> list[Batch]:
        """Discard a partial frame after a reconnect; tick rates stay known."""
        self._deframer.restart()
        for node in self._nodes.values():
            node.last = None
        return []

    def finish(self) -> list[Batch]:
        """Return nothing, because no record is held back; report assumed tick rates."""
        self._deframer.drop()
        for number, node in sorted(self._nodes.items()):
            if node.assumed and node.hello is None:
                self.remarks.append(
                    f"{_node_name(number)} did not send its tick rate, which is assumed to be "
                    f"{TICK_HZ} Hz"
                )
        if self._unused:
            self.remarks.append(
                f"{self._unused} of {self._pulses} pulses of the Lighthouse deck are in no sweep: "
                "their passage has no offset, or they are of another one"
            )
        return []

    def _records(self, contents: Contents) -> list[Batch]:
        heads = contents.rows(np.arange(len(contents)), 0, HEADER.itemsize).view(HEADER)[:, 0]
        valid = np.ones(len(contents), bool)
        restarted = self._count_lost(heads)
        lines, sources = self._read_lines(contents, heads, restarted, valid)
        pieces = _split(*_log_block(lines, heads), sources, contents, heads)
        known = np.isin(heads["type"], (Type.HELLO, Type.TEXT))
        for type, read in READERS.items():
            frames = np.flatnonzero(heads["type"] == type)
            known[frames] = True
            for group in _layouts(contents, frames, type):
                payload = contents.rows(group, HEADER.itemsize, int(contents.size[group[0]]))
                block = read(payload, heads["tick"][group].astype(np.int64))
                valid[group] = False if block is None else block.valid
                if block is not None:
                    pieces += _split(block, group, sources, contents, heads)
                    self._count_pulses(block)
        self.counts.frames += int(valid.sum())
        self.counts.bad += int((~valid).sum())
        self.counts.skipped += int(contents.wire[~valid].sum())
        self.counts.unknown += int((~known).sum())
        streams: dict[Stream, list[Batch]] = {}
        for piece in pieces:
            streams.setdefault(piece.stream, []).append(piece)
        return [batch for several in streams.values() for batch in _merged(several)]

    def _count_pulses(self, block: Block) -> None:
        """Count the pulses of a Lighthouse deck, and those without a sweep."""
        if block.is_present is not None:
            self._pulses += int(np.count_nonzero(block.is_present[block.valid])) + block.unused
            self._unused += block.unused

    def _count_lost(self, heads: NDArray[np.void]) -> NDArray[np.bool_]:
        """Count the missing sequence numbers; return which frames are the restart of a device."""
        restarted = np.zeros(len(heads), bool)
        for number in np.unique(heads["node"]).tolist():
            node = self._nodes.setdefault(number, _Node())
            frames = np.flatnonzero(heads["node"] == number)
            sequence = heads["sequence"][frames].astype(np.int64)
            last = sequence[0] - 1 if node.last is None else node.last
            missing = (sequence - np.append(last, sequence[:-1]) - 1) & 0xFFFF
            first = (heads["type"][frames] == Type.HELLO) & (sequence == 0) & (missing > 0)
            missing[first | (missing >= 1 << 15)] = 0
            self.counts.lost += int(missing.sum())
            node.last = int(sequence[-1])
            restarted[frames] = first
        return restarted

    def _read_lines(
        self,
        contents: Contents,
        heads: NDArray[np.void],
        restarted: NDArray[np.bool_],
        valid: NDArray[np.bool_],
    ) -> tuple[list[_LogLine], _FrameSources]:
        """Return the log messages of HELLO and TEXT frames, and the node and clock of each frame.

        ``valid`` becomes False for invalid ones.
        """
        lines = []
        sources = _FrameSources([], np.zeros(len(heads), np.int64))
        for number in np.unique(heads["node"]).tolist():
            sources.add(number, self._nodes[number].ticks, heads["node"] == number)
        for frame in np.flatnonzero(heads["type"] == Type.TEXT).tolist():
            line = read_text(_payload(contents, frame))
            valid[frame] = line is not None
            lines += [_LogLine(frame, *line)] if line else []
        records = np.isin(heads["type"], list(READERS))
        for frame in np.flatnonzero(heads["type"] == Type.HELLO).tolist():
            hello = read_hello(_payload(contents, frame))
            valid[frame] = hello is not None
            if hello is not None:
                number = int(heads["node"][frame])
                later = (heads["node"] == number) & (np.arange(len(heads)) >= frame)
                self._note_assumed_clock(number, records & (heads["node"] == number) & ~later)
                before = self._nodes[number].ticks
                line = self._take_hello(number, hello, bool(restarted[frame]))
                lines += [_LogLine(frame, *line)] if line else []
                if self._nodes[number].ticks != before:
                    sources.add(number, self._nodes[number].ticks, later)
        for number in self._nodes:
            self._note_assumed_clock(number, records & (heads["node"] == number))
        return sorted(lines, key=lambda line: line.frame), sources

    def _note_assumed_clock(self, number: int, records: NDArray[np.bool_]) -> None:
        """Note that a node has sent records before its first HELLO."""
        node = self._nodes[number]
        node.assumed |= node.hello is None and bool(records.any())

    def _take_hello(self, number: int, hello: Hello, restarted: bool) -> tuple[int, str] | None:
        """Take a HELLO; return level and text of its log message, if it changes anything."""
        node = self._nodes[number]
        if node.assumed and node.hello is None and hello.tick_hz != TICK_HZ:
            self.remarks.append(
                f"the tick rate of {_node_name(number)} is {hello.tick_hz} Hz; {TICK_HZ} Hz was "
                "assumed for the records before its HELLO"
            )
        is_new, node.hello = node.hello != hello, hello
        if is_new and hello.version > PROTOCOL_VERSION:
            self.remarks.append(
                f"{_node_name(number)} uses version {hello.version} of the protocol; this "
                f"locatk supports version {PROTOCOL_VERSION}"
            )
        if not is_new and not restarted:
            return None
        description = f"{hello.name or _node_name(number)}, {hello.tick_hz} ticks/s"
        return (
            (WARNING, f"restarted: {description}")
            if restarted
            else (INFO, f"hello from {description}")
        )


def _node_name(number: int) -> str:
    return f"node {number}" if number else "the device"


def _payload(contents: Contents, frame: int) -> bytes:
    start, size = int(contents.start[frame]), int(contents.size[frame])
    return contents.data[start + HEADER.itemsize : start + size].tobytes()


def _layouts(contents: Contents, frames: Index, type: Type) -> list[Index]:
    """Return the frames of a type in groups of one layout."""
    if not len(frames):
        return []
    key = contents.size[frames]
    if type in SERIES:
        long = key >= HEADER.itemsize + SHAPE_BYTES
        shape = contents.rows(frames[long], HEADER.itemsize, HEADER.itemsize + SHAPE_BYTES)
        key[long] |= shape.view("<u4")[:, 0].astype(np.int64) << 32
    if (key == key[0]).all():
        return [frames]
    order = np.argsort(key, kind="stable")
    return np.split(frames[order], np.flatnonzero(np.diff(key[order])) + 1)


def _log_block(lines: list[_LogLine], heads: NDArray[np.void]) -> tuple[Block, Index]:
    """Return log messages as a block, and the indices of their frames."""
    frames = np.array([line.frame for line in lines], np.int64)
    text = np.array([line.text for line in lines], object)[:, None]
    level = np.array([line.level for line in lines], np.int64)[:, None]
    valid = np.ones(len(lines), bool)
    tick = heads["tick"][frames].astype(np.int64)[:, None]
    return Block("log", 0, valid, tick, {"level": level, "text": text}), frames


def _split(
    block: Block, frames: Index, sources: _FrameSources, contents: Contents, heads: NDArray[np.void]
) -> list[Batch]:
    """Return the records of the valid frames of a block, by node and clock."""
    batches = []
    for index in np.unique(sources.of[frames[block.valid]]).tolist():
        number, ticks = sources.known[index]
        which = np.flatnonzero(block.valid & (sources.of[frames] == index))
        each = block.tick.shape[1]
        batch = Batch(
            Stream(
                block.kind, str(number) if number else "", block.sensors, ticks=block.ticks or ticks
            ),
            np.repeat(contents.end[frames[which]], each),
            {
                name: column[which].reshape(-1, *column.shape[2:])
                for name, column in block.columns.items()
            },
            block.tick[which].ravel(),
            np.repeat(heads["sequence"][frames[which]].astype(np.int64), each),
        )
        if block.is_present is not None:
            batch = batch.take(np.flatnonzero(block.is_present[which]))
        if len(batch):
            batches.append(batch)
    return batches


def _merged(pieces: list[Batch]) -> list[Batch]:
    """Return batches of one stream as one batch in the order of the wire.

    There are more batches if only some records have a column.
    """
    if len(pieces) == 1:
        return pieces
    end = np.concatenate([piece.end for piece in pieces])
    order = np.argsort(end, kind="stable")
    forms = sorted({tuple(piece.columns) for piece in pieces})
    form = np.repeat(
        [forms.index(tuple(piece.columns)) for piece in pieces], [len(piece) for piece in pieces]
    )
    runs = np.split(order, np.flatnonzero(np.diff(form[order])) + 1)
    columns = {
        name: np.concatenate(
            [piece.columns.get(name, np.full(len(piece), np.nan)) for piece in pieces]
        )
        for name in {name for names in forms for name in names}
    }
    tick = np.concatenate([piece.tick for piece in pieces])
    sequence = np.concatenate([piece.sequence for piece in pieces])
    return [
        Batch(
            pieces[0].stream,
            end[run],
            {name: columns[name][run] for name in forms[form[run[0]]]},
            tick[run],
            sequence[run],
        )
        for run in runs
    ]


TICK_NS = 1000
"""Duration of a tick."""

HELLO_INTERVAL_NS = 1_000_000_000
"""Interval between two HELLO frames."""

MAX_FRAME_SAMPLES = 8
MAX_FRAME_SWEEPS = 16
MAX_FRAME_TICKS = 20_000
"""Limits of one frame: number of samples or sweeps, and their duration."""

Times = NDArray[np.int64]


@dataclass(frozen=True)
class _UnnumberedFrame:
    """Frame without a sequence number; ``time_ns`` is the earliest time to send it."""

    time_ns: int
    node: int
    type: Type
    tick: int
    payload: bytes


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Return frames of all observations of a recording, in the order of time.

    Devices become nodes in the order of their first observations (samples, hall sensors, odometry,
    sweeps), from node 0. Ticks are microseconds since the first observation; uneven steps between
    samples are kept to one tick. Each node sends HELLO first and then every second.

    Returns
    -------
    iterator of (int, bytes)
        Time of the last sample of a frame in ns, and the frame.

    Raises
    ------
    InputError
        The recording is empty, or contains values out of range: more than 256 devices or 255
        sensors, a sweep without a channel.
    """
    sampled = _sampled_series(recording)
    times = [time_ns for _, _, time_ns, _ in sampled]
    if recording.sweeps is not None:
        _check_sweep_ranges(recording.sweeps)
        times.append(recording.sweeps.time_ns)
    times = [each for each in times if len(each)]
    if not times:
        raise InputError("the recording contains nothing that a locatk device sends")
    start_ns = min(int(each.min()) for each in times)
    end_ns = max(int(each.max()) for each in times)
    nodes = _nodes([device for _, device, *_ in sampled], recording.sweeps)
    streams = [_hellos(nodes, start_ns, end_ns)]
    for type, device, time_ns, values in sampled:
        streams.append(_series(type, nodes[device], time_ns, values, start_ns))
    if recording.sweeps is not None:
        for number in np.unique(recording.sweeps.device).tolist():
            node = nodes[recording.sweeps.devices[number]]
            streams.append(_sweeps(recording.sweeps, number, node, start_ns))
    return _number_frames(streams)


def _sampled_series(recording: Recording) -> list[tuple[Type, str, Times, NDArray[np.float32]]]:
    """Return type, device, times (n,) and values (n, N, ...) of each sampled series."""
    sampled: list[tuple[Type, str, Times, NDArray[np.float32]]] = []
    for samples in recording.samples:
        values = (samples.field_t * 1e6).astype("<f4")
        sampled.append((Type.MAGNETOMETERS, samples.device, samples.time_ns, values))
    for halls in recording.halls:
        values = (halls.field_t * 1e6).astype("<f4")
        sampled.append((Type.HALLS, halls.device, halls.time_ns, values))
    for track in recording.odometry:
        poses = np.column_stack([track.position[:, :2], heading_from_quaternion(track.quaternion)])
        sampled.append((Type.ODOMETRY, track.device, track.time_ns, poses[:, None].astype("<f4")))
    for _, device, _, values in sampled:
        if values.shape[1] > 255:
            raise InputError(f"{values.shape[1]} sensors of {device}, but a frame has at most 255")
        if np.isinf(values).any():
            raise InputError(f"an infinite value of {device}, which frames cannot contain")
    return sampled


def _check_sweep_ranges(sweeps: Sweeps) -> None:
    """Raise an InputError if a frame cannot contain these sweeps."""
    ranges = (
        ("sensor", sweeps.sensor, 0, 255),
        ("channel", sweeps.channel, CHANNELS[0], CHANNELS[-1]),
        ("polynomial", sweeps.polynomial, UNKNOWN, 31),
        ("sweep", sweeps.sweep, UNKNOWN, 1),
        ("count", sweeps.count, 0, payloads.COUNT_LIMIT / payloads.COUNT_STEPS - 1),
    )
    for name, values, low, high in ranges:
        wrong = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(wrong):
            raise InputError(
                f"{name} {values[wrong[0]]} of sweep {wrong[0]}, which is out of range"
            )


def _nodes(sampled: Sequence[str], sweeps: Sweeps | None) -> dict[str, int]:
    """Return the node number of each device."""
    device_numbers = () if sweeps is None else np.unique(sweeps.device).tolist()
    devices = [
        *sampled,
        *(sweeps.devices[number] for number in device_numbers if sweeps is not None),
    ]
    nodes = {device: number for number, device in enumerate(dict.fromkeys(devices))}
    if len(nodes) > 256:
        raise InputError(f"{len(nodes)} devices, but a port has at most 256")
    return nodes


def _number_frames(streams: list[Iterator[_UnnumberedFrame]]) -> Iterator[tuple[int, bytes]]:
    writers: dict[int, FrameWriter] = {}
    for unsent in heapq.merge(*streams, key=lambda each: each.time_ns):
        writer = writers.setdefault(unsent.node, FrameWriter(unsent.node))
        yield unsent.time_ns, writer.frame(unsent.type, unsent.tick, unsent.payload)


def _hellos(nodes: dict[str, int], start_ns: int, end_ns: int) -> Iterator[_UnnumberedFrame]:
    for time_ns in range(start_ns, end_ns + 1, HELLO_INTERVAL_NS):
        for device, node in nodes.items():
            payload = payloads.hello(1_000_000_000 // TICK_NS, device)
            yield _UnnumberedFrame(
                time_ns, node, Type.HELLO, (time_ns - start_ns) // TICK_NS, payload
            )


def _series(
    type: Type, node: int, time_ns: Times, values: NDArray[np.float32], start_ns: int
) -> Iterator[_UnnumberedFrame]:
    """Yield frames of samples with constant steps."""
    ticks = ((time_ns - start_ns) // TICK_NS).tolist()
    max_samples = max(1, min(MAX_FRAME_SAMPLES, (MAX_CONTENT_BYTES - 16) // (4 * values[:1].size)))
    start = 0
    while start < len(ticks):
        stop, step = _end_of_even_steps(ticks, start, max_samples)
        payload = payloads.series(values[start:stop], step)
        yield _UnnumberedFrame(int(time_ns[stop - 1]), node, type, ticks[start], payload)
        start = stop


def _end_of_even_steps(ticks: list[int], start: int, max_samples: int) -> tuple[int, int]:
    """Return the end of the samples from ``start`` on that fit into one frame, and their step."""
    first, stop = ticks[start], start + 1
    if stop == len(ticks) or max_samples == 1 or not 0 < ticks[stop] - first <= MAX_FRAME_TICKS:
        return stop, 0
    step = ticks[stop] - first
    while (
        stop < min(len(ticks), start + max_samples)
        and ticks[stop] - first <= MAX_FRAME_TICKS
        and abs(first + (stop - start) * step - ticks[stop]) <= 1
    ):
        stop += 1
    return stop, step


def _sweeps(sweeps: Sweeps, device: int, node: int, start_ns: int) -> Iterator[_UnnumberedFrame]:
    """Yield frames of the sweeps of one device, in the order of time."""
    rows = np.flatnonzero(sweeps.device == device)
    rows = rows[np.argsort(sweeps.time_ns[rows], kind="stable")]
    ticks = (sweeps.time_ns[rows] - start_ns) // TICK_NS
    start = 0
    while start < len(rows):
        stop = int(np.searchsorted(ticks, ticks[start] + MAX_FRAME_TICKS, "right"))
        stop = min(stop, start + MAX_FRAME_SWEEPS)
        part = rows[start:stop]
        payload = payloads.sweeps(
            ticks[start:stop] & 0xFFFFFFFF,
            sweeps.sensor[part],
            sweeps.channel[part],
            sweeps.polynomial[part],
            sweeps.sweep[part],
            sweeps.count[part],
        )
        time_ns = int(sweeps.time_ns[part[-1]])
        yield _UnnumberedFrame(time_ns, node, Type.LIGHTHOUSE_SWEEP, int(ticks[start]), payload)
        start = stop
