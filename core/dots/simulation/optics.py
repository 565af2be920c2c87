"""Images of dark discs on a sheet: exact perspective, area sampling, illumination.

Each pixel is divided into :data:`SUBPIXELS_PER_PX` squared subpixels, each of which is projected
through lens and pinhole onto the paper. Only the :class:`~locatk.core.dots.camera.Camera` is
shared with the solver.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera

Array = NDArray[np.float64]
Image = NDArray[np.float32]

SUBPIXELS_PER_PX = 3
"""Subpixels along each axis. The edge of a disc is smooth within a subpixel: nine times more of
them change no grey value by more than 1."""

EXPOSURES_PER_PX = 3
"""Number of instants that are averaged for a motion of one pixel."""

MIN_MOTION_PX = 0.01
"""Motion below which one instant is rendered."""


@dataclass(frozen=True)
class Optics:
    """Camera, illumination and noise.

    Attributes
    ----------
    camera : Camera
    metres_per_px : float
        Width of a pixel on the paper at the camera's centre, if it looks straight down.
    blur_px : float
        Standard deviation of the defocus.
    paper_level : float
        Grey value of well illuminated paper.
    contrast : float
        Contrast of the ink: 1 is black.
    vignette : float
        Relative loss of light in the corner that is farthest from the centre.
    gradient : float
        Relative loss of light on one side of the frame, and gain on the other.
    gradient_rad : float
        Direction of the gain, counter-clockwise from the right.
    noise : float
        Standard deviation of a pixel in grey values.
    """

    camera: Camera
    metres_per_px: float
    blur_px: float
    paper_level: float
    contrast: float
    vignette: float
    gradient: float
    gradient_rad: float
    noise: float


@dataclass(frozen=True)
class CameraPose:
    """Orientation of a camera in the middle of an exposure, and its motion.

    Attributes
    ----------
    heading_rad : float
        Direction of the image's right on the paper at the camera's centre.
    pitch_rad, roll_rad : float
        Rotations of the camera about the right and the downward axis of the image. Zero looks
        straight down.
    shift_m : (x, y)
        Motion of the centre on the paper during the exposure.
    rotation_rad : float
        Rotation during the exposure.
    """

    heading_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0


def frame_to_paper(optics: Optics, pose: CameraPose, heading_rad: float | None = None) -> Array:
    """Return the homography (3, 3) from the frame to the paper.

    It maps undistorted pixels right and down of the camera's centre to metres from the
    intersection of the optical axis with the paper, in x and y of the sheet's frame. The distance
    of the pinhole from that point is the focal length times metres per pixel.
    ``heading_rad`` replaces the heading of the pose.
    """
    heading = pose.heading_rad if heading_rad is None else heading_rad
    focal = optics.camera.focal_px
    distance = focal * optics.metres_per_px
    (cp, sp), (cr, sr) = (
        (np.cos(angle), np.sin(angle)) for angle in (pose.pitch_rad, pose.roll_rad)
    )
    about_right = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_down = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    # Columns: the camera's right, down and forward on the sheet (x right, y up, z up).
    axes = np.diag([1.0, -1.0, -1.0]) @ about_right @ about_down
    forward = axes[:, 2]
    # Direction on the paper of a ray that is right of the optical axis.
    right = axes[:, 0] - axes[2, 0] / forward[2] * forward
    rotation = heading - np.arctan2(right[1], right[0])
    c, s = np.cos(rotation), np.sin(rotation)
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ axes
    pinhole = -distance * axes[:, 2]
    # A ray intersects the paper at pinhole - ray * pinhole_z / ray_z.
    homography = np.stack(
        [
            pinhole[0] * axes[2] - pinhole[2] * axes[0],
            pinhole[1] * axes[2] - pinhole[2] * axes[1],
            axes[2],
        ]
    )
    result: Array = homography * [1 / focal, 1 / focal, 1]
    return result


class Exposer:
    """Renderer of frames; quantities that all frames share are computed once."""

    def __init__(self, optics: Optics) -> None:
        self.optics = optics
        camera = optics.camera
        width, height = camera.size
        # Ink beyond the edge is blurred into the frame.
        self._margin = int(np.ceil(4 * optics.blur_px)) + 1
        self._shape = tuple((n + 2 * self._margin) * SUBPIXELS_PER_PX for n in (height, width))
        y, x = ((np.arange(n) + 0.5) / SUBPIXELS_PER_PX - 0.5 - self._margin for n in self._shape)
        points = np.stack(np.meshgrid(x, y), axis=-1)
        rays = camera.undistort(points) - camera.centre_px
        self._rays = rays.reshape(-1, 2).T.astype(np.float32)
        self._light = self._illumination().astype(np.float32)

    def _illumination(self) -> Array:
        """Return the relative illumination (height, width) of the pixels."""
        optics = self.optics
        width, height = optics.camera.size
        y, x = np.mgrid[:height, :width].astype(float)
        x -= optics.camera.centre_px[0]
        y -= optics.camera.centre_px[1]
        square = x * x + y * y
        c, s = np.cos(optics.gradient_rad), np.sin(optics.gradient_rad)
        along = x * c - y * s
        light = 1 - optics.vignette * square / square.max()
        result: Array = light * (1 + optics.gradient * along / np.abs(along).max())
        return result

    def visible_radius_m(self, pose: CameraPose) -> float:
        """Return the largest distance of visible paper from the centre, in metres."""
        width, height = self.optics.camera.size
        m = self._margin
        corners = np.array([[x, y] for x in (-m, width + m) for y in (-m, height + m)], float)
        rays = self.optics.camera.undistort(corners) - self.optics.camera.centre_px
        on_paper = np.c_[rays, np.ones(4)] @ frame_to_paper(self.optics, pose).T
        return float(np.linalg.norm(on_paper[:, :2] / on_paper[:, 2:], axis=1).max())

    def expose(
        self, pose: CameraPose, centres: Array, radii: Array, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Render a frame (height, width) of discs at ``centres`` (n, 2) with ``radii`` (n,).

        All are in metres, relative to the intersection of the optical axis with the paper.
        """
        optics = self.optics
        ink = self._mean_ink(pose, centres, radii)
        if optics.blur_px > 0:
            ink = cv2.GaussianBlur(ink, (0, 0), optics.blur_px * SUBPIXELS_PER_PX)
        margin = self._margin * SUBPIXELS_PER_PX
        ink = cv2.resize(
            ink[margin : self._shape[0] - margin, margin : self._shape[1] - margin],
            optics.camera.size,
            interpolation=cv2.INTER_AREA,
        )
        grey = self._light * (optics.paper_level * (1 - optics.contrast * ink))
        if optics.noise > 0:
            grey += optics.noise * rng.standard_normal(grey.shape, dtype=np.float32)
        frame: NDArray[np.uint8] = np.rint(np.clip(grey, 0, 255)).astype(np.uint8)
        return frame

    def _mean_ink(self, pose: CameraPose, centres: Array, radii: Array) -> Image:
        """Return the coverage of the subpixels, averaged over the exposure."""
        scale = self.optics.metres_per_px
        shift = np.array(pose.shift_m)
        corner_px = float(np.linalg.norm(self.optics.camera.size)) / 2
        motion_px = np.linalg.norm(shift) / scale + abs(pose.rotation_rad) * corner_px
        is_moving = motion_px > MIN_MOTION_PX
        instants = 1 + int(np.ceil(EXPOSURES_PER_PX * motion_px)) if is_moving else 1
        ink = np.zeros(self._shape, np.float32)
        for instant in range(instants):
            phase = (instant + 0.5) / instants - 0.5
            heading_rad = pose.heading_rad + phase * pose.rotation_rad
            to_paper = frame_to_paper(self.optics, pose, heading_rad)
            ink += self._ink(to_paper, centres - phase * shift, radii)
        return ink if instants == 1 else ink / np.float32(instants)

    def _ink(self, to_paper: Array, centres: Array, radii: Array) -> Image:
        """Return the fraction of each subpixel that discs cover, with the margin."""
        canvas = np.zeros(self._shape[0] * self._shape[1], np.float32)
        to_frame = np.linalg.inv(to_paper).astype(float)
        # Discs beside and behind a tilted camera are not in the frame; their images are infinite.
        depths = (centres @ to_frame[2, :2]) / to_frame[2, 2] + 1
        reach = 2 * radii * np.linalg.norm(to_frame[2, :2] / to_frame[2, 2])
        is_before = depths > reach
        centres, radii = centres[is_before], radii[is_before]
        positions, px_per_m = self._project(to_frame, centres)
        scale = self.optics.metres_per_px
        half_widths = np.ceil(SUBPIXELS_PER_PX * (radii * px_per_m + 0.25)) + 1
        positions = (positions + self._margin + 0.5) * SUBPIXELS_PER_PX - 0.5
        rows, columns = self._shape
        far = np.array([columns, rows]) + half_widths[:, None]
        is_inside = ((positions > -half_widths[:, None]) & (positions < far)).all(axis=1)
        positions, centres, radii = positions[is_inside], centres[is_inside], radii[is_inside]
        half_width = int(half_widths[is_inside].max(initial=1.0))

        # Indices are clipped to the canvas, so that subpixels of its edge may occur twice.
        window = np.arange(-half_width, half_width + 1)
        nearest = np.rint(positions).astype(np.int32)
        x = np.clip(nearest[:, 0, None] + window, 0, columns - 1)[:, None, :]
        y = np.clip(nearest[:, 1, None] + window, 0, rows - 1)[:, :, None]
        index = y * columns + x
        # Distances are in pixels of the paper's scale: float32 is too coarse for metres of a floor.
        u, v = (np.take(ray, index) for ray in self._rays)
        h = (to_paper / np.array([[scale], [scale], [1.0]])).astype(np.float32)
        middle = (centres / scale).astype(np.float32)[:, :, None, None]
        depth = h[2, 0] * u + h[2, 1] * v + h[2, 2]
        dx = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / depth - middle[:, 0]
        dy = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / depth - middle[:, 1]
        distance = np.sqrt(dx * dx + dy * dy)
        # The linear ramp at the edge enlarges a disc by pi / 12 of the area of a subpixel.
        edge = np.sqrt(np.maximum((radii / scale) ** 2 - 1 / 12 / SUBPIXELS_PER_PX**2, 0))
        distance -= edge.astype(np.float32)[:, None, None]
        coverage = np.minimum(0.5 - SUBPIXELS_PER_PX * distance, 1, dtype=np.float32)
        is_dark = coverage > 0
        np.maximum.at(canvas, index[is_dark], coverage[is_dark])
        return canvas.reshape(self._shape)

    def _project(self, to_frame: Array, points: Array) -> tuple[Array, Array]:
        """Return points (n, 2) of the paper in px of the frame, and the largest px/m (n,) there."""
        camera = self.optics.camera

        def project(points: Array) -> Array:
            in_frame = np.c_[points, np.ones(len(points))] @ to_frame.T
            return camera.distort(in_frame[:, :2] / in_frame[:, 2:] + camera.centre_px)

        step = self.optics.metres_per_px
        middle = project(points)
        slopes = [(project(points + d) - middle) / step for d in ((step, 0.0), (0.0, step))]
        total = sum((slope * slope).sum(axis=1) for slope in slopes)
        area = slopes[0][:, 0] * slopes[1][:, 1] - slopes[0][:, 1] * slopes[1][:, 0]
        largest = np.sqrt((total + np.sqrt(np.maximum(total**2 - 4 * area**2, 0))) / 2)
        return middle, np.where(np.isfinite(largest), largest, 0.0)
