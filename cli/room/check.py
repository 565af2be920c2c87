"""``locatk room check``: accuracy and coverage of a Lighthouse scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.cli.room.options import (
    changed_room,
    maps_option,
    reception_options,
    request_of,
    room_of,
    room_options,
)
from locatk.core.units import metres

ASSUMED_ROOM = (
    "the scene has no room, so that the rectangle around its stations is the working area; give "
    "--room"
)
"""Note on a scene without a room."""


@click.command(cls=Command)
@options.input_argument("scene_file")
@click.option(
    "--room",
    metavar="ROOM",
    help="Room, if SCENE_FILE has none: LxWxH in metres, or a file (.toml, .dxf, .svg).",
)
@click.option(
    "--accuracy",
    type=options.PositiveNumber(1e-3, 1e6),
    metavar="MM",
    help="Standard deviation that 95 % of the places must reach.",
)
@maps_option
@room_options
@reception_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    scene_file: Path,
    room: str | None,
    accuracy: float | None,
    maps: Path | None,
    overwrite: bool,
    as_json: bool,
    **more: Any,
) -> None:
    """Predict accuracy and coverage of the stations of SCENE_FILE (scene.toml).

    The output lists the worst places and the additional station that helps most. A scene that was
    solved has the errors of its stations; those of a designed scene are taken as solved.

    The exit status is 3 if places are not covered, or if --accuracy is not reached.

    \b
    Examples:
      locatk room check scene.toml
      locatk room check scene.toml --room 6x5x2.8 --volume 0-1500 --maps room.png
      locatk room check room.toml --accuracy 5 --json
    """
    from locatk.cli.room import room_text
    from locatk.core.errors import error_context
    from locatk.core.lighthouse.design import best_addition, check_room
    from locatk.core.lighthouse.design.report import assumed_room, deck_heading_sigma
    from locatk.formats.artifacts.scene import read_scene

    if maps is not None:
        options.guard_output(maps, overwrite=overwrite, inputs=[scene_file])
    device = more["device"]
    request_keys = ("seen", "facing", "range_mm", "field_of_view", "calibration", "device")
    request = request_of(
        stations=1, accuracy=accuracy, **{key: more.pop(key) for key in request_keys}
    )
    scene = read_scene(scene_file)
    with error_context(scene_file):
        if room is not None:
            used = room_of(room, **more)
        else:
            used = changed_room(scene.room or assumed_room(scene), **more)
        report = check_room(scene, used, request)
        heading = None
        if device == "deck":
            heading = deck_heading_sigma(scene, report, used, request)
        with console.working("Searching the best additional station"):
            addition = best_addition(scene, used, request)
    notes = report.notes
    if room is None and scene.room is None:
        notes = (ASSUMED_ROOM, *notes)
    warnings = list(report.warnings)
    if accuracy is not None and report.p95_sigma_m > metres(accuracy):
        warnings.append(
            f"{accuracy:g} mm are not reached: {room_text.mm(report.p95_sigma_m)} at 95 % of the "
            "places"
        )
    if maps is not None:
        from locatk.formats.plots.rooms import write_room_maps

        write_room_maps(maps, replace(scene, room=used), report, overwrite=overwrite)
        console.result(f"Wrote {maps}\n")
    lines = [
        *room_text.room_lines(used),
        room_text.reception_line(request),
        *room_text.report_lines(report, heading),
    ]
    points = [room_text.point_text(report, index) for index in report.worst_points]
    lines += [("worst places" if n == 0 else "", text) for n, text in enumerate(points)]
    lines.append(
        (
            "best addition",
            "none: no additional station improves the room"
            if addition is None
            else room_text.addition_text(addition),
        )
    )
    console.result(console.labelled(lines))
    rows = room_text.station_rows(scene.stations, [f"{n}" for n in report.station_points])
    header = [name if name != "mount" else "places seen" for name in room_text.STATION_HEADER]
    console.result("\n" + console.table(header, rows))
    for text in notes:
        console.result("\n" + console.wrapped(f"Note: {text}.", indent=0))
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "input": scene_file,
                "stations": room_text.station_entries(scene.stations, [None] * len(scene.stations)),
                "report": {**room_text.report_entry(report), "notes": notes},
                "heading_sigma_rad": heading,
                "best_addition": room_text.addition_entry(addition),
                "warnings": warnings,
            }
        )
    failures.finish_with_warnings(warnings)
