"""``locatk tag check``: evaluation of existing tags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command
from locatk.cli.tag.design_text import report_evaluation
from locatk.cli.tag.options import reading_conditions, reading_options


@click.command(cls=Command)
@options.input_argument("tag")
@reading_options
@options.as_json
@options.verbosity
def command(tag: Path, as_json: bool, **conditions: Any) -> None:
    """Evaluate the tags in TAG (tag.toml): their design, ids, and positions on a site.

    The output is that of `locatk tag design`. The exit status is 3 if a requirement is not met.

    \b
    Examples:
      locatk tag check tag.toml
      locatk tag check tag.toml --sensors 3 --sensor-spacing 8 --speed 0.005
      locatk tag check tag.toml --placement-error 2 --json
    """
    from locatk.core.polaris.codec import families
    from locatk.core.polaris.design.planning import evaluate_design
    from locatk.core.polaris.identification.evidence import conflicting_tags
    from locatk.formats.artifacts.tags import read_tags

    tags = read_tags(tag)
    with console.working("Planning"):
        report = evaluate_design(
            tags, reading_conditions(**conditions), count=len(tags.ids or (0,))
        )
    warnings = list(report.warnings)
    distance: int | None = None
    if tags.ids is not None and len(tags.ids) > 1:
        distance, pair = families.closest_pair(tags, tags.ids)
        console.result(
            f"Smallest distance in the family: {distance} (ids {pair[0]} and {pair[1]}), "
            f"required {tags.min_distance}\n"
        )
        if distance < tags.min_distance:
            warnings.append(
                f"ids {pair[0]} and {pair[1]} have a distance of {distance}, not "
                f"{tags.min_distance}; drop one of them"
            )
    conflicts = conflicting_tags(tags)
    if conflicts:
        first, second = conflicts[0]
        warnings.append(
            f"{len(conflicts)} pairs of tags on the site, as {first} and {second}, overlap or "
            "continue each other's grid, so that they are refused (other_design); change their "
            "distance by a quarter of the spacing, or use a family"
        )
    report_evaluation(report, warnings, {"input": tag, "smallest_distance": distance}, as_json)
