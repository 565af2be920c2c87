"""Import of a Crazyflie's log from its micro SD card as a session.

Contents of the session:

* sweeps, from the best kind of events in the log (:mod:`.sweeps`);
* samples of the IMU, and the poses that the Crazyflie estimated, for comparison
  (:mod:`.variables`);
* factory calibrations of the stations, and on request their poses, of a configuration file.

All times are by one clock. The Lighthouse deck has a counter of 24 MHz, accurate to a few ppm. The
Crazyflie's own microseconds run 1.2 % slow in firmware before August 2026, which divides by 85
instead of 84 (crazyflie-firmware, pull request 1684), and nothing in a log says which it is: the
rate is estimated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_line import ClockLine
from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.receiver import RECEIVERS, Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.units import metres
from locatk.formats.artifacts.receiver import read_receiver
from locatk.formats.importers.crazyflie import read_config
from locatk.formats.importers.crazyflie_usd.log_file import Event, UsdLog, read_usd_log
from locatk.formats.importers.crazyflie_usd.sweeps import (
    SWEEP_EVENTS,
    LoggedSweeps,
    find_sources,
    read_angles,
    read_uart_frames,
)
from locatk.formats.importers.crazyflie_usd.variables import (
    USED_VARIABLES,
    list_names,
    read_device_data,
)
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.tables.timestamps import UNDATED_START_NS

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DECK_NAME = "deck"

DEVICE = "crazyflie"
"""Default name of the device."""

MAX_DURATION_S = 1e6
"""Longest log [s], 12 days; a card of 32 GB is full after one."""

NOMINAL_RATES = (0.999, 1.001)
SLOW_RATES = (84 / 85 - 0.001, 84 / 85 + 0.001)
"""Ranges of the rate of the Crazyflie's clock: correct, and with the wrong divisor. By a deck's
counter it was 0.98906, 0.0008 above 84 / 85."""

CYCLE_EVENT = "fixedFrequency"
"""Event at a fixed rate, a whole number of milliseconds by a clock that is not affected."""

MAX_CYCLE_S = 0.04
"""Longest cycle that distinguishes the two rates: 1.2 % of it is less than half a millisecond."""

MAX_USUAL_REJECTIONS = 0.1
"""Fraction of the events with light that may be rejected without a warning. In a flight under two
stations 1 to 5 % have no known channel."""

REJECTIONS = {
    "channel_unknown": "of an unknown channel",
    "rotor_unknown": "of a station whose rotor is not regular",
    "offset_contradicts_rotor": "with an offset that contradicts the rotor",
    "plane_unknown": "of an ambiguous light plane",
    "time_contradicted": "with a time that contradicts the Crazyflie's clock",
    "impossible_angle": "with an impossible angle or number",
}
"""Reasons for which events are not used, for people."""


def read_crazyflie_usd(
    paths: Sequence[Path],
    *,
    config: Path | None = None,
    stations: bool = False,
    receiver: str = DECK_NAME,
    mounting: Sequence[float] = (),
    device: str = DEVICE,
    sweeps: str | None = None,
) -> ImportedSession:
    """Import one log as a session.

    Parameters
    ----------
    paths : sequence of path
        One log: each has a clock of its own.
    config : path, optional
        System configuration with the factory calibrations of the stations.
    stations : bool
        Take the poses of the stations from ``config``, too.
    receiver : str
        Layout of the photodiodes: a name of :data:`RECEIVERS`, or a ``receiver.toml``.
    mounting : sequence of float
        Position of the receiver on the device [mm], and its rotation about z [deg].
    device : str
    sweeps : {"uart", "lhangle", "estimator"}, optional
        Source of the sweeps; the best one by default.

    Raises
    ------
    MissingDataError
        A file is missing.
    FormatError
        It is not a log of the micro SD card, or contains no sweeps.
    ArtifactError
        The configuration is invalid.
    InputError
        There are several logs, or no usable sweep.
    """
    if len(paths) != 1:
        raise InputError(
            "several logs, each with a clock of its own",
            hint="Import each into a session of its own",
        )
    path = Path(paths[0])
    log = read_usd_log(path)
    times = [
        limit for e in log.events.values() if len(e) for limit in (e.time_s.min(), e.time_s.max())
    ]
    if times and max(times) - min(times) > MAX_DURATION_S:
        raise FormatError(
            f"its events are {(max(times) - min(times)) / 86400:.0f} days apart",
            file=path,
            hint="The log is damaged",
        )
    scene, warnings = read_scene(config, stations)
    sources = find_sources(log.events)
    problems: list[str] = []
    for source in _candidate_sources(sources, sweeps, log, path):
        event = log.events[SWEEP_EVENTS[source][0]]
        logged = _read_sweeps(log, event, source)
        if logged is not None and len(logged):
            break
        reasons = "" if logged is None else f": {describe_rejected(logged.rejected)}"
        problems.append(f"none of the {len(event)} events {event.name} is usable{reasons}")
    else:
        raise InputError(
            "; ".join(problems),
            file=path,
            hint="A recording needs a few seconds of light of a station",
        )
    warnings += problems
    start_s = _start_s(log, logged)
    data = read_device_data(_find_variables(log, logged.clock, start_s), device)
    if not logged.clock.is_estimated:
        warnings.append(
            "the log is too short to determine the rate of the Crazyflie's clock: times are off by "
            "milliseconds, or by up to 1.2 % of the duration"
        )
    unused = sum(logged.rejected.values())
    if unused > MAX_USUAL_REJECTIONS * (len(logged) + unused):
        warnings.append(f"sweeps are missing: {describe_rejected(logged.rejected)}")
    warnings += data.warnings
    lost = [] if log.damage is None else [log.damage]
    if log.omitted:
        lost.append(
            f"{log.omitted} events are left out: the clock was set to zero while logging, and the "
            "longer part is imported"
        )
    facts = _facts(path, log, logged, sources, source)
    return ImportedSession(
        make_sweeps(logged, device, _to_ns(logged.time_s, start_s)),
        scene,
        [],
        facts,
        warnings,
        receivers={device: read_mounted_receiver(receiver, mounting)},
        lost="; ".join(lost) or None,
        imu=data.imu,
        onboard=data.onboard,
    )


def read_mounted_receiver(name: str, mounting: Sequence[float]) -> Receiver:
    """Return the receiver of a name or file, at a position [mm] and yaw [deg] on its device.

    Raises
    ------
    MissingDataError, ArtifactError
        ``name`` is neither a known receiver nor a valid file.
    """
    receiver = RECEIVERS[name] if name in RECEIVERS else read_receiver(Path(name))
    if not mounting:
        return receiver
    return receiver.mounted([metres(value) for value in mounting[:3]], np.deg2rad(mounting[3]))


def read_scene(config: Path | None, stations: bool) -> tuple[Scene | None, list[str]]:
    """Return the scene of a configuration, and warnings.

    Without ``stations`` it has the calibrations and serial numbers only.
    """
    if config is None:
        if stations:
            raise InputError(
                "no configuration with the poses of the stations", hint="Give one with --config"
            )
        return None, []
    scene = read_config(config)
    if stations and not scene.stations:
        raise InputError("no pose of a station", file=config, hint="Omit --stations")
    if stations:
        return scene, list(scene.notes)
    calibrations = dict(scene.calibrations)
    ids = dict(scene.ids)
    for station in scene.stations:
        if station.calibration.source == "factory":
            calibrations[station.channel] = station.calibration
        if station.id is not None:
            ids[station.channel] = station.id
    if not calibrations:
        return None, [f"{config} has no calibration of a station"]
    return Scene(calibrations=dict(sorted(calibrations.items())), ids=dict(sorted(ids.items()))), []


def _candidate_sources(
    sources: list[str], wanted: str | None, log: UsdLog, path: Path
) -> list[str]:
    """Return the sources of sweeps to try, only ``wanted`` if it is given."""
    if not sources:
        raise FormatError(
            "no sweeps of a Lighthouse deck in the log",
            file=path,
            hint="Log the events lhUartFrame, lhAngle or estSweepAngle; the log has "
            + list_names(name for name, event in log.events.items() if len(event)),
        )
    if wanted is None:
        return sources
    if wanted not in sources:
        raise InputError(
            f"no event {SWEEP_EVENTS[wanted][0]} in the log",
            file=path,
            hint=f"Give --sweeps {' or '.join(sources)}",
        )
    return [wanted]


def _read_sweeps(log: UsdLog, event: Event, source: str) -> LoggedSweeps | None:
    """Return the sweeps of a source; None if none is usable."""
    read = read_uart_frames if source == "uart" else read_angles
    return read(event, clock_rates(log), log.resolution_s)


def clock_rates(log: UsdLog) -> list[tuple[float, float]]:
    """Return the ranges of the rate that the Crazyflie's clock can have."""
    if log.version == 1:  # ticks of the operating system, which are not affected
        return [NOMINAL_RATES]
    event = log.events.get(CYCLE_EVENT)
    steps_s = np.diff(event.time_s) if event is not None else np.zeros(0)
    if len(steps_s) >= 10 and 0 < (cycle_s := float(np.median(steps_s))) <= MAX_CYCLE_S:
        errors = [
            abs(cycle_s - rate * 1e-3 * max(1, round(cycle_s / rate * 1e3)))
            for rate in (float(np.mean(limits)) for limits in (NOMINAL_RATES, SLOW_RATES))
        ]
        return [NOMINAL_RATES if errors[0] < errors[1] else SLOW_RATES]
    return [NOMINAL_RATES, SLOW_RATES]


def _find_variables(
    log: UsdLog, clock: ClockLine, start_s: float
) -> Iterator[tuple[IntArray, dict[str, Array]]]:
    """Yield the times and the values of the variables of each event that are imported."""
    for event in log.events.values():
        names = USED_VARIABLES & event.columns.keys()
        if names and len(event):
            time_ns = _to_ns(clock.to_reference(event.time_s), start_s)
            yield time_ns, {name: event.floats(name) for name in names}


def _start_s(log: UsdLog, logged: LoggedSweeps) -> float:
    """Return the time of the earliest event by the reference clock."""
    firsts = [event.time_s.min() for event in log.events.values() if len(event)]
    return min(float(logged.time_s[0]), float(logged.clock.to_reference(np.min(firsts))))


def _to_ns(time_s: Array, start_s: float) -> IntArray:
    return UNDATED_START_NS + np.rint((time_s - start_s) * 1e9).astype(np.int64)


def make_sweeps(logged: LoggedSweeps, device: str, time_ns: IntArray) -> Sweeps:
    """Return the sweeps of one device."""
    return Sweeps(
        (device,),
        time_ns,
        np.zeros(len(logged), np.int32),
        logged.sensor.astype(np.int32),
        logged.channel.astype(np.int32),
        np.full(len(logged), UNKNOWN, np.int32),
        logged.plane.astype(np.int32),
        logged.count,
    )


def describe_rejected(rejected: dict[str, int]) -> str:
    """Return the numbers of unused events by reason, for people."""
    return ", ".join(f"{number} {REJECTIONS[reason]}" for reason, number in rejected.items())


def _facts(
    path: Path, log: UsdLog, logged: LoggedSweeps, sources: list[str], source: str
) -> dict[str, str]:
    event = SWEEP_EVENTS[source][0]
    others = [SWEEP_EVENTS[name][0] for name in sources if name != source]
    start_s = logged.clock.offset_s + logged.clock.rate * _start_s(log, logged)
    facts = {
        "format": f"crazyflie-usd, version {log.version}",
        "files": path.name,
        "sweeps": f"{len(logged)} of {len(log.events[event])} events {event}"
        + (f"; not used: {', '.join(others)}" if others else ""),
        "channels": ", ".join(map(str, np.unique(logged.channel))),
        "clock": f"seconds since the log began, by {logged.clock_source}; the Crazyflie's clock "
        + (
            f"ran at {logged.clock.rate:.6f} of its speed"
            if logged.clock.is_estimated
            else "is uncertain"
        ),
        "crazyflie_start_s": f"{start_s:.6f}",
    }
    if logged.rejected:
        facts["rejected"] = describe_rejected(logged.rejected)
    unused = {
        name
        for each in log.events.values()
        for name in each.columns
        if "." in name and len(each) and name not in USED_VARIABLES
    }
    if unused:
        facts["not_used"] = list_names(unused, len(unused))
    if logged.repeated:
        facts["repeated"] = f"{logged.repeated} events {event} repeat the value before them"
    return facts
