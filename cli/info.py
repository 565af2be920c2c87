"""``locatk info``: what is in a file."""

from __future__ import annotations

from collections.abc import Sequence
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
    (.toml): a lighthouse scene, a manifest of dot sheets, a camera.

    A damaged or cut recording is described as far as it can be read; the exit status
    is 3 then.

    \b
    Examples:
      locatk info run.mcap
      locatk info run.mcap --json
      locatk info scene.toml
      locatk info sheet.toml
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
    from locatk.formats import artifacts, describe, sheets, toml

    table = toml.read(file)
    known = (artifacts.SCENE_FORMAT, sheets.MANIFEST_FORMAT, sheets.CAMERA_FORMAT)
    name = table.text("format", choices=known)
    if name == sheets.MANIFEST_FORMAT:
        manifest = describe.manifest(sheets.read_manifest(file))
        return {"kind": "manifest", "system": "dots", **manifest}
    if name == sheets.CAMERA_FORMAT:
        camera = describe.camera(sheets.read_camera(file))
        return {"kind": "camera", "system": "dots", "camera": camera}
    scene = artifacts.read_scene(file)
    return {"kind": "scene", "system": "lighthouse", **_scene(scene)}


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


def _place(sheet: dict[str, Any]) -> str:
    x, y = sheet["position_mm"]
    return f"{x:.6g},{y:.6g} mm, {sheet['heading_deg']:.4g} deg"


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
