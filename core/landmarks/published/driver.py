"""Driver that follows the paper's motion strategy by the paper's own estimates (Fig. 12).

The robot drives straight until its sensors cross the territory of a landmark, and estimates the
centre by the first step (section 3.2). It drives there and spins until the second step (section
3.3) recognises the landmark and finds its centre close to that of the spin, with up to four spins.
Then it drives to the estimated centre, aligns with the bars (section 3.4), corrects its pose by
the four voltages, and takes a landing curve to the next landmark of the map's window (section
4.1). Inputs are the samples of the hall sensors, the odometry, and the geometry of bars, pitch and
window; the codes of the map are not used.

The paper does not describe what a robot does after an approach has failed. Here it drives on
straight ahead and searches the next landmark.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks import visits
from locatk.core.landmarks.detection.trace import compose, sensor_places
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.published.first_step import bar_radii
from locatk.core.landmarks.published.pose_compensation import (
    compensate_pose,
    landing_curve,
    rotation_to_bars,
)
from locatk.core.landmarks.published.search import (
    MAX_UNEXPLAINED_FRACTION,
    PASS_END_M,
    contradicts_valleys,
    pose_by_valleys,
    recognise_spin,
    run_first_step,
    spin_valleys,
    unexplained_fraction,
)
from locatk.core.landmarks.published.second_step import SpinReading
from locatk.core.landmarks.simulation.closed_loop import ApproachReport, Motion
from locatk.core.landmarks.simulation.instruments import Measurements
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.strategy import MAX_BACKING_M, SPIN_RAD, TOURS

Array = NDArray[np.float64]

Result = TypeVar("Result")
Motions = Generator[Motion, None, Result]

QUARTER_TURN_RAD = math.pi / 2

SEARCH_STEP_M = 0.010
"""Path between two looks at the sensors while the robot searches: half of :data:`PASS_END_M`."""

MAX_SEARCH_M = 1.0
"""Path without a field after which the robot gives up: five times the default pitch."""

MAX_PASS_M = 0.3
"""Longest pass: the diameters of a territory (2 x 54 mm) and of the sensors' circle (50 mm), the
path after it, and a margin. A sensor that is stuck at a field ends the pass here."""

MAX_SPINS = 4
"""Spins at one landmark before the robot gives it up; the paper retries without a number."""

MAX_SPIN_OFFSET_M = 0.005
"""A landmark counts as recognised if its centre is this close to that of the spin: the paper's
margin of the sensors' circle (section 3.5.2). Otherwise the robot moves there and spins again."""

MAX_POSE_ERROR_M = 0.001
"""Distance from the centre below which the robot does not correct its position at the landmark:
the paper's accuracy (section 5.2.3)."""

MAX_FAILED_APPROACHES = 3
"""Failed approaches after which the robot gives up."""

SETTLE_S = 0.05
"""Rest after each motion: two periods of the odometry."""


@dataclass(frozen=True)
class _Recording:
    """Measurements so far, with a pose for each sample."""

    time_ns: NDArray[np.int64]
    pose: Array
    field_t: Array
    lever_arm_m: Array
    inside: NDArray[np.bool_]
    """(n,) True for the samples with any sensor in a territory."""
    path_m: Array
    """(n,) path length of the robot by odometry."""

    def path_since_field_m(self) -> float:
        """Return the path length since a sensor was in a territory; ``inf`` for never."""
        inside = np.flatnonzero(self.inside)
        return float(self.path_m[-1] - self.path_m[inside[-1]]) if len(inside) else math.inf


class PublishedDriver:
    """Driver of a simulated robot by the published algorithm.

    Attributes
    ----------
    geometry : Geometry
    pitch_m : float
        Between neighbouring landmarks.
    rotations : sequence of int
        Quarter turns to the left before each step to a neighbour; repeated if there are more
        landmarks.
    landmarks : int
        Landmarks in a row that are read before the robot stops.
    stop_s : float
        Rest for the four voltages.
    reports : list of ApproachReport
        Approaches so far.
    """

    def __init__(
        self,
        geometry: Geometry,
        pitch_m: float,
        rotations: Sequence[int] = (0, 1),
        landmarks: int = 3,
        stop_s: float = 0.5,
    ) -> None:
        self.geometry, self.pitch_m = geometry, pitch_m
        self.rotations, self.landmarks, self.stop_s = rotations, landmarks, stop_s
        self.reports: list[ApproachReport] = []

    def motions(self, measure: Callable[[], Measurements]) -> Motions[None]:
        """Yield the motions of the whole strategy (:class:`~.closed_loop.Driver`)."""
        self._measure, self._radii_m = measure, bar_radii(self.geometry)
        for _ in range(MAX_FAILED_APPROACHES):
            entered = yield from self._search()
            if entered is None:
                return
            centre = self._first_step(entered)
            for number in range(self.landmarks):
                frame = yield from self._approach(centre, searched=number == 0)
                if frame is None:
                    break
                if number == self.landmarks - 1:
                    return
                rotation = self.rotations[number % len(self.rotations)]
                centre = yield from self._drive_to_neighbour(frame, rotation)

    def _approach(self, centre_m: Array, *, searched: bool) -> Motions[Array | None]:
        """Find the centre of a landmark near an estimate and align with its bars.

        Returns the landmark's frame (3,) in that of the odometry; None if the approach failed.
        """
        if not np.isfinite(centre_m).all():
            self._report(searched, 0, lost=True)
            return None
        reading, spins = yield from self._second_step(centre_m)
        if reading is None:
            self._report(searched, spins, lost=not self._has_field_at_end())
            return None
        code, pose = yield from self._third_step(reading)
        self._report(searched, spins, code, pose)
        return _frame_of_landmark(self._now.pose[-1], pose)

    def _report(
        self,
        searched: bool,
        spins: int,
        code: int | None = None,
        pose: Array | None = None,
        *,
        lost: bool = False,
    ) -> None:
        time_ns = int(self._now.time_ns[-1])
        self.reports.append(ApproachReport(time_ns, searched, spins, code, pose, lost))

    # ---- first step

    def _search(self) -> Motions[slice | None]:
        """Drive straight over the next landmark; return the samples of the pass.

        None if no landmark was met within :data:`MAX_SEARCH_M`.
        """
        yield from self._move()
        recording = self._now
        start_m = recording.path_m[-1]
        # After a failed approach, the robot leaves the territory first.
        while recording.path_since_field_m() <= PASS_END_M:
            if recording.path_m[-1] - start_m > MAX_PASS_M:
                return None
            recording = yield from self._drive_ahead()
        first = len(recording.pose) - 1
        start_m = recording.path_m[first]
        while not recording.inside[first:].any():
            if recording.path_m[-1] - start_m > MAX_SEARCH_M:
                return None
            recording = yield from self._drive_ahead()
        entry_m = recording.path_m[-1]
        while recording.path_since_field_m() <= PASS_END_M:
            if recording.path_m[-1] - entry_m > MAX_PASS_M:
                break
            recording = yield from self._drive_ahead()
        return slice(first, len(recording.pose))

    def _drive_ahead(self) -> Motions[_Recording]:
        yield from self._move((SEARCH_STEP_M, 0.0))
        return self._now

    def _first_step(self, entered: slice) -> Array:
        """Estimate the centre (2,) from one pass; ``nan`` if no candidate is left."""
        recording = self._now
        position = sensor_places(recording.pose[entered], recording.lever_arm_m)
        _, centre, _ = run_first_step(
            position, recording.field_t[entered], self.geometry.threshold_t, self._radii_m
        )
        return centre

    # ---- second step

    def _second_step(self, centre_m: Array) -> Motions[tuple[SpinReading | None, int]]:
        """Spin until the landmark is recognised close to the centre of the spin.

        Returns the last reading, None if no spin could be read, and the number of spins.
        """
        reading = None
        for spins in range(1, MAX_SPINS + 1):
            yield from self._drive_to(centre_m)
            first = len(self._now.pose)
            yield from self._move((0.0, SPIN_RAD))
            recording = self._now
            if not recording.inside[first:].any():
                return None, spins
            spin_reading, spin_centre = self._read_spin(recording, slice(first, None))
            if spin_reading is None:
                continue
            reading, centre_m = spin_reading, spin_reading.centre_m
            if np.hypot(*(centre_m - spin_centre)) <= MAX_SPIN_OFFSET_M:
                break
        return reading, spins

    def _read_spin(self, recording: _Recording, spin: slice) -> tuple[SpinReading | None, Array]:
        """Return the reading of a spin, None if it fits no landmark, and the spin's centre (2,)."""
        pose, field, lever_arm = (
            recording.pose[spin],
            recording.field_t[spin],
            recording.lever_arm_m,
        )
        valleys, centre = spin_valleys(pose, field, lever_arm, self.geometry)
        reading = None if valleys is None else recognise_spin(valleys, centre, lever_arm)
        if reading is None:
            return None, centre
        hypothesis = pose_by_valleys(reading, pose[-1])
        unexplained = unexplained_fraction(
            self.geometry, hypothesis, pose[-1], (pose, field), lever_arm
        )
        return (None if unexplained > MAX_UNEXPLAINED_FRACTION else reading), centre

    def _has_field_at_end(self) -> bool:
        """Return whether the robot was in a territory within the last :data:`PASS_END_M`."""
        return self._now.path_since_field_m() <= PASS_END_M

    # ---- third step and pose compensation

    def _third_step(self, reading: SpinReading) -> Motions[tuple[int, Array]]:
        """Align with the bars at the centre and measure the pose there.

        Returns the code, and the robot's pose (3,) in the landmark's frame. If the four voltages
        show that the robot is not at the centre, its position is corrected once.
        """
        code, pose = yield from self._align_and_measure(reading.centre_m, reading)
        if np.hypot(*pose[:2]) > MAX_POSE_ERROR_M:
            centre = _frame_of_landmark(self._now.pose[-1], pose)[:2]
            code, pose = yield from self._align_and_measure(centre, reading)
        return code, pose

    def _align_and_measure(
        self, centre_m: Array, reading: SpinReading
    ) -> Motions[tuple[int, Array]]:
        yield from self._drive_to(centre_m)
        heading = self._now.pose[-1, 2]
        yield from self._move((0.0, rotation_to_bars(heading, reading.bar_rad)))
        first = len(self._now.pose)
        yield from self._move(wait_s=max(self.stop_s, SETTLE_S))
        recording = self._now
        odometry = recording.pose[-1]
        code, pose = pose_by_valleys(reading, odometry)
        field = recording.field_t[first:]
        valid = np.isfinite(field).any(axis=0)
        try:
            by_voltages = compensate_pose(
                self.geometry,
                code,
                recording.lever_arm_m[valid],
                np.nanmean(field[:, valid], axis=0),
            )
        except DegenerateError:
            return code, pose
        return code, pose if contradicts_valleys(by_voltages) else by_voltages

    # ---- motions

    def _drive_to(self, position_m: Array) -> Motions[None]:
        """Rotate towards a position by odometry and drive there, backwards if it is near."""
        x, y, heading = self._now.pose[-1]
        dx, dy = position_m - [x, y]
        distance = math.hypot(dx, dy)
        rotation = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        if abs(rotation) > QUARTER_TURN_RAD and distance <= MAX_BACKING_M:
            rotation, distance = math.remainder(rotation + math.pi, math.tau), -distance
        yield from self._move((0.0, rotation), (distance, 0.0))

    def _drive_to_neighbour(self, frame: Array, quarter_turns: int) -> Motions[Array]:
        """Rotate by quarter turns and take the landing curve to the next landmark.

        ``frame`` (3,) is that of the present landmark. Returns the expected centre (2,) of the
        next one.
        """
        direction = frame[2] + quarter_turns * QUARTER_TURN_RAD
        goal = compose(np.array([*frame[:2], direction]), np.array([self.pitch_m, 0.0, 0.0]))
        heading = self._now.pose[-1, 2]
        yield from self._move((0.0, math.remainder(direction - heading, math.tau)))
        curve = landing_curve(self._now.pose[-1], goal)
        yield from self._move(*curve.arcs())
        return goal[:2]

    def _move(self, *arcs: tuple[float, float], wait_s: float = SETTLE_S) -> Motions[None]:
        """Order one motion, and take the measurements up to its end."""
        yield Motion(arcs, wait_s)
        self._now = self._record()

    def _record(self) -> _Recording:
        measurements = self._measure()
        recording = visits.driven(measurements.samples, measurements.odometry)
        pose = recording.pose
        field = recording.samples.field_t - recording.offset_t
        step = np.diff(pose[:, :2], axis=0, prepend=pose[:1, :2])
        return _Recording(
            recording.samples.time_ns,
            pose,
            field,
            recording.samples.sensors.position_m,
            (np.abs(field) >= self.geometry.threshold_t).any(axis=1),
            np.cumsum(np.hypot(*step.T)),
        )


def _frame_of_landmark(odometry: Array, pose: Array) -> Array:
    """Return the frame (3,) in which a robot at ``odometry`` (3,) has the pose ``pose`` (3,)."""
    heading = odometry[2] - pose[2]
    cos, sin = math.cos(heading), math.sin(heading)
    x, y = pose[:2]
    return np.array([odometry[0] - cos * x + sin * y, odometry[1] - sin * x - cos * y, heading])


def published_driver(floor: FloorMap, options: SimulationOptions) -> PublishedDriver:
    """Return the driver of the strategy ``published`` for a floor.

    Of the floor, the geometry of the bars, the pitch and the window are used.
    """
    headings = TOURS[floor.window]
    rotations = [(b - a + 1) % 4 - 1 for a, b in zip((0, *headings), headings, strict=False)]
    landmarks = len(headings) + 1 if options.landmarks is None else options.landmarks
    return PublishedDriver(floor.geometry, floor.pitch_m, rotations, landmarks, options.stop_s)
