"""Frames of a camera over printed dots, with all that is true of them.

The camera is the paper's (papers/dots.txt III-A): 188 x 120 px that are 0.046 mm wide on
the paper. What is simulated is light: ink lies where the printer left it, is seen through
pinhole and lens, blurred, lit unevenly, and counted with noise. Not simulated are gloss,
show-through and the light and shade of wrinkled paper.
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
from locatk.core.dots.simulation.optics import Exposer, Optics, Stand
from locatk.core.dots.simulation.paths import PATHS, Course, course
from locatk.core.dots.simulation.printed_paper import Paper
from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.paper import paper_size
from locatk.core.simulation import check_options
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

EPOCH_NS = 1_767_225_600_000_000_000
"""Start of every simulated session: 2026-01-01T00:00:00Z."""

SIZE_PX = (188, 120)
METRES_PER_PX = 0.046e-3

LENS_MM, PIXEL_MM = 5.5, 0.024
"""Focal length of the paper's lens, and its sensor's 6 um binned by four."""

FOCAL_PX = LENS_MM * (1 + PIXEL_MM / (METRES_PER_PX * 1e3)) / PIXEL_MM
"""Distance from lens to sensor, 348.7 px.

A thin lens that makes 0.024 mm of 0.046 mm stands 8.4 mm before the sensor and 16.0 mm
over the paper: 24.4 mm together, where the paper measures d = 24.0 mm. Its s1 = 9.7 and
s2 = 12.7 mm (Fig. 12) add up as well, but would make 0.046 mm 2.5 or 1.5 pixels wide.
"""

LENS_DISTORTION = 0.045
"""How much nearer to the centre the paper's lens draws a corner of the frame.

Its nominal 54 degrees over the 5.35 mm diagonal of the MT9V034: 5.5 mm times tan 27
degrees are 2.80 mm, and the corner lies at 2.68 mm.
"""

EXPOSURE_S = 1 / 7684
"""The paper's (III-A.2): 0.35 m/s smear a dot by one pixel."""

LARGEST_TILT = np.pi / 4
LARGEST_DOT = 2 / 3
"""Of the pitch: neighbours whose dots lean to each other touch beyond that."""


def camera(distortion: float = LENS_DISTORTION) -> Camera:
    """The paper's camera; ``distortion`` is by which share its corners are drawn in."""
    centre = ((SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2)
    corner_square = centre[0] ** 2 + centre[1] ** 2
    return Camera(SIZE_PX, FOCAL_PX, centre, -distortion * FOCAL_PX**2 / corner_square)


def sheet(codec: str = "anoto") -> Manifest:
    """An A4 sheet as ``locatk print pattern`` prints it.

    It lies in the middle of the plane, where each digit sequence is under way.
    """
    raster = layout.snap(0.508, None, 300)
    _, page_mm = paper_size("A4")
    page = layout.lay_out(page_mm, 5.0, raster)
    return layout.manifest(
        raster, page.sheets("simulated", (SECTION_LENGTH // 2, SECTION_LENGTH // 4)), codec
    )


@dataclass(frozen=True)
class SimulationOptions:
    """What to simulate.

    Attributes
    ----------
    frames : int
        At least 1.
    rate_hz : float
    path : str
        ``"curve"``, ``"random"`` or ``"still"``; see :mod:`~locatk.core.dots.simulation.paths`.
    speed_mps : float
        Along the curve.
    exposure_s : float
        Speed and turning blur a frame over this time.
    motion_px : float or None
        Smear of every frame in pixels instead, along its way (at rest: along any direction).
    camera : Camera
    metres_per_px : float
        On the paper, at the camera's centre, where it looks straight down.
    pitch_rad, roll_rad : float
        How the camera is mounted askew: turns about its axes to the right and down in the
        image.
    tilt_rad : float
        Each frame is tilted by up to this besides, in any direction.
    dot : float
        Diameter in pitches; the paper's 1/6 grows in print and on rough paper.
    missing, dust : float
        Dots that are not there, and specks that should not be, as a share of the dots.
    jitter_m : float
        Standard deviation of a dot's place along each axis.
    printer_scale : (x, y) or None
        True over nominal length on the paper; None for what the manifest says.
    blur_px : float
        Standard deviation of the defocus.
    noise : float
        Standard deviation in grey values.
    paper_level : float
        Grey value of well lit paper.
    contrast : float
        How much darker ink is; 1 is black.
    vignette, gradient : float
        By how much a corner and a rim are darker than the middle.
    sheet : int
        Number of the sheet of the manifest; of tiles, all are seen.
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
        # Beyond the rim as well, from where light is blurred into the frame.
        rim_px = 0.75 * float(np.linalg.norm(self.camera.size))
        bend = 1 + min(self.camera.radial_px, 0.0) * rim_px**2
        check_options(
            self,
            (
                ("frames", self.frames >= 1, "at least 1"),
                ("rate_hz", 0 < self.rate_hz < np.inf, "a number above 0"),
                ("path", self.path in PATHS, "one of " + ", ".join(PATHS)),
                ("speed_mps", 0 <= self.speed_mps < np.inf, "0 or more"),
                ("exposure_s", 0 <= self.exposure_s * self.rate_hz < 1, "less than a frame's time"),
                ("motion_px", self.motion_px is None or 0 <= self.motion_px <= 100, "0 to 100"),
                ("camera", bend > 0.2, "a camera whose lens does not fold the frame"),
                ("metres_per_px", 0 < self.metres_per_px < np.inf, "a number above 0"),
                (
                    "tilt_rad",
                    tilt <= LARGEST_TILT,
                    f"at most {LARGEST_TILT:.4g} with pitch and roll",
                ),
                ("dot", 0 < self.dot <= LARGEST_DOT, "a share of the pitch of at most 2/3"),
                ("missing", 0 <= self.missing <= 1, "0 to 1"),
                ("dust", 0 <= self.dust <= 1, "0 to 1"),
                ("jitter_m", 0 <= self.jitter_m < 1e-3, "0 to below 0.001"),
                ("printer_scale", all(0.5 < s < 2 for s in scale), "two numbers about 1"),
                ("blur_px", 0 <= self.blur_px <= 20, "0 to 20"),
                ("noise", 0 <= self.noise < np.inf, "0 or more"),
                ("paper_level", 0 < self.paper_level <= 255, "up to 255"),
                ("contrast", 0 <= self.contrast <= 1, "0 to 1"),
                ("vignette", 0 <= self.vignette <= 1, "0 to 1"),
                ("gradient", 0 <= self.gradient <= 1, "0 to 1"),
                ("seed", self.seed >= 0, "0 or more"),
            ),
        )


@dataclass(frozen=True)
class SimulatedSession:
    """A session that never was.

    Attributes
    ----------
    frames : Frames
        Its images are rendered when they are asked for, each time anew.
    truth : Trajectory
        Where the optical axis met the paper, and where the image's right pointed there.
    manifest : Manifest
        As it was given; it knows a ``printer_scale`` of the options only if it says so.
    camera : Camera
    """

    frames: Frames
    truth: Trajectory
    manifest: Manifest
    camera: Camera


class Rendered(Sequence[NDArray[np.uint8]]):
    """Images (height, width) uint8 that are made when they are taken.

    The noise of one depends on its number alone, so that any may be taken at any time.
    """

    def __init__(self, exposer: Exposer, paper: Paper, at: Course, stands: list[Stand]) -> None:
        self._exposer, self._paper, self._course, self._stands = exposer, paper, at, stands

    def __len__(self) -> int:
        return len(self._stands)

    @overload
    def __getitem__(self, number: int) -> NDArray[np.uint8]: ...
    @overload
    def __getitem__(self, number: slice) -> list[NDArray[np.uint8]]: ...
    def __getitem__(self, number: int | slice) -> NDArray[np.uint8] | list[NDArray[np.uint8]]:
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(len(self)))]
        number = range(len(self))[number]
        stand = self._stands[number]
        reach = self._exposer.reach_m(stand) + float(np.linalg.norm(stand.shift_m))
        centres, radii = self._paper.marks(self._course.position[number], reach)
        rng = np.random.default_rng([self._paper.seed, 2, number])
        return self._exposer.expose(stand, centres, radii, rng)

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
    time_s = np.arange(options.frames) / options.rate_hz
    numbers = _seen(manifest, options.sheet)
    paper = replace(manifest, scale=options.printer_scale or manifest.scale)
    corners = np.concatenate([_corners(paper, number) for number in numbers])
    low, high = corners.min(axis=0), corners.max(axis=0)
    # A frame at the rim is full of dots all the same, where the sheet is large enough.
    inset = np.minimum(options.metres_per_px * np.linalg.norm(options.camera.size) / 2 * 1.2,
                       (high - low) / 2)  # fmt: skip
    at = course(options.path, time_s, low + inset, high - inset, options.speed_mps, options.seed)
    return over(manifest, options, at)


def over(manifest: Manifest, options: SimulationOptions, at: Course) -> SimulatedSession:
    """The same for a course of one's own, which may leave the sheet."""
    numbers = _seen(manifest, options.sheet)
    paper = Paper(
        replace(manifest, scale=options.printer_scale or manifest.scale),
        numbers,
        options.dot,
        options.missing,
        options.dust,
        options.jitter_m,
        options.seed,
    )
    # A stream of random numbers for each matter: more noise leaves the poses as they are.
    tilting, aside = (np.random.default_rng([options.seed, k]) for k in (3, 4))
    light = np.random.default_rng([options.seed, 5]).uniform(-np.pi, np.pi)
    optics = Optics(
        options.camera,
        options.metres_per_px,
        options.blur_px,
        options.paper_level,
        options.contrast,
        options.vignette,
        options.gradient,
        light,
        options.noise,
    )
    count = len(at.position)
    lean = tilting.uniform(0, 1, count) * options.tilt_rad
    towards = tilting.uniform(-np.pi, np.pi, count)
    any_way = aside.uniform(-np.pi, np.pi, count)
    stands = [
        Stand(
            float(at.heading[k]),
            options.pitch_rad + lean[k] * np.cos(towards[k]),
            options.roll_rad + lean[k] * np.sin(towards[k]),
            *_motion(options, at.velocity[k], at.turn_rate[k], any_way[k]),
        )
        for k in range(count)
    ]
    time_ns = EPOCH_NS + np.rint(np.arange(count) / options.rate_hz * 1e9).astype(np.int64)
    frames = Frames(
        options.device,
        time_ns,
        tuple(map(str, range(count))),
        Rendered(Exposer(optics), paper, at, stands),
    )
    truth = Trajectory(
        options.device,
        manifest.frame(numbers[0]),
        time_ns,
        np.c_[at.position, np.zeros(count)],
        quaternion_from_heading(at.heading),
        np.zeros((count, 6, 6)),
    )
    return SimulatedSession(frames, truth, manifest, options.camera)


def _motion(
    options: SimulationOptions, velocity: Array, turn_rate: float, any_way: float
) -> tuple[tuple[float, float], float]:
    """Shift in metres and turn in radians while the shutter is open."""
    if options.motion_px is None:
        shift = velocity * options.exposure_s
        return (float(shift[0]), float(shift[1])), float(turn_rate * options.exposure_s)
    speed = np.linalg.norm(velocity)
    way = velocity / speed if speed > 0 else np.array([np.cos(any_way), np.sin(any_way)])
    shift = way * options.motion_px * options.metres_per_px
    return (float(shift[0]), float(shift[1])), 0.0


def _seen(manifest: Manifest, number: int) -> tuple[int, ...]:
    """Numbers of the sheets in the frame of this one."""
    if not 0 <= number < len(manifest.sheets):
        raise InputError(
            f"no sheet number {number}", hint=f"The manifest has 0 to {len(manifest.sheets) - 1}"
        )
    frame = manifest.frame(number)
    return tuple(k for k in range(len(manifest.sheets)) if manifest.frame(k) == frame)


def _corners(manifest: Manifest, number: int) -> Array:
    """(4, 2) corners of the dots of a sheet in metres of its frame."""
    one = manifest.sheets[number]
    low, high = np.array(one.origin), np.array(one.origin) + one.size - 1
    grid = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return manifest.to_metres(number, grid)
