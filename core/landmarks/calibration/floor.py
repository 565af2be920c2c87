"""Calibration of a floor: landmarks as built, from recordings of robots that drove over it.

All visits of all recordings, the odometry between them and the landmarks enter one least squares
(:mod:`locatk.core.landmarks.localization.smoothing`), which is solved twice: first with weak priors
of the landmarks, which reveals displaced and faulty ones; then with the tolerances of installation
for all others.

Some quantities are not observable. *Pose of the whole floor*: its motion changes no measurement, so
that most landmarks are assumed to be at their designed positions (:mod:`.datum`), and standard
deviations are those of landmarks relative to one another. The same holds for recordings that have
no landmark in common with the others. *Strength of all bars*: stronger magnets, sensors with more
gain and sensors nearer to the floor have almost the same effect, so that the typical bar is
assumed to have the strength 1. *Displacement of a single bar*: the centre of a landmark is that of
its four bars.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.calibration.datum import connected_components
from locatk.core.landmarks.calibration.landmarks import (
    MIN_FLAG_SIGMAS,
    CalibratedLandmark,
    describe_landmarks,
    tolerance_priors,
    typical_strength,
    weak_priors,
)
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.trace import compose
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import HALF_PI_RAD
from locatk.core.landmarks.localization.cell_filter import IdentifiedVisit, select_visits_on_map
from locatk.core.landmarks.localization.smoothing import (
    SMOOTHED_MODEL_ERROR_T,
    LandmarkPrior,
    SmoothingResult,
    VisitPose,
    measure_visits,
    smooth,
)
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_codes
from locatk.core.landmarks.solver import IdentifiedRecording, SolveOptions, identify_recording
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_VISIT_DEVIATION_M = 4e-3
MAX_VISIT_DEVIATION_RAD = math.radians(4)
MAX_VISIT_DEVIATION_SIGMAS = 5.0
"""A visit is an outlier if its own estimate of the pose deviates from the smoothed one by more than
these limits and standard deviations."""

MAX_OUTLIER_ROUNDS = 5
"""Rounds of smoothing after which outliers are removed, one per recording in each."""

MAX_RESIDUAL_SIGMAS = 2.0
"""Rms residual of all fields above which a note is given."""


@dataclass(frozen=True)
class CalibrationDrive:
    """Recording of one robot for a calibration; ``name`` is for people."""

    name: str
    identified: IdentifiedRecording


@dataclass(frozen=True)
class FloorCalibrationReport:
    """Map with the landmarks as built.

    Attributes
    ----------
    floor : FloorMap
        The given map, with updated ``built`` of the landmarks that were observed well enough.
    landmarks : tuple of CalibratedLandmark
        All visited ones, by cell.
    unvisited : tuple of (row, column)
    strength, strength_sigma : float
        Of the typical bar, as far as gains and heights of the sensors determine it.
    residual_sigma : float
        Rms residual of the fields, in standard deviations.
    left_out : dict of str to str
        Recordings and visits that were not used, with the reason.
    notes : tuple of str
    """

    floor: FloorMap
    landmarks: tuple[CalibratedLandmark, ...]
    unvisited: tuple[Cell, ...]
    strength: float
    strength_sigma: float
    residual_sigma: float
    left_out: dict[str, str]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _UsedDrive:
    """Drive with the visits that are used."""

    drive: CalibrationDrive
    visits: list[IdentifiedVisit]


def read_drive(
    name: str,
    samples: HallSamples,
    odometry: Trajectory | None,
    floor: FloorMap,
    options: SolveOptions | None = None,
) -> CalibrationDrive | str:
    """Localize one recording on the map.

    Returns
    -------
    CalibrationDrive or str
        Or the reason for which the recording cannot be used.

    Raises
    ------
    InputError
        See :func:`locatk.core.landmarks.solver.solve`.
    """
    identified = identify_recording(samples, odometry, floor, options or SolveOptions())
    if not identified.visits:
        return "no landmark was detected"
    if not select_visits_on_map(identified.visits, floor):
        return "not localised on the map"
    return CalibrationDrive(name, identified)


def calibrate(
    floor: FloorMap,
    drives: Sequence[CalibrationDrive],
    left_out: Mapping[str, str] | None = None,
) -> FloorCalibrationReport:
    """Estimate pose and bar strengths of each visited landmark.

    Parameters
    ----------
    floor : FloorMap
        Its landmarks as built are replaced if they were visited; they do not enter as evidence.
    drives : sequence of CalibrationDrive
        From :func:`read_drive`.
    left_out : mapping of str to str
        Recordings that could not be used, with the reason.

    Raises
    ------
    InputError
        No visit can be used.
    """
    left_out = dict(left_out or {})
    used = [
        _UsedDrive(drive, select_visits_on_map(drive.identified.visits, floor)) for drive in drives
    ]
    used = [one for one in used if one.visits]
    if not used:
        reasons = "; ".join(f"{name}: {text}" for name, text in left_out.items())
        raise InputError(
            f"no landmark of the map was detected in the recordings ({reasons})"
            if reasons
            else "no landmark of the map was detected in the recordings",
            hint="Drive over three landmarks or more of the window's shape in one recording",
        )
    design = replace(floor, built={})
    priors = _common_priors(used)
    used, first = _smooth_without_outliers(used, design, priors, left_out)
    visits = _all_visits(used)
    components = connected_components([[visit.cell for visit in one.visits] for one in used])
    strength, strength_sigma = typical_strength(first)
    rough = describe_landmarks(first, weak_priors(visits, design), design, components, visits)
    landmark_priors = tolerance_priors(first, rough, design, strength)
    # The fields of neighbours are subtracted as they were estimated in the first solution.
    known = {cell: one.built for cell, one in rough.items() if not one.refused}
    final = _smooth(used, landmark_priors, replace(design, built=known), priors)
    fine = describe_landmarks(final, landmark_priors, design, components, visits)
    landmarks = tuple(fine[cell] for cell in sorted(fine))
    built = {one.cell: one.built for one in landmarks if not one.refused}
    report = FloorCalibrationReport(
        floor=replace(floor, built={**floor.built, **built}),
        landmarks=landmarks,
        unvisited=tuple(cell for cell in floor.cells() if cell not in fine),
        strength=strength,
        strength_sigma=strength_sigma,
        residual_sigma=final.residual_sigma,
        left_out=left_out,
        notes=(),
    )
    corrected = [
        f"{drive.name}: {warning.message}"
        for drive in drives
        for warning in drive.identified.recording.warnings
    ]
    return replace(report, notes=(*corrected, *_notes(report, components, floor)))


def _common_priors(used: Sequence[_UsedDrive]) -> ModelPriors:
    """Return priors with the rms noise of all recordings."""
    noises = [one.drive.identified.priors.noise_t for one in used]
    return replace(
        used[0].drive.identified.priors,
        noise_t=math.sqrt(np.mean(np.square(noises))),
        model_error_t=SMOOTHED_MODEL_ERROR_T,
    )


def _all_visits(used: Sequence[_UsedDrive]) -> list[IdentifiedVisit]:
    return [visit for one in used for visit in one.visits]


def _smooth(
    used: Sequence[_UsedDrive],
    landmarks: Mapping[Cell, LandmarkPrior],
    floor: FloorMap,
    priors: ModelPriors,
) -> SmoothingResult:
    """Smooth all recordings together."""
    robots = []
    for one in used:
        identified = one.drive.identified
        robots.append(measure_visits(one.visits, identified.odometry, identified.priors, floor))
    return smooth(robots, landmarks, floor.geometry, priors)


def _smooth_without_outliers(
    used: list[_UsedDrive], design: FloorMap, priors: ModelPriors, left_out: dict[str, str]
) -> tuple[list[_UsedDrive], SmoothingResult]:
    """Smooth with weak priors and remove outliers, which are added to ``left_out``."""
    smoothed = _smooth(used, weak_priors(_all_visits(used), design), design, priors)
    for _ in range(MAX_OUTLIER_ROUNDS):
        outliers = [
            _find_outlier(one.visits, poses, smoothed)
            for one, poses in zip(used, smoothed.visits, strict=True)
        ]
        if all(outlier is None for outlier in outliers):
            break
        kept = []
        for one, outlier in zip(used, outliers, strict=True):
            if outlier is not None:
                row, column = outlier.cell
                time_s = outlier.hypotheses.time_ns * 1e-9
                left_out[f"{one.drive.name} at {time_s:.3f} s"] = (
                    f"the visit to {row},{column} does not agree with the others"
                )
            visits = [visit for visit in one.visits if visit is not outlier]
            if visits:
                kept.append(_UsedDrive(one.drive, visits))
        used = kept
        if not used:
            raise InputError(
                "no visit agrees with the odometry and the other visits",
                hint="Check the odometry and the sensors with `locatk solve` first",
            )
        smoothed = _smooth(used, weak_priors(_all_visits(used), design), design, priors)
    return used, smoothed


def _find_outlier(
    visits: Sequence[IdentifiedVisit], poses: Sequence[VisitPose], smoothed: SmoothingResult
) -> IdentifiedVisit | None:
    """Return the visit of a recording that agrees least with all others, if it is an outlier."""
    outlier, largest = None, 1.0
    for visit, estimate in zip(visits, poses, strict=True):
        hypothesis = visit.hypothesis
        frame = np.array([0.0, 0.0, visit.quarters * HALF_PI_RAD])
        landmark = smoothed.landmarks[visit.cell].pose
        own_pose = compose(landmark, compose(frame, hypothesis.pose))
        deviation = estimate.pose - own_pose
        distance = float(np.hypot(*deviation[:2]))
        rotation = abs(math.remainder(deviation[2], math.tau))
        sigma = MAX_VISIT_DEVIATION_SIGMAS * np.sqrt(np.diag(hypothesis.covariance))
        ratio = max(
            distance / max(MAX_VISIT_DEVIATION_M, float(np.hypot(*sigma[:2]))),
            rotation / max(MAX_VISIT_DEVIATION_RAD, float(sigma[2])),
        )
        if ratio > largest:
            outlier, largest = visit, ratio
    return outlier


def _notes(
    report: FloorCalibrationReport, components: Sequence[Sequence[Cell]], given: FloorMap
) -> list[str]:
    """Return notes on quantities that were assumed or not determined."""
    notes = []
    if len(components) > 1:
        notes.append(
            f"the recordings are of {len(components)} parts of the floor with no landmark in "
            "common: each was aligned with the map by itself"
        )
    single = [component[0] for component in components if len(component) == 1]
    if single:
        cells = " ".join(f"{row},{column}" for row, column in single)
        notes.append(
            f"of {cells} only the bars are determined, not the pose: no recording leads from there "
            "to another landmark"
        )
    difference = abs(report.strength - 1)
    is_known = math.isfinite(report.strength_sigma)
    if is_known and difference > MIN_FLAG_SIGMAS * report.strength_sigma:
        notes.append(
            f"the typical bar seems to have {report.strength:.2f} of the strength on the map: "
            "remanence_t or sensor_height_mm may be wrong; strengths are relative to the typical "
            "bar"
        )
    if report.residual_sigma > MAX_RESIDUAL_SIGMAS:
        notes.append(
            f"the residuals of the fields are {report.residual_sigma:.1f} times the noise: check "
            "the bars and the sensor height of the map"
        )
    kept = set(given.built) - {one.cell for one in report.landmarks if not one.refused}
    if kept:
        notes.append(f"kept from an earlier calibration: {len(kept)} landmarks")
    return [*notes, *_uniqueness_notes(report.floor)]


def _uniqueness_notes(floor: FloorMap) -> list[str]:
    """Return a note if bars differ from the design, and whether the map is still unique."""
    codes = as_built_codes(floor)
    changed = int(np.count_nonzero(codes != floor.codes))
    if not changed:
        return []
    duplicates = prove_map(replace(floor, codes=codes, built={}), steps=False).duplicate_count
    differs = "1 landmark differs" if changed == 1 else f"{changed} landmarks differ"
    if not duplicates:
        return [f"{differs} from the design; the map is still unique as built"]
    repeats = "1 reading repeats" if duplicates == 1 else f"{duplicates} readings repeat"
    return [f"{differs} from the design, so that {repeats} another: correct the flagged bars"]
