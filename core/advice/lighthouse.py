"""Advice on Lighthouse V2 base stations for a task."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from locatk.core.advice.answer import AccuracyMap, Check, Power, SystemAdvice
from locatk.core.advice.checks import MIN_COVERAGE, condition_check, limit_check
from locatk.core.advice.task import Task
from locatk.core.advice.work import work_steps
from locatk.core.error_quantiles import error_quantile
from locatk.core.errors import InputError
from locatk.core.lighthouse.design import (
    RoomDesign,
    RoomRequest,
    bill_of_materials,
    design_room,
)
from locatk.core.lighthouse.design.placement import MAX_STATIONS
from locatk.core.lighthouse.design.report import deck_heading_sigma
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.room import RobotSize, Room
from locatk.core.materials import split_bill

Array = NDArray[np.float64]

ROBOT_HEIGHT_M = 0.1
"""Height of the photodiodes of robots on the floor [m]."""

FLIGHT_MARGIN_M = 1.0
"""Distance of flying robots from the ceiling at least [m]."""

TRIPOD_HEIGHT_M, TRIPOD_INSET_M = 2.0, 0.3
"""Height of stations on tripods, and their distance from the corners of the area [m]."""

ROTATION_HZ = 50.0
"""Rotations of a station per second: 48 MHz over 959,000 ticks on channel 1 (Bitcraze,
crazyflie-firmware, pulse_processor_v2.c)."""

ONE_DIMENSIONAL_QUANTILE = error_quantile([[[1.0]]])
"""Ratio of the 95 % quantile of an error to its standard deviation if all of it is along one
direction: the largest of any shape, 1.96; for equal errors along two axes it is 1.73."""

LATENCY_S = 0.015
"""Time from a sweep to its pose with ten robots, 99 % (`locatk bench live`)."""

MARKERS = 4
"""Points on the floor that are measured to fix the frame."""

RECEIVER_POWER_W, DECK_POWER_W = 23.1e-3, 111e-3
"""Power of a microcontroller with one TS4231, and of a receiver with an FPGA and four (Lighthouse
paper, Table IV)."""


def advise(task: Task, minutes: Mapping[str, float]) -> SystemAdvice:
    """Place stations in a room of the size of a task."""
    room = room_of(task)
    photodiodes = 1 if task.heading_rad is None and not task.is_flying else len(DECK)
    request = RoomRequest(stations=None, accuracy_m=task.position_m / ONE_DIMENSIONAL_QUANTILE)
    largest_m2 = MAX_STATIONS * math.pi * request.max_range_m**2 / request.required_stations(room)
    if task.area_m2 > largest_m2:
        raise InputError(
            f"{MAX_STATIONS} stations cover at most {largest_m2:.0f} m2, by their range of "
            f"{request.max_range_m:g} m, and the area is {task.area_m2:.0f} m2",
            hint="Divide the area",
        )
    design = design_room(room, request)
    stations = len(design.scene.stations)
    report = design.report
    items = bill_of_materials(design.mounts, robots=task.robots, photodiodes=photodiodes)
    infrastructure, robot_parts = split_bill(items, ROBOT_PARTS)
    return SystemAdvice(
        "lighthouse",
        f"{stations} station{'s' * (stations > 1)} ("
        + ", ".join(f"{count} {kind}" for kind, count in sorted(design.mounts.items()))
        + f"), {photodiodes} photodiode{'s' * (photodiodes > 1)} on each robot",
        (*_accuracy_checks(task, room, design, request, photodiodes), *_condition_checks(task)),
        infrastructure=infrastructure,
        robot_parts=robot_parts,
        work=work_steps(
            {
                "mount and aim a station": stations,
                "measure a marker": MARKERS,
                "equip a robot": task.robots,
                "calibrate and check": 1,
            },
            minutes,
        ),
        power=(
            Power("one photodiode", RECEIVER_POWER_W, "Lighthouse paper, Table IV")
            if photodiodes == 1
            else Power("receiver with FPGA", DECK_POWER_W, "Lighthouse paper, Table IV"),
        ),
        maintenance=(
            "Do not touch the stations; after a knock, calibrate the scene again "
            "(`locatk calibrate scene`).",
            "The rotors of the stations wear; switch them off when they are not used.",
        ),
        risks=(
            "Mirrors, glass and polished metal reflect sweeps; motion capture systems and sunlight "
            "blind the photodiodes.",
            *(f"{warning[0].upper()}{warning[1:]}." for warning in design.warnings),
        ),
        paper=(
            "Mean error 5.2 mm with two stations on the published grid; locatk reaches 2.1 mm.",
            "Demodulation loads 19 % of a microcontroller (section II.B).",
        ),
        commands=(
            _design_command(task, design),
            f"locatk simulate lighthouse --artifact room.toml --robots {task.robots} -o drive.mcap",
            "locatk solve drive.mcap -o solved.mcap",
            "locatk eval solved.mcap --truth drive.mcap",
        ),
        accuracy_map=AccuracyMap(
            report.points_m[:, :2],
            ONE_DIMENSIONAL_QUANTILE * np.where(report.is_covered, report.sigma_m, math.nan),
            np.array([station.position[:2] for station in design.scene.stations]),
            "stations",
        ),
    )


ROBOT_PARTS = ("photodiode", "front end")


def room_of(task: Task) -> Room:
    """Return the room of a task: the area is the working area, and walls are around it."""
    if task.is_flying:
        photodiode_z_m = (0.0, max(ROBOT_HEIGHT_M, task.height_m - FLIGHT_MARGIN_M))
    else:
        photodiode_z_m = (ROBOT_HEIGHT_M, ROBOT_HEIGHT_M)
    size = None
    if task.robots > 1 and not task.is_flying:
        size = RobotSize(task.robots, task.diameter_m / 2, ROBOT_HEIGHT_M)
    if task.may_use_ceiling:
        return Room(task.corners_m, task.height_m, photodiode_z_m, robots=size)
    return Room(
        task.corners_m,
        max(task.height_m, TRIPOD_HEIGHT_M + TRIPOD_INSET_M),
        photodiode_z_m,
        mounts=("tripod",),
        tripods_m=_tripods(task.corners_m),
        robots=size,
    )


def _tripods(corners: Array) -> Array:
    """Return places for tripods at the corners and in the middle of the sides, inside the area."""
    middle = corners.mean(axis=0)
    edges = np.concatenate([corners, (corners + np.roll(corners, -1, axis=0)) / 2])
    inwards = middle - edges
    inwards *= TRIPOD_INSET_M / np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-9)
    return np.column_stack([edges + inwards, np.full(len(edges), TRIPOD_HEIGHT_M)])


def _accuracy_checks(
    task: Task, room: Room, design: RoomDesign, request: RoomRequest, photodiodes: int
) -> list[Check]:
    report = design.report
    checks = [
        limit_check(
            "position",
            "m",
            ONE_DIMENSIONAL_QUANTILE * report.p95_sigma_m,
            task.position_m,
            "computed",
            "Fisher information of the angles, with calibration errors",
            "; ".join(design.warnings),
        ),
        limit_check(
            "coverage",
            "fraction",
            report.covered_fraction * float(report.availability[report.is_covered].mean())
            if report.covered_fraction
            else 0.0,
            MIN_COVERAGE,
            "computed",
            "field of view, range and robots that hide stations",
            "More stations, or other mounts",
            better="higher",
        ),
    ]
    if photodiodes == 1:
        return checks
    sigma_rad = deck_heading_sigma(design.scene, report, room, request)
    return [
        *checks,
        limit_check(
            "heading",
            "rad",
            ONE_DIMENSIONAL_QUANTILE * sigma_rad,
            task.heading_rad,
            "computed",
            "four photodiodes of Bitcraze's Lighthouse deck, 30 x 15 mm, in one epoch",
            "Photodiodes farther apart; poses of moving robots are averaged over epochs",
        ),
    ]


def _condition_checks(task: Task) -> list[Check]:
    checks = [
        limit_check(
            "rate",
            "Hz",
            ROTATION_HZ,
            task.rate_hz,
            "published",
            "rotations of a station per second",
            "An IMU or odometry between the sweeps",
            better="higher",
        ),
        limit_check(
            "latency",
            "s",
            LATENCY_S,
            task.latency_s,
            "measured",
            "`locatk bench live`, ten robots, 99 %",
        ),
    ]
    if task.is_outdoor:
        checks.append(
            condition_check(
                "indoors",
                False,
                "stations are made for indoors",
                "manufacturer",
                "A room or a tent without sun",
            )
        )
    if task.infrared == "sun":
        checks.append(
            condition_check(
                "light",
                False,
                "direct sun saturates the photodiodes",
                "github.com/cntools/libsurvive, issue 199",
                "Curtains",
            )
        )
    return checks


def _design_command(task: Task, design: RoomDesign) -> str:
    """Return the command that designs the room around the rectangle of the area."""
    x, y = np.ptp(task.corners_m, axis=0).tolist()
    room = design.scene.room
    assert room is not None
    low_mm, high_mm = (1e3 * z for z in room.photodiode_z_m)
    words = [
        f"locatk room design {x:g}x{y:g}x{room.height_m:g}",
        f"--stations {len(design.scene.stations)}",
        f"--floor {low_mm:g}" if room.is_planar else f"--volume {low_mm:g}-{high_mm:g}",
    ]
    if room.robots is not None:
        size = room.robots
        words.append(
            f"--robots {size.count} --robot-size {1e3 * size.radius_m:g}x{1e3 * size.height_m:g}"
        )
    if "tripod" in room.mounts:
        corner = task.corners_m.min(axis=0)
        words.append("--mount tripod")
        words += [
            f"--tripod {1e3 * (tx - corner[0]):.0f},{1e3 * (ty - corner[1]):.0f},{1e3 * tz:.0f}"
            for tx, ty, tz in design.poses.position_m.tolist()
        ]
    return " ".join([*words, "-o room.toml"])
