"""Recordings of magnetometer arrays as published with Polaris and MagX (CSV).

Format of github.com/wjk5117/Polaris and dychen24/magx (MIT): the header is
``,Time Stamp,Sensor 1,...,Sensor N``; a cell of a sensor is a tuple in text, ``"(x, y, z)"`` in
microtesla. Other columns are ignored.

The sensor's X points right, Y back and Z down, and sensor 1 is the rightmost: in the frame of the
array, B = (-Y, -X, -Z).

The time of a sample is its row divided by the rate, which the user states: the stamps published
with the paper are not times, but rows divided by 100. If stamps are dates and times, or seconds at
the stated rate, the first one is the start of the recording, otherwise row 0 is at 0 s.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.polaris import mlx90393
from locatk.core.polaris.array import Samples
from locatk.core.polaris.tag import Tags
from locatk.formats.importers.field_readings import (
    UnusableReadings,
    exclude_readings,
    find_absent_readings,
)
from locatk.formats.tables.delimited import Table, read_table
from locatk.formats.tables.timestamps import is_iso_time, parse_decimal_time

Array = NDArray[np.float64]

DEVICE = "bar"

TIME_COLUMN = "time stamp"

PUBLISHED_TAGS = Tags(
    codec="polaris-released",
    notes=("assumed on import: the design of the published tags, and all of their ids",),
)
"""Default tag of the paper: 3 x 3 cells of 40 mm, five magnets of 2 x 0.5 mm at 10 mm."""

MAX_RATE_DIFFERENCE_FRACTION = 0.05
"""Largest relative difference of the rate by the stamps from the stated one without a warning."""

MAX_GAP_STEPS = 10.0
"""Smallest difference of two stamps, in usual steps, that shows missing rows.

Rows are written late by a busy computer, but not by ten periods (0.25 s at 40 Hz).
"""

MAX_STAMP_S = 2**62 * 1e-9
"""Largest start of a recording; differences of two times in nanoseconds fit into int64."""

SATURATION_QUANTA = 1.5
"""Readings within this distance of the end of the scale may be saturated."""

_SENSOR_NAME = re.compile(r"sensor ?([1-9]\d{0,3})", re.ASCII)
_EMPTY_VECTOR = "(nan, nan, nan)"
_NUMBER_CHARACTERS = b"0123456789.+-eEnNaA \t"
_TO_COMMAS = bytes.maketrans(b"()|", b"  ,")


@dataclass
class ImportedSamples:
    """Imported recording of a magnetometer array.

    Attributes
    ----------
    samples : Samples
    facts : dict of str to str
        Source and assumptions, as text.
    warnings : list of str
        Losses and doubts, one line each.
    left_out : int
        Values (by axis, sensor and sample) that are missing or unusable.
    """

    samples: Samples
    facts: dict[str, str]
    warnings: list[str] = field(default_factory=list)
    left_out: int = 0

    @property
    def lost(self) -> str | None:
        """Summary of the losses; None without any."""
        if not self.left_out:
            return None
        return f"{self.left_out} of {self.samples.field_t.size} values are excluded"


def read_polaris(path: Path, *, rate_hz: float, spacing_m: float) -> ImportedSamples:
    """Read one recording.

    Parameters
    ----------
    path : path
    rate_hz : float
        Samples per second.
    spacing_m : float
        Distance between neighbouring sensors.

    Raises
    ------
    MissingDataError, FormatError
        See :func:`locatk.formats.tables.delimited.read_table`; also if columns of sensors are
        missing.
    InputError
        A cell is not a tuple of three numbers, stamps go backwards, no MLX90393 has this rate,
        or no value is usable.
    """
    warnings: list[str] = []
    settings = _sensor_settings(rate_hz, warnings)
    table = read_table(path)
    names = _sensor_columns(table)
    array = mlx90393.published_bar(len(names), spacing_m, settings)
    values = np.stack([_vectors(table, name) for name in names], axis=1)
    field_t = -values[:, :, [1, 0, 2]] * 1e-6
    samples = Samples(DEVICE, array, _times(table, rate_hz, warnings), field_t)
    facts = {
        "format": "polaris-csv",
        "file": Path(path).name,
        "rows": str(len(table)),
        "rate_hz": repr(float(rate_hz)),
        "clock": "time is the row divided by the rate; of the stamps only the start is used",
    }
    absent, dead = find_absent_readings(field_t)
    excluded, losses = exclude_readings(
        samples.field_t, (absent, _saturated(samples), dead), table.file, names, table.lines
    )
    warnings += losses
    if excluded == field_t.size:
        raise InputError("no usable value", file=path, hint=warnings[-1])
    return ImportedSamples(samples, facts, warnings, excluded)


def _sensor_settings(rate_hz: float, warnings: list[str]) -> mlx90393.Settings:
    """Return settings of the sensors with this rate: the published ones if possible."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise InputError(f"a rate of {rate_hz:g} Hz", hint="Give samples per second, above 0")
    published = mlx90393.Settings()
    if rate_hz <= published.max_rate_hz:
        return published
    settings = mlx90393.settings_for_rate(rate_hz, published)
    if settings is None:
        raise InputError(
            f"no MLX90393 gives {rate_hz:g} samples per second",
            hint="The published recordings have 40: give the rate of the rows with --rate",
        )
    warnings.append(
        f"the published sensors give at most {published.max_rate_hz:.0f} samples per second; for "
        f"{rate_hz:g}, these settings are assumed: {settings}"
    )
    return settings


def _sensor_columns(table: Table) -> list[str]:
    """Return the names of the columns of sensor 1, 2, ..."""
    columns: dict[int, str] = {}
    for name in table.columns:
        match = _SENSOR_NAME.fullmatch(name)
        if match and columns.setdefault(int(match[1]), name) != name:
            raise FormatError(
                f"columns {columns[int(match[1])]!r} and {name!r} are of one sensor",
                file=table.file,
                where=1,
                hint="Rename or delete one",
            )
    if not columns:
        raise FormatError(
            "columns of sensors are missing",
            file=table.file,
            where=1,
            hint="The header should be: ,Time Stamp,Sensor 1,Sensor 2,...",
        )
    missing = [number for number in range(1, max(columns) + 1) if number not in columns]
    if missing:
        raise FormatError(
            f"column 'Sensor {missing[0]}' is missing",
            file=table.file,
            where=1,
            hint="Export the table with all of its columns, or number them from 1",
        )
    return [columns[number] for number in sorted(columns)]


def _vectors(table: Table, name: str) -> Array:
    """Return the column of a sensor as (n, 3) numbers; ``nan`` for empty cells."""
    cells = [cell or _EMPTY_VECTOR for cell in table.columns[name]]
    vectors = _parse_vectors(cells)
    if vectors is None:
        row = next(row for row, cell in enumerate(cells) if _parse_vectors([cell]) is None)
        table.fail(
            row,
            f"{cells[row][:40]!r} in column {name!r} is not a tuple of three numbers",
            'Write it as "(1.5, -20.25, 3)", in microtesla, or leave it empty',
        )
    return vectors


def _parse_vectors(cells: list[str]) -> Array | None:
    """Parse all cells at once into (n, 3) numbers; None if a cell is not a tuple of three."""
    joined = "|".join(cells).encode("ascii", "replace")
    # Without the characters of numbers, all tuples of three are alike.
    if joined.translate(None, _NUMBER_CHARACTERS) != b"|".join([b"(,,)"] * len(cells)):
        return None
    try:
        numbers = map(float, joined.translate(_TO_COMMAS).split(b","))
        flat = np.fromiter(numbers, float, 3 * len(cells))
    except ValueError:
        return None
    return None if np.isinf(flat).any() else flat.reshape(-1, 3)


def _times(table: Table, rate_hz: float, warnings: list[str]) -> NDArray[np.int64]:
    """Return the times of the rows, in nanoseconds since the epoch."""
    n, start_ns = len(table), 0
    if TIME_COLUMN in table.columns:
        if is_iso_time(table.columns[TIME_COLUMN][0]):
            stamps_ns = table.iso_times_ns(TIME_COLUMN)
            start_ns = int(stamps_ns[0])
            duration_s = (int(stamps_ns[-1]) - start_ns) * 1e-9
            expected_s = (n - 1) / rate_hz
            if n > 1 and abs(duration_s / expected_s - 1) > MAX_RATE_DIFFERENCE_FRACTION:
                stamped = "a single time"
                if duration_s > 0:
                    stamped = f"{(n - 1) / duration_s:.4g} samples per second"
                warnings.append(
                    f"the stamps show {stamped}, not {rate_hz:g}: the stated rate is used"
                )
            steps: Array = np.diff(stamps_ns).astype(float)
        else:
            stamps_s = table.floats(TIME_COLUMN)
            steps = np.diff(stamps_s)
            ratio = (stamps_s[-1] - stamps_s[0]) * rate_hz / max(n - 1, 1)
            is_time = 0 <= stamps_s[0] < MAX_STAMP_S and (
                abs(ratio - 1) <= MAX_RATE_DIFFERENCE_FRACTION
            )
            if is_time:
                start_ns = parse_decimal_time(str(table.columns[TIME_COLUMN][0]))
        if (steps < 0).any():
            row = int(np.argmax(steps < 0)) + 1
            table.fail(row, "the time stamp goes backwards", "Sort the rows by time")
        usual = np.median(steps[steps > 0]) if (steps > 0).any() else math.inf
        gaps = np.flatnonzero(steps > MAX_GAP_STEPS * usual)
        if len(gaps):
            warnings.append(
                f"{table.file}:{table.lines[gaps[0] + 1]}: the time stamp is {MAX_GAP_STEPS:g} or "
                f"more usual steps after the previous one, in {len(gaps)} row"
                f"{'s' * (len(gaps) > 1)}: samples are missing, and all later times are too early"
            )
    return start_ns + np.round(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)


def _saturated(samples: Samples) -> UnusableReadings:
    """Find readings at the end of the scale, to which all larger fields are clipped."""
    array = samples.array
    limit_t = array.range_t - SATURATION_QUANTA * array.quantum_t
    return np.abs(samples.field_t) > limit_t, f"a field beyond the range of an {array.sensor}"
