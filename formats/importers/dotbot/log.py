"""Logs of PyDotBot, the controller of DotBots, imported as sweeps.

PyDotBot logs with structlog: as logfmt into its file, with colours to the terminal; others
configure it to write JSON. Records are recognised by their keys, not by the name of the event:

====================================  ==================================================
keys                                  record
====================================  ==================================================
poly, lfsr_index, [db_time, sweep]    a sweep that the robot decoded, 2024; db_time is the
                                      robot's clock in us when it received the light, sweep
                                      the slot of its memory
sweep_0_poly, _off, _bits, sweep_1_   windows of 64 bits, 2023: the count is the LFSR index of
                                      the 17 bits after the first ``off``, less ``off``
c0, c1                                two counts of one station, 2023, without its polynomial:
                                      channel 1, as its authors assume
====================================  ==================================================

``source`` (or ``address``) names the device. A polynomial above 31, an index beyond the
sequence and bits that are all zero mark an error of the robot: there is no sweep, and nothing
is lost. Slots give the planes of sweeps (:func:`.count_rows.find_planes`). Lines of other events
are skipped.

Log lines are late by tens of milliseconds, longer than the time between two sweeps. If records
contain db_time, it dates the sweeps (:mod:`locatk.core.clock_sync`).

Source: PyDotBot ``controller.py``, ``logger.py``; ``parse_logfile.py`` of alvarado23lighthouse,
alvarado24lh-distortion and alvarado24automatic.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import TickClock
from locatk.core.errors import FormatError, MissingDataError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT, channel_of
from locatk.core.lighthouse.recording import UNKNOWN, StationReport, Sweeps
from locatk.formats.files import check_regular, open_binary
from locatk.formats.importers.dotbot.count_rows import MAX_SLOT, find_planes
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.tables.timestamps import parse_iso_time

DEFAULT_DEVICE = "robot"
"""Name of the device in records without a source."""

ASSUMED_CHANNEL = 1
"""Channel of records without a polynomial."""

MAX_LINE_BYTES = 16384
"""Longer lines are not records: one with 16 windows has about 1,500 bytes."""

MAX_SKIPPED_LINE_BYTES = 64 << 20
"""Longest line that is skipped; a power cut leaves shorter ones, of zeros."""

MAX_NAME_CHARACTERS = 64

MAX_WINDOWS_PER_RECORD = 16

ROWS_PER_BLOCK = 1 << 16
"""Sweeps after which the list of tuples is packed into an array, to save memory."""

MAX_FILE_BYTES = 8 << 30
"""Largest log [bytes], of some weeks of a robot; it is read line by line."""

MAX_NAMED_FAULTS = 5
"""Damaged records that get a warning each."""

MAX_TIME_NS = 1 << 62

ROBOT_HZ, ROBOT_BITS = 1e6, 32
WINDOW_BITS = 64

Rows = NDArray[np.void]
_Fields = Mapping[bytes, bytes]

_FIELD = re.compile(
    rb'\b([A-Za-z_]\w*+)=("(?:[^"\\]|\\.)*+(?:"|$)'  # quotes of logfmt
    rb"|'(?:[^'\\]|\\.)*+(?:'|$)"  # quotes of the terminal
    rb'|[^\s"]*)'
)
_COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?(Z|[+-]\d\d:\d\d)?", re.ASCII
)
LOG_HINT = "Give the file that PyDotBot wrote (pydotbot.log), at log level info"

SWEEP_DTYPE = np.dtype(
    {
        "names": ["time_ns", "device", "polynomial", "count", "tick", "bits", "offset", "slot"],
        "formats": ["i8", "i4", "i4", "i8", "i8", "u8", "i4", "i4"],
    }
)
"""Sweep of a log; ``tick`` is -1 without a time of the robot, ``offset`` -1 without bits, ``slot``
-1 without a slot."""


@dataclass
class _Log:
    """Records read so far.

    Attributes
    ----------
    devices : dict of str to int
        Device numbers by name.
    device_by_field : dict of bytes to int
        Device numbers by the bytes of the field, which repeat from line to line.
    rows : list of tuple
        Sweeps in the order of :data:`SWEEP_DTYPE`; ``packed`` are earlier ones.
    lines, records, without_sweep, damaged : int
        Lines, records of light, records without a sweep, and unreadable records.
    faults : list of str
        Warnings on the first damaged records.
    """

    devices: dict[str, int] = field(default_factory=dict)
    device_by_field: dict[bytes, int] = field(default_factory=dict)
    rows: list[tuple[int, ...]] = field(default_factory=list)
    packed: list[Rows] = field(default_factory=list)
    lines: int = 0
    records: int = 0
    without_sweep: int = 0
    damaged: int = 0
    faults: list[str] = field(default_factory=list)

    def add(self, *row: int) -> None:
        """Add a sweep, its values in the order of :data:`SWEEP_DTYPE`."""
        self.rows.append(row)
        if len(self.rows) == ROWS_PER_BLOCK:
            self.pack()

    def pack(self) -> None:
        """Convert the added sweeps to an array, which takes less memory."""
        self.packed.append(np.array(self.rows, SWEEP_DTYPE))
        self.rows = []


class _Damaged(Exception):
    """Problem of a record that cannot be read."""


def read_dotbot_log(paths: Sequence[Path]) -> ImportedSession:
    """Read logs of one recording, rotated or of several controllers, as one session.

    Parameters
    ----------
    paths : sequence of path
        Log files; records are merged in order of time.

    Raises
    ------
    MissingDataError
        No file is given, or one is missing.
    InputError
        A file is not readable.
    FormatError
        The logs contain no record of light.
    """
    if not paths:
        raise MissingDataError("no log to import")
    log, warnings = _Log(), []
    for path in paths:
        before = log.records
        _read(Path(path), log)
        if log.records == before and len(paths) > 1:
            warnings.append(f"{path}: no record of light")
    rows = _rows(log, warnings)
    if not len(rows):
        detail = f" ({log.records} records of light, {log.damaged} of them damaged)"
        detail = detail if log.records else ": no line is a record of light"
        raise FormatError(f"no sweep in the log{detail}", file=paths[0], hint=LOG_HINT)
    warnings += log.faults
    rows = _without_repeats(_without_unnamed(rows, warnings), warnings)
    clock = _date(rows, log.devices, warnings)
    sweeps = _sweeps(rows[np.argsort(rows["time_ns"], kind="stable")], tuple(log.devices))
    channels, sizes = np.unique(sweeps.channel, return_counts=True)
    assumed = "" if np.all(sweeps.polynomial >= 0) else " (assumed)"
    per_device = np.bincount(sweeps.device, minlength=len(log.devices)).tolist()
    facts = {
        "format": "dotbot-log",
        "files": ", ".join(Path(path).name for path in paths),
        "lines": f"{log.lines}, of which {log.records} are records of light",
        "sweeps": str(len(sweeps)),
        "without a sweep": f"{log.without_sweep} records of robots that decoded nothing",
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
            if len(log.faults) < MAX_NAMED_FAULTS:
                log.faults.append(f"{path}:{number}: {error}: skipped")


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield lines with their numbers and ends; lines longer than any record are empty."""
    if check_regular(path) > MAX_FILE_BYTES:
        raise FormatError(
            f"larger than {MAX_FILE_BYTES >> 30} GiB", file=path, hint="Split the log, or check it"
        )
    with open_binary(path) as stream:
        number = 0
        while line := stream.readline(MAX_LINE_BYTES):
            number += 1
            if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                start = stream.tell()
                while line and not line.endswith(b"\n"):
                    line = stream.readline(MAX_LINE_BYTES)
                    if stream.tell() - start > MAX_SKIPPED_LINE_BYTES:
                        raise FormatError(
                            f"a line of more than {MAX_SKIPPED_LINE_BYTES >> 20} MiB",
                            file=path,
                            where=number,
                            hint=LOG_HINT,
                        )
                line = b"\n"
            yield number, line


def _fields(line: bytes) -> _Fields:
    """Return the keys and values of a line of logfmt or JSON, as bytes."""
    if line.startswith(b"{"):
        try:
            record = json.loads(line)
            return {key.encode(): str(value).encode() for key, value in record.items()}
        except (ValueError, RecursionError):
            return {}
    return dict(_FIELD.findall(line))


def _line_time(line: bytes, fields: _Fields) -> int:
    """Return the time of a line in nanoseconds since the epoch; UTC if it has no zone."""
    stamp = fields.get(b"timestamp")
    text = (line[:40] if stamp is None else stamp.strip(b'"')).decode("latin-1")
    match = _TIME.match(text) if stamp is None else _TIME.fullmatch(text)
    second = _second_ns(match[1], match[2], match[4] or "Z") if match else None
    if match is None or second is None or not 0 <= second < MAX_TIME_NS:
        raise _Damaged("no time")
    return second + int((match[3] or "0").ljust(9, "0"))


@lru_cache(maxsize=1024)
def _second_ns(day: str, clock: str, zone: str) -> int | None:
    """Return the time of a whole second; cached, because many lines share one."""
    try:
        return parse_iso_time(f"{day}T{clock}{zone}", utc_only=False)
    except ValueError:
        return None


def _number(fields: _Fields, key: bytes) -> int:
    """Return a whole number, which may be negative if it marks an error of the robot."""
    text = fields.get(key, b"")
    if not (text.isdigit() or text.removeprefix(b"-").isdigit()) or len(text) > 20:
        shown = text[:20].decode("ascii", "backslashreplace")
        raise _Damaged(f"{key.decode()} is {shown!r}" if text else f"no {key.decode()}")
    return int(text)


def _device(log: _Log, fields: _Fields) -> int:
    source = fields.get(b"source") or fields.get(b"address") or DEFAULT_DEVICE.encode()
    number = log.device_by_field.get(source)
    if number is None:
        try:
            name = source.strip(b"\"'").decode()
        except UnicodeDecodeError:
            name = ""
        if not (0 < len(name) <= MAX_NAME_CHARACTERS and name.isprintable()):
            raise _Damaged("the source is not a name")
        number = log.device_by_field[source] = log.devices.setdefault(name, len(log.devices))
    return number


def _add_processed(log: _Log, fields: _Fields, time_ns: int) -> None:
    """Add a sweep that the robot decoded."""
    polynomial, count = _number(fields, b"poly"), _number(fields, b"lfsr_index")
    tick = _number(fields, b"db_time") if b"db_time" in fields else UNKNOWN
    if b"db_time" in fields and not 0 <= tick < 1 << ROBOT_BITS:
        raise _Damaged(f"db_time is {tick}")
    device = _device(log, fields)
    if not (0 <= polynomial < POLYNOMIAL_COUNT and 0 <= count < lfsr.SEQUENCE_LENGTH):
        log.without_sweep += 1
        return
    slot = _number(fields, b"sweep") if b"sweep" in fields else UNKNOWN
    if b"sweep" in fields and not 0 <= slot <= MAX_SLOT:
        raise _Damaged(f"sweep is {slot}")
    log.add(time_ns, device, polynomial, count, tick, 0, UNKNOWN, slot)


def _add_counts(log: _Log, fields: _Fields, time_ns: int) -> None:
    """Add two counts of an unknown station."""
    counts = [_number(fields, b"c0"), _number(fields, b"c1")]
    device = _device(log, fields)
    for count in counts:
        if 0 <= count < lfsr.SEQUENCE_LENGTH:
            log.add(time_ns, device, UNKNOWN, count, UNKNOWN, 0, UNKNOWN, UNKNOWN)
        else:
            log.without_sweep += 1


def _add_windows(log: _Log, fields: _Fields, time_ns: int) -> None:
    """Add windows of bits, whose LFSR indices are searched later."""
    windows = []
    for k in range(MAX_WINDOWS_PER_RECORD):
        keys = [b"sweep_%d_%s" % (k, part) for part in (b"poly", b"off", b"bits")]
        if not any(key in fields for key in keys):
            break
        windows.append([_number(fields, key) for key in keys])
    device = _device(log, fields)
    for polynomial, offset, bits in windows:
        if not 0 <= bits < 1 << WINDOW_BITS:
            raise _Damaged("the bits are not a 64-bit number")
        max_offset = WINDOW_BITS - lfsr.REGISTER_BITS
        if 0 <= polynomial < POLYNOMIAL_COUNT and 0 <= offset <= max_offset:
            log.add(time_ns, device, polynomial, 0, UNKNOWN, bits, offset, UNKNOWN)
        else:
            log.without_sweep += 1


_KINDS = {
    b"lfsr_index": _add_processed,
    b"sweep_0_bits": _add_windows,
    b"c0": _add_counts,
}
"""Function that adds a record, by the key that identifies its kind."""


def _rows(log: _Log, warnings: list[str]) -> Rows:
    """Return all sweeps in order of the log's time, with the LFSR indices of their windows."""
    log.pack()
    rows = np.concatenate(log.packed)
    windows = rows["offset"] >= 0
    with_bits = rows[windows]
    index = lfsr.window_index(with_bits["bits"], with_bits["offset"], with_bits["polynomial"])
    rows["count"][windows] = index
    without_index = np.flatnonzero(windows)[index == lfsr.NO_INDEX]
    log.without_sweep += len(without_index)
    rows = np.delete(rows, without_index)
    backwards = int(np.count_nonzero(np.diff(rows["time_ns"]) < 0))
    if backwards:
        warnings.append(f"times of the log went backwards {backwards} times: records were sorted")
    return rows[np.argsort(rows["time_ns"], kind="stable")]


def _without_unnamed(rows: Rows, warnings: list[str]) -> Rows:
    """Remove counts of unknown stations if other records contain the station of the same light."""
    is_named = rows["polynomial"] >= 0
    if not np.any(is_named) or np.all(is_named):
        return rows
    warnings.append(
        f"{np.count_nonzero(~is_named)} counts without a polynomial were dropped: other records "
        "contain the same light with its polynomial"
    )
    return rows[is_named]


def _without_repeats(rows: Rows, warnings: list[str]) -> Rows:
    """Remove sweeps that occur twice, because logs overlap."""
    # Few times of the log are equal, so that it sorts fastest as the first key.
    order = np.lexsort(
        [rows[name] for name in ("tick", "count", "polynomial", "device", "time_ns")]
    )
    ranked = rows[order]
    is_repeat = np.ones(max(len(rows) - 1, 0), bool)
    for name in ("time_ns", "device", "polynomial", "count", "tick"):
        is_repeat &= np.diff(ranked[name]) == 0
    if np.any(is_repeat):
        warnings.append(
            f"{int(np.count_nonzero(is_repeat))} sweeps repeat another exactly: dropped"
        )
    return np.delete(rows, order[1:][is_repeat])


def _date(rows: Rows, devices: Mapping[str, int], warnings: list[str]) -> str:
    """Set the times of sweeps by the clocks of the robots; return a text on the clock."""
    is_dated = rows["tick"] >= 0
    if not np.any(is_dated):
        return "times of log lines, taken as UTC; all counts of a line share one"
    order = np.argsort(rows["device"], kind="stable")
    edges = np.searchsorted(rows["device"][order], np.arange(len(devices) + 1))
    for number, name in enumerate(devices):
        of_device = order[edges[number] : edges[number + 1]]
        of_device = of_device[is_dated[of_device]]
        clock = TickClock(ROBOT_HZ, ROBOT_BITS)
        rows["time_ns"][of_device] = clock.times(
            rows["tick"][of_device], rows["time_ns"][of_device]
        )
        if clock.restarts:
            warnings.append(f"the clock of {name} restarted {clock.restarts} times")
    rest = "" if np.all(is_dated) else f" for {np.count_nonzero(is_dated)} sweeps, else log lines"
    return f"clocks of the robots, fitted to that of the log (UTC){rest}"


def _sweeps(rows: Rows, devices: tuple[str, ...]) -> Sweeps:
    rows = rows[np.argsort(rows["time_ns"], kind="stable")]
    n, polynomial = len(rows), rows["polynomial"].astype(np.int32)
    channel = np.where(polynomial >= 0, channel_of(polynomial), ASSUMED_CHANNEL)
    sweeps = Sweeps(
        devices=devices,
        time_ns=rows["time_ns"].astype(np.int64),
        device=rows["device"].astype(np.int32),
        sensor=np.zeros(n, np.int32),
        channel=channel.astype(np.int32),
        polynomial=polynomial,
        sweep=np.full(n, UNKNOWN, np.int32),
        count=rows["count"].astype(np.float64),
    )
    return replace(sweeps, sweep=find_planes(sweeps, rows["slot"].astype(np.int64)))
