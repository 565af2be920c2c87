"""``locatk recover``: salvage a damaged recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.cli.info.capture import size
from locatk.cli.info.text import when

MAX_LISTED_LOSSES = 20
"""Losses listed in the text output; ``--json`` contains all of them."""


@click.command(cls=Command, short_help="Salvage a damaged recording.")
@options.input_argument("file")
@options.output("Recording to write (.mcap).", endings=(".mcap",))
@options.overwrite
@options.as_json
@options.verbosity
def command(file: Path, output: Path, overwrite: bool, as_json: bool) -> None:
    """Write the intact parts of FILE to OUTPUT, as a complete recording.

    FILE (.mcap, of any tool) may be truncated (killed program), zeroed (power failure), overwritten
    in parts, or have flipped bits. Every intact chunk of messages is saved, with the remaining
    attachments and metadata. Data with a wrong checksum are never used. FILE itself is not changed.

    The exit status is 3 if data were lost, or may have been: if the end of a recording is missing,
    the amount of lost data is unknown. It is 0 if only an index was damaged.

    \b
    Examples:
      locatk recover run.mcap -o whole.mcap
      locatk recover run.mcap -o whole.mcap --overwrite --json
    """
    from locatk.formats.sessions.recovery.recover import recover

    options.guard_output(output, overwrite=overwrite, inputs=[file])
    with console.working(f"Recovering {file}"):
        recovered = recover(file, output, overwrite=overwrite)
    if as_json:
        console.emit_json(_facts(recovered, output.stat().st_size))
    else:
        console.result(_text(recovered))
    if not recovered.complete:
        raise failures.Incomplete(f"{file}: lost {_lost(recovered)}")
    if recovered.damaged:
        console.say(f"The index of {file} was damaged and rebuilt; no data were lost.")


def _facts(recovered: Any, written: int) -> dict[str, Any]:
    """Return the object of ``--json``."""
    return {
        "version": 1,
        "source": recovered.source,
        "output": recovered.output,
        "bytes": written,
        "complete": recovered.complete,
        "damaged": recovered.damaged,
        "ended": recovered.ended,
        "messages": recovered.messages,
        "chunks": recovered.chunks,
        "attachments": recovered.attachments,
        "metadata": recovered.metadata,
        "topics": [
            {
                "topic": each.topic,
                "schema": each.schema,
                "saved": each.saved,
                "lost": each.lost,
                "missing_bytes": each.missing_bytes,
            }
            for each in recovered.topics
        ],
        "lost_messages": recovered.lost_messages,
        "lost_attachments": recovered.lost_attachments,
        "lost_metadata": recovered.lost_metadata,
        "lost_bytes": recovered.lost_bytes,
        "tail_bytes": recovered.tail,
        "damaged_chunks": recovered.damaged_chunks,
        "orphans": recovered.orphans,
        "late": recovered.late,
        "nameless": recovered.nameless,
        "unconfirmed": recovered.unconfirmed,
        "losses": [
            {
                "start": each.start,
                "end": each.end,
                "what": each.what,
                "name": each.name,
                "start_ns": each.start_ns,
                "end_ns": each.end_ns,
            }
            for each in recovered.losses
        ],
    }


def _text(recovered: Any) -> str:
    lines = [
        f"Wrote {recovered.output}: {_count(recovered.messages, 'message')} of "
        f"{_count(recovered.chunks, 'chunk')}, {_count(recovered.attachments, 'attachment')}, "
        f"{_count(recovered.metadata, 'metadata record')}"
    ]
    rows = [(t.topic, t.schema, t.saved, _number(t.lost)) for t in recovered.topics]
    if rows:
        lines += ["", console.table(("topic", "schema", "saved", "lost"), rows)]
    losses = [
        (loss.start, loss.end, f"{loss.what} {loss.name}".rstrip(), _times(loss))
        for loss in recovered.losses[:MAX_LISTED_LOSSES]
    ]
    if losses:
        lines += ["", console.table(("from byte", "to", "unreadable", "recorded (UTC)"), losses)]
    if len(recovered.losses) > MAX_LISTED_LOSSES:
        lines.append(f"... and {len(recovered.losses) - MAX_LISTED_LOSSES} more: see --json")
    return "\n".join(lines)


def _lost(recovered: Any) -> str:
    """Return the losses in one sentence."""
    holes = len(recovered.losses) - bool(recovered.tail)
    hole_bytes = recovered.lost_bytes - recovered.tail
    late = recovered.late
    others = (recovered.lost_messages or late) - late
    words = [
        words
        for count, words in (
            (others, _count(others, "message")),
            (late, f"{_count(late, 'message')} with a time after the year 2262"),
            (recovered.orphans, f"{_count(recovered.orphans, 'message')} without a channel"),
            (recovered.lost_attachments, _count(recovered.lost_attachments or 0, "attachment")),
            (recovered.lost_metadata, _count(recovered.lost_metadata or 0, "metadata record")),
            (holes, f"{size(hole_bytes)} at {_count(holes, 'place')}"),
            (len(recovered.nameless), f"the schema of {', '.join(recovered.nameless)}"),
            (
                len(recovered.unconfirmed),
                f"the confirmed names of {', '.join(recovered.unconfirmed)}",
            ),
        )
        if count
    ]
    words += [
        f"{size(topic.missing_bytes)} received on {topic.topic}"
        for topic in recovered.topics
        if topic.missing_bytes
    ]
    if not recovered.ended:
        tail = f" ({size(recovered.tail)} of it remain)" if recovered.tail else ""
        words.append(f"the end{tail} and the data after it")
    return ", ".join(words)


def _times(loss: Any) -> str:
    """Format the recorded time of lost data; the date only once."""
    if loss.start_ns is None or loss.end_ns is None:
        return "-"
    start, end = (
        str(when(time_ns)).removesuffix("+00:00") for time_ns in (loss.start_ns, loss.end_ns)
    )
    date = f"{start.partition('T')[0]}T"
    return f"{start} to {end.removeprefix(date)}"


def _number(value: int | None) -> str:
    return "?" if value is None else str(value)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
