"""Import of Lighthouse recordings as sessions, and of configurations as scenes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import combine, section
from locatk.cli.info import lighthouse as info_lighthouse

DOTBOT = ("truth", "calibration")
SALEAE = ("channel", "method", "device")
LIBSURVIVE = ("stations",)
CRAZYFLIE = ("config", "stations", "receiver", "mounting", "device")
CRAZYFLIE_USD = (*CRAZYFLIE, "sweeps")
"""Options of the formats, by the names of their arguments."""

READER_ARGUMENTS = {"channel": "channels"}
"""Arguments of the readers whose names differ from those of the options."""

SCENE_KEYS = ("channel", "id", "period_ticks", "calibration", "position_m")

MAX_NAME_CHARACTERS = 64

MAX_LISTED_DEVICES = 8

MAX_MOUNTING = 10_000.0
"""Largest number of --mounting: 10 m, which only mistakes exceed."""


def _check_device_name(ctx: click.Context, option: click.Parameter, name: str | None) -> str | None:
    """Refuse a name that is not suitable for a topic and a terminal; a click callback."""
    if name is not None and not (
        0 < len(name.strip()) <= MAX_NAME_CHARACTERS and name.isprintable()
    ):
        raise click.BadParameter(
            f"expected a name of 1 to {MAX_NAME_CHARACTERS} printable characters"
        )
    return name


class Mounting(click.ParamType):
    """Position [mm] and rotation about z [deg] of a receiver on a device, as text."""

    name = "mounting"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Return x, y, z and yaw."""
        try:
            numbers = [float(word) for word in value.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (3, 4) or not all(abs(number) <= MAX_MOUNTING for number in numbers):
            self.fail(f"{value!r} is not three numbers x,y,z [mm], or four with yaw [deg].")
        return tuple([*numbers, 0.0][:4])


lighthouse_options = combine(
    section(
        "For dotbot-lh2",
        options.input_option(
            "--truth",
            many=True,
            metavar="PATH",
            help="Reference to store with the data: pixel tracks from Blender. Repeatable. Grid "
            "columns of the data itself are always imported.",
        ),
        options.input_option(
            "--calibration",
            metavar="PATH",
            help="Camera or marker calibration (calibration.json).  [default: the one in the "
            "folder of the truth or of the data]",
        ),
    ),
    section(
        "For crazyflie-usd and crazyflie-csv",
        options.input_option(
            "--config",
            metavar="FILE",
            help="Configuration of the Crazyflie (YAML) with the calibrations of the stations; "
            "needs locatk[yaml].",
        ),
        click.option(
            "--receiver",
            metavar="NAME|FILE",
            help="Layout of the photodiodes: deck, bolt, or a receiver.toml.  [default: deck, for "
            "table none]",
        ),
        click.option(
            "--mounting",
            type=Mounting(),
            metavar="X,Y,Z[,YAW]",
            help="Position of the receiver in the axes of the device (x forward, y left, z up) "
            "[mm], and its rotation about z [deg].  [default: 0,0,0,0]",
        ),
        click.option(
            "--sweeps",
            type=click.Choice(("uart", "lhangle", "estimator")),
            help="crazyflie-usd: events with the sweeps, lhUartFrame, lhAngle or estSweepAngle.  "
            "[default: the first of these in the log]",
        ),
    ),
    section(
        "For saleae",
        click.option(
            "--channel",
            type=click.IntRange(0, 255),
            multiple=True,
            metavar="N",
            help="Channel of the analyser, from 0, with the data line of a photodiode. Repeatable, "
            "sensor 0 first.  [default: those with light]",
        ),
        click.option(
            "--method",
            type=click.Choice(("soft", "paper")),
            help="Decoding of bits: `soft` uses soft decisions on the whole burst, `paper` is the "
            "published method.  [default: soft]",
        ),
        click.option(
            "--device",
            metavar="NAME",
            callback=_check_device_name,
            help="Name of the device in the session, also of a Crazyflie.  [default: photodiode "
            "or crazyflie]",
        ),
    ),
    section(
        "For libsurvive",
        click.option(
            "--stations",
            is_flag=True,
            default=None,
            help="Import the poses of the stations, too; for a Crazyflie those of --config. "
            "Otherwise `locatk solve` estimates them.",
        ),
    ),
)


def import_sweeps(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import sweeps; returns the results for ``--json`` and a summary of the losses."""
    from locatk.formats.descriptions.lighthouse import describe_station
    from locatk.formats.sessions import observations

    with console.working("Reading"):
        imported = reader(list(paths), **_reader_arguments(paths, given))
        observations.write_session(
            output,
            system="lighthouse",
            sweeps=imported.sweeps,
            scene=imported.scene,
            truth=imported.truth,
            facts=imported.facts,
            stations=imported.stations,
            receivers=imported.receivers,
            imu=imported.imu,
            onboard=imported.onboard,
            overwrite=overwrite,
        )
    sweeps = imported.sweeps
    stations = [describe_station(report, report.channel) for report in imported.stations]
    truth_poses = sum(map(len, imported.truth))
    truth = f", {truth_poses} truth poses" if truth_poses else ""
    counts = {
        "imu_samples": sum(map(len, imported.imu)),
        "onboard_poses": sum(map(len, imported.onboard)),
    }
    extras = "".join(
        f", {count} {noun}"
        for count, noun in zip(
            counts.values(), ("samples of the IMU", "on-board poses"), strict=True
        )
        if count
    )
    console.say(f"{len(sweeps)} sweeps of {_device_list(sweeps.devices)}{truth}{extras}")
    if stations:
        console.say(console.table(*info_lighthouse.station_table(stations)))
    results = {
        "sweeps": len(sweeps),
        "devices": list(sweeps.devices),
        "truth_poses": truth_poses,
        **counts,
        "stations": [{**each, "id": info_lighthouse.hexadecimal(each["id"])} for each in stations],
        "warnings": imported.warnings,
    }
    return results, imported.lost


def import_scene(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import the stations of a configuration as ``scene.toml``; returns as `import_sweeps`."""
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.descriptions.lighthouse import describe_scene

    scene = reader(paths[0])
    artifacts.write_scene(output, scene, overwrite=overwrite)
    description = describe_scene(scene)
    stations = [{key: each[key] for key in SCENE_KEYS} for each in description["stations"]]
    warnings = list(scene.notes)
    if stations:
        table = info_lighthouse.station_table(description["stations"], description["scale"])
        console.say(console.table(*table))
    else:
        warnings.append(f"{paths[0]} has no station")
    results = {
        "stations": [{**each, "id": info_lighthouse.hexadecimal(each["id"])} for each in stations],
        "scale": description["scale"],
        "warnings": warnings,
    }
    return results, None


def _reader_arguments(paths: tuple[Path, ...], given: dict[str, Any]) -> dict[str, Any]:
    """Return the given options as arguments of a reader, which has its own defaults."""
    arguments = {READER_ARGUMENTS.get(name, name): value for name, value in given.items()}
    if "truth" in arguments:
        # A recording given as its own reference means its own columns, which are always read.
        arguments["truth"] = [
            path for path in given["truth"] if not any(path.samefile(other) for other in paths)
        ]
    return arguments


def _device_list(devices: Sequence[str]) -> str:
    """Return the number of devices and the names of the first."""
    more = ["..."] if len(devices) > MAX_LISTED_DEVICES else []
    names = ", ".join([*devices[:MAX_LISTED_DEVICES], *more])
    return f"{len(devices)} device{'s' * (len(devices) != 1)} ({names})"
