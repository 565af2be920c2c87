"""Maps through the tables of other tools, CSV and LIF, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.map.floor import HOLE_CODE, AsBuiltLandmark, FloorMap, as_built_poses
from locatk.formats.exporters.floors.map_csv import dumps_csv, landmark_number
from locatk.formats.exporters.floors.map_lif import dumps_lif
from locatk.formats.importers.floors.map_csv import HEADER, loads_csv
from locatk.formats.importers.floors.map_lif import loads_lif

STAMP = datetime(2026, 3, 1, 12, 30, 5, 120_000, tzinfo=UTC)

NONE = np.full(7, np.nan)


@st.composite
def placed_floors(draw: st.DrawFn) -> FloorMap:
    """Maps that are told by places: in whole 1/100 mm, the first row and column not empty,
    with two neighbours from which the pitch is seen."""
    rows, columns = draw(st.integers(1, 5)), draw(st.integers(2, 5))
    letters = st.integers(HOLE_CODE, 15)
    values = draw(st.lists(letters, min_size=rows * columns, max_size=rows * columns))
    values[:2] = draw(st.integers(0, 15)), draw(st.integers(0, 15))
    codes = np.array(values, np.int64).reshape(rows, columns)
    codes = codes[: np.flatnonzero((codes != HOLE_CODE).any(1))[-1] + 1]
    codes = codes[:, : np.flatnonzero((codes != HOLE_CODE).any(0))[-1] + 1]
    cells = [(int(r), int(c)) for r, c in np.argwhere(codes != HOLE_CODE)]
    pairs = [((r, c), (r + dr, c + dc)) for r, c in cells for dr, dc in ((0, 1), (1, 0))]
    pairs = [pair for pair in pairs if pair[1] in cells]
    hundredth = st.integers(-(10**6), 10**6).map(lambda value: value / 1e5)
    return FloorMap(
        codes,
        draw(st.integers(6_000, 60_000)) / 1e5,
        origin_m=(draw(hundredth), draw(hundredth)),
        walls=draw(st.frozensets(st.sampled_from(pairs), max_size=5)),
    )


def reread_csv(floor: FloorMap) -> FloorMap:
    return loads_csv(dumps_csv(floor), file="map.csv")


def reread_unique_codes(floor: FloorMap) -> FloorMap:
    return loads_csv(dumps_csv(floor, unique_codes=True), file="map.csv")


def reread_lif(floor: FloorMap, version: str = "1.0.0") -> FloorMap:
    return loads_lif(dumps_lif(floor, STAMP, version), file="map.json")


def reread_lif_2(floor: FloorMap) -> FloorMap:
    return reread_lif(floor, "2.0.0")


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(placed_floors())
def test_a_map_as_designed_comes_back(floor: FloorMap) -> None:
    for reread in (reread_csv, reread_unique_codes, reread_lif, reread_lif_2):
        back = reread(floor)
        np.testing.assert_array_equal(back.codes, floor.codes)
        assert back.pitch_m == floor.pitch_m
        assert back.origin_m == floor.origin_m
        assert back.built == {}
    assert reread_lif(floor).walls == reread_lif_2(floor).walls == floor.walls


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(placed_floors(), st.data())
def test_landmarks_as_built_keep_their_positions(floor: FloorMap, data: st.DataObject) -> None:
    """Which part of a place is the grid's cannot be known; the places are the same."""
    offset = st.sampled_from([-0.004, -1e-4, 0.0, 2e-5, 0.003])
    cells = data.draw(st.lists(st.sampled_from(floor.cells()), max_size=3, unique=True))
    turn = math.radians(1.25)
    built = {
        cell: AsBuiltLandmark(
            data.draw(offset), data.draw(offset), turn, signs(floor.codes[cell]), NONE
        )
        for cell in cells
    }
    laid = FloorMap(floor.codes, floor.pitch_m, origin_m=floor.origin_m, built=built)
    for back, turned in ((reread_csv(laid), True), (reread_lif(laid), False)):
        np.testing.assert_array_equal(back.codes, laid.codes)
        places = as_built_poses(back)
        # A place that is as near to its cell as 1 um is the cell's.
        np.testing.assert_allclose(places[:, :2], as_built_poses(laid)[:, :2], atol=1.5e-6)
        if turned:
            np.testing.assert_allclose(places[:, 2], as_built_poses(laid)[:, 2], atol=1e-9)
        for cell, found in back.built.items():
            np.testing.assert_array_equal(found.strength, signs(laid.codes[cell]))
            assert np.isnan(found.sigma).all()
            assert found.visits == 0


# ---- CSV


def test_the_table_has_the_columns_of_controllers() -> None:
    floor = FloorMap(
        np.array([[7, HOLE_CODE], [0, 15]]),
        origin_m=(-2.48, 0.0125),
        built={(1, 1): AsBuiltLandmark(0.0012, 0, math.radians(-0.5), signs(15), NONE)},
    )
    assert dumps_csv(floor) == (
        "No;Code;X mm;Y mm;Attr1;Attr2;Attr3;Attr4\n"
        "0;7;-2480;12.5;0;0;0;0\n"
        "1;0;-2480;212.5;0;0;0;0\n"
        "2;15;-2278.8;212.5;-50;0;0;0\n"
    )


def test_unique_codes_are_numbers_of_the_cells() -> None:
    floor = FloorMap(np.array([[7, HOLE_CODE, 7], [7, 15, 0]]))
    table = (
        "No;Code;X mm;Y mm;Attr1;Attr2;Attr3;Attr4;Landmark\n"
        "0;1;0;0;0;0;0;0;NNNS\n"
        "1;9;400;0;0;0;0;0;NNNS\n"
        "2;2;0;200;0;0;0;0;NNNS\n"
        "3;3;200;200;0;0;0;0;NNNN\n"
        "4;8;400;200;0;0;0;0;SSSS\n"
    )
    assert dumps_csv(floor, unique_codes=True) == table
    np.testing.assert_array_equal(loads_csv(table, file="x.csv").codes, floor.codes)
    # The letters suffice; an unknown code of the controller is not read.
    without = table.replace("No;Code;", "No;Tag;").replace("0;1;0", "0;x;0")
    np.testing.assert_array_equal(loads_csv(without, file="x.csv").codes, floor.codes)


def test_numbers_of_cells_stay_when_the_floor_grows() -> None:
    """The cells of a square of n x n have the numbers 1 to n^2."""
    for side in (1, 2, 17):
        numbers = {landmark_number((r, c)) for r in range(side) for c in range(side)}
        assert numbers == set(range(1, side**2 + 1))


def test_tables_of_other_programs() -> None:
    """Other orders of columns, no header, a comma in decimals, attributes that are missing
    and a start transponder, whose attribute is the heading of vehicles."""
    wanted = FloorMap(np.array([[3, 9]]), pitch_m=0.2005, origin_m=(1.0, -2.0))
    for text in (
        "\ufeffY [mm];code;remark;X [mm]\n-2000;3;gate;1000\n\n-2000;9;;1200,5\n",
        "4;3;1000;-2000\r\n9;9;1200.5;-2000\r\n",
        ";".join(HEADER) + "\n0;9;1200.5;-2000;9000;0;0;1\n1;3;1000;-2000;;;;\n",
    ):
        found = loads_csv(text, file="x.csv")
        np.testing.assert_array_equal(found.codes, wanted.codes)
        assert (found.pitch_m, found.origin_m) == (wanted.pitch_m, wanted.origin_m)
        assert found.built == {}


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", None, "no landmarks"),
        ("No;Code;X mm;Y mm\n", None, "no landmarks"),
        ("No;Code;X;Z\n1;2;3;4\n", 1, "no column 'Y mm'"),
        ("x,y\n1,2\n", 1, "no column 'Code'"),
        ("0;16;0;0\n", 1, "'16' under 'Code', expected a whole number from 0 to 15"),
        ("0;1;0;0\n1;;200;0\n", 2, "'' under 'Code'"),
        ("No;Code;X;Y;Landmark\n0;1;0;0;NNNS\n1;2;200;0;\n", 3, "'' under 'Landmark'"),
        ("No;Code;X;Y;Landmark\n0;1;0;0;NNNX\n", 2, "'NNNX' under 'Landmark', expected the let"),
        ("0;1.0;0;0\n", 1, "'1.0' under 'Code'"),
        ("0;1;0;0\n1;1;2 m;0\n", 2, "'2 m' under 'X mm', expected a number"),
        ("0;1;0\n", 1, "'' under 'Y mm'"),
        ("0;1;nan;0\n", 1, "'nan' under 'X mm'"),
        ("0;1;0;1e9\n", 1, "up to 1e+07"),
        ("0;1;0;0;36000\n", 1, "'36000' under 'Attr1'"),
        ("0;1;0;0\n", None, "one position does not give a pitch"),
        ("0;1;0;0\n1;1;200;0\n2;1;400.1;1\n3;1;402;1\n", None, "line 3 and line 4 are in one cell"),
        ("0;1;0;0\n1;1;200;0\n2;1;311;0\n", None, "on no grid"),
        ("0;1;0;0\n1;1;200;0\n0;1;400;0\n", 3, "No 0 is also in line 1"),
        ("0;1;0;0;0\n1;1;200;0\n", 2, "4 cells in a row of 5"),
        ("No;Code;X;Y;X mm\n0;1;0;0;0\n", 1, "column 'X mm' occurs twice"),
        ("0;1;0;0\n1;1;2_00;0\n", 2, "'2_00' under 'X mm', expected a number"),
    ],
)
def test_errors_of_a_table_name_the_line(text: str, where: int | None, words: str) -> None:
    with pytest.raises(InputError) as caught:
        loads_csv(text, file="map.csv")
    assert words in caught.value.message
    assert (caught.value.file, caught.value.where) == ("map.csv", where)


def test_landmarks_without_a_heading_are_warned_of() -> None:
    for text, expected in (
        ("0;1;0;0;0\n1;1;200;0;5\n", []),
        ("0;1;0;0\n1;1;200;0\n", ["map.csv:1: 2 of 2 landmarks have no heading (Attr1)"]),
        ("0;1;0;0;0\n1;1;200;0;\n", ["map.csv:2: 1 of 2 landmarks have no heading (Attr1)"]),
    ):
        warnings: list[str] = []
        loads_csv(text, file="map.csv", warnings=warnings)
        assert [warning.partition(": imported")[0] for warning in warnings] == (expected)


def is_map_or_error(load: Callable[[], object]) -> bool:
    """A map, or an error that names the file."""
    try:
        return isinstance(load(), FloorMap)
    except InputError as error:
        return error.file == "map.csv"


@pytest.mark.slow
@given(st.text(alphabet='0123456789;,.-\n"ex Code', max_size=60))
def test_any_table_is_a_map_or_an_error(text: str) -> None:
    for head in ("", ";".join(HEADER) + "\n0;1;0;0\n1;2;200;0\n"):
        assert is_map_or_error(lambda head=head: loads_csv(head + text, file="map.csv"))


# ---- LIF

FLOOR = FloorMap(
    np.array([[7, 1, HOLE_CODE], [0, 15, 9]]), walls=frozenset({((0, 0), (1, 0))}), name="hall"
)


def fields(found: dict[str, Any], wanted: dict[str, type | tuple[type, ...]]) -> None:
    """All of the fields, each of its type."""
    for key, kind in wanted.items():
        assert isinstance(found[key], kind), key


def test_the_layout_has_what_lif_requires() -> None:
    """Required fields of LIF 1.0.0, by VDMA's document of March 2024, chapters 8.3.1 to 8.3.9."""
    data = json.loads(dumps_lif(FLOOR, STAMP))
    assert set(data) == {"metaInformation", "layouts"}
    fields(data["metaInformation"], {"projectIdentification": str, "creator": str})
    assert data["metaInformation"]["exportTimestamp"] == "2026-03-01T12:30:05.12Z"
    assert data["metaInformation"]["lifVersion"] == "1.0.0"
    (layout,) = data["layouts"]
    fields(layout, {"layoutId": str, "layoutVersion": str, "layoutLevelId": str})
    fields(layout, {"nodes": list, "edges": list, "stations": list})
    ids = set()
    for node in layout["nodes"]:
        fields(node, {"nodeId": str, "nodePosition": dict, "vehicleTypeNodeProperties": list})
        fields(node["nodePosition"], {"x": (int, float), "y": (int, float)})
        fields(node["vehicleTypeNodeProperties"][0], {"vehicleTypeId": str})
        ids.add(node["nodeId"])
    assert len(ids) == len(layout["nodes"]) == 5
    for edge in layout["edges"]:
        fields(edge, {"edgeId": str, "vehicleTypeEdgeProperties": list})
        assert {edge["startNodeId"], edge["endNodeId"]} <= ids
        (properties,) = edge["vehicleTypeEdgeProperties"]
        fields(properties, {"vehicleTypeId": str, "rotationAllowed": bool})
        fields(properties, {"vehicleOrientation": float})
        assert properties["orientationType"] == "TANGENTIAL"
    assert len({edge["edgeId"] for edge in layout["edges"]}) == len(layout["edges"])
    # r0c0-r0c1, r0c1-r1c1, r1c0-r1c1, r1c1-r1c2, both ways; r0c0-r1c0 is walled.
    assert len(layout["edges"]) == 8
    assert "r0c0-r1c0" not in {edge["edgeId"] for edge in layout["edges"]}
    named = {node["nodeId"]: node["nodeName"] for node in layout["nodes"]}
    assert named["r0c0"] == "NNNS"
    assert reread_lif(FLOOR).name == "hall"


def test_the_layout_has_what_lif_2_requires() -> None:
    """Required keys of json_schemas/LIF.schema of the repository of LIF 2.0.0; no key of 1.0.0."""
    data = json.loads(dumps_lif(FLOOR, STAMP, "2.0.0"))
    assert set(data) == {"metaInformation", "origins"}
    head = data["metaInformation"]
    assert set(head) == {"lifId", "creator", "exportTimestamp", "lifVersion"}
    assert head["lifVersion"] == "2.0.0"
    assert head["exportTimestamp"] == "2026-03-01T12:30:05.120Z"
    (origin,) = data["origins"]
    fields(origin, {"originId": str, "layouts": list})
    (layout,) = origin["layouts"]
    assert set(layout) == {
        "layoutId", "layoutName", "layoutVersion", "layoutDescriptor", "nodes", "edges"
    }  # fmt: skip
    robots = [{"manufacturer": "locatk", "seriesName": "landmarks"}]
    for node in layout["nodes"]:
        assert set(node) == {
            "nodeId", "nodeDescriptor", "mapId", "nodePosition", "mobileRobotTypeNodeProperties"
        }  # fmt: skip
        assert node["mobileRobotTypeNodeProperties"] == [{"mobileRobotTypes": robots}]
    for edge in layout["edges"]:
        assert set(edge) == {"edgeId", "startNodeId", "endNodeId", "mobileRobotTypeEdgeProperties"}
        (properties,) = edge["mobileRobotTypeEdgeProperties"]
        assert properties["mobileRobotTypes"] == robots
        assert properties["mobileRobotOrientations"] == [0.0]
        assert properties["reachOrientationBeforeEntering"] is True
        assert properties["orientationType"] == "TANGENTIAL"
    # Nodes and passages are those of LIF 1.
    first = json.loads(dumps_lif(FLOOR, STAMP))["layouts"][0]
    for key, name in (("nodes", "nodeId"), ("edges", "edgeId")):
        assert [item[name] for item in layout[key]] == [item[name] for item in first[key]]
    letters = {node["nodeId"]: node["nodeDescriptor"] for node in layout["nodes"]}
    assert letters == {node["nodeId"]: node["nodeName"] for node in first["nodes"]}


def changed_2(change: Callable[[dict[str, Any]], object]) -> str:
    data = json.loads(dumps_lif(FLOOR, STAMP, "2.0.0"))
    change(data)
    return json.dumps(data)


def state_version(version: object) -> Callable[[dict[str, Any]], object]:
    return lambda data: data["metaInformation"].update(lifVersion=version)


def test_the_version_of_a_layout_is_detected() -> None:
    for text in (
        changed_2(lambda data: None),
        changed_2(state_version("2.1.3")),
        changed_2(lambda data: data.pop("metaInformation")),
        changed_2(lambda data: data["origins"].append({"originId": "empty", "layouts": []})),
        changed(state_version("1.0.1")),
        changed(lambda data: data.pop("metaInformation")),
    ):
        found = loads_lif(text, file="map.json")
        np.testing.assert_array_equal(found.codes, FLOOR.codes)
        assert (found.walls, found.name) == (FLOOR.walls, "hall")


def test_the_stamp_is_in_utc() -> None:
    later = datetime.fromisoformat("2026-03-01T14:30:05.12+02:00")
    assert dumps_lif(FLOOR, later) == dumps_lif(FLOOR, STAMP)


def changed(change: Callable[[dict[str, Any]], object]) -> str:
    data = json.loads(dumps_lif(FLOOR, STAMP))
    change(data)
    return json.dumps(data)


def test_an_edge_in_one_direction_is_not_a_wall() -> None:
    text = changed(lambda data: data["layouts"][0]["edges"].pop(0))
    assert loads_lif(text, file="map.json").walls == FLOOR.walls


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", 1, "not JSON"),
        ("{\n\n", 3, "not JSON"),
        ("[1]", None, "not LIF"),
        (changed(state_version("3.0.0")), "metaInformation.lifVersion", "'3.0.0' of LIF is not"),
        (changed(state_version("0.11.0")), "metaInformation.lifVersion", "is not supported"),
        (changed(state_version(2)), "metaInformation.lifVersion", "is not supported"),
        (changed(state_version("2.0.0")), None, "not LIF 2: expected the key 'origins'"),
        (changed_2(state_version("1.0.0")), None, "not LIF 1: expected the key 'layouts'"),
        (changed_2(lambda d: d["origins"].append(d["origins"][0])), "layouts", "2 layouts"),
        (changed_2(lambda d: d.update(origins=1)), "origins", "list of objects"),
        (
            changed_2(lambda d: d["origins"][0]["layouts"][0]["nodes"][2].pop("nodeDescriptor")),
            "nodes[2].nodeDescriptor",
            "the nodeDescriptor of node 'r1c0' is not a landmark",
        ),
        ("{}", None, "not LIF"),
        ('{"layouts": 1}', "layouts", "list of objects"),
        ('{"layouts": []}', "layouts", "0 layouts"),
        (changed(lambda d: d["layouts"].append({})), "layouts", "2 layouts, expected one"),
        (changed(lambda d: d["layouts"][0].pop("nodes")), "nodes", "list of objects"),
        (changed(lambda d: d["layouts"][0].pop("edges")), "edges", "list of objects"),
        (changed(lambda d: d["layouts"][0]["nodes"].clear()), "nodes", "without nodes"),
        (
            changed(lambda d: d["layouts"][0]["nodes"][2].pop("nodeName")),
            "nodes[2].nodeName",
            "the nodeName of node 'r1c0' is not a landmark",
        ),
        (
            changed(lambda d: d["layouts"][0]["nodes"][2].update(nodeId="r0c0")),
            "nodes[2]",
            "node 'r0c0' occurs twice",
        ),
        (
            changed(lambda d: d["layouts"][0]["nodes"][1]["nodePosition"].update(x="0")),
            "nodes[1].nodePosition",
            "x and y in metres",
        ),
        (
            changed(lambda d: d["layouts"][0]["nodes"][1]["nodePosition"].update(x=2000_000)),
            "nodes[1].nodePosition",
            "up to 10000",
        ),
        (
            changed(lambda d: d["layouts"][0]["edges"][1].pop("endNodeId")),
            "edges[1].endNodeId",
            "expected a string",
        ),
    ],
)
def test_errors_of_a_layout_name_the_key(text: str, where: object, words: str) -> None:
    with pytest.raises(FormatError) as caught:
        loads_lif(text, file="map.json")
    assert words in caught.value.message
    assert (caught.value.file, caught.value.where) == ("map.json", where)


def test_a_node_off_the_grid_is_named() -> None:
    text = changed(lambda d: d["layouts"][0]["nodes"][4]["nodePosition"].update(x=0.43))
    with pytest.raises(InputError, match=r"^map\.json: node 'r1c2' is ") as caught:
        loads_lif(text, file="map.json", pitch_m=0.2)
    assert "--tolerance" in str(caught.value.hint)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=60)
@given(
    st.sampled_from(["layouts", "nodes", "edges", "nodeId", "nodePosition", "x", "endNodeId"]),
    json_values,
)
def test_any_layout_is_a_map_or_an_error(key: str, value: object) -> None:
    def put(data: Any) -> None:
        if isinstance(data, dict):
            for name in data:
                if name == key:
                    data[name] = value
                else:
                    put(data[name])
        elif isinstance(data, list):
            put(data[0] if data else None)

    assert is_map_or_error(lambda: loads_lif(changed(put), file="map.csv"))
