"""Comparison of the four systems for a task: costs, order, and pairs of systems."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from locatk.core.advice import dots, landmarks, lighthouse, polaris
from locatk.core.advice.answer import Advice, Check, Combination, SystemAdvice
from locatk.core.advice.checks import condition_check, limit_check
from locatk.core.advice.task import Task
from locatk.core.errors import InputError
from locatk.core.materials import PriceList, with_prices

ADVISERS: dict[str, Callable[[Task, Mapping[str, float]], SystemAdvice]] = {
    "lighthouse": lighthouse.advise,
    "dots": dots.advise,
    "polaris": polaris.advise,
    "landmarks": landmarks.advise,
}
"""Function that designs each system for a task, with the minutes of pieces of work."""

ACCURACY_CHECKS = ("position", "heading")
"""Checks that a second system can meet at the places that need it."""

CHECKS_INDEPENDENT_OF_AREA = (
    "indoors",
    "light",
    "floor",
    "robots in space",
    "iron",
    "speed",
    "rate",
)
"""Checks that fail at single places as they do in the whole area."""

GUIDANCE_RATIO = 10.0
"""Ratio of the position error of a system to the wanted one up to which it can guide robots to the
places of a second system."""


def advise(
    task: Task,
    prices: PriceList | None = None,
    progress: Callable[[str], None] | None = None,
) -> Advice:
    """Design the four systems for a task and compare them.

    Parameters
    ----------
    task : Task
    prices : PriceList, optional
        By default, the published prices and the default minutes.
    progress : callable, optional
        Called with the name of each system before it is designed.

    Returns
    -------
    Advice
        Systems that meet all requirements come first, then those that fail the fewest. Among equal
        ones, less installation work comes first.
    """
    minutes = {} if prices is None else prices.work_minutes
    systems = []
    for name, adviser in ADVISERS.items():
        if progress is not None:
            progress(name)
        try:
            designed = adviser(task, minutes)
        except InputError as error:
            designed = SystemAdvice(
                name,
                "no design",
                (condition_check("design", False, str(error), "its limits", error.hint or ""),),
            )
        systems.append(_with_costs(designed, task, prices))
    systems.sort(key=lambda system: (len(system.failures), system.hours))
    return Advice(tuple(systems), combine(systems, task))


def _with_costs(advice: SystemAdvice, task: Task, prices: PriceList | None) -> SystemAdvice:
    """Return the advice with the user's prices, and the checks of budget, work and power."""
    parts = None if prices is None else prices.parts
    advice = replace(
        advice,
        infrastructure=with_prices(advice.infrastructure, parts),
        robot_parts=with_prices(advice.robot_parts, parts),
    )
    checks = [
        *advice.checks,
        _budget_check(advice, task),
        limit_check(
            "installation",
            "h",
            advice.hours,
            task.hours,
            "assumed",
            "counts of the design; minutes of each piece of work are assumptions",
            "More hours or people, or a smaller area",
        ),
    ]
    if advice.power:
        highest = max(advice.power, key=lambda power: power.power_w)
        remedy = f"The robot must supply {1e3 * highest.power_w:.3g} mW for its localization"
        checks.append(
            limit_check(
                "power", "W", highest.power_w, task.power_w, "published", highest.source, remedy
            )
        )
        if task.battery_wh is not None:
            life_h = task.battery_wh / highest.power_w
            source = "energy of the battery over this power"
            checks.append(
                limit_check(
                    "battery life, localization alone", "h", life_h, None, "published", source
                )
            )
    return replace(advice, checks=tuple(checks))


def _budget_check(advice: SystemAdvice, task: Task) -> Check:
    """Compare the total in the currency of the budget, if all parts have a price in it."""
    text = "; ".join(total.text for total in advice.totals)
    total = advice.totals[0]
    is_comparable = len(advice.totals) == 1 and total.currency == task.currency
    is_complete = is_comparable and not total.parts_without_price
    is_met = None
    if task.budget is not None and is_comparable:
        is_met = False if total.amount > task.budget else True if is_complete else None
    return Check(
        "cost",
        task.currency,
        total.amount if is_complete else text,
        task.budget,
        is_met,
        "published",
        "prices of the papers, or of --prices; each with its date in the bill of materials",
        "A larger budget, a smaller area or fewer robots; enter your prices with --prices",
    )


def combine(systems: Sequence[SystemAdvice], task: Task) -> tuple[Combination, ...]:
    """Return the pairs of systems that together meet the task.

    One covers the area and misses only the accuracy, by less than :data:`GUIDANCE_RATIO`; the other
    reaches the accuracy and fails only by the size of the area, as in work or cost. Nothing is
    combined if a single system meets the task.
    """
    if any(system.is_feasible for system in systems):
        return ()
    pairs = []
    for coarse, fine in itertools.permutations(systems, 2):
        misses = {check.name for check in coarse.failures}
        position = coarse.check("position")
        is_guide = bool(misses) and misses <= set(ACCURACY_CHECKS)
        if position is None or not isinstance(position.expected, float):
            continue
        is_guide &= position.expected <= GUIDANCE_RATIO * task.position_m
        fine_misses = {check.name for check in fine.failures}
        is_fine = not fine_misses & {*ACCURACY_CHECKS, *CHECKS_INDEPENDENT_OF_AREA}
        if is_guide and is_fine:
            pairs.append(
                Combination(
                    coarse.system,
                    fine.system,
                    f"{coarse.system} covers the area to {1e3 * position.expected:.3g} mm; "
                    f"{fine.system} reaches the accuracy, and is needed only at the places that "
                    f"demand it (it fails for the whole area: {', '.join(sorted(fine_misses))})",
                )
            )
    return tuple(pairs)
