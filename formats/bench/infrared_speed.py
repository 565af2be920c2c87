"""How fast light becomes sweeps."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from locatk.core.errors import LocatkError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.demodulation.identification import identify_sequences, read_windows
from locatk.core.lighthouse.demodulation.soft_bits import demodulate_bursts, split_windows
from locatk.formats.bench import Figure
from locatk.formats.bench.timing import alone, cpu_seconds

BATCH = 4
REPEATS = 40
"""Repetitions of the published windows in one batch."""

ROWS = {
    "windows of 16 us to index": "k/s",
    "soft bits to index": "k/s",
    "tables of all 32 sequences": "s",
    "import of 54 s of light": "s",
}


def figures(data: Path) -> list[Figure]:
    """Each in a process of its own, with one thread."""
    try:
        whole, index, tables, capture = alone(f"infrared_speed.measure({str(data)!r})")
    except (LocatkError, OSError) as error:
        return [Figure(n, None, unit, f"not measured: {error}") for n, unit in ROWS.items()]
    return [
        Figure("windows of 16 us to index", whole / 1e3, "k/s",
               f"64 bytes each to polynomial and index, batches of {11_136 * BATCH:,}, processor "
               f"time of one thread, best of {REPEATS}; the peer's chain does the same for 8 "
               "polynomials",
               400.0, "higher", "DotBot C, -O3", 216.0),
        Figure("soft bits to index", index / 1e3, "k/s",
               "the same without demodulation, all 32 polynomials", None, "higher",
               "DotBot C, -O3, 8 polynomials", 658.0),
        Figure("tables of all 32 sequences", tables, "s", "made once a process", 1.0),
        Figure("import of 54 s of light", capture, "s",
               "the demodulation capture from edges in memory to sweeps and factory data", None),
    ]  # fmt: skip


def measure(data: str) -> list[float]:
    """Windows a second, soft bits a second, seconds for the tables, seconds for a capture."""
    from locatk.core.lighthouse.demodulation.pipeline import demodulate_recording
    from locatk.formats.bench.infrared import CAPTURES, capture, published_windows

    start = time.process_time()
    lfsr.tables()
    tables = time.process_time() - start
    folder = Path(data) / "lighthouse"
    windows = np.concatenate([published_windows(folder)] * BATCH)
    whole = cpu_seconds(lambda: read_windows(windows), REPEATS)
    bits = demodulate_bursts(split_windows(windows))
    index = cpu_seconds(lambda: identify_sequences(bits), REPEATS)
    edges = capture(folder, CAPTURES[0])
    light = cpu_seconds(lambda: demodulate_recording([edges]), 3)
    return [len(windows) / whole, len(windows) / index, tables, light]
