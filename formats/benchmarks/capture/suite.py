"""The figures of ``locatk bench capture``: nothing is lost, and what is broken is mended."""

from __future__ import annotations

import os
from pathlib import Path

from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.capture.faults import damage_figures, kill_figures, soak_figures
from locatk.formats.benchmarks.capture.speed import info_figure, speed_figures


def figures(data: Path) -> list[Figure]:
    """All figures; none needs published data. About four minutes, on a quiet machine."""
    live = [*soak_figures(), *kill_figures()] if hasattr(os, "openpty") else []
    return [*live, *damage_figures(), *speed_figures(), info_figure()]
