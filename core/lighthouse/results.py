"""Typed results of the Lighthouse solver: detections per station, and facts of a run.

The names of JSON keys are stable. If a field has another name, its key is declared with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class StationDetection:
    """Sweeps of one base station that a solution used, and how well they agree with it.

    Attributes
    ----------
    station : int
        Index of the station in the recording, from 0 in ascending order of the channel.
    channel : int
        1 to 16.
    id : str or None
        Serial number in hexadecimal.
    period_ticks : int
        Nominal length of a rotation in ticks of 48 MHz.
    calibration : str
        Source of the calibration: ``"factory"``, ``"generic"``, ``"estimated"`` or ``"none"``.
    sweeps, rejected : int
        Number of sweeps that accepted poses use, and of the others.
    residual_rad : float, optional
        Robust standard deviation of the residuals of the used sweeps.
    verification_rad, verification_m : float, optional
        Robust standard deviation of the station's angles from those predicted by the other
        stations, on held-out epochs, as an angle and across the ray.
    """

    station: int
    channel: int
    id: str | None
    period_ticks: int
    calibration: str
    sweeps: int
    rejected: int
    residual_rad: float | None = None
    verification_rad: float | None = None
    verification_m: float | None = None


@dataclass(frozen=True)
class StationVerification:
    """Agreement of one station with the others on held-out epochs.

    Attributes
    ----------
    channel : int
    against : str
        ``"others"``: its angles against positions from all other stations. ``"joint"``: against
        positions that it contributed to, because the others alone do not determine any.
    epochs : int
        Number of epochs compared; ``moments`` in the JSON form.
    residual_rad : float or None
        Robust standard deviation of its angles from those predicted; None without epochs.
    residual_m : float or None
        The same at the distance of each photodiode, across the ray.
    jump_median_m, jump_95_m : float or None
        Median and 95th percentile of the change of position when the station is left out.
    without_rad : float or None
        Robust standard deviation of the residuals of the other stations when it is left out.
    """

    channel: int
    against: str
    epochs: int = field(metadata={"json": "moments"})
    residual_rad: float | None
    residual_m: float | None
    jump_median_m: float | None
    jump_95_m: float | None
    without_rad: float | None


@dataclass(frozen=True)
class SceneVerification:
    """Verification of a scene on epochs.

    Attributes
    ----------
    held_out : bool
        True if the epochs took no part in the estimation of the scene.
    epochs : int
        Number of epochs; ``moments`` in the JSON form.
    stations : tuple of StationVerification
    """

    held_out: bool
    epochs: int = field(metadata={"json": "moments"})
    stations: tuple[StationVerification, ...]


@dataclass(frozen=True)
class TwoViewCandidate:
    """Arrangement of two stations that a homography allows.

    Attributes
    ----------
    cost : float
        Half the sum of squares after refinement.
    roll_deg : float
        Root of the sum of squares of both stations' roll angles.
    fits : bool
        True if it explains the angles about as well as the best.
    chosen : bool
    """

    cost: float
    roll_deg: float
    fits: bool
    chosen: bool


@dataclass(frozen=True)
class StationPairLink:
    """Two stations whose relative pose was estimated from rigid devices.

    Attributes
    ----------
    channels : (int, int)
    epochs : int
        Number of epochs that agree on it; ``moments`` in the JSON form.
    """

    channels: tuple[int, int]
    epochs: int = field(metadata={"json": "moments"})


@dataclass(frozen=True)
class StandstillFacts:
    """Time during which a device rested, and its position there.

    Attributes
    ----------
    number : int
        From 1, in the order of time.
    device : str
    start_ns, end_ns : int
        Nanoseconds since the epoch.
    role : str
        ``"origin"``, ``"x axis"``, ``"floor"``, the name of a marker, or "" if it is not used.
    position_m : tuple of 3 float, optional
        Median position of the device in the frame of the solution; None without a pose.
    """

    number: int
    device: str
    start_ns: int
    end_ns: int
    role: str = ""
    position_m: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class FrameFacts:
    """Origin and uncertainty of the frame of a scene.

    Attributes
    ----------
    source : str
        As :attr:`~locatk.core.lighthouse.scene.model.Scene.frame_source`.
    level_sigma_rad : float
        Standard deviation of the inclination of the z axis, about each horizontal axis.
    up_deviation_rad : float
        Angle between the z axis and the direction against gravity that the accelerometers of the
        stations report.
    up_sigma_rad : float
        Standard deviation of that direction, about each axis.
    origin_sigma_m, heading_sigma_rad, scale_sigma : float
        Standard deviations of the origin (along each axis), of the direction of the x axis, and of
        the scale (relative), from the points on the floor or the markers.
    misfit_m : float
        Rms height of the points on the floor, if they are more than three.
    standstills : tuple of StandstillFacts
        In the order of time, if they were searched.
    """

    source: str
    level_sigma_rad: float | None = None
    up_deviation_rad: float | None = None
    up_sigma_rad: float | None = None
    origin_sigma_m: float | None = None
    heading_sigma_rad: float | None = None
    scale_sigma: float | None = None
    misfit_m: float | None = None
    standstills: tuple[StandstillFacts, ...] | None = None


@dataclass(frozen=True)
class LighthouseFacts:
    """Figures of a run of the Lighthouse solver; None if a figure does not apply.

    Attributes
    ----------
    planar : bool
        True if the scene was solved with all photodiodes on one plane.
    planar_decided_by : str
        ``"option"`` or ``"data"``.
    plane_fraction : float
        Fraction of the positions that agree with one plane; ``plane_share`` in the JSON form.
    plane_median_rad : float
        Median residual of the homography between two stations, as a tangent.
    candidates : tuple of TwoViewCandidate
    candidate_decided_by : str
        ``"markers"`` or ``"gravity"`` if these chose the arrangement;
        ``reading_decided_by`` in the JSON form.
    bundle_points, bundle_iterations : int
        Points and iterations of the final bundle adjustment.
    marker_misfit_m, marker_residual_rad : float
        Rms residual of markers.
    marker_scale : float
        Scale from the size of the device to that of the markers.
    adjusted_epochs, adjusted_positions : int
        Epochs of rigid devices in the bundle adjustment, and their distinct positions;
        ``moments_adjusted`` and ``places_adjusted`` in the JSON form.
    scene_angle_sigma_rad : float
        Noise of angles in the bundle adjustment of a scene from rigid devices.
    iterations : int
        Its iterations.
    links : tuple of StationPairLink
    angle_sigma_rad : float
        Standard deviation of a rotor angle, estimated from the recording.
    lasting_angle_sigma_rad : float
        Its part that repeats from rotation to rotation.
    calibration_sigma_rad : float
        Standard deviation that a generic calibration adds.
    station_residual_rad : dict of str to float
        Robust standard deviation of the residuals, by channel.
    restored_swapped_epochs : int
        Epochs whose sweeps of two stations were exchanged and restored;
        ``moments_with_swapped_sweeps_restored`` in the JSON form.
    verification : SceneVerification
    frame : FrameFacts
        Origin and uncertainty of the frame.
    rigid : LighthouseFacts
        Figures of the rigid devices, if single photodiodes were solved as well.
    """

    plane_fraction: float | None = field(default=None, metadata={"json": "plane_share"})
    plane_median_rad: float | None = None
    planar_decided_by: str | None = None
    candidate_decided_by: str | None = field(default=None, metadata={"json": "reading_decided_by"})
    candidates: tuple[TwoViewCandidate, ...] | None = None
    bundle_points: int | None = None
    bundle_iterations: int | None = None
    planar: bool | None = None
    marker_misfit_m: float | None = None
    marker_residual_rad: float | None = None
    marker_scale: float | None = None
    adjusted_epochs: int | None = field(default=None, metadata={"json": "moments_adjusted"})
    adjusted_positions: int | None = field(default=None, metadata={"json": "places_adjusted"})
    scene_angle_sigma_rad: float | None = None
    iterations: int | None = None
    links: tuple[StationPairLink, ...] | None = None
    restored_swapped_epochs: int | None = field(
        default=None, metadata={"json": "moments_with_swapped_sweeps_restored"}
    )
    angle_sigma_rad: float | None = None
    lasting_angle_sigma_rad: float | None = None
    calibration_sigma_rad: float | None = None
    station_residual_rad: dict[str, float] | None = None
    verification: SceneVerification | None = None
    frame: FrameFacts | None = None
    rigid: LighthouseFacts | None = None
