"""Headerless float32 arrays on the published recordings: bytes of the CSV, damaged, decoded."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.formats import tags
from locatk.formats.importers.polaris_csv import read_polaris
from locatk.formats.wire import DEVICES
from locatk.formats.wire.decoder import Batch, Counts, Options, Stream
from locatk.formats.wire.recording import Recording

RUNS = ["default/RawData_1.csv", "default/RawData_7.csv", "varying/RawData_2.csv"]


def published(data: Path, name: str) -> Samples:
    return read_polaris(data / "polaris" / name, rate_hz=40, spacing_m=0.02).samples


def frames_of(samples: Samples, device: str = "polaris-array") -> list[bytes]:
    return [frame for _, frame in DEVICES[device].encode(Recording(samples=[samples]))]


def synthetic(sensors: int, count: int = 300) -> Samples:
    """Offsets by sensor, noise of a microtesla; nothing passes."""
    rng = np.random.default_rng(3)
    level = rng.normal(0, 40e-6, (sensors, 3))
    field = level + rng.normal(0, 1e-6, (count, sensors, 3))
    return Samples("bar", SensorArray(bar(sensors, 0.02)), 10**9 * np.arange(1, count + 1), field)


def decode(
    pieces: Iterable[bytes], *, pauses: bool, device: str = "polaris-array"
) -> tuple[NDArray[np.float64], list[Batch], Counts, list[str]]:
    decoder = DEVICES[device].decode(Options())
    batches = [batch for piece in pieces for batch in decoder.feed(piece, pause=pauses)]
    batches += decoder.finish()
    fields = [np.asarray(batch.columns["b_tesla"], float) for batch in batches]
    joined = np.concatenate(fields) if fields else np.zeros((0, 27))
    return joined, batches, decoder.counts, decoder.remarks


def wrong(found: NDArray[np.float64], samples: Samples) -> int:
    """Rows of ``found`` that are no sample of the recording."""
    truth = samples.field_t.reshape(len(samples), -1)
    apart = np.abs(found[:, None] - truth[None]).max(axis=2).min(axis=1)
    return int(np.count_nonzero(apart > 1e-10))


@pytest.mark.parametrize("name", RUNS)
def test_a_whole_recording_is_what_the_csv_says(data: Path, name: str) -> None:
    samples = published(data, name)
    frames = frames_of(samples)
    assert {len(frame) for frame in frames} == {108}
    found, batches, counts, remarks = decode(frames, pauses=False)
    np.testing.assert_allclose(found, samples.field_t.reshape(len(samples), -1), atol=1e-11)
    ends = np.concatenate([batch.end for batch in batches])
    np.testing.assert_array_equal(ends, 108 * np.arange(1, len(frames) + 1))
    assert (counts.frames, counts.bad, counts.skipped) == (len(frames), 0, 0)
    assert any("first" in remark for remark in remarks)  # nothing told where a frame begins


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("cut", [1, 12, 36, 53, 72, 107])
def test_pauses_tell_where_a_frame_begins(data: Path, name: str, cut: int) -> None:
    samples = published(data, name)
    frames = frames_of(samples)
    found, _, _, remarks = decode([frames[0][cut:], *frames[1:]], pauses=True)
    assert len(found) == len(frames) - 1
    assert wrong(found, samples) == 0
    assert remarks == []


@pytest.mark.parametrize("cut", [1, 12, 53, 72])
def test_without_pauses_a_doubt_is_told(data: Path, cut: int) -> None:
    frames = frames_of(published(data, RUNS[0]))
    found, _, _, remarks = decode([b"".join(frames)[cut:]], pauses=False)
    assert len(found) > 0
    assert any("which sensor is the first" in remark for remark in remarks)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("kind", ["lost", "added", "flipped"])
def test_it_recovers_after_any_byte(data: Path, kind: str, seed: int) -> None:
    """No frame is wrong, and few are lost by each fault."""
    samples = published(data, RUNS[seed % len(RUNS)])
    rng = np.random.default_rng(seed)
    stream = bytearray(b"".join(frames_of(samples)))
    for place in rng.choice(np.arange(30, len(samples) - 20, 25), 5, replace=False).tolist():
        at = 108 * place + int(rng.integers(108))
        if kind == "lost":
            del stream[at : at + int(rng.integers(1, 108))]
        elif kind == "added":
            stream[at:at] = rng.bytes(int(rng.integers(1, 60)))
        else:
            stream[at - at % 4 + 3] ^= 0x40  # an exponent: a field that cannot be
    found, _, counts, _ = decode([bytes(stream)], pauses=False)
    left = ~np.isnan(found).any(axis=1)
    assert wrong(found[left], samples) == 0
    assert left.sum() >= len(samples) - 5 * 3
    assert counts.frames == len(found)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 400), max_size=60), st.integers(0, 200))
def test_any_split_gives_the_same(sizes: list[int], garbage: int) -> None:
    stream = np.random.default_rng(garbage).bytes(garbage)
    stream += b"".join(frames_of(synthetic(9, 60)))
    pieces, place = [], 0
    for size in sizes:
        pieces.append(stream[place : place + size])
        place += size
    pieces.append(stream[place:])
    whole, one = decode([stream], pauses=False), decode(pieces, pauses=False)
    np.testing.assert_array_equal(whole[0], one[0])
    assert whole[2] == one[2]
    ends = [np.concatenate([b.end for b in each[1]]) if each[1] else [] for each in (whole, one)]
    np.testing.assert_array_equal(ends[0], ends[1])


@pytest.mark.parametrize(("sensors", "size"), [(9, 108), (3, 36)])
def test_both_polaris_bars_are_told_apart(sensors: int, size: int) -> None:
    samples = synthetic(sensors)
    frames = frames_of(samples)
    assert {len(frame) for frame in frames} == {size}
    found, batches, _, _ = decode(frames, pauses=True)
    assert {batch.stream.sensors for batch in batches} == {sensors}
    assert len(found) == len(frames)
    assert wrong(found, samples) == 0
    known = DEVICES["polaris-array"].attached(batches[0].stream)
    assert len(tags.loads_array(known["array.toml"])) == sensors


@pytest.mark.parametrize("cut", [0, 1, 12, 50, 99])
def test_the_constant_slot_of_magx_tells_where_a_frame_begins(cut: int) -> None:
    samples = synthetic(8)
    frames = frames_of(samples, "magx-array")
    assert {len(frame) for frame in frames} == {100}
    found, batches, _, _ = decode([b"".join(frames)[cut:]], pauses=False, device="magx-array")
    assert batches[0].stream == Stream("magnetometers", sensors=8)
    assert len(found) >= len(frames) - 1
    assert wrong(found, samples) == 0


@pytest.mark.parametrize(
    "garbage",
    [np.random.default_rng(1).bytes(200_000), bytes(0), b"\xff" * 50_000],
    ids=["random", "nothing", "ones"],
)
def test_garbage_gives_nothing(garbage: bytes) -> None:
    found, _, counts, _ = decode([garbage], pauses=False)
    assert len(found) == counts.frames == 0


@pytest.mark.parametrize(("device", "sensors"), [("polaris-array", 8), ("magx-array", 9)])
def test_another_array_cannot_be_sent(device: str, sensors: int) -> None:
    with pytest.raises(InputError, match="sensors"):
        frames_of(synthetic(sensors, 3), device)
