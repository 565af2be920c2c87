"""``locatk export``: poses, and stations, for other tools."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command

if TYPE_CHECKING:
    from locatk.core.lighthouse.scene import Scene
    from locatk.core.trajectory import Trajectory

FORMATS = ("tum", "kitti", "csv", "parquet", "ros2")
"""Of poses."""

CONFIG = "crazyflie-config"
"""The format of stations."""

STDOUT = Path("-")


@click.command(cls=Command, short_help="Write poses for other tools.")
@options.input_argument("solution")
@click.option("--format", "format_name", type=click.Choice((*FORMATS, CONFIG)), required=True)
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
    """Write the poses of SOLUTION, or its Lighthouse stations, in the format of other tools.

    SOLUTION is what `locatk solve` has written, or a session, whose reference poses are
    taken. Of crazyflie-config it may be a scene (scene.toml), too.

    \b
    tum      time and pose, one device a file, for evo and others
    kitti    3 x 4 matrices, one device a file; times in a file beside it
    csv      time_s, device, x_m, y_m, z_m, qx, qy, qz, qw, sigma_x_m, sigma_y_m,
             sigma_z_m, sigma_heading_rad; a sigma that is not known is empty
    parquet  the same, exact times, frames, full covariances; needs locatk[parquet]
    ros2     PoseStamped and TFMessage in MCAP, for ros2 bag, RViz and evo
    crazyflie-config
             poses and calibrations of stations, in the YAML that Bitcraze's
             client and library write into a Crazyflie

    \b
    Examples:
      locatk export solved.mcap --format csv -o poses.csv
      locatk export solved.mcap --format tum -o poses.tum
      locatk export solved.mcap --format ros2 -o poses.mcap
      locatk export solved.mcap --format csv -o -
      locatk export solved.mcap --format crazyflie-config -o lighthouse.yaml
      locatk export scene.toml --format crazyflie-config -o lighthouse.yaml
    """
    from locatk.core.errors import InputError
    from locatk.formats.exporters import export as exports
    from locatk.formats.sessions.solutions import read_trajectories

    if covariance and format_name != "ros2":
        raise click.UsageError("--covariance is for --format ros2; csv and parquet always have it.")
    if output == STDOUT and (as_json or format_name not in exports.TEXTS):
        what = "--json" if as_json else f"--format {format_name}"
        raise click.UsageError(f"{what} does not go with -o -, which is for csv and tum.")
    if format_name == CONFIG:
        if devices:
            raise click.UsageError(f"--device is for poses; {CONFIG} holds stations.")
        stations(solution, output, overwrite=overwrite, as_json=as_json)
        return
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


def stations(source: Path, output: Path, *, overwrite: bool, as_json: bool) -> None:
    """Write the stations of a scene, of a session or of a solution."""
    from locatk.core.errors import error_context
    from locatk.formats.exporters import crazyflie

    options.guard_output(output, overwrite=overwrite, inputs=[source])
    scene = scene_of(source)
    with error_context(source):
        crazyflie.write_config(output, scene, overwrite=overwrite)
    channels = [station.channel for station in scene.stations]
    count, s = ("1 station", "") if len(channels) == 1 else (f"{len(channels)} stations", "s")
    console.result(f"Wrote {output}: {count}, channel{s} {', '.join(map(str, channels))}")
    if as_json:
        files = [{"path": output, "channels": channels}]
        console.emit_json({"version": 1, "input": source, "format": CONFIG, "files": files})


def scene_of(source: Path) -> Scene:
    """The scene in a file of its own, or attached to a session or a solution."""
    from locatk.core.errors import InputError
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.sessions.reader import Session

    if source.suffix.lower() == ".toml":
        return artifacts.read_scene(source)
    scene = artifacts.attached_scene(Session.open(source))
    if scene is None:
        raise InputError(
            "no lighthouse scene is attached",
            file=source,
            hint="Give a solution of `locatk solve`, or a scene (scene.toml)",
        )
    return scene


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
    from locatk.formats.exporters import export as exports

    if format_name in exports.ENDINGS and len(found) > 1:
        raise InputError(
            f"{len(found)} devices, and {format_name} holds one",
            hint="Name one with --device, or a folder with -o",
        )
    with TemporaryDirectory(prefix="locatk-export-") as folder:
        path = Path(folder) / "poses"
        exports.write(exports.Part(path, tuple(found)), format_name)
        return path.read_bytes()
