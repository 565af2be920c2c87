"""``locatk simulate polaris``: what a magnetometer bar would measure over tags."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.simulate_options import ABOVE_0, ANY, FROM_0, SHARE, in_si

if TYPE_CHECKING:
    from locatk.core.polaris.simulation.session import SimulatedSession, SimulationOptions


@click.command(short_help="Passes of a magnetometer bar over tags.")
@click.argument("tag", type=options.PATH, required=False)
@options.output("Session to write (.mcap), with the truth in it.")
@click.option(
    "--car", type=click.Choice(("robot", "mini")), default="robot", show_default=True,
    help="Whose sensors, rate, speed and, without TAG, tag: the paper's robot car or its "
    "miniature car.",
)  # fmt: skip
@click.option(
    "--id", "route", type=click.IntRange(0), multiple=True, metavar="ID",
    help="Tag to cross; several in this order.  [default: all of the site, or the first]",
)  # fmt: skip
@click.option("--heading", "heading_deg", type=ANY, metavar="DEG",
              help="Direction of travel in the tag's frame.  [default: straight ahead over one "
              "tag, along the way over several]")  # fmt: skip
@click.option("--lateral", "lateral_mm", type=ANY, metavar="MM",
              help="How far left of the tag's middle the bar's middle passes.")  # fmt: skip
@click.option("--run-up", "run_up_mm", type=ABOVE_0, metavar="MM",
              help="Way before and after the tags.  [default: 10 clearances]")  # fmt: skip
@click.option("--speed", "speed_mps", type=ABOVE_0, metavar="M/S",
              help="[default: 0.1; mini 0.005]")  # fmt: skip
@click.option("--rest", "rest_s", type=FROM_0, metavar="SECONDS", help="Standing at the start.")
@click.option("--acceleration", "acceleration_mps2", type=ABOVE_0, metavar="M/S2",
              help="From rest to the speed.  [default: at speed from the start]")  # fmt: skip
@click.option("--speed-wobble", type=click.FloatRange(0, 0.9), metavar="SHARE",
              help="By how much the speed goes up and down.")  # fmt: skip
@click.option("--crab", "crab_deg", type=ANY, metavar="DEG",
              help="From the way the bar goes to the way it points.")  # fmt: skip
@click.option("--yaw-wobble", "yaw_wobble_deg", type=ANY, metavar="DEG",
              help="By how much it turns about that.")  # fmt: skip
@click.option("--clearance", "clearance_mm", type=ABOVE_0, metavar="MM",
              help="From the magnets' middles to the sensors.  [default: the tag's]")  # fmt: skip
@click.option("--height-wobble", "height_wobble_mm", type=FROM_0, metavar="MM",
              help="By how much that goes up and down.")  # fmt: skip
@options.input_option("--array", "array_file", metavar="FILE", help="Another bar (array.toml).")
@click.option("--sensors", type=click.IntRange(1), help="[default: 9; mini 3]")
@click.option("--spacing", "spacing_mm", type=ABOVE_0, metavar="MM",
              help="Between sensors.  [default: 20; mini 8]")  # fmt: skip
@click.option("--rate", "rate_hz", type=ABOVE_0, metavar="HZ", help="[default: 100; mini 17]")
@click.option("--noise", "noise_ut", type=FROM_0, metavar="UT",
              help="Standard deviation of an axis.  [default: 0.5]")  # fmt: skip
@click.option("--measured-noise", is_flag=True,
              help="Noise of the published recordings instead: 0.86, 0.89, 1.24 uT, more where "
              "the rate leaves less time.")  # fmt: skip
@click.option("--gain", type=click.IntRange(0, 7), help="GAIN_SEL of the MLX90393.  [default: 7]")
@click.option("--resolution", type=click.IntRange(0, 3), help="Its RES.  [default: 0]")
@click.option("--clipped", is_flag=True,
              help="Beyond the range sensors give its end instead of nothing.")  # fmt: skip
@click.option("--offset", "offset_ut", type=FROM_0, metavar="UT",
              help="Standard deviation of the sensors' offsets (hard iron).  [default: 15]",
)  # fmt: skip
@click.option("--drift", "drift_ut", type=FROM_0, metavar="UT",
              help="By how much they wander off in a second.")  # fmt: skip
@click.option("--dead", type=click.IntRange(0), multiple=True, metavar="SENSOR",
              help="Gives nothing; 0 is the rightmost.")  # fmt: skip
@click.option("--stuck", type=click.IntRange(0), multiple=True, metavar="SENSOR",
              help="Gives its first sample for ever.")  # fmt: skip
@click.option("--lost", type=click.FloatRange(0, 1, max_open=True), metavar="SHARE",
              help="Frames that never arrive.")  # fmt: skip
@click.option("--earth", "earth_ut", type=FROM_0, metavar="UT", help="[default: 50]")
@click.option("--dip", "dip_deg", type=ANY, metavar="DEG",
              help="Of the Earth's field under the horizon.  [default: 65]")  # fmt: skip
@click.option("--north", "north_deg", type=ANY, metavar="DEG",
              help="Where it points, from x of the floor.  [default: 0]")  # fmt: skip
@click.option("--debris", type=click.IntRange(0, 10_000), metavar="N",
              help="Iron bits on and around each tag that is crossed.")  # fmt: skip
@click.option("--debris-size", "debris_size_mm", type=ABOVE_0, metavar="MM",
              help="Diameter of the largest.  [default: 2]")  # fmt: skip
@click.option("--debris-magnetised", type=SHARE, metavar="SHARE",
              help="Bits that are magnets of their own.  [default: 0.3]")  # fmt: skip
@click.option("--motor", "motor_ut", type=FROM_0, metavar="UT",
              help="Field of the motors while they drive.")  # fmt: skip
@click.option("--motor-gradient", type=ANY, metavar="SHARE",
              help="By which share that grows in a metre along the bar.  [default: 1]",
)  # fmt: skip
@click.option("--build-angle", "build_angle_deg", type=FROM_0, metavar="DEG",
              help="Standard deviation of how magnets were turned by hand.")  # fmt: skip
@click.option("--build-place", "build_place_mm", type=FROM_0, metavar="MM",
              help="And of where they were put.")  # fmt: skip
@click.option("--build-strength", type=click.FloatRange(0, 0.2), metavar="SHARE",
              help="And of their remanence.")  # fmt: skip
@click.option("--build-seed", type=click.IntRange(0),
              help="The same gives the same tags in every session.")  # fmt: skip
@click.option("--odometry", is_flag=True, help="The robot has one.")
@click.option("--odometry-scale", type=click.FloatRange(-0.5, 1), metavar="SHARE",
              help="By which it tells too much.  [default: 0.01]")  # fmt: skip
@click.option("--odometry-turn", "odometry_turn_deg", type=FROM_0, metavar="DEG",
              help="Standard deviation of its heading after a metre.  [default: 1]")  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    tag: Path | None, output: Path, car: str, overwrite: bool, as_json: bool, **given: Any
) -> None:
    """Simulate a magnetometer bar that drives over tags of TAG (tag.toml).

    The magnets are finite discs, the sensors MLX90393 that convert X, Y and Z one after
    the other. Without TAG it is the paper's tag: 3 x 3 cells 40 mm apart, five magnets,
    eight orientations. The session holds the samples, the bar, the tags as designed, and
    as truth where the bar was. The same options and seed give the same samples.

    \b
    Examples:
      locatk simulate polaris -o run.mcap --id 262143
      locatk simulate polaris tag.toml -o run.mcap --heading 30 --measured-noise
      locatk simulate polaris site.toml -o tour.mcap --id 3 --id 7 --id 3 --odometry
      locatk simulate polaris -o hard.mcap --speed-wobble 0.3 --debris 30 --dead 4 --lost 0.02
      locatk simulate polaris -o mini.mcap --car mini --id 77
    """
    from locatk.core.polaris.simulation import session as simulate
    from locatk.formats import arrays, tags

    options.must_exist([tag])
    array_file = given["array_file"]
    options.guard_output(
        output, overwrite=overwrite, inputs=[path for path in (tag, array_file) if path]
    )
    artifact = tags.read_tags(tag) if tag else simulate.CARS[car].tags
    wanted = _wanted(car, given)
    with console.working("Simulating"):
        simulated = simulate.simulate(artifact, wanted)
        warnings = _warnings(simulated)
        arrays.write_session(
            output,
            [simulated.samples],
            tags=artifact,
            truth=(simulated.truth,),
            odometry=(simulated.odometry,) if simulated.odometry else (),
            facts=_facts(simulated, wanted),
            warnings=warnings,
            overwrite=overwrite,
        )
    for line in warnings:
        console.warn(line)
    told = _told(simulated)
    crossed = ", ".join(str(crossing.tag_id) for crossing in simulated.crossings)
    console.result(
        f"Wrote {output}: {told['samples']} samples of {told['device']} in {told['frame']}, "
        f"over {'tag ' + crossed if crossed else 'no tag'}, {told['truth_poses']} truth poses"
    )
    if as_json:
        console.emit_json({"version": 1, "output": output, **told})


def _wanted(car: str, given: dict[str, Any]) -> SimulationOptions:
    """The simulation's options, of what was said on the command line."""
    from locatk.core.polaris.simulation import session as simulate
    from locatk.formats import tags

    said = in_si(given)
    usual = simulate.CARS[car]
    said.setdefault("speed_mps", usual.speed_mps)
    rate_hz = said.setdefault("rate_hz", usual.rate_hz)
    named = ("sensors", "spacing_m", "noise_t", "gain", "resolution")
    part = {name: said.pop(name) for name in named if name in said}
    measured, file = said.pop("measured_noise"), said.pop("array_file", None)
    if measured and "noise_t" in part:
        raise click.UsageError("Give --noise or --measured-noise, not both.")
    if file is not None:
        if part or measured:
            raise click.UsageError("An --array has sensors and noise of its own.")
        return simulate.SimulationOptions(array=tags.read_array(file), **said)
    if measured:
        part["noise_t"] = None
    array = simulate.usual_bar(
        part.pop("sensors", usual.sensors), part.pop("spacing_m", usual.spacing_m), rate_hz, **part
    )
    return simulate.SimulationOptions(array=array, **said)


def _warnings(simulated: SimulatedSession) -> list[str]:
    """What a user may not have meant."""
    lines = []
    if simulated.saturated:
        lines.append(f"{simulated.saturated} readings are beyond the sensors' range")
    if not simulated.crossings:
        lines.append("the bar passes over no tag")
    return lines


def _told(simulated: SimulatedSession) -> dict[str, Any]:
    """What was simulated, for ``--json``."""
    return {
        "samples": len(simulated.samples),
        "device": simulated.samples.device,
        "frame": simulated.truth.frame,
        "crossings": _crossings(simulated),
        "lost": simulated.lost,
        "saturated": simulated.saturated,
        "debris": len(simulated.debris),
        "truth_poses": len(simulated.truth),
    }


def _crossings(simulated: SimulatedSession) -> list[dict[str, Any]]:
    return [
        {
            "tag_id": crossing.tag_id,
            "time_s": crossing.time_ns / 1e9,
            "y_m": crossing.y_m,
            "heading_rad": crossing.heading_rad,
            "whole": crossing.whole,
        }
        for crossing in simulated.crossings
    ]


def _facts(simulated: SimulatedSession, wanted: SimulationOptions) -> dict[str, str]:
    """The options, and what else is true: the crossings, and the magnets as they lie."""
    from dataclasses import fields

    magnets = simulated.magnets
    said = {
        f"simulated_{item.name}": str(getattr(wanted, item.name))
        for item in fields(wanted)
        if item.name != "array"
    }
    lying = [
        {"tag_id": tag_id, "x_m": x, "y_m": y, "angle_rad": angle, "moment_am2": moment}
        for tag_id, (x, y), angle, moment in zip(
            magnets.tag_id,
            magnets.place_m.tolist(),
            magnets.angle_rad.tolist(),
            magnets.moment_am2.tolist(),
            strict=True,
        )
    ]
    said["simulated_crossings"] = json.dumps(_crossings(simulated))
    said["simulated_magnets"] = json.dumps(lying)
    return said
