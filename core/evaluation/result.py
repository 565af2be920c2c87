"""Result of an evaluation: errors, with the alignment, time offset and association behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.evaluation.consistency import Consistency
from locatk.core.evaluation.coverage import Coverage
from locatk.core.evaluation.pose_errors import Drift, RelativeErrors, Statistics
from locatk.core.evaluation.time_offset import TimeOffset
from locatk.core.geometry import Similarity

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evaluation:
    """Errors of one or several devices under one alignment and one time offset.

    Attributes
    ----------
    ape_translation : Statistics
        Euclidean distances, in metres.
    ape_rotation : Statistics or None
        Angles between the orientations, in degrees; None if estimate or truth has none.
    rpe_translation, rpe_rotation : Statistics or None
        Relative errors of pairs of poses of one device
        (:mod:`locatk.core.evaluation.pose_errors`), in metres and degrees; None if no two poses
        are far enough from each other.
    rpe_delta : str
        Distance of those poses, as in ``"1f"``.
    unscored : dict of str to int
        Number of poses of the estimate that were not scored, by reason: ``"no truth"`` and
        ``"held out"``.
    align : str
        Name of the alignment (:data:`locatk.core.evaluation.alignment.ALIGNMENTS`), the only
        quantity that was fitted on the scored poses.
    alignment : Similarity
        That alignment, from estimate to truth.
    time_offset : TimeOffset
        Time offset, and its origin.
    match : str
        One of :data:`locatk.core.evaluation.association.MATCHES`.
    devices : tuple of str
        Names of the devices.
    device : (n,) int ndarray
        Index into ``devices``.
    time_ns : (n,) int64 ndarray
        Stamps of the scored poses, as in the estimate.
    residuals : (n, 3) ndarray
        Aligned estimate minus truth, in metres.
    errors : (n,) ndarray
        Lengths of the residuals.
    rotation_errors_deg : (n,) ndarray
        ``nan`` if estimate or truth reports no orientation.
    relative : RelativeErrors
        Relative errors; their rows are those of the scored poses.
    coverage : Coverage
        Time of the truth for which the estimate has poses.
    path_m, path_estimate_m : float
        Path length of truth and (not aligned) estimate over the scored poses.
    drift : Drift
        Errors of sub-trajectories by their length.
    consistency : Consistency or None
        Consistency of the reported covariances; None if there are none.
    nees : (n,) ndarray
        Normalized error squared; ``nan`` without covariance.
    nees_dof : (n,) int ndarray
        Its degrees of freedom.
    """

    ape_translation: Statistics
    ape_rotation: Statistics | None
    rpe_translation: Statistics | None
    rpe_rotation: Statistics | None
    rpe_delta: str
    unscored: dict[str, int]
    align: str
    alignment: Similarity
    time_offset: TimeOffset
    match: str
    devices: tuple[str, ...]
    device: NDArray[np.int32]
    time_ns: NDArray[np.int64]
    residuals: Array
    errors: Array
    rotation_errors_deg: Array
    relative: RelativeErrors
    coverage: Coverage
    path_m: float
    path_estimate_m: float
    drift: Drift
    consistency: Consistency | None
    nees: Array
    nees_dof: NDArray[np.int64]

    @property
    def n(self) -> int:
        """Number of scored poses."""
        return self.ape_translation.n

    @property
    def offset_s(self) -> float:
        """Seconds added to the stamps of the estimate."""
        return self.time_offset.offset_s

    @property
    def mae(self) -> float:
        """Mean distance in metres, the MAE in Table I of the Lighthouse paper."""
        return self.ape_translation.mean

    @property
    def rmse(self) -> float:
        """Root mean square of the distances in metres."""
        return self.ape_translation.rmse

    @property
    def sd(self) -> float:
        """Standard deviation of the distances in metres, with n: rmse^2 = mae^2 + sd^2."""
        return self.ape_translation.std

    @property
    def median(self) -> float:
        """Median of the distances in metres."""
        return self.ape_translation.median

    @property
    def p95(self) -> float:
        """95th percentile of the distances in metres."""
        return self.ape_translation.p95

    @property
    def max(self) -> float:
        """Largest distance in metres."""
        return self.ape_translation.max

    @property
    def drift_percent(self) -> float | None:
        """Mean error of sub-trajectories in percent of their length; None without motion."""
        translation = self.drift.translation
        return float(100 * translation.mean()) if len(translation) else None

    @property
    def transform(self) -> Array:
        """Homogeneous matrix (4, 4) of the alignment, including its scale."""
        return self.alignment.matrix

    def device_statistics(self, index: int) -> dict[str, Statistics | None]:
        """Return the statistics of the device ``devices[index]``.

        Keys are ``ape_translation``, ``ape_rotation``, ``rpe_translation`` and ``rpe_rotation``.
        """
        mask = self.device == index
        pair_mask = mask[self.relative.first]
        rotation_deg = self.relative.rotation_deg
        return {
            "ape_translation": Statistics.from_finite(self.errors[mask]),
            "ape_rotation": Statistics.from_finite(self.rotation_errors_deg[mask]),
            "rpe_translation": Statistics.from_finite(self.relative.translation[pair_mask]),
            "rpe_rotation": Statistics.from_finite(
                None if rotation_deg is None else rotation_deg[pair_mask]
            ),
        }

    def __repr__(self) -> str:
        ape = self.ape_translation
        return (
            f"<Evaluation of {ape.n} poses, align {self.align!r}: APE median "
            f"{1e3 * ape.median:.3g} mm, rmse {1e3 * ape.rmse:.3g} mm, p95 {1e3 * ape.p95:.3g} mm>"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON form: everything but the arrays of poses, with figures per device."""
        overall = {
            "ape_translation": self.ape_translation,
            "ape_rotation": self.ape_rotation,
            "rpe_translation": self.rpe_translation,
            "rpe_rotation": self.rpe_rotation,
        }
        is_single = len(self.devices) == 1
        per_device = {
            name: self._figures(overall if is_single else self.device_statistics(index))
            for index, name in enumerate(self.devices)
        }
        rotation_drift = Statistics.from_finite(self.drift.rotation)
        return {
            **self._figures(overall),
            "unscored": dict(self.unscored),
            "align": self.align,
            "align_fitted_on": _FITTED_ON.get(self.align, "the scored poses"),
            "scale": self.alignment.scale,
            "transform": self.transform.tolist(),
            "offset_s": self.time_offset.offset_s,
            "offset_source": self.time_offset.describe(),
            "match": self.match,
            "coverage": {
                "share": self.coverage.fraction,
                "solved_s": self.coverage.solved_s,
                "truth_s": self.coverage.truth_s,
            },
            "path_m": self.path_m,
            "path_estimate_m": self.path_estimate_m,
            "drift": {
                "translation_percent": self.drift_percent,
                "rotation_deg_per_m": None if rotation_drift is None else rotation_drift.mean,
            },
            "nees": None if self.consistency is None else self.consistency.as_dict(),
            "devices": per_device,
        }

    def _figures(self, statistics: dict[str, Statistics | None]) -> dict[str, Any]:
        """Return the JSON figures of all devices or of one.

        Figures of distances are also under short names.
        """
        distances = statistics["ape_translation"]
        if distances is None:
            return {"n": 0}
        tables = {name: value and value.as_dict() for name, value in statistics.items()}
        return {
            "n": distances.n,
            "mae_m": distances.mean,
            "rmse_m": distances.rmse,
            "sd_m": distances.std,
            "median_m": distances.median,
            "p95_m": distances.p95,
            "max_m": distances.max,
            "ape": {
                "translation_m": tables["ape_translation"],
                "rotation_deg": tables["ape_rotation"],
            },
            "rpe": {
                "delta": self.rpe_delta,
                "translation_m": tables["rpe_translation"],
                "rotation_deg": tables["rpe_rotation"],
            },
        }


_FITTED_ON = {"none": "nothing", "origin": "the first scored pose"}
