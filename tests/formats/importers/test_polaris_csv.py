"""Published recordings of magnetometer arrays (CSV): read as they are, or refused by line."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.core.polaris.codec import capacity
from locatk.formats.importers.polaris_csv import (
    PUBLISHED_TAGS,
    ImportedSamples,
    read_polaris,
)

NOISE = np.random.default_rng(5)
COLUMNS_OF_TWO = ("Sensor 1", "Sensor 2", "Sensor2")


def write(
    path: Path,
    values: np.ndarray,
    *,
    stamps: list[str] | None = None,
    header: list[str] | None = None,
    cells: dict[tuple[int, int], str] | None = None,
) -> Path:
    """``values`` (n, N, 3) in microtesla as the authors' tool writes them; ``cells`` replaces
    the text at (row, sensor)."""
    n, sensors, _ = values.shape
    with open(path, "w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(header or ["", "Time Stamp", *(f"Sensor {k + 1}" for k in range(sensors))])
        for row in range(n):
            texts = [str(tuple(map(float, values[row, k]))) for k in range(sensors)]
            for (at, sensor), text in (cells or {}).items():
                if at == row:
                    texts[sensor] = text
            table.writerow([row, row / 100 if stamps is None else stamps[row], *texts])
    return path


def noise(n: int = 40, sensors: int = 3) -> np.ndarray:
    return np.round(NOISE.normal(size=(n, sensors, 3)) + 30, 3)


def read(path: Path, rate: float = 40.0) -> ImportedSamples:
    return read_polaris(path, rate_hz=rate, spacing_m=0.02)


def test_two_columns_of_one_sensor_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "raw.csv", noise(), header=["", "Time Stamp", *COLUMNS_OF_TWO])
    with pytest.raises(FormatError, match="columns 'sensor 2' and 'sensor2' are of one sensor"):
        read(path)


def test_gaps_of_the_stamps_are_warned_of(tmp_path: Path) -> None:
    values = noise(40)
    for jump, expected in ((9, 0), (11, 1)):
        stamps = [str(row / 100 + (row >= 30) * jump / 100) for row in range(40)]
        warnings = read(write(tmp_path / "raw.csv", values, stamps=stamps)).warnings
        assert len(warnings) == expected
    assert "raw.csv:32: the time stamp is 10 or more usual steps" in warnings[0]


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.floats(-4000, 4000), min_size=6, max_size=6), min_size=1, max_size=9).map(
        lambda rows: np.array(rows).reshape(-1, 2, 3)
    )
)
def test_every_number_arrives(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray) -> None:
    imported = read(write(tmp_path_factory.mktemp("csv") / "run.csv", values))
    x, y, z = np.moveaxis(values, 2, 0)
    np.testing.assert_allclose(
        imported.samples.field_t, np.stack([-y, -x, -z], axis=2) * 1e-6, rtol=1e-15
    )
    assert imported.left_out == 0
    assert imported.lost is None


def test_what_a_bar_is_taken_to_be(tmp_path: Path) -> None:
    imported = read(write(tmp_path / "run.csv", noise(n=5)))
    array = imported.samples.array
    # Sensor 1 is the rightmost, y is to the left.
    np.testing.assert_allclose(array.position_m, [[0, -0.02, 0], [0, 0, 0], [0, 0.02, 0]])
    np.testing.assert_allclose(array.noise_t, [0.89e-6, 0.86e-6, 1.24e-6])
    assert imported.samples.time_ns.tolist() == [k * 25_000_000 for k in range(5)]
    assert capacity(PUBLISHED_TAGS) == 1 << 18


@pytest.mark.parametrize("name", ["default", "varying"])
def test_published_runs(data: Path, name: str) -> None:
    """Against Python's own parser, which is what the authors use."""
    folder = data / "polaris" / name
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    for path in sorted(folder.glob("RawData_*.csv"))[:3]:
        with open(path, newline="") as stream:
            rows = list(csv.reader(stream))[1:]
        expected = np.array([[eval(cell) for cell in row[2:]] for row in rows])
        imported = read(path)
        assert imported.warnings == []
        assert imported.samples.field_t.shape == (len(rows), 9, 3)
        np.testing.assert_allclose(imported.samples.field_t[..., 0], -1e-6 * expected[..., 1])
        np.testing.assert_allclose(imported.samples.field_t[..., 1], -1e-6 * expected[..., 0])
        np.testing.assert_allclose(imported.samples.field_t[..., 2], -1e-6 * expected[..., 2])


# ---- times


def test_dates_tell_when_it_began(tmp_path: Path) -> None:
    stamps = [f"2024-05-01 12:00:{k // 40:02d}.{25_000 * (k % 40):06d}" for k in range(60)]
    imported = read(write(tmp_path / "run.csv", noise(60), stamps=stamps))
    assert imported.warnings == []
    start = int(np.datetime64("2024-05-01T12:00:00", "ns").astype(np.int64))
    assert imported.samples.time_ns[[0, 1]].tolist() == [start, start + 25_000_000]
    other = read(tmp_path / "run.csv", rate=50)
    assert other.warnings == [
        "the stamps show 40 samples per second, not 50: the stated rate is used"
    ]


@pytest.mark.parametrize(
    ("start", "rate_hz", "start_ns"),
    [
        ("12.5", 100.0, 12_500_000_000),
        ("1700000000.25", 100.0, 1_700_000_000_250_000_000),
        ("12.5", 40.0, 0),  # The published stamps, which are not times.
        ("-3", 100.0, 0),
    ],
)
def test_stamps_in_seconds_begin_at_their_first_time(
    tmp_path: Path, start: str, rate_hz: float, start_ns: int
) -> None:
    stamps = [f"{float(start) + k / 100:.2f}" for k in range(60)]
    imported = read(write(tmp_path / "run.csv", noise(60), stamps=stamps), rate_hz)
    assert imported.samples.time_ns[0] == start_ns


def test_stamps_that_go_backwards_are_refused(tmp_path: Path) -> None:
    for stamps in (
        ["0.0", "0.01", "0.02", "0.005", "0.03"],
        [f"2024-05-01 12:00:0{k}" for k in (0, 1, 2, 1, 3)],
    ):
        path = write(tmp_path / "run.csv", noise(5), stamps=stamps)
        with pytest.raises(InputError, match=r"run\.csv:5: the time stamp goes backwards"):
            read(path)
    path = write(tmp_path / "run.csv", noise(3), stamps=["0.0", "soon", "0.02"])
    with pytest.raises(InputError, match=r"run\.csv:3: 'soon' instead of a number "):
        read(path)


def test_rates_that_cannot_be(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", noise())
    for rate in (0.0, -40.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="a rate of"):
            read(path, rate)
    with pytest.raises(InputError, match="no MLX90393 gives 5000 samples per second"):
        read(path, 5000.0)
    fast = read(path, 100.0)
    (warning,) = fast.warnings
    assert "at most 61 samples per second" in warning
    # A sensor that converts faster converts its axes closer together.
    delay = np.ptp(fast.samples.array.delay_s)
    assert delay < np.ptp(read(path).samples.array.delay_s)
    assert delay < 2 / 3 / 100


# ---- what is left out


def test_cells_without_numbers_are_left_out_and_named(tmp_path: Path) -> None:
    cells = {(4, 1): "", (9, 1): "(nan, nan, nan)", (7, 2): "(1.0, NaN, 2.0)"}
    imported = read(write(tmp_path / "run.csv", noise(), cells=cells))
    missing = np.argwhere(np.isnan(imported.samples.field_t)).tolist()
    # The y of the part is the x of the array.
    assert missing == [[4, 1, 0], [4, 1, 1], [4, 1, 2], [7, 2, 0], [9, 1, 0], [9, 1, 1], [9, 1, 2]]
    assert imported.lost == "7 of 360 values are excluded"
    path = tmp_path / "run.csv"
    assert imported.warnings == [
        f"{path}:6: sensor 2 has no number in 2 rows; excluded",
        f"{path}:9: sensor 3 has no number in 1 row; excluded",
    ]


def test_saturated_samples_are_left_out_and_named(tmp_path: Path) -> None:
    values = noise()
    values[3, 0, 0] = 32767 * 0.15  # the last count of 16 bits
    values[5, 0, 2] = -32768 * 0.242
    values[6, 0, 2] = 32700 * 0.242  # large, and told
    imported = read(write(tmp_path / "run.csv", values))
    assert np.argwhere(np.isnan(imported.samples.field_t)).tolist() == [[3, 0, 1], [5, 0, 2]]
    (warning,) = imported.warnings
    assert warning.startswith(
        f"{tmp_path / 'run.csv'}:5: sensor 1 has a field beyond the range of an MLX90393"
    )


def test_a_dead_sensor_is_left_out_and_named(tmp_path: Path) -> None:
    values = noise()
    values[:, 1] = 0.0
    imported = read(write(tmp_path / "run.csv", values))
    assert np.isnan(imported.samples.field_t[:, 1]).all()
    assert not np.isnan(imported.samples.field_t[:, [0, 2]]).any()
    assert imported.left_out == 120
    assert "sensor 2 has a constant value" in imported.warnings[0]
    values[:] = 0.0
    with pytest.raises(InputError, match=r"run\.csv: no usable value"):
        read(write(tmp_path / "run.csv", values))


# ---- what is refused


@pytest.mark.parametrize(
    "cell",
    [
        "3.0",
        "(1, 2)",
        "(1, 2, 3, 4)",
        "(1, 2, 3",
        "(1, two, 3)",
        "(1 2, 3, 4)",
        "(1, , 3)",
        "(1, 2, )",
        "((1, 2, 3))",
        "(1, 2, 3)|(4, 5, 6)",
        "(1, 2, 1e999)",
        "(1, 2, inf)",
        "(1.2.3, 4, 5)",
        "(1,\n2, 3)",
        "[1, 2, 3]",
        "(1_0, 2, 3)",
        "(\u0661, 2, 3)",
        "None",
        " ",
    ],
)
def test_a_cell_that_is_no_vector_is_named(tmp_path: Path, cell: str) -> None:
    path = write(tmp_path / "run.csv", noise(12), cells={(5, 1): cell})
    with pytest.raises(InputError, match="not a tuple of three numbers") as caught:
        read(path)
    # Of a cell of two lines the second is named.
    assert caught.value.where == (8 if "\n" in cell else 7)
    assert "'sensor 2'" in caught.value.message


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(st.text("0123456789.+-eEnaifNA(), |\t", max_size=24))
def test_a_cell_is_a_vector_exactly_where_python_says_so(
    tmp_path_factory: pytest.TempPathFactory, inside: str
) -> None:
    def numbers(text: str) -> list[float] | None:
        parts = text.split(",")
        try:
            found = [float(part) for part in parts]
        except ValueError:
            return None
        return found if len(found) == 3 and not np.isinf(found).any() else None

    path = tmp_path_factory.mktemp("csv") / "run.csv"
    cell = f"({inside})"
    write(path, noise(3), cells={(1, 1): cell})
    expected = numbers(inside)
    if expected is None:
        with pytest.raises(InputError):
            read(path)
        return
    field = read(path).samples.field_t[1, 1]
    x, y, z = expected
    large = np.abs([y, x, z]) > 4900
    expected_t = np.where(large, np.nan, np.array([-y, -x, -z]) * 1e-6)
    np.testing.assert_allclose(np.where(large, np.nan, field), expected_t, rtol=1e-14)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (["", "Time Stamp", "a", "b", "c"], "columns of sensors are missing"),
        (["", "Time Stamp", "Sensor 1", "Sensor 2", "Sensor 4"], "column 'Sensor 3' is missing"),
        (["", "Time Stamp", "Sensor 2", "Sensor 3", "Sensor 4"], "column 'Sensor 1' is missing"),
        (["", "Time Stamp", "Sensor 1", "Sensor 1", "Sensor 2"], "occurs twice"),
        (["", "Time Stamp", "Sensor 1", "Sensor 2"], "5 cells in a row"),
    ],
)
def test_columns_that_are_missing_are_named(tmp_path: Path, header: list[str], words: str) -> None:
    with pytest.raises(FormatError, match=words):
        read(write(tmp_path / "run.csv", noise(), header=header))


def test_empty_and_cut_recordings_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", noise())
    whole = path.read_text()
    path.write_text(whole[:-40])
    with pytest.raises(FormatError, match=r"run\.csv:4\d"):
        read(path)
    path.write_text(whole.splitlines()[0] + "\n")
    with pytest.raises(FormatError, match="a header and no rows"):
        read(path)
    path.write_text("")
    with pytest.raises(FormatError, match="empty file"):
        read(path)
    with pytest.raises(MissingDataError):
        read(tmp_path / "none.csv")


def test_other_columns_are_passed_over(tmp_path: Path) -> None:
    """MagX writes the attitude of its board too, and no index."""
    path = tmp_path / "run.csv"
    rows = [f'"(1.0, 2.{k}, 3.0)",2021-06-01 10:00:00.{k}00000,"[0.1, 0.2]"' for k in range(4)]
    path.write_text("\n".join(["Sensor 1,Time Stamp,IMU", *rows]))
    imported = read(path, rate=10.0)
    assert imported.samples.field_t.shape == (4, 1, 3)
    assert imported.warnings == []
