"""What an evaluation says: errors, and under which alignment, offset and association."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.consistency import Consistency
from locatk.core.coverage import Coverage
from locatk.core.geometry import Similarity
from locatk.core.relative import Drift, Relative
from locatk.core.statistics import Statistics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evaluation:
    """Errors of one or several devices under one alignment and one time offset.

    Attributes
    ----------
    ape_translation : Statistics
        Of the Euclidean distances, in metres.
    ape_rotation : Statistics or None
        Of the angles between the orientations, in degrees; None where none is told.
    rpe_translation, rpe_rotation : Statistics or None
        Of the relative errors of pairs of poses of one device (:mod:`locatk.core.relative`), in
        metres and degrees; None where no two poses are far enough apart.
    rpe_delta : str
        How far apart those are, as in ``"1f"``.
    unscored : dict of str to int
        Poses of the estimate that were not scored: ``"no truth"`` and ``"held out"``.
    align : str
        Name of the alignment (:data:`locatk.core.alignment.ALIGNMENTS`), which was fitted on
        the scored poses. Nothing else was.
    alignment : Similarity
        That alignment: estimate to truth.
    offset_s : float
        Added to the stamps of the estimate.
    offset_source : str
        ``"none"``, ``"given"`` or ``"held-out ..."`` with the part it was estimated on.
    match : str
        One of :data:`locatk.core.association.MATCHES`.
    devices : tuple of str
        Names to which ``device`` points.
    device : (n,) int ndarray
        Index into ``devices``.
    time_ns : (n,) int64 ndarray
        Stamps of the scored poses, as in the estimate.
    residuals : (n, 3) ndarray
        Aligned estimate minus truth, in metres.
    errors : (n,) ndarray
        Lengths of the residuals.
    rotation_errors_deg : (n,) ndarray
        ``nan`` where estimate or truth tells no orientation.
    relative : Relative
        Relative errors; their rows are those of the scored poses.
    coverage : Coverage
        How much of the time of the truth the estimate knows.
    path_m, path_estimate_m : float
        Length of the way of truth and (not aligned) estimate, over the scored poses.
    drift : Drift
        Errors of sub-trajectories by their length.
    consistency : Consistency or None
        Of the reported covariances; None where there are none.
    nees : (n,) ndarray
        Normalised error squared; ``nan`` without covariance.
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
    offset_s: float
    offset_source: str
    match: str
    devices: tuple[str, ...]
    device: NDArray[np.int32]
    time_ns: NDArray[np.int64]
    residuals: Array
    errors: Array
    rotation_errors_deg: Array
    relative: Relative
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
    def mae(self) -> float:
        """Mean distance in metres, the MAE of the lighthouse paper's Table I."""
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
        """Below which 95 % of the distances are, in metres."""
        return self.ape_translation.p95

    @property
    def max(self) -> float:
        """Largest distance in metres."""
        return self.ape_translation.max

    @property
    def drift_percent(self) -> float | None:
        """Mean error of sub-trajectories in percent of their length; None without motion."""
        found = self.drift.translation
        return float(100 * found.mean()) if len(found) else None

    @property
    def transform(self) -> Array:
        """(4, 4) homogeneous matrix of the alignment (its scale included)."""
        return self.alignment.matrix

    def of_device(self, number: int) -> dict[str, Statistics | None]:
        """``ape_translation``, ``ape_rotation``, ``rpe_translation`` and ``rpe_rotation`` of the
        device ``devices[number]``."""
        mine = self.device == number
        pairs = mine[self.relative.first]
        turned = self.relative.rotation_deg
        return {
            "ape_translation": Statistics.known(self.errors[mine]),
            "ape_rotation": Statistics.known(self.rotation_errors_deg[mine]),
            "rpe_translation": Statistics.known(self.relative.translation[pairs]),
            "rpe_rotation": Statistics.known(None if turned is None else turned[pairs]),
        }

    def as_dict(self) -> dict[str, Any]:
        """For JSON: all but the arrays of poses, with the figures of each device."""
        every = {
            "ape_translation": self.ape_translation,
            "ape_rotation": self.ape_rotation,
            "rpe_translation": self.rpe_translation,
            "rpe_rotation": self.rpe_rotation,
        }
        single = len(self.devices) == 1
        per_device = {
            name: self._figures(every if single else self.of_device(i))
            for i, name in enumerate(self.devices)
        }
        turned = Statistics.known(self.drift.rotation)
        return {
            **self._figures(every),
            "unscored": dict(self.unscored),
            "align": self.align,
            "align_fitted_on": _FITTED_ON.get(self.align, "the scored poses"),
            "scale": self.alignment.scale,
            "transform": self.transform.tolist(),
            "offset_s": self.offset_s,
            "offset_source": self.offset_source,
            "match": self.match,
            "coverage": {
                "share": self.coverage.share,
                "solved_s": self.coverage.solved_s,
                "truth_s": self.coverage.truth_s,
            },
            "path_m": self.path_m,
            "path_estimate_m": self.path_estimate_m,
            "drift": {
                "translation_percent": self.drift_percent,
                "rotation_deg_per_m": None if turned is None else turned.mean,
            },
            "nees": None if self.consistency is None else asdict(self.consistency),
            "devices": per_device,
        }

    def _figures(self, found: dict[str, Statistics | None]) -> dict[str, Any]:
        """Figures of all or of one device: those of the distances by short names as well."""
        distances = found["ape_translation"]
        if distances is None:
            return {"n": 0}
        said = {name: each and each.as_dict() for name, each in found.items()}
        return {
            "n": distances.n,
            "mae_m": distances.mean,
            "rmse_m": distances.rmse,
            "sd_m": distances.std,
            "median_m": distances.median,
            "p95_m": distances.p95,
            "max_m": distances.max,
            "ape": {
                "translation_m": said["ape_translation"],
                "rotation_deg": said["ape_rotation"],
            },
            "rpe": {
                "delta": self.rpe_delta,
                "translation_m": said["rpe_translation"],
                "rotation_deg": said["rpe_rotation"],
            },
        }


_FITTED_ON = {"none": "nothing", "origin": "the first scored pose"}
