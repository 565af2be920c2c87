"""Decoding of a tag: from the orientations of its magnets to its id, or to a refusal.

Orientations are real numbers of steps and are not rounded: candidates are compared by their soft
distance, the sum of the magnets' deviations from the expected orientations in steps (those as
built, if the magnets of a tag were measured). A magnet where the candidate has none costs P // 2,
as in :mod:`~locatk.core.polaris.codec.families`; a magnet that was not observed costs nothing.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import families, mosk, redundant
from locatk.core.polaris.tag import Cell, TagLayout, Tags, vertices

Array = NDArray[np.float64]

MAX_TIE_STEPS = 0.1
"""Margin in steps below which two ids tie: an orientation is within a twentieth of a step of the
border between two."""

MAX_TIE_SIGMAS = 3.0
"""Margin in its own standard deviations below which two ids tie as well."""

MIN_ERASED_MARGIN_STEPS = 1.0
"""Margin in steps that a member of a family needs if one of its magnets is missing."""

MIN_MAGNETS = 3
"""Number of magnets that must be observed: fewer match many a grid."""

MAX_REDUNDANT_COST_STEPS = 1.0
"""Cost of a magnet in the redundant code, in steps: it corrects misreads of any size."""

MAX_REDUNDANT_MISSING = 2
"""Number of magnets that may be missing from a redundant tag. The code could fill in a third, but
one tag in P of another design would then be taken for a tag that has lost three magnets."""


@dataclass(frozen=True)
class DecodedTag:
    """Id of the magnets of one tag, or a refusal.

    Attributes
    ----------
    tag_id : int or None
        None if it is refused.
    margin : float
        Soft distance to the second best id minus that to the best, in steps; for codec
        ``redundant`` a lower bound of it, see :func:`decode_tag`. 0 if there is no candidate; if
        there is only one, the largest distance of two tags minus the distance to it.
    corrected : int
        Steps between the observed orientations and those of the id, in whole steps, with P // 2
        for a magnet in a wrong cell.
    erased : int
        Magnets of the id that were not observed.
    symbols : tuple of int
        Orientations of the observed magnets, in the order given: those of the id, or the nearest
        ones if it is refused or has no magnet there.
    refused : str
        "" or a machine-readable reason: ``outside_grid``, ``cell_twice``, ``corner_occupied`` (a
        magnet on v4), ``vertex_missing``, ``magnets_missing``, ``too_many_magnets``,
        ``no_such_placement``, ``tie``, ``not_in_family``, ``beyond_code`` (more errors than the
        redundant code corrects).
    """

    tag_id: int | None
    margin: float
    corrected: int
    erased: int
    symbols: tuple[int, ...]
    refused: str = ""


class _ObservedMagnets(NamedTuple):
    """Magnets with an orientation: cells, their columns of a table, steps and sigma (m,)."""

    cells: tuple[Cell, ...]
    column: NDArray[np.intp]
    steps: Array
    sigma: Array
    nearest: tuple[int, ...]


class _Candidates(NamedTuple):
    """Candidate ids with their expected orientations.

    An id that was measured as built has several rows: only the measured one can be elected, but
    as a rival of other ids it is judged by the nearer of its rows.
    """

    owner: NDArray[np.intp]  # (n,) index of the id
    expected: Array  # (n, m) orientation in steps; nan if the id has no magnet there
    is_electable: NDArray[np.bool_]  # (n,)


def decode_tag(
    tags: Tags, cells: Sequence[Cell], steps: ArrayLike, sigma: ArrayLike | None = None
) -> DecodedTag:
    """Decode the id of a tag from the orientations of its magnets.

    *Without a family*, every magnet must be observed and takes its nearest orientation; the margin
    is that of the least certain magnet.

    *In a family*, the nearest member is accepted if at most ``(d - 1) // 2`` steps have to be
    corrected. The distance d is ``min_distance``, less ``P // 2`` for each missing magnet. If a
    magnet is missing, all other members must also be :data:`MIN_ERASED_MARGIN_STEPS` farther away;
    if nothing remains of d, all observed magnets must agree.

    *Codec redundant* accepts the words that :func:`redundant.decode_word` does, if they are in the
    family and at most :data:`MAX_REDUNDANT_MISSING` magnets are missing. Its code corrects misreads
    of any size, so that soft distances count at most one step per magnet. The margin is a lower
    bound: another word differs in at least ``5 - missing`` magnets, and the margin is the cost of
    changing those that change most cheaply.

    Parameters
    ----------
    tags : Tags
    cells : sequence of m (column, row)
        Cells of the observed magnets, in any order.
    steps : (m,) array_like
        Their orientations in steps of 360/P degrees, clockwise from the tag's x; any wrap.
        A magnet of orientation ``nan`` counts as not observed.
    sigma : (m,) array_like, optional
        Standard deviations of ``steps``; not finite if unknown.

    Raises
    ------
    ValueError
        The arguments differ in length.
    InputError
        The design is impossible, or the family has an invalid id.
    """
    codec.check_design(tags)
    measured = np.asarray(steps, float)
    spread = np.zeros(len(cells)) if sigma is None else np.asarray(sigma, float)
    if measured.shape != (len(cells),) or spread.shape != measured.shape:
        raise ValueError(f"{len(cells)} cells, steps {measured.shape}, sigma {spread.shape}")
    is_known = np.isfinite(measured)
    nearest = np.zeros(len(cells), int)
    nearest[is_known] = np.rint(measured[is_known]).astype(int) % tags.orientations
    spread = np.where(np.isfinite(spread), spread, 0.0)
    kept = tuple(cell for cell, ok in zip(cells, is_known, strict=True) if ok)
    magnets = _ObservedMagnets(
        kept,
        np.array([row * tags.order + column for column, row in kept], np.intp),
        measured[is_known],
        spread[is_known],
        tuple(nearest[is_known].tolist()),
    )
    reason = _misplaced(tags, cells)
    if not reason and len(kept) < MIN_MAGNETS:
        reason = "magnets_missing"
    if reason:
        result = _refusal(tags, magnets, reason)
    elif tags.codec == "redundant":
        result = _decode_redundant(tags, magnets)
    elif tags.ids is None:
        result = _decode_any_id(tags, magnets)
    else:
        result = _decode_member(tags, magnets, tags.ids)
    if is_known.all():
        return result
    nearest[is_known] = result.symbols
    return replace(result, symbols=tuple(nearest.tolist()))


def coincidence_probability(tags: Tags, cells: Sequence[Cell], decoded: DecodedTag) -> float:
    """Return the probability that arbitrary orientations in some cells decode to a used id.

    It is that of at most as many corrected steps as those of the decoded tag; for the redundant
    code, which corrects a single magnet, an upper limit. The ids in use are those of the tags on
    the site if the decoded one is among them, else those of the family. If neither is given, it is
    one, except for the redundant code.
    """
    half_turn, count = tags.orientations // 2, len(cells)
    if decoded.tag_id in tags.site:
        ids: tuple[int, ...] | None = tuple(tags.site)
    else:
        ids = tags.ids
    if ids is not None:
        columns = [row * tags.order + column for column, row in cells]
        misplaced = (_members(tags, ids)[:, columns] == families.EMPTY_CELL).sum(axis=1)
        ids_by_misplaced = Counter(misplaced.tolist())
    elif tags.codec == "redundant":
        ids_by_misplaced = Counter({0: codec.capacity(tags)})
    else:
        return 1.0
    probability = 0.0
    for empty, members in ids_by_misplaced.items():
        steps = decoded.corrected - empty * half_turn
        if steps >= 0:
            counts = families.lee_weight_counts(count - empty, tags.orientations)
            words = tags.orientations ** (count - empty)
            probability += members * sum(counts[: steps + 1]) / words
    return min(probability, 1.0)


def _misplaced(tags: Tags, cells: Sequence[Cell]) -> str:
    """Return the reason if magnets are on impossible cells, else ""."""
    if not all(0 <= index < tags.order for cell in cells for index in cell):
        return "outside_grid"
    if len(set(cells)) < len(cells):
        return "cell_twice"
    return "corner_occupied" if vertices(tags.order)[3] in cells else ""


def _refusal(tags: Tags, magnets: _ObservedMagnets, reason: str, margin: float = 0.0) -> DecodedTag:
    missing = max(0, tags.magnets - len(magnets.cells))
    return DecodedTag(None, margin, 0, missing, magnets.nearest, reason)


def _decode_any_id(tags: Tags, magnets: _ObservedMagnets) -> DecodedTag:
    """Decode a tag of which every id of the codec may occur."""
    if not set(vertices(tags.order)[:3]) <= set(magnets.cells):
        return _refusal(tags, magnets, "vertex_missing")
    if len(magnets.cells) != tags.magnets:
        is_incomplete = len(magnets.cells) < tags.magnets
        return _refusal(tags, magnets, "magnets_missing" if is_incomplete else "too_many_magnets")
    # The nearest id, and those with the second nearest orientation of one magnet: the best of all
    # other ids is among them.
    symbols = np.tile(magnets.nearest, (tags.magnets + 1, 1))
    second_nearest = np.where(magnets.steps >= np.rint(magnets.steps), 1, -1)
    symbols[1:] += np.diag(second_nearest)
    symbols %= tags.orientations
    try:
        ids = [_id_of(tags, magnets.cells, row) for row in symbols.tolist()]
    except InputError:
        return _refusal(tags, magnets, "no_such_placement")
    expected = [symbols.astype(float)]
    owners = list(range(len(ids)))
    if tags.built:
        built = tuple(tags.built)
        rows = _as_built_orientations(tags, built)[:, magnets.column]
        has_these_cells = np.flatnonzero(np.isfinite(rows).all(axis=1))
        expected.append(rows[has_these_cells])
        index = {tag_id: k for k, tag_id in enumerate(ids)}
        for tag_id in (built[k] for k in has_these_cells):
            owners.append(index.setdefault(tag_id, len(owners)))
            ids.append(tag_id)
    is_electable = np.array([k >= len(symbols) or i not in tags.built for k, i in enumerate(ids)])
    candidates = _Candidates(np.array(owners, np.intp), np.concatenate(expected), is_electable)
    best, margin, is_tie = _nearest(tags, candidates, magnets)
    if is_tie:
        return _refusal(tags, magnets, "tie", margin)
    layout = codec.layout_of(tags, ids[best])
    corrected, _ = _changes(tags, candidates.expected[best], magnets)
    return _accepted(ids[best], layout, magnets, margin, corrected, 0)


def _decode_member(tags: Tags, magnets: _ObservedMagnets, ids: tuple[int, ...]) -> DecodedTag:
    """Decode a tag of a family."""
    rows = _members(tags, ids)
    if not len(rows):
        return _refusal(tags, magnets, "not_in_family")
    observed_rows = rows[:, magnets.column]
    expected = np.where(observed_rows == families.EMPTY_CELL, np.nan, observed_rows)
    owner = np.arange(len(ids))
    is_electable = np.ones(len(ids), bool)
    index = _indices(ids) if tags.built else {}
    built = tuple(tag_id for tag_id in tags.built if tag_id in index)
    if built:
        built_owner = np.array([index[tag_id] for tag_id in built])
        measured = _as_built_orientations(tags, built)[:, magnets.column]
        expected = np.concatenate([expected, measured])
        is_electable[built_owner] = False
        owner = np.concatenate([owner, built_owner])
        is_electable = np.concatenate([is_electable, np.ones(len(built), bool)])
    best, margin, is_tie = _nearest(tags, _Candidates(owner, expected, is_electable), magnets)

    half_turn = tags.orientations // 2
    corrected, matched = _changes(tags, expected[best], magnets)
    erased = tags.magnets - matched
    # A magnet in a wrong cell is missing from its own cell: that is one error, not two.
    erased -= min(erased, len(magnets.cells) - matched)
    distance = max(0, tags.min_distance - erased * half_turn)
    if corrected > distance // 2:
        return _refusal(tags, magnets, "not_in_family", margin)
    if erased and margin < MIN_ERASED_MARGIN_STEPS:
        return _refusal(tags, magnets, "magnets_missing", margin)
    if is_tie:
        return _refusal(tags, magnets, "tie", margin)
    if corrected > max(0, distance - 1) // 2:
        return _refusal(tags, magnets, "not_in_family", margin)
    tag_id = ids[owner[best]]
    layout = codec.layout_of(tags, tag_id)
    return _accepted(tag_id, layout, magnets, margin, corrected, erased)


def _decode_redundant(tags: Tags, magnets: _ObservedMagnets) -> DecodedTag:
    """Decode a word of the redundant code."""
    cells = redundant.cells(tags)
    if not set(magnets.cells) <= set(cells):
        return _refusal(tags, magnets, "no_such_placement")
    missing = tags.magnets - len(magnets.cells)
    if missing > MAX_REDUNDANT_MISSING:
        return _refusal(tags, magnets, "magnets_missing")
    position = [cells.index(cell) for cell in magnets.cells]
    word: list[int | None] = [None] * tags.magnets
    for index, symbol in zip(position, magnets.nearest, strict=True):
        word[index] = symbol
    expected: dict[int, Array] = {}
    decoded = redundant.decode_word(tags, word)
    if decoded is not None:
        expected[redundant.id_of_word(tags, decoded)] = np.array(decoded, float)[position]
    if tags.built:
        built = tuple(tags.built)
        rows = _as_built_orientations(tags, built)[:, magnets.column]
        misreads = (np.abs(_deviation(tags, rows, magnets)) > 0.5).sum(axis=1)
        for k in np.flatnonzero(2 * misreads + missing <= redundant.MAX_DECODING_WEIGHT):
            expected[built[k]] = rows[k]
    if not expected:
        return _refusal(tags, magnets, "beyond_code")

    costs = {tag_id: _capped(tags, steps, magnets) for tag_id, steps in expected.items()}
    tag_id, *others = sorted(costs, key=lambda tag_id: float(costs[tag_id].sum()))
    layout = codec.layout_of(tags, tag_id)
    margin = _code_margin(tags, np.array(layout.symbols)[position], costs[tag_id], magnets)
    if others:
        margin = min(margin, float(costs[others[0]].sum() - costs[tag_id].sum()))
        if margin < MAX_TIE_STEPS:
            return _refusal(tags, magnets, "tie", margin)
    if tags.ids is not None and tag_id not in _indices(tags.ids):
        return _refusal(tags, magnets, "not_in_family", margin)
    corrected, _ = _changes(tags, expected[tag_id], magnets)
    return _accepted(tag_id, layout, magnets, margin, corrected, missing)


def _code_margin(
    tags: Tags, symbols: NDArray[np.int_], costs: Array, magnets: _ObservedMagnets
) -> float:
    """Return how much more any other word costs at least.

    It differs in at least ``5 - missing`` magnets (the distance of the code).
    """
    others = np.repeat(np.arange(redundant.field_size(tags.orientations))[:, None], len(costs), 1)
    other_costs = _capped(tags, others.astype(float), magnets)
    other_costs[symbols, np.arange(len(costs))] = np.inf
    changes = np.sort(other_costs.min(axis=0) - costs)
    differing = redundant.MIN_WORD_DISTANCE - (tags.magnets - len(magnets.cells))
    return float(changes[:differing].sum())


def _nearest(
    tags: Tags, candidates: _Candidates, magnets: _ObservedMagnets
) -> tuple[int, float, bool]:
    """Return the row of the nearest candidate, its margin, and whether the margin is a tie."""
    deviation = _deviation(tags, candidates.expected, magnets)
    is_empty = np.isnan(deviation)
    half_turn = tags.orientations // 2
    distance = np.where(is_empty, half_turn, np.abs(deviation)).sum(axis=1)
    best = int(np.where(candidates.is_electable, distance, np.inf).argmin())
    is_rival = candidates.owner != candidates.owner[best]
    gaps = distance[is_rival] - distance[best]
    if not len(gaps):
        return best, float(tags.magnets * half_turn - distance[best]), False
    margin = float(gaps.min())
    # The error of a magnet that is between the orientations of two candidates changes the gap
    # by twice the error; other errors do not change it.
    is_doubtful = gaps < MAX_TIE_SIGMAS * 2 * np.sqrt((magnets.sigma**2).sum())
    sign = np.where(is_empty, 0.0, np.sign(deviation))
    gap_by_steps = sign[is_rival][is_doubtful] - sign[best]
    gap_sigma = np.sqrt((gap_by_steps**2 * magnets.sigma**2).sum(axis=1))
    is_tie = margin < MAX_TIE_STEPS or (gaps[is_doubtful] < MAX_TIE_SIGMAS * gap_sigma).any()
    return best, margin, bool(is_tie)


def _deviation(tags: Tags, expected: Array, magnets: _ObservedMagnets) -> Array:
    """Return observed minus expected steps, wrapped to half a revolution; nan stays."""
    deviation: Array = magnets.steps - expected
    deviation -= tags.orientations * np.rint(deviation / tags.orientations)
    return deviation


def _capped(tags: Tags, expected: Array, magnets: _ObservedMagnets) -> Array:
    """Return the cost of each magnet in the redundant code."""
    return np.minimum(np.abs(_deviation(tags, expected, magnets)), MAX_REDUNDANT_COST_STEPS)


def _changes(tags: Tags, expected: Array, magnets: _ObservedMagnets) -> tuple[int, int]:
    """Return the whole steps from one row of expectations, and the number of magnets on it."""
    deviation = _deviation(tags, expected, magnets)
    is_empty = np.isnan(deviation)
    misplaced = int(is_empty.sum())
    steps = int(np.rint(np.abs(deviation[~is_empty])).sum())
    return steps + misplaced * (tags.orientations // 2), len(deviation) - misplaced


def _accepted(
    tag_id: int,
    layout: TagLayout,
    magnets: _ObservedMagnets,
    margin: float,
    corrected: int,
    erased: int,
) -> DecodedTag:
    symbol_of = dict(zip(layout.cells, layout.symbols, strict=True))
    pairs = zip(magnets.cells, magnets.nearest, strict=True)
    symbols = tuple(symbol_of.get(cell, nearest) for cell, nearest in pairs)
    return DecodedTag(tag_id, margin, corrected, erased, symbols)


def _id_of(tags: Tags, cells: tuple[Cell, ...], symbols: Sequence[int]) -> int:
    """Return the id of magnets in any order."""
    pairs = sorted(zip(cells, symbols, strict=True), key=lambda pair: mosk.row_major_key(pair[0]))
    return codec.id_of(tags, TagLayout(tuple(c for c, _ in pairs), tuple(s for _, s in pairs)))


def _as_built_orientations(tags: Tags, ids: tuple[int, ...]) -> Array:
    """Return the orientations (n, K * K) in steps of tags as built; nan if a cell is empty."""
    rows = _members(tags, ids)
    has_magnet = rows != families.EMPTY_CELL
    orientations = np.where(has_magnet, rows, np.nan)
    # A row of the table has its magnets in the order of the layout. Angles are counter-clockwise,
    # orientations clockwise.
    angles = np.concatenate([np.asarray(tags.built[tag_id].angle_rad) for tag_id in ids])
    orientations[has_magnet] -= angles / tags.step_rad
    return orientations


def _members(tags: Tags, ids: tuple[int, ...]) -> NDArray[np.int16]:
    """Return :func:`families.symbol_table` of some ids, cached."""
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
def _indices(ids: tuple[int, ...]) -> dict[int, int]:
    """Return the index of each id."""
    return {tag_id: k for k, tag_id in enumerate(ids)}
