"""Driver that follows the paper's motion strategy by the paper's own estimates (Fig. 12).

1. The robot drives straight until its sensors cross the territory of a landmark, and estimates the
   centre by the first step (section 3.2).
2. It drives there and spins. The second step (section 3.3) reads pattern and centre. If the centre
   is not close to that of the spin, or the reading is not trusted, the robot moves to the centre
   that it read and spins again, up to four times.
3. It drives to the centre, aligns with the bars (section 3.4), and corrects its pose by the four
   voltages (section 4.1).
4. It takes a landing curve to the next landmark of the map's window (section 4.1), and goes on
   with 2.

Inputs are the samples of the hall sensors, the odometry, and the geometry of bars, pitch and
window; the codes of the map are not used. The paper leaves open what the robot does in two cases.
If a spin gives no centre at all, the robot here drives on, turns around, and repeats the first
step on the same landmark. If an approach fails, it searches the next landmark: straight ahead, or
back from where it came if there was none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.detection.trace import compose, sensor_positions
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import preprocess
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
from locatk.core.landmarks.published.second_step import MAX_OFFSET_FRACTION, SpinReading
from locatk.core.landmarks.simulation.closed_loop import ApproachReport, Motion
from locatk.core.landmarks.simulation.instruments import Measurements
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.strategy import MAX_BACKING_M, SPIN_RAD, TOURS

Array = NDArray[np.float64]

Result = TypeVar("Result")
Motions = Generator[Motion, None, Result]

QUARTER_TURN_RAD = math.pi / 2

SEARCH_STEP_M = 0.010
"""Path between two readouts of the sensors while the robot searches: half of
:data:`PASS_END_M`."""

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

MIN_DRIVE_M = 0.0005
"""Distance below which the robot does not rotate to drive there: half of the paper's accuracy."""

MAX_APPROACHES = 4
"""Searches after which the robot gives up."""

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


class _LandmarkLostError(Exception):
    """No landmark was found near the expected position."""


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
    max_unexplained_fraction : float
        Largest rms residual of a trusted spin, in units of its rms field; ``inf`` for the paper's
        text, which has no such check.
    max_approaches : int
        Searches after which the robot gives up.
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
        max_unexplained_fraction: float = MAX_UNEXPLAINED_FRACTION,
        max_approaches: int = MAX_APPROACHES,
    ) -> None:
        self.geometry, self.pitch_m = geometry, pitch_m
        self.rotations, self.landmarks, self.stop_s = rotations, landmarks, stop_s
        self.max_unexplained_fraction = max_unexplained_fraction
        self.max_approaches = max_approaches
        self.reports: list[ApproachReport] = []

    def motions(self, measure: Callable[[], Measurements]) -> Motions[None]:
        """Yield the motions of the whole strategy (:class:`~.closed_loop.Driver`)."""
        self._measure, self._radii_m = measure, bar_radii(self.geometry)
        yield from self._move()
        direction = 0.0
        for _ in range(self.max_approaches):
            yield from self._leave_territory()
            centre = yield from self._search()
            if centre is None:
                return
            for number in range(self.landmarks):
                frame = yield from self._approach(centre, searched=number == 0)
                if frame is None:
                    break
                if number == self.landmarks - 1:
                    return
                # The robot aligned with any of the four bars; it came along one of them.
                heading = frame[2] if number == 0 else direction
                aligned = round((heading - frame[2]) / QUARTER_TURN_RAD)
                rotation = aligned + self.rotations[number % len(self.rotations)]
                direction = frame[2] + rotation * QUARTER_TURN_RAD
                centre = yield from self._drive_to_neighbour(frame[:2], direction)

    def _approach(self, centre_m: Array, *, searched: bool) -> Motions[Array | None]:
        """Find the centre of a landmark near an estimate and align with its bars.

        Returns the landmark's frame (3,) in that of the odometry; None if the approach failed.
        """
        self._spins = 0
        reading = None
        lost = False
        try:
            reading = yield from self._second_step(centre_m)
        except _LandmarkLostError:
            lost = True
        if reading is None:
            self._report(searched, lost=lost)
            if lost:
                yield from self._move((0.0, math.pi))
            return None
        code, pose = yield from self._third_step(reading)
        self._report(searched, code, pose)
        return _frame_of_landmark(self._now.pose[-1], pose)

    def _report(
        self,
        searched: bool,
        code: int | None = None,
        pose: Array | None = None,
        *,
        lost: bool = False,
    ) -> None:
        time_ns = int(self._now.time_ns[-1])
        self.reports.append(ApproachReport(time_ns, searched, self._spins, code, pose, lost))

    # ---- first step

    def _search(self) -> Motions[Array | None]:
        """Drive straight over the next landmark and estimate its centre (2,) by the first step.

        The centre is ``nan`` if the entries give none; None if no landmark was met within
        :data:`MAX_SEARCH_M`.
        """
        first = len(self._now.pose) - 1
        start_m = self._now.path_m[first]
        while not self._now.inside[first:].any():
            if self._now.path_m[-1] - start_m > MAX_SEARCH_M:
                return None
            yield from self._move((SEARCH_STEP_M, 0.0))
        yield from self._leave_territory()
        position = sensor_positions(self._now.pose[first:], self._now.lever_arm_m)
        _, centre, _ = run_first_step(
            position, self._now.field_t[first:], self.geometry.threshold_t, self._radii_m
        )
        return centre

    def _leave_territory(self) -> Motions[None]:
        """Drive straight until no sensor was in a territory for :data:`PASS_END_M`."""
        start_m = self._now.path_m[-1]
        while self._now.path_since_field_m() <= PASS_END_M:
            if self._now.path_m[-1] - start_m > MAX_PASS_M:
                return
            yield from self._move((SEARCH_STEP_M, 0.0))

    # ---- second step

    def _second_step(self, centre_m: Array) -> Motions[SpinReading | None]:
        """Spin until the landmark is recognised close to the centre of the spin.

        Returns the last trusted reading; None if there was none.

        Raises
        ------
        _LandmarkLostError
            There is no field around the expected centre, or the first step gave no centre.
        """
        reading = None
        for _ in range(MAX_SPINS):
            if not np.isfinite(centre_m).all():
                raise _LandmarkLostError
            yield from self._drive_to(centre_m)
            first = len(self._now.pose)
            yield from self._move((0.0, SPIN_RAD))
            self._spins += 1
            if not self._now.inside[first:].any():
                raise _LandmarkLostError
            spin = slice(first, None)
            valleys, spin_centre = spin_valleys(
                self._now.pose[spin], self._now.field_t[spin], self._now.lever_arm_m, self.geometry
            )
            attempt = None
            if valleys is not None:
                attempt = recognise_spin(valleys, spin_centre, self._now.lever_arm_m, 1.0)
            if attempt is None:
                if self._spins < MAX_SPINS:
                    centre_m = yield from self._repeat_first_step()
                continue
            centre_m = attempt.centre_m
            offset_m = np.hypot(*(centre_m - spin_centre))
            if self._is_trusted(attempt, offset_m, spin):
                reading = attempt
                if offset_m <= MAX_SPIN_OFFSET_M:
                    break
        return reading

    def _repeat_first_step(self) -> Motions[Array]:
        """Leave the landmark straight ahead, turn around, and pass over it again."""
        yield from self._leave_territory()
        yield from self._move((0.0, math.pi))
        centre = yield from self._search()
        if centre is None:
            raise _LandmarkLostError
        return centre

    def _is_trusted(self, reading: SpinReading, offset_m: float, spin: slice) -> bool:
        """Return whether a reading passes the checks of ``--method paper``.

        Both are not in the paper: the centre is not too far from that of the spin, and the bars
        explain the field of the spin.
        """
        lever_arm = self._now.lever_arm_m
        radius = float(np.mean(np.hypot(*lever_arm.T)))
        if offset_m > MAX_OFFSET_FRACTION * radius:
            return False
        pose, field = self._now.pose[spin], self._now.field_t[spin]
        hypothesis = pose_by_valleys(reading, pose[-1])
        unexplained = unexplained_fraction(
            self.geometry, hypothesis, pose[-1], (pose, field), lever_arm
        )
        return unexplained <= self.max_unexplained_fraction

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
        if distance < MIN_DRIVE_M:
            return
        rotation = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        if abs(rotation) > QUARTER_TURN_RAD and distance <= MAX_BACKING_M:
            rotation, distance = math.remainder(rotation + math.pi, math.tau), -distance
        yield from self._move((0.0, rotation), (distance, 0.0))

    def _drive_to_neighbour(self, centre_m: Array, direction_rad: float) -> Motions[Array]:
        """Rotate to a direction and take the landing curve to the next landmark.

        ``centre_m`` (2,) is that of the present landmark. Returns the expected centre (2,) of the
        next one.
        """
        goal = compose(np.array([*centre_m, direction_rad]), np.array([self.pitch_m, 0.0, 0.0]))
        heading = self._now.pose[-1, 2]
        yield from self._move((0.0, math.remainder(direction_rad - heading, math.tau)))
        curve = landing_curve(self._now.pose[-1], goal)
        yield from self._move(*curve.arcs())
        return goal[:2]

    def _move(self, *arcs: tuple[float, float], wait_s: float = SETTLE_S) -> Motions[None]:
        """Order one motion, and take the measurements up to its end."""
        yield Motion(arcs, wait_s)
        self._now = self._record()

    def _record(self) -> _Recording:
        measurements = self._measure()
        recording = preprocess(measurements.samples, measurements.odometry)
        pose = recording.pose
        field = recording.samples.field_t - recording.offset_t
        step = np.diff(pose[:, :2], axis=0, prepend=pose[:1, :2])
        return _Recording(
            recording.samples.time_ns,
            pose,
            field,
            recording.samples.sensors.position_m,
            np.any(np.abs(field) >= self.geometry.threshold_t, axis=1),
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
