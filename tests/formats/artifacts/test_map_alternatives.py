"""Hints of failed designs: each change is followed, and gives a map."""

from __future__ import annotations

import bisect
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import DegenerateError, InputError
from locatk.core.landmarks.design.alternatives import REACHED_USAGE, word_usage
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.design.search import kernels
from locatk.formats.artifacts.map_library import design_or_crop

FLOORS = [
    (DesignOptions(27, 27), {"--window I3", "a floor of 25x25"}),
    (DesignOptions(34, 34), {"--window 2x2", "a floor of 25x25"}),
    (DesignOptions(90, 12), {"--window 2x2", "a floor of 49x12"}),
    (
        DesignOptions(9, 9, alphabet="6"),
        {"--alphabet 16", "--window 2x2", "a floor of 7x8"},
    ),
    (DesignOptions(10, 10, detect=1), {"--window 2x2", "--detect 0", "a floor of 7x8"}),
    (DesignOptions(200, 200, "2x2"), {"--window 3x3", "a floor of 119x119"}),
    (DesignOptions(200, 200, "2x2", detect=2), {"--window 3x3 --detect 1"}),
    # A window of 3x3 does not fit on two rows.
    (DesignOptions(2, 200, "I2", "6"), {"--window 2x2"}),
]


def failed_hint(options: DesignOptions) -> str:
    with pytest.raises((InputError, DegenerateError)) as caught:
        design_or_crop(replace(options, evaluations=100_000))
    return caught.value.hint or ""


def changed(options: DesignOptions, change: str) -> DesignOptions:
    if size := re.fullmatch(r"a floor of (\d+)x(\d+)", change):
        rows, columns = int(size[1]), int(size[2])
        return replace(options, rows=rows, columns=columns)
    pairs: dict[str, Any] = {}
    for name, value in re.findall(r"--(\w+) (\w+)", change):
        pairs[name] = int(value) if name in ("detect", "seed") else value
    assert pairs, change
    assert all(getattr(options, name) != value for name, value in pairs.items())
    return replace(options, **pairs)


@pytest.mark.slow
@pytest.mark.parametrize(("options", "named"), FLOORS, ids=range(len(FLOORS)))
def test_each_change_gives_a_map(options: DesignOptions, named: set[str]) -> None:
    hint = failed_hint(options)
    changes = hint.removeprefix("use ").split(", or ")
    assert named <= set(changes)
    for change in changes:
        remaining = changed(options, change)
        if "floor" in change and max(options.rows, options.columns) > 100:
            continue  # The search takes long; the limit is tested below.
        proof = prove_map(design_or_crop(remaining), steps=False)
        assert proof.holds
        assert proof.readings > 0


def test_the_seed_is_named_only_if_the_search_was_unlucky() -> None:
    """The map of the library has other proportions; a search of this size succeeds."""
    hint = failed_hint(DesignOptions(10, 55, seed=4))
    assert hint.startswith("use --seed 5, or ")
    assert "--window L" not in hint
    assert "--seed" not in failed_hint(DesignOptions(10, 70, seed=4))


def test_holes_count() -> None:
    """The readings of the remaining part with its hole are those of a smaller floor."""
    hole = frozenset((row, column) for row in range(8, 24) for column in range(8, 24))
    options = DesignOptions(34, 34, forbidden=hole)
    assert 0.52 < word_usage(options) < 1 < word_usage(replace(options, forbidden=frozenset()))
    size = re.search(r"a floor of (\d+)x(\d+)", failed_hint(options))
    assert size is not None
    assert int(size[1]) * int(size[2]) > 25 * 25


@pytest.mark.slow
@pytest.mark.skipif(kernels is None, reason="in Python these take minutes")
@pytest.mark.parametrize(("requirement", "limit"), REACHED_USAGE.items(), ids=str)
def test_searches_reach_the_stated_usage(requirement: tuple[str, str, int], limit: float) -> None:
    """Sides of 2:3, and a seed with which the limits were not measured."""
    alphabet, window, detect = requirement

    def floor_of(side: int) -> DesignOptions:
        columns = max(2, round(1.5 * side))
        return DesignOptions(side, columns, window, alphabet, detect=detect, seed=7)

    sides = range(2, 201)
    above = bisect.bisect_right(sides, limit, key=lambda side: word_usage(floor_of(side)))
    options = floor_of(sides[above - 1])
    if word_usage(options) > 0:
        floor = design_map(options)
        assert prove_map(floor, steps=False).holds
        assert np.unique(floor.codes).size > 1
