"""Points for tags from drawings that ezdxf writes, in several versions of DXF and units."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ezdxf
import pytest
from ezdxf.enums import TextEntityAlignment
from ezdxf.math import Matrix44
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.cli.drawing_options import UNITS
from locatk.core.errors import FormatError, LocatkError
from locatk.core.polaris.design.site import SitePoint
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.exporters.floors.drawing_dxf import dumps_dxf
from locatk.formats.exporters.floors.site_drawing import draw_site
from locatk.formats.importers.floors.dxf import MAX_TEXT_DISTANCE_M, UNIT_M, DxfReader
from locatk.formats.importers.floors.site_dxf import DrawnSite, read_site_drawing

TAGS = {"layer": "TAGS"}

INSUNITS = {"mm": 4, "m": 6, "in": 1}


def drawing(tmp_path: Path, draw: Callable[[Any, Any], object], version: str = "R2010") -> Path:
    """Write a drawing in m (R12: without a unit) with the layer TAGS."""
    document = ezdxf.new(version)
    document.header["$INSUNITS"] = 6
    document.layers.add("TAGS")
    draw(document, document.modelspace())
    path = tmp_path / "plan.dxf"
    document.saveas(path)
    return path


def read(path: Path, *layers: str, unit: str | None = None) -> DrawnSite:
    return read_site_drawing(path, layers or ("TAGS",), unit)


@pytest.mark.parametrize("version", ["R12", "R2010"])
@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000.0), ("m", 1.0), ("in", 1 / 0.0254)])
def test_blocks_in_any_unit(tmp_path: Path, version: str, unit: str, scale: float) -> None:
    def draw(document: Any, space: Any) -> None:
        document.header["$INSUNITS"] = INSUNITS[unit]
        marker = document.blocks.new("MARKER")
        marker.add_circle((0, 0), 0.05 * scale)
        marker.add_attdef("ID", (0, 0))
        marker.add_attdef("MEANING", (0, 0))
        for x, y, degrees, tag_id, meaning in (
            (1.5, -0.25, 90, "77", "Müll"),
            (3, 2, -30, "", ""),
        ):
            place = (x * scale, y * scale)
            insert = space.add_blockref("MARKER", place, {**TAGS, "rotation": degrees})
            insert.add_auto_attribs({"ID": tag_id, "MEANING": meaning})
        space.add_line((0, 0), (1, 1), TAGS)
        space.add_blockref("MARKER", (9, 9), {"layer": "0"})

    # DXF R12 has no $INSUNITS.
    site = read(drawing(tmp_path, draw, version), unit=unit if version == "R12" else None)
    assert (site.has_heading, site.unit, site.ignored) == (True, unit, {"LINE": 1})
    first, second = site.points
    assert (first.x_m, first.y_m) == pytest.approx((1.5, -0.25))
    assert first.heading_rad == pytest.approx(math.pi / 2)
    assert (first.tag_id, first.meaning) == (77, "Müll")
    assert (second.x_m, second.y_m) == pytest.approx((3, 2))
    assert second.heading_rad == pytest.approx(-math.pi / 6)
    assert (second.tag_id, second.meaning) == (None, "")
    assert first.name.startswith("handle ")


@pytest.mark.parametrize("version", ["R12", "R2010"])
def test_outlines_and_points_with_texts(tmp_path: Path, version: str) -> None:
    def draw(document: Any, space: Any) -> None:
        del document
        square = [(0.9, 0.95), (1.1, 0.95), (1.1, 1.05), (0.9, 1.05)]
        triangle = [(0, 0), (0.3, 0), (0, 0.3)]
        if version == "R12":
            space.add_polyline2d(square, close=True, dxfattribs=TAGS)
            space.add_polyline2d([*triangle, (0, 0)], dxfattribs=TAGS)
            space.add_polyline2d(triangle, dxfattribs=TAGS)
        else:
            space.add_lwpolyline(square, close=True, dxfattribs=TAGS)
            space.add_lwpolyline([*triangle, (0, 0)], dxfattribs=TAGS)
            space.add_lwpolyline(triangle, dxfattribs=TAGS)
        space.add_circle((3, 1), 0.1, TAGS)
        space.add_point((5, 1), TAGS)
        for text, place in (
            ("#12 dock", (1.0, 1.1)),
            ("Tag 7", (0.2, 0.1)),
            ("charging station", (3.1, 1.1)),
            ("5", (3.1, 0.9)),
            ("Plan of hall 3", (9, 9)),
        ):
            space.add_text(text, height=0.1, dxfattribs=TAGS).set_placement(place)

    site = read(drawing(tmp_path, draw, version), unit="m" if version == "R12" else None)
    assert not site.has_heading
    kind = "POLYLINE" if version == "R12" else "LWPOLYLINE"
    assert site.ignored == {kind: 1, "distant TEXT": 1}
    points = {(round(p.x_m, 9), round(p.y_m, 9)): (p.tag_id, p.meaning) for p in site.points}
    assert points == {
        (1.0, 1.0): (12, "dock"),
        (0.1, 0.1): (7, ""),
        (3.0, 1.0): (5, "charging station"),
        (5.0, 1.0): (None, ""),
    }


def test_the_middle_of_an_outline_is_that_of_its_area(tmp_path: Path) -> None:
    """Vertices along one side, and a half circle of radius 1: 4 / (3 pi) from its diameter."""

    def draw(document: Any, space: Any) -> None:
        del document
        corners = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (4, 2), (0, 2)]
        space.add_lwpolyline(corners, close=True, dxfattribs=TAGS)
        arc = [(10, 0, 1.0), (12, 0, 0.0)]
        space.add_lwpolyline(arc, format="xyb", close=True, dxfattribs=TAGS)

    rectangle, half_circle = read(drawing(tmp_path, draw)).points
    assert (rectangle.x_m, rectangle.y_m) == pytest.approx((2, 1))
    assert half_circle.x_m == pytest.approx(11, abs=2e-3)
    assert half_circle.y_m == pytest.approx(-4 / (3 * math.pi), abs=2e-3)


def test_ids_of_blocks_and_of_texts_on_another_layer(tmp_path: Path) -> None:
    def blocks(names: list[str]) -> Callable[[Any, Any], None]:
        def draw(document: Any, space: Any) -> None:
            for number, name in enumerate(names):
                if name not in document.blocks:
                    document.blocks.new(name).add_circle((0, 0), 0.1)
                space.add_blockref(name, (number, 0), TAGS)

        return draw

    named = read(drawing(tmp_path, blocks(["TAG_5", "TAG_12", "dock"])))
    assert [point.tag_id for point in named.points] == [5, 12, None]
    # A block that is used twice is a kind of marker, not a tag.
    kind = read(drawing(tmp_path, blocks(["MARKER_2", "MARKER_2"])))
    assert [point.tag_id for point in kind.points] == [None, None]

    def numbered(document: Any, space: Any) -> None:
        block = document.blocks.new("T")
        block.add_mtext("{\\b1;31} bay", dxfattribs={"insert": (0, 0)})
        space.add_blockref("T", (0, 0), {**TAGS, "xscale": 2.0, "yscale": 2.0})
        space.add_point((1, 0), TAGS)
        space.add_mtext("44", {"layer": "Numbers", "insert": (1.1, 0)})

    path = drawing(tmp_path, numbered)
    assert [point.tag_id for point in read(path).points] == [31, None]
    both = read(path, "tags", "NUMBERS").points
    assert [(point.tag_id, point.meaning) for point in both] == [(31, "bay"), (44, "")]


def test_texts_that_are_seen_from_below_are_at_their_world_position(tmp_path: Path) -> None:
    """The transformation of ezdxf mirrors the texts; it gives them the extrusion (0, 0, -1)."""

    def draw(document: Any, space: Any) -> None:
        del document
        space.add_point((-1, 0), TAGS)
        space.add_point((1, 0), TAGS)
        for text, align in (("5", TextEntityAlignment.LEFT), ("6 dock", TextEntityAlignment.RIGHT)):
            x = 1.1 if text == "5" else -0.9
            entity = space.add_text(text, height=0.1, dxfattribs=TAGS)
            entity.set_placement((x, 0.1), align=align)
            entity.transform(Matrix44.scale(-1, 1, 1))
            assert entity.dxf.extrusion.isclose((0, 0, -1))

    left, right = read(drawing(tmp_path, draw)).points
    assert (left.tag_id, right.tag_id, right.meaning) == (5, 6, "dock")


def test_two_negative_scales_are_half_a_turn(tmp_path: Path) -> None:
    def draw(document: Any, space: Any) -> None:
        insert = marker(document, space, (2, 3), xscale=-1.0, yscale=-2.0, rotation=30.0)
        # The x axis of the block in the drawing, as ezdxf draws it.
        axis = insert.matrix44().transform_direction((1, 0, 0))
        assert math.degrees(math.atan2(axis.y, axis.x)) == pytest.approx(-150)

    (point,) = read(drawing(tmp_path, draw)).points
    assert (point.x_m, point.y_m) == pytest.approx((2, 3))
    assert math.remainder(point.heading_rad - math.radians(-150), math.tau) == pytest.approx(0)


@pytest.mark.parametrize(("other_x", "limit"), [(None, MAX_TEXT_DISTANCE_M), (9.0, 4.5)])
@pytest.mark.parametrize(("ratio", "tag_id"), [(0.99, 5), (1.01, None)])
def test_distant_texts_belong_to_no_object(
    tmp_path: Path, other_x: float | None, limit: float, ratio: float, tag_id: int | None
) -> None:
    """A single object has a limit of its own; otherwise it is half the distance to the next."""

    def draw(document: Any, space: Any) -> None:
        del document
        space.add_point((0, 0), TAGS)
        if other_x is not None:
            space.add_point((other_x, 0), TAGS)
        text = space.add_text("5", height=0.1, dxfattribs=TAGS)
        text.set_placement((0, ratio * limit))

    content = DxfReader(drawing(tmp_path, draw)).read(["TAGS"])
    found = [text.text for text in content.objects[0].nearby_texts]
    assert found == ([] if tag_id is None else [str(tag_id)])
    assert [text.text for text in content.distant_texts] == (["5"] if tag_id is None else [])


def test_exported_sites_come_back(tmp_path: Path) -> None:
    poses = {
        0: PlanarPose(0.0, 0.0, 0.0),
        77354: PlanarPose(2.5, -1.8, math.radians(-135)),
        5: PlanarPose(0.1234567, 2.6, 1.0),
    }
    tags = Tags(site=poses, meanings={0: "dock", 5: 'stop; "7"'})
    path = tmp_path / "site.dxf"
    path.write_text(dumps_dxf(draw_site(tags)))
    site = read(path)
    assert (site.unit, site.ignored) == ("mm", {})
    assert {point.tag_id for point in site.points} == set(poses)
    for point in site.points:
        pose = poses[point.tag_id]
        expected = (pose.x_m, pose.y_m, pose.heading_rad)
        assert (point.x_m, point.y_m, point.heading_rad) == pytest.approx(expected, abs=1e-12)
        assert point.meaning == tags.meanings.get(point.tag_id, "")


def marker(document: Any, space: Any, place: tuple[float, float], **more: Any) -> Any:
    if "T" not in document.blocks:
        document.blocks.new("T").add_attdef("ID", (0, 0))
    return space.add_blockref("T", place, {**TAGS, **more})


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (lambda d, s: marker(d, s, (0, 0), xscale=-1.0), "a mirrored block"),
        (lambda d, s: marker(d, s, (0, 0), yscale=-2.0), "a mirrored block"),
        (lambda d, s: marker(d, s, (0, 0), extrusion=(0, 0, -1)), "a mirrored block"),
        (lambda d, s: marker(d, s, (0, 0), extrusion=(0, 0.6, 0.8)), "a tilted block"),
        (
            lambda d, s: marker(d, s, (0, 0), column_count=3, column_spacing=1.0),
            "an array of 3 blocks",
        ),
        (
            lambda d, s: marker(d, s, (0, 0)).add_auto_attribs({"ID": "A7"}),
            "the attribute ID is 'A7'",
        ),
        (
            lambda d, s: s.add_point((450_000, 5_000_000), TAGS),
            "at 450000, 5e[+]06 m from the origin",
        ),
        (
            lambda d, s: (
                s.add_circle((0, 0), 1, TAGS),
                s.add_text("5", dxfattribs=TAGS),
                s.add_text("6", dxfattribs=TAGS),
            ),
            "a tag with two ids, '5' and '6'",
        ),
        (
            lambda d, s: (
                s.add_point((0, 0), TAGS),
                s.add_point((1, 0), TAGS),
                s.add_text("5", dxfattribs=TAGS).set_placement((0.6, 0.4)),
            ),
            "the text '5' is next to no tag",
        ),
        (
            lambda d, s: (s.add_point((0, 0), TAGS), s.add_text(41 * "x", dxfattribs=TAGS)),
            "the meaning is not one line",
        ),
    ],
)
def test_errors_name_the_entity(tmp_path: Path, draw: Any, words: str) -> None:
    path = drawing(tmp_path, draw)
    with pytest.raises(FormatError, match=words) as caught:
        read(path)
    assert caught.value.file == str(path)
    document = ezdxf.readfile(path)
    handles = {f"handle {entity.dxf.handle}" for entity in document.modelspace()}
    assert caught.value.where in handles
    assert caught.value.hint


def test_drawings_that_are_refused(tmp_path: Path) -> None:
    path = drawing(tmp_path, lambda _, space: space.add_line((0, 0), (1, 1), TAGS))
    with pytest.raises(FormatError, match="on layer TAGS, but 1 LINE"):
        read(path)
    with pytest.raises(FormatError, match="nothing is on layer 'MARKS'") as caught:
        read(path, "MARKS")
    assert caught.value.hint.endswith("--layer: TAGS")
    for version in ("R12", "R2010"):

        def unitless(document: Any, space: Any) -> None:
            document.header["$INSUNITS"] = 0
            space.add_point((3, 4), TAGS)

        path = drawing(tmp_path, unitless, version)
        with pytest.raises(FormatError, match="the drawing has no unit") as caught:
            read(path)
        assert "--units mm" in caught.value.hint
        (point,) = read(path, unit="ft").points
        assert (point.x_m, point.y_m) == pytest.approx((0.9144, 1.2192))
    for data, words in ((b"AC1032\0\0", "a drawing in DWG"), (b"id,x\n1,2\n", "not DXF")):
        path.write_bytes(data)
        with pytest.raises(FormatError, match=words):
            read(path)
    with pytest.raises(LocatkError, match="no such file"):
        read(tmp_path / "none.dxf")


def test_units_of_the_command_are_those_of_the_reader() -> None:
    assert tuple(UNIT_M) == UNITS


@pytest.fixture(scope="module")
def exported() -> bytes:
    poses = {5: PlanarPose(0, 0, 0), 7: PlanarPose(1, 0, 0)}
    return dumps_dxf(draw_site(Tags(site=poses))).encode()


@pytest.mark.slow
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_any_damage_is_points_or_an_error(
    tmp_path: Path, exported: bytes, data: st.DataObject
) -> None:
    lines = exported.split(b"\n")
    for _ in range(data.draw(st.integers(1, 4))):
        index = data.draw(st.integers(0, len(lines) - 1))
        lines[index] = data.draw(
            st.sampled_from([b"", b"0", b"-1", b"nan", b"1e308", b"INSERT", b"SECTION", b"\xff"])
        )
    end = data.draw(st.integers(len(lines) // 2, len(lines)))
    path = tmp_path / "damaged.dxf"
    path.write_bytes(b"\n".join(lines[:end]))
    with contextlib.suppress(LocatkError):
        for point in read(path).points:
            assert isinstance(point, SitePoint)
            assert math.isfinite(point.x_m + point.y_m + point.heading_rad)
