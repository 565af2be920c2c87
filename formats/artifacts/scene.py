"""Artifact ``scene.toml``: Lighthouse stations, markers and known distances."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import MODELS, PARAMETERS, Calibration
from locatk.core.lighthouse.room import MAX_ROBOTS, MOUNTS, Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit, Scene, Station
from locatk.core.lighthouse.scene.model import FRAME_SOURCES, JOINT_PARAMETERS
from locatk.core.polygons import MAX_CORNERS, MAX_LENGTH_M
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    MAX_VARIANCE,
    NO_UNIT,
    NOT_NEGATIVE,
    POSITIVE,
    Boolean,
    Integer,
    InvalidValueError,
    ListOf,
    Number,
    Row,
    Text,
    Unit,
    parse_key,
    type_name,
)
from locatk.formats.artifacts.schema import (
    Array,
    Artifact,
    Key,
    Table,
    Tables,
    Values,
    Variant,
    refuse_repeated,
)
from locatk.formats.artifacts.toml import Inline

SCENE_FILE = "scene.toml"
"""Name of the attachment that holds the scene of a session or a solution."""

SCENE_FORMAT = "locatk-lighthouse-scene"

SCALES = ("markers", "distance", "odometry", "device", "design", "unit")
SOURCES = ("factory", "generic", "estimated", "none")

ANGLE_PARAMETERS = ("phase", "tilt", "gibphase", "ogeephase")
"""Calibration parameters that are angles; their keys end in ``_rad``."""

ROTATION_TOLERANCE = 1e-6
"""Largest deviation of an element of ``R R^T`` from the identity."""

MAX_COVARIANCE_ERROR = 1e-6
"""Largest asymmetry and most negative eigenvalue of a matrix of correlations: beyond rounding."""

FACTOR_DIGITS = 6
"""Significant digits of the factor of the joint covariance: a millionth of each sigma."""

CHANNEL = Integer(1, 16)

_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?([Zz]|[+-]\d\d:\d\d)", re.ASCII
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


# ---- times


def parse_time(text: str) -> int | None:
    """Return the nanoseconds since 1970 of an RFC 3339 time, or None if it is not one."""
    match = _TIME.fullmatch(text)
    if match is None:
        return None
    day, clock, fraction, zone = match.groups()
    try:
        whole = datetime.fromisoformat(f"{day}T{clock}{zone.upper().replace('Z', '+00:00')}")
        seconds = (whole - _EPOCH) // timedelta(seconds=1)
    except (ValueError, OverflowError):
        return None
    time_ns = seconds * 1_000_000_000 + int((fraction or "").ljust(9, "0"))
    return time_ns if abs(time_ns) < 1 << 63 else None


def format_time(time_ns: int) -> str:
    """Return the RFC 3339 text of nanoseconds since 1970, in UTC, with all nine digits."""
    seconds, nanoseconds = divmod(int(time_ns), 1_000_000_000)
    whole = _EPOCH + timedelta(seconds=seconds)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"


# ---- kinds of values


@dataclass(frozen=True)
class Time:
    """Time as nanoseconds since 1970; TOML's own date and time without quotes is accepted."""

    expected = "an RFC 3339 time with its zone"
    plural = "RFC 3339 times"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> int:
        text = value.isoformat() if isinstance(value, datetime) else value
        time_ns = parse_time(text) if isinstance(text, str) else None
        if time_ns is None:
            raise InvalidValueError(
                'expected a time with its zone, as in "2023-07-27T15:34:22.700963Z"'
            )
        return time_ns

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> str:
        return format_time(value)


@dataclass(frozen=True)
class SerialNumber:
    """Serial number of a station, as a hexadecimal string."""

    expected = "a hexadecimal number in quotes"
    plural = "hexadecimal numbers in quotes"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> int:
        if not isinstance(value, str):
            raise InvalidValueError(f"expected a string, not {type_name(value)}")
        if not re.fullmatch("[0-9a-fA-F]{1,16}", value):
            raise InvalidValueError('expected a hexadecimal number in quotes, as in "4cc60647"')
        return int(value, 16)

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> str:
        return f"{value:08x}"


@dataclass(frozen=True)
class Counts:
    """LFSR counts of the two sweeps by channel, as in ``{ 1 = [48333.0, 88779.0] }``."""

    expected = "a table with two counts by channel"
    plural = "tables with two counts by channel"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> dict[int, tuple[float, float]]:
        if not isinstance(value, dict):
            raise InvalidValueError(f"expected {self.expected}, not {type_name(value)}")
        if not value:
            raise InvalidValueError(f"expected {self.expected}, not an empty table")
        for key in value:
            if not re.fullmatch("[1-9]|1[0-6]", key):
                raise InvalidValueError("expected a channel from 1 to 16 as key", key)
        pair = Row(NOT_NEGATIVE, 2)
        return {int(key): parse_key(key, pair, item) for key, item in value.items()}

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Inline:
        return Inline({str(c): [float(count) for count in pair] for c, pair in value.items()})


@dataclass(frozen=True)
class UnitVector:
    """Direction in three dimensions; of any length in the file."""

    expected = "a direction of 3 numbers, not all 0"
    plural = "directions of 3 numbers, not all 0"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> NDArray[np.float64]:
        vector = Array((3,)).parse(value)
        length = float(np.linalg.norm(vector))
        if not length > 0:
            raise InvalidValueError(f"expected {self.expected}")
        # A vector of length 1 is not changed, so that it is written again as it was read.
        return vector if abs(length - 1.0) < 1e-12 else vector / length

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return np.asarray(value, float).tolist()


@dataclass(frozen=True)
class PoseCovariance:
    """Covariance of a pose: finite, symmetric and without negative variances in any direction."""

    expected = "a covariance of 6 rows of 6 numbers"
    plural = "covariances of 6 rows of 6 numbers"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> NDArray[np.float64]:
        covariance = Array((6, 6), Number(max_magnitude=MAX_VARIANCE)).parse(value)
        problem = covariance_problem(covariance)
        if problem is not None:
            raise InvalidValueError(
                f"not a covariance: {problem}",
                "",
                "Leave the key out if the covariance is unknown",
            )
        return covariance

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return np.asarray(value, float).tolist()


def covariance_problem(covariance: NDArray[np.float64]) -> str | None:
    """Return the reason why a square matrix is not a covariance, or None if it is one."""
    if not np.all(np.isfinite(covariance)):
        return "a value is not finite"
    variance = np.diagonal(covariance)
    if np.any(variance < 0):
        return "a variance is negative"
    sigma = np.sqrt(variance)
    inverse = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0)
    correlation = covariance * inverse[:, None] * inverse
    if np.any(covariance[sigma == 0]) or np.any(covariance[:, sigma == 0]):
        return "a variance is 0 and its covariances are not"
    if np.max(np.abs(correlation - correlation.T)) > MAX_COVARIANCE_ERROR:
        return "it is not symmetric"
    if np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] < -MAX_COVARIANCE_ERROR:
        return "it is not positive semi-definite"
    return None


@dataclass(frozen=True)
class TriangularFactor:
    """Rows of a lower triangular matrix L, of 1, 2, 3 ... numbers; its value is L L^T."""

    expected = "a list of rows of 1, 2, 3 and so on numbers"
    plural = "lists of rows of 1, 2, 3 and so on numbers"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> NDArray[np.float64]:
        if not (isinstance(value, list) and value):
            raise InvalidValueError(f"expected {self.expected}")
        factor: NDArray[np.float64] = np.zeros((len(value), len(value)))
        for number, row in enumerate(value):
            length = number + 1
            factor[number, :length] = parse_key(f"[{number}]", Array((length,)), row)
        covariance: NDArray[np.float64] = factor @ factor.transpose()
        return covariance

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        factor = _triangular_factor(np.asarray(value, float))
        digits = f".{FACTOR_DIGITS - 1}e"
        return [
            [float(format(number, digits)) for number in row[: k + 1]]
            for k, row in enumerate(factor.tolist())
        ]


def _triangular_factor(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lower triangular L with L L^T = covariance, which may be semi-definite.

    Raises
    ------
    ValueError
        The matrix is not a covariance.
    """
    problem = covariance_problem(covariance)
    if problem is not None:
        raise ValueError(f"not a covariance: {problem}")
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        pass  # The gauge of a scene has no variance, so that a covariance may be singular.
    sigma = np.sqrt(np.diagonal(covariance))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    upper = np.asarray(np.linalg.qr(root.T, mode="r"))
    return np.asarray((upper * np.where(np.diagonal(upper) < 0, -1.0, 1.0)[:, None]).T)


# ---- calibrations


def _parameter_key(parameter: str) -> str:
    return f"{parameter}_rad" if parameter in ANGLE_PARAMETERS else parameter


_PARAMETERS = Table(
    tuple(Key(_parameter_key(parameter), ANY_NUMBER) for parameter in PARAMETERS),
    lambda values: [values[_parameter_key(parameter)] for parameter in PARAMETERS],
    lambda row: dict(zip(map(_parameter_key, PARAMETERS), map(float, row), strict=True)),
    is_inline=True,
)


def _calibration_keys(*, is_known: bool) -> tuple[Key, ...]:
    required: dict[str, Any] = {} if is_known else {"default": None}
    return (
        Key("source", Text(SOURCES), "origin of the calibration"),
        Key(
            "model",
            Text(MODELS),
            "model of the parameters: `libsurvive` (all seven), or `crazyflie` (as its firmware "
            "estimates them: no curve, no ogee)",
            "libsurvive",
        ),
        Key(
            "first",
            _PARAMETERS,
            "the seven parameters of the first sweep, as the station sends them; may be missing "
            "if the source is `none`",
            **required,
        ),
        Key("second", _PARAMETERS, "those of the second sweep", **required),
    )


def _calibration_of(values: Values) -> Calibration:
    # Without calibration all parameters are zero.
    zeros = np.zeros(len(PARAMETERS))
    sweeps = np.array([zeros if values[k] is None else values[k] for k in ("first", "second")])
    return Calibration(sweeps, values["source"], values["model"])


def _calibration_values(calibration: Calibration) -> Values:
    first, second = calibration.sweeps
    return {
        "source": calibration.source,
        "model": calibration.model,
        "first": first,
        "second": second,
    }


def _calibration_table(values: Mapping[str, Any]) -> Table:
    is_known = values.get("source") != "none"
    return Table(_calibration_keys(is_known=is_known), _calibration_of)


CALIBRATION = Variant(
    _calibration_table, _calibration_table({"source": "factory"}), _calibration_values
)


_UP = "direction against gravity in its axes (forward, left, up), from its accelerometer"


def _known_station_table(values: Mapping[str, Any]) -> Table:
    """Return the table of a station that has yet to be solved."""
    keys: tuple[Key, ...] = (
        Key("channel", CHANNEL, "channel of a station that has yet to be solved, once each"),
        Key("id", SerialNumber(), "its serial number", None, "unknown"),
        Key("up", UnitVector(), _UP, None, "unknown"),
    )
    if {"id", "up"} & set(values) and set(values) <= {"channel", "id", "up"}:
        return Table(keys)  # its calibration is unknown
    keys += _calibration_keys(is_known=values.get("source") != "none")
    return Table(keys, lambda values: {**values, "calibration": _calibration_of(values)})


# ---- visits of markers

_COUNTS = Table(
    (Key("counts", Counts(), "counts of the two sweeps by channel, in any order"),),
    lambda values: MarkerVisit(counts=values["counts"]),
)


def _timed_visit(values: Values) -> MarkerVisit:
    if values["end"] < values["start"]:
        raise InvalidValueError("is before start", "end")
    return MarkerVisit(values["device"], values["start"], values["end"])


_INTERVAL = Table(
    (
        Key("device", Text(), "device that rested on the marker"),
        Key("start", Time(), "start of its rest"),
        Key("end", Time(), "end of its rest"),
    ),
    _timed_visit,
)


def _visit_values(visit: MarkerVisit) -> Values:
    if visit.counts:
        return {"counts": visit.counts}
    return {"device": visit.device, "start": visit.start_ns, "end": visit.end_ns}


VISIT = Variant(
    lambda values: _COUNTS if "counts" in values else _INTERVAL,
    Table(
        (
            *_INTERVAL.keys,
            Key("counts", Counts(), "instead of the other keys: " + _COUNTS.keys[0].meaning, None),
        )
    ),
    _visit_values,
)


# ---- the scene


def _station_of(values: Values) -> Station:
    rotation = values["rotation"]
    with np.errstate(over="ignore", invalid="ignore"):
        is_orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE)
        if not (is_orthogonal and np.linalg.det(rotation) > 0):
            raise InvalidValueError("expected the rows of a rotation matrix", "rotation")
    return Station(**values)


def _station_values(station: Station) -> Values:
    return {"#": _view_direction(station.rotation), **vars(station)}


def _view_direction(rotation: NDArray[np.float64]) -> str:
    x, y, z = rotation[:, 0].tolist()
    yaw, pitch = math.degrees(math.atan2(y, x)), math.degrees(math.asin(max(-1.0, min(1.0, z))))
    return f"looks to yaw {yaw:.1f} deg, {abs(pitch):.1f} deg {'up' if pitch > 0 else 'down'}"


def _scene_table(values: Mapping[str, Any]) -> Table:
    """Return the table of a scene: lengths of stations have no unit if their scale is unknown."""
    if values.get("stations") and values.get("scale", "unit") == "unit":
        return _table_of_lengths("floor_z_units", "position_units", "covariance_units_rad")
    return _table_of_lengths("floor_z_mm", "position_mm", "covariance_m_rad")


def _table_of_lengths(floor_z: str, position: str, covariance: str) -> Table:
    station = Table(
        (
            Key("channel", CHANNEL, "channel (mode) of the station, once each"),
            Key("id", SerialNumber(), "serial number", None, "unknown"),
            Key(position, Array((3,)), "position of the rotor's centre", value_name="position"),
            Key(
                "rotation",
                Array((3, 3)),
                "rows of the rotation matrix from station to frame; its columns are the station's "
                "forward, left and up. The comment above is the direction of view",
            ),
            Key(
                covariance,
                PoseCovariance(),
                "covariance of position (m) and rotation vector (rad) in the frame",
                None,
                "unknown",
                value_name="covariance",
            ),
            Key(
                "floor_map_m",
                Array((3, 3)),
                "of a single station over a floor with markers: homography from its rays (1, y, z) "
                "to floor points (1, x, y) in m",
                None,
                "none",
                value_name="floor_map",
            ),
            Key("up", UnitVector(), _UP, None, "unknown"),
            Key("calibration", CALIBRATION),
        ),
        _station_of,
        _station_values,
    )
    return Table(
        (
            Key("frame", Text(), "name of the frame of all positions", "floor"),
            Key(
                "scale",
                Text(SCALES),
                "origin of the scale of the stations; `device` is a device of known size, `design` "
                "a designed room, `unit` an unknown scale",
                "unit",
            ),
            Key(
                "planar",
                Boolean(),
                "true if all devices move on the plane z = `floor_z_mm`",
                None,
                "unknown",
            ),
            Key(
                floor_z,
                ANY_NUMBER,
                "height of the photodiodes in a planar scene",
                0.0,
                value_name="floor_z",
            ),
            Key(
                "frame_source",
                Text(FRAME_SOURCES),
                "origin of the axes of the frame: `markers`, `floor` (z = 0 is the floor), "
                "`gravity` (z is up, at an unknown height), `station` (not level) or `design` (the "
                "axes of `room`; stations mounted by hand near to their designed poses)",
                None,
                "unknown",
            ),
            Key(
                "level_sigma_deg",
                NOT_NEGATIVE,
                "standard deviation of the inclination of the z axis against the vertical, or "
                "against the floor if this is the source of the frame; about each axis",
                None,
                "unknown",
            ),
            Key("notes", ListOf(Text()), "assumptions of the solution", ()),
            Key("stations", Tables(station), default=()),
            Key("markers", Tables(_MARKER), default=()),
            Key("distances", Tables(_DISTANCE), default=()),
            Key(
                "calibrations",
                Tables(Variant(_known_station_table, _known_station_table({}))),
                default=(),
            ),
            Key(
                "joint_covariance",
                _JOINT_COVARIANCE,
                default=None,
                default_text="unknown",
                value_name="covariance",
            ),
            Key("room", _ROOM, default=None, default_text="unknown"),
        ),
        _scene_of,
    )


_JOINT_COVARIANCE = Table(
    (
        Key(
            "factor",
            TriangularFactor(),
            "rows of the lower triangular factor L of the joint covariance L L^T of all stations, "
            f"in the order of `stations`, {JOINT_PARAMETERS} parameters each: position (m), "
            "rotation vector in the frame (rad), and of the first and the second sweep phase, "
            "tilt, curve, and magnitude times cosine and sine of the phase of gib and of ogee",
        ),
    ),
    lambda values: values["factor"],
    lambda covariance: {"factor": covariance},
)


# ---- the room

_CORNERS = Array((None, 2), Number(-1e3 * MAX_LENGTH_M, 1e3 * MAX_LENGTH_M), MAX_CORNERS)


def _obstacle_of(values: Values) -> Obstacle:
    try:
        return Obstacle(**values)
    except InputError as error:
        raise InvalidValueError(error.message, hint=error.hint) from None


_OBSTACLE = Table(
    (
        Key("name", Text(), "descriptive name", ""),
        Key("outline_mm", _CORNERS, "corners of a vertical prism that light does not pass"),
        Key("low_mm", NOT_NEGATIVE, "height of its lower face", 0.0),
        Key("high_mm", POSITIVE, "height of its upper face"),
    ),
    _obstacle_of,
    vars,
)


def _robots_of(values: Values) -> RobotSize:
    try:
        return RobotSize(**values)
    except InputError as error:
        raise InvalidValueError(error.message, hint=error.hint) from None


_ROBOTS = Table(
    (
        Key("count", Integer(1, MAX_ROBOTS), "number of robots in the working area"),
        Key("radius_mm", POSITIVE, "radius of the cylinder that a robot is"),
        Key("height_mm", POSITIVE, "its height"),
    ),
    _robots_of,
    vars,
)


def _room_of(values: Values) -> Room:
    low_m, high_m = values.pop("low_m"), values.pop("high_m")
    high_m = low_m if high_m is None else high_m
    tripods = values["tripods_m"]
    values["tripods_m"] = np.zeros((0, 3)) if tripods is None else tripods
    try:
        return Room(photodiode_z_m=(low_m, high_m), **values)
    except InputError as error:
        raise InvalidValueError(error.message, hint=error.hint) from None


def _room_values(room: Room) -> Values:
    low_m, high_m = room.photodiode_z_m
    tripods_m = room.tripods_m if len(room.tripods_m) else None
    return {
        **vars(room),
        "low_m": low_m,
        "high_m": None if room.is_planar else high_m,
        "tripods_m": tripods_m,
    }


_ROOM = Table(
    (
        Key("outline_mm", _CORNERS, "corners of the walls, along them"),
        Key("height_mm", POSITIVE, "height of the ceiling; z is 0 on the floor"),
        Key(
            "lowest_photodiode_mm",
            NOT_NEGATIVE,
            "height of the lowest photodiode",
            0.0,
            value_name="low_m",
        ),
        Key(
            "highest_photodiode_mm",
            NOT_NEGATIVE,
            "height of the highest one",
            None,
            "that of the lowest: all devices move on a plane",
            value_name="high_m",
        ),
        Key("area_mm", _CORNERS, "corners of the working area", None, "the whole room"),
        Key(
            "mounts",
            ListOf(Text(MOUNTS), 1),
            "kinds of places at which stations can be mounted",
            ("wall", "ceiling"),
        ),
        Key(
            "tripods_mm",
            Array((None, 3), Number(-1e3 * MAX_LENGTH_M, 1e3 * MAX_LENGTH_M), MAX_CORNERS),
            "positions of stations on tripods",
            None,
            "none",
        ),
        Key("robots", _ROBOTS, default=None, default_text="hide nothing"),
        Key("obstacles", Tables(_OBSTACLE), default=()),
    ),
    _room_of,
    _room_values,
)


# ---- points and the whole

_MARKER = Table(
    (
        Key("name", Text(), "name of a point that was measured by hand, once each"),
        Key("position_mm", Array((3,)), "its position; z is 0 on the floor", value_name="position"),
        Key("sightings", Tables(VISIT), default=(), value_name="visits"),
    ),
    lambda values: Marker(**values),
    vars,
)
_DISTANCE = Table(
    (
        Key("distance_mm", POSITIVE, "known distance between two visits", value_name="distance"),
        Key("first", VISIT, "first visit, with the keys of `markers.sightings`"),
        Key("second", VISIT, "second visit"),
    ),
    lambda values: Distance(**values),
    vars,
)


def _scene_of(values: Values) -> Scene:
    stations, markers, known = (values[k] for k in ("stations", "markers", "calibrations"))
    refuse_repeated((entry["channel"] for entry in known), "calibrations", "channel")
    refuse_repeated((station.channel for station in stations), "stations", "channel")
    refuse_repeated((marker.name for marker in markers), "markers", "name")
    calibrations = {e["channel"]: e["calibration"] for e in known if "calibration" in e}
    ids = {entry["channel"]: entry["id"] for entry in known if entry["id"] is not None}
    ups = {entry["channel"]: entry["up"] for entry in known if entry["up"] is not None}
    covariance, rows = values["covariance"], JOINT_PARAMETERS * len(stations)
    if covariance is not None and len(covariance) != rows:
        raise InvalidValueError(
            f"expected {rows} rows, {JOINT_PARAMETERS} for each of {len(stations)} stations, "
            f"not {len(covariance)}",
            "joint_covariance.factor",
        )
    return Scene(**{**values, "calibrations": calibrations, "ids": ids, "ups": ups})


def _scene_values(scene: Scene) -> Values:
    known: list[Values] = []
    for channel in sorted(scene.calibrations.keys() | scene.ids.keys() | scene.ups.keys()):
        entry: Values = {"channel": channel, "up": scene.ups.get(channel)}
        if channel in scene.ids:
            entry["id"] = scene.ids[channel]
        if channel in scene.calibrations:
            entry |= _calibration_values(scene.calibrations[channel])
        known.append(entry)
    return {**vars(scene), "calibrations": known}


SCENE: Artifact[Scene] = Artifact(
    SCENE_FILE, SCENE_FORMAT, Variant(_scene_table, _scene_table({}), _scene_values)
)
"""The scene as a file."""

dumps_scene, loads_scene, attached_scene = SCENE.dumps, SCENE.loads, SCENE.attached
write_scene, read_scene = SCENE.write, SCENE.read
