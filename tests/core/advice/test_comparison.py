"""Order of the systems, costs, and pairs of systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from locatk.core.advice import comparison
from locatk.core.advice.answer import Check, Power, SystemAdvice
from locatk.core.advice.checks import condition_check
from locatk.core.advice.comparison import advise, combine
from locatk.core.advice.task import Task
from locatk.core.advice.work import work_steps
from locatk.core.materials import BillItem, Price, PriceList

TASK = Task(position_m=0.02)


def dots(task: Task, minutes: Mapping[str, float]) -> SystemAdvice:
    """Ten sheets and two cameras, priced in euros but for the sheets."""
    return SystemAdvice(
        "dots",
        "",
        (condition_check("floor", "print" in task.floor_work, "", ""),),
        infrastructure=(BillItem("printed sheet", 10, ""),),
        robot_parts=(BillItem("image sensor", 2, "", Price(12.86, "EUR", "2016", "Table II")),),
        work=work_steps({"lay a sheet": 10}, minutes),
        power=(Power("moving", 0.873, "paper"), Power("at rest", 0.352, "paper")),
    )


def polaris(task: Task, minutes: Mapping[str, float]) -> SystemAdvice:
    """Twenty tags, priced in dollars but for glue."""
    return SystemAdvice(
        "polaris",
        "",
        (condition_check("floor", "glue" in task.floor_work, "", ""),),
        infrastructure=(
            BillItem("disc magnet", 100, "", Price(0.015, "USD", "2024", "paper")),
            BillItem("glue", 1, ""),
        ),
        robot_parts=(BillItem("magnetometer", 9, "", Price(2.0, "USD", "2024", "paper")),),
        work=work_steps({"make a tag": 20, "place a tag": 20}, minutes),
        power=(Power("always", 0.08, "paper"),),
    )


@pytest.fixture(autouse=True)
def two_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare two systems whose counts are known."""
    monkeypatch.setattr(comparison, "ADVISERS", {"dots": dots, "polaris": polaris})


def test_feasible_systems_with_less_work_come_first() -> None:
    names = []
    advice = advise(TASK, progress=names.append)
    assert names == ["dots", "polaris"]
    assert [system.system for system in advice.systems] == ["dots", "polaris"]
    assert all(system.is_feasible for system in advice.systems)
    assert advice.systems[0].hours < advice.systems[1].hours
    untouched = advise(replace(TASK, floor_work=frozenset({"glue"})))
    assert [system.system for system in untouched.systems] == ["polaris", "dots"]
    assert untouched.best is untouched.systems[0]


def test_minutes_of_the_user_change_hours_and_order() -> None:
    advice = advise(TASK, PriceList(work_minutes={"lay a sheet": 600.0}))
    assert [system.system for system in advice.systems] == ["polaris", "dots"]
    step = next(step for step in advice.systems[1].work if step.name == "lay a sheet")
    assert step.hours == 10 * step.count
    assert step.source == "prices.toml"


def test_budget_is_compared_in_its_currency_only() -> None:
    task = replace(TASK, budget=10.0, currency="USD")
    costs = {s.system: s.check("cost") for s in advise(task).systems}
    # Magnets and magnetometers are 19.50 USD; prices of the dots are in euros.
    assert costs["polaris"].is_met is False  # type: ignore[union-attr]
    assert costs["dots"].is_met is None  # type: ignore[union-attr]
    enough = {s.system: s.check("cost") for s in advise(replace(task, budget=1e4)).systems}
    # Parts without a price could exceed any budget.
    assert enough["polaris"].is_met is None  # type: ignore[union-attr]
    assert "no price of" in str(enough["polaris"].expected)  # type: ignore[union-attr]


def test_complete_prices_decide_about_the_budget() -> None:
    parts = {
        item.part for s in advise(TASK).systems for item in (*s.infrastructure, *s.robot_parts)
    }
    prices = {part: Price(1.0, "EUR", "2026-11", "shop") for part in parts}
    task = replace(TASK, budget=1e4, currency="EUR")
    for system in advise(task, PriceList(prices)).systems:
        cost = system.check("cost")
        assert cost is not None
        assert cost.is_met is True
        count = sum(item.count for item in (*system.infrastructure, *system.robot_parts))
        assert cost.expected == pytest.approx(count)


def test_hours_power_and_battery_are_checked() -> None:
    task = replace(TASK, hours=0.1, power_w=0.1, battery_wh=2.22)
    by_system = {system.system: system for system in advise(task).systems}
    assert by_system["dots"].check("installation").is_met is False  # type: ignore[union-attr]
    assert by_system["dots"].check("power").is_met is False  # type: ignore[union-attr]
    assert by_system["polaris"].check("power").is_met is True  # type: ignore[union-attr]
    life = by_system["dots"].check("battery life, localization alone")
    assert life is not None
    assert life.expected == pytest.approx(2.22 / 0.873)


def system(name: str, position_m: float, *failed: str) -> SystemAdvice:
    checks = [
        Check("position", "m", position_m, 0.001, position_m <= 0.001, "computed", ""),
        *(Check(each, "", "", None, False, "assumed", "") for each in failed),
    ]
    return SystemAdvice(name, "", tuple(checks))


def test_a_coarse_system_guides_robots_to_the_places_of_a_fine_one() -> None:
    task = Task(position_m=0.001)
    coarse, fine = system("lighthouse", 0.004), system("dots", 0.0005, "installation")
    assert [(p.area_system, p.spot_system) for p in combine([coarse, fine], task)] == [
        ("lighthouse", "dots")
    ]
    # A system that meets the task needs no second one.
    assert combine([coarse, system("dots", 0.0005)], task) == ()
    # Ten times the wanted error is too coarse, and an untouched floor has no single places either.
    assert combine([system("lighthouse", 0.02), fine], task) == ()
    assert combine([coarse, system("dots", 0.0005, "floor")], task) == ()
    assert combine([system("lighthouse", 0.004, "light"), fine], task) == ()
