"""Sweeps in the events of a Crazyflie's log.

=================  ================================================================  =============
event              content                                                           firmware
=================  ================================================================  =============
``lhUartFrame``    each pulse as received from the Lighthouse deck, at its own time  2021, data
                                                                                     collection
``lhAngle``        rotor angles of complete rotations, when the next light arrives   the same
``estSweepAngle``  the same, of stations with known geometry, thinned at random      current
=================  ================================================================  =============

Sources: crazyflie-firmware ``lighthouse_core.c``, ``estimator.c`` and ``usddeck.c``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_line import ClockLine, fit_clock_line, unwrap_counter
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.late_angles import date_late_angles
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.plane_labels import FRAME_S, PULSE_HZ, label_pulses
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.importers.crazyflie_usd.log_file import Event

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SENSOR_COUNT = 4

STATION_LIMITS = (2, 4, 16)
"""Numbers of stations for which firmware is built. A frame of an unknown channel has this number
as its station (``pulse_processor.h``, ``lighthouse_core.c``)."""

MIN_OFFSET_FRACTION = 0.05
"""Smallest fraction of the frames of a station that have an offset; fewer are wrong ones."""

SWEEP_EVENTS = {
    "uart": ("lhUartFrame", ("sensor", "basestation", "offset", "timestampfpga"), ()),
    "lhangle": ("lhAngle", ("sensor", "basestation", "sweep"), ("angle",)),
    "estimator": ("estSweepAngle", ("sensorid", "basestationid", "sweepid"), ("sweepangle",)),
}
"""Events with sweeps by the names of their sources, the best first: name, variables that are
integers, and variables that are numbers. The variable ``t`` of ``estSweepAngle`` is the nominal
tilt of the plane, not a time."""

MAX_TIME_ERROR_S = 1.0
"""Largest difference of the deck's counter from the Crazyflie's clock [s]. It is milliseconds."""


@dataclass(frozen=True)
class LoggedSweeps:
    """Sweeps of one kind of events, ascending in time.

    Attributes
    ----------
    time_s : (n,) ndarray
        Time of the light by the reference clock.
    sensor, channel, plane : (n,) int64 ndarray
    count : (n,) ndarray
    clock : ClockLine
        Mapping of the reference clock to the Crazyflie's.
    clock_source : str
        The reference clock, for people.
    rejected : dict of str to int
        Number of unusable events by reason.
    repeated : int
        Number of events that repeat the previous value.
    """

    time_s: Array
    sensor: IntArray
    channel: IntArray
    plane: IntArray
    count: Array
    clock: ClockLine
    clock_source: str
    rejected: dict[str, int]
    repeated: int = 0

    def __len__(self) -> int:
        return len(self.time_s)


def read_uart_frames(
    event: Event, rates: Sequence[tuple[float, float]], resolution_s: float
) -> LoggedSweeps | None:
    """Return the sweeps of the frames of a Lighthouse deck; None if none is usable.

    ``rates`` are the possible rates of the Crazyflie's clock, ``resolution_s`` that of its stamps.
    """
    columns = event.columns
    station, offset = columns["basestation"].astype(np.int64), columns["offset"].astype(np.int64)
    sensor = columns["sensor"].astype(np.int64)
    fits = [
        fit
        for limits in rates
        if (fit := _fit_counter(event, float(np.mean(limits)), resolution_s)) is not None
    ]
    if not fits:
        return None
    # A counter of 24 bits wraps every 0.7 s: with a wrong rate, a gap of 30 s has too many or few.
    tick, clock = min(
        fits, key=lambda fit: float(np.mean(np.abs(_delay_s(event.time_s, *fit)).clip(max=1.0)))
    )
    clock = ClockLine(clock.offset_s - FRAME_S * clock.rate, clock.rate, clock.is_estimated)
    is_usable = (station >= 0) & (station < len(CHANNELS)) & (station != unknown_station(event))
    channel = np.where(is_usable, station + CHANNELS[0], UNKNOWN)
    is_timed = np.abs(_delay_s(event.time_s, tick, clock)) <= MAX_TIME_ERROR_S
    is_timed &= (sensor >= 0) & (sensor < SENSOR_COUNT)
    rows = np.flatnonzero(is_timed)
    labelled = label_pulses(tick[rows], sensor[rows], channel[rows], offset[rows])
    rejected = dict(labelled.rejected)
    if len(rows) < len(tick):
        rejected["time_contradicted"] = len(tick) - len(rows)
    rows = rows[labelled.row]
    order = np.argsort(tick[rows], kind="stable")
    rows = rows[order]
    return LoggedSweeps(
        tick[rows] / PULSE_HZ,
        sensor[rows],
        labelled.channel[order],
        labelled.plane[order],
        labelled.count[order],
        clock,
        "the Lighthouse deck's counter of 24 MHz",
        rejected,
    )


def _fit_counter(
    event: Event, rate: float, resolution_s: float
) -> tuple[IntArray, ClockLine] | None:
    """Return the deck's counter without wraps, and the Crazyflie's clock of about this rate."""
    columns = event.columns
    has_long_counter = "timestamp2fpga" in columns and columns["timestamp2fpga"].dtype.kind in "iu"
    bits, name = (32, "timestamp2fpga") if has_long_counter else (24, "timestampfpga")
    tick = unwrap_counter(columns[name].astype(np.int64), event.time_s / rate, PULSE_HZ, bits)
    clock = fit_clock_line(tick / PULSE_HZ, event.time_s, resolution_s=resolution_s)
    return None if clock is None else (tick, clock)


def _delay_s(time_s: Array, tick: IntArray, clock: ClockLine) -> Array:
    """Return the times from the counter to the stamps of the Crazyflie, by the deck's clock."""
    return clock.to_reference(time_s) - tick / PULSE_HZ


def find_sources(events: Mapping[str, Event]) -> list[str]:
    """Return the sources of sweeps in a log, the best first."""
    sources = []
    for source, (name, integers, numbers) in SWEEP_EVENTS.items():
        event = events.get(name)
        if event is not None and len(event):
            kinds = {key: values.dtype.kind for key, values in event.columns.items()}
            has_integers = all(kinds.get(key, "") in ("i", "u") for key in integers)
            if has_integers and all(key in kinds for key in numbers):
                sources.append(source)
    return sources


def unknown_station(event: Event) -> int:
    """Return the station of frames of an unknown channel, -1 if there are none.

    It is the largest station, of which hardly any frame has an offset: the offset is found only of
    pulses with a known channel, of four in ten of these.
    """
    station, offset = event.columns["basestation"], event.columns["offset"]
    largest = int(station.max(initial=0))
    fraction = float(np.mean(offset[station == largest] > 0)) if len(station) else 0.0
    return largest if largest in STATION_LIMITS and fraction < MIN_OFFSET_FRACTION else -1


def read_angles(
    event: Event, rates: Sequence[tuple[float, float]], resolution_s: float
) -> LoggedSweeps | None:
    """Return the sweeps of ``lhAngle`` or ``estSweepAngle``; None if none is usable.

    ``rates`` are the possible rates of the Crazyflie's clock, ``resolution_s`` that of its stamps.
    """
    _, integers, (angle_name,) = next(
        each for each in SWEEP_EVENTS.values() if each[0] == event.name
    )
    sensor, station, plane = (event.columns[name].astype(np.int64) for name in integers)
    angle = event.floats(angle_name)
    is_usable = (sensor >= 0) & (sensor < SENSOR_COUNT) & (station >= 0) & (plane >= 0)
    is_usable &= (station < len(CHANNELS)) & (plane < 2)
    channel = np.where(is_usable, station + CHANNELS[0], CHANNELS[0])
    turns = (angle - ROTOR_ZERO_RAD[np.clip(plane, 0, 1)]) / (2 * np.pi)
    is_usable &= (turns >= 0) & (turns < 1)
    is_repeated = is_usable & _repeats(((4 * station + sensor) * 2 + plane), angle)
    rows = np.flatnonzero(is_usable & ~is_repeated)
    count = turns[rows] * period_counts(channel[rows])
    dated = date_late_angles(
        event.time_s[rows], channel[rows], plane[rows], count, rates, resolution_s
    )
    if dated is None:
        return None
    is_dated = np.isfinite(dated.time_s)
    rejected = {
        "impossible_angle": int(np.count_nonzero(~is_usable)),
        "rotor_unknown": int(np.count_nonzero(~is_dated)),
    }
    order = np.flatnonzero(is_dated)
    order = order[np.argsort(dated.time_s[order], kind="stable")]
    return LoggedSweeps(
        dated.time_s[order],
        sensor[rows[order]],
        channel[rows[order]],
        plane[rows[order]],
        count[order],
        dated.clock,
        "the rotors of the stations, of nominal speed",
        {reason: number for reason, number in rejected.items() if number},
        int(np.count_nonzero(is_repeated)),
    )


def _repeats(series: IntArray, values: Array) -> NDArray[np.bool_]:
    """Return which values equal the one before it in their series."""
    order = np.argsort(series, kind="stable")
    is_same = np.zeros(len(series), bool)
    is_same[order[1:]] = (np.diff(series[order]) == 0) & (np.diff(values[order]) == 0)
    return is_same
