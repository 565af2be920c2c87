"""Typed results of the landmarks solver: detections of landmarks, and facts of a run.

The names of JSON keys are stable (docs/formats.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from locatk.core.landmarks.map.floor import Cell


@dataclass(frozen=True)
class LandmarkDetection:
    """One visit of a robot to one landmark.

    Attributes
    ----------
    time_s : float
        Last time at which the robot was within 5 mm of its closest approach.
    device : str
        Name of the robot.
    cell : (row, column) or None
        Cell of the map; None if it is not known.
    pattern : str or None
        One of the paper's six patterns; None if nothing was read.
    code : int or None
        0 to 15: orientation of the four bars as on the map if the cell is known, else in the
        frame of the robot.
    probability : float
        Posterior probability of the code, from this visit alone.
    x_m, y_m, heading_rad : float or None
        Pose of the robot in the frame of the landmark at ``time_s``. Its axes are parallel to
        those of the map if the cell is known, else rotated by quarter turns so that the heading
        is nearest to 0. None if nothing was read.
    sigma_x_m, sigma_y_m, sigma_heading_rad : float or None
        Standard deviations; nan if the method does not estimate them.
    strength : tuple of float, or None
        Signed strengths of the four bars; 1 is nominal.
    residual_sigma : float
        Rms residual of the samples in standard deviations of the noise; nan if the method has
        no model of the samples.
    refused : str
        Machine-readable reason for which the visit is not used; ``""`` if it is.
    cell_probability : float or None
        Posterior probability of the cell given all visits, and of the map; None if the cell is not
        known, or if the method does not estimate it.
    """

    time_s: float
    device: str
    cell: Cell | None
    pattern: str | None
    code: int | None
    probability: float
    x_m: float | None
    y_m: float | None
    heading_rad: float | None
    sigma_x_m: float | None
    sigma_y_m: float | None
    sigma_heading_rad: float | None
    strength: tuple[float, ...] | None
    residual_sigma: float
    refused: str
    cell_probability: float | None = None


@dataclass(frozen=True, kw_only=True)
class RobotFacts:
    """Localization of one robot on the map.

    Attributes
    ----------
    localised : bool
        Whether the robot has poses on the map.
    provisional : bool
        Whether these poses may be wrong: :attr:`probability` is below 0.999.
    probability : float, optional
        Posterior probability that the robot is on this floor, and that the least certain cell that
        is reported (or the most certain one if none is) is right; unknown with
        ``--method paper``.
    map_probability : float, optional
        Posterior probability that the robot is on this floor and not on any other.
    landmarks_seen : int
        Landmarks that were read.
    landmarks_to_localise : int or None
        Number of the landmark at which the cell became certain; None if it never did, or with
        ``--method paper``. Written as null; earlier versions left it out with that method.
    misfit_sigma : float, optional
        Rms residual of all fields after smoothing, in standard deviations.
    """

    localised: bool
    provisional: bool = False
    probability: float | None = None
    map_probability: float | None = None
    landmarks_seen: int
    landmarks_to_localise: int | None = field(default=None, metadata={"json_null": True})
    misfit_sigma: float | None = None


@dataclass(frozen=True)
class LandmarkFacts:
    """Figures of a run of the landmarks solver.

    Attributes
    ----------
    robots : dict of str to RobotFacts
        By device.
    """

    robots: dict[str, RobotFacts] = field(default_factory=dict)
