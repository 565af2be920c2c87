"""Magnetic environment of tags: fields of iron in the floor and of motors that vary in a pass.

A field that does not vary while the bar passes a tag is an offset of the sensors, which the solver
estimates, and costs nothing. Two kinds of fields vary:

- **Iron** in the floor: each place has another field. It is modelled as a Gaussian field with a
  standard deviation and a correlation length, which is about the distance to the iron.
- **Motors** and their wires: the field changes with the throttle, at all sensors at once. The
  solver estimates such a common field only if it sees one, so that errors are up to twice smaller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

Array = NDArray[np.float64]

MAX_FIELD_T = 1e-3
"""Field above any disturbance that a floor or a motor causes; a larger value is in another unit."""


@dataclass(frozen=True)
class Environment:
    """Fields that vary while a bar passes a tag.

    Attributes
    ----------
    name : str
    field_t : float
        Standard deviation of the field by axis.
    length_m : float
        Distance along the floor at which the correlation of the field is exp(-1/2).
    is_common : bool
        True if it is the same at all sensors, except for ``gradient_per_m``.
    gradient_per_m : float
        Relative change of a common field in a metre along the bar.

    Raises
    ------
    InputError
        The field is negative or above 1 mT, or the length is not positive.
    """

    name: str
    field_t: float
    length_m: float = 0.05
    is_common: bool = False
    gradient_per_m: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.field_t <= MAX_FIELD_T:
            raise InputError(
                f"a disturbance of {self.field_t * 1e6:g} uT",
                hint="Give the standard deviation of the field in uT, 0 to 1000",
            )
        if not (self.length_m > 0 and math.isfinite(self.length_m)):
            raise InputError(f"a correlation length of {self.length_m:g} m is not positive")

    def path_correlation(self, path_m: Array) -> Array:
        """Return the correlation (n, n) between positions (n,) along the path."""
        return _squared_exponential(path_m, self.length_m)

    def bar_correlation(self, y_m: Array) -> Array:
        """Return the covariance (N, N), relative to ``field_t``, of sensors at ``y_m`` (N,)."""
        if self.is_common:
            relative = 1 + self.gradient_per_m * (y_m - y_m.mean())
            return np.outer(relative, relative)
        return _squared_exponential(y_m, self.length_m)


QUIET = Environment("quiet", 0.0)
"""No varying fields: the published recordings have white noise over their first 185 samples, with a
correlation of 0.03 between neighbours (github.com/wjk5117/Polaris)."""

REINFORCED = Environment("reinforced", 3e-6)
"""Floor of reinforced concrete. A bar of 10 mm under a cover of 25 mm (EN 1992-1-1, table 4.4N,
dry rooms) is 40 mm below sensors at 10 mm. A long cylinder of iron across the Earth's field B0 has
the field B0 (a/r)^2 outside (Jackson, Classical Electrodynamics, section 5.12), 0.8 uT of 50 uT.
Bars are also magnetised along their length, by 2 to 20 mT if the permeability is 100 to 1000, and
that flux leaves at their ends: 1.5 to 80 uT at 40 mm from an end. 3 uT is between these; the
correlation length is the distance. Floors differ by a factor of ten: measure yours."""

MOTORS = Environment("motors", 2.6e-6, is_common=True, gradient_per_m=10.0)
"""Motors that start and stop during a pass: 9 uT between rest and motion were measured on a robot
(github.com/manankharwar/fusioncore, issue 93, three runs of 60 to 156 m), which is 9 uT over the
root of 12 for a uniform distribution in between. The gradient is that of a dipole 0.3 m beside the
bar, 3/r."""

ENVIRONMENTS = {each.name: each for each in (QUIET, REINFORCED, MOTORS)}
"""Environments by name."""


def environment_of(text: str) -> Environment:
    """Return the environment of a name, or of the standard deviation of the field in uT.

    Raises
    ------
    InputError
        The text is neither.
    """
    if text in ENVIRONMENTS:
        return ENVIRONMENTS[text]
    try:
        field_ut = float(text)
    except ValueError:
        field_ut = math.nan
    if math.isnan(field_ut):
        raise InputError(
            f"environment {text!r}",
            hint=f"Give {', '.join(ENVIRONMENTS)}, or the standard deviation of the field in uT",
        )
    return Environment(f"{field_ut:g} uT", field_ut * 1e-6)


def _squared_exponential(position_m: Array, length_m: float) -> Array:
    offset = (position_m[:, None] - position_m[None, :]) / length_m
    return np.exp(-(offset**2) / 2)
