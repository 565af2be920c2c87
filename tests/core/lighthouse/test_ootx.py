"""Factory data in slow bits: frames found whatever is missing, none taken that is wrong."""

from __future__ import annotations

import gzip
import json
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import InputError, LocatkError
from locatk.core.lighthouse.calibration import PARAMETERS
from locatk.core.lighthouse.channels import PERIOD_TICKS
from locatk.core.lighthouse.demodulation import ootx

Bits = NDArray[np.int8]

STATION = bytes.fromhex(
    "080a bfe7d710 0000 5d9e 21aa 4c29 01 0f 622b 9535 fd7f1f d13e bc2f 7c18 a09a 8b 00"
    "cd3e 2040 e4b5 c9b4 046f"
)
"""What station 10d7e7bf sends in libsurvive-extras-data (MIT), tracker-cal-attempt."""

PAYLOADS = st.binary(min_size=43, max_size=43)


def by_hand(payload: bytes) -> list[int]:
    """Slow bits of a frame, from the format's description, one by one."""
    content = struct.pack("<H", len(payload)) + payload + b"\0" * (len(payload) % 2)
    content += struct.pack("<I", zlib.crc32(payload))
    bits = [0] * 17 + [1]
    for k, byte in enumerate(content):
        bits += [byte >> place & 1 for place in range(7, -1, -1)]
        if k % 2:
            bits.append(1)
    return bits


def noise(n: int, seed: int) -> Bits:
    return np.random.default_rng(seed).integers(0, 2, n).astype(np.int8)


@pytest.mark.slow
@given(PAYLOADS)
def test_encodes_as_documented(payload: bytes) -> None:
    bits = ootx.encode_frame(payload)
    assert bits.tolist() == by_hand(payload)
    assert len(bits) == 443
    (frame,) = ootx.decode_frames(bits)
    assert frame == ootx.OotxFrame(18, payload, True, 0)


def test_fields_by_name() -> None:
    data = ootx.decode_factory_data(STATION)
    assert (data.id, data.channel) == (0x10D7E7BF, 12)
    assert (data.protocol, data.firmware, data.hardware) == (8, 40, 15)
    assert (data.unlock_count, data.faults, data.nonce) == (1, 0, 0x6F04)
    assert data.acceleration == (-3, 127, 31)
    assert data.calibration.source == "factory"
    columns = dict(zip(PARAMETERS, data.calibration.sweeps.T.tolist(), strict=True))
    assert {name: [round(v, 6) for v in values] for name, values in columns.items()} == {
        "phase": [0.0, -0.006214],
        "tilt": [-0.047882, 0.041382],
        "curve": [0.057678, 0.348877],
        "gibphase": [1.704102, 0.12085],
        "gibmag": [0.00219, -0.003235],
        "ogeephase": [1.700195, 2.0625],
        "ogeemag": [-0.368164, -0.299072],
    }


def test_a_frame_at_any_rotation_of_a_recording() -> None:
    stream = np.tile(ootx.encode_frame(STATION), 3)
    for first in range(0, 443, 13):
        found = ootx.decode_frames(stream[first : first + 886])
        assert [f.start_rotation for f in found] == [
            (443 - first) % 443 + 18 + 443 * k for k in range(2)
        ][: len(found)]
        assert found
        assert all(f.is_valid and f.payload == STATION for f in found)


def test_a_recording_of_one_frame_that_starts_in_its_middle() -> None:
    """Every bit was received, the end of the frame before its sync."""
    stream = np.tile(ootx.encode_frame(STATION), 2)
    found = ootx.decode_frames(stream[300 : 300 + 443 + 40])
    # Both halves are of different frames, and 40 rotations more name the length.
    assert [f.is_valid for f in found] in ([], [True])
    found = ootx.decode_frames(stream[300:])
    assert [(f.start_rotation, f.payload, f.is_valid) for f in found] == [(161, STATION, True)]


def test_frames_in_the_middle_of_noise_and_behind_false_starts() -> None:
    frame = ootx.encode_frame(STATION)
    # A sync, length and the first words of a frame, broken off by a whole one.
    for cut in (18, 36, 100, 200, 442):
        bits = np.concatenate([noise(60, 1), frame[:cut], frame, noise(500, 2)])
        right = [f for f in ootx.decode_frames(bits) if f.is_valid]
        assert [(f.start_rotation, f.payload) for f in right] == [(60 + cut + 18, STATION)]
        # What overlaps it is not told as damaged.
        assert all(
            abs(f.start_rotation - right[0].start_rotation) >= 443 or f.is_valid
            for f in ootx.decode_frames(bits)
        )


@pytest.mark.parametrize("place", [3, 17, 18 + 2, 18 + 16, 18 + 17 * 9 + 16])
def test_a_wrong_bit_that_all_frames_share_is_no_frame(place: int) -> None:
    frame = ootx.encode_frame(STATION)
    wrong = frame.copy()
    wrong[place] ^= 1
    found = ootx.decode_frames(np.concatenate([wrong, frame]))
    assert [(f.start_rotation, f.is_valid) for f in found] == [(443 + 18, True)]


@pytest.mark.slow
@given(PAYLOADS, st.integers(0, 442))
def test_one_wrong_bit_never_passes(payload: bytes, place: int) -> None:
    bits = ootx.encode_frame(payload)
    bits[place] ^= 1
    assert not any(f.is_valid for f in ootx.decode_frames(bits))


def test_a_wrong_frame_among_right_ones_is_counted_not_repaired() -> None:
    stream = np.tile(ootx.encode_frame(STATION), 5)
    stream[443 * 2 + 60] ^= 1
    found = ootx.decode_frames(stream)
    assert [f.is_valid for f in found] == [True, True, False, True, True]
    assert found[2].payload != STATION


@pytest.mark.slow
@given(PAYLOADS, st.sets(st.integers(0, 442), max_size=ootx.MAX_SOLVED_BITS))
def test_few_missing_bits_are_solved_for(payload: bytes, missing: set[int]) -> None:
    bits = ootx.encode_frame(payload)
    bits[list(missing)] = ootx.MISSING_BIT
    (frame,) = ootx.decode_frames(bits)
    assert frame == ootx.OotxFrame(18, payload, True, len(missing))


def test_shared_bits_do_not_count_as_missing() -> None:
    frame = ootx.encode_frame(STATION)
    stuffing = np.arange(18 + 16, 443, 17)
    frame[stuffing[3:]] = ootx.MISSING_BIT
    (found,) = ootx.decode_frames(frame)
    assert found.is_valid
    assert found.missing_bits == len(stuffing) - 3
    # Eight bits more are solved for, the ninth is too much.
    frame[104 : 104 + 9] = ootx.MISSING_BIT
    (found,) = ootx.decode_frames(frame)
    assert not found.is_valid


def test_repetitions_give_missing_bits() -> None:
    """A third of the rotations missed: no frame could be read alone."""
    rng = np.random.default_rng(7)
    stream = np.tile(ootx.encode_frame(STATION), 12)
    for share in (0.05, 0.2, 0.33):
        bits = np.where(rng.random(len(stream)) < share, ootx.MISSING_BIT, stream)
        found = ootx.decode_frames(bits)
        assert len(found) >= 10, share
        assert all(f.is_valid and f.payload == STATION for f in found), share
        assert min(f.missing_bits for f in found) > ootx.MAX_SOLVED_BITS


@pytest.mark.parametrize("repeats", [2, 3, 6, 20])
def test_without_a_valid_frame_the_majority_decides(repeats: int) -> None:
    """A wrong bit in each frame, none twice; of two that differ, both values are tried."""
    place = 18 + 17 + 17 * np.arange(20) + np.random.default_rng(repeats).integers(0, 16, 20)
    stream = np.tile(ootx.encode_frame(STATION), (repeats, 1))
    stream[np.arange(repeats), place[:repeats]] ^= 1
    found = ootx.decode_frames(stream.ravel())
    assert len(found) == repeats
    right = [(f.payload, f.missing_bits) for f in found if f.is_valid]
    assert right == [(STATION, 1 if repeats > 2 else 2)]


def test_a_frame_that_changes_is_not_mixed_with_the_old_one() -> None:
    other = bytearray(STATION)
    other[14] ^= 3  # it fell out of step
    stream = np.concatenate(
        [np.tile(ootx.encode_frame(STATION), 3), np.tile(ootx.encode_frame(bytes(other)), 3)]
    )
    stream[443 * 2 + 200 :: 50] = ootx.MISSING_BIT
    found = ootx.decode_frames(stream)
    assert {f.payload for f in found if f.is_valid} <= {STATION, bytes(other)}
    assert [f.is_valid for f in found].count(True) >= 5


def test_unobservable_properties_of_a_recording() -> None:
    frame = ootx.encode_frame(STATION)
    assert ootx.decode_frames([]) == []
    assert ootx.decode_frames(frame[:-1])[:1] != []
    assert ootx.decode_frames(frame[:400]) == []
    assert ootx.decode_frames(np.full(5000, ootx.MISSING_BIT)) == []
    for bits in (np.zeros(5000), np.ones(5000), noise(200_000, 3)):
        assert ootx.decode_frames(bits) == []


def test_wrong_arguments() -> None:
    for bits in ([2, 0, 1], [[0, 1]], [0.5], [float("nan")]):
        with pytest.raises(InputError):
            ootx.decode_frames(bits)
    for size in (0, 33, 42, 44):
        with pytest.raises(InputError, match="43"):
            ootx.encode_frame(bytes(size))
        with pytest.raises(InputError, match="43"):
            ootx.decode_factory_data(bytes(size))


@pytest.mark.parametrize("place", [6, 8, 10, 12, 16, 18, 23, 25, 27, 29, 33, 35, 37, 39])
def test_parameters_that_are_no_numbers_are_refused(place: int) -> None:
    for half in (0x7C00, 0xFC00, 0x7E00):
        payload = bytearray(STATION)
        payload[place : place + 2] = struct.pack("<H", half)
        with pytest.raises(InputError, match="not finite"):
            ootx.decode_factory_data(bytes(payload))


def test_channels_beyond_16_are_refused() -> None:
    payload = bytearray(STATION)
    payload[31] = 0x90
    with pytest.raises(InputError, match="channel"):
        ootx.decode_factory_data(bytes(payload))


@pytest.mark.slow
@settings(deadline=None)
@given(
    st.lists(st.sampled_from([-1, 0, 1]), max_size=1500),
    st.lists(st.integers(0, 1328), max_size=60),
    PAYLOADS,
)
def test_no_frame_is_right_that_was_not_sent(
    junk: list[int], hits: list[int], payload: bytes
) -> None:
    stream = np.tile(ootx.encode_frame(payload), 3)
    stream[hits[:30]] ^= 1
    stream[hits[30:]] = ootx.MISSING_BIT
    for frame in ootx.decode_frames(np.concatenate([junk, stream])):
        assert not frame.is_valid or frame.payload == payload


@given(PAYLOADS)
def test_any_payload_is_read_or_refused(payload: bytes) -> None:
    try:
        data = ootx.decode_factory_data(payload)
    except LocatkError:
        return
    assert np.all(np.isfinite(data.calibration.sweeps))
    assert 1 <= data.channel <= 16


def slow_bits(path: Path) -> dict[int, Bits]:
    """Slow bits of each station (channel from 0), one a rotation by its 48 MHz time codes."""
    rows: dict[int, list[tuple[int, int]]] = {}
    with gzip.open(path, "rt", errors="replace") as lines:
        for line in lines:
            cells = line.split()
            if len(cells) >= 6 and cells[2] == "Y":
                rows.setdefault(int(cells[3]), []).append((int(cells[4]), int(cells[5])))
    found = {}
    for channel, events in rows.items():
        bits: list[int] = []
        last = events[0][0]
        for code, bit in events:
            passed = (code - last) % (1 << 32) / PERIOD_TICKS[channel]
            if abs(passed - round(passed)) < 1e-3:  # else no time code of a rotor's zero
                bits += [ootx.MISSING_BIT] * (round(passed) - 1) + [bit]
                last = code
        found[channel] = np.array(bits, np.int8)
    return found


@pytest.mark.slow
def test_four_stations_of_a_libsurvive_recording(data: Path) -> None:
    """Equal, field by field, to what libsurvive stored beside it.

    It prints values that were rounded to six decimals, of a 32-bit float, with twelve.
    """
    path = data / "lighthouse/libsurvive/tracker-cal-attempt.rec.gz"
    stored = {
        int(entry["id"]): entry
        for entry in map(
            json.loads,
            re.findall(r'"lighthouse\d":(\{.*?\n\})', (Path(f"{path}.json")).read_text(), re.S),
        )
    }
    seen = set()
    for channel, bits in slow_bits(path).items():
        found = ootx.decode_frames(bits)
        assert len(found) >= 5
        assert all(f.is_valid for f in found)
        assert len({f.payload for f in found}) == 1
        factory = ootx.decode_factory_data(found[0].payload)
        entry = stored[factory.id]
        seen.add(factory.id)
        assert factory.channel == channel + 1 == int(entry["mode"]) + 1
        columns = zip(PARAMETERS, factory.calibration.sweeps.T.tolist(), strict=True)
        for name, values in columns:
            key = "fcalgibpha" if name == "gibphase" else f"fcal{name}"
            printed = [f"{np.float32(round(value, 6)):.12f}" for value in values]
            assert [float(v) for v in printed] == [float(v) for v in entry[key]], (channel, name)
    assert {f"{number:08x}" for number in seen} == {"10d7e7bf", "4096b5a0", "a4dbc8a4", "ca94a6b6"}


@pytest.mark.parametrize(("received", "starts"), [(36, [0]), (35, [])])
def test_a_frame_needs_36_of_its_fixed_bits(received: int, starts: list[int]) -> None:
    bits = np.full(2 * ootx.FRAME_BITS, ootx.MISSING_BIT, np.int8)
    fixed = ootx._FIXED_POSITIONS[:received]
    bits[fixed] = ootx._FIXED_BITS[:received]
    assert len(ootx._FIXED_POSITIONS) == 67
    assert ootx._find_starts(bits).tolist() == starts


@pytest.mark.parametrize(("missing", "is_solved"), [(8, True), (9, False)])
def test_at_most_eight_bits_are_solved_for(missing: int, is_solved: bool) -> None:
    frame = ootx.encode_frame(STATION)
    # Bits of the serial number, none of them fixed.
    frame[18 + 34 + 17 : 18 + 34 + 17 + missing] = ootx.MISSING_BIT
    solved = ootx._solve_missing(frame)
    assert (solved is not None) == is_solved
    if solved is not None:
        assert np.array_equal(solved, ootx.encode_frame(STATION))


def test_a_wrong_frame_with_missing_bits_is_not_solved() -> None:
    frame = ootx.encode_frame(STATION)
    frame[60] ^= 1
    frame[70:74] = ootx.MISSING_BIT
    assert ootx._solve_missing(frame) is None


@pytest.mark.parametrize(("distance", "votes"), [(8, 1), (9, 0)])
def test_frames_vote_up_to_eight_frames_away(distance: int, votes: int) -> None:
    window = np.full((20, ootx.FRAME_BITS), ootx.MISSING_BIT, np.int8)
    window[10, 50] = 1
    assert ootx._votes(window)[10 - distance, 50] == votes
    assert ootx._votes(window)[min(10 + distance, 19), 50] == votes


@pytest.mark.parametrize(("distance", "overlaps"), [(442, True), (443, False)])
def test_frames_overlap_within_their_length(distance: int, overlaps: bool) -> None:
    starts = np.array([1000 - distance, 1000 + distance])
    assert ootx._overlaps_valid(starts, np.array([1000])).tolist() == [overlaps] * 2
    assert ootx._overlaps_valid(starts, np.zeros(0, np.int64)).tolist() == [False] * 2
