"""`locatk simulate polaris` as a user runs it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.simulation.session import CARS, SimulationOptions, simulate, usual_bar
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.artifacts import tags as artifacts
from locatk.formats.sessions.field_samples import read_magnetometers
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_odometry, read_truth

SITE = Tags(ids=(3, 7), site={3: PlanarPose(0.0, 0.0, 0.0), 7: PlanarPose(0.4, 0.0, 1.0)})


SETTINGS = """
format = "locatk-simulation-polaris"
format_version = 1

[robot]
tag_ids = [3]
rest_s = 0.3
acceleration_mps2 = 0.5
crab_deg = 3
yaw_wobble_deg = 1
clearance_mm = 11
height_wobble_mm = 0.5

[sensors]
count = 7
spacing_mm = 18
gain = 6
resolution = 1

[errors]
measured_noise = true
offset_ut = 12
drift_ut = 0.2

[faults]
clipped = true
dead_sensors = [2]
stuck_sensors = [5]
lost_fraction = 0.03

[environment]
earth_ut = 45
dip_deg = 60
north_deg = 20
debris_count = 12
debris_size_mm = 1.5
debris_magnetised_fraction = 0.6
motor_ut = 8
motor_gradient_per_m = 2

[build]
angle_deg = 5
position_mm = 0.4
strength_fraction = 0.05
seed = 9

[odometry]
recorded = false
scale_fraction = 0.02
heading_deg = 2
"""
"""Settings that have no option of their own, and three that options override."""


@pytest.mark.slow
def test_a_session_holds_samples_bar_tag_and_truth(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    result = locatk("simulate", "polaris", "-o", out, "--id", 262143, "--seed", 3, "--json")
    assert result.exit_code == 0, result.stderr
    wanted = simulate(None, SimulationOptions(route=(262143,), seed=3))
    told = json.loads(result.stdout)
    (crossing,) = told.pop("crossings")
    assert told == {
        "version": 1,
        "output": str(out),
        "samples": 313,
        "device": "bar",
        "frame": "tag-262143",
        "lost": 0,
        "saturated": 0,
        "debris": 0,
        "truth_poses": 313,
    }
    assert crossing["tag_id"] == 262143
    assert crossing["time_s"] == pytest.approx(wanted.crossings[0].time_ns * 1e-9, abs=1e-6)
    session = Session.open(out)
    assert session.facts["system"] == "polaris"
    (samples,) = read_magnetometers(session)
    assert samples.field_t == pytest.approx(wanted.samples.field_t, rel=1e-6)
    assert np.array_equal(samples.time_ns, wanted.samples.time_ns)
    assert samples.array.position_m == pytest.approx(wanted.samples.array.position_m)
    assert samples.array.delay_s == pytest.approx(wanted.samples.array.delay_s)
    assert samples.array.noise_t == pytest.approx([5e-7] * 3)
    assert artifacts.attached_tags(session) == Tags()
    (truth,) = read_truth(session)
    assert (truth.device, truth.frame) == ("bar", "tag-262143")
    assert truth.position == pytest.approx(wanted.truth.position)
    assert heading_from_quaternion(truth.quaternion) == pytest.approx(
        heading_from_quaternion(wanted.truth.quaternion)
    )
    facts = session.metadata()["facts"]
    assert json.loads(facts["simulated_crossings"]) == [crossing]
    magnets = json.loads(facts["simulated_magnets"])
    assert [[magnet["x_m"], magnet["y_m"]] for magnet in magnets] == pytest.approx(
        wanted.magnets.position_m
    )


def test_each_option_reaches_the_samples(locatk, tmp_path: Path) -> None:
    tag, out, config = (tmp_path / name for name in ("site.toml", "run.mcap", "sim.toml"))
    artifacts.write_tags(tag, SITE)
    config.write_text(SETTINGS)
    given = (
        *("--id", 7, "--id", 3, "--heading", 200, "--lateral", 5, "--run-up", 80),
        *("--speed", 0.12, "--speed-wobble", 0.2, "--rate", 60, "--noise", 0.7),
        *("--odometry", "--seed", 8),
    )
    result = locatk("simulate", "polaris", tag, "-o", out, "--config", config, *given)
    assert result.exit_code == 0, result.stderr
    options = SimulationOptions(
        array=usual_bar(7, 0.018, 60.0, 0.7e-6, 6, 1),
        rate_hz=60.0,
        route=(7, 3),
        heading_rad=math.radians(200),
        lateral_m=0.005,
        run_up_m=0.08,
        speed_mps=0.12,
        rest_s=0.3,
        acceleration_mps2=0.5,
        speed_wobble=0.2,
        crab_rad=math.radians(3),
        yaw_wobble_rad=math.radians(1),
        clearance_m=0.011,
        height_wobble_m=0.5e-3,
        build_angle_rad=math.radians(5),
        build_place_m=0.4e-3,
        build_strength=0.05,
        build_seed=9,
        earth_t=45e-6,
        dip_rad=math.radians(60),
        north_rad=math.radians(20),
        offset_t=12e-6,
        drift_t=0.2e-6,
        dead=(2,),
        stuck=(5,),
        clipped=True,
        lost=0.03,
        debris=12,
        debris_size_m=1.5e-3,
        debris_magnetised=0.6,
        motor_t=8e-6,
        motor_gradient=2.0,
        odometry=True,
        odometry_scale=0.02,
        odometry_turn_rad=math.radians(2),
        seed=8,
    )
    wanted = simulate(SITE, options)
    assert "in site, over tag 7, 3" in result.stdout
    session = Session.open(out)
    (samples,) = read_magnetometers(session)
    assert np.array_equal(samples.time_ns, wanted.samples.time_ns)
    read, exact = samples.field_t, wanted.samples.field_t
    assert np.array_equal(np.isnan(read), np.isnan(exact))
    # To a count at most, where a rounding error of the units tipped the scale.
    assert np.nanmax(np.abs(read - exact)) < 1.1 * samples.array.quantum_t.max()
    assert np.nanmean(np.abs(read - exact)) < 1e-9
    (odometry,) = read_odometry(session)
    assert wanted.odometry is not None
    assert odometry.position == pytest.approx(wanted.odometry.position)
    assert artifacts.attached_tags(session) == SITE


def test_the_miniature_car_has_its_own_tag_and_bar(locatk, tmp_path: Path) -> None:
    out = tmp_path / "mini.mcap"
    result = locatk("simulate", "polaris", "-o", out, "--car", "mini", "--id", 77)
    assert result.exit_code == 0, result.stderr
    session = Session.open(out)
    (samples,) = read_magnetometers(session)
    assert len(samples.array) == 3
    assert np.diff(samples.time_ns) == pytest.approx(1e9 / 17, abs=1)
    assert artifacts.attached_tags(session) == CARS["mini"].tags
    (truth,) = read_truth(session)
    assert np.diff(truth.position[:, 0]) == pytest.approx(5e-3 / 17, rel=1e-4)


def test_another_bar_and_the_measured_noise(locatk, tmp_path: Path) -> None:
    file, out = tmp_path / "array.toml", tmp_path / "run.mcap"
    own = SensorArray(bar(5, 0.03), noise_t=np.full(3, 2e-6), sensor="mine")
    artifacts.write_array(file, own)
    result = locatk("simulate", "polaris", "-o", out, "--array", file, "--rate", 40)
    assert result.exit_code == 0, result.stderr
    (samples,) = read_magnetometers(Session.open(out))
    assert samples.array.position_m == pytest.approx(own.position_m)
    assert samples.array.noise_t == pytest.approx(own.noise_t)
    result = locatk(
        "simulate", "polaris", "-o", out, "--rate", 60, "--measured-noise", "--overwrite"
    )
    assert result.exit_code == 0, result.stderr
    (samples,) = read_magnetometers(Session.open(out))
    assert samples.array.noise_t == pytest.approx([0.89e-6, 0.86e-6, 1.24e-6])


def test_unusual_settings_give_warnings(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    result = locatk("simulate", "polaris", "-o", out, "--lateral", 500)
    assert result.exit_code == 0
    assert "no tag" in result.stdout
    assert "over no tag" in result.stderr
    config = tmp_path / "sim.toml"
    config.write_text(
        'format = "locatk-simulation-polaris"\nformat_version = 1\n[robot]\nclearance_mm = 1\n'
    )
    result = locatk("simulate", "polaris", "-o", out, "--config", config, "--overwrite")
    assert result.exit_code == 0
    assert "beyond the sensors' range" in result.stderr


@pytest.mark.parametrize(
    ("given", "status", "said"),
    [
        (("--id", 327_680), 1, "327680"),
        (("--id", 1, "--id", 2), 1, "no site"),
        (("--noise", 1, "--measured-noise"), 2, "not both"),
        (("--speed-wobble", 1.5), 2, "--speed-wobble"),
        (("--rate", 5000), 1, "5000 Hz"),
        (("--dead", 9), 2, "dead_sensors in [faults]"),
        (("--array", "nowhere.toml"), 1, "nowhere.toml"),
        (("nowhere.toml",), 1, "nowhere.toml"),
        (("--car", "truck"), 2, "mini"),
    ],
)
def test_impossible_settings_give_one_line(
    locatk, tmp_path: Path, given: tuple[object, ...], status: int, said: str
) -> None:
    result = locatk("simulate", "polaris", "-o", tmp_path / "run.mcap", *given)
    assert result.exit_code == status
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "status", "said"),
    [
        ("[faults]\ndead_sensors = [9]", 1, "dead (9,)"),
        ("[robot]\nclearance_mm = 0.1", 1, "magnet"),
        ('[sensors]\narray_file = "array.toml"\ncount = 3', 2, "--array or count of [sensors]"),
        ('[sensors]\narray_file = "array.toml"\n[errors]\nmeasured_noise = true', 2, "--array"),
    ],
)
def test_a_wrong_setting_is_one_line(
    locatk, tmp_path: Path, text: str, status: int, said: str
) -> None:
    artifacts.write_array(tmp_path / "array.toml", replace(usual_bar(), sensor="mine"))
    config, out = tmp_path / "sim.toml", tmp_path / "run.mcap"
    config.write_text(f'format = "locatk-simulation-polaris"\nformat_version = 1\n{text}\n')
    result = locatk("simulate", "polaris", "-o", out, "--config", config)
    assert result.exit_code == status, result.stderr
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert not out.exists()


def test_an_array_of_the_command_line_replaces_the_sensors_of_the_file(
    locatk, tmp_path: Path
) -> None:
    file, config, out = (tmp_path / name for name in ("array.toml", "sim.toml", "run.mcap"))
    own = replace(usual_bar(5), sensor="mine")
    artifacts.write_array(file, own)
    config.write_text(
        'format = "locatk-simulation-polaris"\nformat_version = 1\n[sensors]\ncount = 3\n'
    )
    result = locatk("simulate", "polaris", "-o", out, "--config", config, "--array", file)
    assert result.exit_code == 0, result.stderr
    (samples,) = read_magnetometers(Session.open(out))
    assert len(samples.array) == 5


def test_outputs_are_not_overwritten_without_the_option(locatk, tmp_path: Path) -> None:
    out, tag = tmp_path / "run.mcap", tmp_path / "tag.toml"
    out.write_text("mine")
    assert locatk("simulate", "polaris", "-o", out).exit_code == 1
    assert out.read_text() == "mine"
    assert locatk("simulate", "polaris", "-o", out, "--overwrite").exit_code == 0
    artifacts.write_tags(tag, SITE)
    assert locatk("simulate", "polaris", tag, "-o", tag, "--overwrite").exit_code == 2
    assert artifacts.read_tags(tag) == SITE


def test_options_of_a_simulation_are_shown_with_verbose(locatk, tmp_path: Path) -> None:
    path = tmp_path / "sim.mcap"
    assert locatk("simulate", "polaris", "-o", path).exit_code == 0
    told = locatk("info", path).stdout
    assert "simulated_" not in told
    assert "options of the simulation: see -v" in told
    assert "simulated_crossings" in locatk("info", path, "-v").stdout
    assert "simulated_crossings" in locatk("info", path, "--json").stdout
