"""The search for a map: letters are redrawn, cell by cell, where two windows read the same."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks.map.windows import ALPHABET_CODES, PATHS

Integers = NDArray[np.int64]

LETTERS = {alphabet: len(codes) for alphabet, codes in ALPHABET_CODES.items()}

LARGEST_TABLE = 1 << 24
"""Possible words that are counted one by one; beyond it see :func:`search_loosely`."""

SHIFT = 24
"""Weights are whole numbers, so that both twins draw the same: this many bits."""

GAMMA = 0x9E3779B97F4A7C15
MASK = (1 << 64) - 1


@dataclass(frozen=True, eq=False)
class Problem:
    """Words that must differ.

    Attributes
    ----------
    item_cells, item_rows : (items, length) int32 ndarray
        Cells whose letters make each word, and their rows of ``parts``.
    first : (cells + 1,) int32 ndarray
        The uses of a cell: rows ``first[cell]`` to ``first[cell + 1] - 1`` of the next two.
    use_item, use_row : int32 ndarray
        The item, and the row of ``parts``.
    parts : (rows, letters) uint64 ndarray
        What each letter adds to a word.
    base : (items,) uint64 ndarray
        With which the words begin.
    possible : int
        Words are numbers below it.
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
        """(items,) words that the letters of the cells make."""
        words = self.base.copy()
        for place in range(self.item_cells.shape[1]):
            words += self.parts[self.item_rows[:, place], values[self.item_cells[:, place]]]
        return words


def problem(
    count: int, cells: Integers, heading: Integers, window: str, alphabet: str, detect: int
) -> Problem:
    """The words of windows ``cells`` (n, k) under headings (n,) on a floor of ``count`` cells.

    Two readings differ in more than ``detect`` landmarks just where they differ in each
    choice of ``k - detect`` landmarks (R. C. Singleton, IEEE Trans. Inf. Theory 10, 1964):
    each choice makes words of its own.
    """
    letters, size = LETTERS[alphabet], len(PATHS[window])
    length = size - detect
    choices = np.array(list(itertools.combinations(range(size), length)))
    words = letters**length
    # Readings of a compass map under two headings have no letter in common.
    blocks = 4 if alphabet == "compass" else 1
    value = np.arange(letters)
    parts = np.empty((4, length, letters), object)
    for turn in range(4):
        seen = ((value << (4 - turn)) | (value >> turn)) & 15 if alphabet == "16" else value
        for place in range(length):
            parts[turn, place] = [int(letter) * letters**place for letter in seen]
    block = np.arange(len(choices))[:, None] * blocks + (heading if blocks > 1 else 0 * heading)
    total = words * blocks * len(choices)
    item_cells = cells[:, choices].transpose(1, 0, 2).reshape(-1, length)
    rows = np.broadcast_to((heading * length)[:, None] + np.arange(length), (len(cells), length))
    item_rows = np.tile(rows, (len(choices), 1))
    order = np.argsort(item_cells, axis=None, kind="stable")
    owners = item_cells.reshape(-1)[order]
    return Problem(
        np.ascontiguousarray(item_cells, np.int32),
        np.ascontiguousarray(item_rows, np.int32),
        np.searchsorted(owners, np.arange(count + 1)).astype(np.int32),
        (order // length).astype(np.int32),
        item_rows.reshape(-1)[order].astype(np.int32),
        np.array(parts.reshape(4 * length, letters).tolist(), np.uint64),
        (block.reshape(-1) * words).astype(np.uint64),
        total,
    )


def random_values(count: int, letters: int, seed: int) -> NDArray[np.uint8]:
    """(count,) letters from 0, drawn as the search draws."""
    state = np.uint64(seed & MASK) + np.uint64(GAMMA) * np.arange(1, count + 1, dtype=np.uint64)
    z = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ z >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    upper = (z ^ z >> np.uint64(31)) >> np.uint64(32)
    return (upper * np.uint64(letters) >> np.uint64(32)).astype(np.uint8)


def weights(temperature: float) -> NDArray[np.uint32]:
    """Weight of a letter that makes 0, 1, 2, ... conflicts more than the best one."""
    many = 1 + math.ceil(SHIFT * math.log(2) * temperature)
    return np.array(
        [round(2**SHIFT * math.exp(-more / temperature)) for more in range(many)], np.uint32
    )


def search(
    task: Problem, values: NDArray[np.uint8], heat: NDArray[np.uint32], seed: int, steps: int
) -> int:
    """Redraws letters in ``values`` (in place) until all words differ, or for ``steps``.

    Returns how many words are left that an earlier item has too.
    """
    if task.possible > LARGEST_TABLE:
        return search_loosely(task, values, seed, steps)
    words = task.words(values)
    if kernels is None:
        return search_python(task, values, words, heat, seed, steps)
    left = np.zeros(1, np.int64)
    kernels.search_map(
        task.item_cells,
        task.first,
        task.use_item,
        task.use_row,
        task.parts,
        heat,
        values,
        words,
        left,
        len(values),
        *task.item_cells.shape,
        task.parts.shape[1],
        len(heat),
        task.possible,
        seed & MASK,
        steps,
    )
    return int(left[0])


def search_loosely(task: Problem, values: NDArray[np.uint8], seed: int, steps: int) -> int:
    """The same where so many words are possible that hardly any two are the same by chance:
    one cell of each item in conflict gets another letter, until there is none."""
    letters, length = task.parts.shape[1], task.item_cells.shape[1]
    left = 0
    while True:
        words = task.words(values)
        _, group, count = np.unique(words, return_inverse=True, return_counts=True)
        clash = np.flatnonzero(count[group] > 1)
        left = len(words) - len(count)
        if left == 0 or steps < 1:
            return left
        steps -= len(clash)
        pick = random_values(len(clash), length, seed)
        cells = np.unique(task.item_cells[clash, pick])
        seed += len(clash) * GAMMA
        values[cells] = random_values(len(cells), letters, seed)
        seed += len(cells) * GAMMA


def search_python(
    task: Problem,
    values: NDArray[np.uint8],
    words: NDArray[np.uint64],
    heat: NDArray[np.uint32],
    seed: int,
    steps: int,
) -> int:
    """Twin of the compiled search; draws the same letters.

    An item in conflict is drawn, then one of its cells. For each letter the conflicts are
    counted that the cell would make: an item makes as many as there are other items with
    its word. The letter is drawn by the weight of the conflicts it makes more than the best
    one, as at a temperature ("heat bath"). Items that are in no conflict are never touched.
    """
    state = seed & MASK

    def below(limit: int) -> int:
        nonlocal state
        state = (state + GAMMA) & MASK
        z = ((state ^ state >> 30) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ z >> 27) * 0x94D049BB133111EB) & MASK
        return ((z ^ z >> 31) >> 32) * limit >> 32

    word_of = words.tolist()
    parts = task.parts.tolist()
    weight = heat.tolist()
    first = task.first.tolist()
    uses = list(zip(task.use_item.tolist(), task.use_row.tolist(), strict=True))
    counts: dict[int, int] = {}
    mixed: dict[int, int] = {}
    listed: list[int] = []
    is_listed = [False] * len(word_of)

    def put(item: int, word: int) -> None:
        word_of[item] = word
        mixed[word] = mixed.get(word, 0) ^ item
        counts[word] = counts.get(word, 0) + 1
        if counts[word] > 1 and not is_listed[item]:
            is_listed[item] = True
            listed.append(item)

    def conflict() -> int:
        # The list holds all items of a word but one, and some that are in conflict no more.
        while listed:
            pick = below(len(listed))
            item = listed[pick]
            at = word_of[item]
            if counts[at] == 2 and below(2):
                return mixed[at] ^ item
            if counts[at] > 1:
                return item
            is_listed[item] = False
            listed[pick] = listed[-1]
            listed.pop()
        return -1

    def redraw(cell: int) -> None:
        mine = uses[first[cell] : first[cell + 1]]
        old = int(values[cell])
        rest = []
        for item, row in mine:
            at = word_of[item]
            mixed[at] ^= item
            counts[at] -= 1
            rest.append((item, word_of[item] - parts[row][old], parts[row]))
        cost = []
        for letter in range(task.parts.shape[1]):
            read = [word + part[letter] for _, word, part in rest]
            total = 0
            for word in read:
                before = counts.get(word, 0)
                total += before
                counts[word] = before + 1
            for word in read:
                counts[word] -= 1
            cost.append(total)
        least = min(cost)
        share = [weight[c - least] if c - least < len(weight) else 0 for c in cost]
        pick = below(sum(share))
        chosen = 0
        while pick >= share[chosen]:
            pick -= share[chosen]
            chosen += 1
        values[cell] = chosen
        for item, word, part in rest:
            put(item, word + part[chosen])

    for item, word in enumerate(list(word_of)):
        put(item, word)
    length = task.item_cells.shape[1]
    for _ in range(steps):
        item = conflict()
        if item < 0:
            break
        redraw(int(task.item_cells[item, below(length)]))
    words[:] = word_of
    return sum(count - 1 for count in counts.values() if count > 1)
