"""What a camera makes of dark discs on a sheet: true perspective, area sampling, light.

Each pixel is divided into :data:`OVERSAMPLING` squared parts, each of which is carried
through lens and pinhole to the paper; nothing here is shared with a solver but the
:class:`~locatk.core.dots.camera.Camera`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera

Array = NDArray[np.float64]
Image = NDArray[np.float32]

OVERSAMPLING = 3
"""Parts of a pixel along each axis. The edge of a disc is smooth within a part, so that
nine times more of them change no grey value by more than 1."""

EXPOSURES_PER_PX = 3
"""Into how many moments a motion of one pixel is divided."""


@dataclass(frozen=True)
class Optics:
    """How a camera sees.

    Attributes
    ----------
    camera : Camera
    metres_per_px : float
        On the paper where the camera looks straight down, at its centre.
    blur_px : float
        Standard deviation of the defocus.
    paper_level : float
        Grey value of well lit paper.
    contrast : float
        How much darker ink is: 1 is black.
    vignette : float
        By how much the corner that is farthest from the centre is darker than it.
    gradient : float
        By how much one rim of the frame is darker than the middle, and the other lighter.
    gradient_rad : float
        Where it is lighter, counter-clockwise from the right.
    noise : float
        Standard deviation in grey values.
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
class Stand:
    """How a camera stands over the sheet in the middle of an exposure, and how it moves.

    Attributes
    ----------
    heading_rad : float
        Of the image's right on the paper, at the camera's centre.
    pitch_rad, roll_rad : float
        Turns of the camera about its own axes to the right and down in the image. Zero
        looks straight down.
    shift_m : (x, y)
        How far the centre moves on the paper while the shutter is open.
    turn_rad : float
        How far it turns meanwhile.
    """

    heading_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    turn_rad: float = 0.0


def view(optics: Optics, stand: Stand, heading_rad: float | None = None) -> Array:
    """Homography (3, 3) from the frame to the paper.

    From undistorted px right and down of the camera's centre to metres from the point at
    which the optical axis meets the paper, x and y of the sheet's frame. The pinhole is as
    far from that point as gives the scale: focal length times metres a pixel.
    ``heading_rad`` replaces the stand's.
    """
    heading = stand.heading_rad if heading_rad is None else heading_rad
    focal = optics.camera.focal_px
    distance = focal * optics.metres_per_px
    (cp, sp), (cr, sr) = (
        (np.cos(angle), np.sin(angle)) for angle in (stand.pitch_rad, stand.roll_rad)
    )
    about_right = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_down = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    # Columns: the camera's right, down and forward on the sheet (x right, y up, z up).
    axes = np.diag([1.0, -1.0, -1.0]) @ about_right @ about_down
    forward = axes[:, 2]
    # On the paper the image's right goes where a ray beside the axis meets it.
    right = axes[:, 0] - axes[2, 0] / forward[2] * forward
    turn = heading - np.arctan2(right[1], right[0])
    c, s = np.cos(turn), np.sin(turn)
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ axes
    pinhole = -distance * axes[:, 2]
    # A ray meets the paper at pinhole - ray * pinhole_z / ray_z.
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
    """Takes frames; what does not change from one to the next is computed once."""

    def __init__(self, optics: Optics) -> None:
        self.optics = optics
        camera, parts = optics.camera, OVERSAMPLING
        width, height = camera.size
        # What lies beyond the rim is blurred into the frame.
        self._margin = int(np.ceil(4 * optics.blur_px)) + 1
        self._shape = tuple((n + 2 * self._margin) * parts for n in (height, width))
        y, x = ((np.arange(n) + 0.5) / parts - 0.5 - self._margin for n in self._shape)
        points = np.stack(np.meshgrid(x, y), axis=-1)
        rays = camera.undistort(points) - camera.centre_px
        self._rays = rays.reshape(-1, 2).T.astype(np.float32)
        self._light = self._shine().astype(np.float32)

    def _shine(self) -> Array:
        """Share (height, width) of the light that reaches each pixel."""
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

    def reach_m(self, stand: Stand) -> float:
        """How far the paper that is seen reaches from the centre, in metres."""
        width, height = self.optics.camera.size
        m = self._margin
        corners = np.array([[x, y] for x in (-m, width + m) for y in (-m, height + m)], float)
        rays = self.optics.camera.undistort(corners) - self.optics.camera.centre_px
        met = np.c_[rays, np.ones(4)] @ view(self.optics, stand).T
        return float(np.linalg.norm(met[:, :2] / met[:, 2:], axis=1).max())

    def expose(
        self, stand: Stand, centres: Array, radii: Array, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """A frame (height, width) of discs at ``centres`` (n, 2) of ``radii`` (n,).

        All in metres relative to the point at which the camera looks.
        """
        import cv2

        optics = self.optics
        ink = self._moving(stand, centres, radii)
        if optics.blur_px > 0:
            ink = cv2.GaussianBlur(ink, (0, 0), optics.blur_px * OVERSAMPLING)
        rim = self._margin * OVERSAMPLING
        ink = cv2.resize(
            ink[rim : self._shape[0] - rim, rim : self._shape[1] - rim],
            optics.camera.size,
            interpolation=cv2.INTER_AREA,
        )
        grey = self._light * (optics.paper_level * (1 - optics.contrast * ink))
        if optics.noise > 0:
            grey += optics.noise * rng.standard_normal(grey.shape, dtype=np.float32)
        frame: NDArray[np.uint8] = np.rint(np.clip(grey, 0, 255)).astype(np.uint8)
        return frame

    def _moving(self, stand: Stand, centres: Array, radii: Array) -> Image:
        """Mean ink over the exposure."""
        scale = self.optics.metres_per_px
        shift = np.array(stand.shift_m)
        corner_px = float(np.linalg.norm(self.optics.camera.size)) / 2
        motion_px = np.linalg.norm(shift) / scale + abs(stand.turn_rad) * corner_px
        moments = 1 + int(np.ceil(EXPOSURES_PER_PX * motion_px)) if motion_px > 0.01 else 1
        ink = np.zeros(self._shape, np.float32)
        for moment in range(moments):
            at = (moment + 0.5) / moments - 0.5
            seen = view(self.optics, stand, stand.heading_rad + at * stand.turn_rad)
            ink += self._ink(seen, centres - at * shift, radii)
        return ink if moments == 1 else ink / np.float32(moments)

    def _ink(self, seen: Array, centres: Array, radii: Array) -> Image:
        """Share of each part of a pixel that discs cover, margin included."""
        canvas = np.zeros(self._shape[0] * self._shape[1], np.float32)
        image = np.linalg.inv(seen).astype(float)
        at, stretch = self._project(image, centres)
        scale = self.optics.metres_per_px
        reach = OVERSAMPLING * (float(radii.max(initial=0.0)) * stretch.max(initial=0.0) + 0.25)
        half = int(np.ceil(reach)) + 1
        at = (at + self._margin + 0.5) * OVERSAMPLING - 0.5
        rows, columns = self._shape
        with np.errstate(invalid="ignore"):
            near = ((at > -half) & (at < (columns + half, rows + half))).all(axis=1)
        at, centres, radii = at[near], centres[near], radii[near]

        # A part is tested where it is, so that those of the rim may come up twice.
        around = np.arange(-half, half + 1)
        part = np.rint(at).astype(np.int32)
        x = np.clip(part[:, 0, None] + around, 0, columns - 1)[:, None, :]
        y = np.clip(part[:, 1, None] + around, 0, rows - 1)[:, :, None]
        index = y * columns + x
        # In px of the paper's scale: float32 would not hold metres of a floor.
        u, v = (np.take(ray, index) for ray in self._rays)
        h = (seen / np.array([[scale], [scale], [1.0]])).astype(np.float32)
        middle = (centres / scale).astype(np.float32)[:, :, None, None]
        depth = h[2, 0] * u + h[2, 1] * v + h[2, 2]
        away_x = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / depth - middle[:, 0]
        away_y = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / depth - middle[:, 1]
        beyond = np.sqrt(away_x * away_x + away_y * away_y)
        # The ramp about an edge makes a disc larger by 1/12 of a part's area times pi.
        edge = np.sqrt(np.maximum((radii / scale) ** 2 - 1 / 12 / OVERSAMPLING**2, 0))
        beyond -= edge.astype(np.float32)[:, None, None]
        covered = np.minimum(0.5 - OVERSAMPLING * beyond, 1, dtype=np.float32)
        dark = covered > 0
        np.maximum.at(canvas, index[dark], covered[dark])
        return canvas.reshape(self._shape)

    def _project(self, image: Array, points: Array) -> tuple[Array, Array]:
        """Points (n, 2) of the paper in px of the frame, and px a metre (n,) at most there."""
        camera = self.optics.camera

        def project(at: Array) -> Array:
            met = np.c_[at, np.ones(len(at))] @ image.T
            return camera.distort(met[:, :2] / met[:, 2:] + camera.centre_px)

        step = self.optics.metres_per_px
        middle = project(points)
        along = [(project(points + d) - middle) / step for d in ((step, 0.0), (0.0, step))]
        total = sum((a * a).sum(axis=1) for a in along)
        area = along[0][:, 0] * along[1][:, 1] - along[0][:, 1] * along[1][:, 0]
        largest = np.sqrt((total + np.sqrt(np.maximum(total**2 - 4 * area**2, 0))) / 2)
        return middle, np.where(np.isfinite(largest), largest, 0.0)
