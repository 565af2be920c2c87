"""`locatk calibrate sheet` as a user runs it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.dots.calibration import floor as module
from locatk.core.dots.calibration.floor import FloorReport
from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.simulation import session as simulate
from locatk.core.dots.simulation.paths import CameraPath
from locatk.core.dots.simulation.session import SimulationOptions
from locatk.formats.artifacts import sheets
from locatk.formats.exporters.tum import write_tum
from locatk.formats.sessions import frames as files

SIZE, PAGE, FIRST = (90, 80), (47.0, 42.0), (0.5, 0.6)
DESIGN = Manifest(
    (
        Sheet("left", (1000, 2000), SIZE, (0, 0), PAGE, FIRST, (0.0, 0.0)),
        Sheet("right", (1100, 2000), SIZE, (0, 0), PAGE, FIRST, (46.0, 0.5)),
    )
)
GLUED = replace(
    DESIGN,
    sheets=(
        DESIGN.sheets[0],
        replace(DESIGN.sheets[1], position_mm=(46.8, -0.3), heading_deg=0.8),
    ),
)
CAMERA = Camera((320, 240), 350.0, (159.5, 119.5))


def seen(count: int, middle_mm: float, spread_mm: float, seed: int) -> simulate.SimulatedSession:
    """Frames at random places of a strip of the glued sheets."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([middle_mm - spread_mm, 6], [middle_mm + spread_mm, 36], (count, 2))
    path = CameraPath(
        position * 1e-3, rng.uniform(-3, 3, count), np.zeros((count, 2)), np.zeros(count)
    )
    options = SimulationOptions(frames=count, camera=CAMERA, seed=seed)
    return simulate.simulate_path(GLUED, options, path)


@pytest.fixture(scope="module")
def seam(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seam") / "run.mcap"
    session = seen(6, 46.5, 1.0, 1)
    files.write_session(path, [session.frames], DESIGN, camera=CAMERA, truth=[session.truth])
    return path


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that stays on the left sheet."""
    path = tmp_path_factory.mktemp("beside") / "left.mcap"
    session = seen(4, 20.0, 10.0, 2)
    files.write_session(path, [session.frames], DESIGN, camera=CAMERA)
    return path


@pytest.mark.slow
def test_a_session_in_a_manifest_out(locatk, seam: Path, tmp_path: Path) -> None:
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "sheet", seam, "-o", out)
    assert result.exit_code == 0, result.stderr
    text = result.stdout
    result = locatk("calibrate", "sheet", seam, "-o", out, "--overwrite", "--json")
    entry = json.loads(result.stdout)
    right = sheets.read_manifest(out).sheets[1]
    assert right.position_mm == pytest.approx((46.8, -0.3), abs=2e-3)
    assert right.heading_deg == pytest.approx(0.8, abs=5e-3)
    lines = text.splitlines()
    assert lines[0].startswith("2 sheets from ")
    assert f"Wrote {out}" in lines[-1]
    assert "datum" in text
    left, second = entry["sheets"]
    assert (entry["version"], entry["datum"], left["id"]) == (1, "left", "left")
    assert left["sigma_x_m"] == 0
    assert second["dx_m"] == pytest.approx(0.8e-3, abs=2e-6)
    assert second["dheading_rad"] == pytest.approx(math.radians(0.8), abs=1e-4)
    assert 0 < second["sigma_x_m"] < 1e-5
    assert second["has_map"] is False
    (one,) = entry["seams"]
    assert one["sheets"] == ["left", "right"]
    assert one["rms_m"] < 5e-6
    assert entry["frames"]["seen"] == 6
    assert entry["frames"]["with_seam"] == second["seam_frames"] >= 4
    assert entry["scale"] == [None, None]
    assert entry["sigma_truth_m"] is None


@pytest.mark.slow
def test_solve_uses_the_sheets_as_built(locatk, seam: Path, tmp_path: Path) -> None:
    glued = tmp_path / "glued.toml"
    sheets.write_manifest(glued, GLUED)
    errors = []
    for name, artifact in (("design", ()), ("built", ("--artifact", glued))):
        solved = tmp_path / f"{name}.mcap"
        assert locatk("solve", seam, "-o", solved, *artifact).exit_code in (0, 3)
        result = locatk("eval", solved, "--truth", seam, "--json")
        errors.append(json.loads(result.stdout)["max_m"])
    assert errors[0] > 0.4e-3
    assert errors[1] < 10e-6


def test_sheets_without_a_common_frame_are_named(locatk, beside: Path, tmp_path: Path) -> None:
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "sheet", beside, "-o", out)
    assert result.exit_code == 1
    assert "right is not connected with left" in result.stderr
    assert "Hint: Move the camera slowly across each seam" in result.stderr
    assert not out.exists()


@pytest.mark.slow
def test_one_truth_stands_in_for_seams(locatk, tmp_path: Path) -> None:
    """Truths of their own do not connect sessions: each may have any frame."""
    left, right = seen(11, 20.0, 12.0, 5), seen(11, 70.0, 12.0, 6)
    later = 10**10
    right = replace(
        right,
        frames=replace(right.frames, time_ns=right.frames.time_ns + later),
        truth=replace(right.truth, time_ns=right.truth.time_ns + later),
    )
    sessions = [tmp_path / "left.mcap", tmp_path / "right.mcap"]
    for path, session in zip(sessions, (left, right), strict=True):
        files.write_session(path, [session.frames], DESIGN, camera=CAMERA)
    truth = replace(
        left.truth,
        time_ns=np.concatenate([left.truth.time_ns, right.truth.time_ns]),
        position=np.concatenate([left.truth.position, right.truth.position]),
        quaternion=np.concatenate([left.truth.quaternion, right.truth.quaternion]),
        covariance=np.concatenate([left.truth.covariance, right.truth.covariance]),
    )
    for path, track in (("left", left.truth), ("right", right.truth), ("truth", truth)):
        write_tum(tmp_path / f"{path}.tum", track)
    out = tmp_path / "built.toml"
    each = ("--truth", tmp_path / "left.tum", "--truth", tmp_path / "right.tum")
    assert "not connected" in locatk("calibrate", "sheet", *sessions, "-o", out, *each).stderr
    result = locatk("calibrate", "sheet", *sessions, "-o", out, "--truth", tmp_path / "truth.tum")
    assert result.exit_code == 0, result.stderr
    right_sheet = sheets.read_manifest(out).sheets[1]
    assert right_sheet.position_mm == pytest.approx((46.8, -0.3), abs=0.02)
    assert "poses, scale of the print" in result.stdout


@pytest.mark.slow
def test_unplaced_sheets_and_rejected_frames_end_with_status_3(
    locatk, seam: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spare = Sheet("spare", (9000, 2000), SIZE, (0, 0), PAGE, FIRST)
    left, right = DESIGN.sheets
    floor = replace(
        DESIGN, sheets=(replace(left, position_mm=None), replace(right, position_mm=None), spare)
    )
    artifact, out = tmp_path / "floor.toml", tmp_path / "built.toml"
    sheets.write_manifest(artifact, floor)
    arguments = ("calibrate", "sheet", seam, "--artifact", artifact, "-o", out, "--json")
    reports: list[FloorReport] = []
    calibrate_floor = module.calibrate_floor

    def calibrate(*given: Any) -> FloorReport:
        reports.append(calibrate_floor(*given))
        return reports[0]

    monkeypatch.setattr(module, "calibrate_floor", calibrate)
    result = locatk(*arguments)
    assert result.exit_code == 3, result.stderr
    assert "Incomplete: without a position: spare" in result.stderr
    assert json.loads(result.stdout)["unplaced"] == ["spare"]
    assert sheets.read_manifest(out).sheets[2].position_mm is None

    rejected = replace(reports[0], rejected=2, unplaced=())
    monkeypatch.setattr(module, "calibrate_floor", lambda *_: rejected)
    result = locatk(*arguments, "--overwrite")
    assert result.exit_code == 3
    assert "Incomplete: rejected: 2 frames that contradict the others" in result.stderr


def test_usage_errors(locatk, seam: Path, beside: Path, tmp_path: Path) -> None:
    out = tmp_path / "built.toml"
    out.write_text("kept")
    assert "exists" in locatk("calibrate", "sheet", seam, "-o", out).stderr
    assert out.read_text() == "kept"
    new = tmp_path / "new.toml"
    three = ("--truth", seam) * 3
    result = locatk("calibrate", "sheet", seam, beside, "-o", new, *three)
    assert result.exit_code == 2
    assert "3 files for 2 sessions" in result.stderr
    result = locatk("calibrate", "sheet", seam, "-o", tmp_path / "built.pdf")
    assert result.exit_code == 2
    assert "end it in .toml" in result.stderr
    for number in ("nan", "inf"):
        result = locatk("calibrate", "sheet", seam, "-o", new, "--offset", number)
        assert result.exit_code == 2
        assert "is not a finite number" in result.stderr


@pytest.mark.slow
def test_a_recording_counts_once(locatk, seam: Path, tmp_path: Path) -> None:
    once, out = tmp_path / "once.toml", tmp_path / "built.toml"
    assert locatk("calibrate", "sheet", seam, "-o", once).exit_code == 0
    result = locatk("calibrate", "sheet", seam, seam, "-o", out)
    assert result.exit_code == 3
    assert f"{seam}: the same measurements as in {seam}" in result.stderr
    assert out.read_text() == once.read_text()


@pytest.mark.slow
def test_a_session_of_another_floor_is_left_out(locatk, seam: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    session = seen(2, 20.0, 10.0, 3)
    files.write_session(other, [session.frames], GLUED, camera=CAMERA)
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "sheet", seam, other, "-o", out)
    assert result.exit_code == 3
    assert "the manifest differs from that of the first session" in result.stderr
    assert out.exists()
