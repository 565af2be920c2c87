"""``locatk simulate landmarks``: samples of hall sensors and odometry on a floor of landmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from locatk.cli import console, options
from locatk.cli.simulate.options import input_argument, simulation_command

MAX_NAMED_LANDMARKS = 12
"""Landmarks of a path that the result names."""


@simulation_command("locatk.formats.simulation.landmarks")
@input_argument("map_file")
def command(
    map_file: Path,
    output: Path,
    settings: Mapping[str, Any],
    input_files: list[Path],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate a robot that drives over the landmarks of MAP_FILE (map.toml).

    Each bar is a cuboid magnet of its own strength and position; the robot is a differential drive
    with erroneous wheels. It is steered by the truth and by the errors of its aims; with --strategy
    published, by its sensors and odometry only. Errors are standard deviations. The session
    contains samples, odometry, the map as designed, and as truth the poses of the robot; the errors
    of the floor are only in its facts. The same settings and seed give the same session.

    \b
    Examples:
      locatk simulate landmarks map.toml -o run.mcap
      locatk simulate landmarks map.toml -o tour.mcap --landmarks 12 --seed 3
      locatk simulate landmarks map.toml -o own.mcap --strategy published
      locatk simulate landmarks map.toml -o path.mcap --strategy path --path p.csv
      locatk simulate landmarks map.toml -o pass.mcap --strategy pass --cell 2,3
      locatk simulate landmarks map.toml -o bad.mcap --flip 2,3:1
      locatk simulate landmarks --print-config > sim.toml
      locatk simulate landmarks map.toml --config sim.toml -o run.mcap --seed 2
    """
    from locatk.formats.simulation import landmarks

    options.guard_output(output, overwrite=overwrite, inputs=[map_file, *input_files])
    with console.working("Simulating"):
        summary, warnings = landmarks.write_simulation(
            output, settings, map_file, overwrite=overwrite
        )
    for line in warnings:
        console.warn(line)
    text = (
        f"Wrote {output}: {summary['samples']} samples of {summary['device']}, over "
        f"{_visited(summary['visits'])}, {summary['truth_poses']} truth poses"
    )
    console.result(console.wrapped(text))
    if as_json:
        console.emit_json({"version": 1, "output": output, **summary})


def _visited(visits: Sequence[Mapping[str, Any]]) -> str:
    """Name the landmarks in the order of their visits, without immediate repetitions."""
    cells = [visit["cell"] for visit in visits]
    path = [
        f"{cell[0]},{cell[1]}" for k, cell in enumerate(cells) if k == 0 or cell != cells[k - 1]
    ]
    if not path:
        return "no landmark"
    more = len(path) - MAX_NAMED_LANDMARKS
    return f"landmarks {' '.join(path[:MAX_NAMED_LANDMARKS])}" + (
        f" and {more} more" if more > 0 else ""
    )
