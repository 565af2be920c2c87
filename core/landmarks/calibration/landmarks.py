"""Landmarks of a calibration: priors before, and flags after the least squares."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.calibration.datum import deviations_from_design, relative_covariances
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import FAULTY_STRENGTH_SIGMA
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.localization.cell_filter import IdentifiedVisit
from locatk.core.landmarks.localization.smoothing import (
    LANDMARK_SIGMA,
    MIN_STRENGTH_SIGMA,
    LandmarkPrior,
    SmoothingResult,
)
from locatk.core.landmarks.map.floor import MISSING_BAR_STRENGTH, AsBuiltLandmark, Cell, FloorMap

Array = NDArray[np.float64]

UNKNOWN_POSE_SIGMA = np.array([10e-3, 10e-3, math.radians(5)])
"""Standard deviations of a landmark's pose (m, m, rad) that is practically unknown."""

MAX_DESIGN_DEVIATION_SIGMAS = 3.0
"""Deviation in units of :data:`LANDMARK_SIGMA` above which a landmark is not constrained by its
design."""

MIN_DISPLACEMENT_M = 5e-3
MIN_ROTATION_RAD = math.radians(3)
"""Deviations from the design above which a landmark is flagged."""

MAX_WEAK_STRENGTH = 0.8
"""Strength below which a bar is flagged as weak."""

MIN_FLAG_SIGMAS = 3.0
"""Standard deviations by which a deviation must be significant to be flagged."""

MAX_SOUND_DEVIATION = 0.2
"""A bar is constrained to the typical strength if it is within this fraction of it."""

MAX_REPORTED_SIGMA = np.array([1.5e-3, 1.5e-3, math.radians(1.5)])
"""Standard deviations of a pose by the measurements alone, above which a landmark is not written to
the map ..."""

MAX_REPORTED_STRENGTH_SIGMA = 0.15
"""... and of a strength."""


@dataclass(frozen=True)
class CalibratedLandmark:
    """Landmark as estimated by a calibration.

    Attributes
    ----------
    cell : (row, column)
    built : AsBuiltLandmark
    refused : str
        Reason for which it is not written to the map; ``""`` if it is.
    """

    cell: Cell
    built: AsBuiltLandmark
    refused: str = ""


def weak_priors(visits: Sequence[IdentifiedVisit], design: FloorMap) -> dict[Cell, LandmarkPrior]:
    """Return priors that contain little more than the directions of the bars, as read."""
    weight: dict[Cell, Array] = {}
    total: dict[Cell, Array] = {}
    for visit in visits:
        cell, hypothesis = visit.cell, visit.hypothesis
        strength, sigma = np.roll(
            [hypothesis.strength, hypothesis.strength_sigma], visit.quarters, axis=1
        )
        information = np.maximum(sigma, MIN_STRENGTH_SIGMA) ** -2
        weight[cell] = weight.get(cell, np.zeros(4)) + information
        total[cell] = total.get(cell, np.zeros(4)) + information * strength
    priors = {}
    for cell, weighted in total.items():
        mean = weighted / weight[cell]
        direction = np.where(np.abs(mean) < MISSING_BAR_STRENGTH, 0.0, np.sign(mean))
        pose = np.array([*design.position(cell), 0.0])
        sigma = np.full(4, FAULTY_STRENGTH_SIGMA)
        priors[cell] = LandmarkPrior(pose, UNKNOWN_POSE_SIGMA, direction, sigma)
    return priors


def tolerance_priors(
    smoothed: SmoothingResult,
    landmarks: Mapping[Cell, CalibratedLandmark],
    design: FloorMap,
    strength: float,
) -> dict[Cell, LandmarkPrior]:
    """Return priors with the tolerances of installation, except for detected deviations.

    Parameters
    ----------
    smoothed : SmoothingResult
        Of weak priors.
    landmarks : mapping of cell to CalibratedLandmark
        From the same.
    design : FloorMap
    strength : float
        Of the typical bar.
    """
    priors = {}
    usual_sigma = ModelPriors().strength
    for cell, landmark in smoothed.landmarks.items():
        built = landmarks[cell].built
        deviation = np.abs([built.x_m, built.y_m, built.heading_rad])
        is_displaced = bool(np.any(deviation > MAX_DESIGN_DEVIATION_SIGMAS * LANDMARK_SIGMA))
        relative = landmark.strength / strength
        is_sound = np.abs(np.abs(relative) - 1) < MAX_SOUND_DEVIATION
        priors[cell] = LandmarkPrior(
            np.array([*design.position(cell), 0.0]),
            UNKNOWN_POSE_SIGMA if is_displaced else LANDMARK_SIGMA,
            np.where(is_sound, np.sign(relative), relative),
            np.where(is_sound, usual_sigma, FAULTY_STRENGTH_SIGMA),
        )
    return priors


def typical_strength(smoothed: SmoothingResult) -> tuple[float, float]:
    """Return the strength of the typical bar, and the smallest standard deviation of a bar."""
    landmarks = smoothed.landmarks.values()
    strength = np.concatenate([one.strength for one in landmarks])
    is_present = np.abs(strength) > 2 * MISSING_BAR_STRENGTH
    if not is_present.any():
        return 1.0, math.nan
    sigma = np.concatenate([np.sqrt(np.diag(one.covariance)[3:]) for one in landmarks])
    return float(np.median(np.abs(strength[is_present]))), float(np.min(sigma[is_present]))


def describe_landmarks(
    smoothed: SmoothingResult,
    priors: Mapping[Cell, LandmarkPrior],
    design: FloorMap,
    components: Sequence[Sequence[Cell]],
    visits: Sequence[IdentifiedVisit],
) -> dict[Cell, CalibratedLandmark]:
    """Return all landmarks, each connected part of the floor aligned with its design."""
    count = Counter(visit.cell for visit in visits)
    scale = max(1.0, smoothed.residual_sigma) ** 2  # that of the covariances
    landmarks = {}
    for component in components:
        estimates = [smoothed.landmarks[cell] for cell in component]
        pose = np.array([one.pose for one in estimates])
        covariance = np.array([one.covariance for one in estimates])
        designed = np.array([[*design.position(cell), 0.0] for cell in component])
        deviation = deviations_from_design(pose, designed, LANDMARK_SIGMA)
        prior_sigma = np.array([priors[cell].sigma for cell in component])
        own = relative_covariances(covariance[:, :3, :3], pose[:, :2], prior_sigma, scale)
        if len(component) == 1:
            deviation, own = np.zeros((1, 3)), np.full((1, 3, 3), np.nan)
        pose_sigma = np.sqrt(np.maximum(np.einsum("nii->ni", own), 0.0))
        strength_sigma = np.sqrt(np.einsum("nii->ni", covariance[:, 3:, 3:]))
        for k, cell in enumerate(component):
            strength = estimates[k].strength
            sigma = np.concatenate([pose_sigma[k], strength_sigma[k]])
            x, y, heading = (float(value) for value in deviation[k])
            flags = flag_deviations(signs(design.codes[cell]), deviation[k], strength, sigma)
            built = AsBuiltLandmark(x, y, heading, strength, sigma, count[cell], flags)
            prior = np.concatenate([prior_sigma[k], priors[cell].strength_sigma])
            refused = refusal_reason(sigma_without_prior(sigma, prior))
            landmarks[cell] = CalibratedLandmark(cell, built, refused)
    return landmarks


def flag_deviations(
    designed: Array, deviation: Array, strength: Array, sigma: Array
) -> tuple[str, ...]:
    """Return flags of significant deviations of one landmark.

    Parameters
    ----------
    designed : (4,) ndarray
        Signs of the bars.
    deviation : (3,) ndarray
        Of the pose, in m and rad.
    strength : (4,) ndarray
    sigma : (7,) ndarray
        Standard deviations of pose (``nan`` if unknown) and strengths.

    Returns
    -------
    tuple of str
        As of :attr:`.AsBuiltLandmark.flags`.
    """
    flags = []
    for bar, (value, bar_sigma) in enumerate(zip(strength, sigma[3:], strict=True)):
        magnitude = abs(value)
        if magnitude < MISSING_BAR_STRENGTH:
            flags.append(f"missing:{bar}")
            continue
        if value * designed[bar] < 0 and magnitude > MIN_FLAG_SIGMAS * bar_sigma:
            flags.append(f"flipped:{bar}")
        if magnitude < MAX_WEAK_STRENGTH and 1 - magnitude > MIN_FLAG_SIGMAS * bar_sigma:
            flags.append(f"weak:{bar}")
    pose_sigma = np.nan_to_num(sigma[:3])
    distance_limit = max(MIN_DISPLACEMENT_M, MIN_FLAG_SIGMAS * float(np.hypot(*pose_sigma[:2])))
    if float(np.hypot(*deviation[:2])) > distance_limit:
        flags.append("displaced")
    if abs(deviation[2]) > max(MIN_ROTATION_RAD, MIN_FLAG_SIGMAS * float(pose_sigma[2])):
        flags.append("turned")
    return tuple(flags)


def sigma_without_prior(sigma: Array, prior_sigma: Array) -> Array:
    """Return the standard deviations of unknowns by the measurements alone."""
    information = 1 / sigma**2 - 1 / prior_sigma**2
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(np.isnan(sigma), np.nan, np.fmax(information, 0.0) ** -0.5))


def refusal_reason(sigma: Array) -> str:
    """Return the reason for which a landmark is not written to the map, or ``""``.

    The standard deviations (7,) are those of the measurements alone.
    """
    if np.any(sigma[:3] > MAX_REPORTED_SIGMA):
        return "its pose is too uncertain"
    uncertain = np.flatnonzero(sigma[3:] > MAX_REPORTED_STRENGTH_SIGMA)
    if len(uncertain):
        return f"the strength of bar {', '.join(str(k) for k in uncertain)} is too uncertain"
    return ""
