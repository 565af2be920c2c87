"""A camera from its own frames of the pattern: focal length, centre and lens.

The dots are a calibration target of thousands of known places that every session holds
anyway. What poses need most, the centre and the bend of the lens, any frames tell; the
focal length only those that are tilted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from locatk.core.dots.calibration.camera_fit import (
    Fit,
    Views,
    fit_flat,
    fit_homographies,
    fit_poses,
)
from locatk.core.dots.calibration.camera_views import (
    MOST_FRAMES,
    MOST_SEEN,
    NO_PATTERN,
    SeenFrame,
    common_size,
    look,
    seen_of,
    spread,
    spread_order,
    views_of,
)
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Manifest
from locatk.core.dots.solver import OTHER_SIZE
from locatk.core.errors import DegenerateError, InputError

USUAL_FOCAL = 1.56
"""Focal length in diagonals of a frame where nothing is known: that of the paper's camera,
348.7 px for 188 x 120 px."""

LARGEST_FOCAL_SIGMA = 0.05
"""Relative standard deviation up to which a focal length counts as known."""

LARGEST_CENTRE_SIGMA = 0.01
"""Standard deviation in diagonals up to which a centre counts as known; beyond, the middle
of the frame is no worse a guess."""

LARGEST_MISFIT = 1.5
"""Scatter about poses over that about homographies up to which the frames are taken for
what a pinhole sees of a flat sheet."""

LARGEST_BEND = 0.9
"""Of |k| times the square of a corner's distance; at 1 the lens folds the frame."""

NOTED_ASPECT = 5e-4
"""0.05 mm on a ruler of 100 mm."""


@dataclass(frozen=True)
class CalibrateOptions:
    """What is known of the camera.

    Attributes
    ----------
    focal_px : float, optional
        Kept, whatever the frames say.
    camera : Camera, optional
        An earlier calibration: the frames are read with its lens, and its focal length is
        kept where they do not tell one.
    """

    focal_px: float | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class CameraReport:
    """A camera, and how well it is known.

    Attributes
    ----------
    camera : Camera
    focal_from : str
        ``"frames"``; else it was not fitted: ``"given"``, ``"camera"`` (an earlier one) or
        ``"usual"``. Centre and k in px^-2 hold all the same.
    centre_from : str
        ``"frames"`` or ``"middle"`` of the frame.
    sigma_focal_px : float
        Standard deviations; nan of what was not fitted.
    sigma_centre_px : (x, y)
    sigma_radial_px : float
        Of k in px^-2.
    aspect, sigma_aspect : float
        The sheet's true scale along x over that along y, relative to the manifest's,
        minus 1; nan where the focal length is not fitted.
    largest_tilt_rad : float
        Likewise.
    rms_before_px, rms_px : float
        Root mean square distance of dots from where they should be: without a lens, and
        with the camera.
    seen, located, used : int
        Frames that were looked at, that have a place, and that were fitted.
    dots : int
        Dots that were fitted.
    skipped : dict of str to int
        Why frames that were looked at have no place.
    notes : tuple of str
    """

    camera: Camera
    focal_from: str
    centre_from: str
    sigma_focal_px: float
    sigma_centre_px: tuple[float, float]
    sigma_radial_px: float
    aspect: float
    sigma_aspect: float
    largest_tilt_rad: float
    rms_before_px: float
    rms_px: float
    seen: int
    located: int
    used: int
    dots: int
    skipped: dict[str, int]
    notes: tuple[str, ...]

    @property
    def sigma_radial(self) -> float:
        """Of the camera's k, for its focal length."""
        return self.sigma_radial_px * self.camera.focal_px**2

    @property
    def distortion(self) -> float:
        """Share by which the lens draws in what belongs half a diagonal from its centre."""
        return -self.camera.radial_px * (math.hypot(*self.camera.size) / 2) ** 2


def calibrate(
    frames: Frames, manifest: Manifest, options: CalibrateOptions | None = None
) -> CameraReport:
    """Fit the camera of a session to the dots in its frames.

    Of a long session, frames are taken that are spread over time, headings and tilts.

    Raises
    ------
    DegenerateError
        Too few frames show the pattern, or what they show is no lens of this kind.
    InputError
        The manifest names an unknown codec, or the focal length is not above 0.
    """
    options = options or CalibrateOptions()
    if options.focal_px is not None and not 0 < options.focal_px < math.inf:
        raise InputError(f"a focal length of {options.focal_px:g} px", hint="Give one above 0")
    code = codec(manifest.codec)
    order = spread_order(len(frames))[:MOST_SEEN]
    looked = look(frames, manifest, code, order, (None, options.camera))
    size = common_size(looked, len(frames))
    chosen = spread(size, seen_of(looked, looked, size), len(frames))

    # With the lens known, more dots and frames are told: so look at them once more.
    lens = _camera(size, fit_homographies(views_of(size, chosen)), _usual_focal(size))
    again = [seen.index for seen in chosen]
    blank = [index for index, outcome in looked.items() if outcome == NO_PATTERN]
    again += blank[: max(MOST_FRAMES - len(again), 0)]
    looked |= {
        index: outcome
        for index, outcome in look(frames, manifest, code, again, (lens,)).items()
        if isinstance(outcome, SeenFrame)
    }
    skipped = Counter(outcome for outcome in looked.values() if isinstance(outcome, str))
    skipped[OTHER_SIZE] = sum(isinstance(o, SeenFrame) and o.size != size for o in looked.values())
    return _report(
        views_of(size, seen_of(looked, again, size)),
        options,
        len(looked),
        {reason: count for reason, count in sorted(skipped.items()) if count},
    )


def _usual_focal(size: tuple[int, int]) -> float:
    return USUAL_FOCAL * math.hypot(*size)


def _camera(size: tuple[int, int], fit: Fit, focal: float) -> Camera:
    """The camera of a fit, where it is one."""
    (width, height), (x, y) = size, fit.centre.tolist()
    far = math.hypot(max(x, width - 1 - x), max(y, height - 1 - y))
    inside = -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
    if not inside or abs(fit.radial) * far**2 > LARGEST_BEND:
        raise DegenerateError(
            f"no lens of this kind shows such frames: its centre would be at {x:.0f}, {y:.0f} px "
            f"and k {fit.radial:.2g} px^-2",
            hint="Is the sheet flat? Are the frames whole, neither cropped nor scaled unevenly?",
        )
    return Camera(size, focal, (x, y), fit.radial * focal**2)


def _report(
    views: Views, options: CalibrateOptions, seen: int, skipped: dict[str, int]
) -> CameraReport:
    size, usual = views.size, _usual_focal(views.size)
    largest = LARGEST_CENTRE_SIGMA * math.hypot(*size)
    bend = fit_homographies(views)
    poses = fit_poses(views, bend, usual)
    tilted = poses.sigma[3] <= LARGEST_FOCAL_SIGMA * poses.focal
    fits = poses.rms <= LARGEST_MISFIT * bend.rms
    best = poses if tilted and fits else bend
    held = bool(best.sigma[:2].max() > largest)
    if held:
        best = (
            fit_poses(views, bend, usual, hold_centre=True)
            if best is poses
            else fit_homographies(views, hold_centre=True)
        )
    known = tilted and fits
    focal, source = usual, "usual"
    if options.focal_px is not None:
        focal, source = options.focal_px, "given"
    elif known:
        focal, source = best.focal, "frames"
    elif options.camera is not None and options.camera.size == size:
        focal, source = options.camera.focal_px, "camera"
    camera = _camera(size, best, focal)
    return CameraReport(
        camera=camera,
        focal_from=source,
        centre_from="middle" if held else "frames",
        sigma_focal_px=float(best.sigma[3]) if source == "frames" else math.nan,
        sigma_centre_px=(float(best.sigma[0]), float(best.sigma[1])),
        sigma_radial_px=float(best.sigma[2]),
        aspect=best.aspect,
        sigma_aspect=float(best.sigma[4]),
        largest_tilt_rad=float(best.tilt.max()),
        rms_before_px=fit_flat(views).rms,
        rms_px=best.rms,
        seen=seen,
        located=seen - sum(skipped.values()),
        used=len(views),
        dots=int(best.used.sum()),
        skipped=skipped,
        notes=tuple(_notes(best, poses, bend, camera, source, held=held, tilted=tilted, fits=fits)),
    )


def _notes(
    best: Fit,
    poses: Fit,
    bend: Fit,
    camera: Camera,
    source: str,
    *,
    held: bool,
    tilted: bool,
    fits: bool,
) -> Iterator[str]:
    focal = camera.focal_px
    if not fits:
        yield (
            "the frames are not what a pinhole sees of a flat sheet: dots miss their places by "
            f"{poses.rms:.2g} px, and by {bend.rms:.2g} px where each frame may be any homography; "
            "the shutter may be a rolling one, the sheet not flat, or pixels not square"
        )
    if source in ("usual", "camera"):
        why = "" if tilted else ": they are not tilted enough"
        instead = "a usual one stands in" if source == "usual" else "the earlier one is kept"
        yield (
            f"the frames do not tell the focal length{why}; {instead}, {focal:.1f} px. Poses on "
            "the sheet do not depend on it"
        )
    if source == "given" and tilted and fits:
        sigma = poses.sigma[3]
        if abs(poses.focal - focal) > max(3 * sigma, 0.01 * focal):
            yield f"the frames tell a focal length of {poses.focal:.1f} px (sigma {sigma:.2g})"
    if held:
        yield (
            "the frames do not tell the centre, for want of bend and tilt: it is taken to be the "
            "middle of the frame"
        )
    if abs(best.aspect) > max(3 * best.sigma[4], NOTED_ASPECT):
        more = "longer" if best.aspect > 0 else "shorter"
        yield (
            f"the sheet is {100 * abs(best.aspect):.2f} % {more} along x, compared to y, than its "
            "manifest says: its scales should be measured"
        )
