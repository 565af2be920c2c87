"""Answers to a task as values for JSON, and figures as text."""

from __future__ import annotations

import math
from typing import Any

from locatk.core.advice.answer import AccuracyMap, Advice, Check, SystemAdvice
from locatk.core.materials import BillTotal
from locatk.formats.exporters.bill_of_materials import bill_rows

_SCALES = {
    "m": (1e3, "mm"),
    "rad": (180 / math.pi, "deg"),
    "s": (1e3, "ms"),
    "W": (1e3, "mW"),
    "fraction": (100.0, "%"),
}
"""Factor and unit in which values are shown to people."""


def value_text(value: float | str | None, unit: str) -> str:
    """Return a value for people: lengths in mm, angles in degrees, times in ms.

    Examples
    --------
    >>> value_text(0.0123, "m"), value_text(float("inf"), "m"), value_text("any", "")
    ('12.3 mm', 'none', 'any')
    """
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    if not math.isfinite(value):
        return "none"
    factor, shown = _SCALES.get(unit, (1.0, unit))
    if unit == "m" and value >= 1.0:
        factor, shown = 1.0, "m"
    scaled = factor * value
    number = f"{scaled:.0f}" if scaled >= 100 else f"{scaled:.3g}"
    return f"{number} {shown}".rstrip()


def check_text(check: Check | None) -> str:
    """Return the figure of a check, with an exclamation mark if it is not as wanted."""
    return "-" if check is None else value_text(check.expected, check.unit) + failure_mark(check)


def failure_mark(check: Check | None) -> str:
    """Return the mark of a check that is not met; empty for others."""
    return " !" if check is not None and check.is_met is False else ""


def cost_text(advice: SystemAdvice) -> str:
    """Return the cost of a system, in each currency of its prices."""
    totals = ", ".join(map(total_text, advice.totals))
    return totals + failure_mark(advice.check("cost"))


def total_text(total: BillTotal) -> str:
    """Return a total as short as a cell of a table: ``"400+ USD"`` if prices are missing."""
    if not total.currency:
        return "not priced"
    sign = "+" if total.parts_without_price else ""
    return f"{total.amount:,.0f}{sign} {total.currency}"


def advice_entry(advice: Advice) -> dict[str, Any]:
    """Return an answer as values for JSON, in SI units as ``unit`` says."""
    return {
        "best": None if advice.best is None else advice.best.system,
        "systems": [_system_entry(system) for system in advice.systems],
        "combinations": [vars(pair) for pair in advice.combinations],
    }


def _system_entry(advice: SystemAdvice) -> dict[str, Any]:
    return {
        "system": advice.system,
        "feasible": advice.is_feasible,
        "design": advice.design,
        "checks": [_check_entry(check) for check in advice.checks],
        "infrastructure": bill_rows(advice.infrastructure),
        "robot_parts": bill_rows(advice.robot_parts),
        "totals": [_total_entry(total) for total in advice.totals],
        "work": [{**vars(step), "hours": step.hours} for step in advice.work],
        "hours": advice.hours,
        "power": [vars(power) for power in advice.power],
        "maintenance": advice.maintenance,
        "risks": advice.risks,
        "paper": advice.paper,
        "commands": advice.commands,
        "map": None if advice.accuracy_map is None else _map_entry(advice.accuracy_map),
    }


def _check_entry(check: Check) -> dict[str, Any]:
    return vars(check)


def _total_entry(total: BillTotal) -> dict[str, Any]:
    return {
        "amount": total.amount if total.currency else None,
        "currency": total.currency or None,
        "parts_without_price": total.parts_without_price,
    }


def _map_entry(shown: AccuracyMap) -> dict[str, Any]:
    return {
        "points_m": shown.point_m,
        "error_p95_m": shown.error_m,
        "infrastructure": shown.infrastructure,
        "infrastructure_m": shown.infrastructure_m,
    }
