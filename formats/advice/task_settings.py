"""Settings of a task: keys of ``task.toml`` and options of ``locatk advise``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.advice.task import FLOOR_WORK, INFRARED, IRON, Task
from locatk.core.errors import InputError
from locatk.core.polygons import rectangle
from locatk.core.routes import Route
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    NO_UNIT,
    POSITIVE,
    Boolean,
    FilePath,
    Integer,
    InvalidValueError,
    ListOf,
    Row,
    Text,
    Unit,
)
from locatk.formats.importers.floors.site_csv import read_route
from locatk.formats.settings.config import SettingsConfig, with_values
from locatk.formats.settings.setting import Setting

UNTOUCHED = "none"
"""Work on a floor that must not be touched."""


@dataclass(frozen=True)
class Rectangle:
    """Two sides in metres; on the command line as in ``10x8``."""

    expected = "a list of two sides in m, above 0"
    plural = "lists of two sides in m, above 0"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> tuple[float, float]:
        try:
            first, second = Row(POSITIVE, 2).parse(value)
            return first, second
        except InvalidValueError:
            raise InvalidValueError(f"expected {self.expected}") from None

    def parse_text(self, text: str) -> tuple[float, float]:
        match = re.fullmatch(r"\s*([\d.]+)\s*[x*,]\s*([\d.]+)\s*m?\s*", text)
        if match is None:
            raise ValueError(f"expected {self.expected}")
        first, second = (POSITIVE.parse_text(part) for part in match.groups())
        return first, second

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> list[float]:
        return [float(side) for side in value]


CONFIG = SettingsConfig(
    "advise",
    (
        Setting(
            "area.size_m",
            Rectangle(),
            "Sides of the area in which robots are localized",
            "size_m",
            "--area",
            metavar="LxW",
            default_text="5x5",
        ),
        Setting(
            "area.outline_m",
            ListOf(Row(ANY_NUMBER, 2)),
            "Corners of an area that is no rectangle, in order",
            "outline_m",
            default=None,
            default_text="the rectangle",
            example=[(0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (0.0, 5.0)],
        ),
        Setting("area.height_m", POSITIVE, "Height of the ceiling in m", "height_m", "--height"),
        Setting(
            "area.ceiling",
            Boolean(),
            "Stations may be mounted on the ceiling and high on the walls; otherwise they are on "
            "tripods",
            "may_use_ceiling",
            "--ceiling/--no-ceiling",
        ),
        Setting(
            "area.outdoor", Boolean(), "The area is outdoors", "is_outdoor", "--outdoor/--indoor"
        ),
        Setting(
            "area.infrared",
            Text(INFRARED),
            "Infrared light: none (lamps), windows (daylight), sun (direct)",
            "infrared",
            "--infrared",
        ),
        Setting(
            "area.iron",
            Text(IRON),
            "Iron in the floor: none, reinforced (concrete), plates (or rails)",
            "iron",
            "--iron",
        ),
        Setting(
            "area.motors",
            Boolean(),
            "Strong motors or machines are within half a metre of the sensors",
            "has_motors",
            "--motors/--no-motors",
        ),
        Setting(
            "area.floor",
            ListOf(Text((*FLOOR_WORK, UNTOUCHED))),
            "What may be done to the floor: print (lay printed sheets), glue (tags), mill "
            "(pockets), none",
            flag="--floor",
            default=("print", "glue"),
            default_text="print and glue",
        ),
        Setting(
            "area.routes",
            ListOf(FilePath()),
            "Table (.csv) of the waypoints of a route, with columns x and y",
            flag="--route",
            default=None,
            default_text="robots drive anywhere",
            example=["aisle.csv"],
        ),
        Setting("robots.count", Integer(1), "Number of robots", "robots", "--robots"),
        Setting("robots.speed_mps", POSITIVE, "Speed", "speed_mps", "--speed"),
        Setting("robots.flying", Boolean(), "Robots fly", "is_flying", "--flying/--driving"),
        Setting("robots.diameter_mm", POSITIVE, "Size of a robot", "diameter_m", "--diameter"),
        Setting(
            "robots.clearance_mm",
            POSITIVE,
            "Height of the sensors below a robot above the floor",
            "clearance_m",
            "--clearance",
        ),
        Setting(
            "robots.odometry",
            Boolean(),
            "Robots measure their motion (wheels)",
            "has_odometry",
            "--odometry/--no-odometry",
        ),
        Setting(
            "robots.battery_wh",
            POSITIVE,
            "Energy of the battery",
            "battery_wh",
            default=None,
            default_text="unknown",
            example=7.4,
        ),
        Setting(
            "wanted.position_mm",
            POSITIVE,
            "Position error that 95 % of the poses may have",
            "position_m",
            "--accuracy",
        ),
        Setting(
            "wanted.heading_deg",
            POSITIVE,
            "Heading error that 95 % of the poses may have",
            "heading_rad",
            "--heading",
            default=None,
            default_text="no heading is needed",
            example=2.0,
        ),
        Setting("wanted.rate_hz", POSITIVE, "Poses per second", "rate_hz", "--rate"),
        Setting(
            "wanted.latency_ms",
            POSITIVE,
            "Largest age of a pose",
            "latency_s",
            "--latency",
            default=None,
            default_text="any",
            example=50.0,
        ),
        Setting(
            "limits.power_mw",
            POSITIVE,
            "Power of a robot for its localization",
            "power_w",
            "--power",
            default=None,
            default_text="any",
            example=100.0,
        ),
        Setting(
            "limits.budget",
            POSITIVE,
            "Money for infrastructure and sensors",
            "budget",
            "--budget",
            default=None,
            default_text="any",
            example=1000.0,
            metavar="AMOUNT",
        ),
        Setting(
            "limits.currency",
            Text(is_blank_allowed=False),
            "Currency of the budget (ISO 4217); prices in others are not compared with it",
            "currency",
            "--currency",
            metavar="CODE",
        ),
        Setting(
            "limits.hours",
            POSITIVE,
            "Working hours for the installation",
            "hours",
            "--hours",
            default=None,
            default_text="any",
            example=8.0,
            metavar="HOURS",
        ),
    ),
    Task(),
    conflicts=((("area.size_m",), ("area.outline_m",)),),
    command="locatk advise --task FILE",
    format="locatk-task",
)
"""Settings of a task, as a file and as options."""


def task_of(settings: Mapping[str, Any]) -> Task:
    """Return the task of merged settings; tables of routes are read.

    Raises
    ------
    InputError
        A value is impossible.
    MissingDataError, FormatError
        A route cannot be read.
    """
    values = CONFIG.in_si(settings)
    routes = tuple(read_route(Path(path)) for path in values.pop("area.routes", None) or ())
    if routes and not {"size_m", "outline_m"} & set(values):
        values["outline_m"] = _around(routes, values.get("diameter_m", Task.diameter_m))
    floor = values.pop("area.floor", None)
    if floor is not None:
        if UNTOUCHED in floor and len(floor) > 1:
            raise InputError(
                f"a floor of {' and '.join(floor)}", hint=f"Give {UNTOUCHED} alone, or the others"
            )
        values["floor_work"] = frozenset(floor) - {UNTOUCHED}
    if values.get("outline_m") is not None:
        values["outline_m"] = np.array(values["outline_m"], float)
    task: Task = with_values(Task(), {**values, "routes": routes})
    return task


def _around(routes: Sequence[Route], margin_m: float) -> NDArray[np.float64]:
    """Return the rectangle (4, 2) around routes and the robots on them."""
    waypoints = np.concatenate([route.waypoint_m for route in routes])
    low, high = waypoints.min(axis=0) - margin_m, waypoints.max(axis=0) + margin_m
    length_m, width_m = (high - low).tolist()
    return rectangle(length_m, width_m, (float(low[0]), float(low[1])))
