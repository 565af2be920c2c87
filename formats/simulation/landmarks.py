"""Settings of ``locatk simulate landmarks``."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from locatk.core.landmarks.landmark import PATTERNS, name
from locatk.core.landmarks.published.driver import published_driver
from locatk.core.landmarks.simulation.session import (
    STRATEGIES,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.formats.artifacts import maps
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    CELL,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    FilePath,
    Integer,
    ListOf,
    Number,
    Record,
    Row,
    Text,
)
from locatk.formats.sessions import field_samples
from locatk.formats.settings.config import SettingsConfig, SettingsError, with_values
from locatk.formats.settings.setting import Requirement, Setting
from locatk.formats.tables.delimited import read_table

STRATEGY = "robot.strategy"
START, PATH_FILE, CELLS = "robot.start", "robot.path_file", "robot.cells"
SENSORS_FILE, RANGE = "sensors.file", "sensors.range_mt"
ERROR_FACTOR, DISPLACED = "errors.factor", "faults.displaced_landmarks"

SEARCH_STRATEGIES = tuple(strategy for strategy in STRATEGIES if strategy not in ("path", "pass"))
"""Strategies that begin with the search for a landmark."""

NESTED_OPTIONS = ("errors", "faults", "aims", "limits")
"""Options that are recorded as JSON in the facts of a session."""

BAR = Record({"cell": CELL, "bar": Integer(0)})
DISPLACEMENT = Record({"cell": CELL, "x_mm": ANY_NUMBER, "y_mm": ANY_NUMBER})
POSE = Record({"x_mm": ANY_NUMBER, "y_mm": ANY_NUMBER, "heading_deg": ANY_NUMBER})

_ROBOT = (
    Setting(
        STRATEGY,
        Text(STRATEGIES),
        "paper: search a landmark, spin, and go on to its neighbours, steered by the truth; "
        "published: the same by the estimates of the published method; path: follow a path file "
        "or cells; pass: pass one landmark straight",
        "strategy",
        "--strategy",
    ),
    Setting(
        START,
        POSE,
        "Pose at the start of the search, in the frame of the map",
        former_flag="--start",
        default=None,
        default_text="anywhere between landmarks",
        example=(120.0, 80.0, 45.0),
    ),
    Setting(
        "robot.landmarks",
        Integer(1),
        "Number of landmarks to visit",
        "landmarks",
        "--landmarks",
        default_text="those of the map's window",
        example=12,
    ),
    Setting(
        "robot.spins",
        Integer(0),
        "Number of landmarks at which to spin",
        "spins",
        former_flag="--spins",
        default_text="those of the map's window",
        example=1,
    ),
    Setting(
        PATH_FILE,
        FilePath(),
        "Waypoints of a path: a CSV file with the columns x_mm,y_mm",
        flag="--path",
        default=None,
        default_text="none",
        example="path.csv",
        metavar="CSV",
    ),
    Setting(
        CELLS,
        ListOf(CELL),
        "Cells of a path, in this order, or the one cell to pass",
        flag="--cell",
        default=None,
        default_text="none",
        example=((0, 1), (1, 1)),
        metavar="ROW,COLUMN",
    ),
    Setting(
        "robot.pattern",
        Text(PATTERNS),
        "Pattern of the landmark to pass",
        "pattern",
        former_flag="--pattern",
        default_text="any",
        example="NNNS",
    ),
    Setting(
        "robot.lateral_mm",
        ANY_NUMBER,
        "Distance at which a pass is left of the landmark's centre",
        "lateral_m",
        former_flag="--lateral",
        default_text="a heading within 45 degrees of the centre",
        example=20.0,
    ),
    Setting(
        "robot.approach_deg",
        ANY_NUMBER,
        "Direction from the landmark to the start of a pass",
        "approach_rad",
        former_flag="--approach",
        default_text="any",
        example=90.0,
    ),
    Setting("robot.speed_mps", POSITIVE, "Speed", "limits.speed_mps", "--speed"),
    Setting(
        "robot.acceleration_mps2",
        POSITIVE,
        "Acceleration",
        "limits.acceleration_mps2",
        former_flag="--acceleration",
    ),
    Setting(
        "robot.turn_rate_dps",
        POSITIVE,
        "Rate of rotations",
        "limits.turn_rps",
        former_flag="--turn-rate",
    ),
    Setting(
        "robot.turn_acceleration_dps2",
        POSITIVE,
        "Acceleration of rotations",
        "limits.turn_rps2",
        former_flag="--turn-acceleration",
    ),
    Setting(
        "robot.rest_s",
        NOT_NEGATIVE,
        "Rest at the start and at the end",
        "rest_s",
        former_flag="--rest",
    ),
    Setting("robot.stop_s", NOT_NEGATIVE, "Rest on each landmark", "stop_s", "--stop"),
)

_AIMS = (
    Setting(
        "aims.first_mm",
        NOT_NEGATIVE,
        "Mean position error after the first pass over a landmark",
        "aims.first_m",
        former_flag="--aim-first",
    ),
    Setting(
        "aims.second_mm",
        NOT_NEGATIVE,
        "Mean position error after a spin",
        "aims.second_m",
        former_flag="--aim-second",
    ),
    Setting(
        "aims.step_mm",
        NOT_NEGATIVE,
        "Mean position error from landmark to landmark, and on a path",
        "aims.step_m",
        former_flag="--aim-step",
    ),
    Setting(
        "aims.heading_deg",
        NOT_NEGATIVE,
        "Standard deviation of the heading after the alignment with a landmark",
        "aims.heading_rad",
        former_flag="--aim-heading",
    ),
)

_SENSORS = (
    Setting("sensors.rate_hz", POSITIVE, "Rate of the samples", "rate_hz", "--rate"),
    Setting(
        SENSORS_FILE,
        FilePath(),
        "Other hall sensors (halls.toml), with a range of their own",
        flag="--sensors",
        default=None,
        default_text="four on a circle",
        example="halls.toml",
    ),
    Setting(
        RANGE,
        POSITIVE,
        "Largest field that the sensors measure",
        "range_t",
        former_flag="--range",
        default_text="unlimited",
        example=20.0,
    ),
    Setting(
        "sensors.quantum_mt",
        NOT_NEGATIVE,
        "Resolution of a reading",
        "errors.quantum_t",
        former_flag="--quantum",
    ),
)

_ERRORS = (
    Setting(
        ERROR_FACTOR,
        NOT_NEGATIVE,
        "Factor on the defaults of all errors of this table and of [odometry], except the Earth's "
        "field; 0 for no errors",
        flag="--errors",
        metavar="FACTOR",
        default=1.0,
    ),
    Setting(
        "errors.noise_mt",
        NOT_NEGATIVE,
        "Standard deviation of a sample",
        "errors.noise_t",
        "--noise",
    ),
    Setting(
        "errors.offset_mt",
        NOT_NEGATIVE,
        "Standard deviation of the offsets of the sensors",
        "errors.offset_t",
        former_flag="--offset",
    ),
    Setting(
        "errors.gain_fraction",
        NOT_NEGATIVE,
        "Standard deviation of the gains of the sensors",
        "errors.gain",
        former_flag="--gain",
    ),
    Setting(
        "errors.earth_ut",
        ANY_NUMBER,
        "Vertical component of the Earth's field, upward positive",
        "errors.earth_t",
        former_flag="--earth",
    ),
    Setting(
        "errors.height_mm",
        ANY_NUMBER,
        "Height of the sensors above their nominal height",
        "errors.height_m",
        former_flag="--height",
    ),
    Setting(
        "errors.bar_strength_fraction",
        Number(0.0, 0.2),
        "Standard deviation of the strength of a bar",
        "errors.bar_strength",
        former_flag="--bar-strength",
    ),
    Setting(
        "errors.bar_position_mm",
        NOT_NEGATIVE,
        "Standard deviation of the position of a bar",
        "errors.bar_place_m",
        former_flag="--bar-place",
    ),
    Setting(
        "errors.bar_angle_deg",
        NOT_NEGATIVE,
        "Standard deviation of the rotation of a bar about the vertical",
        "errors.bar_turn_rad",
        former_flag="--bar-turn",
    ),
    Setting(
        "errors.bar_tilt_deg",
        NOT_NEGATIVE,
        "Standard deviation of the tilt of a bar",
        "errors.bar_lean_rad",
        former_flag="--bar-lean",
    ),
    Setting(
        "errors.landmark_position_mm",
        NOT_NEGATIVE,
        "Standard deviation of the position of a landmark",
        "errors.landmark_place_m",
        former_flag="--landmark-place",
    ),
    Setting(
        "errors.landmark_angle_deg",
        NOT_NEGATIVE,
        "Standard deviation of the rotation of a landmark",
        "errors.landmark_turn_rad",
        former_flag="--landmark-turn",
    ),
)

_ODOMETRY = (
    Setting(
        "odometry.rate_hz",
        POSITIVE,
        "Rate of the odometry",
        "odometry_hz",
        former_flag="--odometry-rate",
    ),
    Setting(
        "odometry.scale_fraction",
        Number(0.0, 0.2),
        "Standard deviation of the scale of distances",
        "errors.odometry_scale",
        former_flag="--odometry-scale",
    ),
    Setting(
        "odometry.rotation_fraction",
        Number(0.0, 0.2),
        "Standard deviation of the scale of rotations",
        "errors.odometry_turn",
        former_flag="--odometry-turn",
    ),
    Setting(
        "odometry.drift_deg_per_m",
        NOT_NEGATIVE,
        "Standard deviation of the drift of the heading",
        "errors.odometry_drift_rad_per_m",
        former_flag="--odometry-drift",
        default_text="4.35, a degree in a pass of 0.23 m",
    ),
    Setting(
        "odometry.wheel_noise_mm",
        NOT_NEGATIVE,
        "Standard deviation of the path of a wheel after a metre, a random walk",
        "errors.wheel_noise_m",
        former_flag="--wheel-noise",
    ),
    Setting(
        "odometry.slips_per_m",
        NOT_NEGATIVE,
        "Mean number of slips of a wheel in a metre",
        "errors.slips_per_m",
        former_flag="--slips",
    ),
    Setting(
        "odometry.slip_mm", NOT_NEGATIVE, "Length of a slip", "errors.slip_m", former_flag="--slip"
    ),
)

_FAULTS = (
    Setting(
        "faults.flipped_bars",
        ListOf(BAR),
        "Bars with north and south exchanged; bars are 0 to 3",
        "faults.flipped",
        "--flip",
        default_text="none",
        example=(((2, 3), 1),),
        metavar="ROW,COLUMN:BAR",
    ),
    Setting(
        "faults.missing_bars",
        ListOf(BAR),
        "Bars that are missing",
        "faults.missing",
        former_flag="--missing",
        default_text="none",
        example=(((2, 3), 0),),
    ),
    Setting(
        DISPLACED,
        ListOf(DISPLACEMENT),
        "Landmarks that are displaced, in the frame of the map",
        former_flag="--displace",
        default=None,
        default_text="none",
        example=(((2, 3), 4.0, -1.5),),
    ),
    Setting(
        "faults.misread_fraction",
        FRACTION,
        "Probability that a landmark is installed as another one",
        "faults.misread_rate",
        former_flag="--misread-rate",
    ),
    Setting(
        "faults.dead_sensors",
        ListOf(Text()),
        "Sensors that give nothing",
        "faults.dead",
        former_flag="--dead",
        default_text="none",
        example=("rear",),
    ),
    Setting(
        "faults.stuck_sensors",
        ListOf(Text()),
        "Sensors that always give their offset",
        "faults.stuck",
        former_flag="--stuck",
        default_text="none",
        example=("right",),
    ),
    Setting(
        "faults.swapped_sensors",
        ListOf(Row(Text(), 2)),
        "Pairs of sensors with exchanged wires",
        "faults.swapped",
        former_flag="--swap",
        default_text="none",
        example=(("front", "left"),),
    ),
)

CONFIG = SettingsConfig(
    "landmarks",
    (
        *_ROBOT,
        *_AIMS,
        *_SENSORS,
        *_ERRORS,
        *_ODOMETRY,
        *_FAULTS,
        Setting("random.seed", Integer(0), "Seed of all random numbers", "seed", "--seed"),
        Setting(
            "random.floor_seed",
            Integer(0),
            "Seed of the errors of the floor: the same floor for several drives",
            "floor_seed",
            "--floor-seed",
            default_text="seed",
            example=0,
        ),
    ),
    SimulationOptions(),
    conflicts=(((PATH_FILE,), (CELLS,)), ((SENSORS_FILE,), (RANGE,))),
    requirements=(
        *(
            Requirement(key, STRATEGY, SEARCH_STRATEGIES)
            for key in (START, "robot.landmarks", "robot.spins")
        ),
        Requirement(PATH_FILE, STRATEGY, ("path",)),
        Requirement(CELLS, STRATEGY, ("path", "pass")),
        *(
            Requirement(key, STRATEGY, ("pass",))
            for key in ("robot.pattern", "robot.lateral_mm", "robot.approach_deg")
        ),
    ),
)
"""Settings of the command."""


def simulation_options(settings: Mapping[str, Any]) -> SimulationOptions:
    """Return the options of a simulation.

    Raises
    ------
    SettingsError
        The strategy and the cells contradict each other.
    MissingDataError, ArtifactError, FormatError
        A file is missing or invalid.
    InputError
        A value is out of its range.
    """
    values = CONFIG.in_si(settings)
    defaults = SimulationOptions()
    values["errors"] = with_values(
        defaults.errors.scaled(values.pop(ERROR_FACTOR, 1.0)), _pop_table(values, "errors")
    )
    if (start := values.pop(START, None)) is not None:
        x_mm, y_mm, heading_deg = start
        values["start"] = (x_mm * 1e-3, y_mm * 1e-3, math.radians(heading_deg))
    if displaced := values.pop(DISPLACED, None):
        values["faults.displaced"] = tuple(
            (cell, (x_mm * 1e-3, y_mm * 1e-3)) for cell, x_mm, y_mm in displaced
        )
    if file := values.pop(SENSORS_FILE, None):
        values["sensors"] = maps.read_halls(Path(file))
    file, cells = values.pop(PATH_FILE, None), values.pop(CELLS, ())
    if file:
        values["waypoints"] = read_waypoints(Path(file))
    strategy = values.get("strategy", defaults.strategy)
    if strategy == "path":
        if not (file or cells):
            titles = " or ".join(CONFIG.setting(key).title for key in (PATH_FILE, CELLS))
            raise SettingsError(f"A path needs {titles}")
        values["cells"] = cells
    elif len(cells) > 1:
        raise SettingsError("A pass has one cell; several are a path")
    elif cells:
        (values["cell"],) = cells
    options: SimulationOptions = with_values(defaults, values)
    return options


def _pop_table(values: dict[str, Any], table: str) -> dict[str, Any]:
    """Remove the values of nested options, and return them by attribute."""
    names = [field for field in values if field.startswith(f"{table}.")]
    return {field.removeprefix(f"{table}."): values.pop(field) for field in names}


def read_waypoints(file: Path) -> tuple[tuple[float, float], ...]:
    """Read the positions in metres of a CSV file with the columns ``x_mm`` and ``y_mm``.

    Raises
    ------
    MissingDataError
        There is no such file.
    FormatError, InputError
        A column is missing, or a value is not a number.
    """
    table = read_table(file)
    table.require("x_mm", "y_mm")
    x_mm, y_mm = table.floats("x_mm").tolist(), table.floats("y_mm").tolist()
    return tuple((x * 1e-3, y * 1e-3) for x, y in zip(x_mm, y_mm, strict=True))


def write_simulation(
    output: str | os.PathLike[str],
    settings: Mapping[str, Any],
    map_file: str | os.PathLike[str],
    *,
    overwrite: bool = False,
) -> tuple[dict[str, Any], list[str]]:
    """Simulate a robot on the landmarks of a map, and write the session.

    Returns the summary for ``--json`` and the warnings.

    Raises
    ------
    LocatkError
        A file is missing or invalid, or the settings cannot be simulated.
    """
    floor = maps.read_map(map_file)
    options = simulation_options(settings)
    driver = published_driver(floor, options) if options.strategy == "published" else None
    simulated = simulate(floor, options, driver)
    warnings = _warnings(simulated)
    field_samples.write_halls(
        output,
        simulated.samples,
        floor=floor,
        truth=simulated.truth,
        odometry=simulated.odometry,
        facts=_facts(simulated, options),
        warnings=warnings,
        overwrite=overwrite,
    )
    return _summary(simulated), warnings


def _warnings(simulated: SimulatedSession) -> list[str]:
    """Return warnings about results that a user may not intend."""
    lines = list(simulated.notes)
    if simulated.saturated:
        lines.append(f"{simulated.saturated} readings are at the end of the sensors' range")
    if not simulated.events:
        lines.append("the robot passes over no landmark")
    return lines


def _summary(simulated: SimulatedSession) -> dict[str, Any]:
    """Return a summary of the simulation for ``--json``."""
    return {
        "samples": len(simulated.samples[0]),
        "device": simulated.samples[0].device,
        "frame": simulated.truth[0].frame,
        "visits": _visits(simulated),
        **({"approaches": _approaches(simulated)} if simulated.approaches else {}),
        "faults": [
            {"cell": list(mark.cell), "faults": list(mark.faults)}
            for mark in simulated.installed_landmarks
            if mark.faults
        ],
        "saturated": simulated.saturated,
        "slips_s": [time_ns / 1e9 for time_ns in simulated.slips],
        "odometry_poses": len(simulated.odometry[0]),
        "truth_poses": len(simulated.truth[0]),
    }


def _approaches(simulated: SimulatedSession) -> list[dict[str, Any]]:
    """Return the outcomes of the strategy ``published`` for ``--json`` and the facts."""
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


def _visits(simulated: SimulatedSession) -> list[dict[str, Any]]:
    """Return the visits of landmarks for ``--json`` and the facts of the session."""
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


def _facts(simulated: SimulatedSession, options: SimulationOptions) -> dict[str, str]:
    """Return the options, the visits and the true landmarks as facts.

    Only visited and faulty landmarks are included; a floor has thousands.
    """
    facts = {}
    for item in fields(options):
        value = getattr(options, item.name)
        if item.name in NESTED_OPTIONS:
            facts[f"simulated_{item.name}"] = json.dumps(asdict(value))
        elif item.name != "sensors":
            facts[f"simulated_{item.name}"] = str(value)
    visited = {visit.cell for visit in simulated.events}
    facts["simulated_visits"] = json.dumps(_visits(simulated))
    if simulated.approaches:
        facts["simulated_approaches"] = json.dumps(_approaches(simulated))
    facts["simulated_floor"] = json.dumps(
        [
            {
                "cell": list(mark.cell),
                "code": name(mark.code),
                "x_m": mark.x_m,
                "y_m": mark.y_m,
                "heading_rad": mark.heading_rad,
                "strength": mark.strength.tolist(),
                "faults": list(mark.faults),
            }
            for mark in simulated.installed_landmarks
            if mark.faults or mark.cell in visited
        ]
    )
    return facts
