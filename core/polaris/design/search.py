"""Search for designs of tags: magnet, clearance, spacing and code for ids and an accuracy.

The Polaris paper simulates one magnet to find its smallest spacing (section 5.2.3). Here, stocked
magnets, clearances, spacings and codes are tried in the order of cost and size. Conditions that
are cheap to test come first, the accuracy bound last.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.error_quantiles import error_quantile
from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import families
from locatk.core.polaris.design.accuracy_bound import AccuracyBound, accuracy_bound
from locatk.core.polaris.design.materials import disc_magnet
from locatk.core.polaris.design.planning import (
    MAX_EARTH_FIELD_T,
    MERGED_PEAK_SPACING_CLEARANCES,
    MIN_SIGNAL_TO_NOISE,
    NORMAL_QUANTILE,
    ORIENTATION_MARGIN_SIGMAS,
    PLACEMENT_SIGMA_RAD,
    PROBABILITY,
    ReadingConditions,
    compact_spacing,
    disc_field,
    errors_text,
    evaluate_design,
    horizontal_noise_t,
    sample_layouts,
    sensor_array,
)
from locatk.core.polaris.identification.matching import AS_BUILT_SIGMA_M, HAND_BUILT_SIGMA_M
from locatk.core.polaris.tag import Magnet, Tags, cell_positions, vertices
from locatk.core.units import length_text

Array = NDArray[np.float64]

STOCKED_DISCS = (
    (1e-3, 0.5e-3, "N52"),
    (2e-3, 0.5e-3, "N52"),
    (2e-3, 1e-3, "N42"),
    (3e-3, 1e-3, "N42"),
    (4e-3, 2e-3, "N42"),
    (5e-3, 2e-3, "N42"),
    (6e-3, 2.5e-3, "N35"),
    (8e-3, 2.5e-3, "N35"),
)
"""Diameter, height [m] and grade of discs that are sold magnetised across: those of the Polaris
paper (sections 5.2.3 and 7.2), and those for rotary encoders, which have 6 x 2.5 or 8 x 2.5 mm
(data sheets of the AS5048 and AS5600). Others are made to order."""

ORDERS, ORIENTATIONS = (2, 3, 4, 5), (4, 8, 16)
"""Orders of the grid and numbers of orientations that are tried."""

MAX_MAGNETS = 9
"""Largest number of magnets of a tag that is tried. The decoder needs more time for more."""

CLEARANCE_STEPS, CLEARANCE_DECIMALS = 4, 4
"""Number of clearances that are tried within a range, and their decimals in metres."""

DENSE_SPACING_CLEARANCES = 2.0
"""Spacing in clearances that is tried besides that of the paper. Closer magnets are read, but not
in every pass (docs/polaris.md)."""

SEARCHED_LAYOUTS = 2
"""Number of layouts over which the accuracy of a candidate is averaged."""

MAX_EVALUATIONS = 60
"""Largest number of candidates of a magnet whose accuracy is computed."""

NOTHING_FITS = "no tag with so many ids fits below the array"
"""Reason if no magnet is to blame."""

MISREAD = "orientations are misread at this speed, noise and placement of the magnets"
"""Reason if the angles of magnets are too uncertain for any number of orientations."""

CIRCLE_QUANTILE = math.sqrt(-2 * math.log(1 - PROBABILITY))
"""Length of errors with two equal components, in standard deviations, that is not exceeded with
:data:`.planning.PROBABILITY`."""


@dataclass(frozen=True)
class TagDesign:
    """Design that was found.

    Attributes
    ----------
    tags : Tags
        Without ids.
    position_p95_m, heading_p95_rad : float
        Errors of the pose of the array in the frame of the tag that are not exceeded with 95 %,
        with the errors of magnets placed by hand.
    """

    tags: Tags
    position_p95_m: float
    heading_p95_rad: float

    @property
    def side_m(self) -> float:
        """Side of the sheet: a spacing more than the grid."""
        return self.tags.order * self.tags.spacing_m

    @property
    def errors_text(self) -> str:
        """Errors of position and heading in words."""
        return errors_text(self.position_p95_m, self.heading_p95_rad)


@dataclass(frozen=True)
class DesignSearch:
    """Result of a search.

    Attributes
    ----------
    designs : tuple of TagDesign
        The best one of each magnet, ascending by number of magnets, side and volume of a magnet.
    closest : TagDesign or None
        If there is none, the one with the smallest error relative to the wanted accuracy; None
        if no design can be read at all.
    reason : str
        Why there is no design; empty if there is one.
    """

    designs: tuple[TagDesign, ...]
    closest: TagDesign | None = None
    reason: str = ""


@dataclass(frozen=True)
class SearchSpace:
    """Values that are tried; those with one value are fixed.

    Attributes
    ----------
    magnets : sequence of Magnet
    clearance_m : (float, float)
        Smallest and largest clearance.
    orders, counts, orientations : sequence of int
        K, M and P.
    spacing_m : float or None
        None for that of the paper, and a denser one.
    codec : str
    """

    magnets: Sequence[Magnet] = ()
    clearance_m: tuple[float, float] = (0.01, 0.01)
    orders: Sequence[int] = ORDERS
    counts: Sequence[int] = tuple(range(3, MAX_MAGNETS + 1))
    orientations: Sequence[int] = ORIENTATIONS
    spacing_m: float | None = None
    codec: str = "mosk"


def stocked_magnets() -> tuple[Magnet, ...]:
    """Return the magnets of :data:`STOCKED_DISCS`."""
    return tuple(
        disc_magnet(diameter, height, grade=grade) for diameter, height, grade in STOCKED_DISCS
    )


def search_designs(
    count: int,
    position_m: float = math.inf,
    heading_rad: float = math.inf,
    use: ReadingConditions | None = None,
    space: SearchSpace | None = None,
    min_distance: int = 1,
) -> DesignSearch:
    """Search for designs with a number of ids and an accuracy.

    Parameters
    ----------
    count : int
        Number of tags.
    position_m, heading_rad : float
        Errors of a pass that must not be exceeded with 95 %.
    use : ReadingConditions, optional
    space : SearchSpace, optional
        Default: all stocked magnets at 10 mm.
    min_distance : int
        Minimum distance of the tags of the family.

    Raises
    ------
    InputError
        The count or a wanted error is not positive, or the range of clearances is empty.
    """
    use, space = use or ReadingConditions(), space or SearchSpace()
    if count < 1 or min_distance < 1:
        raise InputError(f"{count} tags with distance {min_distance}", hint="Use at least 1")
    if not (position_m > 0 and heading_rad > 0):
        raise InputError("a wanted accuracy must be above 0", hint="Give mm and degrees")
    low_m, high_m = space.clearance_m
    if not 0 < low_m <= high_m < math.inf:
        raise InputError(
            f"clearances from {length_text(low_m)} to {length_text(high_m)}",
            hint="Give the smaller one first",
        )
    designs, closest, reasons = [], list[TagDesign](), dict[str, int]()
    codes = _Codes(count, min_distance, space)
    if not codes.tags:
        return DesignSearch((), None, f"no code with {count} ids and distance {min_distance}")
    if count > families.MAX_CANDIDATES:
        return DesignSearch((), None, f"families have at most {families.MAX_CANDIDATES} tags")
    for magnet in space.magnets or stocked_magnets():
        best, near = _best_of_magnet(magnet, codes, use, space, position_m, heading_rad, reasons)
        if best is not None:
            designs.append(best)
        if near is not None:
            closest.append(near)
    if designs:
        return DesignSearch(tuple(sorted(designs, key=lambda design: _cost(design.tags))))
    if closest and min(_excess(each, position_m, heading_rad) for each in closest) > 1:
        nearest = min(closest, key=lambda each: _excess(each, position_m, heading_rad))
        built = _evaluated(nearest.tags, use, AS_BUILT_SIGMA_M)[0]
        reason = (
            f"no design is that accurate with magnets placed to {length_text(HAND_BUILT_SIGMA_M)}; "
            f"the nearest reaches {nearest.errors_text}, and {built.errors_text} if its "
            "magnets are measured as built (`locatk calibrate tag`)"
        )
        return DesignSearch((), nearest, reason)
    reason = max(reasons, key=lambda each: reasons[each]) if reasons else NOTHING_FITS
    return DesignSearch((), None, reason)


def _cost(tags: Tags) -> tuple[float, ...]:
    """Return the sort key: magnets to place, side of the tag, volume of a magnet."""
    side_m = round(tags.order * tags.spacing_m, 6)
    volume = tags.magnet.diameter_m**2 * tags.magnet.height_m
    return tags.magnets, side_m, volume, tags.orientations, -tags.clearance_m


def _excess(design: TagDesign, position_m: float, heading_rad: float) -> float:
    return max(design.position_p95_m / position_m, design.heading_p95_rad / heading_rad)


class _Codes:
    """Codes with enough ids.

    Attributes
    ----------
    tags : list of Tags
        One of each code that may have enough ids, with any magnets.
    """

    def __init__(self, count: int, min_distance: int, space: SearchSpace) -> None:
        self._count, self._min_distance = count, min_distance
        self._has_family: dict[tuple[int, int, int], bool] = {}
        self.tags = []
        for magnets, order, orientations in itertools.product(
            space.counts, space.orders, space.orientations
        ):
            tags = Tags(order=order, magnets=magnets, orientations=orientations, codec=space.codec)
            try:
                if codec.capacity(tags) >= count <= families.max_family_size(tags, min_distance):
                    self.tags.append(tags)
            except InputError:
                continue  # no such code

    def has_family(self, tags: Tags) -> bool:
        """Return whether a family of the wanted size is found; each code is tried once."""
        if self._min_distance == 1:
            return True  # ids differ by a step at least, and there are enough
        key = tags.magnets, tags.order, tags.orientations
        if key not in self._has_family:
            try:
                families.generate_family(tags, self._count, self._min_distance)
                self._has_family[key] = True
            except InputError:
                self._has_family[key] = False
        return self._has_family[key]


def _best_of_magnet(
    magnet: Magnet,
    codes: _Codes,
    use: ReadingConditions,
    space: SearchSpace,
    position_m: float,
    heading_rad: float,
    reasons: dict[str, int],
) -> tuple[TagDesign | None, TagDesign | None]:
    """Return the cheapest design of a magnet with the accuracy, and the most accurate one without.

    ``reasons`` counts why candidates were left out.
    """
    candidates: list[Tags] = []
    clearances = np.linspace(*space.clearance_m, CLEARANCE_STEPS).round(CLEARANCE_DECIMALS)
    for clearance_m in dict.fromkeys(clearances.tolist()):
        reason = _unreadable(magnet, clearance_m, use)
        if reason:
            reasons[reason] = reasons.get(reason, 0) + 1
            continue
        for spacing_m, code in itertools.product(_spacings(magnet, clearance_m, space), codes.tags):
            tags = replace(code, magnet=magnet, clearance_m=clearance_m, spacing_m=spacing_m)
            if (tags.order - 1) * spacing_m <= use.array_m + 1e-9:
                candidates.append(tags)
    if not candidates:
        return None, None
    bounds = [(_least_excess(tags, position_m, heading_rad), tags) for tags in candidates]
    viable = [tags for bound, tags in bounds if bound <= 1]
    if not viable:
        _, nearest = min(bounds, key=lambda pair: (pair[0], _cost(pair[1])))
        return None, _evaluated(nearest, use)[0]
    closest: TagDesign | None = None
    placement = use.placement_rad or PLACEMENT_SIGMA_RAD
    angle_rad: dict[float, float] = {}
    tried = 0
    for tags in sorted(viable, key=_cost):
        # The angle of a magnet hardly depends on the code.
        max_rad = math.pi / tags.orientations / ORIENTATION_MARGIN_SIGMAS
        if math.hypot(placement, angle_rad.get(tags.clearance_m, 0.0)) > max_rad:
            reasons[MISREAD] = reasons.get(MISREAD, 0) + 1
            continue
        design, angle_rad[tags.clearance_m] = _evaluated(tags, use)
        if math.hypot(placement, angle_rad[tags.clearance_m]) > max_rad:
            reasons[MISREAD] = reasons.get(MISREAD, 0) + 1
            continue
        excess = _excess(design, position_m, heading_rad)
        if excess <= 1:
            if not codes.has_family(tags):
                continue
            report = evaluate_design(tags, use)
            design = TagDesign(tags, *_errors_of(report.placed))
            excess = _excess(design, position_m, heading_rad)
            if excess <= 1 and not report.warnings:
                return design, None
        if closest is None or excess < _excess(closest, position_m, heading_rad):
            closest = design
        tried += 1
        if tried == MAX_EVALUATIONS:
            break
    return None, closest


def _spacings(magnet: Magnet, clearance_m: float, space: SearchSpace) -> Iterator[float]:
    """Yield the spacings to try: the given one, or a dense one and that of the paper."""
    least_m = max(MERGED_PEAK_SPACING_CLEARANCES * clearance_m, magnet.diameter_m)
    if space.spacing_m is not None:
        if space.spacing_m > least_m:
            yield space.spacing_m
        return
    dense_m = math.ceil(1e3 * DENSE_SPACING_CLEARANCES * clearance_m - 1e-6) / 1e3
    if dense_m > least_m:
        yield dense_m
    yield compact_spacing(magnet, clearance_m)


def _unreadable(magnet: Magnet, clearance_m: float, use: ReadingConditions) -> str:
    """Return why a magnet cannot be read at a clearance; empty if it can."""
    if clearance_m < max(magnet.diameter_m, magnet.height_m):
        return "the magnets are too wide for the clearance"
    array, _ = sensor_array(use)
    midway_m = use.sensor_spacing_m / 2 if use.sensors > 1 else 0.0
    points = np.array([[0.0, 0.0, 1.0], [midway_m, 0.0, 1.0], [0.0, midway_m, 1.0]])
    points[:, 2] = clearance_m
    peak_t, *between_t = np.linalg.norm(disc_field(magnet, points), axis=1).tolist()
    if peak_t + MAX_EARTH_FIELD_T > array.range_t.min():
        return "the sensors saturate"
    if min(between_t) < MIN_SIGNAL_TO_NOISE * horizontal_noise_t(array, use.environment):
        return "the field of the magnets is too weak for this clearance"
    return ""


def _evaluated(
    tags: Tags, use: ReadingConditions, build_m: float = HAND_BUILT_SIGMA_M
) -> tuple[TagDesign, float]:
    """Return a design with its errors, and the standard deviation of a magnet's angle [rad]."""
    array, _ = sensor_array(use)
    try:
        bound = accuracy_bound(
            tags,
            sample_layouts(tags, SEARCHED_LAYOUTS),
            array,
            step_m=use.step_m,
            environment=use.environment,
            build_m=build_m,
        )
    except InputError:
        return TagDesign(tags, math.inf, math.inf), math.inf
    return TagDesign(tags, *_errors_of(bound)), bound.angle_rad


def _least_excess(tags: Tags, position_m: float, heading_rad: float) -> float:
    """Return the error of magnets placed by hand alone, relative to the wanted accuracy.

    The three vertices, and the others on the rim in the best case, determine the heading.
    """
    corners = cell_positions(tags, vertices(tags.order)[:3])
    half_m = (tags.order - 1) / 2 * tags.spacing_m
    spread = float(((corners - corners.mean(axis=0)) ** 2).sum())
    spread += (tags.magnets - 3) * 2 * half_m**2
    return max(
        CIRCLE_QUANTILE * HAND_BUILT_SIGMA_M / math.sqrt(tags.magnets) / position_m,
        NORMAL_QUANTILE * HAND_BUILT_SIGMA_M / math.sqrt(spread) / heading_rad,
    )


def _errors_of(bound: AccuracyBound) -> tuple[float, float]:
    """Return the errors of position and heading of the pose that are not exceeded with 95 %."""
    position = np.diag(np.square([bound.pose_x_m, bound.pose_y_m]))
    return error_quantile(position[None], PROBABILITY), NORMAL_QUANTILE * bound.pose_heading_rad
