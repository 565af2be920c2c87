"""Evaluation of the design of a tag: field, noise, accuracy and limits, before the tag is made.

The field is that of a disc (closed form of magpylib) and the accuracy is the Cramer-Rao bound. A
limit that the design exceeds becomes a warning with figures and a remedy; an assumption becomes a
note.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import magpylib
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_field
from locatk.core.materials import BillItem
from locatk.core.polaris import codec
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.design.accuracy_bound import (
    AccuracyBound,
    NuisanceModel,
    accuracy_bound,
)
from locatk.core.polaris.design.environment import QUIET, Environment
from locatk.core.polaris.design.materials import bill_of_materials
from locatk.core.polaris.identification.matching import AS_BUILT_SIGMA_M, HAND_BUILT_SIGMA_M
from locatk.core.polaris.mlx90393 import Settings, published_bar, settings_for_rate
from locatk.core.polaris.tag import Magnet, TagLayout, Tags
from locatk.core.units import length_text

Array = NDArray[np.float64]

SEPARATION_FIELD_FRACTION = 0.1
"""Fraction of its peak to which the field of a magnet, along the moment, falls half a spacing away
from it if two magnets are separate. This rule reproduces the spacings of the Polaris paper."""

COMPACT_SPACING_FRACTION = 0.8
"""Smallest spacing as a fraction of that of separate magnets (Polaris paper, section 5.2.3)."""

PLACEMENT_SIGMA_RAD = math.radians(6)
"""Standard deviation of the orientation of magnets placed by hand, as measured on the recordings of
the published tags (github.com/wjk5117/Polaris); the worst of their ten magnets is off by 13
degrees."""

MERGED_PEAK_SPACING_CLEARANCES = 1.5
"""Largest spacing, in clearances, at which the peaks of two magnets merge for some orientations:
for 10 of 256 pairs of orientations of dipoles (:func:`neighbour_error`)."""

ORIENTATION_MARGIN_SIGMAS = 3.0
"""Standard deviations of the angle of a magnet that half a step of orientation must exceed."""

MIN_SIGNAL_TO_NOISE = 6.0
"""Smallest ratio of signal to noise midway between two sensors at which noise is not detected as
magnets."""

MIN_SAMPLES_PER_FIELD = 2.0
"""Smallest number of samples over the half-width of the field of a magnet."""

MIN_SAMPLES_PER_PEAK = 5.0
"""Number of samples over the half-width of a field from which peaks are found reliably."""

MAX_EARTH_FIELD_T = 65e-6
"""Strongest magnetic field of the Earth on its surface (near the poles)."""

PROBABILITY = 0.95
"""Probability of the errors that a forecast or a search states."""

NORMAL_QUANTILE = 1.96
"""Error of one component in standard deviations that is not exceeded with it."""

SAMPLED_LAYOUTS = 8
"""Number of layouts of a family over which the accuracy is averaged."""


@dataclass(frozen=True)
class ReadingConditions:
    """Conditions under which tags are read.

    Attributes
    ----------
    sensors, sensor_spacing_m : int, float
        Number and spacing of the sensors of the bar.
    settings : Settings
        Settings of the magnetometers.
    noise_t : float or None
        Standard deviation of a sample on each axis; by default that of the magnetometer.
    rate_hz : float or None
        Sampling rate; by default the highest of the magnetometer.
    speed_mps : float
    placement_rad : float or None
        Standard deviation of the orientations of the placed magnets; by default as measured on the
        tags as built, otherwise :data:`PLACEMENT_SIGMA_RAD`.
    environment : Environment
        Magnetic fields that vary during a pass.
    """

    sensors: int = 9
    sensor_spacing_m: float = 0.02
    settings: Settings = field(default_factory=Settings)
    noise_t: float | None = None
    rate_hz: float | None = None
    speed_mps: float = 0.1
    placement_rad: float | None = None
    environment: Environment = QUIET

    @property
    def array_m(self) -> float:
        """Distance between the outermost sensors."""
        return (self.sensors - 1) * self.sensor_spacing_m

    @property
    def step_m(self) -> float:
        """Distance between two samples."""
        return self.speed_mps / min(self.rate_hz or math.inf, self.settings.max_rate_hz)


@dataclass(frozen=True)
class DesignReport:
    """Expected performance of a design. The names of the fields are keys of the JSON output.

    Attributes
    ----------
    tags : Tags
    use : ReadingConditions
    capacity : int
        Number of ids of the codec.
    peak_t, between_t : float
        Field of one magnet directly above it, and midway between two sensors.
    half_along_m, half_across_m : float
        Full width of the field at half of the peak, along the moment and across it.
    min_spacing_m, compact_spacing_m : float
        Spacing by :data:`SEPARATION_FIELD_FRACTION`, and :data:`COMPACT_SPACING_FRACTION` of it.
    neighbour_angle_rad, neighbour_shift_m : float
        Largest errors of a method that evaluates one magnet at a time, due to one neighbour;
        ``nan`` if the peaks merge.
    noise_t : (3,) ndarray
        Standard deviation of a sample by axis of the array.
    noise_from : {"given", "measured", "assumed"}
        Origin of ``noise_t``.
    signal_to_noise, between_to_noise : float
        ``peak_t`` and ``between_t`` over the noise of the horizontal axes, which includes the
        fields of the environment that differ between sensors.
    max_rate_hz, rate_hz : float
        Highest rate of the magnetometer, and the rate of this report.
    step_m : float
        Distance from sample to sample.
    samples : float
        Number of samples over ``half_across_m``.
    max_speed_mps : float
        Speed at which ``samples`` is :data:`MIN_SAMPLES_PER_FIELD`.
    range_t : float
        Smallest range of the axes.
    known_speed, free_speed : AccuracyBound
        Accuracy of one pass if the speed is known, and if each step is unknown; ``nan`` if there
        are too few samples.
    placed : AccuracyBound
        ``free_speed`` with the errors of the magnets in the tag: of their positions
        (``build_m``) and orientations (``placement_rad``).
    build_m : float
        Standard deviation of the position of a magnet in the tag along each axis.
    placement_rad : float
        Standard deviation of the orientations of the placed magnets.
    max_orientations : int
        Largest P that this error permits.
    misread : float
        Probability that the orientation of any magnet of a tag is off by more than half a step.
    array_m, tag_m, diagonal_m : float
        Widths of the array, of the tag, and of the tag at 45 degrees.
    play_m : float
        Largest lateral offset of the tag at which all magnets are below the array.
    materials : tuple of BillItem
    warnings, notes : tuple of str
    """

    tags: Tags
    use: ReadingConditions
    capacity: int
    peak_t: float
    between_t: float
    half_along_m: float
    half_across_m: float
    min_spacing_m: float
    compact_spacing_m: float
    neighbour_angle_rad: float
    neighbour_shift_m: float
    noise_t: Array
    noise_from: str
    signal_to_noise: float
    between_to_noise: float
    max_rate_hz: float
    rate_hz: float
    step_m: float
    samples: float
    max_speed_mps: float
    range_t: float
    known_speed: AccuracyBound
    free_speed: AccuracyBound
    placed: AccuracyBound
    build_m: float
    placement_rad: float
    max_orientations: int
    misread: float
    array_m: float
    tag_m: float
    diagonal_m: float
    play_m: float
    materials: tuple[BillItem, ...]
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def disc_field(magnet: Magnet, points: Array) -> Array:
    """Return the flux density (n, 3) in tesla of a disc at ``points`` (n, 3) in metres.

    The disc is at the origin with its moment along x. The field is the closed form of a cylinder of
    magpylib.
    """
    source = magpylib.magnet.Cylinder(
        polarization=(magnet.remanence_t, 0, 0),
        dimension=(magnet.diameter_m, magnet.height_m),
    )
    with np.errstate(over="ignore", invalid="ignore"):  # far away, the field is 0
        return np.asarray(source.getB(points), float).reshape(-1, 3)


def field_width(
    magnet: Magnet, clearance_m: float, fraction: float, *, across: bool = False
) -> float:
    """Return the full width in metres at which the field falls to a fraction of its peak.

    The width is along the moment or across it, ``clearance_m`` above the centre of the magnet.
    """
    axis = np.array([0.0, 1.0, 0.0]) if across else np.array([1.0, 0.0, 0.0])
    peak = _field_strength(magnet, [0, 0, clearance_m])

    def excess(distance: float) -> float:
        return _field_strength(magnet, distance * axis + [0, 0, clearance_m]) - fraction * peak

    outer = clearance_m + magnet.diameter_m
    while excess(outer) > 0:
        outer *= 2
    return float(2 * brentq(excess, 0, outer, xtol=1e-7))


def compact_spacing(magnet: Magnet, clearance_m: float) -> float:
    """Return the smallest spacing by the rule of the Polaris paper, rounded up to whole mm.

    Raises
    ------
    InputError
        The sensors would be within the magnet.
    """
    _check_clearance(magnet, clearance_m)
    exact = COMPACT_SPACING_FRACTION * field_width(magnet, clearance_m, SEPARATION_FIELD_FRACTION)
    return math.ceil(exact * 1e3 - 1e-6) / 1e3


def neighbour_error(spacing_m: float, clearance_m: float) -> tuple[float, float]:
    """Return the largest errors of angle (rad) and position (m) due to one equal neighbour.

    They are those of a magnet that is evaluated at the peak of its field, as by the Polaris paper,
    over 16 x 16 orientations of dipoles. Both are ``nan`` for spacings of up to
    :data:`MERGED_PEAK_SPACING_CLEARANCES` clearances.
    """
    if spacing_m <= MERGED_PEAK_SPACING_CLEARANCES * clearance_m:
        return math.nan, math.nan
    angle_rad = np.arange(16) * math.tau / 16
    moments = np.column_stack([np.cos(angle_rad), np.sin(angle_rad), 0 * angle_rad])
    peak_position = np.zeros((1, 1, 1, 3))
    for half_side, count in ((0.4 * clearance_m, 41), (0.02 * clearance_m, 9)):
        line = np.linspace(-half_side, half_side, count)
        x, y = np.meshgrid(line, line)
        points = peak_position + np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
        points[..., 2] = clearance_m
        own_field = dipole_field(points, moments[:, None, None])
        neighbour_field = dipole_field(points - [spacing_m, 0, 0], moments[None, :, None])
        total = own_field + neighbour_field
        peak = np.einsum("abpi,abpi->abp", total, total).argmax(-1)[..., None, None]
        peak_position = np.take_along_axis(points, peak, 2)
    peak_field = -np.take_along_axis(total, peak, 2)[:, :, 0]
    error_rad = np.arctan2(peak_field[..., 1], peak_field[..., 0]) - angle_rad[:, None]
    error_rad = np.abs((error_rad + math.pi) % math.tau - math.pi)
    shift_m = np.hypot(peak_position[..., 0], peak_position[..., 1])
    return float(error_rad.max()), float(shift_m.max())


def evaluate_design(
    tags: Tags, use: ReadingConditions | None = None, count: int = 1
) -> DesignReport:
    """Evaluate the design of tags for the conditions under which they are read.

    Parameters
    ----------
    tags : Tags
    use : ReadingConditions, optional
    count : int
        Number of tags in the bill of materials.

    Raises
    ------
    InputError
        The design is impossible (:func:`locatk.core.polaris.codec.check_design`); spacing,
        clearance, speed, rate, noise or placement error is not positive; magnets overlap or extend
        into the sensors; or the bar has no sensors.
    """
    use = use or ReadingConditions()
    capacity = codec.capacity(tags)
    magnet, clearance, part = tags.magnet, tags.clearance_m, use.settings
    _check_clearance(magnet, clearance)
    for name, value in (
        ("spacing", tags.spacing_m),
        ("speed", use.speed_mps),
        ("rate", use.rate_hz),
        ("noise", use.noise_t),
        ("placement error", use.placement_rad),
    ):
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise InputError(f"the {name} is {value:g} and must be positive")
    if magnet.diameter_m > tags.spacing_m:
        raise InputError(
            f"magnets of {magnet.diameter_m * 1e3:g} mm do not fit a spacing of "
            f"{tags.spacing_m * 1e3:g} mm"
        )

    array, noise_from = sensor_array(use)
    horizontal_noise = horizontal_noise_t(array, use.environment)
    midway = use.sensor_spacing_m / 2 if use.sensors > 1 else 0.0
    peak = _field_strength(magnet, [0, 0, clearance])
    between = min(
        _field_strength(magnet, [midway, 0, clearance]),
        _field_strength(magnet, [0, midway, clearance]),
    )
    separate_spacing = field_width(magnet, clearance, SEPARATION_FIELD_FRACTION)
    half_across = field_width(magnet, clearance, 0.5, across=True)
    step = use.step_m
    rate = use.speed_mps / step
    layouts = sample_layouts(tags, SAMPLED_LAYOUTS)
    environment = use.environment
    placement = _placement_sigma(tags) if use.placement_rad is None else use.placement_rad
    build = AS_BUILT_SIGMA_M if tags.built else HAND_BUILT_SIGMA_M
    free_speed = _accuracy(tags, layouts, array, step, "steps", environment)
    reading = free_speed.angle_rad if math.isfinite(free_speed.angle_rad) else 0.0
    angle_sigma = math.hypot(placement, reading)
    half_step_sigmas = math.pi / tags.orientations / angle_sigma
    neighbour_angle, neighbour_shift = neighbour_error(tags.spacing_m, clearance)
    tag_width = (tags.order - 1) * tags.spacing_m
    array_width = use.array_m
    report = DesignReport(
        tags=tags,
        use=use,
        capacity=capacity,
        peak_t=peak,
        between_t=between,
        half_along_m=field_width(magnet, clearance, 0.5),
        half_across_m=half_across,
        min_spacing_m=separate_spacing,
        compact_spacing_m=COMPACT_SPACING_FRACTION * separate_spacing,
        neighbour_angle_rad=neighbour_angle,
        neighbour_shift_m=neighbour_shift,
        noise_t=array.noise_t,
        noise_from=noise_from,
        signal_to_noise=peak / horizontal_noise,
        between_to_noise=between / horizontal_noise,
        max_rate_hz=part.max_rate_hz,
        rate_hz=rate,
        step_m=step,
        samples=half_across / step,
        max_speed_mps=half_across * rate / MIN_SAMPLES_PER_FIELD,
        range_t=float(np.min(array.range_t)),
        known_speed=_accuracy(tags, layouts, array, step, "strength", environment),
        free_speed=free_speed,
        placed=_accuracy(tags, layouts, array, step, "steps", environment, build, placement),
        build_m=build,
        placement_rad=placement,
        max_orientations=int(math.pi / (ORIENTATION_MARGIN_SIGMAS * angle_sigma)),
        misread=1 - math.erf(half_step_sigmas / math.sqrt(2)) ** tags.magnets,
        array_m=array_width,
        tag_m=tag_width,
        diagonal_m=math.sqrt(2) * tag_width,
        play_m=(array_width - tag_width) / 2,
        materials=bill_of_materials(tags, use.sensors, "Melexis MLX90393", count),
    )
    return replace(report, warnings=tuple(_warnings(report)), notes=tuple(_notes(report)))


def sample_layouts(tags: Tags, count: int) -> list[TagLayout]:
    """Return the layouts of ``count`` random tags of the family, the same ones at every call."""
    generator = random.Random(0)
    total = codec.capacity(tags) if tags.ids is None else len(tags.ids)
    numbers = [generator.randrange(total) for _ in range(count)]
    return [codec.layout_of(tags, n if tags.ids is None else tags.ids[n]) for n in numbers]


def horizontal_noise_t(array: SensorArray, environment: Environment) -> float:
    """Return the noise of x and y, with the fields of the environment that sensors do not share."""
    varying_t = 0.0 if environment.is_common else environment.field_t
    return float(np.sqrt(np.mean(array.noise_t[:2] ** 2) + varying_t**2))


def errors_text(position_m: float, heading_rad: float) -> str:
    """Format errors of position and heading."""
    return f"{length_text(position_m)} and {math.degrees(heading_rad):.2g} deg"


def _accuracy(
    tags: Tags,
    layouts: list[TagLayout],
    array: SensorArray,
    step_m: float,
    nuisance: NuisanceModel,
    environment: Environment,
    build_m: float = 0.0,
    build_rad: float = 0.0,
) -> AccuracyBound:
    """Return the accuracy bound; ``nan`` if there are too few samples to determine the magnets."""
    try:
        return accuracy_bound(
            tags,
            layouts,
            array,
            step_m=step_m,
            nuisance=nuisance,
            environment=environment,
            build_m=build_m,
            build_rad=build_rad,
        )
    except InputError:
        return AccuracyBound(*[math.nan] * 6)


def _placement_sigma(tags: Tags) -> float:
    """Return the rms orientation error of the tags as built, or the default if none is known."""
    if not tags.built:
        return PLACEMENT_SIGMA_RAD
    errors_rad = np.concatenate([built.angle_rad for built in tags.built.values()])
    return float(np.sqrt(np.mean(errors_rad**2)))


def sensor_array(use: ReadingConditions) -> tuple[SensorArray, str]:
    """Return the bar with its noise, and the origin of the noise."""
    settings = use.settings
    if use.noise_t is not None:
        noise_t, origin = np.full(3, use.noise_t), "given"
    elif np.isfinite(settings.noise_t).all():
        noise_t, origin = settings.noise_t, "measured"
    else:
        noise_t, origin = settings.assumed_noise_t, "assumed"
    return published_bar(use.sensors, use.sensor_spacing_m, settings, noise_t), origin


def _check_clearance(magnet: Magnet, clearance_m: float) -> None:
    """Check that the sensors are above the magnet."""
    if not clearance_m > magnet.height_m / 2 or not math.isfinite(clearance_m):
        raise InputError(
            f"the clearance is {clearance_m * 1e3:g} mm from the centre of a magnet "
            f"{magnet.height_m * 1e3:g} mm high",
            hint="Give the distance from the centre of the magnets to the sensors",
        )


def _field_strength(magnet: Magnet, point: Array | list[float]) -> float:
    """Return the magnitude of the flux density of a disc at one point, in tesla."""
    return float(np.linalg.norm(disc_field(magnet, np.asarray(point, float)[None])))


# ---- warnings and notes


def _warnings(report: DesignReport) -> Iterator[str]:
    """Describe the limits that a design exceeds, with figures and remedies."""
    tags, use = report.tags, report.use
    if use.rate_hz is not None and use.rate_hz > report.max_rate_hz:
        faster = settings_for_rate(use.rate_hz, use.settings)
        remedy = (
            "no osr and filt are that fast"
            if faster is None
            else f"osr {faster.osr} filt {faster.filt} gives {faster.max_rate_hz:.0f} Hz"
        )
        yield (
            f"{use.rate_hz:g} Hz is too fast: three axes take "
            f"{use.settings.conversion_s * 1e3:.2f} ms at osr {use.settings.osr} filt "
            f"{use.settings.filt}, at most {report.max_rate_hz:.1f} Hz, which the other figures "
            f"assume; {remedy}"
        )
    if report.samples < MIN_SAMPLES_PER_FIELD:
        yield (
            f"{use.speed_mps:g} m/s is too fast: {report.samples:.1f} samples over a magnet's "
            f"field of {length_text(report.half_across_m)}; drive at most "
            f"{report.max_speed_mps:.2f} m/s, or sample faster"
        )
    if report.between_to_noise < MIN_SIGNAL_TO_NOISE:
        disturbance = use.environment.field_t and not use.environment.is_common
        noise = f"noise and the {use.environment.name} environment" if disturbance else "noise"
        yield (
            f"the field is too weak: {report.between_t * 1e6:.2g} uT midway between two sensors, "
            f"{report.between_to_noise:.1f} times the {noise} and not {MIN_SIGNAL_TO_NOISE:g}; "
            "take larger magnets, less clearance or sensors closer together"
        )
    if report.peak_t + MAX_EARTH_FIELD_T > report.range_t:
        yield (
            f"the sensors saturate: {report.peak_t * 1e6:.0f} uT above a magnet and up to "
            f"{MAX_EARTH_FIELD_T * 1e6:.0f} uT of the Earth exceed their range of "
            f"{report.range_t * 1e6:.0f} uT; take a lower gain, a higher resolution or more "
            "clearance"
        )
    if tags.magnet.diameter_m > tags.clearance_m:
        yield (
            f"the magnets are too wide for the clearance: {length_text(tags.magnet.diameter_m)} at "
            f"{length_text(tags.clearance_m)}; their field has two peaks or a flat one, which the "
            "solver's dipoles do not have; keep the sensors at least a diameter away"
        )
    if tags.orientations > report.max_orientations:
        max_sigma_deg = 180 / ORIENTATION_MARGIN_SIGMAS / tags.orientations
        yield (
            f"{tags.orientations} orientations are too many: half a step is "
            f"{180 / tags.orientations:.3g} degrees, the magnets are placed to "
            f"{math.degrees(report.placement_rad):.2g} and read to "
            f"{math.degrees(report.free_speed.angle_rad):.2g} degrees rms, so that "
            f"{report.misread:.0%} of the tags have a misread magnet; take at most "
            f"{max(report.max_orientations, 1)}, or come to {max_sigma_deg:.2g} degrees with a jig "
            "or by calibration"
        )
    merged_spacing_m = MERGED_PEAK_SPACING_CLEARANCES * tags.clearance_m
    if tags.spacing_m <= merged_spacing_m:
        yield (
            f"the magnets are too close: {length_text(tags.spacing_m)} at a clearance of "
            f"{length_text(tags.clearance_m)}, so that two peaks may merge; keep them more than "
            f"{length_text(merged_spacing_m)} apart"
        )
    if report.play_m < -1e-9:
        sensors = math.ceil(report.tag_m / use.sensor_spacing_m - 1e-9) + 1
        yield (
            f"the tag is wider than the array: {length_text(report.tag_m)} against "
            f"{length_text(report.array_m)}; take {sensors} sensors or a smaller tag"
        )


def _notes(report: DesignReport) -> Iterator[str]:
    """Describe the assumptions and restrictions of a design that works."""
    tags, use = report.tags, report.use
    if report.noise_from == "assumed":
        yield (
            f"The noise at osr {use.settings.osr} filt {use.settings.filt} was never measured; "
            f"{report.noise_t[0] * 1e6:.2g} uT is assumed. Record a minute at standstill and give "
            "the noise of that recording."
        )
    merged_spacing_m = MERGED_PEAK_SPACING_CLEARANCES * tags.clearance_m
    if merged_spacing_m < tags.spacing_m < report.compact_spacing_m - 1e-9:
        yield (
            "The spacing is below the paper's rule of "
            f"{length_text(report.compact_spacing_m)}: solve by the method `joint`. A method that "
            "evaluates one magnet at a time has errors of up to "
            f"{math.degrees(report.neighbour_angle_rad):.1f} degrees and "
            f"{length_text(report.neighbour_shift_m)}."
        )
    if use.sensors > 1 and use.sensor_spacing_m > tags.spacing_m / 2 + 1e-9:
        yield (
            f"The sensors are {length_text(use.sensor_spacing_m)} apart, more than half the tag's "
            f"spacing ({length_text(tags.spacing_m / 2)}): the method `paper` needs two sensors "
            "for each magnet."
        )
    if MIN_SAMPLES_PER_FIELD <= report.samples < MIN_SAMPLES_PER_PEAK:
        yield (
            f"With {report.samples:.1f} samples over a magnet's field, peaks are hard to find: "
            "solve by the method `joint`."
        )
    if -1e-9 <= report.play_m < tags.spacing_m / 2:
        play = length_text(max(report.play_m, 0))
        yield f"The robot must meet the centre of the tag to within {play}."
    if report.play_m >= 0 and report.diagonal_m > report.array_m + 1e-9:
        yield (
            f"Crossed at 45 degrees the tag is {length_text(report.diagonal_m)} wide, more than "
            f"the array's {length_text(report.array_m)}: keep its heading near 0, 90, 180 or 270."
        )
    if use.environment.field_t > 0:
        yield (
            f"The environment {use.environment.name} is assumed to vary by "
            f"{use.environment.field_t * 1e6:.2g} uT during a pass. Drive the array over your "
            "floor without tags, and give the standard deviation of that recording as "
            "--environment; stronger magnets and less clearance reduce its effect, more sensors "
            "only that of noise."
        )
    if tags.codec == "mosk" and tags.min_distance < 2:
        yield (
            "Any id may occur, so one misread orientation is another tag: a family with a minimum "
            "distance detects it, and the codec `redundant` corrects it."
        )
