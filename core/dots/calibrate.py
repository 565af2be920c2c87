"""A camera from its own frames of the pattern: focal length, centre and lens.

The dots are a calibration target of thousands of known places that every session holds
anyway. What poses need most, the centre and the bend of the lens, any frames tell; the
focal length only those that are tilted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError

Array = NDArray[np.float64]

NO_PATTERN = "no_pattern"

FEWEST_FRAMES = 5
"""With fewer, nothing tells a bad frame from a good one."""

MOST_FRAMES = 200
"""Frames that are fitted; more would tell nothing new."""

MOST_LOCATED = 2 * MOST_FRAMES
"""Frames with a place from which those are chosen."""

MOST_SEEN = 1000
"""Frames that are looked at, where many of them show no pattern."""

MOST_DOTS = 250
"""Of a frame; the paper's camera sees 180."""

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
    # Any beginning of this order is spread over all frames (the golden ratio's multiples).
    order = np.argsort(np.arange(len(frames)) * (math.sqrt(5) - 1) / 2 % 1).tolist()
    looked = _look(frames, manifest, code, order[:MOST_SEEN], (None, options.camera))
    size = _common_size(looked, len(frames))
    chosen = _spread(size, _seen_of(looked, looked, size), len(frames))

    # With the lens known, more dots and frames are told: so look at them once more.
    lens = _camera(size, fit_homographies(_views(size, chosen)), _usual_focal(size))
    again = [seen.index for seen in chosen]
    blank = [index for index, outcome in looked.items() if outcome == NO_PATTERN]
    again += blank[: max(MOST_FRAMES - len(again), 0)]
    looked |= {
        index: outcome
        for index, outcome in _look(frames, manifest, code, again, (lens,)).items()
        if isinstance(outcome, _Seen)
    }
    skipped = Counter(outcome for outcome in looked.values() if isinstance(outcome, str))
    skipped[OTHER_SIZE] = sum(isinstance(o, _Seen) and o.size != size for o in looked.values())
    return _report(
        _views(size, _seen_of(looked, again, size)),
        options,
        len(looked),
        {reason: count for reason, count in sorted(skipped.items()) if count},
    )


@dataclass(frozen=True)
class _Seen:
    """Dots of a frame: (m, 2) in px, and (m, 2) in metres on the sheet, x right, y down."""

    index: int
    size: tuple[int, int]
    pixels: Array
    plane: Array


def _look(
    frames: Frames,
    manifest: Manifest,
    code: Codec,
    order: Iterable[int],
    cameras: Sequence[Camera | None],
) -> dict[int, _Seen | str]:
    """What frames show, or why they show nothing, by index; until there are enough."""
    looked: dict[int, _Seen | str] = {}
    located = 0
    for index in order:
        try:
            image = frames.images[index]
        except InputError:
            looked[index] = UNREADABLE
            continue
        looked[index] = _dots_of(index, image, manifest, code, cameras)
        located += isinstance(looked[index], _Seen)
        if located == MOST_LOCATED:
            break
    return looked


def _dots_of(
    index: int,
    image: NDArray[np.uint8],
    manifest: Manifest,
    code: Codec,
    cameras: Sequence[Camera | None],
) -> _Seen | str:
    height, width = image.shape
    for camera in dict.fromkeys(cameras):
        if camera is not None and camera.size != (width, height):
            continue
        for sighting in sightings(image[None], code, camera):
            middle = sighting.origin + sighting.grid.mean(axis=0)
            number = int(manifest.find(middle[None], [[-1, -1]], slack=RIM)[0])
            if number < 0:
                return OFF_SHEET
            place = np.rint(sighting.grid)
            shift = (sighting.grid - place) * (manifest.offset_mm / manifest.pitch_mm / OFFSET)
            # Lengths alone: how a tile is turned on its floor means nothing to a camera.
            pitch = np.linalg.norm(manifest.jacobian(number), axis=0)
            plane = (place + shift) * pitch
            some = np.random.default_rng(index).permutation(len(plane))[:MOST_DOTS]
            return _Seen(index, (width, height), sighting.pixels[some], plane[some])
    return NO_PATTERN


def _seen_of(
    looked: dict[int, _Seen | str], indices: Iterable[int], size: tuple[int, int]
) -> list[_Seen]:
    """Located frames of ``size`` among ``indices``."""
    outcomes = (looked[index] for index in indices)
    return [one for one in outcomes if isinstance(one, _Seen) and one.size == size]


def _common_size(looked: dict[int, _Seen | str], total: int) -> tuple[int, int]:
    """Size of most located frames, of which there must be enough."""
    sizes = Counter(one.size for one in looked.values() if isinstance(one, _Seen))
    size, count = sizes.most_common(1)[0] if sizes else ((0, 0), 0)
    if count >= FEWEST_FRAMES:
        return size
    reasons = Counter(one for one in looked.values() if isinstance(one, str))
    off = reasons[OFF_SHEET] > count
    seen = f"{len(looked)} of {total}" if len(looked) < total else f"{total}"
    raise DegenerateError(
        f"{count or 'none'} of {seen} frames show the pattern, where {FEWEST_FRAMES} are needed"
        if not off
        else f"{reasons[OFF_SHEET]} of {seen} frames show the pattern off all sheets of the manifest",
        hint="Is it the manifest of another sheet?"
        if off
        else "Take frames at several places of the sheet, in focus, turned in several directions",
    )


def _spread(size: tuple[int, int], found: list[_Seen], total: int) -> list[_Seen]:
    """At most :data:`MOST_FRAMES`, as different as can be in heading, tilt and time."""
    if len(found) <= MOST_FRAMES:
        return found
    own = homographies(_views(size, found))
    heading = np.arctan2(own[:, 3], own[:, 0])
    tilt = own[:, 6:] / np.maximum(np.std(own[:, 6:]), 1e-12)
    when = np.array([seen.index for seen in found]) / total
    features = np.column_stack([np.cos(heading), np.sin(heading), tilt.clip(-3, 3), 2 * when])
    chosen = [0]
    nearest = np.full(len(found), np.inf)
    while len(chosen) < MOST_FRAMES:
        away = np.linalg.norm(features - features[chosen[-1]], axis=1)
        nearest = np.minimum(nearest, away)
        chosen.append(int(np.argmax(nearest)))
    return [found[k] for k in sorted(chosen)]


def _views(size: tuple[int, int], found: Sequence[_Seen]) -> Views:
    most = max(len(seen.pixels) for seen in found)
    pixels, plane = np.zeros((2, len(found), most, 2))
    valid = np.zeros((len(found), most), bool)
    for k, seen in enumerate(found):
        count = len(seen.pixels)
        pixels[k, :count], plane[k, :count], valid[k, :count] = seen.pixels, seen.plane, True
    return Views(size, pixels, plane, valid)


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
        notes=tuple(_notes(best, poses, bend, camera, source, held, tilted, fits)),
    )
