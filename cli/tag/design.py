"""``locatk tag design`` and ``tag check``: will it work, and how well?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.options import number
from locatk.cli.tag.shared_options import design_options, use_of, use_options
from locatk.core.errors import OutputExistsError
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.polaris.design.planning import DesignReport
    from locatk.core.polaris.tag import Magnet

GRADES = ("N35", "N38", "N40", "N42", "N45", "N48", "N50", "N52")


@click.command(short_help="Plan a tag or a family of tags and write tag.toml.")
@options.output("Tags to write (.toml).")
@design_options
@click.option(
    "--spacing",
    type=float,
    metavar="MM",
    help="Between two cells.  [default: the smallest by the paper's rule, in whole mm]",
)
@number("--diameter", default=2.0, metavar="MM", help="Of the disc magnets.")
@number("--height", default=0.5, metavar="MM", help="Of the disc magnets.")
@click.option("--grade", type=click.Choice(GRADES), help="Of the magnets.  [default: N52]")
@click.option(
    "--remanence", type=float, metavar="T", help="Of the magnets, instead of the grade's."
)
@number("--clearance", default=10.0, metavar="MM", help="From the magnets' middle to the sensors.")
@use_options
@click.option(
    "--id", "ids", type=int, multiple=True, metavar="N", help="A tag of the family (repeatable)."
)
@click.option("--count", type=click.IntRange(min=1), help="Tags of a family to generate.")
@number(
    "--min-distance",
    default=1,
    type=click.IntRange(min=1),
    metavar="D",
    help="Between any two tags of the family, in steps of orientation.",
)
@click.option("--bom", type=options.PATH, metavar="FILE", help="Bill of materials to write (.csv).")
@options.overwrite
@options.as_json
@options.verbosity
def design(
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
    overwrite: bool,
    as_json: bool,
    **use: Any,
) -> None:
    """Plan a tag, or a family of them, and write it to OUTPUT.

    Computes field, noise, accuracy (Cramer-Rao bound) and limits. What will not work is a
    warning with what to do; the tag is written all the same, and the exit status is 3.
    Without --id and --count, any id may occur.

    \b
    Examples:
      locatk tag design -o tag.toml
      locatk tag design -o tag.toml --count 50 --min-distance 3 --bom parts.csv
      locatk tag design -o mini.toml --order 2 --magnets 3 --diameter 1 --clearance 4
      locatk tag design -o tag.toml --spacing 16 --osr 2 --rate 100 --speed 0.3
    """
    from locatk.core.polaris.codec import families
    from locatk.core.polaris.design.planning import compact_spacing, evaluate_design
    from locatk.core.polaris.tag import Tags
    from locatk.formats.artifacts.tags import write_tags
    from locatk.formats.exporters.bill_of_materials import write_bill

    if ids and count is not None:
        raise click.UsageError("--id names the tags and --count generates them; leave one out.")
    if min_distance > 1 and not ids and count is None:
        raise click.UsageError("--min-distance is that of a family: add --count or --id.")
    options.guard_output(output, overwrite=overwrite)
    if bom is not None:
        options.guard_output(bom, overwrite=overwrite)
        if bom.resolve() == output.resolve():
            raise OutputExistsError("tags and materials would be one file", file=bom)

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
        with console.working("Generating"):
            tags = replace(tags, ids=families.generate_family(tags, count, min_distance))
        tags = replace(
            tags, notes=(f"family of rule {families.FAMILY_RULE_VERSION}, count {count}",)
        )
    families.check_family(tags)
    with console.working("Planning"):
        planned = evaluate_design(tags, use_of(**use), count=len(tags.ids or (0,)))
    write_tags(output, tags, overwrite=overwrite)
    if bom is not None:
        write_bill(bom, planned.materials, overwrite=overwrite)
    written = [str(path) for path in (output, bom) if path is not None]
    console.result(f"Wrote {' and '.join(written)}\n")
    _tell(planned, list(planned.warnings), {"output": output, "bom": bom}, as_json)


@click.command(short_help="Check tags that are there.")
@options.input_argument("tag")
@use_options
@options.as_json
@options.verbosity
def check(tag: Path, as_json: bool, **use: Any) -> None:
    """Say whether the tags of TAG will work, and how well.

    The same as `locatk tag design`, and the smallest distance of the family. The exit
    status is 3 where something will not work.

    \b
    Examples:
      locatk tag check tag.toml
      locatk tag check tag.toml --sensors 3 --sensor-spacing 8 --filt 5 --speed 0.005
      locatk tag check tag.toml --placement-error 2 --json
    """
    from locatk.core.polaris.codec import families
    from locatk.core.polaris.design.planning import evaluate_design
    from locatk.formats.artifacts.tags import read_tags

    tags = read_tags(tag)
    with console.working("Planning"):
        planned = evaluate_design(tags, use_of(**use), count=len(tags.ids or (0,)))
    warnings = list(planned.warnings)
    found: int | None = None
    if tags.ids is not None and len(tags.ids) > 1:
        found, pair = families.closest_pair(tags, tags.ids)
        console.result(
            f"Smallest distance in the family: {found} (ids {pair[0]} and {pair[1]}), "
            f"{tags.min_distance} is asked for\n"
        )
        if found < tags.min_distance:
            warnings.append(
                f"ids {pair[0]} and {pair[1]} have a distance of {found}, not "
                f"{tags.min_distance}; drop one of them"
            )
    _tell(planned, warnings, {"input": tag, "smallest_distance": found}, as_json)


def _magnet(diameter: float, height: float, grade: str | None, remanence: float | None) -> Magnet:
    from locatk.core.polaris.design.materials import disc_magnet

    if grade is None and remanence is None:
        grade = "N52"
    return disc_magnet(metres(diameter), metres(height), grade=grade or "", remanence_t=remanence)


def _tell(planned: DesignReport, warnings: list[str], more: dict[str, Any], as_json: bool) -> None:
    """The plan and its notes, the warnings, and the exit status they mean."""
    from locatk.cli.tag import design_text as tag_plan

    console.result(tag_plan.text(planned))
    for note in planned.notes:
        console.say(note)
    if as_json:
        console.emit_json({"version": 1, **more, **tag_plan.entry(planned), "warnings": warnings})
    failures.finish_with_warnings(warnings)
