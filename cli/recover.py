"""``locatk recover``: what is left of a damaged recording, as a whole one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.info.capture import size
from locatk.cli.info.text import when

if TYPE_CHECKING:
    from locatk.formats.sessions.recovery.recover import Recovered
    from locatk.formats.sessions.recovery.salvage import Loss

MOST_LOSSES = 20
"""So many losses are listed for people; ``--json`` holds them all."""


@click.command(short_help="Salvage a damaged recording.")
@options.input_argument("file")
@options.output("Recording to write (.mcap).")
@options.overwrite
@options.as_json
@options.verbosity
def command(file: Path, output: Path, overwrite: bool, as_json: bool) -> None:
    """Write what is left of FILE to OUTPUT, as a whole recording.

    FILE (.mcap, of any tool) may be cut short, as by a program that was killed, zeroed, as by
    a power cut, overwritten in places or have flipped bits. Every whole chunk of messages is
    saved, wherever it lies, with the attachments and metadata that are left. Nothing is
    believed that has a wrong checksum. FILE itself is not touched.

    The exit status is 3 where something was lost, or may have been: a recording without an end
    says nothing of what came last. It is 0 where only an index was damaged.

    \b
    Examples:
      locatk recover run.mcap -o whole.mcap
      locatk recover run.mcap -o whole.mcap --overwrite --json
    """
    from locatk.formats.sessions.recovery.recover import recover

    options.guard_output(output, overwrite=overwrite, inputs=[file])
    with console.working(f"Recovering {file}"):
        found = recover(file, output, overwrite=overwrite)
    if as_json:
        console.emit_json(_facts(found, output.stat().st_size))
    else:
        console.result(_text(found))
    if not found.complete:
        raise failures.Incomplete(f"lost {_lost(found)} in {file}")
    if found.damaged:
        console.say(f"The index of {file} was damaged and is made anew; nothing was lost.")


def _facts(found: Recovered, written: int) -> dict[str, Any]:
    """What ``--json`` says."""
    return {
        "version": 1,
        "source": found.source,
        "output": found.output,
        "bytes": written,
        "complete": found.complete,
        "damaged": found.damaged,
        "ended": found.ended,
        "messages": found.messages,
        "chunks": found.chunks,
        "attachments": found.attachments,
        "metadata": found.metadata,
        "topics": [
            {
                "topic": each.topic,
                "schema": each.schema,
                "saved": each.saved,
                "lost": each.lost,
                "missing_bytes": each.missing_bytes,
            }
            for each in found.topics
        ],
        "lost_messages": found.lost_messages,
        "lost_attachments": found.lost_attachments,
        "lost_metadata": found.lost_metadata,
        "lost_bytes": found.lost_bytes,
        "tail_bytes": found.tail,
        "damaged_chunks": found.damaged_chunks,
        "orphans": found.orphans,
        "nameless": found.nameless,
        "losses": [
            {
                "start": each.start,
                "end": each.end,
                "what": each.what,
                "name": each.name,
                "start_ns": each.start_ns,
                "end_ns": each.end_ns,
            }
            for each in found.losses
        ],
    }


def _text(found: Recovered) -> str:
    lines = [
        f"Wrote {found.output}: {_count(found.messages, 'message')} of "
        f"{_count(found.chunks, 'chunk')}, {_count(found.attachments, 'attachment')}, "
        f"{_count(found.metadata, 'metadata record')}"
    ]
    rows = [(t.topic, t.schema, t.saved, _number(t.lost)) for t in found.topics]
    if rows:
        lines += ["", console.table(("topic", "schema", "saved", "lost"), rows)]
    losses = [
        (loss.start, loss.end, f"{loss.what} {loss.name}".rstrip(), _times(loss))
        for loss in found.losses[:MOST_LOSSES]
    ]
    if losses:
        lines += ["", console.table(("from byte", "to", "unreadable", "recorded"), losses)]
    if len(found.losses) > MOST_LOSSES:
        lines.append(f"... and {len(found.losses) - MOST_LOSSES} more: see --json")
    return "\n".join(lines)


def _lost(found: Recovered) -> str:
    """What was lost, and how much, in one sentence."""
    inner = len(found.losses) - bool(found.tail)
    places = found.lost_bytes - found.tail
    words = [
        words
        for count, words in (
            (found.lost_messages, _count(found.lost_messages or 0, "message")),
            (found.orphans, f"{_count(found.orphans, 'message')} that nothing names"),
            (found.lost_attachments, _count(found.lost_attachments or 0, "attachment")),
            (found.lost_metadata, _count(found.lost_metadata or 0, "metadata record")),
            (inner, f"{size(places)} at {_count(inner, 'place')}"),
            (len(found.nameless), f"the schema of {', '.join(found.nameless)}"),
        )
        if count
    ]
    words += [
        f"{size(topic.missing_bytes)} received on {topic.topic}"
        for topic in found.topics
        if topic.missing_bytes
    ]
    if not found.ended:
        tail = f" ({size(found.tail)} are left of it)" if found.tail else ""
        words.append(f"the end{tail} and whatever came last")
    return ", ".join(words)


def _times(loss: Loss) -> str:
    if loss.start_ns is None or loss.end_ns is None:
        return "-"
    return f"{when(loss.start_ns)} to {when(loss.end_ns)}"


def _number(value: int | None) -> str:
    return "?" if value is None else str(value)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
