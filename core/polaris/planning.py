"""Will it work? Field, noise, accuracy and limits of a design, before a tag is made.

The field is magpylib's, of the disc as it is; the accuracy is the Cramer-Rao bound. What
will not work becomes a warning with numbers and what to do; what is good to know, a note.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace

import magpylib
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_field
from locatk.core.materials import Item
from locatk.core.polaris import advice, codec
from locatk.core.polaris.advice import FEWEST_SAMPLES, MERGED, SIGMAS
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.bound import Bound, Unknown, bound
from locatk.core.polaris.materials import bill
from locatk.core.polaris.mlx90393 import Settings, published_bar
from locatk.core.polaris.tag import Layout, Magnet, Tags

Array = NDArray[np.float64]

WIDTH_LEVEL = 0.1
"""Two magnets are apart where the field of one, along its moment, has fallen to this part
of its peak half a spacing away: the rule that gives the paper's spacings."""

COMPACT = 0.8
"""The paper's smallest spacing against that (Polaris section 5.2.3)."""

PLACEMENT_RAD = math.radians(6)
"""Error of hand placement, rms: that of the published tags, worst 13 degrees."""

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

    Over 16 x 16 orientations, dipoles. ``nan`` up to ``advice.MERGED`` clearances apart.
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
    return replace(
        result, warnings=tuple(advice.warnings(result)), notes=tuple(advice.notes(result))
    )


def some_layouts(tags: Tags, count: int) -> list[Layout]:
    """Layouts of ``count`` tags of the family, drawn the same way every time."""
    draw = random.Random(0)
    total = codec.capacity(tags) if tags.ids is None else len(tags.ids)
    numbers = [draw.randrange(total) for _ in range(count)]
    return [codec.layout_of(tags, n if tags.ids is None else tags.ids[n]) for n in numbers]


def _accuracy(
    tags: Tags, layouts: list[Layout], array: SensorArray, step_m: float, unknown: Unknown
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
