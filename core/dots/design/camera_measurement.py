"""Read rate and accuracy of a camera over dots, measured on rendered frames.

The frames are those of :mod:`locatk.core.dots.simulation` and the decoder is the real one; nothing
is shared with the closed forms of :mod:`~locatk.core.dots.design.camera` but the setup.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import SECTION_LENGTH
from locatk.core.dots.design.camera_optics import noise_levels, static_blur_px
from locatk.core.dots.design.camera_setup import CameraSetup
from locatk.core.dots.design.dot_noise import PAPER_LEVEL
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, Manifest, Sheet
from locatk.core.dots.simulation.paths import CameraPath
from locatk.core.dots.simulation.session import SimulationOptions, simulate_path
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion, wrap_angle

Array = NDArray[np.float64]

SHEET_FIELDS = 4.0
"""Width of the rendered sheet in diagonals of the field."""


@dataclass(frozen=True)
class CameraMeasurement:
    """Results of rendered frames.

    Attributes
    ----------
    frames : int
    read : int
        Number of frames with a pose.
    position_error_m : (n, 2) ndarray
        Of the poses, along x and y of the sheet.
    heading_error_rad : (n,) ndarray
    stated_sigma_m : float
        Standard deviation of a position per axis that the solver states, in the mean square.
    """

    frames: int
    read: int
    position_error_m: Array
    heading_error_rad: Array
    stated_sigma_m: float

    @property
    def read_rate(self) -> float:
        """Fraction of the frames that were decoded."""
        return self.read / self.frames

    @property
    def position_rms_m(self) -> float:
        """Root mean square error of a position per axis; nan without poses."""
        return _rms(self.position_error_m)

    @property
    def heading_rms_rad(self) -> float:
        """Root mean square error of the heading; nan without poses."""
        return _rms(self.heading_error_rad)


def _rms(values: Array) -> float:
    return math.sqrt(np.mean(values**2)) if len(values) else math.nan


def camera_model(setup: CameraSetup) -> Camera:
    """Return the camera of frames of a setup: pinhole and division model."""
    width, height = setup.size_px
    centre = ((width - 1) / 2, (height - 1) / 2)
    focal_px = setup.image_distance_m / setup.pixel_m
    corner_square = centre[0] ** 2 + centre[1] ** 2
    radial = -setup.lens.distortion * focal_px**2 / corner_square
    return Camera(setup.size_px, focal_px, centre, radial)


def measure_camera(setup: CameraSetup, frames: int = 20, seed: int = 0) -> CameraMeasurement:
    """Render frames at random positions and headings, decode them, and compare the poses.

    The camera moves at the speeds of the setup, in random directions of the image, and is tilted by
    its tilt in random directions.

    Raises
    ------
    InputError
        The number of frames is not positive, or the frames cannot be rendered.
    """
    if frames < 1:
        raise InputError(f"{frames} frames", hint="Give 1 or more")
    rng = np.random.default_rng([seed, 20240])
    manifest = _sheet(setup, rng)
    camera = camera_model(setup)
    heading = rng.uniform(-np.pi, np.pi, frames)
    direction = rng.uniform(-np.pi, np.pi, frames)
    ends = np.array(manifest.sheets[0].origin) + [[0, 0], manifest.sheets[0].size]
    middle = manifest.to_metres(0, ends.mean(axis=0)[None])[0]
    # Frames stay inside of the sheet, tilted ones as well.
    free_m = (SHEET_FIELDS / 2 - 1.0) * 2 * setup.corner_m
    path = CameraPath(
        position_m=middle + rng.uniform(-free_m, free_m, (frames, 2)) / math.sqrt(2),
        heading_rad=heading,
        velocity_mps=setup.speed_mps * np.stack([np.cos(direction), np.sin(direction)], axis=1),
        yaw_rate_rps=setup.yaw_rate_rps * rng.choice([-1.0, 1.0], frames),
    )
    tilt_direction = rng.uniform(-np.pi, np.pi)
    options = SimulationOptions(
        frames=frames,
        rate_hz=min(0.9 / setup.exposure_s, 1000.0),
        speed_mps=setup.speed_mps,
        exposure_s=setup.exposure_s,
        camera=camera,
        metres_per_px=setup.metres_per_px,
        pitch_rad=setup.tilt_rad * math.cos(tilt_direction),
        roll_rad=setup.tilt_rad * math.sin(tilt_direction),
        dot=setup.dot_pitches,
        jitter_m=setup.jitter_m,
        blur_px=static_blur_px(setup),
        noise=noise_levels(setup),
        paper_level=PAPER_LEVEL,
        contrast=setup.contrast,
        seed=seed,
    )
    session = simulate_path(manifest, options, path)
    known = camera if setup.is_calibrated else None
    solution = solve([session.frames], manifest, SolveOptions(camera=known))
    trajectory = solution.trajectories[0]
    index = np.searchsorted(session.truth.time_ns, trajectory.time_ns)
    error = trajectory.position[:, :2] - session.truth.position[index, :2]
    heading_error = heading_from_quaternion(trajectory.quaternion) - heading[index]
    stated = trajectory.covariance
    variance = np.trace(stated[:, :2, :2], axis1=1, axis2=2) / 2 if stated is not None else []
    return CameraMeasurement(
        frames=frames,
        read=len(index),
        position_error_m=error,
        heading_error_rad=wrap_angle(heading_error),
        stated_sigma_m=math.sqrt(np.mean(variance)) if len(variance) else math.nan,
    )


def _sheet(setup: CameraSetup, rng: np.random.Generator) -> Manifest:
    """Return a sheet of the setup's pitch, several fields wide, from anywhere in the pattern."""
    pitch_mm = setup.pitch_m * 1e3
    size = math.ceil(SHEET_FIELDS * 2 * setup.corner_m / setup.pitch_m)
    origin = rng.integers(1000, SECTION_LENGTH - size - 1000, 2)
    page_mm = ((size + 2) * pitch_mm,) * 2
    sheet = Sheet(
        id="rendered",
        origin=(int(origin[0]), int(origin[1])),
        size=(size, size),
        section=(31, 15),
        page_mm=(page_mm[0], page_mm[1]),
        first_mm=(1.5 * pitch_mm, 1.5 * pitch_mm),
    )
    offset_mm = pitch_mm * DOT_OFFSET_PITCHES
    return Manifest((sheet,), "anoto", pitch_mm, setup.dot_pitches * pitch_mm, offset_mm)
