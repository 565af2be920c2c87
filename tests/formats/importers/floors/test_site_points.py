"""Points for tags from tables and LIF layouts: read strictly, errors name line or node."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import LocatkError
from locatk.core.polaris.design.site import SitePoint
from locatk.formats.importers.floors.site_csv import read_site_points
from locatk.formats.importers.floors.site_lif import loads_site_points


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "survey.csv"
    path.write_text(text)
    return path


def test_a_table_in_its_units(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        'Point,X [mm],y_cm,Heading (deg),id,Meaning\np1,1500,-20,90,77,"stop, wait"\np2,0,0,,,\n',
    )
    points, has_heading = read_site_points(path)
    assert has_heading
    assert points == [
        SitePoint(1.5, -0.2, math.pi / 2, 77, "stop, wait", "line 2"),
        SitePoint(0.0, 0.0, 0.0, None, "", "line 3"),
    ]
    bare, has_heading = read_site_points(
        table(tmp_path, "north,east,no\n1,2,123456789012345678901234567890\n"),
        {"x": "east", "y": "north", "id": "no"},
        ("m",),
    )
    assert not has_heading
    assert bare == [SitePoint(2.0, 1.0, 0.0, 123456789012345678901234567890, "", "line 2")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y_mm\n1,2\n", "the unit of column 'x' is missing"),
        ("x_mm\n1\n", "a column for y is missing"),
        ("x_mm,y_mm,id\n1,2,-3\n", "'-3' is not an id"),
        ("x_mm,y_mm,id\n1,2,3.0\n", "'3.0' is not an id"),
        ("x_mm,y_mm\n1,\n", "column 'y_mm' is empty or above"),
        ("x_m,y_m\n1,20000\n", "column 'y_m' is empty or above 10000 m"),
        ("x_mm,y_mm\n1,b\n", "'b' instead of a number"),
        ("x_mm,y_mm,meaning\n1,2," + 41 * "x" + "\n", "the meaning is not one line of at most 40"),
        ("x_mm,y_mm\n", "a header and no rows"),
        ("", "empty file"),
    ],
)
def test_tables_that_are_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(LocatkError, match=words) as caught:
        read_site_points(table(tmp_path, text))
    assert caught.value.file == str(tmp_path / "survey.csv")


def test_keys_of_columns_are_known(tmp_path: Path) -> None:
    path = table(tmp_path, "x_mm,y_mm\n1,2\n")
    with pytest.raises(LocatkError, match="unknown column key 'z'"):
        read_site_points(path, {"z": "x_mm"})
    with pytest.raises(LocatkError, match="column 'name' is missing"):
        read_site_points(path, {"id": "name"})


def layout(nodes: list[dict[str, Any]], version: str = "1.0.0") -> str:
    head = {"metaInformation": {"lifVersion": version}}
    if version.startswith("1"):
        return json.dumps({**head, "layouts": [{"nodes": nodes, "edges": []}]})
    return json.dumps({**head, "origins": [{"layouts": [{"nodes": nodes, "edges": []}]}]})


def node(name: str, number: int, **more: Any) -> dict[str, Any]:
    return {
        "nodeId": f"n{number}",
        "nodeName": name,
        "nodePosition": {"x": 1.5 * number, "y": -1.0},
        **more,
    }


def test_nodes_with_ids_or_meanings() -> None:
    theta = [{"vehicleTypeId": "a"}, {"vehicleTypeId": "b", "theta": 1.5}]
    nodes = [node("77", 0, vehicleTypeNodeProperties=theta), node("5", 1)]
    points, has_heading = loads_site_points(layout(nodes), file="a.json")
    assert has_heading
    assert points == [
        SitePoint(0.0, -1.0, 1.5, 77, "", "node 'n0'"),
        SitePoint(1.5, -1.0, 0.0, 5, "", "node 'n1'"),
    ]
    nodes = [node("77", 0), node("Dock\n 5", 1), {**node("", 2), "nodeName": None}]
    points, has_heading = loads_site_points(layout(nodes), file="a.json")
    assert not has_heading
    assert [point.tag_id for point in points] == [None] * 3
    assert [point.meaning for point in points] == ["77", "Dock 5", "n2"]
    nodes = [{**node("", 0), "nodeDescriptor": "12"}]
    points, _ = loads_site_points(layout(nodes, "2.0.0"), file="a.json")
    assert points[0].tag_id == 12


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        ("[]", "not LIF"),
        (layout([]), "a layout without nodes"),
        (layout([node("1", 0), node("2", 0)]), "node 'n0' occurs twice"),
        (layout([{**node("1", 0), "nodePosition": {"x": 1}}]), "expected x and y in metres"),
        (
            layout([node("1", 0, vehicleTypeNodeProperties=[{"theta": 90}])]),
            "expected an angle in radians",
        ),
        (layout([node("1", 0)], "3.0"), "version '3.0' of LIF is not supported"),
    ],
)
def test_layouts_that_are_refused(text: str, words: str) -> None:
    with pytest.raises(LocatkError, match=words):
        loads_site_points(text, file="a.json")


@pytest.mark.slow
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.text(alphabet='xyid_mheading,\n0123456789.-+e" ', max_size=120), st.booleans())
def test_any_text_is_points_or_an_error(tmp_path: Path, text: str, is_headed: bool) -> None:
    path = table(tmp_path, ("x_mm,y_mm,id\n" if is_headed else "") + text)
    try:
        points, _ = read_site_points(path)
    except LocatkError:
        return
    assert all(math.isfinite(point.x_m + point.y_m + point.heading_rad) for point in points)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    ["layouts", "nodes", "nodeId", "nodePosition", "x", "y", "theta", "nodeName"]
                ),
                inner,
                max_size=4,
            )
        ),
        max_leaves=12,
    )
)
def test_any_json_is_points_or_an_error(value: Any) -> None:
    for text in (json.dumps(value), layout([value] if isinstance(value, dict) else [])):
        with contextlib.suppress(LocatkError):
            loads_site_points(text, file="a.json")
