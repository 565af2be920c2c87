"""``locatk map check``: the proof of maps, for people and for scripts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from locatk.cli import console, options
from locatk.cli.map import proof_text as map_proof
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.landmarks.design.proof import MapProof
    from locatk.core.landmarks.map.floor import FloorMap


@click.command("check", short_help="Prove that a map is unique, or show where not.")
@options.input_argument("maps", many=True)
@options.as_json
@options.verbosity
def command(maps: tuple[Path, ...], as_json: bool) -> None:
    """Prove that a robot can tell where it is on MAPS, or show where it cannot.

    Every window under every heading is read and compared: duplicates with both places, how
    many landmarks any two readings differ in, how many a robot must visit until it knows its
    place, and what one fault breaks. Of a map as built (`locatk calibrate map`) the bars count
    as they lie.

    For scripts: the exit status is 0 where each map is unique and notices as many misread
    landmarks as its file promises (`detect`), and 1 where one does not or cannot be read.

    \b
    Examples:
      locatk map check map.toml
      locatk map check floors/*.toml -q && echo good
      locatk map check map.toml --json | jq '.maps[0].proof.duplicates'
    """
    from locatk.core.landmarks.design.proof import prove_map
    from locatk.core.landmarks.map.floor import as_built_codes
    from locatk.formats.artifacts.maps import read_map

    proved: list[tuple[Path, FloorMap, MapProof]] = []
    floors = [(path, read_map(path)) for path in maps]
    with console.progress(floors, "Proving") as bar:
        for path, floor in bar:
            proved.append((path, floor, prove_map(replace(floor, codes=as_built_codes(floor)))))
    for number, (path, floor, proof) in enumerate(proved):
        if number:
            console.result("")
        _tell(path, floor, proof)
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "maps": [
                    {
                        "input": path,
                        "verdict": map_proof.verdict(proof),
                        "map": map_proof.map_entry(floor),
                        "proof": map_proof.proof_entry(proof, floor),
                    }
                    for path, floor, proof in proved
                ],
            }
        )
    wrong = [(path, proof) for path, _, proof in proved if not proof.holds]
    if len(wrong) == 1:
        path, proof = wrong[0]
        raise InputError(map_proof.verdict(proof), file=path, hint=_hint(proof))
    if wrong:
        raise InputError(
            f"{len(wrong)} of {len(proved)} maps do not hold: "
            + ", ".join(str(path) for path, _ in wrong)
        )


def _tell(path: Path, floor: FloorMap, proof: MapProof) -> None:
    """The proof of one map."""
    console.result(f"{path}: {map_proof.verdict(proof)}\n")
    console.result(console.labelled([*map_proof.floor_lines(floor), *map_proof.proof_lines(proof)]))
    if proof.duplicates:
        console.result("\n" + map_proof.duplicates(proof, floor))
    if proof.readings:
        console.result("\n" + map_proof.faults(proof))
    console.result(f"\nSHA-256 {proof.fingerprint}")
    flagged = [cell for cell, built in sorted(floor.built.items()) if built.flags]
    if flagged:
        count = f"{len(flagged)} landmark" + "s" * (len(flagged) > 1)
        first = ", ".join(f"{row},{column}" for row, column in flagged[:5])
        more = " ..." if len(flagged) > 5 else ""
        console.warn(
            f"{count} of {path} not built as designed (at {first}{more}); the proof is of how "
            "they lie."
        )


def _hint(proof: MapProof) -> str:
    if not proof.is_unique:
        return "design the map again, or forbid a cell of each duplicate"
    return "lower `detect` in the file, or design the map with --detect"
