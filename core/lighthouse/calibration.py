"""How a real base station bends its two light planes.

Factory calibration has seven numbers a sweep. The forward model is libsurvive's
(``survive_reproject_gen2.c``, MIT), written in the axes used here: x forward, y left,
z up. It predicts the angle that is observed for a point; it is not a correction of
angles, so that correcting needs its inverse (:func:`ideal_angles`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.angles import PLANE_TILT, rays

Array = NDArray[np.float64]

PARAMETERS = ("phase", "tilt", "curve", "gibmag", "gibphase", "ogeemag", "ogeephase")
"""A sweep's seven parameters in the order of the arrays below, as the station sends
them; angles in radians."""

PHASE, TILT, CURVE, GIBMAG, GIBPHASE, OGEEMAG, OGEEPHASE = range(7)

MODELS = ("libsurvive", "crazyflie")

LENS_SERIES = np.array([0.0, 0.0, 0.0076069798, 5.3685255e-06, 0.0028679863, -8.0108022e-06])
"""Coefficients of the lens polynomial, constant term first (libsurvive)."""


@dataclass(frozen=True)
class Calibration:
    """Parameters of the two light planes of one station.

    Attributes
    ----------
    sweeps : (2, 7) ndarray
        One row a sweep, columns as in :data:`PARAMETERS`.
    source : str
        ``"factory"``, ``"generic"``, ``"estimated"`` or ``"none"``.
    model : str
        One of :data:`MODELS`: libsurvive's full model, or what Crazyflie firmware makes of
        the same numbers (``lighthouse_calibration.c``), which leaves curve and ogee out and
        takes the gib wave at the azimuth of the point.
    """

    sweeps: Array
    source: str
    model: str = "libsurvive"

    @property
    def tilts(self) -> Array:
        """(2,) tilt of each plane in radians, nominal plus factory tilt."""
        return PLANE_TILT + self.sweeps[:, TILT]

    @property
    def bends(self) -> bool:
        """Whether more than tilt and phase is known."""
        return bool(np.any(self.sweeps[:, [CURVE, GIBMAG, OGEEMAG]]))


IDEAL = Calibration(np.zeros((2, 7)), "none")
"""Planes exactly 30 degrees off and nothing else, as the paper takes them."""


def predict_angles(points: Array, calibration: Calibration) -> Array:
    """Rotor angles at which both planes of a station meet points.

    Parameters
    ----------
    points : (..., 3) ndarray
        In the station's axes, in any unit of length.
    calibration : Calibration

    Returns
    -------
    (..., 2) ndarray
        Radians; ``nan`` for points that no plane reaches (above or below the cone of
        the sweep).
    """
    x, y, z = (points[..., None, i] for i in range(3))
    return _Sweep(np.arctan2(y, x), z / np.hypot(x, y), calibration).angles


def predict_with_gradient(points: Array, calibration: Calibration) -> tuple[Array, Array, Array]:
    """Rotor angles with their derivatives.

    Parameters as for :func:`predict_angles`.

    Returns
    -------
    angles : (..., 2) ndarray
    by_point : (..., 2, 3) ndarray
        Derivative of each angle by (x, y, z), in radians a unit of length.
    by_tilt : (..., 2) ndarray
        Derivative by the sweep's tilt. (By its phase it is -1.)
    """
    x, y, z = (points[..., None, i] for i in range(3))
    r = np.hypot(x, y)
    slope = z / r
    sweep = _Sweep(np.arctan2(y, x), slope, calibration)
    by_azimuth, by_slope, by_tilt = sweep.gradient()
    across, along = by_azimuth / r, by_slope / r
    by_point = np.stack(
        [
            (-across * y - along * slope * x) / r,
            (across * x - along * slope * y) / r,
            along,
        ],
        axis=-1,
    )
    return sweep.angles, by_point, by_tilt


class _Sweep:
    """The forward model for directions, given as azimuth and slope z / hypot(x, y).

    Attributes are the steps of the model, so that the gradient can follow them:
    ``lead`` is how far a tilted plane runs ahead of a point, ``bent_lead`` the same of
    the curved plane, ``angles`` what the receiver sees.
    """

    def __init__(self, azimuth: Array, slope: Array, calibration: Calibration) -> None:
        p = calibration.sweeps
        tilt = calibration.tilts
        self.parameters, self.slope = p, slope
        self.tan, self.cos, self.sin = np.tan(tilt), np.cos(tilt), np.sin(tilt)
        self.gib_at_azimuth = calibration.model == "crazyflie"
        self.curved = not self.gib_at_azimuth and bool(np.any(p[:, [CURVE, OGEEMAG]]))
        with np.errstate(invalid="ignore"):
            self.lift = self.tan * slope
            self.lead = np.arcsin(self.lift)
            self.bent, self.bent_lead = self.lift, self.lead
            if self.curved:
                self._curve(azimuth)
                self.bent_lead = np.arcsin(self.bent)
        seen = azimuth - self.bent_lead
        self.wave = (azimuth if self.gib_at_azimuth else seen) + p[:, GIBPHASE]
        self.angles = seen + p[:, GIBMAG] * np.cos(self.wave) - p[:, PHASE]

    def _curve(self, azimuth: Array) -> None:
        p = self.parameters
        self.ogee = azimuth - self.lead + p[:, OGEEPHASE]
        self.bend = p[:, CURVE] + p[:, OGEEMAG] * np.cos(self.ogee)
        self.elevation_sin = self.slope / np.sqrt(1.0 + self.slope**2)
        self.off = np.arcsin(self.elevation_sin / self.cos)
        self.lens, self.d_lens = _LENS(self.off), _D_LENS(self.off)
        self.depth = self.cos - self.d_lens * self.bend * self.sin
        self.bent = self.lift + self.lens * self.bend / self.depth

    def gradient(self) -> tuple[Array, Array, Array]:
        """Derivatives of the angles by azimuth, slope and tilt."""
        p = self.parameters
        with np.errstate(invalid="ignore", divide="ignore"):
            d_asin = 1.0 / np.sqrt(1.0 - self.lift**2)
            d_tan = 1.0 / self.cos**2
            if self.curved:
                parts = self._curved_gradient(d_asin, d_tan)
            else:
                parts = (
                    np.ones_like(self.lead),
                    -self.tan * d_asin,
                    -self.slope * d_tan * d_asin,
                )
        wobble = p[:, GIBMAG] * np.sin(self.wave)
        if self.gib_at_azimuth:
            return parts[0] - wobble, parts[1], parts[2]
        return parts[0] * (1.0 - wobble), parts[1] * (1.0 - wobble), parts[2] * (1.0 - wobble)

    def _curved_gradient(self, d_asin: Array, d_tan: Array) -> tuple[Array, Array, Array]:
        dd_lens = _DD_LENS(self.off)
        d_off = 1.0 / np.sqrt(1.0 - (self.elevation_sin / self.cos) ** 2)
        d_bent_asin = 1.0 / np.sqrt(1.0 - self.bent**2)
        bend_by_seen = -self.parameters[:, OGEEMAG] * np.sin(self.ogee)

        def derivative(d_azimuth: float, d_lift: Array, d_sine: Array, d_tilt: float) -> Array:
            """Of (azimuth - bent_lead), for given changes of what it is made from."""
            d_bend = bend_by_seen * (d_azimuth - d_lift * d_asin)
            change = d_off * d_sine
            d_depth = (
                -self.sin * d_tilt
                - dd_lens * change * self.bend * self.sin
                - self.d_lens * d_bend * self.sin
                - self.d_lens * self.bend * self.cos * d_tilt
            )
            d_bent = (
                d_lift
                + (self.d_lens * change * self.bend + self.lens * d_bend) / self.depth
                - self.lens * self.bend / self.depth**2 * d_depth
            )
            return d_azimuth - d_bent * d_bent_asin

        zero = np.zeros_like(self.lift)
        flat = np.sqrt(1.0 + self.slope**2)
        return (
            derivative(1.0, zero, zero, 0.0),
            derivative(0.0, self.tan + zero, 1.0 / (flat**3 * self.cos), 0.0),
            derivative(0.0, self.slope * d_tan, self.elevation_sin * self.sin / self.cos**2, 1.0),
        )


def _horner(coefficients: Array) -> Callable[[Array], Array]:
    def evaluate(x: Array) -> Array:
        total = np.full_like(x, coefficients[-1])
        for c in coefficients[-2::-1]:
            total *= x
            total += c
        return total

    return evaluate


def _derivative(coefficients: Array) -> Array:
    return coefficients[1:] * np.arange(1, len(coefficients))


_LENS = _horner(LENS_SERIES)
_D_LENS = _horner(_derivative(LENS_SERIES))
_DD_LENS = _horner(_derivative(_derivative(LENS_SERIES)))


def ideal_angles(angles: Array, calibration: Calibration, iterations: int = 3) -> Array:
    """Observed rotor angles of a pair, corrected to plain tilted planes.

    Parameters
    ----------
    angles : (..., 2) ndarray
        As observed, in radians.
    calibration : Calibration
    iterations : int
        Fixed-point steps; each shrinks the error by the slope of the bending, about a
        hundred times, so that three leave less than 1e-7 rad.

    Returns
    -------
    (..., 2) ndarray
        Angles of planes with :attr:`Calibration.tilts` and nothing else, for
        :func:`~locatk.core.lighthouse.angles.plane_normals`.
    """
    ideal = angles + calibration.sweeps[:, PHASE]
    if not calibration.bends:
        return ideal
    for _ in range(iterations):
        direction = rays(ideal, calibration.tilts)
        y, z = direction[..., 1:2], direction[..., 2:3]
        bent = _Sweep(np.arctan(y), z / np.hypot(1.0, y), calibration).angles
        # The plain planes meet this direction at the very angles it was made from.
        ideal = angles - (bent - ideal)
    return ideal
