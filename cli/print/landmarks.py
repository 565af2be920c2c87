"""``locatk print landmarks``: drawings for the installation of a landmark floor."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.price_options import price_options

DEFAULT_OVERLAP_MM = 10.0


@click.command(cls=Command, short_help="Draw the installation pack of a landmark map.")
@options.input_argument("map_file")
@options.output("PDF to write.", endings=(".pdf",))
@options.overwrite
@options.as_json
@options.verbosity
@section(
    "Content",
    click.option(
        "--templates",
        "templates_only",
        is_flag=True,
        help="Draw only the placement templates, at true size.",
    ),
    click.option(
        "--floor",
        "whole_floor",
        is_flag=True,
        help="Draw the whole floor at true size instead, divided into sheets or strips.",
    ),
    click.option(
        "--spares",
        "spares_percent",
        type=click.FloatRange(0, 1000),
        default=5.0,
        show_default=True,
        metavar="PERCENT",
        help="Spare bars, in addition to four for each landmark.",
    ),
    options.output_option(
        "--bom",
        metavar="FILE",
        endings=(".csv",),
        help="Also write the bill of materials (.csv).",
    ),
    price_options,
)
@section(
    "Paper",
    click.option(
        "--paper",
        "--size",
        "paper_name",
        default="A4",
        show_default=True,
        metavar="PAPER",
        help="A0 to A5, Letter, Tabloid, or a size as in 600x900mm or 24x36in; with --floor also "
        "the width of a roll as in roll:914mm or roll:36in.",
    ),
    click.option(
        "--margin",
        "margin_mm",
        type=click.FloatRange(0),
        default=10.0,
        show_default=True,
        metavar="MM",
        help="Empty margin, for printers that cannot print to the edge; with --floor it "
        "contains rulers and registration marks.",
    ),
    click.option(
        "--overlap",
        "overlap_mm",
        type=click.FloatRange(0),
        metavar="MM",
        help="Overlap of neighbouring sheets of --floor; registration marks show where to cut.  "
        f"[default: {DEFAULT_OVERLAP_MM:g}]",
    ),
)
def landmarks(
    map_file: Path,
    output: Path,
    templates_only: bool,
    whole_floor: bool,
    paper_name: str,
    margin_mm: float,
    overlap_mm: float | None,
    spares_percent: float,
    bom: Path | None,
    prices: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw the installation pack of the map MAP_FILE (map.toml).

    The pack contains a plan of the floor, a placement template at true size for each kind of
    landmark (outlines, an arrow to the north pole of each bar, the y axis of the map), the bill of
    materials, a checklist, and a list of all landmarks. Print at 100 % and measure the rulers.
    Landmarks are drawn as designed, even if the file contains calibrated ones.

    \b
    Examples:
      locatk print landmarks map.toml -o pack.pdf
      locatk print landmarks map.toml -o templates.pdf --templates --paper A3
      locatk print landmarks map.toml -o floor.pdf --floor --paper A0
      locatk print landmarks map.toml -o floor.pdf --floor --paper roll:914mm
      locatk print landmarks map.toml -o pack.pdf --spares 10 --bom parts.csv
      locatk print landmarks --print-prices > prices.toml
      locatk print landmarks map.toml -o pack.pdf --prices prices.toml
    """
    from locatk.core.errors import OutputExistsError, error_context
    from locatk.core.landmarks.design.materials import bill_of_materials
    from locatk.core.materials import with_prices
    from locatk.core.paper_sizes import parse_paper
    from locatk.formats.artifacts.maps import read_map
    from locatk.formats.artifacts.prices import read_prices
    from locatk.formats.exporters.bill_of_materials import bill_rows, total_entry, write_bill
    from locatk.formats.output import atomic_write

    if templates_only and whole_floor:
        raise click.UsageError("--templates and --floor are different drawings; leave one out.")
    if overlap_mm is not None and not whole_floor:
        raise click.UsageError("--overlap needs --floor.")
    paper = parse_paper(paper_name)
    if paper.is_roll and not whole_floor:
        raise click.UsageError("A roll needs --floor; the pack needs sheets, as in --paper A4.")
    options.guard_output(output, overwrite=overwrite, inputs=[map_file])
    if bom is not None:
        options.guard_output(bom, overwrite=overwrite, inputs=[map_file])
        if os.path.realpath(bom) == os.path.realpath(output):
            raise OutputExistsError("drawing and materials would be one file", file=bom)
    floor = read_map(map_file)
    items = with_prices(bill_of_materials(floor, spares_percent), read_prices(prices))
    with error_context(map_file):
        if whole_floor:
            overlap_mm = DEFAULT_OVERLAP_MM if overlap_mm is None else overlap_mm
            data, entry = _draw_floor(floor, paper, margin_mm, overlap_mm)
        else:
            data, entry = _draw_pack(floor, paper, margin_mm, items, templates_only)
    with atomic_write(output, overwrite=overwrite) as stream:
        stream.write(data)
    if bom is not None:
        write_bill(bom, items, overwrite=overwrite)
    console.result(_text(output, bom, floor, items, entry))
    console.say("Print at 100 %, without scaling to fit, and measure the rulers.")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "bom": bom,
                "landmarks": len(floor.cells()),
                "materials": bill_rows(items),
                "materials_total": total_entry(items),
                **entry,
            }
        )


def _draw_pack(
    floor: Any, paper: Any, margin_mm: float, items: Any, templates_only: bool
) -> tuple[bytes, dict[str, Any]]:
    """Return the PDF of the pack, and its entries for ``--json`` (docs/formats.md)."""
    from locatk.core.landmarks.drawing.landmark import code_digit
    from locatk.core.landmarks.drawing.pack import PACK_PARTS, draw_installation_pack
    from locatk.core.landmarks.landmark import name
    from locatk.formats.printing.drawings import render_pages

    pack = draw_installation_pack(
        floor,
        paper.size_mm,
        parts=("templates",) if templates_only else PACK_PARTS,
        paper_name=paper.name,
        margin_mm=margin_mm,
        items=items,
    )
    with console.steps(len(pack.pages), "Drawing") as done:
        data = render_pages(pack.pages, _title(floor), done=done)
    return data, {
        "pages": len(pack.pages),
        "page_mm": pack.pages[0].size_mm,
        "parts": {part: [first + 1, end] for part, (first, end) in pack.parts.items()},
        "templates": [
            {
                "code": code_digit(item.code),
                "bars": name(item.code),
                "cells": item.cells,
                "page": item.page + 1,
                "centre_mm": item.centre_mm,
                "side_mm": item.side_mm,
            }
            for item in pack.templates
        ],
    }


def _draw_floor(
    floor: Any, paper: Any, margin_mm: float, overlap_mm: float
) -> tuple[bytes, dict[str, Any]]:
    """Return the PDF of the floor, and its entries for ``--json`` (docs/formats.md)."""
    from locatk.core.landmarks.drawing.true_size import draw_floor
    from locatk.formats.printing.drawings import render_floor

    pages = draw_floor(floor, paper, margin_mm=margin_mm, overlap_mm=overlap_mm)
    with console.steps(len(pages), "Drawing") as done:
        data = render_floor(pages, _title(floor), done=done)
    return data, {
        "pages": len(pages),
        "page_mm": pages[0].size_mm,
        "tiles": [
            {
                "id": page.tile.name,
                "page": number,
                "x_mm": round(page.tile.corner_mm[0], 6),
                "y_mm": round(page.tile.corner_mm[1], 6),
                "box_mm": page.tile.box,
            }
            for number, page in enumerate(pages, 1)
        ],
    }


def _title(floor: Any) -> str:
    return f"locatk landmarks {floor.name}".strip()


def _text(
    output: Path,
    bom: Path | None,
    floor: Any,
    items: tuple[Any, ...],
    entry: dict[str, Any],
) -> str:
    """Format the summary of the drawing."""
    from locatk.core.materials import total_of

    width, height = entry["page_mm"]
    pages = entry["pages"]
    files = f"{output} and {bom}" if bom is not None else str(output)
    bars = sum(item.count for item in items if item.part.startswith("bar magnet"))
    lines = [
        f"Wrote {files}: {pages} page{'s' * (pages != 1)} of {width:g} x {height:g} mm",
        f"{len(floor.cells())} landmarks, {bars} bars with spares",
        f"Materials: {total_of(items).text}",
    ]
    for part, (first, last) in entry.get("parts", {}).items():
        where = f"page {first}" if first == last else f"pages {first} to {last}"
        lines.append(f"  {part}: {where}")
    return "\n".join(lines)
