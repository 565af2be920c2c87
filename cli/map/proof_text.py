"""Text and JSON of a map and its proof, by ``locatk map design`` and ``map check``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.landmarks.design.final_poses import FinalPoses
    from locatk.core.landmarks.design.localization_steps import Start
    from locatk.core.landmarks.design.proof import FaultEffects, MapProof
    from locatk.core.landmarks.map.floor import Cell, FloorMap

MAX_PRINTED_DUPLICATES = 10
"""Duplicates that are printed; --json has all that the proof lists."""

WINDOW_DESCRIPTIONS = {
    "L": "one ahead, then to the left",
    "I2": "two in a row",
    "I3": "three in a row",
    "2x2": "four in a square, to the left",
    "3x3": "nine in a square",
}

ALPHABET_DESCRIPTIONS = {
    "6": "only the pattern is read",
    "16": "pattern and orientation are read",
    "compass": "one landmark determines the heading",
}


def verdict(proof: MapProof) -> str:
    """Summarise a proof in a few words."""
    if not proof.is_unique:
        count = proof.duplicate_count
        return (
            f"{count} of {proof.readings} readings {'repeats' if count == 1 else 'repeat'} another"
        )
    if not proof.holds:
        return (
            f"{_misread(proof.promised)} should be detected, but two readings differ in only "
            f"{_landmarks(proof.min_distance or 0)}"
        )
    if not proof.readings:
        return "unique: it has no reading"
    return "unique" + (f", {_misread(proof.detects)} detected" if proof.detects else "")


def floor_lines(floor: FloorMap) -> list[tuple[str, str]]:
    """Return label and text of each line about the map."""
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
    return [
        ("Map", ", ".join(facts)),
        ("Window", f"{floor.window}: {WINDOW_DESCRIPTIONS[floor.window]}"),
        ("Alphabet", f"{floor.alphabet}: {ALPHABET_DESCRIPTIONS[floor.alphabet]}"),
    ]


def proof_lines(proof: MapProof) -> list[tuple[str, str]]:
    """Return label and text of each line about the proof."""
    fraction = f"{proof.readings / proof.words:.0%}".replace("%", " %") if proof.words else "-"
    different = (
        "each is unique" if proof.is_unique else f"{proof.duplicate_count} repeat an earlier one"
    )
    if not proof.readings:
        return [("Readings", "none: no window fits on the floor"), *_localization_lines(proof)]
    lines = [
        (
            "Readings",
            f"{proof.readings} under all headings, {fraction} of {proof.words} possible ones; "
            f"{different}",
        )
    ]
    if proof.min_distance is not None:
        lines.append(("Distance", f"any two differ in at least {_landmarks(proof.min_distance)}"))
        if proof.detects:
            lines.append(("Detection", f"{_misread(proof.detects)} always detected"))
        elif proof.is_unique:
            lines.append(("Detection", "one misread landmark may give a wrong position"))
    return [*lines, *_localization_lines(proof)]


def final_lines(final: FinalPoses, floor: FloorMap) -> list[tuple[str, str]]:
    """Return label and text of the lines about the landmarks until poses are final."""
    if final.mean is None or final.p99 is None:
        return [
            ("Final", "never: poses remain provisional, because other floors or starts fit as well")
        ]
    is_sampled = final.starts < 4 * len(floor.cells())
    tested = f" of {_count(final.starts, 'tested start')}" if is_sampled else ""
    never = f", never from {_count(final.never, 'start')}" if final.never else ""
    return [
        (
            "Final",
            f"after {final.mean:.2g} landmarks on average, {final.p99:.0f} for 99 % of starts, "
            f"{final.worst} at most{tested}{never}; until then, poses are provisional",
        )
    ]


def duplicates(proof: MapProof, floor: FloorMap) -> str:
    """Format the first duplicates, with both positions."""
    table = console.table(
        ("reads", "at row,column", "heading", "and at", "heading"),
        (
            (
                reading_text(duplicate.letters, floor.alphabet),
                _cell(duplicate.first[0]),
                _degrees(duplicate.first[1]),
                _cell(duplicate.second[0]),
                _degrees(duplicate.second[1]),
            )
            for duplicate in proof.duplicates[:MAX_PRINTED_DUPLICATES]
        ),
    )
    more = proof.duplicate_count - MAX_PRINTED_DUPLICATES
    return table + (f"\n... and {more} more" if more > 0 else "")


def faults(proof: MapProof) -> str:
    """Format the effects of one fault."""
    rows = [
        _fault("flipped bar", proof.flipped_bar, "undetected, another position"),
        _fault("missing bar", proof.missing_bar, "may be of another position"),
        _fault("missing landmark", proof.missing_landmark, "may be of another position"),
    ]
    return console.table(("one fault", "harmful", "cases", "the reading", "worst at"), rows)


def reading_text(letters: tuple[int, ...], alphabet: str) -> str:
    """Return the bars of each landmark of a reading."""
    from locatk.core.landmarks.landmark import PATTERNS, name

    return " ".join(PATTERNS[k - 1] if alphabet == "6" else name(k) for k in letters)


def map_entry(floor: FloorMap) -> dict[str, Any]:
    """Return the map for ``--json``."""
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
    """Return the proof for ``--json`` (docs/formats.md)."""
    steps = proof.localization
    return {
        "holds": proof.holds,
        "unique": proof.is_unique,
        "readings": proof.readings,
        "words": proof.words,
        "duplicate_count": proof.duplicate_count,
        "duplicates": [
            {
                "reads": reading_text(duplicate.letters, floor.alphabet).split(),
                "one": _start_entry(duplicate.first),
                "other": _start_entry(duplicate.second),
            }
            for duplicate in proof.duplicates
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
            "worst_starts": [_start_entry(start) for start in steps.worst_starts],
            "never": steps.never,
            "never_starts": [_start_entry(start) for start in steps.never_starts],
        },
        "sha256": proof.fingerprint,
    }


def final_entry(final: FinalPoses) -> dict[str, Any]:
    """Return the landmarks until poses are final for ``--json``."""
    return {
        "starts": final.starts,
        "mean": final.mean,
        "p99": final.p99,
        "worst": final.worst,
        "worst_start": None if final.worst_start is None else _start_entry(final.worst_start),
        "never": final.never,
    }


def _localization_lines(proof: MapProof) -> list[tuple[str, str]]:
    """Return label and text of the lines about the landmarks until a robot is localised."""
    steps = proof.localization
    if steps is None or steps.mean is None or steps.p99 is None or steps.worst is None:
        return [("Localised", "never: no start differs from all others")]
    lines = [
        (
            "Localised",
            f"after {steps.mean:.2g} landmarks on average, {steps.p99:.0f} for 99 % of starts, "
            f"{steps.worst} at most",
        )
    ]
    if steps.worst_starts:
        lines.append(("Slowest", f"from {_start(steps.worst_starts[0])}"))
    if steps.never:
        count = _count(steps.never, "start")
        lines.append(("Never", f"from {count}, as from {_start(steps.never_starts[0])}"))
    return lines


def _start(start: Start) -> str:
    cell, heading = start
    return f"{_cell(cell)} at {_degrees(heading)} deg"


def _fault(name: str, fault: FaultEffects, effect: str) -> tuple[str, ...]:
    return (
        name,
        f"{100 * fault.harmful_fraction:.3g} %",
        str(fault.cases),
        effect if fault.harmful else "none: detected or right",
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


def _start_entry(start: Start) -> dict[str, Any]:
    (row, column), heading = start
    return {"row": row, "column": column, "heading_deg": 90 * heading}


def _cell(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def _degrees(quarters: int) -> str:
    return str(90 * quarters)


def _landmarks(count: int) -> str:
    return _count(count, "landmark")


def _misread(count: int) -> str:
    return f"{count} misread {'landmark' if count == 1 else 'landmarks'}"


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
