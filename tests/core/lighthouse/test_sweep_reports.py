"""Factory data of stations from the polynomials of recorded sweeps."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from locatk.core.lighthouse.demodulation import ootx, sweep_reports
from locatk.core.lighthouse.demodulation.sweep_reports import report_stations
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.simulation.session import SimulationOptions, simulate
from locatk.formats.artifacts.scene import read_scene
from locatk.formats.sessions.observations import read_station_reports, read_sweeps, write_session
from locatk.formats.sessions.reader import Session

PERIODS = {1: 959_000 / 48e6, 2: 957_000 / 48e6, 16: 887_000 / 48e6}


def payload(channel: int, serial: int) -> bytes:
    head = struct.pack(
        "<HI4eBB2ebbb", 64, serial, 0, -0.005, -0.05, 0.046, 0, 9, 0.1, 0.2, 2, 127, 3
    )
    return head + struct.pack(
        "<4eBB4eH", 1, 2, -0.005, -0.004, 0x80 | channel - 1, 0, 0, 0, 0, 0, 7
    )


def sweeps_of(
    channels: dict[int, int], rotations: int, seed: int = 0, jitter_s: float = 0.0
) -> Sweeps:
    """Both sweeps of each rotation over two photodiodes, of stations with these serial numbers."""
    rng = np.random.default_rng(seed)
    rows = []
    for channel, serial in channels.items():
        period = PERIODS[channel] * (1 + 20e-6)
        bits = np.resize(ootx.encode_frame(payload(channel, serial)), rotations + 500)[500:]
        for count in (40_000.0, 40_100.0, 80_000.0, 80_100.0):
            time_s = (
                np.arange(rotations) * period + count / 6e6 + rng.normal(0, jitter_s, rotations)
            )
            columns = (time_s, np.full(rotations, count % 1000 > 0), 2 * channel - 2 + bits)
            rows.append(
                np.stack([*columns, np.full(rotations, channel), np.full(rotations, count)])
            )
    time_s, sensor, polynomial, channel, count = np.concatenate(rows, axis=1)
    order = np.argsort(time_s, kind="stable")
    return Sweeps(
        ("deck",),
        1_700_000_000_000_000_000 + np.rint(time_s[order] * 1e9).astype(np.int64),
        np.zeros(len(order), np.int32),
        sensor[order].astype(np.int32),
        channel[order].astype(np.int32),
        polynomial[order].astype(np.int32),
        np.full(len(order), -1, np.int32),
        count[order],
    )


def test_stations_send_their_factory_data() -> None:
    reports, warnings = report_stations(sweeps_of({1: 0xABC, 16: 0xDEF}, 1000))
    assert [(each.channel, each.id) for each in reports] == [(1, 0xABC), (16, 0xDEF)]
    for each in reports:
        assert each.calibration is not None
        assert each.calibration.source == "factory"
        np.testing.assert_allclose(each.calibration.sweeps[:, 1], [-0.05, 0.046], atol=1e-4)
        assert (each.sweeps, each.frames, each.damaged) == (4000, 1, 0)
        assert each.acceleration == (2, 127, 3)
    assert warnings == ()


def test_times_may_be_wrong_by_milliseconds_and_sweeps_missing() -> None:
    sweeps = sweeps_of({2: 77}, 3000, jitter_s=0.002)
    kept = np.random.default_rng(3).random(len(sweeps)) < 0.4
    kept &= (np.arange(len(sweeps)) < 5000) | (np.arange(len(sweeps)) > 5400)
    reports, _ = report_stations(sweeps.take(kept))
    assert [(each.channel, each.id) for each in reports] == [(2, 77)]
    assert reports[0].frames >= 4


def test_a_recording_shorter_than_a_frame_has_none() -> None:
    assert report_stations(sweeps_of({1: 1}, 400)) == ((), ())


def test_devices_that_report_few_rotations_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gateway reports one rotation of five: no frame can be found, and none is searched."""
    sweeps = sweeps_of({1: 1}, 5000)
    rotation = np.rint((sweeps.time_ns - sweeps.time_ns[0]) * 1e-9 / PERIODS[1]).astype(int)
    few = sweeps.take(rotation % 5 == 0)
    assert ootx.decode_frames(np.where(np.arange(5000) % 5, -1, 1)) == []
    monkeypatch.setattr(sweep_reports, "decode_frames", pytest.fail)
    assert report_stations(few) == ((), ())


def test_slow_bits_of_chance_are_no_factory_data() -> None:
    sweeps = sweeps_of({1: 1, 2: 2}, 5000)
    random = np.random.default_rng(0).integers(0, 2, len(sweeps)).astype(np.int32)
    chance = replace(sweeps, polynomial=2 * (sweeps.channel - 1) + random)
    assert report_stations(chance) == ((), ())


def test_polynomials_that_are_unknown_or_of_another_channel_are_not_used() -> None:
    sweeps = sweeps_of({1: 1}, 1000)
    for polynomial in (np.full(len(sweeps), -1, np.int32), sweeps.polynomial + 2):
        assert report_stations(replace(sweeps, polynomial=polynomial)) == ((), ())


def test_the_device_that_received_a_whole_frame_is_used() -> None:
    """The first one has more sweeps, but wrong bits; the clocks of both are seconds apart."""
    whole, broken = sweeps_of({1: 5}, 900), sweeps_of({1: 5}, 4000)
    random = np.random.default_rng(0).integers(0, 2, len(broken)).astype(np.int32)
    broken = replace(broken, time_ns=broken.time_ns + 3_456_789_012, polynomial=random)
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in (broken, whole)])
        for name in ("time_ns", "sensor", "channel", "polynomial", "sweep", "count")
    }
    device = np.repeat(np.arange(2, dtype=np.int32), [len(broken), len(whole)])
    reports, _ = report_stations(Sweeps(("a", "b"), device=device, **columns))
    assert [(each.channel, each.id, each.frames) for each in reports] == [(1, 5, 1)]


def test_factory_data_of_another_channel_are_reported() -> None:
    sweeps = sweeps_of({1: 9}, 1000)
    bits = np.resize(ootx.encode_frame(payload(3, 9)), 1500)[500:]
    rotation = np.floor((sweeps.time_ns - sweeps.time_ns[0]) * 1e-9 / PERIODS[1] + 0.1).astype(int)
    reports, (warning,) = report_stations(
        replace(sweeps, polynomial=bits[rotation].astype(np.int32))
    )
    assert warning.code == "channel_mismatch"
    assert [each.channel for each in reports] == [1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "channels"),
    [
        (("libsurvive", "libsurvive/tracker-cal-attempt.rec.gz"), [1, 4, 8, 12]),
        (("saleae", "benchmarks/demodulation_code/logic_analyser_capture.sal"), [1, 2]),
    ],
)
def test_real_stations_as_decoded_from_syncs_and_light(
    data: Path,
    tmp_path: Path,
    locatk: Callable[..., Result],
    words: tuple[str, str],
    channels: list[int],
) -> None:
    """The importers decode them from other data: syncs of a tracker, and the rotors' phase."""
    path = data / "lighthouse" / words[1]
    if not path.exists():
        pytest.skip(f"no {path}")
    assert locatk("import", words[0], path, "-o", tmp_path / "run.mcap").exit_code in (0, 3)
    session = Session.open(tmp_path / "run.mcap")
    expected = {each.channel: each for each in read_station_reports(session)}
    reports, warnings = report_stations(read_sweeps(session))
    assert [each.channel for each in reports] == channels
    assert warnings == ()
    for report in reports:
        decoded = expected[report.channel]
        assert report.id == decoded.id
        assert report.frames == decoded.frames
        assert report.calibration is not None
        assert decoded.calibration is not None
        np.testing.assert_array_equal(report.calibration.sweeps, decoded.calibration.sweeps)


@pytest.mark.slow
def test_a_solution_uses_the_factory_data_in_its_recording(
    tmp_path: Path, locatk: Callable[..., Result]
) -> None:
    simulated = simulate(SimulationOptions(report_hz=50, duration_s=36, seed=3))
    sweeps = simulated.sweeps
    polynomial = sweeps.polynomial.copy()
    for channel in (1, 2):
        rows = sweeps.channel == channel
        zero = sweeps.time_ns[rows] * 1e-9 - sweeps.count[rows] / 6e6
        rotation = np.rint((zero - zero.min()) / PERIODS[channel]).astype(int)
        bits = np.resize(ootx.encode_frame(payload(channel, channel)), rotation.max() + 1)
        polynomial[rows] = 2 * (channel - 1) + bits[rotation]
    run, scene = tmp_path / "run.mcap", tmp_path / "scene.toml"
    sweeps = replace(sweeps, polynomial=polynomial)
    write_session(run, system="lighthouse", sweeps=sweeps, scene=simulated.scene)
    result = locatk("solve", run, "-o", tmp_path / "solved.mcap", "--save-scene", scene)
    assert result.exit_code == 0, result.output
    assert "no factory calibration" not in result.output
    stations = read_scene(scene).stations
    assert [(each.channel, each.id) for each in stations] == [(1, 1), (2, 2)]
    assert [each.calibration.source for each in stations] == ["factory", "factory"]
