"""``locatk decode``: raw bytes of a recording into records, again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.capture.options import names_option


@click.command(short_help="Decode the raw bytes of a recording again.")
@options.input_argument("recording")
@click.option(
    "--device",
    metavar="NAME",
    help="What sent the bytes, as of `locatk capture`; `auto` finds out.  [default: what the "
    "recording says]",
)
@options.output("Session to write (.mcap).")
@options.input_option(
    "--artifact",
    many=True,
    metavar="FILE",
    help="Artifact (.toml), or a session that holds some (.mcap), to attach, in the place of "
    "what is there. Repeatable.",
)
@names_option
@options.overwrite
@options.as_json
@options.verbosity
def command(
    recording: Path,
    device: str | None,
    output: Path,
    artifact: tuple[Path, ...],
    columns: tuple[str, ...],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Make a session of the raw bytes in RECORDING and of what is decoded from them now.

    For a recording whose device was named wrong, whose decoder has become better, or to which
    an artifact shall be added. Times stay as they were recorded.

    The exit status is 3 where frames were bad or missing.

    \b
    Examples:
      locatk decode run.mcap -o again.mcap
      locatk decode run.mcap --device lines --columns t_ms,x_m,y_m,heading_deg -o again.mcap
      locatk decode run.mcap --artifact array.toml --artifact tag.toml -o again.mcap
    """
    from locatk.formats.capture import attachments as artifacts
    from locatk.formats.capture.redecoding import decode, losses
    from locatk.formats.devices.decoder import Options

    options.guard_output(output, overwrite=overwrite, inputs=[recording, *artifact])
    with console.working("Decoding"):
        decoded = decode(
            recording,
            output,
            device=device,
            options=Options(columns=columns),
            artifacts=artifacts.attachments(artifact),
            overwrite=overwrite,
        )
    for remark in decoded.remarks:
        console.warn(remark)
    rows: list[tuple[Any, ...]] = [
        (name, decoded.devices[name], t.bytes, t.frames, t.bad, t.lost, sum(t.samples.values()))
        for name, t in decoded.totals.items()
    ]
    header = ("name", "device", "bytes", "frames", "bad", "missing", "records")
    console.result(f"Wrote {output}\n" + console.table(header, rows))
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "system": decoded.system or None,
                "devices": [
                    {"name": name, "device": decoded.devices[name], **_counted(totals)}
                    for name, totals in decoded.totals.items()
                ],
                "remarks": decoded.remarks,
            }
        )
    if lost := losses(decoded):
        raise failures.Incomplete("; ".join(lost))


def _counted(totals: Any) -> dict[str, Any]:
    """What the decoder counts; the rest is of the port."""
    from locatk.formats.capture.redecoding import LINE_STATISTICS

    return {key: value for key, value in vars(totals).items() if key not in LINE_STATISTICS}
