"""``locatk export``: poses for other tools."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from locatk.cli import console, failures, options

if TYPE_CHECKING:
    from locatk.core.trajectory import Trajectory

FORMATS = ("tum", "kitti", "csv", "parquet", "ros2")

STDOUT = Path("-")


@click.command(short_help="Write poses for other tools.")
@options.input_argument("solution")
@click.option("--format", "format_name", type=click.Choice(FORMATS), required=True)
@options.output(
    "File to write; for `tum` and `kitti` with several devices, the folder for them; `-` writes "
    "`csv` or `tum` to stdout."
)
@click.option("--device", "devices", multiple=True, metavar="NAME", help="Only this; repeatable.")
@click.option("--covariance", is_flag=True, help="In `ros2`, poses with covariance as well.")
@options.overwrite
@options.as_json
@options.verbosity
def command(
    solution: Path,
    format_name: str,
    output: Path,
    devices: tuple[str, ...],
    covariance: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the poses of SOLUTION in the format of other tools.

    SOLUTION is what `locatk solve` has written, or a session, whose reference poses are
    taken.

    \b
    tum      time and pose, one device a file, for evo and others
    kitti    3 x 4 matrices, one device a file; times in a file beside it
    csv      time_s, device, x_m, y_m, z_m, qx, qy, qz, qw, sigma_x_m, sigma_y_m,
             sigma_z_m, sigma_heading_rad; a sigma that is not known is empty
    parquet  the same, exact times, frames, full covariances; needs locatk[parquet]
    ros2     PoseStamped and TFMessage in MCAP, for ros2 bag, RViz and evo

    \b
    Examples:
      locatk export solved.mcap --format csv -o poses.csv
      locatk export solved.mcap --format tum -o poses.tum
      locatk export solved.mcap --format ros2 -o poses.mcap
      locatk export solved.mcap --format csv -o -
    """
    from locatk.core.errors import InputError
    from locatk.formats import exports
    from locatk.formats.solutions import read_trajectories

    if covariance and format_name != "ros2":
        raise click.UsageError("--covariance is for --format ros2; csv and parquet always have it.")
    if output == STDOUT and (as_json or format_name not in exports.TEXTS):
        what = "--json" if as_json else f"--format {format_name}"
        raise click.UsageError(f"{what} does not go with -o -, which is for csv and tum.")
    found = chosen(read_trajectories(solution), devices, solution)
    poses = sum(map(len, found))
    if format_name != "parquet":  # where they are null
        found = [exports.numbers(each) for each in found]
    lost = poses - sum(map(len, found))
    if lost == poses:
        raise InputError(f"none of the {poses} poses is a number", file=solution)
    if output == STDOUT:
        click.echo(text(found, format_name), nl=False)
        tell(lost)
        return

    planned = exports.parts(found, format_name, output)
    if planned[0].path != output:
        options.make_folder(output)
    for path in (path for part in planned for path in part.files):
        options.guard_output(path, overwrite=overwrite, inputs=[solution])
    facts = exports.facts_of(solution)
    for part in planned:
        exports.write(part, format_name, facts=facts, covariance=covariance, overwrite=overwrite)
        console.result(f"Wrote {part.path}: {sum(map(len, part.trajectories))} poses")
    if format_name == "kitti":
        name = planned[0].times if len(planned) == 1 else f"{output}/*.times.txt"
        console.say(f"Lines of kitti have no times: these are in {name}")
    if format_name == "ros2" and output.suffix != ".mcap":
        console.warn(f"{output} does not end in .mcap, by which ros2 bag and evo know it")
    if as_json:
        files = [
            {"path": part.path, "device": each.device, "poses": len(each), "times": part.times}
            for part in planned
            for each in part.trajectories
        ]
        console.emit_json({"version": 1, "input": solution, "format": format_name, "files": files})
    tell(lost)


def tell(lost: int) -> None:
    """Say what was left out, by the exit status too."""
    if lost:
        poses = "1 pose that is not a number" if lost == 1 else f"{lost} poses that are not numbers"
        raise failures.Incomplete(f"left out {poses}")


def chosen(found: list[Trajectory], devices: tuple[str, ...], solution: Path) -> list[Trajectory]:
    """Those of these devices, or all where none is named."""
    from locatk.core.errors import InputError

    names = [trajectory.device for trajectory in found]
    for device in devices:
        if device not in names:
            raise InputError(
                f"no device {device!r}", file=solution, hint=f"There are {', '.join(names)}"
            )
    return [each for each in found if not devices or each.device in devices]


def text(found: list[Trajectory], format_name: str) -> bytes:
    """The file as it would be written."""
    from locatk.core.errors import InputError
    from locatk.formats import exports

    if format_name in exports.ENDINGS and len(found) > 1:
        raise InputError(
            f"{len(found)} devices, and {format_name} holds one",
            hint="Name one with --device, or a folder with -o",
        )
    with TemporaryDirectory(prefix="locatk-export-") as folder:
        path = Path(folder) / "poses"
        exports.write(exports.Part(path, tuple(found)), format_name)
        return path.read_bytes()
