"""`locatk map design` and `locatk map check` as a user runs them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.cli import console
from locatk.core.landmarks.landmark import PATTERN_OF, Geometry, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, AsBuiltLandmark, FloorMap
from locatk.formats.artifacts.maps import read_map, write_map


def readings_by_hand(floor: FloorMap) -> list[tuple[int, ...]]:
    """Readings of window L, by walking: nothing of locatk but cells, walls and codes."""
    found = []
    for cell in floor.cells():
        for heading in range(4):
            one = (cell, heading)
            if not floor.is_passable(cell, heading):
                continue
            step = {0: (0, 1), 1: (1, 0), 2: (0, -1), 3: (-1, 0)}
            ahead = (cell[0] + step[heading][0], cell[1] + step[heading][1])
            left = (heading + 1) % 4
            if not floor.is_passable(ahead, left):
                continue
            last = (ahead[0] + step[left][0], ahead[1] + step[left][1])
            codes = [int(floor.codes[at]) for at in (one[0], ahead, last)]
            if floor.alphabet == "6":
                found.append(tuple(int(PATTERN_OF[code]) for code in codes))
            else:
                found.append(tuple(int(rotated(code, -heading)) for code in codes))
    return found


@pytest.fixture
def made(locatk, tmp_path: Path) -> Path:
    path = tmp_path / "map.toml"
    result = locatk("map", "design", "6x7", "-o", path)
    assert result.exit_code == 0, result.stderr
    return path


def bad(made: Path, path: Path) -> Path:
    """The map with its first column laid as the second."""
    floor = read_map(made)
    codes = floor.codes.copy()
    codes[:, 0] = codes[:, 1]
    codes[:, 2] = codes[:, 1]
    write_map(path, replace(floor, codes=codes))
    return path


# ---- design


def test_a_map_on_which_poses_stay_provisional_says_so(locatk, tmp_path: Path) -> None:
    path = tmp_path / "row.toml"
    assert locatk("map", "design", "1x3", "--window", "I2", "-o", path).exit_code in (0, 3)
    assert "Final      never: poses remain provisional" in locatk("map", "check", path).stdout
    (told,) = json.loads(locatk("map", "check", path, "--json").stdout)["maps"]
    final = told["landmarks_until_final"]
    assert (final["mean"], final["worst_start"]) == (None, None)
    assert final["never"] == final["starts"] == 12


@pytest.mark.slow
def test_design_writes_and_prints_a_map(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    result = locatk("map", "design", "6x7", "-o", path, "--name", "hall", "--seed", 5)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    floor = read_map(path)
    assert floor.shape == (6, 7)
    assert (floor.name, floor.seed, floor.pitch_m) == ("hall", 5, 0.2)
    assert (floor.alphabet, floor.window, floor.detect) == ("16", "L", 0)
    assert floor.geometry == Geometry()
    words = readings_by_hand(floor)
    assert len(words) == len(set(words)) == 4 * 5 * 6
    assert "6 x 7 at 200 mm" in result.stdout
    assert f"Readings   {len(words)} under all headings" in result.stdout
    assert "Bars       168 of 30 x 10 x 5 mm, 1.2 T" in result.stdout
    assert all(len(line) <= 80 for line in result.stdout.splitlines()[2:])
    # The same seed gives the same file, another one another map.
    again, other = tmp_path / "again.toml", tmp_path / "other.toml"
    locatk("map", "design", "6x7", "-o", again, "--name", "hall", "--seed", 5)
    locatk("map", "design", "6x7", "-o", other, "--name", "hall", "--seed", 6)
    assert again.read_bytes() == path.read_bytes()
    assert (read_map(other).codes != floor.codes).any()


def test_patterns_alone(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    assert locatk("map", "design", "5x5", "--alphabet", 6, "-o", path).exit_code == 0
    words = readings_by_hand(read_map(path))
    assert len(words) == len(set(words)) == 64


def test_holes_and_walls_are_at_the_requested_cells(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    result = locatk(
        "map", "design", "6x7", "--forbid", "2,3;4,0-2", "--forbid", "0-1,6",
        "--wall", "0-5,3:0-5,4", "--wall", "1,1:2,1", "-o", path,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    floor = read_map(path)
    holes = {(int(r), int(c)) for r, c in np.argwhere(floor.codes == HOLE_CODE)}
    assert holes == {(2, 3), (4, 0), (4, 1), (4, 2), (0, 6), (1, 6)}
    assert floor.walls == {((r, 3), (r, 4)) for r in range(6)} | {((1, 1), (2, 1))}
    words = readings_by_hand(floor)
    assert len(words) == len(set(words)) < 4 * 5 * 6
    assert "6 holes, 7 walls" in result.stdout


def test_one_misread_landmark_is_detected(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    result = locatk("map", "design", "5x5", "--detect", 1, "-o", path)
    assert result.exit_code == 0, result.stderr
    assert "1 misread landmark always detected" in result.stdout
    words = np.array(readings_by_hand(read_map(path)))
    differ = (words[:, None] != words[None]).sum(axis=-1)
    assert differ[~np.eye(len(words), dtype=bool)].min() >= 2
    assert read_map(path).detect == 1


def test_the_geometry_is_kept(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    result = locatk(
        "map", "design", "3x3", "--bar", "25x5x4.7", "--remanence", 0.4, "--radius", 24.3,
        "--sensor-height", 9.1, "--circle", 24, "--pitch", 233.3, "-o", path,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    floor = read_map(path)
    assert floor.geometry == Geometry(
        bar_length_m=0.025,
        bar_width_m=0.005,
        bar_height_m=0.0047,
        remanence_t=0.4,
        radius_m=0.0243,
        sensor_height_m=0.0091,
        circle_m=0.024,
        threshold_t=0.0011,  # of the remanence, where it is not given
    )
    assert floor.pitch_m == 0.2333


def test_stdout_is_one_json_object(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    result = locatk("map", "design", "5x6", "--pitch", 150, "-o", path, "--json")
    assert result.exit_code == 3, result.stderr
    told = json.loads(result.stdout)
    assert told["version"] == 1
    assert told["map"]["bars"] == 120
    assert sum(told["patterns"].values()) == 30
    proof = told["proof"]
    assert proof["holds"]
    assert proof["unique"]
    assert proof["readings"] == 80
    assert proof["landmarks_to_localise"]["worst"] >= 2
    assert np.shape(proof["flipped_bar"]["by_cell"]) == (5, 6)
    assert told["landmark"]["contour_pitch_m"] == pytest.approx(0.16, abs=0.002)
    assert len(told["warnings"]) == 2  # the pitch is too small for territories and fields
    checked = json.loads(locatk("map", "check", path, "--json").stdout)["maps"][0]
    assert checked["proof"] == proof
    final = told["landmarks_until_final"]
    assert checked["landmarks_until_final"] == final
    assert set(final) == {"starts", "mean", "p99", "worst", "worst_start", "never"}
    assert final["starts"] == 4 * told["map"]["landmarks"]
    assert proof["landmarks_to_localise"]["mean"] < final["mean"] <= final["worst"]
    lines = locatk("map", "check", path).stdout
    assert f"Final      after {final['mean']:.2g} landmarks on average, " in lines
    assert checked["map"] == told["map"]


def test_outputs_are_not_overwritten_without_the_option(locatk, made: Path) -> None:
    before = made.read_bytes()
    result = locatk("map", "design", "5x5", "-o", made)
    assert result.exit_code == 1
    assert "exists" in result.stderr
    assert made.read_bytes() == before
    assert locatk("map", "design", "5x5", "-o", made, "--overwrite").exit_code == 0
    assert read_map(made).shape == (5, 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        (["34x34"], 1, "4096"),  # 4 x 33 x 33 readings
        (["10x10", "--detect", 1], 1, "256"),
        (["9x9", "--alphabet", 6], 1, "216"),
        (["5x5", "--detect", 3], 1, "detect"),
        (["5"], 2, "24x24"),
        (["0x5"], 2, "1 to 2000 rows"),
        (["5x99999"], 2, "1 to 2000 rows"),
        (["5x5", "--forbid", "5,0"], 2, "4,4"),
        (["5x5", "--forbid", "1"], 2, "row,column"),
        (["5x5", "--forbid", "3-1,0"], 2, "row,column"),
        (["5x5", "--forbid", "1,0,2"], 2, "row,column"),
        (["5x5", "--forbid", ""], 2, "row,column"),
        (["5x5", "--wall", "1,1:2,2"], 2, "are not neighbours"),
        (["5x5", "--wall", "1,1"], 2, "cell:cell"),
        (["5x5", "--wall", "0-3,1:0-2,2"], 2, "4 and 3 cells"),
        (["5x5", "--wall", "4,4:4,5"], 2, "4,4"),
        (["5x5", "--window", "4x4"], 2, "--window"),
        (["5x5", "--alphabet", "7"], 2, "--alphabet"),
        (["5x5", "--pitch", 50], 1, "60 mm"),
        (["5x5", "--pitch", "nan"], 2, "--pitch"),
        (["5x5", "--bar", "30x10"], 2, "30x10x5"),
        (["5x5", "--bar", "60x10x5"], 1, "overlap"),
        (["5x5", "--remanence", 12000], 1, "tesla"),
        (["5x5", "--threshold", 0], 1, "threshold"),
        ([], 2, "ROWSxCOLS"),
    ],
    ids=str,
)
def test_impossible_designs_are_refused(
    locatk, tmp_path: Path, options: list[object], status: int, said: str
) -> None:
    result = locatk("map", "design", *options, "-o", tmp_path / "map.toml")
    assert result.exit_code == status, result.stderr
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_hint_names_changes_and_not_what_is_set(locatk, tmp_path: Path) -> None:
    result = locatk("map", "design", "34x34", "--window", "L", "-o", tmp_path / "map.toml")
    assert result.exit_code == 1
    assert result.stderr.endswith("Hint: Use --window 2x2, or a floor of 25x25.\n")


# ---- design --landmark


def test_landmark_prints_the_tables(locatk) -> None:
    result = locatk("map", "design", "--landmark")
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    assert all(len(line) <= 80 for line in result.stdout.splitlines())
    rows = [line.split() for line in result.stdout.splitlines()]
    (nnns,) = [row for row in rows if row[:3] == ["3", "NNNS", "6"]]
    assert nnns[3:] == ["6.02+", "44.23-", "90.00+", "135.77-", "173.98+", "270.00-"]
    assert [row[2] for row in rows if row[:1] and row[0] in "123456"] == list("466688")
    for text in ("194 mm", "50 mV/mT", "+-38.4 mT", "0.0 to 23.6 mm"):
        assert text in result.stdout


def test_landmark_warns_of_a_collapse(locatk) -> None:
    result = locatk("map", "design", "--landmark", "--bar", "40x10x5", "--sensor-height", 20)
    assert result.exit_code == 3
    assert "he valleys of SSSN and NNNS collapse to 2 instead of 6" in result.stderr
    assert "at most 17.8 mm" in result.stderr
    assert "2, not 6" in result.stdout
    quiet = locatk("map", "design", "--landmark", "--sensor-height", 24, "-q")
    assert quiet.exit_code == 3
    assert quiet.stderr.count("\n") == 1


def test_landmark_as_json(locatk) -> None:
    result = locatk("map", "design", "--landmark", "--remanence", 1, "--json", "--threshold", 2.73)
    told = json.loads(result.stdout)
    assert told["version"] == 1
    assert told["geometry"]["remanence_t"] == 1
    assert [pattern["valleys"] for pattern in told["patterns"]] == [4, 6, 6, 6, 8, 8]
    assert not any(pattern["collapsed"] for pattern in told["patterns"])
    assert told["patterns"][0]["r1_m"] is None
    assert told["patterns"][2]["r2_m"] == pytest.approx(0.0547, abs=1e-4)
    assert told["hall_class"] == {"mv_per_mt": 50, "range_t": 0.042}
    assert told["sensor_heights_m"][1] == pytest.approx(0.0236, abs=1e-4)
    assert told["warnings"] == []
    far = json.loads(locatk("map", "design", "--landmark", "--bar", "2x2x2", "--json").stdout)
    assert far["patterns"][2]["r1_m"] is None
    assert far["warnings"]


def test_landmark_makes_no_map(locatk, tmp_path: Path) -> None:
    for more in (["5x5"], ["-o", tmp_path / "map.toml"]):
        result = locatk("map", "design", "--landmark", *more)
        assert result.exit_code == 2
        assert "--landmark" in result.stderr
    assert locatk("map", "design", "--landmark", "--sensor-height", 0).exit_code == 1
    assert locatk("map", "design", "5x5").exit_code == 2
    assert list(tmp_path.iterdir()) == []


# ---- check


def test_check_proves_a_map(locatk, made: Path) -> None:
    result = locatk("map", "check", made)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    assert result.stdout.startswith(f"{made}: unique")
    assert "each is unique" in result.stdout
    for fault in ("flipped bar", "missing bar", "missing landmark"):
        assert fault in result.stdout
    assert all(len(line) <= 80 for line in result.stdout.splitlines()[1:])


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_a_terminal_shows_that_maps_are_checked(
    locatk, made: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """One map has a label, which is erased, and several have a bar."""
    monkeypatch.setattr(console, "_shows_progress", lambda: True)
    result = locatk("map", "check", *[made] * count)
    assert result.exit_code == 0
    assert "Proving" in result.stderr
    assert ("Proving ..." in result.stderr) == (count == 1)


def test_check_shows_duplicates_with_both_positions(locatk, made: Path, tmp_path: Path) -> None:
    path = bad(made, tmp_path / "bad.toml")
    result = locatk("map", "check", path)
    assert result.exit_code == 1
    words = readings_by_hand(read_map(path))
    repeats = len(words) - len(set(words))
    assert repeats > 0
    assert f"{repeats} of {len(words)} readings" in result.stdout
    assert result.stderr.startswith("Error:")
    assert len(result.stderr.splitlines()) == 1
    assert "and at" in result.stdout
    told = json.loads(locatk("map", "check", path, "--json").stdout)["maps"][0]
    assert told["proof"]["unique"] is False
    assert len(told["proof"]["duplicates"]) == repeats
    first = told["proof"]["duplicates"][0]
    floor = read_map(path)

    def word(place: dict[str, int]) -> int:
        return int(rotated(floor.codes[place["row"], place["column"]], -place["heading_deg"] // 90))

    assert first["one"] != first["other"]
    assert word(first["one"]) == word(first["other"])


def test_check_compares_with_the_stated_detection(locatk, made: Path, tmp_path: Path) -> None:
    path = tmp_path / "promise.toml"
    write_map(path, replace(read_map(made), detect=2))
    result = locatk("map", "check", path)
    assert result.exit_code == 1
    assert "2 misread landmarks should be detected" in result.stderr
    both = locatk("map", "check", path, made, bad(made, tmp_path / "bad.toml"), "-q")
    assert both.exit_code == 1
    assert "2 of 3 maps do not hold" in both.stderr
    assert locatk("map", "check", made, made).exit_code == 0


def test_check_warns_of_landmarks_that_differ_from_the_design(
    locatk, made: Path, tmp_path: Path
) -> None:
    path = tmp_path / "built.toml"
    built = AsBuiltLandmark(
        0, 0, 0, np.array([1.0, -1, 1, 0]), np.full(7, np.nan), 1, ("missing:3",)
    )
    write_map(path, replace(read_map(made), built={(1, 2): built}))
    result = locatk("map", "check", path)
    assert result.exit_code == 0
    assert "1 landmark of" in result.stderr
    assert "at 1,2" in result.stderr


def test_check_refuses_other_files(locatk, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text("format = 'locatk-tag'\nformat_version = 1\n")
    assert locatk("map", "check", path).exit_code == 1
    assert locatk("map", "check", tmp_path / "none.toml").exit_code == 1
    assert locatk("map", "check").exit_code == 2


def test_a_floor_without_a_window(locatk, tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    result = locatk("map", "design", "1x1", "-o", path)
    assert result.exit_code == 0, result.stderr
    assert "no window fits" in result.stdout
    assert locatk("map", "check", path).exit_code == 0


@pytest.mark.slow
def test_the_published_maps_hold(locatk, data: Path, tmp_path: Path) -> None:
    """Hexadecimal codes, the first line the row at y = 0; id6 holds pattern indices."""
    from locatk.core.landmarks.landmark import PATTERNS, code_of

    for file, alphabet, window in (
        ("or16_L_24x24", "16", "L"),
        ("or16_I2_8x8", "16", "I2"),
        ("or16_I3_28x28", "16", "I3"),
        ("id6_L_7x7", "6", "L"),
        ("id6_S_17x17", "6", "2x2"),
    ):
        source = data / "landmarks" / f"{file}.txt"
        if not source.is_file():
            pytest.skip(f"{source} is not there")
        lines = source.read_text().splitlines()
        rows = [line for line in lines if line and " " not in line]  # one line says how found
        digits = [[int(digit, 16) for digit in line] for line in rows]
        codes = np.array(digits)
        if alphabet == "6":
            codes = np.array([code_of(letters) for letters in PATTERNS])[codes]
        path = tmp_path / f"{file}.toml"
        write_map(path, FloorMap(codes, alphabet=alphabet, window=window))
        result = locatk("map", "check", path)
        assert result.exit_code == 0, result.stderr
