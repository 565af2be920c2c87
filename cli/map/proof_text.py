"""What ``locatk map design`` and ``map check`` tell of a map and its proof."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.landmarks.design.localization_steps import Start
    from locatk.core.landmarks.design.proof import FaultEffects, MapProof
    from locatk.core.landmarks.map.floor import Cell, FloorMap

SHOWN = 10
"""Duplicates that are printed; all that are listed are in --json."""

WINDOW_WORDS = {
    "L": "one ahead, then to the left",
    "I2": "two in a row",
    "I3": "three in a row",
    "2x2": "four round to the left",
    "3x3": "nine in a square",
}


def verdict(proof: MapProof) -> str:
    """In a few words: what is proved, or what fails."""
    if not proof.is_unique:
        count = proof.duplicate_count
        return (
            f"{count} of {proof.readings} readings {'repeats' if count == 1 else 'repeat'} another"
        )
    if not proof.holds:
        return (
            f"{_misread(proof.promised)} shall be noticed, but two readings differ in only "
            f"{_landmarks(proof.min_distance or 0)}"
        )
    if not proof.readings:
        return "unique, as it has no reading"
    return "unique" + (f", {_misread(proof.detects)} noticed" if proof.detects else "")


def floor_lines(floor: FloorMap) -> list[tuple[str, str]]:
    """The map itself: a name and what it is, line by line."""
    rows, columns = floor.shape
    cells = floor.cells()
    holes = rows * columns - len(cells)
    size = f"{floor.pitch_m * (rows - 1):.3g} x {floor.pitch_m * (columns - 1):.3g} m"
    facts = [
        f"{rows} x {columns} at {1e3 * floor.pitch_m:g} mm ({size})",
        _landmarks(len(cells)),
        *([_count(holes, "hole")] if holes else []),
        *([_count(len(floor.walls), "wall")] if floor.walls else []),
    ]
    read = {
        "6": "alphabet 6: the pattern alone is read",
        "16": "alphabet 16: pattern and orientation are read",
        "compass": "alphabet compass: one landmark tells the heading",
    }[floor.alphabet]
    return [
        ("Map", ", ".join(facts)),
        ("Window", f"{floor.window}, {WINDOW_WORDS[floor.window]}; {read}"),
    ]


def proof_lines(proof: MapProof) -> list[tuple[str, str]]:
    """What holds: a name and what it is, line by line."""
    share = f"{proof.readings / proof.words:.0%}".replace("%", " %") if proof.words else "-"
    different = (
        "each is unique" if proof.is_unique else f"{proof.duplicate_count} repeat an earlier one"
    )
    if not proof.readings:
        return [("Readings", "none: no window fits on the floor"), ("Localised", _steps(proof))]
    lines = [
        (
            "Readings",
            f"{proof.readings} under all headings, {share} of the {proof.words} there can be; "
            f"{different}",
        )
    ]
    if proof.min_distance is not None:
        noticed = (
            f"; {_misread(proof.detects)} always noticed"
            if proof.detects
            else "; one misread may pass for another place"
            if proof.is_unique
            else ""
        )
        lines.append(
            (
                "Distance",
                f"any two differ in at least {_landmarks(proof.min_distance)}{noticed}",
            )
        )
    lines.append(("Localised", _steps(proof)))
    return lines


def duplicates(proof: MapProof, floor: FloorMap) -> str:
    """The first duplicates, with both places."""
    table = console.table(
        ("reads", "at row,column", "heading", "and at", "heading"),
        (
            (
                read(one.letters, floor.alphabet),
                _cell(one.first[0]),
                _degrees(one.first[1]),
                _cell(one.second[0]),
                _degrees(one.second[1]),
            )
            for one in proof.duplicates[:SHOWN]
        ),
    )
    more = proof.duplicate_count - SHOWN
    return table + (f"\n... and {more} more" if more > 0 else "")


def faults(proof: MapProof) -> str:
    """What one fault breaks."""
    rows = [
        _fault("flipped bar", proof.flipped_bar, "reads as another place, unnoticed"),
        _fault("missing bar", proof.missing_bar, "may be of another place"),
        _fault("missing landmark", proof.missing_landmark, "may be of another place"),
    ]
    return console.table(
        ("one fault", "harmful", "cases", "the reading", "most at row,column"), rows
    )


def read(letters: tuple[int, ...], alphabet: str) -> str:
    """Letters of a reading, as bars."""
    from locatk.core.landmarks.landmark import PATTERNS, name

    return " ".join(PATTERNS[k - 1] if alphabet == "6" else name(k) for k in letters)


def map_entry(floor: FloorMap) -> dict[str, Any]:
    """The map for ``--json``."""
    rows, columns = floor.shape
    cells = floor.cells()
    return {
        "name": floor.name,
        "rows": rows,
        "columns": columns,
        "pitch_m": floor.pitch_m,
        "alphabet": floor.alphabet,
        "window": floor.window,
        "detect": floor.detect,
        "seed": floor.seed,
        "landmarks": len(cells),
        "holes": rows * columns - len(cells),
        "walls": sorted(floor.walls),
        "bars": 4 * len(cells),
        "notes": floor.notes,
    }


def proof_entry(proof: MapProof, floor: FloorMap) -> dict[str, Any]:
    """The proof for ``--json`` (docs/commands.md)."""
    steps = proof.localization
    return {
        "holds": proof.holds,
        "unique": proof.is_unique,
        "readings": proof.readings,
        "words": proof.words,
        "duplicate_count": proof.duplicate_count,
        "duplicates": [
            {
                "reads": read(one.letters, floor.alphabet).split(),
                "one": _place(one.first),
                "other": _place(one.second),
            }
            for one in proof.duplicates
        ],
        "least_distance": proof.min_distance,
        "detects": proof.detects,
        "promised": proof.promised,
        "flipped_bar": _fault_entry(proof.flipped_bar),
        "missing_bar": _fault_entry(proof.missing_bar),
        "missing_landmark": _fault_entry(proof.missing_landmark),
        "landmarks_to_localise": steps
        and {
            "mean": steps.mean,
            "p99": steps.p99,
            "worst": steps.worst,
            "worst_starts": [_place(place) for place in steps.worst_starts],
            "never": steps.never,
            "never_starts": [_place(place) for place in steps.never_starts],
        },
        "sha256": proof.fingerprint,
    }


def _steps(proof: MapProof) -> str:
    steps = proof.localization
    if steps is None or steps.mean is None or steps.p99 is None or steps.worst is None:
        return "never: no start can be told from all others"
    text = f"after {steps.mean:.2g} visited in the mean, {steps.p99:.0f} for 99 % of starts, "
    text += f"{steps.worst} at worst"
    if steps.worst_starts:
        (cell, heading), *_ = steps.worst_starts
        text += f" (from {_cell(cell)} at {_degrees(heading)} deg)"
    if steps.never:
        (cell, heading), *_ = steps.never_starts
        text += (
            f";\n{'':11}never from {_count(steps.never, 'start')} (as from {_cell(cell)} at "
            f"{_degrees(heading)} deg)"
        )
    return text


def _fault(name: str, fault: FaultEffects, what: str) -> tuple[str, ...]:
    return (
        name,
        f"{100 * fault.harmful_fraction:.3g} %",
        str(fault.cases),
        what if fault.harmful else "none: always noticed or right",
        "  ".join(_cell(cell) for cell in fault.worst[:3]) or "-",
    )


def _fault_entry(fault: FaultEffects) -> dict[str, Any]:
    return {
        "cases": fault.cases,
        "harmful": fault.harmful,
        "share": fault.harmful_fraction,
        "worst_cells": fault.worst,
        "by_cell": fault.by_cell,
    }


def _place(place: Start) -> dict[str, Any]:
    (row, column), heading = place
    return {"row": row, "column": column, "heading_deg": 90 * heading}


def _cell(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def _degrees(quarters: int) -> str:
    return str(90 * quarters)


def _landmarks(count: int) -> str:
    return _count(count, "landmark")


def _misread(count: int) -> str:
    return f"{count} misread {'landmark' if count == 1 else 'landmarks'}"


def _count(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
