"""Beginning of pages on several solutions: links, small maps and their scales."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly")

from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.lighthouse.scene import Marker, Scene
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.report.overview import MAP_HEIGHT_PX, MAP_WIDTH_PX, overview
from locatk.formats.report.report import render_report
from locatk.formats.report.subject import Subject

EVIL = "</a><script>alert(1)</script>"


@pytest.fixture(autouse=True)
def _short_script(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave plotly.js, which is 5 MB, out of the pages."""
    monkeypatch.setattr("locatk.formats.report.page.get_plotlyjs", lambda: "// plotly.js")


def track(position: Any, device: str = "red", frame: str = "floor") -> Trajectory:
    """A trajectory through positions (n, 2), a tenth of a second apart."""
    position = np.column_stack([position, np.zeros(len(position))])
    return Trajectory.from_positions(device, frame, 10**8 * np.arange(len(position)), position)


def circle(radius_m: float, n: int = 400) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, n)
    return radius_m * np.column_stack([np.cos(angle), np.sin(angle)])


def subject(name: str, *tracks: Trajectory, system: str = "lighthouse", **more: Any) -> Subject:
    scene = Scene(planar=True, scale="markers")
    return Subject(name, Solution(system, "bundle", tracks, **{"artifact": scene, **more}))


def maps(html: str) -> list[str]:
    """The small maps of a page."""
    return re.findall(r'<a href="#s\d+"><svg.*?</a>', html, re.S)


def points(drawn: str, kind: str = "path") -> list[np.ndarray]:
    """Points (n, 2) of the paths of a class, in pixels, with interruptions as separate lines."""
    lines = []
    for path in re.findall(rf'<path class="{kind}"[^>]* d="([^"]*)"', drawn):
        for part in path.removeprefix("M").split("M"):
            numbers = re.findall(r"[\d.e+-]+", part.replace("h0", ""))
            lines.append(np.array(numbers, float).reshape(-1, 2))
    return lines


def pixels_per_m(drawn: str) -> float:
    """Scale of a map by its scale bar."""
    (bar,) = re.findall(r'class="bar" d="M1 \d+v4h([\d.]+)v-4"', drawn)
    value, unit = re.search(r"<text[^>]*>(\S+) (\S+)</text>", drawn).groups()  # type: ignore[union-attr]
    return float(bar) / (float(value) * {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "unit": 1.0}[unit])


def test_rows_and_maps_lead_to_the_parts_of_their_solutions() -> None:
    names = [f"run-{k}.mcap" for k in range(1, 4)]
    page = render_report([subject(name, track(circle(1.0))) for name in names])
    ids = Counter(re.findall(r' id="([^"]+)"', page))
    assert max(ids.values()) == 1
    title_of = dict(re.findall(r'<article class="subject" id="(s\d+)">\s*<h2>(.*?)</h2>', page))
    assert list(title_of.values()) == names
    rows = re.findall(r'<td class="short"><a href="#(.*?)">(.*?)</a>', page)
    of_maps = re.findall(r'<a href="#(s\d+)"><svg.*?<b>(.*?)</b>', page, re.S)
    for links in (rows, of_maps):
        assert [name for _, name in links] == names
        assert all(title_of[target] == name for target, name in links)
    assert page.count('<a href="#overview">') == 3
    assert ids["overview"] == 1


def test_a_page_on_one_solution_has_no_overview() -> None:
    page = render_report([subject("run.mcap", track(circle(1.0)))])
    assert 'class="maps"' not in page
    assert "#overview" not in page


def test_a_map_is_to_scale_and_upright() -> None:
    corner = track([(0.0, 0.0), (3.0, 0.0), (3.0, 1.5)])
    (drawn,) = maps(overview([subject("run", corner)]))
    (line,) = points(drawn)
    scale = pixels_per_m(drawn)
    np.testing.assert_allclose((line[1] - line[0]) / scale, [3.0, 0.0], atol=0.01)
    np.testing.assert_allclose((line[2] - line[1]) / scale, [0.0, -1.5], atol=0.01)  # y is down
    assert (line >= 0).all()
    assert (line <= [MAP_WIDTH_PX, MAP_HEIGHT_PX]).all()
    # The trajectory fills the map.
    assert np.ptp(line, axis=0).max() > 0.7 * MAP_HEIGHT_PX


@pytest.mark.parametrize(("radius_m", "is_shared"), [(1.0, True), (2.5, True), (8.0, False)])
def test_maps_of_similar_size_share_a_scale(radius_m: float, is_shared: bool) -> None:
    html = overview(
        [
            subject("small", track(circle(1.0))),
            subject("large", track(circle(radius_m))),
            subject("other", track(circle(40.0)), system="polaris", artifact=None),
        ]
    )
    first, second, third = (pixels_per_m(drawn) for drawn in maps(html))
    assert (first == pytest.approx(second, rel=0.01)) == is_shared
    assert third < 0.1 * first
    assert ("All maps of a system have the same scale: lighthouse." in html) == is_shared
    for drawn, size_m in zip(maps(html), (2.0, 2 * radius_m, 80.0), strict=True):
        size_px = np.ptp(np.vstack(points(drawn)), axis=0)
        np.testing.assert_allclose(size_px / pixels_per_m(drawn), size_m, rtol=0.03)


def test_a_scene_without_scale_shares_none_with_metres() -> None:
    unscaled = Scene(planar=True, scale="unit")
    html = overview(
        [
            subject("a", track(circle(1.0))),
            subject("b", track(circle(1.0)), artifact=unscaled),
        ]
    )
    assert "have the same scale" not in html
    assert re.search(r"<text[^>]*>1 unit</text>|<text[^>]*>0.5 unit</text>", html)


def test_paths_are_interrupted_at_gaps_and_devices_have_their_colors() -> None:
    gap = track(circle(1.0))
    gap.time_ns[200:] += 10**10
    html = overview([subject("run", gap, track(circle(0.5), "blue"))])
    colors = re.findall(r'class="path" style="stroke:var\(--(device-\d+)\)"', html)
    assert colors == ["device-0", "device-1"]
    assert len(points(html)) == 3


def test_sheets_are_outlines_and_markers_are_dots() -> None:
    sheet = Sheet("a", (0, 0), (800, 560), (0, 0), (420.0, 297.0), (5.0, 5.0))
    dots = subject(
        "dots",
        track([(0.1, 0.1), (0.2, 0.2)], frame="a"),
        system="dots",
        artifact=Manifest((sheet,)),
    )
    (drawn,) = maps(overview([dots]))
    paper, pattern = points(drawn, "artifact")
    np.testing.assert_allclose(
        np.ptp(paper, axis=0) / pixels_per_m(drawn), [0.420, 0.297], rtol=0.02
    )
    assert (np.ptp(pattern, axis=0) < np.ptp(paper, axis=0)).all()
    markers = tuple(Marker(name, np.array([x, 0.5, 0.0])) for name, x in (("a", -0.5), ("b", 0.5)))
    scene = Scene(planar=True, scale="markers", markers=markers)
    (drawn,) = maps(overview([subject("run", track(circle(1.0)), artifact=scene)]))
    first, second = np.vstack(points(drawn, "dots"))
    assert (second - first) / pixels_per_m(drawn) == pytest.approx([1.0, 0.0], abs=0.03)


@pytest.mark.parametrize("n", [0, 1])
def test_few_poses_have_a_map(n: int) -> None:
    (drawn,) = maps(overview([subject("run", track(np.zeros((n, 2))))]))
    assert "nan" not in drawn
    (empty,) = maps(overview([subject("run")]))
    assert "0 poses" in empty


def test_of_several_frames_the_one_with_most_poses_is_drawn() -> None:
    tracks = (track(circle(1.0, 50), "a", "first"), track(circle(3.0, 90), "b", "second"))
    (drawn,) = maps(overview([subject("run", *tracks, system="dots", artifact=None)]))
    (line,) = points(drawn)
    assert np.ptp(line[:, 0]) / pixels_per_m(drawn) == pytest.approx(6.0, rel=0.03)
    assert "1 of 2 frames" in drawn


def test_names_are_escaped() -> None:
    html = overview([subject(EVIL, track(circle(1.0), EVIL))])
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_maps_of_long_runs_of_many_devices_are_small() -> None:
    rng = np.random.default_rng(1)
    tracks = [track(circle(1.0, 3000) + rng.standard_normal((3000, 2)), f"r{k}") for k in range(20)]
    (drawn,) = maps(overview([subject("run", *tracks)]))
    assert len(drawn) < 10_000
