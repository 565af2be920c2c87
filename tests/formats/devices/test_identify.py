"""Which device speaks, told from its first bytes: all devices against each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.trajectory import Trajectory
from locatk.formats.devices import DEVICES, Device
from locatk.formats.devices import identification as identify
from locatk.formats.devices.identification import (
    MAX_BYTES,
    Identifier,
    Verdict,
)
from locatk.formats.devices.interface import Batch, Counts, Options, Recording, Stream

START_NS = 1_760_000_000_000_000_000


def magnetometers(sensors: int, seed: int) -> Recording:
    """Fields that wander, each sensor with an offset, in the counts of the part."""
    rng = np.random.default_rng(seed)
    offset = rng.normal(0, 60, (sensors, 3))
    way = np.cumsum(rng.normal(0, 1, (200, sensors, 3)), axis=0) + rng.normal(0, 0.5, 3)
    quantum = np.array([0.15, 0.15, 0.242])
    field_ut = np.rint((offset + way) / quantum) * quantum
    time_ns = START_NS + np.arange(200) * 10_000_000
    array = SensorArray(bar(sensors, 0.02))
    return Recording(samples=[Samples("bar", array, time_ns, field_ut * 1e-6)])


def halls(seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    heading = np.linspace(0, 3, 60)
    place = np.column_stack([np.cos(heading), np.sin(heading), 0 * heading])
    unknown = np.full((60, 6, 6), np.nan)
    pose_ns = START_NS + np.arange(60) * 30_000_000
    quaternion = quaternion_from_heading(heading)
    field_t = rng.normal(0, 1e-3, (180, 4))
    sensor_ns = START_NS + np.arange(180) * 10_000_000
    return Recording(
        halls=[HallSamples("robot", HallSensors(), sensor_ns, field_t)],
        odometry=[Trajectory("robot", "odometry", pose_ns, place, quaternion, unknown)],
    )


def sweeps(sensors: int, seed: int) -> Recording:
    """Two stations on a few photodiodes."""
    rng = np.random.default_rng(seed)
    turn, channel, sweep, sensor = (
        grid.ravel()
        for grid in np.meshgrid(range(60), (1, 4), (0, 1), range(sensors), indexing="ij")
    )
    count = np.rint(20_000 + 40_000 * sweep + 300 * channel + 15 * sensor + 200 * np.sin(turn / 20))
    count += rng.integers(0, 3, len(count))
    time_ns = START_NS + turn * np.where(channel == 1, 19_979_167, 19_854_167)
    time_ns = time_ns + np.rint(count / 6e6 * 1e9).astype(np.int64)
    order = np.argsort(time_ns, kind="stable")
    columns = (np.zeros_like(turn), sensor, channel, 2 * (channel - 1), sweep)
    ints = [column[order].astype(np.int32) for column in columns]
    return Recording(sweeps=Sweeps(("drone",), time_ns[order], *ints, count[order]))


RECORDINGS: dict[str, Callable[[int], Recording]] = {
    "nine magnetometers": lambda seed: magnetometers(9, seed),
    "three magnetometers": lambda seed: magnetometers(3, seed),
    "eight magnetometers": lambda seed: magnetometers(8, seed),
    "halls": halls,
    "sweeps of four": lambda seed: sweeps(4, seed),
    "sweeps of one": lambda seed: sweeps(1, seed),
}

BOOT = (
    b"ESP-ROM:esp32s3-20210327\r\nBuild:Mar 27 2021\r\nrst:0x1 (POWERON),boot:0x8\r\n"
    b"I (27) boot: ESP-IDF v5.1\r\nI (30) heap: 123456 free\r\nMLX90393 found\r\n"
) * 4


def sent(name: str, seed: int = 0) -> Iterator[tuple[str, list[bytes]]]:
    """What a device sends of each recording that it can tell."""
    for what, make in RECORDINGS.items():
        try:
            yield what, [frame for _, frame in DEVICES[name].encode(make(seed))]
        except InputError:
            continue


def fed(pieces: list[bytes], **known: Any) -> Identifier:
    """An identifier that received the pieces, each after a pause, until it was certain."""
    identifier = Identifier(**known)
    for piece in pieces:
        identifier.feed(piece, pause=True)
        if identifier.verdict() is not None:
            break
    return identifier


def listen(pieces: list[bytes], **known: Any) -> Verdict:
    """The verdict, each piece after a pause."""
    return fed(pieces, **known).settle()


def cut(pieces: list[bytes], size: int) -> list[bytes]:
    data = b"".join(pieces)
    return [data[i : i + size] for i in range(0, len(data), size)]


def damaged(pieces: list[bytes], seed: int) -> list[bytes]:
    """One byte in 500 is another one."""
    rng = np.random.default_rng(seed)
    out = []
    for piece in pieces:
        data = np.frombuffer(piece, np.uint8).copy()
        hit = rng.random(len(data)) < 0.002
        data[hit] ^= np.uint8(1) << rng.integers(0, 8, np.count_nonzero(hit)).astype(np.uint8)
        out.append(data.tobytes())
    return out


SENDERS = sorted(name for name, device in DEVICES.items() if device.encoder)


@pytest.mark.slow
@pytest.mark.parametrize("name", SENDERS)
def test_no_device_is_taken_for_another(name: str) -> None:
    """The table of confusion; the devices are the rows, what is done to the bytes the columns."""
    told = 0
    for what, pieces in sent(name, 0):
        told += 1
        forms = {
            "whole": pieces,
            "from within a frame": [pieces[0][7:], *pieces[1:]],
            "after a boot": [BOOT, *pieces],
            "damaged": damaged(pieces, 0),
            "short": pieces[:12],
            "in large reads": cut(pieces, 3000),
        }
        found = {form: listen(each).device for form, each in forms.items()}
        assert found == dict.fromkeys(forms, name), what
    assert told


@pytest.mark.slow
@pytest.mark.parametrize("name", SENDERS)
def test_clean_frames_are_sure_soon(name: str) -> None:
    for _, pieces in sent(name):
        identifier, heard = Identifier(), 0
        while identifier.verdict() is None:
            identifier.feed(pieces.pop(0), pause=True)
            heard += 1
        verdict = identifier.verdict()
        assert verdict is not None
        assert heard <= 50
        assert verdict.device == name


@pytest.mark.slow
@pytest.mark.parametrize("name", SENDERS)
def test_pieces_do_not_matter(name: str) -> None:
    for what, pieces in sent(name):
        for size in (20, 1 << 20):
            assert listen(cut(pieces, size)[:1000]).device == name, (what, size)


def noise(kind: str) -> bytes:
    rng = np.random.default_rng(7)
    made: dict[str, Callable[[], bytes]] = {
        "random": lambda: rng.bytes(30_000),
        "zeros": lambda: bytes(30_000),
        "ones": lambda: b"\xff" * 30_000,
        "sparse": lambda: bytes(rng.integers(0, 4, 30_000, dtype=np.uint8)),
        "counters": lambda: np.arange(7500, dtype="<u4").tobytes(),
        "int16": lambda: np.cumsum(rng.integers(-3, 4, 15_000)).astype("<i2").tobytes(),
        "no line ends": lambda: bytes(rng.integers(32, 127, 30_000, dtype=np.uint8)),
        "other floats": lambda: magnetometers(5, 1).samples[0].field_t.astype("<f4").tobytes(),
        "framed floats": lambda: b"".join(
            b"\xaa\x55" + row.tobytes() + b"\x01"
            for row in (magnetometers(9, 1).samples[0].field_t * 1e6).astype("<f4")
        ),
        "zeros and syncs": lambda: (bytes(1200) + b"\xff" * 12) * 20,
    }
    return made[kind]()


@pytest.mark.slow
@pytest.mark.parametrize("boot", [b"", BOOT])
@pytest.mark.parametrize(
    "kind",
    [
        "random",
        "zeros",
        "ones",
        "sparse",
        "counters",
        "int16",
        "no line ends",
        "other floats",
        "framed floats",
        "zeros and syncs",
    ],
)
def test_what_fits_no_device_stays_raw(kind: str, boot: bytes) -> None:
    verdict = listen(cut([boot + noise(kind)], 300))
    assert verdict.device == "raw"
    assert verdict.why.endswith("--baud")


@pytest.mark.parametrize(
    "text",
    [
        BOOT * 20,
        b"".join(
            b"$GPGGA,%06d.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M*47\r\n" % i for i in range(200)
        ),
        b"".join(b'{"t": %d, "v": %d}\n' % (i, i % 7) for i in range(200)),
        b"Hello world\n",
    ],
)
def test_words_are_lines_when_nothing_else_comes(text: bytes) -> None:
    """Each device may print a few words before it begins."""
    identifier = Identifier()
    for piece in cut([text], 200):
        identifier.feed(piece)
        assert identifier.verdict() is None
    verdict = identifier.settle()
    assert verdict.device == "lines"
    assert verdict is identifier.verdict() is identifier.settle()
    identifier.feed(b"more")
    assert len(identifier._data) == len(text)


def test_reasons_for_raw() -> None:
    assert Identifier().settle() == Verdict("raw", "no bytes received")
    assert "all 50 bytes are 0x00: check the wiring" in listen([bytes(50)]).why
    assert "50 bytes match no known device" in listen([np.random.default_rng(0).bytes(50)]).why


def test_so_many_bytes_are_enough() -> None:
    identifier = Identifier()
    identifier.feed(np.random.default_rng(1).bytes(MAX_BYTES + 50_000))
    verdict = identifier.verdict()
    assert verdict is not None
    assert verdict.device == "raw"
    assert len(identifier._data) == MAX_BYTES


# ---- devices of other packages


@dataclass
class Fake:
    """A decoder of frames of ``size`` bytes that begin with ``start``."""

    start: bytes
    size: int
    fails: str = ""
    doubts: tuple[str, ...] = ()
    counts: Counts = field(default_factory=Counts)
    data: bytes = b""

    def __post_init__(self) -> None:
        self.remarks = list(self.doubts)

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        if self.fails == "feed":
            raise ValueError("no")
        self.counts.bytes += len(data)
        self.data += data
        ends = []
        while len(self.data) >= self.size:
            if self.data.startswith(self.start):
                self.data = self.data[self.size :]
                ends.append(self.counts.bytes - len(self.data))
            else:
                self.data = self.data[1:]
                self.counts.skipped += bool(self.counts.frames or ends)
        self.counts.frames += len(ends)
        value = {"value": np.zeros((len(ends), 1))}
        end = np.array(ends, np.int64)
        return [Batch(Stream("readings", names=("v",)), end, value)] if ends else []

    def restart(self) -> list[Batch]:
        return []

    def finish(self) -> list[Batch]:
        if self.fails == "finish":
            raise ValueError("no")
        return []


@dataclass(frozen=True)
class Other(Device):
    """A device of another package."""

    fake: tuple[Any, ...] = ()

    def create_decoder(self, options: Options) -> Fake:
        if self.fake[2:3] == ("decode",):
            raise ValueError("no")
        return Fake(*self.fake)


def other(name: str, *fake: Any) -> Other:
    return Other(name, "", 9600, "", fake=fake)


def framed(frames: int) -> list[bytes]:
    rng = np.random.default_rng(2)
    return [b"\xaa\x55" + rng.bytes(18) for _ in range(frames)]


def test_devices_of_other_packages() -> None:
    devices = [*DEVICES.values(), other("theirs", b"\xaa\x55", 20)]
    for frames, is_certain in ((100, True), (8, False)):
        identifier = fed(framed(frames), devices=devices)
        assert (identifier.verdict() is not None) == is_certain
        assert identifier.settle().device == "theirs"
    assert listen(framed(3), devices=devices).device == "raw"


@pytest.mark.slow
def test_a_decoder_that_takes_everything_is_not_believed() -> None:
    devices = [*DEVICES.values(), other("all", b"", 10)]
    assert listen(framed(100), devices=devices).device == "raw"
    for name in SENDERS:
        for _, pieces in sent(name):
            assert listen(pieces, devices=devices).device == name


def test_a_decoder_that_doubts_is_not_sure() -> None:
    device = other("theirs", b"\xaa\x55", 20, "", ("which is which?",))
    identifier = fed(framed(100), devices=[device])
    assert identifier.verdict() is None
    assert identifier.settle().device == "theirs"


@pytest.mark.slow
@pytest.mark.parametrize("where", ["decode", "feed", "finish"])
def test_a_decoder_that_fails_does_no_harm(where: str) -> None:
    devices = [other("theirs", b"\xaa\x55", 20, where), *DEVICES.values()]
    for name in ("locatk", "lines"):
        assert all(listen(p, devices=devices).device == name for _, p in sent(name))
    verdict = listen([bytes(100)], devices=devices)
    assert verdict.device == "raw"
    assert verdict.why.endswith("the decoder of theirs failed (ValueError: no)")


def test_entry_points(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass
    class Entry:
        name: str
        found: Device | None

        def load(self) -> Device:
            if self.found is None:
                raise ImportError("gone")
            return self.found

    theirs = Entry("theirs", other("theirs", b"\xaa\x55", 20))
    entries = [Entry("broken", None), theirs, Entry("lines", other("lines", b"", 1))]
    monkeypatch.setattr(identify, "entry_points", lambda group: entries)
    assert listen(framed(100)).device == "theirs"
    assert listen([b"Hello\n"]).device == "lines"
    assert "the decoder of broken failed (ImportError: gone)" in listen([bytes(9)]).why


def test_options_reach_the_decoders() -> None:
    columns = ("u", "v")
    identifier = Identifier(Options(columns))
    identifier.feed(b"\n" + b"1,2\n" * 40)
    assert identifier.verdict() == Verdict(
        "lines", "40 lines in the first 161 bytes, 100% of the bytes since the first one"
    )
