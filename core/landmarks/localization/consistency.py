"""Consistency of a localized robot with the map: detections as reported, and doubts about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift, compose, relative
from locatk.core.landmarks.landmark import CODE_COUNT, HALF_PI_RAD, pattern, rotated
from locatk.core.landmarks.localization.cell_filter import (
    MIN_CELL_PROBABILITY,
    CellEstimate,
    IdentifiedVisit,
    identify_cells,
)
from locatk.core.landmarks.localization.odometry_path import OdometryPath
from locatk.core.landmarks.localization.robust_smoothing import (
    Cause,
    DisplacedLandmark,
    WheelSlip,
)
from locatk.core.landmarks.localization.smoothing import (
    POSE_SIZE,
    RobotMeasurements,
    SmoothingResult,
)
from locatk.core.landmarks.map.floor import (
    HOLE_CODE,
    Cell,
    FloorMap,
    as_built_code,
    as_built_landmark,
)
from locatk.core.landmarks.preprocessing import HallRecording
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory

MIN_MISREAD_PROBABILITY = 0.99
"""Probability from which on a landmark is reported to differ from the map."""

MIN_OUTLIER_PROBABILITY = 0.5
"""Probability from which on a visit counts as an outlier."""

MIN_DISPLACED_CODE_PROBABILITY = 0.9
"""Probability of a code from which on a visit that was not used is evidence of a landmark."""

MIN_DISPLACEMENT_SIGMAS = 4.0
"""Displacement or rotation of a landmark in standard deviations from which on it is reported."""

MIN_REPORTED_SCALE, MIN_SCALE_SIGMAS = 0.0175, 4.0
"""Relative error of distances by odometry, and its significance, from which on it is reported: few
calibrated robots have it, and a floor whose landmarks have another pitch looks the same."""

MAX_DISPLACEMENT_PITCHES = 0.5
"""Displacement of a landmark, in pitches, beyond which it would be in another cell."""

MAX_POSE_GAP_NS = 100_000_000
"""Time to the nearest pose up to which the trajectory is known."""

MIN_CONTRADICTIONS = 2
MAX_CONTRADICTED_FRACTION = 1 / 3
"""A map is rejected if at least so many landmarks, and more than this fraction of all, are expected
to be misread, or are unexplained."""

MIN_MAP_PROBABILITY = 0.05
"""Probability of being on the floor below which its map is rejected."""

MAP_CONTRADICTED_WARNING = SolverWarning(
    "map_contradicted",
    "not localised; too many of its landmarks differ from the map: is it the map of this floor, "
    "and does the odometry have the right sign?",
)
NO_MAP_WARNING = SolverWarning("no_map", "no map, so that its landmarks have no cells")


def describe_visit(
    visit: VisitHypotheses,
    estimate: CellEstimate | None,
    floor: FloorMap | None,
    map_probability: float | None = None,
    *,
    is_lost: bool = False,
) -> LandmarkDetection:
    """Return the detection that reports one visit.

    Parameters
    ----------
    visit : VisitHypotheses
        Hypotheses of the visit, or the reason for which there is none.
    estimate : CellEstimate or None
        Its cell on the map, if it is known.
    floor : FloorMap or None
        The map; misread landmarks, and cells without one, are recognized by it.
    map_probability : float, optional
        Probability that the robot is on this floor, if it was estimated.
    is_lost : bool
        True if the cell is known, but the robot has no poses during the visit.
    """
    unread = LandmarkDetection(
        time_s=visit.time_ns * 1e-9,
        device=visit.device,
        cell=None,
        pattern=None,
        code=None,
        probability=0.0,
        x_m=None,
        y_m=None,
        heading_rad=None,
        sigma_x_m=None,
        sigma_y_m=None,
        sigma_heading_rad=None,
        strength=None,
        residual_sigma=visit.residual_sigma,
        refused=visit.refused,
        cell_probability=None,
    )
    if not visit.hypotheses:
        return unread
    best, cell, quarters, refused = visit.best, None, 0, visit.refused
    cell_probability = None
    if estimate is not None and estimate.probability >= MIN_CELL_PROBABILITY:
        best = visit.hypotheses[estimate.hypothesis]
        cell, quarters = estimate.cell, estimate.quarters
        if map_probability is not None:
            cell_probability = estimate.probability * map_probability
        if floor is not None:
            code_on_map = as_built_code(floor, estimate.cell)
            if code_on_map == HOLE_CODE:
                cell = cell_probability = None
                refused = "off_map"
            elif estimate.misread_probability >= MIN_MISREAD_PROBABILITY:
                refused = "misread"
            elif code_on_map != rotated(best.code, quarters):
                refused = "uncertain"
    elif floor is not None and not visit.refused:
        is_outlier = estimate is not None and (
            estimate.outlier_probability >= MIN_OUTLIER_PROBABILITY
        )
        refused = "inconsistent" if is_outlier else "not_localised"
    if is_lost:
        refused = refused or "no_pose"
    code = int(rotated(best.code, quarters))
    rotation = quarters * HALF_PI_RAD
    cos, sin = np.cos(rotation), np.sin(rotation)
    x, y, heading = best.pose
    sigma = np.sqrt(np.diag(best.covariance))
    sigma_x, sigma_y = np.abs([[cos, -sin], [sin, cos]]) @ sigma[:2]
    return replace(
        unread,
        cell=cell,
        pattern=pattern(code),
        code=code,
        probability=sum(h.probability for h in visit.hypotheses if h.code == best.code),
        x_m=float(cos * x - sin * y),
        y_m=float(sin * x + cos * y),
        heading_rad=math.remainder(float(heading + rotation), math.tau),
        sigma_x_m=float(sigma_x),
        sigma_y_m=float(sigma_y),
        sigma_heading_rad=float(sigma[2]),
        strength=tuple(float(v) for v in np.roll(best.strength, quarters)),
        refused=refused,
        cell_probability=cell_probability,
    )


def warn_of_cause(cause: Cause, *alternatives: Cause) -> SolverWarning:
    """Return the warning of a wheel slip or of a displaced landmark, or of either.

    Of alternatives no sizes are given: together they were estimated from one inconsistency.
    """
    code = "wheel_slip" if isinstance(cause, WheelSlip) else "landmark_displaced"
    if not alternatives:
        return SolverWarning(code, f"{_describe_cause(cause)} by {_describe_size(cause)}")
    message = ", or ".join(_describe_cause(each) for each in (cause, *alternatives))
    return SolverWarning(code, f"{message}; the recording does not show which")


def warn_of_carrying(robot: RobotMeasurements) -> list[SolverWarning]:
    """Return a warning for each time that a robot was carried."""
    warnings = []
    for (first, second), link in zip(pairwise(robot.visits), robot.links, strict=True):
        if link is None:
            message = (
                f"the robot was carried between {1e-9 * first.segment.time_ns[-1]:.3f} and "
                f"{1e-9 * second.segment.time_ns[0]:.3f} s; there are no poses in between"
            )
            warnings.append(SolverWarning("robot_carried", message))
    return warnings


def find_displaced_landmarks(
    visits: Sequence[IdentifiedVisit], trajectory: Trajectory, floor: FloorMap
) -> list[DisplacedLandmark]:
    """Find landmarks for whose displacement a visit was not used.

    Such a visit read the code of the landmark that is nearest to it by the trajectory, at another
    pose than that on the map.

    Parameters
    ----------
    visits : sequence of IdentifiedVisit
        Those that are not used.
    trajectory : Trajectory
        From the others.
    floor : FloorMap
    """
    path = OdometryPath.of(trajectory)
    displaced: dict[Cell, DisplacedLandmark] = {}
    for visit in visits:
        if visit.hypotheses.refused or not visit.hypotheses.hypotheses:
            continue
        best = visit.hypotheses.best
        time_ns = np.array([visit.hypotheses.time_ns])
        nearest = int(np.abs(trajectory.time_ns - time_ns).argmin())
        gap_ns = abs(int(trajectory.time_ns[nearest] - time_ns[0]))
        if best.probability < MIN_DISPLACED_CODE_PROBABILITY or gap_ns > MAX_POSE_GAP_NS:
            continue
        robot = path.pose_at(time_ns)[0]
        landmark = compose(robot, relative(np.zeros((1, 3)), best.pose)[0])
        quarters = round(landmark[2] / HALF_PI_RAD)
        column, row = np.round((landmark[:2] - floor.origin_m) / floor.pitch_m).astype(int).tolist()
        cell = (row, column)
        is_on_map = 0 <= cell[0] < floor.shape[0] and 0 <= cell[1] < floor.shape[1]
        if not is_on_map or as_built_code(floor, cell) != rotated(best.code, quarters % 4):
            continue
        built, _ = as_built_landmark(floor, cell)
        shift = landmark - built
        rotation = math.remainder(float(shift[2]), HALF_PI_RAD)
        distance = float(np.hypot(*shift[:2]))
        if distance > MAX_DISPLACEMENT_PITCHES * floor.pitch_m:
            continue
        variance = trajectory.sigma[nearest, [0, 1, 5]] ** 2 + np.diag(best.covariance)
        if max(distance**2 / variance[:2].max(), rotation**2 / variance[2]) < (
            MIN_DISPLACEMENT_SIGMAS**2
        ):
            continue
        displaced[cell] = DisplacedLandmark(cell, distance, rotation)
    return list(displaced.values())


def without_contradicted_ends(
    trajectory: Trajectory,
    used: Sequence[IdentifiedVisit],
    contradicting: Sequence[IdentifiedVisit],
) -> tuple[Trajectory, list[SolverWarning]]:
    """Return a trajectory without dead reckoning to visits that contradict it, and warnings.

    Before the first and after the last visit that is used, poses are dead reckoning. If a landmark
    was visited there whose field or cell does not agree with it, a wheel slipped or the robot was
    carried at some moment, and no other visit confirms any of these poses.

    Parameters
    ----------
    trajectory : Trajectory
    used, contradicting : sequence of IdentifiedVisit
        Visits from which the trajectory was estimated, and those that contradict the odometry or
        during which a wheel slipped.
    """
    first_ns = used[0].segment.time_ns[0]
    last_ns = used[-1].segment.time_ns[-1]
    times_ns = [one.segment.time_ns for one in contradicting]
    is_kept = np.ones(len(trajectory), bool)
    removed = []
    if any(time_ns[0] < first_ns for time_ns in times_ns):
        is_kept &= trajectory.time_ns >= first_ns
        removed.append(f"before {1e-9 * first_ns:.3f} s")
    if any(time_ns[-1] > last_ns for time_ns in times_ns):
        is_kept &= trajectory.time_ns <= last_ns
        removed.append(f"after {1e-9 * last_ns:.3f} s")
    reason = "landmarks contradict the odometry: did a wheel slip, or was the robot carried?"
    warnings = [
        SolverWarning("odometry_contradicted", f"no poses {part}, where {reason}")
        for part in removed
    ]
    return trajectory.select(is_kept), warnings


def contradicts_odometry(visit: IdentifiedVisit) -> bool:
    """Return whether a visit that is not on the map contradicts the odometry from others to it."""
    if visit.hypotheses.refused:
        return visit.hypotheses.refused == "not_explained"
    # Others are outside of the map.
    return visit.estimate is not None and visit.estimate.probability < MIN_CELL_PROBABILITY


def _describe_cause(cause: Cause) -> str:
    if isinstance(cause, WheelSlip):
        return (
            f"a wheel slipped between {1e-9 * cause.first_ns:.3f} and {1e-9 * cause.last_ns:.3f} s"
        )
    return f"the landmark at {cause.cell[0]},{cause.cell[1]} is displaced"


def _describe_size(cause: Cause) -> str:
    return f"{1e3 * cause.distance_m:.2g} mm and {math.degrees(abs(cause.rotation_rad)):.2g} deg"


def warn_of_scale(result: SmoothingResult, drift: OdometryDrift) -> list[SolverWarning]:
    """Return a warning if distances by odometry differ much from those of the map."""
    visit = result.visits[0][0]
    # The scale is the first of the constant errors.
    correction = float(visit.corrections[0]) * drift.scale
    sigma = math.sqrt(visit.covariance[POSE_SIZE, POSE_SIZE]) * drift.scale
    if abs(correction) < max(MIN_REPORTED_SCALE, MIN_SCALE_SIGMAS * sigma):
        return []
    message = (
        f"distances by odometry are {1 / (1 + correction):.3f} times those of the map; corrected: "
        "check the wheel diameters, and the pitch of the landmarks on the floor"
    )
    return [SolverWarning("odometry_scale", message)]


def warn_of_lag(lag_s: float, remaining_s: float = 0.0) -> SolverWarning:
    """Return the warning of odometry that is later or earlier than the fields.

    ``remaining_s`` is the lag that is left after the correction.
    """
    direction = "later" if lag_s > 0 else "earlier"
    message = (
        f"the odometry is {1e3 * abs(lag_s):.0f} ms {direction} than the fields; its times were "
        "corrected by that"
    )
    if remaining_s:
        message += f", and about {1e3 * remaining_s:.0f} ms are left: give the lag, if it is known"
    return SolverWarning("odometry_lag", message)


def is_map_contradicted(
    visits: Sequence[IdentifiedVisit], on_map: Sequence[IdentifiedVisit], map_probability: float
) -> bool:
    """Return whether too many landmarks differ from the map.

    Parameters
    ----------
    visits : sequence of IdentifiedVisit
        All visits of a robot.
    on_map : sequence of IdentifiedVisit
        Those whose cell is known.
    map_probability : float
        Probability that the robot is on this floor, by its readings.
    """
    if any(visit.estimate is not None for visit in visits) and (
        map_probability < MIN_MAP_PROBABILITY
    ):
        return True
    misread = sum(
        visit.estimate.misread_probability for visit in on_map if visit.estimate is not None
    )
    unexplained = sum(visit.hypotheses.refused == "not_explained" for visit in visits)
    contradictions = misread + unexplained
    return contradictions >= MIN_CONTRADICTIONS and contradictions > MAX_CONTRADICTED_FRACTION * (
        len(on_map) + unexplained
    )


def warn_of_missing_pose(
    recording: HallRecording, visits: Sequence[IdentifiedVisit]
) -> SolverWarning:
    """Return the warning that explains why a robot is not localized."""
    device = recording.samples.device
    if any(not visit.hypotheses.refused for visit in visits):
        probability = max(
            (visit.estimate.probability for visit in visits if visit.estimate is not None),
            default=0.0,
        )
        message = f"not localised; the most likely cell has a probability of {probability:.2g}"
        return SolverWarning("not_localised", message).about(device)
    if visits:
        message = (
            f"{len(visits)} visits, but no landmark explains any of them; check the geometry of "
            "the landmarks, the sensors and the odometry"
        )
        if all(visit.hypotheses.refused != "not_explained" for visit in visits):
            message = f"{len(visits)} visits, all of them too short or too weak"
        return SolverWarning("visits_unexplained", message).about(device)
    magnitude_t = np.abs(recording.samples.field_t)
    strongest_mt = 1e3 * float(np.max(magnitude_t, initial=0.0, where=np.isfinite(magnitude_t)))
    message = f"no landmark was detected; the strongest field is {strongest_mt:.2g} mT"
    return SolverWarning("no_landmark", message).about(device)


def warn_of_opposite_polarity(
    device: str,
    visits: Sequence[IdentifiedVisit],
    floor: FloorMap,
    *,
    misread: float,
    drift: OdometryDrift,
) -> list[SolverWarning]:
    """Return a warning if the robot would be localized with all fields of the opposite sign."""
    opposite = [
        replace(
            visit.hypotheses,
            hypotheses=tuple(
                replace(one, code=CODE_COUNT - 1 - one.code) for one in visit.hypotheses.hypotheses
            ),
        )
        for visit in visits
        if not visit.hypotheses.refused
    ]
    result = identify_cells(opposite, floor, misread=misread, drift=drift)
    of_cell = max((one.probability for one in result.estimates), default=0.0)
    if of_cell * result.map_probability < PROVISIONAL_PROBABILITY:
        return []
    message = (
        "with N and S exchanged it would be localised; are the sensors or all bars mounted upside "
        "down?"
    )
    return [SolverWarning("polarity_exchanged", message).about(device)]
