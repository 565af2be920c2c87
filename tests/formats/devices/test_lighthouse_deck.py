"""The Lighthouse deck's frames, against published ones and against what can happen to them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.recording import Sweeps
from locatk.formats.devices.interface import Batch, Options, Recording
from locatk.formats.devices.lighthouse_deck import (
    FRAME_BYTES,
    MAX_COUNT_DIFFERENCE,
    MAX_GAP_TICKS,
    STREAM,
    SYNC_FRAME,
    TESTED_OFFSETS,
    WORDS_UNUSED,
    DeckDecoder,
    encode,
)
from locatk.formats.importers.dotbot.recording import read_dotbot


def frame(
    sensor: int,
    tick: int,
    polynomial: int | None = None,
    offset: int = 0,
    word: int = 0,
    width: int = 300,
) -> bytes:
    head = 0xFC if polynomial is None else polynomial << 2
    fields = ((head | sensor, 1), (width, 2), (offset, 3), (word, 3), (tick & 0xFFFFFF, 3))
    return b"".join(value.to_bytes(size, "little") for value, size in fields)


@pytest.fixture
def published(published_frames: list[dict[str, Any]]) -> bytes:
    """Bytes of frames that a deck sent."""
    return b"".join(frame(**each) for each in published_frames)


def word(count: int, polynomial: int) -> int:
    return int(lfsr.state_at(count, polynomial))


def decode(*pieces: bytes) -> tuple[dict[str, NDArray[Any]], DeckDecoder]:
    decoder = DeckDecoder(Options())
    batches = [batch for piece in pieces for batch in decoder.feed(piece)]
    return joined(batches + decoder.finish()), decoder


def joined(batches: list[Batch]) -> dict[str, NDArray[Any]]:
    """All records as columns, with ``tick`` and ``end``."""
    names = ("sensor", "channel", "polynomial", "sweep", "count")
    assert all(batch.stream == STREAM and len(batch) for batch in batches)
    columns = {k: np.concatenate([[], *(b.columns[k] for b in batches)]) for k in names}
    columns["tick"] = np.concatenate([[], *(b.tick for b in batches if b.tick is not None)])
    columns["end"] = np.concatenate([[], *(b.end for b in batches)])
    return columns


def sweeps_of(
    time_ns: NDArray[Any],
    sensor: NDArray[Any],
    polynomial: NDArray[Any],
    count: NDArray[Any],
) -> Sweeps:
    n = len(time_ns)
    return Sweeps(
        ("deck",),
        time_ns.astype(np.int64),
        np.zeros(n, np.int32),
        sensor.astype(np.int32),
        (polynomial // 2 + 1).astype(np.int32),
        polynomial.astype(np.int32),
        np.full(n, -1, np.int32),
        count.astype(np.float64),
    )


def turns(n: int, *, seed: int = 0) -> Sweeps:
    """Four sensors in sight of the stations on channels 1 and 2 for ``n`` turns.

    Their periods differ by 42 us, so that their light crosses after some 20 turns.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for channel, period in ((1, 959_000), (2, 957_000)):
        zero = np.arange(n) * period / 48e6 + 0.0008 * (channel - 1)
        slow = rng.integers(0, 2, n)
        for base in (30_000, 71_000):
            for sensor, lag in enumerate((0, 41, 268, 310)):
                count = base + lag + rng.integers(0, 8, n)
                polynomial = 2 * (channel - 1) + slow
                rows.append((zero + count / 6e6, np.full(n, sensor), polynomial, count))
    time_s, sensor, polynomial, count = (np.concatenate(part) for part in zip(*rows, strict=True))
    order = np.argsort(time_s)
    time_ns = 1_700_000_000_000_000_000 + np.rint(time_s[order] * 1e9).astype(np.int64)
    return sweeps_of(time_ns, sensor[order], polynomial[order], count[order])


def wire(sweeps: Sweeps) -> bytes:
    return b"".join(data for _, data in encode(Recording(sweeps=sweeps)))


SWEEPS = turns(40)
CLEAN = wire(SWEEPS)
EXPECTED, _CLEAN_DECODER = decode(CLEAN)
EXPECTED_COUNTS = _CLEAN_DECODER.counts


def test_frames_that_a_deck_sent(published: bytes) -> None:
    got, decoder = decode(SYNC_FRAME + published + SYNC_FRAME)
    assert got["sensor"].tolist() == [1, 0, 3, 2, 0, 1, 2, 3, 1, 0, 3, 2, 0, 1, 2, 3]
    assert got["polynomial"].tolist() == [0] * 8 + [1] * 8
    assert set(got["channel"]) == {1}
    assert set(got["sweep"]) == {-1}
    # The offset of one sensor, and for the others that and a quarter of the ticks between.
    assert got["count"][:4].tolist() == [28992 - 164 / 4, 28992, 28992 + 1075 / 4, 28992 + 310]
    assert got["count"][8:12].tolist() == [28992 - 40, 28992, 28992 + 1075 / 4, 28992 + 1243 / 4]
    assert got["tick"][0] == 0x5431ED
    assert got["end"].tolist() == list(range(24, 24 + 16 * FRAME_BYTES, FRAME_BYTES))
    assert (decoder.counts.frames, decoder.counts.bad, decoder.remarks) == (18, 0, [])


def test_beam_words_that_a_deck_sent_stand_where_time_says(
    published: bytes, published_frames: list[dict[str, Any]]
) -> None:
    got, _ = decode(SYNC_FRAME + published)
    words = [each["word"] for each in published_frames]
    index = lfsr.indices(words, got["polynomial"].astype(int))
    assert np.abs(index - got["count"]).max() <= 0.75 < MAX_COUNT_DIFFERENCE


def test_there_and_back() -> None:
    assert len(EXPECTED["count"]) == len(SWEEPS)
    order = np.lexsort((SWEEPS.sensor, SWEEPS.polynomial, SWEEPS.time_ns))
    for name in ("sensor", "channel", "polynomial", "count"):
        again = np.lexsort((EXPECTED["sensor"], EXPECTED["polynomial"], EXPECTED["end"]))
        assert np.array_equal(np.sort(EXPECTED[name][again]), np.sort(getattr(SWEEPS, name)[order]))
    assert rows(EXPECTED) == rows(
        {name: getattr(SWEEPS, name) for name in ("sensor", "polynomial", "count")}
    )
    seconds = (SWEEPS.time_ns - SWEEPS.time_ns[0]) * 1e-9
    ticks = np.unwrap(EXPECTED["tick"] - EXPECTED["tick"][0], period=1 << 24)
    np.testing.assert_allclose(np.sort(ticks) / 24e6, seconds, atol=1.5 / 24e6)


def rows(columns: dict[str, NDArray[Any]]) -> list[tuple[float, ...]]:
    """Sensor, polynomial and count of each record, sorted."""
    names = ("sensor", "polynomial", "count")
    return sorted(zip(*(columns[name].tolist() for name in names), strict=True))


def test_fractions_survive_to_the_resolution() -> None:
    rng = np.random.default_rng(3)
    lags = np.array([0.0, 40.25, 268.5, 309.75])
    count = 30_000 + np.arange(200)[:, None] * 7.1 + lags + rng.uniform(0, 5, (200, 4))
    time_ns = np.arange(200)[:, None] * 20_000_000 + count * 1e9 / 6e6
    sensor = np.tile(np.arange(4), (200, 1))
    got, _ = decode(
        wire(sweeps_of(time_ns.ravel(), sensor.ravel(), np.full(800, 6), count.ravel()))
    )
    assert np.array_equal(got["sensor"], sensor.ravel())
    assert np.abs(got["count"] - count.ravel()).max() <= 0.75


@given(st.lists(st.integers(0, len(CLEAN)), max_size=40))
@settings(max_examples=40, deadline=None)
def test_pieces_do_not_matter(cuts: list[int]) -> None:
    edges = [0, *sorted(cuts), len(CLEAN)]
    got, decoder = decode(*(CLEAN[a:b] for a, b in pairwise(edges)))
    for name, column in EXPECTED.items():
        assert np.array_equal(got[name], column)
    assert decoder.counts == EXPECTED_COUNTS


@pytest.mark.slow
def test_byte_by_byte_with_faults() -> None:
    data = bytearray(CLEAN[: 300 * FRAME_BYTES])
    del data[1000:1005]
    data[2003] ^= 0x40
    data[2500:2500] = b"\x00\x01\x02"
    whole, at_once = decode(bytes(data))
    single, by_byte = decode(*(bytes([byte]) for byte in data))
    for name, column in whole.items():
        assert np.array_equal(single[name], column)
    assert by_byte.counts == at_once.counts
    assert by_byte.remarks == at_once.remarks


QUIET = 20 * FRAME_BYTES
"""The jury has sat before the first fault."""


@pytest.mark.slow
@given(st.lists(st.integers(QUIET, len(CLEAN) - 1), min_size=1, max_size=8), st.data())
@settings(max_examples=40, deadline=None)
def test_lost_and_added_bytes_make_no_wrong_sweep(places: list[int], draw: st.DataObject) -> None:
    data = bytearray(CLEAN)
    for place in sorted(places, reverse=True):
        if draw.draw(st.booleans()):
            del data[place : place + draw.draw(st.integers(1, 30))]
        else:
            data[place:place] = draw.draw(st.binary(min_size=1, max_size=30))
    got, decoder = decode(bytes(data))
    assert near(got, sensors=False)
    # A fault costs its passage, and what it takes to get aligned.
    assert len(got["count"]) >= len(EXPECTED["count"]) - 20 * len(places)
    assert decoder.counts.frames * FRAME_BYTES + decoder.counts.skipped <= len(data)


def near(got: dict[str, NDArray[Any]], *, sensors: bool = True) -> bool:
    """Whether each record is one of the clean ones, as far as beam words can tell.

    Nothing in a frame guards the number of its sensor.
    """
    return all(
        np.abs(
            EXPECTED["count"][
                (EXPECTED["polynomial"] == p) & ((EXPECTED["sensor"] == s) | (not sensors))
            ]
            - c
        ).min()
        <= MAX_COUNT_DIFFERENCE
        for s, p, c in set(zip(got["sensor"], got["polynomial"], got["count"], strict=True))
    )


@pytest.mark.slow
@given(st.lists(st.integers(QUIET * 8, len(CLEAN) * 8 - 1), min_size=1, max_size=8, unique=True))
@settings(max_examples=40, deadline=None)
def test_flipped_bits_make_no_wrong_sweep(bits: list[int]) -> None:
    data = bytearray(CLEAN)
    for bit in bits:
        data[bit // 8] ^= 1 << bit % 8
    got, _ = decode(bytes(data))
    assert near(got, sensors=all(bit // 8 % FRAME_BYTES or bit % 8 > 1 for bit in bits))
    assert len(got["count"]) >= len(EXPECTED["count"]) - 12 * len(bits)


@pytest.mark.parametrize("place", range(FRAME_BYTES))
def test_one_flipped_bit_costs_one_sweep(place: int) -> None:
    data = bytearray(CLEAN)
    # The last frame of a passage, without an offset.
    data[40 * FRAME_BYTES + place] ^= 0x10
    got, decoder = decode(bytes(data))
    assert len(EXPECTED["count"]) - len(got["count"]) == (place not in (1, 2, 9))
    assert decoder.counts.bad == (place in (3, 4, 5, 8))
    assert near(got) or place == 0


@pytest.mark.parametrize("lost", range(1, FRAME_BYTES))
def test_aligned_again_within_a_passage_of_lost_bytes(lost: int) -> None:
    place = 40 * FRAME_BYTES + 2
    data = CLEAN[:place] + CLEAN[place + lost :]
    got, decoder = decode(data)
    assert len(got["count"]) >= len(EXPECTED["count"]) - 8
    assert decoder.counts.bad >= 1
    assert decoder.counts.skipped > 0


def test_nothing_but_noise() -> None:
    rng = np.random.default_rng(5)
    decoder = DeckDecoder(Options())
    for _ in range(50):
        assert decoder.feed(rng.bytes(20_000)) == []
        assert len(decoder._aligner._rest) < 4 * FRAME_BYTES
    assert decoder.finish() == []
    assert (decoder.counts.frames, decoder.counts.bad, decoder.counts.skipped) == (0, 0, 0)
    assert decoder.counts.bytes == 1_000_000


@pytest.mark.parametrize("byte", [0x00, 0xFF, 0x55])
def test_nothing_but_one_byte(byte: int) -> None:
    got, decoder = decode(*[bytes([byte]) * 5_000] * 20)
    assert len(got["count"]) == 0
    assert len(decoder._aligner._rest) < 4 * FRAME_BYTES


def test_memory_is_bounded_under_endless_light() -> None:
    # Pulses close to each other for ever, without any offset, then with.
    decoder = DeckDecoder(Options())
    for offset in (0, 30_000):
        for start in range(0, 16_000, 4_000):
            pulses = [
                frame(k & 3, 100 * k, 0, offset, word(30_000, 0))
                for k in range(start, start + 4_000)
            ]
            decoder.feed(SYNC_FRAME + b"".join(pulses))
            assert len(decoder._open) <= 64
            assert len(decoder._waiting) <= 64 * TESTED_OFFSETS


def test_noise_before_the_first_frame_is_no_error() -> None:
    rng = np.random.default_rng(6)
    got, decoder = decode(rng.bytes(1001) + CLEAN)
    assert rows(got) == rows(EXPECTED)
    assert (decoder.counts.bad, decoder.counts.skipped) == (0, 0)


def test_listening_from_anywhere() -> None:
    for start in range(3 * FRAME_BYTES):
        got, decoder = decode(CLEAN[start:])
        assert len(got["count"]) >= len(EXPECTED["count"]) - 4
        assert near(got)
        assert (decoder.counts.bad, decoder.counts.skipped) == (0, 0)


def test_sync_frames_beside_bytes_like_theirs() -> None:
    # Sensor 3 without polynomial begins with 0xFF, a time can end with it.
    pulses = (
        frame(3, 0xFFFF00, None, 0, word(30_000, 2)),
        frame(1, 0xFFFF64, 2, 30_025, word(30_025, 2)),
        frame(0, 0xFFFFFF, 2, 0, word(30_064, 2)),
    )
    got, decoder = decode(
        SYNC_FRAME, b"".join(pulses), SYNC_FRAME * 3, b"".join(pulses), SYNC_FRAME
    )
    assert got["count"].tolist() == [30_000, 30_025, 30_063.75] * 2
    assert (decoder.counts.frames, decoder.counts.bad) == (11, 0)


def test_time_starts_again() -> None:
    tick = (1 << 24) - 300
    pulses = [
        frame(sensor, tick + 4 * lag, None if sensor == 0 else 4, offset, word(50_000 + lag, 4))
        for sensor, lag, offset in ((0, 0, 0), (1, 50, 50_050), (2, 100, 0), (3, 200, 0))
    ]
    got, _ = decode(SYNC_FRAME + b"".join(pulses))
    assert got["count"].tolist() == [50_000, 50_050, 50_100, 50_200]
    assert got["tick"].tolist() == [tick, tick + 200, 100, 500]


def test_beams_that_cross_are_not_mixed() -> None:
    # Two stations, pulse by pulse in turn; the deck knows of each station only a pair.
    first, second = 0, 2
    pulses = [
        frame(0, 0, None, 0, word(30_000, first)),
        frame(1, 160, first, 30_040, word(30_040, first)),
        frame(0, 200, None, 0, word(50_000, second)),
        frame(1, 360, second, 50_040, word(50_040, second)),
        frame(2, 800, None, 0, word(30_200, first)),
        frame(2, 1_000, None, 0, word(50_200, second)),
        frame(3, 1_200, None, 0, word(30_300, first)),
        frame(3, 1_400, second, 0, word(50_300, second)),
        frame(3, 1_404, None, 0, 0),
    ]
    got, decoder = decode(SYNC_FRAME + b"".join(pulses) + SYNC_FRAME)
    assert rows(got) == sorted(
        (sensor, polynomial, base + lag)
        for polynomial, base in ((first, 30_000), (second, 50_000))
        for sensor, lag in enumerate((0, 40, 200, 300))
        # Only one offset is looked at on either side of a pulse.
        if (sensor, polynomial) not in {(2, first), (3, first)}
    )
    assert "3 of 9 pulses" in decoder.remarks[0]


def test_pulse_without_word_takes_the_only_polynomial() -> None:
    head = frame(0, 0, None, 0, word(30_000, 5)), frame(1, 160, 5, 30_040, word(30_040, 5))
    got, decoder = decode(SYNC_FRAME, *head, frame(2, 800), SYNC_FRAME)
    assert rows(got) == [(0, 5, 30_000), (1, 5, 30_040), (2, 5, 30_200)]
    assert decoder.remarks == []
    # Its sensor was lit twice: which of the two was it?
    got, decoder = decode(SYNC_FRAME, *head, frame(2, 800), frame(2, 900), SYNC_FRAME)
    assert rows(got) == [(0, 5, 30_000), (1, 5, 30_040)]
    assert decoder.counts.frames == 6
    assert "2 of 4 pulses" in decoder.remarks[0]


def test_pulse_whose_word_stands_elsewhere_is_left_out() -> None:
    head = frame(0, 0, None, 0, word(30_000, 5)), frame(1, 160, 5, 30_040, word(30_040, 5))
    for own in (None, 5):
        late = frame(2, 800, own, 0, word(30_200 + MAX_COUNT_DIFFERENCE + 1, 5))
        assert rows(decode(SYNC_FRAME, *head, late, SYNC_FRAME)[0]) == [
            (0, 5, 30_000),
            (1, 5, 30_040),
        ]
        inside = frame(2, 800, own, 0, word(30_200 + MAX_COUNT_DIFFERENCE, 5))
        assert rows(decode(SYNC_FRAME, *head, inside, SYNC_FRAME)[0])[2] == (2, 5, 30_200)


def test_counts_follow_from_the_offset_before_a_pulse() -> None:
    """The offset after it, here two counts off, is used only for pulses before the first offset."""
    got, _ = decode(
        SYNC_FRAME,
        frame(3, 0, 3, 0, word(4900, 3)),
        frame(0, 400, 3, 5000, word(5000, 3)),
        frame(1, 800, 3, 0, word(5100, 3)),
        frame(2, 1200, 3, 5202, word(5202, 3)),
        SYNC_FRAME,
    )
    assert got["count"].tolist() == [4900, 5000, 5100, 5202]


def test_passages_without_an_offset_give_nothing() -> None:
    got, decoder = decode(SYNC_FRAME, frame(0, 0), frame(1, 100, 3, 0, word(100, 3)), SYNC_FRAME)
    assert len(got["count"]) == 0
    assert decoder.counts.frames == 4
    assert "2 of 2 pulses" in decoder.remarks[0]


def test_offset_that_its_word_denies_is_wrong() -> None:
    data = bytearray(CLEAN)
    places = [
        k
        for k in range(QUIET, len(data) - FRAME_BYTES, FRAME_BYTES)
        if any(data[k + 3 : k + 6]) and data[k + 5] < 2
    ]
    data[places[3] + 4] ^= 1
    got, decoder = decode(bytes(data))
    assert decoder.counts.bad == 1
    assert decoder.counts.frames == len(CLEAN) // FRAME_BYTES - 1
    assert near(got)


@pytest.mark.parametrize("words", [0, 0x1A639])
def test_words_that_say_nothing_are_not_used(words: int) -> None:
    data = np.frombuffer(CLEAN, np.uint8).reshape(-1, FRAME_BYTES).copy()
    pulses = data[:, 5] != 0xFF
    data[pulses, 6:9] = [words >> k & 0xFF for k in (0, 8, 16)]
    got, decoder = decode(data.tobytes())
    assert WORDS_UNUSED in decoder.remarks
    assert len(got["count"]) > 0.8 * len(SWEEPS)
    assert near(got)
    assert decoder.counts.bad == 0


def test_sweeps_come_with_the_next_passage_or_in_the_dark(published: bytes) -> None:
    passages = [
        published[k : k + 4 * FRAME_BYTES] for k in range(0, 16 * FRAME_BYTES, 4 * FRAME_BYTES)
    ] * 2
    decoder = DeckDecoder(Options())
    given = [sum(map(len, decoder.feed(data))) for data in (SYNC_FRAME, *passages)]
    # The jury needs some passages; then each comes with the next one.
    assert given == [0, 0, 0, 0, 0, 0, 20, 4, 4]
    assert [sum(map(len, decoder.feed(SYNC_FRAME))) for _ in range(3)] == [0, 0, 4]


def test_connection_lost_and_there_again() -> None:
    decoder = DeckDecoder(Options())
    half = len(CLEAN) // 2 + 5
    batches = decoder.feed(CLEAN[:half])
    batches += decoder.restart()
    batches += decoder.feed(CLEAN[half + 1_000 :]) + decoder.finish()
    got = joined(batches)
    assert near(got)
    assert np.all(np.diff(got["end"]) >= 0)
    assert got["end"].max() <= decoder.counts.bytes
    assert (decoder.counts.bad, decoder.counts.skipped, decoder.counts.lost) == (0, 0, 0)
    assert len(got["count"]) > len(SWEEPS) - 1_000 / FRAME_BYTES - 16


def test_published_recording(data: Path) -> None:
    path = data / "lighthouse/twoLH-3D_scene/dataset/data_all.csv"
    sweeps = read_dotbot([path]).sweeps
    got, decoder = decode(wire(sweeps))
    assert len(got["count"]) == len(sweeps)
    assert decoder.remarks == []
    for channel in (1, 2):
        mine = np.sort(got["count"][got["channel"] == channel])
        assert np.array_equal(mine, np.sort(sweeps.count[sweeps.channel == channel]))
    # Both planes of both stations, row by row: within a turn of their time stamp.
    assert np.array_equal(
        np.sort(got["count"].reshape(-1, 4), axis=1), np.sort(sweeps.count.reshape(-1, 4), axis=1)
    )


def test_what_is_sent_looks_like_a_deck() -> None:
    sent = list(encode(Recording(sweeps=SWEEPS)))
    times = [time for time, _ in sent]
    assert times == sorted(times)
    syncs = [time for time, data in sent if data == SYNC_FRAME]
    assert set(np.diff(syncs)) == {500_000_000}
    assert SWEEPS.time_ns[0] <= syncs[0] <= SWEEPS.time_ns[0] + 1_000_000
    frames = np.frombuffer(CLEAN, np.uint8).reshape(-1, FRAME_BYTES)
    pulses = frames[frames[:, 5] != 0xFF].astype(int)
    assert np.all((pulses[:, 5] | pulses[:, 8]) < 2)
    tick = pulses[:, 9:] @ (1, 1 << 8, 1 << 16)
    new = np.r_[True, np.abs((np.diff(tick) + (1 << 23)) % (1 << 24) - (1 << 23)) > MAX_GAP_TICKS]
    # The first pulse of a passage is not known, the second has the offset.
    known, offset = pulses[:, 0] < 0x80, np.any(pulses[:, 3:6], axis=1)
    alone = new & known
    assert np.count_nonzero(alone) < 0.05 * np.count_nonzero(new)
    assert np.all(offset[alone])
    assert np.all(offset[np.flatnonzero(new & ~known) + 1])
    assert not np.any(offset & ~known)


def test_nothing_that_a_deck_could_see() -> None:
    sweeps = turns(2)
    other = Sweeps(
        ("deck",),
        sweeps.time_ns,
        sweeps.device,
        sweeps.sensor + 4,
        sweeps.channel,
        sweeps.polynomial,
        sweeps.sweep,
        sweeps.count,
    )
    for recording in (Recording(), Recording(sweeps=other)):
        with pytest.raises(InputError, match="no sweeps") as error:
            encode(recording)
        assert error.value.hint
