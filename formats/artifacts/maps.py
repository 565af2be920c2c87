"""Artifacts of the landmarks: the floor, ``map.toml``, and the robot's sensors, ``halls.toml``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.landmark import Geometry, code_of, name
from locatk.core.landmarks.map.floor import (
    ALPHABETS,
    HOLE_CODE,
    WINDOWS,
    AsBuiltLandmark,
    FloorMap,
    Wall,
)
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    CELL,
    NO_UNIT,
    NOT_NEGATIVE,
    POSITIVE,
    REMANENCE,
    Integer,
    InvalidValueError,
    ListOf,
    Number,
    Row,
    Text,
    Unit,
)
from locatk.formats.artifacts.schema import (
    Array,
    Artifact,
    Key,
    LinesOf,
    Table,
    Tables,
    Values,
    refuse_equal_positions,
    refuse_repeated,
)
from locatk.formats.artifacts.toml import Lines

MAP_FILE = "map.toml"
"""Name of the attachment that holds the map of a session or a solution."""

HALLS_FILE = "halls.toml"
"""Name of the attachment that holds the hall sensors of a session."""

MAP_FORMAT = "locatk-landmark-map"
HALLS_FORMAT = "locatk-hall-sensors"

LETTERS = "0123456789abcdef"
"""Letters of the codes in the rows of a map."""

NO_LANDMARK = "."
"""Letter of a cell without a landmark."""

MAX_ROWS = 2_000
"""Rows or columns of a map."""

MAX_SEED = 2**63 - 1
MAX_DETECTED = 8
MAX_VISITS = 10**9
MAX_HALL_SENSORS = 1_000

COMPASS_CODES = frozenset(map(code_of, ("NNNS", "SSSN", "NNSS")))
"""Codes of the alphabet ``compass``: each pattern in its one orientation."""

ROWS_COMMENT = (
    "One letter a landmark: the sum of 1, 2, 4 and 8 for each bar that is N, counter-clockwise\n"
    'from the right-hand one; "." is a cell without. The FIRST row has the least y, the last\n'
    "one the greatest: do not draw the map top-down, a mirrored map is no longer unique."
)
"""Comment of the rows, for people who edit the file."""

OVERLAP_TOLERANCE_M = 1e-9
"""Bars may touch."""


def map_rows(codes: NDArray[np.int64]) -> list[str]:
    """Return codes as the rows of a map are written, first the row of the least y."""
    letters = np.array([NO_LANDMARK, *LETTERS])[codes + 1]
    return ["".join(row) for row in letters.tolist()]


@dataclass(frozen=True)
class CodeRows:
    """Codes (rows, columns) as strings of one letter a cell."""

    expected = "a list of strings"
    plural = "lists of strings"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> NDArray[np.int64]:
        rows = ListOf(Text()).parse(value)
        if not rows or not rows[0]:
            raise InvalidValueError("an empty map, expected a list of strings, one a row")
        if max(len(rows), len(rows[0])) > MAX_ROWS:
            raise InvalidValueError(f"expected at most {MAX_ROWS} rows and columns")
        codes = {letter: code for code, letter in enumerate(LETTERS)}
        codes |= {letter.upper(): code for letter, code in codes.items()}
        codes[NO_LANDMARK] = HOLE_CODE
        for number, row in enumerate(rows):
            if len(row) != len(rows[0]):
                raise InvalidValueError(
                    f"expected {len(rows[0])} letters as in the first row, not {len(row)}",
                    f"[{number}]",
                    f"Write {NO_LANDMARK!r} for a cell without a landmark",
                )
            for column, letter in enumerate(row):
                if letter not in codes:
                    raise InvalidValueError(
                        f"unknown letter {letter!r} in column {column}, expected 0 to 9, a to f, "
                        f"or {NO_LANDMARK!r} for no landmark",
                        f"[{number}]",
                    )
        grid = np.array([[codes[letter] for letter in row] for row in rows], np.int64)
        if (grid == HOLE_CODE).all():
            raise InvalidValueError("an empty map: no cell has a landmark")
        return grid

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Lines:
        return Lines(map_rows(value))


# ---- maps


def _geometry_of(values: Values) -> Geometry:
    geometry = Geometry(**values)
    min_radius_m = (geometry.bar_length_m + geometry.bar_width_m) / 2
    if geometry.radius_m < min_radius_m - OVERLAP_TOLERANCE_M:
        raise InvalidValueError(
            f"the bars overlap at their corners, expected at least {1e3 * min_radius_m:g}, half of "
            "bar_length_mm and bar_width_mm",
            "radius_mm",
        )
    return geometry


def _built_of(values: Values) -> tuple[tuple[int, int], AsBuiltLandmark]:
    cell, strengths = values.pop("cell"), values.pop("sigma_strength")
    sigma = [values.pop(key) for key in ("sigma_x_m", "sigma_y_m", "sigma_heading_rad")]
    sigma += [math.nan] * 4 if strengths is None else strengths.tolist()
    return cell, AsBuiltLandmark(**values, sigma=np.array(sigma))


def _built_values(built: tuple[tuple[int, int], AsBuiltLandmark]) -> Values:
    cell, landmark = built
    keys = ("sigma_x_m", "sigma_y_m", "sigma_heading_rad")
    strengths = np.asarray(landmark.sigma[3:], float)
    return {
        "cell": cell,
        **vars(landmark),
        **{
            key: None if math.isnan(sigma) else sigma
            for key, sigma in zip(keys, landmark.sigma[:3].tolist(), strict=True)
        },
        "sigma_strength": None if np.isnan(strengths).all() else strengths,
    }


def _map_of(values: Values) -> FloorMap:
    grid, geometry, built = values["map"], values["landmark"], values["built"]
    codes, pitch_m = grid["rows"], grid["pitch_m"]
    if grid["alphabet"] == "compass":
        _check_compass(codes)
    min_pitch_m = 2 * geometry.radius_m + geometry.bar_width_m
    if pitch_m < min_pitch_m - OVERLAP_TOLERANCE_M:
        raise InvalidValueError(
            "bars of neighbouring landmarks overlap, expected at least "
            f"{1e3 * min_pitch_m:g} with the bars of [landmark]",
            "map.pitch_mm",
        )
    walls = [_wall(pair, codes.shape, f"map.walls[{k}]") for k, pair in enumerate(grid["walls"])]
    for number, (cell, landmark) in enumerate(built):
        _check_built(cell, landmark, codes, pitch_m, f"built[{number}]")
    refuse_repeated((cell for cell, _ in built), "built", "cell")
    return FloorMap(
        codes=codes,
        pitch_m=pitch_m,
        alphabet=grid["alphabet"],
        window=grid["window"],
        detect=grid["detect"],
        geometry=geometry,
        origin_m=(grid["origin_x_m"], grid["origin_y_m"]),
        walls=frozenset(walls),
        built=dict(built),
        name=grid["name"],
        seed=grid["seed"],
        notes=values["notes"],
    )


def _check_compass(codes: NDArray[np.int64]) -> None:
    others = np.argwhere(~np.isin(codes, [HOLE_CODE, *COMPASS_CODES]))
    if len(others):
        row, column = others[0].tolist()
        letters = ", ".join(f"{LETTERS[code]} ({name(code)})" for code in sorted(COMPASS_CODES))
        raise InvalidValueError(
            f"{LETTERS[codes[row, column]]!r} in column {column} is not of the alphabet compass: "
            f"expected {letters}",
            f"map.rows[{row}]",
        )


def _wall(pair: tuple[tuple[int, int], ...], shape: tuple[int, ...], key: str) -> Wall:
    first, second = sorted(pair)
    for cell in (first, second):
        _check_cell(cell, shape, key)
    if abs(first[0] - second[0]) + abs(first[1] - second[1]) != 1:
        raise InvalidValueError(f"{list(first)} and {list(second)} are not neighbours", key)
    return first, second


def _check_cell(cell: tuple[int, int], shape: tuple[int, ...], key: str) -> None:
    if not (cell[0] < shape[0] and cell[1] < shape[1]):
        raise InvalidValueError(
            f"{list(cell)} is not a cell of the map, whose last one is "
            f"[{shape[0] - 1}, {shape[1] - 1}]",
            key,
        )


def _check_built(
    cell: tuple[int, int],
    landmark: AsBuiltLandmark,
    codes: NDArray[np.int64],
    pitch_m: float,
    path: str,
) -> None:
    _check_cell(cell, codes.shape, f"{path}.cell")
    if codes[cell] == HOLE_CODE:
        raise InvalidValueError(f"{list(cell)} has no landmark in rows", f"{path}.cell")
    for key, offset_m in (("x_mm", landmark.x_m), ("y_mm", landmark.y_m)):
        if abs(offset_m) > pitch_m / 2:
            raise InvalidValueError(
                "the landmark is closer to another cell than to its own", f"{path}.{key}"
            )


def _map_values(floor: FloorMap) -> Values:
    x_m, y_m = floor.origin_m
    grid = {**vars(floor), "origin_x_m": x_m, "origin_y_m": y_m, "rows": floor.codes}
    grid["walls"] = sorted(floor.walls)
    return {
        "notes": floor.notes,
        "map": grid,
        "landmark": floor.geometry,
        "built": sorted(floor.built.items()),
    }


_MAP_KEYS = (
    Key("name", Text(), "for people", ""),
    Key(
        "alphabet",
        Text(ALPHABETS),
        "the part of a landmark that is read: `6` its pattern, `16` also its orientation, "
        "`compass` only NNNS, SSSN and NNSS (codes 7, 8, 3), each in that one orientation",
    ),
    Key("window", Text(WINDOWS), "cells of a reading"),
    Key(
        "detect",
        Integer(0, MAX_DETECTED),
        "misread landmarks of a window that are always detected",
        0,
    ),
    Key("seed", Integer(0, MAX_SEED), "seed of the search", None, "none"),
    Key(
        "pitch_mm",
        POSITIVE,
        "distance of neighbouring cells, at least 2 `radius_mm` + `bar_width_mm`",
    ),
    Key("origin_x_mm", ANY_NUMBER, "position of row 0, column 0", 0.0),
    Key("origin_y_mm", ANY_NUMBER, "position of row 0, column 0", 0.0),
    Key(
        "rows",
        CodeRows(),
        "a string a row, a letter a cell: the code as a hexadecimal digit (bit k is set if bar k, "
        "at 90 k degrees counter-clockwise from +x, is N), `.` for none. **The first string is the "
        "row of the least y**",
        comment=ROWS_COMMENT,
    ),
    Key(
        "walls",
        LinesOf(Row(CELL, 2)),
        "pairs of neighbouring cells `[row, column]` between which a robot cannot drive",
        (),
    ),
)
_GEOMETRY_KEYS = (
    Key("bar_length_mm", POSITIVE, "of each bar, which is magnetised along its length"),
    Key("bar_width_mm", POSITIVE, "of each bar"),
    Key("bar_height_mm", POSITIVE, "of each bar, vertical"),
    Key("remanence_t", REMANENCE, "of the bars"),
    Key("radius_mm", POSITIVE, "from the centre of the landmark to the middle of a bar"),
    Key("sensor_height_mm", POSITIVE, "from the tops of the bars to the sensors"),
    Key("circle_mm", POSITIVE, "radius of the circle of hall sensors"),
    Key("threshold_mt", POSITIVE, "field at which a sensor enters the territory"),
)
_BUILT_KEYS = (
    Key("cell", CELL, "row and column of a landmark as built; each once"),
    Key("x_mm", ANY_NUMBER, "from the cell to the centre of the landmark, at most half a pitch"),
    Key("y_mm", ANY_NUMBER, "from the cell to the centre of the landmark, at most half a pitch"),
    Key("heading_deg", Number(-180, 180), "from the x of the map to the x of the landmark"),
    Key("strength", Array((4,)), "of the bars, signed as they are; 1 is nominal, 0 missing"),
    Key("sigma_x_mm", NOT_NEGATIVE, "standard deviation", math.nan, "unknown"),
    Key("sigma_y_mm", NOT_NEGATIVE, "standard deviation", math.nan, "unknown"),
    Key("sigma_heading_deg", NOT_NEGATIVE, "standard deviation", math.nan, "unknown"),
    Key(
        "sigma_strength",
        Array((4,), Number(0.0, is_nan_allowed=True)),
        "standard deviations; `nan` if unknown",
        None,
        "unknown",
    ),
    Key("visits", Integer(0, MAX_VISITS), "number of visits that it was measured in", 0),
    Key(
        "flags",
        ListOf(Text()),
        "`flipped:<bar>`, `weak:<bar>`, `missing:<bar>`, `displaced`, `turned`",
        (),
    ),
)

MAP: Artifact[FloorMap] = Artifact(
    MAP_FILE,
    MAP_FORMAT,
    Table(
        (
            Key("notes", ListOf(Text()), "for people", ()),
            Key("map", Table(_MAP_KEYS)),
            Key("landmark", Table(_GEOMETRY_KEYS, _geometry_of, vars)),
            Key("built", Tables(Table(_BUILT_KEYS, _built_of, _built_values)), default=()),
        ),
        _map_of,
        _map_values,
    ),
)
"""A map as a file."""

dumps_map, loads_map, attached_map = MAP.dumps, MAP.loads, MAP.attached
write_map, read_map = MAP.write, MAP.read


# ---- hall sensors


def _halls_of(values: Values) -> HallSensors:
    names, position = values["names"], values["position_m"]
    if not all(names):
        raise InvalidValueError("expected a list of names, one a sensor", "names")
    if len(set(names)) < len(names):
        raise InvalidValueError("two sensors of one name", "names")
    if len(position) != len(names):
        raise InvalidValueError(f"expected a list of {len(names)} rows of 2 numbers", "position_mm")
    refuse_equal_positions(position, "position_mm", names)
    return HallSensors(**values)


def _halls_values(sensors: HallSensors) -> Values:
    return {
        **vars(sensors),
        "noise_t": None if math.isnan(sensors.noise_t) else sensors.noise_t,
        "range_t": None if math.isinf(sensors.range_t) else sensors.range_t,
    }


HALLS: Artifact[HallSensors] = Artifact(
    HALLS_FILE,
    HALLS_FORMAT,
    Table(
        (
            Key("sensor", Text(), "part number and settings, for people", ""),
            Key(
                "noise_ut",
                POSITIVE,
                "standard deviation of a sample; if unknown, it is estimated from the samples",
                math.nan,
                "unknown",
            ),
            Key(
                "range_mt",
                POSITIVE,
                "largest measurable field; samples at it are saturated",
                math.inf,
                "unknown",
            ),
            Key(
                "names",
                ListOf(Text(), 1, MAX_HALL_SENSORS),
                "of the sensors, in the order of the samples; each once",
            ),
            Key(
                "position_mm",
                Array((None, 2), max_rows=MAX_HALL_SENSORS),
                "x and y of each sensor; no two are equal",
            ),
        ),
        _halls_of,
        _halls_values,
    ),
)
"""Hall sensors as a file."""

dumps_halls, loads_halls, write_halls, read_halls = (
    HALLS.dumps,
    HALLS.loads,
    HALLS.write,
    HALLS.read,
)
attached_halls, halls_file = HALLS.attached_for, HALLS.file_for
