"""Sweeps of base stations in tables of any layout: the same sweeps in each form."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError, LocatkError
from locatk.core.lighthouse.channels import PERIOD_TICKS
from locatk.core.lighthouse.recording import Sweeps
from locatk.formats.importers.any_table.columns import guess_columns
from locatk.formats.importers.any_table.sweeps import read_sweeps
from locatk.formats.sessions import observations
from locatk.formats.sessions.inertial import read_imu
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_trajectories
from locatk.formats.tables.clocks import parse_clock
from locatk.formats.tables.dialects import read_any_table

START_NS = 1_700_000_000_000_000_000


def import_text(path: Path, text: str, units: tuple[str, ...] = (), **columns: str) -> Sweeps:
    path.write_text(text, encoding="utf-8")
    table = read_any_table(path)
    return read_sweeps(table, guess_columns(table, columns, units), device="d", units=units).sweeps


# ---- any form gives the same sweeps

SWEEP = st.tuples(
    st.integers(1, 16), st.integers(0, 3), st.integers(0, 1), st.floats(1e-4, 0.999), st.booleans()
)
"""Channel, photodiode, plane, fraction of a rotation, and device."""

TURNS = {
    "count": lambda turn, period, plane: turn * period / 8,
    "lfsr_count": lambda turn, period, plane: turn * period / 8,
    "offset_48mhz": lambda turn, period, plane: turn * period,
    "offset [24MHz]": lambda turn, period, plane: turn * period / 2,
    "offset (us)": lambda turn, period, plane: turn * period / 48,
    "alpha_rad": lambda turn, period, plane: 2 * np.pi * turn,
    "alpha (\u00b0)": lambda turn, period, plane: 360 * turn,
    "angle_deg": lambda turn, period, plane: 360 * turn - (120, 240)[plane],
    "angle [rad]": lambda turn, period, plane: 2 * np.pi * (turn - (1 / 3, 2 / 3)[plane]),
}
"""Measurements by header, of a fraction of a rotation of some ticks of 48 MHz. The first plane
points straight ahead after 120 degrees, the second after 240."""


@pytest.mark.parametrize("header", TURNS)
@settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(
    sweeps=st.lists(SWEEP, min_size=1, max_size=12),
    station=st.sampled_from(["channel", "station", "Base Station", "polynomial"]),
    time=st.sampled_from([("timestamp [us]", 1000), ("t_ns", 1), ("Time (ms)", 10**6)]),
    dialect=st.sampled_from([(",", "."), (";", ","), ("\t", "."), ("|", ".")]),
    order=st.permutations(range(6)),
)
def test_the_same_sweeps_in_any_form(
    header: str,
    sweeps: list[tuple[int, int, int, float, bool]],
    station: str,
    time: tuple[str, int],
    dialect: tuple[str, str],
    order: list[int],
    tmp_path: Path,
) -> None:
    period = PERIOD_TICKS[[channel - 1 for channel, *_ in sweeps]]
    if station == "Base Station":  # a number is only known to count from 0 if one is 0
        sweeps = [(1, 0, 0, 0.5, False), *sweeps]
        period = PERIOD_TICKS[[channel - 1 for channel, *_ in sweeps]]
    lines = []
    times = START_NS + 5_000_000 * np.arange(len(sweeps))
    for k, (channel, sensor, plane, turn, is_second) in enumerate(sweeps):
        number = {"channel": channel, "polynomial": 2 * channel - 1}.get(station, channel - 1)
        value = TURNS[header](turn, int(period[k]), plane)
        cells = [f"{times[k] // time[1]}", f"{number}", f"{sensor}", f"{plane}", repr(float(value))]
        cells.append("wand" if is_second else "tag")
        lines.append([cell.replace(".", dialect[1]) for cell in cells])
    names = [time[0], station, "Sensor", "plane", header, "device"]
    rows = [[cells[k] for k in order] for cells in (names, *lines)]
    text = "\n".join(dialect[0].join(row) for row in rows)
    named = {"station": "station"} if station == "station" else {}
    read = import_text(tmp_path / "log.csv", text, **named)
    expected = np.array([(c, s, p) for c, s, p, *_ in sweeps])
    np.testing.assert_array_equal(np.stack([read.channel, read.sensor, read.sweep], 1), expected)
    np.testing.assert_array_equal(read.time_ns, times)
    turns = np.array([turn for *_, turn, _ in sweeps])
    np.testing.assert_allclose(read.count, turns * period / 8, rtol=0, atol=1e-6)
    devices = [read.devices[number] for number in read.device]
    assert devices == ["wand" if second else "tag" for *_, second in sweeps]
    if station == "polynomial":
        np.testing.assert_array_equal(read.polynomial, 2 * expected[:, 0] - 1)


def test_a_row_may_have_several_sweeps(tmp_path: Path) -> None:
    wide = "t_us,count0_ch4_s1,count1_ch4_s1,count0_ch16_s0\n0,100,200,\n20000,101,,7\n"
    long = (
        "t_us,sensor,channel,plane,count\n0,1,4,0,100\n0,1,4,1,200\n20000,1,4,0,101\n"
        "20000,0,16,0,7\n"
    )
    pairs = "t_us,s,mode,count0,count1\n0,1,4,100,200\n20000,1,4,101,\n20000,0,16,7,\n"
    read = [import_text(tmp_path / "a.csv", text) for text in (wide, long)]
    read.append(import_text(tmp_path / "a.csv", pairs, sensor="s"))
    for sweeps in read:
        assert sweeps.channel.tolist() == [4, 4, 4, 16]
        assert sweeps.sensor.tolist() == [1, 1, 1, 0]
        assert sweeps.sweep.tolist() == [0, 1, 0, 0]
        assert sweeps.count.tolist() == [100, 200, 101, 7]
        assert sweeps.time_ns.tolist() == [0, 0, 20_000_000, 20_000_000]


def test_the_unit_of_the_times_is_not_that_of_offsets(tmp_path: Path) -> None:
    text = "t,channel,offset_us\n0,1,10\n"
    (count,) = import_text(tmp_path / "a.csv", text, units=("ms",)).count
    assert count == pytest.approx(60)
    with pytest.raises(InputError, match="the unit of column 'offset' is missing"):
        import_text(tmp_path / "a.csv", text.replace("_us", ""), units=("ms",))


def test_sensor_and_plane_may_be_unknown(tmp_path: Path) -> None:
    sweeps = import_text(tmp_path / "a.csv", "t_s;mode;count\n0;1;100,5\n1;1;200,25\n")
    assert sweeps.count.tolist() == [100.5, 200.25]
    assert (sweeps.sweep.tolist(), sweeps.sensor.tolist()) == ([-1, -1], [0, 0])
    sweeps = import_text(tmp_path / "a.csv", "t_s,mode,plane,count\n0,1,,100\n1,1,-1,200\n")
    assert sweeps.sweep.tolist() == [-1, -1]


def test_counts_of_published_slots_are_not_taken_for_planes(tmp_path: Path) -> None:
    """Of count_1 and count_2, count_1 is not the second plane."""
    with pytest.raises(LocatkError):
        import_text(tmp_path / "a.csv", "t_s,mode,count_1,count_2\n0,1,100,200\n")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("t_s,bs,count\n0,1,9\n", "column 'bs' may count base stations from 0 or from 1"),
        ("t_s,channel,angle_deg\n0,1,9\n", "only if its plane is known"),
        ("t_s,channel,plane,angle\n0,1,0,9\n", "the unit of column 'angle' is missing"),
        ("t_ms,channel,offset\n0,1,9\n", "the unit of column 'offset' is missing"),
        ("t_s,channel,count\n0,1,9\n1,0,9\n", r"a\.csv:3: 0 in column 'channel' should be a whole"),
        ("t_s,channel,count\n0,1,9\n1,1.5,9\n", r"a\.csv:3: 1\.5 in column 'channel'"),
        ("t_s,channel,count\n0,1,9\n1,,9\n", r"a\.csv:3: column 'channel' should have a whole"),
        ("t_s,channel,plane,count\n0,1,2,9\n", r"a\.csv:2: 2 in column 'plane'"),
        ("t_s,channel,plane,angle_deg\n0,1,,9\n", r"a\.csv:2: column 'plane' should have"),
        ("t_s,channel,count\n0,1,131072\n", r"a\.csv:2: 131072 in column 'count' is not within"),
        ("t_s,channel,count\n0,1,-1\n", r"a\.csv:2: -1 in column 'count' is not within"),
        ("t_s,channel,alpha_deg\n0,1,361\n", r"a\.csv:2: 361 in column 'alpha_deg' is not within"),
        ("t_s,channel,plane,angle_deg\n0,1,0,250\n", r"a\.csv:2: 250 in column"),
        ("t_s,channel,polynomial,count\n0,1,2,9\n", "polynomial 2 is not of channel 1"),
        ("t_s,channel,count,count0_ch4\n0,1,9,9\n", "its channel is in its key and in column"),
        ("t_s,count_ch17\n0,9\n", "there is no channel 17"),
        ("t_s,channel,count\n0,1,\n", "no sweep"),
        ("t_s,channel,count\n0,1,1\n1,1,2\n0.9,1,3\n", r"a\.csv:4: the time goes backwards"),
        ("t_s,device,channel,count\n0,,1,1\n", r"a\.csv:2: '' is not the name of a device"),
        ("t_s,channel,station,count\n0,1,0,1\n", "both number the base stations"),
    ],
)
def test_what_is_not_clear_is_refused(text: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=problem) as error:
        import_text(tmp_path / "a.csv", text)
    assert error.value.hint


def test_photodiodes_may_be_reported_in_any_order(tmp_path: Path) -> None:
    """Rows are late by less than a rotation, each device has a clock of its own."""
    text = "t_us,device,channel,count\n9000,a,1,1\n0,a,1,2\n500000,a,1,3\n100,b,1,4\n490000,a,1,5\n"
    sweeps = import_text(tmp_path / "a.csv", text)
    assert sweeps.count.tolist() == [2, 4, 1, 5, 3]


def test_a_counter_of_each_device_wraps_on_its_own(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    size = 1 << 24
    rows = [
        (f"{(start + 48_000 * k) % size},{device},1,{k}")
        for k in range(1000)
        for device, start in (("a", 0), ("b", 9_000_000))
    ]
    path.write_text("\n".join(["ticks,device,channel,count", *rows]))
    table = read_any_table(path)
    clock = parse_clock("24 MHz, 24 bit")
    guess = guess_columns(table, {"t": "ticks"}, (), clock=clock)
    sweeps = read_sweeps(table, guess, device="d", clock=clock).sweeps
    for device in (0, 1):
        own = sweeps.time_ns[sweeps.device == device]
        np.testing.assert_array_equal(np.diff(own), 2_000_000)


@pytest.mark.slow
@settings(
    max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(
    start=st.floats(0, 1),
    length=st.integers(0, 60),
    inserted=st.text('0123456789.,;\t\n-eE_chs#"|', max_size=8),
)
def test_damaged_tables_are_refused_or_read(
    start: float, length: int, inserted: str, tmp_path: Path
) -> None:
    text = "t_us,sensor,channel,plane,count0_ch4,alpha_deg,ax,ay,az\n" + "".join(
        f"{1000 * k},{k % 4},{1 + k % 3},{k % 2},{100 * k},{3 * k},0,0,9.8\n" for k in range(20)
    )
    text = text.replace("count0_ch4", "count")
    at = round(start * len(text))
    with contextlib.suppress(LocatkError):
        sweeps = import_text(tmp_path / "a.csv", text[:at] + inserted + text[at + length :])
        assert np.isfinite(sweeps.count).all()
        assert (np.diff(sweeps.time_ns) >= 0).all()


# ---- recordings


def test_a_published_recording_is_read_as_by_its_own_importer(
    locatk: Callable[..., Any], data: Path, tmp_path: Path
) -> None:
    source = data / "lighthouse" / "twoLH-2D_scene" / "dataset" / "lighthouse" / "data.csv"
    columns = "t=timestamp,device=source,count0_ch1=LHA_count_1,count1_ch1=LHA_count_2"
    columns += ",count0_ch2=LHB_count_1,count1_ch2=LHB_count_2"
    table, own = tmp_path / "table.mcap", tmp_path / "own.mcap"
    result = locatk("import", "table", source, "--columns", columns, "-o", table)
    assert result.exit_code == 0, result.stderr
    assert locatk("import", "dotbot-lh2", source, "-o", own).exit_code == 0
    read, expected = (observations.read_sweeps(Session.open(path)) for path in (table, own))
    assert len(read) == len(expected) == 18504
    for name in ("devices", "time_ns", "device", "sensor", "channel", "count"):
        np.testing.assert_array_equal(getattr(read, name), getattr(expected, name))


@pytest.mark.slow
def test_an_exported_flight_is_solved_again(locatk: Callable[..., Any], tmp_path: Path) -> None:
    """Sweeps and IMU of a session, written as the table of another tool, give the same poses."""
    run, log = tmp_path / "run.mcap", tmp_path / "log.tsv"
    simulate = ("simulate", "lighthouse", "--flight", "--receiver", "deck", "--duration", "3")
    assert locatk(*simulate, "--seed", "2", "-o", run).exit_code == 0
    session = Session.open(run)
    sweeps, (imu,) = observations.read_sweeps(session), read_imu(session)
    rows = [
        (t, f"{t % 2**32}\t{c - 1}\t{s}\t{p}\t{4 * n!r}\t\t\t\t\t\t")
        for t, c, s, p, n in zip(
            (sweeps.time_ns // 1000).tolist(),
            sweeps.channel.tolist(),
            sweeps.sensor.tolist(),
            ["" if plane < 0 else plane for plane in sweeps.sweep.tolist()],
            sweeps.count.tolist(),
            strict=True,
        )
    ]
    for t, a, w in zip(
        (imu.time_ns // 1000).tolist(),
        imu.acceleration.tolist(),
        imu.angular_rate.tolist(),
        strict=True,
    ):
        force = "\t".join(repr(value / 9.80665) for value in a)
        rate = "\t".join(repr(float(np.rad2deg(value))) for value in w)
        rows.append((t, f"{t % 2**32}\t\t\t\t\t{force}\t{rate}"))
    header = ["micros", "station", "diode", "plane", "offset", *(f"acc_{a} [g]" for a in "xyz")]
    header += [f"gyro_{axis} [dps]" for axis in "xyz"]
    lines = [text for _, text in sorted(rows, key=lambda row: row[0])]
    log.write_text("\n".join(["\t".join(header), *lines]))
    again = tmp_path / "again.mcap"
    result = locatk(
        *("import", "table", log, "--clock", "us, 32 bit", "--units", "24mhz"),
        *("--columns", "t=micros", "--receiver", "deck", "--start", "2026-01-01T00:00:00Z"),
        *("-o", again),
    )
    assert result.exit_code == 0, result.stderr
    (imported,) = read_imu(Session.open(again))
    np.testing.assert_allclose(imported.acceleration, imu.acceleration, atol=1e-12)
    np.testing.assert_allclose(imported.angular_rate, imu.angular_rate, atol=1e-12)
    # A table has no markers: the same observations without them.
    plain = tmp_path / "plain.mcap"
    receivers = observations.read_receivers(session)
    observations.write_session(
        plain, system="lighthouse", sweeps=sweeps, imu=[imu], receivers=receivers
    )
    solved = []
    for path in (plain, again):
        output = tmp_path / f"{path.stem}-solved.mcap"
        assert locatk("solve", path, "-o", output).exit_code == 0
        solved += read_trajectories(output)
    first, second = solved
    assert len(first) == len(second) > 50
    # Times were rounded to microseconds, and the first row is at --start.
    assert np.ptp(first.time_ns - second.time_ns) < 2000
    np.testing.assert_allclose(first.position, second.position, atol=1e-4)
    np.testing.assert_allclose(first.quaternion, second.quaternion, atol=1e-3)
