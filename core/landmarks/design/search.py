"""Search for a map: letters of cells are redrawn where two windows read the same."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks.map.windows import ALPHABET_CODES, WINDOW_PATHS

Integers = NDArray[np.int64]

LETTER_COUNTS = {alphabet: len(codes) for alphabet, codes in ALPHABET_CODES.items()}

MAX_TABLE_WORDS = 1 << 24
"""Possible words up to which their uses are counted in a table; beyond, see
:func:`search_sparse`."""

WEIGHT_BITS = 24
"""Weights are integers of this many bits, so that the compiled and the Python search draw alike."""

GOLDEN_GAMMA = 0x9E3779B97F4A7C15
"""Increment of the generator SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""

UINT64_MASK = (1 << 64) - 1


@dataclass(frozen=True, eq=False)
class SearchProblem:
    """Items whose words must all be different.

    Each cell has a value, the index of its letter. An item is a reading, or a choice of some of its
    letters. Its word is the integer ``base[item] + sum(parts[item_rows[item, k],
    values[item_cells[item, k]]])`` over its letters k. A use is an occurrence of a cell in an item.

    Attributes
    ----------
    item_cells, item_rows : (items, length) int32 ndarray
        Cells whose letters make each word, and their rows of ``parts``.
    first : (cells + 1,) int32 ndarray
        The uses of a cell are ``first[cell]`` to ``first[cell + 1] - 1`` of ``use_item`` and
        ``use_row``.
    use_item, use_row : int32 ndarray
        Item of each use, and its row of ``parts``.
    parts : (rows, letters) uint64 ndarray
        Contribution of each letter to a word.
    base : (items,) uint64 ndarray
        Constant part of each word.
    possible : int
        Words are smaller than this number.
    """

    item_cells: NDArray[np.int32]
    item_rows: NDArray[np.int32]
    first: NDArray[np.int32]
    use_item: NDArray[np.int32]
    use_row: NDArray[np.int32]
    parts: NDArray[np.uint64]
    base: NDArray[np.uint64]
    possible: int

    def words(self, values: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """Return the words (items,) of the letters of the cells."""
        words = self.base.copy()
        for k in range(self.item_cells.shape[1]):
            words += self.parts[self.item_rows[:, k], values[self.item_cells[:, k]]]
        return words


def build_problem(
    count: int, cells: Integers, heading: Integers, window: str, alphabet: str, detect: int
) -> SearchProblem:
    """Return the words of windows ``cells`` (n, k) at headings (n,) on a floor of ``count`` cells.

    Two readings differ in more than ``detect`` letters if and only if they differ in each choice
    of ``k - detect`` letters (R. C. Singleton, IEEE Trans. Inf. Theory 10, 1964): each choice makes
    items of its own.
    """
    letters, size = LETTER_COUNTS[alphabet], len(WINDOW_PATHS[window])
    length = size - detect
    choices = np.array(list(itertools.combinations(range(size), length)))
    words = letters**length
    # Readings of a compass map at two headings have no letter in common.
    blocks = 4 if alphabet == "compass" else 1
    value = np.arange(letters)
    parts = np.empty((4, length, letters), object)
    for quarter in range(4):
        rotated_letters = (
            ((value << (4 - quarter)) | (value >> quarter)) & 15 if alphabet == "16" else value
        )
        for k in range(length):
            parts[quarter, k] = [int(letter) * letters**k for letter in rotated_letters]
    block = np.arange(len(choices))[:, None] * blocks + (heading if blocks > 1 else 0 * heading)
    possible = words * blocks * len(choices)
    item_cells = cells[:, choices].transpose(1, 0, 2).reshape(-1, length)
    rows = np.broadcast_to((heading * length)[:, None] + np.arange(length), (len(cells), length))
    item_rows = np.tile(rows, (len(choices), 1))
    order = np.argsort(item_cells, axis=None, kind="stable")
    used_cells = item_cells.reshape(-1)[order]
    return SearchProblem(
        np.ascontiguousarray(item_cells, np.int32),
        np.ascontiguousarray(item_rows, np.int32),
        np.searchsorted(used_cells, np.arange(count + 1)).astype(np.int32),
        (order // length).astype(np.int32),
        item_rows.reshape(-1)[order].astype(np.int32),
        np.array(parts.reshape(4 * length, letters).tolist(), np.uint64),
        (block.reshape(-1) * words).astype(np.uint64),
        possible,
    )


def random_values(count: int, letters: int, seed: int) -> NDArray[np.uint8]:
    """Return letters (count,) below ``letters``, from the generator of the search."""
    increments = np.arange(1, count + 1, dtype=np.uint64)
    state = np.uint64(seed & UINT64_MASK) + np.uint64(GOLDEN_GAMMA) * increments
    z = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ z >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    upper = (z ^ z >> np.uint64(31)) >> np.uint64(32)
    return (upper * np.uint64(letters) >> np.uint64(32)).astype(np.uint8)


def letter_weights(temperature: float) -> NDArray[np.uint32]:
    """Return the weights of letters with 0, 1, 2, ... conflicts more than the best one."""
    count = 1 + math.ceil(WEIGHT_BITS * math.log(2) * temperature)
    return np.array(
        [round(2**WEIGHT_BITS * math.exp(-excess / temperature)) for excess in range(count)],
        np.uint32,
    )


def search(
    problem: SearchProblem,
    values: NDArray[np.uint8],
    weights: NDArray[np.uint32],
    seed: int,
    steps: int,
) -> int:
    """Redraw letters in ``values`` (in place) until all words differ, for at most ``steps``.

    Returns
    -------
    int
        Number of words that equal the word of an earlier item.
    """
    if problem.possible > MAX_TABLE_WORDS:
        return search_sparse(problem, values, seed, steps)
    words = problem.words(values)
    if kernels is None:
        return search_python(problem, values, words, weights, seed, steps)
    repeats = np.zeros(1, np.int64)
    kernels.search_map(
        problem.item_cells,
        problem.first,
        problem.use_item,
        problem.use_row,
        problem.parts,
        weights,
        values,
        words,
        repeats,
        len(values),
        *problem.item_cells.shape,
        problem.parts.shape[1],
        len(weights),
        problem.possible,
        seed & UINT64_MASK,
        steps,
    )
    return int(repeats[0])


def search_sparse(problem: SearchProblem, values: NDArray[np.uint8], seed: int, steps: int) -> int:
    """Search among so many possible words that two are rarely equal by chance.

    One cell of each item in conflict gets another letter, until there is no conflict.
    """
    letters, length = problem.parts.shape[1], problem.item_cells.shape[1]
    while True:
        words = problem.words(values)
        _, group, count = np.unique(words, return_inverse=True, return_counts=True)
        conflicts = np.flatnonzero(count[group] > 1)
        repeats = len(words) - len(count)
        if repeats == 0 or steps < 1:
            return repeats
        steps -= len(conflicts)
        pick = random_values(len(conflicts), length, seed)
        cells = np.unique(problem.item_cells[conflicts, pick])
        seed += len(conflicts) * GOLDEN_GAMMA
        values[cells] = random_values(len(cells), letters, seed)
        seed += len(cells) * GOLDEN_GAMMA


def search_python(
    problem: SearchProblem,
    values: NDArray[np.uint8],
    words: NDArray[np.uint64],
    weights: NDArray[np.uint32],
    seed: int,
    steps: int,
) -> int:
    """Twin of the compiled search; it draws the same letters.

    An item in conflict is drawn, then one of its cells. For each letter the conflicts that the
    cell would have are counted: each of its items has as many as there are other items with the
    same word. The letter is drawn with a weight that depends on its excess of conflicts over the
    best letter, as at a temperature ("heat bath"). Only cells of an item in conflict are redrawn,
    which also changes the words of the other items that use the cell.
    """
    state = seed & UINT64_MASK

    def below(limit: int) -> int:
        nonlocal state
        state = (state + GOLDEN_GAMMA) & UINT64_MASK
        z = ((state ^ state >> 30) * 0xBF58476D1CE4E5B9) & UINT64_MASK
        z = ((z ^ z >> 27) * 0x94D049BB133111EB) & UINT64_MASK
        return ((z ^ z >> 31) >> 32) * limit >> 32

    word_of = words.tolist()
    parts = problem.parts.tolist()
    weight = weights.tolist()
    first = problem.first.tolist()
    uses = list(zip(problem.use_item.tolist(), problem.use_row.tolist(), strict=True))
    counts: dict[int, int] = {}
    # XOR of all items with a word: of exactly two, XOR with one gives the other.
    item_xor: dict[int, int] = {}
    # Items that may be in conflict; those that no longer are are removed when they are drawn.
    listed: list[int] = []
    is_listed = [False] * len(word_of)

    def set_word(item: int, word: int) -> None:
        word_of[item] = word
        item_xor[word] = item_xor.get(word, 0) ^ item
        counts[word] = counts.get(word, 0) + 1
        if counts[word] > 1 and not is_listed[item]:
            is_listed[item] = True
            listed.append(item)

    def draw_conflict() -> int:
        # The list has all items of a word but one, and some that are no longer in conflict.
        while listed:
            pick = below(len(listed))
            item = listed[pick]
            word = word_of[item]
            if counts[word] == 2 and below(2):
                return item_xor[word] ^ item
            if counts[word] > 1:
                return item
            is_listed[item] = False
            listed[pick] = listed[-1]
            listed.pop()
        return -1

    def redraw(cell: int) -> None:
        cell_uses = uses[first[cell] : first[cell + 1]]
        old = int(values[cell])
        rest = []
        for item, row in cell_uses:
            word = word_of[item]
            item_xor[word] ^= item
            counts[word] -= 1
            rest.append((item, word - parts[row][old], parts[row]))
        cost = []
        for letter in range(problem.parts.shape[1]):
            candidates = [word + part[letter] for _, word, part in rest]
            total = 0
            for word in candidates:
                before = counts.get(word, 0)
                total += before
                counts[word] = before + 1
            for word in candidates:
                counts[word] -= 1
            cost.append(total)
        least = min(cost)
        letter_weight = [weight[c - least] if c - least < len(weight) else 0 for c in cost]
        pick = below(sum(letter_weight))
        chosen = 0
        while pick >= letter_weight[chosen]:
            pick -= letter_weight[chosen]
            chosen += 1
        values[cell] = chosen
        for item, word, part in rest:
            set_word(item, word + part[chosen])

    for item, word in enumerate(list(word_of)):
        set_word(item, word)
    length = problem.item_cells.shape[1]
    for _ in range(steps):
        item = draw_conflict()
        if item < 0:
            break
        redraw(int(problem.item_cells[item, below(length)]))
    words[:] = word_of
    return sum(count - 1 for count in counts.values() if count > 1)
