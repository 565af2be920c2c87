"""tag.toml and array.toml: exact round trips, and strict checks of edited files."""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.codec import capacity
from locatk.core.polaris.tag import (
    CODECS,
    MAX_MEANING_CHARACTERS,
    AsBuiltTag,
    Magnet,
    PlanarPose,
    Tags,
)
from locatk.formats.artifacts.tags import (
    ARRAY,
    TAGS,
    dumps_array,
    dumps_tags,
    loads_array,
    loads_tags,
)

# ---- round trips

above = st.floats(1e-9, 1e3)
length = st.floats(2e-4, 99)
finite = st.floats(-1e6, 1e6)


def arrays(shape: tuple[int, ...], elements: st.SearchStrategy[float]) -> st.SearchStrategy:
    size = math.prod(shape)
    return st.lists(elements, min_size=size, max_size=size).map(
        lambda values: np.array(values).reshape(shape)
    )


meanings = st.text(
    st.characters(exclude_categories=("C", "Z"), include_characters=" "),
    min_size=1,
    max_size=MAX_MEANING_CHARACTERS,
).filter(lambda text: not text.isspace())


@st.composite
def tag_sets(draw: st.DrawFn) -> Tags:
    """Any tags, of designs of each codec."""
    codec = draw(st.sampled_from(CODECS))
    design = {
        "mosk": st.tuples(st.integers(2, 5), st.integers(3, 9), st.integers(2, 20)),
        "redundant": st.tuples(st.just(3), st.integers(7, 8), st.just(8)),
        "polaris-released": st.just((3, 5, 8)),
    }[codec]
    order, magnets, orientations = draw(design)
    magnets = min(magnets, order * order - 1)
    spacing = draw(length)
    tags = Tags(order, magnets, orientations, spacing, codec)
    last = capacity(tags) - 1
    ids = draw(st.none() | st.lists(st.integers(0, last), min_size=1, max_size=5, unique=True))
    some = st.integers(0, last) if ids is None else st.sampled_from(ids)
    site = dict(
        sorted(
            draw(
                st.dictionaries(some, st.builds(PlanarPose, finite, finite, finite), max_size=2)
            ).items()
        )
    )
    sigma = st.floats(0, 1e3)
    # Half the spacing is the limit, in any direction.
    offset = st.floats(-0.35 * spacing, 0.35 * spacing)
    angle = st.floats(-math.pi, math.pi)
    built = st.builds(
        AsBuiltTag, arrays((magnets, 2), offset), arrays((magnets,), angle), st.integers(0, 99)
    )
    return Tags(
        order,
        magnets,
        orientations,
        spacing,
        codec,
        Magnet(
            spacing * draw(st.floats(0.01, 1)),
            draw(length),
            draw(st.floats(1e-3, 2)),
            draw(st.sampled_from(["", "N52", 'odd "grade"'])),
        ),
        draw(length),
        None if ids is None else tuple(ids),
        draw(st.integers(1, 9)),
        dict(sorted(draw(st.dictionaries(some, built, max_size=2)).items())),
        site,
        tuple(draw(st.lists(st.text(max_size=20), max_size=2))),
        dict(sorted(draw(st.dictionaries(some, meanings, max_size=2)).items())),
        {tag_id: draw(st.tuples(sigma, sigma, sigma)) for tag_id in site if draw(st.booleans())},
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(tag_sets())
def test_all_tags_come_back_to_the_last_bit(tags: Tags) -> None:
    text = dumps_tags(tags)
    read = loads_tags(text)
    with np.printoptions(floatmode="unique", precision=None):
        assert repr(read) == repr(tags)  # tells -0.0 from 0.0
    assert dumps_tags(read) == text


@st.composite
def sensor_arrays(draw: st.DrawFn) -> SensorArray:
    count = draw(st.integers(1, 12))
    triples = arrays((count, 3), finite).filter(lambda p: len(np.unique(p, axis=0)) == len(p))
    return SensorArray(
        draw(triples),
        draw(arrays((3,), above | st.just(math.nan))),
        draw(arrays((3,), finite)),
        draw(arrays((3,), above | st.just(0.0))),
        draw(arrays((3,), above | st.just(math.inf))),
        draw(st.text(max_size=20)),
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(sensor_arrays())
def test_every_array_comes_back_to_the_last_bit(array: SensorArray) -> None:
    text = dumps_array(array)
    read = loads_array(text)
    with np.printoptions(floatmode="unique", precision=None):
        assert repr(read) == repr(array)
    assert dumps_array(read) == text


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(st.floats(-7, 7), st.decimals(-360, 360, places=2))
def test_degrees_keep_their_digits(angle: float, degrees: Decimal) -> None:
    tags = Tags(site={0: PlanarPose(0.0, 0.0, angle)})
    assert loads_tags(dumps_tags(tags)).site[0].heading_rad == angle
    text = f"{dumps_tags(tags).split('heading_deg = ')[0]}heading_deg = {degrees}\n"
    again = loads_tags(dumps_tags(loads_tags(text)))
    assert again == loads_tags(text)
    assert math.isclose(again.site[0].heading_rad, math.radians(degrees), rel_tol=1e-15)
    assert Decimal(dumps_tags(again).split("heading_deg = ")[1]) == degrees


# ---- edited files

TAG = """\
format = "locatk-tag"
format_version = 1
codec = "mosk"
order = 3
magnets = 5
orientations = 8
spacing_mm = 40
clearance_mm = 10
"""
MAGNET = """
[magnet]
diameter_mm = 2
height_mm = 0.5
remanence_t = 1.45
grade = "N52"
"""
FAMILY = "\n[family]\nids = [3, 7]\nmin_distance = 2\n"
BUILT = """
[[built]]
id = 7
offset_mm = [[0, 0.5], [0, 0], [0, 0], [0, 0], [-0.1, 0]]
angle_deg = [4.3, -2.2, 13.0, 0, -2.8]
"""
SITE = "\n[[site]]\nid = 7\nx_mm = 1500\ny_mm = -20.5\nheading_deg = 90\n"
MEANING = '\n[[meaning]]\nid = 7\ntext = "stop"\n'


def test_tags_by_hand() -> None:
    assert loads_tags("\ufeff" + TAG + MAGNET) == Tags()
    tags = loads_tags(TAG + MAGNET + FAMILY + BUILT + SITE)
    assert (tags.ids, tags.min_distance) == ((3, 7), 2)
    assert tags.built[7].offset_m[0, 1] == 0.5e-3
    assert tags.built[7].angle_rad[2] == math.radians(13)
    assert tags.site == {7: PlanarPose(1.5, -0.0205, math.pi / 2)}
    assert tags.meanings == {}
    assert tags.site_sigma == {}
    surveyed = loads_tags(TAG + MAGNET + SITE + "sigma_mm = [2, 3]")
    assert surveyed.site_sigma == {7: (0.002, 0.003, 0.0)}
    newer = TAG.replace("version = 1", "version = 2")
    assert loads_tags(newer + MAGNET + FAMILY + MEANING).meanings == {7: "stop"}


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", None, "missing key 'format'"),
        (TAG.replace("locatk-tag", "tag") + MAGNET, "format", "expected 'locatk-tag'"),
        (TAG.replace("version = 1", "version = 3") + MAGNET, "format_version", "newer"),
        (TAG.replace('"mosk"', '"moks"') + MAGNET, "codec", "not one of mosk, redundant"),
        (TAG.replace("order = 3", "order = 1") + MAGNET, "order", "from 2 to 100"),
        (TAG.replace("magnets = 5", "magnets = 9") + MAGNET, "magnets", "at most 8"),
        (TAG.replace("magnets = 5", "magnets = 2") + MAGNET, "magnets", "from 3 to"),
        (TAG.replace("ations = 8", "ations = 1") + MAGNET, "orientations", "from 2"),
        (
            TAG.replace("spacing_mm = 40", "spacing_mm = 0") + MAGNET,
            "spacing_mm",
            "0.001 to 100000 in mm",
        ),
        (TAG.replace("clearance_mm", "clearance") + MAGNET, None, "missing key 'clearance_mm'"),
        (TAG, None, "missing key 'magnet'"),
        (TAG + MAGNET.replace("= 2", "= 41"), "magnet.diameter_mm", "no more than spacing_mm"),
        (TAG + MAGNET.replace("1.45", "14500"), "magnet.remanence_t", "above 0, at most 2 in T"),
        (TAG + MAGNET.replace("1.45", "nan"), "magnet.remanence_t", "finite"),
        (TAG + MAGNET + "hight_mm = 1", "magnet", "unknown key 'hight_mm'"),
        (TAG + MAGNET + FAMILY.replace("[3, 7]", "[]"), "family.ids", "one or more whole numbers"),
        (TAG + MAGNET + FAMILY.replace("3,", "3.0,"), "family.ids[0]", "a whole number"),
        (TAG + MAGNET + FAMILY.replace("3,", "true,"), "family.ids[0]", "a whole number"),
        (TAG + MAGNET + FAMILY.replace("3,", "-3,"), "family.ids[0]", "of at least 0"),
        (TAG + MAGNET + FAMILY.replace("3,", "7,"), "family.ids", "7 occurs twice"),
        (TAG + MAGNET + FAMILY.replace("3,", "327680,"), "family.ids", "last one is 327679"),
        (TAG + MAGNET + FAMILY.replace("= 2", "= 0"), "family.min_distance", "from 1"),
        (TAG + MAGNET + BUILT.replace("7", "327680"), "built[0].id", "not an id of this design"),
        (TAG + MAGNET + FAMILY + BUILT.replace("7", "5"), "built[0].id", "not in the family"),
        (TAG + MAGNET + BUILT + BUILT, "built[1].id", "twice"),
        (TAG + MAGNET + BUILT.replace("[0, 0], ", "", 1), "built[0].offset_mm", "5 rows of 2"),
        (TAG + MAGNET + BUILT.replace("0.5", "20.5"), "built[0].offset_mm", "another cell"),
        (TAG + MAGNET + BUILT.replace("4.3, ", ""), "built[0].angle_deg", "list of 5"),
        (
            TAG + MAGNET + BUILT.replace("4.3", "181"),
            "built[0].angle_deg[0]",
            "from -180 to 180 in deg",
        ),
        (TAG + MAGNET + BUILT.replace("4.3", '"4"'), "built[0].angle_deg[0]", "not a string"),
        (TAG + MAGNET + SITE.replace("90", "inf"), "site[0].heading_deg", "finite"),
        (TAG + MAGNET + SITE.replace("x_mm", "x"), "site[0]", "missing key 'x_mm'"),
        (TAG + MAGNET + SITE + SITE, "site[1].id", "twice"),
        (TAG + MAGNET + SITE + "sigma_mm = [1, -1]", "site[0].sigma_mm[1]", "of at least 0"),
        (TAG + MAGNET + SITE + "sigma_deg = -1", "site[0].sigma_deg", "of at least 0"),
        (TAG + MAGNET + MEANING + MEANING, "meaning[1].id", "twice"),
        (TAG + MAGNET + MEANING.replace("7", "327680"), "meaning[0].id", "not an id of this"),
        (TAG + MAGNET + FAMILY + MEANING.replace("7", "5"), "meaning[0].id", "not in the family"),
        (TAG + MAGNET + MEANING.replace("stop", " "), "meaning[0].text", "40 characters that is"),
        (TAG + MAGNET + MEANING.replace("stop", 41 * "x"), "meaning[0].text", "40 characters"),
        (TAG + MAGNET + MEANING.replace("stop", "a\\nb"), "meaning[0].text", "one line"),
        (TAG + MAGNET + MEANING.replace('"stop"', "3"), "meaning[0].text", "not a number"),
        (TAG.replace("mosk", "polaris-released").replace("= 8", "= 16") + MAGNET, None, "released"),
    ],
)
def test_errors_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(TAGS, text, where, words)


def test_ids_of_any_size() -> None:
    large = Tags(order=5, magnets=13, orientations=20, ids=(10**21,))
    assert loads_tags(dumps_tags(large)).ids == (10**21,)


ARRAY_TEXT = """\
format = "locatk-sensor-array"
format_version = 1
position_mm = [[0, -20, 0], [0, 0, 0], [0, 20, 0]]
"""


def test_an_array_by_hand() -> None:
    array = loads_array(ARRAY_TEXT)
    np.testing.assert_array_equal(array.position_m, bar(3, 0.02))
    assert np.isnan(array.noise_t).all()
    assert np.isinf(array.range_t).all()
    assert not array.delay_s.any()
    known = loads_array(ARRAY_TEXT + "noise_ut = [0.5, nan, 1.24]\nrange_ut = [4915, 4915, nan]\n")
    np.testing.assert_array_equal(known.noise_t, [0.5e-6, np.nan, 1.24e-6])
    np.testing.assert_array_equal(known.range_t, [4915e-6, 4915e-6, np.inf])


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        (ARRAY_TEXT.replace("sensor-array", "array"), "format", "expected"),
        (
            ARRAY_TEXT.replace("[[0, -20, 0], [0, 0, 0], [0, 20, 0]]", "[]"),
            "position_mm",
            "1 to 10000 rows of 3 numbers in mm",
        ),
        (
            ARRAY_TEXT.replace("[[0, -20, 0], [0, 0, 0], [0, 20, 0]]", "3"),
            "position_mm",
            "1 to 10000 rows of 3 numbers in mm",
        ),
        (ARRAY_TEXT.replace("[0, 0, 0]", "[0, 0]"), "position_mm[1]", "list of 3 numbers"),
        (ARRAY_TEXT.replace("[0, 0, 0]", "[0, 20, 0]"), "position_mm", "position of sensor 1"),
        (ARRAY_TEXT + "noise_ut = [0.5, 0, 1]", "noise_ut[1]", "above 0 in uT"),
        (ARRAY_TEXT + "noise_ut = 0.5", "noise_ut", "list of 3"),
        (ARRAY_TEXT + "range_ut = [1, 1, -1]", "range_ut[2]", "above 0 in uT"),
        (ARRAY_TEXT + "quantum_ut = [1, 1, -1]", "quantum_ut[2]", "of at least 0"),
        (ARRAY_TEXT + "delay_ms = [0, 5, nan]", "delay_ms[2]", "finite"),
        (ARRAY_TEXT + "noise_nt = [1, 1, 1]", None, "unknown key 'noise_nt'"),
    ],
)
def test_errors_of_an_array_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(ARRAY, text, where, words)
