"""Sites of tags as tables, layouts and drawings: the same poses, ids and meanings."""

from __future__ import annotations

import io
import json
import math
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree as Xml

import ezdxf
import numpy as np
import pytest

from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.design.site import place_tags
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.exporters.floors.drawing_dxf import dumps_dxf
from locatk.formats.exporters.floors.drawing_svg import INKSCAPE, NAMESPACE, dumps_svg
from locatk.formats.exporters.floors.site_csv import dumps_csv
from locatk.formats.exporters.floors.site_drawing import draw_site
from locatk.formats.exporters.floors.site_lif import dumps_lif
from locatk.formats.importers.floors.site_csv import read_site_points
from locatk.formats.importers.floors.site_lif import loads_site_points

STAMP = datetime(2026, 3, 1, 12, 30, 5, 120_000, tzinfo=UTC)

DESIGN = Tags(ids=(0, 202517, 77354, 279871), min_distance=3)

SITE = Tags(
    ids=DESIGN.ids,
    min_distance=3,
    site={
        0: PlanarPose(0.0, 0.0, 0.0),
        77354: PlanarPose(2.5, -1.800000001, math.radians(-135)),
        202517: PlanarPose(1.5005, 0.2, math.pi / 2),
        279871: PlanarPose(0.1234567, 2.6, 1.0),
    },
    meanings={0: "=dock", 202517: 'stop; "wait", 5', 279871: "7"},
)


def assert_same_site(back: Tags, site: Tags = SITE) -> None:
    assert (back.ids, back.meanings) == (site.ids, site.meanings)
    assert list(back.site) == list(site.site)
    for tag_id, pose in site.site.items():
        other = back.site[tag_id]
        assert (other.x_m, other.y_m) == (pose.x_m, pose.y_m)
        assert other.heading_rad == pytest.approx(pose.heading_rad, abs=1e-13)


def test_a_table_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "site.csv"
    path.write_text(dumps_csv(SITE))
    points, has_heading = read_site_points(path)
    assert has_heading
    assert_same_site(place_tags(DESIGN, points))
    # No spreadsheet runs a meaning as a formula.
    assert "\n0,0,0,0,'=dock\n" in dumps_csv(SITE)
    assert "\n77354,2500,-1800.000001,-135,\n" in dumps_csv(SITE)


@pytest.mark.parametrize("version", ["1.0.0", "2.0.0"])
def test_a_layout_comes_back(version: str) -> None:
    points, has_heading = loads_site_points(dumps_lif(SITE, STAMP, version), file="a.json")
    assert has_heading
    assert_same_site(place_tags(DESIGN, points))


def test_the_layouts_have_what_lif_requires() -> None:
    """Required fields of LIF 1.0.0 (chapters 8.3.1 to 8.3.9) and of the schema of LIF 2.0.0."""
    data = json.loads(dumps_lif(SITE, STAMP))
    assert data["metaInformation"]["exportTimestamp"] == "2026-03-01T12:30:05.12Z"
    (layout,) = data["layouts"]
    assert {"layoutId", "layoutVersion", "layoutLevelId"} <= set(layout)
    assert (layout["edges"], layout["stations"]) == ([], [])
    node = layout["nodes"][1]
    assert (node["nodeId"], "nodeName" in node) == ("tag77354", False)
    assert node["nodePosition"] == {"x": 2.5, "y": -1.800000001}
    (properties,) = node["vehicleTypeNodeProperties"]
    assert properties["vehicleTypeId"] == "locatk.polaris"
    assert properties["theta"] == pytest.approx(math.radians(-135))
    (origin,) = json.loads(dumps_lif(SITE, STAMP, "2.0.0"))["origins"]
    node = origin["layouts"][0]["nodes"][2]
    assert {"nodeId", "mapId", "nodePosition", "mobileRobotTypeNodeProperties"} <= set(node)
    assert node["nodeDescriptor"] == 'stop; "wait", 5'
    (properties,) = node["mobileRobotTypeNodeProperties"]
    robot = {"manufacturer": "locatk", "seriesName": "polaris"}
    assert properties["mobileRobotTypes"] == [robot]


def test_headings_of_layouts_are_within_half_a_turn() -> None:
    """Range of theta: -pi to pi, in both versions."""
    site = Tags(site={5: PlanarPose(0, 0, math.radians(350))})
    for version in ("1.0.0", "2.0.0"):
        ((point,), _) = loads_site_points(dumps_lif(site, STAMP, version), file="a.json")
        assert point.heading_rad == pytest.approx(math.radians(-10))


def north_ends(tag_id: int) -> np.ndarray:
    """Directions of the magnets on the floor [rad], from the codec: clockwise from x."""
    symbols = np.array(layout_of(SITE, tag_id).symbols)
    return SITE.site[tag_id].heading_rad - symbols * math.tau / SITE.orientations


def test_dxf_has_a_block_for_each_tag() -> None:
    text = dumps_dxf(draw_site(SITE))
    assert text == dumps_dxf(draw_site(SITE))
    document = ezdxf.read(io.StringIO(text))
    assert not document.audit().has_errors
    assert document.units == ezdxf.units.MM
    space = document.modelspace()
    assert {entity.dxf.layer for entity in space} == {"TAGS", "CENTRES", "LABELS"}
    labels = sorted(entity.dxf.text for entity in space.query("TEXT"))
    assert labels == ["0 =dock", '202517 stop; "wait", 5', "279871 7", "77354"]
    inserts = {entity.dxf.name: entity for entity in space.query("INSERT")}
    assert set(inserts) == {f"TAG_{tag_id}" for tag_id in SITE.site}
    for tag_id, pose in SITE.site.items():
        insert = inserts[f"TAG_{tag_id}"]
        assert insert.dxf.layer == "TAGS"
        assert tuple(insert.dxf.insert)[:2] == pytest.approx((1e3 * pose.x_m, 1e3 * pose.y_m))
        assert math.radians(insert.dxf.rotation) == pytest.approx(pose.heading_rad)
        assert insert.get_attrib_text("ID") == str(tag_id)
        assert insert.get_attrib_text("MEANING") == SITE.meanings.get(tag_id, "")
        parts = list(insert.virtual_entities())
        (outline,) = (part for part in parts if part.dxftype() == "LWPOLYLINE")
        corners = np.array([point[:2] for point in outline.get_points()])
        np.testing.assert_allclose(corners.mean(0), [1e3 * pose.x_m, 1e3 * pose.y_m], atol=1e-6)
        np.testing.assert_allclose(np.hypot(*np.diff(corners, axis=0).T), 120)
        discs = [part for part in parts if part.dxftype() == "CIRCLE"]
        assert {(disc.dxf.radius, disc.dxf.layer) for disc in discs} == {(1.0, "MAGNETS")}
        lines = [part for part in parts if part.dxftype() == "LINE"]
        along = {
            layer: [line.dxf.end - line.dxf.start for line in lines if line.dxf.layer == layer]
            for layer in ("TAGS", "MAGNETS")
        }
        (forward,) = along["TAGS"]
        assert math.remainder(forward.angle - pose.heading_rad, math.tau) == pytest.approx(0)
        ours = np.array([arrow.angle for arrow in along["MAGNETS"]])
        difference = np.exp(1j * (ours - north_ends(tag_id)))
        np.testing.assert_allclose(difference, 1, atol=1e-9)


def test_svg_is_at_true_size_in_layers() -> None:
    root = Xml.fromstring(dumps_svg(draw_site(SITE)))
    left = root.get("viewBox").split()
    assert (root.get("width"), root.get("height")) == (f"{left[2]}mm", f"{left[3]}mm")
    assert float(left[3]) == pytest.approx(2600 + 1800.000001 + 2 * 120, abs=1e-3)
    layers = {
        group.get("id"): group
        for group in root.iter(f"{{{NAMESPACE}}}g")
        if group.get(f"{{{INKSCAPE}}}groupmode") == "layer"
    }
    assert list(layers) == ["tags", "centres", "labels"]
    groups = {group.get("id"): group for group in layers["tags"]}
    assert set(groups) == {f"tag{tag_id}" for tag_id in SITE.site}
    discs = {name: group.findall("{*}circle") for name, group in groups.items()}
    assert {len(each) for each in discs.values()} == {5}

    def on_floor(name: str) -> np.ndarray:
        return np.array([[float(disc.get("cx")), -float(disc.get("cy"))] for disc in discs[name]])

    # The heading of tag 202517 is 90 degrees: its v1 (lower left, forward up) is lower left.
    first, second = on_floor("tag0"), on_floor("tag202517")
    shift = second[0] - first[0]
    np.testing.assert_allclose(first[0] - first.min(0), [0, 80], atol=1e-3)
    np.testing.assert_allclose(second[0], second.min(0), atol=1e-3)
    np.testing.assert_allclose(shift, [1500.5, 200 - 80], atol=1e-3)
