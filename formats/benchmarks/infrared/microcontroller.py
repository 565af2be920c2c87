"""Computation times on the authors' microcontroller: Table III of the Lighthouse paper.

The published logic analyser captures (``data/lighthouse/benchmarks``, of
DotBots/alvarado23lighthouse) contain, beside the light, a digital line per stage of the
firmware: the line is high while the stage runs. The times of Table III (Alvarado-Marin et al.,
IEEE RA-L 2024, DOI 10.1109/LRA.2024.3405345) are the widths of these pulses. They describe the
authors' nRF52833, not locatk, and have no target.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.recording import Edges
from locatk.formats.benchmarks import Figure
from locatk.formats.importers.saleae.recording import read_light

Array = NDArray[np.float64]

TABLE_III = "paper, Table III"


@dataclass(frozen=True)
class FirmwareStage:
    """Row of Table III.

    Attributes
    ----------
    name : str
    capture : str
        Folder and first word of the capture's name.
    lines : tuple of str
        Lines whose pulses, one after the other, are the stage.
    mean_us, sd_us : float
        Published mean and standard deviation; None if only the mean is given.
    """

    name: str
    capture: str
    lines: tuple[str, ...]
    mean_us: float
    sd_us: float | None = None


STAGES = (
    FirmwareStage("demodulation", "demodulation_code/logic", ("demodulate_light()",), 623.0, 3.6),
    FirmwareStage(
        "polynomial", "demodulation_code/logic", ("determine_polynomial()",), 127.0, 27.0
    ),
    FirmwareStage("LFSR index", "demodulation_code/logic", ("reverse_count_p()",), 158.0, 155.0),
    FirmwareStage(
        "position, one station",
        "oneLH_2D/Logic",
        ("count_to_camera()", "apply_homography()"),
        141.0,
    ),
    FirmwareStage(
        "position, two stations", "twoLH_2D/Logic", ("count_to_camera()", "twoLH_2D"), 144.0
    ),
)
"""Rows of Table III, with the captures and lines that hold them."""

DEMODULATION_STAGES = ("demodulation", "polynomial", "LFSR index")
"""Stages of every sweep, all in one capture."""

PAPER_LOAD_PERCENT = 19.0
"""Processor load of the demodulation, with every sweep of two stations (section II.B)."""


def figures(folder: Path) -> list[Figure]:
    """Return the times of all stages; ``folder`` is that of the published Lighthouse recordings.

    Raises
    ------
    LocatkError
        A capture is missing or damaged, or has no line of that name.
    """
    rows: list[Figure] = []
    busy_us = {}
    counts = {}
    for stage in STAGES:
        path = folder / "benchmarks" / f"{stage.capture}_analyser_capture.sal"
        lines = read_light(path, stage.lines)
        widths_us = [pulse_widths_us(line) for line in lines]
        busy_us[stage.name] = float(widths_us[0].sum()) / lines[0].duration_s
        counts[stage.name] = len(widths_us[0])
        how = (
            f"{len(widths_us[0]):,} pulses of {' and '.join(stage.lines)} in the authors' capture "
            f"{stage.capture.split('/')[0]}"
        )
        rows.append(
            Figure(f"microcontroller, {stage.name}: mean",
                   sum(float(widths.mean()) for widths in widths_us), "us", how, peer=TABLE_III,
                   peer_value=stage.mean_us)
        )  # fmt: skip
        if stage.sd_us is not None:
            rows.append(
                Figure(f"microcontroller, {stage.name}: SD", float(widths_us[0].std()), "us",
                       "of the same", peer=TABLE_III, peer_value=stage.sd_us)
            )  # fmt: skip
    load = sum(busy_us[name] for name in DEMODULATION_STAGES)
    demodulated, indexed = counts["demodulation"], counts["LFSR index"]
    return [
        *rows,
        Figure("microcontroller: load", 1e-4 * load, "%",
               f"time of {', '.join(DEMODULATION_STAGES)} over the duration of the capture",
               peer="paper, II.B", peer_value=PAPER_LOAD_PERCENT),
        Figure("microcontroller: captures with an index", 100 * indexed / demodulated, "%",
               f"{indexed:,} searches for an index after {demodulated:,} demodulations; the "
               "firmware searches if it has selected a polynomial", better="higher"),
    ]  # fmt: skip


def pulse_widths_us(line: Edges) -> Array:
    """Return the durations (n,) in microseconds for which a line was high, between two edges."""
    edges_us = line.tick[0 if line.rises else 1 :] * (1e6 / line.rate_hz)
    pulses = edges_us[: len(edges_us) // 2 * 2].reshape(-1, 2)
    return np.asarray(np.diff(pulses)[:, 0])
