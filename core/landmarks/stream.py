"""Causal localization of robots on landmarks: fixes and detections while they drive.

Each visit is fitted as soon as the robot leaves the landmark (:mod:`.visit_stream`), with the
functions of the offline solver, and its cell is identified by the forward pass of the same Bayes
filter (:mod:`.localization.causal_cells`). A robot that returns to the landmark it has just left
revises that visit.

What the offline solver takes from the whole recording is found from the past: offsets, noise and
range of the sensors by running statistics, the lag of the odometry by the visits so far. The random
walk of the odometry is that of the options; it is estimated by smoothing only, and has little
influence on single visits.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import (
    SAME_LANDMARK_PITCH_FRACTION,
    DetectedVisit,
    VisitHypotheses,
    check_gains,
    check_wiring,
    detect_landmark,
    find_faulty_sensor,
    is_doubtful,
)
from locatk.core.landmarks.detection.trace import (
    OdometryDrift,
    compose,
    known_drift,
    planar_rotation,
)
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import HALF_PI_RAD, Geometry
from locatk.core.landmarks.localization.causal_cells import CausalCells, CausalEstimate
from locatk.core.landmarks.localization.cell_filter import (
    ForwardPass,
    IdentifiedVisit,
    select_visits_on_map,
)
from locatk.core.landmarks.localization.consistency import (
    MAP_CONTRADICTED_WARNING,
    NO_MAP_WARNING,
    describe_visit,
    is_map_contradicted,
    warn_of_lag,
    warn_of_opposite_polarity,
)
from locatk.core.landmarks.localization.smoothing import (
    constant_error_information,
    landmark_priors,
)
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.preprocessing import DEFAULT_PITCH_M, HallRecording, VisitSegment
from locatk.core.landmarks.solver import (
    MAX_LAG_ROUNDS,
    MIN_REPORTED_LAG_S,
    SolveOptions,
    common_lag,
)
from locatk.core.landmarks.visit_stream import CompletedVisit, VisitStream
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    BackgroundTask,
    DetectionEvent,
    Fix,
    StateChange,
    Stream,
    StreamEvent,
    TrackingState,
    WarningEvent,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

RECENT_VISITS = 32
"""Visits by which map, sensors and lag of the odometry are judged."""

SENSORS_TASK, POLARITY_TASK = "sensors", "polarity"
"""Names of the tasks in the background."""

MIN_JUDGED_VISITS = 6
"""Visits from which on a map can be contradicted: a single landmark that differs from the map makes
another floor as probable as 19 to 1 if it is among the first ones. Until then the probability of
the fixes says it."""

FIRST_CHECK_VISITS = 4
"""Visits after which the sensors are checked for the first time, and again after twice as many."""

LEFT_OUT_WARNINGS = {
    "spikes": ("spikes", "single readings jump; left out"),
    "saturated": ("saturated", "readings are saturated"),
    "odometry_invalid": (
        "odometry_invalid",
        "poses of the odometry are not finite numbers, or not later than the pose before; left out",
    ),
}
"""Codes and messages of the warnings of what was left out, by :attr:`.VisitStream.notes`."""


@dataclass(frozen=True)
class SensorCheck:
    """Result of checking the sensors of a robot.

    Attributes
    ----------
    scale : float
        Readings relative to those expected.
    faulty_sensor : int or None
        Sensor that agrees with no landmark.
    """

    scale: float
    faulty_sensor: int | None


def check_sensors(
    visits: Sequence[DetectedVisit],
    recording: HallRecording,
    geometry: Geometry,
    priors: ModelPriors,
) -> SensorCheck:
    """Check order, signs, scale and function of the sensors; long if they are doubtful.

    Raises
    ------
    InputError
        The sensors are in the wrong order, or one has the opposite sign.
    """
    scale = check_wiring(visits, recording, geometry, priors)
    if scale != 1:
        return SensorCheck(scale, None)
    return SensorCheck(scale, find_faulty_sensor(visits, recording, geometry, priors))


def check_polarity(
    device: str,
    visits: Sequence[IdentifiedVisit],
    floor: FloorMap,
    misread: float,
    drift: OdometryDrift,
) -> list[SolverWarning]:
    """Return a warning if a robot would be localized with all fields of the opposite sign."""
    return warn_of_opposite_polarity(device, visits, floor, misread=misread, drift=drift)


class LandmarksStream(Stream):
    """Causal solver of landmarks, for any number of robots (:class:`.events.Stream`).

    Parameters
    ----------
    floor : FloorMap or None
        Without a map landmarks are detected, but there are no fixes.
    options : SolveOptions, optional
        Of the method ``"field"``.

    Raises
    ------
    InputError
        The method is another one.
    """

    system = "landmarks"

    def __init__(self, floor: FloorMap | None, options: SolveOptions | None = None) -> None:
        self.floor, self.options = floor, options or SolveOptions()
        if self.options.method != "field":
            raise InputError(
                f"method {self.options.method!r} needs a whole recording",
                hint="Use method 'field'",
            )
        self._robots: dict[str, RobotStream] = {}

    def push(self, observations: Any) -> Sequence[StreamEvent]:
        """Return the results that samples or odometry make known; other kinds are not used."""
        if not isinstance(observations, HallSamples | Trajectory) or not len(observations):
            return []
        device = observations.device
        if device not in self._robots:
            self._robots[device] = RobotStream(device, self.floor, self.options)
        return self._robots[device].push(observations)

    def advance(self, time_ns: int) -> Sequence[StreamEvent]:
        """Return the results of observations up to a time, of which none is missing."""
        return [event for robot in self._in_order() for event in robot.release(time_ns)]

    def finish(self) -> Sequence[StreamEvent]:
        """Return the results of all observations that were held back."""
        return [event for robot in self._in_order() for event in robot.release(is_finished=True)]

    def background_task(self) -> BackgroundTask | None:
        """Return the next check of sensors; None if there is none."""
        tasks = (robot.background_task() for robot in self._in_order())
        return next((task for task in tasks if task is not None), None)

    def complete(self, task: BackgroundTask, result: Any) -> Sequence[StreamEvent]:
        """Take the result of a check of sensors."""
        device = task.name.partition(" of ")[2]
        return self._robots[device].complete(task, result)

    def _in_order(self) -> list[RobotStream]:
        """Return the robots by name: the order of their first observations is of no meaning."""
        return [self._robots[device] for device in sorted(self._robots)]


@dataclass(frozen=True)
class StreamedVisit:
    """Visit that was detected, and the state of the filter before it.

    Attributes
    ----------
    segment : VisitSegment
    hypotheses : VisitHypotheses
    before : ForwardPass or None
        None without a map.
    is_merged : bool
        True if it contains the visit before, which was to the same landmark.
    """

    segment: VisitSegment
    hypotheses: VisitHypotheses
    before: ForwardPass | None
    is_merged: bool = False


class RobotStream:
    """Causal solver of one robot."""

    def __init__(self, device: str, floor: FloorMap | None, options: SolveOptions) -> None:
        self.device, self.floor, self.options = device, floor, options
        self.geometry = floor.geometry if floor is not None else Geometry()
        self.pitch_m = floor.pitch_m if floor is not None else DEFAULT_PITCH_M
        drift = known_drift(options.priors.drift, options.odometry_noise, options.odometry_lag_s)
        self.priors = replace(options.priors, drift=drift, pitch_m=self.pitch_m)
        self.visits = VisitStream(device, self.geometry, self.pitch_m, drift)
        self.visits.lag_ns = round(1e9 * (options.odometry_lag_s or 0.0))
        self.lag_rounds = 0
        self.last_event_ns: int | None = None
        self.last_cell: Cell | None = None
        self.warned: set[str] = set()
        self.tasks: deque[BackgroundTask] = deque()
        self._start()

    def _start(self) -> None:
        """Begin without any visit."""
        self.cells = None
        if self.floor is not None:
            self.cells = CausalCells(
                self.floor, misread=self.options.misread, drift=self.priors.drift
            )
        self.previous: StreamedVisit | None = None
        self.current: StreamedVisit | None = None
        self.recent: deque[IdentifiedVisit] = deque(maxlen=RECENT_VISITS)
        self.lag_information: deque[tuple[Array, Array]] = deque(maxlen=RECENT_VISITS)
        self.visit_count, self.next_check = 0, FIRST_CHECK_VISITS
        self.is_contradicted = False

    # ---- observations

    def push(self, observations: HallSamples | Trajectory) -> list[StreamEvent]:
        """Return the results that the next observations make known."""
        if isinstance(observations, HallSamples):
            self.visits.push_samples(observations)
        else:
            self.visits.push_odometry(observations)
        return self.release()

    def release(
        self, time_ns: int | None = None, *, is_finished: bool = False
    ) -> list[StreamEvent]:
        """Return the results of all observations that need not be held back."""
        events: list[StreamEvent] = []
        for visit in self.visits.visits(time_ns, is_finished=is_finished):
            events += self._take(visit)
        for name, (code, message) in LEFT_OUT_WARNINGS.items():
            if self.visits.notes[name]:
                events += self._warn(SolverWarning(code, message))
        return events

    def _take(self, left: CompletedVisit) -> list[StreamEvent]:
        """Return the results of a visit that the robot has left."""
        if not left.is_revised:
            self.previous, self.current = self.current, None
        earlier = self.current
        visit = self._detect(left)
        if earlier is not None and visit.hypotheses.refused and not earlier.hypotheses.refused:
            # The return to the landmark is of no use; what was found before it is.
            return [self._detection(visit.hypotheses, None)]
        if visit.is_merged and earlier is None:
            earlier = self.previous
        self.current, estimate = visit, None
        if self.cells is not None and visit.before is not None:
            self.cells.take_back(visit.before)
            if not visit.hypotheses.refused:
                estimate = self.cells.add(visit.hypotheses)
        cell = None if estimate is None else estimate.cell
        identified = IdentifiedVisit(visit.segment, visit.hypotheses, cell)
        if earlier is None:
            self.visit_count += 1
        else:
            self.recent.pop()
            self.lag_information.pop()
        self.recent.append(identified)
        events = self._judge_map()
        if self.last_event_ns is None or visit.hypotheses.time_ns > self.last_event_ns:
            self.last_event_ns = visit.hypotheses.time_ns
            if self.is_contradicted:
                estimate = None
            events.append(self._detection(visit.hypotheses, estimate))
            if estimate is not None:
                events += self._fix(identified, estimate.map_probability)
        events += self._estimate_lag(visit)
        events += self._judge_sensors(left.recording)
        return events

    def _detect(self, left: CompletedVisit) -> StreamedVisit:
        """Detect the landmark of a visit, merged with the previous one if it is the same."""
        current = self.current
        if current is not None and current.is_merged:
            centre = current.hypotheses.landmark_position()
            left = self.visits.merged(current.segment, left.segment, centre) or left
        hypotheses = self._detect_landmark(left)
        if current is not None:
            return replace(current, segment=left.segment, hypotheses=hypotheses)
        before = None if self.cells is None else self.cells.state
        visit = StreamedVisit(left.segment, hypotheses, before)
        previous = self.previous
        if previous is None or previous.hypotheses.refused or hypotheses.refused:
            return visit
        centre = hypotheses.landmark_position()
        distance_m = np.hypot(*(centre - previous.hypotheses.landmark_position()))
        if distance_m >= SAME_LANDMARK_PITCH_FRACTION * self.pitch_m:
            return visit
        merged = self.visits.merged(previous.segment, left.segment, centre)
        hypotheses = visit.hypotheses if merged is None else self._detect_landmark(merged)
        if merged is None or hypotheses.refused:
            return visit
        return StreamedVisit(merged.segment, hypotheses, previous.before, is_merged=True)

    def _detect_landmark(self, left: CompletedVisit) -> VisitHypotheses:
        """Return the hypotheses of a visit."""
        priors = replace(self.priors, noise_t=left.recording.noise_t)
        return detect_landmark(left.segment, left.recording, self.geometry, priors)

    # ---- events

    def _detection(self, visit: VisitHypotheses, estimate: CausalEstimate | None) -> DetectionEvent:
        """Return the event of one visit."""
        cell, map_probability = (
            (None, None) if estimate is None else (estimate.cell, estimate.map_probability)
        )
        detection = describe_visit(visit, cell, self.floor, map_probability)
        return DetectionEvent(self.device, visit.time_ns, detection)

    def _fix(self, visit: IdentifiedVisit, map_probability: float) -> list[Fix]:
        """Return the pose of the robot during a visit, if its cell is known."""
        assert self.floor is not None
        if not select_visits_on_map([visit], self.floor):
            self.last_cell = None
            return []
        assert visit.estimate is not None  # select_visits_on_map() checks it
        prior = landmark_priors([visit], self.floor, self.priors)[visit.cell]
        landmark = prior.pose + [0.0, 0.0, visit.quarters * HALF_PI_RAD]
        pose = compose(landmark, visit.hypothesis.pose)
        rotation = planar_rotation(landmark[2])
        by_landmark = np.eye(3)
        by_landmark[:2, 2] = landmark[1] - pose[1], pose[0] - landmark[0]
        of_landmark = by_landmark @ np.diag(prior.sigma**2) @ by_landmark.T
        covariance = rotation @ visit.hypothesis.covariance @ rotation.T + of_landmark
        # The error of a landmark is that of all fixes at it.
        is_same = visit.cell == self.last_cell
        self.last_cell = visit.cell
        return [
            Fix(
                device=self.device,
                frame="map",
                time_ns=visit.hypotheses.time_ns,
                position=np.array([pose[0], pose[1], 0.0]),
                quaternion=quaternion_from_heading(pose[2]),
                covariance=_with_unobserved(covariance),
                common_covariance=_with_unobserved(of_landmark) if is_same else None,
                probability=visit.estimate.probability * map_probability,
            )
        ]

    def _warn(self, warning: SolverWarning) -> list[StreamEvent]:
        """Return the event of a warning, the first time only."""
        if warning.code in self.warned:
            return []
        self.warned.add(warning.code)
        about = warning.about(self.device)
        return [WarningEvent(self.device, int(self.visits.time_ns), about)]

    # ---- doubts

    def _judge_map(self) -> list[StreamEvent]:
        """Return the events of a map that the recent visits contradict."""
        if self.floor is None:
            return self._warn(NO_MAP_WARNING)
        assert self.cells is not None
        visits = list(self.recent)
        on_map = select_visits_on_map(visits, self.floor)
        was_contradicted = self.is_contradicted
        self.is_contradicted = self.visit_count >= MIN_JUDGED_VISITS and is_map_contradicted(
            visits, on_map, self.cells.map_probability
        )
        if not self.is_contradicted or was_contradicted:
            return []
        if MAP_CONTRADICTED_WARNING.code not in self.warned:
            arguments = (
                self.device,
                visits,
                self.floor,
                self.options.misread,
                self.priors.drift,
            )
            name = f"{POLARITY_TASK} of {self.device}"
            self.tasks.append(BackgroundTask(name, check_polarity, arguments))
        return [
            *self._warn(MAP_CONTRADICTED_WARNING),
            StateChange(
                self.device,
                int(self.visits.time_ns),
                TrackingState.LOST,
                "too many landmarks differ from the map",
            ),
        ]

    def _estimate_lag(self, visit: StreamedVisit) -> list[StreamEvent]:
        """Estimate the lag of the odometry from the recent visits, and remove it."""
        fit = visit.hypotheses.best.fit if not visit.hypotheses.refused else None
        fits = [] if fit is None else [(fit, visit.segment.trace)]
        self.lag_information.append(constant_error_information(fits))
        if self.options.odometry_lag_s is not None or self.lag_rounds == MAX_LAG_ROUNDS:
            return []
        information, vector = (
            np.concatenate(each) for each in zip(*self.lag_information, strict=True)
        )
        lag_s = common_lag(information, vector, self.priors.drift)
        if not lag_s:
            return []
        self.lag_rounds += 1
        self.lag_information.clear()
        self.lag_information.append(constant_error_information([]))
        self.visits.lag_ns += round(1e9 * lag_s)
        total_s = 1e-9 * self.visits.lag_ns
        return self._warn(warn_of_lag(total_s)) if abs(total_s) > MIN_REPORTED_LAG_S else []

    def _judge_sensors(self, recording: HallRecording) -> list[StreamEvent]:
        """Return warnings of the sensors, and request checks of doubtful ones."""
        events: list[StreamEvent] = []
        names, statistics = recording.samples.sensors.names, self.visits.statistics
        assert statistics is not None
        for code, flags, message in (
            ("sensor_silent", statistics.is_silent, "the {} sensor reported nothing"),
            ("sensor_constant", statistics.is_constant, "the {} sensor never changed; left out"),
        ):
            for k in np.flatnonzero(flags):
                events += self._warn(SolverWarning(code, message.format(names[k])))
        if self.visit_count < self.next_check:
            return events
        self.next_check = 2 * self.visit_count
        detected = [DetectedVisit(one.segment, one.hypotheses) for one in self.recent]
        fits = [
            one.hypotheses.best.fit
            for one in self.recent
            if one.hypotheses.hypotheses and one.hypotheses.best.fit is not None
        ]
        try:
            for warning in check_gains(fits, recording, self.priors):
                events += self._warn(_without_device(warning))
        except InputError as error:
            events += self._warn(_warning_of(error))
        if any(is_doubtful(one) for one in detected):
            priors = replace(self.priors, noise_t=recording.noise_t)
            arguments = (detected, recording, self.geometry, priors)
            name = f"{SENSORS_TASK} of {self.device}"
            self.tasks.append(BackgroundTask(name, check_sensors, arguments))
        return events

    def background_task(self) -> BackgroundTask | None:
        """Return the next check, once."""
        return self.tasks.popleft() if self.tasks else None

    def complete(self, task: BackgroundTask, result: Any) -> list[StreamEvent]:
        """Take the result of a check."""
        if isinstance(result, InputError):
            return self._warn(_warning_of(result))
        if isinstance(result, SensorCheck):
            return self._change_sensors(result)
        if isinstance(result, BaseException):
            return self._warn(SolverWarning("check_failed", f"{task.name} failed: {result}"))
        return [event for warning in result for event in self._warn(_without_device(warning))]

    def _change_sensors(self, check: SensorCheck) -> list[StreamEvent]:
        """Correct the scale of the readings, or leave out a sensor, from now on."""
        sensors = self.visits.sensors
        none = HallSamples(self.device, sensors, np.empty(0, np.int64), np.empty((0, len(sensors))))
        recording = HallRecording(none, np.empty((0, 3)), np.zeros(len(sensors)), 0.0)
        if check.scale != 1:
            recording = recording.rescaled(check.scale)
            self.visits.correct_scale(check.scale)
        elif check.faulty_sensor is not None:
            recording = recording.without_sensor(check.faulty_sensor)
            self.visits.leave_out(check.faulty_sensor)
        else:
            return []
        self._start()  # The readings of all visits were wrong.
        return [event for each in recording.warnings for event in self._warn(_without_device(each))]


def _with_unobserved(planar: Array) -> Array:
    """Return the covariance (6, 6) of a pose of which x, y and heading are observed."""
    covariance = np.full((6, 6), np.nan)
    observed = np.array([0, 1, 5])
    covariance[np.ix_(observed, observed)] = planar
    return covariance


def _without_device(warning: SolverWarning) -> SolverWarning:
    """Return a warning without the name of the device in front."""
    return replace(warning, message=warning.message.partition(": ")[2])


def _warning_of(error: InputError) -> SolverWarning:
    """Return an error of the sensors as a warning: live localization goes on."""
    return SolverWarning("sensors_wrong", str(error))
