"""Changes of the options of a map that does not exist, or that a search did not find."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from locatk.core.landmarks.design.bounds import count_competing_readings
from locatk.core.landmarks.design.generation import DesignOptions, empty_floor
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell
from locatk.core.landmarks.map.windows import WINDOW_PATHS, passable_steps, place_windows

REACHED_USAGE = {
    ("16", "L", 0): 0.52, ("16", "L", 1): 0.56, ("6", "L", 0): 0.66, ("6", "L", 1): 0.44,
    ("compass", "L", 0): 0.88, ("compass", "L", 1): 0.44,
    ("16", "I2", 0): 0.93, ("compass", "I2", 0): 0.66,
    ("16", "I3", 0): 0.76, ("16", "I3", 1): 0.54, ("6", "I3", 0): 0.75, ("6", "I3", 1): 0.33,
    ("compass", "I3", 0): 0.88,
    ("16", "2x2", 0): 0.86, ("16", "2x2", 1): 0.43, ("6", "2x2", 0): 0.79, ("6", "2x2", 1): 0.46,
    ("compass", "2x2", 0): 0.51,
    ("16", "3x3", 0): 1e-5,
}  # fmt: skip
"""Usage (:func:`word_usage`) up to which a search finds a map, by alphabet, window and detection.

The largest usage at which both of two seeds (101 and 102) succeeded, on floors of 1:1 and of 1:5,
with the default budget. For 2x2 (except 16 without detection) and 3x3 it is that of squares known
before. Requirements that are not listed were not measured. All were verified on floors of 2:3 with
the seed 7.
"""

WINDOWS_BY_LANDMARKS = tuple(sorted(WINDOW_PATHS, key=lambda window: len(WINDOW_PATHS[window])))
"""Windows in order of the number of landmarks that a robot visits."""


def word_usage(options: DesignOptions) -> float:
    """Return the readings of a floor as a fraction of those that can be different.

    It is 0 if no window fits on the floor.
    """
    blank = empty_floor(options)
    cells, heading = place_windows(blank.codes != HOLE_CODE, passable_steps(blank), options.window)
    count, bound = count_competing_readings(
        cells, heading, alphabet=options.alphabet, window=options.window, detect=options.detect
    )
    return count / bound


@dataclass(frozen=True)
class DesignAdvisor:
    """Search for the smallest changes of options with which a map is found.

    Attributes
    ----------
    options : DesignOptions
        Valid options.
    is_known : function
        Return True for options of which a map is known without a search.
    """

    options: DesignOptions
    is_known: Callable[[DesignOptions], bool]

    def iter_changes(self) -> Iterator[str]:
        """Yield changes as options of ``locatk map design``; each of them is sufficient.

        A change replaces the same option, and never repeats the value that is set.
        """
        options = self.options
        if self._is_found(options):
            yield f"--seed {options.seed + 1}"
        landmarks = len(WINDOW_PATHS[options.window])
        alphabets = [alphabet for alphabet in ("16",) if alphabet != options.alphabet]
        windows = [
            window
            for window in WINDOWS_BY_LANDMARKS
            if len(WINDOW_PATHS[window]) >= landmarks and window != options.window
        ]
        detections = list(reversed(range(options.detect)))
        kinds: dict[str, Sequence[object]] = {
            "alphabet": alphabets,
            "window": windows,
            "detect": detections,
        }
        changes = [
            change
            for kind, values in kinds.items()
            if (change := self._first_found({kind: value} for value in values))
        ]
        if not changes:
            several = itertools.product(
                *([{}, *({kind: value} for value in values)] for kind, values in kinds.items())
            )
            change = self._first_found({**a, **b, **c} for a, b, c in several)
            changes = [change] if change else []
        for change in changes:
            yield " ".join(f"--{name} {value}" for name, value in change.items())
        if size := self._largest_size():
            yield f"a floor of {size[0]}x{size[1]}"

    def _first_found(self, changes: Iterable[dict[str, Any]]) -> dict[str, Any] | None:
        found = (c for c in changes if c and self._is_found(replace(self.options, **c)))
        return next(found, None)

    def _is_found(self, options: DesignOptions) -> bool:
        return word_usage(options) > 0 and self._is_reached(options)

    def _is_reached(self, options: DesignOptions) -> bool:
        limit = REACHED_USAGE.get((options.alphabet, options.window, options.detect), 0.0)
        return self.is_known(options) or word_usage(options) <= limit

    def _largest_size(self) -> tuple[int, int] | None:
        """Return the size for which the longer side has to be reduced least often."""
        size = [self.options.rows, self.options.columns]
        sizes = []
        while min(size) > 1:
            size[size[0] < size[1]] -= 1
            sizes.append((size[0], size[1]))
        index = bisect.bisect_left(
            sizes, True, key=lambda size: self._is_reached(_part(self.options, *size))
        )
        fitting = sizes[index : index + 1]
        return next((s for s in fitting if word_usage(_part(self.options, *s)) > 0), None)


def _part(options: DesignOptions, rows: int, columns: int) -> DesignOptions:
    """Return the options of the first rows and columns of a floor."""

    def is_inside(cell: Cell) -> bool:
        return cell[0] < rows and cell[1] < columns

    return replace(
        options,
        rows=rows,
        columns=columns,
        forbidden=frozenset(filter(is_inside, options.forbidden)),
        walls=frozenset(wall for wall in options.walls if all(map(is_inside, wall))),
    )
