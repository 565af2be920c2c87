"""Search for bars and sensor heights with which a floor has a wanted accuracy.

The landmark paper leaves bars and heights open. Bars of common sizes are tried at several heights:
territories must not overlap at the pitch, the field of a neighbour must be small, and the forecast
of straight drives (:func:`.routes.forecast_floor`) must be as accurate as wanted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.landmarks.design.analysis import LandmarkAnalysis, analyse_landmark
from locatk.core.landmarks.design.routes import FloorForecast, forecast_floor
from locatk.core.landmarks.design.visit_accuracy import VisitErrors
from locatk.core.landmarks.landmark import Geometry
from locatk.core.streaming.planar_filter import OdometryNoise
from locatk.core.units import length_text

BARS_M = (
    (12.7e-3, 3.2e-3, 3.2e-3),
    (20e-3, 5e-3, 5e-3),
    (25e-3, 5e-3, 5e-3),
    (25.4e-3, 6.35e-3, 6.35e-3),
    (30e-3, 5e-3, 5e-3),
    (30e-3, 10e-3, 5e-3),
    (40e-3, 10e-3, 5e-3),
    (50.8e-3, 12.7e-3, 12.7e-3),
)
"""Length, width and height [m] of the bars that are tried.

Neodymium bars magnetised along their length are sold from 12.7 x 3.2 x 3.2 mm to 50.8 x 25.4 x
25.4 mm (apexmagnets.com, "4 uses for bar magnets"). Ask for this direction: most blocks are
magnetised through their thickness."""

HEIGHTS_M = (4e-3, 8e-3, 12e-3, 16e-3, 20e-3)
"""Heights of the sensors over the bars that are tried [m]."""

SEARCH_ROUTES = 6
"""Drives of a forecast: half of the default accuracy suffices for a choice."""

DEFAULT_RADIUS_M = 0.025
"""Distance of the bars from the centre, if they are not too long for it."""

THRESHOLD_PER_VOLUME = 2.75e-3 / (30e-3 * 10e-3 * 5e-3)
"""Threshold per remanence and volume of a bar [1/m^3]: that of the default bars. The far field is
proportional to the volume, so that all territories are about as large."""


@dataclass(frozen=True)
class BarOption:
    """Bars that were tried.

    Attributes
    ----------
    analysis : LandmarkAnalysis
        At the height with the most accurate forecast.
    forecast : FloorForecast
        At this height.
    heights_m : tuple of float
        Heights of those tried at which the floor is as accurate as wanted.
    reason : str
        Reason for which no height suffices, or "".
    """

    analysis: LandmarkAnalysis
    forecast: FloorForecast
    heights_m: tuple[float, ...]
    reason: str

    @property
    def is_feasible(self) -> bool:
        """True if the bars suffice at any height."""
        return bool(self.heights_m)


def search_bars(
    pitch_m: float,
    wanted_position_m: float,
    wanted_heading_rad: float | None = None,
    *,
    remanence_t: float = 1.2,
    circle_m: float = 0.025,
    bars_m: Iterable[tuple[float, float, float]] = BARS_M,
    heights_m: Sequence[float] = HEIGHTS_M,
    noise: OdometryNoise | None = None,
    errors: VisitErrors | None = None,
    speed_mps: float = 0.1,
    progress: Callable[[], None] = lambda: None,
) -> tuple[BarOption, ...]:
    """Try bars at several heights.

    Parameters
    ----------
    pitch_m : float
    wanted_position_m, wanted_heading_rad : float
        Errors that are not to be exceeded in 95 % of the cases, anywhere on the floor (live).
    remanence_t, circle_m : float
        Of all bars, and of the circle of sensors.
    bars_m : iterable of (length, width, height)
    heights_m : sequence of float
        Of the sensors.
    noise, errors, speed_mps
        See :func:`.routes.forecast_floor`.
    progress : function
        Called after each of the bars.

    Returns
    -------
    tuple of BarOption
        One for each of the bars, feasible ones first, then as given.

    Raises
    ------
    InputError
        A number is not positive, or even the smallest bars of neighbouring landmarks overlap.
    """
    if not (pitch_m > 0 and wanted_position_m > 0):
        raise InputError("a pitch or an accuracy of 0 or less", hint="Give numbers above 0")
    bars_m = tuple(bars_m)
    least_m = min((2 * _radius_m(length, width) + width for length, width, _ in bars_m), default=0)
    if pitch_m < least_m - 1e-9:
        raise InputError(
            f"bars of neighbouring landmarks overlap at a pitch of {length_text(pitch_m)}",
            hint=f"Give at least {length_text(least_m)}",
        )
    options = []
    for length, width, thickness in bars_m:
        tried = []
        for height_m in heights_m:
            geometry = Geometry(
                bar_length_m=length,
                bar_width_m=width,
                bar_height_m=thickness,
                remanence_t=remanence_t,
                radius_m=_radius_m(length, width),
                sensor_height_m=height_m,
                circle_m=circle_m,
                threshold_t=THRESHOLD_PER_VOLUME * remanence_t * length * width * thickness,
            )
            forecast = forecast_floor(
                geometry,
                pitch_m,
                noise,
                errors=errors,
                speed_mps=speed_mps,
                routes=SEARCH_ROUTES,
            )
            tried.append((analyse_landmark(geometry), forecast))
        options.append(_option_of(tried, pitch_m, wanted_position_m, wanted_heading_rad))
        progress()
    return tuple(sorted(options, key=lambda option: not option.is_feasible))


def _radius_m(length_m: float, width_m: float) -> float:
    """Return the radius at which the ends of neighbouring bars do not touch at the corners."""
    return max(DEFAULT_RADIUS_M, (length_m + width_m) / 2)


def _option_of(
    tried: Sequence[tuple[LandmarkAnalysis, FloorForecast]],
    pitch_m: float,
    wanted_position_m: float,
    wanted_heading_rad: float | None,
) -> BarOption:
    """Return the best height of some bars, and the reason if none suffices."""
    separate = [each for each in tried if each[0].min_pitch_m <= pitch_m]
    good = [each for each in separate if each[1].is_within(wanted_position_m, wanted_heading_rad)]
    analysis, forecast = min(good or separate or tried, key=lambda each: each[1].position_p95_m)
    if good:
        reason = ""
    elif not separate:
        reason = f"needs a pitch of {length_text(analysis.min_pitch_m)}"
    elif math.isinf(forecast.position_p95_m):
        reason = "too weak"
    else:
        reason = "not accurate enough"
    heights_m = tuple(each[0].geometry.sensor_height_m for each in good)
    return BarOption(analysis, forecast, heights_m, reason)
