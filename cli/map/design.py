"""``locatk map design``: a floor of landmarks, or the tables of one landmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.map import landmark_text as map_landmark
from locatk.cli.map import proof_text as map_proof
from locatk.cli.map.options import Cells, Size, Walls, geometry_of, geometry_options, on_floor
from locatk.cli.options import number
from locatk.core.errors import InputError
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.landmarks.design.analysis import LandmarkAnalysis
    from locatk.core.landmarks.design.proof import MapProof
    from locatk.core.landmarks.landmark import Geometry
    from locatk.core.landmarks.map.floor import Cell, FloorMap, Wall


@click.command("design", short_help="Find a map in which every window is unique.")
@click.argument("size", metavar="[ROWSxCOLS]", type=Size(), required=False)
@options.output("Map to write (.toml).", required=False)
@click.option(
    "--window",
    type=click.Choice(("L", "I2", "I3", "2x2", "3x3")),
    default="L",
    show_default=True,
    help="After which landmarks a robot knows where it is: one ahead and one to the left, two or "
    "three in a row, or a square of four or nine.",
)
@click.option(
    "--alphabet",
    type=click.Choice(("6", "16", "compass")),
    default="16",
    show_default=True,
    help="What is read of a landmark: its pattern; pattern and orientation; or the same of the "
    "three patterns that tell the heading alone.",
)
@click.option(
    "--detect",
    type=click.IntRange(0, 8),
    default=0,
    show_default=True,
    metavar="N",
    help="So many misread landmarks of a window are always noticed.",
)
@number("--pitch", default=200.0, metavar="MM", help="Between two landmarks.")
@number("--seed", default=0, type=click.IntRange(0), metavar="N", help="Another one, another map.")
@click.option(
    "--forbid",
    type=Cells(),
    multiple=True,
    metavar="CELLS",
    help="Cells without a landmark: row,column from 0, with ranges, as in '2,3;4,0-5' "
    "(repeatable).",
)
@click.option(
    "--wall",
    type=Walls(),
    multiple=True,
    metavar="CELLS:CELLS",
    help="Between which neighbours no robot can go, as in '2,3:2,4' or '0-5,3:0-5,4' (repeatable).",
)
@click.option("--name", default="", metavar="TEXT", help="Of the map, for people.")
@click.option(
    "--landmark", is_flag=True, help="Write no map: print what a landmark of these bars is worth."
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
    overwrite: bool,
    as_json: bool,
    **bars: Any,
) -> None:
    """Find a floor of landmarks on which a robot knows its place after a few of them.

    Each window of the floor, read under any of four headings, is unique; the map is proved
    before it is written. Row 0 has the least y, column 0 the least x. A size that no map
    can have is refused with the bound. Small and tight floors take some seconds of search.

    With --landmark no map is made: the valleys of the six patterns, r1 and r2, the heights
    at which they can be told, the least pitch, the range of the hall sensors and tolerances
    are printed for the bars of the options. What will not work is a warning; the map is
    written all the same, and the exit status is 3.

    \b
    Examples:
      locatk map design 24x24 -o map.toml
      locatk map design 7x7 --alphabet 6 --pitch 250 -o small.toml
      locatk map design 60x100 --window 2x2 --forbid '10-20,40-45' -o hall.toml
      locatk map design 7x7 --detect 1 --wall '0-5,3:0-5,4' -o rooms.toml
      locatk map design --landmark
      locatk map design --landmark --bar 40x10x5 --sensor-height 5 --json
    """
    geometry, pitch_m = geometry_of(**bars), metres(pitch)
    if landmark:
        if size is not None or output is not None:
            raise click.UsageError("--landmark makes no map: leave ROWSxCOLS and -o out.")
        _landmark(geometry, pitch_m, as_json)
        return
    if size is None or output is None:
        raise click.UsageError("A map needs ROWSxCOLS and -o, as in 24x24 -o map.toml.")
    forbidden = [cell for cells in forbid for cell in cells]
    walls = [pair for pairs in wall for pair in pairs]
    on_floor(size, forbidden, "--forbid")
    on_floor(size, [cell for pair in walls for cell in pair], "--wall")
    options.guard_output(output, overwrite=overwrite)

    from locatk.core.landmarks.design.analysis import analyse_landmark
    from locatk.core.landmarks.design.generation import DesignOptions
    from locatk.core.landmarks.design.proof import prove_map
    from locatk.formats.artifacts.map_library import design
    from locatk.formats.artifacts.maps import write_map

    analysis = analyse_landmark(geometry)
    _check_pitch(geometry, pitch_m)
    wanted = DesignOptions(
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
    with _searching() as told:
        floor = replace(design(wanted, told), name=name)
    with console.working("Proving"):
        proof = prove_map(floor)
    if not proof.holds:
        raise InputError(
            f"the map that was found is wrong: {map_proof.verdict(proof)}",
            hint="please report it, with the command",
        )
    write_map(output, floor, overwrite=overwrite)
    _tell(output, floor, proof, analysis, as_json)


def _tell(
    output: Path, floor: FloorMap, proof: MapProof, analysis: LandmarkAnalysis, as_json: bool
) -> None:
    from locatk.core.landmarks.design.analysis import landmark_warnings, pitch_warnings
    from locatk.core.landmarks.design.materials import count_patterns

    found = count_patterns(floor)
    counts = ", ".join(f"{item.landmarks} {item.letters}" for item in found)
    bars = 4 * len(floor.cells())
    console.result(f"Wrote {output}\n")
    console.result(
        console.labelled(
            [
                *map_proof.floor_lines(floor),
                *map_proof.proof_lines(proof),
                ("Bars", f"{bars} of {map_landmark.bar(floor.geometry)}"),
                ("Patterns", counts),
                ("SHA-256", proof.fingerprint),
            ]
        )
    )
    said = [*landmark_warnings(analysis), *pitch_warnings(analysis, floor.pitch_m)]
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "map": map_proof.map_entry(floor),
                "patterns": {item.letters: item.landmarks for item in found},
                "proof": map_proof.proof_entry(proof, floor),
                "landmark": map_landmark.entry(analysis, floor.pitch_m),
                "warnings": said,
            }
        )
    for note in floor.notes:
        console.detail(f"{note[0].upper()}{note[1:]}.")
    failures.finish_with_warnings(said)


def _landmark(geometry: Geometry, pitch_m: float, as_json: bool) -> None:
    """The tables of one landmark."""
    from locatk.core.landmarks.design.analysis import (
        analyse_landmark,
        landmark_warnings,
        pitch_warnings,
    )

    found = analyse_landmark(geometry)
    _check_pitch(geometry, pitch_m)
    said = [*landmark_warnings(found), *pitch_warnings(found, pitch_m)]
    console.result(map_landmark.text(found, pitch_m))
    if as_json:
        console.emit_json({"version": 1, **map_landmark.entry(found, pitch_m), "warnings": said})
    failures.finish_with_warnings(said)


def _check_pitch(geometry: Geometry, pitch_m: float) -> None:
    least = 2 * geometry.radius_m + geometry.bar_width_m
    if not pitch_m >= least - 1e-9:
        raise InputError(
            f"bars of neighbouring landmarks overlap at a pitch of {1e3 * pitch_m:g} mm",
            hint=f"give at least {1e3 * least:g} mm",
        )


@contextmanager
def _searching() -> Iterator[Callable[[float, int], None]]:
    """What a search tells its progress, shown on a terminal."""
    with console.progress(range(100), "Searching") as bar:
        update = getattr(bar, "update", None)
        shown = 0

        def told(share: float, left: int) -> None:
            nonlocal shown
            if update is not None:
                update(int(100 * share) - shown)
                shown = int(100 * share)

        yield told
