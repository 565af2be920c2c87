"""`locatk calibrate map` as a user runs it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from locatk.cli.app import app
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.simulation import session as simulate
from locatk.core.landmarks.simulation.floor import install_landmarks
from locatk.core.landmarks.simulation.session import Faults, SimulatedSession, SimulationOptions
from locatk.formats.artifacts import maps
from locatk.formats.sessions import field_samples
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_odometry

FLOOR = FloorMap(np.array([[13, 5, 4, 12], [3, 7, 2, 15], [1, 11, 6, 8]]), name="hall")
FAULTS = Faults(flipped=(((1, 1), 2),), displaced=(((0, 2), (0.006, -0.008)),))
LOOPS = (
    ((0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0)),
    ((1, 0), (0, 0), (0, 1), (1, 1), (1, 2), (0, 2)),
)


def drive(
    cells: tuple[tuple[int, int], ...], seed: int, floor: FloorMap = FLOOR
) -> SimulatedSession:
    """A robot of its own, always on the same floor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            simulate, "install_landmarks", lambda f, e, x, _: install_landmarks(f, e, x, 5)
        )
        return simulate.simulate(
            floor, SimulationOptions(strategy="path", cells=cells, seed=seed, faults=FAULTS)
        )


def write(
    path: Path, session: SimulatedSession, floor: FloorMap | None = FLOOR, **more: object
) -> Path:
    given: dict = {"truth": session.truth, "odometry": session.odometry, **more}
    field_samples.write_halls(path, session.samples, floor=floor, **given)
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two recordings over six landmarks of twelve."""
    folder = tmp_path_factory.mktemp("runs")
    return [write(folder / f"run{k}.mcap", drive(cells, k)) for k, cells in enumerate(LOOPS)]


@pytest.fixture(scope="module")
def calibration(runs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    """Result and output of `locatk calibrate map` of these recordings."""
    out = tmp_path_factory.mktemp("calibration") / "built.toml"
    arguments = ["calibrate", "map", *map(str, runs), "-o", str(out)]
    return CliRunner().invoke(app, arguments), out


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSession:
    """A drive over three of them, one with a flipped bar: by the map as designed, nowhere."""
    return drive(((0, 0), (0, 1), (1, 1)), 9)


@pytest.fixture(scope="module")
def sound() -> SimulatedSession:
    """A drive over four landmarks without a fault."""
    return drive(((0, 1), (0, 0), (1, 0), (2, 0)), 10)


@pytest.mark.slow
def test_sessions_in_a_map_as_built_out(calibration: tuple[Result, Path]) -> None:
    result, out = calibration
    assert result.exit_code == 0, result.stderr
    floor = maps.read_map(out)
    assert maps.dumps_map(replace(floor, built={})) == maps.dumps_map(FLOOR)
    assert set(floor.built) == set(LOOPS[0])
    flags = {cell: built.flags for cell, built in floor.built.items() if built.flags}
    assert flags == {(0, 2): ("displaced",), (1, 1): ("flipped:2",)}
    assert all(built.visits == 2 for built in floor.built.values())
    lines = result.stdout.splitlines()
    assert lines[0] == "6 landmarks as built against their design, 2 flagged:"
    table = [line.split() for line in lines[2:9]]  # Two lines of titles.
    assert table[0][0] == "cell"
    assert [row[0] for row in table[1:]] == ["0,0", "0,1", "0,2", "1,0", "1,1", "1,2"]
    built = floor.built[0, 2]
    assert table[3][1:4] == ["2", f"{1e3 * built.x_m:+.2f}", f"{1e3 * built.y_m:+.2f}"]
    assert table[3][-1] == "displaced"
    assert (table[5][6], table[5][-1]) == ("NNSS", "flipped:2")  # designed NNNS
    assert lines[9] == "never visited: 0,3 1,3 2,0 2,1 2,2 2,3"
    assert lines[10] == f"Wrote {out}"
    assert "1 landmark differs from the design; the map is still unique" in result.stderr
    assert all(len(line) <= 80 for line in lines[:10])


@pytest.mark.slow
def test_a_drive_counts_once(
    locatk, runs: list[Path], calibration: tuple[Result, Path], tmp_path: Path
) -> None:
    copy, out = tmp_path / "copy.mcap", tmp_path / "built.toml"
    copy.write_bytes(runs[0].read_bytes())
    result = locatk("calibrate", "map", *runs, copy, "-o", out)
    assert result.exit_code == 3
    assert f"{copy}: the same measurements as in {runs[0]}" in result.stderr
    assert out.read_text() == calibration[1].read_text()


@pytest.mark.slow
def test_json_is_all_that_is_on_stdout(locatk, runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "map", *runs, "-o", out, "--json")
    assert result.exit_code == 0
    answer = json.loads(result.stdout)
    floor = maps.read_map(out)
    assert answer["version"] == 1
    assert answer["sessions"] == [str(path) for path in runs]
    assert answer["output"] == str(out)
    assert answer["left_out"] == {}
    assert answer["unvisited"] == [[0, 3], [1, 3], [2, 0], [2, 1], [2, 2], [2, 3]]
    assert 0.9 < answer["typical_strength"] < 1.1
    assert 0.5 < answer["misfit_sigma"] < 1.2
    assert [tuple(one["cell"]) for one in answer["landmarks"]] == sorted(floor.built)
    for one in answer["landmarks"]:
        built = floor.built[tuple(one["cell"])]
        assert [one["x_m"], one["y_m"], one["heading_rad"]] == pytest.approx(
            [built.x_m, built.y_m, built.heading_rad], rel=1e-9
        )
        assert one["strength"] == pytest.approx(built.strength.tolist())
        sigma = [one[f"sigma_{key}"] for key in ("x_m", "y_m", "heading_rad")]
        assert [*sigma, *one["sigma_strength"]] == pytest.approx(built.sigma.tolist())
        assert (one["visits"], one["flags"]) == (built.visits, list(built.flags))
        assert one["refused"] == ""
    laid = {tuple(one["cell"]): one["laid"] for one in answer["landmarks"]}
    assert laid[1, 1] == "NNSS"
    assert laid[0, 0] == "NSNN"


@pytest.mark.slow
def test_later_sessions_are_solved_with_it(
    locatk, calibration: tuple[Result, Path], other: SimulatedSession, tmp_path: Path
) -> None:
    (_, out), later = calibration, write(tmp_path / "later.mcap", other)
    assert locatk("solve", later, "-o", tmp_path / "a.mcap").exit_code == 3
    result = locatk("solve", later, "-o", tmp_path / "b.mcap", "--artifact", out, "--json")
    cells = [seen["cell"] for seen in json.loads(result.stdout)["sessions"][0]["detections"]]
    assert cells == [[0, 0], [0, 1], [1, 1]]


@pytest.mark.slow
def test_recordings_that_cannot_be_used_are_named(
    locatk, runs: list[Path], other: SimulatedSession, tmp_path: Path
) -> None:
    out = tmp_path / "built.toml"
    blind = replace(other.samples[0], field_t=1e-5 * np.sign(other.samples[0].field_t))
    quiet = write(tmp_path / "quiet.mcap", replace(other, samples=(blind,)))
    lost = write(tmp_path / "lost.mcap", other, odometry=())
    strange = write(tmp_path / "strange.mcap", other, floor=replace(FLOOR, pitch_m=0.25))
    result = locatk("calibrate", "map", runs[0], quiet, lost, strange, "-o", out, "--json")
    assert result.exit_code == 3
    left_out = json.loads(result.stdout)["left_out"]
    problems = {path: reason.partition(" Hint: ")[0] for path, reason in left_out.items()}
    assert problems == {
        str(quiet): "no landmark was detected",
        str(lost): "no odometry of robot.",
        str(strange): "the map differs from that of the first session.",
    }
    for path in left_out:
        assert path in result.stderr
    assert "Incomplete: 3 recordings or visits were not used." in result.stderr
    assert len(maps.read_map(out).built) == 6


@pytest.mark.slow
def test_the_map_may_be_given_and_must_be_there(
    locatk, sound: SimulatedSession, tmp_path: Path
) -> None:
    bare, out = write(tmp_path / "bare.mcap", sound, floor=None), tmp_path / "built.toml"
    result = locatk("calibrate", "map", bare, "-o", out)
    assert result.exit_code == 1
    assert f"Error: {bare}: the session has no map" in result.stderr
    assert "--artifact" in result.stderr
    assert not out.exists()
    given = tmp_path / "map.toml"
    maps.write_map(given, FLOOR)
    result = locatk("calibrate", "map", bare, "-o", out, "--artifact", given)
    assert result.exit_code == 0, result.stderr
    assert set(maps.read_map(out).built) == {(0, 1), (0, 0), (1, 0), (2, 0)}
    again = locatk("calibrate", "map", bare, "-o", given, "--artifact", given, "--overwrite")
    assert again.exit_code == 1
    assert "one of the inputs" in again.stderr


def test_one_session_that_cannot_be_used_is_an_error(
    locatk, other: SimulatedSession, tmp_path: Path
) -> None:
    run, out = write(tmp_path / "run.mcap", other, odometry=()), tmp_path / "built.toml"
    assert read_odometry(Session.open(run)) == []
    result = locatk("calibrate", "map", run, "-o", out)
    assert result.exit_code == 1
    assert "no odometry of robot" in result.stderr
    assert str(run) in result.stderr
    assert not out.exists()


@pytest.mark.slow
def test_several_robots_of_one_session(locatk, sound: SimulatedSession, tmp_path: Path) -> None:
    second = drive(((1, 0), (0, 0), (0, 1)), 11)
    both = replace(
        sound,
        **{
            key: (
                replace(getattr(sound, key)[0], device="red"),
                replace(getattr(second, key)[0], device="green"),
            )
            for key in ("samples", "truth", "odometry")
        },
    )
    run, out = write(tmp_path / "run.mcap", both), tmp_path / "built.toml"
    result = locatk("calibrate", "map", run, "-o", out)
    assert result.exit_code == 0, result.stderr
    visits = {cell: built.visits for cell, built in maps.read_map(out).built.items()}
    assert visits == {(0, 0): 2, (0, 1): 2, (1, 0): 2, (2, 0): 1}
