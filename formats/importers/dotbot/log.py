"""Logs of PyDotBot, the controller of DotBots, read into sweeps.

PyDotBot logs with structlog: as logfmt into its file, with colours to the terminal; others
let it write JSON. Records are told by their keys, whatever the event is called:

====================================  ==================================================
keys                                  what it is
====================================  ==================================================
poly, lfsr_index, [db_time]           a sweep that the robot decoded, 2024; db_time is the
                                      robot's clock in us when it received the light
sweep_0_poly, _off, _bits, sweep_1_   windows of 64 bits, 2023: the count is the place of the
                                      17 bits after the first ``off``, less ``off``
c0, c1                                two counts of one station, 2023; which one is not told:
                                      channel 1, as its authors assume
====================================  ==================================================

``source`` (or ``address``) names the device. A polynomial above 31, an index beyond the
sequence and bits of nothing but zeros are a robot's marks of an error: no sweep, and nothing
is lost. ``sweep`` numbers a robot's memory, not the planes of the rotor: it is not used.
Lines of other events are passed over.

Log lines are late by tens of milliseconds, more than lies between two sweeps. Where robots
tell db_time, it dates the sweeps (:mod:`locatk.core.clock_sync`).

Source: PyDotBot ``controller.py``, ``logger.py``; ``parse_logfile.py`` of alvarado23lighthouse,
alvarado24lh-distortion and alvarado24automatic.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import TickClock
from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT, channel_of
from locatk.core.lighthouse.recording import UNKNOWN, StationReport, Sweeps
from locatk.formats.artifacts.scene import parse_time
from locatk.formats.importers.lighthouse import ImportedSession

DEVICE = "robot"
"""Name of the device in records without a source."""

ASSUMED_CHANNEL = 1
"""Of records that name no polynomial."""

LONGEST_LINE = 16384
LONGEST_NAME = 64
MOST_WINDOWS = 16
PACKED = 1 << 16
NAMED_FAULTS = 5
"""Damaged records that are named one by one."""

ROBOT_HZ, ROBOT_BITS = 1e6, 32
WINDOW_BITS = 64

Rows = NDArray[np.void]
_Fields = Mapping[bytes, bytes]

_FIELD = re.compile(
    rb'\b([A-Za-z_]\w*+)=("(?:[^"\\]|\\.)*+(?:"|$)'  # logfmt quotes so ...
    rb"|'(?:[^'\\]|\\.)*+(?:'|$)"  # ... and the terminal so
    rb'|[^\s"]*)'
)
_COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?(Z|[+-]\d\d:\d\d)?", re.ASCII
)
_HINT = "give the file that PyDotBot wrote (pydotbot.log), at log level info"

_ROW = np.dtype(
    {
        "names": ["time_ns", "device", "polynomial", "count", "tick", "bits", "offset"],
        "formats": ["i8", "i4", "i4", "i8", "i8", "u8", "i8"],
    }
)
"""A sweep; ``tick`` is -1 where the robot told no time, ``offset`` -1 where it told the
count and no bits."""


@dataclass
class _Log:
    """What was read so far. Devices are numbered by their names, and by those names' bytes."""

    devices: dict[str, int] = field(default_factory=dict)
    known: dict[bytes, int] = field(default_factory=dict)
    rows: list[tuple[int, ...]] = field(default_factory=list)
    packed: list[Rows] = field(default_factory=list)
    lines: int = 0
    records: int = 0
    marks: int = 0
    damaged: int = 0
    faults: list[str] = field(default_factory=list)

    def add(self, *row: int) -> None:
        """Add a sweep, its values in the order of :data:`_ROW`."""
        self.rows.append(row)
        if len(self.rows) == PACKED:
            self.pack()

    def pack(self) -> None:
        """Keep what was added in less memory."""
        self.packed.append(np.array(self.rows, _ROW))
        self.rows = []


class _Damaged(Exception):
    """What is wrong with a record."""


def read_dotbot_log(paths: Sequence[Path]) -> ImportedSession:
    """Read logs of one recording, rotated or of several controllers, as one session.

    Parameters
    ----------
    paths : sequence of path
        Log files; records are merged in order of time.

    Raises
    ------
    MissingDataError
        No file is given, or one is not there.
    InputError
        A file cannot be read.
    FormatError
        No line of the logs is a record of light.
    """
    if not paths:
        raise MissingDataError("no log to import")
    log, warnings = _Log(), []
    for path in paths:
        before = log.records
        _read(Path(path), log)
        if log.records == before and len(paths) > 1:
            warnings.append(f"no record of light in {path}")
    rows = _rows(log, warnings)
    if not len(rows):
        told = f" ({log.records} records of light, {log.damaged} of them damaged)"
        told = told if log.records else ": none of its lines tells of light"
        raise FormatError(f"no sweep in the log{told}", file=paths[0], hint=_HINT)
    warnings += log.faults
    rows = _once(_named_first(rows, warnings), warnings)
    clock = _date(rows, log.devices, warnings)
    sweeps = _sweeps(rows[np.argsort(rows["time_ns"], kind="stable")], tuple(log.devices))
    channels, sizes = np.unique(sweeps.channel, return_counts=True)
    assumed = "" if np.all(sweeps.polynomial >= 0) else " (assumed)"
    per_device = np.bincount(sweeps.device, minlength=len(log.devices)).tolist()
    facts = {
        "format": "dotbot-log",
        "files": ", ".join(Path(path).name for path in paths),
        "lines": f"{log.lines}, of which {log.records} tell of light",
        "sweeps": str(len(sweeps)),
        "without a sweep": f"{log.marks} marks of robots that decoded nothing",
        "devices": ", ".join(
            f"{name} ({n} sweeps)" for name, n in zip(log.devices, per_device, strict=True)
        ),
        "channels": ", ".join(map(str, channels.tolist())) + assumed,
        "clock": clock,
    }
    return ImportedSession(
        sweeps,
        None,
        [],
        facts,
        warnings,
        stations=tuple(
            StationReport(channel, sweeps=n)
            for channel, n in zip(channels.tolist(), sizes.tolist(), strict=True)
        ),
        lost=f"{log.damaged} of {log.records} records are damaged" if log.damaged else None,
    )


def _read(path: Path, log: _Log) -> None:
    """Add the records of one file."""
    for number, line in _lines(path):
        log.lines += 1
        if not (b"lfsr_index" in line or b"_bits" in line or b"c0" in line):
            continue
        plain = _COLOUR.sub(b"", line) if b"\x1b" in line else line
        fields = _fields(plain)
        kind = next((keys for keys in _KINDS if keys in fields), None)
        if kind is None:
            continue
        log.records += 1
        try:
            if not line.endswith(b"\n"):
                raise _Damaged("the line is cut short")
            _KINDS[kind](log, fields, _line_time(plain, fields))
        except _Damaged as error:
            log.damaged += 1
            if len(log.faults) < NAMED_FAULTS:
                log.faults.append(f"{path}:{number}: {error}: left out")


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers and ends; of one that is longer than any record, nothing."""
    try:
        with open(path, "rb") as stream:
            number = 0
            while line := stream.readline(LONGEST_LINE):
                number += 1
                if len(line) == LONGEST_LINE and not line.endswith(b"\n"):
                    while line and not line.endswith(b"\n"):
                        line = stream.readline(LONGEST_LINE)
                    line = b"\n"
                yield number, line
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from None


def _fields(line: bytes) -> _Fields:
    """Keys and values of a line of logfmt or JSON, as bytes."""
    if line.startswith(b"{"):
        try:
            found = json.loads(line)
            return {key.encode(): str(value).encode() for key, value in found.items()}
        except (ValueError, RecursionError):
            return {}
    return dict(_FIELD.findall(line))


def _line_time(line: bytes, fields: _Fields) -> int:
    """Nanoseconds since the epoch at which a line was logged; UTC where no zone is told."""
    told = fields.get(b"timestamp")
    text = (line[:40] if told is None else told.strip(b'"')).decode("latin-1")
    match = _TIME.match(text) if told is None else _TIME.fullmatch(text)
    second = _second_ns(match[1], match[2], match[4] or "Z") if match else None
    if match is None or second is None or not 0 <= second < 1 << 62:
        raise _Damaged("no time")
    return second + int((match[3] or "0").ljust(9, "0"))


@lru_cache(maxsize=1024)
def _second_ns(day: str, clock: str, zone: str) -> int | None:
    return parse_time(f"{day}T{clock}{zone}")


def _number(fields: _Fields, key: bytes) -> int:
    """A whole number; one of a robot's marks of an error may be negative."""
    text = fields.get(key, b"")
    if not (text.isdigit() or text.removeprefix(b"-").isdigit()) or len(text) > 20:
        shown = text[:20].decode("ascii", "backslashreplace")
        raise _Damaged(f"{key.decode()} is {shown!r}" if text else f"no {key.decode()}")
    return int(text)


def _device(log: _Log, fields: _Fields) -> int:
    told = fields.get(b"source") or fields.get(b"address") or DEVICE.encode()
    number = log.known.get(told)
    if number is None:
        try:
            name = told.strip(b"\"'").decode()
        except UnicodeDecodeError:
            name = ""
        if not (0 < len(name) <= LONGEST_NAME and name.isprintable()):
            raise _Damaged("a source that is no name")
        number = log.known[told] = log.devices.setdefault(name, len(log.devices))
    return number


def _add_processed(log: _Log, fields: _Fields, time_ns: int) -> None:
    """A sweep that the robot decoded."""
    polynomial, count = _number(fields, b"poly"), _number(fields, b"lfsr_index")
    tick = _number(fields, b"db_time") if b"db_time" in fields else UNKNOWN
    if b"db_time" in fields and not 0 <= tick < 1 << ROBOT_BITS:
        raise _Damaged(f"db_time is {tick}")
    device = _device(log, fields)
    if not (0 <= polynomial < POLYNOMIAL_COUNT and 0 <= count < lfsr.SEQUENCE_LENGTH):
        log.marks += 1
        return
    log.add(time_ns, device, polynomial, count, tick, 0, UNKNOWN)


def _add_counts(log: _Log, fields: _Fields, time_ns: int) -> None:
    """Two counts of a station that is not told."""
    counts = [_number(fields, b"c0"), _number(fields, b"c1")]
    device = _device(log, fields)
    for count in counts:
        if 0 <= count < lfsr.SEQUENCE_LENGTH:
            log.add(time_ns, device, UNKNOWN, count, UNKNOWN, 0, UNKNOWN)
        else:
            log.marks += 1


def _add_windows(log: _Log, fields: _Fields, time_ns: int) -> None:
    """Windows of bits, from which the indices are to be found."""
    windows = []
    for k in range(MOST_WINDOWS):
        keys = [b"sweep_%d_%s" % (k, part) for part in (b"poly", b"off", b"bits")]
        if not any(key in fields for key in keys):
            break
        windows.append([_number(fields, key) for key in keys])
    device = _device(log, fields)
    for polynomial, offset, bits in windows:
        if not 0 <= bits < 1 << WINDOW_BITS:
            raise _Damaged("bits that are no 64-bit number")
        room = WINDOW_BITS - lfsr.REGISTER_BITS
        if 0 <= polynomial < POLYNOMIAL_COUNT and 0 <= offset <= room:
            log.add(time_ns, device, polynomial, 0, UNKNOWN, bits, offset)
        else:
            log.marks += 1


_KINDS = {
    b"lfsr_index": _add_processed,
    b"sweep_0_bits": _add_windows,
    b"c0": _add_counts,
}
"""What adds a record, by the key that tells it."""


def _rows(log: _Log, warnings: list[str]) -> Rows:
    """All sweeps in order of the log's time, windows searched for their indices."""
    log.pack()
    rows = np.concatenate(log.packed)
    windows = rows["offset"] >= 0
    known = rows[windows]
    index = lfsr.window_index(known["bits"], known["offset"], known["polynomial"])
    rows["count"][windows] = index
    dark = np.flatnonzero(windows)[index == lfsr.NO_INDEX]
    log.marks += len(dark)
    rows = np.delete(rows, dark)
    backwards = int(np.count_nonzero(np.diff(rows["time_ns"]) < 0))
    if backwards:
        warnings.append(f"times of the log went backwards {backwards} times: records were sorted")
    return rows[np.argsort(rows["time_ns"], kind="stable")]


def _named_first(rows: Rows, warnings: list[str]) -> Rows:
    """Without counts of unknown stations where others tell theirs: they are the same light."""
    named = rows["polynomial"] >= 0
    if not np.any(named) or np.all(named):
        return rows
    warnings.append(
        f"{int(np.count_nonzero(~named))} counts that name no station were passed over: other "
        "records tell the same light with its polynomial"
    )
    return rows[named]


def _once(rows: Rows, warnings: list[str]) -> Rows:
    """Without sweeps that are in the logs twice, as where logs overlap."""
    # The log's time, of which there are few equal ones, is the first key.
    order = np.lexsort(
        [rows[name] for name in ("tick", "count", "polynomial", "device", "time_ns")]
    )
    ranked = rows[order]
    same = np.ones(max(len(rows) - 1, 0), bool)
    for name in ("time_ns", "device", "polynomial", "count", "tick"):
        same &= np.diff(ranked[name]) == 0
    if np.any(same):
        warnings.append(f"{int(np.count_nonzero(same))} sweeps repeat another exactly: dropped")
    return np.delete(rows, order[1:][same])


def _date(rows: Rows, devices: Mapping[str, int], warnings: list[str]) -> str:
    """Set the times of sweeps by the robots' clocks; how times are known."""
    dated = rows["tick"] >= 0
    if not np.any(dated):
        return "times of log lines, taken as UTC; all counts of a line share one"
    order = np.argsort(rows["device"], kind="stable")
    edges = np.searchsorted(rows["device"][order], np.arange(len(devices) + 1))
    for number, name in enumerate(devices):
        mine = order[edges[number] : edges[number + 1]]
        mine = mine[dated[mine]]
        clock = TickClock(ROBOT_HZ, ROBOT_BITS)
        rows["time_ns"][mine] = clock.times(rows["tick"][mine], rows["time_ns"][mine])
        if clock.restarts:
            warnings.append(f"the clock of {name} started again {clock.restarts} times")
    rest = "" if np.all(dated) else f" for {np.count_nonzero(dated)} sweeps, else log lines"
    return f"robots' clocks, by the log's (UTC){rest}"


def _sweeps(rows: Rows, devices: tuple[str, ...]) -> Sweeps:
    n, polynomial = len(rows), rows["polynomial"].astype(np.int32)
    channel = np.where(polynomial >= 0, channel_of(polynomial), ASSUMED_CHANNEL)
    return Sweeps(
        devices=devices,
        time_ns=rows["time_ns"].astype(np.int64),
        device=rows["device"].astype(np.int32),
        sensor=np.zeros(n, np.int32),
        channel=channel.astype(np.int32),
        polynomial=polynomial,
        sweep=np.full(n, UNKNOWN, np.int32),
        count=rows["count"].astype(np.float64),
    )
