"""Melexis MLX90393, the magnetometer of the published arrays.

Figures are those of Melexis' data sheet 3901090393, as in the drivers of Adafruit
(github.com/adafruit/Adafruit_MLX90393_Library) and T. Yapo; the noise was measured in the published
recordings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import SensorArray, bar

Array = NDArray[np.float64]

QUANTUM_UT = (
    (0.751, 1.210),
    (0.601, 0.968),
    (0.451, 0.726),
    (0.376, 0.605),
    (0.300, 0.484),
    (0.250, 0.403),
    (0.200, 0.323),
    (0.150, 0.242),
)
"""Field per count of X and Y, and of Z [uT], by GAIN_SEL 0 to 7, at resolution 0 and HALLCONF 0xC
(data sheet). GAIN_SEL 7, which drivers call "1x", is the most sensitive."""

HALLCONF_SCALE = {0xC: 1.0, 0x0: 98 / 75}
"""Field per count relative to HALLCONF 0xC. The data sheet gives 0.196 uT for 0x0, some drivers
less (Adafruit_MLX90393_Library issue 7)."""

INVALID_OSR_AND_FILTER = frozenset({(0, 0), (0, 1), (1, 0)})
"""Pairs of oversampling and filter with which the part does not convert (Melexis' getting-started
note; Adafruit_MLX90393_Library issue 11 shows the effect)."""

CONVERSION_OVERHEAD_S = 491e-6
"""Duration of a conversion of all three axes, besides that of the axes themselves (data sheet)."""

READOUT_S = 0.3e-3
"""Time from the end of a conversion to the start of the next, as in the published firmware."""

MEASURED_NOISE_UT = (0.86, 0.89, 1.24)
"""Standard deviation of X, Y, Z in the published recordings while the car was at rest (gain 7,
resolution 0, oversampling 3, filter 3): the median of the sensors. The noise is white."""


@dataclass(frozen=True)
class Settings:
    """Register settings of the part; the published arrays have the defaults.

    Attributes
    ----------
    gain : int
        GAIN_SEL, 0 to 7.
    resolution : int
        RES_XYZ, 0 to 3: each step doubles the field per count.
    osr, filt : int
        OSR, 0 to 3, and DIG_FILT, 0 to 7.
    hallconf : int
        0xC or 0x0.

    Raises
    ------
    InputError
        A value is out of range, or the part does not convert with this pair of oversampling and
        filter.
    """

    gain: int = 7
    resolution: int = 0
    osr: int = 3
    filt: int = 3
    hallconf: int = 0xC

    def __post_init__(self) -> None:
        for name, last in (("gain", 7), ("resolution", 3), ("osr", 3), ("filt", 7)):
            value = getattr(self, name)
            if not 0 <= value <= last:
                raise InputError(f"{name} of the MLX90393 is {value}, not 0 to {last}")
        if self.hallconf not in HALLCONF_SCALE:
            raise InputError(f"hallconf of the MLX90393 is {self.hallconf:#x}, not 0xc or 0x0")
        if (self.osr, self.filt) in INVALID_OSR_AND_FILTER:
            raise InputError(
                f"the MLX90393 does not convert with osr {self.osr} and filt {self.filt}",
                hint="Take a larger filt",
            )

    @property
    def quantum_t(self) -> Array:
        """Field per count of the part's X, Y, Z [T]."""
        xy, z = QUANTUM_UT[self.gain]
        scale = HALLCONF_SCALE[self.hallconf] * 2**self.resolution * 1e-6
        return np.array([xy, xy, z]) * scale

    @property
    def range_t(self) -> Array:
        """Largest field of the part's X, Y, Z that its 16 bits represent [T].

        At resolution 3, zero is at a quarter of the scale instead of its middle.
        """
        return self.quantum_t * (2**14 if self.resolution == 3 else 2**15)

    @property
    def axis_s(self) -> float:
        """Time to convert one axis; X, Y and Z are converted one after the other.

        With :data:`CONVERSION_OVERHEAD_S` the formula reproduces each of the 32 times for three
        axes in the data sheet to its last digit.
        """
        return (67 + 64 * 2**self.osr * (2 + 2**self.filt)) * 1e-6

    @property
    def conversion_s(self) -> float:
        """Time to convert X, Y and Z."""
        return 3 * self.axis_s + CONVERSION_OVERHEAD_S

    @property
    def max_rate_hz(self) -> float:
        """Maximum number of samples per second, including the readout."""
        return 1 / (self.conversion_s + READOUT_S)

    @property
    def noise_t(self) -> Array:
        """Measured standard deviation of the part's X, Y, Z [T]; ``nan`` if none is known.

        It is known for the settings of the published recordings (:data:`MEASURED_NOISE_UT`).
        """
        if self == Settings():
            return np.array(MEASURED_NOISE_UT) * 1e-6
        return np.full(3, np.nan)

    @property
    def assumed_noise_t(self) -> Array:
        """Noise of the part's X, Y, Z for planning, also with settings that were not measured [T].

        White noise averages out over the time of a conversion, so that a shorter conversion than
        the measured one is assumed to be noisier; a longer one is not assumed to be quieter. It is
        at least the noise of rounding to a count.
        """
        ratio = Settings().axis_s / self.axis_s
        white = np.array(MEASURED_NOISE_UT) * 1e-6 * max(1.0, math.sqrt(ratio))
        return np.maximum(white, self.quantum_t / math.sqrt(12))

    def __str__(self) -> str:
        return (
            f"MLX90393 gain {self.gain} resolution {self.resolution} "
            f"osr {self.osr} filt {self.filt}"
        )


def settings_for_rate(rate_hz: float, like: Settings) -> Settings | None:
    """Return the settings with the longest conversion that allow a sample rate.

    Gain, resolution and HALLCONF are those of ``like``. None if no settings allow the rate.
    """
    choices = [
        Settings(like.gain, like.resolution, osr, filt, like.hallconf)
        for osr in range(4)
        for filt in range(8)
        if (osr, filt) not in INVALID_OSR_AND_FILTER
    ]
    allowed = [choice for choice in choices if choice.max_rate_hz >= rate_hz]
    return max(allowed, key=lambda choice: (choice.axis_s, choice.osr), default=None)


def published_bar(
    count: int = 9,
    spacing_m: float = 0.02,
    settings: Settings | None = None,
    noise_t: Array | None = None,
) -> SensorArray:
    """Return a bar of these magnetometers, mounted as on the published arrays.

    The part's X points to the right, Y back and Z down; sensor 0 is the rightmost. The time of a
    sample is the middle of its conversion, which is that of Y: X is converted one
    :attr:`Settings.axis_s` before it (5.19 ms as published), Z one after it.

    Parameters
    ----------
    count, spacing_m : int, float
    settings : Settings, optional
        By default those of the published arrays.
    noise_t : (3,) ndarray, optional
        Noise of the part's X, Y, Z; by default :attr:`Settings.noise_t`.

    Raises
    ------
    InputError
        There is no sensor, or the spacing is not positive.
    """
    if count < 1 or not (spacing_m > 0 and math.isfinite(spacing_m)):
        raise InputError(f"no bar of {count} sensors at a spacing of {spacing_m * 1e3:g} mm")
    part = settings or Settings()
    noise = part.noise_t if noise_t is None else np.asarray(noise_t, float)
    # Axes of the array from those of the part: x = -Y, y = -X, z = -Z.
    order = [1, 0, 2]
    return SensorArray(
        position_m=bar(count, spacing_m),
        noise_t=noise[order],
        delay_s=(np.array([-1.0, 0.0, 1.0]) * part.axis_s)[order],
        quantum_t=part.quantum_t[order],
        range_t=part.range_t[order],
        sensor=str(part),
    )
