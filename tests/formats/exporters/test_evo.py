"""The same figures as evo, run as a program beside ours on the same files.

evo (GPL) is never imported; the tests are skipped where its programs are neither on PATH nor
in the folder $LOCATK_EVO.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from locatk.core.geometry import quaternion_from_matrix, rotation_exp
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.kitti import write_kitti
from locatk.formats.exporters.tum import write_tum

EPOCH = 1_690_218_696_000_000_000
STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")
ALIGNMENTS = {"none": [], "se3": ["-a"], "sim3": ["-as"], "origin": ["--align_origin"]}
SIX_DECIMALS = 5e-7


def program(name: str) -> str:
    """Where a program of evo is; the test is skipped where it is not."""
    folder = os.environ.get("LOCATK_EVO")
    found = shutil.which(name, path=folder) if folder else shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is neither on PATH nor in $LOCATK_EVO (pip install evo)")
    return found


Evo = Callable[..., dict[str, float]]


@pytest.fixture
def evo(tmp_path: Path) -> Evo:
    """``evo("ape", "tum", truth, estimate, ...)`` gives the statistics to the last digit."""

    def run(metric: str, *arguments: object) -> dict[str, float]:
        result = tmp_path / "evo.zip"
        result.unlink(missing_ok=True)
        command = [program(f"evo_{metric}"), *map(str, arguments), "--save_results", str(result)]
        home = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
        done = subprocess.run(command, capture_output=True, text=True, env=home, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        with zipfile.ZipFile(result) as archive:
            return dict(json.loads(archive.read("stats.json")))

    return run


def poses(
    time_s: np.ndarray, *, seed: int | None = None, scale: float = 1.0, late_s: float = 0.0
) -> Trajectory:
    """Poses on a way through space; with a seed as an estimate sees them, elsewhere and noisy."""
    t = np.asarray(time_s)
    position = np.stack([3 * np.sin(0.4 * t), 2 * np.cos(0.31 * t) + 0.1 * t, np.sin(0.2 * t)], -1)
    rotation = rotation_exp(np.stack([0.3 * np.sin(t), 0.2 * np.cos(0.7 * t), 0.25 * t], -1))
    if seed is not None:
        rng = np.random.default_rng(seed)
        turn = rotation_exp(np.array([0.2, -0.3, 1.1]))
        position = (position + rng.normal(0, 0.02, position.shape)) @ turn.T / scale + [5, -2, 1]
        rotation = turn @ rotation @ rotation_exp(rng.normal(0, 0.03, position.shape))
    stamps = EPOCH + np.round((t - late_s) * 1e9).astype(np.int64)
    quaternion = quaternion_from_matrix(rotation)
    return Trajectory("r", "f", stamps, position, quaternion, np.full((len(t), 6, 6), np.nan))


def files(folder: Path, kind: str, case: str) -> tuple[Path, Path]:
    """Estimate and truth, whose stamps differ as ``case`` says."""
    rng = np.random.default_rng(5)
    time = np.arange(0, 40, 0.1)
    mine = true = time
    if case == "jitter":
        mine = time + rng.uniform(-0.012, 0.012, len(time))
    elif case == "faster truth":
        true = np.arange(-1, 30, 0.008)
    elif case == "slower truth":
        true, mine = np.arange(3, 50, 0.25), np.arange(0, 40, 0.02)
    elif case == "half-way":  # ties, and differences of just the largest that is allowed
        true, mine = np.arange(0, 30, 0.02), np.arange(0.01, 30, 0.02)
    late_s = 0.35 if case == "late" else 0.0
    estimate, truth = folder / f"estimate.{kind}", folder / f"truth.{kind}"
    write = write_tum if kind == "tum" else write_kitti
    write(estimate, poses(mine, seed=1, scale=1.7, late_s=late_s))
    write(truth, poses(true))
    return estimate, truth


def same(ours: dict[str, float], theirs: dict[str, float]) -> None:
    """All statistics to six decimals, and to rounding where they are large."""
    for name in STATISTICS:
        assert ours[name] == pytest.approx(theirs[name], abs=SIX_DECIMALS, rel=1e-12), name


def ours(locatk, estimate: Path, truth: Path, *more: object) -> dict:
    result = locatk("eval", estimate, "--truth", truth, "--json", *more)
    assert result.exit_code == 0, result.stderr
    return dict(json.loads(result.stdout))


@pytest.mark.parametrize(
    ("kind", "align"), [*(("tum", align) for align in ALIGNMENTS), ("kitti", "sim3")]
)
def test_alignments(locatk, evo: Evo, tmp_path: Path, kind: str, align: str) -> None:
    estimate, truth = files(tmp_path, kind, "jitter" if kind == "tum" else "even")
    found = ours(locatk, estimate, truth, "--align", align)
    for relation, part in (("trans_part", "translation_m"), ("angle_deg", "rotation_deg")):
        for metric in ("ape", "rpe"):
            theirs = evo(metric, kind, truth, estimate, "-r", relation, *ALIGNMENTS[align])
            same(found[metric][part], theirs)


@pytest.mark.parametrize("case", ["faster truth", "slower truth", "half-way"])
def test_association(locatk, evo: Evo, tmp_path: Path, case: str) -> None:
    estimate, truth = files(tmp_path, "tum", case)
    found = ours(locatk, estimate, truth, "--align", "sim3")
    same(found["ape"]["translation_m"], evo("ape", "tum", truth, estimate, "-as"))
    same(found["rpe"]["translation_m"], evo("rpe", "tum", truth, estimate, "-as"))


def test_offset_and_largest_difference(locatk, evo: Evo, tmp_path: Path) -> None:
    estimate, truth = files(tmp_path, "tum", "late")
    found = ours(locatk, estimate, truth, "--align", "se3", "--offset", 0.349, "--max-diff", 0.002)
    more = ("--t_offset", 0.349, "--t_max_diff", 0.002)
    same(found["ape"]["translation_m"], evo("ape", "tum", truth, estimate, "-a", *more))


@pytest.mark.parametrize(
    ("delta", "more"),
    [
        ("10f", ("-d", 10, "-u", "f")),
        ("0.5m", ("-d", 0.5, "-u", "m")),
        ("20deg", ("-d", 20, "-u", "d")),
        ("10f --all-pairs", ("-d", 10, "-u", "f", "--all_pairs")),
        ("0.5m --all-pairs", ("-d", 0.5, "-u", "m", "--all_pairs")),
    ],
)
def test_deltas(locatk, evo: Evo, tmp_path: Path, delta: str, more: tuple[object, ...]) -> None:
    estimate, truth = files(tmp_path, "tum", "jitter")
    found = ours(locatk, estimate, truth, "--align", "sim3", "--delta", *delta.split())
    theirs = evo("rpe", "tum", truth, estimate, "-as", "-r", "angle_deg", *more)
    same(found["rpe"]["rotation_deg"], theirs)


def test_orientations_are_used_as_given(locatk, evo: Evo, tmp_path: Path) -> None:
    """Points as TUM: evo turns their identity orientations along."""
    rows = np.arange(0, 20, 0.1)
    for name, seed in (("estimate", 3), ("truth", None)):
        all_known = poses(rows, seed=seed)
        point = Trajectory.from_positions("r", "f", all_known.time_ns, all_known.position)
        write_tum(tmp_path / f"{name}.tum", point)
    estimate, truth = tmp_path / "estimate.tum", tmp_path / "truth.tum"
    found = ours(locatk, estimate, truth, "--align", "se3")
    same(found["rpe"]["translation_m"], evo("rpe", "tum", truth, estimate, "-a"))
    same(found["ape"]["rotation_deg"], evo("ape", "tum", truth, estimate, "-a", "-r", "angle_deg"))
