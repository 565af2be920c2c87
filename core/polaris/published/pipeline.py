"""Published sensing pipeline of Polaris (section 6.2), for comparison.

Magnets are detected by peaks of the field (6.2.1), their orientations by alignment with
templates (6.2.2), their lateral positions by pairs of adjacent sensors and their longitudinal
ones by speed and rate (6.2.3). The array is assumed to drive straight at a known speed.
Identification, by which the tag's heading and id are found, is that of the default method.

The text leaves choices, and the released program (github.com/wjk5117/Polaris,
``Evaluation/Codes``) differs from it. Each choice was measured on the 13 published recordings
(10 of the default tag, 3 of the tag with varying orientations): runs that are read right, and
scatter of the orientations in degrees, rms about each magnet's mean, per set. The authors'
program reads 12 of the 13 right; its scatter over all runs is 4.7 and 9.8. Simulated passes
were counted too: 220, with headings of 0, 45, 90, 135 and 180 degrees and others, tags of
three to eight magnets, clearances of 5 to 15 mm, 100 and 40 samples per second. Each row of the
table changes one choice of this implementation, its first row; a row with "..." changes the one
above it. d is the spacing of the tag.

=================================================  =====  ===========  =======================
Choice                                             right  scatter      simulated: right, wrong
=================================================  =====  ===========  =======================
As it is                                           12     4.7, 3.7     210, 2
Windows of at most one point per sample (31)       10     7.5, 6.0     196, 2
Derivatives over the samples' standard deviation   7      6.4, 39.9    200, 10
... and 31 points                                  6      11.1, 47.0   185, 9
Each axis to a standard deviation of 1 (release)   7      5.3, 10.8    117, 91
... mean of the costs, 15 mm (release as a whole)  12     4.1, 7.6     not run
Mean of the costs along the path (release)         12     6.4, 5.2     not run
Lateral offsets to d/2 in steps of d/4 (text)      11     2.8, 35.6    125, 77
Lateral offsets to d/4 in steps of d/8 (release)   12     4.7, 3.7     203, 9
72 orientations                                    12     3.5, 3.5     210, 4
Nine lateral offsets                               12     4.1, 3.0     213, 0
Magpylib's cylinders for dipoles                   12     4.7, 3.7     211, 2
Neighbours not subtracted (text and release)       12     4.0, 3.7     203, 8
=================================================  =====  ===========  =======================

- Window and template have the same number of points (8.3.1), however dense the samples are.
  The released program compares 30 samples, 2.6 mm apart, with 80 points, 1 mm apart.
- Alignment has one scale for the three axes, that of the derivatives
  (:mod:`~locatk.core.polaris.published.ddtw`).
- Lateral offsets extend to half the distance of two sensors, because the nearest sensor is
  aligned. With the paper's array and tag that is d/4, as in the released set. The text
  (6.2.2) has d/2; beyond d/4 a moment across the path looks like the opposite one, and is
  mistaken by 180 degrees.
- The templates' clearance is the tag's. The released set has 15 mm where the paper has 10 mm
  and the recordings fit 11.4 to 11.9 mm: with 15 mm all 13 runs are read right.
- The background is the field between tags, not that of the start of the recording.
- 6.2.3 neglects the fields of neighbouring magnets. Here, when all magnets are located, each
  is located again without them: without that the simulated positions of eight magnets are
  off by 2.15 mm in the mean instead of 1.85 mm, those of the miniature tag by 1.44 instead
  of 0.88 mm.
- No sensor serves two magnets that are passed at the same time, as in Fig. 14(b).
- Heading and id come from the grid that fits all magnets best, and an orientation at the
  border between two is refused. The estimator of the text and the release, the position
  pattern alone (:func:`pattern_heading`), has mean absolute errors of the heading, nominally 0,
  of 0.92 and 1.73 degrees instead of 0.76 and 0.45.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_field
from locatk.core.polaris.array import Samples
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.published import ddtw
from locatk.core.polaris.published.peaks import (
    Peak,
    Signals,
    estimate_background,
    find_peaks,
    measure_signals,
    refine_peak,
)
from locatk.core.polaris.published.templates import TemplateGrid, template_set
from locatk.core.polaris.tag import Tags
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

SMOOTHING_CLEARANCES = 1 / 8
"""Standard deviation of the amplitude's smoothing in clearances, which are the length scale
of a magnet's field."""

MIN_SMOOTHING_SAMPLES = 0.5

CLEAR_CLEARANCES = 6.0
"""Distance in clearances beyond which a magnet's field is below a hundredth of its peak."""

BACKGROUND_CLEARANCES = 2.0
"""Range of the moving mean of the background, in clearances."""

MIN_SAMPLES_PER_SPACING = 5
"""Least number of samples on the path between two cells, for a window to have a shape."""

MIN_VALID_FRACTION = 0.5
"""Least fraction of valid samples of a sensor that is used."""

RIGHT_ANGLE_TOLERANCE_RAD = math.radians(15)
"""Deviation of the angle at v2 from 90 degrees, as in the released ``sensing_offline.py``."""


def detect_magnets(
    samples: Samples, tags: Tags, speed_mps: float | None, grid: TemplateGrid | None = None
) -> list[DetectedMagnets]:
    """Detect the magnets of each pass over a tag by the published algorithm.

    Parameters
    ----------
    samples : Samples
    tags : Tags
        Spacing, clearance and magnet are used.
    speed_mps : float
        Speed of the array along its x, above 0. The published recordings were made at 0.105 m/s
        with 40 samples per second.
    grid : TemplateGrid, optional
        Resolution of the templates; by default the paper's.

    Returns
    -------
    list of DetectedMagnets
        In order of time, without covariance.

    Raises
    ------
    InputError
        The speed is not known or not above 0, fewer than two sensors gave samples, or the
        samples are too few or too far apart.
    """
    if speed_mps is None:
        raise InputError(
            "no speed, which the paper's method needs", hint="Give it with --speed, in m/s"
        )
    if not 0 < speed_mps < math.inf:
        raise InputError(f"a speed of {speed_mps:g} m/s is not above 0")
    bar, warnings = _working_sensors(samples)
    path = speed_mps * (bar.time_ns - bar.time_ns[0]) * 1e-9
    step = float(np.median(np.diff(path))) if len(path) > 1 else math.inf
    if step * MIN_SAMPLES_PER_SPACING > tags.spacing_m:
        max_speed = tags.spacing_m / MIN_SAMPLES_PER_SPACING / step * speed_mps
        raise InputError(
            f"samples are {1e3 * step:.3g} mm apart, too far for tags of "
            f"{1e3 * tags.spacing_m:g} mm spacing",
            hint=f"Drive slower than {max_speed:.2g} m/s",
        )
    clearance = tags.clearance_m / step
    signal = measure_signals(bar, max(SMOOTHING_CLEARANCES * clearance, MIN_SMOOTHING_SAMPLES))
    slope_range = tags.spacing_m / 2 / step
    background = estimate_background(
        signal,
        find_peaks(signal, slope_range),
        CLEAR_CLEARANCES * clearance,
        BACKGROUND_CLEARANCES * clearance,
    )
    signal = signal.subtract(background)
    detector = _PassDetector(tags, bar.array.position_m, step, grid or TemplateGrid())
    passes = []
    for first, stop in _split_passes(find_peaks(signal, slope_range), tags, step, len(path)):
        magnets = detector.detect(signal.between(first, stop), path[first:stop])
        if magnets:
            passes.append(
                _as_detected(magnets, bar, path, (first, stop), tags.clearance_m, warnings)
            )
    return passes


@dataclass(frozen=True)
class LocatedMagnet:
    """Magnet below the array; ``path_m`` is the array's distance as it passed the magnet.

    ``pair`` are the two sensors that located it, that of the peak first.
    """

    peak: Peak
    pair: tuple[int, int]
    path_m: float
    x_m: float
    y_m: float
    angle_rad: float
    moment_am2: float

    def distance_m(self, other: LocatedMagnet) -> float:
        """Return the distance to another magnet on the floor."""
        along = self.x_m + self.path_m - other.x_m - other.path_m
        return math.hypot(along, self.y_m - other.y_m)


class _PassDetector:
    """Sections 6.2.1 to 6.2.3 for one pass."""

    def __init__(self, tags: Tags, position_m: Array, step_m: float, grid: TemplateGrid) -> None:
        self.tags, self.position_m, self.step_m = tags, position_m, step_m
        self.window_m = np.linspace(-1, 1, grid.points) * tags.spacing_m
        # The nearest sensor passes a magnet within half the distance of two sensors.
        max_offset = float(np.median(np.diff(position_m[:, 1]))) / 2
        self.templates = template_set(tags, max_offset, grid)
        self.slopes = ddtw.prepare(self.templates.field_t)

    def detect(self, signal: Signals, path: Array) -> list[LocatedMagnet]:
        """Locate the magnets of a pass, then again without the fields of their neighbours."""
        peaks = find_peaks(signal, self.tags.spacing_m / 2 / self.step_m)
        magnets = []
        for peak in peaks:
            pair = self.sensor_pair(signal, peak, peaks)
            if pair is not None:
                magnets.append(self.locate(signal, path, peak, pair))
        fields = [self.magnet_field(magnet, path) for magnet in magnets]
        total = np.sum(fields, axis=0)
        peak_range = self.tags.clearance_m / 2 / self.step_m
        refined = []
        for magnet, field in zip(magnets, fields, strict=True):
            isolated = signal.subtract(total - field)
            peak = refine_peak(isolated, magnet.peak, peak_range)
            refined.append(self.locate(isolated, path, peak, magnet.pair))
        return without_duplicates(refined, self.tags.spacing_m / 2)

    def sensor_pair(
        self, signal: Signals, peak: Peak, peaks: Sequence[Peak]
    ) -> tuple[int, int] | None:
        """Choose the two adjacent sensors that locate the magnet of a peak.

        The peak's sensor is the first. Returns None if the peak is a weaker one of a magnet
        that another peak locates.

        Magnets that are passed at the same time have pairs that share no sensor (6.2.3,
        Fig. 14b). Of all such sets of pairs, that with the largest sum of the weaker sensors'
        amplitudes is chosen, because its pairs enclose the magnets. If these pairs leave out
        the sensor of the peak, its stronger neighbour is the second.
        """
        simultaneous = self.tags.spacing_m / 2 / self.step_m
        rivals: dict[int, Peak] = {}  # by sensor; peaks are sorted, the strongest first
        for other in peaks:
            if abs(other.sample - peak.sample) < simultaneous:
                rivals.setdefault(other.sensor, other)
        own = peak.sensor
        if rivals[own] is not peak:
            return None
        gains = []
        for k in range(signal.amplitude_t.shape[1] - 1):
            inside = [rivals[sensor] for sensor in (k, k + 1) if sensor in rivals]
            if inside:
                sample = round(max(inside, key=lambda rival: rival.amplitude_t).sample)
                gains.append(float(signal.amplitude_t[sample, k : k + 2].min()))
            else:
                gains.append(0.0)
        for k in disjoint_pairs(gains):
            if own in (k, k + 1):
                second = 2 * k + 1 - own
                is_weaker = second in rivals and rivals[second].amplitude_t > peak.amplitude_t
                return None if is_weaker else (own, second)
        neighbours = [k for k in (own - 1, own + 1) if 0 <= k < signal.amplitude_t.shape[1]]
        amplitude = signal.amplitude_t[round(peak.sample)]
        return own, max(neighbours, key=lambda k: float(amplitude[k]))

    def locate(
        self, signal: Signals, path: Array, peak: Peak, pair: tuple[int, int]
    ) -> LocatedMagnet:
        """Align the window around a peak with the templates, then solve Eq. 3."""
        first, second = pair
        centre = float(np.interp(peak.sample, np.arange(len(path)), path))
        window = np.column_stack(
            [
                np.interp(centre + self.window_m, path, signal.field_t[:, first, axis])
                for axis in range(3)
            ]
        )
        nearest = int(ddtw.distances(window, self.slopes).argmin())
        angle = float(self.templates.angle_rad[nearest])
        ratio = peak.amplitude_t / signal.amplitude_t[round(peak.sample), second]
        x, y = self.position_m[first, :2]
        to_second = self.position_m[second, 1] - y
        offset = lateral_offset(float(ratio), angle, abs(to_second), self.tags.clearance_m)
        unit_field = field_strength(np.array([offset]), angle, self.tags.clearance_m)
        return LocatedMagnet(
            peak=peak,
            pair=pair,
            path_m=centre,
            x_m=float(x),
            y_m=float(y + math.copysign(offset, to_second)),
            angle_rad=math.remainder(angle, math.tau),
            moment_am2=float(peak.amplitude_t / unit_field[0]),
        )

    def magnet_field(self, magnet: LocatedMagnet, path: Array) -> Array:
        """Compute the field (n, N, 3) of a magnet along the path."""
        sensor = np.tile(self.position_m, (len(path), 1, 1))
        sensor[..., 0] += (path - magnet.path_m)[:, None] - magnet.x_m
        sensor[..., 1] -= magnet.y_m
        sensor[..., 2] = self.tags.clearance_m
        return dipole_field(sensor, magnet.moment_am2 * _direction(magnet.angle_rad))


def without_duplicates(
    magnets: Sequence[LocatedMagnet], min_distance_m: float
) -> list[LocatedMagnet]:
    """Keep the first of magnets that are no farther than ``min_distance_m`` from each other.

    Two sensors may detect one magnet at different times. Magnets are sorted, the strongest
    first.
    """
    kept: list[LocatedMagnet] = []
    for magnet in magnets:
        if all(magnet.distance_m(other) > min_distance_m for other in kept):
            kept.append(magnet)
    return kept


def disjoint_pairs(gains: Sequence[float]) -> list[int]:
    """Choose pairs (k, k + 1) of a row that share no member and have the largest total gain.

    Returns their k in ascending order; pairs without gain are left out.
    """
    best = [0.0, 0.0]
    for k, gain in enumerate(gains):
        best.append(max(best[-1], best[k] + gain))
    chosen, k = [], len(gains) - 1
    while k >= 0:
        if best[k + 2] > best[k + 1]:
            chosen.append(k)
            k -= 1
        k -= 1
    return chosen[::-1]


def field_strength(offset_m: Array, angle_rad: float, clearance_m: float) -> Array:
    """Compute |B| in tesla of a unit dipole at sensors abeam of it, ``offset_m`` to the left."""
    sensor = np.stack(np.broadcast_arrays(0.0, np.asarray(offset_m, float), clearance_m), axis=-1)
    return np.asarray(np.linalg.norm(dipole_field(sensor, _direction(angle_rad)), axis=-1))


def lateral_offset(
    ratio: float, angle_rad: float, separation_m: float, clearance_m: float
) -> float:
    """Solve Eq. 3 for the distance of a magnet from one sensor towards another.

    Parameters
    ----------
    ratio : float
        Field strength at the first over that at the second sensor as the magnet is abeam.
    angle_rad : float
        Direction of the magnet's moment from the direction of travel.
    separation_m : float
        Distance of the two sensors.
    clearance_m : float

    Returns
    -------
    float
        Metres within 0 .. ``separation_m``, the constraint of Eq. 3. A ratio that no position
        has gives the end whose ratio is nearest.

    Notes
    -----
    The ratio of a dipole's field strengths falls as the magnet moves towards the second
    sensor, whatever its orientation, so that a table inverts it. The strength of the magnet
    cancels.
    """
    offset = np.linspace(0.0, separation_m, 401)
    # Both sensors are on the same side in mirrored frames; |B| is the same in both.
    first = field_strength(offset, angle_rad, clearance_m)
    second = field_strength(separation_m - offset, angle_rad, clearance_m)
    return float(np.interp(-math.log(max(ratio, 1e-300)), np.log(second / first), offset))


def position_pattern(position_m: Array) -> tuple[int, int, int] | None:
    """Find v1, v2 and v3 among magnets (M, 2), by index (6.2.4).

    v1 and v3 are the two that are farthest apart; at v2 they subtend a right angle, within
    15 degrees. Returns None if no magnet does.
    """
    if len(position_m) < 3:
        return None
    distance = np.linalg.norm(position_m[:, None] - position_m[None], axis=-1)
    i, j = (int(k) for k in np.unravel_index(distance.argmax(), distance.shape))
    least_deviation = RIGHT_ANGLE_TOLERANCE_RAD
    corner = None
    for k, point in enumerate(position_m):
        if k in (i, j):
            continue
        a, b = position_m[i] - point, position_m[j] - point
        angle = math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))
        deviation = abs(angle - math.pi / 2)
        if deviation < least_deviation:
            least_deviation, corner = deviation, k
    if corner is None:
        return None
    a, b = position_m[i] - position_m[corner], position_m[j] - position_m[corner]
    # The vertices are numbered clockwise.
    return (i, corner, j) if a[0] * b[1] - a[1] * b[0] > 0 else (j, corner, i)


def pattern_heading(position_m: Array) -> float | None:
    """Estimate the heading of a tag by its position pattern alone (6.2.4).

    As in the released code it is the direction from the centroid of the three magnets to v2, less
    the 45 degrees that it has in the tag's frame: radians, counter-clockwise. None if there is no
    position pattern.
    """
    pattern = position_pattern(position_m)
    if pattern is None:
        return None
    x, y = position_m[pattern[1]] - position_m[list(pattern)].mean(axis=0)
    return math.remainder(math.atan2(y, x) - math.pi / 4, math.tau)


def _direction(angle_rad: float) -> Array:
    return np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])


def _working_sensors(samples: Samples) -> tuple[Samples, tuple[SolverWarning, ...]]:
    """Select the sensors that gave most of their samples, from right to left."""
    order = np.argsort(samples.array.position_m[:, 1], kind="stable")
    valid = np.isfinite(samples.field_t).all(axis=2).mean(axis=0)
    works = valid > MIN_VALID_FRACTION
    kept = order[works[order]]
    if len(kept) < 2:
        raise InputError(
            f"{len(kept)} of {len(works)} sensors of {samples.device} gave more than "
            f"{MIN_VALID_FRACTION:.0%} of their samples",
            hint="The paper's method needs two adjacent sensors",
        )
    dead = ", ".join(str(k + 1) for k in np.flatnonzero(~works))
    silent = SolverWarning(
        "sensor_silent",
        f"without sensor {dead}: at most {MIN_VALID_FRACTION:.0%} of its samples are valid",
    )
    warnings = (silent,) if dead else ()
    array = replace(samples.array, position_m=samples.array.position_m[kept])
    return Samples(samples.device, array, samples.time_ns, samples.field_t[:, kept]), warnings


def _split_passes(
    peaks: Sequence[Peak], tags: Tags, step_m: float, count: int
) -> Iterator[tuple[int, int]]:
    """Yield ranges of samples that hold one tag each, with a spacing before and behind it.

    Within a tag no gap along the path is longer than a side.
    """
    sample = np.sort([peak.sample for peak in peaks])
    if len(sample) == 0:
        return
    is_gap = np.diff(sample) * step_m > 1.25 * (tags.order - 1) * tags.spacing_m
    margin = math.ceil(tags.spacing_m / step_m) + 1
    for group in np.split(sample, np.flatnonzero(is_gap) + 1):
        first = max(math.floor(group[0]) - margin, 0)
        yield first, min(math.ceil(group[-1]) + margin + 1, count)


def _as_detected(
    magnets: Sequence[LocatedMagnet],
    samples: Samples,
    path: Array,
    span: tuple[int, int],
    clearance_m: float,
    warnings: tuple[SolverWarning, ...],
) -> DetectedMagnets:
    """Express the magnets of a pass in the array's frame at its middle."""
    passed = np.array([magnet.path_m for magnet in magnets])
    middle = int(np.abs(path - (passed.min() + passed.max()) / 2).argmin())
    ordered = [magnets[k] for k in np.argsort(passed, kind="stable")]
    first, stop = span
    return DetectedMagnets(
        time_ns=int(samples.time_ns[middle]),
        first=first,
        stop=stop,
        path_m=path[first:stop] - path[middle],
        position_m=np.array([(m.x_m + m.path_m - path[middle], m.y_m) for m in ordered]),
        angle_rad=np.array([m.angle_rad for m in ordered]),
        moment_am2=np.array([m.moment_am2 for m in ordered]),
        covariance=np.full((3 * len(ordered), 3 * len(ordered)), np.nan),
        path_sigma_m=np.full(stop - first, np.nan),
        height_m=clearance_m,
        warnings=warnings,
    )
