"""CSV, TUM and KITTI files: exact round trips, and errors that name file and line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError, OutputExistsError
from locatk.core.geometry import matrix_from_quaternion, rotation_exp
from locatk.core.trajectory import Trajectory, has_orientation
from locatk.formats.exporters.kitti import write_kitti
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.exporters.tum import write_tum
from locatk.formats.importers.poses.kitti import read_kitti
from locatk.formats.importers.poses.trajectory_csv import SIGMA_AXES, read_csv
from locatk.formats.importers.poses.tum import read_tum
from locatk.formats.tables import delimited, timestamps

FINITE = st.floats(-1e9, 1e9)
NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)


@st.composite
def poses(draw: st.DrawFn, names: st.SearchStrategy[str] = NAMES) -> Trajectory:
    stamps = sorted(draw(st.sets(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=8)))
    n = len(stamps)
    position = np.array(draw(st.lists(FINITE, min_size=3 * n, max_size=3 * n))).reshape(n, 3)
    quaternion = np.array(
        [draw(st.lists(st.floats(-1, 1), min_size=4, max_size=4)) for _ in range(n)]
    )
    quaternion[np.linalg.norm(quaternion, axis=1) < 0.1] = [0, 0, 0, 1]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    sigma = np.full((n, 6), np.nan)
    for axis in draw(st.sets(st.sampled_from(SIGMA_AXES))):
        sigma[:, axis] = draw(st.floats(0, 1e3))
    covariance = np.full((n, 6, 6), np.nan)
    covariance[:, range(6), range(6)] = sigma**2
    return Trajectory(
        draw(names), "floor", np.array(stamps, np.int64), position, quaternion, covariance
    )


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.lists(poses(), max_size=3, unique_by=lambda p: p.device).filter(len))
def test_csv_round_trip(tmp_path_factory: pytest.TempPathFactory, written: list) -> None:
    file = tmp_path_factory.mktemp("csv") / "poses.csv"
    write_csv(file, written)
    read = read_csv(file)
    assert [r.device for r in read] == [w.device for w in written]
    for r, w in zip(read, written, strict=True):
        np.testing.assert_array_equal(r.time_ns, w.time_ns)
        np.testing.assert_array_equal(r.position, w.position)
        # An unknown orientation comes back as the identity.
        known = has_orientation(w)
        np.testing.assert_array_equal(r.quaternion[known], w.quaternion[known])
        np.testing.assert_array_equal(r.quaternion[~known], np.tile([0, 0, 0, 1], (sum(~known), 1)))
        np.testing.assert_allclose(r.sigma, w.sigma, rtol=1e-12)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(poses())
def test_tum_round_trip(tmp_path_factory: pytest.TempPathFactory, written: Trajectory) -> None:
    file = tmp_path_factory.mktemp("tum") / "poses.tum"
    write_tum(file, written)
    read = read_tum(file, device=written.device)
    assert read.device == written.device
    np.testing.assert_array_equal(read.time_ns, written.time_ns)
    np.testing.assert_array_equal(read.position, written.position)
    np.testing.assert_array_equal(read.quaternion, written.quaternion)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(poses())
def test_kitti_round_trip(tmp_path_factory: pytest.TempPathFactory, written: Trajectory) -> None:
    file = tmp_path_factory.mktemp("kitti") / "poses.txt"
    write_kitti(file, written)
    read = read_kitti(file, device=written.device)
    assert read.time_ns.tolist() == [10**9 * k for k in range(len(written))]
    np.testing.assert_array_equal(read.position, written.position)
    np.testing.assert_allclose(
        matrix_from_quaternion(read.quaternion),
        matrix_from_quaternion(written.quaternion),
        atol=1e-12,
    )


def test_kitti_is_the_upper_three_rows(tmp_path: Path) -> None:
    write_kitti(tmp_path / "a.txt", sample())
    assert (tmp_path / "a.txt").read_text().splitlines()[1] == (
        "1.0 0.0 0.0 0.75 0.0 1.0 0.0 1.0 0.0 0.0 1.0 0.125"
    )
    assert np.loadtxt(tmp_path / "a.txt").shape == (2, 12)


WORDS = st.one_of(
    st.sampled_from(["nan", "inf", "1_0", "0x1", "1e5", "-0.0", "1e400", "+1", ".5", "5.", "1d5"]),
    st.floats(-2, 2).map(repr),
    st.text("0123456789.eE+-_xn", max_size=6),
)
LINES = st.lists(WORDS, min_size=8, max_size=8).map(" ".join)
STAMPS = st.one_of(st.integers(0, 9999999999).map(str), st.decimals(0, 3, places=9).map(str), WORDS)


@pytest.mark.slow
@given(
    st.lists(st.tuples(STAMPS, st.one_of(st.just("0 0 0 0 0 0 1"), LINES)), max_size=4),
    st.sampled_from(["\n", "\r\n", "\n\n", " \n", "\n# c\n"]),
    st.sampled_from(["", "# head\n", "\ufeff", "\n"]),
)
def test_files_read_at_once_are_read_as_word_by_word(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[str, str]], end: str, head: str
) -> None:
    file = tmp_path_factory.mktemp("tum") / "poses.tum"
    file.write_bytes((head + "".join(f"{a} {b}{end}" for a, b in rows)).encode())
    quick = _outcome(file)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(delimited, "parse_numbers", lambda *_: None)
        patch.setattr(timestamps, "parse_digits", lambda _: None)
        assert _outcome(file) == quick


def _outcome(file: Path) -> object:
    try:
        read = read_tum(file)
    except LocatkError as error:
        return type(error), str(error), error.hint
    return read.time_ns.tolist(), read.position.tolist(), read.quaternion.tolist()


def test_stamps_beyond_the_range_are_no_stamps(tmp_path: Path) -> None:
    file = tmp_path / "a.tum"
    file.write_text("8999999999.5 0 0 0 0 0 0 1\n9999999999.5 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"'9999999999\.5' is not a time") as caught:
        read_tum(file)
    assert caught.value.where == 2


def sample(device: str = "robot") -> Trajectory:
    covariance = np.full((2, 3, 3), 0.0)
    covariance[:] = np.diag([1e-6, 4e-6, 9e-6])
    return Trajectory.from_positions(
        device,
        "floor",
        np.array([1690218696074800000, 1690218696174800001]),
        np.array([[0.5, -0.25, 0.0], [0.75, 1.0, 0.125]]),
        covariance,
    )


def test_csv_is_what_the_contract_says(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", [sample()])
    assert (tmp_path / "a.csv").read_bytes().decode() == (
        "time_s,device,x_m,y_m,z_m,qx,qy,qz,qw,"
        "sigma_x_m,sigma_y_m,sigma_z_m,sigma_heading_rad,probability\n"
        "1690218696.074800000,robot,0.5,-0.25,0.0,,,,,0.001,0.002,0.003,,\n"
        "1690218696.174800001,robot,0.75,1.0,0.125,,,,,0.001,0.002,0.003,,\n"
    )


def test_probabilities_of_poses_survive_csv(tmp_path: Path) -> None:
    """They are in the last column; a file of an earlier version has none."""
    certain = replace(sample(), probability=np.array([0.97, np.nan]))
    path = tmp_path / "a.csv"
    write_csv(path, [certain, replace(sample(), device="other")])
    cells = [line.rpartition(",")[2] for line in path.read_text().splitlines()]
    assert cells == ["probability", "0.97", "", "", ""]
    back, other = read_csv(path)
    np.testing.assert_array_equal(back.probability, certain.probability)
    assert other.probability is None
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line.rpartition(",")[0] for line in lines[:3]))
    assert [each.probability for each in read_csv(path)] == [None]


def test_tum_is_what_evo_demands(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", sample())
    assert (tmp_path / "a.tum").read_text().splitlines()[1] == (
        "1690218696.174800001 0.75 1.0 0.125 0.0 0.0 0.0 1.0"
    )
    assert np.loadtxt(tmp_path / "a.tum").shape == (2, 8)
    assert read_tum(tmp_path / "a.tum").device == "a"


def test_nothing_is_overwritten_unasked_nor_left_half_written(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("mine")
    with pytest.raises(OutputExistsError):
        write_csv(file, [sample()])
    with pytest.raises(OutputExistsError):
        write_tum(file, sample())
    assert file.read_text() == "mine"
    write_csv(file, [sample()], overwrite=True)
    assert len(read_csv(file)[0]) == 2

    backwards = Trajectory.from_positions("r", "floor", np.array([2, 1]), np.zeros((2, 3)))
    nowhere = Trajectory.from_positions("r", "floor", np.array([1, 2]), np.full((2, 3), np.nan))
    for bad in (backwards, nowhere):
        with pytest.raises(InputError):
            write_csv(tmp_path / "b.csv", [bad])
        with pytest.raises(InputError):
            write_tum(tmp_path / "b.csv", bad)
    with pytest.raises(InputError, match="two trajectories"):
        write_csv(tmp_path / "b.csv", [sample(), sample()])
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_csv_of_others_with_fewer_columns(tmp_path: Path) -> None:
    file = tmp_path / "mocap.csv"
    file.write_text(
        "time_s,device,x_m,y_m,z_m,comment\n1.5,b,1,2,3,x\n1.0,a,4,5,6,y\n2.5,b,7,8,9,z\n"
    )
    first, second = read_csv(file, frame="mocap")
    assert (first.device, first.frame, len(first)) == ("b", "mocap", 2)
    assert (second.device, len(second)) == ("a", 1)
    np.testing.assert_array_equal(first.quaternion, [[0, 0, 0, 1]] * 2)
    assert np.all(np.isnan(first.covariance))


def test_rounded_quaternions_are_normalised(tmp_path: Path) -> None:
    file = tmp_path / "a.tum"
    file.write_text("# time x y z qx qy qz qw\n\n1.0 0 0 0 0.7071 0 0 0.7071\n")
    np.testing.assert_allclose(np.linalg.norm(read_tum(file).quaternion, axis=1), 1, atol=1e-15)


HEADER = "time_s,device,x_m,y_m,z_m,qx,qy,qz,qw,sigma_x_m,sigma_y_m,sigma_z_m,sigma_heading_rad\n"
ROW = "1.0,a,0,0,0,0,0,0,1,,,,\n"


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", None, "empty"),
        (HEADER, 1, "no rows"),
        ("time_s,x_m\n1,2\n", 1, "'device', 'y_m', 'z_m'"),
        (HEADER.replace(",qw", "") + "1.0,a,0,0,0,0,0,0,,,,\n", 1, "'qw'"),
        (HEADER + ROW + "2.0,a,zero,0,0,0,0,0,1,,,,\n", 3, "'zero'"),
        (HEADER + ROW + "2.0,a,,0,0,0,0,0,1,,,,\n", 3, "empty cell"),
        (HEADER + ROW + "2.0,a,nan,0,0,0,0,0,1,,,,\n", 3, "finite"),
        (HEADER + ROW + "2.0,a,-1e30,0,0,0,0,0,1,,,,\n", 3, "-1e+09 or more"),
        (HEADER + ROW + "2.0,a,0,0,0,0,0,0,1,-1,,,\n", 3, "0 or more"),
        (HEADER + ROW + "\n2.0,a,0,0,0,0,0,0,1,,x,,\n", 4, "'x'"),
        (HEADER + ROW + "2.0,a,0,0,0,0,0,0,0.5,,,,\n", 3, "quaternion"),
        (HEADER[:-1] + ",probability\n" + ROW[:-1] + ",1.5\n", 2, "1 or less"),
        (HEADER + ROW + ROW, 3, "ascend"),
        (HEADER + ROW + "yesterday,a,0,0,0,0,0,0,1,,,,\n", 3, "'yesterday'"),
        (HEADER + ROW + "2.0,a,0\n", 3, "3 cells"),
        (HEADER + ROW + '2.0,"a,0\n', 3, "CSV"),
    ],
)
def test_bad_csv_names_the_line(tmp_path: Path, text: str, where: object, what: str) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_csv(file)
    assert (caught.value.file, caught.value.where) == (str(file), where)
    assert what in str(caught.value)
    assert caught.value.hint
    assert "\n" not in str(caught.value) + caught.value.hint


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("# nothing\n", None, "no poses"),
        ("1 0 0 0 0 0 0\n", 1, "7 words"),
        ("1 0 0 0 0 0 0 1\n2 0 0 a 0 0 0 1\n", 2, "'a'"),
        ("1 0 0 0 0 0 0 1\n2 0 0 inf 0 0 0 1\n", 2, "finite"),
        ("1 0 0 0 0 0 0 1\n2 0 0 1e30 0 0 0 1\n", 2, "1e+09 or less"),
        ("1 0 0 0 0 0 0 1\n2 0 0 1_0 0 0 0 1\n", 2, "'1_0'"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", 2, "ascend"),
        ("1 0 0 0 0 0 0 2\n", 1, "quaternion"),
        ("t 0 0 0 0 0 0 1\n", 1, "'t'"),
    ],
)
def test_bad_tum_names_the_line(tmp_path: Path, text: str, where: object, what: str) -> None:
    file = tmp_path / "bad.tum"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_tum(file)
    assert (caught.value.file, caught.value.where) == (str(file), where)
    assert what in str(caught.value)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    file = tmp_path_factory.mktemp("junk") / "junk"
    file.write_bytes(content)
    for read in (read_csv, read_tum, read_kitti):
        with pytest.raises(LocatkError):
            read(file)


def test_other_encodings_and_missing_files(tmp_path: Path) -> None:
    file = tmp_path / "latin.csv"
    file.write_bytes((HEADER + ROW).encode() + "2.0,bär".encode("latin-1"))
    with pytest.raises(FormatError, match="UTF-8") as caught:
        read_csv(file)
    assert caught.value.where == 3
    with pytest.raises(FileNotFoundError):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(FormatError, match="a folder"):
        read_csv(tmp_path)


def test_orientation_survives(tmp_path: Path) -> None:
    from locatk.core.geometry import matrix_from_quaternion, quaternion_from_matrix

    turn = rotation_exp(np.array([[0.1, 0.2, 3.0]]))
    pose = Trajectory(
        "a", "f", np.array([5]), np.zeros((1, 3)), quaternion_from_matrix(turn), np.eye(6)[None]
    )
    write_csv(tmp_path / "a.csv", [pose])
    np.testing.assert_allclose(
        matrix_from_quaternion(read_csv(tmp_path / "a.csv")[0].quaternion), turn, atol=1e-14
    )


def test_rotations_of_kitti_are_the_nearest_to_rounded_matrices(tmp_path: Path) -> None:
    """Files of KITTI have seven digits; rounded once or perturbed, no cell counts more."""
    rng = np.random.default_rng(0)
    exact = rotation_exp(rng.normal(size=(200, 3)))
    rounded = exact + rng.normal(0, 1e-3, exact.shape)
    rows = np.concatenate([rounded, np.zeros((200, 3, 1))], axis=2).reshape(-1, 12)
    path = tmp_path / "rounded.kitti"
    np.savetxt(path, rows)
    u, _, vt = np.linalg.svd(rounded)
    np.testing.assert_allclose(
        matrix_from_quaternion(read_kitti(path).quaternion), u @ vt, atol=1e-12
    )
