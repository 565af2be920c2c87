"""`locatk capture` as a user runs it: what it takes, what it says, what it refuses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log

from locatk.cli.capture import text as capture_text
from locatk.cli.capture.options import DURATION, ROTATION, SIZE, SIZE_OR_ZERO
from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts import tags
from locatk.formats.capture import port_listing as listing
from locatk.formats.capture import ports
from locatk.formats.capture.links import Overruns
from locatk.formats.capture.port_listing import PortInfo
from locatk.formats.capture.recording_files import LiveFile
from locatk.formats.capture.status import CaptureStatus
from locatk.formats.schemas.serial_pb2 import Readings, SerialChunk
from locatk.formats.sessions.capture_statistics import CaptureStatistics
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
TEXT = b"t_ms,x_mm\n" + b"".join(b"%d,%d\n" % (10 * k, k * k) for k in range(60))


def recording(path: Path, data: bytes = TEXT, size: int = 16, step_ms: int = 3) -> Path:
    """A session of raw bytes."""
    with SessionWriter(path, system="") as writer:
        for number, start in enumerate(range(0, len(data), size)):
            piece = data[start : start + size]
            chunk = SerialChunk(byte_offset=start, data=piece, opened=number == 0)
            writer.write("/serial/robot", chunk, START_NS + number * step_ms * MS)
    return path


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A recording of lines."""
    return recording(tmp_path / "old.mcap")


@pytest.fixture
def capture(locatk: Callable, old: Path, tmp_path: Path) -> Callable[..., Any]:
    """``capture("--json")`` records the bytes of ``old`` as lines into ``run.mcap``."""

    def run(*given: object, device: str = "lines") -> Any:
        source = ["capture", f"replay:{old}", "--device", device, "--speed", 0]
        output = () if "-o" in given else ("-o", tmp_path / "run.mcap")
        return locatk(*source, *output, *given)

    return run


def facts(path: Path) -> dict[str, str]:
    return Session.open(path).metadata()["capture"]


# ---- what comes of it


def test_bytes_and_records(capture: Any, tmp_path: Path, raw_bytes: Any) -> None:
    result = capture()
    assert result.exit_code == 0, result.stderr
    path = tmp_path / "run.mcap"
    assert raw_bytes(path) == TEXT
    lines = result.stdout.splitlines()
    assert lines[0].startswith(f"{path}: 0:00, {capture_text.size(len(TEXT))} received from lines")
    assert "0 bad, 0 missing" in lines[1]
    assert lines[1].endswith("end of the source")
    assert any(line.split()[:2] == ["/readings/robot", "60"] for line in lines)
    assert result.stderr.startswith("Recording replay:")
    assert "Ctrl-C ends it" in result.stderr
    assert facts(path)["device"] == "lines"
    assert facts(path)["ended"] == "end of the source"


def test_one_json_object_and_nothing_else(capture: Any, tmp_path: Path) -> None:
    result = capture("--json", "--name", "red")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    path = tmp_path / "run.mcap"
    assert {key: report[key] for key in ("version", "outputs", "device", "system", "ended")} == {
        "version": 1,
        "outputs": [str(path)],
        "device": "lines",
        "system": None,
        "ended": "end of the source",
    }
    assert report["bytes"] == len(TEXT)
    assert report["samples"] == {"/readings/red": 60}
    assert report["file_bytes"] == path.stat().st_size
    assert report["started_ns"] < report["ended_ns"]
    assert report["bad"] == report["lost"] == report["gaps"] == report["overruns"] == 0
    assert report["artifacts"] == []
    for key in ("frames", "high_water_bytes", "clock_step_s", "gap_s", "silences", "line_errors"):
        assert key in report
    assert facts(path)["name"] == "red"


def test_the_totals_of_the_json_are_in_the_metadata(capture: Any, tmp_path: Path) -> None:
    report = json.loads(capture("--json").stdout)
    known = facts(tmp_path / "run.mcap")
    for key in ("bytes", "frames", "bad", "lost", "skipped", "gaps", "overruns", "silences"):
        assert known[key] == str(report[key])
    assert known["samples:/readings/robot"] == "60"


def test_quiet_prints_only_the_result(capture: Any) -> None:
    result = capture("-q")
    assert result.exit_code == 0
    assert result.stderr == ""
    assert "received from lines" in result.stdout
    assert capture("-q", "--json", "--overwrite").stderr == ""


def test_notes_and_facts(capture: Any, tmp_path: Path) -> None:
    given = ("--note", "second floor", "--meta", "robot=7", "--meta", " who = A = B ")
    assert capture(*given).exit_code == 0
    known = facts(tmp_path / "run.mcap")
    assert known["note"] == "second floor"
    assert known["meta:robot"] == "7"
    assert known["meta:who"] == "A = B"
    assert known["port"].startswith("replay:")


def test_columns_are_named(capture: Any, tmp_path: Path) -> None:
    assert capture("--columns", "first, second").exit_code == 0
    ((_, first), *_) = Session.open(tmp_path / "run.mcap").decoded("/readings/robot", Readings)
    assert list(first.names) == ["first", "second"]


def test_artifacts_are_attached(capture: Any, tmp_path: Path) -> None:
    tag, array = tmp_path / "tag.toml", tmp_path / "array.toml"
    tag.write_text(tags.dumps_tags(Tags(ids=(3,))))
    array.write_text(tags.dumps_array(SensorArray(bar(9, 0.02))))
    result = capture("--artifact", tag, "--artifact", array, "--json")
    assert json.loads(result.stdout)["artifacts"] == ["array.toml", "tag.toml"]
    path = tmp_path / "run.mcap"
    assert Session.open(path).attachment("tag.toml") == tag.read_bytes()
    result = capture("--artifact", path, "-o", tmp_path / "more.mcap")
    assert "artifacts: array.toml, tag.toml" in result.stdout
    assert Session.open(tmp_path / "more.mcap").attachment("array.toml") == array.read_bytes()


def test_raw_is_kept_as_it_is(capture: Any, tmp_path: Path, raw_bytes: Any) -> None:
    result = capture("--json", device="raw")
    assert json.loads(result.stdout)["samples"] == {}
    assert raw_bytes(tmp_path / "run.mcap") == TEXT


def test_auto_identifies_the_device(locatk: Any, old: Path, tmp_path: Path, raw_bytes: Any) -> None:
    """And has every record from the first byte on."""
    path = tmp_path / "run.mcap"
    result = locatk("capture", f"replay:{old}", "--speed", 0, "-o", path, "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["device"] == "lines"
    assert report["samples"] == {"/readings/robot": 60}
    assert "Warning: identified device: lines" in result.stderr
    assert raw_bytes(path) == TEXT
    assert facts(path)["device"] == "lines"
    (_, said), *_ = Session.open(path).decoded("/log", Log)
    assert said.message.startswith("identified device: lines")


def test_auto_of_noise_is_raw(locatk: Any, tmp_path: Path, raw_bytes: Any) -> None:
    noise = np.random.default_rng(5).bytes(3000)
    source = recording(tmp_path / "noise.mcap", noise, size=100)
    path = tmp_path / "run.mcap"
    result = locatk("capture", f"replay:{source}", "--speed", 0, "-o", path, "--json")
    assert json.loads(result.stdout)["device"] == "raw"
    assert result.exit_code == 3
    assert "no frame of a known device in 3000 bytes" in result.stderr
    assert raw_bytes(path) == noise


@pytest.mark.slow
def test_a_port_that_is_silent(
    locatk: Any, tmp_path: Path, raw_bytes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("locatk.formats.capture.recorder.STATUS_INTERVAL_S", 0.3)
    path = tmp_path / "run.mcap"
    given = ("--device", "raw", "-o", path, "--duration", "450ms", "--silence", "200ms", "--json")
    result = locatk("capture", "loop://", *given)
    assert result.exit_code == 3
    assert "Incomplete: no data were received" in result.stderr
    report = json.loads(result.stdout)
    assert (report["ended"], report["silences"], report["bytes"]) == ("duration", 1, 0)
    assert "Warning: no data received for 0 s" in result.stderr
    assert raw_bytes(path) == b""
    live = [line for line in result.stderr.splitlines() if line.startswith("0:00  ")]
    assert len(live) == 1


def test_bad_frames_give_status_3(capture: Any, old: Path, tmp_path: Path) -> None:
    changed = TEXT.replace(b"400,1600\n", b"400,\x81\x9200\n").replace(b"90,81\n", b"9\x80,81\n")
    recording(old.with_name("new.mcap"), changed).replace(old)
    result = capture("--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["bad"] == 2
    assert result.stderr.splitlines()[-1] == "Incomplete: 2 bad frames."
    assert Session.open(tmp_path / "run.mcap").damage is None


def test_a_wrong_device_gives_status_3(capture: Any, tmp_path: Path) -> None:
    result = capture("--json", device="locatk")
    assert result.exit_code == 3
    assert f"no frame of locatk in {len(TEXT)} bytes" in result.stderr
    assert json.loads(result.stdout)["frames"] == 0


@pytest.mark.slow
def test_parts(capture: Any, tmp_path: Path, old: Path, raw_bytes: Any) -> None:
    """At 100 kB, of bytes that do not compress, 500 kB of them a second."""
    noise = np.random.default_rng(6).bytes(400_000)
    recording(old.with_name("new.mcap"), noise, size=1500).replace(old)
    result = capture("--speed", 1, "--rotate", "100kB", "--json", "--note", "all", device="raw")
    assert result.exit_code == 0, result.stderr
    outputs = [Path(path) for path in json.loads(result.stdout)["outputs"]]
    assert outputs[:2] == [tmp_path / "run-001.mcap", tmp_path / "run-002.mcap"]
    assert sorted(tmp_path.glob("run*")) == sorted(outputs)
    assert raw_bytes(*outputs) == noise
    assert {facts(path)["note"] for path in outputs} == {"all"}
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.slow
def test_the_size_is_a_limit(capture: Any, tmp_path: Path, old: Path, raw_bytes: Any) -> None:
    noise = np.random.default_rng(6).bytes(2_000_000)
    recording(old.with_name("new.mcap"), noise, size=1500).replace(old)
    result = capture("--speed", 1, "--max-size", "200kB", "--json", device="raw")
    assert json.loads(result.stdout)["ended"] == "max-size"
    assert result.exit_code == 0
    kept = raw_bytes(tmp_path / "run.mcap")
    assert noise.startswith(kept)
    assert 190_000 < len(kept) < len(noise)


# ---- cameras


@pytest.mark.slow
@pytest.mark.parametrize("packing", ["jpeg", "png"])
def test_a_video_becomes_pictures(locatk: Any, tmp_path: Path, packing: str) -> None:
    import cv2

    video = tmp_path / "run.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for number in range(12):
        writer.write(np.full((48, 64, 3), 20 * number, np.uint8))
    writer.release()
    path = tmp_path / "run.mcap"
    given = ("--speed", 0, "--image", packing, "-o", path, "--json")
    result = locatk("capture", f"camera:{video}", *given)
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    (topic,) = report["samples"]
    assert report["samples"][topic] == report["frames"] == 12
    assert report["system"] == "dots"
    session = Session.open(path)
    pictures = [image for _, image in session.decoded(topic, CompressedImage)]
    assert {image.format for image in pictures} == {packing}
    middles = [
        int(cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)[24, 32])
        for image in pictures
    ]
    np.testing.assert_allclose(middles, 20 * np.arange(12), atol=4)
    times = [time_ns for time_ns, _ in session.decoded(topic, CompressedImage)]
    assert times == sorted(set(times))


# ---- refused, before the port is opened


@pytest.fixture
def unopened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of ports that somebody tried to open."""
    asked: list[str] = []

    def port_of(name: str, **_: object) -> Any:
        def fail() -> None:
            asked.append(name)
            raise AssertionError("the port was opened")

        return SimpleNamespace(name=name, can_reconnect=False, open=fail, describe=dict)

    monkeypatch.setattr(ports, "port_of", port_of)
    return asked


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "Missing PORT"),
        (["/dev/x"], "Missing option '-o'"),
        (["/dev/x", "-o", "OUT", "--meta", "robot"], "'robot' is not of the form KEY=VALUE"),
        (["/dev/x", "-o", "OUT", "--meta", "=7"], "is not of the form KEY=VALUE"),
        (["/dev/x", "-o", "OUT", "--duration", "5 parsecs"], "is not a time"),
        (["/dev/x", "-o", "OUT", "--duration", "0"], "is not a time"),
        (["/dev/x", "-o", "OUT", "--duration", "-1s"], ""),
        (["/dev/x", "-o", "OUT", "--max-size", "much"], "is not a size"),
        (["/dev/x", "-o", "OUT", "--max-size", "9" * 400], "is not a size"),
        (["/dev/x", "-o", "OUT", "--rotate", "sometimes"], "is no"),
        (["/dev/x", "-o", "OUT", "--rotate", "1us"], ""),
        (["/dev/x", "-o", "OUT", "--rotate", "1B"], "too small"),
        (["/dev/x", "-o", "OUT", "--silence", "0"], "is not a time"),
        (["/dev/x", "-o", "OUT", "--max-size", "0"], "is not a size"),
        (["/dev/x", "-o", "OUT", "--reserve", "none"], "is not a size; examples: 0, 500MB"),
        (["/dev/x", "-o", "OUT", "--columns", "a,,b"], "distinct names"),
        (["/dev/x", "-o", "OUT", "--columns", "a,a"], "distinct names"),
        (["/dev/x", "-o", "OUT", "--baud", "0"], ""),
        (["/dev/x", "-o", "OUT", "--speed", "-1"], ""),
    ],
)
def test_wrong_usage(
    locatk: Any, tmp_path: Path, unopened: list[str], given: list[str], words: str
) -> None:
    output = str(tmp_path / "run.mcap")
    result = locatk("capture", *(output if each == "OUT" else each for each in given))
    assert result.exit_code == 2
    assert words in result.stderr
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert not unopened
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--device", "nonsense"], "no device 'nonsense'"),
        (["--name", "a/b"], "the name 'a/b' cannot be part of a topic"),
        (["--name", "a b"], "cannot be part of a topic"),
        (["--artifact", "WRONG"], "wrong.toml"),
        (["--artifact", "TAG", "--artifact", "OTHER"], "a second tag.toml"),
        (["--artifact", "OLD"], "the session contains no artifact"),
        (["--artifact", "UNPLUGGED"], "No such file"),
        (["-o", "THERE"], "exists"),
        (["-o", "NOFOLDER"], "no such folder"),
        (["-o", "FOLDER", "--overwrite"], "not a regular file"),
        (["--rotate", "10min", "-o", "PARTED"], "parted-002.mcap"),
        (["--reserve", "100000TB"], "of the disk are free"),
    ],
)
def test_refused(
    locatk: Any, old: Path, tmp_path: Path, unopened: list[str], given: list[str], words: str
) -> None:
    (tmp_path / "wrong.toml").write_text("format = 'smell'\n")
    (tmp_path / "tag.toml").write_text(tags.dumps_tags(Tags(ids=(3,))))
    (tmp_path / "other.toml").write_text(tags.dumps_tags(Tags(ids=(4,))))
    (tmp_path / "there.mcap").write_bytes(b"old")
    (tmp_path / "parted-002.mcap").write_bytes(b"old")
    places = {
        "WRONG": "wrong.toml",
        "TAG": "tag.toml",
        "OTHER": "other.toml",
        "UNPLUGGED": "gone.toml",
        "OLD": "old.mcap",
        "THERE": "there.mcap",
        "NOFOLDER": "no/run.mcap",
        "FOLDER": ".",
        "PARTED": "parted.mcap",
    }
    arguments = [str(tmp_path / places[each]) if each in places else each for each in given]
    before = sorted(path.name for path in tmp_path.iterdir())
    output = [] if "-o" in given else ["-o", tmp_path / "run.mcap"]
    result = locatk("capture", "/dev/x", "--device", "raw", *output, *arguments)
    assert result.exit_code == 1
    assert words in result.stderr
    assert result.stderr.startswith("Error: ")
    assert len(result.stderr.splitlines()) == 1
    assert not unopened
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (tmp_path / "there.mcap").read_bytes() == b"old"


def test_a_port_that_is_not_there_keeps_the_old_file(locatk: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"old")
    result = locatk("capture", tmp_path / "no-port", "--device", "raw", "-o", path, "--overwrite")
    assert result.exit_code == 1
    assert "no such port" in result.stderr
    assert path.read_bytes() == b"old"


@pytest.mark.slow
def test_a_port_that_is_waited_for_is_no_warning(locatk: Any, tmp_path: Path) -> None:
    port = tmp_path / "no-port"
    args = ("--device", "raw", "-o", tmp_path / "run.mcap", "--wait", "0.3s")
    result = locatk("capture", port, *args)
    assert result.exit_code == 1
    waiting, error = result.stderr.splitlines()
    assert waiting == f"Waiting: {port}: no such port; Ctrl-C ends it."
    assert error.startswith(f"Error: {port}: no such port. Hint: ")


def test_the_replayed_session_is_not_overwritten(locatk: Any, old: Path) -> None:
    before = old.read_bytes()
    result = locatk("capture", f"replay:{old}", "-o", old, "--overwrite")
    assert result.exit_code == 1
    assert "one of the inputs" in result.stderr
    assert old.read_bytes() == before


def test_a_camera_is_no_serial_device(locatk: Any, tmp_path: Path) -> None:
    result = locatk("capture", "camera:0", "--device", "lines", "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert "a camera is not a lines" in result.stderr


def test_the_end_of_a_damaged_source_is_reported(
    locatk: Any, old: Path, tmp_path: Path, raw_bytes: Any
) -> None:
    data = old.read_bytes()
    old.write_bytes(data[: len(data) - 400])
    path = tmp_path / "run.mcap"
    result = locatk("capture", f"replay:{old}", "--device", "raw", "--speed", 0, "-o", path)
    assert result.exit_code == 3
    assert "Incomplete: " in result.stderr
    assert TEXT.startswith(raw_bytes(path))
    assert Session.open(path).damage is None


# ---- numbers with units


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90", 90), ("90s", 90), ("1.5 min", 90), ("2h", 7200), ("250ms", 0.25), (".5S", 0.5)],
)
def test_times(text: str, seconds: float) -> None:
    assert DURATION.convert(text, None, None) == pytest.approx(seconds)
    if seconds >= 1:
        assert ROTATION.convert(text, None, None) == ("time", pytest.approx(seconds))


@pytest.mark.parametrize(
    ("text", "count"), [("500MB", 5e8), ("2 GB", 2e9), ("64MiB", 2**26), ("200000b", 2e5)]
)
def test_sizes(text: str, count: float) -> None:
    assert SIZE.convert(text, None, None) == count
    assert SIZE_OR_ZERO.convert(text, None, None) == count
    assert ROTATION.convert(text, None, None) == ("size", count)


@pytest.mark.parametrize("text", ["0", "0.0", "0B", "0 MB"])
def test_no_space_needs_to_stay_free(text: str) -> None:
    assert SIZE_OR_ZERO.convert(text, None, None) == 0
    with pytest.raises(click.BadParameter):
        SIZE.convert(text, None, None)
    with pytest.raises(click.BadParameter):  # 0 is the only number that needs no unit.
        SIZE_OR_ZERO.convert("5", None, None)


@pytest.mark.parametrize("text", ["", "s", "1e3", "5 GiBs", "1,5s", "--", "1m2s", "nan", "inf"])
def test_what_is_neither(text: str) -> None:
    for kind in (DURATION, SIZE, ROTATION):
        with pytest.raises(click.BadParameter):
            kind.convert(text, None, None)  # type: ignore[attr-defined]


# ---- what is shown


def test_the_live_line() -> None:
    totals = CaptureStatistics(bad=2, lost=3, overruns=4, gaps=1, high_water_bytes=5_000_000)
    line = capture_text.status_line(
        CaptureStatus(3723.4, None, 2.5e6, 812.4, totals, 7_000_000, 80_000_000_000)
    )
    assert line.split("  ") == [
        "1:02:03",
        "2.5 MB/s",
        "812 frames/s",
        "2 bad",
        "3 missing",
        "4 overrun",
        "1 gap",
        "backlog 5 MB",
        "file 7 MB",
        "disk 80 GB",
    ]
    quiet = capture_text.status_line(
        CaptureStatus(5.0, None, 0.0, 0.0, CaptureStatistics(), 0, None)
    )
    assert quiet.startswith("0:05  0 B/s")
    assert "gap" not in quiet
    assert "disk" not in quiet
    assert "backlog" not in quiet
    away = capture_text.status_line(
        CaptureStatus(9.0, 3.2, 0.0, 0.0, CaptureStatistics(gaps=2), 0, None)
    )
    assert away.startswith("0:09  away for 3 s  ")
    assert "2 gaps" in away


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1 kB"), (20_480, "20.5 kB"), (3.0e9, "3 GB")],
)
def test_sizes_are_short(count: float, text: str) -> None:
    assert capture_text.size(count) == text


def test_on_a_terminal_the_line_stays_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "50")
    status = CaptureStatus(5.0, None, 1e6, 10.0, CaptureStatistics(), 10**6, 10**9)
    with capture_text.live() as live:
        live.show(status)
        live.show(status)
        live.tell("something happened")
        live.show(status)
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert text.count("\r0:05  1 MB/s") == 3
    assert "something happened\n" in text
    assert max(map(len, text.replace("\n", "\r").split("\r"))) < 80
    assert text.endswith("\r")


def test_a_reader_may_disconnect(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []

    def broken(text: str, **_: object) -> None:
        heard.append(text)
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(click, "echo", broken)
    live = capture_text.Live()
    live.tell("one")
    live.show(CaptureStatus(5.0, None, 1e6, 10.0, CaptureStatistics(), 10**6, 10**9))
    live.tell("two")
    live.wipe()
    assert len(heard) == 3


@pytest.mark.slow
def test_losses_of_the_line_are_in_the_json(
    locatk: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the kernel counts of a UART."""
    read, write = os.pipe()

    class Port:
        name, can_reconnect = "uart", True

        def open(self) -> Any:
            return self

        def describe(self) -> dict[str, str]:
            return {"vid": "239a"}

        def read(self, wait_s: float) -> bytes:
            return os.read(read, 100)

        def overruns(self) -> Overruns:
            return Overruns(overrun=3, buffer=4, frame=5)

        def close(self) -> None:
            pass

    def feed() -> None:
        for _ in range(30):
            os.write(write, b"1,2\n")
            threading.Event().wait(0.02)

    monkeypatch.setattr(ports, "port_of", lambda *args, **more: Port())
    feeder = threading.Thread(target=feed)
    feeder.start()
    path = tmp_path / "run.mcap"
    given = ("--device", "lines", "-o", path, "--duration", "200ms", "--json")
    result = locatk("capture", "uart", *given)
    feeder.join()
    os.close(read), os.close(write)
    assert result.exit_code == 3
    report = json.loads(result.stdout)
    assert (report["overruns"], report["line_errors"]) == (7, 5)
    assert "7 bytes overrun" in result.stderr
    assert facts(path)["vid"] == "239a"
    assert facts(path)["overruns"] == "7"


# ---- the list of ports


PORT = PortInfo(
    device="/dev/ttyACM0",
    vid=0x239A,
    pid=0x80F4,
    serial_number="E6614",
    description="Pico",
)


def test_the_list_of_ports(locatk: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listing, "find_ports_with_users", lambda: [PORT])
    result = locatk("capture", "--list")
    assert result.exit_code == 0
    assert result.stderr == ""
    header, row = result.stdout.splitlines()
    assert header.split("  ")[0] == "port"
    for word in ("/dev/ttyACM0", "239a:80f4", "E6614", "Pico"):
        assert word in row
    result = locatk("capture", "--list", "--json")
    (port,) = json.loads(result.stdout)["ports"]
    assert port["device"] == "/dev/ttyACM0"
    assert (port["vid"], port["serial_number"]) == (0x239A, "E6614")


def test_no_ports(locatk: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listing, "find_ports_with_users", list)
    result = locatk("capture", "--list")
    assert (result.exit_code, result.stdout) == (0, "")
    assert "No serial port found" in result.stderr
    assert json.loads(locatk("capture", "--list", "--json").stdout) == {"version": 1, "ports": []}


def test_listing_needs_nothing_heavy() -> None:
    code = (
        "import sys, contextlib, io; from locatk.cli.app import app\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
        "    app(['capture', '--list', '-q'])\n"
        "print(sorted({'numpy', 'cv2', 'mcap'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# ---- a full disk


def test_a_full_disk_is_one_line(
    capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raw_bytes: Any
) -> None:
    monkeypatch.setattr(LiveFile, "free", lambda self: 1)
    from locatk.formats.capture import recorder

    monkeypatch.setattr(recorder, "STATUS_INTERVAL_S", 0.0)
    result = capture("--json")
    assert result.exit_code == 3
    assert "Incomplete: the disk is full up to --reserve" in result.stderr
    assert TEXT.startswith(raw_bytes(tmp_path / "run.mcap"))
    assert "the disk is full" in json.loads(result.stdout)["ended"]
