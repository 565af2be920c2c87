"""The paper's sensing pipeline, for comparison (Polaris section 6.2).

Peaks of the field (6.2.1), orientations by alignment with templates (6.2.2), lateral places
from pairs of adjacent sensors and longitudinal ones from speed and rate (6.2.3), heading
from the position pattern (6.2.4). The array is taken to drive straight on at a known speed.

Where the paper leaves room, or where by the letter its own recordings come out worse than
its figures:

- The background is that of the ground between tags, not of the start of the recording.
- The magnets of a tag reach into each other's samples, although 6.2.3 sets that aside. Once
  all are located, each is located again with the fields of the others taken away.
- No sensor serves two magnets that are passed together, as in Fig. 14(b).
- Alignment has one scale for the three axes, and the released set's lateral offsets
  (:mod:`~locatk.core.polaris.published.ddtw`, :mod:`~locatk.core.polaris.published.templates`).
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
    find_peaks,
    ground,
    peak_near,
    signals,
)
from locatk.core.polaris.published.templates import POINTS, template_set
from locatk.core.polaris.tag import Cell, Tags
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

SMOOTHING = 1 / 8
"""Width of the amplitude's smoothing in clearances, the scale of a magnet's field..."""

LEAST_SMOOTHING = 0.5
"""... and its least in samples."""

CLEAR = 6.0
"""Beyond so many clearances a magnet's field is below a hundredth of its peak: ground."""

FEWEST_POINTS = 5
"""Samples a spacing that a window has to have."""


def sightings(samples: Samples, tags: Tags, speed_mps: float | None) -> list[DetectedMagnets]:
    """Magnets of each pass over a tag, by the published algorithm.

    Parameters
    ----------
    samples : Samples
    tags : Tags
        Spacing, clearance and magnet are used.
    speed_mps : float
        Of the array along its x; the published recordings were made at 0.105 m/s with 40
        samples a second.

    Returns
    -------
    list of Sighting
        In order of time, without covariance.

    Raises
    ------
    InputError
        The speed is not known, fewer than two sensors gave samples, or the samples are too
        few or too far apart.
    """
    if speed_mps is None:
        raise InputError(
            "no speed, which the paper's method needs,", hint="Give it with --speed, in m/s"
        )
    bar, warnings = _living(samples)
    path = speed_mps * (bar.time_ns - bar.time_ns[0]) * 1e-9
    step = float(np.median(np.diff(path))) if len(path) > 1 else math.inf
    if step * FEWEST_POINTS > tags.spacing_m:
        raise InputError(
            f"samples are {1e3 * step:.3g} mm apart, too far for tags of "
            f"{1e3 * tags.spacing_m:g} mm spacing",
            hint=f"Drive slower than {tags.spacing_m / FEWEST_POINTS / step * speed_mps:.2g} m/s",
        )
    clearance = tags.clearance_m / step
    signal = signals(bar, max(SMOOTHING * clearance, LEAST_SMOOTHING))
    reach = tags.spacing_m / 2 / step
    peaks = find_peaks(signal, reach)
    signal = signal.less(ground(signal, peaks, CLEAR * clearance, 2 * clearance))
    pipeline = _Pipeline(tags, bar.array.position_m, step)
    found = []
    for first, stop in _passes(find_peaks(signal, reach), tags, step, len(path)):
        magnets = pipeline.magnets(signal.part(first, stop), path[first:stop])
        if magnets:
            found.append(_sighting(magnets, bar, path, (first, stop), tags.clearance_m, warnings))
    return found


@dataclass(frozen=True)
class _Magnet:
    """``way_m`` is how far the array had moved as it passed; ``pair`` are the two sensors."""

    peak: Peak
    pair: tuple[int, int]
    way_m: float
    x_m: float
    y_m: float
    angle_rad: float
    moment_am2: float


class _Pipeline:
    """Sections 6.2.1 to 6.2.3 for one pass."""

    def __init__(self, tags: Tags, position_m: Array, step_m: float) -> None:
        self.tags, self.position_m, self.step_m = tags, position_m, step_m
        points = min(POINTS, 2 * round(tags.spacing_m / step_m) + 1)
        self.window_m = np.linspace(-1, 1, points) * tags.spacing_m
        self.templates = template_set(tags, points=points)
        self.slopes = ddtw.prepare(self.templates.field_t)

    def magnets(self, signal: Signals, path: Array) -> list[_Magnet]:
        peaks = find_peaks(signal, self.tags.spacing_m / 2 / self.step_m)
        found = []
        for peak in peaks:
            pair = self.pair(signal, peak, peaks)
            if pair is not None:
                found.append(self.located(signal, path, peak, pair))
        fields = [self.field(magnet, path) for magnet in found]
        everything = np.sum(fields, axis=0)
        near = self.tags.clearance_m / 2 / self.step_m
        again = []
        for magnet, own in zip(found, fields, strict=True):
            alone = signal.less(everything - own)
            peak = peak_near(alone, magnet.peak, near)
            again.append(self.located(alone, path, peak, magnet.pair))
        return self.apart(again)

    def apart(self, magnets: Sequence[_Magnet]) -> list[_Magnet]:
        """The strongest of those that lie closer to each other than magnets can."""
        kept: list[_Magnet] = []
        for magnet in magnets:
            distances = [
                math.hypot(magnet.x_m + magnet.way_m - m.x_m - m.way_m, magnet.y_m - m.y_m)
                for m in kept
            ]
            if min(distances, default=math.inf) > self.tags.spacing_m / 2:
                kept.append(magnet)
        return kept

    def pair(self, signal: Signals, peak: Peak, peaks: Sequence[Peak]) -> tuple[int, int] | None:
        """The two adjacent sensors by which the magnet of a peak is located, that of the peak
        first; None where the peak is another's of the same magnet.

        Magnets that are passed together have pairs that share no sensor (6.2.3, Fig. 14b):
        those whose weaker sensors measure the most between them, as then the pairs enclose
        the magnets. Where such pairs leave the sensor of the peak out, its stronger
        neighbour is the second.
        """
        together = self.tags.spacing_m / 2 / self.step_m
        mates: dict[int, Peak] = {}  # by sensor; peaks come strongest first
        for other in peaks:
            if abs(other.at - peak.at) < together:
                mates.setdefault(other.sensor, other)
        own = peak.sensor
        if mates[own] is not peak:
            return None
        gains = []
        for k in range(signal.amplitude_t.shape[1] - 1):
            inside = [mates[sensor] for sensor in (k, k + 1) if sensor in mates]
            at = round(max(inside, key=lambda mate: mate.amplitude_t).at) if inside else None
            gains.append(0.0 if at is None else float(signal.amplitude_t[at, k : k + 2].min()))
        for k in disjoint_pairs(gains):
            if own in (k, k + 1):
                second = 2 * k + 1 - own
                stronger = second in mates and mates[second].amplitude_t > peak.amplitude_t
                return None if stronger else (own, second)
        beside = [k for k in (own - 1, own + 1) if 0 <= k < signal.amplitude_t.shape[1]]
        return own, max(beside, key=lambda k: float(signal.amplitude_t[round(peak.at), k]))

    def located(self, signal: Signals, path: Array, peak: Peak, pair: tuple[int, int]) -> _Magnet:
        first, second = pair
        way = float(np.interp(peak.at, np.arange(len(path)), path))
        window = np.column_stack(
            [
                np.interp(way + self.window_m, path, signal.field_t[:, first, axis])
                for axis in range(3)
            ]
        )
        best = int(ddtw.distances(window, self.slopes).argmin())
        angle = float(self.templates.angle_rad[best])
        ratio = peak.amplitude_t / signal.amplitude_t[round(peak.at), second]
        x, y = self.position_m[first, :2]
        apart = self.position_m[second, 1] - y
        offset = lateral_offset(float(ratio), angle, abs(apart), self.tags.clearance_m)
        here = field_strength(np.array([offset]), angle, self.tags.clearance_m)
        return _Magnet(
            peak=peak,
            pair=pair,
            way_m=way,
            x_m=float(x),
            y_m=float(y + math.copysign(offset, apart)),
            angle_rad=math.remainder(angle, math.tau),
            moment_am2=float(peak.amplitude_t / here[0]),
        )

    def field(self, magnet: _Magnet, path: Array) -> Array:
        """Field (n, N, 3) of a magnet along the way."""
        sensor = np.tile(self.position_m, (len(path), 1, 1))
        sensor[..., 0] += (path - magnet.way_m)[:, None] - magnet.x_m
        sensor[..., 1] -= magnet.y_m
        sensor[..., 2] = self.tags.clearance_m
        return dipole_field(sensor, magnet.moment_am2 * _direction(magnet.angle_rad))


def disjoint_pairs(gains: Sequence[float]) -> list[int]:
    """Of pairs (k, k + 1) in a row those that share no member and gain the most together:
    their k. Pairs without gain are left out."""
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
    """|B| in tesla of a unit dipole, at sensors abeam of it and ``offset_m`` aside."""
    sensor = np.stack(np.broadcast_arrays(0.0, np.asarray(offset_m, float), clearance_m), axis=-1)
    return np.asarray(np.linalg.norm(dipole_field(sensor, _direction(angle_rad)), axis=-1))


def lateral_offset(ratio: float, angle_rad: float, apart_m: float, clearance_m: float) -> float:
    """Eq. 3: how far a magnet lies from one sensor towards another.

    Parameters
    ----------
    ratio : float
        Of the field strengths measured by the first and the second sensor as the magnet
        is abeam of them.
    angle_rad : float
        Of the magnet's moment from the direction of travel.
    apart_m : float
        Distance of the two sensors.
    clearance_m : float

    Returns
    -------
    float
        Metres within 0 .. ``apart_m``, the constraint of Eq. 3: where no place has that
        ratio, the end that comes nearest to it.

    Notes
    -----
    The ratio of a dipole's field strengths falls as the magnet moves towards the second
    sensor, whatever its orientation, so that it is inverted on a table. The strength of the
    magnet does not matter.
    """
    offset = np.linspace(0.0, apart_m, 401)
    # Both sensors lie to one side in a frame that is turned along; only |B| is compared.
    first = field_strength(offset, angle_rad, clearance_m)
    second = field_strength(apart_m - offset, angle_rad, clearance_m)
    return float(np.interp(-math.log(max(ratio, 1e-300)), np.log(second / first), offset))


def position_pattern(place_m: Array) -> tuple[int, int, int] | None:
    """Which of the magnets (M, 2) are v1, v2 and v3 (6.2.4): v1 and v3 are the farthest
    apart, v2 sees them at a right angle, within 15 degrees. None where none does."""
    if len(place_m) < 3:
        return None
    apart = np.linalg.norm(place_m[:, None] - place_m[None], axis=-1)
    i, j = (int(k) for k in np.unravel_index(apart.argmax(), apart.shape))
    right = math.radians(15)
    corner = None
    for k, point in enumerate(place_m):
        if k in (i, j):
            continue
        a, b = place_m[i] - point, place_m[j] - point
        off = abs(math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))
        off = abs(off - math.pi / 2)
        if off < right:
            right, corner = off, k
    if corner is None:
        return None
    a, b = place_m[i] - place_m[corner], place_m[j] - place_m[corner]
    # The vertices are numbered clockwise.
    return (i, corner, j) if a[0] * b[1] - a[1] * b[0] > 0 else (j, corner, i)


def heading(place_m: Array) -> float | None:
    """Heading of the tag, by the direction from the middle of the position pattern's three
    magnets to v2, as the released code has it: radians, counter-clockwise; None without a
    pattern."""
    pattern = position_pattern(place_m)
    if pattern is None:
        return None
    x, y = place_m[pattern[1]] - place_m[list(pattern)].mean(axis=0)
    # In the tag's own frame v2 lies ahead and to the left.
    return math.remainder(math.atan2(y, x) - math.pi / 4, math.tau)


def pose_and_angles(
    sighting: DetectedMagnets, tags: Tags
) -> tuple[tuple[float, float, float], tuple[Cell, ...], Array] | None:
    """The tag by its position pattern alone (6.2.4), instead of by all magnets.

    Returns
    -------
    pose : (x_m, y_m, heading_rad)
        Of the tag in the array's frame: its middle is that of v1 and v3.
    cells : tuple of (column, row)
        The nearest to each magnet, which may lie outside of the grid.
    angle_rad : (M,) ndarray
        Of the magnets in the tag's frame, ``theta_mt`` of Fig. 11.

    None where there is no position pattern.
    """
    pattern, turn = position_pattern(sighting.position_m), heading(sighting.position_m)
    if pattern is None or turn is None:
        return None
    middle = (sighting.position_m[pattern[0]] + sighting.position_m[pattern[2]]) / 2
    cos, sin = math.cos(turn), math.sin(turn)
    own = (sighting.position_m - middle) @ np.array([[cos, -sin], [sin, cos]]) / tags.spacing_m
    half = (tags.order - 1) / 2
    cells = tuple((round(half - y), round(half + x)) for x, y in own.tolist())
    angle = np.remainder(sighting.angle_rad - turn + math.pi, math.tau) - math.pi
    return (float(middle[0]), float(middle[1]), turn), cells, angle


def _direction(angle_rad: float) -> Array:
    return np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])


def _living(samples: Samples) -> tuple[Samples, tuple[SolverWarning, ...]]:
    """The sensors that gave more than half of their samples, from right to left."""
    order = np.argsort(samples.array.position_m[:, 1], kind="stable")
    alive = np.isfinite(samples.field_t).all(axis=2).mean(axis=0) > 0.5
    kept = order[alive[order]]
    if len(kept) < 2:
        raise InputError(
            f"{len(kept)} of {len(alive)} sensors of {samples.device} gave samples",
            hint="The paper's method needs two adjacent sensors",
        )
    dead = ", ".join(str(k + 1) for k in np.flatnonzero(~alive))
    silent = SolverWarning("sensor_silent", f"without sensor {dead}, which gave no samples")
    warnings = (silent,) if dead else ()
    array = replace(samples.array, position_m=samples.array.position_m[kept])
    return Samples(samples.device, array, samples.time_ns, samples.field_t[:, kept]), warnings


def _passes(
    peaks: Sequence[Peak], tags: Tags, step_m: float, count: int
) -> Iterator[tuple[int, int]]:
    """Ranges of samples that hold one tag each, a spacing before and behind its magnets.

    Within a tag no gap along the track is longer than a side.
    """
    at = np.sort([peak.at for peak in peaks])
    if len(at) == 0:
        return
    gaps = np.diff(at) * step_m > 1.25 * (tags.order - 1) * tags.spacing_m
    margin = math.ceil(tags.spacing_m / step_m) + 1
    for group in np.split(at, np.flatnonzero(gaps) + 1):
        first = max(math.floor(group[0]) - margin, 0)
        yield first, min(math.ceil(group[-1]) + margin + 1, count)


def _sighting(
    magnets: Sequence[_Magnet],
    samples: Samples,
    path: Array,
    span: tuple[int, int],
    clearance_m: float,
    warnings: tuple[SolverWarning, ...],
) -> DetectedMagnets:
    ways = np.array([magnet.way_m for magnet in magnets])
    middle = int(np.abs(path - (ways.min() + ways.max()) / 2).argmin())
    order = np.argsort(ways, kind="stable")
    chosen = [magnets[k] for k in order]
    first, stop = span
    return DetectedMagnets(
        time_ns=int(samples.time_ns[middle]),
        first=first,
        stop=stop,
        path_m=path[first:stop] - path[middle],
        position_m=np.array([(m.x_m + m.way_m - path[middle], m.y_m) for m in chosen]),
        angle_rad=np.array([m.angle_rad for m in chosen]),
        moment_am2=np.array([m.moment_am2 for m in chosen]),
        covariance=np.full((3 * len(chosen), 3 * len(chosen)), np.nan),
        path_sigma_m=np.full(stop - first, np.nan),
        height_m=clearance_m,
        warnings=warnings,
    )
