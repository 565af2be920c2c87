"""Colors of reports: contrast in both modes, by WCAG 2.2, and a dark counterpart of each color."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly")

import locatk
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.formats.artifacts.maps import write_map
from locatk.formats.plots import shapes
from locatk.formats.report import theme
from locatk.formats.report.report import report_panels
from locatk.formats.report.style import SCRIPT, STYLE, TEMPLATE
from locatk.formats.report.subject import Subject, load_subject
from locatk.formats.simulation.landmarks import CONFIG, write_simulation

MIN_TEXT_CONTRAST, MIN_MARK_CONTRAST = 4.5, 3.0
"""WCAG 2.2, success criteria 1.4.3 and 1.4.11."""

MODES = ("light", "dark")
BACKGROUNDS = {"light": theme.CARD, "dark": theme.DARK_COLORS[theme.CARD]}


def channels(color: str) -> np.ndarray:
    """Red, green, blue and opacity of a color of CSS, from 0 to 1."""
    parts = re.fullmatch(r"rgba\((\d+),(\d+),(\d+),([\d.]+)\)", color)
    if parts:
        return np.array([*(int(parts[k]) / 255 for k in (1, 2, 3)), float(parts[4])])
    assert re.fullmatch("#[0-9A-Fa-f]{6}", color), color
    return np.array([*(int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)), 1.0])


def luminance(rgb: np.ndarray) -> float:
    """Relative luminance (WCAG 2.2)."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(color: str, background: str) -> float:
    """Contrast ratio (WCAG 2.2), of a translucent color as it appears on the background."""
    *rgb, opacity = channels(color)
    behind = channels(background)[:3]
    shown = opacity * np.array(rgb) + (1 - opacity) * behind
    low, high = sorted((luminance(shown), luminance(behind)))
    return (high + 0.05) / (low + 0.05)


def in_mode(color: str, mode: str) -> str:
    """A color of a diagram in a mode, as the script of the page replaces it."""
    if mode == "light":
        return color
    rgba = channels(color)
    key = "#" + "".join(f"{round(255 * c):02x}" for c in rgba[:3])
    dark = channels(theme.DARK_COLORS[key])
    red, green, blue = (round(255 * c) for c in dark[:3])
    return f"rgba({red},{green},{blue},{rgba[3]:g})"


def test_contrasts_are_those_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)
    assert contrast("#0000ff", "#ffffff") == pytest.approx(8.59, abs=0.005)
    assert contrast("rgba(0,0,0,0.5)", "#ffffff") == pytest.approx(
        contrast("#808080", "#ffffff"), abs=0.05
    )


@pytest.mark.parametrize("mode", MODES)
def test_devices_are_visible_and_distinct(mode: str) -> None:
    colors = [in_mode(color, mode) for color in shapes.COLORS]
    assert len(colors) == 21
    for color in colors:
        assert contrast(color, BACKGROUNDS[mode]) >= MIN_MARK_CONTRAST, color
    # Differences of 8-bit channels, weighted like the eye (Riemersma, compuphase.com/cmetric).
    for a, b in itertools.combinations(colors, 2):
        first, second = (255 * channels(color)[:3] for color in (a, b))
        mean_red, (red, green, blue) = (first[0] + second[0]) / 2, (first - second) ** 2
        distance = (2 + mean_red / 256) * red + 4 * green + (2 + (255 - mean_red) / 256) * blue
        assert np.sqrt(distance) > 50, (a, b)


@pytest.mark.parametrize("mode", MODES)
def test_sensors_and_shapes_are_visible(mode: str) -> None:
    styles = [each for each in vars(shapes).values() if isinstance(each, shapes.Style)]
    assert len(styles) >= 12
    for color in (*theme.SENSOR_SHADES, *(style.color for style in styles), theme.ALL_DEVICES):
        shown = in_mode(color, mode)
        assert contrast(shown, BACKGROUNDS[mode]) >= MIN_MARK_CONTRAST, color


@pytest.mark.parametrize("index", [0, 1], ids=MODES)
def test_text_of_the_page_is_readable(index: int) -> None:
    colors = {name: pair[index] for name, pair in theme.PAGE_COLORS.items()}
    for text, background in itertools.product(("ink", "muted", "link"), ("page", "card", "note")):
        assert contrast(colors[text], colors[background]) >= MIN_TEXT_CONTRAST, (text, background)
    for background in ("page", "card"):
        assert contrast(colors["control"], colors[background]) >= MIN_MARK_CONTRAST


def test_the_style_has_no_color_of_its_own() -> None:
    """Every color of the page is a variable, so that it changes with the mode."""
    media = "@media screen and (prefers-color-scheme: dark)"
    assert STYLE.count(media) == 1
    rules = STYLE[STYLE.index("* { box-sizing") :]
    assert re.findall(r"#[0-9a-f]{3,6}\b|rgba?\(", rules) == ["#fff"]  # Paper.
    used = set(re.findall(r"var\(--([a-z-]+)\)", rules))
    assert used == set(theme.PAGE_COLORS)
    light, dark = STYLE[: STYLE.index("* { box-sizing")].split(media)
    for name, pair in theme.CSS_COLORS.items():
        assert f"--{name}: {pair[0]};" in light
        assert f"--{name}: {pair[1]};" in dark
    assert not re.findall("#[0-9a-f]{6}", SCRIPT)


# ---- diagrams


def simulated(system: str, folder: Path) -> Subject:
    """A subject of a simulated session with truth."""
    if system == "landmarks":
        write_map(folder / "map.toml", design_map(DesignOptions(5, 5)))
        settings = CONFIG.merge({}, {"random.seed": 1})
        write_simulation(folder / "run.mcap", settings, folder / "map.toml")
    else:
        locatk.simulate(system, folder / "run.mcap", seed=1)
    locatk.solve(locatk.open(folder / "run.mcap")).save(folder / "solved.mcap")
    return load_subject(folder / "solved.mcap", session=folder / "run.mcap")


def colors_of(spec: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """Colors of a figure with their paths, as the script of the page finds them."""
    if isinstance(spec, dict):
        for key, value in spec.items():
            yield from colors_of(value, (*path, key))
    elif isinstance(spec, list):
        for value in spec:
            yield from colors_of(value, path)
    elif isinstance(spec, str) and path and "color" in path[-1]:
        yield path, spec


def figures(subject: Subject) -> list[dict[str, Any]]:
    """The figures of a subject as JSON, without the default template of plotly."""
    drawn = [json.loads(p.figure.to_json()) for p in report_panels(subject) if p.figure is not None]
    for each in drawn:
        each["layout"]["template"] = TEMPLATE
    return drawn


@pytest.mark.slow
@pytest.mark.parametrize("system", ["lighthouse", "dots", "polaris", "landmarks"])
def test_lines_marks_and_text_of_diagrams_are_visible(system: str, tmp_path: Path) -> None:
    drawn = figures(simulated(system, tmp_path))
    assert len(drawn) >= 6
    checked = 0
    for spec, mode in itertools.product(drawn, MODES):
        background = BACKGROUNDS[mode]
        for path, color in colors_of(spec):
            shown = in_mode(color, mode)  # Fails if a color has no counterpart.
            if "font" in path or "textfont" in path:
                assert contrast(shown, background) >= MIN_TEXT_CONTRAST, (path, color)
                checked += 1
            elif path[-1] in ("linecolor", "tickcolor"):
                assert contrast(shown, background) >= MIN_MARK_CONTRAST, (path, color)
        for trace in spec["data"]:
            if trace["type"] == "heatmap":
                continue
            line, marker = trace.get("line", {}), trace.get("marker", {})
            mode_of = trace.get("mode", "markers")
            if "lines" in mode_of and line.get("width", 2) > 0:
                shown = in_mode(line["color"], mode)
                assert contrast(shown, background) >= MIN_MARK_CONTRAST, trace["name"]
                checked += 1
            if "markers" in mode_of:
                parts = [marker["color"], marker.get("line", {}).get("color", marker["color"])]
                best = max(contrast(in_mode(part, mode), background) for part in parts)
                assert best >= MIN_MARK_CONTRAST, trace["name"]
                assert marker.get("opacity", 1) == 1
                checked += 1
        for shape in spec["layout"].get("shapes", []):
            if shape["line"]["width"]:
                shown = in_mode(shape["line"]["color"], mode)
                assert contrast(shown, background) >= MIN_MARK_CONTRAST
    assert checked > 40
