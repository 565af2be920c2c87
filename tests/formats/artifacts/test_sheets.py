"""sheet.toml and camera.toml: exact round trips, and strict checks of edited files."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import SECTION_LENGTH
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.formats.artifacts import sheets
from locatk.formats.artifacts.sheets import (
    dumps_camera,
    dumps_manifest,
    loads_camera,
    loads_manifest,
)

# ---- round trips

finite = st.floats(-1e6, 1e6)
above = st.floats(1e-6, 1e6)
pairs = st.tuples(finite, finite)


@st.composite
def manifests(draw: st.DrawFn) -> Manifest:
    """Any manifest: sheets without a position get columns of their own."""
    pitch = draw(st.floats(1e-3, 100))
    count = draw(st.integers(1, 4))
    names = draw(
        st.lists(
            st.text(min_size=1, max_size=8).filter(lambda s: s.strip() and s != "floor"),
            min_size=count,
            max_size=count,
            unique=True,
        )
    )
    places = draw(st.lists(st.none() | pairs, min_size=count, max_size=count))
    origins = []
    for number in range(count):
        low = number * (SECTION_LENGTH // count)
        origins.append(
            (draw(st.integers(low, low + SECTION_LENGTH // count - 1)), draw(st.integers(0, 9)))
        )
    made = []
    for number, (name, place, (x, y)) in enumerate(zip(names, places, origins, strict=True)):
        room = (number + 1) * (SECTION_LENGTH // count) - x
        size = (draw(st.integers(1, room)), draw(st.integers(1, SECTION_LENGTH - y)))
        made.append(
            Sheet(
                name,
                (x, y),
                size,
                draw(st.tuples(st.integers(0, 62), st.integers(0, 62))),
                draw(st.tuples(above, above)),
                draw(pairs),
                place,
                0.0 if place is None else draw(finite),
            )
        )
    return Manifest(
        sheets=tuple(made),
        codec=draw(st.sampled_from(["anoto", "libdots", "microdots"])),
        pitch_mm=pitch,
        dot_mm=pitch * draw(st.floats(0.01, 0.99)),
        offset_mm=pitch * draw(st.floats(0.01, 0.49)),
        dpi=draw(st.integers(1, 10_000)),
        scale=draw(st.tuples(st.floats(0.5, 2), st.floats(0.5, 2))),
        notes=tuple(draw(st.lists(st.text(max_size=20), max_size=2))),
    )


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    size = draw(st.tuples(st.integers(1, 65_535), st.integers(1, 65_535)))
    focal = draw(st.floats(1e-3, 1e6))
    centre = tuple(draw(st.floats(-0.5, n - 0.5)) for n in size)
    corner = np.hypot(*(max(c, n - 1 - c) for c, n in zip(centre, size, strict=True))) / focal
    limit = min(0.99 / max(corner, 1e-9) ** 2, 1e6)
    return Camera(size, focal, centre, draw(st.floats(-limit, limit)))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(manifests())
def test_every_manifest_comes_back_to_the_last_bit(manifest: Manifest) -> None:
    text = dumps_manifest(manifest)
    assert repr(loads_manifest(text)) == repr(manifest)  # tells -0.0 from 0.0
    assert dumps_manifest(loads_manifest(text)) == text


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(cameras())
def test_every_camera_comes_back_to_the_last_bit(camera: Camera) -> None:
    text = dumps_camera(camera)
    assert repr(loads_camera(text)) == repr(camera)
    assert dumps_camera(loads_camera(text)) == text


A4 = Sheet("A4-0001", (0, 3000), (393, 555), (24, 32), (210.0, 297.0), (5.08, 7.62))


def test_sheets_have_a_comment_with_their_size() -> None:
    assert "# 199.6 x 281.9 mm of pattern" in dumps_manifest(Manifest((A4,), codec="libdots"))


def test_the_examples_of_the_documentation(root: Path) -> None:
    text = (root / "docs" / "formats.md").read_text("utf-8")
    examples = re.findall("```toml\n(.*?)```", text, re.DOTALL)
    manifest = next(loads_manifest(e) for e in examples if sheets.MANIFEST_FORMAT in e)
    assert [sheet.id for sheet in manifest.sheets] == ["7f3a-1", "7f3a-2"]
    assert repr(loads_manifest(dumps_manifest(manifest))) == repr(manifest)
    camera = next(loads_camera(e) for e in examples if sheets.CAMERA_FORMAT in e)
    assert camera.size == (188, 120)


# ---- edited files

HEAD = 'format = "locatk-dot-sheets"\nformat_version = 1\ncodec = "libdots"\npitch_mm = 0.508\n'

SHEET = """
[[sheets]]
id = "a"
origin = [0, 3000]
size = [400, 600]
section = [24, 32]
page_mm = [210, 297]
first_mm = [5, 5.5]
"""

OTHER = SHEET.replace('"a"', '"b"').replace("[0, 3000]", "[400, 3000]")
TILE = "position_mm = [0, 0]\n"


def test_a_manifest_by_hand() -> None:
    manifest = loads_manifest("\ufeff" + HEAD + SHEET)
    assert manifest == Manifest(
        (Sheet("a", (0, 3000), (400, 600), (24, 32), (210.0, 297.0), (5.0, 5.5)),),
        codec="libdots",
    )
    # 1/6 of the pitch where nothing else is said, whatever the pitch is.
    assert loads_manifest(HEAD.replace("0.508", "0.6") + SHEET).dot_mm == 0.6 / 6


def test_tiles_may_share_their_rims() -> None:
    tile = OTHER.replace("[400, 3000]", "[390, 3000]") + "position_mm = [200, 0]\nheading_deg = 1"
    manifest = loads_manifest(HEAD + SHEET + TILE + tile)
    assert manifest.frame(0) == manifest.frame(1) == "floor"
    assert manifest.sheets[1].heading_deg == 1.0


COVARIANCE = """
covariance_mm_deg = [[1.0, 0.1, 0.0], [0.1, 4.0, 0.0], [0.0, 0.0, 0.01]]
"""
SIGMAS = """
distortion_sigma_mm = [0.02, 0.05]
distortion_sigma_deg = 0.03
"""
DISTORTION = """
[sheets.distortion]
x_mm = [[0.1, 0.2], [0.3, 0.4]]
y_mm = [[0.5, 0.6], [0.7, 0.8]]
"""


def test_sheets_as_built() -> None:
    text = HEAD + SHEET + TILE + COVARIANCE + SIGMAS + DISTORTION
    (sheet,) = loads_manifest(text).sheets
    assert sheet.covariance_mm_deg == ((1.0, 0.1, 0.0), (0.1, 4.0, 0.0), (0.0, 0.0, 0.01))
    assert sheet.distortion_sigma_mm == (0.02, 0.05)
    assert sheet.distortion_sigma_deg == 0.03
    assert sheet.distortion is not None
    assert sheet.distortion.y_mm == ((0.5, 0.6), (0.7, 0.8))
    sheet.distortion.displacement_mm  # noqa: B018 - computed once; it is no part of the file
    written = dumps_manifest(loads_manifest(text))
    assert loads_manifest(written) == loads_manifest(text)
    assert dumps_manifest(Manifest((sheet,))) == dumps_manifest(
        loads_manifest(dumps_manifest(Manifest((sheet,))))
    )


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", None, "missing key 'format'"),
        (HEAD.replace("dot-sheets", "scene") + SHEET, "format", "expected 'locatk-dot-sheets'"),
        (HEAD.replace("version = 1", "version = 2") + SHEET, "format_version", "newer"),
        (HEAD.replace("libdots", "dots") + SHEET, "codec", "not one of anoto, libdots"),
        (HEAD.replace("codec", "kodec") + SHEET, None, "missing key 'codec'"),
        (HEAD.replace("0.508", "0") + SHEET, "pitch_mm", "above 0"),
        (HEAD.replace("0.508", "-0.508") + SHEET, "pitch_mm", "above 0"),
        (HEAD.replace("0.508", "nan") + SHEET, "pitch_mm", "finite"),
        (HEAD.replace("pitch_mm", "pitch") + SHEET, None, "missing key 'pitch_mm'"),
        (HEAD + "dot_mm = 0.6" + SHEET, "dot_mm", "less than the pitch, 0.508 mm"),
        (HEAD + "offset_mm = 0.3" + SHEET, "offset_mm", "less than half the pitch, 0.254 mm"),
        (HEAD + "offset_mm = 0" + SHEET, "offset_mm", "above 0"),
        (HEAD + "dpi = 300.5" + SHEET, "dpi", "whole number"),
        (HEAD + "scale_x = 100.2" + SHEET, "scale_x", "from 0.5 to 2"),
        (HEAD + 'scale_y = "1"' + SHEET, "scale_y", "from 0.5 to 2, not a string"),
        (HEAD + "scale = [1, 1]" + SHEET, None, "unknown key 'scale'"),
        (HEAD, None, "missing key 'sheets'"),
        (HEAD + "sheets = []", "sheets", "at least 1"),
        (HEAD + SHEET.replace('"a"', '" "'), "sheets[0].id", "not blank"),
        (HEAD + SHEET.replace('"a"', "1"), "sheets[0].id", "a string"),
        (HEAD + SHEET + SHEET, "sheets[1].id", "twice"),
        (HEAD + SHEET.replace("[0,", "[0.0,"), "sheets[0].origin", "2 whole numbers"),
        (HEAD + SHEET.replace("[0,", "[-1,"), "sheets[0].origin", "from 0 to 410815347"),
        (HEAD + SHEET.replace("[0,", "[410815348,"), "sheets[0].origin", "to 410815347"),
        (HEAD + SHEET.replace("[0,", "[410814949,"), "sheets[0].origin", "cross the border"),
        (HEAD + SHEET.replace("[400, 600]", "[400, 0]"), "sheets[0].size", "from 1"),
        (HEAD + SHEET.replace("[400, 600]", "[400]"), "sheets[0].size", "2 whole numbers"),
        (HEAD + SHEET.replace("[24, 32]", "[24, 63]"), "sheets[0].section", "from 0 to 62"),
        (HEAD + SHEET.replace("[24, 32]", "[true, 1]"), "sheets[0].section", "whole numbers"),
        (HEAD + SHEET.replace("[210,", "[0,"), "sheets[0].page_mm", "above 0"),
        (HEAD + SHEET.replace("first_mm", "first"), "sheets[0]", "missing key 'first_mm'"),
        (HEAD + SHEET + "heading_deg = 5", "sheets[0].heading_deg", "without position_mm"),
        (HEAD + SHEET + "position_mm = [1]", "sheets[0].position_mm", "list of 2"),
        (HEAD + SHEET + "colour = 3", "sheets[0]", "unknown key 'colour'"),
        (HEAD + SHEET + COVARIANCE, "sheets[0].covariance_mm_deg", "without position_mm"),
        (
            HEAD + SHEET + TILE + COVARIANCE.replace("[0.1, ", "[0.2, "),
            "sheets[0].covariance_mm_deg",
            "expected a covariance",
        ),
        (
            HEAD + SHEET + TILE + COVARIANCE.replace("4.0", "0.001"),
            "sheets[0].covariance_mm_deg",
            "expected a covariance",
        ),
        (
            HEAD + SHEET + DISTORTION.replace("[0.1, 0.2], ", ""),
            "sheets[0].distortion.y_mm",
            "as many rows and columns",
        ),
        (
            HEAD
            + SHEET
            + DISTORTION.replace("0.1, ", "")
            .replace("0.3, ", "")
            .replace("0.5, ", "")
            .replace("0.7, ", ""),
            "sheets[0].distortion.x_mm",
            "at least two rows and columns",
        ),
        (
            HEAD + SHEET + "distortion_sigma_mm = [0.1, -0.1]",
            "sheets[0].distortion_sigma_mm",
            "at least 0",
        ),
        (
            HEAD + SHEET + OTHER.replace("[400, 3000]", "[399, 3599]"),
            "sheets[1].origin",
            "shares positions with sheet 'a'",
        ),
        (
            HEAD + SHEET + TILE + OTHER.replace("[400, 3000]", "[399, 3599]"),
            "sheets[1].origin",
            "shares positions with sheet 'a'",
        ),
        (
            HEAD + SHEET.replace('"a"', '"floor"') + OTHER + TILE,
            "sheets[0].id",
            "the frame of all tiles",
        ),
    ],
)
def test_errors_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(sheets.MANIFEST, text, where, words)


def test_sheets_that_touch_or_are_in_other_sections_share_nothing() -> None:
    assert len(loads_manifest(HEAD + SHEET + OTHER).sheets) == 2
    other = OTHER.replace("[400, 3000]", "[0, 3000]").replace("[24, 32]", "[24, 33]")
    assert len(loads_manifest(HEAD + SHEET + other).sheets) == 2


CAMERA = (
    'format = "locatk-camera"\nformat_version = 1\nsize_px = [188, 120]\nfocal_px = 900\n'
    "centre_px = [93.5, 59.5]\n"
)


def test_a_camera_by_hand() -> None:
    assert loads_camera(CAMERA) == Camera((188, 120), 900.0, (93.5, 59.5), 0.0)


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        (CAMERA.replace("locatk-camera", "camera"), "format", "expected 'locatk-camera'"),
        (CAMERA.replace("188", "0"), "size_px", "from 1 to 65535"),
        (CAMERA.replace("188", "188.0"), "size_px", "whole numbers"),
        (CAMERA.replace("900", "0"), "focal_px", "above 0"),
        (CAMERA.replace("focal_px", "focal_mm"), None, "missing key 'focal_px'"),
        (CAMERA.replace("93.5", "188"), "centre_px", "x 188 is outside"),
        (CAMERA.replace("59.5", "-1"), "centre_px", "y -1 is outside"),
        (CAMERA + "radial = -70", "radial", "less than 65.9"),
        (CAMERA + "radial = inf", "radial", "finite"),
        (CAMERA + "k = 1", None, "unknown key 'k'"),
    ],
)
def test_errors_of_a_camera_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(sheets.CAMERA, text, where, words)


@pytest.mark.slow
@given(cameras())
@settings(max_examples=40, deadline=None)
def test_valid_cameras_are_invertible_in_the_whole_frame(camera: Camera) -> None:
    """The check of `radial` ensures this."""
    read = loads_camera(dumps_camera(camera))
    corners = np.array([(x, y) for x in (0, camera.size[0] - 1) for y in (0, camera.size[1] - 1)])
    back = read.distort(read.undistort(corners.astype(float)))
    # Near the limit the root is steep: a millionth of the frame is what is left of 16 digits.
    np.testing.assert_allclose(back, corners, atol=1e-3 * max(camera.size))
