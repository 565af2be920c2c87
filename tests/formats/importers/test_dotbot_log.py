"""PyDotBot's logs, as structlog writes them: sweeps with their times, and what is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, LocatkError, MissingDataError
from locatk.core.lighthouse import lfsr
from locatk.formats.importers.dotbot import log
from locatk.formats.importers.dotbot.log import read_dotbot_log
from locatk.formats.importers.imported_session import ImportedSession

SOURCE = "f5242ee32b1d3456"
HEAD = (
    "timestamp=2024-05-31T12:03:0{second}Z level=info logger=pydotbot event={event} "
    f"context=dotbot.controller source={SOURCE} payload_type=LH2 application=DotBot msg_id=15196 "
)
CHATTER = (
    "timestamp=2024-05-31T12:02:24.820325Z level=info logger=pydotbot "
    'event="Subscribed to /pydotbot/c3eFBBuC_AJbB==/request" context=qrkey.mqtt qos=(0,)\n'
)


def processed(second: str, polynomial: int, count: int, tick: int | None = None) -> str:
    head = HEAD.format(second=second, event="lh2-processed")
    tail = "" if tick is None else f" db_time={tick}"
    return f"{head}poly={polynomial} lfsr_index={count}{tail}\n"


def counts(second: str, first: object, other: object) -> str:
    return HEAD.format(second=second, event="lh2") + f"x=0.58 y=0.59 c0={first} c1={other}\n"


def windows(second: str, *values: tuple[int, int, int]) -> str:
    cells = (
        f"sweep_{k}_poly={polynomial} sweep_{k}_off={offset} sweep_{k}_bits={bits}"
        for k, (polynomial, offset, bits) in enumerate(values)
    )
    return HEAD.format(second=second, event="lh2-4") + " ".join(cells) + "\n"


@pytest.fixture
def read(tmp_path: Path):
    def run(*texts: str | bytes) -> ImportedSession:
        paths = []
        for number, text in enumerate(texts):
            paths.append(tmp_path / f"pydotbot{number}.log")
            paths[-1].write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_dotbot_log(paths)

    return run


def ns(text: str) -> int:
    return int(np.datetime64(text, "ns").astype(np.int64))


def test_sweeps_that_robots_decoded(read) -> None:
    text = (
        CHATTER
        + processed("8.299838", 0, 36560)
        + processed("8.321186", 3, 77623)
        + processed("8.482702", 0, 4294967288)  # a robot's -8: it found no index
        + processed("8.492035", 255, 100)
    )
    found = read(text)
    sweeps = found.sweeps
    assert sweeps.devices == (SOURCE,)
    assert sweeps.count.tolist() == [36560, 77623]
    assert sweeps.polynomial.tolist() == [0, 3]
    assert sweeps.channel.tolist() == [1, 2]
    assert sweeps.sweep.tolist() == [-1, -1]
    assert sweeps.sensor.tolist() == [0, 0]
    assert sweeps.time_ns.tolist() == [
        ns("2024-05-31T12:03:08.299838"),
        ns("2024-05-31T12:03:08.321186"),
    ]
    assert found.facts["lines"] == "5, of which 4 are records of light"
    assert found.facts["without a sweep"].startswith("2 ")
    assert [(s.channel, s.sweeps) for s in found.stations] == [(1, 1), (2, 1)]
    assert (found.warnings, found.lost, found.scene) == ([], None, None)


def test_the_robot_s_clock_dates_sweeps_that_arrived_late(read) -> None:
    """Lines in bursts, up to 30 ms late; the light was 6.844 ms apart."""
    rng = np.random.default_rng(4)
    light = np.arange(400) * 6844 + 2**32 - 100_000  # the counter wraps
    late = rng.exponential(8000, len(light)).astype(int)
    late[::7] = 0
    arrival = np.maximum.accumulate(light - light[0] + late)
    text = "".join(
        processed(f"{a / 1e6:.6f}", 0, 40000, int(tick % 2**32))
        for a, tick in zip(arrival.tolist(), light.tolist(), strict=True)
    )
    time = read(text).sweeps.time_ns
    error = (np.diff(time) - 6_844_000)[100:]
    assert np.abs(error).max() < 50_000
    assert np.abs(np.diff(arrival) * 1000 - 6_844_000).max() > 10_000_000


def test_windows_are_read_as_those_of_gateway_frames(read) -> None:
    cases = [(0, 0, 12345), (3, 7, 99999), (12, 47, 0), (31, 20, 131070)]
    bits = [int(lfsr.bits_at(count, polynomial)) for polynomial, _, count in cases]
    values = [(p, offset, b) for (p, offset, _), b in zip(cases, bits, strict=True)]
    found = read(windows("8.1", *values))
    assert found.sweeps.count.tolist() == [count for _, _, count in cases]
    assert found.sweeps.polynomial.tolist() == [0, 3, 12, 31]
    assert found.sweeps.channel.tolist() == [1, 2, 7, 16]
    # Bits before the offset are not trusted: wrong ones change nothing.
    wrong = [(p, offset, b ^ (1 << 63 if offset else 0)) for p, offset, b in values]
    assert read(windows("8.1", *wrong)).sweeps.count.tolist() == found.sweeps.count.tolist()


def test_the_gateway_and_its_log_tell_the_same_counts(read) -> None:
    """The same windows through the reader of gateway frames: one convention."""
    from locatk.formats.devices.dotbot_gateway import GatewayDecoder, encode_hdlc
    from locatk.formats.devices.interface import Options

    rng = np.random.default_rng(1)
    raw = [(int(p), int(o), int(b)) for p, o, b in zip(
        rng.integers(0, 32, 40), rng.integers(0, 48, 40), rng.integers(1, 2**63, 40), strict=True
    )]  # fmt: skip
    record = np.dtype([("bits", "<u8"), ("polynomial", "u1"), ("offset", "i1")])
    frames = b""
    for first, second in zip(raw[::2], raw[1::2], strict=True):
        body = np.array([(b, p, o) for p, o, b in (first, second)], record).tobytes()
        header = bytes(8) + int(SOURCE, 16).to_bytes(8, "little") + bytes(3) + b"\x08" + bytes(4)
        frames += encode_hdlc(header + b"\x02" + body)
    batches = GatewayDecoder(Options()).feed(frames)
    expected = next(b for b in batches if b.stream.kind == "lighthouse").columns["count"]
    text = "".join(windows("8.1", *pair) for pair in zip(raw[::2], raw[1::2], strict=True))
    assert read(text).sweeps.count.tolist() == expected.tolist()


def test_counts_without_a_station_are_of_channel_1(read) -> None:
    found = read(counts("8.1", 82189, 39797) + counts("8.2", 82190, 131071))
    assert found.sweeps.count.tolist() == [82189, 39797, 82190]
    assert found.sweeps.channel.tolist() == [1, 1, 1]
    assert found.sweeps.polynomial.tolist() == [-1, -1, -1]
    assert found.facts["channels"] == "1 (assumed)"


def test_the_same_light_told_twice_is_taken_with_its_polynomial(read) -> None:
    found = read(counts("8.1", 12345, 99999) + windows("8.1", (2, 0, int(lfsr.bits_at(12345, 2)))))
    assert found.sweeps.count.tolist() == [12345]
    assert found.sweeps.channel.tolist() == [2]
    assert "2 counts without a polynomial" in found.warnings[0]


CONSOLE = (
    "\x1b[2m2023-07-24T17:11:36.074800Z\x1b[0m [\x1b[32m\x1b[1minfo     \x1b[0m] "
    "\x1b[1mlh2-processed                 \x1b[0m [\x1b[0m\x1b[1m\x1b[34mpydotbot\x1b[0m]\x1b[0m "
    "\x1b[36mdb_time\x1b[0m=\x1b[35m376960\x1b[0m \x1b[36mlfsr_index\x1b[0m=\x1b[35m36560\x1b[0m "
    "\x1b[36mnote\x1b[0m=\x1b[35m'poly=9 is \"odd\"'\x1b[0m \x1b[36mpoly\x1b[0m=\x1b[35m5\x1b[0m "
    "\x1b[36msource\x1b[0m=\x1b[35mdefe4df80cb89ccd\x1b[0m\n"
)
JSON = (
    '{"source": "defe4df80cb89ccd", "note": "poly=9", "poly": 5, "lfsr_index": 36560, '
    '"db_time": 376960, "event": "lh2-processed", "timestamp": "2023-07-24T17:11:36.074800Z"}\n'
)
LOGFMT = (
    'timestamp=2023-07-24T17:11:36.074800Z event="lh2 \\"poly=9 lfsr_index=1\\" c0=3" '
    "source=defe4df80cb89ccd poly=5 lfsr_index=36560 db_time=376960\n"
)


@pytest.mark.parametrize("text", [CONSOLE, JSON, LOGFMT, LOGFMT.replace("\n", "\r\n")])
def test_all_renderers_of_structlog(read, text: str) -> None:
    """As structlog 25 wrote them."""
    found = read(text)
    assert found.sweeps.devices == ("defe4df80cb89ccd",)
    assert found.sweeps.count.tolist() == [36560]
    assert found.sweeps.polynomial.tolist() == [5]
    assert found.sweeps.time_ns.tolist() == [ns("2023-07-24T17:11:36.074800")]
    assert found.warnings == []


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("2023-07-24T17:11:36Z", "2023-07-24T17:11:36"),
        ("2023-07-24T17:11:36.1", "2023-07-24T17:11:36.1"),
        ('"2023-07-24 17:11:36.000001"', "2023-07-24T17:11:36.000001"),
        ("2023-07-24T19:11:36.123456789+02:00", "2023-07-24T17:11:36.123456789"),
    ],
)
def test_times(read, written: str, expected: str) -> None:
    found = read(f"timestamp={written} event=lh2 c0=1 c1=2\n")
    assert found.sweeps.time_ns.tolist() == [ns(expected)] * 2
    assert found.sweeps.devices == ("robot",)


def test_several_logs_and_robots_are_one_session(read) -> None:
    other = processed("7.5", 2, 111).replace(SOURCE, "4d788429a9a96fca")
    shared = processed("8.1", 1, 5)
    found = read(CHATTER + processed("8.0", 1, 4) + shared, other + shared, CHATTER)
    assert found.sweeps.devices == (SOURCE, "4d788429a9a96fca")
    assert found.sweeps.count.tolist() == [111, 4, 5]
    assert found.sweeps.device.tolist() == [1, 0, 0]
    assert any("1 sweeps repeat" in w for w in found.warnings)
    assert any(w.endswith("pydotbot2.log: no record of light") for w in found.warnings)
    assert found.lost is None


DAMAGED = [
    processed("8.1", 1, 4).replace("lfsr_index=4", "lfsr_index=4x"),
    processed("8.1", 1, 4).replace("lfsr_index=4", "lfsr_index="),
    processed("8.1", 1, 4).replace("lfsr_index=4", f"lfsr_index={'9' * 5000}"),
    processed("8.1", 1, 4).replace("poly=1 ", ""),
    processed("8.1", 1, 4, 2**32),
    processed("8.1", 1, 4, -1),
    processed("8.1", 1, 4).replace("05-31T", "02-30T"),
    processed("8.1", 1, 4).replace("timestamp", "time"),
    processed("8.1", 1, 4).replace("2024-05-31T12:03:08.1", "2262-04-11T23:47:16.9"),
    processed("8.1", 1, 4).replace("2024-05-31T", "1677-05-31T"),
    processed("8.1", 1, 4).replace(SOURCE, "\x07"),
    processed("8.1", 1, 4).replace(SOURCE, "a" * 65),
    counts("8.1", 1.5, 2),
    counts("8.1", 1, 2).replace(" c1=2", ""),
    windows("8.1", (1, 0, 5), (1, 0, 2**64)),
    windows("8.1", (1, 0, 5)).replace("sweep_0_off=0 ", ""),
    processed("8.1", 1, 4)[:-1],
]


@pytest.mark.parametrize("line", DAMAGED)
def test_damaged_records_are_named_with_their_line(read, line: str) -> None:
    found = read(CHATTER + processed("8.0", 0, 1) + line)
    assert found.sweeps.count[0] == 1
    assert found.lost == "1 of 2 records are damaged"
    assert "pydotbot0.log:3: " in found.warnings[0]
    assert len(found.warnings[0]) < 300


def test_many_damaged_records_are_told_in_short(read) -> None:
    found = read(processed("8.0", 0, 1) + DAMAGED[0] * 1000)
    assert len(found.warnings) == 5
    assert found.lost == "1000 of 1001 records are damaged"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n\n",
        CHATTER.encode() * 3,
        bytes(range(256)) * 50,
        b"c0" * 200_000,
        b'a="c0 ' * 200_000,
        b"{" * 5000 + b'"c0": 1}\n',
        b'{"c0": ' + b"[" * 10_000 + b"\n",
        b'{"c0": "\\ud800", "c1": 1}\n',
        b"[1, 2, {}]\nc0\n",
        processed("8.1", 255, 4).encode(),
        windows("8.1", (1, 0, 0)).encode(),
        DAMAGED[0].encode(),
    ],
    ids=lambda content: repr(content[:20]),
)
def test_files_without_a_sweep(read, content: bytes) -> None:
    with pytest.raises(FormatError, match="no sweep in the log") as refused:
        read(content)
    assert "pydotbot0.log" in str(refused.value)
    assert refused.value.hint


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        read_dotbot_log([])
    with pytest.raises(MissingDataError, match="no such file"):
        read_dotbot_log([tmp_path / "pydotbot.log"])
    with pytest.raises(LocatkError, match="a folder"):
        read_dotbot_log([tmp_path])


WHOLE = (
    CHATTER
    + processed("8.1", 0, 36560, 376960)
    + counts("8.2", 82189, 39797)
    + windows("8.3", (2, 3, 12345678901234567890), (3, 0, 987654321))
    + CONSOLE
    + JSON
).encode()


def test_a_line_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "MAX_SKIPPED_LINE_BYTES", 1 << 20)
    path = tmp_path / "zeros.log"
    path.write_bytes(WHOLE + bytes(1 << 19) + b"\n" + WHOLE)
    assert len(read_dotbot_log([path]).sweeps)
    path.write_bytes(WHOLE + bytes(1 << 21))
    with pytest.raises(FormatError, match="a line of more than 1 MiB"):
        read_dotbot_log([path])


@pytest.mark.slow
@settings(deadline=None, max_examples=90)
@given(st.data())
def test_damaged_logs_give_an_error_or_sweeps(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(WHOLE)
    for _ in range(data.draw(st.integers(0, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    cut = data.draw(st.integers(0, len(content)))
    path = tmp_path_factory.getbasetemp() / "damaged.log"
    path.write_bytes(content[:cut] + data.draw(st.binary(max_size=20)))
    try:
        found = read_dotbot_log([path])
    except LocatkError:
        return
    assert np.all((found.sweeps.count >= 0) & (found.sweeps.count < lfsr.SEQUENCE_LENGTH))
    assert np.all((found.sweeps.channel >= 1) & (found.sweeps.channel <= 16))
    assert np.all(np.diff(found.sweeps.time_ns) >= 0)


def test_slots_give_planes(read) -> None:
    """Slot 1 holds the first plane; a lone sweep in it is one of the first plane, too."""
    lines = []
    for k in range(20):
        for slot, count in ((1, 36560 + k), (0, 77623 + k)):
            if slot or k < 15:
                second = f"{1 + 0.1 * k + 0.007 * (1 - slot):.6f}"
                lines.append(processed(second, 0, count).rstrip() + f" sweep={slot}\n")
    sweeps = read("".join(lines)).sweeps
    assert sweeps.sweep.tolist() == [0, 1] * 15 + [0] * 5
    damaged = read("".join(lines) + lines[0].replace("sweep=1", "sweep=999"))
    assert any("sweep is 999" in warning for warning in damaged.warnings)
    assert damaged.lost is not None
