"""Maps that ship, and floors that are cut of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.design.bounds import require_enough_words
from locatk.core.landmarks.design.generation import DesignOptions
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, rotated
from locatk.core.landmarks.map.floor import ALPHABETS, HOLE_CODE, WINDOWS, FloorMap
from locatk.core.landmarks.map.windows import ALPHABET_CODES, window_readings
from locatk.formats.artifacts import map_library
from locatk.formats.artifacts.map_library import (
    LibraryMap,
    crop_map,
    library_maps,
    random_relabelling,
    rotated_map,
)

LEAST = {
    ("6", "L", 0): 7,
    ("16", "L", 0): 25,
    ("6", "2x2", 0): 18,
    ("16", "2x2", 0): 116,
    ("16", "I2", 0): 8,
    ("16", "I3", 0): 28,
    ("6", "I3", 0): 7,
    ("6", "3x3", 0): 200,
    ("compass", "L", 0): 6,
    ("compass", "2x2", 0): 10,
    ("16", "L", 1): 7,
    ("16", "2x2", 1): 22,
    ("6", "2x2", 1): 6,
}
"""Side of the square floor that is there at least: as large as annealing reached, or larger."""


def wanted(entry: LibraryMap, rows: int, columns: int, seed: int = 0) -> DesignOptions:
    return DesignOptions(
        rows, columns, entry.window, entry.alphabet, seed=seed, detect=entry.detect
    )


@pytest.mark.slow
@pytest.mark.parametrize("entry", library_maps(), ids=lambda entry: entry.file)
def test_maps_of_the_library_hold(entry: LibraryMap) -> None:
    """By a count of words that shares nothing with the prover."""
    codes = entry.codes()
    assert codes.shape == (entry.rows, entry.columns)
    assert set(np.unique(codes)) <= set(ALPHABET_CODES[entry.alphabet])
    seen = window_readings(FloorMap(codes, alphabet=entry.alphabet, window=entry.window)).letters
    size = seen.shape[1]
    for lost in range(size) if entry.detect else [size]:
        rest = np.delete(seen, lost, axis=1) if entry.detect else seen
        assert len({row.tobytes() for row in rest}) == len(seen)
    require_enough_words(
        entry.rows,
        entry.columns,
        alphabet=entry.alphabet,
        window=entry.window,
        detect=entry.detect,
    )


@pytest.mark.parametrize("mode", LEAST, ids=str)
def test_maps_are_at_least_as_large_as_promised(mode: tuple[str, str, int]) -> None:
    sides = [
        min(e.rows, e.columns) for e in library_maps() if (e.alphabet, e.window, e.detect) == mode
    ]
    assert max(sides) >= LEAST[mode]


def test_every_mode_has_a_map() -> None:
    assert {(a, w) for a in ALPHABETS for w in WINDOWS} - {("6", "I2")} == {
        (entry.alphabet, entry.window) for entry in library_maps()
    }


@pytest.mark.slow
@pytest.mark.parametrize("entry", library_maps(), ids=lambda entry: entry.file)
def test_cropped_maps_are_unique_and_differ_by_seed(entry: LibraryMap) -> None:
    rows, columns = max(1, min(9, entry.rows - 1)), min(7, entry.columns)
    floors = [crop_map(wanted(entry, rows, columns, seed)) for seed in range(6)]
    assert all(floor is not None and floor.shape == (rows, columns) for floor in floors)
    assert all(prove_map(floor, steps=False).holds for floor in floors if floor)
    assert len({floor.codes.tobytes() for floor in floors if floor}) >= 3
    again = crop_map(wanted(entry, rows, columns, 3))
    assert again is not None
    assert floors[3] is not None
    assert (again.codes == floors[3].codes).all()
    assert again.notes == floors[3].notes != ()
    for floor in floors:
        assert floor is not None
        assert set(np.unique(floor.codes)) <= set(ALPHABET_CODES[entry.alphabet])


def test_whole_maps_are_cropped_in_both_orientations() -> None:
    (entry,) = [e for e in library_maps() if (e.alphabet, e.window, e.detect) == ("6", "I3", 0)]
    assert entry.rows != entry.columns
    for rows, columns in ((entry.rows, entry.columns), (entry.columns, entry.rows)):
        for seed in range(8):
            floor = crop_map(wanted(entry, rows, columns, seed))
            assert floor is not None
            assert prove_map(floor, steps=False).is_unique


@pytest.mark.parametrize("alphabet", ALPHABETS)
@pytest.mark.parametrize("quarters", range(4))
def test_a_rotated_map_has_the_same_readings(alphabet: str, quarters: int) -> None:
    """The letters have the same order, each under the rotated heading."""
    codes = np.random.default_rng(1).choice(ALPHABET_CODES[alphabet], (4, 5))
    for window in WINDOWS:
        before = window_readings(FloorMap(codes, alphabet=alphabet, window=window))
        after = window_readings(
            FloorMap(rotated_map(codes, quarters, alphabet), alphabet=alphabet, window=window)
        )
        letters = after.letters
        if alphabet == "compass":  # landmarks stay as they lie: seen in the map's frame
            letters = rotated(letters, after.heading[:, None])
            old = rotated(before.letters, before.heading[:, None])
        else:
            old = before.letters
        one = sorted(zip((before.heading + quarters) % 4, old.tolist(), strict=True))
        assert one == sorted(zip(after.heading, letters.tolist(), strict=True))


def test_rotation_by_90_degrees() -> None:
    """Counter-clockwise with y up: cells right of the origin are above it afterwards."""
    codes = np.array([[1, 2], [3, 4]])  # row 0 is the lower one
    assert rotated_map(codes, 1, "6").tolist() == [[3, 1], [4, 2]]
    assert rotated_map(codes, 1, "16").tolist() == [[6, 2], [8, 4]]


@pytest.mark.parametrize("alphabet", ALPHABETS)
def test_relabellings_keep_readings_different(alphabet: str) -> None:
    tables = [random_relabelling(alphabet, np.random.RandomState(seed)) for seed in range(30)]
    letters = np.array(ALPHABET_CODES[alphabet])
    for table in tables:
        assert sorted(table[letters]) == sorted(letters)
        if alphabet == "16":
            for turn in range(4):
                turned_first = table[rotated(np.arange(CODE_COUNT), turn)]
                assert (turned_first == rotated(table, turn)).all()
        if alphabet == "6":
            assert len(set(PATTERN_OF[table[letters]])) == 6
    assert len({table.tobytes() for table in tables}) > 5


def test_holes_and_walls_stay() -> None:
    forbidden = frozenset({(0, 3), (5, 5)})
    walls = frozenset({((1, 1), (1, 2))})
    floor = crop_map(DesignOptions(8, 8, forbidden=forbidden, walls=walls, pitch_m=0.3, seed=4))
    assert floor is not None
    assert {tuple(cell) for cell in np.argwhere(floor.codes == HOLE_CODE).tolist()} == forbidden
    assert (floor.walls, floor.pitch_m, floor.seed) == (walls, 0.3, 4)
    assert prove_map(floor).is_unique


def test_maps_that_the_library_lacks_are_searched() -> None:
    corridor = DesignOptions(2, 80)
    assert crop_map(corridor) is None
    assert prove_map(map_library.design_or_crop(corridor), steps=False).is_unique
    assert map_library.design_or_crop(DesignOptions(6, 6)).notes != ()
    assert map_library.design_or_crop(DesignOptions(2, 4, window="I2", alphabet="6")).notes == ()


def test_maps_that_detect_more_are_used_if_less_is_required() -> None:
    asked = DesignOptions(5, 5, detect=1)
    floor = crop_map(asked)
    assert floor is not None
    assert prove_map(floor, steps=False).detects >= 1
    assert crop_map(replace(asked, detect=2)) is None


def test_beyond_the_bound_is_refused() -> None:
    with pytest.raises(InputError, match="only 4096"):
        map_library.design_or_crop(DesignOptions(34, 34))
    with pytest.raises(InputError, match="window"):
        crop_map(DesignOptions(3, 3, window="5x5"))
