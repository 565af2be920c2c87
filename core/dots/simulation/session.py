"""Simulation of the frames of a camera over printed dots, with ground truth.

The camera is that of the paper (section III-A): 188 x 120 px that are 0.046 mm wide on the paper.
Light is simulated: the ink as printed is projected through pinhole and lens, blurred, unevenly
illuminated, and converted to grey values with noise. Not simulated are gloss, show-through, and
the shading of wrinkled paper.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import SECTION_LENGTH
from locatk.core.dots.drawing import layout
from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Manifest
from locatk.core.dots.simulation.decoys import decoys as decoys
from locatk.core.dots.simulation.optics import CameraPose, Exposer, Optics
from locatk.core.dots.simulation.paths import PATHS, CameraPath, RandomSource, camera_path
from locatk.core.dots.simulation.printed_paper import PrintedPaper
from locatk.core.errors import InputError
from locatk.core.paper_sizes import paper_size
from locatk.core.simulation import (
    MAX_SAMPLES,
    check_options,
    check_session_size,
    exact_trajectory,
    random_stream,
    require_fraction,
    require_not_negative,
    require_positive,
    stamps_ns,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

FRAME_SIZE_PX = (188, 120)
"""Width and height of the paper's frames (III-A)."""

METRES_PER_PX = 0.046e-3
"""Width of a pixel on the paper (III-A)."""

LENS_MM, PIXEL_MM = 5.5, 0.024
"""Focal length of the paper's lens, and pixel of its sensor: 6 um, binned by four."""

FOCAL_PX = LENS_MM * (1 + PIXEL_MM / (METRES_PER_PX * 1e3)) / PIXEL_MM
"""Distance from lens to sensor, 348.7 px.

A thin lens that images 0.046 mm onto 0.024 mm is 8.4 mm from the sensor and 16.0 mm above the
paper: 24.4 mm in total, where the paper measures d = 24.0 mm. Its s1 = 9.7 and s2 = 12.7 mm
(Fig. 12) have a similar sum, but 0.046 mm would then be 2.5 or 1.5 pixels wide.
"""

LENS_DISTORTION = 0.045
"""Relative displacement of a corner of the frame towards the centre by the paper's lens.

Its nominal field of view is 54 degrees over the 5.35 mm diagonal of the MT9V034: 5.5 mm times
tan 27 degrees are 2.80 mm, and the corner is at 2.68 mm.
"""

EXPOSURE_S = 1 / 7684
"""Exposure time of the paper (III-A.2): at 0.35 m/s a dot is blurred by one pixel."""

MAX_TILT_RAD = np.pi / 4
"""Largest angle between the optical axis and the vertical."""

MAX_DOT_PITCHES = 2 / 3
"""Largest diameter of a dot: dots that are displaced towards each other touch beyond that."""


MAX_MOTION_PX = 100.0
"""Longest motion blur that is simulated [px]: a frame is rendered several times per pixel of it."""


def camera(distortion: float = LENS_DISTORTION) -> Camera:
    """Return the paper's camera; ``distortion`` displaces its corners towards the centre."""
    centre = ((FRAME_SIZE_PX[0] - 1) / 2, (FRAME_SIZE_PX[1] - 1) / 2)
    corner_square = centre[0] ** 2 + centre[1] ** 2
    return Camera(FRAME_SIZE_PX, FOCAL_PX, centre, -distortion * FOCAL_PX**2 / corner_square)


def sheet(codec: str = "anoto") -> Manifest:
    """Return an A4 sheet as ``locatk print pattern`` prints it, in the middle of the plane."""
    raster = layout.snap(0.508, None, 300)
    _, page_mm = paper_size("A4")
    page = layout.lay_out(page_mm, 5.0, raster)
    return layout.manifest(
        raster, page.sheets("simulated", (SECTION_LENGTH // 2, SECTION_LENGTH // 4)), codec
    )


@dataclass(frozen=True)
class SimulationOptions:
    """Options of simulated frames.

    Attributes
    ----------
    frames : int
        Number of frames, at least 1.
    rate_hz : float
    path : str
        ``"curve"``, ``"random"`` or ``"still"``; see :mod:`~locatk.core.dots.simulation.paths`.
    speed_mps : float
        Speed along the curve.
    exposure_s : float
        Exposure time, for the blur by motion and rotation.
    motion_px : float or None
        Motion blur of every frame instead, along the path (at rest: in a random direction).
    camera : Camera
    metres_per_px : float
        Width of a pixel on the paper at the camera's centre, if it looks straight down.
    pitch_rad, roll_rad : float
        Rotations of the mounted camera about the right and the downward axis of the image.
    tilt_rad : float
        Largest additional tilt of a frame, in a random direction.
    dot : float
        Diameter in pitches; the paper's 1/6 grows in print and on rough paper.
    missing, dust : float
        Numbers of missing dots and of specks, as fractions of the number of dots.
    jitter_m : float
        Standard deviation of the position of a dot along each axis.
    printer_scale : (x, y) or None
        True over nominal length on the paper; None for that of the manifest.
    blur_px : float
        Standard deviation of the defocus.
    noise : float
        Standard deviation of a pixel in grey values.
    paper_level : float
        Grey value of well illuminated paper.
    contrast : float
        Contrast of the ink; 1 is black.
    vignette, gradient : float
        Relative loss of light in the corners, and on one side.
    sheet : int
        Number of the sheet of the manifest; all tiles of its floor are visible.
    device : str
    seed : int
        At least 0.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    frames: int = 100
    rate_hz: float = 50.0
    path: str = "curve"
    speed_mps: float = 0.1
    exposure_s: float = EXPOSURE_S
    motion_px: float | None = None
    camera: Camera = field(default_factory=camera)
    metres_per_px: float = METRES_PER_PX
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    tilt_rad: float = 0.0
    dot: float = 0.30
    missing: float = 0.0
    dust: float = 0.0
    jitter_m: float = 0.0
    printer_scale: tuple[float, float] | None = None
    blur_px: float = 0.6
    noise: float = 2.0
    paper_level: float = 210.0
    contrast: float = 0.75
    vignette: float = 0.0
    gradient: float = 0.0
    sheet: int = 0
    device: str = "camera"
    seed: int = 0

    def __post_init__(self) -> None:
        tilt = np.hypot(self.pitch_rad, self.roll_rad) + abs(self.tilt_rad)
        scale = self.printer_scale or (1.0, 1.0)
        max_blur_m = MAX_MOTION_PX * self.metres_per_px
        is_blur_given = self.path != "curve" or self.motion_px is not None
        # Light from beyond the frame is blurred into it, so that the lens is evaluated there, too.
        margin_px = 0.75 * float(np.linalg.norm(self.camera.size))
        lens_slope = 1 + min(self.camera.radial_px, 0.0) * margin_px**2
        check_options(
            self,
            (
                ("frames", 1 <= self.frames <= MAX_SAMPLES, f"1 to {MAX_SAMPLES}"),
                *require_positive(self, "rate_hz", "metres_per_px"),
                *require_not_negative(self, "speed_mps", "noise", "seed"),
                *require_fraction(self, "missing", "dust", "contrast", "vignette", "gradient"),
                ("path", self.path in PATHS, "one of " + ", ".join(PATHS)),
                ("exposure_s", 0 <= self.exposure_s * self.rate_hz < 1, "less than a frame's time"),
                (
                    "speed_mps",
                    is_blur_given or self.speed_mps * self.exposure_s <= max_blur_m,
                    f"a motion blur of at most {MAX_MOTION_PX:g} px, by speed and exposure",
                ),
                (
                    "motion_px",
                    self.motion_px is None or 0 <= self.motion_px <= MAX_MOTION_PX,
                    f"0 to {MAX_MOTION_PX:g}",
                ),
                ("camera", lens_slope > 0.2, "a camera whose lens does not fold the frame"),
                (
                    "tilt_rad",
                    tilt <= MAX_TILT_RAD,
                    f"at most {MAX_TILT_RAD:.4g} with pitch and roll",
                ),
                ("dot", 0 < self.dot <= MAX_DOT_PITCHES, "a fraction of the pitch of at most 2/3"),
                ("jitter_m", 0 <= self.jitter_m < 1e-3, "0 to below 0.001"),
                ("printer_scale", all(0.5 < s < 2 for s in scale), "two numbers about 1"),
                ("blur_px", 0 <= self.blur_px <= 20, "0 to 20"),
                ("paper_level", 0 < self.paper_level <= 255, "up to 255"),
            ),
        )


@dataclass(frozen=True)
class SimulatedSession:
    """Simulated frames and their ground truth.

    Attributes
    ----------
    frames : Frames
        Each access to an image renders it again.
    truth : Trajectory
        Intersections of the optical axis with the paper, and headings of the image's right there.
    manifest : Manifest
        Knowledge of a user: without a ``printer_scale`` of the options unless it was stated.
    camera : Camera
    """

    frames: Frames
    truth: Trajectory
    manifest: Manifest
    camera: Camera


class RenderedImages(Sequence[NDArray[np.uint8]]):
    """Images (height, width) uint8 that are rendered on access.

    The noise of an image depends on its number alone, so that they can be accessed in any order.
    """

    def __init__(
        self, exposer: Exposer, paper: PrintedPaper, path: CameraPath, poses: list[CameraPose]
    ) -> None:
        self._exposer, self._paper, self._path, self._poses = exposer, paper, path, poses

    def __len__(self) -> int:
        return len(self._poses)

    @overload
    def __getitem__(self, number: int) -> NDArray[np.uint8]: ...
    @overload
    def __getitem__(self, number: slice) -> list[NDArray[np.uint8]]: ...
    def __getitem__(self, number: int | slice) -> NDArray[np.uint8] | list[NDArray[np.uint8]]:
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(len(self)))]
        number = range(len(self))[number]
        pose = self._poses[number]
        radius_m = self._exposer.visible_radius_m(pose) + float(np.linalg.norm(pose.shift_m))
        centres, radii = self._paper.marks(self._path.position_m[number], radius_m)
        rng = random_stream(self._paper.seed, RandomSource.PIXELS, number)
        return self._exposer.expose(pose, centres, radii, rng)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return (self[k] for k in range(len(self)))


def simulate(
    manifest: Manifest | None = None, options: SimulationOptions | None = None
) -> SimulatedSession:
    """Simulate a session over a sheet (default: :func:`sheet`).

    The same manifest and options give the same session.

    Raises
    ------
    InputError
        The manifest has no such sheet, or no such codec.
    """
    options, manifest = options or SimulationOptions(), manifest or sheet()
    check_session_size(options.frames, options.frames / options.rate_hz)
    time_s = np.arange(options.frames) / options.rate_hz
    numbers = _visible_sheets(manifest, options.sheet)
    true_manifest = replace(manifest, scale=options.printer_scale or manifest.scale)
    corners = np.concatenate([_corners(true_manifest, number) for number in numbers])
    low, high = corners.min(axis=0), corners.max(axis=0)
    # Frames at the edge are full of dots if the sheet is large enough.
    half_diagonal_m = options.metres_per_px * np.linalg.norm(options.camera.size) / 2
    inset = np.minimum(half_diagonal_m * 1.2, (high - low) / 2)
    path = camera_path(
        options.path, time_s, low + inset, high - inset, options.speed_mps, options.seed
    )
    return simulate_path(manifest, options, path)


def simulate_path(
    manifest: Manifest, options: SimulationOptions, path: CameraPath
) -> SimulatedSession:
    """Simulate a session along a given path, which may leave the sheet; see :func:`simulate`."""
    numbers = _visible_sheets(manifest, options.sheet)
    paper = PrintedPaper(
        replace(manifest, scale=options.printer_scale or manifest.scale),
        numbers,
        options.dot,
        options.missing,
        options.dust,
        options.jitter_m,
        options.seed,
    )
    tilt_rng = random_stream(options.seed, RandomSource.TILT)
    blur_rng = random_stream(options.seed, RandomSource.BLUR_DIRECTION)
    light_rad = random_stream(options.seed, RandomSource.LIGHT).uniform(-np.pi, np.pi)
    optics = Optics(
        options.camera,
        options.metres_per_px,
        options.blur_px,
        options.paper_level,
        options.contrast,
        options.vignette,
        options.gradient,
        light_rad,
        options.noise,
    )
    count = len(path.position_m)
    tilt = tilt_rng.uniform(0, 1, count) * options.tilt_rad
    tilt_direction = tilt_rng.uniform(-np.pi, np.pi, count)
    blur_direction = blur_rng.uniform(-np.pi, np.pi, count)
    poses = [
        CameraPose(
            float(path.heading_rad[k]),
            options.pitch_rad + tilt[k] * np.cos(tilt_direction[k]),
            options.roll_rad + tilt[k] * np.sin(tilt_direction[k]),
            *_motion(options, path.velocity_mps[k], path.yaw_rate_rps[k], blur_direction[k]),
        )
        for k in range(count)
    ]
    time_ns = stamps_ns(np.arange(count) / options.rate_hz)
    frames = Frames(
        options.device,
        time_ns,
        tuple(map(str, range(count))),
        RenderedImages(Exposer(optics), paper, path, poses),
    )
    frame = manifest.frame(numbers[0])
    truth = exact_trajectory(options.device, frame, time_ns, path.position_m, path.heading_rad)
    return SimulatedSession(frames, truth, manifest, options.camera)


def _motion(
    options: SimulationOptions, velocity: Array, yaw_rate: float, rest_direction: float
) -> tuple[tuple[float, float], float]:
    """Return the shift in metres and the rotation in radians during the exposure."""
    if options.motion_px is None:
        shift = velocity * options.exposure_s
        return (float(shift[0]), float(shift[1])), float(yaw_rate * options.exposure_s)
    speed = np.linalg.norm(velocity)
    direction = (
        velocity / speed
        if speed > 0
        else np.array([np.cos(rest_direction), np.sin(rest_direction)])
    )
    shift = direction * options.motion_px * options.metres_per_px
    return (float(shift[0]), float(shift[1])), 0.0


def _visible_sheets(manifest: Manifest, number: int) -> tuple[int, ...]:
    """Return the numbers of the sheets in the frame of this one."""
    if not 0 <= number < len(manifest.sheets):
        raise InputError(
            f"no sheet number {number}", hint=f"The manifest has 0 to {len(manifest.sheets) - 1}"
        )
    frame = manifest.frame(number)
    return tuple(k for k in range(len(manifest.sheets)) if manifest.frame(k) == frame)


def _corners(manifest: Manifest, number: int) -> Array:
    """Return the corners (4, 2) of the dots of a sheet in metres of its frame."""
    sheet = manifest.sheets[number]
    low, high = np.array(sheet.origin), np.array(sheet.origin) + sheet.size - 1
    grid = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return manifest.to_metres(number, grid)
