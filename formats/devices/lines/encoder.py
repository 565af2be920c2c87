"""A recording as the lines that :mod:`.decoder` reads: CSV with the names of :mod:`.columns`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.formats.devices.interface import Recording

FIELD_FORMAT = "%.4f"
"""Fields in microtesla, to 0.1 nT."""

POSE_FORMAT = "%.6f"
"""Positions in metres and headings in radians."""


class TextColumn(NamedTuple):
    """Measurements of one column: (n,) times and values, and their format."""

    name: str
    time_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    form: str


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Encode a recording as CSV: a header, then one line for each time with a measurement.

    Cells without a measurement at that time are empty. The clock, ``time_us``, counts from the
    first line. Fields are in microtesla.

    Returns
    -------
    iterator of (int, bytes)
        The time of each line's measurements [ns], and the line.

    Raises
    ------
    InputError
        The recording has neither samples of a field nor odometry, or several devices of a kind,
        which one line cannot distinguish.
    """
    columns: list[TextColumn] = []
    for kind, devices in _columns_of_devices(recording).items():
        if len(devices) > 1:
            raise InputError(
                f"{kind} of {len(devices)} devices, but lines of text are of one",
                hint="Emulate the device locatk, whose frames have a node each",
            )
        columns += devices[0] if devices else []
    columns = [column for column in columns if len(column.time_ns)]
    if not columns:
        raise InputError("no magnetometers, hall sensors or odometry in the recording")
    return _lines(columns, np.unique(np.concatenate([column.time_ns for column in columns])))


def _columns_of_devices(recording: Recording) -> dict[str, list[list[TextColumn]]]:
    """Return the columns of each device, by kind."""
    magnetometers = [
        [
            TextColumn(f"b{k}{axis}_ut", each.time_ns, each.field_t[:, k, a] * 1e6, FIELD_FORMAT)
            for k in range(each.field_t.shape[1])
            for a, axis in enumerate("xyz")
        ]
        for each in recording.samples
    ]
    halls = [
        [
            TextColumn(f"hall_{name}_ut", each.time_ns, each.field_t[:, k] * 1e6, FIELD_FORMAT)
            for k, name in enumerate(each.sensors.names)
        ]
        for each in recording.halls
    ]
    odometry = [
        [
            TextColumn(name, each.time_ns, values, POSE_FORMAT)
            for name, values in (
                ("x_m", each.position[:, 0]),
                ("y_m", each.position[:, 1]),
                ("heading_rad", heading_from_quaternion(each.quaternion)),
            )
        ]
        for each in recording.odometry
    ]
    return {"samples": magnetometers, "hall sensors": halls, "odometry": odometry}


def _lines(
    columns: Sequence[TextColumn], times_ns: NDArray[np.int64]
) -> Iterator[tuple[int, bytes]]:
    start_ns = int(times_ns[0])
    yield start_ns, (",".join(["time_us", *(column.name for column in columns)]) + "\n").encode()
    cells = []
    for column in columns:
        values = np.full(len(times_ns), np.nan)
        values[np.searchsorted(times_ns, column.time_ns)] = column.values
        cells.append([column.form % value if value == value else "" for value in values.tolist()])
    for time_ns, *row in zip(times_ns.tolist(), *cells, strict=True):
        tick = (time_ns - start_ns) // 1000
        yield time_ns, (",".join([str(tick), *row]) + "\n").encode()
