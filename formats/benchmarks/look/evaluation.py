"""The figures of ``locatk eval`` beside evo: the same numbers, and how much faster.

evo (GPL) is run as a program of its own, in the Python that it is installed in.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from locatk.core.evaluation import EvaluationOptions, evaluate
from locatk.core.geometry import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
)
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import SEED, cpu_seconds
from locatk.formats.exporters.tum import write_tum
from locatk.formats.importers.tum import read_tum

POSES = 100_000
COMPARED = 5_000
RATE_HZ = 100.0

STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")

ALIGNMENTS = {"none": [], "se3": ["-a"], "sim3": ["-as"], "origin": ["--align_origin"]}
"""Ours, and evo's options for the same."""

PARTS = {"trans_part": "translation_m", "angle_deg": "rotation_deg"}

SAME = "eval: largest difference to evo"
COMMAND = "eval: evo_ape -a and evo_rpe, by locatk eval"
ALL = "eval: evo's four commands for our four tables, by locatk eval"
INSIDE = "eval: evo's association, alignment, APE and RPE, by ours, in process"
OWN = "eval: 100,000 poses, in process"

IN_EVO = """
import sys, time
from evo.core import metrics, sync
from evo.tools import file_interface
true = file_interface.read_tum_trajectory_file(sys.argv[1])
mine = file_interface.read_tum_trajectory_file(sys.argv[2])
start = time.process_time()
true, mine = sync.associate_trajectories(true, mine, max_diff=0.01)
mine.align(true)
for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
    for metric in (metrics.APE(relation), metrics.RPE(relation, 1, metrics.Unit.frames)):
        metric.process_data((true, mine))
        metric.get_all_statistics()
print(time.process_time() - start)
"""
"""The same work by evo's interface for Python, reading left out; prints seconds."""


@dataclass(frozen=True)
class Evo:
    """Where evo's programs are."""

    ape: str
    rpe: str

    @classmethod
    def find(cls) -> Evo | None:
        """In $LOCATK_EVO or on PATH; None where they are not."""
        folder = os.environ.get("LOCATK_EVO")
        ape, rpe = (shutil.which(f"evo_{name}", path=folder or None) for name in ("ape", "rpe"))
        return cls(ape, rpe) if ape and rpe else None

    @property
    def python(self) -> str | None:
        """The Python beside them, which can import evo."""
        return shutil.which("python", path=str(Path(self.ape).parent))


def figures(data: Path) -> list[Figure]:
    """Figures of ``locatk eval``; none needs published data. Two minutes with evo, else 2 s."""
    evo = Evo.find()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, POSES)
        own = _own(folder)
        rows = [
            Figure(OWN, own, "s", "association, alignment se3, APE, RPE, drift of poses in "
                   "memory, translation and rotation; processor time, best of 5", 0.2)
        ]  # fmt: skip
        if evo is None:
            why = "not measured: evo is neither on PATH nor in $LOCATK_EVO (pip install evo)"
            return [
                Figure(SAME, None, "m, deg", why, 5e-7),
                Figure(COMMAND, None, "ratio", why, None, "higher"),
                Figure(ALL, None, "ratio", why, None, "higher"),
                Figure(INSIDE, None, "ratio", why, 100.0, "higher"),
                *rows,
            ]
        return [_difference(evo, folder), *_commands(evo, folder), _inside(evo, folder, own), *rows]


def write(folder: Path, n: int) -> None:
    """``truth.tum`` and ``estimate.tum``: noisy, elsewhere, their stamps 2 ms off and less."""
    rng = np.random.default_rng(SEED)
    t = np.arange(n) / RATE_HZ
    position = np.stack(
        [5 * np.sin(0.1 * t), 4 * np.cos(0.061 * t) + 0.01 * t, 0.5 * np.sin(0.037 * t)], axis=1
    )
    turned = np.stack([0.3 * np.sin(0.2 * t), 0.2 * np.cos(0.1 * t), 0.1 * t], axis=1)
    quaternion = quaternion_from_matrix(rotation_exp(turned))
    stamps = 1_690_218_696_000_000_000 + np.round(t * 1e9).astype(np.int64)
    unknown = np.broadcast_to(np.nan, (n, 6, 6))
    truth = Trajectory("robot", "floor", stamps, position, quaternion, unknown)
    away = rotation_exp(np.array([0.1, -0.2, 0.7]))
    noise = rotation_exp(rng.normal(0, 0.01, (n, 3)))
    estimate = Trajectory(
        "robot",
        "floor",
        stamps + rng.integers(-2_000_000, 2_000_000, n),
        (position + rng.normal(0, 0.01, (n, 3))) @ away.T + [1.0, 2.0, 3.0],
        quaternion_from_matrix(away @ noise @ matrix_from_quaternion(quaternion)),
        unknown,
    )
    write_tum(folder / "truth.tum", truth, overwrite=True)
    write_tum(folder / "estimate.tum", estimate, overwrite=True)


def _own(folder: Path) -> float:
    truth = read_tum(folder / "truth.tum")
    estimate = read_tum(folder / "estimate.tum")
    options = EvaluationOptions(align="se3", match="nearest")
    return cpu_seconds(lambda: evaluate([(estimate, truth)], options))


def _difference(evo: Evo, folder: Path) -> Figure:
    """Over all statistics of APE and RPE under four alignments."""
    small = folder / "small"
    small.mkdir()
    write(small, COMPARED)
    truth, estimate = small / "truth.tum", small / "estimate.tum"
    largest, count = 0.0, 0
    for align, options in ALIGNMENTS.items():
        said = evaluate(
            [(read_tum(estimate), read_tum(truth))],
            EvaluationOptions(align=align, match="nearest"),
        ).as_dict()
        for metric, program in (("ape", evo.ape), ("rpe", evo.rpe)):
            for relation, part in PARTS.items():
                result = small / "result.zip"
                result.unlink(missing_ok=True)
                command = [program, "tum", str(truth), str(estimate), "-r", relation, *options]
                _seconds([*command, "--save_results", str(result)])
                with zipfile.ZipFile(result) as archive:
                    theirs = json.loads(archive.read("stats.json"))
                for name in STATISTICS:
                    largest = max(largest, abs(said[metric][part][name] - theirs[name]))
                    count += 1
    how = f"{count} statistics of {COMPARED} poses: APE and RPE of 1 frame, {', '.join(ALIGNMENTS)}"
    return Figure(SAME, largest, "m, deg", how, 5e-7)


def _commands(evo: Evo, folder: Path) -> list[Figure]:
    """Whole commands, from files to figures; evo's once, ours the best of 3."""
    truth, estimate = str(folder / "truth.tum"), str(folder / "estimate.tum")
    ours = [sys.executable, "-m", "locatk.cli", "eval", estimate, "--truth", truth]
    own = min(_seconds([*ours, "--align", "se3", "--json"]) for _ in range(3))
    theirs = {
        (metric, relation): _seconds([program, "tum", truth, estimate, "-a", "-r", relation])
        for metric, program in (("ape", evo.ape), ("rpe", evo.rpe))
        for relation in PARTS
    }
    two = theirs["ape", "trans_part"] + theirs["rpe", "trans_part"]
    four = sum(theirs.values())
    how = f"{POSES:,} poses; start-up and reading two TUM files of 16 MB included; processor time"
    return [
        Figure(COMMAND, two / own, "ratio",
               f"{two:.1f} s by {own:.2f} s, which gives rotation and drift as well; {how}",
               None, "higher", peer="evo", peer_value=1.0),
        Figure(ALL, four / own, "ratio",
               f"{four:.1f} s by {own:.2f} s: APE and RPE of translation and rotation; {how}",
               None, "higher", peer="evo", peer_value=1.0),
    ]  # fmt: skip


def _inside(evo: Evo, folder: Path, own: float) -> Figure:
    if evo.python is None:
        return Figure(INSIDE, None, "ratio", "not measured: no Python beside evo", 100.0, "higher")
    command = [evo.python, "-c", IN_EVO, str(folder / "truth.tum"), str(folder / "estimate.tum")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    theirs = float(done.stdout.split()[-1])
    return Figure(INSIDE, theirs / own, "ratio",
                  f"{theirs:.1f} s by {own:.3f} s: association, se3, APE and RPE of translation "
                  f"and rotation, {POSES:,} poses in memory; ours with drift and coverage",
                  100.0, "higher", peer="evo", peer_value=1.0)  # fmt: skip


def _seconds(command: list[str]) -> float:
    """Processor time of a command and its children, with one thread."""
    threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    before = os.times()
    start = time.perf_counter()
    environment = {**os.environ, **threads, "MPLBACKEND": "Agg"}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    after = os.times()
    spent = after.children_user + after.children_system
    spent -= before.children_user + before.children_system
    # Windows tells no time of children.
    return spent or time.perf_counter() - start
