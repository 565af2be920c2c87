"""Optics and light of a camera over printed dots, in closed form."""

from __future__ import annotations

import math

from locatk.core.dots.design.camera_setup import MAX_LEVEL, CameraSetup
from locatk.core.dots.design.dot_noise import PAPER_LEVEL
from locatk.core.dots.design.read_rate import MAX_BLUR_PITCHES, searched_levels
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES

GOOD_NOISE_LEVELS = 4.0
"""Noise of a pixel of a searched image of paper, in grey values, from which more light hardly
helps: other errors of a dot are larger."""

LUMEN_PHOTONS_PER_S = 4.09e15
"""Photons of one lumen at 555 nm: 1 / 683 W over the energy of a photon, 3.58e-19 J (SI: candela).
"""

QUANTUM_EFFICIENCY = 0.5
"""Electrons per photon at the peak of common CMOS sensors, if the data sheet does not give it."""

PAPER_REFLECTANCE = 0.8
LENS_TRANSMITTANCE = 0.9

AIRY_DIAMETER, AIRY_SIGMA = 2.44, 0.42
"""Diameter of the first dark ring, and standard deviation of the Gaussian that fits the middle of
the diffraction pattern, in wavelength times working f-number (Hecht, Optics, 10.2.5)."""


# ---- optics


def window_diagonal_m(dots: int, pitch_m: float) -> float:
    """Return the diagonal of a square of dots that are displaced outwards (paper, III-A.3).

    The nominal diameter of a dot is its displacement, 1/6 of the pitch.

    >>> round(window_diagonal_m(8, 0.508e-3) * 1e3, 2)
    5.39
    """
    return math.sqrt(2) * pitch_m * (dots - 1 + 3 * DOT_OFFSET_PITCHES)


def window_in_view(side_m: float, pitch_m: float) -> int:
    """Return the columns and rows of the largest square of dots whose diagonal fits ``side_m``."""
    rest = side_m / (math.sqrt(2) * pitch_m) - 3 * DOT_OFFSET_PITCHES
    return max(0, 1 + math.floor(rest + 1e-9))


def _working_wavelength_m(setup: CameraSetup) -> float:
    """Return the wavelength times the f-number on the side of the sensor."""
    return setup.wavelength_m * setup.lens.f_number * (1 + setup.magnification)


def diffraction_disc_m(setup: CameraSetup) -> float:
    """Return the diameter of the diffraction disc on the sensor."""
    return AIRY_DIAMETER * _working_wavelength_m(setup)


def blur_circle_m(setup: CameraSetup, distance_m: float) -> float:
    """Return the diameter on the sensor of the image of a point at another distance."""
    aperture = setup.lens.focal_m / setup.lens.f_number
    return aperture * setup.image_distance_m * abs(1 / setup.distance_m - 1 / distance_m)


def focus_range(setup: CameraSetup, confusion_m: float) -> tuple[float, float]:
    """Return the nearest and farthest distance whose blur circle is ``confusion_m``."""
    aperture = setup.lens.focal_m / setup.lens.f_number
    step = confusion_m / (aperture * setup.image_distance_m)
    inverse = 1 / setup.distance_m
    return 1 / (inverse + step), math.inf if step >= inverse else 1 / (inverse - step)


def tolerated_confusion_m(setup: CameraSetup) -> float:
    """Return the largest blur circle with which dots are decoded.

    A uniform disc of diameter c has a standard deviation of c / 4 per axis. Diffraction and
    aberrations take their part of the blur that the decoder tolerates.
    """
    limit = MAX_BLUR_PITCHES * setup.pitch_m * setup.magnification
    rest = limit**2 - _diffraction_sigma_m(setup) ** 2 - setup.lens_blur_m**2
    return 4 * math.sqrt(max(rest, 0.0))


def _diffraction_sigma_m(setup: CameraSetup) -> float:
    return AIRY_SIGMA * _working_wavelength_m(setup)


def static_blur_px(setup: CameraSetup) -> float:
    """Return the standard deviation of the blur by focus, diffraction and aberrations in pixels."""
    defocus = max(
        blur_circle_m(setup, setup.distance_m + sign * setup.focus_error_m)
        for sign in (-1, 1)
        if setup.distance_m + sign * setup.focus_error_m > 0
    )
    sigma = math.hypot(defocus / 4, _diffraction_sigma_m(setup), setup.lens_blur_m)
    return sigma / setup.pixel_m


def frame_rate(setup: CameraSetup) -> float:
    """Return the largest frame rate with this exposure."""
    return min(setup.sensor.max_fps, 1 / setup.exposure_s)


def distance_for_field(setup: CameraSetup, side_m: float) -> float:
    """Return the distance of the lens at which the shorter side of the field is ``side_m``."""
    magnification = min(setup.size_px) * setup.pixel_m / side_m
    return setup.lens.focal_m * (1 + 1 / magnification)


# ---- light


def electrons_of_paper(setup: CameraSetup, illuminance_lx: float) -> float:
    """Return the electrons of a pixel of paper, without saturation.

    Illuminance of the sensor: E R T / (4 N^2 (1 + m)^2) for a diffuse paper.
    """
    working = setup.lens.f_number * (1 + setup.magnification)
    on_sensor_lx = illuminance_lx * PAPER_REFLECTANCE * LENS_TRANSMITTANCE / (4 * working**2)
    photons = on_sensor_lx * LUMEN_PHOTONS_PER_S * setup.pixel_m**2 * setup.exposure_s
    return photons * QUANTUM_EFFICIENCY


def full_well_e(setup: CameraSetup) -> float:
    """Return the electrons of a saturated pixel of a frame; binned pixels add up."""
    return setup.sensor.full_well_e * setup.binning**2


def needed_illuminance_lx(setup: CameraSetup) -> float:
    """Return the illuminance of the paper from which more light hardly helps.

    The noise of a pixel of the image that is searched is then :data:`GOOD_NOISE_LEVELS`; halving a
    large frame averages its pixels.
    """
    averaged = 4 ** searched_levels(setup.size_px)[0]
    relative = averaged * (GOOD_NOISE_LEVELS / PAPER_LEVEL) ** 2
    read_variance = (setup.sensor.read_noise_e * setup.binning) ** 2
    electrons = (1 + math.sqrt(1 + 4 * relative * read_variance)) / (2 * relative)
    return electrons / electrons_of_paper(setup, 1.0)


def full_illuminance_lx(setup: CameraSetup) -> float:
    """Return the illuminance with which the paper has :data:`PAPER_LEVEL` without gain."""
    return PAPER_LEVEL / MAX_LEVEL * full_well_e(setup) / electrons_of_paper(setup, 1.0)


def noise_levels(setup: CameraSetup) -> float:
    """Return the noise of a pixel of paper in grey values: photons and read noise.

    With less light than is needed, the gain of the sensor brings the paper to
    :data:`PAPER_LEVEL`, and the noise with it.
    """
    if setup.noise_levels is not None:
        return setup.noise_levels
    electrons = PAPER_LEVEL / MAX_LEVEL * full_well_e(setup)
    if setup.illuminance_lx is not None:
        electrons = min(electrons, electrons_of_paper(setup, setup.illuminance_lx))
    read_noise = setup.sensor.read_noise_e * setup.binning
    return PAPER_LEVEL * math.sqrt(electrons + read_noise**2) / electrons


def illuminance_text(illuminance_lx: float) -> str:
    """Format an illuminance with three digits.

    >>> illuminance_text(44380.2), illuminance_text(9.4567)
    ('44400 lx', '9.46 lx')
    """
    rounded = float(f"{illuminance_lx:.3g}")
    return f"{rounded:.0f} lx" if rounded >= 100 else f"{rounded:g} lx"
