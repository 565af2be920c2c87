"""Maps by search: proved unique, always the same, refused where there is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import DegenerateError, InputError
from locatk.core.landmarks.design import generation, search
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.landmarks.map.windows import ALPHABET_CODES, passable_steps, place_windows

MODES = [
    (5, 6, "6", "L", 0),
    (7, 7, "6", "L", 0),
    (10, 11, "16", "L", 0),
    (6, 6, "16", "L", 1),
    (6, 7, "16", "I2", 0),
    (9, 9, "16", "I3", 0),
    (5, 6, "6", "I3", 0),
    (12, 12, "6", "2x2", 0),
    (5, 5, "6", "2x2", 1),
    (9, 9, "16", "2x2", 1),
    (20, 20, "6", "3x3", 0),
    (9, 9, "16", "3x3", 0),
    (8, 8, "16", "3x3", 1),
    (5, 5, "compass", "L", 0),
    (7, 8, "compass", "2x2", 0),
    (12, 12, "compass", "3x3", 0),
    (1, 1, "16", "L", 0),
    (2, 9, "16", "L", 0),
]


def options(rows: int, columns: int, alphabet: str, window: str, detect: int) -> DesignOptions:
    return DesignOptions(rows, columns, window=window, alphabet=alphabet, detect=detect)


@pytest.mark.parametrize("mode", MODES)
def test_maps_hold_what_they_promise(mode: Any, walked: Callable[[FloorMap], Any]) -> None:
    floor = design_map(options(*mode))
    words = [letters for _, letters in walked(floor).values()]
    assert len(set(words)) == len(words)
    assert floor.shape == mode[:2]
    assert set(np.unique(floor.codes)) <= set(ALPHABET_CODES[mode[2]])
    assert prove_map(floor, steps=False).holds
    for position in range(len(words[0]) if words and mode[4] else 0):
        rest = {word[:position] + word[position + 1 :] for word in words}
        assert len(rest) == len(words)


@pytest.mark.slow
@pytest.mark.skipif(search.kernels is None, reason="in Python these take minutes")
@pytest.mark.parametrize(
    "mode",
    [
        (24, 24, "16", "L", 0),
        (17, 17, "6", "2x2", 0),
        (100, 100, "16", "2x2", 0),
        (8, 8, "16", "I2", 0),
        (28, 28, "16", "I3", 0),
        (7, 7, "16", "L", 1),
        (22, 22, "16", "2x2", 1),
    ],
)
def test_sizes_of_the_facts_are_found(mode: Any) -> None:
    assert prove_map(design_map(options(*mode)), steps=False).holds


def test_same_seed_same_map() -> None:
    expected = options(12, 9, "16", "L", 0)
    maps = [design_map(replace(expected, seed=seed)) for seed in (0, 0, 1, -5, 2**40)]
    assert (maps[0].codes == maps[1].codes).all()
    assert all((maps[0].codes != other.codes).mean() > 0.5 for other in maps[2:])
    assert [floor.seed for floor in maps] == [0, 0, 1, -5, 2**40]


def test_the_map_has_the_requested_properties() -> None:
    geometry = Geometry(bar_length_m=0.02)
    forbidden = frozenset({(0, 0), (3, 4), (2, 2)})
    walls = frozenset({((1, 1), (1, 2)), ((5, 3), (4, 3))})
    expected = DesignOptions(
        6, 7, alphabet="6", pitch_m=0.25, forbidden=forbidden, walls=walls, geometry=geometry
    )
    floor = design_map(expected)
    assert {tuple(cell) for cell in np.argwhere(floor.codes == HOLE_CODE).tolist()} == forbidden
    assert floor.walls == {((1, 1), (1, 2)), ((4, 3), (5, 3))}
    assert (floor.pitch_m, floor.geometry, floor.window) == (0.25, geometry, "L")
    assert prove_map(floor).is_unique


def test_more_than_the_bound_is_refused() -> None:
    with pytest.raises(InputError, match="only 4096"):
        design_map(DesignOptions(40, 40))


def test_an_exhausted_budget_reports_the_remainder() -> None:
    """34 x 34 less one is within the bound, and none is known."""
    observed: list[tuple[float, int]] = []
    options = DesignOptions(32, 32, evaluations=100_000)
    message = r"at best \d+ of 3844 words of its readings repeat"
    with pytest.raises(DegenerateError, match=message) as error:
        design_map(options, lambda *report: observed.append(report))
    assert "seed" in str(error.value.hint)
    shares = [share for share, _ in observed]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert all(left > 0 for _, left in observed)


def test_large_tables_leave_time_for_one_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each stage builds a table of all possible words, which may take longer than its steps."""
    reported: list[float] = []
    monkeypatch.setattr(generation, "MAX_SETUP_WORDS", 20 * 4096)
    with pytest.raises(DegenerateError):
        design_map(
            DesignOptions(32, 32, evaluations=100_000), lambda used, _: reported.append(used)
        )
    assert len(reported) == 20
    assert reported[-1] == 1.0
    monkeypatch.setattr(generation, "MAX_SETUP_WORDS", 1)
    assert design_map(DesignOptions(9, 9)).shape == (9, 9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alphabet": "7"}, "alphabet"),
        ({"window": "4x4"}, "window"),
        ({"rows": 0}, "0 x 5"),
        ({"rows": 10**4, "columns": 10**4}, "cells"),
        ({"detect": 3}, "detect is 3"),
        ({"detect": -1}, "detect"),
        ({"pitch_m": 0.0}, "pitch"),
        ({"pitch_m": float("nan")}, "pitch"),
        ({"forbidden": frozenset({(5, 0)})}, "5,0 is not on the floor"),
        ({"walls": frozenset({((0, 0), (1, 1))})}, "not between two neighbouring"),
        ({"walls": frozenset({((4, 4), (4, 5))})}, "not between two neighbouring"),
    ],
)
def test_options_that_are_none(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        design_map(replace(DesignOptions(5, 5), **change))


@pytest.mark.skipif(search.kernels is None, reason="the compiled twin is not built")
@pytest.mark.parametrize("mode", [mode for mode in MODES if mode[0] * mode[1] < 150])
def test_twins_draw_the_same(mode: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, columns, alphabet, window, detect = mode
    there = np.ones((rows, columns), bool)
    cells, heading = place_windows(there, passable_steps(FloorMap(there.astype(np.int64))), window)
    flat = cells[..., 0] * columns + cells[..., 1]
    task = search.build_problem(rows * columns, flat, heading, window, alphabet, detect)
    one = search.random_values(rows * columns, search.LETTER_COUNTS[alphabet], 4)
    other = one.copy()
    heat = search.letter_weights(1.5)
    left = search.search(task, one, heat, 9, 150)
    monkeypatch.setattr(search, "kernels", None)
    assert search.search(task, other, heat, 9, 150) == left
    assert (one == other).all()
    words = task.words(one)
    assert left == len(words) - len(np.unique(words))


@pytest.mark.parametrize("mode", [(5, 6, "6", "L", 0), (5, 5, "16", "2x2", 1)])
def test_the_map_does_not_depend_on_compiled_loops(
    mode: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = design_map(options(*mode)).codes
    monkeypatch.setattr(search, "kernels", None)
    assert (design_map(options(*mode)).codes == compiled).all()


def test_weights_are_those_of_a_heat_bath() -> None:
    heat = search.letter_weights(0.5).astype(float)
    assert heat[0] == 2**search.WEIGHT_BITS
    assert heat[1:4] / heat[:3] == pytest.approx(np.exp(-2), rel=1e-3)
    assert heat[-1] <= 2


def test_progress_is_the_used_fraction_of_the_budget() -> None:
    fractions: list[float] = []
    options = DesignOptions(32, 32, evaluations=2_000_000)
    with pytest.raises(DegenerateError):
        design_map(options, lambda fraction, repeats: fractions.append(fraction))
    assert fractions[-1] == pytest.approx(1.0)
    # The first third of the stages are the short rounds: 1 of 13 parts of the budget.
    assert fractions[len(fractions) // 3 - 1] == pytest.approx(1 / 13)
