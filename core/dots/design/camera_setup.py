"""Sensor, lens and conditions of a camera over printed dots.

The lens is thin: an object at the distance s is in focus at v = 1 / (1 / f - 1 / s) behind it,
magnified by v / s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.units import length_text

MAX_LEVEL = 255.0
"""Grey value of a saturated pixel of 8 bits."""

MAX_QUANTITY = 1e4
"""Limit of speeds [m/s, rad/s], jitter, blur and errors of the distance [m]."""

MAX_SIDE_M = 10.0
"""Larger distances are probably in another unit."""


@dataclass(frozen=True)
class Sensor:
    """Image sensor.

    Attributes
    ----------
    name : str
    size_px : (width, height)
    pixel_m : float
        Width of a pixel.
    max_fps : float
        Frame rate at full size.
    shutter : {"global", "rolling"}
    is_colour : bool
    max_snr_db : float
        Signal to noise ratio at saturation, 10 log10 of the full well in electrons: 38 dB are 6300.
    dynamic_range_db : float
        20 log10 of the full well over the read noise.
    min_exposure_s : float
    source : str
        Data sheet.
    """

    name: str
    size_px: tuple[int, int]
    pixel_m: float
    max_fps: float
    shutter: str = "global"
    is_colour: bool = False
    max_snr_db: float = 38.0
    dynamic_range_db: float = 60.0
    min_exposure_s: float = 20e-6
    source: str = ""

    def __post_init__(self) -> None:
        if min(self.size_px) < 1:
            raise InputError(f"a sensor of {self.size_px[0]} x {self.size_px[1]} px")
        if self.shutter not in ("global", "rolling"):
            raise InputError(f"no shutter {self.shutter!r}", hint="Known: global, rolling")
        _require(self, 0, 100e-6, "pixel_m", unit="um", scale=1e6)
        _require(self, 0, 1e5, "max_fps")
        _require(self, 0, 80, "max_snr_db", "dynamic_range_db")
        _require(self, 0, 10, "min_exposure_s")

    @property
    def full_well_e(self) -> float:
        """Electrons of a saturated pixel."""
        return float(10 ** (self.max_snr_db / 10))

    @property
    def read_noise_e(self) -> float:
        """Noise of a dark pixel in electrons."""
        return float(self.full_well_e / 10 ** (self.dynamic_range_db / 20))


@dataclass(frozen=True)
class Lens:
    """Lens; ``distortion`` displaces a corner of the frame towards the centre, relative."""

    focal_m: float
    f_number: float = 2.4
    distortion: float = 0.02

    def __post_init__(self) -> None:
        _require(self, 0, 1, "focal_m", unit="mm", scale=1e3)
        _require(self, 0.5, 64, "f_number")
        if not -0.35 <= self.distortion <= 0.35:
            raise InputError(
                f"a distortion of {self.distortion:g}", hint="Give a fraction from -0.35 to 0.35"
            )


@dataclass(frozen=True)
class CameraSetup:
    """Camera over a printed sheet.

    Attributes
    ----------
    sensor : Sensor
    lens : Lens
    distance_m : float
        From the lens (its principal plane) to the paper; the lens is focused there.
    exposure_s : float
    binning : int
        Pixels of the sensor along each side of one pixel of the frame.
    pitch_m : float
        Distance of two positions of the printed grid.
    dot_pitches : float
        Diameter of a printed dot; the nominal 1/6 grows in print.
    contrast : float
        Contrast of the ink; 1 is black.
    illuminance_lx : float or None
        On the paper, at 555 nm; None: as much as the exposure needs.
    noise_levels : float or None
        Standard deviation of a pixel of paper in grey values, instead of that by the light.
    lens_blur_m : float
        Standard deviation of the blur by aberrations, on the sensor.
    focus_error_m : float
        Error of the distance: tolerances of the holder and waves of the paper.
    tilt_rad : float
        Angle between the optical axis and the vertical.
    jitter_m : float
        Standard deviation of the position of a printed dot, per axis.
    wavelength_m : float
    speed_mps, yaw_rate_rps : float
        Largest speeds at which poses are wanted.
    wanted_rate_hz : float
        Poses per second.
    is_calibrated : bool
        The lens is known (`locatk calibrate camera`); otherwise it is estimated in each frame.

    Raises
    ------
    InputError
        A value is out of its range, or the lens cannot be focused on the paper.
    """

    sensor: Sensor
    lens: Lens
    distance_m: float
    exposure_s: float
    binning: int = 1
    pitch_m: float = 0.508e-3
    dot_pitches: float = 0.30
    contrast: float = 0.75
    illuminance_lx: float | None = None
    noise_levels: float | None = None
    lens_blur_m: float = 0.0
    focus_error_m: float = 0.2e-3
    tilt_rad: float = 0.0
    jitter_m: float = 10e-6
    wavelength_m: float = 850e-9
    speed_mps: float = 0.0
    yaw_rate_rps: float = 0.0
    wanted_rate_hz: float = 30.0
    is_calibrated: bool = True

    def __post_init__(self) -> None:
        _require(self, 0, MAX_SIDE_M, "distance_m", unit="mm", scale=1e3)
        _require(self, 0, 10, "exposure_s")
        _require(self, 0, 0.1, "pitch_m", unit="mm", scale=1e3)
        _require(self, 0, 2 / 3, "dot_pitches")
        _require(self, 0, 1, "contrast")
        _require(self, 0, 1e-5, "wavelength_m", unit="nm", scale=1e9)
        _require(self, 0, 1e5, "wanted_rate_hz")
        for name, quantity, scale, unit in (
            ("speed_mps", "speed", 1.0, "m/s"),
            ("yaw_rate_rps", "rate of rotation", 180 / math.pi, "deg/s"),
            ("jitter_m", "jitter of the dots", 1e6, "um"),
            ("lens_blur_m", "blur of the lens", 1e6, "um"),
            ("focus_error_m", "error of the distance", 1e3, "mm"),
        ):
            value = getattr(self, name)
            if not 0 <= value < MAX_QUANTITY:
                raise InputError(
                    f"the {quantity} is {value * scale:g} {unit}",
                    hint=f"Give at least 0, below {MAX_QUANTITY * scale:g} {unit}",
                )
        if self.illuminance_lx is not None:
            _require(self, 0, 1e7, "illuminance_lx")
        if self.noise_levels is not None and not 0 <= self.noise_levels <= MAX_LEVEL:
            raise InputError(f"a noise of {self.noise_levels:g} grey values", hint="Give 0 to 255")
        if not 0 <= self.tilt_rad <= math.pi / 4:
            raise InputError(
                f"a tilt of {math.degrees(self.tilt_rad):g} degrees", hint="Give 0 to 45 degrees"
            )
        if not 1 <= self.binning <= min(self.sensor.size_px):
            raise InputError(f"a binning of {self.binning}", hint="Give 1, 2 or 4")
        if self.distance_m <= 1.05 * self.lens.focal_m:
            raise InputError(
                f"a lens of {length_text(self.lens.focal_m)} cannot be focused on paper "
                f"{length_text(self.distance_m)} in front of it",
                hint=f"Give a distance above {length_text(2 * self.lens.focal_m)}, or a shorter "
                "focal length",
            )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of a frame."""
        width, height = self.sensor.size_px
        return width // self.binning, height // self.binning

    @property
    def pixel_m(self) -> float:
        """Width of a pixel of a frame on the sensor."""
        return self.binning * self.sensor.pixel_m

    @property
    def image_distance_m(self) -> float:
        """Distance from the lens to the sensor."""
        return 1 / (1 / self.lens.focal_m - 1 / self.distance_m)

    @property
    def magnification(self) -> float:
        """Size of the image over that of the paper."""
        return self.image_distance_m / self.distance_m

    @property
    def metres_per_px(self) -> float:
        """Width of a pixel on the paper."""
        return self.pixel_m / self.magnification

    @property
    def field_m(self) -> tuple[float, float]:
        """Width and height of the visible paper, without distortion."""
        width, height = self.size_px
        return width * self.metres_per_px, height * self.metres_per_px

    @property
    def corner_m(self) -> float:
        """Distance on the paper from the centre of the frame to its corner."""
        return math.hypot(*self.field_m) / 2

    @property
    def corner_speed_mps(self) -> float:
        """Largest speed of the corner of the frame over the paper."""
        return self.speed_mps + self.yaw_rate_rps * self.corner_m

    @property
    def motion_m(self) -> float:
        """Motion of the corner on the paper during the exposure, at most."""
        return self.exposure_s * self.corner_speed_mps


def _require(
    item: object,
    low: float,
    high: float,
    *names: str,
    unit: str = "",
    scale: float = 1.0,
) -> None:
    """Raise InputError unless the attributes are above ``low`` and at most ``high``."""
    for name in names:
        value = getattr(item, name)
        if not low < value <= high:
            shown = f"{value * scale:g} {unit}".strip()
            limits = f"above {low * scale:g}, at most {high * scale:g} {unit}".strip()
            quantity = name
            for ending in ("_m", "_s", "_lx", "_hz"):
                quantity = quantity.removesuffix(ending)
            raise InputError(f"{quantity.replace('_', ' ')} is {shown}", hint=f"Give {limits}")
