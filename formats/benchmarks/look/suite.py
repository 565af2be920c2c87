"""The figures of ``locatk bench look``: judged as evo judges, reported and shown at once."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.look.evaluation import figures as eval_figures
from locatk.formats.benchmarks.timing import SEED

POSES = 10_000

JOBS = 2


def figures(data: Path) -> list[Figure]:
    """All figures; none needs published data. About three minutes, on a quiet machine."""
    with tempfile.TemporaryDirectory(prefix="locatk-bench-") as folder:
        place = Path(folder)
        return [
            *eval_figures(data),
            *_report(place / "report"),
            _demo(place / "demo"),
            *_batch(place / "batch"),
        ]


def _locatk(place: Path, *words: object) -> tuple[str, float]:
    """What a command says on stdout, and the seconds that it takes, start-up included.

    Raises
    ------
    OSError
        It failed; the message is the last line that it said.
    """
    start = time.perf_counter()
    run = subprocess.run(
        [sys.executable, "-m", "locatk.cli", *map(str, words)],
        capture_output=True,
        text=True,
        cwd=place,
    )
    took_s = time.perf_counter() - start
    if run.returncode:
        raise OSError((run.stderr.strip().splitlines() or ["no answer"])[-1])
    return run.stdout, took_s


def _report(place: Path) -> list[Figure]:
    """Wall time and size of a report of :data:`POSES` poses with truth and raw signals."""
    place.mkdir()
    options = ("--robots", 10, "--duration", 108, "--seed", SEED)
    _locatk(place, "simulate", "lighthouse", "-o", "run.mcap", *options)
    answer, _ = _locatk(place, "solve", "run.mcap", "-o", "solved.mcap", "--json")
    poses = json.loads(answer)["sessions"][0]["poses"]
    report = ("report", "solved.mcap", "--overwrite", "-o", "report.html")
    took_s = min(_locatk(place, *report)[1] for _ in range(3))
    size_mb = (place / "report.html").stat().st_size / 1e6
    how = f"lighthouse, 10 robots, {poses} poses, truth and sweeps beside them"
    return [
        Figure(
            f"report of {POSES:,} poses: time", took_s, "s", f"{how}; start-up included", target=3
        ),
        Figure(
            f"report of {POSES:,} poses: size", size_mb, "MB", f"{how}; plotly in it", target=12
        ),
    ]


def _demo(place: Path) -> Figure:
    """Wall time of ``locatk demo``, all four systems."""
    place.mkdir()
    _, took_s = _locatk(place, "demo")
    how = "simulates, solves by two methods, evaluates and reports four systems"
    return Figure("demo: time", took_s, "s", how, target=60)


def _batch(place: Path) -> list[Figure]:
    """What several processes bring, and that they change nothing."""
    place.mkdir()
    names = [f"run-{k}.mcap" for k in range(8)]
    for k, name in enumerate(names):
        options = ("--robots", 10, "--duration", 108, "--seed", SEED + k)
        _locatk(place, "simulate", "lighthouse", "-o", name, *options)
    _, alone_s = _locatk(place, "solve", *names, "-o", "alone", "--jobs", 1)
    _, shared_s = _locatk(place, "solve", *names, "-o", "shared", "--jobs", JOBS)
    differing = sum(
        (place / "alone" / name).read_bytes() != (place / "shared" / name).read_bytes()
        for name in names
    )
    how = f"{len(names)} sessions, --jobs 1 in {alone_s:.1f} s, --jobs {JOBS} in {shared_s:.1f} s"
    return [
        Figure("batch: two processes over one", alone_s / shared_s, "x", how, better="higher"),
        Figure("batch: outputs that differ with --jobs", differing, "files", how, target=0),
    ]
