"""Advice on magnetic tags (Polaris) for a task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.advice.answer import AccuracyMap, Power, SystemAdvice
from locatk.core.advice.checks import (
    MIN_COVERAGE,
    condition_check,
    disturbance_t,
    limit_check,
    magnetic_checks,
)
from locatk.core.advice.task import Task
from locatk.core.advice.work import work_steps
from locatk.core.materials import split_bill
from locatk.core.polaris import codec
from locatk.core.polaris.design.environment import MOTORS, QUIET, REINFORCED, Environment
from locatk.core.polaris.design.planning import ReadingConditions, evaluate_design
from locatk.core.polaris.design.routes import SpacingPlan, plan_route, spacing_for_accuracy
from locatk.core.polaris.design.search import SearchSpace, search_designs
from locatk.core.polaris.design.site import SitePoint, pass_separation
from locatk.core.polaris.tag import Tags
from locatk.core.polygons import is_inside
from locatk.core.routes import Route

Array = NDArray[np.float64]

LANE_SPACING_M = 1.0
"""Distance between the lanes that are drawn over an area without routes [m]."""

LATENCY_S = 0.226
"""Time from the last magnet to id and pose, 99 %, with a site and odometry (`locatk bench
live`)."""

ARRAY_POWER_W, MINIATURE_POWER_W, COMPUTING_POWER_W = 77.22e-3, 25.08e-3, 2.8e-3
"""Power of arrays of nine and three magnetometers, and of template matching on an ESP32 (Polaris
paper, section 8.5)."""

SEARCHED_IDS = 500
"""Number of ids of tags that are searched for a larger clearance than that of the paper."""

MAX_MISREAD = 0.01
"""Fraction of passes with a wrong orientation that is accepted."""


def advise(task: Task, minutes: Mapping[str, float]) -> SystemAdvice:
    """Design tags along the routes of a task, or along lanes if it has no routes."""
    use = ReadingConditions(speed_mps=task.speed_mps, environment=environment_of(task))
    tags = _choose_tags(task, use)
    routes = task.routes or lanes(task)
    plan, points = _plan(task, tags, use, routes)
    count = len(points)
    report = evaluate_design(tags, use, max(count, 1))
    spacing = "no spacing" if math.isnan(plan.spacing_m) else f"{plan.spacing_m:.2g} m apart"
    has_poses = count > 0 and math.isfinite(plan.position_p95_m) and task.has_odometry
    position_m, heading_rad = math.inf, math.inf
    if count:
        position_m, heading_rad = plan.position_p95_m, plan.heading_p95_rad
    remedies = "; ".join(plan.remedies)
    checks = [
        limit_check(
            "position",
            "m",
            position_m,
            task.position_m,
            "computed",
            "dead reckoning between tags that are laid by hand (Cramer-Rao bound, odometry)",
            remedies,
        ),
        limit_check(
            "heading",
            "rad",
            heading_rad,
            task.heading_rad,
            "computed",
            "same forecast",
            remedies,
        ),
        limit_check(
            "coverage",
            "fraction",
            (1.0 if task.routes else 0.0) if has_poses else 0.0,
            MIN_COVERAGE,
            "computed",
            "routes after their first tag"
            if task.routes
            else f"the design is for lanes {LANE_SPACING_M:g} m apart: robots that drive anywhere "
            "rarely pass over a tag",
            remedies if task.routes else "Lead the robots along routes, and give them (--route)",
            better="higher",
        ),
        condition_check(
            "tags",
            plan.is_feasible,
            "robots pass over each tag, and the wanted errors are kept"
            if plan.is_feasible
            else "no spacing of tags keeps the wanted errors",
            "forecast of the routes",
            remedies,
            "computed",
        ),
        condition_check(
            "odometry",
            task.has_odometry,
            "needed between tags",
            "Polaris paper, section 8.3.7",
            "Wheels with encoders",
        ),
        limit_check(
            "speed",
            "m/s",
            report.max_speed_mps,
            task.speed_mps,
            "computed",
            "samples over a magnet",
            "Slower robots over tags, larger magnets or a faster setting of the magnetometers",
            better="higher",
        ),
        condition_check(
            "floor",
            bool(task.floor_work & {"glue", "mill"}),
            "tags of 0.7 mm are glued on or laid in pockets",
            "Polaris paper, section 7.2",
            "Permission to glue thin tags on",
        ),
        limit_check(
            "ids",
            "",
            float(codec.capacity(tags)),
            float(count),
            "computed",
            "capacity of the codec (Polaris paper, Eq. 1)",
            "More magnets in a tag",
            better="higher",
        ),
        limit_check(
            "passes that are misread",
            "fraction",
            report.misread,
            MAX_MISREAD,
            "computed",
            "orientations of magnets placed by hand, and noise",
            "Fewer orientations, or measure the tags as built (`locatk calibrate tag`)",
        ),
        limit_check(
            "latency",
            "s",
            LATENCY_S,
            task.latency_s,
            "measured",
            "`locatk bench live`, 99 %, after a tag; poses by odometry at once",
            "Poses by odometry have no latency; only the correction is late",
        ),
        *magnetic_checks(task, "tags"),
    ]
    infrastructure, array = split_bill(report.materials, ROBOT_PARTS)
    return SystemAdvice(
        "polaris",
        f"{count} tags of {tags.magnets} magnets, {spacing} along "
        + (
            f"{len(task.routes)} route{'s' * (len(task.routes) > 1)}"
            if task.routes
            else f"lanes {LANE_SPACING_M:g} m apart"
        ),
        tuple(checks),
        infrastructure=infrastructure,
        robot_parts=tuple(replace(item, count=item.count * task.robots) for item in array),
        work=work_steps(
            {
                "make a tag": count,
                "place a tag": count,
                "survey a tag": count,
                "equip a robot": task.robots,
                "calibrate and check": 1,
            },
            minutes,
        ),
        power=(
            Power("nine magnetometers", ARRAY_POWER_W + COMPUTING_POWER_W, POWER_SOURCE),
            Power("three magnetometers", MINIATURE_POWER_W + COMPUTING_POWER_W, POWER_SOURCE),
        ),
        maintenance=("Replace tags that were torn off; dirt, water and dust do not matter.",),
        risks=(
            "Magnets that were glued with the north the wrong way make another id: check each tag "
            "with one pass.",
            "A robot whose odometry slips more than stated misses the next tag.",
        ),
        paper=(
            "Mean position error 1.93 to 2.49 mm, heading 1.07 to 1.39 degrees (section 8.3.2); "
            "locatk reaches 0.36 and 0.69 mm on the published recordings.",
            "Read under iron filings, dirt and water (section 8.3.6).",
        ),
        commands=(
            _tag_command(task, tags, count),
            _site_command(task, routes, plan),
            "locatk print site site.toml -o site.pdf",
            "locatk simulate polaris site.toml -o drive.mcap --odometry",
            "locatk solve drive.mcap -o solved.mcap",
            "locatk eval solved.mcap --truth drive.mcap",
        ),
        accuracy_map=_accuracy_map(routes, points, plan),
    )


ROBOT_PARTS = ("magnetometer", "microcontroller")
POWER_SOURCE = "Polaris paper, section 8.5, array and computing"


def _choose_tags(task: Task, use: ReadingConditions) -> Tags:
    """Return the tags of the paper, or with more clearance the cheapest that are read there."""
    tags = Tags(clearance_m=task.clearance_m)
    if task.clearance_m <= Tags.clearance_m:
        return tags
    space = SearchSpace(clearance_m=(task.clearance_m, task.clearance_m))
    found = search_designs(SEARCHED_IDS, use=use, space=space).designs
    readable = (d.tags for d in found if not math.isnan(pass_separation(d.tags, use)))
    return next(readable, tags)


def _tag_command(task: Task, tags: Tags, count: int) -> str:
    """Return the command that designs a family of these tags."""
    words = [
        f"locatk tag design --clearance {1e3 * tags.clearance_m:g} --count {max(count, 1)}",
        f"--speed {task.speed_mps:g}",
    ]
    if tags != Tags(clearance_m=tags.clearance_m):
        magnet = tags.magnet
        words.append(
            f"--order {tags.order} --magnets {tags.magnets} --orientations {tags.orientations} "
            f"--spacing {1e3 * tags.spacing_m:g} --diameter {1e3 * magnet.diameter_m:g} "
            f"--height {1e3 * magnet.height_m:g} --grade {magnet.grade}"
        )
    return " ".join([*words, "-o tag.toml"])


def _site_command(task: Task, routes: tuple[Route, ...], plan: SpacingPlan) -> str:
    """Return the command that places the tags along the first route, or on a grid of lanes."""
    if task.routes:
        return (
            f"locatk site design tag.toml --route {task.routes[0].name}.csv "
            f"--accuracy {1e3 * task.position_m:g} -o site.toml"
        )
    spacing_m = LANE_SPACING_M if math.isnan(plan.spacing_m) else plan.spacing_m
    columns = math.ceil(max((route.length_m for route in routes), default=0.0) / spacing_m) + 1
    return (
        f"locatk site design tag.toml --grid {max(len(routes), 1)}x{columns} "
        f"--spacing {1e3 * spacing_m:.0f} -o site.toml"
    )


def environment_of(task: Task) -> Environment:
    """Return the fields of a task that vary during a pass."""
    if task.iron == "none":
        return MOTORS if task.has_motors else QUIET
    if task.iron == "reinforced" and not task.has_motors:
        return REINFORCED
    return replace(REINFORCED, name="task", field_t=disturbance_t(task))


def lanes(task: Task) -> tuple[Route, ...]:
    """Return straight lanes along the longer side of the area, inside it."""
    low, high = task.corners_m.min(axis=0), task.corners_m.max(axis=0)
    axis = int(np.ptp(task.corners_m, axis=0).argmax())
    across = high[1 - axis] - low[1 - axis]
    count = max(1, math.floor(across / LANE_SPACING_M))
    steps = np.linspace(low[axis], high[axis], 201)
    routes = []
    for number in range(count):
        points = np.zeros((len(steps), 2))
        points[:, axis] = steps
        points[:, 1 - axis] = low[1 - axis] + across * (number + 0.5) / count
        inside = points[is_inside(task.corners_m, points)]
        if len(inside) >= 2:
            routes.append(Route(inside[[0, -1]], f"lane {number + 1}"))
    return tuple(routes)


def _plan(
    task: Task, tags: Tags, use: ReadingConditions, routes: tuple[Route, ...]
) -> tuple[SpacingPlan, Array]:
    """Return the plan of the worst route, and the positions of all tags (n, 2)."""
    heading_rad = math.inf if task.heading_rad is None else task.heading_rad
    if not task.routes:
        plan = spacing_for_accuracy(tags, use, position_m=task.position_m, heading_rad=heading_rad)
        if math.isnan(plan.spacing_m):
            return plan, np.zeros((0, 2))
        return plan, np.concatenate([_evenly(route, plan.spacing_m) for route in routes])
    plans, points = [], []
    for route in routes:
        waypoints = [SitePoint(x, y) for x, y in route.waypoint_m.tolist()]
        placed, plan = plan_route(
            tags, waypoints, use, position_m=task.position_m, heading_rad=heading_rad
        )
        plans.append(plan)
        points += [[point.x_m, point.y_m] for point in placed]
    worst = max(plans, key=lambda plan: (not plan.is_feasible, plan.position_p95_m))
    return worst, np.array(points, float).reshape(-1, 2)


def _evenly(route: Route, spacing_m: float) -> Array:
    count = max(2, math.ceil(route.length_m / spacing_m - 1e-9) + 1)
    return route.at(np.linspace(0.0, route.length_m, count))[0]


def _accuracy_map(routes: tuple[Route, ...], tags_m: Array, plan: SpacingPlan) -> AccuracyMap:
    along = [route.at(np.arange(0.0, route.length_m, 0.1))[0] for route in routes]
    points = np.concatenate(along) if along else np.zeros((0, 2))
    return AccuracyMap(points, np.full(len(points), plan.position_p95_m), tags_m, "tags")
