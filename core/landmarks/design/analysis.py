"""What a landmark of some bars is worth: its valleys, territory, reach and tolerances.

Nothing here is measured; all of it follows from the field of the bars in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.design.territory import (
    contour,
    equal_corner,
    field_pitch,
    gulfs,
    largest_field,
    radii,
)
from locatk.core.landmarks.design.valleys import (
    PHASE,
    STRENGTHS,
    VALLEYS,
    crossing,
    over_bars,
    valid_heights,
    valleys,
)
from locatk.core.landmarks.landmark import PATTERNS, Geometry

Array = NDArray[np.float64]

NEIGHBOUR_T = 15e-6
"""Field of a neighbouring landmark that is let pass at the circle: a half percent of the
default threshold, and a third of the Earth's."""

HEADROOM = 1.25
"""Of the sensors' range above the largest field, for lower sensors and stronger bars."""

HALL_CLASSES = ((100.0, 0.021), (50.0, 0.042), (25.0, 0.085), (12.5, 0.169))
"""mV/mT and range of linear hall sensors at 5 V: TI DRV5055 A1 to A4 (SBAS640B, 1)."""


@dataclass(frozen=True)
class Shape:
    """What the sensors see of one pattern, laid as its letters say.

    Attributes
    ----------
    number : int
        The paper's, 1 to 6.
    letters : str
    expected : int
        How many valleys it must have to be told from the others.
    valleys_rad : (n,) ndarray
        Neutral valleys on the circle of the sensors, ascending from x counter-clockwise.
    rising : (n,) bool ndarray
        Whether the field rises there, counter-clockwise.
    mountains_t : (n,) ndarray
        Largest field, signed, between each valley and the next.
    gulfs_rad : (n,) ndarray
        How wide the contour of the threshold is dented along each valley, by more than
        :data:`.territory.GULF_M`.
    r1_m, r2_m : float
        Radii of the half-discs of the threshold, over corners between equal and unequal
        bars; ``nan`` where the pattern has none.
    bias_m : (2,) ndarray
        Where the paper's crossing of valleys (section 3.3) puts the centre; ``nan`` where
        the valleys are not as many as expected.
    slope_t_per_m : (4,) ndarray
        Of the field over each bar, along it and counter-clockwise: the line that fits best
        within a quarter of the bar's length to either side of the zero.
    zero_m : (4,) ndarray
        From each bar's middle to that zero, counter-clockwise; ``nan`` where there is none.
    departure_m : (4,) ndarray
        Largest error of the line within that stretch, as a length.
    """

    number: int
    letters: str
    expected: int
    valleys_rad: Array
    rising: NDArray[np.bool_]
    mountains_t: Array
    gulfs_rad: Array
    r1_m: float
    r2_m: float
    bias_m: Array
    slope_t_per_m: Array
    zero_m: Array
    departure_m: Array

    @property
    def collapsed(self) -> bool:
        """Whether valleys have merged, so that it is taken for another pattern."""
        return len(self.valleys_rad) != self.expected

    @property
    def skew_rad(self) -> float:
        """Largest distance of a valley from the paper's multiples of 45 degrees."""
        off = self.valleys_rad % (math.pi / 4)
        return float(np.minimum(off, math.pi / 4 - off).max(initial=0.0))


@dataclass(frozen=True)
class Tolerance:
    """What one deviation does to landmark 3, NNNS: the same as in :class:`Shape`."""

    what: str
    r1_m: float
    r2_m: float
    bias_m: float
    largest_t: float


@dataclass(frozen=True)
class Analysis:
    """What a geometry is worth.

    Attributes
    ----------
    shapes : tuple of Shape
        One a pattern.
    heights_m : (float, float)
        Sensor heights between which all patterns have the valleys that tell them apart;
        ``nan`` where there are none.
    contour_pitch_m : float
        At which a robot leaves one territory with all sensors before it enters the next:
        twice the sum of r2 and the circle.
    field_pitch_m : float
        At which a neighbour's field at the circle is :attr:`neighbour_t`.
    neighbour_t : float
    largest_t : float
        Largest field that any pattern has in the plane of the sensors.
    range_t : float
        That the sensors need: with :data:`HEADROOM`.
    tolerances : tuple of Tolerance
        The first is as designed.
    """

    geometry: Geometry
    shapes: tuple[Shape, ...]
    heights_m: tuple[float, float]
    contour_pitch_m: float
    field_pitch_m: float
    neighbour_t: float
    largest_t: float
    range_t: float
    tolerances: tuple[Tolerance, ...]

    @property
    def r1_m(self) -> float:
        """Of landmark 3, the paper's hardest."""
        return self.shapes[2].r1_m

    @property
    def r2_m(self) -> float:
        """Of landmark 3."""
        return self.shapes[2].r2_m

    @property
    def least_pitch_m(self) -> float:
        """The larger of the two least pitches; ``nan`` where the threshold is never met."""
        return float(np.maximum(self.contour_pitch_m, self.field_pitch_m))

    @property
    def hall_class(self) -> tuple[float, float] | None:
        """mV/mT and range in tesla of the most sensitive hall sensor that serves, or None."""
        return next((item for item in HALL_CLASSES if item[1] >= self.range_t), None)


def check_geometry(geometry: Geometry) -> None:
    """Refuse bars that cannot be.

    Raises
    ------
    InputError
        A size is no positive number, the remanence is in another unit, or bars overlap.
    """
    g = geometry
    for value, what in (
        (g.bar_length_m, "length of the bars"),
        (g.bar_width_m, "width of the bars"),
        (g.bar_height_m, "height of the bars"),
        (g.remanence_t, "remanence"),
        (g.radius_m, "radius of the bars' middles"),
        (g.sensor_height_m, "height of the sensors"),
        (g.circle_m, "circle of the sensors"),
        (g.threshold_t, "threshold"),
    ):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"the {what} must be above 0, not {value:g}")
    if g.remanence_t > 2:
        raise InputError(
            f"no magnet has a remanence of {g.remanence_t:g} T",
            hint="10,000 gauss are 1 tesla; N52 has 1.45",
        )
    least = (g.bar_length_m + g.bar_width_m) / 2
    if g.radius_m < least - 1e-9:
        raise InputError(
            f"the bars overlap at their corners with a radius of {1e3 * g.radius_m:g} mm",
            hint=f"take a radius of at least {1e3 * least:g} mm, or shorter bars",
        )


def analyse(geometry: Geometry, neighbour_t: float = NEIGHBOUR_T) -> Analysis:
    """Work out what a geometry is worth.

    Parameters
    ----------
    geometry : Geometry
    neighbour_t : float
        Field of one neighbouring landmark that is let pass at the circle of the sensors.

    Raises
    ------
    InputError
        See :func:`check_geometry`.
    """
    check_geometry(geometry)
    shapes = _shapes(geometry)
    largest = largest_field(geometry)
    return Analysis(
        geometry=geometry,
        shapes=shapes,
        heights_m=valid_heights(geometry),
        contour_pitch_m=2 * (shapes[2].r2_m + geometry.circle_m),
        field_pitch_m=field_pitch(geometry, neighbour_t),
        neighbour_t=neighbour_t,
        largest_t=largest,
        range_t=HEADROOM * largest,
        tolerances=_tolerances(geometry),
    )


def _shapes(geometry: Geometry) -> tuple[Shape, ...]:
    phi = np.radians(np.arange(360) + PHASE)
    territory = contour(geometry, STRENGTHS, phi)
    slopes, zeros, departures = over_bars(geometry)
    shapes = []
    for k, letters in enumerate(PATTERNS):
        strengths = STRENGTHS[:, k]
        angles, rising, mountains = valleys(geometry, strengths)
        r1, r2 = radii(phi, territory[:, k], strengths)
        nominal = np.where(equal_corner(np.degrees(phi), strengths), r1, r2)
        right = len(angles) == VALLEYS[k]
        shapes.append(
            Shape(
                number=k + 1,
                letters=letters,
                expected=VALLEYS[k],
                valleys_rad=angles,
                rising=rising,
                mountains_t=mountains,
                gulfs_rad=gulfs(territory[:, k], nominal, angles),
                r1_m=r1,
                r2_m=r2,
                bias_m=crossing(geometry, angles) if right else np.full(2, np.nan),
                slope_t_per_m=slopes[k],
                zero_m=zeros[k],
                departure_m=departures[k],
            )
        )
    return tuple(shapes)


_DEVIATIONS: tuple[tuple[str, dict[str, float]], ...] = (
    ("as designed", {}),
    ("sensors 1 mm higher", {"sensor_height_m": 1e-3}),
    ("sensors 1 mm lower", {"sensor_height_m": -1e-3}),
    ("bars 10 % stronger", {"remanence_t": 0.1}),
    ("bars 10 % weaker", {"remanence_t": -0.1}),
    ("bars 1 mm farther out", {"radius_m": 1e-3}),
    ("bars 1 mm longer", {"bar_length_m": 1e-3}),
    ("circle 1 mm wider", {"circle_m": 1e-3}),
)
"""By length, or by the share of the remanence."""


def _tolerances(geometry: Geometry) -> tuple[Tolerance, ...]:
    """What deviations do to landmark 3, all others as designed."""
    phi = np.radians(3 * (np.arange(120) + PHASE))
    strengths = STRENGTHS[:, 2]
    result = []
    for what, change in _DEVIATIONS:
        values = {
            key: getattr(geometry, key) * (1 + by)
            if key == "remanence_t"
            else max(getattr(geometry, key) + by, 0.0)
            for key, by in change.items()
        }
        other = replace(geometry, **values)
        r1, r2 = radii(phi, contour(other, strengths[:, None], phi)[:, 0], strengths)
        angles = valleys(other, strengths)[0]
        bias = crossing(other, angles) if len(angles) == VALLEYS[2] else np.full(2, np.nan)
        result.append(Tolerance(what, r1, r2, float(np.hypot(*bias)), largest_field(other)))
    return tuple(result)
