"""Reading a tag: from the magnets seen to the id they mean, or a refusal.

Orientations come as real numbers of steps, and stay so: candidates are compared by their
soft distance, the sum of the magnets' deviations from the orientations expected, in steps
(where a tag's magnets were measured as built, these are expected). A magnet seen where the
candidate has none costs P // 2, as in :mod:`families`; one that was not seen costs nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import families, mosk, redundant
from locatk.core.polaris.tag import Cell, TagLayout, Tags, vertices

Array = NDArray[np.float64]

TIE = 0.1
"""Margins below this many steps are a tie: an orientation within a twentieth of a step of
the border between two."""

TIE_SIGMA = 3.0
"""So are margins of less than so many of their own standard deviations."""

SURE = 1.0
"""Margin in steps that a family's member needs where one of its magnets is missing."""

FEWEST = 3
"""Magnets that must be seen: fewer lie on many a grid."""


@dataclass(frozen=True)
class Reading:
    """What the magnets of one tag say.

    Attributes
    ----------
    tag_id : int or None
        None where it is refused.
    margin : float
        Soft distance to the second best id minus that to the best, in steps; of codec
        ``redundant`` a lower bound of it, see :func:`read`. 0 where no id came into
        question, and where only one exists the largest distance of two tags.
    corrected : int
        Steps between what was seen and the id, in whole orientations, with P // 2 for a
        magnet in a wrong cell.
    erased : int
        Magnets of the id that were not seen.
    symbols : tuple of int
        Orientations of the magnets seen, in the order given: as the id has them, or the
        nearest ones where it is refused or has no magnet there.
    refused : str
        "" or why there is no id: ``outside_grid``, ``cell_twice``, ``corner_occupied`` (a
        magnet on v4), ``vertex_missing``, ``magnets_missing``, ``too_many_magnets``,
        ``no_such_placement``, ``tie``, ``not_in_family``, ``beyond_code`` (more errors than
        the redundant code is made for).
    """

    tag_id: int | None
    margin: float
    corrected: int
    erased: int
    symbols: tuple[int, ...]
    refused: str = ""


class _Seen(NamedTuple):
    """Magnets with an orientation: cells, their columns of a table, steps and sigma (m,)."""

    cells: tuple[Cell, ...]
    column: NDArray[np.intp]
    steps: Array
    sigma: Array
    nearest: tuple[int, ...]


class _Candidates(NamedTuple):
    """Ids in question, as what is expected of them.

    An id that was measured as built has more rows: only the built one can be chosen, but as
    a rival of others it has the benefit of both.
    """

    owner: NDArray[np.intp]  # (n,) which id
    expected: Array  # (n, m) orientation in steps; nan where the id has no magnet
    electable: NDArray[np.bool_]  # (n,)


def read(
    tags: Tags, cells: Sequence[Cell], steps: ArrayLike, sigma: ArrayLike | None = None
) -> Reading:
    """The id that magnets mean.

    Three ways. *Without a family*, each magnet must be there and takes its nearest
    orientation; the margin is that of the least certain magnet. *In a family*, the nearest
    member is read where no more than ``(min_distance - 1) // 2`` steps had to be corrected,
    ``P // 2`` less distance counting for each magnet missing; beyond that distance missing
    magnets are borne only where everything seen agrees and all other members are
    :data:`SURE` steps further. *Codec redundant* reads what :func:`redundant.decode_word`
    accepts, then asks whether the family has it; as its code corrects misreads of any size,
    soft distances count one step a magnet at most, and the margin is a lower bound: what
    the ``5 - missing`` magnets cost that would change cheapest, the fewest in which another
    word differs.

    Parameters
    ----------
    tags : Tags
    cells : sequence of m (column, row)
        Where magnets were seen, in any order.
    steps : (m,) array_like
        Their orientations in steps of 360/P degrees, clockwise from the tag's x; any wrap.
        A magnet of orientation ``nan`` counts as not seen.
    sigma : (m,) array_like, optional
        Standard deviations of ``steps``; not finite where unknown.

    Raises
    ------
    ValueError
        The arguments are not equally long.
    InputError
        The design cannot be, or the family has an id that is none.
    """
    codec.check_design(tags)
    measured = np.asarray(steps, float)
    spread = np.zeros(len(cells)) if sigma is None else np.asarray(sigma, float)
    if measured.shape != (len(cells),) or spread.shape != measured.shape:
        raise ValueError(f"{len(cells)} cells, steps {measured.shape}, sigma {spread.shape}")
    known = np.isfinite(measured)
    nearest = np.zeros(len(cells), int)
    nearest[known] = np.rint(measured[known]).astype(int) % tags.orientations
    spread = np.where(np.isfinite(spread), spread, 0.0)
    kept = tuple(cell for cell, ok in zip(cells, known, strict=True) if ok)
    seen = _Seen(
        kept,
        np.array([row * tags.order + column for column, row in kept], np.intp),
        measured[known],
        spread[known],
        tuple(nearest[known].tolist()),
    )
    reason = _misplaced(tags, cells)
    if not reason and len(kept) < FEWEST:
        reason = "magnets_missing"
    if reason:
        result = _refusal(tags, seen, reason)
    elif tags.codec == "redundant":
        result = _read_redundant(tags, seen)
    elif tags.ids is None:
        result = _read_any(tags, seen)
    else:
        result = _read_member(tags, seen, tags.ids)
    if known.all():
        return result
    nearest[known] = result.symbols
    return Reading(**{**vars(result), "symbols": tuple(nearest.tolist())})


def _misplaced(tags: Tags, cells: Sequence[Cell]) -> str:
    if not all(0 <= index < tags.order for cell in cells for index in cell):
        return "outside_grid"
    if len(set(cells)) < len(cells):
        return "cell_twice"
    return "corner_occupied" if vertices(tags.order)[3] in cells else ""


def _refusal(tags: Tags, seen: _Seen, reason: str, margin: float = 0.0) -> Reading:
    missing = max(0, tags.magnets - len(seen.cells))
    return Reading(None, margin, 0, missing, seen.nearest, reason)


def _read_any(tags: Tags, seen: _Seen) -> Reading:
    """Every id of the codec may occur."""
    if not set(vertices(tags.order)[:3]) <= set(seen.cells):
        return _refusal(tags, seen, "vertex_missing")
    if len(seen.cells) != tags.magnets:
        few = len(seen.cells) < tags.magnets
        return _refusal(tags, seen, "magnets_missing" if few else "too_many_magnets")
    # The nearest id, and those that differ from it in one magnet's second nearest: in one of
    # them is the best of all others.
    symbols = np.tile(seen.nearest, (tags.magnets + 1, 1))
    side = np.where(seen.steps >= np.rint(seen.steps), 1, -1)
    symbols[1:] += np.diag(side)
    symbols %= tags.orientations
    try:
        ids = [_id_of(tags, seen.cells, row) for row in symbols.tolist()]
    except InputError:
        return _refusal(tags, seen, "no_such_placement")
    expected = [symbols.astype(float)]
    owners = list(range(len(ids)))
    if tags.built:
        built = tuple(tags.built)
        rows = _built(tags, built)[:, seen.column]
        here = np.flatnonzero(np.isfinite(rows).all(axis=1))
        expected.append(rows[here])
        known = {tag_id: k for k, tag_id in enumerate(ids)}
        for tag_id in (built[k] for k in here):
            owners.append(known.setdefault(tag_id, len(owners)))
            ids.append(tag_id)
    electable = np.array([k >= len(symbols) or i not in tags.built for k, i in enumerate(ids)])
    found = _Candidates(np.array(owners, np.intp), np.concatenate(expected), electable)
    best, margin, tie = _nearest(tags, found, seen)
    if tie:
        return _refusal(tags, seen, "tie", margin)
    layout = codec.layout_of(tags, ids[best])
    corrected, _ = _changes(tags, found.expected[best], seen)
    return _accepted(ids[best], layout, seen, margin, corrected, 0)


def _read_member(tags: Tags, seen: _Seen, ids: tuple[int, ...]) -> Reading:
    """Only the ids of a family may occur."""
    rows = _members(tags, ids)
    if not len(rows):
        return _refusal(tags, seen, "not_in_family")
    seen_rows = rows[:, seen.column]
    expected = np.where(seen_rows == families.EMPTY_CELL, np.nan, seen_rows)
    owner = np.arange(len(ids))
    electable = np.ones(len(ids), bool)
    number = _numbers(ids) if tags.built else {}
    built = tuple(tag_id for tag_id in tags.built if tag_id in number)
    if built:
        which = np.array([number[tag_id] for tag_id in built])
        expected = np.concatenate([expected, _built(tags, built)[:, seen.column]])
        electable[which] = False
        owner = np.concatenate([owner, which])
        electable = np.concatenate([electable, np.ones(len(built), bool)])
    best, margin, tie = _nearest(tags, _Candidates(owner, expected, electable), seen)

    half_turn = tags.orientations // 2
    corrected, matched = _changes(tags, expected[best], seen)
    erased = tags.magnets - matched
    # A magnet in a wrong cell leaves its own cell without: that is one error, not two.
    erased -= min(erased, len(seen.cells) - matched)
    distance = max(0, tags.min_distance - erased * half_turn)
    if corrected > distance // 2:
        return _refusal(tags, seen, "not_in_family", margin)
    if erased and margin < SURE:
        return _refusal(tags, seen, "magnets_missing", margin)
    if tie:
        return _refusal(tags, seen, "tie", margin)
    if corrected > max(0, distance - 1) // 2:
        return _refusal(tags, seen, "not_in_family", margin)
    tag_id = ids[owner[best]]
    layout = codec.layout_of(tags, tag_id)
    return _accepted(tag_id, layout, seen, margin, corrected, erased)


def _read_redundant(tags: Tags, seen: _Seen) -> Reading:
    """Words of the redundant code."""
    cells = redundant.cells(tags)
    if not set(seen.cells) <= set(cells):
        return _refusal(tags, seen, "no_such_placement")
    missing = tags.magnets - len(seen.cells)
    where = [cells.index(cell) for cell in seen.cells]
    word: list[int | None] = [None] * tags.magnets
    for place, symbol in zip(where, seen.nearest, strict=True):
        word[place] = symbol
    expected: dict[int, Array] = {}
    decoded = redundant.decode_word(tags, word)
    if decoded is not None:
        expected[redundant.id_of_word(tags, decoded)] = np.array(decoded, float)[where]
    if tags.built:
        built, rows = tuple(tags.built), _built(tags, tuple(tags.built))[:, seen.column]
        misread = (np.abs(_deviation(tags, rows, seen)) > 0.5).sum(axis=1)
        for k in np.flatnonzero(2 * misread + missing <= redundant.MAX_DECODING_WEIGHT):
            expected[built[k]] = rows[k]
    if not expected:
        return _refusal(tags, seen, "beyond_code")

    costs = {tag_id: _capped(tags, steps, seen) for tag_id, steps in expected.items()}
    tag_id, *others = sorted(costs, key=lambda tag_id: float(costs[tag_id].sum()))
    layout = codec.layout_of(tags, tag_id)
    margin = _code_margin(tags, np.array(layout.symbols)[where], costs[tag_id], seen)
    if others:
        margin = min(margin, float(costs[others[0]].sum() - costs[tag_id].sum()))
        if margin < TIE:
            return _refusal(tags, seen, "tie", margin)
    if tags.ids is not None and tag_id not in _numbers(tags.ids):
        return _refusal(tags, seen, "not_in_family", margin)
    corrected, _ = _changes(tags, expected[tag_id], seen)
    return _accepted(tag_id, layout, seen, margin, corrected, missing)


def _code_margin(tags: Tags, symbols: NDArray[np.int_], costs: Array, seen: _Seen) -> float:
    """How much more another word costs at least: it differs in ``5 - missing`` magnets."""
    others = np.repeat(np.arange(redundant.field_size(tags.orientations))[:, None], len(costs), 1)
    there = _capped(tags, others.astype(float), seen)
    there[symbols, np.arange(len(costs))] = np.inf
    changes = np.sort(there.min(axis=0) - costs)
    differing = redundant.MIN_WORD_DISTANCE - (tags.magnets - len(seen.cells))
    return float(changes[:differing].sum())


def _nearest(tags: Tags, found: _Candidates, seen: _Seen) -> tuple[int, float, bool]:
    """Row of the nearest candidate, its margin, and whether that is too little to tell."""
    away = _deviation(tags, found.expected, seen)
    empty = np.isnan(away)
    half_turn = tags.orientations // 2
    soft = np.where(empty, half_turn, np.abs(away)).sum(axis=1)
    best = int(np.where(found.electable, soft, np.inf).argmin())
    rivals = found.owner != found.owner[best]
    gaps = soft[rivals] - soft[best]
    if not len(gaps):
        return best, float(tags.magnets * half_turn - soft[best]), False
    margin = float(gaps.min())
    # A magnet's error moves the gap twice where it lies between the two, else not at all.
    doubtful = gaps < TIE_SIGMA * 2 * np.sqrt((seen.sigma**2).sum())
    slope = np.where(empty, 0.0, np.sign(away))
    turns = slope[rivals][doubtful] - slope[best]
    scatter = np.sqrt((turns**2 * seen.sigma**2).sum(axis=1))
    return best, margin, margin < TIE or bool((gaps[doubtful] < TIE_SIGMA * scatter).any())


def _deviation(tags: Tags, expected: Array, seen: _Seen) -> Array:
    """Steps from what is expected to what was seen, the short way round; nan stays."""
    away: Array = seen.steps - expected
    away -= tags.orientations * np.rint(away / tags.orientations)
    return away


def _capped(tags: Tags, expected: Array, seen: _Seen) -> Array:
    """What each magnet costs in the redundant code: its deviation, a step at most."""
    return np.minimum(np.abs(_deviation(tags, expected, seen)), 1.0)


def _changes(tags: Tags, expected: Array, seen: _Seen) -> tuple[int, int]:
    """Whole steps from one row of expectations to what was seen, and how many of the
    magnets seen it has."""
    away = _deviation(tags, expected, seen)
    empty = np.isnan(away)
    wrong = int(empty.sum())
    steps = int(np.rint(np.abs(away[~empty])).sum())
    return steps + wrong * (tags.orientations // 2), len(away) - wrong


def _accepted(
    tag_id: int, layout: TagLayout, seen: _Seen, margin: float, corrected: int, erased: int
) -> Reading:
    meant = dict(zip(layout.cells, layout.symbols, strict=True))
    pairs = zip(seen.cells, seen.nearest, strict=True)
    symbols = tuple(meant.get(cell, nearest) for cell, nearest in pairs)
    return Reading(tag_id, margin, corrected, erased, symbols)


def _id_of(tags: Tags, cells: tuple[Cell, ...], symbols: Sequence[int]) -> int:
    """The id of magnets in any order."""
    pairs = sorted(zip(cells, symbols, strict=True), key=lambda pair: mosk.row_major_key(pair[0]))
    return codec.id_of(tags, TagLayout(tuple(c for c, _ in pairs), tuple(s for _, s in pairs)))


def _built(tags: Tags, ids: tuple[int, ...]) -> Array:
    """Orientations (n, K * K) in steps of tags as they were built; nan where no magnet is."""
    rows = _members(tags, ids)
    taken = rows != families.EMPTY_CELL
    result = np.where(taken, rows, np.nan)
    # A table's row has its magnets in the order of the layout. Angles turn the other way.
    angles = np.concatenate([np.asarray(tags.built[tag_id].angle_rad) for tag_id in ids])
    result[taken] -= angles / tags.step_rad
    return result


def _members(tags: Tags, ids: tuple[int, ...]) -> NDArray[np.int16]:
    """:func:`families.symbol_table`, remembered."""
    return _table(tags.order, tags.magnets, tags.orientations, tags.codec, ids)


@functools.lru_cache(maxsize=16)
def _table(
    order: int, magnets: int, orientations: int, name: str, ids: tuple[int, ...]
) -> NDArray[np.int16]:
    design = Tags(order=order, magnets=magnets, orientations=orientations, codec=name)
    rows = families.symbol_table(design, ids)
    rows.flags.writeable = False
    return rows


@functools.lru_cache(maxsize=16)
def _numbers(ids: tuple[int, ...]) -> dict[int, int]:
    """Index of each id."""
    return {tag_id: k for k, tag_id in enumerate(ids)}
