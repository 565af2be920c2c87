"""Raw bytes of recordings, decoded again: the same as live, and better where it can be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from locatk.core.errors import FormatError, InputError, MissingDataError, OutputExistsError
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.formats.capture.ingestion import SerialIntake
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.capture.recording_files import LOG_NAME, FileContent, RecordingFiles
from locatk.formats.capture.redecoding import decode, losses
from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Options, Recording
from locatk.formats.schemas.serial_pb2 import Readings, SerialChunk
from locatk.formats.sessions import messages
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
RAW = "/serial/robot"

Reads = Sequence[tuple[int, bytes] | None]
"""(ms since the start, bytes); None: unplugged and plugged in again."""


def record(
    path: Path,
    name: str,
    reads: Reads,
    *,
    options: Options | None = None,
    facts: dict[str, str] | None = None,
    topic_name: str = "robot",
) -> Path:
    """A recording as the recorder makes it, with stamps of the test's own."""
    intake = SerialIntake(topic_name, "/dev/x", name, options)
    said = {"device": name, "port": "/dev/x", "note": "of a test", **(facts or {})}
    made = RecordingFiles(path, FileContent(said, {}, intake.declared))
    for start in range(0, len(reads), 3):
        arrived: list[ReceivedData] = []
        for each in reads[start : start + 3]:
            if each is None:
                made.write(intake.take(arrived))
                arrived = []
                made.log("connection lost: a test", START_NS)
                made.write(intake.restart())
                made.log("connected again", START_NS)
            else:
                arrived.append(ReceivedData(START_NS + each[0] * MS, each[1], len(each[1])))
        made.write(intake.take(arrived))
        made.flush()
    made.write(intake.finish())
    made.attach(intake.artifacts())
    made.system(intake.system)
    made.finish({"gaps": "3", "overruns": "7", "ended": "stopped", **intake.clocks()})
    return path


def raw(path: Path, topic: str = RAW) -> list[tuple[int, int, bytes, bool]]:
    return [
        (time_ns, chunk.byte_offset, chunk.data, chunk.opened)
        for time_ns, chunk in Session.open(path).decoded(topic, SerialChunk)
    ]


def readings(path: Path, topic: str = "/readings/robot") -> tuple[list[int], list[float]]:
    found: tuple[list[int], list[float]] = [], []
    for _, message in Session.open(path).decoded(topic, Readings):
        found[0].extend(message.time_ns)
        found[1].extend(message.value)
    return found


def numbered(count: int, step_ms: int = 7) -> Reads:
    """Lines of two numbers, cut anywhere."""
    text = b"a,b\n" + b"".join(b"%d,%d\n" % (k, k * k) for k in range(count))
    return [(k * step_ms, text[k * 11 : k * 11 + 11]) for k in range(-(-len(text) // 11))]


def test_the_same_bytes_give_the_same_records(tmp_path: Path) -> None:
    live = record(tmp_path / "live.mcap", "lines", numbered(200))
    decoded = decode(live, tmp_path / "again.mcap")
    assert decoded.devices == {"robot": "lines"}
    assert losses(decoded) == []
    assert raw(tmp_path / "again.mcap") == raw(live)
    assert readings(tmp_path / "again.mcap") == readings(live)
    assert len(readings(live)[1]) > 300
    assert decoded.totals["robot"].samples == {"/readings/robot": len(readings(live)[0])}
    twice = decode(tmp_path / "again.mcap", tmp_path / "twice.mcap")
    assert twice.totals == decoded.totals
    assert readings(tmp_path / "twice.mcap") == readings(live)


def some_samples(n: int = 400) -> Samples:
    rng = np.random.default_rng(3)
    field = np.cumsum(rng.normal(size=(n, 9, 3)) * 2e-7, axis=0) + rng.normal(size=(9, 3)) * 4e-5
    return Samples("robot", SensorArray(bar(9, 0.02)), START_NS + np.arange(n) * 10 * MS, field)


def some_halls(n: int = 400) -> HallSamples:
    rng = np.random.default_rng(4)
    place = np.array([[0.02, 0.02], [0.02, -0.02], [-0.02, 0.02], [-0.02, -0.02]])
    sensors = HallSensors(("a", "b", "c", "d"), place)
    time_ns = START_NS + np.arange(n) * 10 * MS
    return HallSamples("robot", sensors, time_ns, rng.normal(size=(n, 4)) * 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "recording", "topic", "layout"),
    [
        (
            "polaris-array",
            Recording(samples=[some_samples()]),
            "/magnetometers/robot",
            messages.magnetometers(9),
        ),
        ("locatk", Recording(halls=[some_halls()]), "/halls/robot", messages.halls(4)),
    ],
)
def test_binary_devices_alike(
    tmp_path: Path, name: str, recording: Recording, topic: str, layout: Any
) -> None:
    sent = [
        ((time_ns - START_NS) // MS, data) for time_ns, data in find_device(name).encode(recording)
    ]
    live = record(tmp_path / "live.mcap", name, sent)
    decode(live, tmp_path / "again.mcap")

    def columns(path: Path) -> dict[str, Any]:
        payloads = [payload for _, _, payload in Session.open(path).messages([topic])]
        found: dict[str, Any] = layout.unpack(payloads).columns
        return found

    first, second = columns(live), columns(tmp_path / "again.mcap")
    assert len(first["time_ns"]) > 300
    assert set(first) == set(second)
    for key in first:
        if key != "time_ns":
            np.testing.assert_array_equal(first[key], second[key])
    # The device's clock is learnt while it runs, from other pieces than live.
    assert np.abs(first["time_ns"] - second["time_ns"]).max() < 50_000
    assert raw(tmp_path / "again.mcap") == raw(live)
    names = [
        {each.name for each in Session.open(path).attachments()}
        for path in (live, tmp_path / "again.mcap")
    ]
    assert names[0] == names[1]
    systems = {Session.open(path).facts["system"] for path in (live, tmp_path / "again.mcap")}
    assert systems == {"polaris" if name == "polaris-array" else "landmarks"}


def test_reopened_ports_decode_as_recorded(tmp_path: Path) -> None:
    reads: Reads = [(0, b"1,2\n3,4\n5,6\n7,"), None, (900, b"8\n9,10\n11,12\n"), (950, b"13,14\n")]
    live = record(tmp_path / "live.mcap", "lines", reads)
    decode(live, tmp_path / "again.mcap")
    assert [each[3] for each in raw(tmp_path / "again.mcap")] == [True, True, False]
    assert raw(tmp_path / "again.mcap") == raw(live)
    assert readings(tmp_path / "again.mcap") == readings(live)
    assert readings(live)[1] == [3, 4, 5, 6, 9, 10, 11, 12, 13, 14]  # no line of 7 and 8
    lines = [line.message for _, line in Session.open(tmp_path / "again.mcap").decoded("/log", Log)]
    assert lines == ["connection lost: a test", "connected again"]


def test_facts_of_the_recording_are_kept(tmp_path: Path) -> None:
    live = record(
        tmp_path / "live.mcap", "lines", numbered(20), facts={"meta:robot": "7", "baud": "9600"}
    )
    decode(live, tmp_path / "again.mcap")
    facts = Session.open(tmp_path / "again.mcap").metadata()[CAPTURE_RECORD]
    assert facts["note"] == "of a test"
    assert facts["meta:robot"] == "7"
    assert facts["port"] == "/dev/x"
    assert facts["gaps"] == "3"
    assert facts["overruns"] == "7"
    assert facts["ended"] == "stopped"
    assert facts["decoded_from"] == "live.mcap"
    assert int(facts["frames"]) >= 20


def test_another_device(tmp_path: Path) -> None:
    live = record(tmp_path / "live.mcap", "raw", numbered(50))
    assert not Session.open(live).topics("/readings/")
    decoded = decode(live, tmp_path / "again.mcap", device="lines", options=Options(("t", "u")))
    assert decoded.devices == {"robot": "lines"}
    ((_, first), *_) = Session.open(tmp_path / "again.mcap").decoded("/readings/robot", Readings)
    assert list(first.names) == ["t", "u"]
    facts = Session.open(tmp_path / "again.mcap").metadata()[CAPTURE_RECORD]
    assert facts["device"] == "lines"
    assert raw(tmp_path / "again.mcap") == raw(live)


def test_records_of_before_are_left_out(tmp_path: Path) -> None:
    live = record(tmp_path / "live.mcap", "lines", numbered(50))
    decode(live, tmp_path / "again.mcap", device="raw")
    session = Session.open(tmp_path / "again.mcap")
    assert {channel.topic for channel in session.channels if channel.count} == {RAW}
    assert not [key for key in session.metadata()[CAPTURE_RECORD] if key.startswith("samples:")]
    assert raw(tmp_path / "again.mcap") == raw(live)


def test_artifacts_are_added_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        writer.attach_toml("tag.toml", "old = 1\n")
        writer.attach_toml("map.toml", "kept = 1\n")
        writer.attach("photo.jpg", b"\xff\xd8", "image/jpeg", START_NS)
        writer.metadata("facts", {"weather": "fine"})
        chunk = SerialChunk(data=b"1,2\n3,4\n", opened=True)
        writer.write(RAW, chunk, START_NS)
    decode(
        path,
        tmp_path / "again.mcap",
        device="lines",
        artifacts={"tag.toml": "new = 1\n", "array.toml": "more = 1\n"},
    )
    session = Session.open(tmp_path / "again.mcap")
    assert sorted(each.name for each in session.attachments()) == [
        "array.toml",
        "map.toml",
        "photo.jpg",
        "tag.toml",
    ]
    assert session.attachment("tag.toml") == b"new = 1\n"
    assert session.attachment("map.toml") == b"kept = 1\n"
    assert session.attachment("photo.jpg") == b"\xff\xd8"
    assert session.metadata()["facts"] == {"weather": "fine"}


# ---- recordings that are not whole


def holed(path: Path, chunks: Sequence[tuple[int, int, bytes, bool]]) -> Path:
    """(ms, offset, bytes, opened) as they are."""
    with SessionWriter(path, system="") as writer:
        writer.metadata(CAPTURE_RECORD, {"device": "lines"})
        for ms, offset, data, opened in chunks:
            chunk = SerialChunk(byte_offset=offset, data=data, opened=opened)
            writer.write(RAW, chunk, START_NS + ms * MS)
    return path


def test_bytes_that_are_missing_stay_missing(tmp_path: Path) -> None:
    """After `locatk recover`: what is left on both sides of a hole is not put together."""
    path = holed(
        tmp_path / "hole.mcap",
        [(0, 0, b"1,2\n3,4\n5,", True), (10, 500, b"6\n7,8\n9,10\n", False)],
    )
    decoded = decode(path, tmp_path / "again.mcap")
    assert [(offset, data) for _, offset, data, _ in raw(tmp_path / "again.mcap")] == [
        (0, b"1,2\n3,4\n5,"),
        (500, b"6\n7,8\n9,10\n"),
    ]
    _, values = readings(tmp_path / "again.mcap")
    assert values == [3, 4, 7, 8, 9, 10]
    assert any("490 bytes are missing" in remark for remark in decoded.remarks)
    assert [each[3] for each in raw(tmp_path / "again.mcap")] == [True, False]


def test_a_later_part_keeps_its_offsets(tmp_path: Path) -> None:
    path = holed(
        tmp_path / "run-002.mcap",
        [(0, 1000, b"3,4\n5,6\n7,8\n", False), (10, 1012, b"9,10\n", False)],
    )
    decoded = decode(path, tmp_path / "again.mcap")
    assert [offset for _, offset, _, _ in raw(tmp_path / "again.mcap")] == [1000, 1012]
    assert not decoded.remarks
    _, values = readings(tmp_path / "again.mcap")
    assert values[-4:] == [7, 8, 9, 10]


def test_a_part_that_begins_when_the_port_was_opened_again(tmp_path: Path) -> None:
    path = holed(tmp_path / "run-002.mcap", [(0, 1000, b"3,4\n5,6\n7,8\n", True)])
    decode(path, tmp_path / "again.mcap")
    assert [each[1::2] for each in raw(tmp_path / "again.mcap")] == [(1000, True)]


# ---- several ports


def test_several_ports(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with SessionWriter(path, system="") as writer:
        for k in range(40):
            for name, mark in (("red", 1), ("blue", 2)):
                data = b"%02d,%d\n" % (k, mark)
                chunk = SerialChunk(byte_offset=k * len(data), data=data, opened=k == 0)
                writer.write(f"/serial/{name}", chunk, START_NS + k * 5 * MS)
    decoded = decode(path, tmp_path / "again.mcap", device="lines")
    assert decoded.devices == {"red": "lines", "blue": "lines"}
    for name, mark in (("red", 1), ("blue", 2)):
        _, values = readings(tmp_path / "again.mcap", f"/readings/{name}")
        assert set(values[1::2]) == {mark}
        assert raw(tmp_path / "again.mcap", f"/serial/{name}") == raw(path, f"/serial/{name}")


# ---- refused


def test_what_holds_no_bytes(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "no.mcap", system="dots"):
        pass
    with pytest.raises(FormatError, match="no raw bytes"):
        decode(tmp_path / "no.mcap", tmp_path / "again.mcap")
    with pytest.raises(MissingDataError):
        decode(tmp_path / "none.mcap", tmp_path / "again.mcap")
    assert not (tmp_path / "again.mcap").exists()


def test_what_cannot_be(tmp_path: Path) -> None:
    live = record(tmp_path / "live.mcap", "raw", numbered(3))
    with pytest.raises(InputError, match="no device 'nonsense'"):
        decode(live, tmp_path / "again.mcap", device="nonsense")
    (tmp_path / "again.mcap").write_bytes(b"old")
    with pytest.raises(OutputExistsError):
        decode(live, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == b"old"
    decode(live, tmp_path / "again.mcap", overwrite=True)
    assert raw(tmp_path / "again.mcap") == raw(live)


def test_a_recording_that_was_cut_short_is_not_taken_for_whole(tmp_path: Path) -> None:
    live = record(tmp_path / "live.mcap", "lines", numbered(300))
    data = live.read_bytes()
    live.write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError):
        decode(live, tmp_path / "again.mcap")
    assert not (tmp_path / "again.mcap").exists()
    assert not list(tmp_path.glob(".*"))


def test_lines_of_the_device_are_not_doubled(tmp_path: Path) -> None:
    """What the device itself said is decoded again; what the recorder said is kept."""
    reads: Reads = [(0, b"boot ok\n1,2\n3,4\n"), (30, b"all is well\n5,6\n")]
    live = record(tmp_path / "live.mcap", "lines", reads)
    decode(live, tmp_path / "again.mcap")

    def lines(path: Path) -> list[tuple[str, str]]:
        found = Session.open(path).decoded("/log", Log)
        return sorted((line.name, line.message) for _, line in found)

    assert lines(tmp_path / "again.mcap") == lines(live)
    assert {name for name, _ in lines(live)} <= {LOG_NAME, "robot"}
