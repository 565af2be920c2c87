"""Advice on a printed micro-dot pattern for a task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from locatk.core.advice.answer import Check, Power, SystemAdvice
from locatk.core.advice.checks import condition_check, driving_check, limit_check, uniform_map
from locatk.core.advice.task import Task
from locatk.core.advice.work import work_steps
from locatk.core.dots.design.camera import PRINT_SIGMA_M, CameraReport, compare_sensors
from locatk.core.dots.design.camera_sensors import SENSORS
from locatk.core.error_quantiles import error_quantile
from locatk.core.hand_placement import EDGE_SIGMA_M, LAYING_SIGMA_M
from locatk.core.materials import BillItem
from locatk.core.paper_sizes import PAPER_SIZES_MM
from locatk.core.polygons import is_inside

PAPER_NAME = "A0"
"""Paper of large floors."""

MIN_READ_RATE = 0.95
"""Fraction of the frames that must be decoded."""

MOVING_POWER_W, RESTING_POWER_W = 0.873, 0.352
"""Power of camera, LEDs and microcontroller, moving and at rest (Hostettler et al., ICRA 2016,
section IV.A)."""


def advise(task: Task, minutes: Mapping[str, float]) -> SystemAdvice:
    """Design sheets over the area of a task, and a camera for them."""
    camera = compare_sensors(SENSORS, speed_mps=task.speed_mps, wanted_rate_hz=task.rate_hz)[
        0
    ].report
    setup = camera.setup
    sheets = _sheet_centres(task)
    count = len(sheets)
    position_m, heading_rad = _errors(camera, count > 1)
    calibrated_m, _ = _errors(camera, False)
    checks = [
        limit_check(
            "position",
            "m",
            position_m,
            task.position_m,
            "computed",
            "frame, print" + (", and sheets laid by hand" if count > 1 else ""),
            "Sheets that were measured as laid (`locatk calibrate sheet`): "
            f"{1e3 * calibrated_m:.2g} mm and less",
        ),
        limit_check(
            "heading",
            "rad",
            heading_rad,
            task.heading_rad,
            "computed",
            "frame" + (", and edges of sheets laid by hand" if count > 1 else ""),
            "Sheets that were measured as laid (`locatk calibrate sheet`)",
        ),
        limit_check(
            "coverage",
            "fraction",
            1.0,
            0.95,
            "computed",
            "sheets cover the whole area",
            better="higher",
        ),
        limit_check(
            "frames that are decoded",
            "fraction",
            camera.read_rate,
            MIN_READ_RATE,
            "computed",
            "model of the decoder",
            "; ".join(camera.warnings),
            better="higher",
        ),
        limit_check(
            "speed",
            "m/s",
            camera.max_speed_mps,
            task.speed_mps,
            "computed",
            "motion blur of the chosen exposure",
            "A shorter exposure and stronger LEDs (`locatk camera design`)",
            better="higher",
        ),
        limit_check(
            "rate",
            "Hz",
            camera.pose_rate_hz,
            task.rate_hz,
            "computed",
            "frame rate and read rate",
            "A faster sensor (`locatk camera design`)",
            better="higher",
        ),
        limit_check(
            "latency",
            "s",
            camera.latency_s,
            task.latency_s,
            "computed",
            "exposure, frame and decoding on a PC",
            "A faster sensor",
        ),
        condition_check(
            "floor",
            "print" in task.floor_work,
            "the floor is covered with printed sheets",
            "Hostettler et al., ICRA 2016",
            "A floor that may be covered",
        ),
        *_surroundings(task),
    ]
    x_mm, y_mm = PAPER_SIZES_MM[PAPER_NAME]
    return SystemAdvice(
        "dots",
        f"{count} sheets of {PAPER_NAME}, {setup.sensor.name} with a lens of "
        f"{1e3 * setup.lens.focal_m:g} mm, {1e3 * setup.distance_m:.0f} mm above them",
        tuple(checks),
        infrastructure=(
            BillItem(
                "printed sheet",
                count,
                f"{PAPER_NAME}, {x_mm:.0f} x {y_mm:.0f} mm, laser or plotter of 600 dpi, matt",
            ),
            BillItem("adhesive", 1, f"double-sided, for {task.area_m2:.3g} m2; or a laminate"),
        ),
        robot_parts=tuple(
            replace(item, count=item.count * task.robots)
            for item in (
                *camera.materials,
                BillItem("computer", 1, "decodes the frames of one camera; 3 ms per frame on a PC"),
            )
        ),
        work=work_steps(
            {
                "print a sheet": count,
                "lay a sheet": count,
                "equip a robot": task.robots,
                "calibrate and check": 1,
            },
            minutes,
        ),
        power=(
            Power("moving", MOVING_POWER_W, POWER_SOURCE),
            Power("at rest", RESTING_POWER_W, POWER_SOURCE),
        ),
        maintenance=(
            "Replace sheets that are worn or torn; a printed replacement has the same positions.",
            "Clean the floor: dirt hides dots (10 % missing dots are decoded).",
        ),
        risks=(
            "Printers stretch: measure the rulers of each sheet, or `locatk calibrate printer`.",
            "Glossy laminate reflects the LEDs; test one sheet.",
        ),
        paper=(
            "Largest errors on an uncalibrated laser print of 200 mm: 0.155 and 0.273 mm, 1.58 "
            "degrees (Table III).",
            "A battery of 600 mAh lasts for more than 2.5 hours (section IV.B).",
        ),
        commands=(
            f"locatk camera design --sensor {setup.sensor.name} --speed {task.speed_mps:g} "
            f"--rate {task.rate_hz:g}",
            f"locatk print pattern -o sheets.pdf --size {PAPER_NAME} --count {count}",
            "locatk simulate dots -o drive.mcap --sheet sheets.toml --duration 10",
            "locatk solve drive.mcap -o solved.mcap",
            "locatk eval solved.mcap --truth drive.mcap",
        ),
        accuracy_map=uniform_map(task, position_m, sheets, "sheets"),
    )


POWER_SOURCE = "Hostettler et al., ICRA 2016, section IV.A, with the microcontroller"


def _errors(camera: CameraReport, is_laid: bool) -> tuple[float, float]:
    """Return the errors of position [m] and heading [rad] that 95 % of the poses do not exceed."""
    variance = camera.position_sigma_m**2 + PRINT_SIGMA_M**2
    heading = camera.heading_sigma_rad**2
    if is_laid:
        variance += LAYING_SIGMA_M**2
        heading += 2 * (EDGE_SIGMA_M / (1e-3 * max(PAPER_SIZES_MM[PAPER_NAME]))) ** 2
    position_m = error_quantile(np.array([np.diag([variance, variance])]))
    return position_m, error_quantile(np.array([[[heading]]]))


def _sheet_centres(task: Task) -> np.ndarray:
    """Return the centres (n, 2) of the sheets that cover the area, in the better direction."""
    low = task.corners_m.min(axis=0)
    sides = np.ptp(task.corners_m, axis=0)
    layouts = []
    for size in (PAPER_SIZES_MM[PAPER_NAME], PAPER_SIZES_MM[PAPER_NAME][::-1]):
        paper = 1e-3 * np.array(size)
        columns, rows = (max(1, math.ceil(n - 1e-9)) for n in (sides / paper).tolist())
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        layouts.append(low + (grid + 0.5) * paper)
        layouts[-1] = layouts[-1][_touches(task.corners_m, layouts[-1], paper)]
    return min(layouts, key=len)


def _touches(corners: np.ndarray, centres: np.ndarray, paper: np.ndarray) -> np.ndarray:
    """Return True for the sheets of which one of 25 points is inside the area."""
    offsets = np.stack(np.meshgrid(*[np.linspace(-0.49, 0.49, 5)] * 2), axis=-1).reshape(-1, 2)
    points = centres[:, None] + offsets * paper
    return np.asarray(
        is_inside(corners, points.reshape(-1, 2)).reshape(len(centres), -1).any(axis=1)
    )


def _surroundings(task: Task) -> list[Check]:
    checks = []
    if task.is_outdoor:
        checks.append(
            condition_check(
                "indoors",
                False,
                "printed paper does not last outdoors",
                "material",
                "Milled or etched metal plates, which locatk does not draw",
                "assumed",
            )
        )
    if task.is_flying:
        checks.append(driving_check("dots"))
    return checks
