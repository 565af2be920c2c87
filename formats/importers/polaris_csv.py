"""Recordings of magnetometer arrays as Polaris and MagX publish them (CSV).

github.com/wjk5117/Polaris, dychen24/magx (MIT). The header is ``,Time Stamp,Sensor 1,...,
Sensor N``; a cell of a sensor is a tuple in text, ``"(x, y, z)"`` in microtesla. Other
columns are passed over.

The part's X looks to the right, Y back and Z down, and sensor 1 is the rightmost: in the
array's frame B = (-Y, -X, -Z).

A sample's time is its row over the rate, which has to be told: the stamps that were
published with the paper are not times, but rows over 100. Where stamps are dates and
times, the first is when the recording began.
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
from locatk.formats.importers.field_readings import Bad, leave_out, no_reading
from locatk.formats.tables.csv_table import TIME, Table, read_table

Array = NDArray[np.float64]

DEVICE = "bar"

START_NS = 1_000_000_000
"""Time of the first sample where no clock is known."""

PUBLISHED_TAGS = Tags(
    codec="polaris-released",
    notes=("assumed on import: the design of the published tags, and all of their ids",),
)
"""The paper's default tag: 3 x 3 cells of 40 mm, five magnets of 2 x 0.5 mm at 10 mm."""

RATES_AGREE = 0.05
"""Relative difference up to which stamps and rate are the same."""

_SENSOR = re.compile(r"sensor ?([1-9]\d{0,3})", re.ASCII)
_NOTHING = "(nan, nan, nan)"
_OF_NUMBERS = b"0123456789.+-eEnNaA \t"
_TO_COMMAS = bytes.maketrans(b"()|", b"  ,")


@dataclass
class ImportedSamples:
    """A recording of others.

    Attributes
    ----------
    samples : Samples
    facts : dict of str to str
        What was read and assumed, for people.
    warnings : list of str
        What was lost or is doubtful, one line each.
    left_out : int
        Values by axis, sensor and sample that are not there or could not be used.
    """

    samples: Samples
    facts: dict[str, str]
    warnings: list[str] = field(default_factory=list)
    left_out: int = 0

    @property
    def lost(self) -> str | None:
        """What was lost, None where nothing was."""
        if not self.left_out:
            return None
        return f"{self.left_out} of {self.samples.field_t.size} values are left out"


def read_polaris(path: Path, *, rate_hz: float, spacing_m: float) -> ImportedSamples:
    """Read one recording.

    Parameters
    ----------
    path : path
    rate_hz : float
        Samples a second.
    spacing_m : float
        Between neighbouring sensors.

    Raises
    ------
    MissingDataError, FormatError
        See :func:`locatk.formats.tables.csv_table.read_table`; also where the columns of the
        sensors are missing or have gaps.
    InputError
        A cell is no tuple of three numbers, stamps go backwards, no MLX90393 gives this
        rate, or nothing is left.
    """
    warnings: list[str] = []
    part = _settings(rate_hz, warnings)
    table = read_table(path)
    sensors = _sensors(table)
    array = mlx90393.published_bar(len(sensors), spacing_m, part)
    values = np.stack([_vectors(table, name) for name in sensors], axis=1)
    field_t = -values[:, :, [1, 0, 2]] * 1e-6
    imported = ImportedSamples(
        Samples(DEVICE, array, _times(table, rate_hz, warnings), field_t),
        {
            "format": "polaris-csv",
            "file": Path(path).name,
            "rows": str(len(table)),
            "rate_hz": repr(float(rate_hz)),
            "clock": "time is the row over the rate; stamps are not used, but for the start",
        },
        warnings,
    )
    missing, dead = no_reading(field_t)
    reasons = (missing, _beyond(imported.samples), dead)
    imported.left_out, lost = leave_out(
        imported.samples.field_t, reasons, table.file, sensors, table.lines
    )
    warnings += lost
    if imported.left_out == field_t.size:
        raise InputError("no value that can be used", file=path, hint=warnings[-1])
    return imported


def _settings(rate_hz: float, warnings: list[str]) -> mlx90393.Settings:
    """How the sensors must be set for the rate: as published where that is possible."""
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise InputError(f"a rate of {rate_hz:g} Hz", hint="give samples a second, above 0")
    published = mlx90393.Settings()
    if rate_hz <= published.max_rate_hz:
        return published
    part = mlx90393.settings_for_rate(rate_hz, published)
    if part is None:
        raise InputError(
            f"no MLX90393 gives {rate_hz:g} samples a second",
            hint="the published recordings have 40: give the rate of the rows with --rate",
        )
    warnings.append(
        f"the published sensors give at most {published.max_rate_hz:.0f} samples a second: for "
        f"{rate_hz:g} they are taken to be set to {part}"
    )
    return part


def _sensors(table: Table) -> list[str]:
    """Names of the columns of sensor 1, 2, ..."""
    found = {int(match[1]): name for name in table.columns if (match := _SENSOR.fullmatch(name))}
    if not found:
        raise FormatError(
            "no column of a sensor",
            file=table.file,
            where=1,
            hint="the header should be: ,Time Stamp,Sensor 1,Sensor 2,...",
        )
    missing = [number for number in range(1, max(found) + 1) if number not in found]
    if missing:
        raise FormatError(
            f"missing column 'Sensor {missing[0]}'",
            file=table.file,
            where=1,
            hint="export the table with all of its columns, or name them from 1",
        )
    return [found[number] for number in sorted(found)]


def _vectors(table: Table, name: str) -> Array:
    """One sensor's column as (n, 3) numbers; ``nan`` where a cell is empty."""
    cells = [cell or _NOTHING for cell in table.columns[name]]
    vectors = _parsed(cells)
    if vectors is None:
        row = next(row for row, cell in enumerate(cells) if _parsed([cell]) is None)
        table.fail(
            row,
            f"{cells[row][:40]!r} in column {name!r} is no tuple of three numbers",
            'write it as "(1.5, -20.25, 3)", in microtesla, or leave it empty',
        )
    return vectors


def _parsed(cells: list[str]) -> Array | None:
    """Cells as (n, 3) numbers; None where one is no tuple of three."""
    joined = "|".join(cells).encode("ascii", "replace")
    # Without the letters of numbers, tuples of three are all alike.
    if joined.translate(None, _OF_NUMBERS) != b"|".join([b"(,,)"] * len(cells)):
        return None
    try:
        numbers = map(float, joined.translate(_TO_COMMAS).split(b","))
        flat = np.fromiter(numbers, float, 3 * len(cells))
    except ValueError:
        return None
    return None if np.isinf(flat).any() else flat.reshape(-1, 3)


def _times(table: Table, rate_hz: float, warnings: list[str]) -> NDArray[np.int64]:
    """Times of the rows, in ns since the epoch."""
    n, start = len(table), START_NS
    stamps = table.columns.get("time stamp")
    if stamps is not None:
        if TIME.fullmatch(stamps[0].strip()):
            at = table.times_ns("time stamp")
            start = int(at[0])
            span = (int(at[-1]) - start) * 1e-9
            if n > 1 and abs(span * rate_hz / (n - 1) - 1) > RATES_AGREE:
                told = f"{(n - 1) / span:.4g} samples a second" if span > 0 else "one moment"
                warnings.append(
                    f"the stamps tell {told}, not {rate_hz:g}: the rate that was given is used"
                )
            steps: NDArray[np.float64] = np.diff(at).astype(float)
        else:
            steps = np.diff(table.floats("time stamp"))
        if (steps < 0).any():
            row = int(np.argmax(steps < 0)) + 1
            table.fail(row, "the time stamp goes backwards", "put the rows into their order")
    return start + np.round(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)


def _beyond(samples: Samples) -> Bad:
    """What a sensor cannot tell: the last count of a scale is where all above it ends up."""
    array = samples.array
    saturated = np.abs(samples.field_t) > array.range_t - 1.5 * array.quantum_t
    return saturated, f"more than an {array.sensor} can tell"
