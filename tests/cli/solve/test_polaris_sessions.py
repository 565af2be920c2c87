"""Magnetometer arrays on the command line: import, info, solve, calibrate."""

from __future__ import annotations

import json
import math
import shutil
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.geometry import quaternion_from_heading
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.results import (
    HeadingCorrection,
    MagnetDetection,
    PolarisFacts,
    TagDetection,
)
from locatk.core.polaris.tag import (
    AsBuiltTag,
    PlanarPose,
    Tags,
    as_built_magnets,
    cell_positions,
    symbol_angles,
)
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import tags
from locatk.formats.sessions import field_samples, observations, solutions
from locatk.formats.sessions.reader import Session

START_NS = 1_700_000_000_000_000_000
TAGS = Tags()
ID = 123_456


def published(
    path: Path, n: int = 60, sensors: int = 9, cells: dict[int, str] | None = None
) -> Path:
    """A recording as the authors publish them; ``cells`` replaces sensor 2 in some rows."""
    rng = np.random.default_rng(3)
    lines = [",Time Stamp," + ",".join(f"Sensor {k + 1}" for k in range(sensors))]
    for row in range(n):
        texts = [f'"{tuple(v)}"' for v in (30 + rng.normal(size=(sensors, 3))).round(2).tolist()]
        texts[1] = (cells or {}).get(row, texts[1])
        lines.append(f"{row},{row / 100}," + ",".join(texts))
    path.write_text("\n".join(lines) + "\n")
    return path


# ---- import


def test_a_published_recording_becomes_a_session(locatk, tmp_path: Path) -> None:
    run, out = published(tmp_path / "run.csv"), tmp_path / "run.mcap"
    args = ("import", "polaris-csv", run, "--rate", 40, "--spacing", 20, "-o", out)
    result = locatk(*args, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout) == {
        "version": 1,
        "output": str(out),
        "format": "polaris-csv",
        "samples": 60,
        "sensors": 9,
        "devices": ["bar"],
        "left_out": 0,
        "warnings": [],
    }
    assert "the design of the published tags" in result.stderr
    session = Session.open(out)
    (samples,) = observations.read_magnetometers(session)
    assert samples.field_t.shape == (60, 9, 3)
    assert np.ptp(samples.array.position_m[:, 1]) == pytest.approx(0.16)
    known = observations.read_tags(session)
    assert known is not None
    assert (known.codec, known.spacing_m, known.clearance_m) == ("polaris-released", 0.04, 0.01)
    assert "assumed" in known.notes[0]
    again = locatk(*args)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr


def test_the_tags_that_were_passed_go_into_the_session(locatk, tmp_path: Path) -> None:
    run, out, tag = published(tmp_path / "run.csv"), tmp_path / "run.mcap", tmp_path / "tag.toml"
    tags.write_tags(tag, replace(TAGS, ids=(5,)))
    result = locatk(
        "import", "polaris-csv", run, "--rate", 40, "--spacing", 20, "--tag", tag, "-o", out
    )
    assert result.exit_code == 0, result.stderr
    assert observations.read_tags(Session.open(out)) == replace(TAGS, ids=(5,))
    assert "published tags" not in result.stderr


def test_omissions_are_reported(locatk, tmp_path: Path) -> None:
    run = published(
        tmp_path / "run.csv", cells={5: "", 9: '"(1.0, nan, 2.0)"', 20: '"(4999, 0, 1)"'}
    )
    out = tmp_path / "run.mcap"
    args = ("import", "polaris-csv", run, "--rate", 100, "--spacing", 20, "-o", out)
    result = locatk(*args, "--json")
    assert result.exit_code == 3
    answer = json.loads(result.stdout)
    assert answer["left_out"] == 5
    assert "at most 61 samples per second" in answer["warnings"][0]
    assert f"{run}:7: sensor 2 has no number in 2 rows" in result.stderr
    assert f"{run}:22: sensor 2 has a field beyond the range of an MLX90393" in result.stderr
    assert "Incomplete: 5 of 1620 values are excluded." in result.stderr
    session = Session.open(out)
    (samples,) = observations.read_magnetometers(session)
    assert np.count_nonzero(np.isnan(samples.field_t)) == 5
    assert len(session.topics("/log")) == 1


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (("--spacing", 20), 2, "needs --rate"),
        (("--rate", 40), 2, "needs --spacing"),
        (("--rate", 0, "--spacing", 20), 2, "--rate"),
        (("--rate", 40, "--spacing", 0), 2, "--spacing"),
        (("--rate", 40, "--spacing", 20, "--truth", "run.csv"), 2, "--truth means nothing"),
        (("--rate", 5000, "--spacing", 20), 1, "no MLX90393 gives 5000 samples per second"),
    ],
)
def test_wrong_use_of_the_format(
    locatk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: tuple, status: int, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    published(Path("run.csv"))
    result = locatk("import", "polaris-csv", "run.csv", "-o", "run.mcap", *args)
    assert result.exit_code == status
    assert words in result.stderr
    assert not Path("run.mcap").exists()
    assert "Traceback" not in result.stderr


def test_spacing_and_tag_are_options_of_this_format(locatk, tmp_path: Path) -> None:
    run = published(tmp_path / "run.csv")
    result = locatk("import", "images", run, "--spacing", 20, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 2
    assert "--spacing means nothing to the format images" in result.stderr


# ---- info


def test_info_describes_arrays_and_tags(locatk, tmp_path: Path) -> None:
    run, out = published(tmp_path / "run.csv", cells={5: ""}), tmp_path / "run.mcap"
    locatk("import", "polaris-csv", run, "--rate", 40, "--spacing", 20, "-o", out)
    facts = json.loads(locatk("info", out, "--json").stdout)
    assert (facts["system"], facts["samples"], facts["devices"]) == ("polaris", 60, ["bar"])
    (array,) = facts["arrays"]
    assert (array["sensors"], array["left_out"]) == (9, 3)
    assert array["rate_hz"] == pytest.approx(40)
    assert array["noise_ut"] == pytest.approx([0.89, 0.86, 1.24])
    assert facts["capacity"] == 1 << 18
    text = " ".join(locatk("info", out).stdout.split())
    assert "polaris-released, 5 magnets of 8 orientations on 3 x 3 cells 40 mm apart" in text
    assert "MLX90393 gain 7 resolution 0 osr 3 filt 3" in text


def test_info_describes_artifacts(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    built = AsBuiltTag(np.full((5, 2), 1e-4), np.full(5, math.radians(3)), 7)
    tags.write_tags(
        path,
        replace(
            TAGS,
            ids=(3, 9),
            built={9: built},
            site={3: PlanarPose(1.5, -0.2, math.pi / 2)},
            meanings={9: "charging station"},
        ),
    )
    facts = json.loads(locatk("info", path, "--json").stdout)
    assert (facts["kind"], facts["capacity"], facts["family"]) == ("tag", 327_680, 2)
    first, second = facts["tags"]
    assert (first["id"], first["position_mm"], first["heading_deg"]) == (3, [1500, -200], 90)
    assert (second["id"], second["passes"], second["angle_deg"]) == (9, 7, pytest.approx([3] * 5))
    assert (first["meaning"], second["meaning"]) == (None, "charging station")
    assert second["cells"] == [list(cell) for cell in layout_of(TAGS, 9).cells]
    text = locatk("info", path).stdout
    assert "2 x 0.5 mm, N52, 1.45 T, 1.812 mA m2" in text
    assert "1500,-200 mm, 90 deg" in text
    assert "charging" in text

    path = tmp_path / "array.toml"
    tags.write_array(path, SensorArray(bar(3, 0.008)))
    facts = json.loads(locatk("info", path, "--json").stdout)
    assert facts["kind"] == "array"
    (array,) = facts["arrays"]
    assert (array["sensors"], array["noise_ut"], array["range_ut"]) == (3, [None] * 3, [None] * 3)
    assert locatk("info", path).exit_code == 0

    path.write_text(path.read_text().replace("position_mm", "place_mm"))
    result = locatk("info", path)
    assert result.exit_code == 1
    assert f"Error: {path}: missing key 'position_mm'" in result.stderr


def test_info_of_a_session_with_damaged_samples(locatk, tmp_path: Path) -> None:
    out = record(tmp_path / "run.mcap")
    session = Session.open(out)
    assert session.damage is None
    from locatk.formats.schemas.magnetics_pb2 import MagnetometerArray
    from locatk.formats.sessions.writer import SessionWriter

    (samples,) = observations.read_magnetometers(session)
    message = next(iter(session.decoded("/magnetometers/bar", MagnetometerArray)))[1]
    bad = tmp_path / "bad.mcap"
    with SessionWriter(bad, system="polaris") as writer:
        writer.attach("array.toml", tags.dumps_array(samples.array).encode(), "application/toml")
        for _ in range(2):  # the same samples twice
            writer.write("/magnetometers/bar", message, START_NS)
    result = locatk("info", bad)
    assert result.exit_code == 3
    assert "older than the one before" in result.stderr


# ---- solve and calibrate, whatever the solver does


def record(path: Path, known: Tags | None = TAGS) -> Path:
    """A session of nothing but noise, which differs from those of other names."""
    field = np.random.default_rng(list(path.name.encode())).normal(size=(40, 9, 3)) * 1e-6
    time_ns = START_NS + 10_000_000 * np.arange(40)
    samples = Samples("bar", SensorArray(bar(9, 0.02)), time_ns, field)
    field_samples.write_magnetometers(path, [samples], tags=known)
    return path


def detection(
    known: Tags, tag_id: int | None, pose: tuple[float, float, float], time_s: float = 1.0
) -> TagDetection:
    """What a solver says of the tag ``tag_id`` of ``known``, seen at ``pose``."""
    layout = layout_of(known, ID if tag_id is None else tag_id)
    place, angle = as_built_magnets(known, -1 if tag_id is None else tag_id, layout)
    x, y, heading = pose
    c, s = math.cos(heading), math.sin(heading)
    place = place @ np.array([[c, s], [-s, c]]) + [x, y]
    return TagDetection(
        time_s=time_s,
        device="bar",
        tag_id=tag_id,
        margin=None if tag_id is None else 3.5,
        refused="magnet_missing" if tag_id is None else None,
        x_m=x,
        y_m=y,
        heading_rad=heading,
        sigma_x_m=1e-4,
        sigma_y_m=2e-4,
        sigma_heading_rad=1e-3,
        array_pose=PlanarPose(-c * x - s * y, s * x - c * y, -heading),
        magnets=tuple(
            MagnetDetection(
                x_m=px,
                y_m=py,
                angle_rad=a + heading,
                symbol=symbol,
                cell=cell,
                sigma_x_m=1e-4,
                sigma_y_m=1e-4,
                sigma_angle_rad=1e-2,
                moment_am2=1.2e-3,
            )
            for (px, py), a, symbol, cell in zip(
                place.tolist(), angle.tolist(), layout.symbols, layout.cells, strict=True
            )
        ),
        residual_sigma=1.1,
        height_m=0.01,
        speed_mps=0.1,
        scale=1.0,
        corrected=0,
        erased=0,
        other_sources=0,
    )


class Solver:
    """Stands in for the solver: keeps what it was asked, answers with what it was given."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.seen: list[list[TagDetection]] = []
        self.facts: PolarisFacts | None = None

    def solve(
        self, samples: Any, known: Tags | None, wanted: Any, *, odometry: Any = ()
    ) -> Solution:
        self.asked.append((known, wanted.method, wanted.speed_mps))
        seen = self.seen[min(len(self.asked), len(self.seen)) - 1]
        read = [found for found in seen if found.tag_id is not None]
        n = 5 if read else 0
        time_ns = START_NS + 10_000_000 * np.arange(n)
        track = Trajectory(
            "bar",
            f"tag-{read[0].tag_id}" if read else "array",
            time_ns,
            np.column_stack([np.linspace(-0.1, 0.1, n), np.zeros(n), np.full(n, 0.01)]),
            quaternion_from_heading(np.zeros(n)),
            np.broadcast_to(np.eye(6) * 1e-8, (n, 6, 6)),
        )
        warnings = (SolverWarning("test", "a note"),)
        return Solution(
            "polaris",
            wanted.method,
            (track,),
            {"debris": 2},
            tuple(seen),
            known,
            warnings,
            self.facts,
        )


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> Solver:
    made, module = Solver(), types.ModuleType("locatk.core.polaris.solver")

    class SolveOptions:
        def __init__(self, method: str = "joint", speed_mps: float | None = None) -> None:
            self.method, self.speed_mps = method, speed_mps

    module.SolveOptions, module.solve = SolveOptions, made.solve  # type: ignore[attr-defined]
    import locatk.core.polaris as system

    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(system, "solver", module, raising=False)
    made.seen = [[detection(TAGS, ID, (0.01, -0.02, 0.5))]]
    return made


def test_a_solution_holds_tags_and_poses(locatk, solver: Solver, tmp_path: Path) -> None:
    session, out = record(tmp_path / "run.mcap"), tmp_path / "solved.mcap"
    result = locatk("solve", session, "-o", out, "--speed", 0.105, "--json")
    assert result.exit_code == 0, result.stderr
    assert solver.asked == [(TAGS, "joint", 0.105)]
    (entry,) = json.loads(result.stdout)["sessions"]
    assert (entry["system"], entry["method"], entry["poses"]) == ("polaris", "joint", 5)
    (found,) = entry["detections"]
    contract = {"time_s", "tag_id", "margin", "x_m", "y_m", "heading_rad", "magnets"}
    assert contract <= set(found)
    assert {"x_m", "y_m", "angle_rad", "symbol"} <= set(found["magnets"][0])

    solution = solutions.read_solution(out)
    assert solution.artifact == TAGS
    assert solution.detections == tuple(solver.seen[0])
    facts = json.loads(locatk("info", out, "--json").stdout)
    assert (facts["kind"], facts["system"], facts["codec"]) == ("solution", "polaris", "mosk")
    assert "meaning" not in found
    assert entry["facts"] == {}


def test_meanings_and_heading_corrections_are_printed(
    locatk, solver: Solver, tmp_path: Path
) -> None:
    rotations = (0.02, -0.05, 0.02)
    solver.facts = PolarisFacts(
        tuple(
            HeadingCorrection("bar", 1.0 + k, 77, 78 + k, rotation, 1e-3, 0.5)
            for k, rotation in enumerate(rotations)
        )
    )
    solver.seen = [[replace(detection(TAGS, ID, (0.01, -0.02, 0.5)), meaning="stop")]]
    session, out = record(tmp_path / "run.mcap"), tmp_path / "solved.mcap"
    text = " ".join(locatk("solve", session, "-o", out).stdout.split())
    assert "meaning" in text
    assert "stop" in text
    expected = "heading corrections: 3, mean size 1.72 deg, largest -2.86 deg from tag 77 to tag 79"
    assert expected in text
    result = locatk("solve", session, "-o", out, "--overwrite", "--json")
    (entry,) = json.loads(result.stdout)["sessions"]
    assert list(entry["detections"][0])[-1] == "meaning"
    assert entry["detections"][0]["meaning"] == "stop"
    turns = [each["turn_rad"] for each in entry["facts"]["heading_corrections"]]
    assert turns == list(rotations)
    assert solutions.read_solution(out).detections[0].meaning == "stop"


def test_people_see_a_table_of_tags(locatk, solver: Solver, tmp_path: Path) -> None:
    session = record(tmp_path / "run.mcap")
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap")
    assert result.exit_code == 0
    (row,) = [line for line in result.stdout.splitlines() if line.lstrip().startswith(str(ID))]
    pose = "10.00 ± 0.1 -20.00 ± 0.2 28.65 ± 0.057"
    assert row.split() == [str(ID), "3.50", "5", *pose.split()]
    assert "rejected: 2 debris" in result.stdout
    assert "run.mcap: a note" in result.stderr


def test_a_tag_that_was_not_read_is_a_loss(locatk, solver: Solver, tmp_path: Path) -> None:
    session = record(tmp_path / "run.mcap")
    read, unread = solver.seen[0][0], detection(TAGS, None, (0, 0, 0), 2.0)
    for seen, words in (
        ([read, unread], "1 tag not read (magnet missing)"),
        ([unread, unread], "no pose for bar"),
        ([], "no pose for bar"),
    ):
        solver.seen = [seen]
        out = tmp_path / "solved.mcap"
        result = locatk("solve", session, "-o", out, "--overwrite", "--json")
        assert result.exit_code == 3, result.stderr
        assert words in result.stderr
        assert len(solutions.read_solution(out).detections) == len(seen)
    assert "2 tags not read" not in result.stderr


def test_tags_are_taken_from_the_artifact(locatk, solver: Solver, tmp_path: Path) -> None:
    session, tag = record(tmp_path / "run.mcap", known=None), tmp_path / "tag.toml"
    tags.write_tags(tag, replace(TAGS, ids=(ID,)))
    out = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", out).exit_code == 0
    assert locatk("solve", session, "-o", out, "--overwrite", "--artifact", tag).exit_code == 0
    assert [known for known, *_ in solver.asked] == [None, replace(TAGS, ids=(ID,))]
    assert solutions.read_solution(out).artifact == replace(TAGS, ids=(ID,))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--scene", "auto"), "--scene is not an option of polaris"),
        (("--method", "lattice"), "Use --method joint or paper"),
        (("--save-scene", "scene.toml"), "polaris estimates no scene"),
    ],
)
def test_options_of_other_systems_are_refused(
    locatk, solver: Solver, tmp_path: Path, args: tuple[str, ...], words: str
) -> None:
    session, out = record(tmp_path / "run.mcap"), tmp_path / "solved.mcap"
    result = locatk("solve", session, "-o", out, *args)
    assert result.exit_code in (1, 2)
    assert words in result.stderr
    assert solver.asked == []


def test_speed_is_refused_for_other_formats(locatk, record, tmp_path: Path) -> None:
    session = record(tmp_path / "light.mcap")
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap", "--speed", 1)
    assert result.exit_code == 1
    assert "--speed is not an option of lighthouse" in result.stderr


def test_templates_set_the_resolution_of_the_published_method(locatk, tmp_path: Path) -> None:
    session = tmp_path / "run.mcap"
    assert locatk("simulate", "polaris", "-o", session, "--speed", 0.1).exit_code == 0
    args = ("solve", session, "-o", tmp_path / "solved.mcap", "--speed", 0.1, "--overwrite")
    result = locatk(*args, "--method", "paper", "--templates", "8, 5,40", "--json")
    assert result.exit_code in (0, 3), result.stderr
    (entry,) = json.loads(result.stdout)["sessions"]
    (found,) = entry["detections"]
    steps = np.array([magnet["angle_rad"] for magnet in found["magnets"]]) / (math.pi / 4)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    command = Session.open(tmp_path / "solved.mcap").facts["command"]
    assert command.endswith("--method paper --speed 0.1 --templates 8,5,40")


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (("--templates", "36,5,80"), 1, "method joint uses no templates"),
        (("--templates", "36,5"), 2, "'36,5' is not of the form 36,5,80"),
        (("--templates", "36,5,x"), 2, "'36,5,x' is not of the form 36,5,80"),
        (("--templates", "36,-5,80"), 2, "'36,-5,80' is not of the form 36,5,80"),
        (("--method", "paper", "--templates", "36,5,4"), 1, "templates with 4 points"),
    ],
)
def test_templates_that_are_refused(
    locatk, tmp_path: Path, args: tuple[str, ...], status: int, words: str
) -> None:
    session = record(tmp_path / "run.mcap")
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap", "--speed", 0.1, *args)
    assert result.exit_code == status
    assert words in " ".join(result.stderr.split())


def test_viewers_show_the_tag_at_its_position(locatk, solver: Solver, tmp_path: Path) -> None:
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    for site, frame, corner in (
        ({}, f"tag-{ID}", (-0.04, 0.04)),
        ({ID: PlanarPose(1.0, 2.0, math.pi / 2)}, "site", (0.96, 1.96)),
    ):
        session, out = tmp_path / f"{frame}.mcap", tmp_path / f"{frame}-solved.mcap"
        record(session, replace(TAGS, site=site))
        assert locatk("solve", session, "-o", out).exit_code == 0
        ((_, update),) = Session.open(out).decoded("/scene", SceneUpdate)
        (tag,) = [entity for entity in update.entities if entity.id == f"tag/{ID}"]
        assert tag.frame_id == frame
        assert len(tag.cylinders) == len(tag.arrows) == 5
        first = tag.cylinders[0].pose.position  # v1, by definition the first of a layout
        np.testing.assert_allclose((first.x, first.y), corner, atol=1e-12)
        assert tag.cylinders[0].size.x == 0.002


# ---- calibrate tag

BUILT = AsBuiltTag(
    1e-4 * np.array([[3.0, -2], [-4, 1], [2, 5], [0, -3], [-1, -1]]),
    np.radians([4.3, -2.2, 13.0, 0.0, -2.8]),
)


def passes(count: int = 4) -> list[list[TagDetection]]:
    """Detections of one tag that lies there as built, from several sides."""
    real = replace(TAGS, built={ID: BUILT})
    return [[detection(real, ID, (0.01 * k, -0.002 * k, 1.1 * k))] for k in range(count)]


def true_shape() -> np.ndarray:
    """(5, 3) places and angles of the magnets, where the mean offset and turn are none."""
    layout = layout_of(TAGS, ID)
    nominal = cell_positions(TAGS, layout.cells)
    place = nominal + BUILT.offset_m
    u, _, vt = np.linalg.svd((place - place.mean(0)).T @ (nominal - nominal.mean(0)))
    turn = u @ vt
    moved = (place - place.mean(0)) @ turn + nominal.mean(0)
    angle = BUILT.angle_rad + math.atan2(turn[0, 1], turn[0, 0])
    return np.column_stack([moved - nominal, angle])


def test_passes_say_how_a_tag_was_built(locatk, solver: Solver, tmp_path: Path) -> None:
    solver.seen = passes()
    sessions = [record(tmp_path / f"run{k}.mcap") for k in range(4)]
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "tag", *sessions, "-o", out, "--speed", 0.1, "--json")
    assert result.exit_code == 0, result.stderr
    assert solver.asked == [(TAGS, "joint", 0.1)] * 4
    known = tags.read_tags(out)
    built = known.built[ID]
    assert built.passes == 4
    expected = true_shape()
    np.testing.assert_allclose(built.offset_m, expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(built.angle_rad, expected[:, 2], atol=1e-9)
    assert replace(known, built={}) == TAGS
    answer = json.loads(result.stdout)
    (tag,) = answer["tags"]
    assert (tag["id"], len(tag["used"]), tag["disagree"]) == (ID, 4, [])
    assert {m["passes"] for m in tag["magnets"]} == {4}
    assert max(m["scatter_m"] for m in tag["magnets"]) < 1e-9
    text = locatk("calibrate", "tag", *sessions, "-o", out, "--overwrite").stdout
    assert f"tag {ID}, 4 passes" in text


def test_mean_offset_and_rotation_are_none() -> None:
    layout = layout_of(TAGS, ID)
    nominal = cell_positions(TAGS, layout.cells)
    offset = true_shape()[:, :2]
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=1e-15)
    arms = nominal - nominal.mean(axis=0)
    turn = arms[:, 0] * offset[:, 1] - arms[:, 1] * offset[:, 0]
    assert abs(turn.sum()) < 1e-12
    assert symbol_angles(TAGS, layout.symbols).shape == (5,)


def test_a_pass_that_disagrees_is_named_and_left_out(
    locatk, solver: Solver, tmp_path: Path
) -> None:
    solver.seen = passes(5)
    (found,) = solver.seen[3]
    magnets = list(found.magnets)
    magnets[2] = replace(magnets[2], x_m=magnets[2].x_m + 0.004)
    solver.seen[3] = [replace(found, magnets=tuple(magnets))]
    sessions = [record(tmp_path / f"run{k}.mcap") for k in range(5)]
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "tag", *sessions, "-o", out, "--json")
    assert result.exit_code == 3
    (tag,) = json.loads(result.stdout)["tags"]
    assert tag["disagree"] == [f"{sessions[3]} at 1.000 s"]
    assert "run3.mcap at 1.000 s: disagrees" in result.stderr
    expected = true_shape()
    built = tags.read_tags(out).built[ID]
    assert built.passes == 4
    np.testing.assert_allclose(built.offset_m, expected[:, :2], atol=1e-9)


def test_one_pass_is_too_few(locatk, solver: Solver, tmp_path: Path) -> None:
    session, out = record(tmp_path / "run.mcap"), tmp_path / "built.toml"
    for seen, words in (
        (passes(1)[0], "the only one over tag"),
        ([detection(TAGS, None, (0, 0, 0))], "not read: magnet missing"),
        ([], "no tag was detected"),
    ):
        solver.seen = [seen]
        result = locatk("calibrate", "tag", session, "-o", out)
        assert result.exit_code == 1
        assert "no tag was read in 2 passes" in result.stderr
        assert words in result.stderr
        assert "Pass each tag at least twice" in result.stderr
    assert not out.exists()


def test_a_pass_counts_once(locatk, solver: Solver, tmp_path: Path) -> None:
    """Whether its file is given twice, copied, or decoded again."""
    solver.seen = passes()
    first, second = (record(tmp_path / f"run{k}.mcap") for k in range(2))
    copy = Path(shutil.copy(first, tmp_path / "copy.mcap"))
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "tag", first, second, copy, second, "-o", out, "--json")
    assert result.exit_code == 3
    assert f"{copy}: the same measurements as in {first}" in result.stderr
    assert f"{second}: the same measurements as in {second}" in result.stderr
    assert tags.read_tags(out).built[ID].passes == 2
    (tag,) = json.loads(result.stdout)["tags"]
    assert len(tag["used"]) == 2


def test_an_earlier_calibration_does_not_come_back(locatk, solver: Solver, tmp_path: Path) -> None:
    """The solver must see the magnets, not what was believed of them; other tags stay."""
    solver.seen = passes()
    other = AsBuiltTag(np.zeros((5, 2)), np.full(5, 0.1), 3)
    before = replace(TAGS, built={ID: other, 7: other}, notes=("kept",))
    artifact, out = tmp_path / "before.toml", tmp_path / "after.toml"
    tags.write_tags(artifact, before)
    sessions = [record(tmp_path / f"run{k}.mcap") for k in range(4)]
    result = locatk("calibrate", "tag", *sessions, "--artifact", artifact, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert all(not known.built for known, *_ in solver.asked)
    after = tags.read_tags(out)
    assert after.notes == ("kept",)
    assert set(after.built) == {7, ID}
    np.testing.assert_array_equal(after.built[7].angle_rad, other.angle_rad)
    np.testing.assert_allclose(after.built[ID].angle_rad, true_shape()[:, 2], atol=1e-9)


def test_tags_of_two_designs_are_not_mixed(locatk, solver: Solver, tmp_path: Path) -> None:
    solver.seen = passes()
    sessions = [record(tmp_path / f"run{k}.mcap") for k in range(3)]
    sessions.append(record(tmp_path / "other.mcap", replace(TAGS, spacing_m=0.03)))
    result = locatk("calibrate", "tag", *sessions, "-o", tmp_path / "built.toml")
    assert result.exit_code == 3
    assert "other.mcap: the spacing of the tags differs from that of the first" in result.stderr
    assert tags.read_tags(tmp_path / "built.toml").built[ID].passes == 3


# ---- several designs


@pytest.mark.slow
def test_a_pass_is_solved_by_the_design_of_its_tag(locatk, tmp_path: Path) -> None:
    small, large, run = (tmp_path / name for name in ("small.toml", "large.toml", "run.mcap"))
    tags.write_tags(small, replace(TAGS, spacing_m=0.03))
    tags.write_tags(large, Tags(order=4, magnets=8, spacing_m=0.03))
    simulated = locatk("simulate", "polaris", large, "-o", run, "--seed", 3)
    assert simulated.exit_code == 0, simulated.stderr
    out = tmp_path / "solved.mcap"
    for files in ((small, large), (large, small)):
        designs = [word for path in files for word in ("--tag", path)]
        result = locatk("solve", run, *designs, "-o", out, "--overwrite", "--json")
        assert result.exit_code == 0, result.stderr
        (detection,) = json.loads(result.stdout)["sessions"][0]["detections"]
        assert (detection["design"], len(detection["magnets"])) == ("large.toml", 8)
        assert detection["other_magnets"] == []
        solution = solutions.read_solution(out)
        assert solution.artifact == tags.read_tags(large)
        assert solution.detections[0].design == "large.toml"
    wrong = locatk("solve", run, "--tag", small, "-o", out, "--overwrite", "--json")
    assert wrong.exit_code == 3
    (detection,) = json.loads(wrong.stdout)["sessions"][0]["detections"]
    assert (detection["tag_id"], detection.get("design")) == (None, None)


def test_designs_are_given_once(locatk, tmp_path: Path) -> None:
    run, first, again = tmp_path / "run.mcap", tmp_path / "a.toml", tmp_path / "b.toml"
    for path in (first, again):
        tags.write_tags(path, TAGS)
    args = ("import", "polaris-csv", published(tmp_path / "run.csv"), "--rate", 40)
    assert locatk(*args, "--spacing", 20, "-o", run).exit_code == 0
    result = locatk("solve", run, "--tag", first, "--tag", again)
    assert result.exit_code == 1
    assert "the same tags as in a.toml" in result.stderr
    result = locatk("solve", run, "--tag", first, "--tag", first)
    assert "two designs of tags are named a.toml" in result.stderr
    result = locatk("solve", run, "--artifact", first, "--tag", again)
    assert result.exit_code == 2
    assert "--artifact and --tag both replace the tags" in result.stderr
