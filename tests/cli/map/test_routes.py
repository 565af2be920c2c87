"""`locatk map check --route` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from locatk.core.landmarks.design.routes import check_routes
from locatk.core.routes import Route
from locatk.formats.artifacts.maps import read_map
from locatk.formats.plots.landmark_routes import draw_routes


@pytest.fixture
def made(locatk, tmp_path: Path) -> Path:
    path = tmp_path / "map.toml"
    assert locatk("map", "design", "6x7", "-o", path).exit_code == 0
    return path


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    path = tmp_path / "drive.csv"
    path.write_text("x_mm,y_mm\n0,200\n1200,200\n1200,1000\n")
    return path


@pytest.fixture
def between(tmp_path: Path) -> Path:
    path = tmp_path / "between.csv"
    path.write_text("x [m],y [m]\n0,0.1\n1.2,0.1\n")
    return path


def test_table_and_json_give_the_prediction(locatk, made: Path, drive: Path) -> None:
    result = locatk("map", "check", made, "--route", drive)
    assert result.exit_code == 0, result.stderr
    (line,) = (row for row in result.stdout.splitlines() if row.startswith("drive "))
    assert max(map(len, result.stdout.splitlines()[1:])) <= 80
    assert "by locatk live" in result.stdout
    output = json.loads(locatk("map", "check", made, "--route", drive, "--json").stdout)
    assert output["maps"][0]["verdict"].startswith("unique")
    (route,) = output["routes"]
    floor = read_map(made)
    expected = check_routes(floor, [Route(np.array([[0, 0.2], [1.2, 0.2], [1.2, 1.0]]))])[0]
    assert route["localizable"] is True
    assert route["localized_after_landmarks"] == expected.localized_after
    assert route["position_p95_m"] == pytest.approx(expected.position_p95_m, rel=1e-2)
    assert [visit["cell"] for visit in route["visits"]] == [
        list(visit.cell) for visit in expected.visits
    ]
    assert f"{1e3 * route['position_p95_m']:.2g}" in line


def test_route_that_is_not_localisable_ends_with_3(
    locatk, made: Path, drive: Path, between: Path
) -> None:
    result = locatk("map", "check", made, "--route", drive, "--route", between)
    assert result.exit_code == 3
    assert "route between is not localisable" in result.stderr
    assert "shift the route by" in result.stderr
    output = json.loads(locatk("map", "check", made, "--route", between, "--json").stdout)
    assert output["routes"][0]["position_p95_m"] is None
    assert output["routes"][0]["warnings"]


def test_accuracy_is_compared_with_the_route(locatk, made: Path, drive: Path) -> None:
    command = "map", "check", made, "--route", drive, "--accuracy"
    assert locatk(*command, "50,5").exit_code == 0
    result = locatk(*command, "1")
    assert result.exit_code == 3
    assert "position error of up to" in result.stderr


def test_conditions_change_the_prediction(locatk, made: Path, drive: Path) -> None:
    def p95_m(*options: str) -> float:
        result = locatk("map", "check", made, "--route", drive, "--json", *options)
        return json.loads(result.stdout)["routes"][0]["position_p95_m"]

    usual = p95_m()
    assert p95_m("--offline") < 0.8 * usual
    assert p95_m("--drift", "10", "--slip", "5") > 1.1 * usual
    assert p95_m("--installation", "0.3,0.1") < 0.8 * usual
    assert p95_m("--iron", "0.5") > 1.05 * usual


@pytest.mark.slow
def test_picture_is_written_once(locatk, made: Path, drive: Path) -> None:
    picture = made.with_suffix(".svg")
    command = "map", "check", made, "--route", drive, "-o", picture
    assert locatk(*command).exit_code == 0
    first = picture.read_bytes()
    assert locatk(*command).exit_code == 1
    assert locatk(*command, "--overwrite").exit_code == 0
    assert picture.read_bytes() == first


def test_picture_shows_routes_of_any_kind_with_words_inside(made: Path) -> None:
    floor = read_map(made)
    routes = [
        Route(np.array([[0, 0.2], [1.2, 0.2]]), "a $ name"),
        Route(np.array([[0, 0.1], [1.2, 0.1]]), "between"),
        Route(np.array([[-1.0, -1.0], [2.0, 2.0]]), "across"),
    ]
    checks = check_routes(floor, routes)
    for part in (checks, checks[1:2]):
        figure: Figure = draw_routes(floor, part)
        figure.draw_without_rendering()
        undrawn = set()
        for axes in [figure.axes[0], *figure.axes[0].child_axes, *figure.axes[1:]]:
            for axis in (axes.xaxis, axes.yaxis):
                low, high = sorted(axis.get_view_interval())
                ticks = [t for t in axis.get_major_ticks() if not low <= t.get_loc() <= high]
                undrawn.update(label for t in ticks for label in (t.label1, t.label2))
        texts = [
            each
            for each in figure.findobj(Text)
            if each.get_text() and each.get_visible() and each not in undrawn
        ]
        boxes = [each.get_window_extent().extents for each in texts]
        outside = [
            each.get_text()
            for each, (left, low, right, high) in zip(texts, boxes, strict=True)
            if min(left, low) < -1 or right > figure.bbox.x1 + 1 or high > figure.bbox.y1 + 1
        ]
        assert not outside
        words = {each.get_text() for each in texts}
        assert ("localised here" in words) == (part is checks)


@pytest.mark.parametrize(
    ("options", "text", "status"),
    [
        (["-o", "a.png"], "give --route as well", 2),
        (["--accuracy", "5"], "give --route as well", 2),
        (["--iron", "1"], "--iron is for routes: give --route as well", 2),
        (["--offline"], "--offline is for routes: give --route as well", 2),
        (["--route", "DRIVE", "--accuracy", "-5"], "numbers above 0", 2),
        (["--route", "missing.csv"], "missing.csv", 1),
        (["--route", "DRIVE", "-o", "a.gif"], "a.gif", 2),
    ],
)
def test_wrong_requests_are_refused(
    locatk, made: Path, drive: Path, options: list[str], text: str, status: int
) -> None:
    given = [str(drive) if option == "DRIVE" else option for option in options]
    result = locatk("map", "check", made, *given)
    assert (result.exit_code, result.stdout) == (status, "")
    assert text in result.stderr


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("x_mm,y_mm\n0,0\n", "one waypoint"),
        ("x_mm,y_mm\n0,0\n0,0\n", "equal"),
        ("x,y\n0,0\n1,1\n", "unit"),
        ("x_m,y_m\n0,0\n90000,1\n", "km"),
        ("heading\n0\n", "column"),
    ],
)
def test_bad_tables_are_one_line_with_a_hint(
    locatk, made: Path, tmp_path: Path, table: str, text: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(table)
    result = locatk("map", "check", made, "--route", path)
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")
    assert text in result.stderr or "bad.csv" in result.stderr
    assert "Traceback" not in result.stderr


def test_two_maps_with_a_route_are_refused(locatk, made: Path, drive: Path) -> None:
    result = locatk("map", "check", made, made, "--route", drive)
    assert result.exit_code == 2
    assert "one map" in result.stderr


# ---- map design --landmark --search


@pytest.fixture
def few_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    bar_search = "locatk.core.landmarks.design.bar_search"
    monkeypatch.setattr(f"{bar_search}.BARS_M", ((30e-3, 10e-3, 5e-3), (50e-3, 12e-3, 12e-3)))
    monkeypatch.setattr(f"{bar_search}.HEIGHTS_M", (12e-3,))
    monkeypatch.setattr(f"{bar_search}.SEARCH_ROUTES", 2)


@pytest.mark.usefixtures("few_bars")
@pytest.mark.slow
def test_search_lists_bars_and_heights(locatk) -> None:
    result = locatk("map", "design", "--landmark", "--search", "20,5")
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    (line,) = (each for each in lines if "30x10x5" in each)
    assert line.split()[1] == "12"
    assert "needs a" in result.stdout
    output = json.loads(locatk("map", "design", "--landmark", "--search", "20,5", "--json").stdout)
    assert [bool(each["heights_m"]) for each in output["bars"]] == [True, False]


@pytest.mark.usefixtures("few_bars")
@pytest.mark.slow
def test_search_without_result_says_what_is_possible(locatk) -> None:
    result = locatk("map", "design", "--landmark", "--search", "1")
    assert result.exit_code == 3
    assert "1 mm (95 %) is impossible at a pitch of 200 mm" in result.stderr
    assert "30x10x5" in result.stderr
    result = locatk("map", "design", "--landmark", "--search", "1", "--pitch", "120")
    assert result.exit_code == 3
    assert "the smallest pitch is" in result.stderr.replace("\n", " ")


def test_search_needs_landmark(locatk) -> None:
    result = locatk("map", "design", "--search", "5")
    assert result.exit_code == 2
    assert "give --landmark" in result.stderr
