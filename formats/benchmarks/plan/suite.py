"""Figures of ``locatk bench plan``: predictions, against simulations and recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from locatk.core.advice.comparison import advise
from locatk.core.advice.task import Task
from locatk.formats.benchmarks.figures import Figure, measure_or_explain
from locatk.formats.benchmarks.plan import dots, landmarks, lighthouse, papers, polaris, rooms
from locatk.formats.benchmarks.timing import time_call

PARTS: dict[str, Callable[[Path], Iterable[Figure]]] = {
    "lighthouse": lighthouse.figures,
    "dots": dots.figures,
    "polaris": polaris.figures,
    "landmarks": landmarks.figures,
    "rooms": rooms.figures,
    "papers": papers.figures,
}
"""Function that measures the figures of each part."""

TYPICAL_TASK = Task(size_m=(10.0, 8.0), height_m=3.0, robots=20, position_m=0.01)
"""Lab of 80 m2 with 20 robots."""

ADVISE_TIME = Figure(
    "advise: 20 robots on 10 x 8 m",
    None,
    "s",
    "design of all four systems for one task, processor time of one call",
    target=20.0,
    workload="numpy",
)


def figures(data: Path) -> list[Figure]:
    """Measure all figures; ``data`` is the folder with the published recordings."""
    measured: list[Figure] = []
    for name, measure in PARTS.items():
        declared = Figure(f"{name}: all figures", None, "", "")
        measured += measure_or_explain(lambda measure=measure: measure(data), declared)  # type: ignore[misc]
    measured.append(ADVISE_TIME.timed(time_call(lambda: advise(TYPICAL_TASK), repeats=1)))
    return measured
