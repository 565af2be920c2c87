"""Figures of the benchmarks: measured values with their targets and the values of peers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from locatk.core.errors import LocatkError

Workload = Literal["numpy", "Python"]


class Duration(NamedTuple):
    """Duration of a call in seconds, and the machine factor that was measured with it."""

    seconds: float
    machine_factor: float


@dataclass(frozen=True)
class Figure:
    """Measured value beside its target and the value of a peer.

    A figure is declared without a value; :meth:`timed` and :meth:`missing` complete it.

    Attributes
    ----------
    name, unit : str
    value : float or None
        None if it was not measured; ``how`` then gives the reason.
    how : str
        Method and number of cases, and quantities that were fitted to the truth.
    target : float or None
        Target on the reference machine.
    better : {"lower", "higher"}
    peer : str or None
        Other software, publication or bound that has ``peer_value``.
    peer_value : float or None
    workload : {"numpy", "Python"} or None
        Workload that scales the target of a duration or a rate; None for values that do not
        depend on the speed of the machine.
    machine_factor : float or None
        Duration of this workload, measured with the value, over that on the reference machine.
    """

    name: str
    value: float | None
    unit: str
    how: str
    target: float | None = None
    better: Literal["lower", "higher"] = "lower"
    peer: str | None = None
    peer_value: float | None = None
    workload: Workload | None = None
    machine_factor: float | None = None

    @property
    def scaled_target(self) -> float | None:
        """Target on this machine: durations grow with the machine factor, rates shrink."""
        if self.target is None or self.machine_factor is None:
            return self.target
        factor = self.machine_factor
        return self.target * factor if self.better == "lower" else self.target / factor

    @property
    def met(self) -> bool | None:
        """True if the scaled target is met; None without a target or a value."""
        target = self.scaled_target
        if self.value is None or target is None:
            return None
        return self.value <= target if self.better == "lower" else self.value >= target

    def timed(self, duration: Duration, amount: float = 1.0) -> Figure:
        """Return the figure with a measured duration.

        Parameters
        ----------
        duration : Duration
        amount : float
            Factor from seconds to the unit; of a rate (higher is better), the amount of work.
        """
        seconds, factor = duration
        value = amount * seconds if self.better == "lower" else amount / seconds
        return replace(self, value=value, machine_factor=factor)

    def missing(self, reason: object) -> Figure:
        """Return the figure without a value and with the reason."""
        return replace(self, value=None, how=f"not measured: {reason}")


def measure_or_explain(measure: Callable[[], Iterable[Figure]], *declared: Figure) -> list[Figure]:
    """Return the figures of ``measure``, or those declared with the reason if it fails."""
    try:
        return list(measure())
    except (LocatkError, OSError) as error:
        return [figure.missing(error) for figure in declared]
