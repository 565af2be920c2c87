"""The locatk protocol, as the firmware in docs/firmware speaks it: bytes to records."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.formats.devices.decoder import Batch, Counts, Options, Stream, Ticks
from locatk.formats.devices.locatk_frames.encoder import encode as encode
from locatk.formats.devices.locatk_frames.framing import Contents, Deframer, Index
from locatk.formats.devices.locatk_frames.payloads import (
    HEADER,
    READERS,
    SERIES,
    SHAPE,
    VERSION,
    Block,
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
