"""``locatk info``: description of a session, a solution or an artifact."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.cli.info.text import overview, text
from locatk.core.errors import LocatkError

if TYPE_CHECKING:
    from locatk.formats.sessions.reader import Session

ENDINGS = (".mcap", ".toml")
"""Endings of the files of a folder that are described."""


@click.command(cls=Command, short_help="Describe a session, a solution or an artifact.")
@click.argument("names", metavar="FILE...", type=options.PATH, nargs=-1, required=True)
@options.as_json
@options.verbosity
def command(names: tuple[Path, ...], as_json: bool) -> None:
    """Describe FILE: a session or solution (.mcap, also of other tools), or an artifact (.toml).

    Several files, a folder or a pattern are listed in a table, one line each.

    Artifacts are Lighthouse scenes and receivers; manifests of dot sheets and cameras; tags and
    sensor arrays; maps of landmarks and hall sensors.

    For each Lighthouse station, the output lists channel, serial number, period of a rotation (in
    ticks of 48 MHz and, if it was measured, its difference from the nominal one in ppm), number of
    sweeps, fraction of decoded sweeps, and origin of the calibration.

    A damaged or truncated recording is described as far as it can be read. The exit status is then
    3, and `locatk recover` saves the rest. For recordings with more than 16 MB of samples, only the
    index is read.

    \b
    Examples:
      locatk info run.mcap
      locatk info run.mcap --json
      locatk info recordings/
      locatk info solved.mcap
      locatk info scene.toml
      locatk info receiver.toml
      locatk info sheet.toml
      locatk info tag.toml
      locatk info map.toml
    """
    from locatk.formats.pipeline.file_search import expand_name

    if len(names) > 1 or expand_name(str(names[0]), ENDINGS) is not None:
        _describe_several(names, as_json=as_json)
        return
    file = names[0]
    facts = {"version": 1, **_describe(file)}
    if as_json:
        console.emit_json(facts)
    else:
        console.result(text(facts))
    if facts.get("damage"):
        hint = "; `locatk recover` saves the rest" if facts["recoverable"] else ""
        raise failures.Incomplete(f"{file}: {facts['damage']}{hint}")


def _describe_several(names: Sequence[Path], *, as_json: bool) -> None:
    """List files, one line each; those that cannot be read at the end."""
    from locatk.formats.pipeline.file_search import expand_name

    described: list[dict[str, Any]] = []
    failures_by_file: dict[Path, LocatkError] = {}
    found: dict[Path, None] = {}
    for name in names:
        try:
            expanded = expand_name(str(name), ENDINGS) or [str(name)]
            found.update((Path(file), None) for file in expanded)
        except LocatkError as error:
            failures_by_file[name] = error
    files, count = list(found), len(found) + len(failures_by_file)
    with console.progress(files, "Reading") as items:
        for file in items:
            try:
                described.append(_describe(file))
            except LocatkError as error:
                failures_by_file[file] = error
    if as_json:
        unread = [
            {"file": file, "error": error.message, "hint": error.hint}
            for file, error in failures_by_file.items()
        ]
        console.emit_json({"version": 1, "files": described, "failures": unread})
    elif described:
        console.result(overview(described))
    damaged = [facts for facts in described if facts.get("damage")]
    for facts in damaged:
        console.warn(f"{facts['file']} is damaged: {facts['damage']}")
    for file, failure in failures_by_file.items():
        console.warn(f"{file} was not described: {failure.message}")
    if failures_by_file:
        raise LocatkError(
            f"{len(failures_by_file)} of {count} files could not be described",
            hint="The warnings above say why",
        )
    if damaged:
        raise failures.Incomplete(
            f"{len(damaged)} of {count} files are damaged; `locatk recover` saves the rest"
        )


def _describe(file: Path) -> dict[str, Any]:
    """Read and describe a file."""
    facts = _artifact(file) if file.suffix.lower() == ".toml" else _recording(file)
    return {"file": str(file), "bytes": file.stat().st_size, **facts}


def _artifact(file: Path) -> dict[str, Any]:
    """Read and describe an artifact."""
    from locatk.formats.artifacts.registry import identify_artifact
    from locatk.formats.descriptions import dots, landmarks, lighthouse, polaris

    descriptions: dict[str, Callable[[Any], dict[str, Any]]] = {
        "scene": lighthouse.describe_scene,
        "receiver": lambda receiver: {"receivers": [lighthouse.describe_receiver(receiver)]},
        "manifest": dots.describe_manifest,
        "camera": lambda camera: {"camera": dots.describe_camera(camera)},
        "tag": polaris.describe_tags,
        "array": lambda array: {"arrays": [polaris.describe_array(array)]},
        "map": landmarks.describe_map,
        "halls": lambda halls: {"halls": [landmarks.describe_hall_sensors(halls)]},
    }
    entry = identify_artifact(file)
    facts = descriptions[entry.kind](entry.artifact.read(file))
    return {"kind": entry.kind, "system": entry.system, **facts}


def _recording(file: Path) -> dict[str, Any]:
    """Describe a session, a solution, or a recording of another tool."""
    from locatk.formats.descriptions import dots, landmarks, lighthouse, polaris
    from locatk.formats.sessions import capture_record
    from locatk.formats.sessions.reader import Session, find_damage

    session = Session.open(file, damaged_ok=True)
    # Not all chunks of a file are read to describe it, for example those of the poses.
    if session.damage is None and file.stat().st_size <= capture_record.MAX_DESCRIBED_BYTES:
        session.damage = find_damage(file)
    facts = session.facts
    described = {
        "kind": facts.get("kind"),
        "system": facts.get("system"),
        "tool_version": facts.get("tool_version"),
        "profile": session.profile,
        "library": session.library,
        "start_ns": session.start_ns,
        "end_ns": session.end_ns,
        "duration_s": capture_record.duration_s(session),
        "streams": _streams(session),
        "capture": capture_record.capture(session),
        "attachments": [
            {"name": item.name, "media_type": item.media_type, "bytes": item.size}
            for item in session.attachments()
        ],
        "metadata": session.metadata(),
        "unread_bytes": None,
        "damage": session.damage,
        "recoverable": session.damage is not None,
    }
    systems = {
        "dots": dots,
        "landmarks": landmarks,
        "lighthouse": lighthouse,
        "polaris": polaris,
    }
    if facts.get("system") in systems:
        described |= systems[facts["system"]].describe_recording(session)
    return described


def _streams(session: Session) -> list[dict[str, Any]]:
    """Describe the channels of a recording."""
    from locatk.formats.sessions import capture_record

    samples = {each.topic: capture_record.samples(session, each.topic) for each in session.channels}
    return [
        {
            "topic": channel.topic,
            "schema": channel.schema,
            "encoding": channel.encoding,
            "messages": channel.count,
            "rate_hz": capture_record.rate_hz(session, channel.count),
            "samples": samples[channel.topic],
            "samples_hz": capture_record.rate_hz(session, samples[channel.topic]),
        }
        for channel in session.channels
    ]
