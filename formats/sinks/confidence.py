"""Quality of a pose in the terms of other protocols: radius of its position, score from 0 to 1."""

from __future__ import annotations

import math

from locatk.core.streaming.events import PoseEstimate, TrackingState

CHI_SQUARE_95 = -2 * math.log(0.05)
"""95 % quantile of the chi-square distribution with two degrees of freedom."""

SCORE_DISTANCE_M = 1.0
"""95 % radius at which the score of a pose has fallen to 1/e: half a corridor."""

MAX_PROVISIONAL_SCORE = 0.5
"""A position that may be another one is at best as likely right as wrong."""


def deviation_radius_m(pose: PoseEstimate) -> float:
    """Return the radius in the xy plane that contains the position with 95 % or more [m].

    It is the larger semi-axis of the 95 % ellipse; nan if x or y is unobserved.
    """
    a, b, c = pose.covariance[0, 0], pose.covariance[0, 1], pose.covariance[1, 1]
    largest = (a + c) / 2 + math.hypot((a - c) / 2, b)
    return math.sqrt(CHI_SQUARE_95 * largest) if largest >= 0 else math.nan


def localization_score(pose: PoseEstimate) -> float:
    """Return P exp(-r / 1 m), from 0 to 1.

    r is the radius of :func:`deviation_radius_m`; P the probability of the pose, 1 if unknown.
    While the state is provisional, it is at most 0.5; without a radius 0.
    """
    radius_m = deviation_radius_m(pose)
    if math.isnan(radius_m):
        return 0.0
    probability = 1.0 if math.isnan(pose.probability) else pose.probability
    score = probability * math.exp(-radius_m / SCORE_DISTANCE_M)
    if pose.state == TrackingState.PROVISIONAL:
        score = min(score, MAX_PROVISIONAL_SCORE)
    return float(min(max(score, 0.0), 1.0))
