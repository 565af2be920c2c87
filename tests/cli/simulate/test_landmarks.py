"""`locatk simulate landmarks` as a user runs it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.halls import HallSensors, circle
from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.landmarks.published.driver import published_driver
from locatk.core.landmarks.simulation.session import (
    Aims,
    Errors,
    Faults,
    RobotLimits,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.formats.artifacts import maps
from locatk.formats.sessions.field_samples import read_halls
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_odometry, read_truth

CODES = np.array([[1, 5, 9, 14], [7, 3, 12, 8], [15, HOLE_CODE, 2, 6]])


@pytest.fixture
def floor(tmp_path: Path) -> Path:
    """A map of three rows."""
    path = tmp_path / "map.toml"
    maps.write_map(path, FloorMap(CODES))
    return path


SETTINGS = """
format = "locatk-simulation-landmarks"
format_version = 1

[robot]
start = { x_mm = 100, y_mm = 100, heading_deg = 20 }
landmarks = 2
spins = 1
acceleration_mps2 = 0.5
turn_rate_dps = 120
turn_acceleration_dps2 = 500
rest_s = 0.2

[aims]
first_mm = 5
second_mm = 1
step_mm = 2
heading_deg = 0.5

[sensors]
range_mt = 20
quantum_mt = 0.02

[errors]
offset_mt = 0.2
gain_fraction = 0.02
earth_ut = -30
height_mm = 1
bar_strength_fraction = 0.05
bar_position_mm = 0.4
bar_angle_deg = 2
bar_tilt_deg = 1
landmark_position_mm = 2
landmark_angle_deg = 1

[odometry]
rate_hz = 40
scale_fraction = 0.02
rotation_fraction = 0.03
drift_deg_per_m = 2
wheel_noise_mm = 0.1
slips_per_m = 1
slip_mm = 3

[faults]
missing_bars = [{ cell = [1, 2], bar = 3 }]
displaced_landmarks = [{ cell = [0, 0], x_mm = 4, y_mm = -2.5 }]
misread_fraction = 0.1
dead_sensors = ["rear"]
stuck_sensors = ["right"]
swapped_sensors = [["front", "left"]]
"""
"""Settings that have no option of their own, and one that has."""


def holds(path: Path, wanted: SimulatedSession) -> Session:
    """The session at ``path``, which holds what was simulated."""
    session = Session.open(path)
    (samples,) = read_halls(session)
    assert samples.field_t == pytest.approx(
        wanted.samples[0].field_t, rel=1e-6, abs=1e-12, nan_ok=True
    )
    assert np.array_equal(samples.time_ns, wanted.samples[0].time_ns)
    (truth,), (odometry,) = read_truth(session), read_odometry(session)
    for read, exact in ((truth, wanted.truth[0]), (odometry, wanted.odometry[0])):
        assert (read.device, read.frame) == (exact.device, exact.frame)
        assert np.array_equal(read.time_ns, exact.time_ns)
        assert read.position == pytest.approx(exact.position, abs=1e-9)
        off = heading_from_quaternion(read.quaternion) - heading_from_quaternion(exact.quaternion)
        assert np.cos(off) == pytest.approx(1)
    return session


@pytest.mark.slow
def test_a_session_holds_samples_map_odometry_and_truth(locatk, floor: Path) -> None:
    out = floor.with_name("run.mcap")
    result = locatk(
        "simulate", "landmarks", floor, "-o", out, "--seed", 3, "--landmarks", 4, "--json"
    )
    assert result.exit_code == 0, result.stderr
    wanted = simulate(FloorMap(CODES), SimulationOptions(seed=3, landmarks=4))
    session = holds(out, wanted)
    told = json.loads(result.stdout)
    visits = told.pop("visits")
    assert told == {
        "version": 1,
        "output": str(out),
        "samples": len(wanted.samples[0]),
        "device": "robot",
        "frame": "map",
        "faults": [],
        "saturated": 0,
        "slips_s": [],
        "odometry_poses": len(wanted.odometry[0]),
        "truth_poses": len(wanted.truth[0]),
    }
    assert [tuple(visit["cell"]) for visit in visits] == [one.cell for one in wanted.events]
    assert session.facts["system"] == "landmarks"
    attached = maps.attached_map(session)
    assert attached is not None
    assert np.array_equal(attached.codes, CODES)
    assert not attached.built
    facts = session.metadata()["facts"]
    assert json.loads(facts["simulated_visits"]) == visits
    lying = {tuple(mark["cell"]): mark for mark in json.loads(facts["simulated_floor"])}
    assert set(lying) == {one.cell for one in wanted.events}
    for mark in wanted.installed_landmarks:
        if mark.cell in lying:
            assert lying[mark.cell]["strength"] == pytest.approx(mark.strength.tolist())
            assert lying[mark.cell]["code"] == name(int(CODES[mark.cell]))


def test_each_option_reaches_the_session(locatk, floor: Path) -> None:
    out, config = floor.with_name("run.mcap"), floor.with_name("sim.toml")
    config.write_text(SETTINGS)
    given = (
        *("--landmarks", 4, "--speed", 0.2, "--stop", 0.3, "--rate", 120, "--noise", 0.1),
        *("--flip", "0,1:2", "--flip", "1,1:0", "--seed", 8),
    )
    result = locatk("simulate", "landmarks", floor, "--config", config, "-o", out, *given)
    assert result.exit_code == 0, result.stderr
    errors = Errors(
        noise_t=1e-4,
        offset_t=2e-4,
        gain=0.02,
        earth_t=-30e-6,
        quantum_t=0.02e-3,
        height_m=1e-3,
        bar_strength=0.05,
        bar_place_m=0.4e-3,
        bar_turn_rad=math.radians(2),
        bar_lean_rad=math.radians(1),
        landmark_place_m=2e-3,
        landmark_turn_rad=math.radians(1),
        odometry_scale=0.02,
        odometry_turn=0.03,
        odometry_drift_rad_per_m=math.radians(2),
        wheel_noise_m=1e-4,
        slips_per_m=1.0,
        slip_m=3e-3,
    )
    faults = Faults(
        flipped=(((0, 1), 2), ((1, 1), 0)),
        missing=(((1, 2), 3),),
        displaced=(((0, 0), (4e-3, -2.5e-3)),),
        misread_rate=0.1,
        dead=("rear",),
        stuck=("right",),
        swapped=(("front", "left"),),
    )
    options = SimulationOptions(
        start=(0.1, 0.1, math.radians(20)),
        landmarks=4,
        spins=1,
        limits=RobotLimits(0.2, 0.5, math.radians(120), math.radians(500)),
        rest_s=0.2,
        stop_s=0.3,
        aims=Aims(5e-3, 1e-3, 2e-3, math.radians(0.5)),
        rate_hz=120.0,
        odometry_hz=40.0,
        range_t=0.02,
        errors=errors,
        faults=faults,
        seed=8,
    )
    wanted = simulate(FloorMap(CODES), options)
    session = Session.open(out)
    (samples,) = read_halls(session)
    assert np.array_equal(samples.time_ns, wanted.samples[0].time_ns)
    read, exact = samples.field_t, wanted.samples[0].field_t
    assert np.array_equal(np.isnan(read), np.isnan(exact))
    # To a step at most, where a rounding error of the units tipped the scale.
    assert np.nanmax(np.abs(read - exact)) < 1.1 * 0.02e-3
    assert np.nanmean(np.abs(read - exact)) < 1e-8
    assert samples.sensors.range_t == pytest.approx(0.02)
    (odometry,) = read_odometry(session)
    assert odometry.position == pytest.approx(wanted.odometry[0].position, abs=1e-9)
    # The map is attached as it was designed; only the facts know what is wrong with it.
    attached = maps.attached_map(session)
    assert attached is not None
    assert np.array_equal(attached.codes, CODES)
    facts = json.loads(session.metadata()["facts"]["simulated_floor"])
    assert [0, 1] in [mark["cell"] for mark in facts if "flipped:2" in mark["faults"]]
    assert json.loads(session.metadata()["facts"]["simulated_errors"])["gain"] == 0.02


@pytest.mark.slow
def test_a_path_from_a_file(locatk, floor: Path) -> None:
    way, out = floor.with_name("way.csv"), floor.with_name("run.mcap")
    way.write_text("name,x_mm,y_mm\na,0,0\n\nb,400,0\nc,400.5,200\n")
    config = floor.with_name("sim.toml")
    config.write_text(
        'format = "locatk-simulation-landmarks"\nformat_version = 1\n[errors]\nearth_ut = 0\n'
    )
    given = ("--strategy", "path", "--path", way, "--errors", 0, "--config", config)
    result = locatk("simulate", "landmarks", floor, "-o", out, *given)
    assert result.exit_code == 0, result.stderr
    assert "over landmarks 0,0 0,1 0,2 1,2," in result.stdout
    options = SimulationOptions(
        strategy="path",
        waypoints=((0.0, 0.0), (0.4, 0.0), (0.4005, 0.2)),
        errors=replace(Errors().scaled(0), earth_t=0.0),
    )
    holds(out, simulate(FloorMap(CODES), options))
    way.write_text("x,y\n0,0\n")
    result = locatk("simulate", "landmarks", floor, "-o", out, "--overwrite", *given)
    assert result.exit_code == 1
    assert "columns 'x_mm', 'y_mm' are missing" in result.stderr
    assert "way.csv:1" in result.stderr
    way.write_text("x_mm,y_mm\n0,0\n1,one\n")
    result = locatk("simulate", "landmarks", floor, "-o", out, "--overwrite", *given)
    assert result.exit_code == 1
    assert "way.csv:3" in result.stderr


@pytest.mark.slow
def test_a_path_of_cells_and_a_pass_with_other_sensors(locatk, floor: Path) -> None:
    out, file = floor.with_name("run.mcap"), floor.with_name("halls.toml")
    cells = ("--cell", "0,0", "--cell", "0,3", "--cell", "1,3")
    result = locatk("simulate", "landmarks", floor, "-o", out, "--strategy", "path", *cells)
    assert result.exit_code == 0, result.stderr
    assert "over landmarks 0,0 0,1 0,2 0,3 1,3," in result.stdout
    sensors = HallSensors(position_m=circle(0.03), range_t=0.015, noise_t=1e-4)
    maps.write_halls(file, sensors)
    config = floor.with_name("sim.toml")
    config.write_text(
        'format = "locatk-simulation-landmarks"\nformat_version = 1\n'
        '[robot]\nstrategy = "pass"\nlateral_mm = 5\napproach_deg = 90\n'
        '[sensors]\nfile = "halls.toml"\n'
    )
    given = ("--config", config, "--cell", "1,1")
    result = locatk("simulate", "landmarks", floor, "-o", out, *given, "--overwrite")
    assert result.exit_code == 0, result.stderr
    assert "readings are at the end of the sensors' range" in result.stderr
    options = SimulationOptions(
        strategy="pass", cell=(1, 1), lateral_m=0.005, approach_rad=math.pi / 2, sensors=sensors
    )
    holds(out, simulate(FloorMap(CODES), options))


def test_unusual_settings_give_warnings(locatk, floor: Path) -> None:
    out, way = floor.with_name("run.mcap"), floor.with_name("way.csv")
    way.write_text("x_mm,y_mm\n0,-500\n400,-500\n")
    result = locatk("simulate", "landmarks", floor, "-o", out, "--strategy", "path", "--path", way)
    assert result.exit_code == 0
    assert "over no landmark" in result.stdout
    assert "passes over no landmark" in result.stderr
    assert "leaves the map" in result.stderr


@pytest.mark.parametrize(
    ("given", "status", "said"),
    [
        (("--cell", "0,0"), 2, "--cell needs --strategy path or pass"),
        (("--strategy", "pass", "--cell", "0,0", "--cell", "0,1"), 2, "one cell"),
        (("--strategy", "path"), 2, "--path or --cell"),
        (("--strategy", "path", "--cell", "0,0"), 1, "two waypoints"),
        (("--strategy", "path", "--cell", "0,0", "--cell", "2,1"), 1, "cell 2,1"),
        (("--strategy", "pass", "--landmarks", 2), 2, "--landmarks needs --strategy paper"),
        (("--flip", "0,1"), 2, "ROW,COLUMN:BAR"),
        (("--flip", "2,1:0"), 1, "no landmark"),
        (("--flip", "0,1:4"), 1, "bar 4"),
        (("--noise", -2), 2, "--noise"),
        (("--rate", 1e6), 1, "samples"),
        (("--dead", "rear"), 2, "dead_sensors in [faults]"),
    ],
)
def test_impossible_settings_give_one_line(
    locatk, floor: Path, given: tuple[object, ...], status: int, said: str
) -> None:
    result = locatk("simulate", "landmarks", floor, "-o", floor.with_name("run.mcap"), *given)
    assert result.exit_code == status, result.stderr
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert [path.name for path in floor.parent.iterdir()] == ["map.toml"]


@pytest.mark.parametrize(
    ("text", "given", "status", "said"),
    [
        ("[robot]\nlateral_mm = 2", (), 2, "lateral_mm of [robot] needs --strategy pass"),
        ("[robot]\nlateral_mm = 200", ("--strategy", "pass"), 1, "lateral_m"),
        ('[robot]\npattern = "NSN"', ("--strategy", "pass"), 1, "NSNS"),
        (
            '[robot]\nstrategy = "pass"\npattern = "SSSS"\ncells = [[0, 0]]',
            (),
            1,
            "no landmark SSSS",
        ),
        ("[robot]\nstart = { x_mm = 5 }", (), 1, "robot.start"),
        (
            "[robot]\nstart = { x_mm = -50, y_mm = -50, heading_deg = 225 }",
            (),
            1,
            "meets no landmark",
        ),
        ("[faults]\ndisplaced_landmarks = [{ cell = [0, 1], x_mm = 4 }]", (), 1, "'y_mm'"),
        ('[faults]\ndead_sensors = ["top"]', (), 1, "front, left, rear, right"),
        ('[faults]\nswapped_sensors = [["front"]]', (), 1, "a list of 2"),
        ("[errors]\nheight_mm = -12", (), 1, "top faces"),
        ("[faults]\nmisread_fraction = 2", (), 1, "a number from 0 to 1"),
        ('[sensors]\nfile = "halls.toml"\nrange_mt = 20', (), 2, "not both"),
        ('[sensors]\nfile = "nowhere.toml"', (), 1, "nowhere.toml"),
    ],
)
def test_a_wrong_setting_is_one_line(
    locatk, floor: Path, text: str, given: tuple[object, ...], status: int, said: str
) -> None:
    config = floor.with_name("sim.toml")
    config.write_text(f'format = "locatk-simulation-landmarks"\nformat_version = 1\n{text}\n')
    out = floor.with_name("run.mcap")
    result = locatk("simulate", "landmarks", floor, "-o", out, "--config", config, *given)
    assert result.exit_code == status, result.stderr
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert not out.exists()


def test_other_files_than_maps_are_refused(locatk, floor: Path) -> None:
    out = floor.with_name("run.mcap")
    result = locatk("simulate", "landmarks", floor.with_name("nowhere.toml"), "-o", out)
    assert result.exit_code == 1
    assert "nowhere.toml" in result.stderr
    floor.write_text(floor.read_text().replace("15", "16").replace("f", "g"))
    result = locatk("simulate", "landmarks", floor, "-o", out)
    assert result.exit_code == 1
    assert not out.exists()


@pytest.mark.slow
def test_a_robot_drives_by_the_published_method(locatk, floor: Path) -> None:
    out = floor.with_name("own.mcap")
    given = ("--strategy", "published", "--landmarks", 1, "--rate", 100, "--seed", 2)
    result = locatk("simulate", "landmarks", floor, "-o", out, *given, "--json")
    assert result.exit_code == 0, result.stderr
    options = SimulationOptions("published", landmarks=1, rate_hz=100.0, seed=2)
    wanted = simulate(FloorMap(CODES), options, published_driver(FloorMap(CODES), options))
    session = holds(out, wanted)
    approaches = json.loads(result.stdout)["approaches"]
    assert [tuple(one["cell"]) for one in approaches] == [one.cell for one in wanted.approaches]
    assert {one["outcome"] for one in approaches} <= {
        "centre", "no_pattern", "wrong_pattern", "lost",
    }  # fmt: skip
    assert json.loads(session.metadata()["facts"]["simulated_approaches"]) == approaches


@pytest.mark.parametrize("flag", ["--noise", "--speed", "--rate", "--stop"])
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_numbers_of_flags_are_finite(locatk, tmp_path: Path, flag: str, value: str) -> None:
    (tmp_path / "map.toml").touch()
    result = locatk(
        *("simulate", "landmarks", tmp_path / "map.toml", "-o", tmp_path / "run.mcap", flag, value)
    )
    assert result.exit_code == 2
    assert "is not a finite number" in result.stderr
