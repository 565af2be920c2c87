"""Facts of a run: its files, versions, the command that made it, and what the solver tells."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from locatk.core.dots.sheet import Manifest
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris.tag import Tags
from locatk.core.solution import Solution, to_json
from locatk.formats.plots.time_axis import span, when
from locatk.formats.plots.units import digits
from locatk.formats.report.panel import Panel, Table
from locatk.formats.report.subject import Subject
from locatk.formats.sessions import description as describe

MOST_ROWS = 60
"""Of a table of facts; the rest is counted."""

LONGEST = 160
"""Characters of a fact that are shown."""

_KNOWN = ("kind", "system", "method", "source", "tool_version", "format_version", "command")
_FOR_PROGRAMS = ("options_sha256",)

_UNITS = {
    "m": "m", "mm": "mm", "um": "\u00b5m", "s": "s", "ms": "ms", "hz": "Hz", "mps": "m/s",
    "rad": "rad", "mrad": "mrad", "deg": "\u00b0", "t": "T", "mt": "mT", "ut": "\u00b5T",
    "am2": "A m\u00b2", "px": "px", "ppm": "ppm", "percent": "%",
}  # fmt: skip
"""By what follows the last underscore of a key."""


def run_panels(subject: Subject) -> list[Panel]:
    """Tables of the run, of what the solver tells, and of the artifact."""
    panels = [Panel("The run", table=Table(("", ""), _run(subject)))]
    told = list(_flat(to_json(subject.solution.facts) or {}))
    if told:
        panels.append(Panel("What the solver tells", table=_table(told)))
    found = artifact(subject.solution)
    if found:
        note = "On which the poses stand, as it was given or solved."
        panels.append(Panel("Artifact", note, table=_table(list(_flat(found)))))
    return panels


def _run(subject: Subject) -> list[tuple[str, str]]:
    solution, facts = subject.solution, subject.facts
    rows = [("solution", subject.name)]
    source = facts.get("source")
    if source:
        here = "" if subject.session is not None else " (not at hand)"
        rows.append(("session", source + here))
    rows += [("system", solution.system), ("method", solution.method)]
    times = span(solution)
    if times is not None:
        rows.append(("first pose", when(times[0])))
        rows.append(("duration", f"{(times[1] - times[0]) * 1e-9:.1f} s"))
    names = ", ".join(f"{t.device} ({len(t)} in {t.frame})" for t in solution.trajectories[:12])
    if len(solution.trajectories) > 12:
        names += f" and {len(solution.trajectories) - 12} more"
    rows.append(("poses", names or "none"))
    if "tool_version" in facts:
        rows.append(("solved by", f"locatk {facts['tool_version']}"))
    left_out = _KNOWN + _FOR_PROGRAMS
    rows += [(_words(key), _cut(value)) for key, value in facts.items() if key not in left_out]
    return rows


_TELL: Sequence[tuple[type, Callable[[Any], dict[str, Any]]]] = (
    (Manifest, describe.manifest),
    (Tags, describe.tags),
    (FloorMap, describe.floor),
)


def artifact(solution: Solution) -> dict[str, Any]:
    """What is to say of the artifact; empty where there is none."""
    found = solution.artifact
    if isinstance(found, Scene):
        return _scene(found)
    for kind, tell in _TELL:
        if isinstance(found, kind):
            return tell(found)
    return {}


def _scene(scene: Scene) -> dict[str, Any]:
    told: dict[str, Any] = {"scale": scene.scale, "planar": scene.planar, "frame": scene.frame}
    for station in scene.stations:
        place = ", ".join(digits(float(v)) for v in station.position)
        told[f"station on channel {station.channel}"] = {
            "position" if scene.scale == "unit" else "position_m": place,
            "calibration": station.calibration.source,
            "id": None if station.id is None else f"{station.id:08x}",
        }
    for marker in scene.markers:
        told[f"marker {marker.name}"] = ", ".join(digits(float(v)) for v in marker.position) + " m"
    return told


def _table(rows: list[tuple[str, str]]) -> Table:
    shown = rows[:MOST_ROWS]
    if len(rows) > MOST_ROWS:
        shown.append(("...", f"and {len(rows) - MOST_ROWS} more"))
    return Table(("", ""), shown)


def _flat(facts: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Rows of nested facts; long lists and what is unknown are left out."""
    for key, value in facts.items():
        name = f"{before}{_words(str(key))}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name}: ")
        elif isinstance(value, list | tuple):
            yield from _listed(name, value)
        elif value is not None:
            yield name, _cut(_value(value))


def _listed(name: str, values: Sequence[Any]) -> Iterator[tuple[str, str]]:
    if not values:
        return
    nested = any(isinstance(value, Mapping | list | tuple) for value in values)
    if not nested and len(values) <= 12:
        yield name, _cut(", ".join(_value(value) for value in values))
    elif nested and len(values) <= 3:
        for k, value in enumerate(values):
            yield from _flat({f"{k + 1}": value}, f"{name} ")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value is None else str(value)


def _words(key: str) -> str:
    """A key as a person reads it, its unit in brackets."""
    name, _, unit = key.rpartition("_")
    if name and unit in _UNITS:
        return f"{name.replace('_', ' ')} [{_UNITS[unit]}]"
    return key.replace("_", " ")


def _cut(words: str) -> str:
    return words if len(words) <= LONGEST else words[: LONGEST - 4] + " ..."
