"""Colors of a report in light and dark mode.

The page uses them as variables of CSS, which follow ``prefers-color-scheme``. Diagrams are made in
the light colors; in dark mode, the script of the page replaces each by its counterpart in
:data:`DARK_COLORS` before plotly draws them. Paper and pictures are always light.

Text has a contrast of at least 4.5 to 1, lines and marks of diagrams at least 3 to 1 against the
card that they are on (WCAG 2.2, success criteria 1.4.3 and 1.4.11), in both modes; only grids,
rules, frames of boxes and shaded areas have less, because nothing depends on them.
"""

from __future__ import annotations

from plotly.colors import sample_colorscale

from locatk.formats.plots import shapes

PAGE_COLORS = {
    "page": ("#f3f5f7", "#0f1419"),
    "card": ("#ffffff", "#161c23"),
    "ink": ("#1d2733", "#e6ebf0"),
    "muted": ("#5b6875", "#a3b0bc"),
    "link": ("#0060a0", "#6cb8f0"),
    "control": ("#7d8a97", "#7f8d9b"),
    "frame": ("#d5dbe1", "#303a44"),
    "rule": ("#b9c3cc", "#47525d"),
    "grid": ("#e9edf1", "#28313a"),
    "note": ("#fff8e6", "#2b2512"),
    "note-frame": ("#ecd9a0", "#5c4d1c"),
}
"""Light and dark color by the name of its variable in CSS."""

CARD, INK, MUTED, CONTROL, GRID = (
    PAGE_COLORS[name][0] for name in ("card", "ink", "muted", "control", "grid")
)
"""Background, text, text of minor importance, axes and ticks, and grid lines, in light mode."""

TRANSPARENT = "rgba(0,0,0,0)"

ALL_DEVICES = "#76848f"
"""Color of more devices than a legend names."""

UNSOLVED_DEVICE = MUTED
"""Color of a device in the evaluation that is not in the solution."""

FIELD_SCALE = [[0.0, CARD], [1.0, "#000000"]]
"""Color scale of magnitudes; zero has the background of a card."""

DARK_DEVICE_COLORS = (
    "#4BA3E3", "#F07A2B", "#1DB386", "#DB8FBC", "#9AD8FB", "#F5C242", "#B06FCB",
    "#507D81", "#6462FF", "#E71035", "#C9ACFF", "#BB33CE", "#35FFBD", "#9CCD98",
    "#9E85A1", "#E0BBCF", "#6F6DA7", "#CC4279", "#BB7F5A", "#EC6CFF", "#D7E5FF",
)  # fmt: skip
"""Counterparts of :data:`locatk.formats.plots.shapes.COLORS`, of similar hues, chosen like them."""

CSS_COLORS = PAGE_COLORS | {
    f"device-{k}": colors
    for k, colors in enumerate(zip(shapes.COLORS, DARK_DEVICE_COLORS, strict=True))
}
"""Light and dark color of all variables of CSS."""

SENSOR_SHADE_COUNT = 32
"""Number of shades of sensors in a row; more sensors share shades."""


def _sensor_shades(anchors: tuple[str, ...]) -> tuple[str, ...]:
    """Return shades between the anchors (``"#rrggbb"``)."""
    positions = [k / (SENSOR_SHADE_COUNT - 1) for k in range(SENSOR_SHADE_COUNT)]
    channels = sample_colorscale(list(anchors), positions, colortype="tuple")
    return tuple("#" + "".join(f"{round(255 * c):02x}" for c in shade) for shade in channels)


SENSOR_SHADES, _DARK_SENSOR_SHADES = (
    _sensor_shades(("#440154", "#3b528b", "#21858c", "#4c8c2b", "#8a7a00")),
    _sensor_shades(("#b07cff", "#6e9bf0", "#35b8b0", "#8fd14f", "#fde725")),
)
"""Shades of the sensors of a bar from one end to the other: the order of hues of Viridis, with
lightnesses that are visible on the background."""

DARK_COLORS = {
    light.lower(): dark.lower()
    for light, dark in (
        *PAGE_COLORS.values(),
        *zip(shapes.COLORS, DARK_DEVICE_COLORS, strict=True),
        *zip(SENSOR_SHADES, _DARK_SENSOR_SHADES, strict=True),
        (ALL_DEVICES, "#8896a3"),
        ("#000000", "#ffffff"),
        (shapes.TRUTH.color, "#8f979f"),
        (shapes.PAPER.color, "#8f979f"),
        (shapes.PAPER.fill, "#24221b"),
        (shapes.DOT_PATTERN.fill, "#9aa4ae"),
        (shapes.MAGNET.color, "#d0d7de"),
        (shapes.NORTH_POLE.color, "#f0685a"),
        (shapes.SOUTH_POLE.color, "#8fa8c8"),
        (shapes.WALL.color, "#b4bcc4"),
    )
}
"""Dark counterpart of each color of a diagram, in lowercase."""
