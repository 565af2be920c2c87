"""Tables of any layout: the same samples in many dialects, written by hand."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.formats.importers.any_table.columns import guess_columns
from locatk.formats.importers.any_table.magnetometers import read_magnetometers
from locatk.formats.tables.dialects import read_any_table

FIELD_UT = (
    np.array([[20.5, -3.25, 41.0, 21.0, -3.0, 40.5], [20.75, -3.5, 40.0, 20.0, -2.75, 41.5]] * 8)
    + np.arange(16)[:, None] * 0.25
)
TIME_S = 1_700_000_000 + 0.02 * np.arange(16)


def text_of(header: str, rows: np.ndarray, separator: str = ",", decimal: str = ".") -> str:
    lines = [separator.join(f"{cell:.10g}".replace(".", decimal) for cell in row) for row in rows]
    return "\n".join([header.replace(",", separator), *lines]) + "\n"


def rows(time: np.ndarray, scale: float = 1.0) -> np.ndarray:
    return np.column_stack([time, FIELD_UT * scale])


def relative(scale: float) -> np.ndarray:
    return np.round((TIME_S - TIME_S[0]) * scale, 6)


def read_guessed(path: Path) -> None:
    table = read_any_table(path)
    read_magnetometers(table, guess_columns(table, {}, ()))


DIALECTS = {
    "own": (text_of("t_s,b0x_ut,b0y_ut,b0z_ut,b1x_ut,b1y_ut,b1z_ut", rows(relative(1))), ()),
    "tabs": (text_of("Time (ms),Mag0_X [uT],Mag0_Y [uT],Mag0_Z [uT],Mag1_X [uT],Mag1_Y [uT],"
                     "Mag1_Z [uT]", rows(relative(1e3)), "\t"), ()),
    "semicolons": ("\ufeff# logger 3\n" + text_of("timestamp_us,Bx1 (mT),By1 (mT),Bz1 (mT),"
                   "Bx2 (mT),By2 (mT),Bz2 (mT)", rows(relative(1e6), 1e-3), ";", ","), ()),
    "sensors": (text_of("millis,sensor_1_x,sensor_1_y,sensor_1_z,sensor_2_x,sensor_2_y,sensor_2_z",
                        rows(relative(1e3))), ("ut",)),
}  # fmt: skip
"""Text, and the units that the user states."""


@pytest.mark.parametrize("name", DIALECTS)
def test_the_same_samples_in_any_dialect(name: str, tmp_path: Path) -> None:
    text, units = DIALECTS[name]
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    table = read_any_table(path)
    guess = guess_columns(table, {}, units)
    assert guess.ignored == ()
    imported, odometry = read_magnetometers(table, guess, spacing_m=0.02, units=units)
    samples = imported.samples
    np.testing.assert_allclose(samples.field_t, FIELD_UT.reshape(-1, 2, 3) * 1e-6, rtol=1e-9)
    np.testing.assert_allclose(1e-9 * np.diff(samples.time_ns), 0.02, atol=1e-6)
    np.testing.assert_allclose(samples.array.position_m[:, 1], [-0.01, 0.01])
    assert odometry is None
    assert imported.warnings == []


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_times_since_1970_need_no_unit(unit: str, tmp_path: Path) -> None:
    factor = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    start = 1_700_000_000 * factor
    lines = ["stamp,bx_ut,by_ut,bz_ut", *(f"{start + k * factor},20,{k},40" for k in range(12))]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines))
    table = read_any_table(path)
    guess = guess_columns(table, {}, ())
    assert guess.units == {"time": unit}
    imported, _ = read_magnetometers(table, guess)
    assert imported.samples.time_ns.tolist() == [
        (1_700_000_000 + k) * 1_000_000_000 for k in range(12)
    ]


def test_small_times_need_a_unit(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,bx_ut,by_ut,bz_ut\n0,1,2,3\n20,2,3,4\n")
    table = read_any_table(path)
    guess = guess_columns(table, {}, ())
    with pytest.raises(FormatError, match="the unit of column 't' is missing"):
        read_magnetometers(table, guess)
    imported, _ = read_magnetometers(table, guess, units=("ms",))
    assert np.diff(imported.samples.time_ns).tolist() == [20_000_000]


def test_the_user_decides_which_observations_are_imported(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t_s,bx_ut,by_ut,bz_ut,channel,count,front_mt,station\n0,1,2,43,3,9,7,5\n")
    table = read_any_table(path)
    guess = guess_columns(table, {}, ())
    assert guess.magnetometers
    assert guess.measurements
    assert guess.has_halls
    for key, header in (("b0x", "bx_ut"), ("count", "count"), ("front", "front_mt")):
        guess = guess_columns(table, {key: header}, ())
        found = (bool(guess.magnetometers), bool(guess.measurements), guess.has_halls)
        assert found == (key == "b0x", key == "count", key == "front")
    # Without a channel, count and station are no sweeps.
    path.write_text("t_s,bx_ut,by_ut,bz_ut,count,station\n0,1,2,43,9,5\n")
    assert guess_columns(read_any_table(path), {}, ()).ignored == ("count", "station")


def test_dates_may_have_a_column_of_their_own(tmp_path: Path) -> None:
    """A date beside times of the day is used, one beside full times is not."""
    path = tmp_path / "log.csv"
    rows = "{}23:59:59,5{sep}1;2;43\n{}00:00:00,5{sep}1;3;43\n"
    for text, ignored in (
        ("Date;Time;bx_ut;by_ut;bz_ut\n" + rows.format("2026-01-31;", "2026-02-01;", sep=";"), ()),
        (
            "Date;Time;bx_ut;by_ut;bz_ut\n"
            + rows.format("31.01.26;2026-01-31T", "1.02.26;2026-02-01T", sep="Z;"),
            ("date",),
        ),
    ):
        path.write_text(text)
        table = read_any_table(path)
        guess = guess_columns(table, {}, ())
        imported, _ = read_magnetometers(table, guess)
        assert imported.samples.time_ns.tolist() == [1769903999_500000000, 1769904000_500000000]
        assert guess.ignored == ignored
    path.write_text("time,bx_ut,by_ut,bz_ut\n12:00:00,1,2,43\n12:00:01,1,3,43\n")
    with pytest.raises(FormatError, match="times of the day without dates"):
        read_guessed(path)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("t_s,bx,by,bz\n0,1,2,3\n", "the unit of column 'bx' is missing"),
        ("t_s,bx_ut,by_ut\n0,1,2\n", "no column for b0z"),
        ("t_s,bx_ut,mag_x_ut,by_ut,bz_ut\n0,1,2,3,4\n", "2 columns may be b0x: bx_ut, mag_x_ut"),
        ("t_s,bx_ut,by_ut,bz_ut\n0,1,2,3\n0,1,2,3\n", "the time is that of the previous row"),
        ("t_s,b0x_ut,b0y_ut,b0z_ut,b1x_ut,b1y_ut,b1z_ut\n0,1,2,3,4,5,6\n", "unknown positions"),
        ("t_s;bx_ut;by_ut;bz_ut\n0;1;2\n", "3 cells in a row, but 4 in the header"),
        ("t_s,bx_ut,by_ut,bz_ut\n0,one,2,3\n", "'one' instead of a number"),
    ],
)
def test_what_is_not_clear_is_refused(text: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises((FormatError, InputError), match=problem):
        read_guessed(path)


def test_a_field_far_from_that_of_the_earth_is_remarked(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(DIALECTS["own"][0].replace("_ut", "_mt"))
    table = read_any_table(path)
    imported, _ = read_magnetometers(table, guess_columns(table, {}, ()), spacing_m=0.02)
    assert "the unit may be wrong" in imported.warnings[-1]


def test_parquet_is_read_like_text(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    names = ["b0x_uT", "b0y_uT", "b0z_uT", "b1x_uT", "b1y_uT", "b1z_uT"]
    frame = pandas.DataFrame(FIELD_UT, columns=names)
    frame.insert(0, "time", pandas.to_datetime(np.rint(TIME_S * 1e9).astype(np.int64), utc=True))
    path = tmp_path / "log.parquet"
    frame.to_parquet(path)
    table = read_any_table(path)
    imported, _ = read_magnetometers(table, guess_columns(table, {}, ()), spacing_m=0.02)
    np.testing.assert_allclose(imported.samples.field_t.reshape(-1, 6), FIELD_UT * 1e-6, rtol=1e-9)
    assert imported.samples.time_ns[0] == 1_700_000_000_000_000_000
    path.write_bytes(b"PAR1 junk")
    with pytest.raises(LocatkError):
        read_any_table(path)


# ---- on the command line


@pytest.mark.slow
def test_an_exported_drive_is_solved_again(locatk: Callable[..., Any], tmp_path: Path) -> None:
    """The samples of a session, written by hand as a table of another tool, give the same tag."""
    from locatk.formats.sessions.field_samples import read_magnetometers as read_samples
    from locatk.formats.sessions.reader import Session

    run, tag, log = tmp_path / "run.mcap", tmp_path / "tag.toml", tmp_path / "log.tsv"
    assert locatk("tag", "design", "-o", tag, "--count", "4").exit_code == 0
    assert locatk("simulate", "polaris", tag, "-o", run, "--seed", "3").exit_code == 0
    (samples,) = read_samples(Session.open(run))
    axes = [f"MAG{k + 1}_{axis}" for k in range(len(samples.array)) for axis in "XYZ"]
    lines = ["\t".join(["Zeit", *axes])]
    for time_ns, field_t in zip(samples.time_ns, samples.field_t, strict=True):
        cells = [str(time_ns // 1000), *(f"{1e6 * value:.4f}" for value in field_t.ravel())]
        lines.append("\t".join(cells))
    log.write_text("\n".join(lines))
    spacing = 1e3 * float(np.diff(samples.array.position_m[:2, 1])[0])
    result = locatk(
        *("import", "table", log, "--columns", "t=Zeit", "--units", "us,ut"),
        *("--spacing", f"{spacing:g}", "--tag", tag, "-o", tmp_path / "again.mcap"),
    )
    assert result.exit_code == 0, result.stderr
    assert '[columns]\nt = "zeit"\nb1x = "mag1_x"\n' in result.stderr
    tags = []
    for path in (run, tmp_path / "again.mcap"):
        solved = locatk("solve", path, "-o", tmp_path / f"{path.stem}-solved.mcap", "--json")
        (detection,) = json.loads(solved.stdout)["sessions"][0]["detections"]
        tags.append(detection["tag_id"])
    assert tags[0] == tags[1] is not None


@pytest.mark.slow
def test_hall_sensors_and_odometry(locatk: Callable[..., Any], tmp_path: Path) -> None:
    log = tmp_path / "robot.csv"
    header = "time_ms;odom.pose.x_m;odom.pose.y_m;odom.yaw_deg;Hall Front [mT];Hall Left [mT];"
    header += "Hall Rear [mT];Hall Right [mT];battery"
    cells = [
        f"{20 * k};{0.004 * k:.4f};0;0;{0.01 * (k % 7):.2f};0,02;{0.01 * (k % 5):.2f};0.1;7.4"
        for k in range(60)
    ]
    log.write_text("\n".join([header, *cells]))
    result = locatk("import", "table", log, "--circle", "25", "-o", tmp_path / "r.mcap", "--json")
    assert result.exit_code == 3, result.stderr  # constant sensors are excluded
    facts = json.loads(result.stdout)
    assert (facts["samples"], facts["odometry_poses"]) == (60, 60)
    assert "Not used: battery" in result.stderr


def test_tables_of_nothing_are_refused(locatk: Callable[..., Any], tmp_path: Path) -> None:
    log, output = tmp_path / "log.csv", tmp_path / "run.mcap"
    for text, status, problem in (
        (
            "a,b\n1,2\n",
            2,
            "none of sweeps of base stations, magnetometers, hall sensors and an IMU",
        ),
        ("", 1, "empty"),
        ("\x00\x01\x02", 1, ""),
    ):
        log.write_text(text)
        result = locatk("import", "table", log, "-o", output)
        assert (result.exit_code, "Traceback" in result.stderr) == (status, False), result.stderr
        assert problem in result.stderr
        assert not output.exists()
    assert locatk("import", "table", tmp_path / "none.csv", "-o", output).exit_code == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", DIALECTS)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    start=st.floats(0, 1),
    length=st.integers(0, 200),
    inserted=st.text('0123456789.,;\t\n-eEbxyz#"|', max_size=8),
)
def test_damaged_tables_are_refused_or_read(
    name: str, start: float, length: int, inserted: str, tmp_path: Path
) -> None:
    text, units = DIALECTS[name]
    at = round(start * len(text))
    path = tmp_path / "log.csv"
    path.write_text(text[:at] + inserted + text[at + length :], encoding="utf-8", newline="")
    with contextlib.suppress(LocatkError):
        table = read_any_table(path)
        guess = guess_columns(table, {}, units)
        imported, _ = read_magnetometers(table, guess, spacing_m=0.02, units=units)
        assert (np.diff(imported.samples.time_ns) > 0).all()
        assert not np.isinf(imported.samples.field_t).any()
