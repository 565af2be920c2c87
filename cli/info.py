"""``locatk info``: what is in a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.core.errors import LocatkError

if TYPE_CHECKING:
    from locatk.core.lighthouse.scene import Scene
    from locatk.formats.session import Session


@click.command(short_help="Say what is in a session, a solution or an artifact.")
@options.input_argument("file")
@options.as_json
@options.verbosity
def command(file: Path, as_json: bool) -> None:
    """Say what is in FILE: a session or a solution (.mcap, of any tool), or an artifact
    (.toml): a lighthouse scene, a manifest of dot sheets, a camera, tags, a sensor array.

    A damaged or cut recording is described as far as it can be read; the exit status
    is 3 then.

    \b
    Examples:
      locatk info run.mcap
      locatk info run.mcap --json
      locatk info scene.toml
      locatk info sheet.toml
      locatk info tag.toml
    """
    facts = _artifact(file) if file.suffix.lower() == ".toml" else _recording(file)
    facts = {"version": 1, "file": str(file), "bytes": file.stat().st_size, **facts}
    if as_json:
        console.emit_json(facts)
    else:
        console.result(_text(facts))
    if facts.get("damage"):
        raise failures.Incomplete(f"{facts['damage']} in {file}")


def _artifact(file: Path) -> dict[str, Any]:
    from locatk.formats import artifacts, describe, sheets, tags, toml

    kinds: dict[str, Callable[[], dict[str, Any]]] = {
        artifacts.SCENE_FORMAT: lambda: {
            "kind": "scene",
            "system": "lighthouse",
            **_scene(artifacts.read_scene(file)),
        },
        sheets.MANIFEST_FORMAT: lambda: {
            "kind": "manifest",
            "system": "dots",
            **describe.manifest(sheets.read_manifest(file)),
        },
        sheets.CAMERA_FORMAT: lambda: {
            "kind": "camera",
            "system": "dots",
            "camera": describe.camera(sheets.read_camera(file)),
        },
        tags.TAG_FORMAT: lambda: {
            "kind": "tag",
            "system": "polaris",
            **describe.tags(tags.read_tags(file)),
        },
        tags.ARRAY_FORMAT: lambda: {
            "kind": "array",
            "system": "polaris",
            "arrays": [describe.array(tags.read_array(file))],
        },
    }
    return kinds[toml.read(file).text("format", choices=tuple(kinds))]()


def _recording(file: Path) -> dict[str, Any]:
    from locatk.formats.session import Session

    session = Session.open(file, damaged_ok=True)
    facts = session.facts
    described = {
        "kind": facts.get("kind"),
        "system": facts.get("system"),
        "tool_version": facts.get("tool_version"),
        "profile": session.profile,
        "library": session.library,
        "start_ns": session.start_ns,
        "end_ns": session.end_ns,
        "duration_s": _duration(session),
        "streams": _streams(session),
        "attachments": [
            {"name": item.name, "media_type": item.media_type, "bytes": item.size}
            for item in session.attachments()
        ],
        "metadata": session.metadata(),
        "damage": session.damage,
    }
    if facts.get("system") == "lighthouse":
        described |= _lighthouse(session)
    elif facts.get("system") == "dots":
        from locatk.formats import describe

        described |= describe.dots(session)
    elif facts.get("system") == "polaris":
        from locatk.formats import describe

        described |= describe.polaris(session)
    return described


def _duration(session: Session) -> float | None:
    if session.start_ns is None or session.end_ns is None:
        return None
    return (session.end_ns - session.start_ns) / 1e9


def _streams(session: Session) -> list[dict[str, Any]]:
    duration = _duration(session)
    return [
        {
            "topic": channel.topic,
            "schema": channel.schema,
            "encoding": channel.encoding,
            "messages": channel.count,
            # n messages span n - 1 intervals
            "rate_hz": (channel.count - 1) / duration if duration and channel.count > 1 else None,
        }
        for channel in session.channels
    ]


def _lighthouse(session: Session) -> dict[str, Any]:
    """Sweeps and stations; what is damaged is left out and said."""
    import numpy as np

    from locatk.core.lighthouse.scene import Scene
    from locatk.formats import observations

    described: dict[str, Any] = {}
    counts: dict[int, int] = {}
    scene = None
    try:
        scene = observations.read_scene(session)
        if session.topics("/lighthouse/"):
            sweeps = observations.read_sweeps(session)
            channels, numbers = np.unique(sweeps.channel, return_counts=True)
            counts = dict(zip(channels.tolist(), numbers.tolist(), strict=True))
            described = {"devices": list(sweeps.devices), "sweeps": len(sweeps)}
    except LocatkError as error:
        described["damage"] = session.damage or error.message
    return described | _scene(scene or Scene(), counts)


def _scene(scene: Scene, sweeps: dict[int, int] | None = None) -> dict[str, Any]:
    """Stations that are in the scene, or only seen in ``sweeps`` (channel to count)."""
    from locatk.core.lighthouse.channels import period_ticks

    channels = sorted({station.channel for station in scene.stations} | set(sweeps or {}))
    stations = []
    for channel in channels:
        station = scene.station(channel)
        stations.append(
            {
                "channel": channel,
                "id": station.id if station else None,
                "period_ticks": int(period_ticks(channel)),
                "sweeps": (sweeps or {}).get(channel),
                "calibration": station.calibration.source if station else None,
                "position_m": station.position if station else None,
            }
        )
    return {
        "stations": stations,
        "markers": len(scene.markers),
        "scale": scene.scale if scene.stations else None,
        "planar": scene.planar,
        "frame": scene.frame,
        "notes": list(scene.notes),
    }


MOST_TAGS = 20
"""So many tags of a family are listed for people; ``--json`` holds them all."""

SHOWN_ABOVE = {("locatk", key) for key in ("format_version", "tool_version", "kind", "system")}


def _text(facts: dict[str, Any]) -> str:
    kind = facts.get("kind") or "recording of another tool"
    lines = [f"{facts['file']}: {kind}" + (f", {facts['system']}" if facts.get("system") else "")]
    for label, value in (
        ("size", _size(facts["bytes"])),
        ("made by", facts.get("library")),
        ("start", _when(facts.get("start_ns"))),
        ("duration", _seconds(facts.get("duration_s"))),
        ("devices", ", ".join(facts.get("devices", ()))),
        ("sweeps", facts.get("sweeps")),
        ("markers", facts.get("markers")),
        ("scale", facts.get("scale")),
        ("frames", facts.get("frames")),
        ("print", _print(facts)),
        ("camera", _camera(facts.get("camera"))),
        ("samples", facts.get("samples")),
        ("tag", _design(facts)),
        ("magnet", _magnet(facts.get("magnet"))),
        ("damage", facts.get("damage")),
    ):
        if value not in (None, ""):
            lines.append(f"  {label + ':':<10}{value}")
    for note in facts.get("notes", ()):
        lines.append(f"  note:     {note}")

    def section(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
        if rows:
            lines.extend(["", console.table(header, rows)])

    section(
        ("stream", "schema", "messages", "Hz"),
        [
            (s["topic"], s["schema"], s["messages"], _rate(s["rate_hz"]))
            for s in facts.get("streams", ())
        ],
    )
    section(
        ("channel", "id", "period", "sweeps", "calibration"),
        [
            tuple(
                "-" if value is None else value
                for value in (
                    s["channel"],
                    None if s["id"] is None else f"{s['id']:08x}",
                    s["period_ticks"],
                    s["sweeps"],
                    s["calibration"],
                )
            )
            for s in facts.get("stations", ())
        ],
    )
    section(
        ("camera", "frames", "px"),
        [(c["device"], c["frames"], _by(c["size_px"])) for c in facts.get("cameras", ())],
    )
    section(
        ("sheet", "origin", "dots", "section", "paper [mm]", "pattern [mm]", "frame", "place"),
        [
            (
                s["id"],
                ",".join(map(str, s["origin"])),
                _by(s["size"]),
                ",".join(map(str, s["section"])),
                _by(s["page_mm"]),
                _by(s["pattern_mm"]),
                s["frame"],
                "-" if s["position_mm"] is None else _place(s),
            )
            for s in facts.get("sheets", ())
        ],
    )
    section(
        ("array", "sensors", "Hz", "left out", "width [mm]", "noise [uT]", "range [uT]", "sensor"),
        [
            (
                a.get("device", "-"),
                a["sensors"],
                _rate(a.get("rate_hz")),
                a.get("left_out", "-"),
                f"{max(p[1] for p in a['position_mm']) - min(p[1] for p in a['position_mm']):.6g}",
                _axes(a["noise_ut"]),
                _axes(a["range_ut"]),
                a["sensor"] or "-",
            )
            for a in facts.get("arrays", ())
        ],
    )
    tags = facts.get("tags", [])
    section(
        ("tag", "cell:orientation", "as built (passes)", "place"),
        [
            (
                t["id"],
                " ".join(
                    f"{c},{r}:{s}" for (c, r), s in zip(t["cells"], t["symbols"], strict=True)
                ),
                "-" if t["passes"] is None else t["passes"],
                "-" if t["position_mm"] is None else _place(t),
            )
            for t in tags[:MOST_TAGS]
        ],
    )
    if len(tags) > MOST_TAGS:
        lines.append(f"... and {len(tags) - MOST_TAGS} more: see --json")
    section(
        ("attachment", "type", "bytes"),
        [(a["name"], a["media_type"], a["bytes"]) for a in facts.get("attachments", ())],
    )
    section(
        ("metadata", "key", "value"),
        [
            (name, key, value)
            for name, record in facts.get("metadata", {}).items()
            for key, value in record.items()
            if (name, key) not in SHOWN_ABOVE
        ],
    )
    return "\n".join(lines)


def _print(facts: dict[str, Any]) -> str | None:
    if "pitch_mm" not in facts:
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
    apart = "" if facts["min_distance"] == 1 else f", {facts['min_distance']} steps apart"
    return (
        f"{facts['codec']}, {facts['magnets']} magnets of {facts['orientations']} orientations on "
        f"{facts['order']} x {facts['order']} cells {facts['spacing_mm']:.6g} mm apart, "
        f"{facts['clearance_mm']:.6g} mm below the sensors, {facts['capacity']} ids{family}{apart}"
    )


def _magnet(magnet: dict[str, Any] | None) -> str | None:
    if magnet is None:
        return None
    grade = f"{magnet['grade']}, " if magnet["grade"] else ""
    return (
        f"{magnet['diameter_mm']:.6g} x {magnet['height_mm']:.6g} mm, {grade}"
        f"{magnet['remanence_t']:.4g} T, {1e3 * magnet['moment_am2']:.4g} mA m2"
    )


def _axes(values: Sequence[float]) -> str:
    """Numbers by axis, `-` where unknown."""
    return " ".join(f"{value:.4g}" if math.isfinite(value) else "-" for value in values)


def _place(found: dict[str, Any]) -> str:
    x, y = found["position_mm"]
    return f"{x:.6g},{y:.6g} mm, {found['heading_deg']:.4g} deg"


def _by(pair: Sequence[float] | None) -> str:
    return "-" if pair is None else f"{pair[0]:.6g} x {pair[1]:.6g}"


def _when(time_ns: int | None) -> str | None:
    if time_ns is None:
        return None
    try:
        return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):  # a damaged stamp beyond the year 9999
        return f"{time_ns} ns"


def _seconds(value: float | None) -> str | None:
    return None if value is None else f"{value:.3f} s"


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _size(count: int) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"
