"""Settings of ``locatk simulate polaris``."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from locatk.core.polaris.simulation.session import (
    CARS,
    SimulatedSession,
    SimulationOptions,
    simulate,
    usual_bar,
)
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    FRACTION,
    FRACTION_BELOW_1,
    NOT_NEGATIVE,
    POSITIVE,
    Boolean,
    FilePath,
    Integer,
    ListOf,
    Number,
    Text,
)
from locatk.formats.artifacts.tags import read_array, read_tags
from locatk.formats.sessions import field_samples
from locatk.formats.settings.config import SettingsConfig
from locatk.formats.settings.setting import Setting

DEFAULT_CAR = "robot"

MEASURED_NOISE = "errors.measured_noise"
ARRAY_FILE = "sensors.array_file"

ARRAY_PARAMETERS = {
    "sensors.count": "count",
    "sensors.spacing_mm": "spacing_m",
    "errors.noise_ut": "noise_t",
    "sensors.gain": "gain",
    "sensors.resolution": "resolution",
}
"""Settings of an array of MLX90393, and the parameters of :func:`usual_bar`."""

_ROBOT = (
    Setting(
        "robot.car",
        Text(tuple(CARS)),
        "Sensors, rate, speed and, without TAG, tag: of the paper's robot car or of its "
        "miniature car",
        flag="--car",
        default=DEFAULT_CAR,
    ),
    Setting(
        "robot.tag_ids",
        ListOf(Integer(0)),
        "Tags to cross, in this order",
        "route",
        "--id",
        default_text="all tags of the site, or the first",
        example=(3, 7),
        metavar="ID",
    ),
    Setting(
        "robot.heading_deg",
        ANY_NUMBER,
        "Direction of travel in the frame of the tag",
        "heading_rad",
        "--heading",
        default_text="straight ahead over one tag, along the path over several",
        example=30.0,
    ),
    Setting(
        "robot.lateral_mm",
        ANY_NUMBER,
        "Distance at which the middle of the array passes left of the middle of the tag",
        "lateral_m",
        "--lateral",
    ),
    Setting(
        "robot.run_up_mm",
        POSITIVE,
        "Path before and after the tags",
        "run_up_m",
        "--run-up",
        default_text="10 clearances",
        example=80.0,
    ),
    Setting(
        "robot.speed_mps", POSITIVE, "Speed", "speed_mps", "--speed", default_text="0.1; mini 0.005"
    ),
    Setting(
        "robot.speed_wobble_fraction",
        Number(0.0, 0.9),
        "Amplitude of the variation of the speed",
        "speed_wobble",
        "--speed-wobble",
    ),
    Setting("robot.rest_s", NOT_NEGATIVE, "Rest at the start", "rest_s", former_flag="--rest"),
    Setting(
        "robot.acceleration_mps2",
        POSITIVE,
        "Acceleration from rest to the speed",
        "acceleration_mps2",
        former_flag="--acceleration",
        default_text="at speed from the start",
        example=0.5,
    ),
    Setting(
        "robot.crab_deg",
        ANY_NUMBER,
        "Angle from the direction of travel to the x axis of the array",
        "crab_rad",
        former_flag="--crab",
    ),
    Setting(
        "robot.yaw_wobble_deg",
        ANY_NUMBER,
        "Amplitude of the variation of that angle",
        "yaw_wobble_rad",
        former_flag="--yaw-wobble",
    ),
    Setting(
        "robot.clearance_mm",
        POSITIVE,
        "Height of the sensors above the middles of the magnets",
        "clearance_m",
        former_flag="--clearance",
        default_text="that of the tag",
        example=11.0,
    ),
    Setting(
        "robot.height_wobble_mm",
        NOT_NEGATIVE,
        "Amplitude of the variation of that height",
        "height_wobble_m",
        former_flag="--height-wobble",
    ),
)

_SENSORS = (
    Setting(
        ARRAY_FILE,
        FilePath(),
        "Another array of sensors (array.toml), with noise of its own",
        flag="--array",
        default=None,
        default_text="MLX90393 in a row",
        example="array.toml",
    ),
    Setting(
        "sensors.count",
        Integer(1),
        "Number of sensors",
        former_flag="--sensors",
        default=CARS[DEFAULT_CAR].sensors,
        default_text="9; mini 3",
    ),
    Setting(
        "sensors.spacing_mm",
        POSITIVE,
        "Distance between neighbouring sensors",
        former_flag="--spacing",
        default=20.0,
        default_text="20; mini 8",
    ),
    Setting(
        "sensors.rate_hz",
        POSITIVE,
        "Rate of the samples",
        "rate_hz",
        "--rate",
        default_text="100; mini 17",
    ),
    Setting(
        "sensors.gain", Integer(0, 7), "GAIN_SEL of the MLX90393", former_flag="--gain", default=7
    ),
    Setting(
        "sensors.resolution",
        Integer(0, 3),
        "RES of the MLX90393",
        former_flag="--resolution",
        default=0,
    ),
)

_ERRORS = (
    Setting(
        "errors.noise_ut",
        NOT_NEGATIVE,
        "Standard deviation of an axis",
        flag="--noise",
        default=0.5,
    ),
    Setting(
        MEASURED_NOISE,
        Boolean(),
        "Noise of the published recordings instead: 0.86, 0.89, 1.24 uT, more if the rate leaves "
        "less time for a conversion",
        flag="--measured-noise/--no-measured-noise",
        default=False,
    ),
    Setting(
        "errors.offset_ut",
        NOT_NEGATIVE,
        "Standard deviation of the offsets of the sensors (hard iron)",
        "offset_t",
        former_flag="--offset",
    ),
    Setting(
        "errors.drift_ut",
        NOT_NEGATIVE,
        "Standard deviation of their drift in a second, a random walk",
        "drift_t",
        former_flag="--drift",
    ),
)

_FAULTS = (
    Setting(
        "faults.clipped",
        Boolean(),
        "A sensor beyond its range gives the end of the range instead of nothing",
        "clipped",
        former_flag="--clipped",
    ),
    Setting(
        "faults.dead_sensors",
        ListOf(Integer(0)),
        "Sensors that give nothing; 0 is the rightmost",
        "dead",
        former_flag="--dead",
        default_text="none",
        example=(4,),
    ),
    Setting(
        "faults.stuck_sensors",
        ListOf(Integer(0)),
        "Sensors that repeat their first sample",
        "stuck",
        former_flag="--stuck",
        default_text="none",
        example=(5,),
    ),
    Setting(
        "faults.lost_fraction",
        FRACTION_BELOW_1,
        "Fraction of the frames that never arrive",
        "lost",
        former_flag="--lost",
    ),
)

_ENVIRONMENT = (
    Setting(
        "environment.earth_ut",
        NOT_NEGATIVE,
        "Strength of the Earth's field",
        "earth_t",
        former_flag="--earth",
    ),
    Setting(
        "environment.dip_deg",
        ANY_NUMBER,
        "Angle of the Earth's field below the horizon",
        "dip_rad",
        former_flag="--dip",
    ),
    Setting(
        "environment.north_deg",
        ANY_NUMBER,
        "Magnetic north, from the x axis of the floor",
        "north_rad",
        former_flag="--north",
    ),
    Setting(
        "environment.debris_count",
        Integer(0, 10_000),
        "Iron bits on and around each tag that is crossed",
        "debris",
        former_flag="--debris",
    ),
    Setting(
        "environment.debris_size_mm",
        POSITIVE,
        "Diameter of the largest bit",
        "debris_size_m",
        former_flag="--debris-size",
    ),
    Setting(
        "environment.debris_magnetised_fraction",
        FRACTION,
        "Fraction of the bits that are permanent magnets",
        "debris_magnetised",
        former_flag="--debris-magnetised",
    ),
    Setting(
        "environment.motor_ut",
        NOT_NEGATIVE,
        "Field of the motors at the middle of the array, at speed",
        "motor_t",
        former_flag="--motor",
    ),
    Setting(
        "environment.motor_gradient_per_m",
        ANY_NUMBER,
        "Relative growth of that field along the array",
        "motor_gradient",
        former_flag="--motor-gradient",
    ),
)

_BUILD = (
    Setting(
        "build.angle_deg",
        NOT_NEGATIVE,
        "Standard deviation of the directions of the magnets, as turned by hand",
        "build_angle_rad",
        former_flag="--build-angle",
    ),
    Setting(
        "build.position_mm",
        NOT_NEGATIVE,
        "Standard deviation of their positions along each axis",
        "build_place_m",
        former_flag="--build-place",
    ),
    Setting(
        "build.strength_fraction",
        Number(0.0, 0.2),
        "Relative standard deviation of their remanence",
        "build_strength",
        former_flag="--build-strength",
    ),
    Setting(
        "build.seed",
        Integer(0),
        "Seed of these errors: the same seed gives the same tags in every session",
        "build_seed",
        former_flag="--build-seed",
    ),
)

_ODOMETRY = (
    Setting(
        "odometry.recorded",
        Boolean(),
        "The robot records odometry",
        "odometry",
        "--odometry/--no-odometry",
    ),
    Setting(
        "odometry.scale_fraction",
        Number(-0.5, 1.0),
        "Relative error of its distances",
        "odometry_scale",
        former_flag="--odometry-scale",
    ),
    Setting(
        "odometry.heading_deg",
        NOT_NEGATIVE,
        "Standard deviation of its heading after a metre, a random walk",
        "odometry_turn_rad",
        former_flag="--odometry-turn",
    ),
)

CONFIG = SettingsConfig(
    "polaris",
    (
        *_ROBOT,
        *_SENSORS,
        *_ERRORS,
        *_FAULTS,
        *_ENVIRONMENT,
        *_BUILD,
        *_ODOMETRY,
        Setting("random.seed", Integer(0), "Seed of all other random numbers", "seed", "--seed"),
    ),
    SimulationOptions(),
    conflicts=(
        ((ARRAY_FILE,), (*ARRAY_PARAMETERS, MEASURED_NOISE)),
        (("errors.noise_ut",), (MEASURED_NOISE,)),
    ),
)
"""Settings of the command."""


def simulation_options(settings: Mapping[str, Any]) -> SimulationOptions:
    """Return the options of a simulation.

    Raises
    ------
    MissingDataError, ArtifactError
        The file of the array is missing or invalid.
    InputError
        A value is out of its range, or no setting of the MLX90393 is that fast.
    """
    values = CONFIG.in_si(settings)
    car = CARS[values.pop("robot.car", DEFAULT_CAR)]
    values.setdefault("speed_mps", car.speed_mps)
    values.setdefault("rate_hz", car.rate_hz)
    is_noise_measured = values.pop(MEASURED_NOISE, False)
    file = values.pop(ARRAY_FILE, None)
    if file is not None:
        return SimulationOptions(array=read_array(Path(file)), **values)
    parameters = {name: values.pop(key) for key, name in ARRAY_PARAMETERS.items() if key in values}
    if is_noise_measured:
        parameters["noise_t"] = None
    array = usual_bar(
        **{"count": car.sensors, "spacing_m": car.spacing_m, **parameters},
        rate_hz=values["rate_hz"],
    )
    return SimulationOptions(array=array, **values)


def write_simulation(
    output: str | os.PathLike[str],
    settings: Mapping[str, Any],
    tag_file: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
) -> tuple[dict[str, Any], list[str]]:
    """Simulate an array that passes over tags (None: the one of the car), and write the session.

    Returns the summary for ``--json`` and the warnings.

    Raises
    ------
    LocatkError
        A file is missing or invalid, or the settings cannot be simulated.
    """
    car = CARS[settings.get("robot.car", DEFAULT_CAR)]
    tags = read_tags(tag_file) if tag_file else car.tags
    options = simulation_options(settings)
    simulated = simulate(tags, options)
    warnings = _warnings(simulated)
    field_samples.write_magnetometers(
        output,
        [simulated.samples],
        tags=tags,
        truth=(simulated.truth,),
        odometry=(simulated.odometry,) if simulated.odometry else (),
        facts=_facts(simulated, options),
        warnings=warnings,
        overwrite=overwrite,
    )
    return _summary(simulated), warnings


def _warnings(simulated: SimulatedSession) -> list[str]:
    """Return warnings about results that a user may not intend."""
    lines = []
    if simulated.saturated:
        lines.append(f"{simulated.saturated} readings are beyond the sensors' range")
    if not simulated.crossings:
        lines.append("the bar passes over no tag")
    return lines


def _summary(simulated: SimulatedSession) -> dict[str, Any]:
    """Return a summary of the simulation for ``--json``."""
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
    """Return the crossings of tags for ``--json`` and the facts of the session."""
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


def _facts(simulated: SimulatedSession, options: SimulationOptions) -> dict[str, str]:
    """Return the options, the crossings and the true poses of the magnets as facts."""
    magnets = simulated.magnets
    facts = {
        f"simulated_{item.name}": str(getattr(options, item.name))
        for item in fields(options)
        if item.name != "array"
    }
    built = [
        {"tag_id": tag_id, "x_m": x, "y_m": y, "angle_rad": angle, "moment_am2": moment}
        for tag_id, (x, y), angle, moment in zip(
            magnets.tag_id,
            magnets.position_m.tolist(),
            magnets.angle_rad.tolist(),
            magnets.moment_am2.tolist(),
            strict=True,
        )
    ]
    facts["simulated_crossings"] = json.dumps(_crossings(simulated))
    facts["simulated_magnets"] = json.dumps(built)
    return facts
