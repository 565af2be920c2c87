"""Families of tags: ids of one codec with a minimum distance from each other.

The distance of two tags is the number of steps between their orientations around the circle (Lee
distance), summed over the cells that both occupy, plus P // 2 for each magnet of one tag in a cell
that the other tag leaves empty. Steps are counted, not differing symbols, because orientations are
usually misread by one step. A magnet in another cell, a whole spacing away, is confused less often
than any orientation and counts as the largest number of steps. So the distance is a metric, and a
magnet that is not detected reduces it by at most P // 2, however the two tags differ there.

The members of a family never change: :func:`generate_family` is deterministic,
:data:`FAMILY_RULE_VERSION` names its rule, and a longer family begins with the shorter one.
"""

from __future__ import annotations

import functools
import math

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
    best, pair = tags.magnets * (tags.orientations // 2), ()  # type: tuple[int, tuple[int, ...]]
    rows = symbol_table(tags, ids)
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


def generate_family(tags: Tags, count: int, min_distance: int) -> tuple[int, ...]:
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

    Raises
    ------
    InputError
        The codec has fewer ids, or there are fewer members among the first
        :data:`MAX_CANDIDATES` candidates; the message has their number.
    """
    capacity = codec.capacity(tags)
    if count < 1:
        raise InputError(f"a family of {count} tags", hint="Use at least 1")
    if min_distance < 1:
        raise InputError(f"a minimum distance of {min_distance}", hint="Use at least 1")
    hint = "Use a smaller count or minimum distance, or more magnets or orientations"
    if count > capacity:
        raise InputError(f"no {count} tags: the codec has {capacity} ids", hint=hint)
    stride = _stride(capacity)
    candidates = min(capacity, MAX_CANDIDATES)
    member_rows = np.empty((count, tags.order**2), np.int16)
    members: list[int] = []
    for start in range(0, candidates, BATCH_IDS):
        batch = range(start, min(start + BATCH_IDS, candidates))
        ids = tuple(number * stride % capacity for number in batch)
        rows = symbol_table(tags, ids)
        keeps_distance = _distances(tags, rows, member_rows[: len(members)]) >= min_distance
        eligible = np.flatnonzero(keeps_distance.all(axis=1))
        # Candidates of one batch must also keep the distance from each other.
        is_compatible = _distances(tags, rows[eligible], rows[eligible]) >= min_distance
        accepted: list[int] = []
        for k, row in enumerate(eligible):
            if is_compatible[k, accepted].all():
                accepted.append(k)
                member_rows[len(members)] = rows[row]
                members.append(ids[row])
                if len(members) == count:
                    return tuple(members)
    tried = "all" if candidates == capacity else f"the first {candidates} of"
    raise InputError(
        f"no {count} tags with distance {min_distance}: {len(members)} found among {tried} "
        f"{capacity} ids",
        hint=hint,
    )


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
