"""Text of ``locatk info``: a block of facts, and a table for each kind of content."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from locatk.cli import console
from locatk.cli.info import capture as info_capture
from locatk.cli.info import lighthouse as info_lighthouse
from locatk.cli.info.capture import size

MAX_ROWS = 20
"""Number of tags or landmarks that are listed; ``--json`` lists all."""

MAX_MAP_CELLS = 5_000
"""Number of cells of the largest map that is drawn."""

MAX_DEVICES = 3
"""Number of devices that the overview of several files names."""

KNOWN_METADATA = {
    ("locatk", key) for key in ("format_version", "tool_version", "kind", "system", "provisional")
}
"""Entries that the first lines show."""

POSE_PREFIX = "/pose/"
"""Topics of the poses of a solution."""

SIMULATION_PREFIX = "simulated_"
"""Prefix of the options and the truth of a simulation, which are many and long."""


def text(facts: dict[str, Any]) -> str:
    """Format the facts of ``--json``."""
    from locatk.core.natural_order import natural_key

    kind = facts.get("kind") or "recording of another tool"
    system = f", {facts['system']}" if facts.get("system") else ""
    facts_by_label = (
        ("size", size(facts["bytes"])),
        ("made by", facts.get("library")),
        ("start", when(facts.get("start_ns"))),
        ("duration", _seconds(facts.get("duration_s"))),
        ("devices", ", ".join(sorted(facts.get("devices", ()), key=natural_key))),
        ("sweeps", facts.get("sweeps")),
        ("markers", facts.get("markers")),
        ("scale", facts.get("scale")),
        ("provisional", _provisional(facts.get("metadata") or {})),
        ("frames", facts.get("frames")),
        ("print", _print(facts)),
        ("camera", _camera(facts.get("camera"))),
        ("samples", facts.get("samples")),
        ("tag", _design(facts)),
        ("magnet", _magnet(facts.get("magnet"))),
        ("map", _floor(facts)),
        ("bars", _bars(facts.get("bars"))),
        ("patterns", _patterns(facts.get("patterns"))),
        *info_capture.lines(facts.get("capture") or {}),
        ("not read", _unread(facts.get("unread_bytes"))),
        ("damage", facts.get("damage")),
        *(("note", note) for note in facts.get("notes", ())),
    )
    shown_facts = [
        (f"{label}:", str(value)) for label, value in facts_by_label if value not in (None, "")
    ]
    lines = [f"{facts['file']}: {kind}{system}", console.labelled(shown_facts, indent=2)]

    def section(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
        if rows:
            lines.extend(["", console.table(header, rows)])

    streams = sorted(facts.get("streams", ()), key=lambda stream: natural_key(stream["topic"]))
    counted = any(s["samples"] is not None for s in streams)
    section(
        ("stream", "schema", "messages", "Hz", *(("samples", "Hz") if counted else ())),
        [
            (
                *(s["topic"], s["schema"], s["messages"], _rate(s["rate_hz"])),
                *((_known(s["samples"]), _rate(s["samples_hz"])) if counted else ()),
            )
            for s in streams
        ],
    )
    section(*info_lighthouse.station_table(facts.get("stations", ()), facts.get("scale")))
    section(*info_lighthouse.receiver_table(facts.get("receivers", ())))
    section(
        ("camera", "frames", "px"),
        [(c["device"], c["frames"], _by(c["size_px"])) for c in facts.get("cameras", ())],
    )
    section(
        ("sheet", "origin", "dots", "section", "paper [mm]", "pattern [mm]", "frame", "position"),
        [
            (
                s["id"],
                ",".join(map(str, s["origin"])),
                _by(s["size"]),
                ",".join(map(str, s["section"])),
                _by(s["page_mm"]),
                _by(s["pattern_mm"]),
                s["frame"],
                "-" if s["position_mm"] is None else _pose(s),
            )
            for s in facts.get("sheets", ())
        ],
    )
    section(
        ("array", "sensors", "Hz", "unused", "width [mm]", "noise [uT]", "range [uT]", "sensor"),
        [
            (
                a.get("device", "-"),
                a["sensors"],
                _rate(a.get("rate_hz")),
                _known(a.get("left_out")),
                f"{max(p[1] for p in a['position_mm']) - min(p[1] for p in a['position_mm']):.6g}",
                _axes(a["noise_ut"]),
                _axes(a["range_ut"]),
                a["sensor"] or "-",
            )
            for a in facts.get("arrays", ())
        ],
    )
    tags = facts.get("tags", [])
    has_meaning = any(t["meaning"] for t in tags[:MAX_ROWS])
    section(
        (
            "tag",
            "cell:orientation",
            "as built (passes)",
            "position",
            *(["meaning"] if has_meaning else []),
        ),
        [
            (
                t["id"],
                " ".join(
                    f"{c},{r}:{s}" for (c, r), s in zip(t["cells"], t["symbols"], strict=True)
                ),
                "-" if t["passes"] is None else t["passes"],
                "-" if t["position_mm"] is None else _pose(t),
                *([t["meaning"] or "-"] if has_meaning else []),
            )
            for t in tags[:MAX_ROWS]
        ],
    )
    if len(tags) > MAX_ROWS:
        lines.append(f"... and {len(tags) - MAX_ROWS} more: see --json")
    section(
        (
            "robot",
            "sensors",
            "Hz",
            "unused",
            "noise [uT]",
            "range [mT]",
            "sensor",
            "positions [mm]",
        ),
        [
            (
                h.get("device", "-"),
                h["sensors"],
                _rate(h.get("rate_hz")),
                _known(h.get("left_out")),
                _axes([h["noise_ut"]]),
                _axes([h["range_mt"]]),
                h["sensor"] or "-",
                _positions(h),
            )
            for h in facts.get("halls", ())
        ],
    )
    if facts.get("map") and facts["rows"] * facts["columns"] <= MAX_MAP_CELLS:
        lines.extend(["", *_draw_map(facts["map"])])
    # Flagged landmarks first.
    built = sorted(facts.get("built", ()), key=lambda b: not b["flags"])
    section(
        ("cell", "x [mm]", "y [mm]", "heading [deg]", "strength of bars", "visits", "flags"),
        [
            (
                ",".join(map(str, b["cell"])),
                f"{b['x_mm']:+.2f}",
                f"{b['y_mm']:+.2f}",
                f"{b['heading_deg']:+.2f}",
                " ".join(f"{s:+.2f}" for s in b["strength"]),
                b["visits"],
                ", ".join(b["flags"]) or "-",
            )
            for b in built[:MAX_ROWS]
        ],
    )
    if len(built) > MAX_ROWS:
        lines.append(f"... and {len(built) - MAX_ROWS} more: see --json")
    section(
        ("attachment", "type", "bytes"),
        [(a["name"], a["media_type"], a["bytes"]) for a in facts.get("attachments", ())],
    )
    lines += _metadata(facts.get("metadata", {}))
    return "\n".join(lines)


def _metadata(records: dict[str, dict[str, Any]]) -> list[str]:
    """Format the metadata that the lines above do not show, a block for each record."""
    lines, simulation_options = [], 0
    for name, record in records.items():
        entries = []
        for key, value in record.items():
            if (name, key) in KNOWN_METADATA or info_capture.is_shown(name, key):
                continue
            if info_lighthouse.is_shown(name, key):
                continue
            if key.startswith(SIMULATION_PREFIX) and not console.verbose():
                simulation_options += 1
            else:
                entries.append((key, str(value)))
        if entries:
            lines += ["", f"metadata {name}", console.labelled(entries)]
    if simulation_options:
        lines.append(f"... and {simulation_options} options of the simulation: see -v")
    return lines


def _provisional(records: dict[str, dict[str, Any]]) -> str | None:
    """Format the devices whose poses are provisional."""
    devices = records.get("locatk", {}).get("provisional")
    return devices and f"{devices} (poses may be wrong by more than their covariance)"


def _unread(unread: int | None) -> str | None:
    if unread is None:
        return None
    return f"the samples ({size(unread)}); this description is from the index of the file"


def _print(facts: dict[str, Any]) -> str | None:
    if "dpi" not in facts:
        return None
    scale = [facts["scale_x"], facts["scale_y"]]
    measured = "" if scale == [1, 1] else f", scale {scale[0]:.6g} x {scale[1]:.6g}"
    return (
        f"{facts['codec']}, pitch {facts['pitch_mm']:.6g} mm, dots {facts['dot_mm']:.3g} mm, "
        f"{facts['dpi']} dpi{measured}"
    )


def _camera(camera: dict[str, Any] | None) -> str | None:
    if camera is None:
        return None
    x, y = camera["centre_px"]
    return (
        f"{_by(camera['size_px'])} px, focal length {camera['focal_px']:.6g} px, centre "
        f"{x:.6g},{y:.6g}, radial {camera['radial']:.4g} ({camera['distortion_px']:.2g} px "
        "in the corners)"
    )


def _design(facts: dict[str, Any]) -> str | None:
    if "orientations" not in facts:
        return None
    family = "" if facts["family"] is None else f", a family of {facts['family']}"
    distance = "" if facts["min_distance"] == 1 else f", {facts['min_distance']} steps apart"
    return (
        f"{facts['codec']}, {facts['magnets']} magnets of {facts['orientations']} orientations on "
        f"{facts['order']} x {facts['order']} cells {facts['spacing_mm']:.6g} mm apart, "
        f"{facts['clearance_mm']:.6g} mm below the sensors, {facts['capacity']} ids"
        f"{family}{distance}"
    )


def _magnet(magnet: dict[str, Any] | None) -> str | None:
    if magnet is None:
        return None
    grade = f"{magnet['grade']}, " if magnet["grade"] else ""
    return (
        f"{magnet['diameter_mm']:.6g} x {magnet['height_mm']:.6g} mm, {grade}"
        f"{magnet['remanence_t']:.4g} T, {1e3 * magnet['moment_am2']:.4g} mA m2"
    )


def _floor(facts: dict[str, Any]) -> str | None:
    if "alphabet" not in facts:
        return None
    holes = facts["rows"] * facts["columns"] - facts["landmarks"]
    words = [
        f"{facts['rows']} rows x {facts['columns']} columns {facts['pitch_mm']:.6g} mm apart",
        *([facts["name"]] if facts["name"] else []),
        f"alphabet {facts['alphabet']}, window {facts['window']}",
        *([f"detects {facts['detect']} misread"] if facts["detect"] else []),
        *([f"{holes} without a landmark"] if holes else []),
        *([f"{facts['walls']} wall{'' if facts['walls'] == 1 else 's'}"] if facts["walls"] else []),
        *([f"{len(facts['built'])} as built"] if facts["built"] else []),
    ]
    return ", ".join(words)


def _bars(bars: dict[str, Any] | None) -> str | None:
    if bars is None:
        return None
    return (
        f"{' x '.join(f'{size:.6g}' for size in bars['size_mm'])} mm, {bars['remanence_t']:.4g} T, "
        f"{bars['radius_mm']:.6g} mm from the centre, {bars['sensor_height_mm']:.6g} mm below the "
        "sensors"
    )


def _patterns(patterns: dict[str, int] | None) -> str | None:
    if patterns is None:
        return None
    return ", ".join(f"{count} {letters}" for letters, count in patterns.items() if count)


def _draw_map(rows: list[str]) -> list[str]:
    """Draw the map with y up: the first row of the file is the lowest."""
    width = len(str(len(rows) - 1))
    tens = "".join(str(column // 10) if column % 10 == 0 else " " for column in range(len(rows[0])))
    ones = "".join(str(column % 10) for column in range(len(rows[0])))
    ruler = [ones] if len(rows[0]) <= 10 else [ones, tens]
    return [
        "map from above, y up:",
        *(f"  {number:>{width}}  {row}" for number, row in reversed(list(enumerate(rows)))),
        *(f"  {'':>{width}}  {line}".rstrip() for line in ruler),
    ]


def _positions(halls: dict[str, Any]) -> str:
    pairs = zip(halls["names"], halls["position_mm"], strict=True)
    return "  ".join(f"{name} {x:.6g},{y:.6g}" for name, (x, y) in pairs)


def _axes(values: Sequence[float]) -> str:
    """Format numbers by axis, `-` if unknown."""
    return " ".join(f"{value:.4g}" if math.isfinite(value) else "-" for value in values)


def _pose(site: dict[str, Any]) -> str:
    x, y = site["position_mm"]
    return f"{x:.6g},{y:.6g} mm, {site['heading_deg']:.4g} deg"


def _by(pair: Sequence[float] | None) -> str:
    return "-" if pair is None else f"{pair[0]:.6g} x {pair[1]:.6g}"


def overview(described: Sequence[dict[str, Any]]) -> str:
    """Format the facts of several files, one line each."""
    header = ("file", "kind", "system", "start", "duration", "poses", "devices")
    rows = []
    for facts in described:
        start = when(facts.get("start_ns"))
        rows.append(
            (
                facts["file"],
                facts.get("kind") or "other",
                facts.get("system") or "",
                start and start[:16].replace("T", " "),
                _seconds(facts.get("duration_s"), digits=1),
                _poses(facts),
                _few(_devices(facts)),
            )
        )
    # Columns that are empty for all files are left out.
    used = [i for i in range(len(header)) if any(row[i] not in (None, "") for row in rows)]
    return console.table(
        [header[i] for i in used], [[row[i] for i in used] for row in rows], max_width=100
    )


def _devices(facts: dict[str, Any]) -> list[str]:
    """Return the devices of a session, or those with poses in a solution, in natural order."""
    from locatk.core.natural_order import natural_key

    topics = [stream["topic"] for stream in facts.get("streams", ())]
    solved = [topic.removeprefix(POSE_PREFIX) for topic in topics if topic.startswith(POSE_PREFIX)]
    return sorted(facts.get("devices") or solved, key=natural_key)


def _few(devices: Sequence[str]) -> str:
    """Name a few devices, and count the others."""
    others = len(devices) - MAX_DEVICES
    named = ", ".join(devices[: MAX_DEVICES if others > 1 else None])
    return f"{named} and {others} others" if others > 1 else named


def _poses(facts: dict[str, Any]) -> int | None:
    """Return the number of poses of a solution."""
    streams = facts.get("streams", ())
    counts = [s["messages"] for s in streams if s["topic"].startswith(POSE_PREFIX)]
    return sum(counts) if counts else None


def when(time_ns: int | None) -> str | None:
    """Format a time of a recording in UTC."""
    if time_ns is None:
        return None
    try:
        return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):  # A damaged stamp beyond the year 9999.
        return f"{time_ns} ns"


def _seconds(value: float | None, digits: int = 3) -> str | None:
    return None if value is None else f"{value:.{digits}f} s"


def _known(value: object) -> object:
    return "-" if value is None else value


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 1000 else f"{value:.3g}"
