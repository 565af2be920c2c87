"""``locatk tag design``: plan a tag or a family of tags."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.cli.options import number
from locatk.cli.price_options import price_options
from locatk.cli.route_options import LengthAndAngle
from locatk.cli.tag.design_text import report_evaluation, search_entry, search_text
from locatk.cli.tag.options import (
    LENGTH_MM,
    code_options,
    reading_conditions,
    reading_options,
)
from locatk.core.errors import OutputExistsError
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.polaris.design.planning import ReadingConditions
    from locatk.core.polaris.design.search import DesignSearch
    from locatk.core.polaris.tag import Magnet

GRADES = ("N35", "N38", "N40", "N42", "N45", "N48", "N50", "N52")


@click.command(cls=Command)
@options.output("Tags to write (.toml).", endings=(".toml",))
@options.output_option(
    "--bom", endings=(".csv",), metavar="FILE", help="Also write the bill of materials (.csv)."
)
@price_options
@section(
    "Search",
    click.option(
        "--search",
        is_flag=True,
        help="Choose magnets, clearance, spacing and code for --count tags, except those that are "
        "given as options.",
    ),
    click.option(
        "--accuracy",
        type=LengthAndAngle(),
        metavar="MM[,DEG]",
        help="Error of a pass (position and heading) that must not be exceeded with 95 %.",
    ),
    click.option(
        "--max-clearance",
        type=LENGTH_MM,
        metavar="MM",
        help="Largest clearance to try; --clearance is the smallest.  [default: --clearance]",
    ),
)
@code_options
@section(
    "Family",
    click.option(
        "--id",
        "ids",
        type=int,
        multiple=True,
        metavar="N",
        help="Id of a tag of the family. Repeatable.",
    ),
    click.option(
        "--count",
        type=click.IntRange(min=1),
        metavar="N",
        help="Generate a family of this many tags.",
    ),
    number(
        "--min-distance",
        default=1,
        type=click.IntRange(min=1),
        metavar="D",
        help="Minimum distance between two tags of the family, in orientation steps.",
    ),
)
@section(
    "Magnets",
    click.option(
        "--spacing",
        type=LENGTH_MM,
        metavar="MM",
        help="Distance between neighbouring cells.  [default: the smallest that the paper's rule "
        "allows, in whole mm]",
    ),
    number(
        "--diameter",
        default=2.0,
        type=LENGTH_MM,
        metavar="MM",
        help="Diameter of a disc magnet.",
    ),
    number(
        "--height",
        default=0.5,
        type=LENGTH_MM,
        metavar="MM",
        help="Height of a disc magnet.",
    ),
    click.option(
        "--grade", type=click.Choice(GRADES), help="Grade of the neodymium magnets.  [default: N52]"
    ),
    click.option(
        "--remanence",
        type=options.POSITIVE,
        metavar="T",
        help="Remanence of the magnets, instead of that of the grade.",
    ),
    number(
        "--clearance",
        default=10.0,
        type=LENGTH_MM,
        metavar="MM",
        help="Height of the sensors above the centres of the magnets.",
    ),
)
@reading_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    output: Path,
    order: int,
    magnets: int,
    orientations: int,
    codec: str,
    spacing: float | None,
    diameter: float,
    height: float,
    grade: str | None,
    remanence: float | None,
    clearance: float,
    ids: tuple[int, ...],
    count: int | None,
    min_distance: int,
    bom: Path | None,
    prices: Path | None,
    search: bool,
    accuracy: tuple[float, float | None] | None,
    max_clearance: float | None,
    overwrite: bool,
    as_json: bool,
    **conditions: Any,
) -> None:
    """Design a tag or a family of tags, and write it to OUTPUT.

    The output lists field, noise, accuracy (Cramer-Rao bound) and limits. If a requirement is not
    met, a warning gives a remedy; the tag is written nevertheless, and the exit status is 3.
    Without --id and --count, a tag may have any id of the codec.

    With --search, stocked magnets, clearances, spacings and codes are tried. The output lists the
    best design of each magnet, by number of magnets and size; the first one is written.

    \b
    Examples:
      locatk tag design -o tag.toml
      locatk tag design -o tag.toml --count 50 --min-distance 3 --bom parts.csv
      locatk tag design --print-prices > prices.toml
      locatk tag design -o mini.toml --order 2 --magnets 3 --clearance 4
      locatk tag design -o tag.toml --spacing 16 --osr 2 --rate 100 --speed 0.3
      locatk tag design --search --count 50 --accuracy 1,0.5 -o tag.toml
      locatk tag design --search --count 9 --max-clearance 15 -o tag.toml
    """
    from locatk.core.materials import with_prices
    from locatk.core.polaris.codec import families
    from locatk.core.polaris.design.planning import compact_spacing, evaluate_design
    from locatk.core.polaris.tag import Tags
    from locatk.formats.artifacts.prices import read_prices
    from locatk.formats.artifacts.tags import write_tags
    from locatk.formats.exporters.bill_of_materials import write_bill

    if ids and count is not None:
        raise click.UsageError("--id names the tags and --count generates them: give one of them.")
    if min_distance > 1 and not ids and count is None:
        raise click.UsageError("--min-distance is for a family: add --count or --id.")
    options.guard_output(output, overwrite=overwrite)
    if bom is not None:
        options.guard_output(bom, overwrite=overwrite)
        if bom.resolve() == output.resolve():
            raise OutputExistsError("tags and bill of materials would be one file", file=bom)

    if not search and (accuracy is not None or max_clearance is not None):
        raise click.UsageError("--accuracy and --max-clearance are for --search.")
    use = reading_conditions(**conditions)
    part_prices = read_prices(prices)
    more: dict[str, Any] = {"output": output, "bom": bom}
    if search:
        if count is None:
            raise click.UsageError("--search needs --count, the number of tags.")
        found = _search(count, min_distance, accuracy, max_clearance, use)
        console.result(search_text(found) + "\n")
        more["search"] = search_entry(found)
        if not found.designs:
            if as_json:
                console.emit_json({"version": 1, "search": more["search"]})
            failures.finish_with_warnings([found.reason])
        tags = replace(found.designs[0].tags, min_distance=min_distance)
    else:
        magnet = _magnet(diameter, height, grade, remanence)
        tags = Tags(
            order=order,
            magnets=magnets,
            orientations=orientations,
            spacing_m=compact_spacing(magnet, metres(clearance))
            if spacing is None
            else metres(spacing),
            codec=codec,
            magnet=magnet,
            clearance_m=metres(clearance),
            min_distance=min_distance,
            ids=ids or None,
        )
    if count is not None:
        with console.steps(families.PROGRESS_STEPS, "Generating") as advance:
            ids = families.generate_family(tags, count, min_distance, advance)
        note = f"family of rule {families.FAMILY_RULE_VERSION}, count {count}"
        tags = replace(tags, ids=ids, notes=(note,))
    families.check_family(tags)
    with console.working("Planning"):
        report = evaluate_design(tags, use, count=len(tags.ids or (0,)))
    report = replace(report, materials=with_prices(report.materials, part_prices))
    write_tags(output, tags, overwrite=overwrite)
    if bom is not None:
        write_bill(bom, report.materials, overwrite=overwrite)
    written = [str(path) for path in (output, bom) if path is not None]
    console.result(f"Wrote {' and '.join(written)}\n")
    report_evaluation(report, list(report.warnings), more, as_json)


def _search(
    count: int,
    min_distance: int,
    accuracy: tuple[float, float | None] | None,
    max_clearance: float | None,
    use: ReadingConditions,
) -> DesignSearch:
    """Search for designs; options that were given on the command line are fixed."""
    from locatk.core.polaris.design.search import SearchSpace, search_designs

    context = click.get_current_context()
    given = {
        name: value
        for name, value in context.params.items()
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    }
    clearance = context.params["clearance"]
    space = SearchSpace(
        clearance_m=(metres(clearance), metres(max_clearance or clearance)),
        codec=context.params["codec"],
    )
    if "order" in given:
        space = replace(space, orders=(given["order"],))
    if "magnets" in given:
        space = replace(space, counts=(given["magnets"],))
    if "orientations" in given:
        space = replace(space, orientations=(given["orientations"],))
    if "spacing" in given:
        space = replace(space, spacing_m=metres(given["spacing"]))
    magnet_options = ("diameter", "height", "grade", "remanence")
    if any(name in given for name in magnet_options):
        magnet = _magnet(*(context.params[name] for name in magnet_options))
        space = replace(space, magnets=(magnet,))
    position_m, heading_rad = accuracy or (math.inf, None)
    with console.working("Searching"):
        return search_designs(count, position_m, heading_rad or math.inf, use, space, min_distance)


def _magnet(diameter: float, height: float, grade: str | None, remanence: float | None) -> Magnet:
    from locatk.core.polaris.design.materials import disc_magnet

    if grade is None and remanence is None:
        grade = "N52"
    return disc_magnet(metres(diameter), metres(height), grade=grade or "", remanence_t=remanence)
