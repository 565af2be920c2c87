"""Bytes become messages: all raw ones, then what a decoder makes of them, whatever it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.formats import devices as wire
from locatk.formats.capture import ingestion
from locatk.formats.capture.ingestion import PAUSE_NS, CameraIntake, SerialIntake, StampedMessage
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.devices.interface import Batch, Counts, Options, Stream, Ticks
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.capture_statistics import CaptureStatistics

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
RAW = "/serial/red"


class Quads:
    """Four bytes are a frame; ``?`` in one is wrong, ``!`` anywhere breaks the decoder."""

    pauses: list[bool]

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks = [f"columns are {options.columns}"] if options.columns else []
        self.pauses = []
        self.restarts = 0
        self._tail = b""

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        if b"!" in data:
            raise RuntimeError("broke on !")
        self.pauses.append(pause)
        before = self.counts.bytes - len(self._tail)
        self.counts.bytes += len(data)
        block = self._tail + data
        whole = len(block) // 4 * 4
        self._tail = block[whole:]
        ends, values = [], []
        for start in range(0, whole, 4):
            frame = block[start : start + 4]
            if b"?" in frame:
                self.counts.bad += 1
                continue
            self.counts.frames += 1
            ends.append(before + start + 4)
            values.append([float(frame[0])])
        stream = Stream("readings", names=("first",))
        return [Batch(stream, np.array(ends, np.int64), {"value": np.array(values).reshape(-1, 1)})]

    def restart(self) -> list[Batch]:
        self.restarts += 1
        if self._tail.startswith(b"r"):
            raise RuntimeError("broke on a restart")
        self._tail = b""
        return []

    def finish(self) -> list[Batch]:
        if self._tail.startswith(b"f"):
            raise RuntimeError("broke at the end")
        return []


class Odd(Quads):
    """Gives batches that nobody can use."""

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        end = np.array([1])
        return {
            b"kind": [Batch(Stream("smell"), end, {})],
            b"shape": [Batch(Stream("halls", sensors=4), end, {"b_tesla": np.zeros((3, 2))})],
            b"column": [Batch(Stream("odometry"), end, {"x_m": np.zeros(1)})],
            b"none": None,
        }[data]  # type: ignore[return-value]


def halls_of(stream: Stream) -> dict[str, str]:
    return {"halls.toml": f"sensors = {stream.sensors}\n"} if stream.kind == "halls" else {}


def broken_artifacts(_: Stream) -> dict[str, str]:
    raise RuntimeError("no artifacts today")


class Halls(Quads):
    """Gives a sample of a hall sensor whenever it is fed."""

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        self.counts.bytes += len(data)
        stream = Stream("halls", sensors=1, ticks=Ticks(1e3, 32))
        end = np.array([self.counts.bytes])
        return [Batch(stream, end, {"b_tesla": np.ones((1, 1))}, tick=end)]


@pytest.fixture(autouse=True)
def devices(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, artifacts in (
        ("Quads", ""),
        ("Odd", ""),
        ("Halls", "halls_of"),
        ("Halls", "broken_artifacts"),
    ):
        known = f"{__name__}:{artifacts}" if artifacts else ""
        key = name.lower() + ("-broken" if "broken" in artifacts else "")
        monkeypatch.setitem(
            wire.DEVICES, key, wire.Device(key, "", 115_200, f"{__name__}:{name}", "", known)
        )


def reads(*data: bytes, step_ns: int = 4 * MS, start_ns: int = START_NS) -> list[ReceivedData]:
    return [ReceivedData(start_ns + k * step_ns, each, len(each)) for k, each in enumerate(data)]


def raw(made: Sequence[StampedMessage]) -> bytes:
    content = bytearray()
    for each in made:
        if isinstance(each.message, SerialChunk):
            assert each.message.byte_offset == len(content)
            assert each.topic == RAW
            content += each.message.data
    return bytes(content)


def values(made: Sequence[StampedMessage]) -> list[float]:
    return [
        value
        for each in made
        if each.topic == "/readings/red"
        for value in each.message.value  # type: ignore[attr-defined]
    ]


def times_of(made: Sequence[StampedMessage]) -> list[int]:
    return [
        time_ns
        for each in made
        if each.topic == "/readings/red"
        for time_ns in each.message.time_ns  # type: ignore[attr-defined]
    ]


def counted(intake: Any) -> CaptureStatistics:
    totals = CaptureStatistics()
    intake.count(totals)
    return totals


# ---- bytes and records


def test_raw_bytes_come_first_then_records() -> None:
    intake = SerialIntake("red", "/dev/x", "quads")
    made = list(intake.take(reads(b"abc", b"dEf", b"ghI")))
    assert [each.topic for each in made] == [RAW] * 3 + ["/readings/red"] * 2
    assert raw(made) == b"abcdEfghI"
    chunks: list[Any] = [each.message for each in made[:3]]
    assert [chunk.opened for chunk in chunks] == [True, False, False]
    assert {chunk.port for chunk in chunks} == {"/dev/x"}
    assert [each.time_ns - START_NS for each in made] == [0, 4 * MS, *[8 * MS] * 3]
    assert values(made) == [ord("a"), ord("E")]
    byte_ns = 10e9 / 115_200
    ends = [4 * MS - 2 * byte_ns, 8 * MS - byte_ns]
    np.testing.assert_allclose(np.array(times_of(made)) - START_NS, ends, atol=2)
    assert intake.declared == [(RAW, SerialChunk)]


@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=60).map(lambda d: d.replace(b"!", b".")), cut=st.data())
def test_how_it_was_read_changes_no_record(data: bytes, cut: st.DataObject) -> None:
    places = sorted(cut.draw(st.sets(st.integers(1, max(1, len(data) - 1)), max_size=8)))
    pieces = [data[a:b] for a, b in zip([0, *places], [*places, len(data)], strict=True)]
    pieces = [piece for piece in pieces if piece]
    intake = SerialIntake("red", "", "quads")
    made: list[StampedMessage] = []
    turns = sorted(cut.draw(st.sets(st.integers(0, len(pieces)), max_size=4)))
    arrived = reads(*pieces)
    for a, b in zip([0, *turns], [*turns, len(pieces)], strict=True):
        made += intake.take(arrived[a:b])
    made += intake.finish()
    assert raw(made) == data
    frames = [data[k : k + 4] for k in range(0, len(data) - 3, 4)]
    assert values(made) == [frame[0] for frame in frames if b"?" not in frame]
    totals = counted(intake)
    assert totals.bytes == len(data)
    assert totals.bad == sum(b"?" in frame for frame in frames)
    assert totals.samples.get("/readings/red", 0) == totals.frames == len(values(made))


def test_the_decoder_receives_pauses() -> None:
    intake = SerialIntake("red", "", "quads")
    decoder: Any = intake._decoder
    list(intake.take(reads(b"a", b"b", step_ns=MS)))
    list(intake.take(reads(b"c", start_ns=START_NS + MS + PAUSE_NS - 1)))
    list(intake.take(reads(b"d", b"e", step_ns=MS, start_ns=START_NS + MS + 2 * PAUSE_NS - 1)))
    assert decoder.pauses == [True, False, True]
    assert decoder.counts.bytes == 5


def test_reads_separated_by_a_pause_are_not_merged() -> None:
    intake = SerialIntake("red", "", "quads")
    made = list(intake.take(reads(b"ab", b"cd", b"ef", step_ns=PAUSE_NS)))
    chunks = [each for each in made if isinstance(each.message, SerialChunk)]
    assert [each.time_ns - START_NS for each in chunks] == [0, PAUSE_NS, 2 * PAUSE_NS]


def test_a_line_that_goes_on_has_no_pauses() -> None:
    """Joined or not: the decoder is not told of pauses that were none."""
    intake = SerialIntake("red", "", "quads")
    decoder: Any = intake._decoder
    for turn in range(5):
        list(
            intake.take(
                reads(*[b"abcdefghijkl"] * 20, step_ns=MS, start_ns=START_NS + turn * 20 * MS)
            )
        )
    assert decoder.pauses.count(True) == 1
    list(intake.take(reads(b"abcd", start_ns=START_NS + 99 * MS + PAUSE_NS + 2 * MS)))
    assert decoder.pauses.count(True) == 2


def test_samples_in_short_bursts_keep_their_times() -> None:
    """Bytes of USB come at once, whatever the baud: each read has its own time."""
    intake = SerialIntake("red", "", "quads", baud=1_000_000)
    made = list(intake.take(reads(*[b"abcd"] * 50, step_ns=2 * MS)))
    got = np.array(times_of(made)) - START_NS
    np.testing.assert_allclose(got, np.arange(50) * 2 * MS, atol=0.2 * MS)


def test_options_reach_the_decoder_and_remarks_are_reported_once() -> None:
    intake = SerialIntake("red", "", "quads", Options(columns=("a", "b")))
    assert intake.remarks() == ["columns are ('a', 'b')"]
    assert intake.remarks() == []


def test_the_baud_rate_that_was_given_counts() -> None:
    intake = SerialIntake("red", "", "quads", baud=9600)
    assert intake._arrivals.byte_ns == pytest.approx(10e9 / 9600)


def test_no_such_device() -> None:
    with pytest.raises(InputError, match="no device 'nonsense'"):
        SerialIntake("red", "", "nonsense")


# ---- a line that was lost


def test_after_a_gap_the_decoder_begins_anew_and_offsets_go_on() -> None:
    intake = SerialIntake("red", "", "quads")
    made = list(intake.take(reads(b"abcdEF")))
    made += intake.restart()
    made += intake.take(reads(b"ghijk", start_ns=START_NS + 10**9))
    assert raw(made) == b"abcdEFghijk"
    chunks = [each.message for each in made if isinstance(each.message, SerialChunk)]
    assert [chunk.opened for chunk in chunks] == [True, True]
    assert values(made) == [ord("a"), ord("g")]


def test_ticks_begin_anew_after_a_gap() -> None:
    intake = SerialIntake("red", "", "halls")
    for k in range(50):
        list(intake.take(reads(b"x", start_ns=START_NS + k * 10 * MS)))
    before = intake.clocks()
    list(intake.restart())
    late = START_NS + 3600 * 10**9
    (_, stamped) = intake.take(reads(b"x", start_ns=late))
    assert stamped.publish_ns == late
    assert float(before["tick_offset_s:red"]) == pytest.approx(START_NS * 1e-9, abs=0.1)
    assert before["tick_restarts:red"] == "0"


# ---- decoders that fail


FAULTS = {
    "feed": [b"abcd", b"ef!gh", b"ijkl"],
    "restart": [b"abcd", b"r", None, b"ijkl"],
    "finish": [b"abcd", b"ijkl", b"f"],
}


@pytest.mark.parametrize("where", FAULTS)
def test_a_decoder_that_fails_costs_no_byte(where: str) -> None:
    intake = SerialIntake("red", "", "quads")
    made: list[StampedMessage] = []
    sent = b""
    for number, piece in enumerate(FAULTS[where]):
        if piece is None:
            made += intake.restart()
        else:
            made += intake.take(reads(piece, start_ns=START_NS + number * MS))
            sent += piece
        counted(intake)
    made += intake.finish()
    assert raw(made) == sent
    assert values(made)[0] == ord("a")
    (remark,) = intake.remarks()
    assert "the decoder failed (RuntimeError: broke" in remark
    assert "only raw bytes" in remark
    assert counted(intake).frames >= 1
    assert counted(intake).bytes == len(sent)


@pytest.mark.parametrize("kind", [b"kind", b"shape", b"column", b"none"])
def test_invalid_batches_of_a_decoder_lose_no_bytes(kind: bytes) -> None:
    intake = SerialIntake("red", "", "odd")
    made = [*intake.take(reads(kind)), *intake.take(reads(b"more", start_ns=START_NS + MS))]
    assert raw(made) == kind + b"more"
    assert len(intake.remarks()) == 1


def test_counts_of_a_failed_decoder_are_kept() -> None:
    intake = SerialIntake("red", "", "quads")
    list(intake.take(reads(b"abcd??efgh??")))
    list(intake.take(reads(b"!", start_ns=START_NS + MS)))
    totals = counted(intake)
    assert (totals.frames, totals.bad) == (1, 2)
    assert totals.bytes == 13


def test_artifacts_that_cannot_be_made_cost_nothing() -> None:
    intake = SerialIntake("red", "", "halls-broken")
    list(intake.take(reads(b"x")))
    assert intake.artifacts() == {}
    assert list(intake.take(reads(b"y", start_ns=START_NS + MS)))


# ---- what becomes known


def test_the_system_and_its_artifacts_are_known_from_the_first_record() -> None:
    intake = SerialIntake("red", "", "halls")
    assert (intake.system, intake.artifacts()) == ("", {})
    list(intake.take(reads(b"x")))
    assert intake.system == "landmarks"
    assert intake.artifacts() == {"halls.toml": "sensors = 1\n"}


# ---- auto


@dataclass
class Verdict:
    device: str
    why: str


class Identifier:
    """Knows after so many bytes; ``settle`` takes it for raw."""

    after = 8
    broken = False

    def __init__(self, options: Options | None = None) -> None:
        self.heard = 0

    def feed(self, data: bytes, *, pause: bool = False) -> None:
        if self.broken:
            raise RuntimeError("broke on listening")
        self.heard += len(data)

    def verdict(self) -> Verdict | None:
        return Verdict("quads", "four bytes each") if self.heard >= self.after else None

    def settle(self) -> Verdict:
        return self.verdict() or Verdict("raw", "nothing fits")


@pytest.fixture
def auto(monkeypatch: pytest.MonkeyPatch) -> type[Identifier]:
    kind = type("Identifier", (Identifier,), {})
    monkeypatch.setattr(ingestion, "Identifier", kind)
    return kind


def test_auto_loses_nothing_while_it_listens(auto: Any) -> None:
    intake = SerialIntake("red", "", "auto")
    assert intake.device is None
    made = list(intake.take(reads(b"abcd", b"ef")))
    assert intake.device is None
    assert values(made) == []
    made += intake.take(reads(b"ghijkl", start_ns=START_NS + 50 * MS))
    assert intake.device is not None
    assert intake.device.name == "quads"
    assert raw(made) == b"abcdefghijkl"
    assert values(made) == [ord("a"), ord("e"), ord("i")]
    # Dated as if it had been known from the first byte on.
    byte_ns = 10e9 / 115_200
    expected = [0.0, 50 * MS - 4 * byte_ns, 50 * MS]
    np.testing.assert_allclose(np.array(times_of(made)) - START_NS, expected, atol=2)
    (remark,) = intake.remarks()
    assert remark == "identified device: quads (four bytes each)"
    list(intake.take(reads(b"mnop", start_ns=START_NS + 60 * MS)))
    assert counted(intake).frames == 4


def test_auto_settles_when_it_has_listened_for_long_enough(auto: Any) -> None:
    intake = SerialIntake("red", "", "auto")
    assert list(intake.turn(START_NS + 10**12)) == []  # nothing was heard yet
    made = list(intake.take(reads(b"abc")))
    made += intake.turn(START_NS + 2_900_000_000)
    assert intake.device is None
    made += intake.turn(START_NS + 3_100_000_000)
    assert intake.device is not None
    assert intake.device.name == "raw"
    made += intake.take(reads(b"d" * 20, start_ns=START_NS + 4_000_000_000))
    assert raw(made) == b"abc" + b"d" * 20
    assert len(intake.remarks()) == 1


def test_auto_settles_at_the_end(auto: Any) -> None:
    auto.after = 4
    intake = SerialIntake("red", "", "auto")
    made = list(intake.take(reads(b"abc")))
    auto.after = 3
    made += intake.finish()
    assert intake.device is not None
    assert intake.device.name == "quads"
    assert raw(made) == b"abc"


def test_auto_over_a_gap(auto: Any) -> None:
    """Unplugged while it listens: what was half received is no frame with what comes after."""
    intake = SerialIntake("red", "", "auto")
    made = list(intake.take(reads(b"abcdEF")))
    made += intake.restart()
    made += intake.take(reads(b"ghij", start_ns=START_NS + 10**9))
    assert values(made) == [ord("a"), ord("g")]
    assert raw(made) == b"abcdEFghij"


def test_auto_that_fails_costs_no_byte(auto: Any) -> None:
    auto.broken = True
    intake = SerialIntake("red", "", "auto")
    made = list(intake.take(reads(b"abcd", b"efghijkl")))
    made += intake.turn(START_NS + 10**12)
    made += intake.restart()
    made += intake.finish()
    assert raw(made) == b"abcdefghijkl"
    assert len(intake.remarks()) == 1


def test_auto_that_hears_nothing(auto: Any) -> None:
    intake = SerialIntake("red", "", "auto")
    assert list(intake.finish()) == []
    assert counted(intake) == CaptureStatistics()


# ---- cameras


def test_frames_of_a_camera() -> None:
    intake = CameraIntake("camera", "png")
    frames = [(START_NS, b"one"), (START_NS + 5, b"three")]
    made = list(intake.take([ReceivedData(START_NS + 9, frames, 8)]))
    images: list[Any] = [each.message for each in made]
    assert [(each.topic, each.time_ns) for each in made] == [
        (intake.topic, START_NS),
        (intake.topic, START_NS + 5),
    ]
    assert [(image.data, image.format, image.frame_id) for image in images] == [
        (b"one", "png", "camera"),
        (b"three", "png", "camera"),
    ]
    assert images[1].timestamp.ToNanoseconds() == START_NS + 5
    assert intake.declared == [(intake.topic, CompressedImage)]
    assert intake.system == "dots"
    for nothing in (intake.turn(0), intake.restart(), intake.finish()):
        assert list(nothing) == []
    totals = counted(intake)
    assert (totals.bytes, totals.frames) == (8, 2)
    assert totals.samples == {intake.topic: 2}
    assert (intake.remarks(), intake.clocks(), intake.artifacts()) == ([], {}, {})
