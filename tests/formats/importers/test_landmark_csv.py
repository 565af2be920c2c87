"""Tables of hall sensors and odometry: read as they are said to be, or refused by line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError, MissingDataError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.halls import NAMES, HallSensors
from locatk.formats.importers.landmark_csv import ImportedHalls, Volts, read_landmarks
from locatk.formats.tables.quantities import UNITS

HEADER = ("t_s", "x_mm", "y_mm", "heading_deg", *(f"{name}_mt" for name in NAMES))
KEYS = ("t", "x", "y", "heading", *NAMES)


def drive(n: int = 60) -> np.ndarray:
    """(n, 8) rows in SI: a drive along an arc, readings that change."""
    turn = np.linspace(0.2, 1.4, n)
    rng = np.random.default_rng(2)
    return np.column_stack(
        [
            0.01 * np.arange(n),
            0.3 * np.sin(turn),
            -0.3 * np.cos(turn),
            turn,
            rng.normal(size=(n, 4)) * 5e-3,
        ]
    )


def write(
    path: Path,
    rows: np.ndarray | None = None,
    header: tuple[str, ...] = HEADER,
    scale: tuple[float, ...] = (1, 1e3, 1e3, 180 / math.pi, *[1e3] * 4),
    cells: dict[tuple[int, int], str] | None = None,
) -> Path:
    """A table; ``cells`` replaces texts at (row, column)."""
    rows = drive() if rows is None else rows
    texts = [[repr(v) for v in row] for row in (rows * np.array(scale)).tolist()]
    for (row, column), text in (cells or {}).items():
        texts[row][column] = text
    path.write_text("\n".join(",".join(row) for row in [list(header), *texts]) + "\n")
    return path


def read(path: Path, **more: Any) -> ImportedHalls:
    return read_landmarks(path, **{"sensors": HallSensors(), **more})


def check(found: ImportedHalls, rows: np.ndarray) -> None:
    assert found.warnings == []
    np.testing.assert_allclose(found.samples.field_t, rows[:, 4:], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.odometry.position[:, :2], rows[:, 1:3], rtol=1e-12)
    np.testing.assert_allclose(
        heading_from_quaternion(found.odometry.quaternion), rows[:, 3], atol=1e-12
    )
    np.testing.assert_allclose(
        (found.samples.time_ns - found.samples.time_ns[0]) * 1e-9, rows[:, 0], atol=1e-9
    )


def test_units_in_the_names_are_enough(tmp_path: Path) -> None:
    found = read(write(tmp_path / "run.csv"))
    check(found, drive())
    assert found.samples.device == found.odometry.device == "robot"
    assert found.samples.time_ns[0] == found.odometry.time_ns[0] == 0
    assert found.facts["columns"].startswith("t=t_s [s], x=x_mm [mm]")
    assert found.lost is None


def test_units_in_brackets_and_columns_beside_them(tmp_path: Path) -> None:
    header = ("Time [ms]", "X (m)", "Y[cm]", "Heading [rad]", "Front", "Left", "Rear", "Right")
    path = write(tmp_path / "run.csv", None, header, (1e3, 1, 1e2, 1, *[1e4] * 4))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([f"{lines[0]},note", *(f"{line},ok" for line in lines[1:])]) + "\n")
    check(read(path, units=("gauss",)), drive())


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    time=st.sampled_from(list(UNITS["time"])),
    length=st.sampled_from(list(UNITS["length"])),
    angle=st.sampled_from(list(UNITS["angle"])),
    field=st.sampled_from(["t", "mt", "ut", "gauss"]),
    order=st.permutations(range(8)),
    in_name=st.booleans(),
)
def test_every_unit_in_every_order(
    tmp_path_factory: pytest.TempPathFactory,
    time: str,
    length: str,
    angle: str,
    field: str,
    order: list[int],
    in_name: bool,
) -> None:
    """Either the user says names and units, or the header does."""
    one = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9, "m": 1, "cm": 1e2, "mm": 1e3, "rad": 1}
    one |= {"deg": 180 / math.pi, "t": 1, "mt": 1e3, "ut": 1e6, "gauss": 1e4}
    units = (time, length, length, angle, *[field] * 4)
    keys = [
        f"{key}_{unit}" if in_name else f"col {n}"
        for n, (key, unit) in enumerate(zip(KEYS, units, strict=True))
    ]
    path = write(
        tmp_path_factory.mktemp("csv") / "run.csv",
        drive(12)[:, order],
        tuple(keys[n] for n in order),
        tuple(one[units[n]] for n in order),
    )
    if in_name:
        found = read(path)
    else:
        found = read(path, columns=dict(zip(KEYS, keys, strict=True)), units=set(units))
    check(found, drive(12))


@pytest.mark.parametrize(
    ("first", "unit", "start_ns"),
    [
        ("1700000000.123456789", "s", 1_700_000_000_123_456_789),
        ("1700000000123.5", "ms", 1_700_000_000_123_500_000),
        ("946684800", "s", 946_684_800_000_000_000),
        ("946684799", "s", 946_684_799_000_000_000),
        ("12.3456789", "s", 12_345_678_900),
        ("-3", "s", 0),
    ],
)
def test_times_of_the_file_are_kept(tmp_path: Path, first: str, unit: str, start_ns: int) -> None:
    later = str(int(float(first)) + 5000)
    rows = drive(2)
    header = (f"time_{unit}", *HEADER[1:])
    found = read(write(tmp_path / "run.csv", rows, header, cells={(0, 0): first, (1, 0): later}))
    assert found.samples.time_ns[0] == start_ns


def test_dates_and_a_given_start(tmp_path: Path) -> None:
    dates = {(n, 0): f"2026-01-31T12:00:0{n}.25Z" for n in range(3)}
    path = write(tmp_path / "run.csv", drive(3), ("time", *HEADER[1:]), cells=dates)
    first = 1_769_860_800_250_000_000
    assert read(path).samples.time_ns.tolist() == [first + 10**9 * n for n in range(3)]
    assert read(path, start_ns=7).samples.time_ns.tolist() == [7 + 10**9 * n for n in range(3)]


def test_voltages(tmp_path: Path) -> None:
    """Of sensors with zeros of their own, one of which is mounted upside-down."""
    rows = drive()
    gains, zeros = np.array([13.0, 13.0, -13.0, 12.5]), np.array([2.5, 2.48, 2.51, 2.5])
    volts = rows.copy()
    volts[:, 4:] = rows[:, 4:] * gains + zeros
    header = (*HEADER[:4], *(f"{name}_mV" for name in NAMES))
    path = write(tmp_path / "run.csv", volts, header)
    found = read(path, volts=Volts(tuple(gains), tuple(zeros)))
    check(found, rows)
    assert found.facts["zero_volts"] == "2.5, 2.48, 2.51, 2.5"
    found = read(path, volts=Volts(tuple(gains), None))
    np.testing.assert_allclose(
        found.samples.field_t, rows[:, 4:] - np.median(rows[:, 4:], axis=0), atol=1e-14
    )
    header = (*HEADER[:4], *NAMES)
    path = write(tmp_path / "same.csv", volts, header)
    found = read(path, units=("mv",), volts=Volts((10.0,), (2.5,)), downward=True)
    np.testing.assert_allclose(found.samples.field_t, (2.5 - volts[:, 4:]) / 10.0, atol=1e-14)
    with pytest.raises(InputError, match="voltages without a conversion"):
        read(path, units=("mv",))
    with pytest.raises(InputError, match="volts per tesla for readings in mt"):
        read(path, units=("mt",), volts=Volts((10.0,), (2.5,)))
    with pytest.raises(InputError, match="3 numbers of zero volts for 4 sensors"):
        read(path, units=("mv",), volts=Volts((10.0,), (2.5, 2.5, 2.5)))
    with pytest.raises(InputError, match="0 volts per tesla"):
        read(path, units=("mv",), volts=Volts((0.0,), None))


def test_odometry_may_be_slower_than_the_sensors(tmp_path: Path) -> None:
    rows = drive(40)
    gone = {(n, column): "" for n in range(40) if n % 4 for column in (1, 2, 3)}
    gone |= {(8, column): "" for column in (4, 5, 6, 7)}  # odometry alone
    found = read(write(tmp_path / "run.csv", rows, cells=gone))
    assert found.lost is None
    np.testing.assert_allclose(found.odometry.position[:, 0], rows[::4, 1])
    assert len(found.samples) == 39
    assert found.odometry.time_ns[2] not in found.samples.time_ns
    gone[(5, 2)] = "3"
    gone[(9, 3)] = "nan"
    gone[(12, 1)] = "NaN"
    found = read(write(tmp_path / "run.csv", rows, cells=gone))
    (warning,) = found.warnings
    assert "run.csv:7: odometry is incomplete in 2 rows" in warning
    assert found.left_out_poses == 2
    assert found.lost == "2 poses of odometry are excluded"
    assert len(found.odometry) == 9
    assert np.isfinite(found.odometry.position).all()


def test_odometry_that_is_held_is_no_staircase(tmp_path: Path) -> None:
    """A logger of 100 Hz, odometry of 25 Hz, and a robot that stands in the middle."""
    rows = drive(120)
    rows[40:80, 1:4] = rows[40, 1:4]
    held = rows.copy()
    held[:, 1:4] = rows[np.arange(120) // 4 * 4, 1:4]
    found = read(write(tmp_path / "run.csv", held))
    at = np.round(found.odometry.time_ns * 1e-7).astype(int)
    assert at.tolist() == [*range(0, 41, 4), 79, *range(80, 117, 4), 119]
    np.testing.assert_allclose(found.odometry.position[:, 0], held[at, 1])
    assert len(found.samples) == 120
    assert found.facts["odometry"] == "97 repeated poses are skipped"
    # Who stands, or is logged no faster than he is driven, has no stairs.
    for still in (
        rows,
        rows[40:80],
        rows[:1].repeat(30, axis=0) + [[0.01 * n] + [0] * 7 for n in range(30)],
    ):
        still[:, 4:] = drive(len(still))[:, 4:]
        found = read(write(tmp_path / "run.csv", still))
        assert len(found.odometry) == len(still)
        assert "odometry" not in found.facts


def test_missing_and_dead_readings_are_left_out(tmp_path: Path) -> None:
    rows = drive(30)
    rows[:, 6] = 1e-4
    found = read(write(tmp_path / "run.csv", rows, cells={(5, 4): "", (9, 4): "nan"}))
    assert found.left_out == 32
    assert found.lost == "32 of 120 readings are excluded"
    assert np.isnan(found.samples.field_t[:, 2]).all()
    assert np.flatnonzero(np.isnan(found.samples.field_t[:, 0])).tolist() == [5, 9]
    first, second = found.warnings
    assert "run.csv:7: front_mt has no number in 2 rows" in first
    assert "rear_mt has a constant value" in second
    rows[:, 4:] = 1e-4
    with pytest.raises(InputError, match="no usable reading"):
        read(write(tmp_path / "run.csv", rows))
    nothing = {(n, column): "" for n in range(30) for column in (4, 5, 6, 7)}
    with pytest.raises(InputError, match="no reading of any sensor"):
        read(write(tmp_path / "run.csv", cells=nothing, rows=rows))


def test_other_sensors_than_four_on_a_circle(tmp_path: Path) -> None:
    sensors = HallSensors(("A", "B"), np.array([[0.01, 0.0], [-0.01, 0.0]]))
    rows = drive()
    header = (*HEADER[:4], "a_mt", "b_mt", "c", "d")
    found = read(write(tmp_path / "run.csv", rows, header), sensors=sensors)
    np.testing.assert_allclose(found.samples.field_t, rows[:, 4:6])
    with pytest.raises(InputError, match="a sensor is called 'x'"):
        read(tmp_path / "run.csv", sensors=HallSensors(("x",), np.zeros((1, 2))))


# ---- what is wrong, and what is ambiguous


@pytest.mark.parametrize(
    ("header", "more", "words"),
    [
        (("t", *HEADER[1:]), {}, "the unit of column 't' is missing"),
        ((HEADER[0], "x", *HEADER[2:]), {"units": ("rad",)}, "the unit of column 'x' is missing"),
        (HEADER, {"units": ("m",)}, "'x_mm' is in mm by its name, but in m by --units"),
        ((*HEADER[:7], "right_v"), {}, "column 'front_mt' is in mt, but 'right_v' in v"),
        ((*HEADER[:7], "h4"), {"units": ("mt",)}, "a column for right is missing"),
        ((*HEADER[:6], "front", "right_mt"), {}, "2 columns may be front: front_mt, front"),
        (HEADER, {"columns": {"x": "odom_x"}}, "column 'odom_x' is missing"),
        (HEADER, {"columns": {"x": "y_mm"}}, "column 'y_mm' is used for both x and y"),
        (HEADER, {"columns": {"speed": "x_mm"}}, "unknown column key 'speed'"),
        (HEADER, {"units": ("inch",)}, "unknown unit 'inch'"),
        (HEADER, {"units": ("mm", "m")}, "two units of length, mm and m"),
    ],
)
def test_what_could_mean_two_things_is_refused(
    tmp_path: Path, header: tuple[str, ...], more: dict[str, Any], words: str
) -> None:
    path = write(tmp_path / "run.csv", header=header)
    with pytest.raises((FormatError, InputError), match=words) as caught:
        read(path, **more)
    assert caught.value.hint


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({(3, 0): "0.01"}, r"run\.csv:5: the time goes backwards"),
        ({(3, 0): "0.02"}, r"run\.csv:5: the time is that of the previous row"),
        ({(3, 0): ""}, r"run\.csv:5: empty cell in column 't_s'"),
        ({(3, 0): "1e300"}, r"run\.csv:5: 1e300 in column 't_s' should be"),
        ({(3, 1): "far"}, r"run\.csv:5: 'far' instead of a number in column 'x_mm'"),
        ({(3, 5): "inf"}, r"run\.csv:5: inf in column 'left_mt' should be a finite"),
        ({(3, 1): "1_000"}, r"run\.csv:5: '1_000' instead of a number in column 'x_mm'"),
        ({(3, 0): "\u0663"}, r"run\.csv:5: .* instead of a number in column 't_s'"),
        ({(3, 5): "1e30"}, r"run\.csv:5: a field beyond 10 T"),
        ({(3, 5): "1e300"}, r"run\.csv:5: a field beyond 10 T"),
        ({(n, c): "" for n in range(60) for c in (1, 2, 3)}, "no odometry: 0 of 60 rows"),
        ({(n, c): "" for n in range(1, 60) for c in (1, 2, 3)}, "no odometry: 1 of 60 rows"),
    ],
)
def test_bad_cells_are_named(tmp_path: Path, cells: dict[tuple[int, int], str], words: str) -> None:
    path = write(tmp_path / "run.csv", cells=cells)
    with pytest.raises(InputError, match=words):
        read(path)


def test_a_single_row_of_zeros_is_too_short_a_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 of 1 rows have x, y and heading, not two"):
        read(write(tmp_path / "run.csv", np.zeros((1, 8))))


def test_a_jump_of_the_clock_is_warned_of(tmp_path: Path) -> None:
    rows = drive(60)
    rows[:, 0] *= 100  # 1 s between rows is no jump
    assert read(write(tmp_path / "run.csv", rows)).warnings == []
    rows[59, 0] = 1e9
    (warning,) = read(write(tmp_path / "run.csv", rows)).warnings
    assert "run.csv:61: 1e+09 s after the previous row" in warning


def test_volts_beyond_any_field_are_refused(tmp_path: Path) -> None:
    rows = drive()
    rows[:, 4:] = 2.5 + rows[:, 4:]
    path = write(tmp_path / "run.csv", rows, (*HEADER[:4], *NAMES), cells={(3, 5): "2.5e9"})
    with pytest.raises(InputError, match=r"run\.csv:5: a field beyond 10 T"):
        read(path, units=("mv",), volts=Volts((13.0,), (2.5,)))


def test_files_that_are_no_table(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        read(tmp_path / "none.csv")
    for content in ("", "t,x\n", "\x00\x01"):
        (tmp_path / "run.csv").write_text(content)
        with pytest.raises(FormatError):
            read(tmp_path / "run.csv")


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=120), st.integers(0, 400))
def test_noise_in_a_file_is_an_error_or_data(
    tmp_path_factory: pytest.TempPathFactory, noise: bytes, at: int
) -> None:
    path = write(tmp_path_factory.mktemp("csv") / "run.csv", drive(6))
    data = path.read_bytes()
    path.write_bytes(data[:at] + noise + data[at:])
    try:
        found = read(path)
    except LocatkError:
        return
    assert np.isfinite(found.odometry.position).all()
    assert (np.diff(found.samples.time_ns) > 0).all()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda rows: rows * [1, 1, 1, 180 / math.pi, 1, 1, 1, 1],
            "not move along its heading",
        ),
        (lambda rows: rows * [1, 1, 1, -1, 1, 1, 1, 1], "not move along its heading"),
        (lambda rows: rows[:, [0, 2, 1, 3, 4, 5, 6, 7]], "not move along its heading"),
        (lambda rows: rows * [1, 1e3, 1e3, 1, 1, 1, 1, 1], "m/s: check the units"),
    ],
    ids=["degrees", "clockwise", "exchanged", "millimetres"],
)
def test_doubtful_odometry_is_said(tmp_path: Path, spoil: Any, words: str) -> None:
    (warning,) = read(write(tmp_path / "run.csv", spoil(drive(200)))).warnings
    assert words in warning


def test_reversing_and_turning_on_the_spot_are_no_doubt(tmp_path: Path) -> None:
    rows = drive(200)
    rows[:, 3] += math.pi
    assert read(write(tmp_path / "run.csv", rows)).warnings == []
    rows[:, 1:3] = 0.5
    assert read(write(tmp_path / "run.csv", rows)).warnings == []
