"""The DotBot importer: the published files, layouts made here, and bad input."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError, MissingDataError
from locatk.core.evaluation import EvaluationOptions, evaluate
from locatk.core.geometry import apply_homography, fit_homography
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION, predict_angles
from locatk.core.lighthouse.light_planes import angles_to_counts
from locatk.core.lighthouse.published.scene import paper_image_points
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.dotbot.recording import read_dotbot
from locatk.formats.importers.imported_session import ImportedSession

CORNERS = ("tl", "tr", "br", "bl")


# ---- published files


@pytest.fixture(scope="module")
def one(data: Path) -> Path:
    return data / "lighthouse" / "oneLH-2D_scene" / "dataset"


@pytest.fixture(scope="module")
def two(data: Path) -> Path:
    return data / "lighthouse" / "twoLH-2D_scene" / "dataset"


@pytest.fixture(scope="module")
def two_session(two: Path) -> ImportedSession:
    tracks = [two / "ground_truth" / f"{i}_blender.csv" for i in range(1, 6)]
    return read_dotbot([two / "lighthouse" / "data.csv"], tracks)


def plane_and_counts(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Columns x, y and c0, c1, read without the importer."""
    columns = np.loadtxt(file, delimiter=",", skiprows=1, usecols=(2, 3, 4, 5))
    return columns[:, :2], columns[:, 2:]


def test_published_one_station(one: Path) -> None:
    rows = [68, 183, 123, 191, 139, 188, 1886]
    for i, n in enumerate(rows):
        session = read_dotbot([one / "lighthouse" / f"{i}_lh2.csv"])
        sweeps = session.sweeps
        assert len(sweeps) == 2 * n
        assert sweeps.devices == ("robot",)
        assert set(sweeps.channel) == {1}
        assert set(sweeps.polynomial) == set(sweeps.sweep) == {-1}
        assert session.warnings == []
        assert session.truth == []
    together = read_dotbot([one / "lighthouse" / f"{i}_lh2.csv" for i in range(7)])
    assert len(together.sweeps) == 2 * sum(rows)
    assert np.all(np.diff(together.sweeps.time_ns) >= 0)
    # 2023-07-24 17:11:36.074800 UTC, to the nanosecond; the counts as they stand in the file.
    assert together.sweeps.time_ns[:2].tolist() == [1690218696074800000] * 2
    assert together.sweeps.count[:2].tolist() == [82189, 39797]


def test_published_plane_is_a_homography_of_the_counts(one: Path) -> None:
    for i in range(7):
        plane, counts = plane_and_counts(one / "lighthouse" / f"{i}_lh2.csv")
        image = paper_image_points(np.sort(counts, axis=1), 1)
        homography = fit_homography(image, plane)
        assert np.abs(apply_homography(homography, image) - plane).max() < 1e-8


def test_published_markers_are_the_counts_pydotbot_read(one: Path) -> None:
    """Each file alone leads to the same counts, which are whole: nothing else would be."""
    found = []
    for i in range(7):
        scene = read_dotbot([one / "lighthouse" / f"{i}_lh2.csv"]).scene
        assert scene is not None
        assert [m.name for m in scene.markers] == list(CORNERS)
        found.append([m.visits[0].counts[1] for m in scene.markers])
    counts = np.array(found)
    assert np.ptp(counts, axis=0).max() < 1e-6
    expected = [[35273, 75582], [41104, 80565], [39998, 82486], [35214, 78358]]
    np.testing.assert_allclose(counts[0], expected, atol=2e-3)


def test_published_two_stations(two_session: ImportedSession) -> None:
    sweeps = two_session.sweeps
    assert len(sweeps) == 4 * 4626
    rows = {name: int(np.sum(sweeps.device == i)) // 4 for i, name in enumerate(sweeps.devices)}
    assert rows == {"R": 2065, "G": 1372, "B": 1189}
    assert sweeps.channel[:4].tolist() == [1, 1, 2, 2]
    assert sweeps.count[:4].tolist() == [48333, 88779, 48979, 94628]
    assert two_session.warnings == []
    scene = two_session.scene
    assert scene is not None
    for marker in scene.markers:
        (sighting,) = marker.visits
        assert sighting.device == "R"
        assert sighting.start_ns is not None
        assert sighting.end_ns is not None
        red = sweeps.device == sweeps.devices.index("R")
        stay = (sweeps.time_ns >= sighting.start_ns) & (sweeps.time_ns <= sighting.end_ns)
        assert 30 < np.sum(red & stay) / 4 < 50
        # It stood still there: a few counts of scatter.
        assert sweeps.count[red & stay].reshape(-1, 4).std(axis=0).max() < 5


def test_published_grid(data: Path) -> None:
    folder = data / "lighthouse" / "twoLH-3D_scene" / "dataset"
    session = read_dotbot([folder / "data_all.csv"])
    assert len(session.sweeps) == 4 * 4759
    assert session.scene is None
    (truth,) = session.truth
    assert (truth.device, truth.frame, len(truth)) == ("robot", "grid", 4759)
    assert len(np.unique(truth.position, axis=0)) == 140
    np.testing.assert_allclose(truth.position.max(axis=0), [0.24, 0.12, 0.16])
    assert len(read_dotbot([folder / "data_1point.csv"]).truth[0]) == 140


def _side(points: np.ndarray) -> float:
    """Sign of the area: + where the corners go counterclockwise."""
    x, y = points.T
    return float(np.sign(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


def test_published_truth_on_the_floor(one: Path, two_session: ImportedSession) -> None:
    tracks = [one / "ground_truth" / f"{i}_blender.csv" for i in range(1, 6)]
    session = read_dotbot([one / "lighthouse" / "1_lh2.csv"], tracks)
    (truth,) = session.truth
    assert (truth.device, truth.frame) == ("robot", "floor")
    assert len(truth) == 1211 + 784 + 1341 + 951 + 1271
    # The robot drove along the square of 40 cm; y is negated so that z is up.
    assert np.all(truth.position >= np.array([0.8, -1.2, 0]) - np.array([0.05, 0.05, 0]))
    assert np.all(truth.position <= np.array([1.2, -0.8, 0]) + np.array([0.05, 0.05, 0]))
    lengths = {t.device: len(t) for t in two_session.truth}
    assert lengths == {"R": 5835, "G": 3583, "B": 1268}
    assert sum(lengths.values()) == 1691 + 561 + 1942 + 3910 + 2582
    for track in two_session.truth:
        assert np.all(np.abs(track.position[:, :2] - [1.0, -1.0]) < 0.5)
        assert np.all(track.position[:, 2] == 0)


def test_published_floor_has_z_up(one: Path, two_session: ImportedSession) -> None:
    """Stations look at the floor from above: they see the corners turn as z up has them."""
    scene = two_session.scene
    assert scene is not None
    floor = np.array([m.position[:2] for m in scene.markers])
    assert _side(floor) == -1  # clockwise from above: the names say so too
    sweeps = two_session.sweeps
    for channel in (1, 2):
        corners = []
        for marker in scene.markers:
            (s,) = marker.visits
            keep = (sweeps.channel == channel) & (sweeps.device == sweeps.devices.index("R"))
            keep &= (sweeps.time_ns >= s.start_ns) & (sweeps.time_ns <= s.end_ns)
            corners.append(sweeps.count[keep].reshape(-1, 2).mean(axis=0))
        assert _side(paper_image_points(np.array(corners), channel)) == _side(floor)
    single = read_dotbot([one / "lighthouse" / "1_lh2.csv"]).scene
    assert single is not None
    corners = [m.visits[0].counts[1] for m in single.markers]
    assert _side(paper_image_points(np.array(corners), 1)) == -1


def test_published_error_of_the_authors_is_reproduced(one: Path) -> None:
    """PyDotBot's x, y against the tracks, unaligned: frames, mirroring and clocks agree.

    The authors' figure_8.py prints 7.01 / 7.86 / 3.56 mm (MAE / RMSE / SD) for experiments
    1 to 5 with the camera shifted by +0.318109 s; it extrapolates the tracks by 14 rows.
    """
    pairs = []
    for i in range(1, 6):
        file = one / "lighthouse" / f"{i}_lh2.csv"
        session = read_dotbot([file], [one / "ground_truth" / f"{i}_blender.csv"])
        plane, _ = plane_and_counts(file)
        position = np.column_stack([plane * np.array([2.0, -2.0]), np.zeros(len(plane))])
        time = session.sweeps.time_ns[::2]
        pairs.append((Trajectory.from_positions("robot", "floor", time, position), *session.truth))
    theirs = evaluate(pairs, EvaluationOptions(offset_s=-0.318109))
    assert theirs.mae == pytest.approx(7.01e-3, abs=0.05e-3)
    assert theirs.rmse == pytest.approx(7.86e-3, abs=0.15e-3)
    ours = evaluate(pairs, EvaluationOptions(offset_s="auto"))
    assert ours.offset_s == pytest.approx(-0.25, abs=0.02)
    assert ours.mae < 3.6e-3


# ---- files made here


Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def to_file(text: str | bytes, name: str = "data.csv") -> Path:
        file = tmp_path / name
        file.write_bytes(text.encode() if isinstance(text, str) else text)
        return file

    return to_file


TWO = ",timestamp,source,LHA_count_1,LHA_count_2,LHB_count_1,LHB_count_2\n"
ROW = "0,2023-07-27T15:34:22.700963Z,R,48333,88779,48979,94628\n"
NEXT = "1,2023-07-27T15:34:22.804963Z,R,43517,84421,47416,93591\n"
T0 = 1690472062700963000


@pytest.mark.parametrize(
    "stamp",
    [
        "2023-07-27T15:34:22.700963Z",
        "2023-07-27 15:34:22.700963",
        "2023-07-27 15:34:22.700963000",
        "2023-07-27T15:34:22.700963+00:00",
    ],
)
def test_stamps_are_utc_to_the_nanosecond(write: Write, stamp: str) -> None:
    file = write(f"timestamp,c0,c1\n{stamp},40000,82000\n")
    assert read_dotbot([file]).sweeps.time_ns.tolist() == [T0, T0]
    file = write("timestamp,c0,c1\n2023-07-27 15:34:22.700963001,40000,82000\n")
    assert read_dotbot([file]).sweeps.time_ns[0] == T0 + 1


def test_polynomials_tell_the_channel(write: Write) -> None:
    file = write(
        "timestamp,source,poly_0,lfsr_index_0,poly_1,lfsr_index_1,db_time\n"
        "2023-07-27T15:34:22.1Z,a,8,40000,9,80000,1\n"
        "2023-07-27T15:34:22.1Z,a,31,30000,30,70000,1\n"
    )
    session = read_dotbot([file])
    assert session.sweeps.channel.tolist() == [5, 5, 16, 16]
    assert session.sweeps.polynomial.tolist() == [8, 9, 31, 30]
    assert session.warnings == []  # two stations at one time are no repetition
    assert "from polynomials" in session.facts["channels"]

    file = write("timestamp,c0,c1,poly_0,poly_1\n2023-07-27T15:34:22Z,82000,40000,4,5\n")
    assert read_dotbot([file]).sweeps.channel.tolist() == [3, 3]

    file = write(
        ",timestamp,db_time,lha_poly_0,lha_count_0,lha_poly_1,lha_count_1,"
        "lhb_poly_0,lhb_count_0,lhb_poly_1,lhb_count_1\n"
        "0,2024-12-10T15:27:05.191002Z,206921,1,36669,1,75077,3,37516,3,78457\n"
    )
    sweeps = read_dotbot([file]).sweeps
    assert sweeps.channel.tolist() == [1, 1, 2, 2]
    assert sweeps.count.tolist() == [36669, 75077, 37516, 78457]


def test_counts_above_the_period_are_kept_for_the_solver(write: Write) -> None:
    sweeps = read_dotbot([write(TWO + ROW.replace("94628", "131070"))]).sweeps
    assert sweeps.count.tolist() == [48333, 88779, 48979, 131070]


def test_swapped_and_repeated_stamps_are_mended_and_told(write: Write) -> None:
    swapped = read_dotbot([write(TWO + NEXT + ROW)])
    assert swapped.sweeps.time_ns[0] == T0
    assert len(swapped.sweeps) == 8
    assert swapped.warnings == ["time stamps went backwards 1 times: rows were sorted"]

    other_device = read_dotbot([write(TWO + NEXT + ROW.replace(",R,", ",G,"))])
    assert other_device.warnings == []
    assert other_device.sweeps.devices[other_device.sweeps.device[0]] == "G"

    copied = read_dotbot([write(TWO + ROW + ROW + NEXT)])
    assert len(copied.sweeps) == 8
    assert copied.warnings == ["1 rows repeat another row exactly: dropped"]

    clash = read_dotbot([write(TWO + ROW + ROW.replace("48333", "50000") + NEXT)])
    assert clash.sweeps.count[0] == 48333
    assert len(clash.sweeps) == 8
    assert len(clash.warnings) == 1
    assert "other counts" in clash.warnings[0]


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", None, "empty file"),
        ("\n\n", None, "empty file"),
        (TWO, 1, "no rows"),
        ("time,value\n1,2\n", 1, "known DotBot layout"),
        (TWO.replace(",LHB_count_2", "") + "0,2023-07-27T15:34:22Z,R,1,2,3\n", 1, "'lhb_count_2'"),
        (TWO.replace("timestamp", "when") + ROW, 1, "'timestamp'"),
        ("timestamp,c0\n2023-07-27T15:34:22Z,1\n", 1, "'c1'"),
        (TWO.replace("LHB_count_2", "LHB_count_1") + ROW, 1, "twice"),
        (TWO + ROW + NEXT.replace("84421", "many"), 3, "'many'"),
        (TWO + ROW + NEXT.replace("84421", ""), 3, "empty cell"),
        (TWO + ROW + NEXT.replace("84421", "nan"), 3, "finite"),
        (TWO + ROW + NEXT.replace("84421", "inf"), 3, "finite"),
        (TWO + ROW + NEXT.replace("84421", "-5"), 3, "0 or more"),
        (TWO + ROW + NEXT.replace(",R,", ",,"), 3, "'source'"),
        (TWO + ROW + "\n" + NEXT.replace("15:34", "25:34"), 4, "time in UTC"),
        (TWO + ROW + NEXT.replace("2023-07-27", "2023-02-30"), 3, "time in UTC"),
        (TWO + ROW + NEXT.replace("Z", "+02:00"), 3, "time in UTC"),
        (TWO + ROW + NEXT.replace("2023-07-27T15:34:22.804963Z", "NaT"), 3, "time in UTC"),
        (TWO + ROW + NEXT.replace("2023-07-27T15:34:22.804963Z", "1690472062.8"), 3, "time in UTC"),
        (TWO + ROW + NEXT.strip()[:30], 3, "cells"),
        (TWO + ROW + '1,"2023\n', 3, "broken CSV"),
        (TWO.encode() + ROW.encode() + b"1,\xff\xfe\n", 3, "UTF-8"),
        (TWO + ROW + "\0" * 20, 3, "zero bytes"),
        ("timestamp,c0,c1,poly_0,poly_1\n2023-07-27T15:34:22Z,1,2,0,32\n", 2, "31 or less"),
        ("timestamp,c0,c1,poly_0,poly_1\n2023-07-27T15:34:22Z,1,2,0,-1\n", 2, "0 or more"),
        ("timestamp,c0,c1,poly_0,poly_1\n2023-07-27T15:34:22Z,1,2,0,1.5\n", 2, "whole"),
        ("timestamp,c0,c1\n2023-07-27T15:34:22Z,1,131072\n", 2, "131071 or less"),
        ("timestamp,c0,c1\n2023-07-27T15:34:22Z,1e30,2\n", 2, "131071 or less"),
        (
            "timestamp,c0,c1,real_x_mm,real_y_mm,real_z_mm\n2023-07-27T15:34:22Z,1,2,0,1e30,0\n",
            2,
            "1000000 or less",
        ),
        ("timestamp,c0,c1,real_x_mm\n2023-07-27T15:34:22Z,1,2,0\n", 1, "'real_y_mm'"),
    ],
)
def test_bad_input_names_file_and_line(write: Write, text: str, where: object, what: str) -> None:
    file = write(text)
    with pytest.raises(InputError) as caught:
        read_dotbot([file])
    error = caught.value
    assert (error.file, error.where) == (str(file), where)
    assert what in str(error)
    assert error.hint
    assert "\n" not in str(error) + error.hint


def test_missing_files_and_mixed_layouts(write: Write, tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        read_dotbot([tmp_path / "none.csv"])
    with pytest.raises(InputError, match="a folder"):
        read_dotbot([tmp_path])
    with pytest.raises(MissingDataError):
        read_dotbot([])
    other = write("timestamp,c0,c1\n2023-07-27T15:34:22Z,1,2\n", "other.csv")
    with pytest.raises(InputError, match="layout 'one-station'"):
        read_dotbot([write(TWO + ROW), other])


@pytest.mark.slow
@given(st.binary(max_size=300))
def test_any_bytes_are_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    file = tmp_path_factory.mktemp("junk") / "junk.csv"
    file.write_bytes(content)
    with pytest.raises(LocatkError):
        read_dotbot([file])


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(st.integers(0, 10**6), st.sampled_from("RGB"), st.integers(0, 131071)),
        min_size=1,
        max_size=20,
        unique_by=lambda row: row[:2],
    )
)
def test_no_row_is_lost_or_changed(tmp_path_factory: pytest.TempPathFactory, rows: list) -> None:
    file = tmp_path_factory.mktemp("rows") / "data.csv"
    lines = [
        f"{i},{np.datetime64(T0 + us * 1000, 'ns')},{device},{count},1,2,3\n"
        for i, (us, device, count) in enumerate(rows)
    ]
    file.write_text(TWO + "".join(lines))
    s = read_dotbot([file]).sweeps
    found = zip(s.time_ns[::4], s.device[::4], s.count[::4], strict=True)
    read = [((int(t) - T0) // 1000, s.devices[d], int(c)) for t, d, c in found]
    assert sorted(read) == sorted(rows)
    assert np.all(np.diff(s.time_ns) >= 0)


# ---- calibration and truth


SQUARE = {
    "corners_px": {"tl": [100, 300, 0.0], "tr": [300, 300], "br": [300, 100], "bl": [100, 100]},
    "corners_cm": {"tl": [80, 80], "tr": [120, 80], "br": [120, 120], "bl": [80, 120]},
    "corners_lh2": {"tl": [0.4, 0.4], "tr": [0.6, 0.4], "br": [0.6, 0.6], "bl": [0.4, 0.6]},
}
TRACK = "timestamp,frame,x,y\n2023-07-27T15:34:22Z,1,100,300\n2023-07-27T15:34:23Z,2,200,200\n"


def stays() -> dict:
    """A square whose corner tl a robot stood on at the time of ROW and NEXT."""
    interval = ["2023-07-27T15:34:22Z", "2023-07-27T15:34:23Z"]
    return {"corners_cm": SQUARE["corners_cm"], "timestamps_lh2": {"tl": interval}}


def test_truth_in_floor_metres_with_z_up(write: Write) -> None:
    write(json.dumps({"video.mp4": SQUARE}), "calibration.json")
    recording, track = write(TWO + ROW), write(TRACK, "1_blender.csv")
    session = read_dotbot([recording], [track])
    assert session.facts["calibration"].endswith("(y negated, so that z is up)")
    (truth,) = session.truth
    assert isinstance(truth, Trajectory)
    assert truth.device == "R"
    np.testing.assert_allclose(truth.position, [[0.8, -0.8, 0], [1.0, -1.0, 0]], atol=1e-12)

    upright = {c: [x, 200 - y] for c, (x, y) in SQUARE["corners_cm"].items()}
    write(json.dumps({"v": {**SQUARE, "corners_cm": upright}}), "calibration.json")
    session = read_dotbot([recording], [track])
    np.testing.assert_allclose(
        session.truth[0].position, [[0.8, 1.2, 0], [1.0, 1.0, 0]], atol=1e-12
    )
    assert "as given" in session.facts["calibration"]


def test_truth_of_several_devices(write: Write) -> None:
    write(json.dumps({"video.mp4": SQUARE}), "calibration.json")
    recording = write(TWO + ROW + NEXT.replace(",R,", ",G,"))
    with pytest.raises(InputError, match="'source'"):
        read_dotbot([recording], [write(TRACK, "t.csv")])
    named = "timestamp,frame,source,x,y\n2023-07-27T15:34:22Z,1,G,1,2\n"
    named += "2023-07-27T15:34:22Z,1,B,1,2\n2023-07-27T15:34:22Z,1,B,1,2\n"
    session = read_dotbot([recording], [write(named, "t.csv")])
    assert [(t.device, len(t)) for t in session.truth] == [("G", 1), ("B", 1)]
    assert any("'B'" in w for w in session.warnings)
    assert any("repeat" in w for w in session.warnings)


def test_truth_needs_a_calibration(write: Write, tmp_path: Path) -> None:
    recording, track = write(TWO + ROW), write(TRACK, "t.csv")
    with pytest.raises(MissingDataError, match="calibration") as caught:
        read_dotbot([recording], [track])
    assert "--calibration" in str(caught.value.hint)
    with pytest.raises(MissingDataError, match="calibration"):
        read_dotbot([recording], [track], calibration=tmp_path / "none.json")
    write(json.dumps({"v": stays()}), "calibration.json")
    with pytest.raises(MissingDataError, match="corners_px"):
        read_dotbot([recording], [track])
    grid = write("timestamp,c0,c1,real_x_mm,real_y_mm,real_z_mm\n2023-07-27T15:34:22Z,1,2,1,2,3\n")
    with pytest.raises(InputError, match="own columns"):
        read_dotbot([grid], [track])


def test_markers_name_the_device_that_stood_there(write: Write) -> None:
    write(json.dumps({"v": stays()}), "calibration.json")
    session = read_dotbot([write(TWO + ROW)])
    assert session.scene is not None
    assert session.scene.markers[0].visits[0].device == "R"
    assert session.scene.markers[1].visits == ()
    both = read_dotbot([write(TWO + ROW + NEXT.replace(",R,", ",G,"))])
    assert both.scene is None
    assert "more than one device" in both.warnings[0]
    nobody = read_dotbot([write(TWO + ROW.replace("2023", "2022"))])
    assert nobody.scene is None
    assert "no device" in nobody.warnings[0]


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("{", "JSON"),
        ("[]", "object"),
        ("{}", "no entries"),
        (json.dumps({"a": SQUARE, "b": SQUARE}), "2 entries (a, b), of which none"),
        (json.dumps({"a": {}}), "corners_cm"),
        (json.dumps({"a": {"corners_cm": {"tl": [1, "x"]}}}), "two numbers"),
        (json.dumps({"a": {"corners_cm": {"tl": [1, float("nan")]}}}), "two numbers"),
        (json.dumps({"a": {"corners_mm": {"tl": [1, 10**400]}}}), "two numbers"),
        (json.dumps({"a": {"corners_mm": {"tl": [1, 1e308]}}}), "two numbers"),
        ('{"corners_mm": {"tl": [1, ' + 5000 * "1" + "]}}", "too long"),
        (json.dumps({"a": {"corners_cm": {"tl": [1]}}}), "two numbers"),
        (json.dumps({"a": {"corners_cm": [1, 2]}}), "object"),
        (json.dumps({"a": {**SQUARE, "corners_px": {"top": [1, 2]}}}), "'top'"),
        (json.dumps({"a": {**stays(), "timestamps_lh2": {"tl": ["now", "later"]}}}), "times"),
        (json.dumps({"a": {**stays(), "timestamps_lh2": {"tl": 5}}}), "times"),
        ("[" * 100_000, "nested"),
    ],
)
def test_bad_calibration_is_named(write: Write, content: str, what: str) -> None:
    recording = write(TWO + ROW)
    file = write(content, "calibration.json")
    with pytest.raises(FormatError) as caught:
        read_dotbot([recording])
    assert caught.value.file == str(file)
    assert what in str(caught.value)


def scenes() -> dict:
    """Both scenes of alvarado24automatic: corners in space, stays, circles."""

    def scene(day: int, shift: float) -> dict:
        corners = {
            "tl": [935, 452, 37],
            "tr": [957, 54, 34],
            "br": [557, 31, 31],
            "bl": [539, 431, 34],
        }
        times = {
            c: [f"2024-12-{day}T15:27:{k}0Z", f"2024-12-{day}T15:27:{k}9Z"]
            for k, c in enumerate(corners, 1)
        }
        return {
            "corners_mm": {c: [x + shift, y, z] for c, (x, y, z) in corners.items()},
            "timestamps_lh2": times,
            "circles": {"quantity": 2, "1": times["tl"], "2": times["tr"]},
        }

    return {"scene_1": scene(10, 0), "scene_2": scene(11, 40)}


LABELLED = ",timestamp,db_time,lha_poly_0,lha_count_0,lha_poly_1,lha_count_1,"
LABELLED += "lhb_poly_0,lhb_count_0,lhb_poly_1,lhb_count_1\n"
LABELLED += "0,2024-12-11T15:27:15Z,5000000,1,36669,0,75076,3,37516,2,78457\n"
LABELLED += "1,2024-12-11T15:27:45Z,35000000,1,36669,0,75076,3,37516,2,78457\n"


def test_scenes_of_one_calibration(write: Write, tmp_path: Path) -> None:
    """The folder of the recording names its scene, otherwise its times do."""
    write(json.dumps(scenes()), "calibration.json")
    (tmp_path / "scene_2").mkdir()
    session = read_dotbot([write(LABELLED, "scene_2/lh_data.csv")])
    assert session.scene is not None
    markers = {marker.name: marker for marker in session.scene.markers}
    # In the millimetres of the motion capture, z up, on a level floor.
    np.testing.assert_allclose(markers["tl"].position, [0.975, 0.452, 0.034], atol=1e-12)
    np.testing.assert_allclose(markers["br"].position, [0.597, 0.031, 0.034], atol=1e-12)
    [visit] = markers["tl"].visits
    assert (visit.device, visit.start_ns) == ("robot", 1733930830000000000)
    assert [len(markers[name].visits) for name in CORNERS] == [1, 0, 0, 1]
    assert "heights averaged over 6 mm; not used: 2 circles" in session.facts["calibration"]
    by_time = read_dotbot([write(LABELLED, "run.csv")])
    np.testing.assert_array_equal(
        [m.position for m in by_time.scene.markers], [m.position for m in session.scene.markers]
    )
    other_day = LABELLED.replace("2024-12-11", "2024-12-20")
    with pytest.raises(FormatError, match="of which none belong to the recording"):
        read_dotbot([write(other_day, "run.csv")])
    named = read_dotbot([write(other_day, "scene_2/lh_data.csv")])
    assert "no device reported" in named.warnings[0]
    # A file of the folder above that does not name the folder is of something else.
    (tmp_path / "scene_3").mkdir()
    assert read_dotbot([write(LABELLED, "scene_3/lh_data.csv")]).scene is None
    write("not JSON", "calibration.json")
    assert read_dotbot([write(LABELLED, "scene_2/lh_data.csv")]).scene is None


def test_corners_at_different_heights_stay(write: Write) -> None:
    table = scenes()
    table["scene_1"]["corners_mm"]["tl"][2] = 700
    write(json.dumps({"scene_1": table["scene_1"]}), "calibration.json")
    session = read_dotbot([write(LABELLED.replace("2024-12-11", "2024-12-10"))])
    assert session.scene.markers[0].position[2] == pytest.approx(0.7)


def test_corners_on_a_line_are_refused(write: Write) -> None:
    line = {c: [i, 2 * i] for i, c in enumerate(CORNERS)}
    write(json.dumps({"v": {**SQUARE, "corners_px": line}}), "calibration.json")
    with pytest.raises(FormatError, match="corners_px"):
        read_dotbot([write(TWO + ROW)], [write(TRACK, "t.csv")])


# ---- counts and image points


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.integers(1, 16))
def test_image_points_go_back_to_counts(right: float, up: float, channel: int) -> None:
    """What the recovery of markers rests on: the inverse of the paper's image point."""
    angles = predict_angles(np.array([1.0, -right, up]), IDEAL_CALIBRATION)
    counts = angles_to_counts(angles, channel)
    assert counts[0] < counts[1]
    np.testing.assert_allclose(paper_image_points(counts, channel), [right, up], atol=1e-9)


def synthetic(plane_noise: float = 0.0) -> tuple[str, np.ndarray]:
    """A one-station recording as PyDotBot writes it, and the counts on its corners."""
    corner_counts = np.array([[36000, 75000], [41000, 80500], [40000, 82500], [35000, 78000.0]])
    plane = np.array([SQUARE["corners_lh2"][c] for c in CORNERS])
    homography = fit_homography(paper_image_points(corner_counts, 1), plane)
    rng = np.random.default_rng(0)
    counts = np.round(np.array([38000, 79000]) + rng.normal(0, 400, (60, 2)))
    xy = apply_homography(homography, paper_image_points(counts, 1))
    xy += rng.normal(0, 1, xy.shape) * plane_noise
    text = "timestamp,x,y,c0,c1\n"
    for i, ((x, y), row) in enumerate(zip(xy.tolist(), counts.astype(int), strict=True)):
        first, second = row if i % 3 else row[::-1]
        text += f"2023-07-24 17:11:{i:02d}.5,{x!r},{y!r},{first},{second}\n"
    return text, corner_counts


def test_markers_are_recovered_whatever_the_order_of_counts(write: Write) -> None:
    text, expected = synthetic()
    write(json.dumps({"v": SQUARE}), "calibration.json")
    session = read_dotbot([write(text)])
    assert session.scene is not None
    found = [m.visits[0].counts[1] for m in session.scene.markers]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(session.scene.markers[0].position, [0.8, -0.8, 0])
    assert "homography of columns x" in session.facts["markers"]


def test_no_markers_from_a_plane_that_is_not_of_these_counts(write: Write) -> None:
    write(json.dumps({"v": SQUARE}), "calibration.json")
    session = read_dotbot([write(synthetic(1e-3)[0])])
    assert session.scene is None
    assert "not a homography of the counts" in session.warnings[0]
    still = "timestamp,x,y,c0,c1\n" + "".join(
        f"2023-07-24 17:11:{i:02d},0.5,0.5,38000,79000\n" for i in range(10)
    )
    session = read_dotbot([write(still)])
    assert session.scene is None
    assert "coincide" in session.warnings[0]


# ---- single sweeps, and the clock of the robot


class Event(NamedTuple):
    """Sweep that a robot received."""

    time_s: float
    polynomial: int
    count: int
    slot: int
    plane: int


def received(
    seconds: float, stations: int, *, rest: tuple[float, float] = (0, 0), seed: int = 1
) -> list[Event]:
    """Sweeps of rotors that run freely, over a robot that drives a circle and rests once."""
    rng = np.random.default_rng(seed)
    events = []
    for station in range(stations):
        period_s = [959000, 957000][station] / 48e6 * (1 + [-15e-6, 22e-6][station])
        places, slot_of_plane = [(0.1, 2.0), (-1.5, 1.0)][station], [(1, 0), (0, 1)][station]
        start_s = rng.uniform(0, period_s)
        while start_s < seconds:
            polynomial = 2 * station + int(rng.integers(2))
            for plane, fraction in enumerate((1 / 3, 2 / 3)):
                time_s = start_s + fraction * period_s
                driven_s = time_s - np.clip(time_s - rest[0], 0, rest[1] - rest[0])
                x, y = 0.5 * np.cos(driven_s), 0.5 * np.sin(driven_s)
                angle = np.arctan2(y - places[0], x + places[1])
                turn = fraction + (angle + (-1) ** plane * -0.3) / (2 * np.pi)
                count = turn * period_s * 6e6 + rng.normal(0, 0.8)
                if rng.uniform() > 0.1:
                    event = (start_s + turn * period_s, polynomial, round(count))
                    events.append(Event(*event, slot_of_plane[plane], plane))
            start_s += period_s
    return sorted(events)


def held_table(events: list[Event], stations: int, *, max_age_us: int, boot_us: int = 7) -> str:
    """Table as `parse_logfile.py` writes it: the last sweep of each slot, at the newest's time."""
    names = ["poly_0,lfsr_index_0,poly_1,lfsr_index_1"]
    if stations == 2:
        names = [f"lh{k}_poly_0,lh{k}_count_0,lh{k}_poly_1,lh{k}_count_1" for k in "ab"]
    lines = [",timestamp,db_time," + ",".join(names)]
    cells: dict[tuple[int, int], tuple[int, int, int]] = {}
    for event in events:
        tick = boot_us + round(event.time_s * 1e6 * (1 + 30e-6))
        cells[event.polynomial // 2, event.slot] = (event.polynomial, event.count, tick)
        cells = {key: cell for key, cell in cells.items() if tick - cell[2] <= max_age_us}
        if len(cells) == 2 * stations:
            row = [f"{cell[0]},{cell[1]}" for _, cell in sorted(cells.items())]
            stamp = np.datetime64(T0 + tick * 1000, "ns")
            lines.append(f"{len(lines) - 1},{stamp}Z,{tick}," + ",".join(row))
    return "\n".join(lines) + "\n"


def time_errors_us(sweeps: Sweeps, events: list[Event]) -> np.ndarray:
    """Differences of the times of sweeps from those of their events."""
    times: dict[tuple[int, float], list[float]] = {}
    for event in events:
        times.setdefault((event.polynomial, event.count), []).append(event.time_s)
    found_s = (sweeps.time_ns - T0 - 7000) / 1e9 / (1 + 30e-6)
    columns = (sweeps.polynomial.tolist(), sweeps.count.tolist(), found_s.tolist())
    return 1e6 * np.array(
        [min((at - t for t in times[p, c]), key=abs) for p, c, at in zip(*columns, strict=True)]
    )


@pytest.mark.parametrize(("stations", "max_age_us"), [(1, 10**9), (2, 25_000)])
def test_held_counts_are_left_out(write: Write, stations: int, max_age_us: int) -> None:
    """A sweep of each row is new if nothing is missing; the others are copies of earlier ones."""
    events = received(8, stations, rest=(2, 5))
    session = read_dotbot([write(held_table(events, stations, max_age_us=max_age_us))])
    error_us = time_errors_us(session.sweeps, events)
    # One in a hundred is dated one rotation too late, because two in succession were lost.
    assert np.mean(np.abs(error_us) < 15) > 0.99
    assert np.abs(error_us).max() < 25_000
    rows, sweeps = int(session.facts["rows"]), len(session.sweeps)
    assert 0.9 * len(events) < sweeps <= len(events)
    plane = {(e.polynomial, e.count): e.plane for e in events}
    keys = zip(session.sweeps.polynomial.tolist(), session.sweeps.count.tolist(), strict=True)
    assert [plane[key] for key in keys] == session.sweeps.sweep.tolist()
    assert "clocks of the robots" in session.facts["clock"]
    assert f"{rows * 2 * stations - sweeps} counts are repeated" in session.facts["repeated"]


def test_rows_are_in_the_order_of_their_numbers(write: Write) -> None:
    """A robot reports station by station; the published tables were sorted by time afterwards."""
    events = [e for e in received(8, 2) if e.time_s % 0.1 > 0.03]
    logged = sorted(events, key=lambda e: (e.time_s // 0.02, e.polynomial // 2, e.time_s))
    header, *rows = held_table(logged, 2, max_age_us=25_000).splitlines()
    rows.sort(key=lambda row: row.split(",")[1])
    sweeps = read_dotbot([write("\n".join([header, *rows]) + "\n")]).sweeps
    numbered = np.mean(np.abs(time_errors_us(sweeps, events)) < 15)
    # The rest is a rotation off: nothing tells which of two the robot received.
    assert numbered > 0.83
    unnumbered = [row.split(",", 1)[1] for row in (header, *rows)]
    sweeps = read_dotbot([write("\n".join(unnumbered) + "\n")]).sweeps
    assert np.mean(np.abs(time_errors_us(sweeps, events)) < 15) < numbered - 0.03


def test_complete_reports_with_a_clock_are_kept(write: Write) -> None:
    """Pairs of one rotation at a time of the robot's clock, also at rest."""
    rng = np.random.default_rng(3)
    lines = ["timestamp,source,poly_0,lfsr_index_0,poly_1,lfsr_index_1,db_time"]
    for k in range(200):
        first = 40000 + (k > 100) * 30 * k + int(rng.normal(0, 2))
        stamp = np.datetime64(T0 + k * 100_000_000, "ns")
        lines.append(f"{stamp}Z,a,0,{first},1,{first + 41000 + int(rng.normal(0, 2))},{k * 100000}")
    session = read_dotbot([write("\n".join(lines) + "\n")])
    assert len(session.sweeps) == 400
    assert "repeated" not in session.facts


def test_a_clock_corrects_the_times_of_a_log(write: Write) -> None:
    """Log lines are late by up to 40 ms, the clock wraps, and the robot restarts."""
    rng = np.random.default_rng(4)
    lines, true_ns = ["db_time,SWEEP,lfsr_index,Timestamp,poly,source"], []
    for k in range(1500):
        at_us = 20_000 * k
        tick = (2**32 - 5_000_000 + at_us) % 2**32 if k < 900 else at_us - 18_000_000
        late_ns = round(rng.exponential(8e6)) if k % 7 else 0
        true_ns.append(T0 + 1000 * at_us)
        lines.append(f"{tick},0,{30000 + k},{np.datetime64(true_ns[-1] + late_ns, 'ns')}Z,4,a")
    session = read_dotbot([write("\n".join(lines) + "\n")])
    assert session.facts["layout"] == "sweep-per-row"
    assert session.warnings[-1:] == ["the clock of a restarted 1 times"]
    error_ns = session.sweeps.time_ns - np.array(true_ns)[session.sweeps.count.astype(int) - 30000]
    assert np.quantile(np.abs(error_ns), 0.98) < 3e6


def test_planes_of_single_sweeps(write: Write) -> None:
    """The slot of station 1 is the other plane, that of station 2 the plane."""
    events = received(6, 2)
    gap = [e for e in events if not (2 < e.time_s < 5 and (e.slot == 0 or e.polynomial > 1))]
    lines = ["sweep,source,lfsr_index,timestamp,poly"]
    for e in gap:
        stamp = np.datetime64(T0 + round(e.time_s * 1e9), "ns")
        lines.append(f"{e.slot},a,{e.count},{stamp}Z,{e.polynomial}")
    sweeps = read_dotbot([write("\n".join(lines) + "\n")]).sweeps
    assert sweeps.sweep.tolist() == [e.plane for e in gap]
    assert sweeps.count.tolist() == [e.count for e in gap]
    assert sweeps.channel.tolist() == [e.polynomial // 2 + 1 for e in gap]
    # Without slots, and with slots that change their plane, planes are not guessed.
    plain = [line.split(",", 1)[1] for line in lines]
    assert set(read_dotbot([write("\n".join(plain) + "\n")]).sweeps.sweep) == {-1}
    few = lines[:1] + [line for line in lines[1:] if line.startswith("0")]
    assert set(read_dotbot([write("\n".join(few) + "\n")]).sweeps.sweep) == {-1}


def test_slots_that_a_restart_exchanged(write: Write) -> None:
    lines, planes = ["timestamp,source,poly,lfsr_index,sweep"], []
    for e in received(6, 1):
        slot = e.slot if e.time_s < 3 else 1 - e.slot
        lines.append(f"{np.datetime64(T0 + round(e.time_s * 1e9), 'ns')}Z,a,0,{e.count},{slot}")
        planes.append(e.plane)
    found = read_dotbot([write("\n".join(lines) + "\n")]).sweeps.sweep
    assert np.mean(found == planes) > 0.99
    assert set(found[found != planes]) <= {-1}


def test_headers_in_other_spellings(write: Write) -> None:
    columns = "Time [s],Device,Polynomial 0,LFSR-Index 0,polynomial.1,lfsr_counts_1,DB Time [us]"
    session = read_dotbot([write(columns + "\n1690472062.700963,a,8,40000,9,80000,1\n")])
    assert session.sweeps.time_ns.tolist() == [T0] * 2
    assert session.sweeps.devices == ("a",)
    assert session.sweeps.channel.tolist() == [5, 5]
    with pytest.raises(FormatError, match="'poly' occurs twice"):
        read_dotbot([write("timestamp,poly,polynomial,lfsr_index\n1,2,3,4\n")])
