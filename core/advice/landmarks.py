"""Advice on four-bar magnetic landmarks for a task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from locatk.core.advice.answer import Check, Power, SystemAdvice
from locatk.core.advice.checks import (
    MIN_COVERAGE,
    condition_check,
    disturbance_t,
    limit_check,
    magnetic_checks,
    uniform_map,
)
from locatk.core.advice.task import Task
from locatk.core.advice.work import work_steps
from locatk.core.landmarks.design.analysis import analyse_landmark
from locatk.core.landmarks.design.bounds import max_square_side
from locatk.core.landmarks.design.materials import bill_of_materials
from locatk.core.landmarks.design.routes import FloorForecast, forecast_floor
from locatk.core.landmarks.design.visit_accuracy import VisitErrors
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.materials import BillItem
from locatk.core.polygons import is_inside

SMALLEST_PITCH_M, LARGEST_PITCH_M = 0.2, 1.0
"""Range of the distance between landmarks that is searched [m]: that of the paper's floor, and one
at which a robot that leaves a landmark rarely meets the next."""

PITCH_STEP_M = 0.05
"""Resolution of the pitch [m]."""

FORECAST_ROUTES = 8
"""Number of drives over the floor from which its accuracy is forecast."""

MIN_SENSOR_HEIGHT_M = 2e-3
"""Smallest distance of the sensors from the bars [m]."""

WINDOWS = ("L", "2x2", "3x3")
"""Windows from the one with the fewest landmarks to the one for the largest floors."""

LATENCY_S = 0.07
"""Time from leaving a landmark to its pose, 99 % (`locatk bench live`)."""

HALL_POWER_W = 4 * 6e-3 * 3.3
"""Four linear hall sensors of 6 mA at 3.3 V (Texas Instruments DRV5055, SBAS640B, typical)."""

ALPHABET = "16"


def advise(task: Task, minutes: Mapping[str, float]) -> SystemAdvice:
    """Design a floor of landmarks for a task."""
    is_milled = "mill" in task.floor_work
    geometry = _geometry(task, is_milled)
    pitch_m, forecast = _choose_pitch(task, geometry)
    floor = _floor(task, geometry, pitch_m)
    landmarks = len(floor.cells())
    rows, columns = floor.codes.shape
    window, largest = _window(max(rows, columns))
    checks = [
        limit_check(
            "position",
            "m",
            forecast.position_p95_m,
            task.position_m,
            "computed",
            "forecast of straight drives over the floor (Fisher information, odometry)",
            f"At a landmark it is {1e3 * forecast.position_at_p95_m:.2g} mm; between them, better "
            "odometry is needed. The floor as built (`locatk calibrate map`) is more accurate",
        ),
        limit_check(
            "heading",
            "rad",
            forecast.heading_p95_rad,
            task.heading_rad,
            "computed",
            "same forecast",
            "Odometry with less drift",
        ),
        limit_check(
            "coverage",
            "fraction",
            1.0 if math.isfinite(forecast.position_p95_m) and task.has_odometry else 0.0,
            MIN_COVERAGE,
            "computed",
            "after the landmarks of one window; before, the pose is unknown",
            "Robots with odometry",
            better="higher",
        ),
        condition_check(
            "odometry",
            task.has_odometry,
            "needed between landmarks and to tell them apart",
            "landmark paper, section 2",
            "Wheels with encoders",
        ),
        condition_check(
            "floor",
            _is_floor_allowed(task),
            _floor_text(task, geometry, is_milled),
            "height of the bars and the clearance of the robots",
            f"Milled pockets, or a clearance of at least "
            f"{1e3 * (geometry.bar_height_m + MIN_SENSOR_HEIGHT_M):.2g} mm over glued bars",
            "computed",
        ),
        limit_check(
            "landmarks along a side",
            "",
            max(rows, columns),
            largest,
            "computed",
            f"readings of window {window} that can be different",
            "A larger pitch, or several maps",
        ),
        limit_check(
            "latency",
            "s",
            LATENCY_S,
            task.latency_s,
            "measured",
            "`locatk bench live`, 99 %, after leaving a landmark; poses by odometry at once",
        ),
        *magnetic_checks(task, "bars"),
        *_outdoor_check(task),
    ]
    return SystemAdvice(
        "landmarks",
        f"{landmarks} landmarks of four bars, {1e3 * pitch_m:.0f} mm apart, {rows} x {columns}, "
        f"window {window}",
        tuple(checks),
        infrastructure=bill_of_materials(floor),
        robot_parts=(
            BillItem("hall sensor", 4 * task.robots, "linear, range 85 mT or more; 4 per robot"),
            BillItem("microcontroller", task.robots, "4 analogue inputs at 200 Hz; odometry"),
        ),
        work=work_steps(
            {
                "mark a landmark": landmarks,
                "mill a pocket": 4 * landmarks if is_milled else 0,
                "lay a bar magnet": 4 * landmarks,
                "equip a robot": task.robots,
                "calibrate and check": 1,
            },
            minutes,
        ),
        power=(Power("always", HALL_POWER_W, "four DRV5055 at 3.3 V, data sheet SBAS640B"),),
        maintenance=(
            "Check the bars after heavy traffic: `locatk calibrate map` finds missing and turned "
            "bars from drives.",
        ),
        risks=(
            "A bar with the wrong pole up makes a landmark another one; `locatk map check` and "
            "the survey find it.",
            "Steel tools and swarf stick to bars that are not covered.",
        ),
        paper=(
            "Position below 1 mm and heading within 1.5 degrees after the robot has stopped at a "
            "landmark (section 5.2.3); no recording is published.",
        ),
        commands=(
            f"locatk map design {rows}x{columns} --window {window} --pitch {1e3 * pitch_m:.0f} "
            "-o map.toml",
            "locatk print landmarks map.toml -o floor.pdf",
            "locatk simulate landmarks map.toml -o drive.mcap --landmarks 12",
            "locatk solve drive.mcap -o solved.mcap",
            "locatk eval solved.mcap --truth drive.mcap",
        ),
        accuracy_map=uniform_map(task, forecast.position_p95_m, floor_points(floor), "landmarks"),
    )


def _geometry(task: Task, is_milled: bool) -> Geometry:
    """Return the default bars, in pockets flush with the floor or glued onto it."""
    geometry = Geometry()
    height_m = task.clearance_m - (0.0 if is_milled else geometry.bar_height_m)
    return replace(geometry, sensor_height_m=max(height_m, MIN_SENSOR_HEIGHT_M))


def _is_floor_allowed(task: Task) -> bool:
    is_high_enough = task.clearance_m >= Geometry().bar_height_m + MIN_SENSOR_HEIGHT_M
    return "mill" in task.floor_work or ("glue" in task.floor_work and is_high_enough)


def _floor_text(task: Task, geometry: Geometry, is_milled: bool) -> str:
    if is_milled:
        return "bars in milled pockets, flush with the floor"
    if "glue" not in task.floor_work:
        return "bars must be glued onto the floor or laid in pockets"
    return (
        f"bars of {1e3 * geometry.bar_height_m:g} mm glued on, under robots with "
        f"{1e3 * task.clearance_m:g} mm clearance"
    )


def _choose_pitch(task: Task, geometry: Geometry) -> tuple[float, FloorForecast]:
    """Return the largest pitch of the wanted accuracy, or the smallest, and its forecast."""
    smallest_m = max(SMALLEST_PITCH_M, analyse_landmark(geometry).min_pitch_m)
    if math.isnan(smallest_m):
        smallest_m = SMALLEST_PITCH_M
    low = math.ceil(smallest_m / PITCH_STEP_M - 1e-9)
    high = max(low, math.floor(LARGEST_PITCH_M / PITCH_STEP_M + 1e-9))
    errors = VisitErrors(disturbance_t=disturbance_t(task))

    def forecast(steps: int) -> FloorForecast:
        return forecast_floor(
            geometry,
            steps * PITCH_STEP_M,
            errors=errors,
            speed_mps=task.speed_mps,
            routes=FORECAST_ROUTES,
        )

    best = forecast(low)
    if not best.is_within(task.position_m, task.heading_rad):
        return low * PITCH_STEP_M, best
    while low < high:
        middle = (low + high + 1) // 2
        result = forecast(middle)
        if result.is_within(task.position_m, task.heading_rad):
            low, best = middle, result
        else:
            high = middle - 1
    return low * PITCH_STEP_M, best


def _floor(task: Task, geometry: Geometry, pitch_m: float) -> FloorMap:
    """Return a floor with a landmark at each cell inside the area; its codes are not designed."""
    length_m, width_m = np.ptp(task.corners_m, axis=0).tolist()
    columns, rows = (max(1, math.floor(side / pitch_m + 1e-9) + 1) for side in (length_m, width_m))
    origin = task.corners_m.min(axis=0) + [
        (length_m - (columns - 1) * pitch_m) / 2,
        (width_m - (rows - 1) * pitch_m) / 2,
    ]
    codes = np.zeros((rows, columns), np.int64)
    row, column = np.indices(codes.shape)
    position = np.column_stack([column.ravel(), row.ravel()]) * pitch_m + origin
    is_in_area = is_inside(_grown(task.corners_m), position).reshape(codes.shape)
    codes[~is_in_area] = HOLE_CODE
    return FloorMap(
        codes, pitch_m=pitch_m, geometry=geometry, origin_m=(float(origin[0]), float(origin[1]))
    )


def _grown(corners: np.ndarray) -> np.ndarray:
    """Return corners moved outwards by a micrometre: points on the edge are inside."""
    middle = corners.mean(axis=0)
    return np.asarray(corners + 1e-6 * np.sign(corners - middle))


def floor_points(floor: FloorMap) -> np.ndarray:
    """Return the positions (n, 2) of the landmarks of a floor in metres."""
    cells = np.array(floor.cells(), float).reshape(-1, 2)
    return np.asarray(cells[:, ::-1] * floor.pitch_m + floor.origin_m)


def _window(side: int) -> tuple[str, int]:
    """Return the smallest window for a square floor of this side, and its largest side."""
    for window in WINDOWS:
        largest = max_square_side(ALPHABET, window)
        if side <= largest:
            break
    return window, largest


def _outdoor_check(task: Task) -> list[Check]:
    if not task.is_outdoor:
        return []
    return [
        condition_check(
            "indoors",
            True,
            "magnets do not mind weather and light; ferrite does not corrode",
            "material",
            certainty="assumed",
        )
    ]
