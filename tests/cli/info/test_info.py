"""`locatk info` of live recordings: what they say of themselves, and large ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.formats.sessions import capture_record, field_samples
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
CAPTURE = {
    "device": "polaris-array",
    "port": "/dev/ttyACM0",
    "name": "car",
    "serial_number": "0012",
    "baud": "115200",
    "started_ns": str(START_NS),
    "ended_ns": str(START_NS + 10_000_000_000),
    "ended": "Ctrl-C",
    "bytes": "1080000",
    "frames": "10000",
    "bad": "3",
    "lost": "0",
    "skipped": "324",
    "gaps": "1",
    "gap_s": "1.500000",
    "overruns": "0",
    "high_water_bytes": "4096",
    "part": "2",
    "samples:/magnetometers/car": "1000",
    "tick_offset_s:": "12.5",
    "tick_drift_ppm:": "-3.25",
    "tick_restarts:": "0",
    "note": "third lap",
    "meta:robot": "07",
}


def live(path: Path, capture: dict[str, str] | None = None) -> Path:
    """A session of a bar, with what the recorder adds."""
    rng = np.random.default_rng(1)
    time_ns = START_NS + 10_000_000 * np.arange(1000)
    samples = Samples(
        "car", SensorArray(bar(9, 0.02)), time_ns, 1e-6 * rng.normal(size=(1000, 9, 3))
    )
    plain = path.with_name("plain.mcap")
    field_samples.write_magnetometers(plain, [samples])
    source = Session.open(plain)
    with SessionWriter(path, system="polaris") as writer:
        writer.metadata("capture", CAPTURE if capture is None else capture)
        for entry in source.attachments():
            data = source.attachment(entry.name)
            assert data is not None
            writer.attach(entry.name, data, entry.media_type)
        message_class = field_samples.MAGNETOMETERS.layout(1).message
        for time, message in source.decoded("/magnetometers/car", message_class):
            writer.write("/magnetometers/car", message, time)
    plain.unlink()
    return path


def facts(locatk: Any, path: Path) -> dict[str, Any]:
    result = locatk("info", path, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def test_capture_in_json_has_numbers(locatk, tmp_path: Path) -> None:
    answer = facts(locatk, live(tmp_path / "run.mcap"))
    capture = answer["capture"]
    assert set(capture) == set(CAPTURE)
    assert (capture["bytes"], capture["part"], capture["gap_s"]) == (1_080_000, 2, 1.5)
    assert capture["started_ns"] == START_NS
    assert capture["tick_drift_ppm:"] == -3.25
    assert capture["samples:/magnetometers/car"] == 1000
    assert (capture["serial_number"], capture["meta:robot"]) == ("0012", "07")
    [stream] = answer["streams"]
    assert (stream["samples"], stream["messages"]) == (1000, 20)
    assert stream["samples_hz"] == pytest.approx(999 / answer["duration_s"])
    assert answer["metadata"]["capture"] == CAPTURE


def test_capture_for_people(locatk, tmp_path: Path) -> None:
    text = " ".join(locatk("info", live(tmp_path / "run.mcap")).stdout.split())
    for words in (
        "capture: polaris-array on /dev/ttyACM0, as car, part 2, ended: Ctrl-C",
        "received: 1.08 MB (108 kB/s), 10000 frames (1000/s), at most 4.1 kB waited",
        "losses: 3 bad frames, 324 bytes outside of frames, 1 gap, 1.5 s without connection",
        "clock: drift -3.25 ppm, restarts 0",
        "note: third lap",
        "meta: robot = 07",
    ):
        assert words in text, words
    assert "serial_number" in text  # in the table
    assert "tick_" not in text
    assert text.count("third lap") == 1


def test_a_recording_without_losses_reports_none(locatk, tmp_path: Path) -> None:
    path = live(tmp_path / "run.mcap", {"bytes": "1000", "frames": "10", "bad": "0"})
    text = locatk("info", path).stdout
    assert "losses:    none" in text
    assert "received:  1 kB, 10 frames" in text


@pytest.mark.parametrize(
    "value", ["", "x", "nan", "inf", "-1e400", "9" * 400, "9" * 5000, "-5", "0x1"]
)
def test_wild_numbers_of_a_capture(locatk, tmp_path: Path, value: str) -> None:
    keys = [key for key in CAPTURE if key != "ended"]
    path = live(tmp_path / "run.mcap", dict.fromkeys(keys, value))
    assert locatk("info", path).exit_code == 0
    facts(locatk, path)


def test_without_capture(locatk, session: Path) -> None:
    answer = facts(locatk, session)
    assert answer["capture"] is None
    assert {stream["samples"] for stream in answer["streams"]} == {None}
    assert "capture:" not in locatk("info", session).stdout


# ---- large sessions are described by their index


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every session is one, and reading messages is an error."""

    def refuse(*args: object) -> None:
        raise AssertionError("messages are read")

    monkeypatch.setattr(capture_record, "MAX_DESCRIBED_BYTES", 0)
    monkeypatch.setattr(capture_record, "MAX_DESCRIBED_CHUNKS", 0)
    monkeypatch.setattr(Session, "messages", refuse)


def test_a_large_session_of_magnetometers(locatk, tmp_path: Path, monkeypatch) -> None:
    path = live(tmp_path / "run.mcap")
    read = facts(locatk, path)
    monkeypatch.setattr(capture_record, "MAX_DESCRIBED_BYTES", 0)
    monkeypatch.setattr(Session, "messages", None)
    answer = facts(locatk, path)
    assert answer["unread_bytes"] == sum(s.length for s in Session.open(path).index.segments)
    assert read["unread_bytes"] is None
    assert (answer["devices"], answer["samples"]) == (["car"], 1000)
    [before], [after] = read["arrays"], answer["arrays"]
    assert after["rate_hz"] == pytest.approx(before["rate_hz"], rel=0.1)
    assert (before["left_out"], after["left_out"]) == (0, None)
    for key in ("sensors", "position_mm", "noise_ut", "sensor"):
        assert after[key] == before[key]
    text = locatk("info", path).stdout
    assert "not read:  the samples (" in text


def test_a_large_session_that_does_not_count(locatk, tmp_path: Path, large: None) -> None:
    path = tmp_path / "run.mcap"
    sensors = HallSensors()
    field = np.zeros((50, len(sensors)))
    time_ns = START_NS + 10_000_000 * np.arange(50)
    field_samples.write_halls(path, [HallSamples("robot", sensors, time_ns, field)])
    answer = facts(locatk, path)
    assert (answer["devices"], answer["samples"]) == (["robot"], None)
    assert answer["halls"][0]["rate_hz"] is None
    assert "robot" in locatk("info", path).stdout


def test_a_large_session_of_sweeps(locatk, session: Path, large: None) -> None:
    answer = facts(locatk, session)
    assert (answer["devices"], answer["sweeps"]) == (["red"], None)
    assert answer["unread_bytes"] > 0
    assert answer["markers"] == 1
    assert locatk("info", session).exit_code == 0


def test_damage_of_what_is_not_described_is_found(locatk, tmp_path: Path) -> None:
    session, solved = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    assert locatk("simulate", "dots", "--frames", 3, "-o", session).exit_code == 0
    assert locatk("solve", session, "-o", solved).exit_code == 0
    assert facts(locatk, solved)["damage"] is None
    chunk = min(segment.offset for segment in Session.open(solved).index.segments)
    data = bytearray(solved.read_bytes())
    data[chunk + 100] ^= 1
    solved.write_bytes(data)
    result = locatk("info", solved, "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["damage"] == f"a damaged chunk at byte {chunk}"
    assert "`locatk recover` saves the rest" in result.stderr


@pytest.mark.parametrize(
    ("system", "topic", "schema"),
    [
        ("lighthouse", "/lighthouse/x", "LighthouseSweep"),
        ("polaris", "/magnetometers/x", "MagnetometerArray"),
        ("landmarks", "/halls/x", "HallArray"),
        ("dots", "/camera/x", "CompressedImage"),
    ],
)
def test_topics_without_a_message(
    locatk, tmp_path: Path, system: str, topic: str, schema: str
) -> None:
    """A live recording declares its topics before anything comes."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    from locatk.formats.schemas.lighthouse_pb2 import LighthouseSweep
    from locatk.formats.schemas.magnetics_pb2 import HallArray, MagnetometerArray

    kinds = (CompressedImage, LighthouseSweep, HallArray, MagnetometerArray)
    [kind] = [kind for kind in kinds if kind.DESCRIPTOR.name == schema]
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system=system) as writer:
        writer.declare(topic, kind)
    result = locatk("info", path)
    assert "internal error" not in result.stderr
    assert topic in result.stdout
