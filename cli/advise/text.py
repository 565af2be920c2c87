"""Text of the answer of ``locatk advise``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.advice.answer import Advice, SystemAdvice
    from locatk.core.advice.task import Task

SHOWN_CHECKS = (
    ("position", "position, 95 %"),
    ("heading", "heading, 95 %"),
    ("coverage", "coverage"),
    ("rate", "rate"),
    ("latency", "latency"),
    ("speed", "speed, at most"),
    ("installation", "installation"),
    ("power", "power per robot"),
)
"""Check and its name in the table."""


def text(task: Task, advice: Advice) -> str:
    """Format an answer in 80 columns."""
    parts = [_comparison(task, advice)]
    for system in advice.systems:
        if not system.is_feasible:
            parts.append(_failures(system))
    if advice.combinations:
        parts.append(_combinations(advice))
    best = advice.best or advice.systems[0]
    parts += [_design(best), _next(best)]
    parts.append(
        console.wrapped(
            "Errors are predictions (95 %). A cost with + has parts without a price. Hours are "
            "assumptions and prices those of the papers "
            "unless you give yours with --prices. --report writes maps, parts, sources and risks.",
            indent=0,
        )
    )
    return "\n\n".join(parts)


def _comparison(task: Task, advice: Advice) -> str:
    from locatk.formats.advice.entries import check_text, cost_text, value_text

    systems = advice.systems
    header = ("", "wanted", *(system.system for system in systems))
    rows: list[tuple[str, ...]] = [
        ("meets the task", "", *("yes" if s.is_feasible else "no" for s in systems))
    ]
    for name, title in SHOWN_CHECKS:
        checks = [system.check(name) for system in systems]
        shown = [check for check in checks if check is not None]
        if shown:
            wanted = next((check.wanted for check in shown if check.wanted is not None), None)
            rows.append((title, value_text(wanted, shown[0].unit), *map(check_text, checks)))
    budget = "-" if task.budget is None else f"{task.budget:,.0f} {task.currency}"
    rows.insert(-2, ("cost", budget, *map(cost_text, systems)))
    return console.table(header, rows)


def _failures(system: SystemAdvice) -> str:
    from locatk.formats.advice.entries import value_text

    lines = [f"{system.system} does not meet:"]
    for check in system.failures:
        expected = value_text(check.expected, check.unit)
        wanted = "" if check.wanted is None else f" ({value_text(check.wanted, check.unit)} wanted)"
        remedy = f". {check.remedy}" if check.remedy else ""
        lines.append(console.wrapped(f"  {check.name}: {expected}{wanted}{remedy}", indent=4))
    return "\n".join(lines)


def _combinations(advice: Advice) -> str:
    lines = ["Two systems together:"]
    lines += [console.wrapped(f"  {pair.reason}", indent=4) for pair in advice.combinations]
    return "\n".join(lines)


def _design(system: SystemAdvice) -> str:
    rows = [("Design", system.design)]
    rows += [("Cost", total.text) for total in system.totals]
    rows += [("Risk", risk) for risk in system.risks]
    return f"{system.system}\n{console.labelled(rows, indent=2)}"


def _next(system: SystemAdvice) -> str:
    return "\n".join(["Next:", *_indented(system.commands)])


def _indented(lines: tuple[str, ...]) -> Iterator[str]:
    for line in lines:
        yield f"  {line}"
