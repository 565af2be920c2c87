"""``locatk export``: poses for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from locatk.cli import console, options

if TYPE_CHECKING:
    from locatk.core.trajectory import Trajectory


@click.command(short_help="Write poses for other tools.")
@options.input_argument("solution")
@click.option("--format", "format_name", type=click.Choice(["csv", "tum"]), required=True)
@options.output("File to write; for `tum` with several devices, the folder for them.")
@options.overwrite
@options.verbosity
def command(solution: Path, format_name: str, output: Path, overwrite: bool) -> None:
    """Write the poses of SOLUTION in the format of other tools.

    `csv` has one row a pose: time_s, device, x_m, y_m, z_m, qx, qy, qz, qw, sigma_x_m,
    sigma_y_m, sigma_z_m, sigma_heading_rad; a sigma that is not known is empty. `tum`
    (for evo and others) holds one device a file.

    \b
    Examples:
      locatk export solved.mcap --format csv -o poses.csv
      locatk export solved.mcap --format tum -o poses.tum
    """
    from locatk.formats import trajectories
    from locatk.formats.solutions import read_trajectories

    found = read_trajectories(solution)
    if format_name == "csv":
        options.guard_output(output, overwrite=overwrite, inputs=[solution])
        trajectories.write_csv(output, found, overwrite=overwrite)
        console.result(f"Wrote {output}: {sum(map(len, found))} poses")
        return
    files = tum_files(found, output)
    for path, _ in files:
        options.guard_output(path, overwrite=overwrite, inputs=[solution])
    for path, trajectory in files:
        trajectories.write_tum(path, trajectory, overwrite=overwrite)
        console.result(f"Wrote {path}: {len(trajectory)} poses")


def tum_files(found: list[Trajectory], output: Path) -> list[tuple[Path, Trajectory]]:
    """Which file each device goes to: ``output``, or one of its name in that folder."""
    if len(found) == 1 and not output.is_dir():
        return [(output, found[0])]
    options.make_folder(output)
    return [(output / f"{t.device.replace('/', '_')}.tum", t) for t in found]
