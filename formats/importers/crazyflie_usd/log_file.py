"""Binary log files of the Crazyflie's micro SD card deck, versions 1 and 2.

Little-endian without padding (bitcraze/crazyflie-firmware, ``usddeck.c`` and
``tools/usdlog/cfusdlog.py``)::

    u8 0xBC, u16 version, u16 number of event types
    per type:   u16 id, name, u16 number of variables, per variable "name(T)"; texts end with 0
    per event:  u16 id, timestamp (version 1: u32 ms, version 2: u64 us), its variables
    u32 CRC-32 of everything before it

Ids are indices into a table of the firmware and differ between its builds: events are known by
their names. An event has no length, so that the events after a damaged byte cannot be found. A log
whose writer was switched off has no CRC and ends within an event.
"""

from __future__ import annotations

import re
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.formats.files import read_bytes

MAGIC = 0xBC

TIMESTAMPS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}
"""Type of the timestamps of each version, and their unit in seconds."""

VARIABLE_TYPES = {
    "B": "u1", "b": "i1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4", "f": "<f4", "e": "<f2",
}  # fmt: skip
"""Types of variables by the letters of Python's struct module."""

CRC_BYTES = 4

MAX_STEP_S = 60.0
"""Longest time between two events of a file without a correct checksum [s]. A larger step is damage
that led to a wrong event, unless the next events follow it: a log of sweeps alone has a gap if
there is no light."""

FOLLOWING_EVENTS = 3
"""Number of events that must follow a larger step."""

MAX_BACK_STEP_S = 1.0
"""Largest step back of the timestamps [s]. Events of several tasks are out of order by 0.2 ms; a
larger step back means that the parameter ``usec.reset`` set the clock to zero."""

MAX_NAME_BYTES = 100
"""Longest name of an event or a variable; the firmware's longest have 30 bytes."""

HINT = "Give a log of the micro SD card deck, such as log00"

_ID, _TIME = "\nid", "\ntimestamp"
"""Names of the fields in front of the variables, whose names are one line."""

_NAME = re.compile(rb"[ -~]*")
_VARIABLE = re.compile(r"(.+)\((.)\)")


@dataclass(frozen=True)
class Event:
    """All events of one type.

    Attributes
    ----------
    name : str
    time_s : (n,) ndarray
        Timestamps of the Crazyflie's clock, in the order of the file; of whole milliseconds, the
        middle of each.
    columns : dict of str to (n,) ndarray
        Values of the variables, by their names in lower case.
    """

    name: str
    time_s: NDArray[np.float64]
    columns: dict[str, NDArray[np.generic]]

    def __len__(self) -> int:
        return len(self.time_s)

    def floats(self, name: str) -> NDArray[np.float64]:
        """Return the values of a variable (n,) as float64."""
        with np.errstate(invalid="ignore"):  # A signalling nan becomes a quiet one.
            return self.columns[name].astype(np.float64)


@dataclass(frozen=True)
class UsdLog:
    """Content of a log.

    Attributes
    ----------
    version : int
        1 or 2.
    events : dict of str to Event
        By name; types without an event are included.
    resolution_s : float
        Of the timestamps.
    damage : str or None
        Description of the part that could not be read.
    omitted : int
        Number of events before or after the clock was set to zero, whichever part is shorter. The
        times of the two parts have no known relation.
    """

    version: int
    events: dict[str, Event]
    resolution_s: float
    damage: str | None
    omitted: int = 0


def read_usd_log(path: Path) -> UsdLog:
    """Read a log; of a damaged one, all events before the damage.

    Raises
    ------
    MissingDataError, InputError
        There is no such file, or it cannot be read.
    FormatError
        It is not a log of a known version, or its header is incomplete.
    """
    return parse_usd_log(read_bytes(path), path)


def parse_usd_log(data: bytes, path: Path) -> UsdLog:
    """Parse the bytes of a log; raises as :func:`read_usd_log`."""
    if not data or data[0] != MAGIC:
        raise FormatError("not a log of a Crazyflie's micro SD card", file=path, hint=HINT)
    header = _Header(data, path)
    version = header.number()
    if version not in TIMESTAMPS:
        raise FormatError(
            f"version {version} of the log format is unknown",
            file=path,
            hint="Versions 1 and 2 can be read; update the firmware, or locatk",
        )
    types = [header.event_type(version) for _ in range(header.number())]
    for key in (0, 1):
        if len({event_type[key] for event_type in types}) < len(types):
            raise header.error("two types of events have the same name or number")
    body = data[header.position :]
    is_complete = len(body) >= CRC_BYTES and zlib.crc32(data[:-CRC_BYTES]) == int.from_bytes(
        data[-CRC_BYTES:], "little"
    )
    events = body[:-CRC_BYTES] if is_complete else body
    starts, resets, end = _find_events(events, types, version, check_times=not is_complete)
    rest = len(body) - end - CRC_BYTES * is_complete
    damage = _describe_damage(is_complete, rest, header.position + end)
    first, last = _longest_part(starts, [0, *resets, end])
    buffer = np.frombuffer(events, np.uint8)
    named_events: dict[str, Event] = {}
    omitted = 0
    resolution_s = TIMESTAMPS[version][1]
    for (_, name, dtype), positions in zip(types, starts, strict=True):
        kept = positions[(positions >= first) & (positions < last)]
        omitted += len(positions) - len(kept)
        rows = buffer[kept[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]
        time_s = (rows[_TIME] + 0.5) * resolution_s
        named_events[name] = Event(name, time_s, {f: rows[f] for f in (dtype.names or ())[2:]})
    return UsdLog(version, named_events, resolution_s, damage, omitted)


def _longest_part(starts: list[NDArray[np.int64]], edges: list[int]) -> tuple[int, int]:
    """Return the bytes between two edges that contain the most events."""
    counts = sum(np.histogram(positions, edges)[0] for positions in starts)
    part = int(np.argmax(counts)) if len(edges) > 2 else 0
    return edges[part], edges[part + 1]


def _describe_damage(is_complete: bool, rest: int, position: int) -> str | None:
    """Describe the unread bytes at the end, of which there are ``rest``."""
    if is_complete:
        return f"{rest} bytes from byte {position} on are no event" if rest else None
    if rest == CRC_BYTES:
        return "the checksum is wrong: the log was altered, and its values may be wrong"
    return "the log has no checksum: logging was not stopped before power was switched off" + (
        f"; {rest} bytes from byte {position} on are no complete event" if rest else ""
    )


class _Header:
    """Reader of the header, which refuses one that is damaged."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.position = 1
        self._data = data
        self._path = path

    def number(self) -> int:
        """Return the next u16."""
        self.position += 2
        if self.position > len(self._data):
            raise self.error()
        return int.from_bytes(self._data[self.position - 2 : self.position], "little")

    def event_type(self, version: int) -> tuple[int, str, np.dtype[np.void]]:
        """Return the id, the name and the layout of an event; variables are in lower case."""
        number, name = self.number(), self._text()
        fields = [(_ID, "<u2"), (_TIME, TIMESTAMPS[version][0])]
        for _ in range(self.number()):
            text = self._text()
            match = _VARIABLE.fullmatch(text)
            if match is None or match[2] not in VARIABLE_TYPES:
                raise self.error(f"variable {text!r} of event {name!r} has an unknown type")
            if match[1].lower() in dict(fields):
                raise self.error(f"event {name!r} has two variables {match[1]!r}")
            fields.append((match[1].lower(), VARIABLE_TYPES[match[2]]))
        return number, name, np.dtype(fields)

    def _text(self) -> str:
        end = self._data.find(b"\0", self.position, self.position + MAX_NAME_BYTES + 1)
        text = self._data[self.position : end]
        if end < 0 or not _NAME.fullmatch(text):
            raise self.error()
        self.position = end + 1
        return text.decode("ascii")

    def error(self, problem: str = "the header of the log is incomplete or damaged") -> FormatError:
        """Return the error for a problem at this position."""
        return FormatError(problem, file=self._path, where=f"byte {self.position}", hint=HINT)


def _find_events(
    body: bytes,
    types: list[tuple[int, str, np.dtype[np.void]]],
    version: int,
    *,
    check_times: bool,
) -> tuple[list[NDArray[np.int64]], list[int], int]:
    """Return the positions of the events of each type, and the end of the last one.

    The second result are the positions at which the clock was set to zero.
    """
    sizes = {number: dtype.itemsize for number, _, dtype in types}
    positions = {number: array("q") for number, _, _ in types}
    time_type, unit_s = TIMESTAMPS[version]
    time_end = 2 + np.dtype(time_type).itemsize
    max_step, max_back_step = int(MAX_STEP_S / unit_s), int(MAX_BACK_STEP_S / unit_s)
    resets: list[int] = []
    last: int | None = None
    position, end = 0, len(body)

    def follows(position: int, time: int) -> bool:
        """Return whether events of about this time are behind the one at a position."""
        for _ in range(FOLLOWING_EVENTS):
            position += sizes[int.from_bytes(body[position : position + 2], "little")]
            size = sizes.get(int.from_bytes(body[position : position + 2], "little"))
            if size is None or position + size > end:
                return False
            following = int.from_bytes(body[position + 2 : position + time_end], "little")
            if not -max_back_step <= following - time <= max_step:
                return False
        return True

    while position + 2 <= end:
        number = body[position] | body[position + 1] << 8
        size = sizes.get(number)
        if size is None or position + size > end:
            break
        time = int.from_bytes(body[position + 2 : position + time_end], "little")
        if last is not None and not -max_back_step <= time - last <= max_step:
            # Zeros behind the end of a log are no event: the clock has microseconds.
            is_reset = 0 < time < last and time <= max_step and version > 1
            is_gap = time > last and follows(position, time)
            if check_times and not is_reset and not is_gap:
                break
            if time < last:
                resets.append(position)
        last = time
        positions[number].append(position)
        position += size
    starts = [np.array(positions[number], np.int64) for number, _, _ in types]
    return starts, resets, position
