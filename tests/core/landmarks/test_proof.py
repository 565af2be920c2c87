"""Proofs, against published maps and against slow passes that share nothing with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.landmarks.design.proof import min_hamming_distance, prove_map
from locatk.core.landmarks.landmark import PATTERNS, code_of
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.landmarks.map.windows import window_readings

Walk = Callable[[FloorMap], dict[Any, Any]]

PUBLISHED = {
    "id6_L_7x7": ("6", "L"),
    "id6_S_17x17": ("6", "2x2"),
    "or16_I2_8x8": ("16", "I2"),
    "or16_I3_28x28": ("16", "I3"),
    "or16_L_24x24": ("16", "L"),
    "or16_S_100x100": ("16", "2x2"),
}


def published(folder: Path, name: str) -> FloorMap:
    path = folder / "landmarks" / f"{name}.txt"
    if not path.exists():
        pytest.skip(f"no {path}")
    digits = [
        [int(digit, 16) for digit in line] for line in path.read_text().split("\n")[1:] if line
    ]
    alphabet, window = PUBLISHED[name]
    codes = np.array(digits)
    if alphabet == "6":
        codes = np.array([code_of(letters) for letters in PATTERNS])[codes]
    return FloorMap(codes, alphabet=alphabet, window=window)


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_maps_are_unique(data: Path, walked: Walk, name: str) -> None:
    """facts/landmarks.md 4: found and verified by other programs."""
    floor = published(data, name)
    proof = prove_map(floor)
    by_letters = {letters for _, letters in walked(floor).values()}
    assert proof.is_unique
    assert proof.holds
    assert len(by_letters) == proof.readings
    assert proof.min_distance == 1
    assert proof.localization is not None
    assert proof.localization.never == 0
    assert (proof.landmarks_worst or 99) <= 5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["id6_S_17x17", "or16_L_24x24"])
def test_a_changed_letter_is_found_with_both_places(data: Path, walked: Walk, name: str) -> None:
    floor = published(data, name)
    found = 0
    for cell in floor.cells()[:40:3]:
        codes = floor.codes.copy()
        codes[cell] = codes[0, 5] if codes[cell] != codes[0, 5] else codes[0, 6]
        spoiled = replace(floor, codes=codes)
        proof = prove_map(spoiled, steps=False)
        walks = walked(spoiled)
        found += not proof.is_unique
        assert proof.duplicate_count == len(walks) - len({w for _, w in walks.values()})
        for one, other, letters in proof.duplicates:
            assert one != other
            assert walks[one][1] == walks[other][1] == letters
    assert found


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=25)
def test_as_slow_passes_say(
    seed: int, random_floor: Callable[[int], FloorMap], walked: Walk
) -> None:
    floor = random_floor(seed)
    proof = prove_map(floor)
    walks = list(walked(floor).values())
    words = [letters for _, letters in walks]
    apart = [sum(a != b for a, b in zip(x, y, strict=True)) for x, y in combinations(words, 2)]
    assert proof.readings == len(words)
    assert proof.is_unique == (len(set(words)) == len(words))
    assert proof.min_distance == (min(apart) if apart else None)
    assert proof.is_unique == (proof.duplicate_count == 0) == (not proof.duplicates)
    if apart:
        assert proof.detects == max(0, min(apart) - 1)
    silent = np.zeros(floor.shape, int)
    doubtful = np.zeros(floor.shape, int)
    lost = np.zeros(floor.shape, int)
    for cell in floor.cells():
        for bar in range(4):
            codes = floor.codes.copy()
            codes[cell] ^= 1 << bar
            for place, (cells, wrong) in walked(replace(floor, codes=codes)).items():
                if cell in cells:
                    true = walked_word(floor, place)
                    silent[cell] += wrong in words
                    doubtful[cell] += wrong in words or words.count(true) > 1
        for cells, word in walks:
            if cell in cells:
                at = cells.index(cell)
                rest = [w[:at] + w[at + 1 :] for w in words]
                lost[cell] += rest.count(word[:at] + word[at + 1 :]) > 1
    for faults, slow in (
        (proof.flipped_bar, silent),
        (proof.missing_bar, doubtful),
        (proof.missing_landmark, lost),
    ):
        assert faults.by_cell.tolist() == slow.tolist()
        assert faults.harmful == slow.sum()
        assert all(slow[cell] > 0 for cell in faults.worst)
        assert (faults.worst != ()) == bool(slow.any())
        if faults.worst:
            assert slow[faults.worst[0]] == slow.max()
    cases = sum(len(cells) for cells, _ in walks)
    assert proof.missing_landmark.cases == cases
    assert proof.flipped_bar.cases == proof.missing_bar.cases == 4 * cases


def walked_word(floor: FloorMap, place: tuple[tuple[int, int], int]) -> tuple[int, ...]:
    seen = window_readings(floor)
    (row,) = np.flatnonzero((seen.cells[:, 0] == place[0]).all(1) & (seen.heading == place[1]))
    return tuple(seen.letters[row].tolist())


def test_least_distance_is_told_beyond_one() -> None:
    words = np.array([[0, 0, 0, 0], [1, 2, 3, 0], [15, 15, 0, 15]])
    assert min_hamming_distance(words) == 3
    assert min_hamming_distance(words[[0, 0]]) == 0
    assert min_hamming_distance(np.array([[0, 0], [1, 1]])) == 2
    assert min_hamming_distance(words[:1]) is None


def test_what_is_promised_is_not_believed() -> None:
    floor = FloorMap(np.array([[0, 1], [3, 7]]), alphabet="16", detect=1)
    proof = prove_map(floor)
    assert proof.is_unique
    assert proof.promised == 1
    assert proof.holds == (proof.detects >= 1)
    assert not prove_map(replace(floor, codes=np.zeros((2, 2), int))).holds


def test_floors_without_a_window_are_proved_too() -> None:
    for codes in ([[5]], [[HOLE_CODE]], [[3, HOLE_CODE], [HOLE_CODE, 3]]):
        proof = prove_map(FloorMap(np.array(codes)))
        assert proof.readings == 0
        assert proof.is_unique
        assert proof.min_distance is None
        assert proof.flipped_bar.harmful_fraction == 0


def test_fingerprint_tells_maps_apart() -> None:
    floor = FloorMap(np.arange(9).reshape(3, 3))
    codes = floor.codes.copy()
    codes[2, 2] = HOLE_CODE
    others = [
        floor,
        replace(floor, codes=codes),
        replace(floor, codes=floor.codes.T),
        replace(floor, window="I2"),
        replace(floor, walls=frozenset({((0, 0), (0, 1))})),
    ]
    prints = [prove_map(other, steps=False).fingerprint for other in others]
    assert len(set(prints)) == len(others)
    # What a proof is not about leaves it as it is.
    assert prove_map(replace(floor, pitch_m=0.3, name="x"), steps=False).fingerprint == prints[0]
