"""``locatk simulate landmarks``: what hall sensors and odometry would tell on a floor."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.simulate_options import ABOVE_0, ANY, FROM_0, SHARE, in_si
from locatk.core.errors import FormatError

if TYPE_CHECKING:
    from locatk.core.landmarks.simulation.session import SimulatedSession, SimulationOptions


MOST_TOLD = 12
"""Landmarks of a way that are named."""


class Form(click.ParamType):
    """Text of a fixed form, as in ``2,3:1``."""

    def __init__(self, name: str, example: str, read: Callable[[str], Any]) -> None:
        self.name, self._example, self._read = name, example, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return self._read(value)
        except ValueError:
            self.fail(f"{value!r} is not {self.name}, as in {self._example}", param, ctx)


def _cell(text: str) -> tuple[int, int]:
    row, column = map(int, text.split(","))
    return row, column


def _bar(text: str) -> tuple[tuple[int, int], int]:
    cell, bar = text.split(":")
    return _cell(cell), int(bar)


def _shift(text: str) -> tuple[tuple[int, int], tuple[float, float]]:
    cell, shift = text.split(":")
    dx, dy = map(float, shift.split(","))
    return _cell(cell), (dx * 1e-3, dy * 1e-3)


def _names(text: str) -> tuple[str, str]:
    one, other = text.split(":")
    return one, other


def _pose(text: str) -> tuple[float, float, float]:
    x, y, heading = map(float, text.split(","))
    return x * 1e-3, y * 1e-3, math.radians(heading)


CELL = Form("ROW,COLUMN", "2,3", _cell)
BAR = Form("ROW,COLUMN:BAR", "2,3:0", _bar)
SHIFT = Form("ROW,COLUMN:DX,DY", "2,3:4,-1.5", _shift)
NAMES = Form("NAME:NAME", "front:left", _names)
POSE = Form("X,Y,DEG", "120,80,45", _pose)


@click.command(short_help="A robot with four hall sensors on a floor of landmarks.")
@options.input_argument("map_file")
@options.output("Session to write (.mcap), with the truth in it.")
@click.option(
    "--strategy", type=click.Choice(("paper", "published", "path", "pass")), default="paper",
    show_default=True,
    help="Search a landmark, spin, and go on to its neighbours, steered by the truth; the same "
    "by the estimates of the published method; follow a --path or some --cell; or pass one "
    "landmark straight.",
)  # fmt: skip
@click.option("--start", type=POSE, help="In mm of the map.  [default: anywhere between landmarks]")
@click.option("--landmarks", type=click.IntRange(1), metavar="N",
              help="How many to visit.  [default: those of the map's window]")  # fmt: skip
@click.option("--spins", type=click.IntRange(0), metavar="N",
              help="At how many of them to spin.  [default: those of the map's window]",
)  # fmt: skip
@options.input_option("--path", "path_file", metavar="CSV", help="Waypoints: x_mm,y_mm.")
@click.option("--cell", "cells", type=CELL, multiple=True,
              help="Of a path, in this order; or the one to pass.")  # fmt: skip
@click.option("--pattern", metavar="NNNS", help="Pass a landmark of this pattern.")
@click.option("--lateral", "lateral_mm", type=ANY, metavar="MM",
              help="How far left of its centre.  [default: within 45 degrees of it]")  # fmt: skip
@click.option("--approach", "approach_deg", type=ANY, metavar="DEG",
              help="Where around it a pass starts.  [default: anywhere]")  # fmt: skip
@click.option("--speed", "speed_mps", type=ABOVE_0, metavar="M/S", help="[default: 0.1]")
@click.option("--acceleration", "acceleration_mps2", type=ABOVE_0, metavar="M/S2",
              help="[default: 0.3]")  # fmt: skip
@click.option("--turn-rate", "turn_dps", type=ABOVE_0, metavar="DEG/S", help="[default: 90]")
@click.option("--turn-acceleration", "turn_dps2", type=ABOVE_0, metavar="DEG/S2",
              help="[default: 360]")  # fmt: skip
@click.option("--rest", "rest_s", type=FROM_0, metavar="SECONDS",
              help="Standing at the start and the end.  [default: 0.5]")  # fmt: skip
@click.option("--stop", "stop_s", type=FROM_0, metavar="SECONDS",
              help="Standing on each landmark.  [default: 0.5]")  # fmt: skip
@click.option("--aim-first", "first_mm", type=FROM_0, metavar="MM",
              help="By how much it misses the centre on average after the first pass.  "
              "[default: 7]")  # fmt: skip
@click.option("--aim-second", "second_mm", type=FROM_0, metavar="MM",
              help="The same after a spin.  [default: 2]")  # fmt: skip
@click.option("--aim-step", "step_mm", type=FROM_0, metavar="MM",
              help="The same from landmark to landmark, and of a path.  [default: 3]",
)  # fmt: skip
@click.option("--aim-heading", "heading_deg", type=FROM_0, metavar="DEG",
              help="Standard deviation of its heading when aligned.  [default: 1]")  # fmt: skip
@click.option("--rate", "rate_hz", type=ABOVE_0, metavar="HZ", help="[default: 200]")
@click.option("--odometry-rate", "odometry_hz", type=ABOVE_0, metavar="HZ", help="[default: 50]")
@options.input_option("--sensors", "sensors_file", metavar="FILE",
                      help="Other hall sensors (halls.toml).")  # fmt: skip
@click.option("--range", "range_mt", type=ABOVE_0, metavar="MT",
              help="Greatest field that they tell.  [default: any]")  # fmt: skip
@click.option("--quantum", "quantum_mt", type=FROM_0, metavar="MT",
              help="Least step of a reading.  [default: 0]")  # fmt: skip
@click.option("--errors", "factor", type=FROM_0, default=1.0, show_default=True, metavar="FACTOR",
              help="On the defaults of all errors from here on; 0 for none.")  # fmt: skip
@click.option("--noise", "noise_mt", type=FROM_0, metavar="MT",
              help="Standard deviation of a sample.  [default: 0.15]")  # fmt: skip
@click.option("--offset", "offset_mt", type=FROM_0, metavar="MT",
              help="Of the sensors.  [default: 0.1]")  # fmt: skip
@click.option("--gain", type=FROM_0, metavar="SHARE", help="Of the sensors.  [default: 0.03]")
@click.option("--earth", "earth_ut", type=ANY, metavar="UT",
              help="The Earth's upright field, upward positive.  [default: -45]")  # fmt: skip
@click.option("--height", "height_mm", type=ANY, metavar="MM",
              help="By how much the sensors are too high.  [default: 0]")  # fmt: skip
@click.option("--bar-strength", type=click.FloatRange(0, 0.2), metavar="SHARE",
              help="[default: 0.04]")  # fmt: skip
@click.option("--bar-place", "bar_place_mm", type=FROM_0, metavar="MM", help="[default: 0.5]")
@click.option("--bar-turn", "bar_turn_deg", type=FROM_0, metavar="DEG",
              help="About the upright.  [default: 0]")  # fmt: skip
@click.option("--bar-lean", "bar_lean_deg", type=FROM_0, metavar="DEG", help="[default: 0]")
@click.option("--landmark-place", "landmark_place_mm", type=FROM_0, metavar="MM",
              help="[default: 1]")  # fmt: skip
@click.option("--landmark-turn", "landmark_turn_deg", type=FROM_0, metavar="DEG",
              help="[default: 0.5]")  # fmt: skip
@click.option("--odometry-scale", type=click.FloatRange(0, 0.2), metavar="SHARE",
              help="Of its way.  [default: 0.01]")  # fmt: skip
@click.option("--odometry-turn", type=click.FloatRange(0, 0.2), metavar="SHARE",
              help="Of its turns.  [default: 0.01]")  # fmt: skip
@click.option("--odometry-drift", "odometry_drift_deg_per_m", type=FROM_0, metavar="DEG/M",
              help="Of its heading.  [default: 4.3, a degree a pass]")  # fmt: skip
@click.option("--wheel-noise", "wheel_noise_mm", type=FROM_0, metavar="MM",
              help="Of a wheel on a metre.  [default: 0.2]")  # fmt: skip
@click.option("--slips", "slips_per_m", type=FROM_0, metavar="N",
              help="How often a wheel slips on a metre.  [default: 0]")  # fmt: skip
@click.option("--slip", "slip_mm", type=FROM_0, metavar="MM", help="How far.  [default: 5]")
@click.option("--flip", "flipped", type=BAR, multiple=True,
              help="A bar that lies the wrong way round.")  # fmt: skip
@click.option("--missing", type=BAR, multiple=True, help="A bar that is not there.")
@click.option("--displace", "displaced", type=SHIFT, multiple=True,
              help="A landmark that lies elsewhere, by mm.")  # fmt: skip
@click.option("--misread-rate", type=SHARE, metavar="SHARE",
              help="Chance of a landmark to be laid as another one.")  # fmt: skip
@click.option("--dead", multiple=True, metavar="NAME", help="A sensor that gives nothing.")
@click.option("--stuck", multiple=True, metavar="NAME", help="Or always the same.")
@click.option("--swap", "swapped", type=NAMES, multiple=True, help="Sensors wired wrongly.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option(
    "--floor-seed",
    type=click.IntRange(0),
    help="Of how the bars lie: the same for several drives over one floor. [default: --seed]",
)
@options.overwrite
@options.as_json
@options.verbosity
def command(map_file: Path, output: Path, overwrite: bool, as_json: bool, **given: Any) -> None:
    """Simulate a robot that drives over the landmarks of MAP_FILE (map.toml).

    Each bar is a cuboid magnet of its own strength and place; the robot is a differential
    drive whose wheels err. It steers by the truth and by the errors of its aims, or, with
    --strategy published, by its sensors and odometry alone. Errors are
    standard deviations. The session holds samples, odometry, the map as designed, and as
    truth where the robot was; what is wrong with the floor is in its facts alone. The same
    options and seed give the same session.

    \b
    Examples:
      locatk simulate landmarks map.toml -o run.mcap
      locatk simulate landmarks map.toml -o tour.mcap --landmarks 12 --seed 3
      locatk simulate landmarks map.toml -o own.mcap --strategy published
      locatk simulate landmarks map.toml -o path.mcap --strategy path --path way.csv
      locatk simulate landmarks map.toml -o pass.mcap --strategy pass --cell 2,3 --lateral 20
      locatk simulate landmarks map.toml -o bad.mcap --flip 2,3:1 --range 20 --swap left:right
    """
    from locatk.core.landmarks.published.driver import published_driver
    from locatk.core.landmarks.simulation import session as simulate
    from locatk.formats import halls, maps

    files = [given[name] for name in ("path_file", "sensors_file") if given[name]]
    options.guard_output(output, overwrite=overwrite, inputs=[map_file, *files])
    floor = maps.read_map(map_file)
    wanted = _wanted(given)
    with console.working("Simulating"):
        driver = published_driver(floor, wanted) if wanted.strategy == "published" else None
        simulated = simulate.simulate(floor, wanted, driver)
        warnings = _warnings(simulated)
        halls.write_session(
            output,
            simulated.samples,
            floor=floor,
            truth=simulated.truth,
            odometry=simulated.odometry,
            facts=_facts(simulated, wanted),
            warnings=warnings,
            overwrite=overwrite,
        )
    for line in warnings:
        console.warn(line)
    told = _told(simulated)
    tour = [f"{row},{column}" for row, column in _tour(simulated)]
    more = f" and {len(tour) - MOST_TOLD} more" if len(tour) > MOST_TOLD else ""
    visited = " ".join(tour[:MOST_TOLD]) + more
    console.result(
        f"Wrote {output}: {told['samples']} samples of {told['device']}, over "
        f"{'landmarks ' + visited if visited else 'no landmark'}, "
        f"{told['truth_poses']} truth poses"
    )
    if as_json:
        console.emit_json({"version": 1, "output": output, **told})


def _wanted(given: dict[str, Any]) -> SimulationOptions:
    """The simulation's options, of what was said on the command line."""
    from dataclasses import fields, replace

    from locatk.core.landmarks.simulation import session as simulate
    from locatk.formats import maps

    said = in_si(given)
    parts: dict[str, Any] = {
        "errors": simulate.Errors().scaled(said.pop("factor")),
        "faults": simulate.Faults(),
        "limits": simulate.RobotLimits(),
        "aims": simulate.Aims(),
    }
    for part, usual in parts.items():
        own = {item.name: said.pop(item.name) for item in fields(usual) if item.name in said}
        parts[part] = replace(usual, **own)
    if file := said.pop("path_file", None):
        said["waypoints"] = _waypoints(file)
    if file := said.pop("sensors_file", None):
        if "range_t" in said:
            raise click.UsageError("--sensors have a range of their own.")
        said["sensors"] = maps.read_halls(file)
    strategy = said["strategy"]
    searches = "paper" if strategy != "published" else strategy
    for name, option, of in (
        ("start", "--start", searches),
        ("landmarks", "--landmarks", searches),
        ("spins", "--spins", "paper"),
        ("waypoints", "--path", "path"),
        ("pattern", "--pattern", "pass"),
        ("lateral_m", "--lateral", "pass"),
        ("approach_rad", "--approach", "pass"),
    ):
        if name in said and strategy != of:
            raise click.UsageError(f"{option} is of --strategy {of}.")
    cells = said.pop("cells", ())
    if strategy == "path":
        if bool(cells) == ("waypoints" in said):
            raise click.UsageError("A path takes --path or --cell, twice or more.")
        said["cells"] = cells
    elif cells:
        if strategy != "pass" or len(cells) > 1:
            raise click.UsageError("One --cell is for a pass, several for a path.")
        (said["cell"],) = cells
    return simulate.SimulationOptions(**said, **parts)


def _waypoints(file: Path) -> tuple[tuple[float, float], ...]:
    """Places of a CSV with the columns ``x_mm,y_mm``, in metres."""
    import csv

    from locatk.formats.files import read_text

    rows = csv.reader(read_text(file).removeprefix("\ufeff").splitlines())
    head = [name.strip() for name in next(rows, [])]
    if not {"x_mm", "y_mm"} <= set(head):
        raise FormatError(
            "no columns x_mm and y_mm", file=file, where=1, hint="Name them in the first line"
        )
    places = []
    for row in rows:
        if not "".join(row).strip():
            continue
        try:
            x, y = (float(row[head.index(name)]) * 1e-3 for name in ("x_mm", "y_mm"))
        except (ValueError, IndexError):
            raise FormatError(
                "a waypoint is not two numbers", file=file, where=rows.line_num
            ) from None
        places.append((x, y))
    return tuple(places)


def _warnings(simulated: SimulatedSession) -> list[str]:
    """What a user may not have meant."""
    lines = list(simulated.notes)
    if simulated.saturated:
        lines.append(f"{simulated.saturated} readings are at the end of the sensors' range")
    if not simulated.events:
        lines.append("the robot passes over no landmark")
    return lines


def _tour(simulated: SimulatedSession) -> list[tuple[int, int]]:
    """Cells in the order of their visits, each once in a row."""
    cells = [visit.cell for visit in simulated.events]
    return [cell for k, cell in enumerate(cells) if k == 0 or cell != cells[k - 1]]


def _told(simulated: SimulatedSession) -> dict[str, Any]:
    """What was simulated, for ``--json``."""
    return {
        "samples": len(simulated.samples[0]),
        "device": simulated.samples[0].device,
        "frame": simulated.truth[0].frame,
        "visits": _visits(simulated),
        **({"approaches": _approaches(simulated)} if simulated.approaches else {}),
        "faults": [
            {"cell": list(mark.cell), "faults": list(mark.faults)}
            for mark in simulated.floor_as_laid
            if mark.faults
        ],
        "saturated": simulated.saturated,
        "slips_s": [time_ns / 1e9 for time_ns in simulated.slips],
        "odometry_poses": len(simulated.odometry[0]),
        "truth_poses": len(simulated.truth[0]),
    }


def _visits(simulated: SimulatedSession) -> list[dict[str, Any]]:
    return [
        {
            "cell": list(visit.cell),
            "first_s": visit.first_ns / 1e9,
            "last_s": visit.last_ns / 1e9,
            "nearest_s": visit.nearest_ns / 1e9,
            "nearest_m": visit.nearest_m,
        }
        for visit in simulated.events
    ]


def _approaches(simulated: SimulatedSession) -> list[dict[str, Any]]:
    """Outcomes of the strategy published."""
    return [
        {
            "cell": list(approach.cell),
            "time_s": approach.time_ns / 1e9,
            "outcome": approach.outcome,
            "searched": approach.searched,
            "spins": approach.spins,
            "distance_m": approach.distance_m,
        }
        for approach in simulated.approaches
    ]


def _facts(simulated: SimulatedSession, wanted: SimulationOptions) -> dict[str, str]:
    """The options, and what else is true: the visits, and the landmarks as they lie.

    Of landmarks those are told that were visited or are wrong; a floor has thousands.
    """
    from dataclasses import asdict, fields

    from locatk.core.landmarks import landmark

    said = {}
    for item in fields(wanted):
        value = getattr(wanted, item.name)
        if item.name in ("errors", "faults", "aims", "limits"):
            said[f"simulated_{item.name}"] = json.dumps(asdict(value))
        elif item.name != "sensors":
            said[f"simulated_{item.name}"] = str(value)
    visited = {visit.cell for visit in simulated.events}
    said["simulated_visits"] = json.dumps(_visits(simulated))
    if simulated.approaches:
        said["simulated_approaches"] = json.dumps(_approaches(simulated))
    said["simulated_floor"] = json.dumps(
        [
            {
                "cell": list(mark.cell),
                "code": landmark.name(mark.code),
                "x_m": mark.x_m,
                "y_m": mark.y_m,
                "heading_rad": mark.heading_rad,
                "strength": mark.strength.tolist(),
                "faults": list(mark.faults),
            }
            for mark in simulated.floor_as_laid
            if mark.faults or mark.cell in visited
        ]
    )
    return said
