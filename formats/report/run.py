"""Facts of a run in tables: files, versions, facts of the solver, and the artifact."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from locatk.core.dots.sheet import Manifest
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris.tag import Tags
from locatk.core.solution import Solution, to_json
from locatk.formats.descriptions import dots, landmarks, polaris
from locatk.formats.plots.series import pose_span_ns
from locatk.formats.plots.units import format_number, format_time
from locatk.formats.report.panels import Panel, Table
from locatk.formats.report.subject import Subject

MAX_ROWS = 60
"""Number of rows of a table of facts; the rest is counted."""

MAX_CHARACTERS = 160
"""Length of a value that is shown."""

MAX_LISTED_DEVICES = 12
"""Number of devices whose poses are listed."""

MAX_LISTED_VALUES, MAX_LISTED_RECORDS = 12, 3
"""Number of elements up to which a list of values, and a list of records, is shown; longer lists
are for programs."""

HIDDEN_FACTS = (
    "kind",
    "system",
    "method",
    "source",
    "tool_version",
    "format_version",
    "command",
    "options_sha256",
)
"""Metadata that are shown in other rows or are for programs."""

UNITS = {
    "m": "m", "mm": "mm", "um": "\u00b5m", "s": "s", "ms": "ms", "hz": "Hz", "mps": "m/s",
    "rad": "rad", "mrad": "mrad", "deg": "\u00b0", "t": "T", "mt": "mT", "ut": "\u00b5T",
    "am2": "A m\u00b2", "px": "px", "ppm": "ppm", "percent": "%",
}  # fmt: skip
"""Unit by the last part of a key, as in ``speed_mps``."""


def run_panels(subject: Subject) -> list[Panel]:
    """Return tables of the run, of the facts of the solver, and of the artifact."""
    panels = [Panel("Run", table=Table(("", ""), _run_rows(subject)))]
    facts = list(_flatten(to_json(subject.solution.facts) or {}))
    if facts:
        panels.append(Panel("Facts of the solver", table=_table(facts)))
    artifact = list(_flatten(_describe_artifact(subject.solution)))
    if artifact:
        note = "Given to the solver or estimated by it."
        panels.append(Panel("Artifact", note, table=_table(artifact)))
    return panels


def _run_rows(subject: Subject) -> list[tuple[str, str]]:
    solution, facts = subject.solution, subject.facts
    rows = [("solution", subject.name)]
    source = facts.get("source")
    if source:
        rows.append(("session", source + ("" if subject.session else " (not available)")))
    rows += [("system", solution.system), ("method", solution.method)]
    span_ns = pose_span_ns(solution)
    if span_ns is not None:
        rows.append(("first pose", format_time(span_ns[0])))
        rows.append(("duration", f"{(span_ns[1] - span_ns[0]) * 1e-9:.1f} s"))
    shown = solution.trajectories[:MAX_LISTED_DEVICES]
    poses = ", ".join(f"{t.device} ({len(t)} in {t.frame})" for t in shown)
    omitted = len(solution.trajectories) - len(shown)
    rows.append(("poses", (poses or "none") + (f" and {omitted} more" if omitted else "")))
    if "tool_version" in facts:
        rows.append(("solved by", f"locatk {facts['tool_version']}"))
    return rows + [
        (_key_text(key), _truncate(value))
        for key, value in facts.items()
        if key not in HIDDEN_FACTS
    ]


def _describe_artifact(solution: Solution) -> dict[str, Any]:
    """Return facts of the artifact, empty if there is none."""
    match solution.artifact:
        case Scene() as scene:
            return _describe_scene(scene)
        case Manifest() as manifest:
            return dots.describe_manifest(manifest)
        case Tags() as tags:
            return polaris.describe_tags(tags)
        case FloorMap() as floor:
            return landmarks.describe_map(floor)
    return {}


def _describe_scene(scene: Scene) -> dict[str, Any]:
    facts: dict[str, Any] = {"scale": scene.scale, "planar": scene.planar, "frame": scene.frame}
    for station in scene.stations:
        position = ", ".join(format_number(float(value)) for value in station.position)
        facts[f"station on channel {station.channel}"] = {
            "position" if scene.scale == "unit" else "position_m": position,
            "calibration": station.calibration.source,
            "id": None if station.id is None else f"{station.id:08x}",
        }
    for marker in scene.markers:
        position = ", ".join(format_number(float(value)) for value in marker.position)
        facts[f"marker {marker.name}"] = f"{position} m"
    return facts


def _table(rows: list[tuple[str, str]]) -> Table:
    shown = rows[:MAX_ROWS]
    if len(rows) > MAX_ROWS:
        shown.append(("...", f"and {len(rows) - MAX_ROWS} more"))
    return Table(("", ""), shown)


def _flatten(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield rows of nested facts; long lists and unknown values are omitted."""
    for key, value in facts.items():
        name = f"{prefix}{_key_text(str(key))}"
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{name}: ")
        elif isinstance(value, list | tuple):
            yield from _flatten_list(name, value)
        elif value is not None:
            yield name, _truncate(_value_text(value))


def _flatten_list(name: str, values: Sequence[Any]) -> Iterator[tuple[str, str]]:
    is_nested = any(isinstance(value, Mapping | list | tuple) for value in values)
    if is_nested and len(values) <= MAX_LISTED_RECORDS:
        for k, value in enumerate(values, start=1):
            yield from _flatten({str(k): value}, f"{name} ")
    elif values and not is_nested and len(values) <= MAX_LISTED_VALUES:
        yield name, _truncate(", ".join(_value_text(value) for value in values))


def _value_text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value is None else str(value)


def _key_text(key: str) -> str:
    """Return a key in words with its unit in brackets."""
    name, _, unit = key.rpartition("_")
    if name and unit in UNITS:
        return f"{name.replace('_', ' ')} [{UNITS[unit]}]"
    return key.replace("_", " ")


def _truncate(text: str) -> str:
    return text if len(text) <= MAX_CHARACTERS else text[: MAX_CHARACTERS - 4] + " ..."
