"""Figures of the planning of dot cameras: predictions against rendered and published frames.

Each of twenty tasks (fixed seeds) has a sensor, a lens, a distance, blur, noise, a speed, a tilt
and a printer. The prediction is the closed form of :mod:`locatk.core.dots.design.camera`. Frames of
the same setup are rendered at random poses and decoded by the solver; their errors are those
against the poses that were rendered. Twenty more tasks are near the limits of the decoder, for read
rates.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import codec
from locatk.core.dots.design.camera import CameraReport, design_camera, suggest_camera
from locatk.core.dots.design.camera_measurement import CameraMeasurement, measure_camera
from locatk.core.dots.design.camera_optics import distance_for_field, window_diagonal_m
from locatk.core.dots.design.camera_setup import CameraSetup, Lens, Sensor
from locatk.core.dots.localization.frames import dot_correspondences, localize_frames
from locatk.core.errors import MissingDataError
from locatk.formats.benchmarks.figures import Figure, measure_or_explain
from locatk.formats.benchmarks.plan.ratios import TAIL_RATIO, ratio_figures

Array = NDArray[np.float64]

TASKS, FRAMES, HARD_FRAMES = 20, 60, 20
"""Tasks of each kind, and rendered frames of each."""

FIRST_SEED = 25_300

SENSORS = (
    Sensor("MT9V034, 4 x 4", (188, 120), 24e-6, 60.0),
    Sensor("OV7251, 4 x 4", (160, 120), 12e-6, 100.0),
    Sensor("OV9281, 4 x 4", (320, 200), 12e-6, 120.0),
    Sensor("OV7251, 2 x 2", (320, 240), 6e-6, 100.0),
)
"""Binned sensors: frames of full size take a second each to render."""

PUBLISHED_PITCH_PX = 20.2
"""Pitch of the dots in frame.bmp, the image a.bmp of cellulo-localization, 320 x 241 px."""

SPLITS = 200
"""Number of random divisions of the dots of the published frame into halves."""

OUTLIER_SIGMAS, REJECTION_ROUNDS = 3.5, 4
"""Distance of a dot of this frame from the fit that rejects it, and number of fits."""

PUBLISHED_JITTER_M = 10e-6
"""Assumed jitter of its printer, the default of a design: nothing is known about it."""


@dataclass(frozen=True)
class TaskResult:
    """Prediction and measurement of a task."""

    report: CameraReport
    measured: CameraMeasurement

    @property
    def position_ratio(self) -> float:
        """Predicted standard deviation over the root mean square error of the position."""
        return self.report.position_sigma_m / self.measured.position_rms_m

    @property
    def heading_ratio(self) -> float:
        """Predicted standard deviation over the root mean square error of the heading."""
        return self.report.heading_sigma_rad / self.measured.heading_rms_rad


def make_task(number: int) -> CameraSetup:
    """Draw a task."""
    rng = np.random.default_rng(FIRST_SEED + number)
    sensor = SENSORS[number % len(SENSORS)]
    speed_mps = float(rng.uniform(0.0, 1.0))
    setup = suggest_camera(
        sensor,
        distance_m=float(rng.uniform(0.012, 0.04)),
        window_dots=int(rng.integers(9, 15)),
        f_number=float(rng.uniform(1.8, 4.0)),
        distortion=float(rng.uniform(0.0, 0.05)),
        focus_error_m=float(rng.uniform(0.0, 0.6e-3)),
        lens_blur_m=float(rng.uniform(0.2, 0.7)) * sensor.pixel_m,
        noise_levels=float(rng.uniform(1.0, 8.0)),
        dot_pitches=float(rng.uniform(0.22, 0.34)),
        jitter_m=float(10 ** rng.uniform(-6.5, -5.0)),
        tilt_rad=math.radians(float(rng.uniform(0.0, 10.0))),
        speed_mps=speed_mps,
        yaw_rate_rps=float(rng.uniform(0.0, 5.0)),
        is_calibrated=bool(rng.integers(2)),
    )
    motion_pitches = float(rng.uniform(0.02, 0.4))
    return replace(setup, exposure_s=motion_pitches * setup.pitch_m / setup.corner_speed_mps)


def run_task(number: int, frames: int = FRAMES) -> TaskResult:
    """Predict and measure a task."""
    setup = make_task(number)
    return TaskResult(design_camera(setup), measure_camera(setup, frames, FIRST_SEED + number))


def make_hard_task(number: int) -> CameraSetup:
    """Draw a task with few dots, much blur, motion or noise, of which some cannot be read."""
    rng = np.random.default_rng(FIRST_SEED + 1000 + number)
    setup = replace(make_task(number), tilt_rad=0.0, focus_error_m=0.0)
    pitch_on_sensor_m = setup.pitch_m * setup.magnification
    kind = number % 4
    if kind == 0:
        return replace(setup, lens_blur_m=float(rng.uniform(0.22, 0.38)) * pitch_on_sensor_m)
    if kind == 1:
        factor = float(rng.uniform(0.6, 1.1)) * setup.pitch_m / setup.motion_m
        return replace(setup, exposure_s=setup.exposure_s * factor)
    if kind == 2:
        return replace(setup, noise_levels=float(rng.uniform(20.0, 60.0)), dot_pitches=1 / 6)
    window_dots = int(rng.integers(6, 10))
    side_m = window_diagonal_m(window_dots, setup.pitch_m)
    return replace(setup, distance_m=distance_for_field(setup, side_m))


def hard_read_rates(number: int) -> tuple[float, float]:
    """Return the predicted and the reached read rate of a hard task."""
    setup = make_hard_task(number)
    measured = measure_camera(setup, HARD_FRAMES, FIRST_SEED + 1000 + number)
    return design_camera(setup).read_rate, measured.read_rate


def figures(data: Path) -> list[Figure]:
    """Return the figures; ``data`` is the folder of the published recordings."""
    results = [run_task(number) for number in range(TASKS)]
    return [
        *task_figures(results),
        *read_rate_figures(),
        *measure_or_explain(
            lambda: published_frame_figures(data / "dots" / "frame.bmp"),
            Figure("dots: frame.bmp: scatter of a dot, predicted / residuals", None, "", ""),
            Figure("dots: frame.bmp: sigma of x and y, predicted / halves", None, "", ""),
        ),
    ]


def task_figures(results: list[TaskResult]) -> Iterable[Figure]:
    """Yield the ratios of predicted to reached accuracy, and read rates."""
    how = f"{len(results)} tasks of {FRAMES} rendered frames, error against the rendered pose"
    for name, ratios in (
        ("position", [result.position_ratio for result in results]),
        ("heading", [result.heading_ratio for result in results]),
    ):
        yield from ratio_figures(f"dots: {name}, predicted / reached", ratios, how)
    predicted = [100 * result.report.read_rate for result in results]
    reached = [100 * result.measured.read_rate for result in results]
    worst = float(np.abs(np.subtract(predicted, reached)).max())
    yield Figure("dots: frames read, largest difference to the prediction", worst, "%", how)


def read_rate_figures() -> Iterable[Figure]:
    """Yield predicted and reached read rates of tasks near the limits of the decoder."""
    rates = 100 * np.array([hard_read_rates(number) for number in range(TASKS)])
    how = (
        f"{TASKS} tasks of {HARD_FRAMES} rendered frames: blur of 0.22 to 0.38 pitches, motion of "
        "0.6 to 1.1 pitches, noise of 20 to 60 grey values, or 6 to 9 dots in any direction"
    )
    yield Figure(
        "dots: frames read near the limits, predicted", float(rates[:, 0].mean()), "%", how
    )
    yield Figure("dots: frames read near the limits, reached", float(rates[:, 1].mean()), "%", how)
    difference = float(np.abs(rates[:, 0] - rates[:, 1]).mean())
    yield Figure("dots: frames read near the limits, mean difference", difference, "%", how)


# ---- the published frame


def published_frame_setup(noise: float) -> CameraSetup:
    """Return a camera with the size and the scale of frame.bmp; its lens was not published."""
    sensor = Sensor("MT9V034, 2 x 2", (320, 241), 12e-6, 60.0)
    magnification = PUBLISHED_PITCH_PX * sensor.pixel_m / 0.508e-3
    return CameraSetup(
        sensor,
        Lens(5.5e-3),
        distance_m=5.5e-3 * (1 + 1 / magnification),
        exposure_s=1 / 7684,
        noise_levels=noise,
        jitter_m=PUBLISHED_JITTER_M,
        is_calibrated=False,
    )


def pixel_noise(image: NDArray[np.uint8]) -> float:
    """Estimate the noise of an image (Immerkaer, CVIU 64 (1996) 300), median instead of mean."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], float)
    response = cv2.filter2D(image.astype(float), -1, kernel)
    return float(np.median(np.abs(response)) / 0.6745 / 6)


def published_frame_figures(path: Path) -> Iterable[Figure]:
    """Yield the prediction for the published frame over what the frame itself shows.

    Raises
    ------
    MissingDataError
        There is no such file.
    """
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise MissingDataError("no published frame", file=path)
    frame = np.asarray(image, np.uint8)
    report = design_camera(published_frame_setup(pixel_noise(frame)))
    code = codec("libdots")
    (dots,) = dot_correspondences(frame[None], code)
    centre = (np.array(frame.shape[::-1]) - 1) / 2
    scatter = measure_scatter(dots.pixels - centre, dots.grid)
    localized = localize_frames(frame[None], code)
    stated = np.sqrt(np.diag(localized.covariance[0]))
    pitch_m = report.setup.pitch_m
    position = report.position_sigma_m / pitch_m
    residuals = (
        f"{len(dots.pixels)} dots about a homography with a lens; assumed jitter of the printer"
    )
    residuals += f" {PUBLISHED_JITTER_M * 1e6:g} um"
    halves = f"poses from {SPLITS} random halves of the dots, by OpenCV"
    solver = "the solver's counts errors that neighbouring dots have in common as well"
    for name, value, how in (
        (
            "scatter of a dot, predicted / residuals",
            report.dot_sigma_m / pitch_m / scatter.dot_pitches,
            residuals,
        ),
        ("sigma of x and y, predicted / halves", position / scatter.position_pitches, halves),
        (
            "sigma of the heading, predicted / halves",
            report.heading_sigma_rad / scatter.heading_rad,
            halves,
        ),
        (
            "sigma of x and y, predicted / of the solver",
            position / math.sqrt((stated[0] ** 2 + stated[1] ** 2) / 2),
            solver,
        ),
        (
            "sigma of the heading, predicted / of the solver",
            report.heading_sigma_rad / stated[2],
            solver,
        ),
    ):
        label = f"dots: frame.bmp: {name}"
        yield Figure(label, value, "", f"{how}; goal 0.5 to 2", 1 / TAIL_RATIO, "higher")


@dataclass(frozen=True)
class FrameScatter:
    """Scatter of the dots of one frame, and of poses from halves of them, for the whole frame."""

    dot_pitches: float
    position_pitches: float
    heading_rad: float


def measure_scatter(pixels: Array, grid: Array) -> FrameScatter:
    """Measure the scatter of dots (n, 2), in px from the centre of the frame, about their grid.

    A homography and a lens are fitted with OpenCV: nothing is shared with the solver. The
    difference of the poses of two halves has four times the variance of the pose of all dots.
    """
    points = pixels / float(np.linalg.norm(pixels, axis=1).max())
    sigma, straight = math.inf, points
    for radial in np.linspace(-0.1, 0.1, 81):
        candidate = points / (1 + radial * (points**2).sum(axis=1, keepdims=True))
        homography, _ = cv2.findHomography(candidate, grid, cv2.LMEDS)
        # The median of a sum of two squares is 2 ln 2 variances.
        squared = (_residual(homography, candidate, grid) ** 2).sum(axis=1)
        smallest = math.sqrt(np.median(squared) / (2 * math.log(2)))
        if smallest < sigma:
            sigma, straight = smallest, candidate
    # The smallest median is too small; it only begins the rejection of outliers.
    homography, _ = cv2.findHomography(straight, grid, cv2.LMEDS)
    is_inlier = np.ones(len(grid), bool)
    for _ in range(REJECTION_ROUNDS):
        squared = (_residual(homography, straight, grid) ** 2).sum(axis=1)
        is_inlier = squared < (OUTLIER_SIGMAS * sigma) ** 2
        homography, _ = cv2.findHomography(straight[is_inlier], grid[is_inlier], 0)
        squares = (_residual(homography, straight, grid)[is_inlier] ** 2).sum()
        # Eight parameters of the homography, and one of the lens.
        sigma = math.sqrt(squares / (2 * is_inlier.sum() - 9))
    straight, grid = straight[is_inlier], grid[is_inlier]
    rng = np.random.default_rng(FIRST_SEED)
    differences = []
    for _ in range(SPLITS):
        order = rng.permutation(len(grid))
        halves = order[: len(grid) // 2], order[len(grid) // 2 :]
        poses = [_pose_of(straight[half], grid[half]) for half in halves]
        differences.append(poses[0] - poses[1])
    x, y, heading = np.sqrt(np.mean(np.square(differences), axis=0)) / 2
    return FrameScatter(sigma, math.sqrt((x * x + y * y) / 2), float(heading))


def _residual(homography: Array, points: Array, grid: Array) -> Array:
    projected: Array = cv2.perspectiveTransform(points[None], homography)[0]
    return projected - grid


def _pose_of(points: Array, grid: Array) -> Array:
    """Return position (x, y) and heading of the frame's centre on the grid."""
    homography, _ = cv2.findHomography(points, grid, 0)
    ends = cv2.perspectiveTransform(np.array([[[0.0, 0.0], [1e-3, 0.0]]]), homography)[0]
    right = ends[1] - ends[0]
    return np.array([*ends[0], math.atan2(right[1], right[0])])
