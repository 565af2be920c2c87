"""``locatk room design``: positions and directions of Lighthouse stations in a room."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.cli.materials_text import materials_text
from locatk.cli.price_options import price_options
from locatk.cli.room.options import (
    TRIPOD,
    maps_option,
    parse_mounts,
    reception_options,
    request_of,
    room_of,
    room_options,
)

if TYPE_CHECKING:
    from locatk.core.lighthouse.design import RoomDesign, RoomRequest
    from locatk.core.lighthouse.room import Room
    from locatk.core.materials import BillItem


@click.command(cls=Command)
@click.argument("room", metavar="ROOM")
@options.output("Room to write, a scene (.toml).", endings=(".toml",))
@section(
    "Stations",
    click.option(
        "--stations",
        type=click.IntRange(1, 16),
        metavar="N",
        help="Number of stations.  [default: 4, or as many as --accuracy takes]",
    ),
    click.option(
        "--accuracy",
        type=options.PositiveNumber(1e-3, 1e6),
        metavar="MM",
        help="Largest standard deviation of positions at 95 % of the places.",
    ),
    click.option(
        "--criterion",
        type=click.Choice(("worst", "mean")),
        default="worst",
        show_default=True,
        help="Minimise the standard deviation at the worst places (95th percentile), or the mean.",
    ),
    click.option(
        "--mount",
        "mounts",
        callback=parse_mounts,
        metavar="KIND,...",
        help="Kinds of mounts: wall, ceiling, tripod.  [default: wall,ceiling]",
    ),
    click.option(
        "--tripod",
        "tripods",
        type=TRIPOD,
        multiple=True,
        metavar="X,Y,Z",
        help="Position of a station on a tripod in mm that may be used. Repeatable.",
    ),
)
@room_options
@reception_options
@section(
    "Drawings",
    maps_option,
    options.output_option(
        "--sheet",
        help="Mounting sheet to write: plan, drilling list and tilt gauge.",
        endings=(".pdf",),
    ),
    click.option(
        "--paper",
        "paper_name",
        default="A4",
        show_default=True,
        metavar="PAPER",
        help="Paper of the mounting sheet: A0 to A5, Letter, Tabloid, or a size as in 600x900mm.",
    ),
)
@section(
    "Costs",
    options.output_option(
        "--bom", endings=(".csv",), metavar="FILE", help="Also write the bill of materials (.csv)."
    ),
    price_options,
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    room: str,
    output: Path,
    stations: int | None,
    accuracy: float | None,
    criterion: str,
    mounts: tuple[str, ...] | None,
    tripods: tuple[tuple[float, ...], ...],
    maps: Path | None,
    sheet: Path | None,
    paper_name: str,
    bom: Path | None,
    prices: Path | None,
    overwrite: bool,
    as_json: bool,
    **more: Any,
) -> None:
    """Place Lighthouse base stations in ROOM, and write them as a scene to OUTPUT.

    ROOM is length x width x height in metres, a scene with a table [room] (.toml), or a floor plan
    (.dxf, .svg). Places without enough stations are avoided first, then the standard deviation of
    positions (sigma) is minimised. It contains the noise of the angles, and the errors that the
    calibrations leave in a scene that is solved from a recording in the room. The frame of the
    scene adds its own.

    OUTPUT is the --artifact of `locatk simulate lighthouse`, `locatk solve` and `locatk live`. If a
    wish cannot be fulfilled, the best room is written with a warning, and the exit status is 3.

    \b
    Examples:
      locatk room design 10x10x3 --stations 4 --volume 0-1500 -o room.toml
      locatk room design 6x5x2.8 --floor 80 --accuracy 2 --mount wall -o room.toml
      locatk room design 4x3x2.5 --robots 20 --robot-size 60x80 -o room.toml
      locatk room design lab.dxf --height 2800 -o room.toml --sheet room.pdf
    """
    from locatk.core.lighthouse.design import bill_of_materials, design_room
    from locatk.core.materials import with_prices
    from locatk.formats.artifacts.prices import read_prices
    from locatk.formats.artifacts.scene import write_scene
    from locatk.formats.exporters.bill_of_materials import write_bill
    from locatk.formats.output import atomic_write

    inputs = [Path(room)] if prices is None else [Path(room), prices]
    for path in (output, maps, sheet, bom):
        if path is not None:
            options.guard_output(path, overwrite=overwrite, inputs=inputs)
    if maps is not None and sheet is not None and maps.resolve() == sheet.resolve():
        raise click.UsageError("--maps and --sheet are the same file.")
    part_prices = read_prices(prices)
    device = more["device"]
    request_keys = ("seen", "facing", "range_mm", "field_of_view", "calibration", "device")
    if stations is None and accuracy is None:
        stations = 4
    request = request_of(
        stations=stations,
        accuracy=accuracy,
        criterion=criterion,
        **{key: more.pop(key) for key in request_keys},
    )
    plan = room_of(room, mounts=mounts, tripods=tripods, **more)
    with console.working("Placing stations"):
        design = design_room(plan, request)
    # A wrong paper is an error before anything is written.
    sheet_data = b"" if sheet is None else _drawn_sheet(design, output.stem, paper_name)
    write_scene(output, design.scene, overwrite=overwrite)
    written = [output]
    if maps is not None:
        from locatk.formats.plots.rooms import write_room_maps

        write_room_maps(maps, design.scene, design.report, overwrite=overwrite)
        written.append(maps)
    if sheet is not None:
        with atomic_write(sheet, overwrite=overwrite) as stream:
            stream.write(sheet_data)
        written.append(sheet)
    items = bill_of_materials(
        design.mounts,
        robots=1 if plan.robots is None else plan.robots.count,
        photodiodes=4 if device == "deck" else 1,
    )
    items = with_prices(items, part_prices)
    if bom is not None:
        write_bill(bom, items, overwrite=overwrite)
        written.append(bom)
    console.result(f"Wrote {', '.join(map(str, written))}\n")
    _print_design(design, plan, request, device, items, as_json, written)


def _drawn_sheet(design: RoomDesign, title: str, paper_name: str) -> bytes:
    from locatk.core.lighthouse.drawing.mounting_sheet import draw_mounting_sheet
    from locatk.core.paper_sizes import paper_size
    from locatk.formats.printing.drawings import render_pages

    _, paper_mm = paper_size(paper_name)
    pages = draw_mounting_sheet(design.scene, design.poses.kinds, title, paper_mm)
    return render_pages(pages, f"locatk room {title}")


def _print_design(
    design: RoomDesign,
    room: Room,
    request: RoomRequest,
    device: str,
    items: Sequence[BillItem],
    as_json: bool,
    written: list[Path],
) -> None:
    from locatk.cli.room import room_text
    from locatk.core.lighthouse.design.report import deck_heading_sigma
    from locatk.formats.exporters.bill_of_materials import bill_rows, total_entry

    heading = None
    if device == "deck":
        heading = deck_heading_sigma(design.scene, design.report, room, request)
    rows = room_text.station_rows(design.scene.stations, design.poses.kinds)
    console.result(
        console.labelled(
            [
                *room_text.room_lines(room),
                room_text.reception_line(request),
                *room_text.report_lines(design.report, heading),
            ]
        )
    )
    mounted = room_text.mm(design.mounted_report.p95_sigma_m)
    note = (
        f"Until the scene is calibrated, stations that are mounted by hand within 20 mm and 1.5 "
        f"degrees give {mounted}: record a session and run `locatk calibrate scene`."
    )
    console.result("\n" + console.table(room_text.STATION_HEADER, rows))
    console.result("\n" + console.wrapped(note, indent=0))
    if design.scene.markers:
        text = room_text.marker_text(design.scene.markers)
        console.result("\n" + console.wrapped(text, indent=0))
    console.result("\n" + materials_text(items))
    for text in design.report.notes:
        console.result("\n" + console.wrapped(f"Note: {text}.", indent=0))
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "outputs": written,
                **room_text.design_entry(design),
                "heading_sigma_rad": heading,
                "materials": bill_rows(items),
                "materials_total": total_entry(items),
                "warnings": design.warnings,
            }
        )
    failures.finish_with_warnings(design.warnings)
