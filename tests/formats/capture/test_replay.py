"""Replay: the same bytes in the same pieces, at the recorded pace, and no end that is none."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.formats.capture import replay
from locatk.formats.capture.links import LinkEnded, LinkLost, SourceError
from locatk.formats.capture.ports import port_of
from locatk.formats.capture.replay import ReplayLink, ReplayPort
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.reader import read_index
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
PIECES = [b"a", b"bc" * 500, b"\0" * 4096, b"d"]
EVERY_NS = 20_000_000


def write(
    path: Path, pieces: Iterable[bytes] = PIECES, topics: Iterable[str] = ("/serial/robot",)
) -> Path:
    """A session whose pieces came every 20 ms, on each of ``topics``, beside a log."""
    with SessionWriter(path, system="polaris", overwrite=True) as writer:
        writer.write("/log", Log(message="begin"), START_NS)
        offset = 0
        for number, data in enumerate(pieces):
            for topic in topics:
                chunk = SerialChunk(port=topic, byte_offset=offset, data=data)
                writer.write(topic, chunk, START_NS + number * EVERY_NS)
            offset += len(data)
    return path


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write(tmp_path / "run.mcap")


def played(link: ReplayLink) -> tuple[list[bytes], Exception]:
    """All pieces and what came after them."""
    pieces: list[bytes] = []
    try:
        while True:
            pieces.append(link.read(1.0))
    except (LinkEnded, LinkLost) as end:
        return pieces, end


def test_the_same_pieces(session: Path) -> None:
    port = port_of(f"replay:{session}", baud=9600, speed=0)
    assert isinstance(port, ReplayPort)
    for _ in range(2):  # each opening starts at the beginning
        link = port.open()
        pieces, end = played(link)
        assert pieces == PIECES
        assert isinstance(end, LinkEnded)
        with pytest.raises(LinkEnded):
            link.read(0.0)
        assert link.overruns() is None
        link.close()
    assert not port.can_reconnect
    assert port.describe() == {
        "port": f"replay:{session}",
        "resolved": str(session),
        "speed": "0",
        "topic": "/serial/robot",
    }


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(pieces=st.lists(st.binary(max_size=50), max_size=20))
def test_any_pieces(tmp_path: Path, pieces: list[bytes]) -> None:
    file = write(tmp_path / "run.mcap", [*pieces, b"end"])
    link = ReplayPort(f"replay:{file}", speed=0).open()
    # A piece without bytes would be taken for silence.
    assert played(link)[0] == [piece for piece in [*pieces, b"end"] if piece]


class FakeTime:
    """A clock that goes on only when somebody sleeps."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 5.0
        clock = SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep)
        monkeypatch.setattr(replay, "time", clock)

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds


@pytest.mark.parametrize("speed", [1.0, 4.0, 0.5])
def test_at_the_recorded_pace(session: Path, monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    time = FakeTime(monkeypatch)
    link = ReplayPort(f"replay:{session}", speed=speed).open()
    begun = time.now
    for number, piece in enumerate(PIECES):
        assert link.read(1.0) == piece
        assert time.now - begun == pytest.approx(number * 0.02 / speed)


def test_silence_until_it_is_due(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time = FakeTime(monkeypatch)
    link = ReplayPort(f"replay:{session}").open()
    begun = time.now
    assert [link.read(0.015) for _ in range(3)] == [PIECES[0], b"", PIECES[1]]
    assert time.now - begun == pytest.approx(0.02)
    assert link.read(0.0) == b""


def test_a_late_reader_gets_all_due_bytes(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time = FakeTime(monkeypatch)
    link = ReplayPort(f"replay:{session}").open()
    assert link.read(0.0) == PIECES[0]
    time.now += 0.05
    assert [link.read(0.0) for _ in range(3)] == [*PIECES[1:3], b""]


def test_several_ports(tmp_path: Path) -> None:
    file = write(tmp_path / "run.mcap", topics=("/serial/a", "/serial/b#2"))
    with pytest.raises(SourceError, match="2 ports") as error:
        ReplayPort(f"replay:{file}").open()
    hint = f"Give replay:{file}#/serial/a or replay:{file}#/serial/b#2"
    assert error.value.hint == hint
    with pytest.raises(SourceError, match="no port /serial/c"):
        ReplayPort(f"replay:{file}#/serial/c").open()
    link = ReplayPort(f"replay://{file}#/serial/a", speed=0).open()
    assert played(link)[0] == PIECES


def test_names_with_a_number_sign(tmp_path: Path) -> None:
    file = write(tmp_path / "run#2.mcap")
    for name in (f"replay:{file}", f"replay:{file}#/serial/robot"):
        assert ReplayPort(name, speed=0).open().read(0.0) == PIECES[0]


def test_no_raw_bytes(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no raw bytes") as error:
        ReplayPort(f"replay:{write(tmp_path / 'run.mcap', topics=())}").open()
    assert "It contains /log" in str(error.value.hint)


@pytest.mark.parametrize("content", [None, b"", b"no session at all"])
def test_no_session(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "run.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(SourceError) as error:
        ReplayPort(f"replay:{file}").open()
    assert error.value.file == str(file)


@pytest.mark.parametrize("name", ["replay:", "replay://"])
def test_no_file(name: str) -> None:
    with pytest.raises(SourceError, match="no file name"):
        port_of(name, baud=9600).open()


@pytest.mark.parametrize("speed", [-1.0, float("nan"), float("inf")])
def test_no_speed(session: Path, speed: float) -> None:
    with pytest.raises(SourceError, match="is not a valid speed"):
        port_of(f"replay:{session}", baud=9600, speed=speed)


def many() -> list[bytes]:
    """Pieces of several chunks of MCAP."""
    return [bytes([number % 251]) * 40_000 + bytes([number]) for number in range(100)]


def test_a_session_that_is_cut_short(tmp_path: Path) -> None:
    file = write(tmp_path / "run.mcap", many())
    segments = read_index(file.open("rb")).segments
    assert len(segments) > 2
    file.write_bytes(file.read_bytes()[: segments[-1].offset + 100])
    port = ReplayPort(f"replay:{file}", speed=0)
    link = port.open()
    pieces, end = played(link)
    assert pieces == many()[: len(pieces)]
    assert len(pieces) > 50
    # Not the end of the recording: it is lost, and that is what the recorder will say.
    assert isinstance(end, LinkLost)
    assert str(end).startswith(f"{file}: ")
    assert "cut short" in str(end)
    assert "cut short" in port.describe()["damage"]


def test_a_flipped_byte(tmp_path: Path) -> None:
    file = write(tmp_path / "run.mcap", many())
    segment = read_index(file.open("rb")).segments[1]
    data = bytearray(file.read_bytes())
    data[segment.offset + segment.length // 2] ^= 4
    file.write_bytes(data)
    link = ReplayPort(f"replay:{file}", speed=0).open()
    pieces, end = played(link)
    assert pieces
    assert pieces == many()[: len(pieces)]
    assert isinstance(end, LinkLost)
    assert "locatk recover" in str(end)
    assert isinstance(played(link)[1], LinkLost)


def test_closed(session: Path) -> None:
    link = ReplayPort(f"replay:{session}", speed=0).open()
    link.read(0.0)
    link.close()
    link.close()
    with pytest.raises(LinkEnded):
        link.read(0.0)
