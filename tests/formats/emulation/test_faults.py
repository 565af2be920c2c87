"""Faults of a line: how many, which, and the same ones however the stream is cut."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.formats.emulation.byte_stream import LineFaults, RandomEvents

DATA = np.random.default_rng(0).bytes(200_000)


def bits(one: bytes, other: bytes) -> int:
    """How many bits differ."""
    differ = np.frombuffer(one, np.uint8) ^ np.frombuffer(other, np.uint8)
    return int(np.unpackbits(differ).sum())


def test_a_good_line_changes_nothing() -> None:
    faults = LineFaults()
    assert faults.apply(DATA) == DATA
    assert (faults.dropped, faults.flipped) == (0, 0)


def test_bytes_are_lost_as_often_as_said() -> None:
    faults = LineFaults(drop=0.01, seed=4)
    left = faults.apply(DATA)
    assert len(left) == len(DATA) - faults.dropped
    assert faults.dropped == pytest.approx(2000, abs=5 * 2000**0.5)
    assert faults.flipped == 0
    rest = iter(DATA)
    assert all(value in rest for value in left)  # the same ones in the same order


def test_bits_turn_over_as_often_as_said() -> None:
    faults = LineFaults(flip=1e-3, seed=4)
    spoilt = faults.apply(DATA)
    assert len(spoilt) == len(DATA)
    assert faults.flipped == bits(DATA, spoilt)
    assert faults.flipped == pytest.approx(1600, abs=5 * 1600**0.5)
    differ = np.frombuffer(DATA, np.uint8) ^ np.frombuffer(spoilt, np.uint8)
    by_bit = np.unpackbits(differ[:, None], axis=1).sum(axis=0)
    assert by_bit == pytest.approx(np.full(8, 200), abs=5 * 200**0.5)


def test_failures_have_the_gaps_of_independent_trials() -> None:
    places = RandomEvents(0.2, np.random.default_rng(1)).failures(100_000)
    gaps = np.diff(places)
    assert gaps.min() == 1
    assert (gaps == 1).mean() == pytest.approx(0.2, abs=0.02)
    assert gaps.var() == pytest.approx(0.8 / 0.2**2, rel=0.1)


@pytest.mark.parametrize("probability", [0.0, 1e-15, 1.0])
def test_never_hardly_ever_and_always(probability: float) -> None:
    strikes = RandomEvents(probability, np.random.default_rng(0))
    for _ in range(3):
        assert len(strikes.failures(1000)) == (1000 if probability == 1 else 0)


def test_all_lost_and_all_turned() -> None:
    assert LineFaults(drop=1.0).apply(DATA) == b""
    assert LineFaults(flip=1.0).apply(b"\x00\x0f\xff") == b"\xff\xf0\x00"


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(0, 400), max_size=30),
    st.sampled_from([0.0, 0.003, 0.1, 0.9]),
    st.sampled_from([0.0, 0.0005, 0.02, 0.7]),
)
def test_any_split_meets_the_same_faults(sizes: list[int], drop: float, flip: float) -> None:
    data = DATA[: sum(sizes)]
    whole, cut = LineFaults(drop, flip, seed=7), LineFaults(drop, flip, seed=7)
    edges = np.cumsum([0, *sizes]).tolist()
    pieces = [data[start:stop] for start, stop in pairwise(edges)]
    assert b"".join(map(cut.apply, pieces)) == whole.apply(data)
    assert (cut.dropped, cut.flipped) == (whole.dropped, whole.flipped)


def test_another_seed_is_another_line() -> None:
    one, same, other = (LineFaults(0.1, 0.1, seed).apply(DATA) for seed in (1, 1, 2))
    assert one == same
    assert one != other


@pytest.mark.parametrize("wrong", [{"drop": -0.1}, {"flip": 1.1}, {"drop": float("nan")}])
def test_probabilities_are_checked(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        LineFaults(**wrong)
