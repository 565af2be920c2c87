"""Limits of a design, and what to say of a plan: what will not work, what is good to know."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from locatk.core.polaris.mlx90393 import for_rate

if TYPE_CHECKING:
    from locatk.core.polaris.planning import Plan

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


def warnings(plan: Plan) -> Iterator[str]:
    """What will not work, with numbers and what to do."""
    tags, use = plan.tags, plan.use
    if use.rate_hz is not None and use.rate_hz > plan.max_rate_hz:
        faster = for_rate(use.rate_hz, use.settings)
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


def notes(plan: Plan) -> Iterator[str]:
    """What is good to know of a design that works."""
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
