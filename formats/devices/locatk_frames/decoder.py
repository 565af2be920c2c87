"""The locatk protocol, as the firmware in docs/firmware speaks it: bytes to records."""

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
from locatk.formats.devices.decoder import Batch, Counts, Options, Recording, Stream, Ticks
from locatk.formats.devices.locatk_frames import payloads
from locatk.formats.devices.locatk_frames.framing import LARGEST_CONTENT, Contents, Deframer, Index
from locatk.formats.devices.locatk_frames.payloads import (
    HEADER,
    READERS,
    SERIES,
    SHAPE,
    VERSION,
    Block,
    FrameWriter,
    Hello,
    Type,
    read_hello,
    read_text,
)

TICK_HZ = 1_000_000
"""How fast a clock counts that nobody has told of yet."""

PIECE = 1 << 18
"""Bytes that are decoded at once; more are no quicker, and need more memory."""

INFO, WARNING = 2, 3


@dataclass
class _Node:
    """What is known of one of the devices behind the port.

    Attributes
    ----------
    hello : Hello or None
        Its last.
    assumed : bool
        Whether it gave records before its first one.
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
class _Line:
    """A line of the log, and the frame that told it."""

    frame: int
    level: int
    text: str


@dataclass
class _Tellers:
    """Who told each frame of a piece, by which clock.

    Attributes
    ----------
    known : list of (int, Ticks)
        Nodes, more than once where the rate of a clock changes.
    of : (n,) int ndarray
        Place in ``known``, by frame.
    """

    known: list[tuple[int, Ticks]]
    of: Index

    def add(self, number: int, ticks: Ticks, frames: NDArray[np.bool_]) -> None:
        """Some frames, or all later ones, are of this node and clock."""
        self.of[frames] = len(self.known)
        self.known.append((number, ticks))


class FrameDecoder:
    """Decoder of the locatk protocol; a :class:`.decoder.Decoder`.

    A frame of right CRC counts as received, whatever it says. A sequence number that is
    less than half a round ahead tells how many frames are missing before it; one that is
    further ahead is taken for a step back, as after a new start of the device: then, and
    at a HELLO of the sequence number 0, nothing is :attr:`.Counts.lost`.

    :attr:`.Batch.sequence` is that of the frame, for each of its samples.

    Parameters
    ----------
    options : Options, optional
        None of them matters here.

    Attributes
    ----------
    counts : Counts
        Frames of unknown types are among the ``frames``. What is half received when the
        line is lost or at the end is not ``skipped``.
    remarks : list of str
    """

    def __init__(self, options: Options | None = None) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._deframer = Deframer(self.counts)
        self._nodes: dict[int, _Node] = {}

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Records of the frames that these bytes complete; a pause says nothing here."""
        batches: list[Batch] = []
        for start in range(0, len(data), PIECE):
            contents = self._deframer.feed(data[start : start + PIECE])
            if len(contents):
                batches += self._records(contents)
        return batches

    def restart(self) -> list[Batch]:
        """See :meth:`.Decoder.restart`; how fast the clocks count stays known."""
        self._deframer.restart()
        for node in self._nodes.values():
            node.last = None
        return []

    def finish(self) -> list[Batch]:
        """See :meth:`.Decoder.finish`; nothing is held back."""
        self._deframer.drop()
        for number, node in sorted(self._nodes.items()):
            if node.assumed and node.hello is None:
                self.remarks.append(
                    f"{_named(number)} did not say how fast it counts: ticks were taken for "
                    f"{TICK_HZ} a second"
                )
        return []

    def _records(self, contents: Contents) -> list[Batch]:
        heads = contents.rows(np.arange(len(contents)), 0, HEADER.itemsize).view(HEADER)[:, 0]
        right = np.ones(len(contents), bool)
        anew = self._count_lost(heads)
        lines, tellers = self._read_lines(contents, heads, anew, right)
        pieces = _split(*_log(lines, heads), tellers, contents, heads)
        known = np.isin(heads["type"], (Type.HELLO, Type.TEXT))
        for type, read in READERS.items():
            frames = np.flatnonzero(heads["type"] == type)
            known[frames] = True
            for group in _layouts(contents, frames, type):
                payload = contents.rows(group, HEADER.itemsize, int(contents.size[group[0]]))
                block = read(payload, heads["tick"][group].astype(np.int64))
                right[group] = False if block is None else block.right
                if block is not None:
                    pieces += _split(block, group, tellers, contents, heads)
        self.counts.frames += int(right.sum())
        self.counts.bad += int((~right).sum())
        self.counts.skipped += int(contents.wire[~right].sum())
        self.counts.unknown += int((~known).sum())
        streams: dict[Stream, list[Batch]] = {}
        for piece in pieces:
            streams.setdefault(piece.stream, []).append(piece)
        return [batch for several in streams.values() for batch in _merged(several)]

    def _count_lost(self, heads: NDArray[np.void]) -> NDArray[np.bool_]:
        """Count what the sequence numbers miss; which frames are a new start of a device."""
        anew = np.zeros(len(heads), bool)
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
            anew[frames] = first
        return anew

    def _read_lines(
        self,
        contents: Contents,
        heads: NDArray[np.void],
        anew: NDArray[np.bool_],
        right: NDArray[np.bool_],
    ) -> tuple[list[_Line], _Tellers]:
        """Lines of the log from HELLO and TEXT, and who tells which frame; ``right`` becomes
        false where one of them says what cannot be."""
        lines = []
        tellers = _Tellers([], np.zeros(len(heads), np.int64))
        for number in np.unique(heads["node"]).tolist():
            tellers.add(number, self._nodes[number].ticks, heads["node"] == number)
        for frame in np.flatnonzero(heads["type"] == Type.TEXT).tolist():
            told = read_text(_payload(contents, frame))
            right[frame] = told is not None
            lines += [_Line(frame, *told)] if told else []
        records = np.isin(heads["type"], list(READERS))
        for frame in np.flatnonzero(heads["type"] == Type.HELLO).tolist():
            hello = read_hello(_payload(contents, frame))
            right[frame] = hello is not None
            if hello is not None:
                number = int(heads["node"][frame])
                later = (heads["node"] == number) & (np.arange(len(heads)) >= frame)
                self._assume(number, records & (heads["node"] == number) & ~later)
                before = self._nodes[number].ticks
                line = self._greet(number, hello, bool(anew[frame]))
                lines += [_Line(frame, *line)] if line else []
                if self._nodes[number].ticks != before:
                    tellers.add(number, self._nodes[number].ticks, later)
        for number in self._nodes:
            self._assume(number, records & (heads["node"] == number))
        return sorted(lines, key=lambda line: line.frame), tellers

    def _assume(self, number: int, records: NDArray[np.bool_]) -> None:
        """Note that a node that has not said HELLO has given records."""
        node = self._nodes[number]
        node.assumed |= node.hello is None and bool(records.any())

    def _greet(self, number: int, hello: Hello, anew: bool) -> tuple[int, str] | None:
        """Take a HELLO; level and text of what the log should know of it."""
        node = self._nodes[number]
        if node.assumed and node.hello is None and hello.tick_hz != TICK_HZ:
            self.remarks.append(
                f"{_named(number)} counts {hello.tick_hz} ticks a second: before it said so "
                f"they were taken for {TICK_HZ}"
            )
        news, node.hello = node.hello != hello, hello
        if news and hello.version > VERSION:
            self.remarks.append(
                f"{_named(number)} speaks version {hello.version} of the protocol, of which "
                f"this locatk knows {VERSION}"
            )
        if not news and not anew:
            return None
        said = f"{hello.name or _named(number)}, {hello.tick_hz} ticks a second"
        return (WARNING, f"started anew: {said}") if anew else (INFO, f"hello from {said}")


def _named(number: int) -> str:
    return f"node {number}" if number else "the device"


def _payload(contents: Contents, frame: int) -> bytes:
    start, size = int(contents.start[frame]), int(contents.size[frame])
    return contents.data[start + HEADER.itemsize : start + size].tobytes()


def _layouts(contents: Contents, frames: Index, type: Type) -> list[Index]:
    """Frames of a type, in groups of one layout."""
    if not len(frames):
        return []
    key = contents.size[frames]
    if type in SERIES:
        long = key >= HEADER.itemsize + SHAPE
        shape = contents.rows(frames[long], HEADER.itemsize, HEADER.itemsize + SHAPE)
        key[long] |= shape.view("<u4")[:, 0].astype(np.int64) << 32
    if (key == key[0]).all():
        return [frames]
    order = np.argsort(key, kind="stable")
    return np.split(frames[order], np.flatnonzero(np.diff(key[order])) + 1)


def _log(lines: list[_Line], heads: NDArray[np.void]) -> tuple[Block, Index]:
    """Lines as a block, and their frames."""
    frames = np.array([line.frame for line in lines], np.int64)
    text = np.array([line.text for line in lines], object)[:, None]
    level = np.array([line.level for line in lines], np.int64)[:, None]
    right = np.ones(len(lines), bool)
    tick = heads["tick"][frames].astype(np.int64)[:, None]
    return Block("log", 0, right, tick, {"level": level, "text": text}), frames


def _split(
    block: Block, frames: Index, tellers: _Tellers, contents: Contents, heads: NDArray[np.void]
) -> list[Batch]:
    """Records of right frames of a block, by who told them."""
    batches = []
    for place in np.unique(tellers.of[frames[block.right]]).tolist():
        number, ticks = tellers.known[place]
        which = np.flatnonzero(block.right & (tellers.of[frames] == place))
        each = block.tick.shape[1]
        batches.append(
            Batch(
                Stream(block.kind, str(number) if number else "", block.sensors, ticks=ticks),
                np.repeat(contents.end[frames[which]], each),
                {
                    name: column[which].reshape(-1, *column.shape[2:])
                    for name, column in block.columns.items()
                },
                block.tick[which].ravel(),
                np.repeat(heads["sequence"][frames[which]].astype(np.int64), each),
            )
        )
    return batches


def _merged(pieces: list[Batch]) -> list[Batch]:
    """Batches of one stream, as one in the order on the wire; more where only some records
    have a column."""
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
"""Nanoseconds of a tick."""

HELLO_NS = 1_000_000_000
"""Time from one HELLO to the next."""

MOST_SAMPLES = 8
MOST_SWEEPS = 16
LONGEST_TICKS = 20_000
"""What one frame holds at most: so many samples or sweeps, of so long."""

Times = NDArray[np.int64]


@dataclass(frozen=True)
class _Unsent:
    """A frame that has no sequence number yet; ``time_ns`` is when it can be sent."""

    time_ns: int
    node: int
    type: Type
    tick: int
    payload: bytes


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Frames of all that a recording holds, in the order of their times.

    Devices become nodes in the order in which they are first named (samples, hall sensors,
    odometry, sweeps): the first is node 0. Ticks are microseconds since the first time of
    all; where samples do not come in even steps, a frame tells them to one tick. Each node
    says HELLO first and then every second.

    Returns
    -------
    iterator of (int, bytes)
        When the last sample of a frame was measured, in ns, and the frame.

    Raises
    ------
    InputError
        The recording is empty, or holds what no frame can tell: more than 256 devices, more
        sensors, a sweep of no channel.
    """
    sampled = _sampled(recording)
    times = [time_ns for _, _, time_ns, _ in sampled]
    if recording.sweeps is not None:
        _check(recording.sweeps)
        times.append(recording.sweeps.time_ns)
    times = [each for each in times if len(each)]
    if not times:
        raise InputError("nothing in the recording that a locatk device sends")
    start_ns = min(int(each.min()) for each in times)
    end_ns = max(int(each.max()) for each in times)
    nodes = _nodes([device for _, device, *_ in sampled], recording.sweeps)
    sources = [_hellos(nodes, start_ns, end_ns)]
    for type, device, time_ns, values in sampled:
        sources.append(_series(type, nodes[device], time_ns, values, start_ns))
    if recording.sweeps is not None:
        for number in np.unique(recording.sweeps.device).tolist():
            node = nodes[recording.sweeps.devices[number]]
            sources.append(_sweeps(recording.sweeps, number, node, start_ns))
    return _sent(sources)


def _sampled(recording: Recording) -> list[tuple[Type, str, Times, NDArray[np.float32]]]:
    """Type, device, times (n,) and values (n, N, ...) of what is sampled."""
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
            raise InputError(f"{values.shape[1]} sensors of {device}, where a frame tells 255")
        if np.isinf(values).any():
            raise InputError(f"an infinite value of {device}, which no frame tells")
    return sampled


def _check(sweeps: Sweeps) -> None:
    """Refuse sweeps that a frame cannot tell."""
    ranges = (
        ("sensor", sweeps.sensor, 0, 255),
        ("channel", sweeps.channel, CHANNELS[0], CHANNELS[-1]),
        ("polynomial", sweeps.polynomial, UNKNOWN, 31),
        ("sweep", sweeps.sweep, UNKNOWN, 1),
        ("count", sweeps.count, 0, payloads.COUNT_END / payloads.COUNT_STEPS - 1),
    )
    for name, values, low, high in ranges:
        wrong = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(wrong):
            raise InputError(f"{name} {values[wrong[0]]} of sweep {wrong[0]}, which no frame tells")


def _nodes(sampled: Sequence[str], sweeps: Sweeps | None) -> dict[str, int]:
    """Devices, and their numbers."""
    seen = () if sweeps is None else np.unique(sweeps.device).tolist()
    devices = [*sampled, *(sweeps.devices[number] for number in seen if sweeps is not None)]
    nodes = {device: number for number, device in enumerate(dict.fromkeys(devices))}
    if len(nodes) > 256:
        raise InputError(f"{len(nodes)} devices, where one port tells 256 apart")
    return nodes


def _sent(sources: list[Iterator[_Unsent]]) -> Iterator[tuple[int, bytes]]:
    writers: dict[int, FrameWriter] = {}
    for unsent in heapq.merge(*sources, key=lambda each: each.time_ns):
        writer = writers.setdefault(unsent.node, FrameWriter(unsent.node))
        yield unsent.time_ns, writer.frame(unsent.type, unsent.tick, unsent.payload)


def _hellos(nodes: dict[str, int], start_ns: int, end_ns: int) -> Iterator[_Unsent]:
    for time_ns in range(start_ns, end_ns + 1, HELLO_NS):
        for device, node in nodes.items():
            payload = payloads.hello(1_000_000_000 // TICK_NS, device)
            yield _Unsent(time_ns, node, Type.HELLO, (time_ns - start_ns) // TICK_NS, payload)


def _series(
    type: Type, node: int, time_ns: Times, values: NDArray[np.float32], start_ns: int
) -> Iterator[_Unsent]:
    """Samples in frames of even steps."""
    ticks = ((time_ns - start_ns) // TICK_NS).tolist()
    most = max(1, min(MOST_SAMPLES, (LARGEST_CONTENT - 16) // (4 * values[:1].size)))
    start = 0
    while start < len(ticks):
        stop, step = _even(ticks, start, most)
        payload = payloads.series(values[start:stop], step)
        yield _Unsent(int(time_ns[stop - 1]), node, type, ticks[start], payload)
        start = stop


def _even(ticks: list[int], start: int, most: int) -> tuple[int, int]:
    """Where the samples from ``start`` on end that one frame can tell, and their step."""
    first, stop = ticks[start], start + 1
    if stop == len(ticks) or most == 1 or not 0 < ticks[stop] - first <= LONGEST_TICKS:
        return stop, 0
    step = ticks[stop] - first
    while (
        stop < min(len(ticks), start + most)
        and ticks[stop] - first <= LONGEST_TICKS
        and abs(first + (stop - start) * step - ticks[stop]) <= 1
    ):
        stop += 1
    return stop, step


def _sweeps(sweeps: Sweeps, device: int, node: int, start_ns: int) -> Iterator[_Unsent]:
    """Sweeps of one device, in the order of their times."""
    mine = np.flatnonzero(sweeps.device == device)
    mine = mine[np.argsort(sweeps.time_ns[mine], kind="stable")]
    ticks = (sweeps.time_ns[mine] - start_ns) // TICK_NS
    start = 0
    while start < len(mine):
        stop = int(np.searchsorted(ticks, ticks[start] + LONGEST_TICKS, "right"))
        stop = min(stop, start + MOST_SWEEPS)
        part = mine[start:stop]
        payload = payloads.sweeps(
            ticks[start:stop] & 0xFFFFFFFF,
            sweeps.sensor[part],
            sweeps.channel[part],
            sweeps.polynomial[part],
            sweeps.sweep[part],
            sweeps.count[part],
        )
        time_ns = int(sweeps.time_ns[part[-1]])
        yield _Unsent(time_ns, node, Type.LIGHTHOUSE_SWEEP, int(ticks[start]), payload)
        start = stop
