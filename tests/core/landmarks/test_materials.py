"""Bill of materials of a floor, and the number of landmarks of each pattern."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.design.materials import bill_of_materials, count_patterns
from locatk.core.landmarks.landmark import PATTERNS, code_of
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap


def floor(codes: list[list[int]]) -> FloorMap:
    return FloorMap(np.array(codes))


def test_materials_are_counted() -> None:
    floor_map = floor([[0, 5, 10, 7], [HOLE_CODE, 14, 7, 0]])
    items = {item.part: item for item in bill_of_materials(floor_map, spares_percent=10)}
    assert items["bar magnet"].count == 4 * 7
    assert items["bar magnet, spare"].count == 3
    assert "30 x 10 x 5 mm NdFeB N35" in items["bar magnet"].detail
    assert "bar magnet, spare" not in {item.part for item in bill_of_materials(floor_map, 0)}
    result = {
        item.letters: (item.number, item.landmarks, item.codes)
        for item in count_patterns(floor_map)
    }
    assert result == {
        "NSNS": (1, 2, ((5, 1), (10, 1))),
        "NNNS": (3, 3, ((7, 2), (14, 1))),
        "SSSS": (6, 2, ((0, 2),)),
    }
    with pytest.raises(InputError):
        bill_of_materials(floor_map, -1)


def test_patterns_that_occur_have_the_papers_numbers() -> None:
    floor_map = floor([[code_of(letters) for letters in PATTERNS]])
    assert [item.letters for item in count_patterns(floor_map)] == list(PATTERNS)
