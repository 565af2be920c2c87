"""Typed results of the Polaris solver: detections of tags, and facts of a run.

The names of JSON keys are stable (docs/formats.md). If the name of a field differs from its key,
the key is declared with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from locatk.core.polaris.tag import PlanarPose


@dataclass(frozen=True)
class MagnetDetection:
    """Magnet in the frame of the array at the time of its tag's detection.

    Attributes
    ----------
    x_m, y_m : float
        Position.
    angle_rad : float
        Direction of the moment, counter-clockwise from x.
    symbol : int or None
        Orientation in steps; None if the magnet is not on the grid of a tag.
    cell : (column, row) or None
        Cell of the grid; None likewise.
    sigma_x_m, sigma_y_m, sigma_angle_rad : float
        Standard deviations; nan if the method does not estimate them.
    moment_am2 : float
        Magnitude of the moment.
    """

    x_m: float
    y_m: float
    angle_rad: float
    symbol: int | None
    cell: tuple[int, int] | None
    sigma_x_m: float
    sigma_y_m: float
    sigma_angle_rad: float
    moment_am2: float


@dataclass(frozen=True)
class OtherMagnet:
    """Magnet that belongs to no tag, in the frame of the array at the time of a detection.

    Attributes
    ----------
    x_m, y_m : float
    angle_rad : float
        Direction of the moment, counter-clockwise from x.
    moment_am2 : float
        Magnitude of the moment, comparable with that of the tag's magnets.
    """

    x_m: float
    y_m: float
    angle_rad: float
    moment_am2: float


@dataclass(frozen=True)
class TagDetection:
    """Tag that the array passed over, or magnets that may be one.

    Attributes
    ----------
    time_s : float
        Time at which the array was nearest to the centre of the magnets.
    device : str
        Name of the array.
    tag_id : int or None
        None if the tag was not read; :attr:`refused` is the reason then.
    margin : float or None
        Difference of soft distance between the second best id and the best, in steps of
        orientation; None if no grid fits.
    refused : str or None
        Machine-readable reason; None if the tag was read.
    x_m, y_m, heading_rad : float or None
        Pose of the tag in the frame of the array at ``time_s``; None if no grid fits.
    sigma_x_m, sigma_y_m, sigma_heading_rad : float
        Standard deviations; nan if they are not known.
    array_pose : PlanarPose or None
        Pose of the array in the frame of the tag; ``array`` in the JSON form.
    magnets : tuple of MagnetDetection
        The tag's own magnets row by row if it was read, else all.
    residual_sigma : float
        Rms residual of the samples in standard deviations of the noise; nan if the method has
        no model of the samples.
    height_m : float
        Height of the sensors over the magnets; nan if the method does not estimate it.
    speed_mps : float or None
        Mean speed over the pass; None if its duration is zero.
    scale : float
        Factor applied to lengths along the track so that the tag has its nominal spacing.
    corrected, erased : int or None
        Steps between the observed orientations and those of the id, and magnets of the id that
        were not observed; None if no grid fits.
    other_sources : int
        Sources in the pass that are much weaker than magnets (iron, screws).
    other_magnets : tuple of OtherMagnet
        Magnets of the pass that belong to no tag and are nearest to this one.
    design : str or None
        Name of the tag's design if several were given.
    meaning : str or None
        Meaning of the id in the tag's design; None if it has none.
    """

    time_s: float
    device: str
    tag_id: int | None
    margin: float | None
    refused: str | None
    x_m: float | None
    y_m: float | None
    heading_rad: float | None
    sigma_x_m: float
    sigma_y_m: float
    sigma_heading_rad: float
    array_pose: PlanarPose | None = field(metadata={"json": "array"})
    magnets: tuple[MagnetDetection, ...]
    residual_sigma: float
    height_m: float
    speed_mps: float | None
    scale: float
    corrected: int | None
    erased: int | None
    other_sources: int
    other_magnets: tuple[OtherMagnet, ...] = ()
    design: str | None = None
    meaning: str | None = None


@dataclass(frozen=True)
class HeadingCorrection:
    """Rotation that points a robot from one tag to the next (paper, section 8.3.7).

    Attributes
    ----------
    device : str
    time_s : float
        Time of the last pose over the first tag.
    from_tag, to_tag : int
        Ids of the two tags; ``from`` and ``to`` in the JSON form.
    rotation_rad, sigma_rotation_rad : float
        Rotation at ``time_s``, counter-clockwise, after which the robot points at the centre of
        the second tag, and its standard deviation; ``turn_rad`` and ``sigma_turn_rad`` in the
        JSON form.
    distance_m : float
        From the robot to that centre.
    """

    device: str
    time_s: float
    from_tag: int = field(metadata={"json": "from"})
    to_tag: int = field(metadata={"json": "to"})
    rotation_rad: float = field(metadata={"json": "turn_rad"})
    sigma_rotation_rad: float = field(metadata={"json": "sigma_turn_rad"})
    distance_m: float


@dataclass(frozen=True)
class PolarisFacts:
    """Figures of a run of the Polaris solver.

    Attributes
    ----------
    heading_corrections : tuple of HeadingCorrection
        One for every two tags of the site that were passed one after the other.
    """

    heading_corrections: tuple[HeadingCorrection, ...] = ()
