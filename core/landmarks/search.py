"""The search for a map: letters are redrawn, cell by cell, where two windows read the same."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks.windows import ALPHABET_CODES, PATHS

Integers = NDArray[np.int64]

LETTERS = {alphabet: len(codes) for alphabet, codes in ALPHABET_CODES.items()}

LARGEST_TABLE = 1 << 24
"""Words that are counted one by one; beyond it they share slots by their hash. Two that
share one are kept apart as if they were the same, so that what is found is right."""

SHIFT = 24
"""Weights are whole numbers, so that both twins draw the same: this many bits."""

GAMMA = 0x9E3779B97F4A7C15
MASK = (1 << 64) - 1


@dataclass(frozen=True, eq=False)
class Problem:
    """Words that must differ.

    Attributes
    ----------
    item_cells : (items, length) int32 ndarray
        Cells whose letters make each word.
    first : (cells + 1,) int32 ndarray
        The uses of a cell: rows ``first[cell]`` to ``first[cell + 1] - 1`` of the next two.
    use_item, use_row : int32 ndarray
        The item, and the row of ``parts``.
    parts : (rows, letters) uint64 ndarray
        What each letter adds to a word, modulo 2^64.
    base : (items,) uint64 ndarray
        With which the words begin.
    slots, multiplier, shift : int
        A word is counted at ``(word * multiplier mod 2^64) >> shift``.
    """

    item_cells: NDArray[np.int32]
    item_rows: NDArray[np.int32]
    first: NDArray[np.int32]
    use_item: NDArray[np.int32]
    use_row: NDArray[np.int32]
    parts: NDArray[np.uint64]
    base: NDArray[np.uint64]
    slots: int
    multiplier: int
    shift: int


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
    if total <= LARGEST_TABLE:
        slots, multiplier, shift = total, 1, 0
    else:
        bits = max(LARGEST_TABLE.bit_length() - 1, (16 * len(item_cells)).bit_length())
        slots, multiplier, shift = 1 << bits, GAMMA, 64 - bits
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
        slots,
        multiplier,
        shift,
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
    words = task.base.copy()
    for place in range(task.item_cells.shape[1]):
        words += task.parts[task.item_rows[:, place], values[task.item_cells[:, place]]]
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
        task.slots,
        task.multiplier,
        task.shift,
        seed & MASK,
        steps,
    )
    return int(left[0])
