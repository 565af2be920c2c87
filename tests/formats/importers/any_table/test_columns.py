"""Columns of tables by their usual names, and units of times that need not be stated."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.core.errors import FormatError, InputError
from locatk.formats.importers.any_table.columns import ColumnGuess, guess_columns, read_row_times
from locatk.formats.tables.dialects import read_any_table

FIELD = {"bx_ut": "20", "by_ut": "3", "bz_ut": "40"}


def guess_of(path: Path, text: str, halls: tuple[str, ...] | None = None) -> ColumnGuess:
    path.write_text(text, encoding="utf-8")
    table = read_any_table(path)
    return (
        guess_columns(table, {}, ()) if halls is None else guess_columns(table, {}, (), halls=halls)
    )


def times_text(times: list[int], name: str = "t") -> str:
    rows = [",".join([str(time), *FIELD.values()]) for time in times]
    return "\n".join([",".join([name, *FIELD]), *rows, ""])


# ---- units of times


@pytest.mark.parametrize(
    ("first", "step"),
    [
        (150_000_000, 10_000),  # us since power-on, as s in 1974
        (1_500_000_000, 20_000),  # us since power-on, as s in 2017
        (1_500_000_000, 20_000_000),  # ns since power-on, as s in 2017
        (1_500_000_000_000, 5_000_000),  # ns since power-on, as ms in 2017
        (1_262_303_999, 1),
        (4_102_444_800, 1),
        (1_700_000_000, 11),
        (1_700_000_000_000_000_000, 512),
    ],
)
def test_a_counter_is_not_taken_for_a_date(first: int, step: int, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    guess = guess_of(path, times_text([first + step * k for k in range(9)]))
    assert guess.units == {}
    with pytest.raises(FormatError, match="the unit of column 't' is missing"):
        read_row_times(read_any_table(path), guess, (), None)


def test_a_single_row_has_no_spacing(tmp_path: Path) -> None:
    assert guess_of(tmp_path / "log.csv", times_text([1_700_000_000])).units == {}


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (1_262_304_000, 10, "s"),
        (4_102_444_799, 1, "s"),
        (1_700_000_000_000, 10_000, "ms"),
        (1_700_000_000_000_000, 1, "us"),
        (1_700_000_000_000_000_000, 2048, "ns"),
    ],
)
def test_dates_from_2010_to_2100_need_no_unit(
    first: int, step: int, unit: str, tmp_path: Path
) -> None:
    times = [first + step * k for k in range(9)]
    times[8] += 1000 * step  # a pause does not change the median
    guess = guess_of(tmp_path / "log.csv", times_text(times))
    assert guess.units == {"time": unit}


def test_equal_times_of_sweeps_do_not_count_as_spacing(tmp_path: Path) -> None:
    rows = [f"{1_700_000_000_000 + 20 * (k // 4)},4,{k}" for k in range(16)]
    guess = guess_of(tmp_path / "log.csv", "\n".join(["t,channel,count", *rows]))
    assert guess.units == {"time": "ms"}


def test_a_bad_time_below_a_date_is_reported_by_its_line(tmp_path: Path) -> None:
    text = times_text([1_700_000_000, 1_700_000_001]).replace("1700000001", "soon")
    with pytest.raises(InputError, match=r"log\.csv:3: 'soon' instead of a number"):
        guess_of(tmp_path / "log.csv", text)


@pytest.mark.parametrize(
    ("name", "unit"),
    [("millis", "ms"), ("millis()", "ms"), ("Micros()", "us"), (" micros ", "us")],
)
def test_counters_of_an_arduino_have_the_unit_of_their_name(
    name: str, unit: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    guess = guess_of(path, times_text([0, 20, 40], name))
    assert guess.units == {"time": unit}
    time_ns, _ = read_row_times(read_any_table(path), guess, (), None)
    assert time_ns.tolist() == [20 * k * {"ms": 10**6, "us": 10**3}[unit] for k in range(3)]


# ---- names


def test_a_quaternion_is_not_a_position(tmp_path: Path) -> None:
    """The columns are those of a ROS message nav_msgs/Odometry, with a heading."""
    position = [f"pose.pose.position.{axis}" for axis in "xyz"]
    orientation = [f"pose.pose.orientation.{axis}" for axis in "xyzw"]
    header = ["t_s", *FIELD, *position, *orientation, "pose.pose.orientation.yaw"]
    guess = guess_of(tmp_path / "log.csv", f"{','.join(header)}\n{','.join('0' * len(header))}\n")
    assert guess.headers["x"] == position[0]
    assert guess.headers["y"] == position[1]
    assert guess.headers["heading"] == "pose.pose.orientation.yaw"
    assert guess.ignored == (position[2], *orientation)


@pytest.mark.parametrize("name", ["yaw", "heading", "theta", "phi", "psi"])
def test_an_orientation_may_be_before_a_heading(name: str, tmp_path: Path) -> None:
    header = ["t_s", *FIELD, f"odom.orientation.{name}_rad"]
    guess = guess_of(tmp_path / "log.csv", f"{','.join(header)}\n0,1,2,3,4\n")
    assert guess.headers["heading"] == header[-1]


@pytest.mark.parametrize(
    ("halls", "header", "ignored"),
    [
        (("a", "b"), {"a": "a_mt", "b": "b_mt"}, ("front",)),
        (("a", "b"), {"a": "hall_a [mt]", "b": "b_hall (mt)"}, ("front",)),
        (("Bow 1", "bow.2"), {"Bow 1": "bow_1_mt", "bow.2": "hall bow 2"}, ("front",)),
        (("hall_t", "h+"), {"hall_t": "hall_t", "h+": "h+"}, ("front",)),
        (("front",), {"front": "front"}, ("left", "a")),
    ],
)
def test_hall_sensors_have_the_names_of_their_file(
    halls: tuple[str, ...], header: dict[str, str], ignored: tuple[str, ...], tmp_path: Path
) -> None:
    names = ["t_s", *header.values(), *ignored]
    text = f"{','.join(names)}\n{','.join('0' * len(names))}\n"
    guess = guess_of(tmp_path / "log.csv", text, halls)
    assert guess.headers == {"t": "t_s", **header}
    assert guess.ignored == ignored
    assert guess.has_halls
