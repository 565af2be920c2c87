"""Artifact of the landmarks: the floor, ``map.toml``, and how it was really laid.

Its keys are described in docs/formats.md. Lengths are in mm and angles in degrees,
exactly: what is written and read again is the same to the last bit. The other artifact of
landmarks, ``halls.toml``, is in :mod:`.hall_sensors`, whose functions are also found here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import Geometry, code_of, name
from locatk.core.landmarks.map.floor import (
    ALPHABETS,
    HOLE_CODE,
    WINDOWS,
    AsBuiltLandmark,
    Cell,
    FloorMap,
    Wall,
)
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import Artifact, head
from locatk.formats.artifacts.checks import above, check_remanence
from locatk.formats.artifacts.hall_sensors import (
    HALLS_FILE,
    attached_halls,
    dumps_halls,
    halls_file,
    loads_halls,
    read_halls,
    write_halls,
)
from locatk.formats.artifacts.toml import Degrees, Shifted, Table

__all__ = [
    "HALLS_FILE",
    "MAP_FILE",
    "attached_halls",
    "attached_map",
    "dumps_halls",
    "dumps_map",
    "halls_file",
    "loads_halls",
    "loads_map",
    "map_rows",
    "read_halls",
    "read_map",
    "write_halls",
    "write_map",
]

MAP_FILE = "map.toml"
"""Name of the attachment that holds the map of a session or a solution."""

MAP_FORMAT = "locatk-landmark-map"
VERSION = 1

LETTERS = "0123456789abcdef"
"""How a landmark of each code is written in the rows of a map."""

NO_LANDMARK = "."
"""How a cell without a landmark is written."""

LARGEST_SIDE = 2_000

COMPASS = frozenset(map(code_of, ("NNNS", "SSSN", "NNSS")))
"""Codes of the alphabet ``compass``: each pattern in the one way to lay it."""

ROWS_COMMENT = (
    "One letter a landmark: the sum of 1, 2, 4 and 8 for each bar that is N, counter-clockwise\n"
    '# from the right-hand one; "." is a cell without. The FIRST row has the least y, the last\n'
    "# one the greatest: do not draw the map top-down, a mirrored map is no longer unique."
)
"""Of the file, as people edit it."""

_MM, _METRES = 3, -3
_MT = 3
_NEAR_M = 1e-9
"""Bars may touch."""


def dumps_map(floor: FloorMap) -> str:
    """TOML text of a map; the same map gives the same text."""
    x, y = floor.origin_m
    table = {
        **head(MAP_FORMAT, VERSION),
        "notes": list(floor.notes) or None,
        "map": {
            "name": floor.name or None,
            "alphabet": floor.alphabet,
            "window": floor.window,
            "detect": int(floor.detect),
            "seed": None if floor.seed is None else int(floor.seed),
            "pitch_mm": Shifted(floor.pitch_m, _MM),
            "origin_x_mm": Shifted(x, _MM),
            "origin_y_mm": Shifted(y, _MM),
            "#": ROWS_COMMENT,
            "rows": [],
            "walls": [] if floor.walls else None,
        },
        "landmark": _geometry_table(floor.geometry),
        "built": [_built_table(cell, built) for cell, built in sorted(floor.built.items())] or None,
    }
    rows = [f'"{row}"' for row in map_rows(floor.codes)]
    walls = [f"[[{a}, {b}], [{c}, {d}]]" for (a, b), (c, d) in sorted(floor.walls)]
    return _filled(_filled(toml.dumps(table), "rows", rows), "walls", walls)


def _filled(text: str, key: str, items: list[str]) -> str:
    """``text`` with its empty list of ``key`` filled, an item a line."""
    lines = "".join(f"  {item},\n" for item in items)
    return text.replace(f"\n{key} = []\n", f"\n{key} = [\n{lines}]\n", 1)


def map_rows(codes: NDArray[np.int64]) -> list[str]:
    """Codes as the rows of a map are written, the one of the least y first."""
    letters = np.array([NO_LANDMARK, *LETTERS])[codes + 1]
    return ["".join(row) for row in letters.tolist()]


def _geometry_table(geometry: Geometry) -> dict[str, Any]:
    return {
        "bar_length_mm": Shifted(geometry.bar_length_m, _MM),
        "bar_width_mm": Shifted(geometry.bar_width_m, _MM),
        "bar_height_mm": Shifted(geometry.bar_height_m, _MM),
        "remanence_t": float(geometry.remanence_t),
        "radius_mm": Shifted(geometry.radius_m, _MM),
        "sensor_height_mm": Shifted(geometry.sensor_height_m, _MM),
        "circle_mm": Shifted(geometry.circle_m, _MM),
        "threshold_mt": Shifted(geometry.threshold_t, _MT),
    }


def _built_table(cell: Cell, built: AsBuiltLandmark) -> dict[str, Any]:
    sigma_x, sigma_y, sigma_heading = built.sigma[:3].tolist()
    strengths = np.asarray(built.sigma[3:], float)
    return {
        "cell": [int(index) for index in cell],
        "x_mm": Shifted(built.x_m, _MM),
        "y_mm": Shifted(built.y_m, _MM),
        "heading_deg": Degrees(built.heading_rad),
        "strength": np.asarray(built.strength, float),
        "sigma_x_mm": None if math.isnan(sigma_x) else Shifted(sigma_x, _MM),
        "sigma_y_mm": None if math.isnan(sigma_y) else Shifted(sigma_y, _MM),
        "sigma_heading_deg": None if math.isnan(sigma_heading) else Degrees(sigma_heading),
        "sigma_strength": None if np.isnan(strengths).all() else strengths,
        "visits": int(built.visits),
        "flags": list(built.flags) or None,
    }


# ---- reading maps


def _map(table: Table) -> FloorMap:
    toml.check_format(table, MAP_FORMAT, VERSION)
    notes = table.texts("notes", ())
    sheet = table.table("map")
    geometry = _geometry(table.table("landmark"))
    alphabet = sheet.text("alphabet", choices=ALPHABETS)
    codes = _codes(sheet, alphabet)
    pitch = above(sheet, "pitch_mm", shift=_METRES)
    least = 2 * geometry.radius_m + geometry.bar_width_m
    if pitch < least - _NEAR_M:
        raise sheet.error(
            "pitch_mm",
            "bars of neighbouring landmarks overlap, expected at least "
            f"{1e3 * least:g} with the bars of [landmark]",
        )
    floor = FloorMap(
        codes=codes,
        pitch_m=pitch,
        alphabet=alphabet,
        window=sheet.text("window", choices=WINDOWS),
        detect=sheet.integer("detect", 0, 8, 0),
        geometry=geometry,
        origin_m=(
            sheet.number("origin_x_mm", 0.0, shift=_METRES),
            sheet.number("origin_y_mm", 0.0, shift=_METRES),
        ),
        walls=_walls(sheet, codes.shape),
        built=_all_built(table.tables("built"), codes, pitch),
        name=sheet.text("name", ""),
        seed=sheet.integer("seed", 0, 2**63 - 1, None),
        notes=notes,
    )
    sheet.end()
    table.end()
    return floor


def _codes(sheet: Table, alphabet: str) -> NDArray[np.int64]:
    rows = sheet.texts("rows")
    if not rows or not rows[0]:
        raise sheet.error("rows", "an empty map, expected a list of strings, one a row")
    if max(len(rows), len(rows[0])) > LARGEST_SIDE:
        raise sheet.error("rows", f"expected at most {LARGEST_SIDE} rows and columns")
    known = {letter: code for code, letter in enumerate(LETTERS)}
    known |= {letter.upper(): code for letter, code in known.items()} | {NO_LANDMARK: HOLE_CODE}
    for number, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise sheet.error(
                f"rows[{number}]",
                f"expected {len(rows[0])} letters as in the first row, not {len(row)}",
                f"Write {NO_LANDMARK!r} where there is no landmark",
            )
        for column, letter in enumerate(row):
            if letter not in known:
                raise sheet.error(
                    f"rows[{number}]",
                    f"unknown letter {letter!r} in column {column}, expected 0 to 9, a to f, or "
                    f"{NO_LANDMARK!r} for no landmark",
                )
    codes = np.array([[known[letter] for letter in row] for row in rows], np.int64)
    if (codes == HOLE_CODE).all():
        raise sheet.error("rows", "an empty map: no cell has a landmark")
    if alphabet == "compass":
        strangers = np.argwhere(~np.isin(codes, [HOLE_CODE, *COMPASS]))
        if len(strangers):
            row, column = strangers[0].tolist()
            letters = ", ".join(f"{LETTERS[code]} ({name(code)})" for code in sorted(COMPASS))
            raise sheet.error(
                f"rows[{row}]",
                f"{rows[row][column]!r} in column {column} is not of the alphabet compass: "
                f"expected {letters}",
            )
    return codes


def _walls(sheet: Table, shape: tuple[int, ...]) -> frozenset[Wall]:
    pairs = sheet.raw("walls", [])
    if not isinstance(pairs, list):
        raise sheet.error("walls", "expected a list of [[row, column], [row, column]]")
    walls = set()
    for number, pair in enumerate(pairs):
        key = f"walls[{number}]"
        if not isinstance(pair, list) or len(pair) != 2:
            raise sheet.error(key, "expected two cells, [[row, column], [row, column]]")
        one, other = sorted(_cell(sheet, key, cell, shape) for cell in pair)
        if abs(one[0] - other[0]) + abs(one[1] - other[1]) != 1:
            raise sheet.error(key, f"{list(one)} and {list(other)} are no neighbours")
        walls.add((one, other))
    return frozenset(walls)


def _cell(table: Table, key: str, value: Any, shape: tuple[int, ...]) -> Cell:
    whole = isinstance(value, list) and all(type(index) is int for index in value)
    if not whole or len(value) != 2:
        raise table.error(key, "expected a cell, [row, column]")
    if not (0 <= value[0] < shape[0] and 0 <= value[1] < shape[1]):
        raise table.error(
            key,
            f"{value} is no cell of the map, whose last one is [{shape[0] - 1}, {shape[1] - 1}]",
        )
    return value[0], value[1]


def _geometry(table: Table) -> Geometry:
    geometry = Geometry(
        bar_length_m=above(table, "bar_length_mm", shift=_METRES),
        bar_width_m=above(table, "bar_width_mm", shift=_METRES),
        bar_height_m=above(table, "bar_height_mm", shift=_METRES),
        remanence_t=above(table, "remanence_t"),
        radius_m=above(table, "radius_mm", shift=_METRES),
        sensor_height_m=above(table, "sensor_height_mm", shift=_METRES),
        circle_m=above(table, "circle_mm", shift=_METRES),
        threshold_t=above(table, "threshold_mt", shift=-_MT),
    )
    table.end()
    check_remanence(table, geometry.remanence_t)
    least = (geometry.bar_length_m + geometry.bar_width_m) / 2
    if geometry.radius_m < least - _NEAR_M:
        raise table.error(
            "radius_mm",
            f"the bars overlap at their corners, expected at least {1e3 * least:g}, half of "
            "bar_length_mm and bar_width_mm",
        )
    return geometry


def _all_built(
    tables: list[Table], codes: NDArray[np.int64], pitch_m: float
) -> Mapping[Cell, AsBuiltLandmark]:
    """As-built landmarks by cell, each once and where there is one."""
    found: dict[Cell, AsBuiltLandmark] = {}
    for table in tables:
        cell = _cell(table, "cell", table.raw("cell"), codes.shape)
        if cell in found:
            raise table.error("cell", f"{list(cell)} is there twice")
        if codes[cell] == HOLE_CODE:
            raise table.error("cell", f"{list(cell)} has no landmark in rows")
        found[cell] = _built(table, pitch_m)
    return found


def _built(table: Table, pitch_m: float) -> AsBuiltLandmark:
    strengths = np.full(4, np.nan)
    if table.raw("sigma_strength", None) is not None:
        strengths = table.array("sigma_strength", (4,), nan=True)
    sigma = (
        table.number("sigma_x_mm", math.nan, shift=_METRES),
        table.number("sigma_y_mm", math.nan, shift=_METRES),
        table.angle("sigma_heading_deg", math.nan),
        *strengths,
    )
    built = AsBuiltLandmark(
        x_m=table.number("x_mm", shift=_METRES),
        y_m=table.number("y_mm", shift=_METRES),
        heading_rad=table.angle("heading_deg"),
        strength=table.array("strength", (4,)),
        sigma=np.array(sigma),
        visits=table.integer("visits", 0, 10**9, 0),
        flags=table.texts("flags", ()),
    )
    table.end()
    if max(abs(built.x_m), abs(built.y_m)) > pitch_m / 2:
        key = "x_mm" if abs(built.x_m) >= abs(built.y_m) else "y_mm"
        raise table.error(key, "the landmark is nearer to another cell than to its own")
    if abs(built.heading_rad) > math.pi:
        raise table.error("heading_deg", "expected an angle from -180 to 180")
    if (built.sigma < 0).any():
        names = ("sigma_x_mm", "sigma_y_mm", "sigma_heading_deg", *["sigma_strength"] * 4)
        raise table.error(names[int(np.argmax(built.sigma < 0))], "expected numbers from 0")
    return built


MAP = Artifact(MAP_FILE, dumps_map, _map)
"""The floor as a file; these are its methods."""

write_map, read_map, loads_map, attached_map = MAP.write, MAP.read, MAP.loads, MAP.attached
