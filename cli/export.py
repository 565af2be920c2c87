"""``locatk export``: poses and stations in the formats of other tools."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section

if TYPE_CHECKING:
    from locatk.core.lighthouse.scene import Scene
    from locatk.core.trajectory import Trajectory

FORMATS = ("tum", "kitti", "csv", "parquet", "ros2")
"""Formats of poses."""

CONFIG = "crazyflie-config"
CALIBRATION = "dotbot-calibration"
STATION_FORMATS = (CONFIG, CALIBRATION)
"""Formats of Lighthouse stations."""

ENDINGS = {
    "tum": (".tum", ".txt"),
    "kitti": (".kitti", ".txt"),
    "csv": (".csv",),
    "parquet": (".parquet", ".pq"),
    "ros2": (".mcap",),
    CONFIG: (".yaml", ".yml"),
    CALIBRATION: (".out",),
}
"""Endings of the names of each format."""

OWN_ENDINGS = {
    name: tuple(ending for ending in endings if ending != ".txt")
    for name, endings in ENDINGS.items()
}
"""Endings by which a format is recognised."""

MIN_AREA_MM, MAX_AREA_MM = 100, 100_000
"""Shortest and longest side of a floor of DotBots; their coordinates end at 100 m."""

TABLES = ("csv", "parquet")
"""Formats that hold several sessions."""

STDOUT = Path("-")


def _parse_area(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Return the smallest x and y and the largest x and y of two corners."""
    if value is None:
        return None
    try:
        x, y, other_x, other_y = (float(number) for number in value.split(","))
    except ValueError:
        raise click.BadParameter(
            "expected four numbers, as in 0,-2000,3000,0", ctx, param
        ) from None
    area = (min(x, other_x), min(y, other_y), max(x, other_x), max(y, other_y))
    sizes = (area[2] - area[0], area[3] - area[1])
    if not all(MIN_AREA_MM <= size <= MAX_AREA_MM for size in sizes):
        raise click.BadParameter(
            f"the sides should be {MIN_AREA_MM} to {MAX_AREA_MM} mm long", ctx, param
        )
    return area


@click.command(cls=Command, short_help="Write poses for other tools.")
@click.argument("names", metavar="SOLUTION...", type=options.PATH, nargs=-1, required=True)
@click.option(
    "--format",
    "format_name",
    type=click.Choice((*FORMATS, *STATION_FORMATS)),
    help="Format of the output.  [default: by the ending of the output]",
)
@options.output(
    "File to write; a folder for `tum` and `kitti` with several devices; `-` writes `csv` or "
    "`tum` to stdout."
)
@options.overwrite
@section(
    "Content",
    click.option(
        "--device",
        "devices",
        multiple=True,
        metavar="NAME",
        help="Device to export. Repeatable.  [default: all]",
    ),
    click.option(
        "--onboard",
        "role",
        flag_value="onboard",
        help="Export the poses that the devices estimated themselves; SOLUTION is a session.",
    ),
    click.option(
        "--live",
        "role",
        flag_value="live",
        help="Export the poses of `locatk live`; SOLUTION is the session that it recorded.",
    ),
    click.option("--covariance", is_flag=True, help="ros2: also write poses with covariance."),
    click.option(
        "--frame",
        type=click.Choice(("level", "as-is")),
        help="crazyflie-config: `as-is` also writes a frame that is not level.  [default: level]",
    ),
    click.option(
        "--area",
        metavar="X,Y,X,Y",
        callback=_parse_area,
        help="dotbot-calibration: two opposite corners of the floor on which the robots drive, in "
        "mm in the frame of the scene.  [default: around poses and markers]",
    ),
)
@options.as_json
@options.verbosity
def command(
    names: tuple[Path, ...],
    format_name: str | None,
    output: Path,
    devices: tuple[str, ...],
    role: str | None,
    covariance: bool,
    frame: str | None,
    area: tuple[float, ...] | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the poses of SOLUTION, or its Lighthouse stations, in a format of other tools.

    SOLUTION is a solution of `locatk solve`, or a session with truth, whose truth is then exported.
    For formats of stations it may also be a scene (scene.toml). Several, also folders of solutions
    and patterns, are written to one table (csv, parquet) with a further column, `session`.

    \b
    tum      time and pose, one file per device, for evo and others; an
             unknown orientation is 0 0 0 1
    kitti    3 x 4 matrices, one file per device; times in a second file
    csv      time_s, device, x_m, y_m, z_m, qx, qy, qz, qw, sigma_x_m,
             sigma_y_m, sigma_z_m, sigma_heading_rad, probability; unknown
             values are empty
    parquet  as csv, with exact times, frames and full covariances; needs
             locatk[parquet]
    ros2     PoseStamped and TFMessage in MCAP, for ros2 bag, RViz and evo
    crazyflie-config
             poses and calibrations of stations as YAML, which the client and
             library of Bitcraze write into a Crazyflie; refused if the
             frame is not level on the floor
    dotbot-calibration
             homographies from stations to the floor (calibration.out), with
             which DotBots locate themselves

    \b
    Examples:
      locatk export solved.mcap -o poses.csv
      locatk export solved/ -o all.parquet
      locatk export solved.mcap -o poses.tum
      locatk export solved.mcap --format ros2 -o poses.mcap
      locatk export solved.mcap --format csv -o -
      locatk export solved.mcap --format crazyflie-config -o lighthouse.yaml
      locatk export scene.toml --format crazyflie-config -o lighthouse.yaml
      locatk export solved.mcap --format dotbot-calibration -o calibration.out
    """
    from locatk.core.errors import InputError
    from locatk.formats.evaluation import find_estimates
    from locatk.formats.exporters import export as exports
    from locatk.formats.sessions.solutions import read_trajectories

    if format_name is None:
        if output == STDOUT:
            raise click.UsageError("-o - needs --format csv or --format tum.")
        format_name = options.choose_format(output, None, OWN_ENDINGS)
    if covariance and format_name != "ros2":
        raise click.UsageError(
            "--covariance is for --format ros2; csv and parquet always contain it."
        )
    if output == STDOUT and (as_json or format_name not in exports.TEXTS):
        option = "--json" if as_json else f"--format {format_name}"
        raise click.UsageError(f"{option} cannot be combined with -o -, which is for csv and tum.")
    for option, value, owner in (("frame", frame, CONFIG), ("area", area, CALIBRATION)):
        if value is not None and format_name != owner:
            raise click.UsageError(f"--{option} is for --format {owner}.")
    found, is_several = find_estimates(names)
    options.must_exist(found)
    if is_several:
        if format_name not in TABLES or output == STDOUT:
            raise click.UsageError(
                f"several solutions are written to one file by --format {' or '.join(TABLES)}."
            )
        options.check_ending(output, ENDINGS[format_name])
        options.guard_output(output, overwrite=overwrite, inputs=found)
        entry = export_table(
            found, format_name, output, devices, role or "auto", overwrite=overwrite
        )
        if as_json:
            console.emit_json({"version": 1, "inputs": found, "format": format_name, **entry})
        return
    solution = found[0]
    if format_name in STATION_FORMATS:
        options.check_ending(output, ENDINGS[format_name])
        if devices or role:
            option = "--device" if devices else f"--{role}"
            raise click.UsageError(f"{option} is for poses; {format_name} contains stations.")
        options.guard_output(output, overwrite=overwrite, inputs=[solution])
        if format_name == CONFIG:
            entry = export_config(solution, output, is_as_is=frame == "as-is", overwrite=overwrite)
        else:
            entry = export_calibration(solution, output, area, overwrite=overwrite)
        if as_json:
            console.emit_json(
                {"version": 1, "input": solution, "format": format_name, "files": [entry]}
            )
        return
    tracks = select_devices(read_trajectories(solution, role or "auto"), devices, solution)
    poses = sum(map(len, tracks))
    if format_name != "parquet":  # Parquet has null for values that are not numbers.
        tracks = [exports.with_finite_poses(track) for track in tracks]
    lost = poses - sum(map(len, tracks))
    if lost == poses:
        raise InputError(f"none of the {poses} poses is a number", file=solution)
    if output == STDOUT:
        console.emit_file(render(tracks, format_name))
        warn_of_orientations(tracks, format_name)
        check_loss(lost)
        return

    planned = exports.plan_files(tracks, format_name, output)
    files = [path for part in planned for path in part.files]
    if planned[0].path == output:
        for path in files:
            options.guard_output(path, overwrite=overwrite, inputs=[solution])
        options.check_ending(output, ENDINGS[format_name])
    facts = exports.read_origin(solution)
    if planned[0].path != output:
        options.prepare_folder(output, files, overwrite=overwrite, inputs=[solution])
    for part in planned:
        exports.write(part, format_name, facts=facts, covariance=covariance, overwrite=overwrite)
        console.result(f"Wrote {part.path}: {sum(map(len, part.trajectories))} poses")
    if format_name == "kitti":
        name = planned[0].times if len(planned) == 1 else f"{output}/*.times.txt"
        console.say(f"KITTI files have no times: the times are in {name}")
    warn_of_orientations(tracks, format_name)
    if format_name == "ros2" and not output.suffix:
        console.warn(f"{output} does not end in .mcap, which ros2 bag and evo require")
    if as_json:
        listed = [
            {"path": part.path, "device": each.device, "poses": len(each), "times": part.times}
            for part in planned
            for each in part.trajectories
        ]
        console.emit_json({"version": 1, "input": solution, "format": format_name, "files": listed})
    check_loss(lost)


def export_table(
    found: Sequence[Path],
    format_name: str,
    output: Path,
    devices: tuple[str, ...],
    role: str,
    *,
    overwrite: bool,
) -> dict[str, Any]:
    """Write the poses of several files to one table; returns the file for ``--json``."""
    from locatk.core.errors import InputError
    from locatk.formats.evaluation import base_name
    from locatk.formats.exporters.export import with_finite_poses
    from locatk.formats.exporters.parquet import write_parquet
    from locatk.formats.exporters.trajectory_csv import write_csv
    from locatk.formats.sessions.solutions import read_trajectories

    labels = [base_name(path) for path in found]
    if len(set(labels)) < len(labels):
        labels = [str(path) for path in found]
    tracks: list[Trajectory] = []
    sessions, lost = [], 0
    with console.progress(found, "Reading") as items:
        for path, label in zip(items, labels, strict=True):
            for track in read_trajectories(path, role):
                if devices and track.device not in devices:
                    continue
                kept = track if format_name == "parquet" else with_finite_poses(track)
                lost += len(track) - len(kept)
                tracks.append(kept)
                sessions.append(label)
    if not tracks:
        raise InputError(f"no file has poses of {', '.join(devices)}")
    write = write_parquet if format_name == "parquet" else write_csv
    write(output, tracks, sessions=sessions, overwrite=overwrite)
    poses = sum(map(len, tracks))
    console.result(f"Wrote {output}: {poses} poses of {len(found)} files")
    check_loss(lost)
    return {"files": [{"path": output, "poses": poses}]}


def export_config(source: Path, output: Path, *, is_as_is: bool, overwrite: bool) -> dict[str, Any]:
    """Write the stations of a scene, a session or a solution; returns the file for ``--json``."""
    from locatk.core.errors import error_context
    from locatk.formats.exporters import crazyflie

    scene = read_any_scene(source)
    with error_context(source):
        crazyflie.write_config(output, scene, allow_tilted=is_as_is, overwrite=overwrite)
    if fault := crazyflie.describe_frame_fault(scene):
        console.warn(f"not for flight: {fault}")
    channels = [station.channel for station in scene.stations]
    console.result(f"Wrote {output}: {list_stations(channels)}")
    return {"path": output, "channels": channels}


def export_calibration(
    source: Path, output: Path, area: tuple[float, ...] | None, *, overwrite: bool
) -> dict[str, Any]:
    """Write the homographies of stations to the floor; returns the file for ``--json``."""
    from locatk.core.errors import error_context
    from locatk.formats.exporters import dotbot_calibration as dotbot
    from locatk.formats.sessions.solutions import read_trajectories

    scene = read_any_scene(source)
    tracks = [] if source.suffix.lower() == ".toml" else read_trajectories(source)
    with error_context(source):
        calibration = dotbot.build_calibration(scene, tracks, area_mm=area)
    dotbot.write_calibration(output, calibration, overwrite=overwrite)
    channels = [station.channel for station in calibration.stations]
    console.result(f"Wrote {output}: {list_stations(channels)}")
    for station in calibration.stations:
        console.result(
            f"  channel {station.channel}: sees {station.visible_fraction:.0%} of the floor; "
            f"DotBot error {station.rms_mm:.1f} mm rms, up to {station.max_mm:.1f} mm"
        )
    low_x, low_y, high_x, high_y = calibration.area_mm
    origin_x, origin_y = calibration.origin_mm
    console.result(f"Floor: x {low_x:.0f} to {high_x:.0f}, y {low_y:.0f} to {high_y:.0f} mm")
    console.result(f"A DotBot at (x, y) reports (x {0 - origin_x:+.0f}, {origin_y:.0f} - y) mm")
    for station in calibration.stations:
        if station.rms_mm > dotbot.MAX_USEFUL_ERROR_MM:
            console.warn(
                f"one homography is not enough for this floor and channel {station.channel}: "
                "choose a smaller --area, or a station that is nearer to it"
            )
    for channel in calibration.hidden_channels:
        console.warn(f"the station on channel {channel} sees too little of the floor: left out")
    for channel in channels:
        if channel in dotbot.UNCERTAIN_CHANNELS:
            console.warn(
                f"versions of the DotBot's firmware differ in the period of channel {channel}: "
                "check a position, or use another channel"
            )
    return {
        "path": output,
        "channels": channels,
        "area_mm": calibration.area_mm,
        "origin_mm": calibration.origin_mm,
        "stations": [
            {
                "channel": station.channel,
                "visible_fraction": station.visible_fraction,
                "rms_mm": station.rms_mm,
                "max_mm": station.max_mm,
            }
            for station in calibration.stations
        ],
    }


def list_stations(channels: list[int]) -> str:
    """Return the number of stations and their channels."""
    count, s = ("1 station", "") if len(channels) == 1 else (f"{len(channels)} stations", "s")
    return f"{count}, channel{s} {', '.join(map(str, channels))}"


def read_any_scene(source: Path) -> Scene:
    """Read a scene, or the scene in a session or a solution."""
    from locatk.core.errors import InputError
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.sessions.reader import Session

    if source.suffix.lower() == ".toml":
        return artifacts.read_scene(source)
    scene = artifacts.attached_scene(Session.open(source))
    if scene is None:
        raise InputError(
            "the file has no lighthouse scene",
            file=source,
            hint="Give a solution of `locatk solve`, or a scene (scene.toml)",
        )
    return scene


def check_loss(lost: int) -> None:
    """Raise Incomplete if poses were left out."""
    if lost:
        poses = "1 pose that is not a number" if lost == 1 else f"{lost} poses that are not numbers"
        raise failures.Incomplete(f"left out {poses}")


def warn_of_orientations(tracks: list[Trajectory], format_name: str) -> None:
    """Warn about unknown orientations that a format cannot represent."""
    from locatk.core.trajectory import has_orientation

    devices = [track.device for track in tracks if not has_orientation(track).all()]
    if devices and format_name in ("tum", "kitti", "ros2"):
        console.warn(
            f"the orientation of {', '.join(devices)} is unknown; {format_name} has no value for "
            "it, so that the identity was written"
        )


def select_devices(
    tracks: list[Trajectory], devices: tuple[str, ...], solution: Path
) -> list[Trajectory]:
    """Return the trajectories of these devices, or all if none is named."""
    from locatk.core.errors import InputError

    names = [track.device for track in tracks]
    for device in devices:
        if device not in names:
            raise InputError(
                f"no device {device!r}", file=solution, hint=f"The devices are {', '.join(names)}"
            )
    return [track for track in tracks if not devices or track.device in devices]


def render(tracks: list[Trajectory], format_name: str) -> bytes:
    """Return the content of the output file."""
    from locatk.core.errors import InputError
    from locatk.formats.exporters import export as exports

    if format_name in exports.ENDINGS and len(tracks) > 1:
        raise InputError(
            f"{len(tracks)} devices, but a {format_name} file has one",
            hint="Name one with --device, or a folder with -o",
        )
    with TemporaryDirectory(prefix="locatk-export-") as folder:
        path = Path(folder) / "poses"
        exports.write(exports.OutputFile(path, tuple(tracks)), format_name)
        return path.read_bytes()
