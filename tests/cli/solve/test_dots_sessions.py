"""Camera frames on the command line: import, info, solve, with pictures drawn by this file."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import DOT_DIRECTIONS, codec
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.formats.artifacts import sheets
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session

SHEET = Sheet("7f3a-1", (5_000_000, 3000), (393, 565), (7, 11), (210.0, 297.0), (5.08, 5.08))
MANIFEST = Manifest((SHEET,))
PX_A_PITCH = 0.508 / 0.046
FINER = 8


def draw(
    grid: tuple[float, float],
    heading: float,
    *,
    size: tuple[int, int] = (188, 120),
    sheet: Sheet = SHEET,
    name: str = "anoto",
) -> np.ndarray:
    """What a camera right above ``grid`` sees: discs at the places that the codec says.

    ``heading`` is how far the image's right is turned from the sheet's, counter-clockwise,
    in rad. Drawn eight times finer and averaged.
    """
    (width, height), (x, y) = size, grid
    reach = int(math.hypot(*size) / PX_A_PITCH / 2) + 3
    first = (int(x) - reach, int(y) - reach)
    symbols = codec(name).symbols(first, (2 * reach, 2 * reach), sheet.section)
    rows, columns = np.mgrid[: 2 * reach, : 2 * reach]
    places = np.stack([columns + first[0], rows + first[1]], -1) + DOT_DIRECTIONS[symbols] / 6
    right, down = (places - (x, y)).reshape(-1, 2).T * PX_A_PITCH
    c, s = math.cos(heading), math.sin(heading)
    across = (width - 1) / 2 + c * right - s * down
    along = (height - 1) / 2 + s * right + c * down
    canvas = np.full((height * FINER, width * FINER), 220, np.uint8)
    for a, b in zip(across, along, strict=True):
        if -5 < a < width + 5 and -5 < b < height + 5:
            # Pixel centres are whole numbers in both pictures.
            at = [round(((v + 0.5) * FINER - 0.5) * 16) for v in (a, b)]
            cv2.circle(canvas, at, round(0.15 * PX_A_PITCH * FINER * 16), 40, -1, shift=4)
    picture = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(picture, (0, 0), 0.6)


POSES = [(5_000_100 + 13.37 * n, 3200 + 7.77 * n, 0.9 * n) for n in range(6)]
"""Grid x, grid y and heading of the frames that :func:`folder` draws."""


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    path = tmp_path / "sheet.toml"
    sheets.write_manifest(path, MANIFEST)
    return path


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.toml"
    sheets.write_camera(path, Camera((188, 120), 900.0, (93.5, 59.5)))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """frame1.png to frame12.png, every second of them of nothing."""
    path = tmp_path / "frames"
    path.mkdir()
    for number, (x, y, heading) in enumerate(POSES):
        cv2.imwrite(str(path / f"frame{2 * number + 1}.png"), draw((x, y), heading))
        blank = np.full((120, 188), 200, np.uint8)
        cv2.imwrite(str(path / f"frame{2 * number + 2}.png"), blank)
    (path / "notes.txt").write_text("taken on Monday")
    return path


@pytest.fixture
def session(locatk, folder: Path, manifest: Path, tmp_path: Path) -> Path:
    out = tmp_path / "run.mcap"
    assert locatk("import", "images", folder, "--sheet", manifest, "-o", out).exit_code == 0
    return out


# ---- import


def test_a_folder_becomes_a_session(
    locatk, folder: Path, manifest: Path, camera: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run.mcap"
    result = locatk(
        "import", "images", folder, "--sheet", manifest, "--camera", camera, "--rate", 50,
        "-o", out, "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout) == {
        "version": 1,
        "output": str(out),
        "format": "images",
        "frames": 12,
        "devices": ["camera"],
        "left_out": 0,
        "warnings": [],
    }
    session = Session.open(out)
    (frames,) = observations.read_frames(session)
    assert frames.names == tuple(f"frame{n}.png" for n in range(1, 13))
    assert np.diff(frames.time_ns).tolist() == [20_000_000] * 11
    assert observations.read_manifest(session) == MANIFEST
    assert observations.read_camera(session) == sheets.read_camera(camera)
    again = locatk("import", "images", folder, "--sheet", manifest, "-o", out)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr


def test_bad_files_are_named_and_the_rest_is_written(
    locatk, folder: Path, manifest: Path, tmp_path: Path
) -> None:
    bad = [folder / f"frame{n}.png" for n in (2, 5)]
    bad[0].write_bytes(b"")
    bad[1].write_bytes(bad[1].read_bytes()[:-200])
    out = tmp_path / "run.mcap"
    result = locatk("import", "images", folder, "--sheet", manifest, "-o", out, "--json")
    assert result.exit_code == 3
    answer = json.loads(result.stdout)
    assert (answer["frames"], answer["left_out"], len(answer["warnings"])) == (10, 2, 2)
    for path in bad:
        assert f"Warning: {path}: " in result.stderr
    assert "Incomplete: 2 of 12 files are excluded." in result.stderr
    (frames,) = observations.read_frames(Session.open(out))
    assert len(frames) == 10


def test_a_thousand_bad_files_do_not_fill_the_screen(locatk, folder: Path, tmp_path: Path) -> None:
    for number in range(100, 150):
        (folder / f"frame{number}.png").write_text("")
    result = locatk("import", "images", folder, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 3
    assert result.stderr.count("\n") < 16
    assert "and 40 more" in result.stderr
    assert "50 of 62 files are excluded" in result.stderr


def test_nothing_usable_leaves_nothing(locatk, tmp_path: Path) -> None:
    for name in ("a.png", "b.jpg"):
        (tmp_path / name).write_text("not an image")
    before = sorted(tmp_path.iterdir())
    result = locatk("import", "images", tmp_path, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: none of 2 files is usable")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        (["missing"], "Error: missing: No such file or folder"),
        (["*.png"], "Error: *.png: no file matches the pattern"),
        (["empty"], "Error: empty: no image files (1 files of other kinds)"),
    ],
)
def test_a_folder_without_images(
    locatk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, paths: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("")
    result = locatk("import", "images", *paths, "-o", "run.mcap")
    assert result.exit_code == 1
    assert result.stderr.startswith(words)
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("form", "option", "words"),
    [
        ("dotbot-lh2", "--sheet", "--sheet means nothing to the format dotbot-lh2"),
        ("dotbot-lh2", "--rate", "--rate means nothing"),
        ("images", "--truth", "--truth means nothing to the format images"),
        ("images", "--calibration", "--calibration means nothing"),
        ("video", "--rate", "--rate means nothing to the format video"),
    ],
)
def test_options_of_another_format(
    locatk, manifest: Path, tmp_path: Path, form: str, option: str, words: str
) -> None:
    value = 30 if option == "--rate" else manifest
    result = locatk("import", form, manifest, option, value, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 2
    assert words in result.stderr


def test_a_manifest_that_is_wrong_is_named_before_the_work(
    locatk, folder: Path, manifest: Path, tmp_path: Path
) -> None:
    manifest.write_text(manifest.read_text().replace("[5000000,", "[410815347,"))
    result = locatk("import", "images", folder, "--sheet", manifest, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert f"{manifest}:sheets[0].origin" in result.stderr


def test_a_frame_is_never_the_output(locatk, folder: Path) -> None:
    frame = folder / "frame1.png"
    before = frame.read_bytes()
    result = locatk("import", "images", folder, "-o", frame, "--overwrite")
    assert result.exit_code == 2
    assert frame.read_bytes() == before


def test_frames_of_another_camera(locatk, folder: Path, tmp_path: Path) -> None:
    lens = tmp_path / "camera.toml"
    sheets.write_camera(lens, Camera((640, 480), 900.0, (319.5, 239.5)))
    result = locatk("import", "images", folder, "--camera", lens, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert "188 x 120 px, but the camera has 640 x 480 px" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("length", [0, 900, 4000])
def test_a_bad_video_is_one_line(tmp_path: Path, length: int) -> None:
    """Run as a user runs it: the library under OpenCV talks to stderr past Python."""
    video, out = tmp_path / "run.avi", tmp_path / "run.mcap"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 25, (188, 120), False)
    for x, y, heading in POSES:
        writer.write(draw((x, y), heading))
    writer.release()
    video.write_bytes(video.read_bytes()[:length] + bytes(range(256)) * 5)
    command = [sys.executable, "-m", "locatk.cli", "import", "video", str(video), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("Error: ")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == [video]


# ---- info


def test_info_of_a_session(locatk, session: Path) -> None:
    facts = json.loads(locatk("info", session, "--json").stdout)
    assert (facts["kind"], facts["system"], facts["frames"]) == ("session", "dots", 12)
    assert facts["cameras"] == [{"device": "camera", "frames": 12, "size_px": [188, 120]}]
    (sheet,) = facts["sheets"]
    assert (sheet["id"], sheet["origin"], sheet["section"]) == ("7f3a-1", [5000000, 3000], [7, 11])
    text = locatk("info", session).stdout
    for words in ("188 x 120", "7f3a-1", "5000000,3000", "anoto, pitch 0.508 mm", "12"):
        assert words in text


def test_info_of_artifacts(locatk, manifest: Path, camera: Path, tmp_path: Path) -> None:
    facts = json.loads(locatk("info", manifest, "--json").stdout)
    assert (facts["kind"], facts["codec"], facts["pitch_mm"]) == ("manifest", "anoto", 0.508)
    assert "210 x 297" in locatk("info", manifest).stdout
    facts = json.loads(locatk("info", camera, "--json").stdout)
    assert facts["kind"] == "camera"
    assert facts["camera"]["focal_px"] == 900.0
    assert "188 x 120 px, focal length 900 px" in locatk("info", camera).stdout
    other = tmp_path / "other.toml"
    other.write_text('format = "recipe"')
    result = locatk("info", other)
    assert result.exit_code == 1
    assert "'recipe' is not one of locatk-lighthouse-scene, " in result.stderr


def test_info_of_a_damaged_session(locatk, session: Path) -> None:
    data = bytearray(session.read_bytes())
    chunk = Session.open(session).index.segments[0]
    data[chunk.offset + chunk.length // 2] ^= 0xFF
    session.write_bytes(data)
    facts = json.loads(locatk("info", session, "--json").stdout)
    assert facts["cameras"][0]["size_px"] is None
    assert facts["frames"] == 12


# ---- solve: what is refused


def test_a_session_without_a_manifest(locatk, folder: Path, manifest: Path, tmp_path: Path) -> None:
    run, out = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    result = locatk("import", "images", folder, "-o", run)
    assert result.exit_code == 0
    assert "--artifact" in result.stderr
    result = locatk("solve", run, "-o", out)
    assert result.exit_code == 1
    assert "no manifest of the sheet" in result.stderr
    assert "--sheet" in result.stderr
    assert locatk("solve", run, "-o", out, "--artifact", manifest).exit_code == 0


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["--method", "bundle"], 1, "no method 'bundle' for dots"),
        (["--scene", "two-3d"], 1, "--scene is not an option of dots"),
        (["--save-scene", "scene.toml"], 2, "--save-scene is for lighthouse"),
    ],
)
def test_options_that_are_for_lighthouse(
    locatk, session: Path, tmp_path: Path, options: list[str], status: int, words: str
) -> None:
    out = tmp_path / "solved.mcap"
    result = locatk("solve", session, "-o", out, *options)
    assert result.exit_code == status
    assert words in result.stderr
    assert not out.exists()


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--method", "no method 'lattice' for lighthouse"),
        ("--camera", "--camera is not an option of lighthouse"),
    ],
)
def test_options_that_are_for_dots(
    locatk, record, camera: Path, tmp_path: Path, option: str, words: str
) -> None:
    run = record(tmp_path / "light.mcap")
    value = "lattice" if option == "--method" else camera
    result = locatk("solve", run, "-o", tmp_path / "solved.mcap", option, value)
    assert result.exit_code == 1
    assert words in result.stderr


def test_another_artifact_than_a_manifest(locatk, session: Path, camera: Path, tmp_path: Path):
    result = locatk("solve", session, "-o", tmp_path / "s.mcap", "--artifact", camera)
    assert result.exit_code == 1
    assert "expected 'locatk-dot-sheets'" in result.stderr


# ---- the whole way


def metres(x: float, y: float) -> tuple[float, float]:
    """From the paper's lower left corner, worked out by hand."""
    right = 5.08 + (x - 5_000_000) * 0.508
    down = 5.08 + (y - 3000) * 0.508
    return right * 1e-3, (297 - down) * 1e-3


def check(detection: dict, x: float, y: float, heading: float) -> None:
    """The pose of a frame against where it was drawn: 0.01 mm and 0.1 degrees."""
    assert (detection["x_m"], detection["y_m"]) == pytest.approx(metres(x, y), abs=1e-5)
    turn = detection["heading_rad"] - heading
    assert abs(math.remainder(turn, 2 * math.pi)) < math.radians(0.1)
    assert detection["sheet"] == "7f3a-1"
    assert 0 < detection["confidence"] <= 1


def test_from_frames_to_poses(locatk, session: Path, tmp_path: Path) -> None:
    out, table = tmp_path / "solved.mcap", tmp_path / "poses.csv"
    result = locatk("solve", session, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    (answer,) = json.loads(result.stdout)["sessions"]
    assert (answer["system"], answer["method"], answer["poses"]) == ("dots", "lattice", 6)
    assert sum(answer["rejected"].values()) == 6  # the blank ones
    names = [f"frame{2 * n + 1}.png" for n in range(6)]
    assert [detection["frame"] for detection in answer["detections"]] == names
    for detection, pose in zip(answer["detections"], POSES, strict=True):
        check(detection, *pose)

    solution = observations.read_solution(out)
    assert solution.artifact == MANIFEST
    outcomes = solution.facts.frames
    assert [outcome.frame for outcome in outcomes] == [f"frame{n}.png" for n in range(1, 13)]
    assert all(outcome.rejected is None for outcome in outcomes[::2])
    assert all(outcome.rejected for outcome in outcomes[1::2])
    (trajectory,) = solution.trajectories
    assert (trajectory.device, trajectory.frame) == ("camera", "7f3a-1")
    assert locatk("export", out, "--format", "csv", "-o", table).exit_code == 0
    rows = [line.split(",") for line in table.read_text().splitlines()[1:]]
    assert [row[1] for row in rows] == ["camera"] * 6
    found = np.array([[float(cell) for cell in row[2:4]] for row in rows])
    np.testing.assert_allclose(found, [metres(x, y) for x, y, _ in POSES], atol=1e-5)
    assert "7f3a-1" in locatk("info", out).stdout


def test_a_sheet_for_viewers(locatk, session: Path, tmp_path: Path) -> None:
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    out = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", out).exit_code == 0
    ((_, scene),) = Session.open(out).decoded("/scene", SceneUpdate)
    entities = {entity.id: entity for entity in scene.entities}
    assert set(entities) == {"sheet/7f3a-1", "path/camera"}
    sheet = entities["sheet/7f3a-1"]
    assert sheet.frame_id == entities["path/camera"].frame_id == "7f3a-1"
    paper, pattern = ([(p.x, p.y) for p in line.points] for line in sheet.lines)
    np.testing.assert_allclose(paper, [(0, 0.297), (0.21, 0.297), (0.21, 0), (0, 0)], atol=1e-9)
    first, last = metres(5_000_000, 3000), metres(5_000_392, 3564)
    np.testing.assert_allclose([pattern[0], pattern[2]], [first, last], atol=1e-9)


def test_a_frame_that_cannot_be_read_is_counted_and_the_rest_is_solved(
    locatk, tmp_path: Path, manifest: Path
) -> None:
    from locatk.formats.sessions import frames
    from locatk.formats.sessions.frames import Shot

    run = tmp_path / "run.mcap"
    pictures = [cv2.imencode(".png", draw(pose[:2], pose[2]))[1].tobytes() for pose in POSES]
    pictures[2] = pictures[2][:500]
    frames.write_shots(
        run,
        {"pen": [Shot(10**9 * n, f"f{n}", data, "png") for n, data in enumerate(pictures)]},
        manifest=MANIFEST,
    )
    result = locatk("solve", run, "-o", tmp_path / "solved.mcap", "--json")
    assert result.exit_code == 0, result.stderr
    (answer,) = json.loads(result.stdout)["sessions"]
    assert answer["poses"] == 5
    assert sum(answer["rejected"].values()) == 1
    assert [detection["frame"] for detection in answer["detections"]] == [
        f"f{n}" for n in (0, 1, 3, 4, 5)
    ]


def test_the_manifest_of_another_sheet(locatk, session: Path, tmp_path: Path) -> None:
    """Frames of a place that no sheet of the manifest holds have no pose."""
    other = tmp_path / "other.toml"
    moved = Sheet("x", (100, 3000), (393, 565), (7, 11), (210.0, 297.0), (5.08, 5.08))
    sheets.write_manifest(other, Manifest((moved,)))
    result = locatk("solve", session, "-o", tmp_path / "s.mcap", "--artifact", other, "--json")
    assert result.exit_code == 3
    (answer,) = json.loads(result.stdout)["sessions"]
    assert answer["poses"] == 0
    assert answer["detections"] == []
    assert sum(answer["rejected"].values()) == 12


@pytest.mark.parametrize("depth", ["16-bit", "12-bit", "colour"])
def test_frames_of_other_depths(locatk, manifest: Path, tmp_path: Path, depth: str) -> None:
    path = tmp_path / "frames"
    path.mkdir()
    for number, (x, y, heading) in enumerate(POSES):
        picture = draw((x, y), heading)
        kept = {
            "16-bit": picture.astype(np.uint16) * 257,
            "12-bit": picture.astype(np.uint16) * 16,
            "colour": cv2.merge([picture // 2, picture, picture]),
        }[depth]
        cv2.imwrite(str(path / f"{number}.png"), kept)
    run = tmp_path / "run.mcap"
    assert locatk("import", "images", path, "--sheet", manifest, "-o", run).exit_code == 0
    result = locatk("solve", run, "-o", tmp_path / "solved.mcap", "--json")
    (answer,) = json.loads(result.stdout)["sessions"]
    for detection, pose in zip(answer["detections"], POSES, strict=True):
        check(detection, *pose)


def test_from_a_video_to_poses(locatk, manifest: Path, tmp_path: Path) -> None:
    video, run = tmp_path / "run.avi", tmp_path / "run.mcap"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 25, (188, 120), False)
    for x, y, heading in POSES:
        writer.write(draw((x, y), heading))
    writer.release()
    result = locatk("import", "video", video, "--sheet", manifest, "-o", run)
    assert result.exit_code == 0, result.stderr
    result = locatk("solve", run, "-o", tmp_path / "solved.mcap", "--json")
    (answer,) = json.loads(result.stdout)["sessions"]
    for number, (detection, pose) in enumerate(zip(answer["detections"], POSES, strict=True)):
        check(detection, *pose)
        assert detection["time_s"] == pytest.approx(1 + number / 25, abs=1e-6)
        assert detection["frame"] == str(number)


@pytest.mark.parametrize("turns", range(4))
def test_the_published_frame(locatk, data: Path, tmp_path: Path, turns: int) -> None:
    """The public frame of cellulo-localization, of a `libdots` sheet."""
    source = data / "dots" / "frame.bmp"
    if not source.exists():
        pytest.skip(f"{source} is not there")
    picture = cv2.imread(str(source), cv2.IMREAD_GRAYSCALE)
    path, sheet, run = tmp_path / "frame.bmp", tmp_path / "sheet.toml", tmp_path / "run.mcap"
    cv2.imwrite(str(path), np.rot90(picture, turns))
    made = Sheet("cellulo", (0, 3000), (400, 600), (24, 32), (210.0, 310.0), (0.0, 0.0))
    sheets.write_manifest(sheet, Manifest((made,), codec="libdots"))
    assert locatk("import", "images", path, "--sheet", sheet, "-o", run).exit_code == 0
    result = locatk("solve", run, "-o", tmp_path / "solved.mcap", "--json")
    (answer,) = json.loads(result.stdout)["sessions"]
    (detection,) = answer["detections"]
    at = (detection["grid_x"], detection["grid_y"])
    assert at == pytest.approx((129.168, 3224.506), abs=0.05)
    # A picture turned counter-clockwise shows what a camera turned clockwise sees. The
    # camera was tilted: an affine fit to the dots turns the sheet's x by 1.42 degrees and its y
    # by 1.30, of which one is along the right of the picture and the other of the turned one.
    turn = math.degrees(detection["heading_rad"]) - 1.603 + 90 * turns
    assert abs(math.remainder(turn, 360)) < (0.35 if turns % 2 else 0.2)
