"""What `locatk import` is told of Lighthouse on the command line, and what it does."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.command import combine
from locatk.cli.info import lighthouse as info_lighthouse

if TYPE_CHECKING:
    from locatk.core.lighthouse.recording import StationReport
    from locatk.formats.importers.lighthouse import ImportedSession

DOTBOT = ("truth", "calibration")
SALEAE = ("channel", "method", "device")
LIBSURVIVE = ("stations",)
"""Options of the formats, by the names of their arguments."""

NAMES = {"channel": "channels"}
"""Options that readers call by another name."""

SCENE_KEYS = ("channel", "id", "period_ticks", "calibration", "position_m")

LONGEST_NAME = 64


def _device_name(ctx: click.Context, option: click.Parameter, name: str | None) -> str | None:
    """A name that a topic can have and a terminal can show."""
    if name is not None and not (0 < len(name.strip()) <= LONGEST_NAME and name.isprintable()):
        raise click.BadParameter(f"expected a name of 1 to {LONGEST_NAME} printable characters")
    return name


lighthouse_options = combine(
    options.input_option(
        "--truth",
        many=True,
        metavar="PATH",
        help="dotbot-lh2: reference to store beside the data: pixel tracks from Blender. "
        "Repeatable. Grid columns in the data itself are taken unasked.",
    ),
    options.input_option(
        "--calibration",
        metavar="PATH",
        help="dotbot-lh2: camera or marker calibration (calibration.json), where it is not beside "
        "the truth.",
    ),
    click.option(
        "--channel",
        type=click.IntRange(0, 255),
        multiple=True,
        metavar="N",
        help="saleae: channel of the analyser, from 0, that holds a photodiode's data line. "
        "Repeatable, sensor 0 first. [default: those with light]",
    ),
    click.option(
        "--method",
        type=click.Choice(("soft", "paper")),
        help="saleae: how bits are read: `soft` weighs the whole burst, `paper` is the published "
        "way as written. [default: soft]",
    ),
    click.option(
        "--device",
        metavar="NAME",
        callback=_device_name,
        help="saleae: of the device in the session. [default: photodiode]",
    ),
    click.option(
        "--stations",
        is_flag=True,
        default=None,
        help="libsurvive: take the poses of the stations from the recording, too; else "
        "`locatk solve` finds its own.",
    ),
)


def import_sweeps(
    read: Any,
    paths: tuple[Path, ...],
    output: Path,
    given: dict[str, Any],
    overwrite: bool,
) -> tuple[dict[str, Any], str | None]:
    """Import sweeps; returns what ``--json`` says of them, and what was lost.

    ``given`` holds the options that were given, by the names of their arguments.
    """
    from locatk.formats.sessions import observations

    with console.working("Reading"):
        imported: ImportedSession = read(list(paths), **_arguments(paths, given))
        observations.write_session(
            output,
            system="lighthouse",
            sweeps=imported.sweeps,
            scene=imported.scene,
            truth=imported.truth,
            facts=imported.facts,
            stations=imported.stations,
            receivers=imported.receivers,
            overwrite=overwrite,
        )
    sweeps, stations = imported.sweeps, _stations(imported.stations)
    truth_poses = sum(map(len, imported.truth))
    console.say(
        f"{len(sweeps)} sweeps of {_some(sweeps.devices)}"
        + (f", {truth_poses} truth poses" if truth_poses else "")
    )
    if stations:
        console.say(console.table(*info_lighthouse.station_table(stations)))
    answer = {
        "sweeps": len(sweeps),
        "devices": list(sweeps.devices),
        "truth_poses": truth_poses,
        "stations": [{**each, "id": info_lighthouse.hexadecimal(each["id"])} for each in stations],
        "warnings": imported.warnings,
    }
    return answer, imported.lost


def import_scene(
    read: Any, path: Path, output: Path, overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import the stations of another tool's configuration as ``scene.toml``; returns as
    :func:`import_sweeps`."""
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.sessions import lighthouse_description

    if output.suffix.lower() != ".toml":
        raise click.UsageError(
            f"-o {output}: what comes out is a scene, whose name ends in .toml (scene.toml)."
        )
    scene = read(path)
    artifacts.write_scene(output, scene, overwrite=overwrite)
    found = lighthouse_description.scene(scene)
    stations = [{key: each[key] for key in SCENE_KEYS} for each in found["stations"]]
    warnings = list(scene.notes)
    if stations:
        table = info_lighthouse.station_table(found["stations"], found["scale"])
        console.say(console.table(*table))
    else:
        warnings.append(f"{path} holds no station")
    answer = {
        "stations": [{**each, "id": info_lighthouse.hexadecimal(each["id"])} for each in stations],
        "scale": found["scale"],
        "warnings": warnings,
    }
    return answer, None


def _arguments(paths: tuple[Path, ...], given: dict[str, Any]) -> dict[str, Any]:
    """Keywords of a reader; what is not given is left to it."""
    named = {NAMES.get(name, name): value for name, value in given.items()}
    if "truth" in named:
        # A recording named as its own reference means its own columns, which are read anyway.
        named["truth"] = [
            path for path in named["truth"] if not any(path.samefile(other) for other in paths)
        ]
    return named


def _some(devices: Sequence[str], most: int = 8) -> str:
    """Devices for people: how many, and the names of some."""
    names = ", ".join([*devices[:most], "..."] if len(devices) > most else devices)
    return f"{len(devices)} device{'s' * (len(devices) != 1)} ({names})"


def _stations(heard: Sequence[StationReport]) -> list[dict[str, Any]]:
    from locatk.formats.sessions import lighthouse_description

    return [lighthouse_description.station(station, station.channel) for station in heard]
