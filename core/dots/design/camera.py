"""Design of a camera over printed dots: optics, exposure, read rate and accuracy before buying.

All figures are closed forms of the setup (:mod:`.camera_setup`, :mod:`.camera_optics`,
:mod:`.dot_noise`); no frame is rendered.
:func:`~locatk.core.dots.design.camera_measurement.measure_camera` renders frames of the same setup
and decodes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from locatk.core.dots.design.camera_materials import camera_materials
from locatk.core.dots.design.camera_optics import (
    diffraction_disc_m,
    distance_for_field,
    focus_range,
    frame_rate,
    full_illuminance_lx,
    illuminance_text,
    needed_illuminance_lx,
    noise_levels,
    static_blur_px,
    tolerated_confusion_m,
    window_diagonal_m,
    window_in_view,
)
from locatk.core.dots.design.camera_setup import MAX_LEVEL, CameraSetup, Lens, Sensor
from locatk.core.dots.design.dot_noise import (
    PAPER_LEVEL,
    ROUNDING_VARIANCE,
    DotImage,
    dot_error,
)
from locatk.core.dots.design.pose_accuracy import PoseAccuracy, pose_accuracy
from locatk.core.dots.design.read_rate import (
    MAX_MOTION_PITCHES,
    MAX_SHEAR,
    MIN_PX_PER_PITCH,
    read_rate,
    reading_limit,
    searched_levels,
)
from locatk.core.errors import InputError
from locatk.core.materials import BillItem
from locatk.core.units import length_text

MIN_WINDOW_DOTS = 8
"""Columns and rows of the smallest window that is decoded (Hostettler et al. 2016, II-B.6)."""

GOOD_WINDOW_DOTS = 12
"""Columns and rows with which missing and wrong dots do no harm."""

EXPOSURE_MOTION_PITCHES = 1 / 11
"""Motion during a chosen exposure: one pixel of the paper's camera, whose pitch is 11 px."""

DIM_EXPOSURE_MOTION_PITCHES = 0.4
"""Motion during a chosen exposure, at most, if the light is too little for a shorter one: half of
what is decoded."""

MAX_PX_PER_PITCH = 40.0
"""Pixels per pitch of a searched image beyond which it shows too few dots, whatever its size: the
decoder halves images until their shorter side is about 120 px."""

UNREADABLE_MOTION_PITCHES, UNREADABLE_BLUR_PITCHES = 2.0, 0.5
"""Motion and standard deviation of blur beyond which no dot is left in a frame."""

UNREADABLE_LIMIT = (
    "no dot is left by blur, motion or the size of its image: blur less, by the f-number, focus "
    "and exposure, or change the distance"
)
"""Reason and remedy of these."""

GOOD_READ_RATE = 0.95
"""Fraction of decoded frames below which there is a warning."""

NEGLIGIBLE_FRACTION = 0.01
"""Fraction of frames not decoded at one size from which no other size is considered."""

MAX_LIGHT_DEFICIT = 4.0
"""Ratio of the light that is needed to the least that passes without a warning."""

DECODING_S_PER_PX = 0.29e-3 / (188 * 120)
"""Time to decode a frame per pixel of the image that is searched: 0.29 ms for a frame of the paper
on a core of a PC (`locatk bench dots`)."""

PRINT_SIGMA_M = 0.09e-3
"""Error of positions on an uncalibrated laser print within 200 mm, standard deviation per axis: the
largest errors of 121 positions of the paper, 0.155 mm across and 0.273 mm along the feed (Table
III), are 2.5 standard deviations; the mean square of both axes. `locatk calibrate printer` and
`calibrate sheet` remove most of it."""

STANDARD_FOCAL_LENGTHS_M = (
    1.8e-3, 2.1e-3, 2.5e-3, 2.8e-3, 3.6e-3, 4e-3, 5.5e-3, 6e-3, 8e-3, 12e-3, 16e-3,
)  # fmt: skip
"""Focal lengths in which lenses with an M12 thread are sold."""

PREFERRED_DISTANCE_M = 0.020
"""Distance from lens to paper if it can be chosen: a robot of low height, and room for the LEDs."""


@dataclass(frozen=True)
class CameraReport:
    """Figures of a camera over dots.

    Attributes
    ----------
    setup : CameraSetup
    magnification : float
    metres_per_px : float
        Width of a pixel on the paper.
    field_m : (width, height)
    pixels_per_pitch : float
    searched_px_per_pitch : float
        In the image that the decoder searches, which is halved several times if the frame is large.
    dots_in_view : (columns, rows)
        With the grid parallel to the frame.
    window_dots : int
        Columns and rows of the largest square of dots that is in view in any direction.
    used_dots : float
        Number of dots of a frame that determine its pose.
    image_distance_m : float
        From the lens to the sensor.
    near_m, far_m : float
        Distances from the lens between which the dots are sharp enough to be decoded.
    circle_of_confusion_m : float
        Tolerated diameter of the blur on the sensor.
    airy_px, blur_px : float
        Diameter of the diffraction disc, and standard deviation of all blur but motion.
    distortion_px : float
        Displacement of the corner by the lens.
    motion_px, rotation_px : float
        Motion blur by the speed, and by the rotation at the corner.
    one_pixel_speed_mps, one_pixel_yaw_rate_rps : float
        Speeds with a motion blur of one pixel: by translation, and by rotation at the pixel in the
        middle of the farther edge (paper, III-A.2).
    max_exposure_s : float
        Longest exposure with which the frames at the wanted speeds are decoded.
    max_speed_mps, max_yaw_rate_rps : float
        Largest speeds at which frames with this exposure are decoded, each without the other.
    needed_illuminance_lx, full_illuminance_lx : float
        On the paper: from which more light hardly helps, and for a well exposed frame without gain.
    noise_levels : float
        Standard deviation of a pixel of paper in grey values.
    dot_sigma_m : float
        Standard deviation of the position of a dot on the paper per axis, printer included.
    position_sigma_m, heading_sigma_rad : float
        Standard deviations of a pose of one frame, relative to the dots in view; position per axis.
    absolute_position_sigma_m : float
        Position per axis with the error of an uncalibrated print, :data:`PRINT_SIGMA_M`.
    read_rate : float
        Fraction of the frames that are decoded.
    needed_fps : float
        Frames per second for the wanted rate of poses.
    pose_rate_hz : float
        Poses per second at the largest frame rate.
    pose_spacing_m : float
        Distance between two poses at the wanted speed.
    latency_s : float
        From the middle of the exposure to the pose, on a PC.
    materials : tuple of BillItem
    warnings : tuple of str
        Requirements that are not met, with figures and remedies.
    """

    setup: CameraSetup
    magnification: float
    metres_per_px: float
    field_m: tuple[float, float]
    pixels_per_pitch: float
    searched_px_per_pitch: float
    dots_in_view: tuple[int, int]
    window_dots: int
    used_dots: float
    image_distance_m: float
    near_m: float
    far_m: float
    circle_of_confusion_m: float
    airy_px: float
    blur_px: float
    distortion_px: float
    motion_px: float
    rotation_px: float
    one_pixel_speed_mps: float
    one_pixel_yaw_rate_rps: float
    max_exposure_s: float
    max_speed_mps: float
    max_yaw_rate_rps: float
    needed_illuminance_lx: float
    full_illuminance_lx: float
    noise_levels: float
    dot_sigma_m: float
    position_sigma_m: float
    heading_sigma_rad: float
    absolute_position_sigma_m: float
    read_rate: float
    needed_fps: float
    pose_rate_hz: float
    pose_spacing_m: float
    latency_s: float
    materials: tuple[BillItem, ...] = field(repr=False)
    warnings: tuple[str, ...] = ()

    @property
    def depth_of_field_m(self) -> float:
        """Range of distances in which the dots are sharp enough."""
        return self.far_m - self.near_m


def design_camera(setup: CameraSetup) -> CameraReport:
    """Predict optics, read rate and accuracy of a camera over dots."""
    mpp = setup.metres_per_px
    blur_px = static_blur_px(setup)
    confusion_m = tolerated_confusion_m(setup)
    near_m, far_m = focus_range(setup, confusion_m)
    noise = noise_levels(setup)
    quality = _frame_quality(setup, blur_px, noise)
    corner_m = setup.corner_m
    speed_px = setup.exposure_s * setup.speed_mps / mpp
    rotation_px = setup.exposure_s * setup.yaw_rate_rps * corner_m / mpp
    tolerated_m = MAX_MOTION_PITCHES * setup.pitch_m
    corner_mps = setup.corner_speed_mps
    fps = frame_rate(setup)
    decoding_s = DECODING_S_PER_PX * math.prod(setup.size_px) / 4**quality.level
    report = CameraReport(
        setup=setup,
        magnification=setup.magnification,
        metres_per_px=mpp,
        field_m=setup.field_m,
        pixels_per_pitch=setup.pitch_m / mpp,
        searched_px_per_pitch=setup.pitch_m / mpp / 2**quality.level,
        dots_in_view=(
            int(setup.field_m[0] / setup.pitch_m),
            int(setup.field_m[1] / setup.pitch_m),
        ),
        window_dots=window_in_view(min(setup.field_m), setup.pitch_m),
        used_dots=quality.accuracy.dots,
        image_distance_m=setup.image_distance_m,
        near_m=near_m,
        far_m=far_m,
        circle_of_confusion_m=confusion_m,
        airy_px=diffraction_disc_m(setup) / setup.pixel_m,
        blur_px=blur_px,
        distortion_px=abs(setup.lens.distortion) * math.hypot(*setup.size_px) / 2,
        motion_px=speed_px,
        rotation_px=rotation_px,
        one_pixel_speed_mps=mpp / setup.exposure_s,
        one_pixel_yaw_rate_rps=1 / (setup.exposure_s * (max(setup.size_px) - 1) / 2),
        max_exposure_s=math.inf if corner_mps == 0 else tolerated_m / corner_mps,
        max_speed_mps=tolerated_m / setup.exposure_s,
        max_yaw_rate_rps=tolerated_m / (setup.exposure_s * corner_m),
        needed_illuminance_lx=needed_illuminance_lx(setup),
        full_illuminance_lx=full_illuminance_lx(setup),
        noise_levels=noise,
        dot_sigma_m=quality.dot_sigma_m,
        position_sigma_m=quality.accuracy.position_pitches * setup.pitch_m,
        heading_sigma_rad=quality.accuracy.heading_rad,
        absolute_position_sigma_m=math.hypot(
            quality.accuracy.position_pitches * setup.pitch_m, PRINT_SIGMA_M
        ),
        read_rate=quality.read_rate,
        needed_fps=setup.wanted_rate_hz / max(quality.read_rate, 1e-3),
        pose_rate_hz=quality.read_rate * min(fps, 1 / decoding_s),
        pose_spacing_m=setup.speed_mps / (fps * max(quality.read_rate, 1e-3)),
        latency_s=setup.exposure_s / 2 + 1 / setup.sensor.max_fps + decoding_s,
        materials=camera_materials(
            setup.sensor.name,
            setup.lens.focal_m,
            setup.wavelength_m,
            is_colour=setup.sensor.is_colour,
        ),
    )
    return replace(report, warnings=tuple(_warnings(report, quality.limit)))


# ---- read rate and accuracy


@dataclass(frozen=True)
class _FrameQuality:
    """Read rate of frames, and accuracy of those that are decoded at a number of halvings."""

    level: int
    read_rate: float
    dot_sigma_m: float
    accuracy: PoseAccuracy
    limit: str


def _frame_quality(setup: CameraSetup, blur_px: float, noise: float) -> _FrameQuality:
    """Return the quality at the sizes of a frame that the decoder tries, best first.

    The accuracy is that of the first size at which most frames are decoded, otherwise of the best.
    """
    accurate = None
    best = None
    missed = 1.0
    for level in searched_levels(setup.size_px):
        candidate = _quality_at_level(setup, blur_px, noise, level)
        missed *= 1 - candidate.read_rate
        if accurate is None and candidate.read_rate > 0.5:
            accurate = candidate
        if best is None or candidate.read_rate > best.read_rate:
            best = candidate
        if missed < NEGLIGIBLE_FRACTION:
            break
    assert best is not None
    return replace(accurate or best, read_rate=1 - missed)


def _quality_at_level(
    setup: CameraSetup, blur_px: float, noise: float, level: int
) -> _FrameQuality:
    factor = 2**level
    mpp = setup.metres_per_px * factor
    size = (setup.size_px[0] // factor, setup.size_px[1] // factor)
    pitch_px = setup.pitch_m / mpp
    # Halved images are rounded once more.
    variance = (noise**2 + ROUNDING_VARIANCE) / factor**2 + (ROUNDING_VARIANCE if level else 0.0)
    motion_px = setup.exposure_s * setup.speed_mps / mpp
    # A rotation blurs the dots of a frame in all directions, in the mean square like this.
    radius_px = math.hypot(*size) / math.sqrt(12)
    rotation_px = setup.exposure_s * setup.yaw_rate_rps * radius_px
    if (
        pitch_px > MAX_PX_PER_PITCH
        or motion_px > UNREADABLE_MOTION_PITCHES * pitch_px
        or math.hypot(blur_px / factor, rotation_px) > UNREADABLE_BLUR_PITCHES * pitch_px
    ):
        no_pose = PoseAccuracy(math.inf, math.inf, 0.0)
        return _FrameQuality(level, 0.0, math.inf, no_pose, UNREADABLE_LIMIT)
    image = DotImage(
        pitch_px=pitch_px,
        diameter_px=setup.dot_pitches * pitch_px,
        blur_px=math.hypot(blur_px / factor, rotation_px / math.sqrt(24)),
        motion_px=motion_px,
        noise=math.sqrt(variance) / PAPER_LEVEL,
        contrast=setup.contrast,
        jitter_px=setup.jitter_m / mpp,
    )
    error = dot_error(image)
    accuracy = pose_accuracy(
        size, pitch_px, error.total_px, is_lens_known=setup.is_calibrated
    ).with_fraction(error.used_fraction)
    rate = read_rate(error, accuracy.dots, pitch_px)
    limit = reading_limit(error, accuracy.dots, pitch_px)
    return _FrameQuality(level, rate, error.total_px * mpp, accuracy, limit)


# ---- warnings


def _warnings(report: CameraReport, limit: str) -> Iterator[str]:
    """Yield the requirements that are not met, most important first.

    ``limit`` is what limits the read rate.
    """
    setup = report.setup
    yield from _field_warnings(report)
    yield from _light_warnings(report)
    if setup.focus_error_m > min(setup.distance_m - report.near_m, report.far_m - setup.distance_m):
        yield (
            f"the depth of field, {length_text(report.depth_of_field_m)}, is less than twice the "
            f"error of the distance, {length_text(setup.focus_error_m)}: choose an f-number above "
            f"{setup.lens.f_number:g}, or a stiffer holder"
        )
    if setup.sensor.shutter == "rolling":
        skew = setup.speed_mps / setup.sensor.max_fps / min(setup.field_m)
        if skew > MAX_SHEAR:
            slower = MAX_SHEAR * min(setup.field_m) * setup.sensor.max_fps
            yield (
                f"the rolling shutter shears the frame by {skew:.2f} at {setup.speed_mps:g} m/s, "
                f"more than the {MAX_SHEAR:g} that are decoded: drive at most {slower:.2g} m/s, or "
                "choose a sensor with a global shutter"
            )
    fps = frame_rate(setup)
    if report.needed_fps > fps * (1 + 1e-9):
        yield (
            f"{setup.wanted_rate_hz:g} poses per second need {report.needed_fps:.3g} frames per "
            f"second, and the camera takes {fps:.3g}: choose a faster sensor, or accept "
            f"{report.pose_rate_hz:.3g} poses per second"
        )
    if report.read_rate < GOOD_READ_RATE:
        yield (
            f"only {100 * report.read_rate:.0f} % of the frames are expected to be decoded, "
            f"because {limit}"
        )


def _field_warnings(report: CameraReport) -> Iterator[str]:
    setup = report.setup
    if report.window_dots < MIN_WINDOW_DOTS:
        needed_m = window_diagonal_m(MIN_WINDOW_DOTS, setup.pitch_m)
        farther_m = distance_for_field(setup, needed_m)
        yield (
            f"only {report.window_dots} x {report.window_dots} dots are in view in any direction, "
            f"and a position needs {MIN_WINDOW_DOTS} x {MIN_WINDOW_DOTS}: the shorter side of the "
            f"field has to be {length_text(needed_m)}, as with a distance of "
            f"{length_text(farther_m)}"
        )
    if report.pixels_per_pitch < MIN_PX_PER_PITCH:
        nearer_m = distance_for_field(
            setup,
            min(setup.field_m) * report.pixels_per_pitch / (1.2 * MIN_PX_PER_PITCH),
        )
        yield (
            f"{report.pixels_per_pitch:.1f} px per pitch are less than the {MIN_PX_PER_PITCH:g} "
            f"that the decoder needs: move the lens to {length_text(nearer_m)}, choose more pixels "
            "or a longer focal length"
        )


def _light_warnings(report: CameraReport) -> Iterator[str]:
    setup = report.setup
    if setup.exposure_s > report.max_exposure_s * (1 + 1e-9):
        yield (
            f"the exposure of {setup.exposure_s * 1e6:.0f} us blurs the corner by "
            f"{report.motion_px + report.rotation_px:.1f} px at the wanted speed: expose at most "
            f"{report.max_exposure_s * 1e6:.0f} us, or drive at most {report.max_speed_mps:.2g} m/s"
        )
    if setup.exposure_s < setup.sensor.min_exposure_s:
        yield (
            f"the sensor exposes at least {setup.sensor.min_exposure_s * 1e6:.0f} us, not "
            f"{setup.exposure_s * 1e6:.0f} us: pulse the LEDs instead"
        )
    if setup.illuminance_lx is not None and setup.noise_levels is None:
        excess = setup.illuminance_lx / report.full_illuminance_lx
        if excess > MAX_LEVEL / PAPER_LEVEL:
            yield (
                f"the paper is overexposed {excess:.1f} times: expose "
                f"{setup.exposure_s / excess * 1e6:.0f} us, or dim the light to "
                f"{illuminance_text(report.full_illuminance_lx)}"
            )
        elif setup.illuminance_lx < report.needed_illuminance_lx / MAX_LIGHT_DEFICIT:
            yield (
                f"the light, {illuminance_text(setup.illuminance_lx)}, gives a noise of "
                f"{report.noise_levels:.0f} grey values: light the paper with "
                f"{illuminance_text(report.needed_illuminance_lx)}, as by pulsed LEDs"
            )


# ---- choices


def suggest_camera(
    sensor: Sensor,
    *,
    focal_m: float | None = None,
    distance_m: float | None = None,
    exposure_s: float | None = None,
    window_dots: int = GOOD_WINDOW_DOTS,
    f_number: float = 2.4,
    distortion: float = 0.02,
    **conditions: Any,
) -> CameraSetup:
    """Choose focal length, distance and exposure that are not given, for a window of dots.

    The shorter side of the field shows ``window_dots`` columns and rows in any direction. The focal
    length is one in which M12 lenses are sold. The exposure is the longest with which a dot moves
    by less than :data:`EXPOSURE_MOTION_PITCHES` at the wanted speeds, and which the frame rate
    leaves time for; longer if a given light needs it.

    Parameters
    ----------
    sensor : Sensor
    focal_m, distance_m, exposure_s : float, optional
        Given values are kept.
    window_dots : int
    f_number, distortion : float
        Of the lens.
    **conditions
        Further attributes of :class:`CameraSetup`.

    Raises
    ------
    InputError
        See :class:`CameraSetup`.
    """
    if not 1 <= window_dots <= 100:
        raise InputError(f"a window of {window_dots} dots", hint="Give 8 to 40; 12 is good")

    def setup_of(focal_m: float, distance_m: float, exposure_s: float = 1e-4) -> CameraSetup:
        lens = Lens(focal_m, f_number, distortion)
        return CameraSetup(sensor, lens, distance_m, exposure_s, **conditions)

    if focal_m is not None and distance_m is None:
        distance_m = _distance_for_dots(setup_of(focal_m, 2 * focal_m), window_dots)
    elif focal_m is None:
        aim_m = PREFERRED_DISTANCE_M if distance_m is None else distance_m
        focal_m, chosen_m = _standard_lens(setup_of, aim_m, window_dots)
        distance_m = chosen_m if distance_m is None else distance_m
    assert focal_m is not None
    assert distance_m is not None
    setup = setup_of(focal_m, distance_m)
    if exposure_s is None:
        exposure_s = _chosen_exposure(setup)
    return replace(setup, exposure_s=exposure_s)


def _distance_for_dots(setup: CameraSetup, window_dots: int) -> float:
    return distance_for_field(setup, window_diagonal_m(window_dots, setup.pitch_m))


def _standard_lens(
    setup_of: Callable[[float, float], CameraSetup], aim_m: float, window_dots: int
) -> tuple[float, float]:
    """Return the standard focal length and its distance for the window, nearest to ``aim_m``.

    Of the lenses that show the window at ``aim_m`` or nearer, the longest is taken: its field is
    the smallest that is large enough.
    """
    distances = {
        focal_m: _distance_for_dots(setup_of(focal_m, 2 * focal_m), window_dots)
        for focal_m in STANDARD_FOCAL_LENGTHS_M
    }
    suitable = [focal_m for focal_m, distance_m in distances.items() if distance_m <= aim_m]
    focal_m = max(suitable, default=STANDARD_FOCAL_LENGTHS_M[0])
    return focal_m, distances[focal_m]


def _chosen_exposure(setup: CameraSetup) -> float:
    """Return the exposure for the speeds, the frame rate and the light of a setup."""
    corner_mps = setup.corner_speed_mps
    by_rate = 0.5 / max(setup.wanted_rate_hz, setup.sensor.max_fps)
    if corner_mps == 0:
        return by_rate
    exposure_s = EXPOSURE_MOTION_PITCHES * setup.pitch_m / corner_mps
    if setup.illuminance_lx is not None:
        by_light = setup.exposure_s * needed_illuminance_lx(setup) / setup.illuminance_lx
        longest = DIM_EXPOSURE_MOTION_PITCHES * setup.pitch_m / corner_mps
        exposure_s = min(max(exposure_s, by_light), longest)
    return max(min(exposure_s, by_rate), setup.sensor.min_exposure_s)


@dataclass(frozen=True)
class SensorFit:
    """Sensor for a task: the setup chosen for it, its figures, and why it does not fit."""

    sensor: Sensor
    report: CameraReport
    reasons: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """True if all requirements are met."""
        return not self.reasons


def compare_sensors(sensors: Iterable[Sensor], **wanted: Any) -> tuple[SensorFit, ...]:
    """Choose a setup for each sensor, with the arguments of :func:`suggest_camera`.

    Sensors that fit come first, then in the order given.
    """
    fits = []
    for sensor in sensors:
        report = design_camera(suggest_camera(sensor, **wanted))
        fits.append(SensorFit(sensor, report, report.warnings))
    return tuple(sorted(fits, key=lambda fit: not fit.fits))
