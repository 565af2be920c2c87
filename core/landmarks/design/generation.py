"""Generation of maps: a search for letters such that no two windows of the floor read the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from locatk.core.errors import DegenerateError, InputError
from locatk.core.landmarks.design.bounds import require_enough_words_for_windows
from locatk.core.landmarks.design.search import (
    LETTER_COUNTS,
    build_problem,
    letter_weights,
    random_values,
    search,
)
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import (
    ALPHABETS,
    HOLE_CODE,
    STEPS,
    WINDOWS,
    Cell,
    FloorMap,
    Wall,
)
from locatk.core.landmarks.map.windows import (
    ALPHABET_CODES,
    WINDOW_PATHS,
    passable_steps,
    place_windows,
)

TEMPERATURE_RANGES = ((0.45, 0.3), (0.6, 0.4), (0.38, 0.3), (0.8, 0.5))
"""Start and end temperature, in conflicts, of the cooling rounds, which take turns.

Maps with far fewer readings than words are found with any of them. Which range suits a map with
nearly as many readings as words is not known beforehand.
"""

ROUND_LENGTHS = (1, 3, 9)
"""Relative lengths of the rounds: all ranges are tried in short rounds before longer ones."""

STAGES_PER_ROUND = 16
"""Number of temperatures in a round."""

MAX_SETUP_WORDS = 300_000_000
"""Possible words of all stages together. Each stage builds a table of them, which takes 27 ns a
word (measured with 15 million, far beyond the caches): 8 s in total."""

MAX_CELLS = 1_000_000


@dataclass(frozen=True)
class DesignOptions:
    """Requirements on a map.

    Attributes
    ----------
    rows, columns : int
    window, alphabet : str
        See :class:`.FloorMap`.
    pitch_m : float
    seed : int
        Different seeds give different maps.
    forbidden : frozenset of cell
        Cells without a landmark.
    walls : frozenset of (cell, cell)
        See :class:`.FloorMap`.
    detect : int
        Number of misread landmarks of a window that must always be detected.
    geometry : Geometry
    evaluations : int
        Budget of the search: number of evaluations of one letter in one window. The default takes
        about ten seconds compiled, and a hundred times as long in Python.
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


def design_map(
    options: DesignOptions, progress: Callable[[float, int], None] | None = None
) -> FloorMap:
    """Search for a unique map; equal options give equal maps, with or without compiled loops.

    Parameters
    ----------
    options : DesignOptions
    progress : function, optional
        Called at intervals with the used fraction of the budget and the number of words that still
        equal an earlier one; a reading has one word, or with ``detect`` one per choice of letters.

    Raises
    ------
    InputError
        An option is not valid, or the floor has more readings than can be different.
    DegenerateError
        No map was found within the budget; one may exist.

    Notes
    -----
    Min-conflicts (Minton et al., Artificial Intelligence 58, 1992) with a heat bath: only cells of
    windows that read like another one are redrawn, and all letters of a cell are weighted at once
    (:func:`.search.search_python`). On a two-core machine a 24 x 24 map of window L and alphabet
    16 takes 0.1 to 0.4 s; simulated annealing that proposes one letter for any cell took 4 to 17 s.
    """
    blank = empty_floor(options)
    has_landmark = blank.codes != HOLE_CODE
    cells, heading = place_windows(has_landmark, passable_steps(blank), options.window)
    alphabet = options.alphabet
    require_enough_words_for_windows(
        cells, heading, alphabet=alphabet, window=options.window, detect=options.detect
    )
    cell_count, letters = has_landmark.size, LETTER_COUNTS[alphabet]
    flat = cells[..., 0] * options.columns + cells[..., 1]
    problem = build_problem(cell_count, flat, heading, options.window, alphabet, options.detect)
    evaluations_per_step = len(problem.use_item) * letters / max(1, cell_count)
    steps_per_stage = options.evaluations / max(1.0, evaluations_per_step) / STAGES_PER_ROUND
    steps_per_stage = steps_per_stage / len(TEMPERATURE_RANGES) / sum(ROUND_LENGTHS)
    lengths = np.repeat(ROUND_LENGTHS, len(TEMPERATURE_RANGES) * STAGES_PER_ROUND)
    # Large tables leave time for the first rounds only.
    lengths = lengths[: max(STAGES_PER_ROUND, MAX_SETUP_WORDS // problem.possible)]
    fewest_repeats, used = len(problem.item_cells), 0
    values = random_values(cell_count, letters, options.seed)
    for index, length in enumerate(lengths.tolist()):
        number, stage = divmod(index, STAGES_PER_ROUND)
        hot, cold = TEMPERATURE_RANGES[number % len(TEMPERATURE_RANGES)]
        if stage == 0 and number:
            values = random_values(cell_count, letters, _stage_seed(options.seed, index, 1))
        weights = letter_weights(hot + (cold - hot) * stage / (STAGES_PER_ROUND - 1))
        steps = max(1, round(steps_per_stage * length))
        repeats = search(problem, values, weights, _stage_seed(options.seed, index, 2), steps)
        if repeats == 0:
            codes = np.array(ALPHABET_CODES[alphabet])[values].reshape(has_landmark.shape)
            return with_codes(blank, np.where(has_landmark, codes, HOLE_CODE), options.seed)
        fewest_repeats = min(fewest_repeats, repeats)
        used += length
        if progress is not None:
            progress(used / int(lengths.sum()), repeats)
    raise DegenerateError(
        f"no map was found: at best {fewest_repeats} of {len(problem.item_cells)} words of its "
        "readings repeat another one",
        hint="try another seed, or make the floor smaller",
    )


def empty_floor(options: DesignOptions) -> FloorMap:
    """Return the floor of the options with code 0 in each cell that has a landmark.

    Raises
    ------
    InputError
        An option is not valid.
    """
    rows, columns = options.rows, options.columns
    if options.alphabet not in ALPHABETS:
        raise InputError(f"alphabet {options.alphabet!r} is none of {', '.join(ALPHABETS)}")
    if options.window not in WINDOWS:
        raise InputError(f"window {options.window!r} is none of {', '.join(WINDOWS)}")
    if rows < 1 or columns < 1 or rows * columns > MAX_CELLS:
        raise InputError(f"a floor of {rows} x {columns} cells is not from 1 to {MAX_CELLS}")
    size = len(WINDOW_PATHS[options.window])
    if not 0 <= options.detect < size:
        raise InputError(
            f"detect is {options.detect}, and a window {options.window} has {size} landmarks",
            hint=f"give 0 to {size - 1}",
        )
    if not 0 < options.pitch_m < float("inf"):
        raise InputError(f"a pitch of {options.pitch_m} m is not above 0")

    def is_on_floor(cell: Cell) -> bool:
        return 0 <= cell[0] < rows and 0 <= cell[1] < columns

    codes = np.zeros((rows, columns), np.int64)
    for cell in options.forbidden:
        if not is_on_floor(cell):
            raise InputError(f"forbidden cell {cell[0]},{cell[1]} is not on the floor")
        codes[cell] = HOLE_CODE
    for first, second in options.walls:
        step = (second[0] - first[0], second[1] - first[1])
        if not (is_on_floor(first) and is_on_floor(second) and step in STEPS):
            raise InputError(
                f"wall {first[0]},{first[1]} {second[0]},{second[1]} is not between two"
                " neighbouring cells of the floor"
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
    """Return the floor with other codes, and with the seed and notes of these codes."""
    return replace(floor, codes=np.asarray(codes, np.int64), seed=seed, notes=notes)


def _stage_seed(seed: int, stage: int, purpose: int) -> int:
    """Return a seed whose random numbers do not overlap those of other stages.

    SplitMix64 advances its state by :data:`.search.GOLDEN_GAMMA`; seeds must not differ by few such
    steps. The purpose is 1 for initial letters and 2 for the search.
    """
    return (seed + 1) * 0xD1342543DE82EF95 + (stage << 8 | purpose) * 0xAF251AF3B0F025B5
