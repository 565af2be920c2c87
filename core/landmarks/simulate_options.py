"""What is simulated, and within which bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from locatk.core.landmarks.floor import Cell
from locatk.core.simulation import check_options

PASS_M = 0.23
"""Way of one pass in facts/landmarks.md 3, on which the heading drifts by one degree."""


@dataclass(frozen=True)
class Errors:
    """How large errors are: standard deviations, unless said otherwise.

    The defaults are the nominal ones of facts/landmarks.md 3, which has none of the wheels'
    turn, noise and slip, nor of how landmarks are placed.

    Attributes
    ----------
    noise_t : float
        Of a sample.
    offset_t, gain : float
        Of each sensor; the gain as a share.
    earth_t : float
        Upright part of the Earth's field, positive upward; itself and the same everywhere.
    quantum_t : float
        Least step of a reading; 0 for none.
    height_m : float
        By how much all sensors are too high; no standard deviation.
    bar_strength : float
        Of each bar, as a share.
    bar_place_m, bar_turn_rad, bar_lean_rad : float
        Of each bar: along both axes of the floor, about the upright, and about the two
        level axes.
    landmark_place_m, landmark_turn_rad : float
        Of each landmark as a whole, along both axes and about the upright.
    odometry_scale, odometry_turn : float
        By which share it tells too long a way, and too much of a turn, for a whole session.
    odometry_drift_rad_per_m : float
        By how much its heading turns away on a metre, for a whole session.
    wheel_noise_m : float
        Of the way of each wheel on a metre, as a random walk.
    slips_per_m, slip_m : float
        How often a wheel slips, and how far it turns too much then; no standard deviations.
    """

    noise_t: float = 0.15e-3
    offset_t: float = 0.1e-3
    gain: float = 0.03
    earth_t: float = -45e-6
    quantum_t: float = 0.0
    height_m: float = 0.0
    bar_strength: float = 0.04
    bar_place_m: float = 0.5e-3
    bar_turn_rad: float = 0.0
    bar_lean_rad: float = 0.0
    landmark_place_m: float = 1e-3
    landmark_turn_rad: float = math.radians(0.5)
    odometry_scale: float = 0.01
    odometry_turn: float = 0.01
    odometry_drift_rad_per_m: float = math.radians(1) / PASS_M
    wheel_noise_m: float = 0.2e-3
    slips_per_m: float = 0.0
    slip_m: float = 0.005

    def __post_init__(self) -> None:
        signed = ("earth_t", "height_m")
        check_options(
            self,
            (
                (
                    item.name,
                    math.isfinite(value := getattr(self, item.name))
                    and (item.name in signed or value >= 0),
                    "a number" if item.name in signed else "0 or more",
                )
                for item in fields(self)
            ),
        )

    def scaled(self, factor: float) -> Errors:
        """All errors ``factor`` times as large, but for the Earth's field."""
        return replace(
            self,
            **{
                item.name: factor * getattr(self, item.name)
                for item in fields(self)
                if item.name != "earth_t"
            },
        )


NONE = Errors(**{item.name: 0.0 for item in fields(Errors)})
"""No errors at all, and no Earth."""


@dataclass(frozen=True)
class Faults:
    """What is broken or wrong, beyond errors.

    Attributes
    ----------
    flipped, missing : tuple of (cell, bar)
        Bars that lie the wrong way round, and that do not lie there.
    displaced : tuple of (cell, (dx, dy))
        Landmarks that lie elsewhere, in metres of the map's frame.
    misread_rate : float
        Chance of a landmark to be laid as another one of the alphabet.
    dead, stuck : tuple of str
        Sensors that give nothing, and that give their offset for ever.
    swapped : tuple of (name, name)
        Sensors whose wires were exchanged.
    """

    flipped: tuple[tuple[Cell, int], ...] = ()
    missing: tuple[tuple[Cell, int], ...] = ()
    displaced: tuple[tuple[Cell, tuple[float, float]], ...] = ()
    misread_rate: float = 0.0
    dead: tuple[str, ...] = ()
    stuck: tuple[str, ...] = ()
    swapped: tuple[tuple[str, str], ...] = ()
