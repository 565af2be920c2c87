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

from locatk.core.lighthouse.light_planes import PLANE_TILT, rays

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


IDEAL_CALIBRATION = Calibration(np.zeros((2, 7)), "none")
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
        :func:`~locatk.core.lighthouse.light_planes.plane_normals`.
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


# ---- calibration of unknown units

# One row a unit: phase of sweep 2 (that of sweep 1 is zero in all), then for both sweeps
# tilt, curve, gibmag, gibphase, ogeemag, ogeephase.
FACTORY_UNITS = np.array(
    [
        # 1083618720
        (-0.006382, -0.050262, 0.045624, 0.022507, 0.190430, -0.006107, -0.006329,
         1.605469, 1.793945, 0.206665, 0.187500, 1.362305, 2.062500),
        # 282585023
        (-0.006214, -0.047882, 0.041382, 0.057678, 0.348877, 0.002190, -0.003235,
         1.704102, 0.120850, -0.368164, -0.299072, 1.700195, 2.062500),
        # 3398739638
        (-0.006275, -0.047882, 0.047363, 0.116089, 0.193237, -0.007393, -0.005386,
         2.046875, 2.251953, 0.282715, 0.172363, 2.216797, 2.642578),
        # 2765867172
        (-0.002159, -0.049622, 0.043884, -0.067078, 0.295410, -0.003815, -0.002544,
         2.535156, 2.654297, -0.209839, -0.188232, 0.762207, 1.591797),
        # 2465522850
        (-0.003456, -0.051453, 0.046844, -0.035309, 0.346436, -0.006634, -0.006760,
         1.861328, 2.304688, 0.132935, 0.242310, 2.125000, 3.062500),
        # 3671943459
        (-0.007420, -0.047119, 0.045990, 0.154785, 0.326416, -0.004402, -0.003576,
         2.369141, 2.714844, -0.176636, -0.218994, 0.476562, 0.965332),
        # three units of one recording without serial numbers
        (-0.005741, -0.046600, 0.043671, 0.012390, 0.341309, 0.002470, 0.002228,
         1.010742, 2.107422, -0.417969, -0.391602, 1.328125, 1.465820),
        (-0.005077, -0.051788, 0.048309, 0.045410, 0.244629, -0.006950, -0.005329,
         2.328125, 2.812500, 0.252686, -0.216553, 3.074219, 0.843262),
        (-0.001843, -0.049988, 0.048096, -0.123108, -0.084839, -0.004356, -0.002129,
         2.291016, 2.222656, 0.143921, -0.077332, 2.939453, 1.486328),
        # 4261648623
        (-0.006184, -0.049011, 0.045746, 0.348633, 0.143433, -0.004772, -0.004246,
         1.912109, 2.226562, 0.113342, -0.210693, 3.093750, 0.364990),
        # 3651042988
        (-0.005894, -0.050537, 0.047974, 0.020767, 0.265137, -0.008698, -0.007442,
         1.968750, 2.410156, 0.248657, 0.330811, 2.167969, 3.070312),
    ]
)  # fmt: skip


def _mean(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 7) mean calibration; a magnitude and its phase are averaged as a phasor."""
    sweeps = np.zeros((2, 7))
    sweeps[1, PHASE] = units[:, 0].mean()
    sweeps[:, TILT] = units[:, 1:3].mean(axis=0)
    sweeps[:, CURVE] = units[:, 3:5].mean(axis=0)
    for magnitude, phase, column in ((GIBMAG, GIBPHASE, 5), (OGEEMAG, OGEEPHASE, 9)):
        phasors = units[:, column : column + 2] * np.exp(1j * units[:, column + 2 : column + 4])
        mean = phasors.mean(axis=0)
        sweeps[:, magnitude], sweeps[:, phase] = np.abs(mean), np.angle(mean)
    return sweeps


def _spread(units: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 2) standard deviation of (phase, tilt) over units."""
    spread = np.zeros((2, 2))
    spread[1, 0] = units[:, 0].std(ddof=1)
    spread[:, 1] = units[:, 1:3].std(axis=0, ddof=1)
    return spread


GENERIC_CALIBRATION = Calibration(_mean(FACTORY_UNITS), "generic")
"""Mean of the published factory calibrations."""

PHASE_TILT_SIGMA_RAD = _spread(FACTORY_UNITS)
"""(2, 2) spread of phase and tilt of each sweep over units, in radians; the phase of
sweep 1 is zero by definition."""

MODEL_SIGMA_RAD = 1e-3
"""What a generic calibration leaves unmodelled, in radians: the spread of gibmag over units
is 3 mrad, of which most is a constant that a station's pose absorbs."""
