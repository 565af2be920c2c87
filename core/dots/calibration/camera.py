"""Calibration of a camera from its own frames of the pattern: focal length, centre and lens.

The dots are a calibration target of thousands of known positions that every session contains. The
parameters that poses depend on most, the centre and the distortion of the lens, follow from any
frames; the focal length only from tilted ones.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from locatk.core.dots.calibration.camera_fit import (
    CalibrationViews,
    CameraFit,
    fit_homographies,
    fit_poses,
    fit_without_lens,
)
from locatk.core.dots.calibration.camera_views import (
    MAX_EXAMINED_FRAMES,
    MAX_FITTED_FRAMES,
    NO_PATTERN,
    CalibrationFrame,
    common_size,
    examine_frames,
    frames_of_size,
    select_diverse_frames,
    spread_order,
    stack_views,
)
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.recordings import OTHER_SIZE
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import DegenerateError, InputError

USUAL_FOCAL_DIAGONALS = 1.56
"""Focal length if nothing is known [diagonals of a frame]: that of the paper's camera, 348.7 px for
188 x 120 px."""

MAX_FOCAL_RELATIVE_SIGMA = 0.05
"""Largest relative standard deviation of a focal length that counts as determined."""

MAX_CENTRE_SIGMA_DIAGONALS = 0.01
"""Largest standard deviation [diagonals] of a centre that counts as determined; beyond it the
middle of the frame is as good an estimate."""

MAX_POSE_MISFIT_RATIO = 1.5
"""Largest ratio of the residuals of poses to those of homographies if the frames are images of a
flat sheet by a pinhole camera."""

MAX_CORNER_DISTORTION = 0.9
"""Largest |k| times the squared distance of a corner; at 1 the lens folds the frame."""

MIN_NOTED_ASPECT = 5e-4
"""Least aspect that is reported: 0.05 mm on a ruler of 100 mm."""

NOTED_SIGMAS = 3.0
"""Difference in standard deviations from which an aspect or a focal length is reported."""

MIN_NOTED_FOCAL_RATIO = 0.01
"""Relative difference of focal lengths from which it is reported."""


@dataclass(frozen=True)
class CalibrateOptions:
    """Prior knowledge of the camera.

    Attributes
    ----------
    focal_px : float, optional
        Focal length, which is used whatever the frames indicate.
    camera : Camera, optional
        An earlier calibration: frames that cannot be localized with an unknown lens are tried with
        its lens, and its focal length is used if the frames do not determine one.
    """

    focal_px: float | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class CameraReport:
    """Calibrated camera, with the uncertainty of its parameters.

    Attributes
    ----------
    camera : Camera
    focal_from : str
        ``"frames"``; else it was not estimated: ``"given"``, ``"camera"`` (an earlier one) or
        ``"usual"``. Centre and k in px^-2 are valid all the same.
    centre_from : str
        ``"frames"`` or ``"middle"`` of the frame.
    sigma_focal_px : float
        Standard deviations; nan if not estimated.
    sigma_centre_px : (x, y)
    sigma_radial_px : float
        Of k in px^-2.
    aspect, sigma_aspect : float
        The sheet's true scale along x over that along y, relative to the manifest's, minus 1; nan
        if the frames do not determine a focal length.
    largest_tilt_rad : float
        Largest tilt of a frame; nan if the frames do not determine a focal length.
    rms_before_px, rms_px : float
        Root mean square distance of the dots from their predicted positions: without a lens, and
        with the camera.
    seen, located, used : int
        Number of frames that were examined, localized and fitted.
    dots : int
        Number of dots that were fitted.
    skipped : dict of str to int
        Reasons why examined frames were not used.
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
        """Standard deviation of the camera's k, for its focal length."""
        return self.sigma_radial_px * self.camera.focal_px**2

    @property
    def distortion(self) -> float:
        """Fraction by which the lens moves a point at half a diagonal towards its centre."""
        return -self.camera.radial_px * (math.hypot(*self.camera.size) / 2) ** 2


def calibrate(
    frames: Frames, manifest: Manifest, options: CalibrateOptions | None = None
) -> CameraReport:
    """Estimate the camera of a session from the dots in its frames.

    Of a long session, frames are selected that differ in time, heading and tilt.

    Raises
    ------
    DegenerateError
        Too few frames show the pattern, or no lens of this kind has such frames.
    InputError
        The manifest names an unknown codec, or the focal length is not above 0.
    """
    options = options or CalibrateOptions()
    if options.focal_px is not None and not 0 < options.focal_px < math.inf:
        raise InputError(f"a focal length of {options.focal_px:g} px", hint="Give one above 0")
    code = codec(manifest.codec)
    order = spread_order(len(frames))[:MAX_EXAMINED_FRAMES]
    outcomes = examine_frames(frames, manifest, code, order, (None, options.camera))
    size = common_size(outcomes, len(frames))
    localized = frames_of_size(outcomes, outcomes, size)
    selected = select_diverse_frames(size, localized, len(frames))

    # With the lens known, more dots and more frames are decoded: so examine them once more.
    lens = camera_of_fit(size, fit_homographies(stack_views(size, selected)), _usual_focal(size))
    again = [frame.index for frame in selected]
    blank = [index for index, outcome in outcomes.items() if outcome == NO_PATTERN]
    again += blank[: max(MAX_FITTED_FRAMES - len(again), 0)]
    outcomes |= {
        index: outcome
        for index, outcome in examine_frames(frames, manifest, code, again, (lens,)).items()
        if isinstance(outcome, CalibrationFrame)
    }
    skipped = Counter(outcome for outcome in outcomes.values() if isinstance(outcome, str))
    skipped[OTHER_SIZE] = sum(
        isinstance(outcome, CalibrationFrame) and outcome.size != size
        for outcome in outcomes.values()
    )
    return calibrate_views(
        stack_views(size, frames_of_size(outcomes, again, size)),
        options,
        len(outcomes),
        {reason: count for reason, count in sorted(skipped.items()) if count},
    )


def _usual_focal(size: tuple[int, int]) -> float:
    """Return the focal length in px if nothing is known."""
    return USUAL_FOCAL_DIAGONALS * math.hypot(*size)


def camera_of_fit(size: tuple[int, int], fit: CameraFit, focal: float) -> Camera:
    """Return the camera of a fit; raise DegenerateError if it is not plausible."""
    (width, height), (x, y) = size, fit.centre.tolist()
    corner = math.hypot(max(x, width - 1 - x), max(y, height - 1 - y))
    is_inside = -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
    if not is_inside or abs(fit.radial) * corner**2 > MAX_CORNER_DISTORTION:
        raise DegenerateError(
            f"no lens of this kind shows such frames: its centre would be at {x:.0f}, {y:.0f} px "
            f"and k {fit.radial:.2g} px^-2",
            hint="Is the sheet flat? Are the frames whole, neither cropped nor scaled unevenly?",
        )
    return Camera(size, focal, (x, y), fit.radial * focal**2)


def calibrate_views(
    views: CalibrationViews, options: CalibrateOptions, examined: int, skipped: dict[str, int]
) -> CameraReport:
    """Fit the camera to selected frames, with those of its parameters that they determine."""
    size, usual = views.size, _usual_focal(views.size)
    by_homographies = fit_homographies(views)
    by_poses = fit_poses(views, by_homographies, usual)
    is_tilted = by_poses.sigma[3] <= MAX_FOCAL_RELATIVE_SIGMA * by_poses.focal
    is_pinhole = by_poses.rms <= MAX_POSE_MISFIT_RATIO * by_homographies.rms
    determines_focal = is_tilted and is_pinhole
    best = by_poses if determines_focal else by_homographies
    max_centre_sigma = MAX_CENTRE_SIGMA_DIAGONALS * math.hypot(*size)
    fix_centre = bool(best.sigma[:2].max() > max_centre_sigma)
    if fix_centre and determines_focal:
        best = fit_poses(views, by_homographies, usual, fix_centre=True)
    elif fix_centre:
        best = fit_homographies(views, fix_centre=True)
    focal, source = usual, "usual"
    if options.focal_px is not None:
        focal, source = options.focal_px, "given"
    elif determines_focal:
        focal, source = best.focal, "frames"
    elif options.camera is not None and options.camera.size == size:
        focal, source = options.camera.focal_px, "camera"
    camera = camera_of_fit(size, best, focal)
    notes = [
        *_misfit_notes(by_poses, by_homographies, is_pinhole=is_pinhole),
        *_focal_notes(by_poses, camera, source, is_tilted=is_tilted, is_pinhole=is_pinhole),
        *_centre_and_aspect_notes(best, fix_centre=fix_centre),
    ]
    return CameraReport(
        camera=camera,
        focal_from=source,
        centre_from="middle" if fix_centre else "frames",
        sigma_focal_px=float(best.sigma[3]) if source == "frames" else math.nan,
        sigma_centre_px=(float(best.sigma[0]), float(best.sigma[1])),
        sigma_radial_px=float(best.sigma[2]),
        aspect=best.aspect,
        sigma_aspect=float(best.sigma[4]),
        largest_tilt_rad=float(best.tilt.max()),
        rms_before_px=fit_without_lens(views).rms,
        rms_px=best.rms,
        seen=examined,
        located=examined - sum(skipped.values()),
        used=len(views),
        dots=int(best.used.sum()),
        skipped=skipped,
        notes=tuple(notes),
    )


def _misfit_notes(
    by_poses: CameraFit, by_homographies: CameraFit, *, is_pinhole: bool
) -> Iterator[str]:
    """Report frames that are not images of a flat sheet by a pinhole camera."""
    if not is_pinhole:
        yield (
            "the frames are not what a pinhole sees of a flat sheet: dots miss their places by "
            f"{by_poses.rms:.2g} px, and by {by_homographies.rms:.2g} px where each frame may be "
            "any homography; the shutter may be a rolling one, the sheet not flat, or pixels not "
            "square"
        )


def _focal_notes(
    by_poses: CameraFit, camera: Camera, source: str, *, is_tilted: bool, is_pinhole: bool
) -> Iterator[str]:
    """Report the source of the focal length if it is not that of the frames."""
    focal = camera.focal_px
    if source in ("usual", "camera"):
        reason = "" if is_tilted else ": they are not tilted enough"
        instead = "a usual one stands in" if source == "usual" else "the earlier one is kept"
        yield (
            f"the frames do not tell the focal length{reason}; {instead}, {focal:.1f} px. Poses on "
            "the sheet do not depend on it"
        )
    if source == "given" and is_tilted and is_pinhole:
        sigma = by_poses.sigma[3]
        difference = abs(by_poses.focal - focal)
        if difference > max(NOTED_SIGMAS * sigma, MIN_NOTED_FOCAL_RATIO * focal):
            yield f"the frames tell a focal length of {by_poses.focal:.1f} px (sigma {sigma:.2g})"


def _centre_and_aspect_notes(fit: CameraFit, *, fix_centre: bool) -> Iterator[str]:
    """Report an undetermined centre, and a wrong aspect of the sheet."""
    if fix_centre:
        yield (
            "the frames do not tell the centre, for want of bend and tilt: it is taken to be the "
            "middle of the frame"
        )
    if abs(fit.aspect) > max(NOTED_SIGMAS * fit.sigma[4], MIN_NOTED_ASPECT):
        comparison = "longer" if fit.aspect > 0 else "shorter"
        yield (
            f"the sheet is {100 * abs(fit.aspect):.2f} % {comparison} along x, compared to y, than "
            "its manifest says: its scales should be measured"
        )
