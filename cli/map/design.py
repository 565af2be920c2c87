"""``locatk map design``: a floor of landmarks, or the analysis of one landmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.cli.map import landmark_text, proof_text
from locatk.cli.map.options import Cells, Size, Walls, check_cells, geometry_of, geometry_options
from locatk.cli.options import number
from locatk.cli.route_options import LengthAndAngle
from locatk.core.errors import InputError
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.landmarks.design.analysis import LandmarkAnalysis
    from locatk.core.landmarks.design.proof import MapProof
    from locatk.core.landmarks.landmark import Geometry
    from locatk.core.landmarks.map.floor import Cell, FloorMap, Wall

OVERLAP_TOLERANCE_M = 1e-9
"""Bars may touch."""


@click.command(cls=Command)
@click.argument("size", metavar="[ROWSxCOLS]", type=Size(), required=False)
@options.output("Map to write (.toml).", required=False, endings=(".toml",))
@click.option("--name", default="", metavar="TEXT", help="Descriptive name of the map.")
@click.option(
    "--landmark",
    is_flag=True,
    help="Print the analysis of one landmark instead of designing a map.",
)
@click.option(
    "--search",
    type=LengthAndAngle(),
    metavar="MM[,DEG]",
    help="With --landmark: list the common bars, and heights of the sensors, with which errors of "
    "position (and heading) do not exceed this with 95 % at the --pitch.",
)
@section(
    "Map",
    click.option(
        "--window",
        type=click.Choice(("L", "I2", "I3", "2x2", "3x3")),
        default="L",
        show_default=True,
        help="Landmarks that determine the position of a robot: one ahead and one to the left "
        "(L), two or three in a row (I2, I3), or a square of four or nine (2x2, 3x3).",
    ),
    click.option(
        "--alphabet",
        type=click.Choice(("6", "16", "compass")),
        default="16",
        show_default=True,
        help="Properties that a robot reads of a landmark: `6` its pattern, `16` pattern and "
        "orientation, `compass` both, with only the three patterns that determine the "
        "heading.",
    ),
    click.option(
        "--detect",
        type=click.IntRange(0, 8),
        default=0,
        show_default=True,
        metavar="N",
        help="Number of misread landmarks in a window that are always detected.",
    ),
    number("--pitch", default=200.0, metavar="MM", help="Distance between neighbouring landmarks."),
    number(
        "--seed",
        default=0,
        type=click.IntRange(0),
        metavar="N",
        help="Seed of the search; another seed gives another map.",
    ),
    click.option(
        "--forbid",
        type=Cells(),
        multiple=True,
        metavar="CELLS",
        help="Cells without a landmark: row,column from 0, with ranges, as in '2,3;4,0-5'. "
        "Repeatable.",
    ),
    click.option(
        "--wall",
        type=Walls(),
        multiple=True,
        metavar="CELLS:CELLS",
        help="Neighbouring cells between which a robot cannot drive, as in '2,3:2,4' or "
        "'0-5,3:0-5,4'. Repeatable.",
    ),
)
@geometry_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    size: tuple[int, int] | None,
    output: Path | None,
    window: str,
    alphabet: str,
    detect: int,
    pitch: float,
    seed: int,
    forbid: tuple[tuple[Cell, ...], ...],
    wall: tuple[tuple[Wall, ...], ...],
    name: str,
    landmark: bool,
    search: tuple[float, float | None] | None,
    overwrite: bool,
    as_json: bool,
    **bars: Any,
) -> None:
    """Design a map on which a few neighbouring landmarks determine the position of a robot.

    Every window of landmarks is unique under all four headings; this is verified before the map is
    written. Row 0 has the smallest y, column 0 the smallest x. If no map of the size can exist, the
    error gives the bound. For small maps close to the bound, the search takes some seconds.

    With --landmark, no map is designed. The output is an analysis of one landmark with the given
    bars: the valleys of the six patterns, the radii r1 and r2, the heights at which patterns are
    distinguishable, the minimum pitch, the range of the hall sensors, and tolerances. If a
    requirement is not met, a warning gives a remedy; a map is written nevertheless, and the exit
    status is 3.

    \b
    Examples:
      locatk map design 24x24 -o map.toml
      locatk map design 7x7 --alphabet 6 --pitch 250 -o small.toml
      locatk map design 60x100 --window 2x2 --forbid '10-20,40-45' -o hall.toml
      locatk map design 7x7 --detect 1 --wall '0-5,3:0-5,4' -o rooms.toml
      locatk map design --landmark
      locatk map design --landmark --bar 40x10x5 --sensor-height 5 --json
      locatk map design --landmark --search 8,2 --pitch 250
    """
    geometry, pitch_m = geometry_of(**bars), metres(pitch)
    if landmark:
        if size is not None or output is not None:
            raise click.UsageError("--landmark makes no map: omit ROWSxCOLS and -o.")
        if search is not None:
            _print_search(geometry, pitch_m, search, as_json)
            return
        _print_landmark(geometry, pitch_m, as_json)
        return
    if search is not None:
        raise click.UsageError("--search is of landmarks: give --landmark as well.")
    if size is None or output is None:
        raise click.UsageError("A map needs ROWSxCOLS and -o, as in 24x24 -o map.toml.")
    forbidden = [cell for cells in forbid for cell in cells]
    walls = [pair for pairs in wall for pair in pairs]
    check_cells(size, forbidden, "--forbid")
    check_cells(size, [cell for pair in walls for cell in pair], "--wall")
    options.guard_output(output, overwrite=overwrite)

    from locatk.core.landmarks.design.analysis import analyse_landmark
    from locatk.core.landmarks.design.generation import DesignOptions
    from locatk.core.landmarks.design.proof import prove_map
    from locatk.formats.artifacts.map_library import design_or_crop
    from locatk.formats.artifacts.maps import write_map

    analysis = analyse_landmark(geometry)
    _check_pitch(geometry, pitch_m)
    request = DesignOptions(
        rows=size[0],
        columns=size[1],
        window=window,
        alphabet=alphabet,
        pitch_m=pitch_m,
        seed=seed,
        forbidden=frozenset(forbidden),
        walls=frozenset(walls),
        detect=detect,
        geometry=geometry,
    )
    with _search_progress() as report:
        floor = replace(design_or_crop(request, report), name=name)
    with console.working("Proving"):
        proof = prove_map(floor)
    if not proof.holds:
        raise InputError(
            f"the map of the search is not valid: {proof_text.verdict(proof)}",
            hint="Please report the command as an error of locatk",
        )
    write_map(output, floor, overwrite=overwrite)
    _print_map(output, floor, proof, analysis, as_json)


def _print_map(
    output: Path, floor: FloorMap, proof: MapProof, analysis: LandmarkAnalysis, as_json: bool
) -> None:
    from locatk.core.landmarks.design.analysis import landmark_warnings, pitch_warnings
    from locatk.core.landmarks.design.final_poses import count_landmarks_until_final
    from locatk.core.landmarks.design.materials import count_patterns

    final = count_landmarks_until_final(floor)
    patterns = count_patterns(floor)
    counts = ", ".join(f"{item.landmarks} {item.letters}" for item in patterns)
    bars = 4 * len(floor.cells())
    console.result(f"Wrote {output}\n")
    console.result(
        console.labelled(
            [
                *proof_text.floor_lines(floor),
                *proof_text.proof_lines(proof),
                *proof_text.final_lines(final, floor),
                ("Bars", f"{bars} of {landmark_text.bar(floor.geometry)}"),
                ("Patterns", counts),
                ("SHA-256", proof.fingerprint),
            ]
        )
    )
    warnings = [*landmark_warnings(analysis), *pitch_warnings(analysis, floor.pitch_m)]
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "map": proof_text.map_entry(floor),
                "patterns": {item.letters: item.landmarks for item in patterns},
                "proof": proof_text.proof_entry(proof, floor),
                "landmarks_until_final": proof_text.final_entry(final),
                "landmark": landmark_text.entry(analysis, floor.pitch_m),
                "warnings": warnings,
            }
        )
    for note in floor.notes:
        console.detail(f"{note[0].upper()}{note[1:]}.")
    failures.finish_with_warnings(warnings)


def _print_landmark(geometry: Geometry, pitch_m: float, as_json: bool) -> None:
    """Print the analysis of one landmark, and finish with its warnings."""
    from locatk.core.landmarks.design.analysis import (
        analyse_landmark,
        landmark_warnings,
        pitch_warnings,
    )

    analysis = analyse_landmark(geometry)
    _check_pitch(geometry, pitch_m)
    warnings = [*landmark_warnings(analysis), *pitch_warnings(analysis, pitch_m)]
    console.result(landmark_text.text(analysis, pitch_m))
    if as_json:
        console.emit_json(
            {"version": 1, **landmark_text.entry(analysis, pitch_m), "warnings": warnings}
        )
    failures.finish_with_warnings(warnings)


def _print_search(
    geometry: Geometry, pitch_m: float, wanted: tuple[float, float | None], as_json: bool
) -> None:
    """Print the bars and heights that suffice; the exit status is 3 if none do."""
    from locatk.core.landmarks.design.bar_search import BARS_M, HEIGHTS_M, search_bars

    with console.steps(len(BARS_M), "Searching") as step:
        options = search_bars(
            pitch_m,
            *wanted,
            remanence_t=geometry.remanence_t,
            circle_m=geometry.circle_m,
            bars_m=BARS_M,
            heights_m=HEIGHTS_M,
            progress=step,
        )
    warnings = landmark_text.search_warnings(options, pitch_m, wanted)
    console.result(landmark_text.search_table(options))
    if as_json:
        entries = [landmark_text.search_entry(option) for option in options]
        console.emit_json({"version": 1, "pitch_m": pitch_m, "bars": entries, "warnings": warnings})
    failures.finish_with_warnings(warnings)


def _check_pitch(geometry: Geometry, pitch_m: float) -> None:
    min_pitch_m = 2 * geometry.radius_m + geometry.bar_width_m
    if not pitch_m >= min_pitch_m - OVERLAP_TOLERANCE_M:
        raise InputError(
            f"bars of neighbouring landmarks overlap at a pitch of {1e3 * pitch_m:g} mm",
            hint=f"Give at least {1e3 * min_pitch_m:g} mm",
        )


@contextmanager
def _search_progress() -> Iterator[Callable[[float, int], None]]:
    """Yield the function to which a search reports its progress, with a bar on a terminal."""
    with console.progress(range(100), "Searching") as bar:
        update = getattr(bar, "update", None)
        shown = 0

        def report(fraction: float, remaining: int) -> None:
            nonlocal shown
            if update is not None:
                update(int(100 * fraction) - shown)
                shown = int(100 * fraction)

        yield report
