"""Preprocessing of a recording: invalid readings, odometry at each sample, visits to landmarks.

:func:`preprocess` removes readings that are no fields and interpolates the odometry at the times
of the samples. :func:`segment_visits` divides the result into visits: intervals in which one
landmark is near, averaged in short bins of the path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.detection.trace import (
    OdometryDrift,
    Trace,
    compose,
    odometry_corrections,
    planar_rotation,
    relative,
    sensor_positions,
)
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.landmark import Geometry
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

SATURATION_FRACTION = 0.999
"""Fraction of a sensor's range from which on a reading counts as saturated."""

MIN_PLATEAU_READINGS = 30
"""Number of readings at exactly the same extreme from which on that is taken as the range."""

MIN_SPIKE_T = 2e-3
"""Smallest difference of a spike from the mean of its two neighbours ..."""

MIN_SPIKE_SIGMAS = 6.0
"""... and the smallest one in standard deviations by noise: one in a billion readings."""

MAX_SPIKE_MOTION_M = 0.01
"""Motion of the outermost sensor between two samples beyond which no spikes are sought: the field
of a bar, which is about 30 mm wide, would look like one."""

MIN_SPIKE_FRACTION = 0.4
"""Further difference that a spike must have, relative to the larger of its neighbours: the field
of a fast robot is curved between two samples."""

MIN_SPREAD_FRACTION = 1e-3
"""A sensor whose standard deviation is smaller than this fraction of the largest one is dead."""

MAX_UNCOVERED_FRACTION = 0.02
"""Fraction of the samples before and after the odometry that is left out without a warning."""

MAX_INTERPOLATED_MOTION_M = 0.01
"""Motion of the outermost sensor between two poses beyond which it is not interpolated if poses in
between were invalid: a fifth of the size of a bar's field, over which a path is nearly straight."""

MAX_OFFSET_T = 5e-4
"""Largest field that is attributed to offsets and noise alone."""

MIN_OFFSET_SAMPLES = 30
"""Number of such samples from which offsets are estimated."""

MIN_NOISE_T = 2e-5
"""Lower limit of the estimated or given noise of a sample."""

UNKNOWN_NOISE_T = 10 * MIN_NOISE_T
"""Noise that is assumed if a recording is too short or too sparse for an estimate."""

NOISE_QUANTILE = 0.25
"""Quantile of the second differences from which noise is estimated: most of the time the field is
even, which the upper quantiles are not."""

MIN_LEVELS = 8
"""Number of different readings from which on their smallest difference is taken as the step of the
sensors."""

NORMAL_QUARTILE_OF_MAGNITUDE = 0.3186
"""25 % quantile of the absolute value of a standard normal variable."""

MAX_SPAN_M = 2.0
"""Extent of a path that is certainly too long for one landmark."""

DEFAULT_PITCH_M = 0.2
"""Distance of neighbouring landmarks that is assumed without a map."""

MIN_MOTION_M = 1e-3
"""Motion of a sensor below which a field cannot change."""

STEP_M = 5e-3
"""Path of the sensors over which fields are summed in order to detect visits."""

MIN_FIELD_THRESHOLDS = 0.2
"""Field that indicates a landmark, in thresholds of its territory ..."""

MIN_FIELD_SIGMAS = 6.0
"""... and in standard deviations of the noise; the larger of the two applies."""

MIN_PEAK_THRESHOLDS = 0.5
"""Strongest field of a visit in thresholds, below which it does not determine a landmark."""

MARGIN_M = 0.06
"""Path before the first and after the last field that belongs to a visit as well."""

BIN_M = 2e-3
"""Path of the sensors over which samples are averaged."""

MAX_BINS = 400

MIN_POSE_INTERVAL_NS = 100_000
"""Shortest time between two poses of the odometry [ns]: 10 kHz. Times of a recording are made to
ascend by a nanosecond if its clock was corrected; the velocity between such poses is not real."""

VELOCITY_SPAN_NS = 10_000_000
"""Time before and after which velocities are the mean of: about the spacing of odometry."""

REFERENCE_DISTANCE_M = 5e-3
"""The reference of a visit is its last bin that is at most this much farther from the landmark than
the nearest one."""


@dataclass(frozen=True)
class HallRecording:
    """Preprocessed recording of one robot.

    Attributes
    ----------
    samples : HallSamples
        ``nan`` if a sensor was saturated or dead, or at a spike.
    pose : (n, 3) ndarray
        Robot by its odometry at each sample: x, y, heading (unwrapped).
    offset_t : (N,) ndarray
        Of each sensor, as far as the recording determines it.
    noise_t : float
        Standard deviation of a sample.
    warnings : tuple of SolverWarning
    odometry : Trajectory or None
        The valid poses, from which :attr:`pose` is interpolated.
    """

    samples: HallSamples
    pose: Array
    offset_t: Array
    noise_t: float
    warnings: tuple[SolverWarning, ...] = ()
    odometry: Trajectory | None = None

    def without_sensor(self, sensor: int) -> HallRecording:
        """Return the recording without one sensor, with a warning."""
        field = self.samples.field_t.copy()
        field[:, sensor] = np.nan
        name = self.samples.sensors.names[sensor]
        message = f"the {name} sensor agrees with no landmark; left out"
        warning = SolverWarning("sensor_left_out", message).about(self.samples.device)
        samples = replace(self.samples, field_t=field)
        return replace(self, samples=samples, warnings=(*self.warnings, warning))

    def rescaled(self, scale: float) -> HallRecording:
        """Return the recording with readings divided by a factor, with a warning."""
        message = (
            f"fields are about {scale:.2g} times those expected of the bars; corrected. Check the "
            "unit and the gain of the readings, the height of the sensors, and the bars of the map"
        )
        warning = SolverWarning("sensor_scale", message).about(self.samples.device)
        return replace(
            self,
            samples=replace(self.samples, field_t=self.samples.field_t / scale),
            offset_t=self.offset_t / scale,
            noise_t=max(self.noise_t / scale, MIN_NOISE_T),
            warnings=(*self.warnings, warning),
        )


@dataclass(frozen=True)
class VisitSegment:
    """Part of a recording near one landmark.

    Attributes
    ----------
    first, stop : int
        Samples ``first`` to ``stop - 1``.
    time_ns : (n,) int64 ndarray
        Mean times of the bins of :attr:`trace`.
    trace : Trace
    origin : (3,) ndarray
        Pose of the robot by odometry at ``trace.reference``: the frame of the trace.
    """

    first: int
    stop: int
    time_ns: NDArray[np.int64]
    trace: Trace
    origin: Array

    def odometry_pose(self, index: int) -> Array:
        """Return the mean pose (3,) of one bin by odometry."""
        return compose(self.origin, self.trace.pose[index])


def preprocess(samples: HallSamples, odometry: Trajectory | None) -> HallRecording:
    """Remove invalid readings and poses, and interpolate the odometry at the times of the samples.

    Raises
    ------
    InputError
        There is no odometry, it covers no sample, or no sensor can be used.
    """
    if odometry is None or len(odometry) < 2:
        raise InputError(
            f"no odometry of {samples.device}",
            hint="Record it together with the hall sensors: fields alone do not determine a path",
        )
    time_ns = samples.time_ns
    is_valid = valid_poses(odometry)
    if is_valid.sum() < 2:
        raise InputError(
            f"no valid odometry of {samples.device}",
            hint="Its poses are not finite numbers, or their times do not increase",
        )
    warnings = []
    if not is_valid.all():
        message = (
            f"{(~is_valid).sum()} poses of the odometry are not finite numbers, or not later than "
            "the pose before; left out"
        )
        warnings.append(SolverWarning("odometry_invalid", message).about(samples.device))
    invalid_ns, odometry = odometry.time_ns[~is_valid], odometry.select(is_valid)
    is_covered = (time_ns >= odometry.time_ns[0]) & (time_ns <= odometry.time_ns[-1])
    is_covered &= ~_is_in_gap(samples, odometry, invalid_ns)
    if is_covered.sum() < 2:
        raise InputError(
            f"the odometry of {samples.device} covers none of its samples",
            hint="Check that both clocks are the same",
        )
    uncovered = int((~is_covered).sum())
    if uncovered > MAX_UNCOVERED_FRACTION * len(time_ns):
        message = f"{uncovered} samples without odometry left out"
        warnings.append(SolverWarning("samples_without_odometry", message).about(samples.device))
    pose = interpolate_smoothly(time_ns, odometry.time_ns, planar_poses(odometry))
    field, reading_warnings = remove_invalid_readings(samples, sensor_motion(samples.sensors, pose))
    field, time_ns = field[is_covered], time_ns[is_covered]
    return HallRecording(
        samples=HallSamples(samples.device, samples.sensors, time_ns, field),
        pose=pose[is_covered],
        offset_t=_estimate_offsets(field),
        noise_t=_sample_noise(samples, field),
        warnings=(*warnings, *reading_warnings),
        odometry=odometry,
    )


def valid_poses(odometry: Trajectory) -> NDArray[np.bool_]:
    """Return which poses (n,) are finite and later than all finite ones before.

    Poses less than :data:`MIN_POSE_INTERVAL_NS` later are not.
    """
    is_finite = np.isfinite(np.hstack([odometry.position[:, :2], odometry.quaternion]))
    is_valid = np.asarray(is_finite.all(axis=1))
    time_ns = odometry.time_ns[is_valid]
    is_later = np.ones(len(time_ns), bool)
    is_later[1:] = time_ns[1:] - np.maximum.accumulate(time_ns)[:-1] >= MIN_POSE_INTERVAL_NS
    is_valid[is_valid] = is_later
    return is_valid


def _is_in_gap(
    samples: HallSamples, odometry: Trajectory, invalid_ns: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return which samples (n,) are at invalid poses between valid ones that are far apart."""
    motion_m = sensor_motion(samples.sensors, planar_poses(odometry))
    has_invalid = np.diff(np.searchsorted(invalid_ns, odometry.time_ns)) > 0
    is_gap = np.pad(has_invalid & (motion_m > MAX_INTERPOLATED_MOTION_M), 1)
    return np.asarray(is_gap[np.searchsorted(odometry.time_ns, samples.time_ns)])


def sensor_motion(sensors: HallSensors, pose: Array) -> Array:
    """Return the largest motion (n - 1,) of a sensor between successive poses (n, 3)."""
    step = np.diff(pose, axis=0)
    radius_m = float(np.hypot(*sensors.position_m.T).max())
    return np.asarray(np.hypot(step[:, 0], step[:, 1]) + radius_m * np.abs(step[:, 2]))


def planar_poses(odometry: Trajectory) -> Array:
    """Return x, y and unwrapped heading (n, 3) of a trajectory."""
    heading = np.unwrap(heading_from_quaternion(odometry.quaternion))
    return np.column_stack([odometry.position[:, :2], heading])


def check_odometry(recording: HallRecording, geometry: Geometry) -> None:
    """Check that the odometry is plausible for the fields.

    Raises
    ------
    InputError
        It moves by metres at one landmark, or does not move while the field changes.
    """
    device = recording.samples.device
    strongest = np.nan_to_num(np.abs(recording.samples.field_t)).max(axis=1)
    edges = np.diff((strongest > geometry.threshold_t).astype(np.int8), prepend=0, append=0)
    spans = np.column_stack([np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)])
    if not len(spans):
        return
    extent = [float(np.hypot(*np.ptp(recording.pose[a:b, :2], axis=0))) for a, b in spans]
    # The longest of them may be along a whole row of landmarks.
    usual_extent_m = float(np.quantile(extent, 0.9))
    if usual_extent_m > MAX_SPAN_M:
        raise InputError(
            f"the odometry of {device} moves {usual_extent_m:.3g} m over one landmark",
            hint="Positions are in metres and headings in radians: check the units",
        )
    motion_m = max(
        np.ptp(recording.pose[:, :2], axis=0).max(),
        np.hypot(*recording.samples.sensors.position_m.T).max() * np.ptp(recording.pose[:, 2]),
    )
    if motion_m >= MIN_MOTION_M:
        return
    field_t = recording.samples.field_t
    if np.nanmax(np.fmax.reduce(field_t) - np.fmin.reduce(field_t)) > geometry.threshold_t:
        raise InputError(
            f"the odometry of {device} does not move while its fields change",
            hint="Positions are in metres and headings in radians: check the units",
        )


# ---- invalid readings


def remove_invalid_readings(
    samples: HallSamples, motion_m: Array
) -> tuple[Array, list[SolverWarning]]:
    """Replace spikes, saturated readings and dead sensors by ``nan``.

    Parameters
    ----------
    samples : HallSamples
    motion_m : (n - 1,) ndarray
        Largest motion of a sensor between successive samples.

    Returns
    -------
    field_t : (n, N) ndarray
    warnings : list of SolverWarning

    Raises
    ------
    InputError
        No sensor is left.
    """
    field = samples.field_t.copy()
    warnings = []
    is_spike = detect_spikes(field, motion_m, _sample_noise(samples, field))
    field[is_spike] = np.nan
    if is_spike.any():
        message = f"{int(is_spike.sum())} single readings jump; left out"
        warnings.append(SolverWarning("spikes", message))
    range_t = samples.sensors.range_t
    plateau_t = _detect_plateau(field)
    if not np.isfinite(range_t) and plateau_t is not None:
        range_t = plateau_t
        message = f"readings end at {1e3 * range_t:.3g} mT, which is taken as the sensors' range"
        warnings.append(SolverWarning("range_from_data", message))
    is_saturated = np.abs(field) >= SATURATION_FRACTION * range_t
    field[is_saturated] = np.nan
    if is_saturated.any():
        message = f"{100 * is_saturated.mean():.2g} % of the readings are saturated"
        warnings.append(SolverWarning("saturated", message))
    warnings += _remove_dead_sensors(samples, field)
    return field, [warning.about(samples.device) for warning in warnings]


def detect_spikes(field: Array, motion_m: Array, noise_t: float) -> NDArray[np.bool_]:
    """Return which readings (n, N) deviate from both neighbours."""
    is_spike = np.zeros(field.shape, bool)
    if len(field) < 3:
        return is_spike
    before, reading, after = field[:-2], field[1:-1], field[2:]
    difference = np.abs(reading - (before + after) / 2)
    larger = np.maximum(np.abs(before), np.abs(after))
    # A difference from the mean of two has the variance 1 + 1/4 + 1/4.
    least_t = max(MIN_SPIKE_T, MIN_SPIKE_SIGMAS * math.sqrt(1.5) * noise_t)
    with np.errstate(invalid="ignore"):
        is_spike[1:-1] = difference > least_t + np.abs(after - before) + MIN_SPIKE_FRACTION * larger
    is_slow = np.maximum(motion_m[:-1], motion_m[1:]) <= MAX_SPIKE_MOTION_M
    is_spike[1:-1] &= is_slow[:, None]
    return is_spike


def _detect_plateau(field: Array) -> float | None:
    """Return the largest magnitude if many readings have it: an unknown range ends there."""
    magnitude = np.abs(field[~np.isnan(field)])
    if not len(magnitude) or magnitude.max() < MIN_SPIKE_T:
        return None
    largest = float(magnitude.max())
    is_plateau = (magnitude > (1 - 1e-9) * largest).sum() >= MIN_PLATEAU_READINGS
    return largest if is_plateau else None


def _remove_dead_sensors(samples: HallSamples, field: Array) -> list[SolverWarning]:
    """Remove dead sensors from ``field`` in place; return warnings of them."""
    names = samples.sensors.names
    spread = np.array(
        [np.nan if np.isnan(column).all() else np.nanstd(column) for column in field.T]
    )
    if np.isnan(spread).all():
        raise InputError(
            f"no hall sensor of {samples.device} can be used",
            hint="All are dead or saturated: check wiring and range",
        )
    is_silent = np.isnan(samples.field_t).all(axis=0)
    warnings = [
        SolverWarning("sensor_silent", f"the {names[k]} sensor reported nothing")
        for k in np.flatnonzero(is_silent)
    ]
    for k in np.flatnonzero(spread < MIN_SPREAD_FRACTION * np.nanmax(spread)).tolist():
        field[:, k] = np.nan
        message = f"the {names[k]} sensor never changed; left out"
        warnings.append(SolverWarning("sensor_constant", message))
    return warnings


def _estimate_offsets(field: Array) -> Array:
    """Return the readings (N,) of the sensors far from landmarks; 0 if there are too few."""
    quiet = field[np.all(np.isnan(field) | (np.abs(field) < MAX_OFFSET_T), axis=1)]
    if len(quiet) < MIN_OFFSET_SAMPLES:
        return np.zeros(field.shape[1])
    is_silent = np.isnan(quiet).all(axis=0)
    return np.where(is_silent, 0.0, np.nanmedian(np.where(is_silent, 0.0, quiet), axis=0))


def _sample_noise(samples: HallSamples, field: Array) -> float:
    """Return the standard deviation of a sample: as given, or from second differences.

    It is at least that of rounding to the steps of the readings.
    """
    values = np.unique(field[~np.isnan(field)])
    step_t = float(np.diff(values).min()) if len(values) >= MIN_LEVELS else 0.0
    least_t = max(MIN_NOISE_T, step_t / math.sqrt(12))
    given_t = samples.sensors.noise_t
    if math.isfinite(given_t) and given_t > 0:
        return max(given_t, least_t)
    second = np.abs(field[2:] - 2 * field[1:-1] + field[:-2])
    if np.isnan(second).all():
        return max(UNKNOWN_NOISE_T, least_t)
    quantile = np.nanquantile(second, NOISE_QUANTILE)
    # A second difference has the variance 1 + 4 + 1.
    return max(float(quantile / NORMAL_QUARTILE_OF_MAGNITUDE / math.sqrt(6)), least_t)


def interpolate_smoothly(
    time_ns: NDArray[np.int64], known_ns: NDArray[np.int64], values: Array
) -> Array:
    """Interpolate values (n, k) smoothly, without overshoot where they are constant."""
    known_s, wanted_s = (known_ns - known_ns[0]) * 1e-9, (time_ns - known_ns[0]) * 1e-9
    if len(known_s) < 3:
        return np.column_stack([np.interp(wanted_s, known_s, column) for column in values.T])
    return np.asarray(Akima1DInterpolator(known_s, values, method="makima")(wanted_s))


# ---- visits


def segment_visits(
    recording: HallRecording,
    geometry: Geometry,
    drift: OdometryDrift,
    pitch_m: float = DEFAULT_PITCH_M,
) -> list[VisitSegment]:
    """Divide a recording into visits to landmarks, in order of time.

    A visit continues while fields are measured within half the pitch of the centroid of the
    previous ones. Samples in between belong to it, and a margin before and after, up to half the
    samples to the neighbouring visit.

    Parameters
    ----------
    recording : HallRecording
    geometry : Geometry
    drift : OdometryDrift
    pitch_m : float
        Distance of neighbouring landmarks.
    """
    starts, power, position = _fields_along_path(recording, geometry)
    groups: list[list[int]] = []
    centroids: list[Array] = []
    weight = 0.0
    for number in np.flatnonzero(power > 0).tolist():
        if groups and np.hypot(*(position[number] - centroids[-1])) < pitch_m / 2:
            groups[-1][1] = number
            weight += power[number]
            shift = (position[number] - centroids[-1]) * power[number] / weight
            centroids[-1] = centroids[-1] + shift
        else:
            groups.append([number, number])
            centroids.append(position[number])
            weight = power[number]
    magnitude = np.abs(recording.samples.field_t - recording.offset_t)
    strongest = np.nan_to_num(magnitude).max(axis=1)
    edges = np.append(starts, len(strongest))
    spans = [(int(edges[a]), int(edges[b + 1])) for a, b in groups]
    kept = [
        n
        for n, (first, stop) in enumerate(spans)
        if strongest[first:stop].max() >= MIN_PEAK_THRESHOLDS * geometry.threshold_t
    ]
    spans, centroids = [spans[n] for n in kept], [centroids[n] for n in kept]
    steps = np.hypot(*np.diff(recording.pose[:, :2], axis=0).T)
    distance = np.concatenate([[0], np.cumsum(steps)])
    segments = []
    for number, ((first, stop), centroid) in enumerate(zip(spans, centroids, strict=True)):
        earliest = (spans[number - 1][1] + first) // 2 if number else 0
        is_last = number + 1 == len(spans)
        latest = len(distance) if is_last else (stop + spans[number + 1][0]) // 2
        begin = int(np.searchsorted(distance, distance[first] - MARGIN_M))
        end = int(np.searchsorted(distance, distance[stop - 1] + MARGIN_M, "right"))
        segments.append(
            average_samples(recording, max(earliest, begin), min(latest, end), centroid, drift)
        )
    return segments


def merge_segments(
    recording: HallRecording,
    first: VisitSegment,
    second: VisitSegment,
    centre: Array,
    drift: OdometryDrift,
) -> VisitSegment:
    """Merge two successive visits to the landmark at ``centre``, with the samples in between."""
    return average_samples(recording, first.first, second.stop, centre, drift)


def _sensor_path(recording: HallRecording, pose: Array) -> Array:
    """Return the distance (n,) that the outermost sensor moved since the first of poses (n, 3)."""
    step = np.diff(pose, axis=0, prepend=pose[:1])
    radius_m = float(np.hypot(*recording.samples.sensors.position_m.T).max())
    return np.cumsum(np.hypot(step[:, 0], step[:, 1]) + radius_m * np.abs(step[:, 2]))


def _fields_along_path(
    recording: HallRecording, geometry: Geometry
) -> tuple[NDArray[np.intp], Array, Array]:
    """Sum the fields over short steps of the path.

    Returns
    -------
    starts : (g,) ndarray
        First samples of the steps.
    power : (g,) ndarray
        Sums of squares of the fields above the limits of detection.
    position : (g, 2) ndarray
        Centroids of the sensors, weighted with these squares.
    """
    path = _sensor_path(recording, recording.pose)
    starts = np.flatnonzero(np.diff(np.floor(path / STEP_M), prepend=-1.0))
    magnitude = np.nan_to_num(np.abs(recording.samples.field_t - recording.offset_t))
    limit_t = max(MIN_FIELD_THRESHOLDS * geometry.threshold_t, MIN_FIELD_SIGMAS * recording.noise_t)
    magnitude[magnitude < limit_t] = 0.0
    position = sensor_positions(recording.pose, recording.samples.sensors.position_m)
    power = np.add.reduceat((magnitude**2).sum(axis=1), starts)
    moment = np.add.reduceat(np.einsum("ns,nsi->ni", magnitude**2, position), starts, axis=0)
    with np.errstate(invalid="ignore"):
        return starts, power, moment / power[:, None]


def _velocity(recording: HallRecording, first: int, stop: int) -> Array:
    """Return the derivatives of the poses by odometry (stop - first, 3) at samples, per second."""
    time_ns = recording.samples.time_ns - recording.samples.time_ns[0]
    ahead, behind = (
        np.column_stack([np.interp(wanted_ns, time_ns, each) for each in recording.pose.T])
        for wanted_ns in (
            time_ns[first:stop] + VELOCITY_SPAN_NS,
            time_ns[first:stop] - VELOCITY_SPAN_NS,
        )
    )
    return (ahead - behind) / (2e-9 * VELOCITY_SPAN_NS)


def average_samples(
    recording: HallRecording, first: int, stop: int, centre: Array, drift: OdometryDrift
) -> VisitSegment:
    """Average the samples ``first`` to ``stop - 1`` of a visit in bins of the path.

    ``centre`` (2,) is the landmark's position by odometry, at which the reference is nearest.
    """
    pose = recording.pose[first:stop]
    path = _sensor_path(recording, pose)
    bin_m = max(BIN_M, path[-1] / MAX_BINS)
    starts = np.flatnonzero(np.diff(np.floor(path / bin_m).astype(np.int64), prepend=-1))
    field = recording.samples.field_t[first:stop] - recording.offset_t
    is_measured = ~np.isnan(field)
    count = np.add.reduceat(is_measured.astype(float), starts, axis=0)
    with np.errstate(invalid="ignore"):
        mean_field = np.add.reduceat(np.where(is_measured, field, 0.0), starts, axis=0) / count
    samples = np.diff(np.append(starts, len(pose)))
    mean_pose = np.add.reduceat(pose, starts, axis=0) / samples[:, None]
    distance = np.hypot(*(mean_pose[:, :2] - centre).T)
    reference = int(np.flatnonzero(distance < distance.min() + REFERENCE_DISTANCE_M)[-1])
    local = relative(mean_pose, mean_pose[reference])
    velocity = np.add.reduceat(_velocity(recording, first, stop), starts, axis=0)
    velocity = velocity / samples[:, None] @ planar_rotation(mean_pose[reference, 2])
    trace = Trace(
        pose=local,
        correction=odometry_corrections(local, reference, drift, velocity),
        field_t=mean_field,
        sensor_position_m=recording.samples.sensors.position_m,
        weight=samples.astype(float),
        reference=reference,
    )
    start_ns = recording.samples.time_ns[first]
    elapsed_ns = recording.samples.time_ns[first:stop] - start_ns
    time_ns = start_ns + np.add.reduceat(elapsed_ns, starts) // samples
    return VisitSegment(first, stop, time_ns, trace, mean_pose[reference])
