"""Durations of calls, and the speed of the machine at the time of the measurement.

The same commit is up to three times as fast on one machine as on another, and a busy neighbour
changes durations within seconds. Two fixed workloads are therefore timed in turn with each call:
``numpy`` (batched normal equations of small problems, as the solvers form them, and new memory)
and ``Python`` (loops over dictionaries and attributes). The machine factor is the duration of a
workload over that on the reference machine, an AMD EPYC 9004 (Zen 4, 2.6 GHz, a virtual machine
with two processors, Python 3.11, numpy 2.4). Targets of durations are multiplied by it.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from locatk.formats.benchmarks.figures import Duration, Figure, Workload
from locatk.formats.pipeline.execution import SINGLE_THREAD_ENVIRONMENT

FIRST_SEED = 20_000
"""First seed of the benchmarks; no parameter is tuned on these seeds."""

SAMPLE_S = 0.05
"""Duration of one sample of a workload; ten time slices of the scheduler."""

# ---- workloads


def solve_normal_equations() -> None:
    """Form and solve 2,000 least-squares problems, then fill and sum a large new array.

    The problems have 24 residuals and 6 unknowns and stay in the cache. The array of 36 MB is
    larger than blocks that the allocator keeps, so that its pages are always requested anew.
    """
    angle = np.linspace(0.0, 6.0, 100 * 24 * 6).reshape(100, 24, 6)
    for _ in range(20):
        jacobian = np.sin(angle)
        transposed = jacobian.swapaxes(1, 2)
        gradient = transposed @ np.cos(angle[..., :1])
        np.linalg.solve(transposed @ jacobian + np.eye(6), gradient)
    np.full(4_500_000, 0.5).sum()


@dataclass
class _Counter:
    count: int = 0
    total: float = 0.0

    def add(self, value: float) -> None:
        self.count += 1
        self.total += value


def count_in_dictionary() -> None:
    """Count 6,000 numbers by their remainder in a dictionary of objects."""
    counters: dict[str, _Counter] = {}
    for number in range(6_000):
        key = f"k{number % 97}"
        counter = counters.get(key)
        if counter is None:
            counter = counters[key] = _Counter()
        counter.add(0.5 * number)
    sorted(counters.values(), key=lambda counter: counter.total)


WORKLOADS: dict[Workload, tuple[Callable[[], None], float]] = {
    "numpy": (solve_normal_equations, 9.2e-3),
    "Python": (count_in_dictionary, 1.2e-3),
}
"""Workloads and their durations in seconds on the reference machine."""


def machine_factor(workload: Workload, clock: Callable[[], float] = time.process_time) -> float:
    """Return the mean duration of a workload now, over that on the reference machine."""
    run, reference_s = WORKLOADS[workload]
    start, rounds = clock(), 0
    while rounds == 0 or clock() - start < SAMPLE_S:
        run()
        rounds += 1
    return (clock() - start) / rounds / reference_s


def machine_figures() -> list[Figure]:
    """Return the factors of both workloads, smallest of ten samples."""
    return [
        Figure(
            f"machine factor, {workload}",
            min(machine_factor(workload) for _ in range(10)),
            "ratio",
            f"processor time of a fixed {workload} workload over that on an AMD EPYC 9004 "
            f"({1e3 * reference_s:.2f} ms)",
            peer="reference machine",
            peer_value=1.0,
        )
        for workload, (_, reference_s) in WORKLOADS.items()
    ]


# ---- durations


def time_call(
    call: Callable[[], object],
    repeats: int = 5,
    workload: Workload = "numpy",
    clock: Callable[[], float] = time.process_time,
) -> Duration:
    """Return the shortest duration of several calls, with the machine factor.

    The workload is timed before each call, by the same clock: by default the processor time of
    this process, which excludes the time of other processes.
    """
    factors, durations = [], []
    for _ in range(repeats):
        factors.append(machine_factor(workload, clock))
        start = clock()
        call()
        durations.append(clock() - start)
    return Duration(min(durations), min(factors))


def time_each(
    calls: Sequence[Callable[[], object]], repeats: int = 1, workload: Workload = "numpy"
) -> tuple[list[float], float]:
    """Return the shortest processor time of each call, and the machine factor of all.

    The workload is timed in turn with the calls, about once for each :data:`SAMPLE_S` of them.
    """
    factors, durations = [machine_factor(workload)], []
    unsampled_s = 0.0
    for call in calls:
        shortest = math.inf
        for _ in range(repeats):
            start = time.process_time()
            call()
            duration = time.process_time() - start
            shortest, unsampled_s = min(shortest, duration), unsampled_s + duration
        durations.append(shortest)
        if unsampled_s > SAMPLE_S:
            factors.append(machine_factor(workload))
            unsampled_s = 0.0
    return durations, float(np.median(factors))


# ---- processes


def run_single_threaded(call: str) -> list[float]:
    """Return the numbers that a function of a benchmark returns in a process with one thread.

    Parameters
    ----------
    call : str
        Expression after ``locatk.formats.benchmarks.``, as in ``"dots.printing.measure_memory()"``.

    Raises
    ------
    OSError
        The call failed; the message is the last line of its errors.
    """
    path = cast(re.Match[str], re.match(r"[\w.]+", call))
    module, _, name = path[0].rpartition(".")
    expression = call.removeprefix(f"{module}.")
    code = f"from locatk.formats.benchmarks.{module} import {name}; print(*{expression})"
    command = [sys.executable, "-c", code]
    return [float(word) for word in run_command(command, SINGLE_THREAD_ENVIRONMENT).split()]


def peak_memory_mb() -> float:
    """Return the largest memory [MB] of this process until now.

    Raises
    ------
    OSError
        The system does not report it.
    """
    # The value of getrusage includes the memory of the parent before the program was started.
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise OSError("no VmHWM in /proc/self/status")


def time_command(command: Sequence[str], repeats: int = 1, folder: str | None = None) -> Duration:
    """Return the shortest processor time of a program and its children, with one thread.

    Windows does not report the time of children; the wall time is returned instead.
    """
    factors, durations = [], []
    for _ in range(repeats):
        factors.append(machine_factor("Python"))
        start = os.times()
        run_command(command, SINGLE_THREAD_ENVIRONMENT | {"MPLBACKEND": "Agg"}, folder)
        end = os.times()
        user_s = end.children_user - start.children_user
        system_s = end.children_system - start.children_system
        durations.append(user_s + system_s or end.elapsed - start.elapsed)
    return Duration(min(durations), min(factors))


def run_command(
    command: Sequence[str], environment: dict[str, str] | None = None, folder: str | None = None
) -> str:
    """Run a program and return its standard output.

    Raises
    ------
    OSError
        The program failed; the message is the last line of its errors.
    """
    process = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env={**os.environ, **(environment or {})},
        cwd=folder,
    )
    if process.returncode:
        raise OSError((process.stderr.strip().splitlines() or ["no message"])[-1])
    return process.stdout


def measure_single_threaded(figure: Figure, call: str, amount: float = 1.0) -> Figure:
    """Complete a figure by a call in a process with one thread.

    The call returns numbers that ``figure.how`` may contain as ``{0}``, ``{1}``; the last two are
    a :class:`Duration` if the figure has a workload, otherwise the last one is the value.
    ``amount`` is that of :meth:`Figure.timed`.
    """
    try:
        numbers = run_single_threaded(call)
    except OSError as error:
        return figure.missing(error)
    if figure.workload is None:
        numbers.append(math.nan)
    *_, value, factor = numbers
    described = replace(figure, how=figure.how.format(*numbers))
    if figure.workload is None:
        return replace(described, value=amount * value)
    return described.timed(Duration(value, factor), amount)
