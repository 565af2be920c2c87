"""Evaluation of estimated trajectories against the truth.

:func:`evaluate` matches poses by time, fits a named alignment, and returns absolute and relative
errors, drift, coverage and the consistency of the covariances. It can be used by itself::

    evaluation = evaluate([(estimate, truth)], EvaluationOptions(align="se3", offset_s="auto"))
    print(evaluation.rmse, evaluation.time_offset.describe())
"""

from locatk.core.evaluation.alignment import ALIGNMENTS, fit_alignment
from locatk.core.evaluation.association import (
    MATCHES,
    MAX_DIFF_S,
    MAX_GAP_S,
    Association,
    Pairs,
    associate,
    pair_devices,
)
from locatk.core.evaluation.coarse_offset import CoarseOffset, estimate_coarse_offset
from locatk.core.evaluation.consistency import CHI2_95_QUANTILES, Consistency
from locatk.core.evaluation.coverage import Coverage
from locatk.core.evaluation.pose_errors import Delta, Statistics
from locatk.core.evaluation.result import Evaluation
from locatk.core.evaluation.scoring import EvaluationOptions, evaluate
from locatk.core.evaluation.time_offset import (
    TimeOffset,
    estimate_held_out_offset,
    estimate_offset,
)

__all__ = [
    "ALIGNMENTS",
    "CHI2_95_QUANTILES",
    "MATCHES",
    "MAX_DIFF_S",
    "MAX_GAP_S",
    "Association",
    "CoarseOffset",
    "Consistency",
    "Coverage",
    "Delta",
    "Evaluation",
    "EvaluationOptions",
    "Pairs",
    "Statistics",
    "TimeOffset",
    "associate",
    "estimate_coarse_offset",
    "estimate_held_out_offset",
    "estimate_offset",
    "evaluate",
    "fit_alignment",
    "pair_devices",
]
