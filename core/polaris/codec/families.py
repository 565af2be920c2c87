"""Families: ids of one codec that keep a minimum distance from each other.

Distance of two tags: the steps between their orientations, round the circle (Lee), in the
cells both occupy, plus P // 2 for each magnet that one has in a cell where the other has
none. Orientations are misread by a step, seldom by more, so that steps count and not
symbols. A magnet in another cell, a whole spacing away, is misread less than any turn, and
counts as the largest of them: so the distance stays a metric, and a magnet that was not seen
takes P // 2 from it at most, whichever way the two tags differ there.

A family's members never change: :func:`generate` is deterministic, ``VERSION`` names its
rule, and a longer family begins with the shorter one.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.codec import dispatch as codec
from locatk.core.polaris.tag import Tags

VERSION = 1
"""Of the rule after which :func:`generate` chooses. Another rule gets another number and
leaves this one's families as they are."""

EMPTY = -1
"""In tables: no magnet in the cell."""

MOST_VISITS = 1 << 19
"""Ids that :func:`generate` tries before it gives up."""

BATCH = 1024


def table(tags: Tags, ids: tuple[int, ...]) -> NDArray[np.int16]:
    """Orientations of tags by cell.

    Returns
    -------
    (n, K * K) int16 ndarray
        Of cell (column, row) at ``row * K + column``; ``EMPTY`` where no magnet is.

    Raises
    ------
    InputError
        One of the ids is none of the codec.
    """
    order = tags.order
    rows = np.full((len(ids), order * order), EMPTY, np.int16)
    for row, tag_id in zip(rows, ids, strict=True):
        layout = codec.layout_of(tags, tag_id)
        row[[r * order + c for c, r in layout.cells]] = layout.symbols
    return rows


def distance(tags: Tags, one: int, other: int) -> int:
    """Distance of two tags, by their ids.

    Raises
    ------
    InputError
        One of the ids is none of the codec.
    """
    rows = table(tags, (one, other))
    return int(_distances(tags, rows[:1], rows[1:])[0, 0])


def smallest_distance(tags: Tags, ids: tuple[int, ...]) -> int:
    """Distance of the two closest of ``ids``; of less than two, the largest distance that
    tags can have.

    Raises
    ------
    InputError
        One of the ids is none of the codec.
    """
    return closest(tags, ids)[0]


def closest(tags: Tags, ids: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    """Distance of the two closest of ``ids``, and these two (first found; none where there
    are less than two ids).

    Raises
    ------
    InputError
        One of the ids is none of the codec.
    """
    best, pair = tags.magnets * (tags.orientations // 2), ()  # type: tuple[int, tuple[int, ...]]
    rows = table(tags, ids)
    for start in range(0, len(ids), BATCH):
        part = rows[start : start + BATCH]
        apart = _distances(tags, part, rows)
        # Each pair once: with those before it in the list.
        apart[np.arange(len(part))[:, None] + start <= np.arange(len(ids))] = np.inf
        k = int(apart.argmin())
        value = apart.flat[k]
        if value < best or (not pair and value == best):
            best, pair = int(value), (ids[k % len(ids)], ids[start + k // len(ids)])
    return best, pair


def check(tags: Tags) -> None:
    """Refuse a family that is none.

    Raises
    ------
    InputError
        ``tags.ids`` is empty, has an id that the codec has not or that stands there twice,
        or two of them are closer than ``tags.min_distance``; see also
        :func:`codec.check_design`.
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
    found, pair = closest(tags, tags.ids)
    if found == 0:
        raise InputError(f"id {pair[0]} stands twice in the family")
    if pair and found < tags.min_distance:
        raise InputError(
            f"ids {pair[0]} and {pair[1]} have distance {found}, not {tags.min_distance}",
            hint="Drop one of them, or let the minimum distance be smaller",
        )


def generate(tags: Tags, count: int, min_distance: int) -> tuple[int, ...]:
    """The first ``count`` members of the family with this minimum distance.

    Ids are visited in steps of about the golden section of the capacity, so that they are
    spread over placements and orientations; each joins that keeps the distance from all
    before it.

    Parameters
    ----------
    tags : Tags
        Its design; ``tags.ids`` is not looked at.
    count : int
    min_distance : int
        At least 1.

    Raises
    ------
    InputError
        The codec does not hold so many, or they were not found among the first
        :data:`MOST_VISITS` ids; it says how many were.
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
    visits = min(capacity, MOST_VISITS)
    members = np.empty((count, tags.order**2), np.int16)
    chosen: list[int] = []
    for start in range(0, visits, BATCH):
        batch = range(start, min(start + BATCH, visits))
        ids = tuple(visit * stride % capacity for visit in batch)
        rows = table(tags, ids)
        far = _distances(tags, rows, members[: len(chosen)]) >= min_distance
        fits = np.flatnonzero(far.all(axis=1))
        among = _distances(tags, rows[fits], rows[fits]) >= min_distance
        taken: list[int] = []
        for k, row in enumerate(fits):
            if among[k, taken].all():
                taken.append(k)
                members[len(chosen)] = rows[row]
                chosen.append(ids[row])
                if len(chosen) == count:
                    return tuple(chosen)
    tried = "all" if visits == capacity else f"the first {visits} of"
    raise InputError(
        f"no {count} tags with distance {min_distance}: {len(chosen)} found among {tried} "
        f"{capacity} ids",
        hint=hint,
    )


def _stride(capacity: int) -> int:
    """The first number from the golden section of ``capacity`` on that is coprime to it."""
    stride = max(1, (math.isqrt(5 * capacity * capacity) - capacity) // 2)
    while math.gcd(stride, capacity) != 1:
        stride += 1
    return stride


def _distances(
    tags: Tags, rows: NDArray[np.int16], others: NDArray[np.int16]
) -> NDArray[np.float32]:
    """Distances (n, m) of the tags of two tables: exact, for halves and small integers are
    so in float32, and one matrix product."""
    size, base = rows.shape[1], tags.orientations
    # One column a cell and orientation (the last: empty), one where the tag has it.
    cost = _costs(base)
    weighted = cost[rows].reshape(len(rows), size * (base + 1))
    marked = np.eye(base + 1, dtype=np.float32)[others].reshape(len(others), size * (base + 1))
    result: NDArray[np.float32] = weighted @ marked.T
    return result


@functools.cache
def _costs(orientations: int) -> NDArray[np.float32]:
    """What two tags differ in one cell (P + 1, P + 1); the last index is the empty cell. A
    magnet in another cell leaves one cell and enters one: each has half of its weight."""
    steps = np.arange(orientations)
    turn = np.abs(steps[:, None] - steps)
    costs = np.zeros((orientations + 1, orientations + 1), np.float32)
    costs[:-1, :-1] = np.minimum(turn, orientations - turn)
    costs[-1, :-1] = costs[:-1, -1] = orientations // 2 / 2
    return costs
