"""Will it work? Field, noise, accuracy and limits of a design, before a tag is made.

The field is magpylib's, of the disc as it is; the accuracy is the Cramer-Rao bound. What
will not work becomes a warning with numbers and what to do; what is good to know, a note.
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
from locatk.core.materials import Item
from locatk.core.polaris import codec
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.design.accuracy_bound import Bound, Unknown, bound
from locatk.core.polaris.design.materials import bill
from locatk.core.polaris.mlx90393 import Settings, published_bar, settings_for_rate
from locatk.core.polaris.tag import Magnet, TagLayout, Tags

Array = NDArray[np.float64]

WIDTH_LEVEL = 0.1
"""Two magnets are apart where the field of one, along its moment, has fallen to this part
of its peak half a spacing away: the rule that gives the paper's spacings."""

COMPACT = 0.8
"""The paper's smallest spacing against that (Polaris section 5.2.3)."""

PLACEMENT_RAD = math.radians(6)
"""Error of hand placement, rms: that of the published tags, worst 13 degrees."""

MERGED = 1.5
"""Clearances between two magnets up to which their peaks merge for some orientations."""

SIGMAS = 3.0
"""Standard deviations of a magnet's angle that must fit into half a step of orientation."""

WEAKEST = 6.0
"""Signal to noise midway between two sensors below which noise looks like magnets."""

FEWEST_SAMPLES, PEAK_SAMPLES = 2.0, 5.0
"""Over the half-width of a magnet's field: at least, and to find a peak in them."""

EARTH_T = 65e-6
"""The strongest field of the Earth on its surface."""

_LAYOUTS = 8


@dataclass(frozen=True)
class Use:
    """How tags are to be read.

    Attributes
    ----------
    sensors, sensor_spacing_m : int, float
        The bar.
    settings : Settings
        Of its magnetometers.
    noise_t : float or None
        Standard deviation of every axis; None for that of the magnetometer.
    rate_hz : float or None
        Samples a second; None for as many as the magnetometer gives.
    speed_mps : float
    placement_rad : float or None
        Standard deviation of the magnets' orientations as laid; None for what was measured
        of the tags as built, else :data:`PLACEMENT_RAD`.
    """

    sensors: int = 9
    sensor_spacing_m: float = 0.02
    settings: Settings = field(default_factory=Settings)
    noise_t: float | None = None
    rate_hz: float | None = None
    speed_mps: float = 0.1
    placement_rad: float | None = None


@dataclass(frozen=True)
class Plan:
    """What to expect of a design.

    Attributes
    ----------
    capacity : int
        Ids of the codec.
    peak_t, between_t : float
        Field of one magnet straight above it, and midway between two sensors.
    half_along_m, half_across_m : float
        Full width at half of the peak, along the moment and across it.
    min_spacing_m, compact_spacing_m : float
        By the rule of :data:`WIDTH_LEVEL`, and :data:`COMPACT` of it.
    neighbour_angle_rad, neighbour_shift_m : float
        How far off a method is at worst that looks at one magnet at a time, because of one
        neighbour; ``nan`` where the peaks merge.
    noise_t : (3,) ndarray
        By axis of the array; and ``noise_from``: "given", "measured" or "assumed".
    signal_to_noise, between_to_noise : float
        ``peak_t`` and ``between_t`` over the noise of the horizontal axes.
    max_rate_hz, rate_hz : float
        Of the magnetometer; and what is planned with.
    step_m, samples, max_speed_mps : float
        From sample to sample; samples over ``half_across_m``; and the speed at which these
        are as few as will do.
    range_t : float
        The smallest of the axes.
    known_speed, free_speed : Bound
        Accuracy of one pass where the speed is known, and where each step is free; ``nan``
        where the samples are too few.
    placement_rad : float
        What is planned with.
    max_orientations : int
        The largest P that the placement's error allows.
    misread : float
        Chance that a tag has a magnet more than half a step off.
    array_m, tag_m, diagonal_m, play_m : float
        Widths; and how far to either side a tag may lie.
    materials : tuple of Item
    warnings, notes : tuple of str
    """

    tags: Tags
    use: Use
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
    known_speed: Bound
    free_speed: Bound
    placement_rad: float
    max_orientations: int
    misread: float
    array_m: float
    tag_m: float
    diagonal_m: float
    play_m: float
    materials: tuple[Item, ...]
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def disc_field(magnet: Magnet, points: Array) -> Array:
    """Flux density (n, 3) in tesla of a disc at the origin whose moment is along x, at
    ``points`` (n, 3) in metres (magpylib, closed form of a cylinder)."""
    source = magpylib.magnet.Cylinder(
        polarization=(magnet.remanence_t, 0, 0),
        dimension=(magnet.diameter_m, magnet.height_m),
    )
    return np.asarray(source.getB(points), float).reshape(-1, 3)


def width(magnet: Magnet, clearance_m: float, level: float, *, across: bool = False) -> float:
    """Full width in metres at which the field, ``clearance_m`` above the magnet's middle,
    is ``level`` of its peak: along the moment or across it."""
    axis = np.array([0.0, 1.0, 0.0]) if across else np.array([1.0, 0.0, 0.0])
    peak = _size(magnet, [0, 0, clearance_m])

    def above(way: float) -> float:
        return _size(magnet, way * axis + [0, 0, clearance_m]) - level * peak

    far = clearance_m + magnet.diameter_m
    while above(far) > 0:
        far *= 2
    return float(2 * brentq(above, 0, far, xtol=1e-7))


def compact_spacing(magnet: Magnet, clearance_m: float) -> float:
    """The smallest spacing by the paper, rounded up to a whole mm.

    Raises
    ------
    InputError
        The sensors would be in the magnet.
    """
    _check_clearance(magnet, clearance_m)
    exact = COMPACT * width(magnet, clearance_m, WIDTH_LEVEL)
    return math.ceil(exact * 1e3 - 1e-6) / 1e3


def neighbour_error(spacing_m: float, clearance_m: float) -> tuple[float, float]:
    """Worst error of angle (rad) and place (m) of a magnet that is read at the peak of its
    field, because of one equal neighbour.

    Over 16 x 16 orientations, dipoles. ``nan`` up to :data:`MERGED` clearances apart.
    """
    if spacing_m <= MERGED * clearance_m:
        return math.nan, math.nan
    turns = np.arange(16) * math.tau / 16
    moments = np.column_stack([np.cos(turns), np.sin(turns), 0 * turns])
    at = np.zeros((1, 1, 1, 3))
    for reach, count in ((0.4 * clearance_m, 41), (0.02 * clearance_m, 9)):
        line = np.linspace(-reach, reach, count)
        x, y = np.meshgrid(line, line)
        points = at + np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
        points[..., 2] = clearance_m
        own = dipole_field(points, moments[:, None, None])
        total = own + dipole_field(points - [spacing_m, 0, 0], moments[None, :, None])
        peak = np.einsum("abpi,abpi->abp", total, total).argmax(-1)[..., None, None]
        at = np.take_along_axis(points, peak, 2)
    seen = -np.take_along_axis(total, peak, 2)[:, :, 0]
    off = np.arctan2(seen[..., 1], seen[..., 0]) - turns[:, None]
    off = np.abs((off + math.pi) % math.tau - math.pi)
    return float(off.max()), float(np.hypot(at[..., 0], at[..., 1]).max())


def plan(tags: Tags, use: Use | None = None, count: int = 1) -> Plan:
    """What to expect of ``count`` tags of a design; see :class:`Plan`.

    Raises
    ------
    InputError
        A design that cannot be: see :func:`locatk.core.polaris.codec.check_design`; a
        spacing, clearance, speed, rate, noise or error that is not positive; magnets in each
        other or in the sensors; a bar without sensors.
    """
    use = use or Use()
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
            raise InputError(f"the {name} is {value:g}, not above 0")
    if magnet.diameter_m > tags.spacing_m:
        raise InputError(
            f"magnets of {magnet.diameter_m * 1e3:g} mm do not fit a spacing of "
            f"{tags.spacing_m * 1e3:g} mm"
        )

    array, noise_from = _array(use)
    horizontal = float(np.sqrt(np.mean(array.noise_t[:2] ** 2)))
    beside = use.sensor_spacing_m / 2 if use.sensors > 1 else 0.0
    peak = _size(magnet, [0, 0, clearance])
    between = min(_size(magnet, [beside, 0, clearance]), _size(magnet, [0, beside, clearance]))
    wide = width(magnet, clearance, WIDTH_LEVEL)
    across = width(magnet, clearance, 0.5, across=True)
    rate = min(use.rate_hz or math.inf, part.max_rate_hz)
    step = use.speed_mps / rate
    layouts = some_layouts(tags, _LAYOUTS)
    free = _accuracy(tags, layouts, array, step, "steps")
    placement = _placement(tags) if use.placement_rad is None else use.placement_rad
    spread = math.hypot(placement, free.angle_rad if math.isfinite(free.angle_rad) else 0.0)
    reach = math.pi / tags.orientations / spread
    neighbour = neighbour_error(tags.spacing_m, clearance)
    side = (tags.order - 1) * tags.spacing_m
    bar = (use.sensors - 1) * use.sensor_spacing_m
    result = Plan(
        tags=tags,
        use=use,
        capacity=capacity,
        peak_t=peak,
        between_t=between,
        half_along_m=width(magnet, clearance, 0.5),
        half_across_m=across,
        min_spacing_m=wide,
        compact_spacing_m=COMPACT * wide,
        neighbour_angle_rad=neighbour[0],
        neighbour_shift_m=neighbour[1],
        noise_t=array.noise_t,
        noise_from=noise_from,
        signal_to_noise=peak / horizontal,
        between_to_noise=between / horizontal,
        max_rate_hz=part.max_rate_hz,
        rate_hz=rate,
        step_m=step,
        samples=across / step,
        max_speed_mps=across * rate / FEWEST_SAMPLES,
        range_t=float(np.min(array.range_t)),
        known_speed=_accuracy(tags, layouts, array, step, "strength"),
        free_speed=free,
        placement_rad=placement,
        max_orientations=int(math.pi / (SIGMAS * spread)),
        misread=1 - math.erf(reach / math.sqrt(2)) ** tags.magnets,
        array_m=bar,
        tag_m=side,
        diagonal_m=math.sqrt(2) * side,
        play_m=(bar - side) / 2,
        materials=bill(tags, use.sensors, "Melexis MLX90393", count),
    )
    return replace(result, warnings=tuple(_warnings(result)), notes=tuple(_notes(result)))


def some_layouts(tags: Tags, count: int) -> list[TagLayout]:
    """Layouts of ``count`` tags of the family, drawn the same way every time."""
    draw = random.Random(0)
    total = codec.capacity(tags) if tags.ids is None else len(tags.ids)
    numbers = [draw.randrange(total) for _ in range(count)]
    return [codec.layout_of(tags, n if tags.ids is None else tags.ids[n]) for n in numbers]


def _accuracy(
    tags: Tags, layouts: list[TagLayout], array: SensorArray, step_m: float, unknown: Unknown
) -> Bound:
    """The bound; ``nan`` where there are too few samples to tell the magnets."""
    try:
        return bound(tags, layouts, array, step_m=step_m, unknown=unknown)
    except InputError:
        return Bound(*[math.nan] * 6)


def _placement(tags: Tags) -> float:
    """How well the magnets are laid: as measured where tags are calibrated."""
    if not tags.built:
        return PLACEMENT_RAD
    off = np.concatenate([built.angle_rad for built in tags.built.values()])
    return float(np.sqrt(np.mean(off**2)))


def _array(use: Use) -> tuple[SensorArray, str]:
    """The bar with a noise to plan with, and where that comes from."""
    part = use.settings
    if use.noise_t is not None:
        noise, source = np.full(3, use.noise_t), "given"
    elif np.isfinite(part.noise_t).all():
        noise, source = part.noise_t, "measured"
    else:
        noise, source = part.assumed_noise_t, "assumed"
    return published_bar(use.sensors, use.sensor_spacing_m, part, noise), source


def _check_clearance(magnet: Magnet, clearance_m: float) -> None:
    if not clearance_m > magnet.height_m / 2 or not math.isfinite(clearance_m):
        raise InputError(
            f"the clearance is {clearance_m * 1e3:g} mm from the middle of a magnet "
            f"{magnet.height_m * 1e3:g} mm high",
            hint="Give the way from the magnets' middle to the sensors",
        )


def _size(magnet: Magnet, point: Array | list[float]) -> float:
    return float(np.linalg.norm(disc_field(magnet, np.asarray(point, float)[None])))


# ---- warnings and notes


def _warnings(plan: Plan) -> Iterator[str]:
    """Describe the limits that a design exceeds, with figures and remedies."""
    tags, use = plan.tags, plan.use
    if use.rate_hz is not None and use.rate_hz > plan.max_rate_hz:
        faster = settings_for_rate(use.rate_hz, use.settings)
        remedy = (
            "no osr and filt are that fast"
            if faster is None
            else f"osr {faster.osr} filt {faster.filt} gives {faster.max_rate_hz:.0f} Hz"
        )
        yield (
            f"{use.rate_hz:g} Hz is too fast: three axes take "
            f"{use.settings.conversion_s * 1e3:.2f} ms at osr {use.settings.osr} filt "
            f"{use.settings.filt}, at most {plan.max_rate_hz:.1f} Hz, with which the rest is "
            f"planned; {remedy}"
        )
    if plan.samples < FEWEST_SAMPLES:
        yield (
            f"{use.speed_mps:g} m/s is too fast: {plan.samples:.1f} samples over a magnet's "
            f"field of {_mm(plan.half_across_m)}; drive at most {plan.max_speed_mps:.2f} m/s, "
            "or sample faster"
        )
    if plan.between_to_noise < WEAKEST:
        yield (
            f"the field is too weak: {plan.between_t * 1e6:.2g} uT midway between two sensors, "
            f"{plan.between_to_noise:.1f} times the noise and not {WEAKEST:g}; take larger "
            "magnets, less clearance or sensors closer together"
        )
    if plan.peak_t + EARTH_T > plan.range_t:
        yield (
            f"the sensors saturate: {plan.peak_t * 1e6:.0f} uT above a magnet and up to "
            f"{EARTH_T * 1e6:.0f} uT of the Earth, but they tell "
            f"{plan.range_t * 1e6:.0f} uT; take a lower gain, a higher resolution or more "
            "clearance"
        )
    if tags.magnet.diameter_m > tags.clearance_m:
        yield (
            f"the magnets are too wide for the clearance: {_mm(tags.magnet.diameter_m)} at "
            f"{_mm(tags.clearance_m)}, where they are no points to the solver and have two "
            "peaks or a flat one; keep the sensors at least a diameter away"
        )
    if tags.orientations > plan.max_orientations:
        yield (
            f"{tags.orientations} orientations are too many: half a step is "
            f"{180 / tags.orientations:.3g} degrees, the magnets are laid to "
            f"{math.degrees(plan.placement_rad):.2g} and read to "
            f"{math.degrees(plan.free_speed.angle_rad):.2g} degrees rms, so that "
            f"{plan.misread:.0%} of the tags have one that reads wrong; take at most "
            f"{max(plan.max_orientations, 1)}, or come to {180 / SIGMAS / tags.orientations:.2g} "
            "degrees with a jig or by calibration"
        )
    if tags.spacing_m <= MERGED * tags.clearance_m:
        yield (
            f"the magnets are too close: {_mm(tags.spacing_m)} at a clearance of "
            f"{_mm(tags.clearance_m)}, where two peaks may merge; keep them more than "
            f"{_mm(MERGED * tags.clearance_m)} apart"
        )
    if plan.play_m < -1e-9:
        yield (
            f"the tag is wider than the array: {_mm(plan.tag_m)} against {_mm(plan.array_m)}; "
            f"take {math.ceil(plan.tag_m / use.sensor_spacing_m - 1e-9) + 1} sensors or a "
            "smaller tag"
        )


def _notes(plan: Plan) -> Iterator[str]:
    """Describe the assumptions and restrictions of a design that works."""
    tags, use = plan.tags, plan.use
    if plan.noise_from == "assumed":
        yield (
            f"The noise at osr {use.settings.osr} filt {use.settings.filt} was never measured; "
            f"{plan.noise_t[0] * 1e6:.2g} uT is assumed. Record a minute of standing still and "
            "give what you find."
        )
    if MERGED * tags.clearance_m < tags.spacing_m < plan.compact_spacing_m - 1e-9:
        yield (
            f"The spacing is below the paper's rule of {_mm(plan.compact_spacing_m)}: solve by "
            "the method `joint`; one that takes magnets one at a time is up to "
            f"{math.degrees(plan.neighbour_angle_rad):.1f} degrees and "
            f"{_mm(plan.neighbour_shift_m)} off."
        )
    if use.sensors > 1 and use.sensor_spacing_m > tags.spacing_m / 2 + 1e-9:
        yield (
            f"The sensors are {_mm(use.sensor_spacing_m)} apart, more than half the tag's "
            f"spacing ({_mm(tags.spacing_m / 2)}): the method `paper` needs two to a magnet."
        )
    if FEWEST_SAMPLES <= plan.samples < PEAK_SAMPLES:
        yield (
            f"With {plan.samples:.1f} samples over a magnet's field, peaks are hard to find: "
            "solve by the method `joint`."
        )
    if -1e-9 <= plan.play_m < tags.spacing_m / 2:
        yield f"The robot must meet the tag's middle to within {_mm(max(plan.play_m, 0))}."
    if plan.play_m >= 0 and plan.diagonal_m > plan.array_m + 1e-9:
        yield (
            f"Driven across at 45 degrees the tag is {_mm(plan.diagonal_m)} wide, more than the "
            f"array's {_mm(plan.array_m)}: keep its heading near 0, 90, 180 or 270."
        )
    if tags.codec == "mosk" and tags.min_distance < 2:
        yield (
            "Any id may occur, so one misread orientation is another tag: a family with a "
            "smallest distance, or the codec `redundant`, tells or corrects it."
        )


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.3g} mm"
