"""Sequential landmark search on a recording (sections 3 and 4.1).

Visits are segmented as in the default method, but not merged. For each visit:

1. the first pass gives entries, and these the first estimate of the centre (:mod:`.first_step`);
2. each rotation of at least 330 degrees on the spot gives valleys, and these the pattern, heading
   and centre (:mod:`.second_step`); the last spin that can be read counts, because the paper
   retries;
3. at the sample at which the robot stops or passes within a few millimetres of the centre and
   along the bars, four voltages correct the pose (:mod:`.pose_compensation`).

A pass alone gives neither pattern nor heading: such a visit is refused as ``no_spin``, and a
warning contains the first estimate (``first_step``). One check is not in the paper: a reading
whose bars explain less than 60 % of the spin's field is refused as ``unexplained``. More than 8 to
10 mm from the centre valleys merge, and other patterns would be read without notice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks import preprocessing
from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift, relative, sensor_positions
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import Geometry, name
from locatk.core.landmarks.published.first_step import (
    GRAZING_CHORD_M,
    PassEntries,
    bar_radii,
    estimate_centre,
    find_entries,
    vote_centre,
)
from locatk.core.landmarks.published.pose_compensation import compensate_pose
from locatk.core.landmarks.published.second_step import (
    HYSTERESIS_FRACTION,
    MAX_OFFSET_FRACTION,
    SpinReading,
    Valleys,
    circle_profile,
    find_spins,
    find_valleys,
    recognise,
)
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

PASS_END_M = 0.020
"""Path without any field after which the first pass is over: longer than a gulf is wide (10 mm),
shorter than the gap between two territories (42 mm at the default pitch)."""

MAX_BAR_OFFSET_M = 0.006
"""Largest distance from the centre for the four voltages: the field of a bar is linear within
7.5 mm of its middle with the default bars."""

MAX_BAR_ROTATION_RAD = math.radians(12)
"""Largest rotation from the bars for the four voltages; 5 mm on the sensors' circle."""

STANDSTILL_M = 0.3e-3
"""Largest distance between the poses of a standstill."""

STANDSTILL_RAD = math.radians(0.3)
"""Largest rotation between the poses of a standstill."""

MAX_UNEXPLAINED_FRACTION = 0.4
"""A reading is refused if the rms residual of a spin exceeds this fraction of its rms field."""


@dataclass(frozen=True)
class FirstStep:
    """First estimate of a landmark's centre, from the first pass of a visit.

    Attributes
    ----------
    first, stop : int
        Samples of the pass.
    entries : PassEntries
        In the frame of the odometry.
    centre_m : (2,) ndarray
        In the frame of the odometry; ``nan`` if no candidate is left.
    voted_m : (2,) ndarray
        Estimate of the baseline (:func:`~.first_step.vote_centre`).
    grazed : bool
        The pass may only have cut a corner of the territory; the error can be 28 mm.
    """

    first: int
    stop: int
    entries: PassEntries
    centre_m: Array
    voted_m: Array
    grazed: bool


def detect_landmarks(
    samples: HallSamples,
    odometry: Trajectory,
    geometry: Geometry,
    pitch_m: float = preprocessing.DEFAULT_PITCH_M,
) -> list[VisitHypotheses]:
    """Detect the landmarks visited in a recording by the published algorithm.

    Parameters
    ----------
    samples : HallSamples
    odometry : Trajectory
        Of the same robot and clock.
    geometry : Geometry
    pitch_m : float
        Distance of neighbouring landmarks, by which visits are separated.

    Returns
    -------
    list of VisitHypotheses
        One for each visit, in order of time: with one hypothesis of probability 1 and unknown
        covariance, or refused as ``no_spin``, ``no_pattern`` or ``unexplained``.

    Raises
    ------
    InputError
        There is no odometry, it covers no sample, or no sensor can be used.
    DegenerateError
        The field of the bars does not reach the threshold.
    """
    return [visit.detect() for visit in _find_visits(samples, odometry, geometry, pitch_m)]


def first_steps(
    samples: HallSamples,
    odometry: Trajectory,
    geometry: Geometry,
    pitch_m: float = preprocessing.DEFAULT_PITCH_M,
) -> list[FirstStep]:
    """Run the first step alone for each visit of a recording.

    Parameters and exceptions as in :func:`detect_landmarks`.
    """
    return [visit.first_step() for visit in _find_visits(samples, odometry, geometry, pitch_m)]


def run_first_step(
    position_m: Array, field_t: Array, threshold_t: float, radii_m: tuple[float, float]
) -> tuple[PassEntries, Array, Array]:
    """Return the entries, the paper's centre (2,) and the voted centre (2,) of one pass.

    ``position_m`` (n, N, 2) are the sensors, ``field_t`` (n, N) their fields, ``radii_m`` r1 and
    r2.
    """
    entries = find_entries(position_m, field_t, threshold_t)
    points, silent = entries.point_m[None], entries.silent_m[None]
    centre = estimate_centre(points, silent, entries.robot_m[None], radii_m)[0]
    return entries, centre, vote_centre(points, silent, radii_m)[0]


def spin_valleys(
    pose: Array, field_t: Array, lever_arm_m: Array, geometry: Geometry
) -> tuple[Valleys | None, Array]:
    """Find the valleys of one spin and the centre (2,) of its circle.

    Parameters
    ----------
    pose : (n, 3) ndarray
        Robot by odometry while it rotates on the spot.
    field_t : (n, N) ndarray
    lever_arm_m : (N, 2) ndarray
        Sensors in the robot's frame.
    geometry : Geometry

    Returns
    -------
    valleys : Valleys or None
        None if part of the circle was not measured.
    centre_m : (2,) ndarray
        In the frame of the odometry.
    """
    centre = np.median(pose[:, :2], axis=0)
    profile = circle_profile(sensor_positions(pose, lever_arm_m), field_t, centre)
    if np.isnan(profile).any():
        return None, centre
    return find_valleys(profile, HYSTERESIS_FRACTION * geometry.threshold_t), centre


def recognise_spin(
    valleys: Valleys,
    centre_m: Array,
    lever_arm_m: Array,
    max_offset_fraction: float = MAX_OFFSET_FRACTION,
) -> SpinReading | None:
    """Recognise the landmark of one spin, in the frame of the odometry; None if it fits none.

    Parameters
    ----------
    valleys, centre_m
        Results of :func:`spin_valleys`.
    lever_arm_m : (N, 2) ndarray
        Sensors in the robot's frame; their mean distance from the origin is the circle's radius.
    max_offset_fraction : float
        See :func:`~.second_step.recognise`.
    """
    radius = float(np.mean(np.hypot(*lever_arm_m.T)))
    reading = recognise(valleys, radius, max_offset_fraction)
    if reading is None:
        return None
    return SpinReading(reading.centre_m + centre_m, reading.bar_rad, reading.north)


def pose_by_valleys(reading: SpinReading, odometry: Array) -> tuple[int, Array]:
    """Return the code and the robot's pose (3,) in the landmark's frame by the valleys alone.

    ``odometry`` (3,) is the robot at that time.
    """
    code, heading = reading.in_frame_of(odometry[2])
    pose = relative(odometry[None], np.array([*reading.centre_m, heading]))[0]
    pose[2] = math.remainder(pose[2], math.tau)
    return code, pose


def contradicts_valleys(pose: Array) -> bool:
    """Return whether a pose (3,) by four voltages is too far from the centre to be right.

    The voltages are used near the centre only; a pose beyond twice these limits shows that the
    landmark is another one or that its fields are not linear there.
    """
    too_far = np.hypot(*pose[:2]) > 2 * MAX_BAR_OFFSET_M
    return bool(too_far or abs(pose[2]) > 2 * MAX_BAR_ROTATION_RAD)


def unexplained_fraction(
    geometry: Geometry,
    hypothesis: tuple[int, Array],
    odometry: Array,
    spin: tuple[Array, Array],
    lever_arm_m: Array,
) -> float:
    """Return the rms residual of a spin for a landmark, in units of the rms of its field.

    Parameters
    ----------
    geometry : Geometry
    hypothesis : (int, (3,) ndarray)
        Code, and the robot in the frame of the landmark.
    odometry : (3,) ndarray
        Robot by odometry at the time of the hypothesis.
    spin : ((n, 3) ndarray, (n, N) ndarray)
        Poses by odometry, and fields.
    lever_arm_m : (N, 2) ndarray
        Sensors in the robot's frame.
    """
    (code, (x, y, heading)), (spin_pose, field) = hypothesis, spin
    pose = relative(spin_pose, odometry)
    cos, sin = math.cos(heading), math.sin(heading)
    pose[:, :2] = pose[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
    pose[:, 2] += heading
    expected = landmark_field(geometry, code, sensor_positions(pose, lever_arm_m))
    return math.sqrt(np.nanmean((field - expected) ** 2) / np.nanmean(field**2))


def _find_visits(
    samples: HallSamples, odometry: Trajectory, geometry: Geometry, pitch_m: float
) -> list[_VisitSearch]:
    recording = preprocessing.preprocess(samples, odometry)
    radii_m = bar_radii(geometry)
    found = preprocessing.segment_visits(recording, geometry, OdometryDrift(), pitch_m)
    return [_VisitSearch(recording, visit.first, visit.stop, geometry, radii_m) for visit in found]


class _VisitSearch:
    """Search within one visit; indices are those of the visit's own samples."""

    def __init__(
        self,
        recording: preprocessing.HallRecording,
        first: int,
        stop: int,
        geometry: Geometry,
        radii_m: tuple[float, float],
    ) -> None:
        self.samples, self.first, self.stop = recording.samples, first, stop
        self.geometry, self.radii_m = geometry, radii_m
        self.pose = recording.pose[first:stop]
        self.field = recording.samples.field_t[first:stop] - recording.offset_t
        self.lever_arm = recording.samples.sensors.position_m
        self.spins = find_spins(self.pose)
        self.warnings: list[SolverWarning] = []

    def warn(self, code: str, message: str) -> None:
        """Add a warning on this visit."""
        self.warnings.append(SolverWarning(code, message))

    def first_step(self) -> FirstStep:
        """Run the first step on the first pass."""
        stop = self._end_of_pass()
        position = sensor_positions(self.pose[:stop], self.lever_arm)
        entries, centre, voted = run_first_step(
            position, self.field[:stop], self.geometry.threshold_t, self.radii_m
        )
        grazed = entries.longest_chord_m < GRAZING_CHORD_M
        return FirstStep(self.first, self.first + stop, entries, centre, voted, grazed)

    def detect(self) -> VisitHypotheses:
        """Run all steps."""
        step = self.first_step()
        if np.isfinite(step.centre_m).all():
            x, y = step.centre_m * 1e3
            grazed = ", by a grazing pass" if step.grazed else ""
            message = f"first step: centre at {x:.1f}, {y:.1f} mm of the odometry{grazed}"
            self.warn("first_step", message)
        refused = "no_spin"
        for start, stop in reversed(self.spins):
            reading = self._second_step(start, stop)
            if reading is None:
                refused = "no_pattern"
                continue
            index, code, pose = self._compensate(reading, start, stop)
            spin = self.pose[start:stop], self.field[start:stop]
            unexplained = unexplained_fraction(
                self.geometry, (code, pose), self.pose[index], spin, self.lever_arm
            )
            if unexplained > MAX_UNEXPLAINED_FRACTION:
                refused = "unexplained"
                message = (
                    f"{name(code)} leaves {100 * unexplained:.0f} % of the spin's field unexplained"
                )
                self.warn("spin_unexplained", message)
                continue
            return self._visit_hypotheses(index, (_hypothesis(code, pose),), "")
        nearest = len(self.pose) // 2
        if np.isfinite(step.centre_m).all():
            nearest = int(np.hypot(*(self.pose[:, :2] - step.centre_m).T).argmin())
        return self._visit_hypotheses(nearest, (), refused)

    def _end_of_pass(self) -> int:
        """Return the end of the first pass: a spin, or the end of the territory."""
        end = self.spins[0][0] if self.spins else len(self.pose)
        inside = np.flatnonzero((np.abs(self.field) >= self.geometry.threshold_t).any(axis=1))
        step = np.diff(self.pose[:, :2], axis=0, prepend=self.pose[:1, :2])
        path = np.cumsum(np.hypot(*step.T))
        if not len(inside):
            return end
        gap = np.flatnonzero(np.diff(path[inside]) > PASS_END_M)
        last = inside[gap[0]] if len(gap) else inside[-1]
        # The samples after the territory count for the silent sensors.
        return min(end, int(np.searchsorted(path, path[last] + PASS_END_M, "right")))

    def _second_step(self, start: int, stop: int) -> SpinReading | None:
        spin = slice(start, stop)
        valleys, centre = spin_valleys(
            self.pose[spin], self.field[spin], self.lever_arm, self.geometry
        )
        if valleys is None:
            self.warn("spin_incomplete", "a part of the circle was not measured during a spin")
            return None
        reading = recognise_spin(valleys, centre, self.lever_arm)
        if reading is None:
            count = len(valleys.angle_rad)
            message = f"a spin with {count} valleys fits no landmark near its centre"
            self.warn("spin_without_pattern", message)
        return reading

    def _compensate(self, reading: SpinReading, start: int, stop: int) -> tuple[int, int, Array]:
        """Return a sample, the code, and the robot's pose (3,) in the landmark's frame then.

        The four voltages correct the pose if the robot came near the centre and along the bars.
        """
        index = self._nearest_to_bars(reading, start)
        if index is None:
            self.warn(
                "never_over_bars",
                "the sensors were never above the bars; the pose is that of the valleys alone",
            )
            return stop - 1, *pose_by_valleys(reading, self.pose[stop - 1])
        standstill = self._standstill(index)
        code, _ = reading.in_frame_of(self.pose[index, 2])
        valid = np.isfinite(self.field[standstill]).any(axis=0)
        field = np.nanmean(self.field[standstill][:, valid], axis=0)
        try:
            pose = compensate_pose(self.geometry, code, self.lever_arm[valid], field)
        except DegenerateError as error:
            self.warn("voltages_undetermined", f"{error}; the pose is that of the valleys alone")
            return index, *pose_by_valleys(reading, self.pose[index])
        if contradicts_valleys(pose):
            message = "the voltages contradict the valleys; the pose is that of the valleys alone"
            self.warn("voltages_contradict_valleys", message)
            return index, *pose_by_valleys(reading, self.pose[index])
        return index, code, pose

    def _nearest_to_bars(self, reading: SpinReading, start: int) -> int | None:
        """Return the sample whose sensors are closest to the middles of the bars, if any."""
        offset = self.pose[start:, :2] - reading.centre_m
        # Bars are 90 degrees apart: the frame that is chosen does not matter.
        fourfold = 4 * (self.pose[start:, 2] - reading.in_frame_of(0.0)[1])
        rotation = np.arctan2(np.sin(fourfold), np.cos(fourfold)) / 4
        distance = np.hypot(*offset.T)
        usable = (distance <= MAX_BAR_OFFSET_M) & (np.abs(rotation) <= MAX_BAR_ROTATION_RAD)
        usable &= np.isfinite(self.field[start:]).sum(axis=1) >= 3
        if not usable.any():
            return None
        cost = np.where(usable, distance + self.geometry.circle_m * np.abs(rotation), np.inf)
        return start + int(cost.argmin())

    def _standstill(self, index: int) -> slice:
        """Return the samples around one during which the robot did not move."""
        change = np.abs(self.pose - self.pose[index])
        moved = np.flatnonzero(
            (change[:, :2] > STANDSTILL_M).any(axis=1) | (change[:, 2] > STANDSTILL_RAD)
        )
        before, after = moved[moved < index], moved[moved > index]
        first = int(before[-1]) + 1 if len(before) else 0
        return slice(first, int(after[0]) if len(after) else len(self.pose))

    def _visit_hypotheses(
        self, index: int, hypotheses: tuple[Hypothesis, ...], refused: str
    ) -> VisitHypotheses:
        return VisitHypotheses(
            device=self.samples.device,
            time_ns=int(self.samples.time_ns[self.first + index]),
            first=self.first,
            stop=self.stop,
            odometry=self.pose[index].copy(),
            hypotheses=hypotheses,
            refused=refused,
            warnings=tuple(self.warnings),
        )


def _hypothesis(code: int, pose: Array) -> Hypothesis:
    unknown = np.full(4, np.nan)
    return Hypothesis(code, 1.0, pose, np.full((3, 3), np.nan), unknown, unknown)
