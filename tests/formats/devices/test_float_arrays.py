"""Polaris and MagX: bare floats become samples, from any byte on, whatever gets lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.polaris import mlx90393
from locatk.core.polaris.array import Samples
from locatk.formats.artifacts.tags import loads_array
from locatk.formats.devices import find_device
from locatk.formats.devices.float32.decoder import (
    MagxDecoder,
    PolarisDecoder,
    encode_magx,
    encode_polaris,
    polaris_artifacts,
)
from locatk.formats.devices.interface import Batch, Decoder, Options, Recording, Stream
from locatk.formats.importers.polaris_csv import read_polaris

COUNT_UT = np.array([0.150, 0.150, 0.242])
NOISE_UT = np.array([0.86, 0.89, 1.24])

Make = Callable[[Options], Decoder]
Kind = tuple[Make, int, int]
"""A decoder, the sensors and the floats of a frame."""

KINDS: dict[str, Kind] = {
    "nine": (PolarisDecoder, 9, 27),
    "three": (PolarisDecoder, 3, 9),
    "magx": (MagxDecoder, 8, 25),
}


def bar(n: int, sensors: int = 9, seed: int = 0, offset_ut: float = 25.0) -> np.ndarray:
    """(n, 3 sensors) float32 of a bar that stands still, in counts of its parts."""
    rng = np.random.default_rng(seed)
    field = rng.normal([10, -5, 40], offset_ut, (sensors, 3))
    noisy = field + rng.normal(size=(n, sensors, 3)) * NOISE_UT
    return (np.rint(noisy / COUNT_UT) * COUNT_UT).astype("<f4").reshape(n, -1)


def to_bytes(values: np.ndarray, spare: float | None = None) -> bytes:
    if spare is not None:
        values = np.column_stack([values, np.full(len(values), spare)])
    return values.astype("<f4").tobytes()


def tesla(values: np.ndarray) -> np.ndarray:
    """Float32 of the parts, in microtesla, as the array's tesla."""
    parts = values.astype(float).reshape(len(values), -1, 3)
    return (parts[:, :, [1, 0, 2]] * -1e-6).reshape(len(values), -1)


def starts(length: int, size: int, after: int = 0) -> list[int]:
    """Where frames start and the line was silent before, in a stream cut at ``after``."""
    return [p - after for p in range(0, length, size) if p >= after]


def decode(
    data: bytes,
    pauses: Iterable[int] = (),
    cuts: Iterable[int] = (),
    make: Make = PolarisDecoder,
    restarts: Sequence[int] = (),
) -> tuple[Decoder, list[Batch]]:
    decoder = make(Options())
    silent = set(pauses)
    places = {0, len(data), *silent, *cuts, *restarts}
    edges = sorted(place for place in places if 0 <= place <= len(data))
    batches: list[Batch] = []
    for begin, end in pairwise(edges):
        if begin in restarts:
            batches += decoder.restart()
        batches += decoder.feed(data[begin:end], pause=begin in silent)
    return decoder, batches + decoder.finish()


def fields(batches: list[Batch]) -> np.ndarray:
    return np.concatenate([batch.columns["b_tesla"] for batch in batches])


def ends(batches: list[Batch]) -> np.ndarray:
    return np.concatenate([batch.end for batch in batches])


def order(found: np.ndarray, true: np.ndarray) -> list[int]:
    """Which of the true frames each found one is; -1 for none."""
    index = {row.tobytes(): k for k, row in enumerate(true)}
    return [index.get(row.tobytes(), -1) for row in found]


@pytest.fixture(scope="module")
def runs(data: Path) -> list[Samples]:
    """The published recordings of the bar of nine."""
    files = sorted(data.glob("polaris/*/RawData_*.csv"))
    if not files:
        pytest.skip(f"no recordings of Polaris in {data}")
    return [read_polaris(path, rate_hz=40, spacing_m=0.02).samples for path in files]


@pytest.fixture(scope="module")
def published(runs: list[Samples]) -> list[np.ndarray]:
    """The same as float32 of the parts."""
    streams = [b"".join(frame for _, frame in encode_polaris(Recording([run]))) for run in runs]
    return [np.frombuffer(stream, "<f4").reshape(-1, 27) for stream in streams]


def of_kind(published: list[np.ndarray], kind: str) -> list[tuple[np.ndarray, bytes]]:
    """Recordings as another device would have sent them, from some seconds before the
    magnets on: what is right, and the bytes."""
    published = [values[150:] for values in published]
    if kind == "nine":
        return [(values, to_bytes(values)) for values in published]
    if kind == "three":
        return [(values[:, 9:18], to_bytes(values[:, 9:18])) for values in published]
    return [(values[:, :24], to_bytes(values[:, :24], 0.0)) for values in published]


# ---- whole streams


def test_published_recordings_come_back_as_they_were_imported(runs: list[Samples]) -> None:
    for run in runs:
        sent = list(encode_polaris(Recording([run])))
        assert [time for time, _ in sent] == run.time_ns.tolist()
        decoder, batches = decode(b"".join(frame for _, frame in sent))
        assert {batch.stream for batch in batches} == {Stream("magnetometers", sensors=9)}
        assert all(batch.tick is None for batch in batches)
        np.testing.assert_array_equal(ends(batches), 108 * np.arange(1, len(run) + 1))
        np.testing.assert_allclose(
            fields(batches), run.field_t.reshape(len(run), -1), rtol=1e-7, atol=0
        )
        assert (decoder.counts.frames, decoder.counts.bad, decoder.counts.skipped) == (
            len(run),
            0,
            0,
        )
        (remark,) = decoder.remarks
        assert "assumed from the first received byte" in remark


def test_axes_are_the_arrays() -> None:
    values = bar(40)
    values[:, :3] += np.float32([150.0, 300.0, 484.0])
    _, batches = decode(to_bytes(values))
    x, y, z = values[7, :3].astype(float)
    assert fields(batches)[7, :3].tolist() == pytest.approx([-y * 1e-6, -x * 1e-6, -z * 1e-6])


@pytest.mark.slow
def test_any_start_is_right_where_the_line_pauses(published: list[np.ndarray]) -> None:
    for k, values in enumerate(published):
        data, true = to_bytes(values), tesla(values)
        start = 108 * k + 12 if k % 2 else 9 * k + 1
        decoder, batches = decode(data[start:], starts(len(data), 108, start))
        np.testing.assert_array_equal(fields(batches), true[-(-start // 108) :])
        assert decoder.remarks == []
        assert (decoder.counts.bad, decoder.counts.skipped) == (0, 0)


@pytest.mark.slow
def test_three_sensors_are_told_from_nine(published: list[np.ndarray]) -> None:
    for values, data in of_kind(published, "three")[::2]:
        _, batches = decode(data)
        np.testing.assert_array_equal(fields(batches), tesla(values))
        assert {batch.stream.sensors for batch in batches} == {3}
        decoder, batches = decode(data[77:], starts(len(data), 36, 77))
        np.testing.assert_array_equal(fields(batches), tesla(values)[3:])
        assert decoder.remarks == []


@pytest.mark.slow
@pytest.mark.parametrize("spare", [0.0, 3.7, -6.2598534e18], ids=["zero", "volts", "garbage"])
def test_magx_is_right_from_any_byte_without_pauses(
    published: list[np.ndarray], spare: float
) -> None:
    for values in published[::3]:
        data, true = to_bytes(values[:, :24], spare), tesla(values[:, :24])
        for start in (0, 1, 4, 57, 100, 263):
            decoder, batches = decode(data[start:], make=MagxDecoder)
            np.testing.assert_array_equal(fields(batches), true[-(-start // 100) :])
            assert decoder.remarks == []


def test_magx_whose_spare_float_changes() -> None:
    values = bar(120, 8)
    volts = 3.7 + np.arange(120) * 1e-3
    data = to_bytes(np.column_stack([values, volts]))
    decoder, batches = decode(data[30:], make=MagxDecoder)
    np.testing.assert_array_equal(fields(batches), tesla(values)[1:])
    assert decoder.remarks == []


# ---- which sensor is the first


@pytest.mark.parametrize("start", [1, 4, 50, 103])
def test_start_within_a_frame_without_pauses_is_a_guess(start: int) -> None:
    decoder, batches = decode(to_bytes(bar(80))[start:])
    assert len(fields(batches)) >= 78
    (remark,) = decoder.remarks
    assert "is a guess" in remark


def test_pauses_that_come_later_correct_the_first_byte() -> None:
    values = bar(200)
    data = to_bytes(values)[24:]
    pauses = [p for p in starts(len(data) + 24, 108, 24) if p > 100 * 108]
    decoder, batches = decode(data, pauses)
    found = order(fields(batches), tesla(values))
    assert found[-95:] == list(range(105, 200))
    assert "assumed from the first received byte" in decoder.remarks[0]
    assert "in a wrong order" in decoder.remarks[1]


@pytest.mark.parametrize("seed", range(5))
def test_false_pauses_are_outvoted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = bar(200, seed=seed)
    data = to_bytes(values)
    stalls = rng.integers(1, len(data) - 30, 40).tolist()
    decoder, batches = decode(data[30:], [*starts(len(data), 108, 30)[::3], *stalls])
    np.testing.assert_array_equal(fields(batches), tesla(values)[1:])
    assert decoder.remarks == []
    # Alone, they name no place.
    decoder, batches = decode(data, stalls)
    np.testing.assert_array_equal(fields(batches), tesla(values))
    assert "assumed from the first received byte" in decoder.remarks[0]


def test_pauses_in_each_frame_at_the_border_of_usb_packets() -> None:
    values = bar(100)
    data = to_bytes(values)
    frames = starts(len(data), 108, 20)
    decoder, batches = decode(data[20:], [*frames, *(p + 64 for p in frames)])
    np.testing.assert_array_equal(fields(batches), tesla(values)[1:])
    assert decoder.remarks == []


def test_sensors_that_measure_alike_are_told_by_pauses_only() -> None:
    values = bar(200, offset_ut=0.0)
    data, true = to_bytes(values), tesla(values)
    decoder, batches = decode(data)
    np.testing.assert_array_equal(fields(batches), true)
    assert "such similar values" in decoder.remarks[0]
    decoder, batches = decode(data[50:], starts(len(data), 108, 50))
    np.testing.assert_array_equal(fields(batches), true[1:])
    assert decoder.remarks == []
    three = to_bytes(values[:, :9])
    decoder, batches = decode(three, starts(len(three), 36))
    np.testing.assert_array_equal(fields(batches), true[:, :9])
    assert decoder.remarks == []


def test_loss_among_sensors_that_measure_alike() -> None:
    values = bar(200, offset_ut=0.0)
    data, true = to_bytes(values), tesla(values)
    cut = 100 * 108 + 30
    damaged = data[:cut] + data[cut + 7 :]
    pauses = [p if p < cut else p - 7 for p in starts(len(data), 108)]
    decoder, batches = decode(damaged, pauses)
    assert order(fields(batches), true) == [*range(100), *range(101, 200)]
    assert decoder.remarks == []
    decoder, batches = decode(damaged)
    assert order(fields(batches), true)[:100] == list(range(100))
    assert "is a guess" in decoder.remarks[-1]


# ---- damage


def hit(data: bytes, size: int, kind: str, rng: np.random.Generator) -> tuple[bytes, int, int]:
    """Lose or add up to a frame of bytes anywhere; where, and how many were lost."""
    at, n = int(rng.integers(2 * size, len(data) - 6 * size)), int(rng.integers(1, size))
    if kind == "lose":
        return data[:at] + data[at + n :], at, n
    return data[:at] + rng.bytes(n) + data[at:], at, -n


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lose", "add"])
@pytest.mark.parametrize("device", KINDS)
def test_lost_and_added_bytes(published: list[np.ndarray], device: str, kind: str) -> None:
    """All frames that were not touched come, but for one in some cases; no wrong one, but
    for what values cannot tell."""
    make, _, floats = KINDS[device]
    size = 4 * floats
    recordings = of_kind(published, device)
    late: Counter[int] = Counter()
    wrong = 0
    events = 2 * len(recordings)
    for seed in range(events):
        rng = np.random.default_rng(seed)
        values, data = recordings[seed % len(recordings)]
        damaged, at, lost = hit(data, size, kind, rng)
        pauses: list[int] = []
        if device == "three" or seed % 2:
            # Three sensors over magnets do not tell enough without.
            pauses = [p if p <= at else max(at, p - lost) for p in starts(len(data), size)]
        decoder, batches = decode(damaged, pauses, make=make)
        found = order(fields(batches), tesla(values))
        touched = set(range(at // size, (at + max(lost, 1) - 1) // size + 1))
        late[len(set(range(len(values))) - touched - set(found))] += 1
        wrong += found.count(-1)
        right = [k for k in found if k >= 0]
        assert right == sorted(set(right))
        counts = decoder.counts
        assert counts.frames == len(found)
        assert size * counts.frames + counts.skipped == len(damaged)
        assert counts.bad <= 1
    # Three sensors over magnets wait until the field is as it was.
    assert max(late) <= (12 if device == "three" else 2)
    assert late[0] >= (0.7 if device == "three" else 0.85) * events
    assert wrong <= (2 if device == "three" else 1)


@pytest.mark.slow
def test_bytes_lost_all_the_time(published: list[np.ndarray]) -> None:
    rng = np.random.default_rng(7)
    whole = got = wrong = 0
    for values in published:
        data = np.frombuffer(to_bytes(values), np.uint8)
        kept = rng.random(len(data)) > 1e-3
        kept[: 8 * 108] = True
        _, batches = decode(data[kept].tobytes())
        found = order(fields(batches), tesla(values))
        whole += int(kept.reshape(-1, 108).all(axis=1).sum())
        got += len(found) - found.count(-1)
        wrong += found.count(-1)
    assert got >= 0.99 * whole
    assert wrong <= 3


@pytest.mark.slow
def test_flipped_bits_become_no_number_where_they_can_be_noticed(
    published: list[np.ndarray],
) -> None:
    rng = np.random.default_rng(3)
    missed = 0
    for k in range(30):
        values = published[k % len(published)][:150]
        data = bytearray(to_bytes(values))
        at = int(rng.integers(40 * 108, len(data) - 3 * 108))
        data[at] ^= 1 << int(rng.integers(8))
        decoder, batches = decode(bytes(data))
        found, true = fields(batches), tesla(values)
        row, column = at // 108, at % 108 // 4
        other = np.ones(true.shape, bool)
        other[row, 3 * (column // 3) : 3 * (column // 3) + 3] = False
        np.testing.assert_array_equal(found[other], true[other])
        assert np.isnan(found[row]).sum() <= 1
        missed += bool(np.nanmax(np.abs(found[row] - true[row])) > 1e-9)
        assert (decoder.counts.bad, decoder.counts.skipped) == (0, 0)
    assert missed <= 0.08 * 30


def test_a_single_value_that_cannot_be_is_left_out() -> None:
    values = bar(100)
    true = tesla(values)
    values[60, 13] = 1e30
    values[70, 4] = -values[70, 4] - 3000
    values[80, 7] += 0.07
    decoder, batches = decode(to_bytes(values))
    for row, column in ((60, 12), (70, 3), (80, 6)):
        true[row, column] = np.nan
    np.testing.assert_array_equal(fields(batches), true)
    assert decoder.counts.bad == 0
    assert "left out, from byte 6480 on" in decoder.remarks[-1]
    assert len(decoder.remarks) == 2


def test_a_burst_makes_the_frame_bad() -> None:
    values = bar(100)
    data = bytearray(to_bytes(values))
    data[60 * 108 + 20 : 60 * 108 + 60] = np.random.default_rng(1).bytes(40)
    decoder, batches = decode(bytes(data))
    assert order(fields(batches), tesla(values)) == [*range(60), *range(61, 100)]
    assert (decoder.counts.bad, decoder.counts.skipped) == (1, 108)


def test_all_values_may_leap() -> None:
    values = bar(200)
    leap = np.random.default_rng(2).integers(-400, 400, 9)
    moved = np.rint(values[100:].reshape(-1, 9, 3) / COUNT_UT) + leap[:, None]
    values[100:] = (moved * COUNT_UT).reshape(-1, 27)
    decoder, batches = decode(to_bytes(values))
    np.testing.assert_array_equal(fields(batches), tesla(values))
    assert len(decoder.remarks) == 1


@pytest.mark.slow
def test_damage_in_the_first_frames() -> None:
    values = bar(120)
    data, true = to_bytes(values), tesla(values)
    for at in range(130, 900, 35):
        decoder, batches = decode(data[:at] + data[at + 36 :])
        found = order(fields(batches), true)
        # One float of another sensor may be close to what is expected.
        assert found.count(-1) <= 1
        assert len(found) >= 116
        assert found[-110:] == list(range(10, 120))
        assert "assumed from the first received byte" in decoder.remarks[0]


# ---- odd sensors


@pytest.mark.parametrize("stuck", [0.0, np.nan, 45.0])
def test_a_sensor_that_always_says_the_same(stuck: float) -> None:
    values = bar(120)
    values[:, 12:15] = stuck
    data = to_bytes(values)
    _, batches = decode(data)
    np.testing.assert_array_equal(fields(batches), tesla(values))
    _, batches = decode(data[40:], starts(len(data), 108, 40))
    np.testing.assert_array_equal(fields(batches), tesla(values)[1:])


def test_saturated_sensors_say_no_number_for_a_while() -> None:
    values = bar(120)
    values[50:80, 3:9] = np.nan
    decoder, batches = decode(to_bytes(values))
    np.testing.assert_array_equal(fields(batches), tesla(values))
    assert decoder.counts.bad == 0


def test_a_sensor_that_never_makes_sense_is_left_out() -> None:
    values = bar(120)
    values[:, 4] = 1e30
    decoder, batches = decode(to_bytes(values))
    found = fields(batches)
    assert np.isnan(found[:, 3]).all()
    assert np.isnan(found).sum() == 120
    assert "left out, from byte 0 on" in decoder.remarks[-1]


def test_values_that_are_no_counts() -> None:
    values = bar(120) + np.random.default_rng(4).normal(size=(120, 27)).astype("f4")
    true = tesla(values)
    _, batches = decode(to_bytes(values))
    np.testing.assert_array_equal(fields(batches), true)
    data = to_bytes(values)
    _, batches = decode(data[:5000] + data[5050:])
    found = order(fields(batches), true)
    assert -1 not in found
    assert len(found) == 119


# ---- no arrays at all


@pytest.mark.slow
@pytest.mark.parametrize("make", [PolarisDecoder, MagxDecoder])
@pytest.mark.parametrize(
    "piece",
    [
        np.random.default_rng(0).bytes(20_000),
        bytes(20_000),
        b"\xff" * 20_000,
        b"12.5,-3.25,40.1\r\n" * 1200,
        to_bytes(np.zeros((200, 27))),
    ],
    ids=["random", "zeros", "ones", "text", "zero fields"],
)
def test_garbage_gives_nothing_and_is_not_kept(make: Make, piece: bytes) -> None:
    decoder = make(Options())
    for _ in range(5):
        assert decoder.feed(piece, pause=True) == []
    assert decoder.feed(b"\0") == []
    kept = vars(decoder)
    assert len(kept["_data"]) < 5000
    assert len(kept["_pauses"]) < 5
    assert decoder.finish() == []
    assert (decoder.counts.frames, decoder.counts.bad, decoder.counts.skipped) == (0, 0, 0)
    (remark,) = decoder.remarks
    assert "no samples" in remark


@pytest.mark.parametrize("gap", [bytes(30_001), b"\xff" * 30_001])
def test_a_long_gap_of_garbage(gap: bytes) -> None:
    values = bar(200)
    data = to_bytes(values)
    decoder, batches = decode(data[: 108 * 90] + gap + data[108 * 90 :])
    np.testing.assert_array_equal(fields(batches), tesla(values))
    assert (decoder.counts.bad, decoder.counts.skipped) == (1, 30_001)
    assert len(decoder.remarks) == 1


def test_other_arrays_are_not_taken_for_it() -> None:
    values = bar(200)
    assert decode(to_bytes(values[:, :24], 0.0))[1] == []
    assert decode(to_bytes(values), make=MagxDecoder)[1] == []


def test_what_the_firmware_says_of_its_sensors() -> None:
    values = bar(100)
    text = b"No sensor 3 found ... check your wiring?\r\n"
    decoder, batches = decode(7 * text + to_bytes(values))
    np.testing.assert_array_equal(fields(batches), tesla(values))
    assert decoder.remarks[0] == "message of the device: No sensor 3 found ... check your wiring?"
    assert "assumed from the first received byte" in decoder.remarks[1]
    decoder, batches = decode(500 * text)
    assert batches == []
    assert decoder.remarks == ["message of the device: No sensor 3 found ... check your wiring?"]


@pytest.mark.parametrize("n", [0, 1, 2, 3, 9])
def test_short_streams(n: int) -> None:
    values = bar(10)[:n]
    _, batches = decode(to_bytes(values) + b"\x11\x22")
    if n < 2:
        assert batches == []
    else:
        np.testing.assert_array_equal(fields(batches), tesla(values))


# ---- pieces and connections


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(st.data())
def test_any_split_gives_the_same(draw: st.DataObject) -> None:
    kind = draw.draw(st.sampled_from(sorted(KINDS)))
    make, sensors, floats = KINDS[kind]
    rng = np.random.default_rng(draw.draw(st.integers(0, 2**32)))
    values = bar(60, sensors, seed=int(rng.integers(99)), offset_ut=rng.choice([0.0, 25.0]))
    size = 4 * floats
    data = to_bytes(values, 0.0 if kind == "magx" else None)
    pauses = set(starts(len(data), size)) if rng.random() < 0.6 else set()
    for _ in range(int(rng.integers(4))):
        data, at, lost = hit(data, size, str(rng.choice(["lose", "add"])), rng)
        pauses = {p if p < at else max(at, p - lost) for p in pauses}
    if rng.random() < 0.3:
        at = int(rng.integers(len(data)))
        data = data[:at] + rng.bytes(9000) + data[at:]
        pauses = {p if p < at else p + 9000 for p in pauses}
    pauses |= set(rng.integers(1, len(data), 3).tolist())
    data, pauses = data[17:], {p - 17 for p in pauses if p > 17}
    restarts = rng.integers(1, len(data), 1).tolist() if rng.random() < 0.4 else []
    place = st.integers(1, len(data) - 1)
    cuts = draw.draw(
        st.one_of(st.lists(place, max_size=30), place.map(lambda n: range(0, 9999, n)))
    )
    whole, expected = decode(data, pauses, (), make, restarts)
    pieces, batches = decode(data, pauses, cuts, make, restarts)
    assert pieces.counts == whole.counts
    assert pieces.remarks == whole.remarks
    for sensors in (3, 8, 9):
        parts = [
            [batch for batch in some if batch.stream.sensors == sensors]
            for some in (expected, batches)
        ]
        assert bool(parts[0]) == bool(parts[1])
        if parts[0]:
            np.testing.assert_array_equal(ends(parts[0]), ends(parts[1]))
            np.testing.assert_array_equal(fields(parts[0]), fields(parts[1]))
            assert (np.diff(ends(parts[0])) > 0).all()


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.binary(max_size=400), st.integers(0, 40), st.booleans())
def test_any_bytes_are_taken(garbage: bytes, repeat: int, silent: bool) -> None:
    for make in (PolarisDecoder, MagxDecoder):
        decoder = make(Options())
        batches = decoder.feed(garbage * repeat, pause=silent)
        batches += decoder.feed(to_bytes(bar(20)), pause=silent)
        batches += decoder.feed(garbage)
        batches += decoder.restart() + decoder.feed(garbage * 3) + decoder.finish()
        assert sum(map(len, batches)) == decoder.counts.frames


def test_byte_by_byte() -> None:
    values = bar(45)
    data = to_bytes(values)
    _, batches = decode(data, cuts=range(len(data)))
    np.testing.assert_array_equal(fields(batches), tesla(values))


def test_frames_come_one_after_the_other() -> None:
    """A frame is given with the one after it, once the first are settled by their pauses."""
    values = bar(60)
    decoder = PolarisDecoder(Options())
    given_after = []
    for frame in values:
        given_after.append(sum(map(len, decoder.feed(frame.tobytes(), pause=True))))
    assert given_after[:7] == [0] * 7
    assert given_after[8:] == [1] * 52
    assert sum(map(len, decoder.finish())) == 1
    assert decoder.counts.frames == 60


@pytest.mark.parametrize("turned", [False, True], ids=["as it was", "turned meanwhile"])
def test_after_a_restart_the_sensors_tell_their_order(turned: bool) -> None:
    values = bar(200)
    if turned:
        counts = np.rint(values[100:].reshape(-1, 9, 3) / COUNT_UT) + [200, -150, 40]
        values[100:] = (counts * COUNT_UT).reshape(-1, 27)
    data = to_bytes(values)
    first, second = data[: 100 * 108 + 50], data[100 * 108 + 90 :]
    decoder, batches = decode(first + second, restarts=[len(first)])
    assert order(fields(batches), tesla(values)) == [*range(100), *range(101, 200)]
    assert (decoder.counts.bad, decoder.counts.skipped) == (0, 0)
    assert len(decoder.remarks) == 1


# ---- encoding, artifacts


@pytest.mark.parametrize("device", KINDS)
def test_what_is_encoded_is_decoded(device: str) -> None:
    make, sensors, floats = KINDS[device]
    array = mlx90393.published_bar(sensors, 0.02)
    true = tesla(bar(50, sensors))
    times = np.arange(50) * 25_000_000
    samples = Samples("bar", array, times, true.reshape(50, sensors, 3))
    encode = encode_magx if device == "magx" else encode_polaris
    sent = list(encode(Recording([samples])))
    assert [time for time, _ in sent] == times.tolist()
    assert {len(frame) for _, frame in sent} == {4 * floats}
    _, batches = decode(b"".join(frame for _, frame in sent), make=make)
    np.testing.assert_allclose(fields(batches), true, rtol=1e-7, atol=0)


def test_no_number_is_sent_as_no_number() -> None:
    array = mlx90393.published_bar(3, 0.008)
    samples = Samples("bar", array, np.arange(1), np.full((1, 3, 3), np.nan))
    ((_, frame),) = encode_polaris(Recording([samples]))
    assert np.isnan(np.frombuffer(frame, "<f4")).all()


@pytest.mark.parametrize(("sensors", "encode"), [(8, encode_polaris), (9, encode_magx)])
def test_other_numbers_of_sensors_cannot_be_sent(sensors: int, encode: Callable) -> None:
    array = mlx90393.published_bar(sensors, 0.02)
    samples = Samples("bar", array, np.arange(2), np.zeros((2, sensors, 3)))
    with pytest.raises(InputError, match=f"{sensors} sensors, but"):
        encode(Recording([samples]))


def test_nothing_to_send() -> None:
    with pytest.raises(InputError, match="no samples of magnetometers"):
        encode_polaris(Recording())


@pytest.mark.parametrize(("sensors", "spacing_m", "rate_hz"), [(9, 0.02, 59), (3, 0.008, 18)])
def test_the_published_bars_are_known(sensors: int, spacing_m: float, rate_hz: float) -> None:
    (text,) = polaris_artifacts(Stream("magnetometers", sensors=sensors)).values()
    array = loads_array(text)
    assert len(array) == sensors
    np.testing.assert_allclose(np.diff(array.position_m[:, 1]), spacing_m)
    np.testing.assert_allclose(array.quantum_t, [0.15e-6, 0.15e-6, 0.242e-6])
    # From one axis to the next it takes a third of a conversion.
    assert np.ptp(array.delay_s) * 1.5 == pytest.approx(1 / rate_hz, rel=0.1)


def test_the_place_of_magx_sensors_is_not_known() -> None:
    assert find_device("magx-array").default_artifacts(Stream("magnetometers", sensors=8)) == {}
