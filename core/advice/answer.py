"""Answer to a task: what each system would do, cost and need, with the source of each figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.materials import BillItem, BillTotal, total_of

Array = NDArray[np.float64]

Certainty = Literal["published", "measured", "computed", "assumed"]
"""How sure a figure is: measured by the authors of a paper or a data sheet; measured by locatk on
published recordings; computed from a model that was compared with simulations and recordings; an
assumption that users should replace by their own figure."""


@dataclass(frozen=True)
class Check:
    """Requirement of the task beside what a system reaches.

    Attributes
    ----------
    name : str
    unit : str
        Of :attr:`wanted` and :attr:`expected`, empty if the requirement is no number.
    expected : float or str
    wanted : float or str or None
        None if the task does not demand anything.
    is_met : bool or None
        None if nothing is demanded, or it is unknown.
    certainty : Certainty
    source : str
        Origin of :attr:`expected`.
    remedy : str
        What would have to change if it is not met.
    """

    name: str
    unit: str
    expected: float | str
    wanted: float | str | None
    is_met: bool | None
    certainty: Certainty
    source: str
    remedy: str = ""


@dataclass(frozen=True)
class WorkStep:
    """Work of the installation.

    Attributes
    ----------
    name : str
    count : float
    minutes_each : float
    source : str
    """

    name: str
    count: float
    minutes_each: float
    source: str

    @property
    def hours(self) -> float:
        """Duration of the step."""
        return self.count * self.minutes_each / 60


@dataclass(frozen=True)
class Power:
    """Power of the localization of one robot in one mode, in watts."""

    mode: str
    power_w: float
    source: str


@dataclass(frozen=True, eq=False)
class AccuracyMap:
    """Expected error at points of the area.

    Attributes
    ----------
    point_m : (n, 2) ndarray
    error_m : (n,) ndarray
        95 % quantile of the position error; ``nan`` where there is no position.
    infrastructure_m : (k, 2) ndarray
        Positions of stations, tags or landmarks.
    infrastructure : str
        Their name, as in ``"stations"``.
    """

    point_m: Array
    error_m: Array
    infrastructure_m: Array
    infrastructure: str


@dataclass(frozen=True)
class SystemAdvice:
    """Design of one system for a task.

    Attributes
    ----------
    system : str
    design : str
        The design in one sentence.
    checks : tuple of Check
    infrastructure : tuple of BillItem
    robot_parts : tuple of BillItem
        Of all robots together.
    work : tuple of WorkStep
    power : tuple of Power
        Of one robot.
    maintenance, risks, paper : tuple of str
        Sentences; those of ``paper`` state results of the paper.
    commands : tuple of str
        Commands of locatk that carry the design out.
    accuracy_map : AccuracyMap or None
    """

    system: str
    design: str
    checks: tuple[Check, ...]
    infrastructure: tuple[BillItem, ...] = ()
    robot_parts: tuple[BillItem, ...] = ()
    work: tuple[WorkStep, ...] = ()
    power: tuple[Power, ...] = ()
    maintenance: tuple[str, ...] = ()
    risks: tuple[str, ...] = ()
    paper: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    accuracy_map: AccuracyMap | None = field(default=None, compare=False)

    @property
    def is_feasible(self) -> bool:
        """True if no requirement fails."""
        return not self.failures

    @property
    def failures(self) -> tuple[Check, ...]:
        """The requirements that are not met."""
        return tuple(check for check in self.checks if check.is_met is False)

    @property
    def hours(self) -> float:
        """Working time of the installation."""
        return sum(step.hours for step in self.work)

    @property
    def totals(self) -> tuple[BillTotal, ...]:
        """Cost of infrastructure and robots, a total for each currency."""
        return totals_by_currency((*self.infrastructure, *self.robot_parts))

    def check(self, name: str) -> Check | None:
        """Return the check of this name, or None."""
        return next((check for check in self.checks if check.name == name), None)


@dataclass(frozen=True)
class Combination:
    """Two systems that together do what neither does alone.

    Attributes
    ----------
    area_system, spot_system : str
        The one that covers the area, and the one at the places that demand the accuracy.
    reason : str
    """

    area_system: str
    spot_system: str
    reason: str


@dataclass(frozen=True)
class Advice:
    """The four systems for a task, the most suitable first.

    Attributes
    ----------
    systems : tuple of SystemAdvice
    combinations : tuple of Combination
    """

    systems: tuple[SystemAdvice, ...]
    combinations: tuple[Combination, ...]

    @property
    def best(self) -> SystemAdvice | None:
        """The most suitable system, None if no system meets all requirements."""
        return next((advice for advice in self.systems if advice.is_feasible), None)


def totals_by_currency(items: Sequence[BillItem]) -> tuple[BillTotal, ...]:
    """Return the totals of a bill, one for each currency.

    Parts without a price are listed with each of them.
    """
    priced = sorted({item.price.currency for item in items if item.price is not None})
    missing = [item for item in items if item.price is None]
    if not priced:
        return (total_of(missing),)
    return tuple(
        total_of(
            [
                *(item for item in items if item.price and item.price.currency == currency),
                *missing,
            ]
        )
        for currency in priced
    )
