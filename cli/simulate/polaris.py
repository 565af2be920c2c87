"""``locatk simulate polaris``: samples of a magnetometer bar over tags."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.simulate.options import simulation_command


@simulation_command("locatk.formats.simulation.polaris")
@click.argument("tag", type=options.PATH, required=False)
def command(
    tag: Path | None,
    output: Path,
    settings: Mapping[str, Any],
    input_files: list[Path],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate a magnetometer bar that drives over tags of TAG (tag.toml).

    The magnets are finite discs, the sensors MLX90393 that convert X, Y and Z one after the other.
    Without TAG it is the paper's tag: 3 x 3 cells 40 mm apart, five magnets, eight orientations.
    The session contains the samples, the bar, the tags as designed, and as truth the poses of the
    bar. The same settings and seed give the same samples.

    \b
    Examples:
      locatk simulate polaris -o run.mcap --id 262143
      locatk simulate polaris tag.toml -o run.mcap --heading 30 --measured-noise
      locatk simulate polaris site.toml -o tour.mcap --id 3 --id 7 --odometry
      locatk simulate polaris -o mini.mcap --car mini --id 77
      locatk simulate polaris --speed-wobble 0.3 --print-config > sim.toml
      locatk simulate polaris --config sim.toml -o run.mcap --seed 2
    """
    from locatk.formats.simulation import polaris

    options.must_exist([tag])
    inputs = [*input_files, *([tag] if tag else [])]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    with console.working("Simulating"):
        summary, warnings = polaris.write_simulation(output, settings, tag, overwrite=overwrite)
    for line in warnings:
        console.warn(line)
    crossed = ", ".join(str(crossing["tag_id"]) for crossing in summary["crossings"])
    console.result(
        f"Wrote {output}: {summary['samples']} samples of {summary['device']} in "
        f"{summary['frame']}, over {'tag ' + crossed if crossed else 'no tag'}, "
        f"{summary['truth_poses']} truth poses"
    )
    if as_json:
        console.emit_json({"version": 1, "output": output, **summary})
