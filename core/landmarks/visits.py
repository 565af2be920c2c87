"""Where in a recording the robot was at a landmark, and what it measured there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.detection.trace import Drift, Trace, corrections, relative, sensor_places
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.preprocessing import cleaned
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

NEAR = 0.2
"""Field that tells of a landmark, in units of the threshold."""

NEAR_SIGMA = 6.0
"""The same in standard deviations of the noise, whichever is larger."""

WEAK = 0.5
"""Strongest field of a visit, in units of the threshold, under which it says too little."""

STRETCH_M = 5e-3
"""Way of the sensors over which fields are joined to find visits."""

MARGIN_M = 0.06
"""Way before and after, on which nothing is felt, that belongs to a visit."""

BIN_M = 2e-3
"""Way of the sensors over which samples are averaged."""

MOST_BINS = 400

LEAST_NOISE_T = 2e-5

UNTOLD = 0.02
"""Share of the samples that may lie before or after the odometry without a word."""

LONGEST_M = 2.0
"""Way during which no one landmark can be felt."""

LEAST_M = 1e-3
"""Way of the sensors without which no field can change."""

QUIET_T = 5e-4
"""Fields that offsets and noise may make alone."""

FEWEST_QUIET = 30


@dataclass(frozen=True)
class Driven:
    """A recording whose every sample has a pose by odometry.

    Attributes
    ----------
    samples : HallSamples
        ``nan`` where a sensor was saturated or dead.
    pose : (n, 3) ndarray
        Robot by its odometry: x, y, heading (unwrapped).
    offset_t : (N,) ndarray
        Of each sensor, as far as it shows in the recording.
    noise_t : float
        Standard deviation of a sample.
    warnings : tuple of SolverWarning
    """

    samples: HallSamples
    pose: Array
    offset_t: Array
    noise_t: float
    warnings: tuple[SolverWarning, ...] = ()

    def lacking(self, sensor: int) -> Driven:
        """Return the recording without one sensor, and with a warning of it."""
        field = self.samples.field_t.copy()
        field[:, sensor] = np.nan
        name = self.samples.sensors.names[sensor]
        message = f"the {name} sensor fits no landmark; left out"
        warning = SolverWarning("sensor_left_out", message).about(self.samples.device)
        samples = replace(self.samples, field_t=field)
        return replace(self, samples=samples, warnings=(*self.warnings, warning))


@dataclass(frozen=True)
class Visit:
    """A stretch of a recording near one landmark.

    Attributes
    ----------
    first, stop : int
        Samples ``first`` to ``stop - 1``.
    time_ns : (n,) int64 ndarray
        Mean times of the bins of :attr:`trace`.
    trace : Trace
    origin : (3,) ndarray
        Robot by its odometry where the frame of the trace stands: at ``trace.reference``.
    """

    first: int
    stop: int
    time_ns: NDArray[np.int64]
    trace: Trace
    origin: Array


def driven(samples: HallSamples, odometry: Trajectory | None) -> Driven:
    """Samples with poses by odometry; dead and saturated sensors taken out.

    Raises
    ------
    InputError
        There is no odometry, it covers no sample, or no sensor can be used.
    """
    if odometry is None or len(odometry) < 2:
        raise InputError(
            f"no odometry of {samples.device}",
            hint="Record it beside the hall sensors: a trace without a way says too little",
        )
    time = samples.time_ns
    covered = (time >= odometry.time_ns[0]) & (time <= odometry.time_ns[-1])
    if covered.sum() < 2:
        raise InputError(
            f"the odometry of {samples.device} covers none of its samples",
            hint="Check that both clocks are the same",
        )
    warnings = []
    without = int((~covered).sum())
    if without > UNTOLD * len(time):
        message = f"{without} samples without odometry left out"
        warnings.append(SolverWarning("samples_without_odometry", message).about(samples.device))
    field, faults = cleaned(samples)
    field, time = field[covered], time[covered]
    heading = np.unwrap(heading_from_quaternion(odometry.quaternion))
    way = np.column_stack([odometry.position[:, :2], heading])
    pose = _interpolated(time, odometry.time_ns, way)
    offset = _offsets(field)
    kept = HallSamples(samples.device, samples.sensors, time, field)
    return Driven(kept, pose, offset, _noise(samples, field), (*warnings, *faults))


def check_way(run: Driven, geometry: Geometry) -> None:
    """Refuse odometry that cannot be of these fields.

    Raises
    ------
    InputError
        It leads over metres while one landmark is felt, or nowhere while fields change.
    """
    device = run.samples.device
    strength = np.nan_to_num(np.abs(run.samples.field_t)).max(axis=1)
    over = np.diff((strength > geometry.threshold_t).astype(np.int8), prepend=0, append=0)
    spans = np.column_stack([np.flatnonzero(over > 0), np.flatnonzero(over < 0)])
    if not len(spans):
        return
    extent = [float(np.hypot(*np.ptp(run.pose[a:b, :2], axis=0))) for a, b in spans]
    # The longest of them may have been along a whole row of landmarks.
    long = float(np.quantile(extent, 0.9))
    if long > LONGEST_M:
        raise InputError(
            f"by its odometry {device} drove {long:.3g} m over one landmark",
            hint="Positions are in metres and headings in radians: check the units",
        )
    moved = max(
        np.ptp(run.pose[:, :2], axis=0).max(),
        run.samples.sensors.position_m.max() * np.ptp(run.pose[:, 2]),
    )
    if moved < LEAST_M and np.nanmax(np.ptp(run.samples.field_t, axis=0)) > geometry.threshold_t:
        raise InputError(
            f"the odometry of {device} stands still while its fields change",
            hint="Positions are in metres and headings in radians: check the units",
        )


def find(run: Driven, geometry: Geometry, drift: Drift, pitch_m: float = 0.2) -> list[Visit]:
    """The visits of a recording, in order of time.

    A visit goes on while fields are felt no farther than half the pitch from where they
    were felt so far, by middle; what lies between and a margin before and after belong to
    it, but nothing that is nearer to the next one.
    """
    starts, power, place = _felt(run, geometry)
    found: list[list[int]] = []
    middles: list[Array] = []
    weight = 0.0
    for number in np.flatnonzero(power > 0).tolist():
        if found and np.hypot(*(place[number] - middles[-1])) < pitch_m / 2:
            found[-1][1] = number
            weight += power[number]
            middles[-1] = middles[-1] + (place[number] - middles[-1]) * power[number] / weight
        else:
            found.append([number, number])
            middles.append(place[number])
            weight = power[number]
    strength = np.nan_to_num(np.abs(run.samples.field_t - run.offset_t)).max(axis=1)
    edges = np.append(starts, len(strength))
    spans = [(int(edges[a]), int(edges[b + 1])) for a, b in found]
    kept = [
        n
        for n, (first, stop) in enumerate(spans)
        if strength[first:stop].max() >= WEAK * geometry.threshold_t
    ]
    spans, middles = [spans[n] for n in kept], [middles[n] for n in kept]
    way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(run.pose[:, :2], axis=0).T))])
    visits = []
    for number, ((first, stop), middle) in enumerate(zip(spans, middles, strict=True)):
        before = (spans[number - 1][1] + first) // 2 if number else 0
        after = (stop + spans[number + 1][0]) // 2 if number + 1 < len(spans) else len(way)
        first = max(before, int(np.searchsorted(way, way[first] - MARGIN_M)))
        stop = min(after, int(np.searchsorted(way, way[stop - 1] + MARGIN_M, "right")))
        visits.append(_visit(run, first, stop, middle, drift))
    return visits


def _felt(run: Driven, geometry: Geometry) -> tuple[NDArray[np.intp], Array, Array]:
    """First samples (g,) of short ways, the squares (g,) of the fields that are felt on each,
    and the middles (g, 2) of where."""
    step = np.diff(run.pose, axis=0, prepend=run.pose[:1])
    reach = float(np.hypot(*run.samples.sensors.position_m.T).max())
    way = np.cumsum(np.hypot(step[:, 0], step[:, 1]) + reach * np.abs(step[:, 2]))
    starts = np.flatnonzero(np.diff(np.floor(way / STRETCH_M), prepend=-1.0))
    strength = np.nan_to_num(np.abs(run.samples.field_t - run.offset_t))
    strength[strength < max(NEAR * geometry.threshold_t, NEAR_SIGMA * run.noise_t)] = 0.0
    place = sensor_places(run.pose, run.samples.sensors.position_m)
    power = np.add.reduceat((strength**2).sum(axis=1), starts)
    middle = np.add.reduceat(np.einsum("ns,nsi->ni", strength**2, place), starts, axis=0)
    with np.errstate(invalid="ignore"):
        return starts, power, middle / power[:, None]


def joined(run: Driven, one: Visit, other: Visit, middle: Array, drift: Drift) -> Visit:
    """Two visits in a row, and what lies between them, as one to the landmark at ``middle``."""
    return _visit(run, one.first, other.stop, middle, drift)


def _visit(run: Driven, first: int, stop: int, middle: Array, drift: Drift) -> Visit:
    pose = run.pose[first:stop]
    step = np.diff(pose, axis=0, prepend=pose[:1])
    reach = float(np.hypot(*run.samples.sensors.position_m.T).max())
    way = np.cumsum(np.hypot(step[:, 0], step[:, 1]) + reach * np.abs(step[:, 2]))
    unit = max(BIN_M, way[-1] / MOST_BINS)
    number = np.floor(way / unit).astype(np.int64)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    field = run.samples.field_t[first:stop] - run.offset_t
    seen = ~np.isnan(field)
    count = np.add.reduceat(seen.astype(float), starts, axis=0)
    with np.errstate(invalid="ignore"):
        value = np.add.reduceat(np.where(seen, field, 0.0), starts, axis=0) / count
    every = np.diff(np.append(starts, len(pose)))
    mean = np.add.reduceat(pose, starts, axis=0) / every[:, None]
    distance = np.hypot(*(mean[:, :2] - middle).T)
    near = np.flatnonzero(distance < distance.min() + 5e-3)
    reference = int(near[-1])
    local = relative(mean, mean[reference])
    trace = Trace(
        local,
        corrections(local, reference, drift),
        value,
        run.samples.sensors.position_m,
        every.astype(float),
        reference,
    )
    since = run.samples.time_ns[first:stop] - run.samples.time_ns[first]
    times = run.samples.time_ns[first] + np.add.reduceat(since, starts) // every
    return Visit(first, stop, times, trace, mean[reference])


def _interpolated(at: NDArray[np.int64], time_ns: NDArray[np.int64], value: Array) -> Array:
    """Values (n, k) at times between those of ``value``: smooth, but still where it is still."""
    from scipy.interpolate import Akima1DInterpolator

    known, wanted = (time_ns - time_ns[0]) * 1e-9, (at - time_ns[0]) * 1e-9
    if len(known) < 3:
        return np.column_stack([np.interp(wanted, known, column) for column in value.T])
    return np.asarray(Akima1DInterpolator(known, value, method="makima")(wanted))


def _offsets(field: Array) -> Array:
    """(N,) what each sensor tells where there is no landmark; 0 where it never is away."""
    quiet = field[np.all(np.isnan(field) | (np.abs(field) < QUIET_T), axis=1)]
    if len(quiet) < FEWEST_QUIET:
        return np.zeros(field.shape[1])
    silent = np.isnan(quiet).all(axis=0)
    return np.where(silent, 0.0, np.nanmedian(np.where(silent, 0.0, quiet), axis=0))


def _noise(samples: HallSamples, field: Array) -> float:
    """Standard deviation of a sample: as told, else from neighbours where fields are even."""
    told = samples.sensors.noise_t
    if math.isfinite(told) and told > 0:
        return max(told, LEAST_NOISE_T)
    second = np.abs(field[2:] - 2 * field[1:-1] + field[:-2])
    if not len(second):
        return 10 * LEAST_NOISE_T
    quiet = np.nanquantile(second, 0.25) / 0.3186 / math.sqrt(6)
    return max(float(quiet), LEAST_NOISE_T)
