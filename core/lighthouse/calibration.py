"""Calibration of base stations: how the light planes of a real unit differ from ideal ones.

A station broadcasts seven factory parameters for each of its two sweeps (OOTX frame). The
manufacturer has not published their meaning; libsurvive's authors found it. This module holds
them (:class:`Calibration`), predicts the rotor angle at which a calibrated plane
crosses a point (:func:`predict_angles`, the forward model), corrects measured angles to those
of ideal planes (:func:`ideal_angles`, its inverse), and describes units whose factory data are
unknown (:data:`GENERIC_CALIBRATION`, the prior).

The forward model is libsurvive's (cntools/libsurvive, ``src/survive_reproject_gen2.c``, MIT),
in the axes of :mod:`~locatk.core.lighthouse.light_planes`: x forward, y left, z up. It predicts
the measured angle of a given point; it is not a correction of measured angles (libsurvive issue
215). With tilt ``t = nominal + factory tilt`` of a plane and a point at

    azimuth  = atan2(y, x)
    slope    = z / hypot(x, y)                        tangent of the elevation

an ideal plane tilted by ``t`` has the rotor angle ``azimuth - offset`` when it crosses the point:

    sin(offset) = tan(t) slope                                                      (1)

A real plane is curved. Its curvature is a constant ("curve") and a wave of one period per
rotation ("ogee"); it acts through a polynomial L, common to all units, of the angle ``beta``
from the plane's horizontal direction to the point, measured in the plane:

    curvature   = curve + ogeemag cos(azimuth - offset + ogeephase)                 (2)
    sin(beta)   = sin(elevation) / cos(t)                                           (3)
    sin(curved offset) = tan(t) slope
                         + L(beta) curvature / (cos(t) - L'(beta) curvature sin(t)) (4)

Another wave of one period per rotation ("gib") and a constant angle ("phase") remain:

    crossing = azimuth - curved offset                                              (5)
    measured = crossing + gibmag cos(crossing + gibphase) - phase                   (6)

libsurvive measures azimuths from an axis a quarter of a revolution away, so that its sines are
cosines here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.light_planes import PLANE_TILT_RAD, rays

Array = NDArray[np.float64]

PARAMETERS = ("phase", "tilt", "curve", "gibmag", "gibphase", "ogeemag", "ogeephase")
"""Names of the seven parameters of a sweep, in the order of the columns of
:attr:`Calibration.sweeps`. Phase, tilt and the phases of the waves are in radians, the
magnitude of gib in radians, those of curve and ogee without unit."""

PHASE, TILT, CURVE, GIBMAG, GIBPHASE, OGEEMAG, OGEEPHASE = range(7)

LINEAR_PARAMETERS = (
    "phase",
    "tilt",
    "curve",
    "gibmag cos gibphase",
    "gibmag sin gibphase",
    "ogeemag cos ogeephase",
    "ogeemag sin ogeephase",
)
"""Parameters of a sweep with the waves as phasors: angles are smooth functions of these, also if a
magnitude is zero. :meth:`Calibration.linear_parameters` returns them."""

MODELS = ("libsurvive", "crazyflie")

LENS_POLYNOMIAL = np.array([0.0, 0.0, 0.0076069798, 5.3685255e-06, 0.0028679863, -8.0108022e-06])
"""Coefficients of L in Eq. 4, constant term first (survive_reproject_gen2.c)."""


@dataclass(frozen=True)
class Calibration:
    """Parameters of the two light planes of one station.

    Attributes
    ----------
    sweeps : (2, 7) ndarray
        One row per sweep, columns as in :data:`PARAMETERS`.
    source : str
        ``"factory"``, ``"generic"``, ``"estimated"`` or ``"none"``.
    model : str
        Forward model, one of :data:`MODELS`: libsurvive's, or that of the Crazyflie firmware
        (``lighthouse_calibration.c``) for the same parameters. The firmware ignores curve and
        ogee, and takes the gib wave at the azimuth of the point instead of Eq. 5.
    """

    sweeps: Array
    source: str
    model: str = "libsurvive"

    @property
    def tilts(self) -> Array:
        """Tilts (2,) of the planes in radians, nominal plus factory tilt."""
        return PLANE_TILT_RAD + self.sweeps[:, TILT]

    def linear_parameters(self) -> Array:
        """Return the parameters (2, 7) with phasors, as :data:`LINEAR_PARAMETERS`."""
        parameters = self.sweeps.copy()
        for magnitude, phase in ((GIBMAG, GIBPHASE), (OGEEMAG, OGEEPHASE)):
            wave = self.sweeps[:, magnitude] * np.exp(1j * self.sweeps[:, phase])
            parameters[:, magnitude], parameters[:, phase] = wave.real, wave.imag
        return parameters

    def with_linear_parameters(self, parameters: Array) -> Calibration:
        """Return the calibration with other :data:`LINEAR_PARAMETERS` (2, 7)."""
        sweeps = parameters.copy()
        for magnitude, phase in ((GIBMAG, GIBPHASE), (OGEEMAG, OGEEPHASE)):
            wave = parameters[:, magnitude] + 1j * parameters[:, phase]
            sweeps[:, magnitude], sweeps[:, phase] = np.abs(wave), np.angle(wave)
        return replace(self, sweeps=sweeps)

    @property
    def is_generic(self) -> bool:
        """True for an average of other units, also if it was refined from a recording."""
        return self.source in ("generic", "estimated")

    @property
    def is_distorted(self) -> bool:
        """True if a parameter other than phase and tilt has an effect."""
        return bool(np.any(self.sweeps[:, [CURVE, GIBMAG, OGEEMAG]]))


IDEAL_CALIBRATION = Calibration(np.zeros((2, 7)), "none")
"""Planes with the nominal tilt and no distortion, as the paper assumes them."""


def predict_angles(points: Array, calibration: Calibration) -> Array:
    """Predict the rotor angles at which both planes of a station cross points.

    Parameters
    ----------
    points : (..., 3) ndarray
        In the station's axes, in any unit of length.
    calibration : Calibration

    Returns
    -------
    (..., 2) ndarray
        Radians; ``nan`` for points that no plane crosses (steeper than the planes).
    """
    x, y, z = (points[..., None, i] for i in range(3))
    return _ForwardModel(np.arctan2(y, x), z / np.hypot(x, y), calibration).angles


def predict_with_gradient(points: Array, calibration: Calibration) -> tuple[Array, Array, Array]:
    """Predict rotor angles and their derivatives.

    Parameters
    ----------
    points, calibration
        See :func:`predict_angles`.

    Returns
    -------
    angles : (..., 2) ndarray
        Radians.
    by_point : (..., 2, 3) ndarray
        Derivative of each angle by (x, y, z), in radians per unit of length.
    by_tilt : (..., 2) ndarray
        Derivative of each angle by the tilt of its plane. (The derivative by phase is -1.)
    """
    model, by_point, by_tilt = _model_with_gradient(points, calibration)
    return model.angles, by_point, by_tilt


def _model_with_gradient(
    points: Array, calibration: Calibration
) -> tuple[_ForwardModel, Array, Array]:
    x, y, z = (points[..., None, i] for i in range(3))
    r = np.hypot(x, y)
    slope = z / r
    model = _ForwardModel(np.arctan2(y, x), slope, calibration)
    by_azimuth, by_slope, by_tilt = model.gradient()
    # d azimuth = (-y, x, 0) / r^2 and d slope = (-slope x, -slope y, r) / r^2.
    tangential, radial = by_azimuth / r, by_slope / r
    by_point = np.stack(
        [
            (-tangential * y - radial * slope * x) / r,
            (tangential * x - radial * slope * y) / r,
            radial,
        ],
        axis=-1,
    )
    return model, by_point, by_tilt


def predict_with_derivatives(points: Array, calibration: Calibration) -> tuple[Array, Array, Array]:
    """Predict rotor angles, with derivatives by the points and all parameters.

    Parameters
    ----------
    points, calibration
        See :func:`predict_angles`.

    Returns
    -------
    angles : (..., 2) ndarray
        Radians; ``nan`` for points that a plane does not cross.
    by_point : (..., 2, 3) ndarray
        Derivative of each angle by the point.
    by_parameters : (..., 2, 7) ndarray
        Derivative of each angle by :data:`LINEAR_PARAMETERS` of its plane.
    """
    model, by_point, by_tilt = _model_with_gradient(points, calibration)
    return model.angles, by_point, model.by_linear_parameters(by_tilt)


def predict_sweeps(
    points: Array, plane: NDArray[np.int64], calibration: Calibration
) -> tuple[Array, Array, Array]:
    """Predict the rotor angles of single sweeps, with derivatives by all parameters.

    Parameters
    ----------
    points : (n, 3) ndarray
        In the station's axes, in any unit of length.
    plane : (n,) int ndarray
        0 or 1.
    calibration : Calibration

    Returns
    -------
    angle : (n,) ndarray
        Radians; ``nan`` for points that the plane does not cross.
    by_point : (n, 3) ndarray
        Derivative by the point.
    by_parameters : (n, 7) ndarray
        Derivative by :data:`LINEAR_PARAMETERS` of the plane.
    """
    angles, by_point, by_parameters = predict_with_derivatives(points, calibration)
    rows = np.arange(len(points))
    return angles[rows, plane], by_point[rows, plane], by_parameters[rows, plane]


class _ForwardModel:
    """Eq. 1 to 6 of the module for directions, evaluated once for angles and derivatives.

    All arrays are (..., 2), one value per plane.

    Attributes
    ----------
    sin_offset, offset
        Eq. 1: azimuth of the point relative to the direction of an ideal tilted plane.
    curvature, ogee_angle, plane_angle, lens, lens_slope, denominator
        Terms of Eq. 2 to 4: the curvature, the argument of its cosine, ``beta``, L(beta),
        L'(beta) and the denominator of Eq. 4. Set only if the model is curved.
    sin_curved_offset
        Eq. 4; Eq. 1 if the plane is not curved.
    gib_angle
        Argument of the cosine of Eq. 6.
    angles
        Rotor angles in radians (Eq. 6).
    """

    def __init__(self, azimuth: Array, slope: Array, calibration: Calibration) -> None:
        self.parameters, self.azimuth, self.slope = calibration.sweeps, azimuth, slope
        parameters, tilt = calibration.sweeps, calibration.tilts
        self.tan_tilt, self.cos_tilt, self.sin_tilt = np.tan(tilt), np.cos(tilt), np.sin(tilt)
        self.is_crazyflie = calibration.model == "crazyflie"
        has_curvature = bool(np.any(parameters[:, [CURVE, OGEEMAG]]))
        self.is_curved = has_curvature and not self.is_crazyflie
        with np.errstate(invalid="ignore"):
            self.sin_offset = self.tan_tilt * slope
            self.offset = np.arcsin(self.sin_offset)
            self.sin_curved_offset, curved_offset = self.sin_offset, self.offset
            if self.is_curved:
                self._curve(azimuth)
                curved_offset = np.arcsin(self.sin_curved_offset)
        crossing = azimuth - curved_offset
        self.gib_angle = (azimuth if self.is_crazyflie else crossing) + parameters[:, GIBPHASE]
        gib = parameters[:, GIBMAG] * np.cos(self.gib_angle)
        self.angles = crossing + gib - parameters[:, PHASE]

    def _curve(self, azimuth: Array) -> None:
        """Evaluate Eq. 2 to 4."""
        parameters = self.parameters
        self.ogee_angle = azimuth - self.offset + parameters[:, OGEEPHASE]
        self.curvature = parameters[:, CURVE] + parameters[:, OGEEMAG] * np.cos(self.ogee_angle)
        self.sin_elevation = self.slope / np.sqrt(1.0 + self.slope**2)
        self.plane_angle = np.arcsin(self.sin_elevation / self.cos_tilt)
        self.lens, self.lens_slope = _LENS(self.plane_angle), _LENS_SLOPE(self.plane_angle)
        self.denominator = self.cos_tilt - self.lens_slope * self.curvature * self.sin_tilt
        self.sin_curved_offset = self.sin_offset + self.lens * self.curvature / self.denominator

    def gradient(self) -> tuple[Array, Array, Array]:
        """Return the derivatives of the angles by azimuth, slope and tilt, each (..., 2)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            # Derivatives of the offset by its sine, and of the tangent by the tilt.
            d_offset = 1.0 / np.sqrt(1.0 - self.sin_offset**2)
            d_tan_tilt = 1.0 / self.cos_tilt**2
            if self.is_curved:
                crossing = self._curved_gradient(d_offset, d_tan_tilt)
            else:
                crossing = (
                    np.ones_like(self.offset),
                    -self.tan_tilt * d_offset,
                    -self.slope * d_tan_tilt * d_offset,
                )
        d_gib = self.parameters[:, GIBMAG] * np.sin(self.gib_angle)
        by_azimuth, by_slope, by_tilt = crossing
        if self.is_crazyflie:
            return by_azimuth - d_gib, by_slope, by_tilt
        return by_azimuth * (1.0 - d_gib), by_slope * (1.0 - d_gib), by_tilt * (1.0 - d_gib)

    def by_linear_parameters(self, by_tilt: Array) -> Array:
        """Return the derivatives (..., 2, 7) by :data:`LINEAR_PARAMETERS`, given those by tilt."""
        gib_base = self.gib_angle - self.parameters[:, GIBPHASE]
        by_crossing = np.ones_like(gib_base)
        if not self.is_crazyflie:
            by_crossing = 1.0 - self.parameters[:, GIBMAG] * np.sin(self.gib_angle)
        derivatives = np.zeros((*self.angles.shape, len(LINEAR_PARAMETERS)))
        derivatives[..., PHASE], derivatives[..., TILT] = -1.0, by_tilt
        derivatives[..., GIBMAG] = np.cos(gib_base)
        derivatives[..., GIBPHASE] = -np.sin(gib_base)
        if not self.is_crazyflie:
            with np.errstate(invalid="ignore", divide="ignore"):
                self._curve(self.azimuth)
                d_curved_offset = 1.0 / np.sqrt(1.0 - self.sin_curved_offset**2)
                by_curve = -self.lens * self.cos_tilt / self.denominator**2 * d_curved_offset
            ogee_base = self.ogee_angle - self.parameters[:, OGEEPHASE]
            derivatives[..., CURVE] = by_curve * by_crossing
            derivatives[..., OGEEMAG] = derivatives[..., CURVE] * np.cos(ogee_base)
            derivatives[..., OGEEPHASE] = -derivatives[..., CURVE] * np.sin(ogee_base)
        return derivatives

    def _curved_gradient(self, d_offset: Array, d_tan_tilt: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of the crossing (Eq. 5) of curved planes."""
        lens_curvature = _LENS_CURVATURE(self.plane_angle)
        d_plane_angle = 1.0 / np.sqrt(1.0 - (self.sin_elevation / self.cos_tilt) ** 2)
        d_curved_offset = 1.0 / np.sqrt(1.0 - self.sin_curved_offset**2)
        d_ogee = -self.parameters[:, OGEEMAG] * np.sin(self.ogee_angle)

        def derivative(
            azimuth_rate: float,
            sin_offset_rate: Array,
            sin_plane_angle_rate: Array,
            tilt_rate: float,
        ) -> Array:
            """Apply the chain rule to Eq. 2 to 5, for given rates of the inner terms."""
            curvature_rate = d_ogee * (azimuth_rate - sin_offset_rate * d_offset)
            plane_angle_rate = d_plane_angle * sin_plane_angle_rate
            denominator_rate = (
                -self.sin_tilt * tilt_rate
                - lens_curvature * plane_angle_rate * self.curvature * self.sin_tilt
                - self.lens_slope * curvature_rate * self.sin_tilt
                - self.lens_slope * self.curvature * self.cos_tilt * tilt_rate
            )
            numerator_rate = (
                self.lens_slope * plane_angle_rate * self.curvature + self.lens * curvature_rate
            )
            sin_curved_offset_rate = (
                sin_offset_rate
                + numerator_rate / self.denominator
                - self.lens * self.curvature / self.denominator**2 * denominator_rate
            )
            return azimuth_rate - sin_curved_offset_rate * d_curved_offset

        zero = np.zeros_like(self.sin_offset)
        secant = np.sqrt(1.0 + self.slope**2)
        return (
            derivative(1.0, zero, zero, 0.0),
            derivative(0.0, self.tan_tilt + zero, 1.0 / (secant**3 * self.cos_tilt), 0.0),
            derivative(
                0.0,
                self.slope * d_tan_tilt,
                self.sin_elevation * self.sin_tilt / self.cos_tilt**2,
                1.0,
            ),
        )


def _polynomial(coefficients: Array) -> Callable[[Array], Array]:
    """Return a function that evaluates a polynomial by Horner's scheme, in place."""

    def evaluate(x: Array) -> Array:
        value = np.full_like(x, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            value *= x
            value += coefficient
        return value

    return evaluate


def _derivative(coefficients: Array) -> Array:
    """Return the coefficients of the derivative, constant term first."""
    return coefficients[1:] * np.arange(1, len(coefficients))


_LENS = _polynomial(LENS_POLYNOMIAL)
_LENS_SLOPE = _polynomial(_derivative(LENS_POLYNOMIAL))
_LENS_CURVATURE = _polynomial(_derivative(_derivative(LENS_POLYNOMIAL)))


def ideal_angles(angles: Array, calibration: Calibration, iterations: int = 3) -> Array:
    """Correct the measured rotor angles of pairs to those of ideal tilted planes.

    Parameters
    ----------
    angles : (..., 2) ndarray
        Measured angles in radians. Both of a pair are needed; ``nan`` makes both ``nan``.
    calibration : Calibration
    iterations : int
        Fixed-point steps. Each multiplies the error by the derivative of the distortion, about
        0.01, so that three steps leave less than 1e-7 rad.

    Returns
    -------
    (..., 2) ndarray
        Rotor angles of planes with :attr:`Calibration.tilts` and no distortion through the same
        point, for :func:`~locatk.core.lighthouse.light_planes.plane_normals` and
        :func:`~locatk.core.lighthouse.light_planes.rays`.
    """
    ideal = angles + calibration.sweeps[:, PHASE]
    if not calibration.is_distorted:
        return ideal
    for _ in range(iterations):
        direction = rays(ideal, calibration.tilts)
        y, z = direction[..., 1:2], direction[..., 2:3]
        predicted = _ForwardModel(np.arctan(y), z / np.hypot(1.0, y), calibration).angles
        # Ideal planes at `ideal` meet in this ray, so that the difference is the distortion.
        ideal = angles - (predicted - ideal)
    return ideal


# ---- prior over units

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
        # Three units of one recording, without serial numbers.
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
"""(11, 13) factory parameters of real base stations, one row per unit.

Columns: phase of sweep 2 (that of sweep 1 is zero in every unit), then for both sweeps tilt,
curve, gibmag, gibphase, ogeemag and ogeephase. Comments are the serial numbers. The first nine
units are those of the recordings in jdavidberger/libsurvive-extras-data (MIT), the last two
were published by Bitcraze."""


def _phase_tilt_sigma(units: Array) -> Array:
    """Return the standard deviation (2, 2) over units: a row per sweep, columns phase, tilt."""
    sigma = np.zeros((2, 2))
    sigma[1, 0] = units[:, 0].std(ddof=1)
    sigma[:, 1] = units[:, 1:3].std(axis=0, ddof=1)
    return sigma


def _linear_parameters(units: Array) -> Array:
    """Return the parameters (n, 2, 7) of units as :data:`LINEAR_PARAMETERS`."""
    parameters = np.zeros((len(units), 2, 7))
    parameters[:, 1, PHASE] = units[:, 0]
    parameters[:, :, TILT], parameters[:, :, CURVE] = units[:, 1:3], units[:, 3:5]
    for magnitude, phase, column in ((GIBMAG, GIBPHASE, 5), (OGEEMAG, OGEEPHASE, 9)):
        wave = units[:, column : column + 2] * np.exp(1j * units[:, column + 2 : column + 4])
        parameters[:, :, magnitude], parameters[:, :, phase] = wave.real, wave.imag
    return parameters


FACTORY_LINEAR_PARAMETERS = _linear_parameters(FACTORY_UNITS)
"""(11, 2, 7) :data:`LINEAR_PARAMETERS` of both planes of :data:`FACTORY_UNITS`."""

GENERIC_CALIBRATION = Calibration(np.zeros((2, 7)), "generic").with_linear_parameters(
    FACTORY_LINEAR_PARAMETERS.mean(axis=0)
)
"""Mean of :data:`FACTORY_UNITS`, for stations whose factory data are unknown."""

PHASE_TILT_SIGMA_RAD = _phase_tilt_sigma(FACTORY_UNITS)
"""(2, 2) standard deviation of phase and tilt of each sweep over :data:`FACTORY_UNITS`, in
radians; the phase of sweep 1 is zero by definition."""

MODEL_SIGMA_RAD = 1e-3
"""Standard deviation of what a generic calibration leaves unmodelled, in radians, when phase and
tilt are estimated. gibmag varies over :data:`FACTORY_UNITS` by 3 mrad, but most of that is a
constant that the station's pose absorbs."""
