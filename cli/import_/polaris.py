"""Import of samples of a magnetometer array over magnetic tags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import section

OPTIONS = ("rate", "spacing", "tag")
"""Options of polaris-csv, by the names of their arguments."""

REQUIRED = OPTIONS[:2]

polaris_options = section(
    "For polaris-csv",
    click.option(
        "--spacing",
        type=options.PositiveNumber(1e-9, 1000),
        metavar="MM",
        help="Distance between neighbouring sensors of a straight bar (published runs: 20).",
    ),
    options.input_option(
        "--tag",
        help="Tags in the recording (tag.toml).  [default of polaris-csv: the published design]",
    ),
)


def import_samples(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import samples; returns the results for ``--json`` and a summary of the losses."""
    from locatk.formats.artifacts import tags
    from locatk.formats.importers.polaris_csv import PUBLISHED_TAGS
    from locatk.formats.sessions import field_samples

    tag = tags.read_tags(given["tag"]) if "tag" in given else PUBLISHED_TAGS
    with console.working("Reading"):
        imported = reader(paths[0], rate_hz=given["rate"], spacing_m=given["spacing"] / 1000)
        field_samples.write_magnetometers(
            output,
            [imported.samples],
            tags=tag,
            facts=imported.facts,
            warnings=imported.warnings,
            overwrite=overwrite,
        )
    samples = imported.samples
    console.say(f"{len(samples)} samples of {len(samples.array)} sensors")
    if "tag" not in given:
        console.say("No --tag: the session contains the design of the published tags")
    results = {
        "samples": len(samples),
        "sensors": len(samples.array),
        "devices": [samples.device],
        "left_out": imported.left_out,
        "warnings": imported.warnings,
    }
    return results, imported.lost
