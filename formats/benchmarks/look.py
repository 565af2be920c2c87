"""Figures of ``locatk bench look``: evaluation compared with evo, reports, the demo, and batches.

evo is run as a program, in the Python in which it is installed: it is under the GPL and is never
imported here.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
import time
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from locatk.core.evaluation import EvaluationOptions, evaluate
from locatk.core.geometry import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
)
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    run_command,
    time_call,
    time_command,
)
from locatk.formats.exporters.tum import write_tum
from locatk.formats.importers.poses.tum import read_tum
from locatk.formats.pipeline.execution import SINGLE_THREAD_ENVIRONMENT

LOCATK = (sys.executable, "-m", "locatk.cli")

EVALUATED_POSES = 100_000
COMPARED_POSES = 5_000
POSE_RATE_HZ = 100.0

STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")

EVO_ALIGNMENTS = {"none": [], "se3": ["-a"], "sim3": ["-as"], "origin": ["--align_origin"]}
"""Alignments of ``locatk eval``, and the options of evo for the same."""

EVO_RELATIONS = {"trans_part": "translation_m", "angle_deg": "rotation_deg"}
"""Relations of evo, and the keys of the same errors in our report."""

EVO_IN_PROCESS = """
import sys, time
from evo.core import metrics, sync
from evo.tools import file_interface
reference = file_interface.read_tum_trajectory_file(sys.argv[1])
estimate = file_interface.read_tum_trajectory_file(sys.argv[2])
start = time.process_time()
reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=0.01)
estimate.align(reference)
for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
    for metric in (metrics.APE(relation), metrics.RPE(relation, 1, metrics.Unit.frames)):
        metric.process_data((reference, estimate))
        metric.get_all_statistics()
print(time.process_time() - start)
"""
"""Program that evaluates two TUM files by evo's Python interface and prints the seconds without
reading."""

REPORT_POSES = 10_000
BATCH_SESSIONS = 8
BATCH_JOBS = 2


def figures(data: Path) -> list[Figure]:
    """Return all figures; none needs published data. About three minutes, on a quiet machine."""
    with tempfile.TemporaryDirectory(prefix="locatk-bench-") as name:
        folders = []
        for part in ("evaluation", "report", "demo", "batch"):
            folder = Path(name, part)
            folder.mkdir()
            folders.append(folder)
        evaluation, report, demo, batch = folders
        return [
            *evaluation_figures(evaluation),
            *report_figures(report),
            demo_figure(demo),
            *batch_figures(batch),
        ]


# ---- evaluation


@dataclass(frozen=True)
class Evo:
    """Programs of evo."""

    ape: str
    rpe: str

    @classmethod
    def find(cls) -> Evo | None:
        """Return the programs in $LOCATK_EVO or on PATH, or None."""
        folder = os.environ.get("LOCATK_EVO")
        ape, rpe = (shutil.which(f"evo_{name}", path=folder or None) for name in ("ape", "rpe"))
        return cls(ape, rpe) if ape and rpe else None

    @property
    def python(self) -> str | None:
        """Python in the same folder, which can import evo."""
        return shutil.which("python", path=str(Path(self.ape).parent))


def evaluation_figures(folder: Path) -> list[Figure]:
    """Compare the results and the duration of ``locatk eval`` with those of evo, if installed."""
    difference = Figure("eval: largest difference to evo", None, "m, deg", "", 5e-7)
    two = Figure("eval: evo_ape -a and evo_rpe, by locatk eval", None, "ratio", "",
                 better="higher", peer="evo", peer_value=1.0)  # fmt: skip
    four = Figure("eval: evo's four commands for our four tables, by locatk eval", None, "ratio",
                  "", better="higher", peer="evo", peer_value=1.0)  # fmt: skip
    in_process = Figure("eval: evo's association, alignment, APE and RPE, by ours, in process",
                        None, "ratio", "", 100.0, "higher", "evo", 1.0)  # fmt: skip
    write_trajectories(folder, EVALUATED_POSES)
    truth, estimate = (read_tum(folder / f"{name}.tum") for name in ("truth", "estimate"))
    options = EvaluationOptions(align="se3", match="nearest")
    own = time_call(lambda: evaluate([(estimate, truth)], options))
    own_figure = Figure(
        "eval: 100,000 poses, in process", None, "s",
        "association, alignment se3, APE, RPE, drift of poses in memory, translation and "
        "rotation; processor time, best of 5", 0.2, workload="numpy",
    ).timed(own)  # fmt: skip
    evo = Evo.find()
    if evo is None:
        reason = "evo is neither on PATH nor in $LOCATK_EVO (pip install evo)"
        compared = (difference, two, four, in_process)
        return [*(figure.missing(reason) for figure in compared), own_figure]
    return [
        _compare_statistics(difference, evo, folder / "small"),
        *_compare_commands(two, four, evo, folder),
        _compare_in_process(in_process, evo, folder, own.seconds),
        own_figure,
    ]


def write_trajectories(folder: Path, n: int) -> None:
    """Write ``truth.tum`` and ``estimate.tum`` with ``n`` poses.

    The estimate is noisy, in another frame, and its stamps differ by up to 2 ms.
    """
    rng = np.random.default_rng(FIRST_SEED)
    t = np.arange(n) / POSE_RATE_HZ
    position = np.stack(
        [5 * np.sin(0.1 * t), 4 * np.cos(0.061 * t) + 0.01 * t, 0.5 * np.sin(0.037 * t)], axis=1
    )
    rotation_vectors = np.stack([0.3 * np.sin(0.2 * t), 0.2 * np.cos(0.1 * t), 0.1 * t], axis=1)
    quaternion = quaternion_from_matrix(rotation_exp(rotation_vectors))
    stamps = 1_690_218_696_000_000_000 + np.round(t * 1e9).astype(np.int64)
    unknown = np.broadcast_to(np.nan, (n, 6, 6))
    truth = Trajectory("robot", "floor", stamps, position, quaternion, unknown)
    frame_rotation = rotation_exp(np.array([0.1, -0.2, 0.7]))
    noise = rotation_exp(rng.normal(0, 0.01, (n, 3)))
    estimate = Trajectory(
        "robot",
        "floor",
        stamps + rng.integers(-2_000_000, 2_000_000, n),
        (position + rng.normal(0, 0.01, (n, 3))) @ frame_rotation.T + [1.0, 2.0, 3.0],
        quaternion_from_matrix(frame_rotation @ noise @ matrix_from_quaternion(quaternion)),
        unknown,
    )
    write_tum(folder / "truth.tum", truth, overwrite=True)
    write_tum(folder / "estimate.tum", estimate, overwrite=True)


def _compare_statistics(figure: Figure, evo: Evo, folder: Path) -> Figure:
    """Compare all statistics of APE and RPE under four alignments."""
    folder.mkdir()
    write_trajectories(folder, COMPARED_POSES)
    truth, estimate, result = (
        folder / name for name in ("truth.tum", "estimate.tum", "result.zip")
    )
    differences = []
    for align, options in EVO_ALIGNMENTS.items():
        report = evaluate(
            [(read_tum(estimate), read_tum(truth))],
            EvaluationOptions(align=align, match="nearest"),
        ).as_dict()
        for metric, program in (("ape", evo.ape), ("rpe", evo.rpe)):
            for relation, part in EVO_RELATIONS.items():
                result.unlink(missing_ok=True)
                command = [program, "tum", str(truth), str(estimate), "-r", relation, *options]
                run_command([*command, "--save_results", str(result)], {"MPLBACKEND": "Agg"})
                with zipfile.ZipFile(result) as archive:
                    by_evo = json.loads(archive.read("stats.json"))
                differences += [abs(report[metric][part][s] - by_evo[s]) for s in STATISTICS]
    how = (
        f"{len(differences)} statistics of {COMPARED_POSES} poses: APE and RPE of 1 frame, "
        f"{', '.join(EVO_ALIGNMENTS)}"
    )
    return replace(figure, value=max(differences), how=how)


def _compare_commands(two: Figure, four: Figure, evo: Evo, folder: Path) -> list[Figure]:
    """Time whole commands, from files to statistics: evo's once, ours as the best of 3."""
    truth, estimate = str(folder / "truth.tum"), str(folder / "estimate.tum")
    command = [*LOCATK, "eval", estimate, "--truth", truth, "--align", "se3", "--json"]
    own_s = time_command(command, 3).seconds
    evo_s = {
        (metric, relation): time_command([program, "tum", truth, estimate, "-a", "-r", relation])[0]
        for metric, program in (("ape", evo.ape), ("rpe", evo.rpe))
        for relation in EVO_RELATIONS
    }
    two_s = evo_s["ape", "trans_part"] + evo_s["rpe", "trans_part"]
    four_s = sum(evo_s.values())
    how = (
        f"{EVALUATED_POSES:,} poses; start-up and reading two TUM files of 16 MB included; "
        "processor time"
    )
    return [
        replace(two, value=two_s / own_s, how=f"{two_s:.1f} s by {own_s:.2f} s, which gives "
                f"rotation and drift as well; {how}"),
        replace(four, value=four_s / own_s, how=f"{four_s:.1f} s by {own_s:.2f} s: APE and RPE "
                f"of translation and rotation; {how}"),
    ]  # fmt: skip


def _compare_in_process(figure: Figure, evo: Evo, folder: Path, own_s: float) -> Figure:
    if evo.python is None:
        return figure.missing("no Python in the folder of evo")
    files = (str(folder / "truth.tum"), str(folder / "estimate.tum"))
    output = run_command([evo.python, "-c", EVO_IN_PROCESS, *files], SINGLE_THREAD_ENVIRONMENT)
    evo_s = float(output.split()[-1])
    how = (
        f"{evo_s:.1f} s by {own_s:.3f} s: association, se3, APE and RPE of translation and "
        f"rotation, {EVALUATED_POSES:,} poses in memory; ours with drift and coverage"
    )
    return replace(figure, value=evo_s / own_s, how=how)


# ---- commands


def run_locatk(folder: Path, *arguments: object) -> str:
    """Run a command in a folder and return its standard output.

    Raises
    ------
    OSError
        The command failed; the message is the last line of its errors.
    """
    return run_command([*LOCATK, *map(str, arguments)], folder=str(folder))


def _simulate_run(folder: Path, name: str, seed: int) -> None:
    options = ("--robots", 10, "--duration", 108, "--seed", seed)
    run_locatk(folder, "simulate", "lighthouse", "-o", name, *options)


def report_figures(folder: Path) -> list[Figure]:
    """Time a report of :data:`REPORT_POSES` poses with truth and raw signals."""
    _simulate_run(folder, "run.mcap", FIRST_SEED)
    summary = run_locatk(folder, "solve", "run.mcap", "-o", "solved.mcap", "--json")
    poses = json.loads(summary)["sessions"][0]["poses"]
    command = [*LOCATK, "report", "solved.mcap", "--overwrite", "-o", "report.html"]
    duration = time_command(command, 3, str(folder))
    size_mb = (folder / "report.html").stat().st_size / 1e6
    how = f"lighthouse, 10 robots, {poses} poses, with truth and sweeps"
    return [
        Figure(f"report of {REPORT_POSES:,} poses: time", None, "s",
               f"{how}; processor time of the command, start-up included, best of 3", 3.0,
               workload="Python").timed(duration),
        Figure(f"report of {REPORT_POSES:,} poses: size", size_mb, "MB", f"{how}; with plotly",
               12.0),
    ]  # fmt: skip


def demo_figure(folder: Path) -> Figure:
    """Time ``locatk demo`` of all four systems."""
    how = (
        "simulates, solves by two methods, evaluates and reports four systems; processor time of "
        "the command"
    )
    figure = Figure("demo: time", None, "s", how, 60.0, workload="Python")
    return figure.timed(time_command([*LOCATK, "demo"], folder=str(folder)))


def batch_figures(folder: Path) -> list[Figure]:
    """Compare a batch in several processes with the same batch in one."""
    names = [f"run-{k}.mcap" for k in range(BATCH_SESSIONS)]
    for k, name in enumerate(names):
        _simulate_run(folder, name, FIRST_SEED + k)
    walls_s = []
    for output, jobs in (("single", 1), ("parallel", BATCH_JOBS)):
        start = time.perf_counter()
        run_locatk(folder, "solve", *names, "-o", output, "--jobs", jobs)
        walls_s.append(time.perf_counter() - start)
    single_s, parallel_s = walls_s
    differing = sum(
        (folder / "single" / name).read_bytes() != (folder / "parallel" / name).read_bytes()
        for name in names
    )
    how = (
        f"{len(names)} sessions, --jobs 1 in {single_s:.1f} s, --jobs {BATCH_JOBS} in "
        f"{parallel_s:.1f} s, wall time"
    )
    return [
        Figure("batch: two processes over one", single_s / parallel_s, "x", how, better="higher"),
        Figure("batch: outputs that differ with --jobs", differing, "files", how, 0.0),
    ]
