"""What the columns of a line of text mean, by their names; and a recording as such lines.

One spelling for the project: a quantity, then its unit as in :mod:`..importers.columns`
(``x_mm``, ``x [mm]``, ``x(mm)``), in capitals or not.

=================================  =======================================================
``t``, ``time``, ``timestamp``     with s, ms, us or ns: the device's clock (a tick, in
                                   microseconds). Also ``millis`` and ``micros``
``seq``, ``sequence``              its counter of samples: tells what was lost
``b<k>x``, ``b<k>y``, ``b<k>z``    with t, mt, ut, nt or gauss: magnetometer k, from 0 or 1
                                   on; all three axes of all. ``bx``, ``by``, ``bz`` where
                                   there is only one
``temperature``, ``temp``          with c: of the magnetometers
``hall_<name>``                    with t, mt, ut, nt or gauss: a hall sensor, positive
                                   upward. Front, left, rear and right in this order, others
                                   as they come
``x``, ``y``, ``heading``          with m, cm, mm and rad, deg: odometry; all three
=================================  =======================================================

Every other column is a reading, with the number as it is. So is what has no unit: what a
name does not tell is not guessed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.halls import NAMES
from locatk.formats.devices.decoder import Batch, Recording, Stream, Ticks
from locatk.formats.tables.columns import TIMES, UNITS

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TICK_HZ = 1e6

INFO = 2
"""Level of what a device prints, in the log."""

FIELD = {unit: factor for unit, factor in UNITS["field"].items() if unit not in ("v", "mv")}
FIELD["nt"] = 1e-9

_UNIT = re.compile(r"(.+?)(?:_([a-z]+)| ?\[([a-z]+)\]| ?\(([a-z]+)\))")
_AXIS = re.compile(r"b(\d{0,3})_?([xyz])", re.ASCII)
_TIMERS = {"millis": 1e3, "micros": 1.0}
_NO_TIME = 2.0**62


@dataclass(frozen=True)
class Part:
    """Records of one kind: from which columns of a line, and what they are in SI."""

    stream: Stream
    columns: tuple[int, ...]
    factors: tuple[float, ...]


@dataclass(frozen=True)
class Meaning:
    """What the columns of a line are.

    Attributes
    ----------
    names : tuple of str
    parts : tuple of Part
    tick : (int, float) or None
        Column of the device's clock, and its unit in microseconds.
    sequence : int or None
        Column of its counter.
    temperature : int or None
        Column of the temperature of the magnetometers.
    doubts : tuple of str
        Columns that look like more than the readings that they are kept as.
    """

    names: tuple[str, ...]
    parts: tuple[Part, ...]
    tick: tuple[int, float] | None
    sequence: int | None
    temperature: int | None
    doubts: tuple[str, ...]

    @property
    def told(self) -> bool:
        """Whether a name says more than that there is a reading."""
        readings = all(part.stream.kind == "readings" for part in self.parts)
        return not readings or self.tick is not None or self.sequence is not None

    def records(self, values: Array, end: Ints, wide: bool) -> tuple[list[Batch], bool]:
        """Batches of lines (n, columns) that end at ``end`` (n,), and ``wide`` as it is then.

        ``wide`` says that the clock has counted beyond 32 bits: microseconds do so after 71
        minutes, and many devices start again at 0 there.
        """
        tick = None if self.tick is None else _whole(values[:, self.tick[0]] * self.tick[1])
        sequence = None if self.sequence is None else _whole(values[:, self.sequence])
        narrow = len(end)
        if tick is not None and self.tick is not None:
            beyond = tick >= 1 << 32
            if wide or self.tick[1] != 1:
                narrow = 0
            elif beyond.any():
                narrow = int(np.argmax(beyond))
            wide |= narrow < len(end)
        batches = []
        for rows, bits in ((slice(0, narrow), 32), (slice(narrow, None), 64)):
            if len(end[rows]):
                ticks = None if tick is None else Ticks(TICK_HZ, bits)
                for part in self.parts:
                    batch = self._batch(part, ticks, values[rows], end[rows], tick, sequence, rows)
                    batches += [batch] if len(batch) else []
        return batches, wide

    def wrong(self, values: Array) -> NDArray[np.bool_]:
        """(n,) lines whose clock or counter cannot be."""
        wrong = np.zeros(len(values), bool)
        if self.tick is not None:
            tick = values[:, self.tick[0]] * self.tick[1]
            wrong |= ~((tick >= 0) & (tick < _NO_TIME))
        if self.sequence is not None:
            sequence = values[:, self.sequence]
            wrong |= ~((sequence >= 0) & (sequence < 1 << 32) & (np.rint(sequence) == sequence))
        return wrong

    def _batch(
        self,
        part: Part,
        ticks: Ticks | None,
        values: Array,
        end: Ints,
        tick: Ints | None,
        sequence: Ints | None,
        rows: slice,
    ) -> Batch:
        """Lines in which there is something of this kind."""
        stream = part.stream
        ours = values[:, part.columns] * np.array(part.factors)
        if stream.kind != "readings":
            ours[np.isinf(ours)] = np.nan
        gone = np.isnan(ours)
        kept = ~(gone.any(axis=1) if stream.kind == "odometry" else gone.all(axis=1))
        ours = ours[kept]
        columns: dict[str, NDArray[Any]]
        if stream.kind == "odometry":
            columns = {"x_m": ours[:, 0], "y_m": ours[:, 1], "heading_rad": ours[:, 2]}
        elif stream.kind == "readings":
            columns = {"value": ours}
        else:
            columns = {"b_tesla": ours}
        if stream.kind == "magnetometers" and self.temperature is not None:
            columns["temperature_celsius"] = values[kept, self.temperature]
        return Batch(
            Stream(stream.kind, "", stream.sensors, stream.names, ticks),
            end[kept],
            columns,
            None if tick is None else tick[rows][kept],
            None if sequence is None else sequence[rows][kept],
        )


def _whole(values: Array) -> Ints:
    return np.rint(values).astype(np.int64)


def split_unit(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit, ``""`` where it has none; small letters.

    Examples
    --------
    >>> split_unit("B0X_uT"), split_unit("heading [deg]"), split_unit("hall_left")
    (('b0x', 'ut'), ('heading', 'deg'), ('hall_left', ''))
    """
    plain = name.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    match = _UNIT.fullmatch(plain)
    unit = "" if match is None else match[2] or match[3] or match[4]
    known = unit in FIELD or unit in ("c", "celsius") or any(unit in of for of in UNITS.values())
    return (match[1], unit) if match and known else (plain, "")


def meaning(names: Sequence[str]) -> Meaning:
    """What columns of these names are; see the module."""
    tick: tuple[int, float] | None = None
    sequence: int | None = None
    temperature: int | None = None
    axes: dict[tuple[int, str], tuple[int, float]] = {}
    halls: dict[str, tuple[int, float]] = {}
    pose: dict[str, tuple[int, float]] = {}
    no_unit = []
    for place, name in enumerate(names):
        bare, unit = split_unit(name)
        axis = _AXIS.fullmatch(bare)
        if bare in ("seq", "sequence") and not unit and sequence is None:
            sequence = place
        elif bare in _TIMERS and not unit and tick is None:
            tick = place, _TIMERS[bare]
        elif bare in TIMES and unit in UNITS["time"] and tick is None:
            tick = place, UNITS["time"][unit] / 1e3
        elif axis and unit in FIELD:
            axes.setdefault((int(axis[1] or 0), axis[2]), (place, FIELD[unit]))
        elif bare.startswith("hall_") and unit in FIELD:
            halls.setdefault(bare[5:], (place, FIELD[unit]))
        elif bare in ("x", "y") and unit in UNITS["length"]:
            pose.setdefault(bare, (place, UNITS["length"][unit]))
        elif bare == "heading" and unit in UNITS["angle"]:
            pose.setdefault(bare, (place, UNITS["angle"][unit]))
        elif bare in ("temperature", "temp") and unit in ("c", "celsius"):
            temperature = place if temperature is None else temperature
        elif not unit and (axis or bare.startswith("hall_")):
            no_unit.append(name)
    doubts = []
    if no_unit:
        doubts.append(f"no unit in the name of column {no_unit[0]!r}: name it {no_unit[0]}_ut")
    parts = []
    numbers = sorted({number for number, _ in axes})
    if (
        axes
        and len(axes) == 3 * len(numbers)
        and numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        and numbers[0] <= 1
    ):
        found = [axes[number, axis] for number in numbers for axis in "xyz"]
        parts.append(_part(Stream("magnetometers", sensors=len(numbers)), found))
    elif axes:
        temperature = None
        doubts.append(
            "columns of magnetometers that are not x, y and z of each, from 0 or 1 on without a gap"
        )
    else:
        temperature = None
    if halls:
        known = set(halls) <= set(NAMES)
        order = [name for name in NAMES if name in halls] if known else list(halls)
        stream = Stream("halls", sensors=len(order), names=tuple(order))
        parts.append(_part(stream, [halls[name] for name in order]))
    if len(pose) == 3:
        parts.append(_part(Stream("odometry"), [pose[key] for key in ("x", "y", "heading")]))
    elif pose:
        doubts.append("columns of odometry that are not x, y and heading, each with its unit")
    used = {sequence, temperature, None if tick is None else tick[0]}
    used |= {column for part in parts for column in part.columns}
    rest = [place for place in range(len(names)) if place not in used]
    if rest:
        stream = Stream("readings", names=tuple(names[place] for place in rest))
        parts.append(_part(stream, [(place, 1.0) for place in rest]))
    return Meaning(tuple(names), tuple(parts), tick, sequence, temperature, tuple(doubts))


def _part(stream: Stream, found: Sequence[tuple[int, float]]) -> Part:
    return Part(stream, tuple(place for place, _ in found), tuple(factor for _, factor in found))


def points(stream: Stream, found: Sequence[tuple[int, int, list[float]]]) -> Batch:
    """Readings of which each came alone: end, tick and values."""
    end, tick, values = (np.array(part) for part in zip(*found, strict=True))
    return Batch(stream, end, {"value": values}, None if stream.ticks is None else tick)


def log(found: Sequence[tuple[int, str]]) -> Batch:
    """Lines of the log: end and text."""
    text = np.empty(len(found), object)
    text[:] = [line for _, line in found]
    columns: dict[str, NDArray[Any]] = {"level": np.full(len(found), INFO), "text": text}
    return Batch(Stream("log"), np.array([end for end, _ in found], np.int64), columns)


def merged(batches: Sequence[Batch]) -> list[Batch]:
    """The same records with those of a stream together, in the order of their lines; in
    several batches where only some tell a temperature or a count."""
    streams: dict[Stream, list[Batch]] = {}
    for batch in batches:
        streams.setdefault(batch.stream, []).append(batch)
    return [batch for several in streams.values() for batch in _joined(several)]


def _joined(several: list[Batch]) -> list[Batch]:
    if len(several) == 1:
        return several
    said = [_fields(batch) for batch in several]
    forms = [tuple(fields) for fields in said]
    form = np.repeat([forms.index(each) for each in forms], [len(batch) for batch in several])
    every = {
        name: np.concatenate([f.get(name, np.zeros(len(f["end"]), np.int64)) for f in said])
        for name in {name for names in forms for name in names}
    }
    order = np.argsort(every["end"], kind="stable")
    batches = []
    for run in np.split(order, np.flatnonzero(np.diff(form[order])) + 1):
        fields = {name: every[name][run] for name in forms[form[run[0]]]}
        own = {name: fields.pop(name, None) for name in ("tick", "sequence")}
        batches.append(Batch(several[0].stream, fields.pop("end"), fields, **own))
    return batches


def _fields(batch: Batch) -> dict[str, NDArray[Any]]:
    fields = {"end": batch.end, "tick": batch.tick, "sequence": batch.sequence, **batch.columns}
    return {name: array for name, array in fields.items() if array is not None}


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """A recording as CSV, its columns named as above: a header, then one line a time at
    which anything was measured, with empty cells for what was not.

    The clock, ``time_us``, counts from the first line. Fields are in microtesla.

    Returns
    -------
    iterator of (int, bytes)
        When what a line says was measured, in ns, and the line.

    Raises
    ------
    InputError
        The recording has neither samples of a field nor odometry, or several devices of a
        kind: a line tells of one.
    """
    columns: list[tuple[str, Ints, Array, str]] = []
    for kind, several in _kinds(recording).items():
        if len(several) > 1:
            raise InputError(
                f"{kind} of {len(several)} devices, where a line tells of one",
                hint="Emulate the device locatk, whose frames have a node each",
            )
        columns += several[0] if several else []
    columns = [column for column in columns if len(column[1])]
    if not columns:
        raise InputError("no magnetometers, hall sensors or odometry in the recording")
    times = np.unique(np.concatenate([time_ns for _, time_ns, _, _ in columns]))
    return _lines(columns, times)


def _kinds(recording: Recording) -> Mapping[str, list[list[tuple[str, Ints, Array, str]]]]:
    """Kind to devices to columns: name, times, values and how they are written."""
    samples = [
        [
            (f"b{k}{axis}_ut", each.time_ns, each.field_t[:, k, a] * 1e6, "%.4f")
            for k in range(each.field_t.shape[1])
            for a, axis in enumerate("xyz")
        ]
        for each in recording.samples
    ]
    halls = [
        [
            (f"hall_{name}_ut", each.time_ns, each.field_t[:, k] * 1e6, "%.4f")
            for k, name in enumerate(each.sensors.names)
        ]
        for each in recording.halls
    ]
    odometry = [
        [
            ("x_m", each.time_ns, each.position[:, 0], "%.6f"),
            ("y_m", each.time_ns, each.position[:, 1], "%.6f"),
            ("heading_rad", each.time_ns, heading_from_quaternion(each.quaternion), "%.6f"),
        ]
        for each in recording.odometry
    ]
    return {"samples": samples, "hall sensors": halls, "odometry": odometry}


def _lines(
    columns: Sequence[tuple[str, Ints, Array, str]], times: Ints
) -> Iterator[tuple[int, bytes]]:
    start_ns = int(times[0])
    names = [name for name, *_ in columns]
    yield start_ns, (",".join(["time_us", *names]) + "\n").encode()
    cells = []
    for _, time_ns, values, form in columns:
        column = np.full(len(times), np.nan)
        column[np.searchsorted(times, time_ns)] = values
        cells.append([form % value if value == value else "" for value in column.tolist()])
    for time_ns, *row in zip(times.tolist(), *cells, strict=True):
        tick = (time_ns - start_ns) // 1000
        yield time_ns, (",".join([str(tick), *row]) + "\n").encode()
