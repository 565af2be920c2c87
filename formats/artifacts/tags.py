"""Artifacts of Polaris: the tags, ``tag.toml``, and the sensor array, ``array.toml``.

Their keys are described in docs/formats.md. Lengths are in mm and angles in degrees,
exactly: what is written and read again is the same to the last bit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from locatk.core.errors import InputError
from locatk.core.polaris.array import Array, SensorArray
from locatk.core.polaris.tag import CODECS, AsBuiltTag, Magnet, PlanarPose, Tags
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import Artifact, head
from locatk.formats.artifacts.checks import above, check_remanence, twin
from locatk.formats.artifacts.toml import Degrees, Shifted, Table

TAG_FILE = "tag.toml"
"""Name of the attachment that holds the tags of a session or a solution."""

ARRAY_FILE = "array.toml"
"""Name of the attachment that holds the array of a session; see :func:`attached_array`."""

TAG_FORMAT = "locatk-tag"
ARRAY_FORMAT = "locatk-sensor-array"
VERSION = 1

LARGEST_ORDER = 100
LARGEST_ORIENTATIONS = 360
LARGEST_ARRAY = 10_000

_MM, _METRES = 3, -3
_UT, _TESLA = 6, -6
_MS, _SECONDS = 3, -3


def dumps_tags(tags: Tags) -> str:
    """TOML text of tags; the same tags give the same text."""
    magnet = tags.magnet
    family = {
        "ids": None if tags.ids is None else [int(number) for number in tags.ids],
        "min_distance": int(tags.min_distance),
    }
    table = {
        **head(TAG_FORMAT, VERSION),
        "codec": tags.codec,
        "order": int(tags.order),
        "magnets": int(tags.magnets),
        "orientations": int(tags.orientations),
        "spacing_mm": Shifted(tags.spacing_m, _MM),
        "clearance_mm": Shifted(tags.clearance_m, _MM),
        "notes": list(tags.notes) or None,
        "magnet": {
            "diameter_mm": Shifted(magnet.diameter_m, _MM),
            "height_mm": Shifted(magnet.height_m, _MM),
            "remanence_t": float(magnet.remanence_t),
            "grade": magnet.grade or None,
        },
        "family": None if (tags.ids, tags.min_distance) == (None, 1) else family,
        "built": [
            {
                "id": int(number),
                "passes": int(built.passes),
                "offset_mm": Shifted(np.asarray(built.offset_m, float), _MM),
                "angle_deg": Degrees(np.asarray(built.angle_rad, float)),
            }
            for number, built in sorted(tags.built.items())
        ],
        "site": [
            {
                "id": int(number),
                "x_mm": Shifted(place.x_m, _MM),
                "y_mm": Shifted(place.y_m, _MM),
                "heading_deg": Degrees(place.heading_rad),
            }
            for number, place in sorted(tags.site.items())
        ],
    }
    return toml.dumps({key: value for key, value in table.items() if value != []})


def dumps_array(array: SensorArray) -> str:
    """TOML text of an array; the same array gives the same text. What is not known of it
    is left out."""
    noise, limit = (np.asarray(v, float) for v in (array.noise_t, array.range_t))
    limit = np.where(np.isinf(limit), np.nan, limit)
    return toml.dumps(
        {
            **head(ARRAY_FORMAT, VERSION),
            "sensor": array.sensor or None,
            "noise_ut": None if np.isnan(noise).all() else Shifted(noise, _UT),
            "delay_ms": Shifted(np.asarray(array.delay_s, float), _MS),
            "quantum_ut": Shifted(array.quantum_t, _UT) if np.any(array.quantum_t) else None,
            "range_ut": None if np.isnan(limit).all() else Shifted(limit, _UT),
            "position_mm": Shifted(np.asarray(array.position_m, float), _MM),
        }
    )


# ---- reading tags


def _tags(table: Table) -> Tags:
    toml.check_format(table, TAG_FORMAT, VERSION)
    codec = table.text("codec", choices=CODECS)
    order = table.integer("order", 2, LARGEST_ORDER)
    magnets = table.integer("magnets", 3, order * order - 1)
    spacing = above(table, "spacing_mm", shift=_METRES)
    magnet = _magnet(table.table("magnet"), spacing)
    ids, distance = _family(table.table("family", None))
    design = Tags(
        order=order,
        magnets=magnets,
        orientations=table.integer("orientations", 2, LARGEST_ORIENTATIONS),
        spacing_m=spacing,
        codec=codec,
        magnet=magnet,
        clearance_m=above(table, "clearance_mm", shift=_METRES),
        ids=ids,
        min_distance=distance,
        notes=table.texts("notes", ()),
    )
    built, site = table.tables("built"), table.tables("site")
    table.end()
    known = _known(table, design)
    return replace(
        design,
        built={number: _built(entry, design) for number, entry in _by_id(built, known)},
        site={number: _placed(entry) for number, entry in _by_id(site, known)},
    )


def _magnet(table: Table, spacing_m: float) -> Magnet:
    magnet = Magnet(
        diameter_m=above(table, "diameter_mm", shift=_METRES),
        height_m=above(table, "height_mm", shift=_METRES),
        remanence_t=above(table, "remanence_t"),
        grade=table.text("grade", ""),
    )
    table.end()
    if magnet.diameter_m > spacing_m:
        raise table.error("diameter_mm", "expected no more than spacing_mm")
    check_remanence(table, magnet.remanence_t)
    return magnet


def _family(table: Table | None) -> tuple[tuple[int, ...] | None, int]:
    """Members, None where any id is one, and their distance."""
    if table is None:
        return None, 1
    ids = table.raw("ids", None)
    whole = isinstance(ids, list) and all(type(number) is int and number >= 0 for number in ids)
    if ids is not None and not (ids and whole):
        raise table.error("ids", "expected a list of whole numbers from 0")
    if ids is not None and len(set(ids)) < len(ids):
        raise table.error("ids", f"{Counter(ids).most_common(1)[0][0]} is there twice")
    distance = table.integer("min_distance", 1, 10**6, 1)
    table.end()
    return None if ids is None else tuple(ids), distance


def _known(table: Table, tags: Tags) -> Callable[[int], str | None]:
    """What tells why a number is no id of ``tags``; the design itself is checked first."""
    from locatk.core.polaris import codec

    try:
        codec.check_design(tags)
    except InputError as error:
        raise table.error("", error.message, error.hint) from None
    capacity = codec.capacity(tags)
    members = None if tags.ids is None else frozenset(tags.ids)

    def why(number: int) -> str | None:
        if number >= capacity:
            return f"{number} is no id of this design, whose ids end at {capacity - 1}"
        return None if members is None or number in members else f"{number} is not in the family"

    for number in tags.ids or ():
        if (wrong := why(number)) is not None:
            raise table.error("family.ids", wrong)
    return why


def _by_id(tables: list[Table], why: Callable[[int], str | None]) -> Iterator[tuple[int, Table]]:
    """Ids and their tables, each once and of the family."""
    seen = set()
    for table in tables:
        number = table.raw("id")
        if type(number) is not int or number < 0:
            raise table.error("id", "expected a whole number from 0")
        wrong = f"{number} is there twice" if number in seen else why(number)
        if wrong is not None:
            raise table.error("id", wrong)
        seen.add(number)
        yield number, table


def _built(table: Table, tags: Tags) -> AsBuiltTag:
    built = AsBuiltTag(
        offset_m=table.array("offset_mm", (tags.magnets, 2), shift=_METRES),
        angle_rad=table.angles("angle_deg", tags.magnets),
        passes=table.integer("passes", 0, 10**9, 0),
    )
    table.end()
    if np.hypot(*built.offset_m.T).max() > tags.spacing_m / 2:
        raise table.error("offset_mm", "a magnet is nearer to another cell than to its own")
    if np.abs(built.angle_rad).max() > math.pi:
        raise table.error("angle_deg", "expected angles from -180 to 180")
    return built


def _placed(table: Table) -> PlanarPose:
    place = PlanarPose(
        x_m=table.number("x_mm", shift=_METRES),
        y_m=table.number("y_mm", shift=_METRES),
        heading_rad=table.angle("heading_deg"),
    )
    table.end()
    return place


# ---- reading arrays


def _array(table: Table) -> SensorArray:
    toml.check_format(table, ARRAY_FORMAT, VERSION)
    rows = table.raw("position_mm")
    if not isinstance(rows, list) or not 1 <= len(rows) <= LARGEST_ARRAY:
        raise table.error("position_mm", "expected a list of [x, y, z], one a sensor")
    position = table.array("position_mm", (len(rows), 3), shift=_METRES)
    if (one := twin(position)) is not None:
        raise table.error("position_mm", f"two sensors at the place of sensor {one}")
    limit = _axes(table, "range_ut", _TESLA, np.nan)
    array = SensorArray(
        position_m=position,
        noise_t=_axes(table, "noise_ut", _TESLA, np.nan),
        delay_s=_axes(table, "delay_ms", _SECONDS, 0.0),
        quantum_t=_axes(table, "quantum_ut", _TESLA, 0.0),
        range_t=np.where(np.isnan(limit), np.inf, limit),
        sensor=table.text("sensor", ""),
    )
    table.end()
    for key, wrong, words in (
        ("noise_ut", array.noise_t <= 0, "above 0"),
        ("range_ut", array.range_t <= 0, "above 0"),
        ("quantum_ut", array.quantum_t < 0, "from 0"),
    ):
        if wrong.any():
            raise table.error(key, f"expected three numbers {words}, by axis")
    return array


def _axes(table: Table, key: str, shift: int, default: float) -> Array:
    """Three numbers, of x, y and z; where ``default`` is nan, each may be unknown."""
    if key not in table:
        table.raw(key, None)  # known also where it is missing
        return np.full(3, default)
    return table.array(key, (3,), shift=shift, nan=math.isnan(default))


TAGS = Artifact(TAG_FILE, dumps_tags, _tags)
ARRAY = Artifact(ARRAY_FILE, dumps_array, _array)
"""Tags and arrays as files; these are their methods."""

write_tags, read_tags, loads_tags, attached_tags = TAGS.write, TAGS.read, TAGS.loads, TAGS.attached
write_array, read_array, loads_array = ARRAY.write, ARRAY.read, ARRAY.loads
attached_array, array_file = ARRAY.attached_for, ARRAY.file_for
