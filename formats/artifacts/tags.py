"""Artifacts of Polaris: the tags, ``tag.toml``, and the sensor array, ``array.toml``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.tag import (
    CODECS,
    MAX_MEANING_CHARACTERS,
    AsBuiltTag,
    Magnet,
    PlanarPose,
    Tags,
)
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    NOT_NEGATIVE,
    REMANENCE,
    Integer,
    InvalidValueError,
    ListOf,
    Number,
    Text,
)
from locatk.formats.artifacts.schema import (
    Array,
    Artifact,
    Key,
    Table,
    Tables,
    Values,
    refuse_equal_positions,
    refuse_repeated,
)

TAG_FILE = "tag.toml"
"""Name of the attachment that holds the tags of a session or a solution."""

ARRAY_FILE = "array.toml"
"""Name of the attachment that holds the array of a session."""

TAG_FORMAT = "locatk-tag"
ARRAY_FORMAT = "locatk-sensor-array"

MAX_ORDER = 100
MAX_ORIENTATIONS = 360
MAX_MIN_DISTANCE = 10**6
MAX_PASSES = 10**9
MAX_SENSORS = 10_000


# ---- tags


def _tags_of(values: Values) -> Tags:
    family = values.pop("family") or {"ids": None, "min_distance": 1}
    built = {entry.pop("id"): AsBuiltTag(**entry) for entry in _by_id(values.pop("built"), "built")}
    site, site_sigma = {}, {}
    for entry in _by_id(values.pop("site"), "site"):
        tag_id, sigma_m, sigma_rad = (entry.pop(key) for key in ("id", "sigma_m", "sigma_rad"))
        site[tag_id] = PlanarPose(**entry)
        if sigma_m is not None or sigma_rad is not None:
            x_m, y_m = (0.0, 0.0) if sigma_m is None else sigma_m.tolist()
            site_sigma[tag_id] = (x_m, y_m, sigma_rad or 0.0)
    meanings = {entry["id"]: entry["text"] for entry in _by_id(values.pop("meaning"), "meaning")}
    tags = Tags(
        **values, **family, built=built, site=site, site_sigma=site_sigma, meanings=meanings
    )
    if tags.magnets > tags.order**2 - 1:
        raise InvalidValueError(f"expected at most {tags.order**2 - 1}, order^2 - 1", "magnets")
    if tags.magnet.diameter_m > tags.spacing_m:
        raise InvalidValueError("expected no more than spacing_mm", "magnet.diameter_mm")
    _check_ids(tags)
    for number, tag in enumerate(built.values()):
        _check_built(tag, tags, f"built[{number}]")
    return tags


def _by_id(entries: tuple[Values, ...], table: str) -> tuple[Values, ...]:
    refuse_repeated((entry["id"] for entry in entries), table, "id")
    return entries


def _check_ids(tags: Tags) -> None:
    """Refuse designs that the codec does not have, and ids that are not of the design."""
    try:
        codec.check_design(tags)
    except InputError as error:
        raise InvalidValueError(error.message, "", error.hint) from None
    capacity = codec.capacity(tags)
    if tags.ids is not None:
        number, count = Counter(tags.ids).most_common(1)[0]
        if count > 1:
            raise InvalidValueError(f"{number} occurs twice", "family.ids")
    members = None if tags.ids is None else frozenset(tags.ids)
    keys = [("family.ids", number) for number in tags.ids or ()]
    keys += [(f"built[{k}].id", number) for k, number in enumerate(tags.built)]
    keys += [(f"site[{k}].id", number) for k, number in enumerate(tags.site)]
    keys += [(f"meaning[{k}].id", number) for k, number in enumerate(tags.meanings)]
    for key, number in keys:
        if number >= capacity:
            raise InvalidValueError(
                f"{number} is not an id of this design, whose last one is {capacity - 1}", key
            )
        if members is not None and number not in members:
            raise InvalidValueError(f"{number} is not in the family", key)


def _check_built(tag: AsBuiltTag, tags: Tags, path: str) -> None:
    if tag.offset_m.shape != (tags.magnets, 2):
        raise InvalidValueError(
            f"expected a list of {tags.magnets} rows of 2 numbers", f"{path}.offset_mm"
        )
    if len(tag.angle_rad) != tags.magnets:
        raise InvalidValueError(f"expected a list of {tags.magnets} numbers", f"{path}.angle_deg")
    if np.hypot(*tag.offset_m.T).max() > tags.spacing_m / 2:
        raise InvalidValueError(
            "a magnet is closer to another cell than to its own", f"{path}.offset_mm"
        )


def _tags_values(tags: Tags) -> Values:
    family = {"ids": tags.ids, "min_distance": tags.min_distance}
    return {
        **vars(tags),
        "family": None if (tags.ids, tags.min_distance) == (None, 1) else family,
        "built": [{"id": number, **vars(tag)} for number, tag in sorted(tags.built.items())],
        "site": [_site_values(tags, number) for number in sorted(tags.site)],
        "meaning": [{"id": number, "text": text} for number, text in sorted(tags.meanings.items())],
    }


def _site_values(tags: Tags, number: int) -> Values:
    values = {"id": number, **vars(tags.site[number])}
    if number in tags.site_sigma:
        x_m, y_m, heading_rad = tags.site_sigma[number]
        values |= {"sigma_m": np.array([x_m, y_m]), "sigma_rad": heading_rad}
    return values


_MAX_MAGNETS = MAX_ORDER**2 - 1

LENGTH_MM = Number(1e-3, 1e5)
"""Lengths of a tag: from a micrometre to a hundred metres."""

TAGS: Artifact[Tags] = Artifact(
    TAG_FILE,
    TAG_FORMAT,
    Table(
        (
            Key("codec", Text(CODECS), "code of the ids"),
            Key("order", Integer(2, MAX_ORDER), "cells along a side, K of the paper"),
            Key("magnets", Integer(3, _MAX_MAGNETS), "M of the paper, at most K^2 - 1"),
            Key("orientations", Integer(2, MAX_ORIENTATIONS), "P of the paper"),
            Key("spacing_mm", LENGTH_MM, "distance of neighbouring cells"),
            Key("clearance_mm", LENGTH_MM, "height of the sensors over the middle of the magnets"),
            Key("notes", ListOf(Text()), "for people", ()),
            Key(
                "magnet",
                Table(
                    (
                        Key("diameter_mm", LENGTH_MM, "of the disc, at most `spacing_mm`"),
                        Key("height_mm", LENGTH_MM, "of the disc"),
                        Key("remanence_t", REMANENCE, "Br of the material"),
                        Key("grade", Text(), "grade under which it is sold", ""),
                    ),
                    lambda values: Magnet(**values),
                    vars,
                ),
            ),
            Key(
                "family",
                Table(
                    (
                        Key(
                            "ids",
                            ListOf(Integer(), min_count=1),
                            "ids that are in use",
                            None,
                            "every id of the codec",
                        ),
                        Key(
                            "min_distance",
                            Integer(1, MAX_MIN_DISTANCE),
                            "least distance of two members, in steps of orientation",
                            1,
                        ),
                    )
                ),
                default=None,
            ),
            Key(
                "built",
                Tables(
                    Table(
                        (
                            Key("id", Integer(), "id of a tag as built, of the family, once each"),
                            Key(
                                "passes",
                                Integer(0, MAX_PASSES),
                                "number of passes that it was measured in",
                                0,
                            ),
                            Key(
                                "offset_mm",
                                Array((None, 2), max_rows=_MAX_MAGNETS),
                                "from each magnet's cell to the magnet, x and y in the frame of "
                                "the tag, at most half the spacing; in the order of the layout "
                                "(row by row from v1)",
                            ),
                            Key(
                                "angle_deg",
                                Array((None,), Number(-180, 180), max_rows=_MAX_MAGNETS),
                                "from each magnet's nominal orientation to the real one, "
                                "counter-clockwise",
                            ),
                        )
                    )
                ),
                default=(),
            ),
            Key(
                "site",
                Tables(
                    Table(
                        (
                            Key("id", Integer(), "id of a tag on the floor, once each"),
                            Key("x_mm", ANY_NUMBER, "position of its middle in the frame `site`"),
                            Key("y_mm", ANY_NUMBER, "position of its middle in the frame `site`"),
                            Key(
                                "heading_deg",
                                ANY_NUMBER,
                                "from the x of the frame to the x of the tag, counter-clockwise",
                            ),
                            Key(
                                "sigma_mm",
                                Array((2,), NOT_NEGATIVE),
                                "standard deviations of x and y, as of `locatk site survey`; part "
                                "of the covariance of solved poses",
                                None,
                                "0",
                            ),
                            Key(
                                "sigma_deg",
                                NOT_NEGATIVE,
                                "standard deviation of the heading",
                                None,
                                "0",
                            ),
                        )
                    )
                ),
                default=(),
            ),
            Key(
                "meaning",
                Tables(
                    Table(
                        (
                            Key("id", Integer(), "id of a tag that has a meaning, once each"),
                            Key(
                                "text",
                                Text(is_blank_allowed=False, max_length=MAX_MEANING_CHARACTERS),
                                "what the tag stands for, on one line: it is shown with the id",
                            ),
                        )
                    )
                ),
                default=(),
            ),
        ),
        _tags_of,
        _tags_values,
    ),
    version=2,
)
"""Tags as a file."""

dumps_tags, loads_tags, attached_tags = TAGS.dumps, TAGS.loads, TAGS.attached
write_tags, read_tags = TAGS.write, TAGS.read


def read_designs(paths: Sequence[Path]) -> dict[str, Tags]:
    """Read several designs of tags, by the names of their files.

    Raises
    ------
    ArtifactError
        A file is damaged.
    InputError
        Two files have the same name, or the same tags.
    """
    designs: dict[str, Tags] = {}
    for path in paths:
        tags = read_tags(path)
        if path.name in designs:
            raise InputError(
                f"two designs of tags are named {path.name}",
                file=path,
                hint="Rename one: the results refer to designs by the names of their files",
            )
        text = dumps_tags(tags)
        twin = next((name for name, other in designs.items() if dumps_tags(other) == text), None)
        if twin is not None:
            raise InputError(f"the same tags as in {twin}", file=path, hint="Give each design once")
        designs[path.name] = tags
    return designs


# ---- arrays


def _array_of(values: Values) -> SensorArray:
    refuse_equal_positions(values["position_m"], "position_mm")
    limit = values.pop("range_t")
    known = {key: value for key, value in values.items() if value is not None}
    if limit is not None:
        known["range_t"] = np.where(np.isnan(limit), np.inf, limit)
    return SensorArray(**known)


def _array_values(array: SensorArray) -> Mapping[str, Any]:
    limit = np.asarray(array.range_t, float)
    limit = np.where(np.isinf(limit), np.nan, limit)
    return {
        **vars(array),
        "noise_t": None if np.isnan(array.noise_t).all() else array.noise_t,
        "quantum_t": array.quantum_t if np.any(array.quantum_t) else None,
        "range_t": None if np.isnan(limit).all() else limit,
    }


_POSITIVE_OR_UNKNOWN = Number(0.0, is_low_excluded=True, is_nan_allowed=True)

ARRAY: Artifact[SensorArray] = Artifact(
    ARRAY_FILE,
    ARRAY_FORMAT,
    Table(
        (
            Key("sensor", Text(), "part number and settings, for people", ""),
            Key(
                "noise_ut",
                Array((3,), _POSITIVE_OR_UNKNOWN),
                "standard deviation of a sample along x, y, z of the array; `nan` if unknown",
                None,
                "unknown",
            ),
            Key(
                "delay_ms",
                Array((3,)),
                "time of conversion of each axis, from the time of the sample on",
                None,
                "0",
            ),
            Key(
                "quantum_ut",
                Array((3,), NOT_NEGATIVE),
                "field of a count along each axis; 0 if unknown",
                None,
                "unknown",
            ),
            Key(
                "range_ut",
                Array((3,), _POSITIVE_OR_UNKNOWN),
                "largest measurable field along each axis; `nan` if unknown",
                None,
                "unknown",
            ),
            Key(
                "position_mm",
                Array((None, 3), max_rows=MAX_SENSORS),
                "x, y, z of each sensor, sensor 0 first; no two are equal",
            ),
        ),
        _array_of,
        _array_values,
    ),
)
"""A sensor array as a file."""

dumps_array, loads_array, write_array, read_array = (
    ARRAY.dumps,
    ARRAY.loads,
    ARRAY.write,
    ARRAY.read,
)
attached_array, array_file = ARRAY.attached_for, ARRAY.file_for
