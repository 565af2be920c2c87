"""``locatk map check``: proof that maps are unique."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.cli.map import proof_text
from locatk.cli.map.route_text import (
    RouteRequest,
    route_entry,
    route_explanation,
    route_options,
    route_table,
)
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.landmarks.design.final_poses import FinalPoses
    from locatk.core.landmarks.design.proof import MapProof
    from locatk.core.landmarks.design.routes import RouteCheck
    from locatk.core.landmarks.map.floor import FloorMap

ROUTE_CONDITIONS = "speed", "drift", "slip", "installation", "iron", "vehicle", "offline"
"""Options that have no effect without a route."""


MAX_NAMED_CELLS = 5
"""Cells that a warning names."""


@click.command(cls=Command)
@options.input_argument("maps", many=True)
@route_options
@options.overwrite
@options.as_json
@options.verbosity
def command(maps: tuple[Path, ...], overwrite: bool, as_json: bool, **route_values: Any) -> None:
    """Prove that every window of MAPS is unique, or list the duplicates; check routes over a map.

    The readings of all windows under all headings are compared. The output lists duplicates with
    both positions, the minimum number of landmarks in which two readings differ, the number of
    landmarks that a robot visits until it is localised, and until its poses are no longer
    provisional, and the effect of one fault. For a map as built (`locatk calibrate map`), the bars
    are compared as they were installed.

    With --route, the landmarks that a robot passes are predicted, and from where on it is
    localised without knowing its start. Its errors follow from the field of the bars, the noise of
    the sensors, the installation of the landmarks, and the odometry between them.

    The exit status is 0 if every map is unique and detects as many misread landmarks as its file
    specifies (`detect`), otherwise 1. It is 3 if a route is not localisable, or less accurate than
    --accuracy.

    \b
    Examples:
      locatk map check map.toml
      locatk map check floors/*.toml -q && echo unique
      locatk map check map.toml --json | jq '.maps[0].proof.duplicates'
      locatk map check map.toml --route drive.csv --accuracy 5 -o routes.png
    """
    request = RouteRequest(**route_values)
    if request.picture is not None and not request.route_paths:
        raise click.UsageError("--picture shows routes: give --route as well.")
    if request.accuracy is not None and not request.route_paths:
        raise click.UsageError("--accuracy is that of routes: give --route as well.")
    if not request.route_paths:
        context = click.get_current_context()
        for name in ROUTE_CONDITIONS:
            if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
                raise click.UsageError(f"--{name} is for routes: give --route as well.")
    if request.route_paths and len(maps) > 1:
        raise click.UsageError("--route needs one map.")
    if request.picture is not None:
        options.guard_output(
            request.picture, overwrite=overwrite, inputs=[*maps, *request.route_paths]
        )
    from locatk.core.landmarks.design.final_poses import count_landmarks_until_final
    from locatk.core.landmarks.design.proof import prove_map
    from locatk.core.landmarks.map.floor import as_built_codes
    from locatk.formats.artifacts.maps import read_map

    proved: list[tuple[Path, FloorMap, MapProof, FinalPoses]] = []
    floors = [(path, read_map(path)) for path in maps]
    # A bar of one step shows nothing.
    shown = console.working("Proving") if len(floors) == 1 else contextlib.nullcontext()
    with shown, console.progress(floors, "Proving") as bar:
        for path, floor in bar:
            built = replace(floor, codes=as_built_codes(floor))
            final = count_landmarks_until_final(built)
            proved.append((path, floor, prove_map(built), final))
    checks: tuple[RouteCheck, ...] = ()
    if request.route_paths:
        with console.working("Predicting"):
            checks = request.check(floors[0][1])
    for number, (path, floor, proof, final) in enumerate(proved):
        if number:
            console.result("")
        _print_proof(path, floor, proof, final)
    if checks:
        console.result(f"\n{route_table(checks)}")
        console.result(f"\n{route_explanation(is_offline=request.offline)}")
    if request.picture is not None:
        # matplotlib takes 0.5 s to import.
        from locatk.formats.plots.landmark_routes import write_routes_picture

        write_routes_picture(request.picture, floors[0][1], checks, overwrite=overwrite)
        console.say(f"Wrote {request.picture}")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "maps": [
                    {
                        "input": path,
                        "verdict": proof_text.verdict(proof),
                        "map": proof_text.map_entry(floor),
                        "proof": proof_text.proof_entry(proof, floor),
                        "landmarks_until_final": proof_text.final_entry(final),
                    }
                    for path, floor, proof, final in proved
                ],
                **({"routes": [route_entry(check) for check in checks]} if checks else {}),
            }
        )
    failed = [(path, proof) for path, _, proof, _ in proved if not proof.holds]
    if len(failed) == 1:
        path, proof = failed[0]
        raise InputError(proof_text.verdict(proof), file=path, hint=_hint(proof))
    if failed:
        raise InputError(
            f"{len(failed)} of {len(proved)} maps do not hold: "
            + ", ".join(str(path) for path, _ in failed)
        )
    for check in checks:
        for note in check.notes:
            console.warn(f"{note[0].upper()}{note[1:]}.")
    failures.finish_with_warnings([text for check in checks for text in check.warnings])


def _print_proof(path: Path, floor: FloorMap, proof: MapProof, final: FinalPoses) -> None:
    """Print the proof of one map, and warn of landmarks that differ from the design."""
    console.result(f"{path}: {proof_text.verdict(proof)}\n")
    console.result(
        console.labelled(
            [
                *proof_text.floor_lines(floor),
                *proof_text.proof_lines(proof),
                *proof_text.final_lines(final, floor),
            ]
        )
    )
    if proof.duplicates:
        console.result("\n" + proof_text.duplicates(proof, floor))
    if proof.readings:
        console.result("\n" + proof_text.faults(proof))
    console.result(f"\nSHA-256 {proof.fingerprint}")
    flagged = [cell for cell, built in sorted(floor.built.items()) if built.flags]
    if flagged:
        count = f"{len(flagged)} landmark" + "s" * (len(flagged) > 1)
        first = ", ".join(f"{row},{column}" for row, column in flagged[:MAX_NAMED_CELLS])
        more = " ..." if len(flagged) > MAX_NAMED_CELLS else ""
        console.warn(
            f"{count} of {path} not built as designed (at {first}{more}); the proof is of the "
            "floor as built."
        )


def _hint(proof: MapProof) -> str:
    if not proof.is_unique:
        return "Design the map again, or forbid a cell of each duplicate"
    return "Lower `detect` in the file, or design the map with --detect"
