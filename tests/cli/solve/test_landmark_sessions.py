"""Robots over landmarks on the command line: import, info, solve, what viewers get."""

from __future__ import annotations

import json
import math
import sys
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.halls import NAMES, HallSamples, HallSensors, circle
from locatk.core.landmarks.landmark import code_of
from locatk.core.landmarks.map.floor import AsBuiltLandmark, FloorMap
from locatk.core.landmarks.results import LandmarkDetection, LandmarkFacts, RobotFacts
from locatk.core.landmarks.simulation.session import SimulationOptions, simulate
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import maps
from locatk.formats.sessions import field_samples, observations, solutions
from locatk.formats.sessions.reader import Session

START_NS = 1_700_000_000_000_000_000

FLOOR = FloorMap(
    np.array([[code_of("NNNS"), code_of("NSNS"), -1], [code_of("SSSS"), code_of("NNSS"), 5]]),
    walls=frozenset({((0, 0), (0, 1))}),
    built={
        (1, 1): AsBuiltLandmark(
            0.002, 0.0, 0.0, np.array([1.0, 0.9, 0.0, -1.0]), np.full(7, np.nan), 4, ("missing:2",)
        )
    },
    name="lab",
)


def write_map(path: Path, floor: FloorMap = FLOOR) -> Path:
    maps.write_map(path, floor, overwrite=True)
    return path


def odometry(n: int = 40, device: str = "robot") -> Trajectory:
    return Trajectory.from_positions(
        device,
        "odometry",
        START_NS + 10_000_000 * np.arange(n),
        np.column_stack([0.005 * np.arange(n), np.zeros(n), np.zeros(n)]),
    )


def record(
    path: Path,
    floor: FloorMap | None = FLOOR,
    devices: tuple[str, ...] = ("robot",),
    driven: tuple[str, ...] = ("robot",),
) -> Path:
    """A session of nothing but noise."""
    field = np.random.default_rng(1).normal(size=(40, 4)) * 1e-4
    time_ns = START_NS + 10_000_000 * np.arange(40)
    field_samples.write_halls(
        path,
        [HallSamples(device, HallSensors(noise_t=1e-4), time_ns, field) for device in devices],
        floor=floor,
        odometry=[odometry(device=device) for device in driven],
    )
    return path


# ---- import


def log(path: Path, n: int = 40, cells: dict[tuple[int, int], str] | None = None) -> Path:
    """A robot's log in millivolts, milliseconds and degrees, in an order of its own."""
    rng = np.random.default_rng(4)
    lines = ["h4,h3,h2,h1,yaw,odom_y,odom_x,time"]
    for row in range(n):
        texts = [f"{v:.3f}" for v in rng.normal(2500, 20, 4)]
        texts += ["0.0", "0.0", repr(0.005 * row), str(10 * row)]
        for (at, column), text in (cells or {}).items():
            if at == row:
                texts[column] = text
        lines.append(",".join(texts))
    path.write_text("\n".join(lines) + "\n")
    return path


NAMED = "t=time,x=odom_x,y=odom_y,heading=yaw,front=h1,left=h2,rear=h3,right=h4"
VOLTS = ("--volts-per-tesla", "13", "--zero-volts", "2.5")
TOLD = ("--columns", NAMED, "--units", "ms,m,deg,mv", *VOLTS)


def test_a_log_becomes_a_session(locatk, tmp_path: Path) -> None:
    run, out, floor = (
        log(tmp_path / "run.csv"),
        tmp_path / "run.mcap",
        write_map(tmp_path / "m.toml"),
    )
    args = ("import", "landmark-csv", run, *TOLD, "--map", floor, "-o", out)
    result = locatk(*args, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout) == {
        "version": 1,
        "output": str(out),
        "format": "landmark-csv",
        "samples": 40,
        "sensors": 4,
        "devices": ["robot"],
        "odometry_poses": 40,
        "left_out": 0,
        "left_out_poses": 0,
        "warnings": [],
    }
    session = Session.open(out)
    assert session.facts["system"] == "landmarks"
    assert "front=h1 [mv]" in session.metadata()["facts"]["columns"]
    (samples,) = observations.read_halls(session)
    assert samples.sensors.names == NAMES
    np.testing.assert_array_equal(samples.sensors.position_m, circle())
    first = [float(v) for v in run.read_text().splitlines()[1].split(",")[:4]]
    wanted = (np.array(first[::-1]) * 1e-3 - 2.5) / 13
    np.testing.assert_allclose(samples.field_t[0], wanted, rtol=1e-5)
    (driven,) = observations.read_odometry(session)
    assert (driven.device, driven.frame) == ("robot", "odometry")
    assert driven.position[-1, 0] == pytest.approx(0.195)
    attached = observations.read_map(session)
    assert attached is not None
    assert maps.dumps_map(attached) == maps.dumps_map(FLOOR)
    again = locatk(*args)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr


def test_sensors_and_start_are_reported(locatk, tmp_path: Path) -> None:
    run, out = log(tmp_path / "run.csv"), tmp_path / "run.mcap"
    args = ("import", "landmark-csv", run, *TOLD, "-o", out, "--overwrite")
    start = ("--start", "2026-01-31T12:00:00Z")
    assert locatk(*args, "--circle", 30, *start, "--downward").exit_code == 0
    session = Session.open(out)
    (samples,) = observations.read_halls(session)
    np.testing.assert_allclose(samples.sensors.position_m, circle(0.03))
    assert samples.time_ns[0] == 1_769_860_800_000_000_000
    down = samples.field_t
    assert observations.read_map(session) is None

    sensors = HallSensors(("front", "rear"), circle()[::2], range_t=0.02, sensor="SS49E")
    maps.write_halls(tmp_path / "halls.toml", sensors)
    named = NAMED.split(",left")[0] + ",rear=h3"
    told = ("--columns", named, *TOLD[2:], "--halls", tmp_path / "halls.toml")
    result = locatk("import", "landmark-csv", run, *told, "-o", out, "--overwrite")
    assert result.exit_code == 0, result.stderr
    assert "No --map" in result.stderr
    (samples,) = observations.read_halls(Session.open(out))
    assert (samples.sensors.sensor, samples.sensors.range_t) == ("SS49E", 0.02)
    np.testing.assert_allclose(samples.field_t, -down[:, ::2], rtol=1e-6)


def test_omissions_are_reported(locatk, tmp_path: Path) -> None:
    run = log(tmp_path / "run.csv", cells={(3, 0): "", (7, 0): "nan"})
    out = tmp_path / "run.mcap"
    result = locatk("import", "landmark-csv", run, *TOLD, "--circle", 25, "-o", out, "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["left_out"] == 2
    assert f"{run}:5: h4 has no number in 2 rows; excluded" in result.stderr
    assert "Incomplete: 2 of 160 readings are excluded." in result.stderr
    assert len(Session.open(out).topics("/log")) == 1


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (TOLD, 2, "needs --circle, --halls or --map"),
        ((*TOLD, "--circle", 25, "--halls", "run.csv"), 2, "--circle or --halls, not both"),
        ((*TOLD, "--circle", 0), 2, "--circle"),
        ((*TOLD, "--circle", 25, "--rate", 40), 2, "--rate means nothing"),
        ((*TOLD, "--circle", 25, "--start", "noon"), 2, "not a time in UTC"),
        ((*TOLD[:4], *VOLTS[:2], "--circle", 25), 2, "Voltages need --zero-volts too"),
        ((*TOLD[:4], "--circle", 25), 1, "voltages without a conversion"),
        ((*TOLD[:2], *VOLTS, "--circle", 25), 1, "the unit of column 'time' is missing"),
        (("--columns", "t=a,t=b", "--circle", 25), 2, "t occurs twice"),
        (("--columns", "t:time", "--circle", 25), 2, "'t:time' is not KEY=NAME"),
        ((*TOLD[:4], "--volts-per-tesla", "x", "--circle", 25), 2, "'x' is not numbers"),
        ((*TOLD, "--map", "none.toml"), 1, "No such file"),
        (("--units", "s,m,rad,t", "--circle", 25), 1, "a column for x is missing"),
        ((*TOLD, "--circle", 25, "run.csv"), 2, "takes one PATH"),
    ],
)
def test_wrong_use_of_the_format(
    locatk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: tuple, status: int, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    log(Path("run.csv"))
    result = locatk("import", "landmark-csv", "run.csv", "-o", "run.mcap", *args)
    assert result.exit_code == status
    assert words in result.stderr
    assert not Path("run.mcap").exists()
    assert "Traceback" not in result.stderr


def test_options_of_this_format(locatk, tmp_path: Path) -> None:
    run = log(tmp_path / "run.csv")
    for more in (("--volts-per-tesla", "3"), ("--downward",), ("--circle", 25)):
        result = locatk("import", "images", run, *more, "-o", tmp_path / "run.mcap")
        assert result.exit_code == 2
        assert f"{more[0]} means nothing to the format images" in result.stderr


# ---- info


def test_info_describes_samples_sensors_and_map(locatk, tmp_path: Path) -> None:
    run = record(tmp_path / "run.mcap")
    facts = json.loads(locatk("info", run, "--json").stdout)
    assert (facts["system"], facts["samples"], facts["devices"]) == ("landmarks", 40, ["robot"])
    (robot,) = facts["halls"]
    assert robot["rate_hz"] == pytest.approx(100)
    assert (robot["names"], robot["noise_ut"], robot["range_mt"]) == (list(NAMES), 100, None)
    assert (facts["rows"], facts["columns"], facts["landmarks"]) == (2, 3, 5)
    assert facts["patterns"]["NSNS"] == 2
    assert facts["map"] == ["75.", "035"]
    text = locatk("info", run).stdout
    words = " ".join(text.split())
    assert "2 rows x 3 columns 200 mm apart, lab, alphabet 16, window L, 1 without a" in words
    assert all(words.count(f" {sensor}") for sensor in ("front 25,0", "left 0,25", "rear -25,0"))
    # Seen from above: the row of the least y is the lowest.
    drawn = text.splitlines()
    assert drawn[drawn.index("  1  035") + 1] == "  0  75."


def test_info_describes_artifacts(locatk, tmp_path: Path) -> None:
    path = write_map(tmp_path / "map.toml")
    facts = json.loads(locatk("info", path, "--json").stdout)
    assert (facts["kind"], facts["pitch_mm"], facts["walls"]) == ("map", 200, 1)
    (built,) = facts["built"]
    assert (built["cell"], built["x_mm"], built["flags"]) == ([1, 1], 2, ["missing:2"])
    text = " ".join(locatk("info", path).stdout.split())
    assert "30 x 10 x 5 mm, 1.2 T, 25 mm from the centre, 12 mm below the sensors" in text
    assert "missing:2" in text

    path = tmp_path / "halls.toml"
    maps.write_halls(path, HallSensors())
    facts = json.loads(locatk("info", path, "--json").stdout)
    assert (facts["kind"], facts["halls"][0]["sensors"]) == ("halls", 4)
    assert locatk("info", path).exit_code == 0

    path.write_text(path.read_text().replace("position_mm", "place_mm"))
    result = locatk("info", path)
    assert result.exit_code == 1
    assert f"Error: {path}: missing key 'position_mm'" in result.stderr


def test_info_of_a_damaged_session(locatk, tmp_path: Path) -> None:
    from locatk.formats.sessions.writer import SessionWriter

    bad = tmp_path / "bad.mcap"
    with SessionWriter(bad, system="landmarks") as writer:
        writer.attach("map.toml", b"format = 3", "application/toml")
    result = locatk("info", bad)
    assert result.exit_code == 3
    assert "expected a string, not a number" in result.stderr


# ---- solve, whatever the solver does


def detection(
    cell: tuple[int, int] | None, refused: str = "", time_s: float = 0.1
) -> LandmarkDetection:
    """What a solver says of one visit."""
    return LandmarkDetection(
        time_s=START_NS * 1e-9 + time_s,
        device="robot",
        cell=cell,
        pattern="NNNS",
        code=7,
        probability=0.9876,
        x_m=0.001,
        y_m=-0.002,
        heading_rad=0.5,
        sigma_x_m=1e-4,
        sigma_y_m=2e-4,
        sigma_heading_rad=1e-3,
        strength=(1.0, -1.0, 1.0, 1.0),
        residual_sigma=1.1,
        refused=refused,
    )


def told(localised: bool = True, **more: Any) -> LandmarkFacts:
    robot = RobotFacts(
        localised=localised, probability=0.4, landmarks_seen=2, landmarks_to_localise=None
    )
    return LandmarkFacts({"robot": replace(robot, **more)})


class Solver:
    """Stands in for the solver: keeps what it was asked, answers with what it was given."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.seen = [detection((0, 0)), detection((1, 0), time_s=0.3)]
        self.facts: LandmarkFacts | None = told()
        self.poses = 5

    def solve(
        self, samples: Any, floor: FloorMap | None = None, wanted: Any = None, *, odometry: Any = ()
    ) -> Solution:
        self.asked.append((floor, wanted.method, len(samples), len(odometry)))
        n = self.poses
        path = Trajectory(
            "robot",
            "map",
            START_NS + 80_000_000 * np.arange(n),
            np.column_stack([np.zeros(n), np.linspace(0, 0.2, n), np.zeros(n)]),
            quaternion_from_heading(np.full(n, math.pi / 2)),
            np.broadcast_to(np.eye(6) * 1e-8, (n, 6, 6)),
        )
        refused = {"too_short": 1}
        paths = (path,) if n else ()
        return Solution(
            "landmarks",
            wanted.method,
            paths,
            refused,
            tuple(self.seen),
            floor,
            (SolverWarning("test", "a note"),),
            self.facts,
        )


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> Solver:
    made, module = Solver(), types.ModuleType("locatk.core.landmarks.solver")

    class SolveOptions:
        def __init__(self, method: str = "field") -> None:
            self.method = method

    module.SolveOptions, module.solve = SolveOptions, made.solve  # type: ignore[attr-defined]
    import locatk.core.landmarks as system

    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(system, "solver", module, raising=False)
    return made


def test_a_solution_holds_map_landmarks_and_poses(locatk, solver: Solver, tmp_path: Path) -> None:
    session, out = record(tmp_path / "run.mcap"), tmp_path / "solved.mcap"
    result = locatk("solve", session, "-o", out, "--method", "paper", "--json")
    assert result.exit_code == 0, result.stderr
    ((floor, *rest),) = solver.asked
    assert rest == ["paper", 1, 1]
    assert maps.dumps_map(floor) == maps.dumps_map(FLOOR)
    (entry,) = json.loads(result.stdout)["sessions"]
    assert (entry["system"], entry["method"], entry["poses"]) == ("landmarks", "paper", 5)
    contract = {"time_s", "cell", "pattern", "probability", "x_m", "y_m", "heading_rad"}
    assert contract <= set(entry["detections"][0])
    assert entry["facts"]["robots"]["robot"]["localised"] is True

    solution = solutions.read_solution(out)
    assert maps.dumps_map(solution.artifact) == maps.dumps_map(FLOOR)
    assert solution.detections == tuple(solver.seen)
    assert solution.facts == solver.facts
    facts = json.loads(locatk("info", out, "--json").stdout)
    assert (facts["kind"], facts["system"], facts["landmarks"]) == ("solution", "landmarks", 5)
    assert locatk("export", out, "--format", "csv", "-o", tmp_path / "poses.csv").exit_code == 0
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 6


def test_people_see_a_table_of_landmarks(locatk, solver: Solver, tmp_path: Path) -> None:
    session = record(tmp_path / "run.mcap")
    solver.seen[1] = replace(solver.seen[1], probability=0.99999)
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap")
    assert result.exit_code == 0
    first, second = (line.split() for line in result.stdout.splitlines() if "NNNS" in line)
    assert first[:4] == ["22:13:20.100", "0,0", "NNNS", "98.8"]
    assert first[4:] == ["1.00", "±", "0.1", "-2.00", "±", "0.2", "28.65", "±", "0.057"]
    assert second[:4] == ["22:13:20.300", "1,0", "NNNS", ">99.9"]
    assert "rejected: 1 too short" in result.stdout
    assert "run.mcap: a note" in result.stderr


def test_a_long_drive_is_listed_in_part(locatk, solver: Solver, tmp_path: Path) -> None:
    solver.seen = [detection((0, 0), time_s=n) for n in range(90)]
    result = locatk("solve", record(tmp_path / "run.mcap"), "-o", tmp_path / "solved.mcap")
    assert result.stdout.count("NNNS") == 40
    assert "... and 50 more: see --json" in result.stdout


@pytest.mark.parametrize(
    ("facts", "seen", "poses", "words"),
    [
        (
            told(False),
            [detection(None)],
            0,
            "not localised: the likeliest position has a probability",
        ),
        (told(False, landmarks_seen=0), [], 0, "robot is not localised: no landmark was detected"),
        (told(False, probability=None), [], 0, "robot is not localised."),
        (None, [], 0, "no pose at all"),
        (told(), [detection((0, 0), "misread")] * 2, 5, "2 landmarks differ from the map"),
        (told(), [detection(None, "no_landmark")], 5, "1 landmark refused (no landmark)"),
    ],
)
def test_unsolved_parts_are_losses(
    locatk, solver: Solver, tmp_path: Path, facts: Any, seen: Any, poses: int, words: str
) -> None:
    solver.facts, solver.seen, solver.poses = facts, seen, poses
    out = tmp_path / "solved.mcap"
    result = locatk("solve", record(tmp_path / "run.mcap"), "-o", out, "--json")
    assert result.exit_code == 3, result.stderr
    assert words in result.stderr
    assert len(json.loads(result.stdout)["sessions"][0]["detections"]) == len(seen)
    assert len(solutions.read_solution(out).detections) == len(seen)


def test_without_a_map_there_is_no_position(locatk, solver: Solver, tmp_path: Path) -> None:
    solver.facts, solver.seen, solver.poses = told(False), [detection(None)], 0
    session = record(tmp_path / "run.mcap", floor=None)
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap")
    assert result.exit_code == 3
    assert "robot is not localised: no map of the floor" in result.stderr
    assert solver.asked[0][0] is None
    # The map may come later.
    other = write_map(tmp_path / "other.toml", replace(FLOOR, name="other"))
    solver.facts, solver.poses = told(), 5
    out = tmp_path / "solved.mcap"
    result = locatk("solve", session, "-o", out, "--artifact", other, "--overwrite")
    assert result.exit_code == 0, result.stderr
    assert solver.asked[1][0].name == "other"
    assert solutions.read_solution(out).artifact.name == "other"


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (("--method", "joint"), 1, "no method 'joint' for landmarks"),
        (("--speed", 0.1), 1, "--speed is not an option of landmarks"),
        (("--scene", "auto"), 1, "--scene is not an option of landmarks"),
        (("--camera", "run.mcap"), 1, "--camera is not an option of landmarks"),
        (("--save-scene", "s.toml"), 2, "--save-scene is for lighthouse"),
        (("--artifact", "bad.toml"), 1, "bad.toml:map.rows[1]"),
    ],
)
def test_wrong_use_of_solve(
    locatk,
    solver: Solver,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    args: tuple,
    status: int,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    record(Path("run.mcap"))
    write_map(Path("bad.toml"))
    Path("bad.toml").write_text(Path("bad.toml").read_text().replace('"035"', '"0x5"'))
    result = locatk("solve", "run.mcap", "-o", "solved.mcap", *args)
    assert result.exit_code == status
    assert words in result.stderr
    assert not solver.asked


def test_a_recording_without_odometry_is_refused(locatk, solver: Solver, tmp_path: Path) -> None:
    for devices, driven in ((("robot",), ()), (("robot", "slow"), ("robot",))):
        path = record(tmp_path / f"{len(devices)}.mcap", devices=devices, driven=driven)
        result = locatk("solve", path, "-o", tmp_path / "solved.mcap")
        assert result.exit_code == 1
        assert f"Error: {path}: no odometry of {devices[-1]}. Hint: " in result.stderr
        assert f"/odometry/{devices[-1]}" in result.stderr
    assert not solver.asked


# ---- what viewers and pictures get


def test_viewers_see_the_bars(locatk, solver: Solver, tmp_path: Path) -> None:
    out = tmp_path / "solved.mcap"
    assert locatk("solve", record(tmp_path / "run.mcap"), "-o", out).exit_code == 0
    (scene,) = [message for _, message in Session.open(out).decoded("/scene", SceneUpdate)]
    entities = {entity.id: entity for entity in scene.entities}
    assert len(entities) == 6  # five landmarks and the path
    assert {entity.frame_id for entity in scene.entities} == {"map"}
    first = entities["landmark/0,0"]
    assert {pair.key: pair.value for pair in first.metadata} == {"cell": "0,0", "bars": "NNNS"}
    # A bar that is N is magnetised counter-clockwise: the right-hand one of cell 0,0 upward.
    assert len(first.cubes) == len(first.arrows) == 4
    arrow = first.arrows[0].pose
    assert (arrow.position.x, arrow.position.y) == pytest.approx((0.025, -0.015))
    turn = arrow.orientation
    assert heading_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])) == pytest.approx(
        math.pi / 2
    )
    # The last one is S, at the bottom: clockwise is to the left there.
    last = first.arrows[3].pose
    assert (last.position.x, last.position.y) == pytest.approx((0.015, -0.025))
    # As built: 2 mm aside, and one bar is missing.
    built = entities["landmark/1,1"]
    assert (len(built.cubes), len(built.arrows)) == (4, 3)
    assert built.cubes[0].pose.position.x == pytest.approx(0.227)
    assert ("flags", "missing:2") in [(pair.key, pair.value) for pair in built.metadata]


# ---- the real thing


@pytest.mark.slow
def test_from_a_log_to_poses(locatk, tmp_path: Path) -> None:
    """Simulated, written as a table, imported again and solved: within 2 mm of the truth."""
    from locatk.core.landmarks.design.generation import DesignOptions, design_map

    floor = design_map(DesignOptions(rows=4, columns=5, seed=3))
    board, run = write_map(tmp_path / "map.toml", floor), tmp_path / "run.mcap"
    args = ("--seed", 5, "--landmarks", 4, "-o", run)
    assert locatk("simulate", "landmarks", board, *args).exit_code == 0
    session = Session.open(run)
    (samples,), (driven,) = observations.read_halls(session), observations.read_odometry(session)
    poses = dict(
        zip(
            driven.time_ns.tolist(),
            zip(
                driven.position[:, 0].tolist(),
                driven.position[:, 1].tolist(),
                np.degrees(heading_from_quaternion(driven.quaternion)).tolist(),
                strict=True,
            ),
            strict=True,
        )
    )
    lines = ["time_ns,x_m,y_m,heading_deg,front,left,rear,right"]
    for time_ns, field in zip(samples.time_ns.tolist(), samples.field_t.tolist(), strict=True):
        pose = ",".join(map(repr, poses.get(time_ns, ()))) or ",,"
        lines.append(f"{time_ns},{pose}," + ",".join(repr(1e3 * b) for b in field))
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    again = tmp_path / "again.mcap"
    args = ("--units", "mt", "--map", board, "-o", again)
    result = locatk("import", "landmark-csv", tmp_path / "log.csv", *args)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("Warning") == 0
    out = tmp_path / "solved.mcap"
    result = locatk("solve", again, "-o", out, "--json")
    assert result.exit_code in (0, 3), result.stderr
    (entry,) = json.loads(result.stdout)["sessions"]
    assert entry["facts"]["robots"]["robot"]["localised"]
    score = json.loads(locatk("eval", out, "--truth", run, "--json").stdout)
    assert score["mae_m"] < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("start_ns", [0, 3_210_000_000, 1_700_000_000_123_456_000])
def test_exported_times_are_those_of_the_table(
    tmp_path: Path, locatk: Callable[..., Result], start_ns: int
) -> None:
    floor = FloorMap(np.random.default_rng(11).integers(0, 16, (4, 4)))
    cells = ((0, 0), (0, 3), (3, 3))
    options = SimulationOptions(strategy="path", cells=cells, rate_hz=50.0, seed=2)
    session = simulate(floor, options)
    (samples,), (path,) = session.samples, session.odometry
    heading = heading_from_quaternion(path.quaternion)
    lines = ["t_s,x_m,y_m,heading_rad,front_t,left_t,rear_t,right_t"]
    for k, elapsed_ns in enumerate((samples.time_ns - samples.time_ns[0]).tolist()):
        seconds, rest = divmod(start_ns + elapsed_ns, 1_000_000_000)
        values = (*path.position[k, :2], heading[k], *samples.field_t[k])
        lines.append(",".join([f"{seconds}.{rest:09d}", *(f"{value:.9g}" for value in values)]))
    table = tmp_path / "run.csv"
    table.write_text("\n".join(lines) + "\n")
    recorded, solved = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    exported = tmp_path / "poses.csv"
    map_file = write_map(tmp_path / "map.toml", floor)
    for args in (
        ("import", "landmark-csv", table, "--map", map_file, "-o", recorded),
        ("solve", recorded, "-o", solved),
        ("export", solved, "--format", "csv", "-o", exported),
    ):
        assert locatk(*args).exit_code in (0, 3)
    times = [line.split(",")[0] for line in exported.read_text().splitlines()[1:]]
    assert len(times) > 100
    assert set(times) <= {line.split(",")[0] for line in lines}
