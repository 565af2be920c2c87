"""Families of tags: ids of one codec with a minimum distance from each other.

The distance of two tags is the number of steps between their orientations around the circle (Lee
distance), summed over the cells that both occupy, plus P // 2 for each magnet of one tag in a cell
that the other tag leaves empty. Steps are counted, not differing symbols, because orientations are
usually misread by one step. A magnet in another cell, a whole spacing away, is confused less often
than any orientation and counts as the largest number of steps. So the distance is a metric, and a
magnet that is not detected reduces it by at most P // 2, however the two tags differ there.

Two tags that are closer than P // 2 have their magnets in the same cells. So the tags near a given
one are few and can be enumerated: :class:`_NearTags` finds them in a table by their keys, without
comparing all pairs.

The members of a family never change: :func:`generate_family` is deterministic,
:data:`FAMILY_RULE_VERSION` names its rule, and a longer family begins with the shorter one.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.codec import dispatch as codec
from locatk.core.polaris.tag import Tags

FAMILY_RULE_VERSION = 1
"""Version of the rule by which :func:`generate_family` chooses ids. Another rule gets another
number and leaves the families of this one as they are."""

EMPTY_CELL = -1
"""Value of a cell without magnet in the tables of :func:`symbol_table`."""

MAX_CANDIDATES = 1 << 19
"""Largest number of ids that :func:`generate_family` tries; it bounds the time of the search."""

BATCH_IDS = 1024
"""Number of ids whose distances are computed together; it bounds the memory of the distances."""

IDS_PER_NEAR_TAG = 6
"""Number of tags to which one is compared in the time in which one near tag is looked up (measured
for the default design)."""

PROGRESS_STEPS = 100
"""Number of steps in which :func:`generate_family` reports its progress."""

TRIED_ORIENTATIONS = (8, 16, 20, 32)
"""Numbers of orientations that are proposed if a family cannot have as many members."""

KEY_SEED = 20
"""Seed of the keys of :class:`_NearTags`. They do not change any result."""


def symbol_table(tags: Tags, ids: tuple[int, ...]) -> NDArray[np.int16]:
    """Return the orientations of tags by cell.

    Returns
    -------
    (n, K * K) int16 ndarray
        The orientation in cell (column, row) is at ``row * K + column``; :data:`EMPTY_CELL` if
        there is no magnet.

    Raises
    ------
    InputError
        The codec does not have one of the ids.
    """
    order = tags.order
    rows = np.full((len(ids), order * order), EMPTY_CELL, np.int16)
    for row, tag_id in zip(rows, ids, strict=True):
        layout = codec.layout_of(tags, tag_id)
        row[[r * order + c for c, r in layout.cells]] = layout.symbols
    return rows


def distance(tags: Tags, first_id: int, second_id: int) -> int:
    """Return the distance of two tags.

    Raises
    ------
    InputError
        The codec does not have one of the ids.
    """
    rows = symbol_table(tags, (first_id, second_id))
    return int(_distances(tags, rows[:1], rows[1:])[0, 0])


def smallest_distance(tags: Tags, ids: tuple[int, ...]) -> int:
    """Return the smallest distance between two of ``ids``.

    For fewer than two ids it is the largest distance that tags of the design can have.

    Raises
    ------
    InputError
        The codec does not have one of the ids.
    """
    return closest_pair(tags, ids)[0]


def closest_pair(tags: Tags, ids: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    """Return the smallest distance between two of ``ids``, and the first pair that has it.

    For fewer than two ids the pair is empty; see :func:`smallest_distance`.

    Raises
    ------
    InputError
        The codec does not have one of the ids.
    """
    rows = symbol_table(tags, ids)
    counts = lee_weight_counts(tags.magnets, tags.orientations)
    for radius in range(tags.orientations // 2):
        if IDS_PER_NEAR_TAG * counts[radius] > len(ids):
            break
        deltas = _rotations_of_weight(tags.magnets, tags.orientations, radius)
        table = _NearTags(tags, rows)
        pairs = [
            (start + int(later), int(earlier))
            for start in range(0, len(ids), BATCH_IDS)
            for later, earlier in table.find(rows[start : start + BATCH_IDS], deltas)
            if earlier < start + later
        ]
        if pairs:
            later, earlier = min(pairs)
            return radius, (ids[earlier], ids[later])
    best, pair = tags.magnets * (tags.orientations // 2), ()  # type: tuple[int, tuple[int, ...]]
    for start in range(0, len(ids), BATCH_IDS):
        batch = rows[start : start + BATCH_IDS]
        distances = _distances(tags, batch, rows)
        # Each pair is considered once, with the ids before it in the list.
        distances[np.arange(len(batch))[:, None] + start <= np.arange(len(ids))] = np.inf
        k = int(distances.argmin())
        value = distances.flat[k]
        if value < best or (not pair and value == best):
            best, pair = int(value), (ids[k % len(ids)], ids[start + k // len(ids)])
    return best, pair


def check_family(tags: Tags) -> None:
    """Check that the ids of a design are a family.

    Raises
    ------
    InputError
        ``tags.ids`` is empty, contains an id twice or one that the codec does not have, or two of
        them are closer than ``tags.min_distance``; see also :func:`codec.check_design`.
    """
    codec.check_design(tags)
    if tags.min_distance < 1:
        raise InputError(f"a minimum distance of {tags.min_distance}", hint="Use at least 1")
    if tags.ids is None:
        if tags.min_distance > 1:
            raise InputError(
                f"a minimum distance of {tags.min_distance} without ids",
                hint="List the family's ids, or let the minimum distance be 1",
            )
        return
    if not tags.ids:
        raise InputError("a family without ids")
    smallest, pair = closest_pair(tags, tags.ids)
    if smallest == 0:
        raise InputError(f"id {pair[0]} occurs twice in the family")
    if pair and smallest < tags.min_distance:
        raise InputError(
            f"ids {pair[0]} and {pair[1]} have distance {smallest}, not {tags.min_distance}",
            hint="Drop one of them, or let the minimum distance be smaller",
        )


def max_family_size(tags: Tags, min_distance: int) -> int:
    """Return an upper bound of the number of tags that keep a distance from each other.

    With the magnets in given cells, tags are words of a code with Lee distance. Translates of a set
    of words with a diameter below the distance, by the words of the code, are disjoint (the
    code-anticode bound; Delsarte, Philips Res. Rep. Suppl. 10 (1973)). The sets are balls, balls
    around two neighbours, and products of intervals; these include the bounds of Hamming and of
    Singleton. Free magnets contribute at most P // 2 each, so that the magnets at the three
    vertices alone have to provide the rest of the distance.

    Raises
    ------
    InputError
        See :func:`codec.check_design`.
    """
    capacity = codec.capacity(tags)
    magnets, base = tags.magnets, tags.orientations
    words = base**magnets
    placements = max(capacity // words, 1)
    bound = placements * (words // _largest_anticode(magnets, base, min_distance - 1))
    at_vertices = min_distance - 1 - (magnets - 3) * (base // 2)
    if at_vertices >= 0:
        bound = min(bound, base**3 // _largest_anticode(3, base, at_vertices))
    return max(1, min(capacity, bound))


def _largest_anticode(magnets: int, orientations: int, diameter: int) -> int:
    """Return the size of the largest known set of words with at most this Lee diameter."""
    half = orientations // 2
    # Number of words per distance from the centre; the first magnet has one or two centres.
    near = [1] + [2] * half
    near[-1] -= orientations % 2 == 0
    paired = [2] * (orientations // 2) + [orientations % 2]
    weights = [1]
    for _ in range(magnets - 1):
        weights = [
            sum(weights[k - j] * near[j] for j in range(half + 1) if 0 <= k - j < len(weights))
            for k in range(len(weights) + half)
        ]
    first = near if diameter % 2 == 0 else paired
    radius = diameter // 2
    ball = sum(
        count * other
        for distance, count in enumerate(first)
        for other in weights[: max(radius - distance + 1, 0)]
    )
    # largest[d]: the largest product of intervals with diameter d so far.
    largest = [1] * (diameter + 1)
    for _ in range(magnets):
        largest = [
            max(
                largest[d - length] * (orientations if length == half else length + 1)
                for length in range(min(half, d) + 1)
            )
            for d in range(diameter + 1)
        ]
    return max(ball, largest[diameter])


def _feasible_hint(tags: Tags, count: int, min_distance: int) -> str:
    """Return which smaller distance, more magnets or more orientations might suffice."""
    options = []
    for distance in range(min_distance - 1, 0, -1):
        if max_family_size(tags, distance) >= count:
            options.append(f"a minimum distance of {distance}")
            break
    more_magnets = [replace(tags, magnets=n) for n in range(tags.magnets + 1, tags.order**2)]
    finer = [replace(tags, orientations=p) for p in TRIED_ORIENTATIONS if p > tags.orientations]
    for designs, quantity in ((more_magnets, "magnets"), (finer, "orientations")):
        for design in designs:
            try:
                is_feasible = max_family_size(design, min_distance) >= count
            except InputError:
                continue  # The codec does not have this design.
            if is_feasible:
                options.append(f"{getattr(design, quantity)} {quantity}")
                break
    if not options:
        return "Use a smaller count or minimum distance, or a larger order"
    return f"Possible at best with {' or '.join(options)}"


def generate_family(
    tags: Tags, count: int, min_distance: int, progress: Callable[[], None] | None = None
) -> tuple[int, ...]:
    """Return the first ``count`` members of the family with this minimum distance.

    Candidates are ids in steps of about the golden section of the capacity, so that they are spread
    over placements and orientations. A candidate becomes a member if it keeps the distance from all
    members before it.

    Parameters
    ----------
    tags : Tags
        Design; ``tags.ids`` is ignored.
    count : int
    min_distance : int
        At least 1.
    progress : callable, optional
        Called :data:`PROGRESS_STEPS` times, if all candidates are tried.

    Raises
    ------
    InputError
        The codec has fewer ids, no family can have as many members (:func:`max_family_size`), or
        there are fewer members among the first :data:`MAX_CANDIDATES` candidates; the message has
        their number.
    """
    capacity = codec.capacity(tags)
    if count < 1:
        raise InputError(f"a family of {count} tags", hint="Use at least 1")
    if min_distance < 1:
        raise InputError(f"a minimum distance of {min_distance}", hint="Use at least 1")
    if count > capacity:
        hint = "Use a smaller count, or more magnets or orientations"
        raise InputError(f"no {count} tags: the codec has {capacity} ids", hint=hint)
    bound = max_family_size(tags, min_distance)
    if count > bound:
        raise InputError(
            f"no {count} tags with distance {min_distance}: there are at most {bound}",
            hint=_feasible_hint(tags, count, min_distance),
        )
    stride = _stride(capacity)
    candidates = min(capacity, MAX_CANDIDATES)
    member_rows = np.empty((count, tags.order**2), np.int16)
    members: list[int] = []
    reported = 0
    for start in range(0, candidates, BATCH_IDS):
        batch = range(start, min(start + BATCH_IDS, candidates))
        ids = tuple(number * stride % capacity for number in batch)
        rows = symbol_table(tags, ids)
        near = _near_any(tags, rows, member_rows[: len(members)], min_distance - 1)
        eligible = np.flatnonzero(~near)
        # Candidates of one batch must also keep the distance from each other.
        is_compatible = _distances(tags, rows[eligible], rows[eligible]) >= min_distance
        is_open = np.ones(len(eligible), bool)
        for k, row in enumerate(eligible):
            if is_open[k]:
                is_open &= is_compatible[k]
                member_rows[len(members)] = rows[row]
                members.append(ids[row])
                if len(members) == count:
                    return tuple(members)
        fraction = max(len(members) / count, batch.stop / candidates)
        while progress is not None and reported < int(PROGRESS_STEPS * fraction):
            progress()
            reported += 1
    tried = "all" if candidates == capacity else f"the first {candidates} of"
    raise InputError(
        f"no {count} tags with distance {min_distance}: {len(members)} found among {tried} "
        f"{capacity} ids",
        hint="Use a smaller count or minimum distance, or more magnets or orientations",
    )


def _near_any(
    tags: Tags, rows: NDArray[np.int16], member_rows: NDArray[np.int16], radius: int
) -> NDArray[np.bool_]:
    """Return whether any member is within a radius of each of the tags (n,)."""
    magnets, base = tags.magnets, tags.orientations
    if radius < base // 2:
        size = sum(lee_weight_counts(magnets, base)[: radius + 1])
        if IDS_PER_NEAR_TAG * size < len(member_rows):
            words = [_rotations_of_weight(magnets, base, steps) for steps in range(radius + 1)]
            pairs = _NearTags(tags, member_rows).find(rows, np.vstack(words))
            near = np.zeros(len(rows), bool)
            near[pairs[:, 0]] = True
            return near
    return np.asarray((_distances(tags, rows, member_rows) <= radius).any(axis=1))


class _NearTags:
    """Table of tags in which those near another tag, with the same cells, are found.

    A tag has a key: the sum, modulo 2^64, of a random number for each cell and its value (Zobrist,
    ICCA Journal 13 (1990) 69). The keys of all tags near another one are looked up in the sorted
    keys of the table; each match is verified, so that equal keys of different tags do no harm.
    """

    def __init__(self, tags: Tags, rows: NDArray[np.int16]) -> None:
        self.orientations, self.magnets, self.rows = tags.orientations, tags.magnets, rows
        self.numbers = np.random.default_rng(KEY_SEED).integers(
            0, 1 << 64, (rows.shape[1], tags.orientations + 1), np.uint64
        )
        keys = self.numbers[np.arange(rows.shape[1]), rows].sum(axis=1, dtype=np.uint64)
        self.order = np.argsort(keys, kind="stable")
        self.keys = keys[self.order]

    def find(self, rows: NDArray[np.int16], deltas: NDArray[np.int16]) -> NDArray[np.intp]:
        """Return pairs (k, 2) of an index in ``rows`` and one in the table.

        The orientations of the second differ from those of the first by one of ``deltas`` (v, M).
        """
        cells = np.nonzero(rows != EMPTY_CELL)[1].reshape(len(rows), self.magnets)
        symbols = np.take_along_axis(rows, cells, axis=1)
        keys = self.numbers[np.arange(rows.shape[1]), rows].sum(axis=1, dtype=np.uint64)[:, None]
        rotated = (symbols[:, :, None] + np.arange(self.orientations)) % self.orientations
        changes = self.numbers[cells[:, :, None], rotated]
        changes = changes - self.numbers[cells, symbols][:, :, None]
        keys = np.repeat(keys, len(deltas), axis=1)
        for magnet in range(self.magnets):
            keys += changes[:, magnet, deltas[:, magnet]]
        position = np.searchsorted(self.keys, keys)
        last = len(self.keys) - 1
        row, word = np.nonzero(self.keys[np.minimum(position, last)] == keys)
        position, keys = position[row, word], keys[row, word]
        expected = rows[row]
        by_magnet = np.arange(self.magnets)
        expected[np.arange(len(row))[:, None], cells[row]] = rotated[
            row[:, None], by_magnet, deltas[word]
        ]
        found = [np.empty((0, 2), np.intp)]
        # Several tags of the table have the same key if it has one of them twice.
        while len(row):
            index = self.order[position]
            is_equal = (self.rows[index] == expected).all(axis=1)
            found.append(np.column_stack([row, index])[is_equal])
            position = position + 1
            is_next = (position <= last) & (self.keys[np.minimum(position, last)] == keys)
            row, position, keys = row[is_next], position[is_next], keys[is_next]
            expected = expected[is_next]
        return np.vstack(found)


@functools.cache
def lee_weight_counts(magnets: int, orientations: int) -> tuple[int, ...]:
    """Return the number of words of ``magnets`` symbols of each Lee weight, from 0 on."""
    per_magnet = [0] * (orientations // 2 + 1)
    for symbol in range(orientations):
        per_magnet[min(symbol, orientations - symbol)] += 1
    counts = np.array([1], object)
    for _ in range(magnets):
        counts = np.convolve(counts, np.array(per_magnet, object))
    return tuple(int(count) for count in counts)


@functools.lru_cache(maxsize=16)
def _rotations_of_weight(magnets: int, orientations: int, weight: int) -> NDArray[np.int16]:
    """Return all words (v, M) of a Lee weight: rotations of the magnets by so many steps in all."""
    if magnets == 0:
        return np.zeros((int(weight == 0), 0), np.int16)
    blocks = []
    for delta in range(orientations):
        steps = min(delta, orientations - delta)
        if steps <= weight:
            rest = _rotations_of_weight(magnets - 1, orientations, weight - steps)
            blocks.append(np.column_stack([np.full(len(rest), delta, np.int16), rest]))
    return np.vstack(blocks)


def _stride(capacity: int) -> int:
    """Return the first number from the golden section of ``capacity`` on that is coprime to it."""
    stride = max(1, (math.isqrt(5 * capacity * capacity) - capacity) // 2)
    while math.gcd(stride, capacity) != 1:
        stride += 1
    return stride


def _distances(
    tags: Tags, rows: NDArray[np.int16], other_rows: NDArray[np.int16]
) -> NDArray[np.float32]:
    """Return the distances (n, m) of the tags of two tables by one matrix product.

    They are exact, because float32 represents halves and small integers exactly.
    """
    cells, base = rows.shape[1], tags.orientations
    # One column for each cell and orientation; the last orientation is the empty cell.
    costs = _cell_costs(base)[rows].reshape(len(rows), cells * (base + 1))
    one_hot = np.eye(base + 1, dtype=np.float32)[other_rows].reshape(
        len(other_rows), cells * (base + 1)
    )
    distances: NDArray[np.float32] = costs @ one_hot.T
    return distances


@functools.cache
def _cell_costs(orientations: int) -> NDArray[np.float32]:
    """Return the distance (P + 1, P + 1) of two tags in one cell; the last index is the empty cell.

    A magnet in another cell changes two cells, so each of them has half of its weight.
    """
    symbols = np.arange(orientations)
    steps = np.abs(symbols[:, None] - symbols)
    costs = np.zeros((orientations + 1, orientations + 1), np.float32)
    costs[:-1, :-1] = np.minimum(steps, orientations - steps)
    costs[-1, :-1] = costs[:-1, -1] = orientations // 2 / 2
    return costs
