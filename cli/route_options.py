"""Options of forecasts along routes: waypoints, odometry, and accuracies."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

from locatk.core.units import length_text, metres

if TYPE_CHECKING:
    from locatk.core.streaming.planar_filter import OdometryNoise

MAX_ACCURACY_MM = 1e5
"""Largest length of an accuracy; a larger one is in another unit."""


class LengthAndAngle(click.ParamType):
    """Length in mm and, optionally, angle in degrees, as in ``20`` or ``20,1.5``."""

    name = "MM[,DEG]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float | None]:
        """Parse the text to m and rad; fail with the expected form."""
        if isinstance(value, tuple):
            return value
        try:
            length, *angle = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not MM or MM,DEG as in 20,1.5.", param, ctx)
        numbers = [length, *angle]
        if len(angle) > 1 or not all(number > 0 and math.isfinite(number) for number in numbers):
            self.fail(
                f"{value!r} is not one or two numbers above 0, in mm and degrees.", param, ctx
            )
        if length > MAX_ACCURACY_MM or any(number > 180 for number in angle):
            self.fail(f"{value!r} is not within 100000 mm and 180 degrees.", param, ctx)
        return metres(length), math.radians(angle[0]) if angle else None


drift_option = click.option(
    "--drift",
    type=click.FloatRange(0, 90),
    metavar="DEG/M",
    help="Drift of the heading of the odometry (standard deviation).  [default: 2.9]",
)

slip_option = click.option(
    "--slip",
    type=click.FloatRange(0, 50),
    metavar="PERCENT",
    help="Error of distances by odometry (standard deviation).  [default: 1.5]",
)


def accuracy_text(position_m: float, heading_rad: float | None) -> str:
    """Format an accuracy; a heading that is None or infinite is left out.

    >>> accuracy_text(0.02, 0.0349), accuracy_text(0.02, None)
    ('20 mm and 2 deg', '20 mm')
    """
    text = length_text(position_m)
    if heading_rad is None or not math.isfinite(heading_rad):
        return text
    return f"{text} and {math.degrees(heading_rad):.2g} deg"


def odometry_noise(drift: float | None, slip: float | None) -> OdometryNoise:
    """Return the errors of odometry of the options."""
    from dataclasses import replace

    from locatk.core.streaming.planar_filter import OdometryNoise

    noise = OdometryNoise()
    if drift is not None:
        noise = replace(noise, drift_rad_per_m=math.radians(drift))
    if slip is not None:
        noise = replace(noise, scale=slip / 100)
    return noise
