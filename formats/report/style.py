"""Look of a report: colors, fonts, the template of figures, and the script that draws them."""

from __future__ import annotations

from typing import Any

from locatk.formats.report.theme import CARD, CONTROL, CSS_COLORS, GRID, INK, TRANSPARENT

FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'

DEVICE_LEGEND_RANK = 100
"""Rank of devices in a legend, before everything else (the default of plotly is 1000)."""


def faded(color: str, opacity: float) -> str:
    """Return ``"#rrggbb"`` as a translucent color."""
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


_AXIS: dict[str, Any] = {
    "gridcolor": GRID,
    "linecolor": CONTROL,
    "tickcolor": CONTROL,
    "showline": True,
    "mirror": True,
    "ticks": "outside",
    "ticklen": 4,
    "zeroline": False,
    "automargin": True,
    "title": {"standoff": 8, "font": {"size": 13}},
}

TEMPLATE: dict[str, Any] = {
    "layout": {
        "font": {"family": FONT, "size": 13, "color": INK},
        "paper_bgcolor": TRANSPARENT,
        "plot_bgcolor": CARD,
        "margin": {"l": 56, "r": 12, "t": 12, "b": 44},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
        "hovermode": "closest",
        "hoverlabel": {"font": {"family": FONT, "size": 13}, "align": "left"},
        "legend": {
            "orientation": "h",
            "x": 0,
            "xanchor": "left",
            "y": 1.0,
            "yanchor": "bottom",
            "font": {"size": 12.5},
            "bgcolor": TRANSPARENT,
        },
        "modebar": {"bgcolor": faded(CARD, 0.7), "color": CONTROL, "activecolor": INK},
        # A figure that is drawn again in other colors keeps its view.
        "uirevision": "kept",
    }
}
"""Layout that all figures share; a page contains it once."""

CONFIG: dict[str, Any] = {
    "responsive": True,
    "displaylogo": False,
    "showSendToCloud": False,
    "showTips": False,
    "scrollZoom": False,
    "modeBarButtonsToRemove": ["select2d", "lasso2d", "autoScale2d"],
}

MAX_EAGER_FIGURES = 100
"""Number of figures up to which a page draws all of them; otherwise it draws those in sight."""

SCRIPT = """\
"use strict";
(function () {
  const shared = JSON.parse(document.getElementById("shared").textContent);
  const figures = Array.from(document.querySelectorAll(".figure"));
  // A finger on a figure scrolls the page.
  const touch = !window.matchMedia("(hover: hover)").matches;
  shared.config.displayModeBar = touch ? false : "hover";
  // Diagrams are made in light colors; dark ones replace them, but not on paper.
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  function darkened(color) {
    const parts = color.match(/^rgba\\((\\d+),(\\d+),(\\d+),([\\d.]+)\\)$/);
    const hex = (n) => Number(n).toString(16).padStart(2, "0");
    const key = parts ? "#" + parts.slice(1, 4).map(hex).join("") : color.toLowerCase();
    const other = shared.dark[key];
    if (!other || !parts) { return other || color; }
    const channels = [1, 3, 5].map((k) => parseInt(other.slice(k, k + 2), 16));
    return "rgba(" + channels.join(",") + "," + parts[4] + ")";
  }
  function copied(value, isDark, isColor) {
    if (Array.isArray(value)) { return value.map((each) => copied(each, isDark, isColor)); }
    if (value && typeof value === "object") {
      return Object.fromEntries(Object.entries(value).map(([key, each]) =>
        [key, copied(each, isDark, /color/.test(key) && typeof each !== "number")]));
    }
    return isDark && isColor && typeof value === "string" ? darkened(value) : value;
  }
  function paint(figure, isDark) {
    const spec = copied(figure.spec, isDark, false);
    spec.layout.template = copied(shared.template, isDark, false);
    return Plotly.react(figure, spec.data, spec.layout, shared.config);
  }
  function paintAll(isDark) {
    for (const figure of figures) { if (figure.spec) { paint(figure, isDark); } }
  }
  dark.addEventListener("change", function () { paintAll(dark.matches); });

  // One after another, so that the page can be read in the meantime, and first those in sight.
  // A page of many figures draws no others: all together would take minutes.
  const inSight = new Set(), waiting = new Set(figures);
  let isDrawing = false;
  function drawNext() {
    const all = figures.length <= shared.eager ? figures : [];
    const figure = figures.find((each) => waiting.has(each) && inSight.has(each)) ||
      all.find((each) => waiting.has(each));
    isDrawing = Boolean(figure);
    if (figure) {
      draw(figure).then(function () { setTimeout(drawNext, 0); });
    } else {
      document.documentElement.dataset.drawn = String(figures.length - waiting.size);
    }
  }
  function draw(figure) {
    waiting.delete(figure);
    const spec = JSON.parse(document.getElementById(figure.id + "-data").textContent);
    if (touch) { spec.layout.dragmode = false; }
    if (figure.clientWidth < 600) { narrow(figure, spec); }
    figure.spec = spec;
    return paint(figure, dark.matches);
  }
  const observer = new IntersectionObserver(function (entries) {
    for (const entry of entries) {
      inSight[entry.isIntersecting ? "add" : "delete"](entry.target);
    }
    if (!isDrawing) { drawNext(); }
  }, {rootMargin: "50% 0px"});
  figures.forEach((figure) => observer.observe(figure));
  // In a narrow window legends move above the figure, and maps become lower.
  function narrow(figure, spec) {
    const legend = spec.layout.legend || {};
    if (legend.orientation === "v") {
      spec.layout.legend = {traceorder: legend.traceorder};
    }
    const named = spec.data.filter(function (trace) {
      return trace.name && trace.showlegend !== false && spec.layout.showlegend !== false;
    });
    const longest = named.reduce((most, trace) => Math.max(most, trace.name.length), 0);
    const width = figure.clientWidth - 70;
    const columns = Math.max(1, Math.floor(width / (46 + 7 * longest)));
    const rows = named.length > 1 ? Math.ceil(named.length / columns) : 0;
    let height = figure.clientHeight + 19 * Math.max(0, rows - 1);
    const x = spec.layout.xaxis, y = spec.layout.yaxis;
    if (y && y.scaleanchor && x.range && y.range) {
      const shape = (y.range[1] - y.range[0]) / (x.range[1] - x.range[0]);
      height = Math.min(height, Math.max(140, width * shape) + 70 + 19 * rows);
    }
    // Titles of diagrams are between them and the legend.
    const titled = (spec.layout.annotations || []).some(function (words) {
      return words.yref === "paper" && words.y > 0.99 && words.yanchor === "bottom";
    });
    if (titled) {
      spec.layout.legend = Object.assign({}, spec.layout.legend, {y: 1 + 22 / height});
      height += 22;
    }
    figure.style.height = Math.round(height) + "px";
  }
  // Paper is narrower than most windows.
  function fit(width) {
    for (const figure of figures) {
      if (!figure.layout) { continue; }
      const square = figure.layout.yaxis && figure.layout.yaxis.scaleanchor;
      const height = figure.dataset.height || figure.style.height;
      figure.dataset.height = height;
      const low = Math.min(parseFloat(height), 0.72 * width) + "px";
      figure.style.height = width && square ? low : height;
      const size = width ? {width: width, height: parseFloat(figure.style.height)}
        : {width: null, height: null};
      Plotly.relayout(figure, Object.assign(size, {autosize: width === null}));
    }
  }
  window.addEventListener("beforeprint", function () {
    waiting.forEach(draw);
    if (dark.matches) { paintAll(false); }
    fit(690);
  });
  window.addEventListener("afterprint", function () {
    if (dark.matches) { paintAll(true); }
    fit(null);
  });

  // Headers of the overview sort it; numbers with units by their size.
  const scales = {"m": 1, "cm": 1e-2, "mm": 1e-3, "\u00b5m": 1e-6, "um": 1e-6};
  function value(cell) {
    const words = cell.textContent.replace(/\u202f|\u00a0/g, "").trim().split(" ");
    const number = parseFloat(words[0].replace("\u2212", "-"));
    return number * (scales[words[1]] || 1);
  }
  for (const table of document.querySelectorAll(".sortable table")) {
    const body = table.tBodies[0];
    const headers = Array.from(table.tHead.rows[0].cells);
    headers.forEach(function (header, column) {
      const button = document.createElement("button");
      button.textContent = header.textContent;
      header.textContent = "";
      header.appendChild(button);
      button.addEventListener("click", function () {
        const falling = header.getAttribute("aria-sort") === "ascending";
        for (const other of headers) { other.removeAttribute("aria-sort"); }
        header.setAttribute("aria-sort", falling ? "descending" : "ascending");
        const rows = Array.from(body.rows);
        const order = new Intl.Collator(undefined, {numeric: true});
        rows.sort(function (a, b) {
          const x = value(a.cells[column]), y = value(b.cells[column]);
          if (isNaN(x) || isNaN(y) || column === 0) {
            if (column && isNaN(x) !== isNaN(y)) { return isNaN(x) ? 1 : -1; }
            return (falling ? -1 : 1) *
              order.compare(a.cells[column].textContent, b.cells[column].textContent);
          }
          return (falling ? -1 : 1) * (x - y);
        });
        body.append(...rows);
      });
    });
  }

  for (const button of document.querySelectorAll("button.copy")) {
    button.hidden = false;
    button.addEventListener("click", function () {
      const text = document.getElementById(button.dataset.of);
      window.getSelection().selectAllChildren(text);
      document.execCommand("copy");
      button.textContent = "Copied";
    });
  }
})();
"""


def _variables(index: int) -> str:
    """Return the variables of CSS for the light colors (0) or the dark ones (1)."""
    return " ".join(f"--{name}: {colors[index]};" for name, colors in CSS_COLORS.items())


STYLE = (
    f":root {{ color-scheme: light; {_variables(0)} }}\n"
    "@media screen and (prefers-color-scheme: dark) {\n"
    f"  :root {{ color-scheme: dark; {_variables(1)} }}\n"
    "}\n"
    """\
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-behavior: smooth; }
body {
  margin: 0; background: var(--page); color: var(--ink); line-height: 1.5; font-size: 16px;
  font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
main, body > header, body > footer { max-width: 1080px; margin: 0 auto; padding: 0 20px; }
body > header { padding-top: 28px; }
body > header .brand {
  font-size: 13px; letter-spacing: .06em; text-transform: uppercase; color: var(--muted); margin: 0;
}
h1 { font-size: 30px; line-height: 1.2; margin: 2px 0 10px; overflow-wrap: anywhere; }
h2 { font-size: 25px; line-height: 1.25; margin: 44px 0 4px; overflow-wrap: anywhere; }
h3 { font-size: 18px; line-height: 1.3; margin: 0 0 2px; }
p { margin: 0 0 10px; }
a { color: var(--link); }
.sub { color: var(--muted); margin: 0 0 14px; overflow-wrap: anywhere; }
.verdict { font-size: 18px; margin: 0 0 14px; max-width: 60em; }
.tiles {
  display: flex; flex-wrap: wrap; gap: 10px; margin: 0 0 16px;
}
.tile {
  flex: 1 1 116px; padding: 8px 11px 9px;
  background: var(--card); border: 1px solid var(--frame); border-radius: 8px;
}
.tile b {
  display: block; font-size: 19px; white-space: nowrap; line-height: 1.25; font-weight: 600;
}
.tile span { font-size: 13px; color: var(--muted); display: block; line-height: 1.35; }
.notes {
  background: var(--note); border: 1px solid var(--note-frame); border-radius: 8px;
  padding: 10px 16px; margin: 0 0 16px;
}
.notes ul { margin: 2px 0 0; padding-left: 20px; }
.notes li { overflow-wrap: anywhere; }
.panel {
  background: var(--card); border: 1px solid var(--frame); border-radius: 8px;
  padding: 14px 18px 12px; margin: 0 0 16px;
}
.panel > p { color: var(--muted); font-size: 14.5px; max-width: 68em; }
.wide { overflow-x: auto; overflow-y: hidden; }
.figure { width: 100%; margin-top: 4px; }
.table { overflow-x: auto; margin: 6px 0 4px; }
table { border-collapse: collapse; font-size: 14.5px; font-variant-numeric: tabular-nums; }
th {
  text-align: left; font-weight: 600; color: var(--muted); border-bottom: 1px solid var(--rule);
  white-space: nowrap;
}
th, td { padding: 4px 18px 4px 0; vertical-align: top; }
td { border-bottom: 1px solid var(--grid); overflow-wrap: anywhere; min-width: 15em; }
td.short { white-space: nowrap; min-width: 0; }
tr:last-child td { border-bottom: 0; }
th.number, td.number { text-align: right; white-space: nowrap; min-width: 0; }
pre {
  background: var(--page); border: 1px solid var(--frame); border-radius: 6px; padding: 9px 12px;
  margin: 6px 0 10px; font-size: 14px; white-space: pre-wrap; overflow-wrap: anywhere;
  font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, monospace;
}
.command { display: flex; gap: 10px; align-items: flex-start; }
.command pre { flex: 1; }
button.copy {
  margin-top: 8px; font: inherit; font-size: 14px; padding: 5px 12px; border-radius: 6px;
  border: 1px solid var(--control); background: var(--card); color: var(--ink); cursor: pointer;
}
.sortable table { font-size: 13.5px; margin-bottom: 14px; }
.sortable th, .sortable td { padding-right: 9px; }
.sortable th button {
  font: inherit; color: inherit; background: none; border: 0; padding: 0; cursor: pointer;
}
.sortable th[aria-sort=ascending] button::after { content: " \u25b2"; }
.sortable th[aria-sort=descending] button::after { content: " \u25bc"; }
.back { float: right; margin: -26px 0 0; font-size: 14.5px; }
.maps {
  display: grid; grid-template-columns: repeat(auto-fill, minmax(170px, 1fr)); gap: 10px;
}
.maps a {
  display: block; padding: 8px 10px; overflow-wrap: anywhere; color: inherit;
  text-decoration: none; font-size: 13px; line-height: 1.35; break-inside: avoid;
  background: var(--card); border: 1px solid var(--frame); border-radius: 8px;
}
.maps a:hover, .maps a:focus-visible { border-color: var(--link); }
.maps a b { display: block; color: var(--link); font-weight: 600; }
.maps a span { color: var(--muted); }
.maps > a > svg { display: block; width: 100%; margin-bottom: 4px; }
.maps svg { fill: none; }
.maps svg path { stroke-linecap: round; stroke-linejoin: round; }
.maps .path { stroke-width: 1.6; }
.maps .artifact { stroke: var(--control); }
.maps .dots { stroke: var(--control); stroke-width: 3; }
.maps .station { stroke: var(--ink); stroke-width: 6; }
.maps .bar { stroke: var(--ink); stroke-width: 1.5; stroke-linecap: butt; }
.maps text { fill: var(--muted); font-size: 12px; }
.pictures { display: flex; flex-wrap: wrap; gap: 14px; margin-top: 8px; }
.pictures figure { margin: 0; flex: 1 1 220px; max-width: 480px; }
.pictures img { width: 100%; height: auto; border: 1px solid var(--frame); display: block; }
.pictures figcaption { font-size: 13.5px; color: var(--muted); }
body > footer { color: var(--muted); font-size: 13.5px; padding-top: 8px; padding-bottom: 36px; }
@media (max-width: 600px) {
  main, body > header, body > footer { padding-left: 10px; padding-right: 10px; }
  .panel { padding: 12px 10px 8px; }
  .tile { flex-basis: 40%; }
  .tile { padding: 8px 10px; }
  td { min-width: 13em; }
  h1 { font-size: 24px; } h2 { font-size: 21px; }
}
@media (prefers-reduced-motion: reduce) { html { scroll-behavior: auto; } }
@media print {
  @page { margin: 12mm; }
  body { background: #fff; font-size: 11pt; }
  main, body > header, body > footer { max-width: none; padding: 0; }
  .panel, .tile, .notes { break-inside: avoid; }
  .panel { border: 0; padding: 6px 0; }
  h2 { break-after: avoid; }
  .subject + .subject { break-before: page; }
  .table, .wide { overflow: visible; }
  table { font-size: 9pt; }
  th, td { padding-right: 10px; }
  button.copy, .modebar, .back { display: none !important; }
}
"""
)
