"""Maps by search: a letter for each cell such that no two windows of the floor read the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from locatk.core.errors import DegenerateError, InputError
from locatk.core.landmarks.design.bounds import refuse_readings
from locatk.core.landmarks.design.search import LETTERS, problem, random_values, search, weights
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import ALPHABETS, HOLE, STEPS, WINDOWS, Cell, FloorMap, Wall
from locatk.core.landmarks.map.windows import ALPHABET_CODES, PATHS, placements, ways

LADDERS = ((0.45, 0.3), (0.6, 0.4), (0.38, 0.3), (0.8, 0.5))
"""Temperatures between which a round cools, round after round, in conflicts: loose maps fall
into place with any, and the tighter a map is, the better one ladder suits than the others."""

LENGTHS = (1, 3, 9)
"""Of the rounds in turn: all ladders are gone through fast before any is gone through slowly."""

STAGES = 16
"""Temperatures of a round."""

LARGEST_CELLS = 1_000_000


@dataclass(frozen=True)
class DesignOptions:
    """Which map is wanted.

    Attributes
    ----------
    rows, columns : int
    window, alphabet : str
        See :class:`.FloorMap`.
    pitch_m : float
    seed : int
        Another one gives another map.
    forbidden : frozenset of cell
        Where no landmark can lie.
    walls : frozenset of (cell, cell)
        See :class:`.FloorMap`.
    detect : int
        How many misread landmarks of a window shall always be noticed.
    geometry : Geometry
    evaluations : int
        Budget of the search: so often it looks what one letter would do to one window.
        The default takes about ten seconds compiled, and a hundred times that in Python.
    """

    rows: int
    columns: int
    window: str = "L"
    alphabet: str = "16"
    pitch_m: float = 0.2
    seed: int = 0
    forbidden: frozenset[Cell] = frozenset()
    walls: frozenset[Wall] = frozenset()
    detect: int = 0
    geometry: Geometry = field(default_factory=Geometry)
    evaluations: int = 2_500_000_000


def design(
    options: DesignOptions, progress: Callable[[float, int], None] | None = None
) -> FloorMap:
    """A map as wanted; the same options give the same map, with or without compiled loops.

    Parameters
    ----------
    options : DesignOptions
    progress : function, optional
        Called now and then with the share of the budget that is spent, and with the
        readings that still repeat another one.

    Raises
    ------
    InputError
        The options are none, or ask for more readings than can differ.
    DegenerateError
        No map was found within the budget, which does not say that there is none.

    Notes
    -----
    Min-conflicts (Minton et al., Artificial Intelligence 58, 1992) with a heat bath: only
    cells of windows that read like another one are redrawn, and all letters of a cell are
    weighed at once (:func:`.search.search_python`). Against plain annealing, which proposes
    one letter for any cell, 16/L of 24 x 24 falls from 4-17 s (facts/landmarks.md 4) to 0.1-0.4 s.
    """
    blank = empty_floor(options)
    there = blank.codes != HOLE
    cells, heading = placements(there, ways(blank), options.window)
    alphabet = options.alphabet
    refuse_readings(cells, heading, alphabet=alphabet, window=options.window, detect=options.detect)
    count, letters = there.size, LETTERS[alphabet]
    flat = cells[..., 0] * options.columns + cells[..., 1]
    task = problem(count, flat, heading, options.window, alphabet, options.detect)
    each = len(task.use_item) * letters / max(1, count)
    unit = options.evaluations / max(1.0, each) / STAGES / len(LADDERS) / sum(LENGTHS)
    turns = len(LENGTHS) * len(LADDERS) * STAGES
    fewest = len(task.item_cells)
    values = random_values(count, letters, options.seed)
    for turn in range(turns):
        of_round, stage = divmod(turn, STAGES)
        steps = max(1, round(unit * LENGTHS[of_round // len(LADDERS)]))
        hot, cold = LADDERS[of_round % len(LADDERS)]
        if stage == 0 and of_round:
            values = random_values(count, letters, _seed(options.seed, turn, 1))
        heat = weights(hot + (cold - hot) * stage / (STAGES - 1))
        left = search(task, values, heat, _seed(options.seed, turn, 2), steps)
        if left == 0:
            codes = np.array(ALPHABET_CODES[alphabet])[values].reshape(there.shape)
            return with_codes(blank, np.where(there, codes, HOLE), options.seed)
        fewest = min(fewest, left)
        if progress is not None:
            progress((turn + 1) / turns, left)
    raise DegenerateError(
        f"no map was found: of {len(cells)} readings at best {fewest} repeat another one",
        hint="try another seed, a row fewer, a larger window, the alphabet 16, or more holes",
    )


def empty_floor(options: DesignOptions) -> FloorMap:
    """The floor that the options describe, with code 0 in each cell that bears a landmark.

    Raises
    ------
    InputError
        The options are none.
    """
    rows, columns = options.rows, options.columns
    if options.alphabet not in ALPHABETS:
        raise InputError(f"alphabet {options.alphabet!r} is none of {', '.join(ALPHABETS)}")
    if options.window not in WINDOWS:
        raise InputError(f"window {options.window!r} is none of {', '.join(WINDOWS)}")
    if rows < 1 or columns < 1 or rows * columns > LARGEST_CELLS:
        raise InputError(f"a floor of {rows} x {columns} cells is not from 1 to {LARGEST_CELLS}")
    size = len(PATHS[options.window])
    if not 0 <= options.detect < size:
        raise InputError(
            f"detect is {options.detect}, and a window {options.window} has {size} landmarks",
            hint=f"give 0 to {size - 1}",
        )
    if not 0 < options.pitch_m < float("inf"):
        raise InputError(f"a pitch of {options.pitch_m} m is not above 0")

    def on_floor(cell: Cell) -> bool:
        return 0 <= cell[0] < rows and 0 <= cell[1] < columns

    codes = np.zeros((rows, columns), np.int64)
    for cell in options.forbidden:
        if not on_floor(cell):
            raise InputError(f"forbidden cell {cell[0]},{cell[1]} is not on the floor")
        codes[cell] = HOLE
    for one, other in options.walls:
        step = (other[0] - one[0], other[1] - one[1])
        if not (on_floor(one) and on_floor(other) and step in STEPS):
            raise InputError(
                f"wall {one[0]},{one[1]} {other[0]},{other[1]} is not between two neighbouring"
                " cells of the floor"
            )
    return FloorMap(
        codes,
        pitch_m=options.pitch_m,
        alphabet=options.alphabet,
        window=options.window,
        detect=options.detect,
        geometry=options.geometry,
        walls=frozenset((min(wall), max(wall)) for wall in options.walls),
    )


def with_codes(
    floor: FloorMap, codes: np.ndarray, seed: int, notes: tuple[str, ...] = ()
) -> FloorMap:
    """The same floor with landmarks laid as ``codes``."""
    return replace(floor, codes=np.asarray(codes, np.int64), seed=seed, notes=notes)


def _seed(seed: int, turn: int, use: int) -> int:
    # Far from each other: the generator's own states count up by one odd number.
    return (seed + 1) * 0xD1342543DE82EF95 + (turn << 8 | use) * 0xAF251AF3B0F025B5
