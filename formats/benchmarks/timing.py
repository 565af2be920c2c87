"""How benches measure speed, and the seeds that belong to them."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Literal

from locatk.formats.benchmarks import Figure

SEED = 20_000
"""First of the seeds that belong to benches; nothing is tuned on them."""


def cpu_seconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Least processor time of several runs: what one core needs, whoever else is busy."""
    best = math.inf
    for _ in range(repeats):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def alone(call: str) -> list[float]:
    """Numbers that a function of a bench measures in a process of its own, with one thread.

    Parameters
    ----------
    call : str
        An expression after ``locatk.formats.benchmarks.``, as in ``"dots.printing.memory()"``.

    Raises
    ------
    OSError
        It failed; the message is the last line that it said.
    """
    path = re.match(r"[\w.]+", call)
    assert path is not None
    module, _, name = path[0].rpartition(".")
    expression = call.removeprefix(f"{module}.")
    code = f"from locatk.formats.benchmarks.{module} import {name}; print(*{expression})"
    threads = ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM", "OPENCV_FOR")
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **{f"{name}_NUM_THREADS": "1" for name in threads}},
    )
    if run.returncode:
        raise OSError((run.stderr.strip().splitlines() or ["no answer"])[-1])
    return [float(word) for word in run.stdout.split()]


def measured(
    name: str,
    unit: str,
    call: str,
    factor: float,
    how: str,
    target: float | None,
    better: Literal["lower", "higher"] = "lower",
    peer: str | None = None,
    peer_value: float | None = None,
) -> Figure:
    """The last number of :func:`alone`, times ``factor``; ``{0}`` in ``how`` is the first."""
    try:
        numbers = alone(call)
    except OSError as error:
        return Figure(name, None, unit, f"not measured: {error}", target, better, peer, peer_value)
    value = factor * numbers[-1]
    return Figure(name, value, unit, how.format(*numbers), target, better, peer, peer_value)
